"""Echoes as copies of a recorded pulse: a hard target has one echo, at every signal-to-noise ratio."""

import jax
import numpy as np
import pytest

import jaxlidar as jl
from inversion import gaussian_decomposition
from tests.helpers import slow_unless

LAG = np.arange(-40.0, 41.0)
TIME = np.arange(120.0)


def impulse(lag):
    """A skewed system impulse with a second bump of 6 %, smooth enough for its sampling."""
    skewed = np.where(lag < 0, np.exp(-0.5 * (lag / 4.0) ** 2), np.exp(-0.5 * (lag / 6.5) ** 2))
    return skewed + 0.06 * np.exp(-0.5 * ((lag - 22.0) / 4.0) ** 2)


def record(*echoes):
    """Record of copies of the impulse, with the amplitude and time of each echo."""
    return sum(a * impulse(TIME - t) for a, t in echoes)


def hard_targets(ratio, shots=20):
    """Times, at random between samples, and noisy records of single echoes there."""
    random = np.random.default_rng(7)
    times = random.uniform(45.0, 60.0, shots)
    clean = np.stack([record((1.0, time)) for time in times])
    return times, clean + random.normal(size=clean.shape) / ratio


@pytest.mark.parametrize("ratio", slow_unless([1000.0], [5.0, 30.0, 200.0, 1000.0]))
def test_a_hard_target_has_one_echo(ratio):
    times, power = hard_targets(ratio)
    echoes = gaussian_decomposition(TIME, power, noise=1 / ratio, pulse=impulse(LAG))
    np.testing.assert_array_equal(echoes.count, 1)
    # The error of the pulse, 1 %, limits strong echoes, and noise weak ones.
    np.testing.assert_allclose(echoes.time[:, 0], times, atol=0.02 + 5 / ratio)
    np.testing.assert_allclose(echoes.amplitude[:, 0], 1.0, atol=0.01 + 3 / ratio)


def test_gaussians_find_several_echoes_of_a_hard_target():
    """Negative control: the same records, decomposed into Gaussians."""
    _, power = hard_targets(1000.0)
    assert np.min(np.asarray(gaussian_decomposition(TIME, power, noise=1e-3, width=5.0).count)) >= 2


def test_two_targets_are_separated_with_errors_as_stated():
    random = np.random.default_rng(5)
    power = record((1.0, 40.3), (0.6, 58.8)) + 0.02 * random.normal(size=(60, TIME.size))
    settings = {"noise": 0.02, "pulse": impulse(LAG), "pulse_error": 0.0, "broaden": False, "max_echoes": 3}
    echoes = gaussian_decomposition(TIME, power, **settings)
    is_right = np.asarray(echoes.count) == 2
    assert is_right.mean() > 0.95
    table = np.stack([echoes.amplitude, echoes.time], axis=2)[is_right, :2]
    z = (table - [[1.0, 40.3], [0.6, 58.8]]) / np.asarray(echoes.stderr)[is_right, :2, :2]
    # Standard errors of the mean and of the variance of z over n records.
    n = is_right.sum()
    assert np.all(np.abs(z.mean(axis=0)) < 4.5 / np.sqrt(n))
    assert np.all(np.abs(z.var(axis=0) - 1) < 4.5 * np.sqrt(2 / n))


@pytest.mark.slow
def test_a_wide_target_is_a_broadened_copy():
    """The variances of a Gaussian pulse and of the target add."""
    pulse = jl.GaussianPulse(fwhm=9.0)
    width = np.hypot(9.0 / 2.3548, 5.0)
    # A Gaussian of 9 ns full width, broadened by one of 5 ns standard deviation.
    power = np.exp(-0.5 * ((TIME - 61.4) / width) ** 2)
    echoes = gaussian_decomposition(TIME, power, noise=0.005, pulse=pulse)
    assert int(echoes.count) == 1
    assert float(echoes.width[0]) == pytest.approx(5.0, rel=0.02)
    assert float(echoes.time[0]) == pytest.approx(61.4, abs=0.02)
    np.testing.assert_allclose(echoes.model, power, atol=0.01)


def test_lengths_up_to_a_size_share_a_program(caplog):
    # A number of records that no other test has: whatever ran before, the first call compiles.
    power = np.tile(record((1.0, 40.0)), (11, 1))
    for bins in (75, 90):
        with jax.log_compiles():
            caplog.clear()
            settings = {"noise": 0.01, "pulse": impulse(LAG), "broaden": False, "max_echoes": 2}
            echoes = gaussian_decomposition(TIME[:bins], power[:, :bins], **settings)
            has_compiled = any("_decompose" in message for message in caplog.messages)
        assert has_compiled == (bins == 75)
        assert np.all(np.asarray(echoes.count) == 1)
        assert echoes.model.shape == (11, bins)


def test_samples_of_infinite_noise_have_no_weight():
    noise = np.where(TIME > 90, np.inf, 0.01)
    power = record((1.0, 40.0)) + np.where(TIME > 90, 5.0, 0.0)
    echoes = gaussian_decomposition(TIME, power, noise=noise, width=5.0, max_echoes=3)
    assert int(echoes.count) >= 1
    assert np.all(np.asarray(echoes.time) <= 90)
    # A record that ends within an echo has no echo beyond its end.
    cut = gaussian_decomposition(
        TIME[:41], power[:41], noise=0.01, pulse=impulse(LAG), broaden=False, max_echoes=2
    )
    assert np.all(np.asarray(cut.time) <= 40)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "width and pulse"),
        ({"width": 1.0, "pulse": np.ones(3)}, "width and pulse"),
        ({"pulse": np.ones(4)}, "odd number of lags"),
        ({"pulse": np.ones(5), "pulse_error": -1.0}, "pulse_error = -1"),
    ],
)
def test_bad_input_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        gaussian_decomposition(TIME, TIME, noise=1.0, **settings)


def records_with_proportional_noise(count, seed):
    """Records of up to three echoes, some beyond the ends, and their noise, in proportion to the signal."""
    random = np.random.default_rng(seed)
    amplitude, centre = random.uniform(0.1, 1.0, (count, 3)), random.uniform(-3.0, 62.0, (count, 3))
    amplitude *= np.arange(3) < random.integers(1, 4, (count, 1))
    time = np.arange(60.0)
    shape = np.exp(-0.5 * ((time - centre[..., None]) / 2.5) ** 2)
    clean = np.einsum("re,ret->rt", amplitude, shape)
    noise = random.choice([0.02, 0.05, 0.1], (count, 1)) * clean + 1e-9
    return clean + noise * random.normal(size=clean.shape), noise


def within_bounds(echoes, power, noise):
    """(records,) True if all echoes lie within the record and none is higher than the noise allows."""
    is_echo = np.arange(np.shape(echoes.time)[-1]) < np.asarray(echoes.count)[:, None]
    highest = np.max(power + noise, axis=1, keepdims=True)
    is_inside = (np.asarray(echoes.time) >= 0) & (np.asarray(echoes.time) <= power.shape[1] - 1)
    # A peak between samples is higher than both: by exp(1 / (8 s^2)) = 1.08 for half the pulse, s = 1.25.
    return np.all(~is_echo | (is_inside & (np.asarray(echoes.amplitude) <= 1.1 * highest)), axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("count", [200, 4000])
def test_no_echo_leaves_its_record_with_noise_in_proportion(count):
    power, noise = records_with_proportional_noise(count, 8)
    lag, time = np.arange(-20.0, 21.0), np.arange(60.0)
    pulse = np.exp(-0.5 * (lag / 2.5) ** 2)
    for kind in ({"width": 2.5}, {"pulse": pulse, "broaden": False}):
        echoes = gaussian_decomposition(time, power, noise=noise, **kind, max_echoes=4)
        assert np.all(within_bounds(echoes, power, noise))
        # The bounds cost no strong echo.
        has_signal = np.max(power[:, 5:-5], axis=1) > 0.1
        assert np.all(np.asarray(echoes.count)[has_signal] > 0)
    # Negative controls: an echo beyond the end, and one too high.
    too_late = echoes._replace(time=echoes.time.at[0, 0].set(61.0))
    too_high = echoes._replace(amplitude=echoes.amplitude.at[1, 0].set(2.0 * float(power[1].max())))
    assert not within_bounds(too_late, power, noise)[0]
    assert not within_bounds(too_high, power, noise)[1]
