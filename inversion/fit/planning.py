"""Plans that are valid for every scene within the bounds of the geometric unknowns."""

import dataclasses
import itertools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from inversion.fit.unknowns import Settled, put
from jaxlidar import Lidar, Plan, Scene
from jaxlidar import plan as make_plan
from jaxlidar.extend import check_integer, check_kind
from jaxlidar.planning.effects import find_empty_materials
from jaxlidar.planning.path_lengths import PathLengths
from jaxlidar.planning.plan import MIN_BATCHES
from jaxlidar.planning.plan_check import check_reach
from jaxlidar.planning.size_buckets import size_bucket

# With more geometric unknowns than this, not every corner of the bounds is examined.
_ALL_CORNERS = 4


# Of all batches together, where neither they nor a plan are given.
N_PHOTONS, N_RAYS = 65536, 8192


def batch_sizes(
    n_photons: float | None, n_rays: float | None, max_orders: int | None, plan: Plan | None
) -> tuple[int, int]:
    """Photons and rays of each batch of a simulation.

    **Raises:** ValueError for less than one in a batch, and for a plan together with what it would replace.
    """
    own = {"n_photons": n_photons, "n_rays": n_rays, "max_orders": max_orders}
    given = [name for name, value in own.items() if value is not None]
    if plan is not None and given:
        raise ValueError(
            f"plan is given together with {', '.join(given)}; admissible is either: make the plan with them"
        )
    photons = check_integer("n_photons", N_PHOTONS if n_photons is None else n_photons, MIN_BATCHES)
    rays = check_integer("n_rays", N_RAYS if n_rays is None else n_rays, MIN_BATCHES)
    return photons // MIN_BATCHES, rays // MIN_BATCHES


def corners(scene: Scene, settled: list[Settled]) -> list[Scene]:
    """The scene at its start, and with the geometric unknowns at their bounds.

    All combinations for up to four unknowns; for more, each alone and all together. An array is at its low or
    its high bounds as a whole.
    """
    moving = [i for i, s in enumerate(settled) if s.place.traced]
    if len(moving) <= _ALL_CORNERS:
        sides = [dict(zip(moving, c)) for c in itertools.product("lh", repeat=len(moving))] if moving else []
    else:
        sides = [{i: c} for i in moving for c in "lh"] + [dict.fromkeys(moving, c) for c in "lh"]
    scenes = []
    for side in [{}, *sides]:
        values = [
            s.start if i not in side else jnp.asarray(s.low if side[i] == "l" else s.high, s.start.dtype)
            for i, s in enumerate(settled)
        ]
        scenes.append(put(scene, tuple(s.place for s in settled), tuple(values)))
    return scenes


def plan_for(
    lidar: Lidar,
    scene: Scene,
    settled: list[Settled],
    time: Float[np.ndarray, " bins"],
    *,
    max_orders: int | None,
    photons: int,
    rays: int,
) -> Plan:
    """The plan of the starting scene, with loops and time bins long enough for all `corners`.

    Letters, orders and step lengths are those of the starting scene.

    **Raises:** ValueError where a corner is inadmissible, such as a canopy that reaches above the sensor.
    """
    interval = float(lidar.sampling_interval)
    window = (float(time[0]), float(time[0]) + (time.size - 1 + 1e-3) * interval)
    scenes = corners(scene, settled)
    common = {"window": window, "n_photons": photons, "n_rays": rays, "describe": False}
    # What is zero at the start may be more elsewhere.
    common["effects"] = dict.fromkeys(find_empty_materials(scenes[0]), True)
    first = make_plan(lidar, scenes[0], max_orders=max_orders, **common)
    common.update(max_orders=first.orders, bin_width=first.bins.width)
    if scene.canopy is not None:
        common.update(max_step=first.limits.max_segment)
    plans = [first]
    for corner in scenes[1:]:
        try:
            plans.append(make_plan(lidar, corner, **common))
        except ValueError as error:
            raise ValueError(f"at the bounds of the unknowns the scene is inadmissible: {error}") from error
    start = min(p.bins.start for p in plans)
    end = max(p.bins.start + p.bins.width * p.bins.count for p in plans)
    bins = dataclasses.replace(
        first.bins,
        start=start,
        count=round((end - start) / first.bins.width),
        max_span=max(p.bins.max_span for p in plans),
    )
    start_distance = max(p.limits.start_distance for p in plans)
    max_path = max(p.limits.max_path for p in plans)
    extents = [PathLengths(lidar, s) for s in scenes]
    longest = max_path + start_distance
    plan = first.with_limits(
        start_distance=start_distance,
        max_path=max_path,
        max_flight=max(e.longest_flight(longest) for e in extents),
    ).with_config(
        max_ray_segments=max(p.config.max_ray_segments for p in plans),
        max_faces=size_bucket(max(e.max_faces(longest) for e in extents)),
        covers_fully=tuple(all(c) for c in zip(*(p.config.covers_fully for p in plans))),
    )
    return dataclasses.replace(plan, bins=bins)


def plan_within(
    plan: Plan | None,
    lidar: Lidar,
    scene: Scene,
    settled: list[Settled],
    time: Float[np.ndarray, " bins"],
    **sizes: Any,
) -> Plan:
    """A plan that was given, checked for the samples and for all `corners`; or else one of `plan_for`.

    A given plan may end before the light does: what comes then is not recorded.

    **Raises:** ValueError where a plan would leave out light that is recorded, or a part of the scene, and as
    `plan_for`.
    """
    given = plan is not None
    if plan is None:
        plan = plan_for(lidar, scene, settled, time, **sizes)
    check_samples(plan, time)
    for number, corner in enumerate(corners(scene, settled) if given else ()):
        try:
            check_reach(plan, lidar, corner)
        except ValueError as error:
            where = "at the bounds of the unknowns " if number else ""
            raise ValueError(
                f"{where}{error}, or for the largest one within the bounds; without plan= one is made here"
            ) from error
    return plan


def check_samples(plan: Plan, time: Float[np.ndarray, " bins"]) -> None:
    """Check that the samples of a plan are at `time`. **Raises:** ValueError where they are not."""
    check_kind("plan", plan, Plan, "a Plan")
    slack = 1e-3 * plan.sample_interval + 4e-7 * float(np.max(np.abs(time)))
    expected = plan.sample_start + plan.sample_interval * np.arange(plan.n_samples)
    if time.size != plan.n_samples or np.max(np.abs(expected - time)) > slack:
        raise ValueError(
            f"time has {time.size} samples from {time[0]:g} to {time[-1]:g} ns, but the plan has "
            f"{plan.n_samples} every {plan.sample_interval:g} ns from {plan.sample_start:g} ns; "
            "they must agree"
        )
