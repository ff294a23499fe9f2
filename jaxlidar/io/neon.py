"""Reader of recorded waveforms: NEON's airborne full-waveform lidar, as an .npz of arrays.

The arrays are those of the sample that comes with the R package waveformlidar, with its names for the columns
of the geolocation. What they refer to was found from the recorded numbers, and `NeonShot` relies on it.

- (`V9`, `V10`, `V11`) is where sample `V16` (0 throughout) of the return lies, and (`dx`, `dy`, `dz`) is the
  way from one sample to the next, 0.14986 m: half of what light travels in air in 1 ns.
- (`x`, `y`, `z`), the position of the first return, lies at the sample `fr` + `V15` - `or`, to 0.0001 m of
  height. `fr` and `or` are where the return and the outgoing pulse rise to half of their height, `V15` is the
  outgoing pulse's largest sample, counted from 0. So a sample lies where a target is whose echo has the
  largest sample of the outgoing pulse there: that is time zero of the pulse.
- A hard target's echo is broader than its outgoing pulse, as though by a Gaussian of 1.9 ns
  (`Lidar(jitter=1.9)`), and so rises to half 0.5 ns earlier: ground fitted with time zero as above lies 0.07
  m below the discrete returns of flat targets.
- Zeros are not samples: they fill rows to a common length, and the gaps between segments of a return.
- The pedestal is that of the digitiser: samples before the returns do not vary with the outgoing pulse's, nor
  from shot to shot by more than noise. Noise is correlated over about 5 samples.
- The horizontal positions in the sample have seven digits, that is 1 m in northing.
"""

import dataclasses
import os
import zipfile
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar.io.pedestal import above_pedestal

# The columns of `geo` that are used.
_COLUMNS = ("index", "dx", "dy", "dz", "V9", "V10", "V11", "V15", "V16")
# Numbers of samples at the beginning of a return, and of an outgoing pulse, that hold only noise.
_QUIET, _QUIET_PULSE = 8, 5
# Standard deviation of normal numbers over their median absolute deviation.
_STD_PER_MAD = 1.4826
# What NumPy and zipfile raise for damaged archives.
_DAMAGED = (OSError, EOFError, KeyError, NotImplementedError, ValueError, zipfile.BadZipFile, zlib.error)


@dataclasses.dataclass(frozen=True, eq=False)
class NeonShot:
    """One shot of NEON's airborne lidar, in double precision. Samples are 1 ns; the first is the highest.

    - `index`: the file's number of the shot.
    - `waveform`: (samples,) received, in counts, noise included; 0 where nothing was recorded.
    - `recorded`: (samples,) whether it was recorded: a return may consist of several segments.
    - `noise_mean`, `noise_std`: mean and standard deviation of the noise in counts, estimated from what
      precedes the returns of all shots of the file.
    - `position`: (samples, 3) easting, northing, elevation in m: where a target lies whose echo of
      `pulse_power` has its time zero in that sample.
    - `pulse_time`: (pulse samples,) ns, zero at the largest sample of the outgoing pulse.
    - `pulse_power`: (pulse samples,) outgoing, in counts: pedestal removed, not negative, and zero before and
      after the pulse. For `SampledPulse(time=shot.pulse_time, power=shot.pulse_power)`. Its length is the
      same in all shots of a file.
    - `zenith`: of the beam in degrees, as in `Lidar`.
    - `azimuth`: in degrees clockwise from north, the horizontal direction in which the light travels down, as
      in `Lidar`.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.io import NeonShot
    >>> way = np.array([[0.0, 0.0, 20.15], [0.0, 0.0, 20.0], [0.0, 0.0, 19.85]])
    >>> received = {"waveform": np.array([10.0, 90.0, 12.0]), "recorded": np.full(3, True), "position": way}
    >>> pulse = {"pulse_time": np.array([-1.0, 0.0, 1.0]), "pulse_power": np.array([0.0, 80.0, 0.0])}
    >>> shot = NeonShot(index=1, noise_mean=10.0, noise_std=1.0, zenith=0.0, azimuth=0.0, **received, **pulse)
    >>> print(shot.signal, shot.time_from(20.0).round(2))
    [ 0. 80.  2.] [-1.  0.  1.]
    """

    index: int
    waveform: Float[np.ndarray, " samples"]
    recorded: Bool[np.ndarray, " samples"]
    noise_mean: float
    noise_std: float
    position: Float[np.ndarray, "samples 3"]
    pulse_time: Float[np.ndarray, " pulse_samples"]
    pulse_power: Float[np.ndarray, " pulse_samples"]
    zenith: float
    azimuth: float

    @property
    def signal(self) -> Float[np.ndarray, " samples"]:
        """The received waveform less the mean noise, in counts; 0 where nothing was recorded."""
        return np.where(self.recorded, self.waveform - self.noise_mean, 0.0)

    @property
    def elevation(self) -> Float[np.ndarray, " samples"]:
        """Elevation of the samples in m, decreasing."""
        return self.position[:, 2]

    def time_from(self, elevation: float) -> Float[np.ndarray, " samples"]:
        """Times of the samples in ns, for a simulation whose reference plane z = 0 lies at `elevation` (m).

        Zero is the two-way travel time to where the beam axis meets that plane; earlier times are negative.
        """
        first, last = self.elevation[0], self.elevation[-1]
        return np.arange(self.waveform.size) - (self.waveform.size - 1) * (elevation - first) / (last - first)

    def position_at(self, elevation: float) -> Float[np.ndarray, " 2"]:
        """Easting and northing in m of where the beam axis meets `elevation` (m)."""
        first, last = self.position[0], self.position[-1]
        return first[:2] + (last - first)[:2] * (elevation - first[2]) / (last[2] - first[2])


class NeonImpulse(NamedTuple):
    """The system impulse: a hard target's echo at nadir, and its outgoing pulse, in counts above the
    pedestal.

    - `time`, `power`: (samples,) of the echo, ns from its largest sample.
    - `pulse_time`, `pulse_power`: (pulse samples,) of the outgoing pulse, ns from its largest sample.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.io import NeonImpulse
    >>> ns = np.array([-1.0, 0.0, 1.0])
    >>> impulse = NeonImpulse(ns, np.array([30.0, 60.0, 30.0]), ns, np.array([20.0, 80.0, 20.0]))
    >>> print(f"{impulse.power.sum() / impulse.pulse_power.sum():.1f}")
    1.0
    """

    time: Float[np.ndarray, " samples"]
    power: Float[np.ndarray, " samples"]
    pulse_time: Float[np.ndarray, " pulse_samples"]
    pulse_power: Float[np.ndarray, " pulse_samples"]


class NeonRead(NamedTuple):
    """What `read_neon` returns: the shots of a file and its system impulse.

    - `shots`: list of `NeonShot`, in the order of the file.
    - `impulse`: the `NeonImpulse`.
    - `dropped`: how many shots of the file were left out, by reason.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.io import NeonImpulse, NeonRead
    >>> impulse = NeonImpulse(*np.array([[-1.0, 0.0], [30.0, 60.0], [-1.0, 0.0], [20.0, 80.0]]))
    >>> read = NeonRead([], impulse, {"without a return": 2, "without a pulse": 0})
    >>> sum(read.dropped.values())
    2
    """

    shots: list[NeonShot]
    impulse: NeonImpulse
    dropped: dict[str, int]


def read_neon(path: str | os.PathLike[str]) -> NeonRead:
    """The full-waveform returns of NEON's airborne lidar in a file.

    **Arguments:**

    - `path`: an .npz file with `ret` (shots, samples), `outgoing` (shots, pulse samples), `system_impulse`
      and `impulse_outgoing` (one-dimensional), in counts, rows filled up with zeros; and `geo` (shots,
      columns), the geolocation, with the names of its columns in `geo_cols`.

    **Returns:** a `NeonRead`: the shots in the order of the file, the system impulse, and what was dropped,
    by reason: shots that have fewer than 8 samples ("without a return") and those with fewer of the outgoing
    pulse ("without a pulse").

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the key, for a
    file that is no .npz or is damaged, arrays that are missing, of the wrong shape or not numbers, samples
    that are negative or not finite, and shots whose geolocation makes no sense.

    **Source:** Zhou et al. (2017), ISPRS J. Photogramm. 129, 131.

    **Example:**

    >>> import numpy as np, pathlib, tempfile
    >>> import jaxlidar.io
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "shots.npz"
    >>> echo = np.array([10.0] * 8 + [50.0, 90.0, 50.0, 10.0])
    >>> waveforms = {"ret": [echo], "outgoing": [echo], "system_impulse": echo, "impulse_outgoing": echo}
    >>> geo = {"index": 1, "dx": 0, "dy": 0, "dz": -0.15, "V9": 500, "V10": 700, "V11": 30, "V15": 9}
    >>> np.savez(path, **waveforms, geo=[[*geo.values(), 0]], geo_cols=[*geo, "V16"])
    >>> (shot,), impulse, dropped = jaxlidar.io.read_neon(path)
    >>> print(f"{shot.signal.max():.1f} counts at {shot.elevation[np.argmax(shot.signal)]:.2f} m")
    80.0 counts at 28.65 m
    """
    path = Path(path)
    data = _arrays(path)
    ret, outgoing = _counts(path, data, "ret", 2), _counts(path, data, "outgoing", 2)
    geo, where = _columns(path, data, len(ret))
    if len(outgoing) != len(ret):
        raise ValueError(f"{path}: outgoing: {len(outgoing)} shots, but ret has {len(ret)}")
    impulse = [_counts(path, data, key, 1) for key in ("system_impulse", "impulse_outgoing")]
    for key, samples in zip(("system_impulse", "impulse_outgoing"), impulse):
        if np.count_nonzero(samples) < _QUIET:
            raise ValueError(f"{path}: {key}: fewer than {_QUIET} samples")

    has_return = np.count_nonzero(ret, axis=1) >= _QUIET
    has_pulse = np.count_nonzero(outgoing, axis=1) >= _QUIET
    kept = np.flatnonzero(has_return & has_pulse)
    if kept.size == 0:
        raise ValueError(f"{path}: ret, outgoing: no shot has both a return and a pulse")
    quiet = np.stack([_recorded(ret[i])[:_QUIET] for i in kept])
    mean = float(np.median(quiet.mean(axis=1)))
    std = float(_STD_PER_MAD * np.median(np.abs(quiet - mean)))
    pedestal = float(np.median([_recorded(outgoing[i])[:_QUIET_PULSE].mean() for i in kept]))
    shots = []
    for i in kept:
        place = f"shot {int(geo['index'][i])}"
        step = np.array([geo[c][i] for c in ("dx", "dy", "dz")])
        _check_step(f"{where}: {place}", step)
        count = int(np.flatnonzero(ret[i])[-1]) + 1
        number = np.arange(count) - geo["V16"][i]
        bin0 = np.array([geo[c][i] for c in ("V9", "V10", "V11")])
        peak = geo["V15"][i]
        if not 0 <= peak < outgoing.shape[1] or outgoing[i, int(peak)] <= pedestal:
            raise ValueError(f"{where}: {place}: V15 = {peak:g} is no sample of the outgoing pulse")
        east, north, down = step / np.linalg.norm(step)
        shots.append(
            NeonShot(
                index=int(geo["index"][i]),
                waveform=ret[i, :count].copy(),
                recorded=ret[i, :count] > 0,
                noise_mean=mean,
                noise_std=std,
                position=bin0 + number[:, None] * step,
                pulse_time=np.arange(outgoing.shape[1]) - peak,
                pulse_power=above_pedestal(outgoing[i], pedestal),
                zenith=float(np.rad2deg(np.arctan2(np.hypot(east, north), -down))),
                azimuth=float(np.rad2deg(np.arctan2(east, north))) % 360.0,
            )
        )
    dropped = {"without a return": int((~has_return).sum()), "without a pulse": int((~has_pulse).sum())}
    return NeonRead(shots, NeonImpulse(*_centred(impulse[0]), *_centred(impulse[1])), dropped)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an .npz file."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path}: no .npz file, or the end of one is missing")
    key, data = "the archive", {}
    try:
        # NumPy does not close files that it opens and finds damaged.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            for key in file.files:
                data[key] = np.asarray(file[key])
    except _DAMAGED as error:
        raise ValueError(f"{path}: {key}: damaged ({error})") from error
    return data


def _array(path: Path, data: dict[str, np.ndarray], key: str, ndim: int) -> np.ndarray:
    if key not in data:
        raise ValueError(f"{path}: {key}: no such array; there are {', '.join(data) or 'none'}")
    if data[key].ndim != ndim:
        raise ValueError(f"{path}: {key}: shape {data[key].shape} where {ndim} dimensions belong")
    return data[key]


def _numbers(path: Path, data: dict[str, np.ndarray], key: str, ndim: int) -> np.ndarray:
    array = _array(path, data, key, ndim)
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{path}: {key}: type {array.dtype} where numbers belong")
    array = array.astype(np.float64)
    if not np.all(np.isfinite(array)):
        place = tuple(int(n) for n in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{path}: {key}: element {place} is {array[place]}")
    return array


def _counts(path: Path, data: dict[str, np.ndarray], key: str, ndim: int) -> np.ndarray:
    array = _numbers(path, data, key, ndim)
    if np.any(array < 0):
        place = tuple(int(n) for n in np.argwhere(array < 0)[0])
        raise ValueError(f"{path}: {key}: element {place} is {array[place]:g}; counts are not negative")
    return array


def _columns(path: Path, data: dict[str, np.ndarray], shots: int) -> tuple[dict[str, np.ndarray], str]:
    """The columns of the geolocation, and the place that messages about them name."""
    geo, names = _numbers(path, data, "geo", 2), _array(path, data, "geo_cols", 1).tolist()
    if geo.shape != (shots, len(names)):
        raise ValueError(f"{path}: geo: shape {geo.shape}, but ret and geo_cols have {(shots, len(names))}")
    for needed in _COLUMNS:
        if needed not in names:
            raise ValueError(f"{path}: geo_cols: no column {needed}; there are {', '.join(map(str, names))}")
    return {name: geo[:, names.index(name)] for name in _COLUMNS}, f"{path}: geo"


def _check_step(place: str, step: np.ndarray) -> None:
    length = float(np.linalg.norm(step))
    # One part in a hundred leaves room for air.
    if abs(length / (SPEED_OF_LIGHT / 2) - 1) > 0.01:
        raise ValueError(f"{place}: dx, dy, dz: {length:g} m from sample to sample, where 1 ns is 0.1499 m")
    if step[2] >= 0:
        raise ValueError(f"{place}: dz = {step[2]:g} m does not lead down")


def _recorded(row: np.ndarray) -> np.ndarray:
    return row[row > 0]


def _centred(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times from the largest sample, and power above the pedestal."""
    pedestal = float(_recorded(samples)[:_QUIET_PULSE].mean())
    return np.arange(samples.size) - float(np.argmax(samples)), above_pedestal(samples, pedestal)
