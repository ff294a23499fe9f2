"""Airborne waveforms in LAS files: reader and writer of waveform packets.

Packets lie in the .las file or in a .wdp file beside it. A point has the offset and the layout of the packet
of its shot, and its distance from the packet's first sample. The following was found from recorded files; the
specification does not say it.

- A point's vector leads back along the beam, against the light: the first sample of its packet lies at the
  point plus the location times the vector, as the specification's anchor does. Some writers use the opposite
  sign. The reader takes the sign with which points of a packet agree on its first sample; where no packet has
  two points, light goes down.
- Points of a packet agree on its first sample to 2 mm (RIEGL Q680i), which is the rounding of coordinates.
- A packet is a segment. Packets of one GPS time and scanner channel that lie one after another on one line
  are segments of one shot: of a crown and the ground far below it, for instance.
- Packets without a point are not found, and no outgoing pulse is in the file.

Source: LAS specification 1.4 (ASPRS). A packet's layout is the specification's waveform packet descriptor.
"""

import math
import os
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from jaxlidar._fields.crs import CoordinateSystem, system_of_name
from jaxlidar.formats.airborne import AirborneShot, AirborneShots, Returns, Segment, evenly_spaced
from jaxlidar.formats.checks import MAX_COORDINATE, existing_file
from jaxlidar.formats.coordinates import check_elevations, find_units, wkt_of_units
from jaxlidar.formats.files import atomic_writes
from jaxlidar.formats.las import import_laspy, las_path, las_points, point_format_of, scan_angles
from jaxlidar.formats.las_header import LasHeader, read_header
from jaxlidar.formats.laz import decompress_points

# Point formats with packets.
_PACKET_FORMATS = (4, 5, 9, 10)
# Layouts of packets are variable length records: the user, the number before that of the first, and how many
# there may be.
_USER, _BEFORE_FIRST_LAYOUT, _MAX_LAYOUTS = b"LASF_Spec", 99, 255
_LAYOUT = struct.Struct("<BBIIdd")
# The header of the record that holds the packets, at the beginning of a .wdp file, and its number.
_PACKETS_HEADER, _PACKETS_NUMBER = struct.Struct("<2x16sHQ32s"), 65535
# In the public header: offset of the flags, the flag of packets within the file, offset of their place.
_FLAGS_OFFSET, _INTERNAL_PACKETS, _PACKETS_OFFSET = 6, 2, 227
# The unit of times in the file, 1 ps, in ns.
_PS = 1e-3
# Segments of one shot lie on one line to this many metres, and their directions differ by this fraction.
_MAX_OFF_LINE, _MAX_TURN = 0.05, 1e-3
# No point lies farther from the first sample of its packet, ns.
_MAX_LOCATION = 1e6


class PacketLayout(NamedTuple):
    """The layout of a packet.

    - `bits`: of a sample. `compression`: 0 for none. `samples`: their number.
    - `step`: ps from sample to sample.
    - `gain`, `offset`: a sample's value is `offset` + `gain` * sample.
    """

    bits: int
    compression: int
    samples: int
    step: int
    gain: float
    offset: float

    @property
    def error(self) -> str:
        """The reason why packets of this layout cannot be read; empty where they can."""
        if self.compression:
            return f"packets are compressed ({self.compression}): they are not read"
        if self.bits not in (8, 16, 32) or not self.samples or not self.step:
            return f"{self.samples} samples of {self.bits} bits every {self.step} ps"
        if not (math.isfinite(self.gain) and self.gain != 0.0 and math.isfinite(self.offset)):
            return f"gain {self.gain:g}, offset {self.offset:g}"
        return ""

    @property
    def size(self) -> int:
        """Bytes of a packet."""
        return self.samples * self.bits // 8


# -- reading -----------------------------------------------------------------------------------------------


def read_las_waveforms(path: str | os.PathLike[str]) -> AirborneShots:
    """Open the shots of a LAS or LAZ file with waveform packets (point formats 4, 5, 9 and 10).

    This needs laspy, and lazrs for LAZ (`pip install "jaxlidar[io]"`). Both files are mapped, but for the
    points of LAZ, which are unpacked into memory: samples are read when a shot is indexed. Packets that are
    compressed themselves are refused, as no library reads them. Each shot has its points as `returns`, and no
    outgoing pulse. Coordinates may be metres, feet or degrees.

    **Arguments:**

    - `path`: the .las or .laz file; packets lie in it, or in the .wdp file beside it under the same name.

    **Returns:** an `AirborneShots`, in the order of GPS time. Its `dropped` counts points "without a packet".

    **Raises:** FileNotFoundError where there is no such file, or no .wdp file. ImportError without laspy,
    lazrs for LAZ, and pyproj for a declared coordinate reference system, or rasterio for one by GeoTIFF keys.
    ValueError, naming the file and the place (the record of a point), where it is damaged, cut short,
    declares more than it can hold, has no packets or compressed ones, and where a point's packet has an
    unknown layout or lies outside of the file, or its vector does not have the length that light goes; and
    for geocentric coordinates, and a coordinate reference system that is not known.

    **Source:** LAS specification 1.4 (ASPRS).

    **Example:**

    >>> from jaxlidar.io import read_las_waveforms
    >>> shot = read_las_waveforms("flight.las")[0]  # doctest: +SKIP
    >>> print(shot.returns.number, shot.elevation[shot.signal.argmax()])  # doctest: +SKIP
    """
    return _LasShots(existing_file(path))


def has_packets(path: Path) -> bool:
    """Return True if the points of a LAS or LAZ file have waveform packets."""
    with path.open("rb") as file:
        header = read_header(path, file)
    return header.point_format in _PACKET_FORMATS


@final
class _LasShots(AirborneShots):
    """Shots of a LAS file.

    `points` are the mapped point records. Points are sorted by packet, and packets by shot. The indices of
    the points of packet k are `points_by_packet[first_point[k] : end_point[k]]`, and shot i has the packets
    from `first_packet[i]` to before `end_packet[i]`; `first_points[i]` is the index of its first point.
    """

    def __init__(self, path: Path):
        laspy = import_laspy("reading LAS")
        self.path, self.tables = path, {}
        with path.open("rb") as file:
            header = read_header(path, file)
            if header.point_format not in _PACKET_FORMATS:
                raise ValueError(
                    f"{path}: header: point format {header.point_format} has no packets; {_PACKET_FORMATS} "
                    "have"
                )
            self.layouts = _read_layouts(path, file, header)
            self.system = header.coordinate_system(path, file)
            file.seek(_FLAGS_OFFSET)
            flags = int.from_bytes(file.read(2), "little")
            file.seek(_PACKETS_OFFSET)
            internal_offset = int.from_bytes(file.read(8), "little")
            # Points of LAZ files are unpacked into memory; those of LAS files are mapped.
            unpacked = None
            if header.laszip is not None:
                unpacked = decompress_points(path, file, header, with_packets=True)
        packet_path, self.packets_offset = path, internal_offset
        if not flags & _INTERNAL_PACKETS:
            packet_path, self.packets_offset = existing_file(_packet_path(path)), 0
        self.packet_bytes = (
            np.memmap(packet_path, np.uint8, "r") if packet_path.stat().st_size else np.zeros(0, "u1")
        )
        _check_packets_header(packet_path, self.packet_bytes, self.packets_offset)
        self.scale, self.offset = np.array(header.scales), np.array(header.offsets)
        point_format = point_format_of(header)
        if unpacked is None:
            records: Any = np.memmap(path, point_format.dtype(), "r", header.start, (header.points,))
        else:
            records = np.frombuffer(unpacked, point_format.dtype(), header.points)
        self.points: Any = laspy.PackedPointRecord(records, point_format)
        self._sort_points_and_packets()

    def _sort_points_and_packets(self) -> None:
        points = self.points
        layout, offset, size = (np.asarray(points[f"wavepacket_{n}"]) for n in ("index", "offset", "size"))
        available = self.packet_bytes.size - self.packets_offset
        _check_points(self.path, self.layouts, layout, offset, size, available)
        indices = np.flatnonzero(layout)
        self.dropped = {"without a packet": int(layout.size - indices.size)}
        if indices.size == 0:
            raise ValueError(f"{self.path}: record 0: neither this point nor another has a packet")
        location, number = _location(points), np.asarray(points["return_number"])
        # By packet, and in the order of returns within each.
        indices = indices[np.lexsort((number[indices], location[indices], offset[indices]))]
        is_first = np.r_[True, offset[indices][1:] != offset[indices][:-1]]
        location, position, vector = (
            location[indices],
            self._position(points)[indices],
            _vector(points)[indices],
        )
        self._check_numbers(indices, np.c_[position, vector, location], ~(np.abs(location) <= _MAX_LOCATION))
        self.vector_sign = _vector_sign(position, vector, location, np.cumsum(is_first))
        direction = self.vector_sign * vector
        start = position - location[:, None] * direction
        sampled = evenly_spaced(indices.size)
        self.units = find_units(f"{self.path}: points", self.system, start[sampled], direction[sampled])
        self._check_numbers(indices, direction, self.units.has_wrong_length(start, direction))
        check_elevations(f"{self.path}: points", position[:, 2] * self.units.vertical)

        first = np.flatnonzero(is_first)
        heads, metres = indices[first], self.units.metres(start[first])
        layouts = [self.layouts[int(n)] for n in layout[heads]]
        steps = np.array([packet_layout.step * _PS for packet_layout in layouts])
        packets = _Packets(
            start=start[first] * metres,
            direction=direction[first] * metres,
            length=steps * [packet_layout.samples for packet_layout in layouts],
            step=steps,
            gps_time=np.asarray(points["gps_time"])[heads],
            source=np.asarray(points["point_source_id"])[heads],
            channel=_scanner_channel(points)[heads],
        )
        order, begins_shot = _group_into_shots(packets)
        self.points_by_packet, ends = indices, np.r_[first[1:], indices.size]
        self.first_point, self.end_point = first[order], ends[order]
        self.first_packet = np.flatnonzero(begins_shot)
        self.end_packet = np.r_[self.first_packet[1:], order.size]
        self.first_points = heads[order[self.first_packet]]

    def _check_numbers(self, indices: np.ndarray, numbers: np.ndarray, wrong: np.ndarray) -> None:
        """Refuse points whose numbers are too large, or wrong otherwise."""
        wrong = wrong | ~(np.abs(numbers) <= MAX_COORDINATE).all(axis=1)
        if np.any(wrong):
            first = int(np.argmax(wrong))
            raise ValueError(
                f"{self.path}: record {indices[first]}: its place in space, its vector or its location in "
                f"the packet makes no sense: {numbers[first].tolist()}"
            )

    def _position(self, points: Any) -> np.ndarray:
        counts = np.stack([np.asarray(points[axis]) for axis in "XYZ"], axis=-1)
        return counts * self.scale + self.offset

    def _line(self, points: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions of the first samples of the points' packets, and the directions of light."""
        direction = self.vector_sign * _vector(points)
        return self._position(points) - _location(points)[:, None] * direction, direction

    def __len__(self) -> int:
        return self.first_points.size

    @property
    def gps_time(self) -> np.ndarray:
        return np.asarray(self.points["gps_time"], float)[self.first_points]

    @property
    def direction(self) -> np.ndarray:
        return self._line(self.points[self.first_points])[1]

    @property
    def anchor(self) -> np.ndarray:
        return self._line(self.points[self.first_points])[0]

    def _read(self, index: int) -> dict[str, Any]:
        points_of_packets = [
            self.points[self.points_by_packet[self.first_point[k] : self.end_point[k]]]
            for k in range(self.first_packet[index], self.end_packet[index])
        ]
        anchors, directions = self._line(points_of_packets[0][:1])
        anchor, direction = anchors[0], directions[0]
        segments, times, positions = [], [], []
        for k, points in enumerate(points_of_packets):
            layout = self.layouts[int(points["wavepacket_index"][0])]
            offset = self.packets_offset + int(points["wavepacket_offset"][0])
            location, position = _location(points), self._position(points)
            # Time along the line from the anchor to the point, less that from the packet's first sample.
            point_time = float((position[0] - anchor) @ direction / (direction @ direction))
            start = point_time - float(location[0]) if k else 0.0
            samples = np.asarray(self.packet_bytes[offset : offset + layout.size])
            segments.append(
                Segment(
                    samples.view(f"<u{layout.bits // 8}"),
                    start,
                    layout.step * _PS,
                    gain=layout.gain,
                    offset=layout.offset,
                )
            )
            times.append(start + location)
            positions.append(position)
        names = ("intensity", "return_number", "number_of_returns", "classification")
        numbers = (np.concatenate([np.asarray(p[name], int) for p in points_of_packets]) for name in names)
        return {
            "outgoing": (),
            "returning": tuple(segments),
            "anchor": anchor,
            "direction": direction,
            "metres": self.units.metres(anchor),
            "gps_time": float(points_of_packets[0]["gps_time"][0]),
            "scanner_channel": int(_scanner_channel(points_of_packets[0])[0]),
            "scan_angle": float(scan_angles(points_of_packets[0][:1])[0]),
            "flight_line": int(points_of_packets[0]["point_source_id"][0]),
            "returns": Returns(np.concatenate(positions), np.concatenate(times), *numbers),
            "crs": self.system.text,
        }


def _vector(points: Any) -> np.ndarray:
    """Return the vectors of points per ns."""
    return np.stack([_double(points, f"{axis}_t") for axis in "xyz"], axis=-1) / _PS


def _location(points: Any) -> np.ndarray:
    """Return the times in ns from the first sample of their packet to points."""
    return _double(points, "return_point_wave_location") * _PS


def _double(points: Any, name: str) -> np.ndarray:
    # Casting warns of NaN whose bits signal an error; such points are refused later.
    with np.errstate(invalid="ignore"):
        return np.asarray(points[name], float)


def _scanner_channel(points: Any) -> np.ndarray:
    """Return the scanner channels of points; zeros in point formats that have none."""
    if "scanner_channel" in points.point_format.dimension_names:
        return np.asarray(points["scanner_channel"])
    return np.zeros(len(points), np.uint8)


def _packet_path(path: Path) -> Path:
    """Return the path of the file of packets beside a LAS file."""
    return path.with_suffix(".WDP" if path.suffix.isupper() else ".wdp")


def _read_layouts(path: Path, file: BinaryIO, header: LasHeader) -> dict[int, PacketLayout]:
    """Return the layouts of a file by their number. Those that no packet uses may make no sense."""
    layouts = {}
    for number in range(1, _MAX_LAYOUTS + 1):
        record = header.record(file, _USER, _BEFORE_FIRST_LAYOUT + number)
        if record is None:
            continue
        if len(record) < _LAYOUT.size:
            raise ValueError(f"{path}: record of layout {number}: {len(record)} bytes")
        layouts[number] = PacketLayout(*_LAYOUT.unpack_from(record))
    return layouts


def _check_packets_header(path: Path, packet_bytes: np.ndarray, offset: int) -> None:
    """Refuse a record that is not that of packets. **Raises:** ValueError, naming the file and the place."""
    end = offset + _PACKETS_HEADER.size
    if end > packet_bytes.size:
        raise ValueError(
            f"{path}: packets: their record begins at {offset}, but the file ends after {packet_bytes.size} "
            "bytes"
        )
    user, number, *_ = _PACKETS_HEADER.unpack(packet_bytes[offset:end].tobytes())
    if user.split(b"\0")[0] != _USER or number != _PACKETS_NUMBER:
        raise ValueError(
            f"{path}: packets: the record at byte {offset} is {user!r}, {number}: not that of packets"
        )


def _check_points(
    path: Path,
    layouts: dict[int, PacketLayout],
    layout: np.ndarray,
    offset: np.ndarray,
    size: np.ndarray,
    available: int,
) -> None:
    """Refuse points whose packet has an unknown layout, another size than its layout, or does not fit.

    **Arguments:** `layout`, `offset`, `size`: (points,) of their packets, layout 0 for none; `available`:
    bytes of the record of packets.

    **Raises:** ValueError, naming the file, the point's record and the reason.
    """
    used = {int(n) for n in np.unique(layout)} - {0}
    for number in sorted(used):
        error = layouts[number].error if number in layouts else f"none of {sorted(layouts)}"
        if error:
            raise ValueError(f"{path}: record {np.argmax(layout == number)}: layout {number}: {error}")
    expected = np.zeros(_MAX_LAYOUTS + 1, np.int64)
    expected[sorted(used)] = [layouts[number].size for number in sorted(used)]
    has_packet = layout > 0
    wrong_size = has_packet & (size != expected[layout])
    if np.any(wrong_size):
        i = int(np.argmax(wrong_size))
        raise ValueError(
            f"{path}: record {i}: its packet has {size[i]} bytes; layout {layout[i]} has "
            f"{expected[layout[i]]}"
        )
    # Offsets are unsigned, of 64 bits: their sum with a size could overflow.
    outside = has_packet & (
        (offset < _PACKETS_HEADER.size)
        | (offset > max(available, 0))
        | (size > available - offset.astype(float))
    )
    if np.any(outside):
        i = int(np.argmax(outside))
        raise ValueError(
            f"{path}: record {i}: its packet of {size[i]} bytes at byte {offset[i]} does not lie within "
            f"the {available} bytes of packets"
        )


def _vector_sign(
    position: Float[np.ndarray, "points 3"],
    vector: Float[np.ndarray, "points 3"],
    location: Float[np.ndarray, " points"],
    packet: Int[np.ndarray, " points"],
) -> float:
    """Return 1 where vectors lead with the light, -1 where they lead back (see the module's docstring)."""
    same = np.diff(packet) == 0
    disagreement = [
        np.abs(np.diff(position - sign * location[:, None] * vector, axis=0))[same].sum() for sign in (1, -1)
    ]
    if disagreement[0] != disagreement[1]:
        return 1.0 if disagreement[0] < disagreement[1] else -1.0
    return 1.0 if np.median(vector[:, 2]) <= 0 else -1.0


class _Packets(NamedTuple):
    """Properties of packets that tell which of them are of one shot.

    - `start`: position of the first sample, m. `direction`: of light, m per ns.
    - `length`: ns from the first sample to the end. `step`: ns from sample to sample.
    - `gps_time`: s. `source`: number of the flight line or instrument. `channel`: of the scanner.
    """

    start: Float[np.ndarray, "packets 3"]
    direction: Float[np.ndarray, "packets 3"]
    length: Float[np.ndarray, " packets"]
    step: Shaped[np.ndarray, " packets"]
    gps_time: Float[np.ndarray, " packets"]
    source: Shaped[np.ndarray, " packets"]
    channel: Shaped[np.ndarray, " packets"]


def _group_into_shots(
    packets: _Packets,
) -> tuple[Int[np.ndarray, " packets"], Bool[np.ndarray, " packets"]]:
    """Return the order of packets in which those of one shot follow one another, and which begin a shot.

    Packets are of one shot if they have the same GPS time (not 0), source and scanner channel and lie one
    after another on one line.
    """
    # Positions of some 1e6 m leave few digits for distances along the line: relative to their mean.
    centred = packets.start - packets.start.mean(axis=0)
    step2 = np.sum(packets.direction**2, axis=1)
    along = np.sum(centred * packets.direction, axis=1) / step2
    # Without a GPS time every packet is a shot, in the order of the file: the sort is stable.
    along = np.where(packets.gps_time != 0, along, 0.0)
    order = np.lexsort((along, packets.channel, packets.source, packets.gps_time))
    start, direction, length, step, gps_time, source, channel = (field[order] for field in packets)
    between, step2 = np.diff(start, axis=0), step2[order][:-1]
    time = np.sum(between * direction[:-1], axis=1) / step2
    off_line = np.linalg.norm(between - time[:, None] * direction[:-1], axis=1)
    turn = np.linalg.norm(np.diff(direction, axis=0), axis=1)
    follows = (
        (np.diff(gps_time) == 0)
        & (gps_time[1:] != 0)
        & (source[1:] == source[:-1])
        & (channel[1:] == channel[:-1])
        & (step[1:] == step[:-1])
        & (off_line < _MAX_OFF_LINE)
        & (turn < _MAX_TURN * np.sqrt(step2))
        & (time > length[:-1] - step[1:] / 2)
    )
    return order, np.r_[True, ~follows]


# -- writing -----------------------------------------------------------------------------------------------


def write_las_waveforms(
    path: str | os.PathLike[str], shots: Iterable[AirborneShot], *, point_format: int = 9
) -> None:
    """Write airborne shots as a LAS 1.4 file with waveform packets in a .wdp file beside it.

    Samples, their gain, offset and sampling interval, GPS times and scanner channels are kept exactly;
    positions are rounded to mm, directions to single precision, scan angles to 0.006 degrees (whole ones in
    formats 4 and 5). The shots' returns become points. A segment
    without a return gets one, at its largest sample, flagged as synthetic, because packets are found by their
    points. The format has no place for outgoing pulses. Shots are taken one at a time, so that there may be
    more than memory holds.

    This needs laspy (`pip install "jaxlidar[io]"`). Existing files are replaced when the new ones are
    complete, the .wdp file first.

    **Arguments:**

    - `path`: the .las file. Missing folders are created.
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
    >>> line = {"anchor": np.array([5e5, 4e6, 20.0]), "direction": np.array([0.0, 0.0, -0.15])}
    >>> write_las_waveforms(path, [AirborneShot(0, **line, returning=(echo,), gps_time=2.5)])
    >>> (shot,) = read_las_waveforms(path)
    >>> print(shot.waveform, shot.returns.position[0, 2], shot.gps_time)
    [ 3.  5. 90. 60.  9.  4.  3.  2.] 19.7 2.5
    """
    if point_format not in _PACKET_FORMATS:
        raise ValueError(f"point_format = {point_format} has no packets; those of {_PACKET_FORMATS} have")
    path = las_path(path)
    # The inner file appears first: a LAS file that exists has its packets.
    with atomic_writes(_packet_path(path), path) as (packet_draft, draft):
        writer = _PacketWriter()
        with packet_draft.open("wb") as file:
            file.write(bytes(_PACKETS_HEADER.size))
            for shot in shots:
                writer.write(shot, file)
            size = file.tell() - _PACKETS_HEADER.size
            file.seek(0)
            file.write(_PACKETS_HEADER.pack(_USER, _PACKETS_NUMBER, size, b"Waveform Data Packets"))
        if not writer.positions:
            raise ValueError("shots: there is none; a file holds at least one")
        fields = {name: np.concatenate(values) for name, values in writer.fields.items()}
        points = las_points(point_format, np.concatenate(writer.positions), fields, writer.system)
        points.header.global_encoding.waveform_data_packets_external = True
        laspy = import_laspy("writing LAS")
        for layout, number in writer.layouts.items():
            record = laspy.VLR(_USER.decode(), _BEFORE_FIRST_LAYOUT + number, "", _LAYOUT.pack(*layout))
            points.header.vlrs.append(record)
        with draft.open("wb") as file:
            points.write(file)


class _PacketWriter:
    """Writes packets, and collects the fields of their points."""

    def __init__(self):
        self.layouts: dict[PacketLayout, int] = {}
        self.positions: list[np.ndarray] = []
        self.fields: dict[str, list[np.ndarray]] = {}
        self.system: CoordinateSystem | None = None
        self.geographic, self.crs = False, None

    def write(self, shot: AirborneShot, file: BinaryIO) -> None:
        """Write the packets of a shot, and collect its points."""
        if not self.positions:
            self.geographic, self.crs = shot.is_geographic, shot.crs
            self.system = _system_of_shot(shot)
        if shot.is_geographic != self.geographic:
            raise ValueError(f"shot {shot.index}: degrees and metres in one file")
        if shot.crs != self.crs:
            raise ValueError(
                f"shot {shot.index}: its coordinate reference system is {shot.crs}, that of the first shot "
                f"{self.crs}; a file holds one"
            )
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
        segments = sorted(shot.returning, key=lambda segment: segment.start)
        returns, is_synthetic = _returns_with_synthetic(shot, segments)
        starts = np.array([segment.start for segment in segments])
        segment_of_return = np.maximum(np.searchsorted(starts, returns.time, "right") - 1, 0)
        layout, offset, size = (np.zeros(len(segments), np.int64) for _ in range(3))
        for k, segment in enumerate(segments):
            samples = _unsigned_samples(shot, segment)
            layout[k] = self._layout_number(shot, segment, samples)
            offset[k], size[k] = file.tell(), samples.nbytes
            file.write(samples.tobytes())
        # Vectors lead back along the beam, as in the specification.
        vector = np.broadcast_to(-shot.direction * _PS, returns.position.shape)
        self.positions.append(returns.position)
        fields = {
            "intensity": returns.intensity,
            "return_number": returns.number,
            "number_of_returns": returns.count,
            "classification": returns.classification,
            "synthetic": is_synthetic.astype(np.uint8),
            "gps_time": np.full(returns.time.size, 0.0 if shot.gps_time is None else shot.gps_time),
            "scanner_channel": np.full(returns.time.size, shot.scanner_channel),
            "scan_angle": np.full(returns.time.size, shot.scan_angle),
            "point_source_id": np.full(returns.time.size, shot.flight_line),
            "wavepacket_index": layout[segment_of_return],
            "wavepacket_offset": offset[segment_of_return],
            "wavepacket_size": size[segment_of_return],
            "return_point_wave_location": (returns.time - starts[segment_of_return]) / _PS,
            **{f"{axis}_t": vector[:, i] for i, axis in enumerate("xyz")},
        }
        for name, values in fields.items():
            self.fields.setdefault(name, []).append(values)

    def _layout_number(self, shot: AirborneShot, segment: Segment, samples: np.ndarray) -> int:
        """Return the number of a segment's layout, a new one where no segment before has the same."""
        step = round(segment.step / _PS)
        if abs(segment.step / _PS - step) > 1e-6 * step or not 0 < step < 2**32:
            raise ValueError(f"shot {shot.index}: samples every {segment.step:g} ns; admissible are whole ps")
        bits = 8 * samples.dtype.itemsize
        layout = PacketLayout(bits, 0, samples.size, step, float(segment.gain), float(segment.offset))
        number = self.layouts.setdefault(layout, len(self.layouts) + 1)
        if number > _MAX_LAYOUTS:
            raise ValueError(f"shot {shot.index}: one layout of packets more than {_MAX_LAYOUTS}")
        return number


def _system_of_shot(shot: AirborneShot) -> CoordinateSystem | None:
    """Return the coordinate reference system to declare for a shot; None for metres of an unknown one."""
    east, _, up = (float(metres) for metres in shot.metres)
    if shot.crs is not None:
        return system_of_name(f"shot {shot.index}: crs", shot.crs)
    if shot.is_geographic:
        return system_of_name("crs", "EPSG:4326")
    return None if east == up == 1.0 else system_of_name("crs", wkt_of_units(east, up))


def _returns_with_synthetic(shot: AirborneShot, segments: list[Segment]) -> tuple[Returns, np.ndarray]:
    """Return the returns of a shot, with one more for each segment that has none; True for those added."""
    empty = np.zeros(0, int)
    recorded = shot.returns or Returns(np.zeros((0, 3)), np.zeros(0), empty, empty, empty, empty)
    starts = [segment.start for segment in segments]
    segment_of_return = np.maximum(np.searchsorted(starts, recorded.time, "right") - 1, 0)
    without_return = [segment for k, segment in enumerate(segments) if k not in segment_of_return]
    time = np.array([segment.time[np.argmax(segment.samples)] for segment in without_return])
    count, zeros = recorded.time.size, np.zeros(len(without_return), int)
    total = count + len(without_return)
    synthetic = Returns(
        position=shot.anchor + time[:, None] * shot.direction,
        time=time,
        intensity=zeros,
        number=count + 1 + np.arange(len(without_return)),
        count=zeros + total,
        classification=zeros,
    )
    joined = (np.concatenate(pair) for pair in zip(recorded, synthetic))
    return Returns(*joined), np.arange(total) >= count


def _unsigned_samples(shot: AirborneShot, segment: Segment) -> np.ndarray:
    """Return samples as unsigned numbers: of the bits that they have, or of 16 or 32."""
    samples = segment.samples
    if samples.dtype.kind == "u" and samples.dtype.itemsize <= 4:
        return samples.astype(f"<u{samples.dtype.itemsize}")
    numbers = np.asarray(samples, float)
    wrong = ~((numbers >= 0) & (numbers < 2**32) & (numbers == np.floor(numbers)))
    if np.any(wrong):
        raise ValueError(
            f"shot {shot.index}: a sample is {numbers[wrong][0]:g}; admissible are whole numbers in [0, 2^32)"
        )
    return numbers.astype("<u2" if numbers.max() < 2**16 else "<u4")
