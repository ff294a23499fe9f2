"""Fits that begin with pilot evaluations: they end where fits with all batches do, and trace less."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion.fit.model
import jaxlidar as jl
from inversion.fit.data import ObservedWaveform
from inversion.fit.model import PILOT_BATCHES, Evaluation, ForwardModel
from inversion.fit.planning import plan_for_bounds
from inversion.fit.problem import BoundProblem
from inversion.fit.recorder_model import RecorderModel
from inversion.fit.retrieval_many import LockstepGroups, LockstepModel
from inversion.fit.solver import (
    EvaluationRequest,
    LeastSquaresFit,
    SolverSettings,
)
from inversion.fit.unknowns import BoundUnknown, Setter, bind_unknowns
from jaxlidar.planning.plan import MIN_BATCHES
from tests.helpers import run_fit
from tests.inversion.fit.test_retrieval import LIDAR, UNKNOWNS, retrieve_canopy, start_scene, target  # noqa: F401

# Two echoes of unknown heights and strengths, and of a common unknown width.
TIME = np.arange(80.0)
LOW, HIGH = np.array([20.0, 0.2, 45.0, 0.2, 1.5]), np.array([35.0, 5.0, 60.0, 5.0, 6.0])
TRUTH = np.array([29.0, 1.0, 52.0, 2.0, 3.0])
# Standard deviation of the record, and of each batch of the simulation relative to the signal.
SIGMA, BATCH_SIGMA = 0.02, 0.03


def echoes(values):
    first, first_strength, second, second_strength, width = values
    shape = lambda position: jnp.exp(-0.5 * ((TIME - position) / width) ** 2)  # noqa: E731
    return (first_strength * shape(first) + second_strength * shape(second))[None]


class BatchedSimulation:
    """A simulation in batches whose noise is proportional to the signal. It counts the batches."""

    def __init__(self, n_pilot, seed=0):
        noise = BATCH_SIGMA * np.random.default_rng(seed).normal(size=(MIN_BATCHES, 1, TIME.size))
        # Noise is correlated over neighbouring samples, as by a pulse.
        smoothed = np.apply_along_axis(np.convolve, -1, noise, np.ones(5) / np.sqrt(5.0), mode="same")
        self.factors, self.n_pilot, self.n_traced = 1.0 + smoothed, n_pilot, 0

    def __call__(self, request):
        is_pilot = request.pilot and self.n_pilot < len(self.factors)
        factors = self.factors[: self.n_pilot] if is_pilot else self.factors
        self.n_traced += len(factors)
        total, slope = _echoes_and_slope(request.values)
        batches = factors * np.asarray(total, float)
        slope = np.mean(factors, axis=0)[..., None] * np.asarray(slope, float)
        return Evaluation(np.mean(batches, axis=0), slope, None, batches, is_pilot)


@jax.jit
def _echoes_and_slope(values):
    return echoes(values), jax.jacfwd(echoes)(values)


def fit_echoes(simulation, seed, max_steps=50, progress=None):
    """Fit a noisy record of the echoes with a simulation."""
    random = np.random.default_rng(seed)
    observed = np.asarray(echoes(TRUTH), float) + SIGMA * random.normal(size=(1, TIME.size))
    setter = Setter(None, None, "geometric")
    unknowns = [
        BoundUnknown(
            f"x{i}", setter, jnp.asarray(low + 0.3 * (high - low)), np.asarray(low), np.asarray(high), None
        )
        for i, (low, high) in enumerate(zip(LOW, HIGH))
    ]
    observation = ObservedWaveform(TIME, observed, np.full(observed.shape, SIGMA))
    recorder = RecorderModel(None, [], jl.Lidar(), TIME.size)
    settings = SolverSettings(max_steps, starts=1)
    return run_fit(LeastSquaresFit(observation, unknowns, recorder, settings, progress).run(), simulation)


def distance(a, b):
    """Largest difference of two records' values, in standard errors."""
    return np.max(np.abs(a.values - b.values) / b.stderr)


def test_a_fit_ends_where_one_with_all_batches_does(monkeypatch):
    # Both with the weights of the solution; those of the start put the simulation's noise elsewhere.
    monkeypatch.setattr("inversion.fit.solver._MAX_WEIGHT_CHANGE", 0.0)
    distances_of_pilot_fits, n_traced = [], []
    for seed in range(8):
        with_pilot, with_all = BatchedSimulation(PILOT_BATCHES, seed), BatchedSimulation(MIN_BATCHES, seed)
        fit = fit_echoes(with_pilot, seed)
        a, b = fit.summary, fit_echoes(with_all, seed).summary
        assert a.converged
        assert b.converged
        assert distance(a, b) < 0.1
        np.testing.assert_allclose(a.stderr, b.stderr, rtol=0.02)
        np.testing.assert_allclose(a.simulation_error, b.simulation_error, rtol=0.03)
        assert a.reduced_chi2 == pytest.approx(b.reduced_chi2, abs=0.01)
        assert fit.evaluation.batches.shape[0] == MIN_BATCHES
        assert not fit.evaluation.is_pilot
        n_traced.append((with_pilot.n_traced, with_all.n_traced))
        # Negative control: a fit that stopped at what the pilot batches say ends elsewhere.
        pilot_only = BatchedSimulation(MIN_BATCHES, seed)
        pilot_only.factors = pilot_only.factors[:PILOT_BATCHES]
        distances_of_pilot_fits.append(distance(fit_echoes(pilot_only, seed).summary, b))
    assert np.median(distances_of_pilot_fits) > 0.2
    traced_with_pilot, traced_with_all = np.sum(n_traced, axis=0)
    assert traced_with_pilot < 0.6 * traced_with_all


def test_steps_are_simulations_with_pilot_batches_or_all():
    simulation, steps = BatchedSimulation(PILOT_BATCHES), []
    fit = fit_echoes(simulation, 0, progress=steps.append)
    record = fit.summary
    assert record.steps == len(fit.history) == len(steps)
    assert [s.number for s in steps] == list(range(1, record.steps + 1))
    n_full = (simulation.n_traced - PILOT_BATCHES * record.steps) / (MIN_BATCHES - PILOT_BATCHES)
    assert 2 <= n_full < record.steps
    assert record.status == f"converged after {record.steps} simulations"


@pytest.mark.parametrize("max_steps", [1, 2, 3, 4, 5])
def test_a_fit_that_is_stopped_has_simulated_with_all_batches(max_steps):
    fit = fit_echoes(BatchedSimulation(PILOT_BATCHES), 0, max_steps=max_steps)
    record = fit.summary
    assert record.status.startswith("not converged: stopped at max_steps")
    assert record.steps == max_steps
    assert not fit.evaluation.is_pilot
    assert np.all(record.simulation_error > 0)


def test_a_batch_that_is_not_finite_fails_the_fit():
    """The pilot batches are finite."""
    simulation = BatchedSimulation(PILOT_BATCHES)
    simulation.factors[-1] = np.nan
    record = fit_echoes(simulation, 0).summary
    assert not record.converged
    assert record.status.startswith("failed: the simulated waveform is not finite")


def model_and_lockstep_model():
    scene, time = start_scene(), np.arange(-60.0, 21.0)
    unknowns = bind_unknowns(UNKNOWNS[1:4:2], scene)
    plan = plan_for_bounds(LIDAR, scene, unknowns, time, n_photons=1024, n_rays=64, max_orders=2)
    key = jax.random.key(0)
    problem = BoundProblem(
        numbers=range(3),
        observed=[],
        lidars=[LIDAR],
        scenes=[scene],
        unknowns=[unknowns],
        scale=[],
        recorders=[None],
        plan=plan,
    )
    groups = LockstepGroups(n_threads=2, fits_per_thread=2)
    return ForwardModel(LIDAR, scene, plan, unknowns, key), LockstepModel(problem, groups, key)


@pytest.fixture
def traced_batches(monkeypatch):
    """A list that grows by one for every batch that a `ForwardModel` traces."""
    traced, trace_batch = [], inversion.fit.model._compiled_trace_batch
    monkeypatch.setattr(
        "inversion.fit.model._compiled_trace_batch", lambda *args: (traced.append(1), trace_batch(*args))[1]
    )
    return traced


@pytest.mark.slow
def test_a_lockstep_group_traces_the_batches_that_each_fit_requests(traced_batches):
    """Pilot batches for some and all for another, as a single simulation gives them; none is traced twice."""
    model, lockstep_model = model_and_lockstep_model()
    points = [np.array([1.1, 0.2]), np.array([1.4, -0.1]), np.array([0.9, 0.4])]
    requests = {i: EvaluationRequest(values, True, i != 1) for i, values in enumerate(points)}
    together = lockstep_model(requests)
    for i, values in enumerate(points):
        alone = model(values, with_batches=True, pilot=i != 1)
        assert alone.is_pilot == together[i].is_pilot == (i != 1)
        assert alone.batches.shape == together[i].batches.shape
        for name in ("reflectance", "jacobian", "batches"):
            a, b = getattr(together[i], name), getattr(alone, name)
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * np.max(np.abs(b)))
        np.testing.assert_allclose(alone.reflectance, np.mean(alone.batches, axis=0), rtol=1e-4, atol=1e-7)
    traced_batches.clear()
    pilot, full = model(points[0], pilot=True), model(points[0])
    assert len(traced_batches) == MIN_BATCHES
    np.testing.assert_array_equal(full.batches[:PILOT_BATCHES], pilot.batches)
    assert not np.array_equal(full.reflectance, pilot.reflectance)


@pytest.mark.slow
def test_a_retrieval_with_pilot_evaluations_is_that_without(target, monkeypatch, traced_batches):  # noqa: F811
    def fit(seed):
        traced_batches.clear()
        retrieval = retrieve_canopy(target, seed, start_scene(), n_photons=32768, n_rays=1024)
        return retrieval, len(traced_batches)

    fits_with_pilot = [fit(seed) for seed in range(3)]
    monkeypatch.setattr("inversion.fit.model.PILOT_BATCHES", MIN_BATCHES)
    for seed, (with_pilot, n_traced) in enumerate(fits_with_pilot):
        without, n_traced_without = fit(seed)
        assert n_traced_without == MIN_BATCHES * without.steps
        assert n_traced < 0.7 * n_traced_without
        for name, value in without.values.items():
            assert np.max(np.abs(with_pilot.values[name] - value) / without.stderr[name]) < 0.1
            np.testing.assert_allclose(with_pilot.stderr[name], without.stderr[name], rtol=0.03)
        assert float(with_pilot.reduced_chi2) == pytest.approx(float(without.reduced_chi2), abs=0.01)
