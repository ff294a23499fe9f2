"""The soft edge of a receiver's field of view: once for the tracer, once more for the plan's bounds."""

from typing import Any

import jax.numpy as jnp

# Width of the edge, as a share of the field's radius.
EDGE = 0.02


def seen(off_axis: Any, xp: Any = jnp) -> Any:
    """Share of a point that the receiver sees, 0..1, smooth so that it has a derivative.

    **Arguments:**

    - `off_axis`: its distance from the axis over the radius of the field of view there, any shape.
    - `xp`: `jax.numpy` (default) or `numpy`.
    """
    return 1.0 / (1.0 + xp.exp(xp.clip((off_axis - 1.0) / EDGE, -80.0, 80.0)))
