"""Transmitted pulses: unit-area shapes whose integrals, blurred by timing jitter, are closed forms.

A digitiser records energy per bin, so what a simulation needs of a pulse is its running integral

    F(t) = integral from -inf to t of (p * g_j)(u) du,

where `p` is the pulse and `g_j` a Gaussian of standard deviation `j` (the timing jitter): the energy of
an echo in a bin is a difference of two values of `F`. With Phi the normal distribution function and
s^2 = sigma^2 + j^2,

- Gaussian: F = Phi(t/s);
- rectangle, and each linear piece of a sampled pulse: integrated error functions, written as the
  unblurred integral plus terms that decay, so that nothing cancels far away; where the piece is shorter
  than 2 j these do cancel, and Gauss-Legendre quadrature (exact to rounding there) takes over;
- exponentially modified Gaussian (Grushka 1972, Anal. Chem. 44, 1733): F = Phi(z) - phi(z) M(s/tau - z),
  with z measured from the Gaussian's centre and M the Mills ratio, by Laplace's continued fraction for
  large arguments: nothing overflows, and tau = 0 is the Gaussian.

Every formula and its derivatives stay finite at zero width and zero jitter, where F is a unit step of
value 1/2 at the step.
"""

import abc
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erfc
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._checks import as_array, as_scalar, check_range, concrete

_FWHM_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))
# A width below this (ns) counts as zero: a millionth of a light wave's period, and its inverse cube still
# fits into float32, as second derivatives need.
_NEGLIGIBLE = 1e-12
# Phi and phi are 1 or 0 to the last bit beyond; clipping here keeps inf * 0 out of the derivatives.
_SCORE_MAX = 40.0
# A normal variable lies outside +-5.5 sigma with probability 3.8e-8, an exponential one beyond 16.8
# mean lives with 5.1e-8: together below the 1e-7 that `support` promises.
_GAUSSIAN_REACH = 5.5
_EXPONENTIAL_REACH = 16.8
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)


def _vector(x: ArrayLike | Sequence[ArrayLike]) -> Float[Array, " samples"]:
    return as_array(x if isinstance(x, jax.Array) else jnp.asarray(x, dtype=float))


def _norm(a: Array, b: Array) -> Array:
    """sqrt(a^2 + b^2) whose derivative is finite at zero."""
    square = a * a + b * b
    positive = square > _NEGLIGIBLE**2
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def _score(t: Array, sigma: Array) -> Array:
    """t / sigma within +-40; for a sigma of zero the sign of t times 40."""
    inside = (sigma > _NEGLIGIBLE) & (jnp.abs(t) < _SCORE_MAX * sigma)
    ratio = jnp.where(inside, t, 0.0) / jnp.where(inside, sigma, 1.0)
    return jnp.where(inside, ratio, _SCORE_MAX * jnp.sign(t))


def _density(z: Array) -> Array:
    return jnp.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)


def _distribution(z: Array) -> Array:
    return 0.5 * erfc(-z / math.sqrt(2))


def _decaying(z: Array) -> tuple[Array, Array]:
    """Once and twice integrated Phi(z) less the same of the unit step: the first even and vanishing at
    infinity, the second odd (an integration constant dropped)."""
    tail, density = _distribution(-jnp.abs(z)), _density(z)
    once = density - jnp.abs(z) * tail
    twice = jnp.sign(z) * (0.25 - 0.5 * ((z * z + 1) * tail - jnp.abs(z) * density))
    return once, twice


@jax.custom_jvp
def _wide_piece(t: Array, length: Array, sigma: Array) -> tuple[Array, Array]:
    """`_piece` for length > 2 sigma."""
    once_high, twice_high = _decaying(_score(t + length / 2, sigma))
    once_low, twice_low = _decaying(_score(t - length / 2, sigma))
    ratio = sigma / length
    q = jnp.clip(2 * t / length, -1.0, 1.0)
    even = (1 + q) / 2 + ratio * (once_high - once_low)
    odd = (q * q - 1) / 4 - ratio * (once_high + once_low) + 2 * ratio**2 * (twice_high - twice_low)
    return even, odd


@_wide_piece.defjvp
def _wide_piece_jvp(primals, tangents):
    # By hand, since the two parts of each sum have kinks at the ends that only cancel in the sum.
    t, length, sigma = primals
    dt, dlength, dsigma = tangents
    even, odd = _wide_piece(t, length, sigma)
    high, low = _score(t + length / 2, sigma), _score(t - length / 2, sigma)
    rise, total = _distribution(high) - _distribution(low), _distribution(high) + _distribution(low)
    density_high, density_low = _density(high), _density(low)
    deven = rise * dt + (density_high - density_low) * dsigma + (total / 2 - even) * dlength
    dodd = (
        (2 * even - total) * dt
        + (2 * sigma / length * rise - density_high - density_low) * dsigma
        - (rise / 2 + 2 * odd) * dlength
    )
    return (even, odd), (deven / length, dodd / length)


def _narrow_piece(t: Array, length: Array, sigma: Array) -> tuple[Array, Array]:
    """`_piece` for length <= 2 sigma: quadrature, whose error is below 1e-15 there."""
    even = odd = jnp.zeros_like(t)
    for x, weight in zip(_NODES.tolist(), _WEIGHTS.tolist()):
        value = 0.5 * weight * _distribution(_score(t - 0.5 * x * length, sigma))
        even, odd = even + value, odd + x * value
    return even, odd


def _piece(t: Array, length: Array, sigma: Array) -> tuple[Array, Array]:
    """Halves of the integrals over x in [-1, 1] of Phi((t - x length/2)/sigma) and of x times that.

    A linear piece of mean power m and half rise d, centred on zero, has the blurred running integral
    length * (m * first + d * second).
    """
    wide = (length > 2 * sigma) & (length > _NEGLIGIBLE)
    wide_even, wide_odd = _wide_piece(t, jnp.where(wide, length, 1.0), jnp.where(wide, sigma, 0.0))
    even, odd = _narrow_piece(t, length, sigma)
    return jnp.where(wide, wide_even, even), jnp.where(wide, wide_odd, odd)


def _exponential_part(t: Array, sigma: Array, decay: Array) -> Array:
    """phi(z) M(sigma/decay - z) with z = t/sigma: what an exponential tail takes off Phi(z)."""
    z = _score(t, sigma)
    room = sigma - decay * z
    large = (room > 4 * decay) & (room > _NEGLIGIBLE)  # the argument of M exceeds 4
    v = jnp.where(large, decay, 0.0) / jnp.where(large, room, 1.0)
    # Laplace's continued fraction of M(1/v), smooth at v = 0, closed by its tail for equal terms: 16 terms
    # leave 3e-13 of it.
    fraction = 0.5 * (1 + jnp.sqrt(1 + 68 * v * v))
    for k in range(16, 0, -1):
        fraction = 1 + k * v * v / fraction
    by_fraction = _density(z) * v / fraction
    # Elsewhere as it stands: the exponent stays below 8.
    direct = ~large & (decay > _NEGLIGIBLE)
    rate = 1 / jnp.where(direct, decay, 1.0)
    width, time = jnp.where(direct, sigma, 0.0), jnp.where(direct, t, 0.0)
    shifted = _distribution(_score(time - width * width * rate, width))
    as_it_stands = jnp.exp(rate * (0.5 * width * width * rate - time)) * shifted
    return jnp.where(large, by_fraction, jnp.where(direct, as_it_stands, 0.0))


class AbstractPulse(eqx.Module):
    """The shape of the transmitted pulse: power against time in ns, normalised to unit area.

    Pure, and differentiable in time, jitter and every parameter. Subclasses are final.
    """

    @abc.abstractmethod
    def cumulative(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        """The share of the pulse's energy that has passed by time `t`.

        - `t`: times in ns, any shape.
        - `jitter`: standard deviation of the timing error in ns (not negative), a scalar. The
          pulse is convolved with a Gaussian of that width. Default 0.

        Returns an array shaped as `t`, rising from 0 to 1.
        """

    @property
    @abc.abstractmethod
    def mean(self) -> Float[Array, ""]:
        """The pulse's centroid in ns."""

    @property
    @abc.abstractmethod
    def std(self) -> Float[Array, ""]:
        """The pulse's standard deviation in ns, without jitter."""

    @property
    @abc.abstractmethod
    def finest(self) -> Float[Array, ""]:
        """Scale (ns) of the finest feature over which the power changes smoothly; zero where it jumps."""

    @abc.abstractmethod
    def support(self, jitter: ArrayLike = 0.0) -> tuple[float, float]:
        """Times (low, high) in ns outside which less than 1e-7 of the energy lies.

        For sizing windows: Python numbers, hence for concrete parameters only; inside a transformation
        JAX raises its `ConcretizationTypeError`.
        """

    def power(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        """The pulse's power at times `t` (ns, any shape) per unit of energy, in 1/ns.

        The derivative of `cumulative`; half the jump where the power jumps. A pulse of zero width has no
        finite power: its step counts as flat, and the result is zero everywhere.
        """
        t = as_array(t)
        return jax.jvp(lambda u: self.cumulative(u, jitter), (t,), (jnp.ones_like(t),))[1]


class GaussianPulse(AbstractPulse):
    """A Gaussian pulse, centred on time zero.

    - `fwhm`: full width at half maximum in ns, not negative; zero is an instant. Default 6 (Table 1 of
      the paper).

    **Raises:** `ValueError` for a negative or non-finite width.
    """

    fwhm: Float[Array, ""] = eqx.field(converter=as_scalar, default=6.0)

    def __check_init__(self):
        check_range("fwhm", self.fwhm, 0.0)

    def cumulative(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        return _distribution(_score(as_array(t), _norm(self.std, as_scalar(jitter))))

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
        reach = _GAUSSIAN_REACH * math.hypot(float(self.std), float(as_scalar(jitter)))
        return -reach, reach


class RectangularPulse(AbstractPulse):
    """A pulse of constant power, centred on time zero.

    - `length`: duration in ns, not negative; zero is an instant. Default 6 (Table 1 of the paper).

    **Raises:** `ValueError` for a negative or non-finite length.
    """

    length: Float[Array, ""] = eqx.field(converter=as_scalar, default=6.0)

    def __check_init__(self):
        check_range("length", self.length, 0.0)

    def cumulative(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        return _piece(as_array(t), self.length, jnp.abs(as_scalar(jitter)))[0]

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
        reach = 0.5 * float(self.length) + _GAUSSIAN_REACH * float(as_scalar(jitter))
        return -reach, reach


class ExponentiallyModifiedGaussianPulse(AbstractPulse):
    """A Gaussian convolved with a decaying exponential: a sharp rise and a long tail.

    Time zero is the centroid; the Gaussian's centre lies `decay` before it.

    - `fwhm`: full width at half maximum of the Gaussian in ns, not negative.
    - `decay`: mean life of the exponential in ns, not negative; zero is the Gaussian pulse.

    **Raises:** `ValueError` for a negative or non-finite width or decay.
    """

    fwhm: Float[Array, ""] = eqx.field(converter=as_scalar)
    decay: Float[Array, ""] = eqx.field(converter=as_scalar)

    def __check_init__(self):
        check_range("fwhm", self.fwhm, 0.0)
        check_range("decay", self.decay, 0.0)

    def cumulative(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        sigma = _norm(self.fwhm / _FWHM_PER_SIGMA, as_scalar(jitter))
        from_centre = as_array(t) + self.decay
        return _distribution(_score(from_centre, sigma)) - _exponential_part(from_centre, sigma, self.decay)

    @property
    def mean(self) -> Float[Array, ""]:
        return jnp.zeros_like(self.fwhm)

    @property
    def std(self) -> Float[Array, ""]:
        return _norm(self.fwhm / _FWHM_PER_SIGMA, self.decay)

    @property
    def finest(self) -> Float[Array, ""]:
        return self.std

    def support(self, jitter: ArrayLike = 0.0) -> tuple[float, float]:
        decay = float(self.decay)
        reach = _GAUSSIAN_REACH * math.hypot(float(self.fwhm) / _FWHM_PER_SIGMA, float(as_scalar(jitter)))
        return -decay - reach, -decay + reach + _EXPONENTIAL_REACH * decay


class SampledPulse(AbstractPulse):
    """A recorded transmit waveform: linear between its samples, zero outside, scaled to unit area.

    Time zero is that of the given time axis: subtract the centroid (`mean`) from `time` for a pulse
    whose echoes lie where a symmetric pulse's do. Remove a recorded baseline before.

    - `time`: (samples,) in ns, strictly increasing, at least two.
    - `power`: (samples,) in any unit, not negative, not all zero.

    **Raises:** `ValueError` for times that are unsorted or too few, for shapes that differ, and for power
    that is negative, non-finite or zero throughout.
    """

    time: Float[Array, " samples"]
    samples: Float[Array, " samples"]

    def __init__(self, time: ArrayLike | Sequence[ArrayLike], power: ArrayLike | Sequence[ArrayLike]):
        self.time = _vector(time)
        self.samples = _vector(power)  # `power` names the method

    def __check_init__(self):
        time, power = concrete(self.time), concrete(self.samples)
        if self.time.shape != self.samples.shape or self.time.ndim != 1 or self.time.size < 2:
            raise ValueError(
                f"time and power have shapes {self.time.shape} and {self.samples.shape}; the admissible ones "
                "are equal, one-dimensional, of two samples or more"
            )
        check_range("time", self.time)
        check_range("power", self.samples, 0.0)
        if time is not None and np.any(np.diff(time) <= 0):
            i = int(np.argmax(np.diff(time) <= 0))
            raise ValueError(
                f"time = {time[i]:g} is followed by {time[i + 1]:g}; the admissible times increase strictly"
            )
        if power is not None and not np.any(power > 0):
            raise ValueError("power = 0 throughout; the admissible range of its largest sample is (0, inf)")

    def _pieces(self) -> tuple[Array, Array, Array, Array]:
        """Centre, length, mean power and half rise of each linear piece, for unit area."""
        low, high = self.time[:-1], self.time[1:]
        # Divided by the largest first, as powers of 1e-20 W or so would underflow on the way.
        power = self.samples / jax.lax.stop_gradient(jnp.max(self.samples))
        mean, rise = 0.5 * (power[1:] + power[:-1]), 0.5 * (power[1:] - power[:-1])
        area = jnp.sum(mean * (high - low))
        return 0.5 * (low + high), high - low, mean / area, rise / area

    def cumulative(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        centre, length, mean, rise = self._pieces()
        sigma = jnp.abs(as_scalar(jitter))

        def at(time):
            even, odd = _piece(time - centre, length, sigma)
            return jnp.sum(length * (mean * even + rise * odd))

        t = as_array(t)
        return jax.vmap(at)(t.reshape(-1)).reshape(t.shape)

    @property
    def mean(self) -> Float[Array, ""]:
        centre, length, mean, rise = self._pieces()
        return jnp.sum(length * (mean * centre + rise * length / 6))

    @property
    def std(self) -> Float[Array, ""]:
        centre, length, mean, rise = self._pieces()
        centre = centre - self.mean
        return jnp.sqrt(jnp.sum(length * (mean * (centre**2 + length**2 / 12) + rise * centre * length / 3)))

    @property
    def finest(self) -> Float[Array, ""]:
        return self.std

    def support(self, jitter: ArrayLike = 0.0) -> tuple[float, float]:
        time, lit = np.asarray(self.time, dtype=float), np.flatnonzero(np.asarray(self.samples))
        reach = _GAUSSIAN_REACH * float(as_scalar(jitter))
        first, last = max(lit[0] - 1, 0), min(lit[-1] + 1, time.size - 1)
        return float(time[first]) - reach, float(time[last]) + reach
