"""The best of several fits of the same data, and how likely the others are."""

from collections.abc import Sequence

import numpy as np

from inversion.fit.solver import Fit, Fitting, Outcome


def best_of(fits: Sequence[Fit]) -> Fitting:
    """Run fits from several starts, one after the other, and select the converged one of the lowest cost.

    **Returns:** its outcome, with the steps of all fits.
    """
    outcomes = []
    for fit in fits:
        outcomes.append((yield from fit.run()))
    best = min(outcomes, key=lambda o: (not o.converged, not np.isfinite(o.cost), o.cost))
    if len(fits) == 1:
        return best
    second, robust = among(best, [o for o in outcomes if o.converged and o is not best])
    near = sum(o.converged and o.cost < best.cost + 1.0 for o in outcomes)
    return best._replace(
        steps=sum(o.steps for o in outcomes),
        history=tuple(h for o in outcomes for h in o.history),
        status=f"{best.status}; {near} of {len(fits)} starts ended there",
        second_minimum=second,
        robust_stderr=robust,
    )


def among(best: Outcome, others: Sequence[Outcome]) -> tuple[float, np.ndarray]:
    """How much likelier the best end is than the next, and standard errors with the spread over ends.

    Ends are alike within two standard errors of all unknowns. Chi-squared counts correlated samples by what
    they tell, and in units of the best fit's; an end weighs exp(-rise / 2).
    """
    telling = (
        best.independent_samples / max(np.count_nonzero(best.residuals), 1) / max(best.reduced_chi2, 1.0)
    )
    second, variance, weight = np.inf, np.zeros_like(best.values), 1.0
    for other in others:
        rise, away = max(other.cost - best.cost, 0.0) * telling, other.values - best.values
        if np.any(np.abs(away) > 2.0 * best.robust_stderr):
            second = min(second, rise)
        variance += np.exp(-0.5 * rise) * away**2
        weight += np.exp(-0.5 * rise)
    return float(second), np.hypot(best.robust_stderr, np.sqrt(variance / weight))
