"""Samples of a free interval: against the digitiser's own, finite differences, and the energy of a return."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.spectral.apply_optics import make_free_sampling_model, make_waveform_model, total_samples

WINDOW = (-12.0, 20.0)


def lidar_of(interval):
    return jl.Lidar(sampling_interval=interval, jitter=0.5, pulse=jl.GaussianPulse(fwhm=4.0))


@pytest.fixture(scope="module")
def setup():
    # Air returns light as well, in samples of its own.
    scene = jl.Scene(ground=jl.Ground(reflectance=0.4), atmosphere=jl.Atmosphere(lidar_ratio=30.0))
    lidar = lidar_of(1.0)
    return jl.make_setup(lidar, scene, jl.plan(lidar, scene, window=WINDOW, max_orders=1))


@pytest.fixture(scope="module")
def response(setup):
    return eqx.filter_jit(jl.trace_scene)(setup, jax.random.key(0))


def record(setup, response, interval, n_samples):
    lidar = eqx.tree_at(lambda v: v.sampling_interval, setup.lidar, jnp.asarray(interval, float))
    model = make_free_sampling_model(eqx.tree_at(lambda s: s.lidar, setup, lidar), n_samples)
    return total_samples(response, model)


def test_samples_of_the_planned_interval_are_the_digitisers(setup, response):
    expected = total_samples(response, make_waveform_model(setup))
    samples = record(setup, response, 1.0, setup.plan.n_samples)
    np.testing.assert_allclose(samples, expected, atol=2e-6 * float(jnp.max(expected)))


def test_samples_of_another_interval_are_those_of_a_lidar_that_has_it(setup, response):
    wave = jl.simulate(
        lidar_of(2.5), setup.scene, key=jax.random.key(0), window=WINDOW, max_orders=1, rtol=1e-4
    )
    samples = record(setup, response, 2.5, wave.time.size)
    peak = float(jnp.max(samples))
    np.testing.assert_allclose(samples, wave.reflectance, atol=1e-3 * peak)
    # A shift of the samples by a tenth of their interval would be seen.
    assert np.max(np.abs(np.gradient(np.asarray(samples[0])))) * 0.1 > 10 * 1e-3 * peak


def test_derivatives_by_the_interval_are_those_of_finite_differences(setup, response):
    def weighted(interval):
        samples = record(setup, response, interval, 14)
        return jnp.sum(samples[0] * jnp.cos(jnp.arange(14.0)))

    step = 0.01
    difference = (float(weighted(1.7 + step)) - float(weighted(1.7 - step))) / (2 * step)
    assert float(jax.grad(weighted)(1.7)) == pytest.approx(difference, rel=2e-3)
