"""Two ways to trace many shots, as tasks: one by one, or with light that they share."""

import abc
import dataclasses
import functools
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxlidar._workers import Task, task
from jaxlidar.instrument.survey import Survey
from jaxlidar.planning.setup import Setup
from jaxlidar.survey.records import Record
from jaxlidar.survey.shared import TOGETHER, Part, Ready, ready_for, record_of, trace_tile
from jaxlidar.survey.sharing import Sharing
from jaxlidar.survey.shots import Aim, aims_of, several

# Shots of one chunk, with one order and with more; a chunk cannot be interrupted.
_CHUNKS = 128, 16


@dataclasses.dataclass(frozen=True)
class AbstractWay(abc.ABC):
    """The shots of a survey, cut into tasks.

    - `setup`: of the survey's middle. - `survey`: about that place. - `rtol`: relative error aimed at.
    """

    setup: Setup
    survey: Survey
    rtol: float

    @abc.abstractmethod
    def tasks(self, key: PRNGKeyArray) -> list[Task]:
        """The tasks, each of which gives a `result`."""

    @property
    @abc.abstractmethod
    def count(self) -> int:
        """Number of tasks."""

    @property
    @abc.abstractmethod
    def slices(self) -> list[slice]:
        """The shots of each record, all but the last as many."""

    @abc.abstractmethod
    def kind_of(self, number: int) -> Any:
        """The class of a task's result: its fields are arrays, or dicts of arrays."""

    @abc.abstractmethod
    def records(self, results: Mapping[int, Any]) -> Iterator[tuple[slice, Record]]:
        """The records of all `slices`, from the results of all tasks by number."""

    @abc.abstractmethod
    def described(self) -> dict[str, Any]:
        """What `Waveforms.info` says of it."""


@dataclasses.dataclass(frozen=True)
class OneByOne(AbstractWay):
    """Every shot has photons of its own."""

    @property
    def chunk(self) -> int:
        """Shots of one chunk; it depends on the survey and the plan alone."""
        shots = len(self.survey)
        most = min(_CHUNKS[self.setup.plan.orders > 1], max(1, shots // 8))
        return -(-shots // -(-shots // most))

    def tasks(self, key: PRNGKeyArray) -> list[Task]:
        each = (aims_of(self.survey, shots.start, self.chunk) for shots in self.slices)
        given = [(self.setup, aims, self.rtol) for aims in each]
        return [task(number, trace_chunk, one, key) for number, one in enumerate(given)]

    @property
    def count(self) -> int:
        return len(self.slices)

    @property
    def slices(self) -> list[slice]:
        return _slices(len(self.survey), self.chunk)

    def kind_of(self, number: int) -> type[Record]:
        return Record

    def records(self, results: Mapping[int, Any]) -> Iterator[tuple[slice, Record]]:
        for number, shots in enumerate(self.slices):
            yield shots, jax.tree.map(lambda a, n=shots.stop - shots.start: a[:n], results[number])

    def described(self) -> dict[str, Any]:
        return {"shared": False}


@dataclasses.dataclass(frozen=True)
class SharedLight(AbstractWay):
    """Shots are sums over nodes, of which each tile has some."""

    sharing: Sharing

    @functools.cached_property
    def ready(self) -> Ready:
        """What all tiles have in common."""
        return ready_for(self.setup, self.sharing.spacing, self.sharing.views)

    def tasks(self, key: PRNGKeyArray) -> list[Task]:
        return [
            task(number, trace_tile, (self.ready, tile, number, self.rtol), key)
            for number, tile in enumerate(self.sharing.tiles)
        ]

    @property
    def count(self) -> int:
        return len(self.sharing.tiles)

    @property
    def slices(self) -> list[slice]:
        return _slices(len(self.survey), TOGETHER)

    def kind_of(self, number: int) -> type[Part]:
        return Part

    def records(self, results: Mapping[int, Any]) -> Iterator[tuple[slice, Record]]:
        for shots in self.slices:
            tiles, low, high = enumerate(self.sharing.tiles), shots.start, shots.stop
            among = [n for n, tile in tiles if np.any((tile.shots >= low) & (tile.shots < high))]
            yield shots, record_of(self.ready, (results[n] for n in among), shots)

    def described(self) -> dict[str, Any]:
        return {
            "shared": True,
            "grid": self.sharing.spacing,
            "parallel light": self.sharing.parallel,
        }


def _slices(shots: int, size: int) -> list[slice]:
    return [slice(first, min(first + size, shots)) for first in range(0, shots, size)]


def trace_chunk(setup: Setup, aims: Aim, rtol: float, key: PRNGKeyArray) -> Record:
    """The records of a chunk of shots."""
    return several(setup, aims.as_arrays(), key, jnp.asarray(rtol))
