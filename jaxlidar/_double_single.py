"""Double-single arithmetic: numbers of about 36 bits as sums of two in single precision, for the plate model.

The head of such a number has at most 12 significant bits, so that the product of two heads is exact; the
tail is an ordinary number some 2^12 times smaller. Heads are cut off by masking bits, never by rounding a
sum: products may be contracted with sums, as compilers do, without changing what is exact here.
"""

import itertools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxlidar import _expint
from jaxlidar._one_function import once

_Single = Float[Array, "..."]

# (log1p(x) - x + x^2/2)/x^3 for |x| < 1/3 and (exp(-x) - 1 + x)/x^2 for |x| < 0.35, by interpolation at
# Chebyshev nodes.
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
_EXP = (
    0.50000000135,
    -0.16666666682,
    0.041666464197,
    -0.0083333108446,
    0.0013933730716,
    -0.00019891080464,
)


# Of 1 - 2 E3(k) = k (k ln k + Po(k)) in 3/4 - k, and of 2 E3(k) = 2 exp(-k) Q(s)/(k + 2.5).
_SMALL_OMEGA_DOUBLE_SINGLE = (
    1.1363837604,
    1.360851687231,
    -0.2557427357864,
    -0.02831863156568,
    -0.003514591349223,
    -0.000418872244915,
    -4.560279369399e-5,
    -5.685342257067e-6,
)
_LARGE_TAU_DOUBLE_SINGLE = (
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
_DOUBLE_SINGLE = tuple(
    itertools.zip_longest(_SMALL_OMEGA_DOUBLE_SINGLE, _LARGE_TAU_DOUBLE_SINGLE, fillvalue=0.0)
)
_LN_2 = (0.693115234375, 3.194618494e-5)  # twelve bits, and the rest


class DoubleSingle(NamedTuple):
    """The number head + tail."""

    head: _Single
    tail: _Single


def _cut(x: _Single) -> _Single:
    bits = jax.lax.bitcast_convert_type(x, jnp.int32)
    return jax.lax.bitcast_convert_type(bits & -4096, jnp.float32)


def split(x: _Single) -> DoubleSingle:
    head = _cut(x)
    return DoubleSingle(head, x - head)


def constant(x: float | np.ndarray) -> DoubleSingle:
    """A number, or an array of them, known in double precision."""
    single = np.asarray(x, np.float32)
    head = (single.view(np.int32) & np.int32(-4096)).view(np.float32)
    return DoubleSingle(jnp.asarray(head), jnp.asarray(np.asarray(x - head.astype(float), np.float32)))


def single(a: DoubleSingle) -> _Single:
    return a.head + a.tail


def where(condition: Bool[Array, "..."], a: DoubleSingle, b: DoubleSingle) -> DoubleSingle:
    return DoubleSingle(jnp.where(condition, a.head, b.head), jnp.where(condition, a.tail, b.tail))


def minus(a: DoubleSingle) -> DoubleSingle:
    return DoubleSingle(-a.head, -a.tail)


def short_plus(c: float | _Single, x: _Single) -> DoubleSingle:
    """c + x, where c has few bits and the sum is not much larger than either."""
    head = _cut(c + x)
    return DoubleSingle(head, (c - head) + x)


def plus(a: DoubleSingle, b: DoubleSingle) -> DoubleSingle:
    """a + b, where a is zero or not much smaller than b (2^-11)."""
    tail = a.tail + b.tail
    head = _cut(a.head + b.head + tail)
    return DoubleSingle(head, ((a.head - head) + b.head) + tail)


def times(a: DoubleSingle, b: DoubleSingle) -> DoubleSingle:
    exact, rest = a.head * b.head, a.head * b.tail + a.tail * single(b)
    head = _cut(exact + rest)
    return DoubleSingle(head, (exact - head) + rest)


def over(a: DoubleSingle, b: DoubleSingle, inverse: _Single) -> DoubleSingle:
    """a/b, given 1/b in single precision."""
    head = _cut(single(a) * inverse)
    return DoubleSingle(head, ((a.head - head * b.head) + (a.tail - head * b.tail)) * inverse)


def power_of_two(e: Int[Array, "..."]) -> _Single:
    return jax.lax.bitcast_convert_type((127 + e) << 23, jnp.float32)


def minus_log(x: _Single) -> DoubleSingle:
    """-ln x, x > 0."""
    e = _octave(x)
    return _minus_log(x * power_of_two(e) - 1, e, 0.0)


def minus_log_of(x: _Single, lost: _Single, thin: Bool[Array, "..."], excess: _Single) -> DoubleSingle:
    """-ln x, and -ln(1 - lost) where `thin`, for an x short by the small share `excess` of itself."""
    e = jnp.where(thin, 0, _octave(x))
    return _minus_log(jnp.where(thin, -lost, x * power_of_two(e) - 1), e, excess)


def _octave(x: _Single) -> Int[Array, "..."]:
    """The e for which 2^e x lies between 2/3 and 4/3."""
    # The bits of 2/3.
    return -((jax.lax.bitcast_convert_type(x, jnp.int32) - 0x3F2AAAAB) >> 23)


def _minus_log(own: _Single, e: Int[Array, "..."], excess: _Single | float) -> DoubleSingle:
    """e ln 2 - ln(1 + own) - excess, |own| <= 1/3."""
    head = _cut(own)
    half = 0.5 * head * head
    number = e.astype(jnp.float32)
    # Eight bits times twelve are exact.
    octaves, beyond = number * _LN_2[0], number * _LN_2[1] - excess
    small = (0.5 * (own - head)) * (own + head) - own * own * own * _expint.polynomial(own, _LOG1P) + beyond
    total = _cut(((octaves - own) + half) + small)
    return DoubleSingle(total, (((octaves - total) - own) + half) + small)


def exp_minus(a: DoubleSingle) -> tuple[_Single, _Single]:
    """exp(-a) and 1 - exp(-a), for a >= 0, in single precision."""
    number = jnp.minimum(jnp.round(single(a) * (1 / math.log(2))), 254)
    rest = (a.head - number * _LN_2[0]) + (a.tail - number * _LN_2[1])
    # Clipped where the result is zero.
    rest = jnp.minimum(rest, 80.0)
    lost = rest - rest * rest * _expint.polynomial(rest, _EXP)
    e = number.astype(jnp.int32)
    half = e >> 1
    factor = power_of_two(-half) * power_of_two(half - e)
    return (1 - lost) * factor, (1 - factor) + factor * lost


def depths(k: _Single, scale: _Single, inverse: _Single) -> tuple[DoubleSingle, DoubleSingle]:
    """1 - 2 E3(k), and what `_expint.scaled_tau` gives, of single precision's k, to nine digits.

    For k >= 1 the former has two digits fewer. The rest are what `_expint.helpers` gives: with these there is
    nothing here but sums and products, which compilers fuse into one loop.
    """
    below, small = _expint.split(k)
    large = jnp.maximum(k, 1.0)
    u = over(constant(1.0), short_plus(2.5, large), inverse)
    # Both polynomials at once.
    x = where(below, short_plus(0.75, -small), short_plus(7.0 * u.head - 1.0, 7.0 * u.tail))
    total = split(_expint.polynomial(single(x), [jnp.where(below, *c) for c in _DOUBLE_SINGLE[2:]]))
    for c in (_DOUBLE_SINGLE[1], _DOUBLE_SINGLE[0]):
        total = plus(where(below, *map(constant, c)), times(x, total))
    factor = split(k)
    log_part = times(factor, minus(minus_log(small)))
    total = where(below, plus(total, log_part), total)
    product = times(where(below, factor, DoubleSingle(2.0 * u.head, 2.0 * u.tail)), total)
    omega = where(below, product, short_plus(1.0, -scale * single(product)))
    rest = short_plus(1.0, -product.head)
    return omega, where(below, DoubleSingle(rest.head, rest.tail - product.tail), product)


def refined(
    k: _Single, w: _Single, v: _Single, bounces: DoubleSingle
) -> tuple[tuple[_Single, _Single], DoubleSingle]:
    """In single precision 1 - v and v with their rounding corrected, and beta = -ln v.

    Given are 1 - v and, by the name of `v`, exp(k) v for k >= 1, v itself below.
    """
    scale, inverse = _expint.helpers(k)
    thin, excess = w < 0.3, once(_excess(k, scale, inverse, w, v, bounces))
    log_part = minus_log_of(v, w, thin, excess)
    change = v * excess
    v = scale * (v + change)
    w = jnp.where(thin, w - change, 1 - v)
    return (w, jnp.where(thin, 1 - w, v)), plus(split(jnp.where(k < 1, 0.0, k)), log_part)


def _excess(
    k: _Single, scale: _Single, inverse: _Single, w: _Single, v: _Single, bounces: DoubleSingle
) -> _Single:
    """By what share of itself v is too small: one step of Newton's, whose residual is double_single.

    With kappa = (r12 + r21)/t21 the exact v solves v z = (1 - v)^2 tau,
    z = omega (omega + kappa (2 - omega)).
    """
    omega, tau = depths(k, scale, inverse)
    other = short_plus(2.0, -omega.head)
    other = DoubleSingle(other.head, other.tail - omega.tail)
    z = times(omega, plus(times(bounces, other), omega))
    thin = w < 0.3
    rest = scale * v
    fine_v = where(thin, short_plus(1.0, -w), split(v))
    fine_w = where(thin, split(w), short_plus(1.0, -rest))
    left, right = times(fine_v, z), times(times(fine_w, fine_w), tau)
    gap = (right.head - left.head) + (right.tail - left.tail)
    slope = w * single(tau) * (1 + rest)
    return jnp.where(slope > 0, gap / jnp.where(slope > 0, slope, 1.0), 0.0)
