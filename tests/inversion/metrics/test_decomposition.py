"""Echoes, deconvolution, heights and gaps of waveforms, against waveforms made of known parts."""

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
ECHOES = np.array([[0.6, -31.3, 3.0], [1.0, -12.0, 2.5], [1.5, 18.4, 4.0]])


def echoes(table, time=TIME):
    return sum(a * np.exp(-0.5 * ((time - t) / s) ** 2) for a, t, s in table)


def noisy(seed, table=ECHOES, noise=0.02):
    return echoes(table) + noise * np.random.default_rng(seed).normal(size=TIME.size)


@pytest.mark.parametrize("bins", [120, 121])
def test_echoes_without_noise(bins, precision):
    time = TIME[:bins]
    found = gaussian_decomposition(time, echoes(ECHOES, time), noise=1e-3, width=3.0)
    assert int(found.count) == 3
    table = np.stack([found.amplitude, found.time, found.width], axis=1)[:3]
    np.testing.assert_allclose(table, ECHOES, rtol=2e-4)
    np.testing.assert_allclose(found.model, echoes(ECHOES, time), atol=2e-4)
    np.testing.assert_array_equal(found.amplitude[3:], 0.0)


@pytest.fixture(scope="module")
def many():
    """Decompositions of 200 noisy waveforms, in one batch."""
    waves = jnp.asarray(np.stack([noisy(seed) for seed in range(200)]))
    return jax.jit(jax.vmap(lambda y: gaussian_decomposition(TIME, y, noise=0.02, width=3.0)))(waves)


def test_the_number_of_echoes_is_found(many):
    """A needless echo lowers chi2 by more than 3 ln(121) in few of 100 waveforms."""
    count = np.asarray(many.count)
    assert np.mean(count == 3) > 0.95
    assert count.min() >= 3


def test_errors_of_echoes_are_as_stated(many):
    right = np.asarray(many.count) == 3
    table = np.stack([many.amplitude, many.time, many.width], axis=2)[right, :3]
    z = (table - ECHOES) / np.asarray(many.stderr)[right, :3]
    # The variance of z over n waveforms, of which nine kinds are looked at, lies within 4 sqrt(2/n) of one.
    n = right.sum()
    assert np.all(np.abs(z.mean(axis=0)) < 4 / np.sqrt(n))
    assert np.all(np.abs(z.var(axis=0) - 1) < 4 * np.sqrt(2 / n))


def test_chi2_of_what_is_left_is_that_of_noise(many):
    right = np.asarray(many.count) == 3
    freedom = TIME.size - 9
    mean = np.mean(np.asarray(many.chi2)[right])
    assert abs(mean - freedom) < 4 * np.sqrt(2 * freedom / right.sum())


def test_equal_shapes_compile_once(caplog):
    """JAX says what it compiles. A new number of bins is heard, a second waveform of them is not."""
    time = np.arange(-31.0, 32.0)
    with jax.log_compiles():
        gaussian_decomposition(time, echoes(ECHOES[1:2], time), noise=0.02, width=3.0)
        assert any("_decompose" in said for said in caplog.messages)
        caplog.clear()
        found = gaussian_decomposition(time, echoes(ECHOES[1:], time), noise=0.01, width=2.5)
        assert not caplog.messages
        assert int(found.count) == 2
        richardson_lucy(time, pulse(lags=7))
        assert any("_richardson_lucy" in said for said in caplog.messages)
        caplog.clear()
        richardson_lucy(time + 100.0, pulse(lags=7))
        assert not caplog.messages


def test_noise_alone_holds_no_echo():
    none = gaussian_decomposition(TIME, noisy(1, []), noise=0.02, width=3.0)
    assert int(none.count) == 0
    np.testing.assert_array_equal(none.model, 0.0)
    assert np.all(np.isfinite(none.stderr))


def test_close_echoes_are_told_apart_where_the_noise_allows():
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
    target = np.zeros(TIME.size)
    target[[40, 52, 80]] = 1.0, 0.7, 2.0
    kernel = pulse()
    return target, np.convolve(target, kernel / kernel.sum(), mode="same")


def test_richardson_lucy_sharpens_and_keeps_the_energy():
    target, seen = spikes()
    found = richardson_lucy(seen, pulse(), iterations=300)
    assert float(found.sum()) == pytest.approx(target.sum(), rel=1e-3)
    assert np.all(np.asarray(found) >= 0)
    peaks = 1 + np.flatnonzero((found[1:-1] > found[:-2]) & (found[1:-1] > found[2:]) & (found[1:-1] > 0.1))
    np.testing.assert_array_equal(peaks, [40, 52, 80])
    assert float(found[40]) > 3 * seen[40]


def test_wiener_undoes_the_pulse():
    target, seen = spikes()
    found = np.asarray(wiener(seen, pulse(1.0, 21), noise_to_signal=1e-6))
    broad = np.convolve(target, pulse(np.sqrt(8.0)) / pulse(np.sqrt(8.0)).sum(), mode="same")
    np.testing.assert_allclose(found, broad, atol=2e-3 * broad.max() + 2e-3)
    assert np.argmax(found) == 80


def test_deconvolutions_are_differentiable():
    _, seen = spikes()
    weights = jnp.linspace(0.0, 1.0, TIME.size)
    with jax.enable_x64(True):
        for function in (
            lambda y: richardson_lucy(y, pulse(), iterations=5),
            lambda y: wiener(y, pulse(), noise_to_signal=0.01),
        ):
            y, along = jnp.asarray(seen + 0.01), jnp.sin(jnp.arange(TIME.size))

            def total(y, function=function):
                return jnp.sum(jnp.asarray(weights, y.dtype) * function(y))

            _, slope = jax.jvp(total, (y,), (along,))
            difference = (total(y + 1e-6 * along) - total(y - 1e-6 * along)) / 2e-6
            assert float(slope) == pytest.approx(float(difference), rel=1e-5)


def test_relative_heights_of_an_even_return():
    """Energy spread evenly from 2 to 12 m."""
    height = np.linspace(15.0, -1.0, 1601)
    power = ((height > 2.0) & (height < 12.0)).astype(float)
    np.testing.assert_allclose(
        relative_heights(height, power, ground=1.0, levels=(0.0, 25.0, 50.0, 98.0)),
        [1.0, 3.5, 6.0, 10.8],
        atol=0.02,
    )
    with_noise = np.where(power > 0, power, -0.1)
    np.testing.assert_allclose(
        relative_heights(height, with_noise, levels=(50.0,)), relative_heights(height, power, levels=(50.0,))
    )


def test_ground_is_the_last_mode():
    height = np.linspace(20.0, -5.0, 251)
    power = np.exp(-0.5 * ((height - 12.0) / 2) ** 2) + 0.5 * np.exp(-0.5 * ((height - 0.334) / 0.5) ** 2)
    assert float(find_ground(height, power, threshold=0.1)) == pytest.approx(0.334, abs=2e-3)
    assert float(find_ground(height, power, threshold=0.8)) == pytest.approx(12.0, abs=2e-3)
    assert np.isnan(find_ground(height, power, threshold=2.0))


def test_plant_area_of_a_simulated_canopy():
    """With the hot spot, the gap-probability model is the simulation's: the leaf area index comes back."""
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
    slope = jax.grad(lambda g: gap_probability(wave.components["leaf"][0], g)[-1])(0.1)
    assert np.isfinite(slope)


@pytest.mark.parametrize(
    ("call", "says"),
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
        (lambda: plant_area_index(0.0), "gap = 0"),
        (lambda: plant_area_index(0.5, zenith=90.0), "zenith = 90"),
    ],
)
def test_bad_input_is_refused(call, says):
    with pytest.raises(ValueError, match=says):
        call()
