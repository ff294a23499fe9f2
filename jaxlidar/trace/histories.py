"""Scattering histories: how often each letter (leaf.R, leaf.T, ground.R, ...) occurred on a path.

The product of reflectances does not depend on the order of the scatterings, so a history is a tuple of
exponents. All of total degree up to the longest path are numbered by degree: the histories of short paths
come first. There are C(degree + letters, letters) of them.
"""

import dataclasses
import functools
import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


@dataclasses.dataclass(frozen=True, eq=False)
class Histories:
    """The table of histories of up to `degree` scatterings of `letters` kinds.

    - `exponents`: (histories, letters), the degree not decreasing along the first axis.
    - `successor`: (histories, letters), the history after one more scattering of a letter; where that
      would exceed the degree, the history itself.
    """

    exponents: np.ndarray
    successor: np.ndarray

    @property
    def count(self) -> int:
        """Number of histories."""
        return len(self.exponents)

    @property
    def letters(self) -> int:
        """Number of letters."""
        return self.exponents.shape[1]

    @property
    def degree(self) -> int:
        """Largest number of scatterings."""
        return int(self.exponents[-1].sum()) if self.letters else 0

    def monomials(self, optics: Float[Array, "letters wavelengths"]) -> Float[Array, "histories wavelengths"]:
        """Product over the letters of optics to the power of the history's exponents.

        Powers are repeated products: exact, with finite derivatives, at zero too.
        """
        powers, square = jnp.ones((1, *optics.shape), optics.dtype), optics[None]
        while len(powers) <= self.degree:
            powers, square = jnp.concatenate([powers, powers * square]), square * square
        product = jnp.ones((self.count, optics.shape[1]), optics.dtype)
        for letter in range(self.letters):
            product = product * powers[self.exponents[:, letter], letter]
        return product


@functools.cache
def histories(letters: int, degree: int) -> Histories:
    """All histories of at most `degree` scatterings, numbered by degree."""
    rows: list[list[int]] = []
    for total in range(degree + 1):
        # Stars and bars: `letters - 1` bars divide `total` stars.
        for bars in itertools.combinations(range(total + letters - 1), max(letters - 1, 0)):
            edges = (-1, *bars, total + letters - 1)
            rows.append([b - a - 1 for a, b in itertools.pairwise(edges)])
    if letters == 0:
        rows = [[]]
    exponents = np.array(rows, dtype=np.int32).reshape(len(rows), letters)
    number = {tuple(row): i for i, row in enumerate(exponents.tolist())}
    successor = np.empty_like(exponents)
    for i, row in enumerate(exponents.tolist()):
        for k in range(letters):
            grown = (*row[:k], row[k] + 1, *row[k + 1 :])
            successor[i, k] = number.get(grown, i)
    return Histories(exponents, successor)
