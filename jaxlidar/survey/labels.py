"""Labels of discrete returns: which copy of a mesh was hit, its normal there, and the incidence angle.

The tracer sums the light of a footprint and keeps nothing of what rays meet, so labels are found afterwards:

1. Rays of equal energy leave the sensor of each shot, over the footprint as a Fibonacci disc.
2. A ray meets the ground or a triangle, whichever is nearer, and all plates on the way. Voxels do not stop
   it: their light is expected light, without a surface.
3. What it meets belongs to the return of its shot that is nearest in range, among those of its material, and
   no farther from it than the return is wide at half its maximum.
4. A return is labelled with the copy that most of its rays meet, and with the mean of their unit normals, on
   the side of the sensor.

Shots whose returns have no ray are looked at again with more rays, as a twig fills little of a footprint.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fields.checks import as_array
from jaxlidar._jax.programs import Program
from jaxlidar._vectors import FAR, Vec, along, vec
from jaxlidar.planning.channels import surface_names
from jaxlidar.planning.local_origin import move_aim_to_origin
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.scenes.mesh_surface import MeshSurface, MeshTree, build_mesh_tree
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.shapes import AbstractShape
from jaxlidar.sensors.survey import Survey
from jaxlidar.survey.coverage import disc_of_footprint

# Rays of a shot in the first round, and in the second one where returns have none; rays of a block.
_RAYS, _BLOCK = (24, 600), 1 << 16
# Distance, m, before the first return of a shot at which its rays start: single precision resolves it.
_AHEAD = 100.0


class Labels(NamedTuple):
    """Labels of returns.

    - `instance`: number of the copy that was hit, from 1; 0 for none. - `normal`: unit vectors, on the side
      of the sensor; NaN for none. - `incidence`: degrees between the beam and the normal; NaN for none.
    """

    instance: Int[np.ndarray, " returns"]
    normal: Float[np.ndarray, "returns 3"]
    incidence: Float[np.ndarray, " returns"]


class _Hits(NamedTuple):
    """What rays meet: the number of the shot and of the surface, range, m, instance, and unit normal."""

    shot: Int[np.ndarray, " hits"]
    surface: Int[np.ndarray, " hits"]
    range: Float[np.ndarray, " hits"]
    instance: Int[np.ndarray, " hits"]
    normal: Float[np.ndarray, "hits 3"]


def labels_of(
    shot: Int[np.ndarray, " returns"],
    range_: Float[np.ndarray, " returns"],
    width: Float[np.ndarray, " returns"],
    material: Shaped[np.ndarray, " returns"],
    survey: Survey,
    scene: Scene,
) -> Labels:
    """Find the labels of returns, which are sorted by shot and range; `range_` is the true one, m."""
    count = len(shot)
    labels = Labels(np.zeros(count, int), np.full((count, 3), np.nan), np.full(count, np.nan))
    names = surface_names(scene)
    numbers = {name: number for number, name in enumerate(names)}
    surface = np.array([numbers.get(name, -1) for name in material.tolist()], int)
    tracer = _FirstHits(survey, scene)
    waits = surface >= 0
    for n_rays in _RAYS:
        (waiting,) = np.nonzero(waits)
        if not waiting.size:
            break
        shots, first = np.unique(shot[waiting], return_index=True)
        start = np.maximum(range_[waiting[first]] - _AHEAD, 0.0)
        # Returns by surface, shot and range: those of one shot and surface are neighbours.
        order = waiting[np.lexsort((range_[waiting], shot[waiting], surface[waiting]))]
        per_block = max(_BLOCK // n_rays, 1)
        found = []
        for block in range(0, shots.size, per_block):
            rows = slice(block, block + per_block)
            hits = tracer.hits(shots[rows], start[rows], n_rays)
            index = _nearest_return(hits, order, surface, shot, range_, 0.5 * SPEED_OF_LIGHT * width)
            is_found = index >= 0
            found.append((index[is_found], hits.instance[is_found], hits.normal[is_found]))
        index, instance, normal = (np.concatenate(column) for column in zip(*found))
        _write(labels, index, instance, normal, survey.direction[shot])
        waits &= np.isnan(labels.incidence)
    return labels


def _nearest_return(
    hits: _Hits,
    order: Int[np.ndarray, " waiting"],
    surface: Int[np.ndarray, " returns"],
    shot: Int[np.ndarray, " returns"],
    range_: Float[np.ndarray, " returns"],
    reach: Float[np.ndarray, " returns"],
) -> Int[np.ndarray, " hits"]:
    """Return the number of the return that each hit belongs to; -1 for none.

    `order`: returns by surface, shot and range. `reach`: m from a return within which its hits lie.
    """
    farthest = 1.0 + max(float(range_[order].max()), float(hits.range.max(initial=0.0)))
    n_shots = int(shot[order].max()) + 1

    def key(surface: np.ndarray, shot: np.ndarray, range_: np.ndarray) -> np.ndarray:
        return (surface * n_shots + shot) * farthest + range_

    sorted_keys = key(surface[order], shot[order], range_[order])
    position = np.searchsorted(sorted_keys, key(hits.surface, hits.shot, hits.range))
    nearest, best = np.full(len(hits.shot), -1), np.full(len(hits.shot), np.inf)
    for neighbour in (position - 1, position):
        number = order[np.clip(neighbour, 0, len(order) - 1)]
        distance = np.abs(range_[number] - hits.range)
        is_same = (shot[number] == hits.shot) & (surface[number] == hits.surface)
        is_nearer = is_same & (distance <= reach[number]) & (distance < best)
        nearest, best = np.where(is_nearer, number, nearest), np.where(is_nearer, distance, best)
    return nearest


def _write(
    labels: Labels,
    index: Int[np.ndarray, " hits"],
    instance: Int[np.ndarray, " hits"],
    normal: Float[np.ndarray, "hits 3"],
    axis: Float[np.ndarray, "returns 3"],
) -> None:
    """Write the labels of returns that have hits: the instance of most of them, and their mean normal."""
    pairs, pair, count = np.unique(
        np.stack([index, instance]), axis=1, return_inverse=True, return_counts=True
    )
    # The last pair of a return, in the order of its counts, is that with most of its hits.
    order = np.lexsort((count, pairs[0]))
    chosen = order[np.flatnonzero(np.diff(pairs[0][order], append=-1))]
    sums = np.zeros((pairs.shape[1], 3))
    np.add.at(sums, pair.ravel(), normal)
    mean = sums[chosen] / np.linalg.norm(sums[chosen], axis=1, keepdims=True)
    number = pairs[0][chosen]
    labels.instance[number], labels.normal[number] = pairs[1][chosen], mean
    cosine = -np.sum(mean * axis[number], axis=1)
    labels.incidence[number] = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))


class _FirstHits:
    """Rays over the footprints of a survey, and what they meet first in a scene."""

    def __init__(self, survey: Survey, scene: Scene):
        middle = survey.middle
        moved_lidar, local = move_aim_to_origin(middle, scene)
        is_moved = not np.any(np.asarray(moved_lidar.position)[:2])
        self.survey, self.scene = survey, local
        self.origin = np.append(np.asarray(middle.position, float)[:2] * is_moved, 0.0)
        self.tree = build_mesh_tree(local.meshes, local.period) if local.meshes else None
        self.of_copies, self.of_triangles = _stated_instances(scene.meshes)
        self.first_material = int(scene.ground is not None) + len(scene.plates)

    def hits(
        self, shots: Int[np.ndarray, " shots"], start: Float[np.ndarray, " shots"], n_rays: int
    ) -> _Hits:
        """Follow rays of shots; `start`: distance, m, from the sensor at which they start."""
        part = self.survey.subset(shots)
        direction = self._directions(part, n_rays)
        point = part.sensor[:, None] + start[:, None, None] * direction - self.origin
        point, direction = point.reshape(-1, 3), direction.reshape(-1, 3)
        shot, start = (np.repeat(a, n_rays) for a in (shots, start))
        # Blocks of few sizes share compiled programs.
        spare = size_bucket(len(point)) - len(point)
        x, w = (as_array(np.concatenate([a, np.repeat(a[-1:], spare, axis=0)])) for a in (point, direction))
        far = np.full(len(point), FAR)

        def met(program: Program, what: Any) -> list[np.ndarray]:
            return [np.asarray(a)[: len(point)] for a in program(what, x, w)]

        found, blocked, ground = [], far, self.scene.ground
        if self.tree is not None:
            distance, normal, row, copy = met(_meet_meshes, self.tree)
            material = 0 if self.tree.material is None else np.asarray(self.tree.material)[row]
            instance = self.instance_of(row, copy)
            found.append((distance, normal, self.first_material + material, instance))
            blocked = distance
        shapes = [plate.shape for plate in self.scene.plates]
        shapes = shapes if ground is None else [ground.shape, *shapes]
        distances = [met(_meet_shape, shape) for shape in shapes]
        if ground is not None:
            blocked = np.minimum(blocked, distances[0][0])
        found += [(distance, normal, number, 0) for number, (distance, normal) in enumerate(distances)]
        hits = []
        for distance, normal, surface, instance in found:
            (rays,) = np.nonzero((distance < 0.1 * FAR) & (distance <= blocked))
            surface, instance = (np.broadcast_to(a, shot.shape)[rays] for a in (surface, instance))
            normal, axis = normal[rays].astype(float), direction[rays]
            # On the side of the sensor.
            normal *= -np.sign(np.sum(normal * axis, axis=1, keepdims=True))
            hits.append((shot[rays], surface, start[rays] + distance[rays], instance, normal))
        return _Hits(*(np.concatenate(column) for column in zip(*hits)))

    def instance_of(
        self, row: Int[np.ndarray, " rays"], copy: Int[np.ndarray, " rays"]
    ) -> Int[np.ndarray, " rays"]:
        """Return the numbers of instances: those stated of copies, else of the triangles in rows."""
        assert self.tree is not None
        # A lower tree of n leaves has 2 n rows, the last n of which are triangles.
        sizes = np.array([len(mesh.faces) for mesh in self.scene.meshes])
        first_row = len(self.tree.copy) * 2 + np.cumsum([0, *(2 * sizes)])
        mesh = np.clip(np.searchsorted(first_row, row, side="right") - 1, 0, len(sizes) - 1)
        triangle = row - first_row[mesh] - sizes[mesh] + np.cumsum([0, *sizes])[mesh]
        of_triangle = self.of_triangles[np.clip(triangle, 0, None)]
        return np.where(self.of_copies[copy] > 0, self.of_copies[copy], of_triangle)

    @staticmethod
    def _directions(part: Survey, n_rays: int) -> Float[np.ndarray, "shots rays 3"]:
        """Return unit vectors of rays of equal energy over the footprints of shots."""
        x, y = disc_of_footprint(part, n_rays).T[..., None]
        reach = (part.footprint_radius / part.slant_range)[:, None, None]
        axis, (first, second) = part.direction, part.footprint_axes
        rays = axis[:, None] + reach * (x * first[:, None] + y * second[:, None])
        return rays / np.linalg.norm(rays, axis=2, keepdims=True)


def _stated_instances(meshes: Sequence[MeshSurface]) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of all copies and of all triangles; 0 where none is stated.

    Where no mesh states any, copies are numbered from 1, mesh after mesh.
    """
    copies = [mesh.instances.instance for mesh in meshes]
    triangles = [mesh.instance for mesh in meshes]
    if all(numbers is None for numbers in (*copies, *triangles)):
        n_copies = sum(len(mesh.instances) for mesh in meshes)
        copies = [1 + np.arange(n_copies)]
    else:
        copies = [np.zeros(len(mesh.instances), int) if a is None else a for mesh, a in zip(meshes, copies)]
    triangles = [np.zeros(len(mesh.faces), int) if a is None else a for mesh, a in zip(meshes, triangles)]
    none = np.zeros(0, int)
    return np.concatenate([none, *copies]), np.concatenate([none, *triangles])


def _meet_triangles(tree: MeshTree, x: Float[Array, "rays 3"], w: Float[Array, "rays 3"]) -> tuple[Any, ...]:
    hit, row, copy = tree.meet_row(vec(x.T), vec(w.T))
    return hit.distance, _rows(hit.normal, hit.distance), row, copy


def _meet_surface(
    shape: AbstractShape, x: Float[Array, "rays 3"], w: Float[Array, "rays 3"]
) -> tuple[Any, ...]:
    distance = shape.distance(vec(x.T), vec(w.T))
    normal, _ = shape.tangent(along(vec(x.T), vec(w.T), distance))
    return distance, _rows(normal, distance)


def _rows(v: Vec, like: Float[Array, " rays"]) -> Float[Array, "rays 3"]:
    """Return vectors as rows; those of a plane have the components of one."""
    return jnp.stack([jnp.broadcast_to(a, like.shape) for a in v], axis=-1)


_meet_meshes, _meet_shape = Program(_meet_triangles), Program(_meet_surface)
