"""Campaigns on the workers of a real Dask cluster, one of which is killed."""

import os

import pytest

import jaxlidar as jl
from tests.inversion.fit.test_retrieval_many import fit, footprints  # noqa: F401
from tests.survey.test_simulate_many import FAST, KEY, die_once, nadir, same, stand

distributed = pytest.importorskip("distributed")
pytestmark = [
    pytest.mark.slow,
    # Of Dask's own making.
    pytest.mark.filterwarnings("ignore::DeprecationWarning:(distributed|dask|tornado|zict).*"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(scope="module")
def client():
    """A client of two worker processes."""
    quiet = {"dashboard_address": None, "silence_logs": "CRITICAL"}
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, **quiet) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


@pytest.fixture(scope="module")
def whole():
    """What one process makes of the survey."""
    return jl.simulate_many(nadir(32), stand(), key=KEY, **FAST)


def test_workers_of_a_cluster_give_the_same(client, whole):
    assert same(whole, jl.simulate_many(nadir(32), stand(), key=KEY, **FAST, executor=client.get_executor()))


def test_light_is_shared_by_workers(client):
    survey, how = jl.Survey.grid(nadir(1).lidar, (-20, -20), (20, 20), 4.0), {"rtol": 0.1, "max_orders": 2}
    many = jl.simulate_many(survey, stand(), key=KEY, **how)
    assert many.info["shared"]
    assert same(many, jl.simulate_many(survey, stand(), key=KEY, **how, executor=client.get_executor()))


class KilledOnce(distributed.cfexecutor.ClientExecutor):
    """The executor of a client, one worker of which is killed."""

    marker = ""

    def submit(self, function, /, *args, **kwargs):
        return super().submit(die_once, self.marker, function, *args)


def test_a_worker_that_is_killed_costs_its_chunk_a_second_try(client, whole, tmp_path):
    pool = KilledOnce(client)
    pool.marker = str(tmp_path / "died")
    assert same(whole, jl.simulate_many(nadir(32), stand(), key=KEY, **FAST, executor=pool))
    assert os.path.exists(pool.marker)


def test_fits_by_workers_are_the_same(client, footprints):  # noqa: F811
    here = fit(footprints, lanes=2)
    assert same(here, fit(footprints, lanes=2, executor=client.get_executor()))
    assert here.converged.all()
