"""Ends of the signal, relative heights, ground and canopy of synthetic records, whose echoes are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from inversion import find_ground, ground_and_canopy, plant_area_index, relative_heights, signal_ends

HEIGHT = np.arange(40.0, -20.0, -0.15)
LAG = np.arange(-60.0, 61.0)


def system_pulse():
    """Skewed pulse with a second bump of 15 % in its tail, time zero at its mode."""
    skewed = np.where(LAG < 0, np.exp(-0.5 * (LAG / 4.0) ** 2), np.exp(-0.5 * (LAG / 6.5) ** 2))
    return skewed + 0.15 * np.exp(-0.5 * ((LAG - 30.0) / 4.0) ** 2)


def echoes(*targets, pulse=None):
    """Record of copies of the pulse, with the amplitude and height of each target."""
    pulse = system_pulse() if pulse is None else pulse
    delay = (HEIGHT[0] - HEIGHT) / 0.15
    record = np.zeros(HEIGHT.size)
    for amplitude, height in targets:
        record += amplitude * np.interp(delay - (HEIGHT[0] - height) / 0.15, LAG, pulse, left=0.0, right=0.0)
    return record


def noisy(record, sigma, seed):
    return record + sigma * np.random.default_rng(seed).normal(size=record.shape)


def test_ends_of_a_box():
    """A straight line from sample to sample crosses the threshold; an empty record has no ends."""
    power = np.where((HEIGHT < 20.0) & (HEIGHT > 0.0), 10.0, 0.0)
    top, bottom = signal_ends(HEIGHT, power, noise=1.0, threshold=5.0)
    inside = np.flatnonzero(power)
    assert float(top) == pytest.approx(HEIGHT[inside[0]] + 0.075, abs=1e-4)
    assert float(bottom) == pytest.approx(HEIGHT[inside[-1]] - 0.075, abs=1e-4)
    assert all(np.isnan(end) for end in signal_ends(HEIGHT, 0 * power, noise=1.0))


def test_ends_with_an_estimate_of_the_noise():
    """Of 200 noisy records none begins in the noise, even if the background is off by half a deviation."""
    power = np.stack([noisy(echoes((80.0, 18.0), (150.0, 2.0)), 2.0, seed) for seed in range(200)])
    for offset in (0.0, 1.0):
        ends = signal_ends(HEIGHT, power + offset, pulse=system_pulse())
        # The echoes' pulses begin above the targets, and end below them with the tail.
        assert np.all((np.asarray(ends.top) > 18.0) & (np.asarray(ends.top) < 22.0))
        assert np.all((np.asarray(ends.bottom) < 2.0) & (np.asarray(ends.bottom) > -8.0))


def test_noise_beyond_the_signal_does_not_move_relative_heights():
    """Over all of a long record the noise moves RH98 by metres; between the signal's ends it does not."""
    clean = echoes((60.0, 15.0), (100.0, 0.0))
    power = np.stack([noisy(clean, 3.0, seed) for seed in range(50)])
    between_ends = np.asarray(relative_heights(HEIGHT, power, levels=(50.0, 98.0)))
    ends = (40.0, -20.0)
    over_record = np.asarray(relative_heights(HEIGHT, np.maximum(power, 0), levels=(98.0,), ends=ends))
    truth = np.asarray(relative_heights(HEIGHT, clean, levels=(50.0, 98.0)))
    assert np.max(np.abs(between_ends - truth)) < 0.4
    assert np.min(np.abs(over_record[:, 0] - truth[1])) > 1.0


def test_ripples_of_the_pulses_tail_are_no_ground():
    """Ground is the hard target; its second bump, four metres below, is ground only without the pulse."""
    power = np.stack([noisy(echoes((100.0, 3.03)), 1.0, seed) for seed in range(100)])
    ground = np.asarray(find_ground(HEIGHT, power, pulse=system_pulse(), noise=1.0))
    assert np.max(np.abs(ground - 3.03)) < 0.1
    # Negative control: without the pulse, the bump of the tail is the lowest mode.
    smooth = np.stack([np.convolve(row, np.hanning(9) / 4.0, mode="same") for row in power])
    assert np.max(np.asarray(find_ground(HEIGHT, smooth, noise=1.0))) < 0.0


def test_a_mode_beyond_the_tail_is_ground():
    """At the bump of a tail, an echo well above it is ground, and one below the threshold is not."""
    # The bump lies 30 samples of 0.15 m below the mode.
    bump = 3.03 - 30 * 0.15
    strong, weak = echoes((100.0, 3.03), (30.0, bump)), echoes((100.0, 3.03), (2.0, bump))
    assert float(find_ground(HEIGHT, strong, pulse=system_pulse(), noise=0.5)) == pytest.approx(bump, abs=0.2)
    assert float(find_ground(HEIGHT, weak, pulse=system_pulse(), noise=0.5)) == pytest.approx(3.03, abs=0.2)


@pytest.mark.slow
def test_the_pulse_may_be_one_of_jaxlidars_and_its_zero_anywhere():
    # The pulse's mode is 9 samples after its time zero, from which heights count.
    late = np.roll(system_pulse(), 9)
    power = echoes((100.0, 3.03), pulse=late)
    assert float(find_ground(HEIGHT, power, pulse=late, noise=0.5)) == pytest.approx(3.03, abs=0.03)
    gaussian = jl.GaussianPulse(fwhm=10.0)
    power = np.asarray(gaussian.power(-(HEIGHT - 1.07) / 0.149896))
    assert float(find_ground(HEIGHT, power, pulse=gaussian)) == pytest.approx(1.07, abs=0.01)


def test_records_of_all_lengths_up_to_a_size_compile_once(caplog):
    def all_metrics(bins):
        # A number of records that no other test has: whatever ran before, the first call compiles.
        power = np.tile(echoes((60.0, 34.0), (100.0, 30.0))[:bins], (11, 1))
        split = ground_and_canopy(HEIGHT[:bins], power, pulse=system_pulse(), noise=1.0)
        heights = relative_heights(HEIGHT[:bins], power, noise=1.0)
        return np.concatenate([np.stack(split, axis=-1), heights], axis=-1)

    with jax.log_compiles():
        first = all_metrics(150)
        assert any("_find_ground" in message for message in caplog.messages)
        caplog.clear()
        second = all_metrics(185)
        programs = ("_find_ground", "_split_energy")
        assert not [message for message in caplog.messages if any(name in message for name in programs)]
    np.testing.assert_allclose(second, first, rtol=1e-3)


@pytest.mark.parametrize("fraction", [0.1, 0.3, 0.6])
def test_the_ground_is_split_from_the_canopy(fraction, precision):
    """An even canopy from 4 to 16 m over ground widened by its slope: its fraction is retrieved."""
    canopy = [(fraction / 80, 4.0 + 0.15 * i) for i in range(80)]
    slope = [((1 - fraction) * w, 0.15 * k) for k, w in zip(range(-6, 7), np.hanning(15)[1:-1] / 7.0)]
    split = ground_and_canopy(HEIGHT, 1e3 * echoes(*canopy, *slope), pulse=system_pulse())
    total = 1e3 * system_pulse().sum()
    assert float(split.height) == pytest.approx(0.0, abs=0.1)
    assert float(split.canopy) / total == pytest.approx(fraction, abs=0.03)
    assert float(split.ground) / total == pytest.approx(1 - fraction, abs=0.03)
    # Canopy 1.5 times as bright as the ground, and G = 0.5: PAI = -2 ln(gap).
    cover = fraction / (fraction + 1.5 * (1 - fraction))
    assert float(plant_area_index(split.gap)) == pytest.approx(-2 * np.log(1 - cover), rel=0.2)


@pytest.mark.slow
def test_derivatives_are_those_of_differences():
    with jax.enable_x64(True):
        power = jnp.asarray(noisy(echoes((60.0, 15.0), (100.0, 0.0)), 1.0, 3))
        direction = jnp.sin(jnp.arange(power.size))

        @jax.jit
        def values(y):
            split = ground_and_canopy(HEIGHT, y, pulse=system_pulse(), noise=1.0)
            heights = relative_heights(HEIGHT, y, noise=1.0, levels=(25.0, 60.0, 98.0))
            return jnp.concatenate([heights, jnp.stack([split.height, split.gap])])

        _, derivative = jax.jvp(values, (power,), (direction,))
        difference = (values(power + 1e-6 * direction) - values(power - 1e-6 * direction)) / 2e-6
        np.testing.assert_allclose(derivative, difference, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: signal_ends(HEIGHT[::-1], HEIGHT), "steps of height"),
        (lambda: signal_ends(HEIGHT, HEIGHT * np.nan), "power = nan"),
        (lambda: signal_ends(HEIGHT, HEIGHT, noise=-1.0), "noise = -1"),
        (lambda: signal_ends(HEIGHT, HEIGHT, threshold=-1.0), "threshold = -1"),
        (
            lambda: find_ground(HEIGHT, HEIGHT, pulse=np.ones(4)),
            "odd number of lags.*: pad one end with zeros",
        ),
        (lambda: find_ground(HEIGHT, HEIGHT, pulse=np.zeros(5)), "peak of pulse = 0"),
        (lambda: find_ground(HEIGHT, HEIGHT, threshold=np.nan), "threshold = nan"),
        (
            lambda: ground_and_canopy(HEIGHT, HEIGHT, pulse=LAG, reflectance_ratio=0.0),
            "reflectance_ratio = 0",
        ),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
