"""Datasets of numbers in HDF5 products, checked against the file before they are read.

Attributes are those of the CF conventions: numbers that equal `_FillValue` or `missing_value`, lie outside of
`valid_min`, `valid_max` or `valid_range`, or are none of `flag_values`, are missing; `units` are converted.
Packed numbers (`scale_factor`, `add_offset`) are refused.

HDF5 answers for what a file does not hold with zeros, and for what it declares with memory. So a dataset is
read only if it has numbers, its chunks are all stored, and its size is plausible for the size of the file.

**Texts.** Attributes that are texts of variable length lie in global heaps. HDF5 goes through a heap from
object to object, by the sizes that they state. At a step of no length, as over zeros, it stays for ever, in
compiled code that no signal interrupts (found with HDF5 2.0). So such attributes are read through a stream
that refuses heaps like that. Only attributes of products are: a stream of Python is slower than HDF5's own.
"""

import contextlib
import datetime
import functools
import io
import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from jaxlidar._fields.checks import required_for
from jaxlidar._fields.crs import units_agree
from jaxlidar._fields.units import unit_size
from jaxlidar.formats.checks import check_unpacked_size, existing_file, refuse_damage

# Attributes of numbers that are stored as counts.
_STORED_AS_COUNTS = {"scale_factor": 1.0, "add_offset": 0.0}
# Attributes with values that stand for a missing number.
_FILL_ATTRIBUTES = ("_FillValue", "missing_value")
# Units of numbers that readers ask for: their kind and size.
_UNITS = {
    "m": ("length", 1.0),
    "degrees": ("angle", math.pi / 180.0),
    "rad": ("angle", 1.0),
    "s": ("time", 1.0),
}
# Between the unit and the epoch of a time.
_SINCE = " since "
# First bytes of a global heap, which its size follows: the signature, version 1, three bytes that are kept.
_HEAP = b"GCOL\x01\0\0\0"
# First bytes of an object of a heap, which its size follows; number 0 is what is free. Both are kept to
# multiples of these bytes.
_OBJECT_SIZE_OFFSET = _HEAP_ALIGNMENT = 8
# Kinds of the types of attributes that do not lie in heaps: numbers, and text of a fixed length.
_PLAIN_KINDS = "biufS"

_Group = TypeVar("_Group")


@contextlib.contextmanager
def open_hdf5(
    path: str | os.PathLike[str], product: str, is_fill: Callable[[np.ndarray], np.ndarray] | None = None
) -> Iterator["ProductFile"]:
    """Open an HDF5 file to read it.

    **Arguments:** `product`: its name, for messages. `is_fill`: tells which numbers stand for missing ones
    where no attribute says so. Default None: none.

    **Raises:** FileNotFoundError where there is no such file, ImportError without h5py, ValueError for a file
    that is not HDF5.
    """
    with required_for("reading HDF5"):
        import h5py
    path = existing_file(path)
    with contextlib.ExitStack() as stack:
        with refuse_damage(f"{path}: not a readable HDF5 file"):
            file = stack.enter_context(h5py.File(path, "r"))
        yield ProductFile(path, product, file, stack, is_fill)


class ProductFile:
    """An open HDF5 file of a product, whose datasets are checked before they are read.

    - `path`, `product`, `file`: the path, the name of the product, and the `h5py.File`.
    - `stack`: of what is closed with the file. `is_fill`: as for `open_hdf5`.
    """

    def __init__(self, path: Path, product: str, file: Any, stack: contextlib.ExitStack, is_fill: Any):
        self.path, self.product, self.file, self._stack, self._is_fill = path, product, file, stack, is_fill

    @functools.cached_property
    def _checked_file(self) -> Any:
        """The same file, whose heaps are checked as they are read."""
        import h5py

        _, size_of_lengths = self.file.id.get_create_plist().get_sizes()
        stream = self._stack.enter_context(CheckedHeapStream(self.path, size_of_lengths))
        return self._stack.enter_context(h5py.File(stream, "r"))

    def location(self, name: str) -> str:
        """Return the location of a dataset or group, for messages."""
        return f"{self.path}: /{name}"

    def groups(self, prefix: str) -> list[str]:
        """Return the names of the groups that begin with `prefix`.

        **Raises:** ValueError where there is none: the file is no such product.
        """
        with refuse_damage(f"{self.path}: not a readable HDF5 file"):
            names = [name for name in map(str, self.file) if name.startswith(prefix)]
        if not names:
            raise ValueError(f"{self.path}: no group {prefix}...: no {self.product} product")
        return names

    def read_groups(
        self, prefix: str, read: Callable[[str], _Group]
    ) -> tuple[list[_Group], list[ValueError]]:
        """Return what `read` makes of the groups that begin with `prefix`, and its errors for the others.

        **Raises:** the first of these errors, where there is none but them; as `groups`.
        """
        groups, errors = [], []
        for name in self.groups(prefix):
            try:
                groups.append(read(name))
            except ValueError as error:
                errors.append(error)
        if not groups:
            raise errors[0]
        return groups, errors

    def has(self, name: str) -> bool:
        """Return True if the file has a dataset or group of that name."""
        with refuse_damage(f"{self.location(name)}: damaged"):
            return name in self.file

    def dataset(self, name: str, ndim: int = 1, shape: tuple[int, ...] | None = None) -> Any:
        """Return a dataset of numbers of `ndim` dimensions, or of a shape, all of which the file stores.

        **Raises:** ValueError, naming the file and the dataset, where that is not so.
        """
        location, ndim = self.location(name), ndim if shape is None else len(shape)
        with refuse_damage(f"{location}: damaged"):
            node = self.file.get(name)
            stored, kind = getattr(node, "shape", None), getattr(getattr(node, "dtype", None), "kind", None)
        if stored is None or kind is None:
            raise ValueError(f"{location}: no such dataset; it is part of a {self.product} product")
        if kind not in "iuf":
            raise ValueError(f"{location}: type {node.dtype} where numbers belong")
        if len(stored) != ndim:
            dimensions = "one dimension belongs" if ndim == 1 else f"{ndim} dimensions belong"
            raise ValueError(f"{location}: shape {stored}, where {dimensions}")
        with refuse_damage(f"{location}: damaged"):
            # HDF5 returns zeros for what is not stored, as many as are declared.
            is_elsewhere = node.is_virtual or node.external
            chunk = node.chunks or stored
            chunks = math.prod(math.ceil(size / part) if part else 0 for size, part in zip(stored, chunk))
            contiguous = node.id.get_storage_size() // max(node.nbytes, 1)
            n_stored = node.id.get_num_chunks() if node.chunks else contiguous
        if is_elsewhere or n_stored < chunks:
            raise ValueError(
                f"{location}: {math.prod(stored)} numbers are declared, but the file holds {n_stored} of "
                f"{chunks} parts of them"
            )
        if shape not in (None, stored):
            raise ValueError(f"{location}: shape {stored}; admissible is {shape}, as of the other datasets")
        stated = {attribute: self.attribute(name, attribute) for attribute in _STORED_AS_COUNTS}
        packed = [key for key, usual in _STORED_AS_COUNTS.items() if stated[key] not in (None, usual)]
        if packed:
            raise ValueError(f"{location}: {', '.join(packed)}: counts, which are not read")
        check_unpacked_size(self.path, f"/{name}", chunks * math.prod(chunk) * node.dtype.itemsize)
        return node

    def attribute(self, name: str, key: str) -> Any:
        """Return an attribute of a dataset or group; None where it has none.

        **Raises:** ValueError, naming the file and the dataset, where it is damaged.
        """
        with refuse_damage(f"{self.location(name)}: damaged"):
            node = self.file[name]
            if key not in node.attrs:
                return None
            is_plain = node.attrs.get_id(key).dtype.kind in _PLAIN_KINDS
            # A link may lead to another file.
            is_here = node.file.filename == self.file.filename
            return (self._checked_file[node.name] if is_here and not is_plain else node).attrs[key]

    def read(
        self, name: str, ndim: int = 1, rows: Any = slice(None), shape: tuple[int, ...] | None = None
    ) -> np.ndarray:
        """Return the stored numbers of a dataset, or of some of its rows. **Raises:** as `dataset`."""
        dataset = self.dataset(name, ndim, shape)
        with refuse_damage(f"{self.location(name)}: damaged"):
            return dataset[rows]

    def integers(self, name: str) -> np.ndarray:
        """Return the whole numbers of a dataset. **Raises:** as `dataset`; ValueError for another type."""
        numbers = self.read(name)
        if numbers.dtype.kind not in "iu":
            raise ValueError(f"{self.location(name)}: type {numbers.dtype} where whole numbers belong")
        return numbers

    def numbers(
        self,
        name: str,
        unit: str = "",
        *,
        ndim: int = 1,
        rows: Any = slice(None),
        shape: tuple[int, ...] | None = None,
    ) -> Float[np.ndarray, "..."]:
        """Return numbers in double precision; NaN where they are missing.

        **Arguments:** `unit`: in which they are returned, whatever unit the attribute `units` states: "m",
        "degrees", "rad", "s" or, of times, such as "s since 2018-01-01". Others stay as they are.

        **Raises:** as `dataset`; ValueError for attributes that are no numbers, and for a unit or an epoch
        that is not known.
        """
        stored = self.read(name, ndim, rows, shape)
        with np.errstate(over="ignore", invalid="ignore"):
            values = stored.astype(np.float64)
            is_missing = self._is_missing(name, stored)
            if self._is_fill is not None:
                is_missing |= self._is_fill(values)
        return self._in_unit(name, np.where(is_missing, np.nan, values), unit)

    def _is_missing(self, name: str, values: np.ndarray) -> np.ndarray:
        """Return True where attributes declare numbers missing."""
        is_missing = np.zeros(values.shape, bool)

        def as_compared(stated: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            # Attributes may have another type: of two types the less precise one, to which one was rounded.
            low = min((values.dtype, stated.dtype), key=lambda dtype: dtype.itemsize)
            is_float = values.dtype.kind == stated.dtype.kind == "f"
            return (values.astype(low), stated.astype(low)) if is_float else (values, stated)

        for key in _FILL_ATTRIBUTES:
            if (fill := self._stated_numbers(name, key)) is not None:
                is_missing |= np.isin(*as_compared(fill))
        limits = {key: self._stated_numbers(name, key) for key in ("valid_min", "valid_max", "valid_range")}
        if (both := limits.pop("valid_range")) is not None:
            if both.size != 2:
                raise ValueError(f"{self.location(name)}: valid_range = {both}; admissible are two numbers")
            limits["valid_min"], limits["valid_max"] = both[:1], both[1:]
        for key, limit in limits.items():
            if limit is not None:
                compared, bound = as_compared(limit[:1])
                is_missing |= compared < bound if key == "valid_min" else compared > bound
        flags = self._stated_numbers(name, "flag_values")
        # With masks, the values are those of some of the bits.
        if flags is not None and self.attribute(name, "flag_masks") is None:
            is_missing |= ~np.isin(*as_compared(flags))
        return is_missing

    def _stated_numbers(self, name: str, key: str) -> np.ndarray | None:
        """Return the numbers of an attribute, which may be text; None where it states none, as "N/A".

        **Raises:** ValueError for text with digits that is no list of numbers.
        """
        stated = self.attribute(name, key)
        if stated is None:
            return None
        numbers = np.atleast_1d(np.asarray(stated)).ravel()
        if numbers.dtype.kind in "iuf":
            return numbers if numbers.size else None
        words = " ".join(map(text_of_attribute, numbers.tolist())).strip(" []()").replace(",", " ").split()
        try:
            return np.array(list(map(float, words))) if words else None
        except ValueError:
            if not any(character.isdigit() for character in "".join(words)):
                return None
            raise ValueError(
                f"{self.location(name)}: {key} = {' '.join(words)!r}; admissible are numbers"
            ) from None

    def _in_unit(self, name: str, values: Float[np.ndarray, "..."], unit: str) -> Float[np.ndarray, "..."]:
        """Return values of a dataset in a unit, as that of `numbers`."""
        unit, _, epoch = unit.partition(_SINCE)
        stated = [self.attribute(name, key) for key in ("units", "unit")] if unit in _UNITS else []
        stated = [text_of_attribute(text) for text in stated if text is not None]
        if not stated:
            return values
        (kind, size), location = _UNITS[unit], self.location(name)
        name_of_unit, _, stated_epoch = stated[0].partition(_SINCE)
        stated_size = unit_size(kind, location, name_of_unit)
        if stated_size is not None and not units_agree(stated_size, size):
            values = values * (stated_size / size)
        if epoch and stated_epoch:
            values = values + _seconds_between(location, epoch, stated_epoch) / size
        return values


class CheckedHeapStream(io.FileIO):
    """A file from which HDF5 reads no global heap in which it would stay for ever.

    **Raises:** OSError where one is read.
    """

    def __init__(self, path: Path, size_of_lengths: int):
        super().__init__(path, "rb")
        self._size_of_lengths = size_of_lengths

    def readinto(self, buffer: Any, /) -> int | None:
        start, count = self.tell(), super().readinto(buffer)
        # HDF5 keeps bytes that it has read and reads the others: those of a heap may come in parts.
        first = max(start - len(_HEAP) + 1, 0)
        self.seek(first)
        content = self.read(start - first + (count or 0) + len(_HEAP) - 1)
        for match in re.finditer(re.escape(_HEAP), content):
            self._check_heap(first + match.start())
        self.seek(start + (count or 0))
        return count

    def _check_heap(self, start: int) -> None:
        """Go through the objects of a heap as HDF5 does. **Raises:** OSError at a step of no length."""
        length = self._size_of_lengths
        header = _aligned(_OBJECT_SIZE_OFFSET + length)
        self.seek(start + len(_HEAP))
        size = int.from_bytes(self.read(length), "little")
        self.seek(start)
        # HDF5 refuses a heap that is longer than the file, and an object that is longer than the heap.
        heap = self.read(min(size, os.fstat(self.fileno()).st_size))
        position = header
        while position + header <= len(heap):
            number = int.from_bytes(heap[position : position + 2], "little")
            size_start = position + _OBJECT_SIZE_OFFSET
            size = int.from_bytes(heap[size_start : size_start + length], "little")
            # Sums overflow as those of HDF5 do.
            step = (header + _aligned(size) if number else size) % 2**64
            if step == 0:
                raise OSError(
                    f"the heap at byte {start} has an object of no length at byte {start + position}"
                )
            position += step


def _aligned(size: int) -> int:
    """Return the size of what is kept to a multiple of the alignment of heaps."""
    return -(-size // _HEAP_ALIGNMENT) * _HEAP_ALIGNMENT


def _seconds_between(location: str, epoch: str, stated_epoch: str) -> float:
    """Return the seconds from an epoch to that which a file states. **Raises:** ValueError for no time."""
    text = stated_epoch.strip().removesuffix("UTC").removesuffix("Z").strip()
    try:
        stated = datetime.datetime.fromisoformat(text)
        return (stated.replace(tzinfo=None) - datetime.datetime.fromisoformat(epoch)).total_seconds()
    except ValueError:
        raise ValueError(
            f"{location}: times since {stated_epoch!r}; admissible is a date such as {epoch}"
        ) from None


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
