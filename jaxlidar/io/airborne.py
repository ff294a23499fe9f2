"""Records of airborne full-waveform lidar, one kind for all formats.

A digitiser records segments: some of the outgoing pulse, some of what returns. All segments of a shot have
one clock, in ns. What returns at time t comes from a target at `anchor` + t `direction`, whose echo has the
pulse's time zero at t. `pulse_zero` is that zero on the clock of the outgoing segments.

Samples stay as they were recorded. What an instrument adds to them (pedestals that differ between interleaved
digitisers, tables that give counts amplitudes, saturation) is not removed.
"""

import dataclasses
import functools
import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from jaxlidar.io.pedestal import above_pedestal

# Most samples from the first to the last one of a shot: 150 km at 1 ns.
_LONGEST = 1_000_000


class Segment(NamedTuple):
    """Samples in a row of one channel of a digitiser.

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
    >>> from jaxlidar.io import Returns
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
    """What a file says of the scanner; None where it says nothing.

    - `instrument`, `serial`: names.
    - `wavelength`: nm.
    - `pulse_width`: full width at half maximum of the outgoing pulse, ns.
    - `divergence`: mrad.

    **Example:**

    >>> from jaxlidar.io import Scanner
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
    - `anchor`: (3,) where what returns at time 0 comes from: easting, northing and elevation in m, or as in
      the file.
    - `direction`: (3,) the way from there of what returns 1 ns later, in units of `anchor`.
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

    def __post_init__(self):
        if not self.returning:
            raise ValueError(f"shot {self.index}: it has no returning segment")
        for segment in (*self.returning, *self.outgoing):
            start, step, *_ = numbers = [segment.start, segment.step, segment.gain, segment.offset]
            if segment.samples.size == 0 or not (np.all(np.isfinite(numbers)) and step > 0):
                raise ValueError(
                    f"shot {self.index}: a segment of {segment.samples.size} samples every {step:g} ns from "
                    f"{start:g} ns, gain {segment.gain:g}, offset {segment.offset:g}"
                )
        first, places = self._segments[0], self._places
        if any(segment.step != first.step for segment in self._segments):
            raise ValueError(f"shot {self.index}: segments of channel {first.channel} have different steps")
        ends = [place + segment.samples.size for place, segment in zip(places, self._segments)]
        if any(start < end for start, end in zip(places[1:], ends)):
            raise ValueError(f"shot {self.index}: segments of channel {first.channel} overlap")
        if ends[-1] > _LONGEST:
            raise ValueError(
                f"shot {self.index}: {ends[-1]} samples from the first to the last; at most {_LONGEST} are "
                "admissible"
            )

    @functools.cached_property
    def _segments(self) -> tuple[Segment, ...]:
        """The returning segments of the first one's channel, in order of time."""
        channel = self.returning[0].channel
        return tuple(sorted((s for s in self.returning if s.channel == channel), key=lambda s: s.start))

    @functools.cached_property
    def _places(self) -> list[int]:
        """At which samples, counted from the first, the segments begin."""
        steps = (round((b.start - a.start) / a.step) for a, b in itertools.pairwise(self._segments))
        return list(itertools.accumulate(steps, initial=0))

    @property
    def is_geographic(self) -> bool:
        """Whether x and y are degrees."""
        return bool(self.metres[0] != self.metres[2])

    @property
    def sampling_interval(self) -> float:
        """Time from sample to sample in ns."""
        return self._segments[0].step

    @functools.cached_property
    def recorded(self) -> Bool[np.ndarray, " samples"]:
        """Whether a sample was recorded: between segments nothing was."""
        last = self._places[-1] + self._segments[-1].samples.size
        found = np.zeros(last, bool)
        for place, segment in zip(self._places, self._segments):
            found[place : place + segment.samples.size] = True
        return found

    @functools.cached_property
    def time(self) -> Float[np.ndarray, " samples"]:
        """Times of the samples, ns on the shot's clock, increasing; interpolated between segments."""
        numbers = np.concatenate(
            [p + np.arange(s.samples.size) for p, s in zip(self._places, self._segments)]
        )
        times = np.concatenate([segment.time for segment in self._segments])
        return np.interp(np.arange(self.recorded.size), numbers, times)

    @functools.cached_property
    def waveform(self) -> Float[np.ndarray, " samples"]:
        """The values received, noise included; 0 where nothing was recorded."""
        values = np.zeros(self.recorded.size)
        values[self.recorded] = np.concatenate([segment.values for segment in self._segments])
        return values

    @property
    def signal(self) -> Float[np.ndarray, " samples"]:
        """The received waveform less the mean noise; 0 where nothing was recorded."""
        return np.where(self.recorded, self.waveform - self.noise_mean, 0.0)

    @property
    def position(self) -> Float[np.ndarray, "samples 3"]:
        """Where a target lies whose echo has the pulse's time zero in a sample, in units of `anchor`."""
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
        """The horizontal direction in which the light travels, in degrees clockwise from north, as in
        `Lidar`."""
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
        """The outgoing pulse: pedestal removed, not negative, and zero before and after the pulse.

        **Raises:** ValueError where no pulse was recorded, and for one without energy.
        """
        return self._pulse[1]

    def of_channel(self, channel: int) -> "AirborneShot":
        """The shot as one channel recorded it.

        **Arguments:** `channel`: number of a channel that a returning segment has.

        **Returns:** an `AirborneShot` with the returning segments of that channel.

        **Raises:** ValueError where the shot has no such channel.
        """
        chosen = tuple(segment for segment in self.returning if segment.channel == channel)
        if not chosen:
            known = sorted({segment.channel for segment in self.returning})
            raise ValueError(f"shot {self.index}: channel = {channel} is none of {known}")
        return dataclasses.replace(self, returning=chosen)

    def time_from(self, elevation: float) -> Float[np.ndarray, " samples"]:
        """Times of the samples in ns, for a simulation whose reference plane z = 0 lies at `elevation`.

        **Arguments:** `elevation`: of the plane, in the unit of `anchor`.

        **Returns:** (samples,) ns. Zero is the two-way travel time to where the beam axis meets that plane;
        earlier times are negative.
        """
        return self.time - (elevation - self.anchor[2]) / self.direction[2]

    def position_at(self, elevation: float) -> Float[np.ndarray, " 2"]:
        """Where the beam axis meets an elevation.

        **Arguments:** `elevation`: in the unit of `anchor`.

        **Returns:** easting and northing, in units of `anchor`.
        """
        return self.anchor[:2] + self.direction[:2] * (elevation - self.anchor[2]) / self.direction[2]
