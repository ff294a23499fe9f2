r"""Model of a recorder in a fit: the receiver's response, offsets of digitisers, noise of the pulse.

**Record.** With w the simulated waveform, whose pulse is the recorded one, a record is

    y = scale (r * g * w) + b_(i mod n) + noise,

with r the receiver's impulse response, g a Gaussian of unknown width, and b the offsets of n digitisers that
take samples in turn; one digitiser has a single baseline. Width, offsets and scale are unknowns of the fit
like those of the scene, so that all standard errors include theirs. They act on the simulated waveform:
nothing is traced or compiled for them. The smoothing is done in the Fourier domain, which is exact for
signals that the sampling resolves.

**Noise of the pulse.** A recorded pulse p has noise e of its own, and every return repeats it. With h the
returns of the scene, so that w = h * p, the record contains scale (r * g * h * e). This noise is correlated
over samples as the returns are: its covariance is sigma_p^2 G G^T, with G the convolution matrix of scale
(r * g * h). It is added to the covariances of record and simulation, and the fit whitens its residuals by the
root of the sum. h is estimated by non-negative least squares from the simulated waveform, one return a
sample (Lawson and Hanson 1974, Solving Least Squares Problems).
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
# Returns of the scene below this fraction of the strongest one are rounding.
_FAINT = 1e-6
# Least distance of fitted offsets and scale from their bounds, over the bounds' width: the fit's bijections
# are flat at the bounds.
_MARGIN = 0.01

BoundPair = tuple[float, float]


def _optional_impulse(x: Any) -> Array | None:
    return None if x is None else as_array(x, "impulse")


def _scalar(x: Any) -> Array:
    # Converters of fields are called with one argument.
    return as_scalar(x)


@final
@briefly
class Recorder(eqx.Module):
    """Receiver and digitisers of a recorder, for `retrieve` and `retrieve_many`. Its gain is their `scale`.

    - `width`: (low, high), bounds of a further unknown, "receiver width": standard deviation in ns of the
      Gaussian by which the receiver smooths. It starts at their middle. Default None: no smoothing.
    - `impulse`: (lags,) the receiver's response to an impulse at the record's sampling, an odd number of
      lags with time zero in the middle; its scale does not matter. It may be negative for a receiver
      that overshoots. `receiver_impulse` estimates it. Default None: none.
    - `offset`: (low, high), bounds of a further unknown, "offset", added to the record, in its unit. It
      starts from its least-squares value. Default None: no such unknown.
    - `interleaved`: number of digitisers that take samples in turn, each with its own offset: "offset" then
      has that many values. Default 1: one baseline.
    - `pulse_noise`: standard deviation of the noise of the recorded pulse over its peak, independent from
      sample to sample at the record's sampling, 0 or more. `recorded_pulse` gives a pulse with such noise.
      Default 0.
    - `correlation`: rho of the noise of neighbouring samples, in [0, 1); that of samples n apart is rho^n.
      `noise` of a fit is the standard deviation of each sample. Default 0: independent.

    **Raises:** ValueError for a value outside its range, bounds that are not a pair low < high, an impulse
    with an even number of lags or a sum that is not above 0, and `interleaved` without `offset`.

    **Example:** a baseline that differs between odd and even samples, and a slow receiver.

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> import numpy as np
    >>> truth, start = jl.Scene(ground=jl.Ground(height=0.5)), jl.Scene(ground=jl.Ground())
    >>> wave = jl.simulate(jl.Lidar(jitter=2.0), truth, key=jax.random.key(0), window=(-40.0, 40.0))
    >>> pedestals = np.where(np.arange(wave.time.size) % 2, 0.03, 0.02)
    >>> height = inversion.Unknown("ground.height", bounds=(-2.0, 2.0), name="height")
    >>> recorder = inversion.Recorder(width=(0.1, 5.0), offset=(-0.1, 0.1), interleaved=2)
    >>> options = {"noise": 0.001, "time": wave.time, "key": jax.random.key(1), "scale": (0.1, 10.0)}
    >>> record = np.asarray(wave.reflectance)[0] + pedestals
    >>> fit = inversion.retrieve(record, jl.Lidar(), start, [height], recorder=recorder, **options)
    >>> print(f"{float(fit.values['receiver width']):.1f} ns", fit.values["offset"].round(3))
    2.0 ns [0.02 0.03]
    """

    width: BoundPair | None = eqx.field(static=True, default=None)
    impulse: Float[Array, " lags"] | None = eqx.field(converter=_optional_impulse, default=None)
    offset: BoundPair | None = eqx.field(static=True, default=None)
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
        """Return the record of a simulated waveform at fitted values.

        **Arguments:** `reflectance`: (..., bins), such as one of `Retrievals.fitted`. `values`: by name, as
        fitted; those of the scene are not used. `step`: the sampling interval, ns. Default 1.

        **Returns:** (..., bins) in the unit of the record.
        """
        waveform = np.asarray(reflectance, float)
        bins = waveform.shape[-1]
        width = float(np.asarray(values.get(_WIDTH, 0.0)))
        received = _ReceiverResponse(self, bins, step)(waveform, width)
        # Repeats the offsets of the digitisers along the record.
        offset = np.resize(np.asarray(values.get(_OFFSET, 0.0), float).ravel(), bins)
        return float(np.asarray(values.get("scale", 1.0))) * received + offset


class _ReceiverResponse:
    """Convolution with the receiver's response r * g along the last axis, in the Fourier domain."""

    def __init__(self, recorder: Recorder, bins: int, step: float):
        self.bins = bins
        self.is_identity = recorder.width is None and recorder.impulse is None
        lags = 1 if recorder.impulse is None else recorder.impulse.size
        # Long enough that light smoothed out of the record at one end does not come back at the other.
        self.size = 2 * bins + lags
        self.omega = 2.0 * np.pi * np.fft.rfftfreq(self.size, step)
        self.impulse_spectrum = np.ones(self.omega.size)
        if recorder.impulse is not None:
            samples = np.zeros(self.size)
            samples[:lags] = np.asarray(recorder.impulse, float) / float(jnp.sum(recorder.impulse))
            # Time zero, the middle lag, becomes the first sample of the transform.
            self.impulse_spectrum = np.fft.rfft(np.roll(samples, -(lags // 2)))

    def __call__(self, waveform: np.ndarray, width: float, *, derivative: bool = False) -> np.ndarray:
        """Return the waveform as received, or its derivative with respect to the width.

        The Gaussian of width s has the spectrum exp(-(omega s)^2 / 2), with the derivative -omega^2 s times
        that.
        """
        if self.is_identity:
            return waveform
        phase = self.omega * width
        factor = -phase * self.omega if derivative else 1.0
        spectrum = self.impulse_spectrum * np.exp(-0.5 * phase**2) * factor
        return np.fft.irfft(np.fft.rfft(waveform, self.size) * spectrum, self.size)[..., : self.bins]


class RecordWithJacobian(NamedTuple):
    """A modelled record, (wavelengths, bins), and its Jacobian, (wavelengths, bins, unknowns)."""

    total: np.ndarray
    jacobian: np.ndarray


class RecorderModel:
    """Forward model of a recorder in a fit: its unknowns, the record and its derivatives, and its noise.

    The unknowns of the recorder follow those of the scene in every vector of the fit. Their values are
    (width, offsets, scale), of which any may be missing.

    - `unknowns`: the recorder's unknowns.

    **Arguments:** `recorder`: None for one that changes nothing. `scale`: the unknown of the gain, or none.
    `lidar`: with the pulse and the sampling interval. `bins`: samples of the record.
    """

    def __init__(self, recorder: Recorder | None, scale: Sequence[Settled], lidar: Lidar, bins: int):
        self.recorder = Recorder() if recorder is None else recorder
        step = float(lidar.sampling_interval)
        self.response = _ReceiverResponse(self.recorder, bins, step)
        self.has_scale = bool(scale)
        self.unknowns = [*recorder_unknowns(self.recorder), *scale]
        self.count = sum(unknown.start.size for unknown in self.unknowns)
        # Column j of the offsets' Jacobian is one at the samples of digitiser j.
        digitiser = np.arange(bins)[:, None] % self.recorder.interleaved
        n_offsets = self.recorder.interleaved if self.recorder.offset is not None else 0
        self.offset_columns = (digitiser == np.arange(n_offsets)).astype(float)
        has_pulse_noise = float(self.recorder.pulse_noise) > 0
        self.pulse = _pulse_fractions(lidar, bins, step) if has_pulse_noise else None

    def _split(self, values: np.ndarray) -> tuple[float, np.ndarray, float]:
        """Width, offsets and scale."""
        has_width = self.recorder.width is not None
        # Width first, scale last, offsets in between: the order of `unknowns`.
        offsets = values[int(has_width) : self.count - int(self.has_scale)]
        return (values[0] if has_width else 0.0), offsets, (values[-1] if self.has_scale else 1.0)

    def __call__(self, total: np.ndarray, jacobian: np.ndarray, values: np.ndarray) -> RecordWithJacobian:
        """Model the record of a simulated waveform.

        **Arguments:** `total`: (wavelengths, bins). `jacobian`: (wavelengths, bins, n), with respect to the
        unknowns of the scene. `values`: of the recorder's unknowns.

        **Returns:** the record, and its Jacobian with the columns of the recorder's unknowns appended.
        """
        width, offsets, scale = self._split(values)
        received = self.response(total, width)
        # The response acts along the last axis, which is that of unknowns in a Jacobian.
        scene_columns = np.moveaxis(self.response(np.moveaxis(jacobian, -1, 0), width), 0, -1)
        columns = [scale * scene_columns]
        if self.recorder.width is not None:
            columns.append(scale * self.response(total, width, derivative=True)[..., None])
        columns.append(np.broadcast_to(self.offset_columns, (*total.shape, self.offset_columns.shape[-1])))
        if self.has_scale:
            columns.append(received[..., None])
        record = scale * received + self.offset_columns @ offsets
        return RecordWithJacobian(record, np.concatenate(columns, axis=-1))

    def received(self, batches: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return simulated batches as received and scaled, without offsets."""
        width, _, scale = self._split(values)
        return scale * self.response(batches, width)

    def fit_linear(
        self, values: np.ndarray, total: np.ndarray, observed: np.ndarray, sigma: np.ndarray
    ) -> np.ndarray:
        """Return the values with offsets and scale, in which the record is linear, fitted to an observation.

        Weighted linear least squares, with columns scaled to unit length; the result is kept within the
        bounds of the unknowns.

        **Arguments:** `values`: of the recorder's unknowns. `total`, `observed`: (wavelengths, bins)
        simulated waveform and record. `sigma`: noise, infinite for samples without weight.
        """
        linear = np.broadcast_to(self.offset_columns, (*total.shape, self.offset_columns.shape[-1]))
        received = self.response(total, self._split(values)[0])
        is_used, fixed = np.isfinite(sigma), np.zeros_like(total) if self.has_scale else received
        if self.has_scale:
            linear = np.concatenate([linear, received[..., None]], axis=-1)
        if linear.shape[-1] == 0:
            return values
        columns = linear[is_used] / sigma[is_used, None]
        target = (observed - fixed)[is_used] / sigma[is_used]
        norm = np.linalg.norm(columns, axis=0)
        norm = np.where(norm > 0, norm, 1.0)
        fitted = np.linalg.lstsq(columns / norm, target, rcond=None)[0] / norm
        low, high = (
            np.concatenate([np.ravel(getattr(unknown, end)) for unknown in self.unknowns])
            for end in ("low", "high")
        )
        margin = _MARGIN * (high - low)
        return np.clip(np.append(values[: values.size - fitted.size], fitted), low + margin, high - margin)

    def pulse_noise(self, total: np.ndarray, values: np.ndarray) -> np.ndarray | None:
        """Return the matrix sigma_p G of the noise of the pulse, or None for a pulse without noise.

        1. Returns h of the scene, one a sample: minimise |w - h * p| over h >= 0, with p the fractions of the
           pulse's energy in samples.
        2. Column j of G is the record of a unit error of sample j of the pulse: h delayed, as received.

        **Arguments:** `total`: (wavelengths, bins) simulated waveform. `values`: of the recorder's unknowns.

        **Returns:** (wavelengths, bins, lags) change of the record by one standard deviation of each sample
        of the pulse.
        """
        if self.pulse is None:
            return None
        width, _, scale = self._split(values)
        bins, lags = self.response.bins, self.pulse.size
        # Returns are placed by the middle of the pulse's energy, which keeps most of an echo in the record.
        zero = int(np.argmax(np.cumsum(self.pulse) >= 0.5))
        pulse_matrix = linalg.toeplitz(np.r_[self.pulse, np.zeros(bins - 1)], np.zeros(bins))
        echoes = pulse_matrix[zero : zero + bins]
        noise_matrices = []
        for waveform in total:
            # The solver's tolerances are absolute: the waveform is scaled to a peak of one.
            peak = max(float(np.max(waveform)), 1e-300)
            returns = optimize.nnls(echoes, np.maximum(waveform, 0.0) / peak, maxiter=30 * bins)[0] * peak
            returns[returns < _FAINT * peak] = 0.0
            first_row = np.r_[returns[0], np.zeros(lags - 1)]
            delayed = linalg.toeplitz(np.r_[returns, np.zeros(lags - 1)], first_row)
            noise_matrices.append(self.response(delayed[zero : zero + bins].T, width).T)
        sigma = scale * float(self.recorder.pulse_noise) * float(np.max(self.pulse))
        return sigma * np.stack(noise_matrices)


def recorder_unknowns(recorder: Recorder) -> list[Settled]:
    """Return the unknowns of a recorder, width and offset, starting from the middle of their bounds.

    The first simulation gives the offset a better start (`RecorderModel.fit_linear`).
    """
    # They change no part of the scene.
    outside_scene, unknowns = Place(None, None, "optical"), []
    shapes = {
        _WIDTH: (recorder.width, ()),
        _OFFSET: (recorder.offset, () if recorder.interleaved == 1 else (recorder.interleaved,)),
    }
    for name, (bounds, shape) in shapes.items():
        if bounds is not None:
            low, high = (np.full(shape, end, float) for end in bounds)
            middle = jnp.asarray(0.5 * (low + high))
            unknowns.append(start_from(Settled(name, outside_scene, middle, low, high, None), middle))
    return unknowns


def check_names(recorder: Recorder | None, unknowns: Sequence[Settled]) -> None:
    """Refuse unknowns of the scene with names of the recorder's. **Raises:** ValueError."""
    recorder_names = [] if recorder is None else [unknown.name for unknown in recorder_unknowns(recorder)]
    for unknown in unknowns:
        if unknown.name in recorder_names:
            raise ValueError(
                f"name = {unknown.name!r} is taken by the recorder; the unknown needs another one"
            )


def _check_bounds(field: str, bounds: Any, least: float) -> None:
    try:
        low, high = (float(b) for b in bounds)
    except (TypeError, ValueError):
        raise ValueError(f"{field} = {bounds!r} is not a pair (low, high)") from None
    check_range(field, [low, high], least)
    if not low < high:
        raise ValueError(f"{field} = {bounds!r} is not low < high")


def _pulse_fractions(lidar: Lidar, bins: int, step: float) -> np.ndarray:
    """Fractions of the pulse's energy in samples, from its first to its last, at most a record's length."""
    low, high = lidar.pulse.support(lidar.jitter)
    first, last = max(int(np.floor(low / step)), -bins), min(int(np.ceil(high / step)), bins)
    edges = step * (np.arange(first, last + 2) - 0.5)
    fractions = concrete(jnp.diff(lidar.pulse.cumulative(edges, lidar.jitter)))
    assert fractions is not None
    return np.asarray(fractions, float)
