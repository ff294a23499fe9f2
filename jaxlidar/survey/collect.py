"""`Waveforms` from the results of a strategy's tasks, in memory or, a few shots at a time, in a file."""

import dataclasses
import itertools
import os
import time
from collections.abc import Iterator, Mapping, MutableMapping
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxlidar._checks import warn_user
from jaxlidar._summary import NOTABLE_FRACTION, percent, unfollowed_message
from jaxlidar.io.case import Case
from jaxlidar.io.checkpoint import Checkpoint
from jaxlidar.io.netcdf import by_rows
from jaxlidar.io.rows import unwritten_rows
from jaxlidar.simulate import LateLightWarning, UnfollowedLightWarning
from jaxlidar.spectral.apply_optics import make_waveform_model, refuse_excess
from jaxlidar.survey.acquisition import Acquisition
from jaxlidar.survey.results import ShotResults
from jaxlidar.survey.strategy import AbstractStrategy
from jaxlidar.survey.waveforms import Waveforms


class StoredResults(MutableMapping[int, Any]):
    """Results of a survey's tasks by number, in a checkpoint."""

    def __init__(self, checkpoint: Checkpoint, strategy: AbstractStrategy):
        self.checkpoint, self.strategy = checkpoint, strategy
        # Every entry is read once here: damaged ones are traced again with the missing ones.
        self.numbers = {number for number, _ in checkpoint.intact_entries(self._decode)}

    def _decode(self, number: int, arrays: Mapping[str, np.ndarray]) -> Any:
        if not 0 <= number < self.strategy.n_tasks:
            raise ValueError(f"its number is outside the admissible range [0, {self.strategy.n_tasks - 1}]")
        return _from_arrays(self.strategy.result_class(number), arrays)

    def __len__(self) -> int:
        return len(self.numbers)

    def __iter__(self) -> Iterator[int]:
        return iter(sorted(self.numbers))

    def __contains__(self, number: object) -> bool:
        return number in self.numbers

    def __getitem__(self, number: int) -> Any:
        return _from_arrays(self.strategy.result_class(number), self.checkpoint.read(number))

    def __setitem__(self, number: int, result: Any) -> None:
        self.checkpoint.add(number, _as_arrays(result))
        self.numbers.add(number)

    def __delitem__(self, number: int) -> None:
        raise TypeError("results in a checkpoint are not deleted")


def waveforms_in_memory(
    strategy: AbstractStrategy,
    survey_fields: dict[str, Any],
    task_results: Mapping[int, Any],
    start_time: float,
    **info: Any,
) -> Waveforms:
    """Return all waveforms.

    `survey_fields`: the fields of `Waveforms` that are known before any tracing. `info`: further entries of
    `Waveforms.info`.
    """
    # Blocks come in the order of shots.
    blocks = [results for _, results in strategy.shot_results(task_results)]
    results: ShotResults = jax.tree.map(lambda *a: np.concatenate(a), *blocks)
    refuse_excess(results.excess)
    _warn_of_missing_light(strategy, _MissingLight.of(results))
    return _waveforms(strategy, {**survey_fields, **results.waveform_fields()}, start_time, **info)


def waveforms_on_disk(
    strategy: AbstractStrategy,
    survey_fields: dict[str, Any],
    task_results: Mapping[int, Any],
    start_time: float,
    path: str | os.PathLike[str],
    case: Case | None,
    **info: Any,
) -> Waveforms:
    """Write all waveforms to a file, block of shots by block, with their case if there is one, and open it.

    `info`: further entries of `Waveforms.info`.
    """
    blocks, missing = strategy.shot_results(task_results), _MissingLight()
    first_shots, first_results = next(blocks)
    # The file is laid out before its rows are known: from the shapes of the first block.
    empty = jax.tree.map(lambda a: unwritten_rows(len(strategy.survey), a), first_results.waveform_fields())
    layout = _waveforms(strategy, {**survey_fields, **empty}, start_time, **info)
    with by_rows(layout, path, case) as rows:
        # One block of results is in memory at a time, whatever the number of shots.
        for shots, results in itertools.chain([(first_shots, first_results)], blocks):
            refuse_excess(results.excess)
            fields = {name: _rows(value, shots) for name, value in survey_fields.items()}
            rows.add(shots, {**fields, **results.waveform_fields()})
            missing = missing.or_more(_MissingLight.of(results))
    _warn_of_missing_light(strategy, missing)
    return Waveforms.open(path)


def _rows(value: Any, shots: slice) -> Any:
    """Return the rows of some shots: of an array, or of the fields of an `Acquisition` that have rows."""
    if not isinstance(value, Acquisition):
        return value[shots]
    columns = ("gps_time", "scan_angle", "flight_line", "range_at_time_zero")
    return dataclasses.replace(value, **{name: getattr(value, name)[shots] for name in columns})


def _waveforms(
    strategy: AbstractStrategy, fields: dict[str, Any], start_time: float, **info: Any
) -> Waveforms:
    altitude = strategy.setup.lidar.altitude
    return Waveforms(
        time=np.asarray(make_waveform_model(strategy.setup).time),
        wavelength=np.asarray(strategy.setup.lidar.wavelength),
        **fields,
        info={
            "rtol": strategy.rtol,
            "orders": strategy.setup.plan.orders,
            "altitude": None if altitude is None else float(altitude),
            "seconds": time.perf_counter() - start_time,
            **strategy.info(),
            **info,
        },
    )


class _MissingLight(NamedTuple):
    """Largest fractions of all shots of light that waveforms lack; see `ShotResults`."""

    late: float = 0.0
    unfollowed: float = 0.0

    @staticmethod
    def of(results: ShotResults) -> "_MissingLight":
        """Return the missing light of some shots."""
        return _MissingLight(*(float(np.max(a, initial=0.0)) for a in (results.late, results.unfollowed)))

    def or_more(self, second: "_MissingLight") -> "_MissingLight":
        """Return the larger of each fraction."""
        return _MissingLight(*map(max, self, second))


def _warn_of_missing_light(strategy: AbstractStrategy, missing: _MissingLight) -> None:
    """Warn if much light of a shot is after the record, or may be in orders that were not followed."""
    plan = strategy.setup.plan
    if plan.scope.automatic_orders and missing.unfollowed > strategy.rtol:
        warn_user(unfollowed_message(plan.orders, missing.unfollowed), UnfollowedLightWarning)
    if missing.late >= NOTABLE_FRACTION:
        end = plan.sample_start + plan.sample_interval * plan.n_samples
        warn_user(
            f"{percent(missing.late)} of the light of a shot is still on its way when the record ends at "
            f"{end:.4g} ns: see Waveforms.energy_budget",
            LateLightWarning,
        )


def _as_arrays(result: Any) -> dict[str, np.ndarray]:
    """Return the arrays of a result by name.

    Those of a dict are named "field/item", and a dict without items has the name "field/" and an empty array.
    Fields that are None are left out.
    """
    arrays, fields = {}, vars(result) if dataclasses.is_dataclass(result) else result._asdict()
    for field, value in fields.items():
        if isinstance(value, dict):
            # Files of arrays know no dicts: without a name of its own, an empty one would be lost.
            items = {f"{field}/{item}": array for item, array in value.items()}
            arrays |= items or {f"{field}/": np.empty(0)}
        elif value is not None:
            arrays[field] = value
    return arrays


def _from_arrays(result_class: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Return the result of that class from its arrays, the inverse of `_as_arrays`."""
    fields: dict[str, Any] = {}
    for name, array in arrays.items():
        field, slash, item = name.partition("/")
        if not slash:
            fields[field] = array
        else:
            fields.setdefault(field, {}).update({item: array} if item else {})
    return result_class(**fields)
