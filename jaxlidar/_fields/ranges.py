"""Quantities: the unit, the admissible range and the plausible values of a field, stated where it is defined.

Constructors refuse concrete values outside their range; `inadmissible` detects traced ones.

Besides the fields that `quantity` makes, a class may state ranges in the mapping `ranges`, by field. A key
may also be a sum of fields, as in "reflectance + transmittance", or a product. A field that is None, or a
module such as a `Spectrum` in the place of numbers, is skipped: a module states its own ranges.
"""

import dataclasses
import functools
import operator
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxlidar._fields.checks import Magnitude, as_array, check_range, warn_unit

# Tolerance at a closed limit, in units of the floating-point precision: a value at the limit, such as a sum
# of reflectance and transmittance that is 1, may exceed it by rounding.
_ROUNDING = 8


class Range(NamedTuple):
    """An admissible range of finite numbers, with closed or open limits.

    - `low`, `high`: limits.
    - `low_open`, `high_open`: True if the limit itself is not admissible.
    - `mirrored`: True if a traced value may also be negative and then means the same in the opposite
      direction, as angles from the vertical do. Fits and finite differences pass through zero.
    - `increasing`: True if each number must be larger than the one before. This is checked for traced values
      only; constructors check concrete ones and name them in their errors.

    **Example:** the ranges of a module of your own.

    >>> import equinox as eqx, jax
    >>> from jaxlidar.extend import Range, as_scalar, check_ranges, inadmissible, quantity
    >>> class Hill(eqx.Module):
    ...     slope: jax.Array = quantity(range=Range(0.0, 90.0, high_open=True), converter=as_scalar)
    ...
    ...     def __check_init__(self):
    ...         check_ranges(self)
    >>> bool(jax.jit(lambda slope: inadmissible(Hill(slope)))(200.0))
    True
    """

    low: float = -np.inf
    high: float = np.inf
    low_open: bool = False
    high_open: bool = False
    mirrored: bool = False
    increasing: bool = False


FINITE, NOT_NEGATIVE, POSITIVE = Range(), Range(0.0), Range(0.0, low_open=True)
# The range of a reflectance, a transmittance, a probability.
FRACTION = Range(0.0, 1.0)
# The range of reflectance + transmittance, which rounding may lift above 1.
SUM_OF_FRACTIONS = Range(0.0, 1.0 + 1e-6)
WAVELENGTHS = Range(0.0, low_open=True, increasing=True)

DEGREES = "degrees"
COMPASS = "degrees clockwise from north"
# Plausible from the far ultraviolet to a tenth of a millimetre.
NANOMETRES = Magnitude("nm", 100.0, 1e5, {"um": 1e3, "m": 1e9, "pm": 1e-3})
# Plausible from a femtosecond to two microseconds: pulses of wind lidars last less than one.
NANOSECONDS = Magnitude("ns", 1e-6, 2e3, {"s": 1e9, "ps": 1e-3})

if TYPE_CHECKING:
    # Type checkers know this function: from `converter` and `default` they infer what constructors take.
    quantity = eqx.field
else:

    def quantity(
        *,
        unit: str | Magnitude = "",
        range: Range = FINITE,
        converter: Callable[..., Any] | None = None,
        **options: Any,
    ) -> dataclasses.Field:
        """Define a field that holds numbers: `eqx.field` with their unit and range.

        **Arguments:** all by keyword.

        - `unit`: the unit, or a `Magnitude` with the values beyond which `check_ranges` warns. Default "": a
          pure number.
        - `range`: the admissible range. Default: all finite numbers.
        - `converter`: a function of the value and of the field's name. Default None: the value stays.
        - `**options`: as those of `eqx.field`, such as `default`.
        """
        convert = None
        if converter is not None:

            @functools.wraps(converter)
            def convert(x: Any) -> Any:
                return converter(x, field.name)

        field = eqx.field(converter=convert, metadata={"unit": unit, "range": range}, **options)
        return field


def _ranges(module: Any) -> Mapping[str, Range]:
    """Return the ranges of a module by field: those of its quantities, and those in `ranges`."""
    return _stated(module, "range") | getattr(module, "ranges", {})


def _stated(module: Any, key: str) -> dict[str, Any]:
    """Return what `quantity` states for the fields of a module: `key` is "unit" or "range"."""
    fields = getattr(module, "__dataclass_fields__", {}).values()
    return {field.name: field.metadata[key] for field in fields if key in field.metadata}


def check_ranges(module: Any) -> None:
    """Refuse a module with a concrete value outside the range that its class states.

    **Raises:** `ValueError` naming the field, the first offending value and the admissible range.

    **Warns:** `UnitWarning` for a field whose `Magnitude` is stated and its value implausible.
    """
    for name, admissible in _ranges(module).items():
        if (value := _value(module, name)) is not None:
            low, high, low_open, high_open, *_ = admissible
            check_range(name, value, low, high, low_open=low_open, high_open=high_open)
    for name, unit in _stated(module, "unit").items():
        if isinstance(unit, Magnitude):
            warn_unit(name, getattr(module, name), unit)


def inadmissible(tree: Any) -> Bool[Array, ""]:
    """Return True if any value in a module lies outside the range that its class states, or is not finite.

    Use it within JAX transformations, where a traced value cannot be refused: multiply a result by
    `jnp.where(inadmissible(scene), jnp.nan, 1.0)`. A value may lie beyond a limit by rounding.

    **Arguments:**

    - `tree`: a module, such as a `Lidar` or a `Scene`, or tuples, lists and dicts of them; within `jax.vmap`
      where its arrays have a leading axis.

    **Returns:** one truth value, concrete or traced.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> from jaxlidar.extend import inadmissible
    >>> print(jax.vmap(lambda slope: inadmissible(jl.Ground(slope=slope)))(jax.numpy.array([20.0, 200.0])))
    [False  True]
    """
    return functools.reduce(operator.or_, reasons(tree).values(), jnp.asarray(False))


def reasons(tree: Any) -> dict[str, Bool[Array, ""]]:
    """Tell for each value with a stated range whether it lies outside of it.

    **Arguments:** `tree`: as for `inadmissible`.

    **Returns:** a dict of truth values, concrete or traced, by path, as "ground.slope" or
    "plates[0].coverage".
    """
    outside = {}
    for path, module in _modules("", tree):
        for name, admissible in _ranges(module).items():
            if (value := _value(module, name)) is not None:
                outside[f"{path}.{name}" if path else name] = is_outside(value, admissible)
    return outside


def is_outside(x: Any, admissible: Range) -> Bool[Array, ""]:
    """Return True if an element of `x` is not finite, out of order, or out of range by more than rounding."""
    return _is_outside(as_array(x), admissible)


@functools.partial(jax.jit, static_argnames="admissible")
def _is_outside(x: Array, admissible: Range) -> Bool[Array, ""]:
    """Return True if an element of an array of floats is inadmissible."""
    low, high, low_open, high_open, mirrored, increasing = admissible
    in_order = jnp.all(jnp.diff(x) > 0) if increasing and x.ndim else True
    x = jnp.abs(x) if mirrored else x
    slack = _ROUNDING * float(jnp.finfo(x.dtype).eps)
    inside = jnp.isfinite(x)
    if low > -np.inf:
        inside &= x > low if low_open else x >= low - slack * max(abs(low), 1.0)
    if high < np.inf:
        inside &= x < high if high_open else x <= high + slack * max(abs(high), 1.0)
    return ~(in_order & jnp.all(inside))


def _value(module: Any, name: str) -> Any:
    """Evaluate a field, or a sum or product of fields; None if one of them is None or a module."""
    for sign, combine in ((" + ", operator.add), (" * ", operator.mul)):
        if sign in name:
            operands = [_value(module, operand) for operand in name.split(sign)]
            return None if any(x is None for x in operands) else functools.reduce(combine, operands)
    value = getattr(module, name)
    return None if isinstance(value, eqx.Module) else value


def _modules(path: str, x: Any) -> Iterator[tuple[str, eqx.Module]]:
    """Iterate over all modules in a tree, each with its path in the tree."""
    if isinstance(x, eqx.Module):
        yield path, x
        for field in dataclasses.fields(x):
            dot = f"{path}." if path else ""
            yield from _modules(dot + field.name, getattr(x, field.name, None))
    elif isinstance(x, Mapping):
        for key, item in x.items():
            yield from _modules(f"{path}[{key!r}]", item)
    elif isinstance(x, list | tuple):
        for i, item in enumerate(x):
            yield from _modules(f"{path}[{i}]", item)
