"""The table of effects that a plan shows: each effect, whether it is simulated, why, and its bound."""

import functools
import math
from collections.abc import Callable, Sequence

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fields.checks import concrete_number, has_tracers, is_traced
from jaxlidar._text import percent
from jaxlidar.planning.bounds import Bounds
from jaxlidar.planning.config import TimeBins
from jaxlidar.planning.effects import (
    EFFECT_NAMES,
    Effect,
    present_effects,
    surfaces_are_planes,
    without_effects,
)
from jaxlidar.planning.orders import OrderChoice
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.surfaces import Ground
from jaxlidar.sensors.field_of_view import EDGE_WIDTH
from jaxlidar.sensors.lidar import Lidar

# Reasons why effects are off that the user has not switched off.
_REASONS_TO_LEAVE_OUT = {"relief": "the terrain is a plane", "meshes": "met by no ray of order one"}


def effect_table(
    lidar: Lidar,
    scene: Scene,
    off: tuple[str, ...],
    order_choice: OrderChoice,
    bins: TimeBins,
    start_distance: float,
    records_all_of_order_one: bool,
) -> tuple[Effect, ...]:
    """Return a row for every effect.

    1. For each effect: whether it is simulated and why, and the bound on the change from the scene as planned
       to the scene without it. Where it is off, the bound is on the change from the scene with it.
    2. Where multiple scattering is simulated: rows for the orders beyond the last, and for light after the
       record.
    3. A row for scattering within the atmosphere beyond order one, which is never simulated.

    **Arguments:**

    - `lidar`, `scene`: with all their effects. `off`: names of those that are switched off.
    - `order_choice`: number of orders followed, and why.
    - `bins`: fine time bins, back to where the air's own return begins.
    - `start_distance`: distance, m, before the reference plane at which rays start.
    - `records_all_of_order_one`: True if the window was chosen so that no light of order one is cut off.
    """
    orders = order_choice.count
    # An effect may be gone although it is not switched off: the air's return goes with its extinction.
    has, planned = present_effects(lidar, scene), present_effects(*without_effects(lidar, scene, off))
    reasons = dict.fromkeys(EFFECT_NAMES, "in the scene") | {"multiple scattering": order_choice.reason}
    reasons |= _sized_reasons(lidar, scene)
    # Bounds need values, which are unknown while they are being traced, and hold for planes below a sensor.
    bounded = not has_tracers((lidar, scene)) and surfaces_are_planes(scene)
    bounded = bounded and not lidar.has_sensor_position

    # Most rows have the same effects switched off, and share one set of bounds.
    @functools.cache
    def bound_functions(left_out: tuple[str, ...]) -> dict[str, Callable[[], float]]:
        bounds = Bounds(*without_effects(lidar, scene, left_out), orders)
        return _bound_functions(bounds, bins, start_distance)

    def bound(name: str, left_out: tuple[str, ...]) -> float:
        """Return a bound on the change without `name`, where `left_out` is, too; 1 if none is known."""
        remaining = without_effects(lidar, scene, left_out)
        # A canopy without the hot spot can have it switched on: its bound is of interest too.
        has_effect = present_effects(*remaining) | {"hot spot": remaining[1].canopy is not None}
        if not has_effect.get(name, True):
            return 0.0
        # A scene with relief is not bounded: "relief" itself needs no function.
        return bound_functions(left_out)[name]() if bounded else 1.0

    rows = []
    for name in EFFECT_NAMES:
        simulated = planned[name] and name not in off and (name != "multiple scattering" or orders > 1)
        reason, also_off = reasons[name], off
        if name in off:
            # The bound says what switching it on again would change.
            absent = _REASONS_TO_LEAVE_OUT.get(name, "zero everywhere")
            reason = "switched off" if has[name] else absent
            also_off = tuple(n for n in off if n != name)
        elif not has[name] and name not in ("multiple scattering", "hot spot"):
            reason = "not in the scene"
        elif has[name] and not planned[name] and name != "multiple scattering":
            reason = "gone with what is switched off"
        rows.append(Effect(name, simulated, reason, bound(name, also_off), _measure(name)))
        if simulated and name == "multiple scattering":
            name = f"orders beyond {orders}"
            upper_bound = bound(name, off)
            likely = min(order_choice.beyond, upper_bound)
            rows.append(Effect(name, False, f"likely below {percent(likely)}", upper_bound, "sum"))
            # What comes after a window that has all of order one is of higher order.
            outside = bound("multiple scattering", off) if records_all_of_order_one else 1.0
            reason = "light on its way at the end of the record"
            rows.append(Effect("after the window", False, reason, outside, "sum"))
    if without_effects(lidar, scene, off)[1].atmosphere is not None:
        name = "scattering within the atmosphere"
        rows.append(Effect(name, False, "beyond first order", bound(name, off), "sum"))
    return tuple(rows)


def _measure(name: str) -> str:
    """Return the measure of an effect's bound: "samples" for those that shift light in time."""
    return "samples" if name in ("slope spread", "divergence", "jitter") else "sum"


def _bound_functions(bounds: Bounds, bins: TimeBins, start_distance: float) -> dict[str, Callable[[], float]]:
    """Return, for every effect, the function that computes its bound."""

    def slope_spread() -> float:
        level = without_effects(bounds.lidar, bounds.scene, ("slope spread",))
        return bounds.slope_spread(Bounds(*level, bounds.orders))

    return {
        "leaf": lambda: bounds.canopy_material("leaf"),
        "bark": lambda: bounds.canopy_material("bark"),
        "plates": bounds.plates,
        "ground": bounds.ground,
        "slope spread": slope_spread,
        "multiple scattering": lambda: bounds.orders_beyond(1),
        f"orders beyond {bounds.orders}": lambda: bounds.orders_beyond(bounds.orders),
        # A mirror's return may exceed all others by far.
        "specular return": lambda: 1.0,
        "divergence": bounds.divergence,
        "field of view": bounds.field_of_view,
        "hot spot": bounds.hot_spot,
        "atmospheric extinction": lambda: bounds.atmospheric_extinction(bins, start_distance),
        "atmospheric backscatter": lambda: bounds.atmospheric_backscatter(bins, start_distance),
        "jitter": bounds.jitter,
        # The air scatters to the receiver, beyond first order, at most the light that it took from the beam.
        "scattering within the atmosphere": lambda: bounds.air_loss(bins),
    }


def _sized_reasons(lidar: Lidar, scene: Scene) -> dict[str, str]:
    """Return reasons that state the size of an effect, for those that have one."""
    radius = concrete_number(lidar.footprint_radius)
    # Two-way: 2 sigma tan(slope) / c, with the standard deviation sigma = radius / 2 of a Gaussian footprint.
    slope = concrete_number(scene.ground.slope) if isinstance(scene.ground, Ground) else 0.0
    spread = radius * math.tan(math.radians(slope)) / SPEED_OF_LIGHT
    view = lidar.field_of_view
    air = scene.atmosphere
    hotspot = scene.canopy is not None and scene.canopy.hotspot
    reasons = {
        "slope spread": f"{slope:g} degrees: {spread:.2g} ns (standard deviation)",
        "divergence": f"{concrete_number(lidar.divergence):g} mrad: a footprint of radius {radius:.3g} m",
        "field of view": f"a soft edge of {percent(EDGE_WIDTH)}"
        if view is None or is_traced(view)
        else f"{concrete_number(view):g} mrad, with a soft edge of {percent(EDGE_WIDTH)}",
        "hot spot": "back through the same gap: exp(-tau)"
        if hotspot
        else "paths in and out are independent: exp(-2 tau)",
        "atmospheric backscatter": "above the scene",
        "jitter": f"{concrete_number(lidar.jitter):g} ns",
    }
    if scene.canopy is None:
        reasons["hot spot"] = "not in the scene"
    if air is not None and air.lidar_ratio is None:
        reasons["atmospheric backscatter"] = "no lidar ratio"
    return reasons


def table_lines(effects: Sequence[Effect]) -> list[str]:
    """Return the lines of a table of effects, with a head."""
    rows = [("effect", "simulated", "changes at most", "why")]
    for e in effects:
        bound = "nothing" if e.bound == 0 else f"{percent(e.bound)} of {e.measure}"
        rows.append((e.name, "yes" if e.simulated else "no", bound, e.reason))
    widths = [max(len(r[i]) for r in rows) for i in range(3)]
    lines = ["  ".join([*(c.ljust(w) for c, w in zip(r, widths)), r[3]]).rstrip() for r in rows]
    return [lines[0], "-" * max(map(len, lines)), *lines[1:]]
