"""The generalised plate model: a leaf as N absorbing plates with rough surfaces, without cancellation.

Symbols: k optical depth of a plate, N number of plates (real), n refractive index, alpha half-angle of the
cone of incidence. r, t, A reflectance, transmittance and absorptance of one plate in diffuse light; Ra, Ta,
Aa of the first plate, lit within the cone; Rs, Ts, As of the pile of the others; R, T, 1 - R - T of the leaf.
t12 and r12 are the transmittance and reflectance of a surface for diffuse light from outside, t21 and r21
from inside, t_alpha and r_alpha for light within the cone (`jaxlidar.optics.leaf_surface`).

*Plate* (Allen et al. 1969). With the diffuse transmittance tau = 2 E3(k) of the interior, omega = 1 - tau,
q = t21 + r21 omega (which is 1 - r21 tau) and p = 1 + r21 tau,

    t = t12 t21 tau/(q p),    r = r12 + r21 tau t,    A = 1 - r - t = t12 omega/q.

For the first plate t12 and r12 are replaced by t_alpha and r_alpha.

*Pile* (Stokes 1862) of M = N - 1 plates, M real. Light decays by v = exp(-beta) per plate,
cosh(beta) = (1 + t^2 - r^2)/(2 t) = 1 + y/(2 t) with y = A (2 r + A). Stokes' solution, with
s = 1 + r^2 - t^2 = (r + A)(1 + t) + r^2, S = sinh(M beta)/(t sinh beta) and C = cosh(M beta), is

    Rs = 2 r S/(s S + 2 C),    Ts = 2/(s S + 2 C).

Multiplied by V = v^M, with g = v/t and W = (1 - V^2)/(1 - v^2), so that V S = g W and 2 V C = 1 + V^2:

    v = 2 t/(2 t + y + sqrt(y (y + 4 t))),    D = s g W + 1 + V^2,
    Rs = 2 r g W/D,    Ts = 2 V/D,    As = 1 - Rs - Ts = (g W A (A + 2 t) + (1 - V)^2)/D.

*Leaf.* Light is reflected to and fro between the first plate and the pile:

    R = Ra + Ta Rs t/(1 - Rs r),    T = Ta Ts/(1 - Rs r),    1 - R - T = Aa + Ta (As + Rs A)/(1 - Rs r).

*Numerics.* Nothing here is a difference of close numbers, so that all three are accurate from transparent
plates (A = 0: V = 1, W = M) to opaque ones. V = v^M alone magnifies rounding, that of beta by M beta, which
reaches 80 before V underflows: single precision leaves five digits. The derivatives are those of these
expressions, put into the same form (`_slopes_k`, `_slopes_M`): the textbook's a, b and their square root are
not differentiable at A = 0, while the result is.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxlidar._fields.checks import check_numbers
from jaxlidar._jax.one_function import barrier
from jaxlidar.optics import expint
from jaxlidar.optics.leaf_surface import LeafSurface

_Reals = Float[Array, "..."]
Triple = tuple[_Reals, _Reals, _Reals]


def plate_model(k: Float[ArrayLike, "..."], N: Float[ArrayLike, "..."], surface: LeafSurface) -> Triple:
    """Reflectance, transmittance and absorptance of a leaf of N plates.

    All three are differentiable in all arguments, also at k = 0, at N = 1 and where they underflow. The
    second derivative in k diverges logarithmically at k = 0; the one returned there is large and finite.

    Measured relative errors, for k up to 100, N up to 10 and n from 1.2 to 1.55:

    - Double precision: 2e-14.
    - Single precision: 1.2e-6 for reflectance, absorptance and dR/dk, 2.5e-6 for dA/dk, and 1e-5 for
      transmittance and the other derivatives, each at the worst of 200,000 random points (999 of 1,000 lie
      within 5e-6; leaves of k < 10 and N < 3.5 within 5e-6). Derivatives below 1e-30 lose digits on their way
      to zero.

    **Arguments:**

    - `k`: optical depth of one plate (absorption coefficient times thickness), 0 or more.
    - `N`: number of plates, real, 1 or more. `k` and `N` are not checked, since they are mostly traced.
    - `surface`: mean reflectances and transmittances of the leaf's surface, as
      `jaxlidar.leaf_surface` returns them.

    Shapes broadcast against each other.

    **Returns:** reflectance, transmittance and absorptance, of the common shape. Their sum is 1 to rounding.
    Each is computed without subtraction: the absorptance of a nearly transparent leaf is not a difference of
    numbers near 1.

    **Source:** Allen et al. (1969), J. Opt. Soc. Am. 59, 1376; Jacquemoud and Baret (1990), Remote Sens.
    Environ. 34, 75; Stokes (1862), Proc. R. Soc. Lond. 11, 545.

    **Example:**

    >>> import jaxlidar as jl
    >>> R, T, A = jl.plate_model(k=0.1, N=1.5, surface=jl.leaf_surface(1.45))
    >>> print(f"R {R:.3f}, T {T:.3f}, A {A:.3f}")
    R 0.287, T 0.305, A 0.409
    """
    return _values_of(*_arrays(k, N, surface))


def plate_model_slopes(
    k: Float[ArrayLike, "..."], N: Float[ArrayLike, "..."], surface: LeafSurface
) -> tuple[Triple, Triple, Triple]:
    """Reflectance, transmittance and absorptance of a leaf of N plates, with their derivatives in k and in N.

    Values and derivatives share most of the work.

    **Arguments:**

    - `k`, `N`, `surface`: as for `plate_model`.

    **Returns:** reflectance, transmittance and absorptance; their derivatives in `k`; their derivatives in
    `N`.
    """
    return _slopes_of(*_arrays(k, N, surface))


def _arrays(k: Any, N: Any, surface: LeafSurface) -> tuple[_Reals, _Reals, LeafSurface]:
    """Return arrays of one type and one shape."""
    for name, x in {"k": k, "N": N, **surface._asdict()}.items():
        check_numbers(name, x)
    dtype = jnp.result_type(k, N, float)
    k, N, *face = jnp.broadcast_arrays(*(jnp.asarray(x, dtype) for x in (k, N, *surface)))
    return k, N, LeafSurface(*face)


# Compiled as one program: called outside of `jit`, every operation would be compiled by itself.
@jax.jit
def _values_of(k: _Reals, N: _Reals, face: LeafSurface) -> Triple:
    return _leaf(k, N - 1, face)


@jax.jit
def _slopes_of(k: _Reals, N: _Reals, face: LeafSurface) -> tuple[Triple, Triple, Triple]:
    return _values_and_slopes(k, N - 1, face)


class _PileState(NamedTuple):
    """The quantities that values and derivatives share, in the symbols of the module's docstring."""

    tau: Array
    t: Array
    r: Array
    A: Array
    Ta: Array
    Ra: Array
    Aa: Array
    q: Array
    p: Array
    y: Array
    s: Array
    g: Array
    v: Array
    w: Array  # 1 - v
    beta: Array
    V: Array
    Z: Array  # 1 - V
    W: Array
    D: Array


def _state(k: _Reals, M: _Reals, face: LeafSurface) -> _PileState:
    """Evaluate plate and pile: the equations of the module's docstring from top to bottom."""
    # The barriers keep the compiler from computing these again for every output (twice as fast on the CPU).
    tau, omega = barrier((expint.tau(k), expint.omega(k)))
    q, p = face.t21 + face.r21 * omega, 1 + face.r21 * tau
    inside = face.t21 * tau / (q * p)
    t, Ta = face.t12 * inside, face.t_alpha * inside
    r, Ra = face.r12 + face.r21 * tau * t, face.r_alpha + face.r21 * tau * Ta
    absorbed = omega / q
    A, Aa = face.t12 * absorbed, face.t_alpha * absorbed
    y = A * (2 * r + A)
    s = (r + A) * (1 + t) + r * r
    # Guards the derivative of the square root, and the quotient in W, where plates are transparent.
    is_clear = y <= 0
    root = jnp.where(is_clear, 0.0, jnp.sqrt(jnp.where(is_clear, 1.0, y * (y + 4 * t))))
    reciprocal = 1 / (2 * t + y + root)
    g, w = 2 * reciprocal, (y + root) * reciprocal
    v = t * g
    beta, V, Z = barrier(_decay(w, jax.lax.stop_gradient(v), M))
    W = jnp.where(is_clear, M, Z * (1 + V) / (jnp.where(is_clear, 1.0, w) * (1 + v)))
    D = s * g * W + 1 + V * V
    return _PileState(tau, t, r, A, Ta, Ra, Aa, q, p, y, s, g, v, w, beta, V, Z, W, D)


@jax.custom_jvp
def _decay(w: _Reals, v: _Reals, M: _Reals) -> Triple:
    """beta = -ln v, V = v^M and 1 - V, where v = 1 - w is given in both forms."""
    # The logarithm of the form that has more digits: of 1 - w for v near 1, else of v.
    is_thin = w < 0.3
    v = jnp.maximum(v, jnp.finfo(v.dtype).tiny)
    beta = -jnp.where(is_thin, jnp.log1p(-jnp.where(is_thin, w, 0.0)), jnp.log(jnp.where(is_thin, 1.0, v)))
    return beta, jnp.exp(-M * beta), -jnp.expm1(-M * beta)


@_decay.defjvp
def _decay_jvp(primals, tangents):
    # The derivative goes through w alone, for v = 1 - w.
    _, v, M = primals
    dw, _, dM = tangents
    beta, V, Z = _decay(*primals)
    dbeta = dw / jnp.maximum(v, jnp.finfo(v.dtype).tiny)
    dV = -V * (beta * dM + M * dbeta)
    return (beta, V, Z), (dbeta, dV, -dV)


@jax.custom_jvp
@jax.jit
def _leaf(k: _Reals, M: _Reals, face: LeafSurface) -> Triple:
    return _values(_state(k, M, face))


@jax.jit
def _values_and_slopes(k: _Reals, M: _Reals, face: LeafSurface) -> tuple[Triple, Triple, Triple]:
    """Values, derivatives in k and derivatives in M."""
    x = _state(k, M, face)
    return _values(x), _slopes_k(x, k, M, face), _slopes_M(x)


@jax.jit
def _surface_tangents(k: _Reals, M: _Reals, face: LeafSurface, dface: LeafSurface) -> Triple:
    """Changes of reflectance, transmittance and absorptance with a change of the surface."""
    return jax.jvp(lambda f: _values(_state(k, M, f)), (face,), (dface,))[1]


def _pile(x: _PileState) -> Triple:
    """Rs, Ts and As = 1 - Rs - Ts."""
    per_D = 1 / x.D
    absorbed = x.g * x.W * x.A * (x.A + 2 * x.t) + x.Z * x.Z
    return 2 * x.r * x.g * x.W * per_D, 2 * x.V * per_D, absorbed * per_D


def _values(x: _PileState) -> Triple:
    """R, T and 1 - R - T of the leaf."""
    Rs, Ts, As = _pile(x)
    # Light that travels down between the first plate and the pile, after all reflections.
    downward = x.Ta / (1 - Rs * x.r)
    return x.Ra + downward * Rs * x.t, downward * Ts, x.Aa + downward * (As + Rs * x.A)


def _leaf_jvp(primals, tangents):
    # Symbolic zeros tell which derivatives are not asked for. Those in the surface then cost nothing.
    k, M, face = primals
    dk, dM, dface = tangents
    values, in_k, in_M = _values_and_slopes(k, M, face)
    total: list = [jnp.zeros_like(k)] * 3
    for slopes, change in ((in_k, dk), (in_M, dM)):
        if not isinstance(change, SymbolicZero):
            total = [a + b * change for a, b in zip(total, slopes)]
    if not all(isinstance(d, SymbolicZero) for d in dface):
        dface = LeafSurface(*(jnp.zeros_like(k) if isinstance(d, SymbolicZero) else d for d in dface))
        total = [a + b for a, b in zip(total, _surface_tangents(k, M, face, dface))]
    return values, tuple(total)


_leaf.defjvp(_leaf_jvp, symbolic_zeros=True)


def _slopes_M(x: _PileState) -> Triple:
    """Derivatives of the leaf's reflectance, transmittance and absorptance in M.

    From dV/dM = -beta V, with P = beta/(1 - v^2):

        dRs/dM = 8 r g P (V/D)^2,    d ln Ts/dM = -(s g P (1 + V^2) + beta (1 - V^2))/D,
        dAs/dM = 4 g P V [s (1 - V)^2/2 + V A (2 t + A) + (1 - v^2)(1 - V^2)/(2 g)]/D^2.
    """
    r, t, A, g, V = x.r, x.t, x.A, x.g, x.V
    P = _beta_over_one_minus_v2(x)
    one_plus_V2, one_minus_V2 = 1 + V * V, x.Z * (1 + V)
    per_D = 1 / x.D
    dRs = 8 * r * g * P * (V * per_D) ** 2
    log_Ts = -(x.s * g * P * one_plus_V2 + x.beta * one_minus_V2) * per_D
    bracket = x.s * x.Z * x.Z / 2 + V * A * (2 * t + A) + x.w * (1 + x.v) * one_minus_V2 / (2 * g)
    dAs = 4 * g * P * V * bracket * per_D * per_D
    Rs, Ts, As = _pile(x)
    inverse = 1 / (1 - Rs * r)
    downward = x.Ta * inverse
    # d ln(downward)/dM: more light returns from the pile to the first plate and down again.
    log_downward = r * dRs * inverse
    return (
        downward * inverse * t * dRs,
        downward * Ts * (log_Ts + log_downward),
        downward * (dAs + A * dRs + (As + Rs * A) * log_downward),
    )


def _slopes_k(x: _PileState, k: _Reals, M: _Reals, face: LeafSurface) -> Triple:
    """Derivatives of the leaf's reflectance, transmittance and absorptance in k.

    1. The plate: d ln tau/dk = -2 E2/tau, and with rho = r21 tau

           d ln t = d ln tau (1 + rho^2)/(q p),    dr = rho t (d ln t + d ln tau),    dA = -d ln tau t p/q.

    2. The pile, a function of r, s, y and t. Subscripts y and t are derivatives of S and C in y, and in ln t
    at
       constant y:

           dRs = 2/D {g W dr - r/D [2 V^2 (S C_y - C S_y) dy + (g W)^2 ds + 2 V^2 (S C_t - C S_t) d ln t]},
           d ln Ts = -V/D {S ds + (s S_y + 2 C_y) dy + (s S_t + 2 C_t) d ln t}.

       With dbeta/dy = 1/(2 t sinh beta), all of them follow from

           psi(a) = (cosh a - sinh(a)/a)/a^2,    phi(a) = (sinh(a)/a - 1)/a^2,    L(a) = (a coth a - 1)/a^2,

       at a = M beta, 2 M beta and beta: these carry the differences that would lose digits at small beta.
    3. The leaf, by the product rule.
    """
    r, t, A, g, v, V, W, per_D = x.r, x.t, x.A, x.g, x.v, x.V, x.W, 1 / x.D
    log_tau = expint.log_slope(k)
    rho = face.r21 * x.tau
    log_t = log_tau * (1 + rho * rho) / (x.q * x.p)
    dt, dr, dA = t * log_t, rho * t * (log_t + log_tau), -log_tau * t * x.p / x.q
    dy, ds = 2 * ((r + A) * dA + A * dr), 2 * (r * dr - t * dt)

    P = _beta_over_one_minus_v2(x)
    one_plus_V2, one_minus_V2 = 1 + V * V, x.Z * (1 + V)
    a = M * x.beta
    is_flat = a <= 0
    # V sinh(a)/a, V psi(a) and V^2 phi(2 a).
    V_sinhc = jnp.where(is_flat, V, one_minus_V2 / jnp.where(is_flat, 1.0, 2 * a))
    V_psi = _scaled_psi(a, V, one_minus_V2)
    VV_phi = _scaled_phi(2 * a, V * V, one_minus_V2 * one_plus_V2)
    beta_coth = P * (1 + v * v)  # beta coth(beta)
    L = _langevin(x.beta, beta_coth)
    # 2 V^2 (S C_y - C S_y), and 2 V S_y.
    cross_y = 4 * g * g * M * P * P * (4 * M * M * VV_phi * beta_coth + V * V * L)
    V_S_y = 4 * g * g * P * P * M * (M * M * V_psi - V_sinhc * L)
    per_square = 1 / (1 + v) ** 2
    # 2 V^2 (S C_t - C S_t), and -2 V (s S_t + 2 C_t).
    cross_t = g * (2 * v * W * one_plus_V2 + 4 * M * V * V) * per_square
    minus_V_D_t = 2 * x.s * g * (2 * v * W + M * one_plus_V2) * per_square + 2 * M * W * x.w * x.w
    dRs = 2 * per_D * (g * W * dr - r * per_D * (cross_y * dy + (g * W) ** 2 * ds + cross_t * log_t))
    # 4 V C_y = 2 M g W.
    log_Ts = (minus_V_D_t * log_t - 2 * g * W * ds - (x.s * V_S_y + 2 * M * g * W) * dy) * (per_D / 2)

    Rs, Ts, _ = _pile(x)
    inverse = 1 / (1 - Rs * r)
    downward = x.Ta * inverse
    # All contributions to dR and dT are negative: no digits are lost. The absorptance gains what they lose.
    dR = rho * x.Ta * (log_t + log_tau) + downward * (
        Rs * t * log_t + inverse * (t * dRs + Rs * Rs * t * dr) + Rs * dt
    )
    dT = downward * Ts * (log_t + log_Ts + (r * dRs + Rs * dr) * inverse)
    return dR, dT, -(dR + dT)


def _beta_over_one_minus_v2(x: _PileState) -> _Reals:
    """P = beta/(1 - v^2), which is 1/2 at beta = 0."""
    is_clear = x.y <= 0
    return jnp.where(is_clear, 0.5, x.beta / (jnp.where(is_clear, 1.0, x.w) * (1 + x.v)))


def _scaled_psi(a: _Reals, decay: _Reals, one_minus_decay2: _Reals) -> _Reals:
    """exp(-a) (cosh a - sinh(a)/a)/a^2; `decay` = exp(-a), `one_minus_decay2` = 1 - exp(-2 a).

    Here and below, a Taylor series in a^2 below a = 1.5, where the difference would lose digits.
    """
    is_near, z, inverse = _series_or_closed_form(a)
    series = expint.polynomial(z, [(2 * j + 2) / math.factorial(2 * j + 3) for j in range(_n_terms(a))])
    closed = (1 - one_minus_decay2 / 2 - one_minus_decay2 / 2 * inverse) * (inverse * inverse)
    return jnp.where(is_near, decay * series, closed)


def _scaled_phi(a: _Reals, decay: _Reals, one_minus_decay2: _Reals) -> _Reals:
    """exp(-a) (sinh(a)/a - 1)/a^2, with the same arguments."""
    is_near, z, inverse = _series_or_closed_form(a)
    series = expint.polynomial(z, [1 / math.factorial(2 * j + 3) for j in range(_n_terms(a))])
    closed = (one_minus_decay2 / 2 * inverse - decay) * (inverse * inverse)
    return jnp.where(is_near, decay * series, closed)


def _langevin(a: _Reals, a_coth: _Reals) -> _Reals:
    """(a coth a - 1)/a^2, given `a_coth` = a coth a; for small a by Lambert's continued fraction in a^2."""
    is_near, z, inverse = _series_or_closed_form(a)
    numerator, denominator = _LAMBERT[a.dtype == jnp.float64]
    fraction = expint.polynomial(z, numerator) / expint.polynomial(z, denominator)
    return jnp.where(is_near, fraction, (a_coth - 1) * (inverse * inverse))


def _series_or_closed_form(a: _Reals) -> tuple[Bool[Array, "..."], _Reals, _Reals]:
    """True where the series is used; its argument a^2; 1/a for the closed form."""
    is_near = a < 1.5
    return is_near, jnp.where(is_near, a * a, 0.0), 1 / jnp.maximum(a, 1.5)


def _n_terms(a: _Reals) -> int:
    return 10 if a.dtype == jnp.float64 else 6


def _lambert(depth: int) -> tuple[Sequence[float], Sequence[float]]:
    """1/(3 + z/(5 + z/(7 + ...))), cut after `depth` levels, as a ratio of polynomials in z.

    With z = a^2 this is (a coth a - 1)/a^2, by Lambert's continued fraction of tanh (DLMF 4.39.1).
    """
    numerator, denominator = np.array([1.0]), np.array([2.0 * depth + 1])
    for b in range(2 * depth - 1, 1, -2):
        # b + z numerator/denominator, then its reciprocal.
        total = np.polynomial.polynomial.polyadd(b * denominator, np.concatenate([[0.0], numerator]))
        numerator, denominator = denominator, total
    return (numerator / denominator[0]).tolist(), (denominator / denominator[0]).tolist()


# By precision: single (False) and double.
_LAMBERT = {False: _lambert(5), True: _lambert(9)}
