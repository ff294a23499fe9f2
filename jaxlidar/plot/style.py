"""Common style of the figures: colours, axes, and limits around the visible signal.

Colours are those of Okabe and Ito (2008), which are distinct with any colour vision.
"""

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_hex
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D, proj3d

from jaxlidar._fields.checks import check_kind, check_number
from jaxlidar.planning.channels import unnumbered
from jaxlidar.spectral.waveform import Waveform
from jaxlidar.survey.waveforms import Waveforms

MATERIAL_COLOURS = {
    "leaf": "#009E73",
    "bark": "#8C510A",
    "ground": "#E69F00",
    "plate": "#56B4E9",
    "mesh": "#CC79A7",
}
# Colours of the other materials of meshes.
_MESH_COLOURS = ("#CC79A7", "#D55E00", "#0072B2", "#F0E442", "#56B4E9", "#000000")
OTHER_COLOUR = "#999999"
TOTAL_COLOUR = "#1A1A1A"
BEAM_COLOUR = "#D55E00"
WAVELENGTH_COLOURS = ("#0072B2", "#D55E00", "#CC79A7", "#009E73", "#E69F00", "#56B4E9")
# Least share of the shorter side of a map in the longer one: labels need room.
_MIN_MAP_SHARE = 0.4
# Figures show the heights at which the waveform exceeds this fraction of its peak.
VISIBLE_FRACTION = 0.004


def material_colours(names: Iterable[str]) -> dict[str, str]:
    """Return the colours of materials, by name; several of one name are called "plate 1", "plate 2".

    Materials of a mesh, called "mesh:NAME", are told apart: leaf, wood and bark as in voxels, others in
    alphabetical order.
    """
    others = itertools.cycle(_MESH_COLOURS)
    colours = {}
    for name in sorted(set(names)):
        kind = unnumbered(name).rpartition(":")[2]
        kind = "bark" if kind == "wood" else kind
        if kind in MATERIAL_COLOURS:
            colours[name] = MATERIAL_COLOURS[kind]
        else:
            colours[name] = next(others) if name.startswith("mesh:") else OTHER_COLOUR
    return colours


def check_waveform(wave: Any) -> None:
    """Refuse an object that is not one waveform, such as those of a survey.

    **Raises:** TypeError that says how to draw one.
    """
    if isinstance(wave, Waveforms):
        raise TypeError(
            f"wave is a Waveforms of {len(wave)} shots; admissible is the Waveform of one shot, as in "
            "many[0]; jaxlidar.plot.waterfall draws those of many shots"
        )
    check_kind("wave", wave, Waveform, "a Waveform")
    if wave.has_scenes:
        raise TypeError(f"wave has {len(wave)} scenes; admissible is that of one scene, as in wave[0]")


def wavelength_rows(wave: Waveform | Waveforms, wavelength: float | None) -> Sequence[int]:
    """Return the row of the waveform at `wavelength` (nm), or all rows for None."""
    wavelengths = np.asarray(wave.wavelength, dtype=float)
    if wavelength is None:
        return range(wavelengths.size)
    check_number("wavelength", wavelength)
    # Wavelengths are stored in single precision.
    rows = np.flatnonzero(np.isclose(wavelengths, wavelength, rtol=1e-6))
    if rows.size == 0:
        names = ", ".join(f"{w:g}" for w in wavelengths)
        raise ValueError(f"wavelength = {wavelength:g} nm is none of the waveform's: {names}")
    return [int(rows[0])]


def wavelength_colours(wavelengths: Sequence[float]) -> list[str]:
    """Return a colour for each wavelength: black for one, distinct ones for a few, and a scale for more."""
    if len(wavelengths) == 1:
        return [TOTAL_COLOUR]
    if len(wavelengths) <= len(WAVELENGTH_COLOURS):
        return list(WAVELENGTH_COLOURS[: len(wavelengths)])
    return [to_hex(colour) for colour in _wavelength_scale(wavelengths).to_rgba(np.asarray(wavelengths))]


def wavelength_bar_width(wavelengths: Sequence[float] | np.ndarray) -> float:
    """Return the width in inches that the colour bar of wavelengths takes, zero where there is none."""
    return 0.9 if len(wavelengths) > len(WAVELENGTH_COLOURS) else 0.0


def add_wavelength_bar(ax: Axes, wavelengths: Sequence[float]) -> bool:
    """Add the colour bar of more wavelengths than have distinct colours, and return True if there is one."""
    if not wavelength_bar_width(wavelengths):
        return False
    ax.figure.colorbar(_wavelength_scale(wavelengths), ax=ax, label="wavelength (nm)")
    return True


def _wavelength_scale(wavelengths: Sequence[float]) -> ScalarMappable:
    return ScalarMappable(Normalize(min(wavelengths), max(wavelengths)), "viridis")


def point_marker(count: int) -> dict[str, Any]:
    """Return the style that makes a line of one point visible; none is needed for more points."""
    return {"marker": "o", "markersize": 4.0} if count == 1 else {}


def write_note(ax: Axes, text: str) -> None:
    """Write why axes are empty, in their middle."""
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", va="center", color=TOTAL_COLOUR)


def limit_height(ax: Axes, height: Float[np.ndarray, " bins"], total: np.ndarray) -> None:
    """Set the limits of the height axis around the visible signal of any of the waveforms, and label it."""
    total = np.nan_to_num(total, nan=0.0)
    peak = np.max(total, axis=-1, keepdims=True)
    # The floor keeps a waveform of zeros from counting as visible everywhere.
    visible = height[np.any(total > VISIBLE_FRACTION * np.maximum(peak, 1e-300), axis=0)]
    if visible.size > 1 and np.ptp(visible) > 0:
        margin = 0.03 * np.ptp(visible)
        ax.set_ylim(visible.min() - margin, visible.max() + margin)
    ax.set_ylabel("height (m)")


class _UpperTicks(MaxNLocator):
    """Ticks but for those near the lower end. `prune` of matplotlib leaves them where a tick lies below."""

    def __call__(self) -> np.ndarray:
        assert self.axis is not None
        low, high = sorted(self.axis.get_view_interval())
        ticks = np.asarray(super().__call__())
        return ticks[ticks > low + 0.1 * (high - low)]


def label_map(ax: Axes) -> None:
    """Set equal scales and the labels of a map, which is widened if it is a strip."""
    ax.set_aspect("equal")
    limits = np.array([ax.get_xlim(), ax.get_ylim()])
    least = _MIN_MAP_SHARE * float(np.ptp(limits, axis=1).max())
    for (low, high), axis, locator in zip(limits, "xy", (MaxNLocator, _UpperTicks)):
        is_strip = high - low < least
        if is_strip:
            middle = 0.5 * (low + high)
            ax.set(**{f"{axis}lim": (middle - 0.5 * least, middle + 0.5 * least)})
        # Map coordinates have seven digits: few ticks, none with an offset or an exponent, and none at the
        # lower left, where both axes would have one.
        getattr(ax, f"{axis}axis").set_major_locator(locator(nbins=2 if is_strip else 4))
    ax.ticklabel_format(style="plain", useOffset=False)
    ax.tick_params(axis="y", labelrotation=90)
    ax.set_xlabel("x, east (m)")
    ax.set_ylabel("y, north (m)")


def make_axes(ax: Axes | None, size: tuple[float, float]) -> Axes:
    """Return `ax`, or the axes of a new figure of `size` inches if it is None."""
    if ax is not None:
        return ax
    from matplotlib import pyplot

    return pyplot.subplots(figsize=size, layout="constrained")[1]


def oblique_axes(
    ax: Axes | Axes3D | None,
    low: Float[np.ndarray, "3"],
    high: Float[np.ndarray, "3"],
    elevation: float,
    azimuth: float,
    size: tuple[float, float],
) -> Axes3D:
    """Return three-dimensional axes with equal scales around a box, seen from a direction.

    **Arguments:** `low`, `high`: corners of the box, m. `elevation`, `azimuth`: of the viewer, degrees above
    the horizon and clockwise from north. `size`: of a new figure, inches, if `ax` is None.
    """
    if ax is None:
        from matplotlib import pyplot

        ax = pyplot.figure(figsize=size, layout="constrained").add_subplot(projection="3d")
    check_kind("ax", ax, Axes3D, 'three-dimensional axes, as of add_subplot(projection="3d")')
    assert isinstance(ax, Axes3D)
    # Flat boxes need a height.
    sides = np.maximum(high - low, 1e-3 * max(float(np.max(high - low)), 1.0))
    middle = 0.5 * (low + high)
    for name, centre, side in zip(("xlim", "ylim", "zlim"), middle, sides):
        ax.set(**{name: (centre - 0.5 * side, centre + 0.5 * side)})
    # matplotlib's azimuth is counted from the x axis, counterclockwise.
    ax.view_init(elev=elevation, azim=90.0 - azimuth)
    # A box of any shape fills the axes but for the room of its labels.
    ax.set_box_aspect(sides.tolist(), zoom=1)
    corners = np.array(list(itertools.product(*zip(middle - 0.5 * sides, middle + 0.5 * sides))))
    x, y, z = corners.T
    horizontal, vertical, _ = proj3d.proj_transform(x, y, z, ax.get_proj())
    # In parts of the axes' half width, from their centre: nearer corners lie farther out.
    extent = np.max(np.abs(np.stack([horizontal, vertical]))) / ax.viewLim.xmax
    zoom: Any = 0.72 / extent
    ax.set_box_aspect(sides.tolist(), zoom=zoom)
    ax.set(xlabel="x, east (m)", ylabel="y, north (m)", zlabel="height (m)")
    ax.tick_params(labelsize="x-small")
    for axis, side, largest in zip((ax.xaxis, ax.yaxis, ax.zaxis), sides, high):
        axis.set_major_locator(MaxNLocator(nbins=max(round(4 * side / max(sides)), 1)))
        # Labels of axes lie beyond those of ticks, of which map coordinates have six or seven digits.
        axis.labelpad = 6.0 + 1.5 * len(f"{largest:.0f}")
    ax.ticklabel_format(style="plain", useOffset=False)
    return ax
