r"""Cotangents of extinction at orders two and above: flights are traced once more, and taken in reverse.

Extinction does not move paths: points of collision are held at fractions of their chord through a voxel, and
everything else is drawn from detached densities (`trace.photons.photons`). It acts on weights alone. With
the cotangents y of the response, let D be the deposits of a photon times y. The derivative of each with
respect to the extinction k_v of voxel v is (`trace.derivatives.score_functions`)

    D * (number of collisions in v / k_v  -  length in v,  of the path up to the deposit and of its return).

Hence a flight and its collision count with the sum of all deposits from there on:

1. Photons are traced once more, from the same random numbers. The ends of every flight are kept, with their
   deposits D (`KeptFlights`).
2. The flights are taken from the last to the first, and the deposits of each photon summed on the way. The
   depth of a flight is marched again: each voxel gets minus the length in it times what comes from there on.
   The voxel of the collision gets the same over its extinction, and voxels along return paths minus their
   lengths times D.

A flight has several ends. Each counts with its own deposit, and the selected one with what comes after, too.
A group of photons is traced at a time, the smaller the more orders there are, so that memory is bounded.
Path replay backpropagation (Vicini, Speierer and Jakob 2021, ACM Trans. Graph. 40, 108) keeps no flights. It
traces photons twice more, and finds what comes after a flight as a difference, whose rounding would remain
where a photon ends. Photons hardly ever collide where extinction is zero or small: what is scattered there is
added by `trace.march.thin_voxels`, and collisions there do not count.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt32

from jaxlidar._jax.one_function import barrier, one_function
from jaxlidar._jax.vmapped_loops import any_problem, largest_count
from jaxlidar._vectors import Scalar, Vec
from jaxlidar.planning.config import Scatterer
from jaxlidar.trace.deposit import take_rows
from jaxlidar.trace.derivatives.replay import ExtinctionTables
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.march.thin_voxels import ThinVoxels, start_unplaced
from jaxlidar.trace.march.voxel_traversal import (
    Medium,
    VoxelRay,
    cell_index,
    enter_grid,
    maximum,
    minimum,
    select,
    step_voxel,
    voxel_above,
)
from jaxlidar.trace.photons.higher_orders import (
    CHUNKS_PER_GROUP,
    PHOTONS_PER_CHUNK,
    FlightEnds,
    FlownPhotons,
    HigherOrderTally,
    Lanes,
    PhotonBatch,
    empty_tally,
    is_deposited,
    returns_of_ends,
)
from jaxlidar.trace.photons.random_numbers import PhotonDraws

# Steps of a march between two subtractions from the voxels.
STEPS_AT_A_TIME = 16
# Flights of photons that are kept at a time, as long as a group has at least one chunk.
MAX_KEPT_FLIGHTS = 1 << 16


class KeptFlights(NamedTuple):
    """Flights of chunks of photons, one chunk after another, as far as extinction acts on them.

    - `number`: that of the photon in its group; one past the last for dead ones.
    - `x`, `w`: start and direction. `targets`: optical depth of each end. `max_distance`: to where the photon
      stops, whatever its depth, m. `selected`: the end from which it goes on.
    - `cell`, `material`: voxel and material that each end collides with; the material is -1 if there is none,
      or if it is that of a surface. `end_x`: position of each end.
    - `deposits`: deposit of each end, times the cotangents of returns.
    - `placed`: thin voxel that each end or the photon before was placed in (`trace.march.thin_voxels`).
    """

    number: Int[Array, "*chunks photons"]
    x: Vec
    w: Vec
    targets: Float[Array, "*chunks ends photons"]
    max_distance: Float[Array, "*chunks photons"]
    selected: Int[Array, "*chunks photons"]
    cell: Int[Array, "*chunks ends_photons"]
    material: Int[Array, "*chunks ends_photons"]
    end_x: Vec
    deposits: Float[Array, "*chunks ends photons"]
    placed: Int[Array, "*chunks ends photons"]

    @staticmethod
    def empty(scene: DeviceScene, batch: PhotonBatch) -> "KeptFlights":
        """Return room for a group of photons and all orders, with flights of dead photons in it."""
        n_ends = scene.config.deposits_per_flight
        chunks, size = batch.chunks_per_group * scene.config.order_steps, batch.chunk_size
        of_photons, of_ends = jnp.zeros((chunks, size)), jnp.zeros((chunks, n_ends * size))
        vector, end_x = (of_photons, of_photons, of_photons), (of_ends, of_ends, of_ends)
        by_end, cell = of_ends.reshape(chunks, n_ends, size), of_ends.astype(jnp.int32)
        number = jnp.full((chunks, size), batch.group_size)
        selected = jnp.zeros_like(number)
        placed = cell.reshape(by_end.shape) - 1
        return KeptFlights(
            number, vector, vector, by_end, of_photons, selected, cell, cell - 1, end_x, by_end, placed
        )

    def with_chunk(self, place: Int[Array, ""], chunk: "KeptFlights") -> "KeptFlights":
        """Return these flights with those of a chunk at its place."""
        return jax.tree.map(lambda flights, new: flights.at[place].set(new), self, chunk)

    def chunk(self, place: Int[Array, ""]) -> "KeptFlights":
        """Return the flights of the chunk at a place."""
        return jax.tree.map(lambda flights: flights.at[place].get(mode="promise_in_bounds"), self)


def pull_back_higher_orders(
    scene: DeviceScene, words: UInt32[Array, "words"], cotangent: HigherOrderTally
) -> ExtinctionTables:
    """Pull cotangents of the result of `trace_photons` back to the extinction of every voxel.

    Returns alone have derivatives; the energy budget has none (`trace.tally_index`). For each group
    of photons:

    1. Trace them again, and keep their flights with the deposits, times their cotangents.
    2. From the last chunk of flights to the first, add to the voxels.
    3. If there are thin voxels, trace them once more, and add the deposits of those that are placed there.
    """
    medium, bins = scene.medium, scene.bins
    assert medium is not None
    chunks = MAX_KEPT_FLIGHTS // (PHOTONS_PER_CHUNK * scene.config.order_steps)
    chunks_per_group = max(1, min(chunks, CHUNKS_PER_GROUP))
    batch, empty = PhotonBatch(scene, words, max_chunks_per_group=chunks_per_group), empty_tally(scene)
    padded = jax.ShapeDtypeStruct(empty.weights.shape, empty.weights.dtype)
    # Trimming is linear: its transpose is applied once, to the cotangents.
    (of_returns,) = jax.linear_transpose(bins.trim, padded)((cotangent.weights, cotangent.outside))
    thin_voxels = ThinVoxels.of(scene)

    def trace_group(number: Int[Array, ""], total: ExtinctionTables) -> ExtinctionTables:
        # Photons of all groups are traced once as they are, and once more to be placed in thin voxels.
        is_placing = number >= batch.n_groups
        group = jnp.where(is_placing, number - batch.n_groups, number).astype(jnp.uint32)
        first_lane = batch.first_lane(group)

        def trace_chunk(in_chunk: Lanes, state: tuple[Array, KeptFlights], draws: PhotonDraws, order: Array):
            n_chunks, flights = state
            p = in_chunk.photons
            flown, ends, placed, onward = thin_voxels.trace_chunk(batch, in_chunk, draws, order, is_placing)
            in_voxel = ends.flights.collided & (ends.collision.surface < 0)
            chunk_flights = KeptFlights(
                # Dead photons fill up chunks; the first of the group stands in for them (`compact`), whose
                # sums they must not change.
                number=jnp.where(p.alive, (in_chunk.lane - first_lane).astype(jnp.int32), batch.group_size),
                x=p.x,
                w=p.w,
                targets=-jnp.log(flown.u),
                max_distance=jnp.minimum(flown.encounters.nearest_stop, flown.max_length),
                selected=flown.selected,
                cell=ends.flights.cell,
                material=jnp.where(in_voxel, ends.collision.material, -1),
                end_x=ends.x,
                deposits=_deposits(thin_voxels.scene, flown, ends, of_returns, order),
                placed=placed,
            )
            return onward, (n_chunks + 1, flights.with_chunk(n_chunks, chunk_flights))

        nothing = (jnp.zeros((), jnp.int32), KeptFlights.empty(scene, batch))
        lanes = start_unplaced(batch.send(group))
        _, (n_chunks, group_flights) = batch.trace_orders(lanes, nothing, trace_chunk)
        n_chunks = largest_count(n_chunks)
        # Nothing else counts of photons that are placed in thin voxels.
        n_chunks, n_placed = jnp.where(is_placing, 0, n_chunks), jnp.where(is_placing, n_chunks, 0)

        def add_chunk(n: Array, state: tuple[ExtinctionTables, Array]) -> tuple[ExtinctionTables, Array]:
            tables, later = state
            flights = group_flights.chunk(n_chunks - 1 - n)
            end_number = jnp.arange(len(flights.deposits))[:, None]
            comes_later = later.at[flights.number].get(mode="fill", fill_value=0.0)
            from_end_on = flights.deposits + jnp.where(
                end_number == flights.selected[None], comes_later[None], 0.0
            )
            tables = _subtract_flights(scene, medium, tables, flights, from_end_on)
            tables = _add_collisions(scene, medium, tables, flights, from_end_on.reshape(-1))
            tables = _subtract_return_paths(scene, medium, tables, flights)
            from_start_on = jnp.sum(from_end_on, axis=0)
            return tables, later.at[flights.number].set(from_start_on, mode="drop")

        def add_placed(n: Array, tables: ExtinctionTables) -> ExtinctionTables:
            flights = group_flights.chunk(n)
            return thin_voxels.add_to_tables(tables, flights.placed, flights.deposits)

        later = jnp.zeros((batch.group_size,), of_returns.dtype)
        total = lax.fori_loop(0, n_chunks, add_chunk, (total, later))[0]
        return lax.fori_loop(0, n_placed, add_placed, total)

    n_groups = jnp.where(any_problem(thin_voxels.are_thin), 2 * batch.n_groups, batch.n_groups)
    zero = jax.tree.map(jnp.zeros_like, ExtinctionTables.of(scene))
    return lax.fori_loop(0, n_groups, trace_group, zero)


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
        deposits, table = jnp.zeros_like(returns.row[:, 0]), of_returns.reshape(-1, of_returns.shape[-1])
        for tally_row, values in returns.rows:
            of_values = take_rows(table, tally_row, returns.first_bin, values.shape)
            deposits = deposits + jnp.sum((values * of_values).reshape(len(deposits), -1), axis=-1)
        return deposits.reshape(flown.weight.shape)

    return lax.cond(is_deposited(scene, order), of_order_two_on, lambda: jnp.zeros_like(flown.weight))


class _SubtractingMarch(NamedTuple):
    """State of the march of rays that subtract from voxels.

    - `distance`, `depth`: length, m, and optical depth up to here. `voxel`: the voxel ahead.
    - `running`: False for rays that have stopped.
    """

    distance: Float[Array, "photons"]
    depth: Float[Array, "photons"]
    voxel: tuple[Int[Array, "photons"], ...]
    running: Bool[Array, "photons"]


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
    3. The sum of these lengths times amounts is what the voxel loses. Go on to the next voxel.

    Some steps are taken at a time, and then subtracted together: a loop without scatters is compiled as one
    function.

    **Arguments:** `targets`: optical depths of the ends; infinite where all of a ray counts.
    """
    medium = scene.medium
    assert medium is not None
    end, largest = minimum(ray.leave, max_length), jnp.max(targets, axis=0)
    ray, end, largest, targets, amounts = barrier((ray, end, largest, targets, amounts))

    def step(state: _SubtractingMarch, _):
        distance, depth, voxel, running = state
        faces = barrier(ray.face_distances(voxel))
        to = maximum(distance, minimum(end, minimum(minimum(faces[0], faces[1]), faces[2])))
        cell = cell_index(medium, voxel)
        k = medium.extinction(cell, w)
        to, cell, k = barrier((to, cell, k))
        length = select(running, to - distance, jnp.zeros_like(to))
        lost = jnp.zeros_like(to)
        for target, amount in zip(targets, amounts):
            to_target = (target - depth) / maximum(k, jnp.full_like(k, 1e-30))
            to_target = lax.clamp(jnp.zeros_like(length), to_target, length)
            # Collisions lie at fixed fractions of their chords, also for second derivatives.
            fraction = lax.stop_gradient(to_target / maximum(length, jnp.full_like(length, 1e-30)))
            lost = lost + amount * fraction * length
        next_depth = depth + k * length
        goes_on = running & (next_depth <= largest) & (to < end)
        next_voxel = step_voxel(ray, voxel, faces, to)
        # The voxel of a ray that has stopped does not matter.
        distance = select(running, to, distance)
        return _SubtractingMarch(distance, next_depth, next_voxel, goes_on), (cell, lost)

    def take_steps(state: _SubtractingMarch):
        return lax.scan(step, state, None, length=STEPS_AT_A_TIME)

    def block(state: tuple[_SubtractingMarch, ExtinctionTables, Int[Array, ""]]):
        march, tables, n_steps = state
        march, (cell, lost) = one_function(take_steps)(march)
        return march, tables.add_total(medium, cell, w, -lost), n_steps + STEPS_AT_A_TIME

    def continue_(state) -> Bool[Array, ""]:
        march, _, n_steps = state
        return any_problem(march.running) & (n_steps < scene.config.max_faces)

    # Nothing would be subtracted for rays whose amounts are all zero.
    running = jnp.any(amounts != 0.0, axis=0) & (ray.enter < end)
    start, zero = jnp.minimum(ray.enter, end), jnp.zeros_like(end)
    march = _SubtractingMarch(start, zero, ray.voxel, running)
    return lax.while_loop(continue_, block, (march, tables, jnp.zeros((), jnp.int32)))[1]


def _subtract_flights(
    scene: DeviceScene,
    medium: Medium,
    tables: ExtinctionTables,
    flights: KeptFlights,
    amounts: Float[Array, "ends photons"],
) -> ExtinctionTables:
    """Subtract the lengths of flights up to their ends, times the amounts of these."""
    # Not only in the box of occupied voxels: leaves in empty voxels around it would attenuate, too.
    ray = enter_grid(medium, flights.x, flights.w)
    return _subtract_lengths(scene, tables, ray, flights.w, flights.targets, amounts, flights.max_distance)


def _add_collisions(
    scene: DeviceScene, medium: Medium, tables: ExtinctionTables, flights: KeptFlights, amounts: Scalar
) -> ExtinctionTables:
    """Add amounts over the extinction of the material that was hit, in the voxels of collisions.

    Not in thin voxels: see `trace.march.thin_voxels`.
    """

    def over_extinction(table: Array | None, scatterer: Scatterer | None) -> Scalar | None:
        if table is None or scatterer is None:
            return None
        k = table.at[flights.cell].get(mode="promise_in_bounds")
        counts = (flights.material == scatterer.material) & ~medium.is_thin(k)
        return jnp.where(counts, amounts / jnp.where(counts, k, 1.0), 0.0)

    of_leaf = over_extinction(medium.leaf, scene.config.leaf)
    of_bark = over_extinction(medium.bark, scene.config.bark)
    # The tables themselves: a factor of direction cancels in dk / k.
    return tables.add_tables(flights.cell, of_leaf, of_bark)


def _subtract_return_paths(
    scene: DeviceScene, medium: Medium, tables: ExtinctionTables, flights: KeptFlights
) -> ExtinctionTables:
    """Subtract deposits times lengths in the voxels along their return paths.

    At nadir, they are subtracted from the table of depths straight up, whose own derivative goes on to
    voxels.
    """
    x, deposits = flights.end_x, flights.deposits.reshape(-1)
    if scene.depth_above is not None:
        cell, above, inside = voxel_above(medium, x)
        amounts = jnp.where(inside, -deposits, 0.0)
        up = (jnp.zeros_like(above), jnp.zeros_like(above), jnp.ones_like(above))
        tables = tables.add_depth_above(cell, amounts)
        return tables.add_total(medium, cell, up, amounts * above * medium.size[2])
    v, to_sensor = scene.beam.view(x), scene.beam.distance_to_sensor(x)
    ray, infinite = enter_grid(medium, x, v), jnp.full_like(deposits, jnp.inf)
    # A sensor may be within the voxels.
    to_end = infinite if to_sensor is None else to_sensor
    return _subtract_lengths(scene, tables, ray, v, infinite[None], deposits[None], to_end)
