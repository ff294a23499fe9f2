r"""Thin voxels in derivatives of orders two and above: what leaf or bark there scatters, or would scatter.

The derivative of a collision with respect to the extinction k of its voxel is the deposits from there on,
over k (`trace.derivatives.higher_order_replay`). Where k is zero, photons never collide. Where it is small,
hardly one of them does, and counts for much: its derivative would be missing from nearly every sample, whose
scatter would not tell. So in thin voxels (`Medium.is_thin`) collisions are placed on flights; those of the
flights themselves do not count. With L the length of a flight within the voxels, and D(s) the deposits from a
collision at s on,

    dR/dk = sum over orders of E[ integral_0^L 1(x(s) lies in a thin voxel) D(s) ds ].

The transmittance up to s needs no factor: a flight reaches s with exactly that probability. This is the term
of in-scattering of the differential transfer equation (Nimier-David, Mueller, Keller and Jakob 2022, ACM
Trans. Graph. 41, 44). The integral is L times the integrand at a uniform point; a photon ends where that does
not lie in a thin voxel. For leaves that are not spherically oriented, k is multiplied by 2 G.

Photons are traced once more for this. Each is placed at one of its orders n = 1, 2, ...: with the probability
P = 1 / (n + 1) if it was not before, and P = 1 at the last one. Its weight is divided by P, or by 1 - P if it
goes on without. So a photon that is placed at order n has the weight n (n + 1): weights grow polynomially
with n, not geometrically. From there on it deposits as any photon does.

A voxel may be thin for leaf, for bark, or for both. `ThinVoxels` lays out a second map behind the first one.
Its extinction is 1 where the first one is thin, and 0 elsewhere: a collision there chooses the material.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt32

from jaxlidar._jax.vmapped_loops import any_problem
from jaxlidar._vectors import Scalar, along
from jaxlidar.trace.deposit import add_rows
from jaxlidar.trace.derivatives.replay import ExtinctionTables
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.march.flight import Flight
from jaxlidar.trace.march.voxel_traversal import Medium, cell_index, enter_grid, voxel_at
from jaxlidar.trace.photons.higher_orders import (
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
from jaxlidar.trace.photons.photons import attached_ratio
from jaxlidar.trace.photons.random_numbers import PhotonDraws

# Thin voxels in which ends of flights were placed, or their photons at an earlier order: the index of the
# cell for leaf, that plus the number of cells for bark, or -1 for none.
Placed = Int[Array, "ends photons"]


class ThinVoxels(NamedTuple):
    """The thin voxels of a scene, for photons that are placed there.

    - `scene`: the scene, with a second map behind its own (see the module). `n_cells`: size of the first map.
    - `are_thin`: for leaf in all cells, then for bark, True where this material is thin; False where there is
      no such material.
    """

    scene: DeviceScene
    n_cells: int
    are_thin: Bool[Array, "two_materials_cells"]

    @staticmethod
    def of(scene: DeviceScene) -> "ThinVoxels":
        """Find the thin voxels of a scene."""
        medium = scene.medium
        assert medium is not None
        in_map, is_thin_at = _in_map(medium), medium.is_thin

        def find_thin(table: Array | None) -> tuple[Bool[Array, "cells"], Array | None]:
            if table is None:
                return jnp.zeros_like(in_map), None
            is_thin = in_map & is_thin_at(table)
            return is_thin, jnp.concatenate([table, is_thin.astype(table.dtype)])

        (thin_leaf, leaf), (thin_bark, bark) = find_thin(medium.leaf), find_thin(medium.bark)
        total = None if medium.total is None or leaf is None or bark is None else leaf + bark
        medium = dataclasses.replace(medium, leaf=leaf, bark=bark, total=total)
        are_thin = jnp.concatenate([thin_leaf, thin_bark])
        return ThinVoxels(dataclasses.replace(scene, medium=medium), in_map.size, are_thin)

    def trace_chunk(
        self,
        batch: PhotonBatch,
        in_chunk: Lanes,
        draws: PhotonDraws,
        order: Int[Array, ""],
        is_placing: Bool[Array, ""],
    ) -> tuple[FlownPhotons, FlightEnds, Placed, Lanes]:
        """Trace a chunk of photons through one order, and place some of them if `is_placing`.

        **Returns:** flights, the collisions at their ends, voxels in which these were placed, and the photons
        that go on.
        """
        n_cells, config, tally = self.n_cells, self.scene.config, empty_tally(self.scene)
        assert in_chunk.thin_voxel is not None

        def place(flown: FlownPhotons) -> FlownPhotons:
            def place_undecided() -> tuple[Flight, Scalar]:
                return self._place(
                    flown, batch.lattices_of_thin_voxels(in_chunk.lane, order), order, undecided
                )

            flights, weight = lax.cond(is_placing, place_undecided, lambda: (flown.flights, flown.weight))
            return flown._replace(flights=flights, weight=weight)

        undecided = in_chunk.photons.alive & (in_chunk.thin_voxel < 0)
        flown, _ = fly(self.scene, in_chunk.photons, tally, draws, order, place)
        ends = collide_at_ends(self.scene, flown)
        cell, is_placed = ends.flights.cell, ends.flights.collided & (ends.flights.cell >= n_cells)
        if config.bark is None:
            voxel = cell - n_cells
        else:
            voxel = jnp.where(ends.collision.material == config.bark.material, cell, cell - n_cells)
        before = jnp.broadcast_to(in_chunk.thin_voxel, flown.weight.shape)
        placed = jnp.where(is_placed.reshape(before.shape), voxel.reshape(before.shape), before)
        p, _ = scatter(self.scene, flown, tally)
        return flown, ends, placed, Lanes(in_chunk.lane, p, flown.select_end(placed))

    def _place(
        self,
        flown: FlownPhotons,
        draws: list[Float[Array, "photons"]],
        order: Int[Array, ""],
        undecided: Bool[Array, "photons"],
    ) -> tuple[Flight, Float[Array, "ends photons"]]:
        """Place photons that are not placed yet, each with the probability P, on their flights.

        1. Choose these photons.
        2. A uniform point on the part of each flight that lies within the voxels.
        3. The extinction k of the second map there: 0 ends the photon. The weight is the length times k / P,
           and 1 / (1 - P) for photons that go on without.
        """
        scene, p, flights = self.scene, flown.p, flown.flights
        medium = scene.medium
        assert medium is not None
        choice, position = draws
        is_last = order + 1 == scene.orders
        probability = jnp.where(is_last, 1.0, 1.0 / (order + 2).astype(choice.dtype))
        chosen = undecided & (choice < probability)
        # Not only the box of occupied voxels, at which marches end.
        ray, n_ends = enter_grid(medium, p.x, p.w), len(flown.weight)
        # Points of several ends are stratified.
        fraction = jnp.stack([position + i / n_ends for i in range(n_ends)])
        fraction = fraction - jnp.floor(fraction)
        to_ends = functools.partial(jnp.broadcast_to, shape=fraction.shape)
        x, w, enter, leave, is_placed_now = jax.tree.map(to_ends, (p.x, p.w, ray.enter, ray.leave, chosen))
        length = jnp.maximum(jnp.minimum(flights.distance, leave) - enter, 0.0)
        distance = enter + fraction * length
        _, voxel = voxel_at(medium, along(x, w, distance))
        cell = cell_index(medium, voxel) + self.n_cells
        k = medium.extinction(cell, w)
        # The flight's own end remains a random decision: its density is attached, also the factor k of its
        # collision (`trace.march.flight`), for second derivatives.
        k_of_end = jnp.where(flights.collided, medium.extinction(flights.cell, w), 1.0)
        # The bound serves the last order alone, at which all are placed and P is 1.
        going_on = to_ends(jnp.where(undecided, 1.0 / jnp.maximum(1.0 - probability, 0.1), 1.0))
        factor = jnp.where(is_placed_now, length * k * attached_ratio(k_of_end) / probability, going_on)
        moved = dataclasses.replace(
            flights,
            collided=jnp.where(is_placed_now, length * k > 0.0, flights.collided),
            landed=flights.landed & ~is_placed_now,
            outside=flights.outside & ~is_placed_now,
            escaped=flights.escaped & ~is_placed_now,
            cell=jnp.where(is_placed_now, cell, flights.cell),
            distance=jnp.where(is_placed_now, distance, flights.distance),
        )
        return moved, flown.weight * factor

    def add_to_tables(self, tables: ExtinctionTables, placed: Placed, values: Scalar) -> ExtinctionTables:
        """Add values to the tables of extinction, in the voxels where ends were placed."""

        def in_table(first: int) -> tuple[Bool[Array, "..."], Int[Array, "..."]]:
            voxel = placed - first
            counts = (voxel >= 0) & (voxel < self.n_cells)
            return counts, jnp.where(counts, voxel, 0)

        (on_leaf, leaf_cell), (on_bark, bark_cell) = in_table(0), in_table(self.n_cells)
        tables = tables.add_tables(leaf_cell, jnp.where(on_leaf, values, 0.0), None)
        return tables.add_tables(bark_cell, None, jnp.where(on_bark, values, 0.0))


def add_tangents_of_thin_voxels(
    scene: DeviceScene, words: UInt32[Array, "words"], of_tables: ExtinctionTables, tangent: HigherOrderTally
) -> HigherOrderTally:
    """Add to a tangent of the result of `trace_photons` what scattering in thin voxels adds.

    Returns alone have derivatives, as in `trace.derivatives.higher_order_replay`.

    **Arguments:** `of_tables`: tangents of the tables of extinction; None where they are zero.
    """
    thin_voxels, batch, tally = ThinVoxels.of(scene), PhotonBatch(scene, words), empty_tally(scene)
    no_tangent = jnp.zeros((thin_voxels.n_cells,), tally.weights.dtype)
    of_voxels = jnp.concatenate([no_tangent if t is None else t for t in (of_tables.leaf, of_tables.bark)])

    def trace_chunk(in_chunk: Lanes, weights: Array, draws: PhotonDraws, order: Int[Array, ""]):
        is_placing = jnp.asarray(True)
        flown, ends, placed, onward = thin_voxels.trace_chunk(batch, in_chunk, draws, order, is_placing)
        factor = jnp.where(placed >= 0, of_voxels[jnp.maximum(placed, 0)], 0.0)

        def deposit(weights: Array) -> Array:
            weight, n_entries = flown.weight.reshape(-1), tally.weights.shape[1]
            returns = returns_of_ends(thin_voxels.scene, ends, weight, None, n_entries)
            for row, values in returns.rows:
                of_voxel = factor.reshape(-1, *(1,) * (values.ndim - 1))
                weights = add_rows(weights, row, returns.first_bin, values * of_voxel)
            return weights

        return onward, lax.cond(is_deposited(scene, order), deposit, lambda w: w, weights)

    def trace_group(group: Int[Array, ""], weights: Array) -> Array:
        lanes = start_unplaced(batch.send(group.astype(jnp.uint32)))
        return batch.trace_orders(lanes, weights, trace_chunk)[1]

    is_moved = any_problem(thin_voxels.are_thin & (of_voxels != 0.0))
    weights = tally.weights.reshape(-1, scene.bins.padded)
    weights = lax.fori_loop(0, jnp.where(is_moved, batch.n_groups, 0), trace_group, weights)
    inside, outside = scene.bins.trim(weights.reshape(tally.weights.shape))
    return dataclasses.replace(tangent, weights=tangent.weights + inside, outside=tangent.outside + outside)


def start_unplaced(lanes: Lanes) -> Lanes:
    """Return photons that are not placed in thin voxels yet."""
    return lanes._replace(thin_voxel=jnp.full(lanes.lane.shape, -1))


def _in_map(medium: Medium) -> Bool[Array, "cells"]:
    """Return True for voxels of the map, False for the room behind it."""
    numbers = (jnp.arange(n) < count for n, count in zip(medium.shape, medium.counts))
    x, y, z = jnp.meshgrid(*numbers, indexing="ij")
    return (x & y & z).reshape(-1)
