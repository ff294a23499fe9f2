"""Check that a plan that was made earlier serves a lidar and a scene."""

import math
from collections.abc import Callable, Iterator, Sequence

from jaxlidar._checks import concrete_number
from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.optics.laws import AbstractMirror
from jaxlidar.planning.channels import largest_albedo, number_channels, scene_optics
from jaxlidar.planning.effects import consists_of_planes, find_empty_materials, without_effects
from jaxlidar.planning.local_origin import move_aim_to_origin
from jaxlidar.planning.orders import choose_orders
from jaxlidar.planning.path_lengths import PathLengths, check_footprints_on_terrain, meshes_are_in_reach
from jaxlidar.planning.plan import Plan
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.surfaces import AbstractSheet
from jaxlidar.scenes.terrain import Terrain

# Lengths and times may differ by the rounding of single precision.
_ROUNDING = 1e-5


def check_plan(plan: Plan, lidar: Lidar, scene: Scene) -> None:
    """Refuse a plan that does not fit: one that would leave out light, or a part of the scene.

    **Raises:** ValueError that names what does not fit, with numbers.
    """
    _check(plan, lidar, scene, (_misfit_materials, _misfit_lengths, _misfit_times, _misfit_pulse))


def check_reach(plan: Plan, lidar: Lidar, scene: Scene) -> None:
    """Refuse a plan whose materials or path lengths do not fit, whatever its pulse and recorded times.

    **Raises:** ValueError that names what does not fit, with numbers.
    """
    _check(plan, lidar, scene, (_misfit_materials, _misfit_lengths))


def check_pulse(plan: Plan, lidar: Lidar, scene: Scene) -> None:
    """Refuse a plan that does not fit the pulse of a lidar.

    **Raises:** ValueError that names what does not fit, with numbers.
    """
    _check(plan, lidar, scene, (_misfit_pulse,))


def _check(plan: Plan, lidar: Lidar, scene: Scene, checks: Sequence[Callable]) -> None:
    check_footprints_on_terrain(lidar, scene)
    ground = scene.ground
    if plan.scope.flat_terrain and isinstance(ground, Terrain) and ground.relief and not ground.is_plane():
        raise ValueError("the plan does not fit: it takes the terrain for a plane; make one for this terrain")
    for name in plan.scope.empty_materials:
        if name not in find_empty_materials(scene):
            raise ValueError(
                f"the plan does not fit: it is for a map without {name}; make one for this scene"
            )
    if plan.scope.unreached_meshes and meshes_are_in_reach(lidar, scene):
        raise ValueError(
            "the plan does not fit: it is for meshes that no ray meets; make one for this lidar and scene"
        )
    # The plan is for the scene without the effects that it leaves out: compare like with like.
    lidar, scene = without_effects(*move_aim_to_origin(lidar, scene), plan.off)
    for check in checks:
        for misfit in check(plan, lidar, scene):
            raise ValueError(f"the plan does not fit: {misfit}; make one for this lidar and this scene")


def _misfit_materials(plan: Plan, lidar: Lidar, scene: Scene) -> Iterator[str]:
    """Yield misfits in materials, their channels, and the orders that their albedo calls for."""
    optics, config, scope = scene_optics(lidar, scene), plan.config, plan.scope
    scatterers = number_channels(optics)
    missing, surplus = (
        ", ".join(sorted(set(a) - set(b)))
        for a, b in (
            (scatterers.channels, config.channels),
            (config.materials, scatterers.materials),
        )
    )
    if missing:
        yield f"it has {', '.join(config.channels) or 'no scatterers'}; the scene also has {missing}"
    if surplus or config.materials != scatterers.materials:
        has = ", ".join(scatterers.materials) or "no scatterers"
        yield f"it has {', '.join(config.materials)}; the scene has {has}"
    # A plan may have a channel for a transmittance that is zero here, but not for one that the scene cannot
    # have.
    possible = {f"{o.name}.R" for o in optics} | {
        f"{o.name}.T" for o in optics if o.transmittance is not None
    }
    impossible = ", ".join(sorted(set(config.channels) - possible))
    if impossible:
        yield f"it has {impossible}; what the scene transmits is not scattered"
    has_gaps = [isinstance(s, AbstractSheet) and concrete_number(s.coverage) < 1 for s in scene.surfaces]
    if any(full and partial for full, partial in zip(config.covers_fully, has_gaps)):
        yield "it has plates that cover everything; the scene's have gaps"
    if config.mirrors != tuple(isinstance(s.law, AbstractMirror) for s in scene.surfaces):
        yield "its surfaces and the scene's differ in which are mirrors"
    hotspot = scene.canopy is not None and scene.canopy.hotspot
    if config.hotspot != hotspot:
        yield f"it has hotspot = {config.hotspot}; the canopy has hotspot = {hotspot}"
    if config.vertical and concrete_number(lidar.zenith) != 0:
        yield f"it is for a beam at nadir; zenith = {concrete_number(lidar.zenith):g} degrees"
    if config.uses_quadrature and not consists_of_planes(scene):
        yield "it is for planes; the scene has more"
    # Orders that the user chose are followed whatever the albedo. A larger albedo may still need no more.
    albedo = largest_albedo(optics)
    if scope.automatic_orders and albedo > scope.albedo + 1e-3:
        histories, n_channels = plan.config.keeps_histories, len(scatterers.channels)
        needed = choose_orders(scene, optics, n_channels, plan.rtol, None, histories).count
        if needed > plan.orders:
            yield (
                f"it follows {plan.orders} orders, for albedos up to {scope.albedo:.3g}; the scene has "
                f"{albedo:.3g}, which calls for {needed}"
            )


def _misfit_lengths(plan: Plan, lidar: Lidar, scene: Scene) -> Iterator[str]:
    """Yield misfits in the lengths of paths, and in the numbers of loop steps that they need."""
    if plan.scope.from_sensor != lidar.has_sensor_position:
        kinds = {True: "a lidar that is placed by its sensor", False: "a lidar with an altitude"}
        yield f"it is for {kinds[plan.scope.from_sensor]}, and this is {kinds[lidar.has_sensor_position]}"
    lengths, config, limits = PathLengths(lidar, scene), plan.config, plan.limits
    top = -0.5 * lengths.first_path
    if top > limits.start_distance:
        yield (
            f"its rays start {limits.start_distance:g} m before the reference plane; the scene reaches to "
            f"{top:g} m"
        )
    # A plan's segments may be longer than any chord of this scene: then the chords decide, unless the plan's
    # own length, which cuts them no shorter, needs fewer steps.
    segment, chord = limits.max_segment, lengths.longest_chord
    if chord < segment and lengths.max_ray_segments(chord) > config.max_ray_segments:
        segment = chord
    longest = limits.max_path + limits.start_distance
    counts = {
        "segments of a ray": (lengths.max_ray_segments(segment), config.max_ray_segments),
        "voxels along a flight": (lengths.max_faces(longest), config.max_faces),
    }
    # Loops of fixed length would end before the ray does, and lose its light.
    for name, (needed, planned) in counts.items():
        if needed > planned:
            yield f"it allows for {planned} {name}; the scene may have {needed}"
    flight = lengths.longest_flight(longest)
    if flight > limits.max_flight * (1 + _ROUNDING):
        yield f"it follows flights over {limits.max_flight:g} m; the scene calls for {flight:g} m"


def _misfit_times(plan: Plan, lidar: Lidar, scene: Scene) -> Iterator[str]:
    """Yield misfits in the times at which light returns."""
    lengths, bins, scope = PathLengths(lidar, scene), plan.bins, plan.scope
    first, last = lengths.first_path / SPEED_OF_LIGHT, lengths.last_path / SPEED_OF_LIGHT
    begin, end = bins.start, plan.limits.max_path / SPEED_OF_LIGHT - bins.width
    if not scope.automatic_window:
        # What a window leaves out is the caller's choice, for scenes no larger than the plan's.
        begin, end = min(begin, scope.first_return), max(end, scope.last_return)
    slack = bins.width + _ROUNDING * max(abs(begin), abs(end))
    if first < begin - slack or last > end + slack:
        yield f"it covers returns from {begin:.6g} to {end:.6g} ns; the scene has {first:.6g} to {last:.6g}"


def _misfit_pulse(plan: Plan, lidar: Lidar, scene: Scene) -> Iterator[str]:
    """Yield misfits in the pulse, and in its sampling."""
    interval = concrete_number(lidar.sampling_interval)
    if not lidar.opens_at_first_return and abs(plan.sample_interval - interval) > _ROUNDING * interval:
        yield f"it has samples of {plan.sample_interval:g} ns; sampling_interval = {interval:g} ns"
    jitter = concrete_number(lidar.jitter)
    feature = math.hypot(concrete_number(lidar.pulse.finest), jitter)
    planned_feature = plan.scope.pulse_feature
    if feature < planned_feature * (1 - _ROUNDING):
        yield (
            f"its fine bins suit pulses with features of {planned_feature:.3g} ns; the lidar's pulse has "
            f"some of {feature:.3g} ns"
        )
    # With a window of the user's, the part of the pulse that it cuts off is the user's choice.
    low, high = lidar.pulse.support(jitter)
    planned_low, planned_high = plan.pulse_support
    slack = plan.bins.width + _ROUNDING * (high - low)
    if plan.scope.automatic_window and (low < planned_low - slack or high > planned_high + slack):
        yield (
            f"it is for a pulse from {planned_low:.4g} to {planned_high:.4g} ns; the lidar's lasts from "
            f"{low:.4g} to {high:.4g} ns"
        )
