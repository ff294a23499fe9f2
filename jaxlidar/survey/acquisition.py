"""`Acquisition`: the properties of a survey's shots and pulse that discrete returns need beside waveforms."""

from typing import final

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from jaxlidar._constants import PLANCK_TIMES_LIGHT
from jaxlidar._fields.checks import concrete_array, concrete_number
from jaxlidar.results.datasets import keep_as_netcdf
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.receiver import Receiver
from jaxlidar.sensors.survey import Survey

# Samples of the pulse per sample of the digitiser: crossings of a level are interpolated between them.
PULSE_OVERSAMPLING = 8
# Most samples of the pulse: those of a pulse of 100 us at 0.1 ns.
_MAX_PULSE_SAMPLES = 1_000_000


@final
class Acquisition(eqx.Module):
    """Times, scan angles, flight lines and ranges of shots, and the pulse and radiometry that they share.

    - `gps_time`: (shots,) s; NaN where the survey has none.
    - `scan_angle`: (shots,) degrees to the right of the track; the zenith angle where the survey has none.
    - `flight_line`: (shots,) number of the flight line; 1 where the survey has none.
    - `range_at_time_zero`: (shots,) m from the sensor, from which light arrives at time zero: that of the
      reference plane along the beam, or zero for shots that are placed by their sensors, but for the error
      of a measured range (`Survey.disturbed`).
    - `pulse`: (lags,) fraction of an echo's energy that a sample records, by the sample's time after the
      echo's time zero, in steps of an eighth of the sampling interval. The middle one is at time zero.
    - `radiometric_constant`: (wavelengths,) J m2: the energy of a return is this times its apparent
      reflectance over its squared range.
    - `noise`: (wavelengths,) J per sample, standard deviation of what the receiver records without signal:
      electronic noise, photon noise of the background, and rounding to the steps of the digitiser.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> line = {"start": (0, 0), "end": (0, 10), "speed": 50.0, "pulse_rate": 10.0}
    >>> survey = jl.Survey.scan(jl.Lidar(), jl.Oscillating(20.0, 1.0), **line, gps_time=3.2e8)
    >>> many = jl.simulate_many(survey, jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    >>> print(many.acquisition.gps_time[:2], many.acquisition.scan_angle.round(1))
    [3.2e+08 3.2e+08] [ 0.  11.8 19. ]
    """

    gps_time: Float[np.ndarray, " shots"]
    scan_angle: Float[np.ndarray, " shots"]
    flight_line: Int[np.ndarray, " shots"]
    range_at_time_zero: Float[np.ndarray, " shots"]
    pulse: Float[np.ndarray, " lags"]
    radiometric_constant: Float[np.ndarray, " wavelengths"]
    noise: Float[np.ndarray, " wavelengths"]


# In files, an acquisition is a group of its own beside the waveforms.
keep_as_netcdf(
    Acquisition,
    "acquisition of the shots of a survey",
    {
        "gps_time": ("s", "GPS time: seconds of the week, or adjusted standard GPS time"),
        "scan_angle": ("degree", "angle of the beam to the right of the track"),
        "flight_line": ("1", "number of the flight line"),
        "range_at_time_zero": ("m", "range from which light arrives at time zero"),
        "pulse": ("1", "fraction of an echo that a sample records, by time from the echo's time zero"),
        "radiometric_constant": ("J m2", "energy times squared range per apparent reflectance"),
        "noise": ("J", "standard deviation of a sample that the receiver records without signal"),
    },
    dimensions={"shots": "shot", "wavelengths": "wavelength", "lags": "lag"},
)


def acquisition_of(survey: Survey) -> Acquisition:
    """Return the acquisition of all shots of a survey."""
    shots, range_at_time_zero = len(survey), survey.slant_range
    if survey.has_sensor_position:
        range_at_time_zero = survey.stated_rows[:, 5]
    unknown_time = np.full(shots, np.nan)
    return Acquisition(
        gps_time=unknown_time if survey.gps_time is None else survey.gps_time,
        scan_angle=survey.zenith if survey.scan_angle is None else survey.scan_angle,
        flight_line=np.ones(shots, int) if survey.flight_line is None else survey.flight_line,
        range_at_time_zero=range_at_time_zero,
        pulse=sampled_pulse(survey.lidar),
        radiometric_constant=radiometric_constant(survey.lidar),
        noise=noise_without_signal(survey.lidar),
    )


def sampled_pulse(lidar: Lidar) -> Float[np.ndarray, " lags"]:
    """Return the system's pulse as the digitiser samples it, jitter included; see `Acquisition.pulse`."""
    jitter, interval = concrete_number(lidar.jitter), concrete_number(lidar.sampling_interval)
    step = interval / PULSE_OVERSAMPLING
    start, end = lidar.pulse.support(jitter)
    # One sample more at each end records nothing: the pulse begins and ends within the lags.
    half = int(np.ceil((max(-start, end, 0.0) + 0.5 * interval) / step)) + 1
    if 2 * half + 1 > _MAX_PULSE_SAMPLES:
        raise ValueError(
            f"the pulse lasts {2 * half + 1} steps of {step:g} ns; admissible are {_MAX_PULSE_SAMPLES}"
        )
    # Edges of samples: those of lag i are the half intervals before and after it.
    half_sample = PULSE_OVERSAMPLING // 2
    edges = step * np.arange(-half - half_sample, half + half_sample + 1)
    cumulative = np.asarray(lidar.pulse.cumulative(edges, jitter), float)
    return np.maximum(cumulative[PULSE_OVERSAMPLING:] - cumulative[:-PULSE_OVERSAMPLING], 0.0)


def radiometric_constant(lidar: Lidar) -> Float[np.ndarray, " wavelengths"]:
    """Return E_t eta A_r / pi in J m2 by wavelength (see `jaxlidar.spectral.waveform`)."""
    energy, efficiency = (
        concrete_array(a) for a in (lidar.energy_per_wavelength, lidar.efficiency_per_wavelength)
    )
    return energy * efficiency * concrete_number(lidar.aperture_area) / np.pi


def noise_without_signal(lidar: Lidar) -> Float[np.ndarray, " wavelengths"]:
    """Return `Acquisition.noise` of a lidar; zero for a photon counter, which records no samples."""
    receiver, wavelengths = lidar.receiver, concrete_array(lidar.wavelength)
    variance = np.zeros(wavelengths.shape)
    if isinstance(receiver, Receiver):
        variance += concrete_number(receiver.electronic_noise) ** 2
        if receiver.photon_noise:
            variance += PLANCK_TIMES_LIGHT / wavelengths * concrete_number(receiver.background)
        if receiver.bits is not None and receiver.saturation is not None:
            # The variance of a number that is uniform within a step.
            variance += (concrete_number(receiver.saturation) / (2**receiver.bits - 1)) ** 2 / 12.0
    return np.sqrt(variance)
