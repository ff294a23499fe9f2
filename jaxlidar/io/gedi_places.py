"""Where on the earth the shots of a survey lie: the geolocation of GEDI's level 1B product."""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxlidar._checks import check_kind, check_number, concrete_number
from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar.instrument.survey import Survey

# Distance in m over which the direction of true north is found.
_SHORT = 100.0


def reference_system(origin: tuple[float, float] | None, crs: str | None) -> Any:
    """The projection that a survey's positions are in. **Raises:** as `write_gedi_l1b`."""
    from rasterio import CRS
    from rasterio.errors import CRSError

    if (origin is None) == (crs is None):
        raise ValueError(f"origin = {origin} and crs = {crs}: give one of them")
    if origin is not None:
        longitude, latitude = origin
        check_number("longitude of origin", longitude, -180.0, 180.0)
        check_number("latitude of origin", latitude, -90.0, 90.0)
        return CRS.from_string(
            f"+proj=aeqd +lat_0={float(latitude)!r} +lon_0={float(longitude)!r} +datum=WGS84 +units=m"
        )
    check_kind("crs", crs, str, "the name of a coordinate reference system")
    try:
        system = CRS.from_string(crs)
    except CRSError as error:
        raise ValueError(f"crs = {crs!r} is not known ({error})") from error
    if not system.is_projected or system.linear_units_factor[1] != 1.0:
        raise ValueError(
            f"crs = {crs!r} is not in metres; admissible is a projected system, such as EPSG:32633"
        )
    return system


def geolocation(
    survey: Survey,
    first: Float[np.ndarray, " shots"],
    count: np.ndarray,
    plane: Float[np.ndarray, " shots"],
    system: Any,
) -> dict[str, np.ndarray]:
    """Datasets of the group `geolocation`, each (shots,), with standard errors of zero.

    `first` is the time of the first bin in ns, `count` the number of bins of 1 ns, `plane` the elevation of
    the reference plane in m.
    """
    zenith, azimuth = np.deg2rad(survey.zenith), np.deg2rad(survey.azimuth)
    altitude = concrete_number(survey.lidar.altitude)
    # Heights above the reference plane, as those of `Waveform.height`.
    drop = 0.5 * SPEED_OF_LIGHT * np.cos(zenith)
    heights = {"bin0": -drop * first, "lastbin": -drop * (first + count - 1)}
    heights["instrument"] = np.full_like(first, altitude)
    across = np.stack([np.sin(azimuth), np.cos(azimuth)], axis=1) * np.tan(zenith)[:, None]
    found = {}
    for name, height in heights.items():
        longitude, latitude = _degrees(system, survey.position - height[:, None] * across)
        found[f"longitude_{name}"], found[f"latitude_{name}"] = longitude, latitude
        found["altitude_instrument" if name == "instrument" else f"elevation_{name}"] = plane + height
    for name, time in (("bin0", first), ("lastbin", first + count - 1)):
        found[f"bounce_time_offset_{name}"] = (
            1e-9 * (2 * altitude / (SPEED_OF_LIGHT * np.cos(zenith)) + time) / 2
        )
    # From the footprint to the sensor: against the light.
    towards = np.remainder(azimuth + _convergence(system, survey.position), 2 * math.pi) - math.pi
    found["local_beam_azimuth"] = towards.astype(np.float32)
    found["local_beam_elevation"] = (0.5 * math.pi - zenith).astype(np.float32)
    found |= {f"{name}_error": np.zeros(len(survey), np.float32) for name in found}
    found["degrade"] = np.zeros(len(survey), np.int8)
    return found


def _degrees(system: Any, position: Float[np.ndarray, "n 2"]) -> tuple[np.ndarray, np.ndarray]:
    """Longitude and latitude on WGS-84. **Raises:** ValueError beyond the projection's reach."""
    from rasterio.warp import transform

    longitude, latitude = map(np.array, transform(system, "EPSG:4326", *position.T))
    lost = ~(np.isfinite(longitude) & np.isfinite(latitude))
    if lost.any():
        bad = int(np.argmax(lost))
        raise ValueError(
            f"position: shot {bad} at {position[bad].tolist()} m lies outside the projection {system}"
        )
    return longitude, latitude


def _convergence(system: Any, position: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Direction of the projection's north in rad clockwise from true north, to a hundredth of itself."""
    half = np.array([0.0, 0.5 * _SHORT])
    (west, south), (east, north) = (_degrees(system, position + side * half) for side in (-1.0, 1.0))
    eastward = np.remainder(east - west + 180.0, 360.0) - 180.0
    return np.arctan2(eastward * np.cos(np.deg2rad(0.5 * (south + north))), north - south)
