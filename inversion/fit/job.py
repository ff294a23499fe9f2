"""The fits of many footprints: side by side in lanes of this process, or in chunks by the workers of an
executor. A footprint's fit is the same either way.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from typing import Any

import jax
import optimistix as optx
from jaxtyping import PRNGKeyArray

from inversion.fit.checkpoint import Row, row_of
from inversion.fit.data import Data
from inversion.fit.lanes import Lanes, Simulator
from inversion.fit.retrieval import fits_from
from inversion.fit.solver import Fitting, Request
from inversion.fit.starts import best_of
from inversion.fit.unknowns import Settled
from inversion.receiver.recorder import Recorder, RecorderModel
from jaxlidar import Lidar, Plan, Scene
from jaxlidar.extend import outcomes, task

# Fits that a worker does in turn in one lane, before it gives back what it has.
_TURNS = 4


@dataclasses.dataclass(frozen=True)
class Job:
    """The footprints to fit. `lidars`, `scenes` and `settled` have one for all, or one for each.

    - `numbers`: of the footprints, from which their keys are made. - `settled`: unknowns of each.
    - `scale`: none or one more unknown. - `recorders`: one for all, or one for each.
    """

    numbers: Sequence[int]
    data: list[Data]
    lidars: list[Lidar]
    scenes: list[Scene]
    settled: list[list[Settled]]
    scale: list[Settled]
    recorders: list[Recorder | None]
    plan: Plan
    solver: optx.AbstractLeastSquaresSolver
    max_steps: int
    starts: int
    lanes: Lanes

    def part(self, some: Sequence[int]) -> "Job":
        """That of some footprints, on one core."""

        def own(given: list[Any]) -> list[Any]:
            return given if len(given) == 1 < len(self.data) else [given[i] for i in some]

        return dataclasses.replace(
            self,
            numbers=[self.numbers[i] for i in some],
            data=own(self.data),
            lidars=own(self.lidars),
            scenes=own(self.scenes),
            settled=own(self.settled),
            recorders=own(self.recorders),
            lanes=self.lanes._replace(threads=1),
        )


def fits(job: Job, key: PRNGKeyArray, todo: Sequence[int]) -> Iterator[tuple[int, Row]]:
    """The fits of the footprints at the places `todo` of a job, as they end, with these places."""

    def fitting(i: int) -> Fitting:
        own, data = job.settled[i % len(job.settled)], job.data[i]
        lidar, recorder = job.lidars[i % len(job.lidars)], job.recorders[i % len(job.recorders)]
        terms = RecorderModel(recorder, job.scale, lidar, data.time.size)
        own_key, more = jax.random.fold_in(key, job.numbers[i]), (job.solver, job.max_steps, None)
        return best_of(fits_from(job.starts, own_key, data, own, terms, *more))

    simulate = Simulator(job.lidars, job.scenes, job.plan, job.settled[0], key, job.lanes)
    waiting, running = list(todo), dict[int, tuple[Fitting, Request]]()
    while waiting or running:
        while waiting and len(running) < job.lanes.number:
            fit = fitting(i := waiting.pop(0))
            running[i] = fit, next(fit)
        for i, evaluation in simulate({i: request for i, (_, request) in running.items()}).items():
            fit = running[i][0]
            try:
                running[i] = fit, fit.send(evaluation)
            except StopIteration as end:
                del running[i]
                yield i, row_of(end.value)


def fits_by(
    executor: Executor, job: Job, key: PRNGKeyArray, todo: Sequence[int]
) -> Iterator[tuple[int, Row]]:
    """The same fits, by the workers of an executor."""
    size = _TURNS * job.lanes.each
    chunks = [todo[i : i + size] for i in range(0, len(todo), size)]
    tasks = [task(n, _chunk, (job.part(chunk),), key) for n, chunk in enumerate(chunks)]
    for done, rows in outcomes(tasks, executor):
        for i, row in zip(chunks[done.number], rows):
            yield i, Row(**{name: a if a.ndim else a.item() for name, a in row.items()})


def _chunk(job: Job, key: PRNGKeyArray) -> list[dict[str, Any]]:
    """Rows of a chunk of footprints; this runs in workers."""
    places = range(len(job.numbers))
    rows = dict(fits(job, key, places))
    return [vars(rows[i]) for i in places]
