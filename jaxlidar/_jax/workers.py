"""Units of work: run in this process on all cores or devices, or by the workers of an executor."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxlidar._fields.checks import warn_user
from jaxlidar._jax.threads import side_by_side

# Units that an executor is given ahead of its workers: enough to keep many of them busy, few enough that
# those which wait there do not fill the memory.
_QUEUED = 32


class WorkUnit(NamedTuple):
    """A unit of work that any process can do: a function, its arguments, and JAX's precision.

    `key`: the data of a random key and, for keys of the new style, the name of its implementation, since keys
    themselves cannot be pickled.
    """

    number: int
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    key: tuple[np.ndarray, str | None]
    double: bool


class UnitOutcome(NamedTuple):
    """The outcome of a unit: arrays, or the exception that it raised."""

    arrays: Any
    error: Exception | None


def portable_key(key: PRNGKeyArray) -> tuple[np.ndarray, str | None]:
    """Return a random key as plain data, see `WorkUnit`."""
    if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        return np.asarray(jax.random.key_data(key)), str(jax.random.key_impl(key))
    return np.asarray(key), None


def task(
    number: int, function: Callable[..., Any], arguments: tuple[Any, ...], key: PRNGKeyArray
) -> WorkUnit:
    """Return the unit of work `function(*arguments, key)`, in JAX's present precision."""
    double = jnp.result_type(float).itemsize == 8
    return WorkUnit(number, function, arguments, portable_key(key), double)


def run_unit(unit: WorkUnit) -> UnitOutcome:
    """Do a unit of work; this runs in workers.

    Exceptions of the work itself are part of the outcome. Any other exception that a worker causes means that
    it died.
    """
    data, implementation = unit.key
    with jax.enable_x64(unit.double):
        try:
            key = jnp.asarray(data)
            if implementation is not None:
                key = jax.random.wrap_key_data(key, impl=implementation)
            result = unit.function(*unit.arguments, key)
            return UnitOutcome(jax.tree.map(np.asarray, result), None)
        except Exception as error:
            return UnitOutcome(None, error)


def outcomes(
    tasks: Sequence[WorkUnit], executor: Executor | None, devices: Sequence[Any] | None = None
) -> Iterator[tuple[WorkUnit, Any]]:
    """Yield tasks and their results as they come: from workers, from these devices, or from all cores.

    **Raises:** the exception of a task, and RuntimeError where the worker of one died twice.
    """
    pairs = _run_locally(tasks, devices) if executor is None else _run_by_workers(list(tasks), executor)
    for unit, outcome in pairs:
        if outcome.error is not None:
            raise outcome.error
        yield unit, outcome.arrays


def in_turn(tasks: Sequence[WorkUnit]) -> Iterator[tuple[WorkUnit, Any]]:
    """Yield tasks and their results, one after the other in this thread. **Raises:** as `outcomes`."""
    for unit in tasks:
        outcome = run_unit(unit)
        if outcome.error is not None:
            raise outcome.error
        yield unit, outcome.arrays


def _run_locally(
    units: Sequence[WorkUnit], devices: Sequence[Any] | None = None
) -> Iterator[tuple[WorkUnit, UnitOutcome]]:
    with side_by_side(devices=devices) as run:
        yield from zip(units, run(run_unit, units))


def _run_by_workers(units: list[WorkUnit], executor: Executor) -> Iterator[tuple[WorkUnit, UnitOutcome]]:
    """Yield units and their outcomes from the workers of an executor.

    1. Submit units until as many are queued as may be.
    2. If the executor takes no more, as a process pool that lost a worker, run all remaining units locally.
    3. Yield the outcomes that have come; a unit whose worker died is submitted once more.
    """
    # Taken from the end.
    waiting, deaths = units[::-1], dict.fromkeys((unit.number for unit in units), 0)
    running: dict[Future, WorkUnit] = {}
    try:
        while waiting or running:
            while waiting and len(running) < _QUEUED:
                unit = waiting.pop()
                try:
                    running[executor.submit(run_unit, unit)] = unit
                except (BrokenExecutor, RuntimeError) as error:
                    warn_user(
                        f"executor takes no more work ({error}): remaining tasks are done in this process",
                        LostWorkersWarning,
                    )
                    # Running units are lost with the executor.
                    remaining = [unit, *reversed(waiting), *running.values()]
                    waiting.clear()
                    running.clear()
                    yield from _run_locally(remaining)
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                unit = running.pop(future)
                try:
                    outcome = future.result()
                except (Exception, CancelledError) as error:
                    deaths[unit.number] += 1
                    if deaths[unit.number] > 1:
                        raise RuntimeError(
                            f"the workers of chunk {unit.number} died twice: {error}"
                        ) from error
                    waiting.append(unit)
                    continue
                yield unit, outcome
    finally:
        for future in running:
            future.cancel()


class LostWorkersWarning(UserWarning):
    """Warning that an executor takes no more work, as a process pool that lost a worker.

    The remaining work is done in this process, with the same results.

    **Example:**

    >>> import jaxlidar as jl
    >>> issubclass(jl.LostWorkersWarning, UserWarning)
    True
    """
