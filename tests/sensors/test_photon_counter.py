"""The photon counter: events against closed forms of Poisson processes and their dead time.

With the rate lambda(t) of a pixel and its integral Lambda(t):

- one event at most: it has the density lambda exp(-Lambda), and its mean is early (first-photon bias);
- a constant rate n and the dead time tau: the mean rate of events is n / (1 + n tau);
- recorded and lost photons together are a Poisson process again.

Means are tested by z-scores, distributions by Kolmogorov-Smirnov and chi-squared tests. The keys are fixed.
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

import jaxlidar as jl
from jaxlidar._constants import PLANCK_TIMES_LIGHT
from jaxlidar.sensors import photon_counter

Z_LIMIT = 4.5  # one false alarm in 150,000
P_LIMIT = 1e-5
SIGMA = 3.0  # ns, of the Gaussian echo
GREEN = 532.0
SHOTS = 400


@functools.cache
def some_wave(wavelength):
    return jl.simulate(jl.Lidar(wavelength=wavelength), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))


def wave_of(photons, time, wavelength=(GREEN,)):
    """Make a `Waveform` with the given expected number of photons per sample, (wavelengths, bins)."""
    energy = np.atleast_2d(photons) * PLANCK_TIMES_LIGHT / np.asarray(wavelength)[:, None]
    height = -0.5 * jl.SPEED_OF_LIGHT * np.asarray(time)
    # Not by the constructor: the fields that photon counting does not use have another number of samples.
    return eqx.tree_at(
        lambda wave: (wave.time, wave.height, wave.energy),
        some_wave(wavelength),
        tuple(jnp.asarray(values, float) for values in (time, height, energy)),
    )


def echo(photons):
    """Make a finely sampled Gaussian echo at time zero."""
    edges = np.linspace(-20.0, 20.0, 1601)
    return wave_of(photons * np.diff(stats.norm.cdf(edges, scale=SIGMA)), 0.5 * (edges[1:] + edges[:-1]))


def dark(bins=10):
    return wave_of(np.zeros(bins), np.arange(float(bins)))


def events_of(wave, pulses, seed=0, **fields):
    return jl.PhotonCounter(**fields).count(wave, key=jax.random.key(seed), pulses=pulses)


def z_of_mean(values, expected):
    return abs(np.mean(values) - expected) / (np.std(values, ddof=1) / np.sqrt(len(values)))


@pytest.fixture(scope="module")
def survey():
    """Simulate two wavelengths over flat ground at 2 m, from nadir to 40 degrees."""
    lidar = jl.Lidar(wavelength=(GREEN, 1064.0), energy=1e-9)
    shots = jl.Survey(lidar, np.zeros((SHOTS, 2)), np.linspace(0.0, 40.0, SHOTS))
    scene = jl.Scene(ground=jl.Ground(height=2.0, reflectance=(0.2, 0.4)))
    return jl.simulate_many(shots, scene, key=jax.random.key(0))


def counts_of(events):
    return np.bincount(events.pulse, minlength=events.pulses)


def dispersion(counts):
    """Compute the two-sided p-value of the index of dispersion of Poisson counts."""
    chi2 = (len(counts) - 1) * counts.var(ddof=1) / counts.mean()
    return 2 * min(stats.chi2.cdf(chi2, len(counts) - 1), stats.chi2.sf(chi2, len(counts) - 1))


def first_photon_mean(photons):
    """Integrate the mean of the density lambda(t) exp(-Lambda(t)), in ns, given that there is a photon."""

    def density(x):
        return x * photons * stats.norm.pdf(x) * np.exp(-photons * stats.norm.cdf(x))

    return SIGMA * integrate.quad(density, -10, 10)[0] / -np.expm1(-photons)


# -- dead time ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("photons", [2.0, 8.0, 30.0])
def test_first_photon_bias_is_that_of_the_closed_form(photons):
    """One pixel that sees one photon of a pulse: the echo reads early by up to twice its width."""
    bias = first_photon_mean(photons)
    events = events_of(echo(photons), 400_000, pixels=1, dead_time=1e4)
    assert abs(events.time.mean() / bias - 1) < 0.01
    assert z_of_mean(events.time, bias) < Z_LIMIT
    np.testing.assert_allclose(len(events) / 400_000, -np.expm1(-photons), atol=Z_LIMIT * 0.5 / np.sqrt(4e5))
    first = events.time[:20_000]
    cdf = lambda t: np.expm1(-photons * stats.norm.cdf(t, scale=SIGMA)) / np.expm1(-photons)  # noqa: E731
    assert stats.kstest(first, cdf).pvalue > P_LIMIT


def test_an_echo_without_dead_time_is_rejected_as_first_photons():
    events = events_of(echo(8.0), 10_000, pixels=1, dead_time=0.0)
    assert z_of_mean(events.time, first_photon_mean(8.0)) > Z_LIMIT
    assert z_of_mean(events.time, 0.0) < Z_LIMIT
    assert stats.kstest(events.time, stats.norm(scale=SIGMA).cdf).pvalue > P_LIMIT


def test_the_first_of_many_pixels_has_the_same_bias_and_each_pixel_its_own():
    photons, pulses, pixels = 8.0, 20_000, 16
    events = events_of(echo(photons), pulses, pixels=pixels, dead_time=1e4)
    _, first = np.unique(events.pulse, return_index=True)
    assert z_of_mean(events.time[first], first_photon_mean(photons)) < Z_LIMIT
    assert z_of_mean(events.time, first_photon_mean(photons / pixels)) < Z_LIMIT
    # Every pixel records one photon at most: counts are binomial.
    probability = -np.expm1(-photons / pixels)
    assert z_of_mean(counts_of(events), pixels * probability) < Z_LIMIT
    assert stats.chisquare(np.bincount(events.pixel, minlength=pixels)).pvalue > P_LIMIT
    np.testing.assert_allclose(counts_of(events).var(), pixels * probability * (1 - probability), rtol=0.05)
    assert np.unique(events.pulse * pixels + events.pixel).size == len(events)


@pytest.mark.parametrize("dead_time", [3.2, 40.0])
def test_dead_time_reduces_a_constant_rate(dead_time):
    """n / (1 + n tau) per pixel, and the next term of renewal theory, as all pixels are live at the start."""
    pixels, rate, window, pulses = 4, 2e8, 20_000.0, 200
    n = 1e-9 * rate / pixels
    interval = dead_time + 1 / n
    expected = (window - 1 / n) / interval + 0.5 * (1 / (n * interval) ** 2 + 1)
    events = events_of(
        dark(), pulses, pixels=pixels, dead_time=dead_time, background_rate=rate, window=(0.0, window)
    )
    np.testing.assert_allclose(expected, window * n / (1 + n * dead_time), rtol=1e-2)
    assert z_of_mean(counts_of(events), pixels * expected) < Z_LIMIT
    assert z_of_mean(counts_of(events), pixels * window * n) > Z_LIMIT
    order = np.lexsort((events.time, events.pixel, events.pulse))
    channel = (events.pulse * pixels + events.pixel)[order]
    gaps = np.diff(events.time[order])[np.diff(channel) == 0]
    assert gaps.min() >= dead_time - 1e-6
    assert stats.kstest(gaps[:20_000] - dead_time, stats.expon(scale=1 / n).cdf).pvalue > P_LIMIT


def test_lost_and_recorded_photons_add_up_to_the_arrivals(survey):
    """Over many shots, the sum is a Poisson count; the recorded photons are not."""
    photons = 20.0
    scale = photons * PLANCK_TIMES_LIGHT / survey.wavelength / survey.energy.sum(axis=2)
    bright = dataclasses.replace(survey, energy=survey.energy * scale[:, :, None])
    window = (float(survey.time[0]) - 50.0, float(survey.time[-1]) + 50.0)
    events = events_of(bright, 1, pixels=2, dead_time=5.0, background_rate=1e8, window=window)
    for i, wavelength in enumerate(survey.wavelength):
        recorded = np.bincount(events.shot[events.wavelength == wavelength], minlength=SHOTS)
        arrived = recorded + events.lost[:, i]
        assert z_of_mean(arrived, photons + 0.1 * (window[1] - window[0])) < Z_LIMIT
        assert dispersion(arrived) > P_LIMIT
        assert dispersion(recorded) < P_LIMIT


# -- background, jitter, probability ------------------------------------------------------------------------


def test_background_is_poisson():
    fields = {"dead_time": 0.0, "background_rate": 5e6, "window": (-300.0, 700.0)}
    events = events_of(dark(), 20_000, **fields)
    counts = counts_of(events)
    assert not events.signal.any()
    assert z_of_mean(counts, 5.0) < Z_LIMIT
    assert dispersion(counts) > P_LIMIT
    assert stats.kstest(events.time[:20_000], stats.uniform(-300.0, 1000.0).cdf).pvalue > P_LIMIT
    # Within a long record, gaps are exponential.
    long = events_of(dark(), 1, **{**fields, "window": (0.0, 4e6)})
    assert stats.kstest(np.diff(long.time), stats.expon(scale=200.0).cdf).pvalue > P_LIMIT
    blind = events_of(dark(), 20_000, **{**fields, "pixels": 1, "dead_time": 50.0})
    assert dispersion(counts_of(blind)) < P_LIMIT


def test_jitter_adds_its_variance_and_loses_no_event():
    fields = {"pixels": 1, "dead_time": 1e4}
    plain, jittered = (events_of(echo(3.0), 50_000, jitter=j, **fields) for j in (0.0, 2.0))
    assert len(plain) == len(jittered)
    error = jittered.time - plain.time
    assert z_of_mean(error, 0.0) < Z_LIMIT
    assert abs(error.var() / 4.0 - 1) < Z_LIMIT * np.sqrt(2 / len(error))
    assert abs(jittered.time.var() - plain.time.var() - 4.0) < 0.2
    assert stats.kstest(error[:20_000], stats.norm(scale=2.0).cdf).pvalue > P_LIMIT


def test_detection_probability_scales_the_mean_of_each_wavelength(precision):
    time = np.arange(6.0)
    photons = np.array([[0.0, 4.0, 0.0, 1.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0, 0.0, 2.0]])
    wave = wave_of(photons, time, (GREEN, 1064.0))
    events = events_of(wave, 20_000, dead_time=0.0, detection_probability=(0.2, 0.6))
    assert events.signal.all()
    for wavelength, row, probability in zip((GREEN, 1064.0), photons, (0.2, 0.6)):
        of_wavelength = events.wavelength == wavelength
        sample = np.floor(events.time[of_wavelength] + 0.5).astype(int)
        counts = np.bincount(sample, minlength=6)
        expected = 20_000 * probability * row
        assert np.all(np.abs(counts - expected) <= Z_LIMIT * np.sqrt(expected))
    # Uniform within the samples.
    assert stats.kstest((events.time[:20_000] + 0.5) % 1.0, "uniform").pvalue > P_LIMIT
    np.testing.assert_allclose(events.height, -0.5 * jl.SPEED_OF_LIGHT * events.time, rtol=1e-6)


def test_samples_that_noise_put_below_zero_send_nothing():
    events = events_of(wave_of([0.0, 4.0, -0.03, 0.0], np.arange(4.0)), 5000, dead_time=0.0)
    assert np.all(np.abs(events.time - 1.0) <= 0.5)
    assert z_of_mean(counts_of(events), 4.0) < Z_LIMIT


# -- structure ---------------------------------------------------------------------------------------------


def test_no_light_and_too_much(precision, tmp_path):
    none = events_of(dark(), 10)
    assert len(none) == 0
    assert str(none).startswith("0 photon events of 1 shot with 10 pulses")
    none.save(tmp_path / "none.nc")
    assert len(jl.open(tmp_path / "none.nc")) == 0
    # A flood of light: each pixel has an event in each dead time, and all other photons are lost.
    flood = wave_of([0.0, 1e12, 1e12, 1e12, 1e12, 0.0, 0.0], np.arange(7.0))
    events = events_of(flood, 3, pixels=2, dead_time=3.2)
    assert len(events) == 2 * 2 * 3
    assert np.allclose(np.sort(events.time)[[0, -1]], [0.5, 3.7], atol=1e-6)
    np.testing.assert_allclose(events.lost.sum(), 3 * 4e12, rtol=1e-5)
    with pytest.raises(ValueError, match=r"give 4e\+12 events; admissible are up to 1e\+08"):
        events_of(flood, 1, dead_time=0.0)
    with pytest.raises(ValueError, match=r"give 4e\+15 photons; admissible are up to 1e\+15"):
        events_of(flood, 1000)


def test_the_waveforms_of_a_survey(survey, monkeypatch, tmp_path):
    events = events_of(survey, 50, dead_time=0.0)
    mean = 50 * survey.energy.sum(axis=2, dtype=float) / (PLANCK_TIMES_LIGHT / survey.wavelength)
    for i, wavelength in enumerate(survey.wavelength):
        counts = np.bincount(events.shot[events.wavelength == wavelength], minlength=SHOTS)
        assert np.all(np.abs(counts - mean[:, i]) < 5 * np.sqrt(mean[:, i]))
        assert stats.chisquare(counts, counts.sum() * mean[:, i] / mean[:, i].sum()).pvalue > P_LIMIT
    means = np.bincount(events.shot, events.height) / np.bincount(events.shot)
    np.testing.assert_allclose(means, 2.0, atol=0.1)
    alone = events_of(survey[3], 50, dead_time=0.0)
    np.testing.assert_allclose(alone.window[0], events.window[3], rtol=1e-4)
    assert np.all(np.diff(events.shot) >= 0)
    order = np.lexsort((events.time, events.pulse, events.shot))
    assert np.array_equal(order, np.arange(len(events)))
    same_key, another_key = (events_of(survey, 50, seed=seed, dead_time=0.0) for seed in (0, 1))
    assert np.array_equal(same_key.time, events.time)
    assert not np.array_equal(another_key.time[:9], events.time[:9])
    # Blocks of a few shots draw other random numbers from the same distribution.
    monkeypatch.setattr(photon_counter, "_BLOCK_SIZE", 16 * 50 * 2 * 150)
    in_blocks = events_of(survey, 50, dead_time=0.0)
    assert set(in_blocks.shot) == set(range(SHOTS))
    assert abs(len(in_blocks) - mean.sum()) < Z_LIMIT * np.sqrt(mean.sum())
    events.save(tmp_path / "events.nc")
    back = jl.open(tmp_path / "events.nc")
    for name in (f.name for f in dataclasses.fields(events)):
        saved, read = (np.asarray(getattr(record, name)) for record in (events, back))
        assert (saved.dtype, saved.tobytes()) == (read.dtype, read.tobytes())


def test_a_waveform_is_recorded_as_its_energies_are(survey):
    wave, receiver = survey[0], jl.Receiver(background=1e-17, photon_noise=False, electronic_noise=1e-18)
    for key in (None, jax.random.key(3)):
        sent = jl.record(wave.energy, wave.wavelength, receiver, key=key)
        np.testing.assert_array_equal(jl.record(wave, receiver=receiver, key=key), sent)
    np.testing.assert_array_equal(jl.record(survey), survey.energy)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"pixels": 0}, r"pixels = 0 .*\[1, inf\) of integers"),
        ({"dead_time": -1.0}, r"dead_time = -1 .*\[0, inf\)"),
        ({"detection_probability": 1.5}, r"detection_probability = 1.5 .*\[0, 1\]"),
        ({"background_rate": (1.0, -1.0)}, r"background_rate = -1 .*\[0, inf\)"),
        ({"jitter": np.nan}, "jitter = nan"),
        ({"window": (3.0, 3.0)}, r"window = \(3.0, 3.0\) does not increase"),
        ({"window": 3.0}, r"window has shape \(\)"),
    ],
)
def test_inadmissible_counters_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        jl.PhotonCounter(**fields)


def test_inadmissible_records_are_refused():
    wave, key, count = dark(), jax.random.key(0), jl.PhotonCounter().count
    with pytest.raises(ValueError, match="pulses = 0"):
        count(wave, key=key, pulses=0)
    with pytest.raises(ValueError, match="wavelength is given, but wave is a waveform"):
        jl.record(wave, GREEN, key=key)
    with pytest.raises(TypeError, match="wavelength is None; admissible are real numbers"):
        jl.record(np.ones((1, 2)))
    with pytest.raises(TypeError, match="wave is an array of float64; admissible is a Waveform"):
        count(np.ones((1, 2)), key=key)
    with pytest.raises(
        ValueError, match=r"energy = -.* is too far below zero; admissible are samples that all"
    ):
        count(wave_of(-np.ones(10), np.arange(10.0)), key=key)
    with pytest.raises(ValueError, match="energy = nan"):
        count(wave_of(np.full(10, np.nan), np.arange(10.0)), key=key)
    with pytest.raises(ValueError, match=r"detection_probability has shape \(2,\)"):
        events_of(wave, 1, detection_probability=(0.1, 0.2))
    with pytest.raises(ValueError, match="wave has one sample"):
        count(dark(1), key=key)
    with pytest.raises(TypeError, match="outside of JAX transformations"):
        jax.jit(lambda w: count(w, key=key).time)(wave)
