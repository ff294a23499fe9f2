"""Truth of the shots of a survey: reference quantities of what each beam meets in the scene."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from jaxlidar._jax.programs import Program
from jaxlidar._jax.workers import task
from jaxlidar.simulation.truth import compute_labels, first_order_setup
from jaxlidar.survey.per_shot import (
    ShotGeometry,
    SurveyContext,
    make_survey_context,
    map_first_shots,
    shot_geometry,
    shots_to_trace,
)
from jaxlidar.survey.strategy import AbstractStrategy, SurveyTask, without_padding

# Fields of `Truth` with an axis of samples.
_SAMPLED_FIELDS = (
    "height",
    "returns",
    "gap_probability",
    "leaf_area_density",
    "bark_area_density",
    "plant_area_index",
)


def truth_tasks(strategy: AbstractStrategy, key: PRNGKeyArray, first: int = 0) -> list[SurveyTask]:
    """Return tasks that find the truth of a strategy's blocks of shots, numbered from `first` on.

    They draw no random numbers: `key` is passed on unused.
    """
    setup, tasks = strategy.setup, []
    context = make_survey_context(first_order_setup(setup))
    for number, shots in enumerate(strategy.shot_slices, first):
        geometry = shot_geometry(strategy.survey, shots.start, shots.stop - shots.start)
        unit = task(number, truths_of_chunk, (context, geometry, setup.plan.n_samples), key)
        tasks.append(SurveyTask(unit, shots, is_truth=True))
    return tasks


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
