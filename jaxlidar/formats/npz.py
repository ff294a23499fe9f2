"""Arrays of .npz files; what they declare is compared with the file before anything is unpacked."""

import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from jaxlidar.formats.checks import check_unpacked_size, existing_file

# What NumPy and zipfile raise for damaged archives.
_DAMAGED = (
    *(OSError, EOFError, ValueError, TypeError, OverflowError, SyntaxError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError),
)
_HEADER_READERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def read_arrays(path: Path, keys: Iterable[str]) -> dict[str, np.ndarray]:
    """Return the named arrays of an .npz file, read-only. No others are read.

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the array, for
    one that is missing or damaged, and for one that declares another size than it has or a size that such a
    file does not hold.
    """
    existing_file(path)
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path}: no .npz file, or the end of one is missing")
    try:
        archive = zipfile.ZipFile(path)
    except _DAMAGED as error:
        raise ValueError(f"{path}: the archive: damaged ({error})") from error
    with archive:
        members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
        return {key: _read_array(path, key, archive, members) for key in keys}


def _read_array(
    path: Path, key: str, archive: zipfile.ZipFile, members: dict[str, zipfile.ZipInfo]
) -> np.ndarray:
    if key not in members:
        raise ValueError(f"{path}: {key}: no such array; there are {', '.join(members) or 'none'}")
    member = members[key]
    check_unpacked_size(path, key, member.file_size)
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{path}: {key}: packed by method {member.compress_type}, which no .npz file uses")
    try:
        # By hand, as numpy.load would allocate what the header declares before it reads.
        with archive.open(member) as stream:
            version = np.lib.format.read_magic(stream)
            if version not in _HEADER_READERS:
                raise ValueError(f"version {version} of the format is not known")
            shape, is_fortran_ordered, dtype = _HEADER_READERS[version](stream)
            if dtype.hasobject:
                raise ValueError("it holds Python objects")
            declared, available = math.prod(shape) * dtype.itemsize, member.file_size - stream.tell()
            if declared != available:
                raise ValueError(f"{dtype} of shape {shape} takes {declared} bytes; there are {available}")
            order = "F" if is_fortran_ordered else "C"
            return np.frombuffer(stream.read(), dtype).reshape(shape, order=order)
    except _DAMAGED as error:
        raise ValueError(f"{path}: {key}: damaged ({error})") from error
