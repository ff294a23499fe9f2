"""Reader of the places of footprints: text tables, and GEDI's levels 1B and 2A."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped

from jaxlidar._fields.crs import transform
from jaxlidar.formats.checks import MAX_COORDINATE
from jaxlidar.formats.coordinates import GEOGRAPHIC
from jaxlidar.formats.gedi import BEAMS
from jaxlidar.formats.hdf5 import open_hdf5
from jaxlidar.formats.text import parse_number, read_lines, split_cells

# Beam of footprints whose file names none.
_BEAM = "BEAM0101"
# Names of columns of places, without case.
_COLUMNS = {
    "x": ("x", "easting", "east"),
    "y": ("y", "northing", "north"),
    "longitude": ("longitude", "lon", "lng"),
    "latitude": ("latitude", "lat"),
    "shot_number": ("shot_number", "shot", "id"),
    "beam": ("beam",),
}
# Longitude and latitude of shots in levels 1B and 2A: the first pair that a beam has is read.
_PLACES_OF_PRODUCTS = (
    ("lon_lowestmode", "lat_lowestmode"),
    ("geolocation/lon_lowestmode", "geolocation/lat_lowestmode"),
    ("geolocation/longitude_lastbin", "geolocation/latitude_lastbin"),
    ("geolocation/longitude_bin0", "geolocation/latitude_bin0"),
)
# Digits of a shot number that fit into 64 bits.
_MAX_DIGITS = 19


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
      latitude (lon, lat) in degrees on WGS-84; and where they are known shot_number (shot, id), unique whole
      numbers, and beam, such as "BEAM0101", in any order and case. Other columns are not read.
    - `crs`: coordinate reference system of x and y, in metres.

    **Returns:** a `Places`. Without shot numbers, rows are numbered from 1; without beams, all are of
    "BEAM0101".

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the line, for
    columns that are missing, rows of another length, cells that are no numbers, numbers of shots that are not
    unique, and names that are no beam's; for an HDF5 file that is neither product.
    """
    if Path(path).suffix.lower() in (".h5", ".hdf5"):
        return _places_of_product(Path(path), crs)
    path, lines = read_lines(path)
    delimiter = max(",;\t", key=lines[0].count) if lines else ","
    names = [name.strip().lower() for name in split_cells(path, 1, lines[0], delimiter)] if lines else []
    columns = {
        quantity: min(names.index(name) for name in known if name in names)
        for quantity, known in _COLUMNS.items()
        if set(known) & set(names)
    }
    axes = ("x", "y") if "x" in columns else ("longitude", "latitude")
    for axis in axes:
        if axis not in columns:
            raise ValueError(
                f"{path}: line 1: no column {axis}; admissible are x and y in m, or longitude and latitude "
                f"in degrees; there are {', '.join(names) or 'none'}"
            )
    numbers = [number for number, text in enumerate(lines[1:], 2) if text.strip()]
    if not numbers:
        raise ValueError(f"{path}: line 2: no footprint; admissible is one row or more")
    rows = [split_cells(path, number, lines[number - 1], delimiter, len(names)) for number in numbers]
    cells = {quantity: [row[i].strip() for row in rows] for quantity, i in columns.items()}

    def coordinates(axis: str, limit: float) -> list[float]:
        values = [parse_number(path, number, axis, cell) for number, cell in zip(numbers, cells[axis])]
        for number, value in zip(numbers, values):
            # Written so that NaN is refused.
            if not abs(value) <= limit:
                raise ValueError(
                    f"{path}: line {number}: {axis} = {value:g}; admissible is [-{limit:g}, {limit:g}]"
                )
        return values

    limits = (MAX_COORDINATE, MAX_COORDINATE) if axes[0] == "x" else (180.0, 90.0)
    position = np.column_stack([coordinates(axis, limit) for axis, limit in zip(axes, limits)])
    if axes[0] == "longitude":
        position = _on_map(path, crs, position, [f"line {number}" for number in numbers])
    shot_numbers = np.arange(1, len(rows) + 1, dtype=np.uint64)
    if "shot_number" in cells:
        first_line: dict[str, int] = {}
        for number, cell in zip(numbers, cells["shot_number"]):
            if not (cell.isascii() and cell.isdigit() and len(cell) <= _MAX_DIGITS):
                raise ValueError(f"{path}: line {number}: shot_number = {cell!r} is no whole number")
            if cell in first_line:
                raise ValueError(
                    f"{path}: line {number}: shot_number = {cell} is that of line {first_line[cell]}, too"
                )
            first_line[cell] = number
        shot_numbers = np.array([int(cell) for cell in cells["shot_number"]], np.uint64)
    beams = [cell.upper() for cell in cells.get("beam", [_BEAM] * len(rows))]
    for number, beam in zip(numbers, beams):
        if beam not in BEAMS:
            raise ValueError(f"{path}: line {number}: beam = {beam!r} is none of {', '.join(BEAMS)}")
    return Places(position, shot_numbers, np.array(beams))


def _places_of_product(path: Path, crs: str) -> Places:
    """Read the places of shots of levels 1B or 2A. **Raises:** as `read_places`."""
    product, shot_numbers, beams, places = "GEDI L1B or L2A", [], [], []
    with open_hdf5(path) as file:
        for beam in file.groups("BEAM", product):
            pairs = [pair for pair in _PLACES_OF_PRODUCTS if all(file.has(f"{beam}/{n}") for n in pair)]
            if not pairs:
                raise ValueError(
                    f"{file.location(beam)}: no longitude and latitude; it is no {product} product"
                )
            place = [
                file.in_unit(f"{beam}/{n}", file.numbers(f"{beam}/{n}", product), "degrees") for n in pairs[0]
            ]
            shot_numbers.append(file.read(f"{beam}/shot_number", product).astype(np.uint64))
            beams.append(np.full(shot_numbers[-1].size, beam))
            places.append(np.stack(place, axis=1))
    numbers, degrees = np.concatenate(shot_numbers), np.concatenate(places)
    if len(degrees) != numbers.size:
        raise ValueError(f"{path}: {numbers.size} shot numbers belong to {len(degrees)} places")
    # Shots without a place have fill values.
    is_placed = np.isfinite(degrees).all(axis=1) & (np.abs(degrees) <= [180.0, 90.0]).all(axis=1)
    numbers, beams = numbers[is_placed], np.concatenate(beams)[is_placed]
    rows = [f"shot {number}" for number in numbers]
    return Places(_on_map(path, crs, degrees[is_placed], rows), numbers, beams)


def _on_map(path: Path, crs: str, degrees: np.ndarray, rows: Sequence[str]) -> np.ndarray:
    """Return longitudes and latitudes as x and y, m; what lies outside the map of a product is not finite."""
    position = transform(str(path), GEOGRAPHIC, crs, *degrees.T)
    outside = ~np.isfinite(position).all(axis=1)
    if outside.any():
        i = int(np.argmax(outside))
        raise ValueError(
            f"{path}: {rows[i]}: longitude {degrees[i, 0]:g} and latitude {degrees[i, 1]:g} lie outside of "
            f"the map {crs}"
        )
    return position
