"""Rays along the axis and around the rim of every beam, and whether the terrain takes all of them in."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxlidar._checks import concrete_array
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.instrument.survey import Survey
from jaxlidar.scenes.height_field import HeightField
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.terrain import Terrain

# Points of the rim of one footprint, and of each of very many.
_RIM, _COARSE, _MANY = 32, 8, 1000


class Rims(NamedTuple):
    """The axis of each beam and lines around it.

    - `aim`: aim points, m. - `points`: where the lines cross the plane through the aim point across the
      beam, relative to it, m. - `rays`: unit vectors from the sensor to these points, `distance` m away.
    - `slant`: distance of the aim point from the sensor, m.
    """

    aim: Float[np.ndarray, "shots lines 3"]
    points: Float[np.ndarray, "shots lines 3"]
    rays: Float[np.ndarray, "shots lines 3"]
    distance: Float[np.ndarray, "shots lines"]
    slant: Float[np.ndarray, "shots lines"]


def rims_of(survey: Survey, radii: float) -> Rims:
    """The rims of all footprints, so many radii out; the first line of each is the axis."""
    count = _RIM if len(survey) <= _MANY else _COARSE
    # A polygon about the rim takes in all of it.
    radius = radii * survey.footprint_radius / (1.0 if count == _RIM else np.cos(np.pi / count))
    axis, slant = survey.direction, survey.slant_range
    across = np.cross(axis, np.where(np.abs(axis[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(axis, across)
    turn = np.linspace(0, 2 * np.pi, count + 1)[:, None]
    circle = np.cos(turn) * across[:, None] + np.sin(turn) * other[:, None]
    points = np.pad(radius[:, None, None] * circle, ((0, 0), (1, 0), (0, 0)))
    rays = (axis * slant[:, None])[:, None] + points
    distance = np.linalg.norm(rays, axis=2)
    aim = np.broadcast_to(np.pad(survey.position, ((0, 0), (0, 1)))[:, None], points.shape)
    slant = np.broadcast_to(slant[:, None], distance.shape)
    return Rims(aim, points, rays / distance[..., None], distance, slant)


def check_on_terrain(shots: Lidar | Survey, scene: Scene) -> None:
    """Refuse footprints that lie partly off open terrain. 3e-4 of a Gaussian beam may.

    **Raises:** ValueError with the shot and both extents.
    """
    ground = scene.ground
    if not (isinstance(ground, Terrain) and ground.relief and ground.sides == "open"):
        return
    survey = shots if isinstance(shots, Survey) else Survey.of(shots)
    origin, end, heights = concrete_array(ground.origin), ground.end, concrete_array(ground.heights)
    rims = rims_of(survey, 2.0 if survey.lidar.profile == "gaussian" else 1.0)
    steep = np.minimum(rims.rays[..., 2:], -1e-9)
    ends = [
        rims.points + rims.rays * (z - rims.points[..., 2:]) / steep for z in (heights.min(), heights.max())
    ]
    # Within these all rays meet the ground, whatever lies beneath them.
    low, high = (f(np.concatenate(ends, axis=1)[..., :2], axis=1) + survey.position for f in (np.min, np.max))
    for i in np.flatnonzero(np.any((low < origin) | (high > end), axis=1)):
        place = survey.position[i]
        shape = ground.moved(-place).shape
        assert isinstance(shape, HeightField)
        box, lowest, highest = shape.height_bounds_below(rims.points[i], rims.rays[i])
        box = box + place
        if np.all(box[0] >= origin) and np.all(box[1] <= end):
            continue
        which = "the footprint" if len(survey) == 1 else f"the footprint of shot {i} of {len(survey)}"
        extents = (
            f"{axis} = {a:.2f} to {b:.2f} m"
            for span in (box, (origin, end))
            for axis, a, b in zip("xy", *span)
        )
        raise ValueError(
            "{} lies off the terrain: between heights of {:.6g} and {:.6g} m it takes in {} and {}; the "
            "terrain has {} and {}".format(which, lowest, highest, *extents)
        )
