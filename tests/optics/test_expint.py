"""The exponential integrals, 2 E3 and their derivatives against mpmath, in both precisions.

Exact values are those of the arguments as rounded to the precision.
"""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from jaxlidar.optics import expint
from tests.helpers import BY_PRECISION

EXACT = {
    "e1": mpmath.e1,
    "e2": lambda k: mpmath.expint(2, k),
    "tau": lambda k: 2 * mpmath.expint(3, k),
    "omega": lambda k: 1 - 2 * mpmath.expint(3, k),
    "log_slope": lambda k: -mpmath.expint(2, k) / mpmath.expint(3, k),
}
SLOPE = {
    "e1": lambda k: -mpmath.exp(-k) / k,
    "e2": lambda k: -mpmath.e1(k),
    "tau": lambda k: -2 * mpmath.expint(2, k),
    "omega": lambda k: 2 * mpmath.expint(2, k),
    "log_slope": lambda k: mpmath.diff(EXACT["log_slope"], k),
}
# About four units in the last place; E1 matters to second derivatives only.
TOLERANCE = {"float32": 5e-7, "float64": 4e-15}


def arguments(precision):
    """Optical depths from 1e-12 to 80, denser about the break of the approximations at 1."""
    k = np.concatenate([10 ** np.linspace(-12, 1.9, 60), np.linspace(0.3, 3, 60), [1.0, np.nextafter(1, 0)]])
    return np.unique(k.astype(precision))


def relative_error(values, exact):
    """Relative errors of numbers against numbers of mpmath."""
    return np.array([float(abs((mpmath.mpf(float(v)) - x) / x)) for v, x in zip(np.asarray(values), exact)])


@pytest.mark.parametrize("name", EXACT)
def test_values_and_derivatives(name, precision):
    k = arguments(precision)
    function = getattr(expint, name)
    values, slopes = jax.jit(lambda k: jax.jvp(function, (k,), (jnp.ones_like(k),)))(jnp.asarray(k))
    assert values.dtype == precision
    with mpmath.workdps(40):
        points = [mpmath.mpf(float(x)) for x in k]
        assert relative_error(values, [EXACT[name](x) for x in points]).max() < TOLERANCE[precision]
        # The derivative of log_slope is a difference of nearly equal numbers where it does not matter.
        tolerance = TOLERANCE[precision] * (1 if name != "log_slope" else 30 * np.maximum(k, 1))
        assert np.all(relative_error(slopes, [SLOPE[name](x) for x in points]) < tolerance)


@BY_PRECISION
@pytest.mark.parametrize("name", EXACT)
def test_zero_and_large_arguments(name, precision):
    function = getattr(expint, name)
    k = jnp.array([0.0, 1e3, 1e4])
    for f in (function, jax.vmap(jax.grad(function))):
        assert np.all(np.isfinite(f(k)[1:]))
    assert np.isfinite(function(k)[0])
    at_zero = {"e2": 1.0, "tau": 1.0, "omega": 0.0, "log_slope": -2.0}
    if name in at_zero:
        np.testing.assert_allclose(function(k)[0], at_zero[name], rtol=1e-6)
        assert np.isfinite(jax.grad(function)(k[0]))


def test_second_derivative_of_tau(precision):
    second = jax.vmap(jax.grad(jax.grad(expint.tau)))(jnp.array([0.0, 1e-3, 0.5, 2.0]))
    np.testing.assert_allclose(second[1:], [2 * float(mpmath.e1(x)) for x in (1e-3, 0.5, 2.0)], rtol=1e-6)
    assert np.isfinite(second[0])
