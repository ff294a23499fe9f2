"""Flights: how far a photon flies, and what ends its flight.

A flight ends at the nearest of: a collision in the medium, at the optical depth

    tau = -ln u,   u uniform in (0, 1);

a surface that stops the photon (the ground; a plate unless the photon passes a gap, or is transmitted
straight on); the length beyond which its light could not be recorded any more; or it leaves the scene.

Derivatives: the collision point is held at a fixed fraction of its chord through the voxel (detached), or of
the part of it between surfaces that the path meets within the voxel, so that it moves with voxel sizes and
heights, and stays on its side of a surface. The weight carries the attached ratio of its density

    p(s) ds = k exp(-tau) ds  ->  (k and exp(-tau) and the chord, each over its detached value).

exp(-tau) and the chord are attached here. The material m is drawn with the probability k_m / k, so that the
density of position and material together has the factor k_m in place of k; it is attached where the material
is known (`trace.photons.collisions`). The ratio of a flight that does not collide is that of its
probability, exp(-tau) of the whole flight.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._vectors import FAR, Scalar, Vec, with_derivative_of
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.march.meshes import surface_distances
from jaxlidar.trace.march.voxel_traversal import PathSlopes, march_to_depths
from jaxlidar.trace.photons.photons import GAP, STOPPED, TRANSMITTED, Photons, attached_ratio, detach


class Flight(eqx.Module):
    """The ends of flights: in the medium, on a surface, after the record, or never.

    - `collided`, `landed`, `outside`, `escaped`: which of these, all False for photons that are not alive.
    - `cell`: the voxel of a collision.
    - `distance`: length flown, m.
    - `ratio`: attached ratio of the density of that distance but for the factor k (see the module), or of
      the probability of no collision.
    - `depth_slopes`: derivatives of the optical depth flown with respect to parameters; None without
      score functions.
    - `path_slopes`: derivatives by the path of the optical depth of the whole flight; None where landing
      points do not move.
    - `moved_w`: direction of flights whose landing points move (`trace.derivatives.reparametrisation`),
      equal to that of the photons but for its derivative; None where none move.
    """

    collided: Bool[Array, "*photons"]
    landed: Bool[Array, "*photons"]
    outside: Bool[Array, "*photons"]
    escaped: Bool[Array, "*photons"]
    cell: Int[Array, "*photons"]
    distance: Float[Array, "*photons"]
    ratio: Float[Array, "*photons"]
    depth_slopes: Float[Array, "ends photons parameters"] | None = None
    path_slopes: PathSlopes | None = None
    moved_w: Vec | None = None

    def direction(self, p: Photons) -> Vec:
        """Direction of the flights of photons."""
        return p.w if self.moved_w is None else self.moved_w

    @property
    def has_hit(self) -> Bool[Array, "*photons"]:
        """True if anything was hit."""
        return self.collided | self.landed

    def landed_on(self, encounters: "SurfaceEncounters") -> list[Bool[Array, "*photons"]]:
        """For each surface, True if the flight ends on it."""
        return [self.landed & (stop <= encounters.nearest_stop) for stop in encounters.stops]


class SurfaceEncounters(eqx.Module):
    """The surfaces ahead of photons, and what will happen there.

    - `distances`: to each surface, m; FAR where it is not met.
    - `outcomes`: for each plate GAP, STOPPED (reflected, absorbed, or transmitted diffusely) or TRANSMITTED
      (straight on); None for the ground and for meshes.
    - `ratios`: for each plate, attached ratio of that outcome; None for the ground and for meshes.
    - `stops`: distance to each surface if the photon will stop there, else FAR.
    - `nearest_stop`: distance to the nearest surface at which the photon stops.
    - `mesh_normal`: of the triangle that is met; None without meshes.
    """

    distances: list[Scalar]
    outcomes: list[Int[Array, "*photons"] | None]
    ratios: list[Scalar | None]
    stops: list[Scalar]
    nearest_stop: Scalar
    mesh_normal: Vec | None


def meet_surfaces(scene: DeviceScene, p: Photons, draws: tuple[Scalar, ...]) -> SurfaceEncounters:
    """Find the surfaces ahead of photons, and sample the outcome at each plate.

    1. The distance to each surface. The ground and meshes stop every photon that meets them.
    2. A plate of the coverage c: u < c meets its material, else a gap. With straight transmission, u from c q
       to c is transmitted; other photons that meet material stop.
    3. The nearest distance at which the photon stops.

    `draws`: one uniform number u for each plate.
    """
    distances, outcomes, ratios, stops = [], [], [], []
    remaining_draws = iter(draws)
    distances_ahead, mesh_normal = surface_distances(scene, p.x, p.w, p.surface)
    for i, (surface, distance) in enumerate(zip(scene.surfaces, distances_ahead)):
        if not surface.lights_itself:
            # Light that leaves this surface never meets it again; by rounding, the photon may start below it.
            distance = jnp.where(p.surface == i, FAR, distance)
        distances.append(distance)
        if not surface.is_plate:
            outcomes.append(None)
            ratios.append(None)
            stops.append(distance)
            continue
        u, coverage = next(remaining_draws), jnp.broadcast_to(surface.coverage, p.weight.shape)
        is_hit = u < coverage
        # A partial plate is a mixture: sampling gap or material gives each photon one history, and no path is
        # split.
        outcome = jnp.where(is_hit, STOPPED, GAP)
        if surface.straight and scene.config.surfaces[i].transmission >= 0:
            # The number that decided that the plate was hit decides between reflection and transmission, too.
            transmitted = is_hit & (u >= coverage * scene.limits.reflection_probability)
            outcome = jnp.where(transmitted, TRANSMITTED, outcome)
        outcomes.append(outcome)
        ratios.append(attached_ratio(jnp.where(is_hit, coverage, 1.0 - coverage)))
        # A plate that lets the photon pass is no obstacle to the flight; `_pass_plates` accounts for it
        # afterwards.
        stops.append(jnp.where(outcome == STOPPED, distance, FAR))
    nearest_stop = jnp.full_like(p.weight, FAR)
    for stop in stops:
        nearest_stop = jnp.minimum(nearest_stop, stop)
    return SurfaceEncounters(distances, outcomes, ratios, stops, nearest_stop, mesh_normal)


def sample_flights(
    scene: DeviceScene,
    p: Photons,
    encounters: SurfaceEncounters,
    max_length: Float[Array, "photons"],
    u: Float[Array, "ends photons"],
    *,
    by_path: bool = False,
) -> Flight:
    """Let photons fly to collisions at the optical depths -ln(u), to the surface that stops them, or on.

    A flight has one end for each number in `u`; `max_length`, m, is how far it can be recorded. With
    `by_path` it has `path_slopes`. The steps:

    1. March to the target depths, at most to the nearest stop or to `max_length`.
    2. Place each collision within its voxel, where the depth is linear, at a detached fraction of the chord
       between the surfaces on either side.
    3. Attach the ratio of its density: exp(-tau) times that chord.
    4. Sort out what ended the flight.
    """
    nearest_stop = encounters.nearest_stop
    # Nothing beyond these two can be an end: the march need not go there.
    max_distance = jnp.minimum(nearest_stop, max_length)
    to_ends = functools.partial(jnp.broadcast_to, shape=u.shape)
    if scene.medium is None:
        collided = stopped_in_medium = jnp.zeros(u.shape, bool)
        distance, ratio = to_ends(max_distance), jnp.ones_like(u)
        cell, depth_slopes, path_slopes = jnp.zeros(u.shape, jnp.int32), None, None
    else:
        medium, target = scene.medium, -jnp.log(u)
        crossing = march_to_depths(
            medium,
            p.x,
            p.w,
            target,
            max_distance,
            p.alive,
            scene.config.max_faces,
            scene.occupied_box,
            reverse=scene.reverse,
            slopes=scene.slopes,
            by_path=by_path,
        )
        path_slopes = crossing.path_slopes
        collided, cell, depth_slopes = crossing.crossed, crossing.cell, crossing.depth_slopes
        if depth_slopes is not None:
            depth_slopes = jnp.swapaxes(depth_slopes, 1, 2)
        # Looked up again rather than carried through the march, whose loop takes most of the time.
        k = jnp.where(collided, jax.vmap(medium.extinction, (0, None))(cell, p.w), 1.0)
        chord = jnp.where(collided, crossing.chord, 1.0)
        # Guards against 0/0 where a voxel is empty or the chord zero.
        fraction = jnp.clip((target - crossing.depth) / jnp.maximum(k * chord, 1e-30), 0.0, 1.0)
        flown = detach(jnp.where(collided, fraction, 0.0)) * chord
        distance = jnp.where(collided, crossing.entered + flown, to_ends(max_distance))
        # Held fixed as a fraction, the point stays within its voxel, and on its side of surfaces in it, when
        # these move or grow: returns jump at them, and flights that are stopped end there.
        nearest, farthest = crossing.entered, crossing.entered + chord
        for surface_distance in map(to_ends, encounters.distances):
            is_ahead = detach(surface_distance) > detach(distance)
            farthest = jnp.where(is_ahead, jnp.minimum(farthest, surface_distance), farthest)
            nearest = jnp.where(is_ahead, nearest, jnp.maximum(nearest, surface_distance))
        span = jnp.where(collided, farthest - nearest, 1.0)
        fraction = detach((distance - nearest) / jnp.maximum(span, 1e-30))
        moved = jnp.where(collided, nearest + fraction * span, distance)
        distance = with_derivative_of(distance, moved)
        depth = crossing.depth + k * (distance - crossing.entered)
        depth = jnp.where(collided, depth, to_ends(crossing.total_depth))
        # The density per m is k exp(-tau), and the point moves with its span: exp(-tau) and the span are
        # attached here, k with the material that is hit.
        ratio = jnp.exp(detach(depth) - depth) * span / jnp.maximum(detach(span), 1e-30)
        # Exactly one: rounding of the quotient would make waveforms depend on whether derivatives are taken.
        ratio = with_derivative_of(jnp.ones_like(ratio), ratio)
        # The march may also end at the box of occupied voxels, behind which there is nothing.
        stopped_in_medium = ~collided & to_ends(crossing.distance >= max_length)
    alive = to_ends(p.alive)
    # Compared with `max_length`, not with the distance flown: a surface that lies just beyond it would be
    # recorded too late.
    landed = alive & ~collided & to_ends(nearest_stop < max_length)
    collided = alive & collided
    hits_nothing = alive & ~collided & ~landed
    # Beyond `max_length` there is a surface, or still medium: its light comes after the record.
    outside = hits_nothing & (to_ends(nearest_stop < FAR) | stopped_in_medium)
    escaped = hits_nothing & ~outside
    return Flight(collided, landed, outside, escaped, cell, distance, ratio, depth_slopes, path_slopes)
