r"""Height fields: surfaces whose height is known at the nodes of a grid, and bilinear in between.

A ray x + s w lies above the surface by z(s) - h(x(s), y(s)), which within one cell is a quadratic in s,

    f(u) = a u^2 + b u + c,   u from where the ray enters the cell.

Rays go from cell to cell and stop where f falls through zero. That root is the one at which the derivative is
-sqrt(b^2 - 4 a c), whatever the sign of a:

    u = 2 c / (sqrt(b^2 - 4 a c) - b)          for b <= 0,
    u = -(b + sqrt(b^2 - 4 a c)) / (2 a)       for b > 0,

neither of which loses digits. Light that starts on the surface rises from it, so that the point where it
starts is no such root. Whether a ray is above is carried from cell to cell, so none slips through an edge by
rounding. A ray that stays above the highest point of a block of cells crosses the block at once (maximum
mipmaps; Tevs, Ihrke and Seidel 2008, Symposium on Interactive 3D Graphics and Games).
"""

from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._checks import concrete_array
from jaxlidar._one_function import once
from jaxlidar._vectors import FAR, Scalar, Vec, along, dot, normalise, vec
from jaxlidar.scenes.raster import Cell, Raster
from jaxlidar.scenes.shapes import AbstractShape

# Cells that a ray may cross where the field repeats without end.
MOST_CELLS = 16_384
# Cells along each side of a block: a power of two, for processors divide integers one by one.
_POWER = 3
BLOCK = 1 << _POWER
# In units of the precision and of its coordinates, how far under the surface a ray may start.
_ROUNDING = 10
# Of so many rays and more, the last go on by themselves when no more are left than one in so many.
_MANY, _LONG = 128, 8
# Rays that close in on the surface by less than this per m have the derivative of those that do by this.
_GRAZING = 1e-4


class _Ray(eqx.Module):
    """A ray among cells: how far it has come, in which cell it is, and where it meets the surface."""

    at: Float[Array, "*s"]
    i: Int[Array, "*s"]
    j: Int[Array, "*s"]
    above: Bool[Array, "*s"]
    running: Bool[Array, "*s"]
    met: Float[Array, "*s"]
    count: Int[Array, ""]


class _Way(eqx.Module):
    """The line of a ray over the cells.

    - `z`, `climb`: its height, m, and the change of it per m. - `place`, `rate`: the same among cells.
    - `gap`, `offset`: it leaves cell number v along an axis at the distance `gap * v + offset`, m; `ahead`:
      whether to larger numbers. - `leave`: distance at which it has left all cells that it may meet, m.
    - `slack`: how far rounding may put it under the surface, m.
    """

    z: Float[Array, "*s"]
    climb: Float[Array, "*s"]
    place: tuple[Float[Array, "*s"], ...]
    rate: tuple[Float[Array, "*s"], ...]
    gap: tuple[Float[Array, "*s"], ...]
    offset: tuple[Float[Array, "*s"], ...]
    ahead: tuple[Bool[Array, "*s"], ...]
    leave: Float[Array, "*s"]
    slack: Float[Array, "*s"]


@final
class HeightField(AbstractShape):
    """A height field over the rectangle of its nodes, or over the whole plane where it is periodic.

    Rays that fall from above are stopped; those that rise from below pass. The edge has no sides.

    **Arguments:**

    - `heights`: a `Raster` of heights, m.
    - `low`, `high`: the lowest and the highest of them, m.
    - `tops`: the highest of each block of cells, m.
    """

    heights: Raster
    low: Float[Array, ""]
    high: Float[Array, ""]
    tops: Float[Array, "blocks_x blocks_y"]

    @staticmethod
    def of(heights: Raster) -> "HeightField":
        """The height field of a raster of heights in m."""
        values = heights.values
        return HeightField(heights, jnp.min(values), jnp.max(values), _tops(heights))

    @property
    def lights_itself(self) -> bool:
        return True

    def moved(self, by: Float[Array, "3"]) -> "HeightField":
        heights = self.heights.moved(by[:2])
        heights = eqx.tree_at(lambda r: r.values, heights, heights.values + by[2])
        return HeightField(heights, self.low + by[2], self.high + by[2], self.tops + by[2])

    def tangent(self, x: Vec) -> tuple[Vec, Scalar]:
        height, (east, north) = self.heights.with_slope(x)
        # Compilers would look it up again for every result that depends on it.
        normal, height = once((normalise((-east, -north, jnp.ones_like(east))), height))
        return normal, dot(normal, (x[0], x[1], height))

    def distance(self, x: Vec, w: Vec) -> Scalar:
        x, w = (vec(jnp.broadcast_arrays(*v)) for v in (x, w))
        fixed, start, way = jax.tree.map(lax.stop_gradient, (self, x, w))
        found = fixed._march(start, way)
        met = found < FAR
        found = jnp.where(met, found, 0.0)
        # Where the ray is above the surface by nothing: the derivative of that, not of the march.
        point = along(x, w, found)
        height, (east, north) = self.heights.with_slope(point)
        falling = lax.stop_gradient(w[2] - east * w[0] - north * w[1])
        gap = point[2] - height
        moved = (gap - lax.stop_gradient(gap)) / jnp.minimum(falling, -_GRAZING)
        return jnp.where(met, found - moved, FAR)

    def _march(self, x: Vec, w: Vec) -> Scalar:
        """Distance to the first point where a ray falls through the surface; without derivatives."""
        shape = x[0].shape
        way, ray = self._enter(*(vec(a.reshape(-1) for a in v) for v in (x, w)))
        most = MOST_CELLS if self.heights.periodic else sum(self.heights.cells) + 2
        if ray.at.size >= _MANY:
            few = ray.at.size // _LONG
            ray = self._follow(way, ray, most, few)
            # All rays of a loop wait for the longest, which takes many times the steps of most: the last
            # ones go on by themselves.
            some = jnp.sum(ray.running)
            turn = jnp.where(ray.running, jnp.cumsum(ray.running) - 1, few)
            number = jnp.arange(ray.at.size, dtype=jnp.int32)
            last = jnp.zeros(few, jnp.int32).at[turn].set(number, mode="drop")
            own, part = jax.tree.map(lambda a: a[last] if a.ndim else a, (way, ray))
            part = eqx.tree_at(lambda r: r.running, part, number[:few] < some)
            met = self._follow(own, part, most).met
            met = ray.met.at[jnp.where(number[:few] < some, last, number.size)].set(met, mode="drop")
        else:
            met = self._follow(way, ray, most).met
        return met.reshape(shape)

    def _enter(self, x: Vec, w: Vec) -> tuple[_Way, _Ray]:
        """Rays where they come to cells over which they may meet the surface."""
        field = self.heights
        place = field.place(x)
        rate = [w[k] / field.spacing[k] for k in range(2)]
        slack = self._slack(x)
        enter, leave = _between(x[2], w[2], self.low - slack, self.high + slack)
        if not field.periodic:
            for k in range(2):
                near, far = _between(place[k], rate[k], *field.bounds[k])
                enter, leave = jnp.maximum(enter, near), jnp.minimum(leave, far)
        running = enter < leave
        enter = jnp.where(running, enter, 0.0)
        gap, offset, ahead = [], [], []
        for k in range(2):
            flat = jnp.abs(rate[k]) < 1e-12
            ahead.append(rate[k] > 0)
            inverse = 1.0 / jnp.where(flat, 1.0, rate[k])
            gap.append(jnp.where(flat, 0.0, inverse))
            offset.append(jnp.where(flat, FAR, (jnp.where(ahead[k], 1.0, 0.0) - place[k]) * inverse))
        way = _Way(
            x[2], w[2], tuple(place), tuple(rate), tuple(gap), tuple(offset), tuple(ahead), leave, slack
        )
        start = field.cell((place[0] + rate[0] * enter, place[1] + rate[1] * enter))
        above = self._rise(way, enter, start)[2] > -slack
        far = jnp.full_like(enter, FAR)
        return way, _Ray(enter, *start, above, running, far, jnp.zeros((), jnp.int32))

    def _slack(self, x: Vec) -> Scalar:
        """How far rounding may put a ray under the surface, m."""
        field = self.heights
        size = self.high - self.low + field.spacing[0] + field.spacing[1] + sum(jnp.abs(c) for c in x)
        return _ROUNDING * float(jnp.finfo(x[2].dtype).eps) * size

    def _block(self, number: Int[Array, "*s"], k: int) -> tuple[Int[Array, "*s"], ...]:
        """Number of the block of a cell along an axis, and the first and the last of its cells."""
        field = self.heights
        place = number + field.number[k]
        place = place % field.cells[k] if field.periodic else place
        block = place >> _POWER
        first = number - (place - block * BLOCK)
        last = number + (jnp.minimum((block + 1) * BLOCK, field.cells[k]) - 1 - place)
        return block, first, last

    def _across(self, way: _Way, ray: _Ray) -> tuple[Bool[Array, "*s"], Scalar, tuple[Int[Array, "*s"], ...]]:
        """Whether a ray stays above its block, where it leaves it, and the cell that it comes to."""
        blocks = [self._block(number, k) for k, number in enumerate((ray.i, ray.j))]
        top = self.tops.at[blocks[0][0], blocks[1][0]].get(mode="promise_in_bounds")
        edges = [jnp.where(way.ahead[k], last, first) for k, (_, first, last) in enumerate(blocks)]
        faces = [way.gap[k] * edges[k] + way.offset[k] for k in range(2)]
        out = jnp.minimum(jnp.minimum(faces[0], faces[1]), way.leave)
        out = jnp.maximum(out, ray.at)
        least = way.z + jnp.minimum(way.climb * ray.at, way.climb * out)
        first = faces[0] <= faces[1]
        to = []
        for k, crossed in enumerate((first, ~first)):
            _, low, high = blocks[k]
            inside = jnp.floor(way.place[k] + way.rate[k] * out).astype(jnp.int32)
            step = jnp.where(way.ahead[k], 1, -1)
            to.append(jnp.where(crossed, edges[k] + step, jnp.clip(inside, low, high)))
        return ray.above & (least > top + way.slack), out, (to[0], to[1])

    def _rise(self, way: _Way, at: Scalar, cell: Cell) -> tuple[Scalar, Scalar, Scalar]:
        """Coefficients of the height above the surface, from the distance `at` on: of u^2, u and 1."""
        one, a, b, c = self.heights.corners(cell)
        rate = way.rate
        px, py = (way.place[k] + rate[k] * at - cell[k] for k in range(2))
        height = way.z + way.climb * at - (one + a * px + (b + c * px) * py)
        return -c * rate[0] * rate[1], way.climb - (a + c * py) * rate[0] - (b + c * px) * rate[1], height

    def _follow(self, way: _Way, ray: _Ray, most: int, few: int = 0) -> _Ray:
        """Rays after `most` cells or blocks, or when no more than a few have not stopped."""

        def going(ray: _Ray) -> Bool[Array, ""]:
            return (jnp.sum(ray.running) > few) & (ray.count < most)

        def advance(ray: _Ray) -> _Ray:
            # Compilers would compute what is shared again for every part of the ray.
            clear, out, (east, north) = once(self._across(way, ray))
            faces = [way.gap[k] * number + way.offset[k] for k, number in enumerate((ray.i, ray.j))]
            until = jnp.maximum(ray.at, jnp.minimum(jnp.minimum(faces[0], faces[1]), way.leave))
            length = until - ray.at
            a, b, c = once(self._rise(way, ray.at, (ray.i, ray.j)))
            c = jnp.where(ray.above, jnp.maximum(c, 0.0), c)
            end = (a * length + b) * length + c
            root, real = _falling_root(a, b, c)
            through = (c >= 0) & (end < 0)
            hit = ray.running & ~clear & (through | (real & (root >= 0) & (root <= length)))
            hit, root, until, end = once((hit, root, until, end))
            met = jnp.where(hit, ray.at + jnp.clip(root, 0.0, length), ray.met)
            until = jnp.where(clear, out, until)
            go = ray.running & ~hit & (until < way.leave)
            first = faces[0] <= faces[1]
            step = [jnp.where(a, 1, -1) for a in way.ahead]
            i = jnp.where(clear, east, ray.i + jnp.where(first, step[0], 0))
            j = jnp.where(clear, north, ray.j + jnp.where(first, 0, step[1]))
            i, j = jnp.where(go, i, ray.i), jnp.where(go, j, ray.j)
            return _Ray(until, i, j, clear | (end >= 0), go, met, ray.count + 1)

        return lax.while_loop(going, advance, ray)

    def beneath(
        self, points: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "2 2"], float, float]:
        """What lies beneath a beam, all of whose rays are among the given lines.

        **Returns:** (2, 2) the least and the largest x and y, m, that rays may have where they meet the
        surface, and the least and the largest height, m, in between.
        """
        heights, spacing = concrete_array(self.heights.values), concrete_array(self.heights.spacing)
        origin = concrete_array(self.heights.origin) - concrete_array(self.heights.number) * spacing
        steep = np.minimum(directions[:, 2], -1e-9)
        low, high, box = heights.min(), heights.max(), np.zeros((2, 2))
        # The beam between the bounds lies within a box, within which there may be closer bounds.
        for _ in range(4):
            ends = [points + directions * ((z - points[:, 2]) / steep)[:, None] for z in (low, high)]
            box = np.stack([f(np.concatenate(ends)[:, :2], axis=0) for f in (np.min, np.max)])
            first = np.floor((box[0] - origin) / spacing).astype(int)
            last = np.ceil((box[1] - origin) / spacing).astype(int)
            numbers = []
            for a, b, n in zip(first, last, heights.shape):
                # The cells that the box touches; of one that repeats, no more than all.
                along = np.arange(a, min(b, a + n) + 1)
                numbers.append(along % n if self.heights.periodic else np.unique(np.clip(along, 0, n - 1)))
            part = heights[np.ix_(*numbers)]
            low, high = part.min(), part.max()
        return box, float(low), float(high)

    def crossing(
        self, points: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        _, low, high = self.beneath(points, directions)
        level = np.where(np.arange(len(points)) % 2, low, high)
        steep = np.minimum(directions[:, 2], -1e-9)
        return (level - points[:, 2]) / steep, steep


def _tops(heights: Raster) -> Float[Array, "blocks_x blocks_y"]:
    """The highest node of each block of cells, without derivatives."""
    top = lax.stop_gradient(heights.values)
    for axis, cells in enumerate(heights.cells):
        ahead = (
            jnp.roll(top, -1, axis) if heights.periodic else lax.slice_in_dim(top, 1, cells + 1, axis=axis)
        )
        top = jnp.maximum(lax.slice_in_dim(top, 0, cells, axis=axis), ahead)
        room = [(0, 0), (0, 0)]
        room[axis] = (0, -cells % BLOCK)
        shape = list(top.shape)
        shape[axis : axis + 1] = [-(-cells // BLOCK), BLOCK]
        top = jnp.max(jnp.pad(top, room, constant_values=-jnp.inf).reshape(shape), axis=axis + 1)
    return top


def _between(at: Scalar, rate: Scalar, low: Scalar | float, high: Scalar | float) -> tuple[Any, Any]:
    """Between which distances, from 0 on, a coordinate lies between two bounds; never: (FAR, 0)."""
    flat = jnp.abs(rate) < 1e-12
    inverse = 1.0 / jnp.where(flat, 1.0, rate)
    a, b = (low - at) * inverse, (high - at) * inverse
    within = (low <= at) & (at <= high)
    near = jnp.where(flat, jnp.where(within, 0.0, FAR), jnp.minimum(a, b))
    far = jnp.where(flat, jnp.where(within, FAR, 0.0), jnp.maximum(a, b))
    return jnp.maximum(near, 0.0), far


def _falling_root(a: Scalar, b: Scalar, c: Scalar) -> tuple[Scalar, Bool[Array, "..."]]:
    """Where a u^2 + b u + c falls through zero, and whether it does for any real u."""
    square = b * b - 4.0 * a * c
    root = jnp.sqrt(jnp.maximum(square, 0.0))
    rising = b > 0
    divisor = jnp.where(rising, 2.0 * a, root - b)
    none = divisor == 0
    value = jnp.where(rising, -(b + root), 2.0 * c) / jnp.where(none, 1.0, divisor)
    return jnp.where(none, FAR, value), (square >= 0) & ~none
