"""Surveys: one lidar and many shots, each with its place and direction."""

import dataclasses
import math
import operator
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from jaxlidar._checks import (
    briefly,
    check_integer,
    check_kind,
    check_number,
    check_numbers,
    check_range,
    concrete,
    concrete_array,
    concrete_number,
)
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.instrument.scan import STEEPEST, AbstractScan

# Rounding of a distance over a spacing that still counts as a whole number of spacings.
_WHOLE = 1e-6


@final
@briefly
class Survey(eqx.Module):
    """Many shots of one lidar: where the beam axis of each meets the reference plane, and its direction.

    `Survey.grid`, `Survey.track` and `Survey.scan` make one of a few numbers. A survey has a length;
    `survey[i]` is the `Lidar` of shot i, `survey[a:b]` a part. Places are kept in double precision.

    **Arguments:**

    - `lidar`: the `Lidar` of all shots. Its own position is not used.
    - `position`: (shots, 2) x and y in m where the beam axis meets the reference plane z = 0.
    - `zenith`: angle between the beam and the vertical in degrees, in [0, 89], one number or (shots,).
      Default None: the lidar's.
    - `azimuth`: compass direction in which the beam travels in degrees, one number or (shots,). Default None:
      the lidar's.

    **Raises:** ValueError for arrays that are not of these shapes, no shot at all, and values outside their
    ranges; TypeError for things of another kind.

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

    def __init__(
        self,
        lidar: Lidar,
        position: Any,
        zenith: ArrayLike | Any | None = None,
        azimuth: ArrayLike | Any | None = None,
    ):
        check_kind("lidar", lidar, Lidar, "a Lidar, as in Survey(Lidar(), position=...)")
        check_range("position", position)
        places = _known("position", position)
        if places.ndim != 2 or places.shape[1] != 2 or len(places) == 0:
            raise ValueError(f"position has shape {places.shape}; admissible is (shots, 2), one shot or more")
        self.lidar, self.position = lidar, places
        self.zenith = _per_shot("zenith", lidar.zenith if zenith is None else zenith, len(places))
        self.azimuth = _per_shot("azimuth", lidar.azimuth if azimuth is None else azimuth, len(places))
        check_range("zenith", self.zenith, 0.0, STEEPEST)

    def __len__(self) -> int:
        return len(self.position)

    def __getitem__(self, shot: int | slice) -> "Lidar | Survey":
        if isinstance(shot, slice):
            return Survey(self.lidar, self.position[shot], self.zenith[shot], self.azimuth[shot])
        i = self._number(shot)
        own = {name: jnp.asarray(getattr(self, name)[i], float) for name in ("zenith", "azimuth")}
        return dataclasses.replace(self.lidar, position=self.position[i], **own)

    def __iter__(self):
        return (self[i] for i in range(len(self)))

    def _number(self, shot: Any) -> int:
        """The shot of that number; negative numbers count from the end."""
        n, i = len(self), operator.index(shot)
        if not -n <= i < n:
            raise IndexError(f"shot {i}: the survey has {n}; admissible are -{n} to {n - 1}")
        return i % n

    @staticmethod
    def of(lidar: Lidar) -> "Survey":
        """The survey of one shot: that of a lidar with its own place and direction."""
        zenith, azimuth = concrete_number(lidar.zenith), concrete_number(lidar.azimuth)
        return Survey(lidar, concrete_array(lidar.position)[None], zenith, azimuth)

    @property
    def middle(self) -> Lidar:
        """A `Lidar` that aims at the middle of all places, at the largest zenith of the shots."""
        place = 0.5 * (self.position.min(axis=0) + self.position.max(axis=0))
        i = int(np.argmax(self.zenith))
        own = {name: jnp.asarray(getattr(self, name)[i], float) for name in ("zenith", "azimuth")}
        return dataclasses.replace(self.lidar, position=place, **own)

    def about(self, place: Float[np.ndarray, "2"]) -> "Survey":
        """The same survey with places relative to `place`, (2,) in m."""
        return Survey(self.lidar, self.position - place, self.zenith, self.azimuth)

    @property
    def direction(self) -> Float[np.ndarray, "shots 3"]:
        """Unit vectors (shots, 3) in which the beams travel."""
        zenith, azimuth = np.deg2rad(self.zenith), np.deg2rad(self.azimuth)
        across = np.sin(zenith)
        return np.stack([across * np.sin(azimuth), across * np.cos(azimuth), -np.cos(zenith)], axis=-1)

    @property
    def slant_range(self) -> Float[np.ndarray, " shots"]:
        """Distances (shots,) in m from the sensor to the reference plane, along the beam axes."""
        return concrete_number(self.lidar.altitude) / np.cos(np.deg2rad(self.zenith))

    @property
    def sensor(self) -> Float[np.ndarray, "shots 3"]:
        """Positions (shots, 3) of the sensor in m."""
        foot = np.pad(self.position, ((0, 0), (0, 1)))
        return foot - self.slant_range[:, None] * self.direction

    @property
    def footprint_radius(self) -> Float[np.ndarray, " shots"]:
        """Radii (shots,) in m of the beams at the reference plane, as `Lidar.footprint_radius`."""
        return self.slant_range * concrete_number(self.lidar.divergence) * 0.5e-3

    @staticmethod
    def grid(lidar: Lidar, low: Any, high: Any, spacing: Any) -> "Survey":
        """A survey of a regular grid of footprints, row after row from the south-west.

        **Arguments:**

        - `lidar`: the `Lidar` of all shots.
        - `low`: (x, y) of the first footprint in m.
        - `high`: (x, y) that no footprint lies beyond, m; not below `low`.
        - `spacing`: m between neighbours, positive, one number or (along x, along y).

        **Returns:** a `Survey`; along each axis it has one footprint at `low` and all others that fit.

        **Raises:** ValueError for values outside their ranges and other shapes; TypeError for no numbers.

        **Example:**

        >>> import jaxlidar as jl
        >>> survey = jl.Survey.grid(jl.Lidar(), low=(0, 0), high=(20, 10), spacing=10.0)
        >>> survey.position.tolist()
        [[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [0.0, 10.0], [10.0, 10.0], [20.0, 10.0]]
        """
        first, last = _place("low", low), _place("high", high)
        check_range("spacing", spacing, 0.0, low_open=True)
        step = _known("spacing", spacing)
        if step.shape not in ((), (2,)):
            raise ValueError(f"spacing has shape {step.shape}; admissible is one number or (2,)")
        if np.any(last < first):
            raise ValueError(f"high = {last.tolist()} lies below low = {first.tolist()}")
        step = np.broadcast_to(step, (2,))
        x, y = (first[k] + step[k] * np.arange(_fitting(last[k] - first[k], step[k])) for k in range(2))
        return Survey(lidar, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))

    @staticmethod
    def track(
        lidar: Lidar, start: Any, end: Any, spacing: Any, *, beams: int = 1, beam_spacing: Any = 600.0
    ) -> "Survey":
        """A survey of footprints along a line, of one beam or of several side by side, as GEDI flies them.

        **Arguments:**

        - `lidar`: the `Lidar` of all shots.
        - `start`, `end`: (x, y) in m of the first footprint, and where the track ends. Of several beams, they
          are those of their middle.
        - `spacing`: m between footprints along the track, positive; GEDI's are 60 m.
        - `beams`: number of beams, at least 1. Default 1; GEDI has 8.
        - `beam_spacing`: m between beams across the track, positive. Default 600, GEDI's.

        **Returns:** a `Survey`: all footprints of the leftmost beam first, then those of the next.

        **Raises:** ValueError for values outside their ranges and a line without length; TypeError for no
        numbers.

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
        along = float(spacing) * np.arange(_fitting(length, float(spacing)))
        across = float(beam_spacing) * (np.arange(count) - 0.5 * (count - 1))
        place = first + across[:, None, None] * right + along[None, :, None] * forward
        return Survey(lidar, place.reshape(-1, 2))

    @staticmethod
    def scan(
        lidar: Lidar, pattern: AbstractScan, start: Any, end: Any, speed: Any, pulse_rate: Any
    ) -> "Survey":
        """A survey of the shots of a scanner on a level platform that flies along a line.

        The platform flies at the lidar's altitude above the reference plane. Zenith and azimuth follow from
        the pattern.

        **Arguments:**

        - `lidar`: the `Lidar` of all shots. Its own direction is not used.
        - `pattern`: an `Oscillating`, a `RotatingPolygon`, a `Conical`, or another `AbstractScan`.
        - `start`, `end`: (x, y) in m of the platform at the first shot, and where the line ends.
        - `speed`: of the platform in m/s, positive.
        - `pulse_rate`: shots per s, positive.

        **Returns:** a `Survey`, its shots in the order of time.

        **Raises:** ValueError for values outside their ranges, a line without length, and a pattern that
        looks more than 89 degrees from the vertical; TypeError for things of another kind.

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
        time = np.arange(_fitting(length, float(speed) / float(pulse_rate))) / float(pulse_rate)
        ahead, aside, down = np.moveaxis(np.asarray(pattern.direction(time), float), -1, 0)
        level = ahead[:, None] * forward + aside[:, None] * right
        steep = np.hypot(ahead, aside)
        zenith = np.rad2deg(np.arctan2(steep, down))
        if not np.all(zenith <= STEEPEST + 1e-9):
            raise ValueError(
                f"pattern looks {float(np.max(zenith)):g} degrees from the vertical; admissible is "
                f"[0, {STEEPEST:g}]"
            )
        platform = first + (float(speed) * time)[:, None] * forward
        place = platform + float(lidar.altitude) * level / down[:, None]
        azimuth = np.where(steep > 0, np.rad2deg(np.arctan2(level[:, 0], level[:, 1])) % 360.0, 0.0)
        return Survey(lidar, place, np.minimum(zenith, STEEPEST), azimuth)


def _known(field: str, x: Any) -> np.ndarray:
    """Numbers in double precision. **Raises:** TypeError for what JAX is tracing."""
    check_numbers(field, x)
    value = concrete(x)
    if value is None:
        raise TypeError(f"{field} is being traced by a JAX transformation; admissible are known numbers")
    return value


def _per_shot(field: str, x: Any, shots: int) -> Float[np.ndarray, " shots"]:
    """One number for all shots, or one for each."""
    check_range(field, x)
    value = _known(field, x)
    if value.shape not in ((), (shots,)):
        raise ValueError(
            f"{field} has shape {value.shape}; admissible is one number or ({shots},), as position"
        )
    return np.broadcast_to(value, (shots,)).copy()


def _place(field: str, x: Any) -> Float[np.ndarray, "2"]:
    check_range(field, x)
    value = _known(field, x)
    if value.shape != (2,):
        raise ValueError(f"{field} has shape {value.shape}; admissible is (2,): x and y")
    return value


def _line(start: Any, end: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Start, unit vectors forward and to the right, and length of a line."""
    first, last = _place("start", start), _place("end", end)
    length = float(np.hypot(*(last - first)))
    if not length > 0:
        raise ValueError(f"end = {last.tolist()} is start; admissible is a line with a length")
    forward = (last - first) / length
    return first, forward, np.array([forward[1], -forward[0]]), length


def _fitting(length: float, step: float) -> int:
    """How many places, `step` apart, lie on a length, its start among them."""
    return math.floor(length / step * (1 + _WHOLE) + _WHOLE) + 1
