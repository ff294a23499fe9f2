"""Truth of the shots of a survey: reference quantities of what each beam meets in the scene."""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxlidar._jax.programs import Program
from jaxlidar._jax.threads import ONE_CORE
from jaxlidar._jax.workers import WorkUnit, task
from jaxlidar.planning.setup import Setup
from jaxlidar.simulation.truth import compute_labels, first_order_setup
from jaxlidar.spectral.apply_optics import make_waveform_model
from jaxlidar.survey.per_shot import ShotGeometry, aim_offset, setup_of_shot, shot_geometry
from jaxlidar.survey.strategy import AbstractStrategy, ContributionSum, Shots, first_rows
from jaxlidar.trace.device_scene import DeviceScene, aim_at, build_device_scene


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
        # All are as large as the first, for one program; the last one is filled up.
        size = self.shot_slices[0].stop
        return [
            task(number, truths_of_chunk, (self.setup, shot_geometry(self.survey, shots.start, size)), key)
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
        return first_rows(result, self.shot_slices[number - n_light])

    def info(self) -> dict[str, Any]:
        return self.light_strategy.info()


def truths_of_chunk(setup: Setup, shots: ShotGeometry, key: PRNGKeyArray) -> dict[str, Any]:
    """Return the fields of the `Truth` of a chunk of shots but `time`; no random numbers are drawn."""
    # The truth is that of the first order with a fixed key: `key` is unused, as every task has one.
    fields = _compiled_truths(first_order_setup(setup), shots.in_precision())
    return jax.tree.map(np.asarray, fields)


def _truth_of_shot(scene: DeviceScene, setup: Setup, shot: ShotGeometry) -> dict[str, Any]:
    """Return the fields of `Truth` for one shot but `time`, which all shots share."""
    offset = aim_offset(setup, shot)
    setup = setup_of_shot(setup, shot)
    scene = aim_at(scene, setup.lidar, offset)
    fields = dict(vars(compute_labels(scene, make_waveform_model(setup))))
    del fields["time"]
    return fields


def _truths_of_shots(setup: Setup, shots: ShotGeometry) -> dict[str, Any]:
    """Return the fields of `Truth` but `time` for shots one after the other, over one device scene."""
    scene = build_device_scene(setup)
    return jax.lax.map(lambda shot: _truth_of_shot(scene, setup, shot), shots)


_compiled_truths = Program(_truths_of_shots, **ONE_CORE)
