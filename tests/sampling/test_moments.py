"""Running moments: host, compiled and merged ones against the textbook formulas in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlidar.sampling.errors import relative_error, student_widening
from jaxlidar.sampling.moments import RunningMoments, scaled_deviation

# Batches whose scatter is small beside their mean: where sums of squares less squared sums lose all digits.
BATCHES = 1e3 + np.random.default_rng(0).normal(size=(20, 3, 5))


def exact_stderr(batches):
    n = len(batches)
    return student_widening(n) * batches.std(axis=0, ddof=1) / np.sqrt(n)


def on_host(batches):
    moments = RunningMoments.on_host({"a": batches[0]}, batches[0])
    for batch in batches:
        moments = moments.update({"a": batch}, 2.0 * batch)
    return moments


def test_moments_on_the_host_are_those_of_all_batches():
    moments = on_host(BATCHES)
    assert moments.count == len(BATCHES)
    np.testing.assert_allclose(moments.mean["a"], BATCHES.mean(axis=0), rtol=1e-14)
    np.testing.assert_allclose(moments.mean_only, 2.0 * BATCHES.mean(axis=0), rtol=1e-14)
    np.testing.assert_allclose(moments.stderr["a"], exact_stderr(BATCHES), rtol=1e-11)


def test_batches_in_single_precision_add_up_in_double():
    batches = jnp.asarray(BATCHES, jnp.float32)
    moments = on_host(batches)
    assert moments.mean["a"].dtype == moments.squares["a"].dtype == np.float64
    np.testing.assert_allclose(moments.stderr["a"], exact_stderr(np.asarray(batches, float)), rtol=1e-11)


def test_compiled_moments_are_those_on_the_host(precision):
    batches = jnp.asarray(BATCHES - 1e3, float)

    @jax.jit
    def compiled(batches):
        empty = RunningMoments.in_program(jax.eval_shape(lambda: batches[0]))
        return jax.lax.fori_loop(0, len(batches), lambda n, m: m.update(batches[n]), empty)

    moments, close = compiled(batches), {"rtol": 1e-5 if precision == "float32" else 1e-12}
    assert int(moments.count) == len(BATCHES)
    np.testing.assert_allclose(moments.stderr, exact_stderr(np.asarray(batches, float)), **close)


def test_moments_of_batches_side_by_side_are_those_of_one_after_the_other():
    batches = jnp.asarray(BATCHES - 1e3)

    @jax.jit
    def compiled(batches):
        empty = RunningMoments.in_program(batches[0], 2.0 * batches[0])
        side_by_side = [RunningMoments.of_batches(part, 2.0 * part) for part in (batches[:12], batches[12:])]
        # Of no batch and of twelve: as where the first group is added.
        return empty.merge(side_by_side[0]).merge(side_by_side[1])

    moments = compiled(batches)
    assert int(moments.count) == len(BATCHES)
    np.testing.assert_allclose(moments.mean, np.mean(BATCHES - 1e3, axis=0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(moments.mean_only, 2.0 * moments.mean, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(moments.stderr, exact_stderr(BATCHES - 1e3), rtol=1e-4)


@pytest.mark.parametrize("cut", [1, 8, 19])
def test_merged_moments_are_those_of_all_batches(cut):
    merged, moments = on_host(BATCHES[:cut]).merge(on_host(BATCHES[cut:])), on_host(BATCHES)
    assert merged.count == moments.count
    for a, b in zip(jax.tree.leaves(merged), jax.tree.leaves(moments), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11)


def test_scaled_deviations_of_a_linear_map_have_its_squares():
    matrix, moments, squares = np.random.default_rng(1).normal(size=(4, 3)), on_host(BATCHES[:1]), 0.0
    for n, batch in enumerate(BATCHES[1:], 2):
        squares += (matrix @ scaled_deviation(batch, moments.mean["a"], n)) ** 2
        moments = moments.update({"a": batch}, batch)
    expected = np.sum((matrix @ BATCHES - (matrix @ BATCHES).mean(axis=0)) ** 2, axis=0)
    np.testing.assert_allclose(squares, expected, rtol=1e-10)


def test_the_relative_error_is_of_samples_near_the_peak_and_of_the_worst_wavelength():
    mean = np.array([[1.0, 0.5, 0.009, 0.0], [2.0, 2.0, 2.0, 2.0]])
    stderr = np.array([[0.03, 0.02, 1.0, 1.0], [0.02, 0.02, 0.02, 0.02]])
    expected = np.sqrt(0.5 * (0.03**2 + 0.04**2))
    assert relative_error(mean, stderr) == pytest.approx(expected)
    shots = jnp.asarray(np.stack([mean, mean]))
    np.testing.assert_allclose(
        relative_error(shots, jnp.asarray(np.stack([stderr, 2 * stderr]))),
        [
            expected,
            2 * expected,
        ],
        rtol=1e-6,
    )
    assert relative_error(np.zeros((1, 4)), np.zeros((1, 4))) == 0.0
