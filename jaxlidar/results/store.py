"""The store of a long run: its results, row by row, in a Zarr store that one process at a time writes.

A row is the result of one shot, fit or step; a unit of work writes some rows. The same run, started again,
computes the rows that are missing:

- Every array has a dimension of rows, and is cut along it into chunks with checksums (CRC-32C).
- The array `done` tells which rows are complete. It is written after them: a run that is killed, or whose
  disk is full, loses the rows that it was writing and no others, since zarr writes a chunk to a temporary
  file and renames it.
- Rows in a chunk that is damaged or missing are not done. A warning names the chunk.

The attribute `problem` has digests of all that the results depend on. Results of another problem are refused,
with the names of what differs. While a run has the store open, it locks the file "PATH.lock" (`filelock`); an
unlocked file that is left over means nothing.

Rows are written through zarr's arrays: `xarray.Dataset.to_zarr(region=)` opens the store again for each unit,
which takes three times as long, and admits slices of rows alone.
"""

import contextlib
import json
import os
import shutil
import threading
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxlidar._fields.checks import required_for, warn_user
from jaxlidar.formats.checks import DAMAGE_ERRORS

_SUFFIX = ".zarr"
# The file that makes a folder a Zarr store of version 3.
ROOT_FILE = "zarr.json"
# The array that tells which rows are complete.
DONE = "done"
# The attribute with digests of the problem, as JSON.
PROBLEM = "problem"
# The group of a complete result that is no dataset of rows, such as that of a fit.
RESULT = "result"
# A chunk of zeros is written, too: a chunk that is not there is missing.
_CONFIG = {"write_empty_chunks": True}
# Bytes of an array that are read together, to test their checksums.
_BYTES_AT_ONCE = 2**26
# Warning filters are one list for all threads: of two that change it, one would restore the other's.
_FILTER_LOCK = threading.Lock()
# Rows of a store: a slice, or their numbers.
Rows = slice | np.ndarray


def is_zarr(path: Path) -> bool:
    """Return True if a path is that of a Zarr store, by its suffix."""
    return path.suffix.lower() == _SUFFIX


def check_replaceable(path: Path) -> None:
    """Refuse to write a store in place of anything but a store. **Raises:** ValueError."""
    is_empty_folder = path.is_dir() and not any(path.iterdir())
    if is_zarr(path) and path.exists() and not is_empty_folder and not (path / ROOT_FILE).is_file():
        raise ValueError(f"{path}: it is there already and no Zarr store; nothing is overwritten")


def import_packages(path: Path) -> None:
    """Import what a Zarr store, or otherwise a netCDF file, needs. **Raises:** ImportError."""
    with required_for("a Zarr store" if is_zarr(path) else "a netCDF file"):
        if is_zarr(path):
            import filelock  # noqa: F401
            import zarr  # noqa: F401
        else:
            import h5netcdf  # noqa: F401
        import xarray  # noqa: F401


def consolidate(path: Path) -> None:
    """Write all metadata of a store in one place, without which xarray warns that opening takes long."""
    import zarr

    with _FILTER_LOCK, warnings.catch_warnings():
        # zarr warns that the format does not specify it yet.
        warnings.filterwarnings("ignore", "Consolidated metadata is currently not part", UserWarning)
        zarr.consolidate_metadata(path, zarr_format=3)


class ResultStore:
    """An open store; `open_store` makes it. `root` is its group of zarr."""

    def __init__(self, path: Path, root: Any):
        self.path, self.root = path, root
        self._rows: dict[str, StoredRows] = {}

    def rows(self, group: str, dimension: str, count: int, chunk: int = 1) -> "StoredRows":
        """Return the rows of a group, which is made unless it is there.

        **Arguments:** `group`: its name; "" is the root. `dimension`: name of the dimension of rows. `count`:
        number of rows. `chunk`: number of rows of a chunk. Default 1.

        **Warns:** for damaged chunks, whose rows are not done.

        **Raises:** ValueError for damage of what describes the arrays.
        """
        with plain_errors(self.path):
            node = self.root.require_group(group) if group else self.root
            self._rows[group] = StoredRows(self.path, node, dimension, count, chunk)
        return self._rows[group]

    def damaged_arrays(self) -> list[str]:
        """Return the names of damaged arrays among those without rows that `rows` has returned."""
        with_rows = {f"{g}/{name}".strip("/") for g, rows in self._rows.items() for name in rows.arrays}
        damaged = []
        for name, node in self.root.members(max_depth=None):
            if hasattr(node, "nchunks") and name not in with_rows:
                try:
                    node[...]
                    is_intact = node.nchunks == node.nchunks_initialized
                except DAMAGE_ERRORS:
                    is_intact = False
                damaged += [] if is_intact else [name]
        return sorted(damaged)


class StoredRows:
    """Arrays whose rows are written in any order.

    - `arrays`: of zarr, by name. - `is_done`: (rows,) True for complete rows.
    - `has_layout`: True if this run has written what all rows have in common.
    """

    def __init__(self, path: Path, group: Any, dimension: str, count: int, chunk: int):
        self.path, self.dimension, self.count = path, dimension, count
        self._group, self._chunk = group, chunk
        self.arrays = {
            name: array.with_config(_CONFIG)
            for name, array in group.arrays()
            if dimension in (array.metadata.dimension_names or ())
        }
        self.has_layout = False
        if DONE not in self.arrays:
            self._create_array(DONE, dataset_of_rows(dimension, {DONE: np.zeros(count, bool)}))[:] = False
        self.is_done = self._intact_rows()
        # A store that cannot be written is found before any work.
        self.arrays[DONE][:] = self.is_done

    def write(self, rows: Rows, dataset: Any) -> None:
        """Write an `xarray.Dataset` of some rows, and that these rows are done.

        Variables without rows, and attributes, are those of the first call.

        **Raises:** OSError where they cannot be written, as on a full disk: these rows are not done.
        """
        try:
            if not self.has_layout:
                self._write_layout(dataset)
            for name, array in self.arrays.items():
                if name != DONE:
                    array.oindex[self._index(name, rows)] = _values(dataset.variables[name])
            self.is_done[rows] = True
            self.arrays[DONE][:] = self.is_done
        except OSError as error:
            self.is_done[rows] = False
            raise OSError(f"path = {self.path} could not be written ({error})") from error

    def _write_layout(self, dataset: Any) -> None:
        """Make the arrays with rows that are missing; write attributes and the variables without rows."""
        for name, variable in dataset.variables.items():
            if self.dimension not in variable.dims:
                self._create_array(name, dataset)[...] = _values(variable)
            elif name not in self.arrays:
                self._create_array(name, dataset)
        self._group.attrs.update(dataset.attrs)
        self.has_layout = True

    def _create_array(self, name: str, dataset: Any) -> Any:
        """Make the array of a variable, in one chunk, or with chunks of rows."""
        from zarr.codecs import Crc32cCodec

        variable = dataset.variables[name]
        sizes = chunks = dict(variable.sizes)
        if self.dimension in sizes:
            sizes = sizes | {self.dimension: self.count}
            chunks = chunks | {self.dimension: self.count if name == DONE else self._chunk}
        array = self._group.create_array(
            name,
            shape=tuple(sizes.values()),
            # zarr admits arrays without values, but no such chunks.
            chunks=tuple(max(size, 1) for size in chunks.values()),
            dtype=str if variable.dtype.kind in "OUT" else variable.dtype,
            dimension_names=list(sizes),
            attributes=_attributes(dataset, name),
            compressors=[Crc32cCodec()],
            config=_CONFIG,
            overwrite=True,
        )
        if self.dimension in sizes:
            self.arrays[name] = array
        return array

    def read(self, rows: Rows) -> dict[str, np.ndarray]:
        """Return the values of some rows by name."""
        return {
            name: array.oindex[self._index(name, rows)] for name, array in self.arrays.items() if name != DONE
        }

    def _index(self, name: str, rows: Rows) -> tuple[Rows, ...]:
        return (*[slice(None)] * self._axis(name), rows)

    def _axis(self, name: str) -> int:
        """Return the axis of rows of an array."""
        return self.arrays[name].metadata.dimension_names.index(self.dimension)

    def _intact_rows(self) -> np.ndarray:
        """Return which rows are done, without those in damaged or missing chunks.

        Damaged chunks are removed, as zarr could not write a part of one. A warning names them.
        """
        is_done, is_intact, names = np.ones(self.count, bool), np.ones(self.count, bool), []
        for name in sorted(self.arrays, key=lambda name: (name != DONE, name)):
            size = self.arrays[name].chunks[self._axis(name)]
            for number, file in self._damaged_chunks(name, is_done):
                file.unlink(missing_ok=True)
                is_intact[number * size : (number + 1) * size] = False
                names.append(f"chunk {number} of {Path(self._group.path) / name}")
            if name == DONE:
                is_done = self.arrays[DONE][:]
        if names:
            warn_user(
                f"path = {self.path} is damaged, and these chunks are computed again: {', '.join(names)}"
            )
        return is_done & is_intact

    def _damaged_chunks(self, name: str, is_done: np.ndarray) -> list[tuple[int, Path]]:
        """Return the numbers and files of chunks that are damaged, or missing although rows are done."""
        array, axis = self.arrays[name], self._axis(name)
        # Without values there are no chunks.
        if array.size == 0:
            return []
        size, folder = array.chunks[axis], self.path / self._group.path / name / "c"
        before, after = ["0"] * axis, ["0"] * (array.ndim - axis - 1)
        files = [folder.joinpath(*before, str(n), *after) for n in range(-(-self.count // size))]

        def damaged_among(numbers: np.ndarray) -> list[int]:
            """Read chunks together; where that fails, each half."""
            try:
                array.oindex[self._index(name, slice(numbers[0] * size, (numbers[-1] + 1) * size))]
                return []
            except DAMAGE_ERRORS:
                if len(numbers) == 1:
                    return numbers.tolist()
                half = len(numbers) // 2
                return damaged_among(numbers[:half]) + damaged_among(numbers[half:])

        # zarr reads a missing chunk as zeros.
        is_there = np.array([file.is_file() for file in files])
        needed = np.unique(np.flatnonzero(is_done) // size)
        damaged = needed[~is_there[needed]].tolist()
        n_blocks = -(-array.nbytes // _BYTES_AT_ONCE)
        for numbers in np.array_split(np.flatnonzero(is_there), n_blocks):
            damaged += damaged_among(numbers) if len(numbers) else []
        return [(number, files[number]) for number in sorted(damaged)]


def done_rows(root: Any) -> dict[str, np.ndarray]:
    """Return which rows of a store are complete, by the path of their group: "/", "/fits", ..."""
    parts = ((name.rpartition("/"), array) for name, array in root.members(max_depth=None))
    return {f"/{group}": array[...] for (group, _, name), array in parts if name == DONE}


def _values(variable: Any) -> np.ndarray:
    """Return the values of a variable, with texts of any length as objects, as zarr takes them."""
    return variable.values.astype(object) if variable.dtype.kind in "UT" else variable.values


def dataset_of_rows(dimension: str, arrays: Mapping[str, Any]) -> Any:
    """Return arrays whose first dimension is that of rows as an `xarray.Dataset`."""
    import xarray

    return xarray.Dataset(
        {
            name: ([dimension, *(f"{name}_{axis}" for axis in range(1, np.ndim(array)))], np.asarray(array))
            for name, array in arrays.items()
        }
    )


def _attributes(dataset: Any, name: str) -> dict[str, Any]:
    """Return the attributes of a variable as xarray writes them, with the names of its coordinates.

    CF conventions (section 5): a variable names the coordinates that are no dimensions.
    """
    variable = dataset.variables[name]
    auxiliary = [c for c in dataset.coords if c not in dataset.dims]
    named = [c for c in auxiliary if set(dataset.variables[c].dims) <= set(variable.dims)]
    if not named or name in dataset.coords:
        return dict(variable.attrs)
    return {**variable.attrs, "coordinates": " ".join(named)}


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[None]:
    """Keep runs out of a store while a complete result takes its place. Files of other kinds are not locked.

    **Raises:** ValueError for what is no store, and for the store of a run that has not ended. OSError for
    one that a run has open.
    """
    check_replaceable(path)
    import_packages(path)
    with contextlib.ExitStack() as stack:
        if is_zarr(path) and (path / ROOT_FILE).is_file():
            import zarr
            from filelock import FileLock

            with plain_errors(path):
                # A store without this file was made by `save`.
                if Path(f"{path}.lock").exists():
                    stack.enter_context(FileLock(f"{path}.lock", timeout=0))
                root = zarr.open_group(path, mode="r", zarr_format=3, use_consolidated=False)
                # A run that has not written any row may not have its arrays yet.
                has_ended = PROBLEM not in root.attrs or RESULT in root
                is_done = [True] if has_ended else done_rows(root).values()
            if not is_done or not all(map(np.all, is_done)):
                raise ValueError(
                    f"path = {path} is the store of a run that has not ended; nothing is overwritten: give "
                    "another path, or remove the store"
                )
        yield


@contextlib.contextmanager
def open_store(path: str | os.PathLike[str], problem: Mapping[str, str]) -> Iterator[ResultStore]:
    """Open a store, which nobody else can open until the block ends. A missing one is made.

    **Arguments:**

    - `path`: the folder of the store, whose name ends in ".zarr". Missing folders are made.
    - `problem`: digests of the parts of the problem (`jaxlidar.extend.fingerprint`).

    **Returns:** a context manager that gives a `ResultStore`.

    **Raises:** ValueError for another suffix, and for a path that is no store, damaged, or of another
    problem. OSError for a store that is in use, or cannot be written: it is found here, before any work.
    ImportError where zarr, xarray or filelock is not installed.
    """
    path = Path(path)
    check_store_path(path)
    check_replaceable(path)
    import_packages(path)
    import zarr
    from filelock import FileLock

    with contextlib.ExitStack() as stack:
        with plain_errors(path):
            path.mkdir(parents=True, exist_ok=True)
            stack.enter_context(FileLock(f"{path}.lock", timeout=0))
            if not (path / ROOT_FILE).is_file():
                zarr.create_group(path, zarr_format=3, attributes={PROBLEM: json.dumps(dict(problem))})
            # Metadata that is consolidated is that of a finished run.
            root = zarr.open_group(path, mode="r+", zarr_format=3, use_consolidated=False)
            stored = json.loads(str(root.attrs.get(PROBLEM, "{}")))
        if not stored:
            raise ValueError(
                f"path = {path} was not written by a run that could go on, but by save; nothing is "
                "overwritten: give another path, or remove the store"
            )
        check_same_problem(path, stored, problem)
        yield ResultStore(path, root)


def store_beside(path: Path) -> Path:
    """Return the path of the store of a run whose result becomes the file `path`."""
    return path.with_name(path.name + _SUFFIX)


def remove_store(path: Path) -> None:
    """Remove a store, and its lock, when its results are in another file."""
    shutil.rmtree(path, ignore_errors=True)
    Path(f"{path}.lock").unlink(missing_ok=True)


def check_store_path(path: Path) -> None:
    """Refuse the path of a long run that is not that of a Zarr store. **Raises:** ValueError."""
    if not is_zarr(path):
        raise ValueError(
            f"path = {path}; admissible is the folder of a Zarr store, such as "
            f"{path.with_suffix(_SUFFIX).name}: a run writes its results as they come. Other files are "
            "written from the complete result, by its method save"
        )


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
        "nothing is overwritten: give another path, or remove the store"
    )


@contextlib.contextmanager
def plain_errors(path: Path) -> Iterator[None]:
    """Turn errors of zarr, of the lock and of the file system into sentences about `path`."""
    from filelock import Timeout

    try:
        yield
    except Timeout as error:
        raise OSError(
            f"path = {path} is in use by another run: wait until it has ended, or give another path"
        ) from error
    except OSError as error:
        raise OSError(f"path = {path} cannot be written: {error}") from error
    except DAMAGE_ERRORS as error:
        raise ValueError(f"path = {path} is damaged: {error}") from error
