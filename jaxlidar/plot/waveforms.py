"""Figures of waveforms, height upward."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from jaxlidar._checks import check_number
from jaxlidar.plot.style import (
    MATERIAL_COLOURS,
    OTHER_COLOUR,
    TOTAL_COLOUR,
    WAVELENGTH_COLOURS,
    check_waveform,
    limit_height,
    make_axes,
    wavelength_rows,
)
from jaxlidar.spectral.waveform import Waveform


def waveform(
    wave: Waveform,
    ax: Axes | None = None,
    *,
    wavelength: float | None = None,
    quantity: str = "reflectance",
    components: bool = True,
    sigma: float = 2.0,
    label: str | None = None,
    **style: Any,
) -> Axes:
    """Draw a waveform, height upward.

    For one wavelength: the total as a line, the return of each material as an area from zero, and the light
    that was scattered more than once as a dashed line. For several wavelengths: the totals.

    **Arguments:**

    - `wave`: a `Waveform`.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `wavelength`: in nm, one of the waveform's. Default None: all.
    - `quantity`: "reflectance" (apparent reflectance) or "energy" (J; without components). Default
      "reflectance".
    - `components`: True to draw materials and orders, too, of a single wavelength. Default True.
    - `sigma`: half-width of the band around the total, in standard errors, not negative; 0 draws none. Within
      it a band of half the width is drawn more strongly. Default 2.
    - `label`: name of the total in the legend. Default None: "total", or the wavelength.
    - `style`: style of the total's line, as for `Axes.plot`.

    **Returns:** the axes.

    **Raises:** ValueError for a wavelength that the waveform does not have, another quantity, or a negative
    `sigma`.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    >>> ax = jaxlidar.plot.waveform(wave, Figure().subplots())
    >>> print(ax.get_ylabel(), [text.get_text() for text in ax.get_legend().get_texts()])
    height (m) ['ground', 'total']
    """
    if quantity not in ("reflectance", "energy"):
        raise ValueError(f"quantity = {quantity!r} is none of 'reflectance', 'energy'")
    check_waveform(wave)
    check_number("sigma", sigma, 0.0)
    rows = wavelength_rows(wave, wavelength)
    ax = make_axes(ax, (3.5, 4.2))
    height = np.asarray(wave.height)
    total = np.asarray(wave.reflectance if quantity == "reflectance" else wave.energy)
    # The standard error is that of the reflectance; this factor converts it to the quantity drawn.
    conversion = total / np.where(np.asarray(wave.reflectance) > 0, np.asarray(wave.reflectance), np.inf)
    stderr = np.asarray(wave.stderr) * conversion
    is_single = len(rows) == 1
    for number, i in enumerate(rows):
        default_colour = TOTAL_COLOUR if is_single else WAVELENGTH_COLOURS[number % len(WAVELENGTH_COLOURS)]
        colour = style.get("color", default_colour)
        if is_single and components and quantity == "reflectance":
            _draw_components(ax, wave, i)
        for half_width, opacity in ((sigma, 0.15), (0.5 * sigma, 0.2)):
            if np.any(half_width * stderr[i] > 0):
                low, high = total[i] - half_width * stderr[i], total[i] + half_width * stderr[i]
                ax.fill_betweenx(height, low, high, color=colour, alpha=opacity, linewidth=0)
        name = ("total" if is_single else f"{float(wave.wavelength[i]):g} nm") if label is None else label
        ax.plot(total[i], height, **{"color": colour, "linewidth": 1.4, "label": name, **style})
    limit_height(ax, height, total[rows])
    if not np.any(total[rows] < 0):
        ax.set_xlim(left=0.0)
    ax.locator_params(axis="x", nbins=5)
    ax.ticklabel_format(axis="x", style="sci", scilimits=(-2, 3), useMathText=True)
    interval = abs(float(wave.time[1] - wave.time[0])) if wave.time.size > 1 else None
    sample = "sample" if interval is None else f"sample of {interval:.3g} ns"
    ax.set_xlabel(
        f"apparent reflectance\nper {sample}" if quantity == "reflectance" else f"energy per {sample} (J)"
    )
    if is_single:
        ax.set_title(f"{float(wave.wavelength[rows[0]]):g} nm", fontsize="medium")
    ax.legend(frameon=False, fontsize="small")
    return ax


def _draw_components(ax: Axes, wave: Waveform, i: int) -> None:
    """Draw the returns of materials, the strongest one below the others, and of higher orders."""
    height = np.asarray(wave.height)
    names = [n for n in wave.components if n not in ("first", "higher")]
    peaks = {n: float(np.max(np.asarray(wave.components[n][i]), initial=0.0)) for n in names}
    for name in sorted(names, key=lambda n: -peaks[n]):
        if peaks[name] > 0:
            component = np.asarray(wave.components[name][i])
            # Several plates are called "plate 1", "plate 2".
            colour = MATERIAL_COLOURS.get(name.split()[0], OTHER_COLOUR)
            ax.fill_betweenx(height, 0.0, component, color=colour, alpha=0.45, linewidth=0, label=name)
            ax.plot(component, height, color=colour, linewidth=0.8)
    higher = np.asarray(wave.components["higher"][i])
    if np.any(higher > 0):
        ax.plot(
            higher,
            height,
            color=TOTAL_COLOUR,
            linewidth=1.0,
            linestyle=(0, (4, 2)),
            label="scattered twice\nor more",
        )
