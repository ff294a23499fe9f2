"""Coordinate reference systems that files declare: what a file declares is used, or the file is refused.

All readers and writers take them from here. A file declares its system as GeoTIFF keys, as well-known text
(WKT) or by name. PROJ understands systems (`jaxlidar._fields.crs`), and GDAL, by rasterio, GeoTIFF keys:
no key and no text is interpreted here.

A system may leave the unit of heights open, as EPSG:2225 does: its x and y are in feet. The default is in
`CoordinateSystem.lengths`; for waveforms it is not needed, because light that returns 1 ns later comes from
0.1499 m farther, in whatever unit (`find_units`).

Source: OGC 19-008r4, GeoTIFF 1.1; OGC 18-010r11, well-known text.
"""

import contextlib
import dataclasses
import math
import struct
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxlidar._fields.checks import required_for
from jaxlidar._fields.crs import CoordinateSystem, import_pyproj, system_of_crs, transform, units_agree
from jaxlidar.formats.checks import TWO_WAY_METRES_PER_NS, TWO_WAY_TOLERANCE

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
# Lengths in m that waveforms without a declared unit may have: metre and foot.
_UNDECLARED_LENGTHS = (1.0, 0.3048)
# WGS-84: semi-major axis in m, and squared eccentricity.
_SEMI_MAJOR_AXIS, _ECCENTRICITY2 = 6378137.0, 0.00669437999014
# Longitude and latitude, and those with height above the ellipsoid, of WGS-84.
GEOGRAPHIC, GEOGRAPHIC_3D = "EPSG:4326", "EPSG:4979"
# No unit of length has this many metres; a degree, or a gradian, of latitude has some 1e5.
_MIN_METRES_PER_ANGLE = 1e4
# Elevations in m from which light returns: from the deepest trench to the highest clouds.
MIN_ELEVATION, MAX_ELEVATION = -12_000.0, 20_000.0


def import_rasterio(purpose: str) -> Any:
    """Return the package rasterio. **Raises:** ImportError that names the purpose."""
    with required_for(purpose):
        import rasterio
        import rasterio.errors
    return rasterio


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
