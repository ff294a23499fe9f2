"""Headers and variable length records of LAS and LAZ files; each size in them is compared with the file's.

laspy allocates and loops by the sizes that a header declares, reads the points before the end of a file
that is cut short, and refuses files for text in records that nobody asks for.

Source: LAS specification 1.4 (ASPRS). PulseWaves files have variable length records of the same kind.
"""

import dataclasses
import math
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

from jaxlidar._fields.crs import CoordinateSystem
from jaxlidar.formats.checks import check_unpacked_size
from jaxlidar.formats.coordinates import declared_system

# The public header block: signature, version, sizes of header and point records, legacy number of points,
# scales and offsets, and the largest and smallest x, y and z; from LAS 1.4 on, place and number of the
# extended records, and the number of points.
_PUBLIC_BLOCK = struct.Struct("<4s20x2B68xHIIBHI20x3d3d6d")
_EXTENDED_BLOCK, _EXTENDED_BLOCK_OFFSET = struct.Struct("<QIQ"), 235
_HEADER_SIZES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375, 5: 393}
# The header of a variable length record (user, number, length), and that of an extended one.
_RECORD_HEADER, _EXTENDED_RECORD_HEADER = struct.Struct("<2x16sHH32x"), struct.Struct("<2x16sHQ32x")
_LASZIP_RECORD = (b"laszip encoded", 22204)
# The user of the records that declare the coordinate reference system.
PROJECTION_USER = b"LASF_Projection"
# The bit of the point format that says that points are compressed, by LAZ and not by the specification.
_COMPRESSED = 128
# Items of a point record by point format, as LAZ numbers them, and their sizes in bytes. Extra bytes may
# follow.
ITEMS = {
    **{0: (6,), 1: (6, 7), 2: (6, 8), 3: (6, 7, 8), 4: (6, 7, 9), 5: (6, 7, 8, 9)},
    **{6: (10,), 7: (10, 11), 8: (10, 12), 9: (10, 13), 10: (10, 12, 13)},
}
ITEM_SIZES = {6: 20, 7: 8, 8: 6, 9: 29, 10: 30, 11: 6, 12: 8, 13: 29}
# Admissible units of length in which coordinates are counted.
_SCALES = (1e-9, 1e3)


class VariableRecord(NamedTuple):
    """A variable length record: its user, its number, and the offset and length in bytes of its content."""

    user: bytes
    number: int
    offset: int
    length: int


def variable_records(
    path: Path, file: BinaryIO, header: struct.Struct, start: int, end: int, count: int, next_content: str
) -> Iterator[VariableRecord]:
    """Yield the variable length records that lie between two offsets of a file.

    `header` unpacks user, number and length of a record; `next_content` names what begins at `end`.

    **Raises:** ValueError, naming the file and the record, where records do not fit.
    """
    offset = start
    for i in range(count):
        if offset + header.size > end:
            raise ValueError(f"{path}: header: {count} variable length records, but there is room for {i}")
        file.seek(offset)
        user, number, length = header.unpack(file.read(header.size))
        offset += header.size + length
        if length < 0 or offset > end:
            raise ValueError(
                f"{path}: variable length record {i}: its {length} bytes run into the {next_content}, from "
                f"{end} on"
            )
        yield VariableRecord(user.split(b"\0")[0], number, offset - length, length)


def check_scales(
    location: str,
    axes: str,
    scales: Sequence[float],
    offsets: Sequence[float],
    admissible: tuple[float, float],
) -> None:
    """Refuse scales of counted numbers outside a range, and offsets that are not finite."""
    for axis, scale, offset in zip(axes, scales, offsets):
        if not admissible[0] <= scale <= admissible[1]:
            raise ValueError(f"{location}: scale of {axis} = {scale:g} is outside the range {admissible}")
        if not math.isfinite(offset):
            raise ValueError(f"{location}: offset of {axis} = {offset:g} is not finite")


@dataclasses.dataclass(frozen=True)
class LasHeader:
    """The header of a LAS file.

    - `point_format`: number of the point format, and `point_size`: bytes of a point record.
    - `points`: number of points, and `start`: offset of the first, in bytes.
    - `scales`, `offsets`: of x, y and z.
    - `low`, `high`: smallest and largest x, y and z.
    - `laszip`: the variable length record that describes the compression of points; None where they are not
      compressed.
    - `records`: offsets and lengths of the variable length records, by user and number; the extended ones,
      which lie after the points, come last.
    """

    point_format: int
    point_size: int
    points: int
    start: int
    scales: tuple[float, ...]
    offsets: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    laszip: bytes | None = None
    records: dict[tuple[bytes, int], list[tuple[int, int]]] = dataclasses.field(default_factory=dict)

    def contents(self, file: BinaryIO, user: bytes, number: int) -> list[bytes]:
        """Return the contents of the variable length records of a user and number."""
        contents = []
        for offset, length in self.records.get((user, number), ()):
            file.seek(offset)
            contents.append(file.read(length))
        return contents

    def record(self, file: BinaryIO, user: bytes, number: int) -> bytes | None:
        """Return the content of the first variable length record of a user and number; None without."""
        return next(iter(self.contents(file, user, number)), None)

    def coordinate_system(self, path: Path, file: BinaryIO) -> CoordinateSystem:
        """Return the coordinate reference system that the file declares.

        **Raises:** as `declared_system`.
        """
        return declared_system(f"{path}: header", lambda number: self.contents(file, PROJECTION_USER, number))

    @property
    def extra_bytes(self) -> int:
        """Bytes of a point record beyond those that its format names."""
        return self.point_size - sum(ITEM_SIZES[item] for item in ITEMS[self.point_format])


def read_header(path: Path, file: BinaryIO) -> LasHeader:
    """Read the header of a file, whose points then fit into it; compressed ones at least plausibly.

    **Raises:** ValueError, naming the file and the place, for a header that makes no sense.
    """
    size = path.stat().st_size
    block = file.read(max(_HEADER_SIZES.values()))
    if not block.startswith(b"LASF"):
        raise ValueError(f"{path}: header: not a LAS file: it does not begin with LASF")
    if len(block) < _PUBLIC_BLOCK.size:
        raise ValueError(f"{path}: header: the file ends after {size} bytes")
    fields = _PUBLIC_BLOCK.unpack_from(block)
    _, major, minor, header_size, start, records, format_byte, point_size, points, *numbers = fields
    # The ends of axes alternate, the largest first.
    scales, offsets, high, low = map(tuple, (numbers[:3], numbers[3:6], numbers[6::2], numbers[7::2]))
    if major != 1 or minor not in _HEADER_SIZES:
        raise ValueError(f"{path}: header: version {major}.{minor} is none of LAS 1.0 to 1.5")
    if not _HEADER_SIZES[minor] <= header_size <= start <= size:
        raise ValueError(
            f"{path}: header: it is {header_size} bytes long and points begin at {start}: a file of {size} "
            f"bytes and version 1.{minor} admits {_HEADER_SIZES[minor]} or more, in this order"
        )
    extended, extended_count = 0, 0
    if minor >= 4:
        extended, extended_count, points = _EXTENDED_BLOCK.unpack_from(block, _EXTENDED_BLOCK_OFFSET)
        if extended_count and extended + extended_count * _EXTENDED_RECORD_HEADER.size > size:
            raise ValueError(
                f"{path}: header: {extended_count} extended records from {extended} on do not fit into "
                f"{size} bytes"
            )
    point_format = format_byte & ~_COMPRESSED
    header = LasHeader(point_format, point_size, points, start, scales, offsets, low, high)
    if header.point_format not in ITEMS or header.extra_bytes < 0:
        raise ValueError(f"{path}: header: point format {header.point_format}, records of {point_size} bytes")
    check_scales(f"{path}: header", "xyz", scales, offsets, _SCALES)
    if points == 0:
        raise ValueError(f"{path}: header: the file holds no points")
    ordinary = variable_records(path, file, _RECORD_HEADER, header_size, start, records, "points")
    appended = variable_records(
        path, file, _EXTENDED_RECORD_HEADER, extended, size, extended_count, "end of the file"
    )
    locations: dict[tuple[bytes, int], list[tuple[int, int]]] = {}
    for record in (*ordinary, *appended):
        locations.setdefault((record.user, record.number), []).append((record.offset, record.length))
    header = dataclasses.replace(header, records=locations)
    laszip = header.record(file, *_LASZIP_RECORD)
    if not format_byte & _COMPRESSED:
        if start + points * point_size > size:
            raise ValueError(
                f"{path}: record {(size - start) // point_size}: the file ends, but its header names "
                f"{points} points"
            )
        return header
    check_unpacked_size(path, f"header: {points} points", points * point_size)
    if laszip is None:
        raise ValueError(f"{path}: header: points are compressed, but no record {_LASZIP_RECORD[1]} says how")
    return dataclasses.replace(header, laszip=laszip)
