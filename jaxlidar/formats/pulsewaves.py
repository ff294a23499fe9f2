"""Reader of airborne waveforms: PulseWaves files, as LVIS and RIEGL data are published in.

A .pls file holds the pulses, a .wvs file beside it their samples. The following was found from recorded
files, and `read_pulsewaves` relies on it; the specification does not say it.

- RIEGL Q680i: outgoing segments are timed from their own largest sample (to 0.003 ns), returning ones from
  the anchor; so a target lies at anchor + t direction where its echo has the outgoing pulse's largest sample
  at t. The same shots as LAS put their discrete returns there to 5 mm, which is the rounding of directions.
  Counts are not proportional to the light received: tables give their amplitudes (`AirborneShots.tables`,
  `Segment.table`). Where the channel of low power is near its largest count, that of high power recorded a
  second segment 1.44 ns later (`AirborneShot.of_channel`).
- LVIS: the anchor is the first returning sample, and nothing tells when the pulse left: its time zero is
  taken at its largest sample. Two digitisers recorded odd and even samples, with pedestals of their own.
  About a third of the returns saturate near 225 counts. Coordinates are degrees and m; east is 0 to 360.
- RIEGL Q560: pulses without a return have a descriptor without a returning sampling, or no segment in all
  returning ones, and 0 as their first and last returning sample.
- Samples are returned as they are stored: pedestals, tables and saturation are left to the user.

Source: PulseWaves specification 0.3 (rapidlasso).
"""

import contextlib
import math
import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeVar, final

import numpy as np
from jaxtyping import Bool

from jaxlidar._fields.checks import warn_user
from jaxlidar._fields.crs import CoordinateSystem, system_of_name
from jaxlidar.formats.airborne import AirborneShots, Scanner, Segment, evenly_spaced
from jaxlidar.formats.checks import MAX_COORDINATE, FileWarning, existing_file
from jaxlidar.formats.coordinates import (
    GEOGRAPHIC_3D,
    check_elevations,
    declared_system,
    find_units,
    geographic_lines,
)
from jaxlidar.formats.las_header import check_scales, variable_records

# The header: signature, version, sizes, counts of records; then scale and offset of times, and those of
# coordinates.
_HEADER = struct.Struct("<16s156x2BHqqIIII8xIi")
_TIME_SCALE, _COORDINATE_SCALES = struct.Struct("<2d16x"), struct.Struct("<6d48x")
_HEADER_SIZE = _HEADER.size + _TIME_SCALE.size + _COORDINATE_SCALES.size
_PULSES_SIGNATURE, _WAVES_SIGNATURE = b"PulseWavesPulse\0", b"PulseWavesWaves\0"
_WAVES_HEADER_SIZE = 60
# Header of a variable length record, or footer of an appended one: user, number, length.
_RECORD = struct.Struct("<16sI4xq64x")
_SPECIFICATION_USER, _PROJECTION_USER = b"PulseWaves_Spec", b"PulseWaves_Proj"
# The number of the record that ends the appended ones, which are read backwards.
_END_NUMBER = 2**32 - 1
# Numbers of the records of scanners, of descriptors of pulses, and of tables of amplitudes.
_SCANNERS, _DESCRIPTORS, _TABLES = (range(first, first + 256) for first in (100_000, 200_000, 300_000))
_SCANNER = struct.Struct("<8x64s64s2f28xf")
# A descriptor: its own size, the origin, bytes before waves, samplings, unit, compression, scanner. The
# specification has the last two in the opposite order; in recorded files they lie so.
_DESCRIPTOR = struct.Struct("<I4xIHHfII")
# A sampling: size, type, channel, then the storage of durations, segments and samples.
_SAMPLING = struct.Struct("<I4xBBxBffBBHIHHfI")
_TABLE_HEADER, _TABLE = struct.Struct("<I4xI64x"), struct.Struct("<I4xIHBBI64x")
# The offset of the optical centre from the anchor, where it is not the same for all pulses.
_NO_ORIGIN = 0x8FFFFFFF
_OUTGOING, _RETURNING = 1, 2
# Admissible units in which times and coordinates are counted.
_SCALES = (1e-12, 1e3)
# Most entries of a table of amplitudes: as many as there are counts of 16 bits.
_MAX_ENTRIES = 65536
# Fields of a pulse record. Further bytes may follow.
_PULSE_FIELDS = (
    *(("time", "<i8"), ("waves", "<i8"), ("anchor", "<i4", 3), ("target", "<i4", 3), ("first", "<i2")),
    *(("last", "<i2"), ("descriptor", "u1"), ("scan", "u1"), ("intensity", "u1"), ("class", "u1")),
)
_PULSE_SIZE = np.dtype(list(_PULSE_FIELDS)).itemsize
# Units of time from an anchor to its target.
_TARGET_TIME = 1000.0

_Content = TypeVar("_Content")


def read_pulsewaves(path: str | os.PathLike[str]) -> AirborneShots:
    """Open the shots of a PulseWaves file.

    Both files are mapped: a shot is read when it is indexed. Coordinates may be metres, feet or degrees;
    geocentric ones become longitude, latitude and height above the ellipsoid of WGS-84. Files that declare
    their coordinate reference system need pyproj, or rasterio (`pip install "jaxlidar[io]"`).

    **Arguments:**

    - `path`: the .pls file; the .wvs file lies beside it, under the same name.

    **Returns:** an `AirborneShots` of the pulses that have a return; `AirborneShot.index` is the number of
    the pulse in the file, from 0. Its `dropped` counts the pulses "without a return". Segments have the
    counts as stored.

    **Warns:** `FileWarning` where pulses have no return, with their number.

    **Raises:** FileNotFoundError where there is no such file, or no .wvs file. ValueError, naming the file
    and the place, for one that is no PulseWaves file, is damaged, compressed, without pulses, or declares
    more than it can hold; when a shot is read, for waves that lie outside of the .wvs file, an unknown
    descriptor, a segment without samples, and a direction that does not have the length that light goes; and
    for a coordinate reference system that is not known. ImportError without pyproj where one is declared, or
    without rasterio where that is by GeoTIFF keys.

    **Source:** PulseWaves specification 0.3 (rapidlasso).

    **Example:**

    >>> import jaxlidar as jl
    >>> import jaxlidar.io
    >>> shot = jaxlidar.io.read_pulsewaves("flight.pls")[0]  # doctest: +SKIP
    >>> pulse = jl.SampledPulse(time=shot.pulse_time, power=shot.pulse_power)  # doctest: +SKIP
    >>> lidar = jl.Lidar(pulse=pulse, zenith=shot.zenith, azimuth=shot.azimuth)  # doctest: +SKIP
    """
    return _PulseWavesShots(existing_file(path))


class PulseSampling(NamedTuple):
    """Storage of one sampling of a pulse: numbers of bits, and the fixed numbers that apply where bits are 0.

    - `outgoing`: True for the outgoing pulse, False for the return. `channel`: its number.
    - `duration_bits`: of the duration from the anchor to a segment; `scale` and `offset` convert it to units
      of time.
    - `segment_bits`, `segments`: of the number of segments. `sample_bits`, `samples`: of that of samples.
    - `bits`: of a sample. `table`: number of the table of amplitudes, 0 for none. `step`: ns between samples.
    """

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


class PulseDescriptor(NamedTuple):
    """Storage of the waves of a pulse.

    - `has_origin`: True if outgoing segments are timed from the pulse's time zero.
    - `extra`: bytes before the waves.
    - `unit`: of durations, ns.
    - `scanner`: number of the scanner, 0 for none.
    """

    has_origin: bool
    extra: int
    unit: float
    scanner: int
    samplings: tuple[PulseSampling, ...]


class PulsesHeader(NamedTuple):
    """The header of a file of pulses, and its records by number; `scale` and `offset` are of x, y and z."""

    start: int
    count: int
    pulse_size: int
    time_scale: float
    time_offset: float
    scale: np.ndarray
    offset: np.ndarray
    system: CoordinateSystem
    scanners: dict[int, Scanner]
    descriptors: dict[int, PulseDescriptor]
    tables: dict[int, np.ndarray]


# -- shots -------------------------------------------------------------------------------------------------


@final
class _PulseWavesShots(AirborneShots):
    def __init__(self, path: Path):
        self.path = path
        with path.open("rb") as file:
            header = self.header = _read_header(path, file)
        self.tables, self.scanners = header.tables, header.scanners
        # By descriptor, as the field of a pulse has one byte.
        self.time_units = np.full(256, np.nan)
        self.time_units[list(header.descriptors)] = [d.unit for d in header.descriptors.values()]
        dtype = np.dtype([*_PULSE_FIELDS, ("further", f"V{header.pulse_size - _PULSE_SIZE}")])
        self.pulses: Any = np.memmap(path, dtype, "r", header.start, (header.count,))
        wave_path = existing_file(path.with_suffix(".WVS" if path.suffix.isupper() else ".wvs"))
        with wave_path.open("rb") as file:
            head = file.read(_WAVES_HEADER_SIZE)
        if len(head) < _WAVES_HEADER_SIZE or not head.startswith(_WAVES_SIGNATURE):
            raise ValueError(f"{wave_path}: header: no file of waves: it does not begin with PulseWavesWaves")
        compression = int.from_bytes(head[16:20], "little")
        if compression:
            raise ValueError(f"{wave_path}: header: waves are compressed ({compression}): they are not read")
        self.waves, self.wave_path = np.memmap(wave_path, np.uint8, "r"), wave_path
        has_return = self._has_return()
        self.pulse_numbers = np.flatnonzero(has_return)
        self.dropped = {"without a return": int(np.sum(~has_return))}
        if self.pulse_numbers.size == 0:
            raise ValueError(f"{path}: pulse 0: neither this pulse nor another has a returning segment")
        if self.dropped["without a return"]:
            warn_user(
                f"{path}: pulse {int(np.argmin(has_return))}: it has no returning segment: "
                f"{self.dropped['without a return']} of {header.count} pulses skipped",
                FileWarning,
            )
        rows = self.pulse_numbers[evenly_spaced(len(self))]
        # Geocentric lines become geographic ones.
        is_geocentric = header.system.kind == "geocentric"
        self.system = system_of_name("coordinates", GEOGRAPHIC_3D) if is_geocentric else header.system
        anchor, direction = self._lines(rows)
        first_return = anchor + self._first_time(rows)[:, None] * direction
        self.units = find_units(f"{path}: pulses", self.system, first_return, direction)

    def __len__(self) -> int:
        return self.pulse_numbers.size

    def _has_return(self) -> Bool[np.ndarray, " pulses"]:
        """Return True for pulses that have a return, and for damaged ones, which are refused when read."""
        has_return = np.ones(self.header.count, bool)
        for number, descriptor in self.header.descriptors.items():
            returning = [sampling for sampling in descriptor.samplings if not sampling.outgoing]
            if any(sampling.segment_bits == 0 for sampling in returning):
                continue
            has_descriptor = self.pulses["descriptor"] == number
            if not returning:
                has_return[has_descriptor] = False
                continue
            # The waves say how many segments there are: they are read where the pulse itself names no sample.
            is_unclear = has_descriptor & (self.pulses["first"] == self.pulses["last"])
            for index in np.flatnonzero(is_unclear).tolist():
                with contextlib.suppress(ValueError):
                    has_return[index] = bool(self._segments(index, descriptor)[1])
        return has_return

    def _lines(self, rows: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the anchors and the directions per ns of pulses."""
        pulses, header = self.pulses[rows], self.header
        counts = pulses["target"].astype(float) - pulses["anchor"]
        time_unit = self.time_units[pulses["descriptor"]]
        anchor = pulses["anchor"] * header.scale + header.offset
        direction = counts * header.scale / (_TARGET_TIME * time_unit[:, None])
        if header.system.kind != "geocentric":
            return anchor, direction
        location = f"{self.path}: pulses"
        return geographic_lines(location, header.system, anchor, direction, self._first_time(rows))

    def _first_time(self, rows: Any) -> np.ndarray:
        """Return the times of the first returning samples of pulses, ns, to the whole unit of time."""
        return self.pulses["first"][rows] * self.time_units[self.pulses["descriptor"][rows]]

    @property
    def gps_time(self) -> np.ndarray:
        return self.pulses["time"][self.pulse_numbers] * self.header.time_scale + self.header.time_offset

    @property
    def anchor(self) -> np.ndarray:
        return self._lines(self.pulse_numbers)[0]

    @property
    def direction(self) -> np.ndarray:
        return self._lines(self.pulse_numbers)[1]

    def _read(self, index: int) -> dict[str, Any]:
        index = int(self.pulse_numbers[index])
        pulse, rows = self.pulses[index], slice(index, index + 1)
        descriptor = self._descriptor(index)
        outgoing, returning = self._segments(index, descriptor)
        if not returning:
            raise ValueError(f"{self.path}: pulse {index}: it has no returning segment")
        anchor, direction = (array[0] for array in self._lines(rows))
        if np.abs(anchor).max() > MAX_COORDINATE:
            raise ValueError(
                f"{self.path}: pulse {index}: its anchor {anchor.tolist()} lies beyond {MAX_COORDINATE:g}"
            )
        first_return = (anchor + returning[0].start * direction)[2] * self.units.vertical
        check_elevations(f"{self.path}: pulse {index}: its first return", first_return)
        if self.units.has_wrong_length(anchor, direction):
            raise ValueError(
                f"{self.path}: pulse {index}: the way of light in 1 ns cannot be {direction.tolist()}"
            )
        return {
            "index": index,
            "outgoing": outgoing,
            "returning": returning,
            "anchor": anchor,
            "direction": direction,
            "pulse_zero": 0.0 if descriptor.has_origin else None,
            "metres": self.units.metres(anchor),
            "gps_time": float(pulse["time"] * self.header.time_scale + self.header.time_offset),
            "scanner": self.scanners.get(descriptor.scanner or min(self.scanners, default=0)),
            "crs": self.system.text,
        }

    def _descriptor(self, index: int) -> PulseDescriptor:
        number = int(self.pulses["descriptor"][index])
        if number not in self.header.descriptors:
            numbers = sorted(self.header.descriptors)
            raise ValueError(f"{self.path}: pulse {index}: descriptor {number} is none of {numbers}")
        return self.header.descriptors[number]

    def _segments(
        self, index: int, descriptor: PulseDescriptor
    ) -> tuple[tuple[Segment, ...], tuple[Segment, ...]]:
        """Return the outgoing and the returning segments of a pulse."""
        offset = int(self.pulses["waves"][index])
        location = f"{self.path}: pulse {index}: its waves at byte {offset} of {self.wave_path.name}"
        reader = _WaveReader(self.waves, offset, location)
        reader.take(descriptor.extra)
        outgoing: list[Segment] = []
        returning: list[Segment] = []
        for sampling in descriptor.samplings:
            count = reader.integer(sampling.segment_bits) if sampling.segment_bits else sampling.segments
            for _ in range(count):
                segment = self._segment(reader, sampling, descriptor.unit)
                (outgoing if sampling.outgoing else returning).append(segment)
        return tuple(outgoing), tuple(returning)

    @staticmethod
    def _segment(reader: "_WaveReader", sampling: PulseSampling, unit: float) -> Segment:
        duration = reader.integer(sampling.duration_bits, signed=True) if sampling.duration_bits else 0
        samples = reader.integer(sampling.sample_bits) if sampling.sample_bits else sampling.samples
        start = (sampling.scale * duration + sampling.offset) * unit
        return Segment(
            reader.samples(samples, sampling.bits),
            start,
            sampling.step,
            sampling.channel,
            table=sampling.table,
        )


class _WaveReader:
    """Reads the waves of a pulse from the bytes of a file, from an offset on."""

    def __init__(self, waves: np.ndarray, offset: int, location: str):
        self.waves, self.offset, self.location = waves, offset, location
        if offset < _WAVES_HEADER_SIZE:
            raise ValueError(f"{location}: they lie in the header")

    def take(self, size: int) -> np.ndarray:
        """Return the next bytes."""
        if self.offset + size > self.waves.size:
            raise ValueError(f"{self.location}: the file ends after {self.waves.size} bytes")
        self.offset += size
        return self.waves[self.offset - size : self.offset]

    def integer(self, bits: int, *, signed: bool = False) -> int:
        """Return the next whole number."""
        return int.from_bytes(self.take(bits // 8).tobytes(), "little", signed=signed)

    def samples(self, count: int, bits: int) -> np.ndarray:
        """Return the next samples, which stay in the file."""
        if count == 0:
            raise ValueError(f"{self.location}: a segment of 0 samples")
        return np.asarray(self.take(count * bits // 8)).view(f"<u{bits // 8}")


# -- header and records ------------------------------------------------------------------------------------


def _read_header(path: Path, file: BinaryIO) -> PulsesHeader:
    """Read the header of a file, whose pulses then fit into it.

    **Raises:** ValueError, naming the file and the place, for a header or a record that makes no sense.
    """
    size, location = path.stat().st_size, f"{path}: header"
    block = file.read(_HEADER_SIZE)
    if not block.startswith(_PULSES_SIGNATURE):
        raise ValueError(f"{location}: no file of pulses: it does not begin with PulseWavesPulse")
    if len(block) < _HEADER_SIZE:
        raise ValueError(f"{location}: the file ends after {size} bytes")
    (
        _,
        major,
        minor,
        header_size,
        start,
        count,
        pulse_format,
        _,
        pulse_size,
        compression,
        records,
        appended,
    ) = _HEADER.unpack_from(block)
    if major > 1:
        raise ValueError(f"{location}: version {major}.{minor} is none of PulseWaves 0 and 1")
    if pulse_format != 0 or compression != 0:
        raise ValueError(
            f"{location}: pulse format {pulse_format}, compression {compression}; read is 0 of both"
        )
    if not _HEADER_SIZE <= header_size <= start <= size:
        raise ValueError(
            f"{location}: it is {header_size} bytes long and pulses begin at {start}: a file of {size} bytes "
            f"admits {_HEADER_SIZE} or more, in this order"
        )
    if count <= 0:
        raise ValueError(f"{location}: the file holds {count} pulses")
    if pulse_size < _PULSE_SIZE:
        raise ValueError(f"{location}: pulses of {pulse_size} bytes; they have {_PULSE_SIZE} or more")
    if start + count * pulse_size > size:
        raise ValueError(
            f"{path}: pulse {(size - start) // pulse_size}: the file ends, but its header names {count} "
            "pulses"
        )
    time_scale, time_offset = _TIME_SCALE.unpack_from(block, _HEADER.size)
    coordinates = np.array(_COORDINATE_SCALES.unpack_from(block, _HEADER.size + _TIME_SCALE.size))
    scales, offsets = (time_scale, *coordinates[:3]), (time_offset, *coordinates[3:])
    check_scales(location, "txyz", scales, offsets, _SCALES)
    contents = dict(_record_contents(path, file, header_size, start, records))
    if appended:
        contents |= _appended_contents(path, file, start + count * pulse_size, size)
    projection = {
        number: [content] for (user, number), content in contents.items() if user == _PROJECTION_USER
    }
    system = declared_system(location, lambda number: projection.get(number, []))

    def parse(numbers: range, parse_content: Callable[[str, bytes], _Content]) -> dict[int, _Content]:
        """Parse the records with some numbers of the specification, by their number from 0 on."""
        return {
            number - numbers.start: parse_content(f"{path}: record {number}", content)
            for (user, number), content in sorted(contents.items())
            if user == _SPECIFICATION_USER and number in numbers
        }

    return PulsesHeader(
        start=start,
        count=count,
        pulse_size=pulse_size,
        time_scale=time_scale,
        time_offset=time_offset,
        scale=coordinates[:3],
        offset=coordinates[3:],
        system=system,
        scanners=parse(_SCANNERS, _parse_scanner),
        descriptors=parse(_DESCRIPTORS, _parse_descriptor),
        tables=parse(_TABLES, _parse_table),
    )


def _record_contents(
    path: Path, file: BinaryIO, start: int, end: int, count: int
) -> Iterator[tuple[tuple[bytes, int], bytes]]:
    """Yield the contents of the variable length records between two offsets, by user and number."""
    for user, number, offset, length in variable_records(path, file, _RECORD, start, end, count, "pulses"):
        file.seek(offset)
        yield (user, number), file.read(length)


def _appended_contents(path: Path, file: BinaryIO, start: int, end: int) -> dict[tuple[bytes, int], bytes]:
    """Return the contents of the records after the pulses, from the last to the first, by user and number."""
    contents, offset = {}, end
    while True:
        if offset - _RECORD.size < start:
            raise ValueError(f"{path}: appended records: there is no first one after the pulses")
        file.seek(offset - _RECORD.size)
        user, number, length = _RECORD.unpack(file.read(_RECORD.size))
        if (user.rstrip(b"\0"), number) == (_SPECIFICATION_USER, _END_NUMBER):
            return contents
        offset -= _RECORD.size + length
        if length < 0 or offset < start:
            raise ValueError(
                f"{path}: appended record {number}: its {length} bytes run into the pulses, up to {start}"
            )
        file.seek(offset)
        contents[user.rstrip(b"\0"), number] = file.read(length)


def _parse_scanner(location: str, content: bytes) -> Scanner:
    if len(content) < _SCANNER.size:
        raise ValueError(f"{location}: {len(content)} bytes hold no scanner")
    *names, wavelength, width, divergence = _SCANNER.unpack_from(content)
    instrument, serial = (name.split(b"\0")[0].decode("ascii", "replace") for name in names)
    numbers = (x if math.isfinite(x) and x > 0 else None for x in (wavelength, width, divergence))
    return Scanner(instrument, serial, *numbers)


def _parse_descriptor(location: str, content: bytes) -> PulseDescriptor:
    if len(content) < _DESCRIPTOR.size:
        raise ValueError(f"{location}: {len(content)} bytes hold no descriptor of pulses")
    offset, origin, extra, count, unit, compression, scanner = _DESCRIPTOR.unpack_from(content)
    if compression:
        raise ValueError(f"{location}: waves are compressed ({compression}); read are those that are not")
    if not (math.isfinite(unit) and unit > 0 and count > 0 and offset >= _DESCRIPTOR.size):
        raise ValueError(f"{location}: {count} samplings from byte {offset} on, in units of {unit:g} ns")
    samplings = []
    for i in range(count):
        if offset + _SAMPLING.size > len(content):
            raise ValueError(f"{location}: {count} samplings, but there is room for {i}")
        size, *fields = _SAMPLING.unpack_from(content, offset)
        if size < _SAMPLING.size:
            raise ValueError(f"{location}: sampling {i}: {size} bytes; it has {_SAMPLING.size} or more")
        samplings.append(_parse_sampling(f"{location}: sampling {i}", *fields))
        offset += size
    return PulseDescriptor(origin != _NO_ORIGIN, extra, unit, scanner, tuple(samplings))


def _parse_sampling(location: str, sampling_type: int, channel: int, *fields: Any) -> PulseSampling:
    """Return a sampling from the fields of `_SAMPLING`, which end with the compression."""
    *storage, compression = fields
    sampling = PulseSampling(sampling_type == _OUTGOING, channel, *storage)
    if compression:
        raise ValueError(f"{location}: samples are compressed ({compression}); read are those that are not")
    if sampling_type not in (_OUTGOING, _RETURNING):
        raise ValueError(
            f"{location}: type {sampling_type} is neither outgoing ({_OUTGOING}) nor returning ({_RETURNING})"
        )
    admissible = {
        **{"duration_bits": (0, 16, 32), "segment_bits": (0, 8, 16), "sample_bits": (0, 8, 16)},
        "bits": (8, 16, 32),
    }
    for field, values in admissible.items():
        if getattr(sampling, field) not in values:
            raise ValueError(f"{location}: {field} = {getattr(sampling, field)} is none of {values}")
    if sampling.segment_bits == 0 and not sampling.segments:
        raise ValueError(f"{location}: it has 0 segments")
    if sampling.sample_bits == 0 and not sampling.samples:
        raise ValueError(f"{location}: its segments have 0 samples")
    for field in ("scale", "step"):
        value = getattr(sampling, field)
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{location}: {field} = {value:g} is outside the range (0, inf)")
    if not math.isfinite(sampling.offset):
        raise ValueError(f"{location}: offset = {sampling.offset:g} is not finite")
    return sampling


def _parse_table(location: str, content: bytes) -> np.ndarray:
    """Return the first table of amplitudes of a record."""
    if len(content) < _TABLE_HEADER.size + _TABLE.size:
        raise ValueError(f"{location}: {len(content)} bytes hold no table")
    offset, _ = _TABLE_HEADER.unpack_from(content)
    if not _TABLE_HEADER.size <= offset <= len(content) - _TABLE.size:
        raise ValueError(f"{location}: its table at byte {offset} does not fit into {len(content)} bytes")
    size, entries, *_ = _TABLE.unpack_from(content, offset)
    offset += size
    if not (size >= _TABLE.size and entries <= _MAX_ENTRIES and offset + 4 * entries <= len(content)):
        raise ValueError(
            f"{location}: {entries} entries from byte {offset} on do not fit into {len(content)} bytes"
        )
    return np.frombuffer(content, "<f4", entries, offset).astype(np.float64)
