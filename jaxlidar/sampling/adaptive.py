"""Adaptive sampling: add batches until the error of an estimate is below its tolerance.

The size n of an estimate is its number of batches, or of parts of a lattice. Its error falls as n^-p: p = 1/2
for independent batches, p = 3/4 for randomised lattices in the plane, where the integrand jumps. From the
error e at the size n, the tolerance r is met at the size

    n' = n (e / r)^(1 / p)

(`StepRule`). The size grows in rounds, and the error is looked at between rounds alone (`StoppingRule`): an
estimate that is examined after every batch stops too early too often, at the moment when its error happens to
be underestimated (Glynn and Whitt 1992, Ann. Appl. Probab. 2, 180).

There are two drivers with the same two rules: `sample_until` runs on the host, where rounds may be reported,
limited in time, and interrupted; `sample_until_compiled` is a loop within a compiled program.
"""

import abc
import dataclasses
import enum
import math
import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from jaxlidar.sampling.errors import floating, namespace_of, student_widening
from jaxlidar.sampling.moments import RunningMoments

Estimate = TypeVar("Estimate")


class StopReason(enum.Enum):
    """Reason why sampling ended, in words. Those of one shot and of a survey are the same."""

    NOTHING_RANDOM = "nothing is random"
    TOLERANCE_MET = "tolerance met"
    BATCHES_SPENT = "batches spent"
    TIME_SPENT = "time spent"
    INTERRUPTED = "interrupted"


@runtime_checkable
class HasErrors(Protocol):
    """Errors of an estimate: the `relative` one, and the `largest` standard error of any of its values."""

    @property
    def relative(self) -> Any: ...

    @property
    def largest(self) -> Any: ...


class EstimateErrors(NamedTuple):
    """Errors of an estimate; the largest standard error is needed for an `atol` alone."""

    relative: Any
    largest: Any = math.inf


@dataclasses.dataclass(frozen=True)
class StepRule:
    """Size of an estimate after the next round.

    - `convergence_rate`: p, the power of the size with which the error falls.
    - `safety`: factor on the predicted size, since the present error is itself an estimate.
    - `min_growth`, `max_growth`: bounds of the next size over the present one. Few batches know their error
      badly.
    - `min_step`: least increase of the size. - `multiple`: sizes are multiples of this, to keep all cores
      busy.
    - `widened`: True where the size is a number of batches whose standard error is widened by Student's t. It
      then falls faster than n^-p, as the factor falls, too.
    """

    convergence_rate: float = 0.5
    safety: float = 1.0
    min_growth: float = 1.0
    max_growth: float = 4.0
    min_step: int = 1
    multiple: int = 1
    widened: bool = False

    def next_size(self, size: Any, error: Any, tolerance: Any) -> Any:
        """Return the size after the next round; on the host, an int.

        `size`: the present one; `error`, `tolerance`: present and largest admissible relative error.
        """
        xp = namespace_of(error)
        size = floating(size)
        growth = (error / tolerance) ** (1.0 / self.convergence_rate)
        if self.widened:
            predicted = xp.ceil(size * xp.maximum(growth, 1.0))
            widening_ratio = student_widening(predicted) / student_widening(size)
            growth *= widening_ratio ** (1.0 / self.convergence_rate)
        growth = xp.clip(self.safety * growth, self.min_growth, self.max_growth)
        rounded = self.multiple * xp.ceil(size * growth / self.multiple)
        following = xp.maximum(rounded, size + self.min_step)
        return int(following) if xp is np else following.astype(jnp.int32)

    def largest_size(self, size: int) -> int:
        """Return the size after a step of the largest growth."""
        return int(self.max_growth * size)


# For batches that all cores of the host share out among themselves: a round that is no multiple of the number
# of cores leaves some of them idle at its end.
BATCH_STEPS = StepRule(safety=1.05, max_growth=4.0, min_step=4, multiple=4, widened=True)


@dataclasses.dataclass(frozen=True)
class StoppingRule:
    """Limits of adaptive sampling.

    - `rtol`: relative error to reach; None: go to `max_size`, whatever the error.
    - `atol`: stop also when the largest standard error is at most this.
    - `min_size`: size after the first round. - `max_size`: largest size; None: no limit. A tolerance that is
      out of reach ends there.
    """

    rtol: Any
    atol: float = 0.0
    min_size: int = 1
    max_size: int | None = None

    def exceeds(self, errors: HasErrors) -> Any:
        """Return True where the errors are above both tolerances."""
        return (errors.relative > self.rtol) & (errors.largest > self.atol)

    def can_grow(self, size: Any) -> Any:
        """Return True where the size is below the largest one."""
        return True if self.max_size is None else size < self.max_size

    def limited(self, size: Any) -> Any:
        """Return a size, at most the largest one."""
        return size if self.max_size is None else namespace_of(size).minimum(size, self.max_size)


class AbstractEstimate(abc.ABC):
    """An estimate on the host that batches refine."""

    @property
    @abc.abstractmethod
    def n_batches(self) -> int:
        """Number of batches so far."""

    @abc.abstractmethod
    def add_batches(self, numbers: range) -> None:
        """Trace the batches with these numbers, and add them to the estimate."""

    @abc.abstractmethod
    def errors(self) -> HasErrors:
        """Return the errors of the estimate so far."""


class MeanEstimate(AbstractEstimate):
    """The mean of a tree of arrays over batches, with its standard errors.

    - `moments`: of the batches so far; None before the first.
    """

    def __init__(self, trace: Callable[[range], Iterable[Any]]):
        """`trace`: traces the batches with the given numbers."""
        self.trace = trace
        self.moments: Any = None

    @property
    def n_batches(self) -> int:
        """Number of batches."""
        return 0 if self.moments is None else self.moments.count

    def add_batches(self, numbers: range) -> None:
        """Trace batches and add them."""
        for batch in self.trace(numbers):
            moments = RunningMoments.on_host(batch) if self.moments is None else self.moments
            self.moments = moments.update(batch)

    def errors(self) -> EstimateErrors:
        """Return the largest standard error, of quantities whose scale is one."""
        stderr = jax.tree.leaves(self.moments.stderr)
        return EstimateErrors(max(float(np.max(a, initial=0.0)) for a in stderr))


def sample_until(
    estimate: AbstractEstimate,
    stop: StoppingRule,
    step: StepRule,
    *,
    max_seconds: float = math.inf,
    start_time: float | None = None,
    report: Callable[[HasErrors], None] | None = None,
    keeps_interrupted: bool = False,
) -> tuple[StopReason, HasErrors]:
    """Add batches to an estimate, round after round, until a limit is reached.

    Each round ends with: (1) the errors of all batches so far; (2) the report; (3) the limits, in the order
    of the tolerance, the number of batches, and the time; (4) the size of the next round.

    **Arguments:**

    - `estimate`: refined in place.
    - `stop`, `step`: the rules.
    - `max_seconds`: stop after this time since `start_time` (of `time.perf_counter`; None: now). One round is
      made.
    - `report`: a function that takes the errors after every round.
    - `keeps_interrupted`: True ends at a KeyboardInterrupt if the fewest batches are done, in place of
      raising it.

    **Returns:** the reason why it ended, and the errors of all batches.
    """
    sampling_start = time.perf_counter()
    start_time = sampling_start if start_time is None else start_time
    target = stop.min_size
    try:
        while True:
            estimate.add_batches(range(estimate.n_batches, target))
            batches, elapsed = estimate.n_batches, time.perf_counter() - start_time
            errors = estimate.errors()
            if report is not None:
                report(errors)
            if stop.rtol is not None and not stop.exceeds(errors):
                return StopReason.TOLERANCE_MET, errors
            if not stop.can_grow(batches):
                return StopReason.BATCHES_SPENT, errors
            if elapsed >= max_seconds:
                return StopReason.TIME_SPENT, errors
            if stop.rtol is None:
                target = step.largest_size(batches)
            else:
                target = step.next_size(batches, errors.relative, stop.rtol)
            target = int(stop.limited(target))
            if math.isfinite(max_seconds):
                # At the rate so far, compilation included: the first rounds err on the short side.
                rate = batches / max(time.perf_counter() - sampling_start, 1e-9)
                in_time = batches + int(rate * (max_seconds - elapsed))
                target = max(min(target, in_time), batches + 1)
    except KeyboardInterrupt:
        if not keeps_interrupted or estimate.n_batches < stop.min_size:
            raise
        # The round that was interrupted has added some of its batches.
        return StopReason.INTERRUPTED, estimate.errors()


def sample_until_compiled(
    refine: Callable[[Estimate, jax.Array, jax.Array], Estimate],
    empty: Estimate,
    relative_error: Callable[[Estimate], jax.Array],
    stop: StoppingRule,
    step: StepRule,
) -> Estimate:
    """Refine an estimate until a tolerance or the largest size is reached, within a compiled program.

    **Arguments:**

    - `refine`: takes an estimate, its size, and its next size; returns the estimate of that size.
    - `empty`: the estimate of size zero, a tree of arrays.
    - `relative_error`: returns the relative error of an estimate.
    - `stop`, `step`: the rules.
    """

    # Before the first round the error says nothing (0 or NaN, which is not above any tolerance): the size
    # decides.
    def continues(state: tuple[jax.Array, Estimate]) -> jax.Array:
        size, estimate = state
        exceeds = stop.exceeds(EstimateErrors(relative_error(estimate)))
        return (size < stop.min_size) | (exceeds & stop.can_grow(size))

    def next_round(state: tuple[jax.Array, Estimate]) -> tuple[jax.Array, Estimate]:
        size, estimate = state
        following = stop.limited(step.next_size(size, relative_error(estimate), stop.rtol))
        # Both branches of `where` are computed; the first round has no error to predict from.
        following = jnp.where(size < stop.min_size, stop.min_size, following)
        return following, refine(estimate, size, following)

    return jax.lax.while_loop(continues, next_round, (jnp.zeros((), jnp.int32), empty))[1]
