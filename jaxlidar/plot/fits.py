"""Figures of fits and their residuals against height."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import ArrayLike
from matplotlib.axes import Axes

from jaxlidar._fields.checks import as_numpy, check_number
from jaxlidar.plot.style import (
    TOTAL_COLOUR,
    WAVELENGTH_COLOURS,
    check_waveform,
    limit_height,
    make_axes,
    wavelength_rows,
)
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
    """Draw (observed - simulated) / noise against height, over bands of one and two standard deviations.

    **Arguments:**

    - `wave`: the simulated `Waveform`, such as that of a fit.
    - `observed`: (wavelengths, bins) apparent reflectance at the waveform's samples.
    - `noise`: its standard deviation, a number or of the same shape, positive.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `wavelength`: in nm, one of the waveform's. Default None: all.
    - `limit`: end of the axis in standard deviations, positive; points beyond are drawn at the end as
      arrowheads. Default 5.
    - `style`: style of the points, as for `Axes.plot`.

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
    check_waveform(wave)
    data, sigma = as_numpy(observed, "observed"), as_numpy(noise, "noise")
    shape = np.asarray(wave.reflectance).shape
    if data.shape != shape:
        raise ValueError(f"observed has shape {data.shape}; admissible is the waveform's, {shape}")
    if sigma.ndim and sigma.shape != shape:
        raise ValueError(f"noise has shape {sigma.shape}; admissible is a number or the waveform's {shape}")
    if not np.all(sigma > 0):
        raise ValueError(f"noise = {np.min(sigma):g} is outside the admissible range (0, inf)")
    check_number("limit", limit, 0.0, low_open=True)
    rows = wavelength_rows(wave, wavelength)
    ax = make_axes(ax, (2.2, 4.2))
    height = np.asarray(wave.height)
    residual = (data - np.asarray(wave.reflectance)) / sigma
    for half_width, opacity in ((2.0, 0.12), (1.0, 0.15)):
        ax.axvspan(-half_width, half_width, color=TOTAL_COLOUR, alpha=opacity, linewidth=0)
    ax.axvline(0.0, color=TOTAL_COLOUR, linewidth=0.6)
    for number, i in enumerate(rows):
        colour = TOTAL_COLOUR if len(rows) == 1 else WAVELENGTH_COLOURS[number % len(WAVELENGTH_COLOURS)]
        points = {"color": colour, "marker": "o", "markersize": 2.0, "linestyle": "none", **style}
        if len(rows) > 1:
            points.setdefault("label", f"{float(wave.wavelength[i]):g} nm")
        inside = np.abs(residual[i]) <= limit
        ax.plot(residual[i][inside], height[inside], **points)
        for side, marker in ((-1, "<"), (1, ">")):
            beyond = side * residual[i] > limit
            # A label that begins with "_" does not appear in the legend.
            ax.plot(
                np.full(beyond.sum(), 0.97 * side * limit),
                height[beyond],
                **{**points, "marker": marker, "label": "_"},
            )
    limit_height(ax, height, np.maximum(np.asarray(wave.reflectance), data)[rows])
    ax.set_xlim(-limit, limit)
    ax.set_xlabel("residual\n(standard deviations)")
    if len(rows) > 1:
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
    """Draw a fit on two axes: observed samples over the fitted waveform, and beside them the residuals.

    **Arguments:**

    - `wave`: the fitted `Waveform`.
    - `observed`: (wavelengths, bins) apparent reflectance at the waveform's samples.
    - `noise`: its standard deviation, a number or of the same shape, positive.
    - `axes`: two axes to draw on. Default None: those of a new figure.
    - `wavelength`: in nm, one of the waveform's. Default None: all.
    - `limit`: end of the axis of the residuals in standard deviations, positive. Default 5.

    **Returns:** the two axes.

    **Raises:** ValueError for another number of axes than two, and as `residuals`.

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
    waveform_axes, residual_axes = axes
    residuals(wave, observed, noise, residual_axes, wavelength=wavelength, limit=limit)
    residual_axes.set_ylabel("")
    rows, height = wavelength_rows(wave, wavelength), np.asarray(wave.height)
    data, model = as_numpy(observed, "observed"), np.asarray(wave.reflectance)
    for number, i in enumerate(rows):
        is_one_of_many = len(rows) > 1
        colour = WAVELENGTH_COLOURS[number % len(WAVELENGTH_COLOURS)] if is_one_of_many else TOTAL_COLOUR
        suffix = f", {float(wave.wavelength[i]):g} nm" if is_one_of_many else ""
        points = {"marker": "o", "markersize": 2.5, "linestyle": "none", "markerfacecolor": "none"}
        waveform_axes.plot(data[i], height, color=colour, label=f"observed{suffix}", **points)
        waveform_axes.plot(model[i], height, color=colour, linewidth=1.0, label=f"fitted{suffix}")
    limit_height(waveform_axes, height, np.maximum(model, data)[rows])
    waveform_axes.set_xlabel("apparent reflectance\nper sample")
    waveform_axes.legend(frameon=False, fontsize="small", loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return axes
