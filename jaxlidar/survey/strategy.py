"""The interface of strategies: a survey as tasks, and the results of its shots from those of tasks."""

import abc
import dataclasses
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np
from jaxtyping import Int, PRNGKeyArray

from jaxlidar._jax.workers import WorkUnit
from jaxlidar.planning.setup import Setup
from jaxlidar.sensors.survey import Survey

# Shots of a task: a slice, or their numbers.
Shots: TypeAlias = slice | Int[np.ndarray, " shots"]
# The results of one of `shot_slices`, from a function that gives the contribution of a task.
ContributionSum: TypeAlias = Callable[[Callable[[int], Any], slice], dict[str, Any]]


class SurveyTask(NamedTuple):
    """A task: a unit of work, whose number is its place among all tasks, and the shots that it is about.

    Its results are the light of these shots, or what it contributes to that; or the fields of their truth but
    `time`.
    """

    unit: WorkUnit
    shots: Shots
    is_truth: bool = False


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
    def tasks(self, key: PRNGKeyArray) -> list[SurveyTask]:
        """Return the tasks that trace light."""

    @property
    @abc.abstractmethod
    def contribution_sum(self) -> ContributionSum | None:
        """Sum over tasks that gives the light of shots; None where each shot is one task's."""

    @property
    @abc.abstractmethod
    def shot_slices(self) -> list[slice]:
        """Blocks of shots that are completed or stored together; all but the last are of one size."""

    @abc.abstractmethod
    def info(self) -> dict[str, Any]:
        """Return the strategy's entries of `Waveforms.info`."""


def slices_of_shots(shots: int, size: int) -> list[slice]:
    """Return slices of `size` shots; the last one may be shorter."""
    return [slice(first, min(first + size, shots)) for first in range(0, shots, size)]


def without_padding(
    fields: Mapping[str, Any], n_shots: int, n_samples: int, sampled_names: Collection[str]
) -> dict[str, Any]:
    """Return results of shots, on the host, without what fills up the sizes of a compiled program.

    **Arguments:** `fields`: arrays, or dicts of arrays, with shots along axis 0. `sampled_names`: those whose
    last axis is samples.
    """
    rows = jax.tree.map(lambda a: np.asarray(a)[:n_shots], dict(fields))
    sampled = {name: rows[name] for name in sampled_names if name in rows}
    return rows | jax.tree.map(lambda a: a[..., :n_samples], sampled)
