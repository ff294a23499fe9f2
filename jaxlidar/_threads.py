"""Compiled programs side by side: XLA runs one on one core, so that several threads use them all."""

import contextlib
import os
import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax

# For programs that run side by side: they would wait for one another if each spread over several cores.
ONE_CORE: dict[str, Any] = {
    "compiler_options": {
        "xla_cpu_multi_thread_eigen": False,
        "xla_cpu_enable_concurrency_optimized_scheduler": False,
    }
}


@contextlib.contextmanager
def side_by_side(
    most: int | None = None, *, devices: Sequence[Any] | None = None
) -> Iterator[Callable[[Callable, Iterable], Iterator]]:
    """A `map` that runs calls on as many threads as there are cores, or `most`; results come in order.

    With `devices`, there is one thread for each, which computes on it. JAX keeps its precision and its
    default device by thread: here they are the caller's. Threads that ask for the same program at once wait
    for one compilation. What has not begun when the block ends is dropped.
    """
    config: Any = jax.config
    double, own = config.jax_enable_x64, threading.local()
    if devices is None:
        devices = [config.jax_default_device] * max(min(os.cpu_count() or 1, most or 1024), 1)
    free = queue.SimpleQueue()
    for device in devices:
        free.put(device)

    def begin() -> None:
        own.device = free.get()

    pool = ThreadPoolExecutor(max_workers=len(devices), initializer=begin)

    def run(function: Callable, items: Iterable) -> Iterator:
        def one(item: Any) -> Any:
            with jax.enable_x64(double), jax.default_device(own.device):
                return jax.block_until_ready(function(item))

        return pool.map(one, items)

    try:
        yield run
    finally:
        pool.shutdown(cancel_futures=True)
