r"""Decomposition of records into echoes: Gaussians, or copies of a recorded pulse.

A record is modelled as a sum of K echoes, y(t) = sum_k f(t; a_k, t_k, s_k) + noise, of amplitude a, time t
and width s (Hofton et al. 2000; Wagner et al. 2006):

    Gaussians            f = a exp(-(t - t_k)^2 / 2 s_k^2),
    copies of a pulse p  f = a p(t - t_k),
    broadened copies     f = a (p * g_s)(t - t_k),    g_s the Gaussian of width s and unit area.

**Algorithm.** Echoes are added one at a time:

1. Matched filter of the residual r with weights w = 1 / sigma. An echo of shape p about bin i lowers chi^2 by
   (sum w^2 r p_i)^2 / sum w^2 p_i^2; the new echo starts where that is largest.
2. All echoes are fitted again, by Levenberg-Marquardt.
3. The number of echoes is that with the lowest chi^2 + cost; the search ends after two echoes in a row that
   have not lowered it. An echo of m parameters costs

       Gaussians, m = 3:          m ln(bins),
       copies, m = 2 or 3:        (m + 1) ln(bins),

   the Bayesian information criterion (Schwarz 1978), and for copies one ln(bins) more, because the time of an
   echo is searched for among all bins (Zhang and Siegmund 2007).

Copies are shifted and broadened in the Fourier domain, which is exact for a pulse that its sampling resolves.

**Errors of the pulse.** A recorded pulse is itself a noisy record. Its errors count as noise of `pulse_error`
times the amplitude of a single echo with the energy found within a pulse's length,

    sigma_i^2 + pulse_error^2 sum_j y_j^2 / sum p^2,    j within a pulse's length of i.

So the residual that an imperfect pulse leaves of a strong echo is not taken for weak echoes.

**Bounds.** Parameters are smooth bijections (logistic) of free ones, so that no echo leaves the record: its
time lies between the first and the last sample with weight, and its height, broadened, between zero and the
highest that the record supports, one standard deviation above a sample. Noise in proportion to the signal
has next to no weight where the signal is strong; without bounds, echoes grow there beyond any sample.

Derivatives are those at the number of echoes found.

**Source:** Hofton et al. (2000), IEEE Trans. Geosci. Remote Sens. 38, 1989; Wagner et al. (2006), ISPRS J.
Photogramm. 60, 100; Schwarz (1978), Ann. Stat. 6, 461; Zhang and Siegmund (2007), Biometrics 63, 22.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxlidar._fields.checks import as_array, check_integer, check_range, concrete
from jaxlidar._jax.products import matmul
from jaxlidar.survey.records import (
    Pulse,
    divide,
    divide_by_largest,
    even_axis,
    over_shots,
    pad_to,
    record_bucket,
    sample_pulse,
)

_SOLVER = optx.LevenbergMarquardt(rtol=1e-3, atol=1e-3)
_MAX_STEPS = 40
# Number of echoes in a row that do not lower the criterion, after which no more are added.
_PATIENCE = 2
# Bounds of the width of a Gaussian echo, and of the Gaussian that broadens a copy, in widths of the pulse.
_WIDTH_BOUNDS = {"gaussian": (0.5, 8.0), "copies": (0.5, 8.0), "broadened": (0.1, 8.0)}
# The width that fits start from, in widths of the pulse, and the cost of an echo, in ln(bins).
_START_WIDTH = {"gaussian": 1.0, "copies": 1.0, "broadened": 0.4}
_COST = {"gaussian": 3, "copies": 3, "broadened": 4}
# Largest height of an echo above the record, in standard deviations of the noise.
_EXCESS = 1.0
# Fits start at least this fraction of the bounds' width away from them: the logistic function is flat there.
_MARGIN = 0.01
# Least noise over the largest sample: models are computed to that precision.
_ROUNDING = 1e-4
# Least and largest finite noise over the largest sample that weights are made of.
_NOISE_LIMITS = (1e-8, 1e15)

FreeParameters = Float[Array, "echoes 3"]
IsActive = Bool[Array, " echoes"]


class Echoes(NamedTuple):
    """Echoes of a record, in order of time; entries beyond `count` are zero. Several records add a dimension.

    - `amplitude`: (echoes,) height of the peak, in units of the record; of a copy, before it is broadened.
    - `time`: (echoes,) time of the peak in ns; of a copy, of the pulse's time zero.
    - `width`: (echoes,) standard deviation in ns; of a copy, that of the Gaussian that broadens it, or 0.
    - `stderr`: (echoes, 3) one standard error of each of the three above.
    - `count`: number of echoes.
    - `model`: (bins,) the sum of the echoes.
    - `chi2`: sum of squared residuals over the noise.
    - `criterion`: `chi2` plus the cost of all echoes.

    **Example:**

    >>> import inversion, numpy as np
    >>> time = np.arange(0.0, 60.0)
    >>> power = np.exp(-0.5 * ((time - 20.0) / 3.0) ** 2)
    >>> echoes = inversion.gaussian_decomposition(time, power, noise=0.01, width=3.0)
    >>> print(f"{int(echoes.count)}: {float(echoes.time[0]):.1f} ns, width {float(echoes.width[0]):.1f} ns")
    1: 20.0 ns, width 3.0 ns
    """

    amplitude: Float[Array, "... echoes"]
    time: Float[Array, "... echoes"]
    width: Float[Array, "... echoes"]
    stderr: Float[Array, "... echoes 3"]
    count: Int[Array, "..."]
    model: Float[Array, "... bins"]
    chi2: Float[Array, "..."]
    criterion: Float[Array, "..."]


def gaussian_decomposition(
    time: Float[ArrayLike, " bins"],
    power: Float[ArrayLike, "... bins"],
    *,
    noise: Float[ArrayLike, "..."],
    width: Float[ArrayLike, ""] | None = None,
    pulse: Pulse | None = None,
    broaden: bool = True,
    pulse_error: float = 0.01,
    max_echoes: int = 6,
) -> Echoes:
    """Decompose a record into Gaussians or copies of a recorded pulse, their number by a penalised criterion.

    System pulses are no Gaussians: where the pulse was recorded, give it, or a hard target will have two
    echoes or more. Records are padded to size buckets (64, 96, 128, 192, ... bins); each is compiled once,
    for each number of records. No echo is negative, none lies outside the record, and none exceeds the
    record by more than one standard deviation of its noise. An echo that the record cuts off is an echo at
    that end.

    **Arguments:**

    - `time`: (bins,) ns, increasing in equal steps. Times of echoes are rounded to single precision, 0.06 ns
      at 1e6 ns, unless JAX computes in double precision.
    - `power`: (bins,) record in any unit, background removed; or (shots, bins).
    - `noise`: standard deviation of `power`, above 0: one number, or of the shape of `power`. Samples of
      infinite noise have no weight. 1e-4 of the largest sample is added in quadrature.
    - `width`: for Gaussian echoes: standard deviation of the pulse in ns, above 0. Widths of echoes start
      from it and end between half of it and eight times it.
    - `pulse`: for copies: a recorded pulse, or the system's impulse, at the record's sampling, (lags,), an
      odd number of samples with time zero in the middle, or (shots, lags); or a `jaxlidar` pulse.
    - `broaden`: True if copies may be broadened by Gaussians, where that lowers the criterion. Default True.
    - `pulse_error`: standard deviation of the errors of `pulse` over its peak, 0 or more. Default 0.01.
    - `max_echoes`: most echoes, at least 1. Default 6.

    **Returns:** an `Echoes`, with `max_echoes` entries.

    **Raises:** ValueError for inadmissible arguments, and unless either `width` or `pulse` is given.

    **Source:** Hofton et al. (2000), IEEE Trans. Geosci. Remote Sens. 38, 1989; Wagner et al. (2006), ISPRS
    J. Photogramm. 60, 100; Schwarz (1978), Ann. Stat. 6, 461; Zhang and Siegmund (2007), Biometrics 63, 22
    (times found by search).

    **Example:**

    >>> import inversion, numpy as np
    >>> time = np.arange(0.0, 60.0)
    >>> power = sum(a * np.exp(-0.5 * ((time - t) / 3.0) ** 2) for a, t in ((1.0, 20.0), (0.5, 40.0)))
    >>> echoes = inversion.gaussian_decomposition(time, power, noise=0.01, width=3.0)
    >>> [f"{float(t):.1f}" for t in echoes.time[: echoes.count]]
    ['20.0', '40.0']
    """
    max_echoes = check_integer("max_echoes", max_echoes)
    check_range("time", time)
    check_range("power", power)
    y_shape, bins = np.shape(power), np.size(time)
    if np.ndim(time) != 1 or y_shape[-1:] != (bins,) or bins < 2:
        raise ValueError(
            f"time and power have the shapes {np.shape(time)} and {y_shape}; admissible is (bins,) and "
            "(..., bins), two or more"
        )
    if np.shape(noise) not in ((), (bins,), y_shape):
        raise ValueError(f"noise has the shape {np.shape(noise)}; admissible is () or {y_shape}")
    if (width is None) == (pulse is None):
        raise ValueError("width and pulse: admissible is one of them")
    sigma = concrete(noise)
    # It may be infinite.
    finite_sigma = noise if sigma is None else np.where(np.isposinf(sigma), 1.0, sigma)
    check_range("noise", finite_sigma, 0.0, low_open=True)
    check_range("pulse_error", pulse_error, 0.0)
    times = even_axis("time", time)
    y, magnitude = divide_by_largest(power, "power", noise)
    relative_noise = divide(noise, magnitude if np.ndim(magnitude) == 0 else magnitude[..., None], "noise")
    padded, weight = _padded_to(record_bucket(bins), y, relative_noise)
    arrays = {"power": padded, "weight": weight, "step": jnp.asarray(times.step, y.dtype)}
    if pulse is None:
        assert width is not None
        check_range("width", width, 0.0, low_open=True)
        arrays |= {"pulse": jnp.ones(1), "width": as_array(width, "width"), "pulse_error": jnp.zeros(())}
        echoes = _compiled_decomposition("gaussian", max_echoes)(**arrays)
    else:
        lags, error = sample_pulse(pulse, times.step), as_array(pulse_error, "pulse_error")
        arrays |= {"pulse": lags, "width": jnp.ones(()), "pulse_error": error}
        echoes = _compiled_decomposition("copies", max_echoes)(**arrays)
        if broaden:
            # For each record the one or the other: a width that does not pay for itself is zero.
            echoes = _better(_compiled_decomposition("broadened", max_echoes)(**arrays), echoes)
    return _in_units(echoes, times.first, jnp.asarray(magnitude, y.dtype), bins)


@partial(jax.jit, static_argnames="size")
def _padded_to(size: int, y: Array, sigma: Array) -> tuple[Array, Array]:
    """Pad records to `size` samples, and return them with their weights, one over the noise."""
    # Beyond these limits noise changes nothing, but the squares of weights would overflow or vanish.
    sigma = jnp.where(jnp.isinf(sigma), sigma, jnp.clip(sigma, *_NOISE_LIMITS))
    # Padding has no weight: it does not count as recorded.
    return pad_to(y, size), pad_to(jnp.broadcast_to(1.0 / sigma, y.shape), size)


@jax.jit
def _better(a: Echoes, b: Echoes) -> Echoes:
    """Return for each record the echoes of the lower criterion."""
    return jax.tree.map(partial(_select, a.criterion < b.criterion), a, b)


def _select(condition: Array, a: Array, b: Array) -> Array:
    """Choose between arrays that have more dimensions, after those of the condition."""
    return jnp.where(condition.reshape(condition.shape + (1,) * (a.ndim - condition.ndim)), a, b)


@partial(jax.jit, static_argnames="bins")
def _in_units(echoes: Echoes, first_time: ArrayLike, magnitude: Array, bins: int) -> Echoes:
    """Return echoes in the units of records, with the times of the record, and models of `bins` samples."""
    # The program counts time from the first sample; empty entries stay zero.
    time = jnp.where(echoes.amplitude > 0, jnp.asarray(first_time, echoes.time.dtype) + echoes.time, 0.0)
    unit = magnitude[..., None]
    per_parameter = jnp.stack([unit, jnp.ones_like(unit), jnp.ones_like(unit)], axis=-1)
    return echoes._replace(
        amplitude=echoes.amplitude * unit,
        time=time,
        stderr=echoes.stderr * per_parameter,
        model=echoes.model[..., :bins] * unit,
    )


@lru_cache
def _compiled_decomposition(kind: str, max_echoes: int) -> Callable[..., Echoes]:
    """Return the compiled decomposition into echoes of one kind, at most `max_echoes` of them."""

    def decompose(**arguments: Array) -> Echoes:
        return _decompose(kind, max_echoes, **arguments)

    decompose.__name__ = "_decompose"
    # Shot by shot: the solver takes a number of steps that differs between shots.
    compiled = over_shots(power=1, weight=1, step=0, pulse=1, width=0, pulse_error=0, sequential=True)
    return compiled(decompose)


# -- shapes of echoes ----------------------------------------------------------------------------------


class _EchoShape(NamedTuple):
    """Model of one kind of echo. Times and widths are in samples.

    - `width`: standard deviation of the pulse, or of the Gaussian of its peak and area.
    - `model`: of amplitudes, centres and widths, (echoes,) each: the sum of the echoes, (bins,).
    - `matched_filter`: of a residual r and weights w, (bins,) each: sum w^2 r p_i and sum w^2 p_i^2 with the
      pulse p_i about each bin i. Their ratio is the best amplitude of one echo there.
    """

    width: Array
    model: Callable[[Array, Array, Array], Array]
    matched_filter: Callable[[Array, Array], tuple[Array, Array]]


def _gaussian_shape(size: int, pulse_width: Array) -> _EchoShape:
    """Gaussians on `size` bins, for a pulse of that standard deviation in samples."""
    number = jnp.arange(size, dtype=pulse_width.dtype)
    # An odd number of samples, so that its middle is one.
    kernel = jnp.exp(-0.5 * ((number[: size - 1] - (size // 2 - 1)) / pulse_width) ** 2)

    def model(amplitude, centre, width):
        distance = (number[None, :] - centre[:, None]) / width[:, None]
        return jnp.sum(amplitude[:, None] * jnp.exp(-0.5 * distance * distance), axis=0)

    def matched_filter(residual, weight):
        matched = jnp.convolve(residual * weight**2, kernel, mode="same")
        return matched, jnp.convolve(weight**2, kernel**2, mode="same")

    return _EchoShape(pulse_width, model, matched_filter)


def _copy_shape(size: int, pulse: Array) -> _EchoShape:
    """Copies of a pulse on `size` bins, shifted and broadened in the Fourier domain."""
    # Long enough that a copy at either end does not wrap around.
    padded = record_bucket(size + pulse.size)
    time_zero = pulse.size // 2
    from_zero = jnp.roll(jnp.pad(pulse, (0, padded - pulse.size)), -time_zero)
    spectrum, square_spectrum = jnp.fft.rfft(from_zero), jnp.fft.rfft(from_zero**2)
    omega = 2.0 * jnp.pi * jnp.fft.rfftfreq(padded).astype(pulse.dtype)

    def model(amplitude, centre, width):
        # A shift by c and a Gaussian of width s multiply the spectrum by exp(-i omega c - (omega s)^2 / 2).
        damping = -0.5 * (omega[None, :] * width[:, None]) ** 2
        factor = jnp.exp(lax.complex(damping, -omega[None, :] * centre[:, None]))
        return jnp.fft.irfft(spectrum * jnp.sum(amplitude[:, None] * factor, axis=0), padded)[:size]

    def correlate(samples, pulse_spectrum):
        return jnp.fft.irfft(jnp.fft.rfft(samples, padded) * jnp.conj(pulse_spectrum), padded)[:size]

    def matched_filter(residual, weight):
        return correlate(residual * weight**2, spectrum), correlate(weight**2, square_spectrum)

    return _EchoShape(jnp.sum(pulse) / jnp.sqrt(2.0 * jnp.pi), model, matched_filter)


def _weight_with_pulse_error(y: Array, weight: Array, pulse: Array, pulse_error: Array) -> Array:
    """Lower the weights of samples by the errors of the pulse near them (see the module's docstring)."""
    size = record_bucket(y.size + pulse.size)
    half, energy = pulse.size // 2, jnp.where(weight > 0, y * y, 0.0)
    box = jnp.ones(pulse.size, y.dtype)
    # Moving sum of the energy over a pulse's length; rounding of the transforms can make it negative.
    near = jnp.fft.irfft(jnp.fft.rfft(energy, size) * jnp.fft.rfft(box, size), size)
    square_amplitude = jnp.maximum(near[half : half + y.size], 0.0) / jnp.sum(pulse**2)
    return weight / jnp.sqrt(1.0 + (weight * pulse_error) ** 2 * square_amplitude)


# -- parameters of echoes ------------------------------------------------------------------------------


class _Parameterisation(NamedTuple):
    """Bijections from free parameters z, of order one, to amplitude, centre and width of echoes.

    With l the logistic function, w the pulse's width and [first, first + length] the samples with weight:

        height = highest l(z_0),    centre = first + length l(4 w z_1 / length),
        width = w exp(log_low + (log_high - log_low) l(z_2)).

    In the middle of the record one unit of z_1 is a width of the pulse. The height of a broadened copy is its
    peak after broadening, and its amplitude that before, larger by sqrt(1 + (width / w)^2).
    """

    kind: str
    pulse_width: Array
    highest: Array
    first: Array
    length: Array
    log_low: Array
    log_high: Array

    @property
    def stretch(self) -> Array:
        """Factor of the free parameter of the centre."""
        return 4.0 * self.pulse_width / self.length

    def unpack(self, free: FreeParameters) -> tuple[Array, Array, Array]:
        """Amplitudes, centres and widths, in samples."""
        width = jnp.exp(self.log_low + (self.log_high - self.log_low) * jax.nn.sigmoid(free[:, 2]))
        width = width * self.pulse_width
        amplitude = self.highest * jax.nn.sigmoid(free[:, 0])
        centre = self.first + self.length * jax.nn.sigmoid(self.stretch * free[:, 1])
        if self.kind == "broadened":
            amplitude *= jnp.hypot(1.0, width / self.pulse_width)
        return amplitude, centre, jnp.zeros_like(width) if self.kind == "copies" else width

    def start(self, amplitude: Array, centre: Array) -> Float[Array, "3"]:
        """Free parameters of a new echo."""
        log_width = jnp.log(_START_WIDTH[self.kind])
        return jnp.stack(
            [
                _logit(amplitude / self.highest),
                _logit((centre - self.first) / self.length) / self.stretch,
                _logit((log_width - self.log_low) / (self.log_high - self.log_low)),
            ]
        )

    def restart_limits(self) -> Float[Array, "1 3"]:
        """Largest magnitudes of free parameters from which a fit starts again."""
        largest = _logit(jnp.ones(3, self.highest.dtype))[None, :]
        return largest * jnp.stack([0.5, 1.0 / self.stretch, 1.0])[None, :]


def _logit(fraction: Array) -> Array:
    """Inverse of the logistic function, at a margin from 0 and 1."""
    fraction = jnp.clip(fraction, _MARGIN, 1.0 - _MARGIN)
    return jnp.log(fraction) - jnp.log1p(-fraction)


def _parameterisation(
    kind: str, shape: _EchoShape, y: Array, weight: Array, is_used: Array
) -> _Parameterisation:
    """Bounds of the echoes of a record, from its samples with weight (`is_used`)."""
    first, last = jnp.argmax(is_used), y.size - 1 - jnp.argmax(is_used[::-1])
    # A Gaussian of width s with its peak midway between two samples is higher than both by exp(1 / (8 s^2)).
    narrowest = shape.width * (_WIDTH_BOUNDS[kind][0] if kind == "gaussian" else 1.0)
    between_samples = jnp.exp(0.125 / jnp.maximum(narrowest, 0.5) ** 2)
    supported = jnp.where(is_used, y + _EXCESS / jnp.where(is_used, weight, 1.0), 0.0)
    highest = jnp.maximum(between_samples * jnp.max(supported), jnp.finfo(y.dtype).tiny)
    log_low, log_high = (jnp.log(jnp.asarray(bound, y.dtype)) for bound in _WIDTH_BOUNDS[kind])
    length = jnp.maximum(last - first, 1).astype(y.dtype)
    return _Parameterisation(kind, shape.width, highest, first.astype(y.dtype), length, log_low, log_high)


# -- fit -----------------------------------------------------------------------------------------------


class _EchoFit(NamedTuple):
    """A fit of some echoes: free parameters, echoes that are in use, chi-squared, and with their cost."""

    free: FreeParameters
    is_active: IsActive
    chi2: Array
    criterion: Array


def _decompose(
    kind: str,
    max_echoes: int,
    power: Array,
    weight: Array,
    step: Array,
    pulse: Array,
    width: Array,
    pulse_error: Array,
) -> Echoes:
    """Decompose one padded record; `weight` is the inverse noise, zero where a sample does not count.

    1. Shape of echoes; weights with the errors of the pulse and of rounding; bounds.
    2. Greedy search: add an echo at the maximum of the matched filter, fit all again, remember the fit with
       the lowest criterion.
    3. Sort the echoes of that fit by time, and compute their standard errors.
    """
    if kind == "gaussian":
        shape = _gaussian_shape(power.size, width / step)
    else:
        shape = _copy_shape(power.size, pulse)
        weight = _weight_with_pulse_error(power, weight, pulse, pulse_error)
    is_used = weight > 0
    log_bins = jnp.log(jnp.maximum(jnp.sum(is_used), 2).astype(power.dtype))
    y = jnp.where(is_used, power, 0.0)
    scale = jnp.maximum(jnp.max(jnp.abs(y)), jnp.finfo(y.dtype).tiny)
    weight = jnp.where(is_used, weight / jnp.sqrt(1.0 + (_ROUNDING * scale * weight) ** 2), 0.0)
    parameters = _parameterisation(kind, shape, y, weight, is_used)

    def model(free: FreeParameters, is_active: IsActive) -> Array:
        amplitude, centre, width = parameters.unpack(free)
        return shape.model(jnp.where(is_active, amplitude, 0.0), centre, width)

    def residual(free: FreeParameters, is_active: IsActive) -> Array:
        return (model(free, is_active) - y) * weight

    def add_echo(fit: _EchoFit, k: Array) -> _EchoFit:
        """Add echo `k` at the maximum of the matched filter, and fit all echoes again."""
        matched, norm = shape.matched_filter(y - model(fit.free, fit.is_active), weight)
        norm = jnp.maximum(norm, jnp.finfo(y.dtype).tiny)
        best = jnp.argmax(jnp.where(is_used, matched / jnp.sqrt(norm), -jnp.inf))
        # Far out the bijections are flat: without the limit, parameters that the fit with one echo less has
        # pushed there would not move any more.
        limits = parameters.restart_limits()
        start = jnp.clip(fit.free, -limits, limits)
        start = start.at[k].set(parameters.start(matched[best] / norm[best], best.astype(y.dtype)))
        is_active = fit.is_active.at[k].set(True)
        fitted = optx.least_squares(
            residual, _SOLVER, start, args=is_active, max_steps=_MAX_STEPS, throw=False
        ).value
        # A fit that fails leaves the echoes where they started; the criterion decides about them as usual.
        free = jnp.where(jnp.all(jnp.isfinite(fitted)), fitted, start)
        chi2 = jnp.sum(residual(free, is_active) ** 2)
        cost = _COST[kind] * (k + 1).astype(y.dtype) * log_bins
        return _EchoFit(free, is_active, chi2, chi2 + cost)

    def give_up(fit: _EchoFit, k: Array) -> _EchoFit:
        return fit._replace(criterion=jnp.full((), jnp.inf, y.dtype))

    def search(
        carry: tuple[_EchoFit, _EchoFit, Array], k: Array
    ) -> tuple[tuple[_EchoFit, _EchoFit, Array], None]:
        latest, best, n_failures = carry
        latest = lax.cond(n_failures < _PATIENCE, add_echo, give_up, latest, k)
        is_better = latest.criterion < best.criterion
        best = jax.tree.map(partial(_select, is_better), latest, best)
        return (latest, best, jnp.where(is_better, 0, n_failures + 1)), None

    chi2_without = jnp.sum((y * weight) ** 2)
    empty = _EchoFit(
        jnp.zeros((max_echoes, 3), y.dtype), jnp.zeros(max_echoes, bool), chi2_without, chi2_without
    )
    carry = (empty, empty, jnp.zeros((), int))
    (_, best, _), _ = lax.scan(search, carry, jnp.arange(max_echoes))

    order = jnp.argsort(jnp.where(best.is_active, best.free[:, 1], jnp.inf))
    free, is_active = best.free[order], best.is_active[order]
    amplitude, centre, width = parameters.unpack(free)
    stderr = _standard_errors(
        shape, parameters, jnp.stack([amplitude, centre, width], axis=1), is_active, weight
    )
    per_sample = jnp.stack([jnp.ones((), y.dtype), step, step])[None, :]
    return Echoes(
        amplitude=jnp.where(is_active, amplitude, 0.0),
        time=jnp.where(is_active, centre * step, 0.0),
        width=jnp.where(is_active, width * step, 0.0),
        stderr=jnp.where(is_active[:, None], stderr * per_sample, 0.0),
        count=jnp.sum(is_active),
        model=model(free, is_active),
        chi2=best.chi2,
        criterion=best.criterion,
    )


def _standard_errors(
    shape: _EchoShape,
    parameters: _Parameterisation,
    values: Float[Array, "echoes 3"],
    is_active: IsActive,
    weight: Array,
) -> Float[Array, "echoes 3"]:
    """Standard errors of amplitude, centre and width, in samples: roots of the diagonal of (J'J)^-1.

    J is the Jacobian of the whitened model with respect to the parameters themselves, not the free ones,
    whose bijections are flat near the bounds. Its columns are scaled to unit length before inversion.
    """
    unit = jnp.stack([parameters.highest, parameters.pulse_width, parameters.pulse_width])[None, :]

    def whitened_model(scaled: Float[Array, "echoes 3"]) -> Array:
        amplitude, centre, width = (scaled * unit).T
        return shape.model(jnp.where(is_active, amplitude, 0.0), centre, width) * weight

    scaled = values / unit
    columns = jax.jacfwd(whitened_model)(scaled).reshape(-1, scaled.size)
    # Parameters without effect have no column; one on their diagonal keeps the normal matrix regular.
    has_effect = jnp.asarray([1.0, 1.0, 0.0 if parameters.kind == "copies" else 1.0], scaled.dtype)
    idle = 1.0 - jnp.where(is_active, 1.0, 0.0)[:, None] * has_effect[None, :]
    columns = columns * (1.0 - idle.reshape(1, -1))
    norm = jnp.sqrt(jnp.sum(columns**2, axis=0))
    norm = jnp.where(norm > 0, norm, 1.0)
    columns = columns / norm[None, :]
    variance = jnp.diagonal(jnp.linalg.pinv(matmul(columns.T, columns) + jnp.diag(idle.reshape(-1))))
    errors = (jnp.sqrt(jnp.maximum(variance, 0.0)) / norm).reshape(-1, 3)
    return jnp.where(idle > 0, 0.0, errors) * unit
