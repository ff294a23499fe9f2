"""PROSPECT's plate model (a leaf as N absorbing plates) against the textbook's formulas in 150 digits.

Reflectance, transmittance, absorptance and their derivatives in k (optical depth of a plate) and N, in single
and double precision. Errors are relative. Numbers below the smallest normal number of single precision
(1.2e-38) are measured against that one, in both precisions. The surface is that of the exact refractive
index, as `Prospect` passes it.
"""

import functools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from jaxlidar.optics.leaf_surface import LeafSurface, leaf_surface
from jaxlidar.optics.plate_model import plate_model, plate_model_slopes
from tests.helpers import BY_PRECISION

# Optical depths and numbers of plates, half-angles of incidence in degrees, refractive indices.
KS = (0.0, 1e-8, 1e-4, 1e-2, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
NS = (1.0, 1.0001, 1.5, 2.0, 3.4, 10.0)
ALPHAS = (0.0, 40.0, 59.0, 90.0)
INDICES = (1.2, 1.3, 1.42, 1.55)
# Compiling takes much longer than running here.
quick_jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
NAMES = ("R", "T", "A", "dR/dk", "dT/dk", "dA/dk", "dR/dN", "dT/dN", "dA/dN")
SMALLEST = mpmath.mpf(float(np.finfo(np.float32).tiny))


@functools.cache
def exact_cone_transmittance(n, alpha):
    """Mean transmittance of a surface within a cone, by adaptive quadrature of Fresnel's formulas."""
    c = mpmath.cos(mpmath.radians(alpha)) if alpha < 90 else mpmath.mpf(0)

    def transmitted(mu):
        inside = mpmath.sqrt(1 - (1 - mu**2) / mpmath.mpf(n) ** 2)
        s_wave, p_wave = (mu - n * inside) / (mu + n * inside), (n * mu - inside) / (n * mu + inside)
        return 2 * mu * (1 - (s_wave**2 + p_wave**2) / 2)

    if alpha == 0:
        return transmitted(mpmath.mpf(1)) / 2
    with mpmath.workdps(40):
        return mpmath.quad(transmitted, [c, (1 + c) / 2, 1]) / (1 - c**2)


@functools.cache
def exact_tau(k):
    """Transmittance 2 E3(k) of the interior of a plate for diffuse light."""
    return 2 * mpmath.expint(3, k)


def textbook(k, N, n, alpha):
    """R, T and 1 - R - T by Allen et al. (1969) and Stokes (1862), as printed in the literature on
    PROSPECT."""
    t_alpha, t12 = exact_cone_transmittance(n, alpha), exact_cone_transmittance(n, 90.0)
    t21 = t12 / mpmath.mpf(n) ** 2
    r21 = 1 - t21
    tau = exact_tau(k)
    denominator = 1 - (r21 * tau) ** 2
    Ta = t_alpha * tau * t21 / denominator
    Ra = 1 - t_alpha + r21 * tau * Ta
    t = t12 * tau * t21 / denominator
    r = 1 - t12 + r21 * tau * t
    root = mpmath.sqrt((1 + r + t) * (1 + r - t) * (1 - r + t) * (1 - r - t))
    a, b = (1 + r**2 - t**2 + root) / (2 * r), (1 - r**2 + t**2 + root) / (2 * t)
    power = b ** (N - 1)
    Rs = a * (power**2 - 1) / (a**2 * power**2 - 1)
    Ts = power * (a**2 - 1) / (a**2 * power**2 - 1)
    R, T = Ra + Ta * Rs * t / (1 - Rs * r), Ta * Ts / (1 - Rs * r)
    return R, T, 1 - R - T


@functools.cache
def exact_values_and_slopes(k, N, n, alpha):
    """The nine numbers of NAMES; derivatives as differences in 150 digits.

    The formulas fail at k = 0, for which k = 1e-50 stands.
    """
    with mpmath.workdps(150):
        k, N, small = max(mpmath.mpf(k), mpmath.mpf(10) ** -50), mpmath.mpf(N), mpmath.mpf(10) ** -18
        values = textbook(k, N, n, alpha)
        in_k = (textbook(k * (1 + s), N, n, alpha) for s in (small, -small))
        in_N = (textbook(k, N + s, n, alpha) for s in (small, -small))
        return [
            *values,
            *((up - down) / (2 * small * k) for up, down in zip(*in_k)),
            *((up - down) / (2 * small) for up, down in zip(*in_N)),
        ]


def grid_points(precision):
    """All combinations (k, N, n, alpha), with k and N in a precision."""
    real = np.dtype(precision).type
    return [(real(k), real(N), n, a) for k in KS for N in NS for n in INDICES for a in ALPHAS]


static_surface = functools.cache(leaf_surface)


def surfaces(points):
    """The surfaces of points (k, N, n, alpha), as one `LeafSurface` of arrays."""
    rows = [static_surface(n, alpha) for *_, n, alpha in points]
    return LeafSurface(*(np.array(column) for column in zip(*rows)))


def values_and_slopes(k, N, face):
    """The nine numbers of NAMES by the public function and its forward derivatives."""
    tangent = jnp.ones_like(k)
    values, in_k = jax.jvp(lambda k: plate_model(k, N, face), (k,), (tangent,))
    _, in_N = jax.jvp(lambda N: plate_model(k, N, face), (N,), (tangent,))
    return jnp.stack([*values, *in_k, *in_N])


TOLERANCE = {"float32": 1e-5, "float64": 1e-13}


@BY_PRECISION
def test_against_the_textbook_in_150_digits(precision):
    points = grid_points(precision)
    k, N = (jnp.array([p[i] for p in points]) for i in (0, 1))
    face = surfaces(points)
    computed = np.asarray(jax.jit(lambda k, N: values_and_slopes(k, N, face))(k, N), dtype=float)
    for i, p in enumerate(points):
        exact = exact_values_and_slopes(float(p[0]), float(p[1]), *p[2:])
        for name, value, x in zip(NAMES, computed[:, i], exact):
            error = float(abs(mpmath.mpf(float(value)) - x) / max(abs(x), SMALLEST))
            # Below SMALLEST single precision has no digits, and zero is exact.
            is_underflow = abs(x) < SMALLEST and value < 1e-37
            assert error < TOLERANCE[precision] or is_underflow, (name, p, value, float(x), error)


def test_energy_is_conserved(precision):
    points = grid_points(precision)
    k, N = (jnp.array([p[i] for p in points]) for i in (0, 1))
    R, T, A = jax.jit(plate_model)(k, N, surfaces(points))
    unit = float(np.finfo(precision).eps)
    np.testing.assert_allclose(R + T + A, 1, rtol=4 * unit)
    np.testing.assert_allclose((R + T)[k == 0], 1, rtol=4 * unit)
    assert np.all(A[k == 0] == 0)


def test_slopes_are_the_derivatives(precision):
    k, N = jnp.array([0.0, 1e-3, 0.2, 2.0]), jnp.array([1.0, 1.5, 3.0, 2.0])
    face = LeafSurface(*(jnp.asarray(f, precision) for f in leaf_surface(np.full(4, 1.42))))
    values, in_k, in_N = plate_model_slopes(k, N, face)
    np.testing.assert_allclose(
        jnp.stack([*values, *in_k, *in_N]), jax.jit(values_and_slopes)(k, N, face), rtol=1e-6
    )


@pytest.mark.slow
@BY_PRECISION
def test_reverse_equals_forward(precision):
    unit = float(np.finfo(precision).eps)
    k, N = jnp.array([0.0, 0.0, 0.1, 0.5, 50.0]), jnp.array([1.0, 2.0, 1.0, 2.3, 9.0])
    face = LeafSurface(*(jnp.asarray(f, precision) for f in leaf_surface(np.full(5, 1.42))))
    forward, backward = (
        quick_jit(jax.vmap(jacobian(plate_model, argnums=(0, 1, 2))))(k, N, face)
        for jacobian in (jax.jacfwd, jax.jacrev)
    )
    for a, b in zip(jax.tree.leaves(forward), jax.tree.leaves(backward)):
        np.testing.assert_allclose(a, b, rtol=20 * unit, atol=4 * unit)


def test_derivatives_in_the_surface():
    with jax.enable_x64(True):
        k, N, h = jnp.array([0.0, 0.01, 1.0]), jnp.array([1.0, 2.5, 1.7]), 1e-6

        @jax.jit
        def of_index(n):
            return plate_model(k, N, leaf_surface(jnp.full(3, n), 59.0))

        _, slopes = jax.jvp(of_index, (1.42,), (1.0,))
        for slope, up, down in zip(slopes, of_index(1.42 + h), of_index(1.42 - h)):
            np.testing.assert_allclose(slope, (up - down) / (2 * h), rtol=1e-7, atol=1e-9)


@pytest.mark.slow
def test_second_derivatives():
    with jax.enable_x64(True):
        face, h = leaf_surface(1.42), 1e-5
        k, N = jnp.array([1e-3, 0.2, 0.5, 3.0]), jnp.array([1.5, 1.0, 3.0, 2.0])

        def reflectance(k, N):
            return plate_model(k, N, face)[0]

        first = quick_jit(jax.vmap(jax.grad(reflectance, argnums=(0, 1))))
        second = quick_jit(jax.vmap(jax.hessian(reflectance, argnums=(0, 1))))(k, N)
        step = h * k
        in_k = [(a - b) / (2 * step) for a, b in zip(first(k + step, N), first(k - step, N))]
        in_N = [(a - b) / (2 * h) for a, b in zip(first(k, N + h), first(k, N - h))]
        np.testing.assert_allclose(second[0], [in_k[0], in_N[0]], rtol=1e-6)
        np.testing.assert_allclose(second[1], [in_k[1], in_N[1]], rtol=1e-6)


@BY_PRECISION
def test_nothing_is_nan_or_infinite(precision):
    grid = [
        (k, N, n, a)
        for k in (*KS, 1e-30, 1e3, 1e4)
        for N in (1.0, 1.0001, 2.0, 10.0, 1e3)
        for n in (1.0, 1.5)
        for a in (0.0, 90.0)
    ]
    k, N = (jnp.array([p[i] for p in grid]) for i in (0, 1))
    face = surfaces(grid)
    assert np.all(np.isfinite(jax.jit(values_and_slopes)(k, N, face)))

    def total(k, N, face):
        return sum(jnp.sum(x) for x in plate_model(k, N, face))

    @jax.jit
    def reverse_and_curvature(k, N, face):
        slopes = jax.grad(total, argnums=(0, 1, 2))
        return slopes(k, N, face), jax.jvp(lambda k, N: slopes(k, N, face)[:2], (k, N), (k + 1, N))

    reverse, curvature = reverse_and_curvature(k, N, face)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((reverse, curvature)))


@pytest.mark.parametrize("alpha", ALPHAS)
def test_surface(alpha, precision):
    for n in (1.01, 1.2, 1.55, 2.5):
        t_alpha, t12 = float(exact_cone_transmittance(n, alpha)), float(exact_cone_transmittance(n, 90.0))
        exact = LeafSurface(t_alpha, 1 - t_alpha, t12, 1 - t12, t12 / n**2, 1 - t12 / n**2)
        np.testing.assert_allclose(leaf_surface(n, alpha), exact, rtol=3e-12)
        # Traced or JAX indices go through working precision.
        n = jnp.asarray(n)
        rtol = 8 * float(np.finfo(precision).eps)
        np.testing.assert_allclose(leaf_surface(n, alpha), leaf_surface(float(n), alpha), rtol=rtol)


def test_an_index_of_one_has_no_surface():
    np.testing.assert_allclose(leaf_surface(1.0, 40.0), (1, 0, 1, 0, 1, 0), atol=1e-15)
