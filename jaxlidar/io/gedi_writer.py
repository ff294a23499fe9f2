"""Writer of simulated waveforms in the layout of GEDI's level 1B product, for the tools that read it.

What a simulation does not have is left out: the orbit, the fit of the transmitted pulse, geophysical
corrections, the sun, and what the product knows of its own processing. Standard errors of places are zero.
"""

import dataclasses
import datetime
import functools
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from jaxlidar._checks import (
    check_choice,
    check_integer,
    check_key,
    check_kind,
    check_number,
    check_range,
    check_shape,
    concrete_number,
)
from jaxlidar._files import atomic_write
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.instrument.survey import Survey
from jaxlidar.io.checks import MOST_COUNTS
from jaxlidar.io.gedi_places import geolocation, reference_system
from jaxlidar.io.netcdf import version
from jaxlidar.spectral.waveform import Waveform, energy_per_reflectance

# The beams' groups: the number of the laser's channel, and whether the laser's full power is in the beam.
BEAMS = {
    "BEAM0000": (0, False),
    "BEAM0001": (0, False),
    "BEAM0010": (1, False),
    "BEAM0011": (1, False),
    "BEAM0101": (2, True),
    "BEAM0110": (3, True),
    "BEAM1000": (4, True),
    "BEAM1011": (5, True),
}
# Shot numbers are orbit, beam (2 digits), reserved (3) and number within the orbit (8).
_ORBIT, _BEAM = 10**13, 10**11
# Shots per second of one beam.
_RATE = 242.0
# Samples of the transmitted pulse, its pedestal, and counts of its largest sample above it.
_SENT, _SENT_PEDESTAL, _SENT_PEAK = 128, 250.0, 1000.0
# Standard deviation in bins of the Gaussian that the product smooths with, and where it ends.
_SMOOTHING, _REACH = 1.7, 8
# Admissible difference of the sampling interval from 1 ns, which single precision rounds.
_OFF = 1e-3
# Counts of bins are stored in 16 bits.
_MOST_BINS = 2**16 - 1
_BLOCK = 256


def write_gedi_l1b(
    path: str | os.PathLike[str],
    waveforms: Any,
    survey: Survey,
    *,
    origin: tuple[float, float] | None = None,
    crs: str | None = None,
    elevation: ArrayLike | Sequence = 0.0,
    beam: str | Sequence[str] = "BEAM0101",
    shot_number: Sequence[int] | np.ndarray | None = None,
    margin: int = 200,
    gain: float = 50_000.0,
    noise_mean: float = 240.0,
    noise_std: float = 3.0,
    key: PRNGKeyArray | None = None,
) -> None:
    """Write simulated shots as a GEDI L1B file, which the product's own tools and `read_gedi_l1b` read.

    The file has the groups of all eight beams. Bins have the elevation of `Waveform.height`, and `tx_gloc` is
    time zero of the lidar's pulse, so that what `read_gedi_l1b` gives fits what was simulated. Where the
    pulse is not symmetric, the product would have the centre of a Gaussian fit there.

    **Arguments:**

    - `path`: the HDF5 file to write. It appears when it is whole.
    - `waveforms`: the `Waveforms` of `jaxlidar.simulate_many`, or one `Waveform` for each shot, of one
      wavelength and samples of 1 ns. Their `recorded` energies are written.
    - `survey`: the `Survey` that was simulated; `Survey.of(lidar)` for one waveform.
    - `origin`: longitude and latitude of x = y = 0 in degrees, where y is north. Places are those of the
      azimuthal equidistant projection about it.
    - `crs`: in place of `origin`, the projected coordinate reference system of the survey's positions, in
      metres, such as "EPSG:32633". Azimuths are turned from its grid's north to true north.
    - `elevation`: of the reference plane z = 0 above the WGS-84 ellipsoid in m, one number or (shots,).
      Default 0.
    - `beam`: one of the product's eight, such as "BEAM0000", for all shots or for each. Shots lie in the file
      beam after beam. Default "BEAM0101".
    - `shot_number`: (shots,) unique whole numbers. Default None: numbers of the product's form, of orbit 1.
    - `margin`: bins without light that are added above and below what was simulated, 0 or more; tools take
      the noise from there. Default 200, 30 m.
    - `gain`: counts of a sample per apparent reflectance of it, positive: energies are related to that of a
      Lambertian target at the reference plane. Default 50,000: ground of reflectance 0.35 gives the 17,500
      counts in all of recorded full-power beams.
    - `noise_mean`: counts without light, 0 or more. The receiver's background comes in addition. Default 240.
    - `noise_std`: standard deviation of the noise in counts before the product's smoothing, 0 or more, as
      `noise_stddev_corrected` has it. Default 3.
    - `key`: a JAX random key: normal noise is added, smoothed as recorded noise is (a standard deviation of
      0.41 `noise_std`). Default None: no noise is added to `recorded`.

    **Returns:** nothing.

    **Raises:** ImportError without h5py or rasterio, which the extra `io` installs. TypeError for things of
    another kind. ValueError for several wavelengths, samples that are not 1 ns apart, waveforms of another
    survey, an unknown beam or `crs`, neither or both of `origin` and `crs`, and numbers outside their ranges.
    OSError for a path that cannot be written.

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
    try:
        import h5py
        import rasterio  # noqa: F401
    except ImportError as error:
        raise ImportError("GEDI files need h5py and rasterio: pip install 'jaxlidar[io]'") from error
    check_kind("survey", survey, Survey, "a Survey, such as Survey.of(lidar)")
    margin = check_integer("margin", margin, 0)
    first, count = _spans(waveforms, survey, margin)
    shots = len(survey)
    check_range("elevation", elevation)
    check_shape("elevation", elevation, (), (shots,))
    plane = np.broadcast_to(np.asarray(elevation, float), (shots,))
    beams = np.array([beam] * shots if isinstance(beam, str) else list(beam))
    check_shape("beam", beams, (shots,))
    for name in np.unique(beams):
        check_choice("beam", str(name), tuple(BEAMS))
    check_number("gain", gain, 0.0, low_open=True)
    check_number("noise_mean", noise_mean, 0.0)
    check_number("noise_std", noise_std, 0.0)
    if key is not None:
        check_key(key)
    per_joule = gain / _energy_per_reflectance(survey)
    background = concrete_number(survey.lidar.receiver.background)
    sent, reference = _sent(survey.lidar)
    columns = {
        "shot_number": _numbers(shot_number, beams),
        "noise_mean_corrected": noise_mean + per_joule * background,
        "noise_stddev_corrected": np.full(shots, float(noise_std)),
        "rx_sample_count": count.astype(np.uint16),
        "stale_return_flag": np.zeros(shots, np.uint8),
        "tx_gloc": np.full(shots, reference, np.float32),
        "tx_sample_count": np.full(shots, sent.size, np.uint16),
    }
    place = geolocation(survey, first, count, plane, reference_system(origin, crs))
    records = _Records(waveforms, per_joule, noise_mean, noise_std, key, count, margin, background)
    with atomic_write(path) as draft, h5py.File(draft, "w") as file:
        _describe(file, Path(path).name)
        for name in BEAMS:
            (chosen,) = np.nonzero(beams == name)
            beam_columns = {field: column[chosen] for field, column in columns.items()}
            group = _beam_group(file, name, beam_columns)
            group["txwaveform"] = np.tile(sent, chosen.size)
            _receive(group, records, chosen)
            located = group.create_group("geolocation")
            for field, column in place.items():
                located[field] = column[chosen]
            for field in ("delta_time", "shot_number"):
                located[field] = group[field][:]


def _beam_group(file: Any, name: str, columns: dict[str, np.ndarray]) -> Any:
    """The group of a beam, with what is known of its shots before their records."""
    channel, full = BEAMS[name]
    group = file.create_group(name)
    group.attrs["description"] = _text(f"{'Full power' if full else 'Coverage'} beam")
    shots = len(columns["shot_number"])
    for field, column in columns.items():
        group[field] = column
    group["beam"] = np.full(shots, int(name[-4:], 2), np.uint16)
    group["channel"] = np.full(shots, channel, np.uint8)
    group["delta_time"] = np.arange(shots) / _RATE
    for kind in ("rx", "tx"):
        count = columns[f"{kind}_sample_count"].astype(np.uint64)
        group[f"{kind}_sample_start_index"] = np.cumsum(count, dtype=np.uint64) - count + np.uint64(1)
    return group


def _receive(group: Any, records: "_Records", chosen: np.ndarray) -> None:
    """Write the records of a beam's shots, some at a time, and their energies."""
    starts = group["rx_sample_start_index"][:].astype(int) - 1
    received = group.create_dataset("rxwaveform", (int(records.count[chosen].sum()),), np.float32)
    energy = np.zeros(chosen.size)
    for block in range(0, chosen.size, _BLOCK):
        some = slice(block, block + _BLOCK)
        counts = records.of(chosen[some])
        together = np.concatenate(counts)
        received[starts[block] : starts[block] + together.size] = together
        above = group["noise_mean_corrected"][some]
        energy[some] = [own.sum(dtype=float) - own.size * dark for own, dark in zip(counts, above)]
    group["rx_energy"] = energy


class _Records(NamedTuple):
    """What the digitiser would store of the shots: pedestal, energies times `per_joule`, noise."""

    waveforms: Any
    per_joule: np.ndarray
    noise_mean: float
    noise_std: float
    key: Any
    count: np.ndarray
    margin: int
    background: float

    def of(self, shots: np.ndarray) -> list[np.ndarray]:
        """Counts of some shots, (bins,) each."""
        longest = int(self.count.max())
        noise = np.zeros((shots.size, longest))
        if self.key is not None:
            noise = self.noise_std * np.asarray(_noise(self.key, jnp.asarray(shots), longest), float)
        return [self._one(int(i), own[: self.count[i]]) for i, own in zip(shots, noise)]

    def _one(self, i: int, noise: np.ndarray) -> np.ndarray:
        survey_wide = hasattr(self.waveforms, "position")
        energy = self.waveforms.recorded[i, 0] if survey_wide else self.waveforms[i].recorded[0]
        energy = np.asarray(energy, float)
        check_range(f"recorded of shot {i}", energy)
        energy = np.pad(energy, self.margin, constant_values=self.background)
        counts = self.noise_mean + self.per_joule[i] * energy + noise
        if np.abs(counts).max() > MOST_COUNTS:
            raise ValueError(
                f"gain: shot {i} has {np.abs(counts).max():g} counts; admissible are up to {MOST_COUNTS:g}"
            )
        return counts.astype(np.float32)


def _spans(waveforms: Any, survey: Survey, margin: int) -> tuple[np.ndarray, np.ndarray]:
    """Time of the first bin in ns, and number of bins, of each shot. **Raises:** as `write_gedi_l1b`."""
    place = getattr(waveforms, "position", None)
    if place is None:
        check_kind("waveforms", waveforms, Sequence, "the Waveforms of simulate_many, or a list of Waveform")
        for i, wave in enumerate(waveforms):
            check_kind(f"waveforms {i}", wave, Waveform, "a Waveform")
    if len(waveforms) != len(survey):
        raise ValueError(f"{len(waveforms)} waveforms are of a survey of {len(survey)} shots; give its own")
    if place is not None and not np.array_equal(place, survey.position):
        raise ValueError("the waveforms have another position than the shots of the survey; give their own")
    if place is not None:
        spans = [_span(waveforms, "waveforms", margin)] * len(survey)
    else:
        spans = [_span(wave, f"waveforms {i}", margin) for i, wave in enumerate(waveforms)]
    first, count = zip(*spans)
    return np.array(first), np.array(count)


def _span(waves: Any, name: str, margin: int) -> tuple[float, int]:
    wavelengths, time = np.size(waves.wavelength), np.asarray(waves.time, float)
    if wavelengths != 1:
        raise ValueError(f"{name}: {wavelengths} wavelengths; admissible is one, as in the product")
    if not 2 <= time.size <= _MOST_BINS - 2 * margin:
        raise ValueError(f"{name}: {time.size} bins; admissible are 2 to {_MOST_BINS - 2 * margin}")
    step = (time[-1] - time[0]) / (time.size - 1)
    if abs(step - 1.0) > _OFF:
        raise ValueError(f"{name}: samples are {step:g} ns apart; admissible is 1 ns, as in the product")
    return float(time[0]) - margin, time.size + 2 * margin


def _energy_per_reflectance(survey: Survey) -> np.ndarray:
    """J of a sample per apparent reflectance of it, at the reference plane, (shots,)."""
    plane = jnp.zeros(1)
    upright = dataclasses.replace(survey.lidar, zenith=0.0)
    return float(energy_per_reflectance(upright, plane)[0, 0]) * np.cos(np.deg2rad(survey.zenith)) ** 2


def _numbers(given: Any, beams: np.ndarray) -> np.ndarray:
    """Shot numbers, unique. **Raises:** as `write_gedi_l1b`."""
    if given is None:
        beam = np.array([int(name[-4:], 2) for name in beams])
        return (_ORBIT + _BEAM * beam + np.arange(1, beams.size + 1)).astype(np.uint64)
    numbers = np.asarray(given)
    check_shape("shot_number", numbers, beams.shape)
    if numbers.dtype.kind not in "iu" or numbers.min() < 0:
        raise ValueError(f"shot_number has the type {numbers.dtype}; admissible are whole numbers from 0 on")
    unique, times = np.unique(numbers, return_counts=True)
    if times.max() > 1:
        raise ValueError(f"shot_number = {unique[times.argmax()]} is that of {times.max()} shots")
    return numbers.astype(np.uint64)


def _sent(lidar: Lidar) -> tuple[np.ndarray, float]:
    """The transmitted waveform in counts, and the sample at which its time is zero."""
    low, high = (float(t) for t in lidar.pulse.support())
    # A quarter of the samples, at least, comes before the pulse: the pedestal.
    size = _SENT * math.ceil(4 / 3 * (high - low + 2) / _SENT)
    reference = math.ceil(size / 4 + 1 - low)
    edges = np.arange(size + 1) - reference - 0.5
    power = np.diff(np.asarray(lidar.pulse.cumulative(edges), float))
    return (_SENT_PEDESTAL + _SENT_PEAK * power / power.max()).astype(np.float32), float(reference)


@functools.partial(jax.jit, static_argnums=2)
def _noise(key: PRNGKeyArray, shots: Array, bins: int) -> Float[Array, "shots bins"]:
    """White noise of unit standard deviation, smoothed as the product's records are."""
    lag = np.arange(-_REACH, _REACH + 1)
    kernel = np.exp(-0.5 * (lag / _SMOOTHING) ** 2)
    kernel = jnp.asarray(kernel / kernel.sum(), float)

    def one(shot: Array) -> Array:
        white = jax.random.normal(jax.random.fold_in(key, shot), (bins + 2 * _REACH,))
        return jnp.convolve(white, kernel, mode="valid")

    return jax.vmap(one)(shots)


def _text(text: str) -> np.ndarray:
    """An attribute as the product has it."""
    return np.array([text], object)


def _describe(file: Any, name: str) -> None:
    """What the file is: the product's attributes, with its simulated origin."""
    file.attrs["short_name"] = _text("GEDI_L1B")
    said = {
        "abstract": "Simulated waveforms in the layout of the GEDI L1B product; no measurements.",
        "creationDate": f"{datetime.datetime.now(datetime.UTC):%Y-%m-%dT%H:%M:%S.%fZ}",
        "credit": f"jaxlidar {version('jaxlidar')}",
        "fileName": name,
        "shortName": "GEDI_L1B",
    }
    group = file.create_group("METADATA/DatasetIdentification")
    for field, text in said.items():
        group.attrs[field] = _text(text)
