"""From fine bins to samples: the pulse, integrated over every sample, as a matrix or as a band of one."""

import math
from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxlidar.instrument.lidar import Lidar
from jaxlidar.planning.plan import Plan
from jaxlidar.planning.trace_plan import DENSE


@final
class Sampling(eqx.Module):
    """What the digitiser makes of returns in fine bins. Made by `sampling_of`."""

    share: Float[Array, "offsets"]
    first: int = eqx.field(static=True)
    plan: Plan = eqx.field(static=True)

    @property
    def dense(self) -> bool:
        """Whether a matrix serves."""
        return self.plan.bins.count * self.plan.n_samples <= DENSE

    def matrix(self) -> Float[Array, "fine samples"]:
        """Share of a return in fine bin i that each sample receives."""
        plan = self.plan
        samples, bins = np.arange(plan.n_samples)[None, :], np.arange(plan.bins.count)[:, None]
        # Fused into the gather, the pulse would be computed again for every element.
        return lax.optimization_barrier(self.share)[samples * plan.per_sample - bins - self.first]

    def __call__(self, fine: Float[Array, "*s bins"]) -> Float[Array, "*s samples"]:
        """Samples of returns in fine bins."""
        if self.dense:
            return jnp.einsum("...b,bs->...s", fine, self.matrix())
        return self._band(fine)

    def _band(self, fine: Float[Array, "*s bins"]) -> Float[Array, "*s samples"]:
        """Only where the pulse reaches: sample s takes fine bins s k - n, n the numbers of `share`."""
        plan = self.plan
        stride, last = plan.per_sample, self.first + self.share.size - 1
        # Sample 0 begins with bin -last.
        before = max(last, 0)
        start = before - last
        length = (plan.n_samples - 1) * stride + self.share.size
        after = max(start + length - before - plan.bins.count, 0)
        rows = fine.reshape(-1, 1, fine.shape[-1])
        rows = jnp.pad(rows, ((0, 0), (0, 0), (before, after)))[..., start : start + length]
        out = lax.conv_general_dilated(
            rows, self.share[::-1][None, None, :], (stride,), "VALID", precision=lax.Precision.HIGHEST
        )
        return out.reshape(*fine.shape[:-1], plan.n_samples)


def sampling_of(lidar: Lidar, plan: Plan) -> Sampling:
    """The pulse of a lidar, as its digitiser integrates it.

    The second moment of the deposit kernel (see `jaxlidar.trace.deposit`) is taken out, by steps that are
    limited so that no share becomes negative (as fluxes are by Boris and Book 1973, J. Comput. Phys. 11,
    38). Where the pulse is smooth on the scale of a fine bin, this leaves an error of fourth order in the
    bin's width.
    """
    # Offsets between a sample's centre and a fine bin's, in fine bins, from the last bin to the first.
    bins, across = plan.bins, plan.per_sample
    shift = (plan.sample_start - bins.start) / bins.width
    low, high = -(bins.count - 1), (plan.n_samples - 1) * across
    if bins.count * plan.n_samples > DENSE:
        # As far as the pulse reaches.
        half = 0.5 * plan.sample_interval
        low = max(low, math.floor((plan.reach[0] - half) / bins.width - shift) - 2)
        high = min(high, math.ceil((plan.reach[1] + half) / bins.width - shift) + 2)
    # The edges of samples lie a whole number of fine bins apart.
    number = np.arange(low - 1, high + across + 2) - 0.5 * across
    passed = lidar.pulse.cumulative(jnp.asarray((number + shift) * bins.width), lidar.jitter)
    share = jnp.maximum(jnp.diff(passed), 0.0)
    most = 0.5 * jnp.minimum(share[1:], share[:-1])
    step = jnp.clip(0.5 * bins.kernel_variance * jnp.diff(share), -most, most)
    passed = passed[1:-1] - step
    return Sampling(passed[across:] - passed[:-across], low, plan)
