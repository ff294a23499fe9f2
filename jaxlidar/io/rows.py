"""Results of many rows: written some rows at a time, and mapped from the file when they are read.

Neither needs memory for all rows. Every row has a checksum, which is compared when the file is opened.
"""

import dataclasses
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxlidar.io.annotations import shape_of, values_of

CHECKSUMS = "row_crc32"
# Rows that are compared at once, and rows of a chunk where a file has chunks.
BLOCK = 256


def blank(rows: int, like: np.ndarray) -> np.ndarray:
    """Zeros of the shape (rows, *like.shape[1:]) that take no memory, in place of what comes row by row."""
    return np.broadcast_to(np.zeros((), like.dtype), (rows, *like.shape[1:]))


def row_fields(layout: Any) -> list[str]:
    """The fields of a class of results that have a row for each of `layout.rows`."""
    found = []
    for field in dataclasses.fields(layout.kind):
        shape = shape_of(field.type) or shape_of(values_of(field.type))
        if layout.rows is not None and shape and shape[0] == layout.rows:
            found.append(field.name)
    return found


class Rows:
    """The rows of a result in a file that is being written, which `jaxlidar.io.netcdf.by_rows` gives.

    `inner` has those of objects in its fields, by the field's name.
    """

    def __init__(self, group: Any, layout: Any, rows: int, value: Any, inner: Mapping[str, "Rows"]):
        self.group, self.fields, self.inner = group, row_fields(layout), inner
        # Dicts are written in the order of those of the frame, whatever theirs.
        items = {name: getattr(value, name) for name in self.fields}
        self.items = {name: list(v) for name, v in items.items() if isinstance(v, dict)}
        self.sums, self.there = np.zeros(rows, np.uint32), np.zeros(rows, bool)

    def add(self, rows: slice, values: Mapping[str, Any]) -> None:
        """Write some rows: for each field an array, or a dict of arrays; or an object that has them."""
        for name, part in self.inner.items():
            part.add(rows, vars(values[name]))
        sums = self.sums[rows] * 0
        for name in self.fields:
            variable, value = self.group.variables[name], values[name]
            keys = self.items.get(name, [None])
            for number, key in enumerate(keys):
                array = np.asarray(value if key is None else value[key])
                if array.dtype != variable.dtype:
                    raise TypeError(
                        f"{name} has rows of {array.dtype}, but those before are {variable.dtype}"
                    )
                variable[rows if key is None else (number, rows)] = array
                sums = _added(sums, array)
        self.sums[rows], self.there[rows] = sums, True

    def end(self) -> None:
        """Write the checksums."""
        for part in self.inner.values():
            part.end()
        if not np.all(self.there):
            raise ValueError(f"{np.sum(~self.there)} of {self.there.size} rows are missing")
        self.group.variables[CHECKSUMS][...] = self.sums


def check_rows(place: str, sums: np.ndarray, fields: Mapping[str, Any]) -> None:
    """Compare the checksums of all rows. **Raises:** ValueError that begins with `place`."""
    arrays = [a for v in fields.values() for a in (v.values() if isinstance(v, dict) else [v])]
    if any(len(a) != len(sums) for a in arrays):
        raise ValueError(f"{place}: damaged: {[len(a) for a in arrays]} rows for {len(sums)} checksums")
    for start in range(0, len(sums), BLOCK):
        rows = slice(start, start + BLOCK)
        found = np.zeros_like(sums[rows])
        for array in arrays:
            found = _added(found, array[rows])
        if np.any(differ := found != sums[rows]):
            row = start + int(np.argmax(differ))
            raise ValueError(f"{place}: row {row}: damaged (its checksum is another)")


def _added(sums: np.ndarray, array: np.ndarray) -> np.ndarray:
    """The checksums of rows, with those of one more array."""
    rows = np.ascontiguousarray(array).reshape(len(array), -1).view(np.uint8)
    return np.array([zlib.crc32(row.data, int(s)) for row, s in zip(rows, sums)], np.uint32)


def mapped(path: Path, variable: Any) -> np.ndarray:
    """The values of a variable: mapped where they lie in one piece of the file, otherwise read."""
    # h5netcdf does not say where values lie; the h5py dataset beneath does.
    dataset = getattr(variable, "_h5ds", None)
    place = None if dataset is None or not dataset.size else dataset.id.get_offset()
    if dataset is None or place is None or not dataset.dtype.isnative:
        return np.asarray(variable[...])
    return np.memmap(path, dataset.dtype, "r", place, dataset.shape)
