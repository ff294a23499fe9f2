"""Flights: what a photon meets next, and how far it flies."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._vectors import FAR, Scalar, with_derivative_of
from jaxlidar.trace.march import free_flight
from jaxlidar.trace.photons import EVENT, GAP, THROUGH, Photons, ratio_of, stop
from jaxlidar.trace.setting import Setting


class Flight(eqx.Module):
    """How flights end: in the medium, on a surface, after the window, or never.

    - `collided`, `landed`, `late`, `escaped`: which of these.
    - `cell`: the last voxel.
    - `distance`: flown, m.
    - `density`: ratio of the density of that distance.
    - `moved`: derivatives of the optical depth flown, where scores are asked for.
    """

    collided: Bool[Array, "*photons"]
    landed: Bool[Array, "*photons"]
    late: Bool[Array, "*photons"]
    escaped: Bool[Array, "*photons"]
    cell: Int[Array, "*photons"]
    distance: Float[Array, "*photons"]
    density: Float[Array, "*photons"]
    moved: Float[Array, "ends columns photons"] | None = None

    @property
    def event(self) -> Bool[Array, "*photons"]:
        """Whether anything was hit."""
        return self.collided | self.landed

    def landed_on(self, events: list[Scalar], limit: Scalar) -> list[Bool[Array, "*photons"]]:
        """For each surface, whether the flight ends on it."""
        return [self.landed & (event <= limit) for event in events]


def fly(
    setting: Setting,
    p: Photons,
    limit: Float[Array, "photons"],
    budget: Float[Array, "photons"],
    u: Float[Array, "ends photons"],
) -> Flight:
    """Let photons fly to collisions at the optical depths -log(u), to a surface at `limit`, or on.

    `budget` is the length in m that is left of the window. A flight has one end for each number in `u`.
    """
    reach = jnp.minimum(limit, budget)
    wide = functools.partial(jnp.broadcast_to, shape=u.shape)
    if setting.medium is None:
        collided = in_medium = jnp.zeros(u.shape, bool)
        distance, density = wide(reach), jnp.ones_like(u)
        cell, moved = jnp.zeros(u.shape, jnp.int32), None
    else:
        medium, target = setting.medium, -jnp.log(u)
        steps, box = setting.plan.march_steps, setting.occupied
        how = {"reverse": setting.reverse, "scores": setting.scores}
        free = free_flight(medium, p.x, p.w, target, reach, p.alive, steps, box, **how)
        collided, cell, moved = free.collided, free.cell, free.moved
        k = jnp.where(collided, jax.vmap(medium.extinction, (0, None))(cell, p.w), 1.0)
        chord = jnp.where(collided, free.chord, 1.0)
        part = jnp.clip((target - free.depth) / jnp.maximum(k * chord, 1e-30), 0.0, 1.0)
        part = stop(jnp.where(collided, part, 0.0))
        depth = jnp.where(collided, free.depth + part * k * chord, wide(free.total))
        distance = jnp.where(collided, free.entered + part * chord, wide(reach))
        density = jnp.exp(stop(depth) - depth) * chord / stop(chord)
        density = with_derivative_of(jnp.ones_like(density), density)
        in_medium = ~collided & wide(free.distance >= budget)
    alive = wide(p.alive)
    landed = alive & ~collided & wide(limit < budget)
    collided = alive & collided
    nothing = alive & ~collided & ~landed
    late = nothing & (wide(limit < FAR) | in_medium)
    return Flight(collided, landed, late, nothing & ~late, cell, distance, density, moved)


def events_of(setting: Setting, met: list[Scalar], outcomes: list) -> list[Scalar]:
    """Distance to each surface if the photon will stop there, else FAR."""
    return [
        d if not s.plate else jnp.where(o == EVENT, d, FAR)
        for d, s, o in zip(met, setting.surfaces, outcomes)
    ]


def nearest(p: Photons, events: list[Scalar]) -> Scalar:
    """Distance to the nearest surface at which the photon stops."""
    limit = jnp.full_like(p.weight, FAR)
    for d in events:
        limit = jnp.minimum(limit, d)
    return limit


def plates_ahead(setting: Setting, p: Photons, ahead: tuple[Scalar, ...]):
    """Distance to each surface, what will happen at each plate, and the density ratio of that outcome."""
    met, outcomes, ratios = [], [], []
    drawn = iter(ahead)
    for i, s in enumerate(setting.surfaces):
        distance = s.distance(p.x, p.w)
        met.append(distance if s.shape.lights_itself else jnp.where(p.on == i, FAR, distance))
        if not s.plate:
            outcomes.append(None)
            ratios.append(None)
            continue
        v, c = next(drawn), jnp.broadcast_to(s.coverage, p.weight.shape)
        hit = v < c
        outcome = jnp.where(hit, EVENT, GAP)
        if s.straight and setting.plan.surfaces[i].transmitted >= 0:
            # The lobe is chosen with the number that decided that the plate was hit.
            outcome = jnp.where(hit & (v >= c * setting.plan.lobe), THROUGH, outcome)
        outcomes.append(outcome)
        ratios.append(ratio_of(jnp.where(hit, c, 1.0 - c)))
    return met, outcomes, ratios
