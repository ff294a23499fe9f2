"""The way in which the shots of a survey are traced over one scene."""

import math

import numpy as np

from jaxlidar._checks import concrete_array
from jaxlidar.instrument.survey import Survey
from jaxlidar.planning.local_origin import about_aim
from jaxlidar.planning.plan import DEFAULT_RTOL, Plan
from jaxlidar.planning.plan import plan as make_plan
from jaxlidar.planning.setup import make_setup
from jaxlidar.scenes.scene import Scene
from jaxlidar.survey.sharing import sharing
from jaxlidar.survey.ways import AbstractWay, OneByOne, SharedLight


def prepared(
    survey: Survey,
    scene: Scene,
    rtol: float | None,
    max_orders: int | None,
    shared: bool | None,
    window: tuple[float, float] | None = None,
) -> AbstractWay:
    """The way of the shots of a survey over one scene; arguments are those of `simulate_many`.

    `window`: times of the first and the last sample, ns; None: what the scene calls for.
    """
    plan = make_plan(survey, scene, rtol=rtol, max_orders=max_orders, window=window, describe=False)
    rtol = DEFAULT_RTOL if rtol is None else float(rtol)
    plan = plan.with_config(
        n_rays=_rays(plan, survey, scene, rtol), n_photons=_power_of_two(0.8 / rtol**2, 256, 8192)
    )
    middle = survey.middle
    setup = make_setup(middle, scene, plan)
    lidar, _ = about_aim(middle, scene)
    # A scene that cannot be moved keeps its coordinates, and the lidar its place.
    moved = survey.about(concrete_array(middle.position) - concrete_array(lidar.position))
    light = sharing(moved, setup, rtol, shared)
    if light is None:
        return OneByOne(setup, moved, rtol)
    return SharedLight(setup, moved, rtol, light)


def _rays(plan: Plan, survey: Survey, scene: Scene, rtol: float) -> int:
    """Rays of a footprint per batch: enough for the tolerance, and not many for each column of voxels."""
    most = 10.0 / rtol
    if scene.canopy is not None:
        edge = float(np.min(concrete_array(scene.canopy.voxels.voxel_size)[:2]))
        columns = (1.0 + 2.0 * float(np.max(survey.footprint_radius)) / edge) ** 2
        most = min(most, 32.0 * columns)
    return min(_power_of_two(most, 64, 4096), plan.n_rays)


def _power_of_two(x: float, low: int, high: int) -> int:
    return int(min(max(2 ** math.ceil(math.log2(x)), low), high))
