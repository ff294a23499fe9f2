r"""Deconvolution of waveforms: removal of the transmitted pulse.

A waveform is y = h * x + noise, with h the pulse of unit sum and x the target's response.

**Richardson-Lucy** maximises the likelihood of y under Poisson noise, with x >= 0, by the iteration

    x <- x / s [h~ * (y / (h * x))],    h~(i) = h(-i),    s = h~ * 1,

from an even start. s is one except near the ends of the record, where a part of the light of a bin is not
recorded (Richardson 1972; Lucy 1974).

**Wiener** minimises the mean square error of a linear estimate for stationary signal and noise. In the
Fourier domain, with n the ratio of the power spectra of noise and signal,

    X = Y H* / (|H|^2 + n)

(Wiener 1949). All functions take single waveforms, (bins,), can be batched with `jax.vmap`, and are
differentiable.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from jaxlidar.extend import check_integer, check_range, concrete
from jaxlidar.survey.records import divide_by_largest

# Least model of a sample that one is divided by, over the largest sample of the waveform.
_LEAST_MODEL = 1e-6

Samples = Float[Array, " bins"]


def richardson_lucy(
    power: Float[ArrayLike, " bins"], pulse: Float[ArrayLike, " lags"], *, iterations: int = 50
) -> Samples:
    """Deconvolve a waveform by Richardson-Lucy, which conserves energy and is never negative.

    **Arguments:**

    - `power`: (bins,) waveform, background removed. Negative samples, due to noise, count as zero.
    - `pulse`: (lags,) transmitted pulse at the waveform's sampling, an odd number of samples with time zero
      in the middle, not negative; its scale does not matter.
    - `iterations`: 1 or more. More of them resolve more and amplify noise. Default 50.

    **Returns:** (bins,) the deconvolved waveform, in units of `power`.

    **Raises:** ValueError for inadmissible arguments.

    **Source:** Richardson (1972), J. Opt. Soc. Am. 62, 55; Lucy (1974), Astron. J. 79, 745.

    **Example:**

    >>> import inversion, numpy as np
    >>> pulse = np.exp(-0.5 * (np.arange(-12.0, 13.0) / 3.0) ** 2)
    >>> target = np.where(np.arange(60) == 30, 1.0, 0.0)
    >>> power = np.convolve(target, pulse / pulse.sum(), mode="same")
    >>> sharp = inversion.richardson_lucy(power, pulse)
    >>> print(f"peak {power[30]:.2f} to {float(sharp[30]):.2f}, energy {float(sharp.sum()):.2f}")
    peak 0.13 to 0.38, energy 1.00
    """
    iterations = check_integer("iterations", iterations)
    check_range("pulse", pulse, 0.0)
    y, magnitude = _scaled_waveform(power)
    sharp = _richardson_lucy(jnp.maximum(y, 0.0), _unit_pulse(pulse), iterations)
    return sharp * jnp.asarray(magnitude, sharp.dtype)


@partial(jax.jit, static_argnames="iterations")
def _richardson_lucy(y: Samples, h: Float[Array, " lags"], iterations: int) -> Samples:
    recorded_fraction = _convolve(jnp.ones_like(y), h[::-1])
    # Light of a bin whose pulse lies outside the record is not recorded at all, and stays at its start.
    is_recorded = recorded_fraction > 0
    divisor = jnp.where(is_recorded, recorded_fraction, 1.0)

    def iterate(x: Samples, _: None) -> tuple[Samples, None]:
        ratio = y / jnp.maximum(_convolve(x, h), _LEAST_MODEL)
        return jnp.where(is_recorded, x * _convolve(ratio, h[::-1]) / divisor, x), None

    return lax.scan(iterate, jnp.full_like(y, jnp.mean(y)), None, length=iterations)[0]


def wiener(
    power: Float[ArrayLike, " bins"], pulse: Float[ArrayLike, " lags"], *, noise_to_signal: float
) -> Samples:
    """Deconvolve a waveform by a Wiener filter.

    **Arguments:**

    - `power`: (bins,) waveform, background removed.
    - `pulse`: (lags,) as for `richardson_lucy`, but of any sign.
    - `noise_to_signal`: power of the noise over that of the signal, above 0, the same at all frequencies.

    **Returns:** (bins,) the deconvolved waveform, in units of `power`; it may be negative.

    **Raises:** ValueError for inadmissible arguments.

    **Source:** Wiener (1949), Extrapolation, Interpolation, and Smoothing of Stationary Time Series.

    **Example:**

    >>> import inversion, numpy as np
    >>> pulse = np.exp(-0.5 * (np.arange(-12.0, 13.0) / 3.0) ** 2)
    >>> target = np.where(np.arange(60) == 30, 1.0, 0.0)
    >>> power = np.convolve(target, pulse / pulse.sum(), mode="same")
    >>> sharp = inversion.wiener(power, pulse, noise_to_signal=1e-4)
    >>> print(f"peak {power[30]:.2f} to {float(sharp[30]):.2f}")
    peak 0.13 to 0.32
    """
    check_range("noise_to_signal", noise_to_signal, 0.0, low_open=True)
    (y, magnitude), h = _scaled_waveform(power), _unit_pulse(pulse)
    return _wiener(y, h, noise_to_signal) * jnp.asarray(magnitude, y.dtype)


@jax.jit
def _wiener(y: Samples, h: Float[Array, " lags"], noise_to_signal: Array) -> Samples:
    """Deconvolve a record `y` by a pulse `h` of unit sum."""
    # The size of the full convolution of record and pulse: the transforms do not wrap around.
    size = y.size + h.size - 1
    spectrum = jnp.fft.rfft(h, size)
    gain = jnp.conj(spectrum) / (jnp.abs(spectrum) ** 2 + noise_to_signal)
    # The first lag of the pulse lies half its length before time zero, and so does the padded record's start.
    padded = jnp.pad(y, ((h.size - 1) // 2, (h.size - 1) // 2))
    return jnp.fft.irfft(jnp.fft.rfft(padded) * gain, size)[: y.size]


def _convolve(y: Samples, h: Float[Array, " lags"]) -> Samples:
    """Convolve a record with a pulse, time zero in the middle, also one longer than the record."""
    return jnp.convolve(y, h, mode="full")[h.size // 2 : h.size // 2 + y.size]


def _scaled_waveform(power: ArrayLike) -> tuple[Samples, Array | np.ndarray]:
    """Check one waveform and return it over its largest magnitude, and that. **Raises:** ValueError."""
    if np.ndim(power) != 1 or np.size(power) == 0:
        raise ValueError(
            f"power has the shape {np.shape(power)}; admissible is (bins,): use jax.vmap for many"
        )
    return divide_by_largest(power, "power")


def _unit_pulse(pulse: Float[ArrayLike, " lags"]) -> Float[Array, " lags"]:
    """Check a pulse and scale it to unit sum. **Raises:** ValueError for even lags, or a sum of 0."""
    check_range("pulse", pulse)
    if np.ndim(pulse) != 1 or np.size(pulse) % 2 == 0:
        raise ValueError(
            f"pulse has the shape {np.shape(pulse)}; admissible is (lags,) with an odd number of lags, the "
            "middle "
            "one at the pulse's time zero: pad one end with zeros"
        )
    h, _ = divide_by_largest(pulse, "pulse")
    total = concrete(jnp.sum(h))
    if total == 0:
        raise ValueError("sum of pulse = 0; admissible is a pulse with energy")
    return h / jnp.sum(h)
