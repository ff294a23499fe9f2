"""The generalised plate model: a leaf as N absorbing plates with rough surfaces, without cancellation.

*Surface* (Stern 1964; Allen 1973). Light arriving within the cone of half-angle alpha around the normal
is reflected with the mean r = 2/(1 - c^2) * integral over mu in [c, 1] of mu R(mu), c = cos alpha, where

    R(mu) = ((mu - g)/(mu + g))^2 / 2 + ((n^2 mu - g)/(n^2 mu + g))^2 / 2,   g = sqrt(n^2 - 1 + mu^2).

The mean is taken as an average over mu, which is smooth at alpha = 0 and 90 degrees, by Gauss-Legendre
quadrature; r and 1 - r come from separate sums of positive terms.

*Plate* (Allen et al. 1969). With the diffuse transmittance tau = 2 E3(k) of the interior, omega = 1 - tau
and q = t21 + r21 omega (which is 1 - r21 tau), one plate has t = t12 t21 tau / (q (1 + r21 tau)),
r = r12 + r21 tau t and the absorptance A = 1 - r - t = t12 omega / q. For the first plate, lit within the
cone, t12 and r12 are replaced by those of alpha.

*Pile* (Stokes 1862) of M = N - 1 plates, M real. With y = A (2 r + A), the decay per plate is
v = exp(-beta) = 2 t / (2 t + y + sqrt(y (y + 4 t))); with V = v^M, g = v/t, W = (1 - V^2)/(1 - v^2) and
s = 1 + r^2 - t^2 = (r + A)(1 + t) + r^2,

    D = s g W + 1 + V^2,  Rs = 2 r g W/D,  Ts = 2 V/D,  1 - Rs - Ts = (g W A (A + 2 t) + (1 - V)^2)/D.

Nothing here subtracts, so that all three keep their digits from transparent (A = 0: V = 1, W = M) to
opaque. The derivatives below are the derivatives of these expressions, put into the same form: textbook
Stokes' a, b and their square root are not differentiable at A = 0, while the result is.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, ArrayLike, Float

from jaxlidar import _expint

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(32)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2

_Reals = Float[Array, "..."]
Triple = tuple[_Reals, _Reals, _Reals]


class Surface(NamedTuple):
    """What a leaf's surface does to light: mean reflectances and transmittances, each of one shape.

    `t_alpha`, `r_alpha`: of light within the cone of incidence, from outside; `t12`, `r12`: of diffuse light
    from outside; `t21`, `r21`: of diffuse light from inside. Each pair adds up to 1.
    """

    t_alpha: Any
    r_alpha: Any
    t12: Any
    r12: Any
    t21: Any
    r21: Any


def surface(n: ArrayLike, alpha: float | int = 40.0) -> Surface:
    """Mean reflectances and transmittances of a dielectric surface.

    **Arguments:**

    - `n`: refractive index, any shape, at least 1. Exact to rounding from 1.01 on.
    - `alpha`: half-angle of the cone of incidence, degrees, 0..90 (default 40, PROSPECT's).

    **Returns:** a `Surface` of arrays shaped like `n`: JAX arrays where `n` is one, else NumPy arrays of
    float64.

    **Source:** Stern (1964), Appl. Opt. 3, 111; Allen (1973), J. Opt. Soc. Am. 63, 664.
    """
    xp: Any = jnp if isinstance(n, jax.Array) else np
    index = n if isinstance(n, jax.Array) else np.asarray(n, dtype=float)
    t_alpha, r_alpha = _cone(xp, index, alpha)
    t12, r12 = _cone(xp, index, 90.0)
    square = index * index
    # r21 = 1 - t12/n^2, as a sum.
    return Surface(t_alpha, r_alpha, t12, r12, t12 / square, r12 + t12 * ((index - 1) * (index + 1) / square))


def _cone(xp: Any, n: Any, alpha: float | int) -> tuple[Any, Any]:
    c = np.cos(np.deg2rad(alpha)) if alpha < 90 else 0.0
    n = n[..., None]
    mu = np.broadcast_to(c + (1 - c) * _NODES, (1,) * (n.ndim - 1) + _NODES.shape).astype(n.dtype)
    weight = (2 / (1 + c) * _WEIGHTS * (c + (1 - c) * _NODES)).reshape(mu.shape).astype(n.dtype)
    g = xp.sqrt((n - 1) * (n + 1) + mu * mu)
    square = n * n
    across, along = 1 / (mu + g), 1 / (square * mu + g)
    transmitted = 2 * mu * g * (across * across + square * along * along)
    # (mu - g)/(mu + g) = -(n^2 - 1)/(mu + g)^2, and likewise in the plane of incidence.
    excess = (n - 1) * (n + 1)
    s_wave = excess * across * across
    p_wave = excess * ((square + 1) * mu * mu - 1) * along * along
    reflected = (s_wave * s_wave + p_wave * p_wave) / 2
    return xp.sum(weight * transmitted, axis=-1), xp.sum(weight * reflected, axis=-1)


def plate_model(k: Float[ArrayLike, "..."], N: Float[ArrayLike, "..."], surface: Surface) -> Triple:
    """Reflectance, transmittance and absorptance of a leaf of N plates.

    **Arguments:**

    - `k`: optical depth of one plate (absorption coefficient times thickness), 0 or more.
    - `N`: number of plates, real, 1 or more. `k` and `N` are not checked, for they are mostly traced.
    - `surface`: as `surface` gives it.

    Shapes broadcast against each other.

    **Returns:** the three, of the common shape; their sum is 1 to rounding, and each has its own digits: the
    absorptance of a nearly transparent leaf is no difference of numbers near 1.

    All are differentiable in all arguments, also at k = 0, N = 1 and where they underflow. The second
    derivative in k diverges logarithmically at k = 0, where the one returned is large and finite.

    **Source:** Allen et al. (1969), J. Opt. Soc. Am. 59, 1376; Jacquemoud and Baret (1990), Remote Sens.
    Environ. 34, 75; Stokes (1862), Proc. R. Soc. Lond. 11, 545.
    """
    k, N, surface = _common(k, N, surface)
    return _leaf(k, N - 1, surface)


def plate_model_slopes(
    k: Float[ArrayLike, "..."], N: Float[ArrayLike, "..."], surface: Surface
) -> tuple[Triple, Triple, Triple]:
    """The same with its derivatives in k and in N, which share most of the work.

    **Arguments:** as for `plate_model`.

    **Returns:** reflectance, transmittance and absorptance; their derivatives in `k`; those in `N`.
    """
    k, N, surface = _common(k, N, surface)
    M = N - 1
    x = _state(k, M, surface)
    return _values(x), _slopes_k(x, k, M, surface), _slopes_M(x)


def _common(k: Any, N: Any, surface: Surface) -> tuple[_Reals, _Reals, Surface]:
    dtype = jnp.result_type(k, N, float)
    k, N, *face = jnp.broadcast_arrays(*(jnp.asarray(x, dtype) for x in (k, N, *surface)))
    return k, N, Surface(*face)


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


def _state(k: _Reals, M: _Reals, face: Surface) -> _State:
    tau, omega = _expint.tau(k), _expint.omega(k)
    q, p = face.t21 + face.r21 * omega, 1 + face.r21 * tau
    inside = face.t21 * tau / (q * p)
    t, Ta = face.t12 * inside, face.t_alpha * inside
    r, Ra = face.r12 + face.r21 * tau * t, face.r_alpha + face.r21 * tau * Ta
    A, Aa = face.t12 * omega / q, face.t_alpha * omega / q
    y = A * (2 * r + A)
    s = (r + A) * (1 + t) + r * r
    clear = y <= 0
    root = jnp.where(clear, 0.0, jnp.sqrt(jnp.where(clear, 1.0, y * (y + 4 * t))))
    total = 2 * t + y + root
    g, w = 2 / total, (y + root) / total
    v = t * g
    beta, V, Z = _decay(w, jax.lax.stop_gradient(v), M)
    W = jnp.where(clear, M, Z * (1 + V) / (jnp.where(clear, 1.0, w) * (1 + v)))
    D = s * g * W + 1 + V * V
    return _State(tau, t, r, A, Ta, Ra, Aa, q, p, y, s, g, v, w, beta, V, Z, W, D)


@jax.custom_jvp
def _decay(w: _Reals, v: _Reals, M: _Reals) -> Triple:
    """beta = -ln v, V = v^M and 1 - V, where v = 1 - w is given in both forms.

    In single precision exp(-M beta) would magnify the rounding of beta by M beta, which reaches 80: there
    v is split into a power of two and a factor near 1, and the former is raised exactly.
    """
    tiny = jnp.finfo(v.dtype).tiny
    thin = w < 0.3
    v = jnp.maximum(v, tiny)
    if v.dtype == jnp.float32:
        bits = jax.lax.bitcast_convert_type(v, jnp.int32)
        # The bits of 2/3: the factor comes out between 2/3 and 4/3.
        exponent = jnp.where(thin, 0, -((bits - 0x3F2AAAAB) >> 23))
        factor = jax.lax.bitcast_convert_type(bits + (exponent << 23), jnp.float32)
        log_factor = jnp.log1p(jnp.where(thin, -w, factor - 1))
        e = exponent.astype(v.dtype)
        beta = e * math.log(2) - log_factor
        # M in 1/256 times e is exact for all M e < 65536, and so is its distance to the nearest integer.
        coarse = jnp.round(M * 256) / 256
        whole = jnp.round(e * coarse)
        rest = (e * coarse - whole) + e * (M - coarse)
        whole = jnp.minimum(whole, 254).astype(jnp.int32)
        V = jnp.exp(jnp.minimum(M * log_factor, 88) - rest * math.log(2))
        for part in (whole >> 1, whole - (whole >> 1)):
            V *= jax.lax.bitcast_convert_type((127 - part) << 23, jnp.float32)
    else:
        beta = -jnp.where(thin, jnp.log1p(-jnp.where(thin, w, 0.0)), jnp.log(jnp.where(thin, 1.0, v)))
        V = jnp.exp(-M * beta)
    return beta, V, jnp.where(M * beta < 0.7, -jnp.expm1(-M * beta), 1 - V)


@_decay.defjvp
def _decay_jvp(primals, tangents):
    w, v, M = primals
    dw, _, dM = tangents
    beta, V, Z = _decay(w, v, M)
    dbeta = dw / jnp.maximum(v, jnp.finfo(v.dtype).tiny)
    dV = -V * (beta * dM + M * dbeta)
    return (beta, V, Z), (dbeta, dV, -dV)


@jax.custom_jvp
def _leaf(k: _Reals, M: _Reals, face: Surface) -> Triple:
    return _values(_state(k, M, face))


def _values(x: _State) -> Triple:
    Rs, Ts = 2 * x.r * x.g * x.W / x.D, 2 * x.V / x.D
    As = (x.g * x.W * x.A * (x.A + 2 * x.t) + x.Z * x.Z) / x.D
    into = x.Ta / (1 - Rs * x.r)
    return x.Ra + into * Rs * x.t, into * Ts, x.Aa + into * (As + Rs * x.A)


def _leaf_jvp(primals, tangents):
    k, M, face = primals
    dk, dM, dface = tangents
    x = _state(k, M, face)
    out = _values(x)
    total: list = [jnp.zeros_like(k)] * 3
    if not isinstance(dk, SymbolicZero):
        total = [a + b * dk for a, b in zip(total, _slopes_k(x, k, M, face))]
    if not isinstance(dM, SymbolicZero):
        total = [a + b * dM for a, b in zip(total, _slopes_M(x))]
    if not all(isinstance(d, SymbolicZero) for d in dface):
        dface = Surface(*(jnp.zeros_like(k) if isinstance(d, SymbolicZero) else d for d in dface))
        _, change = jax.jvp(lambda f: _values(_state(k, M, f)), (face,), (dface,))
        total = [a + b for a, b in zip(total, change)]
    return out, tuple(total)


_leaf.defjvp(_leaf_jvp, symbolic_zeros=True)


def _slopes_M(x: _State) -> Triple:
    """Derivatives of the leaf's reflectance, transmittance and absorptance in M."""
    r, t, A, g, V = x.r, x.t, x.A, x.g, x.V
    P = _beta_share(x)
    square, rest = 1 + V * V, x.Z * (1 + V)
    dRs = 8 * r * g * P * (V / x.D) ** 2
    log_Ts = -(x.s * g * P * square + x.beta * rest) / x.D
    dAs = (
        4
        * g
        * P
        * V
        * (x.s * x.Z * x.Z / 2 + V * A * (2 * t + A) + x.w * (1 + x.v) * rest / (2 * g))
        / (x.D * x.D)
    )
    Rs, Ts = 2 * r * g * x.W / x.D, 2 * V / x.D
    As = (g * x.W * A * (A + 2 * t) + x.Z * x.Z) / x.D
    inverse = 1 / (1 - Rs * r)
    into = x.Ta * inverse
    again = r * dRs * inverse
    return (
        into * inverse * t * dRs,
        into * Ts * (log_Ts + again),
        into * (dAs + A * dRs + (As + Rs * A) * again),
    )


def _slopes_k(x: _State, k: _Reals, M: _Reals, face: Surface) -> Triple:
    """Derivatives of the leaf's reflectance, transmittance and absorptance in k."""
    r, t, A, g, v, V, W, D = x.r, x.t, x.A, x.g, x.v, x.V, x.W, x.D
    slope = _expint.log_slope(k)
    rho = face.r21 * x.tau
    log_t = slope * (1 + rho * rho) / (x.q * x.p)
    dt, dr, dA = t * log_t, rho * t * (log_t + slope), -slope * t * x.p / x.q
    dy, ds = 2 * ((r + A) * dA + A * dr), 2 * (r * dr - t * dt)

    P = _beta_share(x)
    square = 1 + V * V
    a, b = M * x.beta, 2 * M * x.beta
    V_sinhc, V_psi, _ = _even(a, V, x.Z * (1 + V))
    _, _, VV_phi = _even(b, V * V, x.Z * (1 + V) * square)
    sinhc_v, psi_v, _ = _even(x.beta, v, x.w * (1 + v))
    phi_2 = psi_v / sinhc_v
    gamma = 4 * g * g * M * P * P * (4 * M * M * VV_phi * P * (1 + v * v) + V * V * phi_2)
    h = 4 * g * g * P * P * M * (M * M * V_psi - V_sinhc * phi_2)
    drain = (2 * v * W * square + 4 * M * V * V) / (x.y + 4 * t)
    dRs = 2 * g * W * dr / D - 2 * r * (gamma * dy + (g * W) ** 2 * ds + drain * log_t) / (D * D)
    fall = 2 * x.s * g * (2 * v * W + M * square) / (1 + v) ** 2 + 2 * M * W * x.w * x.w
    log_Ts = (fall * log_t - 2 * g * W * ds - (x.s * h + 2 * M * g * W) * dy) / (2 * D)

    Rs, Ts = 2 * r * g * W / D, 2 * V / D
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


def _even(a: _Reals, decay: _Reals, rest: _Reals) -> Triple:
    """exp(-a) times sinh(a)/a, (cosh a - sinh(a)/a)/a^2 and (sinh(a)/a - 1)/a^2.

    `decay` = exp(-a) and `rest` = 1 - exp(-2 a). Taylor series in a^2 below a = 1.5, where the differences
    would lose digits.
    """
    near = a < 1.5
    z = jnp.where(near, a * a, 0.0)
    terms = 10 if a.dtype == jnp.float64 else 6
    sinhc, psi, phi = (_taylor(z, [f(j) for j in range(terms)]) for f in (_sinhc_term, _psi_term, _phi_term))
    far = jnp.where(near, 1.5, a)
    far_sinhc = rest / (2 * far)
    far_psi = (1 - rest / 2 - far_sinhc) / (far * far)
    far_phi = (far_sinhc - decay) / (far * far)
    return (
        jnp.where(near, decay * sinhc, far_sinhc),
        jnp.where(near, decay * psi, far_psi),
        jnp.where(near, decay * phi, far_phi),
    )


def _taylor(z: _Reals, coefficients: list[float]) -> _Reals:
    total = jnp.full_like(z, coefficients[-1])
    for c in coefficients[-2::-1]:
        total = total * z + jnp.asarray(c, z.dtype)
    return total


def _sinhc_term(j: int) -> float:
    return 1 / math.factorial(2 * j + 1)


def _phi_term(j: int) -> float:
    return 1 / math.factorial(2 * j + 3)


def _psi_term(j: int) -> float:
    return (2 * j + 2) / math.factorial(2 * j + 3)
