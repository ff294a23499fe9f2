"""Units that files name: their sizes in m, rad and s."""

import contextlib
import math

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
