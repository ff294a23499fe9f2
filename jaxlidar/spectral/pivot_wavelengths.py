r"""Pivot wavelengths: spectra at all wavelengths from those at few, to three digits, for standard errors.

What light collects along its path is a polynomial in the optics of the materials, and these vary smoothly
with wavelength. The matrix A of such polynomials (rows) at all wavelengths (columns) has low rank, and an
interpolative decomposition (Cheng, Gimbutas, Martinsson and Rokhlin 2005, SIAM J. Sci. Comput. 26, 1389)

    A ~ A[:, pivots] C

gives every column from few pivot columns: some thirty for 2,101 wavelengths. A is sampled by random
polynomials up to the largest degree. With the pivoted QR decomposition A[:, order] = Q [R11 R12], C[:, order]
= [I, R11^-1 R12].
"""

from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxlidar._jax.products import einsum

# Random polynomials that sample the matrix.
_N_POLYNOMIALS = 64
# Norm of the residual of any column, of the norm 1, at which the decomposition stops.
_RELATIVE_RESIDUAL = 1e-5
# Programs are compiled for multiples of this number of pivots.
_PIVOT_BUCKET = 16


@final
class PivotWavelengths(eqx.Module):
    """Pivot wavelengths, and the coefficients C of an interpolative decomposition. Made by `find_pivots`.

    - `indices`: numbers of the pivot wavelengths. - `coefficients`: of each in the spectrum at all
      wavelengths.
    """

    indices: Int[Array, "pivots"]
    coefficients: Float[Array, "pivots wavelengths"]

    def interpolate(
        self, spectra: Float[Array, "*rest pivots columns"]
    ) -> Float[Array, "*rest wavelengths columns"]:
        """Return spectra at all wavelengths from those at the pivots."""
        return einsum("...fc,fw->...wc", spectra, self.coefficients)


def find_pivots(optics: Float[Array, "channels wavelengths"], degree: int) -> PivotWavelengths | None:
    """Find pivots for polynomials of up to `degree` in the optics.

    None where hardly fewer wavelengths would do, or where 64 polynomials do not resolve the rank.

    1. Random polynomials sample the rows of A.
    2. Rows are scaled to the largest value 1, then columns to the norm 1, so that the residual of each is
       judged relative to itself.
    3. Pivoted QR; pivots beyond those that are needed fill a bucket, with coefficients of zero.
    4. Coefficients of scaled columns, R11^-1 R, by back substitution.
    5. Coefficients of A's own columns: times the norm of the column over that of the pivot.
    """
    values, random = np.asarray(optics, float), np.random.default_rng(0)
    # Powers of random affine forms span all polynomials and, unlike monomials, are of similar magnitude.
    weights = random.uniform(-1, 1, (_N_POLYNOMIALS, len(values)))
    constants = random.uniform(-1, 1, (_N_POLYNOMIALS, 1))
    forms = np.einsum("tl,lw->tw", weights, values) + constants
    polynomials, degrees = forms.copy(), random.integers(1, degree + 1, _N_POLYNOMIALS)
    for power in range(2, degree + 1):
        polynomials[degrees >= power] *= forms[degrees >= power]
    polynomials /= np.max(np.abs(polynomials), axis=1, keepdims=True)
    norms = np.sqrt(np.sum(polynomials**2, axis=0))
    order, rows = _pivoted_qr(polynomials / norms)
    count = len(order)
    padded_count = -(-count // _PIVOT_BUCKET) * _PIVOT_BUCKET
    if count == _N_POLYNOMIALS or padded_count >= values.shape[1]:
        return None
    coefficients, indices = np.zeros((padded_count, values.shape[1])), np.zeros(padded_count, int)
    indices[:count] = order
    # R11^-1 R by back substitution, from the last row up.
    for n in reversed(range(count)):
        later_rows = np.einsum("c,cw->w", rows[n, order[n + 1 :]], coefficients[n + 1 : count])
        coefficients[n] = (rows[n] - later_rows) / rows[n, order[n]]
    coefficients[:count] *= norms / norms[order, None]
    return PivotWavelengths(jnp.asarray(indices), jnp.asarray(coefficients, optics.dtype))


def _pivoted_qr(
    columns: Float[np.ndarray, "polynomials wavelengths"],
) -> tuple[list[int], Float[np.ndarray, "pivots wavelengths"]]:
    """Return the pivot columns of a QR decomposition with column pivoting, and the rows of R.

    SciPy's is not used: threads of its BLAS wait busily after a call, on the cores that trace light.
    """
    residuals, order = np.sum(columns**2, axis=0), list[int]()
    axes, rows = np.zeros((len(columns), len(columns))), list[np.ndarray]()
    tolerance = _RELATIVE_RESIDUAL**2 * np.max(residuals)
    while len(order) < len(columns) and np.max(residuals) > tolerance:
        order.append(int(np.argmax(residuals)))
        axis = columns[:, order[-1]]
        # Gram-Schmidt twice is enough for orthogonality (Giraud, Langou and Rozloznik 2005, Comput. Math.
        # Appl. 50, 1069).
        for _ in range(2):
            axis = axis - np.einsum("nt,n->t", axes, np.einsum("nt,t->n", axes, axis))
        axes[len(order) - 1] = axis = axis / np.sqrt(np.sum(axis**2))
        rows.append(np.einsum("t,tw->w", axis, columns))
        residuals = residuals - rows[-1] ** 2
    return order, np.array(rows)
