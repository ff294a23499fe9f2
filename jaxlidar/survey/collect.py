"""`Waveforms` from the results of a strategy's tasks, in memory or in a store.

A task computes the light, or the truth, of some shots, which are rows of arrays. Where shots are sums of the
contributions of tasks, contributions are kept until all are there, and then summed block of shots by block.
"""

import dataclasses
import itertools
import json
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from jaxlidar._fields.checks import warn_user
from jaxlidar._not_kept import NotKept
from jaxlidar._text import outside_message, unfollowed_message
from jaxlidar.results.case import Case
from jaxlidar.results.datasets import datasets_of
from jaxlidar.results.groups import write_zarr_group
from jaxlidar.results.netcdf import datasets_with_case
from jaxlidar.results.store import ResultStore, consolidate, dataset_of_rows
from jaxlidar.simulation.one_scene import LateLightWarning, UnfollowedLightWarning
from jaxlidar.spectral.apply_optics import make_waveform_model, refuse_excess
from jaxlidar.spectral.truth_class import Truth
from jaxlidar.survey.acquisition import Acquisition
from jaxlidar.survey.results import EXCESS, MISSING_LIGHT, OPTIONAL_ARRAYS
from jaxlidar.survey.shared_illumination import GroupContribution
from jaxlidar.survey.strategy import AbstractStrategy, Shots, SurveyTask
from jaxlidar.survey.waveforms import Waveforms

# The group of a store that has contributions until they are summed, and its number of rows of a chunk.
_CONTRIBUTIONS, _CONTRIBUTIONS_PER_CHUNK = "contributions", 64


class ShotsInMemory:
    """Results of shots in memory.

    - `is_done`: (shots,) True for the shots whose results are there.
    - `values`: results with arrays of `count` rows; None without any result.

    **Arguments:** `hits`: rows of the shots; the others have `fill`. None where all rows are shots.
    """

    def __init__(self, count: int, hits: Int[np.ndarray, " hits"] | None = None, fill: float = 0.0):
        self._count, self._fill = count, fill
        self._rows = np.arange(count) if hits is None else hits
        self.is_done = np.zeros(len(self._rows), bool)
        self.values: Any = None

    def write(self, shots: Shots, results: Any) -> None:
        """Add the results of some shots."""
        if self.values is None:
            self.values = jax.tree.map(
                lambda a: np.full((self._count, *a.shape[1:]), self._fill, a.dtype), results
            )
        for values, of_shots in zip(jax.tree.leaves(self.values), jax.tree.leaves(results), strict=True):
            values[self._rows[shots]] = of_shots
        self.is_done[shots] = True


class StoredShots(NamedTuple):
    """Results of shots in a store: which are there, as in `ShotsInMemory`, and how to add some."""

    is_done: np.ndarray
    write: Callable[[Shots, Any], None]


def _stored_shots(
    is_done: np.ndarray,
    write: Callable[[Shots, Any], None],
    hits: Int[np.ndarray, " hits"] | None,
    fill: float = 0.0,
) -> StoredShots:
    """Return the rows of a store that are shots of a strategy. The others have `fill`, and come first."""
    if hits is None:
        return StoredShots(is_done, write)
    misses = np.setdiff1d(np.arange(len(is_done)), hits)
    # Damaged rows of misses are written again with those of hits.
    hits_done = is_done[hits] & is_done[misses].all()

    def write_all(shots: Shots, results: Any) -> None:
        if not is_done[misses].all():
            write(
                misses, jax.tree.map(lambda a: np.full((len(misses), *a.shape[1:]), fill, a.dtype), results)
            )
        write(hits[shots], results)
        hits_done[shots] = True

    return StoredShots(hits_done, write_all)


class StoredContributions:
    """Contributions of tasks by number, in a store: the rows of a task are its shots."""

    def __init__(self, store: ResultStore, shots_of_tasks: Sequence[Int[np.ndarray, " shots"]]):
        ends = np.cumsum([0, *map(len, shots_of_tasks)]).tolist()
        self._slices = [slice(*pair) for pair in itertools.pairwise(ends)]
        self._rows = store.rows(_CONTRIBUTIONS, "row", ends[-1], _CONTRIBUTIONS_PER_CHUNK)

    def __contains__(self, number: int) -> bool:
        return number < len(self._slices) and bool(np.all(self._rows.is_done[self._slices[number]]))

    def __setitem__(self, number: int, contribution: GroupContribution) -> None:
        arrays = {}
        for field, value in contribution._asdict().items():
            items = value.items() if isinstance(value, dict) else [("", value)]
            arrays |= {f"{field}.{item}": array for item, array in items}
        self._rows.write(self._slices[number], dataset_of_rows("row", arrays))

    def __getitem__(self, number: int) -> GroupContribution:
        fields: dict[str, Any] = {}
        for name, array in self._rows.read(self._slices[number]).items():
            field, _, item = name.partition(".")
            if item:
                fields.setdefault(field, {})[item] = array
            else:
                fields[field] = array
        return GroupContribution(**fields)


@dataclasses.dataclass(frozen=True)
class SurveyResults:
    """Results of the tasks of a strategy.

    - `light`, `truth`: those of shots. - `contributions`: those of tasks, by number.
    """

    strategy: AbstractStrategy
    light: ShotsInMemory | StoredShots
    truth: ShotsInMemory | StoredShots
    contributions: dict[int, GroupContribution] | StoredContributions

    def is_done(self, task: SurveyTask) -> bool:
        """Return True for a task that need not be run."""
        are_done = (self.truth if task.is_truth else self.light).is_done[task.shots]
        return task.unit.number in self.contributions or bool(np.all(are_done))

    def add(self, task: SurveyTask, result: Any) -> None:
        """Add the result of a task."""
        if task.is_truth:
            self.truth.write(task.shots, result)
        elif self.strategy.contribution_sum is None:
            self.light.write(task.shots, result)
        else:
            self.contributions[task.unit.number] = result

    def sum_contributions(self) -> None:
        """Add the light of all shots whose contributions are there."""
        contribution_sum = self.strategy.contribution_sum
        if contribution_sum is None:
            return
        for shots in self.strategy.shot_slices:
            if not np.all(self.light.is_done[shots]):
                self.light.write(shots, contribution_sum(self.contributions.__getitem__, shots))


def waveforms_in_memory(
    results: SurveyResults, survey_fields: dict[str, Any], start_time: float, **info: Any
) -> Waveforms:
    """Return all waveforms from the results of all tasks.

    `survey_fields`: the fields of `Waveforms` that are known before any tracing. `info`: further entries of
    `Waveforms.info`.
    """
    assert isinstance(results.light, ShotsInMemory)
    assert isinstance(results.truth, ShotsInMemory)
    light = results.light.values
    refuse_excess(light[EXCESS])
    _warn_of_missing_light(results.strategy, *(light[name] for name in MISSING_LIGHT))
    fields = {**survey_fields, **_fields_of(light)}
    if results.truth.values is not None:
        fields["truth"] = _truth(results.strategy, results.truth.values)
    return _waveforms(results.strategy, fields, _info(results.strategy, start_time) | info)


class StoredSurvey:
    """The store of a survey, with the layout of `Waveforms`: `jaxlidar.open` reads it when it is finished.

    `survey_fields`: as in `waveforms_in_memory`. `hits`: as in `ShotsInMemory`. `case`: that of the survey.
    """

    def __init__(
        self,
        store: ResultStore,
        strategy: AbstractStrategy,
        tasks: Sequence[SurveyTask],
        survey_fields: dict[str, Any],
        hits: Int[np.ndarray, " hits"] | None,
        case: Case | None,
    ):
        self._store, self._strategy, self._survey_fields, self._case = store, strategy, survey_fields, case
        count, chunk = len(survey_fields["zenith"]), strategy.shot_slices[0].stop
        self._light = store.rows("", "shot", count, chunk)
        light, truth = _stored_shots(self._light.is_done, self._write_light, hits), ShotsInMemory(count)
        self._has_truth = any(task.is_truth for task in tasks)
        if self._has_truth:
            self._truth = store.rows("truth", "shot", count, chunk)
            truth = _stored_shots(self._truth.is_done, self._write_truth, hits, np.nan)
        contributions = {}
        if strategy.contribution_sum is not None:
            of_light: Any = [task.shots for task in tasks if not task.is_truth]
            contributions = StoredContributions(store, of_light)
        if damaged := store.damaged_arrays():
            warn_user(
                f"path = {store.path} is damaged, and these arrays are made again: {', '.join(damaged)}"
            )
            # They are written with the first shots that are traced.
            light.is_done[:chunk] = truth.is_done[:chunk] = False
        self.results = SurveyResults(strategy, light, truth, contributions)

    def _write_light(self, shots: Shots, results: dict[str, Any]) -> None:
        refuse_excess(results[EXCESS])
        fields = {
            # An acquisition is a group of its own, which is written once for all shots.
            name: value if isinstance(value, Acquisition) else value[shots]
            for name, value in self._survey_fields.items()
        }
        waveforms = _waveforms(self._strategy, {**fields, **_fields_of(results)}, {})
        if self._light.has_layout:
            datasets = datasets_of(waveforms)
        else:
            datasets = datasets_with_case(waveforms, self._case)
            for path in datasets.keys() - {"/"}:
                write_zarr_group(self._store.path, path, datasets[path])
        missing_light = {
            name: ("shot", results[name], {"units": "1", "long_name": long_name})
            for name, long_name in MISSING_LIGHT.items()
        }
        dataset = datasets["/"].assign(missing_light)
        # `finish` writes `info`. A truth, which is another task's, is a group and no attribute.
        left_out = {"info", "truth"} if self._has_truth else {"info"}
        dataset.attrs = {name: value for name, value in dataset.attrs.items() if name not in left_out}
        self._light.write(shots, dataset)

    def _write_truth(self, shots: Shots, fields: dict[str, Any]) -> None:
        self._truth.write(shots, datasets_of(_truth(self._strategy, fields), "/truth")["/truth"])

    def finish(self, start_time: float, **info: Any) -> None:
        """Write what is known when all tasks are done."""
        root = self._store.root
        if _CONTRIBUTIONS in root:
            del root[_CONTRIBUTIONS]
        # A store that was finished before stays as it is, but for chunks that were damaged.
        if "info" not in root.attrs:
            _warn_of_missing_light(self._strategy, *(root[name][:] for name in MISSING_LIGHT))
            root.attrs["info"] = json.dumps(_info(self._strategy, start_time) | info, default=float)
        consolidate(self._store.path)


def _info(strategy: AbstractStrategy, start_time: float) -> dict[str, Any]:
    """Return the entries of `Waveforms.info`."""
    altitude = strategy.setup.lidar.altitude
    return {
        "rtol": strategy.rtol,
        "orders": strategy.setup.plan.orders,
        "altitude": None if altitude is None else float(altitude),
        "seconds": time.perf_counter() - start_time,
        **strategy.info(),
    }


def _truth(strategy: AbstractStrategy, fields: dict[str, Any]) -> Truth:
    """Return the truth of shots from its other fields."""
    time: Any = np.asarray(make_waveform_model(strategy.setup).time)
    return Truth(time=time, **fields)


def _fields_of(light: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of `Waveforms` among results; arrays that are not kept are `NotKept`."""
    not_kept = {name: NotKept(name) for name in OPTIONAL_ARRAYS if name not in light}
    return not_kept | {name: a for name, a in light.items() if name not in (*MISSING_LIGHT, EXCESS)}


def _waveforms(strategy: AbstractStrategy, fields: dict[str, Any], info: dict[str, Any]) -> Waveforms:
    return Waveforms(
        time=np.asarray(make_waveform_model(strategy.setup).time),
        wavelength=np.asarray(strategy.setup.lidar.wavelength),
        **fields,
        info=info,
    )


def _warn_of_missing_light(strategy: AbstractStrategy, outside: np.ndarray, unfollowed: np.ndarray) -> None:
    """Warn if more light than the tolerance is after the record, or may be in orders that were not followed.

    `outside`, `unfollowed`: (shots,), as in `MISSING_LIGHT`.
    """
    plan = strategy.setup.plan
    most_outside, most_unfollowed = (float(np.max(a, initial=0.0)) for a in (outside, unfollowed))
    if plan.scope.automatic_orders and most_unfollowed > strategy.rtol:
        warn_user(unfollowed_message(plan.orders, most_unfollowed), UnfollowedLightWarning)
    if most_outside > strategy.rtol:
        warn_user(outside_message(most_outside, plan.record_end, "see Waveforms.neglected"), LateLightWarning)
