r"""Records and pulses in the form that compiled programs take: one sampling, a few sizes, many shots.

**Size buckets.** XLA compiles a program for one shape. Records are padded with zeros to the next size of 64,
96, 128, 192, 256, 384, ... samples, so that records of all lengths up to a size share a program. The number
of samples recorded, `n_samples`, is an argument of the program.

**Smoothing.** A record is smoothed by the Gaussian that has peak and area of its pulse p,

    g(i) = exp(-i^2 / 2 s^2) / sum_j exp(-j^2 / 2 s^2),    s = sum_i p(i) / (sqrt(2 pi) max p).

For a Gaussian pulse this is the matched filter. For any other it has no side lobes, which the matched filter
has. An echo of a pulse with a skew or a tail keeps both when smoothed: the convolution p * g says how far the
mode lies from the pulse's time zero, and how much of the echo may follow the mode (`SmoothedPulse`).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from jaxlidar import AbstractPulse
from jaxlidar.extend import as_array, check_range, concrete

# Metres of height per ns of two-way travel at nadir: half the speed of light.
METRES_PER_NS = 0.149896229
# The ends of a pulse are cut where its samples stay below this fraction of its peak.
_FAINT = 1e-6

# A recorded pulse at the sampling of the record, (lags,) or (shots, lags), or a pulse of jaxlidar.
Pulse = Float[ArrayLike, "... lags"] | AbstractPulse


# -- programs for many sizes and many shots ------------------------------------------------------------


def size_bucket(count: int) -> int:
    """Smallest of 64, 96, 128, 192, 256, 384, ... that is not below `count`."""
    size = 64
    while size < count:
        # From a power of two to one and a half of it, and from there to the next power of two.
        size = size * 3 // 2 if size & (size - 1) == 0 else size * 4 // 3
    return size


def pad_to(samples: Array, size: int) -> Array:
    """Append zeros to the last axis, up to `size` samples."""
    return jnp.pad(samples, [(0, 0)] * (samples.ndim - 1) + [(0, size - samples.shape[-1])])


def over_shots(*, sequential: bool = False, **ranks: int) -> Callable[[Callable], Callable]:
    """Return a decorator that makes a compiled function of many shots out of a function of one shot.

    The decorated function takes arrays by keyword. Their leading dimensions are shots and broadcast against
    one another; results have the broadcast dimensions first.

    **Arguments:**

    - `sequential`: compute one shot after the other, not all at once. For iterations that end after a number
      of steps that differs between shots: side by side, all shots would take as many as the slowest.
    - `ranks`: by the name of each argument, its number of dimensions for one shot.
    """

    def decorate(function: Callable) -> Callable:
        def batched(**arguments: Array):
            shots = jnp.broadcast_shapes(
                *(array.shape[: array.ndim - ranks[name]] for name, array in arguments.items())
            )
            if not shots:
                return function(**arguments)
            rows = {}
            for name, array in arguments.items():
                shape = array.shape[array.ndim - ranks[name] :]
                rows[name] = jnp.broadcast_to(array, shots + shape).reshape(-1, *shape)

            def of_row(row: dict[str, Array]):
                return function(**row)

            results = lax.map(of_row, rows) if sequential else jax.vmap(of_row)(rows)
            return jax.tree.map(lambda array: array.reshape(*shots, *array.shape[1:]), results)

        # JAX names the compiled program after the function.
        batched.__name__ = function.__name__
        return jax.jit(batched)

    return decorate


class PaddedRecord(NamedTuple):
    """One record or several, padded with zeros to a size bucket.

    - `height`: (bins,) or (shots, bins) m, decreasing in equal steps.
    - `power`: (bins,) or (shots, bins).
    - `n_samples`: () number of samples that were recorded, the first ones.
    """

    height: Float[Array, "... bins"]
    power: Float[Array, "... bins"]
    n_samples: Array


def pad_record(height: ArrayLike, power: ArrayLike) -> PaddedRecord:
    """Check heights and samples and pad them to a size bucket.

    **Raises:** ValueError for shapes that do not match, fewer than three samples, values that are not finite,
    and heights that do not decrease.
    """
    z, y = as_array(height, "height"), as_array(power, "power")
    if y.ndim < 1 or z.ndim < 1 or z.shape[-1] != y.shape[-1] or y.shape[-1] < 3:
        raise ValueError(
            f"height and power have the shapes {z.shape} and {y.shape}; admissible is (..., bins) for both, "
            "three or more"
        )
    check_range("height", height)
    check_range("power", power)
    check_range("steps of height", -jnp.diff(z), 0.0, low_open=True)
    size = size_bucket(y.shape[-1])
    return PaddedRecord(pad_to(z, size), pad_to(y, size), jnp.asarray(y.shape[-1]))


def sampling_step(axis: Float[ArrayLike, "... bins"], scale: float = 1.0) -> float | None:
    """Step of an even axis over `scale`, or None inside a JAX transformation, which traces the axis."""
    values = concrete(axis)
    return None if values is None else abs(float(values.flat[1] - values.flat[0])) / scale


# -- pulses --------------------------------------------------------------------------------------------


def sample_pulse(pulse: Pulse | None, step: float | None) -> Float[Array, "... padded"]:
    """Sample a pulse as a record is sampled: peak one, time zero in the middle, padded to a size bucket.

    1. Evaluate an `AbstractPulse` over its support, or take the samples.
    2. Cut the faint ends, equally on both sides, so that time zero stays in the middle.
    3. Pad both sides to a size bucket, and divide by the peak.

    **Arguments:**

    - `pulse`: see `gaussian_decomposition`. None gives a single sample of one: no pulse at all.
    - `step`: sampling interval in ns; None inside a JAX transformation that traces the record's axis.

    **Returns:** (..., lags), an odd number of lags.

    **Raises:** ValueError for an even number of lags, for samples that are not finite or have no positive
    peak, and for an `AbstractPulse` where `step` is None.
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
            f"pulse has the shape {samples.shape}; admissible is (lags,) with an odd number of lags, the "
            "middle one at the pulse's time zero: pad one end with zeros, or give its times as well, as "
            "jaxlidar.SampledPulse(time=, power=)"
        )
    check_range("pulse", samples)
    # Ends can be cut only where the samples have values; inside a transformation all lags stay.
    values = concrete(samples)
    if values is not None:
        peak = values.max(axis=-1)
        check_range("peak of pulse", peak, 0.0, low_open=True)
        is_bright = np.abs(values) > _FAINT * peak[..., None]
        bright_lags = np.flatnonzero(np.any(is_bright, axis=tuple(range(values.ndim - 1))))
        middle = values.shape[-1] // 2
        half = max(middle - int(bright_lags[0]), int(bright_lags[-1]) - middle)
        samples = samples[..., middle - half : middle + half + 1]
    half = samples.shape[-1] // 2
    padding = size_bucket(half) - half
    samples = jnp.pad(samples, [(0, 0)] * (samples.ndim - 1) + [(padding, padding)])
    return samples / jnp.max(samples, axis=-1, keepdims=True)


def sample_pulse_at_heights(pulse: Pulse | None, height: ArrayLike) -> Float[Array, "... padded"]:
    """Sample a pulse at the steps of a record's heights, for light that goes straight down."""
    return sample_pulse(pulse, sampling_step(height, METRES_PER_NS))


class SmoothedPulse(NamedTuple):
    """The Gaussian that smooths a record, and the shape of a smoothed echo of the record's pulse.

    - `kernel`: (lags,) the Gaussian g, of unit area.
    - `mode`: samples from the pulse's time zero to the mode of the smoothed echo.
    - `tail`: (2 lags - 1,) at delay j, largest value of the smoothed echo j samples after its mode or later,
      over its peak; 0 at 0. It bounds the signal of one echo below its mode.
    """

    kernel: Float[Array, " lags"]
    mode: Float[Array, ""]
    tail: Float[Array, " delays"]


def smooth_pulse(pulse: Float[Array, " lags"]) -> SmoothedPulse:
    """Smooth a pulse of `sample_pulse` as its record is smoothed; a single sample means no smoothing.

    1. Kernel: the Gaussian of the pulse's peak (one) and area.
    2. Mode of the smoothed pulse, between samples by a parabola.
    3. Tail: running maximum, from the end, of the samples after the mode.
    """
    if pulse.size == 1:
        return SmoothedPulse(jnp.ones(1), jnp.zeros(()), jnp.zeros(1))
    width = jnp.sum(pulse) / math.sqrt(2.0 * math.pi)
    lag = jnp.arange(pulse.size) - pulse.size // 2
    kernel = jnp.exp(-0.5 * (lag / width) ** 2)
    kernel /= jnp.sum(kernel)
    smooth = jnp.convolve(pulse, kernel, mode="full")
    # The parabola needs a neighbour on both sides.
    peak = jnp.clip(jnp.argmax(smooth), 1, smooth.size - 2)
    after_peak = jnp.arange(smooth.size) + peak
    clipped = jnp.clip(after_peak, 0, smooth.size - 1)
    echo = jnp.where(after_peak < smooth.size, smooth[clipped], 0.0) / smooth[peak]
    # In the full convolution of two arrays of n lags each, time zero is sample n - 1.
    mode = peak + vertex_offset(smooth, peak) - (pulse.size - 1)
    return SmoothedPulse(kernel, mode, lax.cummax(echo, reverse=True).at[0].set(0.0))


def vertex_offset(samples: Float[Array, " bins"], peak: Array) -> Float[Array, ""]:
    """Offset in samples of the vertex of the parabola through a maximum and its two neighbours.

    With samples a, b, c about the maximum b the offset is (c - a) / (2 (2 b - a - c)).
    """
    before, top, after = samples[peak - 1], samples[peak], samples[peak + 1]
    curvature = 2.0 * top - before - after
    # Three equal samples have no vertex; the offset is then zero, without a division by zero.
    return 0.5 * (after - before) / jnp.where(curvature > 0, curvature, 1.0)
