"""Reader of airborne waveforms in LAS files: wave packets, in the file or in a .wdp file beside it.

Points hold where the packet of samples of their shot begins, how it is laid out, and how far from its first
sample they lie. What that makes of a shot was found from recorded files.

- A point's vector leads back along the beam, against the light: the first sample of its packet lies at the
  point plus the location times the vector, as the specification's anchor does. Some writers lead it the other
  way. The reader takes the way in which points of a packet agree on its first sample; where no packet has two
  points, light goes down.
- Points of a packet agree on its first sample to 2 mm (RIEGL Q680i), which is the rounding of coordinates.
- A packet is a segment. Packets of one GPS time that lie one after another on one line are segments of one
  shot: of a crown and the ground far below it, for instance.
- Packets without a point are not found, and no outgoing pulse is in the file.
"""

import os
from pathlib import Path
from typing import Any, final

import numpy as np

from jaxlidar.io.airborne import Returns, Segment
from jaxlidar.io.airborne_shots import AirborneShots, evenly
from jaxlidar.io.checks import FARTHEST, existing
from jaxlidar.io.coordinates import GEO_KEYS, WKT, frame_of, is_geographic
from jaxlidar.io.las_header import read_header
from jaxlidar.io.las_packets import (
    FORMATS,
    Packets,
    beside,
    check_packets,
    check_points,
    layouts_of,
    shots_of,
    way_of_vectors,
)

# In the public header: flags, of which one says that packets lie within the file, and where they do.
_FLAGS_AT, _WITHIN, _PACKETS_AT = 6, 2, 227
_PROJECTION = b"LASF_Projection"
_PS = 1e-3
# No point lies farther from the first sample of its packet, ns.
_FARTHEST_LOCATION = 1e6


def read_las_waveforms(path: str | os.PathLike[str]) -> AirborneShots:
    """The shots of a LAS file with waveform packets (point formats 4, 5, 9 and 10).

    This needs laspy (`pip install "jaxlidar[io]"`). Both files are mapped: samples are read when they are
    asked for. Each shot has its points as `returns`, and no outgoing pulse. Coordinates may be metres, feet
    or degrees.

    **Arguments:**

    - `path`: the .las file; packets lie in it, or in the .wdp file beside it under the same name.

    **Returns:** an `AirborneShots`, in the order of GPS time. Its `dropped` counts points "without a packet".

    **Raises:** FileNotFoundError where there is no such file, or no .wdp file. ImportError without laspy.
    ValueError, naming the file and the place (the record of a point), where it is damaged, cut short,
    declares more than it can hold, has no packets or compressed ones, and where a point's packet has an
    unknown layout or lies outside of the file, or its vector is not the way that light goes.

    **Source:** LAS specification 1.4 (ASPRS).

    **Example:**

    >>> from jaxlidar.io import read_las_waveforms
    >>> shot = read_las_waveforms("flight.las")[0]  # doctest: +SKIP
    >>> print(shot.returns.number, shot.elevation[shot.signal.argmax()])  # doctest: +SKIP
    """
    return _LasShots(existing(path))


def has_packets(path: Path) -> bool:
    """Whether the points of a LAS file, not compressed, have waveform packets."""
    with path.open("rb") as file:
        header = read_header(path, file)
    return header.point_format in FORMATS and header.laszip is None


@final
class _LasShots(AirborneShots):
    def __init__(self, path: Path):
        try:
            import laspy
        except ImportError as error:
            raise ImportError('reading LAS needs laspy: pip install "jaxlidar[io]"') from error
        self.path, self.tables = path, {}
        with path.open("rb") as file:
            header = read_header(path, file)
            if header.point_format not in FORMATS:
                raise ValueError(
                    f"{path}: header: point format {header.point_format} has no packets; {FORMATS} have"
                )
            if header.laszip is not None:
                raise ValueError(f"{path}: header: points are compressed: their packets are not read")
            self.layouts = layouts_of(path, file, header)
            systems = (header.record(file, _PROJECTION, number) or b"" for number in (GEO_KEYS, WKT))
            geographic = is_geographic(*systems)
            file.seek(_FLAGS_AT)
            flags = int.from_bytes(file.read(2), "little")
            file.seek(_PACKETS_AT)
            within = int.from_bytes(file.read(8), "little")
        packet_path, self.base = path, within
        if not flags & _WITHIN:
            packet_path, self.base = existing(beside(path)), 0
        self.packets = (
            np.memmap(packet_path, np.uint8, "r") if packet_path.stat().st_size else np.zeros(0, "u1")
        )
        check_packets(packet_path, self.packets, self.base)
        self.scale, self.offset = np.array(header.scales), np.array(header.offsets)
        point_format = laspy.PointFormat(header.point_format)
        if header.extra_bytes:
            point_format.add_extra_dimension(laspy.ExtraBytesParams("extra", f"{header.extra_bytes}u1"))
        self.records: Any = laspy.PackedPointRecord(
            np.memmap(path, point_format.dtype(), "r", header.start, (header.points,)), point_format
        )
        self._find_packets(geographic)

    def _find_packets(self, geographic: bool) -> None:
        """Which points are of one packet, and which packets of one shot."""
        records = self.records
        layout, place, size = (np.asarray(records[f"wavepacket_{n}"]) for n in ("index", "offset", "size"))
        check_points(self.path, self.layouts, layout, place, size, self.packets.size - self.base)
        points = np.flatnonzero(layout)
        self.dropped = {"without a packet": int(layout.size - points.size)}
        if points.size == 0:
            raise ValueError(f"{self.path}: record 0: neither this point nor another has a packet")
        location, number = _location(records), np.asarray(records["return_number"])
        points = points[np.lexsort((number[points], location[points], place[points]))]
        is_first = np.r_[True, place[points][1:] != place[points][:-1]]
        location, position, vector = (
            location[points],
            self._position(records)[points],
            _vector(records)[points],
        )
        self._check(points, np.c_[position, vector, location], ~(np.abs(location) <= _FARTHEST_LOCATION))
        self.way = way_of_vectors(position, vector, location, np.cumsum(is_first))
        direction = self.way * vector
        start = position - location[:, None] * direction
        some = evenly(points.size)
        self.frame = frame_of(f"{self.path}: points", geographic, start[some], direction[some])
        self._check(points, direction, self.frame.wrong(start, direction))

        first = np.flatnonzero(is_first)
        heads, metres = points[first], self.frame.metres(start[first])
        layouts = [self.layouts[int(n)] for n in layout[heads]]
        steps = np.array([each.step * _PS for each in layouts])
        packets = Packets(
            start=start[first] * metres,
            direction=direction[first] * metres,
            length=steps * [each.samples for each in layouts],
            step=steps,
            gps_time=np.asarray(records["gps_time"])[heads],
            source=np.asarray(records["point_source_id"])[heads],
        )
        order, begins = shots_of(packets)
        # Points by packet; where those of each packet begin and end; where the packets of each shot do.
        self.by_packet, ends = points, np.r_[first[1:], points.size]
        self.first_point, self.last_point = first[order], ends[order]
        self.first_packet = np.flatnonzero(begins)
        self.last_packet = np.r_[self.first_packet[1:], order.size]
        self.heads = heads[order[self.first_packet]]

    def _check(self, points: np.ndarray, numbers: np.ndarray, wrong: np.ndarray) -> None:
        """Refuse points whose numbers are too large, or otherwise wrong."""
        wrong = wrong | ~(np.abs(numbers) <= FARTHEST).all(axis=1)
        if np.any(wrong):
            which = int(np.argmax(wrong))
            raise ValueError(
                f"{self.path}: record {points[which]}: its place in space, its vector or its location in the "
                f"packet makes no sense: {numbers[which].tolist()}"
            )

    def _position(self, records: Any) -> np.ndarray:
        units = np.stack([np.asarray(records[axis]) for axis in "XYZ"], axis=-1)
        return units * self.scale + self.offset

    def _line(self, records: Any) -> tuple[np.ndarray, np.ndarray]:
        """Where the first samples of points' packets lie, and the ways of light."""
        direction = self.way * _vector(records)
        return self._position(records) - _location(records)[:, None] * direction, direction

    def __len__(self) -> int:
        return self.heads.size

    @property
    def gps_time(self) -> np.ndarray:
        return np.asarray(self.records["gps_time"], float)[self.heads]

    @property
    def direction(self) -> np.ndarray:
        return self._line(self.records[self.heads])[1]

    @property
    def anchor(self) -> np.ndarray:
        return self._line(self.records[self.heads])[0]

    def _facts(self, index: int) -> dict[str, Any]:
        own = range(self.first_packet[index], self.last_packet[index])
        parts = [self.records[self.by_packet[self.first_point[k] : self.last_point[k]]] for k in own]
        anchors, directions = self._line(parts[0][:1])
        anchor, direction = anchors[0], directions[0]
        segments, times, positions = [], [], []
        for k, records in enumerate(parts):
            layout, place = self.layouts[int(records["wavepacket_index"][0])], records["wavepacket_offset"][0]
            at, location, position = self.base + int(place), _location(records), self._position(records)
            way = float((position[0] - anchor) @ direction / (direction @ direction))
            start = way - float(location[0]) if k else 0.0
            samples = np.asarray(self.packets[at : at + layout.size]).view(f"<u{layout.bits // 8}")
            segments.append(
                Segment(samples, start, layout.step * _PS, gain=layout.gain, offset=layout.offset)
            )
            times.append(start + location)
            positions.append(position)
        names = ("intensity", "return_number", "number_of_returns", "classification")
        numbers = (np.concatenate([np.asarray(r[name], int) for r in parts]) for name in names)
        return {
            "outgoing": (),
            "returning": tuple(segments),
            "anchor": anchor,
            "direction": direction,
            "metres": self.frame.metres(anchor),
            "gps_time": float(parts[0]["gps_time"][0]),
            "returns": Returns(np.concatenate(positions), np.concatenate(times), *numbers),
        }


def _vector(records: Any) -> np.ndarray:
    return np.stack([np.asarray(records[f"{axis}_t"], float) for axis in "xyz"], axis=-1) / _PS


def _location(records: Any) -> np.ndarray:
    return np.asarray(records["return_point_wave_location"], float) * _PS
