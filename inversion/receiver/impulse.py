"""Impulse response of a receiver, estimated from hard targets, and pulses without a second sampling.

**Response.** The impulse response r of a receiver is common to its shots. With p_k the pulses and y_k the
echoes of hard flat targets,

    y_k(t) = a_k (r * p_k)(t - t_k) + b_k.

The model is linear in r, and for a given r each shot has two unknowns only. So two steps alternate:

1. For each shot, search the position t_k on a grid of shifts; the best amplitude at each is closed-form,
   a = <m, y> / <m, m> with m the shifted model, and the best shift has the largest <m, y>^2 / <m, m>.
2. Solve the linear least squares for r, with a small ridge; scale r to unit sum.

Residuals are weighted by the noise, and the background b_k is projected out of data and model (variable
projection). Echoes are shifted in the Fourier domain.

**Pulses.** A record holds means over bins. If such samples are taken for the pulse itself, a simulation
smooths it once more (`recorded_pulse`).
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import ArrayLike, Float

from jaxlidar import SampledPulse
from jaxlidar.extend import as_numpy, check_integer, check_range, even_step

# Rounds of positions and response, and the shifts that the first and the later rounds search, in samples
# about the last position.
_ROUNDS = 5
_COARSE_SHIFTS, _FINE_SHIFTS = np.arange(-4.0, 4.01, 0.25), np.arange(-0.3, 0.31, 0.03)
# Ridge over the mean information on a lag: combinations of lags that pulses do not separate stay small.
_RIDGE = 1e-4
# Bins of padding on both sides of a recorded pulse, which its spectrum is taken with.
_PADDING = 2


def recorded_pulse(
    time: ArrayLike | Sequence, power: ArrayLike | Sequence, *, finer: int = 4
) -> SampledPulse:
    """Return the pulse that a simulation records with the samples of a recorded pulse.

    Samples of a record hold the mean over their bin. A `SampledPulse` of them would be smoothed once more,
    because the simulation takes means over bins of the straight lines between them: by 0.5 ns at 1 ns, which
    short pulses show. Here the spectrum of the samples is divided by those of a bin, sinc(f), and of the
    lines between finer samples, sinc(f / finer)^2.

    **Arguments:**

    - `time`: (samples,) ns, in equal steps.
    - `power`: (samples,) background removed, zero at both ends or nearly.
    - `finer`: samples of the pulse in each bin of the record, 1 or more. Default 4.

    **Returns:** a `SampledPulse`; samples that ringing makes negative are zero.

    **Raises:** ValueError for times that are not in equal steps, for power without a positive sample, and as
    `SampledPulse`.

    **Example:**

    >>> import inversion, numpy as np
    >>> time = np.arange(-8.0, 9.0)
    >>> power = np.exp(-0.5 * (time / 1.7) ** 2)
    >>> pulse = inversion.recorded_pulse(time, power)
    >>> samples = np.diff(pulse.cumulative(np.arange(-8.5, 9.0)))
    >>> print(f"{np.max(np.abs(samples / samples.max() - power)):.3f}")
    0.000
    """
    finer = check_integer("finer", finer)
    t, y = as_numpy(time, "time"), as_numpy(power, "power")
    check_range("power", y)
    if t.ndim != 1 or t.shape != y.shape or t.size < 2:
        raise ValueError(
            f"time and power have the shapes {t.shape} and {y.shape}; admissible is (samples,) for both, two "
            "or more"
        )
    step = float(even_step("time", time))
    check_range("largest power", y.max(), 0.0, low_open=True)
    # The scale of a pulse does not matter, but single precision may not hold it.
    padded = np.pad(y / y.max(), _PADDING)
    n_fine = finer * padded.size
    frequency = np.fft.rfftfreq(padded.size)
    smoothing = np.sinc(frequency) * np.sinc(frequency / finer) ** 2
    spectrum = np.fft.rfft(padded) / smoothing
    # Zeros at higher frequencies interpolate between the samples.
    fine_spectrum = np.pad(spectrum, (0, n_fine // 2 + 1 - spectrum.size))
    fine = finer * np.fft.irfft(fine_spectrum, n_fine)
    fine_time = t[0] - _PADDING * step + step / finer * np.arange(n_fine)
    # Ringing before the first bright bin and after the last one is no part of the pulse.
    bright = np.flatnonzero(padded > 0)
    is_inside = fine_time > fine_time[0] + (bright[0] - 1) * step
    is_inside &= fine_time < fine_time[0] + (bright[-1] + 1) * step
    return SampledPulse(fine_time, np.where(is_inside, np.maximum(fine, 0.0), 0.0))


def receiver_impulse(
    pulses: Sequence[Float[np.ndarray, " lags"]],
    echoes: Sequence[Float[np.ndarray, " bins"]],
    *,
    noise: Sequence[Float[np.ndarray, " bins"]],
    before: int = 4,
    after: int = 8,
    interleaved: int = 1,
) -> Float[np.ndarray, " impulse_lags"]:
    """Estimate the receiver's response to an impulse from echoes of hard flat targets and their pulses.

    Targets that are not flat broaden the response. Records do not show a delay that is common to all shots:
    the response has its time zero where echoes are on average at their pulses' time zero.

    **Arguments:**

    - `pulses`: of each shot, (lags,), background removed, time zero at the largest sample.
    - `echoes`: of each shot, (bins,), at the same sampling; any background.
    - `noise`: of each shot, (bins,) standard deviations; infinite for samples without weight.
    - `before`: lags of the response before time zero, 0 or more, in samples. Default 4.
    - `after`: those after it. Default 8.
    - `interleaved`: number of digitisers with offsets of their own. Default 1.

    **Returns:** (2 n + 1,) with time zero in the middle, n the larger of `before` and `after`, of sum
    one, for `Recorder.impulse`. It may be negative.

    **Raises:** ValueError for numbers of pulses, echoes and noises that differ, or are zero, for samples that
    are not finite, for pulses without a positive sample, for noise that is not above 0, of another length
    than its echo, or infinite throughout all echoes, and for echoes without signal.

    **Example:** a receiver with an exponential tail.

    >>> import inversion, numpy as np
    >>> pulse = np.exp(-0.5 * (np.arange(-8.0, 9.0) / 1.7) ** 2)
    >>> tail = np.exp(-np.arange(6.0) / 2.0)
    >>> echo = np.convolve(np.pad(pulse, 20), tail / tail.sum())
    >>> impulse = inversion.receiver_impulse([pulse], [echo], noise=[np.full(echo.size, 1e-3)], before=2)
    >>> model = np.convolve(np.pad(pulse, 20), impulse)
    >>> centroid = lambda power: np.average(np.arange(power.size), weights=power)
    >>> delay = centroid(model) - centroid(echo)
    >>> print(f"peak {model.max() / echo.max():.2f}, later by {delay:.1f} samples")
    peak 1.00, later by 7.0 samples
    """
    if not len(pulses) == len(echoes) == len(noise) > 0:
        raise ValueError(
            f"pulses, echoes and noise are {len(pulses)}, {len(echoes)} and {len(noise)}; admissible are as "
            "many, one or more"
        )
    check_integer("interleaved", interleaved)
    lags = np.arange(-check_integer("before", before, 0), check_integer("after", after, 0) + 1)
    records = {"pulses": pulses, "echoes": echoes, "noise": noise}
    arrays = zip(*([as_numpy(record, name) for record in records[name]] for name in records))
    shots = []
    for pulse, echo, sigma in arrays:
        _check_hard_target(pulse, echo, sigma)
        shots.append(HardTargetEcho(pulse, echo, sigma, interleaved))
    response = np.where(lags == 0, 1.0, 0.0)
    for iteration in range(_ROUNDS):
        rows = []
        for shot in shots:
            shot.locate(lags, response, _COARSE_SHIFTS if iteration == 0 else _FINE_SHIFTS)
            rows.append((shot.amplitude * shot.delayed_pulses(lags), shot.whitened))
        columns, whitened = (np.concatenate(arrays) for arrays in zip(*rows))
        information = columns.T @ columns
        if not np.trace(information) > 0:
            raise ValueError("echoes have no signal like their pulses; admissible is one or more that has")
        ridge = _RIDGE * np.trace(information) / lags.size * np.eye(lags.size)
        response = np.linalg.solve(information + ridge, columns.T @ whitened)
        response = response / np.sum(response)
    # `Recorder.impulse` has time zero in the middle.
    half = max(before, after)
    impulse = np.zeros(2 * half + 1)
    impulse[half - before : half + after + 1] = response
    return impulse


def _check_hard_target(pulse: np.ndarray, echo: np.ndarray, noise: np.ndarray) -> None:
    """Refuse a shot from which no response can be estimated. **Raises:** ValueError."""
    if pulse.ndim != 1 or echo.ndim != 1 or noise.shape != echo.shape or not pulse.size or not echo.size:
        raise ValueError(
            f"pulses, echoes and noise have the shapes {pulse.shape}, {echo.shape} and {noise.shape}; "
            "admissible is (lags,) for a pulse and (bins,) for an echo and its noise"
        )
    check_range("pulses", pulse)
    check_range("echoes", echo)
    check_range("largest sample of pulses", pulse.max(), 0.0, low_open=True)
    check_range("noise", np.where(np.isposinf(noise), 1.0, noise), 0.0, low_open=True)


class HardTargetEcho:
    """Echo of a hard flat target beside its pulse, whitened, with the offsets of digitisers projected out.

    - `position`: of the pulse's time zero in the record, in samples; at first the largest sample's.
    - `amplitude`: of the echo over the pulse.
    - `whitened`: (bins,) echo over its noise, with offsets of the digitisers projected out.
    """

    def __init__(self, pulse: np.ndarray, echo: np.ndarray, noise: np.ndarray, interleaved: int = 1):
        # Long enough that shifted pulses do not wrap around.
        self._size = 2 * (echo.size + pulse.size)
        self._pulse_zero, self._bins = int(np.argmax(pulse)), echo.size
        self._spectrum = np.fft.rfft(pulse, self._size)
        self._omega = 2.0 * np.pi * np.fft.rfftfreq(self._size)
        self._weight = np.where(np.isfinite(noise), 1.0 / noise, 0.0)
        # Samples i, i + n, i + 2 n, ... are those of one digitiser, and share an offset.
        is_of_digitiser = np.arange(echo.size)[:, None] % interleaved == np.arange(interleaved)
        self._offset_basis = np.linalg.qr(is_of_digitiser * self._weight[:, None])[0]
        self._echo = np.asarray(echo, float)
        self.whitened = self._without_offsets(self._echo * self._weight)
        self.position = float(np.argmax(np.where(self._weight > 0, echo, -np.inf)))
        self.amplitude = 1.0

    def _without_offsets(self, columns: np.ndarray) -> np.ndarray:
        return columns - self._offset_basis @ (self._offset_basis.T @ columns)

    def _shift(self, shifts: np.ndarray) -> np.ndarray:
        """(frequencies, shifts) factors that move a pulse to the echo's position plus shifts, in samples."""
        return np.exp(-1j * self._omega[:, None] * (self.position - self._pulse_zero + shifts))

    def _response_spectrum(self, lags: np.ndarray, response: np.ndarray) -> np.ndarray:
        return np.exp(-1j * self._omega[:, None] * lags) @ response

    def _records(self, spectra: np.ndarray) -> np.ndarray:
        """(bins, columns) whitened records of spectra, without offsets."""
        records = np.fft.irfft(spectra, self._size, axis=0)[: self._bins]
        return self._without_offsets(records * self._weight[:, None])

    def delayed_pulses(self, lags: np.ndarray) -> np.ndarray:
        """(bins, lags) whitened pulses at the echo's position plus lags, in samples."""
        return self._records(self._spectrum[:, None] * self._shift(lags))

    def locate(self, lags: np.ndarray, response: np.ndarray, shifts: np.ndarray) -> None:
        """Move the position by the best of the shifts, and set the amplitude, for a response at lags."""
        received = self._response_spectrum(lags, response) * self._spectrum
        models = self._records(received[:, None] * self._shift(shifts))
        matched, norm = self.whitened @ models, np.sum(models**2, axis=0)
        # A shot of infinite noise has neither; its amplitude is then zero.
        norm = np.where(norm > 0, norm, 1.0)
        # A negative match would be an echo of negative amplitude.
        best = int(np.argmax(np.where(matched > 0, matched**2 / norm, 0.0)))
        self.position += float(shifts[best])
        self.amplitude = float(matched[best] / norm[best])

    def fit(self, impulse: np.ndarray) -> tuple[np.ndarray, float]:
        """Fit the echo by a response of an odd number of lags, time zero in the middle, for one digitiser.

        **Returns:** (bins,) the fitted echo without its background, and the background.
        """
        lags = np.arange(impulse.size) - impulse.size // 2
        for shifts in (_COARSE_SHIFTS, _FINE_SHIFTS, _FINE_SHIFTS):
            self.locate(lags, impulse, shifts)
        received = self._response_spectrum(lags, impulse) * self._spectrum
        shifted = received * np.exp(-1j * self._omega * (self.position - self._pulse_zero))
        model = np.fft.irfft(shifted, self._size)[: self._bins]
        columns = np.stack([model, np.ones_like(model)], axis=1) * self._weight[:, None]
        amplitude, background = np.linalg.lstsq(columns, self._echo * self._weight, rcond=None)[0]
        return amplitude * model, float(background)
