"""Running integrals of pulses, blurred by timing jitter: closed forms that stay finite at zero width.

For the formulas see `jaxlidar.instrument.pulse`.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erfc
from jaxtyping import Array

# A width below this (ns) counts as zero: a millionth of a light wave's period, and its inverse cube still
# fits into float32, as second derivatives need.
_NEGLIGIBLE = 1e-12
# Phi and phi are 1 or 0 to the last bit beyond; clipping here keeps inf * 0 out of the derivatives.
_SCORE_MAX = 40.0
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)


def quadrature_sum(a: Array, b: Array) -> Array:
    """sqrt(a^2 + b^2) whose derivative is finite at zero."""
    square = a * a + b * b
    positive = square > _NEGLIGIBLE**2
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def score(t: Array, sigma: Array) -> Array:
    """t / sigma within +-40; for a sigma of zero the sign of t times 40."""
    inside = (sigma > _NEGLIGIBLE) & (jnp.abs(t) < _SCORE_MAX * sigma)
    ratio = jnp.where(inside, t, 0.0) / jnp.where(inside, sigma, 1.0)
    return jnp.where(inside, ratio, _SCORE_MAX * jnp.sign(t))


def _density(z: Array) -> Array:
    return jnp.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)


def distribution(z: Array) -> Array:
    return 0.5 * erfc(-z / math.sqrt(2))


def _decaying(z: Array) -> tuple[Array, Array]:
    """Phi(z) integrated once and twice, minus the same integrals of the unit step.

    The first is even and vanishes at infinity; the second is odd (an integration constant is dropped).
    """
    tail, density = distribution(-jnp.abs(z)), _density(z)
    once = density - jnp.abs(z) * tail
    twice = jnp.sign(z) * (0.25 - 0.5 * ((z * z + 1) * tail - jnp.abs(z) * density))
    return once, twice


@jax.custom_jvp
def _wide_piece(t: Array, length: Array, sigma: Array) -> tuple[Array, Array]:
    """`piece` for length > 2 sigma."""
    once_high, twice_high = _decaying(score(t + length / 2, sigma))
    once_low, twice_low = _decaying(score(t - length / 2, sigma))
    ratio = sigma / length
    q = jnp.clip(2 * t / length, -1.0, 1.0)
    even = (1 + q) / 2 + ratio * (once_high - once_low)
    odd = (q * q - 1) / 4 - ratio * (once_high + once_low) + 2 * ratio**2 * (twice_high - twice_low)
    return even, odd


@_wide_piece.defjvp
def _wide_piece_jvp(primals, tangents):
    # By hand, since the two parts of each sum have kinks at the ends that only cancel in the sum.
    t, length, sigma = primals
    dt, dlength, dsigma = tangents
    even, odd = _wide_piece(t, length, sigma)
    high, low = score(t + length / 2, sigma), score(t - length / 2, sigma)
    rise, total = distribution(high) - distribution(low), distribution(high) + distribution(low)
    density_high, density_low = _density(high), _density(low)
    deven = rise * dt + (density_high - density_low) * dsigma + (total / 2 - even) * dlength
    dodd = (
        (2 * even - total) * dt
        + (2 * sigma / length * rise - density_high - density_low) * dsigma
        - (rise / 2 + 2 * odd) * dlength
    )
    return (even, odd), (deven / length, dodd / length)


def _narrow_piece(t: Array, length: Array, sigma: Array) -> tuple[Array, Array]:
    """`piece` for length <= 2 sigma: quadrature, whose error is below 1e-15 there."""
    even = odd = jnp.zeros_like(t)
    for x, weight in zip(_NODES.tolist(), _WEIGHTS.tolist()):
        value = 0.5 * weight * distribution(score(t - 0.5 * x * length, sigma))
        even, odd = even + value, odd + x * value
    return even, odd


def piece(t: Array, length: Array, sigma: Array) -> tuple[Array, Array]:
    """Halves of the integrals over x in [-1, 1] of Phi((t - x length/2)/sigma) and of x times that.

    A linear piece of mean power m and half rise d, centred on zero, has the blurred running integral
    length * (m * first + d * second).
    """
    wide = (length > 2 * sigma) & (length > _NEGLIGIBLE)
    wide_even, wide_odd = _wide_piece(t, jnp.where(wide, length, 1.0), jnp.where(wide, sigma, 0.0))
    even, odd = _narrow_piece(t, length, sigma)
    return jnp.where(wide, wide_even, even), jnp.where(wide, wide_odd, odd)


def exponential_part(t: Array, sigma: Array, decay: Array) -> Array:
    """phi(z) M(sigma/decay - z) with z = t/sigma: what an exponential tail subtracts from Phi(z)."""
    z = score(t, sigma)
    room = sigma - decay * z
    large = (room > 4 * decay) & (room > _NEGLIGIBLE)  # the argument of M exceeds 4
    v = jnp.where(large, decay, 0.0) / jnp.where(large, room, 1.0)
    # Laplace's continued fraction of M(1/v), smooth at v = 0, closed by its tail for equal terms: 16 terms
    # leave 3e-13 of it.
    fraction = 0.5 * (1 + jnp.sqrt(1 + 68 * v * v))
    for k in range(16, 0, -1):
        fraction = 1 + k * v * v / fraction
    by_fraction = _density(z) * v / fraction
    # Elsewhere as it stands: the exponent stays below 8.
    direct = ~large & (decay > _NEGLIGIBLE)
    rate = 1 / jnp.where(direct, decay, 1.0)
    width, time = jnp.where(direct, sigma, 0.0), jnp.where(direct, t, 0.0)
    shifted = distribution(score(time - width * width * rate, width))
    as_it_stands = jnp.exp(rate * (0.5 * width * width * rate - time)) * shifted
    return jnp.where(large, by_fraction, jnp.where(direct, as_it_stands, 0.0))
