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
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxlidar.io.checks import (
    MAX_COORDINATE,
    MAX_COUNTS,
    TWO_WAY_METRES_PER_NS,
    TWO_WAY_TOLERANCE,
    check_unpacked_size,
    existing_file,
    refuse_damage,
)
from jaxlidar.io.noise import above_pedestal

# Datasets of a beam's group with a number for each shot.
_PER_SHOT = (
    "rx_sample_count",
    "rx_sample_start_index",
    "tx_sample_count",
    "tx_sample_start_index",
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
# Datasets of the flags of a GediShot; subsets may have left them out.
_FLAGS = {"degrade": "geolocation/degrade", "stale_return": "stale_return_flag"}
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


def read_gedi_l1b(
    path: str | os.PathLike[str], shot: int | np.integer | Sequence[int] | np.ndarray | None = None
) -> list[GediShot]:
    """Read the shots of a GEDI L1B file, or of a subset of one in the same layout.

    This needs h5py (`pip install "jaxlidar[io]"`). From beams without a requested shot nothing is read but,
    to find shots by number, the numbers.

    Start indices are used where they fit the stored samples. Where they do not, as in subsets that kept the
    numbering of the full file, the samples of shots follow one another without gaps, as many as the counts.

    **Arguments:**

    - `path`: an HDF5 file.
    - `shot`: the requested shots, an integer or several. A number below the number of shots in the file is an
      index, from 0, into all shots, beam after beam in the order of the file; any other is a shot number.
      Default None: all.

    **Returns:** a list of `GediShot`, in the order of `shot`; one integer gives a list of one.

    **Raises:** FileNotFoundError where there is no such file. ImportError without h5py. ValueError, naming
    the file and the place, for a file that is not HDF5, is damaged or declares more than it can hold, is no
    GEDI L1B product or holds a shot whose numbers make no sense, such as a pulse without energy or bins that
    are not 1 ns apart, and for a shot that it does not hold.

    **Source:** GEDI L1B product data dictionary (Dubayah et al. 2020, doi:10.5067/GEDI/GEDI01_B.002); Luthcke
    et al. 2019, GEDI waveform geolocation for L1 and L2 products (theoretical basis document).

    **Example:**

    >>> import jaxlidar as jl
    >>> import jaxlidar.io
    >>> (shot,) = jaxlidar.io.read_gedi_l1b("GEDI01_B.h5", shot=0)  # doctest: +SKIP
    >>> pulse = jl.SampledPulse(time=shot.pulse_time, power=shot.pulse_power)  # doctest: +SKIP
    >>> lidar = jl.Lidar(pulse=pulse, zenith=shot.zenith, azimuth=shot.azimuth)  # doctest: +SKIP
    """
    try:
        import h5py
    except ImportError as error:
        raise ImportError('reading HDF5 needs h5py: pip install "jaxlidar[io]"') from error
    path = existing_file(path)
    with contextlib.ExitStack() as stack:
        with refuse_damage(f"{path}: not a readable HDF5 file"):
            file = stack.enter_context(h5py.File(path, "r"))
            names = [name for name in map(str, file) if name.startswith("BEAM")]
        if not names:
            raise ValueError(f"{path}: no group BEAM...: no GEDI L1B product")
        selected = _select(path, [_Beam(path, file, name) for name in names], shot)
        # By beam, so that the samples of neighbouring shots are read together.
        indices_by_beam: dict[_Beam, set[int]] = {}
        for beam, i in selected:
            indices_by_beam.setdefault(beam, set()).add(i)
        shots = {beam: _shots(beam, sorted(indices)) for beam, indices in indices_by_beam.items()}
        return [shots[beam][i] for beam, i in selected]


def _select(path: Path, beams: "list[_Beam]", shot: Any) -> "list[tuple[_Beam, int]]":
    """Return the beam, and the index within it, of each requested shot. **Raises:** as `read_gedi_l1b`."""
    order = [(beam, i) for beam in beams for i in range(len(beam))]
    if shot is None:
        return order
    requested = [shot] if isinstance(shot, int | np.integer) else list(shot)
    by_number: dict[int, tuple[_Beam, int]] = {}
    selected = []
    for number in requested:
        if not isinstance(number, int | np.integer) or isinstance(number, bool):
            raise ValueError(f"shot = {number} is neither an index nor a shot number: both are integers")
        if 0 <= number < len(order):
            selected.append(order[int(number)])
            continue
        if not by_number:
            by_number = {int(n): (beam, i) for beam in beams for i, n in enumerate(beam.shot_number)}
        if int(number) not in by_number:
            raise ValueError(
                f"{path}: shot = {number} is neither an index in [0, {len(order) - 1}] "
                "nor the number of a shot here"
            )
        selected.append(by_number[int(number)])
    return selected


def _shots(beam: "_Beam", indices: list[int]) -> dict[int, GediShot]:
    received, transmitted = beam.samples("rx", indices), beam.samples("tx", indices)
    return {i: _shot(beam, i, received[i], transmitted[i]) for i in indices}


def _shot(beam: "_Beam", i: int, received: np.ndarray, transmitted: np.ndarray) -> GediShot:
    # The pointing vector leads from the footprint to the sensor, so its elevation is above the horizon.
    above_horizon = beam.number("geolocation/local_beam_elevation", i, 0.0, np.pi / 2 + 1e-6)
    towards = beam.number("geolocation/local_beam_azimuth", i, -2 * np.pi, 2 * np.pi)
    top = beam.number("geolocation/elevation_bin0", i)
    bottom = beam.number("geolocation/elevation_lastbin", i)
    location = beam.location("geolocation/elevation_lastbin", i)
    if bottom >= top:
        raise ValueError(f"{location}: {bottom:g} m is not below the first bin, {top:g} m")
    step = (top - bottom) / (received.size - 1)
    expected = TWO_WAY_METRES_PER_NS * np.sin(above_horizon)
    if abs(step - expected) > TWO_WAY_TOLERANCE * expected:
        raise ValueError(
            f"{location}: {step:g} m from bin to bin, where 1 ns along the beam is {expected:.4f} m of "
            "elevation"
        )
    pulse_zero = beam.number("tx_gloc", i, 0.0, transmitted.size - 1)
    pedestal = float(np.median(transmitted[: max(transmitted.size // 4, 1)]))
    return GediShot(
        beam=beam.name,
        shot_number=int(beam.shot_number[i]),
        time=np.arange(received.size, dtype=np.float64),
        elevation=np.linspace(top, bottom, received.size),
        waveform=received,
        noise_mean=beam.number("noise_mean_corrected", i),
        noise_std=beam.number("noise_stddev_corrected", i, 0.0),
        pulse_time=np.arange(transmitted.size) - pulse_zero,
        pulse_power=above_pedestal(transmitted, pedestal, beam.location("txwaveform", i)),
        latitude=beam.number("geolocation/latitude_lastbin", i, -90.0, 90.0),
        longitude=beam.number("geolocation/longitude_lastbin", i, -180.0, 360.0),
        altitude=beam.number("geolocation/altitude_instrument", i),
        zenith=max(0.0, 90.0 - float(np.rad2deg(above_horizon))),
        azimuth=float(np.rad2deg(towards) + 180.0) % 360.0,
        degrade=beam.flag("degrade", i),
        stale_return=beam.flag("stale_return", i),
    )


class _Beam:
    """The group of one beam: its numbers for each shot, and the samples of shots.

    Datasets are compared with the file before they are read. Numbers of all shots are read when the first is
    used. Two beams are equal if they are the same object.
    """

    def __init__(self, path: Path, file: Any, name: str):
        self.path, self.file, self.name = path, file, name
        self.size = self._dataset("shot_number").shape[0]

    def __len__(self) -> int:
        return self.size

    def location(self, field: str, shot: int | None = None) -> str:
        """Return the location of a field, and of a shot in it, for messages."""
        location = f"{self.path}: /{self.name}/{field}"
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

    def flag(self, name: str, shot: int) -> int | None:
        """Return a flag of a shot, or None where the file does not have it."""
        values = self._flags.get(name)
        return None if values is None else int(values[shot])

    def samples(self, kind: str, shots: Sequence[int]) -> dict[int, np.ndarray]:
        """Return the samples of shots in increasing order, of the received ("rx") or sent ("tx") waveform.

        Shots that follow one another are read in one pass.
        """
        field = f"{kind}waveform"
        start, count = self._start_and_count[kind]
        dataset, samples_by_shot = self._dataset(field), {}
        runs = np.split(np.array(shots), np.flatnonzero(np.diff(shots) > 1) + 1)
        for run in (run.tolist() for run in runs):
            first, end = int(start[run[0]]), int(start[run[-1]] + count[run[-1]])
            with refuse_damage(f"{self.location(field, run[0])}: damaged"):
                run_samples = dataset[first:end]
            for i in run:
                if count[i] < 2:
                    raise ValueError(
                        f"{self.location(f'{kind}_sample_count', i)}: {count[i]} samples; at least 2 belong "
                        "here"
                    )
                offset = start[i] - first
                samples = run_samples[offset : offset + count[i]].astype(np.float64)
                wrong = ~(np.abs(samples) <= MAX_COUNTS)
                if wrong.any():
                    k = int(np.argmax(wrong))
                    raise ValueError(f"{self.location(field, i)}: sample {k} is {samples[k]:g}")
                samples_by_shot[i] = samples
        return samples_by_shot

    @functools.cached_property
    def shot_number(self) -> np.ndarray:
        """(shots,) unique numbers of the product."""
        numbers = self._read("shot_number")
        if numbers.dtype.kind not in "iu":
            raise ValueError(
                f"{self.location('shot_number')}: type {numbers.dtype} where whole numbers belong"
            )
        return numbers

    @functools.cached_property
    def _per_shot(self) -> dict[str, np.ndarray]:
        for field in _PER_SHOT:
            shape = self._dataset(field).shape
            if shape != (self.size,):
                raise ValueError(
                    f"{self.location(field)}: shape {shape}, but shot_number has the shape {(self.size,)}"
                )
        return {field: self._read(field) for field in _PER_SHOT}

    @functools.cached_property
    def _flags(self) -> dict[str, np.ndarray]:
        flags = {}
        for name, field in _FLAGS.items():
            with refuse_damage(f"{self.location(field)}: damaged"):
                is_missing = f"{self.name}/{field}" not in self.file
            if is_missing:
                continue
            values = self._read(field)
            if values.shape != (self.size,) or values.dtype.kind not in "iu":
                raise ValueError(
                    f"{self.location(field)}: shape {values.shape} and type {values.dtype}, where a whole "
                    f"number for each of {self.size} shots belongs"
                )
            flags[name] = values
        return flags

    @functools.cached_property
    def _start_and_count(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Index of the first sample of each shot, from 0, and number of samples; received and sent."""
        start_and_count = {}
        for kind in ("rx", "tx"):
            size = self._dataset(f"{kind}waveform").size
            count = self._integers(f"{kind}_sample_count", size)
            # The product counts from 1.
            start = self._integers(f"{kind}_sample_start_index", 2**62) - 1
            end = start + count
            if not (np.all(start >= 0) and np.all(end <= size) and np.all(start[1:] >= end[:-1])):
                if count.sum() != size:
                    raise ValueError(
                        f"{self.location(f'{kind}_sample_start_index')}: neither do the indices fit the "
                        f"{size} samples stored, nor do the counts ({count.sum()} in all)"
                    )
                start = np.cumsum(count) - count
            start_and_count[kind] = (start, count)
        return start_and_count

    def _integers(self, field: str, high: int) -> np.ndarray:
        values = self._per_shot[field]
        if values.dtype.kind == "f":
            # Half precision does not hold the limits of the comparison.
            values = values.astype(np.float64)
        wrong = ~((values >= 0) & (values <= high) & (values == np.floor(values)))
        if wrong.any():
            i = int(np.argmax(wrong))
            raise ValueError(f"{self.location(field, i)}: {values[i]:g} is no whole number in [0, {high}]")
        return values.astype(np.int64)

    def _dataset(self, field: str) -> Any:
        """Return a dataset of numbers in one dimension, all of which are stored in the file."""
        with refuse_damage(f"{self.location(field)}: damaged"):
            node = self.file.get(f"{self.name}/{field}")
            shape, kind = getattr(node, "shape", None), getattr(getattr(node, "dtype", None), "kind", None)
        if shape is None or kind is None:
            raise ValueError(f"{self.location(field)}: no such dataset; it is part of a GEDI L1B product")
        if kind not in "iuf":
            raise ValueError(f"{self.location(field)}: type {node.dtype} where numbers belong")
        if len(shape) != 1:
            raise ValueError(f"{self.location(field)}: shape {shape}, where one dimension belongs")
        with refuse_damage(f"{self.location(field)}: damaged"):
            # HDF5 returns zeros for what is not stored, as many as are declared.
            is_elsewhere = node.is_virtual or node.external
            (chunk,) = node.chunks or shape
            chunks = math.ceil(shape[0] / chunk) if chunk else 0
            contiguous = node.id.get_storage_size() // max(node.nbytes, 1)
            stored = node.id.get_num_chunks() if node.chunks else contiguous
        if is_elsewhere or stored < chunks:
            raise ValueError(
                f"{self.location(field)}: {shape[0]} numbers are declared, but the file holds {stored} of "
                f"{chunks} parts of them"
            )
        check_unpacked_size(self.path, f"/{self.name}/{field}", chunks * chunk * node.dtype.itemsize)
        return node

    def _read(self, field: str) -> np.ndarray:
        dataset = self._dataset(field)
        with refuse_damage(f"{self.location(field)}: damaged"):
            return dataset[:]
