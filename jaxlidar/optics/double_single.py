"""Double-single arithmetic: numbers of about 36 bits as sums of two in single precision, for the plate model.

*Why.* A leaf of N plates decays by V = v^(N - 1) = exp(-(N - 1) beta), beta = -ln v. The relative error of V
is (N - 1) beta times that of beta, and (N - 1) beta reaches 80 before V underflows: single precision leaves
five digits of V. With beta in twice the digits, V has all seven. (Double precision would do, but JAX has it
only where `jax_enable_x64` is set.)

*Numbers.* x = head + tail. The head has at most 12 significant bits, so that the product of two heads is
exact in the 24 bits of single precision; the tail is an ordinary number some 2^12 times smaller. (Dekker
1971, Numer. Math. 18, 224, splits numbers in this way to make products exact.) Heads are cut off by masking
bits, never by rounding a sum, as in Dekker's (x + c) - c. Compilers may contract a product and a sum into one
fused operation; that does not change what is exact here.

*Errors.* Sums and products are correct to about 2^-35, relative to the larger operand; tau and omega to nine
digits, but omega to seven for k >= 1.

*Correction of v.* With tau = 2 E3(k), omega = 1 - tau and kappa = (r12 + r21)/t21 of a leaf's surface, the
decay v per plate solves

    v z = (1 - v)^2 tau,    z = omega (omega + kappa (2 - omega)).

This is Stokes' cosh(beta) = (1 + t^2 - r^2)/(2 t) (`jaxlidar.optics.plate_model`), with the plate's r and t
inserted. Newton's method from the v of single precision takes one step: its residual (1 - v)^2 tau - v z is a
small difference of numbers known to nine digits, and its slope (1 - v) tau (1 + v) need not be accurate.
"""

import itertools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._jax.one_function import barrier
from jaxlidar.optics import expint

_Single = Float[Array, "..."]
# Clears the lower 12 of the 24 bits of a significand.
_HEAD_MASK = -4096

# Coefficients of ascending powers, by interpolation at Chebyshev nodes.
# (log1p(x) - x + x^2/2)/x^3 for |x| <= 1/3; with it log1p has a relative error of 4e-10.
_LOG1P = (
    0.333333336603,
    -0.250000003043,
    0.19999853166,
    -0.166665299933,
    0.142961789972,
    -0.125097396633,
    0.108532879004,
    -0.09760089836,
    0.11612164612,
    -0.10678317289,
)
# (exp(-x) - 1 + x)/x^2 for |x| <= 0.35; with it 1 - exp(-x) has a relative error of 7e-10.
_EXP = (
    0.50000000135,
    -0.16666666682,
    0.041666464197,
    -0.0083333108446,
    0.0013933730716,
    -0.00019891080464,
)
# Po in 3/4 - k, for k < 1, and Q in s, for k >= 1: relative errors of omega and tau of 2e-11 and 7e-10. Other
# forms than those of `expint`, whose truncation errors and first coefficients do not need twice the digits.
_PO = (
    1.1363837604,
    1.360851687231,
    -0.2557427357864,
    -0.02831863156568,
    -0.003514591349223,
    -0.000418872244915,
    -4.560279369399e-5,
    -5.685342257067e-6,
)
_Q = (
    0.9782225481575,
    0.0197494690016,
    0.03905427627888,
    0.001824719561628,
    0.003865345255285,
    0.000206929013534,
    0.0005406930446642,
    2.359826989101e-5,
    0.0001031186073128,
    -1.108701044031e-6,
    6.524928289407e-6,
    2.379349646323e-6,
    1.143522060477e-5,
    -2.044302851091e-6,
)
# Pairs of coefficients of equal power, so that one pass of Horner's rule serves both intervals.
_PO_AND_Q = tuple(itertools.zip_longest(_PO, _Q, fillvalue=0.0))
# ln 2 as a number of twelve bits and a remainder.
_LN_2 = (0.693115234375, 3.194618494e-5)


class DoubleSingle(NamedTuple):
    """The number head + tail, as two arrays in single precision."""

    head: _Single
    tail: _Single


def _head_of(x: _Single) -> _Single:
    """The number cut off (rounded towards zero) to 12 significant bits."""
    bits = jax.lax.bitcast_convert_type(x, jnp.int32)
    return jax.lax.bitcast_convert_type(bits & _HEAD_MASK, jnp.float32)


def split(x: _Single) -> DoubleSingle:
    """Split a number in single precision into head and tail, without rounding."""
    head = _head_of(x)
    return DoubleSingle(head, x - head)


def from_double(x: float | np.ndarray) -> DoubleSingle:
    """Round a number in double precision, or an array of them."""
    single = np.asarray(x, np.float32)
    head = (single.view(np.int32) & np.int32(_HEAD_MASK)).view(np.float32)
    return DoubleSingle(jnp.asarray(head), jnp.asarray(np.asarray(x - head.astype(float), np.float32)))


def to_single(a: DoubleSingle) -> _Single:
    """Round to single precision."""
    return a.head + a.tail


def where(condition: Bool[Array, "..."], a: DoubleSingle, b: DoubleSingle) -> DoubleSingle:
    """Return a where the condition holds, else b."""
    return DoubleSingle(jnp.where(condition, a.head, b.head), jnp.where(condition, a.tail, b.tail))


def negate(a: DoubleSingle) -> DoubleSingle:
    """-a."""
    return DoubleSingle(-a.head, -a.tail)


# Sums and products below take their head from the rounded result, and their tail from the difference between
# the terms and the head. Terms are subtracted in an order in which each difference is exact.


def add_singles(c: float | _Single, x: _Single) -> DoubleSingle:
    """c + x, where c has few bits and the sum is not much larger than either."""
    head = _head_of(c + x)
    return DoubleSingle(head, (c - head) + x)


def add(a: DoubleSingle, b: DoubleSingle) -> DoubleSingle:
    """a + b, where a is zero or not much smaller than b (2^-11)."""
    tail = a.tail + b.tail
    head = _head_of(a.head + b.head + tail)
    return DoubleSingle(head, ((a.head - head) + b.head) + tail)


def multiply(a: DoubleSingle, b: DoubleSingle) -> DoubleSingle:
    """a b. The product of the heads, 12 bits each, is exact."""
    head_product, tail_products = a.head * b.head, a.head * b.tail + a.tail * to_single(b)
    head = _head_of(head_product + tail_products)
    return DoubleSingle(head, (head_product - head) + tail_products)


def divide(a: DoubleSingle, b: DoubleSingle, inverse: _Single) -> DoubleSingle:
    """a / b, given 1 / b in single precision: a quotient of 12 bits, then the remainder times 1 / b."""
    head = _head_of(to_single(a) * inverse)
    return DoubleSingle(head, ((a.head - head * b.head) + (a.tail - head * b.tail)) * inverse)


def power_of_two(e: Int[Array, "..."]) -> _Single:
    """2^e, exactly: the exponent bits of a number in single precision, whose bias is 127."""
    return jax.lax.bitcast_convert_type((127 + e) << 23, jnp.float32)


def minus_log(x: _Single) -> DoubleSingle:
    """-ln x, x > 0."""
    e = _octave(x)
    return _minus_log(x * power_of_two(e) - 1, e, 0.0)


def minus_log_corrected(
    x: _Single, complement: _Single, is_near_one: Bool[Array, "..."], excess: _Single
) -> DoubleSingle:
    """-ln(x (1 + excess)) of an x that is too small by the small fraction `excess` of itself.

    Where `is_near_one`, x is taken as 1 - complement, for there the complement has more digits.
    """
    e = jnp.where(is_near_one, 0, _octave(x))
    return _minus_log(jnp.where(is_near_one, -complement, x * power_of_two(e) - 1), e, excess)


def _octave(x: _Single) -> Int[Array, "..."]:
    """The e for which 2^e x lies between 2/3 and 4/3."""
    # 0x3F2AAAAB are the bits of 2/3; the exponent begins at bit 23.
    return -((jax.lax.bitcast_convert_type(x, jnp.int32) - 0x3F2AAAAB) >> 23)


def _minus_log(y: _Single, e: Int[Array, "..."], excess: _Single | float) -> DoubleSingle:
    """e ln 2 - ln(1 + y) - excess, |y| <= 1/3, by ln(1 + y) = y - y^2/2 + y^3 times a polynomial."""
    # y^2/2 = head^2/2, which is exact, + (y - head)(y + head)/2.
    head = _head_of(y)
    half_square = 0.5 * head * head
    octaves = e.astype(jnp.float32)
    # Eight bits times twelve are exact.
    log_octaves, log_remainder = octaves * _LN_2[0], octaves * _LN_2[1] - excess
    small_terms = (0.5 * (y - head)) * (y + head) - y * y * y * expint.polynomial(y, _LOG1P) + log_remainder
    total = _head_of(((log_octaves - y) + half_square) + small_terms)
    return DoubleSingle(total, (((log_octaves - total) - y) + half_square) + small_terms)


def exp_minus(a: DoubleSingle) -> tuple[_Single, _Single]:
    """exp(-a) and 1 - exp(-a), for a >= 0, in single precision.

    With a = e ln 2 + x, |x| <= 0.35, exp(-a) = 2^-e (1 - y), where y = 1 - exp(-x).
    """
    octaves = jnp.minimum(jnp.round(to_single(a) * (1 / math.log(2))), 254)
    x = (a.head - octaves * _LN_2[0]) + (a.tail - octaves * _LN_2[1])
    # An a beyond 254 octaves, where the result is zero, would overflow the polynomial.
    x = jnp.minimum(x, 80.0)
    y = x - x * x * expint.polynomial(x, _EXP)
    e = octaves.astype(jnp.int32)
    # Two factors: 2^-e itself may lie below the smallest normal number.
    half = e >> 1
    factor = power_of_two(-half) * power_of_two(half - e)
    return (1 - y) * factor, (1 - factor) + factor * y


def omega_and_scaled_tau(
    k: _Single, scale: _Single, reciprocal: _Single
) -> tuple[DoubleSingle, DoubleSingle]:
    """1 - 2 E3(k), and `expint.scaled_tau`(k), to nine digits of the k given.

    For k >= 1 the former has two digits fewer. `scale` and `reciprocal` are those of
    `expint.scale_and_reciprocal`: with these there is nothing here but sums and products, which compilers
    fuse into one loop.
    """
    is_small, small = expint.small_argument(k)
    large = jnp.maximum(k, 1.0)
    u = divide(from_double(1.0), add_singles(2.5, large), reciprocal)
    # Po(3/4 - k) or Q(s), s = 7 u - 1. The terms of the two lowest powers in twice the digits, after those of
    # higher power in single precision.
    x = where(is_small, add_singles(0.75, -small), add_singles(7.0 * u.head - 1.0, 7.0 * u.tail))
    total = split(expint.polynomial(to_single(x), [jnp.where(is_small, *c) for c in _PO_AND_Q[2:]]))
    for c in (_PO_AND_Q[1], _PO_AND_Q[0]):
        total = add(where(is_small, *map(from_double, c)), multiply(x, total))
    factor = split(k)
    log_term = multiply(factor, negate(minus_log(small)))
    total = where(is_small, add(total, log_term), total)
    # omega = k (k ln k + Po), or scaled tau = 2 u Q.
    product = multiply(where(is_small, factor, DoubleSingle(2.0 * u.head, 2.0 * u.tail)), total)
    omega = where(is_small, product, add_singles(1.0, -scale * to_single(product)))
    complement = add_singles(1.0, -product.head)
    return omega, where(is_small, DoubleSingle(complement.head, complement.tail - product.tail), product)


def refine_decay(
    k: _Single, w: _Single, v: _Single, kappa: DoubleSingle
) -> tuple[tuple[_Single, _Single], DoubleSingle]:
    """Correct the rounding of the decay per plate.

    **Arguments:**

    - `k`: optical depth of a plate.
    - `w`: 1 - v.
    - `v`: the decay per plate, times exp(k) for k >= 1.
    - `kappa`: (r12 + r21)/t21 of the leaf's surface.

    **Returns:** 1 - v and v (not scaled), corrected, in single precision; and beta = -ln v.
    """
    scale, reciprocal = expint.scale_and_reciprocal(k)
    # The excess serves v and its logarithm: the barrier keeps the compiler from computing it for each.
    is_thin, excess = w < 0.3, barrier(_decay_excess(k, scale, reciprocal, w, v, kappa))
    log_term = minus_log_corrected(v, w, is_thin, excess)
    change = v * excess
    v = scale * (v + change)
    # The smaller of v and 1 - v is corrected, and the other one derived from it.
    w = jnp.where(is_thin, w - change, 1 - v)
    return (w, jnp.where(is_thin, 1 - w, v)), add(split(jnp.where(k < 1, 0.0, k)), log_term)


def _decay_excess(
    k: _Single, scale: _Single, reciprocal: _Single, w: _Single, v: _Single, kappa: DoubleSingle
) -> _Single:
    """The fraction of itself by which v is too small: one step of Newton's method (see the module)."""
    omega, tau = omega_and_scaled_tau(k, scale, reciprocal)
    two_minus_omega = add_singles(2.0, -omega.head)
    two_minus_omega = DoubleSingle(two_minus_omega.head, two_minus_omega.tail - omega.tail)
    z = multiply(omega, add(multiply(kappa, two_minus_omega), omega))
    # The smaller of v and 1 - v is taken as exact, and the other one is derived from it in twice the digits.
    is_thin = w < 0.3
    unscaled_v = scale * v
    exact_v = where(is_thin, add_singles(1.0, -w), split(v))
    exact_w = where(is_thin, split(w), add_singles(1.0, -unscaled_v))
    # The factor exp(k) is in v and tau alike, and cancels in the quotient.
    v_z, w_w_tau = multiply(exact_v, z), multiply(multiply(exact_w, exact_w), tau)
    residual = (w_w_tau.head - v_z.head) + (w_w_tau.tail - v_z.tail)
    slope = w * to_single(tau) * (1 + unscaled_v)
    return jnp.where(slope > 0, residual / jnp.where(slope > 0, slope, 1.0), 0.0)
