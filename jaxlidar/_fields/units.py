"""Units that files name: their sizes in m, m2, rad and s."""

import contextlib
import math

# The names of units of length, which have no case and may be plural, by their size in m.
_LENGTH_NAMES = {
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
# Those of angles, by their size in rad.
_ANGLE_NAMES = {
    math.pi / 180.0: ("degree", "deg", "degrees north", "degrees east", "degree north", "degree east"),
    math.pi / 200.0: ("gradian", "grad", "gon"),
    1.0: ("radian", "rad"),
}
# Those of times, by their size in s.
_TIME_NAMES = {
    1.0: ("second", "sec", "s"),
    1e-3: ("millisecond", "msec", "ms"),
    1e-6: ("microsecond", "usec", "us", "µs"),
    1e-9: ("nanosecond", "nsec", "ns"),
    60.0: ("minute", "min"),
    3600.0: ("hour", "hr", "h"),
    86400.0: ("day", "d"),
}
_BY_KIND = {"length": _LENGTH_NAMES, "area": {1.0: ("m2",)}, "angle": _ANGLE_NAMES, "time": _TIME_NAMES}
_SIZES = {
    kind: {name: size for size, names in names_by_size.items() for name in names}
    for kind, names_by_size in _BY_KIND.items()
}


def unit_size(kind: str, location: str, unit: str | None) -> float | None:
    """Return the size in m, m2, rad or s of a unit that a file names, as "cm" or "0.01 m"; None without one.

    **Arguments:** `kind`: "length", "area", "angle" or "time". `location`: in the file, for messages.

    **Raises:** ValueError for an unknown unit.
    """
    text = (unit or "").strip().strip("[]()").lower().replace("_", " ")
    # "Seconds of the day" are seconds.
    words = (text.partition(" of ")[0] if kind == "time" else text).split()
    if not words:
        return None
    factor = 1.0
    with contextlib.suppress(ValueError):
        factor, words = float(words[0]), words[1:]
    name, sizes = " ".join(words), _SIZES[kind]
    size = sizes.get(name, sizes.get(name.removesuffix("s")))
    if size is None or not 0 < factor < math.inf:
        raise ValueError(f"{location}: the unit {unit!r} is not known; known are {', '.join(sizes)}")
    return factor * size
