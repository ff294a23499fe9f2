"""Stored fits of `retrieve_many`: kills, damage and full disks lose no other fit, and runs go on."""

import errno
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
import zarr

import inversion
import jaxlidar as jl
from inversion.fit.fit_summary import FitSummary
from inversion.fit.retrieval_many import FinishedFits
from jaxlidar.results.store import StoredRows, open_store
from tests.helpers import ask
from tests.inversion.fit.test_fingerprint import PROBLEM, TIME, unknowns
from tests.results.test_store import UNWRITABLE, flip_a_bit, unwritable

ROOT = Path(__file__).resolve().parents[3]


def test_fits_are_read_as_they_were_written(tmp_path):
    """Numbers, texts, infinite values and arrays without values; a failed fit need not be finite."""

    def fit(number):
        return FitSummary(
            values=np.array([0.5, number]),
            stderr=np.array([0.1, np.inf]),
            robust_stderr=np.array([0.2, np.inf]),
            prior_share=np.array([0.0, 1.0]),
            at_bound=np.array([False, True]),
            covariance=np.diag([0.01, np.inf]),
            averaging=np.diag([0.9, 0.0]),
            reduced_chi2=1.25 if number else np.nan,
            independent_samples=17.5,
            second_minimum=np.inf,
            strength=np.zeros(0),
            converged=number > 0,
            status="converged after 4 simulations; the data do not determine λ"[number:],
            steps=4,
            simulation_error=np.array([0.01, 0.0]),
            residuals=np.linspace(-2.0, 2.0, 30)[None],
            fitted=np.linspace(0.0, 1.0, 30)[None],
        )

    for numbers in ((0, 3, 1), ()):
        with open_store(tmp_path / "fits.zarr", {"key": "a"}) as store:
            finished = FinishedFits(store, 5)
            for number in numbers:
                finished.add(number, fit(number))
    assert sorted(finished.summaries) == [0, 1, 3]
    for number, summary in finished.summaries.items():
        for name, value in vars(fit(number)).items():
            assert type(value) is type(getattr(summary, name))
            np.testing.assert_array_equal(getattr(summary, name), value)


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
    """Return the footprints in a store, read without the code under test."""
    return set(np.flatnonzero(zarr.open_array(path / "done", mode="r")[:]).tolist())


# Another process runs this, with programs compiled as here: results are the same to the last bit.
KILLED_RUN = """
from tests.quick_compilation import optimise_programs

optimise_programs()

import tests.inversion.fit.test_stored_fits as t

t.run({path!r}, t.wait_after_three)
"""


@pytest.mark.slow
def test_a_run_that_was_killed_goes_on(tmp_path, monkeypatch):
    path = tmp_path / "fits.zarr"
    code = KILLED_RUN.format(path=str(path))
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        assert [process.stdout.readline().strip() for _ in range(3)] == ["1", "2", "3"]
        with pytest.raises(OSError, match="is in use by another run"):
            run(path)
    finally:
        process.kill()
        process.communicate()
    # The lock went with its process.
    finished = stored_numbers(path)
    assert len(finished) == 3
    simulated, reports = set(), []
    evaluate = inversion.fit.retrieval_many.LockstepModel.__call__
    monkeypatch.setattr(
        "inversion.fit.retrieval_many.LockstepModel.__call__",
        lambda self, requests: (simulated.update(requests), evaluate(self, requests))[1],
    )
    resumed = run(path, reports.append)
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


def test_fits_of_a_damaged_chunk_are_repeated(tmp_path, monkeypatch):
    monkeypatch.setattr("inversion.fit.retrieval_many._FITS_PER_CHUNK", 3)
    path = tmp_path / "fits.zarr"
    expected = run(path)
    flip_a_bit(path / "covariance" / "c" / "1" / "0" / "0")
    reports = []
    with pytest.warns(UserWarning, match=r"fits\.zarr is damaged, .* computed again: chunk 1 of covariance$"):
        fits = run(path, reports.append)
    assert [p.done for p in reports] == [5, 6, 7]
    np.testing.assert_array_equal(fits.values["height"], expected.values["height"])
    # It has been replaced: no warning.
    run(path, lambda p: pytest.fail("a fit was repeated"))
    opened = jl.open(path)
    assert jax.tree.structure(opened) == jax.tree.structure(fits)
    jax.tree.map(np.testing.assert_array_equal, opened, fits)


def test_a_full_disk_warns_once_and_results_are_returned(tmp_path, monkeypatch):
    path, write = tmp_path / "fits.zarr", StoredRows.write
    expected, has_room = run(None), [True, True, False, False, False, False]

    def write_if_there_is_room(self, rows, values):
        # Of the last fit, after two attempts for that before.
        if has_room and not has_room.pop(0):
            raise OSError(errno.ENOSPC, "no space left on device")
        write(self, rows, values)

    monkeypatch.setattr(StoredRows, "write", write_if_there_is_room)
    stored = []
    with pytest.warns(UserWarning, match="no space left on device. The fits go on") as warned:
        fits = run(path, lambda progress: stored.append(len(stored_numbers(path))))
    assert len(warned) == 1
    np.testing.assert_array_equal(fits.values["height"], expected.values["height"])
    # All that could not be written is, once there is room.
    assert stored == [1, 2, 2, 2, 2, 2, COUNT]
