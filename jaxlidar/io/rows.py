"""Results with many rows, such as shots: they are written some rows at a time, with a checksum for each row.

Neither writing nor opening such a file needs memory for all rows. xarray writes the variables without rows;
those with rows are written here.
"""

import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

# The variable with the checksums of rows, and the attribute with the checksum of a variable without rows.
CHECKSUMS, CHECKSUM = "row_crc32", "crc32"
# Rows that are compared at once, and rows of a chunk where a file has chunks.
BLOCK = 256


class RowVariables(NamedTuple):
    """Names of the variables of a group that have rows, and the name of the dimension of rows."""

    names: tuple[str, ...]
    dimension: str


def unwritten_rows(rows: int, like: np.ndarray) -> np.ndarray:
    """Return zeros of the shape (rows, *like.shape[1:]) that take no memory, for rows to be written later."""
    return np.broadcast_to(np.zeros((), like.dtype), (rows, *like.shape[1:]))


class RowWriter:
    """Writes the rows of one result into variables of an open file, in any order.

    - `variables`: what takes values by `variables[field][rows] = array`; of a dict, by the number of the item
      and `rows`.
    - `items`: keys of the fields that are dicts, in the order in which the file has them.
    - `checksums`: the variable of checksums.
    - `inner`: writers of the objects in fields, by the field's name.

    `count` is the number of rows.
    """

    def __init__(
        self,
        variables: Mapping[str, Any],
        items: Mapping[str, Sequence[str]],
        checksums: Any,
        inner: Mapping[str, "RowWriter"],
    ):
        self._variables, self._items, self._checksums = variables, items, checksums
        self.inner, self.count = inner, int(checksums.shape[0])
        self._sums, self._written = np.zeros(self.count, np.uint32), np.zeros(self.count, bool)

    @property
    def fields(self) -> list[str]:
        """Fields that have rows, but for those of objects in fields."""
        return list(self._variables)

    def add(self, rows: slice, values: Mapping[str, Any]) -> None:
        """Write some rows: for each field an array, or a dict of arrays; or an object that has them.

        **Raises:** TypeError for rows of another type than the variable.
        """
        for name, writer in self.inner.items():
            writer.add(rows, vars(values[name]))
        sums = np.zeros_like(self._sums[rows])
        for name, variable in self._variables.items():
            # The order of the file's items, whatever that of these rows is.
            for number, key in enumerate(self._items.get(name, [None])):
                array = np.asarray(values[name] if key is None else values[name][key])
                if array.dtype != variable.dtype:
                    raise TypeError(
                        f"{name} has rows of {array.dtype}, but those before are {variable.dtype}"
                    )
                variable[rows if key is None else (number, rows)] = array
                sums = _add_to_checksums(sums, array)
        self._sums[rows], self._written[rows] = sums, True

    def end(self) -> None:
        """Write the checksums. **Raises:** ValueError where rows are missing."""
        for writer in self.inner.values():
            writer.end()
        if not np.all(self._written):
            raise ValueError(f"{np.sum(~self._written)} of {self.count} rows are missing")
        self._checksums[...] = self._sums
        self._checksums.attrs[CHECKSUM] = checksum_of(self._sums)


def checksum_of(array: np.ndarray) -> int:
    """Return the CRC-32 of the bytes of an array."""
    return zlib.crc32(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)


def check_rows(place: str, checksums: np.ndarray, fields: Mapping[str, Any]) -> None:
    """Compare the checksums of all rows. **Raises:** ValueError that begins with `place`."""
    arrays = [a for v in fields.values() for a in (v.values() if isinstance(v, dict) else [v])]
    if any(len(a) != len(checksums) for a in arrays):
        raise ValueError(f"{place}: damaged: {[len(a) for a in arrays]} rows for {len(checksums)} checksums")
    for start in range(0, len(checksums), BLOCK):
        rows = slice(start, start + BLOCK)
        sums = np.zeros_like(checksums[rows])
        for array in arrays:
            sums = _add_to_checksums(sums, array[rows])
        if np.any(differ := sums != checksums[rows]):
            row = start + int(np.argmax(differ))
            raise ValueError(f"{place}: row {row}: damaged (its checksum is another)")


def _add_to_checksums(sums: np.ndarray, array: np.ndarray) -> np.ndarray:
    """Return the checksums of rows, continued with the bytes of one more array."""
    rows = np.ascontiguousarray(array).reshape(len(array), -1).view(np.uint8)
    return np.array([zlib.crc32(row.data, int(s)) for row, s in zip(rows, sums)], np.uint32)
