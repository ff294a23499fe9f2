"""Decompression of the points of LAZ files by lazrs.

lazrs allocates the memory that a file declares, and ends the process where that fails. So all declared sizes
are checked first: those of the compression record, of the chunk table, and, from point format 6 on, of the
layers of each chunk, which hold one field each. All of them must fit into the file.

Two kinds of damaged bytes also end the process, and are refused:

- An arithmetic-coded stream never begins with four bytes of 255. In one that does, lazrs looks up symbols
  that do not exist.
- lazrs calls itself at each change between sequences of GPS times. Many bytes of 255 in a row decode to so
  many changes that the stack overflows.
"""

import itertools
import struct
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxlidar._fields.checks import required_for
from jaxlidar.formats.checks import check_unpacked_size
from jaxlidar.formats.las_header import ITEM_SIZES, ITEMS, LasHeader

# The compression record: compressor, points per chunk and number of items; each item has a kind, a size and a
# version.
_COMPRESSION, _ITEM = struct.Struct("<H10xI16xH"), struct.Struct("<3H")
_CHUNKED, _LAYERED = 2, 3
# The number of points per chunk of files whose chunk table has the number of each.
_VARIABLE = 2**32 - 1
# Number of layers by item. Extra bytes have a layer each.
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
_EXTRA_BYTES, _EXTRA_LAYERS = 0, 14
# Bytes that lazrs allocates for the statistics of each extra byte.
_PER_EXTRA_BYTE = 10_000
# The layers with the fields of a `PointCloud` come first; those of its extra bytes come last.
_USED_LAYERS = 9
# Number of the layer with GPS times.
_TIMES_LAYER = 8
_TABLE_HEADER = struct.Struct("<2I")
_IMPOSSIBLE_START, _ENDLESS_TIMES = b"\xff" * 4, b"\xff" * 8


class _Packing(NamedTuple):
    """The compression: `layered` if each field has a layer, points per chunk, and number of layers."""

    layered: bool
    chunk_size: int
    layers: int


def decompress_points(
    path: Path, file: BinaryIO, header: LasHeader, *, with_packets: bool = False
) -> bytearray:
    """Return the binary records of all points, as a LAS file has them.

    **Arguments:** `with_packets`: all fields, those of waveform packets too; else those of a `PointCloud`.

    **Raises:** ImportError without lazrs. ValueError, naming the file and the place, where they are damaged.
    """
    lazrs = _import_lazrs()
    packing = _read_packing(path, header)
    first, table, chunks = _read_chunk_table(path, file, header)
    file.seek(header.start)
    try:
        entries = lazrs.read_chunk_table(file, lazrs.LazVlr(header.laszip))
    except (RuntimeError, OSError) as error:
        raise ValueError(f"{path}: chunk table: damaged ({error})") from error
    sizes = _chunk_sizes(path, header, packing, entries, table - first)
    if packing.layered:
        is_used = np.ones(packing.layers, bool)
        is_used[_USED_LAYERS : packing.layers - header.extra_bytes] = with_packets
        _check_layers(path, file, header, is_used, sizes, first)
    else:
        _check_streams(path, file, header, sizes, first)
    points = bytearray(header.points * header.point_size)
    # Threads decompress a chunk each. For one chunk they do not help, and would allocate its declared size.
    decompressor = lazrs.ParLasZipDecompressor if chunks > 1 else lazrs.LasZipDecompressor
    file.seek(header.start)
    try:
        decompressor(file, header.laszip, _selection(lazrs, with_packets)).decompress_many(points)
    except (RuntimeError, OSError) as error:
        raise ValueError(f"{path}: chunks: damaged ({error})") from error
    return points


def _import_lazrs() -> Any:
    with required_for("reading LAZ"):
        import lazrs  # pyright: ignore[reportMissingImports]
    return lazrs


def _selection(lazrs: Any, with_packets: bool) -> Any:
    """Return lazrs' selection of the fields that a `PointCloud` holds, or of all fields."""
    if with_packets:
        return lazrs.DecompressionSelection(lazrs.SELECTIVE_DECOMPRESS_ALL)
    names = ("XY_RETURNS_CHANNEL", "Z", "CLASSIFICATION", "FLAGS", "INTENSITY")
    names += ("SCAN_ANGLE", "POINT_SOURCE_ID", "GPS_TIME", "ALL_EXTRA_BYTES")
    return lazrs.DecompressionSelection(sum(getattr(lazrs, f"SELECTIVE_DECOMPRESS_{n}") for n in names))


def _read_packing(path: Path, header: LasHeader) -> _Packing:
    """Read the compression record, and compare its items with the point format."""
    record = header.laszip or b""
    location = f"{path}: record of the compression"
    if len(record) < _COMPRESSION.size:
        raise ValueError(f"{location}: {len(record)} bytes")
    compressor, chunk_size, count = _COMPRESSION.unpack_from(record)
    if len(record) < _COMPRESSION.size + count * _ITEM.size:
        raise ValueError(f"{location}: {len(record)} bytes cannot name {count} items")
    unpacked = (_ITEM.unpack_from(record, _COMPRESSION.size + i * _ITEM.size) for i in range(count))
    items: list[tuple[int, int]] = [(kind, size) for kind, size, _ in unpacked]
    layered = header.point_format >= 6
    expected = [(item, ITEM_SIZES[item]) for item in ITEMS[header.point_format]]
    if header.extra_bytes:
        check_unpacked_size(path, "extra bytes", header.extra_bytes * _PER_EXTRA_BYTE)
        expected.append((_EXTRA_LAYERS if layered else _EXTRA_BYTES, header.extra_bytes))
    if items != expected:
        raise ValueError(
            f"{location}: items {items}; point format {header.point_format} with {header.point_size} bytes "
            f"has {expected}"
        )
    if compressor != (_LAYERED if layered else _CHUNKED) or chunk_size == 0:
        raise ValueError(
            f"{location}: compressor {compressor} with {chunk_size} points per chunk; read are compressors "
            f"{_CHUNKED} up to point format 5 and {_LAYERED} beyond"
        )
    return _Packing(layered, chunk_size, sum(_LAYERS.get(kind, size) for kind, size in items))


def _read_chunk_table(path: Path, file: BinaryIO, header: LasHeader) -> tuple[int, int, int]:
    """Return the offsets of the first chunk and of the chunk table, and the number of chunks in it."""
    size, first = path.stat().st_size, header.start + 8
    if first > size:
        raise ValueError(f"{path}: chunk table: the file ends before it")
    file.seek(header.start)
    table = int.from_bytes(file.read(8), "little", signed=True)
    if table <= header.start:
        # A writer that cannot seek puts the offset of the table at the end of the file.
        file.seek(size - 8)
        table = int.from_bytes(file.read(8), "little", signed=True)
    if not first < table <= size - _TABLE_HEADER.size:
        raise ValueError(f"{path}: chunk table: {table} is no place after {first} in a file of {size} bytes")
    file.seek(table)
    _, chunks = _TABLE_HEADER.unpack(file.read(_TABLE_HEADER.size))
    if file.read(4) == _IMPOSSIBLE_START:
        raise ValueError(f"{path}: chunk table: its entries are damaged")
    # A chunk begins with a point that is not compressed. The last chunk may be empty.
    if not 0 < chunks <= 1 + (table - first) // header.point_size:
        raise ValueError(f"{path}: chunk table: {chunks} chunks in {table - first} bytes")
    return first, table, chunks


def _chunk_sizes(
    path: Path, header: LasHeader, packing: _Packing, entries: list[tuple[int, int]], total_size: int
) -> list[int]:
    """Return the bytes of each chunk, which add up to `total_size`; their points are those of the header."""
    points, sizes = map(list, zip(*entries))
    if packing.chunk_size != _VARIABLE:
        # All chunks but the last one are full.
        full = (min(i * packing.chunk_size, header.points) for i in range(len(sizes) + 1))
        points = [high - low for low, high in itertools.pairwise(full)]
    for unit, counts, total in (("points", points, header.points), ("bytes", sizes, total_size)):
        if sum(counts) != total or min(counts) < 0:
            raise ValueError(f"{path}: chunk table: its {len(counts)} chunks do not add up to {total} {unit}")
    if any((n > 0) != (size > 0) for n, size in zip(points, sizes)):
        raise ValueError(f"{path}: chunk table: a chunk without points or without bytes")
    return sizes


def _check_layers(
    path: Path,
    file: BinaryIO,
    header: LasHeader,
    is_used: Bool[np.ndarray, " layers"],
    sizes: list[int],
    offset: int,
) -> None:
    """Refuse chunks whose layers do not fit, or whose layers that are used cannot be decoded."""
    # A chunk begins with one point that is not compressed and the number of points. The sizes of the layers
    # follow.
    count, lead = len(is_used), header.point_size + 4
    for i, size in enumerate(sizes):
        if size == 0:
            continue
        file.seek(offset + lead)
        layers = np.frombuffer(file.read(4 * count), "<u4").astype(np.int64)
        if lead + 4 * count + layers.sum() > size:
            raise ValueError(f"{path}: chunk {i}: its layers do not fit into its {size} bytes")
        starts = offset + lead + 4 * count + np.cumsum(layers) - layers
        for layer in np.flatnonzero(is_used & (layers > 0)):
            file.seek(starts[layer])
            if file.read(4) == _IMPOSSIBLE_START:
                raise ValueError(f"{path}: chunk {i}: layer {layer} is damaged")
        file.seek(starts[_TIMES_LAYER])
        if _ENDLESS_TIMES in file.read(int(layers[_TIMES_LAYER])):
            raise ValueError(f"{path}: chunk {i}: its GPS times are damaged: bytes of 255 in a row")
        offset += size


def _check_streams(path: Path, file: BinaryIO, header: LasHeader, sizes: list[int], offset: int) -> None:
    """Refuse chunks whose stream cannot be decoded."""
    for i, size in enumerate(sizes):
        file.seek(offset)
        # A chunk begins with one point that is not compressed.
        stream = file.read(size)[header.point_size :]
        if stream.startswith(_IMPOSSIBLE_START) or _ENDLESS_TIMES in stream:
            raise ValueError(f"{path}: chunk {i}: the stream is damaged: bytes of 255 in a row")
        offset += size
