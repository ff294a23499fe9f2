"""Checkpoint of finished fits: its rows and its file."""

import dataclasses
import hashlib
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from jaxlidar.io import atomic_write

from .fit import Outcome
from .unknowns import Settled


@dataclasses.dataclass(frozen=True)
class Row:
    """Checkpoint of one finished fit."""

    values: np.ndarray
    stderr: np.ndarray
    covariance: np.ndarray
    reduced_chi2: float
    converged: bool
    steps: int
    fitted: np.ndarray
    status: str


def row_of(o: Outcome) -> Row:
    """The row of a fit's outcome."""
    total = np.asarray(o.evaluation.total)
    return Row(o.values, o.stderr, o.covariance, o.reduced_chi2, o.converged, o.steps, total, o.status)


def fingerprint(y: np.ndarray, sigma: np.ndarray, names: list[Settled]) -> str:
    """Hash of the data and of the names and bounds of the unknowns that fits belong to."""
    digest = hashlib.sha256()
    for array in (y, np.ascontiguousarray(sigma), *(a for s in names for a in (s.low, s.high))):
        digest.update(np.ascontiguousarray(array).tobytes())
    digest.update("\n".join(s.name for s in names).encode())
    return digest.hexdigest()


class Kept:
    """The checkpoint file of finished fits. With the path None, nothing is written.

    **Raises:** ValueError where the file is damaged or has another fingerprint.
    """

    def __init__(self, path: str | os.PathLike[str] | None, fingerprint: str):
        self.path = None if path is None else Path(path)
        self.fingerprint = fingerprint
        self.rows: dict[int, Row] = {}
        if self.path is not None and self.path.exists():
            self._read(self.path)

    def _read(self, path: Path) -> None:
        try:
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
                table = {name: file[name] for name in file.files}
            fingerprint, numbers = str(table["fingerprint"]), table["number"].tolist()
            columns = {f.name: table[f.name] for f in dataclasses.fields(Row)}
        except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
            raise ValueError(f"path = {path} is damaged or no file of fits: {error}") from error
        if fingerprint != self.fingerprint:
            raise ValueError(f"path = {path} keeps fits of other footprints, noise, bounds or unknowns")
        for n, i in enumerate(numbers):
            fields = {name: column[n] for name, column in columns.items()}
            self.rows[i] = Row(**{name: v if v.ndim else v.item() for name, v in fields.items()})

    def write(self) -> None:
        """Write all rows to the file."""
        if self.path is None or not self.rows:
            return
        order = sorted(self.rows)
        table: dict[str, Any] = {
            f.name: np.array([getattr(self.rows[i], f.name) for i in order]) for f in dataclasses.fields(Row)
        }
        with atomic_write(self.path) as draft, draft.open("wb") as file:
            table |= {"number": np.array(order), "fingerprint": np.array(self.fingerprint)}
            np.savez(file, allow_pickle=False, **table)
