"""Writer of simulated waveforms in the layout of GEDI's level 1B product, for the tools that read it.

Datasets without a counterpart in a simulation are left out: the orbit and the history of processing. Standard
errors, and corrections for tides and the atmosphere, are zero. The extended Gaussian of the transmitted pulse
(`tx_eg...`: a Gaussian convolved with an exponential) has the area, variance and skewness of the pulse.
"""

import dataclasses
import datetime
import functools
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fields.checks import (
    check_choice,
    check_integer,
    check_key,
    check_kind,
    check_number,
    check_numbers,
    check_range,
    check_shape,
    checked_array,
    concrete_number,
    required_for,
)
from jaxlidar._fields.crs import common_system, directions_of_north, metric_system, transform
from jaxlidar._fingerprint import version_of
from jaxlidar.formats.checks import MAX_COUNTS
from jaxlidar.formats.coordinates import GEOGRAPHIC
from jaxlidar.formats.files import atomic_write
from jaxlidar.formats.gedi import BEAMS
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.receiver import Receiver
from jaxlidar.sensors.survey import Survey
from jaxlidar.spectral.waveform import Waveform, energy_at_reference

# Digits of shot numbers: orbit, beam (2), reserved (3) and number within the orbit (8).
_ORBIT_DIGIT, _BEAM_DIGIT = 10**13, 10**11
# Shots per second of one beam.
_SHOT_RATE = 242.0
# The transmitted pulse: samples, pedestal, and counts of its largest sample above the pedestal.
_PULSE_SAMPLES, _PULSE_PEDESTAL, _PULSE_PEAK = 128, 250.0, 1000.0
# Datasets of geophysical corrections.
_CORRECTIONS = (
    "dynamic_atmosphere_correction",
    "geoid",
    "tide_earth",
    "tide_load",
    "tide_ocean",
    "tide_ocean_pole",
    "tide_pole",
)
# Samples of `rx_offset`; the others up to the first one received are those of `rx_open`.
_RX_OFFSET = 1000
# Least time constant of the extended Gaussian over the pulse's standard deviation: symmetric ones have none.
_MIN_TIME_CONSTANT = 0.05
# Standard deviation in bins of the Gaussian that the product smooths with, and half of its length.
_SMOOTHING_STD, _SMOOTHING_HALF_LENGTH = 1.7, 8
# Admissible difference of the sampling interval from 1 ns, which single precision rounds.
_STEP_TOLERANCE = 1e-3
# Numbers of bins are stored in 16 bits.
_MAX_BINS = 2**16 - 1
# Shots that are written at once.
_BLOCK = 256
# Admissible differences between the lidar of waveforms and that of a survey: of angles in degrees, and of
# altitude, wavelength and the cosine of the zenith angle as fractions. The last one shifts a sample 100 m
# above the plane by 1 mm.
_MAX_TURN, _MAX_RELATIVE_DIFFERENCE, _MAX_COSINE_DIFFERENCE = 1e-4, 1e-6, 1e-5


def write_gedi_l1b(
    path: str | os.PathLike[str],
    waveforms: Any,
    survey: Survey,
    *,
    origin: tuple[float, float] | None = None,
    crs: str | None = None,
    elevation: ArrayLike | Sequence = 0.0,
    beam: str | Sequence[str] | np.ndarray = "BEAM0101",
    shot_number: Sequence[int] | np.ndarray | None = None,
    margin: int = 200,
    gain: float = 50_000.0,
    noise_mean: float = 240.0,
    noise_std: float = 3.0,
    solar_elevation: ArrayLike | Sequence = -90.0,
    key: PRNGKeyArray | None = None,
) -> None:
    """Write simulated shots as a GEDI L1B file, which the product's own tools and `read_gedi_l1b` read.

    The file has a group for each beam that has shots. Bins have the elevation of `Waveform.height`, and
    `tx_gloc` is time zero of the lidar's pulse, so that what `read_gedi_l1b` gives fits what was simulated.
    Where the pulse is not symmetric, the product would have the centre of a Gaussian fit there.

    **Arguments:**

    - `path`: the HDF5 file to write. It appears when it is complete. Missing folders are created.
    - `waveforms`: the `Waveforms` of `jaxlidar.simulate_many`, a list of such whose shots follow one another,
      or a list of one `Waveform` for each shot, of one wavelength and samples of 1 ns. Their `recorded`
      energies are written.
    - `survey`: the `Survey` that was simulated; `Survey.of(lidar)` for one waveform.
    - `origin`: longitude and latitude of x = y = 0 in degrees, where y is north. Positions are those of the
      azimuthal equidistant projection about it.
    - `crs`: in place of `origin`, the projected coordinate reference system of the survey's positions, in
      metres, such as "EPSG:32633". Azimuths are turned from its grid's north to true north. Default None:
      that of the survey.
    - `elevation`: that of the reference plane z = 0 above the WGS-84 ellipsoid in m, one number or (shots,).
      Default 0.
    - `beam`: one of the product's eight, such as "BEAM0000", for all shots or for each. Shots lie in the file
      beam after beam. Default "BEAM0101".
    - `shot_number`: (shots,) unique whole numbers. Default None: numbers of the product's form, of orbit 1.
    - `margin`: bins without light that are added above and below the simulated ones, 0 or more; tools
      estimate the noise from them. Default 200, 30 m.
    - `gain`: counts of a sample per apparent reflectance of it, positive: energies are related to that of a
      Lambertian target at the reference plane. Default 50,000: ground of reflectance 0.35 gives 17,500 counts
      over all samples, as in recorded full-power beams.
    - `noise_mean`: counts without light, 0 or more. The receiver's background comes in addition. Default 240.
    - `noise_std`: standard deviation of the noise in counts before the product's smoothing, 0 or more, as
      `noise_stddev_corrected` has it. Default 3.
    - `solar_elevation`: of the sun in degrees, one number or (shots,), by which tools tell day from night.
      Default -90: night.
    - `key`: a JAX random key: normal noise is added, smoothed as recorded noise is (a standard deviation of
      0.41 `noise_std`). Default None: no noise is added to `recorded`.

    **Returns:** nothing.

    **Raises:** ImportError without h5py or pyproj, which the extra `io` installs. TypeError for things of
    another kind. ValueError for several wavelengths, samples that are not 1 ns apart, waveforms of another
    survey, an unknown beam or `crs`, neither or both of `origin` and `crs`, and numbers outside their ranges.
    OSError for a path that cannot be written.

    **Warns:** UserWarning where the transformation from `crs` to WGS-84 has an accuracy that is coarser than
    0.1 m or unknown.

    **Source:** GEDI L1B product data dictionary (Dubayah et al. 2020, doi:10.5067/GEDI/GEDI01_B.002).

    **Example:**

    >>> import pathlib, tempfile
    >>> import jax, numpy as np, jaxlidar as jl
    >>> lidar = jl.Lidar(altitude=4e5, pulse=jl.GaussianPulse(fwhm=15.6), divergence=0.0625, aperture=0.8)
    >>> wave = jl.simulate(lidar, jl.Scene(ground=jl.Ground(height=5.0)), key=jax.random.key(0))
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "simulated.h5"
    >>> place = {"origin": (14.42, 50.08), "elevation": 300.0}
    >>> jl.io.write_gedi_l1b(path, [wave], jl.Survey.of(lidar), **place)
    >>> (shot,) = jl.io.read_gedi_l1b(path)
    >>> print(shot.beam, f"{shot.latitude:.2f}, {np.average(shot.elevation, weights=shot.signal):.2f} m")
    BEAM0101 50.08, 305.00 m
    """
    with required_for("writing GEDI files"):
        import h5py
    check_kind("survey", survey, Survey, "a Survey, such as Survey.of(lidar)")
    margin = check_integer("margin", margin, 0)
    parts = _parts(waveforms)
    first_time, bins = _spans(parts, survey, margin)
    shots = len(survey)
    plane_elevation = checked_array("elevation", elevation, (shots,), one_for_all=True)
    beams = np.array([beam] * shots if isinstance(beam, str) else list(beam))
    check_shape("beam", beams, (shots,))
    for name in np.unique(beams):
        check_choice("beam", str(name), tuple(BEAMS))
    check_number("gain", gain, 0.0, low_open=True)
    check_number("noise_mean", noise_mean, 0.0)
    check_number("noise_std", noise_std, 0.0)
    sun = checked_array("solar_elevation", solar_elevation, (shots,), -90.0, 90.0, one_for_all=True)
    if key is not None:
        check_key(key)
    per_joule = gain / _energy_per_reflectance(survey)
    check_kind("receiver", survey.lidar.receiver, Receiver, "a Receiver: GEDI digitises")
    assert isinstance(survey.lidar.receiver, Receiver)
    background = concrete_number(survey.lidar.receiver.background)
    pulse, pulse_zero = _transmitted_pulse(survey.lidar)
    columns = {
        "shot_number": _shot_numbers(shot_number, beams),
        "noise_mean_corrected": noise_mean + per_joule * background,
        "noise_stddev_corrected": np.full(shots, float(noise_std)),
        "rx_sample_count": bins.astype(np.uint16),
        "stale_return_flag": np.zeros(shots, np.uint8),
        "tx_gloc": np.full(shots, pulse_zero, np.float32),
        "tx_sample_count": np.full(shots, pulse.size, np.uint16),
        **{name: np.full(shots, value) for name, value in _extended_gaussian(pulse, pulse_zero).items()},
        "tx_egflag": np.ones(shots, np.uint8),
        "tx_pulseflag": np.ones(shots, np.uint8),
    }
    if origin is not None and survey.crs is not None:
        raise ValueError(
            f"origin = {origin} is given with survey.crs = {survey.crs!r}; admissible is either: "
            "positions of a coordinate reference system are not about an origin"
        )
    if origin is None:
        crs = common_system({"survey": survey.crs, "crs": crs})
    projection = _projection(origin, crs)
    geolocation = _geolocation(survey, first_time, bins, plane_elevation, projection)
    geolocation["solar_elevation"] = sun.astype(np.float32)
    # Samples of 1 ns from the transmission to the first received one; the second number has 16 bits.
    first_sample = np.rint(2e9 * geolocation["bounce_time_offset_bin0"] + pulse_zero).astype(np.int64)
    rx_offset = np.minimum(first_sample, _RX_OFFSET)
    columns["rx_offset"] = rx_offset.astype(np.uint16)
    columns["rx_open"] = (first_sample - rx_offset).astype(np.uint32)
    digitiser = _Digitiser(
        recorded=[
            row for part in parts for row in (part.recorded[:, 0] if _is_survey(part) else part.recorded)
        ],
        per_joule=per_joule,
        noise_mean=noise_mean,
        noise_std=noise_std,
        key=key,
        bins=bins,
        margin=margin,
        background=background,
    )
    with atomic_write(path) as draft, h5py.File(draft, "w") as file:
        _write_description(file, Path(path).name)
        for name in BEAMS:
            (indices,) = np.nonzero(beams == name)
            # Tools take a group for a beam with shots.
            if indices.size == 0:
                continue
            beam_columns = {field: column[indices] for field, column in columns.items()}
            group = _write_beam(file, name, beam_columns)
            group["txwaveform"] = np.tile(pulse, indices.size)
            _write_received(group, digitiser, indices)
            geolocation_group = group.create_group("geolocation")
            for field, column in geolocation.items():
                geolocation_group[field] = column[indices]
            for field in ("delta_time", "shot_number"):
                geolocation_group[field] = group[field][:]
            corrections = group.create_group("geophys_corr")
            corrections["delta_time"] = group["delta_time"][:]
            for field in _CORRECTIONS:
                corrections[field] = np.zeros(indices.size, np.float32)


def _write_beam(file: Any, name: str, columns: dict[str, np.ndarray]) -> Any:
    """Write the group of a beam but for its waveforms and their geolocation, and return it."""
    channel, is_full_power = BEAMS[name]
    group = file.create_group(name)
    group.attrs["description"] = _attribute(f"{'Full power' if is_full_power else 'Coverage'} beam")
    shots = len(columns["shot_number"])
    for field, column in columns.items():
        group[field] = column
    group["beam"] = np.full(shots, int(name[-4:], 2), np.uint16)
    group["channel"] = np.full(shots, channel, np.uint8)
    group["delta_time"] = delta_time = np.arange(shots) / _SHOT_RATE
    group["master_int"], group["master_frac"] = delta_time.astype(np.uint32), delta_time % 1.0
    for kind in ("rx", "tx"):
        count = columns[f"{kind}_sample_count"].astype(np.uint64)
        # The product counts samples from 1.
        group[f"{kind}_sample_start_index"] = np.cumsum(count, dtype=np.uint64) - count + np.uint64(1)
    return group


def _write_received(group: Any, digitiser: "_Digitiser", indices: np.ndarray) -> None:
    """Write the received waveforms of a beam's shots, some at a time, and their energies."""
    starts = group["rx_sample_start_index"][:].astype(int) - 1
    received = group.create_dataset("rxwaveform", (int(digitiser.bins[indices].sum()),), np.float32)
    energy, total = np.zeros((2, indices.size))
    for start in range(0, indices.size, _BLOCK):
        block = slice(start, start + _BLOCK)
        waveforms = digitiser.counts(indices[block])
        samples = np.concatenate(waveforms)
        received[starts[start] : starts[start] + samples.size] = samples
        noise_mean = group["noise_mean_corrected"][block]
        total[block] = [waveform.sum(dtype=float) for waveform in waveforms]
        energy[block] = total[block] - digitiser.bins[indices[block]] * noise_mean
    group["rx_energy"] = energy
    group["all_samples_sum"] = np.rint(np.clip(total, 0, np.iinfo(np.uint32).max)).astype(np.uint32)


@dataclasses.dataclass(frozen=True)
class _Digitiser:
    """The digitiser of all shots, counts = `noise_mean` + `per_joule` * energy + noise.

    - `recorded`: energies of each shot, J, without a margin.
    - `per_joule`: (shots,) counts per J.
    - `noise_mean`, `noise_std`: counts. `key`: of the noise; None for none.
    - `bins`: (shots,) number of bins, of which `margin` at either end have only the `background`, J.
    """

    recorded: Sequence[Any]
    per_joule: np.ndarray
    noise_mean: float
    noise_std: float
    key: Any
    bins: np.ndarray
    margin: int
    background: float

    def counts(self, shots: np.ndarray) -> list[np.ndarray]:
        """Return the counts of shots, (bins,) each."""
        max_bins = int(self.bins.max())
        noise = np.zeros((shots.size, max_bins))
        if self.key is not None:
            noise = self.noise_std * np.asarray(_smooth_noise(self.key, jnp.asarray(shots), max_bins), float)
        return [self._shot_counts(int(i), row[: self.bins[i]]) for i, row in zip(shots, noise)]

    def _shot_counts(self, i: int, noise: np.ndarray) -> np.ndarray:
        energy = np.asarray(self.recorded[i], float)
        check_range(f"recorded of shot {i}", energy)
        energy = np.pad(energy, self.margin, constant_values=self.background)
        counts = self.noise_mean + self.per_joule[i] * energy + noise
        if np.abs(counts).max() > MAX_COUNTS:
            raise ValueError(
                f"gain: shot {i} has {np.abs(counts).max():g} counts; admissible are up to {MAX_COUNTS:g}"
            )
        return counts.astype(np.float32)


def _is_survey(waves: Any) -> bool:
    """Return True for the `Waveforms` of a survey, which this package does not import."""
    return hasattr(waves, "position")


def _parts(waveforms: Any) -> list[Any]:
    """Return the `Waveforms`, or the `Waveform`s, of which waveforms consist. **Raises:** TypeError."""
    if _is_survey(waveforms):
        return [waveforms]
    check_kind("waveforms", waveforms, Sequence, "the Waveforms of simulate_many, or a list of Waveform")
    for i, part in enumerate(waveforms):
        if not _is_survey(part):
            check_kind(f"waveforms {i}", part, Waveform, "a Waveform, or Waveforms")
    return list(waveforms)


def _spans(parts: list[Any], survey: Survey, margin: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the time of the first bin in ns, and the number of bins, of each shot.

    **Raises:** as `write_gedi_l1b`.
    """
    if survey.altitude is None or np.ptp(survey.altitude) > 0:
        placed = "by their sensors" if survey.altitude is None else "at several altitudes"
        raise ValueError(
            f"survey: its shots are placed {placed}; admissible is one altitude, as an orbit has"
        )
    counts = [len(part) if _is_survey(part) else 1 for part in parts]
    if sum(counts) != len(survey):
        raise ValueError(f"{sum(counts)} waveforms are of a survey of {len(survey)} shots; give its own")
    lidar, spans, end = _lidar_of(survey), [], 0
    for i, (part, count) in enumerate(zip(parts, counts)):
        name = "waveforms" if _is_survey(part) and len(parts) == 1 else f"waveforms {i}"
        start, end = end, end + count
        if _is_survey(part) and not np.array_equal(part.position, survey.position[start:end]):
            raise ValueError(f"{name}: they have another position than the shots of the survey")
        spans += [_span(part, name, margin)] * count
        _check_lidar(part, name, lidar)
        if _is_survey(part):
            _check_directions(part, name, survey.subset(slice(start, end)))
        else:
            _check_zenith(part, name, float(survey.zenith[start]))
    first_times, bins = zip(*spans)
    return np.array(first_times), np.array(bins)


def _lidar_of(survey: Survey) -> Lidar:
    """Return the lidar of the first shot, at the altitude that all shots share."""
    lidar = survey[0]
    assert isinstance(lidar, Lidar)
    return lidar


def _check_lidar(waves: Any, name: str, lidar: Lidar) -> None:
    """Refuse waveforms of a lidar of another altitude or wavelength than the survey's.

    Waveforms made by `waveform_of`, and those in files of earlier versions, do not have their altitude.
    """
    altitude = waves.info.get("altitude")
    pairs: dict[str, Any] = {"wavelength": (waves.wavelength, lidar.wavelength, "nm")}
    if altitude is not None:
        pairs["altitude"] = (altitude, lidar.altitude, "m")
    for quantity, (of_waves, of_survey, unit) in pairs.items():
        simulated, expected = (float(np.asarray(value).flat[0]) for value in (of_waves, of_survey))
        if abs(simulated - expected) > _MAX_RELATIVE_DIFFERENCE * expected:
            raise ValueError(
                f"{name}: they are of a lidar of {quantity} {simulated:g} {unit}, that of the survey has "
                f"{expected:g} {unit}; give the survey that was simulated"
            )


def _check_directions(waves: Any, name: str, survey: Survey) -> None:
    """Refuse `Waveforms` of other directions than those of the survey's shots."""
    turn = np.remainder(np.asarray(waves.azimuth) - survey.azimuth + 180.0, 360.0) - 180.0
    differences = {
        "zenith": np.abs(np.asarray(waves.zenith) - survey.zenith),
        # A vertical beam has no azimuth.
        "azimuth": np.abs(turn) * np.sin(np.deg2rad(survey.zenith)),
    }
    for angle, difference in differences.items():
        if np.any(difference > _MAX_TURN):
            i = int(np.argmax(difference > _MAX_TURN))
            raise ValueError(
                f"{name}: shot {i} has the {angle} {getattr(waves, angle)[i]:g} degrees, that of the "
                f"survey {getattr(survey, angle)[i]:g} degrees; give the survey that was simulated"
            )


def _check_zenith(wave: Waveform, name: str, zenith: float) -> None:
    """Refuse a waveform whose heights are not those of a zenith angle, in degrees.

    Its cosine is the fall of the height per ns, over that of a vertical beam.
    """
    height, time = np.asarray(wave.height), np.asarray(wave.time)
    fall, duration = float(height[0]) - float(height[-1]), float(time[-1]) - float(time[0])
    cosine = fall / (height.size - 1) / (duration / (time.size - 1)) / (0.5 * SPEED_OF_LIGHT)
    relative_ends = np.abs(height).max() / max(fall, 1e-9) + np.abs(time).max() / duration
    rounding = 4 * np.finfo(height.dtype).eps * relative_ends
    if abs(cosine - math.cos(math.radians(zenith))) > _MAX_COSINE_DIFFERENCE + rounding:
        simulated = math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
        raise ValueError(
            f"{name}: its heights are those of the zenith {simulated:.4g} degrees, the shot of the survey "
            f"has {zenith:.4g} degrees; give the survey that was simulated"
        )


def _span(waves: Any, name: str, margin: int) -> tuple[float, int]:
    wavelengths, time = np.size(waves.wavelength), np.asarray(waves.time, float)
    if wavelengths != 1:
        raise ValueError(f"{name}: {wavelengths} wavelengths; admissible is one, as in the product")
    if not 2 <= time.size <= _MAX_BINS - 2 * margin:
        raise ValueError(f"{name}: {time.size} bins; admissible are 2 to {_MAX_BINS - 2 * margin}")
    step = (time[-1] - time[0]) / (time.size - 1)
    if abs(step - 1.0) > _STEP_TOLERANCE:
        raise ValueError(f"{name}: samples are {step:g} ns apart; admissible is 1 ns, as in the product")
    return float(time[0]) - margin, time.size + 2 * margin


def _energy_per_reflectance(survey: Survey) -> np.ndarray:
    """Return the energy, J, of a sample per apparent reflectance of it, at the reference plane, (shots,)."""
    upright = dataclasses.replace(_lidar_of(survey), zenith=0.0)
    return float(energy_at_reference(upright)[0]) * np.cos(np.deg2rad(survey.zenith)) ** 2


def _shot_numbers(shot_number: Any, beams: np.ndarray) -> np.ndarray:
    """Return unique shot numbers. **Raises:** as `write_gedi_l1b`."""
    if shot_number is None:
        beam = np.array([int(name[-4:], 2) for name in beams])
        return (_ORBIT_DIGIT + _BEAM_DIGIT * beam + np.arange(1, beams.size + 1)).astype(np.uint64)
    check_numbers("shot_number", shot_number)
    numbers = np.asarray(shot_number)
    check_shape("shot_number", numbers, beams.shape)
    if numbers.dtype.kind not in "iu" or numbers.min() < 0:
        raise ValueError(f"shot_number has the type {numbers.dtype}; admissible are whole numbers from 0 on")
    unique, times = np.unique(numbers, return_counts=True)
    if times.max() > 1:
        raise ValueError(f"shot_number = {unique[times.argmax()]} is that of {times.max()} shots")
    return numbers.astype(np.uint64)


def _transmitted_pulse(lidar: Lidar) -> tuple[np.ndarray, float]:
    """Return the transmitted waveform in counts, and the index of the sample at its time zero."""
    start, end = (float(t) for t in lidar.pulse.support())
    # At least a quarter of the samples comes before the pulse: readers take the pedestal from them.
    size = _PULSE_SAMPLES * math.ceil(4 / 3 * (end - start + 2) / _PULSE_SAMPLES)
    zero = math.ceil(size / 4 + 1 - start)
    edges = np.arange(size + 1) - zero - 0.5
    power = np.diff(np.asarray(lidar.pulse.cumulative(edges), float))
    return (_PULSE_PEDESTAL + _PULSE_PEAK * power / power.max()).astype(np.float32), float(zero)


def _extended_gaussian(pulse: np.ndarray, zero: float) -> dict[str, np.float32]:
    """Return the product's parameters of an extended Gaussian with the moments of the transmitted waveform.

    A Gaussian of standard deviation s, convolved with an exponential of time constant 1 / gamma, has the
    variance s^2 + gamma^-2 and the third central moment 2 gamma^-3.
    """
    power = pulse.astype(float) - _PULSE_PEDESTAL
    time = np.arange(pulse.size) - zero
    area = power.sum()
    mean = float(np.sum(power * time) / area)
    variance, third = (float(np.sum(power * (time - mean) ** n) / area) for n in (2, 3))
    constant = np.cbrt(max(third, 0.0) / 2.0)
    deviation = math.sqrt(variance)
    constant = float(np.clip(constant, _MIN_TIME_CONSTANT * deviation, deviation * math.sqrt(0.5)))
    values = {
        "tx_egamplitude": area,
        "tx_egbias": _PULSE_PEDESTAL,
        "tx_eggamma": 1.0 / constant,
        "tx_egsigma": math.sqrt(variance - constant**2),
    }
    errors = dict.fromkeys((*(f"{name}_error" for name in values), "tx_gloc_error"), 0.0)
    return {name: np.float32(value) for name, value in (values | errors).items()}


@functools.partial(jax.jit, static_argnums=2)
def _smooth_noise(key: PRNGKeyArray, shots: Array, bins: int) -> Float[Array, "shots bins"]:
    """Return white noise of unit standard deviation, smoothed as the product's waveforms are."""
    lag = np.arange(-_SMOOTHING_HALF_LENGTH, _SMOOTHING_HALF_LENGTH + 1)
    kernel = np.exp(-0.5 * (lag / _SMOOTHING_STD) ** 2)
    kernel = jnp.asarray(kernel / kernel.sum(), float)

    def shot_noise(shot: Array) -> Array:
        # The noise of a shot follows from its index, however many are written at once.
        white = jax.random.normal(jax.random.fold_in(key, shot), (bins + 2 * _SMOOTHING_HALF_LENGTH,))
        return jnp.convolve(white, kernel, mode="valid")

    return jax.vmap(shot_noise)(shots)


def _attribute(text: str) -> np.ndarray:
    """Return an attribute in the type of the product's: an array of one text."""
    return np.array([text], object)


def _write_description(file: Any, name: str) -> None:
    """Write the attributes of the product that describe the file, and that it is simulated."""
    file.attrs["short_name"] = _attribute("GEDI_L1B")
    description = {
        "abstract": "Simulated waveforms in the layout of the GEDI L1B product; no measurements.",
        "creationDate": f"{datetime.datetime.now(datetime.UTC):%Y-%m-%dT%H:%M:%S.%fZ}",
        "credit": f"jaxlidar {version_of('jaxlidar')}",
        "fileName": name,
        "shortName": "GEDI_L1B",
    }
    group = file.create_group("METADATA/DatasetIdentification")
    for field, text in description.items():
        group.attrs[field] = _attribute(text)


# -- geolocation -------------------------------------------------------------------------------------------


def _projection(origin: tuple[float, float] | None, crs: str | None) -> Any:
    """Return the projected reference system of a survey's positions. **Raises:** as `write_gedi_l1b`."""
    if (origin is None) == (crs is None):
        raise ValueError(f"origin = {origin} and crs = {crs}: give one of them")
    if origin is not None:
        longitude, latitude = origin
        check_number("longitude of origin", longitude, -180.0, 180.0)
        check_number("latitude of origin", latitude, -90.0, 90.0)
        crs = f"+proj=aeqd +lat_0={float(latitude)!r} +lon_0={float(longitude)!r} +datum=WGS84 +units=m"
    assert crs is not None
    projection = metric_system("crs", crs).crs
    if not projection.is_projected:
        raise ValueError(f"crs = {crs!r} has no place on Earth; admissible is a projected system")
    return projection


def _geolocation(
    survey: Survey,
    first_time: Float[np.ndarray, " shots"],
    bins: np.ndarray,
    plane_elevation: Float[np.ndarray, " shots"],
    projection: Any,
) -> dict[str, np.ndarray]:
    """Return the datasets of the group `geolocation`, each (shots,), with standard errors of zero.

    **Arguments:** `first_time`: ns, of the first bin. `bins`: number of bins of 1 ns. `plane_elevation`: m,
    of the reference plane. `projection`: of the survey's positions.
    """
    zenith, azimuth = np.deg2rad(survey.zenith), np.deg2rad(survey.azimuth)
    assert survey.altitude is not None
    altitude = float(survey.altitude[0])
    last_time = first_time + bins - 1
    # Heights above the reference plane, as those of `Waveform.height`.
    height_per_ns = -0.5 * SPEED_OF_LIGHT * np.cos(zenith)
    heights = {"bin0": height_per_ns * first_time, "lastbin": height_per_ns * last_time}
    heights["instrument"] = np.full_like(first_time, altitude)
    # Horizontal displacement of the light per metre that it descends.
    drift = np.stack([np.sin(azimuth), np.cos(azimuth)], axis=1) * np.tan(zenith)[:, None]
    columns = {}
    for name, height in heights.items():
        longitude, latitude = _longitude_latitude(projection, survey.position - height[:, None] * drift)
        columns[f"longitude_{name}"], columns[f"latitude_{name}"] = longitude, latitude
        elevation_name = "altitude_instrument" if name == "instrument" else f"elevation_{name}"
        columns[elevation_name] = plane_elevation + height
    for name, time in (("bin0", first_time), ("lastbin", last_time)):
        columns[f"bounce_time_offset_{name}"] = (
            1e-9 * (2 * altitude / (SPEED_OF_LIGHT * np.cos(zenith)) + time) / 2
        )
    # The product's vector leads from the footprint to the sensor, against the light.
    north = np.deg2rad(directions_of_north(projection, *survey.position.T))
    towards_sensor = np.remainder(azimuth + north, 2 * math.pi) - math.pi
    columns["local_beam_azimuth"] = towards_sensor.astype(np.float32)
    columns["local_beam_elevation"] = (0.5 * math.pi - zenith).astype(np.float32)
    columns |= {f"{name}_error": np.zeros(len(survey), np.float32) for name in columns}
    columns["degrade"] = np.zeros(len(survey), np.int8)
    columns["digital_elevation_model"] = plane_elevation.astype(np.float32)
    return columns


def _longitude_latitude(projection: Any, position: Float[np.ndarray, "n 2"]) -> tuple[np.ndarray, np.ndarray]:
    """Return longitude and latitude on WGS-84. **Raises:** ValueError outside the projection."""
    longitude, latitude = transform("crs", projection, GEOGRAPHIC, *position.T).T
    outside = ~(np.isfinite(longitude) & np.isfinite(latitude))
    if outside.any():
        shot = int(np.argmax(outside))
        raise ValueError(
            f"position: shot {shot} at {position[shot].tolist()} m lies outside the projection {projection}"
        )
    return longitude, latitude
