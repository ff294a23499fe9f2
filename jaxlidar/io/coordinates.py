"""Units of the coordinates of airborne files: geographic or not, and their size in metres.

Files name their coordinate system by GeoTIFF keys (OGC GeoTIFF 1.1, section 7) or as text. The unit of length
need not be read from it: light that returns 1 ns later comes from 0.1499 m farther, in whatever unit.
"""

import struct
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxlidar.io.checks import TWO_WAY_METRES_PER_NS, TWO_WAY_TOLERANCE

# Numbers of the variable length records with the GeoTIFF keys, and with the system as text.
GEO_KEYS, WKT = 34735, 2112
# The key GTModelTypeGeoKey and its value for longitude and latitude.
_MODEL, _GEOGRAPHIC = 1024, 2
# The key GeodeticCRSGeoKey and the EPSG code of WGS-84.
_SYSTEM, _WGS84 = 2048, 4326
_KEY = struct.Struct("<4H")
# Units of length in m: metre and foot.
_LENGTHS = (1.0, 0.3048)
# WGS-84: semi-major axis in m, and squared eccentricity.
_SEMI_MAJOR_AXIS, _ECCENTRICITY2 = 6378137.0, 0.00669437999014


def is_geographic(keys: bytes, wkt: bytes = b"") -> bool:
    """Return True if GeoTIFF keys, or a text, say that coordinates are longitude and latitude in degrees."""
    complete = len(keys) // _KEY.size * _KEY.size
    return (_MODEL, 0, 1, _GEOGRAPHIC) in _KEY.iter_unpack(keys[:complete]) or wkt.startswith(b"GEOG")


def geographic_keys() -> bytes:
    """Return GeoTIFF keys that say that coordinates are geographic, WGS-84."""
    header = (1, 1, 0, 2)
    rows = (header, (_MODEL, 0, 1, _GEOGRAPHIC), (_SYSTEM, 0, 1, _WGS84))
    return b"".join(_KEY.pack(*row) for row in rows)


class CoordinateUnits(NamedTuple):
    """Units of coordinates x, y and z.

    - `geographic`: True if x and y are degrees.
    - `length`: m per unit of length.
    """

    geographic: bool
    length: float

    def metres(self, position: Float[np.ndarray, "*shots 3"]) -> Float[np.ndarray, "*shots 3"]:
        """Return the metres per unit of x, y and z at positions.

        A degree of longitude has the length of the parallel's radius, one of latitude that of the meridian's
        radius of curvature, both at the height of the position.
        """
        if not self.geographic:
            return np.full(position.shape, self.length)
        latitude, height = np.deg2rad(position[..., 1]), self.length * position[..., 2]
        w = 1.0 - _ECCENTRICITY2 * np.sin(latitude) ** 2
        east = (_SEMI_MAJOR_AXIS / np.sqrt(w) + height) * np.cos(latitude)
        north = _SEMI_MAJOR_AXIS * (1.0 - _ECCENTRICITY2) / w**1.5 + height
        degree = np.pi / 180.0
        return np.stack([east * degree, north * degree, np.full(height.shape, self.length)], axis=-1)

    def has_wrong_length(
        self, anchor: Float[np.ndarray, "*shots 3"], direction: Float[np.ndarray, "*shots 3"]
    ) -> Bool[np.ndarray, "*shots"]:
        """Return True for directions whose length is not that which light goes there and back in 1 ns."""
        length = np.linalg.norm(direction * self.metres(anchor), axis=-1)
        difference = np.abs(length - TWO_WAY_METRES_PER_NS)
        return np.asarray(~(difference <= TWO_WAY_TOLERANCE * TWO_WAY_METRES_PER_NS))


def find_units(
    location: str,
    geographic: bool,
    anchor: Float[np.ndarray, "shots 3"],
    direction: Float[np.ndarray, "shots 3"],
) -> CoordinateUnits:
    """Return the units in which most directions, per ns, have the length that light goes there and back.

    **Raises:** ValueError, naming the location in the file and the length, where there are none.
    """
    candidates = [CoordinateUnits(geographic, length) for length in _LENGTHS]
    for units in candidates:
        if np.mean(units.has_wrong_length(anchor, direction)) < 0.5:
            return units
    length = np.median(np.linalg.norm(direction * candidates[0].metres(anchor), axis=-1))
    raise ValueError(
        f"{location}: directions of {length:g} m per ns, where light goes {TWO_WAY_METRES_PER_NS:.4f} m "
        "there and back; read are coordinates in metres, feet or, where the file says so, degrees"
    )
