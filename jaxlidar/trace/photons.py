"""The state of photons, and of their collisions."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._vectors import Scalar, Vec, with_derivative_of

stop = lax.stop_gradient

# What happens to a photon at a plate in its way.
GAP, EVENT, THROUGH = 0, 1, 2


class Scattering(eqx.Module):
    """How photons were sent on: by which of the setting's laws, from which direction, about which normal."""

    law: Int[Array, "photons"]
    incident: Vec
    normal: Vec


class Photons(eqx.Module):
    """The state of a chunk of photons. `on` is the surface from which a photon starts, or -1.

    `sent` is None where no derivatives are asked for, which alone need it.
    `history`, `tints` and `entry`: see `jaxlidar.trace.labels`. `score`: see `jaxlidar.trace.scores`.
    """

    x: Vec
    w: Vec
    path: Float[Array, "photons"]
    weight: Float[Array, "photons"]
    history: Int[Array, "photons"]
    on: Int[Array, "photons"]
    sent: Scattering | None
    alive: Bool[Array, "photons"]
    tints: tuple[Float[Array, "photons"], ...] = ()
    entry: tuple[Float[Array, "photons"], Float[Array, "photons"]] | None = None
    score: Float[Array, "photons columns"] | None = None


class Hit(eqx.Module):
    """A collision.

    - `material`, `letter`: what was hit, and the letter that was drawn.
    - `ratio`: density ratio of the collision.
    - `onward`: weight ratio of going on along `w`.
    - `on`: the surface, or -1.
    - `reflected`, `transmitted`: letters of what returns from here, or -1.
    - `normal`: of the facet or of the lit side.
    - `sent`: how the photon goes on.
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
    sent: Scattering


class Met(eqx.Module):
    """What of a collision decides how it is seen. `normal` is None where that does not.

    Else see `Hit`.
    """

    material: Int[Array, "photons"]
    on: Int[Array, "photons"]
    reflected: Int[Array, "photons"]
    transmitted: Int[Array, "photons"]
    normal: Vec | None


def merge(where: Bool[Array, "photons"], a: Hit, b: Hit) -> Hit:
    """`a` where `where` holds, else `b`."""
    return jax.tree.map(lambda p, q: jnp.where(where, p, q), a, b)


def ratio_of(density: Scalar) -> Scalar:
    """One, with the relative derivative of a density; no derivative where the density is zero."""
    held = stop(density)
    safe = jnp.where(held == 0, 1.0, held)
    return with_derivative_of(jnp.ones_like(held), jnp.where(held == 0, 1.0, density / safe))
