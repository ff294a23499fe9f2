"""Collisions: what is hit, whereto it scatters, and what of it the receiver sees."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxlidar._vectors import Scalar, Vec, along, dot, polar, scale, vec
from jaxlidar.optics.facets import about, facet_normal, facet_reflection, facet_transmission
from jaxlidar.optics.laws import AbstractLaw, EqualAngle, Lambertian
from jaxlidar.optics.phase import anywhere
from jaxlidar.planning.trace_plan import Scatterer
from jaxlidar.trace.march import Medium
from jaxlidar.trace.photons import Hit, Setting, merge, ratio_of, stop
from jaxlidar.trace.surfaces import Surface


def collide(
    setting: Setting,
    w: Vec,
    cell: Int[Array, "photons"],
    collided: Bool[Array, "photons"],
    landed: Bool[Array, "photons"],
    events: list[Scalar],
    limit: Scalar,
    u: list[Scalar],
) -> Hit:
    """What was hit, how it scatters, and whereto."""
    none = jnp.full(limit.shape, -1, jnp.int32)
    one = jnp.ones_like(limit)
    hit = Hit(jnp.zeros_like(none), none, one, one, w, none, none, none, w, w)
    if setting.medium is not None:
        hit = merge(collided, _in_medium(setting, setting.medium, w, cell, u), hit)
    for i, surface in enumerate(setting.surfaces):
        here = landed & (events[i] <= limit)
        hit = merge(here, _on_surface(setting, surface, i, w, none, u), hit)
    return hit


def _on_surface(
    setting: Setting, surface: Surface, number: int, w: Vec, none: Int[Array, "photons"], u: list[Scalar]
) -> Hit:
    lobe, scatterer = setting.trace.lobe, setting.trace.surfaces[number]
    normal = surface.lit_normal(w)
    incident, upright = jax.tree.map(stop, (w, normal))
    out = surface.law.sample(incident, upright, u[4], u[5])
    ratio, onward = jnp.ones_like(u[0]), ratio_of(surface.law.density(w, normal, out))
    facing, letter = _remember(surface.law, upright), jnp.full_like(none, scatterer.reflected)
    diffuse = scatterer.transmitted >= 0 and not surface.straight
    if diffuse:
        through = u[1] >= lobe
        below = scale(upright, jnp.asarray(-1.0))
        far = about(below, u[4], u[5])
        out, facing = _either(through, far, out), _either(through, below, facing)
        onward = jnp.where(through, ratio_of(-dot(normal, far)) / (1.0 - lobe), onward / lobe)
        letter = jnp.where(through, scatterer.transmitted, letter)
    elif scatterer.transmitted >= 0:
        # That it is reflected rather than passed was drawn on the way.
        ratio = ratio / lobe
    return Hit(
        material=jnp.full_like(none, scatterer.material),
        letter=letter,
        ratio=ratio,
        onward=onward,
        w=jax.tree.map(stop, out),
        on=jnp.full_like(none, number),
        reflected=jnp.full_like(none, scatterer.reflected),
        transmitted=jnp.full_like(none, scatterer.transmitted if diffuse else -1),
        normal=normal,
        facing=facing,
    )


def _in_medium(setting: Setting, medium: Medium, w: Vec, cell: Int[Array, "photons"], u: list[Scalar]) -> Hit:
    leaf, bark = setting.trace.leaf, setting.trace.bark
    if bark is None:
        assert leaf is not None
        return _on_leaf(setting, medium, leaf, w, medium.leaf_at(cell, w), u[1], u)
    bark_k = medium.bark_at(cell)
    on_bark = _on_bark(setting, bark, w, bark_k, u)
    if leaf is None:
        return on_bark
    leaf_k = medium.leaf_at(cell, w)
    p = leaf_k / jnp.maximum(leaf_k + bark_k, 1e-30)
    # What is left of the number that chose leaf chooses the lobe.
    share = u[1] / jnp.maximum(p, 1e-30)
    return merge(u[1] < p, _on_leaf(setting, medium, leaf, w, leaf_k, share, u), on_bark)


def _on_leaf(
    setting: Setting, medium: Medium, leaf: Scatterer, w: Vec, k: Scalar, share: Scalar, u: list[Scalar]
) -> Hit:
    ratio, onward, lobe = ratio_of(k), jnp.ones_like(k), setting.trace.lobe
    letter = jnp.full(k.shape, leaf.reflected, jnp.int32)
    if setting.trace.leaf_isotropic:
        return _facet(leaf, letter, ratio, onward, anywhere(u[4], u[5]), w, _nowhere(w))
    if medium.angles is None:
        normal = facet_normal(w, u[2], u[3])
    else:
        normal, more = _leaf_normal(medium, w, u[2], u[3])
        ratio = ratio * more
    out, facing = about(normal, u[4], u[5]), normal
    if leaf.transmitted >= 0:
        through = share >= lobe
        facing = _either(through, scale(normal, jnp.asarray(-1.0)), normal)
        out = along(out, normal, jnp.where(through, -2.0 * dot(out, normal), 0.0))
        letter = jnp.where(through, leaf.transmitted, letter)
        onward = jnp.where(through, 1.0 / (1.0 - lobe), 1.0 / lobe)
    return _facet(leaf, letter, ratio, onward, out, normal, facing)


def _on_bark(setting: Setting, bark: Scatterer, w: Vec, k: Scalar, u: list[Scalar]) -> Hit:
    letter, one = jnp.full(k.shape, bark.reflected, jnp.int32), jnp.ones_like(k)
    if setting.trace.bark_isotropic:
        return _facet(bark, letter, ratio_of(k), one, anywhere(u[4], u[5]), w, _nowhere(w))
    normal = facet_normal(w, u[2], u[3])
    return _facet(bark, letter, ratio_of(k), one, about(normal, u[4], u[5]), normal, normal)


def _facet(
    scatterer: Scatterer,
    letter: Int[Array, "photons"],
    ratio: Scalar,
    onward: Scalar,
    out: Vec,
    normal: Vec,
    facing: Vec,
) -> Hit:
    out, normal, facing = jax.tree.map(stop, (out, normal, facing))
    return Hit(
        material=jnp.full_like(letter, scatterer.material),
        letter=letter,
        ratio=ratio,
        onward=onward,
        w=out,
        on=jnp.full_like(letter, -1),
        reflected=jnp.full_like(letter, scatterer.reflected),
        transmitted=jnp.full_like(letter, scatterer.transmitted),
        normal=normal,
        facing=facing,
    )


def _either(where: Bool[Array, "photons"], a: Vec, b: Vec) -> Vec:
    return vec(jnp.where(where, p, q) for p, q in zip(a, b))


def _nowhere(w: Vec) -> Vec:
    return scale(w, jnp.asarray(0.0))


def _leaf_normal(medium: Medium, w: Vec, u: Scalar, v: Scalar) -> tuple[Vec, Scalar]:
    """A normal on the lit side from the leaf angle distribution, and |normal . w| / G(w)."""
    assert medium.leaf_angles is not None
    assert medium.angles is not None
    p = medium.leaf_angles.normalised()
    number = jnp.sum(jnp.cumsum(stop(p))[None, :-1] < u[:, None], axis=1)
    theta = (number + 0.5) * (0.5 * jnp.pi / p.size)
    normal = polar(jnp.cos(theta), 2 * jnp.pi * v)
    cosine = dot(normal, w)
    normal = _either(cosine > 0, scale(normal, jnp.asarray(-1.0)), normal)
    return normal, jnp.abs(cosine) / medium.angles.projection_at(w) * ratio_of(p[number])


def view_factors(setting: Setting, w: Vec, v: Vec, hit: Hit) -> tuple[Scalar, Scalar | None]:
    """Apparent reflectance per unit reflectance, and per unit transmittance (None if nothing transmits)."""
    trace, medium = setting.trace, setting.medium
    reflected, transmitted = jnp.zeros_like(w[0]), jnp.zeros_like(w[0])
    transmits = [s.transmitted >= 0 and not p.straight for s, p in zip(trace.surfaces, setting.surfaces)]
    if medium is not None:
        angle = dot(w, v)
        front, back = facet_reflection(angle), facet_transmission(angle)
        if trace.leaf is not None:
            transmits.append(trace.leaf.transmitted >= 0)
            here = (hit.on < 0) & (hit.material == trace.leaf.material)
            lit, far = front, back
            if trace.leaf_isotropic:
                lit = far = jnp.full_like(angle, 0.25)
            elif medium.angles is not None:
                turned = dot(hit.normal, v)
                lit, far = jnp.maximum(turned, 0.0), jnp.maximum(-turned, 0.0)
            reflected, transmitted = jnp.where(here, lit, reflected), jnp.where(here, far, transmitted)
        if trace.bark is not None:
            here = (hit.on < 0) & (hit.material == trace.bark.material)
            reflected = jnp.where(here, 0.25 if trace.bark_isotropic else front, reflected)
    for i, s in enumerate(setting.surfaces):
        here, normal = hit.on == i, s.lit_normal(w)
        turned = dot(normal, v)
        factor = s.law.view_factor(w, normal, v, setting.beam.half_angle)
        reflected = jnp.where(here, jnp.where(turned > 0, factor, 0.0), reflected)
        transmitted = jnp.where(here, jnp.maximum(-turned, 0.0), transmitted)
    return reflected, transmitted if any(transmits) else None


def _remember(law: AbstractLaw, normal: Vec) -> Vec:
    """How `Photons.facing` remembers the law by which a surface sent a photon on."""
    length = {Lambertian: 1.0, EqualAngle: 2.0}.get(type(law), 0.0)
    return scale(normal, jnp.asarray(length))


def drawn_density(facing: Vec, w: Vec) -> Scalar:
    """Relative density with which the direction `w` was drawn."""
    kind, cosine = dot(facing, facing), dot(facing, w)
    equal = 1.0 / jnp.sqrt(jnp.maximum(1.0 - 0.25 * cosine * cosine, 1e-6))
    return jnp.where(kind > 2.0, equal, jnp.where(kind > 0.5, jnp.maximum(cosine, 1e-6), 1.0))
