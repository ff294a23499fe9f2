"""Deposits: their kernel's moments, points of a flight from which light returns, and light between plates."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.planning.config import KERNEL_BINS, KERNEL_VARIANCE, TimeBins
from jaxlidar.trace.deposit import bspline_row, smooth_bins
from tests.helpers import SINGLE_SAMPLE, agrees, batch_mean, single_sample_lidar, slab, slow_unless

LIDAR = jl.Lidar(divergence=2.0, sampling_interval=5.0)
SCENE = jl.Scene(
    canopy=jl.Canopy(
        slab(0.8, 0.1), leaf=jl.LeafOptics(reflectance=0.4, transmittance=0.3), bark=0.3, hotspot=False
    ),
    ground=jl.Ground(reflectance=0.3, slope=5.0),
)
PLATES = jl.Scene(
    plates=(jl.Plate(height=6.0, reflectance=0.4, transmittance=0.3, coverage=0.5, transmission="straight"),),
    ground=jl.Ground(reflectance=0.3),
)
BETWEEN = dataclasses.replace(SCENE, plates=PLATES.plates)
SIZES = {"n_photons": 16384, "n_rays": 512, "window": (-80.0, 40.0)}


def samples(wave):
    # Without the tails, whose distribution is too skew for a z-test.
    return wave.reflectance[0, 2:20]


def batch_mean_of(scene, seed, **config):
    plan = jl.plan(LIDAR, scene, max_orders=3, **SIZES).with_config(**config)
    return batch_mean(LIDAR, scene, plan, seed=seed, count=24, quantity=samples)


@pytest.mark.slow
@pytest.mark.parametrize("scene", [SCENE, BETWEEN], ids=["canopy", "canopy and plate"])
def test_the_number_of_deposits_does_not_change_the_mean(scene):
    a, a_stderr = batch_mean_of(scene, 1)
    b, b_stderr = batch_mean_of(scene, 2, deposits_per_flight=1)
    bright = a > 0.01 * a.max()
    stderr = np.hypot(a_stderr, b_stderr)[bright]
    assert agrees(b[bright], stderr, a[bright], sigmas=4.0)
    assert not agrees(b[bright], stderr, 1.05 * a[bright], sigmas=4.0)


def second_order(wave):
    return wave.components["higher"].sum(axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("transmission", slow_unless(["straight"], ["diffuse", "straight"]))
def test_light_between_two_plates_returns_by_both_paths(transmission):
    """Scattered by the upper plate, reflected by the lower, through a gap; and the same path reversed."""
    upper = jl.Plate(height=6.0, reflectance=0.0, transmittance=0.5, coverage=0.5, transmission="diffuse")
    lower = jl.Plate(height=2.0, reflectance=0.4, transmittance=0.3, coverage=0.7, transmission=transmission)
    scene = jl.Scene(plates=(upper, lower))
    # From 400 km all light is vertical.
    lidar = single_sample_lidar()
    plan = jl.plan(lidar, scene, max_orders=2, n_photons=32768, **SINGLE_SAMPLE)
    mean, stderr = batch_mean(lidar, scene, plan, seed=0, count=32, quantity=second_order)
    path_reflectance = 0.5 * 0.5 * 0.7 * 0.4 * 0.5
    assert agrees(mean, stderr, 2 * path_reflectance)
    # The same test rejects a weight of one path that lacks the probability of reflection.
    assert not agrees(mean, stderr, path_reflectance * (1 + plan.limits.reflection_probability))


@pytest.mark.slow
def test_four_deposits_vary_less_than_one():
    _, stderr_of_four = batch_mean_of(SCENE, 1)
    _, stderr_of_one = batch_mean_of(SCENE, 1, deposits_per_flight=1)
    assert np.median(stderr_of_one) > 1.3 * np.median(stderr_of_four)


def test_moments_of_the_kernel_do_not_depend_on_the_instant():
    """Weights sum to one, keep the mean time, and have the second moment that the pulse takes out again."""
    bins = TimeBins(start=2.0, width=0.5, count=40, max_span=4)
    time = jnp.linspace(3.0, 20.0, 1001)[:-1]
    first_bin, row = (np.asarray(v, float) for v in bspline_row(bins, time, jnp.ones_like(time)))
    number = first_bin[:, None] - bins.max_span + np.arange(KERNEL_BINS)
    offset = number - (np.asarray(time, float)[:, None] - bins.start) / bins.width
    for n, exact in enumerate((1.0, 0.0, KERNEL_VARIANCE)):
        moment = np.sum(row * offset**n, axis=1)
        np.testing.assert_allclose(moment, exact, atol=1e-4)
    # Weights of a row that starts at another bin would have these moments too, some of them below zero.
    assert row.min() >= 0.0
    # Negative control: the third moment does depend on the instant.
    third = np.sum(row * offset**3, axis=1)
    assert np.ptp(third) > 1e-2


def test_smoothed_bins_have_the_second_moment_of_the_kernel():
    """The smoothing's own second moment is that of the kernel less that of a bin, 1/12."""
    smooth = np.asarray(smooth_bins(jnp.asarray([0.0, 1.0, 0.0])), float)
    number = np.arange(smooth.size) - 2
    assert smooth.sum() == pytest.approx(1.0)
    assert np.sum(smooth * number**2) == pytest.approx(KERNEL_VARIANCE - 1 / 12)
