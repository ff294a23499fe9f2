"""Detection, noise and digitisation: the effect of every field, and the statistics of noise.

Poisson counts of mean m have the variance m; the variance of their sample variance over n draws is (m + 2
m^2) / n.
"""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar._constants import PLANCK_TIMES_LIGHT
from jaxlidar.sensors.receiver import Receiver, first_return_window, record
from tests.helpers import BY_PRECISION

WAVELENGTH = np.array([532.0, 1064.0])
PHOTON = PLANCK_TIMES_LIGHT / WAVELENGTH
Z_LIMIT = 4.5  # one false alarm in 150,000


def z_scores(counts, expected):
    """Compare mean and variance of draws (draws, ...) with those of Poisson variables, in standard errors."""
    n = counts.shape[0]
    mean = (counts.mean(0) - expected) / np.sqrt(expected / n)
    # The variance of a sample variance: (mu4 - s^4) / n, mu4 = m + 3 m^2.
    variance = (counts.var(0, ddof=1) - expected) / np.sqrt((expected + 2 * expected**2) / n)
    return np.abs(mean).max(), np.abs(variance).max()


def draws(energy, receiver, n, seed=0):
    keys = jax.random.split(jax.random.key(seed), n)
    return np.asarray(jax.vmap(lambda k: record(energy, WAVELENGTH, receiver, key=k))(keys), np.float64)


def test_a_photon_carries_h_c_over_wavelength():
    np.testing.assert_allclose(PLANCK_TIMES_LIGHT / 1064.0, 1.8669e-19, rtol=1e-4)


def test_the_default_changes_nothing_without_a_key(precision):
    energy = jnp.array([[0.0, 1e-17, 3e-12], [1e-30, 1e-18, 1.0]])
    np.testing.assert_array_equal(record(energy, WAVELENGTH, Receiver()), energy)


@pytest.mark.slow
@BY_PRECISION
def test_shot_noise_is_poisson_at_all_levels(precision):
    """Mean, variance and skewness from 1e3 to 1e7 photons, on both sides of the change of method at 1e4."""
    photons = np.geomspace(1e3, 1e7, 17)
    energy = jnp.asarray(np.tile(photons, (2, 500, 1)).transpose(2, 0, 1) * PHOTON[:, None])
    counts = draws(energy, Receiver(), 200) / PHOTON[:, None]
    counts = counts.transpose(0, 2, 3, 1).reshape(-1, photons.size)
    mean, variance = z_scores(counts, photons)
    assert mean < Z_LIMIT
    assert variance < Z_LIMIT
    # Skewness 1 / sqrt(m); its standard error over n draws is sqrt(6 / n).
    skewness = np.mean(((counts - photons) / np.sqrt(photons)) ** 3, axis=0)
    assert np.abs(skewness - 1 / np.sqrt(photons)).max() < Z_LIMIT * np.sqrt(15 / len(counts))
    # Planted: the variance that the sampler of JAX has at 6e5 photons, 2 % off.
    wrong = photons + np.sqrt(0.9785) * (counts - photons)
    assert z_scores(wrong, photons)[1] > Z_LIMIT


def test_missing_energies_stay_missing_and_negative_ones_are_refused():
    noisy = Receiver(background=1e-18, saturation=1e-12, bits=12, electronic_noise=1e-19)
    energy = np.array([[np.nan, 0.0, 1e-17, 1e-13]])
    for receiver in (Receiver(), noisy):
        for key in (None, jax.random.key(0)):
            recorded = np.asarray(record(energy, 1064.0, receiver, key=key))
            np.testing.assert_array_equal(np.isnan(recorded), [[True, False, False, False]])
    for value in (-1e-19, -1.0, np.inf):
        with pytest.raises(
            ValueError, match=rf"energy = {value:g} is outside the admissible range \[0, inf\)"
        ):
            record(np.array([[1e-17, value]]), 1064.0)
    # Inside a program they cannot be refused.
    traced = jax.jit(lambda e: record(e, 1064.0, noisy, key=jax.random.key(0)))
    recorded = np.asarray(traced(jnp.array([[-1e-17, jnp.inf, jnp.nan, 0.0, 1e-17]])))
    np.testing.assert_array_equal(np.isnan(recorded), [[True, True, True, False, False]])


def test_noise_of_a_simulation_below_zero_sends_no_photons():
    wave = types.SimpleNamespace(energy=jnp.array([[1e-16, -5e-19, 0.0]]), wavelength=jnp.array([1064.0]))
    np.testing.assert_array_equal(record(wave), wave.energy)
    assert np.all(np.asarray(record(wave, key=jax.random.key(0)))[0, 1:] == 0.0)

    def shifted(below):
        return types.SimpleNamespace(energy=wave.energy - below, wavelength=wave.wavelength)

    with pytest.raises(ValueError, match=r"energy = .* is too far below zero"):
        record(shifted(1e-17))
    assert np.all(np.isnan(jax.jit(lambda below: record(shifted(below)))(1e-17)))
    assert np.all(np.isfinite(jax.jit(lambda below: record(shifted(below)))(0.0)))


@BY_PRECISION
def test_shot_noise_is_poisson(precision):
    """Means below the sampler's change of method at 10, above it, and in the range of the normal limit."""
    photons = np.array([[0.3, 4.0, 40.0, 900.0, 3e6], [2.0, 12.0, 150.0, 5e4, 2e9]])
    counts = draws(jnp.asarray(photons * PHOTON[:, None]), Receiver(), 4000) / PHOTON[:, None]
    mean, variance = z_scores(counts, photons)
    assert mean < Z_LIMIT
    assert variance < Z_LIMIT
    small = photons < 1e4
    np.testing.assert_allclose(counts[:, small], np.round(counts[:, small]), atol=2e-3)


def test_planted_wrong_noise_is_rejected():
    photons = np.array([[4.0, 40.0], [12.0, 150.0]])
    energy = jnp.asarray(photons * PHOTON[:, None])
    counts = draws(energy, Receiver(), 4000) / PHOTON[:, None]
    assert z_scores(counts, 1.03 * photons)[0] > Z_LIMIT
    swapped = draws(energy, Receiver(), 4000) / PHOTON[::-1, None]  # the photon energies exchanged
    assert z_scores(swapped, photons * PHOTON[:, None] / PHOTON[::-1, None])[1] > Z_LIMIT


@BY_PRECISION
def test_background_is_recorded_and_is_noisy(precision):
    receiver = Receiver(background=20 * PHOTON[1])
    energy = jnp.zeros((2, 3))
    np.testing.assert_allclose(record(energy, WAVELENGTH, receiver), 20 * PHOTON[1], rtol=1e-6)
    counts = draws(energy, receiver, 3000) / PHOTON[:, None]
    assert max(z_scores(counts, np.broadcast_to([[10.0], [20.0]], (2, 3)))) < Z_LIMIT


def test_photon_noise_can_be_left_out_and_electronic_noise_is_normal(precision):
    quiet = Receiver(photon_noise=False)
    energy = jnp.full((2, 4), 1e-17)
    np.testing.assert_array_equal(record(energy, WAVELENGTH, quiet, key=jax.random.key(1)), energy)
    noisy = draws(energy, Receiver(photon_noise=False, electronic_noise=3e-18), 4000)
    z = (noisy - 1e-17) / 3e-18
    assert np.abs(z.mean(0)).max() * np.sqrt(4000) < Z_LIMIT
    assert np.abs(z.var(0) - 1).max() * np.sqrt(4000 / 2) < Z_LIMIT
    assert np.abs(np.mean(z**4) - 3) * np.sqrt(8 * 4000 / 96) < Z_LIMIT


@pytest.mark.parametrize("receiver", [Receiver(background=1e-13), Receiver(electronic_noise=1e-14)])
def test_the_receiver_of_a_survey_is_not_left_out(receiver):
    """Planted: the noise of a receiver with its defaults, hundreds of times smaller."""
    lidar = jl.Lidar(altitude=300.0, receiver=receiver)
    survey = jl.Survey(lidar, [(0.0, 0.0), (1.0, 0.0)])
    many = jl.simulate_many(survey, jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    with pytest.raises(
        ValueError, match=r"receiver = None, but the waveform was recorded by .*lidar.receiver"
    ):
        record(many, key=jax.random.key(1))
    record(many, receiver=lidar.receiver, key=jax.random.key(1))
    record(many, receiver=Receiver(), key=jax.random.key(1))


def test_energies_below_the_detection_threshold_are_recorded_as_zero(precision):
    energy = jnp.array([[1e-18, 2e-18, 3e-18]])
    recorded = record(energy, 1064.0, Receiver(detection_threshold=2e-18))
    np.testing.assert_allclose(recorded, [[0.0, 2e-18, 3e-18]], rtol=1e-6)
    # Without a threshold, samples that noise makes negative stay negative.
    noisy = Receiver(photon_noise=False, electronic_noise=1e-18)
    assert draws(jnp.zeros((2, 50)), noisy, 2).min() < 0


def test_saturation_clips(precision):
    recorded = record(jnp.array([[1.0, 5.0]]), 1064.0, Receiver(saturation=2.0))
    np.testing.assert_array_equal(recorded, [[1.0, 2.0]])


def test_quantisation_is_to_the_nearest_level_and_transparent_to_derivatives(precision):
    receiver = Receiver(saturation=7.0, bits=3)
    energy = jnp.array([[0.4, 0.6, 3.2, 6.9, 9.0]])
    np.testing.assert_array_equal(record(energy, 1064.0, receiver), [[0.0, 1.0, 3.0, 7.0, 7.0]])
    slope = jax.grad(lambda e: jnp.sum(record(e, 1064.0, receiver)))(energy)
    np.testing.assert_array_equal(slope, [[1.0, 1.0, 1.0, 1.0, 0.0]])
    noisy = Receiver(saturation=7.0, bits=3, photon_noise=False, electronic_noise=2.0)
    levels = draws(jnp.zeros((2, 50)), noisy, 2)
    assert set(np.unique(levels)) <= set(np.arange(8.0))


def test_derivative_through_a_realisation_is_finite():
    receiver = Receiver(background=1e-18, electronic_noise=1e-18)
    energy = jnp.array([[0.0, 1e-17, 1e-10]])
    slope = jax.grad(lambda e: jnp.sum(record(e, 1064.0, receiver, key=jax.random.key(0))))(energy)
    assert np.all(np.isfinite(slope))


def test_leading_axes_pass_through():
    energy = jnp.ones((3, 2, 5)) * 1e-16
    assert record(energy, WAVELENGTH, Receiver(bits=8, saturation=1e-15), key=jax.random.key(0)).shape == (
        3,
        2,
        5,
    )


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"detection_threshold": -1.0}, "detection_threshold = -1"),
        ({"saturation": 0.0}, r"saturation = 0 .*\(0, inf\)"),
        ({"bits": 0, "saturation": 1.0}, r"bits = 0 .*\[1, 24\]"),
        ({"bits": 25, "saturation": 1.0}, "bits = 25"),
        ({"bits": 8}, "bits = 8 needs a saturation"),
        ({"background": np.nan}, "background = nan"),
        ({"electronic_noise": -1e-20}, "electronic_noise = -1e-20"),
        ({"window": "last return"}, "window = 'last return' is none of 'fixed', 'first return'"),
    ],
)
def test_inadmissible_input_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        Receiver(**fields)


def fine_record():
    time = np.arange(-5.0, 35.0, 0.1) + 0.05
    echo = lambda centre: np.exp(-0.5 * ((time - centre) / 0.4) ** 2) * (np.abs(time - centre) < 2)  # noqa: E731
    return time, np.stack([echo(3.3) + 2 * echo(14.1), 0.5 * echo(14.1)])


@BY_PRECISION
@pytest.mark.parametrize("interval", [0.1, 1.0, 2.5, 0.73, 0.03, 100.0])
def test_first_return_window_conserves_energy_and_opens_at_the_first_return(interval, precision):
    time, energy = fine_record()
    new_time, new = map(np.asarray, first_return_window(time, jnp.asarray(energy), interval))
    assert new.shape == (2, new_time.size)
    np.testing.assert_allclose(new.sum(-1), energy.sum(-1), rtol=1e-5)
    opening = time[np.argmax(energy[0] > 0)] - 0.05
    np.testing.assert_allclose(new_time[0] - interval / 2, opening, atol=1e-5)
    np.testing.assert_allclose(np.diff(new_time), interval, rtol=1e-3)
    centroid = (energy * time).sum(-1) / energy.sum(-1)
    np.testing.assert_allclose((new * new_time).sum(-1) / new.sum(-1), centroid, atol=0.5 * interval + 1e-4)
    if interval == 1.0:
        first = round((opening + 5.0) / 0.1)
        by_hand = energy[:, first : first + 10].sum(-1)
        np.testing.assert_allclose(new[:, 0], by_hand, rtol=1e-4)


def test_first_return_window_has_a_threshold():
    time, energy = fine_record()
    new_time, new = first_return_window(time, jnp.asarray(energy), 1.0, threshold=1.5)
    opening = time[np.argmax(energy[0] > 1.5)] - 0.05
    np.testing.assert_allclose(new_time[0] - 0.5, opening, atol=1e-5)
    assert np.all(np.asarray(new.sum(-1)) < energy.sum(-1))
    np.testing.assert_allclose(first_return_window(time, jnp.zeros((1, 400)), 1.0)[0][0], -4.5, atol=1e-5)


def test_first_return_window_raises_a_peak_that_fixed_bins_split():
    """The paper's artefact, with an echo as long as a bin at positions from 0 to 1 bin after a fixed edge."""
    time = np.arange(0.0, 20.0, 0.1) + 0.05
    peaks = []
    for start in np.arange(5.0, 6.0, 0.1):
        energy = np.where((time > start) & (time < start + 1.0), 0.1, 0.0)[None]
        fixed = energy.reshape(1, 20, 10).sum(-1).max()
        opened = float(first_return_window(time, jnp.asarray(energy), 1.0)[1].max())
        np.testing.assert_allclose(opened, 1.0, rtol=1e-5)
        peaks.append(fixed)
    assert np.mean(peaks) < 0.8


def test_first_return_window_is_differentiable_under_jit():
    time, energy = fine_record()
    total = jax.jit(jax.grad(lambda e: jnp.sum(first_return_window(time, e, 0.7)[1])))
    first = int(np.argmax(energy[0] > 0))
    np.testing.assert_allclose(total(jnp.asarray(energy))[:, first:], 1.0, rtol=1e-4)


@pytest.mark.parametrize(
    ("time", "interval", "message"),
    [
        (np.arange(4.0), 0.0, "interval = 0"),
        (np.array([0.0, 1.0, 3.0, 4.0]), 1.0, "time has a step of 2"),
        (np.array([3.0, 2.0, 1.0, 0.0]), 1.0, "steps of time = -1"),
        (np.arange(3.0), 1.0, r"time has shape \(3,\)"),
    ],
)
def test_first_return_window_refuses(time, interval, message):
    with pytest.raises(ValueError, match=message):
        first_return_window(time, jnp.ones((1, 4)), interval)


# -- noise models of one's own -----------------------------------------------------------------------------


def excess_noise(key, energy, wavelength):
    """Normal noise of four times the variance of photons."""
    photon = PLANCK_TIMES_LIGHT / wavelength
    return energy + 2.0 * jnp.sqrt(photon * energy) * jax.random.normal(key, energy.shape)


def test_a_noise_model_replaces_the_noise_of_the_receiver():
    """Its mean and variance are those of the function; z-test over 20,000 draws, against a planted fault."""
    n, photons = 20_000, 1e3
    energy = np.broadcast_to(photons * PHOTON[:, None], (2, n))
    receiver = Receiver(background=photons * float(PHOTON[0]), electronic_noise=float(PHOTON[0]))
    samples = record(energy, WAVELENGTH, receiver, key=jax.random.key(3), noise_model=excess_noise)
    counts = np.asarray(samples, float) / PHOTON[:, None]
    expected = photons * (1.0 + PHOTON[0] / PHOTON)
    for variance, is_right in ((4.0 * expected, True), (expected, False)):
        z_mean = (counts.mean(1) - expected) / np.sqrt(4.0 * expected / n)
        z_variance = (counts.var(1, ddof=1) - variance) / (variance * np.sqrt(2.0 / n))
        assert np.abs(z_mean).max() < Z_LIMIT
        assert bool(np.abs(z_variance).max() < Z_LIMIT) is is_right


def test_saturation_threshold_and_quantisation_follow_a_noise_model_in_numpy():
    def offset(key, energy, wavelength):
        assert wavelength.shape == (1, 1)
        return np.asarray(energy) + np.array([-2.0, 0.3, 5.0])

    receiver = Receiver(saturation=7.0, bits=3, detection_threshold=1.0)
    samples = record(np.array([[2.0, 2.0, 4.0]]), 532.0, receiver, key=jax.random.key(0), noise_model=offset)
    np.testing.assert_allclose(samples, [[0.0, 2.0, 7.0]])


def test_a_noise_model_is_differentiable_and_compiled():
    @jax.jit
    def total(energy):
        key = jax.random.key(0)
        return jnp.sum(record(energy, 532.0, key=key, noise_model=lambda key, e, wavelength: 3.0 * e))

    np.testing.assert_allclose(jax.grad(total)(jnp.ones((1, 4))), 3.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"noise_model": "normal"}, TypeError, "noise_model"),
        ({"noise_model": excess_noise, "key": None}, ValueError, "admissible is one with a key"),
        ({"noise_model": lambda key, e, w: e[0]}, ValueError, r"shape \(3,\); admissible is \(1, 3\)"),
        ({"noise_model": lambda key, e, w: None}, TypeError, "what noise_model returns is None"),
        ({"noise_model": excess_noise, "key": 3}, TypeError, "key"),
    ],
)
def test_other_noise_models_are_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        record(np.ones((1, 3)), 532.0, **{"key": jax.random.key(0), **arguments})
