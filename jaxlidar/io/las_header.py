"""The header of LAS and LAZ files, each of whose sizes is compared with the file's."""

import dataclasses
import math
import struct
from pathlib import Path
from typing import BinaryIO

from jaxlidar.io.checks import check_unpacked
from jaxlidar.io.variable_records import variable_records

# The public header block: signature, version, sizes of header and records, legacy count, scales and offsets;
# of LAS 1.4 the extended records and the count.
_PUBLIC = struct.Struct("<4s20x2B68xHIIBHI20x3d3d")
_EXTENDED, _EXTENDED_AT = struct.Struct("<QIQ"), 235
_HEADER_SIZE = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375, 5: 393}
# The header of a variable length record (user, number, length) and the length of that of an extended one.
_RECORD, _EXTENDED_RECORD_SIZE = struct.Struct("<2x16sHH32x"), 60
_LASZIP = (b"laszip encoded", 22204)
_COMPRESSED = 128
# The parts of a record by point format, as LAZ numbers them, and their sizes in bytes. Extra bytes may
# follow.
PARTS = {
    **{0: (6,), 1: (6, 7), 2: (6, 8), 3: (6, 7, 8), 4: (6, 7, 9), 5: (6, 7, 8, 9)},
    **{6: (10,), 7: (10, 11), 8: (10, 12), 9: (10, 13), 10: (10, 12, 13)},
}
PART_SIZES = {6: 20, 7: 8, 8: 6, 9: 29, 10: 30, 11: 6, 12: 8, 13: 29}
# Units of length in the file that coordinates may be counted in.
_SCALES = (1e-9, 1e3)


@dataclasses.dataclass(frozen=True)
class LasHeader:
    """What a LAS file says of its points.

    - `point_format`: number of the point format, and `point_size`: bytes of a point's record.
    - `points`: number of points, and `start`: where they begin, in bytes.
    - `scales`, `offsets`: of x, y and z.
    - `laszip`: the record that says how points are compressed; None where they are not.
    - `records`: place and length of each variable length record, by user and number.
    """

    point_format: int
    point_size: int
    points: int
    start: int
    scales: tuple[float, ...]
    offsets: tuple[float, ...]
    laszip: bytes | None = None
    records: dict[tuple[bytes, int], tuple[int, int]] = dataclasses.field(default_factory=dict)

    def record(self, file: BinaryIO, user: bytes, number: int) -> bytes | None:
        """The content of a variable length record; None where there is none."""
        if (user, number) not in self.records:
            return None
        at, length = self.records[user, number]
        file.seek(at)
        return file.read(length)

    @property
    def extra_bytes(self) -> int:
        """Bytes of a point's record beyond what its format names."""
        return self.point_size - sum(PART_SIZES[part] for part in PARTS[self.point_format])


def read_header(path: Path, file: BinaryIO) -> LasHeader:
    """The header of a file, whose points then fit into it; compressed ones at least plausibly.

    **Raises:** ValueError, naming the file and the place, for a header that makes no sense.
    """
    size = path.stat().st_size
    block = file.read(max(_HEADER_SIZE.values()))
    if not block.startswith(b"LASF"):
        raise ValueError(f"{path}: header: not a LAS file: it does not begin with LASF")
    if len(block) < _PUBLIC.size:
        raise ValueError(f"{path}: header: the file ends after {size} bytes")
    _, major, minor, header_size, start, records, kind, point_size, points, *xyz = _PUBLIC.unpack_from(block)
    if major != 1 or minor not in _HEADER_SIZE:
        raise ValueError(f"{path}: header: version {major}.{minor} is none of LAS 1.0 to 1.5")
    if not _HEADER_SIZE[minor] <= header_size <= start <= size:
        raise ValueError(
            f"{path}: header: it is {header_size} bytes long and points begin at {start}: a file of {size} "
            f"bytes and version 1.{minor} admits {_HEADER_SIZE[minor]} or more, in this order"
        )
    if minor >= 4:
        extended, count, points = _EXTENDED.unpack_from(block, _EXTENDED_AT)
        if count and extended + count * _EXTENDED_RECORD_SIZE > size:
            raise ValueError(
                f"{path}: header: {count} extended records from {extended} on do not fit into {size} bytes"
            )
    header = LasHeader(kind & ~_COMPRESSED, point_size, points, start, tuple(xyz[:3]), tuple(xyz[3:]))
    if header.point_format not in PARTS or header.extra_bytes < 0:
        raise ValueError(f"{path}: header: point format {header.point_format}, records of {point_size} bytes")
    for axis, scale, offset in zip("xyz", xyz[:3], xyz[3:]):
        if not _SCALES[0] <= scale <= _SCALES[1]:
            raise ValueError(f"{path}: header: scale of {axis} = {scale:g} is outside the range {_SCALES}")
        if not math.isfinite(offset):
            raise ValueError(f"{path}: header: offset of {axis} = {offset:g} is not finite")
    if points == 0:
        raise ValueError(f"{path}: header: the file holds no points")
    found = variable_records(path, file, _RECORD, header_size, start, records, "points")
    header = dataclasses.replace(header, records={(r.user, r.number): (r.place, r.length) for r in found})
    laszip = header.record(file, *_LASZIP)
    if not kind & _COMPRESSED:
        if start + points * point_size > size:
            raise ValueError(
                f"{path}: record {(size - start) // point_size}: the file ends, but its header names "
                f"{points} points"
            )
        return header
    check_unpacked(path, f"header: {points} points", points * point_size)
    if laszip is None:
        raise ValueError(f"{path}: header: points are compressed, but no record {_LASZIP[1]} says how")
    return dataclasses.replace(header, laszip=laszip)
