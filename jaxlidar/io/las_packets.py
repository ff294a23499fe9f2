"""Waveform packets of LAS files: how they are laid out, and which points and packets belong to one shot."""

import math
import struct
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from jaxlidar.io.las_header import LasHeader

# The point formats that have packets.
FORMATS = (4, 5, 9, 10)
# Layouts of packets: user and number of the record before the first one; they are numbered from 1 to 255.
USER, BEFORE_FIRST, MOST = b"LASF_Spec", 99, 255
LAYOUT = struct.Struct("<BBIIdd")
# The record that packets lie in, at the beginning of a .wdp file, and its number.
PACKETS, PACKETS_NUMBER = struct.Struct("<2x16sHQ32s"), 65535
# Packets of one shot lie on one line to this many metres, and its directions differ by this part at most.
_ACROSS, _TURN = 0.05, 1e-3


class Layout(NamedTuple):
    """How a packet is stored: bits of a sample, compression, samples, ps between them, and their gain and
    offset."""

    bits: int
    compression: int
    samples: int
    step: int
    gain: float
    offset: float

    @property
    def wrong(self) -> str:
        """What makes no sense in it; empty where it does."""
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


def beside(path: Path) -> Path:
    """The file of packets that belongs to a LAS file."""
    return path.with_suffix(".WDP" if path.suffix.isupper() else ".wdp")


def layouts_of(path: Path, file: BinaryIO, header: LasHeader) -> dict[int, Layout]:
    """The layouts that a file names, by their number. Those that no packet has may make no sense."""
    found = {}
    for number in range(1, MOST + 1):
        record = header.record(file, USER, BEFORE_FIRST + number)
        if record is None:
            continue
        if len(record) < LAYOUT.size:
            raise ValueError(f"{path}: record of layout {number}: {len(record)} bytes")
        found[number] = Layout(*LAYOUT.unpack_from(record))
    return found


def check_packets(path: Path, packets: np.ndarray, base: int) -> None:
    """Refuse what is not the record that packets lie in.

    **Raises:** ValueError, naming the file and the place.
    """
    if base + PACKETS.size > packets.size:
        raise ValueError(
            f"{path}: packets: their record begins at {base}, but the file ends after {packets.size} bytes"
        )
    user, number, *_ = PACKETS.unpack(packets[base : base + PACKETS.size].tobytes())
    if user.split(b"\0")[0] != USER or number != PACKETS_NUMBER:
        raise ValueError(
            f"{path}: packets: the record at byte {base} is {user!r}, {number}: not that of packets"
        )


def check_points(
    path: Path, layouts: dict[int, Layout], layout: np.ndarray, place: np.ndarray, size: np.ndarray, room: int
) -> None:
    """Refuse points whose packet has an unknown layout, another size than its layout, or no room.

    **Arguments:** `layout`, `place`, `size`: (points,) of their packets, layout 0 for none; `room`: bytes
    that packets lie in.

    **Raises:** ValueError, naming the file, the record and what is wrong.
    """
    used = {int(n) for n in np.unique(layout)} - {0}
    for number in sorted(used):
        wrong = layouts[number].wrong if number in layouts else f"none of {sorted(layouts)}"
        if wrong:
            raise ValueError(f"{path}: record {np.argmax(layout == number)}: layout {number}: {wrong}")
    expected = np.zeros(MOST + 1, np.int64)
    expected[sorted(used)] = [layouts[number].size for number in sorted(used)]
    there = layout > 0
    other = there & (size != expected[layout])
    if np.any(other):
        at = int(np.argmax(other))
        raise ValueError(
            f"{path}: record {at}: its packet has {size[at]} bytes; layout {layout[at]} has "
            f"{expected[layout[at]]}"
        )
    outside = there & ((place < PACKETS.size) | (place > max(room, 0)) | (size > room - place.astype(float)))
    if np.any(outside):
        at = int(np.argmax(outside))
        raise ValueError(
            f"{path}: record {at}: its packet of {size[at]} bytes at byte {place[at]} does not lie within "
            f"the {room} bytes of packets"
        )


def way_of_vectors(
    position: Float[np.ndarray, "points 3"],
    vector: Float[np.ndarray, "points 3"],
    location: Float[np.ndarray, " points"],
    packet: Int[np.ndarray, " points"],
) -> float:
    """1 where vectors lead with the light, -1 where they lead back: points of a packet agree on its first
    sample.

    Where no packet has two points, light goes down.
    """
    same = np.diff(packet) == 0
    away = [np.abs(np.diff(position - s * location[:, None] * vector, axis=0))[same].sum() for s in (1, -1)]
    if away[0] != away[1]:
        return 1.0 if away[0] < away[1] else -1.0
    return 1.0 if np.median(vector[:, 2]) <= 0 else -1.0


class Packets(NamedTuple):
    """What is known of each packet: where its first sample lies, m; the way of light in 1 ns, m; ns from the
    first sample to the end; ns between samples; GPS time; what else must be the same for one shot."""

    start: Float[np.ndarray, "packets 3"]
    direction: Float[np.ndarray, "packets 3"]
    length: Float[np.ndarray, " packets"]
    step: Shaped[np.ndarray, " packets"]
    gps_time: Float[np.ndarray, " packets"]
    source: Shaped[np.ndarray, " packets"]


def shots_of(packets: Packets) -> tuple[Int[np.ndarray, " packets"], Bool[np.ndarray, " packets"]]:
    """Packets in the order of shots, and which of them are the first of a shot.

    Packets are of one shot that have one GPS time (not 0) and source and lie one after another on one line.
    """
    centred = packets.start - packets.start.mean(axis=0)
    step2 = np.sum(packets.direction**2, axis=1)
    along = np.sum(centred * packets.direction, axis=1) / step2
    order = np.lexsort((along, packets.source, packets.gps_time))
    start, direction, length, step, gps_time, source = (field[order] for field in packets)
    way, step2 = np.diff(start, axis=0), step2[order][:-1]
    time = np.sum(way * direction[:-1], axis=1) / step2
    across = np.linalg.norm(way - time[:, None] * direction[:-1], axis=1)
    turn = np.linalg.norm(np.diff(direction, axis=0), axis=1)
    follows = (
        (np.diff(gps_time) == 0)
        & (gps_time[1:] != 0)
        & (source[1:] == source[:-1])
        & (step[1:] == step[:-1])
        & (across < _ACROSS)
        & (turn < _TURN * np.sqrt(step2))
        & (time > length[:-1] - step[1:] / 2)
    )
    return order, np.r_[True, ~follows]
