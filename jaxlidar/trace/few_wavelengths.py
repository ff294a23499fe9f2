"""Spectra at many wavelengths from those at few, for standard errors: three digits of them are enough.

What light collects along its way is a polynomial in the optics of the materials, and these are smooth: what
it is at 2,101 wavelengths follows from some thirty (an interpolative decomposition: Cheng, Gimbutas,
Martinsson and Rokhlin 2005, SIAM J. Sci. Comput. 26, 1389).
"""

from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

# Polynomials that are tried, and what may be left of the largest at any wavelength.
_TRIED, _LEFT = 64, 1e-5
# Programs are compiled for multiples of so many.
_STEP = 16


@final
class FewWavelengths(eqx.Module):
    """Wavelengths that stand for all. Made by `few_of`.

    - `chosen`: their numbers. - `shares`: what each adds to a spectrum.
    """

    chosen: Int[Array, "few"]
    shares: Float[Array, "few wavelengths"]

    def spread(self, spectra: Float[Array, "*rest few columns"]) -> Float[Array, "*rest wavelengths columns"]:
        """Spectra at all wavelengths."""
        return jnp.einsum("...fc,fw->...wc", spectra, self.shares)


def few_of(optics: Float[Array, "letters wavelengths"], degree: int) -> FewWavelengths | None:
    """Wavelengths from which polynomials of up to `degree` in the optics follow at all others.

    None where there are not fewer: for optics without a likeness between wavelengths. Those beyond what is
    needed add nothing.
    """
    values, random = np.asarray(optics, float), np.random.default_rng(0)
    # Powers of random sums span all polynomials, and are numbers of one size.
    weights, constant = random.uniform(-1, 1, (_TRIED, len(values))), random.uniform(-1, 1, (_TRIED, 1))
    sums = np.einsum("tl,lw->tw", weights, values) + constant
    tried, degrees = sums.copy(), random.integers(1, degree + 1, _TRIED)
    for reached in range(2, degree + 1):
        tried[degrees >= reached] *= sums[degrees >= reached]
    tried /= np.max(np.abs(tried), axis=1, keepdims=True)
    size = np.sqrt(np.sum(tried**2, axis=0))
    order, rows = _pivots(tried / size)
    count = len(order)
    room = -(-count // _STEP) * _STEP
    if count == _TRIED or room >= values.shape[1]:
        return None
    shares, chosen = np.zeros((room, values.shape[1])), np.zeros(room, int)
    chosen[:count] = order
    # What the chosen add to all is R^-1 of their columns times R, from the last row up.
    for n in reversed(range(count)):
        later = np.einsum("c,cw->w", rows[n, order[n + 1 :]], shares[n + 1 : count])
        shares[n] = (rows[n] - later) / rows[n, order[n]]
    shares[:count] *= size / size[order, None]
    return FewWavelengths(jnp.asarray(chosen), jnp.asarray(shares, optics.dtype))


def _pivots(
    columns: Float[np.ndarray, "tried wavelengths"],
) -> tuple[list[int], Float[np.ndarray, "few wavelengths"]]:
    """The columns of which all others are made, and the rows of R of their QR decomposition.

    SciPy's own is not taken: threads of its BLAS wait busily after a call, on the cores that trace.
    """
    left, order = np.sum(columns**2, axis=0), list[int]()
    axes, rows = np.zeros((len(columns), len(columns))), list[np.ndarray]()
    enough = _LEFT**2 * np.max(left)
    while len(order) < len(columns) and np.max(left) > enough:
        order.append(int(np.argmax(left)))
        axis = columns[:, order[-1]]
        # Twice is enough (Giraud, Langou and Rozloznik 2005, Comput. Math. Appl. 50, 1069).
        for _ in range(2):
            axis = axis - np.einsum("nt,n->t", axes, np.einsum("nt,t->n", axes, axis))
        axes[len(order) - 1] = axis = axis / np.sqrt(np.sum(axis**2))
        rows.append(np.einsum("t,tw->w", axis, columns))
        left = left - rows[-1] ** 2
    return order, np.array(rows)
