"""Reader of the places of footprints: text tables, and GEDI's levels 1B and 2A."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped

from jaxlidar._fields.checks import warn_user
from jaxlidar._fields.columns import check_columns, match_columns
from jaxlidar._fields.crs import transform
from jaxlidar.formats.checks import MAX_COORDINATE, FileWarning
from jaxlidar.formats.coordinates import GEOGRAPHIC
from jaxlidar.formats.gedi import BEAMS
from jaxlidar.formats.hdf5 import open_hdf5
from jaxlidar.formats.text import parse_number, read_table

# Beam of footprints whose file names none.
_BEAM = "BEAM0101"
# Names of columns of places, without case, spaces, underscores and units.
COLUMNS = {
    "x": ("x", "easting", "east"),
    "y": ("y", "northing", "north"),
    "longitude": ("longitude", "lon", "lng"),
    "latitude": ("latitude", "lat"),
    "shot_number": ("shotnumber", "shot"),
    "beam": ("beam",),
}
# That of shot numbers where none of the names above is.
_OTHER_NUMBER = {"shot_number": ("id",)}
# Longitude and latitude of shots in levels 1B and 2A: the first pair that a beam has is read.
_PLACES_OF_PRODUCTS = (
    ("lon_lowestmode", "lat_lowestmode"),
    ("geolocation/lon_lowestmode", "geolocation/lat_lowestmode"),
    ("geolocation/longitude_lastbin", "geolocation/latitude_lastbin"),
    ("geolocation/longitude_bin0", "geolocation/latitude_bin0"),
)
_PRODUCT = "GEDI L1B or L2A"
# Largest shot number: GeoPackage tables hold signed numbers of 64 bits.
_MAX_SHOT_NUMBER = 2**63 - 1


class Places(NamedTuple):
    """Places of footprints: (n, 2) x and y in m, (n,) shot numbers, and (n,) names of beams."""

    position: Float[np.ndarray, "n 2"]
    shot_number: Int[np.ndarray, " n"]
    beam: Shaped[np.ndarray, " n"]


def read_places(path: str | os.PathLike[str], crs: str) -> Places:
    """Read the places of footprints from a text table, or from a GEDI L1B or L2A file.

    **Arguments:**

    - `path`: a file whose name ends in ".h5", or a text file of comma-, semicolon- or tab-separated values,
      whose first line names its columns: x and y (easting and northing) in m in `crs`, or longitude and
      latitude (lon, lat) in degrees on WGS-84, or in the unit that a name ends with; and where they are known
      shot_number (shot; id where neither is), unique whole numbers up to 2^63 - 1, and beam, such as
      "BEAM0101", in any order and case, with spaces or underscores. Other columns are not read; a
      `UserWarning` names those that nearly have the name of one that is missing.
    - `crs`: coordinate reference system of x and y, in metres; or `GEOGRAPHIC`, in which longitudes and
      latitudes stay as they are.

    **Returns:** a `Places`. Without shot numbers, rows are numbered from 1; without beams, all are of
    "BEAM0101". Shots of products that have no place are skipped.

    **Warns:** `FileWarning` for every beam of a product with shots that have no place, naming the first and
    their number.

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the line or the
    dataset, for columns that are missing or ambiguous, rows of another length, cells that are no numbers,
    numbers of shots that are not unique, and names that are no beam's; for an HDF5 file that is neither
    product; for a file without a footprint.
    """
    if Path(path).suffix.lower() in (".h5", ".hdf5"):
        return _places_of_product(Path(path), crs)
    path, names, lines = read_table(path)
    location = f"{path}: line 1"
    columns = match_columns(location, names, COLUMNS)
    if "shot_number" not in columns:
        columns |= match_columns(location, names, _OTHER_NUMBER)
    check_columns(location, names, columns, COLUMNS)
    rows = dict(lines)
    if not rows:
        raise ValueError(f"{path}: line 2: no footprint; admissible is one row or more")
    is_of_map = "x" in columns
    axes, kind = (("x", "y"), "length") if is_of_map else (("longitude", "latitude"), "angle")
    cells = {
        quantity: [row[column.index].strip() for row in rows.values()] for quantity, column in columns.items()
    }

    def coordinates(axis: str, limit: float) -> list[float]:
        unit = columns[axis].size(location, kind)
        values = [unit * parse_number(path, number, axis, cell) for number, cell in zip(rows, cells[axis])]
        for number, value in zip(rows, values):
            # Written so that NaN is refused.
            if not abs(value) <= limit:
                raise ValueError(
                    f"{path}: line {number}: {axis} = {value:g}; admissible is [-{limit:g}, {limit:g}]"
                )
        return values

    limits = (MAX_COORDINATE, MAX_COORDINATE) if is_of_map else (180.0, 90.0)
    position = np.column_stack([coordinates(axis, limit) for axis, limit in zip(axes, limits)])
    if not is_of_map:
        position = _on_map(path, crs, position, [f"line {number}" for number in rows])
    shot_numbers = np.arange(1, len(rows) + 1, dtype=np.uint64)
    if "shot_number" in cells:
        shot_numbers = _shot_numbers(path, dict(zip(rows, cells["shot_number"])))
    beams = [cell.upper() for cell in cells.get("beam", [_BEAM] * len(rows))]
    for number, beam in zip(rows, beams):
        if beam not in BEAMS:
            raise ValueError(f"{path}: line {number}: beam = {beam!r} is none of {', '.join(BEAMS)}")
    return Places(position, shot_numbers, np.array(beams))


def _shot_numbers(path: Path, cells: dict[int, str]) -> Int[np.ndarray, " n"]:
    """Return the shot numbers of cells, by line. **Raises:** as `read_places`."""
    first_line: dict[int, int] = {}
    for line, cell in cells.items():
        if not (cell.isascii() and cell.isdigit()):
            raise ValueError(f"{path}: line {line}: shot_number = {cell!r} is no whole number from 0 on")
        # Python converts no text of thousands of digits.
        digits = cell.lstrip("0") or "0"
        if len(digits) > len(str(_MAX_SHOT_NUMBER)) or int(digits) > _MAX_SHOT_NUMBER:
            raise ValueError(
                f"{path}: line {line}: shot_number = {digits[:40]} is too large; admissible is "
                f"[0, {_MAX_SHOT_NUMBER}]"
            )
        number = int(digits)
        if number in first_line:
            raise ValueError(
                f"{path}: line {line}: shot_number = {number} is that of line {first_line[number]}, too"
            )
        first_line[number] = line
    return np.array(list(first_line), np.uint64)


def _places_of_product(path: Path, crs: str) -> Places:
    """Read the places of shots of levels 1B or 2A. **Raises:** as `read_places`."""
    shot_numbers, beams, places, locations, remarks = [], [], [], [], []
    with open_hdf5(path, _PRODUCT) as file:
        for beam in file.groups("BEAM"):
            pairs = [pair for pair in _PLACES_OF_PRODUCTS if all(file.has(f"{beam}/{n}") for n in pair)]
            if not pairs:
                raise ValueError(
                    f"{file.location(beam)}: no longitude and latitude; it is no {_PRODUCT} product"
                )
            axes = [file.numbers(f"{beam}/{n}", "degrees") for n in pairs[0]]
            numbers, location = file.read(f"{beam}/shot_number"), file.location(beam)
            if not axes[0].size == axes[1].size == numbers.size:
                raise ValueError(
                    f"{location}: {numbers.size} shot numbers belong to {axes[0].size} longitudes and "
                    f"{axes[1].size} latitudes"
                )
            degrees = np.stack(axes, axis=1)
            # Shots without a place have fill values.
            is_placed = (np.abs(degrees) <= [180.0, 90.0]).all(axis=1)
            (skipped,) = np.nonzero(~is_placed)
            if skipped.size:
                i = skipped[0]
                remarks.append(
                    f"{location}/{pairs[0][0]}, shot {numbers[i]}: longitude {degrees[i, 0]:g} and "
                    f"latitude {degrees[i, 1]:g} are no place: {skipped.size} of {numbers.size} shots of "
                    f"{beam} skipped"
                )
            shot_numbers.append(numbers[is_placed].astype(np.uint64))
            beams += [beam] * int(is_placed.sum())
            places.append(degrees[is_placed])
            locations += [f"{location}/shot_number[{i}]" for i in np.flatnonzero(is_placed)]
    numbers = np.concatenate(shot_numbers)
    if numbers.size == 0:
        raise ValueError(f"{path}: no shot has a place; admissible is a file with one or more")
    for remark in remarks:
        warn_user(remark, FileWarning)
    first_location: dict[int, str] = {}
    for number, location in zip(numbers.tolist(), locations):
        if first_location.setdefault(number, location) != location:
            raise ValueError(f"{location} = {number} is that of {first_location[number]}, too")
    rows = [f"shot {number}" for number in numbers]
    return Places(_on_map(path, crs, np.concatenate(places), rows), numbers, np.array(beams))


def _on_map(path: Path, crs: str, degrees: np.ndarray, rows: Sequence[str]) -> np.ndarray:
    """Return longitudes and latitudes as x and y, m; what lies outside the map of a product is not finite."""
    if crs == GEOGRAPHIC:
        return degrees
    position = transform(str(path), GEOGRAPHIC, crs, *degrees.T)
    outside = ~np.isfinite(position).all(axis=1)
    if outside.any():
        i = int(np.argmax(outside))
        raise ValueError(
            f"{path}: {rows[i]}: longitude {degrees[i, 0]:g} and latitude {degrees[i, 1]:g} lie outside of "
            f"the map {crs}"
        )
    return position
