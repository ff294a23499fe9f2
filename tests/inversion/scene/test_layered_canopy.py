"""Estimates of fits of a layered canopy, and their errors."""

import jax.numpy as jnp
import numpy as np
import pytest

from inversion.fit.result import Retrieval
from inversion.scene import layered_canopy
from inversion.scene.layered_canopy import LAYERS, LayeredCanopy


def fits_of(values, covariance, widening):
    """Return two fits. The second has these values and this covariance, the first others.

    `widening`: robust standard errors over those of the covariance.
    """
    stderr = np.split(np.sqrt(np.diag(covariance)), np.cumsum([np.size(a) for a in values.values()])[:-1])
    errors = {name: error.reshape(np.shape(a)) for (name, a), error in zip(values.items(), stderr)}

    def both(by_name, factor):
        return {name: np.stack([factor * a, a]) for name, a in by_name.items()}

    n, no_names, pair = len(covariance), {}, np.ones(2)
    robust = {name: widening * a for name, a in errors.items()}
    return Retrieval(
        values=both(values, 0.5),
        stderr=both(errors, 3.0),
        robust_stderr=both(robust, 3.0),
        prior_share=no_names,
        at_bound=no_names,
        covariance=np.stack([np.eye(n), covariance]),
        reduced_chi2=pair,
        second_minimum=pair,
        independent_samples=pair,
        averaging=np.zeros((2, n, n)),
        strength=no_names,
        bounds=no_names,
        converged=pair > 0,
        steps=np.ones(2, int),
        simulation_error=no_names,
        residuals=np.zeros((2, 1, 1)),
        fitted=np.zeros((2, 1, 1)),
        status=("", ""),
        labels=("",) * n,
    )


def test_estimates_are_those_of_the_scene_and_errors_those_of_draws():
    """Values against the scene with the unknowns in it; errors against the scatter of correlated draws."""
    random, canopy = np.random.default_rng(3), LayeredCanopy(clearance=1.5)
    log_density = np.log(random.uniform(0.05, 0.3, LAYERS))
    # Not in the order of any formula.
    values = {"log density": log_density, "ground": np.array(-0.7), "canopy height": np.array(18.0)}
    root = 0.02 * random.normal(size=(LAYERS + 2, LAYERS + 2)) / np.sqrt(LAYERS)
    covariance, widening = root @ root.T, 1.4
    estimates = canopy.estimates(fits_of(values, covariance, widening), 1)

    scene = canopy.scene(height=10.0)
    scene = canopy.put_ground(scene, jnp.asarray(-0.7))
    scene = canopy.put_height(scene, jnp.asarray(18.0))
    scene = canopy.put_density(scene, jnp.asarray(log_density))
    voxels = scene.canopy.voxels
    thickness, base = float(voxels.voxel_size[2]), float(voxels.origin[2])
    assert estimates.top == pytest.approx(base + LAYERS * thickness, rel=1e-5)
    # The extinction of spherical leaf angles is half of the plant area density.
    assert estimates.pai == pytest.approx(float(np.sum(voxels.leaf)) / 0.5 * thickness, rel=1e-5)
    np.testing.assert_allclose(estimates.density, np.ravel(voxels.leaf) / 0.5, rtol=1e-5)

    def spread(covariance):
        """Return the scatter of top, plant area index and densities over 100 000 draws."""
        centre = np.append(log_density, [values["ground"], values["canopy height"]])
        draws = random.multivariate_normal(centre, covariance, 100_000)
        density, ground, height = np.exp(draws[:, :LAYERS]), draws[:, -2], draws[:, -1]
        area = np.sum(density, axis=1) * (height - 1.5) / LAYERS
        return np.std(ground + height), np.std(area), np.std(density, axis=0)

    top_error, area_error, density_errors = spread(widening**2 * covariance)
    # The uppermost layer is shown: half of its thickness is added.
    linear_error = np.sqrt(estimates.top_stderr**2 - (0.5 * thickness) ** 2)
    assert linear_error == pytest.approx(top_error, rel=0.01)
    assert estimates.pai_stderr == pytest.approx(area_error, rel=0.01)
    np.testing.assert_allclose(estimates.density_stderr, density_errors, rtol=0.015)
    # Planted: without correlations, and without the misfit.
    for wrong_covariance in (widening**2 * np.diag(np.diag(covariance)), covariance):
        assert abs(spread(wrong_covariance)[1] / estimates.pai_stderr - 1.0) > 0.05


def test_errors_of_sums_need_the_covariance():
    values = {"a": np.array(1.0), "b": np.array([1.0, 2.0]), "c": np.array(3.0)}
    covariance = np.diag([1.0, 4.0, 9.0, np.inf])
    covariance[0, 1] = covariance[1, 0] = -1.0
    stderr = layered_canopy._propagated({"a": 1.0, "b": np.array([1.0, 0.0])}, covariance, values)
    assert stderr == pytest.approx(np.sqrt(1.0 + 4.0 - 2.0))


def test_the_top_is_uncertain_by_the_layers_that_may_be_empty():
    density, stderr = np.full(LAYERS, 0.1), np.full(LAYERS, 0.01)
    # The underside of the uppermost layer, one below the top; then of the third from above.
    assert layered_canopy._top_error(density, stderr, 2.0) == pytest.approx(1.0)
    stderr[-2:] = 0.06
    assert layered_canopy._top_error(density, stderr, 2.0) == pytest.approx(3.0)
    # An empty layer between full ones tells nothing of the top.
    stderr[3] = 1.0
    assert layered_canopy._top_error(density, stderr, 2.0) == pytest.approx(3.0)
    assert layered_canopy._top_error(density, np.full(LAYERS, 1.0), 2.0) == pytest.approx(0.5 * 2.0 * LAYERS)
