r"""Exact traversal of the voxel grid, face by face, by a digital differential analyser (DDA).

A ray x + s w leaves voxel number v along axis i at the distance

    s_i(v) = gap_i v + offset_i,   gap_i = size_i / w_i,

and its next face is the nearest of the three (Amanatides and Woo 1987). Within a voxel the extinction
coefficient k is constant, so that the optical depth tau grows by k ds to the next face and is linear between
faces: results do not depend on any step length. Distances come from integer face numbers and are never
accumulated, so that rounding does not add up over many voxels.

A chunk of photons stops as soon as the last of them has stopped.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._fields.checks import is_traced
from jaxlidar._jax.mesh_axes import vary_together
from jaxlidar._jax.one_function import barrier, one_function
from jaxlidar._jax.vmapped_loops import any_problem
from jaxlidar._vectors import FAR, Scalar, Vec, dot, vec
from jaxlidar.optics.leaf_angles import ANGLE_NODES, LeafAngles
from jaxlidar.optics.phase import AbstractPhase
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.voxels import VoxelMap
from jaxlidar.trace.derivatives.extinction_slopes import ExtinctionSlopes

# Maps of more voxels than this are laid out without room to spare: it would cost more than compiling again.
MAX_PADDED_VOXELS = 1 << 17
# Steps between two checks for rays that still move.
STEPS_PER_CHECK = 8

# A voxel is thin if the map would have less than this optical depth, straight down, with its extinction
# throughout. Fewer photons then collide in it than derivatives place there (`trace.march.thin_voxels`).
_THIN = 0.2
# First voxel, and one past the last, along each axis.
VoxelBox = tuple[tuple[Int[Array, ""], ...], tuple[Int[Array, ""], ...]]


class AngleTables(eqx.Module):
    """G and the mean squared cosine of a leaf angle distribution, on equal steps of |cos zenith|."""

    projection: Float[Array, "nodes"]
    squared_cosine: Float[Array, "nodes"]

    def _interpolate(self, table: Float[Array, "nodes"], w: Vec) -> Scalar:
        # Leaves have no azimuth and two sides: G depends on |cos zenith| alone.
        position = jnp.clip(jnp.abs(w[2]), 0.0, 1.0) * (ANGLE_NODES - 1)
        below = jnp.clip(lax.stop_gradient(position).astype(jnp.int32), 0, ANGLE_NODES - 2)
        return table[below] + (position - below) * (table[below + 1] - table[below])

    def projection_at(self, w: Vec) -> Scalar:
        """Projection function G of a direction: mean of |leaf normal . direction|."""
        return self._interpolate(self.projection, w)

    def squared_cosine_at(self, w: Vec) -> Scalar:
        """Mean of (leaf normal . direction)^2 of a direction."""
        return self._interpolate(self.squared_cosine, w)


class Medium(eqx.Module):
    """A voxel map laid out for tracing; positions are relative to the aim point.

    The arrays have room for `shape` voxels, of which the map has `counts`: maps of similar size share
    programs.

    - `leaf`, `bark`, `total`: extinction coefficients, 1/m, by voxel; of leaf for G = 1/2. `total` is None
      where there is only one of them, or their sum depends on direction.
    - `size`, `origin`: edges of a voxel, and lower corner of the map, m.
    - `angle_tables`, `leaf_angles`: of leaves that are not spherically oriented, else None.
    - `leaf_phase`, `bark_phase`: phase functions that take the place of facets, else None.
    - `periodic`: True if the map repeats along x and y.
    - `collisions`: tables of leaf and bark for where light collides, equal to the others but for their
      derivatives. Default None: the same.
    """

    leaf: Float[Array, "cells"] | None
    bark: Float[Array, "cells"] | None
    total: Float[Array, "cells"] | None
    size: Float[Array, "3"]
    origin: Float[Array, "3"]
    angle_tables: AngleTables | None
    leaf_angles: LeafAngles | None
    leaf_phase: AbstractPhase | None
    bark_phase: AbstractPhase | None
    counts: Int[Array, "3"]
    shape: tuple[int, int, int] = eqx.field(static=True)
    periodic: bool = eqx.field(static=True)
    collisions: tuple[Float[Array, "cells"] | None, Float[Array, "cells"] | None] | None = None

    def is_thin(self, k: Scalar) -> Bool[Array, "*s"]:
        """Return True for voxels of the extinction `k`, 1/m, where few photons collide, or none."""
        return k * (self.size[2] * self.counts[2]) < _THIN

    def leaf_extinction(self, cell: Int[Array, "*s"], w: Vec, *, of_collision: bool = False) -> Scalar:
        """Extinction coefficient of leaf for light along `w`, 1/m: 2 G(w) times that at G = 1/2."""
        leaf = self.collisions[0] if of_collision and self.collisions is not None else self.leaf
        assert leaf is not None
        k = _gather(leaf, cell)
        return k if self.angle_tables is None else k * (2.0 * self.angle_tables.projection_at(w))

    def bark_extinction(self, cell: Int[Array, "*s"], *, of_collision: bool = False) -> Scalar:
        """Extinction coefficient of bark, 1/m."""
        bark = self.collisions[1] if of_collision and self.collisions is not None else self.bark
        assert bark is not None
        return _gather(bark, cell)

    def extinction(self, cell: Int[Array, "*s"], w: Vec) -> Scalar:
        """Extinction coefficient of leaf and bark together, 1/m."""
        if self.total is not None:
            return _gather(self.total, cell)
        if self.bark is None:
            return self.leaf_extinction(cell, w)
        if self.leaf is None:
            return self.bark_extinction(cell)
        return self.leaf_extinction(cell, w) + self.bark_extinction(cell)

    def projection_factor(self, w: Vec) -> Scalar | None:
        """Extinction along `w` per unit of `leaf`, 2 G(w); None where it is one."""
        return None if self.angle_tables is None else 2.0 * self.angle_tables.projection_at(w)

    def relative_angle_slope(self, w: Vec) -> Scalar | None:
        """Relative slope of the extinction of leaf by the vertical component of `w`; None without angles."""
        tables = self.angle_tables
        if tables is None:
            return None
        value, slope = jax.jvp(
            lambda z: tables.projection_at((w[0], w[1], z)), (w[2],), (jnp.ones_like(w[2]),)
        )
        return slope / jnp.maximum(value, 1e-30)

    def with_leaf_scaled(self, factor: Float[Array, ""]) -> "Medium":
        """Return the medium with the extinction of leaf multiplied by `factor`."""
        leaf = None if self.leaf is None else self.leaf * factor
        total = None if self.total is None or leaf is None or self.bark is None else leaf + self.bark
        return dataclasses.replace(self, leaf=leaf, total=total)


def _gather(table: Float[Array, "cells"], cell: Int[Array, "*s"]) -> Scalar:
    # `cell_index` clips, so that no bounds need to be checked here.
    return table.at[cell].get(mode="promise_in_bounds", wrap_negative_indices=False)


def make_medium(canopy: Canopy, aim: Float[Array, "3"]) -> Medium:
    """Lay the voxel map of a canopy out for tracing."""
    voxels = with_room(canopy.voxels)
    leaf = None if voxels.leaf is None else jnp.ravel(voxels.leaf)
    bark = None if voxels.bark is None else jnp.ravel(voxels.bark)
    angle_tables = None
    if voxels.leaf_angles is not None and leaf is not None:
        angle_tables = AngleTables(*voxels.leaf_angles.tables())
    return Medium(
        leaf=leaf,
        bark=bark,
        total=None if leaf is None or bark is None or angle_tables is not None else leaf + bark,
        size=voxels.voxel_size,
        origin=jnp.asarray(voxels.origin) - aim,
        angle_tables=angle_tables,
        leaf_angles=voxels.leaf_angles if angle_tables is not None else None,
        leaf_phase=None if leaf is None else canopy.leaf_phase,
        bark_phase=None if bark is None else canopy.bark_phase,
        counts=jnp.asarray(voxels.counts, jnp.int32),
        shape=voxels.shape,
        periodic=canopy.sides == "periodic",
    )


def with_room(voxels: VoxelMap) -> VoxelMap:
    """Return the map, or stack of maps, with tables of a size bucket, which maps of several shapes share."""
    if voxels._counts is not None:
        return voxels
    extinction = voxels.bark if voxels.leaf is None else voxels.leaf
    assert extinction is not None
    *stack, nx, ny, nz = extinction.shape
    room = [(0, 0)] * len(stack) + [(0, n - m) for n, m in zip(_padded_shape((nx, ny, nz)), (nx, ny, nz))]

    def padded(table: Array | np.ndarray | None) -> Array | np.ndarray | None:
        if table is None:
            return None
        # By NumPy, where nothing is traced: JAX would compile a program for each shape.
        return (jnp if is_traced(table) else np).pad(table, room)

    counts = np.broadcast_to(np.array([nx, ny, nz], np.int32), (*stack, 3))
    tables = (padded(voxels.leaf), padded(voxels.bark), counts)
    return eqx.tree_at(lambda v: (v.leaf, v.bark, v._counts), voxels, tables, is_leaf=lambda x: x is None)


def _padded_shape(shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Voxels along each axis for which there is room: size buckets, unless the map is large.

    The bucket is that of one voxel more: a map of a round number of voxels (16, 32, 64 ...) then shares its
    programs with maps that are a little larger.
    """
    x, y, z = shape
    if x * y * z <= MAX_PADDED_VOXELS:
        # Finer buckets for long axes: up to half of a coarse one would be empty.
        x, y, z = (n if n == 1 else size_bucket(n + 1, 2 if n < 32 else 8) for n in shape)
    return x, y, z


class VoxelRay(eqx.Module):
    """Constants of a ray on the grid: it leaves voxel v along axis i at `gap[i] * v[i] + offset[i]`, m.

    - `step`: +1 or -1 along each axis. - `voxel`: the first voxel.
    - `enter`, `leave`: distances, m, at which the ray enters and leaves the grid.
    """

    gap: Vec
    offset: Vec
    step: tuple[Int[Array, "*s"], Int[Array, "*s"], Int[Array, "*s"]]
    voxel: tuple[Int[Array, "*s"], Int[Array, "*s"], Int[Array, "*s"]]
    enter: Float[Array, "*s"]
    leave: Float[Array, "*s"]

    def face_distances(self, voxel: tuple[Int[Array, "*s"], ...]) -> tuple[Scalar, ...]:
        """Distances to the faces at which the ray would leave `voxel` along each axis."""
        return tuple(
            gap * v.astype(gap.dtype) + offset for gap, offset, v in zip(self.gap, self.offset, voxel)
        )


# In the loops below, in place of `jnp.where`, `jnp.minimum` and `jnp.maximum`:


def select(condition: Bool[Array, "*s"], a: Array, b: Array) -> Array:
    """`jnp.where` as a bare primitive: older compilers do not fuse the function into the loop."""
    return lax.select(condition, a, b) if jnp.shape(a) == jnp.shape(b) else jnp.where(condition, a, b)


def minimum(a: Scalar, b: Scalar) -> Scalar:
    """The smaller number; of equal ones the first, where `jnp.minimum` has the mean of both derivatives."""
    return select(b < a, b, a)


def maximum(a: Scalar, b: Scalar) -> Scalar:
    """The larger number; of equal ones the first, where `jnp.maximum` has the mean of both derivatives."""
    return select(b > a, b, a)


def enter_grid(medium: Medium, x: Vec, w: Vec, box: VoxelBox | None = None) -> VoxelRay:
    """Find where rays from `x` along `w` enter the grid (0 if inside) and leave it, and their first voxel.

    With `box`, the same for that block of the grid. A ray that misses it enters and leaves at once, at 0.

    1. Along each axis: distances to the faces, and the interval of distances in which the ray is within the
       bounds of the grid.
    2. The ray is in the grid where all three intervals overlap.
    3. The first voxel, at the point of entry.
    """
    enter, leave = jnp.zeros_like(x[0]), jnp.full_like(x[0], FAR)
    gap, offset, step = [], [], []
    low, high = box if box is not None else ((0, 0, 0), tuple(medium.counts))
    for k in range(3):
        # Along an axis in which the ray does not move it meets no face; division by zero is avoided.
        flat, ahead = jnp.abs(w[k]) < 1e-12, w[k] > 0
        inverse = 1.0 / jnp.where(flat, 1.0, w[k])
        lower = medium.origin[k] - x[k]
        # A flat axis has its faces at FAR, whatever the voxel.
        gap.append(jnp.where(flat, 0.0, medium.size[k] * inverse))
        offset.append(jnp.where(flat, FAR, (lower + jnp.where(ahead, medium.size[k], 0.0)) * inverse))
        step.append(jnp.where(ahead, 1, -1))
        # A periodic map has no sides: the ray is never outside of it in x and y.
        if medium.periodic and k < 2:
            continue
        first, last = (jnp.asarray(number[k], lower.dtype) for number in (low, high))
        lower, upper = lower + medium.size[k] * first, lower + medium.size[k] * last
        within = (lower <= 0) & (upper >= 0)
        a, b = lower * inverse, upper * inverse
        enter = jnp.maximum(enter, jnp.where(flat, jnp.where(within, 0.0, FAR), jnp.minimum(a, b)))
        leave = jnp.minimum(leave, jnp.where(flat, FAR, jnp.maximum(a, b)))
    hits = enter < leave
    enter, leave = jnp.where(hits, enter, 0.0), jnp.where(hits, leave, 0.0)
    voxel = []
    for k in range(3):
        position = (x[k] + w[k] * enter - medium.origin[k]) / medium.size[k]
        # Which voxel is a decision; its faces carry the derivative.
        number = jnp.floor(lax.stop_gradient(position))
        if not (medium.periodic and k < 2):
            # The point of entry lies on a face, and may be rounded to the wrong side.
            number = jnp.clip(number, 0, (medium.counts[k] - 1).astype(number.dtype))
        voxel.append(number.astype(jnp.int32))
    return VoxelRay(tuple(gap), tuple(offset), tuple(step), tuple(voxel), enter, leave)


def cell_index(medium: Medium, voxel: tuple[Int[Array, "*s"], ...]) -> Int[Array, "*s"]:
    """Return the index of a voxel in the flat arrays, clipped against rounding at the last face."""
    nx, ny, nz = medium.counts
    if medium.periodic:
        i, j = _wrap(voxel[0], nx), _wrap(voxel[1], ny)
    else:
        i, j = _clip(voxel[0], nx), _clip(voxel[1], ny)
    _, along_y, along_z = medium.shape
    return (i * along_y + j) * along_z + _clip(voxel[2], nz)


def _clip(number: Int[Array, "*s"], count: Int[Array, ""]) -> Int[Array, "*s"]:
    return lax.clamp(jnp.int32(0), number, count - 1)


def _wrap(number: Int[Array, "*s"], count: Int[Array, ""]) -> Int[Array, "*s"]:
    """Return the remainder of a voxel's number, in floats: integer division is not vectorised."""
    turns = jnp.floor((number.astype(jnp.float32) + 0.5) * (1.0 / count.astype(jnp.float32)))
    return number - turns.astype(number.dtype) * count


def step_voxel(
    ray: VoxelRay, voxel: tuple[Int[Array, "*s"], ...], faces: tuple[Scalar, ...], distance: Scalar
) -> tuple[Int[Array, "*s"], ...]:
    """Return the voxel behind the faces that are met by `distance`; through an edge or a corner, several."""
    return tuple(
        v + select(face <= distance, s, jnp.zeros_like(s)) for v, s, face in zip(voxel, ray.step, faces)
    )


def occupied_box(medium: Medium) -> VoxelBox:
    """Return the block that holds all voxels with any extinction; outside it photons need not be followed."""
    tables = [t for t in (medium.leaf, medium.bark) if t is not None]
    occupied = jnp.any(jnp.stack(tables) > 0, axis=0).reshape(medium.shape)
    low, high = [], []
    for axis, n in enumerate(medium.shape):
        layers = jnp.any(occupied, axis=[k for k in range(3) if k != axis])
        low.append(jnp.min(jnp.where(layers, jnp.arange(n), n)))
        high.append(jnp.max(jnp.where(layers, jnp.arange(1, n + 1), 0)))
    return tuple(low), tuple(high)


class PathSlopes(eqx.Module):
    """Derivatives of the optical depth of a ray by its path, detached.

    - `direction`: by the components of its direction, at a fixed length, m. - `length`: by its length, 1/m.
    """

    direction: Vec
    length: Float[Array, "*photons"]

    def change(self, turn: Vec, longer: Scalar) -> Scalar:
        """Optical depth, to first order, that a turn of the direction and a longer path add."""
        return dot(self.direction, turn) + self.length * longer


class DepthCrossings(eqx.Module):
    """The points of rays at which their optical depth reaches given targets.

    - `crossed`: True if a target is reached within the medium and before the end of the ray.
    - `cell`: the voxel where that is.
    - `entered`, `chord`: distance at which the ray enters this voxel, and length of the ray within it, m.
    - `depth`: optical depth at `entered`.
    - `distance`, `total_depth`: length, m, and optical depth of the whole ray; without meaning after the last
      target, where rays are not followed.
    - `depth_slopes`: derivatives, with respect to parameters, of the optical depth up to each target, or up
      to the end of the ray if there are no targets; None without score functions.
    - `path_slopes`: derivatives of `total_depth` by the path; None where they are not asked for.
    """

    crossed: Bool[Array, "targets photons"]
    cell: Int[Array, "targets photons"]
    entered: Float[Array, "targets photons"]
    chord: Float[Array, "targets photons"]
    depth: Float[Array, "targets photons"]
    distance: Float[Array, "photons"]
    total_depth: Float[Array, "photons"]
    depth_slopes: Float[Array, "ends parameters photons"] | None = None
    path_slopes: PathSlopes | None = None


class _MarchSlopes(NamedTuple):
    """Derivatives by the direction of a ray, of the distance of the last face and of the depth up to there.

    - `extinction`: of the last voxel, 1/m.
    """

    distance: Vec
    depth: Vec
    extinction: Scalar


class _March(NamedTuple):
    """State of the march of rays through voxels.

    - `distance`, `depth`: length, m, and optical depth up to here. `voxel`: the voxel ahead.
    - `running`: False for rays that have stopped.
    - `crossings`: of every target, distances at which its voxel is entered (-1: not crossed) and left,
      optical depth at the former, and the cell.
    - `depth_slopes`: as in `DepthCrossings`. - `path_slopes`: None where they are not asked for.
    """

    distance: Float[Array, "photons"]
    depth: Float[Array, "photons"]
    voxel: tuple[Int[Array, "photons"], ...]
    running: Bool[Array, "photons"]
    crossings: tuple[Array, ...]
    depth_slopes: Float[Array, "ends parameters photons"] | None
    path_slopes: _MarchSlopes | None


def march_to_depths(
    medium: Medium,
    x: Vec,
    w: Vec,
    targets: Float[Array, "targets photons"],
    max_length: Float[Array, "photons"],
    active: Bool[Array, "photons"],
    max_faces: int,
    box: VoxelBox | None = None,
    *,
    reverse: bool = True,
    slopes: ExtinctionSlopes | None = None,
    by_path: bool = False,
) -> DepthCrossings:
    """March rays to their largest target depth, to `max_length`, or until they leave the grid, or `box`.

    Each step:

    1. Find the nearest face, or the end of the ray.
    2. Look up the extinction of the voxel.
    3. For every target depth that lies in this step, remember the voxel, its faces and the depth before it.
    4. Go on to the next voxel.

    A ray stops when it has passed its largest target or its end. The loop has a static length, in blocks of
    `STEPS_PER_CHECK` steps that are skipped when all rays have stopped.

    **Arguments:**

    - `x`, `w`: start and direction of the rays. `active`: False for those that are not followed.
    - `targets`: optical depths. Without any, rays are followed to their end.
    - `max_faces`: bound on the number of faces crossed.
    - `reverse`: True if reverse-mode derivatives may be taken. Default True.
    - `slopes`: extinction derivatives, where derivatives of optical depths are asked for. Default None.
    - `by_path`: True for `path_slopes`. A face at the distance s along axis i has the derivative
      ds / dw_i = -s / w_i. The depth, the sum of k ds, has the sum over voxels of k times the difference
      between the derivatives of the far and the near face. Default False.
    """
    ray = enter_grid(medium, x, w, box)
    end = minimum(ray.leave, max_length)
    largest = jnp.max(targets, axis=0) if len(targets) else jnp.full_like(max_length, jnp.inf)
    # Optimisation barriers here and in the step: values that several results share would otherwise
    # be computed again for each result.
    ray, end, targets, largest = barrier((ray, end, targets, largest))

    def for_targets(a: Array) -> Array:
        return jnp.broadcast_to(a, targets.shape)

    projection_factor = None if slopes is None else lax.stop_gradient(medium.projection_factor(w))
    if by_path:
        fixed = lax.stop_gradient((medium, x, w))
        enter_by_direction, leave_by_direction = _bounds_by_direction(*fixed, box)
        # At a fixed length the end of a ray that does not leave the grid does not depend on its direction.
        leaves = lax.stop_gradient(ray.leave < max_length)
        end_by_direction = vec(jnp.where(leaves, slope, 0.0) for slope in leave_by_direction)
        minus_inverses = vec(-1.0 / jnp.where(jnp.abs(a) < 1e-12, 1.0, a) for a in fixed[2])
        angle_slope = medium.relative_angle_slope(fixed[2])

    def step(state: _March, _):
        """March all rays by one step, 1 to 4 of `march_to_depths`."""
        distance, depth, voxel, running, crossings, depth_slopes, path_slopes = state
        faces = barrier(ray.face_distances(voxel))
        # Not before `distance`: a ray that starts on a face would step back by rounding.
        to = maximum(distance, minimum(end, minimum(minimum(faces[0], faces[1]), faces[2])))
        cell = cell_index(medium, voxel)
        k = medium.extinction(cell, w)
        to, cell = barrier((to, cell))
        next_depth = barrier(depth + k * (to - distance))
        # Half-open, so that each target is crossed once; an empty voxel (equal depths) is never crossed.
        crossed = for_targets(running) & (for_targets(depth) <= targets) & (targets < for_targets(next_depth))
        # Photons whose last target is passed stop here: most flights are shorter than the map.
        goes_on = running & (next_depth <= largest) & (to < end)
        crossed, goes_on = barrier((crossed, goes_on))
        crossings = tuple(
            select(crossed, for_targets(new), old) for new, old in zip((distance, to, depth, cell), crossings)
        )
        if slopes is not None:
            # Up to each target, a segment counts as far as the target, which may lie within it.
            length = jnp.where(running, to - distance, 0.0)[None]
            if len(targets):
                to_target = (targets - for_targets(depth)) / for_targets(jnp.maximum(k, 1e-30))
                length = jnp.clip(to_target, 0.0, for_targets(length[0]))
            assert depth_slopes is not None
            length = lax.stop_gradient(length)
            depth_slopes = slopes.add_segment(depth_slopes, cell, length, projection_factor)
        if path_slopes is not None:
            near, by_direction, extinction = path_slopes
            far = vec(
                select(to < end, select(face <= to, to * minus_inverse, jnp.zeros_like(to)), at_end)
                for face, minus_inverse, at_end in zip(faces, minus_inverses, end_by_direction)
            )
            by_direction = vec(
                sums + select(running, k * (b - a), jnp.zeros_like(k))
                for sums, a, b in zip(by_direction, near, far)
            )
            if angle_slope is not None:
                along_z = medium.leaf_extinction(cell, w) * angle_slope * (to - distance)
                along_z = select(running, along_z, jnp.zeros_like(along_z))
                by_direction = (*by_direction[:2], by_direction[2] + along_z)
            path_slopes = lax.stop_gradient(_MarchSlopes(far, by_direction, select(running, k, extinction)))
        # The voxel of a ray that has stopped does not matter.
        next_voxel = step_voxel(ray, voxel, faces, to)
        distance, depth = select(running, to, distance), select(running, next_depth, depth)
        state = _March(distance, depth, next_voxel, goes_on, crossings, depth_slopes, path_slopes)
        return state, None

    # A loop of static length has a reverse derivative; skipping dead blocks gives back the time of a loop
    # that stops early.
    def block(state: _March, _):
        def run(state):
            return lax.scan(step, state, None, length=STEPS_PER_CHECK)[0]

        return lax.cond(any_problem(state.running), run, lambda s: s, state), None

    zero = jnp.zeros_like(targets)
    # Entered at -1: not crossed.
    no_crossings = (zero - 1.0, zero, zero, zero.astype(jnp.int32))
    start = jnp.minimum(ray.enter, end)
    depth_slopes = None
    if slopes is not None:
        depth_slopes = jnp.zeros((max(len(targets), 1), slopes.count, *max_length.shape), max_length.dtype)
    running = active & (ray.enter < end)
    depth = jnp.zeros_like(max_length)
    path_slopes = None
    if by_path:
        path_slopes = _MarchSlopes(enter_by_direction, (depth, depth, depth), depth)
    state = _March(start, depth, ray.voxel, running, no_crossings, depth_slopes, path_slopes)
    state = vary_together(state)

    def march(state: _March) -> _March:
        return lax.scan(block, state, None, length=-(-max_faces // STEPS_PER_CHECK))[0]

    state = (march if reverse else one_function(march))(state)
    enter, leave, depth, cell = state.crossings
    path_slopes = None
    if state.path_slopes is not None:
        _, by_direction, extinction = state.path_slopes
        path_slopes = PathSlopes(by_direction, jnp.where(leaves, 0.0, extinction))
    return DepthCrossings(
        crossed=enter >= 0,
        cell=cell,
        entered=enter,
        chord=leave - enter,
        depth=depth,
        distance=state.distance,
        total_depth=state.depth,
        depth_slopes=state.depth_slopes,
        path_slopes=path_slopes,
    )


def _bounds_by_direction(medium: Medium, x: Vec, w: Vec, box: VoxelBox | None) -> tuple[Vec, Vec]:
    """Return the derivatives of the distances at which rays enter and leave the grid by their direction."""

    def bounds(w: Vec) -> tuple[Scalar, Scalar]:
        ray = enter_grid(medium, x, w, box)
        return ray.enter, ray.leave

    one, zero = jnp.ones_like(w[0]), jnp.zeros_like(w[0])
    columns = [
        jax.jvp(bounds, (w,), (tuple(one if k == i else zero for k in range(3)),))[1] for i in range(3)
    ]
    return vec(column[0] for column in columns), vec(column[1] for column in columns)


def voxel_at(medium: Medium, x: Vec) -> tuple[Vec, tuple[Int[Array, "*s"], ...]]:
    """Return points in voxels from the lower corner of the map, and the voxel there, along each axis."""
    position = vec((x[k] - medium.origin[k]) / medium.size[k] for k in range(3))
    # Which voxel is a decision, without derivatives.
    return position, tuple(jnp.floor(lax.stop_gradient(p)).astype(jnp.int32) for p in position)


def voxel_above(medium: Medium, x: Vec) -> tuple[Int[Array, "..."], Scalar, Bool[Array, "..."]]:
    """Find the voxel at or straight above `x`, the fraction of it above `x`, and if there is one."""
    position, voxel = voxel_at(medium, x)
    nx, ny, nz = medium.counts
    inside = voxel[2] < nz
    if not medium.periodic:
        inside &= (voxel[0] >= 0) & (voxel[0] < nx) & (voxel[1] >= 0) & (voxel[1] < ny)
    cell = cell_index(medium, voxel)
    # Below the map the whole lowest voxel lies above the point; above the map, nothing.
    upper_face = (jnp.clip(voxel[2], 0, nz - 1) + 1).astype(position[2].dtype)
    above = jnp.clip(upper_face - jnp.maximum(position[2], 0.0), 0.0, 1.0)
    return cell, above, inside


def depth_to_top(medium: Medium, x: Vec, depth_above: Float[Array, "cells"]) -> Scalar:
    """Return the optical depth from `x` straight up; `depth_above` as `vertical_depths` returns it."""
    cell, above, inside = voxel_above(medium, x)
    up = (jnp.zeros_like(x[0]), jnp.zeros_like(x[0]), jnp.ones_like(x[0]))
    depth = _gather(depth_above, cell) + medium.extinction(cell, up) * above * medium.size[2]
    return jnp.where(inside, depth, 0.0)


def vertical_depths(medium: Medium) -> Float[Array, "cells"]:
    """Return the optical depth straight up from each voxel's upper face."""
    cells = jnp.arange(int(np.prod(medium.shape)))
    one = jnp.ones((), medium.size.dtype)
    layer_depth = medium.extinction(cells, (0.0 * one, 0.0 * one, one)).reshape(medium.shape) * medium.size[2]
    # From the top down: the depth of the layer above, summed.
    above = jnp.concatenate([jnp.zeros_like(layer_depth[:, :, :1]), layer_depth[:, :, :0:-1]], axis=2)
    return jnp.cumsum(above, axis=2)[:, :, ::-1].reshape(-1)
