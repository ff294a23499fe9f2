r"""Ends of a record's signal, relative heights and ground, without a model of the scene.

All functions take one record, (bins,), or several of one length, (shots, bins), heights decreasing. Records
are padded to size buckets (64, 96, 128, 192, ... bins): each size is compiled once.

**Smoothing.** With a `pulse`, records are smoothed first by a Gaussian somewhat narrower than that of the
pulse's peak and area (`records.py`).

**Noise.** Thresholds count standard deviations of the noise before smoothing, as GEDI's do: smoothing hardly
reduces a background that drifts. Where no noise is given, it is estimated by sigma clipping. The signal is
positive, so samples below zero are noise alone; for normal noise the median of their magnitude is 0.6745
sigma. From there, five times,

    sigma^2 = mean of y_i^2 over all samples with |y_i| <= 3 sigma.

The mean square counts noise of any correlation, and the error of the background that was removed. A record
without negative samples has no noise.

**Signal.** Its ends are where the smoothed record first and last exceeds `threshold` sigma (Hofton and Blair
2019).

**Ground.** The lowest mode of the smoothed record that is not an artefact of an echo above it. A mode of
value s_i at bin i counts where

    s_i > max(5 sigma, 0.01 max_j s_j) + max_k s_k T(i - k),

over the modes k above it, with s the smoothed record and T the tail of a smoothed echo (`SmoothedPulse`), or
3 % over the pulse's length if that is more: receivers have tails that the transmitted pulse does not show.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from inversion.metrics.records import (
    NORMAL_MEDIAN,
    PaddedRecord,
    check_background,
    pad_record,
    sample_pulse_at_heights,
    smooth_pulse,
    vertex_offset,
)
from jaxlidar.extend import as_array, check_range
from jaxlidar.survey.records import Pulse, over_shots, record_bucket

# Sigma clipping: largest noise in standard deviations, and number of iterations.
_CLIP, _CLIP_ITERATIONS = 3.0, 5
# Least height of a mode: in standard deviations of the noise, and over the largest sample.
_MODE_THRESHOLD = 5.0
_MODE_FRACTION = 0.01
# Number of strongest modes whose tails are compared with lower modes: `top_k` needs a fixed number.
_MODES = 32
# Largest tail of the receiver over the peak of an echo, within a pulse's length. (GEDI: 0.005 to 0.026 of the
# ground's echo, 70 to 135 ns after it.)
_RECEIVER_TAIL = 0.03

Levels = Float[ArrayLike, " levels"] | Sequence[float]


class SignalEnds(NamedTuple):
    """Heights in m, (...,), of the highest and the lowest return; NaN in records without signal.

    - `top`: of the highest return.
    - `bottom`: of the lowest.

    **Example:** relative heights between ends known from elsewhere.

    >>> import inversion, numpy as np
    >>> height = np.arange(20.0, -5.0, -0.5)
    >>> from inversion.metrics.heights import SignalEnds
    >>> ends = SignalEnds(top=10.0, bottom=0.0)
    >>> print(inversion.relative_heights(height, np.ones(height.size), levels=(50.0,), ends=ends))
    [5.]
    """

    top: Float[Array, "..."]
    bottom: Float[Array, "..."]


def signal_ends(
    height: Float[ArrayLike, "... bins"],
    power: Float[ArrayLike, "... bins"],
    *,
    noise: Float[ArrayLike, "..."] | None = None,
    pulse: Pulse | None = None,
    threshold: float = 6.0,
) -> SignalEnds:
    """Return the heights at which the smoothed record first and last exceeds a threshold.

    Between samples the record is taken as a straight line. The heights are differentiable in `power`.

    **Arguments:**

    - `height`: (bins,) m, decreasing in equal steps, as `Waveform.height`; or one row for each shot.
    - `power`: (bins,) record in any unit, background removed; or (shots, bins).
    - `noise`: standard deviation of a sample of `power`, one number or (shots,). Default: from the record's
      quiet samples.
    - `pulse`: gives the width of the smoothing: a recorded pulse at the record's sampling, (lags,), an odd
      number of samples with time zero in the middle, or (shots, lags); or a `jaxlidar` pulse, for light that
      goes straight down. Default: not smoothed.
    - `threshold`: in standard deviations of `noise`, 0 or more. Default 6.

    **Returns:** a `SignalEnds`.

    **Raises:** ValueError for inadmissible arguments, such as uneven steps of `height`, and for a `power`
    with a baseline, unless a JAX transformation traces them.

    **Source:** Hofton and Blair (2019), GEDI transmit and receive waveform processing (theoretical basis
    document).

    **Example:**

    >>> import inversion, numpy as np
    >>> height = np.arange(20.0, -5.0, -0.5)
    >>> power = np.where((height >= 1.0) & (height <= 15.0), 1.0, 0.0)
    >>> top, bottom = inversion.signal_ends(height, power, noise=0.1)
    >>> print(f"{float(top):.1f} m to {float(bottom):.1f} m")
    15.2 m to 0.8 m
    """
    record = pad_record(height, power)
    ends = relative_signal_ends(record, noise=noise, pulse=pulse, threshold=threshold)
    return SignalEnds(*(record.heights.absolute(end) for end in ends))


def relative_signal_ends(
    record: PaddedRecord,
    *,
    noise: ArrayLike | None,
    pulse: Pulse | None,
    threshold: float = 6.0,
) -> SignalEnds:
    """Return the ends of the signal, as `signal_ends`, relative to the height of the first sample."""
    check_range("threshold", threshold, 0.0)
    sigma = _optional_noise(record, noise)
    check_background(record, None if noise is None else sigma)
    top, bottom = _signal_ends(
        **record.arguments(),
        noise=sigma,
        pulse=sample_pulse_at_heights(pulse, record.heights),
        threshold=as_array(threshold, "threshold"),
    )
    return SignalEnds(top, bottom)


def relative_heights(
    height: Float[ArrayLike, "... bins"],
    power: Float[ArrayLike, "... bins"],
    *,
    ground: Float[ArrayLike, "..."] = 0.0,
    levels: Levels = (25.0, 50.0, 75.0, 95.0, 98.0, 100.0),
    ends: SignalEnds | tuple[ArrayLike, ArrayLike] | None = None,
    noise: Float[ArrayLike, "..."] | None = None,
    pulse: Pulse | None = None,
    threshold: float = 6.0,
) -> Float[Array, "... levels"]:
    """Return relative heights (RH metrics): heights above ground below which percentages of the energy lie.

    Only energy between the ends of the signal counts: over a long record the noise would weigh as much as a
    canopy. Differentiable in `power`.

    **Arguments:**

    - `height`, `power`: as for `signal_ends`.
    - `ground`: height of the ground in m, one number or (shots,). Default 0.
    - `levels`: (levels,) percentages, 0 to 100. Default (25, 50, 75, 95, 98, 100).
    - `ends`: heights of the top and the bottom of the signal in m. Default: those of `signal_ends`, with
      `noise`, `pulse` and `threshold`.

    **Returns:** (levels,) or (shots, levels) heights in m; NaN where there is no signal.

    **Raises:** ValueError for `levels` outside 0 to 100, and as `signal_ends`.

    **Source:** Dubayah et al. (2020), Sci. Remote Sens. 1, 100002.

    **Example:**

    >>> import inversion, numpy as np
    >>> height = np.arange(20.0, -5.0, -0.5)
    >>> power = np.where((height >= 1.0) & (height <= 15.0), 1.0, 0.0)
    >>> rh50, rh75 = inversion.relative_heights(height, power, ground=1.0, levels=(50.0, 75.0))
    >>> print(f"{float(rh50):.1f} m, {float(rh75):.1f} m")
    7.0 m, 10.6 m
    """
    check_range("levels", levels, 0.0, 100.0)
    record = pad_record(height, power)
    if ends is None:
        top, bottom = relative_signal_ends(record, noise=noise, pulse=pulse, threshold=threshold)
    else:
        top, bottom = (record.heights.relative(end, "ends") for end in ends)
    return _relative_heights(
        **record.arguments(),
        top=top,
        bottom=bottom,
        fractions=as_array(levels, "levels") / 100.0,
        ground=record.heights.relative(ground, "ground"),
    )


def find_ground(
    height: Float[ArrayLike, "... bins"],
    power: Float[ArrayLike, "... bins"],
    *,
    pulse: Pulse | None = None,
    noise: Float[ArrayLike, "..."] | None = None,
    threshold: Float[ArrayLike, "..."] | None = None,
) -> Float[Array, "..."]:
    """Return the height of the ground: the lowest mode that no echo above it explains.

    Modes are local maxima of the smoothed record. A mode counts where it exceeds the threshold and, with a
    pulse, a hundredth of the largest sample. To both is added the most that the tail of a mode above it can
    put there: the envelope of the smoothed pulse, or 3 % over the pulse's length for the tail of a receiver.
    So ripples of a tail are not taken for ground. Between samples, the height is the vertex of the parabola
    through the maximum and its two neighbours.

    **Arguments:**

    - `height`, `power`, `pulse`, `noise`: as for `signal_ends`. With `pulse`, the height is that of its time
      zero.
    - `threshold`: least height of a mode, in units of `power`; of the smoothed record, if `pulse` is given.
      Default: five standard deviations of `noise`.

    **Returns:** the height in m, () or (shots,); NaN where there is no such mode.

    **Raises:** as `signal_ends`.

    **Example:**

    >>> import inversion, numpy as np
    >>> height = np.arange(20.0, -5.0, -0.25)
    >>> power = 0.5 * np.exp(-0.5 * ((height - 12.0) / 2.0) ** 2) + np.exp(-0.5 * ((height - 1.6) / 0.5) ** 2)
    >>> print(f"{float(inversion.find_ground(height, power)):.1f} m")
    1.6 m
    """
    record = pad_record(height, power)
    ground = relative_ground(record, pulse=pulse, noise=noise, threshold=threshold)
    return record.heights.absolute(ground)


def relative_ground(
    record: PaddedRecord,
    *,
    pulse: Pulse | None,
    noise: ArrayLike | None,
    threshold: ArrayLike | None = None,
) -> Array:
    """Return the height of the ground, as `find_ground`, relative to that of the first sample."""
    sigma = _optional_noise(record, noise)
    # NaN asks the compiled program for the default, so that both cases share it.
    least = jnp.full((), jnp.nan, record.power.dtype)
    if threshold is not None:
        check_range("threshold", threshold)
        least = record.over_magnitude(threshold, "threshold")
    check_background(record, None if noise is None else sigma, None if threshold is None else least)
    lags = sample_pulse_at_heights(pulse, record.heights)
    return _find_ground(**record.arguments(), noise=sigma, pulse=lags, threshold=least)


def _optional_noise(record: PaddedRecord, noise: ArrayLike | None) -> Array:
    """Return the noise in the unit of the padded record, or NaN, which asks programs to estimate it."""
    if noise is None:
        return jnp.full((), jnp.nan)
    check_range("noise", noise, 0.0)
    return record.over_magnitude(noise, "noise")


def _smooth(y: Array, kernel: Array) -> Array:
    """Convolve a record with a kernel of an odd number of lags, zero in the middle, by Fourier transforms."""
    if kernel.size == 1:
        return y
    # Long enough that the convolution does not wrap around.
    size, half = record_bucket(y.size + kernel.size), kernel.size // 2
    return jnp.fft.irfft(jnp.fft.rfft(y, size) * jnp.fft.rfft(kernel, size), size)[half : half + y.size]


def _noise_level(y: Array, noise: Array, is_recorded: Array) -> Array:
    """Return the standard deviation of the noise: as given or, where it is NaN, by sigma clipping."""
    start = jnp.nanmedian(jnp.where(is_recorded & (y < 0), -y, jnp.nan)) / NORMAL_MEDIAN

    def clip(sigma: Array, _: None) -> tuple[Array, None]:
        is_quiet = is_recorded & (jnp.abs(y) <= _CLIP * sigma)
        variance = jnp.sum(jnp.where(is_quiet, y * y, 0.0)) / jnp.maximum(jnp.sum(is_quiet, dtype=y.dtype), 1)
        return jnp.sqrt(jnp.where(variance > 0, variance, 0.0)), None

    start = jnp.where(jnp.isnan(start), 0.0, start)
    estimate, _ = lax.scan(clip, start, None, length=_CLIP_ITERATIONS)
    # Derivatives are taken at a fixed threshold: that of the estimate jumps with every sample clipped.
    return jnp.where(jnp.isnan(noise), lax.stop_gradient(estimate), noise)


@over_shots(step=0, power=1, n_samples=0, pulse=1, noise=0, threshold=0)
def _signal_ends(step, power, n_samples, pulse, noise, threshold):
    """Heights of the first and last crossing of the threshold in one padded record, over its first sample.

    1. Smooth; find the first and the last sample above the level.
    2. Interpolate between that sample and the one outside of it.
    """
    height = -step * jnp.arange(power.size, dtype=power.dtype)
    is_recorded = jnp.arange(power.size) < n_samples
    smooth = _smooth(power, smooth_pulse(pulse).kernel)
    level = threshold * _noise_level(power, noise, is_recorded)
    is_above = is_recorded & (smooth > level)
    first, last = jnp.argmax(is_above), power.size - 1 - jnp.argmax(is_above[::-1])

    def crossing(inside, outside):
        rise = smooth[inside] - smooth[outside]
        fraction = jnp.where(rise > 0, (smooth[inside] - level) / jnp.where(rise > 0, rise, 1.0), 0.0)
        return height[inside] + jnp.clip(fraction, 0.0, 1.0) * (height[outside] - height[inside])

    has_signal = jnp.any(is_above)
    top = crossing(first, jnp.maximum(first - 1, 0))
    bottom = crossing(last, jnp.minimum(last + 1, n_samples - 1))
    return jnp.where(has_signal, top, jnp.nan), jnp.where(has_signal, bottom, jnp.nan)


@over_shots(step=0, power=1, n_samples=0, top=0, bottom=0, fractions=1, ground=0)
def _relative_heights(step, power, n_samples, top, bottom, fractions, ground):
    """Heights above the ground below which fractions of the energy lie, of one padded record.

    Ends and ground count from the first sample.

    1. Turn the record over, from below; its padding then comes first and has no weight.
    2. Weight each sample by the fraction of its bin that lies between the ends of the signal.
    3. Cumulate to the edges of bins, and invert by linear interpolation.
    """
    number = jnp.arange(power.size)[::-1]
    z, y, is_recorded = -step * number.astype(power.dtype), power[::-1], number < n_samples
    half = 0.5 * step
    bin_top, bin_bottom = jnp.minimum(z + half, top), jnp.maximum(z - half, bottom)
    overlap = jnp.where(is_recorded, jnp.maximum(bin_top - bin_bottom, 0.0) / step, 0.0)
    # Interpolation needs energies that do not fall, as they do where noise makes samples negative.
    energy = lax.cummax(jnp.concatenate([jnp.zeros(1, y.dtype), jnp.cumsum(y * overlap)]))
    edges = jnp.clip(jnp.concatenate([z[:1] - half, z + half]), bottom, top)
    edges = jnp.where(jnp.concatenate([is_recorded[:1], is_recorded]), edges, bottom)
    cumulative = energy / jnp.maximum(energy[-1], jnp.finfo(y.dtype).tiny)
    heights = jnp.interp(fractions, cumulative, edges)
    # Where the energy does not rise, interpolation could answer with any height of the plateau.
    heights = jnp.where(fractions <= 0, bottom, jnp.where(fractions >= 1, top, heights))
    return jnp.where(energy[-1] > 0, heights, jnp.nan) - ground


@over_shots(step=0, power=1, n_samples=0, pulse=1, noise=0, threshold=0)
def _find_ground(step, power, n_samples, pulse, noise, threshold):
    """Height of the lowest mode that no tail explains, in one padded record, over its first sample.

    1. Smooth, and set the least height of a mode from threshold, noise and largest sample.
    2. Find the modes: local maxima above it.
    3. Drop those that the tail of one of the strongest modes above them can reach.
    4. Interpolate the lowest mode that remains, and go back from the mode of a smoothed echo to the pulse's
       time zero.
    """
    number = jnp.arange(power.size, dtype=jnp.int32)
    is_recorded = number < n_samples
    echo = smooth_pulse(pulse)
    smooth = jnp.where(is_recorded, _smooth(power, echo.kernel), 0.0)
    sigma = _noise_level(power, noise, is_recorded)
    least = jnp.where(jnp.isnan(threshold), _MODE_THRESHOLD * sigma, threshold)
    least = jnp.maximum(least, _MODE_FRACTION * jnp.max(smooth) if pulse.size > 1 else 0.0)
    inner = smooth[1:-1]
    # A plateau of two equal samples is one mode: it exceeds the sample before, not the one after.
    is_mode = (inner > smooth[:-2]) & (inner >= smooth[2:]) & (inner > least) & is_recorded[2:]
    if pulse.size > 1:
        # A mode does not hide itself: the tail is zero at no distance.
        tail = jnp.maximum(echo.tail[: pulse.size], _RECEIVER_TAIL).at[0].set(0.0)
        strength, position = lax.top_k(jnp.where(is_mode, inner, 0.0), _MODES)
        distance = number[: power.size - 2, None] - position[None, :]
        tail_here = tail[jnp.clip(distance, 0, tail.size - 1)]
        tail_here = jnp.where((distance > 0) & (distance < tail.size), tail_here, 0.0)
        is_mode &= inner > least + jnp.max(tail_here * strength[None, :], axis=1)
    lowest = power.size - 2 - jnp.argmax(is_mode[::-1])
    ground = -step * (lowest.astype(power.dtype) + vertex_offset(smooth, lowest) - echo.mode)
    return jnp.where(jnp.any(is_mode), ground, jnp.nan)
