"""Deconvolution of waveforms: the transmitted pulse is taken out.

All functions take single waveforms, (bins,), can be batched with `jax.vmap`, and are differentiable.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from jaxlidar.extend import as_array, check_integer, check_range

Samples = Float[Array, " bins"]


def richardson_lucy(
    power: Float[ArrayLike, " bins"], pulse: Float[ArrayLike, " lags"], *, iterations: int = 50
) -> Samples:
    """Richardson-Lucy deconvolution of a waveform: it conserves energy and is never negative.

    **Arguments:**

    - `power`: (bins,) waveform, background removed. Negative samples, which noise makes, count as zero.
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
    times = check_integer("iterations", iterations)
    check_range("pulse", pulse, 0.0)
    return _richardson_lucy(jnp.maximum(as_array(power), 0.0), _kernel(pulse), times)


@partial(jax.jit, static_argnames="iterations")
def _richardson_lucy(y: Samples, h: Float[Array, " lags"], iterations: int) -> Samples:
    tiny = 1e-6 * jnp.maximum(jnp.max(y), 1e-30)
    # Share of each bin's energy that is recorded: less at the ends.
    seen = jnp.convolve(jnp.ones_like(y), h[::-1], mode="same")

    def better(x: Samples, _: None) -> tuple[Samples, None]:
        ratio = y / jnp.maximum(jnp.convolve(x, h, mode="same"), tiny)
        return x * jnp.convolve(ratio, h[::-1], mode="same") / seen, None

    return lax.scan(better, jnp.full_like(y, jnp.mean(y)), None, length=iterations)[0]


def wiener(
    power: Float[ArrayLike, " bins"], pulse: Float[ArrayLike, " lags"], *, noise_to_signal: float
) -> Samples:
    """Deconvolution of a waveform by a Wiener filter.

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
    y, h = as_array(power), _kernel(pulse)
    n = y.size + h.size - 1
    spectrum = jnp.fft.rfft(h, n)
    gain = jnp.conj(spectrum) / (jnp.abs(spectrum) ** 2 + noise_to_signal)
    # The pulse begins half its length before its time zero.
    begun = jnp.pad(y, ((h.size - 1) // 2, (h.size - 1) // 2))
    return jnp.fft.irfft(jnp.fft.rfft(begun) * gain, n)[: y.size]


def _kernel(pulse: Float[ArrayLike, " lags"]) -> Float[Array, " lags"]:
    h = as_array(pulse)
    check_range("pulse", pulse)
    if h.ndim != 1 or h.size % 2 == 0:
        raise ValueError(f"pulse has the shape {h.shape}; admissible is (lags,) with an odd number of lags")
    return h / jnp.sum(h)
