"""`simulate_scenes`: the waveforms of many scenes of one structure, in chunks of one compiled program.

A chunk of scenes is simulated by `jax.vmap` within `jax.jit`. Chunks are small enough for their memory, and
run side by side on all cores.
"""

import dataclasses
import os
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray

from jaxlidar._fields.checks import check_integer, check_key, check_kind, has_tracers
from jaxlidar._jax.programs import Program
from jaxlidar._jax.threads import side_by_side
from jaxlidar.planning.memory import memory_limit, transformed_bytes
from jaxlidar.planning.plan import Plan
from jaxlidar.planning.plan_check import check_plan
from jaxlidar.planning.scene_family import plan_scenes, scene_of_stack, stack_size
from jaxlidar.scenes.scene import Scene, check_kinds
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.simulation.one_scene import simulate
from jaxlidar.spectral.waveform import Waveform
from jaxlidar.trace.march.voxel_traversal import with_room

# Scenes of one chunk at most: more gain nothing, as their rays no longer stay in the cache of a core.
MAX_CHUNK = 128


def simulate_scenes(
    lidar: Lidar,
    scenes: Scene,
    *,
    key: PRNGKeyArray,
    plan: Plan | None = None,
    chunk: int | None = None,
) -> Waveform:
    """Simulate the waveforms that a lidar records of many scenes of one structure.

    The waveform of scene i is that of `simulate(lidar, scene_i, plan=plan, key=jax.random.fold_in(key, i))`
    within a JAX transformation: eight batches of the plan's photons and rays, whatever the error, or a single
    pass where nothing is random. It does not depend on the other scenes. Within a transformation values are
    not refused: waveforms are NaN where a value of a scene lies outside of its range, and `lost` is 1 where
    the plan does not cover a scene. The result can be differentiated with respect to lidar and scenes.

    **Arguments:**

    - `lidar`: a `Lidar`, the same for all scenes.
    - `scenes`: a stack, one `Scene` whose arrays have a leading axis of scenes.
      `jax.vmap(make_scene)(values)` makes one of a function of numbers, `jax.tree.map(lambda *a:
      jnp.stack(a), *list_of_scenes)` of a list.
    - `key`: a JAX random key.
    - `plan`: a `Plan` that serves all scenes: see `plan_scenes`. Default None: made here from the stack.
    - `chunk`: scenes that are simulated at once by each core, at least 1: more take more memory. Default
      None: as many as the plan's `max_memory` has room for, 128 at most.

    **Returns:** a `Waveform` with an axis of scenes, and standard errors of each.

    **Raises:** ValueError for arrays that are no stack and other inadmissible arguments, for a plan that does
    not cover one of the scenes, and for scenes that are traced by a JAX transformation without a plan.
    TypeError for arguments of another kind.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> import jax.numpy as jnp
    >>> def make_scene(height, reflectance):
    ...     return jl.Scene(ground=jl.Ground(height=height, reflectance=reflectance))
    >>> heights, reflectances = jnp.linspace(-1.0, 1.0, 100), jnp.linspace(0.1, 0.5, 100)
    >>> scenes = jax.vmap(make_scene)(heights, reflectances)
    >>> waves = jl.simulate_scenes(jl.Lidar(), scenes, key=jax.random.key(0))
    >>> waves.reflectance.shape[:2], f"{float(waves[99].reflectance.sum()):.2f}"
    ((100, 1), '0.50')
    >>> print(waves)
    100 waveforms of 43 samples of 1 ns from -21 ns, at 1064 nm
    """
    check_kinds(lidar, scenes)
    check_key(key)
    number = stack_size(scenes)
    if chunk is not None:
        chunk = check_integer("chunk", chunk)
    is_transformed = has_tracers((lidar, scenes, plan, key))
    refuses = plan is not None
    if plan is None:
        if is_transformed:
            raise ValueError(
                "the scenes are being traced by a JAX transformation: make the plan outside, by "
                "plan_scenes, and pass it as plan="
            )
        plan = plan_scenes(lidar, scenes)
    check_kind("plan", plan, Plan, "a Plan")
    size = min(_affordable_chunk(plan) if chunk is None else chunk, number)
    if is_transformed:
        # One after the other: a transformation cannot run threads.
        numbers = jnp.arange(number)
        waveform_of_scene = _scene_simulation(lidar, plan, key)
        waveforms = jax.lax.map(lambda pair: waveform_of_scene(*pair), (scenes, numbers), batch_size=size)
    else:
        waveforms = _simulate_in_chunks(lidar, scenes, plan, key, number, size, refuses)
    # All scenes have the lidar and the plan, and so the samples, of the first.
    axes = {name: getattr(waveforms, name)[0] for name in ("time", "height", "wavelength")}
    return dataclasses.replace(waveforms, **axes)


def _affordable_chunk(plan: Plan) -> int:
    """Return the number of scenes at once that the plan's memory has room for."""
    size = transformed_bytes(plan.config, plan.bins, degree=plan.degree, n_traces=plan.n_traces)
    chunks_at_once = os.cpu_count() or 1
    return max(1, min(MAX_CHUNK, int(memory_limit(plan.scope.max_memory) / (chunks_at_once * size))))


def _scene_simulation(lidar: Lidar, plan: Plan, key: PRNGKeyArray) -> Any:
    def waveform_of_scene(scene: Scene, number: Int[Array, ""]) -> Waveform:
        wave = simulate(lidar, scene, plan=plan, key=jax.random.fold_in(key, number))
        # What `info` says of a single simulation, such as its seconds, is not that of a scene of many.
        return dataclasses.replace(wave, info={})

    return waveform_of_scene


def _simulate_chunk(
    lidar: Lidar, scenes: Scene, plan: Plan, key: PRNGKeyArray, numbers: Int[Array, " chunk"]
) -> Waveform:
    return jax.vmap(_scene_simulation(lidar, plan, key))(scenes, numbers)


def _refuse_uncovered(lidar: Lidar, scenes: Scene, plan: Plan, numbers: np.ndarray) -> None:
    """Refuse a plan that does not cover one of the scenes with these numbers.

    Their waveforms say that they may not be covered; the check itself takes milliseconds for each scene.
    """
    for i in numbers:
        scene = jax.tree.map(jnp.asarray, scene_of_stack(scenes, int(i)))
        try:
            check_plan(plan, lidar, scene)
        except ValueError as error:
            raise ValueError(f"scenes[{i}]: {error}; plan_scenes makes one for all scenes") from error


# One core each: chunks run side by side on threads.
_compiled_chunk = Program(_simulate_chunk, one_core=True)


def _simulate_in_chunks(
    lidar: Lidar, scenes: Scene, plan: Plan, key: PRNGKeyArray, number: int, size: int, refuses: bool
) -> Waveform:
    """Simulate chunk after chunk on all cores, and join them.

    1. Take the rows of each chunk on the host; the last is filled up with its last scene, so that all chunks
       have one shape, and share one program.
    2. Simulate chunks side by side; where `refuses`, refuse a scene that the plan does not cover.
    3. Join their waveforms, without what filled up the last.
    """
    host_scenes = jax.tree.map(np.asarray, scenes)

    def simulate_rows(start: int) -> Waveform:
        rows = np.minimum(np.arange(start, start + size), number - 1)
        chunk_scenes = jax.tree.map(lambda a: a[rows], host_scenes)
        if chunk_scenes.canopy is not None:
            voxels = with_room(chunk_scenes.canopy.voxels)
            chunk_scenes = eqx.tree_at(lambda s: s.canopy.voxels, chunk_scenes, voxels)
        wave = _compiled_chunk(lidar, chunk_scenes, plan, key, rows.astype(np.int32))
        wave = jax.tree.map(lambda a: np.asarray(a)[: number - start], wave)
        if refuses:
            _refuse_uncovered(lidar, host_scenes, plan, start + np.flatnonzero((wave.lost >= 1).all(axis=1)))
        return wave

    with side_by_side() as run:
        waves = list(run(simulate_rows, range(0, number, size)))
    return jax.tree.map(lambda *a: jnp.asarray(np.concatenate(a)), *waves)
