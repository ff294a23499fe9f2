"""Echoes as copies of a recorded pulse: a hard target has one, at every signal-to-noise ratio."""

import jax
import numpy as np
import pytest

import jaxlidar as jl
from inversion import gaussian_decomposition

LAG = np.arange(-40.0, 41.0)
TIME = np.arange(120.0)


def impulse(lag):
    """A skewed system impulse with a second bump of 6 %, smooth enough for its sampling."""
    skewed = np.where(lag < 0, np.exp(-0.5 * (lag / 4.0) ** 2), np.exp(-0.5 * (lag / 6.5) ** 2))
    return skewed + 0.06 * np.exp(-0.5 * ((lag - 22.0) / 4.0) ** 2)


def record(*echoes):
    return sum(a * impulse(TIME - t) for a, t in echoes)


def hard_targets(ratio, shots=20):
    """Noisy copies at random places between samples."""
    random = np.random.default_rng(7)
    places = random.uniform(45.0, 60.0, shots)
    clean = np.stack([record((1.0, place)) for place in places])
    return places, clean + random.normal(size=clean.shape) / ratio


@pytest.mark.parametrize("ratio", [5.0, 30.0, 200.0, 1000.0])
def test_a_hard_target_has_one_echo(ratio):
    places, power = hard_targets(ratio)
    found = gaussian_decomposition(TIME, power, noise=1 / ratio, pulse=impulse(LAG))
    np.testing.assert_array_equal(found.count, 1)
    np.testing.assert_allclose(found.time[:, 0], places, atol=0.02 + 5 / ratio)
    np.testing.assert_allclose(found.amplitude[:, 0], 1.0, atol=0.01 + 3 / ratio)


def test_gaussians_make_more_of_it():
    """What the copies are for: the same records, decomposed into Gaussians."""
    _, power = hard_targets(1000.0)
    assert np.min(np.asarray(gaussian_decomposition(TIME, power, noise=1e-3, width=5.0).count)) >= 2


def test_two_targets_are_told_apart_and_errors_are_as_stated():
    random = np.random.default_rng(5)
    power = record((1.0, 40.3), (0.6, 58.8)) + 0.02 * random.normal(size=(60, TIME.size))
    settings = {"noise": 0.02, "pulse": impulse(LAG), "pulse_error": 0.0, "broaden": False, "max_echoes": 3}
    found = gaussian_decomposition(TIME, power, **settings)
    right = np.asarray(found.count) == 2
    assert right.mean() > 0.95
    table = np.stack([found.amplitude, found.time], axis=2)[right, :2]
    z = (table - [[1.0, 40.3], [0.6, 58.8]]) / np.asarray(found.stderr)[right, :2, :2]
    n = right.sum()
    assert np.all(np.abs(z.mean(axis=0)) < 4.5 / np.sqrt(n))
    assert np.all(np.abs(z.var(axis=0) - 1) < 4.5 * np.sqrt(2 / n))


@pytest.mark.slow
def test_a_wide_target_is_a_broadened_copy():
    """Of a Gaussian pulse: the variances add."""
    pulse = jl.GaussianPulse(fwhm=9.0)
    width = np.hypot(9.0 / 2.3548, 5.0)
    power = np.exp(-0.5 * ((TIME - 61.4) / width) ** 2)
    found = gaussian_decomposition(TIME, power, noise=0.005, pulse=pulse)
    assert int(found.count) == 1
    assert float(found.width[0]) == pytest.approx(5.0, rel=0.02)
    assert float(found.time[0]) == pytest.approx(61.4, abs=0.02)
    np.testing.assert_allclose(found.model, power, atol=0.01)


def test_lengths_up_to_a_size_share_a_program(caplog):
    # A number of records that no other test has, so that the first is heard whatever ran before.
    power = np.tile(record((1.0, 40.0)), (11, 1))
    for bins in (75, 90):
        with jax.log_compiles():
            caplog.clear()
            settings = {"noise": 0.01, "pulse": impulse(LAG), "broaden": False, "max_echoes": 2}
            found = gaussian_decomposition(TIME[:bins], power[:, :bins], **settings)
            heard = any("_decompose" in said for said in caplog.messages)
        assert heard == (bins == 75)
        assert np.all(np.asarray(found.count) == 1)
        assert found.model.shape == (11, bins)


def test_samples_of_infinite_noise_do_not_count():
    noise = np.where(TIME > 90, np.inf, 0.01)
    power = record((1.0, 40.0)) + np.where(TIME > 90, 5.0, 0.0)
    found = gaussian_decomposition(TIME, power, noise=noise, width=5.0, max_echoes=3)
    assert int(found.count) >= 1
    assert np.all(np.asarray(found.time) <= 90)
    # The end of a record that is cut within an echo is no echo beyond it.
    cut = gaussian_decomposition(
        TIME[:41], power[:41], noise=0.01, pulse=impulse(LAG), broaden=False, max_echoes=2
    )
    assert np.all(np.asarray(cut.time) <= 40)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({}, "width and pulse"),
        ({"width": 1.0, "pulse": np.ones(3)}, "width and pulse"),
        ({"pulse": np.ones(4)}, "odd number of lags"),
        ({"pulse": np.ones(5), "pulse_error": -1.0}, "pulse_error = -1"),
    ],
)
def test_bad_input_is_refused(settings, says):
    with pytest.raises(ValueError, match=says):
        gaussian_decomposition(TIME, TIME, noise=1.0, **settings)


def proportional(count, seed):
    """Records of up to three echoes, some of which lie beyond the ends, with noise in proportion to them."""
    random = np.random.default_rng(seed)
    echoes, place = random.uniform(0.1, 1.0, (count, 3)), random.uniform(-3.0, 62.0, (count, 3))
    echoes *= np.arange(3) < random.integers(1, 4, (count, 1))
    time = np.arange(60.0)
    shape = np.exp(-0.5 * ((time - place[..., None]) / 2.5) ** 2)
    clean = np.einsum("re,ret->rt", echoes, shape)
    noise = random.choice([0.02, 0.05, 0.1], (count, 1)) * clean + 1e-9
    return clean + noise * random.normal(size=clean.shape), noise


def inside(found, power, noise):
    """Whether all echoes lie within their records, none of them higher than the noise allows."""
    on = np.arange(np.shape(found.time)[-1]) < np.asarray(found.count)[:, None]
    top = np.max(power + noise, axis=1, keepdims=True)
    sane = (np.asarray(found.time) >= 0) & (np.asarray(found.time) <= power.shape[1] - 1)
    # A peak between samples is higher than both: of half the pulse's width, by so much.
    return np.all(~on | (sane & (np.asarray(found.amplitude) <= 1.1 * top)), axis=1)


@pytest.mark.parametrize("count", [200, pytest.param(4000, marks=pytest.mark.slow)])
def test_no_echo_leaves_its_record_with_noise_in_proportion(count):
    power, noise = proportional(count, 8)
    lag, time = np.arange(-20.0, 21.0), np.arange(60.0)
    pulse = np.exp(-0.5 * (lag / 2.5) ** 2)
    for kind in ({"width": 2.5}, {"pulse": pulse, "broaden": False}):
        found = gaussian_decomposition(time, power, noise=noise, **kind, max_echoes=4)
        assert np.all(inside(found, power, noise))
        # A strong echo is never lost to the bounds.
        lit = np.max(power[:, 5:-5], axis=1) > 0.1
        assert np.all(np.asarray(found.count)[lit] > 0)
    # Echoes that ran away are seen by the measure.
    far = found._replace(time=found.time.at[0, 0].set(61.0))
    high = found._replace(amplitude=found.amplitude.at[1, 0].set(2.0 * float(power[1].max())))
    assert not inside(far, power, noise)[0]
    assert not inside(high, power, noise)[1]
