"""Checks and conversions at construction: what is inadmissible is refused by name, value and range.

A value outside its range, or of another shape, is a ValueError; a thing of another kind is a TypeError. What
is admissible but absurd, as in another unit, is a `UnitWarning`. Tracers pass: inside a JAX transformation
nothing can be said of values.
"""

import inspect
import sys
import warnings
from collections.abc import Callable, Sequence
from numbers import Real
from types import FrameType, UnionType
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

Class = TypeVar("Class", bound=type)

# -- conversions -------------------------------------------------------------------------------------------


def as_scalar(x: ArrayLike, field: str = "value") -> Float[Array, ""]:
    """A floating-point JAX scalar, in JAX's default precision; `field` names it in error messages."""
    a = as_array(x, field)
    if a.size != 1:
        raise ValueError(f"{field} has shape {a.shape}; admissible is one number")
    return a.reshape(())


def as_optional_scalar(x: ArrayLike | None, field: str = "value") -> Float[Array, ""] | None:
    """A floating-point JAX scalar, or None for None."""
    return None if x is None else as_scalar(x, field)


def as_array(x: ArrayLike | Sequence, field: str = "value") -> Float[Array, "..."]:
    """A floating-point JAX array, in JAX's default precision (a JAX float array is kept as it is)."""
    if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.floating):
        return x
    check_numbers(field, x)
    return jnp.asarray(x, dtype=float)


def scalar(field: str) -> Callable[[ArrayLike], Float[Array, ""]]:
    """The converter of a field that is one number: `as_scalar`, with the field's name."""

    def convert(x: ArrayLike) -> Float[Array, ""]:
        return as_scalar(x, field)

    return convert


def optional_scalar(field: str) -> Callable[[ArrayLike | None], Float[Array, ""] | None]:
    """The converter of a field that is one number or None."""

    def convert(x: ArrayLike | None) -> Float[Array, ""] | None:
        return as_optional_scalar(x, field)

    return convert


def array(field: str) -> Callable[[ArrayLike | Sequence], Float[Array, "..."]]:
    """The converter of a field that is an array of numbers: `as_array`, with the field's name."""

    def convert(x: ArrayLike | Sequence) -> Float[Array, "..."]:
        return as_array(x, field)

    return convert


def coordinates(field: str, size: int) -> Callable[[Any], Array | np.ndarray]:
    """The converter of a field that is a place, m: numbers are kept in double precision, outside of JAX.

    So places millions of metres from the origin keep their digits until they are told relative to another.
    """

    def convert(x: Any) -> Array | np.ndarray:
        known = concrete(x)
        a = as_array(x, field) if known is None else known
        check_shape(field, a, (), (size,))
        return (jnp if known is None else np).broadcast_to(a, (size,))

    return convert


# -- what is known -----------------------------------------------------------------------------------------


def is_traced(x: object) -> bool:
    """Whether a JAX transformation is running over `x`, so that its value is not known."""
    return isinstance(x, Tracer)


def concrete(x: object) -> np.ndarray | None:
    """`x` as a NumPy array, or None where it is a tracer or no array: those cannot be checked."""
    if is_traced(x) or not _is_numeric(x):
        return None
    try:
        return np.asarray(x, dtype=float)
    except (TypeError, ValueError):
        return None


def concrete_number(x: object) -> float:
    """A concrete number.

    **Raises:** ValueError where `x` is being traced by a JAX transformation.
    """
    return float(concrete_array(x))


def concrete_array(x: object) -> np.ndarray:
    """A concrete array, in double precision.

    **Raises:** ValueError where `x` is being traced by a JAX transformation.
    """
    value = concrete(x)
    if value is None:
        raise ValueError(
            "the geometry is being traced by a JAX transformation, so its sizes are unknown: "
            "make a plan outside with jaxlidar.plan and pass it as plan="
        )
    return value


def _is_numeric(x: object) -> bool:
    """Whether `x` is a real number, or an array or nested sequence of them, known or traced."""
    dtype = getattr(x, "dtype", None)
    if isinstance(dtype, np.dtype):
        return any(jnp.issubdtype(dtype, kind) for kind in (jnp.floating, jnp.integer, jnp.bool_))
    if isinstance(x, Sequence) and not isinstance(x, str | bytes):
        return all(map(_is_numeric, x))
    return isinstance(x, Real)


# -- values ------------------------------------------------------------------------------------------------


def check_range(
    field: str,
    x: object,
    low: float = -np.inf,
    high: float = np.inf,
    *,
    low_open: bool = False,
    high_open: bool = False,
) -> None:
    """Refuse `x` unless every element is a number (not NaN) between `low` and `high`.

    Infinite values are refused as well. Tracers pass: inside a transformation nothing can be said.

    **Raises:** `ValueError` naming `field`, the first offending value and the admissible range; `TypeError`
    where `x` is neither a number nor an array of numbers.
    """
    check_numbers(field, x)
    values = concrete(x)
    if values is None:
        return
    ok = np.isfinite(values)
    ok &= (values > low) if low_open else (values >= low)
    ok &= (values < high) if high_open else (values <= high)
    if not np.all(ok):
        left = "(" if low_open or low == -np.inf else "["
        right = ")" if high_open or high == np.inf else "]"
        bad = float(values[~ok].flat[0])
        raise ValueError(f"{field} = {bad:g} is outside the admissible range {left}{low:g}, {high:g}{right}")


def check_number(field: str, x: Any, low: float = -np.inf, high: float = np.inf, **limits: bool) -> None:
    """Refuse `x` unless it is one number in a range, which is stated as for `check_range`."""
    check_range(field, x, low, high, **limits)
    check_shape(field, x, ())


def check_shape(field: str, x: Any, *shapes: tuple[int, ...]) -> None:
    """Refuse `x`, known or traced, unless it has one of the shapes.

    **Raises:** `ValueError` naming `field`, its shape and the admissible ones.
    """
    if np.shape(x) not in shapes:
        admissible = " or ".join(str(shape) if shape else "one number" for shape in shapes)
        raise ValueError(f"{field} has shape {np.shape(x)}; admissible is {admissible}")


def check_integer(field: str, x: Any, low: int = 1, high: float = np.inf) -> int:
    """A whole number from `low` to `high`, as an int.

    **Raises:** `ValueError` naming `field`, the value and the admissible range; `TypeError` where `x` is no
    known number.
    """
    value = concrete(x)
    if value is None or value.ndim:
        raise TypeError(f"{field} is {kind_of(x)}; admissible is an integer of at least {low}")
    if not np.isfinite(value) or value != np.floor(value) or not low <= value <= high:
        right = ")" if high == np.inf else "]"
        raise ValueError(f"{field} = {x} is outside the admissible range [{low}, {high}{right} of integers")
    return int(x)


def check_choice(field: str, x: object, choices: tuple[str, ...]) -> None:
    """Refuse a name that is not among `choices`, and what is no name."""
    named = ", ".join(map(repr, choices))
    check_kind(field, x, str, f"one of {named}")
    if x not in choices:
        raise ValueError(f"{field} = {x!r} is none of {named}")


# -- kinds -------------------------------------------------------------------------------------------------


def kind_of(x: object) -> str:
    """What kind of thing `x` is, with its article, for messages: a Plate, the class Plate, an array, None."""
    if x is None:
        return "None"
    if isinstance(x, type):
        return f"the class {x.__name__}"
    if isinstance(x, jax.Array | np.ndarray):
        return f"an array of {x.dtype}{' that JAX is tracing' if is_traced(x) else ''}"
    name = type(x).__name__
    return f"{'an' if name[0] in 'AEIOUaeiou' else 'a'} {name}"


def check_kind(field: str, x: object, kind: type | UnionType, admissible: str) -> None:
    """Refuse a thing of another kind.

    **Raises:** `TypeError` naming `field`, the kind of `x` and what is admissible.
    """
    if not isinstance(x, kind):
        raise TypeError(f"{field} is {kind_of(x)}; admissible is {admissible}")


def check_flag(field: str, x: object) -> None:
    """Refuse what is neither True nor False."""
    check_kind(field, x, bool | np.bool_, "True or False")


def check_numbers(field: str, x: object, admissible: str = "real numbers") -> None:
    """Refuse what is neither a real number nor an array or nested sequence of such, known or traced.

    **Raises:** `TypeError` naming `field`, the kind of `x` and what is admissible; `ValueError` for a nested
    sequence with rows of different lengths.
    """
    if not _is_numeric(x):
        raise TypeError(f"{field} is {kind_of(x)}; admissible are {admissible}")
    if _is_ragged(x):
        raise ValueError(f"{field} has rows of different lengths; admissible is a regular array")


def _is_ragged(x: object) -> bool:
    """Whether a nested sequence has rows of different lengths."""
    if not isinstance(x, Sequence):
        return False
    return any(map(_is_ragged, x)) or len({_shape(a) for a in x}) > 1


def _shape(x: Any) -> tuple[int, ...]:
    """The shape of a number, an array or a nested sequence that is not ragged."""
    if not isinstance(x, Sequence):
        return np.shape(x)
    return (len(x), *(_shape(x[0]) if len(x) else ()))


def check_key(key: Any) -> None:
    """Refuse what is no single JAX random key, of the new or the old style; a traced key passes.

    **Raises:** `TypeError` where `key` is something else, `ValueError` where it is several keys.
    """
    dtype = getattr(key, "dtype", None)
    new = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)
    if not new and dtype != np.uint32:
        raise TypeError(
            f"key is {kind_of(key)}; admissible is a JAX random key, as jax.random.key(0) makes it"
        )
    # A key of the old style is a row of unsigned integers.
    if key.ndim != (0 if new else 1):
        raise ValueError(f"key has shape {key.shape}: several keys; admissible is one JAX random key")


# -- units -------------------------------------------------------------------------------------------------


class UnitWarning(UserWarning):
    """The warning of a value that is admissible but absurd, as one given in another unit is.

    **Example:** a divergence of 0.3 mrad, given in rad.

    >>> import warnings
    >>> import jaxlidar as jl
    >>> with warnings.catch_warnings(record=True) as found:
    ...     warnings.simplefilter("always")
    ...     lidar = jl.Lidar(divergence=3e-4)
    >>> print(found[0].message)
    divergence = 0.0003 mrad is absurdly small. Is it given in rad? 0.0003 rad is 0.3 mrad
    """


class Magnitude(NamedTuple):
    """The unit of a field, between which values anyone could mean it, and units that it is confused with.

    `others` gives, for another unit, how many of the field's it is; the likelier ones come first.
    """

    unit: str
    low: float
    high: float
    others: dict[str, float]


# The ranges are far wider than those of any instrument, leaf or map.
MAGNITUDES = {
    # From the far ultraviolet to a tenth of a millimetre.
    "wavelength": Magnitude("nm", 100.0, 1e5, {"um": 1e3, "m": 1e9, "pm": 1e-3}),
    # From a bench to beyond all orbits.
    "altitude": Magnitude("m", 1.0, 1e8, {"km": 1e3, "mm": 1e-3}),
    # From less than the diffraction of a telescope of 2 m to a floodlight.
    "divergence": Magnitude("mrad", 4e-4, 1e3, {"rad": 1e3, "urad": 1e-3}),
    # From less than a hundredth of any beam to the whole half-space.
    "field_of_view": Magnitude("mrad", 5e-5, 3.2e3, {"rad": 1e3, "urad": 1e-3}),
    "aperture": Magnitude("m", 0.0, 100.0, {"mm": 1e-3, "cm": 1e-2}),
    "energy": Magnitude("J", 0.0, 100.0, {"uJ": 1e-6, "mJ": 1e-3}),
    # From a femtosecond.
    "sampling_interval": Magnitude("ns", 1e-6, np.inf, {"s": 1e9}),
    # Of pulses, to two microseconds: those of wind lidars last less than one.
    "fwhm": Magnitude("ns", 1e-6, 2e3, {"s": 1e9, "ps": 1e-3}),
    "length": Magnitude("ns", 1e-6, 2e3, {"s": 1e9, "ps": 1e-3}),
    "decay": Magnitude("ns", 1e-6, 2e3, {"s": 1e9, "ps": 1e-3}),
    "jitter": Magnitude("ns", 1e-6, 2e3, {"s": 1e9, "ps": 1e-3}),
    "voxel_size": Magnitude("m", 1e-4, 1e3, {"mm": 1e-3, "cm": 1e-2, "km": 1e3}),
    # From dense fog; air without any aerosol has some 300 km.
    "visibility": Magnitude("km", 1e-3, 1e3, {"m": 1e-3}),
    "rayleigh_scale_height": Magnitude("m", 100.0, 1e5, {"km": 1e3}),
    "aerosol_scale_height": Magnitude("m", 10.0, 1e5, {"km": 1e3}),
    # Leaves hold 0 to 150 ug/cm2 of a pigment, 0.001 to 0.1 cm of water, 0.001 to 0.05 g/cm2 of dry matter.
    "Cab": Magnitude("ug/cm2", 0.0, 300.0, {"mg/m2": 0.1, "ug/m2": 1e-4}),
    "Car": Magnitude("ug/cm2", 0.0, 300.0, {"mg/m2": 0.1, "ug/m2": 1e-4}),
    "Cant": Magnitude("ug/cm2", 0.0, 300.0, {"mg/m2": 0.1, "ug/m2": 1e-4}),
    "Cw": Magnitude("cm", 0.0, 1.0, {"um": 1e-4, "g/m2": 1e-4}),
    "Cm": Magnitude("g/cm2", 0.0, 1.0, {"g/m2": 1e-4, "ug/cm2": 1e-6}),
    "Cp": Magnitude("g/cm2", 0.0, 1.0, {"g/m2": 1e-4, "ug/cm2": 1e-6}),
    "Cc": Magnitude("g/cm2", 0.0, 1.0, {"g/m2": 1e-4, "ug/cm2": 1e-6}),
    # Of trees: the tallest has 116 m, the thickest 12 m.
    "height": Magnitude("m", 0.0, 200.0, {"cm": 1e-2, "mm": 1e-3}),
    "trunk_diameter": Magnitude("m", 0.0, 20.0, {"cm": 1e-2, "mm": 1e-3}),
}

_OURS = ("jaxlidar", "inversion")
_WITHIN = (*_OURS, "equinox", "jaxtyping", "beartype", "dataclasses")


def warn_units(made: object) -> None:
    """`warn_unit` of every field of what is being made that `MAGNITUDES` has."""
    for field in MAGNITUDES:
        if hasattr(made, field):
            warn_unit(field, getattr(made, field))


def warn_unit(field: str, x: object) -> None:
    """Warn where a value of `x` is so far from what its field means that another unit is likely.

    Zero, where it is admissible, means what it says; tracers pass. `MAGNITUDES` has what is warned of.

    **Warns:** `UnitWarning`, at the line of the user's that led here, with the unit that is likely.
    """
    unit, low, high, others = MAGNITUDES[field]
    values = concrete(x)
    if values is None:
        return
    odd = values[(values != 0) & ((values < low) | (values > high))]
    if odd.size == 0:
        return
    value = float(odd.flat[0])
    meant = [(other, value * factor) for other, factor in others.items() if low <= value * factor <= high]
    size = "small" if value < low else "large"
    hint = f"Is it given in {meant[0][0]}? {value:g} {meant[0][0]} is {meant[0][1]:g} {unit}" if meant else ""
    message = f"{field} = {value:g} {unit} is absurdly {size}. {hint or 'Check its unit'}"
    # At the first line outside of the library and of what it is built on.
    frame, level = sys._getframe(), 1
    while frame.f_back is not None and _package(frame) in _WITHIN:
        if _package(frame) == "dataclasses" and _package(frame.f_back) in _OURS:
            # A changed copy that the library makes: the user's own was warned of.
            return
        frame, level = frame.f_back, level + 1
    warnings.warn(message, UnitWarning, stacklevel=level)


def _package(frame: FrameType) -> str:
    return frame.f_globals.get("__name__", "").split(".")[0]


# -- help --------------------------------------------------------------------------------------------------


def briefly(cls: Class) -> Class:
    """Let `help` show a class's arguments with their defaults alone.

    Types of arrays, written out, would push the description, which says what is admissible, out of sight.
    """
    signature = inspect.signature(cls.__init__)
    bare = [p.replace(annotation=p.empty) for p in signature.parameters.values()]
    cls.__init__.__signature__ = inspect.Signature(bare)  # pyright: ignore[reportAttributeAccessIssue]
    return cls
