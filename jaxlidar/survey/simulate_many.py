"""`simulate_many`: simulate the waveforms of all shots of a survey.

1. Check the arguments.
2. Choose the strategy that cuts the shots into tasks: per shot (`per_shot`), shared illumination
   (`shared_illumination`), or, for a scene larger than memory, one of these for each tile (`tiled_scene`).
3. Run the tasks: in this process, on its devices, or by workers.
4. Collect their results in `Waveforms` (`collect`). With a `path`, they go to a store as they come, and a
   later call runs the remaining tasks alone.
"""

import functools
import os
import time
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Int, PRNGKeyArray

from jaxlidar._fields.checks import (
    check_choice,
    check_flag,
    check_integer,
    check_key,
    check_kind,
    has_tracers,
    is_within_program,
    warn_user,
)
from jaxlidar._fields.crs import common_system
from jaxlidar._fingerprint import fingerprint
from jaxlidar._jax.workers import WorkUnit, outcomes
from jaxlidar._registry import simulate_survey
from jaxlidar.progress import Progress, ProgressOption, shows_progress
from jaxlidar.results.case import Case, case_text
from jaxlidar.results.store import check_store_path, open_store
from jaxlidar.scenes.scene import Scene, check_kinds
from jaxlidar.scenes.scene_parts import SceneParts
from jaxlidar.sensors.survey import Survey
from jaxlidar.survey.acquisition import acquisition_of
from jaxlidar.survey.choose_strategy import choose_strategy
from jaxlidar.survey.collect import ShotsInMemory, StoredSurvey, SurveyResults, waveforms_in_memory
from jaxlidar.survey.coverage import (
    OffMapWarning,
    beams_are_narrow,
    ground_heights,
    is_cut_off,
    off_map,
    off_map_message,
    shots_on_ground,
)
from jaxlidar.survey.results import OPTIONAL_ARRAYS
from jaxlidar.survey.strategy import AbstractStrategy, SurveyTask
from jaxlidar.survey.tiled_scene import TiledSceneStrategy
from jaxlidar.survey.truths import truth_tasks
from jaxlidar.survey.waveforms import Waveforms


@simulate_survey.register
@shows_progress
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
    progress: ProgressOption = None,
    shared: bool | None = None,
    truth: bool = False,
    keep: Collection[str] | None = None,
    beyond: str = "refuse",
) -> Waveforms:
    """Simulate the waveforms that all shots of a survey record of one scene.

    One program is compiled for all shots. They are traced with one of two strategies:

    - *Shared illumination*: shots of one direction share light where their footprints overlap. Parallel light
      falls on the area that they cover and is traced once. For shots straight down without a field of view,
      it is separated by where it enters, on a grid: every footprint is a weighted sum, and the error of the
      grid is part of the standard errors. For other shots, each path is weighted by the irradiance of the
      shot's own beam where the path enters, and by its field of view where the path ends. That is exact and
      takes longer; the first order is traced for each shot alone. The effect of light that is not parallel is
      bounded (`info["parallel light"]`). Standard errors are those of each shot; errors of neighbours are
      correlated.
    - *Per shot*: all other shots are traced one by one. A shot costs the same over a map of any size, because
      the work for the map itself is done once for many shots. Its random numbers follow from its number in
      the survey, whatever the other shots are.

    Batches are traced until the error of every shot is below the tolerance, as `simulate` defines it, or 1024
    batches are done (`Waveforms.error` is the error that was reached). Results do not depend on the number of
    workers or devices, nor on whether the run was interrupted.

    All waveforms have one time axis, from the first return of any shot to the last; over steep terrain it is
    long. For derivatives, use `simulate`.

    **Arguments:**

    - `survey`: a `Survey`.
    - `scene`: a `Scene`; or `SceneParts`, for one that is larger than memory.
    - `key`: a JAX random key. The same key gives the same waveforms.
    - `rtol`: relative error to reach for every shot, in (0, 1). Default None: 0.01. In narrow shots
      at first order, what covers less than a tenth of `rtol` of a footprint may be met by no ray, and is then
      not in the standard error.
    - `max_orders`: follow light for this many scatterings, whatever `rtol` needs; at least 1. Default None:
      from `rtol` and the optics.
    - `path`: a Zarr store, whose name ends in ".zarr", for the waveforms as they come, with their case, so
      that `jaxlidar.rerun` can simulate them again. The same call goes on with what is there, also after it
      was killed; where all is there, it reads it. Damaged chunks are named in a warning and their shots
      traced again. One run at a time can use it. Only a few shots are in memory at a time, also of what is
      returned: its arrays beyond 64 MB are read where they are used. Default None: no store.
    - `executor`: a `concurrent.futures.Executor`, whose workers do tasks (chunks of shots, groups of nodes of
      the grid, or tiles of the scene): a process pool (with the start method "spawn" or "forkserver"), that
      of a Dask client (`client.get_executor()`; the extra `cluster` installs Dask), of mpi4py. A task whose
      worker dies gets a second try. Default None: this process, on all cores.
    - `mesh`: a `jax.sharding.Mesh`, whose devices do tasks: each takes the next one. A program is compiled
      for each device. Default None: the default device.
    - `progress`: True for a bar with the time left; or a function called with a `Progress` after every task.
      Default None: silent.
    - `shared`: True traces with shared illumination, and refuses shots that cannot share light; False traces
      per shot. Default None: shared where it is possible and saves time.
    - `truth`: True adds `Waveforms.truth`: reference quantities computed from the scene itself (gap
      probability, area densities, heights), to train or to test retrieval algorithms. Default False.
    - `keep`: names of the arrays to keep, of "reflectance", "stderr", "energy", "recorded", "components",
      "energy_budget" and "energy_budget_stderr"; for instance ("recorded", "energy", "stderr", "components")
      for `Waveforms.returns`. The others are neither in memory nor in the file, and their use is refused.
      Default None: all.
    - `beyond`: "miss" leaves shots off the scene empty: those whose footprints are not on its open terrain.
      Their waveforms, standard errors and photons are zero, their `ground_position` and truth NaN; the others
      are those of `survey.within(scene)`, and there must be one. Default "refuse": such shots are refused.

    **Returns:** a `Waveforms`.

    **Warns:** `OffMapWarning` where footprints lie partly outside the voxel map of a stand,
    `LateLightWarning` where more of the light than `rtol` returns after the end of the record,
    `UnfollowedLightWarning` where orders that are not followed may add more than `rtol`.

    **Raises:** TypeError for arguments of another class, and inside a JAX transformation. ValueError, before
    any work, for inadmissible arguments, a scene that reaches up to the sensor, shots off the scene (see
    `beyond`), a survey and a scene whose `crs` differ, a receiver whose window opens at the first return,
    shots that must share light and cannot, and a `path` that is no Zarr store, or has results of another
    problem, naming what differs. OSError for a `path` that another run uses, or that cannot be written.
    RuntimeError where the workers of a task die twice.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> survey = jl.Survey.track(jl.Lidar(), start=(0, 0), end=(100, 0), spacing=50.0)
    >>> scene = jl.Scene(ground=jl.Ground(height=5.0, reflectance=0.4, slope=5.0, aspect=90.0))
    >>> many = jl.simulate_many(survey, scene, key=jax.random.key(0))
    >>> print(many.ground_height.round(2).tolist(), f"{float(many[0].reflectance.sum()):.2f}")
    [5.0, 0.63, -3.75] 0.40
    """
    check_kind("survey", survey, Survey, "a Survey, as in Survey(lidar, position=...)")
    _check_not_transformed(survey, scene, key)
    if not isinstance(scene, SceneParts):
        check_kinds(survey.lidar, scene)
    check_key(key)
    check_kind("path", path, str | os.PathLike | None, "a path, or None")
    if path is not None:
        check_store_path(Path(path))
    check_kind("executor", executor, Executor | None, "a concurrent.futures.Executor, or None")
    check_kind("mesh", mesh, jax.sharding.Mesh | None, "a jax.sharding.Mesh, or None")
    devices = None if mesh is None else _devices(mesh, executor)
    check_kind("shared", shared, bool | None, "True, False or None")
    check_flag("truth", truth)
    kept_names = _kept_names(keep)
    if max_orders is not None:
        max_orders = check_integer("max_orders", max_orders)
    # Waveforms share one time axis, in memory and in files.
    if survey.lidar.opens_at_first_return:
        raise ValueError(
            "receiver window = 'first return' gives every shot a time axis of its own; admissible is 'fixed'"
        )
    check_choice("beyond", beyond, ("refuse", "miss"))
    start_time = time.perf_counter()
    hits = _hits(survey, scene) if beyond == "miss" else None
    if isinstance(scene, SceneParts):
        strategy = TiledSceneStrategy.of(survey, scene, rtol, max_orders, shared, truth, kept_names)
        off_map_fractions, heights = strategy.off_map, strategy.ground_height
    else:
        shots = survey if hits is None else survey.subset(hits)
        strategy = choose_strategy(shots, scene, rtol, max_orders, shared, kept_names=kept_names)
        setup = strategy.setup
        off_map_fractions = off_map(strategy.survey, setup.scene)
        heights = ground_heights(strategy.survey, setup.scene, setup.plan.limits.start_distance)
        if hits is not None:
            off_map_fractions, heights_of_hits = off_map(survey, scene), heights
            heights = np.full(len(survey), np.nan)
            heights[hits] = heights_of_hits
    # Tiles are parts of a stand, whose sides are not looked at.
    may_miss_plants = isinstance(scene, SceneParts) or (scene.canopy is not None and is_cut_off(scene.canopy))
    if may_miss_plants and (message := off_map_message(off_map_fractions)) is not None:
        warn_user(message, OffMapWarning)
    survey_fields: dict[str, Any] = {
        **_stated_geometry(survey),
        "ground_height": heights,
        "off_map": off_map_fractions,
        "acquisition": acquisition_of(survey),
    }
    run_tasks = functools.partial(outcomes, executor=executor, devices=devices)
    is_narrow = isinstance(scene, Scene) and beams_are_narrow(survey, scene.canopy)
    crs = common_system({"survey": survey.crs, "scene": scene.crs if isinstance(scene, Scene) else None})
    info: dict[str, Any] = {"automatic orders": max_orders is None, "narrow beams": is_narrow, "crs": crs}
    info |= {} if survey.stated is None else {"disturbed": True}
    info |= {} if hits is None else {"missed": len(survey) - len(hits)}
    if path is None:
        light, truths = ShotsInMemory(len(survey), hits), ShotsInMemory(len(survey), hits, np.nan)
        results = SurveyResults(strategy, light, truths, {})
        _trace(results, _tasks(strategy, key, truth), run_tasks, progress)
        return waveforms_in_memory(results, survey_fields, start_time, **info)

    # Digests of all that the waveforms depend on: results of another problem are neither used nor
    # overwritten.
    options = {} if hits is None else {"beyond": beyond}
    scene_content = (scene, strategy.digests) if isinstance(strategy, TiledSceneStrategy) else scene
    problem = fingerprint(
        {
            "survey": survey,
            "scene": scene_content,
            "key": key,
            "rtol": strategy.rtol,
            "max_orders": max_orders,
            "shared": strategy.info()["shared"],
            "truth": bool(truth),
            "keep": kept_names,
            **options,
        }
    )
    arguments = {"rtol": rtol, "max_orders": max_orders, "shared": shared, "truth": truth}
    arguments |= options | ({} if keep is None else {"keep": kept_names})
    case = None if isinstance(scene, SceneParts) else _case(survey, scene, key, arguments)
    with open_store(path, problem) as store:
        tasks = _tasks(strategy, key, truth)
        stored_survey = StoredSurvey(store, strategy, tasks, survey_fields, hits, case)
        try:
            _trace(stored_survey.results, tasks, run_tasks, progress)
        except KeyboardInterrupt as error:
            error.add_note(f"finished shots are kept in {path}: the same call continues with them")
            raise
        stored_survey.finish(start_time, **info)
    return Waveforms.open(path)


def _hits(survey: Survey, scene: Scene | SceneParts) -> Int[np.ndarray, " hits"] | None:
    """Return the numbers of the shots that lie on a scene; None where all do. **Raises:** ValueError."""
    if isinstance(scene, SceneParts):
        raise ValueError("beyond = 'miss' is given with SceneParts; admissible is 'refuse', or a Scene")
    is_on_ground = shots_on_ground(survey, scene)
    if not is_on_ground.any():
        # With a message that has both extents.
        survey.within(scene)
    return None if is_on_ground.all() else np.flatnonzero(is_on_ground)


def _stated_geometry(survey: Survey) -> dict[str, np.ndarray]:
    """Return position, zenith and azimuth as a survey states them, which light need not see."""
    if survey.stated is None:
        return {"position": survey.position, "zenith": survey.zenith, "azimuth": survey.azimuth}
    return {"position": survey.stated[:, :3], "zenith": survey.stated[:, 3], "azimuth": survey.stated[:, 4]}


def _kept_names(keep: Collection[str] | None) -> tuple[str, ...]:
    """Return the names of the arrays to keep, in order. **Raises:** TypeError and ValueError."""
    if keep is None:
        return OPTIONAL_ARRAYS
    # A string is a collection, too, of letters.
    admissible = f"names, as in keep=({', '.join(map(repr, OPTIONAL_ARRAYS))})"
    check_kind("keep", keep, tuple | list | set | frozenset, f"a tuple of {admissible}, or None")
    for name in keep:
        check_choice("keep", name, OPTIONAL_ARRAYS)
    return tuple(name for name in OPTIONAL_ARRAYS if name in keep)


def _check_not_transformed(survey: Survey, scene: Scene | SceneParts, key: PRNGKeyArray) -> None:
    """Refuse to run within a JAX transformation. **Raises:** TypeError."""
    # Tasks run until their tolerance is met, on the host. Within a program nothing of the arguments need be
    # traced: all that is computed of them is.
    if is_within_program() or has_tracers((survey, scene, key)):
        raise TypeError(
            "simulate_many cannot run inside a JAX transformation (jit, grad, vmap, ...): it traces until "
            "the tolerance of every shot is met. Call it outside, or use simulate for each shot, with plan= "
            "made outside"
        )


def _case(survey: Survey, scene: Scene, key: PRNGKeyArray, arguments: dict[str, Any]) -> Case | None:
    """Return the case of a call, or None where the scene or the lidar has classes of the user's own."""
    set_arguments = {name: value for name, value in arguments.items() if value is not None}
    case = Case(survey=survey, scene=scene, key=key, arguments=set_arguments)
    try:
        # The case is written when all is traced: find out before whether it can be.
        case_text(case)
    except TypeError:
        return None
    return case


def _devices(mesh: jax.sharding.Mesh, executor: Executor | None) -> list[Any]:
    """Return the devices of a mesh. **Raises:** as `simulate_many`."""
    if executor is not None:
        raise ValueError(
            "mesh and executor are both given; admissible is one: workers have their own devices"
        )
    devices, process = list(mesh.devices.flat), jax.process_index()
    if remote := [device for device in devices if device.process_index != process]:
        raise ValueError(
            f"mesh has {len(remote)} of {len(devices)} devices in other processes ({remote[0]}); admissible "
            "are devices of this process; for several processes give an executor"
        )
    return devices


def _tasks(strategy: AbstractStrategy, key: PRNGKeyArray, truth: bool) -> list[SurveyTask]:
    """Return the tasks of a strategy, and those that find the truth of its shots; a tile's are its own."""
    tasks = strategy.tasks(key)
    if truth and not isinstance(strategy, TiledSceneStrategy):
        tasks += truth_tasks(strategy, key, len(tasks))
    return tasks


def _trace(
    results: SurveyResults,
    tasks: list[SurveyTask],
    run_tasks: Callable[[list[WorkUnit]], Iterator[tuple[WorkUnit, Any]]],
    progress: ProgressOption,
) -> None:
    """Run the tasks without a result yet, until the results of all shots are there."""
    shots, missing_units = len(results.strategy.survey), [t.unit for t in tasks if not results.is_done(t)]
    n_done = len(tasks) - len(missing_units)
    # Shots are counted in proportion to tasks: with shared illumination no task has shots of its own.
    start_time, stored = time.perf_counter(), shots * n_done // len(tasks)
    for unit, result in run_tasks(missing_units):
        results.add(tasks[unit.number], result)
        n_done += 1
        if callable(progress):
            seconds = time.perf_counter() - start_time
            progress(Progress(shots * n_done // len(tasks), shots, seconds, stored=stored))
    results.sum_contributions()
