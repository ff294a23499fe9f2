"""From fine bins to samples: the pulse, integrated over every sample, as a matrix or as a band of one."""

import math
from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxlidar._one_function import once
from jaxlidar._programs import Program
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.instrument.pulse import AbstractPulse
from jaxlidar.planning.plan import Plan
from jaxlidar.planning.trace_plan import DENSE


@final
class Sampling(eqx.Module):
    """What the digitiser makes of returns in fine bins. Made by `sampling_of`."""

    share: Float[Array, "offsets"]
    first: int = eqx.field(static=True)
    bins: int = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    per_sample: int = eqx.field(static=True)

    @property
    def dense(self) -> bool:
        """Whether a matrix serves."""
        return self.bins * self.samples <= DENSE

    def matrix(self) -> Float[Array, "fine samples"]:
        """Share of a return in fine bin i that each sample receives."""
        samples, bins = np.arange(self.samples)[None, :], np.arange(self.bins)[:, None]
        # Fused into the gather, the pulse would be computed again for every element.
        return once(self.share)[samples * self.per_sample - bins - self.first]

    def __call__(self, fine: Float[Array, "*s bins"]) -> Float[Array, "*s samples"]:
        """Samples of returns in fine bins."""
        if self.dense:
            return jnp.einsum("...b,bs->...s", fine, self.matrix())
        return self._band(fine)

    def _band(self, fine: Float[Array, "*s bins"]) -> Float[Array, "*s samples"]:
        """Only where the pulse reaches: sample s takes fine bins s k - n, n the numbers of `share`."""
        stride, last = self.per_sample, self.first + self.share.size - 1
        # Sample 0 begins with bin -last.
        before = max(last, 0)
        start = before - last
        length = (self.samples - 1) * stride + self.share.size
        after = max(start + length - before - self.bins, 0)
        rows = fine.reshape(-1, 1, fine.shape[-1])
        rows = jnp.pad(rows, ((0, 0), (0, 0), (before, after)))[..., start : start + length]
        out = lax.conv_general_dilated(
            rows, self.share[::-1][None, None, :], (stride,), "VALID", precision=lax.Precision.HIGHEST
        )
        return out.reshape(*fine.shape[:-1], self.samples)


def sampling_of(lidar: Lidar, plan: Plan, samples: int | None = None) -> Sampling:
    """The pulse of a lidar, as its digitiser integrates it over the first `samples` samples.

    Default None: as many as the plan has.

    The second moment of the deposit kernel (see `jaxlidar.trace.deposit`) is taken out, by steps that are
    limited so that no share becomes negative (as fluxes are by Boris and Book 1973, J. Comput. Phys. 11,
    38). Where the pulse is smooth on the scale of a fine bin, this leaves an error of fourth order in the
    bin's width.
    """
    # Offsets between a sample's centre and a fine bin's, in fine bins, from the last bin to the first.
    bins, across, samples = plan.bins, plan.per_sample, samples or plan.n_samples
    shift = (plan.sample_start - bins.start) / bins.width
    low, high = -(bins.count - 1), (samples - 1) * across
    if bins.count * samples > DENSE:
        # As far as the pulse reaches.
        half = 0.5 * plan.sample_interval
        low = max(low, math.floor((plan.reach[0] - half) / bins.width - shift) - 2)
        high = min(high, math.ceil((plan.reach[1] + half) / bins.width - shift) + 2)
    # The edges of samples lie a whole number of fine bins apart.
    number = np.arange(low - 1, high + across + 2) - 0.5 * across
    share = _compiled_shares(
        lidar.pulse, lidar.jitter, jnp.asarray((number + shift) * bins.width), bins.kernel_variance, across
    )
    return Sampling(share, low, bins.count, samples, across)


def _shares(
    pulse: AbstractPulse, jitter: Float[Array, ""], edges: Float[Array, "edges"], variance: float, across: int
) -> Float[Array, "offsets"]:
    """What samples of `across` fine bins receive of bins that lie ever earlier."""
    passed = pulse.cumulative(edges, jitter)
    share = jnp.maximum(jnp.diff(passed), 0.0)
    most = 0.5 * jnp.minimum(share[1:], share[:-1])
    step = jnp.clip(0.5 * variance * jnp.diff(share), -most, most)
    passed = passed[1:-1] - step
    return passed[across:] - passed[:-across]


_compiled_shares = Program(_shares)
