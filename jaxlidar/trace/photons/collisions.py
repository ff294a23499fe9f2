r"""Collisions: the material that is hit, the direction onward, and the radiant intensity towards the sensor.

A collision at extinction k = k_leaf + k_bark is with leaf with the probability k_leaf / k. A leaf or bark
facet has a normal n with the density g(n) |w.n| / G(w) (of spherically oriented facets, with G = 1/2, that is
a cosine law about -w); it reflects by the cosine law into the lit side and transmits by it into the other. In
place of facets a phase function may scatter. A surface reflects by its own law, or transmits diffusely by the
cosine law.

Reflection or transmission is chosen with a fixed probability q that does not depend on wavelength; going on,
the weight is divided by q or 1 - q. Optics (R, T) are not part of the weight: they belong to the history.

Light that returns from a collision is not sampled but deposited as its expectation. Per unit reflectance or
transmittance, as apparent reflectance, it is the intensity factor

    V = pi x BRDF x cos(view)  of a surface,   V = pi x p(w -> v)  of a volume with the phase function p,

times the transmittance of the return path. For a surface that is the bidirectional reflectance factor (BRF)
times the cosine of the view angle, per unit reflectance; p integrates to one over solid angle (1/sr).

The attached ratios of the densities by which facets and directions were drawn keep derivatives unbiased
(`trace.photons.photons`).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxlidar._jax.one_function import barrier
from jaxlidar._vectors import Scalar, Vec, along, cosine_direction, dot, polar, scale, vec
from jaxlidar.optics.facets import facet_normal, facet_reflection, facet_transmission
from jaxlidar.optics.phase import AbstractPhase
from jaxlidar.planning.config import Scatterer
from jaxlidar.trace.device_scene import COSINE_LAW, DeviceScene
from jaxlidar.trace.march.surfaces import TracedSurface
from jaxlidar.trace.march.voxel_traversal import Medium
from jaxlidar.trace.photons.photons import (
    Collision,
    CollisionForReturn,
    LastScattering,
    attached_ratio,
    detach,
    select_collision,
)
from jaxlidar.trace.photons.random_numbers import PhotonDraws


def sample_collision(
    scene: DeviceScene,
    x: Vec,
    w: Vec,
    cell: Int[Array, "photons"],
    collided: Bool[Array, "photons"],
    landed: list[Bool[Array, "photons"]],
    draws: PhotonDraws,
    mesh_normal: Vec | None,
) -> Collision:
    """Sample the material that photons hit at `x`, flying along `w`, and the direction in which it scatters.

    1. In the medium: leaf or bark, in proportion to their extinction, and scattering by it.
    2. On each surface: scattering by that surface.
    3. Select, for each photon, the case of its flight.

    **Arguments:**

    - `cell`: the voxel. `collided`: True for photons that collide in the voxel.
    - `landed`: for each surface, True for photons that land on it.
    - `draws`: uniform numbers.
    - `mesh_normal`: of the triangle on which photons land; None without meshes.
    """
    one = jnp.ones_like(w[0])
    minus_one = jnp.full(one.shape, -1, jnp.int32)
    # For photons that hit nothing, whose weight is zero.
    collision = Collision(
        material=jnp.zeros_like(minus_one),
        channel=minus_one,
        weight=one,
        onward_weight=one,
        w=w,
        surface=minus_one,
        reflection=minus_one,
        transmission=minus_one,
        normal=w,
        last_scattering=LastScattering(jnp.zeros_like(minus_one), w, w),
    )
    # Every case is computed for every photon and one is selected: photons of a chunk run in lockstep, and a
    # branch would not save anything.
    if scene.medium is not None:
        collision = select_collision(collided, _in_medium(scene, scene.medium, w, cell, draws), collision)
    for i, surface in enumerate(scene.surfaces):
        collision = select_collision(
            landed[i], _on_surface(scene, surface, i, x, w, draws, mesh_normal), collision
        )
    return collision


def _on_surface(
    scene: DeviceScene,
    surface: TracedSurface,
    number: int,
    x: Vec,
    w: Vec,
    draws: PhotonDraws,
    mesh_normal: Vec | None,
) -> Collision:
    """Sample scattering by a surface: reflection by its law, or diffuse transmission by the cosine law.

    1. Draw a reflected direction from the law, at detached inputs.
    2. Its weight is the albedo, with the pattern of reflectance, and the attached ratio of its density.
    3. A plate that transmits diffusely sends light on by the cosine law about its far normal with the
       probability 1 - q; weights are divided by q or 1 - q.
    4. At a plate that transmits straight on, the photon stopped with the probability q: the weight of the
       collision is divided by it.
    """
    q, scatterer, law = scene.limits.reflection_probability, scene.config.surfaces[number], surface.law
    normal = surface.lit_normal(x, w, mesh_normal)
    # Directions are decisions: they are drawn from detached inputs, and keep no derivative.
    detached_w, detached_normal = jax.tree.map(detach, (w, normal))
    out = jax.tree.map(detach, law.sample(detached_w, detached_normal, *draws.direction))
    weight = jnp.ones_like(draws.choice)
    # Drawn with the density of the law itself, what is left of BRDF over density is the albedo.
    onward_weight = surface.scale_by_pattern(x, law.albedo(w, normal)) * attached_ratio(
        law.density(w, normal, out)
    )
    minus_one = jnp.full(weight.shape, -1, jnp.int32)
    law_number, exit_normal = jnp.full_like(minus_one, scene.surface_laws[number]), detached_normal
    channel = jnp.full_like(minus_one, scatterer.reflection)
    transmits_diffusely = scatterer.transmission >= 0 and not surface.straight
    if transmits_diffusely:
        through = draws.choice >= q
        # Diffuse transmission is a Lambertian surface seen from behind.
        below = scale(detached_normal, jnp.asarray(-1.0))
        transmitted = cosine_direction(below, *draws.direction)
        out, exit_normal = _select(through, transmitted, out), _select(through, below, exit_normal)
        law_number = jnp.where(through, COSINE_LAW, law_number)
        # The cosine is the density up to a constant, which an attached ratio does not see.
        transmitted_weight = attached_ratio(-dot(normal, transmitted)) / (1.0 - q)
        onward_weight = jnp.where(through, transmitted_weight, onward_weight / q)
        channel = jnp.where(through, scatterer.transmission, channel)
    elif scatterer.transmission >= 0:
        # Straight transmission: that the photon stops here, to be reflected, was drawn on the way
        # (`meet_surfaces`).
        weight = weight / q
    return Collision(
        material=jnp.full_like(minus_one, scatterer.material),
        channel=channel,
        weight=weight,
        onward_weight=onward_weight,
        w=jax.tree.map(detach, out),
        surface=jnp.full_like(minus_one, number),
        reflection=jnp.full_like(minus_one, scatterer.reflection),
        transmission=jnp.full_like(minus_one, scatterer.transmission if transmits_diffusely else -1),
        normal=normal,
        last_scattering=LastScattering(law_number, detached_w, exit_normal),
    )


def _in_medium(
    scene: DeviceScene, medium: Medium, w: Vec, cell: Int[Array, "photons"], draws: PhotonDraws
) -> Collision:
    """Sample scattering within a voxel: by leaf or by bark, in proportion to their extinction."""
    leaf, bark = scene.config.leaf, scene.config.bark
    if bark is None:
        assert leaf is not None
        return _on_leaf(
            scene, medium, leaf, w, medium.leaf_extinction(cell, w, of_collision=True), draws.choice, draws
        )
    # Leaf and bark collide independently: the probability of each is its part of the extinction.
    bark_k = medium.bark_extinction(cell, of_collision=True)
    on_bark = _on_bark(scene, medium, bark, w, bark_k, draws)
    if leaf is None:
        return on_bark
    leaf_k = medium.leaf_extinction(cell, w, of_collision=True)
    p = leaf_k / jnp.maximum(leaf_k + bark_k, 1e-30)
    # Rescaled to (0, 1), the number that chose leaf also chooses between reflection and transmission.
    choice = draws.choice / jnp.maximum(p, 1e-30)
    on_leaf = _on_leaf(scene, medium, leaf, w, leaf_k, choice, draws)
    return select_collision(draws.choice < p, on_leaf, on_bark)


def _on_leaf(
    scene: DeviceScene, medium: Medium, leaf: Scatterer, w: Vec, k: Scalar, choice: Scalar, draws: PhotonDraws
) -> Collision:
    """Sample scattering by leaf: by a bi-Lambertian facet, or by a phase function.

    1. Where there is a phase function, that scatters.
    2. The facet's normal: of spherically oriented facets drawn with its own density, so that its weight is
       one; of others from g(n), with the weight |n.w| / G.
    3. The direction onward: the cosine law about the lit side.
    4. Where a leaf transmits, the direction is mirrored into the other side with the probability 1 - q;
       onward weights are divided by q or 1 - q.
    """
    if medium.leaf_phase is not None:
        return _by_phase(medium.leaf_phase, scene.leaf_law, leaf, w, k, draws)
    weight, onward_weight, q = attached_ratio(k), jnp.ones_like(k), scene.limits.reflection_probability
    channel = jnp.full(k.shape, leaf.reflection, jnp.int32)
    if medium.angle_tables is None:
        # The normal is drawn in proportion to the area that the facet shows to the light: no weight is left
        # in value, but the density has a derivative where the direction of flight has.
        normal = jax.tree.map(detach, facet_normal(w, *draws.normal))
        onward_weight = _attached_facet_ratio(w, normal)
    else:
        normal, normal_weight = _leaf_normal(medium, w, *draws.normal)
        weight = weight * normal_weight
    # Cosine law about the facet's lit side.
    out, exit_normal = cosine_direction(normal, *draws.direction), normal
    if leaf.transmission >= 0:
        through = choice >= q
        exit_normal = _select(through, scale(normal, jnp.asarray(-1.0)), normal)
        # Transmission is reflection mirrored in the facet.
        out = along(out, normal, jnp.where(through, -2.0 * dot(out, normal), 0.0))
        channel = jnp.where(through, leaf.transmission, channel)
        onward_weight = onward_weight * jnp.where(through, 1.0 / (1.0 - q), 1.0 / q)
    return _voxel_collision(leaf, channel, weight, onward_weight, COSINE_LAW, w, out, normal, exit_normal)


def _on_bark(
    scene: DeviceScene, medium: Medium, bark: Scatterer, w: Vec, k: Scalar, draws: PhotonDraws
) -> Collision:
    """Sample scattering by bark: an opaque facet of random orientation, or a phase function."""
    if medium.bark_phase is not None:
        return _by_phase(medium.bark_phase, scene.bark_law, bark, w, k, draws)
    channel = jnp.full(k.shape, bark.reflection, jnp.int32)
    normal = jax.tree.map(detach, facet_normal(w, *draws.normal))
    out, onward_weight = cosine_direction(normal, *draws.direction), _attached_facet_ratio(w, normal)
    return _voxel_collision(
        bark, channel, attached_ratio(k), onward_weight, COSINE_LAW, w, out, normal, normal
    )


def _attached_facet_ratio(w: Vec, normal: Vec) -> Scalar:
    """Attached ratio of the density |n.w| / pi of a facet's normal; of the onward weight alone.

    Returns to the sensor are means over all normals (`intensity_factors`), whichever was drawn.
    """
    return attached_ratio(-dot(normal, w))


def _by_phase(
    phase: AbstractPhase, number: int, scatterer: Scatterer, w: Vec, k: Scalar, draws: PhotonDraws
) -> Collision:
    """Sample scattering by a phase function."""
    channel = jnp.full(k.shape, scatterer.reflection, jnp.int32)
    out = jax.tree.map(detach, phase.sample(jax.tree.map(detach, w), *draws.direction))
    # Sampled by the phase function itself: the weight is one, with the derivative of the density.
    onward_weight = attached_ratio(phase.density(w, out))
    # A phase function has no normal: `w` fills the fields, which nothing reads.
    return _voxel_collision(
        scatterer, channel, attached_ratio(k), onward_weight, number, w, out, normal=w, exit_normal=w
    )


def _voxel_collision(
    scatterer: Scatterer,
    channel: Int[Array, "photons"],
    weight: Scalar,
    onward_weight: Scalar,
    law: int,
    incident: Vec,
    out: Vec,
    normal: Vec,
    exit_normal: Vec,
) -> Collision:
    """Assemble a collision in a voxel, sent on by the law of index `law` about the normal `exit_normal`."""
    incident, out, normal, exit_normal = jax.tree.map(detach, (incident, out, normal, exit_normal))
    return Collision(
        material=jnp.full_like(channel, scatterer.material),
        channel=channel,
        weight=weight,
        onward_weight=onward_weight,
        w=out,
        surface=jnp.full_like(channel, -1),
        reflection=jnp.full_like(channel, scatterer.reflection),
        transmission=jnp.full_like(channel, scatterer.transmission),
        normal=normal,
        last_scattering=LastScattering(jnp.full_like(channel, law), incident, exit_normal),
    )


def _select(where: Bool[Array, "photons"], a: Vec, b: Vec) -> Vec:
    return vec(jnp.where(where, p, q) for p, q in zip(a, b))


def _leaf_normal(medium: Medium, w: Vec, u: Scalar, v: Scalar) -> tuple[Vec, Scalar]:
    """Sample a normal on the lit side from the leaf angle distribution, with its weight |n.w| / G(w).

    The normal is drawn from g(n), not from g(n) |n.w|: the weight makes up for the difference.
    """
    assert medium.leaf_angles is not None
    assert medium.angle_tables is not None
    p = medium.leaf_angles.normalised()
    # Inverse of a distribution in steps: the class of inclination, then its middle.
    number = jnp.sum(jnp.cumsum(detach(p))[None, :-1] < u[:, None], axis=1)
    theta = (number + 0.5) * (0.5 * jnp.pi / p.size)
    normal = polar(jnp.cos(theta), 2 * jnp.pi * v)
    # A leaf has two sides: the one that faces the light is taken.
    cosine = dot(normal, w)
    normal = _select(cosine > 0, scale(normal, jnp.asarray(-1.0)), normal)
    return normal, jnp.abs(cosine) / medium.angle_tables.projection_at(w) * attached_ratio(p[number])


def collision_for_return(scene: DeviceScene, collision: Collision) -> CollisionForReturn:
    """Return the fields of a collision that its return depends on; the compiler then drops all else."""
    has_leaf_angles = scene.medium is not None and scene.medium.angle_tables is not None
    needs_normal = has_leaf_angles or scene.meshes is not None
    return CollisionForReturn(
        collision.material,
        collision.surface,
        collision.reflection,
        collision.transmission,
        collision.normal if needs_normal else None,
    )


def intensity_factors(
    scene: DeviceScene, x: Vec, w: Vec, v: Vec, collision: CollisionForReturn
) -> tuple[Scalar, Scalar | None]:
    """Return the intensity factors towards `v` of light that collides at `x`, flying along `w`.

    They are apparent reflectance per unit reflectance, and per unit transmittance (None if nothing
    transmits).

    1. Leaf: the phase function, or the cosine with the sampled normal; of spherically oriented facets the
       mean over all normals.
    2. Bark: the phase function, or that mean.
    3. Surfaces: their law on the lit side, the cosine law on the other.
    """
    config, medium = scene.config, scene.medium
    reflected, transmitted = jnp.zeros_like(w[0]), jnp.zeros_like(w[0])
    # Light that is transmitted straight on is no scattering: it returns from what lies behind the plate.
    transmits = [s.transmission >= 0 and not p.straight for s, p in zip(config.surfaces, scene.surfaces)]
    if medium is not None:
        cos_scattering = dot(w, v)
        # The means over the normals of spherically oriented facets, so that the sampled normal does not
        # matter; behind an optimisation barrier, as they serve several results.
        front, back = barrier((facet_reflection(cos_scattering), facet_transmission(cos_scattering)))
        in_voxel = collision.surface < 0
        if config.leaf is not None:
            transmits.append(config.leaf.transmission >= 0)
            on_leaf = in_voxel & (collision.material == config.leaf.material)
            lit, unlit = front, back
            if medium.leaf_phase is not None:
                lit = unlit = medium.leaf_phase.intensity_factor(w, v)
            elif medium.angle_tables is not None:
                assert collision.normal is not None
                cosine = dot(collision.normal, v)
                lit, unlit = jnp.maximum(cosine, 0.0), jnp.maximum(-cosine, 0.0)
            reflected = jnp.where(on_leaf, lit, reflected)
            transmitted = jnp.where(on_leaf, unlit, transmitted)
        if config.bark is not None:
            on_bark = in_voxel & (collision.material == config.bark.material)
            bark = front if medium.bark_phase is None else medium.bark_phase.intensity_factor(w, v)
            reflected = jnp.where(on_bark, bark, reflected)
    for i, surface in enumerate(scene.surfaces):
        # Recomputed from the point, with its derivative: the sampled normal is detached.
        on_surface, normal = collision.surface == i, surface.lit_normal(x, w, collision.normal)
        cosine = dot(normal, v)
        factor = surface.law.intensity_factor(w, normal, v, scene.beam.aperture_half_angle(x))
        factor = surface.scale_by_pattern(x, factor)
        reflected = jnp.where(on_surface, jnp.where(cosine > 0, factor, 0.0), reflected)
        transmitted = jnp.where(on_surface, jnp.maximum(-cosine, 0.0), transmitted)
    return reflected, transmitted if any(transmits) else None
