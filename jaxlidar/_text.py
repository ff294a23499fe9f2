"""Texts of numbers, objects and missing light, for messages and for `print`."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

# Light that a record misses is reported from this fraction of the returned light on.
NOTABLE_FRACTION = 0.01
# From here on, six digits do not resolve a metre of a map coordinate; beyond, digits say nothing.
_COORDINATE, _HUGE = 1e5, 1e10
# Longest line of an object's text, and the longest row of numbers that is written out.
_MAX_LINE, _MAX_ROW = 100, 4


def number_text(x: Any) -> str:
    """Format a number with six digits, or with ten where it may be a map coordinate in metres."""
    value = float(x)
    return f"{value:.10g}" if _COORDINATE <= abs(value) < _HUGE else f"{value:g}"


def object_text(x: Any, names: Mapping[str, str] | None = None) -> str:
    """Format an object as its constructor is called, with values; arrays by their shape and range.

    `names`: arguments by field, where these differ.
    """
    return _text(x, 0, names or {})


def _text(x: Any, indent: int, names: Mapping[str, str] = MappingProxyType({})) -> str:
    if isinstance(x, Tracer):
        return repr(x)
    if isinstance(x, jax.Array | np.ndarray | np.generic):
        return _array_text(np.asarray(x))
    if isinstance(x, float):
        return number_text(x)
    if isinstance(x, tuple | list):
        entries = [_text(item, indent + 2) for item in x]
        return _joined("[", "", entries, "]", indent)
    if not dataclasses.is_dataclass(x) or isinstance(x, type):
        return getattr(x, "__qualname__", None) or repr(x)
    fields = [(field.name, getattr(x, field.name)) for field in dataclasses.fields(x)]
    entries = [
        f"{names.get(name, name)}={_text(value, indent + 2)}" for name, value in fields if value is not None
    ]
    return _joined(f"{type(x).__name__}(", " " * (indent + 2), entries, ")", indent)


def _joined(opening: str, margin: str, entries: list[str], closing: str, indent: int) -> str:
    """Join entries in one line, or, where they do not fit, one below the other."""
    line = opening + ", ".join(entries) + closing
    if "\n" not in line and len(line) + indent <= _MAX_LINE:
        return line
    margin = margin or " " * (indent + 2)
    return opening + "".join(f"\n{margin}{entry}," for entry in entries) + "\n" + " " * indent + closing


def _array_text(array: np.ndarray) -> str:
    if array.size == 1 and array.ndim == 0:
        return number_text(array) if array.dtype.kind in "fiub" else str(array)
    if array.ndim == 1 and array.size <= _MAX_ROW and array.dtype.kind in "fiu":
        return "[" + ", ".join(map(number_text, array)) + "]"
    shape = " x ".join(map(str, array.shape))
    if array.dtype.kind not in "fiu" or array.size == 0:
        return f"{shape} values"
    values = array[np.isfinite(array)] if array.dtype.kind == "f" else array
    if values.size == 0:
        return f"{shape} values, none finite"
    return f"{shape} values from {number_text(values.min())} to {number_text(values.max())}"


def samples_text(time: np.ndarray) -> str:
    """Describe the even samples of a record by their times, ns."""
    if time.size == 1:
        return f"1 sample at {time[0]:.6g} ns"
    return f"{time.size} samples of {time[1] - time[0]:.3g} ns from {time[0]:.6g} ns"


def percent(fraction: float) -> str:
    """Format a fraction in percent with two significant digits."""
    # Rounded as text first, as "g" alone writes 100 as 1e+02.
    return f"{float(f'{100 * fraction:.2g}'):g} %"


def outside_message(fraction: float, end: float, advice: str) -> str:
    """Return the text of the warning that a fraction of the returned light comes after `end`, ns."""
    return (
        f"some {percent(fraction)} of the returned light is still on its way when the record ends at "
        f"{end:.4g} ns: {advice}"
    )


def unfollowed_message(orders: int, fraction: float) -> str:
    """Return the text of the warning that orders beyond the last may add a fraction of the light."""
    return (
        f"orders of scattering beyond {orders} may add {percent(fraction)} of the light: give "
        "max_orders=, or fewer wavelengths at once, for which more orders are followed"
    )
