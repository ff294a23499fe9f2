r"""First order: every ray of the footprint is marched through the scene, and its expected return deposited.

Given the rays, nothing is random (`jaxlidar.trace.response` may shift the rays at random). With extinction
coefficients k_m of the materials m, their sum k, and the optical depth tau from the sensor, the return from a
segment of the ray, per unit of its energy, is

    V_m * integral of k_m exp(-kappa tau(s)) ds,    kappa = 2, or 1 with the hot spot,

integrated exactly over every piece of the ray that lies within one voxel and one time bin. V_m is the
intensity factor for backscatter: 2/3 of spherically oriented facets, <cos^2> / G of others, pi p(w -> -w) of
a phase function p (`jaxlidar.optics.facets`, `jaxlidar.optics.phase`). A surface at the distance d returns
V exp(-kappa tau(d)) at one instant. Plates in the path multiply by their transmittance once on the way in and
once on the way out.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._mesh_axes import vary_with
from jaxlidar._one_function import once
from jaxlidar._vectors import FAR, Scalar, Vec, along, scale
from jaxlidar.optics.facets import FACET_BACKSCATTER
from jaxlidar.optics.laws import AbstractMirror
from jaxlidar.planning.config import TraceConfig
from jaxlidar.trace.deposit import add_rows, bspline_row, smooth_bins
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.extinction_slopes import outer_rows
from jaxlidar.trace.histories import Histories
from jaxlidar.trace.meshes import surface_distances
from jaxlidar.trace.ray_segments import (
    RaySegments,
    add_in_blocks,
    integrate_over_bins,
    march_ray,
    mean_decay,
)
from jaxlidar.trace.reparametrisation import rays_with_grids
from jaxlidar.trace.score_functions import add_parameter_rows, segment_derivatives, with_depth_slopes
from jaxlidar.trace.surfaces import TracedSurface
from jaxlidar.trace.voxel_traversal import Medium

# Rays that are marched at once, so that their segments stay in the processor's cache.
RAYS_AT_ONCE = 512


class PlateTransmission:
    """Transmission of first-order light by the plates in its path, as exponents and their weights.

    A plate that covers everything multiplies by T each time; one with the coverage c by (1 - c) + c T. For
    the `passages` = 1 (in) or 2 (in and out) that is expanded, so that each term is a monomial in T:

        ((1 - c) + c T)^2 = (1 - c)^2 + 2 c (1 - c) T + c^2 T^2.
    """

    def __init__(self, surfaces: tuple[TracedSurface, ...], config: TraceConfig, passages: int):
        self.plates = [(i, s, config.surfaces[i].transmission) for i, s in enumerate(surfaces) if s.is_plate]
        terms_by_plate = []
        for i, surface, channel in self.plates:
            c = surface.coverage
            # A plate without a channel for transmittance is opaque.
            straight = surface.straight and channel >= 0
            if config.covers_fully[i]:
                terms = [(passages, jnp.ones_like(c) if straight else jnp.zeros_like(c))]
            elif straight:
                weights = {1: [1 - c, c], 2: [(1 - c) ** 2, 2 * c * (1 - c), c**2]}[passages]
                terms = list(enumerate(weights))
            else:
                terms = [(0, (1 - c) ** passages)]
            # Where the plate is not in the path, the first term alone counts, with the weight one.
            terms_by_plate.append([(*term, float(n == 0)) for n, term in enumerate(terms)])
        self.combinations = list(itertools.product(*terms_by_plate))

    def terms(
        self, histories: Histories, history: int, distance: Scalar, surface_distances: list[Scalar]
    ) -> Iterator[tuple[Int[Array, "..."] | int, Scalar]]:
        """Yield pairs of history and weight of light that scatters at `distance` into `history`.

        The history is an array, or an integer where there are no plates.
        """
        if not self.plates:
            yield history, jnp.ones_like(distance)
            return
        next_history = jnp.asarray(histories.next_history)
        for combination in self.combinations:
            path_history = jnp.full(distance.shape, history, jnp.int32)
            weight = jnp.ones_like(distance)
            for (i, _, channel), (exponent, value, if_absent) in zip(self.plates, combination):
                # A plate behind the point of return shades nothing.
                in_path = surface_distances[i] < distance
                after = path_history
                for _ in range(exponent if channel >= 0 else 0):
                    after = next_history[after, channel]
                path_history = jnp.where(in_path, after, path_history)
                weight = weight * jnp.where(in_path, value, if_absent)
            yield path_history, weight


class FirstOrder(eqx.Module):
    """The deterministic first-order response, and the energy budget of the light that it describes.

    - `weights`, `outside`: apparent reflectance per unit optics, within the bins and outside of them.
    - `arrived`, `escaped`: energy that reached each material, and that left the scene unscattered.
    - `scattered`: `arrived` times the albedo of the law, energy that is scattered per unit optics.
    - `weight_slopes`: derivatives of the weights with respect to parameters; None without score functions.
    """

    weights: Float[Array, "materials histories bins"]
    outside: Float[Array, "materials histories"]
    arrived: Float[Array, "materials histories"]
    scattered: Float[Array, "materials histories"]
    escaped: Float[Array, "histories"]
    weight_slopes: Float[Array, "materials histories bins parameters"] | None = None


class FootprintRays(NamedTuple):
    """Rays of the footprint: where they start above the scene, their directions, and the surfaces they meet.

    - `x`, `w`: start and direction. - `excess`: path from the sensor to the start, m, less the slant range.
    - `energy`: fraction of the pulse's. - `surface_distances`: to each surface, m; `end`: to the ground or a
      mesh. - `mesh_normal`: of the triangle that is met; None without meshes.
    """

    x: Vec
    w: Vec
    excess: Scalar
    energy: Scalar
    surface_distances: list[Scalar]
    end: Scalar
    mesh_normal: Vec | None


def move_rays(
    scene: DeviceScene, across: tuple[Scalar, Scalar], energy: Scalar
) -> tuple[tuple[Scalar, Scalar], Scalar]:
    """Move all rays of a footprint with the geometry. This changes derivatives alone.

    All rays together carry the same energy wherever they are. Stated, and not left to the mean of many rays,
    this takes the noise out of derivatives with respect to the beam's width.
    """
    across, ratio = rays_with_grids(scene, across)
    mean_ratio = jnp.sum(energy * ratio) / jnp.sum(energy)
    return across, energy * (ratio / mean_ratio)


def send_rays(scene: DeviceScene, across: tuple[Scalar, Scalar], energy: Scalar) -> FootprintRays:
    """Send rays through the points `across` the beam, which carry the fractions `energy`."""
    beam, config = scene.beam, scene.config
    point, w, excess = beam.ray(across)
    start_distance = scene.limits.start_distance
    x = along(point, w, jnp.asarray(-start_distance, energy.dtype))
    distances, mesh_normal = surface_distances(scene, x, w)
    end = distances[0] if config.has_ground else jnp.full_like(energy, FAR)
    for surface, distance in zip(scene.surfaces, distances):
        # Nothing behind a triangle is lit by the ray.
        end = jnp.minimum(end, distance) if surface.is_mesh else end
    return FootprintRays(x, w, excess - start_distance, energy, distances, end, mesh_normal)


def march_rays(scene: DeviceScene, rays: FootprintRays) -> tuple[RaySegments, list[Scalar], Scalar]:
    """Cut all rays into segments up to the ground; as `march_ray`, with the surfaces as stops.

    Segments lie along the first axis, where the march leaves them: transposing costs as much as marching.
    """
    medium = scene.medium
    assert medium is not None
    max_segment = jnp.asarray(scene.limits.max_segment, rays.energy.dtype)
    march = jax.vmap(march_ray, (None, 0, 0, 0, 0, None, None), (1, 0, 0))
    max_segments = scene.config.max_ray_segments
    return march(medium, rays.x, rays.w, rays.end, rays.surface_distances, max_segments, max_segment)


class _FirstOrderTally(NamedTuple):
    """Sums over rays while they are deposited, in rows (axis `entries`): materials times histories.

    `returned`: by row and padded bin. `arrived`: by row. `slopes`: derivatives of `returned`, or None.
    """

    returned: Float[Array, "entries padded"]
    arrived: Float[Array, "entries"]
    slopes: Float[Array, "entries padded parameters"] | None


def first_order(
    scene: DeviceScene,
    across: tuple[Float[Array, "rays"], Float[Array, "rays"]],
    energy: Float[Array, "rays"],
    *,
    mirror: int | None = None,
) -> FirstOrder:
    """Compute the response of order one.

    `across` and `energy` give the position of each ray across the beam and its fraction of energy. With
    `mirror`, the rays carry what that surface returns of them (see `jaxlidar.trace.mirror_return`), and
    nothing else is deposited.

    For each chunk of rays:

    1. Send the rays, and march them through the voxels into segments.
    2. Deposit the return of every segment and material, bin by bin, and the energy that arrives there.
    3. Smooth the sum over bins: smoothing is linear, so that only the sum is smoothed.
    4. Deposit the return of every surface at an instant, and the energy that arrives there.
    5. What is left of rays that meet no ground escapes.
    """
    beam, medium, surfaces = scene.beam, scene.medium, scene.surfaces
    config, histories, bins = scene.config, scene.first_histories, scene.bins
    n_histories, leaf_material = histories.count, -1 if config.leaf is None else config.leaf.material
    one_passage = PlateTransmission(surfaces, config, 1)
    two_passages = PlateTransmission(surfaces, config, 2)
    kappa = 1.0 if config.hotspot else 2.0
    next_history = histories.next_history
    n_materials, slopes = len(config.materials), scene.slopes

    # Materials are deposited one after the other, so that each has its own histories and intensity factor.
    def add_segments(tally, segments, per_ray):
        """Add segments to a `_FirstOrderTally`; `per_ray`: the ray of each, and its seen energy.

        1. Integrate exp(-kappa tau) ds over each segment, bin by bin.
        2. For each material, and each term of the plates in the path: add V_m k_m times these integrals.
        3. With score functions, add their derivatives.
        4. Add the energy that arrives, k_m times the integral of exp(-tau) ds.
        """
        assert medium is not None
        (returned, arrived, return_slopes), (rays, seen_energy) = tally, per_ray
        k, w, distances = segments.extinction, rays.w, rays.surface_distances
        start_position = bins.position(2.0 * (rays.excess + segments.start) / SPEED_OF_LIGHT)
        first_bin, pieces = integrate_over_bins(bins, start_position, segments, kappa)
        # Integral of exp(-tau) ds over the segment: what arrives is attenuated once.
        attenuated_length = jnp.exp(-segments.depth) * mean_decay(k * segments.length) * segments.length
        middle = segments.start + 0.5 * segments.length
        materials = _medium_materials(medium, config, segments, w)
        for m, material in materials if mirror is None else ():
            value = material.extinction * (material.intensity_factor * seen_energy)
            scattered_history = int(next_history[0, material.channel])
            for history, factor in two_passages.terms(histories, scattered_history, middle, distances):
                tally_row = jnp.broadcast_to(m * n_histories + history, first_bin.shape)
                # Optimisation barriers: fused, the factor would be computed again for each piece, out of
                # order.
                row = once(pieces * once(value * factor)[None])
                row = jnp.moveaxis(row, 0, -1)
                returned = add_rows(returned, tally_row, first_bin, row)
                if slopes is not None:
                    assert return_slopes is not None
                    rows = segment_derivatives(
                        scene,
                        m == leaf_material,
                        w,
                        start_position,
                        segments,
                        kappa,
                        material.extinction,
                        material.intensity_factor * seen_energy * factor,
                    )
                    return_slopes = add_parameter_rows(return_slopes, tally_row, first_bin, rows)
            for history, factor in one_passage.terms(histories, 0, middle, distances):
                weight = material.extinction * attenuated_length * factor * rays.energy
                arrived = _add(arrived, m * n_histories + history, weight)
        return _FirstOrderTally(returned, arrived, return_slopes)

    def trace_chunk(across, energy):
        """Trace a chunk of rays by the five steps of `first_order`."""
        # Step 1.
        rays = send_rays(scene, across, energy)
        x, w, excess, energy, distances, end, mesh_normal = rays
        # What the receiver sees of a ray, at the ground or at the reference plane: beams are narrow in angle.
        seen_energy = energy * beam.in_view(along(x, w, jnp.minimum(end, scene.limits.start_distance)))
        returned = jnp.zeros((n_materials * n_histories, bins.padded), energy.dtype)
        arrived = jnp.zeros((n_materials * n_histories,), energy.dtype)
        scattered, escaped = arrived, jnp.zeros((n_histories,), energy.dtype)
        depth_at_surfaces, total_depth = [jnp.zeros_like(energy) for _ in distances], jnp.zeros_like(energy)
        return_slopes, slopes_at_surfaces = None, []
        if slopes is not None:
            return_slopes = jnp.zeros((n_materials * n_histories, bins.padded, slopes.count), energy.dtype)
        returned, arrived, scattered, escaped, return_slopes = vary_with(
            (returned, arrived, scattered, escaped, return_slopes), scene
        )

        if medium is not None:
            segments, depth_at_surfaces, total_depth = march_rays(scene, rays)
            if slopes is not None:
                segments, slopes_at_surfaces = with_depth_slopes(scene, segments, w, distances)

            # Step 2.
            tally, per_ray = _FirstOrderTally(returned, arrived, return_slopes), (rays, seen_energy)
            if scene.reverse:

                def step(tally, segments):
                    return add_segments(tally, segments, per_ray), None

                # Blocks are a loop of unknown length, which has no reverse derivative.
                returned, arrived, return_slopes = lax.scan(step, tally, segments)[0]
            else:
                # Segments of zero extinction return nothing, but have derivatives.
                contributes = segments.extinction > 0.0 if scene.derivatives == "none" else None
                returned, arrived, return_slopes = add_in_blocks(
                    add_segments, tally, segments, per_ray, contributes
                )
            # Step 3. All energy that collides in the medium is scattered.
            returned, scattered = _smooth_padded(returned), arrived
            if return_slopes is not None:
                smooth = smooth_bins(jnp.swapaxes(return_slopes, 1, 2))[..., 1:-1]
                return_slopes = jnp.swapaxes(smooth, 1, 2)

        # Step 4.
        for i, (surface, scatterer) in enumerate(zip(surfaces, config.surfaces)):
            if mirror is not None and i != mirror:
                continue
            is_met = distances[i] < FAR
            hit_energy = jnp.where((distances[i] <= end) & is_met, surface.coverage * energy, 0.0)
            point = along(x, w, jnp.where(is_met, distances[i], 0.0))
            normal, back = surface.lit_normal(point, w, mesh_normal), scale(w, jnp.asarray(-1.0))
            for history, factor in one_passage.terms(histories, 0, distances[i], distances):
                weight = hit_energy * jnp.exp(-depth_at_surfaces[i]) * factor
                tally_row = scatterer.material * n_histories + history
                arrived = _add(arrived, tally_row, weight)
                # What a law does not reflect per unit reflectance is absorbed, not scattered.
                albedo = surface.scale_by_pattern(point, surface.law.albedo(w, normal))
                scattered = _add(scattered, tally_row, weight * albedo)
            if mirror is None and isinstance(surface.law, AbstractMirror):
                continue
            # A plate may lie far above the ground, where the field of view is narrower: it is taken at the
            # point itself.
            seen = surface.scale_by_pattern(point, beam.in_view(point))
            if mirror is None:
                seen = surface.law.intensity_factor(w, normal, back, beam.aperture_half_angle(point)) * seen
            # FAR would overflow when it is converted to bins.
            time = 2.0 * (excess + jnp.minimum(distances[i], 1e9)) / SPEED_OF_LIGHT
            first_bin, row = bspline_row(
                bins, time, hit_energy * seen * jnp.exp(-kappa * depth_at_surfaces[i])
            )
            reflected_history = int(next_history[0, scatterer.reflection])
            terms = two_passages.terms(histories, reflected_history, distances[i], distances)
            for history, factor in terms:
                tally_row = jnp.broadcast_to(scatterer.material * n_histories + history, first_bin.shape)
                returned = add_rows(returned, tally_row, first_bin, row * factor[:, None])
                if return_slopes is not None:
                    values = lax.stop_gradient(row * factor[:, None])
                    rows = outer_rows(values, -kappa * slopes_at_surfaces[i])
                    return_slopes = add_parameter_rows(return_slopes, tally_row, first_bin, rows)

        # Step 5. Rays that meet the ground end there; only those that fly past it escape.
        unscattered = jnp.where(end < FAR, 0.0, energy * jnp.exp(-total_depth))
        for history, factor in one_passage.terms(histories, 0, end, distances):
            escaped = _add(escaped, history, unscattered * factor)
        shape = (n_materials, n_histories)
        if return_slopes is not None:
            return_slopes = return_slopes[:, bins.max_span : bins.max_span + bins.count]
            return_slopes = return_slopes.reshape(*shape, bins.count, -1)
        return returned, (arrived.reshape(shape), scattered.reshape(shape), escaped), return_slopes

    across, energy = move_rays(scene, across, energy)
    n_rays = energy.shape[0]
    fill = -n_rays % RAYS_AT_ONCE
    padded = [jnp.pad(a, (0, fill)).reshape(-1, RAYS_AT_ONCE) for a in (*across, energy)]

    def chunk(x, y, e):
        return trace_chunk((x, y), e)

    if n_rays <= RAYS_AT_ONCE:
        returned, budget, weight_slopes = trace_chunk(across, energy)
    elif medium is None and scene.meshes is None:
        # Without a march all chunks fit into the memory at once, and no loop is compiled.
        chunks = jax.vmap(chunk)(*padded)
        returned, budget, weight_slopes = jax.tree.map(lambda a: jnp.sum(a, axis=0), chunks)
    else:
        # The loop needs zeros of the result's shape; evaluating shapes compiles nothing.
        shapes = jax.eval_shape(trace_chunk, across, energy)
        zero = vary_with(jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes), scene)

        def add(total, rays):
            return jax.tree.map(jnp.add, total, chunk(*rays)), None

        returned, budget, weight_slopes = lax.scan(add, zero, padded)[0]
    weights, outside = bins.trim(returned.reshape(n_materials, n_histories, bins.padded))
    arrived, scattered, escaped = budget
    return FirstOrder(weights, outside, arrived, scattered, escaped, weight_slopes)


def _smooth_padded(returned: Float[Array, "entries padded"]) -> Float[Array, "entries padded"]:
    """Smooth bins with their margins; what would leave these at either end stays in the outermost bin."""
    smooth = smooth_bins(returned)
    return smooth[:, 1:-1].at[:, 0].add(smooth[:, 0]).at[:, -1].add(smooth[:, -1])


def _add(
    tally: Float[Array, "entries"], tally_row: Int[Array, "*s"] | int, weight: Float[Array, "*s"]
) -> Float[Array, "entries"]:
    """Add weights to rows of a tally; as one sum where all rays have the same row."""
    weight = jnp.sum(weight) if isinstance(tally_row, int) else weight
    return tally.at[tally_row].add(weight)


class MediumMaterial(eqx.Module):
    """A material along rays: extinction, 1/m, intensity factor for backscatter, and channel."""

    extinction: Float[Array, "..."]
    intensity_factor: Float[Array, "..."] | float
    channel: int = eqx.field(static=True)


def _medium_materials(
    medium: Medium, config: TraceConfig, segments: RaySegments, w: Vec
) -> Iterator[tuple[int, MediumMaterial]]:
    """Yield the number of each material of the medium, and its properties along segments."""
    back = scale(w, jnp.asarray(-1.0))
    if medium.leaf is not None and config.leaf is not None:
        # Without the other material, the segment's extinction is this material's: no second look-up.
        k = segments.extinction if medium.bark is None else medium.leaf_extinction(segments.cell, w)
        factor = FACET_BACKSCATTER
        if medium.leaf_phase is not None:
            factor = medium.leaf_phase.intensity_factor(w, back)
        elif medium.angle_tables is not None:
            # Mean of |n.w| |n.back| over facets that are hit, with density g(n) |n.w| / G.
            factor = medium.angle_tables.squared_cosine_at(w) / medium.angle_tables.projection_at(w)
        yield config.leaf.material, MediumMaterial(k, factor, config.leaf.reflection)
    if medium.bark is not None and config.bark is not None:
        k = segments.extinction if medium.leaf is None else medium.bark_extinction(segments.cell)
        factor = FACET_BACKSCATTER
        if medium.bark_phase is not None:
            factor = medium.bark_phase.intensity_factor(w, back)
        yield config.bark.material, MediumMaterial(k, factor, config.bark.reflection)
