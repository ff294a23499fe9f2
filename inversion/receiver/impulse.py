"""The receiver's response, estimated from hard targets, and recorded pulses without a second sampling.

An instrument's response is common to its shots: with p_k the pulses and y_k the echoes of hard targets,

    y_k = a_k (r * p_k)(t - t_k) + b_k,

r is found by linear least squares, places t_k by search, in turn. Echoes are shifted in the Fourier domain.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import ArrayLike, Float

from jaxlidar import SampledPulse
from jaxlidar.extend import check_integer, check_range

# Rounds of shapes and places, and where the first and later ones search, in samples about the last place.
_ROUNDS = 5
_SEARCH = (np.arange(-4.0, 4.01, 0.25), np.arange(-0.3, 0.31, 0.03))
# Of the mean information, added to that on each lag: lags that pulses do not tell apart stay small.
_RIDGE = 1e-4


def recorded_pulse(
    time: ArrayLike | Sequence, power: ArrayLike | Sequence, *, finer: int = 4
) -> SampledPulse:
    """The pulse whose samples, as a simulation records it, are those recorded.

    Samples of a record are taken to hold the mean over their bin. A `SampledPulse` of them is smoothed twice
    by the sampling, as the simulation takes means of what is linear between them: by 0.5 ns at 1 ns, which
    short pulses show. This one has the samples' spectrum less what bins and lines take of it.

    **Arguments:**

    - `time`: (samples,) ns, in equal steps.
    - `power`: (samples,) background removed, zero at both ends or nearly.
    - `finer`: samples of the pulse in each of the record, 1 or more. Default 4.

    **Returns:** a `SampledPulse`; what would be negative by ringing is zero.

    **Raises:** ValueError for times that are not in equal steps, and as `SampledPulse`.

    **Example:**

    >>> import inversion, numpy as np
    >>> time = np.arange(-8.0, 9.0)
    >>> power = np.exp(-0.5 * (time / 1.7) ** 2)
    >>> pulse = inversion.recorded_pulse(time, power)
    >>> samples = np.diff(pulse.cumulative(np.arange(-8.5, 9.0)))
    >>> print(f"{np.max(np.abs(samples / samples.max() - power)):.3f}")
    0.000
    """
    times = check_integer("finer", finer)
    t, y = np.asarray(time, float), np.asarray(power, float)
    check_range("power", y)
    if t.ndim != 1 or t.shape != y.shape or t.size < 2 or not np.allclose(np.diff(t), t[1] - t[0], rtol=1e-3):
        raise ValueError(f"time and power have the shapes {t.shape} and {y.shape}, or uneven steps")
    more, step = 2, (t[-1] - t[0]) / (t.size - 1)
    size = t.size + 2 * more
    frequency = np.fft.rfftfreq(size)
    # A bin's mean, and lines between the finer samples.
    smoothing = np.sinc(frequency) * np.sinc(frequency / times) ** 2
    spectrum = np.fft.rfft(np.pad(y, more)) / smoothing
    fine = times * np.fft.irfft(np.pad(spectrum, (0, (times * size) // 2 + 1 - spectrum.size)), times * size)
    axis = t[0] - more * step + step / times * np.arange(times * size)
    lit = np.flatnonzero(np.pad(y, more) > 0)
    inside = (axis > axis[0] + (lit[0] - 1) * step) & (axis < axis[0] + (lit[-1] + 1) * step)
    return SampledPulse(axis, np.where(inside, np.maximum(fine, 0.0), 0.0))


def receiver_impulse(
    pulses: Sequence[Float[np.ndarray, " lags"]],
    echoes: Sequence[Float[np.ndarray, " bins"]],
    *,
    noise: Sequence[Float[np.ndarray, " bins"]],
    before: int = 4,
    after: int = 8,
    interleaved: int = 1,
) -> Float[np.ndarray, " impulse_lags"]:
    """The receiver's response to an impulse, from echoes of hard flat targets and their pulses.

    Echoes of what is not flat broaden the response. The mean of all places is put where pulses have theirs,
    which no record tells: a delay common to all shots is not seen.

    **Arguments:**

    - `pulses`: of each shot, (lags,), background removed, time zero at the largest sample.
    - `echoes`: of each shot, (bins,), at the same sampling; any background.
    - `noise`: of each shot, (bins,) standard deviations; infinite where samples do not count.
    - `before`: lags of the response before time zero, 0 or more, in samples. Default 4.
    - `after`: those after it. Default 8.
    - `interleaved`: number of digitisers with offsets of their own. Default 1.

    **Returns:** (2 n + 1,) with time zero in the middle, n the larger of `before` and `after`, of sum
    one, for `Recorder.impulse`. It may be negative.

    **Raises:** ValueError where there are not as many pulses, echoes and noises, or none.

    **Example:** a receiver with an exponential tail.

    >>> import inversion, numpy as np
    >>> pulse = np.exp(-0.5 * (np.arange(-8.0, 9.0) / 1.7) ** 2)
    >>> tail = np.exp(-np.arange(6.0) / 2.0)
    >>> echo = np.convolve(np.pad(pulse, 20), tail / tail.sum())
    >>> found = inversion.receiver_impulse([pulse], [echo], noise=[np.full(echo.size, 1e-3)], before=2)
    >>> again = np.convolve(np.pad(pulse, 20), found)
    >>> middle = lambda power: np.average(np.arange(power.size), weights=power)
    >>> print(f"peak {again.max() / echo.max():.2f}, later by {middle(again) - middle(echo):.1f} samples")
    peak 1.00, later by 7.0 samples
    """
    if not len(pulses) == len(echoes) == len(noise) > 0:
        raise ValueError(
            f"pulses, echoes and noise are {len(pulses)}, {len(echoes)} and {len(noise)}; admissible are as "
            "many, one or more"
        )
    check_integer("interleaved", interleaved)
    lags = np.arange(-check_integer("before", before, 0), check_integer("after", after, 0) + 1)
    shots = [Echo(*each, interleaved) for each in zip(pulses, echoes, noise)]
    shape = np.where(lags == 0, 1.0, 0.0)
    for turn in range(_ROUNDS):
        rows = []
        for shot in shots:
            shot.place(lags, shape, _SEARCH[min(turn, 1)])
            rows.append((shot.amplitude * shot.columns(lags), shot.echo))
        columns, left = (np.concatenate(part) for part in zip(*rows))
        information = columns.T @ columns
        ridge = _RIDGE * np.trace(information) / lags.size * np.eye(lags.size)
        shape = np.linalg.solve(information + ridge, columns.T @ left)
        shape = shape / np.sum(shape)
    half = max(before, after)
    found = np.zeros(2 * half + 1)
    found[half - before : half + after + 1] = shape
    return found


class Echo:
    """A pulse and its echo, weighted, without what offsets can explain."""

    def __init__(self, pulse: np.ndarray, echo: np.ndarray, noise: np.ndarray, interleaved: int = 1):
        self.size, self.zero, self.bins = 2 * (echo.size + pulse.size), int(np.argmax(pulse)), echo.size
        self.spectrum = np.fft.rfft(pulse, self.size)
        self.omega = 2.0 * np.pi * np.fft.rfftfreq(self.size)
        self.weight = np.where(np.isfinite(noise), 1.0 / noise, 0.0)
        digitiser = np.arange(echo.size)[:, None] % interleaved == np.arange(interleaved)
        self.basis = np.linalg.qr(digitiser * self.weight[:, None])[0]
        self.received = np.asarray(echo, float)
        self.echo = self._alone(self.received * self.weight)
        self.at, self.amplitude = float(np.argmax(np.where(self.weight > 0, echo, -np.inf))), 1.0

    def _alone(self, columns: np.ndarray) -> np.ndarray:
        return columns - self.basis @ (self.basis.T @ columns)

    def columns(self, lags: np.ndarray) -> np.ndarray:
        """(bins, lags) echoes so many samples after the shot's place."""
        turns = np.exp(-1j * self.omega[:, None] * (self.at - self.zero + lags))
        echoes = np.fft.irfft(self.spectrum[:, None] * turns, self.size, axis=0)[: self.bins]
        return self._alone(echoes * self.weight[:, None])

    def place(self, lags: np.ndarray, shape: np.ndarray, search: np.ndarray) -> None:
        """Find place and amplitude of the echo."""
        turns = np.exp(-1j * self.omega[:, None] * lags) @ shape * self.spectrum
        shifts = np.exp(-1j * self.omega[:, None] * (self.at - self.zero + search))
        echoes = np.fft.irfft(turns[:, None] * shifts, self.size, axis=0)[: self.bins]
        echoes = self._alone(echoes * self.weight[:, None])
        matched, norm = self.echo @ echoes, np.sum(echoes**2, axis=0)
        best = int(np.argmax(np.where(matched > 0, matched**2 / norm, 0.0)))
        self.at, self.amplitude = self.at + float(search[best]), float(matched[best] / norm[best])

    def fitted(self, impulse: np.ndarray) -> tuple[np.ndarray, float]:
        """(bins,) the echo by a response of an odd number of lags, zero in the middle; its background."""
        lags = np.arange(impulse.size) - impulse.size // 2
        for search in (_SEARCH[0], *[_SEARCH[1]] * 2):
            self.place(lags, impulse, search)
        turns = np.exp(-1j * self.omega[:, None] * lags) @ impulse * self.spectrum
        shifted = turns * np.exp(-1j * self.omega * (self.at - self.zero))
        model = np.fft.irfft(shifted, self.size)[: self.bins]
        both = np.stack([model, np.ones_like(model)], axis=1) * self.weight[:, None]
        amplitude, base = np.linalg.lstsq(both, self.received * self.weight, rcond=None)[0]
        return amplitude * model, float(base)
