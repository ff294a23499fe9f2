"""Compiled programs side by side: XLA runs each on one core, and several threads use all cores."""

import contextlib
import os
import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax

# Compiler options of programs that run side by side: programs that each spread over several cores would wait
# for one another.
ONE_CORE: dict[str, Any] = {
    "compiler_options": {
        "xla_cpu_multi_thread_eigen": False,
        "xla_cpu_enable_concurrency_optimized_scheduler": False,
    }
}
if jax.__version_info__ < (0, 11):
    # The XLA of these versions has a newer generator of kernels, with which compilation takes 1.5 times as
    # long, and programs run faster by a tenth at most. Later versions do not know the option, and refuse it.
    ONE_CORE["compiler_options"]["xla_cpu_use_fusion_emitters"] = False


@contextlib.contextmanager
def side_by_side(
    max_threads: int | None = None, *, devices: Sequence[Any] | None = None
) -> Iterator[Callable[[Callable, Iterable], Iterator]]:
    """Yield a `map` that runs calls on one thread for each core and returns results in order.

    There are at most `max_threads` threads. With `devices`, there is one thread for each of them, which
    computes on it. JAX keeps its precision and its default device by thread: here they are the caller's.
    Threads that need the same program at the same time wait for one compilation. Calls that have not started
    when the block ends are dropped.
    """
    config: Any = jax.config
    double, thread = config.jax_enable_x64, threading.local()
    if devices is None:
        devices = [config.jax_default_device] * max(min(os.cpu_count() or 1, max_threads or 1024), 1)
    free_devices = queue.SimpleQueue()
    for device in devices:
        free_devices.put(device)

    def take_device() -> None:
        thread.device = free_devices.get()

    pool = ThreadPoolExecutor(max_workers=len(devices), initializer=take_device)

    def run(function: Callable, items: Iterable) -> Iterator:
        def call(item: Any) -> Any:
            with jax.enable_x64(double), jax.default_device(thread.device):
                # JAX returns before results are there: a thread that goes on would have more than one in
                # flight.
                return jax.block_until_ready(function(item))

        return pool.map(call, items)

    try:
        yield run
    finally:
        pool.shutdown(cancel_futures=True)
