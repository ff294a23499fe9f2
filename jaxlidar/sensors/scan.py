"""Scan patterns: the direction of an airborne scanner's beam as a function of time.

Directions (f, r, d) are unit vectors in the frame of a level platform: forward, to the right and down. Over
flat ground at the height h below the platform, the beam meets the ground h f / d ahead of the platform and
h r / d to its right. With the half angle alpha, the frequency or line rate nu and the time t:

- oscillating mirror: across the track at the angle alpha sin(2 pi nu t) from the vertical, or at a triangle
  wave of the same limits;
- rotating polygon: across the track at alpha (2 frac(nu t) - 1), frac being the fractional part;
- nutating (Palmer) mirror: f = sin(alpha) cos(2 pi nu t), r = sin(alpha) sin(2 pi nu t), d = cos(alpha).

Source: Baltsavias (1999), ISPRS J. Photogramm. Remote Sens. 54, 199, section 4.
"""

import abc
from typing import Any, final

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxlidar._fields.checks import Magnitude, as_numpy, check_choice, check_number, concrete, warn_unit

# Largest angle between a beam and the vertical, degrees.
MAX_ZENITH = 89.0
# Smaller half angles are narrower than any in use.
_HALF_ANGLE = Magnitude("degrees", 0.8, 90.0, {"rad": 180.0 / np.pi})


def _as_float(x: Any) -> Any:
    """Convert one number to a Python float (double precision); other objects are left to the checks."""
    number = concrete(x)
    return x if number is None or number.ndim else float(number)


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

        **Returns:** (shots, 3) directions, whose third component is positive.
        """


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

    half_angle: float = eqx.field(converter=_as_float)
    frequency: float = eqx.field(converter=_as_float)
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

    **Arguments:**

    - `half_angle`: largest angle from the vertical in degrees, in (0, 89].
    - `line_rate`: lines per s, positive: facets of the mirror times its revolutions per s.

    **Raises:** ValueError for a value outside its range; TypeError for no number.

    **Example:**

    >>> import numpy as np, jaxlidar as jl
    >>> scan = jl.RotatingPolygon(half_angle=30.0, line_rate=100.0)
    >>> print(scan.direction(np.array([0.0, 0.005])).round(3).tolist())
    [[0.0, -0.5, 0.866], [0.0, 0.0, 1.0]]
    """

    half_angle: float = eqx.field(converter=_as_float)
    line_rate: float = eqx.field(converter=_as_float)

    def __check_init__(self):
        _check_pattern(self.half_angle, "line_rate", self.line_rate)

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

    half_angle: float = eqx.field(converter=_as_float)
    frequency: float = eqx.field(converter=_as_float)

    def __check_init__(self):
        _check_pattern(self.half_angle, "frequency", self.frequency)

    def direction(self, time: Float[np.ndarray, " shots"]) -> Float[np.ndarray, "shots 3"]:
        turn = 2 * np.pi * as_numpy(time, "time") * self.frequency
        angle = np.deg2rad(self.half_angle)
        down = np.full(turn.shape, np.cos(angle))
        return np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), down], axis=-1)


def _check_pattern(half_angle: Any, field: str, rate: Any) -> None:
    check_number("half_angle", half_angle, 0.0, MAX_ZENITH, low_open=True)
    # Smaller ones than of any radian are deliberate, as of a beam that stands still.
    if float(half_angle) > 0.01:
        warn_unit("half_angle", half_angle, _HALF_ANGLE)
    check_number(field, rate, 0.0, low_open=True)


def _across_track(degrees: Float[np.ndarray, " shots"]) -> Float[np.ndarray, "shots 3"]:
    """Compute directions at given angles from the vertical to the right."""
    angle = np.deg2rad(degrees)
    return np.stack([np.zeros_like(angle), np.sin(angle), np.cos(angle)], axis=-1)
