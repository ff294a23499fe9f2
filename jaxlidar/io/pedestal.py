"""Removal of the pedestal, which the readers of recorded waveforms share."""

import numpy as np
from jaxtyping import Float


def above_pedestal(samples: Float[np.ndarray, " samples"], pedestal: float) -> Float[np.ndarray, " samples"]:
    """The pulse above its pedestal, from where it leaves zero to where it first returns to zero.

    Outside, noise cut off at zero would add energy that was never sent.
    """
    power = samples - pedestal
    peak = int(np.argmax(power))
    low = (np.flatnonzero(power[:peak] <= 0)[-1:] + 1).sum()
    after = np.flatnonzero(power[peak:] <= 0)
    high = peak + int(after[0]) if after.size else power.size
    pulse = np.zeros_like(power)
    pulse[low:high] = np.maximum(power[low:high], 0.0)
    return pulse
