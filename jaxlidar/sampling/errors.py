"""Standard errors of means of few batches, and the relative error of a waveform.

An estimate is the mean of n independent batches. Its standard error s comes from the scatter of the batches,
with n - 1 degrees of freedom. The interval of two s either side of the mean would hold the expected value
with 95.4 % probability if the variance were known; for n = 8 it holds it with 91 %. Standard errors are
therefore multiplied by

    t_{n-1}(Phi(2)) / 2

where t_{n-1} is the quantile function of Student's distribution and Phi the normal distribution function.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

# Samples below this fraction of the peak do not count in the relative error of a waveform.
PEAK_FRACTION = 0.01


def namespace_of(value: Any) -> Any:
    """Return `jax.numpy` for arrays of JAX, which in compiled programs are tracers, and NumPy otherwise."""
    return jnp if isinstance(value, jax.Array) else np


def floating(count: Any) -> Any:
    """Return a count as a number that floats divide: JAX's default float for its arrays, else as it is."""
    return count.astype(jnp.result_type(float)) if isinstance(count, jax.Array) else count


def student_widening(batches: Any) -> Any:
    """Factor that widens a standard error estimated from few batches.

    `batches`: number of batches, at least 2. It may be a fraction: it is the degrees of freedom plus one.

    The factor is the quantile of Student's t at the probability of two standard errors of a normal
    distribution, divided by two, from its expansion in 1 / (degrees of freedom) (Abramowitz and Stegun
    26.7.5): to 0.1 % for eight batches.
    """
    # Floating point first: the third power of an int32 may overflow.
    x, freedom = 2.0, floating(batches) - 1.0
    terms = (
        (x**3 + x) / 4,
        (5 * x**5 + 16 * x**3 + 3 * x) / 96,
        (3 * x**7 + 19 * x**5 + 17 * x**3 - 15 * x) / 384,
    )
    return (x + sum(t / freedom ** (i + 1) for i, t in enumerate(terms))) / x


def relative_error(mean: Any, stderr: Any) -> Any:
    """Root mean square of stderr / mean over the samples near the peak, for the worst wavelength.

    `mean`, `stderr`: (*shots, wavelengths, samples), both of NumPy, or both of JAX within compiled programs.
    Samples below 1 % of the wavelength's peak do not count. Returns (*shots,).
    """
    xp = namespace_of(mean)
    is_significant = mean > PEAK_FRACTION * xp.max(mean, axis=-1, keepdims=True)
    # Guard the inside of the `where`: the mean may be zero where it does not count.
    squares = xp.where(is_significant, (stderr / xp.where(is_significant, mean, 1.0)) ** 2, 0.0)
    n_samples = xp.sum(is_significant, axis=-1, dtype=squares.dtype)
    mean_squares = xp.sum(squares, axis=-1) / xp.maximum(n_samples, 1)
    return xp.max(xp.sqrt(mean_squares), axis=-1, initial=0.0)
