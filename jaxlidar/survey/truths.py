"""Truth of the shots of a survey: reference quantities of what each beam meets in the scene."""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from jaxlidar._jax.programs import Program
from jaxlidar._jax.workers import WorkUnit, task
from jaxlidar.simulation.truth import compute_labels, first_order_setup
from jaxlidar.survey.per_shot import (
    ShotGeometry,
    SurveyContext,
    make_survey_context,
    map_first_shots,
    shot_geometry,
    shots_to_trace,
)
from jaxlidar.survey.strategy import AbstractStrategy, ContributionSum, Shots, without_padding

# Fields of `Truth` with an axis of samples.
_SAMPLED_FIELDS = (
    "height",
    "returns",
    "gap_probability",
    "leaf_area_density",
    "bark_area_density",
    "plant_area_index",
)


@dataclasses.dataclass(frozen=True)
class StrategyWithTruth(AbstractStrategy):
    """A strategy that traces light, and the truth of all shots.

    After the tasks of `light_strategy`, there is one for the truth of each of its blocks of shots.
    """

    light_strategy: AbstractStrategy

    @staticmethod
    def around(light: AbstractStrategy) -> "StrategyWithTruth":
        """Return a strategy that traces light, with the truth of its shots."""
        return StrategyWithTruth(light.setup, light.survey, light.rtol, light.kept_names, light)

    @property
    def shot_slices(self) -> list[slice]:
        return self.light_strategy.shot_slices

    def tasks(self, key: PRNGKeyArray) -> list[WorkUnit]:
        return [*self.light_strategy.tasks(key), *self.truth_tasks(key)]

    def truth_tasks(self, key: PRNGKeyArray) -> list[WorkUnit]:
        """Return the tasks for the truth alone. They draw no random numbers: `key` is passed on unused."""
        context, n_samples = make_survey_context(first_order_setup(self.setup)), self.setup.plan.n_samples
        return [
            task(
                number,
                truths_of_chunk,
                (context, shot_geometry(self.survey, shots.start, shots.stop - shots.start), n_samples),
                key,
            )
            for number, shots in enumerate(self.shot_slices, self.light_strategy.n_tasks)
        ]

    @property
    def n_tasks(self) -> int:
        return self.light_strategy.n_tasks + len(self.shot_slices)

    @property
    def n_light_tasks(self) -> int:
        return self.light_strategy.n_tasks

    @property
    def contribution_sum(self) -> ContributionSum | None:
        return self.light_strategy.contribution_sum

    def shots_of_task(self, number: int) -> Shots:
        n_light = self.n_light_tasks
        return (
            self.light_strategy.shots_of_task(number)
            if number < n_light
            else self.shot_slices[number - n_light]
        )

    def results_of_task(self, number: int, result: Any) -> Any:
        n_light = self.n_light_tasks
        if number < n_light:
            return self.light_strategy.results_of_task(number, result)
        return result

    def info(self) -> dict[str, Any]:
        return self.light_strategy.info()


def truths_of_chunk(
    context: SurveyContext, shots: ShotGeometry, n_samples: int, key: PRNGKeyArray
) -> dict[str, Any]:
    """Return the fields of the `Truth` of a chunk of shots but `time`; no random numbers are drawn."""
    # The truth is that of the first order with a fixed key: `key` is unused, as every task has one.
    n_shots = len(shots.number)
    fields = _compiled_truths(
        context,
        shots.padded_to(shots_to_trace(n_shots)).in_precision(),
        np.int32(n_shots),
    )
    return without_padding(fields, n_shots, n_samples, _SAMPLED_FIELDS)


def _truths_of_shots(context: SurveyContext, shots: ShotGeometry, count: Array) -> dict[str, Any]:
    """Return the fields of `Truth` but `time` for the first `count` shots, over one device scene."""

    def truth_of_shot(shot: ShotGeometry) -> dict[str, Any]:
        aimed = context.aim(shot, jax.random.key(0))
        fields = dict(vars(compute_labels(aimed.scene, aimed.model)))
        # All shots share it.
        del fields["time"]
        return fields

    return map_first_shots(truth_of_shot, shots, count)


_compiled_truths = Program(_truths_of_shots, one_core=True)
