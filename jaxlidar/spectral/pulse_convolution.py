r"""From fine bins to samples: convolution with the pulse, integrated exactly over every sample.

A return in the fine bin at t_i adds to the sample at t_s, of the width D, the fraction

    F(t_s - t_i + D/2) - F(t_s - t_i - D/2),   F(t) = integral of the pulse's power up to t,

which depends on t_s - t_i alone. It is applied as a matrix of fine bins and samples where that is small, else
as a strided convolution with a band.

Deposits were spread by a kernel (`jaxlidar.trace.deposit`) of the second moment v = 1/4 bin^2
(`KERNEL_VARIANCE`). It is taken out again to second order, F - v/2 F'', by fluxes that are limited so that no
fraction becomes negative (as those of Boris and Book 1973, J. Comput. Phys. 11, 38). Where the pulse is
smooth on the scale of a fine bin, the error left is of fourth order in the bin's width.
"""

import math
from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxlidar._checks import as_array
from jaxlidar._one_function import once
from jaxlidar._products import FULL_PRECISION, einsum
from jaxlidar._programs import Program
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.instrument.pulse import AbstractPulse
from jaxlidar.planning.config import KERNEL_VARIANCE
from jaxlidar.planning.memory import MAX_DENSE_PULSE
from jaxlidar.planning.plan import Plan


@final
class PulseConvolution(eqx.Module):
    """The linear map from returns in fine bins to samples of the digitiser. Made by `pulse_convolution`.

    - `fractions`: of a return that samples receive, by their offset from the fine bin, in fine bins.
    - `first_offset`: the offset of the first of them.
    - `n_bins`, `n_samples`, `bins_per_sample`: sizes.
    """

    fractions: Float[Array, "offsets"]
    first_offset: int = eqx.field(static=True)
    n_bins: int = eqx.field(static=True)
    n_samples: int = eqx.field(static=True)
    bins_per_sample: int = eqx.field(static=True)

    @property
    def is_dense(self) -> bool:
        """True if the map is applied as a matrix."""
        return self.n_bins * self.n_samples <= MAX_DENSE_PULSE

    def matrix(self) -> Float[Array, "fine samples"]:
        """Return the fraction of a return in fine bin i that each sample receives."""
        samples, bins = np.arange(self.n_samples)[None, :], np.arange(self.n_bins)[:, None]
        # Optimisation barriers: fused into the gather, the pulse would be computed again for every element;
        # and the matrix for every product, in place of once for all shots of a survey.
        return once(once(self.fractions)[samples * self.bins_per_sample - bins - self.first_offset])

    def __call__(self, fine: Float[Array, "*s bins"]) -> Float[Array, "*s samples"]:
        """Return the samples of returns in fine bins."""
        if self.is_dense:
            return einsum("...b,bs->...s", fine, self.matrix())
        return self._convolve(fine)

    def _convolve(self, fine: Float[Array, "*s bins"]) -> Float[Array, "*s samples"]:
        """Apply the band: sample s takes the fine bins s * stride - n, with n the offsets of `fractions`."""
        stride, last = self.bins_per_sample, self.first_offset + self.fractions.size - 1
        # Sample 0 begins with bin -last: pad what it lacks, or skip what it does not take.
        before = max(last, 0)
        start = before - last
        length = (self.n_samples - 1) * stride + self.fractions.size
        after = max(start + length - before - self.n_bins, 0)
        rows = fine.reshape(-1, 1, fine.shape[-1])
        rows = jnp.pad(rows, ((0, 0), (0, 0), (before, after)))[..., start : start + length]
        out = lax.conv_general_dilated(
            rows, self.fractions[::-1][None, None, :], (stride,), "VALID", precision=FULL_PRECISION
        )
        return out.reshape(*fine.shape[:-1], self.n_samples)


def pulse_convolution(lidar: Lidar, plan: Plan, n_samples: int | None = None) -> PulseConvolution:
    """Make the convolution of a lidar's pulse with its digitiser's first `n_samples` samples.

    Default None: as many as the plan has.
    """
    # Offsets between a sample's centre and a fine bin's, in fine bins, from the last bin to the first.
    bins, bins_per_sample, n_samples = plan.bins, plan.bins_per_sample, n_samples or plan.n_samples
    # That of the first sample's centre from the first bin's.
    first_sample = (plan.sample_start - bins.start) / bins.width
    low, high = -(bins.count - 1), (n_samples - 1) * bins_per_sample
    if bins.count * n_samples > MAX_DENSE_PULSE:
        # A band as wide as the pulse.
        half = 0.5 * plan.sample_interval
        low = max(low, math.floor((plan.pulse_support[0] - half) / bins.width - first_sample) - 2)
        high = min(high, math.ceil((plan.pulse_support[1] + half) / bins.width - first_sample) + 2)
    # The edges of samples lie a whole number of fine bins apart; one more at each end serves the fluxes.
    edge_offset = np.arange(low - 1, high + bins_per_sample + 2) - 0.5 * bins_per_sample
    edges = as_array((edge_offset + first_sample) * bins.width)
    fractions = _compiled_fractions(lidar.pulse, lidar.jitter, edges, KERNEL_VARIANCE, bins_per_sample)
    return PulseConvolution(fractions, low, bins.count, n_samples, bins_per_sample)


def _sample_fractions(
    pulse: AbstractPulse,
    jitter: Float[Array, ""],
    edges: Float[Array, "edges"],
    variance: float,
    bins_per_sample: int,
) -> Float[Array, "offsets"]:
    """Return the fractions of a return that samples receive, by offset from its fine bin."""
    cumulative = pulse.cumulative(edges, jitter)
    in_bins = jnp.maximum(jnp.diff(cumulative), 0.0)
    # The flux v/2 F'' across each edge, at most half of the smaller neighbour.
    limit = 0.5 * jnp.minimum(in_bins[1:], in_bins[:-1])
    flux = jnp.clip(0.5 * variance * jnp.diff(in_bins), -limit, limit)
    cumulative = cumulative[1:-1] - flux
    return cumulative[bins_per_sample:] - cumulative[:-bins_per_sample]


_compiled_fractions = Program(_sample_fractions)
