"""Truth for all shots of a survey: tasks of their own, beside those that trace light."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxlidar._programs import Program
from jaxlidar._threads import ONE_CORE
from jaxlidar._workers import Task, task
from jaxlidar.planning.setup import Setup
from jaxlidar.spectral.apply_optics import make_waveform_model
from jaxlidar.survey.records import Record
from jaxlidar.survey.shots import Aim, aimed_at, aims_of
from jaxlidar.survey.truths import Truths
from jaxlidar.survey.ways import AbstractWay
from jaxlidar.trace.device_scene import DeviceScene, aim_at, build_device_scene
from jaxlidar.truth import compute_labels, first_order_setup


@dataclasses.dataclass(frozen=True)
class WithTruth(AbstractWay):
    """Another way, and the truth of all shots: after the tasks of that way, one for each of its slices."""

    way: AbstractWay

    @property
    def slices(self) -> list[slice]:
        return self.way.slices

    def tasks(self, key: PRNGKeyArray) -> list[Task]:
        found, size = self.way.tasks(key), self.slices[0].stop
        for number, shots in enumerate(self.slices, self.way.count):
            aims = aims_of(self.survey, shots.start, size)
            found.append(task(number, truths_of_chunk, (self.setup, aims), key))
        return found

    @property
    def count(self) -> int:
        return self.way.count + len(self.slices)

    def kind_of(self, number: int) -> Any:
        return self.way.kind_of(number) if number < self.way.count else Truths

    def records(self, results: Mapping[int, Any]) -> Iterator[tuple[slice, Record]]:
        for number, (shots, record) in enumerate(self.way.records(results), self.way.count):
            some = slice(shots.stop - shots.start)
            yield shots, record._replace(truth=jax.tree.map(lambda a, s=some: a[s], results[number]))

    def described(self) -> dict[str, Any]:
        return self.way.described()


def truths_of_chunk(setup: Setup, aims: Aim, key: PRNGKeyArray) -> Truths:
    """The truth of a chunk of shots; nothing is drawn."""
    known = _several(first_order_setup(setup), aims.as_arrays())
    return Truths(**jax.tree.map(np.asarray, known))


def _one(scene: DeviceScene, setup: Setup, aim: Aim) -> dict[str, Any]:
    by = jnp.asarray(aim.position) - setup.lidar.position
    setup = aimed_at(setup, aim)
    scene = aim_at(scene, setup.lidar, by)
    known = vars(compute_labels(scene, make_waveform_model(setup)))
    return {f.name: known[f.name] for f in dataclasses.fields(Truths)}


def _of_shots(setup: Setup, aims: Aim) -> dict[str, Any]:
    """Some shots, one after the other."""
    scene = build_device_scene(setup)
    return jax.lax.map(lambda aim: _one(scene, setup, aim), aims)


_several = Program(_of_shots, **ONE_CORE)
