"""Figures of waveforms, height upward."""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from jaxlidar._fields.checks import (
    check_choice,
    check_kind,
    check_number,
    check_numbers,
    check_range,
    checked_array,
)
from jaxlidar.plot.style import (
    BEAM_COLOUR,
    OTHER_COLOUR,
    TOTAL_COLOUR,
    VISIBLE_FRACTION,
    add_wavelength_bar,
    check_waveform,
    limit_height,
    make_axes,
    material_colours,
    point_marker,
    wavelength_bar_width,
    wavelength_colours,
    wavelength_rows,
)
from jaxlidar.spectral.waveform import Waveform
from jaxlidar.survey.waveforms import Waveforms

# Components that are no materials.
_ORDERS = ("first", "higher")
# Shots over which a waterfall is legible; more need `shots`.
_MAX_STACKED = 400


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
    that was scattered more than once as a dashed line. For several wavelengths: the totals; those of more
    than six are coloured by their wavelength, with a colour bar in place of the legend.

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
    wavelengths = [float(wave.wavelength[i]) for i in rows]
    ax = make_axes(ax, (3.5 + wavelength_bar_width(wavelengths), 4.2))
    height = np.asarray(wave.height)
    total = np.asarray(wave.reflectance if quantity == "reflectance" else wave.energy)
    # The standard error is that of the reflectance; this factor converts it to the quantity drawn.
    conversion = total / np.where(np.asarray(wave.reflectance) > 0, np.asarray(wave.reflectance), np.inf)
    stderr = np.asarray(wave.stderr) * conversion
    is_single = len(rows) == 1
    marker = point_marker(height.size)
    for i, default_colour in zip(rows, wavelength_colours(wavelengths)):
        colour = style.get("color", default_colour)
        if is_single and components and quantity == "reflectance":
            _draw_components(ax, wave, i)
        for half_width, opacity in ((sigma, 0.15), (0.5 * sigma, 0.2)):
            if np.any(half_width * stderr[i] > 0):
                low, high = total[i] - half_width * stderr[i], total[i] + half_width * stderr[i]
                ax.fill_betweenx(height, low, high, color=colour, alpha=opacity, linewidth=0)
        name = ("total" if is_single else f"{float(wave.wavelength[i]):g} nm") if label is None else label
        ax.plot(total[i], height, **{"color": colour, "linewidth": 1.4, "label": name, **marker, **style})
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
    if "color" in style or label is not None or not add_wavelength_bar(ax, wavelengths):
        ax.legend(frameon=False, fontsize="small")
    return ax


def _draw_components(ax: Axes, wave: Waveform, i: int) -> None:
    """Draw the returns of materials, the strongest one below the others, and of higher orders."""
    height = np.asarray(wave.height)
    marker = point_marker(height.size)
    names = [n for n in wave.components if n not in _ORDERS]
    peaks = {n: float(np.max(np.asarray(wave.components[n][i]), initial=0.0)) for n in names}
    colours = material_colours(names)
    for name in sorted(names, key=lambda n: -peaks[n]):
        if peaks[name] > 0:
            component = np.asarray(wave.components[name][i])
            colour = colours[name]
            ax.fill_betweenx(height, 0.0, component, color=colour, alpha=0.45, linewidth=0, label=name)
            ax.plot(component, height, color=colour, linewidth=0.8, **marker)
    higher = np.asarray(wave.components["higher"][i])
    if np.any(higher > 0):
        ax.plot(
            higher,
            height,
            color=TOTAL_COLOUR,
            linewidth=1.0,
            linestyle=(0, (4, 2)),
            label="scattered twice\nor more",
            **marker,
        )


def waterfall(
    waves: Waveforms,
    ax: Axes | None = None,
    *,
    shots: ArrayLike | Any | None = None,
    distance: ArrayLike | Any | None = None,
    wavelength: float | None = None,
    quantity: str = "reflectance",
    overlap: float = 1.5,
    legend: bool = True,
) -> Axes:
    """Draw the waveforms of shots along a track as a stack, each at its distance, height upward.

    Each waveform is drawn from its place on the track to the right: the total as a line, and the returns of
    materials as areas. All have one scale: the largest sample of all reaches over `overlap` times the median
    distance of neighbouring shots. The true height of the ground is a dashed line.

    **Arguments:**

    - `waves`: the `Waveforms` of a survey.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `shots`: numbers of the shots to draw, or a slice, at most 400. Default None: all.
    - `distance`: (shots,) m along the track of the shots that are drawn. Default None: that of where their
      beams meet the ground, or of the places of the shots without ground, along the line from the first to
      the last one.
    - `wavelength`: in nm, one of the waveforms'. Default None: the first.
    - `quantity`: "reflectance" (apparent reflectance), "energy" or "recorded" (J; without materials). Default
      "reflectance".
    - `overlap`: positive; see above. Default 1.5.
    - `legend`: True to add a legend. Default True.

    **Returns:** the axes.

    **Raises:** ValueError for no shot or more than 400, for numbers that are no shots, for distances of
    another shape, and as `waveform`; TypeError for objects of the wrong type.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> survey = jl.Survey.track(jl.Lidar(), start=(0, 0), end=(40, 0), spacing=10.0)
    >>> many = jl.simulate_many(survey, jl.Scene(ground=jl.Ground(slope=5.0)), key=jax.random.key(0))
    >>> ax = jaxlidar.plot.waterfall(many, Figure().subplots())
    >>> print(ax.get_xlabel(), len(ax.collections))
    distance along the track (m) 5
    """
    check_kind("waves", waves, Waveforms, "the Waveforms of a survey")
    check_choice("quantity", quantity, ("reflectance", "energy", "recorded"))
    check_number("overlap", overlap, 0.0, low_open=True)
    rows = _chosen_shots(waves, shots)
    w = 0 if wavelength is None else wavelength_rows(waves, wavelength)[0]
    if distance is None:
        places = _distance_along_track(waves, rows)
    else:
        places = checked_array("distance", distance, rows.shape)
    power = np.asarray(getattr(waves, quantity)[rows, w], float)
    largest = float(power.max())
    gaps = np.diff(np.sort(places))
    spacing = float(np.median(gaps[gaps > 0])) if np.any(gaps > 0) else 1.0
    scale = overlap * spacing / (largest if largest > 0 else 1.0)
    ax = make_axes(ax, (7.4, 3.6))
    components = {}
    if quantity == "reflectance":
        stored = {n: np.asarray(a[rows, w], float) for n, a in waves.components.items() if n not in _ORDERS}
        components = dict(sorted(stored.items(), key=lambda item: -float(item[1].max())))
    lowest, highest = np.inf, -np.inf
    drawn_materials: dict[str, str] = {}
    colours = material_colours(components)
    # From the right: each waveform may reach over its neighbour to the right, and is drawn in front of it.
    for i in np.argsort(-places, kind="stable"):
        height = waves.height_of_shot(int(rows[i]))
        (visible,) = np.nonzero(np.abs(power[i]) > VISIBLE_FRACTION * max(largest, 1e-300))
        if visible.size == 0:
            continue
        shown = slice(max(visible[0] - 1, 0), visible[-1] + 2)
        areas = {n: (colours[n], a[i, shown]) for n, a in components.items() if np.any(a[i, shown])}
        for colour, values in areas.values() or [(OTHER_COLOUR, power[i, shown])]:
            edge = places[i] + scale * values
            ax.fill_betweenx(height[shown], places[i], edge, color=colour, alpha=0.6, linewidth=0)
        marker = point_marker(height.size)
        edge = places[i] + scale * power[i, shown]
        ax.plot(edge, height[shown], color=TOTAL_COLOUR, linewidth=0.5, **marker)
        drawn_materials |= {n: colour for n, (colour, _) in areas.items()}
        lowest, highest = min(lowest, height[shown].min()), max(highest, height[shown].max())
    ground = np.asarray(waves.ground_height, float)[rows]
    if np.isfinite(ground).any():
        order = np.argsort(places, kind="stable")
        look = {"color": BEAM_COLOUR, "linewidth": 1.0, "linestyle": (0, (4, 2)), "label": "true ground"}
        ax.plot(places[order], ground[order], **look)
        lowest, highest = min(lowest, np.nanmin(ground)), max(highest, np.nanmax(ground))
    if legend:
        entries = [*ax.get_legend_handles_labels()[0]]
        entries += [Patch(color=colour, alpha=0.6, label=name) for name, colour in drawn_materials.items()]
        # Beside the axes: within them it would cover waveforms.
        ax.legend(
            handles=entries, frameon=False, fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0)
        )
    if np.isfinite(lowest):
        margin = max(0.04 * (highest - lowest), 0.5)
        ax.set_ylim(lowest - margin, highest + margin)
    ax.set_xlim(places.min() - 0.5 * spacing, places.max() + (overlap + 0.2) * spacing)
    ax.set_xlabel("distance along the track (m)")
    ax.set_ylabel("height (m)")
    unit = "apparent reflectance per sample" if quantity == "reflectance" else "J per sample"
    ax.set_title(f"{float(waves.wavelength[w]):g} nm, largest {largest:.2g} {unit}", fontsize="medium")
    return ax


def _chosen_shots(waves: Waveforms, shots: Any) -> np.ndarray:
    """Return the numbers of the shots to draw. **Raises:** ValueError."""
    count = len(waves)
    if shots is None or isinstance(shots, slice):
        rows = np.arange(count)[shots if isinstance(shots, slice) else slice(None)]
    else:
        check_numbers("shots", shots)
        rows = np.atleast_1d(np.asarray(shots))
        if rows.ndim != 1 or not np.issubdtype(rows.dtype, np.integer):
            raise ValueError("shots are no row of whole numbers; admissible are numbers of shots, or a slice")
        check_range("shots", rows, -count, count - 1)
    if not 0 < rows.size <= _MAX_STACKED:
        raise ValueError(
            f"shots has {rows.size} shots; admissible are 1 to {_MAX_STACKED}, as in shots=slice(0, 100)"
        )
    return rows % count


def _distance_along_track(waves: Waveforms, rows: np.ndarray) -> Float[np.ndarray, " shots"]:
    """Return the distances of shots along the line from the first to the last one, m."""
    places = np.asarray(waves.ground_position, float)[rows, :2]
    if not np.isfinite(places).all():
        places = np.asarray(waves.position, float)[rows, :2]
    line = places[-1] - places[0]
    length = float(np.linalg.norm(line))
    # Shots at one place have no track: they are drawn side by side.
    return (places - places[0]) @ line / length if length > 0 else np.arange(len(rows), dtype=float)
