"""The interface of strategies: a survey as tasks, and the results of its shots from those of tasks."""

import abc
import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

from jaxtyping import PRNGKeyArray

from jaxlidar._workers import WorkUnit
from jaxlidar.instrument.survey import Survey
from jaxlidar.planning.setup import Setup
from jaxlidar.survey.results import ShotResults


@dataclasses.dataclass(frozen=True)
class AbstractStrategy(abc.ABC):
    """A strategy to trace the shots of a survey.

    Tasks are independent of one another, so that any process may do them, in any order, now or in a later
    run.

    - `setup`: that of the middle of the survey, or of the first tile of a tiled scene.
    - `survey`: relative to the setup's origin of coordinates; over a tiled scene, in map coordinates.
    - `rtol`: relative error to reach.
    - `kept_names`: those of `OPTIONAL_ARRAYS` that results have.
    """

    setup: Setup
    survey: Survey
    rtol: float
    kept_names: tuple[str, ...]

    @abc.abstractmethod
    def tasks(self, key: PRNGKeyArray) -> list[WorkUnit]:
        """Return the tasks, numbered from zero."""

    @property
    @abc.abstractmethod
    def n_tasks(self) -> int:
        """Number of tasks."""

    @property
    @abc.abstractmethod
    def shot_slices(self) -> list[slice]:
        """Shots of each block of results; all blocks but the last are of one size."""

    @abc.abstractmethod
    def result_class(self, number: int) -> Any:
        """Return the class of a task's result, whose fields are arrays or dicts of arrays."""

    @abc.abstractmethod
    def shot_results(self, task_results: Mapping[int, Any]) -> Iterator[tuple[slice, ShotResults]]:
        """Yield the results of all `shot_slices`, from the results of all tasks by number."""

    @abc.abstractmethod
    def info(self) -> dict[str, Any]:
        """Return the strategy's entries of `Waveforms.info`."""


def slices_of_shots(shots: int, size: int) -> list[slice]:
    """Return slices of `size` shots; the last one may be shorter."""
    return [slice(first, min(first + size, shots)) for first in range(0, shots, size)]
