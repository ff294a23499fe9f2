"""Datasets of numbers in HDF5 products, checked against the file before they are read; fill values are NaN.

HDF5 answers for what a file does not hold with zeros, and for what it declares with memory. So a dataset is
read only if it has numbers, its chunks are all stored, and its size is plausible for the size of the file.
"""

import contextlib
import math
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxlidar.io.checks import check_unpacked_size, existing_file, refuse_damage
from jaxlidar.io.coordinates import units_agree

# Attributes of numbers that are stored as counts.
_STORED_AS_COUNTS = {"scale_factor": 1.0, "add_offset": 0.0}
# The attribute of a dataset with the value that stands for a missing one.
_FILL_ATTRIBUTE = "_FillValue"


@contextlib.contextmanager
def open_hdf5(path: str | os.PathLike[str]) -> Iterator["ProductFile"]:
    """Open an HDF5 file to read it.

    **Raises:** FileNotFoundError where there is no such file, ImportError without h5py, ValueError for a file
    that is not HDF5.
    """
    try:
        import h5py
    except ImportError as error:
        raise ImportError('reading HDF5 needs h5py: pip install "jaxlidar[io]"') from error
    path = existing_file(path)
    with contextlib.ExitStack() as stack:
        with refuse_damage(f"{path}: not a readable HDF5 file"):
            file = stack.enter_context(h5py.File(path, "r"))
        yield ProductFile(path, file)


class ProductFile:
    """An open HDF5 file of a product, whose datasets are checked before they are read.

    - `path`, `file`: the path, and the `h5py.File`.
    """

    def __init__(self, path: Path, file: Any):
        self.path, self.file = path, file

    def location(self, name: str) -> str:
        """Return the location of a dataset or group, for messages."""
        return f"{self.path}: /{name}"

    def groups(self, prefix: str, product: str) -> list[str]:
        """Return the names of the groups that begin with `prefix`.

        **Raises:** ValueError where there is none: the file is no such product.
        """
        with refuse_damage(f"{self.path}: not a readable HDF5 file"):
            names = [name for name in map(str, self.file) if name.startswith(prefix)]
        if not names:
            raise ValueError(f"{self.path}: no group {prefix}...: no {product} product")
        return names

    def has(self, name: str) -> bool:
        """Return True if the file has a dataset or group of that name."""
        with refuse_damage(f"{self.location(name)}: damaged"):
            return name in self.file

    def dataset(self, name: str, product: str, ndim: int = 1) -> Any:
        """Return a dataset of numbers of so many dimensions, all of which are stored in the file.

        **Raises:** ValueError, naming the file and the dataset, where that is not so.
        """
        location = self.location(name)
        with refuse_damage(f"{location}: damaged"):
            node = self.file.get(name)
            shape, kind = getattr(node, "shape", None), getattr(getattr(node, "dtype", None), "kind", None)
        if shape is None or kind is None:
            raise ValueError(f"{location}: no such dataset; it is part of a {product} product")
        if kind not in "iuf":
            raise ValueError(f"{location}: type {node.dtype} where numbers belong")
        if len(shape) != ndim:
            dimensions = "one dimension belongs" if ndim == 1 else f"{ndim} dimensions belong"
            raise ValueError(f"{location}: shape {shape}, where {dimensions}")
        with refuse_damage(f"{location}: damaged"):
            # HDF5 returns zeros for what is not stored, as many as are declared.
            is_elsewhere = node.is_virtual or node.external
            packed = [
                attribute
                for attribute, usual in _STORED_AS_COUNTS.items()
                if node.attrs.get(attribute, usual) != usual
            ]
            chunk = node.chunks or shape
            chunks = math.prod(math.ceil(size / part) if part else 0 for size, part in zip(shape, chunk))
            contiguous = node.id.get_storage_size() // max(node.nbytes, 1)
            stored = node.id.get_num_chunks() if node.chunks else contiguous
        if is_elsewhere or stored < chunks:
            raise ValueError(
                f"{location}: {math.prod(shape)} numbers are declared, but the file holds {stored} of "
                f"{chunks} parts of them"
            )
        if packed:
            raise ValueError(f"{location}: {', '.join(packed)}: counts, which are not read")
        check_unpacked_size(self.path, f"/{name}", chunks * math.prod(chunk) * node.dtype.itemsize)
        return node

    def read(self, name: str, product: str, ndim: int = 1, rows: Any = slice(None)) -> np.ndarray:
        """Return the stored numbers of a dataset, or of some of its rows. **Raises:** as `dataset`."""
        dataset = self.dataset(name, product, ndim)
        with refuse_damage(f"{self.location(name)}: damaged"):
            return dataset[rows]

    def numbers(
        self, name: str, product: str, ndim: int = 1, rows: Any = slice(None)
    ) -> Float[np.ndarray, "..."]:
        """Return numbers in double precision; NaN where they are the dataset's fill value."""
        values = self.read(name, product, ndim, rows)
        with refuse_damage(f"{self.location(name)}: damaged"):
            fill = self.file[name].attrs.get(_FILL_ATTRIBUTE)
        is_fill = np.zeros(values.shape, bool) if fill is None else np.isin(values, fill)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.where(is_fill, np.nan, values.astype(np.float64))

    def in_unit(
        self,
        name: str,
        values: Float[np.ndarray, "..."],
        read_unit: Callable[[str, str | None], float | None],
        size: float,
    ) -> Float[np.ndarray, "..."]:
        """Return values of a dataset in another unit than that which its attribute `units` states, if any.

        **Arguments:** `read_unit`: `unit_length` or `unit_angle`. `size`: of the unit that is returned, in m
        or rad.
        """
        with refuse_damage(f"{self.location(name)}: damaged"):
            attributes = self.file[name].attrs
            stated = next((attributes[key] for key in ("units", "unit") if key in attributes), None)
        if stated is None:
            return values
        text = text_of_attribute(stated)
        unit = read_unit(self.location(name), text)
        return values if unit is None or units_agree(unit, size) else values * (unit / size)


def text_of_attribute(attribute: Any) -> str:
    """Return the text of an attribute, which may be bytes or an array of one text."""
    value = attribute.flat[0] if isinstance(attribute, np.ndarray) and attribute.size == 1 else attribute
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def rows_in_order(numbers: np.ndarray, requested: Sequence[int] | np.ndarray) -> np.ndarray:
    """Return the row of each requested number among unique `numbers`; -1 for those that are not there."""
    requested = np.asarray(requested)
    if numbers.size == 0:
        return np.full(requested.shape, -1)
    order = np.argsort(numbers, kind="stable")
    place = np.minimum(np.searchsorted(numbers, requested, sorter=order), numbers.size - 1)
    rows = order[place]
    return np.where(numbers[rows] == requested, rows, -1)
