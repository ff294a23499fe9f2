r"""First-order return of a specular surface.

A mirror sends back only what falls into the aperture, which rays of the ordinary footprint mostly miss. With

    e       a point of the beam on the mirror, across the beam      I       the irradiance there
    m       where the mirror image of the beam axis meets the receiver's plane
    a       radius of the aperture                                  R       distance of the mirror
    w0      radius of the beam on the mirror (at 1/e^2)             rho     roughness, rad
    P(d)    fraction of a Gaussian of the standard deviation rho R, centred d from the axis, within a of it

the receiver gets

    integral over e of  I(e) P(|m + 2 e|) de;

the factor 2 is the spreading of the beam on its return. The rays e are a fixed set of points, half of them
distributed as I and half as the points whose image falls into the aperture, weighted by the balance heuristic
(Veach and Guibas 1995), so that images much smaller and much larger than the aperture are resolved equally
well. The integral over a Gaussian beam is P(|m|) with the variance w0^2 + (rho R)^2, and the rays are scaled
to it. Without roughness and at normal incidence it is 1 - exp(-a^2 / (2 w0^2)): the beam's radius on its
return is 2 w0.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import i0e
from jaxtyping import Array, Float

from jaxlidar._vectors import Scalar, dot, to_frame, vec
from jaxlidar.optics.laws import AbstractMirror
from jaxlidar.trace.first.footprint import GOLDEN, Beam, across_beam, from_polar
from jaxlidar.trace.march.surfaces import TracedSurface

RAYS = 4096
# Lobes narrower than this are given this width, in units of the aperture's radius: P would be a step.
_MIN_LOBE = 1e-3
# Keeps quotients of densities and their derivatives finite in single precision where all are zero.
_TINY = 1e-9
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(48)
# Steps of the two-dimensional golden-ratio sequence (Roberts's R2): 1/g and 1/g^2 with g^3 = g + 1.
_R2_STEPS = (0.7548776662466927, 0.5698402909980532)


def mirror_rays(
    beam: Beam, surface: TracedSurface
) -> tuple[tuple[Float[Array, "rays"], Float[Array, "rays"]], Float[Array, "rays"]]:
    """Place rays across the beam that return from a mirror, and give each its apparent reflectance.

    The apparent reflectance is per unit reflectance and for a transparent path. The angle between the beam
    axis and its mirror image is assumed to be small.

    1. The distance of the mirror along the beam axis, and the beam's width there.
    2. The point m where the mirrored axis meets the receiver's plane.
    3. Half of the rays distributed as the beam's profile, half as points of the aperture, less a point of the
       lobe and m, mapped back to the mirror.
    4. Weights by the balance heuristic; for a Gaussian beam scaled to the closed form of their sum.
    """
    assert isinstance(surface.law, AbstractMirror)
    assert surface.shape is not None
    slant_range, aperture = beam.slant_range, beam.half_angle * beam.slant_range
    # Along the axis; the mirror may lie above the reference plane, before the aim point.
    aim = vec(jnp.zeros(3, slant_range.dtype))
    upward, offset = surface.shape.tangent(aim)
    towards = dot(upward, beam.axis)
    parallel = jnp.abs(towards) < 1e-9
    distance = slant_range + jnp.where(parallel, 0.0, offset / jnp.where(parallel, 1.0, towards))
    # From here on the beam has the width that it has on the mirror.
    magnification = distance / slant_range
    beam = eqx.tree_at(lambda b: b.radius, beam, beam.radius * magnification)
    normal = surface.lit_normal(aim, beam.axis)
    cosine = -dot(normal, beam.axis)
    # The vector m lies along the normal's component across the axis.
    miss = vec(2.0 * cosine * distance * (n + cosine * k) for n, k in zip(normal, beam.axis))
    miss = to_frame(beam.axis, miss)[:2]
    sigma = jnp.maximum(surface.law.roughness * distance, _MIN_LOBE * aperture)

    n_half = RAYS // 2
    i = np.arange(n_half)
    u = jnp.asarray((i + 0.5) / n_half, slant_range.dtype)
    turn = _fractional_part(i * GOLDEN, slant_range)
    # A second pair of coordinates for the lobe.
    lobe_u, lobe_turn = (_fractional_part(i * step + 0.5, slant_range) for step in _R2_STEPS)
    lobe = from_polar(sigma * jnp.sqrt(-2.0 * jnp.log1p(-lobe_u)), lobe_turn)
    in_aperture = from_polar(aperture * jnp.sqrt(u), turn)
    from_beam = across_beam(beam, u, turn)
    from_aperture = tuple((q - m - g) / 2.0 for q, m, g in zip(in_aperture, miss, lobe))
    x, y = (jnp.concatenate([p, q]) for p, q in zip(from_beam, from_aperture))

    irradiance = beam.irradiance((x, y))
    # P(|m + 2 e|).
    caught = gaussian_within(_length((miss[0] + 2.0 * x, miss[1] + 2.0 * y)), sigma, aperture)
    # Density of the rays: the mean of I and that of points whose image falls into the aperture.
    density = 0.5 * (irradiance + 4.0 * caught / (np.pi * aperture**2))
    # Divided by the aperture's squared half-angle, the fraction of the energy is apparent reflectance.
    unit = (distance / aperture) ** 2
    value = unit * irradiance * caught / jnp.maximum(density, _TINY) / (2 * n_half)
    if beam.gaussian and beam.ellipse is None:
        estimate = jnp.sum(value)
        is_seen = estimate > _TINY
        exact = unit * gaussian_within(_length(miss), jnp.hypot(beam.radius, sigma), aperture)
        value = value * jnp.where(is_seen, exact / jnp.where(is_seen, estimate, 1.0), 0.0)
    return (x / magnification, y / magnification), value


def gaussian_within(distance: Scalar, sigma: Scalar, radius: Scalar) -> Scalar:
    """Fraction of a two-dimensional Gaussian within `radius` of a point at `distance` from its centre.

    This is one minus Marcum's Q function, integrated by a Gauss rule over the ring that a Gaussian of eight
    `sigma` covers; accurate to 1e-6.
    """
    low = jnp.clip(distance - 8.0 * sigma, 0.0, radius)
    high = jnp.minimum(distance + 8.0 * sigma, radius)
    half = 0.5 * (high - low)

    def at(node, weight):
        rho = low + half * (1.0 + node)
        off = jnp.exp(-0.5 * ((rho - distance) / sigma) ** 2)
        return weight * half * rho / sigma**2 * off * i0e(rho / sigma * (distance / sigma))

    dtype = distance.dtype
    return jnp.sum(jax.vmap(at)(jnp.asarray(_NODES, dtype), jnp.asarray(_WEIGHTS, dtype)), axis=0)


def _fractional_part(number: np.ndarray, like: Scalar) -> Scalar:
    return jnp.asarray(number % 1.0, like.dtype)


def _length(v: tuple[Scalar, Scalar]) -> Scalar:
    # The small term keeps the derivative at zero finite.
    return jnp.sqrt(v[0] ** 2 + v[1] ** 2 + 1e-24)
