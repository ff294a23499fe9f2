"""The soft edge of the receiver's field of view, for the tracer (JAX) and for the plan's bounds (NumPy).

A point at the distance r from the axis of a field of radius R contributes the fraction

    1 / (1 + exp((r/R - 1) / w)),   w = 0.02,

of its light. The logistic edge gives the visible fraction a derivative with respect to positions and to the
field of view, which a sharp edge would not have.
"""

from typing import Any

import jax.numpy as jnp

# Width w of the edge, in units of the field's radius.
EDGE_WIDTH = 0.02


def visible_fraction(off_axis: Any, xp: Any = jnp) -> Any:
    """Fraction of the light from a point that the receiver sees, in [0, 1].

    **Arguments:**

    - `off_axis`: distance of the point from the axis over the radius of the field of view at that range, any
      shape.
    - `xp`: array module, `jax.numpy` or `numpy`. Default `jax.numpy`.

    **Returns:** an array shaped as `off_axis`.
    """
    # The exponent is clipped so that it does not overflow, and its derivative stays finite, far off the axis.
    return 1.0 / (1.0 + xp.exp(xp.clip((off_axis - 1.0) / EDGE_WIDTH, -80.0, 80.0)))
