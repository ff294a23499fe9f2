"""Removal of the pedestal, which the readers of recorded waveforms share."""

import numpy as np
from jaxtyping import Float

# A pulse whose highest sample exceeds the pedestal by less than this part, or by less counts, is none.
_NOTHING = 1e-6


def above_pedestal(
    samples: Float[np.ndarray, " samples"], pedestal: float, place: str
) -> Float[np.ndarray, " samples"]:
    """The pulse above its pedestal, from where it leaves zero to where it first returns to zero.

    Outside, noise cut off at zero would add energy that was never sent.

    **Raises:** ValueError naming `place` where no sample lies above the pedestal.
    """
    power = samples - pedestal
    peak = int(np.argmax(power))
    if power[peak] <= _NOTHING * max(1.0, float(np.abs(samples).max())):
        raise ValueError(
            f"{place}: a pulse without energy: no sample lies above the pedestal, {pedestal:g} counts"
        )
    before, after = (np.flatnonzero(side <= 0) for side in (power[:peak], power[peak:]))
    low = before[-1] + 1 if before.size else 0
    high = peak + after[0] if after.size else power.size
    pulse = np.zeros_like(power)
    pulse[low:high] = np.maximum(power[low:high], 0.0)
    return pulse
