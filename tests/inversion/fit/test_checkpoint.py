"""Checkpoints: damage, locks and closed folders are said; kills and full disks lose nothing that was done."""

import dataclasses
import os
import shutil
import sqlite3
import subprocess
import sys
import time as clock
from pathlib import Path

import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion.fit.checkpoint import Frame, Row, kept_fits
from tests.inversion.fit.test_fingerprint import PROBLEM, TIME, unknowns

# -- the file: damage, locks, and where it cannot be written ----------------------------------------------

FRAME = Frame(fits=5, unknowns=2, waveform=(1, 30))
PARTS = {"observed": "a", "key": "b"}


def row(number, **changes):
    made = Row(
        values=np.array([0.5, number]),
        stderr=np.array([0.1, np.inf]),
        robust_stderr=np.array([0.2, np.inf]),
        prior_share=np.array([0.0, 1.0]),
        at_bound=np.array([False, True]),
        covariance=np.diag([0.01, np.inf]),
        reduced_chi2=1.25,
        second_minimum=np.inf,
        independent_samples=17.5,
        averaging=np.diag([0.9, 0.0]),
        strength=np.zeros(0),
        converged=True,
        steps=4,
        fitted=np.linspace(0.0, 1.0, 30)[None],
        status="converged after 4 simulations; the data do not determine λ",
    )
    return dataclasses.replace(made, **changes)


def kept(path, *rows, parts=PARTS, frame=FRAME):
    """Open the file and add rows; all rows that it has then."""
    with kept_fits(path, parts, frame) as file:
        for number, more in rows:
            file.add(number, more)
        return dict(file.rows)


@pytest.fixture
def path(tmp_path):
    """A file of three fits."""
    path = tmp_path / "fits.sqlite"
    kept(path, *((i, row(i)) for i in (0, 3, 1)))
    return path


def test_rows_come_back_as_they_were(path):
    found = kept(path)
    assert sorted(found) == [0, 1, 3]
    for number, got in found.items():
        for name, value in vars(row(number)).items():
            assert type(value) is type(getattr(got, name))
            np.testing.assert_array_equal(getattr(got, name), value)


def sql(command, *values):
    def damage(path):
        with sqlite3.connect(path) as file:
            file.execute(command, values)
        file.close()

    return damage


def holds(**changes):
    """Fit 1 is replaced by another."""

    def damage(path):
        with kept_fits(path, PARTS, FRAME) as file:
            file._file.execute("DELETE FROM fits WHERE number = 1")
            file.add(1, row(1, **changes))

    return damage


def cut(size):
    return lambda path: path.write_bytes(path.read_bytes()[:size])


def flipped(path):
    content = bytearray(path.read_bytes())
    content[content.index(np.linspace(0.0, 1.0, 30).tobytes()) + 100] ^= 1
    path.write_bytes(content)


def an_archive(path):
    with path.open("wb") as file:
        np.savez(file, number=np.arange(3))


def another_database(path):
    path.unlink()
    sql("CREATE TABLE trees (height REAL)")(path)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (cut(-4096), "damaged"),
        (cut(6000), "damaged"),
        (cut(50), "damaged"),
        (flipped, "damaged: fit .: Bad CRC"),
        (lambda path: path.write_text("not fits"), "damaged or no file of fits: file is not a database"),
        (an_archive, "damaged or no file of fits: file is not a database"),
        (another_database, "no file of fits, but another SQLite database"),
        (sql("DROP TABLE fits"), "damaged or no file of fits: no such table"),
        (sql("UPDATE fits SET number = 5 WHERE number = 3"), r"damaged: fit 5: .* range \[0, 4\]"),
        (sql("UPDATE fits SET number = -1 WHERE number = 3"), r"damaged: fit -1: .* range \[0, 4\]"),
        (sql("UPDATE fits SET fit = 'gone' WHERE number = 3"), "damaged: fit 3"),
        (sql("UPDATE fits SET fit = substr(fit, 1, 900) WHERE number = 3"), "damaged: fit 3"),
        (holds(values=np.ones(3)), r"damaged: fit 1: values is float64 of the shape \(3,\); .* \(2,\)"),
        (holds(covariance=np.ones(2)), "damaged: fit 1: covariance is"),
        (holds(fitted=np.ones((1, 29))), "damaged: fit 1: fitted is"),
        (holds(steps=0), "damaged: fit 1: .* after 0 steps"),
        (holds(values=np.array([np.nan, 1.0])), "damaged: fit 1: values = .*nan"),
        (holds(reduced_chi2=np.nan), "damaged: fit 1: .* not finite"),
        (holds(fitted=np.full((1, 30), np.inf)), "damaged: fit 1: .* not finite"),
        (holds(stderr=np.array([0.1, np.nan])), "damaged: fit 1: .* not finite"),
        (holds(stderr=np.array([0.1, -1.0])), "damaged: fit 1: .* not finite"),
        (holds(covariance=np.full((2, 2), np.nan)), "damaged: fit 1: .* not finite"),
    ],
)
def test_damage_is_refused_and_left_as_it_is(path, damage, words):
    damage(path)
    before = path.read_bytes()
    with pytest.raises(ValueError, match=rf"path = .*fits\.sqlite is {words}"):
        kept(path)
    assert path.read_bytes() == before


def test_a_failed_fit_need_not_be_finite(path):
    nothing = {"reduced_chi2": np.nan, "fitted": np.full((1, 30), np.nan), "stderr": np.full(2, np.inf)}
    kept(path, (2, row(2, converged=False, status="failed: not finite", **nothing)))
    assert np.isnan(kept(path)[2].reduced_chi2)


def test_a_file_is_used_by_one_run_at_a_time(path):
    with kept_fits(path, PARTS, FRAME) as file:
        with pytest.raises(OSError, match=r"fits\.sqlite is in use by another run: wait until"):
            kept(path)
        file.add(4, row(4))
    assert sorted(kept(path)) == [0, 1, 3, 4]


def unwritable(kind, folder):
    if kind == "a file for a folder":
        (folder / "file").write_text("")
        return folder / "file" / "fits.sqlite"
    if kind == "a folder for a file":
        return folder
    if kind == "a system's folder":
        if not Path("/proc/self").is_dir():
            pytest.skip("this system has no /proc")
        return Path("/proc/self/fits.sqlite")
    if not hasattr(os, "geteuid") or os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    (folder / "closed").mkdir(mode=0o500)
    return folder / "closed" / "fits.sqlite"


KINDS = ["a file for a folder", "a folder for a file", "a system's folder", "a closed folder"]


@pytest.mark.parametrize("kind", KINDS)
def test_what_cannot_be_written_is_found_before_the_work(tmp_path, monkeypatch, kind):
    monkeypatch.setattr("inversion.fit.job.Simulator", lambda *_: pytest.fail("the work began"))
    with pytest.raises(OSError, match=r"path = .* cannot be written: "):
        inversion.retrieve_many(**PROBLEM | {"path": unwritable(kind, tmp_path)})


def test_missing_folders_are_made_and_names_mean_nothing_to_sqlite(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kept("a/b/fits", (0, row(0)))
    kept(":memory:", (0, row(0)))
    assert sorted(kept("a/b/fits")) == sorted(kept(":memory:")) == [0]


def test_no_file_is_none():
    assert sorted(kept(None, (0, row(0)))) == [0]


def test_keeping_a_fit_costs_little(tmp_path):
    """Some milliseconds, whatever is in the file already; here with much to spare."""
    frame = Frame(1000, 2, (1, 30))
    with kept_fits(tmp_path / "fits.sqlite", PARTS, frame) as file:
        begun = clock.perf_counter()
        for i in range(20):
            file.add(i, row(i))
        assert clock.perf_counter() - begun < 20 * 0.5


# -- runs: full disks and kills ---------------------------------------------------------------------------

COUNT = 7


def waves():
    """Echoes of flat ground at several heights, of some brightness, with a little noise."""
    deep = TIME + 2 * np.linspace(-0.5, 0.5, COUNT)[:, None] / 0.299792458
    echo = np.exp(-0.5 * (deep / 2.55) ** 2)
    wave = np.linspace(0.2, 0.5, COUNT)[:, None] * echo / echo.sum(axis=1, keepdims=True)
    return (wave + 1e-3 * np.random.default_rng(0).normal(size=wave.shape))[:, None]


def run(path, progress=None):
    """Fits of a ground that is simulated quickly. It is called by another process too."""
    return inversion.retrieve_many(
        waves(),
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
        clock.sleep(600.0)


MANY = Frame(fits=10**6, unknowns=2, waveform=(1, 30))


def keep_on(path):
    """Keep one fit after the other. It is called by another process."""
    with kept_fits(path, PARTS, MANY) as file:
        for number in range(MANY.fits):
            file.add(number, row(number))
            print(number, flush=True)


def test_a_kill_loses_what_was_in_flight_at_most(tmp_path):
    """It comes at no particular moment; what was said to be kept is kept, and the lock is gone."""
    path = tmp_path / "fits.sqlite"
    code = f"import test_checkpoint as t; t.keep_on({str(path)!r})"
    other = subprocess.Popen(
        [sys.executable, "-c", code], cwd=Path(__file__).parent, stdout=subprocess.PIPE, text=True
    )
    try:
        said = [other.stdout.readline() for _ in range(3)]
        with pytest.raises(OSError, match="is in use by another run"):
            kept(path, frame=MANY)
    finally:
        other.kill()
        said += other.communicate()[0].splitlines(keepends=True)
    done = [int(line) for line in said if line.endswith("\n")]
    found = kept(path, frame=MANY)
    assert done[:3] == [0, 1, 2]
    assert sorted(found) in (done, [*done, len(done)])
    np.testing.assert_array_equal(found[2].fitted, row(2).fitted)


@pytest.mark.slow
def test_a_run_that_was_killed_goes_on(tmp_path, monkeypatch):
    path = tmp_path / "fits.sqlite"
    code = f"import test_checkpoint as t; t.run({str(path)!r}, t.wait_after_three)"
    other = subprocess.Popen(
        [sys.executable, "-c", code], cwd=Path(__file__).parent, stdout=subprocess.PIPE, text=True
    )
    try:
        assert [other.stdout.readline().strip() for _ in range(3)] == ["1", "2", "3"]
        with pytest.raises(OSError, match="is in use by another run"):
            run(path)
    finally:
        other.kill()
        other.communicate()
    # The lock went with its process.
    shutil.copy(path, tmp_path / "copy.sqlite")
    with sqlite3.connect(tmp_path / "copy.sqlite") as file:
        finished = {number for (number,) in file.execute("SELECT number FROM fits")}
    file.close()
    assert len(finished) == 3
    simulated, seen = set(), []
    call = inversion.fit.lanes.Simulator.__call__
    monkeypatch.setattr(
        "inversion.fit.lanes.Simulator.__call__",
        lambda self, asked: (simulated.update(asked), call(self, asked))[1],
    )
    resumed = run(path, seen.append)
    assert simulated == set(range(COUNT)) - finished
    assert [p.done for p in seen] == [4, 5, 6, 7]
    simulated.clear()
    again = run(path, lambda p: pytest.fail("a fit was repeated"))
    assert not simulated
    whole = run(None)
    for found in (resumed, again):
        assert found.status == whole.status
        for name in whole.values:
            np.testing.assert_array_equal(found.values[name], whole.values[name])
        np.testing.assert_array_equal(found.covariance, whole.covariance)
        np.testing.assert_array_equal(found.fitted, whole.fitted)


def test_a_full_disk_warns_once_and_results_come_back(tmp_path, monkeypatch):
    """SQLite is told that its file may have no more than eight pages, later that more are."""
    path, connect, files = tmp_path / "fits.sqlite", sqlite3.connect, []

    def tight(*args, **more):
        files.append(connect(*args, **more))
        files[0].execute("PRAGMA max_page_count = 8")
        return files[0]

    def count(path):
        with sqlite3.connect(path) as file:
            (number,) = file.execute("SELECT count(*) FROM fits").fetchone()
        file.close()
        return number

    whole = run(None)
    with monkeypatch.context() as patch:
        patch.setattr("inversion.fit.checkpoint.sqlite3.connect", tight)
        with pytest.warns(UserWarning, match=r"fits\.sqlite could not be written \(.* full\)") as warned:
            found = run(path)
    assert len(warned) == 1
    np.testing.assert_array_equal(found.values["height"], whole.values["height"])
    kept_then = count(path)
    assert 0 < kept_then < COUNT
    path.unlink()
    files.clear()

    def make_room(progress):
        if progress.done == COUNT - 1:
            files[0].execute("PRAGMA max_page_count = 1000")

    with monkeypatch.context() as patch:
        patch.setattr("inversion.fit.checkpoint.sqlite3.connect", tight)
        with pytest.warns(UserWarning, match="could not be written"):
            run(path, make_room)
    assert count(path) == COUNT
