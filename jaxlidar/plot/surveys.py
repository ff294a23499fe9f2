"""Figures of surveys from above."""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.colors import LightSource, LinearSegmentedColormap

from jaxlidar._fields.checks import as_numpy, check_kind, check_range, check_shape
from jaxlidar.plot.style import BEAM_COLOUR, MATERIAL_COLOURS, label_map, make_axes, write_note
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.terrain import Terrain
from jaxlidar.sensors.survey import Survey
from jaxlidar.survey.coverage import ground_position

# Footprints smaller than this fraction of the figure are drawn as dots.
_MIN_FOOTPRINT = 0.006


def survey(
    survey: Survey,
    scene: Scene | None = None,
    ax: Axes | None = None,
    *,
    values: ArrayLike | None = None,
    label: str = "",
) -> Axes:
    """Draw the shots of a survey from above, over the terrain and the canopy of a scene.

    Every footprint is drawn where its beam axis meets the ground of the scene, and as wide as the beam is
    there, out to 1/e² of the axial irradiance or to the edge of a top-hat; as a dot if it would be too small
    to see. Without a ground it lies on the reference plane. Shots that are placed by their sensors and meet
    no ground are drawn as their sensors. Terrain is shaded as if lit from the north-west, the canopy by
    1 - exp(-optical depth) straight down.

    **Arguments:**

    - `survey`: a `Survey`.
    - `scene`: the `Scene` below. Default None: not drawn.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `values`: (shots,) numbers that colour the footprints, such as heights that were retrieved; NaN is left
      blank; where all are NaN, outlines are drawn, and a note. Default None: outlines alone.
    - `label`: name of the values at their colour bar. Default "".

    **Returns:** the axes.

    **Raises:** ValueError for values of another shape, TypeError for objects of the wrong type.

    **Example:**

    >>> import jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> survey = jl.Survey.grid(jl.Lidar(), low=(0, 0), high=(40, 40), spacing=10.0)
    >>> ax = jaxlidar.plot.survey(survey, ax=Figure().subplots())
    >>> print(ax.get_xlabel(), len(ax.collections))
    x, east (m) 1
    """
    check_kind("survey", survey, Survey, "a Survey")
    check_kind("scene", scene, Scene | None, "a Scene or None")
    ax = make_axes(ax, (4.6, 4.6))
    position, radius, long_radius, angle = _footprints(survey, scene)
    low = (position - long_radius[:, None]).min(axis=0)
    high = (position + long_radius[:, None]).max(axis=0)
    if scene is not None and isinstance(scene.ground, Terrain):
        low, high = _draw_relief(ax, scene.ground, low, high)
    canopy = None if scene is None else scene.canopy
    if canopy is not None:
        origin, end = (np.asarray(a, float)[:2] for a in (canopy.voxels.origin, canopy.voxels.top))
        depth = canopy.voxels.mean_extinction().sum(axis=2) * float(canopy.voxels.voxel_size[2])
        shades = LinearSegmentedColormap.from_list(
            "leaf", [MATERIAL_COLOURS["leaf"] + "00", MATERIAL_COLOURS["leaf"]]
        )
        extent = (origin[0], end[0], origin[1], end[1])
        # Values end at 1; the scale goes further, so that the densest canopy stays lighter than the
        # footprints.
        image: dict[str, Any] = {"vmin": 0.0, "vmax": 1.4, "origin": "lower", "interpolation": "nearest"}
        ax.imshow(-np.expm1(-depth).T, cmap=shades, extent=extent, **image)
        low, high = np.minimum(low, origin), np.maximum(high, end)
    margin = 0.03 * max(float(np.max(high - low)), 1e-3)
    ax.set_xlim(low[0] - margin, high[0] + margin)
    ax.set_ylim(low[1] - margin, high[1] + margin)
    label_map(ax)
    colour_values = None if values is None else _checked_values(values, len(survey))
    if colour_values is not None and np.isnan(colour_values).all():
        # Outlines, and no colour bar, whose numbers would be made up.
        write_note(ax, "no values")
        colour_values = None
    if float(np.max(radius)) < _MIN_FOOTPRINT * float(np.max(high - low)):
        colours = BEAM_COLOUR if colour_values is None else colour_values
        footprints: Any = ax.scatter(*position.T, s=4.0, c=colours, linewidths=0)
    else:
        layout = {"units": "x", "offsets": position, "offset_transform": ax.transData}
        footprints = EllipseCollection(2 * long_radius, 2 * radius, angle, **layout)
        if colour_values is None:
            linewidth = 0.6 if len(survey) < 500 else 0.3
            footprints.set(edgecolor=BEAM_COLOUR, facecolor="none", linewidth=linewidth)
        else:
            footprints.set(array=colour_values, linewidth=0, alpha=0.9)
        ax.add_collection(footprints)
    if colour_values is not None:
        ax.figure.colorbar(footprints, ax=ax, label=label, shrink=0.8)
    return ax


def _footprints(
    survey: Survey, scene: Scene | None
) -> tuple[
    Float[np.ndarray, "shots 2"],
    Float[np.ndarray, " shots"],
    Float[np.ndarray, " shots"],
    Float[np.ndarray, " shots"],
]:
    """Return the place of every footprint on the ground, its shorter and longer radius, and its direction.

    A beam that meets the ground at the range r has r / R of the radius that it has at its aim point, at the
    range R. The direction is that of the longer radius, degrees counterclockwise from east.
    """
    aim = survey.sensor if survey.has_sensor_position else survey.aim_point
    points = np.full_like(aim, np.nan) if scene is None else ground_position(survey, scene)
    met = np.asarray(np.isfinite(points).all(axis=1))
    points = np.where(met[:, None], points, aim)
    distance = np.linalg.norm(points - survey.sensor, axis=1)
    # The axes of an ellipse are singular vectors of any two conjugate radii.
    directions, radii, _ = np.linalg.svd(np.stack(survey.level_footprint_axes, axis=-1))
    radii *= (survey.footprint_radius * distance / survey.slant_range)[:, None]
    angle = np.rad2deg(np.arctan2(directions[:, 1, 0], directions[:, 0, 0]))
    return points[:, :2], radii[:, 1], radii[:, 0], angle


def _draw_relief(
    ax: Axes, terrain: Terrain, low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Shade a terrain, and return the corners of what is drawn.

    Terrain that repeats has no corners of its own: its first period is drawn.
    """
    heights = np.asarray(terrain.heights, float)
    if min(heights.shape) < 2:
        return low, high
    spacing, origin = np.asarray(terrain.spacing, float), np.asarray(terrain.origin, float)
    light = LightSource(azdeg=315.0, altdeg=45.0)
    # Rows run from south to north, against those of images.
    shade = light.hillshade(heights.T[::-1], vert_exag=1.0, dx=spacing[0], dy=spacing[1])
    # Nodes are the centres of the pixels.
    corner = origin + spacing * (np.array(heights.shape) - 0.5)
    extent = (origin[0] - 0.5 * spacing[0], corner[0], origin[1] - 0.5 * spacing[1], corner[1])
    # Greys from the middle up, so that footprints stay visible.
    ax.imshow(shade, cmap="gray", vmin=-0.8, vmax=1.0, extent=extent, origin="upper", zorder=0)
    return np.minimum(low, origin), np.maximum(high, np.asarray(terrain.end, float))


def _checked_values(values: Any, shots: int) -> Float[np.ndarray, " shots"]:
    array = as_numpy(values, "values")
    check_shape("values", array, (shots,))
    # NaN marks shots without a value.
    check_range("values", np.nan_to_num(array))
    return array
