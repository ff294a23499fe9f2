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
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from time import perf_counter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, PRNGKeyArray

from inversion.fit.data import ObservedWaveform, as_noise, as_observed, with_fixed_window
from inversion.fit.fit_summary import FitSummary
from inversion.fit.model import Evaluation, ForwardModel, SimulationInputs, evaluate_scene
from inversion.fit.planning import checked_plan, trace_sizes
from inversion.fit.recorder_model import RecorderModel, check_names, recorder_unknowns
from inversion.fit.result import Retrievals, retrievals_of
from inversion.fit.retrieval import check_progress, check_solver_for, scale_unknown, solver_settings
from inversion.fit.solver import (
    DEFAULT_SOLVER,
    EvaluationRequest,
    FitGenerator,
    SolverSettings,
    fits_from_starts,
    key_of_starts,
    multistart,
)
from inversion.fit.unknowns import BoundUnknown, Unknown, bind_unknowns, with_start
from inversion.receiver.recorder import Recorder
from jaxlidar import Lidar, Plan, Scene, TaskProgress
from jaxlidar.extend import (
    ONE_CORE,
    as_numpy,
    check_integer,
    check_key,
    check_kind,
    fingerprint,
    outcomes,
    side_by_side,
    task,
    warn_user,
)
from jaxlidar.io.store import ResultStore, dataset_of_rows, open_store

# Fits of a chunk of the store. Of each quantity a chunk is a file: fewer files, and small ones to rewrite.
_FITS_PER_CHUNK = 16
# Chunks of a worker are this many times its lockstep group: it is busy while slow fits end, and loses little
# if it dies.
_GROUPS_PER_CHUNK = 4


def retrieve_many(
    observed: ArrayLike | Sequence,
    lidar: Lidar | Sequence[Lidar],
    scene: Scene | Sequence[Scene],
    unknowns: Sequence[Unknown],
    *,
    noise: ArrayLike | Sequence,
    time: ArrayLike | Sequence,
    key: PRNGKeyArray,
    plan: Plan | None = None,
    n_photons: float | None = None,
    n_rays: float | None = None,
    max_orders: int | None = None,
    solver: optx.AbstractLeastSquaresSolver = DEFAULT_SOLVER,
    max_steps: float = 50,
    starts: float = 1,
    start: Mapping[str, ArrayLike | Sequence] | None = None,
    scale: tuple[float, float] | None = None,
    recorder: Recorder | Sequence[Recorder] | None = None,
    noise_floor: float = 1e-3,
    lanes: int = 16,
    path: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
    progress: Callable[[TaskProgress], None] | None = None,
) -> Retrievals:
    """Retrieve unknowns of a scene from many waveforms, each separately, as `retrieve` does for one.

    A fit that fails says so in its status and does not affect the others. All footprints share the random
    numbers of the simulation, so that its errors are correlated between footprints.

    **Arguments:**

    - `observed`: (footprints, wavelengths, bins) apparent reflectance, or in any other unit with `scale`.
    - `lidar`, `scene`: one for all footprints, or one for each. Those of different footprints may differ only
      in the values of their arrays (such as transmit pulses, or starting values).
    - `noise`: one standard deviation, in [0, inf], anything that broadcasts to `observed`.
    - `time`: (bins,) ns, the same for all footprints.
    - `unknowns`, `key`, `n_photons`, `n_rays`, `max_orders`: as for `retrieve`.
    - `solver`, `max_steps`, `starts`, `scale`, `noise_floor`: as for `retrieve`.
    - `recorder`: as for `retrieve`, one for all footprints, or one for each, with the same unknowns.
    - `plan`: one for all footprints. Default None: made for the first lidar and scene and the corners of the
      bounds.
    - `start`: by name, (footprints, ...) values that unknowns start from. Default None: their own.
    - `lanes`: number of footprints simulated together (batch size), at least 1; memory grows with it. Default
      16.
    - `path`: a Zarr store, whose name ends in ".zarr", to which every fit is written once it has ended, so
      that a run that was interrupted or killed goes on where it stopped. It belongs to the problem:
      everything that the result depends on must be as it was, and only `lanes`, `executor` and `progress` may
      change. One run at a time can use it. Damaged chunks are named in a warning and their fits are repeated.
      If it cannot be written any more, as on a full disk, a warning says so once and the fits go on. Default
      None: no store.
    - `executor`: a `concurrent.futures.Executor`, whose workers fit chunks of footprints, as for
      `jaxlidar.simulate_many`. Unknowns are sent to them: give paths, or functions of a module. A chunk whose
      worker dies gets a second try. Default None: this process.
    - `progress`: called with a `TaskProgress` after every fit.

    **Returns:** a `Retrievals`, which does not depend on the number of workers.

    **Raises:** ValueError for inadmissible arguments, as `retrieve` does, and for a `path` that is
    damaged, no Zarr store, or one of another problem, with what differs. TypeError for arguments of another
    kind. OSError for a `path` that cannot be written, before any fit, or that another run uses. RuntimeError
    if the workers of a chunk die twice.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> import numpy as np
    >>> scene = jl.Scene(ground=jl.Ground(height=0.5, reflectance=0.4))
    >>> wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
    >>> unknown = inversion.Unknown(lambda s: s.ground.reflectance, bounds=(0.0, 1.0), name="brightness")
    >>> observed = np.stack([0.5 * wave.reflectance, wave.reflectance])
    >>> more = {"noise": 0.001, "time": wave.time, "key": jax.random.key(1)}
    >>> fits = inversion.retrieve_many(observed, jl.Lidar(), scene, [unknown], **more)
    >>> fits.values["brightness"].round(3).tolist()
    [0.2, 0.4]
    """
    y = as_numpy(observed, "observed")
    if y.ndim != 3 or len(y) == 0:
        raise ValueError(f"observed has the shape {y.shape}; admissible is (footprints, wavelengths, bins)")
    n_footprints = len(y)
    sigma = as_noise(noise, y.shape)
    check_key(key)
    check_progress(progress)
    check_kind("path", path, str | os.PathLike | None, "a path, or None")
    check_kind("executor", executor, Executor | None, "a concurrent.futures.Executor, or None")
    lanes = check_integer("lanes", lanes)
    settings = solver_settings(solver, max_steps, starts)
    sizes = trace_sizes(n_photons, n_rays, max_orders, plan)
    # Lists of one for all footprints, or of one for each. One for all is never repeated, so that arrays are
    # neither stacked nor sent to workers more often than needed.
    lidars = [with_fixed_window(a) for a in _one_or_each("lidar", lidar, Lidar, n_footprints)]
    scenes = _one_or_each("scene", scene, Scene, n_footprints)
    bound = [bind_unknowns(unknowns, a, lidars[0]) for a in scenes]
    if any(unknown.setter.of_lidar for unknown in bound[0]):
        # They start from the lidar of each footprint.
        indices = range(max(len(lidars), len(scenes)))
        cases = [(_of_footprint(scenes, i), _of_footprint(lidars, i)) for i in indices]
        bound = [bind_unknowns(unknowns, *case) for case in cases]
    bound = _with_starts(bound, {} if start is None else start, n_footprints)
    check_solver_for(bound[0], settings)
    recorders: list[Recorder | None] = (
        [None] if recorder is None else _one_or_each("recorder", recorder, Recorder, n_footprints)
    )
    # Recorders of all footprints have the same unknowns.
    has_offset = recorders[0] is not None and recorders[0].offset is not None
    observations = [
        as_observed(y[i], time, sigma[i], noise_floor, _of_footprint(lidars, i), has_offset=has_offset)
        for i in range(n_footprints)
    ]
    sample_times = observations[0].time
    scale_unknowns = [] if scale is None else [scale_unknown(scale, bound[0])]
    check_names(recorders[0], bound[0])
    of_recorder = [] if recorders[0] is None else recorder_unknowns(recorders[0])
    # Names, shapes and bounds are those of all footprints.
    all_unknowns = [*bound[0], *of_recorder, *scale_unknowns]
    # Everything on which the results depend, by names that an error message shows.
    problem_parts = {
        "observed": y,
        "noise": sigma,
        "time": sample_times,
        "noise_floor": float(noise_floor),
        "lidar": lidars,
        "scene": scenes,
        **_parts_of_unknowns(bound),
        "scale": [(u.low, u.high) for u in scale_unknowns],
        "recorder": recorders,
        "key": key,
        "plan": plan,
        # A plan has its own.
        "n_photons": sizes.photons_per_batch if plan is None else None,
        "n_rays": sizes.rays_per_batch if plan is None else None,
        "max_orders": max_orders,
        "solver": solver,
        "max_steps": settings.max_steps,
        "starts": settings.starts,
    }
    # One plan, and one compiled program, serve all.
    plan = checked_plan(plan, lidars[0], scenes[0], bound[0], sample_times, sizes)
    problem = ManyFits(
        numbers=range(n_footprints),
        observed=observations,
        lidars=lidars,
        scenes=scenes,
        unknowns=bound,
        scale=scale_unknowns,
        recorders=recorders,
        plan=plan,
        settings=settings,
        groups=LockstepGroups.for_fits(min(lanes, n_footprints)),
    )
    no_store = contextlib.nullcontext()
    with no_store if path is None else open_store(path, fingerprint(problem_parts)) as store:
        finished = FinishedFits(store, n_footprints)
        start_time, n_stored = perf_counter(), len(finished.summaries)
        missing = [i for i in range(n_footprints) if i not in finished.summaries]
        fits = (
            run_fits(problem, key, missing)
            if executor is None
            else run_fits_by_workers(executor, problem, key, missing)
        )
        for i, summary in fits:
            finished.add(i, summary)
            if progress is not None:
                n_converged = sum(fit.converged for fit in finished.summaries.values())
                counts = len(finished.summaries), n_footprints
                progress(TaskProgress(*counts, perf_counter() - start_time, "fits", n_stored, n_converged))
    return retrievals_of([finished.summaries[i] for i in range(n_footprints)], all_unknowns)


def _parts_of_unknowns(unknowns: list[list[BoundUnknown]]) -> dict[str, Any]:
    """Return what fits depend on of the unknowns: that of the first footprint, and the starts of all."""
    dependencies: dict[str, Any] = {"unknowns": [u.name for u in unknowns[0]]}
    # Bounds, priors and setters are those of the first footprint; starts may differ.
    for u, *in_other_footprints in zip(*unknowns):
        dependencies[f"where or apply of {u.name!r}"] = u.setter
        dependencies[f"bounds of {u.name!r}"] = u.low, u.high
        dependencies[f"prior of {u.name!r}"] = (u.prior, u.is_log_prior) if u.smooth is None else u.smooth
        dependencies[f"start of {u.name!r}"] = [u.start, *(v.start for v in in_other_footprints)]
    return dependencies


def _with_starts(
    unknowns: list[list[BoundUnknown]], start: Mapping[str, Any], n_footprints: int
) -> list[list[BoundUnknown]]:
    """Return the unknowns of every footprint with its starting values; a single list if all are the same."""
    check_kind("start", start, Mapping, "a mapping from names of unknowns to values")
    shapes = {u.name: u.start.shape for u in unknowns[0]}
    starts = {}
    for name, values in start.items():
        if name not in shapes:
            raise ValueError(f"start has {name!r}; admissible are {', '.join(map(repr, shapes))}")
        starts[name] = as_numpy(values, f"start of {name!r}")
        shape = (n_footprints, *shapes[name])
        if starts[name].shape != shape:
            raise ValueError(f"start of {name!r} has the shape {starts[name].shape}; admissible is {shape}")
    # Without starts of their own, footprints share their unknowns.
    if not starts:
        return unknowns
    return [
        [
            with_start(u, jnp.asarray(starts[u.name][i], u.start.dtype)) if u.name in starts else u
            for u in _of_footprint(unknowns, i)
        ]
        for i in range(n_footprints)
    ]


def _one_or_each(field: str, argument: Any, kind: type, n_footprints: int) -> list[Any]:
    """Return a list of one object for all footprints, or of one for each. **Raises:** as `retrieve_many`."""
    if isinstance(argument, kind):
        return [argument]
    check_kind(field, argument, Sequence, f"one {kind.__name__}, or a sequence of one for each footprint")
    objects = list(argument)
    if len(objects) != n_footprints:
        raise ValueError(
            f"{field} has {len(objects)} elements; admissible is one, or {n_footprints} as observed"
        )
    for i, x in enumerate(objects):
        check_kind(f"{field} {i}", x, kind, f"a {kind.__name__}")
    # One compiled program serves all: structures and shapes have to agree.
    structure, shapes = jax.tree.structure(objects[0]), jax.tree.map(jnp.shape, objects[0])
    for i, x in enumerate(objects):
        if jax.tree.structure(x) != structure or jax.tree.map(jnp.shape, x) != shapes:
            raise ValueError(f"{field} {i} differs from the first in more than the values of its arrays")
    return objects


def _of_footprint(objects: Sequence[Any], i: int) -> Any:
    """Return the object of footprint `i`, from one for all or one for each."""
    return objects[0] if len(objects) == 1 else objects[i]


class FinishedFits:
    """Records of the fits that have ended, by footprint, and their store, if there is one."""

    def __init__(self, store: ResultStore | None, n_footprints: int):
        self.n_footprints = n_footprints
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


@dataclasses.dataclass(frozen=True)
class ManyFits:
    """The fits of many footprints.

    `lidars`, `scenes`, `unknowns` and `recorders` have one object for all footprints, or one for each.

    - `numbers`: of the footprints; their random keys are made from these.
    - `observed`: waveform of each.
    - `unknowns`: of the scene.
    - `scale`: the unknown "scale", or empty.
    - `groups`: sizes of lockstep groups.
    """

    numbers: Sequence[int]
    observed: list[ObservedWaveform]
    lidars: list[Lidar]
    scenes: list[Scene]
    unknowns: list[list[BoundUnknown]]
    scale: list[BoundUnknown]
    recorders: list[Recorder | None]
    plan: Plan
    settings: SolverSettings
    groups: LockstepGroups

    def subset(self, indices: Sequence[int]) -> "ManyFits":
        """Return the fits of some footprints, on one core."""

        def of_subset(objects: list[Any]) -> list[Any]:
            # One for all stays one for all, unless there is one footprint anyway.
            is_shared = len(objects) == 1 < len(self.observed)
            return objects if is_shared else [objects[i] for i in indices]

        return dataclasses.replace(
            self,
            numbers=[self.numbers[i] for i in indices],
            observed=of_subset(self.observed),
            lidars=of_subset(self.lidars),
            scenes=of_subset(self.scenes),
            unknowns=of_subset(self.unknowns),
            recorders=of_subset(self.recorders),
            groups=self.groups._replace(n_threads=1),
        )


def run_fits(
    problem: ManyFits, key: PRNGKeyArray, indices: Sequence[int]
) -> Iterator[tuple[int, FitSummary]]:
    """Fit the footprints at these indices of a problem in lockstep. Yield index and summary as fits end."""

    def fit_of(i: int) -> FitGenerator:
        observed, lidar = problem.observed[i], _of_footprint(problem.lidars, i)
        recorder = _of_footprint(problem.recorders, i)
        recorder_model = RecorderModel(recorder, problem.scale, lidar, observed.time.size)
        # It determines the starting points alone, which do not depend on the chunk or on earlier runs.
        start_key = jax.random.fold_in(key_of_starts(key), problem.numbers[i])
        unknowns = _of_footprint(problem.unknowns, i)
        return multistart(fits_from_starts(observed, unknowns, recorder_model, problem.settings, start_key))

    # The photons of all footprints have the same key, as those of a single fit: results do not depend on the
    # chunk.
    simulate = LockstepModel(problem, key)
    # The fits that run at present, with the request that each waits for.
    waiting, running = list(indices), dict[int, tuple[FitGenerator, EvaluationRequest]]()
    while waiting or running:
        # A fit that has ended makes room at once: in groups of fits that begin and end together, most members
        # would be idle until the slowest fit has ended.
        while waiting and len(running) < problem.groups.n_fits:
            i = waiting.pop(0)
            fit = fit_of(i)
            running[i] = fit, next(fit)
        for i, evaluation in simulate({i: request for i, (_, request) in running.items()}).items():
            fit = running[i][0]
            try:
                # The fit goes on to its next request, or ends.
                running[i] = fit, fit.send(evaluation)
            except StopIteration as end:
                del running[i]
                yield i, end.value.summary


def run_fits_by_workers(
    executor: Executor, problem: ManyFits, key: PRNGKeyArray, indices: Sequence[int]
) -> Iterator[tuple[int, FitSummary]]:
    """Fit the footprints as `run_fits`, in chunks by the workers of an executor."""
    size = _GROUPS_PER_CHUNK * problem.groups.fits_per_thread
    chunks = [indices[i : i + size] for i in range(0, len(indices), size)]
    # Arrays and names instead of summaries: a task's result is a tree of arrays.
    tasks = [task(n, _fit_chunk, (problem.subset(chunk),), key) for n, chunk in enumerate(chunks)]
    for completed, summaries in outcomes(tasks, executor):
        for i, arrays in zip(chunks[completed.number], summaries):
            yield i, FitSummary.from_arrays(arrays)


def _fit_chunk(problem: ManyFits, key: PRNGKeyArray) -> list[dict[str, Any]]:
    """Fit a chunk of footprints in a worker."""
    indices = range(len(problem.numbers))
    summaries = dict(run_fits(problem, key, indices))
    return [summaries[i].to_arrays() for i in indices]


class LockstepModel:
    """The simulated waveforms of all running fits: one compiled call for each thread's group."""

    def __init__(self, problem: ManyFits, key: PRNGKeyArray):
        self.lidars, self.scenes, self.groups = problem.lidars, problem.scenes, problem.groups
        self.model = ForwardModel(self.lidars[0], self.scenes[0], problem.plan, problem.unknowns[0], key)

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
        inputs = dataclasses.replace(
            model.inputs, lidar=_stacked(self.lidars, members), scene=_stacked(self.scenes, members)
        )
        # Static: another combination compiles another program.
        has_axis = HasFootprintAxis(len(self.lidars) > 1, len(self.scenes) > 1)
        # Results of idle members are dropped.
        arrays = _evaluate_in_lockstep(inputs, values, jnp.stack(model.keys), jnp.array(n_batches), has_axis)
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
    """Return one object for all, or the members' objects with their arrays stacked."""
    if len(objects) == 1:
        return objects[0]
    # Fields that are no arrays are equal (`_one_or_each`).
    dynamic, static = zip(*(eqx.partition(objects[i], eqx.is_array) for i in members))
    return eqx.combine(jax.tree.map(lambda *a: jnp.stack(a), *dynamic), static[0])


class HasFootprintAxis(NamedTuple):
    """True for lidar and scene that have a leading axis of footprints, False if one serves all."""

    lidar: bool
    scene: bool


@eqx.filter_jit(**ONE_CORE)
def _evaluate_in_lockstep(
    inputs: SimulationInputs, values: Any, keys: Array, n_batches: Array, has_axis: HasFootprintAxis
) -> tuple[Array, Array, Array]:
    """Map `evaluate_scene` over the members of a group."""
    lidar, static_lidar = eqx.partition(inputs.lidar, eqx.is_array)
    scene, static_scene = eqx.partition(inputs.scene, eqx.is_array)

    def evaluate(lidar: Lidar, scene: Scene, values: Any, n_batches: Array) -> tuple[Array, Array, Array]:
        lidar, scene = eqx.combine(lidar, static_lidar), eqx.combine(scene, static_scene)
        member = dataclasses.replace(inputs, lidar=lidar, scene=scene)
        return evaluate_scene(member, values, keys, n_batches)

    # At first order there are no photons, and all members take equally long.
    if inputs.plan.orders == 1:
        axes = (0 if has_axis.lidar else None, 0 if has_axis.scene else None, 0, 0)
        return jax.vmap(evaluate, in_axes=axes)(lidar, scene, values, n_batches)

    # Not vmap: a batched loop goes on until the photons of the slowest member have ended.
    def evaluate_member(member: tuple) -> tuple[Array, Array, Array]:
        member_lidar = member[0] if has_axis.lidar else lidar
        member_scene = member[1] if has_axis.scene else scene
        return evaluate(member_lidar, member_scene, *member[2:])

    mapped = (lidar if has_axis.lidar else None, scene if has_axis.scene else None, values, n_batches)
    return jax.lax.map(evaluate_member, mapped)
