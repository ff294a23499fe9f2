r"""What a recorder makes of a waveform: the receiver's response, offsets of digitisers, noise of the pulse.

With w the simulated waveform, whose pulse is the recorded one, a record is taken as

    y = scale (r * g * w) + b_(i mod n) + noise,

with r the receiver's impulse response, g a Gaussian of unknown width, and b the offsets of n digitisers that
take samples in turn; one of them has a baseline. Width, offsets and the scale are unknowns of the fit beside
those of the scene, so that their share is in all standard errors. They act on the simulated waveform: nothing
is traced or compiled for them. The smoothing is done in the Fourier domain, which is exact for what its
sampling resolves.

A recorded pulse has noise e of its own, which all that returns of it repeats. With h the returns of the
scene, so that w = h * p, a record holds scale (r * g * h * e): noise that is correlated over samples as the
returns are, with the covariance sigma_p^2 G G^T, G the matrix of scale (r * g * h). It is added to that of
the record and of the simulation, and residuals are whitened by the root of the sum. The returns are those
not negative ones, one a sample, whose echoes are nearest to the simulated waveform.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from scipy import linalg, optimize

from inversion.fit.unknowns import Place, Settled, start_from
from jaxlidar import Lidar
from jaxlidar.extend import as_array, as_scalar, briefly, check_integer, check_range, concrete

_WIDTH, _OFFSET = "receiver width", "offset"
# A scene's returns weaker than this share of the strongest one are rounding.
_FAINT = 1e-6

Pair = tuple[float, float]


def _samples(x: Any) -> Array | None:
    return None if x is None else as_array(x, "impulse")


def _scalar(x: Any) -> Array:
    return as_scalar(x)


@final
@briefly
class Recorder(eqx.Module):
    """What a recorder adds to waveforms, for `retrieve` and `retrieve_many`. Its gain is their `scale`.

    - `width`: (low, high), bounds of a further unknown, "receiver width": standard deviation in ns of the
      Gaussian by which the receiver smooths. It starts at their middle. Default None: no smoothing.
    - `impulse`: (lags,) the receiver's response to an impulse at the record's sampling, an odd number of
      lags with time zero in the middle; its scale does not matter. It may be negative where a receiver
      swings. `receiver_impulse` estimates it. Default None: none.
    - `offset`: (low, high), bounds of a further unknown, "offset", added to the record, in its unit. It
      starts where it fits best. Default None: no such unknown.
    - `interleaved`: number of digitisers that take samples in turn, each with its own offset: "offset" has
      then so many values. Default 1: one baseline.
    - `pulse_noise`: standard deviation of the noise of the recorded pulse over its peak, independent from
      sample to sample at the record's sampling, 0 or more. `recorded_pulse` gives a pulse with such noise.
      Default 0.
    - `correlation`: of the noise of neighbouring samples, in [0, 1); between samples n apart it is its n-th
      power. `noise` of a fit is the standard deviation of each sample. Default 0: independent.

    **Raises:** ValueError for a value outside its range, bounds that are no pair low < high, an impulse with
    an even number of lags or a sum that is not above 0, and `interleaved` without `offset`.

    **Example:** a baseline that differs between odd and even samples, and a slow receiver.

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> import numpy as np
    >>> truth, start = jl.Scene(ground=jl.Ground(height=0.5)), jl.Scene(ground=jl.Ground())
    >>> wave = jl.simulate(jl.Lidar(jitter=2.0), truth, key=jax.random.key(0), window=(-40.0, 40.0))
    >>> pedestals = np.where(np.arange(wave.time.size) % 2, 0.03, 0.02)
    >>> height = inversion.Unknown("ground.height", bounds=(-2.0, 2.0), name="height")
    >>> recorder = inversion.Recorder(width=(0.1, 5.0), offset=(-0.1, 0.1), interleaved=2)
    >>> more = {"noise": 0.001, "time": wave.time, "key": jax.random.key(1), "scale": (0.1, 10.0)}
    >>> record = np.asarray(wave.reflectance)[0] + pedestals
    >>> fit = inversion.retrieve(record, jl.Lidar(), start, [height], recorder=recorder, **more)
    >>> print(f"{float(fit.values['receiver width']):.1f} ns", fit.values["offset"].round(3))
    2.0 ns [0.02 0.03]
    """

    width: Pair | None = eqx.field(static=True, default=None)
    impulse: Float[Array, " lags"] | None = eqx.field(converter=_samples, default=None)
    offset: Pair | None = eqx.field(static=True, default=None)
    interleaved: int = eqx.field(static=True, default=1)
    pulse_noise: Float[Array, ""] = eqx.field(converter=_scalar, default=0.0)
    correlation: Float[Array, ""] = eqx.field(converter=_scalar, default=0.0)

    def __check_init__(self):
        for field, low in (("width", 0.0), ("offset", -np.inf)):
            bounds = getattr(self, field)
            if bounds is not None:
                _check_bounds(field, bounds, low)
        check_integer("interleaved", self.interleaved)
        check_range("pulse_noise", self.pulse_noise, 0.0)
        check_range("correlation", self.correlation, 0.0, 1.0, high_open=True)
        if self.interleaved > 1 and self.offset is None:
            raise ValueError(f"interleaved = {self.interleaved}, but offset = None: bounds of the offsets")
        if self.impulse is not None:
            check_range("impulse", self.impulse)
            if self.impulse.ndim != 1 or self.impulse.size % 2 == 0:
                raise ValueError(
                    f"impulse has the shape {self.impulse.shape}; admissible is (lags,) with an odd number"
                )
            check_range("sum of impulse", jnp.sum(self.impulse), 0.0, low_open=True)

    def recorded(
        self, reflectance: Float[ArrayLike, "... bins"], values: dict[str, Any], *, step: float = 1.0
    ) -> Float[np.ndarray, "... bins"]:
        """The record that fitted values make of a simulated waveform.

        **Arguments:** `reflectance`: (..., bins), such as one of `Retrievals.fitted`. `values`: by name, as
        fitted; those of the scene do not matter. `step`: the sampling interval, ns. Default 1.

        **Returns:** (..., bins) in the unit of the record.
        """
        w = np.asarray(reflectance, float)
        smoothed = _Smoothing(self, w.shape[-1], step)(w, float(np.asarray(values.get(_WIDTH, 0.0))))
        offset = np.resize(np.asarray(values.get(_OFFSET, 0.0), float).ravel(), w.shape[-1])
        return float(np.asarray(values.get("scale", 1.0))) * smoothed + offset


class _Smoothing:
    """The receiver's response, applied along the last axis."""

    def __init__(self, recorder: Recorder, bins: int, step: float):
        self.bins, self.none = bins, recorder.width is None and recorder.impulse is None
        lags = 1 if recorder.impulse is None else recorder.impulse.size
        self.size = 2 * bins + lags
        self.omega = 2.0 * np.pi * np.fft.rfftfreq(self.size, step)
        self.response = np.ones(self.omega.size)
        if recorder.impulse is not None:
            samples = np.zeros(self.size)
            samples[:lags] = np.asarray(recorder.impulse, float) / float(jnp.sum(recorder.impulse))
            self.response = np.fft.rfft(np.roll(samples, -(lags // 2)))

    def __call__(self, w: np.ndarray, width: float, *, slope: bool = False) -> np.ndarray:
        """The waveform as received, or its derivative in the width."""
        if self.none:
            return w
        turned = self.omega * width
        factor = self.response * np.exp(-0.5 * turned**2) * (-turned * self.omega if slope else 1.0)
        return np.fft.irfft(np.fft.rfft(w, self.size) * factor, self.size)[..., : self.bins]


class Recorded(NamedTuple):
    """A simulated waveform as recorded: (wavelengths, bins), and (wavelengths, bins, n) its Jacobian."""

    total: np.ndarray
    jacobian: np.ndarray


class Terms:
    """What the recorder's terms do in a fit: their unknowns, values, derivatives and noise.

    `settled`: the terms' unknowns, the last ones of the fit.
    """

    def __init__(self, recorder: Recorder | None, scale: Sequence[Settled], lidar: Lidar, bins: int):
        self.recorder = Recorder() if recorder is None else recorder
        step = float(lidar.sampling_interval)
        self.smoothing = _Smoothing(self.recorder, bins, step)
        self.scaled = bool(scale)
        self.settled = [*settled_terms(self.recorder), *scale]
        self.count = sum(s.start.size for s in self.settled)
        digitiser = np.arange(bins)[:, None] % self.recorder.interleaved
        columns = self.recorder.interleaved if self.recorder.offset is not None else 0
        self.offsets = (digitiser == np.arange(columns)).astype(float)
        self.pulse = _pulse_of(lidar, bins, step) if float(self.recorder.pulse_noise) > 0 else None

    def _split(self, own: np.ndarray) -> tuple[float, np.ndarray, float]:
        """Width, offsets and scale."""
        has_width = self.recorder.width is not None
        offsets = own[int(has_width) : self.count - int(self.scaled)]
        return (own[0] if has_width else 0.0), offsets, (own[-1] if self.scaled else 1.0)

    def __call__(self, total: np.ndarray, jacobian: np.ndarray, own: np.ndarray) -> Recorded:
        """The record at the terms' values `own`, with all derivatives."""
        width, offsets, scale = self._split(own)
        received = self.smoothing(total, width)
        columns = [scale * np.moveaxis(self.smoothing(np.moveaxis(jacobian, -1, 0), width), 0, -1)]
        if self.recorder.width is not None:
            columns.append(scale * self.smoothing(total, width, slope=True)[..., None])
        columns.append(np.broadcast_to(self.offsets, (*total.shape, self.offsets.shape[-1])))
        if self.scaled:
            columns.append(received[..., None])
        return Recorded(scale * received + self.offsets @ offsets, np.concatenate(columns, axis=-1))

    def received(self, batches: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Simulated batches as recorded, without offsets."""
        width, _, scale = self._split(own)
        return scale * self.smoothing(batches, width)

    def best(self, own: np.ndarray, total: np.ndarray, observed: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """The terms' values with offsets and scale where they fit best, within their bounds."""
        linear = np.broadcast_to(self.offsets, (*total.shape, self.offsets.shape[-1]))
        received = self.smoothing(total, self._split(own)[0])
        used, held = np.isfinite(sigma), np.zeros_like(total) if self.scaled else received
        if self.scaled:
            linear = np.concatenate([linear, received[..., None]], axis=-1)
        if linear.shape[-1] == 0:
            return own
        columns, left = linear[used] / sigma[used, None], (observed - held)[used] / sigma[used]
        size = np.linalg.norm(columns, axis=0)
        size = np.where(size > 0, size, 1.0)
        found = np.linalg.lstsq(columns / size, left, rcond=None)[0] / size
        low, high = (
            np.concatenate([np.ravel(getattr(s, end)) for s in self.settled]) for end in ("low", "high")
        )
        margin = 0.01 * (high - low)
        return np.clip(np.append(own[: own.size - found.size], found), low + margin, high - margin)

    def pulse_noise(self, total: np.ndarray, own: np.ndarray) -> np.ndarray | None:
        """(wavelengths, bins, lags) what one standard deviation of each sample of the pulse does to the
        record, or None where the pulse has no noise."""
        if self.pulse is None:
            return None
        width, _, scale = self._split(own)
        bins, lags = self.smoothing.bins, self.pulse.size
        zero = int(np.argmax(np.cumsum(self.pulse) >= 0.5))
        echoes = linalg.toeplitz(np.r_[self.pulse, np.zeros(bins - 1)], np.zeros(bins))[zero : zero + bins]
        found = []
        for one in total:
            top = max(float(np.max(one)), 1e-300)
            returns = optimize.nnls(echoes, np.maximum(one, 0.0) / top, maxiter=30 * bins)[0] * top
            returns[returns < _FAINT * top] = 0.0
            late = linalg.toeplitz(np.r_[returns, np.zeros(lags - 1)], np.r_[returns[0], np.zeros(lags - 1)])
            found.append(self.smoothing(late[zero : zero + bins].T, width).T)
        return scale * float(self.recorder.pulse_noise) * float(np.max(self.pulse)) * np.stack(found)


def settled_terms(recorder: Recorder) -> list[Settled]:
    """The unknowns of a recorder. Their starts are set after the first simulation, but for the width's."""
    nowhere, found = Place(None, None, "optical"), []
    shapes = {
        _WIDTH: (recorder.width, ()),
        _OFFSET: (recorder.offset, () if recorder.interleaved == 1 else (recorder.interleaved,)),
    }
    for name, (bounds, shape) in shapes.items():
        if bounds is not None:
            low, high = (np.full(shape, end, float) for end in bounds)
            middle = jnp.asarray(0.5 * (low + high))
            found.append(start_from(Settled(name, nowhere, middle, low, high, None), middle))
    return found


def check_names(recorder: Recorder | None, settled: Sequence[Settled]) -> None:
    """Refuse unknowns whose names are those of the recorder's. **Raises:** ValueError."""
    taken = [] if recorder is None else [s.name for s in settled_terms(recorder)]
    for s in settled:
        if s.name in taken:
            raise ValueError(f"name = {s.name!r} is taken by the recorder; the unknown needs another one")


def _check_bounds(field: str, bounds: Any, least: float) -> None:
    try:
        low, high = (float(b) for b in bounds)
    except (TypeError, ValueError):
        raise ValueError(f"{field} = {bounds!r} is not a pair (low, high)") from None
    check_range(field, [low, high], least)
    if not low < high:
        raise ValueError(f"{field} = {bounds!r} is not low < high")


def _pulse_of(lidar: Lidar, bins: int, step: float) -> np.ndarray:
    """Shares of the pulse's energy in samples from its first to its last."""
    low, high = lidar.pulse.support(lidar.jitter)
    first, last = max(int(np.floor(low / step)), -bins), min(int(np.ceil(high / step)), bins)
    edges = step * (np.arange(first, last + 2) - 0.5)
    shares = concrete(jnp.diff(lidar.pulse.cumulative(edges, lidar.jitter)))
    assert shares is not None
    return np.asarray(shares, float)
