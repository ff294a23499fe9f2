"""Decompression of the points of LAZ files.

lazrs allocates what a file declares, and ends the process where that fails. So what a file declares is
checked first: the record of the compression, the chunk table, and, from point format 6 on, the layers of each
chunk, which hold one field each. All of them must fit into the file.

Two kinds of damaged bytes also end the process, and are looked for:

- An arithmetic-coded stream never begins with four bytes of 255. Of one that does, lazrs looks up symbols
  that do not exist.
- Up to point format 5, lazrs calls itself at each change between sequences of GPS times. Many bytes of 255 in
  a row decode to so many changes that the stack overflows.
"""

import itertools
import struct
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from jaxlidar.io.checks import check_unpacked
from jaxlidar.io.las_header import PART_SIZES, PARTS, LasHeader

# The record that says how points are compressed: compressor, points per chunk and number of items; each item
# is a kind, a size and a version.
_LASZIP, _ITEM = struct.Struct("<H10xI16xH"), struct.Struct("<3H")
_CHUNKED, _LAYERED = 2, 3
_VARIABLE = 2**32 - 1
# How many layers each part of a record is stored in. Extra bytes have a layer each.
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
_EXTRA_BYTES, _EXTRA_LAYERS = 0, 14
# Bytes that lazrs takes for the statistics of each extra byte.
_PER_EXTRA_BYTE = 10_000
# The layers that hold what a `PointCloud` does: they come first.
_USED_LAYERS = 5
_TABLE = struct.Struct("<2I")
_NO_STREAM, _NO_TIMES = b"\xff" * 4, b"\xff" * 8


class _Packing(NamedTuple):
    """Whether each field has a layer of its own, the points of a chunk, and the number of layers."""

    layered: bool
    chunk_size: int
    layers: int


def unpack(path: Path, file: BinaryIO, header: LasHeader) -> bytearray:
    """The records of all points, as in a LAS file.

    **Raises:** ImportError without lazrs. ValueError, naming the file and the place, where they are damaged.
    """
    lazrs = _lazrs()
    packing = _packing(path, header)
    first, table, chunks = _table_of(path, file, header)
    file.seek(header.start)
    try:
        entries = lazrs.read_chunk_table(file, lazrs.LazVlr(header.laszip))
    except (RuntimeError, OSError) as error:
        raise ValueError(f"{path}: chunk table: damaged ({error})") from error
    sizes = _chunk_sizes(path, header, packing, entries, table - first)
    if packing.layered:
        _check_layers(path, file, header, packing.layers, sizes, first)
    else:
        _check_streams(path, file, header, sizes, first)
    points = bytearray(header.points * header.point_size)
    # Threads share chunks. For one chunk they are of no use, and would allocate its declared size.
    decompressor = lazrs.ParLasZipDecompressor if chunks > 1 else lazrs.LasZipDecompressor
    file.seek(header.start)
    try:
        decompressor(file, header.laszip, _selection(lazrs)).decompress_many(points)
    except (RuntimeError, OSError) as error:
        raise ValueError(f"{path}: chunks: damaged ({error})") from error
    return points


def _lazrs() -> Any:
    try:
        import lazrs  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError('reading LAZ needs lazrs: pip install "jaxlidar[io]"') from error
    return lazrs


def _selection(lazrs: Any) -> Any:
    """The fields that a `PointCloud` holds."""
    names = ("XY_RETURNS_CHANNEL", "Z", "CLASSIFICATION", "FLAGS", "INTENSITY")
    return lazrs.DecompressionSelection(sum(getattr(lazrs, f"SELECTIVE_DECOMPRESS_{n}") for n in names))


def _packing(path: Path, header: LasHeader) -> _Packing:
    record = header.laszip or b""
    place = f"{path}: record of the compression"
    if len(record) < _LASZIP.size:
        raise ValueError(f"{place}: {len(record)} bytes")
    compressor, chunk_size, count = _LASZIP.unpack_from(record)
    if len(record) < _LASZIP.size + count * _ITEM.size:
        raise ValueError(f"{place}: {len(record)} bytes cannot name {count} items")
    named = (_ITEM.unpack_from(record, _LASZIP.size + i * _ITEM.size) for i in range(count))
    items: list[tuple[int, int]] = [(kind, size) for kind, size, _ in named]
    layered = header.point_format >= 6
    expected = [(part, PART_SIZES[part]) for part in PARTS[header.point_format]]
    if header.extra_bytes:
        check_unpacked(path, "extra bytes", header.extra_bytes * _PER_EXTRA_BYTE)
        expected.append((_EXTRA_LAYERS if layered else _EXTRA_BYTES, header.extra_bytes))
    if items != expected:
        raise ValueError(
            f"{place}: items {items}; point format {header.point_format} with {header.point_size} bytes has "
            f"{expected}"
        )
    if compressor != (_LAYERED if layered else _CHUNKED) or chunk_size == 0:
        raise ValueError(
            f"{place}: compressor {compressor} with {chunk_size} points per chunk; read are compressors "
            f"{_CHUNKED} up to point format 5 and {_LAYERED} beyond"
        )
    return _Packing(layered, chunk_size, sum(_LAYERS.get(kind, size) for kind, size in items))


def _table_of(path: Path, file: BinaryIO, header: LasHeader) -> tuple[int, int, int]:
    """Where the first chunk begins and the chunk table does, and how many chunks it names."""
    size, first = path.stat().st_size, header.start + 8
    if first > size:
        raise ValueError(f"{path}: chunk table: the file ends before it")
    file.seek(header.start)
    table = int.from_bytes(file.read(8), "little", signed=True)
    if table <= header.start:
        # A writer that cannot go back puts the place of the table at the end of the file.
        file.seek(size - 8)
        table = int.from_bytes(file.read(8), "little", signed=True)
    if not first < table <= size - _TABLE.size:
        raise ValueError(f"{path}: chunk table: {table} is no place after {first} in a file of {size} bytes")
    file.seek(table)
    _, chunks = _TABLE.unpack(file.read(_TABLE.size))
    if file.read(4) == _NO_STREAM:
        raise ValueError(f"{path}: chunk table: its entries are damaged")
    # A chunk begins with a point that is not compressed. The last chunk may be empty.
    if not 0 < chunks <= 1 + (table - first) // header.point_size:
        raise ValueError(f"{path}: chunk table: {chunks} chunks in {table - first} bytes")
    return first, table, chunks


def _chunk_sizes(
    path: Path, header: LasHeader, packing: _Packing, entries: list[tuple[int, int]], held: int
) -> list[int]:
    """Bytes of each chunk: together they are what is held, and their points those of the header."""
    points, sizes = map(list, zip(*entries))
    if packing.chunk_size != _VARIABLE:
        # All chunks but the last one are full.
        full = (min(i * packing.chunk_size, header.points) for i in range(len(sizes) + 1))
        points = [high - low for low, high in itertools.pairwise(full)]
    for what, counts, total in (("points", points, header.points), ("bytes", sizes, held)):
        if sum(counts) != total or min(counts) < 0:
            raise ValueError(f"{path}: chunk table: its {len(counts)} chunks do not add up to {total} {what}")
    if any((n > 0) != (size > 0) for n, size in zip(points, sizes)):
        raise ValueError(f"{path}: chunk table: a chunk without points or without bytes")
    return sizes


def _check_layers(
    path: Path, file: BinaryIO, header: LasHeader, count: int, sizes: list[int], at: int
) -> None:
    """Refuse chunks whose layers do not fit, or whose used layers cannot be decoded."""
    # A chunk begins with one point as it is and the number of points. Then come the sizes of the layers.
    lead = header.point_size + 4
    for i, size in enumerate(sizes):
        if size == 0:
            continue
        file.seek(at + lead)
        layers = np.frombuffer(file.read(4 * count), "<u4").astype(np.int64)
        if lead + 4 * count + layers.sum() > size:
            raise ValueError(f"{path}: chunk {i}: its layers do not fit into its {size} bytes")
        begin = at + lead + 4 * count + np.cumsum(layers) - layers
        for layer in np.flatnonzero(layers[:_USED_LAYERS]):
            file.seek(begin[layer])
            if file.read(4) == _NO_STREAM:
                raise ValueError(f"{path}: chunk {i}: layer {layer} is damaged")
        at += size


def _check_streams(path: Path, file: BinaryIO, header: LasHeader, sizes: list[int], at: int) -> None:
    """Refuse chunks whose stream cannot be decoded."""
    # A chunk begins with one point as it is.
    for i, size in enumerate(sizes):
        file.seek(at)
        stream = file.read(size)[header.point_size :]
        if stream.startswith(_NO_STREAM) or _NO_TIMES in stream:
            raise ValueError(f"{path}: chunk {i}: the stream is damaged: bytes of 255 in a row")
        at += size
