"""Transmitted pulses: shapes of unit area whose integrals, blurred by timing jitter, are closed forms.

A digitiser records energy per bin, so a simulation needs the running integral of the pulse,

    F(t) = integral from -inf to t of (p * g_j)(u) du,

where `p` is the pulse and `g_j` a Gaussian of standard deviation `j` (the timing jitter). The energy of
an echo in a bin is a difference of two values of `F`. With Phi the normal distribution function and
s^2 = sigma^2 + j^2,

- Gaussian: F = Phi(t/s).
- Rectangle, and each linear piece of a sampled pulse: integrated error functions, written as the
  unblurred integral plus terms that decay, so that nothing cancels far away. Where the piece is shorter
  than 2 j these terms do cancel, and Gauss-Legendre quadrature (exact to rounding there) is used.
- Exponentially modified Gaussian (Grushka 1972, Anal. Chem. 44, 1733): F = Phi(z) - phi(z) M(s/tau - z),
  with z measured from the Gaussian's centre and M the Mills ratio. For large arguments M is Laplace's
  continued fraction: nothing overflows, and tau = 0 is the Gaussian.

Every formula and its derivatives stay finite at zero width and zero jitter, where F is a unit step of
value 1/2 at the step.
"""

import abc
import math
from collections.abc import Sequence
from typing import ClassVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._checks import as_array, as_scalar, briefly, check_range, concrete, scalar, warn_units
from jaxlidar._ranges import Range, check_ranges
from jaxlidar.instrument.pulse_integrals import (
    distribution,
    exponential_part,
    piece,
    quadrature_sum,
    score,
)

_FWHM_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))
# A normal variable lies outside +-5.5 sigma with probability 3.8e-8, an exponential one beyond 16.8
# mean lives with 5.1e-8: together below the 1e-7 that `support` promises.
_GAUSSIAN_REACH = 5.5
_EXPONENTIAL_REACH = 16.8


class AbstractPulse(eqx.Module):
    """The shape of a transmitted pulse: power against time in ns, normalised to unit area.

    A pulse of your own is one class in one file: derive it from this, give `cumulative`, `mean`, `std`,
    `finest` and `support`, and pass it as `pulse=` of a `Lidar`. `power` follows from `cumulative`. Methods
    are pure, written with `jax.numpy` (see `jaxlidar.extend`), and differentiable in time, jitter and every
    field. Subclasses are final.

    **Example:** the share of a pulse's energy that falls into one sample of 1 ns.

    >>> import jaxlidar as jl
    >>> pulse = jl.GaussianPulse(fwhm=6.0)
    >>> print(f"{pulse.cumulative(0.5) - pulse.cumulative(-0.5):.4f}")
    0.1556
    """

    @abc.abstractmethod
    def cumulative(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        """Share of the pulse's energy that has passed by time `t`.

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

        For a Gaussian it is the standard deviation. The width of the fine bins, in which returns are
        collected, follows it.
        """

    @abc.abstractmethod
    def support(self, jitter: ArrayLike = 0.0) -> tuple[float, float]:
        """Times (low, high) in ns outside which less than 1e-7 of the energy lies, for the size of windows.

        **Arguments:**

        - `jitter`: standard deviation of the timing error in ns. Default 0.

        **Returns:** two Python numbers.

        **Raises:** JAX's `ConcretizationTypeError` inside a JAX transformation: the parameters must be known.
        """

    def power(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        """Power of the pulse per unit of energy in 1/ns: the derivative of `cumulative`.

        **Arguments:**

        - `t`: times in ns, any shape.
        - `jitter`: standard deviation of the timing error in ns. Default 0.

        **Returns:** an array shaped as `t`. Where the power jumps, it is half the jump. A pulse of zero width
        has no finite power: its step counts as flat, and the result is zero everywhere.
        """
        t = as_array(t)
        return jax.jvp(lambda u: self.cumulative(u, jitter), (t,), (jnp.ones_like(t),))[1]


@final
@briefly
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

    fwhm: Float[Array, ""] = eqx.field(converter=scalar("fwhm"), default=6.0)

    ranges: ClassVar = {"fwhm": Range(0.0)}

    def __check_init__(self):
        check_ranges(self)
        warn_units(self)

    def cumulative(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        return distribution(score(as_array(t), quadrature_sum(self.std, as_scalar(jitter))))

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


@final
@briefly
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

    length: Float[Array, ""] = eqx.field(converter=scalar("length"), default=6.0)

    ranges: ClassVar = {"length": Range(0.0)}

    def __check_init__(self):
        check_ranges(self)
        warn_units(self)

    def cumulative(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        return piece(as_array(t), self.length, jnp.abs(as_scalar(jitter)))[0]

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


@final
@briefly
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

    fwhm: Float[Array, ""] = eqx.field(converter=scalar("fwhm"))
    decay: Float[Array, ""] = eqx.field(converter=scalar("decay"))

    ranges: ClassVar = {"fwhm": Range(0.0), "decay": Range(0.0)}

    def __check_init__(self):
        check_ranges(self)
        warn_units(self)

    def cumulative(self, t: ArrayLike, jitter: ArrayLike = 0.0) -> Float[Array, "..."]:
        sigma = quadrature_sum(self.fwhm / _FWHM_PER_SIGMA, as_scalar(jitter))
        from_centre = as_array(t) + self.decay
        return distribution(score(from_centre, sigma)) - exponential_part(from_centre, sigma, self.decay)

    @property
    def mean(self) -> Float[Array, ""]:
        return jnp.zeros_like(self.fwhm)

    @property
    def std(self) -> Float[Array, ""]:
        return quadrature_sum(self.fwhm / _FWHM_PER_SIGMA, self.decay)

    @property
    def finest(self) -> Float[Array, ""]:
        return self.fwhm / _FWHM_PER_SIGMA

    def support(self, jitter: ArrayLike = 0.0) -> tuple[float, float]:
        decay = float(self.decay)
        reach = _GAUSSIAN_REACH * math.hypot(float(self.std), float(as_scalar(jitter)))
        return -decay - reach, -decay + reach + _EXPONENTIAL_REACH * decay


@final
@briefly
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

    time: Float[Array, " samples"]
    samples: Float[Array, " samples"]

    ranges: ClassVar = {"time": Range(increasing=True), "samples": Range(0.0)}

    def __init__(self, time: ArrayLike | Sequence[ArrayLike], power: ArrayLike | Sequence[ArrayLike]):
        self.time = as_array(time, "time")
        self.samples = as_array(power, "power")  # `power` names the method

    def __check_init__(self):
        time, power = concrete(self.time), concrete(self.samples)
        if self.time.shape != self.samples.shape or self.time.ndim != 1 or self.time.size < 2:
            raise ValueError(
                f"time and power have shapes {self.time.shape} and {self.samples.shape}; the admissible ones "
                "are equal, one-dimensional, of two samples or more"
            )
        # The user calls it power.
        check_range("power", self.samples, 0.0)
        check_ranges(self)
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
            even, odd = piece(time - centre, length, sigma)
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
        """Scale in ns of the finest feature: the largest power over the sharpest change of its slope.

        Never more than the standard deviation; zero where the record begins or ends with more than a
        hundredth of the largest power.
        """
        slope = jnp.diff(self.samples) / jnp.diff(self.time)
        bend = jnp.max(jnp.abs(jnp.diff(slope, prepend=0.0, append=0.0)))
        most = jnp.max(self.samples)
        jumps = jnp.maximum(self.samples[0], self.samples[-1]) > 0.01 * most
        return jnp.where(jumps, 0.0, jnp.minimum(most / bend, self.std))

    def support(self, jitter: ArrayLike = 0.0) -> tuple[float, float]:
        time, lit = np.asarray(self.time, dtype=float), np.flatnonzero(np.asarray(self.samples))
        reach = _GAUSSIAN_REACH * float(as_scalar(jitter))
        first, last = max(lit[0] - 1, 0), min(lit[-1] + 1, time.size - 1)
        return float(time[first]) - reach, float(time[last]) + reach
