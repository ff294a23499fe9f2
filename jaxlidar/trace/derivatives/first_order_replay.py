r"""Cotangents of extinction at first order: each ray is marched once more, and its segments taken in reverse.

With the cotangents y of the response, a segment of the extinction k and the length l, before which the
optical depth is tau, contributes

    D(k, tau, ...) = sum over bins and materials of y * (what it returns) + (the same of what arrives)

to the loss. Extinction acts on it in three ways: as k itself, as the extinction k_m of each material, and by
the depth tau, to which every segment in front adds its k l. So

    dL / dk of segment i = dD_i / dk + l_i * sum over j behind i of dD_j / dtau,

and surfaces and what escapes, which depend on depths as segments do, are the first terms of that sum.
Segments are taken from the last to the first, and the sum is carried along. Nothing is stored but the
segments of the chunk of rays that is being marched; voxels of zero extinction have derivatives like all
others.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxlidar._jax.vmapped_loops import largest_count
from jaxlidar._vectors import Scalar
from jaxlidar.trace.deposit import take_rows
from jaxlidar.trace.derivatives.replay import ExtinctionTables
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.first.first_order import (
    FirstOrder,
    FirstOrderTracer,
    SegmentReturns,
    march_rays,
    material_extinctions,
    move_rays,
    ray_chunks,
    send_rays,
    smooth_padded,
)


def pull_back_first_order(
    scene: DeviceScene,
    across: tuple[Float[Array, "rays"], Float[Array, "rays"]],
    energy: Float[Array, "rays"],
    cotangent: FirstOrder,
    *,
    mirror: int | None = None,
) -> ExtinctionTables:
    """Pull cotangents of the results of `first_order` back to the extinction of every voxel.

    For each chunk of rays:

    1. Send the rays, and march them into segments.
    2. Cotangents of the depths at surfaces, and of the whole depth, by which light escapes.
    3. From the last step to the first: cotangents of the extinction of segments and of the depths before
       them; the former, with the sum over what lies behind, are added to the voxels.
    """
    assert scene.medium is not None
    medium, bins, tracer = scene.medium, scene.bins, FirstOrderTracer(scene, mirror)
    n_rows = tracer.shape[0] * tracer.shape[1]

    def trim(returned: Array) -> tuple[Array, Array]:
        return bins.trim(returned.reshape(*tracer.shape, bins.padded))

    # Trimming and smoothing are linear: their transposes are applied once, to the cotangents.
    rows = jax.ShapeDtypeStruct((n_rows, bins.padded), energy.dtype)
    (of_returned,) = jax.linear_transpose(trim, rows)((cotangent.weights, cotangent.outside))
    (of_unsmoothed,) = jax.linear_transpose(smooth_padded, rows)(of_returned)
    of_arrived, of_scattered = cotangent.arrived.reshape(-1), cotangent.scattered.reshape(-1)
    # All energy that collides in the medium is scattered.
    of_collided = of_arrived + of_scattered

    def add_chunk(tables: ExtinctionTables, chunk: list[Scalar]) -> tuple[ExtinctionTables, None]:
        # Step 1.
        x, y, energy = chunk
        rays = send_rays(scene, (x, y), energy)
        segments, depth_at_surfaces, total_depth = march_rays(scene, rays)
        per_ray, empty = (rays, tracer.seen_energy(rays)), tracer.empty_tally(energy)

        # Step 2.
        def without_medium(depth_at_surfaces: list[Scalar], total_depth: Scalar) -> tuple[Array, ...]:
            tally = tracer.deposit_surfaces(empty, rays, depth_at_surfaces, [])
            tally = tracer.add_escape(tally, rays, total_depth)
            return tally.returned, tally.arrived, tally.scattered, tally.escaped

        _, pull = jax.vjp(without_medium, depth_at_surfaces, total_depth)
        of_depths, of_total_depth = pull((of_returned, of_arrived, of_scattered, cotangent.escaped))

        # Step 3. The loop ends with the last step at which any ray is still in the medium.
        numbers = jnp.arange(segments.length.shape[0])
        n_steps = largest_count(jnp.where(jnp.any(segments.length > 0.0, axis=1), numbers + 1, 0))

        def add_step(n, state: tuple[ExtinctionTables, Scalar]) -> tuple[ExtinctionTables, Scalar]:
            tables, of_depth_behind = state
            step = jax.tree.map(lambda a: a[n_steps - 1 - n], segments)

            def contribution(
                k: Scalar, extinctions: tuple[Scalar | None, Scalar | None] | None
            ) -> tuple[Scalar, Scalar]:
                """Return D of every segment: what of it returns, and what arrives, times cotangents."""
                changed = dataclasses.replace(step, extinction=k)
                light = tracer.returns_of_segments(changed, *per_ray, extinctions)
                return _of_returns(light, of_unsmoothed), _of_arrivals(light, of_collided)

            # D of a segment depends on its own extinction alone, so that one forward derivative has those of
            # all. With one material, its extinction is that of the segment.
            extinctions, one = None, jnp.ones_like(step.extinction)
            if medium.leaf is not None and medium.bark is not None:
                extinctions = material_extinctions(medium, step, rays.w)
                # D is linear in k_m at a fixed k: its derivative is D at k_m = 1.
                of_leaf = jnp.add(*contribution(step.extinction, (one, jnp.zeros_like(one))))
                of_bark = jnp.add(*contribution(step.extinction, (jnp.zeros_like(one), one)))
                tables = tables.add_materials(medium, step.cell, rays.w, (of_leaf, of_bark))
            (returned, arrived), slopes = jax.jvp(
                lambda k: contribution(k, extinctions), (step.extinction,), (one,)
            )
            of_k = jnp.add(*slopes) + step.length * of_depth_behind
            end = step.start + step.length
            for stop, of_stop in zip(rays.surface_distances, of_depths):
                # What of the segment lies before the surface.
                of_k = of_k + of_stop * (jnp.clip(stop, step.start, end) - step.start)
            tables = tables.add_total(medium, step.cell, rays.w, of_k)
            # All that returns has the factor exp(-kappa tau), and all that arrives exp(-tau).
            return tables, of_depth_behind - tracer.kappa * returned - arrived

        return lax.fori_loop(0, n_steps, add_step, (tables, of_total_depth))[0], None

    zero = jax.tree.map(jnp.zeros_like, ExtinctionTables.of(scene))
    return lax.scan(add_chunk, zero, ray_chunks(*move_rays(scene, across, energy)))[0]


def _of_returns(light: SegmentReturns, cotangent: Float[Array, "entries padded"]) -> Scalar:
    """Return the sum over bins and materials of what segments return, times its cotangents."""
    total = jnp.zeros_like(light.pieces[0])
    for material in light.returned:
        row = jnp.broadcast_to(material.row, light.first_bin.shape)
        of_pieces = take_rows(cotangent, row, light.first_bin, (*row.shape, len(light.pieces)))
        of_pieces = jnp.moveaxis(of_pieces, -1, 0)
        total = total + material.extinction * material.factor * jnp.sum(light.pieces * of_pieces, axis=0)
    return total


def _of_arrivals(light: SegmentReturns, cotangent: Float[Array, "entries"]) -> Scalar:
    """Return the sum over materials of what arrives at segments, times its cotangents."""
    total = jnp.zeros_like(light.pieces[0])
    for row, energy in light.arrived:
        total = total + energy * cotangent[row]
    return total
