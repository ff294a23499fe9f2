"""Surveys: one lidar and many shots, each with its position and direction.

A survey stores for each shot where the beam axis meets the reference plane z = 0, and the zenith and azimuth
of the beam. A scanner on a platform at the position q and height H, flying along the unit vector a with the
unit vector b to its right, whose beam has the direction (f, r, d) in the platform's frame (see `scan`), aims
at

    p = q + H (f a + r b) / d,   zenith = atan2(hypot(f, r), d),   azimuth = that of f a + r b.

Positions stay in double precision, as map coordinates of millions of metres need.
"""

import dataclasses
import math
import operator
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from jaxlidar._checks import (
    as_numpy,
    check_integer,
    check_kind,
    check_number,
    check_range,
    concrete_array,
    concrete_number,
)
from jaxlidar._memory import format_bytes, machine_memory
from jaxlidar._signatures import briefly
from jaxlidar._text import number_text
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.instrument.scan import MAX_ZENITH, AbstractScan

# A length that falls short of a multiple of the spacing by this fraction, as by rounding, counts as the
# multiple.
_SPACING_TOLERANCE = 1e-6
# Point clouds number flight lines with 16 bits.
MAX_FLIGHT_LINE = 2**16 - 1
# Bytes of a shot while a survey is made: its position and direction, and the terms of their sums.
_BYTES_PER_SHOT = 100.0
# More positions along a line than fit into any memory.
_LARGEST_COUNT = 1e30


@final
@briefly
class Survey(eqx.Module):
    """Many shots of one lidar: where the beam axis of each meets the reference plane, and its direction.

    `Survey.grid`, `Survey.track` and `Survey.scan` make regular surveys. `len(survey)` is the number of
    shots, `survey[i]` the `Lidar` of shot i, and `survey[a:b]` the survey of some of them. Positions are kept
    in double precision.

    **Arguments:**

    - `lidar`: the `Lidar` of all shots. Its own position is not used.
    - `position`: (shots, 2) x and y in m where the beam axis meets the reference plane z = 0.
    - `zenith`: angle between the beam and the vertical in degrees, in [0, 89], one number or (shots,).
      Default None: the lidar's.
    - `azimuth`: compass direction in which the beam travels in degrees, one number or (shots,). Default None:
      the lidar's.
    - `gps_time`: (shots,) s, as point clouds have it: seconds of the GPS week, or adjusted standard GPS time
      (GPS time less 1e9 s). Default None: not known.
    - `scan_angle`: (shots,) angle of the beam to the right of the track in degrees, in [-180, 180]. Default
      None: not known.
    - `flight_line`: number of the flight line, an integer in [0, 65535], one number or (shots,). Default
      None: not known.

    **Raises:** ValueError for arrays of other shapes, no shot at all, and values outside their ranges;
    TypeError for objects of the wrong type.

    **Example:**

    >>> import jaxlidar as jl
    >>> survey = jl.Survey(jl.Lidar(altitude=500.0), position=[(0, 0), (10, 0), (20, 0)], zenith=[0, 5, 10])
    >>> len(survey), float(survey[1].zenith), survey[1].position.tolist()
    (3, 5.0, [10.0, 0.0])
    """

    lidar: Lidar
    position: Float[np.ndarray, "shots 2"]
    zenith: Float[np.ndarray, " shots"]
    azimuth: Float[np.ndarray, " shots"]
    gps_time: Float[np.ndarray, " shots"] | None
    scan_angle: Float[np.ndarray, " shots"] | None
    flight_line: Float[np.ndarray, " shots"] | None

    def __init__(
        self,
        lidar: Lidar,
        position: Any,
        zenith: ArrayLike | Any | None = None,
        azimuth: ArrayLike | Any | None = None,
        *,
        gps_time: ArrayLike | Any | None = None,
        scan_angle: ArrayLike | Any | None = None,
        flight_line: ArrayLike | Any | None = None,
    ):
        check_kind("lidar", lidar, Lidar, "a Lidar, as in Survey(Lidar(), position=...)")
        check_range("position", position)
        positions = as_numpy(position, "position")
        if positions.ndim != 2 or positions.shape[1] != 2 or len(positions) == 0:
            raise ValueError(
                f"position has shape {positions.shape}; admissible is (shots, 2), one shot or more"
            )
        self.lidar, self.position = lidar, positions
        self.zenith = _per_shot("zenith", lidar.zenith if zenith is None else zenith, len(positions))
        self.azimuth = _per_shot("azimuth", lidar.azimuth if azimuth is None else azimuth, len(positions))
        check_range("zenith", self.zenith, 0.0, MAX_ZENITH)
        self.gps_time = _optional_per_shot("gps_time", gps_time, len(positions))
        self.scan_angle = _optional_per_shot("scan_angle", scan_angle, len(positions))
        self.flight_line = _optional_per_shot("flight_line", flight_line, len(positions))
        if self.scan_angle is not None:
            check_range("scan_angle", self.scan_angle, -180.0, 180.0)
        if self.flight_line is not None:
            check_range("flight_line", self.flight_line, 0, MAX_FLIGHT_LINE)
            if np.any(self.flight_line != np.floor(self.flight_line)):
                raise ValueError("flight_line has values that are not whole numbers")

    def __len__(self) -> int:
        return len(self.position)

    def __str__(self) -> str:
        columns = (
            ("x", self.position[:, 0], "m"),
            ("y", self.position[:, 1], "m"),
            ("zenith", self.zenith, ""),
        )
        spans = ", ".join(
            f"{name} {number_text(a.min())} to {number_text(a.max())} {unit}" for name, a, unit in columns
        )
        return f"Survey of {len(self):,} shots: {spans}degrees\n{self.lidar}"

    def __getitem__(self, shot: int | slice) -> "Lidar | Survey":
        if isinstance(shot, slice):
            columns = {name: getattr(self, name) for name in ("gps_time", "scan_angle", "flight_line")}
            return Survey(
                self.lidar,
                self.position[shot],
                self.zenith[shot],
                self.azimuth[shot],
                **{name: None if column is None else column[shot] for name, column in columns.items()},
            )
        i = self._index(shot)
        return self._lidar_at(self.position[i], i)

    def __iter__(self):
        return (self[i] for i in range(len(self)))

    def _lidar_at(self, position: Float[np.ndarray, "2"], shot: int) -> Lidar:
        """Aim the lidar at a position, in the direction of a shot."""
        angles = {name: jnp.asarray(getattr(self, name)[shot], float) for name in ("zenith", "azimuth")}
        return dataclasses.replace(self.lidar, position=position, **angles)

    def _index(self, shot: Any) -> int:
        """Return the index of a shot from the start; negative numbers count from the end."""
        n, i = len(self), operator.index(shot)
        if not -n <= i < n:
            raise IndexError(f"shot {i}: the survey has {n}; admissible are -{n} to {n - 1}")
        return i % n

    @staticmethod
    def of(lidar: Lidar) -> "Survey":
        """Make the survey of one shot: that of a lidar in its own position and direction."""
        zenith, azimuth = concrete_number(lidar.zenith), concrete_number(lidar.azimuth)
        return Survey(lidar, concrete_array(lidar.position)[None], zenith, azimuth)

    @property
    def middle(self) -> Lidar:
        """`Lidar` that aims at the middle of all positions, in the direction of the largest zenith angle."""
        middle = 0.5 * (self.position.min(axis=0) + self.position.max(axis=0))
        return self._lidar_at(middle, int(np.argmax(self.zenith)))

    def about(self, origin: Float[np.ndarray, "2"]) -> "Survey":
        """Make the same survey with positions relative to `origin`, (2,) x and y in m."""
        origin = _horizontal_position("origin", origin)
        return dataclasses.replace(self, position=self.position - origin)

    @property
    def direction(self) -> Float[np.ndarray, "shots 3"]:
        """Unit vectors (shots, 3) in which the beams travel."""
        return beam_directions(self.zenith, self.azimuth)

    @property
    def slant_range(self) -> Float[np.ndarray, " shots"]:
        """Distances (shots,) in m from the sensor to the reference plane, along the beam axes."""
        return concrete_number(self.lidar.altitude) / np.cos(np.deg2rad(self.zenith))

    @property
    def sensor(self) -> Float[np.ndarray, "shots 3"]:
        """Positions (shots, 3) of the sensor in m."""
        aim_point = np.pad(self.position, ((0, 0), (0, 1)))
        return aim_point - self.slant_range[:, None] * self.direction

    @property
    def footprint_radius(self) -> Float[np.ndarray, " shots"]:
        """Radii (shots,) in m of the beams at the reference plane, as `Lidar.footprint_radius`."""
        return self.slant_range * concrete_number(self.lidar.divergence) * 0.5e-3

    @staticmethod
    def grid(lidar: Lidar, low: Any, high: Any, spacing: Any) -> "Survey":
        """Make a survey of a regular grid of footprints, row after row from the south-west.

        **Arguments:**

        - `lidar`: the `Lidar` of all shots.
        - `low`: (x, y) of the first footprint in m.
        - `high`: (x, y) of the opposite corner, m, not below `low`. No footprint lies beyond it.
        - `spacing`: m between neighbours, positive, one number or (along x, along y).

        **Returns:** a `Survey`; along each axis it has one footprint at `low` and as many more as fit.

        **Raises:** ValueError for values outside their ranges, other shapes, and more shots than memory has
        room for; TypeError for arguments that are not numbers.

        **Example:**

        >>> import jaxlidar as jl
        >>> survey = jl.Survey.grid(jl.Lidar(), low=(0, 0), high=(20, 10), spacing=10.0)
        >>> survey.position.tolist()
        [[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [0.0, 10.0], [10.0, 10.0], [20.0, 10.0]]
        """
        first, last = _horizontal_position("low", low), _horizontal_position("high", high)
        check_range("spacing", spacing, 0.0, low_open=True)
        step = as_numpy(spacing, "spacing")
        if step.shape not in ((), (2,)):
            raise ValueError(f"spacing has shape {step.shape}; admissible is one number or (2,)")
        if np.any(last < first):
            raise ValueError(f"high = {last.tolist()} lies below low = {first.tolist()}")
        step = np.broadcast_to(step, (2,))
        counts = [_count_along(float(last[k] - first[k]), float(step[k])) for k in range(2)]
        _check_number_of_shots(f"spacing = {step.tolist()}", counts[0] * counts[1])
        x, y = (first[k] + step[k] * np.arange(counts[k]) for k in range(2))
        return Survey(lidar, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))

    @staticmethod
    def track(
        lidar: Lidar, start: Any, end: Any, spacing: Any, *, beams: int = 1, beam_spacing: Any = 600.0
    ) -> "Survey":
        """Make a survey of footprints along a line, of one beam or of several side by side as GEDI has.

        **Arguments:**

        - `lidar`: the `Lidar` of all shots.
        - `start`, `end`: (x, y) in m of the first footprint and of the end of the track. With several beams,
          the track is their middle line.
        - `spacing`: m between footprints along the track, positive; GEDI's are 60 m.
        - `beams`: number of beams, at least 1. Default 1; GEDI has 8.
        - `beam_spacing`: m between beams across the track, positive. Default 600, GEDI's.

        **Returns:** a `Survey`: all footprints of the leftmost beam first, then those of the next.

        **Raises:** ValueError for values outside their ranges, a line without length, and more shots than
        memory has room for; TypeError for arguments that are not numbers.

        **Example:**

        >>> import jaxlidar as jl
        >>> line = {"start": (0, 0), "end": (0, 120), "spacing": 60.0}
        >>> survey = jl.Survey.track(jl.Lidar(), **line, beams=2, beam_spacing=10.0)
        >>> survey.position.tolist()
        [[-5.0, 0.0], [-5.0, 60.0], [-5.0, 120.0], [5.0, 0.0], [5.0, 60.0], [5.0, 120.0]]
        """
        first, forward, right, length = _line(start, end)
        check_number("spacing", spacing, 0.0, low_open=True)
        check_number("beam_spacing", beam_spacing, 0.0, low_open=True)
        count = check_integer("beams", beams)
        count_along = _count_along(length, float(spacing))
        _check_number_of_shots(f"spacing = {float(spacing):g} with beams = {count}", count_along * count)
        along = float(spacing) * np.arange(count_along)
        across = float(beam_spacing) * (np.arange(count) - 0.5 * (count - 1))
        positions = first + across[:, None, None] * right + along[None, :, None] * forward
        return Survey(lidar, positions.reshape(-1, 2))

    @staticmethod
    def scan(
        lidar: Lidar,
        pattern: AbstractScan,
        start: Any,
        end: Any,
        speed: Any,
        pulse_rate: Any,
        *,
        gps_time: Any = 0.0,
        flight_line: Any = 1,
    ) -> "Survey":
        """Make a survey of the shots of a scanner on a level platform that flies along a line.

        The platform flies at the lidar's altitude above the reference plane. Zenith, azimuth and scan angle
        (across the track, positive to the right) follow from the pattern.

        **Arguments:**

        - `lidar`: the `Lidar` of all shots. Its own direction is not used.
        - `pattern`: an `Oscillating`, a `RotatingPolygon`, a `Conical`, or another `AbstractScan`.
        - `start`, `end`: (x, y) in m of the platform at the first shot and at the end of the line.
        - `speed`: of the platform in m/s, positive.
        - `pulse_rate`: shots per s, positive.
        - `gps_time`: GPS time of the first shot in s, as that of `Survey`. Default 0.
        - `flight_line`: number of the flight line. Default 1.

        **Returns:** a `Survey`, its shots in the order of time.

        **Raises:** ValueError for values outside their ranges, a line without length, more shots than memory
        has room for, and a pattern that looks more than 89 degrees from the vertical; TypeError for objects
        of the wrong type.

        **Example:**

        >>> import jaxlidar as jl
        >>> line = {"start": (0, 0), "end": (0, 100), "speed": 50.0, "pulse_rate": 1000.0}
        >>> survey = jl.Survey.scan(jl.Lidar(), jl.Conical(half_angle=20.0, frequency=40.0), **line)
        >>> print(len(survey), survey.zenith[:2].round(3).tolist())
        2001 [20.0, 20.0]
        """
        check_kind(
            "pattern", pattern, AbstractScan, "a scan pattern, as in Conical(half_angle=20, frequency=40)"
        )
        check_kind("lidar", lidar, Lidar, "a Lidar, as in Survey.scan(Lidar(), ...)")
        first, forward, right, length = _line(start, end)
        check_number("speed", speed, 0.0, low_open=True)
        check_number("pulse_rate", pulse_rate, 0.0, low_open=True)
        check_number("gps_time", gps_time)
        shots = _count_along(length, float(speed) / float(pulse_rate))
        rate = f"pulse_rate = {float(pulse_rate):g} at speed = {float(speed):g}"
        _check_number_of_shots(rate, shots)
        time = np.arange(shots) / float(pulse_rate)
        ahead, aside, down = np.moveaxis(np.asarray(pattern.direction(time), float), -1, 0)
        horizontal = ahead[:, None] * forward + aside[:, None] * right
        sine = np.hypot(ahead, aside)
        zenith = np.rad2deg(np.arctan2(sine, down))
        # A pattern at the limit may exceed it by rounding.
        if not np.all(zenith <= MAX_ZENITH + 1e-9):
            raise ValueError(
                f"pattern looks {float(np.max(zenith)):g} degrees from the vertical; admissible is "
                f"[0, {MAX_ZENITH:g}]"
            )
        platform = first + (float(speed) * time)[:, None] * forward
        positions = platform + float(lidar.altitude) * horizontal / down[:, None]
        azimuth = np.where(sine > 0, np.rad2deg(np.arctan2(horizontal[:, 0], horizontal[:, 1])) % 360.0, 0.0)
        return Survey(
            lidar,
            positions,
            np.minimum(zenith, MAX_ZENITH),
            azimuth,
            gps_time=float(gps_time) + time,
            scan_angle=np.rad2deg(np.arctan2(aside, down)),
            flight_line=flight_line,
        )


def beam_directions(
    zenith: Float[np.ndarray, " shots"], azimuth: Float[np.ndarray, " shots"]
) -> Float[np.ndarray, "shots 3"]:
    """Compute the unit vectors of beams from zenith and azimuth in degrees."""
    zenith, azimuth = np.deg2rad(zenith), np.deg2rad(azimuth)
    horizontal = np.sin(zenith)
    return np.stack([horizontal * np.sin(azimuth), horizontal * np.cos(azimuth), -np.cos(zenith)], axis=-1)


def _per_shot(field: str, x: Any, shots: int) -> Float[np.ndarray, " shots"]:
    """Convert one number for all shots, or one for each, to an array with one for each."""
    check_range(field, x)
    value = as_numpy(x, field)
    if value.shape not in ((), (shots,)):
        raise ValueError(
            f"{field} has shape {value.shape}; admissible is one number or ({shots},), as position"
        )
    return np.broadcast_to(value, (shots,)).copy()


def _optional_per_shot(field: str, x: Any, shots: int) -> Float[np.ndarray, " shots"] | None:
    """Convert as `_per_shot`; None stays None."""
    return None if x is None else _per_shot(field, x, shots)


def _horizontal_position(field: str, x: Any) -> Float[np.ndarray, "2"]:
    check_range(field, x)
    value = as_numpy(x, field)
    if value.shape != (2,):
        raise ValueError(f"{field} has shape {value.shape}; admissible is (2,): x and y")
    return value


def _line(start: Any, end: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return the start, the unit vectors forward and to the right, and the length of a line."""
    first, last = _horizontal_position("start", start), _horizontal_position("end", end)
    length = float(np.hypot(*(last - first)))
    if not length > 0:
        raise ValueError(f"end = {last.tolist()} is start; admissible is a line with a length")
    forward = (last - first) / length
    return first, forward, np.array([forward[1], -forward[0]]), length


def _count_along(length: float, step: float) -> int:
    """Count the positions that lie `step` apart on a line of a given length, including its start."""
    # A step that underflows in the division counts as one that no memory has room for.
    steps = min(length / step, _LARGEST_COUNT) if step > 0 else _LARGEST_COUNT
    return math.floor(steps * (1 + _SPACING_TOLERANCE) + _SPACING_TOLERANCE) + 1


def _check_number_of_shots(cause: str, shots: int) -> None:
    """Refuse a survey that does not fit into memory. `cause`: the arguments that ask for so many shots."""
    memory = machine_memory()
    if shots * _BYTES_PER_SHOT > memory:
        raise ValueError(
            f"{cause} asks for {shots:.3g} shots, which take about {format_bytes(shots * _BYTES_PER_SHOT)} "
            f"of memory; admissible are at most {memory / _BYTES_PER_SHOT:.3g} in the "
            f"{format_bytes(memory)} of this machine"
        )
