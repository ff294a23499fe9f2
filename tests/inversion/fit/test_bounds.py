"""Fits at and beside their bounds: they end at the minimum within them, and say so only there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

import inversion
import jaxlidar as jl
from inversion import LogNormal, Recorder, Unknown
from inversion.fit.data import ObservedWaveform
from inversion.fit.model import Evaluation
from inversion.fit.recorder_model import RecorderModel
from inversion.fit.retrieval_many import LockstepModel
from inversion.fit.solver import LeastSquaresFit, SolverSettings
from inversion.fit.unknowns import BoundUnknown, Setter
from tests.helpers import ask, run_fit, slow_unless

LIDAR = jl.Lidar()
HEIGHT, REFLECTANCE = (-2.0, 2.0), (0.05, 0.9)


def ground(height, reflectance):
    return jl.Scene(ground=jl.Ground(height=height, reflectance=reflectance))


def unknowns_with(height=HEIGHT, reflectance=REFLECTANCE, **options):
    return [
        Unknown("ground.height", bounds=height, name="height"),
        Unknown("ground.reflectance", bounds=reflectance, name="reflectance", **options),
    ]


def wave_of(height, reflectance):
    return jl.simulate(LIDAR, ground(height, reflectance), key=jax.random.key(0), window=(-40.0, 40.0))


def fit_ground(truth, start, unknowns=None, **options):
    options = {"noise": 1e-4, "key": jax.random.key(1), **options}
    unknowns = unknowns_with() if unknowns is None else unknowns
    return ask(inversion.retrieve, wave_of(*truth), LIDAR, ground(*start), unknowns, **options)


# Echoes of start and truth overlap little: the reflectance falls to its bound before the height has moved.
FAR_STARTS = [
    ((0.4, 0.25), (2.0, 0.9)),
    ((0.4, 0.25), (2.0, 0.05)),
    ((-0.4, 0.25), (-2.0, 0.9)),
    ((0.4, 0.06), (2.0, 0.9)),
    ((1.9, 0.85), (0.0, 0.05)),
    ((-1.2, 0.8), (0.0, 0.9)),
]


@pytest.mark.parametrize(("truth", "start"), FAR_STARTS)
def test_a_fit_that_came_to_a_bound_leaves_it(truth, start):
    fit = fit_ground(truth, start)
    assert fit.converged, fit.status
    assert "bound" not in fit.status
    assert fit.reduced_chi2 < 0.1
    np.testing.assert_allclose([fit.values["height"], fit.values["reflectance"]], truth, atol=2e-3)
    assert fit.quality.quality == "good"


@pytest.mark.slow
def test_many_fits_leave_their_bounds():
    truths, starts = zip(*FAR_STARTS)
    waves = [wave_of(*truth) for truth in truths]
    fits = ask(
        inversion.retrieve_many,
        np.stack([wave.reflectance for wave in waves]),
        LIDAR,
        [ground(*start) for start in starts],
        unknowns_with(),
        noise=1e-4,
        time=waves[0].time,
        key=jax.random.key(1),
    )
    assert np.all(fits.converged), fits.status
    found = np.stack([fits.values["height"], fits.values["reflectance"]], axis=1)
    np.testing.assert_allclose(found, truths, atol=2e-3)


@pytest.mark.parametrize("height", [-2.0, 2.0])
@pytest.mark.parametrize("reflectance", slow_unless([0.05], [0.05, 0.9]))
def test_a_truth_on_a_bound_is_retrieved_and_named(height, reflectance):
    fit = fit_ground((height, reflectance), (0.7 * height, 0.4))
    assert fit.converged, fit.status
    np.testing.assert_allclose(
        [fit.values["height"], fit.values["reflectance"]], [height, reflectance], atol=1e-3
    )
    assert "bound: height, reflectance" in fit.status or fit.status.count("bound: ") == 2


def test_a_truth_beyond_a_bound_ends_at_it_with_the_others_at_their_minimum():
    """The reflectance is held at its bound, and the height is that of a fit without this bound."""
    fit = fit_ground((0.4, 0.5), (0.0, 0.2), unknowns_with(reflectance=(0.05, 0.3)))
    assert fit.converged, fit.status
    assert float(fit.values["reflectance"]) == pytest.approx(0.3, abs=1e-5)
    assert float(fit.values["height"]) == pytest.approx(0.4, abs=1e-3)
    assert "at the upper bound: reflectance" in fit.status


def test_wide_bounds_and_log_normal_priors_from_zero_are_no_obstacle():
    """The truth lies within a thousandth of the width from the lower bound of the scale."""
    prior = LogNormal(0.25, 1e-3)
    unknowns = unknowns_with(reflectance=(0.0, 1.0), prior=prior)
    wave = wave_of(0.4, 0.25)
    options = {"noise": 1e-4, "time": wave.time, "key": jax.random.key(1), "scale": (0.01, 1e3)}
    fit = ask(inversion.retrieve, 0.5 * wave.reflectance, LIDAR, ground(0.0, 0.9), unknowns, **options)
    assert fit.converged, fit.status
    assert float(fit.values["reflectance"]) == pytest.approx(0.25, rel=3e-3)
    assert float(fit.values["scale"]) == pytest.approx(0.5, rel=3e-3)


# -- linear problems, whose minimum within the bounds is known


def fit_linear_problem(matrix, observed, low, high, start):
    """Fit one vector with noise of one, without a smoothness prior."""
    samples = observed.size
    setter = Setter(None, None, "geometric")
    unknown = BoundUnknown("x", setter, jnp.asarray(start), low, high, None)
    observation = ObservedWaveform(np.arange(samples, dtype=float), observed[None], np.ones((1, samples)))
    recorder, settings = RecorderModel(None, [], LIDAR, samples), SolverSettings(50, 1)
    fit = LeastSquaresFit(observation, [unknown], recorder, settings)

    def simulate(request):
        return Evaluation((matrix @ request.values)[None], matrix[None], None, None)

    return run_fit(fit.run(), simulate).summary


def test_vectors_end_at_the_minimum_within_their_bounds():
    """Correlated unknowns, half of them at a bound, from starts on bounds and within."""
    random = np.random.default_rng(0)
    n_at_bounds, n_steps = 0, []
    for case in range(30):
        matrix = random.normal(size=(40, 6)) @ (np.eye(6) + 0.4 * random.normal(size=(6, 6)))
        low, high = -np.ones(6), np.array([0.5, 1.0, 2.0, 4.0, 50.0, 3.0])
        truth = random.uniform(low - 1.0, high + 1.0)
        observed = matrix @ truth + random.normal(size=40)
        exact = optimize.lsq_linear(matrix, observed, (low, high), method="bvls", tol=1e-12)
        start = (low, high, random.uniform(low, high))[case % 3]
        fit = fit_linear_problem(matrix, observed, low, high, start)
        assert fit.converged, fit.status
        # In chi-squared: the stopping rule leaves 0.05 standard errors.
        rise = np.sum((matrix @ fit.values - observed) ** 2) - 2.0 * exact.cost
        assert -1e-6 < rise < 0.1**2
        np.testing.assert_array_equal(fit.at_bound, exact.active_mask != 0)
        n_at_bounds += np.sum(exact.active_mask != 0)
        n_steps.append(fit.steps)
    assert n_at_bounds > 30
    assert np.median(n_steps) < 8
    assert max(n_steps) < 20


def test_a_fit_held_at_a_bound_by_a_wrong_derivative_says_that_the_misfit_falls_inwards():
    """The cost falls inwards from a start on two bounds, where steps seem to raise it."""
    low, high, samples = np.zeros(2), np.ones(2), 20
    matrix = np.random.default_rng(1).normal(size=(samples, 2))
    observed = matrix @ np.array([0.6, 0.4])
    observation = ObservedWaveform(np.arange(samples, dtype=float), observed[None], np.ones((1, samples)))
    unknown = BoundUnknown("x", Setter(None, None, "geometric"), jnp.asarray(low), low, high, None)
    status = {}
    for sign in (1.0, -1.0):
        recorder, settings = RecorderModel(None, [], LIDAR, samples), SolverSettings(50, 1)
        fit = LeastSquaresFit(observation, [unknown], recorder, settings)

        def simulate(request, sign=sign):
            # With the other sign all values within the bounds fit worse, whatever the derivative promises.
            return Evaluation((sign * matrix @ request.values)[None], matrix[None], None, None)

        status[sign] = run_fit(fit.run(), simulate).summary.status
    assert "bound" not in status[1.0], status
    assert status[1.0].startswith("converged"), status
    assert status[-1.0].startswith("failed: no step improves the fit"), status
    assert "the misfit falls inwards from the bound of x[0], x[1]" in status[-1.0], status


# -- evaluations


@pytest.mark.slow
def test_a_fit_without_random_numbers_requests_no_evaluation_twice(monkeypatch):
    requested = []
    evaluate = LockstepModel.__call__

    def record_and_evaluate(self, requests):
        requested.extend(tuple(request.values) for request in requests.values())
        return evaluate(self, requests)

    monkeypatch.setattr(LockstepModel, "__call__", record_and_evaluate)
    wave = wave_of(0.4, 0.25)
    fits = ask(
        inversion.retrieve_many,
        wave.reflectance[None],
        LIDAR,
        ground(0.0, 0.5),
        unknowns_with(),
        noise=1e-4,
        time=wave.time,
        key=jax.random.key(1),
    )
    assert np.all(fits.converged)
    assert len(requested) == len(set(requested)) == fits.steps[0]


# -- offsets of digitisers


def test_offsets_of_digitisers_are_no_signal():
    """A pedestal changes neither the errors widened by misfit nor the floor of the noise."""
    wave = wave_of(0.4, 0.25)
    peak = float(np.max(wave.reflectance))
    # Misfit in proportion to the signal, and correlated.
    record = np.asarray(wave.reflectance) * (1.0 + 0.05 * np.sin(np.asarray(wave.time)))
    recorder = Recorder(offset=(-100.0 * peak, 100.0 * peak))
    options = {"key": jax.random.key(1), "time": wave.time, "recorder": recorder}
    for noise in (0.01 * peak, 0.0):
        without, with_pedestal = (
            ask(
                inversion.retrieve,
                record + offset,
                LIDAR,
                ground(0.3, 0.2),
                unknowns_with(),
                noise=noise,
                **options,
            )
            for offset in (0.0, 20.0 * peak)
        )
        for name in ("height", "reflectance"):
            np.testing.assert_allclose(with_pedestal.stderr[name], without.stderr[name], rtol=0.02)
            np.testing.assert_allclose(
                with_pedestal.robust_stderr[name], without.robust_stderr[name], rtol=0.02
            )
