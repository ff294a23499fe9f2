"""Noise level and pedestal of recorded waveforms, which readers of several formats need."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Samples at the beginning of a return, and of an outgoing pulse, that hold noise alone.
QUIET_SAMPLES, QUIET_PULSE_SAMPLES = 8, 5
# Standard deviation of normal numbers over their median absolute deviation, 1 / Phi^-1(3/4).
STD_PER_MAD = 1.4826
# A pulse whose largest sample exceeds the pedestal by less than this fraction, or by less counts, is none.
_MIN_RELATIVE_PEAK = 1e-6


class NoiseLevels(NamedTuple):
    """Mean and standard deviation of the noise before returns, and the mean before outgoing pulses."""

    noise_mean: float
    noise_std: float
    pedestal: float


def estimate_noise_levels(shots: Iterable[tuple[np.ndarray | None, np.ndarray]]) -> NoiseLevels:
    """Estimate the levels of shots, each given by the values of its outgoing pulse, if any, and its return.

    They are medians, over the shots, of the means of the first samples. The standard deviation follows from
    the median absolute deviation of all these samples: a few shots that begin within a return do not count.
    """
    quiet, pedestals = [], []
    for outgoing, returning in shots:
        quiet.append(returning[:QUIET_SAMPLES])
        if outgoing is not None:
            pedestals.append(outgoing[:QUIET_PULSE_SAMPLES].mean())
    mean = float(np.median([values.mean() for values in quiet])) if quiet else 0.0
    deviation = np.abs(np.concatenate(quiet) - mean) if quiet else np.zeros(1)
    pedestal = float(np.median(pedestals)) if pedestals else 0.0
    return NoiseLevels(mean, float(STD_PER_MAD * np.median(deviation)), pedestal)


def above_pedestal(
    samples: Float[np.ndarray, " samples"], pedestal: float, location: str
) -> Float[np.ndarray, " samples"]:
    """Return the pulse above its pedestal, from where it leaves zero to where it first returns to zero.

    All other samples are zero: noise cut off at zero would add energy that was never sent.

    **Raises:** ValueError naming `location` where no sample lies above the pedestal.
    """
    power = samples - pedestal
    peak = int(np.argmax(power))
    if power[peak] <= _MIN_RELATIVE_PEAK * max(1.0, float(np.abs(samples).max())):
        raise ValueError(
            f"{location}: a pulse without energy: no sample lies above the pedestal, {pedestal:g} counts"
        )
    before, after = (np.flatnonzero(side <= 0) for side in (power[:peak], power[peak:]))
    start = before[-1] + 1 if before.size else 0
    end = peak + after[0] if after.size else power.size
    pulse = np.zeros_like(power)
    pulse[start:end] = np.maximum(power[start:end], 0.0)
    return pulse
