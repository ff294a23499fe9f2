r"""Trees of bounding boxes over triangles, and rays that meet them, without a stack.

Both levels of the structure are complete binary trees in heap order: node n has the children 2 n and 2 n + 1,
the root is 1, and the N = 2^depth leaves are the nodes N to 2 N - 1. The leaves of the upper tree are
instances of meshes, those of a lower tree the triangles of one mesh. All nodes are rows of one table of
twelve numbers:

    inner node              lowest corners of the boxes of both children, then their highest corners
    leaf of the upper tree  the matrix M and the point o: a point x is M (x - o) in coordinates of the mesh
    leaf of a lower tree    the three corners of a triangle, and the number of its material

so that a step of a ray reads one row, whatever its node is. A ray meets the nearer child first. In place of a
stack it carries a *trail*, a bit for each level above its node: one where the sibling must still be visited
(Barringer and Akenine-Moeller 2013, J. Comput. Graph. Tech. 2(1), 38). With k the number of zeros at the end
of the trail, the next node is the sibling of the ancestor k levels up, (n >> k) XOR 1.

Rays meet triangles by signed areas of their edges, seen along the ray (Woop, Benthin and Wald 2013, J.
Comput. Graph. Tech. 2(1), 65). Neighbours compute the area of a shared edge from the same numbers. An area
counts as zero, and so as inside, within what fused multiplications, which compilers use where they can, may
make the areas of neighbours differ by: no gap opens. A triangle that stands alone grows by that on each side,
some 3e-8 times the distance that the ray has come across its largest component.

Where triangles of several materials lie in one plane, nearer to one another than the rounding of their
distances, rounding would mix the materials: a ray meets the one with the lowest number.

Where the scene repeats, with the period L along x and y, the upper tree holds what lies in one cell of L x L,
whole instances: those that cross its sides lie on both. A ray is followed from cell to cell, in each with its
start shifted by whole periods, and stops at the first triangle that it meets before it leaves the cell.

The search is not differentiated. `triangle_plane` then gives the distance to the plane of the triangle with
its derivatives.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._jax.mesh_axes import vary_with
from jaxlidar._jax.one_function import barrier, one_function
from jaxlidar._vectors import FAR, Scalar, Vec, cross, dot, scale, vec, with_derivative_of

# Numbers in a row of the table.
ROW = 12
# Components of directions below this count as this: its inverse times a length stays finite.
_PARALLEL = 1e-15
# Coordinate of boxes that no ray meets: beyond `FAR`.
_NOWHERE = 1e35
# Rays that are followed at once.
_LANES = 128
# So few rays take less time one by one: a step of all lanes takes as long as about thirty of a single ray.
_FEW = 24
# By how much a signed area may be negative, in units of the precision and of a bound on the difference of two
# compilations of it. That is in units of half the precision, and each of two neighbours needs a half of it.
_AREA_ROUNDING = 0.25
# Rounding of the distance of a triangle, in units of the floating-point precision and of coordinates, and the
# largest rise of a triangle along a ray, over its width, by which it grows.
_DISTANCE_ROUNDING, _MAX_RISE = 4.0, 100.0
# Relative slack of the distances at which a ray leaves a box (Ize 2013, J. Comput. Graph. Tech. 2(2), 12).
_BOX_ROUNDING = 8.0
# Cells of a repeating scene through which a ray is followed: only rays which are level to one
# part in thousands may meet a triangle farther away.
MAX_PERIODS = 4096
# Smallest cosine of incidence in derivatives: those of grazing rays are bounded.
_MIN_COSINE = 1e-4


class Instance(NamedTuple):
    """The lower tree of an instance: the row before its root, its number of leaves, and 1 if one-sided."""

    first_row: Int[Array, "*s"] | int
    n_leaves: Int[Array, "*s"] | int
    one_sided: Int[Array, "*s"] | int


class TriangleTree(eqx.Module):
    """An upper tree over instances, and the lower trees of their meshes.

    - `table`: rows of all trees; those of the upper tree first.
    - `instances`: for each leaf of the upper tree, the numbers of its `Instance`.
    - `box`: the lowest and the highest corner of the box around everything, m.
    - `uniform`: the `Instance` of all leaves where they have the same numbers; else None.
    - `period`: those along x and y, m, of a scene that repeats: its cells have corners at multiples of these.
      None for one that does not.
    - `several_materials`: False where all triangles have the same one.
    """

    table: Float[Array, "rows 12"]
    instances: Int[Array, "leaves 3"]
    box: Float[Array, "2 3"]
    uniform: tuple[int, int, int] | None = eqx.field(static=True)
    period: Float[Array, "2"] | None = None
    several_materials: bool = eqx.field(static=True, default=False)

    @property
    def n_leaves(self) -> int:
        """Number of leaves of the upper tree."""
        return self.instances.shape[0]


class TriangleHit(NamedTuple):
    """The triangles that rays meet first.

    - `distance`: m; FAR where none is met. - `row`: that of the triangle in the table. - `leaf`: that of the
      instance among the leaves of the upper tree.
    - `cell`: the cell along x and y in which that is, where the scene repeats; else None.
    """

    distance: Float[Array, "*s"]
    row: Int[Array, "*s"]
    leaf: Int[Array, "*s"]
    cell: tuple[Int[Array, "*s"], Int[Array, "*s"]] | None = None


def tree_order(corners: Float[np.ndarray, "n 3 3"]) -> Int[np.ndarray, " leaves"]:
    """Return the triangle of each leaf of a complete tree; some occur twice, to fill up the last level.

    Nodes are split at the median of their triangles' centres along the longest axis, level by level, so that
    all nodes of a level are split at once.
    """
    centre = 0.5 * (corners.min(axis=1) + corners.max(axis=1))
    n_triangles = len(corners)
    depth = (n_triangles - 1).bit_length()
    order = np.arange(1 << depth) % n_triangles
    for level in range(depth):
        nodes = order.reshape(1 << level, -1)
        centres = centre[nodes]
        axis = np.argmax(centres.max(axis=1) - centres.min(axis=1), axis=1)
        position = np.take_along_axis(centres, axis[:, None, None], axis=2)[..., 0]
        order = np.take_along_axis(nodes, np.argsort(position, axis=1, kind="stable"), axis=1).reshape(-1)
    return order.astype(np.int32)


def tree_rows(
    leaf_rows: Float[Array, "leaves 12"], low: Float[Array, "leaves 3"], high: Float[Array, "leaves 3"]
) -> tuple[Float[Array, "rows 12"], Float[Array, "2 3"]]:
    """Return the rows of a tree, the first of which is not used, and the corners of the box of its root.

    `low`, `high`: corners of the boxes of the leaves; of spare leaves the highest lies below the lowest.
    """
    levels = [leaf_rows]
    while len(low) > 1:
        # Rays meet no box at such a distance. In the union with a sibling, a box turned inside out adds
        # nothing.
        corners = [jnp.where(low > high, _NOWHERE, a).reshape(-1, 6) for a in (low, high)]
        levels.append(jnp.concatenate(corners, axis=1))
        low, high = (f(a.reshape(-1, 2, 3), axis=1) for f, a in ((jnp.min, low), (jnp.max, high)))
    rows = jnp.concatenate([jnp.zeros_like(leaf_rows[:1]), *levels[::-1]])
    return rows, jnp.concatenate([low, high])


def triangle_rows(
    corners: Float[Array, "leaves 3 3"], material: Int[Array, "leaves"]
) -> tuple[Float[Array, "rows 12"], Float[Array, "2 3"]]:
    """Return the rows of the tree of a mesh, and its bounding box; triangles in the order of the leaves."""
    numbers = jnp.stack([material.astype(corners.dtype)] + [jnp.zeros_like(corners[:, 0, 0])] * 2, axis=1)
    leaf_rows = jnp.concatenate([corners.reshape(-1, 9), numbers], axis=1)
    return tree_rows(leaf_rows, jnp.min(corners, axis=1), jnp.max(corners, axis=1))


def instance_order(centre: Float[Array, "leaves 3"], is_real: Bool[Array, "leaves"]) -> Int[Array, "leaves"]:
    """Return instances in the order of a space-filling curve (Morton 1966), spare ones at its end.

    Instances are moved by transformations that JAX may trace: their order is found within the program, by one
    sort of integers.
    """
    centre = lax.stop_gradient(centre)
    low = jnp.min(jnp.where(is_real[:, None], centre, FAR), axis=0)
    high = jnp.max(jnp.where(is_real[:, None], centre, -FAR), axis=0)
    # One scale for all axes, so that cells of the curve are cubes.
    position = (centre - low[None]) / jnp.maximum(jnp.max(high - low), 1e-30)
    cell = jnp.clip(position * 1023.0, 0.0, 1023.0).astype(jnp.uint32)
    code = jnp.zeros(len(centre), jnp.uint32)
    for bit in range(10):
        for axis in range(3):
            code |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    return jnp.argsort(jnp.where(is_real, code, jnp.uint32(2**32 - 1)))


class _CellWalk(eqx.Module):
    """Where rays are in a scene that repeats.

    - `start`: x and y at which rays start. - `cell`: numbers of the cell along x and y.
    - `leave`: distance at which rays leave the cell, m. - `last`: distance beyond which nothing lies.
    - `count`: number of cells so far.
    """

    start: tuple[Float[Array, "*lanes"], Float[Array, "*lanes"]]
    cell: tuple[Int[Array, "*lanes"], Int[Array, "*lanes"]]
    leave: Float[Array, "*lanes"]
    last: Float[Array, "*lanes"]
    count: Int[Array, "*lanes"]


class _TreeTraversal(eqx.Module):
    """State of the rays in some lanes on their way through the trees.

    - `ray`: number of the ray in each lane; their count in lanes without one.
    - `upper_x`, `upper_w`: start and direction of the ray. - `x`, `w`: the same in coordinates of the mesh.
    - `upper_node`, `upper_trail`: in the upper tree. - `node`, `trail`: in the lower tree.
    - `inside`: True if the ray is in a lower tree. - `active`: False for rays that have no node left.
    - `instance`: that of the lower tree, where instances differ.
    - `distance`, `row`, `leaf`: as in `TriangleHit`; until a triangle is met, `distance` is that beyond which
      none counts, and `row` is zero.
    - `material`, `rounding`: number of the material of that triangle, and bound on the rounding of its
      distance, m; None where all have the same material.
    - `walk`: where the ray is in a scene that repeats; else None.
    """

    ray: Int[Array, "*lanes"]
    upper_x: Vec
    upper_w: Vec
    x: Vec
    w: Vec
    upper_node: Int[Array, "*lanes"]
    upper_trail: Int[Array, "*lanes"]
    node: Int[Array, "*lanes"]
    trail: Int[Array, "*lanes"]
    inside: Bool[Array, "*lanes"]
    active: Bool[Array, "*lanes"]
    instance: Instance | None
    distance: Float[Array, "*lanes"]
    row: Int[Array, "*lanes"]
    leaf: Int[Array, "*lanes"]
    material: Float[Array, "*lanes"] | None
    rounding: Float[Array, "*lanes"] | None
    walk: _CellWalk | None


class _RayQueue(eqx.Module):
    """Rays that wait, those in lanes, and what others have met.

    - `lanes`: the rays that are being followed. - `n_sent`: number of rays of the queue that have been.
    - `hit`: of all rays, with a spare one at the end.
    """

    lanes: _TreeTraversal
    n_sent: Int[Array, ""]
    hit: TriangleHit


def nearest_triangle(
    tree: TriangleTree, x: Vec, w: Vec, active: Bool[Array, "*s"] | None = None, *, any_hit: bool = False
) -> TriangleHit:
    """Find the triangles that rays meet first; with `any_hit`, one that they meet.

    Rays take very different numbers of steps, and most may miss all meshes. All lanes of a loop wait for its
    last ray, so that rays take turns (persistent threads; Aila and Laine 2009, High Performance Graphics):

    1. Put the rays that meet the box around everything into a queue.
    2. Follow as many as there are lanes, until half of these are idle (`_visit_node`).
    3. Note what the finished rays have met, fill their lanes from the queue, and go on with 2.
    4. Once the queue is empty and few rays are left, follow each of these to its end, one by one.

    **Arguments:** `x`, `w`: starts and directions. `active`: False for rays that need no answer.
    """
    shape = jnp.broadcast_shapes(*(a.shape for a in (*x, *w)))
    tree = jax.tree.map(lax.stop_gradient, tree)
    x, w = (vec(jnp.broadcast_to(lax.stop_gradient(a), shape).reshape(-1) for a in v) for v in (x, w))
    n_rays, precision = x[0].size, float(jnp.finfo(tree.table.dtype).eps)
    low, high = (list(corner) for corner in tree.box)
    if tree.period is not None:
        # Copies stand everywhere: what counts is the layer in which they lie.
        endless = jnp.full_like(low[2], _NOWHERE)
        low, high = [-endless, -endless, low[2]], [endless, endless, high[2]]
    waits, _ = _box_distance(low, high, x, _inverse(w), jnp.full_like(x[0], FAR), precision)
    if active is not None:
        waits &= jnp.broadcast_to(active, shape).reshape(-1)
    zero = jnp.zeros(n_rays + 1, jnp.int32)
    cell = None if tree.period is None else (zero, zero)
    missed = TriangleHit(jnp.full(n_rays + 1, FAR, tree.table.dtype), zero, zero, cell)
    n_lanes = min(n_rays, _LANES)
    # Stream compaction: the numbers of rays that wait, in order.
    n_waiting = jnp.sum(waits, dtype=jnp.int32)
    rank = jnp.where(waits, jnp.cumsum(waits, dtype=jnp.int32) - 1, n_rays)
    numbers = jnp.arange(n_rays, dtype=jnp.int32)
    queue = jnp.full(n_rays, n_rays, jnp.int32).at[rank].set(numbers, mode="drop")

    def send(ray: Int[Array, "lanes"]) -> _TreeTraversal:
        """Return rays at the root of the upper tree; lanes whose number is that of no ray are idle."""
        zero = jnp.zeros_like(ray)
        number = jnp.minimum(ray, n_rays - 1)
        start, direction = (vec(a[number] for a in v) for v in (x, w))
        distance, walk = jnp.full(ray.shape, FAR, tree.table.dtype), None
        if tree.period is not None:
            walk = _enter_cells(tree, start, direction, precision)
            start, distance = _start_in_cell(tree.period, walk, start), walk.leave
        return _TreeTraversal(
            ray=ray,
            upper_x=start,
            upper_w=direction,
            x=start,
            w=direction,
            upper_node=zero + 1,
            upper_trail=zero,
            node=zero + 1,
            trail=zero,
            inside=zero > 0,
            active=ray < n_rays,
            instance=Instance(zero, zero + 1, zero) if tree.uniform is None else None,
            distance=distance,
            row=zero,
            leaf=zero,
            material=jnp.zeros_like(distance) if tree.several_materials else None,
            rounding=jnp.zeros_like(distance) if tree.several_materials else None,
            walk=walk,
        )

    def follow(lanes: _TreeTraversal, n_idle: Int[Array, ""]) -> _TreeTraversal:
        """Follow rays until more than `n_idle` lanes are idle, or all are."""

        def traverse(state: tuple[_TreeTraversal, Array]) -> tuple[_TreeTraversal, Array]:
            def continue_(state: tuple[_TreeTraversal, Array]) -> Bool[Array, ""]:
                n_active = jnp.sum(state[0].active, dtype=jnp.int32)
                return (n_active > 0) & (n_active >= n_lanes - state[1])

            def visit(state: tuple[_TreeTraversal, Array]) -> tuple[_TreeTraversal, Array]:
                return _visit_node(tree, state[0], any_hit, precision), state[1]

            return lax.while_loop(continue_, visit, state)

        # The loop is never differentiated, so that it may always be compiled as one function.
        return one_function(traverse)((lanes, n_idle))[0]

    def note(hit: TriangleHit, lanes: _TreeTraversal) -> TriangleHit:
        """Note what finished rays have met; idle lanes write to the spare ray."""
        number = jnp.where(lanes.active, n_rays, lanes.ray)
        return jax.tree.map(lambda a, b: a.at[number].set(b), hit, _result(lanes))

    def take_turns(state: _RayQueue) -> _RayQueue:
        """Fill idle lanes from the queue, and follow rays until half of the lanes are idle."""
        is_idle = ~state.lanes.active
        hit = note(state.hit, state.lanes)
        position = state.n_sent + jnp.cumsum(is_idle, dtype=jnp.int32) - 1
        is_sent = is_idle & (position < n_waiting)
        fresh = send(jnp.where(is_sent, queue[jnp.minimum(position, n_rays - 1)], n_rays))
        lanes = jax.tree.map(lambda a, b: jnp.where(is_idle, a, b), fresh, state.lanes)
        n_sent = jnp.minimum(state.n_sent + jnp.sum(is_idle, dtype=jnp.int32), n_waiting)
        # Nobody waits any more: follow the last ones until few are left.
        n_idle = jnp.where(n_sent < n_waiting, n_lanes // 2, n_lanes - _FEW)
        return _RayQueue(follow(lanes, n_idle), n_sent, hit)

    def goes_on(state: _RayQueue) -> Bool[Array, ""]:
        return (state.n_sent < n_waiting) | (jnp.sum(state.lanes.active, dtype=jnp.int32) >= _FEW)

    def finish(state: _RayQueue) -> TriangleHit:
        """Follow the rays that are left to their ends, one by one, and return what all have met."""
        lanes, hit = state.lanes, note(state.hit, state.lanes)
        unfinished = jnp.flatnonzero(lanes.active, size=min(n_lanes, _FEW), fill_value=0)

        def traverse(state: tuple[_TreeTraversal, Array]) -> tuple[Array, TriangleHit]:
            lanes, lane = state
            ray = jax.tree.map(lambda a: a.at[lane].get(mode="promise_in_bounds"), lanes)
            ray = lax.while_loop(lambda s: s.active, lambda s: _visit_node(tree, s, any_hit, precision), ray)
            return ray.ray, _result(ray)

        def one_lane(n: Array, hit: TriangleHit) -> TriangleHit:
            number, result = one_function(traverse)((lanes, unfinished[n]))
            return jax.tree.map(lambda a, b: a.at[number].set(b), hit, result)

        return lax.fori_loop(0, jnp.sum(lanes.active, dtype=jnp.int32), one_lane, hit)

    idle = send(jnp.full(n_lanes, n_rays, jnp.int32))
    state = vary_with(_RayQueue(idle, jnp.zeros((), jnp.int32), missed), (tree, x, w, waits))
    state = lax.while_loop(goes_on, take_turns, state)
    return jax.tree.map(lambda a: a[:n_rays].reshape(shape), finish(state))


def _result(rays: _TreeTraversal) -> TriangleHit:
    """Return what rays have met that have come to their ends."""
    distance = jnp.where(rays.row > 0, rays.distance, FAR)
    return TriangleHit(distance, rays.row, rays.leaf, None if rays.walk is None else rays.walk.cell)


def _enter_cells(tree: TriangleTree, x: Vec, w: Vec, precision: float) -> _CellWalk:
    """Return rays in the cell of a repeating scene in which they enter the layer of its triangles."""
    assert tree.period is not None
    inverse, (low, high) = _inverse(w), tree.box
    ends = [(corner[2] - x[2]) * inverse[2] for corner in (low, high)]
    enter = jnp.maximum(jnp.minimum(*ends), 0.0)
    last = jnp.maximum(*ends) * (1.0 + _BOX_ROUNDING * precision)
    position = [(a + enter * b) / length for a, b, length in zip(x, w, tree.period)]
    cell = (jnp.floor(position[0]).astype(jnp.int32), jnp.floor(position[1]).astype(jnp.int32))
    walk = _CellWalk((x[0], x[1]), cell, enter, last, jnp.zeros_like(cell[0]))
    leave = jnp.minimum(*_cell_sides(tree.period, walk, w))
    return eqx.tree_at(lambda a: a.leave, walk, jnp.maximum(leave, enter) * (1.0 + _BOX_ROUNDING * precision))


def _cell_sides(period: Array, walk: _CellWalk, w: Vec) -> list[Scalar]:
    """Return the distances at which rays cross the sides of their cells ahead, along x and y."""
    sides = []
    for n, a, length, x in zip(walk.cell, w, period, walk.start):
        ahead = (n + (a > 0)).astype(a.dtype) * length - x
        is_parallel = jnp.abs(a) < _PARALLEL
        sides.append(jnp.where(is_parallel, FAR, ahead / jnp.where(is_parallel, 1.0, a)))
    return sides


def _start_in_cell(period: Array, walk: _CellWalk, x: Vec) -> Vec:
    """Return the starts of rays, shifted by as many periods as their cell lies away."""
    shifted = [a - n.astype(a.dtype) * length for a, n, length in zip(walk.start, walk.cell, period)]
    return vec([*shifted, x[2]])


def _next_cell(period: Array, walk: _CellWalk, w: Vec, precision: float) -> tuple[_CellWalk, Array]:
    """Return rays in the cell behind theirs, and True where there may be anything."""
    sides = _cell_sides(period, walk, w)
    is_x = sides[0] <= sides[1]
    goes_on = (jnp.minimum(*sides) < walk.last) & (walk.count < MAX_PERIODS)
    steps = [jnp.where(a > 0, 1, -1).astype(jnp.int32) for a in w[:2]]
    cell = (
        walk.cell[0] + jnp.where(is_x, steps[0], 0),
        walk.cell[1] + jnp.where(is_x, 0, steps[1]),
    )
    entered = _CellWalk(walk.start, cell, walk.leave, walk.last, walk.count + 1)
    leave = jnp.minimum(*_cell_sides(period, entered, w)) * (1.0 + _BOX_ROUNDING * precision)
    return eqx.tree_at(lambda a: a.leave, entered, jnp.maximum(leave, walk.leave)), goes_on


def _visit_node(tree: TriangleTree, s: _TreeTraversal, any_hit: bool, precision: float) -> _TreeTraversal:
    """Let each ray visit one node.

    1. Read the row of the node.
    2. At an inner node, intersect both boxes, and go on to the nearer one; the trail notes the other.
    3. At an instance, transform the ray, and go on to the root of its tree.
    4. At a triangle, intersect it. Keep that with the lower number of material of two in one plane.
    5. Where nothing below is met, go on to the next node of the trail; at the end of a lower tree, to that of
       the upper tree; at the end of the latter, stop.
    6. Where the scene repeats and nothing was met, begin again in the next cell.
    """
    n_upper, instance = tree.n_leaves, s.instance
    if instance is None:
        assert tree.uniform is not None
        instance = Instance(*tree.uniform)
    # 1.
    node, trail = jnp.where(s.inside, s.node, s.upper_node), jnp.where(s.inside, s.trail, s.upper_trail)
    index = jnp.where(s.inside, instance.first_row, 0) + node
    row = [tree.table.at[index, k].get(mode="promise_in_bounds") for k in range(ROW)]
    is_leaf = node >= jnp.where(s.inside, instance.n_leaves, n_upper)
    start, direction = (
        vec(jnp.where(s.inside, a, b) for a, b in zip(p, q)) for p, q in ((s.x, s.upper_x), (s.w, s.upper_w))
    )
    # 2. Boxes beyond the nearest triangle so far are not met.
    inverse = _inverse(direction)
    reach = s.distance if s.rounding is None else s.distance + s.rounding
    boxes = [
        _box_distance(row[k : k + 3], row[k + 6 : k + 9], start, inverse, reach, precision) for k in (0, 3)
    ]
    # Each number of the next state follows from these: without `barrier` the compiler repeats them in all.
    (first_met, first_near), (second_met, second_near) = barrier(boxes)
    descends = ~is_leaf & (first_met | second_met)
    takes_second = second_met & (~first_met | (second_near < first_near))
    # 3.
    enters = ~s.inside & is_leaf
    leaf = jnp.where(s.inside | enters, s.upper_node - n_upper, 0)
    local_x, local_w = to_mesh(row, s.upper_x, s.upper_w)
    next_instance = s.instance
    if s.instance is not None:
        entered = [tree.instances.at[leaf, k].get(mode="promise_in_bounds") for k in range(3)]
        next_instance = Instance(*(jnp.where(enters, a, b) for a, b in zip(entered, s.instance)))
    # 4.
    distance, rounding = _triangle_distance(row, start, direction, instance.one_sided, precision)
    if s.material is None or s.rounding is None:
        distance = barrier(distance)
        is_nearer = s.active & s.inside & is_leaf & (distance < s.distance)
        material = nearest_rounding = None
    else:
        distance, rounding = barrier((distance, rounding))
        # Zero for the same material, and where nothing has been met.
        order = jnp.where(s.row > 0, jnp.sign(s.material - row[9]), 0.0)
        farthest = s.distance + order * (s.rounding + rounding)
        is_nearer = s.active & s.inside & is_leaf & (distance < farthest)
        material = jnp.where(is_nearer, row[9], s.material)
        nearest_rounding = jnp.where(is_nearer, rounding, s.rounding)
    nearest = jnp.where(is_nearer, distance, s.distance)
    # 5.
    next_node, next_trail, has_ended = _next_on_trail(node, trail)
    has_ended &= ~descends
    next_node = jnp.where(descends, 2 * node + takes_second.astype(node.dtype), next_node)
    next_trail = jnp.where(descends, 2 * trail + (first_met & second_met).astype(trail.dtype), next_trail)
    leaves_mesh, in_upper = s.inside & has_ended, ~s.inside & ~enters
    upper_node, upper_trail, upper_has_ended = _next_on_trail(s.upper_node, s.upper_trail)
    has_ended_all = (leaves_mesh & upper_has_ended) | (in_upper & has_ended)
    next_row = jnp.where(is_nearer, index, s.row)
    active = s.active & ~has_ended_all
    active = active & (next_row == 0) if any_hit else active
    visited = _TreeTraversal(
        ray=s.ray,
        upper_x=s.upper_x,
        upper_w=s.upper_w,
        x=vec(jnp.where(enters, a, b) for a, b in zip(local_x, s.x)),
        w=vec(jnp.where(enters, a, b) for a, b in zip(local_w, s.w)),
        upper_node=jnp.where(leaves_mesh, upper_node, jnp.where(in_upper, next_node, s.upper_node)),
        upper_trail=jnp.where(leaves_mesh, upper_trail, jnp.where(in_upper, next_trail, s.upper_trail)),
        node=jnp.where(enters, 1, next_node),
        trail=jnp.where(enters, 0, next_trail),
        inside=enters | (s.inside & ~has_ended),
        active=active,
        instance=next_instance,
        distance=nearest,
        row=next_row,
        leaf=jnp.where(is_nearer, leaf, s.leaf),
        material=material,
        rounding=nearest_rounding,
        walk=s.walk,
    )
    if s.walk is None:
        return visited
    # 6.
    assert tree.period is not None
    next_walk, goes_on = _next_cell(tree.period, s.walk, s.upper_w, precision)
    goes_on &= s.active & has_ended_all & (next_row == 0)
    walk = jax.tree.map(lambda a, b: jnp.where(goes_on, a, b), next_walk, s.walk)
    upper_x = vec(
        jnp.where(goes_on, a, b) for a, b in zip(_start_in_cell(tree.period, walk, s.upper_x), s.upper_x)
    )
    return dataclasses.replace(
        visited,
        upper_x=upper_x,
        upper_node=jnp.where(goes_on, 1, visited.upper_node),
        upper_trail=jnp.where(goes_on, 0, visited.upper_trail),
        inside=visited.inside & ~goes_on,
        active=visited.active | goes_on,
        distance=jnp.where(goes_on, walk.leave, visited.distance),
        walk=walk,
    )


def _inverse(w: Vec) -> Vec:
    """Return the inverse of each component of directions, finite where a ray is parallel to a plane."""
    return vec(1.0 / jnp.where(jnp.abs(a) < _PARALLEL, _PARALLEL, a) for a in w)


def to_mesh(row: list[Scalar], x: Vec, w: Vec) -> tuple[Vec, Vec]:
    """Transform rays to coordinates of a mesh, M (x - o) and M w; distances along them stay as they are."""
    offset = vec(a - b for a, b in zip(x, row[9:12]))
    matrix = [vec(row[3 * k : 3 * k + 3]) for k in range(3)]
    return vec(dot(m, offset) for m in matrix), vec(dot(m, w) for m in matrix)


def triangle_plane(tree: TriangleTree, hit: TriangleHit, x: Vec, w: Vec) -> tuple[Scalar, Vec]:
    """Return the distance along rays to the planes of triangles that they meet, and their unit normals.

    Both are differentiated with respect to rays, vertices and instances. The normal n of a plane with the
    cross product m of its sides in coordinates of the mesh is M^T m over its length. Where nothing is met,
    the values have no meaning.
    """
    corner, transform = (
        [tree.table.at[number, k].get(mode="promise_in_bounds") for k in range(ROW)]
        # The upper tree has its leaves in the second half of its rows.
        for number in (hit.row, hit.leaf + tree.n_leaves)
    )
    is_met = hit.distance < FAR
    if tree.period is not None:
        assert hit.cell is not None
        shifted = [p - n.astype(p.dtype) * length for p, n, length in zip(x, hit.cell, tree.period)]
        x = vec([*shifted, x[2]])
    a, b, c = (vec(corner[k : k + 3]) for k in (0, 3, 6))
    sides = [vec(p - q for p, q in zip(other, a)) for other in (b, c)]
    # A fixed vector where nothing is met keeps quotients finite.
    local_normal = vec(jnp.where(is_met, m, unit) for m, unit in zip(cross(*sides), (0.0, 0.0, 1.0)))
    start, direction = to_mesh(transform, x, w)
    cosine, ahead = dot(local_normal, direction), dot(local_normal, vec(p - q for p, q in zip(a, start)))
    normal = vec(dot(local_normal, vec(transform[k + 3 * j] for j in range(3))) for k in range(3))
    normal = vec(jnp.where(is_met, m, unit) for m, unit in zip(normal, (0.0, 0.0, 1.0)))
    length = jnp.sqrt(dot(normal, normal))
    # |cosine| of incidence is |local_normal . direction| / |M^T local_normal|, as w has the length one.
    least = _MIN_COSINE * lax.stop_gradient(length)
    is_grazing = jnp.abs(cosine) < least
    cosine = jnp.where(is_grazing, jnp.where(cosine < 0, -least, least), cosine)
    plane_distance = ahead / cosine
    # From the areas of a large triangle the distance is known to the rounding of its size, from the plane to
    # that of the height above it. Grazing rays meet the plane within the triangle by the areas alone.
    distance = jnp.where(is_met & ~is_grazing, jnp.maximum(plane_distance, 0.0), hit.distance)
    distance = with_derivative_of(distance, jnp.where(is_met, plane_distance, FAR))
    return distance, scale(normal, 1.0 / length)


def _next_on_trail(node: Array, trail: Array) -> tuple[Array, Array, Array]:
    """Return the next node of a trail, the trail behind it, and True where the trail has ended."""
    has_ended = trail == 0
    # The lowest bit less one has as many ones as the trail has zeros at its end.
    up = jnp.where(has_ended, 0, lax.population_count((trail & -trail) - 1))
    # At the end the node stays, so that it is always one of the tree.
    return jnp.where(has_ended, node, (node >> up) ^ 1), jnp.where(has_ended, 0, (trail >> up) ^ 1), has_ended


def _box_distance(
    low: list[Scalar], high: list[Scalar], x: Vec, inverse: Vec, largest: Scalar, precision: float
) -> tuple[Bool[Array, "*rays"], Scalar]:
    """Return True where rays meet a box, no farther than `largest`, and where they enter it, m."""
    enter, leave = jnp.zeros_like(largest), largest
    for a, b, start, rate in zip(low, high, x, inverse):
        first, second = (a - start) * rate, (b - start) * rate
        enter = jnp.maximum(enter, jnp.minimum(first, second))
        leave = jnp.minimum(leave, jnp.maximum(first, second))
    return enter <= leave * (1.0 + _BOX_ROUNDING * precision), enter


def _triangle_distance(
    row: list[Scalar], x: Vec, w: Vec, one_sided: Array | int, precision: float
) -> tuple[Scalar, Scalar]:
    """Return the distance along rays to triangles, FAR where they are missed, and a bound on its rounding."""
    size = [jnp.abs(a) for a in w]
    z_largest = (size[2] >= size[0]) & (size[2] >= size[1])
    x_largest = ~z_largest & (size[0] >= size[1])

    def permute(v: Vec) -> Vec:
        """Permute axes cyclically, so that the largest component of the direction is the last."""
        return vec(
            jnp.where(z_largest, v[k], jnp.where(x_largest, v[(k + 1) % 3], v[(k + 2) % 3])) for k in range(3)
        )

    direction = permute(w)
    along_last = jnp.where(jnp.abs(direction[2]) > 0, direction[2], 1.0)
    shear_x, shear_y, inverse = direction[0] / along_last, direction[1] / along_last, 1.0 / along_last

    def seen_along_ray(k: int) -> tuple[Vec, tuple[Scalar, Scalar]]:
        """Return a corner, relative to the start, sheared so that the ray is the last axis.

        Also by how much two compilations of its first two coordinates may differ, in units of half the
        precision: by the rounding of the product, and twice by that of the difference.
        """
        p = permute(vec(a - b for a, b in zip(row[k : k + 3], x)))
        shift = shear_x * p[2], shear_y * p[2]
        seen = p[0] - shift[0], p[1] - shift[1], inverse * p[2]
        first, second = (jnp.abs(shift[n]) + 2.0 * jnp.abs(seen[n]) for n in range(2))
        return seen, (first, second)

    corners = [seen_along_ray(k) for k in (0, 3, 6)]
    a, b, c = (seen for seen, _ in corners)
    areas, roundings = [], []
    for i, j in ((2, 1), (0, 2), (1, 0)):
        (p, dp), (q, dq) = corners[i], corners[j]
        areas.append(p[0] * q[1] - p[1] * q[0])
        x_of_q, y_of_q, x_of_p, y_of_p = (jnp.abs(v) for v in (q[0], q[1], p[0], p[1]))
        difference = dp[0] * y_of_q + dp[1] * x_of_q + dq[0] * y_of_p + dq[1] * x_of_p
        difference += 3.0 * (x_of_p * y_of_q + y_of_p * x_of_q)
        roundings.append(_AREA_ROUNDING * precision * difference)
    is_inside = jnp.ones_like(z_largest)
    is_inside_reversed = is_inside
    for area, rounding in zip(areas, roundings):
        is_inside &= area >= -rounding
        is_inside_reversed &= area <= rounding
    total = areas[0] + areas[1] + areas[2]
    # Triangles that are seen edge-on have no area, and are met at their neighbours.
    has_area = jnp.abs(total) > 0
    numerator = areas[0] * a[2] + areas[1] * b[2] + areas[2] * c[2]
    distance = numerator / jnp.where(has_area, total, 1.0)
    # By rounding of areas the quotient may lie beyond the corners.
    lowest, highest = jnp.minimum(jnp.minimum(a[2], b[2]), c[2]), jnp.maximum(jnp.maximum(a[2], b[2]), c[2])
    distance = jnp.clip(distance, lowest, highest)
    is_met = (is_inside | is_inside_reversed) & has_area & (distance > 0)
    # With corners counter-clockwise as seen from the side of light, `total` has the sign of the direction.
    is_met &= (one_sided == 0) | (total * along_last > 0)
    # Corners are rounded, and so is where the ray meets the triangle: more by the rise of that along the ray.
    coordinates = sum((jnp.abs(v) for v in (*row[:3], *x)), start=jnp.zeros_like(total))
    across = sum((jnp.abs(v[0]) + jnp.abs(v[1]) for v in (a, b, c)), start=jnp.zeros_like(total))
    rise = (highest - lowest) * across / jnp.where(has_area, jnp.abs(total), 1.0)
    rise = jnp.minimum(rise, _MAX_RISE * jnp.abs(inverse))
    rounding = _DISTANCE_ROUNDING * precision * coordinates * (jnp.abs(inverse) + rise)
    return jnp.where(is_met, distance, FAR), rounding
