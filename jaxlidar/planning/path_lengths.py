"""Path lengths from the rim of the footprint to the bounds of a scene, from which loops get their lengths.

Surfaces and the canopy's map are met along lines around the beam: its axis, and a circle of lines a few
footprint radii out. All but a negligible fraction of the light lies between these lines.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._fields.checks import (
    array_namespace,
    concrete,
    concrete_array,
    concrete_number,
    fixed_array,
    has_tracers,
)
from jaxlidar._vectors import FAR, vec
from jaxlidar.planning.config import KERNEL_BINS
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.scenes.height_field import HeightField
from jaxlidar.scenes.mesh_surface import MeshMaterial, MeshSurface
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.shapes import Plane
from jaxlidar.scenes.surfaces import AbstractSheet, AbstractSurface
from jaxlidar.scenes.terrain import Terrain
from jaxlidar.sensors.lidar import AIM_DISTANCE, Lidar
from jaxlidar.sensors.survey import Survey

# Least distance, m, of a sensor from a surface, and least angle, degrees, of its beam from the level within a
# canopy that has no sides.
LEAST_CLEARANCE, LEAST_ELEVATION = 1e-3, 1.0
# Distance of a canopy or a mesh from all beams, m, beyond which it is in another place.
FARTHEST_SCENE = 1e5
# Pairs of a sensor and a triangle whose distance is looked at.
_SENSOR_TRIANGLE_PAIRS = 30_000_000
# Beams at a smaller angle, degrees, to a plane meet it beyond the record, which they would make endless.
LEAST_GRAZING_ANGLE = 0.5
# A flight crosses at most this many voxels, because a batch waits for its longest flight.
MAX_VOXELS = 16_384
# Fine bins of a ray segment at most: all deposits are spread over as many bins as the longest needs.
_MAX_SEGMENT_BINS = 64
# Bins that a segment touches besides those of its length: partial bins at both ends, and the kernel's.
_SEGMENT_MARGIN = 3
# Distance, m, beyond which nothing that repeats counts.
_ENDLESS = 1e7
# Bound on the rounding of positions in single precision: 16 units in the last place of their distance.
_ROUNDING = 2e-6
# Points of the rim of a footprint; those where footprints are many, and how many that is.
_RIM_POINTS, _COARSE_RIM_POINTS, _MANY_FOOTPRINTS = 32, 8, 1000
# Footprint radii out to the rim. Outside of 2.5 is 4e-6 of a Gaussian beam, outside of 2 is 3e-4.
_PATH_RADII, _TERRAIN_RADII = 2.5, 2.0
# Outside of these of a Gaussian beam is 1e-14 of the light: less than single precision resolves.
_REACH_RADII = 4.0


class TracedBeam(NamedTuple):
    """The beam of a lidar that a JAX transformation traces, in the form of a `Survey` of one shot."""

    direction: Any
    aim_point: Any
    slant_range: Any
    footprint_radius: Any
    zenith: Any
    has_sensor_position: bool
    lidar: Lidar

    @staticmethod
    def of(lidar: Lidar) -> "TracedBeam":
        """Return the beam of a lidar, with JAX arrays without derivatives."""
        values = (
            lidar.direction,
            lidar.aim_point,
            lidar.range_to_reference,
            lidar.footprint_radius,
            lidar.zenith,
        )
        values = (fixed_array(a, jnp)[None] for a in values)
        return TracedBeam(*values, lidar.has_sensor_position, lidar)

    @property
    def sensor(self) -> Any:
        """Position (1, 3) of the sensor in m."""
        return self.aim_point - self.slant_range[:, None] * self.direction


class FootprintRims(NamedTuple):
    """Lines along the axis of each beam, first, and around it.

    - `aim`: aim points, m. - `points`: where the lines cross the plane through the aim point across the
      beam, relative to it, m. - `rays`: unit vectors from the sensor to these points, `distance` m away.
    - `slant_range`: distance of the aim point from the sensor, m.
    """

    aim: Float[np.ndarray | Array, "shots lines 3"]
    points: Float[np.ndarray | Array, "shots lines 3"]
    rays: Float[np.ndarray | Array, "shots lines 3"]
    distance: Float[np.ndarray | Array, "shots lines"]
    slant_range: Float[np.ndarray | Array, "shots lines"]


def footprint_rims(survey: Survey | TracedBeam, n_radii: float) -> FootprintRims:
    """Return the axes of all beams, and lines around them `n_radii` footprint radii out."""
    axis, slant_range = survey.direction, survey.slant_range
    xp = array_namespace(axis)
    n_points = _RIM_POINTS if len(axis) <= _MANY_FOOTPRINTS else _COARSE_RIM_POINTS
    # A coarse polygon is laid about the rim instead of into it, so that it encloses the rim.
    polygon_inradius = 1.0 if n_points == _RIM_POINTS else np.cos(np.pi / n_points)
    radius = n_radii * survey.footprint_radius / polygon_inradius
    # Any direction across the axis; of x and y that which is not nearly along it.
    others = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]])
    across = xp.cross(axis, xp.where(xp.abs(axis[:, :1]) < 0.7, *others))
    across = across / xp.linalg.norm(across, axis=1, keepdims=True)
    third = xp.cross(axis, across)
    angle = np.linspace(0, 2 * np.pi, n_points + 1)[:, None]
    circle = np.cos(angle) * across[:, None] + np.sin(angle) * third[:, None]
    points = xp.pad(radius[:, None, None] * circle, ((0, 0), (1, 0), (0, 0)))
    rays = (axis * slant_range[:, None])[:, None] + points
    distance = xp.linalg.norm(rays, axis=2)
    aim = xp.broadcast_to(survey.aim_point[:, None], points.shape)
    slant_range = xp.broadcast_to(slant_range[:, None], distance.shape)
    return FootprintRims(aim, points, rays / distance[..., None], distance, slant_range)


class PathLengths:
    """Path lengths from the rim of the footprint to the bounds of everything in the scene.

    Those of a survey are bounds for all of its shots.

    1. Lines along the axis of each beam and around it (`footprint_rims`).
    2. Distances from the reference plane at which the lines cross surfaces, and the map's top and bottom.
    3. Their extremes are those of the paths; rays start before the nearest.

    - `first_path`, `last_path`: two-way path, m, of the first and the last return of order one, relative to
      that of the aim point.
    - `start_distance`: distance before the reference plane, m, at which all rays start.
    - `vertical`: True if all beams are at nadir.

    - `reaches_sensor`: with `xp` = jax.numpy, where all of these are JAX arrays: True if the scene reaches up
      to the sensor, or the sensor is where it cannot be.

    For shots that are placed by their sensors, paths count from these, and rays start there.

    **Raises:** ValueError where the scene reaches up to the sensor; and for a sensor below the ground or in a
    plate, and a level beam within a canopy that has no sides.
    """

    def __init__(self, lidar: Lidar, scene: Scene, survey: Survey | None = None, *, xp: Any = np):
        """`xp`: jax.numpy for a lidar or a scene that a JAX transformation traces; default numpy."""
        self.scene, self.xp = scene, xp
        # A traced lidar is one lidar: no survey is traced.
        shots = TracedBeam.of(lidar) if xp is jnp else Survey.of(lidar) if survey is None else survey
        self.from_sensor = shots.has_sensor_position
        self.vertical = xp is np and not np.any(shots.zenith) and not self.from_sensor
        self.reaches_sensor: Any = False
        if scene.canopy is not None:
            v = scene.canopy.voxels
            self.size, self.shape = fixed_array(v.voxel_size, xp), v.counts.astype(float)
        if self.from_sensor:
            self._from_sensors(shots)
            return
        # Lines of all shots alike.
        aim, points, self.rays, distance, slant_range = (
            array.reshape(-1, *array.shape[2:]) for array in footprint_rims(shots, _PATH_RADII)
        )
        # Distances from the reference plane at which rays meet surfaces, and the map's bottom and top.
        crossings = []
        for s, crossed, towards in self._surface_crossings(aim, points):
            # Sheets are met from both sides, the ground only from above.
            met = xp.abs(towards) > 1e-6 if isinstance(s, AbstractSheet) else towards < -1e-6
            crossings.append((crossed, met))
        radius = _PATH_RADII * shots.footprint_radius.max()
        for mesh in scene.meshes:
            lines = (points + aim, self.rays, radius, slant_range.min())
            crossings += _mesh_crossings(mesh, *lines, repeats=scene.period is not None)
        if scene.canopy is not None:
            low = fixed_array(scene.canopy.voxels.origin, xp)[2]
            for z in (low, low + self.size[2] * self.shape[2]):
                crossed = (z - points[:, 2]) / self.rays[:, 2]
                crossings.append((crossed, xp.ones_like(crossed, bool)))
        nearest, farthest = self._extremes(crossings, otherwise=0.0)
        self.first_path = 2.0 * nearest
        # Rays at the rim are longer than the axis, from which paths are counted. They are hypotenuses: the
        # difference of the squares keeps the digits that that of the lengths would lose.
        square = (points * points).sum(axis=1)
        self.last_path = 2.0 * (farthest + xp.max(square / (distance + slant_range)))
        # A twentieth of the extent before the first surface: the plan also serves scenes a little higher. Far
        # from the reference plane the margin exceeds the rounding of single precision: a ray that starts on a
        # surface misses it.
        margin = xp.maximum(1e-3, _ROUNDING * xp.maximum(xp.abs(nearest), xp.abs(farthest)))
        self.start_distance = 0.05 * (farthest - nearest) + margin - nearest
        least_range = xp.min(slant_range)
        if xp is jnp:
            self.reaches_sensor = self.start_distance >= least_range
            return
        self.first_path, self.last_path = float(self.first_path), float(self.last_path)
        self.start_distance = float(self.start_distance)
        if self.start_distance >= least_range:
            altitude = concrete_number(lidar.altitude)
            # The range of the aim point is in proportion to the altitude.
            lowest_altitude = altitude * self.start_distance / least_range
            raise ValueError(
                f"altitude = {altitude:g} m: the scene reaches up to the sensor; "
                f"admissible is more than {lowest_altitude:g} m"
            )

    def _from_sensors(self, shots: Survey | TracedBeam) -> None:
        """Set the path lengths of shots that are placed by their sensors.

        1. Refuse sensors within surfaces or below the ground, and endless rays.
        2. Distances from the sensor at which the lines meet planes, and the boxes of map and terrain.
        3. Their extremes, with the width of the beam to spare: between the lines it may reach the edge of a
           box a little earlier or later.
        """
        scene, xp = self.scene, self.xp
        if isinstance(shots, Survey):
            check_sensors(shots, scene)
        else:
            misplaced = [is_bad.any() for *_, is_bad in misplaced_sensors(shots, scene)]
            self.reaches_sensor = jnp.any(jnp.stack(misplaced)) if misplaced else False
        aim, points, self.rays, distance, _ = (
            array.reshape(-1, *array.shape[2:]) for array in footprint_rims(shots, _PATH_RADII)
        )
        sensor = aim + points - distance[:, None] * self.rays
        crossings = []
        radius = _PATH_RADII * shots.footprint_radius.max()
        for mesh in scene.meshes:
            lines, repeats = (sensor, self.rays, radius, AIM_DISTANCE), scene.period is not None
            crossings += _mesh_crossings(mesh, *lines, repeats=repeats, ahead=True)
        for s in scene.surfaces:
            if isinstance(s, Terrain) and s.relief:
                low, high = _box_of_terrain(s, xp)
                enter, leave = _distances_to_box(sensor, self.rays, low, high)
                met = (leave > enter) & (leave > 0)
                crossings += [(enter, met), (leave, met)]
        for s, crossed, towards in self._surface_crossings(aim, points):
            if isinstance(s, Terrain) and s.relief:
                continue
            least = math.sin(math.radians(LEAST_GRAZING_ANGLE))
            met = xp.abs(towards) > least if isinstance(s, AbstractSheet) else towards < -least
            crossed = crossed + distance
            crossings.append((crossed, met & (crossed > 0)))
        if scene.canopy is not None:
            v, sides = scene.canopy.voxels, scene.canopy.sides
            low, high = fixed_array(v.origin, xp), fixed_array(v.top, xp)
            if sides == "periodic":
                low, high = (
                    xp.append(np.full(2, sign * np.inf), z) for sign, z in ((-1, low[2]), (1, high[2]))
                )
            enter, leave = _distances_to_box(sensor, self.rays, low, high)
            crossings += [(enter, leave > enter), (leave, leave > enter)]
        nearest, farthest = self._extremes(crossings, otherwise=AIM_DISTANCE)
        spread = 2.0 * _PATH_RADII * shots.footprint_radius.max() / AIM_DISTANCE
        nearest = xp.maximum(nearest, 0.0) * xp.maximum(1.0 - spread, 0.0)
        self.first_path, self.last_path = 2.0 * nearest, 2.0 * farthest * (1.0 + spread)
        if xp is np:
            self.first_path, self.last_path = float(self.first_path), float(self.last_path)
        self.start_distance = AIM_DISTANCE

    def _surface_crossings(self, aim: Any, points: Any) -> Iterator[tuple[AbstractSurface, Any, Any]]:
        """Yield surfaces that are no meshes, with the distances and cosines at which lines cross them."""
        for surface in self.scene.surfaces:
            if isinstance(surface, MeshMaterial):
                continue
            if self.xp is np:
                yield surface, *surface.shape.crossing(points + aim, self.rays)
                continue
            # About the aim point, as the tracer has it: in single precision map coordinates have no digits
            # for heights.
            try:
                yield surface, *surface.shape.moved(-aim[0]).crossing(points, self.rays)
            except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError):
                # A shape of the user's that computes with NumPy.
                continue

    def _extremes(self, crossings: list[tuple[Any, Any]], otherwise: float) -> tuple[Any, Any]:
        """Return the smallest and the largest distance at which lines meet anything, or `otherwise`."""
        xp = self.xp
        if not crossings:
            return (xp.asarray(otherwise),) * 2
        distance, met = (xp.concatenate(arrays) for arrays in zip(*crossings))
        is_any = met.any()
        extremes = xp.where(met, distance, xp.inf).min(), xp.where(met, distance, -xp.inf).max()
        nearest, farthest = (xp.where(is_any, extreme, otherwise) for extreme in extremes)
        return nearest, farthest

    @property
    def _least_cosine(self) -> Any:
        """Least cosine of any ray to the vertical; not zero, as level rays have."""
        return self.xp.maximum(self.xp.abs(self.rays[:, 2]).min(), 1e-9)

    def _ceil(self, x: Any) -> Any:
        """Round a bound up; a value that is above a whole number by rounding of single precision, down."""
        return math.ceil(x) if self.xp is np else jnp.ceil(x * (1.0 - 1e-5))

    @property
    def longest_chord(self) -> Any:
        """Longest chord, m, of a footprint ray within one voxel."""
        if self.scene.canopy is None:
            return 1e-3
        # A chord ends at the voxel's diagonal, or where the most inclined ray leaves the layer. The relative
        # slack covers the rounding of single precision.
        least_cosine = self._least_cosine
        chord = self.xp.minimum(self.xp.linalg.norm(self.size), self.size[2] / least_cosine) * (1 + 1e-5)
        return float(chord) if self.xp is np else chord

    def max_ray_segments(self, max_segment: Any) -> Any:
        """Return a bound on the number of segments of a footprint ray, none longer than `max_segment` m.

        A segment ends where the ray leaves a layer, crosses a side face, has the greatest length, or meets a
        surface. Side faces are as many as columns that the ray passes over the height of the map.
        """
        if self.scene.canopy is None:
            return 0
        xp, least_cosine = self.xp, self._least_cosine
        height = self.size[2] * self.shape[2]
        rates = xp.abs(self.rays[:, :2]).max(0) / least_cosine * height / self.size[:2]
        columns = [self._ceil(rate) + 1 for rate in rates]
        if self.scene.canopy.sides == "open":
            # Rays that leave an open map do not come back.
            columns = [xp.minimum(n, side) for n, side in zip(columns, self.shape)]
        longest = height / least_cosine
        if self.scene.canopy.sides == "open":
            longest = xp.minimum(longest, xp.linalg.norm(self.size * self.shape))
        divided = xp.where(max_segment >= self.longest_chord, 0, self._ceil(longest / max_segment))
        count = self.shape[2] + sum(columns) + divided + len(self.scene.surfaces) + 2
        return int(count) if xp is np else count

    def longest_flight(self, path: Any) -> Any:
        """Return the length, m, up to which flights are followed.

        It includes all flights whose light returns within `path` m of the first return. Within a periodic
        canopy light could fly on almost for ever: under a beam of more than 64 degrees the length is
        at most ten times the sum of `path` and the height of the canopy, and no flight crosses more than
        `MAX_VOXELS` voxels.
        """
        if self.scene.canopy is None or self.scene.canopy.sides == "open":
            return FAR
        if self.from_sensor:
            # No flight is longer than the path that it is part of.
            return self._affordable(path)
        # Let theta be the beam's zenith angle. A flight of s m within the canopy, up by at most its height,
        # comes closer to the sensor by at most s sin(theta) + height cos(theta). So it lengthens the path by
        # at least s (1 - sin(theta)) - height cos(theta).
        height, cosine = self.size[2] * self.shape[2], self.xp.abs(self.rays[:, 2]).min()
        sine = self.xp.linalg.norm(self.rays[:, :2], axis=1).max()
        return self._affordable((path + height * cosine) / self.xp.maximum(1.0 - sine, 0.1))

    def _affordable(self, flight: Any) -> Any:
        flight = self.xp.minimum(flight, self.longest_affordable_flight)
        return float(flight) if self.xp is np else flight

    @property
    def longest_affordable_flight(self) -> Any:
        """Length, m, of the longest flight through a periodic canopy that crosses at most `MAX_VOXELS`."""
        length = self.xp.maximum(MAX_VOXELS - self.shape[2], 1) / self.xp.sum(1.0 / self.size[:2])
        return float(length) if self.xp is np else length

    def max_faces(self, path: Any) -> Any:
        """Return a bound on the number of voxel faces that a flight of `longest_flight(path)` crosses."""
        if self.scene.canopy is None:
            return 0
        if self.scene.canopy.sides == "open":
            count = self.shape.sum() + 3
            return int(count) if self.xp is np else count
        return self.voxels_along(self.longest_flight(path))

    def voxels_along(self, flight: Any) -> Any:
        """Return a bound on the voxels of a periodic canopy that a flight of that length, m, crosses."""
        # A flight crosses each layer once. Three more, one for each axis, as it starts within a voxel.
        count = self.shape[2] + sum(self._ceil(flight / s) for s in self.size[:2]) + 3
        return int(count) if self.xp is np else count


def _box_of_terrain(terrain: Terrain, xp: Any) -> tuple[Any, Any]:
    """Return the lowest and the highest corner, m, of the box that holds a terrain; endless if it repeats."""
    heights = fixed_array(terrain.heights, xp)
    low, high = (xp.append(a, z) for a, z in zip(_extent(terrain, xp), (heights.min(), heights.max())))
    # Rounding of single precision, in which rays meet the terrain.
    slack = 1e-3 + _ROUNDING * xp.abs(heights).max()
    slack = slack * np.array([0.0, 0.0, 1.0])
    return low - slack, high + slack


def _extent(terrain: Terrain, xp: Any) -> tuple[Any, Any]:
    if terrain.sides == "periodic":
        return xp.full(2, -np.inf), xp.full(2, np.inf)
    origin, spacing = fixed_array(terrain.origin, xp), fixed_array(terrain.spacing, xp)
    return origin, origin + spacing * (np.asarray(terrain.heights.shape, float) - 1.0)


def _distances_to_box(start: Any, rays: Any, low: Any, high: Any) -> tuple[Any, Any]:
    """Return where rays enter a box, m, zero from within, and leave it; one number where they miss it."""
    # A ray along a face never crosses it: so far away that it does not count.
    xp = array_namespace(rays)
    rate = xp.where(xp.abs(rays) < 1e-12, 1e-12, rays)
    a, b = (low - start) / rate, (high - start) / rate
    enter = xp.maximum(xp.minimum(a, b).max(axis=1), 0.0)
    leave = xp.maximum(xp.maximum(a, b).min(axis=1), enter)
    return enter, leave


def misplaced_sensors(shots: Survey | TracedBeam, scene: Scene) -> Iterator[tuple[str, Any, Any]]:
    """Yield for each surface where a sensor cannot be, its distance, m, above it, and True if it is there.

    Last is the angle from the level of beams within a canopy that has no sides.
    """
    xp = array_namespace(shots.direction)
    for surface in scene.surfaces:
        if isinstance(surface, MeshMaterial):
            # Meshes need not be closed: none of their sides is the inside.
            continue
        height = _height_above(surface, shots.sensor)
        if height is not None:
            is_sheet = isinstance(surface, AbstractSheet)
            distance = xp.abs(height) if is_sheet else height
            yield "in a plate" if is_sheet else "below the ground", height, distance < LEAST_CLEARANCE
    if scene.canopy is not None and scene.canopy.sides == "periodic":
        off_level = xp.abs(shots.zenith - 90.0)
        yield "level", off_level, off_level < LEAST_ELEVATION


def check_sensors(shots: Survey, scene: Scene) -> None:
    """Refuse sensors below the ground, in a plate or a triangle, and level beams in a canopy without sides.

    **Raises:** ValueError with the shot and the numbers.
    """
    sensor, which = shots.sensor, "" if len(shots) == 1 else f" of shot {{}} of {len(shots)}"
    for surface in scene.surfaces:
        if isinstance(surface, MeshMaterial) and surface.mesh.surfaces[0].name == surface.name:
            _check_clear_of_triangles(shots, surface.mesh)
    for where, height, is_bad in misplaced_sensors(shots, scene):
        if not is_bad.any():
            continue
        i = int(np.argmax(is_bad))
        if where != "level":
            raise ValueError(
                # The height alone is the user's where a scene was moved to its local origin.
                f"sensor{which.format(i)} at the height {sensor[i, 2]:.9g} m is {where}, "
                f"{float(height[i]):.3g} m above it; admissible is more than {LEAST_CLEARANCE:g} m"
            )
        raise ValueError(
            f"zenith{which.format(i)} = {float(shots.zenith[i]):g} degrees within a canopy with periodic "
            f"sides, which a level beam never leaves; admissible is {LEAST_ELEVATION:g} degree or more "
            "from 90, or sides = 'open'"
        )


def _check_clear_of_triangles(shots: Survey, mesh: MeshSurface) -> None:
    """Refuse a sensor in a triangle: by rounding it would be on either side.

    Sensors outside of the boxes of all instances are clear. Where many are within, such as that of a
    vehicle in a city, so many pairs are looked at that it takes about a second.

    **Raises:** ValueError with the shot.
    """
    if has_tracers(mesh):
        return
    sensor, shot = np.unique(shots.sensor, axis=0, return_index=True)
    boxes = mesh.bounds()
    boxes = np.stack([boxes[:, 0] - LEAST_CLEARANCE, boxes[:, 1] + LEAST_CLEARANCE], axis=1)
    is_within = ((sensor > boxes[:, 0].min(axis=0)) & (sensor < boxes[:, 1].max(axis=0))).all(axis=1)
    n_pairs, corners = 0, None
    for i in np.flatnonzero(is_within):
        around = ((sensor[i] > boxes[:, 0]) & (sensor[i] < boxes[:, 1])).all(axis=1)
        for instance in np.flatnonzero(around):
            if n_pairs > _SENSOR_TRIANGLE_PAIRS:
                return
            corners = mesh.local_corners() if corners is None else corners
            n_pairs += len(corners)
            local, scale = mesh.to_local(sensor[i], int(instance))
            clearance = LEAST_CLEARANCE / scale
            low, high = corners.min(axis=1) - clearance, corners.max(axis=1) + clearance
            near = corners[((local > low) & (local < high)).all(axis=1)]
            if len(near) and _distance_to_triangles(local, near).min() < clearance:
                which = "" if len(shots) == 1 else f" of shot {shot[i]} of {len(shots)}"
                raise ValueError(
                    f"sensor{which} at the height {sensor[i, 2]:.9g} m is in a triangle of a mesh; "
                    f"admissible is more than {LEAST_CLEARANCE:g} m from it"
                )


def _distance_to_triangles(
    point: Float[np.ndarray, "3"], corners: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, " n"]:
    """Return the distances of a point from triangles: from their planes where it is over them, else edges."""
    start, edge = corners, np.roll(corners, -1, axis=1) - corners
    normal = np.cross(edge[:, 0], edge[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    inward = np.cross(normal[:, None], edge)
    is_over = (np.sum((point - start) * inward, axis=2) >= 0).all(axis=1)
    to_plane = np.abs(np.sum((point - start[:, 0]) * normal, axis=1))
    length = np.maximum(np.sum(edge * edge, axis=2), 1e-300)
    along_edge = np.clip(np.sum((point - start) * edge, axis=2) / length, 0.0, 1.0)
    to_edges = np.linalg.norm(point - start - along_edge[..., None] * edge, axis=2).min(axis=1)
    return np.where(is_over, to_plane, to_edges)


def _height_above(surface: AbstractSurface, sensor: Any) -> Any:
    """Return distances, m, of sensors from a surface, positive above it; None where the shape states none.

    In double precision about the first sensor, as map coordinates need.
    """
    if array_namespace(sensor) is jnp:
        # About the sensor, as the tracer has it about the aim point.
        shape = surface.shape.moved(-sensor[0])
        if isinstance(shape, HeightField):
            zero = vec(jnp.zeros((1,)) for _ in range(3))
            return -lax.stop_gradient(shape.heights.value_and_slope(zero)[0])
        if not isinstance(shape, Plane):
            return None
        return -jnp.sum(fixed_array(shape.foot, jnp) * fixed_array(shape.upward, jnp))[None]
    origin = sensor[0].copy()
    local = sensor - [origin[0], origin[1], 0.0]
    if isinstance(surface, Terrain) and surface.relief:
        ground = np.asarray(surface.height_at(*_clipped(surface, sensor).T), float)
        return sensor[:, 2] - ground
    moved = surface.moved(-origin[:2])
    shape = (surface if moved is None else moved).shape
    if not isinstance(shape, Plane):
        return None
    local = sensor if moved is None else local
    normal, foot = concrete_array(shape.upward), concrete_array(shape.foot)
    return (local - foot) @ normal


def _clipped(terrain: Terrain, sensor: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Return horizontal positions, those off the terrain moved to its border."""
    low, high = _extent(terrain, np)
    return np.clip(sensor[:, :2], low, high)


def _mesh_crossings(
    mesh: MeshSurface,
    points: Any,
    rays: Any,
    radius: Any,
    slant_range: Any,
    *,
    repeats: bool,
    ahead: bool = False,
) -> list[tuple[Any, Any]]:
    """Return the distances from points along lines at which these enter and leave the box around a mesh.

    **Returns:** twice (lines,) distances, m, and (lines,) True for lines that meet the box.

    A mesh may lie between the lines of a footprint. A ray of it is displaced from the axis by at most its
    radius, across the axis: the box is enlarged by that much for each line. With `ahead`, the points are
    sensors, at which lines start: what lies behind them is not met. With `repeats` copies of the mesh fill
    the layer in which it lies.
    """
    xp = array_namespace(rays)
    boxes = mesh.bounds(xp)
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    if repeats:
        low = xp.append(points[:, :2].min(axis=0) - _ENDLESS, low[2])
        high = xp.append(points[:, :2].max(axis=0) + _ENDLESS, high[2])
    # Beyond the aim point, beams are wider.
    if ahead and repeats:
        # Level beams end where the tracer gives up, far beyond any record.
        depth = xp.maximum(xp.abs(low[2] - points[:, 2]), xp.abs(high[2] - points[:, 2]))
        beyond = (depth / xp.maximum(xp.abs(rays[:, 2]), 1e-3)).max()
    elif ahead:
        # No point of the box is farther from a sensor than the farthest corner.
        farthest_corner = xp.maximum(xp.abs(low - points), xp.abs(high - points))
        beyond = xp.linalg.norm(farthest_corner, axis=1).max()
    else:
        beyond = xp.maximum(xp.abs(low[2]), xp.abs(high[2]))
    widened = radius * (1.0 + beyond / slant_range)
    margin = widened * xp.sqrt(xp.maximum(1.0 - rays * rays, 0.0))
    rates = xp.where(xp.abs(rays) < 1e-12, 1e-12, rays)
    faces = xp.stack([(low - margin - points) / rates, (high + margin - points) / rates])
    enter, leave = faces.min(axis=0).max(axis=1), faces.max(axis=0).min(axis=1)
    enter = xp.maximum(enter, 0.0) if ahead else enter
    is_met = enter <= leave
    return [(enter, is_met), (leave, is_met)]


def meshes_are_in_reach(shots: Lidar | Survey, scene: Scene, xp: Any = np) -> Any:
    """Return True if unscattered light may meet a mesh; also where JAX is tracing a mesh.

    `xp`: jax.numpy for a lidar that a JAX transformation traces; default numpy.
    """
    if has_tracers(scene.meshes):
        return True
    single = TracedBeam if xp is jnp else Survey
    survey = shots if isinstance(shots, Survey) else single.of(shots)
    n_radii = _REACH_RADII if survey.lidar.profile == "gaussian" else 1.0
    rims = footprint_rims(survey, n_radii)
    points, rays = (a.reshape(-1, 3) for a in (rims.points + rims.aim, rims.rays))
    ahead = survey.has_sensor_position
    if ahead:
        points = points - rims.distance.reshape(-1, 1) * rays
    radius, slant_range = n_radii * survey.footprint_radius.max(), rims.slant_range.min()
    repeats = scene.period is not None
    is_met: Any = False
    for mesh in scene.meshes:
        crossings = _mesh_crossings(mesh, points, rays, radius, slant_range, repeats=repeats, ahead=ahead)
        is_met = is_met | crossings[0][1].any()
    return is_met


def longest_segment(chord: float, bin_length: float, max_step: float | None) -> tuple[float, int]:
    """Return the longest ray segment, m, of order one, and the number of bins that its deposit spans.

    `chord` is the longest chord within one voxel, `max_step` the user's limit. Without it the number of bins
    is a size bucket, and segments may be somewhat longer than the chord, so that one plan serves other
    directions, too.
    """
    # The slack of 1e-6 keeps a whole number of bins from being rounded up; 2 % are for other directions.
    if max_step is not None:
        segment = min(max_step, chord)
        return segment, max(math.ceil(segment / bin_length - 1e-6) + _SEGMENT_MARGIN, KERNEL_BINS)
    bins = min(math.ceil(1.02 * chord / bin_length), _MAX_SEGMENT_BINS)
    span = max(size_bucket(bins + _SEGMENT_MARGIN, 4), KERNEL_BINS)
    return (span - _SEGMENT_MARGIN) * bin_length, span


def footprint_is_off_terrain(lidar: Lidar, scene: Scene) -> Any:
    """Return True where `check_footprints_on_terrain` refuses, of what a JAX transformation traces."""
    ground = scene.ground
    if not (isinstance(ground, Terrain) and ground.relief and ground.sides == "open"):
        return False
    if lidar.has_sensor_position:
        return False
    beam = TracedBeam.of(lidar)
    rims = footprint_rims(beam, _TERRAIN_RADII if lidar.profile == "gaussian" else 1.0)
    shape = ground.shape.moved(-beam.aim_point[0])
    assert isinstance(shape, HeightField)
    box, _, _ = shape.height_bounds_below(rims.points[0], rims.rays[0])
    origin, end = (corner - beam.aim_point[0, :2] for corner in _extent(ground, jnp))
    # Rounding of single precision.
    slack = 1e-5 * (end - origin)
    return jnp.any((box[0] < origin - slack) | (box[1] > end + slack))


def check_scene_near_beams(shots: Lidar | Survey, scene: Scene) -> None:
    """Refuse a canopy or a mesh that is hundreds of kilometres away from all beams: its map is another one.

    Distances are those of the axes of beams from a sphere around everything.

    **Raises:** ValueError with the distance.
    """
    survey = shots if isinstance(shots, Survey) else Survey.of(shots)
    boxes: dict[str, Any] = {}
    if scene.canopy is not None and scene.canopy.sides == "open":
        voxels = scene.canopy.voxels
        boxes["canopy"] = [concrete(a) for a in (voxels.origin, voxels.top)]
    if scene.period is None:
        for i, mesh in enumerate(scene.meshes):
            if not has_tracers(mesh):
                bounds = mesh.bounds()
                boxes[f"meshes[{i}]"] = [bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)]
    for name, (low, high) in boxes.items():
        if low is None or high is None:
            continue
        offset = 0.5 * (low + high) - survey.aim_point
        along_beam = np.sum(offset * survey.direction, axis=1, keepdims=True)
        to_axes = np.linalg.norm(offset - along_beam * survey.direction, axis=1)
        distance = float(to_axes.min()) - 0.5 * float(np.linalg.norm(high - low))
        if distance > FARTHEST_SCENE:
            raise ValueError(
                f"{name} is {1e-3 * distance:.4g} km away from every beam; admissible is up to "
                f"{1e-3 * FARTHEST_SCENE:g} km: are its coordinates those of another map?"
            )


def check_footprints_on_terrain(shots: Lidar | Survey, scene: Scene) -> None:
    """Refuse footprints that lie partly off open terrain. 3e-4 of a Gaussian beam may lie off it.

    **Raises:** ValueError with the shot, both extents, and the way out.
    """
    survey = shots if isinstance(shots, Survey) else Survey.of(shots)
    if not has_border(survey, scene):
        return
    terrain: Any = scene.ground
    rims, (origin, end) = _terrain_rims(survey), _extent(terrain, np)
    near_border = np.flatnonzero(_near_border(rims, survey, terrain, 0.0)[0])
    for i, box, lowest, highest in _boxes_on_terrain(rims, survey, near_border, terrain):
        if np.all(box[0] >= origin) and np.all(box[1] <= end):
            continue
        footprint = "the footprint" if len(survey) == 1 else f"the footprint of shot {i} of {len(survey)}"
        extents = (
            f"{axis} = {a:.2f} to {b:.2f} m"
            for span in (box, (origin, end))
            for axis, a, b in zip("xy", *span)
        )
        raise ValueError(
            "{} lies off the terrain: between heights of {:.6g} and {:.6g} m it takes in {} and {}; the "
            "terrain has {} and {}; admissible are footprints on it: Survey.within keeps those, and "
            "simulate_many(..., beyond='miss') leaves the others empty".format(
                footprint, lowest, highest, *extents
            )
        )


def footprints_on_terrain(survey: Survey, scene: Scene, margin: float = 0.0) -> Bool[np.ndarray, " shots"]:
    """Return the shots that `check_footprints_on_terrain` admits, `margin`, m, or more within the border."""
    is_on = np.ones(len(survey), bool)
    if has_border(survey, scene):
        terrain: Any = scene.ground
        rims, (origin, end) = _terrain_rims(survey), _extent(terrain, np)
        may_be_off, is_off = _near_border(rims, survey, terrain, margin)
        is_on = ~is_off
        undecided = np.flatnonzero(may_be_off & ~is_off)
        for i, box, _, _ in _boxes_on_terrain(rims, survey, undecided, terrain):
            is_on[i] = np.all(box[0] >= origin + margin) and np.all(box[1] <= end - margin)
    return is_on


def has_border(survey: Survey, scene: Scene) -> bool:
    """Return True if footprints must lie on open terrain. A sensor may look past its border."""
    ground = scene.ground
    is_open = isinstance(ground, Terrain) and ground.relief and ground.sides == "open"
    return is_open and not survey.has_sensor_position


def _near_border(
    rims: FootprintRims, survey: Survey, terrain: Any, margin: float
) -> tuple[Bool[np.ndarray, " shots"], Bool[np.ndarray, " shots"]]:
    """Return the shots that may lie partly off a terrain, and those that do for sure.

    Between the terrain's extreme heights all rays meet the ground. A shot may be off it if a ray crosses the
    border in between, and is off it if a ray lies beyond it at both heights.

    `margin`: m by which the border is moved inwards.
    """
    origin, end = _extent(terrain, np)
    heights = concrete_array(terrain.heights)
    # Rays that do not go down meet no ground: a tiny slope puts them far off the terrain.
    downward = np.minimum(rims.rays[..., 2], -1e-9)
    steps = [(z - rims.points[..., 2]) / downward for z in (heights.min(), heights.max())]
    may_be_off, is_off = np.zeros((2, len(survey)), bool)
    # Coordinate by coordinate: NumPy reduces long rows many times faster than columns of two.
    for k in range(2):
        places = rims.points[..., k] + survey.position[:, k, None]
        ends = [places + rims.rays[..., k] * step for step in steps]
        for a, b in ([e < origin[k] + margin for e in ends], [e > end[k] - margin for e in ends]):
            may_be_off |= np.any(a | b, axis=1)
            is_off |= np.any(a & b, axis=1)
    return may_be_off, is_off


def _boxes_on_terrain(
    rims: FootprintRims, survey: Survey, shots: Int[np.ndarray, " n"], terrain: Terrain
) -> Iterator[tuple[int, Float[np.ndarray, "2 2"], float, float]]:
    """Yield shots, and the extents of their footprints between the heights beneath their own rays, m.

    After the extent come these heights, the lowest and the highest, m.
    """
    if not shots.size:
        return
    # About the south-west corner: single precision has no digits for map coordinates. Converted once, as the
    # whole terrain would be for each shot.
    corner = concrete_array(terrain.origin)
    shape = jax.tree.map(concrete_array, terrain.moved(-corner).shape)
    assert isinstance(shape, HeightField)
    for i in shots.tolist():
        points = rims.points[i] + np.append(survey.position[i] - corner, 0.0)
        box, lowest, highest = shape.height_bounds_below(points, rims.rays[i])
        yield i, np.asarray(box) + corner, lowest, highest


def _terrain_rims(survey: Survey) -> FootprintRims:
    return footprint_rims(survey, _TERRAIN_RADII if survey.lidar.profile == "gaussian" else 1.0)
