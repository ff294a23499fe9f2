"""The number of photons that a user asks for: never fewer are traced, also within a JAX transformation."""

import importlib

import jax
import pytest

import jaxlidar as jl
from tests.helpers import slow_unless

KEY = jax.random.key(0)
LIDAR = jl.Lidar()
SCENE = jl.Scene(plates=(jl.Plate(5.0, 0.3, 0.3),), ground=jl.Ground())

# `jaxlidar.simulate` is the function.
simulation = importlib.import_module("jaxlidar.simulation.one_scene")


@pytest.fixture
def batch_photons(monkeypatch):
    """The numbers of photons of a batch of the simulations that follow."""
    photons, make_batch_tracer = [], simulation.make_batch_tracer

    def recording(setup, key):
        photons.append(setup.plan.config.photons_per_batch)
        return make_batch_tracer(setup, key)

    monkeypatch.setattr(simulation, "make_batch_tracer", recording)
    return photons


@pytest.mark.slow
@pytest.mark.parametrize(("n_photons", "traced"), slow_unless([(100, 104)], [(1, 8), (96, 96), (100, 104)]))
def test_eight_batches_have_at_least_as_many_photons(n_photons, traced):
    wave = jl.simulate(LIDAR, SCENE, key=KEY, max_orders=2, n_photons=n_photons, n_rays=8)
    assert (wave.info["batches"], wave.info["photons"]) == (8, traced)
    assert wave.info["stopped"] == "batches spent"


@pytest.mark.slow
@pytest.mark.parametrize("n_photons", slow_unless([100], [1, 100, 600_000]))
def test_a_transformation_traces_as_many_photons(n_photons, batch_photons):
    """A program has eight batches: they are as large as it takes. 600,000 were 524,288, and 100 were 96."""
    plan = jl.plan(LIDAR, SCENE, max_orders=2, n_rays=8, describe=False)
    waves = jax.eval_shape(
        jax.vmap(lambda key: jl.simulate(LIDAR, SCENE, key=key, plan=plan, n_photons=n_photons)),
        jax.random.split(KEY, 2),
    )
    assert waves.reflectance.shape[0] == 2
    assert [8 * n for n in batch_photons] == [8 * -(-n_photons // 8)]


def test_large_batches_can_be_interrupted(batch_photons, monkeypatch):
    """Outside of a transformation, more batches take the place of larger ones."""

    class NoTracing(Exception):
        pass

    def stop(*arguments):
        raise NoTracing

    monkeypatch.setattr(simulation, "_run_batches", stop)
    with pytest.raises(NoTracing):
        jl.simulate(LIDAR, SCENE, key=KEY, max_orders=2, n_photons=600_000, n_rays=8)
    assert batch_photons == [65_536]
