"""Chunks of work: done here on all cores or devices, or by the workers of an executor."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxlidar._threads import side_by_side

# Chunks that an executor is given ahead of its workers.
_AHEAD = 32


class Task(NamedTuple):
    """A chunk of work that any process can do: a function, its arguments, and JAX's precision.

    `key` is the data of a random key and, for keys of the new style, the name of its kind.
    """

    number: int
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    key: tuple[np.ndarray, str | None]
    double: bool


class Outcome(NamedTuple):
    """What a task gave: arrays, or the exception that it raised."""

    arrays: Any
    error: Exception | None


def portable(key: PRNGKeyArray) -> tuple[np.ndarray, str | None]:
    """A random key as plain data."""
    if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        return np.asarray(jax.random.key_data(key)), str(jax.random.key_impl(key))
    return np.asarray(key), None


def task(number: int, function: Callable[..., Any], arguments: tuple[Any, ...], key: PRNGKeyArray) -> Task:
    """The chunk of work `function(*arguments, key)`, in JAX's present precision."""
    return Task(number, function, arguments, portable(key), jnp.result_type(float).itemsize == 8)


def done(task: Task) -> Outcome:
    """Do a task; this runs in workers. Its own exceptions come back, others mean that the worker died."""
    data, kind = task.key
    with jax.enable_x64(task.double):
        try:
            key = jnp.asarray(data)
            key = key if kind is None else jax.random.wrap_key_data(key, impl=kind)
            result = task.function(*task.arguments, key)
            return Outcome(jax.tree.map(np.asarray, result), None)
        except Exception as error:
            return Outcome(None, error)


def outcomes(
    tasks: Sequence[Task], executor: Executor | None, devices: Sequence[Any] | None = None
) -> Iterator[tuple[Task, Any]]:
    """Tasks and what they gave, as they come: from workers, from so many devices, or from all cores.

    **Raises:** what a task raises, and RuntimeError where the worker of one died twice.
    """
    for task, outcome in _here(tasks, devices) if executor is None else _there(list(tasks), executor):
        if outcome.error is not None:
            raise outcome.error
        yield task, outcome.arrays


def _here(tasks: Sequence[Task], devices: Sequence[Any] | None = None) -> Iterator[tuple[Task, Outcome]]:
    with side_by_side(devices=devices) as run:
        yield from zip(tasks, run(done, tasks))


def _there(tasks: list[Task], executor: Executor) -> Iterator[tuple[Task, Outcome]]:
    waiting, tried = tasks[::-1], dict.fromkeys((t.number for t in tasks), 0)
    running: dict[Future, Task] = {}
    try:
        while waiting or running:
            while waiting and len(running) < _AHEAD:
                task = waiting.pop()
                try:
                    running[executor.submit(done, task)] = task
                except (BrokenExecutor, RuntimeError) as error:
                    warnings.warn(
                        f"executor takes no more work ({error}): what is left is done in this process",
                        LostWorkersWarning,
                        stacklevel=2,
                    )
                    left = [task, *reversed(waiting)]
                    waiting.clear()
                    # What runs was given up with the executor.
                    left += list(running.values())
                    running.clear()
                    yield from _here(left)
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                task = running.pop(future)
                try:
                    outcome = future.result()
                except (Exception, CancelledError) as error:
                    tried[task.number] += 1
                    if tried[task.number] > 1:
                        raise RuntimeError(
                            f"the workers of chunk {task.number} died twice: {error}"
                        ) from error
                    waiting.append(task)
                    continue
                yield task, outcome
    finally:
        for future in running:
            future.cancel()


class LostWorkersWarning(UserWarning):
    """The warning that an executor takes no more work, as a process pool that lost a worker.

    What is left is done in the own process, with the same results.

    **Example:**

    >>> import jaxlidar as jl
    >>> issubclass(jl.LostWorkersWarning, UserWarning)
    True
    """
