"""Admissible ranges, stated once for each class.

Constructors refuse what lies outside where it is known; `inadmissible` finds it where JAX is tracing.

A class states its ranges in the mapping `ranges`, by field. A name may also be a sum of fields, as in
"reflectance + transmittance", or a product. None, and what is a module itself, such as a `Spectrum` in the
place of numbers, is passed over: a module states its own ranges.
"""

import dataclasses
import functools
import operator
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxlidar._checks import as_array, check_range

# In units of the precision, what rounding may move a value beyond a limit that belongs to its range.
_ROUNDING = 8


class Range(NamedTuple):
    """An admissible range of finite numbers, with its limits or without them.

    `mirrored`: a traced value may also be negative, and means the same to the other side, as angles from the
    vertical do: fits and differences pass through zero. `increasing`: each number is also larger than the one
    before; of what is known, constructors see to it.

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


# A reflectance, a transmittance, a probability.
SHARE = Range(0.0, 1.0)
# What exceeds 1 by the rounding of measured or single-precision values passes.
SUM_OF_SHARES = Range(0.0, 1.0 + 1e-6)


def check_ranges(module: Any) -> None:
    """Refuse a module with a known value outside the range that its class states in `ranges`.

    **Raises:** `ValueError` naming the field, the first offending value and the admissible range.
    """
    for name, admissible in module.ranges.items():
        if (value := _value(module, name)) is not None:
            check_range(name, value, *admissible[:2], **_openness(admissible))


def inadmissible(tree: Any) -> Bool[Array, ""]:
    """Whether any value in a module lies outside the range that its class states, or is not finite.

    For use within JAX transformations, where a traced value cannot be refused: multiply a result by
    `jnp.where(inadmissible(scene), jnp.nan, 1.0)`. Values at a limit may have crossed it by rounding.

    **Arguments:**

    - `tree`: a module, such as a `Lidar` or a `Scene`, or tuples, lists and dicts of them; within `jax.vmap`
      where its arrays have a leading axis.

    **Returns:** one truth value, known or traced.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> from jaxlidar.extend import inadmissible
    >>> print(jax.vmap(lambda slope: inadmissible(jl.Ground(slope=slope)))(jax.numpy.array([20.0, 200.0])))
    [False  True]
    """
    return functools.reduce(operator.or_, reasons(tree).values(), jnp.asarray(False))


def reasons(tree: Any) -> dict[str, Bool[Array, ""]]:
    """Whether values lie outside their range, by their place, as in "ground.slope" or "plates[0].coverage".

    **Arguments:** `tree`: as for `inadmissible`.

    **Returns:** a dict of truth values, known or traced.
    """
    found = {}
    for place, module in _modules("", tree):
        for name, admissible in getattr(module, "ranges", {}).items():
            if (value := _value(module, name)) is not None:
                found[f"{place}.{name}" if place else name] = outside(value, admissible)
    return found


def outside(x: Any, admissible: Range) -> Bool[Array, ""]:
    """Whether any element of `x` is not finite, out of order, or outside a range by more than rounding."""
    x, (low, high, low_open, high_open, mirrored, increasing) = as_array(x), admissible
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
    """A field, or a sum or product of fields; None where one of them is no numbers."""
    for sign, combine in ((" + ", operator.add), (" * ", operator.mul)):
        if sign in name:
            parts = [_value(module, part) for part in name.split(sign)]
            return None if any(part is None for part in parts) else functools.reduce(combine, parts)
    value = getattr(module, name)
    return None if isinstance(value, eqx.Module) else value


def _modules(place: str, x: Any) -> Iterator[tuple[str, eqx.Module]]:
    """All modules in a tree, with their places in it."""
    if isinstance(x, eqx.Module):
        yield place, x
        for field in dataclasses.fields(x):
            dot = f"{place}." if place else ""
            yield from _modules(dot + field.name, getattr(x, field.name, None))
    elif isinstance(x, Mapping):
        for key, part in x.items():
            yield from _modules(f"{place}[{key!r}]", part)
    elif isinstance(x, list | tuple):
        for i, part in enumerate(x):
            yield from _modules(f"{place}[{i}]", part)
