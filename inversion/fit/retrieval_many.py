"""Retrieval from many waveforms: each is fitted separately, and their simulations run together.

Fits advance in lockstep. Each fit is a generator (`inversion.fit.solver`) that stops at every simulation it
needs:

1. Start as many fits as `lanes` says; each yields its first request.
2. Deal the requests to threads, evenly by their work. Every thread evaluates its group in one compiled call
   of a fixed size. Groups that are not full are padded with idle members, which trace no photons.
3. Send every fit its evaluation. A fit that ends is stored, and the next footprint takes its position.

The number of photon batches of a member is data, so that pilot evaluations, full ones and idle members share
one compiled program. With an executor, chunks of footprints are fitted in the same way by its workers. The
fit of a footprint depends neither on `lanes` nor on the executor.
"""

import contextlib
import dataclasses
import functools
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from time import perf_counter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from inversion.fit.fit_summary import FitSummary
from inversion.fit.model import Evaluation, ForwardModel, SimulationInputs, evaluate_scene
from inversion.fit.planning import size_arguments
from inversion.fit.problem import BoundProblem, Problem, check_problem
from inversion.fit.result import Retrieval, retrievals_of
from inversion.fit.retrieval import solver_settings
from inversion.fit.solver import (
    EvaluationRequest,
    FitGenerator,
    SolverSettings,
    fits_from_starts,
    key_of_starts,
    multistart,
    run_fits,
)
from inversion.fit.unknowns import BoundUnknown
from jaxlidar import Progress
from jaxlidar.extend import (
    Program,
    check_integer,
    check_key,
    check_kind,
    fingerprint,
    outcomes,
    side_by_side,
    task,
    warn_user,
)
from jaxlidar.progress import ProgressOption, shows_progress
from jaxlidar.results.netcdf import store_result
from jaxlidar.results.store import ResultStore, dataset_of_rows, open_store

# Fits of a chunk of the store. A chunk of each quantity is a file: few files, and small ones to rewrite.
_FITS_PER_CHUNK = 16
# Chunks of a worker are this many times its lockstep group: it is busy while slow fits end, and loses little
# if it dies.
_GROUPS_PER_CHUNK = 4


@shows_progress
def retrieve_many(
    problem: Problem,
    *,
    key: PRNGKeyArray,
    max_steps: int = 50,
    starts: int = 1,
    lanes: int = 16,
    path: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
    progress: ProgressOption = None,
) -> Retrieval:
    """Retrieve the unknowns of a problem of many records, from each separately, as `retrieve` does from one.

    A fit that fails says so in its status and does not affect the others. All records share the random
    numbers of the simulation, so that its errors are correlated between records.

    **Arguments:**

    - `problem`: a `Problem` of many records.
    - `key`, `max_steps`, `starts`: as for `retrieve`.
    - `lanes`: number of records simulated together (batch size), at least 1; memory grows with it. Default
      16.
    - `path`: a Zarr store, whose name ends in ".zarr", to which every fit is written once it has ended, so
      that a run that was interrupted or killed goes on where it stopped. It belongs to the problem:
      everything that the result depends on must be as it was, and only `lanes`, `executor` and `progress` may
      change. One run at a time can use it. Damaged chunks are named in a warning and their fits are repeated.
      If it cannot be written any more, as on a full disk, a warning says so once and the fits go on. Default
      None: no store.
    - `executor`: a `concurrent.futures.Executor`, whose workers fit chunks of records, as for
      `jaxlidar.simulate_many`. Unknowns are sent to them: give paths, or functions of a module. A chunk whose
      worker dies gets a second try. Default None: this process.
    - `progress`: True for a bar with the time left; or a function called with a `Progress` after every fit.
      Default None: silent.

    **Returns:** a `Retrieval` with an axis of footprints, which does not depend on the number of workers.

    **Raises:** ValueError for a problem of one record and inadmissible arguments, as `retrieve` does, and for
    a `path` that is damaged, no Zarr store, or one of another problem, with what differs. TypeError for
    arguments of another kind. OSError for a `path` that cannot be written, before any fit, or that another
    run uses. RuntimeError if the workers of a chunk die twice.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> import numpy as np
    >>> scene = jl.Scene(ground=jl.Ground(height=0.5, reflectance=0.4))
    >>> wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
    >>> unknown = inversion.Unknown("ground.reflectance", bounds=(0.0, 1.0), name="brightness")
    >>> observed = np.stack([0.5 * wave.reflectance, wave.reflectance])
    >>> problem = inversion.Problem(observed, jl.Lidar(), scene, [unknown], noise=0.001, time=wave.time)
    >>> fits = inversion.retrieve_many(problem, key=jax.random.key(1))
    >>> fits.values["brightness"].round(3).tolist()
    [0.2, 0.4]
    """
    check_problem(problem, many=True)
    check_key(key)
    check_kind("path", path, str | os.PathLike | None, "a path, or None")
    check_kind("executor", executor, Executor | None, "a concurrent.futures.Executor, or None")
    lanes = check_integer("lanes", lanes)
    settings = solver_settings(max_steps, starts)
    bound = problem.bound
    sizes = size_arguments(problem.n_photons, problem.n_rays, problem.max_orders, problem.plan)
    # Everything on which the results depend, by names that an error message shows.
    problem_parts = {
        "observed": [record.reflectance for record in bound.observed],
        "noise": [record.sigma for record in bound.observed],
        "time": bound.observed[0].time,
        "noise_floor": float(problem.noise_floor),
        "lidar": bound.lidars,
        "scene": bound.scenes,
        **_parts_of_unknowns(bound.unknowns),
        "scale": [(u.low, u.high) for u in bound.scale],
        "recorder": bound.recorders,
        "key": key,
        "plan": problem.plan,
        **sizes,
        "max_steps": settings.max_steps,
        "starts": settings.starts,
    }
    n_footprints, all_unknowns = len(bound.observed), bound.all_unknowns
    groups = LockstepGroups.for_fits(min(lanes, n_footprints))
    no_store = contextlib.nullcontext()
    with no_store if path is None else open_store(path, fingerprint(problem_parts)) as store:
        finished = FinishedFits(store, n_footprints)
        start_time, n_stored = perf_counter(), len(finished.summaries)
        missing = [i for i in range(n_footprints) if i not in finished.summaries]
        fits = (
            fit_records(bound, settings, groups, key, missing)
            if executor is None
            else fit_records_by_workers(executor, bound, settings, groups, key, missing)
        )
        for i, summary in fits:
            finished.add(i, summary)
            if callable(progress):
                n_converged = sum(fit.converged for fit in finished.summaries.values())
                counts = len(finished.summaries), n_footprints
                progress(Progress(*counts, perf_counter() - start_time, "fits", n_stored, n_converged))
        result = retrievals_of([finished.summaries[i] for i in range(n_footprints)], all_unknowns)
        if store is not None and finished.are_stored:
            store_result(store, result)
    return result


def _parts_of_unknowns(unknowns: list[list[BoundUnknown]]) -> dict[str, Any]:
    """Return what fits depend on of the unknowns: that of the first footprint, and the starts of all."""
    dependencies: dict[str, Any] = {"unknowns": [u.name for u in unknowns[0]]}
    # Bounds, priors and setters are those of the first footprint; starts may differ.
    for u, *in_other_footprints in zip(*unknowns):
        dependencies[f"where or apply of {u.name!r}"] = u.setter
        dependencies[f"bounds of {u.name!r}"] = u.low, u.high
        dependencies[f"prior of {u.name!r}"] = (u.prior, u.is_log_prior) if u.smooth is None else u.smooth
        starts = np.stack([u.start, *(v.start for v in in_other_footprints)])
        # One start for all, or the same one for each.
        dependencies[f"start of {u.name!r}"] = starts[:1] if np.all(starts == starts[0]) else starts
    return dependencies


class FinishedFits:
    """Records of the fits that have ended, by footprint, and their store, if there is one."""

    def __init__(self, store: ResultStore | None, n_footprints: int):
        self._rows = None if store is None else store.rows("", "footprint", n_footprints, _FITS_PER_CHUNK)
        self._unwritten: set[int] = set()
        self._has_warned = False
        self.summaries: dict[int, FitSummary] = {}
        if self._rows is not None:
            numbers = np.flatnonzero(self._rows.is_done)
            arrays = self._rows.read(numbers)
            for row, number in enumerate(numbers.tolist()):
                of_fit = {name: np.asarray(array[row]) for name, array in arrays.items()}
                self.summaries[number] = FitSummary.from_arrays(of_fit)

    @property
    def are_stored(self) -> bool:
        """True unless the store could not be written."""
        return not self._unwritten

    def add(self, number: int, summary: FitSummary) -> None:
        """Add a fit, and store it. A first failure to store warns; all fits are in memory anyway."""
        # In memory first: results are returned whatever happens to the store.
        self.summaries[number] = summary
        if self._rows is None:
            return
        self._unwritten.add(number)
        try:
            for i in sorted(self._unwritten):
                arrays = {name: [value] for name, value in self.summaries[i].to_arrays().items()}
                self._rows.write(slice(i, i + 1), dataset_of_rows("footprint", arrays))
                self._unwritten.remove(i)
        except OSError as error:
            if not self._has_warned:
                self._has_warned = True
                warn_user(
                    f"{error}. The fits go on, and are returned; every further one tries to write what is "
                    "missing"
                )


# -- fits in lockstep


class LockstepGroups(NamedTuple):
    """Sizes of the groups of fits whose simulations run together: one group for each thread."""

    n_threads: int
    fits_per_thread: int

    @property
    def n_fits(self) -> int:
        """Number of fits of all groups."""
        return self.n_threads * self.fits_per_thread

    @staticmethod
    def for_fits(n_fits: int) -> "LockstepGroups":
        """Return groups on all cores for at least this many fits."""
        n_threads = min(max(os.cpu_count() or 1, 1), n_fits)
        return LockstepGroups(n_threads, -(-n_fits // n_threads))


def fit_records(
    problem: BoundProblem,
    settings: SolverSettings,
    groups: LockstepGroups,
    key: PRNGKeyArray,
    indices: Sequence[int],
) -> Iterator[tuple[int, FitSummary]]:
    """Fit the records at these indices of a problem in lockstep. Yield index and summary as fits end."""

    def fit_of(i: int) -> FitGenerator:
        # It determines the starting points alone, which do not depend on the chunk or on earlier runs.
        start_key = jax.random.fold_in(key_of_starts(key), problem.numbers[i])
        unknowns, recorder = problem.unknowns_of(i), problem.recorder_model(i)
        return multistart(fits_from_starts(problem.observed[i], unknowns, recorder, settings, start_key))

    # The photons of all records have the same key, as those of a single fit: results do not depend on the
    # chunk.
    simulate = LockstepModel(problem, groups, key)
    for i, fit in run_fits(((i, fit_of(i)) for i in indices), simulate, groups.n_fits):
        yield i, fit.summary


def fit_records_by_workers(
    executor: Executor,
    problem: BoundProblem,
    settings: SolverSettings,
    groups: LockstepGroups,
    key: PRNGKeyArray,
    indices: Sequence[int],
) -> Iterator[tuple[int, FitSummary]]:
    """Fit the records as `fit_records`, in chunks by the workers of an executor."""
    size = _GROUPS_PER_CHUNK * groups.fits_per_thread
    chunks = [indices[i : i + size] for i in range(0, len(indices), size)]
    # A worker has one core.
    more = settings, groups._replace(n_threads=1)
    # Arrays and names instead of summaries: a task's result is a tree of arrays.
    tasks = [task(n, _fit_chunk, (problem.subset(chunk), *more), key) for n, chunk in enumerate(chunks)]
    for completed, summaries in outcomes(tasks, executor):
        for i, arrays in zip(chunks[completed.number], summaries):
            yield i, FitSummary.from_arrays(arrays)


def _fit_chunk(
    problem: BoundProblem, settings: SolverSettings, groups: LockstepGroups, key: PRNGKeyArray
) -> list[dict[str, Any]]:
    """Fit a chunk of records in a worker."""
    indices = range(len(problem.numbers))
    summaries = dict(fit_records(problem, settings, groups, key, indices))
    return [summaries[i].to_arrays() for i in indices]


class LockstepModel:
    """The simulated waveforms of all running fits: one compiled call for each thread's group."""

    def __init__(self, problem: BoundProblem, groups: LockstepGroups, key: PRNGKeyArray):
        self.lidars, self.groups = problem.lidars, groups
        self.model = ForwardModel(self.lidars[0], problem.scenes[0], problem.plan, problem.unknowns[0], key)
        inputs = self.model.inputs
        self.scenes = [dataclasses.replace(inputs, scene=scene).with_room().scene for scene in problem.scenes]

    def __call__(self, requests: Mapping[int, EvaluationRequest]) -> dict[int, Evaluation]:
        """Evaluate the requests of fits, by the index of their footprint."""
        # Sorted by work and dealt in turn: each thread gets as many pilot evaluations as the others.
        indices = sorted(requests, key=lambda i: self._n_batches(requests[i]))
        # Near the end there may be fewer fits than threads.
        n_threads = min(self.groups.n_threads, len(indices))
        groups = [indices[i::n_threads] for i in range(n_threads)]
        evaluations: dict[int, Evaluation] = {}
        with side_by_side(self.groups.n_threads) as run:
            for of_group in run(lambda group: self._evaluate_group(group, requests), groups):
                evaluations |= of_group
        return evaluations

    def _n_batches(self, request: EvaluationRequest) -> int:
        return self.model.n_pilot if request.pilot else len(self.model.keys)

    def _evaluate_group(
        self, group: list[int], requests: Mapping[int, EvaluationRequest]
    ) -> dict[int, Evaluation]:
        """Stack values, lidars and scenes of a group, evaluate them in one call, and split the results."""
        # The compiled call has a fixed size: idle members repeat the last request with no batches.
        n_idle = self.groups.fits_per_thread - len(group)
        members = [*group, *[group[-1]] * n_idle]
        n_batches = [*(self._n_batches(requests[i]) for i in group), *[0] * n_idle]
        model = self.model
        values = jax.tree.map(lambda *a: jnp.stack(a), *(model.values(requests[i].values) for i in members))
        stacked = {"lidar": self.lidars, "scene": self.scenes}
        stacked = {name: _stacked(a, members) for name, a in stacked.items() if len(a) > 1}
        keys, n_batches_of_members = jnp.stack(model.keys), jnp.array(n_batches)
        # Results of idle members are dropped.
        arrays = _evaluate_in_lockstep(model.inputs, stacked, values, keys, n_batches_of_members)
        reflectance, columns, batches = (np.asarray(a, float) for a in arrays)
        return {
            i: Evaluation(
                reflectance[n],
                np.moveaxis(columns[n][model.order], 0, -1),
                None,
                batches[n][: n_batches[n]],
                n_batches[n] < len(model.keys),
            )
            for n, i in enumerate(group)
        }


def _stacked(objects: list[Any], members: list[int]) -> Any:
    """Return the members' objects with their arrays stacked."""
    # Fields that are no arrays are equal (`inversion.fit.problem`).
    dynamic, static = zip(*(eqx.partition(objects[i], eqx.is_array) for i in members))
    return eqx.combine(jax.tree.map(lambda *a: jnp.stack(a), *dynamic), static[0])


@functools.partial(Program, one_core=True)
def _evaluate_in_lockstep(
    inputs: SimulationInputs, stacked: dict[str, Any], values: Any, keys: Array, n_batches: Array
) -> tuple[Array, Array, Array]:
    """Map `evaluate_scene` over the members of a group.

    `stacked`: fields of `inputs` that differ between members, with a leading axis.
    """
    stacked_arrays, static = eqx.partition(stacked, eqx.is_array)

    def evaluate(member: tuple) -> tuple[Array, Array, Array]:
        arrays, values, n_batches = member
        member_inputs = dataclasses.replace(inputs, **eqx.combine(arrays, static))
        return evaluate_scene(member_inputs, values, keys, n_batches)

    members = stacked_arrays, values, n_batches
    # At first order there are no photons, and all members take equally long.
    if not inputs.plan.config.follows_higher_orders:
        return jax.vmap(evaluate)(members)
    # Not vmap: a batched loop goes on until the photons of the slowest member have ended.
    return jax.lax.map(evaluate, members)
