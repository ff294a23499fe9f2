"""Writers of LAS files: points, and airborne waveforms as packets in a .wdp file beside the points."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import ArrayLike, Num

from jaxlidar._checks import check_range, check_shape
from jaxlidar._files import atomic_write
from jaxlidar.io.airborne import AirborneShot, Returns, Segment
from jaxlidar.io.checks import FARTHEST
from jaxlidar.io.coordinates import GEO_KEYS, geographic_keys
from jaxlidar.io.las_packets import (
    BEFORE_FIRST,
    FORMATS,
    LAYOUT,
    MOST,
    PACKETS,
    PACKETS_NUMBER,
    USER,
    Layout,
    beside,
)

# Coordinates are counted in mm, degrees in 1e-8, which is about as much.
_MM, _DEGREES = (1e-3, 1e-3, 1e-3), (1e-8, 1e-8, 1e-3)
_POINTS = 6
# Largest numbers by field: point formats up to 5, and beyond.
_INTENSITY = 2**16 - 1
_MOST_RETURNS, _MOST_CLASSES = {True: 7, False: 15}, {True: 31, False: 255}
_PS = 1e-3
Path_ = str | os.PathLike[str]


def write_las(
    path: Path_,
    position: Num[ArrayLike, "..."],
    *,
    intensity: Num[ArrayLike, "..."] | None = None,
    return_number: Num[ArrayLike, "..."] | None = None,
    number_of_returns: Num[ArrayLike, "..."] | None = None,
    gps_time: Num[ArrayLike, "..."] | None = None,
    classification: Num[ArrayLike, "..."] | None = None,
) -> None:
    """Write points as a LAS 1.4 file (point format 6).

    This needs laspy (`pip install "jaxlidar[io]"`). A file that is there is replaced when the new one is
    whole.

    **Arguments:**

    - `path`: the file, which ends in ".las".
    - `position`: (n, 3) m, at least one point. They are rounded to mm.
    - `intensity`: (n,) from 0 to 65535, rounded to whole numbers. Default None: 0.
    - `return_number`, `number_of_returns`: (n,) whole numbers from 0 to 15. Default None: 1.
    - `gps_time`: (n,) s. Default None: 0.
    - `classification`: (n,) classes of the LAS specification, from 0 to 255. Default None: 0.

    **Returns:** nothing.

    **Raises:** ImportError without laspy. ValueError for another ending, arrays of different lengths, and
    numbers outside their range. OSError where the file cannot be written.

    **Example:**

    >>> import numpy as np, pathlib, tempfile
    >>> import jaxlidar.io
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "echoes.las"
    >>> echoes, two = np.array([[0.0, 0.0, 12.5], [0.1, 0.0, 0.25]]), np.array([2, 2])
    >>> jaxlidar.io.write_las(path, echoes, return_number=np.array([1, 2]), number_of_returns=two)
    >>> print(jaxlidar.io.read_las(path).position[:, 2])
    [12.5   0.25]
    """
    path, place = _las(path), np.asarray(position, float)
    n = len(place)
    ones = np.ones(n, int)
    fields = {
        "intensity": np.zeros(n) if intensity is None else np.round(intensity),
        "return_number": ones if return_number is None else return_number,
        "number_of_returns": ones if number_of_returns is None else number_of_returns,
        "gps_time": np.zeros(n) if gps_time is None else gps_time,
        "classification": 0 * ones if classification is None else classification,
    }
    cloud = _cloud(_POINTS, place, fields, geographic=False)
    with atomic_write(path) as draft:
        _save(cloud, draft)


def write_las_waveforms(path: Path_, shots: Iterable[AirborneShot], *, point_format: int = 9) -> None:
    """Write airborne shots as a LAS 1.4 file with waveform packets in a .wdp file beside it.

    Samples, their gain, offset and sampling interval and GPS times are kept exactly; places are rounded to
    mm, directions to single precision. The shots' returns become points. A segment without a return gets one,
    at its largest sample, flagged as synthetic, for packets are found by their points. Outgoing pulses have
    no place in the format. Shots are taken one at a time, so that there may be more than memory holds.

    This needs laspy (`pip install "jaxlidar[io]"`). Files that are there are replaced when the new ones are
    whole, the .wdp file first.

    **Arguments:**

    - `path`: the .las file.
    - `shots`: `AirborneShot`s, at least one, of one channel each, with samples that are whole and not
      negative.
    - `point_format`: 4, 5, 9 or 10. Default 9.

    **Returns:** nothing.

    **Raises:** ImportError without laspy. ValueError, naming the shot, for what the format cannot hold: no
    shot, several channels, several segments without a GPS time, samples that are not whole numbers below
    2^32, sampling intervals that are not whole ps, more than 255 layouts of packets, and numbers outside
    their range. OSError where the files cannot be written.

    **Source:** LAS specification 1.4 (ASPRS).

    **Example:**

    >>> import numpy as np, pathlib, tempfile
    >>> from jaxlidar.io import AirborneShot, Segment, read_las_waveforms, write_las_waveforms
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "flight.las"
    >>> echo = Segment(np.array([3, 5, 90, 60, 9, 4, 3, 2], np.uint8), start=0.0)
    >>> way = {"anchor": np.array([5e5, 4e6, 20.0]), "direction": np.array([0.0, 0.0, -0.15])}
    >>> write_las_waveforms(path, [AirborneShot(0, **way, returning=(echo,), gps_time=2.5)])
    >>> (shot,) = read_las_waveforms(path)
    >>> print(shot.waveform, shot.returns.position[0, 2], shot.gps_time)
    [ 3.  5. 90. 60.  9.  4.  3.  2.] 19.7 2.5
    """
    if point_format not in FORMATS:
        raise ValueError(f"point_format = {point_format} has no packets; those of {FORMATS} have")
    path = _las(path)
    with atomic_write(path) as draft, atomic_write(beside(path)) as packets:
        written = _Packets()
        with packets.open("wb") as file:
            file.write(bytes(PACKETS.size))
            for shot in shots:
                written.add(shot, file)
            size = file.tell() - PACKETS.size
            file.seek(0)
            file.write(PACKETS.pack(USER, PACKETS_NUMBER, size, b"Waveform Data Packets"))
        if not written.positions:
            raise ValueError("shots: there is none; a file holds at least one")
        fields = {name: np.concatenate(values) for name, values in written.fields.items()}
        cloud = _cloud(point_format, np.concatenate(written.positions), fields, written.geographic)
        cloud.header.global_encoding.waveform_data_packets_external = True
        _add_records(cloud, written.layouts)
        _save(cloud, draft)


class _Packets:
    """The points of the packets that are written, field by field."""

    def __init__(self):
        self.layouts: dict[Layout, int] = {}
        self.positions: list[np.ndarray] = []
        self.fields: dict[str, list[np.ndarray]] = {}
        self.geographic = False

    def add(self, shot: AirborneShot, file: BinaryIO) -> None:
        """Write the packets of a shot, and keep its points."""
        if not self.positions:
            self.geographic = shot.is_geographic
        if shot.is_geographic != self.geographic:
            raise ValueError(f"shot {shot.index}: degrees and metres in one file")
        channels = {segment.channel for segment in shot.returning}
        if len(channels) > 1:
            raise ValueError(
                f"shot {shot.index}: segments of the channels {sorted(channels)}; admissible is one, which "
                "of_channel gives"
            )
        if len(shot.returning) > 1 and not shot.gps_time:
            raise ValueError(
                f"shot {shot.index}: {len(shot.returning)} segments without a GPS time, by which they are "
                "told to be of one shot"
            )
        segments = sorted(shot.returning, key=lambda s: s.start)
        returns, synthetic = _points(shot, segments)
        starts = np.array([segment.start for segment in segments])
        of = np.maximum(np.searchsorted(starts, returns.time, "right") - 1, 0)
        number, place, size = (np.zeros(len(segments), np.int64) for _ in range(3))
        for k, segment in enumerate(segments):
            samples = _stored(shot, segment)
            number[k], place[k], size[k] = self._layout(shot, segment, samples), file.tell(), samples.nbytes
            file.write(samples.tobytes())
        # Vectors lead back along the beam.
        vector = np.broadcast_to(-shot.direction * _PS, returns.position.shape)
        count = returns.time.size
        self.positions.append(returns.position)
        fields = {
            "intensity": returns.intensity,
            "return_number": returns.number,
            "number_of_returns": returns.count,
            "classification": returns.classification,
            "synthetic": synthetic,
            "gps_time": np.full(count, 0.0 if shot.gps_time is None else shot.gps_time),
            "wavepacket_index": number[of],
            "wavepacket_offset": place[of],
            "wavepacket_size": size[of],
            "return_point_wave_location": (returns.time - starts[of]) / _PS,
            **{f"{axis}_t": vector[:, i] for i, axis in enumerate("xyz")},
        }
        for name, values in fields.items():
            self.fields.setdefault(name, []).append(values)

    def _layout(self, shot: AirborneShot, segment: Segment, samples: np.ndarray) -> int:
        step = round(segment.step / _PS)
        if abs(segment.step / _PS - step) > 1e-6 * step or not 0 < step < 2**32:
            raise ValueError(f"shot {shot.index}: samples every {segment.step:g} ns; admissible are whole ps")
        bits = 8 * samples.dtype.itemsize
        layout = Layout(bits, 0, samples.size, step, float(segment.gain), float(segment.offset))
        found = self.layouts.setdefault(layout, len(self.layouts) + 1)
        if found > MOST:
            raise ValueError(f"shot {shot.index}: one layout of packets more than {MOST}")
        return found


def _points(shot: AirborneShot, segments: list[Segment]) -> tuple[Returns, np.ndarray]:
    """The returns of a shot, with one more for each segment that has none; which were added."""
    none = np.zeros(0, int)
    own = shot.returns or Returns(np.zeros((0, 3)), np.zeros(0), none, none, none, none)
    starts = [segment.start for segment in segments]
    of = np.maximum(np.searchsorted(starts, own.time, "right") - 1, 0)
    bare = [segment for k, segment in enumerate(segments) if k not in of]
    time = np.array([segment.time[np.argmax(segment.samples)] for segment in bare])
    before, zeros = own.time.size, np.zeros(len(bare), int)
    total = before + len(bare)
    added = Returns(
        *(shot.anchor + time[:, None] * shot.direction, time),
        *(zeros, before + 1 + np.arange(len(bare)), zeros + total, zeros),
    )
    joined = (np.concatenate(both) for both in zip(own, added))
    return Returns(*joined), np.arange(total) >= before


def _stored(shot: AirborneShot, segment: Segment) -> np.ndarray:
    """Samples as unsigned numbers: of the bits that they have, or of 16 or 32."""
    samples = segment.samples
    if samples.dtype.kind == "u" and samples.dtype.itemsize <= 4:
        return samples.astype(f"<u{samples.dtype.itemsize}")
    stored = np.asarray(samples, float)
    wrong = ~((stored >= 0) & (stored < 2**32) & (stored == np.floor(stored)))
    if np.any(wrong):
        raise ValueError(
            f"shot {shot.index}: a sample is {stored[wrong][0]:g}; admissible are whole numbers in [0, 2^32)"
        )
    return stored.astype("<u2" if stored.max() < 2**16 else "<u4")


def _cloud(point_format: int, position: np.ndarray, fields: dict[str, Any], geographic: bool) -> Any:
    try:
        import laspy
    except ImportError as error:
        raise ImportError('writing LAS needs laspy: pip install "jaxlidar[io]"') from error
    if len(position) == 0:
        raise ValueError("position holds no point; admissible is one or more")
    check_shape("position", position, (len(position), 3))
    check_range("position", position, -FARTHEST, FARTHEST)
    early = point_format < _POINTS
    most = {"return_number": _MOST_RETURNS[early], "classification": _MOST_CLASSES[early]}
    most |= {"number_of_returns": most["return_number"], "intensity": _INTENSITY}
    fields = {name: np.asarray(values) for name, values in fields.items()}
    for name, values in fields.items():
        check_shape(name, values, (len(position),))
        check_range(name, values, 0 if name in most else -np.inf, most.get(name, np.inf))
        if name in most and np.any(values != np.floor(values)):
            raise ValueError(f"{name} has values that are not whole numbers")
    scale, offset = np.array(_DEGREES if geographic else _MM), np.floor(position.min(axis=0))
    counts = np.round((position - offset) / scale)
    if counts.max() >= 2**31:
        spans = np.ptp(position, axis=0).tolist()
        raise ValueError(f"position spans {spans}; admissible is 2^31 steps of {scale.tolist()}")
    header = laspy.LasHeader(point_format=point_format, version="1.4")
    header.generating_software, header.scales, header.offsets = "jaxlidar", scale, offset
    if geographic:
        header.vlrs.append(laspy.VLR("LASF_Projection", GEO_KEYS, "", geographic_keys()))
    cloud = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(len(position), header=header))
    for axis, values in zip("XYZ", counts.T):
        cloud[axis] = values.astype(np.int32)
    for name, values in fields.items():
        cloud[name] = values
    return cloud


def _add_records(cloud: Any, layouts: dict[Layout, int]) -> None:
    import laspy

    for layout, number in layouts.items():
        record = laspy.VLR(USER.decode(), BEFORE_FIRST + number, "", LAYOUT.pack(*layout))
        cloud.header.vlrs.append(record)


def _save(cloud: Any, draft: Path) -> None:
    with draft.open("wb") as file:
        cloud.write(file, do_compress=False)


def _las(path: Path_) -> Path:
    path = Path(path)
    if path.suffix.lower() != ".las":
        raise ValueError(f"path = {path}: its name does not end in .las")
    return path
