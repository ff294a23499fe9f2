"""Scattering histories: how often each scatterer channel (leaf.R, leaf.T, ground.R, ...) occurred on a path.

The product of reflectances and transmittances does not depend on the order of scatterings, so that a history
is a tuple of exponents (n_1, ..., n_c), and its optical weight the monomial

    prod over channels s of  optics_s ** n_s,

with optics_s the reflectance or transmittance of the channel. A scatterer channel is reflection, or
transmission, by one material; detector channels are not meant.

All histories with n_1 + ... + n_c <= degree are numbered by their total degree: those of short paths come
first. There are C(degree + c, c) of them.
"""

import dataclasses
import functools
import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


@dataclasses.dataclass(frozen=True, eq=False)
class Histories:
    """The table of histories of up to `degree` scatterings by a number of channels.

    - `exponents`: (histories, channels), the degree not decreasing along the first axis.
    - `next_history`: (histories, channels), index of the history after one more scattering by a channel;
      where that would exceed the degree, the history itself.
    """

    exponents: np.ndarray
    next_history: np.ndarray

    @property
    def count(self) -> int:
        """Number of histories."""
        return len(self.exponents)

    @property
    def n_channels(self) -> int:
        """Number of scatterer channels."""
        return self.exponents.shape[1]

    @property
    def degree(self) -> int:
        """Largest number of scatterings."""
        return int(self.exponents[-1].sum()) if self.n_channels else 0

    def monomials(
        self, optics: Float[Array, "channels wavelengths"]
    ) -> Float[Array, "histories wavelengths"]:
        """Return the product over channels of optics to the power of each history's exponents.

        Powers are repeated products: exact, with finite derivatives at zero too, where `**` has NaN.
        """
        powers, nth_power = jnp.ones((1, *optics.shape), optics.dtype), optics[None]
        # Doubling: powers 0 .. n - 1 times the n-th power are powers n .. 2 n - 1.
        while len(powers) <= self.degree:
            powers, nth_power = jnp.concatenate([powers, powers * nth_power]), nth_power * nth_power
        product = jnp.ones((self.count, optics.shape[1]), optics.dtype)
        for channel in range(self.n_channels):
            product = product * powers[self.exponents[:, channel], channel]
        return product


@functools.cache
def histories(n_channels: int, degree: int) -> Histories:
    """Return all histories of at most `degree` scatterings, numbered by degree.

    1. For each total degree: all ways to divide it among the channels.
    2. Look up, for each history and channel, the history with one scattering more.
    """
    rows: list[list[int]] = []
    for total in range(degree + 1):
        # Stars and bars: `n_channels - 1` bars divide `total` stars.
        for bars in itertools.combinations(range(total + n_channels - 1), max(n_channels - 1, 0)):
            edges = (-1, *bars, total + n_channels - 1)
            rows.append([b - a - 1 for a, b in itertools.pairwise(edges)])
    if n_channels == 0:
        rows = [[]]
    exponents = np.array(rows, dtype=np.int32).reshape(len(rows), n_channels)
    # Cached and built on the host: tables are constants of compiled programs.
    number = {tuple(row): i for i, row in enumerate(exponents.tolist())}
    next_history = np.empty_like(exponents)
    for i, row in enumerate(exponents.tolist()):
        for k in range(n_channels):
            grown = (*row[:k], row[k] + 1, *row[k + 1 :])
            next_history[i, k] = number.get(grown, i)
    return Histories(exponents, next_history)
