"""Coordinate reference systems: that of a map, those that agree, and transformations between two of them.

PROJ, by the package pyproj, understands systems: their axes have directions and units, so no text is
interpreted here.
"""

import dataclasses
import functools
import json
import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxlidar._fields.checks import check_kind, required_for, warn_user

# Units of length in m in which heights are given; those of x and y, such as km, may be larger.
_HEIGHT_UNITS = (0.1, 1.0)
# Units agree to this fraction: a foot of the US survey differs from the international one by 2e-6.
_UNIT_TOLERANCE = 1e-8
# A transformation is warned of whose accuracy, m, is coarser than this, or unknown.
_COARSEST_ACCURACY = 0.1
# Longest text of a system that messages quote: a code, but no WKT. Confidence, of 100, of PROJ that a system
# is that of a code: names of a few parts may differ.
_LONGEST_CODE, _SURE = 40, 70


@dataclasses.dataclass(frozen=True)
class CoordinateSystem:
    """The coordinate reference system of a file, or of an argument.

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


def crs_name(x: Any) -> str | None:
    """Convert a field `crs`: the name of a map in metres, such as "EPSG:32633", its EPSG number, or None.

    **Raises:** as `common_system`.
    """
    return common_system({"crs": x})


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
    # PROJ chooses the operation by the coordinates.
    if len(result) == 0:
        return result
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
