"""Absorption and escape: light that is followed to its end, without time and without a last order.

Photons are those of the response, with optics applied while they are traced (`trace.photons.higher_orders`).
They deposit nothing; only the energy budget is tallied. What a material absorbs is the weight that arrived at
it less the weight that went on from it.

Russian roulette: with E the largest energy of any wavelength, relative to the emitted one, a photon of E < f
survives with the probability E / f, and its weight is divided by that. This is unbiased.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt32

from jaxlidar._jax.one_function import barrier
from jaxlidar._jax.vmapped_loops import any_problem
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.photons.higher_orders import (
    HigherOrderTally,
    Lanes,
    PhotonBatch,
    empty_tally,
    fly,
    scatter,
)
from jaxlidar.trace.photons.random_numbers import PhotonDraws, random_words
from jaxlidar.trace.tally_index import TallyIndex, add_to_tally

# Below this fraction of the emitted energy a photon may be ended.
_ROULETTE_ENERGY = 0.05

# Weights tallied, and of these the weight that escaped downward.
_Sums = tuple[HigherOrderTally, Float[Array, "wavelengths"]]


def trace_to_end(scene: DeviceScene, key: PRNGKeyArray, max_orders: int) -> dict[str, Array]:
    """Trace a batch of photons to their ends, at most through `max_orders` scatterings.

    `scene` has optics, and a loop of two orders: the first has random numbers of its own, and all later ones
    have those of the second, each from its own key.

    **Returns:** the fractions of the emitted energy that each material absorbs, by its name; that leave the
    scene upward ("returned") and downward ("below"); that arrive at the ground, every time they do
    ("transmitted"); and that flew too far, or were not at their end after the last order ("unfollowed").
    """
    n_words = PhotonBatch.n_words(scene)

    def batch_of_order(order: Int[Array, ""] | int) -> PhotonBatch:
        return PhotonBatch(scene, random_words(jax.random.fold_in(key, order), n_words))

    def trace_order(state: tuple[Lanes, _Sums, Int[Array, ""]]) -> tuple[Lanes, _Sums, Int[Array, ""]]:
        lanes, sums, order = state
        batch = batch_of_order(order)

        def trace_chunk(chunk: Lanes, sums: _Sums, draws: PhotonDraws, order: Array) -> tuple[Lanes, _Sums]:
            # A sum for each chunk: thousands of equal weights, added one after the other in single precision,
            # are off by 5e-5. Optimisation barrier: the compiler would add them to the total all the same.
            chunk, chunk_sums = barrier(_trace_chunk(scene, batch, chunk, no_sums, draws, order))
            return chunk, jax.tree.map(jnp.add, sums, chunk_sums)

        return *batch.trace_order(lanes, sums, trace_chunk, jnp.minimum(order, 1)), order + 1

    # Nothing is added to the returns, which are left out.
    tally = eqx.tree_at(lambda t: (t.weights, t.outside), empty_tally(scene), (None, None))
    no_sums = tally, tally.escaped
    start = batch_of_order(0).send(jnp.zeros((), jnp.uint32)), no_sums, jnp.asarray(0)
    # A loop of unknown length: energy is followed until no photon is left, which no fixed number of orders
    # would do. It has no reverse derivative; `energy_budget` needs none.
    lanes, (tally, down), _ = jax.lax.while_loop(
        lambda state: any_problem(state[0].photons.alive) & (state[2] < max_orders), trace_order, start
    )
    p = lanes.photons
    # What the last order leaves is not followed, and is reported so.
    after_last = add_to_tally(tally.flown_outside, (), TallyIndex.of(p), jnp.where(p.alive, p.weight, 0.0))
    config, on_ground = scene.config, jnp.zeros_like(down)
    if config.has_ground:
        # The ground is the first of the surfaces.
        on_ground = tally.arrived[config.surfaces[0].material]
    fractions = dict(zip(config.materials, tally.arrived - tally.departed))
    fractions |= {"returned": tally.escaped - down, "below": down}
    return fractions | {"transmitted": on_ground, "unfollowed": after_last}


def _trace_chunk(
    scene: DeviceScene, batch: PhotonBatch, chunk: Lanes, sums: _Sums, draws: PhotonDraws, order: Array
) -> tuple[Lanes, _Sums]:
    """Trace a chunk of photons through one order: fly, scatter, and end faint ones by Russian roulette."""
    tally, down = sums
    flown, tally = fly(scene, chunk.photons, tally, draws, order)
    index, weight, escaped = jax.tree.map(
        flown.select_end, (flown.index, flown.weight, flown.flights.escaped)
    )
    down = add_to_tally(down, (), index, jnp.where(escaped & (flown.p.w[2] <= 0), weight, 0.0))
    p, tally = scatter(scene, flown, tally)
    assert p.optical_weights is not None
    # By the largest energy of all wavelengths: one photon carries them all, and ends for all at once.
    energy = scene.config.photons_per_batch * p.weight * jnp.max(p.optical_weights, axis=-1)
    survival = jnp.minimum(energy / _ROULETTE_ENERGY, 1.0)
    # No derivatives are taken, which these numbers are for elsewhere.
    is_alive = p.alive & (batch.lattices_of_thin_voxels(chunk.lane, order)[0] < survival)
    p = dataclasses.replace(p, weight=p.weight / jnp.where(is_alive, survival, 1.0), alive=is_alive)
    return Lanes(_mix(chunk.lane), p), (tally, down)


def _mix(lane: UInt32[Array, "photons"]) -> UInt32[Array, "photons"]:
    """Return other numbers of photons, all different, without an order, by the last step of MurmurHash3.

    Multiples of consecutive numbers may take few values, which makes the errors of some batches large where
    those of most are small: a few batches would not tell their standard error.
    """
    lane = (lane ^ (lane >> 16)) * jnp.uint32(0x85EBCA6B)
    lane = (lane ^ (lane >> 13)) * jnp.uint32(0xC2B2AE35)
    return lane ^ (lane >> 16)
