"""The choice of strategy, per shot or shared illumination, for the shots of a survey over one scene."""

import math

import jax.numpy as jnp
import numpy as np

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fields.checks import concrete_array, concrete_number
from jaxlidar._fields.crs import common_system
from jaxlidar._jax.memory import format_bytes
from jaxlidar._registry import survey_lines
from jaxlidar._text import percent
from jaxlidar.optics.laws import AbstractMirror
from jaxlidar.planning.local_origin import move_aim_to_origin
from jaxlidar.planning.parallel_light import beams_are_parallel, parallel_light_bound
from jaxlidar.planning.plan import DEFAULT_RTOL, Plan
from jaxlidar.planning.plan import plan as make_plan
from jaxlidar.planning.setup import Setup, make_setup
from jaxlidar.scenes.scene import Scene
from jaxlidar.sensors.lidar import AIM_DISTANCE
from jaxlidar.sensors.survey import Survey
from jaxlidar.survey.footprint_splines import FootprintSplines, fit_footprints
from jaxlidar.survey.node_groups import IlluminatedNodes, NodeGroup, illuminated_nodes, make_groups
from jaxlidar.survey.per_shot import PerShotStrategy
from jaxlidar.survey.results import OPTIONAL_ARRAYS, SAMPLED_ARRAYS
from jaxlidar.survey.shared_illumination import SharedIlluminationStrategy
from jaxlidar.survey.strategy import AbstractStrategy
from jaxlidar.survey.view_geometry import ViewGeometry

# Shared light is tallied by node or by shot (`shared_illumination`). Constants of the latter are named
# SHOT_TALLIES.
#
# Largest errors, as fractions of rtol, by parallel light and by the grid of nodes; the finest grid may have a
# larger one.
_PARALLEL_LIGHT_OF_RTOL, _GRID_OF_RTOL, _FINEST_GRID_OF_RTOL = 0.5, 0.2, 0.5
# Where responses are tallied by shot, the grid serves only absorption and escape: its error may be as large
# as this, whatever rtol.
_GRID_OF_SHOT_TALLIES = 0.01
# Coefficients below this fraction of rtol, relative to the largest coefficient, do not count. They lie at the
# rim of the footprint; without them its energy changes by less than 0.1 % where rtol is 0.1.
_FAINT_OF_RTOL = 0.01
# Batches of a footprint that shares light are many and small: they have fewer photons and rays than
# those of a shot traced alone, by these factors. Even half of the rays add little to the error.
_PHOTONS_DIVISOR, _RAYS_DIVISOR = 4.0, 2.0
# Tallied by shot, a batch costs something for every shot, and photons cost more: batches have as many photons
# as those of a shot traced alone.
_PHOTONS_DIVISOR_OF_SHOT_TALLIES = 1.0
# Sharing pays where at least this many footprints overlap in the mean, by either tally, for this many shots.
_MIN_OVERLAP, _MIN_OVERLAP_OF_SHOT_TALLIES, _MIN_SHOTS = 1.3, 2.0, 4
# Numbers of rays and of photons of a batch are powers of two in these ranges: surveys share compiled
# programs.
_RAYS, _PHOTONS = (64, 4096), (256, 8192)


def choose_strategy(
    survey: Survey,
    scene: Scene,
    rtol: float | None,
    max_orders: int | None,
    shared: bool | None,
    window: tuple[float, float] | None = None,
    kept_names: tuple[str, ...] = OPTIONAL_ARRAYS,
) -> AbstractStrategy:
    """Return the strategy for the shots of a survey over one scene; arguments are those of `simulate_many`.

    `window`: times of the first and the last sample, ns; None: those that the scene needs. `kept_names`: of
    the `OPTIONAL_ARRAYS` that results have.
    """
    common_system({"survey": survey.crs, "scene": scene.crs})
    plan = make_plan(survey, scene, rtol=rtol, max_orders=max_orders, window=window, describe=False)
    rtol = DEFAULT_RTOL if rtol is None else float(rtol)
    # Eight batches then have 6.4 / rtol^2 photons, before these are rounded and bounded: a sample with a
    # sixth of the light has the relative error rtol.
    photons = _power_of_two(0.8 / rtol**2, *_PHOTONS)
    columns = _columns_of_footprint(plan, survey, scene)
    plan = plan.with_config(n_rays=_rays_of_batch(plan, columns, rtol), photons_per_batch=photons)
    # The setup is that of one shot in the middle of the survey, with the largest zenith angle.
    middle = survey.middle
    setup = make_setup(middle, scene, plan)
    # Coordinates are relative to the survey's middle, where single precision is fine. A scene that cannot be
    # moved keeps its coordinates, and the lidar its position.
    lidar, _ = move_aim_to_origin(middle, scene)
    relative_survey = survey.relative_to(
        (concrete_array(middle.position) - concrete_array(lidar.position))[:2]
    )
    strategy = _shared_illumination(relative_survey, setup, rtol, kept_names, shared)
    if strategy is not None:
        return strategy
    return PerShotStrategy(setup, relative_survey, rtol, kept_names)


@survey_lines.register
def describe_strategy(survey: Survey, scene: Scene, rtol: float, max_orders: int | None) -> tuple[str, ...]:
    """Return lines on how a survey would be traced: the strategy, the work for a shot, and what results take.

    Where one setting makes shots far dearer than another one would, they say which.
    """
    try:
        strategy = choose_strategy(survey, scene, rtol, max_orders, shared=None)
    except ValueError as error:
        return (f"simulate_many refuses this survey: {error}",)
    plan, notes = strategy.setup.plan, []
    if isinstance(strategy, SharedIlluminationStrategy):
        n_nodes = sum(len(group.node_position) for group in strategy.groups)
        how = f"their light is shared, on {n_nodes:,} nodes of a grid"
    else:
        how = f"each is traced apart, in eight batches or more of {plan.n_rays} rays"
        reason = reason_against_sharing(strategy.survey, strategy.setup, rtol)
        notes = [f"light is not shared: {reason or 'that would save no time, as few footprints overlap'}"]
        if plan.orders > 1:
            how += f" and {plan.photons_traced} photons, through {plan.orders} orders"
            notes.append("photons take most of the time: one order (max_orders=1) takes rays alone")
    # Of each array with samples a row a wavelength; components are those of two orders and of materials.
    n_rows = (len(SAMPLED_ARRAYS) + 1 + len(plan.config.materials)) * survey.lidar.wavelength.size
    n_bytes = jnp.result_type(float).itemsize * n_rows * plan.n_samples
    total = format_bytes(n_bytes * len(survey))
    size = (
        f"results: about {format_bytes(n_bytes)} a shot, {total} for all (keep= and path= take less memory)"
    )
    return (f"simulate_many: {len(survey):,} shots; {how}", *notes, size)


def _columns_of_footprint(plan: Plan, survey: Survey, scene: Scene) -> float:
    """Return about how many columns of voxels a footprint meets; infinity without voxels, or with meshes."""
    if scene.canopy is None or scene.meshes:
        return math.inf
    edge = float(np.min(concrete_array(scene.canopy.voxels.voxel_size)[:2]))
    radius = float(np.max(survey.footprint_radius))
    if survey.has_sensor_position:
        # The radius is that 1 m ahead of the sensor: the widest footprint is that of the last return.
        radius *= 0.5 * SPEED_OF_LIGHT * plan.scope.last_return / AIM_DISTANCE
    # In the mean over positions.
    return (1.0 + 2.0 * radius / edge) ** 2


def _rays_of_batch(plan: Plan, columns: float, rtol: float) -> int:
    """Return the number of rays of a footprint in a batch.

    Enough for the tolerance, and at most 32 for each of its `columns` of voxels: more would meet the same
    voxels.
    """
    # Chosen by trial. If the error of N rays is N^(-3/4) (see `per_shot`), that of eight batches is then 0.2
    # rtol at rtol = 0.01, and less than that at larger ones.
    rays = min(10.0 / rtol, 32.0 * columns)
    return min(_power_of_two(rays, *_RAYS), plan.n_rays)


def _power_of_two(x: float, low: int, high: int) -> int:
    """Return the smallest power of two that is not below `x`, within bounds."""
    return int(min(max(2 ** math.ceil(math.log2(x)), low), high))


def _shared_illumination(
    survey: Survey, setup: Setup, rtol: float, kept_names: tuple[str, ...], shared: bool | None
) -> SharedIlluminationStrategy | None:
    """Return the strategy with shared light, or None where shots cannot share it, or where it does not pay.

    1. Can shots share light at all (`reason_against_sharing`)?
    2. Is there a grid whose error is small against the tolerance?
    3. Do enough footprints overlap?
    4. Make groups of nodes.

    `survey` and `setup` have the same origin of coordinates. `shared`: True where shots must share light,
    None where they do if it pays.

    **Raises:** ValueError where shots must share light and cannot.
    """
    if shared is False:
        return None
    reason = reason_against_sharing(survey, setup, rtol)
    if reason is not None:
        if shared:
            raise ValueError(f"shared = True, but {reason}; admissible is None or False")
        return None
    if shared is None and len(survey) < _MIN_SHOTS:
        return None
    tallies_by_shot = _tallies_by_shot(survey)
    grid_error = max(_GRID_OF_RTOL * rtol, _GRID_OF_SHOT_TALLIES) if tallies_by_shot else _GRID_OF_RTOL * rtol
    splines = fit_footprints(survey, grid_error)
    if not tallies_by_shot and splines.error > _FINEST_GRID_OF_RTOL * rtol:
        if shared:
            raise ValueError(
                f"shared = True, but the finest grid misplaces {percent(splines.error)} of the light, at "
                f"rtol = {rtol:g}; admissible is None or False"
            )
        return None
    nodes = illuminated_nodes(splines, _FAINT_OF_RTOL * rtol)
    min_overlap = _MIN_OVERLAP_OF_SHOT_TALLIES if tallies_by_shot else _MIN_OVERLAP
    if shared is None and nodes.overlap < min_overlap:
        return None
    photons_divisor = _PHOTONS_DIVISOR_OF_SHOT_TALLIES if tallies_by_shot else _PHOTONS_DIVISOR
    groups = _groups(splines, nodes, setup, photons_divisor)
    view_geometry = ViewGeometry.of(survey, groups, splines.spacing) if tallies_by_shot else None
    bound = _parallel_light_bound(survey, setup)
    return SharedIlluminationStrategy(
        setup, survey, rtol, kept_names, groups, splines.spacing, view_geometry, bound
    )


def _tallies_by_shot(survey: Survey) -> bool:
    """Return True where shared light is tallied by shot, not by node: oblique beams, or a field of view."""
    return survey.lidar.field_of_view is not None or bool(np.any(survey.zenith > 0))


def _parallel_light_bound(survey: Survey, setup: Setup) -> float:
    return parallel_light_bound(survey, setup.plan.limits.start_distance, setup.plan.scope.last_return)


def _groups(
    splines: FootprintSplines, nodes: IlluminatedNodes, setup: Setup, photons_divisor: float
) -> list[NodeGroup]:
    """Return groups of nodes with as many photons as make batches of a footprint of the size aimed at."""
    plan = setup.plan
    # The sum of the coefficients of a mean footprint, over the largest one. A node with `light` one gets the
    # photons of a batch divided by this sum, so that all nodes of a footprint together have at least a batch.
    light_per_footprint = float(nodes.light.sum()) * nodes.overlap / len(splines.first_node)
    photons = plan.photons_traced / photons_divisor / light_per_footprint
    return make_groups(splines, nodes, photons, plan.n_rays / _RAYS_DIVISOR / light_per_footprint)


def reason_against_sharing(survey: Survey, setup: Setup, rtol: float) -> str | None:
    """Return the reason why the shots of a survey cannot share light; None where they can."""
    canopy, lidar = setup.scene.canopy, setup.lidar
    if survey.altitude is None:
        return "shots are placed by their sensors"
    if np.ptp(survey.altitude) > 0:
        return "shots have more than one altitude"
    if not beams_are_parallel(survey):
        return "shots have more than one direction"
    # Such shots share higher orders alone; their first order has rays of its own in either strategy.
    if _tallies_by_shot(survey) and setup.plan.orders == 1:
        return "one order is followed, which oblique shots and shots with a field of view do not share"
    if not setup.plan.is_random:
        return "nothing is random"
    if concrete_number(lidar.divergence) == 0:
        return "the beam has no width"
    if lidar.ellipse is not None:
        return "the footprint is an ellipse"
    # Where leaves transmit straight on, extinction depends on wavelength: photons cannot be shared among
    # wavelengths.
    if canopy is not None and canopy.is_straight:
        return "transmission = 'straight': light of every wavelength takes other paths"
    # A mirror returns the image of the beam, which depends on the spreading that parallel light lacks.
    if any(isinstance(s.law, AbstractMirror) for s in setup.scene.surfaces):
        return "a surface is a mirror"
    bound = _parallel_light_bound(survey, setup)
    if bound > _PARALLEL_LIGHT_OF_RTOL * rtol:
        return f"light that is not parallel changes up to {percent(bound)} of samples, at rtol = {rtol:g}"
    return None
