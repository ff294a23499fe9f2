"""Check that a plan that was made earlier serves a lidar and a scene.

Each condition is stated once, as a `Misfit`. Where values are known, `check_plan` refuses a plan by it, with
numbers. Where a JAX transformation traces them, nothing can be refused: `is_covered` evaluates the same
comparisons with JAX arrays, and `Waveform.lost` tells.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fields.checks import concrete_number, fixed_array, is_traced
from jaxlidar.optics.laws import AbstractMirror
from jaxlidar.planning.channels import largest_albedo, scene_optics
from jaxlidar.planning.effects import (
    consists_of_planes,
    find_empty_materials,
    has_smooth_footprint,
    without_effects,
)
from jaxlidar.planning.local_origin import move_aim_to_origin
from jaxlidar.planning.orders import calls_for_more_orders, choose_orders
from jaxlidar.planning.path_lengths import (
    PathLengths,
    check_footprints_on_terrain,
    footprint_is_off_terrain,
    meshes_are_in_reach,
)
from jaxlidar.planning.plan import Plan
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.surfaces import AbstractSheet
from jaxlidar.scenes.terrain import Terrain
from jaxlidar.sensors.lidar import Lidar

# Lengths and times may differ by the rounding of single precision.
_ROUNDING = 1e-5


class Misfit(NamedTuple):
    """A condition that a plan must meet: `is_present`, which may be traced, is True if it does not."""

    is_present: Any
    message: Callable[[], str]


def check_plan(plan: Plan, lidar: Lidar, scene: Scene) -> None:
    """Refuse a plan that does not fit: one that would leave out light, or a part of the scene.

    **Raises:** ValueError that names what does not fit, with numbers.
    """
    _check(plan, lidar, scene, _ALL_MISFITS)


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


def is_covered(plan: Plan, lidar: Lidar, scene: Scene) -> Bool[Array, ""]:
    """Return True if `check_plan` would not refuse a plan for a lidar and a scene that JAX is tracing.

    Computed without derivatives, in single precision, whose rounding counts as covered.
    """
    return _is_free_of(_ALL_MISFITS, plan, lidar, scene)


def is_in_reach(plan: Plan, lidar: Lidar, scene: Scene) -> Bool[Array, ""]:
    """Return True if a plan has the path lengths of a lidar and a scene that JAX is tracing.

    As `is_covered`, whatever the materials, their albedos, the pulse and recorded times.
    """
    return _is_free_of((_misfit_lengths,), plan, lidar, scene)


def _is_free_of(checks: Sequence[Callable], plan: Plan, lidar: Lidar, scene: Scene) -> Bool[Array, ""]:
    arrays, static = eqx.partition((lidar, scene), eqx.is_array)
    # Where a derivative is taken by a Python number, that number remains of it.
    arrays = jax.tree.map(lambda a: jnp.asarray(jax.lax.stop_gradient(a)), arrays)
    # NumPy's rules of broadcasting, by which both evaluate.
    with jax.numpy_rank_promotion("allow"):
        lidar, scene = eqx.combine(arrays, static)
        misfits = _misfits(plan, lidar, scene, checks, jnp)
        return ~jnp.any(jnp.stack([jnp.asarray(misfit.is_present) for misfit in misfits]))


def _check(plan: Plan, lidar: Lidar, scene: Scene, checks: Sequence[Callable]) -> None:
    # While JAX traces a program, even what is computed of known values is traced, unless at compile time.
    with jax.ensure_compile_time_eval():
        check_footprints_on_terrain(lidar, scene)
        for misfit in _misfits(plan, lidar, scene, checks, np):
            if misfit.is_present:
                raise ValueError(f"the plan does not fit: {misfit.message()}")


def _misfits(plan: Plan, lidar: Lidar, scene: Scene, checks: Sequence[Callable], xp: Any) -> Iterator[Misfit]:
    """Yield all conditions; with `xp` = jax.numpy where values are traced."""
    ground = scene.ground
    if xp is jnp:
        yield Misfit(footprint_is_off_terrain(lidar, scene), lambda: "the footprint lies off the terrain")
    # What the plan takes to be flat, empty or out of reach is not checked where it is traced: `make_setup`
    # refuses it.
    if plan.scope.flat_terrain and isinstance(ground, Terrain) and ground.relief:
        has_relief = not is_traced(ground.heights) and not ground.is_plane()
        yield Misfit(has_relief, lambda: "it takes the terrain for a plane; make one for this terrain")
    for name in plan.scope.empty_materials:
        is_present = name not in find_empty_materials(scene)
        yield Misfit(is_present, lambda name=name: f"it is for a map without {name}; make one for this scene")
    if plan.scope.unreached_meshes:
        yield Misfit(
            meshes_are_in_reach(lidar, scene, xp),
            lambda: "it is for meshes that no ray meets; make one for this lidar and scene",
        )
    # The plan is for the scene without the effects that it leaves out: compare like with like.
    lidar, scene = without_effects(*move_aim_to_origin(lidar, scene), plan.off)
    for check in checks:
        for misfit in check(plan, lidar, scene, xp):
            yield Misfit(
                misfit.is_present,
                lambda misfit=misfit: f"{misfit.message()}; make one for this lidar and this scene",
            )


def _misfit_materials(plan: Plan, lidar: Lidar, scene: Scene, xp: Any) -> Iterator[Misfit]:
    """Yield misfits in materials, their channels, and the orders that their albedo calls for."""
    optics, config, scope = scene_optics(lidar, scene), plan.config, plan.scope
    # A transmittance that is zero needs no channel.
    missing = {f"{o.name}.R": True for o in optics} | {
        f"{o.name}.T": xp.any(fixed_array(o.transmittance, xp) > 0)
        for o in optics
        if o.transmittance is not None
    }
    missing = {name: is_missing for name, is_missing in missing.items() if name not in config.channels}

    def missing_channels() -> str:
        names = ", ".join(sorted(name for name, is_missing in missing.items() if is_missing))
        return f"it has {', '.join(config.channels) or 'no scatterers'}; the scene also has {names}"

    for is_missing in missing.values():
        yield Misfit(is_missing, missing_channels)
    materials = tuple(o.name for o in optics)
    yield Misfit(
        config.materials != materials,
        lambda: (
            f"it has {', '.join(config.materials)}; the scene has {', '.join(materials) or 'no scatterers'}"
        ),
    )
    # A plan may have a channel for a transmittance that is zero here, but not for one that the scene cannot
    # have.
    possible = {f"{o.name}.R" for o in optics} | {
        f"{o.name}.T" for o in optics if o.transmittance is not None
    }
    impossible = ", ".join(sorted(set(config.channels) - possible))
    yield Misfit(impossible != "", lambda: f"it has {impossible}; what the scene transmits is not scattered")
    for covers_fully, surface in zip(config.covers_fully, scene.surfaces):
        if covers_fully and isinstance(surface, AbstractSheet):
            yield Misfit(
                fixed_array(surface.coverage, xp) < 1,
                lambda: "it has plates that cover everything; the scene's have gaps",
            )
    yield Misfit(
        config.mirrors != tuple(isinstance(s.law, AbstractMirror) for s in scene.surfaces),
        lambda: "its surfaces and the scene's differ in which are mirrors",
    )
    hotspot = scene.canopy is not None and scene.canopy.hotspot
    yield Misfit(
        config.hotspot != hotspot,
        lambda: f"it has hotspot = {config.hotspot}; the canopy has hotspot = {hotspot}",
    )
    if config.vertical:
        yield Misfit(
            fixed_array(lidar.zenith, xp) != 0,
            lambda: f"it is for a beam at nadir; zenith = {concrete_number(lidar.zenith):g} degrees",
        )
    yield Misfit(
        config.uses_quadrature and not consists_of_planes(scene),
        lambda: "it is for planes; the scene has more",
    )
    yield Misfit(
        config.uses_quadrature and not has_smooth_footprint(lidar),
        lambda: "it is for a round beam, or no field of view; the lidar has level_divergence and both",
    )
    # Orders that the user chose are followed whatever the albedo. A larger albedo may still need no more.
    if scope.automatic_orders:
        albedo, n_channels = largest_albedo(optics, xp), len(config.channels)
        needs_more = calls_for_more_orders(
            scene, optics, n_channels, plan.rtol, plan.orders, config.keeps_histories, xp
        )

        def few_orders() -> str:
            needed = choose_orders(scene, optics, n_channels, plan.rtol, None, config.keeps_histories).count
            return (
                f"it follows {plan.orders} orders, for albedos up to {scope.albedo:.3g}; the scene has "
                f"{albedo:.3g}, which calls for {needed}"
            )

        yield Misfit((albedo > scope.albedo + 1e-3) & needs_more, few_orders)


def _misfit_lengths(plan: Plan, lidar: Lidar, scene: Scene, xp: Any) -> Iterator[Misfit]:
    """Yield misfits in the lengths of paths, and in the numbers of loop steps that they need."""
    kinds = {True: "a lidar that is placed by its sensor", False: "a lidar with an altitude"}
    yield Misfit(
        plan.scope.from_sensor != lidar.has_sensor_position,
        lambda: f"it is for {kinds[plan.scope.from_sensor]}, and this is {kinds[lidar.has_sensor_position]}",
    )
    lengths, config, limits = PathLengths(lidar, scene, xp=xp), plan.config, plan.limits
    yield Misfit(lengths.reaches_sensor, lambda: "the scene reaches up to the sensor")
    top = -0.5 * lengths.first_path
    yield Misfit(
        top > limits.start_distance,
        lambda: (
            f"its rays start {limits.start_distance:g} m before the reference plane; the scene reaches to "
            f"{top:g} m"
        ),
    )
    # A plan's segments may be longer than any chord of this scene: then the chords decide, unless the plan's
    # own length, which cuts them no shorter, needs fewer steps.
    segment, chord = limits.max_segment, lengths.longest_chord
    uses_chord = (chord < segment) & (lengths.max_ray_segments(chord) > config.max_ray_segments)
    segment = xp.where(uses_chord, chord, segment)
    longest = limits.max_path + limits.start_distance
    # Loops of fixed length would end before the ray does, and lose its light.
    for name, needed, planned in (
        ("segments of a ray", lengths.max_ray_segments(segment), config.max_ray_segments),
        ("voxels along a flight", lengths.max_faces(longest), config.max_faces),
    ):
        yield Misfit(
            needed > planned,
            lambda name=name, needed=needed, planned=planned: (
                f"it allows for {planned} {name}; the scene may have {needed}"
            ),
        )
    flight = lengths.longest_flight(longest)
    yield Misfit(
        flight > limits.max_flight * (1 + _ROUNDING),
        lambda: f"it follows flights over {limits.max_flight:g} m; the scene calls for {flight:g} m",
    )


def _misfit_times(plan: Plan, lidar: Lidar, scene: Scene, xp: Any) -> Iterator[Misfit]:
    """Yield misfits in the times at which light returns."""
    lengths, bins, scope = PathLengths(lidar, scene, xp=xp), plan.bins, plan.scope
    first, last = lengths.first_path / SPEED_OF_LIGHT, lengths.last_path / SPEED_OF_LIGHT
    begin, end = bins.start, plan.limits.max_path / SPEED_OF_LIGHT - bins.width
    if not scope.automatic_window:
        # What a window leaves out is the caller's choice, for scenes no larger than the plan's.
        begin, end = xp.minimum(begin, scope.first_return), xp.maximum(end, scope.last_return)
    slack = bins.width + _ROUNDING * xp.maximum(abs(begin), abs(end))
    yield Misfit(
        (first < begin - slack) | (last > end + slack),
        lambda: (
            f"it covers returns from {begin:.6g} to {end:.6g} ns; the scene has {first:.6g} to {last:.6g}"
        ),
    )


def _misfit_pulse(plan: Plan, lidar: Lidar, scene: Scene, xp: Any) -> Iterator[Misfit]:
    """Yield misfits in the pulse, and in its sampling."""
    interval = fixed_array(lidar.sampling_interval, xp)
    if not lidar.opens_at_first_return:
        yield Misfit(
            abs(plan.sample_interval - interval) > _ROUNDING * interval,
            lambda: f"it has samples of {plan.sample_interval:g} ns; sampling_interval = {interval:g} ns",
        )
    jitter = fixed_array(lidar.jitter, xp)
    feature, planned_feature = xp.hypot(fixed_array(lidar.pulse.finest, xp), jitter), plan.scope.pulse_feature
    yield Misfit(
        feature < planned_feature * (1 - _ROUNDING),
        lambda: (
            f"its fine bins suit pulses with features of {planned_feature:.3g} ns; the lidar's pulse has "
            f"some of {feature:.3g} ns"
        ),
    )
    # With a window of the user's, the part of the pulse that it cuts off is the user's choice.
    if not plan.scope.automatic_window:
        return
    planned_low, planned_high = plan.pulse_support
    pulse = lidar.pulse
    try:
        low, high = pulse.support(lidar.jitter)
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError):
        # A pulse whose support is known where its parameters are: what energy is outside of the plan's?
        slack = plan.bins.width + _ROUNDING * (planned_high - planned_low)
        ends = jnp.asarray([planned_low - slack, planned_high + slack])
        inside = jnp.diff(pulse.cumulative(ends, lidar.jitter))[0]
        yield Misfit(inside < 1 - _ROUNDING, lambda: "the lidar's pulse lasts longer")
        return
    slack = plan.bins.width + _ROUNDING * (high - low)
    yield Misfit(
        (low < planned_low - slack) | (high > planned_high + slack),
        lambda: (
            f"it is for a pulse from {planned_low:.4g} to {planned_high:.4g} ns; the lidar's lasts from "
            f"{low:.4g} to {high:.4g} ns"
        ),
    )


_ALL_MISFITS = (_misfit_materials, _misfit_lengths, _misfit_times, _misfit_pulse)
