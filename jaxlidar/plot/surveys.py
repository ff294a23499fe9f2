"""Figures of surveys from above."""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.colors import LinearSegmentedColormap

from jaxlidar._checks import check_kind, check_range, check_shape, concrete
from jaxlidar.instrument.survey import Survey
from jaxlidar.plot.style import BEAM, COLOURS, axes_or_new
from jaxlidar.scenes.scene import Scene

# Footprints smaller than this share of the figure are drawn as dots.
_VISIBLE = 0.006


def survey(
    survey: Survey,
    scene: Scene | None = None,
    ax: Axes | None = None,
    *,
    values: ArrayLike | None = None,
    label: str = "",
) -> Axes:
    """Axes with the shots of a survey from above, over the canopy of a scene.

    Every footprint is drawn as it lies on the reference plane, out to 1/e² of the axial irradiance or to the
    edge of a top-hat; as a dot where it would be too small to see. The canopy is shaded by 1 - exp(-optical
    depth) straight down.

    **Arguments:**

    - `survey`: a `Survey`.
    - `scene`: the `Scene` below. Default None: not drawn.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `values`: (shots,) numbers that colour the footprints, such as heights that were retrieved; NaN is left
      blank. Default None: outlines alone.
    - `label`: what the values are, for their colour bar. Default "".

    **Returns:** the axes.

    **Raises:** ValueError for values of another shape, TypeError for things of another kind.

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
    ax = axes_or_new(ax, (4.6, 4.6))
    place, half = survey.position, survey.footprint_radius
    long = half / np.cos(np.deg2rad(survey.zenith))
    low, high = (place - long[:, None]).min(axis=0), (place + long[:, None]).max(axis=0)
    canopy = None if scene is None else scene.canopy
    if canopy is not None:
        origin, end = (np.asarray(a, float)[:2] for a in (canopy.voxels.origin, canopy.voxels.top))
        depth = canopy.voxels.mean_extinction().sum(axis=2) * float(canopy.voxels.voxel_size[2])
        shades = LinearSegmentedColormap.from_list("leaf", [COLOURS["leaf"] + "00", COLOURS["leaf"]])
        extent = (origin[0], end[0], origin[1], end[1])
        look: dict[str, Any] = {"vmin": 0.0, "vmax": 1.4, "origin": "lower", "interpolation": "nearest"}
        ax.imshow(-np.expm1(-depth).T, cmap=shades, extent=extent, **look)
        low, high = np.minimum(low, origin), np.maximum(high, end)
    room = 0.03 * max(float(np.max(high - low)), 1e-3)
    ax.set_xlim(low[0] - room, high[0] + room)
    ax.set_ylim(low[1] - room, high[1] + room)
    ax.set_aspect("equal")
    ax.set_xlabel("x, east (m)")
    ax.set_ylabel("y, north (m)")
    coloured = None if values is None else _values(values, len(survey))
    if float(np.max(half)) < _VISIBLE * float(np.max(high - low)):
        drawn: Any = ax.scatter(*place.T, s=4.0, c=BEAM if coloured is None else coloured, linewidths=0)
    else:
        # Ellipses are turned counterclockwise from east, azimuths clockwise from north.
        turn = 90.0 - survey.azimuth
        look = {"units": "x", "offsets": place, "offset_transform": ax.transData}
        drawn = EllipseCollection(2 * long, 2 * half, turn, **look)
        if coloured is None:
            drawn.set(edgecolor=BEAM, facecolor="none", linewidth=0.6 if len(survey) < 500 else 0.3)
        else:
            drawn.set(array=coloured, linewidth=0, alpha=0.9)
        ax.add_collection(drawn)
    if coloured is not None:
        ax.figure.colorbar(drawn, ax=ax, label=label, shrink=0.8)
    return ax


def _values(values: Any, shots: int) -> Float[np.ndarray, " shots"]:
    known = concrete(values)
    check_shape("values", values, (shots,))
    assert known is not None
    check_range("values", np.nan_to_num(known))
    return known
