"""Checks that readers share: existing files, sizes that a file may declare, admissible numbers, damage."""

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from jaxlidar._constants import SPEED_OF_LIGHT

# Waveforms and points unpack to some ten times the size of their file. A file that declares more than this
# factor, and more than these bytes, is damaged or made to fill the memory.
_MAX_EXPANSION, _ALWAYS_ADMISSIBLE_BYTES = 200, 2**24
# Largest coordinate, m, and largest count of a digitiser that readers admit.
MAX_COORDINATE = MAX_COUNTS = 1e9
# Double precision holds whole numbers up to this one exactly.
MAX_EXACT_INTEGER = 2**53
# Distance along the beam, m, from which light returns 1 ns later: half of what light travels in 1 ns. In air
# light is slower by 3e-4; one part in a hundred leaves room for that and for rounded directions.
TWO_WAY_METRES_PER_NS, TWO_WAY_TOLERANCE = SPEED_OF_LIGHT / 2, 0.01
# What HDF5, h5netcdf, zarr and xarray raise for damaged files.
DAMAGE_ERRORS = (OSError, RuntimeError, ValueError, KeyError, TypeError, AttributeError, OverflowError)
_FILTER = (
    "it is compressed by a filter that HDF5 lacks here: pip install hdf5plugin, and import hdf5plugin first"
)
# Why HDF5 cannot read a file that is not damaged, by words of its messages.
_OTHER_REASONS = {
    "unable to lock file": "it is in use: another process has it open and may write to it",
    "required filter": _FILTER,
    "can't open directory": _FILTER,
}


class FileWarning(UserWarning, ValueError):
    r"""Warning that a file was read, but not as a whole or not in every point as it says.

    The message names the file and the first such place, and counts what was skipped. The class is that of an
    error, too: a program that turns warnings into errors gets the ValueError that readers raise for files
    that they refuse.

    **Example:** refuse a tree whose second cylinder grows from one that is not in the file.

    >>> import pathlib, tempfile, warnings
    >>> import jaxlidar.io
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "tree.csv"
    >>> names = "ID,parentID,startX,startY,startZ,endX,endY,endZ,radius"
    >>> _ = path.write_text(f"{names}\n1,-1,0,0,0,0,0,2,0.1\n3,2,0,0,3,0,0,4,0.05\n")
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", jaxlidar.io.FileWarning)
    ...     try:
    ...         jaxlidar.io.read_qsm(path)
    ...     except ValueError as error:
    ...         print(str(error).partition("line ")[2])
    3: parent 2 is not in the file: 1 cylinder without a parent became a root
    """


@contextlib.contextmanager
def refuse_damage(refusal: str) -> Iterator[None]:
    """Raise a ValueError that begins with `refusal` in place of what libraries raise for damaged files."""
    try:
        yield
    except DAMAGE_ERRORS as error:
        # What HDF5 cannot read for another reason than damage.
        reason = next((text for words, text in _OTHER_REASONS.items() if words in str(error)), None)
        if reason is not None:
            refusal = f"{refusal.rpartition(': ')[0]}: {reason}"
        raise ValueError(f"{refusal} ({error})") from error


def existing_file(path: str | os.PathLike[str]) -> Path:
    """Return the path of a file that exists. **Raises:** FileNotFoundError."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: {'a folder, not a file' if path.is_dir() else 'no such file'}")
    return path


def check_unpacked_size(path: Path, location: str, size: int) -> None:
    """Refuse content that a file declares to unpack to more bytes than a file of its size plausibly holds.

    **Raises:** ValueError naming the file, the location in it and both sizes.
    """
    file_size, max_size = path.stat().st_size, max_unpacked_size(path)
    if size > max_size:
        raise ValueError(
            f"{path}: {location}: {size} bytes are declared in a file of {file_size} bytes; at most "
            f"{max_size} are plausible"
        )


def max_unpacked_size(path: Path) -> int:
    """Return the most bytes to which a file of its size plausibly unpacks."""
    return max(_MAX_EXPANSION * path.stat().st_size, _ALWAYS_ADMISSIBLE_BYTES)


def check_step_of_light(location: str, length: float, expected: float = TWO_WAY_METRES_PER_NS) -> None:
    """Refuse a length in m of 1 ns of a record that is not half of what light travels.

    **Arguments:** `expected`: what it is, m. In elevation it is less than along an inclined beam.

    **Raises:** ValueError naming the location and both lengths.
    """
    if not abs(length - expected) <= TWO_WAY_TOLERANCE * expected:
        raise ValueError(
            f"{location}: {length:g} m from sample to sample, where 1 ns of light, there and back, comes to "
            f"{expected:.4f} m"
        )


def column_index(location: str, names: Sequence[str], column: str) -> int:
    """Return the index of a column.

    **Raises:** ValueError, naming the location and the columns, unless exactly one has that name.
    """
    count = names.count(column)
    if count != 1:
        times = "no" if count == 0 else f"{count} times the"
        raise ValueError(f"{location}: {times} column {column}; there are {', '.join(map(str, names))}")
    return names.index(column)
