"""The header of PulseWaves files: sizes, scales, scanners, and how the waves of pulses are stored."""

import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from jaxlidar.io.airborne import Scanner
from jaxlidar.io.coordinates import GEO_KEYS, is_geographic
from jaxlidar.io.variable_records import variable_records

# Signature, version, sizes, counts of records, then scale and offset of times, and of coordinates.
_HEADER = struct.Struct("<16s156x2BHqqIIII8xIi")
_TIMES, _PLACES = struct.Struct("<2d16x"), struct.Struct("<6d48x")
_HEADER_SIZE = _HEADER.size + _TIMES.size + _PLACES.size
PULSES, WAVES = b"PulseWavesPulse\0", b"PulseWavesWaves\0"
# Head of a variable length record, or foot of an appended one: user, number, length.
_RECORD = struct.Struct("<16sI4xq64x")
_OURS, _PROJECTION, _END = b"PulseWaves_Spec", b"PulseWaves_Proj", 2**32 - 1
_SCANNERS, _DESCRIPTORS, _TABLES = (range(first, first + 256) for first in (100_000, 200_000, 300_000))
_SCANNER = struct.Struct("<8x64s64s2f28xf")
# Of a descriptor: its own size, the origin, bytes before waves, samplings, unit, compression, scanner. (The
# specification names the last two the other way round; in recorded files they lie so.)
_COMPOSITION = struct.Struct("<I4xIHHfII")
# Of a sampling: size, kind, channel, then how durations, segments and samples are stored.
_SAMPLING = struct.Struct("<I4xBBxBffBBHIHHfI")
_TABLE_HEAD, _TABLE = struct.Struct("<I4xI64x"), struct.Struct("<I4xIHBBI64x")
# The origin's place before the anchor, where it is not the same for all pulses.
_NO_ORIGIN = 0x8FFFFFFF
_OUTGOING, _RETURNING = 1, 2
# Units that times and coordinates may be counted in.
_SCALES = (1e-12, 1e3)
# Most entries of a table of amplitudes: as many as there are counts of 16 bits.
_MOST_ENTRIES = 65536


class Sampling(NamedTuple):
    """How one sampling of a pulse is stored: numbers of bits, or the fixed numbers where bits are 0."""

    outgoing: bool
    channel: int
    duration_bits: int
    scale: float
    offset: float
    segment_bits: int
    sample_bits: int
    segments: int
    samples: int
    bits: int
    table: int
    step: float


class Descriptor(NamedTuple):
    """How the waves of a pulse are stored.

    - `has_origin`: whether outgoing segments are timed from where the pulse's time zero is.
    - `extra`: bytes before the waves.
    - `unit`: of durations, ns.
    - `scanner`: number of the scanner, 0 for none.
    """

    has_origin: bool
    extra: int
    unit: float
    scanner: int
    samplings: tuple[Sampling, ...]


class PulsesHeader(NamedTuple):
    """What a file says of its pulses; `scale` and `offset` are of x, y and z."""

    start: int
    count: int
    pulse_size: int
    time_scale: float
    time_offset: float
    scale: np.ndarray
    offset: np.ndarray
    geographic: bool
    scanners: dict[int, Scanner]
    descriptors: dict[int, Descriptor]
    tables: dict[int, np.ndarray]


def read_pulses_header(path: Path, file: BinaryIO, least_pulse: int) -> PulsesHeader:
    """The header of a file, whose pulses then fit into it.

    **Raises:** ValueError, naming the file and the place, for a header or a record that makes no sense.
    """
    size, place = path.stat().st_size, f"{path}: header"
    block = file.read(_HEADER_SIZE)
    if not block.startswith(PULSES):
        raise ValueError(f"{place}: no file of pulses: it does not begin with PulseWavesPulse")
    if len(block) < _HEADER_SIZE:
        raise ValueError(f"{place}: the file ends after {size} bytes")
    _, major, minor, own, start, count, kind, _, pulse_size, compression, records, appended = (
        _HEADER.unpack_from(block)
    )
    if major > 1:
        raise ValueError(f"{place}: version {major}.{minor} is none of PulseWaves 0 and 1")
    if kind != 0 or compression != 0:
        raise ValueError(f"{place}: pulse format {kind}, compression {compression}; read is 0 of both")
    if not _HEADER_SIZE <= own <= start <= size:
        raise ValueError(
            f"{place}: it is {own} bytes long and pulses begin at {start}: a file of {size} bytes admits "
            f"{_HEADER_SIZE} or more, in this order"
        )
    if count <= 0:
        raise ValueError(f"{place}: the file holds {count} pulses")
    if pulse_size < least_pulse:
        raise ValueError(f"{place}: pulses of {pulse_size} bytes; they have {least_pulse} or more")
    if start + count * pulse_size > size:
        raise ValueError(
            f"{path}: pulse {(size - start) // pulse_size}: the file ends, but its header names {count} "
            "pulses"
        )
    times = _TIMES.unpack_from(block, _HEADER.size)
    places = np.array(_PLACES.unpack_from(block, _HEADER.size + _TIMES.size))
    scales, offsets = (times[0], *places[:3]), (times[1], *places[3:])
    for axis, scale, offset in zip("txyz", scales, offsets):
        if not _SCALES[0] <= scale <= _SCALES[1]:
            raise ValueError(f"{place}: scale of {axis} = {scale:g} is outside the range {_SCALES}")
        if not math.isfinite(offset):
            raise ValueError(f"{place}: offset of {axis} = {offset:g} is not finite")
    found = dict(_contents(path, file, own, start, records))
    if appended:
        found |= _appended(path, file, start + count * pulse_size, size)
    geographic = is_geographic(found.get((_PROJECTION, GEO_KEYS), b""))
    ours = {number: content for (user, number), content in found.items() if user == _OURS}

    def those(numbers: range, read) -> dict:
        at = f"{path}: record"
        return {n - numbers.start: read(f"{at} {n}", ours[n]) for n in sorted(ours) if n in numbers}

    return PulsesHeader(
        start=start,
        count=count,
        pulse_size=pulse_size,
        time_scale=times[0],
        time_offset=times[1],
        scale=places[:3],
        offset=places[3:],
        geographic=geographic,
        scanners=those(_SCANNERS, _scanner),
        descriptors=those(_DESCRIPTORS, _descriptor),
        tables=those(_TABLES, _table),
    )


def _contents(
    path: Path, file: BinaryIO, at: int, end: int, count: int
) -> Iterator[tuple[tuple[bytes, int], bytes]]:
    """Contents of the variable length records between two places, by user and number."""
    for user, number, place, length in variable_records(path, file, _RECORD, at, end, count, "pulses"):
        file.seek(place)
        yield (user, number), file.read(length)


def _appended(path: Path, file: BinaryIO, start: int, at: int) -> dict[tuple[bytes, int], bytes]:
    """Contents of the records after the pulses, which are read from the end of the file."""
    found = {}
    while True:
        if at - _RECORD.size < start:
            raise ValueError(f"{path}: appended records: there is no first one after the pulses")
        file.seek(at - _RECORD.size)
        user, number, length = _RECORD.unpack(file.read(_RECORD.size))
        if (user.rstrip(b"\0"), number) == (_OURS, _END):
            return found
        at -= _RECORD.size + length
        if length < 0 or at < start:
            raise ValueError(
                f"{path}: appended record {number}: its {length} bytes run into the pulses, up to {start}"
            )
        file.seek(at)
        found[user.rstrip(b"\0"), number] = file.read(length)


def _scanner(place: str, record: bytes) -> Scanner:
    if len(record) < _SCANNER.size:
        raise ValueError(f"{place}: {len(record)} bytes hold no scanner")
    *names, wavelength, width, divergence = _SCANNER.unpack_from(record)
    instrument, serial = (name.split(b"\0")[0].decode("ascii", "replace") for name in names)
    numbers = (x if math.isfinite(x) and x > 0 else None for x in (wavelength, width, divergence))
    return Scanner(instrument, serial, *numbers)


def _descriptor(place: str, record: bytes) -> Descriptor:
    if len(record) < _COMPOSITION.size:
        raise ValueError(f"{place}: {len(record)} bytes hold no descriptor of pulses")
    at, origin, extra, count, unit, compression, scanner = _COMPOSITION.unpack_from(record)
    if compression:
        raise ValueError(f"{place}: waves are compressed ({compression}); read are those that are not")
    if not (math.isfinite(unit) and unit > 0 and count > 0 and at >= _COMPOSITION.size):
        raise ValueError(f"{place}: {count} samplings from byte {at} on, in units of {unit:g} ns")
    samplings = []
    for i in range(count):
        if at + _SAMPLING.size > len(record):
            raise ValueError(f"{place}: {count} samplings, but there is room for {i}")
        size, *content = _SAMPLING.unpack_from(record, at)
        if size < _SAMPLING.size:
            raise ValueError(f"{place}: sampling {i}: {size} bytes; it has {_SAMPLING.size} or more")
        samplings.append(_sampling(f"{place}: sampling {i}", *content))
        at += size
    return Descriptor(origin != _NO_ORIGIN, extra, unit, scanner, tuple(samplings))


def _sampling(place: str, kind: int, channel: int, *rest) -> Sampling:
    sampling = Sampling(kind == _OUTGOING, channel, *rest[:-1])
    if rest[-1]:
        raise ValueError(f"{place}: samples are compressed ({rest[-1]}); read are those that are not")
    if kind not in (_OUTGOING, _RETURNING):
        raise ValueError(
            f"{place}: type {kind} is neither outgoing ({_OUTGOING}) nor returning ({_RETURNING})"
        )
    admissible = {
        **{"duration_bits": (0, 16, 32), "segment_bits": (0, 8, 16), "sample_bits": (0, 8, 16)},
        "bits": (8, 16, 32),
    }
    for field, values in admissible.items():
        if getattr(sampling, field) not in values:
            raise ValueError(f"{place}: {field} = {getattr(sampling, field)} is none of {values}")
    if sampling.segment_bits == 0 and not sampling.segments:
        raise ValueError(f"{place}: it has 0 segments")
    if sampling.sample_bits == 0 and not sampling.samples:
        raise ValueError(f"{place}: its segments have 0 samples")
    for field in ("scale", "step"):
        value = getattr(sampling, field)
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{place}: {field} = {value:g} is outside the range (0, inf)")
    if not math.isfinite(sampling.offset):
        raise ValueError(f"{place}: offset = {sampling.offset:g} is not finite")
    return sampling


def _table(place: str, record: bytes) -> np.ndarray:
    """The first table of amplitudes of a record."""
    if len(record) < _TABLE_HEAD.size + _TABLE.size:
        raise ValueError(f"{place}: {len(record)} bytes hold no table")
    at, _ = _TABLE_HEAD.unpack_from(record)
    if not _TABLE_HEAD.size <= at <= len(record) - _TABLE.size:
        raise ValueError(f"{place}: its table at byte {at} does not fit into {len(record)} bytes")
    size, entries, *_ = _TABLE.unpack_from(record, at)
    at += size
    if not (size >= _TABLE.size and entries <= _MOST_ENTRIES and at + 4 * entries <= len(record)):
        raise ValueError(f"{place}: {entries} entries from byte {at} on do not fit into {len(record)} bytes")
    return np.frombuffer(record, "<f4", entries, at).astype(np.float64)
