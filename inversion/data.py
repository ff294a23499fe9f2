"""Checked observations: waveforms, their sample times and their noise."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxlidar import Lidar, Waveform
from jaxlidar.extend import check_range


class Data(NamedTuple):
    """Observed apparent reflectance and its standard deviation; infinite where a sample is left out."""

    time: Float[np.ndarray, " bins"]
    observed: Float[np.ndarray, "wavelengths bins"]
    sigma: Float[np.ndarray, "wavelengths bins"]

    @property
    def used(self) -> np.ndarray:
        """Which samples are fitted."""
        return np.isfinite(self.sigma)


def data_of(observed: object, time: object, noise: object, floor: float, lidar: Lidar) -> Data:
    """Read and check the observations passed to `retrieve`. **Raises:** ValueError where inadmissible."""
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
    t = time_axis(time, lidar)
    y = _array("observed", observed)
    if y.ndim == 1:
        y = y[None, :]
    shape = (lidar.wavelength.size, t.size)
    if y.shape != shape:
        raise ValueError(f"observed has the shape {y.shape}; admissible is (wavelengths, bins) = {shape}")
    sigma = _array("noise", noise)
    try:
        sigma = np.broadcast_to(sigma, shape).copy()
    except ValueError:
        raise ValueError(f"noise has the shape {sigma.shape}, which does not broadcast to {shape}") from None
    if not np.all(sigma >= 0):
        bad = sigma[~(sigma >= 0)].flat[0]
        raise ValueError(f"noise = {bad:g} is outside the admissible range [0, inf]")
    used = np.isfinite(sigma)
    if not np.any(used):
        raise ValueError("noise is infinite throughout, which leaves no sample to fit")
    check_range("observed", y[used])
    check_range("noise_floor", floor, 0.0, 1.0)
    peak = np.max(np.abs(np.where(used, y, 0.0)), axis=1, keepdims=True)
    sigma = np.maximum(sigma, floor * peak)
    if not np.all(sigma > 0):
        raise ValueError(
            f"noise = 0 with noise_floor = {floor:g} and a largest observed value of {float(peak.min()):g}; "
            "admissible is a noise above 0"
        )
    return Data(t, np.where(used, y, 0.0), sigma)


def _array(field: str, x: object) -> np.ndarray:
    try:
        return np.asarray(x, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{field} = {x!r} is no array of numbers") from None


def time_axis(time: object, lidar: Lidar) -> Float[np.ndarray, " bins"]:
    """Sample times in double precision. **Raises:** ValueError unless they lie a sampling interval apart."""
    t = _array("time", time)
    if t.ndim != 1 or t.size == 0 or not np.all(np.isfinite(t)):
        raise ValueError(f"time has the shape {t.shape}; admissible is (bins,), finite, one bin or more")
    interval = float(lidar.sampling_interval)
    slack = 1e-3 * interval + 4e-7 * float(np.max(np.abs(t)))
    if np.max(np.abs(t - t[0] - interval * np.arange(t.size))) > slack:
        steps = np.diff(t)
        worst = steps[np.argmax(np.abs(steps - interval))]
        raise ValueError(
            f"time has a step of {worst:g} ns; admissible is the lidar's sampling_interval, {interval:g} ns"
        )
    return t
