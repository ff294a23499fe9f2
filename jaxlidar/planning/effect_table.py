"""The table of effects that a plan shows: what is simulated, why, and what leaving it out changes at most."""

import functools
import math
from collections.abc import Callable, Sequence

import jax

from jaxlidar._checks import concrete_number, is_traced
from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._summary import percent
from jaxlidar.instrument.field_of_view import EDGE_WIDTH
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.planning.bounds import Bounds
from jaxlidar.planning.effects import NAMES, Effect, planes, present, without
from jaxlidar.planning.orders import Orders
from jaxlidar.planning.trace_plan import Bins
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.surfaces import Ground


def effect_table(
    lidar: Lidar,
    scene: Scene,
    off: tuple[str, ...],
    chosen: Orders,
    bins: Bins,
    upstream: float,
    whole_first: bool,
) -> tuple[Effect, ...]:
    """A row for every effect.

    `chosen`: how many orders are followed, and why. `whole_first`: whether the record takes in all of order
    one.
    """
    orders = chosen.count
    has, planned = present(lidar, scene), present(*without(lidar, scene, off))
    reasons = (
        dict.fromkeys(NAMES, "in the scene") | {"multiple scattering": chosen.why} | _reasons(lidar, scene)
    )
    # Values that are being traced are unknown, and bounds hold for planes only.
    known = not any(is_traced(x) for x in jax.tree.leaves((lidar, scene)))
    known = known and planes(scene)

    @functools.cache
    def rules(off: tuple[str, ...]) -> dict[str, Callable[[], float]]:
        return _rules(Bounds(*without(lidar, scene, off), orders), bins, upstream)

    def bound(name: str, off: tuple[str, ...]) -> float:
        pair = without(lidar, scene, off)
        there = present(*pair) | {"hot spot": pair[1].canopy is not None}
        if not known or not there.get(name, True):
            return float(there.get(name, True))
        return rules(off)[name]()

    rows = []
    for name in NAMES:
        on = planned[name] and name not in off and (name != "multiple scattering" or orders > 1)
        reason, others = reasons[name], off
        if name in off:
            # What switching it on again would change.
            unlike = "the terrain is a plane" if name == "relief" else "zero everywhere"
            reason = "switched off" if has[name] else unlike
            others = tuple(n for n in off if n != name)
        elif not has[name] and name not in ("multiple scattering", "hot spot"):
            reason = "not in the scene"
        elif has[name] and not planned[name] and name != "multiple scattering":
            reason = "gone with what is switched off"
        rows.append(Effect(name, on, reason, bound(name, others), _measure(name)))
        if on and name == "multiple scattering":
            name = f"orders beyond {orders}"
            most = bound(name, off)
            likely = min(chosen.beyond, most)
            rows.append(Effect(name, False, f"likely below {percent(likely)}", most, "sum"))
            late = bound("multiple scattering", off) if whole_first else 1.0
            reason = "light on its way at the end of the record"
            rows.append(Effect("after the window", False, reason, late, "sum"))
    if without(lidar, scene, off)[1].atmosphere is not None:
        name = "scattering within the atmosphere"
        rows.append(Effect(name, False, "beyond first order", bound(name, off), "sum"))
    return tuple(rows)


def _measure(name: str) -> str:
    return "samples" if name in ("slope spread", "divergence", "jitter") else "sum"


def _rules(bounds: Bounds, bins: Bins, upstream: float) -> dict[str, Callable[[], float]]:
    """For every effect, the function that computes its bound."""

    def slope_spread() -> float:
        level = without(bounds.lidar, bounds.scene, ("slope spread",))
        return bounds.slope_spread(Bounds(*level, bounds.orders))

    return {
        "leaf": lambda: bounds.part("leaf"),
        "bark": lambda: bounds.part("bark"),
        "plates": bounds.plates,
        "ground": bounds.ground,
        "slope spread": slope_spread,
        "multiple scattering": lambda: bounds.beyond(1),
        f"orders beyond {bounds.orders}": lambda: bounds.beyond(bounds.orders),
        # A mirror's return may exceed all others by far.
        "specular return": lambda: 1.0,
        "divergence": bounds.divergence,
        "field of view": bounds.field_of_view,
        "hot spot": bounds.hot_spot,
        "atmospheric extinction": lambda: bounds.extinction(bins, upstream),
        "atmospheric backscatter": lambda: bounds.backscatter(bins, upstream),
        "jitter": bounds.jitter,
        # What the air scatters to the receiver beyond first order is at most what was lost.
        "scattering within the atmosphere": lambda: bounds.lost(bins),
    }


def _reasons(lidar: Lidar, scene: Scene) -> dict[str, str]:
    """Why effects are simulated, with their size, where more can be said than that they are in the scene."""
    radius = concrete_number(lidar.footprint_radius)
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
        else "ways are independent: exp(-2 tau)",
        "atmospheric backscatter": "above the scene",
        "jitter": f"{concrete_number(lidar.jitter):g} ns",
    }
    if scene.canopy is None:
        reasons["hot spot"] = "not in the scene"
    if air is not None and air.lidar_ratio is None:
        reasons["atmospheric backscatter"] = "no lidar ratio"
    return reasons


def table_lines(effects: Sequence[Effect]) -> list[str]:
    """The lines of a table of effects, with a head."""
    rows = [("effect", "simulated", "changes at most", "why")]
    for e in effects:
        bound = "nothing" if e.bound == 0 else f"{percent(e.bound)} of {e.measure}"
        rows.append((e.name, "yes" if e.simulated else "no", bound, e.reason))
    widths = [max(len(r[i]) for r in rows) for i in range(3)]
    lines = ["  ".join([*(c.ljust(w) for c, w in zip(r, widths)), r[3]]).rstrip() for r in rows]
    return [lines[0], "-" * max(map(len, lines)), *lines[1:]]
