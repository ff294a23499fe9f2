"""Groups of `xarray.Dataset`s in netCDF-4 files and Zarr stores: `write_groups`, `open_groups`.

The checksums of HDF5 (Fletcher's) or Zarr (CRC-32C), which are kept for each chunk, find damaged values.
"""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxlidar.formats.checks import existing_file, refuse_damage
from jaxlidar.results.store import (
    DONE,
    PROBLEM,
    RESULT,
    ROOT_FILE,
    consolidate,
    done_rows,
    import_packages,
    is_zarr,
)

_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
# Arrays with rows up to this size are read at once, and are NumPy's.
_BYTES_READ_AT_ONCE = 2**26
# Values as they are stored, and read when they are asked for: an index would read its coordinate at once.
_RAW: dict[str, Any] = {"decode_cf": False, "create_default_indexes": False, "cache": False}


def is_result_file(path: Path) -> bool:
    """Return True for the path of a Zarr store, and for an HDF5 file, by its first bytes."""
    if is_zarr(path):
        return True
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_HDF5_SIGNATURE)) == _HDF5_SIGNATURE


# -- writing -----------------------------------------------------------------------------------------------


def write_groups(path: Path, datasets: Mapping[str, Any]) -> None:
    """Write datasets, by the path of their group, as a Zarr store or a netCDF file."""
    if not is_zarr(path):
        for group, dataset in datasets.items():
            # xarray would give floats a fill value, and no number here stands for a missing one.
            encoding: dict[str, Any] = {name: {"_FillValue": None} for name in dataset.variables}
            for name, variable in dataset.variables.items():
                # HDF5 has checksums for chunks alone, and chunks for arrays with values alone.
                if variable.size and variable.ndim and variable.dtype.kind != "U":
                    encoding[name]["fletcher32"] = True
            mode = "w" if group == "/" else "a"
            dataset.to_netcdf(path, mode=mode, group=group, engine="h5netcdf", encoding=encoding)
        return
    for group, dataset in datasets.items():
        write_zarr_group(path, group, dataset)
    consolidate(path)


def write_zarr_group(path: Path, group: str, dataset: Any) -> None:
    """Write a dataset as a group of a Zarr store, in place of one that is there."""
    from zarr.codecs import Crc32cCodec

    # Texts of any length, also where there is none: zarr has no stable type for numpy's "U".
    texts = np.dtype("O", metadata={"vlen": str})
    names = [name for name, variable in dataset.variables.items() if variable.dtype.kind == "U"]
    written = dataset.assign_coords(
        {name: (dataset[name].dims, dataset[name].values.astype(texts)) for name in names}
    )
    encoding = {name: {"compressors": [Crc32cCodec()]} for name in written.variables if name not in names}
    options: dict[str, Any] = {"zarr_format": 3, "consolidated": False, "write_empty_chunks": True}
    written.to_zarr(path, mode="w", group=group, encoding=encoding, **options)


# -- reading -----------------------------------------------------------------------------------------------


class StoredGroups:
    """The datasets of a file that is open, by the path of their group; values are read when asked for."""

    def __init__(self, path: Path, datasets: Mapping[str, Any], zarr_root: Any = None):
        self.path, self.datasets, self._zarr_root = path, datasets, zarr_root

    def values(self, group: str, name: str) -> np.ndarray:
        """Read the values of a variable."""
        return self.datasets[group].variables[name].values

    def rows(self, group: str, name: str) -> Any:
        """Return values that may be larger than memory, which a Zarr store reads where they are used."""
        variable = self.datasets[group].variables[name]
        if self._zarr_root is None or variable.nbytes <= _BYTES_READ_AT_ONCE:
            return self.values(group, name)
        array = self._zarr_root[f"{group}/{name}".strip("/")]
        return StoredArray(array, f"{self.path}: {group.rstrip('/')}/{name}")


@contextlib.contextmanager
def open_groups(path: Path) -> Iterator[StoredGroups]:
    """Open a file for reading.

    **Raises:** FileNotFoundError where there is none; ValueError, naming it, where it is damaged, neither a
    netCDF-4 file nor a Zarr store, or a store whose run has not ended. ImportError where xarray, and h5netcdf
    or zarr, are not installed.
    """
    import_packages(path)
    import xarray

    if is_zarr(path):
        yield _open_zarr(path)
        return
    existing_file(path)
    if not is_result_file(path):
        raise ValueError(f"{path}: byte 0: no netCDF-4 file")
    # HDF5 keeps files that it opened by name, also damaged ones, and would give them again for a new file of
    # that name. It does not keep those that Python opens.
    with path.open("rb") as stream:
        with refuse_damage(f"{path}: damaged"):
            datasets = xarray.open_groups(stream, engine="h5netcdf", **_RAW)
        yield StoredGroups(path, datasets)


def _open_zarr(path: Path) -> StoredGroups:
    import xarray
    import zarr

    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder")
    if not (path / ROOT_FILE).is_file():
        raise ValueError(f"{path}: no Zarr store of version 3: it has no {ROOT_FILE}")
    with refuse_damage(f"{path}: damaged"):
        root: Any = zarr.open_group(path, mode="r", zarr_format=3, use_consolidated=False)
        datasets = xarray.open_groups(path, engine="zarr", consolidated=False, chunks=None, **_RAW)
        done = done_rows(root)
    if RESULT in root:
        # The rows that it was made of are the run's own: not all of them need have been used.
        groups = [name for name in datasets if name.startswith(f"/{RESULT}")]
        datasets = {name.removeprefix(f"/{RESULT}") or "/": datasets[name] for name in groups}
        root, done = root[RESULT], {}
    elif PROBLEM in root.attrs and not done:
        raise ValueError(f"{path}: damaged (no array {DONE!r}, which says which rows a run has written)")
    for group, is_done in done.items():
        if not np.all(is_done):
            raise ValueError(
                f"{path}: {group}: {np.sum(~is_done)} of {len(is_done)} rows are missing: the run that "
                "writes them has not ended; the same call goes on with it"
            )
    for group, dataset in datasets.items():
        for name in dataset.variables:
            array: Any = root[f"{group}/{name}".strip("/")]
            # zarr reads missing chunks as zeros.
            if missing := array.nchunks - array.nchunks_initialized:
                place = f"{path}: {group.rstrip('/')}/{name}"
                raise ValueError(f"{place}: damaged ({missing} chunks are missing)")
    return StoredGroups(path, datasets, root)


class StoredArray(np.lib.mixins.NDArrayOperatorsMixin):
    """An array of a Zarr store that may be larger than memory.

    An index reads its rows, as `array[3]` and `array[:100, 0]`; everything else, such as `array.sum(axis=2)`,
    reads the array as a whole and is what NumPy makes of it. Functions of JAX take `jnp.asarray(array)`.

    - `item`: None, or the index of the item along axis 0 whose rows, along axis 1, these are.
    """

    def __init__(self, array: Any, place: str, item: int | None = None):
        self._array, self._place, self._item = array, place, item

    def of_item(self, item: int) -> "StoredArray":
        """Return the array with this index along axis 0."""
        return StoredArray(self._array, self._place, item)

    @property
    def shape(self) -> tuple[int, ...]:
        return self._array.shape if self._item is None else self._array.shape[1:]

    @property
    def ndim(self) -> int:
        return len(self.shape)

    @property
    def dtype(self) -> np.dtype:
        return self._array.dtype

    def __len__(self) -> int:
        return self.shape[0]

    def _read(self, rows: slice | np.ndarray) -> np.ndarray:
        before = () if self._item is None else (self._item,)
        with refuse_damage(f"{self._place}: damaged"):
            return np.asarray(self._array.oindex[(*before, rows)])

    def __getitem__(self, index: Any) -> Any:
        first, *others = index if isinstance(index, tuple) and index else (index,)
        # Rows by number, by a slice, a mask or numbers; NumPy does what is left.
        rows = None if first is None or first is Ellipsis else np.arange(len(self))[first]
        if rows is None or np.ndim(rows) > 1:
            return np.asarray(self)[index]
        if np.ndim(rows) == 0:
            return self._read(slice(int(rows), int(rows) + 1))[(0, *others)]
        is_range = len(rows) > 0 and np.array_equal(rows, np.arange(rows[0], rows[0] + len(rows)))
        values = self._read(slice(int(rows[0]), int(rows[-1]) + 1) if is_range else rows)
        return values[(slice(None), *others)] if others else values

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self._read(slice(None)), dtype)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        arrays = (np.asarray(x) if isinstance(x, StoredArray) else x for x in inputs)
        return getattr(ufunc, method)(*arrays, **options)

    def __getattr__(self, name: str) -> Any:
        # Names of protocols, and of fields that are not set yet while an object is unpickled, are no methods.
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(np.asarray(self), name)

    def __repr__(self) -> str:
        return f"StoredArray(shape={self.shape}, dtype={self.dtype}, of {self._place})"
