"""How many orders of scattering to follow, and for how long, with estimates of what they leave out."""

import math
from typing import NamedTuple

import numpy as np

from jaxlidar._checks import concrete, concrete_array
from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar.planning.effects import can_light_itself
from jaxlidar.planning.ladder import rung
from jaxlidar.planning.scatterers import Optics, largest_albedo
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.scene import Scene

# Orders are followed while their histories are not more than this (16 orders of four letters, 29 of three).
MAX_HISTORIES = 5000
MAX_ORDERS = 100
# There is room for no more than this where the user does not ask for it.
MOST_ROOM = 7000
# The share of scattered light that is scattered again is taken to be at least this, times the albedo.
AGAIN = 0.8
# Multiple scattering is recorded this long after the last first-order return, ns, at least and at most.
TAIL = (10.0, 300.0)
# The record ends when an estimated share of the light is left that is smaller than this.
LATE = 0.003


class Orders(NamedTuple):
    """How many scatterings are followed.

    - `count`: of them. - `why`: in words. - `beyond`: estimated share of the light of all others.
    - `again`: estimated share of scattered light that is scattered again.
    - `most`: how many could be followed.
    """

    count: int
    why: str
    beyond: float
    again: float
    most: int


def degree_of(orders: int, plates: int) -> int:
    """Longest history: every flight, and the way back, may pass every plate."""
    return orders + (orders + 1) * plates


def order_steps(orders: int, plates: int, letters: int) -> int:
    """Length of the loop over orders: up the ladder, where the table of histories stays small.

    Many orders have few photons: there the steps of the ladder are long.
    """
    steps = rung(orders, 2 if orders <= 16 else 1)
    return steps if math.comb(degree_of(steps, plates) + letters, letters) <= MOST_ROOM else orders


def mean_depth(canopy: Canopy) -> float:
    """Optical depth of the canopy straight down, the mean over its columns that hold anything."""
    extinction = np.zeros(canopy.voxels.shape[:2])
    for part in (canopy.voxels.leaf, canopy.voxels.bark):
        if part is None:
            continue
        known = concrete(part)
        if known is None:
            return math.inf
        extinction += known.sum(axis=2, dtype=float)
    columns = extinction * concrete_array(canopy.voxels.voxel_size)[2]
    there = columns[columns > 0]
    return float(there.mean()) if there.size else 0.0


def scattered_again(scene: Scene, optics: list[Optics]) -> float:
    """Estimated share of scattered light that is scattered again: albedo times the chance of meeting more.

    That chance is 1 - (pi^2 / 3) / (depth + 1.42)^2 in a slab of the optical depth of the canopy, the decay
    of its slowest mode in the diffusion approximation; ground that reflects makes the slab deeper. Between
    two surfaces it is the root of the product of their reflectances. It is never taken to be less than 0.8
    times the largest albedo.
    """
    albedo = largest_albedo(optics)
    again = AGAIN * albedo
    if scene.canopy is not None:
        ground = 0.0 if scene.ground is None else _largest(optics, "ground")
        depth = mean_depth(scene.canopy) * (1.0 + ground)
        if depth > 1.0:
            again = max(again, albedo * (1.0 - math.pi**2 / 3 / (depth + 1.42) ** 2))
    bright = sorted(
        (_largest(optics, o.name) for o in optics if o.name not in ("leaf", "bark")), reverse=True
    )
    if len(bright) > 1:
        again = max(again, math.sqrt(bright[0] * bright[1]))
    return min(again, 1.0)


def _largest(optics: list[Optics], name: str) -> float:
    (reflectance,) = (concrete(o.reflectance) for o in optics if o.name == name)
    return 1.0 if reflectance is None else float(np.max(reflectance))


def orders_of(
    scene: Scene, optics: list[Optics], letters: int, rtol: float, max_orders: int | None
) -> Orders:
    """How many orders to follow, why, and what the others are likely to have."""
    if not can_light_itself(scene):
        return Orders(1, "one plane cannot light itself", 0.0, 0.0, 1)
    plates, again, albedo = len(scene.plates), scattered_again(scene, optics), largest_albedo(optics)
    most = 2
    while most < MAX_ORDERS and math.comb(degree_of(most + 1, plates) + letters, letters) <= MAX_HISTORIES:
        most += 1
    wanted = most
    if again < 1:
        wanted = 1 + math.ceil(math.log(rtol / 10) / math.log(max(again, 1e-6)))
    count = min(max(wanted, 2), most) if max_orders is None else int(max_orders)
    if count == 1:
        return Orders(1, "one order is asked for", 0.0, again, most)
    why = f"orders 2 to {count}; largest albedo {albedo:.2f}"
    return Orders(count, why, again**count, again, most)


def tail_of(scene: Scene, optics: list[Optics], first: float, last: float) -> float:
    """How long after the last first-order return, ns, multiple scattering is worth recording.

    Light goes from scattering to scattering in the time that it takes to fly a mean free path in the canopy,
    or the height between first and last return; what is left falls by the share that is scattered again.
    """
    usual = min(max(3 * (last - first), TAIL[0]), 60.0)
    again = scattered_again(scene, optics)
    step = 0.5 * (last - first)
    if scene.canopy is not None:
        depth = mean_depth(scene.canopy)
        size, shape = concrete_array(scene.canopy.voxels.voxel_size), scene.canopy.voxels.shape
        height = float(size[2]) * shape[2]
        step = height / max(depth, 0.5) / SPEED_OF_LIGHT if math.isfinite(depth) else step
    if again >= 1:
        return TAIL[1]
    scatterings = math.log(LATE) / math.log(max(again, 1e-6))
    return min(max(usual, scatterings * step), TAIL[1])
