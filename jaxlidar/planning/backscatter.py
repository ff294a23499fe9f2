"""Backscatter of the footprint's rays by any scattering law; the bounds of a plan are computed from it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._checks import concrete_array, concrete_number
from jaxlidar._vectors import Vec, scale, vec
from jaxlidar.instrument.field_of_view import visible_fraction
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.optics.laws import AbstractLaw
from jaxlidar.optics.phase import AbstractPhase

Rays = Float[np.ndarray, "rays 3"]
PerRay = Float[np.ndarray, "rays"]


def footprint_rays(lidar: Lidar) -> tuple[Rays, PerRay]:
    """Directions of footprint rays of equal energy, and the share of each that the receiver sees."""
    axis, slant = concrete_array(lidar.direction), concrete_number(lidar.range_to_reference)
    radius = concrete_number(lidar.footprint_radius)
    u, turn = ((np.arange(n) + 0.5) / n for n in (64, 32))
    r = radius * (np.sqrt(-0.5 * np.log1p(-u)) if lidar.profile == "gaussian" else np.sqrt(u))
    first = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.7 else [0, 1.0, 0])
    first /= np.linalg.norm(first)
    circle = np.outer(np.cos(2 * np.pi * turn), first)
    circle = circle + np.outer(np.sin(2 * np.pi * turn), np.cross(axis, first))
    rays = (axis * slant + r[:, None, None] * circle).reshape(-1, 3)
    share = np.ones_like(r)
    if lidar.field_of_view is not None:
        share = visible_fraction(r / (slant * concrete_number(lidar.field_of_view) * 0.5e-3), np)
    return rays / np.linalg.norm(rays, axis=1)[:, None], np.repeat(share, turn.size)


@eqx.filter_jit
def _intensity_factor(
    law: AbstractLaw | AbstractPhase, incident: Vec, normal: Vec, half_angle: Array
) -> Array:
    back = scale(incident, jnp.asarray(-1.0))
    if isinstance(law, AbstractPhase):
        return law.intensity_factor(incident, back)
    return law.intensity_factor(incident, normal, back, half_angle)


def backscatter(
    law: AbstractLaw | AbstractPhase,
    rays: Rays,
    normal: Float[np.ndarray, "3"] | None = None,
    half_angle: float = 0.0,
    two_sided: bool = False,
) -> PerRay:
    """Intensity factors of rays for light scattered straight back; zero from below, unless `two_sided`."""
    normal = np.zeros(3) if normal is None else normal
    below = rays @ normal > 0
    lit = np.where(below & two_sided, -1.0, 1.0)[:, None] * normal
    # In double precision: bounds are ratios of sums of these.
    with jax.enable_x64(True):
        incident, upward = (vec(jnp.asarray(a)) for a in (rays.T, lit.T))
        found = np.asarray(_intensity_factor(law, incident, upward, jnp.asarray(half_angle)), float)
    return np.where(below & (not two_sided), 0.0, found)
