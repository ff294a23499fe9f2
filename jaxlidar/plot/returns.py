"""Figures of discrete returns: from above, obliquely, and in vertical sections.

Returns are coloured by their class, their material or their height. Each group is drawn as one set of points,
the most frequent first, so that rare ones lie on top.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from mpl_toolkits.mplot3d import Axes3D

from jaxlidar._fields.checks import check_choice, check_kind, check_number, checked_array
from jaxlidar.plants.point_cloud import PointCloud
from jaxlidar.plot.style import (
    MATERIAL_COLOURS,
    OTHER_COLOUR,
    TOTAL_COLOUR,
    label_map,
    make_axes,
    material_colours,
    oblique_axes,
)
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.terrain import Terrain
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.survey import Survey
from jaxlidar.survey.coverage import ground_position
from jaxlidar.survey.returns import DiscreteReturns

COLOURED_BY = ("class", "material", "height", "height above ground")
# Names and colours of the classes of the LAS specification; vegetation is darker the higher it is.
_CLASSES = {
    0: ("not classified", OTHER_COLOUR),
    1: ("unclassified", MATERIAL_COLOURS["plate"]),
    2: ("ground", MATERIAL_COLOURS["ground"]),
    3: ("low vegetation", "#B8E3B0"),
    4: ("medium vegetation", "#4DBE9A"),
    5: ("high vegetation", "#00735A"),
    6: ("building", MATERIAL_COLOURS["mesh"]),
    7: ("noise", TOTAL_COLOUR),
    9: ("water", "#0072B2"),
    18: ("high noise", TOTAL_COLOUR),
}
# Points on a section of the ground.
_PROFILE_POINTS = 800


def points(
    returns: DiscreteReturns | PointCloud,
    ax: Axes | Axes3D | None = None,
    *,
    view: str = "above",
    colour_by: str = "class",
    size: float = 1.5,
    elevation: float = 25.0,
    azimuth: float = 200.0,
    legend: bool = True,
) -> Axes | Axes3D:
    """Draw discrete returns from above or obliquely, coloured by class, material or height.

    **Arguments:**

    - `returns`: `DiscreteReturns`, or a `PointCloud` of `jaxlidar.io.read_las`.
    - `ax`: the axes to draw on; for an oblique view, three-dimensional ones. Default None: those of a new
      figure.
    - `view`: "above" or "oblique". Default "above".
    - `colour_by`: "class" (of the LAS specification), "material" or "height above ground" (of
      `DiscreteReturns`), or "height". Default "class".
    - `size`: diameter of a point, in points of the figure, positive. Default 1.5.
    - `elevation`: angle of an oblique view above the horizon, degrees. Default 25.
    - `azimuth`: direction towards the viewer of an oblique view, degrees clockwise from north. Default 200.
    - `legend`: True to add a legend, or a colour bar for heights. Default True.

    **Returns:** the axes.

    **Raises:** ValueError for another `view` or `colour_by`, for a size that is not positive, and where there
    is no return; TypeError for materials of a `PointCloud`, and for objects of the wrong type.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> survey = jl.Survey.grid(jl.Lidar(), low=(0, 0), high=(20, 20), spacing=10.0)
    >>> scene = jl.Scene(plates=[jl.Plate(6.0, 0.4, coverage=0.5)], ground=jl.Ground(reflectance=0.3))
    >>> returns = jl.simulate_many(survey, scene, key=jax.random.key(0)).returns()
    >>> ax = jaxlidar.plot.points(returns, Figure().subplots(), colour_by="material")
    >>> print([text.get_text() for text in ax.get_legend().get_texts()])
    ['ground', 'plate']
    """
    _check_returns(returns)
    check_choice("view", view, ("above", "oblique"))
    check_choice("colour_by", colour_by, COLOURED_BY)
    check_number("size", size, 0.0, low_open=True)
    check_number("elevation", elevation)
    check_number("azimuth", azimuth)
    position = np.asarray(returns.position, float)
    if view == "oblique":
        axes = oblique_axes(ax, position.min(axis=0), position.max(axis=0), elevation, azimuth, (6.4, 4.6))
        _draw_coloured(axes, position, returns, colour_by, size, legend)
        return axes
    ax = make_axes(ax, (5.2, 4.6))
    # The highest last, as one that looks down sees them.
    order = np.argsort(position[:, 2], kind="stable")
    _draw_coloured(ax, position[:, :2], returns, colour_by, size, legend, order)
    label_map(ax)
    return ax


def section(
    returns: DiscreteReturns | PointCloud,
    start: Any,
    end: Any,
    ax: Axes | None = None,
    *,
    width: float = 2.0,
    scene: Scene | None = None,
    colour_by: str = "class",
    size: float = 2.0,
    legend: bool = True,
) -> Axes:
    """Draw a vertical section through discrete returns along a line, with the ground of a scene.

    **Arguments:**

    - `returns`: `DiscreteReturns`, or a `PointCloud` of `jaxlidar.io.read_las`.
    - `start`, `end`: (x, y) in m where the section begins and ends.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `width`: returns at most half of this from the line are drawn, m, positive. Default 2.
    - `scene`: the `Scene` whose ground below the line is drawn. Default None: none.
    - `colour_by`: as that of `points`. Default "class".
    - `size`: as that of `points`. Default 2.
    - `legend`: as that of `points`. Default True.

    **Returns:** the axes; the horizontal one is the distance from `start` along the line.

    **Raises:** as `points`; ValueError for a line without length, and where no return lies in the section.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> survey = jl.Survey.grid(jl.Lidar(), low=(0, 0), high=(20, 20), spacing=5.0)
    >>> scene = jl.Scene(ground=jl.Ground(slope=10.0))
    >>> returns = jl.simulate_many(survey, scene, key=jax.random.key(0)).returns()
    >>> ax = jaxlidar.plot.section(returns, (0, 10), (20, 10), Figure().subplots(), scene=scene)
    >>> print(ax.get_xlabel(), [len(line.get_xdata()) for line in ax.lines if line.get_marker() == "o"])
    distance (m) [5]
    """
    _check_returns(returns)
    check_choice("colour_by", colour_by, COLOURED_BY)
    check_number("size", size, 0.0, low_open=True)
    check_number("width", width, 0.0, low_open=True)
    check_kind("scene", scene, Scene | None, "a Scene or None")
    first, last = checked_array("start", start, (2,)), checked_array("end", end, (2,))
    length = float(np.linalg.norm(last - first))
    if length == 0:
        raise ValueError(f"start and end are both {first.tolist()}; admissible is a line with a length")
    along = (last - first) / length
    position = np.asarray(returns.position, float)
    offset = position[:, :2] - first
    distance, across = offset @ along, offset @ np.array([along[1], -along[0]])
    (rows,) = np.nonzero((distance >= 0) & (distance <= length) & (np.abs(across) <= 0.5 * width))
    if rows.size == 0:
        raise ValueError(
            f"no return lies within {0.5 * width:g} m of the line from {first.tolist()} to {last.tolist()}; "
            f"returns reach from {position[:, :2].min(axis=0).tolist()} to "
            f"{position[:, :2].max(axis=0).tolist()}"
        )
    ax = make_axes(ax, (7.4, 3.0))
    _draw_coloured(
        ax, np.column_stack([distance, position[:, 2]]), returns, colour_by, size, legend, order=rows
    )
    low, high = float(position[rows, 2].min()), float(position[rows, 2].max())
    if scene is not None and scene.ground is not None:
        steps = np.linspace(0.0, length, _PROFILE_POINTS)
        heights = _ground_heights(scene, first + steps[:, None] * along)
        colour = MATERIAL_COLOURS["ground"]
        ax.plot(steps, heights, color=TOTAL_COLOUR, linewidth=0.8, zorder=1.5, label="_terrain")
        ax.fill_between(steps, heights, low - 1e4, color=colour, alpha=0.25, linewidth=0, zorder=1)
        low, high = min(low, float(np.nanmin(heights))), max(high, float(np.nanmax(heights)))
    margin = max(0.05 * (high - low), 0.5)
    ax.set(xlim=(0.0, length), ylim=(low - margin, high + margin))
    ax.set_aspect("equal")
    ax.set_xlabel("distance (m)")
    ax.set_ylabel("height (m)")
    return ax


def _check_returns(returns: Any) -> None:
    """Refuse an object that is no returns, and returns without a point."""
    check_kind("returns", returns, DiscreteReturns | PointCloud, "DiscreteReturns or a PointCloud")
    if len(returns.position) == 0:
        raise ValueError("returns has no return; admissible is one or more")


def _draw_coloured(
    ax: Axes | Axes3D,
    position: Float[np.ndarray, "n axes"],
    returns: DiscreteReturns | PointCloud,
    colour_by: str,
    size: float,
    legend: bool,
    order: np.ndarray | None = None,
) -> None:
    """Draw returns at positions on the axes; `order`: which of them, and in which order."""
    rows = np.arange(len(position)) if order is None else order
    if colour_by in ("height", "height above ground"):
        heights = _heights_of(returns, colour_by)
        # A few outliers, such as noise, shall not take the colours of all others.
        low, high = np.quantile(heights[rows], (0.002, 0.998))
        limits = {"vmin": low, "vmax": high, "cmap": "viridis"}
        look = {"s": size**2, "c": heights[rows], "linewidths": 0, **limits}
        drawn: Any = ax.scatter(*position[rows].T, **look)
        if legend and (figure := ax.get_figure()) is not None:
            is_outside = bool(np.any((heights[rows] < low) | (heights[rows] > high)))
            name = "height above ground (m)" if colour_by != "height" else "height (m)"
            extend = "both" if is_outside else "neither"
            figure.colorbar(drawn, ax=ax, label=name, shrink=0.8, extend=extend)
        return
    groups = _groups_of(returns, colour_by)
    names, numbers = np.unique([name for name, _ in groups], return_inverse=True)
    colours = dict(groups)
    counts = np.bincount(numbers[rows], minlength=len(names))
    heights = np.bincount(numbers[rows], np.asarray(returns.position, float)[rows, 2], len(names))
    # From the lowest to the highest: the ground must not cover the canopy, however many points it has.
    for group in np.argsort(heights / np.maximum(counts, 1), kind="stable"):
        if counts[group] == 0:
            continue
        name, chosen = str(names[group]), rows[numbers[rows] == group]
        look = {"linestyle": "none", "marker": "o", "markersize": size, "markeredgewidth": 0}
        ax.plot(*position[chosen].T, color=colours[name], label=name, **look)
    if legend:
        # Beside the axes: within them it would cover points. Three-dimensional ones have room at the top.
        place: dict[str, Any] = {"loc": "upper right"}
        if not isinstance(ax, Axes3D):
            place = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.3}
        ax.legend(markerscale=5.0 / size, frameon=False, fontsize="small", handletextpad=0.2, **place)


def _heights_of(returns: DiscreteReturns | PointCloud, colour_by: str) -> Float[np.ndarray, " n"]:
    """Return heights that colour returns, m."""
    height = np.asarray(returns.position, float)[:, 2]
    if colour_by == "height":
        return height
    if isinstance(returns, PointCloud):
        raise TypeError(
            "colour_by = 'height above ground' of a PointCloud, which has no ground below its points; "
            "admissible are 'class' and 'height'"
        )
    above = height - returns.ground_height
    if np.isnan(above).any():
        raise ValueError(
            f"colour_by = 'height above ground': {int(np.isnan(above).sum())} of {len(returns)} returns have "
            "no ground below them; admissible is 'height'"
        )
    return above


def _groups_of(returns: DiscreteReturns | PointCloud, colour_by: str) -> list[tuple[str, str]]:
    """Return the name and the colour of each return's class or material."""
    if colour_by == "class":
        classes = np.asarray(returns.classification, int).tolist()
        return [_CLASSES.get(number, (f"class {number}", OTHER_COLOUR)) for number in classes]
    if isinstance(returns, PointCloud):
        raise TypeError(
            "colour_by = 'material' of a PointCloud, which has no materials; admissible are 'class' and "
            "'height'"
        )
    names = returns.material.tolist()
    colours = material_colours(names)
    return [(name, colours[name]) for name in names]


def _ground_heights(scene: Scene, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Return the heights of the ground at points, m; NaN where there is no ground."""
    inside = np.ones(len(points), bool)
    if isinstance(scene.ground, Terrain) and scene.ground.sides == "open":
        low, high = np.asarray(scene.ground.origin, float), np.asarray(scene.ground.end, float)
        inside = np.all((points >= low) & (points <= high), axis=1)
    heights = np.full(len(points), np.nan)
    if inside.any():
        # Beams straight down from above all ground, which meet it anywhere.
        heights[inside] = ground_position(Survey(Lidar(), points[inside], zenith=0.0), scene)[:, 2]
    return heights
