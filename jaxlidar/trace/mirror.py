r"""First return of a specular surface.

A mirror sends back only what falls into the aperture, which rays of the ordinary footprint mostly miss. Let e
be a point of the beam on the mirror, I the irradiance there, m the point where the mirror image of the beam
axis meets the receiver's plane, a the radius of the aperture, R the range and r the roughness. The receiver
gets

    integral over e of  I(e) P(|m + 2 e|) de,

where P(d) is the share of a Gaussian of standard deviation r R, centred d from the axis, that falls within a
of it; the factor 2 is the spreading of the beam on its way back. Half of the rays are drawn from I and half
from P, and weighted by the balance heuristic, so that images much smaller and much larger than the aperture
are sampled equally well. The sum over a Gaussian beam is known, P(|m|) with the variance w^2 + (r R)^2, and
the rays are scaled to it. Without roughness and at normal incidence it is 1 - exp(-2 a^2 / w^2), w being the
radius of the beam at twice the range.
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
from jaxlidar.trace.surfaces import Surface

RAYS = 4096
# Lobes narrower than this are taken as this wide, in units of the aperture's radius.
_NARROW = 1e-3
# Keeps quotients of densities and their derivatives finite in single precision where all are zero.
_TINY = 1e-9
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(48)


def mirror_rays(
    beam: Beam, surface: Surface
) -> tuple[tuple[Float[Array, "rays"], Float[Array, "rays"]], Float[Array, "rays"]]:
    """Rays across the beam that return from a mirror, and the apparent reflectance that each carries.

    The apparent reflectance is per unit reflectance and for a transparent way. The angle between the beam
    axis and its mirror image is assumed to be small.
    """
    assert isinstance(surface.law, AbstractMirror)
    r, a = beam.slant_range, beam.half_angle * beam.slant_range
    # Along the axis; the mirror may lie above the reference plane, before the aim point.
    aim = vec(jnp.zeros(3, r.dtype))
    upward, offset = surface.shape.tangent(aim)
    towards = dot(upward, beam.axis)
    parallel = jnp.abs(towards) < 1e-9
    distance = r + jnp.where(parallel, 0.0, offset / jnp.where(parallel, 1.0, towards))
    # From here on the beam is as wide as it is on the mirror.
    wider = distance / r
    beam = eqx.tree_at(lambda b: b.radius, beam, beam.radius * wider)
    normal = surface.lit_normal(aim, beam.axis)
    cosine = -dot(normal, beam.axis)
    # Where the image of the axis meets the receiver's plane: along the normal's part across the axis.
    miss = vec(2.0 * cosine * distance * (n + cosine * k) for n, k in zip(normal, beam.axis))
    miss = to_frame(beam.axis, miss)[:2]
    sigma = jnp.maximum(surface.law.roughness * distance, _NARROW * a)

    n = RAYS // 2
    i = np.arange(n)
    u = jnp.asarray((i + 0.5) / n, r.dtype)
    turn = _turn(i * GOLDEN, r)
    # A second, independent pair of coordinates for the lobe.
    lobe = sigma * jnp.sqrt(-2.0 * jnp.log1p(-_turn(i * 0.7548776662466927 + 0.5, r)))
    inside, lobe = disc(a * jnp.sqrt(u), turn), disc(lobe, _turn(i * 0.5698402909980532 + 0.5, r))
    from_beam = across_beam(beam, u, turn)
    from_aperture = tuple((q - m - g) / 2.0 for q, m, g in zip(inside, miss, lobe))
    x, y = (jnp.concatenate([p, q]) for p, q in zip(from_beam, from_aperture))

    irradiance = beam.irradiance((x, y))
    caught = within(_length((miss[0] + 2.0 * x, miss[1] + 2.0 * y)), sigma, a)
    # Densities with which e was drawn: I, and that of points whose image falls into the aperture.
    drawn = 0.5 * (irradiance + 4.0 * caught / (np.pi * a**2))
    # Divided by the aperture's squared half-angle, the share of the energy is apparent reflectance.
    unit = (distance / a) ** 2
    value = unit * irradiance * caught / jnp.maximum(drawn, _TINY) / (2 * n)
    if beam.gaussian:
        found = jnp.sum(value)
        seen = found > _TINY
        known = unit * within(_length(miss), jnp.hypot(beam.radius, sigma), a)
        value = value * jnp.where(seen, known / jnp.where(seen, found, 1.0), 0.0)
    return (x / wider, y / wider), value


def within(distance: Scalar, sigma: Scalar, radius: Scalar) -> Scalar:
    """Share of a two-dimensional Gaussian within `radius` of a point at `distance` from its centre.

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


def _turn(number: np.ndarray, like: Scalar) -> Scalar:
    return jnp.asarray(number % 1.0, like.dtype)


def _length(v: tuple[Scalar, Scalar]) -> Scalar:
    # The small number keeps the derivative at zero finite.
    return jnp.sqrt(v[0] ** 2 + v[1] ** 2 + 1e-24)
