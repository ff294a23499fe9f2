"""Coverage of a survey: where its shots meet the ground, and footprints partly outside the map."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxlidar._fields.checks import as_array, check_kind, concrete_array
from jaxlidar._fields.crs import common_system
from jaxlidar._jax.programs import Program
from jaxlidar._registry import shots_within
from jaxlidar._text import NOTABLE_FRACTION, percent
from jaxlidar._vectors import FAR, vec
from jaxlidar.planning.path_lengths import footprints_on_terrain
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.shapes import AbstractShape, Plane
from jaxlidar.scenes.terrain import Terrain
from jaxlidar.sensors.lidar import AIM_DISTANCE
from jaxlidar.sensors.survey import Survey
from jaxlidar.trace.first.footprint import GOLDEN

# Cosines of incidence below this count as along the ground.
_LEAST_COSINE = 1e-6
# Points of a footprint, and shots that are computed together.
_POINTS, _SHOTS_PER_BLOCK = 512, 1024
# Beam axes whose distances to the ground are computed together.
_AXES_PER_BLOCK = 8192


class OffMapWarning(UserWarning):
    """Warning that a hundredth of a footprint's light or more falls outside the voxel map of a stand.

    Beyond a map with open sides the scene is empty, so that such a shot sees less canopy than there may be.
    `Waveforms.off_map` has the fraction of every shot. There is no warning where nothing stands in the
    outermost columns of the map, as around a tree on a lawn.

    **Example:** half a footprint outside the map.

    >>> import warnings
    >>> import jax, numpy as np, jaxlidar as jl
    >>> voxels = jl.VoxelMap.from_lad(np.ones((4, 4, 2)), voxel_size=1.0)
    >>> scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4)))
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always")
    ...     many = jl.simulate_many(
    ...         jl.Survey(jl.Lidar(), [(0, 2)]), scene, key=jax.random.key(0), max_orders=1, rtol=0.05
    ...     )
    >>> print(caught[0].message)
    1 of 1 footprints lie partly outside the voxel map: shot 0 with 50 % of its light
    """


def ground_heights(survey: Survey, scene: Scene, start_distance: float) -> Float[np.ndarray, " shots"]:
    """Return the heights, m, of the ground where each beam axis meets it; NaN where it meets none.

    `survey`, `scene` and `start_distance` as for `_points_on_ground`.

    **Raises:** ValueError for shots outside a ground of finite extent.
    """
    heights = _points_on_ground(survey, scene, start_distance)[:, 2]
    # A plane has no rim: an axis that does not meet it runs along it, and has no height. From a sensor it
    # may go anywhere.
    if scene.ground is None or isinstance(scene.ground.shape, Plane) or survey.has_sensor_position:
        return heights
    misses = np.flatnonzero(np.isnan(heights))
    if misses.size:
        numbers = ", ".join(map(str, misses[:5])) + (", ..." if misses.size > 5 else "")
        raise ValueError(
            f"position: {misses.size} of {len(survey)} shots do not meet the ground: shots {numbers}; "
            "admissible are shots above it: Survey.within keeps those, and simulate_many(..., "
            "beyond='miss') leaves the others empty"
        )
    return heights


def _points_on_ground(survey: Survey, scene: Scene, start_distance: float) -> Float[np.ndarray, "shots 3"]:
    """Return where each beam axis meets the ground, m; NaN where it meets none.

    `survey` and `scene` have the same origin of coordinates. `start_distance`: distance, m, before the
    reference plane, along the beam, at which rays start: that of a plan.
    """
    if scene.ground is None:
        return np.full((len(survey), 3), np.nan)
    # From where rays start, above the scene or at the sensor: a ray that starts on the reference plane would
    # miss ground above it.
    start = survey.aim_point - start_distance * survey.direction
    distance = _distances(scene.ground.shape, start, survey.direction)
    # A miss is at FAR; a tenth of that leaves room for rounding.
    distance = np.where(distance < 0.1 * FAR, distance, np.nan)
    return start + distance[:, None] * survey.direction


def _distance_along_axes(
    shape: AbstractShape, x: Float[Any, "shots 3"], w: Float[Any, "shots 3"]
) -> Float[Any, " shots"]:
    return shape.distance(vec(x.T), vec(w.T))


_compiled_distance = Program(_distance_along_axes)


def _distances(
    shape: AbstractShape, x: Float[np.ndarray, "shots 3"], w: Float[np.ndarray, "shots 3"]
) -> Float[np.ndarray, " shots"]:
    """Return the distances, m, to a shape from many points, block by block."""
    # Blocks of few sizes share compiled programs: outside of one, the loop over cells of a height field would
    # be compiled by every call.
    size = min(size_bucket(len(x)), _AXES_PER_BLOCK)
    distances = []
    for first in range(0, len(x), size):
        block = (a[first : first + size] for a in (x, w))
        rows = (np.concatenate([a, np.repeat(a[-1:], size - len(a), axis=0)]) for a in block)
        distances.append(np.asarray(_compiled_distance(shape, *map(as_array, rows)), float))
    return np.concatenate(distances)[: len(x)]


def ground_position(survey: Survey, scene: Scene) -> Float[np.ndarray, "shots 3"]:
    """Find where the beam axes of a survey meet the ground of a scene.

    Nothing is simulated: plants and plates do not count. `Waveforms.ground_position` has the same.

    **Arguments:**

    - `survey`: a `Survey`.
    - `scene`: a `Scene`.

    **Returns:** (shots, 3) x, y and z, m; NaN where an axis meets no ground.

    `Survey.within` keeps the shots that `simulate_many` admits: of those that are not NaN, all but the ones
    whose footprints lie partly off open terrain.

    **Raises:** TypeError for objects of the wrong type; ValueError for a survey and a scene whose `crs`
    differ.

    **Example:**

    >>> import jaxlidar as jl
    >>> survey = jl.Survey(jl.Lidar(altitude=500.0), position=[(0, 0)], zenith=45.0, azimuth=90.0)
    >>> print(jl.ground_position(survey, jl.Scene(ground=jl.Ground(height=100.0)))[0].round().astype(int))
    [-100    0  100]
    """
    check_kind("survey", survey, Survey, "a Survey")
    check_kind("scene", scene, Scene, "a Scene")
    common_system({"survey": survey.crs, "scene": scene.crs})
    ground, axis = scene.ground, survey.direction
    if ground is None:
        return np.full((len(survey), 3), np.nan)
    # About the middle of the survey, as single precision needs.
    origin = 0.5 * (survey.position[:, :2].min(axis=0) + survey.position[:, :2].max(axis=0))
    moved: Any = ground.moved(-origin)
    if moved is not None:
        survey, ground = survey.relative_to(origin), moved
    start_distance = AIM_DISTANCE
    if not survey.has_sensor_position:
        # Both bounds of every line, which a shape may return at different lines.
        lines = (np.repeat(a, 2, axis=0) for a in (survey.aim_point, axis))
        crossed, towards = ground.shape.crossing(*lines)
        met = towards < -_LEAST_COSINE
        start_distance = 1.0 - float(crossed[met].min()) if met.any() else 0.0
    points = _points_on_ground(survey, Scene(ground=ground), start_distance)
    return points + np.append(np.zeros(2) if moved is None else origin, 0.0)


def shots_on_ground(survey: Survey, scene: Scene, margin: float = 0.0) -> Bool[np.ndarray, " shots"]:
    """Return the shots that a simulation admits: footprints on open terrain, axes that meet other ground.

    `margin`: m from the border of open terrain, inwards.
    """
    ground, is_on = scene.ground, footprints_on_terrain(survey, scene, margin)
    has_border = not (ground is None or isinstance(ground, Terrain) or isinstance(ground.shape, Plane))
    if has_border and not survey.has_sensor_position:
        is_on &= np.isfinite(ground_position(survey, scene)[:, 2])
    return is_on


@shots_within.register
def _shots_within(survey: Survey, scene: Scene, margin: float) -> Bool[np.ndarray, " shots"]:
    """Return the shots that `Survey.within` keeps. **Raises:** as that."""
    check_kind("scene", scene, Scene, "a Scene")
    common_system({"survey": survey.crs, "scene": scene.crs})
    ground, box = scene.ground, _box(scene)
    is_within, extent = shots_on_ground(survey, scene, margin), box
    if isinstance(ground, Terrain) and ground.relief and ground.sides == "open":
        extent = np.stack([concrete_array(ground.origin), ground.end])
        if survey.has_sensor_position:
            place = ground_position(survey, scene)[:, :2]
            is_within = np.all((place >= extent[0] + margin) & (place <= extent[1] - margin), axis=1)
            is_within |= False if box is None else _meets_box(survey, box, margin)
    elif box is not None:
        is_within &= _meets_box(survey, box, margin)
    if not is_within.any():
        positions = survey.position[:, :2]
        of_shots = _extent_text(positions.min(axis=0), positions.max(axis=0))
        of_scene = "ground without their beams" if extent is None else _extent_text(*extent)
        raise ValueError(
            f"survey: no shot lies within the scene: positions are {of_shots}, the scene is {of_scene}, with "
            f"margin = {margin:g} m; are their coordinates those of one map?"
        )
    return is_within


def _extent_text(low: Float[np.ndarray, "axes"], high: Float[np.ndarray, "axes"]) -> str:
    return f"x = {low[0]:.2f} to {high[0]:.2f} m and y = {low[1]:.2f} to {high[1]:.2f} m"


def _box(scene: Scene) -> Float[np.ndarray, "2 3"] | None:
    """Return the corners of the box around a canopy with open sides and meshes that do not repeat, m."""
    corners = []
    if scene.canopy is not None and scene.canopy.sides == "open":
        voxels = scene.canopy.voxels
        # In double precision, as map coordinates need.
        low, size = (concrete_array(a) for a in (voxels.origin, voxels.voxel_size))
        corners += [low, low + size * voxels.shape]
    if scene.period is None:
        corners += [corner for mesh in scene.meshes for corner in mesh.bounds().reshape(-1, 3)]
    return np.stack([np.min(corners, axis=0), np.max(corners, axis=0)]) if corners else None


def _meets_box(survey: Survey, box: Float[np.ndarray, "2 3"], margin: float) -> Bool[np.ndarray, " shots"]:
    """Return the shots whose beam axes meet a box, with its sides `margin`, m, further inwards."""
    inwards = np.array([margin, margin, 0.0])
    # A ray along a face: so slow across it that it meets the other faces of its slab far away.
    rate = np.where(np.abs(survey.direction) < 1e-12, 1e-12, survey.direction)
    faces = np.stack([(corner - survey.sensor) / rate for corner in (box[0] + inwards, box[1] - inwards)])
    enter, leave = faces.min(axis=0).max(axis=1), faces.max(axis=0).min(axis=1)
    is_box = np.all(box[0] + inwards <= box[1] - inwards)
    return is_box & (np.maximum(enter, 0.0) <= leave)


def disc_of_footprint(survey: Survey, count: int) -> Float[np.ndarray, "count 2"]:
    """Return points of equal energy in a footprint of radius one, a Fibonacci lattice.

    r follows from the energy within r, 1 - exp(-2 r^2) of a Gaussian and r^2 of a top hat, and angles advance
    by the golden angle.
    """
    enclosed = (np.arange(count) + 0.5) / count
    gaussian = survey.lidar.profile == "gaussian"
    radius = np.sqrt(-0.5 * np.log1p(-enclosed) if gaussian else enclosed)
    angle = 2.0 * np.pi * GOLDEN * np.arange(count)
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def off_map(survey: Survey, scene: Scene) -> Float[np.ndarray, " shots"]:
    """Return the fraction of each footprint's light outside the voxel map, at the map's top or its bottom.

    1. Points of equal energy in a footprint of radius one.
    2. Stretched to the footprint on a level plane.
    3. Moved along the axis to the heights of the map's top and bottom.

    Only footprints near the rim of the map have any points outside; the others are not looked at.
    """
    canopy = scene.canopy
    # From a sensor, beams may look past the map on purpose.
    if canopy is None or canopy.sides == "periodic" or survey.has_sensor_position:
        return np.zeros(len(survey))
    low, high = (np.asarray(a, float) for a in (canopy.voxels.origin, canopy.voxels.top))
    disc = disc_of_footprint(survey, _POINTS)
    radius = np.linalg.norm(disc, axis=1)
    fractions = np.zeros(len(survey))
    # A disc around the longest side of the stretched footprint.
    direction = survey.direction
    reach = (survey.footprint_radius * radius.max() / -direction[:, 2])[:, None]
    near_rim = np.zeros(len(survey), bool)
    for z in (low[2], high[2]):
        middle = survey.position + z * direction[:, :2] / direction[:, 2:]
        near_rim |= np.any((middle - reach < low[:2]) | (middle + reach > high[:2]), axis=-1)
    shots = np.flatnonzero(near_rim)
    for first in range(0, len(shots), _SHOTS_PER_BLOCK):
        numbers = shots[first : first + _SHOTS_PER_BLOCK]
        block = survey.subset(numbers)
        axis, (first_axis, second_axis) = block.direction, block.level_footprint_axes
        points = disc[:, :1] * second_axis[:, None] + disc[:, 1:] * first_axis[:, None]
        points = block.position[:, None] + block.footprint_radius[:, None, None] * points
        outside = np.zeros(points.shape[:2], bool)
        for z in (low[2], high[2]):
            position = points + (z * axis[:, :2] / axis[:, 2:])[:, None]
            outside |= np.any((position < low[:2]) | (position > high[:2]), axis=-1)
        fractions[numbers] = outside.mean(axis=1)
    return fractions


def is_cut_off(canopy: Canopy) -> bool:
    """Return True if plants stand in the outermost columns of a voxel map: there may be more beyond."""
    for density in (canopy.voxels.leaf, canopy.voxels.bark):
        if density is not None:
            values = np.asarray(density)
            if values[[0, -1]].any() or values[:, [0, -1]].any():
                return True
    return False


def beams_are_narrow(survey: Survey, canopy: Canopy | None) -> bool:
    """Return True if the beams of all shots are narrower than a voxel, about the middle of its map."""
    if canopy is None:
        return False
    voxels, diameter = canopy.voxels, 2.0 * survey.footprint_radius
    if survey.has_sensor_position:
        # The footprint is that 1 m ahead of the sensor.
        middle = 0.5 * (np.asarray(voxels.origin, float) + np.asarray(voxels.top, float))
        diameter = diameter * np.linalg.norm(middle - survey.position, axis=1)
    return bool(np.max(diameter) < np.min(np.asarray(voxels.voxel_size)))


def off_map_message(fractions: Float[np.ndarray, " shots"]) -> str | None:
    """Return a sentence on the footprints that lie partly outside the map, or None where there are none."""
    shots = np.flatnonzero(fractions >= NOTABLE_FRACTION)
    if shots.size == 0:
        return None
    worst = shots[np.argsort(-fractions[shots], kind="stable")][:3]
    examples = ", ".join(f"shot {i} with {percent(float(fractions[i]))}" for i in worst)
    ellipsis = ", ..." if shots.size > 3 else ""
    pronoun = "its" if shots.size == 1 else "their"
    count = f"{shots.size} of {fractions.size} footprints"
    return f"{count} lie partly outside the voxel map: {examples}{ellipsis} of {pronoun} light"
