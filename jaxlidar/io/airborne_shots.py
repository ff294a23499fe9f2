"""Sequences of airborne shots, which read each shot of a file when it is asked for."""

import abc
import functools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np
from jaxtyping import Bool, Float

from jaxlidar.io.airborne import AirborneShot, Segment

# Numbers of samples at the beginning of a return, and of an outgoing pulse, that hold only noise.
QUIET, QUIET_PULSE = 8, 5
# Standard deviation of normal numbers over their median absolute deviation.
STD_PER_MAD = 1.4826
# Shots of a file, evenly spread, that noise is estimated from.
_ESTIMATED_FROM = 1000


def evenly(count: int) -> slice:
    """Which of so many shots stand for all where a file is opened."""
    return slice(0, count, -(-count // _ESTIMATED_FROM))


class Levels(NamedTuple):
    """Mean and standard deviation of the noise before returns, and the mean before outgoing pulses."""

    noise_mean: float
    noise_std: float
    pedestal: float


def levels_of(shots: Iterable[tuple[Sequence[Segment], Sequence[Segment]]]) -> Levels:
    """The levels of shots, each given by its outgoing and its returning segments."""
    before, sent = [], []
    for outgoing, returning in shots:
        before.append(returning[0].values[:QUIET])
        if outgoing:
            sent.append(outgoing[0].values[:QUIET_PULSE].mean())
    mean = float(np.median([values.mean() for values in before])) if before else 0.0
    away = np.abs(np.concatenate(before) - mean) if before else np.zeros(1)
    return Levels(mean, float(STD_PER_MAD * np.median(away)), float(np.median(sent)) if sent else 0.0)


# No Sequence[AirborneShot]: what checks types at run time would read a shot wherever the sequence is passed.
class AirborneShots(Sequence, abc.ABC):
    """The shots of a file, a sequence that reads each when it is asked for.

    `shots[5]` is an `AirborneShot`, `shots[:100]` a list of them. The file is mapped, so it may be larger
    than memory. `read_pulsewaves` and `read_las_waveforms` give it.

    - `path`: the file.
    - `gps_time`: (shots,) s.
    - `anchor`, `direction`: (shots, 3) as in `AirborneShot`.
    - `levels`: mean and standard deviation of the noise, and the pedestal of outgoing pulses: medians of up
      to 1,000 shots, evenly spread.
    - `tables`: (counts,) amplitudes of the counts, by the `table` of a `Segment`. They are not applied.
    - `dropped`: how many points of the file were left out, by reason.

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
        """Where what returns at time 0 comes from."""

    @property
    @abc.abstractmethod
    def direction(self) -> Float[np.ndarray, "shots 3"]:
        """The way of what returns 1 ns later."""

    @abc.abstractmethod
    def _facts(self, index: int) -> dict[str, Any]:
        """What `AirborneShot` needs but for its number and its levels."""

    @functools.cached_property
    def levels(self) -> Levels:
        """Mean and standard deviation of the noise, and the pedestal of outgoing pulses."""
        some = (self._facts(i) for i in range(len(self))[evenly(len(self))])
        return levels_of((facts["outgoing"], facts["returning"]) for facts in some)

    @overload
    def __getitem__(self, index: int) -> AirborneShot: ...
    @overload
    def __getitem__(self, index: slice) -> list[AirborneShot]: ...
    def __getitem__(self, index: int | slice) -> AirborneShot | list[AirborneShot]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        i = range(len(self))[index]
        facts = self._facts(i)
        try:
            return AirborneShot(i, **self.levels._asdict(), **facts)
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from error

    def __iter__(self) -> Iterator[AirborneShot]:
        return (self[i] for i in range(len(self)))

    def __repr__(self) -> str:
        return f"{len(self):,} shots of {self.path.name}"


class ShotStack(NamedTuple):
    """Records of several shots as arrays of one length, for `inversion.gaussian_decomposition` and batches.

    - `time`: (samples,) ns from the first sample of each shot.
    - `signal`: (shots, samples) values less the mean noise; 0 where nothing was recorded.
    - `recorded`: (shots, samples) whether a sample was recorded.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.io import ShotStack
    >>> stack = ShotStack(np.arange(3.0), np.array([[0.0, 80.0, 2.0]]), np.full((1, 3), True))
    >>> noise = np.where(stack.recorded, 1.5, np.inf)
    """

    time: Float[np.ndarray, " samples"]
    signal: Float[np.ndarray, "shots samples"]
    recorded: Bool[np.ndarray, "shots samples"]


def stack_shots(shots: Iterable[AirborneShot]) -> ShotStack:
    """The records of several shots, padded to the longest.

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
    steps = {shot.sampling_interval for shot in shots}
    if len(steps) != 1:
        raise ValueError(f"shots have the sampling intervals {sorted(steps)} ns; admissible is one")
    size = max(shot.recorded.size for shot in shots)
    signal, recorded = np.zeros((len(shots), size)), np.zeros((len(shots), size), bool)
    for row, shot in enumerate(shots):
        signal[row, : shot.recorded.size] = shot.signal
        recorded[row, : shot.recorded.size] = shot.recorded
    return ShotStack(steps.pop() * np.arange(size), signal, recorded)
