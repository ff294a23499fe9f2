"""Readers of NASA's Land, Vegetation and Ice Sensor (LVIS): level 1B waveforms (HDF5), level 2 text.

Level 1B has the longitude, latitude and elevation of the first and the last sample of a return, on the
ellipsoid of WGS-84, and no sampling interval: that follows from the distance of the two. Versions differ in
the number of samples, by which the fields of the last one are named: version 1 has `LON527`, or `LON431`,
version 2 `LON1023`.
"""

import functools
import math
import os
import re
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float

from jaxlidar._fields.checks import warn_user
from jaxlidar.formats.airborne import AirborneShots, Segment, evenly_spaced
from jaxlidar.formats.checks import (
    MAX_COUNTS,
    MAX_EXACT_INTEGER,
    TWO_WAY_METRES_PER_NS,
    TWO_WAY_TOLERANCE,
    FileWarning,
    check_step_of_light,
    refuse_damage,
)
from jaxlidar.formats.coordinates import GEOGRAPHIC_3D, CoordinateUnits, check_elevations
from jaxlidar.formats.hdf5 import ProductFile, open_hdf5
from jaxlidar.formats.noise import QUIET_SAMPLES
from jaxlidar.formats.tables import Column, ColumnAxis, ShotTable
from jaxlidar.formats.text import parse_number, read_lines, split_cells

_PRODUCT = "LVIS L1B"
_UNITS = CoordinateUnits(True, np.pi / 180.0, 1.0)
# Columns of shots that files may have, and their units.
_COLUMNS = {"TIME": "s", "SHOTNUMBER": "", "SIGMEAN": "", "INCIDENTANGLE": "degrees"}
# Shots whose samples are read at once.
_BLOCK = 256
# Sampling intervals in ns of the digitisers in use.
_STEPS = (1.0, 2.0)
# Largest difference of a stated noise level from that of quiet samples, in standard deviations and in counts.
_NOISE_SIGMAS, _NOISE_COUNTS = 3.0, 1.0
# Largest difference in degrees of a stated angle of incidence from that of the line of samples.
_ANGLE_TOLERANCE = 0.5
# A column of the last sample, such as LON1023.
_LAST_SAMPLE = re.compile(r"LON([1-9]\d*)")
# Names of the columns of level 2 text, and those of the table; others keep theirs in small letters.
_LEVEL_2 = {
    "GLON": ("longitude", "degrees", "of the ground"),
    "GLAT": ("latitude", "degrees", "of the ground"),
    "ZG": ("ground", "m", "elevation of the lowest mode"),
    "HLON": ("longitude_highest", "degrees", "of the highest mode"),
    "HLAT": ("latitude_highest", "degrees", "of the highest mode"),
    "ZH": ("elevation_highest", "m", "elevation of the highest mode"),
    "TLON": ("longitude_top", "degrees", "of the first return"),
    "TLAT": ("latitude_top", "degrees", "of the first return"),
    "ZT": ("canopy_top", "m", "elevation of the first return"),
    "TIME": ("time", "s", "seconds of the day, UTC"),
    "SHOTNUMBER": ("shot_number", "", "number of the shot in the flight line"),
    "LFID": ("lfid", "", "identification of the flight line"),
    "INCIDENTANGLE": ("zenith", "degrees", "angle of incidence"),
    "AZIMUTH": ("azimuth", "degrees", "of the aircraft's view"),
    "RANGE": ("range", "m", "from the sensor to the ground"),
    "SENSITIVITY": ("sensitivity", "", "largest cover through which the ground is detected"),
}
_RELATIVE_HEIGHT = re.compile(r"RH(\d+)")
# Columns that a level 2 file must have.
_LEVEL_2_NEEDED = ("GLON", "GLAT", "ZG")


def read_lvis_l1b(path: str | os.PathLike[str]) -> AirborneShots:
    """Read the waveforms of an LVIS level 1B file (HDF5), of version 1 or 2.

    This needs h5py (`pip install "jaxlidar[io]"`). Shots are read when they are indexed, some at a time.
    Positions are longitude, latitude (degrees) and elevation (m) on the ellipsoid of WGS-84. Time 0 of a shot
    is its first sample, and a sample lies where a target is whose echo has the pulse's time zero there: the
    largest sample of the transmitted pulse. `gps_time` is the file's: seconds of the day, UTC.

    The mean noise of a shot is that which the file states (`SIGMEAN`), unless it differs from the first
    samples of returns by more than three standard deviations and a count in the median.

    **Arguments:**

    - `path`: an HDF5 file with `RXWAVE`, `TXWAVE`, `LON0`, `LAT0`, `Z0`, and those of the last sample, such
      as `LON1023`. `TIME`, `SHOTNUMBER`, `SIGMEAN` and `INCIDENTANGLE` are used where they are there.

    **Returns:** an `AirborneShots`.

    **Warns:** `FileWarning` where the stated noise is not that of the quiet samples and is not used, and
    where stated angles of incidence are not those of the lines of samples.

    **Raises:** FileNotFoundError where there is no such file. ImportError without h5py. ValueError, naming
    the file and the place, for a file that is not HDF5, is damaged, lacks a dataset, or whose samples are not
    1 or 2 ns apart; for a shot when it is indexed.

    **Source:** Blair, Rabine and Hofton (1999), ISPRS J. Photogramm. 54, 115; LVIS level 1B user guide (NSIDC
    data set LVISF1B).

    **Example:**

    >>> import jaxlidar as jl
    >>> shots = jl.io.read_lvis_l1b("LVISF1B.h5")  # doctest: +SKIP
    >>> stack = jl.io.stack_shots(shots[:1000])  # doctest: +SKIP
    """
    return _LvisShots(Path(path))


@final
class _LvisShots(AirborneShots):
    def __init__(self, path: Path):
        self.path, self.tables, self.dropped = path, {}, {}
        with open_hdf5(path, _PRODUCT) as file:
            last = _number_of_last_sample(file)
            first_position, last_position = (_positions(file, number) for number in ("0", last))
            shots = len(first_position)
            shapes = {name: file.dataset(name, 2).shape for name in ("RXWAVE", "TXWAVE")}
            columns = {
                name: file.numbers(name, unit, shape=(shots,)) if file.has(name) else None
                for name, unit in _COLUMNS.items()
            }
        for name, shape in shapes.items():
            if shape[0] != shots or shape[1] < QUIET_SAMPLES:
                raise ValueError(
                    f"{path}: /{name}: shape {shape}; admissible is ({shots}, samples), at least "
                    f"{QUIET_SAMPLES}"
                )
        self._samples = shapes["RXWAVE"][1]
        if int(last) != self._samples - 1:
            raise ValueError(
                f"{path}: /LON{last}: that of the last sample, but /RXWAVE has {self._samples} samples"
            )
        if shots == 0:
            raise ValueError(f"{path}: /LON0: no shot")
        self._anchor, self._columns = first_position, columns
        self._step, self._direction = _lines(path, first_position, last_position, self._samples)
        self._block: tuple[int, np.ndarray, np.ndarray] | None = None
        self._check_angles()
        # Called for its warning: where the file is read, not where a shot is.
        _ = self._stated_noise

    def __len__(self) -> int:
        return len(self._anchor)

    @property
    def gps_time(self) -> np.ndarray:
        time = self._columns["TIME"]
        return np.full(len(self), np.nan) if time is None else time

    @property
    def anchor(self) -> np.ndarray:
        return self._anchor

    @property
    def direction(self) -> np.ndarray:
        return self._direction

    def _check_angles(self) -> None:
        """Warn where the angles that the file states are not those of its lines."""
        stated = self._columns["INCIDENTANGLE"]
        if stated is None:
            return
        east, north, up = (self._direction * _UNITS.metres(self._anchor)).T
        zenith = np.rad2deg(np.arctan2(np.hypot(east, north), -up))
        difference = np.abs(stated - zenith)
        difference = difference[np.isfinite(difference)]
        if difference.size and np.median(difference) > _ANGLE_TOLERANCE:
            warn_user(
                f"{self.path}: /INCIDENTANGLE: {np.median(difference):.2g} degrees from the lines of "
                "samples in the median: the lines are used",
                FileWarning,
            )

    @functools.cached_property
    def _stated_noise(self) -> np.ndarray | None:
        """Mean noise of shots as the file states it; None where it does not, or quiet samples differ."""
        stated = self._columns["SIGMEAN"]
        if stated is None:
            return None
        rows = np.arange(len(self))[evenly_spaced(len(self))]
        quiet = np.array([self._waves(int(i))[0][:QUIET_SAMPLES].mean(dtype=float) for i in rows])
        is_finite = np.isfinite(stated[rows]) & np.isfinite(quiet)
        if not np.any(is_finite):
            return None
        difference = abs(float(np.median((stated[rows] - quiet)[is_finite])))
        tolerance = _NOISE_SIGMAS * self.levels.noise_std + _NOISE_COUNTS
        # Written so that NaN counts as a difference.
        if not difference <= tolerance:
            warn_user(
                f"{self.path}: /SIGMEAN: {difference:.3g} counts from the first samples of returns in the "
                "median: these are used",
                FileWarning,
            )
            return None
        return stated

    def _waves(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the received and the transmitted samples of a shot, which are read a block at a time."""
        start = index // _BLOCK * _BLOCK
        if self._block is None or self._block[0] != start:
            rows = slice(start, start + _BLOCK)
            with open_hdf5(self.path, _PRODUCT) as file:
                received, sent = (file.read(name, 2, rows) for name in ("RXWAVE", "TXWAVE"))
            self._block = start, received, sent
        _, received, sent = self._block
        return received[index - start], sent[index - start]

    def _read(self, index: int) -> dict[str, Any]:
        location = f"{self.path}: shot {index}"
        anchor, direction = self._anchor[index], self._direction[index]
        if not np.all(np.isfinite([anchor, direction])):
            raise ValueError(f"{location}: its position is {anchor.tolist()}")
        check_elevations(location, anchor[2])
        length = float(np.linalg.norm(direction * _UNITS.metres(anchor)))
        check_step_of_light(location, length)
        if direction[2] >= 0:
            raise ValueError(f"{location}: its last sample is not below the first one")
        received, sent = self._waves(index)
        for name, samples in (("RXWAVE", received), ("TXWAVE", sent)):
            # Written so that NaN is refused.
            if not np.all(np.abs(samples) <= MAX_COUNTS):
                raise ValueError(f"{self.path}: /{name}: shot {index}: samples are no counts")
        arguments: dict[str, Any] = {
            "anchor": anchor,
            "direction": direction,
            "returning": (Segment(received, 0.0, self._step),),
            "outgoing": (Segment(sent, 0.0, self._step),),
            "metres": _UNITS.metres(anchor),
            "crs": GEOGRAPHIC_3D,
        }
        time, number = self._columns["TIME"], self._columns["SHOTNUMBER"]
        if time is not None and np.isfinite(time[index]):
            arguments["gps_time"] = float(time[index])
        if number is not None and np.abs(number[index]) <= MAX_EXACT_INTEGER:
            arguments["index"] = int(number[index])
        # While levels are estimated, the stated ones are not yet compared with them.
        stated = self.__dict__.get("_stated_noise")
        if stated is not None and np.isfinite(stated[index]):
            arguments["noise_mean"] = float(stated[index])
        return arguments


def _number_of_last_sample(file: ProductFile) -> str:
    """Return the number by which the fields of the last sample are named, such as "1023"."""
    with refuse_damage(f"{file.path}: not a readable HDF5 file"):
        names = list(map(str, file.file))
    matches = [match[1] for name in names if (match := _LAST_SAMPLE.fullmatch(name))]
    if not file.has("RXWAVE") or not matches:
        raise ValueError(
            f"{file.path}: no dataset RXWAVE, LON0 and that of the last sample: no {_PRODUCT} product"
        )
    return max(matches, key=int)


def _positions(file: ProductFile, number: str) -> Float[np.ndarray, "shots 3"]:
    """Return longitude, latitude and elevation of a sample, such as "1023"."""
    longitude = file.numbers(f"LON{number}", "degrees")
    latitude = file.numbers(f"LAT{number}", "degrees", shape=longitude.shape)
    elevation = file.numbers(f"Z{number}", "m", shape=longitude.shape)
    position = np.stack([longitude, latitude, elevation], axis=-1)
    # Longitudes of some versions lie in [0, 360).
    position[:, 0] = np.remainder(position[:, 0] + 180.0, 360.0) - 180.0
    return position


def _lines(
    path: Path, first: Float[np.ndarray, "shots 3"], last: Float[np.ndarray, "shots 3"], samples: int
) -> tuple[float, Float[np.ndarray, "shots 3"]]:
    """Return the sampling interval in ns, and the directions per ns from the first to the last samples.

    **Raises:** ValueError where the interval is none of those in use.
    """
    if first.shape != last.shape:
        raise ValueError(f"{path}: /LON0: {len(first)} shots, but {len(last)} have a last sample")
    difference = last - first
    difference[:, 0] = np.remainder(difference[:, 0] + 180.0, 360.0) - 180.0
    length = np.linalg.norm(difference * _UNITS.metres(first), axis=-1)
    length = length[np.isfinite(length)]
    interval = float(np.median(length)) / (samples - 1) / TWO_WAY_METRES_PER_NS if length.size else np.nan
    for step in _STEPS:
        if abs(interval - step) <= TWO_WAY_TOLERANCE * step:
            return step, difference / ((samples - 1) * step)
    raise ValueError(
        f"{path}: /Z0: samples {interval:.4g} ns apart, by the positions of the first and the last; "
        f"admissible are {' and '.join(f'{step:g}' for step in _STEPS)} ns"
    )


def read_lvis_l2(path: str | os.PathLike[str]) -> ShotTable:
    r"""Read the ground and the relative heights of an LVIS level 2 text file.

    **Arguments:**

    - `path`: a text file of columns, whose names stand in the last line that begins with "#".

    **Returns:** a `ShotTable`. Columns have the names of the file in small letters, but for `longitude`,
    `latitude` and `ground` (the lowest mode), `longitude_highest`, `latitude_highest` and `elevation_highest`
    (the highest mode), `longitude_top`, `latitude_top` and `canopy_top` (the first return), `shot_number`,
    `zenith`, `time`; and `rh` (shots, percentiles). Lengths are m, longitudes lie in [-180, 180).

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming file and line, for a file
    that is not text, that lacks the names of columns or the ground's, and for rows that are not numbers, or
    infinite ones.

    **Source:** LVIS level 2 user guide (NSIDC data set LVISF2).

    **Example:**

    >>> import pathlib, tempfile
    >>> import jaxlidar as jl
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "LVISF2.TXT"
    >>> head = "# LFID SHOTNUMBER TIME GLON GLAT ZG RH50 RH98"
    >>> _ = path.write_text(f"# LVIS level 2\n{head}\n1 7 100.5 290.25 45.5 310.2 4.1 17.9\n")
    >>> table = jl.io.read_lvis_l2(path)
    >>> print(f"{table['longitude'][0]:.2f}, ground {table['ground'][0]} m, RH98 {table['rh'][0, 1]} m")
    -69.75, ground 310.2 m, RH98 17.9 m
    """
    path, lines = read_lines(path)
    comments = [number for number, line in enumerate(lines) if line.lstrip().startswith("#")]
    names: list[str] = []
    for number in reversed(comments):
        candidate = lines[number].lstrip("# ").split()
        if all(name in candidate for name in _LEVEL_2_NEEDED):
            names = candidate
            break
    if not names:
        raise ValueError(f"{path}: no line begins with # and names the columns {', '.join(_LEVEL_2_NEEDED)}")
    rows = []
    for number, line in enumerate(lines, 1):
        if line.strip() and not line.lstrip().startswith("#"):
            cells = split_cells(path, number, line, " ", len(names))
            row = [parse_number(path, number, name, cell) for name, cell in zip(names, cells)]
            # NaN is a missing number; an infinite one is damage.
            for name, value in zip(names, row):
                if math.isinf(value):
                    raise ValueError(f"{path}: line {number}: {name} is not finite")
            rows.append(row)
    values = np.array(rows, float).reshape(len(rows), len(names))
    columns: dict[str, Column] = {}
    levels = {name: int(match[1]) for name in names if (match := _RELATIVE_HEIGHT.fullmatch(name))}
    for name, column in zip(names, values.T):
        if name in levels:
            continue
        title, unit, description = _LEVEL_2.get(name, (name.lower(), "", ""))
        if unit == "degrees" and title.startswith("longitude"):
            column = np.remainder(column + 180.0, 360.0) - 180.0
        is_whole = title in ("shot_number", "lfid") and bool(
            np.all((column == np.floor(column)) & (np.abs(column) <= MAX_EXACT_INTEGER))
        )
        columns[title] = Column(column.astype(np.int64) if is_whole else column, unit, description)
    if levels:
        ordered = sorted(levels, key=lambda name: levels[name])
        axis = ColumnAxis("percentile", np.array([levels[name] for name in ordered], float), "percent")
        heights = values[:, [names.index(name) for name in ordered]]
        columns["rh"] = Column(heights, "m", "relative height", axis)
    return ShotTable(columns, {"product": "LVIS L2"})
