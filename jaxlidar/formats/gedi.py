"""Reader of spaceborne waveforms: GEDI's level 1B product.

The product's data dictionary does not say everything about the fields of a shot. The following was found from
the recorded numbers, and `GediShot` relies on it.

- The time from transmission to the first received bin, 2 `bounce_time_offset_bin0`, equals `rx_open` +
  `rx_offset` - `tx_gloc` plus a constant of the channel, in samples of 1 ns (to 1e-6 ns in some beams, else
  to whole clock steps of 4 ns). So the elevation of a bin is that of a target whose echo has the *Gaussian
  fit* of the transmitted pulse centred on that bin: time zero of the pulse is `tx_gloc`, counted from sample
  0. (Flat ground fitted with the recorded pulse then lies within 0.1 m of level 2's `elev_lowestmode`.) The
  pulse is skewed: its largest sample comes 0.7 to 1.3 ns before, its centroid 2 to 3 ns after (0.3 to 0.5 m
  of elevation, if confused).
- 2 (`bounce_time_offset_lastbin` - `bounce_time_offset_bin0`) is the number of bins less one, in ns: the two
  elevations are those of the first and the last bin, and bins in between lie evenly, 0.1498 m apart.
- The waveforms are smoothed, the received one as though by a Gaussian of 1.7 ns: noise of neighbouring bins
  has a correlation of 0.92, 0.71, 0.45, 0.21 and then about none, and a standard deviation about half of
  `noise_stddev_corrected`. For fits take every fifth bin as independent, or weight accordingly.

Level 2 results (L2A `elev_lowestmode`, `rh`; L2B `pai`, `cover`) belong to the shot with the same
`GediShot.shot_number`, which is unique in all of the mission.
"""

import contextlib
import dataclasses
import functools
import numbers
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxlidar._fields.checks import check_numbers, warn_user
from jaxlidar.formats.checks import (
    MAX_COORDINATE,
    MAX_COUNTS,
    MAX_EXACT_INTEGER,
    TWO_WAY_METRES_PER_NS,
    FileWarning,
    check_step_of_light,
    refuse_damage,
)
from jaxlidar.formats.coordinates import check_elevations
from jaxlidar.formats.hdf5 import ProductFile, open_hdf5
from jaxlidar.formats.noise import above_pedestal

# Groups of beams: the number of the laser's channel, and True for a beam with the full power of its laser.
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
# Datasets of a beam's group with a number for each shot; start indices of samples may be missing.
_PER_SHOT = (
    "rx_sample_count",
    "tx_sample_count",
    "tx_gloc",
    "noise_mean_corrected",
    "noise_stddev_corrected",
    "geolocation/elevation_bin0",
    "geolocation/elevation_lastbin",
    "geolocation/latitude_lastbin",
    "geolocation/longitude_lastbin",
    "geolocation/altitude_instrument",
    "geolocation/local_beam_elevation",
    "geolocation/local_beam_azimuth",
)
# Units that datasets have, unless they name another one.
_UNITS = {
    "geolocation/elevation_bin0": "m",
    "geolocation/elevation_lastbin": "m",
    "geolocation/altitude_instrument": "m",
    "geolocation/latitude_lastbin": "degrees",
    "geolocation/longitude_lastbin": "degrees",
    "geolocation/local_beam_elevation": "rad",
    "geolocation/local_beam_azimuth": "rad",
    "geolocation/solar_elevation": "degrees",
    "delta_time": "s since 2018-01-01",
}
# Datasets of other numbers of a GediShot, and of its flags; subsets may have left them out.
_FLAGS = {"degrade": "geolocation/degrade", "stale_return": "stale_return_flag"}
_OPTIONAL = {"solar_elevation": "geolocation/solar_elevation", "delta_time": "delta_time", **_FLAGS}
# Nothing that GEDI sees lies so far below the ellipsoid, m; fill values do.
_MIN_ELEVATION = -1000.0
# Equal samples in a row that noise does not make.
_MIN_SATURATED_RUN = 3


@dataclasses.dataclass(frozen=True, eq=False)
class GediShot:
    """One shot of GEDI's level 1B product, in double precision. Bins are 1 ns; the first is the highest.

    - `beam`: name of the beam's group, such as "BEAM0101".
    - `shot_number`: the product's unique number.
    - `time`: (bins,) ns, 0 at the first bin and increasing downward.
    - `elevation`: (bins,) m above the WGS-84 ellipsoid, decreasing: that of a target whose echo of
      `pulse_power` has its time zero in the bin.
    - `waveform`: (bins,) received, in counts, noise included.
    - `noise_mean`, `noise_std`: mean and standard deviation of the received noise in counts, as the product
      gives them.
    - `pulse_time`: (samples,) ns, zero at the reference of `elevation`.
    - `pulse_power`: (samples,) transmitted, in counts: pedestal removed, not negative, and zero before and
      after the pulse. For `SampledPulse(time=shot.pulse_time, power=shot.pulse_power)`.
    - `latitude`, `longitude`: of the last bin in degrees.
    - `altitude`: of the instrument in m above the ellipsoid.
    - `zenith`: of the beam at the footprint in degrees, as in `Lidar`.
    - `azimuth`: in degrees clockwise from north, the horizontal direction in which the light travels down, as
      in `Lidar`.
    - `degrade`: the product's flag of degraded pointing or positioning, 0 where neither is. Default None: not
      in the file.
    - `stale_return`: the product's flag, 1 where no return was detected on board and the place of an earlier
      shot's return chose the samples. Default None: not in the file.
    - `solar_elevation`: of the sun at the footprint in degrees, below 0 by night. Default None: not in the
      file.
    - `delta_time`: of the transmission in s since the beginning of 2018. Default None: not in the file.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.io import GediShot
    >>> bins = {"time": np.arange(3.0), "elevation": np.array([20.3, 20.15, 20.0])}
    >>> pulse = {"pulse_time": np.array([-1.0, 0.0, 1.0]), "pulse_power": np.array([0.0, 80.0, 0.0])}
    >>> place = {"latitude": -20.0, "longitude": 25.0, "altitude": 4e5, "zenith": 0.5, "azimuth": 90.0}
    >>> received = {"waveform": np.array([200.0, 260.0, 205.0]), "noise_mean": 202.0, "noise_std": 2.0}
    >>> GediShot(beam="BEAM0101", shot_number=1, **bins, **received, **pulse, **place).signal
    array([-2., 58.,  3.])
    """

    beam: str
    shot_number: int
    time: Float[np.ndarray, " bins"]
    elevation: Float[np.ndarray, " bins"]
    waveform: Float[np.ndarray, " bins"]
    noise_mean: float
    noise_std: float
    pulse_time: Float[np.ndarray, " samples"]
    pulse_power: Float[np.ndarray, " samples"]
    latitude: float
    longitude: float
    altitude: float
    zenith: float
    azimuth: float
    degrade: int | None = None
    stale_return: int | None = None
    solar_elevation: float | None = None
    delta_time: float | None = None

    @property
    def saturated(self) -> int:
        """Length of the longest run of samples at the largest value, if it is three or more, else 0.

        The level 1B product has no flag of saturation. A receiver or digitiser at its limit repeats one
        value.
        """
        ends = np.flatnonzero(np.diff(np.r_[False, self.waveform == self.waveform.max(), False]))
        longest = int(np.max(ends[1::2] - ends[::2]))
        return longest if longest >= _MIN_SATURATED_RUN else 0

    @property
    def signal(self) -> Float[np.ndarray, " bins"]:
        """Received waveform less the mean noise, in counts."""
        return self.waveform - self.noise_mean


def read_gedi_l1b(path: str | os.PathLike[str], shot: Any = None) -> list[GediShot]:
    """Read the shots of a GEDI L1B file, or of a subset of one in the same layout.

    This needs h5py (`pip install "jaxlidar[io]"`). From beams without a requested shot nothing is read but
    the numbers of shots.

    Start indices are used where they fit the stored samples. Where they do not, as in subsets that kept the
    numbering of the full file, or are missing, the samples of shots follow one another without gaps, as many
    as the counts.

    Shots that are not complete (a missing number or one that makes no sense, such as a fill value, an
    elevation that is NaN, samples that are not stored) are skipped where all shots are read, and so are
    beams that lack a dataset. Flags that are no whole numbers become None.

    **Arguments:**

    - `path`: an HDF5 file.
    - `shot`: the requested shots, an integer or several. A number below the number of shots in the file is an
      index, from 0, into all shots, complete or not, beam after beam in the order of the file; any other is a
      shot number. One that is the index of a shot and the number of another is refused. Default None: all.

    **Returns:** a list of `GediShot`, in the order of `shot`; one integer gives a list of one.

    **Warns:** `FileWarning` for every beam with shots that are skipped, naming the first and their number;
    for beams that are skipped, for start indices that are missing, and for flags that are left out.

    **Raises:** FileNotFoundError where there is no such file. ImportError without h5py. TypeError for a
    `shot` that is neither an integer nor several. ValueError, naming the file and the place, for a file that
    is not HDF5, is damaged or declares more than it can hold, is no GEDI L1B product or has no shot that is
    complete, and for a requested shot that is not complete or that it does not hold.

    **Source:** GEDI L1B product data dictionary (Dubayah et al. 2020, doi:10.5067/GEDI/GEDI01_B.002); Luthcke
    et al. 2019, GEDI waveform geolocation for L1 and L2 products (theoretical basis document).

    **Example:**

    >>> import jaxlidar as jl
    >>> import jaxlidar.io
    >>> (shot,) = jaxlidar.io.read_gedi_l1b("GEDI01_B.h5", shot=0)  # doctest: +SKIP
    >>> pulse = jl.SampledPulse(time=shot.pulse_time, power=shot.pulse_power)  # doctest: +SKIP
    >>> lidar = jl.Lidar(pulse=pulse, zenith=shot.zenith, azimuth=shot.azimuth)  # doctest: +SKIP
    """
    requested = None if shot is None else _requested_numbers(shot)
    reads, remarks = _read_rows(path, requested)
    first_error = next((row for row in reads if isinstance(row, IncompleteShot)), None)
    complete = [row for row in reads if isinstance(row, GediShot)]
    # What was asked for is read or refused; of all shots those that are not complete are skipped.
    if first_error is not None and (requested is not None or not complete):
        raise first_error.error
    for warning in remarks:
        warn_user(warning, FileWarning)
    return complete


class IncompleteShot(NamedTuple):
    """A shot of a file that cannot be read: its beam, its number (-1: not readable), and the reason."""

    beam: str
    shot_number: int
    error: ValueError


def read_gedi_rows(path: str | os.PathLike[str]) -> list[GediShot | IncompleteShot]:
    """Read all shots of a GEDI L1B file, with those that are not complete in their places.

    **Warns:** `FileWarning` for beams that are skipped, and for start indices that are missing.

    **Raises:** as `read_gedi_l1b`, but for shots that are not complete.
    """
    rows, remarks = _read_rows(path, None, counts_skipped=False)
    for warning in remarks:
        warn_user(warning, FileWarning)
    return rows


def _read_rows(
    path: str | os.PathLike[str], requested: list[int] | None, *, counts_skipped: bool = True
) -> tuple[list[GediShot | IncompleteShot], list[str]]:
    """Return the requested shots of a file, or the reasons why they cannot be read, and remarks on the file.

    **Arguments:** `counts_skipped`: have a remark on each beam with shots that are not complete.
    """
    with open_hdf5(path, "GEDI L1B") as file:
        beams, beam_errors = file.read_groups("BEAM", lambda name: _Beam(file, name))
        selected = _select(file.path, beams, requested)
        # By beam, so that the samples of neighbouring shots are read together.
        indices_by_beam: dict[_Beam, set[int]] = {}
        for beam, i in selected:
            indices_by_beam.setdefault(beam, set()).add(i)
        reads = {beam: _shots(beam, sorted(indices)) for beam, indices in indices_by_beam.items()}
        remarks = [f"{error}: the beam is skipped" for error in beam_errors]
        for beam, (_, errors) in reads.items():
            if errors and counts_skipped:
                first = next(iter(errors.values()))
                remarks.append(f"{first}: {len(errors)} of {len(beam)} shots of {beam.name} skipped")
            remarks += beam.remarks
        rows: list[GediShot | IncompleteShot] = []
        for beam, i in selected:
            shots, errors = reads[beam]
            rows.append(shots[i] if i in shots else IncompleteShot(beam.name, beam.number_of(i), errors[i]))
    return rows, remarks


def _requested_numbers(shot: Any) -> list[int]:
    """Return the requested indices and shot numbers. **Raises:** as `read_gedi_l1b`."""
    is_several = isinstance(shot, Sequence | np.ndarray) and not isinstance(shot, str | bytes)
    requested: list[Any] = list(shot) if is_several and np.shape(shot) != () else [shot]
    for number in requested:
        if isinstance(number, numbers.Real) and not isinstance(number, numbers.Integral):
            raise ValueError(f"shot = {number} is neither an index nor a shot number: both are integers")
        if isinstance(number, bool) or not isinstance(number, numbers.Integral):
            raise TypeError(
                f"shot = {' '.join(repr(number).split())} is a {type(number).__name__}; admissible are an "
                "index or a shot number, "
                "which are integers, or a list of them"
            )
    # NumPy counts times among the integers.
    check_numbers("shot", shot)
    return [int(number) for number in requested]


def _select(path: Path, beams: "list[_Beam]", requested: list[int] | None) -> "list[tuple[_Beam, int]]":
    """Return the beam, and the index within it, of each requested shot. **Raises:** as `read_gedi_l1b`."""
    order = [(beam, i) for beam in beams for i in range(len(beam))]
    if requested is None:
        return order
    by_number = {int(n): (beam, i) for beam in beams for i, n in enumerate(beam.shot_number)}
    selected = []
    for number in requested:
        has_index = 0 <= number < len(order)
        if not has_index and number not in by_number:
            raise ValueError(
                f"{path}: shot = {number} is neither an index in [0, {len(order) - 1}] "
                "nor the number of a shot here"
            )
        shot = order[number] if has_index else by_number[number]
        if by_number.get(number, shot) != shot:
            raise ValueError(
                f"{path}: shot = {number} is the number of a shot here and the index of another one; "
                "admissible is None, which reads all shots: choose by their `shot_number`"
            )
        selected.append(shot)
    return selected


def _shots(beam: "_Beam", indices: list[int]) -> tuple[dict[int, GediShot], dict[int, ValueError]]:
    """Return the shots of a beam that are complete, and the errors of those that are not, by their index."""
    shots: dict[int, GediShot] = {}
    errors: dict[int, ValueError] = {}
    try:
        received, transmitted = (beam.samples(kind, indices, errors) for kind in ("rx", "tx"))
    except ValueError as error:
        # The beam lacks a dataset.
        return {}, dict.fromkeys(indices, error)
    for i in indices:
        if i in errors:
            continue
        try:
            shots[i] = _shot(beam, i, received[i], transmitted[i])
        except ValueError as error:
            errors[i] = error
    return shots, dict(sorted(errors.items()))


def _shot(beam: "_Beam", i: int, received: np.ndarray, transmitted: np.ndarray) -> GediShot:
    # The pointing vector leads from the footprint to the sensor, so its elevation is above the horizon.
    above_horizon = beam.number("geolocation/local_beam_elevation", i, 0.0, np.pi / 2 + 1e-6)
    towards = beam.number("geolocation/local_beam_azimuth", i, -2 * np.pi, 2 * np.pi)
    top = beam.number("geolocation/elevation_bin0", i, _MIN_ELEVATION)
    bottom = beam.number("geolocation/elevation_lastbin", i, _MIN_ELEVATION)
    location = beam.location("geolocation/elevation_lastbin", i)
    check_elevations(location, bottom)
    if bottom >= top:
        raise ValueError(f"{location}: {bottom:g} m is not below the first bin, {top:g} m")
    step = (top - bottom) / (received.size - 1)
    check_step_of_light(location, step, TWO_WAY_METRES_PER_NS * np.sin(above_horizon))
    pulse_zero = beam.number("tx_gloc", i, 0.0, transmitted.size - 1)
    pedestal = float(np.median(transmitted[: max(transmitted.size // 4, 1)]))
    return GediShot(
        beam=beam.name,
        shot_number=int(beam.shot_number[i]),
        time=np.arange(received.size, dtype=np.float64),
        elevation=np.linspace(top, bottom, received.size),
        waveform=received,
        noise_mean=beam.number("noise_mean_corrected", i, 0.0),
        noise_std=beam.number("noise_stddev_corrected", i, 0.0),
        pulse_time=np.arange(transmitted.size) - pulse_zero,
        pulse_power=above_pedestal(transmitted, pedestal, beam.location("txwaveform", i)),
        latitude=beam.number("geolocation/latitude_lastbin", i, -90.0, 90.0),
        longitude=beam.number("geolocation/longitude_lastbin", i, -180.0, 360.0),
        altitude=beam.number("geolocation/altitude_instrument", i, _MIN_ELEVATION),
        zenith=max(0.0, 90.0 - float(np.rad2deg(above_horizon))),
        azimuth=float(np.rad2deg(towards) + 180.0) % 360.0,
        degrade=beam.flag("degrade", i),
        stale_return=beam.flag("stale_return", i),
        solar_elevation=beam.optional_number("solar_elevation", i),
        delta_time=beam.optional_number("delta_time", i),
    )


class _Beam:
    """The group of one beam: its numbers for each shot, and the samples of shots.

    Datasets are compared with the file before they are read. Numbers of all shots are read when the first is
    used. Two beams are equal if they are the same object. `remarks` are messages on what was read in another
    way than the file says, or left out of shots.

    **Raises:** ValueError where there are no shot numbers.
    """

    def __init__(self, file: ProductFile, name: str):
        self.file, self.name = file, name
        self.remarks: list[str] = []
        self.size = self._dataset("shot_number").shape[0]

    def __len__(self) -> int:
        return self.size

    def location(self, field: str, shot: int | None = None) -> str:
        """Return the location of a field, and of a shot in it, for messages."""
        location = self.file.location(f"{self.name}/{field}")
        return location if shot is None else f"{location}, shot {int(self.shot_number[shot])}"

    def number(
        self, field: str, shot: int, low: float = -MAX_COORDINATE, high: float = MAX_COORDINATE
    ) -> float:
        """Return the number of a shot. **Raises:** ValueError where it is not in [low, high]."""
        value = float(self._per_shot[field][shot])
        if not low <= value <= high:
            raise ValueError(
                f"{self.location(field, shot)}: {value:g} is outside the admissible range [{low:g}, {high:g}]"
            )
        return value

    def optional_number(self, name: str, shot: int) -> float | None:
        """Return a number of a shot, or None where the file does not have it."""
        values = self._optional.get(name)
        return None if values is None or not np.isfinite(values[shot]) else float(values[shot])

    def flag(self, name: str, shot: int) -> int | None:
        """Return a flag of a shot, or None where the file does not have it."""
        number = self.optional_number(name, shot)
        return None if number is None else int(number)

    def samples(
        self, kind: str, shots: Sequence[int], errors: dict[int, ValueError]
    ) -> dict[int, np.ndarray]:
        """Return the samples of shots in increasing order, of the received ("rx") or sent ("tx") waveform.

        Shots that follow one another are read in one pass. Shots whose samples cannot be read are missing in
        the result; their errors are added to `errors`.

        **Raises:** ValueError where a dataset is missing.
        """
        dataset, location = self._dataset(f"{kind}waveform"), self._sample_locations[kind]
        for i in shots:
            if i not in errors and (error := self._error_of_location(kind, i)) is not None:
                errors[i] = error
        readable = [i for i in shots if i not in errors]
        samples_by_shot = {}
        runs = np.split(np.array(readable, int), np.flatnonzero(np.diff(readable) > 1) + 1)
        for run in (run.tolist() for run in runs if run.size):
            first, end = location.start[run[0]], location.start[run[-1]] + location.count[run[-1]]
            run_samples = None
            # Where a chunk is damaged, the shots that lie in it are found one by one.
            with contextlib.suppress(ValueError), refuse_damage("a damaged chunk"):
                run_samples = dataset[first:end]
            for i in run:
                at, n = location.start[i], location.count[i]
                try:
                    with refuse_damage(f"{self.location(f'{kind}waveform', i)}: damaged"):
                        raw = dataset[at : at + n] if run_samples is None else run_samples[at - first :][:n]
                    samples_by_shot[i] = self._checked_samples(kind, i, raw)
                except ValueError as error:
                    errors[i] = error
        return samples_by_shot

    def _checked_samples(self, kind: str, shot: int, raw: np.ndarray) -> np.ndarray:
        """Return samples in double precision. **Raises:** ValueError for one that is no count."""
        # Casting warns of NaN whose bits signal an error.
        with np.errstate(invalid="ignore"):
            samples = raw.astype(np.float64)
        wrong = ~(np.abs(samples) <= MAX_COUNTS)
        if wrong.any():
            k = int(np.argmax(wrong))
            raise ValueError(f"{self.location(f'{kind}waveform', shot)}: sample {k} is {samples[k]:g}")
        return samples

    def _error_of_location(self, kind: str, shot: int) -> ValueError | None:
        """Return the reason why the location of a shot's samples is not known, or None where it is."""
        location = self._sample_locations[kind]
        count_field, start_field = f"{kind}_sample_count", f"{kind}_sample_start_index"
        count, start, size = location.count[shot], location.start[shot], location.size
        if count < 0:
            value = self._per_shot[count_field][shot]
            return ValueError(
                f"{self.location(count_field, shot)}: {value:g} is no whole number in [0, {size}]"
            )
        if count < 2:
            return ValueError(f"{self.location(count_field, shot)}: {count} samples; at least 2 belong here")
        if start < 0:
            value = location.indices[shot]
            return ValueError(
                f"{self.location(start_field, shot)}: {value:g} does not place its {count} samples between "
                f"those of its neighbours, in [1, {size}]"
            )
        if start + count > size:
            return ValueError(
                f"{self.location(start_field, shot)}: samples {start + 1} to {start + count} of {size} that "
                "are stored"
            )
        return None

    def number_of(self, shot: int) -> int:
        """Return the unique number of a shot; -1 where the file's are no whole numbers."""
        try:
            return int(self.shot_number[shot])
        except ValueError:
            return -1

    @functools.cached_property
    def shot_number(self) -> np.ndarray:
        """(shots,) unique numbers of the product."""
        return self.file.integers(f"{self.name}/shot_number")

    @functools.cached_property
    def _per_shot(self) -> dict[str, np.ndarray]:
        """Numbers of shots by field, in double precision; NaN where they are missing."""
        return {field: self._numbers(field) for field in _PER_SHOT}

    @functools.cached_property
    def _optional(self) -> dict[str, np.ndarray]:
        """Numbers of shots by name, of those of `_OPTIONAL` that the file has; NaN where they are missing.

        Flags that are no whole numbers are missing, too.
        """
        columns = {}
        for name, field in _OPTIONAL.items():
            if not self._has(field):
                continue
            try:
                values = self._numbers(field)
            except ValueError as error:
                self.remarks.append(f"{error}: it is left out")
                continue
            wrong = ~((values == np.floor(values)) & (np.abs(values) <= MAX_EXACT_INTEGER))
            if name in _FLAGS and wrong.any():
                first = int(np.argmax(wrong))
                self.remarks.append(
                    f"{self.location(field, first)}: {values[first]:g} is no whole number: {np.sum(wrong)} "
                    f"of {self.size} flags of {self.name} left out"
                )
                values = np.where(wrong, np.nan, values)
            columns[name] = values
        return columns

    @functools.cached_property
    def _sample_locations(self) -> "dict[str, _SampleLocation]":
        """Locations of the samples received ("rx") and sent ("tx")."""
        return {kind: self._sample_location(kind) for kind in ("rx", "tx")}

    def _sample_location(self, kind: str) -> "_SampleLocation":
        """Return the samples' location in a waveform dataset, and remark on start indices that are replaced.

        **Raises:** ValueError for indices and counts that do not fit the stored samples.
        """
        size = self._dataset(f"{kind}waveform").size
        count = _whole_numbers(self._per_shot[f"{kind}_sample_count"], 0, size)
        field = f"{kind}_sample_start_index"
        indices = self._numbers(field) if self._has(field) else np.full(self.size, np.nan)
        # The product counts from 1.
        recorded_start = np.maximum(_whole_numbers(indices, 1, 2**62) - 1, -1)
        # Shots without samples need no start.
        (shots,) = np.nonzero(count != 0)
        start = np.full(self.size, -1)
        start[shots] = _locate_samples(self.location(field), recorded_start[shots], count[shots], size)
        replaced = (recorded_start < 0) & (start >= 0)
        if replaced.any():
            first = int(np.argmax(replaced))
            self.remarks.append(
                f"{self.location(field, first)}: {indices[first]:g} is no whole number in [1, {size}]: the "
                f"samples of {np.sum(replaced)} shots of {self.name} are located by the counts"
            )
        return _SampleLocation(start, count, indices, size)

    def _has(self, field: str) -> bool:
        return self.file.has(f"{self.name}/{field}")

    def _dataset(self, field: str) -> Any:
        return self.file.dataset(f"{self.name}/{field}")

    def _numbers(self, field: str) -> np.ndarray:
        """Return the numbers of all shots, in the unit of `_UNITS`; NaN where they are missing."""
        return self.file.numbers(f"{self.name}/{field}", _UNITS.get(field, ""), shape=(self.size,))


class _SampleLocation(NamedTuple):
    """Location of the samples of shots in a dataset.

    - `start`: (shots,) index of the first sample, from 0; -1 where it is not known.
    - `count`: (shots,) number of samples; -1 where it is not known.
    - `indices`: (shots,) start indices as in the file, NaN where they are missing.
    - `size`: number of samples in the dataset.
    """

    start: Int[np.ndarray, " shots"]
    count: Int[np.ndarray, " shots"]
    indices: Float[np.ndarray, " shots"]
    size: int


def _whole_numbers(values: np.ndarray, low: int, high: int) -> np.ndarray:
    """Return values as integers; -1 for those that are no whole numbers in [low, high]."""
    is_whole = (values >= low) & (values <= high) & (values == np.floor(values))
    return np.where(is_whole, values, -1.0).astype(np.int64)


def _locate_samples(location: str, start: np.ndarray, count: np.ndarray, size: int) -> np.ndarray:
    """Return the first samples of shots, which follow one another in a dataset.

    1. Recorded starts are used if they all lie within the dataset, one after another.
    2. If the counts of all shots add up to the size, samples follow one another without gaps: starts are
       those of the full file, or some are missing.
    3. Recorded starts are used if they follow one another without gaps from the first sample on, or up to the
       last one: samples, or some starts or counts, are missing. Missing starts are replaced where their
       neighbours leave room for just the samples of the shots between.

    Where 2 and 3 place a shot differently, a count or a start is wrong: its place is not known.

    **Arguments:** `location`: of the starts, for messages. `start`, `count`: (shots,), -1 where they are
    missing. `size`: of the dataset.

    **Returns:** (shots,) indices, -1 where they are not known.

    **Raises:** ValueError where neither starts nor counts fit.
    """
    end = start + count
    is_placed = (start >= 0) & (count >= 0)
    if np.all(is_placed) and np.all(end <= size) and np.all(start[1:] >= end[:-1]):
        return start
    by_count = np.cumsum(count) - count if np.all(count >= 0) and count.sum() == size else None
    (placed,) = np.nonzero(is_placed)
    is_anchored = (is_placed[0] and start[0] == 0) or (is_placed[-1] and end[-1] == size)
    follows = (start[1:] == end[:-1])[is_placed[1:] & is_placed[:-1]]
    if not (is_anchored and np.all(follows)):
        if by_count is None and np.any(count >= 0):
            raise ValueError(
                f"{location}: neither do the indices fit the {size} samples stored, nor do the counts "
                f"({np.sum(np.maximum(count, 0))} in all)"
            )
        return np.full(start.shape, -1) if by_count is None else by_count
    by_start = np.where(is_placed, start, -1)
    # Runs of shots between two that are placed, or between one and an end of the dataset.
    for before, after in zip(np.r_[-1, placed].tolist(), np.r_[placed, start.size].tolist()):
        run = slice(before + 1, after)
        run_begin = int(end[before]) if before >= 0 else 0
        run_end = int(start[after]) if after < start.size else size
        if np.all(count[run] >= 0) and count[run].sum() == run_end - run_begin:
            by_start[run] = run_begin + np.cumsum(count[run]) - count[run]
    return by_start if by_count is None else np.where(by_start == by_count, by_count, -1)
