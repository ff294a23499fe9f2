"""Checked observations: waveforms, their sample times and their noise."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxlidar import Lidar, Waveform
from jaxlidar.extend import check_kind, check_numbers, check_range


class Data(NamedTuple):
    """Observed apparent reflectance and its standard deviation; infinite where a sample is left out."""

    time: Float[np.ndarray, " bins"]
    observed: Float[np.ndarray, "wavelengths bins"]
    sigma: Float[np.ndarray, "wavelengths bins"]

    @property
    def used(self) -> np.ndarray:
        """Which samples are fitted."""
        return np.isfinite(self.sigma)


def at_fixed_times(lidar: Lidar) -> Lidar:
    """The lidar without what opens its recording window: samples lie at given times."""
    check_kind("lidar", lidar, Lidar, "a Lidar")
    return dataclasses.replace(lidar, receiver=dataclasses.replace(lidar.receiver, window="fixed"))


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
    y = numbers("observed", observed)
    if y.ndim == 1:
        y = y[None, :]
    shape = (lidar.wavelength.size, t.size)
    if y.shape != shape:
        raise ValueError(f"observed has the shape {y.shape}; admissible is (wavelengths, bins) = {shape}")
    sigma = noise_of(noise, shape)
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


def noise_of(noise: object, shape: tuple[int, ...]) -> np.ndarray:
    """Standard deviations of this shape. **Raises:** ValueError for what does not broadcast to it."""
    sigma = numbers("noise", noise)
    try:
        return np.broadcast_to(sigma, shape).copy()
    except ValueError:
        raise ValueError(f"noise has the shape {sigma.shape}, which does not broadcast to {shape}") from None


def numbers(field: str, x: Any) -> np.ndarray:
    """An array in double precision. **Raises:** TypeError for no numbers, ValueError for ragged rows."""
    check_numbers(field, x)
    try:
        return np.asarray(x, dtype=float)
    except ValueError:
        raise ValueError(f"{field} has rows of different lengths; admissible is a regular array") from None


def time_axis(time: object, lidar: Lidar) -> Float[np.ndarray, " bins"]:
    """Sample times in double precision. **Raises:** ValueError unless they lie a sampling interval apart."""
    t = numbers("time", time)
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
