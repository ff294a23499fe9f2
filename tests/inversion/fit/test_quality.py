"""Verdicts on fits and records: every check fails for its own defect only; robust standard errors."""

import re
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion import Verdict, judge_fit, judge_record
from inversion.fit.data import ObservedWaveform
from inversion.fit.model import Evaluation
from inversion.fit.recorder_model import RecorderModel
from inversion.fit.solver import LeastSquaresFit, SolverSettings, multistart
from inversion.fit.uncertainty import (
    SampleIndex,
    _autoregressive_products,
    _sample_order,
    _whitened_products,
    estimate_covariance,
    residual_covariance,
)
from inversion.fit.unknowns import BoundUnknown, Setter
from tests.helpers import ask, run_fit

BIN = np.arange(600)
PULSE = np.exp(-0.5 * (np.arange(-40.0, 41.0) / 6.0) ** 2)


def record(random):
    """Return an echo of 100 with noise of 1."""
    return 100.0 * np.exp(-0.5 * ((BIN - 380.0) / 6.5) ** 2) + random.normal(size=BIN.size)


def verdict_on(signal, **flags):
    return judge_record(signal, noise=1.0, pulse=PULSE, **flags)


def test_sound_records_are_good():
    random = np.random.default_rng(0)
    verdicts = [verdict_on(record(random), degrade=0, stale_return=0) for _ in range(50)]
    assert verdicts == [Verdict("good", ())] * 50


@pytest.mark.parametrize(
    ("quality", "reason", "change"),
    [
        ("doubtful", "clipped", lambda y: np.minimum(y, 40.0)),
        ("bad", "cut off", lambda y: y[:386]),
        ("doubtful", "cut off", lambda y: y[:397]),
        ("bad", "cut off: the signal reaches the first", lambda y: y[377:]),
        ("bad", "weak", lambda y: np.random.default_rng(1).normal(size=y.size)),
        ("doubtful", "weak", lambda y: 0.08 * y),
        ("doubtful", "dead samples", lambda y: np.where(BIN == 372, 0.0, y)),
        ("doubtful", "dead samples", lambda y: np.where(BIN > 383, 2.0 * y, y)),
        ("doubtful", "uneven noise", lambda y: np.where(BIN > 300, 2.0 * y, y)),
    ],
)
def test_damaged_records_are_not_good(quality, reason, change):
    verdict = verdict_on(change(record(np.random.default_rng(2))))
    assert verdict.quality == quality
    assert any(r.startswith(reason) for r in verdict.reasons)


def test_records_without_noise_are_not_judged_by_it():
    echo = 100.0 * np.exp(-0.5 * ((BIN - 380.0) / 6.5) ** 2)
    assert judge_record(echo, noise=0.0, pulse=PULSE) == Verdict("good", ())
    for change, reason in (
        (0.0 * echo, "no signal"),
        (echo[:386], "cut off"),
        (np.minimum(echo, 9), "clipped"),
    ):
        assert judge_record(change, noise=0.0, pulse=PULSE).reasons[0].startswith(reason)


def test_flags_count():
    signal = record(np.random.default_rng(3))
    assert verdict_on(signal, degrade=70).quality == "doubtful"
    assert verdict_on(signal, stale_return=1).quality == "bad"


def test_verdicts_join():
    good, doubtful, bad = (Verdict(q, (q,)) for q in ("good", "doubtful", "bad"))
    assert doubtful & bad == bad & doubtful == Verdict("bad", ("bad", "doubtful"))
    assert good & doubtful == Verdict("doubtful", ("doubtful", "good"))


SOUND = types.SimpleNamespace(
    values={"ground": np.array(0.1), "layers": np.zeros(3)},
    stderr={"ground": np.array(0.1), "layers": np.ones(3)},
    bounds={"ground": np.array([-1.0, 1.0]), "layers": np.stack([np.full(3, -9.0), np.full(3, 9.0)])},
    prior_share={"ground": np.array(0.01), "layers": np.full(3, 0.2)},
    at_bound={"ground": np.array(False), "layers": np.zeros(3, bool)},
    reduced_chi2=np.array(1.2),
    independent_samples=np.array(40.0),
    second_minimum=np.array(np.inf),
    strength={},
    converged=True,
)


@pytest.mark.parametrize(
    ("quality", "reason", "changes"),
    [
        ("good", None, {}),
        ("bad", "not converged", {"converged": False}),
        ("doubtful", "misfit", {"reduced_chi2": np.array(3.5)}),
        ("bad", "misfit", {"reduced_chi2": np.array(11.0)}),
        ("bad", "misfit", {"reduced_chi2": np.array(np.nan)}),
        # The same chi-squared is within the scatter of few samples.
        ("good", None, {"reduced_chi2": np.array(3.5), "independent_samples": np.array(5.0)}),
        ("doubtful", "second minimum", {"second_minimum": np.array(3.0)}),
        ("doubtful", "undetermined: layers", {"stderr": {"ground": 0.1, "layers": np.array([1, np.inf, 1])}}),
        # A uniform distribution over the bounds has a standard deviation of 5.2.
        ("doubtful", "undetermined: layers", {"stderr": {"ground": 0.1, "layers": np.array([1, 5.3, 1])}}),
        ("good", None, {"stderr": {"ground": 0.1, "layers": np.array([1, 5.1, 1])}}),
        (
            "doubtful",
            "at a bound: layers",
            {"at_bound": {"ground": False, "layers": np.array([True, False, False])}},
        ),
        ("doubtful", "from the prior: ground", {"prior_share": {"ground": 0.6, "layers": np.zeros(3)}}),
    ],
)
def test_checks_of_a_fit(quality, reason, changes):
    fit = types.SimpleNamespace(**{**vars(SOUND), **changes})
    verdict = judge_fit(fit)
    assert verdict.quality == quality
    assert [r for r in verdict.reasons if reason is None or not r.startswith(reason)] == []
    concerns_layers_only = reason is not None and "layers" in reason
    ground_is_good = judge_fit(fit, about=["ground"]).quality == "good"
    assert ground_is_good == (concerns_layers_only or quality == "good")
    with pytest.raises(ValueError, match="about has 'canopy'; admissible are 'ground', 'layers'"):
        judge_fit(fit, about=["canopy"])


def test_misfit_is_among_the_reasons_of_a_verdict():
    """Misfit beyond its scatter, though below its limits, is named beside a failure that it may cause."""
    at_bound = {"at_bound": {"ground": True, "layers": np.zeros(3, bool)}}
    for chi2, reasons in (
        (1.8, ("at a bound: ground",)),
        (2.0, ("at a bound: ground", "misfit: reduced chi-squared 2")),
        (11.0, ("misfit: reduced chi-squared 11", "at a bound: ground")),
    ):
        fit = types.SimpleNamespace(**{**vars(SOUND), **at_bound, "reduced_chi2": np.array(chi2)})
        assert judge_fit(fit).reasons == reasons
    assert judge_fit(types.SimpleNamespace(**{**vars(SOUND), "reduced_chi2": np.array(2.0)})).reasons == ()


def test_prior_fraction_is_that_of_the_information():
    jacobian = np.array([[2.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    precision, width = np.diag([0.0, 3.0, 5.0]), np.full(3, 10.0)
    fraction = estimate_covariance(jacobian, precision, width, np.ones(2), None).prior_share
    np.testing.assert_allclose(fraction, [0.0, 0.75, 1.0])


def test_the_filter_gives_the_products_of_the_dense_covariance():
    """Innovations and sums of the Kalman filter, for two wavelengths with gaps."""
    random = np.random.default_rng(6)
    index = SampleIndex(
        np.repeat([0, 1], [25, 15]), np.append(np.cumsum(random.integers(1, 4, 25)), np.arange(15))
    )
    signal, columns = random.uniform(size=(40, 1)), random.normal(size=(40, 3))
    phi, k2 = np.array([0.8, 0.5]), np.array([4.0, 9.0])
    order = _sample_order(index)
    product, log_determinant = _whitened_products(columns, signal[:, 0], k2, phi, order)
    correlated = _autoregressive_products(signal * columns, phi, order)
    for i in range(2):
        distance = np.abs(np.subtract.outer(index.bin, index.bin))
        same_wavelength = np.equal.outer(index.wavelength, index.wavelength)
        correlation = same_wavelength * phi[i] ** distance * (signal * signal.T)
        covariance = np.eye(40) + k2[i] * correlation
        expected = columns.T @ np.linalg.solve(covariance, columns)
        np.testing.assert_allclose(product[i], expected, atol=1e-12)
        np.testing.assert_allclose(log_determinant[i], np.linalg.slogdet(covariance)[1])
        np.testing.assert_allclose(correlated[..., i], columns.T @ correlation @ columns, atol=1e-12)


def autoregressive_noise(random, phi, count=100):
    """Draw first-order autoregressive noise of unit variance."""
    noise = random.normal(size=count)
    for i in range(1, count):
        noise[i] = phi * noise[i - 1] + np.sqrt(1.0 - phi**2) * noise[i]
    return noise


@pytest.mark.parametrize("phi", [0.0, 0.8])
def test_robust_errors_are_those_of_many_draws(phi):
    """Over 80 draws, robust errors of a line and a wave are their spread or up to 2.5 times it.

    Plain ones are large enough for phi = 0 only.
    """
    random, time = np.random.default_rng(4), np.linspace(-1.0, 1.0, 100)
    jacobian = np.stack([np.ones(100), time, np.cos(9.0 * time)], axis=1)
    inverse = np.linalg.inv(jacobian.T @ jacobian)
    index = SampleIndex(np.zeros(100, int), np.arange(100))
    estimates, stated_variances = [], []
    for _ in range(80):
        noise = autoregressive_noise(random, phi)
        values = inverse @ (jacobian.T @ noise)
        residual = noise - jacobian @ values
        covariance = residual_covariance(residual, jacobian, np.zeros((3, 3)), 3.0, np.ones(100), index)
        estimates.append(values)
        stated_variances.append(np.diag(inverse @ covariance.meat @ inverse))
    spread = np.std(estimates, axis=0)
    ratio = np.sqrt(np.median(stated_variances, axis=0)) / spread
    assert np.all((ratio > 0.85) & (ratio < 2.5))
    assert np.all(np.sqrt(np.diag(inverse)) > 0.85 * spread) == (phi == 0.0)


def test_samples_far_apart_or_of_other_wavelengths_are_independent():
    constant, bins, zeros = np.ones((100, 1)), np.arange(100), np.zeros(100, int)
    residual = autoregressive_noise(np.random.default_rng(5), 0.9, 100)

    def covariance(wavelength, sample_bin):
        index = SampleIndex(wavelength, sample_bin)
        return residual_covariance(residual, constant, np.zeros((1, 1)), 1.0, np.ones(100), index)

    dense = covariance(zeros, bins)
    assert dense.independent_samples < 40
    for wavelength, sample_bin in ((bins, bins), (zeros, 1000 * bins)):
        independent = covariance(wavelength, sample_bin)
        assert independent.independent_samples == pytest.approx(100, rel=0.01)
        assert independent.meat < 0.3 * dense.meat


def test_undetermined_and_collinear_unknowns_have_a_finite_sandwich():
    """Columns that are collinear, zero, and zero with a strong prior."""
    random, index = np.random.default_rng(7), SampleIndex(np.zeros(50, int), np.arange(50))
    wave, zeros = random.normal(size=50), np.zeros(50)
    jacobian = np.stack([wave, 2.0 * wave, zeros, zeros], axis=1)
    precision = np.diag([0, 0, 0, 1e12])
    covariance = residual_covariance(random.normal(size=50), jacobian, precision, 2.0, np.ones(50), index)
    assert np.all(np.isfinite(covariance.meat))
    assert 0 < covariance.independent_samples <= 50


@pytest.mark.slow
def test_one_fit_and_many_give_the_same_evidence():
    """Verdict and errors of a fit from two starts, alone and among many; robust errors are never narrower."""
    scene = jl.Scene(ground=jl.Ground(height=0.5, reflectance=0.3))
    wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
    unknowns = [
        inversion.Unknown("ground.height", bounds=(-2.0, 2.0), name="height"),
        inversion.Unknown("ground.reflectance", bounds=(0.0, 1.0), name="brightness", prior=(0.3, 1e-6)),
    ]
    options = {"noise": 0.001, "starts": 2, "key": jax.random.key(1)}
    start = jl.Scene(ground=jl.Ground())
    fit = ask(inversion.retrieve, wave, jl.Lidar(), start, unknowns, **options)
    fits = ask(
        inversion.retrieve_many,
        wave.reflectance[None],
        jl.Lidar(),
        start,
        unknowns,
        time=wave.time,
        **options,
    )
    for name in fit.values:
        assert fit.robust_stderr[name] >= fit.stderr[name]
        assert fits.robust_stderr[name][0] >= fits.stderr[name][0]
        np.testing.assert_allclose(fits.prior_share[name][0], fit.prior_share[name], atol=1e-3)
        assert fits.at_bound[name][0] == fit.at_bound[name] == False  # noqa: E712
    assert fit.prior_share["height"] == 0.0
    assert fit.prior_share["brightness"] > 0.9
    assert fit.quality == fits.quality[0] == Verdict("doubtful", ("from the prior: brightness",))
    assert judge_fit(fit, about=["height"]).quality == "good"
    assert "height at bound" in fits.to_xarray()


@pytest.mark.slow
def test_starts_that_end_elsewhere_at_the_same_misfit_are_doubt():
    """Below a slanting beam, slopes of 10 and 30 degrees broaden the echo alike."""
    lidar = jl.Lidar(altitude=500.0, divergence=10.0, zenith=20.0, azimuth=90.0)

    def scene(slope):
        return jl.Scene(ground=jl.Ground(slope=slope, aspect=270.0, reflectance=0.3))

    wave = jl.simulate(lidar, scene(10.0), key=jax.random.key(0), window=(-80.0, 80.0))
    unknowns = [
        inversion.Unknown("ground.slope", bounds=(0.0, 50.0), name="slope"),
        inversion.Unknown("ground.reflectance", bounds=(0.05, 0.9), name="reflectance"),
    ]
    options = {"noise": 1e-4, "starts": 3, "key": jax.random.key(1)}
    fit = ask(inversion.retrieve, wave, lidar, scene(40.0), unknowns, **options)
    assert fit.converged
    assert min(abs(float(fit.values["slope"]) - slope) for slope in (10.0, 30.0)) < 0.1
    assert fit.quality.quality == "doubtful"
    assert fit.quality.reasons[0].startswith("second minimum")
    # Starts in the other minimum did not end there.
    assert "3 of 3" not in fit.status
    assert fit.robust_stderr["slope"] > 50.0 * fit.stderr["slope"]
    (printed,) = re.findall(r"slope .*\(robust ([\d.]+)\)", str(fit))
    assert float(printed) == pytest.approx(float(fit.robust_stderr["slope"]), rel=1e-3)


BINS = np.arange(40.0)
ECHO = np.exp(-0.5 * ((BINS - 20.0) / 4.0) ** 2)


def fit_from_two_starts(batch_sigma, max_steps_elsewhere=50):
    """Fit x in an echo of strength 1 + x^2, which is 2 at x = -1 and 1, with other noise at either sign.

    `max_steps_elsewhere`: of the start that ends at x = -1.
    """
    random = np.random.default_rng(3)
    observed = 2.0 * ECHO + 0.001 * random.normal(size=BINS.size)
    noise = {sign: 1.0 + batch_sigma * random.normal(size=(8, 1, BINS.size)) for sign in (-1.0, 1.0)}

    def simulate(request):
        x = float(request.values[0])
        factors = noise[np.sign(x)]
        batches = factors * (1.0 + x**2) * ECHO
        slope = np.mean(factors, axis=0) * 2.0 * x * ECHO
        return Evaluation(np.mean(batches, axis=0), slope[..., None], None, batches)

    setter, bound = Setter(None, None, "geometric"), np.asarray(2.0)
    unknown = BoundUnknown("x", setter, jnp.asarray(0.7), -bound, bound, None)
    observation = ObservedWaveform(BINS, observed[None], np.full((1, BINS.size), 0.001))
    recorder = RecorderModel(None, [], jl.Lidar(), BINS.size)
    fits = [
        LeastSquaresFit(
            observation,
            [unknown],
            recorder,
            SolverSettings(steps, 2),
            start=np.array([start]),
        )
        for start, steps in ((0.7, 50), (-0.7, max_steps_elsewhere))
    ]
    return run_fit(multistart(fits), simulate).summary


def test_noise_of_the_simulation_is_no_difference_between_minima():
    """Both minima are equally good, though their chi-squared by the measurement's noise alone differs."""
    summary = fit_from_two_starts(batch_sigma=0.03)
    assert summary.converged
    assert summary.second_minimum < 4.0
    assert "1 of 2 starts ended there" in summary.status
    assert summary.robust_stderr[0] > 1.0
    # Without noise of the simulation as well.
    assert fit_from_two_starts(batch_sigma=0.0).second_minimum < 4.0


def test_a_start_that_has_not_converged_elsewhere_is_doubt():
    summary = fit_from_two_starts(batch_sigma=0.03, max_steps_elsewhere=4)
    assert summary.converged
    assert "1 of 2 starts ended there" in summary.status
    assert summary.second_minimum < 4.0
