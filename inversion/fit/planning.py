"""Plans for fits: one plan that is valid for all scenes and lidars within the bounds of the unknowns.

A compiled simulation has loops of fixed length and a fixed time axis. In a fit the scene or the lidar moves,
so that both have to be long enough for every case within the bounds. The bounds' corners are examined, which
suffices for quantities that are monotonic in each unknown, such as heights and sizes. Beyond four unknowns
not all corners are examined (`corner_cases`).
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from inversion.fit.unknowns import BoundUnknown, set_lidar_values, set_values
from jaxlidar import Lidar, Plan, Scene, Survey
from jaxlidar import plan as make_plan
from jaxlidar.extend import check_integer, check_kind
from jaxlidar.planning.effects import effects_of_family
from jaxlidar.planning.plan import MIN_BATCHES
from jaxlidar.planning.plan_check import check_pulse, check_reach
from jaxlidar.planning.scene_family import plan_cases

# Up to this many unknowns that change the response, every corner of the bounds is examined: 2^4 of them.
_MAX_UNKNOWNS_FOR_ALL_CORNERS = 4
# Batches of every full evaluation: as few as estimate the noise of a simulation.
N_BATCHES = MIN_BATCHES
# Bytes up to which fits keep scattering histories.
MAX_MEMORY_OF_HISTORIES = 1e9
# Photons of all batches together and rays of each, unless they or a plan are given.
N_PHOTONS, N_RAYS = 65536, 1024


def size_arguments(
    n_photons: int | None, n_rays: int | None, max_orders: int | None, plan: Plan | None
) -> dict[str, Any]:
    """Return the arguments of `plan` for the size of a simulation, from those of `Problem`.

    With a plan, which has its own, they are None.

    **Raises:** ValueError for less than one photon or ray in a batch, and for a plan that is given together
    with a size, which it has already. TypeError for what is no plan.
    """
    check_kind("plan", plan, Plan | None, "a Plan")
    arguments = {"n_photons": n_photons, "n_rays": n_rays, "max_orders": max_orders}
    conflicting = [name for name, value in arguments.items() if value is not None]
    if plan is not None and conflicting:
        raise ValueError(
            f"plan is given together with {', '.join(conflicting)}; admissible is either: make the plan with "
            "them"
        )
    if plan is not None:
        return arguments
    photons = check_integer("n_photons", N_PHOTONS if n_photons is None else n_photons, N_BATCHES)
    rays = check_integer("n_rays", N_RAYS if n_rays is None else n_rays)
    # Rounded up, as in the plan: a number that the batches have already is no other problem.
    return {"n_photons": N_BATCHES * -(-photons // N_BATCHES), "n_rays": rays, "max_orders": max_orders}


# Lidar, scene and unknowns of a record.
FitCase = tuple[Lidar, Scene, list[BoundUnknown]]


def corner_cases(lidar: Lidar, scene: Scene, unknowns: list[BoundUnknown]) -> list[tuple[Lidar, Scene]]:
    """Return lidar and scene at their start, and with the unknowns that plans depend on at their bounds.

    These are the geometric ones, those of extinction, and all of the lidar, whose pulse decides the width of
    time bins. All combinations for up to four unknowns; for more, each alone and all together. An array is at
    its lower or its upper bounds as a whole.
    """
    moving = [i for i, u in enumerate(unknowns) if u.setter.changes_response or u.setter.of_lidar]
    if len(moving) <= _MAX_UNKNOWNS_FOR_ALL_CORNERS:
        corners = (
            [dict(zip(moving, c)) for c in itertools.product(("low", "high"), repeat=len(moving))]
            if moving
            else []
        )
    else:
        corners = [{i: side} for i in moving for side in ("low", "high")]
        corners += [dict.fromkeys(moving, side) for side in ("low", "high")]
    setters = tuple(u.setter for u in unknowns)
    cases = []
    for side_of in [{}, *corners]:
        values = tuple(
            jnp.asarray(getattr(u, side_of[i]), u.start.dtype) if i in side_of else u.start
            for i, u in enumerate(unknowns)
        )
        cases.append((set_lidar_values(lidar, setters, values), set_values(scene, setters, values)))
    return cases


def plan_for_bounds(
    shots: Lidar | Survey,
    scene: Scene,
    unknowns: list[BoundUnknown],
    time: Float[np.ndarray, " samples"],
    *,
    others: Sequence[FitCase] = (),
    max_orders: int | None,
    **sizes: int,
) -> Plan:
    """Plan the starting scene, with loops and fine time bins long enough for all `corner_cases`.

    Fine time bins are those in which light is collected; `time` has the samples of the record. With
    a `Survey` the plan serves all of its shots. `others`: of further records that it serves.

    Orders, and whether histories are kept, are those of the starting scene.

    **Raises:** ValueError for an inadmissible corner, such as a canopy that reaches above the sensor.
    """
    survey, lidar = (shots, shots.middle) if isinstance(shots, Survey) else (None, shots)
    interval = float(lidar.sampling_interval)
    # A thousandth of a sample keeps the last one in a window whose end is rounded.
    window = (float(time[0]), float(time[0]) + (time.size - 1 + 1e-3) * interval)
    cases = [case for start in ((lidar, scene, unknowns), *others) for case in corner_cases(*start)]
    common: dict[str, Any] = {
        "window": window,
        **sizes,
        "effects": effects_of_family([case_scene for _, case_scene in cases]),
    }
    # The first case is the start itself.
    start_lidar, start_scene = cases[0]
    start_shots = start_lidar if survey is None else survey
    start_options = {"max_orders": max_orders, "describe": False, **common}
    first = make_plan(start_shots, start_scene, **start_options)
    # Fits of surveys trace all derivatives, and many shots at once.
    if survey is None and not first.config.keeps_histories:
        first = _plan_with_histories(first, start_lidar, start_scene, **start_options)
    common.update(max_orders=first.orders, histories=first.config.keeps_histories)
    try:
        plan = plan_cases(cases, survey=survey, **common)
    except ValueError as error:
        raise ValueError(f"at the bounds of the unknowns the scene is inadmissible: {error}") from error
    # The orders are those that the start calls for: the plan must refuse scenes that call for more.
    scope = dataclasses.replace(plan.scope, automatic_orders=first.scope.automatic_orders)
    return dataclasses.replace(plan, scope=scope)


def _plan_with_histories(first: Plan, lidar: Lidar, scene: Scene, **options: Any) -> Plan:
    """Return a plan with scattering histories that follows as much light as `first`, or `first`.

    Derivatives with respect to optics cost next to nothing with histories, and another trace each without.
    Fits therefore keep larger ones than simulations do.
    """
    try:
        plan = make_plan(lidar, scene, histories=True, **options)
    except ValueError:
        return first
    follows_as_much = plan.orders >= first.orders
    return plan if follows_as_much and plan.memory <= MAX_MEMORY_OF_HISTORIES else first


def checked_plan(
    plan: Plan | None,
    lidar: Lidar,
    scene: Scene,
    unknowns: list[BoundUnknown],
    time: Float[np.ndarray, " samples"],
    sizes: dict[str, Any],
    others: Sequence[FitCase] = (),
) -> Plan:
    """Check a plan for the samples and for all `corner_cases`, or make one with `plan_for_bounds`.

    A plan that is given may end before the light does: later light is not recorded.

    **Raises:** ValueError for a plan that would leave out recorded light or a part of the scene, and as
    `plan_for_bounds`.
    """
    if plan is None:
        plan = plan_for_bounds(lidar, scene, unknowns, time, others=others, **sizes)
        check_samples(plan, time)
        return plan
    check_samples(plan, time)
    moves_lidar = any(u.setter.of_lidar for u in unknowns)
    # The first case is the start itself.
    starts = ((lidar, scene, unknowns), *others)
    for number, corner in ((n, corner) for start in starts for n, corner in enumerate(corner_cases(*start))):
        try:
            check_reach(plan, *corner)
            if moves_lidar:
                check_pulse(plan, *corner)
        except ValueError as error:
            position = "at the bounds of the unknowns " if number else ""
            raise ValueError(
                f"{position}{error}, or for the largest one within the bounds; without plan= one is made here"
            ) from error
    return plan


def plan_without_record(
    plan: Plan | None,
    lidar: Lidar,
    scene: Scene,
    unknowns: list[BoundUnknown],
    time: Float[np.ndarray, " samples"] | None,
    sizes: dict[str, Any],
) -> Plan:
    """Check a plan for derivatives at the scene alone, or make one. `time`: None for samples of the plan.

    **Raises:** ValueError for a plan that would leave out a part of the scene, and as `plan_for_bounds`.
    """
    moves_lidar = any(u.setter.of_lidar for u in unknowns)
    if plan is None and time is None:
        # Derivatives are needed at the scene only: without sample times, its own plan serves.
        plan = make_plan(lidar, scene, **sizes)
        if moves_lidar:
            # A plan for a beam at nadir knows no other direction, and none of its derivatives.
            plan = plan_for_bounds(lidar, scene, unknowns, sample_times(plan), **sizes)
    elif plan is None:
        assert time is not None
        plan = plan_for_bounds(lidar, scene, unknowns, time, **sizes)
    elif moves_lidar:
        plan = checked_plan(plan, lidar, scene, unknowns, sample_times(plan), sizes)
    else:
        check_reach(plan, lidar, scene)
    if time is not None:
        check_samples(plan, time)
    return plan


def sample_times(plan: Plan) -> Float[np.ndarray, " samples"]:
    """Return the times of the samples of a plan, ns."""
    return plan.sample_start + plan.sample_interval * np.arange(plan.n_samples)


def check_samples(plan: Plan, time: Float[np.ndarray, " samples"]) -> None:
    """Check that the samples of a plan are at `time`. **Raises:** ValueError if they are not."""
    # As for sample times: rounding of single precision is allowed.
    tolerance = 1e-3 * plan.sample_interval + 4e-7 * float(np.max(np.abs(time)))
    expected = sample_times(plan)
    if time.size != plan.n_samples or np.max(np.abs(expected - time)) > tolerance:
        raise ValueError(
            f"time has {time.size} samples from {time[0]:g} to {time[-1]:g} ns, but the plan has "
            f"{plan.n_samples} every {plan.sample_interval:g} ns from {plan.sample_start:g} ns; "
            "they must agree"
        )
