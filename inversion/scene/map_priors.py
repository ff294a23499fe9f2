r"""Priors of a fit of many records: residuals that are sparse, for unknowns of a hundred thousand values.

The priors of all unknowns add to half of chi-squared

    1/2 |r(x)|^2 + sum of x_i / mean_i,    r(x) = W (t(x) - m),

with t = ln x for log-normal priors and t = x for others. The matrix W is sparse: its rows are 1 / s of a
normal or log-normal prior of mean m, and differences of neighbours of a Markov field over their standard
deviation, of which m is zero. The second sum is that of exponential priors. The Jacobian of r is W dt/dx.
"""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float

from inversion.fit.unknowns import BoundUnknown

# Logarithms of values below this are those of it: a log-normal prior may have a bound at zero.
_LEAST = 1e-300


class MapPriors:
    """The priors of unknowns that are flattened to one vector, x.

    - `whitening`: W. - `mean`: m. - `is_log`: True for log-normal priors. - `rate`: one over the means of
      exponential priors, or 0.
    """

    def __init__(self, unknowns: Sequence[BoundUnknown]):
        sizes = [u.start.size for u in unknowns]
        rates = [
            0.0 if u.field is None or u.field.mean is None else 1.0 / float(u.field.mean) for u in unknowns
        ]
        self.rate = np.repeat(rates, sizes)
        self.is_log = np.repeat([u.is_log_prior for u in unknowns], sizes)
        self.mean = np.concatenate(
            [np.zeros(u.start.size) if u.prior is None else np.ravel(u.prior[0]) for u in unknowns]
        )
        self.whitening = scipy.sparse.csr_array(scipy.sparse.block_diag([_whitening(u) for u in unknowns]))

    def cost_and_gradient(self, x: Float[np.ndarray, " n"]) -> tuple[float, Float[np.ndarray, " n"]]:
        """Return -ln of the prior density up to a constant, and its gradient."""
        transformed = np.where(self.is_log, np.log(np.maximum(x, _LEAST)), x)
        residual = self.whitening @ (transformed - self.mean)
        # The exponential prior is linear in x, and has no residual.
        cost = 0.5 * float(residual @ residual) + float(self.rate @ x)
        return cost, self.jacobian(x).T @ residual + self.rate

    def jacobian(self, x: Float[np.ndarray, " n"]) -> Any:
        """Return the Jacobian of r, a sparse array of SciPy."""
        dt_dx = 1.0 / np.where(self.is_log, np.maximum(x, _LEAST), 1.0)
        return self.whitening @ scipy.sparse.dia_array((dt_dx[None], 0), shape=(x.size, x.size))


def _whitening(u: BoundUnknown) -> Any:
    """Return the rows of W of an unknown, sparse; none without a prior."""
    rows = [scipy.sparse.csr_matrix((0, u.start.size))]
    if u.prior is not None:
        rows.append(scipy.sparse.diags(1.0 / np.ravel(u.prior[1])))
    if u.field is not None:
        for axis, size in enumerate(np.broadcast_to(np.asarray(u.field.difference, float), u.start.ndim)):
            if np.isfinite(size):
                along = [scipy.sparse.eye(n) for n in u.start.shape]
                n = u.start.shape[axis]
                along[axis] = (scipy.sparse.eye(n - 1, n, k=1) - scipy.sparse.eye(n - 1, n)) / size
                rows.append(functools.reduce(scipy.sparse.kron, along))
    return scipy.sparse.vstack(rows)
