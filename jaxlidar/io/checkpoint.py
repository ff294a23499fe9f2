"""Checkpoint of a long run: its finished entries, in an SQLite file that one process at a time holds.

An entry is a set of named arrays under a number, such as the fit of a footprint or the waveforms of a chunk
of shots. The same run, started again, computes the entries that are missing. The file guarantees:

- *Atomic entries.* An entry is written in one transaction of SQLite: it is in the file whole or not at all,
  also after the process was killed (https://www.sqlite.org/atomiccommit.html).
- *One process.* A run holds the lock "PATH.lock" while it has the file open. The operating system lifts it
  when the process ends, in whichever way; the empty file that a killed process leaves is locked by the next
  run. The file system has to support locks.
- *One problem.* Digests of all that the results depend on are stored; another problem is refused, with the
  names of what differs.
- *Damage.* SQLite checks the structure of the file; a damaged file is refused and left as it is. An entry is
  a NumPy archive, whose members have checksums (CRC-32); damaged entries are named in a warning and computed
  again.
- *Full disk.* An entry that cannot be written stays in memory and is tried again with the next one.

Tables: `problem` (part, digest) and `entries` (number, piece, content). Archives are cut into pieces, as
SQLite limits the length of a value to 1e9 bytes.
"""

import contextlib
import io
import os
import sqlite3
import stat
import threading
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from jaxlidar._checks import warn_user

# Marks a checkpoint in SQLite's header (https://www.sqlite.org/fileformat2.html#application_id): "jlcp" in
# ASCII.
_APPLICATION_ID = 0x6A6C6370
_TABLES = (
    "CREATE TABLE problem (part TEXT PRIMARY KEY, digest TEXT NOT NULL)",
    "CREATE TABLE entries (number INTEGER, piece INTEGER, content BLOB NOT NULL, "
    "PRIMARY KEY (number, piece))",
)
_PIECE_BYTES = 2**28
# SQLite's codes of a damaged file; the first is that of a missing table.
_FILE_DAMAGE = (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT)
# Exceptions of NumPy, zip files and decoders over a damaged entry.
_ENTRY_DAMAGE = (
    ValueError,
    TypeError,
    KeyError,
    RuntimeError,
    OSError,
    EOFError,
    zipfile.BadZipFile,
)

# After so many attempts, an error of SQLite is no trace of a lock that has just been removed.
_MAX_LOCK_ATTEMPTS = 20
# Held while a thread takes the lock of a run.
_ACQUIRING = threading.Lock()

Entry = TypeVar("Entry")


class Checkpoint:
    """An open checkpoint: entries by number, each a mapping of names to arrays. `open_checkpoint` makes it.

    Entries that could not be written are kept in memory, and read from there.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection):
        self.path = path
        self._connection = connection
        self._unwritten: dict[int, bytes] = {}

    def numbers(self) -> list[int]:
        """Return the numbers of all entries, in order, including damaged ones."""
        stored = self._connection.execute("SELECT DISTINCT number FROM entries").fetchall()
        return sorted({number for (number,) in stored} | self._unwritten.keys())

    def add(self, number: int, arrays: Mapping[str, Any]) -> None:
        """Add an entry, in place of a damaged one of this number.

        **Raises:** OSError if it cannot be written. It is then kept in memory, and tried again with the next
        one.
        """
        self._unwritten[number] = _pack(arrays)
        try:
            for waiting in list(self._unwritten):
                self._write(waiting, self._unwritten[waiting])
                del self._unwritten[waiting]
        except (sqlite3.Error, OSError) as error:
            raise OSError(f"path = {self.path} could not be written ({error})") from error

    def read(self, number: int) -> dict[str, np.ndarray]:
        """Return the arrays of an entry. **Raises:** ValueError, naming the entry, if it is damaged."""
        try:
            return self._read(number)
        except _ENTRY_DAMAGE as error:
            raise ValueError(f"path = {self.path} is damaged: entry {number}: {error}") from error

    def intact_entries(
        self, decode: Callable[[int, dict[str, np.ndarray]], Entry]
    ) -> Iterator[tuple[int, Entry]]:
        """Yield the numbers of the entries, and what `decode` makes of each, except damaged ones.

        Every array is read, so that its checksum is tested. `decode` may raise ValueError or TypeError for
        arrays that no result has. After the last entry, a warning names the damaged ones.
        """
        damaged = []
        for number in self.numbers():
            try:
                entry = decode(number, self._read(number))
            except _ENTRY_DAMAGE as error:
                damaged.append(f"entry {number} ({error})")
                continue
            yield number, entry
        if damaged:
            warn_user(
                f"path = {self.path} is damaged, and these entries are computed again: {'; '.join(damaged)}"
            )

    def remove(self) -> None:
        """Close and remove the file, when the run's own results are stored elsewhere."""
        self._connection.close()
        self.path.unlink()

    def _read(self, number: int) -> dict[str, np.ndarray]:
        packed = self._unwritten.get(number)
        if packed is None:
            query = "SELECT content FROM entries WHERE number = ? ORDER BY piece"
            packed = b"".join(content for (content,) in self._connection.execute(query, (number,)))
        return _unpack(packed)

    def _write(self, number: int, packed: bytes) -> None:
        pieces = range(0, len(packed), _PIECE_BYTES)
        rows = [(number, n, packed[i : i + _PIECE_BYTES]) for n, i in enumerate(pieces)]
        connection = self._connection
        connection.execute("BEGIN")
        try:
            connection.execute("DELETE FROM entries WHERE number = ?", (number,))
            connection.executemany("INSERT INTO entries VALUES (?, ?, ?)", rows)
            connection.execute("COMMIT")
        except sqlite3.Error:
            # SQLite may have rolled back by itself, as on a full disk.
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            raise


@contextlib.contextmanager
def open_checkpoint(path: str | os.PathLike[str], problem: Mapping[str, str]) -> Iterator[Checkpoint]:
    """Open a checkpoint, which nobody else can open until the block ends. A missing file is made.

    1. Lock the file "PATH.lock" for this run, or refuse where another run has it.
    2. Open the checkpoint, create its tables or check them.
    3. Afterwards, close it and remove the lock.

    **Arguments:**

    - `path`: the file. Missing folders are made.
    - `problem`: digests of the parts of the problem (`jaxlidar.extend.fingerprint`).

    **Returns:** a context manager that gives a `Checkpoint`.

    **Raises:** ValueError for a file that is damaged, no checkpoint, or one of another problem. OSError for a
    file that is in use, or cannot be written: it is found here, before any work.
    """
    path = Path(path)
    with contextlib.ExitStack() as stack:
        with _plain_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            if not _is_missing_or_regular(path):
                raise OSError("it is no regular file")
            stack.enter_context(_run_lock(path))
            # Only now: a run that has the lock may remove the file. SQLite would deny a group the right to
            # write that its umask grants.
            path.touch()
            connection = stack.enter_context(contextlib.closing(_connect(path)))
            _lock_and_check(connection, path, problem)
        yield Checkpoint(path, connection)


def _connect(path: Path) -> sqlite3.Connection:
    # An absolute path: SQLite gives names such as ":memory:" a meaning.
    # isolation_level None: transactions begin and end only as written here.
    return sqlite3.connect(path.absolute(), timeout=0.0, isolation_level=None)


@contextlib.contextmanager
def _run_lock(path: Path) -> Iterator[None]:
    """Hold the lock of the run that uses the checkpoint `path`, until the block ends.

    The lock is an exclusive transaction of SQLite on an empty file beside the checkpoint, which the operating
    system ends with the process, in whichever way. The checkpoint's own lock does not do: its file is removed
    at the end of a run, and a second run that had opened it before would lock and change a file without a
    name, or take the journal of a third run for its own.

    **Raises:** sqlite3.Error where another run has it.
    """
    lock_path = path.with_name(path.name + ".lock")
    with contextlib.ExitStack() as stack:
        number, attempts = None, 0
        while number is None or number != _file_number(lock_path):
            # A run that has just ended removes its lock. What was locked here may then be a file without a
            # name, which keeps nobody else out: lock the next one.
            stack.close()
            attempts += 1
            # POSIX drops the locks of a process on a file when any descriptor of it is closed, as after its
            # creation here, while another thread may have locked it.
            with _ACQUIRING:
                lock_path.touch()
                number = _file_number(lock_path)
                connection = stack.enter_context(contextlib.closing(_connect(lock_path)))
                try:
                    connection.execute("BEGIN EXCLUSIVE")
                except sqlite3.OperationalError as error:
                    # SQLite refuses a file that has been removed with an error of input and output. The next
                    # file may have the number of the removed one.
                    is_in_use = error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY
                    may_be_removed = not is_in_use and attempts < _MAX_LOCK_ATTEMPTS
                    if number == _file_number(lock_path) and not may_be_removed:
                        raise
                    number = None
        try:
            yield
        finally:
            _remove_lock(lock_path)
    # Windows removes no file that is open, as this one was until now.
    if os.name == "nt":
        _remove_lock(lock_path)


def _remove_lock(lock_path: Path) -> None:
    """Remove the file of a lock; not where Windows has it open, for this run or another one."""
    with contextlib.suppress(PermissionError):
        lock_path.unlink(missing_ok=True)


def _file_number(path: Path) -> int | None:
    """Return the number by which the file system knows a file; None if it has gone."""
    try:
        return path.stat().st_ino
    except FileNotFoundError:
        return None


def _is_missing_or_regular(path: Path) -> bool:
    """Return False for folders, devices and the like."""
    # One look: another run may remove the file at any moment.
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except FileNotFoundError:
        return True


def check_same_problem(
    path: str | os.PathLike[str], stored: Mapping[str, str], problem: Mapping[str, str]
) -> None:
    """Refuse results of another problem.

    **Arguments:** `path`: of the results. `stored`, `problem`: digests by part, of the results and of the
    present run.

    **Raises:** ValueError that names the path and the parts that differ.
    """
    differing = [part for part in {**problem, **stored} if stored.get(part) != problem.get(part)]
    if not differing:
        return
    # Parts that only one problem has, such as the bounds of a renamed unknown, follow from a part that both
    # have.
    shared = [part for part in differing if part in stored and part in problem]
    raise ValueError(
        f"path = {path} holds results of another problem, which differs in {', '.join(shared or differing)}; "
        "nothing is overwritten: give another path, or remove the file"
    )


@contextlib.contextmanager
def _plain_errors(path: Path) -> Iterator[None]:
    """Turn errors of SQLite and of the file system into sentences about `path`."""
    try:
        yield
    except (sqlite3.Error, UnicodeDecodeError) as error:
        # Python cannot decode every message about a damaged file.
        code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF
        if code == sqlite3.SQLITE_BUSY:
            raise OSError(
                f"path = {path} is in use by another run: wait until it has ended, or give another path"
            ) from error
        if code in _FILE_DAMAGE:
            raise ValueError(f"path = {path} is damaged or no checkpoint: {error}") from error
        raise OSError(f"path = {path} cannot be written: {error}") from error
    except OSError as error:
        raise OSError(f"path = {path} cannot be written: {error}") from error


def _lock_and_check(connection: sqlite3.Connection, path: Path, problem: Mapping[str, str]) -> None:
    """Lock the file, and create its tables or check them, in one transaction."""

    def rows_of(query: str) -> list:
        return connection.execute(query).fetchall()

    # The lock of the first transaction is kept until the connection closes.
    rows_of("PRAGMA locking_mode = EXCLUSIVE")
    rows_of("BEGIN EXCLUSIVE")
    if not rows_of("SELECT * FROM sqlite_master"):
        for table in _TABLES:
            rows_of(table)
        rows_of(f"PRAGMA application_id = {_APPLICATION_ID}")
        connection.executemany("INSERT INTO problem VALUES (?, ?)", problem.items())
    if rows_of("PRAGMA application_id") != [(_APPLICATION_ID,)]:
        raise ValueError(f"path = {path} is no checkpoint, but another SQLite database")
    (integrity,) = rows_of("PRAGMA integrity_check(1)")[0]
    if integrity != "ok":
        raise ValueError(f"path = {path} is damaged: {integrity}")
    check_same_problem(path, dict(rows_of("SELECT part, digest FROM problem")), problem)
    # A missing table is damage that shows here.
    rows_of("SELECT number, piece FROM entries LIMIT 1")
    # Written even if nothing changes: a file or folder that cannot be written is found before the work.
    connection.executemany("INSERT OR REPLACE INTO problem VALUES (?, ?)", problem.items())
    rows_of("COMMIT")


def _pack(arrays: Mapping[str, Any]) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **dict(arrays))  # pyright: ignore[reportArgumentType]
    return stream.getvalue()


def _unpack(packed: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of an archive; reading tests their checksums."""
    with np.load(io.BytesIO(packed), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}
