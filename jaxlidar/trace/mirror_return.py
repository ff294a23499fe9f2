r"""First-order return of a specular surface.

A mirror sends back only what falls into the aperture, which rays of the ordinary footprint mostly miss. Let e
be a point of the beam on the mirror, I the irradiance there, m the point where the mirror image of the beam
axis meets the receiver's plane, a the radius of the aperture, R the range and r the roughness. The receiver
gets

    integral over e of  I(e) P(|m + 2 e|) de,

where P(d) is the fraction of a Gaussian of standard deviation r R, centred d from the axis, that falls within
a of it; the factor 2 is the spreading of the beam on its return. Half of the rays are drawn from I and half
from P, and weighted by the balance heuristic (Veach and Guibas 1995), so that images much smaller and much
larger than the aperture are sampled equally well. The integral over a Gaussian beam is P(|m|) with the
variance w^2 + (r R)^2, and the rays are scaled to it. Without roughness and at normal incidence it is 1 -
exp(-2 a^2 / w^2), w being the radius of the beam at twice the range.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import i0e
from jaxtyping import Array, Float

from jaxlidar._vectors import Scalar, dot, to_frame, vec
from jaxlidar.optics.laws import AbstractMirror
from jaxlidar.trace.footprint import GOLDEN, Beam, across_beam, disc
from jaxlidar.trace.surfaces import TracedSurface

RAYS = 4096
# Lobes narrower than this are given this width, in units of the aperture's radius: P would be a step.
_MIN_LOBE = 1e-3
# Keeps quotients of densities and their derivatives finite in single precision where all are zero.
_TINY = 1e-9
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(48)


def mirror_rays(
    beam: Beam, surface: TracedSurface
) -> tuple[tuple[Float[Array, "rays"], Float[Array, "rays"]], Float[Array, "rays"]]:
    """Sample rays across the beam that return from a mirror, and the apparent reflectance that each carries.

    The apparent reflectance is per unit reflectance and for a transparent path. The angle between the beam
    axis and its mirror image is assumed to be small.

    1. The distance of the mirror along the beam axis, and the beam's width there.
    2. The point m where the mirrored axis meets the receiver's plane.
    3. Half of the rays from the beam's profile, half from points of the aperture mapped back to the mirror.
    4. Weights by the balance heuristic; for a Gaussian beam scaled to the closed form of their sum.
    """
    assert isinstance(surface.law, AbstractMirror)
    r, a = beam.slant_range, beam.half_angle * beam.slant_range
    # Along the axis; the mirror may lie above the reference plane, before the aim point.
    aim = vec(jnp.zeros(3, r.dtype))
    upward, offset = surface.shape.tangent(aim)
    towards = dot(upward, beam.axis)
    parallel = jnp.abs(towards) < 1e-9
    distance = r + jnp.where(parallel, 0.0, offset / jnp.where(parallel, 1.0, towards))
    # From here on the beam has the width that it has on the mirror.
    magnification = distance / r
    beam = eqx.tree_at(lambda b: b.radius, beam, beam.radius * magnification)
    normal = surface.lit_normal(aim, beam.axis)
    cosine = -dot(normal, beam.axis)
    # m: along the normal's component across the axis.
    miss = vec(2.0 * cosine * distance * (n + cosine * k) for n, k in zip(normal, beam.axis))
    miss = to_frame(beam.axis, miss)[:2]
    sigma = jnp.maximum(surface.law.roughness * distance, _MIN_LOBE * a)

    n = RAYS // 2
    i = np.arange(n)
    u = jnp.asarray((i + 0.5) / n, r.dtype)
    turn = _fraction_of_turn(i * GOLDEN, r)
    # A second pair of coordinates for the lobe, from the two-dimensional golden-ratio lattice.
    lobe_radius = sigma * jnp.sqrt(-2.0 * jnp.log1p(-_fraction_of_turn(i * 0.7548776662466927 + 0.5, r)))
    lobe = disc(lobe_radius, _fraction_of_turn(i * 0.5698402909980532 + 0.5, r))
    in_aperture = disc(a * jnp.sqrt(u), turn)
    from_beam = across_beam(beam, u, turn)
    from_aperture = tuple((q - m - g) / 2.0 for q, m, g in zip(in_aperture, miss, lobe))
    x, y = (jnp.concatenate([p, q]) for p, q in zip(from_beam, from_aperture))

    irradiance = beam.irradiance((x, y))
    caught = gaussian_within(_length((miss[0] + 2.0 * x, miss[1] + 2.0 * y)), sigma, a)
    # Density with which e was drawn: the mean of I and that of points whose image falls into the aperture.
    density = 0.5 * (irradiance + 4.0 * caught / (np.pi * a**2))
    # Divided by the aperture's squared half-angle, the fraction of the energy is apparent reflectance.
    unit = (distance / a) ** 2
    value = unit * irradiance * caught / jnp.maximum(density, _TINY) / (2 * n)
    if beam.gaussian:
        estimate = jnp.sum(value)
        is_seen = estimate > _TINY
        exact = unit * gaussian_within(_length(miss), jnp.hypot(beam.radius, sigma), a)
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


def _fraction_of_turn(number: np.ndarray, like: Scalar) -> Scalar:
    return jnp.asarray(number % 1.0, like.dtype)


def _length(v: tuple[Scalar, Scalar]) -> Scalar:
    # The small term keeps the derivative at zero finite.
    return jnp.sqrt(v[0] ** 2 + v[1] ** 2 + 1e-24)
