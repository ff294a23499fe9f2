r"""From fine bins to samples: convolution with the pulse, integrated exactly over every sample.

A return in the fine bin at t_i adds to the sample at t_s, of the width D, the fraction

    F(t_s - t_i + D/2) - F(t_s - t_i - D/2),   F(t) = integral of the pulse's power up to t,

which depends on t_s - t_i alone. It is applied as a matrix of fine bins and samples where that is small, or
as a band: samples in tiles, each of which takes from two blocks of fine bins, by one matrix for all tiles.

Deposits were spread by a kernel (`trace.deposit`) of the second moment v = 1/4 bin^2
(`KERNEL_VARIANCE`). It is taken out again to second order, F - v/2 F'', by fluxes that are limited so that no
fraction becomes negative (as those of Boris and Book 1973, J. Comput. Phys. 11, 38). Where the pulse is
smooth on the scale of a fine bin, the error left is of fourth order in the bin's width.
"""

from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._fields.checks import as_array
from jaxlidar._jax.one_function import barrier
from jaxlidar._jax.products import einsum
from jaxlidar._jax.programs import Program
from jaxlidar.planning.config import KERNEL_VARIANCE
from jaxlidar.planning.memory import band_size
from jaxlidar.planning.plan import Plan
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.pulse import AbstractPulse


@final
class PulseConvolution(eqx.Module):
    """The linear map from returns in fine bins to samples of the digitiser. Made by `pulse_convolution`.

    - `fractions`: of a return that samples receive, by their offset from the fine bin, in fine bins.
    - `first_offset`: the offset of the first of them.
    - `n_bins`, `n_samples`, `bins_per_sample`: sizes. `is_dense`: True if the map is applied as a matrix.
    """

    fractions: Float[Array, "offsets"]
    first_offset: int = eqx.field(static=True)
    n_bins: int = eqx.field(static=True)
    n_samples: int = eqx.field(static=True)
    bins_per_sample: int = eqx.field(static=True)
    is_dense: bool = eqx.field(static=True)

    def matrix(self) -> Float[Array, "fine samples"]:
        """Return the fraction of a return in fine bin i that each sample receives."""
        # Indices are computed by the program: tables of NumPy would be constants of megabytes in it.
        samples, bins = jnp.arange(self.n_samples)[None, :], jnp.arange(self.n_bins)[:, None]
        # Optimisation barriers: fused into the gather, the pulse would be computed again for every element;
        # and the matrix for every product, in place of once for all shots of a survey.
        return barrier(barrier(self.fractions)[samples * self.bins_per_sample - bins - self.first_offset])

    def __call__(self, fine: Float[Array, "*s bins"]) -> Float[Array, "*s samples"]:
        """Return the samples of returns in fine bins."""
        if self.is_dense:
            return einsum("...b,bs->...s", fine, self.matrix())
        return self._convolve(fine)

    def _convolve(self, fine: Float[Array, "*s bins"]) -> Float[Array, "*s samples"]:
        """Apply the band: sample s takes the fine bins s * stride - n, with n the offsets of `fractions`.

        1. Lay out the fine bins in blocks as long as the samples of a tile. The first block begins with the
           first bin that sample 0 takes. A tile is at least as long as the band, so that tile t takes from
           blocks t and t + 1 alone.
        2. Multiply all blocks by the matrices of both positions.
        3. Add what each tile takes from its two blocks.
        """
        stride, width = self.bins_per_sample, self.fractions.size
        n_tile = -(-width // stride)
        block, n_tiles = n_tile * stride, -(-self.n_samples // n_tile)
        # Step 1. Sample 0 begins with bin -last: pad what it lacks, or skip what it does not take.
        last = self.first_offset + width - 1
        before, skipped, length = max(last, 0), max(-last, 0), (n_tiles + 1) * block
        after = max(skipped + length - before - self.n_bins, 0)
        padded = jnp.pad(fine, [(0, 0)] * (fine.ndim - 1) + [(before, after)])
        blocks = padded[..., skipped : skipped + length].reshape(*fine.shape[:-1], n_tiles + 1, block)
        # Step 2. Optimisation barrier: padding in the product's own kernel takes longer than the product.
        products = einsum("...b,bps->...ps", barrier(blocks), self._tile_matrices(n_tile))
        # Step 3.
        tiles = products[..., :-1, 0, :] + products[..., 1:, 1, :]
        return tiles.reshape(*fine.shape[:-1], n_tiles * n_tile)[..., : self.n_samples]

    def _tile_matrices(self, n_tile: int) -> Float[Array, "block 2 tile"]:
        """Return the fraction of each bin of the two blocks of a tile that each of its samples receives."""
        block, width = n_tile * self.bins_per_sample, self.fractions.size
        bins = jnp.arange(block)[:, None, None] + block * jnp.arange(2)[None, :, None]
        index = jnp.arange(n_tile)[None, None, :] * self.bins_per_sample - bins + width - 1
        in_band = (index >= 0) & (index < width)
        fractions = barrier(self.fractions)[jnp.clip(index, 0, width - 1)]
        # Optimisation barriers as in `matrix`.
        return barrier(jnp.where(in_band, fractions, 0.0))


def pulse_convolution(
    lidar: Lidar, plan: Plan, n_samples: int | None = None, band: tuple[int, int] | None = None
) -> PulseConvolution:
    """Make the convolution of a lidar's pulse with its digitiser's first `n_samples` samples.

    Default None: as many as the plan has. `band`: offsets (see `pulse_band`) beyond which samples take from
    no bin, for a band in place of the matrix wherever that takes less. Default None: that of the plan.
    """
    # Offsets between a sample's centre and a fine bin's, in fine bins, from the last bin to the first.
    bins, bins_per_sample, n_samples = plan.bins, plan.bins_per_sample, n_samples or plan.n_samples
    low, high = -(bins.count - 1), (n_samples - 1) * bins_per_sample
    band, is_dense = plan.pulse_band if band is None else band, True
    if band is not None:
        # A band of one offset at least, where the record lies beside all returns.
        band_low = min(max(low, band[0]), high)
        band_high = max(min(high, band[1]), band_low)
        is_dense = band_size(band_high - band_low + 1, bins_per_sample) >= bins.count * n_samples
        if not is_dense:
            low, high = band_low, band_high
    # The edges of samples lie a whole number of fine bins apart; one more at each end serves the fluxes.
    edge_offset = np.arange(low - 1, high + bins_per_sample + 2) - 0.5 * bins_per_sample
    edges = as_array((edge_offset + plan.first_sample) * bins.width)
    fractions = _compiled_fractions(lidar.pulse, lidar.jitter, edges, KERNEL_VARIANCE, bins_per_sample)
    return PulseConvolution(fractions, low, bins.count, n_samples, bins_per_sample, is_dense)


def _sample_fractions(
    pulse: AbstractPulse,
    jitter: Float[Array, ""],
    edges: Float[Array, "edges"],
    variance: float,
    bins_per_sample: int,
) -> Float[Array, "offsets"]:
    """Return the fractions of a return that samples receive, by offset from its fine bin."""
    cumulative = pulse.cumulative(edges, jitter)
    cumulative = _narrowed(cumulative[:-2], cumulative[1:-1], cumulative[2:], variance)
    return cumulative[bins_per_sample:] - cumulative[:-bins_per_sample]


def _narrowed(
    before: Float[Array, "..."], cumulative: Float[Array, "..."], after: Float[Array, "..."], variance: float
) -> Float[Array, "..."]:
    """Return F - v/2 F'': the integral of the pulse, narrowed by the variance of the kernel of deposits.

    `before`, `after`: the integral one fine bin earlier and later. `variance`: in bins squared.
    """
    earlier_bin = jnp.maximum(cumulative - before, 0.0)
    later_bin = jnp.maximum(after - cumulative, 0.0)
    # The flux v/2 F'' across each edge, at most half of the smaller neighbour.
    limit = 0.5 * jnp.minimum(later_bin, earlier_bin)
    flux = jnp.clip(0.5 * variance * (later_bin - earlier_bin), -limit, limit)
    return cumulative - flux


_compiled_fractions = Program(_sample_fractions)


@final
class FreeSamplingConvolution(eqx.Module):
    """The map of `PulseConvolution` for samples of any interval, differentiable with respect to that.

    Made by `free_sampling_convolution`. Its samples need not begin or end where fine bins do.

    - `weights`: fraction of a return in each fine bin that each sample receives.
    """

    weights: Float[Array, "fine samples"]

    @property
    def n_bins(self) -> int:
        """Number of fine bins."""
        return self.weights.shape[0]

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return self.weights.shape[1]

    def __call__(self, fine: Float[Array, "*s bins"]) -> Float[Array, "*s samples"]:
        """Return the samples of returns in fine bins."""
        return einsum("...b,bs->...s", fine, self.weights)


def free_sampling_convolution(lidar: Lidar, plan: Plan, n_samples: int) -> FreeSamplingConvolution:
    """Make the convolution of a lidar's pulse with samples of its own interval, not of the plan's.

    The first sample is centred where that of the plan is, and each begins where the one before it ends.
    """
    bins = plan.bins
    # From the centre of the first sample: the times themselves may be large.
    bin_time = as_array(bins.width * (np.arange(bins.count) - plan.first_sample))
    edges = lidar.sampling_interval * as_array(np.arange(n_samples + 1) - 0.5)
    offset = edges[None, :] - bin_time[:, None]
    before, cumulative, after = (
        lidar.pulse.cumulative(offset + shift, lidar.jitter) for shift in (-bins.width, 0.0, bins.width)
    )
    narrowed = _narrowed(before, cumulative, after, KERNEL_VARIANCE)
    return FreeSamplingConvolution(jnp.diff(narrowed, axis=1))
