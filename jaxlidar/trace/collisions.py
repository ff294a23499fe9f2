"""Collisions: what is hit, in which direction it scatters, and how much of that the receiver sees."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxlidar._vectors import Scalar, Vec, about, along, dot, polar, scale, vec
from jaxlidar.optics.facets import facet_normal, facet_reflection, facet_transmission
from jaxlidar.optics.phase import AbstractPhase
from jaxlidar.planning.trace_plan import Scatterer
from jaxlidar.trace.march import Medium
from jaxlidar.trace.photons import Hit, Met, Scattering, merge, ratio_of, stop
from jaxlidar.trace.random_numbers import Draw
from jaxlidar.trace.setting import COSINE_LAW, Setting
from jaxlidar.trace.surfaces import Surface


def collide(
    setting: Setting,
    x: Vec,
    w: Vec,
    cell: Int[Array, "photons"],
    collided: Bool[Array, "photons"],
    landed: list[Bool[Array, "photons"]],
    draw: Draw,
) -> Hit:
    """What photons that fly along `w` hit at `x`, and how and in which direction it scatters.

    - `cell`: the voxel.
    - `collided`: whether they collide in the voxel.
    - `landed`: for each surface, whether they land on it.
    """
    one = jnp.ones_like(w[0])
    none = jnp.full(one.shape, -1, jnp.int32)
    nowhere = Scattering(jnp.zeros_like(none), w, w)
    hit = Hit(jnp.zeros_like(none), none, one, one, w, none, none, none, w, nowhere)
    if setting.medium is not None:
        hit = merge(collided, _in_medium(setting, setting.medium, w, cell, draw), hit)
    for i, surface in enumerate(setting.surfaces):
        hit = merge(landed[i], _on_surface(setting, surface, i, x, w, draw), hit)
    return hit


def _on_surface(setting: Setting, surface: Surface, number: int, x: Vec, w: Vec, draw: Draw) -> Hit:
    lobe, scatterer, law = setting.plan.lobe, setting.plan.surfaces[number], surface.law
    normal = surface.lit_normal(x, w)
    incident, upright = jax.tree.map(stop, (w, normal))
    out = jax.tree.map(stop, law.sample(incident, upright, *draw.direction))
    ratio = jnp.ones_like(draw.choice)
    onward = surface.by_place(x, law.albedo(w, normal)) * ratio_of(law.density(w, normal, out))
    none = jnp.full(ratio.shape, -1, jnp.int32)
    sent_by, facing = jnp.full_like(none, setting.surface_laws[number]), upright
    letter = jnp.full_like(none, scatterer.reflected)
    diffuse = scatterer.transmitted >= 0 and not surface.straight
    if diffuse:
        through = draw.choice >= lobe
        below = scale(upright, jnp.asarray(-1.0))
        far = about(below, *draw.direction)
        out, facing = _either(through, far, out), _either(through, below, facing)
        sent_by = jnp.where(through, COSINE_LAW, sent_by)
        onward = jnp.where(through, ratio_of(-dot(normal, far)) / (1.0 - lobe), onward / lobe)
        letter = jnp.where(through, scatterer.transmitted, letter)
    elif scatterer.transmitted >= 0:
        # Whether it is reflected or passes was drawn on the way.
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
        sent=Scattering(sent_by, incident, facing),
    )


def _in_medium(setting: Setting, medium: Medium, w: Vec, cell: Int[Array, "photons"], draw: Draw) -> Hit:
    leaf, bark = setting.plan.leaf, setting.plan.bark
    if bark is None:
        assert leaf is not None
        return _on_leaf(setting, medium, leaf, w, medium.leaf_at(cell, w), draw.choice, draw)
    bark_k = medium.bark_at(cell)
    on_bark = _on_bark(setting, medium, bark, w, bark_k, draw)
    if leaf is None:
        return on_bark
    leaf_k = medium.leaf_at(cell, w)
    p = leaf_k / jnp.maximum(leaf_k + bark_k, 1e-30)
    # Rescaled, the number that chose leaf also chooses the lobe.
    share = draw.choice / jnp.maximum(p, 1e-30)
    return merge(draw.choice < p, _on_leaf(setting, medium, leaf, w, leaf_k, share, draw), on_bark)


def _on_leaf(
    setting: Setting, medium: Medium, leaf: Scatterer, w: Vec, k: Scalar, share: Scalar, draw: Draw
) -> Hit:
    if medium.leaf_phase is not None:
        return _in_volume(medium.leaf_phase, setting.leaf_law, leaf, w, k, draw)
    ratio, onward, lobe = ratio_of(k), jnp.ones_like(k), setting.plan.lobe
    letter = jnp.full(k.shape, leaf.reflected, jnp.int32)
    if medium.angles is None:
        normal = facet_normal(w, *draw.normal)
    else:
        normal, more = _leaf_normal(medium, w, *draw.normal)
        ratio = ratio * more
    out, facing = about(normal, *draw.direction), normal
    if leaf.transmitted >= 0:
        through = share >= lobe
        facing = _either(through, scale(normal, jnp.asarray(-1.0)), normal)
        out = along(out, normal, jnp.where(through, -2.0 * dot(out, normal), 0.0))
        letter = jnp.where(through, leaf.transmitted, letter)
        onward = jnp.where(through, 1.0 / (1.0 - lobe), 1.0 / lobe)
    return _within(leaf, letter, ratio, onward, COSINE_LAW, w, out, normal, facing)


def _on_bark(setting: Setting, medium: Medium, bark: Scatterer, w: Vec, k: Scalar, draw: Draw) -> Hit:
    if medium.bark_phase is not None:
        return _in_volume(medium.bark_phase, setting.bark_law, bark, w, k, draw)
    letter, one = jnp.full(k.shape, bark.reflected, jnp.int32), jnp.ones_like(k)
    normal = facet_normal(w, *draw.normal)
    out = about(normal, *draw.direction)
    return _within(bark, letter, ratio_of(k), one, COSINE_LAW, w, out, normal, normal)


def _in_volume(phase: AbstractPhase, number: int, scatterer: Scatterer, w: Vec, k: Scalar, draw: Draw) -> Hit:
    letter = jnp.full(k.shape, scatterer.reflected, jnp.int32)
    out = jax.tree.map(stop, phase.sample(jax.tree.map(stop, w), *draw.direction))
    onward = ratio_of(phase.density(w, out))
    return _within(scatterer, letter, ratio_of(k), onward, number, w, out, w, w)


def _within(
    scatterer: Scatterer,
    letter: Int[Array, "photons"],
    ratio: Scalar,
    onward: Scalar,
    law: int,
    incident: Vec,
    out: Vec,
    normal: Vec,
    facing: Vec,
) -> Hit:
    """A collision within a voxel, scattered about the normal `facing` by the law of that number."""
    incident, out, normal, facing = jax.tree.map(stop, (incident, out, normal, facing))
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
        sent=Scattering(jnp.full_like(letter, law), incident, facing),
    )


def _either(where: Bool[Array, "photons"], a: Vec, b: Vec) -> Vec:
    return vec(jnp.where(where, p, q) for p, q in zip(a, b))


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


def shown(setting: Setting, hit: Hit) -> Met:
    """What of a collision `view_factors` asks for."""
    turned = setting.medium is not None and setting.medium.angles is not None
    return Met(hit.material, hit.on, hit.reflected, hit.transmitted, hit.normal if turned else None)


def view_factors(setting: Setting, x: Vec, w: Vec, v: Vec, hit: Met) -> tuple[Scalar, Scalar | None]:
    """Intensity factors towards `v` of light that collides at `x`, flying along `w`.

    They are apparent reflectance per unit reflectance, and per unit transmittance (None if nothing
    transmits).
    """
    plan, medium = setting.plan, setting.medium
    reflected, transmitted = jnp.zeros_like(w[0]), jnp.zeros_like(w[0])
    transmits = [s.transmitted >= 0 and not p.straight for s, p in zip(plan.surfaces, setting.surfaces)]
    if medium is not None:
        angle = dot(w, v)
        front, back = facet_reflection(angle), facet_transmission(angle)
        if plan.leaf is not None:
            transmits.append(plan.leaf.transmitted >= 0)
            here = (hit.on < 0) & (hit.material == plan.leaf.material)
            lit, far = front, back
            if medium.leaf_phase is not None:
                lit = far = medium.leaf_phase.intensity_factor(w, v)
            elif medium.angles is not None:
                assert hit.normal is not None
                turned = dot(hit.normal, v)
                lit, far = jnp.maximum(turned, 0.0), jnp.maximum(-turned, 0.0)
            reflected, transmitted = jnp.where(here, lit, reflected), jnp.where(here, far, transmitted)
        if plan.bark is not None:
            here = (hit.on < 0) & (hit.material == plan.bark.material)
            bark = front if medium.bark_phase is None else medium.bark_phase.intensity_factor(w, v)
            reflected = jnp.where(here, bark, reflected)
    for i, s in enumerate(setting.surfaces):
        here, normal = hit.on == i, s.lit_normal(x, w)
        turned = dot(normal, v)
        factor = s.by_place(x, s.law.intensity_factor(w, normal, v, setting.beam.half_angle))
        reflected = jnp.where(here, jnp.where(turned > 0, factor, 0.0), reflected)
        transmitted = jnp.where(here, jnp.maximum(-turned, 0.0), transmitted)
    return reflected, transmitted if any(transmits) else None
