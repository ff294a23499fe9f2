"""Soft time binning: deposits of energy into fine bins, smooth in time and exactly conserving.

A return at an instant is spread over three bins by the quadratic B-spline, whose weights sum to one
and whose second moment, 1/4 bin^2, does not depend on where in the bin the instant falls; the
derivative with respect to time is continuous. A return that extends over a stretch of the ray is
integrated bin by bin and smoothed by (1, 10, 1)/12, which gives it the same second moment. That
common second moment is taken out again when the pulse is applied (`jaxlidar.waveform`).
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ..layout import KERNEL, Bins

_SMOOTH = (1 / 12, 10 / 12, 1 / 12)


def instant_row(
    bins: Bins, time: Float[Array, "*s"], value: Float[Array, "*s"]
) -> tuple[Int[Array, "*s"], Float[Array, "*s 3"]]:
    """First bin (counting the margin) and the three weights of a return at one instant."""
    position = bins.position(time)
    centre = jnp.round(lax.stop_gradient(position))
    r = position - centre
    row = jnp.stack([0.5 * (0.5 - r) ** 2, 0.75 - r * r, 0.5 * (0.5 + r) ** 2], axis=-1)
    return _first(bins, centre - 1, KERNEL), row * value[..., None]


def smooth_row(row: Float[Array, "*s n"]) -> Float[Array, "*s n+2"]:
    """Give bin integrals the second moment of the B-spline."""
    zero = jnp.zeros_like(row[..., :1])
    a, b, c = _SMOOTH
    return (
        a * jnp.concatenate([row, zero, zero], -1)
        + b * jnp.concatenate([zero, row, zero], -1)
        + c * jnp.concatenate([zero, zero, row], -1)
    )


def _first(bins: Bins, first: Float[Array, "*s"], length: int) -> Int[Array, "*s"]:
    start = jnp.clip(first + bins.row, 0, bins.padded - length)
    return start.astype(jnp.int32)


def first_bin(bins: Bins, first: Float[Array, "*s"], length: int) -> Int[Array, "*s"]:
    """Index, counting the margin, of bin number `first` as the start of a row of `length` bins."""
    return _first(bins, first, length)


def scatter_rows(
    into: Float[Array, "slots padded"],
    slot: Int[Array, "*s"],
    first: Int[Array, "*s"],
    rows: Float[Array, "*s n"],
) -> Float[Array, "slots padded"]:
    """Add rows of contiguous bins. One windowed scatter costs about as much as one single element."""
    slots, padded = into.shape
    index = (slot * padded + first).reshape(-1, 1)
    numbers = lax.ScatterDimensionNumbers(
        update_window_dims=(1,), inserted_window_dims=(), scatter_dims_to_operand_dims=(0,)
    )
    flat = lax.scatter_add(
        into.reshape(-1),
        index,
        rows.reshape(index.shape[0], rows.shape[-1]),
        numbers,
        mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS,
    )
    return flat.reshape(slots, padded)
