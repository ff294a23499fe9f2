"""Random numbers for photons: randomly shifted lattices, one per order and dimension, or independent ones.

Photon i takes frac(z i + s) in each dimension, in 32-bit integer arithmetic. The shift s is random, so every
number is uniform and every estimate unbiased, whatever z is. For the first collision z belongs to a lattice
of low discrepancy (Roberts's generalised golden ratio); later it is random, which makes any two photons
independent. This costs two integer operations where a counter-based generator costs fifty. Photons of one
batch are not independent: standard errors come from batches with independent keys. Independent numbers serve
for comparison.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt32

Uniform = Float[Array, "..."]


class Draw(eqx.Module):
    """The uniform numbers of one order of a photon's path, by what they decide.

    - `flight`: where the flight ends.
    - `choice`: which material is hit, and whether light is reflected.
    - `normal`: of the facet that is hit.
    - `direction`: onward.
    - `ahead`, `behind`: for each plate, whether light meets it on its way, and on the way back to the sensor.
    """

    flight: Uniform
    choice: Uniform
    normal: tuple[Uniform, Uniform]
    direction: tuple[Uniform, Uniform]
    ahead: tuple[Uniform, ...]
    behind: tuple[Uniform, ...]

    @staticmethod
    def of(numbers: Sequence[Uniform], plates: int) -> "Draw":
        """A `Draw` from six numbers and two, or one, for each plate."""
        a, b, c, d, e, f, *rest = numbers
        return Draw(a, b, (c, d), (e, f), tuple(rest[:plates]), tuple(rest[plates:]))

    @staticmethod
    def dimensions(plates: int, *, back: bool = True) -> int:
        """How many numbers an order takes. `back`: whether light returns from every collision."""
        return 6 + plates * (2 if back else 1)


class Lattices(eqx.Module):
    """Uniform numbers in (0, 1) for each photon, order and dimension, from shifted lattices."""

    step: UInt32[Array, "orders dims"]
    shift: UInt32[Array, "orders dims"]

    def __call__(self, photon: UInt32[Array, "*photons"], order: Array) -> list[Float[Array, "*photons"]]:
        """One array for each dimension."""
        return [
            to_unit(photon * self.step[order, d] + self.shift[order, d]) for d in range(self.step.shape[1])
        ]


class Independent(eqx.Module):
    """Independent uniform numbers in (0, 1) for each photon, order and dimension."""

    key: PRNGKeyArray
    dims: int = eqx.field(static=True)

    def __call__(self, photon: UInt32[Array, "photons"], order: Array) -> list[Float[Array, "photons"]]:
        """One array for each dimension. Photons come in blocks, each known by its first photon."""
        key = jax.random.fold_in(jax.random.fold_in(self.key, order), photon[0])
        return list(to_unit(jax.random.bits(key, (self.dims, photon.size), jnp.uint32)))


def words(key: PRNGKeyArray, count: int) -> UInt32[Array, "count"]:
    """The first random words of a key; those of a smaller count are the first of them.

    All that a program draws it takes from one call, for compiling each generator takes a while.
    """
    return jax.random.bits(key, (count,), jnp.uint32)


def lattices(drawn: UInt32[Array, "words"], orders: int, dims: int) -> Lattices:
    """Lattices for `orders` collisions of `dims` numbers each, from two random words for each number."""
    drawn = drawn.reshape(orders, 2, dims)
    step, shift = drawn[:, 0] | jnp.uint32(1), drawn[:, 1]
    root = np.roots([1.0, *[0.0] * (dims - 1), -1.0, -1.0])
    ratio = float(np.real(root[np.argmax(np.real(root))]))
    golden = np.floor(2.0**32 * ((1.0 / ratio ** np.arange(1, dims + 1)) % 1.0)).astype(np.uint32)
    return Lattices(step.at[0].set(jnp.asarray(golden)), shift)


def to_unit(bits: UInt32[Array, "*s"]) -> Float[Array, "*s"]:
    """Uniform numbers in (0, 1) from random words."""
    if jnp.finfo(jnp.result_type(float)).bits == 64:
        return (bits.astype(float) + 0.5) * 2.0**-32
    return ((bits >> 9).astype(float) + 0.5) * 2.0**-23
