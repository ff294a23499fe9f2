"""What becomes of light that is followed to its end: how much is absorbed where, and how much leaves.

Photons carry their energy at every wavelength, optics are applied at every scattering, and no time is kept:
so there is no limit to the orders. What a collision absorbs is booked as its expectation. Photons with little
energy are ended by Russian roulette, which keeps all expectations.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxlidar._vectors import FAR, Scalar, Vec, along, vec
from jaxlidar.planning.trace_plan import Scatterer
from jaxlidar.scenes.height_field import HeightField
from jaxlidar.trace.collisions import collide
from jaxlidar.trace.flight import events_of, fly, nearest, plates_ahead
from jaxlidar.trace.footprint import across_beam
from jaxlidar.trace.photons import THROUGH, Photons
from jaxlidar.trace.random_numbers import Draw
from jaxlidar.trace.setting import Setting, unscattered

# Below this share of the emitted energy a photon may be ended.
_FAINT = 0.05


class Fates(eqx.Module):
    """Shares of the emitted energy, the mean of photons.

    - `absorbed`: by each material. - `up`, `down`: left the scene upward, or downward where there is no
      ground.
    - `on_ground`: arrived at the ground, every time it did. - `unfollowed`: what flew farther than flights
      are followed, or was not at its end when the last order was reached.
    """

    absorbed: Float[Array, "materials wavelengths"]
    up: Float[Array, "wavelengths"]
    down: Float[Array, "wavelengths"]
    on_ground: Float[Array, "wavelengths"]
    unfollowed: Float[Array, "wavelengths"]


class _Walk(eqx.Module):
    photons: Photons
    energy: Float[Array, "photons wavelengths"]
    fates: Fates
    order: Int[Array, ""]


def from_beam(setting: Setting, key: PRNGKeyArray, count: int) -> tuple[Vec, Vec]:
    """Places above the scene and directions of light of the beam."""
    share, turn = jax.random.uniform(key, (2, count))
    point, w, _ = setting.beam.ray(across_beam(setting.beam, share, turn))
    return along(point, w, jnp.asarray(-setting.plan.upstream, share.dtype)), w


def from_the_sky(setting: Setting, key: PRNGKeyArray, count: int) -> tuple[Vec, Vec]:
    """Parallel light over one period of the voxel map, which enters at its top, or above all terrain."""
    medium = setting.medium
    assert medium is not None
    u, v = jax.random.uniform(key, (2, count))
    low, high = medium.origin, medium.origin + medium.size * medium.counts
    x, y = (low[k] + s * (high[k] - low[k]) for k, s in enumerate((u, v)))
    top = jnp.full_like(u, high[2])
    for s in setting.surfaces:
        if isinstance(s.shape, HeightField):
            top = jnp.maximum(top, s.shape.high)
    return (x, y, top), vec(jnp.broadcast_to(c, u.shape) for c in setting.beam.axis)


def follow(
    setting: Setting,
    optics: Float[Array, "letters wavelengths"],
    key: PRNGKeyArray,
    count: int,
    source: Callable[[Setting, PRNGKeyArray, int], tuple[Vec, Vec]],
    max_orders: int,
) -> Fates:
    """Follow `count` photons of a source to their ends.

    `optics`: reflectance or transmittance of every letter.
    """
    start_key, key = jax.random.split(key)
    x, w = source(setting, start_key, count)
    none = jnp.zeros((count,), jnp.int32)
    zero, one = jnp.zeros_like(x[0]), jnp.ones_like(x[0])
    photons = Photons(x, w, zero, one, none, none - 1, unscattered(zero), none == 0)
    wavelengths = optics.shape[1]
    nothing = jnp.zeros((wavelengths,), optics.dtype)
    tally = Fates(
        jnp.zeros((len(setting.plan.materials), wavelengths), optics.dtype),
        nothing,
        nothing,
        nothing,
        nothing,
    )
    start = _Walk(photons, jnp.ones((count, wavelengths), optics.dtype), tally, jnp.zeros((), jnp.int32))

    def going(walk: _Walk) -> Bool[Array, ""]:
        return jnp.any(walk.photons.alive) & (walk.order < max_orders)

    def step(walk: _Walk) -> _Walk:
        return _one_order(setting, optics, walk, jax.random.fold_in(key, walk.order))

    end = jax.lax.while_loop(going, step, start)
    left = jnp.sum(jnp.where(end.photons.alive[:, None], end.energy, 0.0), axis=0)
    fates = eqx.tree_at(lambda f: f.unfollowed, end.fates, end.fates.unfollowed + left)
    return jax.tree.map(lambda a: a / count, fates)


def _one_order(setting: Setting, optics: Array, walk: _Walk, key: PRNGKeyArray) -> _Walk:
    """Fly, pass plates, collide, scatter."""
    plan, p, energy, fates = setting.plan, walk.photons, walk.energy, walk.fates
    plates = sum(s.plate for s in setting.surfaces)
    tiny = jnp.finfo(energy.dtype).tiny
    draw_key, end_key = jax.random.split(key)
    shape = (Draw.dimensions(plates, back=False), p.weight.size)
    draw = Draw.of(list(jax.random.uniform(draw_key, shape, p.weight.dtype, tiny)), plates)
    met, outcomes, _ = plates_ahead(setting, p, draw.ahead)
    events = events_of(setting, met, outcomes)
    limit = nearest(p, events)
    farthest = jnp.full_like(limit, plan.max_flight)
    flight = jax.tree.map(lambda a: a[0], fly(setting, p, limit, farthest, draw.flight[None]))

    def optics_at(letter: int) -> Float[Array, "1 wavelengths"]:
        return optics[letter : letter + 1] if letter >= 0 else jnp.zeros_like(optics[:1])

    def lost(scatterer: Scatterer, arrived: Array, scattered: Array) -> Array:
        """What of the energy that arrives is absorbed. `scattered`: the albedo of the law."""
        reflected = optics_at(scatterer.reflected) * scattered[:, None]
        return jnp.sum(arrived * (1.0 - reflected - optics_at(scatterer.transmitted)), axis=0)

    whole = jnp.ones_like(p.weight)
    absorbed = fates.absorbed
    before = energy
    for i, (s, d, outcome) in enumerate(zip(setting.surfaces, met, outcomes)):
        if not s.plate or outcome is None:
            continue
        scatterer = plan.surfaces[i]
        passed = p.alive & (d < FAR) & ((d < flight.distance) | ~flight.event) & (outcome == THROUGH)
        arrived = jnp.where(passed[:, None], _arriving(setting, optics, before, met, outcomes, i), 0.0)
        absorbed = absorbed.at[scatterer.material].add(lost(scatterer, arrived, whole))
        through = optics_at(scatterer.transmitted) / (1.0 - plan.lobe)
        energy = jnp.where(passed[:, None], energy * through, energy)

    gone = jnp.where(flight.escaped[:, None], energy, 0.0)
    up = (p.w[2] > 0)[:, None]
    late = jnp.where(flight.late[:, None], energy, 0.0)
    x = along(p.x, p.w, jnp.where(flight.event, flight.distance, 0.0))
    landed = flight.landed_on(events, limit)
    hit = collide(setting, x, p.w, flight.cell, flight.collided, landed, draw)
    energy = jnp.where(flight.event[:, None], energy, 0.0)
    for scatterer in (plan.leaf, plan.bark):
        if scatterer is not None:
            here = flight.collided & (hit.material == scatterer.material)
            arrived = jnp.where(here[:, None], energy, 0.0)
            absorbed = absorbed.at[scatterer.material].add(lost(scatterer, arrived, whole))
    on_ground = fates.on_ground
    for s, here, scatterer in zip(setting.surfaces, landed, plan.surfaces):
        arrived = jnp.where(here[:, None], energy, 0.0)
        scattered = s.by_place(x, s.law.albedo(p.w, s.lit_normal(x, p.w)))
        absorbed = absorbed.at[scatterer.material].add(lost(scatterer, arrived, scattered))
        if not s.plate:
            on_ground = on_ground + jnp.sum(arrived, axis=0)

    letter = jnp.maximum(hit.letter, 0)
    energy = energy * optics[letter] * (hit.ratio * hit.onward)[:, None]
    alive = flight.event & (jnp.max(energy, axis=1) > 0)
    # Russian roulette.
    chance = jnp.minimum(jnp.max(energy, axis=1) / _FAINT, 1.0)
    kept = alive & (jax.random.uniform(end_key, chance.shape, chance.dtype) < chance)
    energy = jnp.where(kept[:, None], energy / jnp.where(kept, chance, 1.0)[:, None], 0.0)
    photons = Photons(x, hit.w, p.path, p.weight, p.history, hit.on, hit.sent, kept)
    fates = Fates(
        absorbed,
        fates.up + jnp.sum(jnp.where(up, gone, 0.0), axis=0),
        fates.down + jnp.sum(jnp.where(up, 0.0, gone), axis=0),
        on_ground,
        fates.unfollowed + jnp.sum(late, axis=0),
    )
    return _Walk(photons, energy, fates, walk.order + 1)


def _arriving(
    setting: Setting, optics: Array, energy: Array, met: list[Scalar], outcomes: list, number: int
) -> Array:
    """The energy at a plate on the way, after those that lie before it."""
    plan = setting.plan
    for j, (s, d, outcome) in enumerate(zip(setting.surfaces, met, outcomes)):
        scatterer = plan.surfaces[j]
        if j == number or not s.plate or scatterer.transmitted < 0:
            continue
        nearer = (d < met[number]) & (outcome == THROUGH)
        through = optics[scatterer.transmitted][None, :] / (1.0 - plan.lobe)
        energy = jnp.where(nearer[:, None], energy * through, energy)
    return energy
