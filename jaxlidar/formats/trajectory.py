"""Reader of trajectories: tables of position and attitude, as inertial navigation systems export them."""

import os
import re
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxlidar._fields.checks import UnitWarning
from jaxlidar._fields.columns import NamedColumn, check_columns, match_columns, plain_name
from jaxlidar._fields.crs import (
    common_system,
    directions_of_north,
    metric_system,
    system_of_name,
    transform,
    units_agree,
)
from jaxlidar._fields.units import unit_size
from jaxlidar.formats.checks import MAX_COORDINATE
from jaxlidar.formats.coordinates import GEOGRAPHIC
from jaxlidar.formats.text import parse_number, read_lines, split_cells
from jaxlidar.sensors.trajectory import Trajectory

# Names of columns in files, without case, spaces, underscores and units.
_NAMES = {
    "time": (
        "time",
        "gpstime",
        "gpsseconds",
        "gpstimesow",
        "timesow",
        "sow",
        "secofweek",
    ),
    "x": ("x", "easting", "east", "e"),
    "y": ("y", "northing", "north", "n"),
    "z": ("z", "height", "altitude", "alt", "elevation", "hell", "hellip", "hmsl", "ellipsoidheight", "h"),
    "longitude": ("longitude", "lon", "long", "lng"),
    "latitude": ("latitude", "lat"),
    "roll": ("roll", "phi"),
    "pitch": ("pitch", "theta"),
    "yaw": ("yaw", "heading", "trueheading", "azimuth", "psi", "hdg"),
}
# What stands in the place of the unit of GPS times, which are seconds.
_SECONDS = ("sow", "gps")
# Kinds of the units of columns; those of others are angles.
_KINDS = {"time": "time", "x": "length", "y": "length", "z": "length"}
# Names, followed by units, of times that are not GPS time: UTC differs from it by leap seconds, and seconds
# of the day do not count the days of the week.
_OTHER_TIME = re.compile(
    r"utc|gmt|unix|posix|glonass|ofday|systemtime|pctime|local(time|sec)|tai(time|sec)|time(local|tai|sod|tod)"
    r"|^(tai|sod|tod)$"
)
# A comment that names a unit of length or a reference system.
_COMMENT = re.compile(r"\s*#\s*(crs|srs|units?)\s*[:=]\s*(.*?)\s*$", re.IGNORECASE)


def read_trajectory(path: str | os.PathLike[str], *, crs: str | None = None) -> Trajectory:
    r"""Read the trajectory of a platform from a table with one row for each time.

    **Arguments:**

    - `path`: a text file of comma-, semicolon-, tab- or space-separated values. Its first line that does
      not open with "#", or else the last one that does, names the columns, in any order and case, with
      spaces or underscores, and with a unit, as in `x [ft]` or `x_ft`, where it is not the usual one: GPS
      time in s, as time, GPSTime or SOW; x or easting, y or northing, and z, height or altitude in m; roll,
      pitch, and yaw or heading in degrees. Comments such as "# units: feet" and "# crs: EPSG:2263" name the
      unit of lengths without one. Further columns are not read; a `UserWarning` names those that nearly
      have the name of one that is missing. Without roll and pitch these are zero; without yaw the platform
      heads along its course.
    - `crs`: a map's coordinate reference system in metres, such as "EPSG:32633". Columns longitude and
      latitude, on WGS 84, are projected to it, and headings, which are from true north, turned to the map's;
      so is a true heading beside x and y. Default None: the file has x and y, and headings are the map's.

    **Returns:** a `Trajectory`, in the sense of roll, pitch and yaw that it states, with the `crs` of the
    argument or the comment.

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the line, for
    columns that are missing, or that several columns may be; times that are UTC, local or of the day, unless
    a column of GPS time is beside them; longitude and latitude, or a true heading, without `crs`, and `crs`
    without these; units that are not known; rows of another length, and cells that are not finite numbers;
    coordinates that are not on Earth; and what a `Trajectory` refuses. ImportError where `crs` is given and
    `pyproj`, of the extra `io`, is not installed.

    **Warns:** UserWarning where longitude and latitude are transformed to a map of another datum with an
    accuracy that is coarser than 0.1 m or unknown.

    **Example:**

    >>> import pathlib, tempfile
    >>> import jaxlidar.io
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "flight.csv"
    >>> _ = path.write_text("GPSTime (s),Easting,Northing,Height,Roll,Pitch,Heading\n10,5,6,700,1,-2,90\n")
    >>> flight = jaxlidar.io.read_trajectory(path)
    >>> flight.position.tolist(), flight.yaw.tolist()
    ([[5.0, 6.0, 700.0]], [90.0])
    """
    path, lines = read_lines(path)
    head, delimiter, columns = _header(path, lines)
    location, n_columns = f"{path}: line {head + 1}", len(_cells(path, head + 1, lines[head], delimiter))
    sizes = {name: column.size(location, _KINDS.get(name, "angle")) for name, column in columns.items()}
    is_geographic = "longitude" in columns
    # A heading from true north beside longitude and latitude need not say so.
    is_true = "yaw" in columns and "true" in plain_name(columns["yaw"].name)
    if is_true and crs is None:
        name = columns["yaw"].name
        raise ValueError(f"{location}: {name!r} is from true north; give crs, the map of x and y")
    declared, declared_crs = _declared_in_comments(path, lines, is_geographic)
    for name, size in declared.items():
        # A unit beside the name of a column goes before those of comments.
        if name in columns and columns[name].unit is None and size is not None:
            sizes[name] = size
    if is_geographic and crs is None:
        crs = declared_crs
    if is_geographic and crs is None:
        raise ValueError(f"{location}: longitude and latitude; give crs, the map that they are projected to")
    if crs is not None and not is_geographic and not is_true:
        raise ValueError(
            f"{location}: crs is given, but the columns are x and y, and no heading is named as one from "
            "true north; admissible is crs = None"
        )
    rows, numbers = [], []
    for number, text in enumerate(lines[head + 1 :], head + 2):
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        cells = split_cells(path, number, text, delimiter, n_columns)
        rows.append([_value(path, number, column, cells) for column in columns.values()])
        numbers.append(number)
    if not rows:
        raise ValueError(f"{path}: line {len(lines)}: there is no row in the file")
    values = {name: sizes[name] * column for name, column in zip(columns, np.array(rows).T)}
    for name in ("x", "y", "z"):
        if name in values and np.any(np.abs(values[name]) > MAX_COORDINATE):
            row = int(np.argmax(np.abs(values[name]) > MAX_COORDINATE))
            raise ValueError(f"{path}: line {numbers[row]}: {name} lies beyond {MAX_COORDINATE:g} m")
    if is_geographic:
        assert crs is not None
        values["x"], values["y"] = _projected(path, crs, values["longitude"], values["latitude"])
    yaw = values.get("yaw")
    if yaw is not None and crs is not None:
        # 359.9 degrees from true north may be 361 from the map's.
        projection = metric_system("crs", crs).crs
        yaw = np.fmod(yaw - directions_of_north(projection, values["x"], values["y"]), 360.0)
    position = np.stack([values[axis] for axis in "xyz"], axis=-1)
    angles = [columns[name] for name in ("roll", "pitch", "yaw") if name in columns]
    try:
        with warnings.catch_warnings():
            if any(column.unit is not None for column in angles):
                # Angles whose unit the file names are what they are.
                warnings.simplefilter("ignore", UnitWarning)
            map_name = crs if is_geographic else common_system({"crs": crs, str(location): declared_crs})
            roll, pitch = values.get("roll", 0.0), values.get("pitch", 0.0)
            return Trajectory(values["time"], position, roll, pitch, yaw, map_name)
    except ValueError as error:
        raise ValueError(f"{path}: line {numbers[0]} and following: {error}") from error


def _header(path: Path, lines: list[str]) -> tuple[int, str, dict[str, NamedColumn]]:
    """Return the index of the line that names the columns, the delimiter, and the columns in use."""
    data = [i for i, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")]
    if not data:
        raise ValueError(f"{path}: line 1: there is no row in the file")
    head = data[0]
    # A table may name its columns in a comment: then the first other line has numbers alone.
    if head > 0 and re.fullmatch(r"[-+\d.eE,;\s]+", lines[head]):
        head -= 1
        while head > 0 and _COMMENT.match(lines[head]):
            head -= 1
        lines[head] = lines[head].lstrip().lstrip("#")
    delimiter = max(",;\t ", key=lambda d: (lines[head].count(d) > 0, d != " ", lines[head].count(d)))
    location = f"{path}: line {head + 1}"
    names = [cell.strip() for cell in _cells(path, head + 1, lines[head], delimiter)]
    other_times = [name for name in names if _OTHER_TIME.search(re.sub(r"[\[\]()]", "", plain_name(name)))]
    columns = match_columns(location, ["" if name in other_times else name for name in names], _NAMES)
    if "time" in columns:
        if (columns["time"].unit or "").lower() in _SECONDS:
            columns["time"] = columns["time"]._replace(unit=None)
    elif other_times:
        raise ValueError(
            f"{location}: {other_times[0]!r} is not GPS time; admissible is a column of GPS time, whose name "
            f"may be {', '.join(_NAMES['time'])}"
        )
    # One angle of an attitude is not an attitude; heading alone is.
    angles = ("roll", "pitch") if ("roll" in columns) != ("pitch" in columns) else ()
    check_columns(location, names, columns, _NAMES, ("time", "z", *angles))
    return head, delimiter, columns


def _declared_in_comments(
    path: Path, lines: list[str], is_geographic: bool
) -> tuple[dict[str, float | None], str | None]:
    """Return the metres per unit of x, y and z, and the system, that comments of a file declare.

    Comments are as "# units: feet" and "# crs: EPSG:2263". A system of the Earth's own, as EPSG:4326, is that
    of longitude and latitude, and is not returned; that of x and y is returned in metres.

    **Raises:** ValueError for several units or systems, a unit beside a system of another, and degrees where
    the columns are x and y.
    """
    declared: dict[str, tuple[str, str]] = {}
    for number, line in enumerate(lines, 1):
        if comment := _COMMENT.match(line):
            name = "crs" if comment[1].lower() in ("crs", "srs") else "units"
            location = f"{path}: line {number}"
            if declared.setdefault(name, (location, comment[2]))[1] != comment[2]:
                raise ValueError(f"{location}: {comment[2]!r} after {declared[name][1]!r}; admissible is one")
    horizontal = vertical = None
    crs = None
    if "crs" in declared:
        system = system_of_name(declared["crs"][0] + ": crs", declared["crs"][1])
        if is_geographic:
            crs = declared["crs"][1] if system.kind == "map" else None
        else:
            horizontal, vertical = system.lengths(declared["crs"][0])
            crs = system.map_name
    if "units" in declared:
        location, text = declared["units"]
        unit = unit_size("length", location, text)
        if horizontal is not None and unit is not None and not units_agree(horizontal, unit):
            raise ValueError(f"{location}: {text}, but the system {declared['crs'][1]} is in another unit")
        horizontal = vertical = unit
    return {"x": horizontal, "y": horizontal, "z": vertical}, crs


def _cells(path: Path, line: int, text: str, delimiter: str) -> list[str]:
    """Return the names of the columns; those apart by spaces have none, and units are names' own."""
    return split_cells(path, line, re.sub(r"\s+(?=[\[(])", "", text) if delimiter == " " else text, delimiter)


def _value(path: Path, line: int, column: NamedColumn, cells: list[str]) -> float:
    value = parse_number(path, line, column.name, cells[column.index])
    if not np.isfinite(value):
        raise ValueError(f"{path}: line {line}: {column.name} is not finite")
    return value


def _projected(
    path: Path, crs: str, longitude: Float[np.ndarray, " n"], latitude: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return x and y on a map, m."""
    projection = metric_system("crs", crs).crs
    for name, values, limit in (("longitude", longitude, 360.0), ("latitude", latitude, 90.0)):
        if np.any(np.abs(values) > limit):
            raise ValueError(
                f"{path}: {name} = {values[np.abs(values) > limit][0]:g} is outside [-{limit:g}, {limit:g}]"
            )
    x, y = transform(str(path), GEOGRAPHIC, projection, longitude, latitude).T
    if not np.all(np.isfinite(x) & np.isfinite(y)):
        raise ValueError(f"{path}: a position lies outside the projection {crs}")
    return x, y
