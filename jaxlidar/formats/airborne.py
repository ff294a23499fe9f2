"""Shots of airborne full-waveform lidar, in one form for all file formats.

A digitiser records segments of the outgoing pulse and of the return. All segments of a shot have one clock,
in ns. Light that returns at time t comes from a target at `anchor` + t `direction`, whose echo has the
pulse's time zero at t. `pulse_zero` is that zero on the clock of the outgoing segments.

Samples stay as they were recorded. Effects of the instrument (pedestals that differ between interleaved
digitisers, tables that give counts amplitudes, saturation) are not removed.
"""

import abc
import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from jaxlidar._fields.checks import as_numpy, check_index, check_number, check_numbers, check_shape
from jaxlidar.formats.coordinates import is_angle
from jaxlidar.formats.noise import NoiseLevels, above_pedestal, estimate_noise_levels

# Most samples from the first to the last one of a shot: 150 km at 1 ns.
_MAX_SAMPLES = 1_000_000
# Shots of a file, evenly spaced, from which noise is estimated.
_MAX_SHOTS_FOR_NOISE = 1000


def evenly_spaced(count: int) -> slice:
    """Return a slice of `count` shots that selects at most a thousand of them, evenly spaced."""
    return slice(0, count, -(-count // _MAX_SHOTS_FOR_NOISE))


class Segment(NamedTuple):
    """Consecutive samples of one channel of a digitiser.

    - `samples`: (samples,) as stored.
    - `start`: time of the first sample, ns on the shot's clock.
    - `step`: ns from sample to sample. Default 1.
    - `channel`: number of the channel. Default 0.
    - `gain`: of the digitiser: a sample's value is `offset` + `gain` * sample. Default 1.
    - `offset`: as above. Default 0.
    - `table`: number of the table of amplitudes that belongs to the counts, where a file has such tables.
      Default 0: none.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.io import Segment
    >>> segment = Segment(np.array([3, 90, 12], np.uint8), start=5.0, gain=0.5)
    >>> print(segment.time, segment.values)
    [5. 6. 7.] [ 1.5 45.   6. ]
    """

    samples: Shaped[np.ndarray, " samples"]
    start: float
    step: float = 1.0
    channel: int = 0
    gain: float = 1.0
    offset: float = 0.0
    table: int = 0

    @property
    def time(self) -> Float[np.ndarray, " samples"]:
        """Times of the samples, ns on the shot's clock."""
        return self.start + self.step * np.arange(self.samples.size)

    @property
    def values(self) -> Float[np.ndarray, " samples"]:
        """Values of the samples: `offset` + `gain` * `samples`."""
        return self.offset + self.gain * self.samples.astype(np.float64)


class Returns(NamedTuple):
    """Discrete returns that a file holds for a shot.

    - `position`: (returns, 3) coordinates as in the file.
    - `time`: (returns,) ns on the shot's clock, where a file says so.
    - `intensity`, `number`, `count`, `classification`: (returns,) intensity, number of the return, number of
      all returns of the shot, class of the LAS specification.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.formats.airborne import Returns
    >>> one, place = np.array([1]), np.array([[0.0, 0.0, 12.5]])
    >>> Returns(place, np.array([4.0]), np.array([310]), one, one, np.array([2])).position[0, 2]
    np.float64(12.5)
    """

    position: Float[np.ndarray, "returns 3"]
    time: Float[np.ndarray, " returns"]
    intensity: Int[np.ndarray, " returns"]
    number: Int[np.ndarray, " returns"]
    count: Int[np.ndarray, " returns"]
    classification: Int[np.ndarray, " returns"]


class Scanner(NamedTuple):
    """The scanner of a file; None for properties that the file does not state.

    - `instrument`, `serial`: name and serial number.
    - `wavelength`: nm.
    - `pulse_width`: full width at half maximum of the outgoing pulse, ns.
    - `divergence`: mrad.

    **Example:**

    >>> from jaxlidar.formats.airborne import Scanner
    >>> Scanner("Q680i", "9997848", wavelength=1550.0).divergence is None
    True
    """

    instrument: str
    serial: str
    wavelength: float | None = None
    pulse_width: float | None = None
    divergence: float | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class AirborneShot:
    """One shot of an airborne lidar, in double precision.

    `time`, `waveform`, `recorded`, `position` and what follows from them are those of the channel whose
    segment comes first; `of_channel` gives the shot as another channel recorded it.

    **Arguments:**

    - `index`: the file's number of the shot.
    - `anchor`: (3,) position from which light returns at time 0: easting, northing and elevation in m, or as
      in the file.
    - `direction`: (3,) vector from there to the position from which light returns 1 ns later, in units of
      `anchor`.
    - `returning`: `Segment`s of the return, at least one.
    - `outgoing`: `Segment`s of the outgoing pulse. Default: none.
    - `noise_mean`, `noise_std`: mean and standard deviation of the noise in values of samples, estimated from
      what precedes the returns of the file's shots. Defaults 0.
    - `pedestal`: mean value of the outgoing segments before the pulse, estimated likewise. Default 0.
    - `pulse_zero`: time zero of the pulse, ns on the clock of the outgoing segments. Default None: the
      largest sample.
    - `metres`: (3,) metres per unit of `anchor`. Default ones.
    - `gps_time`: s. Default None: not known.
    - `scanner`: a `Scanner`. Default None.
    - `returns`: the `Returns` that the file holds. Default None.
    - `scanner_channel`: number of the channel of a scanner that sends several beams at one time. Default 0.
    - `crs`: the coordinate reference system of `anchor`, as the file declares it: a code, such as
      "EPSG:32633", or well-known text. Default None: not known.
    - `scan_angle`: degrees to the right of the track. Default 0.
    - `flight_line`: number of the flight line or instrument, as a LAS file's point source. Default 0.

    **Raises:** ValueError for a shot without a returning segment, for segments whose numbers make no sense,
    for those of a channel that overlap, have different steps or lie too far apart.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.io import AirborneShot, Segment
    >>> echo, sent = Segment(np.array([10, 90, 12]), start=0.0), Segment(np.array([0, 80, 0]), start=-1.0)
    >>> place = {"anchor": np.array([0.0, 0.0, 20.15]), "direction": np.array([0.0, 0.0, -0.15])}
    >>> shot = AirborneShot(1, **place, returning=(echo,), outgoing=(sent,), noise_mean=10.0)
    >>> print(shot.signal, shot.time_from(20.0).round(2), shot.pulse_time)
    [ 0. 80.  2.] [-1.  0.  1.] [-1.  0.  1.]
    """

    index: int
    anchor: Float[np.ndarray, " 3"]
    direction: Float[np.ndarray, " 3"]
    returning: tuple[Segment, ...]
    outgoing: tuple[Segment, ...] = ()
    noise_mean: float = 0.0
    noise_std: float = 0.0
    pedestal: float = 0.0
    pulse_zero: float | None = None
    metres: Float[np.ndarray, " 3"] = dataclasses.field(default_factory=lambda: np.ones(3))
    gps_time: float | None = None
    scanner: Scanner | None = None
    returns: Returns | None = None
    scanner_channel: int = 0
    crs: str | None = None
    scan_angle: float = 0.0
    flight_line: int = 0

    def __post_init__(self):
        if not self.returning:
            raise ValueError(f"shot {self.index}: it has no returning segment")
        for name in ("anchor", "direction", "metres"):
            check_shape(name, as_numpy(getattr(self, name), name), (3,))
        fields = ("index", "noise_mean", "noise_std", "pedestal", "pulse_zero", "gps_time")
        for name in (*fields, "scanner_channel", "scan_angle", "flight_line"):
            if (number := getattr(self, name)) is not None:
                check_numbers(name, number)
        for segment in (*self.returning, *self.outgoing):
            for name, numbers in segment._asdict().items():
                check_numbers(name, numbers)
            start, step, *_ = numbers = [segment.start, segment.step, segment.gain, segment.offset]
            if segment.samples.size == 0 or not (np.all(np.isfinite(numbers)) and step > 0):
                raise ValueError(
                    f"shot {self.index}: a segment of {segment.samples.size} samples every {step:g} ns from "
                    f"{start:g} ns, gain {segment.gain:g}, offset {segment.offset:g}"
                )
        first, indices = self._segments[0], self._first_indices
        if any(segment.step != first.step for segment in self._segments):
            raise ValueError(f"shot {self.index}: segments of channel {first.channel} have different steps")
        ends = [index + segment.samples.size for index, segment in zip(indices, self._segments)]
        if any(start < end for start, end in zip(indices[1:], ends)):
            raise ValueError(f"shot {self.index}: segments of channel {first.channel} overlap")
        if ends[-1] > _MAX_SAMPLES:
            raise ValueError(
                f"shot {self.index}: {ends[-1]} samples from the first to the last; at most {_MAX_SAMPLES} "
                "are admissible"
            )

    @functools.cached_property
    def _segments(self) -> tuple[Segment, ...]:
        """Returning segments of the first segment's channel, in order of time."""
        channel = self.returning[0].channel
        return tuple(sorted((s for s in self.returning if s.channel == channel), key=lambda s: s.start))

    @functools.cached_property
    def _first_indices(self) -> list[int]:
        """Index of the first sample of each segment, counted from the first sample of the shot."""
        steps = (round((b.start - a.start) / a.step) for a, b in itertools.pairwise(self._segments))
        return list(itertools.accumulate(steps, initial=0))

    @property
    def is_geographic(self) -> bool:
        """True if x and y are longitude and latitude."""
        return is_angle(self.metres)

    @property
    def sampling_interval(self) -> float:
        """Time from sample to sample in ns."""
        return self._segments[0].step

    @functools.cached_property
    def recorded(self) -> Bool[np.ndarray, " samples"]:
        """True for samples that were recorded, False between segments."""
        recorded = np.zeros(self._first_indices[-1] + self._segments[-1].samples.size, bool)
        for index, segment in zip(self._first_indices, self._segments):
            recorded[index : index + segment.samples.size] = True
        return recorded

    @functools.cached_property
    def time(self) -> Float[np.ndarray, " samples"]:
        """Times of the samples, ns on the shot's clock, increasing; interpolated between segments."""
        times = np.concatenate([segment.time for segment in self._segments])
        return np.interp(np.arange(self.recorded.size), np.flatnonzero(self.recorded), times)

    @functools.cached_property
    def waveform(self) -> Float[np.ndarray, " samples"]:
        """Values received, noise included; 0 where nothing was recorded."""
        values = np.zeros(self.recorded.size)
        values[self.recorded] = np.concatenate([segment.values for segment in self._segments])
        return values

    @property
    def signal(self) -> Float[np.ndarray, " samples"]:
        """Received waveform less the mean noise; 0 where nothing was recorded."""
        return np.where(self.recorded, self.waveform - self.noise_mean, 0.0)

    @property
    def position(self) -> Float[np.ndarray, "samples 3"]:
        """Position of a target whose echo has the pulse's time zero in a sample, in units of `anchor`."""
        return self.anchor + self.time[:, None] * self.direction

    @property
    def elevation(self) -> Float[np.ndarray, " samples"]:
        """Elevation of the samples, in the unit of `anchor`."""
        return self.position[:, 2]

    @property
    def zenith(self) -> float:
        """Zenith angle of the beam in degrees, as in `Lidar`."""
        east, north, up = self.direction * self.metres
        return float(np.rad2deg(np.arctan2(np.hypot(east, north), -up)))

    @property
    def azimuth(self) -> float:
        """Horizontal direction in which the light travels, in degrees clockwise from north, as in `Lidar`."""
        east, north, _ = self.direction * self.metres
        return float(np.rad2deg(np.arctan2(east, north))) % 360.0

    @functools.cached_property
    def _pulse(self) -> tuple[np.ndarray, np.ndarray]:
        if not self.outgoing:
            raise ValueError(f"shot {self.index}: no outgoing pulse was recorded")
        segment = self.outgoing[0]
        power = above_pedestal(segment.values, self.pedestal, f"shot {self.index}: outgoing")
        zero = segment.time[np.argmax(power)] if self.pulse_zero is None else self.pulse_zero
        return segment.time - zero, power

    @property
    def pulse_time(self) -> Float[np.ndarray, " pulse_samples"]:
        """Times of the samples of the outgoing pulse, in ns from its time zero.

        With `pulse_power` for `SampledPulse`. **Raises:** ValueError where no pulse was recorded.
        """
        return self._pulse[0]

    @property
    def pulse_power(self) -> Float[np.ndarray, " pulse_samples"]:
        """Power of the outgoing pulse: pedestal removed, not negative, and zero before and after the pulse.

        **Raises:** ValueError where no pulse was recorded, and for one without energy.
        """
        return self._pulse[1]

    def of_channel(self, channel: int) -> "AirborneShot":
        """Return the shot as one channel recorded it.

        **Arguments:** `channel`: number of a channel that a returning segment has.

        **Returns:** an `AirborneShot` with the returning segments of that channel.

        **Raises:** ValueError where the shot has no such channel.
        """
        check_numbers("channel", channel)
        segments = tuple(segment for segment in self.returning if segment.channel == channel)
        if not segments:
            channels = sorted({segment.channel for segment in self.returning})
            raise ValueError(f"shot {self.index}: channel = {channel} is none of {channels}")
        return dataclasses.replace(self, returning=segments)

    def time_from(self, elevation: float) -> Float[np.ndarray, " samples"]:
        """Return the times of the samples in ns, for a simulation whose plane z = 0 lies at `elevation`.

        **Arguments:** `elevation`: of the plane, in the unit of `anchor`.

        **Returns:** (samples,) ns. Zero is the two-way travel time to where the beam axis meets that plane;
        earlier times are negative.
        """
        check_number("elevation", elevation)
        return self.time - (elevation - self.anchor[2]) / self.direction[2]

    def position_at(self, elevation: float) -> Float[np.ndarray, " 2"]:
        """Return the position in which the beam axis meets an elevation.

        **Arguments:** `elevation`: in the unit of `anchor`.

        **Returns:** easting and northing, in units of `anchor`.
        """
        check_number("elevation", elevation)
        return self.anchor[:2] + self.direction[:2] * (elevation - self.anchor[2]) / self.direction[2]


# Not Sequence[AirborneShot]: checkers of types at run time would read a shot wherever the sequence is passed.
class AirborneShots(Sequence, abc.ABC):
    """The shots of a file: a sequence that reads a shot when it is indexed.

    `shots[5]` is an `AirborneShot`, `shots[:100]` a list of them. The file is mapped, so it may be larger
    than memory. `read_pulsewaves`, `read_las_waveforms` and `read_lvis_l1b` return it.

    - `path`: the file.
    - `gps_time`: (shots,) s.
    - `anchor`, `direction`: (shots, 3) as in `AirborneShot`.
    - `levels`: mean and standard deviation of the noise, and the pedestal of outgoing pulses: medians of up
      to 1,000 shots, evenly spread.
    - `tables`: (counts,) amplitudes of the counts, by the `table` of a `Segment`. They are not applied.
    - `dropped`: how many points or pulses of the file were left out, by reason.

    **Raises:** a shot's ValueError, which names the file and the shot, where it is damaged.

    **Example:**

    >>> from jaxlidar.io import read_pulsewaves
    >>> shots = read_pulsewaves("flight.pls")  # doctest: +SKIP
    >>> top = [shot.elevation[shot.signal.argmax()] for shot in shots]  # doctest: +SKIP
    """

    path: Path
    tables: dict[int, np.ndarray]
    dropped: dict[str, int]

    @property
    @abc.abstractmethod
    def gps_time(self) -> Float[np.ndarray, " shots"]:
        """GPS times of the shots, s."""

    @property
    @abc.abstractmethod
    def anchor(self) -> Float[np.ndarray, "shots 3"]:
        """Positions from which light returns at time 0."""

    @property
    @abc.abstractmethod
    def direction(self) -> Float[np.ndarray, "shots 3"]:
        """Vectors from the anchors to the positions from which light returns 1 ns later."""

    @abc.abstractmethod
    def _read(self, index: int) -> dict[str, Any]:
        """Return the arguments of `AirborneShot` but for its noise levels; its index where it is another.

        A noise level that the file states for the shot may be among them.
        """

    @functools.cached_property
    def levels(self) -> NoiseLevels:
        """Mean and standard deviation of the noise, and the pedestal of outgoing pulses."""
        sampled = range(len(self))[evenly_spaced(len(self))]
        return estimate_noise_levels(
            (shot["outgoing"][0].values if shot["outgoing"] else None, shot["returning"][0].values)
            for shot in self._read_undamaged(sampled)
        )

    def _read_undamaged(self, indices: Iterable[int]) -> Iterator[dict[str, Any]]:
        """Yield what `_read` returns, but for damaged shots: those are refused when they are indexed."""
        for i in indices:
            with contextlib.suppress(ValueError):
                yield self._read(i)

    @overload
    def __getitem__(self, index: int) -> AirborneShot: ...
    @overload
    def __getitem__(self, index: slice) -> list[AirborneShot]: ...
    def __getitem__(self, index: int | slice) -> AirborneShot | list[AirborneShot]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        i = check_index("shot", index, len(self))
        # Levels of the file are replaced by those that it states for the shot.
        arguments: dict[str, Any] = {**self.levels._asdict(), "index": i, **self._read(i)}
        try:
            return AirborneShot(**arguments)
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from error

    def __iter__(self) -> Iterator[AirborneShot]:
        return (self[i] for i in range(len(self)))

    def __repr__(self) -> str:
        return f"{len(self):,} shots of {self.path.name}"


class ShotStack(NamedTuple):
    """Waveforms of several shots as arrays of one length, for `inversion.gaussian_decomposition` and batches.

    - `time`: (samples,) ns from the first sample of each shot.
    - `signal`: (shots, samples) values less the mean noise; 0 where nothing was recorded.
    - `recorded`: (shots, samples) True for samples that were recorded.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.formats.airborne import ShotStack
    >>> stack = ShotStack(np.arange(3.0), np.array([[0.0, 80.0, 2.0]]), np.full((1, 3), True))
    >>> noise = np.where(stack.recorded, 1.5, np.inf)
    """

    time: Float[np.ndarray, " samples"]
    signal: Float[np.ndarray, "shots samples"]
    recorded: Bool[np.ndarray, "shots samples"]


def stack_shots(shots: Iterable[AirborneShot]) -> ShotStack:
    """Return the waveforms of several shots, padded to the longest.

    **Arguments:**

    - `shots`: `AirborneShot`s of one sampling interval, at least one.

    **Returns:** a `ShotStack`.

    **Raises:** ValueError where there is no shot, and where sampling intervals differ.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.io import AirborneShot, Segment, stack_shots
    >>> way = {"anchor": np.array([0.0, 0.0, 20.15]), "direction": np.array([0.0, 0.0, -0.15])}
    >>> echoes = (np.array([1, 9, 1]), np.array([2, 8, 5, 2]))
    >>> shots = [AirborneShot(i, **way, returning=(Segment(e, 0.0),)) for i, e in enumerate(echoes)]
    >>> print(stack_shots(shots).signal)
    [[1. 9. 1. 0.]
     [2. 8. 5. 2.]]
    """
    shots = list(shots)
    if not shots:
        raise ValueError("shots is empty; admissible are one or more")
    steps = {shot.sampling_interval for shot in shots}
    if len(steps) != 1:
        raise ValueError(f"shots have the sampling intervals {sorted(steps)} ns; admissible is one")
    size = max(shot.recorded.size for shot in shots)
    signal, recorded = np.zeros((len(shots), size)), np.zeros((len(shots), size), bool)
    for row, shot in enumerate(shots):
        signal[row, : shot.recorded.size] = shot.signal
        recorded[row, : shot.recorded.size] = shot.recorded
    return ShotStack(steps.pop() * np.arange(size), signal, recorded)
