"""Photons, what they hit, and the scene as constants of the photon loop."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._vectors import Scalar, Vec, with_derivative_of
from jaxlidar.planning.trace_plan import Bins, TracePlan
from jaxlidar.trace.footprint import Beam
from jaxlidar.trace.histories import Histories
from jaxlidar.trace.march import Box, Medium, columns, occupied
from jaxlidar.trace.surfaces import Surface

stop = lax.stop_gradient

# What happens to a photon at a plate in its way.
GAP, EVENT, THROUGH = 0, 1, 2


class Photons(eqx.Module):
    """The state of a chunk of photons.

    `on` is the surface a photon stands on, or -1. `facing` is the normal about which its direction was
    drawn: of length one by the cosine law, two by the equal-angle law; zero where all were alike.
    """

    x: Vec
    w: Vec
    path: Float[Array, "photons"]
    weight: Float[Array, "photons"]
    history: Int[Array, "photons"]
    on: Int[Array, "photons"]
    facing: Vec
    alive: Bool[Array, "photons"]


class Hit(eqx.Module):
    """A collision.

    - `material`, `letter`: what was hit, and the letter that was drawn.
    - `ratio`: density ratio of the collision. - `onward`: weight ratio of going on along `w`.
    - `on`: the surface, or -1. - `reflected`, `transmitted`: letters of what returns from here, or -1.
    - `normal`: of the facet or of the lit side. - `facing`: see `Photons`.
    """

    material: Int[Array, "photons"]
    letter: Int[Array, "photons"]
    ratio: Float[Array, "photons"]
    onward: Float[Array, "photons"]
    w: Vec
    on: Int[Array, "photons"]
    reflected: Int[Array, "photons"]
    transmitted: Int[Array, "photons"]
    normal: Vec
    facing: Vec


class Setting(eqx.Module):
    """The scene as constants of the photon loop."""

    beam: Beam
    medium: Medium | None
    surfaces: tuple[Surface, ...]
    trace: TracePlan = eqx.field(static=True)
    table: Histories = eqx.field(static=True)
    bins: Bins = eqx.field(static=True)
    column: Float[Array, "cells"] | None
    occupied: Box | None
    successor: Int[Array, "histories letters"]

    def __init__(
        self,
        beam: Beam,
        medium: Medium | None,
        surfaces: tuple[Surface, ...],
        trace: TracePlan,
        table: Histories,
        bins: Bins,
    ):
        self.beam, self.medium, self.surfaces = beam, medium, surfaces
        self.trace, self.table, self.bins = trace, table, bins
        self.column = columns(medium) if medium is not None and trace.vertical else None
        self.occupied = None if medium is None else occupied(medium)
        self.successor = jnp.asarray(table.successor)

    def budget(self, p: Photons) -> Float[Array, "photons"]:
        """How far photons may fly, m, so that their light can still be recorded."""
        return jnp.minimum(self.beam.budget(p.x, p.w, self.trace.last - p.path), self.trace.max_flight)

    def grow(
        self, history: Int[Array, "*photons"], letter: Int[Array, "*photons"] | int
    ) -> Int[Array, "*photons"]:
        """The history with one more scattering; unchanged where the letter is -1."""
        if isinstance(letter, int):
            return self.successor[history, letter] if letter >= 0 else history
        grown = self.successor[history, jnp.maximum(letter, 0)]
        return jnp.where(letter >= 0, grown, history)


def merge(where: Bool[Array, "photons"], a: Hit, b: Hit) -> Hit:
    """`a` where `where` holds, else `b`."""
    return jax.tree.map(lambda p, q: jnp.where(where, p, q), a, b)


def ratio_of(density: Scalar) -> Scalar:
    """One, with the relative derivative of a density; no derivative where the density is zero."""
    held = stop(density)
    safe = jnp.where(held == 0, 1.0, held)
    return with_derivative_of(jnp.ones_like(held), jnp.where(held == 0, 1.0, density / safe))
