"""Collisions: what is hit, whereto it scatters, and what of it the receiver sees."""

import jax
import jax.numpy as jnp

from .._vector import Scalar, Vec, dot, polar, scale
from ..materials import (
    AbstractLaw,
    EqualAngle,
    Lambertian,
    about,
    anywhere,
    facet_normal,
    facet_reflection,
    facet_transmission,
)
from .march import Medium
from .photons import Hit, Setting, merge, ratio_of, stop


def collide(setting: Setting, w, cell, collided, landed, events, limit, u) -> "Hit":
    """What was hit, how it scatters, and whereto."""
    layout, one = setting.layout, jnp.ones_like(limit)
    none = jnp.full(limit.shape, -1, jnp.int32)
    hit = Hit(jnp.zeros_like(none), none, one, one, w, none, none, none, w, w)
    if setting.medium is not None:
        hit = merge(collided, _in_medium(setting, setting.medium, w, cell, u), hit)
    for i, (s, scatterer) in enumerate(zip(setting.surfaces, layout.surfaces)):
        here = landed & (events[i] <= limit)
        normal = s.lit_normal(w)
        out = s.law.sample(*jax.tree.map(stop, (w, normal)), u[4], u[5])
        facing = _remember(s.law, normal)
        ratio, onward, letter = ratio_of(s.law.density(w, normal, out)), one, scatterer.reflected
        letters = jnp.full_like(none, letter)
        if scatterer.transmitted >= 0:
            if s.straight:
                onward = one / layout.lobe
            else:
                through = u[1] >= layout.lobe
                far = about(tuple(-n for n in jax.tree.map(stop, normal)), u[4], u[5])
                out = tuple(jnp.where(through, f, o) for f, o in zip(far, out))
                facing = tuple(jnp.where(through, -n, f) for n, f in zip(normal, facing))
                ratio = jnp.where(through, ratio_of(-dot(normal, far)), ratio)
                onward = jnp.where(through, 1.0 / (1.0 - layout.lobe), 1.0 / layout.lobe)
                letters = jnp.where(through, scatterer.transmitted, letters)
        diffuse = scatterer.transmitted if not s.straight else -1
        surface = Hit(
            jnp.full_like(none, scatterer.material),
            letters,
            one,
            onward * ratio,
            jax.tree.map(stop, out),
            jnp.full_like(none, i),
            jnp.full_like(none, scatterer.reflected),
            jnp.full_like(none, diffuse),
            normal,
            jax.tree.map(stop, facing),
        )
        hit = merge(here, surface, hit)
    return hit


def _in_medium(setting: Setting, medium: Medium, w, cell, u) -> "Hit":
    layout = setting.layout
    leaf_k = None if medium.leaf is None else medium.leaf_at(cell, w)
    bark_k = None if medium.bark is None else medium.bark_at(cell)
    like = jnp.zeros_like(cell)
    parts = []
    if layout.leaf is not None:
        onward, letter = jnp.ones_like(u[0]), jnp.full_like(like, layout.leaf.reflected)
        if bark_k is None:
            chosen, share = jnp.ones_like(u[1], bool), u[1]
        else:
            p = leaf_k / jnp.maximum(leaf_k + bark_k, 1e-30)
            chosen, share = u[1] < p, u[1] / jnp.maximum(p, 1e-30)
        ratio = ratio_of(leaf_k)
        if layout.leaf_isotropic:
            normal, out, facing = w, anywhere(u[4], u[5]), tuple(0.0 * n for n in w)
        else:
            if medium.angles is None:
                normal = facet_normal(w, u[2], u[3])
            else:
                normal, more = _leaf_normal(medium, w, u[2], u[3])
                ratio = ratio * more
            out, facing = about(normal, u[4], u[5]), normal
            if layout.leaf.transmitted >= 0:
                through = share >= layout.lobe
                facing = tuple(jnp.where(through, -n, n) for n in normal)
                lift = jnp.where(through, 2.0 * dot(out, normal), 0.0)
                out = tuple(o - lift * n for o, n in zip(out, normal))
                letter = jnp.where(through, layout.leaf.transmitted, letter)
                onward = jnp.where(through, 1.0 / (1.0 - layout.lobe), 1.0 / layout.lobe)
        parts.append((chosen, layout.leaf, letter, ratio, onward, out, normal, facing))
    if layout.bark is not None:
        chosen = jnp.ones_like(u[1], bool) if not parts else ~parts[0][0]
        if layout.bark_isotropic:
            normal, out, facing = w, anywhere(u[4], u[5]), tuple(0.0 * n for n in w)
        else:
            normal = facing = facet_normal(w, u[2], u[3])
            out = about(normal, u[4], u[5])
        letter = jnp.full_like(like, layout.bark.reflected)
        one = jnp.ones_like(u[0])
        parts.append((chosen, layout.bark, letter, ratio_of(bark_k), one, out, normal, facing))
    hit = None
    for chosen, scatterer, letter, ratio, onward, out, normal, facing in parts:
        full = jnp.full_like(like, scatterer.material)
        none = jnp.full_like(like, -1)
        part = Hit(
            full,
            letter,
            ratio,
            onward,
            jax.tree.map(stop, out),
            none,
            jnp.full_like(like, scatterer.reflected),
            jnp.full_like(like, scatterer.transmitted),
            jax.tree.map(stop, normal),
            jax.tree.map(stop, facing),
        )
        hit = part if hit is None else merge(chosen, part, hit)
    assert hit is not None
    return hit


def _leaf_normal(medium: Medium, w, u, v):
    """A normal on the lit side from the leaf angle distribution, and |normal . w| / G(w)."""
    assert medium.leaf_angles is not None
    assert medium.angles is not None
    p = medium.leaf_angles.normalised()
    number = jnp.sum(jnp.cumsum(stop(p))[None, :-1] < u[:, None], axis=1)
    theta = (number + 0.5) * (0.5 * jnp.pi / p.size)
    normal = polar(jnp.cos(theta), 2 * jnp.pi * v)
    cosine = dot(normal, w)
    normal = tuple(jnp.where(cosine > 0, -n, n) for n in normal)
    return normal, jnp.abs(cosine) / medium.angles.projection_at(w) * ratio_of(p[number])


def view_factors(setting: Setting, w, v, hit):
    """Apparent reflectance per unit reflectance, and per unit transmittance (None if none has any)."""
    layout, medium = setting.layout, setting.medium
    reflected = jnp.zeros_like(w[0])
    transmits = [s.transmitted >= 0 and not p.straight for s, p in zip(layout.surfaces, setting.surfaces)]
    if layout.leaf is not None:
        transmits.append(layout.leaf.transmitted >= 0)
    transmitted = jnp.zeros_like(w[0]) if any(transmits) else None
    if medium is not None:
        angle = dot(w, v)
        facet = facet_reflection(angle)
        if layout.leaf is not None:
            here = (hit.on < 0) & (hit.material == layout.leaf.material)
            leaf = jnp.full_like(angle, 0.25)
            if not layout.leaf_isotropic:
                leaf = facet if medium.angles is None else jnp.maximum(dot(hit.normal, v), 0.0)
            reflected = jnp.where(here, leaf, reflected)
            if layout.leaf.transmitted >= 0:
                through = (
                    facet_transmission(angle)
                    if medium.angles is None
                    else jnp.maximum(-dot(hit.normal, v), 0.0)
                )
                transmitted = jnp.where(here, through, transmitted)
        if layout.bark is not None:
            here = (hit.on < 0) & (hit.material == layout.bark.material)
            reflected = jnp.where(here, 0.25 if layout.bark_isotropic else facet, reflected)
    for i, (s, scatterer) in enumerate(zip(setting.surfaces, layout.surfaces)):
        here = hit.on == i
        normal = s.lit_normal(w)
        lit = dot(normal, v) > 0
        factor = s.law.view_factor(w, normal, v, setting.beam.half_angle)
        reflected = jnp.where(here, jnp.where(lit, factor, 0.0), reflected)
        if scatterer.transmitted >= 0 and not s.straight:
            transmitted = jnp.where(here, jnp.maximum(-dot(normal, v), 0.0), transmitted)
    return reflected, transmitted


def _remember(law: AbstractLaw, normal: Vec) -> Vec:
    """How `Photons.facing` remembers the law by which a surface sent a photon on."""
    length = {Lambertian: 1.0, EqualAngle: 2.0}.get(type(law), 0.0)
    return scale(normal, jnp.asarray(length))


def drawn_density(facing: Vec, w: Vec) -> Scalar:
    """Relative density with which the direction `w` was drawn."""
    kind, cosine = dot(facing, facing), dot(facing, w)
    equal = 1.0 / jnp.sqrt(jnp.maximum(1.0 - 0.25 * cosine * cosine, 1e-6))
    return jnp.where(kind > 2.0, equal, jnp.where(kind > 0.5, jnp.maximum(cosine, 1e-6), 1.0))
