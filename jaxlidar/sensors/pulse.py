"""Transmitted pulses: shapes of unit area whose integrals, blurred by timing jitter, are closed forms.

A digitiser records energy per bin, so a simulation needs the running integral of the pulse,

    F(t) = integral from -inf to t of (p * g_j)(u) du,

where p is the pulse and g_j a Gaussian of standard deviation j (the timing jitter). The energy of an echo in
a bin is a difference of two values of F. With Phi the normal distribution function, phi its density and
s^2 = sigma^2 + j^2:

- Gaussian of standard deviation sigma: F = Phi(t/s).
- Linear segment of length L, mean power m and half rise d, centred on zero (a rectangle has d = 0, a sampled
  pulse is a sum of segments): F = L (m E + d O) with

      E = 1/2 integral over x in [-1, 1] of Phi((t - x L/2)/j),   O the same with x in the integrand.

  E and O are written as the integrals without jitter plus terms that decay away from the ends of the segment,
  so that no large terms cancel there. Where L <= 2 j these decaying terms do cancel, and Gauss-Legendre
  quadrature with 10 nodes is used, which is exact to rounding.
- Exponentially modified Gaussian with the mean life tau (Grushka 1972, Anal. Chem. 44, 1733):
  F = Phi(z) - phi(z) M(s/tau - z), with z = t/s measured from the Gaussian's centre and the Mills ratio
  M(x) = (1 - Phi(x))/phi(x). For large x, M is Laplace's continued fraction, which does not overflow, and
  tau = 0 gives the Gaussian.

Every formula and its derivatives stay finite at zero width and zero jitter, where F is a unit step of value
1/2 at the step.
"""

import abc
import math
from collections.abc import Sequence
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erfc
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._fields.checks import as_array, as_scalar, check_range, concrete
from jaxlidar._fields.ranges import NANOSECONDS, NOT_NEGATIVE, Range, check_ranges, quantity

_FWHM_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))
# Extents of `support` in standard deviations and in mean lives. A normal variable lies outside +-5.5 sigma
# with probability 3.8e-8, an exponential one beyond 16.8 mean lives with 5.1e-8: together below the 1e-7 that
# `support` promises.
_GAUSSIAN_EXTENT = 5.5
_EXPONENTIAL_EXTENT = 16.8
# Widths below this (ns) count as zero. It is a millionth of the period of light, and its inverse cube, which
# second derivatives contain, still fits into float32.
_NEGLIGIBLE_WIDTH = 1e-12
# Phi and phi are 1 or 0 to the last bit beyond; clipping there keeps inf * 0 out of the derivatives.
_Z_MAX = 40.0
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)


class AbstractPulse(eqx.Module):
    """The shape of a transmitted pulse: power against time in ns, normalised to unit area.

    A pulse of your own is one class in one file: derive it from this class, define `cumulative`, `mean`,
    `std`, `finest` and `support`, and pass it as `pulse=` of a `Lidar`. `power` follows from `cumulative`.
    Methods are pure, written with `jax.numpy` (see `jaxlidar.extend`), and differentiable in time, jitter and
    every field. Subclasses are final.

    **Example:** the fraction of a pulse's energy that falls into one sample of 1 ns.

    >>> import jaxlidar as jl
    >>> pulse = jl.GaussianPulse(fwhm=6.0)
    >>> print(f"{pulse.cumulative(0.5) - pulse.cumulative(-0.5):.4f}")
    0.1556
    """

    @abc.abstractmethod
    def cumulative(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        """Fraction of the pulse's energy that has passed by time `t`.

        **Arguments:**

        - `t`: times in ns, any shape.
        - `jitter`: standard deviation of the timing error in ns, not negative, one number. The pulse is
          convolved with a Gaussian of this width. Default 0.

        **Returns:** an array shaped as `t`, rising from 0 to 1.
        """

    @property
    @abc.abstractmethod
    def mean(self) -> Float[Array, ""]:
        """Centroid of the pulse in ns."""

    @property
    @abc.abstractmethod
    def std(self) -> Float[Array, ""]:
        """Standard deviation of the pulse in ns, without jitter."""

    @property
    @abc.abstractmethod
    def finest(self) -> Float[Array, ""]:
        """Scale in ns of the finest feature of the pulse; zero where the power jumps.

        For a Gaussian it is the standard deviation. The width of the fine time bins, into which returns are
        accumulated before the pulse is applied, is a fraction of it.
        """

    @abc.abstractmethod
    def support(self, jitter: ArrayLike = 0.0) -> tuple[float, float]:
        """Times (low, high) in ns outside of which less than 1e-7 of the energy lies, to size time windows.

        **Arguments:**

        - `jitter`: standard deviation of the timing error in ns. Default 0.

        **Returns:** two Python numbers.

        **Raises:** JAX's `ConcretizationTypeError` inside a JAX transformation: the parameters must be
        concrete.
        """

    def power(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        """Power of the pulse per unit of energy in 1/ns: the derivative of `cumulative`.

        **Arguments:**

        - `t`: times in ns, any shape.
        - `jitter`: standard deviation of the timing error in ns. Default 0.

        **Returns:** an array shaped as `t`. Where the power jumps, it is half the jump. A pulse of zero width
        has no finite power: its step counts as flat, and the result is zero everywhere.
        """
        t = as_array(t, "t")
        return jax.jvp(lambda u: self.cumulative(u, jitter), (t,), (jnp.ones_like(t),))[1]


@final
class GaussianPulse(AbstractPulse):
    """A Gaussian pulse, centred on time zero.

    **Arguments:**

    - `fwhm`: full width at half maximum in ns, not negative; zero is an instantaneous pulse. Default 6 (Table
      1 of the paper).

    **Raises:** ValueError for a negative or non-finite width.

    **Example:** at half the width the power is half the maximum.

    >>> import jaxlidar as jl
    >>> pulse = jl.GaussianPulse(fwhm=4.0)
    >>> print(f"{pulse.power(2.0) / pulse.power(0.0):.3f}")
    0.500
    """

    fwhm: Float[Array, ""] = quantity(unit=NANOSECONDS, range=NOT_NEGATIVE, converter=as_scalar, default=6.0)

    def __check_init__(self):
        check_ranges(self)

    def cumulative(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        return _normal_cdf(_z_score(as_array(t, "t"), _safe_hypot(self.std, as_scalar(jitter, "jitter"))))

    @property
    def mean(self) -> Float[Array, ""]:
        return jnp.zeros_like(self.fwhm)

    @property
    def std(self) -> Float[Array, ""]:
        return self.fwhm / _FWHM_PER_SIGMA

    @property
    def finest(self) -> Float[Array, ""]:
        return self.std

    def support(self, jitter: ArrayLike = 0.0) -> tuple[float, float]:
        extent = _GAUSSIAN_EXTENT * math.hypot(float(self.std), float(as_scalar(jitter, "jitter")))
        return -extent, extent


@final
class RectangularPulse(AbstractPulse):
    """A pulse of constant power, centred on time zero.

    **Arguments:**

    - `length`: duration in ns, not negative; zero is an instantaneous pulse. Default 6 (Table 1 of the
      paper).

    **Raises:** ValueError for a negative or non-finite length.

    **Example:**

    >>> import jaxlidar as jl
    >>> pulse = jl.RectangularPulse(length=6.0)
    >>> print(f"{pulse.std:.3f} ns, {pulse.cumulative(1.5):.2f} of the energy by 1.5 ns")
    1.732 ns, 0.75 of the energy by 1.5 ns
    """

    length: Float[Array, ""] = quantity(
        unit=NANOSECONDS, range=NOT_NEGATIVE, converter=as_scalar, default=6.0
    )

    def __check_init__(self):
        check_ranges(self)

    def cumulative(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        return _segment_integrals(as_array(t, "t"), self.length, jnp.abs(as_scalar(jitter, "jitter")))[0]

    @property
    def mean(self) -> Float[Array, ""]:
        return jnp.zeros_like(self.length)

    @property
    def std(self) -> Float[Array, ""]:
        return self.length / math.sqrt(12)

    @property
    def finest(self) -> Float[Array, ""]:
        return jnp.zeros_like(self.length)

    def support(self, jitter: ArrayLike = 0.0) -> tuple[float, float]:
        extent = 0.5 * float(self.length) + _GAUSSIAN_EXTENT * float(as_scalar(jitter, "jitter"))
        return -extent, extent


@final
class ExponentiallyModifiedGaussianPulse(AbstractPulse):
    """A Gaussian convolved with a decaying exponential: a pulse with a sharp rise and a long tail.

    Time zero is the centroid; the Gaussian's centre lies `decay` before it.

    **Arguments:**

    - `fwhm`: full width at half maximum of the Gaussian in ns, not negative.
    - `decay`: mean life of the exponential in ns, not negative; zero gives the Gaussian pulse.

    **Raises:** ValueError for a negative or non-finite width or decay.

    **Source:** Grushka (1972), Anal. Chem. 44, 1733.

    **Example:** more than half of the energy precedes the centroid, because of the long tail.

    >>> import jaxlidar as jl
    >>> pulse = jl.ExponentiallyModifiedGaussianPulse(fwhm=3.0, decay=2.0)
    >>> print(f"{pulse.cumulative(0.0):.3f} of the energy, standard deviation {pulse.std:.3f} ns")
    0.570 of the energy, standard deviation 2.371 ns
    """

    fwhm: Float[Array, ""] = quantity(unit=NANOSECONDS, range=NOT_NEGATIVE, converter=as_scalar)
    decay: Float[Array, ""] = quantity(unit=NANOSECONDS, range=NOT_NEGATIVE, converter=as_scalar)

    def __check_init__(self):
        check_ranges(self)

    def cumulative(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        sigma = _safe_hypot(self.fwhm / _FWHM_PER_SIGMA, as_scalar(jitter, "jitter"))
        from_centre = as_array(t, "t") + self.decay
        return _normal_cdf(_z_score(from_centre, sigma)) - _exponential_tail(from_centre, sigma, self.decay)

    @property
    def mean(self) -> Float[Array, ""]:
        return jnp.zeros_like(self.fwhm)

    @property
    def std(self) -> Float[Array, ""]:
        return _safe_hypot(self.fwhm / _FWHM_PER_SIGMA, self.decay)

    @property
    def finest(self) -> Float[Array, ""]:
        return self.fwhm / _FWHM_PER_SIGMA

    def support(self, jitter: ArrayLike = 0.0) -> tuple[float, float]:
        decay = float(self.decay)
        extent = _GAUSSIAN_EXTENT * math.hypot(float(self.std), float(as_scalar(jitter, "jitter")))
        return -decay - extent, -decay + extent + _EXPONENTIAL_EXTENT * decay


@final
class SampledPulse(AbstractPulse):
    """A recorded transmit waveform: linear between its samples, zero outside, scaled to unit area.

    Time zero is that of the given time axis. Subtract the centroid (`mean`) from `time` to place echoes where
    those of a symmetric pulse lie. Subtract the baseline of a record before.

    **Arguments:**

    - `time`: (samples,) in ns, strictly increasing, at least two.
    - `power`: (samples,) in any unit, not negative, not all zero. Stored as `samples`, since `power` is a
      method.

    **Raises:** ValueError for times that do not increase strictly, are too few or are not finite, for shapes
    that differ, and for power that is negative, non-finite or zero throughout.

    **Example:** a triangular pulse, moved so that its centroid lies at time zero.

    >>> import jaxlidar as jl
    >>> import numpy as np
    >>> time, power = np.array([0.0, 2.0, 8.0]), np.array([0.0, 5.0, 0.0])
    >>> centroid = jl.SampledPulse(time, power).mean
    >>> pulse = jl.SampledPulse(time - centroid, power)
    >>> print(f"centroid {centroid:.3f} ns, standard deviation {pulse.std:.3f} ns")
    centroid 3.333 ns, standard deviation 1.700 ns
    """

    time: Float[Array, " samples"] = quantity(unit="ns", range=Range(increasing=True))
    samples: Float[Array, " samples"] = quantity(range=NOT_NEGATIVE)

    def __init__(self, time: ArrayLike | Sequence[ArrayLike], power: ArrayLike | Sequence[ArrayLike]):
        self.time = as_array(time, "time")
        # Not under its own name: `power` is a method of all pulses.
        self.samples = as_array(power, "power")

    def __check_init__(self):
        time, power = concrete(self.time), concrete(self.samples)
        if self.time.shape != self.samples.shape or self.time.ndim != 1 or self.time.size < 2:
            raise ValueError(
                f"time and power have shapes {self.time.shape} and {self.samples.shape}; the admissible ones "
                "are equal, one-dimensional, of two samples or more"
            )
        # Before check_ranges, which would call the samples by the name of the field, not of the argument.
        check_range("power", self.samples, 0.0)
        check_ranges(self)
        if time is not None and np.any(np.diff(time) <= 0):
            i = int(np.argmax(np.diff(time) <= 0))
            raise ValueError(
                f"time = {time[i]:g} is followed by {time[i + 1]:g}; the admissible times increase strictly"
            )
        if power is not None and not np.any(power > 0):
            raise ValueError("power = 0 throughout; the admissible range of its largest sample is (0, inf)")

    def _segments(self) -> tuple[Array, Array, Array, Array]:
        """Centre, length, mean power and half rise of each linear segment, scaled to unit area."""
        return _linear_segments(self.time, self.samples)

    def cumulative(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        centre, length, mean, rise = self._segments()
        sigma = jnp.abs(as_scalar(jitter, "jitter"))

        def at(time):
            even, odd = _segment_integrals(time - centre, length, sigma)
            return jnp.sum(length * (mean * even + rise * odd))

        t = as_array(t, "t")
        return jax.vmap(at)(t.reshape(-1)).reshape(t.shape)

    @property
    def mean(self) -> Float[Array, ""]:
        centre, length, mean, rise = self._segments()
        return jnp.sum(length * (mean * centre + rise * length / 6))

    @property
    def std(self) -> Float[Array, ""]:
        centre, length, mean, rise = self._segments()
        centre = centre - self.mean
        return jnp.sqrt(jnp.sum(length * (mean * (centre**2 + length**2 / 12) + rise * centre * length / 3)))

    @property
    def finest(self) -> Float[Array, ""]:
        """Scale in ns of the finest feature: the largest power over the sharpest change of its slope.

        Never more than the standard deviation; zero where the record begins or ends with more than a
        hundredth of the largest power.
        """
        slope = jnp.diff(self.samples) / jnp.diff(self.time)
        bend = jnp.max(jnp.abs(jnp.diff(slope, prepend=0.0, append=0.0)))
        peak = jnp.max(self.samples)
        jumps = jnp.maximum(self.samples[0], self.samples[-1]) > 0.01 * peak
        return jnp.where(jumps, 0.0, jnp.minimum(peak / bend, self.std))

    def support(self, jitter: ArrayLike = 0.0) -> tuple[float, float]:
        time, nonzero = np.asarray(self.time, dtype=float), np.flatnonzero(np.asarray(self.samples))
        extent = _GAUSSIAN_EXTENT * float(as_scalar(jitter, "jitter"))
        first, last = max(nonzero[0] - 1, 0), min(nonzero[-1] + 1, time.size - 1)
        return float(time[first]) - extent, float(time[last]) + extent


# -- running integrals -------------------------------------------------------------------------------------


def _safe_hypot(a: Array, b: Array) -> Array:
    """Compute sqrt(a^2 + b^2) with a derivative that is finite at zero."""
    square = a * a + b * b
    positive = square > _NEGLIGIBLE_WIDTH**2
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


@jax.jit
def _z_score(t: Array, sigma: Array) -> Array:
    """Compute t / sigma, clipped to +-40; for a sigma of zero it is +-40 with the sign of t."""
    inside = (sigma > _NEGLIGIBLE_WIDTH) & (jnp.abs(t) < _Z_MAX * sigma)
    ratio = jnp.where(inside, t, 0.0) / jnp.where(inside, sigma, 1.0)
    return jnp.where(inside, ratio, _Z_MAX * jnp.sign(t))


def _normal_pdf(z: Array) -> Array:
    return jnp.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)


@jax.jit
def _normal_cdf(z: Array) -> Array:
    return 0.5 * erfc(-z / math.sqrt(2))


def _cdf_integrals(z: Array) -> tuple[Array, Array]:
    """Integrate Phi(z) once and twice, and subtract the same integrals of the unit step.

    The first is even and vanishes at infinity. The second is odd; its integration constant cancels in
    differences.
    """
    tail, density = _normal_cdf(-jnp.abs(z)), _normal_pdf(z)
    first_integral = density - jnp.abs(z) * tail
    second_integral = jnp.sign(z) * (0.25 - 0.5 * ((z * z + 1) * tail - jnp.abs(z) * density))
    return first_integral, second_integral


@jax.custom_jvp
def _wide_segment(t: Array, length: Array, sigma: Array) -> tuple[Array, Array]:
    """Evaluate `_segment_integrals` in closed form, for length > 2 sigma."""
    first_high, second_high = _cdf_integrals(_z_score(t + length / 2, sigma))
    first_low, second_low = _cdf_integrals(_z_score(t - length / 2, sigma))
    ratio = sigma / length
    # The integrals without jitter, in the position q within the segment.
    q = jnp.clip(2 * t / length, -1.0, 1.0)
    even = (1 + q) / 2 + ratio * (first_high - first_low)
    odd = (q * q - 1) / 4 - ratio * (first_high + first_low) + 2 * ratio**2 * (second_high - second_low)
    return even, odd


@_wide_segment.defjvp
def _wide_segment_jvp(primals, tangents):
    # Written out: the integrals without jitter and the decaying terms have kinks at the ends of the segment,
    # which automatic differentiation would take one by one, while they cancel in the sum.
    t, length, sigma = primals
    dt, dlength, dsigma = tangents
    even, odd = _wide_segment(t, length, sigma)
    high, low = _z_score(t + length / 2, sigma), _z_score(t - length / 2, sigma)
    rise, total = _normal_cdf(high) - _normal_cdf(low), _normal_cdf(high) + _normal_cdf(low)
    density_high, density_low = _normal_pdf(high), _normal_pdf(low)
    deven = rise * dt + (density_high - density_low) * dsigma + (total / 2 - even) * dlength
    dodd = (
        (2 * even - total) * dt
        + (2 * sigma / length * rise - density_high - density_low) * dsigma
        - (rise / 2 + 2 * odd) * dlength
    )
    return (even, odd), (deven / length, dodd / length)


def _narrow_segment(t: Array, length: Array, sigma: Array) -> tuple[Array, Array]:
    """Evaluate `_segment_integrals` by quadrature, for length <= 2 sigma, where its error is below 1e-15."""
    even = odd = jnp.zeros_like(t)
    for x, weight in zip(_NODES.tolist(), _WEIGHTS.tolist()):
        value = 0.5 * weight * _normal_cdf(_z_score(t - 0.5 * x * length, sigma))
        even, odd = even + value, odd + x * value
    return even, odd


@jax.jit
def _linear_segments(time: Array, samples: Array) -> tuple[Array, Array, Array, Array]:
    """Centre, length, mean power and half rise of each segment between samples, scaled to unit area."""
    low, high = time[:-1], time[1:]
    # The largest sample is divided out first: powers of 1e-20 W would underflow in the products. It cancels
    # in the result, so its derivative is zero.
    power = samples / jax.lax.stop_gradient(jnp.max(samples))
    mean, rise = 0.5 * (power[1:] + power[:-1]), 0.5 * (power[1:] - power[:-1])
    area = jnp.sum(mean * (high - low))
    return 0.5 * (low + high), high - low, mean / area, rise / area


@jax.jit
def _segment_integrals(t: Array, length: Array, sigma: Array) -> tuple[Array, Array]:
    """Compute E and O (see the module) of a linear segment centred on zero, for the jitter `sigma`."""
    wide = (length > 2 * sigma) & (length > _NEGLIGIBLE_WIDTH)
    wide_even, wide_odd = _wide_segment(t, jnp.where(wide, length, 1.0), jnp.where(wide, sigma, 0.0))
    even, odd = _narrow_segment(t, length, sigma)
    return jnp.where(wide, wide_even, even), jnp.where(wide, wide_odd, odd)


@jax.jit
def _exponential_tail(t: Array, sigma: Array, decay: Array) -> Array:
    """Compute phi(z) M(sigma/decay - z) with z = t/sigma, which an exponential tail subtracts from Phi(z)."""
    z = _z_score(t, sigma)
    # The argument of M times the decay, which is finite at a decay of zero.
    scaled_argument = sigma - decay * z
    large = (scaled_argument > 4 * decay) & (scaled_argument > _NEGLIGIBLE_WIDTH)
    v = jnp.where(large, decay, 0.0) / jnp.where(large, scaled_argument, 1.0)
    # Laplace's continued fraction of M(1/v), smooth at v = 0. Its tail is that of a fraction with equal
    # terms: 16 terms then have a relative error of 3e-13.
    fraction = 0.5 * (1 + jnp.sqrt(1 + 68 * v * v))
    for k in range(16, 0, -1):
        fraction = 1 + k * v * v / fraction
    by_fraction = _normal_pdf(z) * v / fraction
    # Where the argument of M is below 4, the formula exp(rate^2 sigma^2/2 - rate t) Phi(z - sigma rate) does
    # not overflow: its exponent is below 8.
    direct = ~large & (decay > _NEGLIGIBLE_WIDTH)
    rate = 1 / jnp.where(direct, decay, 1.0)
    width, time = jnp.where(direct, sigma, 0.0), jnp.where(direct, t, 0.0)
    shifted = _normal_cdf(_z_score(time - width * width * rate, width))
    by_definition = jnp.exp(rate * (0.5 * width * width * rate - time)) * shifted
    return jnp.where(large, by_fraction, jnp.where(direct, by_definition, 0.0))
