r"""Response of a receiver, estimated once from the narrowest echoes among many recorded shots.

**Response.** A receiver of limited bandwidth smooths, and recovers slowly from a strong echo:

    r = g * [(1 - f) delta + f e],    e(t) = exp(-t / d) / d for t >= 0,

with g a Gaussian of standard deviation s, f the fraction of the energy in the tail and d its decay time.
Three numbers are determined where a response that is free at every lag rings: the pulse of a spaceborne lidar
is longer than the response. (`receiver_impulse` is for short pulses and hard targets known to be flat.)

**Targets.** Slopes, relief and plants widen echoes, and nothing narrows them. So the shots with the smallest
equivalent width of the echo, sum over peak, relative to that of their pulse, are those of flat open ground.
The width s that they have in common is an upper limit of the receiver's: it contains the relief of the
flattest ground on the way.

**Fit.** With p_k the pulses and y_k the echoes, minimise over s, f, d and the positions t_k

    sum_k sum_i (y_k(i) - a_k (r * p_k)(i - t_k))^2 / (max y_k)^2,

with a_k the best amplitude of each (variable projection; Golub and Pereyra 1973, SIAM J. Numer. Anal. 10,
413). Plants return light before the ground: samples before the echo has risen to half its peak have no
weight.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from jaxlidar.extend import as_numpy, check_number, check_range

# Samples of an echo before and after its peak that are used, and the lags of a pulse about its time zero.
_BEFORE, _AFTER, _LAGS = 40, 160, 64
# Length of the Fourier transforms: shifted echoes do not wrap around into the samples that are used.
_SIZE = 512
# Least peak of an echo over the noise, and fewest echoes that determine a response.
_LEAST_PEAK, _FEWEST = 30.0, 3
# Bounds and start of s in samples, f, and d in samples.
_LOW, _HIGH, _START = (0.05, 0.0, 5.0), (20.0, 0.3, 120.0), (3.0, 0.02, 30.0)
# Lags of the response on both sides of time zero.
_HALF = 160


class ShotResponse(NamedTuple):
    """Response of a receiver to an impulse, common to many shots.

    - `impulse`: (2 n + 1,) at the sampling of the shots, time zero in the middle, of sum one, for
      `Recorder.impulse`.
    - `width`: standard deviation of its smoothing in samples.
    - `tail_fraction`: fraction of the energy in its tail.
    - `tail_decay`: time in samples after which the tail has decayed to 1/e.
    - `shots`: indices of the shots from which it was estimated.

    **Example:** the energy that follows an echo's Gaussian part.

    >>> import inversion, numpy as np
    >>> from inversion.receiver.shot_response import ShotResponse
    >>> response = ShotResponse(np.array([0.0, 0.9, 0.1]), 0.3, 0.1, 1.0, np.arange(3))
    >>> response.tail_fraction
    0.1
    """

    impulse: Float[np.ndarray, " lags"]
    width: float
    tail_fraction: float
    tail_decay: float
    shots: np.ndarray


def shot_response(shots: Sequence[Any], *, fraction: float = 0.1) -> ShotResponse:
    """Estimate the receiver's response from the narrowest echoes among recorded shots.

    One estimate serves all shots of a receiver, such as those of an orbit. Slopes and relief widen echoes:
    the width is an upper limit of the receiver's, the closer the flatter the flattest ground is.

    **Arguments:**

    - `shots`: with `signal` (samples,), background removed, `noise_std`, and `pulse_time` and `pulse_power`
      (lags,) in samples about time zero, as of `jaxlidar.io.read_gedi_l1b`.
    - `fraction`: of the shots with strong echoes, the narrowest part that is used, above 0, at most 1.
      Default 0.1. At least three shots are used.

    **Returns:** a `ShotResponse`.

    **Raises:** ValueError for numbers that are not finite or outside their ranges, and for fewer than three
    shots whose echo rises 30 standard deviations above the noise, at least 40 samples after the first sample
    and 160 before the last.

    **Example:** a receiver that smooths over 3 samples, and flat ground.

    >>> import inversion, numpy as np, types
    >>> lag, time = np.arange(-30.0, 31.0), np.arange(400.0)
    >>> pulse = {"pulse_time": lag, "pulse_power": np.exp(-0.5 * (lag / 6.0) ** 2)}
    >>> signals = [np.exp(-0.5 * ((time - t) ** 2 / (6.0**2 + 3.0**2))) for t in (180.0, 190.3, 200.7)]
    >>> shots = [types.SimpleNamespace(signal=y, noise_std=1e-3, **pulse) for y in signals]
    >>> response = inversion.shot_response(shots, fraction=1.0)
    >>> print(f"{response.width:.2f} samples, {response.tail_fraction:.2f} in the tail")
    3.00 samples, 0.00 in the tail
    """
    check_number("fraction", fraction, 0.0, 1.0, low_open=True)
    strong, relative_width = _strong_echoes(shots)
    count = max(_FEWEST, round(float(fraction) * len(strong)))
    if len(strong) < _FEWEST:
        raise ValueError(
            f"shots have {len(strong)} echoes that are {_LEAST_PEAK:g} times the noise and far enough from "
            f"the record's ends; admissible are {_FEWEST} or more"
        )
    narrowest = np.asarray(strong)[np.argsort(relative_width)[:count]]
    echoes, spectra = (np.stack(rows) for rows in zip(*(_echo_and_spectrum(shots[i]) for i in narrowest)))
    width, tail_fraction, tail_decay = _fit_response(echoes, spectra)
    impulse = np.fft.irfft(_response_spectrum(width, tail_fraction, tail_decay), _SIZE)
    impulse = np.concatenate([impulse[-_HALF:], impulse[: _HALF + 1]])
    return ShotResponse(impulse / impulse.sum(), width, tail_fraction, tail_decay, narrowest)


def _strong_echoes(shots: Sequence[Any]) -> tuple[list[int], list[float]]:
    """Return the indices of shots with a strong echo, and its width over that of the pulse."""
    indices, widths = [], []
    for i, shot in enumerate(shots):
        signal = as_numpy(shot.signal, "signal")
        check_range("signal", signal)
        peak = int(np.argmax(signal))
        noise = float(as_numpy(shot.noise_std, "noise_std"))
        check_number("noise_std", noise, 0.0, low_open=True)
        is_inside = peak >= _BEFORE and peak + _AFTER < signal.size
        if not is_inside or signal[peak] < _LEAST_PEAK * noise:
            continue
        pulse = _pulse(shot)
        near = signal[peak - _BEFORE : peak + _AFTER + 1]
        indices.append(i)
        widths.append(float(near.sum() / near.max() * pulse.max() / pulse.sum()))
    return indices, widths


def _pulse(shot: Any) -> np.ndarray:
    """Return the transmitted pulse at whole samples from its time zero."""
    time, samples = as_numpy(shot.pulse_time, "pulse_time"), as_numpy(shot.pulse_power, "pulse_power")
    check_range("pulse_time", time)
    check_range("pulse_power", samples)
    power = np.interp(np.arange(-_LAGS, _LAGS + 1.0), time, samples, left=0.0, right=0.0)
    check_number("largest pulse_power", float(power.max()), 0.0, low_open=True)
    return power


def _echo_and_spectrum(shot: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return an echo over its peak, and the spectrum of its pulse with time zero at the echo's peak."""
    peak = int(np.argmax(shot.signal))
    echo = np.asarray(shot.signal, float)[peak - _BEFORE : peak + _AFTER + 1]
    pulse = _pulse(shot)
    padded = np.zeros(_SIZE)
    padded[: pulse.size] = pulse / pulse.sum()
    return echo / echo.max(), np.fft.rfft(np.roll(padded, _BEFORE - _LAGS))


def _response_spectrum(width: Any, tail_fraction: Any, tail_decay: Any) -> np.ndarray:
    """Return the spectrum of the response r at the frequencies of the transforms."""
    omega = 2.0 * np.pi * np.fft.rfftfreq(_SIZE)
    tail = tail_fraction / (1.0 + 1j * omega * tail_decay)
    return np.exp(-0.5 * (omega * width) ** 2) * (1.0 - tail_fraction + tail)


def _fit_response(echoes: np.ndarray, spectra: np.ndarray) -> tuple[float, float, float]:
    """Return width, tail fraction and tail decay of the response that echoes have in common.

    **Arguments:** `echoes`: (shots, samples) over their peaks. `spectra`: (shots, frequencies) of pulses.
    """
    shots, samples = echoes.shape
    omega = 2.0 * np.pi * np.fft.rfftfreq(_SIZE)
    number = np.arange(samples)
    # The last sample before the peak that is below half of it: plants may lie before.
    rise = _BEFORE - np.argmax(echoes[:, _BEFORE::-1] < 0.5, axis=1)
    weight = np.where(number >= rise[:, None], 1.0, 0.0)

    def residuals(x: np.ndarray) -> np.ndarray:
        shift = np.exp(-1j * omega * x[3:, None])
        model = np.fft.irfft(spectra * shift * _response_spectrum(*x[:3]), _SIZE, axis=1)[:, :samples]
        model = model * weight
        amplitude = np.sum(model * echoes, axis=1) / np.sum(model**2, axis=1)
        return (amplitude[:, None] * model - weight * echoes).ravel()

    # A position moves the residuals of its own shot only: all positions share one difference quotient.
    of_position = scipy.sparse.kron(scipy.sparse.eye(shots), np.ones((samples, 1)))
    sparsity = scipy.sparse.hstack([np.ones((shots * samples, 3)), of_position])
    low, high = np.r_[_LOW, np.full(shots, -30.0)], np.r_[_HIGH, np.full(shots, 30.0)]
    # Squares of residuals below 2 % of the peak, magnitudes above: a shot with plants does not decide alone.
    fit = scipy.optimize.least_squares(
        residuals,
        np.r_[_START, np.zeros(shots)],
        bounds=(low, high),
        x_scale="jac",
        jac_sparsity=sparsity,
        loss="soft_l1",
        f_scale=0.02,
    )
    return float(fit.x[0]), float(fit.x[1]), float(fit.x[2])
