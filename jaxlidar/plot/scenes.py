"""Figures of scenes from the side.

The view is horizontal, along y (or x); `across` is the horizontal axis of the figure, `depth` that along the
view.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap

from jaxlidar.plot.style import BEAM_COLOUR, MATERIAL_COLOURS, make_axes
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.surfaces import AbstractGround, AbstractSurface
from jaxlidar.scenes.terrain import Terrain
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.survey import Survey

# Least width of the axes over their height, where they show nothing but a beam, planes and terrain.
_MIN_WIDTH = 0.6
# Most metres along the horizontal of the path of a beam from its sensor, over the height of the scene, and
# the height of a scene of less, m.
_MAX_PATH, _MIN_HEIGHT = 4.0, 2.0


def scene(
    scene: Scene,
    lidar: Lidar | None = None,
    ax: Axes | None = None,
    *,
    along: str = "y",
    legend: bool = True,
) -> Axes:
    """Draw a scene from the side: optical depth of leaf and bark, plates, meshes, ground and the beam.

    Leaf and bark are shaded by 1 - exp(-optical depth) of a horizontal view through all of the voxel map.
    Planes and terrain are cut at the middle of the map, of the meshes if there is no map, or of the
    footprint or path of the beam. The figure takes in the map, all meshes and the footprint; or, of a lidar
    that is placed by its sensor, the sensor and the path of its beam to the lowest or highest surface, the
    canopy's top included, but not farther than four times the height of all of these.

    **Arguments:**

    - `scene`: a `Scene`.
    - `lidar`: a `Lidar`, whose beam is drawn as wide as it looks from the side, out to 1/e^2 of the axial
      irradiance or to the edge of a top-hat; a dot marks a sensor that it is placed by. Default None: no
      beam.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `along`: the direction of view: "y" looks north, x to the right; "x" looks west, y to the right. Default
      "y".
    - `legend`: True to add a legend. Default True.

    **Returns:** the axes.

    **Raises:** ValueError for another `along`.

    **Example:**

    >>> import jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> ax = jaxlidar.plot.scene(jl.Scene(ground=jl.Ground()), jl.Lidar(), Figure().subplots())
    >>> print([text.get_text() for text in ax.get_legend().get_texts()])
    ['ground', 'beam (1/e²)']
    """
    if along not in ("x", "y"):
        raise ValueError(f"along = {along!r} is none of 'x', 'y'")
    ax = make_axes(ax, (3.5, 4.2))
    across, depth = (0, 1) if along == "y" else (1, 0)
    centre = np.zeros(2) if lidar is None else np.asarray(lidar.position, dtype=float)[:2]
    # Boxes of what the figure shows, horizontally: lowest and highest corners.
    boxes, heights, entries = [], [], []
    if scene.meshes:
        bounds = np.concatenate([mesh.bounds() for mesh in scene.meshes])
        boxes.append((bounds[:, 0, :2].min(axis=0), bounds[:, 1, :2].max(axis=0)))
        heights += [bounds[:, 0, 2].min(), bounds[:, 1, 2].max()]
    if scene.canopy is not None:
        voxels = scene.canopy.voxels
        origin, size = np.asarray(voxels.origin, dtype=float), np.asarray(voxels.voxel_size, dtype=float)
        # In double precision, as map coordinates need.
        end = origin + size * voxels.shape
        boxes.append((origin[:2], end[:2]))
        heights.append(end[2])
        extent = (origin[across], end[across], origin[2], end[2])
        entries += _draw_voxels(ax, voxels.leaf, "leaf", depth, size[depth], extent)
        entries += _draw_voxels(ax, voxels.bark, "bark", depth, size[depth], extent)
    if lidar is not None:
        levels = [*heights, *_heights_below(scene, across, centre)]
        corners, beam_heights = _beam_box(lidar, levels)
        heights += beam_heights
        if not boxes:
            # A narrow beam alone would make axes without room for their ticks.
            spanned = [*levels, *beam_heights]
            widening = 0.5 * _MIN_WIDTH * (max(spanned, default=0.0) - min(spanned, default=0.0))
            middle_of_beam = corners.mean(axis=0)
            corners[0] = np.minimum(corners[0], middle_of_beam - widening)
            corners[1] = np.maximum(corners[1], middle_of_beam + widening)
        boxes.insert(0, (corners[0], corners[1]))
    low, high = _extent(boxes, across)
    if isinstance(scene.ground, Terrain) and high <= low:
        # Without a canopy, meshes and a beam, the figure has the extent of the terrain.
        boxes = [(np.asarray(scene.ground.origin, dtype=float), scene.ground.end)]
        low, high = _extent(boxes, across)
    if high <= low:
        low, high = low - 1.0, low + 1.0
    # The map goes before meshes, and these before the footprint.
    middle = 0.5 * (boxes[-1][0][depth] + boxes[-1][1][depth]) if boxes else centre[depth]
    sides = np.array([low, high])
    profile = _ground_profile(scene.ground, sides, across, middle)
    for mesh in scene.meshes:
        outlines = mesh.corners()[:, :, [across, 2]]
        style = {"facecolors": MATERIAL_COLOURS["mesh"], "linewidths": 0.2, "edgecolors": "white"}
        entries.append(ax.add_collection(PolyCollection(list(outlines), label="mesh", **style)))
    heights += profile[1].tolist()
    for plate in scene.plates:
        z = _heights_at(plate, sides, across, middle)
        heights += z.tolist()
        entries += ax.plot(sides, z, color=MATERIAL_COLOURS["plate"], linewidth=2.5, label="plate")
    bottom, top = min(heights, default=0.0), max(heights, default=0.0)
    margin = max(0.06 * (top - bottom), 0.2)
    if scene.ground is not None:
        # The ground is filled far below the lower limit, in case that a caller widens the limits.
        fill_bottom = bottom - 10 * (top - bottom + margin)
        fill = {"color": MATERIAL_COLOURS["ground"], "linewidth": 0, "zorder": 3, "label": "ground"}
        entries.append(ax.fill_between(*profile, fill_bottom, **fill))
    if lidar is not None:
        length = 2.0 * (top - bottom + margin + np.linalg.norm(np.ptp(boxes[0], axis=0)) + high - low)
        entries += _draw_beam(ax, lidar, across, (bottom, top + 10 * margin), float(length))
    ax.set_xlim(low, high)
    ax.set_ylim(bottom - margin, top + margin)
    ax.set_aspect("equal")
    ax.set_xlabel("x, east (m)" if along == "y" else "y, north (m)")
    ax.set_ylabel("height (m)")
    if legend and entries:
        # One entry for each name: the beam has two edges, and there may be several plates.
        by_name = {entry.get_label(): entry for entry in entries}
        style = {"frameon": False, "fontsize": "small", "ncols": 2, "handlelength": 1.5, "columnspacing": 1.2}
        ax.legend(by_name.values(), by_name.keys(), loc="lower center", bbox_to_anchor=(0.5, 1.0), **style)
    return ax


def _extent(boxes: list[tuple[np.ndarray, np.ndarray]], across: int) -> tuple[float, float]:
    """Return the lowest and the highest position of boxes along an axis; zeros without any."""
    return (
        min((float(low[across]) for low, _ in boxes), default=0.0),
        max((float(high[across]) for _, high in boxes), default=0.0),
    )


def _draw_voxels(
    ax: Axes, extinction: Any, name: str, depth: int, edge: float, extent: tuple[float, float, float, float]
) -> list[Any]:
    """Shade a material by its opacity along the view, and return its entry for the legend."""
    if extinction is None or not np.any(np.asarray(extinction) > 0):
        return []
    opacity = -np.expm1(-np.asarray(extinction, dtype=float).sum(axis=depth) * edge)
    colours = LinearSegmentedColormap.from_list(name, [MATERIAL_COLOURS[name] + "00", MATERIAL_COLOURS[name]])
    ax.imshow(
        opacity.T, cmap=colours, vmin=0.0, vmax=1.0, origin="lower", extent=extent, interpolation="nearest"
    )
    return ax.plot([], [], "s", color=MATERIAL_COLOURS[name], label=name)


def _heights_below(scene: Scene, across: int, place: np.ndarray) -> list[float]:
    """Return the heights of the ground and of plates on the vertical line through a place (x, y)."""
    sides, depth = place[[across, across]], float(place[1 - across])
    profiles = [_ground_profile(scene.ground, sides, across, depth)[1]]
    profiles += [_heights_at(plate, sides, across, depth) for plate in scene.plates]
    return [float(z) for heights in profiles for z in heights[:1]]


def _beam_box(lidar: Lidar, levels: list[float]) -> tuple[np.ndarray, list[float]]:
    """Return the horizontal corners (2, 2) of what a beam takes, and the heights between which it lies.

    That is the footprint on the reference plane. Of a lidar that is placed by its sensor, it is the path from
    there to the lowest of the levels, or the highest one for a beam that goes up; heights are then its ends.
    """
    survey = Survey.of(lidar)
    radius = 1.3 * float(survey.footprint_radius[0])
    if not lidar.has_sensor_position:
        reach = radius * np.linalg.norm(survey.level_footprint_axes, axis=0)[0]
        return survey.position + [[-1.0], [1.0]] * reach, []
    sensor, direction = survey.sensor[0], survey.direction[0]
    height = max(float(np.ptp([*levels, sensor[2]])), _MIN_HEIGHT)
    # To the level, or over the height of the scene where no level lies ahead.
    level = min(levels, default=sensor[2]) if direction[2] < 0 else max(levels, default=sensor[2])
    climb = level - sensor[2]
    climb = climb if climb * direction[2] > 0 else np.copysign(height, direction[2])
    longest = _MAX_PATH * height / max(float(np.hypot(*direction[:2])), 1e-9)
    length = min(climb / direction[2] if direction[2] else longest, longest)
    end = sensor + length * direction
    # With room for the mark of the sensor.
    reach = radius * length + 0.05 * height
    ends = np.stack([sensor, end])
    corners = np.stack([ends.min(axis=0) - reach, ends.max(axis=0) + reach])[:, :2]
    return corners, [float(sensor[2]), float(end[2])]


def _draw_beam(ax: Axes, lidar: Lidar, across: int, heights: tuple[float, float], length: float) -> list[Any]:
    """Draw the edges of the beam as it looks from the side, and return their entries for the legend.

    Beams of an altitude are drawn between the heights, those from a sensor over the length in m from there.

    A point of the edge at the range r is r gamma / 2 (cos(t) a + sin(t) b) off the axis, with the semi-axes a
    and b of the footprint over its radius. Along a unit vector u across the axis, in the plane of the figure,
    the edge lies sqrt((a.u)^2 + (b.u)^2) r gamma / 2 off the axis.
    """
    name = "beam (1/e²)" if lidar.profile == "gaussian" else "beam"
    style = {"color": BEAM_COLOUR, "linewidth": 1.0, "linestyle": (0, (4, 2)), "label": name}
    survey, plane = Survey.of(lidar), [across, 2]
    sensor, towards = survey.sensor[0, plane], survey.direction[0, plane]
    steepness = float(np.linalg.norm(towards))
    # A level beam along the view has no sides.
    sideways = np.array([towards[1], -towards[0]]) / steepness if steepness > 1e-6 else np.zeros(2)
    semi_axes = np.stack([axis[0, plane] for axis in survey.footprint_axes])
    slope = 0.5e-3 * float(lidar.largest_divergence) * float(np.linalg.norm(semi_axes @ sideways))
    if lidar.has_sensor_position:
        # As far as the figure may reach: limits cut it off.
        ends = [sensor + length * (towards + side * slope * sideways) for side in (-1, 1)]
        ax.fill(*np.array([sensor, *ends]).T, color=BEAM_COLOUR, alpha=0.07, linewidth=0)
        ax.plot(*sensor, "o", color=BEAM_COLOUR, markersize=4.0, label="_sensor", zorder=4)
        return [line for end in ends for line in ax.plot(*np.array([sensor, end]).T, **style)]
    z = np.array(heights)
    axis = sensor[0] + (z - sensor[1]) * towards[0] / towards[1]
    # On a level line the beam is wider than across its axis.
    half_width = slope * (z - sensor[1]) / survey.direction[0, 2] * steepness / abs(towards[1])
    ax.fill_betweenx(z, axis - half_width, axis + half_width, color=BEAM_COLOUR, alpha=0.07, linewidth=0)
    return [line for side in (-1, 1) for line in ax.plot(axis + side * half_width, z, **style)]


def _ground_profile(
    ground: AbstractGround | None, sides: np.ndarray, across: int, middle: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and heights of the ground between two sides, as far as the ground extends."""
    if ground is None:
        return sides, np.zeros(0)
    if not (isinstance(ground, Terrain) and ground.relief):
        return sides, _heights_at(ground, sides, across, middle)
    position, depth = np.linspace(sides[0], sides[1], 800), np.array([middle])
    if ground.sides == "open":
        low, high = np.asarray(ground.origin, dtype=float), ground.end
        position = np.clip(position, low[across], high[across])
        depth = np.clip(depth, low[1 - across], high[1 - across])
    x, y = (position, depth[0] + 0.0 * position)[:: 1 if across == 0 else -1]
    return position, np.asarray(ground.height_at(x, y), dtype=float)


def _heights_at(surface: AbstractSurface, sides: np.ndarray, across: int, middle: float) -> np.ndarray:
    """Find the heights of a surface at two positions, where vertical lines cross it."""
    points = np.full((2, 3), middle)
    points[:, across], points[:, 2] = sides, 0.0
    depth, _ = surface.shape.crossing(points, np.tile([0.0, 0.0, -1.0], (2, 1)))
    return -np.asarray(depth)
