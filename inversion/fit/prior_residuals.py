r"""Priors of a fit as residuals, and the strengths of smoothness priors by the evidence.

A normal prior with mean m and standard deviation s adds the residual (x - m) / s to a least-squares fit, a
log-normal prior (ln x - m) / s. A Gaussian process with mean m and covariance t^2 K, t its strength and
K = L L^T, adds the vector L^-1 (x - m) / t. Half of the sum of squares is -ln of the prior density, up to its
normalisation; for a log-normal prior it is the density of ln x, so that the estimate is the maximum a
posteriori in ln x. The normalisation of a Gaussian process depends on t:

    -2 ln density = |L^-1 (x - m)|^2 / t^2 + ln det K + 2 n ln t + constant.

With whitened data residuals r and Jacobian J at the fit, prior precision P, H = J^T J + P, and the simulation
linear about the fit, the evidence (the density of the data with the unknowns integrated out) obeys

    -2 ln evidence = minimum of the cost + ln det H - ln det P + constant.

A strength left to the data minimises this. To keep H regular where the data leave an unknown without Gaussian
process open, each of these gets a further prior in H, of one width of its bounds about its estimate. It has
no gradient there, and changes the comparison of strengths only for unknowns that are open.

**Source:** MacKay (1992), Neural Comput. 4, 415; Rasmussen and Williams (2006), Gaussian Processes for
Machine Learning, section 5.4.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy

from inversion.fit.unknowns import BoundUnknown

# Standard deviation of a profile's common level, in strengths, for a prior without mean.
_LEVEL_SIGMA = 3.0
# Strengths of smoothness priors, in widths of the bounds: first trial and range; largest factor of one
# update.
_FIRST_STRENGTH, _STRENGTH_RANGE, _MAX_FACTOR = 0.1, (1e-4, 3.0), 3.0
# Added to the diagonal of K: over distances far below the scale, K is singular in floating point.
_NUGGET = 1e-8


class _GaussianProcess:
    """Smoothness prior of one unknown, whose values are the `columns` of the flattened unknowns."""

    def __init__(self, unknown: BoundUnknown, columns: slice):
        assert unknown.smooth is not None
        smooth, self.columns, n_layers = unknown.smooth, columns, unknown.low.size
        mean = unknown.prior_level if smooth.mean is None else np.asarray(smooth.mean, float)
        self.mean = np.broadcast_to(mean, unknown.low.shape).ravel()
        self.has_free_strength = smooth.strength is None
        width = float(np.max(unknown.high - unknown.low))
        self.strength_range = (_STRENGTH_RANGE[0] * width, _STRENGTH_RANGE[1] * width)
        self.strength = _FIRST_STRENGTH * width if smooth.strength is None else float(smooth.strength)
        covariance = smooth.correlation(n_layers) + _NUGGET * np.eye(n_layers)
        # Both for a strength of one: a strength only scales them.
        self.cholesky = np.linalg.cholesky(covariance + (_LEVEL_SIGMA**2 if smooth.mean is None else 0.0))
        self.inverse_cholesky = scipy.linalg.solve_triangular(self.cholesky, np.eye(n_layers), lower=True)
        self.log_determinant = 2.0 * float(np.sum(np.log(np.diag(self.cholesky))))


class PriorResiduals:
    """Residuals that the priors of all unknowns add to a fit. It holds the strengths of smoothness priors."""

    def __init__(self, unknowns: Sequence[BoundUnknown]):
        def flatten(array_of: Callable[[BoundUnknown], np.ndarray]) -> np.ndarray:
            return np.concatenate([np.ravel(array_of(u)) for u in unknowns])

        self.mean = flatten(lambda u: np.zeros_like(u.low) if u.prior is None else u.prior[0])
        self.weight = flatten(lambda u: np.zeros_like(u.low) if u.prior is None else 1.0 / u.prior[1])
        self.is_log = flatten(lambda u: np.full(u.low.shape, u.is_log_prior))
        self.is_smooth = flatten(lambda u: np.full(u.low.shape, u.smooth is not None))
        self.width = flatten(lambda u: u.high - u.low)
        edges = np.cumsum([0, *(u.low.size for u in unknowns)])
        columns = [slice(a, b) for a, b in itertools.pairwise(edges)]
        self.processes = [_GaussianProcess(u, c) for u, c in zip(unknowns, columns) if u.smooth is not None]

    @property
    def centre(self) -> np.ndarray:
        """Values of zero residual; logarithms for log-normal priors."""
        centre = self.mean.copy()
        for process in self.processes:
            centre[process.columns] = process.mean
        return centre

    @property
    def whitening(self) -> np.ndarray:
        """Matrix (n, n) that makes residuals of differences from `centre`: W^T W is the prior precision."""
        whitening = np.diag(self.weight)
        for process in self.processes:
            whitening[process.columns, process.columns] = process.inverse_cholesky / process.strength
        return whitening

    def __call__(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whitened residuals, one for each value, and their Jacobian (residuals, values)."""
        # x for log-normal priors, else 1: d ln x / dx = 1 / x.
        log_argument = np.where(self.is_log, np.maximum(values, 1e-300), 1.0)
        transformed = np.where(self.is_log, np.log(log_argument), values)
        whitening = self.whitening
        return whitening @ (transformed - self.centre), whitening / log_argument

    def hessian(self, values: np.ndarray) -> np.ndarray:
        """Return half of the Hessian of the sum of squared residuals, (values, values).

        With a log-normal prior, q = (ln x - m) / s, it is (1 - s q) / (s x)^2 and not 1 / (s x)^2.
        """
        residual, jacobian = self(values)
        curvature = (
            np.where(self.is_log, self.weight * residual, 0.0) / np.where(self.is_log, values, 1.0) ** 2
        )
        return jacobian.T @ jacobian - np.diag(curvature)

    @property
    def basis(self) -> np.ndarray:
        """Columns: changes of the values that are independent, of unit variance, under smoothness priors."""
        basis = np.eye(self.mean.size)
        for process in self.processes:
            basis[process.columns, process.columns] = process.cholesky * process.strength
        return basis

    @property
    def log_determinant(self) -> float:
        """ln det of the smoothness priors' covariance, which makes costs at two strengths comparable.

        It is -2 ln of their normalisation, up to a constant.
        """
        return float(sum(p.log_determinant + 2.0 * p.mean.size * np.log(p.strength) for p in self.processes))

    @property
    def strengths(self) -> np.ndarray:
        """Strengths of the smoothness priors, in the order of the unknowns."""
        return np.array([p.strength for p in self.processes])

    @property
    def has_free_strengths(self) -> bool:
        """True if any strength is left to the data."""
        return any(p.has_free_strength for p in self.processes)

    def set_strengths(self, strengths: np.ndarray) -> None:
        """Set the strengths of the smoothness priors."""
        for process, strength in zip(self.processes, strengths):
            process.strength = float(strength)

    def maximise_evidence(self, values: np.ndarray, residual: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
        """Return the strengths of the largest evidence; strengths that are given stay as they are.

        One strength after the other is sought with the others fixed, within a factor of three of its present
        value: the simulation is linear only nearby. The fit with the new strengths, and the next call, go on.

        **Arguments:** `values`: of the fit. `residual`, `jacobian`: of the data, whitened, in natural units.
        """
        prior_residual, prior_jacobian = self(values)
        is_plain = ~self.is_smooth
        # In widths of the bounds. As all unknowns lie within their bounds, a prior of unit variance about the
        # estimates of the plain ones keeps H regular where the data leave one of them open. It is centred on
        # the estimates: no term of the gradient.
        jacobian = jacobian * self.width
        prior_jacobian = prior_jacobian * np.outer(is_plain, is_plain) * self.width
        information = jacobian.T @ jacobian + prior_jacobian.T @ prior_jacobian
        information += np.diag(is_plain.astype(float))
        gradient = jacobian.T @ residual + prior_jacobian.T @ np.where(is_plain, prior_residual, 0.0)
        strengths = self.strengths
        for i, process in enumerate(self.processes):
            if not process.has_free_strength:
                continue

            def criterion(log_strength: float, i: int = i) -> float:
                trial = np.where(np.arange(strengths.size) == i, np.exp(log_strength), strengths)
                return self._minus_two_log_evidence(values, information, gradient, trial)

            # In logarithms: a strength is positive, and its plausible range spans orders of magnitude.
            interval = process.strength * np.array([1.0 / _MAX_FACTOR, _MAX_FACTOR])
            interval = np.log(np.clip(interval, *process.strength_range))
            minimum: Any = scipy.optimize.minimize_scalar(criterion, bounds=interval, method="bounded")
            strengths[i] = np.exp(minimum.x)
        return strengths

    def _minus_two_log_evidence(
        self, values: np.ndarray, information: np.ndarray, gradient: np.ndarray, strengths: np.ndarray
    ) -> float:
        """-2 ln evidence at these strengths, up to a constant.

        `information`, `gradient`: J^T J and J^T r of data and plain priors, in widths of the bounds.
        """
        information, gradient, prior_terms = information.copy(), gradient.copy(), 0.0
        for process, strength in zip(self.processes, strengths):
            columns, whitening = process.columns, process.inverse_cholesky / strength
            residual = whitening @ (values[columns] - process.mean)
            jacobian = whitening * self.width[columns]
            information[columns, columns] += jacobian.T @ jacobian
            gradient[columns] += jacobian.T @ residual
            # |q|^2 - ln det P of this process.
            prior_terms += residual @ residual + 2.0 * process.mean.size * np.log(strength)
        # H = L L^T: the cost at its minimum is less by |L^-1 gradient|^2.
        cholesky = np.linalg.cholesky(information)
        decrease = scipy.linalg.solve_triangular(cholesky, gradient, lower=True)
        return float(prior_terms - decrease @ decrease + 2.0 * np.sum(np.log(np.diag(cholesky))))


def fixed_priors(unknowns: Sequence[BoundUnknown]) -> PriorResiduals:
    """Return priors whose strengths are all given: for Cramer-Rao bounds and profile likelihoods.

    **Raises:** ValueError for a strength left to the data.
    """
    for unknown in unknowns:
        if unknown.smooth is not None and unknown.smooth.strength is None:
            raise ValueError(
                f"unknown {unknown.name!r}: strength = None leaves the Smooth prior's strength to a fit; "
                "admissible here is a number"
            )
    return PriorResiduals(unknowns)
