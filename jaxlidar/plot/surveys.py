"""Figures of surveys from above."""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.colors import LinearSegmentedColormap

from jaxlidar._checks import as_numpy, check_kind, check_range, check_shape
from jaxlidar.instrument.survey import Survey
from jaxlidar.plot.style import BEAM_COLOUR, MATERIAL_COLOURS, make_axes
from jaxlidar.scenes.scene import Scene

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
    """Draw the shots of a survey from above, over the canopy of a scene.

    Every footprint is drawn as it lies on the reference plane, out to 1/e² of the axial irradiance or to the
    edge of a top-hat; as a dot if it would be too small to see. The canopy is shaded by 1 - exp(-optical
    depth) straight down.

    **Arguments:**

    - `survey`: a `Survey`.
    - `scene`: the `Scene` below. Default None: not drawn.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `values`: (shots,) numbers that colour the footprints, such as heights that were retrieved; NaN is left
      blank. Default None: outlines alone.
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
    position, radius = survey.position, survey.footprint_radius
    # On the reference plane the footprint is an ellipse, longer along the azimuth of the beam.
    long_radius = radius / np.cos(np.deg2rad(survey.zenith))
    low = (position - long_radius[:, None]).min(axis=0)
    high = (position + long_radius[:, None]).max(axis=0)
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
    ax.set_aspect("equal")
    ax.set_xlabel("x, east (m)")
    ax.set_ylabel("y, north (m)")
    colour_values = None if values is None else _checked_values(values, len(survey))
    if float(np.max(radius)) < _MIN_FOOTPRINT * float(np.max(high - low)):
        colours = BEAM_COLOUR if colour_values is None else colour_values
        footprints: Any = ax.scatter(*position.T, s=4.0, c=colours, linewidths=0)
    else:
        # Ellipses are turned counterclockwise from east, azimuths clockwise from north.
        angle = 90.0 - survey.azimuth
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


def _checked_values(values: Any, shots: int) -> Float[np.ndarray, " shots"]:
    array = as_numpy(values, "values", missing=True)
    check_shape("values", array, (shots,))
    # NaN marks shots without a value.
    check_range("values", np.nan_to_num(array))
    return array
