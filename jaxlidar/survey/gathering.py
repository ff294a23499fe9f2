"""`Waveforms` of what tasks gave: in memory, or in a file, where few shots are in memory at a time."""

import dataclasses
import itertools
import os
import time
import warnings
from collections.abc import Iterator, Mapping, MutableMapping
from typing import Any

import jax
import numpy as np

from jaxlidar._summary import NOTABLE_FRACTION, percent
from jaxlidar.io.case import Case
from jaxlidar.io.checkpoint import Checkpoint
from jaxlidar.io.netcdf import by_rows
from jaxlidar.io.rows import blank
from jaxlidar.simulate import LateLightWarning
from jaxlidar.spectral.apply_optics import make_waveform_model
from jaxlidar.survey.records import Record
from jaxlidar.survey.waveforms import Waveforms
from jaxlidar.survey.ways import AbstractWay


class StoredResults(MutableMapping[int, Any]):
    """Results of a survey's tasks by number, in a checkpoint."""

    def __init__(self, checkpoint: Checkpoint, way: AbstractWay):
        self.checkpoint, self.way = checkpoint, way
        # Every entry is read once here: damaged ones are traced again with the missing ones.
        self.numbers = {number for number, _ in checkpoint.intact_entries(self._decode)}

    def _decode(self, number: int, arrays: Mapping[str, np.ndarray]) -> Any:
        if not 0 <= number < self.way.count:
            raise ValueError(f"its number is outside the admissible range [0, {self.way.count - 1}]")
        return _from_arrays(self.way.kind_of(number), arrays)

    def __len__(self) -> int:
        return len(self.numbers)

    def __iter__(self) -> Iterator[int]:
        return iter(sorted(self.numbers))

    def __contains__(self, number: object) -> bool:
        return number in self.numbers

    def __getitem__(self, number: int) -> Any:
        return _from_arrays(self.way.kind_of(number), self.checkpoint.read(number))

    def __setitem__(self, number: int, result: Any) -> None:
        self.checkpoint.add(number, _as_arrays(result))
        self.numbers.add(number)

    def __delitem__(self, number: int) -> None:
        raise TypeError("results in a checkpoint are not deleted")


def in_memory(
    way: AbstractWay, known: dict[str, Any], results: Mapping[int, Any], started: float
) -> Waveforms:
    """All waveforms. `known` has the fields that are known before any tracing."""
    each = [record for _, record in way.records(results)]
    record: Record = jax.tree.map(lambda *some: np.concatenate(some), *each)
    _say_what_is_late(way, float(np.max(record.energy_budget["after the window"], initial=0.0)))
    return _waveforms(way, {**known, **record._asdict()}, started)


def on_disk(
    way: AbstractWay,
    known: dict[str, Any],
    results: Mapping[int, Any],
    started: float,
    path: str | os.PathLike[str],
    problem: dict[str, str],
    case: Case | None,
) -> Waveforms:
    """All waveforms, written to a file, with their case if there is one, and opened."""
    each, late = way.records(results), 0.0
    first = next(each)
    empty = jax.tree.map(lambda a: blank(len(way.survey), a), first[1]._asdict())
    with by_rows(_waveforms(way, {**known, **empty}, started, problem=problem), path, case) as rows:
        for shots, record in itertools.chain([first], each):
            rows.add(shots, {**{name: a[shots] for name, a in known.items()}, **record._asdict()})
            late = max(late, float(np.max(record.energy_budget["after the window"])))
    _say_what_is_late(way, late)
    return Waveforms.open(path)


def _waveforms(way: AbstractWay, fields: dict[str, Any], started: float, **info: Any) -> Waveforms:
    return Waveforms(
        time=np.asarray(make_waveform_model(way.setup).time),
        wavelength=np.asarray(way.setup.lidar.wavelength),
        **fields,
        info={
            "rtol": way.rtol,
            "orders": way.setup.plan.orders,
            "seconds": time.perf_counter() - started,
            **way.described(),
            **info,
        },
    )


def _say_what_is_late(way: AbstractWay, late: float) -> None:
    plan = way.setup.plan
    if late >= NOTABLE_FRACTION:
        end = plan.sample_start + plan.sample_interval * plan.n_samples
        warnings.warn(
            f"{percent(late)} of the light of a shot is still on its way when the record ends at "
            f"{end:.4g} ns: see Waveforms.energy_budget",
            LateLightWarning,
            stacklevel=4,
        )


def _as_arrays(result: Any) -> dict[str, np.ndarray]:
    """The arrays of a result by name: those of a dict are named "field/item", what is None is left out."""
    arrays, fields = {}, vars(result) if dataclasses.is_dataclass(result) else result._asdict()
    for field, value in fields.items():
        if isinstance(value, dict):
            # A dict without items has a name of its own.
            arrays |= {f"{field}/{item}": array for item, array in value.items()} or {
                f"{field}/": np.empty(0)
            }
        elif value is not None:
            arrays[field] = value
    return arrays


def _from_arrays(kind: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """The result of that kind, from what `_as_arrays` gave."""
    fields: dict[str, Any] = {}
    for name, array in arrays.items():
        field, within, item = name.partition("/")
        if not within:
            fields[field] = array
        else:
            fields.setdefault(field, {}).update({item: array} if item else {})
    return kind(**fields)
