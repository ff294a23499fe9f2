"""Fits that begin with few batches of photons: they end where fits with all batches do, and trace less."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion.fit.model
import jaxlidar as jl
from inversion.fit.data import Data
from inversion.fit.lanes import Lanes, Simulator
from inversion.fit.model import FEW_BATCHES, Evaluation, Model
from inversion.fit.planning import plan_for
from inversion.fit.retrieval import SOLVER
from inversion.fit.solver import Fit, Request, drive
from inversion.fit.unknowns import Place, Settled, settle
from inversion.receiver.recorder import RecorderModel
from jaxlidar.planning.plan import MIN_BATCHES
from tests.inversion.fit.test_retrieval import LIDAR, UNKNOWNS, retrieve_canopy, start_scene, target  # noqa: F401

# Two echoes, of which heights, strengths and a width are unknown.
TIME = np.arange(80.0)
LOW, HIGH = np.array([20.0, 0.2, 45.0, 0.2, 1.5]), np.array([35.0, 5.0, 60.0, 5.0, 6.0])
TRUTH = np.array([29.0, 1.0, 52.0, 2.0, 3.0])
SIGMA, GRAIN = 0.02, 0.03


def echoes(values):
    first, a, second, b, width = values
    shape = lambda at: jnp.exp(-0.5 * ((TIME - at) / width) ** 2)  # noqa: E731
    return (a * shape(first) + b * shape(second))[None]


class Batches:
    """A simulation in batches whose noise is a share of the signal. It counts the batches."""

    def __init__(self, number, seed=0):
        grain = GRAIN * np.random.default_rng(seed).normal(size=(MIN_BATCHES, 1, TIME.size))
        # Noise is alike over neighbouring samples, as a pulse makes it.
        blurred = np.apply_along_axis(np.convolve, -1, grain, np.ones(5) / np.sqrt(5.0), mode="same")
        self.factors, self.number, self.traced = 1.0 + blurred, number, 0

    def __call__(self, request):
        few = request.few and self.number < len(self.factors)
        factors = self.factors[: self.number] if few else self.factors
        self.traced += len(factors)
        total, slope = _echoes_and_slope(request.values)
        batches = factors * np.asarray(total, float)
        slope = np.mean(factors, axis=0)[..., None] * np.asarray(slope, float)
        return Evaluation(np.mean(batches, axis=0), slope, None, batches, few)


@jax.jit
def _echoes_and_slope(values):
    return echoes(values), jax.jacfwd(echoes)(values)


def fitted(simulation, seed, max_steps=50, progress=None):
    rng = np.random.default_rng(seed)
    observed = np.asarray(echoes(TRUTH), float) + SIGMA * rng.normal(size=(1, TIME.size))
    place = Place(None, None, True)
    settled = [
        Settled(
            f"x{i}", place, jnp.asarray(low + 0.3 * (high - low)), np.asarray(low), np.asarray(high), None
        )
        for i, (low, high) in enumerate(zip(LOW, HIGH))
    ]
    data = Data(TIME, observed, np.full(observed.shape, SIGMA))
    terms = RecorderModel(None, [], jl.Lidar(), TIME.size)
    return drive(Fit(data, settled, terms, SOLVER, max_steps, progress).run(), simulation)


def distance(a, b):
    return np.max(np.abs(a.values - b.values) / b.stderr)


def test_a_fit_ends_where_one_with_all_batches_does(monkeypatch):
    # Both with the weights of the solution; those of the start put the simulation's noise elsewhere.
    monkeypatch.setattr("inversion.fit.solver._WRONG_WEIGHTS", 0.0)
    few_alone, traced = [], []
    for seed in range(12):
        few, all_ = Batches(FEW_BATCHES, seed), Batches(MIN_BATCHES, seed)
        a, b = fitted(few, seed), fitted(all_, seed)
        assert a.converged
        assert b.converged
        assert distance(a, b) < 0.1
        np.testing.assert_allclose(a.stderr, b.stderr, rtol=0.02)
        np.testing.assert_allclose(a.simulation_error, b.simulation_error, rtol=0.03)
        assert a.reduced_chi2 == pytest.approx(b.reduced_chi2, abs=0.01)
        assert a.evaluation.batches.shape[0] == MIN_BATCHES
        assert not a.evaluation.few
        traced.append((few.traced, all_.traced))
        # A fit that stopped at what few batches say would be told apart.
        alone = Batches(MIN_BATCHES, seed)
        alone.factors = alone.factors[:FEW_BATCHES]
        few_alone.append(distance(fitted(alone, seed), b))
    assert np.median(few_alone) > 0.2
    less, most = np.sum(traced, axis=0)
    assert less < 0.6 * most


def test_steps_are_simulations_with_few_batches_or_all():
    simulation, steps = Batches(FEW_BATCHES), []
    fit = fitted(simulation, 0, progress=steps.append)
    assert fit.steps == len(fit.history) == len(steps)
    assert [s.number for s in steps] == list(range(1, fit.steps + 1))
    many = (simulation.traced - FEW_BATCHES * fit.steps) / (MIN_BATCHES - FEW_BATCHES)
    assert 2 <= many < fit.steps
    assert fit.status == f"converged after {fit.steps} simulations"


@pytest.mark.parametrize("most", [1, 2, 3, 4, 5])
def test_a_fit_that_is_stopped_has_simulated_with_all_batches(most):
    simulation = Batches(FEW_BATCHES)
    fit = fitted(simulation, 0, max_steps=most)
    assert fit.status.startswith("not converged: stopped at max_steps")
    assert fit.steps == most
    assert not fit.evaluation.few
    assert np.all(fit.simulation_error > 0)


def test_a_batch_that_is_not_finite_fails_the_fit():
    """The first ones are fine."""
    simulation = Batches(FEW_BATCHES)
    simulation.factors[-1] = np.nan
    fit = fitted(simulation, 0)
    assert not fit.converged
    assert fit.status.startswith("failed: the simulated waveform is not finite")


def model_and_lanes():
    scene = start_scene()
    settled = settle(UNKNOWNS[1:4:2], scene)
    time = np.arange(-60.0, 21.0)
    plan = plan_for(LIDAR, scene, settled, time, max_orders=2, photons=128, rays=64)
    given = plan, settled, jax.random.key(0)
    return Model(LIDAR, scene, *given), Simulator([LIDAR], [scene], *given, Lanes(2, 2))


@pytest.mark.slow
def test_lanes_trace_the_batches_that_are_asked_for(monkeypatch):
    """Few in one lane and all in another, as one simulation gives them; what is there is not traced again."""
    counts = []
    batch = inversion.fit.model._compiled_batch
    monkeypatch.setattr("inversion.fit.model._compiled_batch", lambda *a: (counts.append(1), batch(*a))[1])
    model, simulator = model_and_lanes()
    at = [np.array([1.1, 0.2]), np.array([1.4, -0.1]), np.array([0.9, 0.4])]
    requests = {i: Request(values, True, i != 1) for i, values in enumerate(at)}
    found = simulator(requests)
    for i, values in enumerate(at):
        one = model(values, spread=True, few=i != 1)
        assert one.few == found[i].few == (i != 1)
        assert one.batches.shape == found[i].batches.shape
        for name in ("total", "jacobian", "batches"):
            a, b = getattr(found[i], name), getattr(one, name)
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * np.max(np.abs(b)))
        np.testing.assert_allclose(one.total, np.mean(one.batches, axis=0), rtol=1e-4, atol=1e-7)
    counts.clear()
    few, whole = model(at[0], few=True), model(at[0])
    assert len(counts) == MIN_BATCHES
    np.testing.assert_array_equal(whole.batches[:FEW_BATCHES], few.batches)
    assert not np.array_equal(whole.total, few.total)


@pytest.mark.slow
def test_a_retrieval_with_few_batches_is_that_with_all(target, monkeypatch):  # noqa: F811
    counts = []
    batch = inversion.fit.model._compiled_batch
    monkeypatch.setattr("inversion.fit.model._compiled_batch", lambda *a: (counts.append(1), batch(*a))[1])

    def fit(seed):
        counts.clear()
        found = retrieve_canopy(target, seed, start_scene(), n_photons=32768, n_rays=8192)
        return found, len(counts)

    few = [fit(seed) for seed in range(3)]
    monkeypatch.setattr("inversion.fit.model.FEW_BATCHES", MIN_BATCHES)
    for seed, (found, traced) in enumerate(few):
        whole, most = fit(seed)
        assert most == MIN_BATCHES * whole.steps
        assert traced < 0.7 * most
        for name, value in whole.values.items():
            assert np.max(np.abs(found.values[name] - value) / whole.stderr[name]) < 0.1
            np.testing.assert_allclose(found.stderr[name], whole.stderr[name], rtol=0.03)
        assert float(found.reduced_chi2) == pytest.approx(float(whole.reduced_chi2), abs=0.01)
