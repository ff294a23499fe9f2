"""Figures: waveforms with height upward, scenes from the side, residuals of a fit.

Every function draws on the `matplotlib.axes.Axes` that it is given, or on a new figure's, and returns it;
nothing is shown and nothing is saved. Import it by name: `import jaxlidar.plot`.

Colours are those of Okabe and Ito (2008), which are told apart whatever one's colour vision.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap

from .lidar import Lidar
from .scene import Ground, Plate, Scene
from .waveform import Waveform

COLOURS = {"leaf": "#009E73", "bark": "#8C510A", "ground": "#E69F00", "plate": "#56B4E9"}
TOTAL = "#1A1A1A"
BEAM = "#D55E00"
WAVELENGTH_COLOURS = ("#0072B2", "#D55E00", "#CC79A7", "#009E73", "#E69F00", "#56B4E9")
# What is drawn lies where the waveform exceeds this share of its peak.
VISIBLE = 0.004


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

    For one wavelength: the total as a line, what comes from each material as an area from zero, and what
    was scattered more than once as a dashed line. For several: the totals.

    **Arguments:**

    - `wave`: a `Waveform`.
    - `ax`: where to draw. Default None: on a new figure.
    - `wavelength`: in nm, one of the waveform's. Default None: all.
    - `quantity`: "reflectance" (default: apparent reflectance) or "energy" (J; without components).
    - `components`: whether materials and orders are drawn too, where there is one wavelength. Default True.
    - `sigma`: half-width of the band round the total, in standard errors; 0 draws none. Default 2. Half as
      wide a band is drawn more strongly within it.
    - `label`: of the total. Default None: "total", or the wavelength.
    - `style`: of the total's line, as for `Axes.plot`.

    **Raises:** ValueError for a wavelength that the waveform does not have, another quantity, or a negative
    `sigma`.
    """
    if quantity not in ("reflectance", "energy"):
        raise ValueError(f"quantity = {quantity!r} is none of 'reflectance', 'energy'")
    if not sigma >= 0:
        raise ValueError(f"sigma = {sigma:g} is outside the admissible range [0, inf)")
    chosen = _chosen(wave, wavelength)
    ax = _axes(ax, (3.5, 4.2))
    height = np.asarray(wave.height)
    total = np.asarray(wave.reflectance if quantity == "reflectance" else wave.energy)
    gain = total / np.where(np.asarray(wave.reflectance) > 0, np.asarray(wave.reflectance), np.inf)
    stderr = np.asarray(wave.stderr) * gain
    alone = len(chosen) == 1
    for number, i in enumerate(chosen):
        colour = style.get("color", TOTAL if alone else WAVELENGTH_COLOURS[number % len(WAVELENGTH_COLOURS)])
        if alone and components and quantity == "reflectance":
            _components(ax, wave, i)
        for width, strength in ((sigma, 0.15), (0.5 * sigma, 0.2)):
            if np.any(width * stderr[i] > 0):
                low, high = total[i] - width * stderr[i], total[i] + width * stderr[i]
                ax.fill_betweenx(height, low, high, color=colour, alpha=strength, linewidth=0)
        name = ("total" if alone else f"{float(wave.wavelength[i]):g} nm") if label is None else label
        ax.plot(total[i], height, **{"color": colour, "linewidth": 1.4, "label": name, **style})
    _frame_height(ax, height, total[chosen])
    if not np.any(total[chosen] < 0):
        ax.set_xlim(left=0.0)
    ax.locator_params(axis="x", nbins=5)
    ax.ticklabel_format(axis="x", style="sci", scilimits=(-2, 3), useMathText=True)
    interval = abs(float(wave.time[1] - wave.time[0])) if wave.time.size > 1 else None
    each = "sample" if interval is None else f"sample of {interval:.3g} ns"
    ax.set_xlabel(
        f"apparent reflectance\nper {each}" if quantity == "reflectance" else f"energy per {each} (J)"
    )
    if alone:
        ax.set_title(f"{float(wave.wavelength[chosen[0]]):g} nm", fontsize="medium")
    ax.legend(frameon=False, fontsize="small")
    return ax


def _components(ax: Axes, wave: Waveform, i: int) -> None:
    height = np.asarray(wave.height)
    names = [n for n in wave.components if n not in ("first", "higher")]
    peaks = {n: float(np.max(np.asarray(wave.components[n][i]), initial=0.0)) for n in names}
    for name in sorted(names, key=lambda n: -peaks[n]):
        if peaks[name] > 0:
            part = np.asarray(wave.components[name][i])
            colour = COLOURS[name.split()[0]]
            ax.fill_betweenx(height, 0.0, part, color=colour, alpha=0.45, linewidth=0, label=name)
            ax.plot(part, height, color=colour, linewidth=0.8)
    higher = np.asarray(wave.components["higher"][i])
    if np.any(higher > 0):
        ax.plot(
            higher,
            height,
            color=TOTAL,
            linewidth=1.0,
            linestyle=(0, (4, 2)),
            label="scattered twice\nor more",
        )


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
    """Draw (observed - simulated)/noise against height, over bands of one and two standard deviations.

    **Arguments:**

    - `wave`: the simulated `Waveform`, such as that of a fit.
    - `observed`: (wavelengths, bins) apparent reflectance at the waveform's samples.
    - `noise`: its standard deviation, a number or of the same shape, positive.
    - `ax`: where to draw. Default None: on a new figure.
    - `wavelength`: in nm, one of the waveform's. Default None: all.
    - `limit`: where the axis ends, in standard deviations, positive; what lies beyond is drawn at the end as
      an arrowhead. Default 5.
    - `style`: of the points, as for `Axes.plot`.

    **Raises:** ValueError for shapes that differ, noise or a limit that is not positive, and a wavelength
    that the waveform does not have.
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
    chosen = _chosen(wave, wavelength)
    ax = _axes(ax, (2.2, 4.2))
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
    _frame_height(ax, height, np.maximum(np.asarray(wave.reflectance), data)[chosen])
    ax.set_xlim(-limit, limit)
    ax.set_xlabel("residual\n(standard deviations)")
    if len(chosen) > 1:
        ax.legend(
            loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False, fontsize="small", markerscale=3
        )
    return ax


def scene(
    scene: Scene,
    lidar: Lidar | None = None,
    ax: Axes | None = None,
    *,
    along: str = "y",
    legend: bool = True,
) -> Axes:
    """Draw a scene from the side: optical depth of leaf and bark, plates, ground and the beam.

    Leaf and bark are shaded by 1 - exp(-optical depth) of a horizontal look through the whole voxel map;
    planes are cut at the middle of the map (or of the footprint, where there is no map).

    **Arguments:**

    - `scene`: a `Scene`.
    - `lidar`: whose beam is drawn, out to 1/e^2 of the axial irradiance or to the top-hat's edge. Default
      None: no beam.
    - `ax`: where to draw. Default None: on a new figure.
    - `along`: "y" (default) looks north, x to the right; "x" looks west, y to the right.
    - `legend`: whether to name what is drawn. Default True.

    **Raises:** ValueError for another `along`.
    """
    if along not in ("x", "y"):
        raise ValueError(f"along = {along!r} is none of 'x', 'y'")
    ax = _axes(ax, (3.5, 4.2))
    across, depth = (0, 1) if along == "y" else (1, 0)
    radius = 0.0 if lidar is None else float(lidar.footprint_radius)
    centre = np.zeros(2) if lidar is None else np.asarray(lidar.position, dtype=float)
    low, high, top = centre[across] - 1.3 * radius, centre[across] + 1.3 * radius, 0.0
    middle = centre[depth]
    entries: list[Any] = []
    if scene.canopy is not None:
        voxels = scene.canopy.voxels
        origin, end = np.asarray(voxels.origin, dtype=float), np.asarray(voxels.top, dtype=float)
        low, high, top = min(low, origin[across]), max(high, end[across]), end[2]
        middle = 0.5 * (origin[depth] + end[depth])
        extent = (origin[across], end[across], origin[2], end[2])
        edge = float(voxels.voxel_size[depth])
        entries += _voxels(ax, voxels.leaf, "leaf", depth, edge, extent)
        entries += _voxels(ax, voxels.bark, "bark", depth, edge, extent)
    if high <= low:
        low, high = centre[across] - 1.0, centre[across] + 1.0
    sides = np.array([low, high])
    levels = [top]
    for surface in scene.surfaces:
        z = _cut(surface, sides, across, middle)
        levels += z.tolist()
        if isinstance(surface, Plate):
            entries += ax.plot(sides, z, color=COLOURS["plate"], linewidth=2.5, label="plate")
    bottom, top = min(levels), max(levels)
    room = max(0.06 * (top - bottom), 0.2)
    if scene.ground is not None:
        z = _cut(scene.ground, sides, across, middle)
        # Deep enough for whoever then widens the limits.
        deep = bottom - 10 * (top - bottom + room)
        look = {"color": COLOURS["ground"], "linewidth": 0, "zorder": 3, "label": "ground"}
        entries.append(ax.fill_between(sides, z, deep, **look))
    if lidar is not None:
        entries += _beam(ax, lidar, across, bottom, top + 10 * room)
    ax.set_xlim(low, high)
    ax.set_ylim(bottom - room, top + room)
    ax.set_aspect("equal")
    ax.set_xlabel("x, east (m)" if along == "y" else "y, north (m)")
    ax.set_ylabel("height (m)")
    if legend and entries:
        named = {entry.get_label(): entry for entry in entries}
        look = {"frameon": False, "fontsize": "small", "ncols": 2, "handlelength": 1.5, "columnspacing": 1.2}
        ax.legend(named.values(), named.keys(), loc="lower center", bbox_to_anchor=(0.5, 1.0), **look)
    return ax


def _voxels(
    ax: Axes, extinction: Any, name: str, depth: int, edge: float, extent: tuple[float, float, float, float]
) -> list[Any]:
    if extinction is None or not np.any(np.asarray(extinction) > 0):
        return []
    opaque = -np.expm1(-np.asarray(extinction, dtype=float).sum(axis=depth) * edge)
    colours = LinearSegmentedColormap.from_list(name, [COLOURS[name] + "00", COLOURS[name]])
    ax.imshow(
        opaque.T, cmap=colours, vmin=0.0, vmax=1.0, origin="lower", extent=extent, interpolation="nearest"
    )
    return ax.plot([], [], "s", color=COLOURS[name], label=name)


def _beam(ax: Axes, lidar: Lidar, across: int, bottom: float, top: float) -> list[Any]:
    """The beam's edges in the plane through its axis."""
    z = np.array([bottom, top])
    zenith, azimuth = np.deg2rad(float(lidar.zenith)), np.deg2rad(float(lidar.azimuth))
    lean = -np.tan(zenith) * (np.sin(azimuth), np.cos(azimuth))[across]
    axis = float(lidar.position[across]) + lean * z
    shrink = 1.0 - z / float(lidar.altitude)
    # The footprint on a horizontal plane is longer along the direction of travel.
    stretch = np.sqrt(1.0 + lean**2)
    half = float(lidar.footprint_radius) * shrink * stretch
    ax.fill_betweenx(z, axis - half, axis + half, color=BEAM, alpha=0.07, linewidth=0)
    name = "beam (1/e²)" if lidar.profile == "gaussian" else "beam"
    look = {"color": BEAM, "linewidth": 1.0, "linestyle": (0, (4, 2)), "label": name}
    return [line for side in (-1, 1) for line in ax.plot(axis + side * half, z, **look)]


def _cut(surface: Ground | Plate, sides: np.ndarray, across: int, middle: float) -> np.ndarray:
    plane = surface.plane
    normal = np.asarray(plane.normal, dtype=float)
    point = np.full((2, 2), middle)
    point[:, across] = sides
    return float(plane.height) - point @ normal[:2] / normal[2]


def _chosen(wave: Waveform, wavelength: float | None) -> Sequence[int]:
    has = np.asarray(wave.wavelength, dtype=float)
    if wavelength is None:
        return range(has.size)
    near = np.flatnonzero(np.isclose(has, wavelength, rtol=1e-6))
    if near.size == 0:
        listed = ", ".join(f"{w:g}" for w in has)
        raise ValueError(f"wavelength = {wavelength:g} nm is none of the waveform's: {listed}")
    return [int(near[0])]


def _frame_height(ax: Axes, height: Float[np.ndarray, " bins"], total: np.ndarray) -> None:
    """Limits round what is visible of any of the waveforms, and the axis' name."""
    peak = np.max(total, axis=-1, keepdims=True)
    seen = height[np.any(total > VISIBLE * np.maximum(peak, 1e-300), axis=0)]
    if seen.size > 1 and np.ptp(seen) > 0:
        margin = 0.03 * np.ptp(seen)
        ax.set_ylim(seen.min() - margin, seen.max() + margin)
    ax.set_ylabel("height (m)")


def _axes(ax: Axes | None, size: tuple[float, float]) -> Axes:
    if ax is not None:
        return ax
    from matplotlib import pyplot

    return pyplot.subplots(figsize=size, layout="constrained")[1]
