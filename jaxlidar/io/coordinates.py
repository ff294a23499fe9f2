"""Coordinate reference systems and units of files: what a file declares is used, or the file is refused.

All readers and writers take both from here. A file declares its system as GeoTIFF keys, as well-known text
(WKT) or by name, and units by name as well. PROJ, by the package pyproj, understands systems, and GDAL, by
rasterio, GeoTIFF keys: the axes of systems have directions and units, so no key and no text is interpreted
here. Names of units alone have a table.

A system may leave the unit of heights open, as EPSG:2225 does: its x and y are in feet. The default is in
`CoordinateSystem.lengths`; for waveforms it is not needed, because light that returns 1 ns later comes from
0.1499 m farther, in whatever unit (`find_units`).

Source: OGC 19-008r4, GeoTIFF 1.1; OGC 18-010r11, well-known text.
"""

import contextlib
import dataclasses
import functools
import json
import math
import struct
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxlidar._fields.checks import check_kind, warn_user
from jaxlidar._registry import common_crs
from jaxlidar.io.checks import TWO_WAY_METRES_PER_NS, TWO_WAY_TOLERANCE, required_for

# Numbers of the variable length records of LAS and PulseWaves files that declare the system: GeoTIFF keys
# with their floating-point numbers and texts, WKT, and a transformation of coordinates as WKT.
_GEO_KEYS, _GEO_DOUBLES, _GEO_TEXTS, WKT_RECORD, _TRANSFORMATION = 34735, 34736, 34737, 2112, 2111
# GeoTIFF keys: the kind of model, codes of systems and projections, and units.
_MODEL, _GEOGRAPHIC_CODE, _PROJECTED_CODE, _PROJECTION, _METHOD = 1024, 2048, 3072, 3074, 3075
_ANGULAR_UNIT, _ANGLE_SIZE, _LENGTH_UNIT, _LENGTH_SIZE, _VERTICAL_UNIT = 2054, 2055, 3076, 3077, 4099
_MODEL_PROJECTED, _MODEL_GEOGRAPHIC = 1, 2
# Codes of GeoTIFF for "undefined" and "defined by the user", that is, by other keys.
_NO_CODES = (0, 32767)
# A GeoTIFF key, or the header of a directory of keys.
_KEY = struct.Struct("<4H")
# The names of units of length, which have no case and may be plural, by their size in m.
_UNIT_NAMES = {
    1.0: ("m", "metre", "meter"),
    0.3048: ("ft", "foot", "feet", "international foot", "international feet"),
    1200 / 3937: ("us-ft", "ftus", "us survey foot", "us survey feet", "survey foot", "foot us", "us foot"),
    0.9144: ("yd", "yard"),
    0.0254: ("in", "inch", "inches"),
    1000.0: ("km", "kilometre", "kilometer"),
    0.1: ("dm", "decimetre", "decimeter"),
    0.01: ("cm", "centimetre", "centimeter"),
    0.001: ("mm", "millimetre", "millimeter"),
}
_METRES_BY_NAME = {name: metres for metres, names in _UNIT_NAMES.items() for name in names}
# Those of angles, by their size in rad.
_ANGLE_NAMES = {
    math.pi / 180.0: ("degree", "deg", "degrees north", "degrees east", "degree north", "degree east"),
    math.pi / 200.0: ("gradian", "grad", "gon"),
    1.0: ("radian", "rad"),
}
_RADIANS_BY_NAME = {name: radians for radians, names in _ANGLE_NAMES.items() for name in names}
# Those of times, by their size in s.
_TIME_NAMES = {
    1.0: ("second", "sec", "s"),
    1e-3: ("millisecond", "msec", "ms"),
    1e-6: ("microsecond", "usec", "us"),
    1e-9: ("nanosecond", "nsec", "ns"),
    60.0: ("minute", "min"),
    3600.0: ("hour", "hr", "h"),
    86400.0: ("day", "d"),
}
_SECONDS_BY_NAME = {name: seconds for seconds, names in _TIME_NAMES.items() for name in names}
# Lengths in m that waveforms without a declared unit may have: metre and foot.
_UNDECLARED_LENGTHS = (1.0, 0.3048)
# Units of length in m in which heights are given; those of x and y, such as km, may be larger.
_HEIGHT_UNITS = (0.1, 1.0)
# Units agree to this fraction: a foot of the US survey differs from the international one by 2e-6.
_UNIT_TOLERANCE = 1e-8
# WGS-84: semi-major axis in m, and squared eccentricity.
_SEMI_MAJOR_AXIS, _ECCENTRICITY2 = 6378137.0, 0.00669437999014
# Longitude and latitude, and those with height above the ellipsoid, of WGS-84.
GEOGRAPHIC, GEOGRAPHIC_3D = "EPSG:4326", "EPSG:4979"
# A transformation is warned of whose accuracy, m, is coarser than this, or unknown.
_COARSEST_ACCURACY = 0.1
# No unit of length has this many metres; a degree, or a gradian, of latitude has some 1e5.
_MIN_METRES_PER_ANGLE = 1e4
# Longest text of a system that messages quote: a code, but no WKT. Confidence, of 100, of PROJ that a system
# is that of a code: names of a few parts may differ.
_LONGEST_CODE, _SURE = 40, 70
# Elevations in m from which light returns: from the deepest trench to the highest clouds.
MIN_ELEVATION, MAX_ELEVATION = -12_000.0, 20_000.0


# -- systems -----------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class CoordinateSystem:
    """The coordinate reference system that a file declares.

    - `name`: for messages.
    - `kind`: "map" for x to the east and y to the north, "geographic" for longitude and latitude,
      "geocentric" for coordinates from the centre of the Earth.
    - `horizontal`: m per unit of x and y; of a geographic system, rad per unit. None: not declared.
    - `vertical`: m per unit of height. None: not declared.
    - `crs`: the `pyproj.CRS`. None: no system is declared.
    """

    name: str = "no coordinate reference system"
    kind: str = "map"
    horizontal: float | None = None
    vertical: float | None = None
    crs: Any = None

    # Each shot of a file asks for it, and PROJ takes milliseconds.
    @functools.cached_property
    def text(self) -> str | None:
        """The system as a code, or as WKT; None if none is declared."""
        if self.crs is None:
            return None
        authority = self.crs.to_authority(min_confidence=100)
        return self._with_same_units(":".join(authority)) if authority else self.wkt

    @property
    def wkt(self) -> str:
        """The system as WKT, of version 1 where that can hold it. There must be one."""
        import pyproj.exceptions

        try:
            return self._with_same_units(self.crs.to_wkt("WKT1_GDAL"))
        except pyproj.exceptions.CRSError:
            return self.crs.to_wkt()

    @property
    def map_name(self) -> str | None:
        """The name of the same map in metres; None where none is declared, or its unit is not known."""
        return self.in_metres().text if self.kind == "map" and self.horizontal is not None else None

    def _with_same_units(self, text: str) -> str:
        """Return the text, or WKT of version 2 where the text does not keep the unit of each axis."""
        copy = system_of_name("crs", text)
        is_same = (copy.horizontal, copy.vertical) == (self.horizontal, self.vertical)
        return text if is_same else self.crs.to_wkt()

    def horizontal_length(self, location: str) -> float:
        """Return the metres per unit of x and y: the declared ones, otherwise those of heights or 1.

        **Raises:** ValueError, naming the location in the file, for degrees and geocentric coordinates.
        """
        if self.kind != "map":
            unit = "geocentric coordinates" if self.kind == "geocentric" else "coordinates in degrees"
            raise ValueError(f"{location}: {unit} ({self.name}); project them to metres")
        return self.horizontal or self.vertical or 1.0

    def lengths(self, location: str) -> tuple[float, float]:
        """Return the metres per unit of x and y, and per unit of height.

        Where the system has no unit of heights, they have that of x and y, as the points of LAS files do.

        **Raises:** ValueError, naming the location in the file, for degrees, geocentric coordinates and
        heights without a unit beside kilometres.
        """
        horizontal = self.horizontal_length(location)
        vertical = self.vertical or horizontal
        if not _HEIGHT_UNITS[0] <= vertical <= _HEIGHT_UNITS[1] and self.vertical is None:
            raise ValueError(
                f"{location}: x and y are in units of {horizontal:g} m ({self.name}), heights in none"
            )
        return horizontal, vertical

    def in_metres(self) -> "CoordinateSystem":
        """Return the same system with the metre as unit of its axes. Geographic ones are not changed."""
        units = [unit for unit in (self.horizontal, self.vertical) if unit is not None]
        if self.crs is None or self.kind != "map" or all(units_agree(unit, 1.0) for unit in units):
            return self
        definition = self.crs.to_json_dict()
        for component in definition.get("components", [definition]):
            system = component.get("source_crs", component)
            for axis in system["coordinate_system"]["axis"]:
                axis["unit"] = "metre"
            # The code names the system in its own unit.
            system.pop("id", None)
            system["name"] += " in metres"
        definition.pop("id", None)
        return system_of_name("crs", json.dumps(definition))


def import_pyproj(purpose: str) -> Any:
    """Return the package pyproj. **Raises:** ImportError that names the purpose."""
    with required_for(purpose):
        import pyproj
        import pyproj.transformer
    return pyproj


def import_rasterio(purpose: str) -> Any:
    """Return the package rasterio. **Raises:** ImportError that names the purpose."""
    with required_for(purpose):
        import rasterio
        import rasterio.errors
    return rasterio


def system_of_crs(location: str, crs: Any) -> CoordinateSystem:
    """Return the system of a `pyproj.CRS`, or of another class that gives WKT; None declares nothing.

    **Raises:** ValueError, naming the location in the file, for axes that lead west or south or down, and
    for x and y of different units.
    """
    if not crs:
        return CoordinateSystem()
    pyproj = import_pyproj("reading coordinate reference systems")
    if not isinstance(crs, pyproj.CRS):
        # Those of rasterio.
        crs = pyproj.CRS.from_wkt(crs.to_wkt(version="WKT2_2019"))
    name, kind, horizontal, vertical = crs.name or "an unnamed system", "map", None, None
    for component in crs.sub_crs_list or [crs]:
        system = component.source_crs if component.is_bound else component
        coordinates = system.coordinate_system.name
        upward = [axis for axis in system.axis_info if axis.direction == "up"]
        level = [axis for axis in system.axis_info if axis.direction != "up"]
        directions = {axis.direction for axis in level}
        if system.is_geocentric:
            kind, upward = "geocentric", level
        elif coordinates == "ellipsoidal":
            kind = "geographic"
        elif coordinates not in ("cartesian", "vertical"):
            raise ValueError(f"{location}: {coordinates} coordinates ({name}) are not read")
        # Both axes of a polar projection lead south, or north.
        if directions & {"down", "west"} or (directions & {"south"} and len(directions) > 1):
            raise ValueError(
                f"{location}: axes to the {' and '.join(sorted(directions))} ({name}); read are those to the "
                "east, north and up"
            )
        units = {_unit_size(axis) for axis in level}
        if len(units) > 1:
            raise ValueError(f"{location}: x and y have different units ({name})")
        horizontal = units.pop() if units else horizontal
        vertical = _unit_size(upward[0]) if upward else vertical
    return CoordinateSystem(name, kind, horizontal, vertical, crs)


def _unit_size(axis: Any) -> float | None:
    """Return the size of an axis's unit in m or rad; None for one that GDAL did not find in a file."""
    is_unknown = axis.unit_name == "unknown" and axis.unit_conversion_factor == 1
    return None if is_unknown else axis.unit_conversion_factor


def units_agree(a: float, b: float) -> bool:
    """Return True if two sizes of units are the same but for rounding."""
    return math.isclose(a, b, rel_tol=_UNIT_TOLERANCE)


def system_of_name(field: str, name: str) -> CoordinateSystem:
    """Return the system of an argument, such as "EPSG:32633" or WKT.

    **Raises:** TypeError where it is no string; ValueError for a name that PROJ does not know.
    """
    check_kind(field, name, str, "the name of a coordinate reference system, or None")
    pyproj = import_pyproj("reading coordinate reference systems")
    try:
        crs = pyproj.CRS.from_user_input(name)
    except pyproj.exceptions.CRSError as error:
        raise ValueError(f"{field} = {name!r} is not known ({error})") from error
    return system_of_crs(f"{field} = {name!r}", crs)


def metric_system(field: str, name: str) -> CoordinateSystem:
    """Return the system of an argument whose coordinates, and heights, are metres on a map.

    **Raises:** as `system_of_name`; ValueError for another unit.
    """
    system = system_of_name(field, name)
    units = (system.horizontal, 1.0 if system.vertical is None else system.vertical)
    if system.kind != "map" or not all(unit is not None and units_agree(unit, 1.0) for unit in units):
        raise ValueError(
            f"{field} = {name!r} is not in metres; admissible is a projected system, such as EPSG:32633"
        )
    return system


@functools.lru_cache
def _map_in_metres(field: str, name: str) -> CoordinateSystem:
    return metric_system(field, name)


@common_crs.register
def common_system(names: Mapping[str, Any]) -> str | None:
    """Return the name of the one coordinate reference system of all, by field; None where none has one.

    One with a system of heights agrees with one without. An EPSG number becomes a name.

    **Raises:** ValueError for two systems, naming both, for one that is not known and one that is not in
    metres; TypeError for what is no name; ImportError where pyproj is not installed.
    """
    first_field = ""
    first: str | None = None
    for field, name in names.items():
        if name is None:
            continue
        name = f"EPSG:{name}" if type(name) is int else name
        check_kind(field, name, str, "the name of a coordinate reference system, its EPSG number, or None")
        system = _map_in_metres(field, name)
        if first is None or name == first:
            first_field, first = first_field or field, name
            continue
        first_system = _map_in_metres(first_field, first)
        (level, heights), (other_level, other_heights) = map(level_and_heights, (first_system, system))
        if not (_are_equal(level, other_level) and _are_equal(heights, other_heights)):
            raise ValueError(
                f"{field} is in {_short_name(system)}, {first_field} in {_short_name(first_system)}; "
                "admissible is one coordinate reference system: jaxlidar.io.to_crs transforms points, "
                "inventories and trajectories"
            )
        first = name if heights is None else first
    return first


def _short_name(system: CoordinateSystem) -> str:
    text = system.text or ""
    return text if len(text) <= _LONGEST_CODE else system.name


def level_and_heights(system: CoordinateSystem) -> tuple[Any, Any]:
    """Return the `pyproj.CRS` of x and y, and that of heights; None for one that is not declared."""
    crs = system.crs
    parts = [part.source_crs if part.is_bound else part for part in crs.sub_crs_list or [crs]]
    level, heights = ([part for part in parts if part.is_vertical == is_up] for is_up in (False, True))
    return (level or [None])[0], (heights or [None])[0]


def _are_equal(a: Any, b: Any) -> bool:
    """Return True for systems that are the same, by definition or code, and where one is not known."""
    if a is None or b is None or a.equals(b, ignore_axis_order=True):
        return True
    code = a.to_authority(min_confidence=_SURE)
    return code is not None and code == b.to_authority(min_confidence=_SURE)


def transform(
    location: str, source: Any, target: Any, *coordinates: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n axes"]:
    """Transform coordinates, x or longitude first, from one system to another; not finite where impossible.

    **Warns:** UserWarning, naming the location, which is a file or an argument, with the accuracy that PROJ
    states for the transformation, where that is coarser than 0.1 m or unknown, and with the file of a better
    one that is not installed. Conversions within one datum, as from longitude and latitude to UTM, are exact.
    An ellipsoid without a datum is taken for that of the other system, without a warning.
    """
    pyproj = import_pyproj("transforming coordinates")
    source, target = pyproj.CRS.from_user_input(source), pyproj.CRS.from_user_input(target)
    with warnings.catch_warnings():
        # That the best one is not installed is said below, with what its lack costs.
        warnings.simplefilter("ignore")
        transformer = pyproj.Transformer.from_crs(source, target, always_xy=True)
    result = np.stack(transformer.transform(*coordinates), axis=-1)
    operation = transformer.get_last_used_operation()
    # Conversions are exact, and PROJ states no accuracy, -1, as of transformations where it is not known.
    steps = [step for step in operation.operations or () if step.type_name != "Conversion"]
    has_datums = _has_datum(source) and _has_datum(target)
    is_known = all(step.accuracy >= 0 or (_equates_datums(step) and not has_datums) for step in steps)
    accuracy = operation.accuracy if is_known else math.inf
    if accuracy > _COARSEST_ACCURACY:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            group = pyproj.transformer.TransformerGroup(source, target, always_xy=True)
        better = [o for o in group.unavailable_operations if 0 <= o.accuracy < accuracy]
        grids = [grid.short_name for operation in better for grid in operation.grids]
        warn_user(
            f"{location}: the accuracy of the transformation from {source.name} to {target.name} is "
            f"{'not known' if math.isinf(accuracy) else f'{accuracy:g} m'}"
            + (f"; a better one needs a file that `projsync --file {grids[0]}` installs" if grids else ""),
            UserWarning,
        )
    return result


def _equates_datums(step: Any) -> bool:
    """Return True if nothing but the difference of two datums is unknown of a step of PROJ.

    It takes them for the same one where it knows no transformation between them. Heights above two surfaces
    may be equated by the same step.
    """
    name = step.name.lower()
    return "ballpark geo" in name and "ballpark vertical" not in name


def _has_datum(crs: Any) -> bool:
    """Return True if a system names its datum, which parameters of an ellipsoid alone do not."""
    return crs.datum is None or not crs.datum.name.lower().startswith(("unknown", "unnamed"))


def directions_of_north(
    crs: Any, x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Return the direction of a map's north at places on it, in degrees clockwise from true north."""
    pyproj = import_pyproj("turning headings from true north")
    projection = pyproj.Proj(crs)
    longitude, latitude = projection(x, y, inverse=True)
    return np.asarray(projection.get_factors(longitude, latitude).meridian_convergence)


def unit_length(location: str, unit: str | None) -> float | None:
    """Return the metres of a unit of length that a file names, such as "cm" or "0.01 m"; None without one.

    **Raises:** ValueError, naming the location in the file, for an unknown unit.
    """
    return _size_by_name(location, unit, _METRES_BY_NAME)


def unit_angle(location: str, unit: str | None) -> float | None:
    """Return the size in rad of a unit of angles that a file names; None without one.

    **Raises:** ValueError, naming the location in the file, for an unknown unit.
    """
    return _size_by_name(location, unit, _RADIANS_BY_NAME)


def unit_time(location: str, unit: str | None) -> float | None:
    """Return the seconds of a unit of time that a file names, such as "ms"; None without one.

    **Raises:** ValueError, naming the location in the file, for an unknown unit.
    """
    # "Seconds of the day" are seconds.
    return _size_by_name(location, None if unit is None else unit.partition(" of ")[0], _SECONDS_BY_NAME)


def _size_by_name(location: str, unit: str | None, sizes: dict[str, float]) -> float | None:
    words = (unit or "").strip().strip("[]()").lower().replace("_", " ").split()
    if not words:
        return None
    factor = 1.0
    with contextlib.suppress(ValueError):
        factor, words = float(words[0]), words[1:]
    name = " ".join(words)
    size = sizes.get(name, sizes.get(name.removesuffix("s")))
    if size is None or not 0 < factor < math.inf:
        raise ValueError(f"{location}: the unit {unit!r} is not known; known are {', '.join(sizes)}")
    return factor * size


@contextlib.contextmanager
def open_raster(path: Path, driver: str) -> Iterator[Any]:
    """Open a raster file with rasterio, with the vertical system that it declares.

    **Raises:** ImportError without rasterio; ValueError, naming the file, where it is damaged.
    """
    rasterio = import_rasterio("reading raster files")
    try:
        with warnings.catch_warnings(), rasterio.Env(GTIFF_REPORT_COMPD_CS="YES"):
            # A file without a position is refused by its reader.
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(path, driver=driver) as file:
                yield file
    except rasterio.errors.RasterioError as error:
        raise ValueError(f"{path}: damaged, or no file of the kind {driver} ({error})") from error


def check_elevations(location: str, elevation: np.ndarray | np.floating | float) -> None:
    """Refuse elevations, m, from which no light returns, as of geocentric coordinates. NaN passes.

    **Raises:** ValueError, naming the location in the file and the elevation.
    """
    elevation = np.asarray(elevation)
    wrong = (elevation < MIN_ELEVATION) | (elevation > MAX_ELEVATION)
    if np.any(wrong):
        index = np.argwhere(wrong)[0].tolist()
        raise ValueError(
            f"{location}: an elevation of {elevation[wrong].flat[0]:g} m{f' at {index}' if index else ''}; "
            f"admissible is [{MIN_ELEVATION:g}, {MAX_ELEVATION:g}]: coordinates may be geocentric, or in "
            "another unit"
        )


# -- declarations of LAS and PulseWaves files --------------------------------------------------------------


def declared_system(location: str, contents: Callable[[int], Sequence[bytes]]) -> CoordinateSystem:
    """Return the system that the projection records of a file declare, by WKT, GeoTIFF keys or both.

    **Arguments:** `contents`: returns the contents of the records of a number, ordinary and extended ones.

    **Raises:** ImportError without pyproj where a system is declared, or without rasterio where that is by
    GeoTIFF keys. ValueError, naming the location, for records that cannot be read, or disagree on units, and
    for a transformation of coordinates.
    """
    if contents(_TRANSFORMATION):
        raise ValueError(
            f"{location}: its coordinates are to be transformed (record {_TRANSFORMATION}): not read"
        )
    texts = (content.decode("utf-8", "replace").strip("\0 \t\r\n\ufeff") for content in contents(WKT_RECORD))
    systems = [_system_of_wkt(location, text) for text in texts if text]
    numbers, names = (b"".join(contents(number)) for number in (_GEO_DOUBLES, _GEO_TEXTS))
    systems += [_system_of_keys(location, keys, numbers, names) for keys in contents(_GEO_KEYS)]
    combined = CoordinateSystem()
    for system in systems:
        combined = _combine(location, combined, system)
    return combined


def _combine(location: str, a: CoordinateSystem, b: CoordinateSystem) -> CoordinateSystem:
    """Return what two declarations of a file say together. **Raises:** ValueError where they disagree."""
    if a.crs is None or b.crs is None:
        return b if a.crs is None else a
    pairs = ((a.horizontal, b.horizontal), (a.vertical, b.vertical))
    differs = a.kind != b.kind and a.horizontal is not None and b.horizontal is not None
    if differs or any(x and y and not units_agree(x, y) for x, y in pairs):
        units = " and ".join(f"{s.name!r} ({s.kind}, {s.horizontal}, {s.vertical} m or rad)" for s in (a, b))
        raise ValueError(f"{location}: it declares two coordinate systems that differ, {units}")
    is_b_richer = bool(b.horizontal and b.vertical and not a.vertical)
    return dataclasses.replace(
        b if is_b_richer else a, horizontal=a.horizontal or b.horizontal, vertical=a.vertical or b.vertical
    )


def _system_of_wkt(location: str, text: str) -> CoordinateSystem:
    pyproj = import_pyproj("reading coordinate reference systems")
    try:
        crs = pyproj.CRS.from_wkt(text)
    except pyproj.exceptions.CRSError as error:
        raise ValueError(
            f"{location}: its coordinate reference system {text[:60]!r} is not known ({error})"
        ) from error
    return system_of_crs(location, crs)


def _system_of_keys(location: str, directory: bytes, numbers: bytes, texts: bytes) -> CoordinateSystem:
    """Return the system of a directory of GeoTIFF keys, with the numbers and texts that it refers to."""
    complete = len(directory) // _KEY.size * _KEY.size
    keys = {row[0]: row for row in list(_KEY.iter_unpack(directory[:complete]))[1:]}
    if not keys:
        return CoordinateSystem()

    def system_of(selected: dict[int, tuple[int, ...]]) -> CoordinateSystem:
        return system_of_crs(location, _crs_of_keys(location, selected, numbers, texts))

    codes = [keys[key][3] for key in (_PROJECTED_CODE, _PROJECTION, _METHOD) if key in keys]
    has_projection = any(code not in _NO_CODES for code in codes)
    if _GEOGRAPHIC_CODE in keys and _MODEL not in keys and not has_projection:
        keys[_MODEL] = (_MODEL, 0, 1, _MODEL_GEOGRAPHIC)
    elif keys.get(_MODEL, (0, 0, 0, 0))[3] == _MODEL_PROJECTED and not has_projection:
        # GDAL skips the unit of a map without a projection, but not that of one without a model.
        keys = {key: row for key, row in keys.items() if key not in (_MODEL, _PROJECTED_CODE)}
    system = system_of(keys)
    # GDAL prefers the unit of a code to that of a key; a file that has another one in each is refused.
    units = {_LENGTH_UNIT, _LENGTH_SIZE, _VERTICAL_UNIT} if system.kind == "map" else {_VERTICAL_UNIT}
    if system.kind == "geographic":
        units |= {_MODEL, _ANGULAR_UNIT, _ANGLE_SIZE} if _ANGULAR_UNIT in keys else set()
    explicit = {key: row for key, row in keys.items() if key in units}
    return _combine(location, system, system_of(explicit)) if explicit else system


def _crs_of_keys(location: str, keys: dict[int, tuple[int, ...]], numbers: bytes, texts: bytes) -> Any:
    """Return the `rasterio.CRS` of GeoTIFF keys. **Raises:** ValueError where GDAL cannot read them.

    GDAL reads keys from TIFF files only: they are put into one, of one pixel, in memory.
    """
    rasterio = import_rasterio("reading GeoTIFF keys")
    rows = [_KEY.pack(1, 1, 1, len(keys)), *(_KEY.pack(*keys[key]) for key in sorted(keys))]
    # With GTIFF_REPORT_COMPD_CS, vertical systems are not left out.
    environment = rasterio.Env(GTIFF_REPORT_COMPD_CS="YES", GTIFF_POINT_GEO_IGNORE="YES")
    try:
        image = _tiff_of_keys(b"".join(rows), numbers, texts)
        with environment, rasterio.MemoryFile(image) as file, file.open(driver="GTiff") as dataset:
            return dataset.crs
    except (rasterio.errors.RasterioError, ValueError) as error:
        raise ValueError(f"{location}: its GeoTIFF keys cannot be read ({error})") from error


def _tiff_of_keys(directory: bytes, numbers: bytes, texts: bytes) -> bytes:
    """Return a TIFF file of one pixel with GeoTIFF keys: its tags, then their contents, then the pixel."""
    short, long, double, text = 3, 4, 12, 2
    # Width, height, bits, no compression, samples, rows of a strip and its bytes.
    values = {256: 1, 257: 1, 258: 8, 259: 1, 262: 1, 277: 1, 278: 1, 279: 1}
    # Size of a pixel and its place, without which a file has no coordinates.
    contents = {33550: (double, np.array([1.0, 1.0, 0.0]).tobytes()), 33922: (double, bytes(48))}
    contents[_GEO_KEYS] = (short, directory)
    if complete := len(numbers) // 8 * 8:
        contents[_GEO_DOUBLES] = (double, numbers[:complete])
    if texts:
        contents[_GEO_TEXTS] = (text, texts)
    size = {short: 2, double: 8, text: 1}
    count = len(values) + 1 + len(contents)
    offset = 8 + 2 + 12 * count + 4
    tags = {tag: struct.pack("<HHIHxx", tag, short, 1, value) for tag, value in values.items()}
    blob = b""
    for tag, (kind, content) in contents.items():
        length = len(content) // size[kind]
        in_place = content.ljust(4, b"\0") if len(content) <= 4 else struct.pack("<I", offset + len(blob))
        tags[tag] = struct.pack("<HHI4s", tag, kind, length, in_place)
        # Contents begin at even offsets.
        blob += content + b"\0" * (len(content) % 2)
    tags[273] = struct.pack("<HHII", 273, long, 1, offset + len(blob))
    entries = b"".join(tags[tag] for tag in sorted(tags))
    return struct.pack("<2sHIH", b"II", 42, 8, count) + entries + bytes(4) + blob + b"\0"


def wkt_of_units(horizontal: float, vertical: float) -> str:
    """Return WKT of a local system that declares its units alone, in m."""
    level = f'LOCAL_CS["local",LOCAL_DATUM["local",0],UNIT["unit",{horizontal!r}]]'
    height = f'VERT_CS["local",VERT_DATUM["local",2005],UNIT["unit",{vertical!r}],AXIS["Up",UP]]'
    return f'COMPD_CS["local",{level},{height}]'


# -- waveforms ---------------------------------------------------------------------------------------------


class CoordinateUnits(NamedTuple):
    """Units of coordinates x, y and z.

    - `geographic`: True if x and y are longitude and latitude.
    - `horizontal`: m, or rad of geographic coordinates, per unit of x and y.
    - `vertical`: m per unit of z.
    """

    geographic: bool
    horizontal: float
    vertical: float

    def metres(self, position: Float[np.ndarray, "*shots 3"]) -> Float[np.ndarray, "*shots 3"]:
        """Return the metres per unit of x, y and z at positions.

        A degree of longitude has the length of the parallel's radius, one of latitude that of the meridian's
        radius of curvature, both at the height of the position.
        """
        if not self.geographic:
            return np.broadcast_to([self.horizontal, self.horizontal, self.vertical], position.shape).copy()
        latitude, height = self.horizontal * position[..., 1], self.vertical * position[..., 2]
        w = 1.0 - _ECCENTRICITY2 * np.sin(latitude) ** 2
        east = (_SEMI_MAJOR_AXIS / np.sqrt(w) + height) * np.cos(latitude)
        north = _SEMI_MAJOR_AXIS * (1.0 - _ECCENTRICITY2) / w**1.5 + height
        vertical = np.full(height.shape, self.vertical)
        return np.stack([east * self.horizontal, north * self.horizontal, vertical], axis=-1)

    def has_wrong_length(
        self, anchor: Float[np.ndarray, "*shots 3"], direction: Float[np.ndarray, "*shots 3"]
    ) -> Bool[np.ndarray, "*shots"]:
        """Return True for directions whose length is not that which light goes there and back in 1 ns."""
        length = np.linalg.norm(direction * self.metres(anchor), axis=-1)
        difference = np.abs(length - TWO_WAY_METRES_PER_NS)
        return np.asarray(~(difference <= TWO_WAY_TOLERANCE * TWO_WAY_METRES_PER_NS))


def is_angle(metres: Float[np.ndarray, " 3"]) -> bool:
    """Return True if metres per unit of x, y and z are those of longitude, latitude and height."""
    return bool(metres[1] > _MIN_METRES_PER_ANGLE)


def find_units(
    location: str,
    system: CoordinateSystem,
    anchor: Float[np.ndarray, "shots 3"],
    direction: Float[np.ndarray, "shots 3"],
) -> CoordinateUnits:
    """Return the units, of those that the system admits, in which light goes the directions per ns.

    Anchors must lie near the surface of the Earth, such as where light first returns.

    Units that the system does not declare are metres or feet: those with which most directions have the
    length that light goes there and back in 1 ns.

    **Raises:** ValueError, naming the location in the file and the length, where there are none; and for
    geocentric coordinates, declared or not.
    """
    is_geographic = system.kind == "geographic"
    if system.kind == "geocentric":
        raise ValueError(f"{location}: geocentric coordinates ({system.name}): they are not read")
    undeclared = _UNDECLARED_LENGTHS
    if system.horizontal is not None and not is_geographic:
        undeclared = (system.horizontal, *_UNDECLARED_LENGTHS)
    candidates = [
        CoordinateUnits(is_geographic, vertical if system.horizontal is None else system.horizontal, vertical)
        for vertical in (undeclared if system.vertical is None else (system.vertical,))
    ]
    for units in candidates:
        if np.mean(units.has_wrong_length(anchor, direction)) < 0.5:
            check_elevations(location, anchor[:, 2] * units.vertical)
            return units
    length = np.median(np.linalg.norm(direction * candidates[0].metres(anchor), axis=-1))
    raise ValueError(
        f"{location}: directions of {length:g} m per ns, where light goes {TWO_WAY_METRES_PER_NS:.4f} m "
        f"there and back; the file declares {system.name}, and read are metres, feet and what it declares"
    )


def geographic_lines(
    location: str,
    system: CoordinateSystem,
    anchor: Float[np.ndarray, "shots 3"],
    direction: Float[np.ndarray, "shots 3"],
    time: Float[np.ndarray, " shots"],
) -> tuple[Float[np.ndarray, "shots 3"], Float[np.ndarray, "shots 3"]]:
    """Return lines of geocentric coordinates as longitude, latitude and height: anchors and directions.

    A straight line is curved in longitude, latitude and height: the lines returned touch it where light
    returns at `time`, ns, so that they are exact there. At d metres from there they are off by d^2 / 2R, with
    R the radius of the Earth: by 0.2 mm over 50 m.

    **Warns:** as `transform`, naming the location in the file.
    """
    touching = anchor + time[:, None] * direction
    place = transform(location, system.crs, GEOGRAPHIC_3D, *touching.T)
    longitude, latitude = np.deg2rad(place[:, :2]).T
    east = np.stack([-np.sin(longitude), np.cos(longitude), np.zeros_like(longitude)], axis=-1)
    up = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)],
        axis=-1,
    )
    axes = np.stack([east, np.cross(up, east), up], axis=1)
    local = np.einsum("sij,sj->si", axes, (system.horizontal or 1.0) * direction)
    local /= CoordinateUnits(True, math.pi / 180.0, 1.0).metres(place)
    return place - time[:, None] * local, local
