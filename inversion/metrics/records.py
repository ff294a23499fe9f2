r"""Records by height: padded to a size bucket, checked for a background, and smoothed.

**Size buckets.** Records of all lengths up to a size share a program (`jaxlidar.survey.records`). The number
of samples recorded, `n_samples`, is an argument of the program.

**Smoothing.** A record is smoothed by a Gaussian narrower than that which has peak and area of its pulse p,

    g(i) = exp(-i^2 / 2 s^2) / sum_j exp(-j^2 / 2 s^2),    s = 0.83 sum_i p(i) / (sqrt(2 pi) max p).

For a Gaussian pulse the factor 1 would be the matched filter; 0.83 is that of GEDI's processing, 6.5 bins for
a pulse of 7.8. It loses 1 % of the signal-to-noise ratio, sqrt(2 f / (1 + f^2)), and separates echoes that
lie closer by 8 %, 2 s sqrt(1 + f^2). For other pulses a Gaussian has no side lobes, which the matched
filter has. An echo of a pulse with a skew or a tail keeps both when smoothed: the convolution
p * g says how far the mode lies from the pulse's time zero, and how much of the echo may follow the mode
(`SmoothedPulse`).
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from jaxlidar import SPEED_OF_LIGHT
from jaxlidar.extend import check_range, concrete
from jaxlidar.survey.records import (
    EvenAxis,
    Pulse,
    divide,
    divide_by_largest,
    even_axis,
    pad_to,
    record_bucket,
    sample_pulse,
)

# Metres of height per ns of two-way travel at nadir: half the speed of light.
METRES_PER_NS = 0.5 * SPEED_OF_LIGHT
# Width of the smoothing over that of the Gaussian of the pulse's peak and area.
SMOOTHING = 0.83
# Median of the absolute value of a normal variable of unit variance.
NORMAL_MEDIAN = 0.6745
# At least this fraction of the samples of a record without background is quiet: within these standard
# deviations of the noise of zero, or this fraction of the largest sample.
_QUIET_FRACTION, _QUIET_SIGMAS, _QUIET_LEVEL = 0.05, 2.0, 0.01


class PaddedRecord(NamedTuple):
    """One record or several, over their largest samples, padded with zeros to a size bucket.

    - `heights`: of the samples in m, decreasing from the first.
    - `power`: (bins,) or (shots, bins) samples over `magnitude`.
    - `n_samples`: () number of samples that were recorded, the first ones.
    - `magnitude`: () or (shots,) largest magnitude of the samples.
    """

    heights: EvenAxis
    power: Float[Array, "... bins"]
    n_samples: Array
    magnitude: Array | np.ndarray

    def arguments(self) -> dict[str, Array]:
        """Arguments `step`, `power` and `n_samples` of programs of one shot."""
        step = jnp.asarray(self.heights.step, self.power.dtype)
        return {"step": step, "power": self.power, "n_samples": self.n_samples}

    def over_magnitude(self, x: ArrayLike, field: str) -> Array:
        """Convert numbers in the unit of the record, () or (shots,), to that of `power`."""
        return divide(x, self.magnitude, field)

    def times_magnitude(self, x: Array) -> Array:
        """Convert energies in the unit of `power` to that of the record."""
        return x * jnp.asarray(self.magnitude, x.dtype)


def pad_record(height: ArrayLike, power: ArrayLike) -> PaddedRecord:
    """Check heights and samples, scale the samples and pad them to a size bucket.

    **Raises:** ValueError for shapes that do not match, fewer than three samples, values that are not finite,
    and heights that do not decrease in even steps.
    """
    check_range("height", height)
    check_range("power", power)
    z_shape, y_shape = np.shape(height), np.shape(power)
    if len(y_shape) < 1 or len(z_shape) < 1 or z_shape[-1] != y_shape[-1] or y_shape[-1] < 3:
        raise ValueError(
            f"height and power have the shapes {z_shape} and {y_shape}; admissible is (..., bins) for both, "
            "three or more"
        )
    heights = even_axis("height", height, decreasing=True)
    samples, magnitude = divide_by_largest(power, "power")
    bins = y_shape[-1]
    return PaddedRecord(heights, pad_to(samples, record_bucket(bins)), jnp.asarray(bins), magnitude)


def check_background(record: PaddedRecord, noise: Array | None, threshold: Array | None = None) -> None:
    """Refuse records whose background was not removed; tracers pass.

    Nearly all samples of such a record lie to one side of zero. It is refused where the lowest twentieth ends
    above, or the median lies below, both two standard deviations of the noise and a hundredth of the largest
    sample. Where the noise is not known, samples below zero are compared with the median absolute deviation.

    **Arguments:** `noise`: standard deviation over the record's magnitude; None where it is not known.
    `threshold`: in the same unit, the least signal, below which a baseline does no harm.

    **Raises:** ValueError with the number of the first such record, and its baseline.
    """
    power, magnitude = concrete(record.power), concrete(record.magnitude)
    sigma = None if noise is None else concrete(noise)
    least = concrete(-np.inf if threshold is None else threshold)
    if power is None or magnitude is None or least is None or (noise is not None and sigma is None):
        return
    refuse_baseline("power", power[..., : int(record.n_samples)], sigma, least=least, unit=magnitude)


def refuse_baseline(
    field: str,
    power: np.ndarray,
    noise: np.ndarray | None,
    *,
    least: np.ndarray | float = -np.inf,
    unit: np.ndarray | float = 1.0,
) -> None:
    """Refuse samples, (..., bins), as `check_background` does; `unit` scales the value of the error."""
    median = np.median(power, axis=-1)
    if noise is None:
        # The deviation of a record of signal throughout is no noise: a baseline may hide below it.
        noise_above, noise_below = 0.0, np.median(np.abs(power - median[..., None]), axis=-1) / NORMAL_MEDIAN
    else:
        noise_above = noise_below = noise
    level = _QUIET_LEVEL * np.max(np.abs(power), axis=-1)
    lowest = np.quantile(power, _QUIET_FRACTION, axis=-1)
    is_above = (lowest > np.maximum(_QUIET_SIGMAS * noise_above, level)) & (lowest > least)
    is_below = median < -np.maximum(_QUIET_SIGMAS * noise_below, level)
    has_baseline = is_above | is_below
    if np.any(has_baseline):
        number = int(np.argmax(has_baseline))
        baseline = np.broadcast_to(unit * np.where(is_below, median, lowest), has_baseline.shape)
        record_name = f" of record {number}" if np.ndim(has_baseline) else ""
        raise ValueError(
            f"{field}{record_name} has a baseline of about {baseline.flat[number]:g}; admissible are records "
            f"less their background, with quiet samples within {_QUIET_SIGMAS:g} standard deviations of the "
            "noise of 0"
        )


# -- pulses --------------------------------------------------------------------------------------------


def sample_pulse_at_heights(pulse: Pulse | None, heights: EvenAxis) -> Float[Array, "... padded"]:
    """Sample a pulse at the steps of a record's heights, for light that goes straight down."""
    return sample_pulse(pulse, heights.step / METRES_PER_NS)


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

    1. Kernel: the Gaussian of the module's docstring.
    2. Mode of the smoothed pulse, between samples by a parabola.
    3. Tail: running maximum, from the end, of the samples after the mode.
    """
    if pulse.size == 1:
        return SmoothedPulse(jnp.ones(1), jnp.zeros(()), jnp.zeros(1))
    width = SMOOTHING * jnp.sum(pulse) / math.sqrt(2.0 * math.pi)
    lag = jnp.arange(pulse.size, dtype=pulse.dtype) - pulse.size // 2
    kernel = jnp.exp(-0.5 * (lag / width) ** 2)
    kernel /= jnp.sum(kernel)
    smooth = jnp.convolve(pulse, kernel, mode="full")
    # The parabola needs a neighbour on both sides.
    peak = jnp.clip(jnp.argmax(smooth), 1, smooth.size - 2)
    after_peak = jnp.arange(smooth.size) + peak
    clipped = jnp.clip(after_peak, 0, smooth.size - 1)
    echo = jnp.where(after_peak < smooth.size, smooth[clipped], 0.0) / smooth[peak]
    # In the full convolution of two arrays of n lags each, time zero is sample n - 1.
    mode = peak.astype(smooth.dtype) + vertex_offset(smooth, peak) - (pulse.size - 1)
    return SmoothedPulse(kernel, mode, lax.cummax(echo, reverse=True).at[0].set(0.0))


def vertex_offset(samples: Float[Array, " bins"], peak: Array) -> Float[Array, ""]:
    """Offset in samples of the vertex of the parabola through a maximum and its two neighbours.

    With samples a, b, c about the maximum b the offset is (c - a) / (2 (2 b - a - c)).
    """
    before, top, after = samples[peak - 1], samples[peak], samples[peak + 1]
    curvature = 2.0 * top - before - after
    # Three equal samples have no vertex; the offset is then zero, without a division by zero.
    return 0.5 * (after - before) / jnp.where(curvature > 0, curvature, 1.0)
