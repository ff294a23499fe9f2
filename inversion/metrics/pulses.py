"""Pulses at the sampling of a record, and what smoothing a record makes of their echoes."""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from inversion.metrics.records import ladder
from jaxlidar import AbstractPulse
from jaxlidar.extend import as_array, check_range, concrete

# m of height per ns of two-way travel at nadir.
METRES_PER_NS = 0.149896229
# Samples of a pulse below this share of its peak are left out at its ends.
_FAINT = 1e-6

# A recorded pulse at the sampling of the record, (lags,), or a pulse.
Pulse = Float[ArrayLike, "... lags"] | AbstractPulse


def pulse_samples(pulse: Pulse | None, step: float | None) -> Float[Array, "... padded"]:
    """A pulse at the sampling of a record, of peak one, time zero in the middle, padded to a ladder of sizes.

    **Arguments:**

    - `pulse`: see `gaussian_decomposition`. None gives a single sample: no pulse at all.
    - `step`: ns from sample to sample; None where it is not known, as inside a JAX transformation.

    **Returns:** (..., lags), an odd number of lags.

    **Raises:** ValueError for an even number of lags, samples that are not finite or have no positive peak,
    and for an `AbstractPulse` whose samples are not known.
    """
    if pulse is None:
        return jnp.ones(1)
    if isinstance(pulse, AbstractPulse):
        if step is None:
            raise ValueError(
                "pulse is to be sampled at steps that a JAX transformation is tracing; admissible there are "
                "samples"
            )
        half = max(1, math.ceil(max(map(abs, pulse.support())) / step))
        samples = pulse.power(jnp.arange(-half, half + 1) * step)
    else:
        samples = as_array(pulse, "pulse")
    if samples.ndim < 1 or samples.shape[-1] % 2 == 0:
        raise ValueError(
            f"pulse has the shape {samples.shape}; admissible is (lags,) with an odd number of lags"
        )
    check_range("pulse", samples)
    known = concrete(samples)
    if known is not None:
        peak = known.max(axis=-1)
        check_range("peak of pulse", peak, 0.0, low_open=True)
        lit = np.flatnonzero(
            np.any(np.abs(known) > _FAINT * peak[..., None], axis=tuple(range(known.ndim - 1)))
        )
        middle = known.shape[-1] // 2
        reach = max(middle - int(lit[0]), int(lit[-1]) - middle)
        samples = samples[..., middle - reach : middle + reach + 1]
    half = samples.shape[-1] // 2
    more = ladder(half) - half
    samples = jnp.pad(samples, [(0, 0)] * (samples.ndim - 1) + [(more, more)])
    return samples / jnp.max(samples, axis=-1, keepdims=True)


class Response(NamedTuple):
    """What smoothing a record by a Gaussian of a pulse's peak and area makes of an echo of that pulse.

    - `kernel`: (lags,) the Gaussian, of unit area.
    - `mode`: samples from the pulse's time zero to the mode of the smoothed echo.
    - `tail`: (2 lags - 1,) most of the smoothed echo so many samples after its mode or later, over its peak;
      0 at 0.
    """

    kernel: Float[Array, " lags"]
    mode: Float[Array, ""]
    tail: Float[Array, " delays"]


def response(pulse: Float[Array, " lags"]) -> Response:
    """The response of a record's smoothing to a pulse from `pulse_samples`; for one sample, no smoothing."""
    if pulse.size == 1:
        return Response(jnp.ones(1), jnp.zeros(()), jnp.zeros(1))
    width = jnp.sum(pulse) / math.sqrt(2.0 * math.pi)
    lag = jnp.arange(pulse.size) - pulse.size // 2
    kernel = jnp.exp(-0.5 * (lag / width) ** 2)
    kernel /= jnp.sum(kernel)
    smooth = jnp.convolve(pulse, kernel, mode="full")
    peak = jnp.clip(jnp.argmax(smooth), 1, smooth.size - 2)
    late = jnp.arange(smooth.size) + peak
    echo = jnp.where(late < smooth.size, smooth[jnp.clip(late, 0, smooth.size - 1)], 0.0) / smooth[peak]
    mode = peak + vertex(smooth, peak) - (pulse.size - 1)
    return Response(kernel, mode, lax.cummax(echo, reverse=True).at[0].set(0.0))


def vertex(samples: Float[Array, " bins"], peak: Array) -> Float[Array, ""]:
    """From a maximum to the vertex of the parabola through it and its two neighbours, in samples."""
    before, top, after = samples[peak - 1], samples[peak], samples[peak + 1]
    bend = 2.0 * top - before - after
    return 0.5 * (after - before) / jnp.where(bend > 0, bend, 1.0)


def steps_of(axis: Float[ArrayLike, "... bins"], scale: float = 1.0) -> float | None:
    """From sample to sample of an even axis over `scale`, or None where it is not known."""
    known = concrete(axis)
    return None if known is None else abs(float(known.flat[1] - known.flat[0])) / scale
