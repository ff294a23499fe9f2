"""Exponential integrals E1, E2 and the diffuse transmittance 2 E3, in bounded time and with every derivative.

The exponential integral of order n is En(k) = integral over t in [1, inf) of exp(-k t) / t^n dt, k >= 0. A
layer of optical depth k transmits the fraction 2 E3(k) of diffuse light and absorbs 1 - 2 E3(k). JAX's own
functions do not serve here: `jax.scipy.special.exp1` and `expn` iterate until the slowest element of an array
has converged, and lack second derivatives. Here every argument takes the same operations.

*Approximation.* For k < 1 the logarithmic singularity is split off (Abramowitz and Stegun 1964, 5.1.11 and
5.1.12). What remains are entire functions P1, P2, Pt and Po:

    E1(k) = -ln k + P1(k),              E2(k) = k ln k + P2(k),
    2 E3(k) = -k^2 ln k + Pt(k),    1 - 2 E3(k) = k (k ln k + Po(k)).

For k >= 1 the leading behaviour is divided out. With s = 7 / (k + 2.5) - 1, which runs from 1 at k = 1 down
to -1 at infinity,

    En(k) = exp(-k) Qn(s) / (k + n).

Qn lies between 1 and 1.22, since En is close to its lower bound exp(-k) / (k + n) (Abramowitz and Stegun
5.1.19). The Pn and Qn are replaced by polynomials, which were computed by interpolation at Chebyshev nodes in
60-digit arithmetic. P2 and Po are written in powers of 1 - k and Pt in those of 3/4 - k, about where they are
small. The break at k = 1 is where ln k changes sign; so no subtraction loses more than a bit or two.

*Errors.* Largest relative error of the polynomials themselves, and their numbers of terms:

|              | P1      | P2      | Pt      | Po      | Q1      | Q2      | Q3      | terms P, Q           |
| ------------ | ------- | ------- | ------- | ------- | ------- | ------- | ------- | -------------------- |
| single       | 2.7e-10 | 6.6e-10 | 6.8e-10 | 5.3e-11 | 3.5e-8  | 6.2e-9  | 1.4e-8  | 8, 13 (Q3: 11)       |
| double       | 3.3e-17 | 1.4e-16 | 7.3e-17 | 4.0e-17 | 3.6e-15 | 4.1e-16 | 1.9e-15 | 14, 26               |

(as errors of En, 2 E3 or 1 - 2 E3). With rounding, all functions below are within 5e-7 (single) and 4e-15
(double) of the exact values (`tests/optics/test_expint.py`).

*Derivatives* follow from E3' = -E2, E2' = -E1 and E1' = -exp(-k)/k (Abramowitz and Stegun 5.1.26), not from
the polynomials, whose own derivatives are less accurate with every order. E1 is infinite at k = 0; there the
value at the smallest normal number is returned instead, which keeps second derivatives of 2 E3 finite.

*Scaled functions* leave out the factor exp(-k) for k >= 1, so that ratios of them stay finite where En itself
underflows.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

# Coefficients of ascending powers of the arguments named above.
_P1_DOUBLE = (
    -0.5772156649015329,
    1.0,
    -0.2499999999999999,
    0.055555555555552964,
    -0.010416666666631956,
    0.0016666666663880854,
    -0.00023148148003162964,
    2.8344666073466973e-05,
    -3.100185747859201e-06,
    3.0617033992676305e-07,
    -2.753014152932079e-08,
    2.2543157897595086e-09,
    -1.6086153676658512e-10,
    7.797313433970101e-12,
)
_P1_SINGLE = (
    -0.5772156648,
    0.9999999918,
    -0.2499998268,
    0.05555415859,
    -0.01041110549,
    0.001654539979,
    -0.0002165860150,
    1.842719574e-5,
)
_P2_DOUBLE = (
    0.14849550677592205,
    1.2193839343955202,
    -0.3160602794142787,
    -0.04404018627618851,
    -0.0066917830892479525,
    -0.0009494078440860269,
    -0.00012199489280836473,
    -1.4147262585107028e-05,
    -1.4864368770545166e-06,
    -1.4237082103049915e-07,
    -1.2477357138086965e-08,
    -1.0331943012080737e-09,
    -6.552741787231927e-11,
    -8.47067862615676e-12,
)
_P2_SINGLE = (
    0.1484955068,
    1.219383926,
    -0.3160601002,
    -0.04404160991,
    -0.006686257031,
    -0.0009609653118,
    -0.0001088046529,
    -2.169551265e-5,
)
_PT_DOUBLE = (
    0.1477121796936938,
    0.1157449947928558,
    1.5526587404594492,
    -0.23450375433732676,
    -0.02568274558566313,
    -0.0032004298069991197,
    -0.00038411412042736867,
    -4.272898448506414e-05,
    -4.36631314919352e-06,
    -4.099251546688844e-07,
    -3.547223987544608e-08,
    -2.8449009665109794e-09,
    -2.0605403630533127e-10,
    -1.8541825526622164e-11,
)
_PT_SINGLE = (
    0.1477121796,
    0.1157449922,
    1.552658756,
    -0.2345036289,
    -0.02568335430,
    -0.003201147833,
    -0.0003775634718,
    -5.270947152e-5,
)
_PO_DOUBLE = (
    0.7806160656044797,
    1.4836250520526357,
    -0.23575888234288464,
    -0.025052029400032445,
    -0.0030319362619343373,
    -0.0003552230262642906,
    -3.875374475909563e-05,
    -3.898061578383445e-06,
    -3.612448138383691e-07,
    -3.0927351202922676e-08,
    -2.4510509551087816e-09,
    -1.841431714933168e-10,
    -1.1055245637657603e-11,
    -1.2477633148274264e-12,
)
_PO_SINGLE = (
    0.7806160656,
    1.483625050,
    -0.2357588405,
    -0.02505236179,
    -0.003030644491,
    -0.0003579300661,
    -3.565344474e-5,
    -5.685342257e-6,
)
_Q1_DOUBLE = (
    1.0265287338666076,
    0.06336330265909224,
    0.05301614220463813,
    0.024720150731126045,
    0.012607919543647607,
    0.006151038877659773,
    0.003110835572654461,
    0.0015582160155511696,
    0.0007963750222788477,
    0.00040590238486092913,
    0.00020958959639485734,
    0.00010815002860354768,
    5.663610223427495e-05,
    2.9498810066112538e-05,
    1.466343155392064e-05,
    7.682260133493678e-06,
    5.692608418606126e-06,
    3.0144743376989975e-06,
    -6.456896971489514e-07,
    -3.532545920141327e-07,
    1.8899305576136232e-06,
    1.0114393006837585e-06,
    -6.996621055736524e-07,
    -3.7523079449701667e-07,
    2.2979600809215682e-07,
    1.231278473913925e-07,
)
_Q1_SINGLE = (
    1.026528734,
    0.06336304609,
    0.05301600672,
    0.02472726311,
    0.01261167516,
    0.006095549030,
    0.003081539025,
    0.001739807724,
    0.0008922191735,
    0.0001280350930,
    6.304470115e-5,
    0.0002936338767,
    0.0001541291846,
)
_Q2_DOUBLE = (
    1.040733551709416,
    0.08626741216656798,
    0.05533976386398514,
    0.015740392067608393,
    0.007694371413809644,
    0.002774825152370185,
    0.0013608383477742524,
    0.000545950389672896,
    0.0002731314576788693,
    0.00011616413347519914,
    5.9333597938702304e-05,
    2.6125469002555198e-05,
    1.3659442274517762e-05,
    6.125915503692251e-06,
    3.1500116679859086e-06,
    1.4601572819482987e-06,
    1.0079928289960048e-06,
    3.998124350453416e-07,
    -5.8107332750424696e-08,
    4.5528646985965326e-08,
    2.725982581101529e-07,
    6.423147999653809e-08,
    -9.762185097852967e-08,
    -1.6376816819217093e-08,
    3.180875993007698e-08,
    7.867980794413328e-09,
)
_Q2_SINGLE = (
    1.040733552,
    0.08626736537,
    0.05533973831,
    0.01574169082,
    0.007695080336,
    0.002764662660,
    0.001355294809,
    0.0005793887330,
    0.0002913493488,
    6.448759338e-5,
    3.124514476e-5,
    6.135655360e-5,
    3.269421356e-5,
)
_Q3_DOUBLE = (
    1.0480955869082482,
    0.09103318459113198,
    0.04325458321415648,
    0.004744640207974702,
    0.004271156907632176,
    0.0004979251402368396,
    0.0005977178876827607,
    6.321917733872346e-05,
    0.00010232451981540566,
    7.99147371807905e-06,
    2.0110752539021924e-05,
    7.046108280567556e-07,
    4.5005756461563145e-06,
    -1.6251408539263478e-07,
    8.175669420386973e-07,
    5.126994944706925e-08,
    7.334967596159716e-07,
    -3.355675970721369e-07,
    -4.963798524328685e-07,
    3.395954667029673e-07,
    4.914203392550172e-07,
    -3.0012801851333573e-07,
    -2.192379019531947e-07,
    1.3767578087195376e-07,
    5.469118608518261e-08,
    -3.320952956689697e-08,
)
_Q3_SINGLE = (
    1.048095587,
    0.09103317647,
    0.04325468566,
    0.004744793031,
    0.004269134629,
    0.0004972024201,
    0.0006086678557,
    6.431834023e-5,
    7.892377888e-5,
    7.874401244e-6,
    4.035077376e-5,
)

_Reals = Float[Array, "..."]


def polynomial(x: _Reals, coefficients: Sequence[Any]) -> _Reals:
    """Evaluate the sum of coefficients[i] x^i by Horner's rule; coefficients are numbers or arrays."""
    total = jnp.broadcast_to(jnp.asarray(coefficients[-1], x.dtype), x.shape)
    for c in coefficients[-2::-1]:
        total = total * x + jnp.asarray(c, x.dtype)
    return total


def _polynomial_of_precision(x: _Reals, single: Sequence[float], double: Sequence[float]) -> _Reals:
    return polynomial(x, double if x.dtype == jnp.float64 else single)


# Both branches of every function are evaluated for every k, and `where` selects one. Each branch is therefore
# given an argument within its own interval: an infinity or NaN in the branch that is not selected would turn
# derivatives into NaN.


def _small_argument(k: _Reals) -> tuple[Bool[Array, "..."], _Reals]:
    """True where k < 1, and the argument of the expansion for small k: k within (0, 1), 1 elsewhere."""
    is_small = k < 1
    return is_small, jnp.where(is_small, jnp.maximum(k, jnp.finfo(k.dtype).tiny), 1.0)


def _large_argument(k: _Reals) -> tuple[_Reals, _Reals]:
    """Return k where it is at least 1, and 1 elsewhere; and the argument s of the polynomials Qn."""
    k = jnp.maximum(k, 1.0)
    return k, 7.0 / (k + 2.5) - 1.0


def _scale(k: _Reals) -> _Reals:
    """The factor between a function and its scaled form: 1 for k < 1, exp(-k) from there on."""
    return jnp.where(k < 1, 1.0, jnp.exp(-k))


def scaled_e1(k: _Reals) -> _Reals:
    """E1(k) for k < 1, and exp(k) E1(k) from there on."""
    is_small, small = _small_argument(k)
    large, s = _large_argument(k)
    below = _polynomial_of_precision(small, _P1_SINGLE, _P1_DOUBLE) - jnp.log(small)
    above = _polynomial_of_precision(s, _Q1_SINGLE, _Q1_DOUBLE) / (large + 1.0)
    return jnp.where(is_small, below, above)


def scaled_e2(k: _Reals) -> _Reals:
    """E2(k) for k < 1, and exp(k) E2(k) from there on."""
    is_small, small = _small_argument(k)
    large, s = _large_argument(k)
    below = small * jnp.log(small) + _polynomial_of_precision(1.0 - small, _P2_SINGLE, _P2_DOUBLE)
    above = _polynomial_of_precision(s, _Q2_SINGLE, _Q2_DOUBLE) / (large + 2.0)
    return jnp.where(is_small, below, above)


def _scaled_tau_above(large: _Reals, s: _Reals) -> _Reals:
    return 2.0 * _polynomial_of_precision(s, _Q3_SINGLE, _Q3_DOUBLE) / (large + 3.0)


def scaled_tau(k: _Reals) -> _Reals:
    """2 E3(k) for k < 1, and exp(k) 2 E3(k) from there on."""
    is_small, small = _small_argument(k)
    # In this order: the square of a small k would underflow before it meets the logarithm.
    log_term = small * (small * jnp.log(small))
    below = _polynomial_of_precision(0.75 - small, _PT_SINGLE, _PT_DOUBLE) - log_term
    return jnp.where(is_small, below, _scaled_tau_above(*_large_argument(k)))


@jax.custom_jvp
def e1(k: _Reals) -> _Reals:
    """The exponential integral E1(k), k >= 0; at 0 its value at the smallest normal number."""
    return _scale(k) * scaled_e1(k)


@jax.custom_jvp
def e2(k: _Reals) -> _Reals:
    """The exponential integral E2(k), k >= 0."""
    return _scale(k) * scaled_e2(k)


@jax.custom_jvp
def tau(k: _Reals) -> _Reals:
    """2 E3(k), the transmittance of diffuse light by a layer of optical depth k >= 0."""
    return _scale(k) * scaled_tau(k)


@jax.custom_jvp
def omega(k: _Reals) -> _Reals:
    """1 - 2 E3(k), the absorptance that belongs to `tau`, without subtraction for small k."""
    is_small, small = _small_argument(k)
    log_term = small * jnp.log(small)
    # The factor is k itself, not the clamped one: zero at k = 0.
    below = k * (log_term + _polynomial_of_precision(1.0 - small, _PO_SINGLE, _PO_DOUBLE))
    large, s = _large_argument(k)
    return jnp.where(is_small, below, 1.0 - jnp.exp(-large) * _scaled_tau_above(large, s))


@jax.custom_jvp
def log_slope(k: _Reals) -> _Reals:
    """d ln tau / dk = -2 E2(k) / tau(k): finite where tau itself underflows."""
    return -2.0 * scaled_e2(k) / scaled_tau(k)


e1.defjvps(lambda dk, _, k: -dk * jnp.exp(-k) / jnp.maximum(k, jnp.finfo(k.dtype).tiny))
e2.defjvps(lambda dk, _, k: -dk * e1(k))
tau.defjvps(lambda dk, _, k: -2.0 * dk * e2(k))
omega.defjvps(lambda dk, _, k: 2.0 * dk * e2(k))
# The quotient rule, with the factor exp(-k) cancelled: (E2 / E3)' = -E1 / E3 + (E2 / E3)^2.
log_slope.defjvps(lambda dk, slope, k: dk * (2.0 * scaled_e1(k) / scaled_tau(k) - slope * slope))
