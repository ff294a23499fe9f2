r"""Soft time binning: deposits of returned light into fine bins, smooth in time, which conserve energy.

A return at the time t (in bins) is spread over three bins by the quadratic B-spline B,

    weight of bin n = B(t - n),   B(x) = 3/4 - x^2 for |x| < 1/2,  (3/2 - |x|)^2 / 2 for 1/2 < |x| < 3/2.

The weights sum to one, their variance about t, 1/4 bin^2, does not depend on where in the bin t falls, and
their derivative with respect to t is continuous. A return that extends over a ray segment is integrated
exactly over each bin (a box of variance 1/12) and smoothed by (1, 10, 1)/12 (variance 1/6), which gives it
the same variance of 1/4 in all. That common variance is taken out again when the pulse is applied
(`jaxlidar.spectral.pulse_convolution`).

Rows of bins have a margin at either end, which collects what falls outside the record.
"""

import math

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxlidar._jax.one_function import barrier
from jaxlidar.planning.config import KERNEL_BINS, TimeBins


def bspline_row(
    bins: TimeBins, time: Float[Array, "*s"], value: Float[Array, "*s"]
) -> tuple[Int[Array, "*s"], Float[Array, "*s kernel"]]:
    """Spread returns `value` at the instants `time`, ns, over three bins each.

    **Returns:** index of the first bin, counting the margin, and the values in three bins from there on.
    """
    # Optimisation barrier: fused into the row, both would be computed again for each of its bins.
    position, value = barrier((bins.position(time), value))
    lowest = jnp.round(lax.stop_gradient(position) - 0.5 * (KERNEL_BINS - 1))
    # Offset from the middle bin, in [-1/2, 1/2].
    r = position - lowest - 1.0
    weights = [0.5 * (0.5 - r) ** 2, 0.75 - r * r, 0.5 * (0.5 + r) ** 2]
    return padded_index(bins, lowest, KERNEL_BINS), jnp.stack(weights, axis=-1) * value[..., None]


def smooth_bins(integrals: Float[Array, "*s n"]) -> Float[Array, "*s n+2"]:
    """Smooth integrals over bins by (1, 10, 1)/12, so that their variance is that of the B-spline.

    This is a full convolution: the result has one more bin at either end.
    """
    zero = jnp.zeros_like(integrals[..., :1])
    # The variance of (side, 1 - 2 side, side) is 2 side: 1/4 of the B-spline less 1/12 of the box.
    side = 1.0 / 12.0
    return (
        side * jnp.concatenate([integrals, zero, zero], -1)
        + (1.0 - 2.0 * side) * jnp.concatenate([zero, integrals, zero], -1)
        + side * jnp.concatenate([zero, zero, integrals], -1)
    )


def padded_index(bins: TimeBins, number: Float[Array, "*s"], length: int) -> Int[Array, "*s"]:
    """Return the index, counting the margin, of bin `number`, from which a row of `length` bins starts."""
    # Returns outside the record fall into the margins, where `TimeBins.trim` sums them: clipping keeps energy
    # countable.
    start = jnp.clip(number + bins.max_span, 0, bins.padded - length)
    return start.astype(jnp.int32)


def add_rows(
    tally: Float[Array, "rows padded"],
    row: Int[Array, "*s"],
    first_bin: Int[Array, "*s"],
    values: Float[Array, "*s n"] | Float[Array, "*s wavelengths n"],
) -> Float[Array, "rows padded"]:
    """Add runs of n contiguous bins to rows of a tally.

    With an axis of wavelengths, values are added to as many consecutive rows, the first of which is `row`.
    One windowed scatter costs about as much as adding one element, so that a deposit over many bins, or
    wavelengths, is one update.
    """
    numbers = lax.ScatterDimensionNumbers(
        update_window_dims=(1, 2), inserted_window_dims=(), scatter_dims_to_operand_dims=(0, 1)
    )
    return lax.scatter_add(
        tally,
        _corners(row, first_bin),
        values.reshape(row.size, -1, values.shape[-1]),
        numbers,
        # `padded_index` keeps runs within the row.
        mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS,
    )


def take_rows(
    tally: Float[Array, "rows padded"],
    row: Int[Array, "*s"],
    first_bin: Int[Array, "*s"],
    shape: tuple[int, ...],
) -> Float[Array, "..."]:
    """Return runs of contiguous bins of rows of a tally: the transpose of `add_rows`.

    `shape`: that of the values which `add_rows` would add there, and of the result.
    """
    window = math.prod(shape[row.ndim : -1]), shape[-1]
    numbers = lax.GatherDimensionNumbers(offset_dims=(1, 2), collapsed_slice_dims=(), start_index_map=(0, 1))
    mode = lax.GatherScatterMode.PROMISE_IN_BOUNDS
    return lax.gather(tally, _corners(row, first_bin), numbers, window, mode=mode).reshape(shape)


def _corners(row: Int[Array, "*s"], first_bin: Int[Array, "*s"]) -> Int[Array, "runs 2"]:
    """Return the row and bin of the first value of each run."""
    return jnp.stack([row, first_bin], axis=-1).reshape(-1, 2)
