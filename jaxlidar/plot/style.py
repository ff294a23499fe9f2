"""What figures share: colours, axes, and limits around what is visible.

Colours are those of Okabe and Ito (2008), which can be told apart with any colour vision.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from jaxlidar.spectral.waveform import Waveform

COLOURS = {"leaf": "#009E73", "bark": "#8C510A", "ground": "#E69F00", "plate": "#56B4E9"}
OTHER = "#999999"
TOTAL = "#1A1A1A"
BEAM = "#D55E00"
WAVELENGTH_COLOURS = ("#0072B2", "#D55E00", "#CC79A7", "#009E73", "#E69F00", "#56B4E9")
# Figures show heights at which the waveform exceeds this share of its peak.
VISIBLE = 0.004


def wavelengths_of(wave: Waveform, wavelength: float | None) -> Sequence[int]:
    """Rows of the waveform at `wavelength` (nm); all rows for None."""
    has = np.asarray(wave.wavelength, dtype=float)
    if wavelength is None:
        return range(has.size)
    near = np.flatnonzero(np.isclose(has, wavelength, rtol=1e-6))
    if near.size == 0:
        listed = ", ".join(f"{w:g}" for w in has)
        raise ValueError(f"wavelength = {wavelength:g} nm is none of the waveform's: {listed}")
    return [int(near[0])]


def frame_height(ax: Axes, height: Float[np.ndarray, " bins"], total: np.ndarray) -> None:
    """Set the limits around what is visible of any of the waveforms, and the name of the axis."""
    peak = np.max(total, axis=-1, keepdims=True)
    seen = height[np.any(total > VISIBLE * np.maximum(peak, 1e-300), axis=0)]
    if seen.size > 1 and np.ptp(seen) > 0:
        margin = 0.03 * np.ptp(seen)
        ax.set_ylim(seen.min() - margin, seen.max() + margin)
    ax.set_ylabel("height (m)")


def axes_or_new(ax: Axes | None, size: tuple[float, float]) -> Axes:
    """`ax`, or those of a new figure of `size` inches."""
    if ax is not None:
        return ax
    from matplotlib import pyplot

    return pyplot.subplots(figsize=size, layout="constrained")[1]
