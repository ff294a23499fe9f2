"""Noise of a record's samples, and whitening by it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import linalg


class Noise(NamedTuple):
    """Samples' own noise, and what is common to samples.

    - `alone`: (samples,) standard deviation of each sample's own noise.
    - `common`: (samples, lags) what one standard deviation of each of several other errors does to the
      samples, or None.
    - `correlation`: (samples, samples) of the samples' own noise, or None where it is independent.
    """

    alone: Float[np.ndarray, " samples"]
    common: Float[np.ndarray, "samples lags"] | None = None
    correlation: Float[np.ndarray, "samples samples"] | None = None

    @property
    def sigma(self) -> Float[np.ndarray, " samples"]:
        """Standard deviation of each sample, of all its noise."""
        if self.common is None:
            return self.alone
        return np.sqrt(self.alone**2 + np.sum(self.common**2, axis=1))

    def white(self, x: Float[np.ndarray, "samples ..."]) -> Float[np.ndarray, "samples ..."]:
        """Differences, or columns of them, made independent and of unit variance."""
        own = x / self.alone.reshape(-1, *(1,) * (x.ndim - 1))
        if self.common is None and self.correlation is None:
            return own
        total = np.eye(self.alone.size) if self.correlation is None else self.correlation
        if self.common is not None:
            shared = self.common / self.alone[:, None]
            total = total + shared @ shared.T
        return linalg.solve_triangular(np.linalg.cholesky(total), own, lower=True)


def correlation_between(
    neighbours: float, used: Bool[np.ndarray, "wavelengths bins"]
) -> Float[np.ndarray, "samples samples"] | None:
    """Correlations of the samples that are used: powers of that of neighbours, or None where that is 0."""
    if neighbours == 0:
        return None
    wavelength, sample = np.nonzero(used)
    apart = np.abs(sample[:, None] - sample)
    return np.where(wavelength[:, None] == wavelength, neighbours**apart, 0.0)


def blocks(
    common: Float[np.ndarray, "wavelengths bins lags"] | None, used: Bool[np.ndarray, "wavelengths bins"]
) -> Float[np.ndarray, "samples all_lags"] | None:
    """The common errors of the samples that are used; those of different wavelengths are independent."""
    if common is None:
        return None
    return np.asarray(linalg.block_diag(*(one[which] for one, which in zip(common, used))))
