"""Adaptive sampling: sizes of rounds, reasons to stop, interrupts; the compiled loop has the same rules."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlidar.sampling.adaptive import (
    BATCH_STEPS,
    AbstractEstimate,
    EstimateErrors,
    StepRule,
    StoppingRule,
    StopReason,
    sample_until,
    sample_until_compiled,
)
from jaxlidar.sampling.errors import student_widening


class Predictable(AbstractEstimate):
    """An estimate whose error is `scale` / sqrt(batches); it notes the size of every round."""

    def __init__(self, scale, interrupted_at=math.inf):
        self.scale, self.interrupted_at = scale, interrupted_at
        self.rounds, self._batches = [], 0

    @property
    def n_batches(self):
        return self._batches

    def add_batches(self, numbers):
        for number in numbers:
            if number == self.interrupted_at:
                raise KeyboardInterrupt
            assert number == self._batches
            self._batches += 1
        self.rounds.append(self._batches)

    def errors(self):
        relative = self.scale / math.sqrt(self._batches)
        return EstimateErrors(relative, 0.1 * relative)


def test_the_tolerance_is_met_after_rounds_that_aim_at_it():
    estimate = Predictable(1.0)
    reason, errors = sample_until(estimate, StoppingRule(0.1, min_size=8), BATCH_STEPS)
    assert reason is StopReason.TOLERANCE_MET
    assert errors.relative <= 0.1
    # At most four times as many; then what 100 batches call for, less what Student's factor is smaller.
    assert estimate.rounds[:2] == [8, 32]
    assert estimate.rounds[-1] in range(100, 108, 4)
    absolute = Predictable(1.0)
    assert sample_until(absolute, StoppingRule(0.1, 0.02, 8), BATCH_STEPS)[0] is StopReason.TOLERANCE_MET
    assert absolute.rounds == [8, 32]


def test_a_fixed_number_of_batches_is_traced_whatever_the_error():
    estimate = Predictable(1e-9)
    reason, _ = sample_until(estimate, StoppingRule(None, min_size=8, max_size=50), BATCH_STEPS)
    assert (reason, estimate.rounds) == (StopReason.BATCHES_SPENT, [8, 32, 50])
    out_of_reach = Predictable(1.0)
    reason, _ = sample_until(out_of_reach, StoppingRule(1e-6, min_size=8, max_size=50), BATCH_STEPS)
    assert (reason, out_of_reach.rounds) == (StopReason.BATCHES_SPENT, [8, 32, 50])


def test_time_and_interrupts_end_it():
    estimate, stop = Predictable(1.0), StoppingRule(1e-6, min_size=8)
    assert sample_until(estimate, stop, BATCH_STEPS, max_seconds=1e-9)[0] is StopReason.TIME_SPENT
    assert estimate.rounds == [8]
    for keeps, batches in ((True, 10), (False, 10), (True, 5)):
        estimate = Predictable(1.0, interrupted_at=batches)
        if keeps and batches >= 8:
            reason, errors = sample_until(estimate, stop, BATCH_STEPS, keeps_interrupted=True)
            assert reason is StopReason.INTERRUPTED
            assert errors.relative == 1.0 / math.sqrt(batches)
        else:
            with pytest.raises(KeyboardInterrupt):
                sample_until(estimate, stop, BATCH_STEPS, keeps_interrupted=keeps)


def test_steps_follow_the_order_of_convergence():
    assert StepRule(convergence_rate=0.5, max_growth=100.0).next_size(10, 0.04, 0.01) == 160
    assert StepRule(convergence_rate=0.75, max_growth=100.0).next_size(1, 0.08, 0.01) == 16
    assert StepRule(convergence_rate=0.75, max_growth=8.0).next_size(1, 0.08, 0.01) == 8
    assert StepRule(max_growth=1.0, min_step=4).next_size(8, 1.0, 0.1) == 12
    # Few batches have a wide Student's factor, which more of them have not.
    plain, widened = (StepRule(max_growth=100.0, widened=w).next_size(8, 0.1, 0.01) for w in (False, True))
    assert plain == 800
    assert widened == math.ceil(800 * (student_widening(800) / student_widening(8)) ** 2)
    compiled = jax.jit(lambda size, error: BATCH_STEPS.next_size(size, error, 0.01))
    for size, error in ((8, 0.0123), (12, 0.3), (100, 0.0101)):
        assert int(compiled(size, error)) == BATCH_STEPS.next_size(size, error, 0.01)


@pytest.mark.parametrize(("rtol", "max_size"), [(0.1, 1024), (1e-6, 50)])
def test_the_compiled_loop_makes_the_same_rounds(rtol, max_size):
    """The estimate notes its sizes."""
    stop = StoppingRule(rtol, min_size=8, max_size=max_size)

    def refine(sizes, size, following):
        return sizes.at[jnp.argmin(sizes)].set(following)

    def relative_error(sizes):
        return 1.0 / jnp.sqrt(jnp.maximum(jnp.max(sizes), 1))

    sizes = jax.jit(
        lambda: sample_until_compiled(refine, jnp.zeros(16, jnp.int32), relative_error, stop, BATCH_STEPS)
    )()
    estimate = Predictable(1.0)
    sample_until(estimate, stop, BATCH_STEPS)
    assert np.trim_zeros(np.asarray(sizes)).tolist() == estimate.rounds
