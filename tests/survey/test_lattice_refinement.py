"""Shots of first order: lattices of rays that are made denser until the tolerance is met."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.trace.footprint import RaySlice, fibonacci_disc, make_beam

KEY = jax.random.key(5)
LIDAR = jl.Lidar(altitude=1000.0, divergence=3.0, pulse=jl.GaussianPulse(fwhm=4.0))


def edge(thickness: float = 3.0) -> jl.Scene:
    """Return a crown whose edge every shot sees."""
    density = np.zeros((20, 20, 6))
    density[10:, :, 6 - round(thickness) :] = 0.8
    canopy = jl.Canopy(jl.VoxelMap.from_lad(density, voxel_size=1.0), leaf=jl.Prospect(), hotspot=False)
    return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3))


def shots(count: int = 8) -> jl.Survey:
    """Return shots across the edge, at x = 10."""
    return jl.Survey(LIDAR, np.stack([10.0 + np.linspace(-1.6, 1.6, count), np.full(count, 10.0)], axis=1))


def test_slices_of_a_lattice_make_up_that_lattice(precision):
    beam, shift = make_beam(LIDAR), jnp.asarray([0.3, 0.8])
    (x, y), energy = fibonacci_disc(beam, 24 * 5, shift)
    slices = [fibonacci_disc(beam, 24, shift, RaySlice(jnp.asarray(n), jnp.asarray(5))) for n in range(5)]
    close = {"atol": 2e-5 if precision == "float32" else 1e-6}
    np.testing.assert_allclose(x, np.concatenate([s[0][0] for s in slices]), **close)
    np.testing.assert_allclose(y, np.concatenate([s[0][1] for s in slices]), **close)
    np.testing.assert_allclose(energy, np.concatenate([s[1] for s in slices]) / 5, rtol=1e-6)
    # Far out in a dense lattice, turns are still those of the golden ratio.
    distant = fibonacci_disc(beam, 64, shift, RaySlice(jnp.asarray(1000), jnp.asarray(1024)))[0]
    number = 64_000 + np.arange(64)
    turn = 2 * np.pi * ((number * (np.sqrt(5.0) - 1) / 2) % 1.0 + 0.8)
    angle = np.angle(np.exp(1j * (np.arctan2(distant[1], distant[0]) - turn)))
    assert np.abs(angle).max() < 1e-4


@pytest.mark.slow
def test_every_shot_has_the_error_that_it_reports_within_the_tolerance():
    survey, scene, rtol = shots(), edge(), 0.01
    waveforms = jl.simulate_many(survey, scene, key=KEY, max_orders=1, rtol=rtol, shared=False)
    assert np.all(waveforms.error <= rtol)
    plan = jl.plan(survey, scene, max_orders=1, n_rays=1 << 14, describe=False)
    exact = [jl.simulate(lidar, scene, key=KEY, plan=plan).reflectance for lidar in survey]

    def chi_squared(waveforms: jl.Waveforms) -> np.ndarray:
        """Return that of each shot, per sample."""
        mean, stderr = np.asarray(waveforms.reflectance), np.asarray(waveforms.stderr)
        counts = mean > 0.01 * mean.max(axis=-1, keepdims=True)
        error = np.where(counts, np.maximum(stderr, 2e-4 * mean), 1.0)
        square = np.where(counts, ((mean - np.asarray(exact)) / error) ** 2, 0.0)
        return square.sum(axis=(1, 2)) / counts.sum(axis=(1, 2))

    # Errors of the samples of a shot are correlated: each shot counts about once.
    assert 0.05 < chi_squared(waveforms).mean() < 2.5
    # Planted: a crown thinner by a layer.
    wrong = jl.simulate_many(survey, edge(2.0), key=KEY, max_orders=1, rtol=rtol, shared=False)
    assert chi_squared(wrong).mean() > 100.0


@pytest.mark.slow
def test_a_tolerance_out_of_reach_is_reported():
    waveforms = jl.simulate_many(shots(1), edge(), key=KEY, max_orders=1, rtol=1e-6, shared=False)
    assert 1e-6 < float(waveforms.error[0]) < 1e-3
