"""Discrete returns: detectors against echoes in closed form, and against the surfaces of scenes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.io import FileWarning
from jaxlidar.survey.acquisition import PULSE_OVERSAMPLING, sampled_pulse
from jaxlidar.survey.returns import _find_echoes, _levels, _median_beside_echoes, position_along_beam

DETECTORS = ("peak", "constant fraction", "leading edge")
STD = 3.0
FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0)) * STD
LAGS = np.arange(-20 * PULSE_OVERSAMPLING, 20 * PULSE_OVERSAMPLING + 1) / PULSE_OVERSAMPLING
PULSE = np.exp(-0.5 * (LAGS / STD) ** 2) / (STD * np.sqrt(2.0 * np.pi))


def gaussian_record(*echoes, samples=120):
    """Record of Gaussian echoes, each (amplitude, time in samples)."""
    time = np.arange(samples)
    return sum(a * np.exp(-0.5 * ((time - t) / STD) ** 2) for a, t in echoes)


def find(detector, *records, noise=0.0, threshold=None, fraction=0.5):
    records = np.stack(records)
    limits = None if threshold is None else np.full(len(records), threshold)
    return find_echoes(detector, records, noise, limits, fraction, PULSE)


def find_echoes(detector, records, noise, limits, fraction, pulse):
    noise = np.full((len(records), 1), noise)
    return _find_echoes(detector, records, noise, _levels(records, noise, limits), fraction, pulse)


# -- detectors ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("detector", DETECTORS)
def test_times_of_gaussian_echoes_are_exact_at_every_phase_of_the_samples(detector):
    """Separate echoes of any amplitude and phase: the calibration by the pulse leaves no walk."""
    times = 30.0 + np.arange(16) / 16.0
    records = [
        gaussian_record((a, t), (0.3 * a, t + 50.3)) for t, a in zip(times, np.geomspace(1e-16, 1.0, 16))
    ]
    echoes = find(detector, *records)
    assert echoes.row.tolist() == np.repeat(np.arange(16), 2).tolist()
    # Edges are interpolated between samples, linearly or in logarithms; 0.015 samples of 1 ns are 2.2 mm.
    tolerance = {"peak": 1e-4, "constant fraction": 0.015, "leading edge": 0.03}[detector]
    np.testing.assert_allclose(echoes.time, np.stack([times, times + 50.3], axis=1).ravel(), atol=tolerance)
    expected = np.stack([np.geomspace(1e-16, 1.0, 16), 0.3 * np.geomspace(1e-16, 1.0, 16)], axis=1).ravel()
    np.testing.assert_allclose(echoes.amplitude, expected, rtol=1e-3)
    np.testing.assert_allclose(echoes.width, FWHM, rtol=0.01)


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize(
    "pulse",
    [
        jl.ExponentiallyModifiedGaussianPulse(fwhm=3.0, decay=2.0),
        jl.ExponentiallyModifiedGaussianPulse(fwhm=3.0, decay=0.5),
        jl.GaussianPulse(fwhm=1.5),
    ],
)
def test_times_of_skewed_and_of_short_pulses_have_no_walk_with_the_phase(detector, pulse):
    """The interpolation between samples, which these pulses make worst, is calibrated at every phase."""
    lidar = jl.Lidar(pulse=pulse)
    times = 30.0 + np.arange(32) / 32.0
    edges = np.arange(121.0) - 0.5
    records = np.stack([np.diff(np.asarray(pulse.cumulative(edges - t, 0.0), float)) for t in times])
    echoes = find_echoes(detector, records, 0.0, None, 0.5, sampled_pulse(lidar))
    assert echoes.row.tolist() == list(range(32))
    np.testing.assert_allclose(echoes.time, times, atol=0.015)
    assert abs(np.mean(echoes.time - times)) < 1e-3


def test_a_flat_top_is_read_at_its_middle():
    """Samples of a plateau differ by their rounding and range; the phase is known to half a sample then."""
    pulse, times = jl.RectangularPulse(length=6.0), 30.0 + np.arange(32) / 32.0
    edges, fall = np.arange(121.0) - 0.5, 1.0 - 3e-6 * np.arange(120)
    records = np.stack([np.diff(np.asarray(pulse.cumulative(edges - t, 0.0), float)) for t in times])
    for factor in (fall, fall[::-1]):
        record = (records * factor).astype(np.float32)
        echoes = find_echoes("peak", record, 0.0, None, 0.5, sampled_pulse(jl.Lidar(pulse=pulse)))
        assert echoes.row.tolist() == list(range(32))
        np.testing.assert_allclose(echoes.time, times, atol=0.5)
        assert abs(np.mean(echoes.time - times)) < 0.05


def test_the_background_of_short_records_is_that_beside_their_echoes():
    """Planted: the median of all samples, half of which belong to echoes."""
    random, background, noise = np.random.default_rng(0), 0.1, 0.01
    signal = gaussian_record((1.0, 14.0), (0.4, 38.0), samples=60)
    records = background + signal + noise * random.normal(size=(400, 60))
    median = _median_beside_echoes(records)
    assert median.shape == (400, 1)
    # Of some twenty samples beside the echoes.
    assert abs(median.mean() - background) < 0.5 * noise
    assert abs(np.median(records, axis=1).mean() - background) > 2 * noise
    empty = background + noise * random.normal(size=(400, 60))
    assert abs(_median_beside_echoes(empty).mean() - background) < 0.05 * noise
    np.testing.assert_array_equal(_median_beside_echoes(np.zeros((2, 3))), 0.0)


def test_peaks_that_rise_less_than_the_threshold_above_the_dip_are_one():
    resolved, merged = gaussian_record((1.0, 40.0), (0.8, 49.0)), gaussian_record((1.0, 40.0), (0.8, 46.5))
    assert find("peak", resolved, merged).row.tolist() == [0, 0, 1]
    # The dip of the first lies at half of the lower one.
    assert find("peak", resolved, threshold=0.5).row.tolist() == [0]


def test_constant_fraction_needs_an_edge_and_leading_edge_a_fall():
    overlapping = gaussian_record((1.0, 40.0), (0.8, 48.0))
    assert find("peak", overlapping).row.size == 2
    assert find("constant fraction", overlapping).row.size == 1
    assert find("constant fraction", overlapping, fraction=0.95).row.size == 2
    assert find("leading edge", overlapping).row.size == 1


def test_a_prominent_peak_next_to_small_ones_is_the_only_one():
    """Ripples on both flanks and on the top are dropped, whatever their order."""
    time = np.arange(120)
    record = gaussian_record((1.0, 60.0)) * (1.0 + 0.002 * (-1.0) ** time)
    echoes = find("peak", record, threshold=0.01)
    assert echoes.row.size == 1
    assert echoes.time[0] == pytest.approx(60.0, abs=0.5)


def test_a_saturated_echo_is_at_the_middle_of_its_plateau():
    echoes = find("peak", np.minimum(gaussian_record((5.0, 60.0)), 1.0))
    assert echoes.time[0] == pytest.approx(60.0)
    assert echoes.amplitude[0] == 1.0


def test_noise_is_not_detected_and_the_threshold_is_five_standard_deviations():
    noise = np.random.default_rng(0).normal(0.0, 0.01, (200, 120))
    signal = np.stack([gaussian_record((a, 60.0)) for a in np.repeat([0.01, 0.09], 100)])
    echoes = find("peak", *(signal + noise), noise=0.01)
    counts = np.bincount(echoes.row, minlength=200)
    assert counts[:100].mean() < 0.05
    assert counts[100:].mean() == pytest.approx(1.0, abs=0.02)
    # The planted wrong answer: at a fifth of the threshold, noise is detected.
    assert np.bincount(find("peak", *(signal + noise), threshold=0.01).row).mean() > 3


def test_extents_hold_all_light_of_an_echo_and_none_of_its_neighbour():
    record = gaussian_record((1.0, 30.0), (0.5, 80.0), (0.4, 90.0))
    echoes = find("peak", record)
    sums = [record[a:b].sum() for a, b in zip(echoes.start, echoes.end)]
    area = STD * np.sqrt(2.0 * np.pi)
    np.testing.assert_allclose(sums, [area, 0.5 * area, 0.4 * area], rtol=0.1)
    assert sums[0] == pytest.approx(area, rel=2e-3)
    assert sums[1] + sums[2] == pytest.approx(0.9 * area, rel=2e-3)
    assert echoes.end[1] == echoes.start[2]


@pytest.mark.parametrize("detector", DETECTORS)
def test_records_without_light_have_no_return(detector):
    assert find(detector, np.zeros(50), np.zeros(50)).row.size == 0


def test_echoes_at_the_ends_of_a_record_are_kept():
    echoes = find("peak", gaussian_record((1.0, 0.0)), gaussian_record((1.0, 119.0)))
    np.testing.assert_allclose(echoes.time, [0.0, 119.0], atol=0.5)


# -- returns of a survey -----------------------------------------------------------------------------------

SCENE = jl.Scene(
    plates=[jl.Plate(height=7.03, reflectance=0.4, coverage=0.5)],
    ground=jl.Ground(height=1.02, reflectance=0.3),
)
LIDAR = jl.Lidar(altitude=500.0, pulse=jl.GaussianPulse(fwhm=4.0))
LINE = {"start": (5e5, 5.2e6), "end": (5e5, 5.2e6 + 40.0), "speed": 40.0, "pulse_rate": 20.0}


@pytest.fixture(scope="module")
def survey():
    return jl.Survey.scan(LIDAR, jl.Oscillating(20.0, 3.0), **LINE, gps_time=3.2e8, flight_line=7)


@pytest.fixture(scope="module")
def waveforms(survey):
    return jl.simulate_many(survey, SCENE, key=jax.random.key(0), truth=True, max_orders=1)


@pytest.mark.parametrize("detector", DETECTORS)
def test_returns_lie_on_the_surfaces_of_the_scene(detector, survey, waveforms):
    returns = waveforms.returns(detector)
    shots = np.arange(len(survey))
    assert returns.shot.tolist() == np.repeat(shots, 2).tolist()
    assert returns.number.tolist() == [1, 2] * len(survey)
    assert set(returns.n_returns.tolist()) == {2}
    assert returns.material.tolist() == ["plate", "ground"] * len(survey)
    height = np.tile([7.03, 1.02], len(survey))
    # Closed form: where the axis meets each plane, from the sensor's position.
    distance = (survey.sensor[returns.shot, 2] - height) / -survey.direction[returns.shot, 2]
    position = survey.sensor[returns.shot] + distance[:, None] * survey.direction[returns.shot]
    np.testing.assert_allclose(returns.range, distance, atol=0.006)
    np.testing.assert_allclose(returns.position, position, atol=0.006)
    # Oblique beams spread the echo over the footprint of 0.15 m by less than a per cent.
    np.testing.assert_allclose(returns.width, np.hypot(4.0, 0.6), rtol=0.03)


def test_reflectance_and_shares_are_those_of_the_simulation(waveforms):
    returns = waveforms.returns()
    total = np.bincount(returns.shot, returns.reflectance)
    np.testing.assert_allclose(total, waveforms.reflectance[:, 0].sum(axis=1), rtol=5e-3)
    expected = np.stack(
        [waveforms.components[name][:, 0].sum(axis=1) for name in ("plate", "ground")], axis=1
    )
    np.testing.assert_allclose(returns.reflectance, expected.ravel(), rtol=0.02)
    np.testing.assert_allclose(returns.ground_share, np.tile([0.0, 1.0], len(waveforms)), atol=0.01)


def test_leaves_of_all_individuals_of_a_stand_are_vegetation(waveforms):
    """Surfaces of one name are numbered; planted: those of another name are not vegetation."""
    returns = waveforms.returns()

    def classes(name):
        material = np.where(returns.material == "plate", name, returns.material)
        return dataclasses.replace(returns, material=material).classification

    vegetation = classes("leaf")
    assert set(vegetation.tolist()) == {2, 5}
    np.testing.assert_array_equal(classes("mesh:leaf 12"), vegetation)
    assert set(classes("mesh:wall 12").tolist()) == {1, 2}


def test_returns_have_the_times_and_angles_of_the_survey(survey, waveforms):
    returns = waveforms.returns()
    np.testing.assert_array_equal(returns.gps_time, 3.2e8 + returns.shot / 20.0)
    np.testing.assert_array_equal(returns.scan_angle, survey.scan_angle[returns.shot])
    # To the right of a track northward is east.
    np.testing.assert_array_equal(
        np.sign(survey.scan_angle.round(6)), np.sign(survey.direction[:, 0].round(6))
    )
    assert set(returns.flight_line.tolist()) == {7}


def test_true_returns_are_the_surfaces_and_detected_ones_agree_with_them(waveforms):
    truth, detected = waveforms.true_returns(), waveforms.returns()
    assert truth.material.tolist() == detected.material.tolist()
    np.testing.assert_allclose(truth.position[:, 2], np.tile([7.03, 1.02], len(waveforms)), atol=1e-3)
    np.testing.assert_allclose(truth.reflectance, detected.reflectance, rtol=0.02)
    np.testing.assert_allclose(truth.width, 0.0, atol=2.0)
    assert len(waveforms.true_returns(min_reflectance=0.14)) < len(truth)


def test_a_waveform_has_the_returns_of_its_shot(survey, waveforms):
    returns, shot_returns = (
        waveforms.returns("constant fraction"),
        waveforms[3].returns(survey[3], "constant fraction"),
    )
    rows = returns.shot == 3
    np.testing.assert_allclose(shot_returns.position, returns.position[rows], atol=1e-3)
    np.testing.assert_allclose(shot_returns.reflectance, returns.reflectance[rows], rtol=1e-3)
    assert shot_returns.material.tolist() == returns.material[rows].tolist()
    with pytest.raises(
        ValueError, match="lidar is placed by its sensor, that of the waveform by its altitude"
    ):
        waveforms[3].returns(survey[3].at((0.0, 0.0, 500.0)))
    truth = waveforms[3].true_returns(survey[3])
    np.testing.assert_allclose(truth.reflectance, waveforms.true_returns().reflectance[rows], rtol=1e-4)


def test_a_noisy_record_is_detected_above_its_noise_and_background(waveforms):
    receiver = jl.Receiver(background=3e-16, electronic_noise=2e-17)
    record = np.asarray(jl.record(waveforms, receiver=receiver, key=jax.random.key(1)))
    returns = waveforms.returns(record=record)
    assert np.mean(returns.n_returns == 2) > 0.95
    main = returns.n_returns == 2
    np.testing.assert_allclose(
        returns.position[main, 2], np.tile([7.03, 1.02], len(waveforms))[: main.sum()], atol=0.5
    )
    stated = waveforms.returns(record=record, background=3e-16, noise=2e-17)
    np.testing.assert_allclose(np.median(stated.reflectance), np.median(returns.reflectance), rtol=0.05)


@pytest.mark.parametrize("lidar_has_receiver", [True, False])
def test_noise_that_the_receiver_cuts_at_zero_is_no_return(lidar_has_receiver):
    scene = jl.Scene(plates=[jl.Plate(60.0, 0.4, coverage=0.5)], ground=jl.Ground(reflectance=0.3))
    noise = 6e-15
    options = {"saturation": 3e-12, "bits": 12, "electronic_noise": noise}
    receiver, with_pedestal = jl.Receiver(**options), jl.Receiver(**options, background=10 * noise)

    def simulated(receiver):
        options = {"altitude": 500.0, "sampling_interval": 0.5, "pulse": jl.GaussianPulse(3.0)}
        lidar = jl.Lidar(**options, receiver=receiver if lidar_has_receiver else jl.Receiver())
        survey = jl.Survey.grid(lidar, low=(0, 0), high=(9, 9), spacing=1.0)
        return jl.simulate_many(survey, scene, key=jax.random.key(0), max_orders=1)

    waves = simulated(receiver)
    record = np.asarray(jl.record(waves, receiver=receiver, key=jax.random.key(1)))
    assert record.shape[2] > 800
    with pytest.warns(UserWarning, match="100 of 100 shots has noise that is cut at zero"):
        returns = waves.returns(record=record)
    np.testing.assert_array_equal(np.bincount(returns.shot), 2)
    # Differences of neighbours alone tell a half of this noise, above which samples of noise lie.
    differences = np.median(np.abs(np.diff(record[:, 0], axis=1)), axis=1) / np.sqrt(2.0) / 0.6745
    assert len(waves.returns(record=record, noise=differences)) > 300
    # With a pedestal nothing is cut, and nothing said.
    pedestal = simulated(with_pedestal)
    record = np.asarray(jl.record(pedestal, receiver=with_pedestal, key=jax.random.key(1)))
    np.testing.assert_array_equal(np.bincount(pedestal.returns(record=record).shot), 2)


def test_the_acquisition_has_the_noise_of_a_sample_without_signal():
    wavelength, background = np.array([532.0, 1064.0]), 2e-16
    receiver = jl.Receiver(saturation=4e-15, bits=6, electronic_noise=3e-17, background=background)
    survey = jl.Survey(jl.Lidar(wavelength=wavelength, receiver=receiver), [(0.0, 0.0)])
    waves = jl.simulate_many(survey, jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    photons = jl.record(
        np.zeros((2, 200_000)), wavelength, dataclasses.replace(receiver, bits=None), key=jax.random.key(1)
    )
    step = 4e-15 / 63
    expected = np.hypot(np.std(np.asarray(photons, float), axis=1), step / np.sqrt(12.0))
    np.testing.assert_allclose(waves.acquisition.noise, expected, rtol=0.01)


def test_the_strongest_returns_are_taken_where_there_are_too_many(waveforms):
    returns = waveforms.returns(max_returns=1)
    strongest = waveforms.returns()
    assert set(returns.n_returns.tolist()) == set(returns.number.tolist()) == {1}
    np.testing.assert_allclose(returns.amplitude, strongest.amplitude.reshape(-1, 2).max(axis=1))


def test_files_say_how_many_returns_they_have_no_room_for(tmp_path, monkeypatch, waveforms):
    monkeypatch.setattr("jaxlidar.survey.waveforms.MAX_LAS_RETURNS", 1)
    count, reports = len(waveforms), []
    with pytest.warns(FileWarning, match=f"{count} of {2 * count} returns are not written.* {count} shots"):
        written = waveforms.to_las(tmp_path / "one.las", progress=reports.append)
    assert set(written.n_returns.tolist()) == {1}
    # They are detected once.
    assert [report.done for report in reports] == [count]
    # Asked for, they are no surprise.
    assert len(waveforms.to_las(tmp_path / "asked.las", max_returns=1)) == count


@pytest.mark.slow
def test_decomposition_agrees_with_the_scene(survey, waveforms):
    """Of one shot."""
    reports = []
    returns = waveforms[2].returns(survey[2], "decomposition", progress=reports.append)
    np.testing.assert_allclose(returns.position[:, 2], [7.03, 1.02], atol=0.01)
    np.testing.assert_allclose(returns.width, np.hypot(4.0, 0.6), rtol=0.05)
    assert returns.material.tolist() == ["plate", "ground"]
    assert reports[-1].done == 1


def test_files_hold_the_acquisition(tmp_path, waveforms):
    waveforms.save(tmp_path / "a.nc")
    again = jl.open(tmp_path / "a.nc")
    for name, value in vars(waveforms.acquisition).items():
        np.testing.assert_array_equal(getattr(again.acquisition, name), value)
    np.testing.assert_array_equal(again.returns().position, waveforms.returns().position)
    dataclasses.replace(waveforms, acquisition=None).save(tmp_path / "old.nc")
    with pytest.raises(ValueError, match="no acquisition"):
        jl.open(tmp_path / "old.nc").returns()


def test_surveys_that_are_written_as_they_come_have_returns(tmp_path, survey, waveforms):
    on_disk = jl.simulate_many(
        survey, SCENE, key=jax.random.key(0), truth=True, max_orders=1, path=tmp_path / "a.zarr"
    )
    np.testing.assert_array_equal(on_disk.returns().position, waveforms.returns().position)


def test_the_pulse_of_an_acquisition_is_that_of_the_lidar(waveforms):
    pulse = waveforms.acquisition.pulse
    lags = np.arange(pulse.size) - pulse.size // 2
    assert pulse[::PULSE_OVERSAMPLING].sum() == pytest.approx(1.0, abs=1e-5)
    assert (lags * pulse).sum() / pulse.sum() == pytest.approx(0.0, abs=1e-4)
    skewed = sampled_pulse(jl.Lidar(pulse=jl.ExponentiallyModifiedGaussianPulse(fwhm=4.0, decay=3.0)))
    assert skewed[::PULSE_OVERSAMPLING].sum() == pytest.approx(1.0, abs=1e-3)


def test_positions_follow_from_the_two_way_time():
    origin, direction = np.array([[5e5, 4e6, 0.0]]), np.array([[0.6, 0.0, -0.8]])
    position = position_along_beam(origin, direction, np.array([-20.0]))
    np.testing.assert_allclose(position - origin, -20.0 * 0.5 * 0.299792458 * direction, rtol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"detector": "zero crossing"}, "detector = 'zero crossing' is none of"),
        ({"fraction": 1.0}, "fraction = 1 is outside"),
        ({"threshold": 0.0}, "threshold = 0 is outside"),
        ({"noise": -1.0}, "noise = -1 is outside"),
        ({"background": np.zeros(3)}, r"background has shape \(3,\)"),
        ({"record": np.zeros((2, 1, 5))}, "record has shape"),
        ({"wavelength": 532.0}, "wavelength = 532 nm is none of"),
        ({"max_returns": 0}, "max_returns = 0 is outside"),
        ({"detector": lambda *_: np.zeros((1, 2))}, r"detector returns shape \(1, 2\) for shot 0"),
        ({"detector": lambda *_: 3.0}, r"detector returns shape \(\) for shot 0"),
        ({"detector": lambda time, *_: time[-1:] + 5.0}, "time that detector returns for shot 0"),
        ({"detector": lambda time, *_: time[5] + np.array([0.0, 0.1])}, "a sample, .* ns, or more apart"),
        ({"detector": lambda time, *_: time[:1], "threshold": 1.0}, "threshold is given"),
    ],
)
def test_wrong_arguments_are_refused(waveforms, arguments, message):
    with pytest.raises(ValueError, match=message):
        waveforms.returns(**arguments)


def test_a_sample_that_is_not_known_does_not_take_its_shot_along(waveforms):
    record = np.array(waveforms.recorded)
    record[1, 0, 2] = np.nan
    with pytest.raises(ValueError, match="record = nan is outside the admissible range"):
        waveforms.returns(record=record)


def test_a_function_measures_the_record_as_peaks_do(waveforms):
    """Given the times that "peak" finds, in any order, a function yields the same returns."""
    peaks = waveforms.returns("peak")
    shots = iter(np.split(peaks.time, np.flatnonzero(np.diff(peaks.shot)) + 1))
    returns = waveforms.returns(lambda time, power, noise: next(shots)[::-1])
    for name, values in vars(peaks).items():
        if np.asarray(values).dtype.kind == "f":
            np.testing.assert_allclose(getattr(returns, name), values, rtol=1e-6, err_msg=name)
        else:
            np.testing.assert_array_equal(getattr(returns, name), values, err_msg=name)


def test_a_compiled_function_gives_times_and_nan_for_none(waveforms):
    @jax.jit
    def largest(time, power, noise):
        return jnp.stack([time[jnp.argmax(power)], jnp.nan])

    returns = waveforms.returns(largest)
    assert set(returns.n_returns.tolist()) == {1}
    highest = np.argmax(waveforms.recorded[:, 0], axis=-1)
    np.testing.assert_allclose(returns.time, np.asarray(waveforms.time)[highest], atol=1e-3)
    np.testing.assert_allclose(returns.amplitude, waveforms.recorded[:, 0].max(axis=-1), rtol=0.1)
    assert set(returns.material.tolist()) == {"plate"}


def test_a_function_gets_samples_without_background_and_their_noise(waveforms):
    seen = []

    def keep(time, power, noise):
        seen.append((time, power, noise))
        return np.zeros(0)

    record = np.asarray(waveforms.recorded) + 3e-15
    returns = waveforms.returns(keep, record=record, background=3e-15, noise=2e-17)
    assert (len(returns), returns.n_shots, len(seen)) == (0, len(waveforms), len(waveforms))
    time, power, noise = seen[1]
    np.testing.assert_array_equal(time, waveforms.time)
    np.testing.assert_allclose(power, waveforms.recorded[1, 0], atol=1e-6 * record.max())
    np.testing.assert_allclose(noise, np.full(time.size, 2e-17), rtol=1e-6)
    # Where no sample is above zero there is no return.
    far_from_light = [int(np.argmin(power))]
    assert len(waveforms.returns(lambda time, power, noise: time[far_from_light], record=0.0 * record)) == 0


@pytest.mark.parametrize("detector", [3, None, np.zeros(2)])
def test_a_detector_is_a_name_or_a_function(waveforms, detector):
    with pytest.raises(TypeError, match="detector"):
        waveforms.returns(detector)
    with pytest.raises(TypeError, match="what detector returns is None"):
        waveforms.returns(lambda *_: None)


def test_truth_is_needed_for_true_returns(waveforms):
    with pytest.raises(ValueError, match="simulate them with truth=True"):
        dataclasses.replace(waveforms, truth=None).true_returns()
