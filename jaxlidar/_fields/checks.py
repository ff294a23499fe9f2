"""Checks and conversions of arguments. Errors name the field, its value and the admissible range.

A value outside its range or of the wrong shape raises ValueError; an object of the wrong type raises
TypeError. A value that is admissible but implausible, as if given in another unit, gives a `UnitWarning`.
Tracers pass every check of values: inside a JAX transformation values are not known.

Numbers are real: booleans, complex numbers, times of NumPy and masked arrays with masked elements are of a
wrong type. NumPy and JAX would drop a mask and take booleans and times for numbers without a word, so
arguments become arrays by `as_array` or `as_numpy`.
"""

import contextlib
import operator
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from numbers import Real
from types import FrameType, UnionType
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._text import number_text

# Numbers as users give them: one, an array, or rows of them in lists and tuples.
Numbers: TypeAlias = ArrayLike | Sequence[Any]

# Largest distance of times or heights from evenly spaced ones, over their step.
_UNEVENNESS = 0.05

# -- conversions -------------------------------------------------------------------------------------------


def as_scalar(x: ArrayLike, field: str = "value") -> Float[Array, ""]:
    """Convert to a floating-point JAX scalar in the default precision; `field` names it in error messages."""
    a = as_array(x, field)
    if a.size != 1:
        raise ValueError(f"{field} has shape {a.shape}; admissible is one number")
    return a.reshape(()) if a.ndim else a


def as_optional_scalar(x: ArrayLike | None, field: str = "value") -> Float[Array, ""] | None:
    """Convert to a floating-point JAX scalar; None stays None."""
    return None if x is None else as_scalar(x, field)


def as_array(x: ArrayLike | Sequence, field: str = "value") -> Float[Array, "..."]:
    """Convert to a floating-point JAX array in the default precision; a JAX float array is not changed.

    **Raises:** as `check_numbers`.
    """
    if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.floating):
        return x
    check_numbers(field, x)
    values = concrete(x)
    if values is None:
        return jnp.asarray(x, dtype=float)
    # By NumPy and `device_put`: `jnp.asarray` compiles a program for every shape.
    with np.errstate(over="ignore"):
        return jax.device_put(values.astype(jnp.result_type(float)))


def as_numpy(x: Any, field: str = "value") -> Float[np.ndarray, "..."]:
    """Convert numbers whose values are known to a NumPy array of float64.

    **Raises:** as `check_numbers`; TypeError where JAX is tracing `x`.
    """
    check_numbers(field, x)
    if is_traced(x):
        raise TypeError(f"{field} is being traced by a JAX transformation; admissible are known numbers")
    return np.asarray(x, dtype=float)


def as_optional_array(x: ArrayLike | Sequence | None, field: str = "value") -> Float[Array, "..."] | None:
    """Convert to a floating-point JAX array; None stays None."""
    return None if x is None else as_array(x, field)


def coordinates(size: int) -> Callable[..., Array | np.ndarray]:
    """Make the converter of a field that is a position in m: a NumPy array of float64 unless it is traced.

    Map coordinates are millions of metres, which single precision resolves to 0.5 m only. They are kept in
    double precision, outside of JAX, until they are taken relative to a local origin.
    """

    def convert(x: Any, field: str = "position") -> Array | np.ndarray:
        value = concrete(x)
        a = as_array(x, field) if value is None else value
        check_shape(field, a, (), (size,))
        return (jnp if value is None else np).broadcast_to(a, (size,))

    return convert


# -- concrete and traced values ----------------------------------------------------------------------------


def is_traced(x: object) -> bool:
    """Return True if a JAX transformation is tracing `x`, so that its value is not known."""
    return isinstance(x, Tracer)


def has_tracers(tree: Any) -> bool:
    """Return True if a JAX transformation is tracing any leaf of a pytree."""
    return any(map(is_traced, jax.tree.leaves(tree)))


def is_within_program() -> bool:
    """Return True while JAX traces a program (jit, scan, eval_shape): even constants are then traced."""
    return is_traced(jnp.zeros(()))


def concrete(x: object) -> np.ndarray | None:
    """Convert `x` to a NumPy array of float64; None if it is traced or not numeric, and cannot be checked."""
    if is_traced(x) or not _is_numeric(x):
        return None
    try:
        return np.asarray(x, dtype=float)
    except (TypeError, ValueError):
        return None


def concrete_number(x: object) -> float:
    """Convert a number whose value is known to a float.

    **Raises:** ValueError where `x` is being traced by a JAX transformation.
    """
    return float(concrete_array(x))


def concrete_array(x: object) -> np.ndarray:
    """Convert an array whose values are known to a NumPy array of float64.

    **Raises:** ValueError where `x` is being traced by a JAX transformation.
    """
    value = concrete(x)
    if value is None:
        raise ValueError(
            "the geometry is being traced by a JAX transformation, so its sizes are unknown: "
            "make a plan outside with jaxlidar.plan and pass it as plan="
        )
    return value


def array_namespace(x: object) -> Any:
    """Return the module whose functions take `x`: `jax.numpy` for JAX arrays, else `numpy`."""
    return jnp if isinstance(x, jax.Array) else np


def fixed_array(x: Any, xp: Any) -> Any:
    """Convert an array for computations without derivatives: in double precision with `xp` = numpy.

    **Raises:** ValueError where `x` is being traced by a JAX transformation and `xp` is numpy.
    """
    return concrete_array(x) if xp is np else lax.stop_gradient(jnp.asarray(x, float))


def _is_numeric(x: object) -> bool:
    """Return True if `x` is a real number, or an array or nested sequence of them, concrete or traced.

    Booleans are none. Neither are times, which NumPy counts among the integers, and masked elements.
    """
    if _has_masked_elements(x):
        return False
    dtype = getattr(x, "dtype", None)
    if isinstance(dtype, np.dtype):
        return dtype.kind in "iu" or bool(jnp.issubdtype(dtype, jnp.floating))
    if isinstance(x, Sequence) and not isinstance(x, str | bytes):
        return all(map(_is_numeric, x))
    return isinstance(x, Real) and not isinstance(x, bool)


def _has_masked_elements(x: object) -> bool:
    return isinstance(x, np.ma.MaskedArray) and bool(np.ma.getmaskarray(x).any())


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

    Infinite values are refused as well. Tracers pass: their values are not known.

    **Raises:** `ValueError` naming `field`, the first offending value and the admissible range; `TypeError`
    where `x` is neither a number nor an array of numbers.
    """
    check_numbers(field, x)
    values = concrete(x)
    if values is None:
        return
    in_range = np.isfinite(values)
    in_range &= (values > low) if low_open else (values >= low)
    in_range &= (values < high) if high_open else (values <= high)
    if not np.all(in_range):
        opening = "(" if low_open or low == -np.inf else "["
        closing = ")" if high_open or high == np.inf else "]"
        first_outside = float(values[~in_range].flat[0])
        raise ValueError(
            f"{field} = {number_text(first_outside)} is outside the admissible range "
            f"{opening}{number_text(low)}, {number_text(high)}{closing}"
        )


def even_step(field: str, axis: object, *, decreasing: bool = False) -> np.ndarray:
    """Return the step of times or heights that are evenly spaced along the last dimension.

    The step is the distance of the first from the last value over the number of steps, in double precision.
    Values may lie off the even ones by a twentieth of a step, as those of a text file with few digits do, and
    by the rounding of their type.

    **Arguments:**

    - `field`: name of the axis.
    - `axis`: (..., bins) values that are known, two or more.
    - `decreasing`: True for values that decrease, as heights along a beam do. Default False.

    **Returns:** (...,) steps, positive.

    **Raises:** `ValueError` naming `field`, the step and the admissible ones for values that are not finite,
    do not increase (or decrease), or have uneven steps.
    """
    check_range(field, axis)
    values = concrete_array(axis)
    steps = np.diff(values, axis=-1)
    if decreasing:
        check_range(f"steps of {field}", steps, high=0.0, high_open=True)
    else:
        check_range(f"steps of {field}", steps, 0.0, low_open=True)
    mean_step = (values[..., -1:] - values[..., :1]) / steps.shape[-1]
    off_grid = np.abs(values - values[..., :1] - mean_step * np.arange(values.shape[-1]))
    # Values of single precision are even to their rounding only, which is coarse far from zero.
    dtype = getattr(axis, "dtype", float)
    rounding = float(jnp.finfo(dtype if jnp.issubdtype(dtype, jnp.floating) else float).eps)
    tolerance = _UNEVENNESS * np.abs(mean_step) + 2.0 * rounding * np.abs(values).max(axis=-1, keepdims=True)
    is_uneven = np.any(off_grid > tolerance, axis=-1)
    if np.any(is_uneven):
        row_steps, row_mean = steps[is_uneven][0], mean_step[is_uneven][0]
        worst = row_steps[np.argmax(np.abs(row_steps - row_mean))]
        raise ValueError(
            f"{field} has a step of {worst:g} among uneven steps of {float(row_mean[0]):g} on average; "
            "admissible are even steps: interpolate the record to them"
        )
    return np.asarray(np.abs(mean_step[..., 0]))


def check_number(field: str, x: Any, low: float = -np.inf, high: float = np.inf, **limits: bool) -> None:
    """Refuse `x` unless it is one number in a range, given as for `check_range`."""
    check_range(field, x, low, high, **limits)
    check_shape(field, x, ())


def check_shape(field: str, x: Any, *shapes: tuple[int, ...]) -> None:
    """Refuse `x`, concrete or traced, unless it has one of the shapes.

    **Raises:** `ValueError` naming `field`, its shape and the admissible ones.
    """
    if np.shape(x) not in shapes:
        admissible = " or ".join(str(shape) if shape else "one number" for shape in shapes)
        raise ValueError(f"{field} has shape {np.shape(x)}; admissible is {admissible}")


def checked_array(
    field: str,
    x: Any,
    shape: tuple[int | None, ...],
    low: float = -np.inf,
    high: float = np.inf,
    *,
    one_for_all: bool = False,
    **limits: bool,
) -> Float[np.ndarray, "..."]:
    """Convert numbers in a range, given as for `check_range`, to a new NumPy array of float64 of one shape.

    **Arguments:** `shape`: None in it stands for any number of rows, one or more. `one_for_all`: True where
    one number may stand for all.

    **Raises:** as `check_range`, `as_numpy` and `check_shape`.
    """
    check_range(field, x, low, high, **limits)
    array = as_numpy(x, field)
    if one_for_all and array.ndim == 0:
        return np.full([1 if n is None else n for n in shape], array)
    fits = [m > 0 if n is None else m == n for m, n in zip(array.shape, shape)]
    if array.ndim != len(shape) or not all(fits):
        rows = str(shape).replace("None", "n") + (", n at least 1" if None in shape else "")
        admissible = f"one number or {rows}" if one_for_all else rows
        raise ValueError(f"{field} has shape {array.shape}; admissible is {admissible}")
    return array.copy()


def check_integer(field: str, x: Any, low: int = 1, high: float = np.inf) -> int:
    """Convert a whole number from `low` to `high` to an int.

    **Raises:** `ValueError` naming `field`, the value and the admissible range; `TypeError` where `x` is not
    one concrete number.
    """
    value = concrete(x)
    if value is None or value.ndim:
        raise TypeError(f"{field} is {kind_of(x)}; admissible is an integer of at least {low}")
    check_numbers(field, x)
    if not np.isfinite(value) or value != np.floor(value) or not low <= value <= high:
        closing = ")" if high == np.inf else "]"
        raise ValueError(f"{field} = {x} is outside the admissible range [{low}, {high}{closing} of integers")
    return int(x)


def check_index(name: str, index: Any, count: int) -> int:
    """Return an index along an axis of `count` items, such as a `name`, as an int.

    **Raises:** IndexError for one beyond the axis, which JAX would replace; TypeError for no whole number.
    """
    i = operator.index(index)
    if not -count <= i < count:
        raise IndexError(f"{name} {i}: there are {count}; admissible are -{count} to {count - 1}")
    return i


def check_choice(field: str, x: object, choices: tuple[str, ...]) -> None:
    """Refuse a string that is not among `choices`, and an object that is not a string."""
    names = ", ".join(map(repr, choices))
    check_kind(field, x, str, f"one of {names}")
    if x not in choices:
        raise ValueError(f"{field} = {x!r} is none of {names}")


# -- types -------------------------------------------------------------------------------------------------


def kind_of(x: object) -> str:
    """Describe the type of `x` with its article, for messages: a Plate, the class Plate, an array, None."""
    if x is None:
        return "None"
    if isinstance(x, type):
        return f"the class {x.__name__}"
    if _has_masked_elements(x):
        return "an array with masked elements"
    if isinstance(x, jax.Array | np.ndarray):
        return f"an array of {x.dtype}{' that JAX is tracing' if is_traced(x) else ''}"
    name = type(x).__name__
    return f"{'an' if name[0] in 'AEIOUaeiou' else 'a'} {name}"


def check_kind(field: str, x: object, kind: type | UnionType, admissible: str) -> None:
    """Refuse an object of another type than `kind`.

    **Raises:** `TypeError` naming `field`, the type of `x` and what is admissible.
    """
    if not isinstance(x, kind):
        raise TypeError(f"{field} is {kind_of(x)}; admissible is {admissible}")


def check_flag(field: str, x: object) -> None:
    """Refuse an object that is neither True nor False."""
    check_kind(field, x, bool | np.bool_, "True or False")


def check_numbers(field: str, x: object, admissible: str = "real numbers") -> None:
    """Refuse `x` unless it is a real number, or an array or nested sequence of them, concrete or traced.

    **Raises:** `TypeError` naming `field`, the type of `x` and what is admissible; `ValueError` for a nested
    sequence with rows of different lengths.
    """
    if not _is_numeric(x):
        raise TypeError(f"{field} is {kind_of(x)}; admissible are {admissible}")
    if _is_ragged(x):
        raise ValueError(f"{field} has rows of different lengths; admissible is a regular array")


def _is_ragged(x: object) -> bool:
    """Return True if a nested sequence has rows of different lengths."""
    if not isinstance(x, Sequence):
        return False
    return any(map(_is_ragged, x)) or len({_shape(a) for a in x}) > 1


def _shape(x: Any) -> tuple[int, ...]:
    """Return the shape of a number, an array or a nested sequence that is not ragged."""
    if not isinstance(x, Sequence):
        return np.shape(x)
    return (len(x), *(_shape(x[0]) if len(x) else ()))


def check_seed(x: Any) -> None:
    """Refuse an object that is neither a whole number, 0 or more, nor a generator of NumPy."""
    if not isinstance(x, np.random.Generator):
        check_integer("seed", x, 0)


def check_key(key: Any) -> None:
    """Refuse an object that is not one JAX random key, typed or raw; a traced key passes.

    **Raises:** `TypeError` where `key` is something else, `ValueError` where it is several keys.
    """
    dtype = getattr(key, "dtype", None)
    is_typed = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)
    if not is_typed and dtype != np.uint32:
        raise TypeError(
            f"key is {kind_of(key)}; admissible is a JAX random key, as jax.random.key(0) makes it"
        )
    # A raw key, as of `jax.random.PRNGKey`, is a row of unsigned integers.
    if key.ndim != (0 if is_typed else 1):
        raise ValueError(f"key has shape {key.shape}: several keys; admissible is one JAX random key")


# -- units -------------------------------------------------------------------------------------------------


class UnitWarning(UserWarning):
    """Warning of a value that is admissible but implausible, as if it were given in another unit.

    **Example:** a divergence of 0.3 mrad, given in rad.

    >>> import warnings
    >>> import jaxlidar as jl
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always")
    ...     lidar = jl.Lidar(divergence=3e-4)
    >>> print(caught[0].message)
    divergence = 0.0003 mrad is absurdly small. Is it given in rad? 0.0003 rad is 0.3 mrad
    """


class Magnitude(NamedTuple):
    """The unit of a quantity, its plausible values, and units that are given by mistake.

    - `unit`: of the quantity.
    - `low`, `high`: limits of the plausible values in that unit, far wider than the values of any instrument,
      leaf or map.
    - `confused_units`: for each unit that is given by mistake, its size in units of the quantity; the
      likelier ones come first.
    """

    unit: str
    low: float
    high: float
    confused_units: dict[str, float]

    def __str__(self) -> str:
        return self.unit


_PROJECT_PACKAGES = ("jaxlidar", "inversion")
# Packages whose frames lie between a user's line and a warning of the project.
_INTERNAL_PACKAGES = (
    *_PROJECT_PACKAGES,
    *("equinox", "jax", "optimistix", "jaxtyping", "beartype"),
    *("abc", "contextlib", "dataclasses", "functools"),
)


def warn_unit(field: str, x: object, magnitude: Magnitude) -> None:
    """Warn if a value of `x` is so far from the plausible values of its field that another unit is likely.

    Zero, where it is admissible, gives no warning, and tracers pass.

    **Warns:** `UnitWarning`, at the user's line that led to this call, with the likely unit.
    """
    unit, low, high, confused_units = magnitude
    values = concrete(x)
    if values is None:
        return
    implausible = values[(values != 0) & ((values < low) | (values > high))]
    if implausible.size == 0:
        return
    value = float(implausible.flat[0])
    size, hint = "small" if value < low else "large", "Check its unit"
    for likely_unit, factor in confused_units.items():
        if low <= value * factor <= high:
            hint = f"Is it given in {likely_unit}? {value:g} {likely_unit} is {value * factor:g} {unit}"
            break
    message = f"{field} = {value:g} {unit} is absurdly {size}. {hint}"
    warn_user(message, UnitWarning)


def warn_user(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the user's line: the innermost one outside of the project and of the packages beneath it.

    Python shows a warning by default once for each line that it names.

    No warning is given where `dataclasses.replace` within the project copies an object that the user was
    warned of already.
    """
    frame, level = sys._getframe(), 1
    while frame.f_back is not None and _top_package(frame) in _INTERNAL_PACKAGES:
        if _top_package(frame) == "dataclasses" and _top_package(frame.f_back) in _PROJECT_PACKAGES:
            return
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


def _top_package(frame: FrameType) -> str:
    return frame.f_globals.get("__name__", "").split(".")[0]


# -- packages ---------------------------------------------------------------------------------------------


@contextlib.contextmanager
def required_for(purpose: str, extra: str = "io") -> Iterator[None]:
    """Within the context, import packages of an extra.

    **Raises:** ImportError that names the purpose, the package that is missing, and how to install it. The
    error of a package that is installed, but cannot be loaded, passes as it is.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise ImportError(f'{purpose} needs {error.name}: pip install "jaxlidar[{extra}]"') from error
