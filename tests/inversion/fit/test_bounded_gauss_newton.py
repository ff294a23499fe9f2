"""The solver of fits, run by optimistix: minima within bounds as scipy finds them, noise, and failures."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy import optimize

from inversion.fit.bounded_gauss_newton import BoundedGaussNewton, at_bounds

# No step counts as small, unless rounding is.
EXACT = BoundedGaussNewton(atol=1e-4, rtol=1e-4, limits=(1e-4,) * 20)


@pytest.fixture(autouse=True)
def double_precision():
    """As in fits."""
    with jax.enable_x64(True):
        yield


def solve(function, start, lower, upper, solver=EXACT, **options):
    bounds = {"lower": jnp.asarray(lower, float), "upper": jnp.asarray(upper, float)}
    start = jnp.asarray(start, float)
    return optx.least_squares(function, solver, start, options=bounds, throw=False, **options)


def test_linear_problems_end_at_the_minimum_within_bounds():
    random = np.random.default_rng(0)
    n_at_bounds = 0
    for _ in range(5):
        matrix = random.normal(size=(30, 5)) @ (np.eye(5) + 0.4 * random.normal(size=(5, 5)))
        observed = matrix @ random.uniform(-0.5, 1.5, 5)
        expected = optimize.lsq_linear(matrix, observed, (0.0, 1.0), method="bvls").x
        solution = solve(
            lambda y, args: args[0] @ y - args[1],
            np.full(5, 0.5),
            np.zeros(5),
            np.ones(5),
            args=(jnp.asarray(matrix), jnp.asarray(observed)),
        )
        assert solution.result == optx.RESULTS.successful
        np.testing.assert_allclose(solution.value, expected, atol=1e-4)
        n_at_bounds += np.sum((expected == 0.0) | (expected == 1.0))
    assert n_at_bounds > 4


def rosenbrock(y, args=None):
    return jnp.array([10.0 * (y[1] - y[0] ** 2), 1.0 - y[0]])


@pytest.mark.parametrize("upper", [(2.0, 2.0), (0.5, 2.0), (2.0, 0.3)], ids=["free", "first", "second"])
def test_a_curved_valley_leads_to_the_minimum(upper):
    solution = solve(rosenbrock, (-1.2, 0.2), (-2.0, -2.0), upper, max_steps=200)
    expected = optimize.least_squares(rosenbrock, (-1.2, 0.2), bounds=((-2.0, -2.0), upper)).x
    assert solution.result == optx.RESULTS.successful
    np.testing.assert_allclose(solution.value, expected, atol=1e-3)


def test_many_problems_run_under_vmap():
    starts = jnp.array([(-1.2, 0.2), (1.0, -1.0), (0.3, 1.5)])
    values = jax.vmap(lambda y: solve(rosenbrock, y, (-2.0, -2.0), (0.5, 2.0)).value)(starts)
    np.testing.assert_allclose(values, np.tile((0.5, 0.25), (3, 1)), atol=1e-3)


def test_residuals_that_are_not_finite_reject_a_step():
    """The logarithm of a negative number; without the rejection y would be NaN."""
    solution = solve(lambda y, args: 3.0 * jnp.log(y - 0.5) + 3.0, (2.0,), (0.0,), (4.0,))
    np.testing.assert_allclose(solution.value, 0.5 + np.exp(-1.0), atol=1e-4)


@jax.custom_jvp
def with_wrong_derivative(y):
    return 5.0 * (y - 0.7)


@with_wrong_derivative.defjvp
def _(primals, tangents):
    return with_wrong_derivative(*primals), -5.0 * tangents[0]


def test_a_wrong_derivative_fails_and_says_so():
    solution = solve(lambda y, args: with_wrong_derivative(y), (0.2,), (0.0,), (1.0,), BoundedGaussNewton())
    assert solution.result == optx.RESULTS.nonlinear_divergence
    np.testing.assert_allclose(solution.value, 0.2)


def test_noise_of_the_residuals_ends_a_fit_where_no_step_improves_it():
    """Jumps of a tenth of a standard error: the default limits end there, exact ones do not."""

    def noisy(y, args):
        jumps = jax.lax.stop_gradient(0.1 * jnp.sin(1e5 * y))
        return jnp.concatenate([4.0 * (y - 0.6) + jumps, 0.5 * jnp.cos(3.0 * y)])

    lengths, steps = [], []
    for solver in (BoundedGaussNewton(), EXACT):
        solution = solve(noisy, (0.1,), (0.0,), (1.0,), solver)
        lengths.append(float(solution.stats["length"]))
        steps.append(int(solution.stats["num_steps"]))
    assert lengths[0] < 0.3
    assert steps[0] < steps[1]


@pytest.mark.parametrize(("residual", "leaving"), [((-1e-5, -0.4), False), ((-0.4, -1e-5), True)])
def test_an_unknown_leaves_its_bound_for_its_own_misfit(residual, leaving):
    """The cost falls by the step of both unknowns; the first is at its bound, the second within."""
    values, lower, upper = np.array([0.0, 0.5]), np.zeros(2), np.ones(2)
    found = at_bounds(values, np.array(residual), np.eye(2), lower, upper)
    assert found.leaving.tolist() == [leaving, False]
    assert not found.held.any()
