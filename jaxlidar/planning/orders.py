"""Number of orders of scattering to follow, and for how long, with estimates of what they leave out.

Let q = p w be the fraction of scattered light that is scattered again, with the recollision probability p
(Smolander and Stenberg 2005, Remote Sens. Environ. 94, 355) and the albedo w. The light of order n is about
q^n, so that orders up to 1 + ln(rtol / 10) / ln q leave a tenth of the tolerance. In a slab of optical depth
tau, q tends to the decay per scattering of the slowest diffusion mode,

    q = w (1 - (pi^2 / 3) / (tau + 1.42)^2),

where 1.42 = 2 x 0.71 are the two extrapolation lengths (Case and Zweifel 1967).

A trace that keeps scattering histories has room for a limited number of orders. Where these would leave out
more than the tolerance, optics are applied while light is traced: then there is no such limit.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fields.checks import concrete, concrete_array, fixed_array
from jaxlidar.planning.channels import MaterialOptics, largest_albedo
from jaxlidar.planning.effects import allows_interreflection
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.terrain import Terrain

# Orders are followed while their histories are not more than this (16 orders of four channels, 29 of three).
MAX_HISTORIES = 5000
# With histories, the weight of a photon is 2 at every scattering by leaves that reflect and transmit: in
# single precision, 2^128 is infinite.
MAX_ORDERS_OF_HISTORIES = 100
# With optics applied: a slab of optical depth 20 that absorbs nothing takes 900 orders to a tolerance of 1 %.
MAX_ORDERS = 1000
# The loop over orders is rounded up to a size bucket only while its histories are not more than this.
MAX_BUCKETED_HISTORIES = 7000
# The recollision probability p is taken to be at least this.
MIN_RECOLLISION = 0.8
# Multiple scattering is recorded this long after the last first-order return, ns, at least; at most, where
# little light is left by then.
TAIL = (10.0, 300.0)
# It may be longer, up to this, where the tolerance asks for it, or where the ratio of successive orders is
# larger than this: light lingers in dense canopies that absorb little.
LONG_TAIL, LINGERING = 3000.0, 0.9
# The record ends when the estimated fraction of light that is still in the scene falls below this, or below
# this share of a smaller tolerance.
LATE_FRACTION = 0.003
LATE_SHARE = 0.3
# Share of the tolerance that may return later of light that grazes the ground far from an open canopy.
GRAZING_SHARE = 0.5


class OrderChoice(NamedTuple):
    """The number of scatterings that are followed.

    - `count`: the number. - `reason`: in words. - `beyond`: estimated fraction of the light in all later
      orders.
    - `affordable_orders`: largest number for which the table of histories stays small enough.
    - `needs_applied_optics`: True where these orders would leave out more than the tolerance.
    """

    count: int
    reason: str
    beyond: float
    affordable_orders: int
    needs_applied_optics: bool = False


def max_degree(orders: int, n_plates: int) -> int:
    """Return the largest degree of a history: every flight, and the return path, may pass every plate."""
    return orders + (orders + 1) * n_plates


def order_steps(orders: int, n_plates: int, n_channels: int) -> int:
    """Return the length of the loop over orders: a size bucket, where the table of histories stays small.

    Few photons survive to high orders, so that steps beyond the last order cost little: buckets are wide
    there.
    """
    steps = size_bucket(orders, 2 if orders <= 16 else 1)
    histories = math.comb(max_degree(steps, n_plates) + n_channels, n_channels)
    return steps if histories <= MAX_BUCKETED_HISTORIES else orders


def mean_optical_depth(canopy: Canopy, xp: Any = np) -> Any:
    """Return the vertical optical depth of the canopy, the mean over its columns that are not empty.

    Infinite where extinction is being traced, unless `xp` is jax.numpy.
    """
    if xp is jnp:
        tables = [fixed_array(a, jnp) for a in (canopy.voxels.leaf, canopy.voxels.bark) if a is not None]
        columns = sum(table.sum(axis=2) for table in tables) * fixed_array(canopy.voxels.voxel_size, jnp)[2]
        return columns.sum() / jnp.maximum((columns > 0).sum(dtype=columns.dtype), 1.0)
    extinction = np.zeros(canopy.voxels.shape[:2])
    for table in (canopy.voxels.leaf, canopy.voxels.bark):
        if table is None:
            continue
        values = concrete(table)
        if values is None:
            return math.inf
        extinction += values.sum(axis=2, dtype=float)
    columns = extinction * concrete_array(canopy.voxels.voxel_size)[2]
    occupied = columns[columns > 0]
    return float(occupied.mean()) if occupied.size else 0.0


def scattered_again(scene: Scene, optics: list[MaterialOptics], xp: Any = np) -> Any:
    """Estimate the fraction q = p w of scattered light that is scattered again (see the module).

    1. The least recollision probability times the largest albedo.
    2. A canopy: the decay of the slowest diffusion mode; ground that reflects makes its slab deeper.
    3. Between two surfaces, or of a mesh with itself: the root of the product of their reflectances.
    4. Within a mesh that transmits, such as leaves: the least recollision probability times its albedo.

    q is the largest of these, and at most 1. `xp`: jax.numpy for values that a JAX transformation traces.
    """
    fraction = xp.maximum(MIN_RECOLLISION * largest_albedo(optics, xp), slowest_decay(scene, optics, xp))
    return _number(xp.minimum(fraction, 1.0), xp)


def _number(x: Any, xp: Any) -> Any:
    return float(x) if xp is np else x


def slowest_decay(scene: Scene, optics: list[MaterialOptics], xp: Any = np) -> Any:
    """Estimate the ratio of successive orders in the slowest mode: steps 2 to 4 of `scattered_again`.

    Zero for a canopy of an optical depth of at most one, which diffusion does not describe.
    """
    albedo, fraction = largest_albedo(optics, xp), 0.0
    if scene.canopy is not None:
        ground = 0.0 if scene.ground is None else _largest_reflectance(optics, "ground", xp)
        depth = mean_optical_depth(scene.canopy, xp) * (1.0 + ground)
        fraction = xp.where(depth > 1.0, albedo * (1.0 - math.pi**2 / 3 / (depth + 1.42) ** 2), 0.0)
    surfaces = [o.name for o in optics if o.name not in ("leaf", "bark")]
    # A mesh may face itself, as the walls of a street do.
    surfaces += [name for name in surfaces if name.partition(":")[0].startswith("mesh")]
    if len(surfaces) > 1:
        reflectances = xp.stack([xp.asarray(_largest_reflectance(optics, name, xp)) for name in surfaces])
        fraction = xp.maximum(fraction, xp.sqrt(xp.prod(xp.sort(reflectances)[-2:])))
    leaves = [o for o in optics if o.name.startswith("mesh") and o.transmits]
    if leaves:
        fraction = xp.maximum(fraction, MIN_RECOLLISION * largest_albedo(leaves, xp))
    return _number(xp.minimum(fraction, 1.0), xp)


def _largest_reflectance(optics: list[MaterialOptics], name: str, xp: Any = np) -> Any:
    if xp is jnp:
        (reflectance,) = (fixed_array(o.reflectance, jnp) for o in optics if o.name == name)
        return jnp.max(reflectance)
    (reflectance,) = (concrete(o.reflectance) for o in optics if o.name == name)
    return 1.0 if reflectance is None else float(np.max(reflectance))


def choose_orders(
    scene: Scene,
    optics: list[MaterialOptics],
    n_channels: int,
    rtol: float,
    max_orders: int | None,
    histories: bool | None = None,
) -> OrderChoice:
    """Choose the number of orders to follow: exactly `max_orders`, or (None) as many as `rtol` needs.

    With `histories` True these are at most as many as histories allow. With None optics are applied where
    histories do not allow enough: by the slowest decay, as the least recollision probability is no reason to
    trace again for every change of optics.
    """
    if not allows_interreflection(scene):
        return OrderChoice(1, "one plane cannot light itself", 0.0, 1)
    fraction, albedo = scattered_again(scene, optics), largest_albedo(optics)
    affordable = affordable_orders(scene, n_channels)
    if max_orders is None:
        is_known = all(concrete(o.reflectance) is not None for o in optics) and math.isfinite(
            0.0 if scene.canopy is None else mean_optical_depth(scene.canopy)
        )
        is_short = slowest_decay(scene, optics) ** affordable > rtol
        applies_optics = histories is False or (histories is None and is_known and is_short)
        possible = MAX_ORDERS if applies_optics else affordable
        count = min(max(orders_to_tolerance(fraction, rtol), 2), possible)
    else:
        applies_optics, count = histories is False, int(max_orders)
    if count == 1:
        return OrderChoice(1, "one order is asked for", 0.0, affordable)
    reason = f"orders 2 to {count}; largest albedo {albedo:.2f}"
    return OrderChoice(count, reason, fraction**count, affordable, applies_optics)


def calls_for_more_orders(
    scene: Scene,
    optics: list[MaterialOptics],
    n_channels: int,
    rtol: Any,
    orders: int,
    histories: bool,
    xp: Any,
) -> Any:
    """Return True if `choose_orders` would follow more than `orders` orders for a tolerance.

    It follows 1 + ln(rtol / 10) / ln q, rounded up, and two at least. `xp`: jax.numpy for values that a JAX
    transformation traces.
    """
    if not allows_interreflection(scene):
        return False
    possible = MAX_ORDERS if not histories else affordable_orders(scene, n_channels)
    remains = xp.maximum(scattered_again(scene, optics, xp), 1e-6) ** (orders - 1) > rtol / 10
    return (orders < possible) & ((orders < 2) | remains)


def affordable_orders(scene: Scene, n_channels: int) -> int:
    """Return the largest number of orders for which the table of histories stays small enough."""
    n_plates, affordable = len(scene.plates), 2
    while affordable < MAX_ORDERS_OF_HISTORIES:
        n_histories = math.comb(max_degree(affordable + 1, n_plates) + n_channels, n_channels)
        if n_histories > MAX_HISTORIES:
            break
        affordable += 1
    return affordable


def orders_to_tolerance(fraction: float, rtol: float) -> int:
    """Return the number of orders after which a tenth of the tolerance is left; at most `MAX_ORDERS`.

    `fraction`: ratio of the light of successive orders, at most one.
    """
    if fraction >= 1:
        return MAX_ORDERS
    return min(1 + math.ceil(math.log(rtol / 10) / math.log(max(fraction, 1e-6))), MAX_ORDERS)


def multiple_scattering_tail(
    scene: Scene,
    optics: list[MaterialOptics],
    first_return: float,
    last_return: float,
    rtol: float,
    n_histories: int,
) -> float:
    """Estimate for how long, ns, after the last first-order return multiple scattering is worth recording.

    1. From one scattering to the next light takes the time of a mean free path in the canopy, or of the
       height between first and last return. The light that is still in the scene falls by the factor q each
       time. In a canopy q is an upper bound: tails become longer than 300 ns for what exceeds the tolerance
       only, by the ratio of the slowest mode (`slowest_decay`).
    2. Light that grazes the ground returns late, however fast the decay: see `grazing_tail`.
    3. The tail is at least three times as long as order one lasts, but no more than 60 ns of that, and 10 to
       3000 ns long in all. Memory is proportional to the length and to the number of histories
       `n_histories`: with as many as `MAX_HISTORIES`, it is 300 ns at most unless light lingers.
    """
    usual_tail = min(max(3 * (last_return - first_return), TAIL[0]), 60.0)
    fraction = scattered_again(scene, optics)
    time_between = 0.5 * (last_return - first_return)
    if scene.canopy is not None:
        depth = mean_optical_depth(scene.canopy)
        height = _canopy_size(scene.canopy)[2]
        time_between = height / max(depth, 0.5) / SPEED_OF_LIGHT if math.isfinite(depth) else time_between
    longest = LONG_TAIL if LINGERING < slowest_decay(scene, optics) < 1 else TAIL[1]
    if fraction >= 1:
        return longest

    def decay_time(remainder: float, ratio: float) -> float:
        return math.log(remainder) / math.log(max(ratio, 1e-6)) * time_between

    tail = min(max(usual_tail, decay_time(min(LATE_FRACTION, LATE_SHARE * rtol), fraction)), longest)
    # Most of the light leaves a canopy faster than in the bound: what remains decays as in its slowest mode.
    slowest = fraction if scene.canopy is None else float(slowest_decay(scene, optics))
    grazing = grazing_tail(scene, optics, last_return - first_return, rtol)
    required = max(decay_time(rtol, min(slowest, fraction)), grazing)
    return max(tail, min(required, max(TAIL[1] * MAX_HISTORIES / n_histories, TAIL[1]), LONG_TAIL))


def grazing_tail(scene: Scene, optics: list[MaterialOptics], duration: float, rtol: float) -> float:
    """Estimate after which time, ns, little light returns that leaves an open canopy and grazes the ground.

    Let leaves scatter the light S isotropically, at the height h above ground of reflectance r. The fraction
    h / (2 d) of it flies down so flat that it meets the ground beyond the distance d, unless the canopy stops
    it: the fraction p = exp(-k a) leaves a canopy of extinction k and half width a by its sides. It adds
    r S p h / (2 d) to the apparent reflectance, while the leaves return S / 4 and the ground r S / 2. So the
    fraction that returns later than d / c,

        2 r / (1 + 2 r) p h / d,

    falls with the inverse of time alone. `duration` is that of order one, ns, from the top to the ground.
    """
    if scene.canopy is None or scene.ground is None or scene.canopy.sides != "open":
        return 0.0
    reflectance = _largest_reflectance(optics, "ground")
    width, depth = _canopy_size(scene.canopy), mean_optical_depth(scene.canopy)
    half_width, height = 0.25 * (width[0] + width[1]), 0.5 * SPEED_OF_LIGHT * duration
    leaves_sides = math.exp(-depth / width[2] * half_width)
    distance = 2 * reflectance / (1 + 2 * reflectance) * leaves_sides * height / (GRAZING_SHARE * rtol)
    if isinstance(scene.ground, Terrain) and scene.ground.sides == "open":
        # There is no ground beyond.
        shape = np.asarray(scene.ground.heights.shape) - 1
        distance = min(distance, float(np.linalg.norm(concrete_array(scene.ground.spacing) * shape)))
    return distance / SPEED_OF_LIGHT


def _canopy_size(canopy: Canopy) -> tuple[float, ...]:
    """Return the sizes of the voxel map along x, y and z, m."""
    return tuple((concrete_array(canopy.voxels.voxel_size) * np.asarray(canopy.voxels.shape)).tolist())
