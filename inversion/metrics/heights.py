r"""Where a record's signal begins and ends, its relative heights, and its ground, without a model of the
scene.

All functions take one record, (bins,), or several of one length, (shots, bins), heights decreasing. Records
are padded to a ladder of sizes (64, 96, 128, 192, ... bins): each size is compiled once.

With a `pulse`, records are smoothed first, by the Gaussian of the pulse's peak and area: a matched filter for
a Gaussian pulse, and one without side lobes for any other. What the smoothing makes of the pulse itself says
where the echo's mode lies from its time zero, and what tail comes after it. Thresholds count standard
deviations of the noise before smoothing, as GEDI's do: a background that drifts is smoothed by little. Where
no noise is given, it is the root mean square of the samples within three of it, from a start at the median of
those below zero: noise of any correlation, and what the background that was removed is wrong by. A record
without negative samples has none.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from inversion.metrics.pulses import METRES_PER_NS, Pulse, pulse_samples, response, steps_of, vertex
from inversion.metrics.records import ladder, over_shots, pad
from jaxlidar.extend import as_array, check_range

# Median of the absolute value of a normal variable of unit variance.
_MEDIAN = 0.6745
# Least mode, in standard deviations of the noise, and over the strongest of the record.
_MODE = 5.0
_FAINTEST = 0.01
# So many of the strongest modes may hide others in their tails.
_MODES = 32
# Tail of the receiver, which a transmitted pulse does not show: at most so much of an echo, over the pulse's
# length. (GEDI: 0.005 to 0.026 of the ground's echo, 70 to 135 ns after it.)
_RECEIVER = 0.03

Levels = Float[ArrayLike, " levels"] | Sequence[float]


class SignalEnds(NamedTuple):
    """Heights in m, (...,), between which a record holds signal; NaN where there is none.

    - `top`: of the highest return.
    - `bottom`: of the lowest.

    **Example:** relative heights between ends that are known.

    >>> import inversion, numpy as np
    >>> height = np.arange(20.0, -5.0, -0.5)
    >>> ends = inversion.SignalEnds(top=10.0, bottom=0.0)
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
    """Heights of the highest and of the lowest return: where the smoothed record first and last exceeds a
    threshold.

    Between samples, it is where a straight line crosses the threshold. The heights are differentiable in
    `power`.

    **Arguments:**

    - `height`: (bins,) m, decreasing in equal steps, as `Waveform.height`; or one row for each shot.
    - `power`: (bins,) record, background removed; or (shots, bins).
    - `noise`: standard deviation of a sample of `power`, one number or (shots,). Default: from the record's
      quiet samples.
    - `pulse`: what the record is smoothed by: a recorded pulse at the record's sampling, (lags,), an odd
      number of samples with time zero in the middle, or (shots, lags); or a `jaxlidar` pulse, for light that
      goes straight down. Default: not smoothed.
    - `threshold`: in standard deviations of `noise`, 0 or more. Default 6.

    **Returns:** a `SignalEnds`.

    **Raises:** ValueError for inadmissible arguments.

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
    check_range("threshold", threshold, 0.0)
    z, y, count = record(height, power)
    sigma = _noise(noise)
    return _signal_ends(z, y, count, _lags(pulse, height), sigma, as_array(threshold))


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
    """Relative heights (RH metrics): heights above ground below which given percentages of the energy return.

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
    if ends is None:
        ends = signal_ends(height, power, noise=noise, pulse=pulse, threshold=threshold)
    top, bottom = (as_array(end) for end in ends)
    z, y, count = record(height, power)
    return _relative_heights(z, y, count, top, bottom, as_array(levels) / 100.0, as_array(ground))


def find_ground(
    height: Float[ArrayLike, "... bins"],
    power: Float[ArrayLike, "... bins"],
    *,
    pulse: Pulse | None = None,
    noise: Float[ArrayLike, "..."] | None = None,
    threshold: Float[ArrayLike, "..."] | None = None,
) -> Float[Array, "..."]:
    """Height of the ground, taken as the lowest mode that no other echo explains.

    Modes are local maxima of the record, smoothed by the pulse. A mode counts where it exceeds the threshold
    and, with a pulse, a hundredth of the strongest mode, both beyond what the tail of any mode above it can
    put there: the envelope of what smoothing makes of the pulse, and 3 % over the pulse's length for the tail
    of a receiver. So ripples of a tail are no ground. Between samples, the height is the vertex of the
    parabola through the maximum and its two neighbours.

    **Arguments:**

    - `height`, `power`, `pulse`, `noise`: as for `signal_ends`. With `pulse`, the height is that of its time
      zero.
    - `threshold`: least height of a mode, in units of `power`; of the smoothed record, if `pulse` is given.
      Default: five standard deviations of `noise`.

    **Returns:** the height in m, () or (shots,); NaN where there is no such mode.

    **Raises:** ValueError for inadmissible arguments.

    **Example:**

    >>> import inversion, numpy as np
    >>> height = np.arange(20.0, -5.0, -0.25)
    >>> power = 0.5 * np.exp(-0.5 * ((height - 12.0) / 2.0) ** 2) + np.exp(-0.5 * ((height - 1.6) / 0.5) ** 2)
    >>> print(f"{float(inversion.find_ground(height, power)):.1f} m")
    1.6 m
    """
    z, y, count = record(height, power)
    sigma = _noise(noise)
    if threshold is not None:
        check_range("threshold", threshold)
    least = jnp.full((), jnp.nan, y.dtype) if threshold is None else as_array(threshold)
    return _find_ground(z, y, count, _lags(pulse, height), sigma, least)


def record(height: ArrayLike, power: ArrayLike) -> tuple[Array, Array, Array]:
    """Heights and samples, padded to the ladder, and the number of samples."""
    z, y = as_array(height, "height"), as_array(power, "power")
    if y.ndim < 1 or z.ndim < 1 or z.shape[-1] != y.shape[-1] or y.shape[-1] < 3:
        raise ValueError(
            f"height and power have the shapes {z.shape} and {y.shape}; admissible is (..., bins) for both, "
            "three or more"
        )
    check_range("height", height)
    check_range("power", power)
    check_range("steps of height", -jnp.diff(z), 0.0, low_open=True)
    size = ladder(y.shape[-1])
    return pad(z, size), pad(y, size), jnp.asarray(y.shape[-1])


def _noise(noise: ArrayLike | None) -> Array:
    """The noise; NaN stands for one to be found."""
    if noise is None:
        return jnp.full((), jnp.nan)
    check_range("noise", noise, 0.0)
    return as_array(noise)


def _lags(pulse: Pulse | None, height: ArrayLike) -> Array:
    return pulse_samples(pulse, steps_of(height, METRES_PER_NS))


def _smoothed(y: Array, kernel: Array) -> Array:
    if kernel.size == 1:
        return y
    size, half = ladder(y.size + kernel.size), kernel.size // 2
    return jnp.fft.irfft(jnp.fft.rfft(y, size) * jnp.fft.rfft(kernel, size), size)[half : half + y.size]


def _spread(y: Array, sigma: Array, real: Array) -> Array:
    """The noise given, or found from what lies below zero."""
    below = jnp.nanmedian(jnp.where(real & (y < 0), -y, jnp.nan)) / _MEDIAN

    def again(found: Array, _: None) -> tuple[Array, None]:
        quiet = real & (jnp.abs(y) <= 3.0 * found)
        square = jnp.sum(jnp.where(quiet, y * y, 0.0)) / jnp.maximum(jnp.sum(quiet), 1)
        return jnp.sqrt(jnp.where(square > 0, square, 0.0)), None

    found, _ = lax.scan(again, jnp.where(jnp.isnan(below), 0.0, below), None, length=5)
    return jnp.where(jnp.isnan(sigma), lax.stop_gradient(found), sigma)


@over_shots(1, 1, 0, 1, 0, 0)
def _ends(z, y, count, pulse, sigma, threshold):
    number = jnp.arange(y.size)
    real = number < count
    smooth = _smoothed(y, response(pulse).kernel)
    level = threshold * _spread(y, sigma, real)
    above = real & (smooth > level)
    first, last = jnp.argmax(above), y.size - 1 - jnp.argmax(above[::-1])

    def crossing(inside, outside):
        rise = smooth[inside] - smooth[outside]
        share = jnp.where(rise > 0, (smooth[inside] - level) / jnp.where(rise > 0, rise, 1.0), 0.0)
        return z[inside] + jnp.clip(share, 0.0, 1.0) * (z[outside] - z[inside])

    some = jnp.any(above)
    top = crossing(first, jnp.maximum(first - 1, 0))
    bottom = crossing(last, jnp.minimum(last + 1, count - 1))
    return jnp.where(some, top, jnp.nan), jnp.where(some, bottom, jnp.nan)


def _signal_ends(*arguments: Array) -> SignalEnds:
    return SignalEnds(*_ends(*arguments))


@over_shots(1, 1, 0, 0, 0, 1, 0)
def _relative_heights(z, y, count, top, bottom, shares, ground):
    # From below; what is not of the record comes first, and weighs nothing.
    z, y, real = z[::-1], y[::-1], jnp.arange(y.size)[::-1] < count
    step = jnp.abs(z[-1] - z[-2])
    half = 0.5 * step
    upper, lower = jnp.minimum(z + half, top), jnp.maximum(z - half, bottom)
    within = jnp.where(real, jnp.maximum(upper - lower, 0.0) / step, 0.0)
    # At the edges of samples. Noise must not make the energy fall.
    energy = lax.cummax(jnp.concatenate([jnp.zeros(1, y.dtype), jnp.cumsum(y * within)]))
    edges = jnp.clip(jnp.concatenate([z[:1] - half, z + half]), bottom, top)
    edges = jnp.where(jnp.concatenate([real[:1], real]), edges, bottom)
    share = energy / jnp.maximum(energy[-1], jnp.finfo(y.dtype).tiny)
    heights = jnp.interp(shares, share, edges)
    # Where the energy stands still, none and all of it are at the ends.
    heights = jnp.where(shares <= 0, bottom, jnp.where(shares >= 1, top, heights))
    return jnp.where(energy[-1] > 0, heights, jnp.nan) - ground


@over_shots(1, 1, 0, 1, 0, 0)
def _find_ground(z, y, count, pulse, sigma, threshold):
    number = jnp.arange(y.size)
    real = number < count
    echo = response(pulse)
    smooth = jnp.where(real, _smoothed(y, echo.kernel), 0.0)
    least = jnp.where(jnp.isnan(threshold), _MODE * _spread(y, sigma, real), threshold)
    least = jnp.maximum(least, _FAINTEST * jnp.max(smooth) * (pulse.size > 1))
    inner = smooth[1:-1]
    peak = (inner > smooth[:-2]) & (inner >= smooth[2:]) & (inner > least) & real[2:]
    if pulse.size > 1:
        tail = jnp.maximum(echo.tail[: pulse.size], _RECEIVER).at[0].set(0.0)
        strength, place = lax.top_k(jnp.where(peak, inner, 0.0), _MODES)
        away = number[: y.size - 2, None] - place[None, :]
        reach = jnp.where((away > 0) & (away < tail.size), tail[jnp.clip(away, 0, tail.size - 1)], 0.0)
        peak &= inner > least + jnp.max(reach * strength[None, :], axis=1)
    last = y.size - 2 - jnp.argmax(peak[::-1])
    found = z[last] - (z[0] - z[1]) * (vertex(smooth, last) - echo.mode)
    return jnp.where(jnp.any(peak), found, jnp.nan)
