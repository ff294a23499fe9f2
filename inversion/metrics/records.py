r"""Records and pulses in the form that compiled programs take: one sampling, a few sizes, many shots.

**Size buckets.** XLA compiles a program for one shape. Records are padded with zeros to the next size of 64,
96, 128, 192, 256, 384, ... samples, so that records of all lengths up to a size share a program. The number
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
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from jaxlidar import AbstractPulse
from jaxlidar.extend import as_array, check_range, concrete, even_step

# Metres of height per ns of two-way travel at nadir: half the speed of light.
METRES_PER_NS = 0.149896229
# Width of the smoothing over that of the Gaussian of the pulse's peak and area.
_SMOOTHING = 0.83
# Median of the absolute value of a normal variable of unit variance.
NORMAL_MEDIAN = 0.6745
# Of a record without background, at least this fraction of the samples is quiet: within these standard
# deviations of the noise of zero, or this fraction of the largest sample.
_QUIET_FRACTION, _QUIET_SIGMAS, _QUIET_LEVEL = 0.05, 2.0, 0.01
# The ends of a pulse are cut where its samples stay below this fraction of its peak.
_FAINT = 1e-6
# Largest relative difference of steps for which records share the samples of a pulse.
_EQUAL_STEPS = 1e-6

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


# -- axes and records ----------------------------------------------------------------------------------


class EvenAxis(NamedTuple):
    """Times or heights in equal steps. Programs see the steps only: single precision rounds large values.

    - `first`: () or (shots,) the first value; in NumPy's double precision unless it is traced.
    - `step`: () or (shots,) the positive step; likewise.
    """

    first: Array | np.ndarray
    step: Array | np.ndarray

    def relative(self, x: ArrayLike, field: str) -> Array:
        """Difference of values from the first one, rounded after it is taken; NaN for missing values."""
        values, first = concrete(x), concrete(self.first)
        if values is None or first is None:
            return as_array(x, field) - as_array(self.first)
        return as_array(values - first)

    def absolute(self, x: Array) -> Array:
        """Inverse of `relative`, in the precision of `x`."""
        return jnp.asarray(self.first, x.dtype) + x


def even_axis(field: str, axis: ArrayLike, *, decreasing: bool = False) -> EvenAxis:
    """Check the axis of a record, (bins,) or (shots, bins), two bins or more.

    **Raises:** as `even_step`; the steps of an axis that JAX traces are not checked.
    """
    check_range(field, axis)
    values = concrete(axis)
    if values is None:
        traced = as_array(axis, field)
        extent = traced[..., -1] - traced[..., 0]
        return EvenAxis(traced[..., 0], (-extent if decreasing else extent) / (traced.shape[-1] - 1))
    return EvenAxis(values[..., 0], even_step(field, axis, decreasing=decreasing))


def divide_by_largest(
    x: ArrayLike, field: str, noise: ArrayLike | None = None
) -> tuple[Array, Array | np.ndarray]:
    """Divide each row of samples by its largest magnitude, before it is rounded to single precision.

    Squares of energies below 1e-19 J or above 1e19 J do not exist in single precision. Derivatives take the
    magnitude as constant: it cancels in results.

    **Arguments:** `x`: (..., bins) finite samples. `noise`: their standard deviation; samples of infinite
    noise become zero and do not count. Default: all count.

    **Returns:** (..., bins) samples, at most 1 in magnitude, and (...) the magnitudes, 1 for rows of zeros.

    **Raises:** ValueError for samples that are not finite.
    """
    check_range(field, x)
    values, sigma = concrete(x), concrete(0.0 if noise is None else noise)
    if values is None or sigma is None:
        samples = as_array(x, field)
        if noise is not None:
            is_used = jnp.broadcast_to(jnp.isfinite(as_array(noise)), samples.shape)
            samples = jnp.where(is_used, samples, 0.0)
        magnitude = lax.stop_gradient(jnp.max(jnp.abs(samples), axis=-1))
        magnitude = jnp.where(magnitude > 0, magnitude, 1.0)
        return samples / magnitude[..., None], magnitude
    values = np.where(np.isinf(sigma), 0.0, values)
    magnitude = np.max(np.abs(values), axis=-1)
    magnitude = np.where(magnitude > 0, magnitude, 1.0)
    return jnp.asarray((values / magnitude[..., None]).astype(_float_type(x))), magnitude


def divide(x: ArrayLike, divisor: Array | np.ndarray, field: str) -> Array:
    """Quotient of two numbers, taken in double precision where JAX traces neither."""
    values, divisor_values = concrete(x), concrete(divisor)
    if values is None or divisor_values is None:
        dividend, denominator = jnp.broadcast_arrays(as_array(x, field), as_array(divisor))
        return dividend / denominator
    quotient, dtype = values / divisor_values, _float_type(x)
    # A number that the type cannot hold is large, not infinite: infinite noise has another meaning.
    limit = float(jnp.finfo(dtype).max)
    return jnp.asarray(np.where(np.isinf(quotient), quotient, np.clip(quotient, -limit, limit)).astype(dtype))


def _float_type(x: ArrayLike) -> jnp.dtype:
    """Type of a floating-point JAX array, the default one of anything else."""
    if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.floating):
        return x.dtype
    return jnp.zeros(()).dtype


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
    return PaddedRecord(heights, pad_to(samples, size_bucket(bins)), jnp.asarray(bins), magnitude)


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
        # Of a record of signal throughout the deviation is no noise: a baseline may hide below it.
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


def sample_pulse(pulse: Pulse | None, step: ArrayLike) -> Float[Array, "... padded"]:
    """Sample a pulse as a record is sampled: peak one, time zero in the middle, padded to a size bucket.

    1. Evaluate an `AbstractPulse` over its support, or take the samples.
    2. Cut the faint ends, equally on both sides, so that time zero stays in the middle.
    3. Pad both sides to a size bucket, and divide by the peak.

    **Arguments:**

    - `pulse`: see `gaussian_decomposition`. None gives a single sample of one: no pulse at all.
    - `step`: () or (shots,) sampling interval in ns.

    **Returns:** (..., lags), an odd number of lags.

    **Raises:** ValueError for an even number of lags, for samples that are not finite or have no positive
    peak, and for an `AbstractPulse` where a JAX transformation traces `step`.
    """
    if pulse is None:
        return jnp.ones(1)
    if isinstance(pulse, AbstractPulse):
        steps = concrete(step)
        if steps is None:
            raise ValueError(
                "pulse is to be sampled at steps that a JAX transformation is tracing; admissible there are "
                "samples"
            )
        if np.ptp(steps) <= _EQUAL_STEPS * np.min(steps):
            steps = np.min(steps)
        half = max(1, math.ceil(max(map(abs, pulse.support())) / np.min(steps)))
        samples = pulse.power(np.arange(-half, half + 1) * steps[..., None])
    else:
        samples = divide_by_largest(pulse, "pulse")[0] if np.size(pulse) > 1 else as_array(pulse, "pulse")
        check_range("pulse", samples)
    if samples.ndim < 1 or samples.shape[-1] % 2 == 0:
        raise ValueError(
            f"pulse has the shape {samples.shape}; admissible is (lags,) with an odd number of lags, the "
            "middle one at the pulse's time zero: pad one end with zeros, or give its times as well, as "
            "jaxlidar.SampledPulse(time=, power=)"
        )
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
    width = _SMOOTHING * jnp.sum(pulse) / math.sqrt(2.0 * math.pi)
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
