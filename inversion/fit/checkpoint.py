"""Checkpoint of finished fits: an SQLite file that one process at a time holds.

SQLite writes a fit whole or not at all, also where the process is killed; it finds damage; and it locks the
file, a lock that the operating system lifts when the process ends, in whichever way.
"""

import contextlib
import dataclasses
import io
import os
import sqlite3
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from inversion.fit.solver import Outcome

# Marks a file of fits, in SQLite's header.
_MARK = 0x66697473
_TABLES = (
    "CREATE TABLE problem (part TEXT PRIMARY KEY, digest TEXT NOT NULL)",
    "CREATE TABLE fits (number INTEGER PRIMARY KEY, fit BLOB NOT NULL)",
)
# The first is that of a missing table.
_DAMAGED = (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT)


@dataclasses.dataclass(frozen=True)
class Row:
    """A finished fit."""

    values: np.ndarray
    stderr: np.ndarray
    robust_stderr: np.ndarray
    prior_share: np.ndarray
    at_bound: np.ndarray
    covariance: np.ndarray
    reduced_chi2: float
    second_minimum: float
    independent_samples: float
    averaging: np.ndarray
    strength: np.ndarray
    converged: bool
    steps: int
    fitted: np.ndarray
    status: str


def row_of(o: Outcome) -> Row:
    """The row of a fit's outcome."""
    own = {f.name: getattr(o, f.name) for f in dataclasses.fields(Row) if f.name != "fitted"}
    return Row(**own, fitted=np.asarray(o.evaluation.total))


class Frame(NamedTuple):
    """How many fits there are, their unknowns, the shape of a waveform, and smoothness priors."""

    fits: int
    unknowns: int
    waveform: tuple[int, ...]
    smooth: int = 0


class Kept:
    """Finished fits by number, and the file that keeps them, if there is one."""

    def __init__(self, rows: dict[int, Row], path: Path | None, file: sqlite3.Connection | None):
        self.rows = rows
        self._path, self._file = path, file
        self._waiting: list[tuple[int, bytes]] = []
        self._warned = False

    def add(self, number: int, row: Row) -> None:
        """Keep a fit. Where the file cannot be written, it is tried again with the next fit."""
        self.rows[number] = row
        if self._file is None:
            return
        self._waiting.append((number, _packed(row)))
        try:
            while self._waiting:
                self._file.execute("INSERT INTO fits VALUES (?, ?)", self._waiting[0])
                del self._waiting[0]
        except (sqlite3.Error, OSError) as error:
            if not self._warned:
                self._warned = True
                warnings.warn(
                    f"path = {self._path} could not be written ({error}). The fits go on, and are returned; "
                    "every further one tries to write what is missing",
                    stacklevel=3,
                )


@contextlib.contextmanager
def kept_fits(path: str | os.PathLike[str] | None, parts: Mapping[str, str], frame: Frame) -> Iterator[Kept]:
    """The fits in a file, which nobody else can open until the block ends. With the path None, there is none.

    **Arguments:**

    - `path`: the file; it is made where there is none.
    - `parts`: digests of the parts of the problem.
    - `frame`: what the fits must look like.

    **Raises:** ValueError where the file is damaged, no file of fits, or one of another problem. OSError
    where it is in use, or cannot be written.
    """
    if path is None:
        yield Kept({}, None, None)
        return
    path = Path(path)
    with contextlib.ExitStack() as stack:
        with _explained(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            # Absolute, as SQLite gives names such as ":memory:" a meaning.
            file = sqlite3.connect(path.absolute(), timeout=0.0, isolation_level=None)
            stack.enter_context(contextlib.closing(file))
            rows = _load(file, path, parts, frame)
        yield Kept(rows, path, file)


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Errors of SQLite and of the file system, in a sentence."""
    try:
        yield
    except (sqlite3.Error, UnicodeDecodeError) as error:
        # Python cannot read every message about a damaged file.
        code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF
        if code == sqlite3.SQLITE_BUSY:
            raise OSError(
                f"path = {path} is in use by another run: wait until it has ended, or give another path"
            ) from error
        if code in _DAMAGED:
            raise ValueError(f"path = {path} is damaged or no file of fits: {error}") from error
        raise OSError(f"path = {path} cannot be written: {error}") from error
    except OSError as error:
        raise OSError(f"path = {path} cannot be written: {error}") from error


def _load(file: sqlite3.Connection, path: Path, parts: Mapping[str, str], frame: Frame) -> dict[int, Row]:
    """Lock the file, make or check it, and read its rows."""

    def ask(question: str) -> list:
        return file.execute(question).fetchall()

    ask("PRAGMA locking_mode = EXCLUSIVE")
    ask("BEGIN EXCLUSIVE")
    if not ask("SELECT * FROM sqlite_master"):
        for table in _TABLES:
            ask(table)
        ask(f"PRAGMA application_id = {_MARK}")
        file.executemany("INSERT INTO problem VALUES (?, ?)", parts.items())
    if ask("PRAGMA application_id") != [(_MARK,)]:
        raise ValueError(f"path = {path} is no file of fits, but another SQLite database")
    (sound,) = ask("PRAGMA integrity_check(1)")[0]
    if sound != "ok":
        raise ValueError(f"path = {path} is damaged: {sound}")
    found = dict(ask("SELECT part, digest FROM problem"))
    differ = [part for part in {**parts, **found} if found.get(part) != parts.get(part)]
    if differ:
        # Where unknowns have other names, only one of the two problems has their bounds, priors and starts.
        names = [part for part in differ if part in found and part in parts] or differ
        raise ValueError(f"path = {path} keeps fits of another problem; what differs: {', '.join(names)}")
    rows = {}
    for number, packed in ask("SELECT number, fit FROM fits"):
        try:
            if not 0 <= number < frame.fits:
                raise ValueError(f"its number is outside the admissible range [0, {frame.fits - 1}]")
            rows[number] = _unpacked(packed, frame)
        except (ValueError, TypeError, RuntimeError, OSError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"path = {path} is damaged: fit {number}: {error}") from error
    # Written in any case: a file or folder that cannot be written is found here.
    file.executemany("INSERT OR REPLACE INTO problem VALUES (?, ?)", parts.items())
    ask("COMMIT")
    return rows


def _packed(row: Row) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **vars(row))
    return stream.getvalue()


def _unpacked(packed: bytes, frame: Frame) -> Row:
    """The row of a fit. **Raises:** ValueError, and others of NumPy and zip files, where it is damaged."""
    with np.load(io.BytesIO(packed), allow_pickle=False) as archive:
        found = {name: archive[name] for name in archive.files}
    n = frame.unknowns
    forms = {
        "values": ("f", (n,)),
        "stderr": ("f", (n,)),
        "robust_stderr": ("f", (n,)),
        "prior_share": ("f", (n,)),
        "at_bound": ("b", (n,)),
        "covariance": ("f", (n, n)),
        "reduced_chi2": ("f", ()),
        "second_minimum": ("f", ()),
        "independent_samples": ("f", ()),
        "averaging": ("f", (n, n)),
        "strength": ("f", (frame.smooth,)),
        "converged": ("b", ()),
        "steps": ("i", ()),
        "fitted": ("f", frame.waveform),
        "status": ("U", ()),
    }
    if found.keys() != forms.keys():
        raise ValueError(f"it has {', '.join(found)}; admissible are {', '.join(forms)}")
    for name, (kind, shape) in forms.items():
        a = found[name]
        if (a.dtype.kind, a.shape) != (kind, shape):
            raise ValueError(f"{name} is {a.dtype} of the shape {a.shape}; admissible is {kind!r} of {shape}")
    row = Row(**{name: a if a.ndim else a.item() for name, a in found.items()})
    if row.steps < 1 or not np.all(np.isfinite(row.values)):
        raise ValueError(f"values = {row.values} after {row.steps} steps; admissible are finite ones after 1")
    # What has not converged may have no finite waveform, and an unknown left open has an infinite error.
    known = (
        np.isfinite(row.reduced_chi2)
        and np.all(np.isfinite(row.fitted))
        and np.all(row.robust_stderr >= row.stderr)
    )
    known = known and np.all(row.stderr >= 0)
    if row.converged and not (known and not np.any(np.isnan(row.covariance))):
        raise ValueError("it is said to have converged, but its numbers are not finite")
    return row
