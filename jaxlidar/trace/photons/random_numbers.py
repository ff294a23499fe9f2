"""Random numbers for photons: Kronecker sequences with a random shift, one for each order and dimension.

Photon i takes the uniform number

    u = frac(z i + s)

in each dimension, in 32-bit integer arithmetic. The shift s is random, so that every number is uniform and
every estimate unbiased, whatever z is (a Cranley-Patterson rotation; Kronecker sequences are the lattices of
any number of points). For the first collision the z of all D dimensions form a sequence of low discrepancy
(Roberts's R_D: z_j = phi^-j for j = 1 ... D, with phi the root of x^(D+1) = x + 1); later z is random, which
makes photons nearly independent in pairs. This costs two integer operations, where a counter-based generator
costs fifty.

Photons of one batch are not independent of one another: standard errors come from batches with independent
keys (randomised quasi-Monte Carlo; L'Ecuyer and Lemieux 2000, Manage. Sci. 46, 1214).
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt32

Uniform = Float[Array, "..."]


class PhotonDraws(eqx.Module):
    """The uniform numbers of one order of a photon's path, by what they decide.

    - `flight`: the optical depth at which the flight ends.
    - `choice`: the material that is hit, and reflection or transmission.
    - `normal`: the normal of the facet that is hit.
    - `direction`: the direction onward.
    - `plates_ahead`, `plates_behind`: for each plate, whether the flight, and the return path to the sensor,
      meets the plate or one of its gaps.
    """

    flight: Uniform
    choice: Uniform
    normal: tuple[Uniform, Uniform]
    direction: tuple[Uniform, Uniform]
    plates_ahead: tuple[Uniform, ...]
    plates_behind: tuple[Uniform, ...]

    @staticmethod
    def from_numbers(numbers: Sequence[Uniform], n_plates: int) -> "PhotonDraws":
        """Sort six numbers, and two or one for each plate, by what they decide."""
        flight, choice, n1, n2, d1, d2, *plates = numbers
        return PhotonDraws(
            flight, choice, (n1, n2), (d1, d2), tuple(plates[:n_plates]), tuple(plates[n_plates:])
        )

    @staticmethod
    def dimensions(n_plates: int, *, return_path: bool = True) -> int:
        """Return how many numbers an order takes, with or without a return path to the sensor."""
        return 6 + n_plates * (2 if return_path else 1)


class Lattices(eqx.Module):
    """Uniform numbers in (0, 1) for each photon, order and dimension: frac(`step` * photon + `shift`)."""

    step: UInt32[Array, "orders dims"]
    shift: UInt32[Array, "orders dims"]

    def __call__(self, photon: UInt32[Array, "*photons"], order: Array) -> list[Float[Array, "*photons"]]:
        """Return one array for each dimension."""
        return [
            to_unit(photon * self.step[order, d] + self.shift[order, d]) for d in range(self.step.shape[1])
        ]


def random_words(key: PRNGKeyArray, count: int) -> UInt32[Array, "count"]:
    """Return the first random words of a key; those of a smaller count are the first of them.

    That holds for JAX's default generator (partitionable Threefry), which numbers words by their position;
    rays and photons of a batch rely on it.

    A program draws everything from one call, because compiling each generator takes a while.
    """
    return jax.random.bits(key, (count,), jnp.uint32)


def shifted_lattices(words: UInt32[Array, "words"], orders: int, dims: int) -> Lattices:
    """Return lattices of `dims` dimensions for `orders` collisions, from two random words for each number."""
    words = words.reshape(orders, 2, dims)
    # Odd steps: photons then take each of the 2^32 values of a dimension before one repeats.
    step, shift = words[:, 0] | jnp.uint32(1), words[:, 1]
    roots = np.roots([1.0, *[0.0] * (dims - 1), -1.0, -1.0])
    phi = float(np.real(roots[np.argmax(np.real(roots))]))
    golden = np.floor(2.0**32 * ((1.0 / phi ** np.arange(1, dims + 1)) % 1.0)).astype(np.uint32)
    return Lattices(step.at[0].set(jnp.asarray(golden)), shift)


def to_unit(bits: UInt32[Array, "*s"]) -> Float[Array, "*s"]:
    """Convert random words to uniform numbers in the open interval (0, 1)."""
    if jnp.finfo(jnp.result_type(float)).bits == 64:
        return (bits.astype(float) + 0.5) * 2.0**-32
    # 23 bits: with the half added, single precision rounds none of them to 0 or 1.
    return ((bits >> 9).astype(float) + 0.5) * 2.0**-23
