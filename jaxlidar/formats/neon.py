"""Reader of airborne waveforms: NEON's full-waveform lidar, as an .npz of arrays.

The arrays are those of the sample data of the R package waveformlidar, with its names for the columns of the
geolocation. The following was found from the recorded numbers, and `read_neon` relies on it.

- (`V9`, `V10`, `V11`) is the position of sample `V16` (0 throughout) of the return, and (`dx`, `dy`, `dz`) is
  the step from one sample to the next, 0.14986 m: half of what light travels in air in 1 ns.
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

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxlidar.formats.airborne import AirborneShot, Segment
from jaxlidar.formats.checks import (
    MAX_COORDINATE,
    MAX_COUNTS,
    MAX_EXACT_INTEGER,
    check_step_of_light,
    column_index,
)
from jaxlidar.formats.coordinates import check_elevations
from jaxlidar.formats.noise import (
    QUIET_PULSE_SAMPLES,
    QUIET_SAMPLES,
    NoiseLevels,
    above_pedestal,
    estimate_noise_levels,
)
from jaxlidar.formats.npz import read_arrays

# Arrays in use, and columns of `geo`.
_ARRAYS = ("ret", "outgoing", "system_impulse", "impulse_outgoing", "geo", "geo_cols")
_COLUMNS: tuple[str, ...] = ("index", "dx", "dy", "dz", "V9", "V10", "V11", "V15", "V16")


class NeonImpulse(NamedTuple):
    """The system impulse: a hard target's echo at nadir, and its outgoing pulse, in counts above the
    pedestal.

    - `time`, `power`: (samples,) of the echo, ns from its largest sample.
    - `pulse_time`, `pulse_power`: (pulse samples,) of the outgoing pulse, ns from its largest sample.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.formats.neon import NeonImpulse
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
    """Result of `read_neon`: the shots of a file and its system impulse.

    - `shots`: list of `AirborneShot`, in the order of the file, in counts.
    - `impulse`: the `NeonImpulse`.
    - `dropped`: number of shots of the file that were left out, by reason.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.formats.neon import NeonImpulse, NeonRead
    >>> impulse = NeonImpulse(*np.array([[-1.0, 0.0], [30.0, 60.0], [-1.0, 0.0], [20.0, 80.0]]))
    >>> read = NeonRead([], impulse, {"without a return": 2, "without a pulse": 0})
    >>> sum(read.dropped.values())
    2
    """

    shots: list[AirborneShot]
    impulse: NeonImpulse
    dropped: dict[str, int]


def read_neon(path: str | os.PathLike[str]) -> NeonRead:
    """Read the shots of NEON's airborne full-waveform lidar in a file.

    **Arguments:**

    - `path`: an .npz file with `ret` (shots, samples), `outgoing` (shots, pulse samples), `system_impulse`
      and `impulse_outgoing` (one-dimensional), in counts, rows filled up with zeros; and `geo` (shots,
      columns), the geolocation, with the names of its columns in `geo_cols`.

    **Returns:** a `NeonRead`: the shots in the order of the file, the system impulse, and what was dropped,
    by reason: shots that have fewer than 8 samples ("without a return") and those with fewer of the outgoing
    pulse ("without a pulse").

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the key, for a
    file that is no .npz, is damaged or declares more than it can hold, arrays that are missing, of the wrong
    shape or not numbers, samples that are negative or not finite, pulses without energy, and shots whose
    geolocation makes no sense.

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
    arrays = read_arrays(path, _ARRAYS)
    ret, outgoing = _counts(path, arrays, "ret", 2), _counts(path, arrays, "outgoing", 2)
    if len(outgoing) != len(ret):
        raise ValueError(f"{path}: outgoing: {len(outgoing)} shots, but ret has {len(ret)}")
    geo = _geolocation(path, arrays, len(ret))
    system, sent = (_impulse(path, arrays, key) for key in ("system_impulse", "impulse_outgoing"))

    has_return = np.count_nonzero(ret, axis=1) >= QUIET_SAMPLES
    has_pulse = np.count_nonzero(outgoing, axis=1) >= QUIET_SAMPLES
    complete = np.flatnonzero(has_return & has_pulse)
    if complete.size == 0:
        raise ValueError(f"{path}: ret, outgoing: no shot has both a return and a pulse")
    levels = estimate_noise_levels((_nonzero(outgoing[i]), _nonzero(ret[i])) for i in complete)
    shots = [_shot(path, geo[i], ret[i], outgoing[i], levels) for i in complete]
    dropped = {"without a return": int((~has_return).sum()), "without a pulse": int((~has_pulse).sum())}
    return NeonRead(shots, NeonImpulse(*system, *sent), dropped)


def _segments(row: np.ndarray) -> tuple[Segment, ...]:
    """Return the segments of a return, which lie between zeros."""
    ends = np.flatnonzero(np.diff(np.r_[False, row > 0, False]))
    return tuple(Segment(row[a:b], float(a)) for a, b in zip(ends[::2], ends[1::2]))


def _shot(
    path: Path,
    geo: dict[str, float],
    received: np.ndarray,
    sent: np.ndarray,
    levels: NoiseLevels,
) -> AirborneShot:
    shot = f"shot {geo['index']:.0f}"
    location = f"{path}: geo: {shot}"
    step = np.array([geo["dx"], geo["dy"], geo["dz"]])
    length = float(np.linalg.norm(step))
    check_step_of_light(f"{location}: dx, dy, dz", length)
    if step[2] >= 0:
        raise ValueError(f"{location}: dz = {step[2]:g} m does not lead down")
    anchor = np.array([geo["V9"], geo["V10"], geo["V11"]]) - geo["V16"] * step
    returning = _segments(received)
    last = anchor + returning[-1].time[-1] * step
    if max(np.abs(anchor).max(), np.abs(last).max()) > MAX_COORDINATE:
        raise ValueError(f"{location}: V9, V10, V11, V16: the return lies beyond {MAX_COORDINATE:g} m")
    check_elevations(f"{location}: V11", anchor[2])
    peak = geo["V15"]
    if not (0 <= peak < sent.size and peak.is_integer()) or sent[int(peak)] <= levels.pedestal:
        raise ValueError(f"{location}: V15 = {peak:g} is no sample of the outgoing pulse")
    # Called for its error: a pulse without energy is refused when the file is read, not when it is used.
    above_pedestal(sent, levels.pedestal, f"{path}: outgoing: {shot}")
    segments = {"returning": returning, "outgoing": (Segment(sent, -peak),)}
    return AirborneShot(
        int(geo["index"]), anchor=anchor, direction=step, **segments, **levels._asdict(), pulse_zero=0.0
    )


def _impulse(path: Path, arrays: dict[str, np.ndarray], key: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of an impulse from its largest sample, and its power above the pedestal."""
    samples = _counts(path, arrays, key, 1)
    if np.count_nonzero(samples) < QUIET_SAMPLES:
        raise ValueError(f"{path}: {key}: fewer than {QUIET_SAMPLES} samples")
    pedestal = float(_nonzero(samples)[:QUIET_PULSE_SAMPLES].mean())
    time = np.arange(samples.size) - float(np.argmax(samples))
    return time, above_pedestal(samples, pedestal, f"{path}: {key}")


def _array(path: Path, arrays: dict[str, np.ndarray], key: str, ndim: int) -> np.ndarray:
    if arrays[key].ndim != ndim:
        raise ValueError(f"{path}: {key}: shape {arrays[key].shape} where {ndim} dimensions belong")
    if 0 in arrays[key].shape[1:]:
        raise ValueError(f"{path}: {key}: shape {arrays[key].shape} has no columns")
    return arrays[key]


def _numbers(path: Path, arrays: dict[str, np.ndarray], key: str, ndim: int) -> np.ndarray:
    array = _array(path, arrays, key, ndim)
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{path}: {key}: type {array.dtype} where numbers belong")
    with np.errstate(over="ignore"):
        array = array.astype(np.float64)
    if not np.all(np.isfinite(array)):
        index = tuple(int(n) for n in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{path}: {key}: element {index} is {array[index]}")
    return array


def _counts(path: Path, arrays: dict[str, np.ndarray], key: str, ndim: int) -> np.ndarray:
    array = _numbers(path, arrays, key, ndim)
    wrong = (array < 0) | (array > MAX_COUNTS)
    if np.any(wrong):
        index = tuple(int(n) for n in np.argwhere(wrong)[0])
        raise ValueError(
            f"{path}: {key}: element {index} is {array[index]:g}; counts are not negative, and at most "
            f"{MAX_COUNTS:g}"
        )
    return array


def _geolocation(path: Path, arrays: dict[str, np.ndarray], shots: int) -> list[dict[str, float]]:
    """Return the columns of the geolocation in use, shot by shot."""
    geo, names = _numbers(path, arrays, "geo", 2), _array(path, arrays, "geo_cols", 1).tolist()
    if geo.shape != (shots, len(names)):
        raise ValueError(f"{path}: geo: shape {geo.shape}, but ret and geo_cols have {(shots, len(names))}")
    used = [column_index(f"{path}: geo_cols", names, name) for name in _COLUMNS]
    rows = [dict(zip(_COLUMNS, row)) for row in geo[:, used].tolist()]
    for i, index in enumerate(row["index"] for row in rows):
        if not (index.is_integer() and abs(index) <= MAX_EXACT_INTEGER):
            raise ValueError(f"{path}: geo: row {i}: index = {index:g} is no whole number")
    return rows


def _nonzero(row: np.ndarray) -> np.ndarray:
    """Return the samples of a row: zeros fill it up."""
    return row[row > 0]
