"""Figures of fits and their residuals against height."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import ArrayLike
from matplotlib.axes import Axes

from jaxlidar.plot.style import TOTAL, WAVELENGTH_COLOURS, axes_or_new, frame_height, wavelengths_of
from jaxlidar.spectral.waveform import Waveform


def residuals(
    wave: Waveform,
    observed: ArrayLike,
    noise: ArrayLike,
    ax: Axes | None = None,
    *,
    wavelength: float | None = None,
    limit: float = 5.0,
    **style: Any,
) -> Axes:
    """Axes with (observed - simulated) / noise against height, over bands of one and two standard deviations.

    **Arguments:**

    - `wave`: the simulated `Waveform`, such as that of a fit.
    - `observed`: (wavelengths, bins) apparent reflectance at the waveform's samples.
    - `noise`: its standard deviation, a number or of the same shape, positive.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `wavelength`: in nm, one of the waveform's. Default None: all.
    - `limit`: where the axis ends, in standard deviations, positive; points beyond are drawn at the end as
      arrowheads. Default 5.
    - `style`: of the points, as for `Axes.plot`.

    **Returns:** the axes.

    **Raises:** ValueError for shapes that differ, noise or a limit that is not positive, and a wavelength
    that the waveform does not have.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    >>> ax = jaxlidar.plot.residuals(wave, 1.01 * wave.reflectance, 0.001, Figure().subplots())
    >>> print(f"up to {ax.get_xlim()[1]:.1f} standard deviations")
    up to 5.0 standard deviations
    """
    data, spread = np.asarray(observed, dtype=float), np.asarray(noise, dtype=float)
    shape = np.asarray(wave.reflectance).shape
    if data.shape != shape:
        raise ValueError(f"observed has shape {data.shape}; admissible is the waveform's, {shape}")
    if spread.ndim and spread.shape != shape:
        raise ValueError(f"noise has shape {spread.shape}; admissible is a number or the waveform's {shape}")
    if not np.all(spread > 0):
        raise ValueError(f"noise = {np.min(spread):g} is outside the admissible range (0, inf)")
    if not limit > 0:
        raise ValueError(f"limit = {limit:g} is outside the admissible range (0, inf)")
    chosen = wavelengths_of(wave, wavelength)
    ax = axes_or_new(ax, (2.2, 4.2))
    height = np.asarray(wave.height)
    score = (data - np.asarray(wave.reflectance)) / spread
    for width, strength in ((2.0, 0.12), (1.0, 0.15)):
        ax.axvspan(-width, width, color=TOTAL, alpha=strength, linewidth=0)
    ax.axvline(0.0, color=TOTAL, linewidth=0.6)
    for number, i in enumerate(chosen):
        colour = TOTAL if len(chosen) == 1 else WAVELENGTH_COLOURS[number % len(WAVELENGTH_COLOURS)]
        look = {"color": colour, "marker": "o", "markersize": 2.0, "linestyle": "none", **style}
        if len(chosen) > 1:
            look.setdefault("label", f"{float(wave.wavelength[i]):g} nm")
        inside = np.abs(score[i]) <= limit
        ax.plot(score[i][inside], height[inside], **look)
        for side, marker in ((-1, "<"), (1, ">")):
            beyond = side * score[i] > limit
            ax.plot(
                np.full(beyond.sum(), 0.97 * side * limit),
                height[beyond],
                **{**look, "marker": marker, "label": "_"},
            )
    frame_height(ax, height, np.maximum(np.asarray(wave.reflectance), data)[chosen])
    ax.set_xlim(-limit, limit)
    ax.set_xlabel("residual\n(standard deviations)")
    if len(chosen) > 1:
        ax.legend(
            loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False, fontsize="small", markerscale=3
        )
    return ax


def fit(
    wave: Waveform,
    observed: ArrayLike,
    noise: ArrayLike,
    axes: Sequence[Axes] | None = None,
    *,
    wavelength: float | None = None,
    limit: float = 5.0,
) -> Sequence[Axes]:
    """Two axes with a fit: observed samples over the fitted waveform, and beside them the residuals.

    **Arguments:**

    - `wave`: the fitted `Waveform`.
    - `observed`: (wavelengths, bins) apparent reflectance at the waveform's samples.
    - `noise`: its standard deviation, a number or of the same shape, positive.
    - `axes`: two axes to draw on. Default None: those of a new figure.
    - `wavelength`: in nm, one of the waveform's. Default None: all.
    - `limit`: where the axis of the residuals ends, in standard deviations, positive. Default 5.

    **Returns:** the two axes.

    **Raises:** ValueError for other than two axes, and what `residuals` raises.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    >>> pair = Figure().subplots(1, 2, sharey=True)
    >>> left, right = jaxlidar.plot.fit(wave, 1.01 * wave.reflectance, 0.001, pair)
    >>> print([text.get_text() for text in left.get_legend().get_texts()])
    ['observed', 'fitted']
    """
    if axes is None:
        from matplotlib import pyplot

        axes = pyplot.subplots(1, 2, figsize=(6.0, 4.2), sharey=True, layout="constrained")[1]
    assert axes is not None
    if len(axes) != 2:
        raise ValueError(f"axes has {len(axes)} axes; admissible are 2")
    left, right = axes
    residuals(wave, observed, noise, right, wavelength=wavelength, limit=limit)
    right.set_ylabel("")
    chosen, height = wavelengths_of(wave, wavelength), np.asarray(wave.height)
    data, model = np.asarray(observed, float), np.asarray(wave.reflectance)
    for number, i in enumerate(chosen):
        several = len(chosen) > 1
        colour = WAVELENGTH_COLOURS[number % len(WAVELENGTH_COLOURS)] if several else TOTAL
        named = f", {float(wave.wavelength[i]):g} nm" if several else ""
        look = {"marker": "o", "markersize": 2.5, "linestyle": "none", "markerfacecolor": "none"}
        left.plot(data[i], height, color=colour, label=f"observed{named}", **look)
        left.plot(model[i], height, color=colour, linewidth=1.0, label=f"fitted{named}")
    frame_height(left, height, np.maximum(model, data)[chosen])
    left.set_xlabel("apparent reflectance\nper sample")
    left.legend(frameon=False, fontsize="small", loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return axes
