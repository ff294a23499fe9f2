"""Recorders in fits: planted offsets, smoothing and noise of a pulse are retrieved, with errors as stated."""

import dataclasses

import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion import Recorder, Unknown
from inversion.fit.recorder_model import RecorderModel
from inversion.fit.retrieval import scale_unknown
from tests.helpers import ask

TIME = np.arange(-40.0, 61.0)
HEIGHT = Unknown("ground.height", bounds=(-2.0, 2.0), name="height")
START = jl.Scene(ground=jl.Ground(height=0.1, reflectance=0.5))
SHOTS = 24
# A skewed pulse.
LAG = np.arange(-15.0, 26.0)
POWER = np.where(LAG < 0, np.exp(-0.5 * (LAG / 2.0) ** 2), np.exp(-0.5 * (LAG / 3.5) ** 2))


def plan_of(pulse, jitter=0.0):
    """Plan of a lidar for the highest ground. Flat ground needs few rays."""
    lidar = jl.Lidar(pulse=pulse, jitter=jitter)
    highest = jl.Scene(ground=jl.Ground(height=2.0, reflectance=0.5))
    return jl.plan(
        lidar, highest, max_orders=1, window=(-40.0, 60.0), bin_width=1.0, n_rays=16, footprint="fixed"
    )


def echoes(pulse, heights, jitter=0.0):
    """Records of flat ground at heights, without noise, of a peak of about one."""
    fractions = np.diff(np.asarray(pulse.cumulative(np.append(TIME - 0.5, TIME[-1] + 0.5), jitter)))
    clean = []
    for height in heights:
        edges = np.append(TIME - 0.5, TIME[-1] + 0.5) + height / 0.149896229
        clean.append(np.diff(np.asarray(pulse.cumulative(edges, jitter))))
    return np.stack(clean) / fractions.max()


def fits_of(records, pulses, noise, recorder, near=0.0, path=None):
    """Fits of records that start 0.05 m above the heights `near`."""
    lidars = [jl.Lidar(pulse=pulse) for pulse in pulses]
    settings = {"scale": (0.01, 1e3), "key": jax.random.key(0), "time": TIME, "plan": plan_of(pulses[0])}
    return ask(
        inversion.retrieve_many,
        records[:, None],
        lidars if len(lidars) > 1 else lidars[0],
        START,
        [HEIGHT],
        noise=noise,
        recorder=recorder,
        start={"height": np.broadcast_to(near, len(records)) + 0.05},
        path=path,
        **settings,
    )


def is_standard_normal(z, sigmas=4.5):
    """True if numbers have mean 0 and variance 1, up to their standard errors."""
    n = z.size
    return abs(z.mean()) < sigmas / np.sqrt(n) and abs(z.var() - 1.0) < sigmas * np.sqrt(2.0 / n)


@pytest.fixture(scope="module")
def interleaved():
    """Records of a slow receiver with two digitisers, their truths, and the pulse."""
    random, pulse = np.random.default_rng(3), jl.SampledPulse(LAG, POWER)
    height, amplitude = random.uniform(-0.5, 0.5, SHOTS), random.uniform(0.5, 2.0, SHOTS)
    offsets = random.normal(size=(SHOTS, 2)) * 0.1
    clean = amplitude[:, None] * echoes(pulse, height, jitter=1.5)
    records = clean + offsets[:, np.arange(TIME.size) % 2] + 0.01 * random.normal(size=clean.shape)
    return records, pulse, height, offsets


@pytest.mark.slow
def test_offsets_and_width_are_found_with_errors_as_stated(interleaved):
    records, pulse, height, offsets = interleaved
    recorder = Recorder(width=(0.2, 5.0), offset=(-1.0, 1.0), interleaved=2)
    fits = fits_of(records, [pulse], 0.01, recorder, height)
    assert fits.labels == ("height", "receiver width", "offset[0]", "offset[1]", "scale")
    assert np.all(fits.converged)
    truths = {"height": height, "receiver width": np.full(SHOTS, 1.5), "offset": offsets}
    for name, truth in truths.items():
        assert is_standard_normal(((fits.values[name] - truth) / fits.stderr[name]).ravel()), name
    # Standard error of the mean of reduced chi-squared over shots, with five unknowns each.
    spread = np.sqrt(2.0 / (TIME.size - 5) / SHOTS)
    assert abs(fits.reduced_chi2.mean() - 1.0) < 4.5 * spread
    # Negative controls: one baseline for both digitisers, and none.
    for wrong in (Recorder(width=(0.2, 5.0), offset=(-1.0, 1.0)), Recorder(width=(0.2, 5.0))):
        assert fits_of(records, [pulse], 0.01, wrong, height).reduced_chi2.mean() > 1.0 + 45 * spread
    # The record of the fitted values has the chi-squared of the fit.
    record = recorder.recorded(fits.fitted[0, 0], {name: v[0] for name, v in fits.values.items()})
    chi2 = np.sum(((record - records[0]) / 0.01) ** 2) / (TIME.size - 5)
    assert chi2 == pytest.approx(fits.reduced_chi2[0], rel=1e-3)


@pytest.mark.slow
def test_an_impulse_is_a_width_of_its_own_shape(interleaved):
    """The same receiver, given as an impulse instead of a width."""
    records, pulse, height, _ = interleaved
    lag = np.arange(-8.0, 9.0)
    recorder = Recorder(impulse=np.exp(-0.5 * (lag / 1.5) ** 2), offset=(-1.0, 1.0), interleaved=2)
    fits = fits_of(records, [pulse], 0.01, recorder, height)
    assert is_standard_normal((fits.values["height"] - height) / fits.stderr["height"])
    assert abs(fits.reduced_chi2.mean() - 1.0) < 4.5 * np.sqrt(2.0 / (TIME.size - 4) / SHOTS)


@pytest.mark.slow
@pytest.mark.parametrize("jitter", [0.0, 1.5], ids=["fast", "slow receiver"])
def test_noise_of_the_recorded_pulse_is_noise_of_the_fit(jitter):
    """A fast receiver repeats the noise of the pulse in the echo of hard ground; a slow one smooths it.

    In both, reduced chi-squared is one, and the height has the error stated.
    """
    random = np.random.default_rng(11)
    lag = np.arange(-12.0, 13.0)
    fine = jl.SampledPulse(lag, np.cos(np.pi * lag / 24.0) ** 2)
    height, amplitude = random.uniform(-0.5, 0.5, SHOTS), random.uniform(0.5, 1.0, SHOTS)
    clean = amplitude[:, None] * echoes(fine, height, jitter)
    records = clean + 0.002 * random.normal(size=clean.shape)
    sent = np.diff(np.asarray(fine.cumulative(np.append(lag - 0.5, lag[-1] + 0.5))))
    # The recorded pulse of every shot: the true one with noise of its own.
    sent = np.maximum(sent / sent.max() + 0.005 * random.normal(size=(SHOTS, lag.size)), 0.0)
    sent[:, [0, -1]] = 0.0
    pulses = [inversion.recorded_pulse(lag, s, finer=2) for s in sent]
    response = np.exp(-0.5 * (np.arange(-8.0, 9.0) / jitter) ** 2) if jitter else None
    fits = fits_of(records, pulses, 0.002, Recorder(impulse=response, pulse_noise=0.005), height)
    assert np.all(fits.converged)
    assert is_standard_normal((fits.values["height"] - height) / fits.stderr["height"])
    spread = np.sqrt(2.0 / (TIME.size - 2) / SHOTS)
    assert abs(fits.reduced_chi2.mean() - 1.0) < 4.5 * spread
    # Negative control: without the noise of the pulse, both are wrong.
    without = fits_of(records, pulses, 0.002, Recorder(impulse=response), height)
    assert without.reduced_chi2.mean() > fits.reduced_chi2.mean() + 3 * spread
    assert not is_standard_normal((without.values["height"] - height) / without.stderr["height"])


def test_derivatives_are_those_of_differences():
    """In every unknown of the recorder, and through the simulated waveform."""
    random = np.random.default_rng(0)
    bounds = {"width": (0.2, 5.0), "delay": (-3.0, 3.0), "offset": (-1.0, 1.0)}
    recorder = Recorder(**bounds, impulse=[0.2, 1.0, -0.1], interleaved=3)
    model = RecorderModel(recorder, [scale_unknown((0.1, 10.0), [])], jl.Lidar(), 50)
    # Width, delay, three offsets and scale.
    values = np.array([1.3, 0.7, 0.1, -0.2, 0.05, 2.0])
    total, scene_jacobian = random.normal(size=(2, 50)), random.normal(size=(2, 50, 1))
    _, jacobian = model(total, scene_jacobian, values)
    step = 1e-5
    for i in range(values.size):
        plus, minus = (
            model(total, scene_jacobian, values + sign * step * np.eye(values.size)[i])[0]
            for sign in (1.0, -1.0)
        )
        np.testing.assert_allclose(jacobian[..., 1 + i], (plus - minus) / (2.0 * step), atol=1e-8)
    plus, minus = (
        model(total + sign * step * scene_jacobian[..., 0], scene_jacobian, values)[0] for sign in (1.0, -1.0)
    )
    np.testing.assert_allclose(jacobian[..., 0], (plus - minus) / (2.0 * step), atol=1e-8)


def test_a_range_offset_is_retrieved_with_its_error():
    """Echoes of ground whose height is known, by a timing that is not; planted: no such unknown."""
    random, noise = np.random.default_rng(2), 0.005
    pulse, delays = jl.SampledPulse(LAG, POWER), random.uniform(-6.0, 6.0, SHOTS)
    clean = echoes(pulse, -0.149896229 * delays)
    records = clean + noise * random.normal(size=clean.shape)
    settings = {"noise": noise, "time": TIME, "key": jax.random.key(0), "plan": plan_of(pulse)}
    brightness = Unknown("ground.reflectance", bounds=(0.0, 1.0), name="brightness")
    lidar, scene = jl.Lidar(pulse=pulse), jl.Scene(ground=jl.Ground(reflectance=0.5))

    def fits_with(recorder):
        options = {"recorder": recorder, "scale": (1.0, 30.0), **settings}
        # The gain and the reflectance are one factor: a prior settles it.
        unknown = dataclasses.replace(brightness, prior=(0.5, 0.05))
        return ask(inversion.retrieve_many, records[:, None], lidar, scene, [unknown], **options)

    fits = fits_with(Recorder(delay=(-8.0, 8.0)))
    assert fits.labels == ("brightness", "delay", "scale")
    assert is_standard_normal((fits.values["delay"] - delays) / fits.stderr["delay"])
    assert np.all(np.abs(fits.values["delay"] - delays) < 0.1)
    assert not is_standard_normal((fits.values["delay"] - delays - 0.05) / fits.stderr["delay"])
    assert fits_with(Recorder()).reduced_chi2.mean() > 2.0 * fits.reduced_chi2.mean()


def test_what_a_delay_moves_out_of_the_record_does_not_come_back():
    waveform = np.exp(-0.5 * ((np.arange(40.0) - np.array([[3.0], [36.0]])) / 2.0) ** 2)
    recorder = Recorder(delay=(-50.0, 50.0))
    early, late = (recorder.recorded(waveform, {"delay": delay}) for delay in (-12.0, 12.0))
    assert np.abs(early[0]).max() < 1e-4
    assert np.abs(late[1]).max() < 1e-4
    np.testing.assert_allclose(late[0, 12:], waveform[0, :-12], atol=1e-4)


def test_light_smoothed_out_of_the_record_does_not_come_back():
    """The convolution of the response does not wrap around."""
    total = np.zeros((1, 40))
    total[0, -1] = 1.0
    model = RecorderModel(Recorder(width=(0.1, 9.0)), [], jl.Lidar(), 40)
    assert np.all(np.abs(model.record(total, np.array([3.0]))[0, :20]) < 1e-6)


@pytest.mark.slow
def test_one_fit_is_that_of_a_batch(interleaved):
    records, pulse, height, _ = interleaved
    recorder = Recorder(width=(0.2, 5.0), offset=(-1.0, 1.0), interleaved=2, pulse_noise=0.005)
    batch = fits_of(records[:1], [pulse], 0.01, recorder, height[0])
    settings = {"time": TIME, "plan": plan_of(pulse), "key": jax.random.fold_in(jax.random.key(0), 0)}
    single = ask(
        inversion.retrieve,
        records[0],
        jl.Lidar(pulse=pulse),
        jl.Scene(ground=jl.Ground(height=float(height[0]) + 0.05, reflectance=0.5)),
        [HEIGHT],
        noise=0.01,
        scale=(0.01, 1e3),
        recorder=recorder,
        **settings,
    )
    for name, value in single.values.items():
        np.testing.assert_allclose(batch.values[name][0], value, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
def test_stores_refuse_another_recorder(interleaved, tmp_path):
    records, pulse, *_ = interleaved
    path = tmp_path / "fits.zarr"
    recorder = Recorder(offset=(-1.0, 1.0))
    first = fits_of(records[:2], [pulse], 0.01, recorder, path=path)
    repeated = fits_of(records[:2], [pulse], 0.01, recorder, path=path)
    np.testing.assert_array_equal(first.values["offset"], repeated.values["offset"])
    with pytest.raises(ValueError, match="recorder"):
        fits_of(records[:2], [pulse], 0.01, Recorder(offset=(-1.0, 1.0), pulse_noise=0.1), path=path)


def test_a_response_is_estimated_from_hard_targets():
    """A response with an undershoot, from noisy echoes at random positions between samples."""
    random = np.random.default_rng(2)
    true_response, true_lags = np.array([0.3, 0.1, 0.3, -0.1, 0.0, 0.4]), np.arange(-3.0, 3.0)
    records = []
    for position in 20.0 + random.uniform(0.0, 1.0, 40):
        delayed_pulses = [
            weight * np.exp(-0.5 * ((np.arange(70.0) - position - lag) / 1.7) ** 2)
            for lag, weight in zip(true_lags, true_response)
        ]
        records.append(sum(delayed_pulses) + 0.3 + 0.003 * random.normal(size=70))
    pulse = np.exp(-0.5 * (np.arange(-9.0, 10.0) / 1.7) ** 2)
    noise = [np.full(70, 0.003)] * 40
    response = inversion.receiver_impulse([pulse] * 40, records, noise=noise, before=4, after=4)
    assert response.shape == (9,)
    assert response.sum() == pytest.approx(1.0)
    # The pulse smooths the response: compared are echoes. A common delay is not determined.
    sample, true_echo = np.arange(27.0), np.convolve(pulse, np.append(true_response, [0.0, 0.0, 0.0]))

    def largest_difference(response):
        echo = np.convolve(pulse, response)
        delays = np.arange(-2.0, 2.0, 0.02)
        return min(np.max(np.abs(np.interp(sample - d, sample, true_echo) - echo)) for d in delays)

    assert largest_difference(response) < 0.06
    # Negative control: a receiver that repeats the pulse.
    assert largest_difference(np.eye(9)[4]) > 0.1


@pytest.mark.parametrize("unit", [1e-60, 1e60])
def test_a_response_does_not_depend_on_units_nor_on_shots_without_weight(unit):
    pulse = np.exp(-0.5 * (np.arange(-9.0, 10.0) / 1.7) ** 2)
    echo = np.convolve(np.pad(pulse, 20), [0.2, 0.5, 0.3])
    noise = np.full(echo.size, 0.003)
    expected = inversion.receiver_impulse([pulse], [echo], noise=[noise])
    pulses, echoes = [unit * pulse, pulse, pulse], [unit * echo, unit * echo, 0.0 * echo]
    # A shot of infinite noise, and one without an echo, have no weight.
    noises = [unit * noise, np.full(echo.size, np.inf), noise]
    response = inversion.receiver_impulse(pulses, echoes, noise=noises)
    np.testing.assert_allclose(response, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pulses": [np.full(5, np.nan)]}, "pulses = nan"),
        ({"pulses": [np.zeros(5)]}, "largest sample of pulses = 0"),
        ({"echoes": [np.full(9, np.nan)]}, "echoes = nan"),
        ({"noise": [np.zeros(9)]}, "noise = 0"),
        ({"echoes": [np.zeros(9)]}, "echoes have no signal"),
        ({"noise": [np.full(9, np.inf)]}, "echoes have no signal"),
    ],
)
def test_bad_hard_targets_are_refused(changes, message):
    pulse, echo = np.array([0.0, 1.0, 2.0, 1.0, 0.0]), np.pad([1.0, 2.0, 1.0], 3)
    arguments = {"pulses": [pulse], "echoes": [echo], "noise": [np.ones(9)], **changes}
    with pytest.raises(ValueError, match=message):
        inversion.receiver_impulse(**arguments)


@pytest.mark.slow
def test_a_recorded_pulse_is_simulated_as_it_was_recorded():
    """Samples of the pulse, as means over bins, are those of the record."""
    time = np.arange(-8.0, 9.0)
    power = np.exp(-0.5 * (time / 1.7) ** 2)
    edges = np.append(time - 0.5, time[-1] + 0.5)

    def largest_difference(pulse):
        fractions = np.diff(np.asarray(pulse.cumulative(edges)))
        return np.max(np.abs(fractions / fractions.sum() * power.sum() - power))

    assert largest_difference(inversion.recorded_pulse(time, power)) < 1e-3
    # Negative control: samples taken for the pulse are smoothed by sampling a second time.
    assert largest_difference(jl.SampledPulse(time, power)) > 0.03


def test_amplitudes_of_tables_in_decibels():
    """A linear table from a pedestal of two counts, in decibels: noise about the pedestal keeps its mean."""
    # Counts 0 to 3 have no amplitude, as RIEGL's files mark them.
    decibels = np.where(np.arange(100) < 4, -2e37, 10 * np.log10(np.maximum(np.arange(100) - 2, 1) / 7))
    converted = inversion.amplitudes(np.array([0, 2, 9, 99]), decibels, noise=0.7, decibels=True)
    np.testing.assert_allclose(converted.values, [-2 / 7, 0.0, 1.0, 97 / 7], atol=1e-9)
    np.testing.assert_allclose(converted.noise, [0.1, 0.1, 0.1, np.inf])
    assert inversion.amplitudes(np.array([3, 9]), noise=1.0, saturation=9).noise.tolist() == [1.0, np.inf]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"width": (-1.0, 2.0)}, "width"),
        ({"width": (2.0, 1.0)}, "not low < high"),
        ({"offset": 3.0}, "not a pair"),
        ({"interleaved": 2}, "offset = None"),
        ({"interleaved": 0, "offset": (0.0, 1.0)}, "interleaved = 0"),
        ({"impulse": [1.0, 2.0]}, "odd number"),
        ({"correlation": 1.0}, "correlation"),
        ({"impulse": [1.0, -2.0, 1.0]}, "sum of impulse"),
        ({"pulse_noise": -0.1}, "pulse_noise = -0.1"),
    ],
)
def test_bad_recorders_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Recorder(**settings)


def test_other_bad_input_is_refused():
    with pytest.raises(ValueError, match="increases"):
        inversion.amplitudes([1], [0.0, 2.0, 1.0], noise=1.0)
    with pytest.raises(ValueError, match="counts = 5"):
        inversion.amplitudes([5], [0.0, 2.0, 3.0], noise=1.0)
    with pytest.raises(ValueError, match="as many"):
        inversion.receiver_impulse([], [], noise=[])
    with pytest.raises(ValueError, match="uneven steps"):
        inversion.recorded_pulse([0.0, 1.0, 3.0], [0.0, 1.0, 0.0])
    offset = Unknown("ground.height", bounds=(-2.0, 2.0), name="offset")
    with pytest.raises(ValueError, match="taken by the recorder"):
        ask(
            inversion.retrieve,
            np.zeros(TIME.size),
            jl.Lidar(),
            START,
            [offset],
            noise=1.0,
            time=TIME,
            key=jax.random.key(0),
            recorder=Recorder(offset=(-1.0, 1.0)),
        )


@pytest.mark.slow
def test_correlated_noise_is_noise_of_the_fit():
    """Standard errors and chi-squared are as stated; with noise taken as independent they are not."""
    random, pulse, rho = np.random.default_rng(11), jl.SampledPulse(LAG, POWER), 0.6
    height = random.uniform(-0.5, 0.5, SHOTS)
    # Root of the covariance rho^|i - j| of the noise.
    root = np.linalg.cholesky(rho ** np.abs(np.subtract.outer(TIME, TIME)))
    records = echoes(pulse, height) + 0.02 * random.normal(size=(SHOTS, TIME.size)) @ root.T
    settings = {"offset": (-1.0, 1.0)}
    fits = fits_of(records, [pulse], 0.02, Recorder(correlation=rho, **settings), height)
    assert np.all(fits.converged)
    for name, truth in (("height", height), ("offset", np.zeros(SHOTS))):
        assert is_standard_normal((fits.values[name] - truth) / fits.stderr[name]), name
    assert fits.reduced_chi2.mean() == pytest.approx(1.0, abs=4 * np.sqrt(2 / (TIME.size * SHOTS)))
    without = fits_of(records, [pulse], 0.02, Recorder(**settings), height)
    assert not is_standard_normal(without.values["offset"] / without.stderr["offset"])


def shots_of_a_compressed_digitiser(random, count=60):
    """Counts of pulses and of a slow receiver's echoes, both compressed above 110 counts."""
    lag, response = np.arange(-12.0, 13.0), np.array([0.1, 0.7, 0.3, -0.1, 0.02])
    pulses, echoes = [], []
    for strength in random.uniform(60.0, 190.0, count):
        # Times of pulse and echo between samples.
        pulse_time, echo_time = random.uniform(-0.5, 0.5, 2)
        pulse = 150.0 * np.exp(-0.5 * ((lag - pulse_time) / 1.7) ** 2)
        light = np.exp(-0.5 * ((np.arange(-30.0, 31.0) - echo_time) / 1.7) ** 2)
        light = np.convolve(light, response, "same")
        pulses.append(np.round(compressed(pulse + 3.0) + 0.3 * random.normal(size=pulse.size).clip(-2, 2)))
        echo = compressed(strength * light / light.max() + 3.0)
        echoes.append(np.maximum(np.round(echo + 0.5 * random.normal(size=echo.size)), 0.0))
    return [np.maximum(p, 0.0) for p in pulses], echoes


def compressed(light):
    """Counts of light above 110 rise by 0.7 only."""
    return np.where(light > 110.0, 110.0 + 0.7 * (light - 110.0), light)


def test_a_corrected_table_undoes_the_compression():
    """Amplitudes are within 2 % of the light; by the uncorrected table they are off by more than 10 %."""
    table, options = np.arange(256.0), {"noise": 0.5, "knots": [100.0, 115.0, 130.0, 145.0, 160.0]}
    pulses, echoes = shots_of_a_compressed_digitiser(np.random.default_rng(4))
    corrected = inversion.corrected_table(table, pulses, echoes, **options)
    # Light of 180 gives 159 counts, just below the last knot.
    light = np.linspace(50.0, 180.0, 50)
    read = np.interp(compressed(light), table, corrected)
    np.testing.assert_allclose(read, light, rtol=0.02)
    assert np.max(np.abs(compressed(light) / light - 1.0)) > 0.1
    assert np.all(np.diff(corrected) > 0)


def test_bad_tables_are_refused():
    counts = [np.arange(20.0)]
    options = {"noise": 0.5, "knots": [10.0, 20.0]}
    for changes, message in (
        ({"pulses": []}, "pulses and echoes are 0 and 1"),
        ({"knots": [20.0, 10.0]}, "knots"),
        ({"noise": 0.0}, "noise"),
        ({"echoes": [np.array([300.0])]}, "echoes"),
    ):
        arguments = {"pulses": counts, "echoes": counts, **options, **changes}
        with pytest.raises(ValueError, match=message):
            inversion.corrected_table(np.arange(256.0), **arguments)
