"""Coordinates of airborne files: whether they are geographic, and what their units are in metres.

Files name their coordinate system by GeoTIFF keys or as text. The unit of length need not be read from it:
two ways of 1 ns are 0.1499 m long, in whatever unit.
"""

import struct
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxlidar.io.checks import STEP, STEP_TOLERANCE

# Record of the GeoTIFF keys and of the system as text; the key of the kind of system and its value.
GEO_KEYS, WKT = 34735, 2112
_MODEL, _GEOGRAPHIC = 1024, 2
_KEY = struct.Struct("<4H")
# Units of length in m: metre and foot.
_UNITS = (1.0, 0.3048)
# WGS-84: semi-major axis in m, and squared eccentricity.
_AXIS, _ECCENTRICITY2 = 6378137.0, 0.00669437999014


def is_geographic(keys: bytes, wkt: bytes = b"") -> bool:
    """Whether coordinates are longitude and latitude in degrees, by a record of GeoTIFF keys or by text."""
    whole = len(keys) // _KEY.size * _KEY.size
    return (_MODEL, 0, 1, _GEOGRAPHIC) in _KEY.iter_unpack(keys[:whole]) or wkt.startswith(b"GEOG")


def geographic_keys() -> bytes:
    """A record of GeoTIFF keys that says that coordinates are geographic, WGS-84."""
    return b"".join(
        _KEY.pack(*row) for row in ((1, 1, 0, 2), (_MODEL, 0, 1, _GEOGRAPHIC), (2048, 0, 1, 4326))
    )


class Frame(NamedTuple):
    """How the coordinates of a file become metres.

    - `geographic`: whether x and y are degrees.
    - `unit`: m per unit of length.
    """

    geographic: bool
    unit: float

    def metres(self, anchor: Float[np.ndarray, "*shots 3"]) -> Float[np.ndarray, "*shots 3"]:
        """Metres per unit of x, y and z at places."""
        if not self.geographic:
            return np.full(anchor.shape, self.unit)
        latitude, up = np.deg2rad(anchor[..., 1]), self.unit * anchor[..., 2]
        w = 1.0 - _ECCENTRICITY2 * np.sin(latitude) ** 2
        east = (_AXIS / np.sqrt(w) + up) * np.cos(latitude)
        north = _AXIS * (1.0 - _ECCENTRICITY2) / w**1.5 + up
        degree = np.pi / 180.0
        return np.stack([east * degree, north * degree, np.full(up.shape, self.unit)], axis=-1)

    def wrong(
        self, anchor: Float[np.ndarray, "*shots 3"], direction: Float[np.ndarray, "*shots 3"]
    ) -> np.ndarray:
        """Whether directions do not have the length that light goes there and back in 1 ns."""
        length = np.linalg.norm(direction * self.metres(anchor), axis=-1)
        return np.asarray(~(np.abs(length - STEP) <= STEP_TOLERANCE * STEP))


def frame_of(
    place: str,
    geographic: bool,
    anchor: Float[np.ndarray, "shots 3"],
    direction: Float[np.ndarray, "shots 3"],
) -> Frame:
    """The frame in which most directions, in units per ns, have the length that they must have.

    **Raises:** ValueError, naming the place and the length, where there is none.
    """
    frames = [Frame(geographic, unit) for unit in _UNITS]
    for frame in frames:
        if np.mean(frame.wrong(anchor, direction)) < 0.5:
            return frame
    length = np.median(np.linalg.norm(direction * frames[0].metres(anchor), axis=-1))
    raise ValueError(
        f"{place}: directions of {length:g} m per ns, where light goes {STEP:.4f} m there and back; read are "
        "coordinates in metres, feet or, where the file says so, degrees"
    )
