"""Soft time binning: deposits of energy into fine bins, smooth in time and exactly conserving.

A return at an instant is spread over three bins by the quadratic B-spline. Its weights sum to one, its second
moment, 1/4 bin^2, does not depend on where in the bin the instant falls, and its derivative with respect to
time is continuous. A return that extends over a stretch of the ray is integrated bin by bin and smoothed by
(1, 10, 1)/12, which gives it the same second moment. That common second moment is taken out again when the
pulse is applied (`jaxlidar.waveform`).

For comparison the kernel may have two bins (linear; cloud in cell) or one (the nearest bin, whose derivative
with respect to time is zero); its second moment is then n/12 bin^2 in the mean.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxlidar._one_function import once
from jaxlidar.planning.trace_plan import Bins


def instant_row(
    bins: Bins, time: Float[Array, "*s"], value: Float[Array, "*s"]
) -> tuple[Int[Array, "*s"], Float[Array, "*s kernel"]]:
    """First bin (counting the margin) and weights of a return at one instant."""
    # Fused into the row, both would be computed again for each of its bins.
    position, value = once((bins.position(time), value))
    lowest = jnp.round(lax.stop_gradient(position) - 0.5 * (bins.kernel - 1))
    r = position - lowest
    match bins.kernel:
        case 1:
            row = [jnp.ones_like(r)]
        case 2:
            row = [1.0 - r, r]
        case _:
            r = r - 1.0
            row = [0.5 * (0.5 - r) ** 2, 0.75 - r * r, 0.5 * (0.5 + r) ** 2]
    return _first(bins, lowest, bins.kernel), jnp.stack(row, axis=-1) * value[..., None]


def smooth_row(row: Float[Array, "*s n"], kernel: int) -> Float[Array, "*s n+2"]:
    """Bin integrals, whose own second moment is 1/12 bin^2, smoothed to the second moment of the kernel."""
    zero = jnp.zeros_like(row[..., :1])
    side = (kernel - 1) / 24
    return (
        side * jnp.concatenate([row, zero, zero], -1)
        + (1.0 - 2.0 * side) * jnp.concatenate([zero, row, zero], -1)
        + side * jnp.concatenate([zero, zero, row], -1)
    )


def _first(bins: Bins, first: Float[Array, "*s"], length: int) -> Int[Array, "*s"]:
    start = jnp.clip(first + bins.row, 0, bins.padded - length)
    return start.astype(jnp.int32)


def first_bin(bins: Bins, first: Float[Array, "*s"], length: int) -> Int[Array, "*s"]:
    """Index, counting the margin, of bin number `first`, where a row of `length` bins starts."""
    return _first(bins, first, length)


def scatter_rows(
    into: Float[Array, "slots padded"],
    slot: Int[Array, "*s"],
    first: Int[Array, "*s"],
    rows: Float[Array, "*s n"],
) -> Float[Array, "slots padded"]:
    """Add rows of contiguous bins. One windowed scatter costs about as much as adding one element."""
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
