"""Whether a plan that was made earlier serves a lidar and a scene."""

import math
from collections.abc import Callable, Iterator, Sequence

from jaxlidar._checks import concrete_number
from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.optics.laws import AbstractMirror
from jaxlidar.planning.effects import empty, only_planes, without
from jaxlidar.planning.local_origin import about_aim
from jaxlidar.planning.orders import orders_of
from jaxlidar.planning.path_lengths import PathLengths
from jaxlidar.planning.plan import Plan
from jaxlidar.planning.rims import check_on_terrain
from jaxlidar.planning.scatterers import largest_albedo, scene_optics, spell
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.surfaces import AbstractSheet
from jaxlidar.scenes.terrain import Terrain

# Lengths and times may differ by the rounding of single precision.
_ROUNDING = 1e-5


def check_plan(plan: Plan, lidar: Lidar, scene: Scene) -> None:
    """Refuse a plan that does not fit: one that would leave out light, or a part of the scene.

    **Raises:** ValueError that names what does not fit, with numbers.
    """
    _check(plan, lidar, scene, (_kinds, _reach, _times, _pulse))


def check_reach(plan: Plan, lidar: Lidar, scene: Scene) -> None:
    """As `check_plan`, whatever the pulse, and whether or not light arrives when nothing is recorded.

    **Raises:** ValueError that names what does not fit, with numbers.
    """
    _check(plan, lidar, scene, (_kinds, _reach))


def _check(plan: Plan, lidar: Lidar, scene: Scene, rules: Sequence[Callable]) -> None:
    check_on_terrain(lidar, scene)
    ground = scene.ground
    if plan.limits.flat and isinstance(ground, Terrain) and ground.relief and not ground.is_plane():
        raise ValueError("the plan does not fit: it takes the terrain for a plane; make one for this terrain")
    for name in plan.limits.empty:
        if name not in empty(scene):
            raise ValueError(
                f"the plan does not fit: it is for a map without {name}; make one for this scene"
            )
    lidar, scene = without(*about_aim(lidar, scene), plan.off)
    for rule in rules:
        for sentence in rule(plan, lidar, scene):
            raise ValueError(f"the plan does not fit: {sentence}; make one for this lidar and this scene")


def _kinds(plan: Plan, lidar: Lidar, scene: Scene) -> Iterator[str]:
    """What is there, and of what kind."""
    optics, trace = scene_optics(lidar, scene), plan.trace
    letters = spell(optics)
    missing, surplus = (
        ", ".join(sorted(set(a) - set(b)))
        for a, b in ((letters.letters, trace.letters), (trace.materials, letters.materials))
    )
    if missing:
        yield f"it has {', '.join(trace.letters) or 'no scatterers'}; the scene also has {missing}"
    if surplus or trace.materials != letters.materials:
        has = ", ".join(letters.materials) or "no scatterers"
        yield f"it has {', '.join(trace.materials)}; the scene has {has}"
    known = {f"{o.name}.R" for o in optics} | {f"{o.name}.T" for o in optics if o.transmittance is not None}
    unknown = ", ".join(sorted(set(trace.letters) - known))
    if unknown:
        yield f"it has {unknown}; what the scene transmits is not scattered"
    cover = [isinstance(s, AbstractSheet) and concrete_number(s.coverage) < 1 for s in scene.surfaces]
    if any(full and partial for full, partial in zip(trace.full_cover, cover)):
        yield "it has plates that cover everything; the scene's have gaps"
    if trace.mirrors != tuple(isinstance(s.law, AbstractMirror) for s in scene.surfaces):
        yield "its surfaces and the scene's differ in which are mirrors"
    if trace.hotspot != (scene.canopy is not None and scene.canopy.hotspot):
        yield f"it has hotspot = {trace.hotspot}; the canopy has not"
    if trace.vertical and concrete_number(lidar.zenith) != 0:
        yield f"it is for a beam at nadir; zenith = {concrete_number(lidar.zenith):g} degrees"
    if plan.smooth_footprint and not only_planes(scene):
        yield "it is for planes; the scene has more"
    albedo, limits = largest_albedo(optics), plan.limits
    if limits.automatic_orders and albedo > limits.albedo + 1e-3:
        needed = orders_of(scene, optics, len(letters.letters), plan.rtol, None).count
        if needed > plan.orders:
            yield (
                f"it follows {plan.orders} orders, for albedos up to {limits.albedo:.3g}; the scene has "
                f"{albedo:.3g}, which calls for {needed}"
            )


def _reach(plan: Plan, lidar: Lidar, scene: Scene) -> Iterator[str]:
    """How far rays and photons go."""
    lengths, trace = PathLengths(lidar, scene), plan.trace
    top = -0.5 * lengths.first
    if top > trace.upstream:
        yield (
            f"its rays start {trace.upstream:g} m before the reference plane; the scene reaches to {top:g} m"
        )
    if (
        lengths.longest_chord < trace.max_step
        and lengths.first_steps(lengths.longest_chord) > trace.first_steps
    ):
        step = lengths.longest_chord
    else:
        step = trace.max_step
    longest = trace.last + trace.upstream
    counts = {
        "stretches of a ray": (lengths.first_steps(step), trace.first_steps),
        "voxels along a flight": (lengths.march_steps(longest), trace.march_steps),
    }
    for name, (needed, planned) in counts.items():
        if needed > planned:
            yield f"it allows for {planned} {name}; the scene may have {needed}"
    flight = lengths.longest_flight(longest)
    if flight > trace.max_flight * (1 + _ROUNDING):
        yield f"it follows flights over {trace.max_flight:g} m; the scene calls for {flight:g} m"


def _times(plan: Plan, lidar: Lidar, scene: Scene) -> Iterator[str]:
    """When light returns."""
    lengths, trace, bins, limits = PathLengths(lidar, scene), plan.trace, plan.bins, plan.limits
    first, last = lengths.first / SPEED_OF_LIGHT, lengths.last / SPEED_OF_LIGHT
    begin, end = bins.start, trace.last / SPEED_OF_LIGHT - bins.width
    if not limits.automatic_window:
        # What a window leaves out is the caller's choice, for scenes no larger than the plan's.
        begin, end = min(begin, limits.first), max(end, limits.last)
    slack = bins.width + _ROUNDING * max(abs(begin), abs(end))
    if first < begin - slack or last > end + slack:
        yield f"it covers returns from {begin:.6g} to {end:.6g} ns; the scene has {first:.6g} to {last:.6g}"


def _pulse(plan: Plan, lidar: Lidar, scene: Scene) -> Iterator[str]:
    """The pulse, and how it is sampled."""
    interval = concrete_number(lidar.sampling_interval)
    if lidar.receiver.window == "fixed" and abs(plan.sample_interval - interval) > _ROUNDING * interval:
        yield f"it has samples of {plan.sample_interval:g} ns; sampling_interval = {interval:g} ns"
    jitter = concrete_number(lidar.jitter)
    finest = math.hypot(concrete_number(lidar.pulse.finest), jitter)
    if finest < plan.limits.finest * (1 - _ROUNDING):
        yield (
            f"its fine bins suit pulses with features of {plan.limits.finest:.3g} ns; the lidar's pulse has "
            f"some of {finest:.3g} ns"
        )
    low, high = lidar.pulse.support(jitter)
    slack = plan.bins.width + _ROUNDING * (high - low)
    if plan.limits.automatic_window and (low < plan.reach[0] - slack or high > plan.reach[1] + slack):
        yield (
            f"it is for a pulse from {plan.reach[0]:.4g} to {plan.reach[1]:.4g} ns; the lidar's lasts from "
            f"{low:.4g} to {high:.4g} ns"
        )
