r"""Observed waveforms and their noise.

The difference of a record and its simulation has the covariance

    C = S (R + B B^T) S,   S = diag(sigma),

with sigma the standard deviation of each sample's separate error, R the correlation of these errors between
samples, and S B the errors common to several samples, such as those of a noisy recorded pulse: column k is
the change of the record by one standard deviation of common error k. sigma holds the noise of record and
simulation; R is applied to both, which is an approximation. With R + B B^T = L L^T (Cholesky), L^-1 S^-1
whitens differences: it makes them independent and of unit variance.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float

from inversion.fit.planning import sample_times
from jaxlidar import Lidar, Plan, Waveform
from jaxlidar.extend import as_numpy, check_kind, check_range


class ObservedWaveform(NamedTuple):
    """Observed apparent reflectance and its standard deviation, infinite for samples that are left out."""

    time: Float[np.ndarray, " bins"]
    reflectance: Float[np.ndarray, "wavelengths bins"]
    sigma: Float[np.ndarray, "wavelengths bins"]

    @property
    def is_fitted(self) -> np.ndarray:
        """(wavelengths, bins) True for samples that are fitted."""
        return np.isfinite(self.sigma)


class SampleNoise(NamedTuple):
    """Noise of the fitted samples, of record and simulation: see the module.

    - `sigma_unshared`: (samples,) standard deviation of each sample's separate error.
    - `shared_errors`: (samples, errors) change of the samples by one standard deviation of each error that
      they share, or None.
    - `correlation`: (samples, samples) of the separate errors between samples, or None if there is none.
    """

    sigma_unshared: Float[np.ndarray, " samples"]
    shared_errors: Float[np.ndarray, "samples errors"] | None = None
    correlation: Float[np.ndarray, "samples samples"] | None = None

    @property
    def sigma(self) -> Float[np.ndarray, " samples"]:
        """Standard deviation of the samples, shared errors included."""
        if self.shared_errors is None:
            return self.sigma_unshared
        return np.sqrt(self.sigma_unshared**2 + np.sum(self.shared_errors**2, axis=1))

    def whiten(self, x: Float[np.ndarray, "samples ..."]) -> Float[np.ndarray, "samples ..."]:
        """Return differences, or columns of them, made independent and of unit variance."""
        scaled = self._over_sigma(x)
        if self._is_diagonal:
            return scaled
        # Differences that are not finite, where a simulation failed, pass through: the solver rejects them.
        return scipy.linalg.solve_triangular(self._cholesky, scaled, lower=True, check_finite=False)

    def times_precision(self, x: Float[np.ndarray, "samples ..."]) -> Float[np.ndarray, "samples ..."]:
        """Return C^-1 times differences, or columns of them."""
        whitened = self.whiten(x)
        if not self._is_diagonal:
            whitened = scipy.linalg.solve_triangular(self._cholesky, whitened, lower=True, trans=1)
        return self._over_sigma(whitened)

    @property
    def _is_diagonal(self) -> bool:
        return self.shared_errors is None and self.correlation is None

    @property
    def _cholesky(self) -> Float[np.ndarray, "samples samples"]:
        """Cholesky factor of the covariance over sigma_unshared."""
        scaled_covariance = np.eye(self.sigma_unshared.size) if self.correlation is None else self.correlation
        if self.shared_errors is not None:
            shared = self._over_sigma(self.shared_errors)
            scaled_covariance = scaled_covariance + shared @ shared.T
        return np.linalg.cholesky(scaled_covariance)

    def _over_sigma(self, x: Float[np.ndarray, "samples ..."]) -> Float[np.ndarray, "samples ..."]:
        # Rows are samples; x may have any number of columns.
        return x / self.sigma_unshared.reshape(-1, *(1,) * (x.ndim - 1))


def neighbour_correlation(
    correlation: float, is_fitted: Bool[np.ndarray, "wavelengths bins"]
) -> Float[np.ndarray, "samples samples"] | None:
    """Return the correlation matrix of the fitted samples, or None for a correlation of 0.

    Samples of one wavelength that are n bins apart have `correlation` ** n; wavelengths are independent.
    """
    if correlation == 0:
        return None
    wavelength, sample = np.nonzero(is_fitted)
    distance = np.abs(sample[:, None] - sample)
    return np.where(wavelength[:, None] == wavelength, correlation**distance, 0.0)


def shared_errors_of_samples(
    errors: Float[np.ndarray, "wavelengths bins errors"] | None,
    is_fitted: Bool[np.ndarray, "wavelengths bins"],
) -> Float[np.ndarray, "samples all_errors"] | None:
    """Return the shared errors of the fitted samples; those of different wavelengths are independent."""
    if errors is None:
        return None
    # Errors of one wavelength are zero at the samples of the others.
    return np.asarray(scipy.linalg.block_diag(*(e[fitted] for e, fitted in zip(errors, is_fitted))))


def with_fixed_window(lidar: Lidar) -> Lidar:
    """Return the lidar with a fixed recording window: the samples of a record lie at known times."""
    check_kind("lidar", lidar, Lidar, "a Lidar")
    # A window that opens at the first return would move with the scene during a fit.
    if not lidar.opens_at_first_return:
        return lidar
    return dataclasses.replace(lidar, receiver=dataclasses.replace(lidar.receiver, window="fixed"))


def as_observed(
    observed: object,
    time: object,
    noise: object,
    *,
    noise_floor: float,
    lidar: Lidar,
    has_offset: bool,
) -> ObservedWaveform:
    """Read and check one record of a `Problem`.

    `has_offset`: True for a record with offsets of digitisers, which are no signal.

    1. Take times and reflectances from a `Waveform`, or from arrays.
    2. Leave out samples of infinite noise.
    3. Raise the noise of the others to the floor.

    **Raises:** ValueError if the observation is inadmissible.
    """
    if isinstance(observed, Waveform):
        if time is not None:
            raise ValueError("time is given, but observed is a Waveform, which has its own")
        if observed.wavelength.shape != lidar.wavelength.shape or not np.allclose(
            observed.wavelength, lidar.wavelength
        ):
            raise ValueError(
                f"observed has the wavelengths {np.asarray(observed.wavelength).tolist()}, but the lidar "
                f"{np.asarray(lidar.wavelength).tolist()}; they must agree"
            )
        time, observed = observed.time, observed.reflectance
    elif time is None:
        raise ValueError("time = None, but observed is an array: its sample times are needed")
    t = as_sample_times(time, lidar)
    y = as_numpy(observed, "observed")
    # The axis of a single wavelength may be left out.
    if y.ndim == 1:
        y = y[None, :]
    shape = (lidar.wavelength.size, t.size)
    if y.shape != shape:
        raise ValueError(f"observed has the shape {y.shape}; admissible is (wavelengths, bins) = {shape}")
    sigma = as_noise(noise, shape)
    # Written so that NaN is refused.
    if not np.all(sigma >= 0):
        inadmissible = sigma[~(sigma >= 0)].flat[0]
        raise ValueError(f"noise = {inadmissible:g} is outside the admissible range [0, inf]")
    is_fitted = np.isfinite(sigma)
    if not np.any(is_fitted):
        raise ValueError("noise is infinite throughout, which leaves no sample to fit")
    check_range("observed", y[is_fitted])
    check_range("noise_floor", noise_floor, 0.0, 1.0)
    # The simulation's standard error is zero in bins that no photon reached: with a record without noise,
    # their weight would be infinite. The floor also replaces stated noise below it.
    signal = np.where(is_fitted, y, 0.0)
    if has_offset:
        # The offset itself is fitted later; most samples of a record lie at it.
        medians = [np.median(row[used]) if np.any(used) else 0.0 for row, used in zip(y, is_fitted)]
        signal = np.where(is_fitted, y - np.array(medians)[:, None], 0.0)
    peak = np.max(np.abs(signal), axis=1, keepdims=True)
    sigma = np.maximum(sigma, noise_floor * peak)
    if not np.all(sigma > 0):
        raise ValueError(
            f"noise = 0 with noise_floor = {noise_floor:g} and a largest observed value of "
            f"{float(peak.min()):g}; admissible is a noise above 0"
        )
    # Samples that are left out may be NaN, which a weight of zero would not remove.
    return ObservedWaveform(t, np.where(is_fitted, y, 0.0), sigma)


def nothing_observed(plan: Plan, noise: object, lidar: Lidar) -> ObservedWaveform:
    """Return the samples of a plan with their noise, before anything has been recorded there.

    **Raises:** ValueError for noise that is not above 0.
    """
    time = sample_times(plan)
    sigma = as_positive_noise(noise, (lidar.wavelength.size, time.size))
    return ObservedWaveform(time, np.zeros(sigma.shape), sigma)


def as_noise(noise: object, shape: tuple[int, ...]) -> np.ndarray:
    """Return standard deviations of this shape. **Raises:** ValueError for one that does not broadcast."""
    sigma = as_numpy(noise, "noise")
    try:
        # A copy: a broadcast array cannot be written.
        return np.broadcast_to(sigma, shape).copy()
    except ValueError:
        raise ValueError(f"noise has the shape {sigma.shape}, which does not broadcast to {shape}") from None


def as_positive_noise(noise: object, shape: tuple[int, ...]) -> np.ndarray:
    """Return the same. **Raises:** ValueError as well for noise that is not above 0."""
    sigma = as_noise(noise, shape)
    # Written so that NaN is refused.
    is_refused = ~(sigma > 0)
    if np.any(is_refused):
        raise ValueError(f"noise = {sigma[is_refused].flat[0]:g} is outside the admissible range (0, inf]")
    return sigma


def as_sample_times(time: object, lidar: Lidar) -> Float[np.ndarray, " bins"]:
    """Return sample times in double precision.

    **Raises:** ValueError unless they lie a sampling interval apart.
    """
    t = as_numpy(time, "time")
    if t.ndim != 1 or t.size == 0 or not np.all(np.isfinite(t)):
        raise ValueError(f"time has the shape {t.shape}; admissible is (bins,), finite, one bin or more")
    interval = float(lidar.sampling_interval)
    # Times may have been stored in single precision: a few units in the last place of the largest are
    # allowed.
    tolerance = 1e-3 * interval + 4e-7 * float(np.max(np.abs(t)))
    if np.max(np.abs(t - t[0] - interval * np.arange(t.size))) > tolerance:
        steps = np.diff(t)
        worst_step = steps[np.argmax(np.abs(steps - interval))]
        raise ValueError(
            f"time has a step of {worst_step:g} ns; admissible is the lidar's sampling_interval, "
            f"{interval:g} ns"
        )
    return t
