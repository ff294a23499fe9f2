"""Tools without a model do not depend on the unit of a record, nor on the origin of its times and heights.

Uneven steps and backgrounds that were not removed are refused. A record without signal in a batch leaves the
others as they are.
"""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from inversion import (
    find_ground,
    gap_probability,
    gaussian_decomposition,
    gedi_metrics,
    ground_and_canopy,
    plant_area_index,
    plant_area_profile,
    recorded_pulse,
    relative_heights,
    richardson_lucy,
    signal_ends,
    wiener,
)
from tests.helpers import slow_unless

STEP = 0.15
HEIGHT = np.arange(30.0, -15.0, -STEP)
TIME = np.arange(HEIGHT.size, dtype=float)
LAG = np.arange(-20.0, 21.0)
PULSE = np.exp(-0.5 * (LAG / 5.0) ** 2)
SIGMA = 0.01


def echo(height, amplitude=1.0, width=5 * STEP):
    return amplitude * np.exp(-0.5 * ((HEIGHT - height) / width) ** 2)


def noisy_record(seed=0):
    """Canopy at 14 m, ground at 0 m, and noise."""
    return echo(14.0, 0.6) + echo(0.0) + SIGMA * np.random.default_rng(seed).normal(size=HEIGHT.size)


def made_up_shot(record, noise_mean=0.0, noise_std=SIGMA, elevation=HEIGHT):
    return types.SimpleNamespace(
        elevation=elevation, waveform=record, noise_mean=noise_mean, noise_std=noise_std
    )


# Results of a record and its noise in a unit; energies are over the unit.
TOOLS = {
    "find_ground": lambda y, n, unit: find_ground(HEIGHT, y, noise=n, pulse=PULSE),
    "find_ground without pulse": lambda y, n, unit: find_ground(HEIGHT, y, threshold=20 * n),
    "signal_ends": lambda y, n, unit: jnp.stack(signal_ends(HEIGHT, y, noise=n)),
    "signal_ends of a pulse": lambda y, n, unit: jnp.stack(signal_ends(HEIGHT, y, pulse=PULSE)),
    "relative_heights": lambda y, n, unit: relative_heights(HEIGHT, y, noise=n),
    "ground_and_canopy": lambda y, n, unit: jnp.stack(
        [x / u for x, u in zip(ground_and_canopy(HEIGHT, y, noise=n, pulse=PULSE), (1.0, unit, unit, 1.0))]
    ),
    "plant_area_profile": lambda y, n, unit: plant_area_profile(
        HEIGHT, y, noise=n, pulse=PULSE, edges=[5.0, 10.0, 15.0]
    ),
    "gap_probability": lambda y, n, unit: gap_probability(y[:200], 5.0 * unit),
    "richardson_lucy": lambda y, n, unit: richardson_lucy(y, PULSE, iterations=20) / unit,
    "wiener": lambda y, n, unit: wiener(y, PULSE, noise_to_signal=0.01) / unit,
}


def decomposed(time, y, n, unit=1.0, **shape):
    echoes = gaussian_decomposition(time, y, noise=n, max_echoes=3, **shape)
    table = [
        echoes.amplitude / unit,
        echoes.time,
        echoes.width,
        echoes.stderr[:, 0] / unit,
        echoes.stderr[:, 1],
    ]
    return np.stack([*table, np.full(3, float(echoes.count))])


UNITS = [1e-30, 1e25]


@pytest.mark.parametrize("name", TOOLS)
@pytest.mark.parametrize("unit", slow_unless([1e-30], UNITS))
def test_results_do_not_depend_on_the_unit(name, unit):
    y, tool = noisy_record(), TOOLS[name]
    expected = np.asarray(tool(y, SIGMA, 1.0))
    assert np.all(np.isfinite(expected))
    np.testing.assert_allclose(tool(unit * y, unit * SIGMA, unit), expected, rtol=1e-4, atol=1e-4)
    # As arrays of JAX in single precision, and inside a program.
    scaled, noise = jnp.asarray(unit * y, jnp.float32), jnp.float32(unit * SIGMA)
    np.testing.assert_allclose(tool(scaled, noise, unit), expected, rtol=1e-3, atol=1e-3)
    traced = jax.jit(lambda y, n: tool(y, n, jnp.float32(unit)))(scaled, noise)
    np.testing.assert_allclose(traced, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(
    "shape", [{"width": 5.0}, {"pulse": PULSE, "broaden": False}], ids=["width", "pulse"]
)
@pytest.mark.parametrize("unit", slow_unless([1e25], UNITS))
def test_echoes_do_not_depend_on_the_unit(shape, unit):
    y = noisy_record()
    expected = decomposed(TIME, y, SIGMA, **shape)
    assert expected[-1, 0] == 2
    table = decomposed(TIME, unit * y, unit * SIGMA, unit, **shape)
    np.testing.assert_allclose(table, expected, rtol=2e-3, atol=1e-3)


@pytest.mark.parametrize("unit", [1e-60, 1e60])
def test_units_beyond_single_precision(unit):
    """Numbers of NumPy are scaled before they are rounded."""
    y = noisy_record()
    scaled = relative_heights(HEIGHT, unit * y, noise=unit * SIGMA)
    np.testing.assert_allclose(scaled, relative_heights(HEIGHT, y, noise=SIGMA), rtol=1e-5)
    ground = find_ground(HEIGHT, unit * y, noise=unit * SIGMA, pulse=unit * PULSE)
    np.testing.assert_allclose(ground, find_ground(HEIGHT, y, noise=SIGMA, pulse=PULSE), atol=1e-4)


@pytest.mark.parametrize("unit", UNITS)
def test_metrics_of_shots_do_not_depend_on_the_unit(unit):
    y = noisy_record()
    expected = gedi_metrics([made_up_shot(y)])
    scaled = gedi_metrics([made_up_shot(unit * y, noise_std=unit * SIGMA)])
    for value, reference in zip(scaled, expected, strict=True):
        np.testing.assert_allclose(value, reference, atol=0.04)


# -- times and heights -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "shape", [{"width": 0.5}, {"pulse": PULSE, "broaden": False}], ids=["width", "pulse"]
)
def test_echoes_do_not_depend_on_the_origin_of_time(shape):
    """Steps of 0.1 ns at 1e6 ns, which single precision holds in multiples of 0.06 ns."""
    y, time = noisy_record(), 0.1 * TIME
    expected, table = decomposed(time, y, SIGMA, **shape), decomposed(1e6 + time, y, SIGMA, **shape)
    np.testing.assert_allclose(
        np.delete(table, 1, axis=0), np.delete(expected, 1, axis=0), rtol=1e-3, atol=1e-4
    )
    np.testing.assert_allclose(table[1, :2] - 1e6, expected[1, :2], atol=0.04)
    with jax.enable_x64(True):
        table = decomposed(1e6 + time, y, SIGMA, **shape)
    np.testing.assert_allclose(table[1, :2] - 1e6, expected[1, :2], atol=1e-3)


def test_heights_do_not_depend_on_their_origin():
    y, offset, ends = noisy_record(), 1e6, (20.0, -5.0)
    expected = relative_heights(HEIGHT, y, ground=0.2, ends=ends)
    lifted = relative_heights(
        HEIGHT + offset, y, ground=offset + 0.2, ends=tuple(offset + end for end in ends)
    )
    np.testing.assert_allclose(lifted, expected, atol=1e-4)
    expected = relative_heights(HEIGHT, y, noise=SIGMA, ground=0.2)
    lifted = relative_heights(HEIGHT + offset, y, noise=SIGMA, ground=offset + 0.2)
    np.testing.assert_allclose(lifted, expected, atol=1e-4)
    split = ground_and_canopy(HEIGHT, y, noise=SIGMA, pulse=PULSE)
    lifted = ground_and_canopy(HEIGHT + offset, y, noise=SIGMA, pulse=PULSE)
    np.testing.assert_allclose(lifted[1:], split[1:], rtol=1e-4)
    np.testing.assert_allclose(lifted.height - offset, split.height, atol=0.07)
    options = {"noise": SIGMA, "pulse": PULSE, "edges": [5.0, 10.0, 15.0]}
    np.testing.assert_allclose(
        plant_area_profile(HEIGHT + offset, y, **options), plant_area_profile(HEIGHT, y, **options), rtol=1e-3
    )
    assert float(find_ground(HEIGHT + offset, y, noise=SIGMA, pulse=PULSE)) == pytest.approx(offset, abs=0.07)


UNEVEN_TIME = np.where(TIME < 150, TIME, 2.0 * TIME - 150.0)
UNEVEN_HEIGHT = 30.0 - STEP * UNEVEN_TIME


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda y: gaussian_decomposition(UNEVEN_TIME, y, noise=SIGMA, width=5.0),
            "time has a step of [12] ",
        ),
        (lambda y: find_ground(UNEVEN_HEIGHT, y), "height has a step of -0.*on average; admissible are even"),
        (lambda y: signal_ends(UNEVEN_HEIGHT, y), "height has a step"),
        (lambda y: relative_heights(UNEVEN_HEIGHT, y, ends=(20.0, -5.0)), "height has a step"),
        (lambda y: ground_and_canopy(UNEVEN_HEIGHT, y, pulse=PULSE), "height has a step"),
        (lambda y: plant_area_profile(UNEVEN_HEIGHT, y, pulse=PULSE, edges=[1.0, 2.0]), "height has a step"),
        (lambda y: gedi_metrics([made_up_shot(y, elevation=UNEVEN_HEIGHT)]), "elevation has a step"),
        (lambda y: gedi_metrics([made_up_shot(y, elevation=HEIGHT[::-1])]), "steps of elevation"),
        (lambda y: recorded_pulse(UNEVEN_TIME, np.abs(y)), "time has a step"),
        (lambda y: recorded_pulse(1e-9 * UNEVEN_TIME, np.abs(y)), "time has a step"),
        # One row of several.
        (lambda y: find_ground(np.stack([HEIGHT, UNEVEN_HEIGHT]), np.stack([y, y])), "height has a step"),
        # One sample is missing.
        (
            lambda y: find_ground(np.delete(HEIGHT, 100), y[1:]),
            "height has a step of -0.3 among uneven steps",
        ),
    ],
)
def test_uneven_steps_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(noisy_record())


def test_steps_of_rounded_heights_are_even():
    """Heights of two decimals, and those of single precision at 3 km, are read with their mean step."""
    y, step = noisy_record(), 0.1498
    height = 30.0 - step * np.arange(HEIGHT.size)
    expected = relative_heights(height, y, noise=SIGMA, ground=0.0)
    for rounded, origin in ((np.round(height, 2), 0.0), (np.float32(height + 3000.0), 3000.0)):
        lifted = relative_heights(rounded, y, noise=SIGMA, ground=origin)
        np.testing.assert_allclose(lifted, expected, atol=0.02)


@pytest.mark.slow
def test_each_shot_has_its_step():
    """A pulse in ns spans twice as many samples in a record of half the step."""
    pulse = jl.GaussianPulse(fwhm=12.0)
    fine = 30.0 - 0.5 * STEP * TIME
    # Ground at 20 m, recorded with both steps.
    power = np.stack([np.asarray(pulse.power((20.0 - z) / 0.149896229)) for z in (HEIGHT, fine)])
    heights = np.stack([HEIGHT, fine])
    together = gap_and_height(ground_and_canopy(heights, power, pulse=pulse))
    alone = [gap_and_height(ground_and_canopy(z, y, pulse=pulse)) for z, y in zip(heights, power)]
    np.testing.assert_allclose(together, np.stack(alone, axis=1), atol=1e-3)
    np.testing.assert_allclose(together[1], 20.0, atol=0.01)


def gap_and_height(split):
    return np.stack([split.gap, split.height])


# -- backgrounds -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [SIGMA, None])
@pytest.mark.parametrize("baseline", [200.0, 20.0, -20.0, -200.0])
def test_a_baseline_is_refused(baseline, noise):
    y = noisy_record() + baseline * SIGMA
    for call in (
        lambda: find_ground(HEIGHT, y, noise=noise),
        lambda: find_ground(HEIGHT, y, noise=noise, pulse=PULSE),
        lambda: signal_ends(HEIGHT, y, noise=noise),
        lambda: relative_heights(HEIGHT, y, noise=noise),
        lambda: ground_and_canopy(HEIGHT, y, noise=noise, pulse=PULSE),
        lambda: find_ground(HEIGHT, np.stack([noisy_record(), y]), noise=noise),
    ):
        with pytest.raises(
            ValueError, match=r"power.* has a baseline of about .*; admissible are records less"
        ):
            call()
    if noise is not None:
        with pytest.raises(ValueError, match="waveform less noise_mean has a baseline"):
            gedi_metrics([made_up_shot(y)])


@pytest.mark.parametrize("noise", [SIGMA, None])
def test_records_without_a_baseline_pass(noise):
    """Errors of the background below the noise, records cut off within the signal, and noise alone."""
    noise_alone = noisy_record() - echo(14.0, 0.6) - echo(0.0)
    for y in (noisy_record() + 0.5 * SIGMA, noisy_record() - 0.5 * SIGMA, noise_alone, 0.0 * HEIGHT):
        find_ground(HEIGHT, y, noise=noise, pulse=PULSE)
        signal_ends(HEIGHT, y, noise=noise)
    cut = slice(90, 215)
    assert float(find_ground(HEIGHT[cut], noisy_record()[cut], noise=noise, pulse=PULSE)) == pytest.approx(
        0.0, abs=0.1
    )
    # A threshold above it.
    lifted = noisy_record() + 20 * SIGMA
    assert float(find_ground(HEIGHT, lifted, noise=noise, threshold=0.5)) == pytest.approx(0.0, abs=0.5)


# -- batches -----------------------------------------------------------------------------------------------


def test_plant_area_of_missing_and_closed_canopies():
    area = np.asarray(plant_area_index(np.array([0.5, np.nan, 0.0, 1.0])))
    np.testing.assert_allclose(area, [2 * np.log(2.0), np.nan, np.inf, 0.0], rtol=1e-6)
    for gap in (-0.1, 1.1, np.inf):
        with pytest.raises(ValueError, match=rf"gap = {gap:g} is outside the admissible range \[0, 1\]"):
            plant_area_index(np.array([0.5, np.nan, gap]))


@pytest.mark.slow
def test_records_of_zeros_in_a_batch():
    """They have no ground, no ends and no echoes, and the others are as alone."""
    y = np.stack([noisy_record(), 0.0 * HEIGHT])
    for tool in (
        lambda y: find_ground(HEIGHT, y, pulse=PULSE, noise=SIGMA),
        lambda y: jnp.stack(signal_ends(HEIGHT, y, noise=SIGMA), axis=-1),
        lambda y: relative_heights(HEIGHT, y, noise=SIGMA),
        lambda y: jnp.stack(ground_and_canopy(HEIGHT, y, pulse=PULSE, noise=SIGMA), axis=-1),
        lambda y: plant_area_profile(HEIGHT, y, pulse=PULSE, noise=SIGMA, edges=[5.0, 10.0, 15.0]),
    ):
        results = np.asarray(tool(y))
        np.testing.assert_allclose(results[0], tool(y[0]), rtol=1e-5, atol=1e-5)
        assert np.all(np.isnan(results[1]))
    echoes = gaussian_decomposition(TIME, y, noise=SIGMA, width=5.0, max_echoes=3)
    np.testing.assert_array_equal(echoes.count, [2, 0])
    assert all(np.all(np.isfinite(x)) for x in echoes)
    areas = plant_area_index(ground_and_canopy(HEIGHT, y, pulse=PULSE, noise=SIGMA).gap)
    np.testing.assert_array_equal(np.isnan(areas), [False, True])


def test_samples_of_infinite_noise_do_not_set_the_scale():
    """Saturated samples of any size, which do not count, leave the echoes as they are."""
    noise = np.where(TIME > 270, np.inf, SIGMA)
    expected = decomposed(TIME, noisy_record(), noise, width=5.0)
    table = decomposed(TIME, np.where(TIME > 270, 1e30, noisy_record()), noise, width=5.0)
    np.testing.assert_allclose(table, expected, rtol=1e-4, atol=1e-5)


def test_noise_beyond_single_precision_is_noise():
    """Noise of 1e-60 is above 0, and noise of 1e60 is not infinite: neither leaves numbers that are not."""
    for noise, count in ((1e-60, 2), (1e60, 0)):
        echoes = gaussian_decomposition(TIME, echo(14.0, 0.6) + echo(0.0), noise=noise, width=5.0)
        assert int(echoes.count) == count
        assert all(np.all(np.isfinite(x)) for x in (echoes.amplitude, echoes.time, echoes.model))


# -- deconvolution and gap probability ---------------------------------------------------------------------


def test_deconvolution_with_a_pulse_longer_than_the_record():
    y = np.zeros(15)
    y[7] = 1.0
    for sharp in (richardson_lucy(y, PULSE), wiener(y, PULSE, noise_to_signal=0.1)):
        assert sharp.shape == y.shape
        assert np.all(np.isfinite(sharp))
    # Half of this pulse is zero: light of the first bins is not recorded at all.
    one_sided = np.where(LAG < -10, 1.0, 0.0)
    assert np.all(np.isfinite(richardson_lucy(y, one_sided)))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: richardson_lucy(HEIGHT * np.nan, PULSE), "power = nan"),
        (lambda: richardson_lucy(np.ones(9), np.zeros(5)), "sum of pulse = 0"),
        (lambda: gap_probability([0.1, np.nan], 0.2), "canopy = nan"),
        (lambda: gap_probability([0.1, 0.2], -0.2), "ground = -0.2"),
        (lambda: recorded_pulse(np.arange(5.0), np.zeros(5)), "largest power = 0"),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_gap_probability_of_noise_alone():
    np.testing.assert_array_equal(gap_probability([0.0, 0.0], 0.0), 1.0)
    assert np.all(np.isnan(gap_probability([0.1, -0.3], 0.0)))


@pytest.mark.parametrize("unit", [1e-60, 1e60])
def test_scale_of_a_recorded_pulse_does_not_matter(unit):
    time, power = np.arange(-8.0, 9.0), np.exp(-0.5 * (np.arange(-8.0, 9.0) / 1.7) ** 2)
    expected = recorded_pulse(time, power).cumulative(time)
    np.testing.assert_allclose(recorded_pulse(time, unit * power).cumulative(time), expected, atol=1e-6)
