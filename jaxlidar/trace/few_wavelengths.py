"""Spectra at many wavelengths from those at few, for standard errors: three digits of them are enough.

What light collects along its way is a polynomial in the optics of the materials, and these are smooth: what
it is at 2,101 wavelengths follows from some thirty (an interpolative decomposition: Cheng, Gimbutas,
Martinsson and Rokhlin 2005, SIAM J. Sci. Comput. 26, 1389).
"""

from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.linalg.interpolative import interp_decomp, reconstruct_interp_matrix

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
    sums = random.uniform(-1, 1, (_TRIED, len(values))) @ values + random.uniform(-1, 1, (_TRIED, 1))
    tried = sums ** random.integers(1, degree + 1, (_TRIED, 1))
    tried /= np.max(np.abs(tried), axis=1, keepdims=True)
    size = np.linalg.norm(tried, axis=0)
    found: Any = interp_decomp(tried / size, _LEFT, rand=False)
    count, order, rest = found
    room = -(-count // _STEP) * _STEP
    if count == _TRIED or room >= values.shape[1]:
        return None
    shares = np.zeros((room, values.shape[1]))
    shares[:count] = reconstruct_interp_matrix(order, rest) * (size / size[order[:count], None])
    return FewWavelengths(jnp.asarray(order[:room]), jnp.asarray(shares, optics.dtype))
