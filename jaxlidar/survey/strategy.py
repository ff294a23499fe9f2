"""The interface of strategies: a survey as tasks, and the results of its shots from those of tasks."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import numpy as np
from jaxtyping import Int, PRNGKeyArray

from jaxlidar._workers import WorkUnit
from jaxlidar.instrument.survey import Survey
from jaxlidar.planning.setup import Setup
from jaxlidar.survey.results import ShotResults

# Shots of a task: a slice, or their numbers.
Shots: TypeAlias = slice | Int[np.ndarray, " shots"]


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
    def n_light_tasks(self) -> int:
        """Number of tasks that trace light; those after them find the truth. Default: all."""
        return self.n_tasks

    @property
    def n_contributions(self) -> int:
        """Number of tasks, the first ones, of which shots are sums (`sum_contributions`). Default: none."""
        return 0

    @property
    @abc.abstractmethod
    def shot_slices(self) -> list[slice]:
        """Blocks of shots that are completed or stored together; all but the last are of one size."""

    @abc.abstractmethod
    def shots_of_task(self, number: int) -> Shots:
        """Return the shots of a task: their numbers, or a slice."""

    def results_of_task(self, number: int, result: Any) -> Any:
        """Return the results of exactly the shots of a task, a `ShotResults` or `Truths`, from its own."""
        return result

    def sum_contributions(self, contribution_of: Callable[[int], Any], shots: slice) -> ShotResults:
        """Return the results of one of `shot_slices`; `contribution_of` gives the contribution of a task."""
        raise NotImplementedError("no task is a contribution")

    @abc.abstractmethod
    def info(self) -> dict[str, Any]:
        """Return the strategy's entries of `Waveforms.info`."""


def slices_of_shots(shots: int, size: int) -> list[slice]:
    """Return slices of `size` shots; the last one may be shorter."""
    return [slice(first, min(first + size, shots)) for first in range(0, shots, size)]


def first_rows(results: Any, shots: slice) -> Any:
    """Return the results of a slice of shots, without the copies that fill up the last chunk."""
    return jax.tree.map(lambda a: a[: shots.stop - shots.start], results)
