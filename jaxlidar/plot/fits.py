"""Figures of fits and their residuals against height."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import ArrayLike
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from jaxlidar._fields.checks import as_numpy, check_number
from jaxlidar.plot.style import (
    TOTAL_COLOUR,
    add_wavelength_bar,
    check_waveform,
    limit_height,
    make_axes,
    wavelength_bar_width,
    wavelength_colours,
    wavelength_rows,
    write_note,
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
    - `observed`: (wavelengths, bins) apparent reflectance at the waveform's samples; NaN is left blank.
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
    wavelengths = [float(wave.wavelength[i]) for i in rows]
    ax = make_axes(ax, (2.2 + wavelength_bar_width(wavelengths), 4.2))
    height = np.asarray(wave.height)
    residual = (data - np.asarray(wave.reflectance)) / sigma
    for half_width, opacity in ((2.0, 0.12), (1.0, 0.15)):
        ax.axvspan(-half_width, half_width, color=TOTAL_COLOUR, alpha=opacity, linewidth=0)
    ax.axvline(0.0, color=TOTAL_COLOUR, linewidth=0.6)
    for i, colour in zip(rows, wavelength_colours(wavelengths)):
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
    if np.isnan(residual[rows]).all():
        write_note(ax, "no values")
    limit_height(ax, height, np.fmax(np.asarray(wave.reflectance), data)[rows])
    ax.set_xlim(-limit, limit)
    ax.set_xlabel("residual\n(standard deviations)")
    if "color" in style or not add_wavelength_bar(ax, wavelengths):
        _add_legend(ax, markerscale=3, ncols=2)
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
    check_waveform(wave)
    rows, height = wavelength_rows(wave, wavelength), np.asarray(wave.height)
    wavelengths = [float(wave.wavelength[i]) for i in rows]
    if axes is None:
        from matplotlib import pyplot

        size = (6.0 + wavelength_bar_width(wavelengths), 4.2)
        axes = pyplot.subplots(1, 2, figsize=size, sharey=True, layout="constrained")[1]
    assert axes is not None
    if len(axes) != 2:
        raise ValueError(f"axes has {len(axes)} axes; admissible are 2")
    waveform_axes, residual_axes = axes
    residuals(wave, observed, noise, residual_axes, wavelength=wavelength, limit=limit)
    residual_axes.set_ylabel("")
    data, model = as_numpy(observed, "observed"), np.asarray(wave.reflectance)
    looks: dict[str, dict[str, Any]] = {
        "observed": {"marker": "o", "markersize": 2.5, "linestyle": "none", "markerfacecolor": "none"},
        # Of a single sample there is no line.
        "fitted": {"linewidth": 1.0, "marker": "x" if height.size == 1 else ""},
    }
    for i, colour in zip(rows, wavelength_colours(wavelengths)):
        for (name, look), values in zip(looks.items(), (data[i], model[i])):
            waveform_axes.plot(values, height, color=colour, label=name, **look)
    limit_height(waveform_axes, height, np.fmax(model, data)[rows])
    waveform_axes.set_xlabel("apparent reflectance\nper sample")
    waveform_axes.ticklabel_format(axis="x", style="sci", scilimits=(-2, 3), useMathText=True)
    # The residuals name the colours of wavelengths.
    handles = [Line2D([], [], color=TOTAL_COLOUR, label=name, **look) for name, look in looks.items()]
    _add_legend(waveform_axes, handles=handles)
    return axes


def _add_legend(ax: Axes, **options: Any) -> None:
    """Add a legend above the axes, if they have anything to name."""
    if "handles" in options or ax.get_legend_handles_labels()[0]:
        ax.legend(frameon=False, fontsize="small", loc="lower center", bbox_to_anchor=(0.5, 1.0), **options)
