"""Reader of recorded waveforms: PulseWaves files, as LVIS and RIEGL data are published in.

A .pls file holds the pulses, a .wvs file beside it their samples. What they refer to was found from recorded
files, and `read_pulsewaves` relies on it.

- RIEGL Q680i: outgoing segments are timed from their own largest sample (to 0.003 ns), returning ones from
  the anchor; so a target lies at anchor + t direction where its echo has the outgoing pulse's largest sample
  at t. The same shots as LAS put their discrete returns there to 5 mm, which is the rounding of directions.
  Counts are not proportional to the light received: tables give their amplitudes (`AirborneShots.tables`,
  `Segment.table`). Where the channel of low power is near its largest count, that of high power recorded a
  second segment 1.44 ns later (`AirborneShot.of_channel`).
- LVIS: the anchor is the first returning sample, and nothing tells when the pulse left: its time zero is
  taken at its largest sample. Two digitisers recorded odd and even samples, with pedestals of their own.
  About a third of the returns saturate near 225 counts. Coordinates are degrees and m; east is 0 to 360.
- Samples are given as they are stored: pedestals, tables and saturation are left to the user.
"""

import os
from pathlib import Path
from typing import Any, final

import numpy as np

from jaxlidar.io.airborne import Segment
from jaxlidar.io.airborne_shots import AirborneShots, evenly
from jaxlidar.io.checks import FARTHEST, existing
from jaxlidar.io.coordinates import frame_of
from jaxlidar.io.pulsewaves_header import WAVES, Descriptor, Sampling, read_pulses_header

_FIELDS = (
    *(("time", "<i8"), ("waves", "<i8"), ("anchor", "<i4", 3), ("target", "<i4", 3), ("first", "<i2")),
    *(("last", "<i2"), ("descriptor", "u1"), ("scan", "u1"), ("intensity", "u1"), ("class", "u1")),
)
_PULSE_SIZE = np.dtype(list(_FIELDS)).itemsize
# A target lies so many units of time from its anchor.
_TARGET = 1000.0
_WAVES_HEADER = 60


def read_pulsewaves(path: str | os.PathLike[str]) -> AirborneShots:
    """The shots of a PulseWaves file.

    Both files are mapped: shots are read when they are asked for. Coordinates may be metres, feet or degrees.

    **Arguments:**

    - `path`: the .pls file; the .wvs file lies beside it, under the same name.

    **Returns:** an `AirborneShots`. Segments have the counts as stored.

    **Raises:** FileNotFoundError where there is no such file, or no .wvs file. ValueError, naming the file
    and the place, for one that is no PulseWaves file, is damaged, compressed, without pulses, or declares
    more than it can hold; asking for a shot, for waves that lie outside of the .wvs file, an unknown
    descriptor, samples that are none, and a direction that light does not go in 1 ns.

    **Source:** PulseWaves specification 0.3 (rapidlasso).

    **Example:**

    >>> import jaxlidar as jl
    >>> import jaxlidar.io
    >>> shot = jaxlidar.io.read_pulsewaves("flight.pls")[0]  # doctest: +SKIP
    >>> pulse = jl.SampledPulse(time=shot.pulse_time, power=shot.pulse_power)  # doctest: +SKIP
    >>> lidar = jl.Lidar(pulse=pulse, zenith=shot.zenith, azimuth=shot.azimuth)  # doctest: +SKIP
    """
    return _PulseWavesShots(existing(path))


@final
class _PulseWavesShots(AirborneShots):
    def __init__(self, path: Path):
        self.path, self.dropped = path, {}
        with path.open("rb") as file:
            header = self.header = read_pulses_header(path, file, _PULSE_SIZE)
        self.tables, self.scanners = header.tables, header.scanners
        self.units = np.full(256, np.nan)
        self.units[list(header.descriptors)] = [found.unit for found in header.descriptors.values()]
        kind = np.dtype([*_FIELDS, ("more", f"V{header.pulse_size - _PULSE_SIZE}")])
        self.pulses: Any = np.memmap(path, kind, "r", header.start, (header.count,))
        wave_path = existing(path.with_suffix(".WVS" if path.suffix.isupper() else ".wvs"))
        with wave_path.open("rb") as file:
            head = file.read(_WAVES_HEADER)
        if len(head) < _WAVES_HEADER or not head.startswith(WAVES):
            raise ValueError(f"{wave_path}: header: no file of waves: it does not begin with PulseWavesWaves")
        compression = int.from_bytes(head[16:20], "little")
        if compression:
            raise ValueError(f"{wave_path}: header: waves are compressed ({compression}): they are not read")
        self.waves, self.wave_path = np.memmap(wave_path, np.uint8, "r"), wave_path
        rows = evenly(header.count)
        self.frame = frame_of(f"{path}: pulses", header.geographic, self._anchor(rows), self._direction(rows))

    def __len__(self) -> int:
        return self.header.count

    def _anchor(self, rows: Any) -> np.ndarray:
        return self.pulses["anchor"][rows] * self.header.scale + self.header.offset

    def _direction(self, rows: Any) -> np.ndarray:
        way = (self.pulses["target"][rows].astype(float) - self.pulses["anchor"][rows]) * self.header.scale
        return way / (_TARGET * self.units[self.pulses["descriptor"][rows], None])

    @property
    def gps_time(self) -> np.ndarray:
        return self.pulses["time"] * self.header.time_scale + self.header.time_offset

    @property
    def anchor(self) -> np.ndarray:
        return self._anchor(slice(None))

    @property
    def direction(self) -> np.ndarray:
        return self._direction(slice(None))

    def _facts(self, index: int) -> dict[str, Any]:
        pulse, rows = self.pulses[index], slice(index, index + 1)
        descriptor = self._descriptor(index)
        outgoing, returning = self._segments(index, descriptor)
        anchor, direction = self._anchor(rows)[0], self._direction(rows)[0]
        if np.abs(anchor).max() > FARTHEST:
            raise ValueError(
                f"{self.path}: pulse {index}: its anchor {anchor.tolist()} lies beyond {FARTHEST:g}"
            )
        if self.frame.wrong(anchor, direction):
            raise ValueError(
                f"{self.path}: pulse {index}: the way of light in 1 ns cannot be {direction.tolist()}"
            )
        return {
            "outgoing": outgoing,
            "returning": returning,
            "anchor": anchor,
            "direction": direction,
            "pulse_zero": 0.0 if descriptor.has_origin else None,
            "metres": self.frame.metres(anchor),
            "gps_time": float(pulse["time"] * self.header.time_scale + self.header.time_offset),
            "scanner": self.scanners.get(descriptor.scanner or min(self.scanners, default=0)),
        }

    def _descriptor(self, index: int) -> Descriptor:
        number = int(self.pulses["descriptor"][index])
        if number not in self.header.descriptors:
            known = sorted(self.header.descriptors)
            raise ValueError(f"{self.path}: pulse {index}: descriptor {number} is none of {known}")
        return self.header.descriptors[number]

    def _segments(
        self, index: int, descriptor: Descriptor
    ) -> tuple[tuple[Segment, ...], tuple[Segment, ...]]:
        at = int(self.pulses["waves"][index])
        place = f"{self.path}: pulse {index}: its waves at byte {at} of {self.wave_path.name}"
        cursor = _Cursor(self.waves, at, place)
        cursor.take(descriptor.extra)
        found: dict[bool, list[Segment]] = {True: [], False: []}
        for sampling in descriptor.samplings:
            count = cursor.whole(sampling.segment_bits) if sampling.segment_bits else sampling.segments
            for _ in range(count):
                found[sampling.outgoing].append(self._segment(cursor, sampling, descriptor.unit))
        if not found[False]:
            raise ValueError(f"{self.path}: pulse {index}: it has no returning segment")
        return tuple(found[True]), tuple(found[False])

    @staticmethod
    def _segment(cursor: "_Cursor", sampling: Sampling, unit: float) -> Segment:
        duration = cursor.whole(sampling.duration_bits, signed=True) if sampling.duration_bits else 0
        samples = cursor.whole(sampling.sample_bits) if sampling.sample_bits else sampling.samples
        start = (sampling.scale * duration + sampling.offset) * unit
        return Segment(
            cursor.samples(samples, sampling.bits),
            start,
            sampling.step,
            sampling.channel,
            table=sampling.table,
        )


class _Cursor:
    """Where in the waves a pulse is being read."""

    def __init__(self, waves: np.ndarray, at: int, place: str):
        self.waves, self.at, self.place = waves, at, place
        if at < _WAVES_HEADER:
            raise ValueError(f"{place}: they lie in the header")

    def take(self, size: int) -> np.ndarray:
        """The next bytes."""
        if self.at + size > self.waves.size:
            raise ValueError(f"{self.place}: the file ends after {self.waves.size} bytes")
        self.at += size
        return self.waves[self.at - size : self.at]

    def whole(self, bits: int, *, signed: bool = False) -> int:
        """The next whole number."""
        return int.from_bytes(self.take(bits // 8).tobytes(), "little", signed=signed)

    def samples(self, count: int, bits: int) -> np.ndarray:
        """The next samples, which stay in the file."""
        if count == 0:
            raise ValueError(f"{self.place}: a segment of 0 samples")
        return np.asarray(self.take(count * bits // 8)).view(f"<u{bits // 8}")
