"""The generalised plate model: a leaf as N absorbing plates with rough surfaces, without cancellation.

*Surface* (Stern 1964; Allen 1973). Light that arrives within the cone of half-angle alpha around the
normal is reflected with the mean r = 2/(1 - c^2) * integral over mu in [c, 1] of mu R(mu), c = cos alpha,
where

    R(mu) = ((mu - g)/(mu + g))^2 / 2 + ((n^2 mu - g)/(n^2 mu + g))^2 / 2,   g = sqrt(n^2 - 1 + mu^2).

The mean is an average over mu, which is smooth at alpha = 0 and 90 degrees, by Gauss-Legendre quadrature.
r and 1 - r come from separate sums of positive terms.

*Plate* (Allen et al. 1969). With the diffuse transmittance tau = 2 E3(k) of the interior, omega = 1 - tau
and q = t21 + r21 omega (which is 1 - r21 tau), one plate has t = t12 t21 tau / (q (1 + r21 tau)),
r = r12 + r21 tau t and the absorptance A = 1 - r - t = t12 omega / q. For the first plate, lit within the
cone, t12 and r12 are replaced by those of alpha.

*Pile* (Stokes 1862) of M = N - 1 plates, M real. With y = A (2 r + A), the decay per plate is
v = exp(-beta) = 2 t / (2 t + y + sqrt(y (y + 4 t))); with V = v^M, g = v/t, W = (1 - V^2)/(1 - v^2) and
s = 1 + r^2 - t^2 = (r + A)(1 + t) + r^2,

    D = s g W + 1 + V^2,  Rs = 2 r g W/D,  Ts = 2 V/D,  1 - Rs - Ts = (g W A (A + 2 t) + (1 - V)^2)/D.

Nothing here is a difference of close numbers, so that all three are accurate from transparent (A = 0: V = 1,
W = M) to opaque. Single precision needs more: V = v^M magnifies the rounding of beta by M beta, which
reaches 80. There v is corrected and beta carried with twice the digits (`jaxlidar._double_single`).
The derivatives below are those of these expressions, put into the same form. Textbook Stokes' a, b and
their square root are not differentiable at A = 0, while the result is.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxlidar import _double_single as pair
from jaxlidar import _expint
from jaxlidar._double_single import DoubleSingle
from jaxlidar._one_function import once
from jaxlidar.optics.leaf_surface import LeafSurface

_Reals = Float[Array, "..."]
Triple = tuple[_Reals, _Reals, _Reals]


def plate_model(k: Float[ArrayLike, "..."], N: Float[ArrayLike, "..."], surface: LeafSurface) -> Triple:
    """Reflectance, transmittance and absorptance of a leaf of N plates.

    All three are differentiable in all arguments, also at k = 0, at N = 1 and where they underflow. The
    second derivative in k diverges logarithmically at k = 0; the one returned there is large and finite.

    Measured relative errors, for k up to 100, N up to 10 and n from 1.2 to 1.55:

    - Double precision: 2e-14.
    - Single precision: 7e-7 for the three, 1e-6 for the derivatives of transmittance and those in N, and
      1.2e-6 for dR/dk, dA/dk and dR/dN, each at the worst of 400,000 random points (999 of 1,000 lie within
      8e-7). Derivatives below 1e-30 lose digits on their way to zero. A surface of NumPy numbers enters with
      all its digits. One of JAX arrays, which are rounded, costs up to 3e-7 more.

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


def _arrays(k: Any, N: Any, surface: LeafSurface) -> tuple[_Reals, _Reals, LeafSurface, DoubleSingle | None]:
    """Arrays of one type, and in single precision kappa = (r12 + r21)/t21 in double-single."""
    dtype = jnp.result_type(k, N, float)
    k, N, *face = (jnp.asarray(x, dtype) for x in (k, N, *surface))
    face, bounces = LeafSurface(*face), None
    if dtype == jnp.float32:
        if any(isinstance(x, jax.Array) for x in surface):
            total = pair.plus(pair.split(face.r21), pair.split(face.r12))
            bounces = pair.over(total, pair.split(face.t21), 1 / face.t21)
        else:
            bounces = pair.constant((np.asarray(surface.r12, float) + surface.r21) / surface.t21)
    return k, N, face, bounces


# Compiled whole: by itself, every operation of it would be a program to compile.
@jax.jit
def _values_of(k: _Reals, N: _Reals, face: LeafSurface, bounces: DoubleSingle | None) -> Triple:
    k, N, face, bounces = _alike(k, N, face, bounces)
    return _leaf(k, N - 1, face, bounces)


@jax.jit
def _slopes_of(
    k: _Reals, N: _Reals, face: LeafSurface, bounces: DoubleSingle | None
) -> tuple[Triple, Triple, Triple]:
    k, N, face, bounces = _alike(k, N, face, bounces)
    return _everything(k, N - 1, face, bounces)


def _alike(
    k: _Reals, N: _Reals, face: LeafSurface, bounces: DoubleSingle | None
) -> tuple[_Reals, _Reals, LeafSurface, DoubleSingle | None]:
    """Arrays of one shape."""
    k, N, *rest = jnp.broadcast_arrays(k, N, *face, *(bounces or ()))
    return k, N, LeafSurface(*rest[:6]), bounces and DoubleSingle(*rest[6:])


class _State(NamedTuple):
    """What values and derivatives share, in the names of the module's docstring."""

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


def _state(k: _Reals, M: _Reals, face: LeafSurface, bounces: DoubleSingle | None) -> _State:
    # The barriers keep the compiler from computing these again for every output (twice as fast on the CPU).
    tau, omega = once((_expint.tau(k), _expint.omega(k)))
    q, p = face.t21 + face.r21 * omega, 1 + face.r21 * tau
    inside = face.t21 * tau / (q * p)
    t, Ta = face.t12 * inside, face.t_alpha * inside
    r, Ra = face.r12 + face.r21 * tau * t, face.r_alpha + face.r21 * tau * Ta
    absorbed = omega / q
    A, Aa = face.t12 * absorbed, face.t_alpha * absorbed
    y = A * (2 * r + A)
    s = (r + A) * (1 + t) + r * r
    clear = y <= 0
    root = jnp.where(clear, 0.0, jnp.sqrt(jnp.where(clear, 1.0, y * (y + 4 * t))))
    per_total = 1 / (2 * t + y + root)
    g, w = 2 * per_total, (y + root) * per_total
    v = t * g
    fine = None
    if bounces is not None:
        scaled = face.t12 * face.t21 * _expint.scaled_tau(k) / (q * p) * g
        exact, fine = pair.refined(*jax.lax.stop_gradient((k, w, scaled, bounces)))
        w = w + (exact[0] - jax.lax.stop_gradient(w))
        v = v + (exact[1] - jax.lax.stop_gradient(v))
    beta, V, Z = once(_decay(w, jax.lax.stop_gradient(v), M, fine))
    W = jnp.where(clear, M, Z * (1 + V) / (jnp.where(clear, 1.0, w) * (1 + v)))
    D = s * g * W + 1 + V * V
    return _State(tau, t, r, A, Ta, Ra, Aa, q, p, y, s, g, v, w, beta, V, Z, W, D)


@jax.custom_jvp
def _decay(w: _Reals, v: _Reals, M: _Reals, fine: DoubleSingle | None) -> Triple:
    """beta = -ln v, V = v^M and 1 - V, where v = 1 - w is given in both forms."""
    if fine is not None:
        return pair.single(fine), *pair.exp_minus(pair.times(pair.split(M), fine))
    thin = w < 0.3
    v = jnp.maximum(v, jnp.finfo(v.dtype).tiny)
    beta = -jnp.where(thin, jnp.log1p(-jnp.where(thin, w, 0.0)), jnp.log(jnp.where(thin, 1.0, v)))
    return beta, jnp.exp(-M * beta), -jnp.expm1(-M * beta)


@_decay.defjvp
def _decay_jvp(primals, tangents):
    _, v, M, _ = primals
    dw, _, dM, _ = tangents
    beta, V, Z = _decay(*primals)
    dbeta = dw / jnp.maximum(v, jnp.finfo(v.dtype).tiny)
    dV = -V * (beta * dM + M * dbeta)
    return (beta, V, Z), (dbeta, dV, -dV)


@jax.custom_jvp
@jax.jit
def _leaf(k: _Reals, M: _Reals, face: LeafSurface, bounces: DoubleSingle | None) -> Triple:
    return _values(_state(k, M, face, bounces))


@jax.jit
def _everything(
    k: _Reals, M: _Reals, face: LeafSurface, bounces: DoubleSingle | None
) -> tuple[Triple, Triple, Triple]:
    """Values, derivatives in k and derivatives in M."""
    x = _state(k, M, face, bounces)
    return _values(x), _slopes_k(x, k, M, face), _slopes_M(x)


@jax.jit
def _change(
    k: _Reals, M: _Reals, face: LeafSurface, bounces: DoubleSingle | None, dface: LeafSurface
) -> Triple:
    """Changes of reflectance, transmittance and absorptance with a change of the surface."""
    return jax.jvp(lambda f: _values(_state(k, M, f, bounces)), (face,), (dface,))[1]


def _pile(x: _State) -> Triple:
    """Rs, Ts and 1 - Rs - Ts."""
    per_D = 1 / x.D
    lost = x.g * x.W * x.A * (x.A + 2 * x.t) + x.Z * x.Z
    return 2 * x.r * x.g * x.W * per_D, 2 * x.V * per_D, lost * per_D


def _values(x: _State) -> Triple:
    Rs, Ts, As = _pile(x)
    into = x.Ta / (1 - Rs * x.r)
    return x.Ra + into * Rs * x.t, into * Ts, x.Aa + into * (As + Rs * x.A)


def _leaf_jvp(primals, tangents):
    k, M, face, bounces = primals
    dk, dM, dface, _ = tangents
    out, in_k, in_M = _everything(k, M, face, bounces)
    total: list = [jnp.zeros_like(k)] * 3
    for slopes, change in ((in_k, dk), (in_M, dM)):
        if not isinstance(change, SymbolicZero):
            total = [a + b * change for a, b in zip(total, slopes)]
    if not all(isinstance(d, SymbolicZero) for d in dface):
        dface = LeafSurface(*(jnp.zeros_like(k) if isinstance(d, SymbolicZero) else d for d in dface))
        total = [a + b for a, b in zip(total, _change(k, M, face, bounces, dface))]
    return out, tuple(total)


_leaf.defjvp(_leaf_jvp, symbolic_zeros=True)


def _slopes_M(x: _State) -> Triple:
    """Derivatives of the leaf's reflectance, transmittance and absorptance in M."""
    r, t, A, g, V = x.r, x.t, x.A, x.g, x.V
    P = _beta_share(x)
    square, rest = 1 + V * V, x.Z * (1 + V)
    per_D = 1 / x.D
    dRs = 8 * r * g * P * (V * per_D) ** 2
    log_Ts = -(x.s * g * P * square + x.beta * rest) * per_D
    gain = x.s * x.Z * x.Z / 2 + V * A * (2 * t + A) + x.w * (1 + x.v) * rest / (2 * g)
    dAs = 4 * g * P * V * gain * per_D * per_D
    Rs, Ts, As = _pile(x)
    inverse = 1 / (1 - Rs * r)
    into = x.Ta * inverse
    again = r * dRs * inverse
    return (
        into * inverse * t * dRs,
        into * Ts * (log_Ts + again),
        into * (dAs + A * dRs + (As + Rs * A) * again),
    )


def _slopes_k(x: _State, k: _Reals, M: _Reals, face: LeafSurface) -> Triple:
    """Derivatives of the leaf's reflectance, transmittance and absorptance in k."""
    r, t, A, g, v, V, W, per_D = x.r, x.t, x.A, x.g, x.v, x.V, x.W, 1 / x.D
    slope = _expint.log_slope(k)
    rho = face.r21 * x.tau
    log_t = slope * (1 + rho * rho) / (x.q * x.p)
    dt, dr, dA = t * log_t, rho * t * (log_t + slope), -slope * t * x.p / x.q
    dy, ds = 2 * ((r + A) * dA + A * dr), 2 * (r * dr - t * dt)

    P = _beta_share(x)
    square, rest = 1 + V * V, x.Z * (1 + V)
    a = M * x.beta
    flat = a <= 0
    V_sinhc = jnp.where(flat, V, rest / jnp.where(flat, 1.0, 2 * a))
    V_psi = _scaled_psi(a, V, rest)
    VV_phi = _scaled_phi(2 * a, V * V, rest * square)
    coth = P * (1 + v * v)  # beta coth(beta)
    phi_2 = _langevin(x.beta, coth)
    gamma = 4 * g * g * M * P * P * (4 * M * M * VV_phi * coth + V * V * phi_2)
    h = 4 * g * g * P * P * M * (M * M * V_psi - V_sinhc * phi_2)
    per_sum = 1 / (1 + v) ** 2
    drain = g * (2 * v * W * square + 4 * M * V * V) * per_sum
    dRs = 2 * per_D * (g * W * dr - r * per_D * (gamma * dy + (g * W) ** 2 * ds + drain * log_t))
    fall = 2 * x.s * g * (2 * v * W + M * square) * per_sum + 2 * M * W * x.w * x.w
    log_Ts = (fall * log_t - 2 * g * W * ds - (x.s * h + 2 * M * g * W) * dy) * (per_D / 2)

    Rs, Ts, _ = _pile(x)
    inverse = 1 / (1 - Rs * r)
    into = x.Ta * inverse
    # All contributions to either are negative; the absorptance takes what they lose.
    dR = rho * x.Ta * (log_t + slope) + into * (
        Rs * t * log_t + inverse * (t * dRs + Rs * Rs * t * dr) + Rs * dt
    )
    dT = into * Ts * (log_t + log_Ts + (r * dRs + Rs * dr) * inverse)
    return dR, dT, -(dR + dT)


def _beta_share(x: _State) -> _Reals:
    """beta/(1 - v^2), which is 1/2 at beta = 0."""
    clear = x.y <= 0
    return jnp.where(clear, 0.5, x.beta / (jnp.where(clear, 1.0, x.w) * (1 + x.v)))


def _scaled_psi(a: _Reals, decay: _Reals, rest: _Reals) -> _Reals:
    """exp(-a) (cosh a - sinh(a)/a)/a^2; `decay` = exp(-a), `rest` = 1 - exp(-2 a).

    Here and below, a Taylor series in a^2 below a = 1.5, where the difference would lose digits.
    """
    near, z, far = _ranges(a)
    series = _expint.polynomial(z, [(2 * j + 2) / math.factorial(2 * j + 3) for j in range(_terms(a))])
    return jnp.where(near, decay * series, (1 - rest / 2 - rest / 2 * far) * (far * far))


def _scaled_phi(a: _Reals, decay: _Reals, rest: _Reals) -> _Reals:
    """exp(-a) (sinh(a)/a - 1)/a^2, with the same arguments."""
    near, z, far = _ranges(a)
    series = _expint.polynomial(z, [1 / math.factorial(2 * j + 3) for j in range(_terms(a))])
    return jnp.where(near, decay * series, (rest / 2 * far - decay) * (far * far))


def _langevin(a: _Reals, coth: _Reals) -> _Reals:
    """(a coth a - 1)/a^2, given `coth` = a coth a; for small a by Lambert's continued fraction in a^2."""
    near, z, far = _ranges(a)
    numerator, denominator = _LAMBERT[a.dtype == jnp.float64]
    return jnp.where(
        near, _expint.polynomial(z, numerator) / _expint.polynomial(z, denominator), (coth - 1) * (far * far)
    )


def _ranges(a: _Reals) -> tuple[Bool[Array, "..."], _Reals, _Reals]:
    """Whether the series is used; its argument a^2; 1/a for the closed form."""
    near = a < 1.5
    return near, jnp.where(near, a * a, 0.0), 1 / jnp.maximum(a, 1.5)


def _terms(a: _Reals) -> int:
    return 10 if a.dtype == jnp.float64 else 6


def _lambert(depth: int) -> tuple[Sequence[float], Sequence[float]]:
    """1/(3 + z/(5 + z/(7 + ...))), cut after `depth` levels, as a ratio of polynomials in z."""
    numerator, denominator = np.array([1.0]), np.array([2.0 * depth + 1])
    for b in range(2 * depth - 1, 1, -2):
        # b + z numerator/denominator, then its reciprocal.
        up = np.polynomial.polynomial.polyadd(b * denominator, np.concatenate([[0.0], numerator]))
        numerator, denominator = denominator, up
    return (numerator / denominator[0]).tolist(), (denominator / denominator[0]).tolist()


_LAMBERT = {False: _lambert(5), True: _lambert(9)}
