"""Echoes, deconvolution, heights and gaps of synthetic waveforms, whose echoes and layers are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from inversion import (
    find_ground,
    gap_probability,
    gaussian_decomposition,
    plant_area_index,
    relative_heights,
    richardson_lucy,
    wiener,
)

TIME = np.arange(-60.0, 61.0)
# Amplitude, time in ns and width in ns of each echo.
ECHOES = np.array([[0.6, -31.3, 3.0], [1.0, -12.0, 2.5], [1.5, 18.4, 4.0]])


def echoes(table, time=TIME):
    """Waveform of Gaussians with the rows amplitude, time, width."""
    return sum(a * np.exp(-0.5 * ((time - t) / s) ** 2) for a, t, s in table)


def noisy(seed, table=ECHOES, noise=0.02):
    return echoes(table) + noise * np.random.default_rng(seed).normal(size=TIME.size)


@pytest.mark.parametrize("bins", [120, 121])
def test_echoes_without_noise(bins, precision):
    time = TIME[:bins]
    decomposed = gaussian_decomposition(time, echoes(ECHOES, time), noise=1e-3, width=3.0)
    assert int(decomposed.count) == 3
    table = np.stack([decomposed.amplitude, decomposed.time, decomposed.width], axis=1)[:3]
    np.testing.assert_allclose(table, ECHOES, rtol=2e-4)
    np.testing.assert_allclose(decomposed.model, echoes(ECHOES, time), atol=2e-4)
    np.testing.assert_array_equal(decomposed.amplitude[3:], 0.0)


@pytest.fixture(scope="module")
def decompositions():
    """Decompositions of 200 noisy waveforms, in one batch."""
    waves = jnp.asarray(np.stack([noisy(seed) for seed in range(200)]))
    return gaussian_decomposition(TIME, waves, noise=0.02, width=3.0)


@pytest.mark.slow
def test_the_number_of_echoes_is_found(decompositions):
    """A superfluous echo lowers chi2 by more than 3 ln(121) in few of 100 waveforms."""
    count = np.asarray(decompositions.count)
    # None is missed: the weakest is 30 standard deviations of the noise high.
    assert np.mean(count == 3) > 0.95
    assert count.min() >= 3


def test_standard_errors_of_echoes_are_those_of_their_scatter(decompositions):
    is_right = np.asarray(decompositions.count) == 3
    values = [decompositions.amplitude, decompositions.time, decompositions.width]
    table = np.stack(values, axis=2)[is_right, :3]
    z = (table - ECHOES) / np.asarray(decompositions.stderr)[is_right, :3]
    # Over n waveforms the mean of z has the standard error 1 / sqrt(n), and its variance sqrt(2 / n); four of
    # them bound all nine parameters.
    n = is_right.sum()
    assert np.all(np.abs(z.mean(axis=0)) < 4 / np.sqrt(n))
    assert np.all(np.abs(z.var(axis=0) - 1) < 4 * np.sqrt(2 / n))


def test_chi2_of_residuals_is_that_of_noise(decompositions):
    is_right = np.asarray(decompositions.count) == 3
    degrees_of_freedom = TIME.size - 9
    mean = np.mean(np.asarray(decompositions.chi2)[is_right])
    # Chi-squared of f degrees of freedom has the variance 2 f.
    assert abs(mean - degrees_of_freedom) < 4 * np.sqrt(2 * degrees_of_freedom / is_right.sum())


def test_equal_shapes_compile_once(caplog):
    """JAX logs compilations. A new number of bins compiles, a second waveform of that length does not."""
    time = np.arange(-31.0, 32.0)
    with jax.log_compiles():
        gaussian_decomposition(time, echoes(ECHOES[1:2], time), noise=0.02, width=3.0)
        assert any("_decompose" in message for message in caplog.messages)
        caplog.clear()
        decomposed = gaussian_decomposition(time, echoes(ECHOES[1:], time), noise=0.01, width=2.5)
        assert not caplog.messages
        assert int(decomposed.count) == 2
        richardson_lucy(time, pulse(lags=7))
        assert any("_richardson_lucy" in message for message in caplog.messages)
        caplog.clear()
        richardson_lucy(time + 100.0, pulse(lags=7))
        assert not caplog.messages


def test_noise_alone_has_no_echo():
    decomposed = gaussian_decomposition(TIME, noisy(1, []), noise=0.02, width=3.0)
    assert int(decomposed.count) == 0
    np.testing.assert_array_equal(decomposed.model, 0.0)
    assert np.all(np.isfinite(decomposed.stderr))


def test_close_echoes_are_separated_where_the_noise_allows():
    # 8 ns apart, with a full width at half maximum of 7 ns.
    close = np.array([[1.0, -4.0, 3.0], [0.8, 4.0, 3.0]])
    quiet = gaussian_decomposition(TIME, noisy(2, close, 0.005), noise=0.005, width=3.0)
    loud = gaussian_decomposition(TIME, noisy(2, close[:1], 0.3), noise=0.3, width=3.0)
    assert int(quiet.count) == 2
    np.testing.assert_allclose(quiet.time[:2], close[:, 1], atol=0.1)
    assert int(loud.count) <= 1


def pulse(width=3.0, lags=41):
    lag = np.arange(lags) - lags // 2
    return np.exp(-0.5 * (lag / width) ** 2)


def spikes():
    """Target of three hard returns, and its record with the pulse."""
    target = np.zeros(TIME.size)
    target[[40, 52, 80]] = 1.0, 0.7, 2.0
    kernel = pulse()
    return target, np.convolve(target, kernel / kernel.sum(), mode="same")


def test_richardson_lucy_sharpens_and_keeps_the_energy():
    target, record = spikes()
    sharp = richardson_lucy(record, pulse(), iterations=300)
    assert float(sharp.sum()) == pytest.approx(target.sum(), rel=1e-3)
    assert np.all(np.asarray(sharp) >= 0)
    inner = sharp[1:-1]
    peaks = 1 + np.flatnonzero((inner > sharp[:-2]) & (inner > sharp[2:]) & (inner > 0.1))
    np.testing.assert_array_equal(peaks, [40, 52, 80])
    assert float(sharp[40]) > 3 * record[40]


def test_wiener_undoes_the_pulse():
    """Without a Gaussian of width 1, echoes of width 3 have the width sqrt(3^2 - 1^2): variances add."""
    target, record = spikes()
    sharp = np.asarray(wiener(record, pulse(1.0, 21), noise_to_signal=1e-6))
    narrowed = np.convolve(target, pulse(np.sqrt(8.0)) / pulse(np.sqrt(8.0)).sum(), mode="same")
    np.testing.assert_allclose(sharp, narrowed, atol=2e-3 * narrowed.max() + 2e-3)
    assert np.argmax(sharp) == 80


def test_deconvolutions_are_differentiable():
    _, record = spikes()
    weights = jnp.linspace(0.0, 1.0, TIME.size)
    with jax.enable_x64(True):
        for function in (
            lambda y: richardson_lucy(y, pulse(), iterations=5),
            lambda y: wiener(y, pulse(), noise_to_signal=0.01),
        ):
            y, direction = jnp.asarray(record + 0.01), jnp.sin(jnp.arange(TIME.size))

            def total(y, function=function):
                return jnp.sum(jnp.asarray(weights, y.dtype) * function(y))

            _, derivative = jax.jvp(total, (y,), (direction,))
            difference = (total(y + 1e-6 * direction) - total(y - 1e-6 * direction)) / 2e-6
            assert float(derivative) == pytest.approx(float(difference), rel=1e-5)


def test_relative_heights_of_an_even_return():
    """Energy spread evenly from 2 to 12 m."""
    height = np.linspace(15.0, -1.0, 1601)
    power = ((height > 2.0) & (height < 12.0)).astype(float)
    np.testing.assert_allclose(
        relative_heights(height, power, ground=1.0, levels=(0.0, 25.0, 50.0, 98.0)),
        [1.0, 3.5, 6.0, 10.8],
        atol=0.02,
    )
    # Negative samples outside of the signal do not count.
    with_noise = np.where(power > 0, power, -0.1)
    np.testing.assert_allclose(
        relative_heights(height, with_noise, levels=(50.0,)), relative_heights(height, power, levels=(50.0,))
    )


def test_ground_is_the_lowest_mode_above_the_threshold():
    height = np.linspace(20.0, -5.0, 251)
    power = np.exp(-0.5 * ((height - 12.0) / 2) ** 2) + 0.5 * np.exp(-0.5 * ((height - 0.334) / 0.5) ** 2)
    assert float(find_ground(height, power, threshold=0.1)) == pytest.approx(0.334, abs=2e-3)
    assert float(find_ground(height, power, threshold=0.8)) == pytest.approx(12.0, abs=2e-3)
    assert np.isnan(find_ground(height, power, threshold=2.0))


@pytest.mark.slow
def test_plant_area_of_a_simulated_canopy():
    """With the hot spot, the simulation has the gap-probability model: the leaf area index is retrieved.

    Spherically oriented leaves return two thirds of their reflectance.
    """
    lai, leaf, ground = 2.4, 0.45, 0.2
    voxels = jl.VoxelMap.from_lad(
        np.full((1, 1, 8), lai / 8), voxel_size=(40.0, 40.0, 1.0), origin=(-20, -20, 2)
    )
    scene = jl.Scene(
        canopy=jl.Canopy(
            voxels, leaf=jl.LeafOptics(reflectance=leaf, transmittance=0.3), sides="periodic", hotspot=True
        ),
        ground=jl.Ground(reflectance=ground),
    )
    lidar = jl.Lidar(divergence=1e-3, altitude=4e5)
    wave = jl.simulate(lidar, scene, key=jax.random.key(0), max_orders=1, footprint="fixed", n_rays=16)
    gap = gap_probability(
        wave.components["leaf"][0],
        wave.components["ground"][0].sum(),
        reflectance_ratio=2 / 3 * leaf / ground,
    )
    assert np.all(np.diff(gap) <= 1e-7)
    assert float(gap[-1]) == pytest.approx(np.exp(-lai / 2), rel=1e-3)
    assert float(plant_area_index(gap[-1])) == pytest.approx(lai, rel=1e-3)
    derivative = jax.grad(lambda g: gap_probability(wave.components["leaf"][0], g)[-1])(0.1)
    assert np.isfinite(derivative)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: gaussian_decomposition(TIME, TIME, noise=0.0, width=1.0), "noise = 0"),
        (lambda: gaussian_decomposition(TIME, TIME, noise=1.0, width=-1.0), "width = -1"),
        (lambda: gaussian_decomposition(TIME[::-1], TIME, noise=1.0, width=1.0), "steps of time = -1"),
        (lambda: gaussian_decomposition(TIME, TIME, noise=1.0, width=1.0, max_echoes=0), "max_echoes = 0"),
        (lambda: gaussian_decomposition(TIME, TIME * np.nan, noise=1.0, width=1.0), "power = nan"),
        (lambda: richardson_lucy(TIME, np.ones(4)), "odd number of lags"),
        (lambda: richardson_lucy(TIME, np.ones(5), iterations=0), "iterations = 0"),
        (lambda: richardson_lucy(TIME, -np.ones(5)), "pulse = -1"),
        (lambda: wiener(TIME, np.ones(5), noise_to_signal=0.0), "noise_to_signal = 0"),
        (lambda: relative_heights(TIME, TIME, levels=(101.0,)), "levels = 101"),
        (lambda: gap_probability(TIME, 1.0, reflectance_ratio=0.0), "reflectance_ratio = 0"),
        (lambda: plant_area_index(-0.1), "gap = -0.1"),
        (lambda: plant_area_index(0.5, zenith=90.0), "zenith = 90"),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
