"""Loops whose condition all problems share: results, derivatives, and that nothing is selected."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxlidar._jax.vmapped_loops import any_problem, largest_count
from jaxlidar._vectors import with_derivative_of


def halve_until_small(x, any_of=any_problem):
    """Halve each number until all are below one, while any problem has a larger one."""

    def step(x):
        return jnp.where(x < 1.0, x, 0.5 * x)

    return lax.while_loop(lambda x: any_of(x >= 1.0), step, x)


PROBLEMS = jnp.array([[0.5, 3.0], [100.0, 7.0], [0.1, 0.2]])


def test_each_problem_has_the_result_that_it_has_alone():
    together = jax.vmap(halve_until_small)(PROBLEMS)
    np.testing.assert_array_equal(together, jnp.stack([halve_until_small(x) for x in PROBLEMS]))
    nested = jax.vmap(jax.vmap(halve_until_small))(jnp.stack([PROBLEMS, 2.0 * PROBLEMS]))
    np.testing.assert_array_equal(nested[0], together)


def test_loops_go_on_for_all_problems_and_select_nothing():
    def selections(any_of):
        looped = jax.vmap(lambda x: halve_until_small(x, any_of))
        return jax.jit(looped).lower(PROBLEMS).as_text().count("stablehlo.select")

    # One selection is that of the step itself; a condition by problem adds that of the loop.
    assert selections(any_problem) == 1
    assert selections(jnp.any) == 2


def test_counts_are_those_of_the_largest_problem():
    counts = jnp.array([[1, 4], [2, 0]])
    assert int(largest_count(counts)) == 4
    np.testing.assert_array_equal(jax.vmap(lambda n: largest_count(n) - n)(counts), 4 - counts)


@pytest.mark.parametrize("transform", [jax.grad, jax.jacfwd, lambda f: jax.grad(jax.checkpoint(f))])
def test_branches_on_shared_conditions_are_differentiated(transform):
    def cube_where_positive(x):
        return lax.cond(any_problem(x > 0.0), lambda x: jnp.maximum(x, 0.0) ** 3, jnp.zeros_like, x)

    slopes = jax.jit(jax.vmap(transform(cube_where_positive)))(jnp.array([-1.0, 2.0]))
    np.testing.assert_allclose(slopes, [0.0, 12.0])


@pytest.mark.parametrize("transform", [jax.grad, jax.jacfwd])
def test_a_derivative_of_its_own_that_alone_depends_on_the_problem(transform):
    # The value is the same for all problems, its derivative is not.
    def mean_of_sums(x):
        def sum_of_steps(factor):
            def step(total, _):
                return total + with_derivative_of(jnp.ones(()), factor * x), None

            return lax.scan(step, jnp.zeros(()), length=2)[0]

        return jnp.mean(jax.vmap(sum_of_steps)(jnp.array([1.0, 3.0])))

    assert mean_of_sums(5.0) == 2.0
    np.testing.assert_allclose(transform(mean_of_sums)(5.0), 4.0)
