r"""Scan patterns: the direction of a scanner's beam as a function of time.

Directions (f, r, d) are unit vectors in the frame of a level platform: forward, to the right and down. Over
flat ground at the height h below the platform, the beam meets the ground h f / d ahead of the platform and
h r / d to its right. With the half angle alpha, the frequency or line rate nu and the time t:

- oscillating mirror: across the track at the angle alpha sin(2 pi nu t) from the vertical, or at a triangle
  wave of the same limits;
- rotating polygon: across the track at alpha (2 frac(nu t) - 1), frac being the fractional part;
- nutating (Palmer) mirror: f = sin(alpha) cos(2 pi nu t), r = sin(alpha) sin(2 pi nu t), d = cos(alpha);
- panorama: a mirror draws vertical lines, and the head turns by a step from each line to the next: the zenith
  angle rises evenly within a line, and the azimuth is that of the line;
- Risley prisms: wedges of glass that turn about the axis of the beam, one behind another. At each of their
  faces, of the unit normal m on the side of the light, a beam w goes on by Snell's law as

      w' = q w + (q c - sqrt(1 - q^2 (1 - c^2))) m,   c = -w . m,   q = n / n',

  from the refractive index n into n'. A face that is inclined by the wedge's angle has the normal
  (sin(a) cos(u), sin(a) sin(u), -cos(a)), u = 2 pi nu t. To first order the deflections (n' - 1) a of the
  wedges add up as vectors that turn: a rosette.

Source: Baltsavias (1999), ISPRS J. Photogramm. Remote Sens. 54, 199, section 4; Li, Liu and Sun (2017), Opt.
Express 25, 7677 (Risley prisms).
"""

import abc
import math
from typing import Any, final

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxlidar._fields.checks import (
    Magnitude,
    as_numpy,
    check_choice,
    check_number,
    check_range,
    check_shape,
    concrete,
    warn_unit,
)

# Largest angle between the vertical and a beam that meets the reference plane, and any beam, degrees.
MAX_ZENITH, STRAIGHT_UP = 89.0, 180.0
# Largest angle of a wedge, degrees, and largest refractive index: those of no glass.
_MAX_WEDGE, _MAX_INDEX = 60.0, 4.0
# A part of a line, or of a step, that is rounding.
_ROUNDING = 1e-6
# Smaller half angles are narrower than any in use.
_HALF_ANGLE = Magnitude("degrees", 0.8, STRAIGHT_UP, {"rad": 180.0 / np.pi})


def _as_floats(x: Any) -> Any:
    """Convert one number to a Python float (double precision), and a row of them to a tuple of floats.

    Static fields need these. Other objects are left to the checks.
    """
    numbers = concrete(x)
    if numbers is None or numbers.ndim > 1:
        return x
    return tuple(numbers.tolist()) if numbers.ndim else float(numbers)


class AbstractScan(eqx.Module):
    """A scan pattern: the direction of the beam of a scanner as a function of time.

    Derive your own pattern from this class and define `direction`.

    **Example:** a profiler, whose beam always looks straight down.

    >>> import numpy as np
    >>> import jaxlidar as jl
    >>> class Profiler(jl.AbstractScan):
    ...     def direction(self, time):
    ...         return np.tile([0.0, 0.0, 1.0], (len(time), 1))
    >>> line = {"start": (0, 0), "end": (0, 100), "speed": 50.0, "pulse_rate": 10.0}
    >>> len(jl.Survey.scan(jl.Lidar(), Profiler(), **line))
    21
    """

    @abc.abstractmethod
    def direction(self, time: Float[np.ndarray, " shots"]) -> Float[np.ndarray, "shots 3"]:
        """Unit vectors of the beam, with the components forward, to the right and down.

        **Arguments:** `time`: (shots,) s since the start of the line.

        **Returns:** (shots, 3) directions. Of a lidar with an altitude, the third component is positive.
        """

    def level_axis(self, time: Float[np.ndarray, " shots"]) -> Float[np.ndarray, "shots 3"]:
        """Directions of `Lidar.level_divergence` of an elliptical beam, vectors in the same frame.

        The axis of the ellipse is the component of this vector perpendicular to the beam, and `divergence`
        lies across both. Default: forward, so that `divergence` of a line scanner is that along its lines.
        Where the vector is parallel to the beam, the ellipse is that of the beam's vertical plane: a pattern
        that looks ahead needs another one.

        **Arguments:** `time`: (shots,) s since the start of the line.

        **Returns:** (shots, 3), of any length but zero.
        """
        return np.tile([1.0, 0.0, 0.0], (len(time), 1))


@final
class Oscillating(AbstractScan):
    """An oscillating mirror: a zigzag, or a sine, of lines across the track.

    The angle from the vertical, to the right, is half_angle * sin(2 pi frequency time); or with
    `motion="triangle"` it rises and falls evenly between the same limits, from zero and upward first.

    **Arguments:**

    - `half_angle`: largest angle from the vertical in degrees, in (0, 89].
    - `frequency`: full cycles (there and back) per s, positive.
    - `motion`: "sine" or "triangle". Default "sine".

    **Raises:** ValueError for a value outside its range and an unknown motion; TypeError for no number.

    **Example:**

    >>> import numpy as np, jaxlidar as jl
    >>> scan = jl.Oscillating(half_angle=30.0, frequency=1.0)
    >>> print(scan.direction(np.array([0.0, 0.25, 0.75])).round(3).tolist())
    [[0.0, 0.0, 1.0], [0.0, 0.5, 0.866], [0.0, -0.5, 0.866]]
    """

    half_angle: float = eqx.field(converter=_as_floats)
    frequency: float = eqx.field(converter=_as_floats)
    motion: str = eqx.field(static=True, default="sine")

    def __check_init__(self):
        _check_pattern(self.half_angle, "frequency", self.frequency)
        check_choice("motion", self.motion, ("sine", "triangle"))

    def direction(self, time: Float[np.ndarray, " shots"]) -> Float[np.ndarray, "shots 3"]:
        cycle = as_numpy(time, "time") * self.frequency
        if self.motion == "sine":
            fraction = np.sin(2 * np.pi * cycle)
        else:
            # A triangle wave of period 1 that starts at zero and rises.
            fraction = 1.0 - np.abs((4.0 * cycle + 1.0) % 4.0 - 2.0)
        return _across_track(fraction * self.half_angle)


@final
class RotatingPolygon(AbstractScan):
    """A rotating polygon mirror: parallel lines across the track, all in the same direction.

    The angle from the vertical rises evenly from -half_angle (left) to half_angle (right), and starts again.
    A profile scanner, as on a vehicle, turns all around: its half angle is 180 degrees.

    **Arguments:**

    - `half_angle`: largest angle from the vertical in degrees, in (0, 180]. One of more than 89 is for a
      lidar that is placed by its sensor.
    - `line_rate`: lines per s, positive: facets of the mirror times its revolutions per s.

    **Raises:** ValueError for a value outside its range; TypeError for no number.

    **Example:**

    >>> import numpy as np, jaxlidar as jl
    >>> scan = jl.RotatingPolygon(half_angle=30.0, line_rate=100.0)
    >>> print(scan.direction(np.array([0.0, 0.005])).round(3).tolist())
    [[0.0, -0.5, 0.866], [0.0, 0.0, 1.0]]
    """

    half_angle: float = eqx.field(converter=_as_floats)
    line_rate: float = eqx.field(converter=_as_floats)

    def __check_init__(self):
        _check_pattern(self.half_angle, "line_rate", self.line_rate, STRAIGHT_UP)

    def direction(self, time: Float[np.ndarray, " shots"]) -> Float[np.ndarray, "shots 3"]:
        fraction = 2.0 * ((as_numpy(time, "time") * self.line_rate) % 1.0) - 1.0
        return _across_track(fraction * self.half_angle)


@final
class Conical(AbstractScan):
    """A nutating (Palmer) mirror: the beam turns about the vertical at a fixed angle, clockwise from above.

    Over flat ground at the height h below, it draws circles of radius h tan(half_angle). At time zero it
    looks forward.

    **Arguments:**

    - `half_angle`: angle from the vertical in degrees, in (0, 89].
    - `frequency`: turns per s, positive.

    **Raises:** ValueError for a value outside its range; TypeError for no number.

    **Example:**

    >>> import numpy as np, jaxlidar as jl
    >>> scan = jl.Conical(half_angle=30.0, frequency=10.0)
    >>> print(scan.direction(np.array([0.0, 0.025])).round(3).tolist())
    [[0.5, 0.0, 0.866], [0.0, 0.5, 0.866]]
    """

    half_angle: float = eqx.field(converter=_as_floats)
    frequency: float = eqx.field(converter=_as_floats)

    def __check_init__(self):
        _check_pattern(self.half_angle, "frequency", self.frequency)

    def direction(self, time: Float[np.ndarray, " shots"]) -> Float[np.ndarray, "shots 3"]:
        turn = 2 * np.pi * as_numpy(time, "time") * self.frequency
        angle = np.deg2rad(self.half_angle)
        down = np.full(turn.shape, np.cos(angle))
        return np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), down], axis=-1)


@final
class Panorama(AbstractScan):
    """The panorama of a terrestrial scanner: vertical lines, one for each step of the turning head.

    `Survey.scan` makes the shots of a scanner that stands still, as on a tripod, with this pattern. On a
    level platform that looks north, azimuths are those of the compass. Both ends of a range have shots where
    it is a multiple of the step; of a full turn, the last line would be the first again, and is left out.

    **Arguments:**

    - `zenith`: (first, last) angle of a line from straight down in degrees, in [0, 180]: 90 is level, and
      180 straight up. Lines run from the first to the last, whichever is larger.
    - `azimuth`: (first, last) azimuth of lines in degrees, clockwise from above, in [-360, 360], at most a
      turn apart. Default (0, 360).
    - `step`: degrees between neighbours, in (0, 180], one number, or two: of the shots of a line, and of
      lines. Default 0.1.
    - `line_rate`: lines per s, positive. It sets the times of shots, and nothing else. Default 100.

    **Raises:** ValueError for values outside their ranges, a range without extent, and a step beyond it;
    TypeError for no numbers.

    **Example:** a tripod scans the half space in front of it.

    >>> import jaxlidar as jl
    >>> pattern = jl.Panorama(zenith=(60.0, 150.0), azimuth=(-45.0, 45.0), step=10.0)
    >>> scanner = jl.instrument("RIEGL VZ-400").at((0.0, 0.0, 1.7))
    >>> survey = jl.Survey.scan(scanner, pattern)
    >>> print(len(survey), survey.zenith[:3].round(3), survey.azimuth[[0, -1]].round(3))
    100 [60. 70. 80.] [315.  45.]
    """

    zenith: tuple[float, float] = eqx.field(converter=_as_floats)
    azimuth: tuple[float, float] = eqx.field(converter=_as_floats, default=(0.0, 360.0))
    step: float | tuple[float, float] = eqx.field(converter=_as_floats, default=0.1)
    line_rate: float = eqx.field(converter=_as_floats, default=100.0)

    def __check_init__(self):
        check_range("zenith", self.zenith, 0.0, STRAIGHT_UP)
        check_range("azimuth", self.azimuth, -360.0, 360.0)
        for field, ends in (("zenith", self.zenith), ("azimuth", self.azimuth)):
            check_shape(field, ends, (2,))
        check_range("step", self.step, 0.0, 180.0, low_open=True)
        check_shape("step", self.step, (), (2,))
        check_number("line_rate", self.line_rate, 0.0, low_open=True)
        names = ("zenith", "azimuth")
        for name, ends, step in zip(names, (self.zenith, self.azimuth), self._steps):
            extent = abs(ends[1] - ends[0])
            if not step * (1.0 - _ROUNDING) <= extent <= 360.0:
                raise ValueError(
                    f"{name} = {ends} extends over {extent:g} degrees; admissible is [step, 360], "
                    f"step = {step:g}"
                )

    @property
    def _steps(self) -> tuple[float, float]:
        steps = np.broadcast_to(np.asarray(self.step, float), (2,))
        return float(steps[0]), float(steps[1])

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of lines and of shots in each."""
        (step, line_step), (first, last) = self._steps, self.azimuth
        shots = math.floor(abs(self.zenith[1] - self.zenith[0]) / step + _ROUNDING) + 1
        lines = math.floor(abs(last - first) / line_step + _ROUNDING) + 1
        # The last line of a full turn is the first one.
        return lines - (abs((lines - 1) * line_step - 360.0) < _ROUNDING), shots

    @property
    def time(self) -> Float[np.ndarray, " shots"]:
        """Times (shots,) of the shots of the whole panorama, s, line after line."""
        lines, shots = self.shape
        return np.arange(lines * shots) / (shots * self.line_rate)

    def direction(self, time: Float[np.ndarray, " shots"]) -> Float[np.ndarray, "shots 3"]:
        zenith, azimuth = self._angles(time)
        level = np.sin(zenith)
        return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.cos(zenith)], axis=-1)

    def level_axis(self, time: Float[np.ndarray, " shots"]) -> Float[np.ndarray, "shots 3"]:
        """Perpendicular to the line that is drawn: `divergence` is that along it."""
        _, azimuth = self._angles(time)
        return np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)], axis=-1)

    def _angles(self, time: Float[np.ndarray, " shots"]) -> tuple[np.ndarray, np.ndarray]:
        """Return the zenith angle of each shot and the azimuth of its line, in rad."""
        lines, shots = self.shape
        # A shot at the start of a line may lie before it by rounding.
        turn = as_numpy(time, "time") * self.line_rate
        line = np.floor(turn + _ROUNDING)
        (step, line_step), ends = self._steps, (self.zenith, self.azimuth)
        rise, advance = (math.copysign(s, last - first) for s, (first, last) in zip((step, line_step), ends))
        zenith = np.deg2rad(self.zenith[0] + rise * shots * (turn - line))
        return zenith, np.deg2rad(self.azimuth[0] + advance * (line % lines))


@final
class Risley(AbstractScan):
    """Rotating wedges of glass, Risley prisms, which draw a rosette about straight down.

    The beam goes through two or more prisms, one behind another, each with one face across the axis and one
    that is inclined; refraction is exact. Where frequencies have no common multiple, the pattern does not
    repeat itself. Turn the scanner by the argument `mounting` of `Survey.fly`: a pitch of 90 degrees makes it
    look ahead.

    **Arguments:**

    - `wedge`: angles of the prisms in degrees, in the order of the light, in [-60, 60]; not zero. Positive
      where the light enters by the inclined face, negative where it leaves by it.
    - `frequency`: turns per s of each prism, clockwise from above where positive; not zero.
    - `index`: refractive index of the glass, in (1, 4], one number or one of each prism. Default 1.51.
    - `incidence`: angle in degrees, forward, at which the light arrives at the first prism, in [-30, 30], as
      of one of several lasers side by side. Default 0.

    **Raises:** ValueError for values outside their ranges, fewer than two prisms, other numbers of
    frequencies or indices, and wedges that reflect the beam in place of refracting it; TypeError for no
    numbers.

    **Source:** Li, Liu and Sun (2017), Opt. Express 25, 7677.

    **Example:** two equal wedges deflect a beam most, or not at all, as they stand to one another.

    >>> import numpy as np, jaxlidar as jl
    >>> scan = jl.Risley(wedge=(10.0, -10.0), frequency=(1.0, -1.0))
    >>> print(scan.direction(np.array([0.0, 0.25])).round(3) + 0.0)
    [[-0.182  0.     0.983]
     [ 0.     0.     1.   ]]
    """

    wedge: tuple[float, ...] = eqx.field(converter=_as_floats)
    frequency: tuple[float, ...] = eqx.field(converter=_as_floats)
    index: float | tuple[float, ...] = eqx.field(converter=_as_floats, default=1.51)
    incidence: float = eqx.field(converter=_as_floats, default=0.0)

    def __check_init__(self):
        check_range("wedge", self.wedge, -_MAX_WEDGE, _MAX_WEDGE)
        count = np.size(self.wedge)
        if np.ndim(self.wedge) != 1 or count < 2:
            raise ValueError(f"wedge has shape {np.shape(self.wedge)}; admissible is (prisms,), two or more")
        check_range("frequency", self.frequency)
        check_shape("frequency", self.frequency, (count,))
        for field, values in (("wedge", self.wedge), ("frequency", self.frequency)):
            if not np.all(values):
                raise ValueError(f"{field} = {values}; admissible are numbers other than zero")
        check_range("index", self.index, 1.0, _MAX_INDEX, low_open=True)
        check_shape("index", self.index, (), (count,))
        check_number("incidence", self.incidence, -30.0, 30.0)
        # The beam is inclined most to the last faces where all prisms deflect it to the same side.
        if not np.all(np.isfinite(self._refracted(np.outer([0.0, np.pi], np.ones(count))))):
            raise ValueError(
                f"wedge = {self.wedge} reflects the beam in place of refracting it; admissible are smaller "
                "angles"
            )

    def level_axis(self, time: Float[np.ndarray, " shots"]) -> Float[np.ndarray, "shots 3"]:
        """To the right: level where the scanner looks ahead."""
        return np.tile([0.0, 1.0, 0.0], (len(time), 1))

    def direction(self, time: Float[np.ndarray, " shots"]) -> Float[np.ndarray, "shots 3"]:
        return self._refracted(2.0 * np.pi * as_numpy(time, "time")[:, None] * np.array(self.frequency))

    def _refracted(self, turn: Float[np.ndarray, "shots prisms"]) -> Float[np.ndarray, "shots 3"]:
        """Return directions behind the prisms, turned by angles in rad; NaN of beams that are reflected."""
        angle = np.deg2rad(self.incidence)
        beam = np.tile([np.sin(angle), 0.0, np.cos(angle)], (len(turn), 1))
        across = np.broadcast_to([0.0, 0.0, -1.0], beam.shape)
        index = np.broadcast_to(np.asarray(self.index, float), len(self.wedge))
        for wedge, n, u in zip(np.deg2rad(self.wedge), index, turn.T):
            slope = np.full_like(u, np.sin(wedge))
            inclined = np.stack(
                [slope * np.cos(u), slope * np.sin(u), np.full_like(u, -np.cos(wedge))], axis=-1
            )
            entry, exit_ = (inclined, across) if wedge > 0 else (across, inclined)
            beam = _refract(_refract(beam, entry, 1.0 / n), exit_, n)
        return beam


def _refract(
    beam: Float[np.ndarray, "shots 3"], normal: Float[np.ndarray, "shots 3"], ratio: float
) -> Float[np.ndarray, "shots 3"]:
    """Return beams behind a face, by Snell's law; `ratio` of the index before it to that behind it."""
    cosine = -np.sum(beam * normal, axis=-1, keepdims=True)
    squared = 1.0 - ratio**2 * (1.0 - cosine**2)
    # Beyond the critical angle the beam is reflected.
    behind = np.sqrt(np.where(squared > 0.0, squared, np.nan))
    return ratio * beam + (ratio * cosine - behind) * normal


def _check_pattern(half_angle: Any, field: str, rate: Any, largest: float = MAX_ZENITH) -> None:
    check_number("half_angle", half_angle, 0.0, largest, low_open=True)
    # Smaller ones than of any radian are deliberate, as of a beam that stands still.
    if float(half_angle) > 0.01:
        warn_unit("half_angle", half_angle, _HALF_ANGLE)
    check_number(field, rate, 0.0, low_open=True)


def _across_track(degrees: Float[np.ndarray, " shots"]) -> Float[np.ndarray, "shots 3"]:
    """Compute directions at given angles from the vertical to the right."""
    angle = np.deg2rad(degrees)
    return np.stack([np.zeros_like(angle), np.sin(angle), np.cos(angle)], axis=-1)
