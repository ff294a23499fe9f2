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
from jaxlidar.scenes.surfaces import AbstractGround, AbstractSheet, AbstractSurface
from jaxlidar.scenes.terrain import Terrain
from jaxlidar.sensors.lidar import Lidar


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
    footprint. The figure takes in the map, all meshes and the footprint.

    **Arguments:**

    - `scene`: a `Scene`.
    - `lidar`: a `Lidar`, whose beam is drawn, out to 1/e^2 of the axial irradiance or to the edge of a
      top-hat. Default None: no beam.
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
    if lidar is not None:
        reach = 1.3 * float(lidar.footprint_radius)
        boxes.append((centre - reach, centre + reach))
        heights += [float(lidar.sensor[2])] if lidar.altitude is None else []
    if scene.meshes:
        bounds = np.concatenate([mesh.bounds() for mesh in scene.meshes])
        boxes.append((bounds[:, 0, :2].min(axis=0), bounds[:, 1, :2].max(axis=0)))
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
        heights += [outlines[..., 1].min(), outlines[..., 1].max()]
        style = {"facecolors": MATERIAL_COLOURS["mesh"], "linewidths": 0.2, "edgecolors": "white"}
        entries.append(ax.add_collection(PolyCollection(list(outlines), label="mesh", **style)))
    for surface in scene.surfaces[: len(scene.surfaces) - sum(len(mesh.surfaces) for mesh in scene.meshes)]:
        z = profile[1] if surface is scene.ground else _heights_at(surface, sides, across, middle)
        heights += z.tolist()
        if isinstance(surface, AbstractSheet):
            entries += ax.plot(sides, z, color=MATERIAL_COLOURS["plate"], linewidth=2.5, label="plate")
    bottom, top = min(heights, default=0.0), max(heights, default=0.0)
    margin = max(0.06 * (top - bottom), 0.2)
    if scene.ground is not None:
        # The ground is filled far below the lower limit, in case that a caller widens the limits.
        fill_bottom = bottom - 10 * (top - bottom + margin)
        fill = {"color": MATERIAL_COLOURS["ground"], "linewidth": 0, "zorder": 3, "label": "ground"}
        entries.append(ax.fill_between(*profile, fill_bottom, **fill))
    if lidar is not None:
        entries += _draw_beam(ax, lidar, across, bottom, top + 10 * margin)
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


def _draw_beam(ax: Axes, lidar: Lidar, across: int, bottom: float, top: float) -> list[Any]:
    """Draw the edges of the beam in the plane through its axis, and return their entries for the legend."""
    name = "beam (1/e²)" if lidar.profile == "gaussian" else "beam"
    style = {"color": BEAM_COLOUR, "linewidth": 1.0, "linestyle": (0, (4, 2)), "label": name}
    if lidar.altitude is None:
        # From the sensor on, as far as the figure may reach: limits cut it off.
        sensor, direction = (np.asarray(a, dtype=float) for a in (lidar.sensor, lidar.direction))
        start, towards = sensor[[across, 2]], direction[[across, 2]]
        length = 2.0 * (abs(top - bottom) + abs(float(sensor[2])) + abs(float(np.ptp(ax.get_xlim()))))
        slope = 0.5e-3 * float(lidar.divergence)
        sideways = np.array([towards[1], -towards[0]])
        ends = [start + length * (towards + side * slope * sideways) for side in (-1, 1)]
        ax.fill(*np.array([start, *ends]).T, color=BEAM_COLOUR, alpha=0.07, linewidth=0)
        return [line for end in ends for line in ax.plot(*np.array([start, end]).T, **style)]
    z = np.array([bottom, top])
    zenith, azimuth = np.deg2rad(float(lidar.zenith)), np.deg2rad(float(lidar.azimuth))
    # Change of the horizontal position per metre of height.
    lean = -np.tan(zenith) * (np.sin(azimuth), np.cos(azimuth))[across]
    axis = float(lidar.position[across]) + lean * z
    # The beam widens with the distance from the sensor.
    widening = 1.0 - z / float(lidar.altitude)
    # The footprint on a horizontal plane is longer along the direction of travel.
    stretch = np.sqrt(1.0 + lean**2)
    half_width = float(lidar.footprint_radius) * widening * stretch
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
