"""The order in which photons are traced: living ones first, those with a short way through the medium first.

Photons of a chunk march together until the last of them has stopped. With ways of about one length in a
chunk, fewer of them wait.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxlidar._one_function import once
from jaxlidar.trace.march import begin
from jaxlidar.trace.photons import Photons
from jaxlidar.trace.setting import Setting

# Ways without a face to cross, with at most so many, and longer ones.
CLASSES, SHORT = 3, 32
# Their counts share an integer: a chunk has fewer than 1,024 photons.
_BITS = 10


def in_order(setting: Setting, photons: Photons) -> tuple[Int[Array, "chunks size"], Int[Array, ""]]:
    """The numbers of living photons, by the length of their ways and else as they are, and how many they are.

    Zeros follow. It is a counting sort: within chunks by a running count of every class.
    """
    alive = photons.alive
    own = once(jnp.where(alive, _classes(setting, photons), CLASSES))
    ones = jnp.where(alive, 1 << (_BITS * own), 0)
    running = once(jnp.cumsum(ones, axis=1))

    def count(packed: Int[Array, "*s"], number: int) -> Int[Array, "*s"]:
        return (packed >> (_BITS * number)) & ((1 << _BITS) - 1)

    each = jnp.stack([count(running[:, -1], c) for c in range(CLASSES)])
    before = (jnp.cumsum(each.reshape(-1)) - each.reshape(-1)).reshape(each.shape)
    place = jnp.full(alive.shape, alive.size)
    for c in range(CLASSES):
        place = jnp.where(own == c, before[c][:, None] + count(running, c) - 1, place)
    number, place = jnp.arange(alive.size), once(place.reshape(-1))
    source = jnp.zeros_like(number).at[place].set(number, mode="drop")
    return source.reshape(alive.shape), jnp.sum(each)


def _classes(setting: Setting, photons: Photons) -> Int[Array, "chunks size"]:
    """0 where a photon crosses no face before it leaves the medium, 1 where these are few, and 2."""
    medium = setting.medium
    if medium is None:
        return jnp.zeros(photons.alive.shape, jnp.int32)
    x, w = lax.stop_gradient((photons.x, photons.w))
    walk = begin(medium, x, w, setting.occupied)
    across = sum(jnp.abs(w[k]) / medium.size[k] for k in range(3))
    faces = (walk.leave - walk.enter) * across
    return (faces > 0).astype(jnp.int32) + (faces > SHORT)
