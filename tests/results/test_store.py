"""The store of long runs: rows are written atomically, by one run at a time; damage is found and named."""

import errno
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxlidar as jl

pytest.importorskip("zarr")

from jaxlidar.results.store import check_same_problem, dataset_of_rows, open_store

xarray = pytest.importorskip("xarray")

PROBLEM = {"observed": "a", "key": "b"}
COUNT, CHUNK = 7, 2


def rows_of(numbers):
    """Return the values of some rows: among them texts, infinite values, zeros, and no values at all."""
    n = np.asarray(numbers)
    return {
        "values": np.stack([0.5 + 0 * n, n, np.inf + 0 * n], axis=1),
        "is_even": n % 2 == 0,
        "status": [f"row {i} of λ" for i in n],
        "zeros": np.zeros((len(n), 4), np.float32),
        "nothing": np.zeros((len(n), 0)),
    }


def written(path, units=(), problem=PROBLEM):
    """Write the rows of some units of work. Return which rows are done, and their values."""
    with open_store(path, problem) as store:
        rows = store.rows("fits", "fit", COUNT, CHUNK)
        for unit in units:
            rows.write(np.array(unit), dataset_of_rows("fit", rows_of(unit)))
        done = np.flatnonzero(rows.is_done)
        return done.tolist(), rows.read(done)


def flip_a_bit(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@pytest.fixture
def path(tmp_path):
    """Path of a store with the rows 0, 1, 3 and 6."""
    written(tmp_path / "run.zarr", [(6, 0), (3,), (1,)])
    return tmp_path / "run.zarr"


def test_rows_are_read_as_they_were_written(path):
    done, values = written(path)
    assert done == [0, 1, 3, 6]
    assert values.keys() == rows_of(done).keys()
    for name, expected in rows_of(done).items():
        np.testing.assert_array_equal(values[name].tolist(), np.asarray(expected).tolist())
        assert values[name].dtype.kind in (np.asarray(expected).dtype.kind, "T", "O")
    done, values = written(path, [(2, 4, 5)])
    assert done == list(range(COUNT))
    np.testing.assert_array_equal(values["values"][:, 1], np.arange(COUNT))


def test_any_program_opens_a_store(path):
    data = xarray.open_zarr(path, group="fits", consolidated=False, chunks=None)
    assert data["values"].dims == ("fit", "values_1")
    assert data["done"].values.tolist() == [True, True, False, True, False, False, True]


def test_rows_may_lie_along_another_axis_and_variables_have_none(tmp_path):
    values, shots = np.arange(30.0).reshape(3, 2, 5), np.array([4, 1])
    dataset = xarray.Dataset(
        {
            "x": (("material", "shot", "time"), values, {"units": "J"}),
            "material": ("material", ["a", "b", "λ"]),
        },
        attrs={"title": "light"},
    )
    with open_store(tmp_path / "a.zarr", PROBLEM) as store:
        rows = store.rows("", "shot", COUNT, CHUNK)
        rows.write(shots, dataset)
        np.testing.assert_array_equal(rows.read(shots)["x"], values)
        assert store.damaged_arrays() == []
        flip_a_bit(tmp_path / "a.zarr" / "material" / "c" / "0")
        assert store.damaged_arrays() == ["material"]
    written = xarray.open_zarr(
        tmp_path / "a.zarr", consolidated=False, chunks=None, drop_variables="material"
    )
    assert written.x.sizes == {"material": 3, "shot": COUNT, "time": 5}
    assert written.x.attrs["units"] == "J"
    assert written.attrs["title"] == "light"


# -- damage ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("chunk", "damage", "left"),
    [
        ("values/c/0/0", flip_a_bit, [3, 6]),
        ("values/c/0/0", lambda chunk: chunk.write_bytes(chunk.read_bytes()[:-9]), [3, 6]),
        ("status/c/1", lambda chunk: chunk.write_bytes(b""), [0, 1, 6]),
        # It would be read as zeros, as which it was written.
        ("zeros/c/3/0", Path.unlink, [0, 1, 3]),
        # Row 4 is not done, but shares a chunk with row 5 that could not be written either.
        ("values/c/2/0", lambda chunk: chunk.write_bytes(b"damage"), [0, 1, 3, 6]),
        ("done/c/0", flip_a_bit, []),
    ],
)
def test_damaged_chunks_are_named_and_their_rows_written_again(path, chunk, damage, left):
    (path / "fits" / chunk).parent.mkdir(exist_ok=True)
    damage(path / "fits" / chunk)
    name, number = chunk.split("/")[0], chunk.split("/")[2]
    match = rf"run\.zarr is damaged, and .* computed again: chunk {number} of (fits/)?{name}$"
    with pytest.warns(UserWarning, match=match):
        assert written(path)[0] == left
    # That they are missing is stored: no warning.
    assert written(path)[0] == left
    done, values = written(path, [[4, *sorted({0, 1, 3, 6} - set(left))]])
    assert done == [0, 1, 3, 4, 6]
    np.testing.assert_array_equal(values["values"], rows_of(done)["values"])


def test_all_damaged_chunks_are_named_at_once(path):
    for number in (0, 1, 3):
        flip_a_bit(path / "fits" / "values" / "c" / str(number) / "0")
    with pytest.warns(UserWarning, match="chunk 0 .*, chunk 1 .*, chunk 3 ") as warned:
        assert written(path)[0] == []
    assert len(warned) == 1


def test_a_store_that_cannot_be_understood_is_refused(path):
    (path / "fits" / "values" / "zarr.json").write_text("{")
    with pytest.raises(ValueError, match=r"path = .*run\.zarr is damaged: "):
        written(path)
    (path / "zarr.json").write_text("{")
    with pytest.raises(ValueError, match=r"path = .*run\.zarr is damaged: "):
        written(path)
    (path / "zarr.json").unlink()
    with pytest.raises(ValueError, match=r"run\.zarr: it is there already and no Zarr store"):
        written(path)


# -- stores of another problem, and paths that are none ----------------------------------------------------


def test_another_problem_is_refused_and_the_message_names_what_differs(path):
    with pytest.raises(
        ValueError, match=r"run\.zarr holds results of another problem, which differs in key; nothing is"
    ):
        written(path, problem=PROBLEM | {"key": "c"})
    assert written(path)[0] == [0, 1, 3, 6]


@pytest.mark.parametrize(
    ("stored", "differing"),
    [
        ({"a": "1", "b": "3"}, "b"),
        ({"a": "3", "b": "3"}, "a, b"),
        # A quantity that only one of the problems has is named if all common ones are equal.
        ({"a": "1", "b": "3", "c": "1"}, "b"),
        ({"a": "1", "b": "2", "c": "1"}, "c"),
        ({}, "a, b"),
    ],
)
def test_differing_quantities_of_problems_are_named(stored, differing):
    problem = {"a": "1", "b": "2"}
    check_same_problem("path", problem, problem)
    with pytest.raises(ValueError, match=rf"path = path holds .* which differs in {differing}; "):
        check_same_problem("path", stored, problem)


def test_stores_of_runs_are_not_replaced_by_results(path):
    wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    with pytest.raises(ValueError, match=r"run\.zarr is the store of a run that has not ended; nothing is"):
        wave.save(path)
    with open_store(path, PROBLEM), pytest.raises(OSError, match=r"run\.zarr is in use by another run"):
        wave.save(path)
    written(path, [range(COUNT)])
    wave.save(path)
    assert np.array_equal(jl.open(path).reflectance, wave.reflectance)
    with pytest.raises(ValueError, match="not written by a run that could go on, but by save"):
        written(path)


def test_the_store_of_a_run_without_rows_yet_is_not_replaced(tmp_path):
    """A run locks its store and names its problem before it knows its arrays, and may be killed there."""
    with open_store(tmp_path / "run.zarr", PROBLEM):
        pass
    wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    with pytest.raises(ValueError, match=r"run\.zarr is the store of a run that has not ended; nothing is"):
        wave.save(tmp_path / "run.zarr")
    assert written(tmp_path / "run.zarr", [(0,)])[0] == [0]


def test_a_store_without_the_array_of_complete_rows_is_not_read(path):
    shutil.rmtree(path / "fits" / "done")
    with pytest.raises(ValueError, match=r"run\.zarr: damaged \(no array 'done'"):
        jl.open(path)


@pytest.mark.parametrize("name", ["run.nc", "run.sqlite", "run"])
def test_other_files_are_refused_with_a_hint(tmp_path, name):
    with pytest.raises(ValueError, match=r"path = .*run.* admissible is .* such as run\.zarr.*method save"):
        written(tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_missing_folders_are_made_and_other_folders_stay(tmp_path):
    assert written(tmp_path / "a" / "b" / "run.zarr", [(0,)])[0] == [0]
    (tmp_path / "thesis.zarr").mkdir()
    (tmp_path / "thesis.zarr" / "thesis.txt").write_text("years of work")
    with pytest.raises(ValueError, match=r"thesis.zarr: it is there already and no Zarr store; nothing is"):
        written(tmp_path / "thesis.zarr")
    assert len(list((tmp_path / "thesis.zarr").iterdir())) == 1


def unwritable(kind, folder):
    """Return a path that cannot be written."""
    if kind == "a file for a folder":
        (folder / "file").write_text("")
        return folder / "file" / "run.zarr"
    if kind == "a system's folder":
        if not Path("/proc/self").is_dir():
            pytest.skip("this system has no /proc")
        return Path("/proc/self/run.zarr")
    if not hasattr(os, "geteuid") or os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    (folder / "closed").mkdir(mode=0o500)
    return folder / "closed" / "run.zarr"


UNWRITABLE = ["a file for a folder", "a system's folder", "a closed folder"]


@pytest.mark.parametrize("kind", UNWRITABLE)
def test_a_path_that_cannot_be_written_is_refused(tmp_path, kind):
    with pytest.raises(OSError, match=r"path = .* cannot be written: "):
        written(unwritable(kind, tmp_path))


# -- two writers, kills, full disks ------------------------------------------------------------------------


def test_one_run_at_a_time_uses_a_store(path):
    in_use = pytest.raises(OSError, match=r"run\.zarr is in use by another run: wait until")
    with open_store(path, PROBLEM), in_use:
        written(path)
    assert written(path, [(4,)])[0] == [0, 1, 3, 4, 6]


def write_rows(path):
    """Write one row after the other, and print its number. Another process calls this."""
    with open_store(path, PROBLEM) as store:
        rows = store.rows("fits", "fit", 10**4, 16)
        for number in range(10**4):
            rows.write(slice(number, number + 1), dataset_of_rows("fit", rows_of([number])))
            print(number, flush=True)


def test_a_kill_loses_at_most_the_row_in_flight(tmp_path):
    """The kill comes at a random moment. Rows that were reported are there, and the lock is gone."""
    path = tmp_path / "run.zarr"
    code = f"import test_store as t; t.write_rows({str(path)!r})"
    process = subprocess.Popen(
        [sys.executable, "-c", code], cwd=Path(__file__).parent, stdout=subprocess.PIPE, text=True
    )
    try:
        lines = [process.stdout.readline() for _ in range(20)]
        with pytest.raises(OSError, match="is in use by another run"):
            written(path)
    finally:
        process.kill()
        lines += process.communicate()[0].splitlines(keepends=True)
    # The last line may have been cut.
    reported = [int(line) for line in lines if line.endswith("\n")]
    assert reported[:20] == list(range(20))
    with open_store(path, PROBLEM) as store:
        rows = store.rows("fits", "fit", 10**4, 16)
        done = np.flatnonzero(rows.is_done).tolist()
        assert done in (reported, [*reported, len(reported)])
        np.testing.assert_array_equal(rows.read(np.array(done))["values"], rows_of(done)["values"])


@pytest.mark.parametrize("fails_at", range(5))
def test_a_full_disk_loses_nothing_that_was_written(path, monkeypatch, fails_at):
    """Writing fails at every array in turn; row 0 shares its chunk with row 1, which is there."""
    from zarr.storage import _local

    put, calls = _local._atomic_write, []

    def put_on_a_full_disk(*args, **options):
        calls.append(args)
        if len(calls) > fails_at:
            raise OSError(errno.ENOSPC, "No space left on device")
        return put(*args, **options)

    with open_store(path, PROBLEM) as store:
        rows = store.rows("fits", "fit", COUNT, CHUNK)
        with monkeypatch.context() as patch:
            patch.setattr(_local, "_atomic_write", put_on_a_full_disk)
            with pytest.raises(OSError, match=r"run\.zarr could not be written \(.*No space left"):
                rows.write(slice(2, 3), dataset_of_rows("fit", rows_of([2])))
        assert np.flatnonzero(rows.is_done).tolist() == [0, 1, 3, 6]
    done, values = written(path)
    assert done == [0, 1, 3, 6]
    np.testing.assert_array_equal(values["values"], rows_of(done)["values"])
    # There is room again.
    assert written(path, [(2,)])[0] == [0, 1, 2, 3, 6]


def test_writing_a_row_takes_little_time(tmp_path):
    """Some ten milliseconds, however many rows there are; the limit leaves a wide margin."""
    with open_store(tmp_path / "run.zarr", PROBLEM) as store:
        rows, start = store.rows("fits", "fit", 10**4, 16), time.perf_counter()
        for number in range(20):
            rows.write(slice(number, number + 1), dataset_of_rows("fit", rows_of([number])))
        assert time.perf_counter() - start < 20 * 0.5
