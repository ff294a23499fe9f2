"""Descent of a fit with a profile, straight through its bounds.

Layers without plants lie at their lower bound, many at a time, and come off it as others change. In the free
parameter of a bounded value each would run away for many steps. So every step solves the linearised problem
within the bounds, in natural units (bounded-variable least squares), and is cut to a quarter where it does
not improve the fit: it stays within the bounds, and begins downhill.

**Source:** Stark and Parker (1995), Comput. Stat. 10, 129.
"""

from collections.abc import Generator
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy import linalg, optimize

from inversion.fit.model import Evaluation
from inversion.fit.priors import outside

if TYPE_CHECKING:
    from inversion.fit.solver import Fit, Point, Request

# Values keep off their bounds by this share of the bounds' width.
_MARGIN = 1e-5
_CUT = 0.25
# Of the information's trace, added to each unknown's own.
_RIDGE = 1e-13


def bounded_step(
    jacobian: Float[np.ndarray, "data n"],
    residual: Float[np.ndarray, " data"],
    low: Float[np.ndarray, " n"],
    high: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " n"], float]:
    """The step that makes the linearised residuals least within bounds, and its length in standard errors:
    the root of the fall in chi-squared.
    """
    width = high - low
    scaled = jacobian * width
    information = scaled.T @ scaled
    # Normal equations, for there are far more samples than unknowns; what nothing determines stays.
    information += _RIDGE * max(np.trace(information), 1e-300) * np.eye(width.size)
    root = np.linalg.cholesky(information)
    right = linalg.solve_triangular(root, -scaled.T @ residual, lower=True)
    step = optimize.lsq_linear(root.T, right, bounds=(low / width, high / width), method="bvls").x * width
    fall = residual @ residual - np.sum((residual + jacobian @ step) ** 2)
    return step, float(np.sqrt(max(fall, 0.0)))


def descend_within(
    fit: "Fit", best: "Point", small: float, stalled: tuple[tuple[int, float], ...]
) -> "Generator[Request, Evaluation, tuple[Point, bool, str]]":
    """Gauss-Newton steps within the bounds, until no step improves the fit.

    **Arguments:**

    - `small`: length of a step, in standard errors, below which the fit has converged.
    - `stalled`: pairs of rejected steps, and the length below which it has converged after so many.

    **Returns:** the best point, whether the fit converged, and how it ended.
    """
    margin = _MARGIN * (fit.high - fit.low)
    low, high = fit.low + margin, fit.high - margin
    fit.report(best, True)
    while True:
        residual, jacobian = fit.natural(best)
        values = np.clip(best.values, low, high)
        step, remaining = bounded_step(jacobian, residual, low - values, high - values)
        share, rejected = 1.0, 0
        while True:
            if remaining < small or any(rejected >= n and remaining < limit for n, limit in stalled):
                return best, True, fit.ended("converged")
            if rejected > stalled[-1][0]:
                return best, False, fit.ended("failed: no step improves the fit")
            if fit.spent:
                return best, False, fit.ended("not converged: stopped at max_steps")
            trial = yield from fit.at(outside(values + share * step, fit.low, fit.high))
            fit.count += 1
            accepted = trial.finite and _cost(fit, trial) < float(residual @ residual)
            fit.report(trial, accepted)
            if accepted:
                best = trial
                break
            share, rejected = share * _CUT, rejected + 1


def _cost(fit: "Fit", point: "Point") -> float:
    residual, _ = fit.natural(point)
    return float(residual @ residual)
