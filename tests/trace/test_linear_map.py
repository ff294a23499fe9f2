"""Linear maps with a transpose of their own: forward, reverse, batched, compiled and second derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlidar.trace.derivatives.linear_map import linear_map

MATRIX = jnp.asarray(np.random.default_rng(0).normal(size=(3, 4)))
CALLS = []


@jax.custom_jvp
def function(x):
    """Return sin(A x)."""
    return jnp.sin(MATRIX @ x)


@function.defjvp
def _(primals, tangents):
    def push(residuals, arguments):
        return [jnp.cos(MATRIX @ residuals[0]) * (MATRIX @ arguments[0])]

    def pull(residuals, cotangents):
        CALLS.append("pull")
        return [MATRIX.T @ (jnp.cos(MATRIX @ residuals[0]) * cotangents[0])]

    value = function(primals[0])
    (tangent,) = linear_map(push, pull, [primals[0]], [tangents[0]], [value])
    return value, tangent


def plain(x):
    return jnp.sin(MATRIX @ x)


X = jnp.asarray([0.1, -0.3, 0.5, 0.2])
XS = jnp.stack([X, 2.0 * X])


@pytest.mark.parametrize(
    "derivative",
    [
        jax.jacfwd,
        jax.jacrev,
        lambda f: jax.grad(lambda x: jnp.sum(f(x) ** 2)),
        lambda f: jax.jit(jax.grad(lambda x: jnp.sum(f(x) ** 2))),
        lambda f: jax.hessian(lambda x: jnp.sum(f(x) ** 2)),
        pytest.param(lambda f: jax.jacrev(jax.grad(lambda x: jnp.sum(f(x) ** 2))), marks=pytest.mark.slow),
        lambda f: lambda x: jax.jvp(f, (x,), (x,))[1],
        lambda f: jax.grad(lambda x: jnp.sum(jax.checkpoint(f)(x) ** 2)),
        lambda f: jax.grad(lambda x: jnp.sum(jax.lax.map(lambda s: f(s * x), jnp.arange(3.0)) ** 2)),
    ],
)
def test_derivatives_are_those_of_the_function(derivative):
    np.testing.assert_allclose(derivative(function)(X), derivative(plain)(X), rtol=1e-5, atol=1e-6)
    batched, expected = (jax.vmap(derivative(f))(XS) for f in (function, plain))
    np.testing.assert_allclose(batched, expected, rtol=1e-5, atol=1e-6)


def test_a_batch_is_summed_over_where_the_argument_has_none():
    def total(f):
        return jax.grad(lambda x: jnp.sum(jax.vmap(lambda s: f(s * x))(jnp.arange(3.0)) ** 2))

    np.testing.assert_allclose(total(function)(X), total(plain)(X), rtol=1e-5)


def test_reverse_mode_runs_the_transpose_and_forward_mode_does_not():
    CALLS.clear()
    jax.jacfwd(function)(X)
    assert not CALLS
    jax.grad(lambda x: jnp.sum(function(x)))(X)
    assert CALLS
