"""Surveys on the workers of a real Dask cluster, one of which is killed."""

import os

import pytest

import jaxlidar as jl
from tests.inversion.fit.test_retrieval_many import fit, footprints  # noqa: F401
from tests.quick_compilation import optimise_programs
from tests.survey.test_simulate_many import FAST, KEY, die_once, nadir, same, stand

dask, distributed = pytest.importorskip("dask"), pytest.importorskip("distributed")
pytestmark = [
    pytest.mark.slow,
    # Warnings of Dask itself.
    pytest.mark.filterwarnings("ignore::DeprecationWarning:(distributed|dask|tornado|zict).*"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(scope="module")
def client():
    """A client of two worker processes."""
    quiet = {"dashboard_address": None, "silence_logs": "CRITICAL"}
    # Dask gives its workers one thread for products of NumPy, which rounds otherwise than two.
    same_threads = {"distributed.nanny.pre-spawn-environ": {}}
    with (
        dask.config.set(same_threads),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, **quiet) as cluster,
        distributed.Client(cluster) as client,
    ):
        # Also of workers that take the place of killed ones.
        client.register_worker_callbacks(optimise_programs)
        yield client


@pytest.fixture(scope="module")
def one_process():
    """The waveforms of the survey, traced by one process."""
    return jl.simulate_many(nadir(32), stand(), key=KEY, **FAST)


def test_workers_of_a_cluster_trace_the_same_waveforms(client, one_process):
    assert same(
        one_process, jl.simulate_many(nadir(32), stand(), key=KEY, **FAST, executor=client.get_executor())
    )


def test_workers_share_illumination(client):
    survey, options = (
        jl.Survey.grid(nadir(1).lidar, (-20, -20), (20, 20), 4.0),
        {"rtol": 0.1, "max_orders": 2},
    )
    waveforms = jl.simulate_many(survey, stand(), key=KEY, **options)
    assert waveforms.info["shared"]
    assert same(
        waveforms, jl.simulate_many(survey, stand(), key=KEY, **options, executor=client.get_executor())
    )


class ClientWithKilledWorker(distributed.cfexecutor.ClientExecutor):
    """The executor of a cluster, one worker of which makes the file `marker` and is killed."""

    marker = ""

    def submit(self, function, /, *args, **kwargs):
        return super().submit(die_once, self.marker, function, *args)


def test_the_chunk_of_a_killed_worker_is_run_again(client, one_process, tmp_path):
    executor = ClientWithKilledWorker(client)
    executor.marker = str(tmp_path / "died")
    assert same(one_process, jl.simulate_many(nadir(32), stand(), key=KEY, **FAST, executor=executor))
    assert os.path.exists(executor.marker)


def test_workers_of_a_cluster_fit_the_same_values(client, footprints):  # noqa: F811
    local = fit(footprints, lanes=2)
    assert same(local, fit(footprints, lanes=2, executor=client.get_executor()))
    assert local.converged.all()
