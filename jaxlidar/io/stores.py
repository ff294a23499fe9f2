"""netCDF-4 files and Zarr stores of datasets. xarray writes and reads them, but for the values of rows.

Two things are done here because xarray does not do them:

- Rows (`jaxlidar.io.rows`) are written into variables of a file that is open, some rows at a time. xarray
  writes a netCDF variable in one call, from an array in memory or from one of dask.
- Rows of netCDF files are mapped (`numpy.memmap`), so that a file that is read may be larger than memory.

Numbers have two kinds of checksums. Those of HDF5 (Fletcher's) or Zarr (CRC-32C), for each chunk, let any
program notice damage of values. The attribute `crc32` of a variable is of all its values, so that chunks are
noticed, too, that a damaged index of the file no longer names. Each row has one of its own.
"""

import contextlib
import threading
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from jaxlidar.io.checks import refuse_damage
from jaxlidar.io.hdf5 import CheckedHeapStream
from jaxlidar.io.rows import BLOCK, CHECKSUM, RowVariables, checksum_of
from jaxlidar.io.store import is_zarr

# The attribute of the root with the number of the format.
FORMAT = "jaxlidar_format"
# The file that makes a folder a Zarr store of version 3.
_ZARR_ROOT = "zarr.json"
_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
# First bytes of an HDF5 file: the signature, the version, and what follows up to the size of lengths.
_SUPERBLOCK = 16
# Warning filters are one list for all threads: of two that change it, one would restore the other's.
_FILTER_LOCK = threading.Lock()
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


class NetcdfFile:
    """A netCDF-4 file that is open."""

    def __init__(self, path: Path, file: Any):
        self.path, self._file = path, file
        self._datasets: dict[str, Any] = {}

    @staticmethod
    def import_packages() -> Any:
        """Return the package h5netcdf. **Raises:** ImportError where it, or xarray, is not installed."""
        try:
            import h5netcdf
            import xarray  # noqa: F401
        except ImportError as error:
            raise ImportError("netCDF files need h5netcdf and xarray: pip install 'jaxlidar[io]'") from error
        return h5netcdf

    @classmethod
    @contextlib.contextmanager
    def open(cls, path: Path) -> "Iterator[NetcdfFile]":
        """Open a file for reading.

        **Raises:** FileNotFoundError where there is none; ValueError, naming it, where it is no netCDF-4
        file or damaged.
        """
        h5netcdf = cls.import_packages()
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file")
        # HDF5 keeps files that it opened by name, also damaged ones, and would give them again for a new file
        # of that name. It does not keep those that Python opens.
        with contextlib.ExitStack() as stack:
            with path.open("rb") as beginning:
                superblock = beginning.read(_SUPERBLOCK)
            if not superblock.startswith(_HDF5_SIGNATURE):
                raise ValueError(f"{path}: byte 0: no netCDF-4 file")
            # Names and texts lie in heaps (`jaxlidar.io.hdf5`). Up to version 1, four bytes stand before the
            # sizes of offsets and lengths that later superblocks do not have.
            is_old = superblock[8:9] < b"\2"
            size_of_lengths = superblock[14 if is_old else 10] if len(superblock) == _SUPERBLOCK else 0
            stream = stack.enter_context(CheckedHeapStream(path, size_of_lengths))
            with refuse_damage(f"{path}: damaged"):
                file = stack.enter_context(h5netcdf.File(stream, "r", decode_vlen_strings=True))
            yield cls(path, file)

    @classmethod
    @contextlib.contextmanager
    def create(
        cls, path: Path, datasets: Mapping[str, Any], rows: Mapping[str, RowVariables]
    ) -> "Iterator[NetcdfFile]":
        """Write datasets by the path of their group, and open the file to write the values of row variables.

        `rows` has the row variables by group; their values in `datasets` do not count.
        """
        h5netcdf = cls.import_packages()
        for group, dataset in datasets.items():
            written = _dataset_to_write(dataset, rows.get(group))
            encoding = {}
            for name, variable in written.variables.items():
                # xarray would give floats a fill value, and no number here stands for a missing one.
                encoding[name] = {"_FillValue": None}
                # HDF5 has checksums for chunks alone.
                if variable.size and variable.ndim and variable.dtype.kind != "U":
                    encoding[name] |= {"chunksizes": variable.shape, "fletcher32": True}
            mode = "w" if group == "/" else "a"
            written.to_netcdf(path, mode=mode, group=group, engine="h5netcdf", encoding=encoding)
        with h5netcdf.File(path, "a") as file:
            store = cls(path, file)
            for group, variables in rows.items():
                for name in variables.names:
                    store._add_row_variable(store._node(group), datasets[group], name)
            yield store

    @staticmethod
    def _add_row_variable(group: Any, dataset: Any, name: str) -> None:
        """Add a variable without values, in one piece of the file."""
        variable = dataset.variables[name]
        for dimension, size in zip(variable.dims, variable.shape):
            if dimension not in group.dimensions:
                group.dimensions[dimension] = size
        added = group.create_variable(name, variable.dims, dtype=variable.dtype)
        added.attrs.update(_row_attributes(dataset, name))

    def variable(self, group: str, name: str) -> Any:
        """Return a variable that takes values by `variable[rows] = array`."""
        return self._node(group).variables[name]

    def _node(self, group: str) -> Any:
        """Return a group of h5netcdf; None where there is none. It has no path for the root."""
        node = self._file
        for name in filter(None, group.split("/")):
            if name not in node.groups:
                return None
            node = node.groups[name]
        return node

    def dataset(self, group: str) -> Any:
        """Return the `xarray.Dataset` of a group, whose values are not read yet; None without the group."""
        import xarray
        from xarray.backends import H5NetCDFStore

        if group not in self._datasets:
            node = self._node(group)
            if node is None:
                return None
            self._datasets[group] = xarray.open_dataset(H5NetCDFStore(node), **_RAW)
        return self._datasets[group]

    def values(self, group: str, name: str) -> np.ndarray:
        """Read the values of a variable. **Raises:** ValueError where their checksum is another."""
        return _checked_values(self, group, name)

    def row_values(self, group: str, name: str) -> np.ndarray:
        """Map the values of a variable where they lie in one piece of the file; otherwise read them."""
        # h5netcdf does not say where values lie; the dataset of h5py beneath does.
        dataset = getattr(self.variable(group, name), "_h5ds", None)
        offset = None if dataset is None or not dataset.size else dataset.id.get_offset()
        if dataset is None or offset is None or not dataset.dtype.isnative:
            return self.dataset(group).variables[name].values
        return np.memmap(self.path, dataset.dtype, "r", offset, dataset.shape)


class ZarrStore:
    """A Zarr store of version 3."""

    def __init__(self, path: Path, group: Any):
        self.path, self._group = path, group
        self._datasets: dict[str, Any] = {}

    @staticmethod
    def import_packages() -> Any:
        """Return the package zarr. **Raises:** ImportError where it, or xarray, is not installed."""
        try:
            import xarray  # noqa: F401
            import zarr
        except ImportError as error:
            raise ImportError("Zarr stores need zarr and xarray: pip install 'jaxlidar[io]'") from error
        return zarr

    @classmethod
    @contextlib.contextmanager
    def open(cls, path: Path) -> "Iterator[ZarrStore]":
        """Open a store for reading.

        **Raises:** FileNotFoundError where there is none; ValueError, naming it, where it is no Zarr store of
        version 3 or damaged.
        """
        zarr = cls.import_packages()
        if not path.is_dir():
            raise FileNotFoundError(f"{path}: no such folder")
        if not (path / _ZARR_ROOT).is_file():
            raise ValueError(f"{path}: no Zarr store of version 3: it has no {_ZARR_ROOT}")
        with refuse_damage(f"{path}: damaged"):
            # Not with the consolidated metadata, which hide damage of an array's own.
            group = zarr.open_group(path, mode="r", zarr_format=3, use_consolidated=False)
        yield cls(path, group)

    @classmethod
    @contextlib.contextmanager
    def create(
        cls, path: Path, datasets: Mapping[str, Any], rows: Mapping[str, RowVariables]
    ) -> "Iterator[ZarrStore]":
        """Write datasets by the path of their group, and open the store to write the values of row variables.

        `rows` has the row variables by group; their values in `datasets` do not count.
        """
        zarr = cls.import_packages()
        from zarr.codecs import Crc32cCodec

        checksum = {"compressors": [Crc32cCodec()]}
        # Texts of any length, also where there is none: zarr has no stable type for numpy's "U".
        texts = np.dtype("O", metadata={"vlen": str})
        for group, dataset in datasets.items():
            written = _dataset_to_write(dataset, rows.get(group))
            names = [name for name, variable in written.variables.items() if variable.dtype.kind == "U"]
            written = written.assign_coords(
                {name: (written[name].dims, written[name].values.astype(texts)) for name in names}
            )
            encoding = {
                name: {"chunks": tuple(max(size, 1) for size in variable.shape), **checksum}
                for name, variable in written.variables.items()
                if name not in names
            }
            options: dict[str, Any] = {"zarr_format": 3, "consolidated": False, "write_empty_chunks": True}
            written.to_zarr(path, mode="a", group=group, encoding=encoding, **options)
        root = zarr.open_group(path, mode="r+", zarr_format=3)
        for group, variables in rows.items():
            for name in variables.names:
                cls._add_row_variable(root[group], datasets[group], name, variables.dimension, checksum)
        yield cls(path, root)
        with _FILTER_LOCK, warnings.catch_warnings():
            # zarr warns that the format does not specify them yet; xarray warns where they are missing.
            warnings.filterwarnings("ignore", "Consolidated metadata is currently not part", UserWarning)
            zarr.consolidate_metadata(path, zarr_format=3)

    @staticmethod
    def _add_row_variable(
        group: Any, dataset: Any, name: str, rows_dimension: str, options: Mapping[str, Any]
    ) -> None:
        """Add a variable without values, in chunks of rows."""
        variable = dataset.variables[name]
        chunks = [
            BLOCK if dimension == rows_dimension else max(size, 1)
            for dimension, size in zip(variable.dims, variable.shape)
        ]
        added = group.create_array(
            name,
            shape=variable.shape,
            dtype=variable.dtype,
            chunks=tuple(chunks),
            dimension_names=list(variable.dims),
            **options,
        )
        added.attrs.update(_row_attributes(dataset, name))

    def variable(self, group: str, name: str) -> Any:
        """Return a variable that takes values by `variable[rows] = array`."""
        array = self._group[f"{group}/{name}".strip("/")]
        # A chunk of zeros is written, too: `values` refuses a store whose chunks are missing.
        return array.with_config({"write_empty_chunks": True})

    def dataset(self, group: str) -> Any:
        """Return the `xarray.Dataset` of a group, whose values are not read yet; None without the group."""
        import xarray

        if group not in self._datasets:
            if group != "/" and group.strip("/") not in self._group:
                return None
            options: dict[str, Any] = {"consolidated": False, "chunks": None, **_RAW}
            self._datasets[group] = xarray.open_dataset(self.path, engine="zarr", group=group, **options)
        return self._datasets[group]

    def values(self, group: str, name: str) -> np.ndarray:
        """Read the values of a variable.

        **Raises:** ValueError where a chunk is missing, or the checksum is another.
        """
        self._check_chunks(group, name)
        return _checked_values(self, group, name)

    def row_values(self, group: str, name: str) -> np.ndarray:
        """Read the values of a variable with rows: those of chunks cannot be mapped."""
        self._check_chunks(group, name)
        return self.dataset(group).variables[name].values

    def _check_chunks(self, group: str, name: str) -> None:
        """Refuse a variable with missing chunks, which Zarr would read as zeros."""
        array = self._group[f"{group}/{name}".strip("/")]
        if missing := array.nchunks - array.nchunks_initialized:
            raise ValueError(f"{missing} chunks are missing")


# Both have the same methods.
Store: TypeAlias = NetcdfFile | ZarrStore


def _dataset_to_write(dataset: Any, rows: RowVariables | None) -> Any:
    """Return a Dataset without the variables with rows, and with checksums of the others."""
    written = dataset.copy() if rows is None else dataset.drop_vars(rows.names)
    for variable in written.variables.values():
        if variable.dtype.kind != "U":
            variable.attrs[CHECKSUM] = checksum_of(variable.values)
    return written


def _checked_values(store: Store, group: str, name: str) -> np.ndarray:
    """Read the values of a variable. **Raises:** ValueError where its checksum is another."""
    variable = store.dataset(group).variables[name]
    values = variable.values
    # No file has checksums of texts.
    if values.dtype.kind not in "OUT":
        checksum = variable.attrs[CHECKSUM]
        if checksum_of(values) != checksum:
            raise ValueError("its checksum is another")
    return values


def _row_attributes(dataset: Any, name: str) -> dict[str, Any]:
    """Return the attributes of a variable as xarray writes them, with the names of its coordinates.

    CF conventions (section 5): a variable names the coordinates that are no dimensions.
    """
    variable = dataset.variables[name]
    auxiliary = [c for c in dataset.coords if c not in dataset.dims]
    named = [c for c in auxiliary if set(dataset.variables[c].dims) <= set(variable.dims)]
    if not named or name in dataset.coords:
        return dict(variable.attrs)
    return {**variable.attrs, "coordinates": " ".join(named)}
