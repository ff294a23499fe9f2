"""Checks and conversions at construction: what is inadmissible is refused by name, value and range."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float


def as_scalar(x: ArrayLike) -> Float[Array, ""]:
    """A floating-point JAX scalar, in JAX's default precision."""
    a = as_array(x)
    if a.size != 1:
        raise ValueError(f"an array of shape {a.shape} was given where one number is admissible")
    return a.reshape(())


def as_optional_scalar(x: ArrayLike | None) -> Float[Array, ""] | None:
    """A floating-point JAX scalar, or None for None."""
    return None if x is None else as_scalar(x)


def as_array(x: ArrayLike | Sequence) -> Float[Array, "..."]:
    """A floating-point JAX array, in JAX's default precision (a JAX float array is kept as it is)."""
    if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.floating):
        return x
    return jnp.asarray(x, dtype=float)


def is_traced(x: object) -> bool:
    """Whether a JAX transformation is running over `x`, so that its value is not known."""
    return isinstance(x, Tracer)


def concrete(x: object) -> np.ndarray | None:
    """`x` as a NumPy array, or None where it is a tracer or no array: those cannot be checked."""
    if is_traced(x):
        return None
    try:
        return np.asarray(x, dtype=float)
    except (TypeError, ValueError):
        return None


def known_number(x: object) -> float:
    """A concrete number.

    **Raises:** ValueError where `x` is being traced by a JAX transformation.
    """
    return float(known_array(x))


def known_array(x: object) -> np.ndarray:
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

    **Raises:** `ValueError` naming `field`, the first offending value and the admissible range.
    """
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


def check_integer(field: str, x: float, low: int = 1) -> int:
    """A whole number of at least `low`, as an int.

    **Raises:** `ValueError` naming `field`, the value and the admissible range.
    """
    if x != x or x in (np.inf, -np.inf) or x != int(x) or x < low:
        raise ValueError(f"{field} = {x} is outside the admissible range [{low}, inf) of integers")
    return int(x)


def check_choice(field: str, x: str, choices: tuple[str, ...]) -> None:
    """Refuse a name that is not among `choices`."""
    if x not in choices:
        raise ValueError(f"{field} = {x!r} is none of {', '.join(map(repr, choices))}")
