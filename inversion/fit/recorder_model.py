r"""Model of a recorder in a fit: its unknowns, the record with its derivatives, and the noise of the pulse.

**Record.** With * the convolution, sample i of a record is

    y_i = scale (r * g * w)(t_i - d) + b_(i mod n) + noise,

with w the simulated waveform, r the receiver's impulse response, g a Gaussian of unknown width, d a delay,
and b_j the offset of digitiser j of n (`inversion.receiver.recorder`). Width, delay, offsets and scale are
unknowns of the fit like those of the scene, so that all standard errors include theirs. They act on w:
nothing is traced or compiled for them.

**Noise of the pulse.** A recorded pulse p has noise e of its own, independent from sample to sample with the
standard deviation sigma_p (`Recorder.pulse_noise` times the pulse's peak), and every return repeats it. With
h the returns of the scene, so that w = h * p, the record contains scale (r * g * h * e). This noise is
correlated over samples as the returns are: its covariance is sigma_p^2 G G^T, with G the convolution matrix
of scale (r * g * h). It is added to the covariances of record and simulation, and the fit whitens its
residuals by the Cholesky factor of the sum. h is estimated by non-negative least squares from the simulated
waveform, one return a sample (Lawson and Hanson 1974, Solving Least Squares Problems).
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy

from inversion.fit.data import (
    ObservedWaveform,
    SampleNoise,
    neighbour_correlation,
    shared_errors_of_samples,
)
from inversion.fit.model import Evaluation, batch_stderr
from inversion.fit.unknowns import MARGIN, BoundUnknown, flat_bounds, flat_start, unknown_outside_scene
from inversion.receiver.recorder import DELAY_NAME, OFFSET_NAME, WIDTH_NAME, ReceiverResponse, Recorder
from jaxlidar import Lidar
from jaxlidar.extend import concrete

# Returns of the scene below this fraction of the strongest one are rounding.
_FAINT = 1e-6


class RecorderValues(NamedTuple):
    """Values of a recorder's unknowns; 0, 0 and 1 for width, delay and scale that are no unknowns."""

    width: Any
    delay: Any
    offsets: Any
    scale: Any


class RecorderModel:
    """Forward model of a recorder in a fit: its unknowns, the record and its derivatives, and its noise.

    The unknowns of the recorder follow those of the scene in every vector of the fit. Their values are
    (width, delay, offsets, scale), without those that the recorder does not have.

    - `unknowns`: the recorder's unknowns.

    **Arguments:** `recorder`: None for one that changes nothing. `scale`: the unknown of the gain, or none.
    `lidar`: with the pulse and the sampling interval. `bins`: samples of the record.
    """

    def __init__(self, recorder: Recorder | None, scale: Sequence[BoundUnknown], lidar: Lidar, bins: int):
        self.recorder = Recorder() if recorder is None else recorder
        interval = float(lidar.sampling_interval)
        self.receiver = ReceiverResponse(self.recorder, bins, interval)
        self.has_scale = bool(scale)
        self.unknowns = [*recorder_unknowns(self.recorder), *scale]
        self.count = sum(unknown.start.size for unknown in self.unknowns)
        # Column j of the offsets' Jacobian is one at the samples of digitiser j.
        digitiser = np.arange(bins)[:, None] % self.recorder.interleaved
        n_offsets = self.recorder.interleaved if self.recorder.offset is not None else 0
        self.offset_columns = (digitiser == np.arange(n_offsets)).astype(float)
        has_pulse_noise = float(self.recorder.pulse_noise) > 0
        self.pulse = _pulse_fractions(lidar, bins, interval) if has_pulse_noise else None

    def _split(self, values: Any) -> RecorderValues:
        """Return values by name, from one vector in the order of `unknowns`."""
        has_width, has_delay = self.recorder.width is not None, self.recorder.delay is not None
        first_offset = int(has_width) + int(has_delay)
        return RecorderValues(
            width=values[0] if has_width else 0.0,
            delay=values[first_offset - 1] if has_delay else 0.0,
            offsets=values[first_offset : self.count - int(self.has_scale)],
            scale=values[-1] if self.has_scale else 1.0,
        )

    def _receive(
        self, waveform: Any, values: RecorderValues, derivative: Literal["width", "delay"] | None = None
    ) -> Any:
        """Return a waveform as received, or its derivative."""
        return self.receiver(waveform, values.width, values.delay, derivative=derivative)

    def __call__(
        self, reflectance: np.ndarray, jacobian: np.ndarray, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Model the record of a simulated waveform.

        **Arguments:** `reflectance`: (wavelengths, bins). `jacobian`: (wavelengths, bins, n), with respect to
        the unknowns of the scene. `values`: of the recorder's unknowns.

        **Returns:** the record, (wavelengths, bins), and its Jacobian with the columns of the recorder's
        unknowns appended, (wavelengths, bins, unknowns).
        """
        by_name = self._split(values)
        scale, received = by_name.scale, self._receive(reflectance, by_name)
        # The response acts along the last axis, which is that of unknowns in a Jacobian.
        scene_columns = np.moveaxis(self._receive(np.moveaxis(jacobian, -1, 0), by_name), 0, -1)
        columns = [scale * scene_columns]
        if self.recorder.width is not None:
            columns.append(scale * self._receive(reflectance, by_name, "width")[..., None])
        if self.recorder.delay is not None:
            columns.append(scale * self._receive(reflectance, by_name, "delay")[..., None])
        columns.append(
            np.broadcast_to(self.offset_columns, (*reflectance.shape, self.offset_columns.shape[-1]))
        )
        if self.has_scale:
            columns.append(received[..., None])
        return self.record(reflectance, values), np.concatenate(columns, axis=-1)

    def record(self, reflectance: Any, values: Any) -> Any:
        """Model the record alone. JAX arrays may be traced and differentiated.

        **Arguments:** as of `__call__`. **Returns:** (wavelengths, bins).
        """
        by_name = self._split(values)
        # No matrix product, which GPUs would round.
        baseline = (self.offset_columns * by_name.offsets[None]).sum(axis=1).reshape(1, -1)
        return by_name.scale * self._receive(reflectance, by_name) + baseline

    def scale_of(self, values: Any) -> Any:
        """Return the scale among the values of the recorder's unknowns; 1 without such an unknown."""
        return self._split(values).scale

    def received(self, batches: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return simulated batches as received and scaled, without offsets."""
        by_name = self._split(values)
        return by_name.scale * self._receive(batches, by_name)

    def start(self, reflectance: np.ndarray, observed: ObservedWaveform | None) -> np.ndarray:
        """Return starting values: those of the unknowns, with offsets and scale fitted to a record.

        `observed`: None if nothing has been recorded.
        """
        if not self.count:
            return np.zeros(0)
        values = flat_start(self.unknowns)
        if observed is None:
            return values
        return self.fit_linear(values, reflectance, observed.reflectance, observed.sigma)

    def sample_noise(
        self,
        observed: ObservedWaveform,
        evaluation: Evaluation,
        values: np.ndarray,
        *,
        with_simulation: bool = True,
    ) -> SampleNoise:
        """Return the noise of the fitted samples: of measurement and pulse, and of a simulation.

        **Arguments:** `evaluation`: the simulation. `values`: of the recorder's unknowns. `with_simulation`:
        count its noise, if it has batches. Default True.
        """
        is_fitted, sigma = observed.is_fitted, observed.sigma[observed.is_fitted]
        if with_simulation and evaluation.batches is not None:
            stderr = batch_stderr(self.received(evaluation.batches, values))
            sigma = np.hypot(sigma, np.broadcast_to(stderr, is_fitted.shape)[is_fitted])
        pulse_errors = self.pulse_noise(evaluation.reflectance, values)
        correlation = neighbour_correlation(float(self.recorder.correlation), is_fitted)
        return SampleNoise(sigma, shared_errors_of_samples(pulse_errors, is_fitted), correlation)

    def fit_linear(
        self, values: np.ndarray, reflectance: np.ndarray, observed: np.ndarray, sigma: np.ndarray
    ) -> np.ndarray:
        """Return the values with offsets and scale, in which the record is linear, fitted to an observation.

        Weighted linear least squares, with columns scaled to unit length; the result is moved to `MARGIN`
        from the bounds of the unknowns if it is closer to them or beyond.

        **Arguments:** `values`: of the recorder's unknowns. `reflectance`, `observed`: (wavelengths, bins)
        simulated waveform and record. `sigma`: noise, infinite for samples without weight.
        """
        linear = np.broadcast_to(self.offset_columns, (*reflectance.shape, self.offset_columns.shape[-1]))
        received = self._receive(reflectance, self._split(values))
        is_used = np.isfinite(sigma)
        # Without the scale, the waveform is subtracted, and only offsets are fitted.
        fixed_record = np.zeros_like(reflectance) if self.has_scale else received
        if self.has_scale:
            linear = np.concatenate([linear, received[..., None]], axis=-1)
        if linear.shape[-1] == 0:
            return values
        columns = linear[is_used] / sigma[is_used, None]
        target = (observed - fixed_record)[is_used] / sigma[is_used]
        norm = np.linalg.norm(columns, axis=0)
        norm = np.where(norm > 0, norm, 1.0)
        fitted = np.linalg.lstsq(columns / norm, target, rcond=None)[0] / norm
        low, high = flat_bounds(self.unknowns)
        margin = MARGIN * (high - low)
        return np.clip(np.append(values[: values.size - fitted.size], fitted), low + margin, high - margin)

    def pulse_noise(self, reflectance: np.ndarray, values: np.ndarray) -> np.ndarray | None:
        """Return the matrix sigma_p G of the noise of the pulse, or None for a pulse without noise.

        1. Returns h of the scene, one a sample: minimise |w - h * p| over h >= 0, with p the fractions of the
           pulse's energy in samples.
        2. Column j of G is the record of a unit error of sample j of the pulse: h delayed, as received.

        **Arguments:** `reflectance`: (wavelengths, bins) simulated waveform. `values`: of the recorder's
        unknowns.

        **Returns:** (wavelengths, bins, lags) change of the record by one standard deviation of each sample
        of the pulse.
        """
        if self.pulse is None:
            return None
        by_name = self._split(values)
        bins, lags = self.receiver.bins, self.pulse.size
        # Returns are placed by the middle of the pulse's energy, which keeps most of an echo in the record.
        middle = int(np.argmax(np.cumsum(self.pulse) >= 0.5))
        pulse_matrix = scipy.linalg.toeplitz(np.r_[self.pulse, np.zeros(bins - 1)], np.zeros(bins))
        unit_echoes = pulse_matrix[middle : middle + bins]
        noise_matrices = []
        for waveform in reflectance:
            # The solver's tolerances are absolute: the waveform is scaled to a peak of one.
            peak = max(float(np.max(waveform)), 1e-300)
            returns = (
                scipy.optimize.nnls(unit_echoes, np.maximum(waveform, 0.0) / peak, maxiter=30 * bins)[0]
                * peak
            )
            returns[returns < _FAINT * peak] = 0.0
            first_row = np.r_[returns[0], np.zeros(lags - 1)]
            delayed = scipy.linalg.toeplitz(np.r_[returns, np.zeros(lags - 1)], first_row)
            noise_matrices.append(self._receive(delayed[middle : middle + bins].T, by_name).T)
        sigma = by_name.scale * float(self.recorder.pulse_noise) * float(np.max(self.pulse))
        return sigma * np.stack(noise_matrices)


def recorder_unknowns(recorder: Recorder) -> list[BoundUnknown]:
    """Return the unknowns of a recorder: width, delay and offset, from the middle of their bounds.

    The first simulation gives the offset a better start (`RecorderModel.fit_linear`).
    """
    shapes = {
        WIDTH_NAME: (recorder.width, ()),
        DELAY_NAME: (recorder.delay, ()),
        OFFSET_NAME: (recorder.offset, () if recorder.interleaved == 1 else (recorder.interleaved,)),
    }
    return [
        unknown_outside_scene(name, bounds, shape)
        for name, (bounds, shape) in shapes.items()
        if bounds is not None
    ]


def check_names(recorder: Recorder | None, unknowns: Sequence[BoundUnknown]) -> None:
    """Refuse unknowns of the scene with names of the recorder's. **Raises:** ValueError."""
    recorder_names = [] if recorder is None else [unknown.name for unknown in recorder_unknowns(recorder)]
    for unknown in unknowns:
        if unknown.name in recorder_names:
            raise ValueError(
                f"name = {unknown.name!r} is taken by the recorder; the unknown needs another one"
            )


def _pulse_fractions(lidar: Lidar, bins: int, interval: float) -> np.ndarray:
    """Return the fractions of the pulse's energy in samples, at most a record's length about time zero."""
    low, high = lidar.pulse.support(lidar.jitter)
    first, last = max(int(np.floor(low / interval)), -bins), min(int(np.ceil(high / interval)), bins)
    edges = interval * (np.arange(first, last + 2) - 0.5)
    fractions = concrete(jnp.diff(lidar.pulse.cumulative(edges, lidar.jitter)))
    assert fractions is not None
    return np.asarray(fractions, float)
