"""Exact traversal of the voxel grid: from face to face along straight rays.

Nothing is sampled on the way: within a voxel the extinction coefficient is constant, so the optical depth is
known at every face and linear between them. Distances to faces are computed from integer face numbers, never
accumulated. A batch of photons stops as soon as the last of them has stopped.

Values that several results of a step share are computed once: the compiler for processors would otherwise
compute them again for each result.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._one_function import once, one_function
from jaxlidar._vectors import FAR, Scalar, Vec
from jaxlidar.optics.leaf_angles import ANGLE_NODES, LeafAngles
from jaxlidar.optics.phase import AbstractPhase
from jaxlidar.planning.ladder import rung
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.trace.scores import Scores

# Voxels of a map that is laid out without room to spare.
LARGE = 1 << 17
# Steps between two checks whether any ray of the batch still moves.
BLOCK = 8


class AngleTables(eqx.Module):
    """G and the mean squared cosine of a leaf angle distribution, on equal steps of |cos zenith|."""

    projection: Float[Array, "nodes"]
    square: Float[Array, "nodes"]

    def _at(self, table: Float[Array, "nodes"], w: Vec) -> Scalar:
        position = jnp.clip(jnp.abs(w[2]), 0.0, 1.0) * (ANGLE_NODES - 1)
        below = jnp.clip(lax.stop_gradient(position).astype(jnp.int32), 0, ANGLE_NODES - 2)
        return table[below] + (position - below) * (table[below + 1] - table[below])

    def projection_at(self, w: Vec) -> Scalar:
        """G of a direction."""
        return self._at(self.projection, w)

    def square_at(self, w: Vec) -> Scalar:
        """Mean of (leaf normal . direction)^2 of a direction."""
        return self._at(self.square, w)


class Medium(eqx.Module):
    """A voxel map laid out for tracing; positions are relative to the aim point.

    The arrays have room for `shape` voxels, of which the map has `counts`.
    """

    leaf: Float[Array, "cells"] | None
    bark: Float[Array, "cells"] | None
    total: Float[Array, "cells"] | None
    size: Float[Array, "3"]
    origin: Float[Array, "3"]
    angles: AngleTables | None
    leaf_angles: LeafAngles | None
    leaf_phase: AbstractPhase | None
    bark_phase: AbstractPhase | None
    counts: Int[Array, "3"]
    shape: tuple[int, int, int] = eqx.field(static=True)
    periodic: bool = eqx.field(static=True)

    def leaf_at(self, cell: Int[Array, "*s"], w: Vec) -> Scalar:
        """Extinction coefficient of leaf for light travelling along `w`, 1/m."""
        assert self.leaf is not None
        k = _pick(self.leaf, cell)
        return k if self.angles is None else k * (2.0 * self.angles.projection_at(w))

    def bark_at(self, cell: Int[Array, "*s"]) -> Scalar:
        """Extinction coefficient of bark, 1/m."""
        assert self.bark is not None
        return _pick(self.bark, cell)

    def extinction(self, cell: Int[Array, "*s"], w: Vec) -> Scalar:
        """Extinction coefficient of leaf and bark together, 1/m."""
        if self.total is not None:
            return _pick(self.total, cell)
        if self.bark is None:
            return self.leaf_at(cell, w)
        return self.leaf_at(cell, w) + self.bark_at(cell)

    def leaf_share(self, w: Vec) -> Scalar | None:
        """Extinction along `w` per unit of `leaf`; None where it is one."""
        return None if self.angles is None else 2.0 * self.angles.projection_at(w)

    def thinned(self, share: Float[Array, ""]) -> "Medium":
        """The medium with a share of the leaf's extinction."""
        leaf = None if self.leaf is None else self.leaf * share
        total = None if self.total is None else _together(leaf, self.bark)
        return dataclasses.replace(self, leaf=leaf, total=total)


def _together(leaf: Array | None, bark: Array | None) -> Array | None:
    return leaf if bark is None else (bark if leaf is None else leaf + bark)


def _pick(table: Float[Array, "cells"], cell: Int[Array, "*s"]) -> Scalar:
    return table.at[cell].get(mode="promise_in_bounds", wrap_negative_indices=False)


def medium_of(canopy: Canopy, aim: Float[Array, "3"]) -> Medium:
    """The medium of a canopy."""
    voxels = canopy.voxels
    shape = _room(voxels.shape)

    def laid_out(table: Float[Array, "nx ny nz"]) -> Float[Array, "cells"]:
        return jnp.pad(table, [(0, room - n) for room, n in zip(shape, voxels.shape)]).reshape(-1)

    leaf = None if voxels.leaf is None else laid_out(voxels.leaf)
    bark = None if voxels.bark is None else laid_out(voxels.bark)
    angles = None
    if voxels.leaf_angles is not None and leaf is not None:
        angles = AngleTables(*voxels.leaf_angles.tables())
    return Medium(
        leaf=leaf,
        bark=bark,
        total=_together(leaf, bark) if angles is None else None,
        size=voxels.voxel_size,
        origin=jnp.asarray(voxels.origin) - aim,
        angles=angles,
        leaf_angles=voxels.leaf_angles if angles is not None else None,
        leaf_phase=None if leaf is None else canopy.leaf_phase,
        bark_phase=None if bark is None else canopy.bark_phase,
        counts=jnp.asarray(voxels.shape, jnp.int32),
        shape=shape,
        periodic=canopy.sides == "periodic",
    )


def _room(shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Voxels along each axis for which there is room: up the ladder, where the map is not large."""
    x, y, z = shape
    if x * y * z <= LARGE:
        # One more than a round number of voxels needs no more room.
        x, y, z = (n if n == 1 else rung(n + 1, 2 if n <= 32 else 8) for n in shape)
    return x, y, z


# First voxel and one past the last, along each axis.
Box = tuple[tuple[Int[Array, ""], ...], tuple[Int[Array, ""], ...]]


class Walk(eqx.Module):
    """A ray on the grid: it leaves voxel v along axis k at the distance `gap[k] * v[k] + offset[k]`."""

    gap: Vec
    offset: Vec
    step: tuple[Int[Array, "*s"], Int[Array, "*s"], Int[Array, "*s"]]
    voxel: tuple[Int[Array, "*s"], Int[Array, "*s"], Int[Array, "*s"]]
    enter: Float[Array, "*s"]
    leave: Float[Array, "*s"]

    def faces(self, voxel: tuple[Int[Array, "*s"], ...]) -> tuple[Scalar, ...]:
        """Distances to the faces at which the ray would leave `voxel` along each axis."""
        return tuple(gap * v + offset for gap, offset, v in zip(self.gap, self.offset, voxel))


def choose(condition: Bool[Array, "*s"], a: Array, b: Array) -> Array:
    """`jnp.where`, where shapes are alike without its being a function: older compilers would not fuse it."""
    return lax.select(condition, a, b) if jnp.shape(a) == jnp.shape(b) else jnp.where(condition, a, b)


def earlier(a: Scalar, b: Scalar) -> Scalar:
    """The smaller of two numbers. Of equal ones the first, where `minimum` has half of both derivatives."""
    return choose(b < a, b, a)


def later(a: Scalar, b: Scalar) -> Scalar:
    """The larger of two numbers; of equal ones the first."""
    return choose(b > a, b, a)


def begin(medium: Medium, x: Vec, w: Vec, box: Box | None = None) -> Walk:
    """Where a ray from `x` along `w` enters the grid (0 if inside) and leaves it, and its first voxel.

    With `box`, the same for that part of the grid.
    """
    near, far = jnp.zeros_like(x[0]), jnp.full_like(x[0], FAR)
    gap, offset, step = [], [], []
    low, high = box if box is not None else ((0, 0, 0), tuple(medium.counts))
    for k in range(3):
        flat, ahead = jnp.abs(w[k]) < 1e-12, w[k] > 0
        inverse = 1.0 / jnp.where(flat, 1.0, w[k])
        lower = medium.origin[k] - x[k]
        gap.append(jnp.where(flat, 0.0, medium.size[k] * inverse))
        offset.append(jnp.where(flat, FAR, (lower + jnp.where(ahead, medium.size[k], 0.0)) * inverse))
        step.append(jnp.where(ahead, 1, -1))
        if medium.periodic and k < 2:
            continue
        lower, upper = lower + medium.size[k] * low[k], lower + medium.size[k] * high[k]
        within = (lower <= 0) & (upper >= 0)
        a, b = lower * inverse, upper * inverse
        near = jnp.maximum(near, jnp.where(flat, jnp.where(within, 0.0, FAR), jnp.minimum(a, b)))
        far = jnp.minimum(far, jnp.where(flat, FAR, jnp.maximum(a, b)))
    # A ray that misses the grid enters and leaves it at once.
    met = near < far
    near, far = jnp.where(met, near, 0.0), jnp.where(met, far, 0.0)
    voxel = []
    for k in range(3):
        place = (x[k] + w[k] * near - medium.origin[k]) / medium.size[k]
        number = jnp.floor(lax.stop_gradient(place))
        if not (medium.periodic and k < 2):
            number = jnp.clip(number, 0, medium.counts[k] - 1)
        voxel.append(number.astype(jnp.int32))
    return Walk(tuple(gap), tuple(offset), tuple(step), tuple(voxel), near, far)


def cell_of(medium: Medium, voxel: tuple[Int[Array, "*s"], ...]) -> Int[Array, "*s"]:
    """Index into the flat arrays, clipped against rounding at the last face."""
    nx, ny, nz = medium.counts
    if medium.periodic:
        i, j = _wrapped(voxel[0], nx), _wrapped(voxel[1], ny)
    else:
        i, j = _within(voxel[0], nx), _within(voxel[1], ny)
    _, along_y, along_z = medium.shape
    return (i * along_y + j) * along_z + _within(voxel[2], nz)


def _within(number: Int[Array, "*s"], count: Int[Array, ""]) -> Int[Array, "*s"]:
    return lax.clamp(jnp.int32(0), number, count - 1)


def _wrapped(number: Int[Array, "*s"], count: Int[Array, ""]) -> Int[Array, "*s"]:
    """The remainder of a voxel's number; by floating point, for processors divide integers one by one."""
    turns = jnp.floor((number.astype(jnp.float32) + 0.5) * (1.0 / count.astype(jnp.float32)))
    return number - turns.astype(number.dtype) * count


def advance(
    walk: Walk, voxel: tuple[Int[Array, "*s"], ...], faces: tuple[Scalar, ...], to: Scalar
) -> tuple[Int[Array, "*s"], ...]:
    """The voxel behind the faces that are met by the distance `to`; through an edge or a corner, several."""
    return tuple(v + choose(face <= to, s, jnp.zeros_like(s)) for v, s, face in zip(voxel, walk.step, faces))


def occupied(medium: Medium) -> Box:
    """The box that holds all voxels with any extinction; outside it photons need not be followed."""
    tables = [t for t in (medium.leaf, medium.bark) if t is not None]
    full = jnp.any(jnp.stack(tables) > 0, axis=0).reshape(medium.shape)
    low, high = [], []
    for axis, n in enumerate(medium.shape):
        layers = jnp.any(full, axis=[k for k in range(3) if k != axis])
        low.append(jnp.min(jnp.where(layers, jnp.arange(n), n)))
        high.append(jnp.max(jnp.where(layers, jnp.arange(1, n + 1), 0)))
    return tuple(low), tuple(high)


class Free(eqx.Module):
    """Free flights, and where on them the optical depth reaches the targets.

    - `collided`: whether this is in the medium and before the limit.
    - `cell`: the voxel where it is.
    - `entered`, `chord`: distance at which the voxel was entered, and length of the ray within it, m.
    - `depth`: optical depth at `entered`.
    - `distance`, `total`: length, m, and optical depth of the whole flight; without meaning after the last
      target.
    - `moved`: derivatives of the optical depth up to each target, or up to the end of the flight if there are
      none; None without scores.
    """

    collided: Bool[Array, "targets photons"]
    cell: Int[Array, "targets photons"]
    entered: Float[Array, "targets photons"]
    chord: Float[Array, "targets photons"]
    depth: Float[Array, "targets photons"]
    distance: Float[Array, "photons"]
    total: Float[Array, "photons"]
    moved: Float[Array, "ends columns photons"] | None = None


def free_flight(
    medium: Medium,
    x: Vec,
    w: Vec,
    targets: Float[Array, "targets photons"],
    limit: Float[Array, "photons"],
    active: Bool[Array, "photons"],
    steps: int,
    box: Box | None = None,
    *,
    reverse: bool = True,
    scores: Scores | None = None,
) -> Free:
    """Follow rays to their largest target, to their length `limit`, or until they leave the grid, or `box`.

    `steps` bounds the number of faces crossed; a batch stops earlier when all its rays have stopped. Without
    targets, rays are followed to their end. `reverse`: whether to allow differentiation in reverse.
    `scores`: of which the derivatives of optical depths are asked for.
    """
    walk = begin(medium, x, w, box)
    end = earlier(walk.leave, limit)
    most = jnp.max(targets, axis=0) if len(targets) else jnp.full_like(limit, jnp.inf)
    walk, end, targets, most = once((walk, end, targets, most))

    def wide(a: Array) -> Array:
        return jnp.broadcast_to(a, targets.shape)

    share = None if scores is None else lax.stop_gradient(medium.leaf_share(w))

    def step(state, _):
        distance, depth, voxel, running, held, moved = state
        faces = once(walk.faces(voxel))
        to = later(distance, earlier(end, earlier(earlier(faces[0], faces[1]), faces[2])))
        cell = cell_of(medium, voxel)
        k = medium.extinction(cell, w)
        to, cell = once((to, cell))
        more = once(depth + k * (to - distance))
        here = wide(running) & (wide(depth) <= targets) & (targets < wide(more))
        go = running & (more <= most) & (to < end)
        here, go = once((here, go))
        kept = tuple(choose(here, wide(a), b) for a, b in zip((distance, to, depth, cell), held))
        if scores is not None:
            length = jnp.where(running, to - distance, 0.0)[None]
            if len(targets):
                upto = (targets - wide(depth)) / wide(jnp.maximum(k, 1e-30))
                length = jnp.clip(upto, 0.0, wide(length[0]))
            moved = scores.add(moved, cell, lax.stop_gradient(length), share)
        # Where the ray has stopped, the voxel does not matter.
        ahead = advance(walk, voxel, faces, to)
        state = choose(running, to, distance), choose(running, more, depth), ahead, go, kept, moved
        return state, None

    def block(state, _):
        def go(state):
            return lax.scan(step, state, None, length=BLOCK)[0]

        return lax.cond(jnp.any(state[3]), go, lambda s: s, state), None

    zero = jnp.zeros_like(targets)
    held = (zero - 1.0, zero, zero, zero.astype(jnp.int32))
    start = jnp.minimum(walk.enter, end)
    moved = None
    if scores is not None:
        moved = jnp.zeros((max(len(targets), 1), scores.count, *limit.shape), limit.dtype)
    state = (start, jnp.zeros_like(limit), walk.voxel, active & (walk.enter < end), held, moved)

    def march(state):
        return lax.scan(block, state, None, length=-(-steps // BLOCK))[0]

    distance, total, _, _, held, moved = (march if reverse else one_function(march))(state)
    entered, left, depth, cell = held
    return Free(entered >= 0, cell, entered, left - entered, depth, distance, total, moved)


def straight_up(medium: Medium, x: Vec) -> tuple[Int[Array, "..."], Scalar, Bool[Array, "..."]]:
    """The voxel at or straight above `x`, the share of its height above `x`, and whether there is one."""
    voxel = []
    place = []
    for k in range(3):
        p = (x[k] - medium.origin[k]) / medium.size[k]
        place.append(p)
        voxel.append(jnp.floor(lax.stop_gradient(p)).astype(jnp.int32))
    nx, ny, nz = medium.counts
    inside = voxel[2] < nz
    if not medium.periodic:
        inside &= (voxel[0] >= 0) & (voxel[0] < nx) & (voxel[1] >= 0) & (voxel[1] < ny)
    cell = cell_of(medium, tuple(voxel))
    above = jnp.clip(jnp.clip(voxel[2], 0, nz - 1) + 1 - jnp.maximum(place[2], 0.0), 0.0, 1.0)
    return cell, above, inside


def depth_to_top(medium: Medium, x: Vec, column: Float[Array, "cells"]) -> Scalar:
    """Optical depth from `x` straight up; `column` is the depth above each voxel's upper face."""
    cell, above, inside = straight_up(medium, x)
    up = (jnp.zeros_like(x[0]), jnp.zeros_like(x[0]), jnp.ones_like(x[0]))
    depth = _pick(column, cell) + medium.extinction(cell, up) * above * medium.size[2]
    return jnp.where(inside, depth, 0.0)


def columns(medium: Medium) -> Float[Array, "cells"]:
    """Optical depth straight up above each voxel's upper face."""
    cells = jnp.arange(int(np.prod(medium.shape)))
    one = jnp.ones((), medium.size.dtype)
    k = medium.extinction(cells, (0.0 * one, 0.0 * one, one)).reshape(medium.shape) * medium.size[2]
    above = jnp.concatenate([jnp.zeros_like(k[:, :, :1]), k[:, :, :0:-1]], axis=2)
    return jnp.cumsum(above, axis=2)[:, :, ::-1].reshape(-1)
