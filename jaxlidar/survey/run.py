"""`simulate_many`: the waveforms of all shots of a survey."""

import functools
import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import jax
from jaxtyping import PRNGKeyArray

from jaxlidar._checks import check_flag, check_integer, check_key, check_kind, is_traced
from jaxlidar._fingerprint import fingerprint
from jaxlidar._registry import simulate_survey
from jaxlidar._workers import Task, outcomes
from jaxlidar.instrument.survey import Survey
from jaxlidar.io.case import Case, case_text
from jaxlidar.io.checkpoint import check_same_problem, open_checkpoint
from jaxlidar.scenes.scene import Scene, check_kinds
from jaxlidar.scenes.scene_parts import SceneParts
from jaxlidar.survey.coverage import OffMapWarning, ground_heights, off_map, said_of
from jaxlidar.survey.gathering import StoredResults, in_memory, on_disk
from jaxlidar.survey.prepare import prepared
from jaxlidar.survey.progress import Pace, SurveyProgress
from jaxlidar.survey.squares import BySquares
from jaxlidar.survey.waveforms import Waveforms
from jaxlidar.survey.ways import AbstractWay
from jaxlidar.survey.with_truth import WithTruth


@simulate_survey.register
def simulate_many(
    survey: Survey,
    scene: Scene | SceneParts,
    *,
    key: PRNGKeyArray,
    rtol: float | None = None,
    max_orders: int | None = None,
    path: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
    mesh: jax.sharding.Mesh | None = None,
    progress: Callable[[SurveyProgress], None] | None = None,
    shared: bool | None = None,
    truth: bool = False,
) -> Waveforms:
    """The waveforms that all shots of a survey record of one scene.

    One program is compiled for all of them, in one of two ways:

    - Shots of one direction share light where their footprints overlap. Parallel light falls on all that they
      cover and is traced once. Straight down, without a field of view, it is told apart by where it entered:
      every footprint is a weighted sum, and the grid on which light is told apart is part of the standard
      errors. Otherwise every shot has its part of each path, exactly: by its own beam where the path enters,
      and its own field of view where it ends. That takes longer, and order one is each shot's own. What
      light that is not parallel would change is bounded (`info["parallel light"]`). Standard errors are those
      of each shot: errors of neighbours are correlated.
    - All others are traced one by one. A shot costs the same over a map of any size: what the map itself
      costs is computed once for many shots. Its waveform does not depend on the other shots.

    Tracing goes on until the error of every shot is below the tolerance, as `simulate` defines it. Results
    depend neither on how many workers or devices there are, nor on whether the run was interrupted.

    All waveforms have one time axis, from the first return of any shot to the last; over steep terrain it is
    long. Derivatives are for `simulate`.

    **Arguments:**

    - `survey`: a `Survey`.
    - `scene`: a `Scene`; or `SceneParts`, for one that is larger than memory.
    - `key`: a JAX random key. The same key gives the same waveforms.
    - `rtol`: relative error at which a shot is done, in (0, 1). Default None: 0.01.
    - `max_orders`: number of scatterings followed, at least 1. Default None: from `rtol` and the largest
      albedo.
    - `path`: a netCDF file, or a Zarr store (".zarr"), for the waveforms, which appears when all are done,
      with its case, so that `jaxlidar.rerun` can do them again. Until then the file "PATH.parts" (of SQLite)
      keeps the shots that are done; the same call goes on with them, also after it was killed. One run at a
      time can use it. Where the file is there already, it is read. Only some shots are in memory at a time,
      also of a netCDF file that is returned: see `jaxlidar.open`. Default None: no file.
    - `executor`: a `concurrent.futures.Executor`, whose workers trace chunks of shots: a process pool (with
      the start method "spawn" or "forkserver"), that of a Dask client (`client.get_executor()`; the extra
      `cluster` installs Dask), of mpi4py. A chunk whose worker dies gets a second try. Default None: this
      process, on all cores.
    - `mesh`: a `jax.sharding.Mesh`, among whose devices the shots are shared out: each takes the next chunk.
      A program is compiled for each device. Default None: the default device.
    - `progress`: a function called with a `SurveyProgress` after every chunk; for instance `print`. Default
      None.
    - `shared`: whether shots share light. True refuses shots that cannot. Default None: where they can and it
      pays.
    - `truth`: whether to add what each beam meets in the scene, as labels for algorithms: `Waveforms.truth`.
      Default False.

    **Returns:** a `Waveforms`.

    **Warns:** `OffMapWarning` where footprints lie partly beside the voxel map, `LateLightWarning` where much
    light comes after the record.

    **Raises:** TypeError for things of another kind. ValueError, before any work, for inadmissible arguments,
    a scene that reaches up to the sensor, shots that do not meet the ground, a receiver whose window opens at
    the first return, shots that shall share light and cannot, and a `path` with results of another problem,
    of which it says what differs. OSError for a `path` that another run uses, or that cannot be written.
    RuntimeError where the workers of a chunk die twice.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> survey = jl.Survey.track(jl.Lidar(), start=(0, 0), end=(100, 0), spacing=50.0)
    >>> scene = jl.Scene(ground=jl.Ground(height=5.0, reflectance=0.4, slope=5.0, aspect=90.0))
    >>> many = jl.simulate_many(survey, scene, key=jax.random.key(0))
    >>> print(many.ground_height.round(2).tolist(), f"{float(many[0].reflectance.sum()):.2f}")
    [5.0, 0.63, -3.75] 0.40
    """
    check_kind("survey", survey, Survey, "a Survey, as in Survey(lidar, position=...)")
    if not isinstance(scene, SceneParts):
        check_kinds(survey.lidar, scene)
    check_key(key)
    check_kind("path", path, str | os.PathLike | None, "a path, or None")
    check_kind("executor", executor, Executor | None, "a concurrent.futures.Executor, or None")
    check_kind("mesh", mesh, jax.sharding.Mesh | None, "a jax.sharding.Mesh, or None")
    devices = None if mesh is None else _devices(mesh, executor)
    check_kind("progress", progress, Callable | None, "a function, or None")
    check_kind("shared", shared, bool | None, "True, False or None")
    check_flag("truth", truth)
    if max_orders is not None:
        max_orders = check_integer("max_orders", max_orders)
    if any(is_traced(x) for x in jax.tree.leaves((survey, scene, key))):
        raise TypeError("simulate_many is not for JAX transformations: use simulate, with plan= made outside")
    if survey.lidar.receiver.window != "fixed":
        raise ValueError(
            f"receiver window = {survey.lidar.receiver.window!r} gives every shot a time axis of its own; "
            "admissible is 'fixed'"
        )
    started = time.perf_counter()
    if isinstance(scene, SceneParts):
        way = BySquares.of(survey, scene, rtol, max_orders, shared, truth)
        beside, heights = way.beside, way.heights
    else:
        way = prepared(survey, scene, rtol, max_orders, shared)
        if truth:
            way = WithTruth(way.setup, way.survey, way.rtol, way)
        beside = off_map(way.survey, way.setup.scene)
        heights = ground_heights(way.survey, way.setup.scene, way.setup.plan.limits.start_distance)
    if (said := said_of(beside)) is not None:
        warnings.warn(said, OffMapWarning, stacklevel=2)
    known: dict[str, Any] = {"position": survey.position, "zenith": survey.zenith, "azimuth": survey.azimuth}
    known |= {"ground_height": heights, "off_map": beside}
    outcomes_of = functools.partial(outcomes, executor=executor, devices=devices)
    if path is None:
        return in_memory(way, known, _traced(way, key, outcomes_of, progress, {}), started)
    content = (scene, way.digests) if isinstance(way, BySquares) else scene
    parts = {"survey": survey, "scene": content, "key": key, "rtol": way.rtol, "max_orders": max_orders}
    parts |= {"shared": way.described()["shared"], "truth": bool(truth)}
    problem = fingerprint(parts)
    if Path(path).exists():
        many = Waveforms.open(path)
        check_same_problem(path, many.info.get("problem", {}), problem)
        return many
    given = {"rtol": rtol, "max_orders": max_orders, "shared": shared, "truth": truth}
    case = None if isinstance(scene, SceneParts) else _case(survey, scene, key, given)
    path = Path(path)
    with open_checkpoint(path.with_name(path.name + ".parts"), problem) as checkpoint:
        results = _traced(way, key, outcomes_of, progress, StoredResults(checkpoint, way))
        many = on_disk(way, known, results, started, path, problem, case)
        checkpoint.remove()
    return many


def _case(survey: Survey, scene: Scene, key: PRNGKeyArray, given: dict[str, Any]) -> Case | None:
    """The case of a call, or None where the scene or the lidar has classes of one's own."""
    arguments = {name: value for name, value in given.items() if value is not None}
    case = Case(survey=survey, scene=scene, key=key, arguments=arguments)
    try:
        case_text(case)
    except TypeError:
        return None
    return case


def _devices(mesh: jax.sharding.Mesh, executor: Executor | None) -> list[Any]:
    """The devices of a mesh. **Raises:** as `simulate_many`."""
    if executor is not None:
        raise ValueError(
            "mesh and executor are both given; admissible is one: workers have their own devices"
        )
    devices, here = list(mesh.devices.flat), jax.process_index()
    if others := [d for d in devices if d.process_index != here]:
        raise ValueError(
            f"mesh has {len(others)} of {len(devices)} devices in other processes ({others[0]}); admissible "
            "are devices of this process; for several processes give an executor"
        )
    return devices


def _traced(
    way: AbstractWay,
    key: PRNGKeyArray,
    outcomes_of: Callable[[list[Task]], Iterator[tuple[Task, Any]]],
    progress: Callable[[SurveyProgress], None] | None,
    results: MutableMapping[int, Any],
) -> Mapping[int, Any]:
    """The results of all tasks, some of which may be there already."""
    tasks, shots = way.tasks(key), len(way.survey)
    there = len(results)
    pace = Pace(shots, shots * there // len(tasks))
    for task, result in outcomes_of([t for t in tasks if t.number not in results]):
        results[task.number], there = result, there + 1
        pace.done = shots * there // len(tasks)
        if progress is not None:
            progress(SurveyProgress(pace.done, shots, pace.seconds, pace.rate, pace.left))
    return results
