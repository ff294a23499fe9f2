"""Checkpoints of `retrieve_many`: stored fits are checked; kills, damage and full disks lose no other fit."""

import dataclasses
import shutil
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion.fit.fit_summary import FitSummary, SummarySizes
from inversion.fit.retrieval_many import FinishedFits
from jaxlidar.io.checkpoint import open_checkpoint
from tests.helpers import ask
from tests.inversion.fit.test_fingerprint import PROBLEM, TIME, unknowns
from tests.io.test_checkpoint import UNWRITABLE, unwritable

ROOT = Path(__file__).resolve().parents[3]

# -- records of fits -------------------------------------------------------------------------------------

SIZES = SummarySizes(unknowns=2, smooth_priors=0, wavelengths=1, bins=30)
N_FITS = 5


def record(number, **changes):
    fit = FitSummary(
        values=np.array([0.5, number]),
        stderr=np.array([0.1, np.inf]),
        robust_stderr=np.array([0.2, np.inf]),
        prior_share=np.array([0.0, 1.0]),
        at_bound=np.array([False, True]),
        covariance=np.diag([0.01, np.inf]),
        averaging=np.diag([0.9, 0.0]),
        reduced_chi2=1.25,
        independent_samples=17.5,
        second_minimum=np.inf,
        strength=np.zeros(0),
        converged=True,
        status="converged after 4 simulations; the data do not determine λ",
        steps=4,
        fitted=np.linspace(0.0, 1.0, 30)[None],
    )
    return dataclasses.replace(fit, **changes)


def stored_records(path, records=None):
    """Add records to a file. Return all that it has then."""
    with open_checkpoint(path, {"key": "a"}) as checkpoint:
        finished = FinishedFits(checkpoint, N_FITS, SIZES)
        for number, fit in (records or {}).items():
            finished.add(number, fit)
        return finished.summaries


@pytest.fixture
def path(tmp_path):
    """A file of three fits."""
    path = tmp_path / "fits.sqlite"
    stored_records(path, {i: record(i) for i in (0, 3, 1)})
    return path


def test_records_are_read_as_they_were_written(path):
    records = stored_records(path)
    assert sorted(records) == [0, 1, 3]
    for number, fit in records.items():
        for name, value in vars(record(number)).items():
            assert type(value) is type(getattr(fit, name))
            np.testing.assert_array_equal(getattr(fit, name), value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"values": np.ones(3)}, r"values is float64 of the shape \(3,\); .* \(2,\)"),
        ({"covariance": np.ones(2)}, "covariance is"),
        ({"fitted": np.ones((1, 29))}, "fitted is"),
        ({"steps": 0}, ".* after 0 steps"),
        ({"values": np.array([np.nan, 1.0])}, "values = .*nan"),
        ({"reduced_chi2": np.nan}, ".* not finite"),
        ({"fitted": np.full((1, 30), np.inf)}, ".* not finite"),
        ({"stderr": np.array([0.1, np.nan])}, ".* not finite"),
        ({"stderr": np.array([0.1, -1.0])}, ".* not finite"),
        ({"covariance": np.full((2, 2), np.nan)}, ".* not finite"),
    ],
)
def test_records_that_no_fit_gives_are_named_and_fitted_again(path, changes, message):
    with open_checkpoint(path, {"key": "a"}) as checkpoint:
        checkpoint.add(1, record(1, **changes).to_arrays())
    with pytest.warns(UserWarning, match=rf"fits\.sqlite is damaged, and .* again: entry 1 \({message}"):
        assert sorted(stored_records(path)) == [0, 3]
    with pytest.warns(UserWarning, match="entry 1"):
        stored_records(path, {1: record(1)})
    assert sorted(stored_records(path)) == [0, 1, 3]


@pytest.mark.parametrize("number", [-1, N_FITS])
def test_records_of_no_footprint_are_named(path, number):
    with open_checkpoint(path, {"key": "a"}) as checkpoint:
        checkpoint.add(number, record(0).to_arrays())
    with pytest.warns(UserWarning, match=rf"entry {number} \(its number is outside .* range \[0, 4\]"):
        assert sorted(stored_records(path)) == [0, 1, 3]


def test_other_quantities_are_named(path):
    with open_checkpoint(path, {"key": "a"}) as checkpoint:
        checkpoint.add(1, {"values": np.ones(2)})
    with pytest.warns(UserWarning, match=r"entry 1 \(it has values; admissible are values, stderr, "):
        stored_records(path)


def test_a_failed_fit_need_not_be_finite(path):
    not_finite = {"reduced_chi2": np.nan, "fitted": np.full((1, 30), np.nan), "stderr": np.full(2, np.inf)}
    stored_records(path, {2: record(2, converged=False, status="failed: not finite", **not_finite)})
    assert np.isnan(stored_records(path)[2].reduced_chi2)


# -- runs ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", UNWRITABLE)
def test_a_path_that_cannot_be_written_is_refused_before_the_work(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(
        "inversion.fit.retrieval_many.LockstepModel", lambda *_: pytest.fail("the work began")
    )
    with pytest.raises(OSError, match=r"path = .* cannot be written: "):
        ask(inversion.retrieve_many, **PROBLEM | {"path": unwritable(kind, tmp_path)})


COUNT = 7


def echoes():
    """Return noisy echoes of flat ground at several heights and reflectances."""
    delayed = TIME + 2 * np.linspace(-0.5, 0.5, COUNT)[:, None] / 0.299792458
    echo = np.exp(-0.5 * (delayed / 2.55) ** 2)
    wave = np.linspace(0.2, 0.5, COUNT)[:, None] * echo / echo.sum(axis=1, keepdims=True)
    return (wave + 1e-3 * np.random.default_rng(0).normal(size=wave.shape))[:, None]


def run(path, progress=None):
    """Fit flat ground, which is simulated quickly. Another process calls this too."""
    return ask(
        inversion.retrieve_many,
        echoes(),
        jl.Lidar(),
        jl.Scene(ground=jl.Ground(reflectance=0.3)),
        unknowns()[:2],
        noise=1e-3,
        time=TIME,
        key=jax.random.key(1),
        lanes=2,
        path=path,
        progress=progress,
    )


def wait_after_three(progress):
    print(progress.done, flush=True)
    if progress.done == 3:
        time.sleep(600.0)


def stored_numbers(path):
    """Return the footprints in a file, read without the code under test."""
    with sqlite3.connect(path) as connection:
        numbers = {number for (number,) in connection.execute("SELECT number FROM entries")}
    connection.close()
    return numbers


# Another process runs this, with programs compiled as here: results are the same to the last bit.
KILLED_RUN = """
from tests.quick_compilation import optimise_programs

optimise_programs()

import tests.inversion.fit.test_checkpoint as t

t.run({path!r}, t.wait_after_three)
"""


@pytest.mark.slow
def test_a_run_that_was_killed_goes_on(tmp_path, monkeypatch):
    path = tmp_path / "fits.sqlite"
    code = KILLED_RUN.format(path=str(path))
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        assert [process.stdout.readline().strip() for _ in range(3)] == ["1", "2", "3"]
        with pytest.raises(OSError, match="is in use by another run"):
            run(path)
    finally:
        process.kill()
        process.communicate()
    # The lock went with its process. A copy, as the next run must find the file as the kill left it.
    shutil.copy(path, tmp_path / "copy.sqlite")
    finished = stored_numbers(tmp_path / "copy.sqlite")
    assert len(finished) == 3
    simulated, reports = set(), []
    evaluate = inversion.fit.retrieval_many.LockstepModel.__call__
    monkeypatch.setattr(
        "inversion.fit.retrieval_many.LockstepModel.__call__",
        lambda self, requests: (simulated.update(requests), evaluate(self, requests))[1],
    )
    resumed = run(path, reports.append)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["copy.sqlite", "fits.sqlite"]
    assert simulated == set(range(COUNT)) - finished
    assert [p.done for p in reports] == [4, 5, 6, 7]
    simulated.clear()
    from_file = run(path, lambda p: pytest.fail("a fit was repeated"))
    assert not simulated
    expected = run(None)
    for fits in (resumed, from_file):
        assert fits.status == expected.status
        for name in expected.values:
            np.testing.assert_array_equal(fits.values[name], expected.values[name])
        np.testing.assert_array_equal(fits.covariance, expected.covariance)
        np.testing.assert_array_equal(fits.fitted, expected.fitted)


def test_a_damaged_entry_is_fitted_again(tmp_path):
    path = tmp_path / "fits.sqlite"
    expected = run(path)
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE entries SET content = substr(content, 1, 900) WHERE number = 2")
    connection.close()
    reports = []
    with pytest.warns(UserWarning, match=r"fits\.sqlite is damaged, and .* again: entry 2 "):
        fits = run(path, reports.append)
    assert [p.done for p in reports] == [COUNT]
    np.testing.assert_array_equal(fits.values["height"], expected.values["height"])
    # It has been replaced: no warning.
    run(path, lambda p: pytest.fail("a fit was repeated"))


def test_a_full_disk_warns_once_and_results_are_returned(tmp_path, monkeypatch):
    """SQLite is told that its file may have no more than eight pages of 4 kB, later that more are allowed."""
    path, connect, connections = tmp_path / "fits.sqlite", sqlite3.connect, []

    def connect_to_small_disk(*args, **options):
        connection = connect(*args, **options)
        # The lock of the run is another file.
        if not str(args[0]).endswith(".lock"):
            connections.append(connection)
            connection.execute("PRAGMA max_page_count = 8")
        return connection

    expected = run(None)
    with monkeypatch.context() as patch:
        patch.setattr("jaxlidar.io.checkpoint.sqlite3.connect", connect_to_small_disk)
        with pytest.warns(UserWarning, match=r"fits\.sqlite could not be written \(.* full\)") as warned:
            fits = run(path)
    assert len(warned) == 1
    np.testing.assert_array_equal(fits.values["height"], expected.values["height"])
    assert 0 < len(stored_numbers(path)) < COUNT
    path.unlink()
    connections.clear()

    def make_room(progress):
        if progress.done == COUNT - 1:
            connections[0].execute("PRAGMA max_page_count = 1000")

    with monkeypatch.context() as patch:
        patch.setattr("jaxlidar.io.checkpoint.sqlite3.connect", connect_to_small_disk)
        with pytest.warns(UserWarning, match="could not be written"):
            run(path, make_room)
    assert stored_numbers(path) == set(range(COUNT))
