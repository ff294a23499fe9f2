r"""First order: every ray of the footprint is marched through the scene, and its expected return deposited.

Given the rays, nothing is random (`trace.response` may shift the rays at random). With extinction
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
from collections.abc import Callable, Iterator
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._jax.mesh_axes import vary_with
from jaxlidar._jax.one_function import barrier
from jaxlidar._vectors import FAR, Scalar, Vec, add, along, scale
from jaxlidar.optics.facets import FACET_BACKSCATTER
from jaxlidar.optics.laws import AbstractMirror
from jaxlidar.planning.config import TraceConfig
from jaxlidar.trace.deposit import add_rows, bspline_row, smooth_bins
from jaxlidar.trace.derivatives.extinction_slopes import outer_rows
from jaxlidar.trace.derivatives.reparametrisation import rays_with_grids
from jaxlidar.trace.derivatives.score_functions import (
    add_parameter_rows,
    segment_derivatives,
    with_depth_slopes,
)
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.march.meshes import surface_distances
from jaxlidar.trace.march.ray_segments import (
    RaySegments,
    add_in_blocks,
    integrate_over_bins,
    march_ray,
    mean_decay,
)
from jaxlidar.trace.march.surfaces import TracedSurface
from jaxlidar.trace.march.voxel_traversal import Medium
from jaxlidar.trace.photons.histories import Histories

Tally = TypeVar("Tally")

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
    - `group`: number of the group in whose sums the ray counts; None: there is one.
    - `aim`: the point at which its beam is aimed; None: the origin.
    """

    x: Vec
    w: Vec
    excess: Scalar
    energy: Scalar
    surface_distances: list[Scalar]
    end: Scalar
    mesh_normal: Vec | None
    group: Int[Array, "..."] | None = None
    aim: Vec | None = None

    def from_aim(self, point: Vec) -> Vec:
        """Return the vector from the aim point to a point of each ray, as beams take it."""
        return point if self.aim is None else add(point, scale(self.aim, jnp.asarray(-1.0)))


def move_rays(
    scene: DeviceScene, across: tuple[Scalar, Scalar], energy: Scalar
) -> tuple[tuple[Scalar, Scalar], Scalar]:
    """Move all rays of a footprint with the geometry. This changes derivatives alone.

    All rays together carry the same energy wherever they are. Stated, and not left to the mean of many rays,
    this takes the noise out of derivatives with respect to the beam's width.
    """
    across, ratio = rays_with_grids(scene, across)
    total = jnp.sum(energy)
    # A mirror that is tilted away returns nothing of any ray.
    mean_ratio = jnp.where(total > 0.0, jnp.sum(energy * ratio) / jnp.where(total > 0.0, total, 1.0), 1.0)
    return across, energy * (ratio / mean_ratio)


def send_rays(
    scene: DeviceScene,
    across: tuple[Scalar, Scalar],
    energy: Scalar,
    *,
    group: Int[Array, "..."] | None = None,
    aim: Vec | None = None,
) -> FootprintRays:
    """Send rays through the points `across` the beam, which carry the fractions `energy`.

    `group`, `aim`: see `FootprintRays`; default None.
    """
    beam, config = scene.beam, scene.config
    point, w, excess = beam.ray(across)
    point = point if aim is None else add(point, aim)
    start_distance = scene.limits.start_distance
    x = along(point, w, jnp.asarray(-start_distance, energy.dtype))
    distances, mesh_normal = surface_distances(scene, x, w)
    end = distances[0] if config.has_ground else jnp.full_like(energy, FAR)
    for surface, distance in zip(scene.surfaces, distances):
        # Nothing behind a triangle is lit by the ray.
        end = jnp.minimum(end, distance) if surface.is_mesh else end
    return FootprintRays(x, w, excess - start_distance, energy, distances, end, mesh_normal, group, aim)


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


class FirstOrderTally(NamedTuple):
    """Sums over rays while they are deposited, in rows (axis `entries`): see `FirstOrderTracer.row`.

    `returned`: by row and padded bin. `arrived`, `scattered`: by row. `escaped`: by history, or by group.
    `slopes`: derivatives of `returned`, or None.
    """

    returned: Float[Array, "entries padded"]
    arrived: Float[Array, "entries"]
    scattered: Float[Array, "entries"]
    escaped: Float[Array, "escapes"]
    slopes: Float[Array, "entries padded parameters"] | None

    @property
    def of_medium(self) -> tuple[Array, Array, Array | None]:
        """The sums to which the segments of the medium add."""
        return self.returned, self.arrived, self.slopes


class MaterialReturn(NamedTuple):
    """What a material returns of segments: its extinction, 1/m, times a factor, times the pieces of these.

    `row`: of the tally.
    """

    row: Int[Array, "..."] | int
    extinction: Float[Array, "..."]
    factor: Float[Array, "..."]
    is_leaf: bool


class SegmentReturns(NamedTuple):
    """What segments return by bin and material, and what arrives there.

    - `start_position`: of the start of each segment on the axis of bins.
    - `first_bin`, `pieces`: as `integrate_over_bins` returns them.
    - `returned`: one for each material, and each term of the plates in the path.
    - `arrived`: pairs of the tally row and the energy that arrives.
    """

    start_position: Float[Array, "..."]
    first_bin: Int[Array, "..."]
    pieces: Float[Array, "pieces ..."]
    returned: list[MaterialReturn]
    arrived: list[tuple[Int[Array, "..."] | int, Scalar]]


class FirstOrderTracer:
    """Deposits the returns of chunks of rays, and the energy that arrives, in parts that reverse mode shares.

    With `mirror`, the rays carry what that surface returns of them (see `trace.first.mirror_return`), and
    nothing else is deposited.

    Rays of `n_groups` groups, numbered by `FootprintRays.group`, have rows of their own. These have no
    histories: without plates, all that a material returns has one, and what arrives has none.
    """

    def __init__(self, scene: DeviceScene, mirror: int | None = None, n_groups: int | None = None):
        self.scene, self.mirror, self.n_groups = scene, mirror, n_groups
        self.one_passage = PlateTransmission(scene.surfaces, scene.config, 1)
        self.two_passages = PlateTransmission(scene.surfaces, scene.config, 2)
        self.kappa = 1.0 if scene.config.hotspot else 2.0

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of materials and of histories, whose product is that of the rows of a tally."""
        return len(self.scene.config.materials), self.scene.first_histories.count

    @property
    def n_medium_materials(self) -> int:
        """Number of materials of the medium, leaf and bark, which are the first ones."""
        return sum(scatterer is not None for scatterer in (self.scene.config.leaf, self.scene.config.bark))

    def trace_chunk(self, across: tuple[Scalar, Scalar], energy: Scalar) -> FirstOrder:
        """Trace a chunk of rays, and sum what they return."""
        scene = self.scene
        tally = self.trace_rays(send_rays(scene, across, energy))
        if tally.slopes is not None:
            bins = scene.bins
            inside = tally.slopes[:, bins.max_span : bins.max_span + bins.count]
            tally = tally._replace(slopes=inside.reshape(*self.shape, *inside.shape[1:]))
        weights, outside = scene.bins.trim(tally.returned.reshape(*self.shape, scene.bins.padded))
        arrived, scattered = tally.arrived.reshape(self.shape), tally.scattered.reshape(self.shape)
        return FirstOrder(weights, outside, arrived, scattered, tally.escaped, tally.slopes)

    def trace_rays(self, rays: FootprintRays) -> FirstOrderTally:
        """Trace rays that have been sent, by the steps of `first_order`."""
        return self.smooth(self.add_rays(self.empty_tally(rays.energy), rays))

    def add_rays(self, tally: FirstOrderTally, rays: FootprintRays) -> FirstOrderTally:
        """Add rays that have been sent to a tally, whose returns are not smoothed."""
        scene, slopes, energy = self.scene, self.scene.slopes, rays.energy
        # Step 1.
        depth_at_surfaces = [jnp.zeros_like(energy) for _ in rays.surface_distances]
        total_depth, slopes_at_surfaces = jnp.zeros_like(energy), []
        if scene.medium is not None:
            segments, depth_at_surfaces, total_depth = march_rays(scene, rays)
            if slopes is not None:
                segments, slopes_at_surfaces = with_depth_slopes(
                    scene, segments, rays.w, rays.surface_distances
                )

            # Step 2.
            per_ray = (rays, self.seen_energy(rays))
            if scene.reverse:

                def step(tally, segments):
                    return self.deposit_segments(tally, segments, per_ray), None

                # Blocks are a loop of unknown length, which has no reverse derivative.
                tally = lax.scan(step, tally, segments)[0]
            else:
                # Segments of zero extinction return nothing, but have derivatives.
                contributes = segments.extinction > 0.0 if scene.derivatives == "none" else None
                tally = add_in_blocks(self.deposit_segments, tally, segments, per_ray, contributes)
        # Steps 3 and 4.
        tally = self.deposit_surfaces(tally, rays, depth_at_surfaces, slopes_at_surfaces)
        return self.add_escape(tally, rays, total_depth)

    def smooth(self, tally: FirstOrderTally) -> FirstOrderTally:
        """Smooth what the medium returns, step 5, once for all rays; surfaces return light at an instant."""
        n_rows = self.n_medium_materials * tally.escaped.shape[0]
        if n_rows == 0:
            return tally
        returned, slopes = tally.returned, tally.slopes
        returned = returned.at[:n_rows].set(smooth_padded(returned[:n_rows]))
        if slopes is not None:
            smooth = smooth_bins(jnp.swapaxes(slopes[:n_rows], 1, 2))[..., 1:-1]
            slopes = slopes.at[:n_rows].set(jnp.swapaxes(smooth, 1, 2))
        # All energy that collides in the medium is scattered.
        scattered = tally.scattered.at[:n_rows].set(tally.arrived[:n_rows])
        return tally._replace(returned=returned, scattered=scattered, slopes=slopes)

    def empty_tally(self, energy: Scalar) -> FirstOrderTally:
        """Return a tally of zeros for rays with these fractions of the energy."""
        scene, (n_materials, n_histories) = self.scene, self.shape
        # Rows of a material, and of what escapes.
        n_columns = n_histories if self.n_groups is None else self.n_groups
        n_rows, n_escaped = n_materials * n_columns, n_columns
        padded = scene.bins.padded
        return_slopes = None
        if scene.slopes is not None:
            return_slopes = jnp.zeros((n_rows, padded, scene.slopes.count), energy.dtype)
        tally = FirstOrderTally(
            returned=jnp.zeros((n_rows, padded), energy.dtype),
            arrived=jnp.zeros((n_rows,), energy.dtype),
            scattered=jnp.zeros((n_rows,), energy.dtype),
            escaped=jnp.zeros((n_escaped,), energy.dtype),
            slopes=return_slopes,
        )
        return vary_with(tally, scene)

    def row(
        self, material: int, history: Int[Array, "..."] | int, rays: FootprintRays
    ) -> Int[Array, "..."] | int:
        """Return the row of a material and a history in a tally; an integer where it is that of all rays."""
        if self.n_groups is None:
            return material * self.shape[1] + history
        assert rays.group is not None
        return material * self.n_groups + rays.group

    def seen_energy(self, rays: FootprintRays) -> Scalar:
        """Return what the receiver sees of rays, at the ground or at the reference plane."""
        # One fraction for all of a ray: beams are narrow in angle.
        end = jnp.minimum(rays.end, self.scene.limits.start_distance)
        return rays.energy * self.scene.beam.in_view(rays.from_aim(along(rays.x, rays.w, end)))

    def deposit_segments(
        self, tally: FirstOrderTally, segments: RaySegments, per_ray: tuple[FootprintRays, Scalar]
    ) -> FirstOrderTally:
        """Add segments to a tally; with score functions, their derivatives, too.

        `per_ray`: the ray of each, and its seen energy.
        """
        scene, (rays, seen_energy) = self.scene, per_ray
        light = self.returns_of_segments(segments, rays, seen_energy)
        returned, arrived, return_slopes = tally.of_medium
        for of_material in light.returned:
            # Optimisation barriers: fused, the factor would be computed again for each piece, out of order.
            row = barrier(light.pieces * barrier(of_material.extinction * of_material.factor)[None])
            row = jnp.moveaxis(row, 0, -1)
            tally_row = jnp.broadcast_to(of_material.row, light.first_bin.shape)
            returned = add_rows(returned, tally_row, light.first_bin, row)
            if scene.slopes is not None:
                assert return_slopes is not None
                rows = segment_derivatives(
                    scene,
                    of_material.is_leaf,
                    rays.w,
                    light.start_position,
                    segments,
                    self.kappa,
                    of_material.extinction,
                    of_material.factor,
                )
                return_slopes = add_parameter_rows(return_slopes, tally_row, light.first_bin, rows)
        for tally_row, weight in light.arrived:
            arrived = _add(arrived, tally_row, weight)
        return tally._replace(returned=returned, arrived=arrived, slopes=return_slopes)

    # Each material has its own histories and intensity factor.
    def returns_of_segments(
        self,
        segments: RaySegments,
        rays: FootprintRays,
        seen_energy: Scalar,
        extinctions: tuple[Scalar | None, Scalar | None] | None = None,
    ) -> SegmentReturns:
        """Compute what segments return, and what arrives there.

        `extinctions`: those of leaf and of bark, 1/m; None looks them up.

        1. Integrate exp(-kappa tau) ds over each segment, bin by bin.
        2. For each material, and each term of the plates in the path: the factor V_m of these integrals,
           beside k_m.
        3. The energy that arrives, k_m times the integral of exp(-tau) ds.
        """
        scene, bins, config, kappa = self.scene, self.scene.bins, self.scene.config, self.kappa
        histories, w, distances = scene.first_histories, rays.w, rays.surface_distances
        leaf_material = -1 if config.leaf is None else config.leaf.material
        assert scene.medium is not None
        start_position = bins.position(2.0 * (rays.excess + segments.start) / SPEED_OF_LIGHT)
        first_bin, pieces = integrate_over_bins(bins, start_position, segments, kappa)
        # Integral of exp(-tau) ds over the segment: what arrives is attenuated once.
        decay = mean_decay(segments.extinction * segments.length)
        attenuated_length = jnp.exp(-segments.depth) * decay * segments.length
        middle = segments.start + 0.5 * segments.length
        if extinctions is None:
            extinctions = material_extinctions(scene.medium, segments, w)
        returned: list[MaterialReturn] = []
        arrived: list[tuple[Int[Array, ...] | int, Scalar]] = []
        # Rays that carry what a mirror returns deposit nothing else.
        is_direct = self.mirror is None
        materials = _medium_materials(scene.medium, config, extinctions, w) if is_direct else ()
        for m, material in materials:
            k, seen = material.extinction, material.intensity_factor * seen_energy
            scattered_history = int(histories.next_history[0, material.channel])
            for history, factor in self.two_passages.terms(histories, scattered_history, middle, distances):
                row = self.row(m, history, rays)
                returned.append(MaterialReturn(row, k, seen * factor, m == leaf_material))
            for history, factor in self.one_passage.terms(histories, 0, middle, distances):
                arrived.append((self.row(m, history, rays), k * attenuated_length * factor * rays.energy))
        return SegmentReturns(start_position, first_bin, pieces, returned, arrived)

    def deposit_surfaces(
        self,
        tally: FirstOrderTally,
        rays: FootprintRays,
        depth_at_surfaces: list[Scalar],
        slopes_at_surfaces: list[Float[Array, "rays parameters"]],
    ) -> FirstOrderTally:
        """Deposit the return of every surface at an instant, and the energy that arrives there.

        `slopes_at_surfaces`: derivatives of the depths with respect to parameters; empty without score
        functions.
        """
        scene, bins, config, mirror = self.scene, self.scene.bins, self.scene.config, self.mirror
        histories = scene.first_histories
        x, w, excess, energy, distances, end, mesh_normal, *_ = rays
        returned, arrived, scattered, _, return_slopes = tally
        for i, (surface, scatterer) in enumerate(zip(scene.surfaces, config.surfaces)):
            if mirror is not None and i != mirror:
                continue
            is_met = distances[i] < FAR
            hit_energy = jnp.where((distances[i] <= end) & is_met, surface.coverage * energy, 0.0)
            point = along(x, w, jnp.where(is_met, distances[i], 0.0))
            normal, back = surface.lit_normal(point, w, mesh_normal), scale(w, jnp.asarray(-1.0))
            for history, factor in self.one_passage.terms(histories, 0, distances[i], distances):
                weight = hit_energy * jnp.exp(-depth_at_surfaces[i]) * factor
                tally_row = self.row(scatterer.material, history, rays)
                arrived = _add(arrived, tally_row, weight)
                # What a law does not reflect per unit reflectance is absorbed, not scattered.
                albedo = surface.scale_by_pattern(point, surface.law.albedo(w, normal))
                scattered = _add(scattered, tally_row, weight * albedo)
            if mirror is None and isinstance(surface.law, AbstractMirror):
                continue
            # A plate may lie far above the ground, where the field of view is narrower: it is taken at the
            # point itself.
            from_aim = rays.from_aim(point)
            seen = surface.scale_by_pattern(point, scene.beam.in_view(from_aim))
            if mirror is None:
                half_angle = scene.beam.aperture_half_angle(from_aim)
                seen = surface.law.intensity_factor(w, normal, back, half_angle) * seen
            # FAR would overflow when it is converted to bins.
            time = 2.0 * (excess + jnp.minimum(distances[i], 1e9)) / SPEED_OF_LIGHT
            first_bin, row = bspline_row(
                bins, time, hit_energy * seen * jnp.exp(-self.kappa * depth_at_surfaces[i])
            )
            reflected_history = int(histories.next_history[0, scatterer.reflection])
            terms = self.two_passages.terms(histories, reflected_history, distances[i], distances)
            for history, factor in terms:
                tally_row = jnp.broadcast_to(self.row(scatterer.material, history, rays), first_bin.shape)
                returned = add_rows(returned, tally_row, first_bin, row * factor[:, None])
                if return_slopes is not None:
                    values = lax.stop_gradient(row * factor[:, None])
                    rows = outer_rows(values, -self.kappa * slopes_at_surfaces[i])
                    return_slopes = add_parameter_rows(return_slopes, tally_row, first_bin, rows)
        return tally._replace(returned=returned, arrived=arrived, scattered=scattered, slopes=return_slopes)

    def add_escape(self, tally: FirstOrderTally, rays: FootprintRays, total_depth: Scalar) -> FirstOrderTally:
        """Add what is left of rays that meet no ground."""
        escaped = tally.escaped
        # Rays that meet the ground end there; only those that fly past it escape.
        unscattered = jnp.where(rays.end < FAR, 0.0, rays.energy * jnp.exp(-total_depth))
        terms = self.one_passage.terms(self.scene.first_histories, 0, rays.end, rays.surface_distances)
        for history, factor in terms:
            escaped = _add(escaped, history if rays.group is None else rays.group, unscattered * factor)
        return tally._replace(escaped=escaped)


def first_order(
    scene: DeviceScene,
    across: tuple[Float[Array, "rays"], Float[Array, "rays"]],
    energy: Float[Array, "rays"],
    *,
    mirror: int | None = None,
) -> FirstOrder:
    """Compute the response of order one.

    `across` and `energy` give the position of each ray across the beam and its fraction of energy. With
    `mirror`, the rays carry what that surface returns of them (see `trace.first.mirror_return`), and
    nothing else is deposited.

    For each chunk of rays:

    1. Send the rays, and march them through the voxels into segments.
    2. Deposit the return of every segment and material, bin by bin, and the energy that arrives there.
    3. Deposit the return of every surface at an instant, and the energy that arrives there.
    4. What is left of rays that meet no ground escapes.
    5. Smooth what segments return over bins: smoothing is linear, so that only the sum is smoothed.
    """
    tracer = FirstOrderTracer(scene, mirror)

    def trace_chunk(x: Scalar, y: Scalar, energy: Scalar) -> FirstOrder:
        return tracer.trace_chunk((x, y), energy)

    # Reverse mode traces each chunk again, and keeps the intermediate values of one chunk at a time.
    chunk = jax.checkpoint(trace_chunk) if scene.reverse else trace_chunk
    across, energy = move_rays(scene, across, energy)
    n_rays = energy.shape[0]
    if n_rays <= RAYS_AT_ONCE:
        return chunk(*across, energy)
    if scene.medium is None and scene.meshes is None:
        # Without a march all chunks fit into the memory at once, and no loop is compiled.
        chunks = jax.vmap(chunk)(*ray_chunks(across, energy))
        return jax.tree.map(lambda a: jnp.sum(a, axis=0), chunks)
    return sum_over_chunks(scene, chunk, ray_chunks(across, energy))


def ray_chunks(across: tuple[Scalar, Scalar], energy: Scalar) -> list[Float[Array, "chunks rays"]]:
    """Arrange x and y across the beam, and energies, in chunks; rays without energy fill up the last."""
    size = min(RAYS_AT_ONCE, energy.shape[0])
    fill = -energy.shape[0] % size
    return [jnp.pad(a, (0, fill)).reshape(-1, size) for a in (*across, energy)]


def sum_over_chunks(
    scene: DeviceScene, chunk: Callable[..., Tally], chunks: list[Float[Array, "chunks rays"]]
) -> Tally:
    """Sum the results of chunks of rays, one after the other."""
    # The loop needs zeros of the result's shape; evaluating shapes compiles nothing.
    shapes = jax.eval_shape(chunk, *(a[0] for a in chunks))
    zero = vary_with(jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes), scene)

    def add(total: Tally, rays: list[Scalar]) -> tuple[Tally, None]:
        return jax.tree.map(jnp.add, total, chunk(*rays)), None

    return lax.scan(add, zero, chunks)[0]


def smooth_padded(returned: Float[Array, "entries padded"]) -> Float[Array, "entries padded"]:
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


def material_extinctions(
    medium: Medium, segments: RaySegments, w: Vec
) -> tuple[Scalar | None, Scalar | None]:
    """Look up the extinction of leaf and of bark along segments, 1/m; None where there is none."""
    if medium.leaf is None or medium.bark is None:
        # Without the other material, the segment's extinction is this material's: no second look-up.
        return (
            None if medium.leaf is None else segments.extinction,
            None if medium.bark is None else segments.extinction,
        )
    return medium.leaf_extinction(segments.cell, w), medium.bark_extinction(segments.cell)


def _medium_materials(
    medium: Medium, config: TraceConfig, extinctions: tuple[Scalar | None, Scalar | None], w: Vec
) -> Iterator[tuple[int, MediumMaterial]]:
    """Yield the number of each material of the medium, and its properties along segments."""
    back, (leaf_k, bark_k) = scale(w, jnp.asarray(-1.0)), extinctions
    if leaf_k is not None and config.leaf is not None:
        factor = FACET_BACKSCATTER
        if medium.leaf_phase is not None:
            factor = medium.leaf_phase.intensity_factor(w, back)
        elif medium.angle_tables is not None:
            # Mean of |n.w| |n.back| over facets that are hit, with density g(n) |n.w| / G.
            factor = medium.angle_tables.squared_cosine_at(w) / medium.angle_tables.projection_at(w)
        yield config.leaf.material, MediumMaterial(leaf_k, factor, config.leaf.reflection)
    if bark_k is not None and config.bark is not None:
        factor = FACET_BACKSCATTER
        if medium.bark_phase is not None:
            factor = medium.bark_phase.intensity_factor(w, back)
        yield config.bark.material, MediumMaterial(bark_k, factor, config.bark.reflection)
