r"""Orders two and above: photons fly, collide, deposit the expected return of every collision, and scatter.

Photons carry no energy, only the geometric weight of their path and the number of its scattering history.
Each order samples a collision: the optical depth to it, the material, the direction onward. From there the
photon deposits, for every channel by which light may return (next-event estimation),

    weight * V(w -> v) * exp(-tau(x -> sensor)) * (fraction that the receiver sees) * (R_t / R_x)^2,

with V the intensity factor towards the sensor (`trace.photons.collisions`), R_x the distance of x from the
sensor, and R_t the range for which the time of arrival stands, half of the whole path: apparent reflectance
refers to that range.

It does so from the ends of n = `deposits_per_flight` flights of the same direction. Their transmittances u,
by which depths -ln u are sampled, are stratified, u_i = (i + r) / n for i = 0 ... n - 1, with the remainder r
of one uniform number times n; each end has the weight 1 / n. The photon goes on from the end that this number
itself selects.

Photons are grouped in chunks, which stay in the processor's cache, and chunks in groups. All chunks of a
group are traced order by order, with living photons compacted before each order
(`trace.photons.compaction`).

Derivatives: decisions are detached, their densities attached (`trace.photons.photons`). Directions,
materials, and the fraction of a chord at which a collision lies are held fixed; voxel sizes, heights and
extinction move positions, path lengths and densities continuously, so that the expected value of the
derivative is the derivative of the expected value. Flights that land on a surface are the exception: their
landing points move with voxel columns and terrain cells, and their directions with these
(`trace.derivatives.reparametrisation`, with a list of the borders that matter). Photons never collide where
the extinction coefficient is zero, and hardly ever where it is small. Derivatives get what would scatter from
there by `trace.march.thin_voxels`.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._jax.mesh_axes import vary_with
from jaxlidar._jax.one_function import barrier
from jaxlidar._jax.vmapped_loops import any_problem, largest_count
from jaxlidar._vectors import FAR, Scalar, Vec
from jaxlidar.trace.deposit import add_rows, bspline_row
from jaxlidar.trace.derivatives.reparametrisation import (
    has_moving_landings,
    move_landings,
    rays_with_grids,
)
from jaxlidar.trace.derivatives.score_functions import (
    add_derivatives_of_returns,
    collision_score,
    vertical_depth_slopes,
)
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.first.footprint import GOLDEN, across_beam
from jaxlidar.trace.march.flight import Flight, SurfaceEncounters, meet_surfaces, sample_flights
from jaxlidar.trace.march.meshes import clear_of_mesh
from jaxlidar.trace.march.voxel_traversal import depth_to_top, march_to_depths
from jaxlidar.trace.photons.collisions import collision_for_return, intensity_factors
from jaxlidar.trace.photons.compaction import compact
from jaxlidar.trace.photons.entry_nodes import EntryNodes
from jaxlidar.trace.photons.photon_step import collide, passed_plates, start_photons
from jaxlidar.trace.photons.photons import (
    Collision,
    CollisionForReturn,
    Photons,
    attached_ratio,
    detach,
)
from jaxlidar.trace.photons.random_numbers import (
    PhotonDraws,
    random_words,
    shifted_lattices,
    to_unit,
)
from jaxlidar.trace.tally_index import TallyIndex, add_to_tally

Sums = TypeVar("Sums")

# Photons that are traced together, so that their state stays in the processor's cache.
PHOTONS_PER_CHUNK = 256
# Chunks that are traced together, order by order. Each group has its own sum: single precision loses small
# deposits on a large sum.
CHUNKS_PER_GROUP = 32
# Random numbers of each order for derivatives: whether to place the photon in a thin voxel, and where on
# its flight (`trace.march.thin_voxels`).
DRAWS_IN_THIN_VOXELS = 2


class HigherOrderTally(eqx.Module):
    """Response of orders two and above, and the energy budget of all light (see `trace.response`).

    The axis `entries` is that of histories; or, where optics are applied, of wavelengths, with `EntryNodes`
    of nodes times wavelengths. The axis `return_entries` is the same, or with `ShotViews` of shots times
    wavelengths. Wavelengths lie innermost (`trace.tally_index`).

    - `weights`, `outside`: returns within the bins and outside of them; with both margins while photons are
      traced.
    - `arrived`, `departed`: weight that reached each material, and that went on from it.
    - `escaped`, `flown_outside`, `unfollowed`: weight that left the scene, that could not be recorded any
      more, and that was still in flight after the last order.
    - `weight_slopes`: derivatives of the returns with respect to parameters; None without score functions.
    """

    weights: Float[Array, "materials return_entries bins"]
    outside: Float[Array, "materials return_entries"]
    arrived: Float[Array, "materials entries"]
    departed: Float[Array, "materials entries"]
    escaped: Float[Array, "entries"]
    flown_outside: Float[Array, "entries"]
    unfollowed: Float[Array, "entries"]
    weight_slopes: Float[Array, "bins parameters wavelengths"] | None = None

    def with_arrival(self, material: Array | int, index: TallyIndex, weight: Scalar) -> "HigherOrderTally":
        """Return the tally with weight that reached a material."""
        arrived = add_to_tally(self.arrived, (material,), index, weight)
        return eqx.tree_at(lambda t: t.arrived, self, arrived)

    def with_departure(self, material: Array | int, index: TallyIndex, weight: Scalar) -> "HigherOrderTally":
        """Return the tally with weight that went on from a material."""
        departed = add_to_tally(self.departed, (material,), index, weight)
        return eqx.tree_at(lambda t: t.departed, self, departed)


class Lanes(NamedTuple):
    """Photons, and the number of each in its batch, which its random numbers depend on.

    - `thin_voxel`: the thin voxel where the photon was placed, or -1, as `Placed` of
      `trace.march.thin_voxels`; None outside of derivatives.
    """

    lane: UInt32[Array, "*photons"]
    photons: Photons
    thin_voxel: Int[Array, "*photons"] | None = None


# Traces the photons of a chunk through one order, and adds to sums; its arguments are these two, the photons'
# random numbers and the order.
TraceChunk = Callable[[Lanes, Sums, PhotonDraws, Int[Array, ""]], tuple[Lanes, Sums]]


class PhotonBatch:
    """The photons of a batch: their random numbers, their division into chunks and groups, and their orders.

    - `n_groups`, `group_size`: number of groups of chunks, and photons of each.
    - `n_words`: number of random words that a batch takes; the first two shift the footprint of order one.
    """

    def __init__(
        self,
        scene: DeviceScene,
        words: UInt32[Array, "words"],
        nodes: EntryNodes | None = None,
        node_key: PRNGKeyArray | None = None,
        max_chunks_per_group: int = CHUNKS_PER_GROUP,
    ):
        """`words`: the random words. `nodes`, `node_key`: about which light enters, and a key for that."""
        self.scene, self.nodes, self.node_key = scene, nodes, node_key
        n_photons = scene.config.photons_per_batch if nodes is None else nodes.n_photons
        # The first two words shift the footprint of order one (`trace.response`) from the same key.
        # The next two shift the disc from which photons start, and every order and dimension takes a step and
        # a shift. The last ones are for derivatives alone.
        orders, dimensions = scene.config.order_steps, PhotonDraws.dimensions(scene.n_plates)
        _, shift, words, more_words = jnp.split(words, np.cumsum([2, 2, 2 * orders * dimensions]))
        self.footprint_shift = to_unit(shift)
        self.lattices = shifted_lattices(words, orders, dimensions)
        self.lattices_of_thin_voxels = shifted_lattices(more_words, orders, DRAWS_IN_THIN_VOXELS)
        self.chunk_size = min(PHOTONS_PER_CHUNK, n_photons)
        n_chunks = -(-n_photons // self.chunk_size)
        # Groups are made equally large, so that the last one is not mostly padding.
        self.n_groups = -(-n_chunks // max_chunks_per_group)
        self.chunks_per_group = -(-n_chunks // self.n_groups)
        self.group_size = self.chunks_per_group * self.chunk_size

    @staticmethod
    def n_words(scene: DeviceScene) -> int:
        """Return the number of random words that a batch takes."""
        dimensions = PhotonDraws.dimensions(scene.n_plates) + DRAWS_IN_THIN_VOXELS
        return 4 + 2 * scene.config.order_steps * dimensions

    def first_lane(self, group: UInt32[Array, ""]) -> UInt32[Array, ""]:
        """Return the lane of the first photon of a group."""
        return group * self.group_size

    def send(self, group: UInt32[Array, ""]) -> Lanes:
        """Send the photons of a group from the sensor, arranged in chunks."""
        lane = self.first_lane(group) + jnp.arange(self.group_size, dtype=jnp.uint32)
        if self.nodes is not None:
            assert self.node_key is not None
            lanes = Lanes(*self.nodes.send_photons(self.scene, lane, self.node_key))
        else:
            lanes = Lanes(lane, _send_photons(self.scene, lane, self.footprint_shift))
        shape = (self.chunks_per_group, self.chunk_size)
        return jax.tree.map(lambda a: a.reshape(*shape, *a.shape[1:]), vary_with(lanes, self.scene))

    def trace_orders(self, lanes: Lanes, sums: Sums, trace_chunk: TraceChunk) -> tuple[Lanes, Sums]:
        """Trace all orders of a group of photons by `trace_chunk`, which adds to `sums`."""

        def order_step(carry, order):
            # The loop is as long as its size bucket; orders beyond the plan's are passed over.
            def trace(lanes: Lanes, sums: Sums) -> tuple[Lanes, Sums]:
                return self.trace_order(lanes, sums, trace_chunk, order)

            return lax.cond(order < self.scene.orders, trace, lambda *carry: carry, *carry), None

        return lax.scan(order_step, (lanes, sums), jnp.arange(self.scene.config.order_steps))[0]

    def trace_order(
        self, lanes: Lanes, sums: Sums, trace_chunk: TraceChunk, order: Int[Array, ""]
    ) -> tuple[Lanes, Sums]:
        """Trace one order of all chunks of a group.

        1. Compact: find the new order of living photons.
        2. Gather a chunk of photons in that order.
        3. Trace it, if any of them lives, and put it in its place; chunk after chunk.
        """
        scene, chunk_size = self.scene, self.chunk_size
        # Late orders have few photons left, and their paths differ in length: sorted, whole chunks are
        # dead or end together, and can be skipped.
        source, n_living = compact(scene, lanes.photons)
        # Photons are gathered chunk by chunk, in their new order: a sort of the whole state would copy
        # all of it through memory.
        flat = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), lanes)

        def gather(chunk) -> Lanes:
            number = source[chunk]
            in_chunk = jax.tree.map(lambda a: a.at[number].get(mode="promise_in_bounds"), flat)
            alive = chunk * chunk_size + jnp.arange(chunk_size) < n_living
            return barrier(eqx.tree_at(lambda c: c.photons.alive, in_chunk, alive))

        def trace(in_chunk, sums):
            draws = PhotonDraws.from_numbers(self.lattices(in_chunk.lane, order), scene.n_plates)
            return trace_chunk(in_chunk, sums, draws, order)

        # Reverse mode traces each chunk again, and keeps the intermediate values of one at a time.
        trace_again = jax.checkpoint(trace) if scene.reverse else trace

        def skip(in_chunk, sums):
            return in_chunk, sums

        def scanned_chunk(sums, chunk):
            in_chunk = gather(chunk)
            any_alive = any_problem(in_chunk.photons.alive)
            in_chunk, sums = lax.cond(any_alive, trace_again, skip, in_chunk, sums)
            return sums, in_chunk

        def looped_chunk(chunk, state):
            lanes, sums = state
            in_chunk, sums = trace(gather(chunk), sums)
            return jax.tree.map(lambda a, b: a.at[chunk].set(b), lanes, in_chunk), sums

        if scene.reverse:
            # Chunks of dead photons are skipped. The loop has a static length, as reverse mode needs.
            sums, lanes = lax.scan(scanned_chunk, sums, jnp.arange(self.chunks_per_group))
            return lanes, sums
        # Chunks of dead photons are not even looked at.
        none_alive = jnp.zeros_like(lanes.photons.alive)
        all_dead = eqx.tree_at(lambda c: c.photons.alive, lanes, none_alive)
        n_living_chunks = -(-largest_count(n_living) // chunk_size)
        return lax.fori_loop(0, n_living_chunks, looped_chunk, (all_dead, sums))


def trace_higher_orders(
    scene: DeviceScene,
    key: PRNGKeyArray,
    nodes: EntryNodes | None = None,
) -> HigherOrderTally:
    """Trace a batch of photons through up to `orders` scatterings; sums are means per photon.

    With `nodes`, light enters about these and is tallied by node: sums are means per photon of a node.
    """
    words = random_words(key, PhotonBatch.n_words(scene))
    node_key = None if nodes is None else jax.random.split(key)[0]
    return trace_photons(scene, words, nodes, node_key)


def trace_photons(
    scene: DeviceScene,
    words: UInt32[Array, "words"],
    nodes: EntryNodes | None = None,
    node_key: PRNGKeyArray | None = None,
) -> HigherOrderTally:
    """Trace a batch of photons with given random words, as `trace_higher_orders`.

    1. Shift the lattices of random numbers for every order and dimension.
    2. For each group of chunks: send photons from the sensor.
    3. For each order: compact living photons, and trace chunk after chunk through `_trace_order`.
    4. Tally the weight of photons that still live after the last order.
    """
    batch = PhotonBatch(scene, words, nodes, node_key)
    empty = vary_with(empty_tally(scene, nodes), scene)

    def trace_chunk(in_chunk: Lanes, tally: HigherOrderTally, draws: PhotonDraws, order: Int[Array, ""]):
        p, tally = _trace_order(scene, in_chunk.photons, tally, draws, order)
        return Lanes(in_chunk.lane, p), tally

    def trace_group(total: HigherOrderTally, group: UInt32[Array, ""]):
        """Trace all orders of a group of chunks, and add its tally to the total."""
        # A group is a loop body, so that memory for photons does not grow with the batch.
        lanes, tally = batch.trace_orders(batch.send(group), empty, trace_chunk)
        p = lanes.photons
        weight = jnp.where(p.alive, p.weight, 0.0)
        unfollowed = add_to_tally(tally.unfollowed, (), TallyIndex.of(p), weight)
        tally = eqx.tree_at(lambda t: t.unfollowed, tally, unfollowed)
        return jax.tree.map(jnp.add, total, _without_margins(scene, tally)), None

    # Likewise with groups, whose photons are kept for each order.
    step = jax.checkpoint(trace_group) if scene.reverse else trace_group
    # Without margins the total is the result, and takes no memory of its own.
    total = _without_margins(scene, empty)
    return lax.scan(step, total, jnp.arange(batch.n_groups, dtype=jnp.uint32))[0]


def _without_margins(scene: DeviceScene, tally: HigherOrderTally) -> HigherOrderTally:
    """Return a tally of the bins of the record; `outside` has what lies in their margins."""
    bins = scene.bins
    if tally.weight_slopes is not None:
        # Derivatives outside the record have no use, unlike the energy there, which `trim` sums up.
        inside = tally.weight_slopes[bins.max_span : bins.max_span + bins.count]
        tally = eqx.tree_at(lambda t: t.weight_slopes, tally, inside)
    return eqx.tree_at(lambda t: (t.weights, t.outside), tally, bins.trim(tally.weights))


def empty_tally(scene: DeviceScene, nodes: EntryNodes | None = None) -> HigherOrderTally:
    """Return a tally of zeros; its bins have both margins.

    Returns are tallied by history; by wavelength where optics are applied; by node, or shot, and wavelength
    where light is shared. The energy budget has no shots: it is tallied by node.
    """
    n_wavelengths = 0 if scene.optics is None else scene.optics.shape[1]
    if scene.optics is None:
        n_entries = scene.histories.count
    else:
        n_entries = n_wavelengths * (1 if nodes is None else len(nodes.position))
    # Returns are tallied by shot; what no receiver sees (absorption, escape) by node.
    n_return_entries = n_entries if scene.shot_views is None else n_wavelengths * scene.shot_views.n_shots
    n_materials, bins, slopes = len(scene.config.materials), scene.bins, scene.slopes
    return HigherOrderTally(
        weights=jnp.zeros((n_materials, n_return_entries, bins.padded)),
        outside=jnp.zeros((n_materials, n_return_entries)),
        arrived=jnp.zeros((n_materials, n_entries)),
        departed=jnp.zeros((n_materials, n_entries)),
        escaped=jnp.zeros((n_entries,)),
        flown_outside=jnp.zeros((n_entries,)),
        unfollowed=jnp.zeros((n_entries,)),
        weight_slopes=None
        if slopes is None
        else jnp.zeros((bins.padded, slopes.count, slopes.history_optics.shape[1])),
    )


def _send_photons(scene: DeviceScene, lane: UInt32[Array, "photons"], shift: Float[Array, "2"]) -> Photons:
    """Send photons from the sensor, on a Fibonacci disc over the footprint that `shift` moves at random.

    1. Point across the beam: the enclosed fraction of energy in equal steps, the direction by golden angles.
    2. Move it with the geometry (derivatives alone), with the ratio of its density.
    3. The weight is 1 / (number of photons), zero for padding.
    """
    n_photons = scene.config.photons_per_batch
    # Stratified in enclosed energy: every ring of equal energy gets one photon.
    fraction = (lane.astype(float) + shift[0]) / n_photons
    # Turns by the golden angle, in 32-bit integers: floats would lose the fraction of large numbers.
    turn = (lane * jnp.uint32(GOLDEN * 2**32)).astype(float) * 2.0**-32 + shift[1]
    # Lanes beyond the last photon fill up chunks.
    is_real = lane < n_photons
    across, ratio = rays_with_grids(scene, across_beam(scene.beam, fraction, turn))
    weight = jnp.where(is_real, ratio / n_photons, 0.0)
    return start_photons(scene, across, weight, jnp.zeros(lane.shape, jnp.int32), is_real)


class FlownPhotons(NamedTuple):
    """A chunk of photons at the ends of their flights, several for each photon.

    - `p`, `draws`: the photons before, and their random numbers. `flights`, `encounters`: their flights.
    - `weight`, `index`: weight and tally index at each end, with the plates that were passed.
    - `selected`: the end from which each photon goes on.
    - `u`: transmittance up to each end, by which its optical depth -ln u was chosen.
    - `max_length`: how far flights can be recorded, m.
    """

    p: Photons
    draws: PhotonDraws
    flights: Flight
    encounters: SurfaceEncounters
    weight: Float[Array, "ends photons"]
    index: TallyIndex
    selected: Int[Array, "photons"]
    u: Float[Array, "ends photons"]
    max_length: Float[Array, "photons"]

    # Arrays by end have ends along their first axis, and photons along the second; each photon goes on from
    # its own selected end.
    def select_end(self, a: Array) -> Array:
        """Return an array by end at the selected end of each photon."""
        number = self.selected.reshape(1, -1, *(1,) * (a.ndim - 2))
        return jnp.take_along_axis(a, number, 0, mode="promise_in_bounds")[0]


def _trace_order(
    scene: DeviceScene, p: Photons, tally: HigherOrderTally, draws: PhotonDraws, order: Int[Array, ""]
) -> tuple[Photons, HigherOrderTally]:
    """Trace a chunk of photons through one order of scattering: fly, collide, deposit, scatter."""
    flown, tally = fly(scene, p, tally, draws, order)
    tally = lax.cond(
        is_deposited(scene, order), lambda t: _deposit_flights(scene, flown, t), lambda t: t, tally
    )
    return scatter(scene, flown, tally)


def is_deposited(scene: DeviceScene, order: Int[Array, ""]) -> Bool[Array, ""]:
    """Return True if photons deposit returns at this order, counted from 0.

    Light of the first order that returns along the beam is deterministic and has been deposited
    (`trace.first.first_order`).
    """
    return (order > 0) | (scene.beam.return_direction is not None)


def fly(
    scene: DeviceScene,
    p: Photons,
    tally: HigherOrderTally,
    draws: PhotonDraws,
    order: Int[Array, ""],
    move_ends: Callable[[FlownPhotons], FlownPhotons] | None = None,
) -> tuple[FlownPhotons, HigherOrderTally]:
    """Let a chunk of photons fly, and tally the energy that arrives at plates on the way.

    1. Find the surfaces ahead, and sample which plates will stop the photon or let it pass.
    2. Sample the ends of the flight, one in each stratum of u, the transmittance up to the end. The photon
       goes on from one of them. `move_ends` may move them and change their weights.
    3. Apply the plates that the flight passes to weights and histories.
    """
    ends = scene.config.deposits_per_flight
    encounters = meet_surfaces(scene, p, draws.plates_ahead)
    max_length = detach(scene.longest_flight(p))
    # One number u says in which stratum the photon goes on, floor(u n), and where in each stratum its end
    # lies, the remainder: the ends (i + remainder) / n are stratified, and the selected one is u itself.
    selected = jnp.minimum(jnp.floor(draws.flight * ends), ends - 1)
    strata = jnp.stack([(i + (draws.flight * ends - selected)) / ends for i in range(ends)])
    # The logarithm of zero would be an infinite depth: depths end at -ln(1e-9) = 20.7.
    u = jnp.maximum(strata, 1e-9)
    moves = has_moving_landings(scene)
    flights = sample_flights(scene, p, encounters, max_length, u, by_path=moves)
    # Rays of the first order move already (`rays_with_grids`).
    if moves:
        flights = move_landings(scene, p, encounters, flights, order > 0)
    # Optimisation barrier: flights serve several results, each of which would compute the march again.
    stops = (encounters.stops, encounters.nearest_stop, encounters.mesh_normal)
    p, draws, flights, stops = barrier((p, draws, flights, stops))
    stops, nearest_stop, mesh_normal = stops
    encounters = dataclasses.replace(
        encounters, stops=stops, nearest_stop=nearest_stop, mesh_normal=mesh_normal
    )
    to_ends = functools.partial(jnp.broadcast_to, shape=strata.shape)
    flown = FlownPhotons(
        p=p,
        draws=draws,
        flights=flights,
        encounters=encounters,
        weight=to_ends(p.weight) * flights.ratio,
        index=jax.tree.map(lambda a: jnp.broadcast_to(a, (ends, *a.shape)), TallyIndex.of(p)),
        selected=selected.astype(jnp.int32),
        u=u,
        max_length=max_length,
    )
    if move_ends is not None:
        flown = move_ends(flown)
    # Before deposits: these carry the history with the plates that their flight has passed.
    return _pass_plates(scene, flown, tally)


def scatter(
    scene: DeviceScene, flown: FlownPhotons, tally: HigherOrderTally
) -> tuple[Photons, HigherOrderTally]:
    """Let a chunk of photons go on from their selected ends.

    1. Tally light that escapes or would come after the record.
    2. Sample the collision at the selected end, tally what arrives and what goes on, and update the photon.
    """
    p, draws, encounters = flown.p, flown.draws, flown.encounters
    # The selected end is distributed as the end of a flight with one uniform number: to go on from it needs
    # no weight.
    flight, weight, index = jax.tree.map(flown.select_end, (flown.flights, flown.weight, flown.index))
    escaped = add_to_tally(tally.escaped, (), index, jnp.where(flight.escaped, weight, 0.0))
    flown_outside = add_to_tally(tally.flown_outside, (), index, jnp.where(flight.outside, weight, 0.0))
    tally = eqx.tree_at(lambda t: (t.escaped, t.flown_outside), tally, (escaped, flown_outside))

    # The collision is sampled again for the selected end: taking it from the deposits would keep the onward
    # directions of all ends alive.
    p = dataclasses.replace(p, w=flight.direction(p))
    x, path, collision = collide(scene, p, flight, encounters, draws)
    weight = jnp.where(flight.has_hit, weight, 0.0)
    tally = tally.with_arrival(collision.material, index, weight)
    index = index.after(scene, collision.channel)
    # `collision.weight` belongs to the collision, `onward_weight` to the direction onward: deposits take the
    # first alone.
    weight = weight * collision.weight * collision.onward_weight
    tally = tally.with_departure(collision.material, index, weight)
    if index.optical_weights is not None:
        # The geometric weight doubles at every scattering by a leaf, and the optical weight halves: over
        # hundreds of orders only their product stays in the range of single precision.
        weight, index = jnp.ones_like(weight), index.times(weight)
    score = None
    if p.score is not None:
        assert flight.depth_slopes is not None
        # The score grows by the collision and falls by the depth flown (`trace.derivatives.score_functions`).
        at_collision = collision_score(scene, flight.cell, flight.collided, collision)
        score = p.score - flight.depth_slopes + at_collision
    onward = Photons(
        x=clear_of_mesh(scene, x, collision.w, collision.surface, collision.normal),
        w=collision.w,
        path=path,
        weight=weight,
        history=index.number,
        surface=collision.surface,
        last_scattering=scene.if_differentiated(collision.last_scattering),
        alive=flight.has_hit,
        optical_weights=index.optical_weights,
        entry_point=index.entry_point,
        score=score,
    )
    return onward, tally


def _pass_plates(
    scene: DeviceScene, flown: FlownPhotons, tally: HigherOrderTally
) -> tuple[FlownPhotons, HigherOrderTally]:
    """Apply the plates that flights pass, by a gap or straight through, to weights and histories.

    1. Every plate that was passed, or is landed on, multiplies the weight by the ratio of its sampled
       outcome.
    2. Transmission divides the weight by its probability, and adds the plate's channel to the history.
    3. For the energy budget, weight arrives at a plate with the history that it has there. The product of
       optics does not depend on the order of plates, but what arrives at each does: nearer plates come first.
    """
    config, limits = scene.config, scene.limits
    weight, index, encounters, select_end = flown.weight, flown.index, flown.encounters, flown.select_end
    to_ends = functools.partial(jnp.broadcast_to, shape=weight.shape)
    transmits: dict[int, Bool[Array, "ends photons"]] = {}
    for passage in passed_plates(scene, flown.p, flown.flights, encounters):
        ratio = encounters.ratios[passage.plate]
        assert ratio is not None
        # The ratio of the outcome belongs to passed plates and to the plate that was hit; plates behind the
        # end were not met.
        weight = weight * jnp.where(passage.is_met, to_ends(ratio), 1.0)
        transmits[passage.plate] = passage.is_transmitted
    # The budget follows the selected end alone: it is the photon; other ends are estimates of what returns.
    selected_weight, selected_index = select_end(weight), jax.tree.map(select_end, index)
    transmission_probability = 1.0 - limits.reflection_probability
    for i, transmitted in transmits.items():
        scatterer, is_transmitted = config.surfaces[i], select_end(transmitted)
        arriving_weight, arriving_index = selected_weight, selected_index
        for j, other_transmitted in transmits.items():
            if j != i:
                is_nearer = encounters.distances[j] < encounters.distances[i]
                before = is_transmitted & select_end(other_transmitted) & is_nearer
                arriving_weight = jnp.where(
                    before, arriving_weight / transmission_probability, arriving_weight
                )
                arriving_index = arriving_index.after_where(before, scene, config.surfaces[j].transmission)
        arriving_weight = jnp.where(is_transmitted, arriving_weight, 0.0)
        tally = tally.with_arrival(scatterer.material, arriving_index, arriving_weight)
        onward = arriving_index.after(scene, scatterer.transmission)
        tally = tally.with_departure(scatterer.material, onward, arriving_weight / transmission_probability)
        index = index.after_where(transmitted, scene, scatterer.transmission)
        weight = jnp.where(transmitted, weight / transmission_probability, weight)
    return flown._replace(weight=weight, index=index), tally


class FlightEnds(NamedTuple):
    """The ends of the flights of a chunk of photons, and their collisions, all along one axis.

    - `p`, `flights`, `draws`, `index`: as in `FlownPhotons`.
    - `x`, `path`, `collision`: position, path length and collision.
    """

    p: Photons
    flights: Flight
    draws: PhotonDraws
    index: TallyIndex
    x: Vec
    path: Scalar
    collision: Collision


def collide_at_ends(scene: DeviceScene, flown: FlownPhotons) -> FlightEnds:
    """Sample the collision at each end of flights; ends lie along one axis, so that one program serves all.

    Scores and derivatives of depths, which have an axis of parameters, are left out.
    """
    ends = scene.config.deposits_per_flight

    def flatten(a: Array) -> Array:
        return jnp.broadcast_to(a, (ends, a.shape[-1])).reshape(-1)

    p = dataclasses.replace(flown.p, score=None, optical_weights=None, w=flown.flights.direction(flown.p))
    flights = dataclasses.replace(flown.flights, depth_slopes=None, moved_w=None)
    p, flights, encounters, draws = jax.tree.map(flatten, (p, flights, flown.encounters, flown.draws))
    index = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), flown.index)
    return FlightEnds(p, flights, draws, index, *collide(scene, p, flights, encounters, draws))


def _deposit_flights(scene: DeviceScene, flown: FlownPhotons, tally: HigherOrderTally) -> HigherOrderTally:
    """Deposit the expected return of every end of the flights, each with an equal share of the weight.

    1. With score functions: the score at each end, that of the photon less the derivative of the depth flown.
    2. Sample the collision at each end, and add its score.
    3. Deposit the return, with the weight divided by the number of ends.
    """
    score, depth_slopes = flown.p.score, flown.flights.depth_slopes
    ends = collide_at_ends(scene, flown)
    if score is not None:
        assert depth_slopes is not None
        score = (score[None] - depth_slopes).reshape(-1, score.shape[-1])
        score = score + collision_score(scene, ends.flights.cell, ends.flights.collided, ends.collision)
    n_entries = tally.weights.shape[1]
    returns = returns_of_ends(scene, ends, flown.weight.reshape(-1), score, n_entries)
    return _add_returns(scene, returns, tally)


class BinnedReturns(NamedTuple):
    """What returns to the sensor from collisions, spread over time bins.

    - `first_bin`: index of the first bin of each return. `rows`: pairs of tally rows, and values in the bins
      from the first on, for each channel by which light returns, shot and wavelength.
    - `row`: the values without the factors of channels. `channel_factors`: channels by which light returns,
      with intensity factors. `index`: tally index with the plates on the return path.
    - `score`: that of the path with its return, or None.
    """

    first_bin: Int[Array, "..."]
    rows: list[tuple[Int[Array, "..."], Float[Array, "... kernel"]]]
    row: Float[Array, "... kernel"]
    channel_factors: list[tuple[Array, Scalar]]
    index: TallyIndex
    score: Float[Array, "photons parameters"] | None


def returns_of_ends(
    scene: DeviceScene,
    ends: FlightEnds,
    weight: Scalar,
    score: Float[Array, "photons parameters"] | None,
    n_entries: int,
) -> BinnedReturns:
    """Compute the expected returns of ends of flights, with the weights there.

    `n_entries`: of the tally that returns are added to, for each material.
    """
    # Each end stands for its stratum: an equal share of the probability.
    n_ends = scene.config.deposits_per_flight
    value = jnp.where(ends.flights.has_hit, weight, 0.0) * ends.collision.weight / n_ends
    # Optimisation barrier: of the collision only what its return depends on passes, so that directions onward
    # are not computed.
    w, x, path, value, index, collision, plate_draws, score = barrier(
        (
            ends.p.w,
            ends.x,
            ends.path,
            value,
            ends.index,
            collision_for_return(scene, ends.collision),
            ends.draws.plates_behind,
            score,
        )
    )
    return _returns_of_collisions(
        scene, w, x, path, value, index, collision, plate_draws, score, n_entries=n_entries
    )


def _add_returns(scene: DeviceScene, returns: BinnedReturns, tally: HigherOrderTally) -> HigherOrderTally:
    """Add returns, and their derivatives with score functions, to a tally."""
    weights = tally.weights.reshape(-1, scene.bins.padded)
    for tally_row, values in returns.rows:
        weights = add_rows(weights, tally_row, returns.first_bin, values)
    if returns.score is not None:
        assert tally.weight_slopes is not None
        weight_slopes = add_derivatives_of_returns(
            scene,
            tally.weight_slopes,
            returns.first_bin,
            returns.row,
            returns.score,
            returns.channel_factors,
            returns.index,
        )
        tally = eqx.tree_at(lambda t: t.weight_slopes, tally, weight_slopes)
    return eqx.tree_at(lambda t: t.weights, tally, weights.reshape(tally.weights.shape))


def _returns_of_collisions(
    scene: DeviceScene,
    w: Vec,
    x: Vec,
    path: Scalar,
    weight: Scalar,
    index: TallyIndex,
    collision: CollisionForReturn,
    plate_draws: tuple[Scalar, ...],
    score: Float[Array, "photons parameters"] | None,
    *,
    n_entries: int,
) -> BinnedReturns:
    """Compute the expected returns of collisions at `x`, of light that flew along `w`.

    1. Intensity factors towards the sensor.
    2. Transmittance of the return path: voxels, ground that hides its own slopes, and plates.
    3. Time of arrival, and the value at the range for which that time stands.
    4. Spread over time bins: for each channel by which light returns, shot, and wavelength.
    """
    beam, bins = scene.beam, scene.bins
    v = beam.view(x)
    reflected, transmitted = intensity_factors(scene, x, w, v, collision)
    # The return path is not sampled: its transmittance is computed, which is what makes the deposit an
    # expectation.
    transmittance, score = _return_transmittance(scene, x, v, weight, score)
    transmittance, index = _return_through_surfaces(scene, x, v, collision, plate_draws, transmittance, index)
    out = beam.excess(x)
    time = (path + out) / SPEED_OF_LIGHT
    value = weight * transmittance * beam.range_factor(path, out) * beam.in_view(x)
    channel_factors = [(collision.reflection, reflected)]
    if transmitted is not None:
        channel_factors.append((collision.transmission, transmitted))
    shots, material = None, collision.material
    if scene.shot_views is not None:
        assert index.entry_point is not None
        # One row for each shot that may see the path.
        shots, seen, delay = barrier(scene.shot_views.seen_by_shots(beam.axis, index.entry_point, x))
        time, value, material = time[:, None] + delay, value[:, None] * seen, material[:, None]
    # One row serves all channels and wavelengths, which differ by factors alone.
    first_bin, row = barrier(bspline_row(bins, time, value))
    # Optimisation barriers: fused into the rows, factors would be computed again for each bin.
    if scene.optics is None:
        rows = []
        for channel, factor in channel_factors:
            factor = barrier(jnp.where(channel >= 0, factor, 0.0))
            history = index.after(scene, channel).number
            rows.append((material * n_entries + history, row * factor[:, None]))
    else:
        # Channels differ by optics alone: one row has their sum, at all wavelengths.
        factors = [
            index.after(scene, channel).by_wavelength(jnp.where(channel >= 0, factor, 0.0))
            for channel, factor in channel_factors
        ]
        of_wavelengths = barrier(functools.reduce(jnp.add, factors))
        values = row[..., None, :] * of_wavelengths.reshape(len(row), *(1,) * (row.ndim - 2), -1, 1)
        first_row = (index.number if shots is None else shots) * scene.optics.shape[1]
        rows = [(material * n_entries + first_row, values)]
    return BinnedReturns(first_bin, rows, row, channel_factors, index, score)


def _return_transmittance(
    scene: DeviceScene,
    x: Vec,
    v: Vec,
    weight: Scalar,
    score: Float[Array, "photons parameters"] | None,
) -> tuple[Scalar, Float[Array, "photons parameters"] | None]:
    """Return exp(-tau) of the voxels from `x` to the sensor along `v`, and scores less the derivative of tau.

    1. At nadir, tau is looked up in the column of voxels above the point.
    2. Otherwise rays are marched to where they leave the voxels, or to a sensor within them.
    """
    medium = scene.medium
    if medium is None:
        return jnp.ones_like(weight), score
    if scene.depth_above is not None:
        depth_above = scene.depth_above
        transmittance = jnp.exp(-jax.vmap(lambda x: depth_to_top(medium, x, depth_above))(x))
        if score is not None:
            score = score - vertical_depth_slopes(scene, medium, x)
        return transmittance, score
    # Without targets the march follows rays to the sensor, or to where they leave the grid.
    to_sensor = scene.beam.distance_to_sensor(x)
    no_targets, to_end = jnp.zeros((0, weight.size)), jnp.full_like(weight, FAR)
    to_end = to_end if to_sensor is None else to_sensor
    return_path = march_to_depths(
        medium,
        x,
        v,
        no_targets,
        to_end,
        weight > 0,
        scene.config.max_faces,
        reverse=scene.reverse,
        slopes=scene.slopes,
    )
    if score is not None:
        assert return_path.depth_slopes is not None
        score = score - return_path.depth_slopes[0].T
    return jnp.exp(-return_path.total_depth), score


def _return_through_surfaces(
    scene: DeviceScene,
    x: Vec,
    v: Vec,
    collision: CollisionForReturn,
    plate_draws: tuple[Scalar, ...],
    transmittance: Scalar,
    index: TallyIndex,
) -> tuple[Scalar, TallyIndex]:
    """Apply the surfaces between `x` and the sensor to the transmittance and the history of the return path.

    A mesh in the way lets nothing through. For each other surface:

    1. Ground that can hide points below its own slopes lets nothing through. Straight up, along parallel
       light of shared illumination at nadir, nothing is hidden.
    2. A plate that is crossed is sampled, gap or material, so that each photon has one history; the factor is
       the attached ratio of that outcome.
    3. Material of a plate that transmits straight on adds its channel to the history; that of
       another plate lets nothing through.
    """
    draws, to_sensor = iter(plate_draws), scene.beam.distance_to_sensor(x)
    # What lies behind the sensor is not crossed.
    end = FAR if to_sensor is None else to_sensor
    if scene.meshes is not None:
        start = clear_of_mesh(scene, x, v, collision.surface, collision.normal)
        is_hidden = scene.meshes.is_met(start, v, transmittance > 0, before=to_sensor)
        transmittance = jnp.where(is_hidden, 0.0, transmittance)
    for i, (surface, scatterer) in enumerate(zip(scene.surfaces, scene.config.surfaces)):
        if surface.is_mesh:
            continue
        if not surface.is_plate:
            # Only a height field can lie in the way of its own return; a plane never does.
            if surface.lights_itself and not (scene.beam.parallel and scene.config.vertical):
                transmittance = jnp.where(surface.distance(x, v) < end, 0.0, transmittance)
            continue
        is_covered = next(draws) < surface.coverage
        is_crossed = surface.distance(x, v) < end
        if not surface.lights_itself:
            # Light that starts on the plate does not meet it again.
            is_crossed &= collision.surface != i
        coverage = jnp.broadcast_to(surface.coverage, transmittance.shape)
        ratio = attached_ratio(jnp.where(is_covered, coverage, 1.0 - coverage))
        if surface.straight:
            index = index.after_where(is_crossed & is_covered, scene, scatterer.transmission)
            factor = ratio if scatterer.transmission >= 0 else jnp.where(is_covered, 0.0, ratio)
        else:
            factor = jnp.where(is_covered, 0.0, ratio)
        transmittance = transmittance * jnp.where(is_crossed, factor, 1.0)
    return transmittance, index
