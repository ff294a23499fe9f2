"""Zarr stores with the few methods of h5netcdf's groups that `jaxlidar.io.groups` uses."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

_SUFFIX = ".zarr"


def is_zarr(path: Path) -> bool:
    """Whether a path is that of a Zarr store, by its suffix."""
    return path.suffix.lower() == _SUFFIX


def opened(path: Path, mode: str) -> "ZarrGroup":
    """A store as a group: a new one ("w"), or one that is there ("r")."""
    try:
        import zarr
    except ImportError as error:
        raise ImportError("Zarr stores need zarr: pip install 'jaxlidar[io]'") from error
    if mode == "r":
        return ZarrGroup(zarr.open_group(path, mode="r", zarr_format=3))
    return ZarrGroup(zarr.create_group(path, zarr_format=3))


class _Size(NamedTuple):
    size: int


class _Dimensions(dict[str, _Size]):
    """Sizes by name, as plain numbers when they are given."""

    def __setitem__(self, name: str, size: Any) -> None:
        super().__setitem__(name, _Size(int(size)))


class ZarrArray:
    """An array; texts are read as bytes."""

    def __init__(self, array: Any):
        self.array, self.attrs = array, array.attrs
        self.ndim, self.shape = array.ndim, array.shape

    @property
    def dtype(self) -> Any:
        """The type of its values; `str` for texts."""
        return self.array.dtype if self.array.dtype.kind in "biuf" else str

    def __getitem__(self, key: Any) -> Any:
        # A chunk that is missing would be read as zeros.
        if self.array.nchunks_initialized != self.array.nchunks:
            raise ValueError(f"{self.array.nchunks - self.array.nchunks_initialized} chunks are missing")
        values = self.array[key]
        return [str(text).encode() for text in values] if self.dtype is str else values

    def __setitem__(self, key: Any, values: Any) -> None:
        self.array.with_config({"write_empty_chunks": True})[key] = values


class _Members(Mapping[str, Any]):
    """The arrays, or the groups, of a group."""

    def __init__(self, group: Any, arrays: bool):
        self.group, self.arrays = group, arrays

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self.group.array_keys() if self.arrays else self.group.group_keys()))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __contains__(self, name: object) -> bool:
        return name in list(self)

    def __getitem__(self, name: str) -> Any:
        if name not in self:
            raise KeyError(name)
        return ZarrArray(self.group[name]) if self.arrays else ZarrGroup(self.group[name])


class ZarrGroup:
    """A group of a store. `dimensions` has those of arrays that were made through this object."""

    def __init__(self, group: Any):
        self.group, self.attrs = group, group.attrs
        self.dimensions = _Dimensions()
        self.variables, self.groups = _Members(group, True), _Members(group, False)

    def __getitem__(self, name: str) -> Any:
        return self.variables[name]

    def create_group(self, name: str) -> "ZarrGroup":
        """A new group within it."""
        return ZarrGroup(self.group.create_group(name))

    def create_variable(
        self,
        name: str,
        dimensions: Sequence[str],
        dtype: Any,
        data: Any = None,
        chunks: Sequence[int] | None = None,
        fletcher32: bool = True,
    ) -> ZarrArray:
        """A new array, of which every chunk has a checksum and is written even if it is empty."""
        from zarr.codecs import Crc32cCodec

        shape = tuple(self.dimensions[d].size for d in dimensions)
        how: dict[str, Any] = {"dimension_names": list(dimensions)}
        if data is not None and np.asarray(data).dtype.kind == "O":
            made = ZarrArray(self.group.create_array(name, shape=shape, dtype=str, **how))
            made[...] = np.asarray(data, str)
            return made
        serial = {"compressors": [Crc32cCodec()]}
        chunks = tuple(max(n, 1) for n in (shape if chunks is None else chunks))
        made = ZarrArray(
            self.group.create_array(name, shape=shape, dtype=dtype, chunks=chunks, **serial, **how)
        )
        if data is not None:
            made[...] = np.asarray(data)
        return made
