"""Checkpoints: entries are written atomically, a file is locked, and damaged or foreign files are refused."""

import contextlib
import os
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jaxlidar.io.checkpoint import check_same_problem, open_checkpoint

PROBLEM = {"observed": "a", "key": "b"}


def entry(number):
    """Return the arrays of an entry, among them a string, an infinite value and an empty array."""
    return {
        "values": np.array([0.5, number, np.inf]),
        "converged": np.array(number % 2 == 0),
        "status": np.array("converged; the data do not determine λ"),
        "strength": np.zeros(0),
        "fitted": np.linspace(0.0, 1.0, 30)[None],
    }


def decode(number, arrays):
    """Check an entry as a user of the checkpoint would."""
    if not 0 <= number < 5:
        raise ValueError("its number is outside the admissible range [0, 4]")
    if arrays.keys() != entry(0).keys():
        raise ValueError(f"it has {', '.join(arrays)}")
    return arrays


def intact(path, problem=PROBLEM):
    """Return the intact entries of a file."""
    with open_checkpoint(path, problem) as checkpoint:
        return dict(checkpoint.intact_entries(decode))


@pytest.fixture
def path(tmp_path):
    """Path of a checkpoint with the entries 0, 1 and 3."""
    path = tmp_path / "run.sqlite"
    with open_checkpoint(path, PROBLEM) as checkpoint:
        for number in (0, 3, 1):
            checkpoint.add(number, entry(number))
    return path


def test_entries_are_read_as_they_were_written(path):
    entries = intact(path)
    assert sorted(entries) == [0, 1, 3]
    for number, arrays in entries.items():
        for name, array in entry(number).items():
            assert arrays[name].dtype == array.dtype
            np.testing.assert_array_equal(arrays[name], array)
    with open_checkpoint(path, PROBLEM) as checkpoint:
        assert checkpoint.numbers() == [0, 1, 3]
        np.testing.assert_array_equal(checkpoint.read(3)["values"], entry(3)["values"])


def test_large_entries_are_stored_in_pieces(path, monkeypatch):
    monkeypatch.setattr("jaxlidar.io.checkpoint._PIECE_BYTES", 100)
    with open_checkpoint(path, PROBLEM) as checkpoint:
        checkpoint.add(2, entry(2))
        checkpoint.add(2, entry(4))
    with sqlite3.connect(path) as connection:
        (n_pieces,) = connection.execute("SELECT count(*) FROM entries WHERE number = 2").fetchone()
    connection.close()
    assert n_pieces > 10
    np.testing.assert_array_equal(intact(path)[2]["values"], entry(4)["values"])


# -- damage ----------------------------------------------------------------------------------------------


def sql(command, *values):
    """Return a function that changes a file by a command of SQL."""

    def damage(path):
        with sqlite3.connect(path) as connection:
            connection.execute(command, values)
        connection.close()

    return damage


def truncated(size):
    return lambda path: path.write_bytes(path.read_bytes()[:size])


def archive(path):
    with path.open("wb") as file:
        np.savez(file, number=np.arange(3))


def another_database(path):
    path.unlink()
    sql("CREATE TABLE trees (height REAL)")(path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (truncated(-4096), "damaged"),
        (truncated(6000), "damaged"),
        (truncated(50), "damaged"),
        (lambda path: path.write_text("text"), "damaged or no checkpoint: file is not a database"),
        (archive, "damaged or no checkpoint: file is not a database"),
        (another_database, "no checkpoint, but another SQLite database"),
        (sql("DROP TABLE entries"), "damaged or no checkpoint: no such table"),
    ],
)
def test_a_damaged_file_is_refused_and_left_as_it_is(path, damage, message):
    damage(path)
    before = path.read_bytes()
    with pytest.raises(ValueError, match=rf"path = .*run\.sqlite is {message}"):
        intact(path)
    assert path.read_bytes() == before


def flip_a_bit(path):
    content = bytearray(path.read_bytes())
    content[content.index(np.linspace(0.0, 1.0, 30).tobytes()) + 100] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (flip_a_bit, r"entry \d \(Bad CRC"),
        (sql("UPDATE entries SET number = 5 WHERE number = 3"), r"entry 5 \(.* range \[0, 4\]"),
        (sql("UPDATE entries SET number = -1 WHERE number = 3"), r"entry -1 \(.* range \[0, 4\]"),
        (sql("UPDATE entries SET content = 'text' WHERE number = 3"), "entry 3 "),
        (sql("UPDATE entries SET content = substr(content, 1, 900) WHERE number = 3"), "entry 3 "),
    ],
)
def test_damaged_entries_are_named_and_can_be_replaced(path, damage, message):
    damage(path)
    with pytest.warns(UserWarning, match=rf"run\.sqlite is damaged, and .* computed again: {message}"):
        entries = intact(path)
    (damaged,) = {0, 1, 3} - entries.keys()
    with open_checkpoint(path, PROBLEM) as checkpoint:
        if damaged in checkpoint.numbers():
            with pytest.raises(ValueError, match=rf"is damaged: entry {damaged}: "):
                checkpoint.read(damaged)
        checkpoint.add(damaged, entry(damaged))
        np.testing.assert_array_equal(checkpoint.read(damaged)["values"], entry(damaged)["values"])


def test_all_damaged_entries_are_named_at_once(path):
    sql("UPDATE entries SET content = 'text'")(path)
    with pytest.warns(UserWarning, match=r"entry 0 .*; entry 1 .*; entry 3 ") as warned:
        assert intact(path) == {}
    assert len(warned) == 1


# -- checkpoints of another problem -----------------------------------------------------------------------


def test_another_problem_is_refused_and_the_message_names_what_differs(path):
    before = path.read_bytes()
    with pytest.raises(
        ValueError, match=r"run\.sqlite holds results of another problem, which differs in key; nothing is"
    ):
        intact(path, PROBLEM | {"key": "c"})
    assert path.read_bytes() == before


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


# -- locks and files that cannot be written --------------------------------------------------------------


def test_one_process_at_a_time_uses_a_file(path):
    with open_checkpoint(path, PROBLEM) as checkpoint:
        with pytest.raises(OSError, match=r"run\.sqlite is in use by another run: wait until"):
            intact(path)
        checkpoint.add(4, entry(4))
    assert sorted(intact(path)) == [0, 1, 3, 4]


def test_a_run_that_ends_while_another_begins_leaves_it_a_file(path, monkeypatch):
    """The second run opens a file just before the first removes it: it must not go on with that file."""
    connect, first_run = sqlite3.connect, contextlib.ExitStack()
    first = first_run.enter_context(open_checkpoint(path, PROBLEM))

    def connect_and_end_the_first_run(*args, **options):
        connection = connect(*args, **options)
        monkeypatch.undo()
        first.remove()
        first_run.close()
        return connection

    monkeypatch.setattr("jaxlidar.io.checkpoint.sqlite3.connect", connect_and_end_the_first_run)
    with open_checkpoint(path, PROBLEM) as second:
        second.add(2, entry(2))
        with pytest.raises(OSError, match="is in use by another run"):
            intact(path)
    assert [p.name for p in path.parent.iterdir()] == ["run.sqlite"]
    assert sorted(intact(path)) == [2]


def use_briefly(path, seconds):
    """Open the file again and again, and remove it every other time; print the outcomes."""
    outcomes, start = set(), time.perf_counter()
    while time.perf_counter() - start < seconds:
        try:
            with open_checkpoint(path, PROBLEM) as checkpoint:
                checkpoint.add(0, entry(0))
                if len(checkpoint.numbers()) and time.perf_counter_ns() % 2:
                    checkpoint.remove()
            outcomes.add("done")
        except Exception as error:
            outcomes.add(f"{type(error).__name__}: {error}")
    print("\n".join(sorted(outcomes)))


@pytest.mark.slow
def test_processes_that_begin_and_end_at_once_are_refused_or_done(tmp_path):
    """A file that another process was removing was read-only or missing, some ten times in 20 s."""
    path = tmp_path / "run.sqlite"
    code = f"import test_checkpoint as t; t.use_briefly({str(path)!r}, 20.0)"
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", code], cwd=Path(__file__).parent, stdout=subprocess.PIPE, text=True
        )
        for _ in range(3)
    ]
    outcomes = {line for process in processes for line in process.communicate()[0].splitlines()}
    in_use = f"OSError: path = {path} is in use by another run: wait until it has ended, or give another path"
    assert outcomes == {"done", in_use}


def test_a_file_can_be_removed_when_its_run_has_ended(path):
    with open_checkpoint(path, PROBLEM) as checkpoint:
        checkpoint.remove()
    assert list(path.parent.iterdir()) == []


def unwritable(kind, folder):
    """Return a path that cannot be written."""
    if kind == "a file for a folder":
        (folder / "file").write_text("")
        return folder / "file" / "run.sqlite"
    if kind == "a folder for a file":
        return folder
    if kind == "a system's folder":
        if not Path("/proc/self").is_dir():
            pytest.skip("this system has no /proc")
        return Path("/proc/self/run.sqlite")
    if not hasattr(os, "geteuid") or os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    (folder / "closed").mkdir(mode=0o500)
    return folder / "closed" / "run.sqlite"


UNWRITABLE = ["a file for a folder", "a folder for a file", "a system's folder", "a closed folder"]


@pytest.mark.parametrize("kind", UNWRITABLE)
def test_a_path_that_cannot_be_written_is_refused(tmp_path, kind):
    with pytest.raises(OSError, match=r"path = .* cannot be written: "):
        intact(unwritable(kind, tmp_path))


def test_missing_folders_are_made_and_memory_is_an_ordinary_name(tmp_path, monkeypatch):
    """To SQLite, ":memory:" is a database in memory; here it is the name of a file."""
    monkeypatch.chdir(tmp_path)
    for path in ("a/b/run", ":memory:"):
        with open_checkpoint(path, PROBLEM) as checkpoint:
            checkpoint.add(0, entry(0))
        assert sorted(intact(path)) == [0]


def test_a_full_disk_keeps_entries_in_memory_until_there_is_room(tmp_path, monkeypatch):
    """SQLite limits the file to eight pages of 4 kB, which stands for a full disk, and later to more."""
    path, connect, connections = tmp_path / "run.sqlite", sqlite3.connect, []

    def connect_to_small_disk(*args, **options):
        connection = connect(*args, **options)
        # The lock of the run is another file.
        if not str(args[0]).endswith(".lock"):
            connections.append(connection)
            connection.execute("PRAGMA max_page_count = 8")
        return connection

    monkeypatch.setattr("jaxlidar.io.checkpoint.sqlite3.connect", connect_to_small_disk)
    large = [{"values": number + np.zeros(1000)} for number in range(5)]
    with open_checkpoint(path, PROBLEM) as checkpoint:
        checkpoint.add(0, large[0])
        for number in (3, 4):
            with pytest.raises(OSError, match=r"could not be written \(database or disk is full\)"):
                checkpoint.add(number, large[number] | {"more": np.zeros(3000)})
        # Entries 3 and 4, which could not be written, are read from memory.
        assert checkpoint.numbers() == [0, 3, 4]
        for number in (0, 3, 4):
            np.testing.assert_array_equal(checkpoint.read(number)["values"], large[number]["values"])
        connections[0].execute("PRAGMA max_page_count = 1000")
        checkpoint.add(2, large[2])
    monkeypatch.undo()
    with open_checkpoint(path, PROBLEM) as checkpoint:
        assert checkpoint.numbers() == [0, 2, 3, 4]


def test_adding_an_entry_takes_little_time(tmp_path):
    """Some milliseconds, however many entries the file has; the limit leaves a wide margin."""
    with open_checkpoint(tmp_path / "run.sqlite", PROBLEM) as checkpoint:
        start = time.perf_counter()
        for number in range(20):
            checkpoint.add(number, entry(number))
        assert time.perf_counter() - start < 20 * 0.5


def add_entries(path):
    """Add one entry after the other, and print its number. Another process calls this."""
    with open_checkpoint(path, PROBLEM) as checkpoint:
        for number in range(10**6):
            checkpoint.add(number, entry(number))
            print(number, flush=True)


def test_a_kill_loses_at_most_the_entry_in_flight(tmp_path):
    """The kill comes at a random moment. Entries that were reported are in the file, and the lock is gone."""
    path = tmp_path / "run.sqlite"
    code = f"import test_checkpoint as t; t.add_entries({str(path)!r})"
    process = subprocess.Popen(
        [sys.executable, "-c", code], cwd=Path(__file__).parent, stdout=subprocess.PIPE, text=True
    )
    try:
        lines = [process.stdout.readline() for _ in range(3)]
        with pytest.raises(OSError, match="is in use by another run"):
            intact(path)
    finally:
        process.kill()
        lines += process.communicate()[0].splitlines(keepends=True)
    # The last line may have been cut.
    reported = [int(line) for line in lines if line.endswith("\n")]
    assert reported[:3] == [0, 1, 2]
    with open_checkpoint(path, PROBLEM) as checkpoint:
        stored = dict(checkpoint.intact_entries(lambda number, arrays: arrays))
    assert sorted(stored) in (reported, [*reported, len(reported)])
    np.testing.assert_array_equal(stored[2]["fitted"], entry(2)["fitted"])
