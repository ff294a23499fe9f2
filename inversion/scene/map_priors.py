r"""Priors of a fit of many records: residuals that are sparse, for unknowns of a hundred thousand values.

The priors of all unknowns add to half of chi-squared

    1/2 |r(x)|^2 + sum of x_i / mean_i,

with the residuals r = (x - m) / s of a normal prior, (ln x - m) / s of a log-normal one, and (x_i - x_j) /
difference of the neighbours of a Markov field. The second sum is that of exponential priors. Each residual
depends on one value or two, so that products with the Jacobian of r and its transpose cost as much as r.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from inversion.fit.unknowns import BoundUnknown, split_by_name


class MapPriors:
    """The priors of unknowns that are flattened to one vector, x."""

    def __init__(self, unknowns: Sequence[BoundUnknown]):
        self.unknowns = unknowns
        rates = [
            0.0 if u.field is None or u.field.mean is None else 1.0 / float(u.field.mean) for u in unknowns
        ]
        self.rate = np.repeat(rates, [u.start.size for u in unknowns])

    def cost_and_gradient(self, x: Float[np.ndarray, " n"]) -> tuple[float, Float[np.ndarray, " n"]]:
        """Return -ln of the prior density up to a constant, and its gradient."""
        residual = self.residuals(x)
        # The exponential prior is linear in x, and has no residual.
        cost = 0.5 * sum(float(np.sum(r**2)) for r in residual) + float(self.rate @ x)
        return cost, self.pull_back(x, residual) + self.rate

    def residuals(self, x: Float[np.ndarray, " n"]) -> list[np.ndarray]:
        """Return r(x)."""
        residual = []
        for u, value in zip(self.unknowns, split_by_name(x, self.unknowns).values()):
            if u.prior is not None:
                mean, std = u.prior
                transformed = np.log(np.maximum(value, _LEAST)) if u.is_log_prior else value
                residual.append(np.asarray((transformed - mean) / std))
            residual += [np.diff(value, axis=axis) / size for axis, size in _differences(u)]
        return residual

    def push_forward(self, x: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"]) -> list[np.ndarray]:
        """Return the product of the Jacobian of r with a vector."""
        pushed = []
        values, tangents = (split_by_name(a, self.unknowns).values() for a in (x, v))
        for u, value, tangent in zip(self.unknowns, values, tangents):
            if u.prior is not None:
                pushed.append(np.asarray(tangent / _spread(u, value)))
            pushed += [np.diff(tangent, axis=axis) / size for axis, size in _differences(u)]
        return pushed

    def pull_back(self, x: Float[np.ndarray, " n"], c: Sequence[np.ndarray]) -> Float[np.ndarray, " n"]:
        """Return the product of the transposed Jacobian of r with vectors like r."""
        cotangents, pulled = iter(c), []
        for u, value in zip(self.unknowns, split_by_name(x, self.unknowns).values()):
            total = np.zeros(value.shape)
            if u.prior is not None:
                total += next(cotangents) / _spread(u, value)
            for axis, size in _differences(u):
                # The transpose of differences: -c_0, c_0 - c_1, ..., c_last.
                ends = [(1, 1) if k == axis else (0, 0) for k in range(value.ndim)]
                total -= np.diff(np.pad(next(cotangents), ends), axis=axis) / size
            pulled.append(total.ravel())
        return np.concatenate(pulled)

    def diagonal(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return the diagonal of the product of the transposed Jacobian of r with itself."""
        diagonal = []
        for u, value in zip(self.unknowns, split_by_name(x, self.unknowns).values()):
            total = np.zeros(value.shape)
            if u.prior is not None:
                total += 1.0 / _spread(u, value) ** 2
            # A value is in the difference to each of its neighbours: one at an end, two between.
            for axis, size in _differences(u):
                along = np.moveaxis(total, axis, 0)
                along[1:] += 1.0 / size**2
                along[:-1] += 1.0 / size**2
            diagonal.append(total.ravel())
        return np.concatenate(diagonal)


# Logarithms of values below this are those of it: a log-normal prior may have a bound at zero.
_LEAST = 1e-300


def _spread(u: BoundUnknown, value: np.ndarray) -> np.ndarray:
    """Return the standard deviation of a value; of a log-normal prior, x times that of its logarithm."""
    assert u.prior is not None
    return np.asarray(u.prior[1] * np.maximum(value, _LEAST) if u.is_log_prior else u.prior[1])


def _differences(u: BoundUnknown) -> list[tuple[int, float]]:
    """Return the axes along which a Markov field is smooth, and the standard deviation of differences."""
    if u.field is None:
        return []
    sizes = np.broadcast_to(np.asarray(u.field.difference, float), (u.start.ndim,))
    return [(axis, float(size)) for axis, size in enumerate(sizes) if np.isfinite(size)]
