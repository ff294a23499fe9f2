r"""Cotangents of extinction at orders two and above: photons are traced twice more.

Extinction does not move paths: points of collision are held at fractions of their chord through a voxel, and
everything else is drawn from detached densities (`jaxlidar.trace.photons`). It acts on weights alone. With
the cotangents y of the response, let D be the deposits of a photon times y. The derivative of each with
respect to the extinction k_v of voxel v is (`jaxlidar.trace.score_functions`)

    D * (number of collisions in v / k_v  -  length in v,  of the path up to the deposit and of its return).

Hence a flight and its collision count with the sum of all deposits from there on:

1. The first walk sums the deposits D of every photon, S.
2. In the second walk, from the same random numbers, S less what has been deposited so far is what lies
   ahead. The depth of a flight is marched once more, and each voxel on the way gets minus the length in it
   times that; the voxel of the collision gets it over its extinction, and voxels along return paths minus
   their lengths times D.

A flight has several ends. Each counts with its own deposit, and the selected one with what lies ahead, too.
The state of a photon is all that is stored (path replay backpropagation; Vicini, Speierer and Jakob 2021, ACM
Trans. Graph. 40, 108). Photons never collide where extinction is zero: such voxels get the lengths alone.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt32

from jaxlidar._one_function import once
from jaxlidar._vectors import Scalar, Vec
from jaxlidar._vmapped_loops import any_problem
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.higher_orders import (
    FlightEnds,
    FlownPhotons,
    HigherOrderTally,
    Lanes,
    PhotonBatch,
    collide_at_ends,
    empty_tally,
    fly,
    is_deposited,
    returns_of_ends,
    scatter,
)
from jaxlidar.trace.random_numbers import PhotonDraws
from jaxlidar.trace.replay import ExtinctionTables
from jaxlidar.trace.voxel_traversal import (
    Medium,
    VoxelRay,
    cell_index,
    enter_grid,
    maximum,
    minimum,
    step_voxel,
    voxel_above,
)


def pull_back_higher_orders(
    scene: DeviceScene, words: UInt32[Array, "words"], cotangent: HigherOrderTally
) -> ExtinctionTables:
    """Pull cotangents of the result of `trace_photons` back to the extinction of every voxel.

    Returns alone have derivatives; the energy budget has none (`jaxlidar.trace.tally_index`). For each group
    of photons:

    1. Sum the deposits of every photon, times their cotangents.
    2. Trace the same photons again, and add to the voxels.
    """
    medium, bins = scene.medium, scene.bins
    assert medium is not None
    batch, empty = PhotonBatch(scene, words), empty_tally(scene)
    padded = jax.ShapeDtypeStruct(empty.weights.shape, empty.weights.dtype)
    # Trimming is linear: its transpose is applied once, to the cotangents.
    (of_returns,) = jax.linear_transpose(bins.trim, padded)((cotangent.weights, cotangent.outside))

    def trace_group(total: ExtinctionTables, group: UInt32[Array, ""]) -> tuple[ExtinctionTables, None]:
        first_lane = batch.first_lane(group)

        def number_in_group(lanes: Lanes) -> Int[Array, "photons"]:
            # Dead photons fill up chunks; the first of the group stands in for them (`compact`), whose sums
            # they must not change.
            number = (lanes.lane - first_lane).astype(jnp.int32)
            return jnp.where(lanes.photons.alive, number, batch.group_size)

        def trace_chunk(in_chunk: Lanes, state: _Walk, draws: PhotonDraws, order: Array):
            flown, _ = fly(scene, in_chunk.photons, empty, draws, order)
            ends, number = collide_at_ends(scene, flown), number_in_group(in_chunk)
            deposits = _deposits(scene, flown, ends, of_returns, order)
            p, _ = scatter(scene, flown, empty)
            in_order = jnp.sum(deposits, axis=0)
            before = state.ahead.at[number].get(mode="fill", fill_value=0.0)
            # Nothing lies ahead of a photon that has ended; rounding would leave a little.
            after = jnp.where(p.alive, before - in_order, 0.0)

            def add(tables: ExtinctionTables) -> ExtinctionTables:
                numbers = jnp.arange(len(deposits))[:, None]
                from_end_on = deposits + jnp.where(numbers == flown.selected[None], after[None], 0.0)
                tables = _subtract_flights(scene, medium, tables, flown, from_end_on)
                tables = _add_collisions(scene, medium, tables, ends, from_end_on.reshape(-1))
                return _subtract_return_paths(scene, medium, tables, ends, deposits.reshape(-1))

            # A loop of one step or none: its state is updated in place, where `cond` would copy the map.
            n_steps = state.is_second.astype(jnp.int32)
            tables = lax.fori_loop(0, n_steps, lambda _, tables: add(tables), state.tables)
            ahead = jnp.where(state.is_second, after, before + in_order)
            ahead = state.ahead.at[number].set(ahead, mode="drop")
            return Lanes(in_chunk.lane, p), _Walk(state.is_second, tables, ahead)

        def walk(state: tuple[ExtinctionTables, Array], is_second: Bool[Array, ""]):
            _, end = batch.trace_orders(batch.send(group), _Walk(is_second, *state), trace_chunk)
            return (end.tables, end.ahead), None

        nothing = jnp.zeros((batch.group_size,), of_returns.dtype)
        # One loop for both walks: what they share is compiled once.
        return lax.scan(walk, (total, nothing), jnp.asarray([False, True]))[0][0], None

    zero = jax.tree.map(jnp.zeros_like, ExtinctionTables.of(scene))
    return lax.scan(trace_group, zero, jnp.arange(batch.n_groups, dtype=jnp.uint32))[0]


class _Walk(NamedTuple):
    """The state of a walk. `is_second`: True for the walk that adds to the tables.

    `ahead`: for each photon of the group, the deposits of the first walk so far, and those that lie ahead in
    the second.
    """

    is_second: Bool[Array, ""]
    tables: ExtinctionTables
    ahead: Float[Array, "photons"]


def _deposits(
    scene: DeviceScene,
    flown: FlownPhotons,
    ends: FlightEnds,
    of_returns: Float[Array, "materials entries padded"],
    order: Int[Array, ""],
) -> Float[Array, "ends photons"]:
    """Return the deposits of every end, times the cotangents of returns; none at order one."""

    def of_order_two_on() -> Float[Array, "ends photons"]:
        returns = returns_of_ends(scene, ends, flown.weight.reshape(-1), None, of_returns.shape[1])
        bins = returns.first_bin[:, None] + jnp.arange(returns.row.shape[-1])[None]
        deposits = jnp.zeros_like(returns.row)
        for tally_row, values in returns.rows:
            places = tally_row[:, None] * scene.bins.padded + bins
            looked_up = of_returns.reshape(-1).at[places].get(mode="promise_in_bounds")
            deposits = deposits + values * looked_up
        return jnp.sum(deposits, axis=-1).reshape(flown.weight.shape)

    return lax.cond(is_deposited(scene, order), of_order_two_on, lambda: jnp.zeros_like(flown.weight))


class _SubtractingMarch(NamedTuple):
    """State of the march of rays that subtract from voxels.

    - `distance`, `depth`: length, m, and optical depth up to here. `voxel`: the voxel ahead.
    - `running`: False for rays that have stopped. `n_steps`: steps so far.
    """

    distance: Float[Array, "photons"]
    depth: Float[Array, "photons"]
    voxel: tuple[Int[Array, "photons"], ...]
    running: Bool[Array, "photons"]
    n_steps: Int[Array, ""]
    tables: ExtinctionTables


def _subtract_lengths(
    scene: DeviceScene,
    tables: ExtinctionTables,
    ray: VoxelRay,
    w: Vec,
    targets: Float[Array, "ends photons"],
    amounts: Float[Array, "ends photons"],
    max_length: Float[Array, "photons"],
) -> ExtinctionTables:
    """Subtract, in each voxel on rays, the length up to each end of a ray times the amount of that end.

    Rays are marched as by `march_to_depths`, without what that finds at their ends. Each step:

    1. Find the nearest face, or the end of the ray, and look up the extinction of the voxel.
    2. For every end: the length in the voxel as far as the depth of its target.
    3. Subtract the sum of these lengths times amounts, and go on to the next voxel.

    **Arguments:** `targets`: optical depths of the ends; infinite where all of a ray counts.
    """
    medium = scene.medium
    assert medium is not None
    end, largest = minimum(ray.leave, max_length), jnp.max(targets, axis=0)

    def step(state: _SubtractingMarch) -> _SubtractingMarch:
        distance, depth, voxel, running, n_steps, tables = state
        faces = ray.face_distances(voxel)
        to = maximum(distance, minimum(end, minimum(minimum(faces[0], faces[1]), faces[2])))
        cell = cell_index(medium, voxel)
        k = medium.extinction(cell, w)
        to, cell, k = once((to, cell, k))
        length = jnp.where(running, to - distance, 0.0)
        to_targets = (targets - depth[None]) / jnp.maximum(k, 1e-30)[None]
        to_targets = jnp.clip(to_targets, 0.0, length[None])
        tables = tables.add_total(medium, cell, w, -jnp.sum(amounts * to_targets, axis=0))
        next_depth = depth + k * length
        goes_on = running & (next_depth <= largest) & (to < end)
        next_voxel = step_voxel(ray, voxel, faces, to)
        # The voxel of a ray that has stopped does not matter.
        distance = jnp.where(running, to, distance)
        return _SubtractingMarch(distance, next_depth, next_voxel, goes_on, n_steps + 1, tables)

    def continue_(state: _SubtractingMarch) -> Bool[Array, ""]:
        return any_problem(state.running) & (state.n_steps < scene.config.max_faces)

    # Of rays whose amounts are all zero, nothing would be subtracted.
    running = jnp.any(amounts != 0.0, axis=0) & (ray.enter < end)
    start, zero = jnp.minimum(ray.enter, end), jnp.zeros_like(end)
    state = _SubtractingMarch(start, zero, ray.voxel, running, jnp.zeros((), jnp.int32), tables)
    return lax.while_loop(continue_, step, state).tables


def _subtract_flights(
    scene: DeviceScene,
    medium: Medium,
    tables: ExtinctionTables,
    flown: FlownPhotons,
    amounts: Float[Array, "ends photons"],
) -> ExtinctionTables:
    """Subtract the lengths of flights up to their ends, times the amounts of these."""
    p = flown.p
    max_distance = jnp.minimum(flown.encounters.nearest_stop, flown.max_length)
    ray = once(enter_grid(medium, p.x, p.w, scene.occupied_box))
    amounts = jnp.where(p.alive, amounts, 0.0)
    return _subtract_lengths(scene, tables, ray, p.w, -jnp.log(flown.u), amounts, max_distance)


def _add_collisions(
    scene: DeviceScene, medium: Medium, tables: ExtinctionTables, ends: FlightEnds, amounts: Scalar
) -> ExtinctionTables:
    """Add amounts over the extinction of the material that was hit, in the voxels of collisions."""
    cell, collision = ends.flights.cell, ends.collision
    in_voxel = ends.flights.collided & (collision.surface < 0)

    def over_extinction(table: Array | None, is_material: Bool[Array, "ends"]) -> Scalar | None:
        if table is None:
            return None
        k = table.at[cell].get(mode="promise_in_bounds")
        counts = in_voxel & is_material & (k > 0.0)
        return jnp.where(counts, amounts / jnp.where(counts, k, 1.0), 0.0)

    config = scene.config
    by_material = [
        None if scatterer is None else over_extinction(table, collision.material == scatterer.material)
        for table, scatterer in ((medium.leaf, config.leaf), (medium.bark, config.bark))
    ]
    # The tables themselves: a factor of direction cancels in dk / k.
    return tables.add_tables(cell, by_material[0], by_material[1])


def _subtract_return_paths(
    scene: DeviceScene, medium: Medium, tables: ExtinctionTables, ends: FlightEnds, deposits: Scalar
) -> ExtinctionTables:
    """Subtract deposits times lengths in the voxels along their return paths.

    At nadir, they are subtracted from the table of depths straight up, whose own derivative goes on to
    voxels.
    """
    if scene.depth_above is not None:
        cell, above, inside = voxel_above(medium, ends.x)
        amounts = jnp.where(inside, -deposits, 0.0)
        up = (jnp.zeros_like(above), jnp.zeros_like(above), jnp.ones_like(above))
        tables = tables.add_depth_above(cell, amounts)
        return tables.add_total(medium, cell, up, amounts * above * medium.size[2])
    v = scene.beam.view(ends.x)
    ray, infinite = once(enter_grid(medium, ends.x, v)), jnp.full_like(deposits, jnp.inf)
    return _subtract_lengths(scene, tables, ray, v, infinite[None], deposits[None], infinite)
