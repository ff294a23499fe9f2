"""Checks that the readers share: files that are there, sizes that files may claim, and columns of tables."""

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from jaxlidar._constants import SPEED_OF_LIGHT

# Records of waveforms and points unpack to some ten times their file. A file that claims to unpack to more
# bytes than these times its size, and than these bytes in any case, is damaged or made to fill the memory.
TIMES, IN_ANY_CASE = 200, 2**24
# No coordinate of a record lies farther out, m; no sample of a digitiser holds more counts.
FARTHEST = MOST_COUNTS = 1e9
# Beyond, a number in double precision need not be the one that was written.
LARGEST_WHOLE = 2**53
# From sample to sample of a recorded waveform, m along the beam: 1 ns. One part in a hundred leaves room for
# air.
STEP, STEP_TOLERANCE = SPEED_OF_LIGHT / 2, 0.01

# What HDF5, h5netcdf, zarr and xarray raise for damaged files.
_DAMAGED = (OSError, RuntimeError, ValueError, KeyError, TypeError, AttributeError, OverflowError)


@contextlib.contextmanager
def refuse_damage(refusal: str) -> Iterator[None]:
    """Raise a ValueError that begins with `refusal` in place of what libraries raise for damaged files."""
    try:
        yield
    except _DAMAGED as error:
        raise ValueError(f"{refusal} ({error})") from error


def existing(path: str | os.PathLike[str]) -> Path:
    """The path of a file that is there.

    **Raises:** FileNotFoundError where it is not.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    return path


def check_unpacked(path: Path, place: str, size: int) -> None:
    """Refuse a part of a file that claims to unpack to more bytes than a file of that size plausibly holds.

    **Raises:** ValueError naming the file, the place and both sizes.
    """
    held = path.stat().st_size
    most = max(TIMES * held, IN_ANY_CASE)
    if size > most:
        raise ValueError(
            f"{path}: {place}: {size} bytes are declared in a file of {held} bytes; at most {most} are "
            "plausible"
        )


def column_of(place: str, names: Sequence[str], column: str) -> int:
    """The index of a column.

    **Raises:** ValueError, naming the place and the columns, unless there is exactly one of that name.
    """
    found = names.count(column)
    if found != 1:
        many = "no" if found == 0 else f"{found} times the"
        raise ValueError(f"{place}: {many} column {column}; there are {', '.join(map(str, names))}")
    return names.index(column)
