"""The soft edge of the receiver's field of view, for the tracer (JAX) and for the plan's bounds (NumPy)."""

from typing import Any

import jax.numpy as jnp

# Width of the edge, as a share of the field's radius.
EDGE = 0.02


def seen(off_axis: Any, xp: Any = jnp) -> Any:
    """Share of the light from a point that the receiver sees, in [0, 1].

    The edge is smooth, so that the share has a derivative.

    **Arguments:**

    - `off_axis`: distance of the point from the axis over the radius of the field of view at that range, any
      shape.
    - `xp`: array module, `jax.numpy` or `numpy`. Default `jax.numpy`.

    **Returns:** an array shaped as `off_axis`.
    """
    return 1.0 / (1.0 + xp.exp(xp.clip((off_axis - 1.0) / EDGE, -80.0, 80.0)))
