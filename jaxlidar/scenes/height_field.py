r"""Height fields: surfaces whose height is known at the nodes of a grid, and bilinear in between.

A ray x + s w has the clearance f(s) = z(s) - h(x(s), y(s)) above the surface h. Within one cell the bilinear
h makes it a quadratic,

    f(u) = a u^2 + b u + c,   u the distance from the point where the ray enters the cell,

and the ray falls through the surface at the root of negative derivative, f' = -sqrt(b^2 - 4 a c), which is

    u = 2 c / (sqrt(b^2 - 4 a c) - b)          for b <= 0,
    u = -(b + sqrt(b^2 - 4 a c)) / (2 a)       for b > 0,

whatever the sign of a; neither form subtracts numbers of nearly equal size. Light that starts on the surface
rises from it, so that its starting point is no such root. The algorithm for all rays at once is:

1. Enter the grid: advance each ray to where it is over the grid and below the highest node.
2. In each step of a loop, cross a block of 8 x 8 cells if the ray stays above the highest node of the block
   (maximum mipmaps, here with a single level; Tevs, Ihrke and Seidel 2008, Symposium on Interactive 3D
   Graphics and Games). Otherwise cross one cell: stop at a falling root within it, or go on to the next cell
   (Amanatides and Woo 1987, Eurographics).
3. Carry from cell to cell if the ray is above the surface. Rounding at a shared edge then cannot let it slip
   through: a ray that was above and is below at the end of a cell has met the surface in it.

Derivatives do not pass through the loop. The distance s solves f(s, theta) = 0, so by implicit
differentiation ds/dtheta = -(df/dtheta) / (df/ds).
"""

from collections.abc import Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._fields.checks import array_namespace, fixed_array
from jaxlidar._jax.mesh_axes import vary_together
from jaxlidar._jax.one_function import barrier
from jaxlidar._jax.vmapped_loops import any_problem
from jaxlidar._vectors import FAR, Scalar, Vec, along, dot, normalise, vec, with_derivative_of
from jaxlidar.scenes.raster import Cell, Raster
from jaxlidar.scenes.shapes import AbstractShape

# Largest number of steps of a ray over a field that repeats without end: only rays that fall by less than a
# millionth of the field's relief in every step need more. The loop ends with the last ray, long before.
MAX_STEPS = 1 << 20
# Cells along each side of a block: a power of two, so that the block of a cell is a shift of bits, because
# processors divide vectors of integers one by one.
_LOG2_BLOCK_SIZE = 3
BLOCK_SIZE = 1 << _LOG2_BLOCK_SIZE
# Tolerance of the height of a ray, in units of the floating-point precision and of the size of its
# coordinates.
_ROUNDING = 10
# All rays of a loop wait for the longest, which takes many times the steps of most. From this number of rays
# on, the last ones are gathered and traced alone, once only one ray in `_COMPACTION_RATIO` is active.
_COMPACTION_MIN_RAYS = 128
_COMPACTION_RATIO = 8
# Smallest rate, per m, at which a ray is taken to approach the surface in derivatives: those of grazing rays
# are bounded.
_MIN_APPROACH_RATE = 1e-4
# Components of directions below this, in cells per m or m per m, count as zero.
_PARALLEL = 1e-12
# Part of a cell by which the box of a beam is narrowed where its bounds are rounded to single precision.
_CELL_SLACK = 1e-3


class _Traversal(eqx.Module):
    """State of the loop over cells.

    - `distance`: along each ray, m.
    - `i`, `j`: current cell along x and y.
    - `above`: True if the ray is above the surface there.
    - `active`: True if the ray has neither met the surface nor left the field.
    - `hit_distance`: distance to the surface, m; `FAR` if it was not met.
    - `steps`: number of steps that all rays have taken.
    """

    distance: Float[Array, "*s"]
    i: Int[Array, "*s"]
    j: Int[Array, "*s"]
    above: Bool[Array, "*s"]
    active: Bool[Array, "*s"]
    hit_distance: Float[Array, "*s"]
    steps: Int[Array, ""]


class _GridRay(eqx.Module):
    """Constants of a ray in the loop over cells.

    - `height`, `height_rate`: height at the distance zero, m, and its change per m.
    - `position`, `rate`: grid coordinates along x and y at the distance zero, and their change per m.
    - `cell_length`, `face_offset`: the ray leaves cell number v along an axis at the distance
      `cell_length * v + face_offset`, m.
    - `ascending`: True along an axis if the ray goes to cells of larger numbers.
    - `exit_distance`: distance beyond which it can meet no cell any more, m.
    - `tolerance`: by how much rounding may put it under the surface, m.
    """

    height: Float[Array, "*s"]
    height_rate: Float[Array, "*s"]
    position: tuple[Float[Array, "*s"], ...]
    rate: tuple[Float[Array, "*s"], ...]
    cell_length: tuple[Float[Array, "*s"], ...]
    face_offset: tuple[Float[Array, "*s"], ...]
    ascending: tuple[Bool[Array, "*s"], ...]
    exit_distance: Float[Array, "*s"]
    tolerance: Float[Array, "*s"]

    def face_distances(self, cell: Sequence[Int[Array, "*s"]]) -> list[Float[Array, "*s"]]:
        """Distances at which the ray leaves a cell along x and y."""
        dtype = self.exit_distance.dtype
        return [self.cell_length[k] * cell[k].astype(dtype) + self.face_offset[k] for k in range(2)]


@final
class HeightField(AbstractShape):
    """A height field over the rectangle of its nodes, or over the whole plane where it is periodic.

    Rays that fall from above are stopped; those that rise from below pass. There are no walls at the edge.

    **Arguments:**

    - `heights`: a `Raster` of heights, m.
    - `lowest`, `highest`: the smallest and the largest of them, m.
    - `block_maxima`: largest height within each block of cells, m.
    """

    heights: Raster
    lowest: Float[Array, ""]
    highest: Float[Array, ""]
    block_maxima: Float[Array, "blocks_x blocks_y"]

    @staticmethod
    @eqx.filter_jit
    def of(heights: Raster) -> "HeightField":
        """Make the height field of a raster of heights in m."""
        values = heights.values
        return HeightField(heights, jnp.min(values), jnp.max(values), _block_maxima(heights))

    @property
    def lights_itself(self) -> bool:
        return True

    def moved(self, by: Float[Array, "3"]) -> "HeightField":
        heights = self.heights.moved(by[:2])
        heights = eqx.tree_at(lambda r: r.values, heights, heights.values + by[2])
        return HeightField(heights, self.lowest + by[2], self.highest + by[2], self.block_maxima + by[2])

    def tangent(self, x: Vec) -> tuple[Vec, Scalar]:
        height, (slope_x, slope_y) = self.heights.value_and_slope(x)
        # Optimisation barrier: compilers would repeat the look-up for every result that depends on it.
        normal, height = barrier((normalise((-slope_x, -slope_y, jnp.ones_like(slope_x))), height))
        return normal, dot(normal, (x[0], x[1], height))

    def distance(self, x: Vec, w: Vec) -> Scalar:
        x, w = (vec(jnp.broadcast_arrays(*v)) for v in (x, w))
        field, start, direction = jax.tree.map(lax.stop_gradient, (self, x, w))
        distance = field._first_hit(start, direction)
        hit = distance < FAR
        distance = jnp.where(hit, distance, 0.0)
        # Implicit differentiation at the point that was found: the correction is zero, its derivative is that
        # of the distance at which the clearance vanishes.
        point = along(x, w, distance)
        height, (slope_x, slope_y) = self.heights.value_and_slope(point)
        approach_rate = lax.stop_gradient(w[2] - slope_x * w[0] - slope_y * w[1])
        clearance = point[2] - height
        correction = (clearance - lax.stop_gradient(clearance)) / jnp.minimum(
            approach_rate, -_MIN_APPROACH_RATE
        )
        # Without derivatives, the compiler then leaves the look-up of the slope out.
        return jnp.where(hit, with_derivative_of(distance, distance - correction), FAR)

    def _first_hit(self, x: Vec, w: Vec) -> Scalar:
        """Find the distance to the first point where a ray falls through the surface; without derivatives."""
        shape = x[0].shape
        ray, state = self._enter_grid(*(vec(a.reshape(-1) for a in v) for v in (x, w)))
        n_rays = state.distance.size
        max_steps = MAX_STEPS if self.heights.periodic else sum(self.heights.cells) + 2
        if n_rays < _COMPACTION_MIN_RAYS:
            return self._traverse(ray, state, max_steps).hit_distance.reshape(shape)
        n_last = n_rays // _COMPACTION_RATIO
        state = self._traverse(ray, state, max_steps, stop_at=n_last)
        # Stream compaction: the indices of the rays that are still active, `rank` of them in order, and zeros
        # in the rest of the `n_last` lanes, which stay idle.
        n_active = jnp.sum(state.active)
        rank = jnp.where(state.active, jnp.cumsum(state.active) - 1, n_last)
        index = jnp.arange(n_rays, dtype=jnp.int32)
        last = jnp.zeros(n_last, jnp.int32).at[rank].set(index, mode="drop")
        is_used = index[:n_last] < n_active
        last_rays, last_state = jax.tree.map(lambda a: a[last] if a.ndim else a, (ray, state))
        last_state = eqx.tree_at(lambda s: s.active, last_state, is_used)
        hit_distance = self._traverse(last_rays, last_state, max_steps).hit_distance
        destination = jnp.where(is_used, last, n_rays)
        return state.hit_distance.at[destination].set(hit_distance, mode="drop").reshape(shape)

    def _enter_grid(self, x: Vec, w: Vec) -> tuple[_GridRay, _Traversal]:
        """Advance rays to the first cell over which they may meet the surface."""
        field = self.heights
        position = field.grid_coordinates(x)
        rate = [w[k] / field.spacing[k] for k in range(2)]
        tolerance = self._height_tolerance(x)
        enter, leave = _interval_within(x[2], w[2], self.lowest - tolerance, self.highest + tolerance)
        if not field.periodic:
            for k in range(2):
                near, far_end = _interval_within(position[k], rate[k], *field.bounds[k])
                enter, leave = jnp.maximum(enter, near), jnp.minimum(leave, far_end)
        active = enter < leave
        enter = jnp.where(active, enter, 0.0)
        cell_length, face_offset, ascending = [], [], []
        for k in range(2):
            parallel = jnp.abs(rate[k]) < _PARALLEL
            ascending.append(rate[k] > 0)
            inverse = 1.0 / jnp.where(parallel, 1.0, rate[k])
            cell_length.append(jnp.where(parallel, 0.0, inverse))
            offset = (jnp.where(ascending[k], 1.0, 0.0) - position[k]) * inverse
            face_offset.append(jnp.where(parallel, FAR, offset))
        ray = _GridRay(
            height=x[2],
            height_rate=w[2],
            position=tuple(position),
            rate=tuple(rate),
            cell_length=tuple(cell_length),
            face_offset=tuple(face_offset),
            ascending=tuple(ascending),
            exit_distance=leave,
            tolerance=tolerance,
        )
        cell = field.cell_at((position[0] + rate[0] * enter, position[1] + rate[1] * enter))
        above = self._clearance(ray, enter, cell)[2] > -tolerance
        missed = jnp.full_like(enter, FAR)
        return ray, _Traversal(enter, *cell, above, active, missed, jnp.zeros((), jnp.int32))

    def _height_tolerance(self, x: Vec) -> Scalar:
        """Bound the height, m, by which rounding may put a ray under the surface."""
        field = self.heights
        extent = self.highest - self.lowest + field.spacing[0] + field.spacing[1]
        # Where a ray from a sensor meets the field, its height has the rounding of that, not of the start.
        height = jnp.maximum(jnp.abs(self.lowest), jnp.abs(self.highest))
        size = extent + height + sum(jnp.abs(c) for c in x)
        return _ROUNDING * float(jnp.finfo(x[2].dtype).eps) * size

    def _block_of(self, cell: Int[Array, "*s"], axis: int) -> tuple[Int[Array, "*s"], ...]:
        """Return the block of a cell along an axis, and the first and the last cell of the block."""
        field = self.heights
        index = cell + field.origin_node[axis]
        index = index % field.cells[axis] if field.periodic else index
        block = index >> _LOG2_BLOCK_SIZE
        first = cell - (index - block * BLOCK_SIZE)
        last = cell + (jnp.minimum((block + 1) * BLOCK_SIZE, field.cells[axis]) - 1 - index)
        return block, first, last

    def _cross_block(
        self, ray: _GridRay, state: _Traversal
    ) -> tuple[Bool[Array, "*s"], Scalar, tuple[Int[Array, "*s"], ...]]:
        """Follow rays through their blocks of cells.

        **Returns:** True where a ray stays above the highest node of its block, the distance at which it
        leaves the block, and the cell that it then enters.
        """
        blocks = [self._block_of(cell, axis) for axis, cell in enumerate((state.i, state.j))]
        highest = self.block_maxima.at[blocks[0][0], blocks[1][0]].get(mode="promise_in_bounds")
        edges = [jnp.where(ray.ascending[k], last, first) for k, (_, first, last) in enumerate(blocks)]
        faces = ray.face_distances(edges)
        leave = jnp.minimum(jnp.minimum(faces[0], faces[1]), ray.exit_distance)
        leave = jnp.maximum(leave, state.distance)
        least_height = ray.height + jnp.minimum(ray.height_rate * state.distance, ray.height_rate * leave)
        leaves_along_x = faces[0] <= faces[1]
        next_cell = []
        for k, crossed in enumerate((leaves_along_x, ~leaves_along_x)):
            _, first, last = blocks[k]
            inside = jnp.floor(ray.position[k] + ray.rate[k] * leave).astype(jnp.int32)
            step = jnp.where(ray.ascending[k], 1, -1)
            next_cell.append(jnp.where(crossed, edges[k] + step, jnp.clip(inside, first, last)))
        stays_above = state.above & (least_height > highest + ray.tolerance)
        return stays_above, leave, (next_cell[0], next_cell[1])

    def _clearance(self, ray: _GridRay, distance: Scalar, cell: Cell) -> tuple[Scalar, Scalar, Scalar]:
        """Return the coefficients a, b, c of the clearance within a cell, with u measured from `distance`."""
        c0, cx, cy, cxy = self.heights.bilinear_coefficients(cell)
        rate = ray.rate
        x, y = (ray.position[k] + rate[k] * distance - cell[k].astype(distance.dtype) for k in range(2))
        clearance = ray.height + ray.height_rate * distance - (c0 + cx * x + (cy + cxy * x) * y)
        slope = ray.height_rate - (cx + cxy * y) * rate[0] - (cy + cxy * x) * rate[1]
        return -cxy * rate[0] * rate[1], slope, clearance

    def _traverse(self, ray: _GridRay, state: _Traversal, max_steps: int, stop_at: int = 0) -> _Traversal:
        """Follow rays from cell to cell, for `max_steps` or until at most `stop_at` of them are active."""

        def continue_(state: _Traversal) -> Bool[Array, ""]:
            return any_problem(jnp.sum(state.active) > stop_at) & (state.steps < max_steps)

        def advance(state: _Traversal) -> _Traversal:
            # An optimisation barrier: compilers would compute shared values again for every field
            # of the new state.
            stays_above, block_exit, block_next = barrier(self._cross_block(ray, state))
            faces = ray.face_distances((state.i, state.j))
            cell_exit = jnp.minimum(jnp.minimum(faces[0], faces[1]), ray.exit_distance)
            cell_exit = jnp.maximum(state.distance, cell_exit)
            length = cell_exit - state.distance
            a, b, c = barrier(self._clearance(ray, state.distance, (state.i, state.j)))
            # A ray that is known to be above may be below by rounding.
            c = jnp.where(state.above, jnp.maximum(c, 0.0), c)
            end_clearance = (a * length + b) * length + c
            root, is_real = _falling_root(a, b, c)
            falls_through = (c >= 0) & (end_clearance < 0)
            has_root = is_real & (root >= 0) & (root <= length)
            hit = state.active & ~stays_above & (falls_through | has_root)
            hit, root, cell_exit, end_clearance = barrier((hit, root, cell_exit, end_clearance))
            hit_distance = jnp.where(hit, state.distance + jnp.clip(root, 0.0, length), state.hit_distance)
            distance = jnp.where(stays_above, block_exit, cell_exit)
            active = state.active & ~hit & (distance < ray.exit_distance)
            leaves_along_x = faces[0] <= faces[1]
            step = [jnp.where(is_ascending, 1, -1) for is_ascending in ray.ascending]
            i = jnp.where(stays_above, block_next[0], state.i + jnp.where(leaves_along_x, step[0], 0))
            j = jnp.where(stays_above, block_next[1], state.j + jnp.where(leaves_along_x, 0, step[1]))
            i, j = jnp.where(active, i, state.i), jnp.where(active, j, state.j)
            above = stays_above | (end_clearance >= 0)
            return _Traversal(distance, i, j, above, active, hit_distance, state.steps + 1)

        return lax.while_loop(continue_, advance, vary_together(state))

    def height_bounds_below(
        self, points: Float[np.ndarray | Array, "n 3"], directions: Float[np.ndarray | Array, "n 3"]
    ) -> tuple[Float[np.ndarray | Array, "2 2"], Any, Any]:
        """Bound the surface that a beam can meet, all of whose rays lie among the given lines.

        **Returns:** (2, 2) the smallest and the largest x and y, m, at which rays may meet the surface, and
        the smallest and the largest height, m, in between.
        """
        xp = array_namespace(points)
        heights, spacing = fixed_array(self.heights.values, xp), fixed_array(self.heights.spacing, xp)
        origin, origin_node = (fixed_array(a, xp) for a in (self.heights.origin, self.heights.origin_node))
        south_west = origin - origin_node * spacing
        downward = xp.minimum(directions[:, 2], -1e-9)
        low, high, box = heights.min(), heights.max(), xp.zeros((2, 2))
        # In single precision, rounding must not add cells.
        slack = 0.0 if xp is np else _CELL_SLACK
        # Between two heights the lines stay within a box, within which the heights have closer bounds, and so
        # on.
        for _ in range(4):
            steps = [(z - points[:, 2]) / downward for z in (low, high)]
            # Coordinate by coordinate: NumPy reduces long rows many times faster than columns of two.
            ends = [xp.stack([points[:, k] + directions[:, k] * step for step in steps]) for k in range(2)]
            box = xp.stack([xp.stack([end.min() for end in ends]), xp.stack([end.max() for end in ends])])
            first = xp.floor((box[0] - south_west) / spacing + slack).astype(int)
            last = xp.ceil((box[1] - south_west) / spacing - slack).astype(int)
            if xp is not np:
                in_box = _touches_nodes(first, last, heights.shape, self.heights.periodic)
                low = xp.where(in_box, heights, xp.inf).min()
                high = xp.where(in_box, heights, -xp.inf).max()
                continue
            indices = []
            for a, b, n in zip(first, last, heights.shape):
                # The nodes of all cells that the box touches, each node of a periodic field about once.
                if self.heights.periodic:
                    indices.append(np.arange(a, min(b, a + n) + 1) % n)
                else:
                    indices.append(np.arange(np.clip(a, 0, n - 1), np.clip(b, 0, n - 1) + 1))
            heights_in_box = heights[np.ix_(*indices)]
            low, high = heights_in_box.min(), heights_in_box.max()
        return (box, float(low), float(high)) if xp is np else (box, low, high)

    def crossing(
        self, points: Float[np.ndarray | Array, "n 3"], directions: Float[np.ndarray | Array, "n 3"]
    ) -> tuple[Float[np.ndarray | Array, " n"], Float[np.ndarray | Array, " n"]]:
        _, low, high = self.height_bounds_below(points, directions)
        # Neighbouring lines take the extremes in turn, as the method of the base class asks for.
        xp = array_namespace(points)
        level = xp.where(np.arange(len(points)) % 2, low, high)
        downward = xp.minimum(directions[:, 2], -1e-9)
        return (level - points[:, 2]) / downward, downward


def _touches_nodes(
    first: Int[Array, "2"], last: Int[Array, "2"], shape: tuple[int, ...], periodic: bool
) -> Bool[Array, "nx ny"]:
    """Return True for the nodes between the first and the last along each axis, which may be traced."""
    along_axes = []
    for a, b, n in zip(first, last, shape):
        nodes = jnp.arange(n)
        if periodic:
            along_axes.append((nodes - a) % n <= b - a)
        else:
            along_axes.append((nodes >= jnp.clip(a, 0, n - 1)) & (nodes <= jnp.clip(b, 0, n - 1)))
    return along_axes[0][:, None] & along_axes[1]


def _block_maxima(heights: Raster) -> Float[Array, "blocks_x blocks_y"]:
    """Find the highest node of each block of cells, without derivatives."""
    maxima = lax.stop_gradient(heights.values)
    for axis, cells in enumerate(heights.cells):
        # A cell has the nodes k and k + 1 along each axis.
        if heights.periodic:
            next_nodes = jnp.roll(maxima, -1, axis)
        else:
            next_nodes = lax.slice_in_dim(maxima, 1, cells + 1, axis=axis)
        maxima = jnp.maximum(lax.slice_in_dim(maxima, 0, cells, axis=axis), next_nodes)
        padding = [(0, 0), (0, 0)]
        padding[axis] = (0, -cells % BLOCK_SIZE)
        shape = list(maxima.shape)
        shape[axis : axis + 1] = [-(-cells // BLOCK_SIZE), BLOCK_SIZE]
        padded = jnp.pad(maxima, padding, constant_values=-jnp.inf)
        maxima = jnp.max(padded.reshape(shape), axis=axis + 1)
    return maxima


def _interval_within(
    start: Scalar, rate: Scalar, low: Scalar | float, high: Scalar | float
) -> tuple[Any, Any]:
    """Return the interval of s >= 0 in which start + rate s lies in [low, high]; (FAR, 0) if none."""
    parallel = jnp.abs(rate) < _PARALLEL
    inverse = 1.0 / jnp.where(parallel, 1.0, rate)
    a, b = (low - start) * inverse, (high - start) * inverse
    within = (low <= start) & (start <= high)
    near = jnp.where(parallel, jnp.where(within, 0.0, FAR), jnp.minimum(a, b))
    far_end = jnp.where(parallel, jnp.where(within, FAR, 0.0), jnp.maximum(a, b))
    return jnp.maximum(near, 0.0), far_end


def _falling_root(a: Scalar, b: Scalar, c: Scalar) -> tuple[Scalar, Bool[Array, "..."]]:
    """Solve a u^2 + b u + c = 0 for the root of negative derivative; the flag is False if there is none."""
    discriminant = b * b - 4.0 * a * c
    root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
    rising = b > 0
    divisor = jnp.where(rising, 2.0 * a, root - b)
    no_root = divisor == 0
    value = jnp.where(rising, -(b + root), 2.0 * c) / jnp.where(no_root, 1.0, divisor)
    return jnp.where(no_root, FAR, value), (discriminant >= 0) & ~no_root
