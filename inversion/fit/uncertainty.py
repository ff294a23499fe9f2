r"""Standard errors of a fit, and which unknowns the data do not constrain.

With whitened Jacobian J and prior precision P, H = J^T J + P, the covariance of the fitted values is

    H^-1 (J^T W J + P) H^-1  +  covariance of (H^-1 J^T d) / batches,

with W the share of the weights' variance that is measurement noise, and d the deviations of the simulation's
batches from their mean. The second term is the simulation's own noise, with all correlation between its bins
and wavelengths. The diagonal of H^-1 P is the share of what is known of each unknown that is the prior's.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Smallest eigenvalue of the correlation form of H at which a combination counts as determined.
_COLLINEAR = 1e-6


class Errors(NamedTuple):
    """Covariance of the unknowns in natural units.

    - `covariance`: of all unknowns. Open ones have an infinite variance and no covariance with the others,
      whose covariance is as if the open ones were free.
    - `simulation`: standard errors from the simulation's noise alone.
    - `open`: whether the data do not constrain the unknown.
    - `inverse`: of the information H; zero where no eigenvalue tells.
    - `prior_share`: of the information on each unknown, from 0 (all from the data) to 1 (all from the prior).
    - `averaging`: H^-1 J^T J, how the estimates follow the truth.
    """

    covariance: Float[np.ndarray, "n n"]
    simulation: Float[np.ndarray, " n"]
    open: np.ndarray
    inverse: Float[np.ndarray, "n n"]
    prior_share: Float[np.ndarray, " n"]
    averaging: Float[np.ndarray, "n n"]


def errors_of(
    jacobian: Float[np.ndarray, "data n"],
    precision: Float[np.ndarray, "n n"],
    width: Float[np.ndarray, " n"],
    measured: Float[np.ndarray, " data"],
    deviations: Float[np.ndarray, "batches data"] | None,
    basis: Float[np.ndarray, "n n"] | None = None,
) -> Errors:
    """Covariance at the solution.

    An unknown is open if its standard error exceeds the width of its bounds, alone or in combination with
    others.

    **Arguments:**

    - `jacobian`: whitened, in natural units.
    - `precision`: matrix of the prior, 0 where there is none.
    - `width`: of the bounds.
    - `measured`: measurement variance over the variance used for whitening.
    - `deviations`: of each batch from their mean, whitened.
    - `basis`: columns in which a prior that correlates unknowns is the identity. Default None: there is none.

    **Returns:** an `Errors`.
    """
    n = width.size
    columns = np.eye(n) if basis is None else basis
    data = jacobian.T @ jacobian
    information = columns.T @ (data + precision) @ columns
    mixed = np.any(columns != np.diag(np.diag(columns)), axis=0)
    opened = np.diag(information) * np.where(mixed, 1.0, width) ** 2 < 1.0 - 1e-6
    own = np.diag(precision)
    alone = own / np.where(own > 0, own + np.diag(data), 1.0)
    keep = np.flatnonzero(~opened)
    norm = np.sqrt(np.diag(information)[keep])
    value, vector = np.linalg.eigh(information[np.ix_(keep, keep)] / np.outer(norm, norm))
    known = value > _COLLINEAR
    opened[keep] |= np.any(vector[:, ~known] ** 2 > 1e-3, axis=1)
    inverse = np.zeros((n, n))
    inverse[np.ix_(keep, keep)] = (
        (vector[:, known] / value[known]) @ vector[:, known].T / np.outer(norm, norm)
    )
    inverse = columns @ inverse @ columns.T
    share = np.clip(np.where(opened, alone, np.diag(inverse @ precision)), 0.0, 1.0)
    middle = (jacobian.T * measured) @ jacobian + precision
    covariance = inverse @ middle @ inverse
    simulation = np.zeros((n, n))
    if deviations is not None and len(deviations) > 1:
        moved = deviations @ jacobian @ inverse
        simulation = moved.T @ moved / (len(moved) * (len(moved) - 1))
    covariance = covariance + simulation
    opened |= np.diag(covariance) > width**2
    covariance[opened, :] = 0.0
    covariance[:, opened] = 0.0
    covariance[opened, opened] = np.inf
    simulated = np.where(opened, 0.0, np.sqrt(np.diag(simulation)))
    return Errors(covariance, simulated, opened, inverse, share, inverse @ data)


def correlation_of(covariance: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Correlation matrix; unknowns of infinite or zero variance have no correlation with others."""
    std = np.sqrt(np.diag(covariance))
    fine = np.isfinite(std) & (std > 0)
    safe = np.where(fine, std, 1.0)
    correlation = np.where(np.outer(fine, fine), np.where(np.isfinite(covariance), covariance, 0.0), 0.0)
    correlation = correlation / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    return correlation


def decrement(jacobian: Float[np.ndarray, "data n"], residual: Float[np.ndarray, " data"]) -> float:
    """Length of a Gauss-Newton step in standard errors: the root of the fall in chi-squared."""
    norm = np.linalg.norm(jacobian, axis=0)
    seen = norm > 0
    if not np.any(seen):
        return 0.0
    basis, value, _ = np.linalg.svd(jacobian[:, seen] / norm[seen], full_matrices=False)
    return float(np.linalg.norm(basis[:, value > 1e-3].T @ residual))
