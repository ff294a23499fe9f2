"""Admissible ranges, stated once for each class.

Constructors refuse concrete values outside their range; `inadmissible` detects traced ones.

A class states its ranges in the mapping `ranges`, by field. A key may also be a sum of fields, as in
"reflectance + transmittance", or a product. A field that is None, or a module such as a `Spectrum` in the
place of numbers, is skipped: a module states its own ranges.
"""

import dataclasses
import functools
import operator
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxlidar._fields.checks import as_array, check_range

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

    >>> from typing import ClassVar
    >>> import equinox as eqx, jax
    >>> from jaxlidar.extend import Range, check_ranges, inadmissible
    >>> class Hill(eqx.Module):
    ...     slope: jax.Array | float
    ...     ranges: ClassVar = {"slope": Range(0.0, 90.0, high_open=True)}
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


# The range of a reflectance, a transmittance, a probability.
FRACTION = Range(0.0, 1.0)
# The range of reflectance + transmittance, which rounding may lift above 1.
SUM_OF_FRACTIONS = Range(0.0, 1.0 + 1e-6)


def check_ranges(module: Any) -> None:
    """Refuse a module with a concrete value outside the range that its class states in `ranges`.

    **Raises:** `ValueError` naming the field, the first offending value and the admissible range.
    """
    for name, admissible in module.ranges.items():
        if (value := _value(module, name)) is not None:
            check_range(name, value, *admissible[:2], **_openness(admissible))


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
        for name, admissible in getattr(module, "ranges", {}).items():
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


def _openness(admissible: Range) -> dict[str, bool]:
    return {"low_open": admissible.low_open, "high_open": admissible.high_open}


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
