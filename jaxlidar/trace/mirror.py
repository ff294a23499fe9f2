r"""First return of a specular surface.

A mirror sends back only what falls into the aperture: rays of the ordinary footprint mostly miss it. So
pairs of a point e of the beam and a point q of the aperture are taken, and weighted by

    integral over q of integral over e of  I(e) N(q - 2 e - m; (roughness R)^2) de dq,

I the irradiance across the beam, m where the mirror image of the axis meets the receiver's plane; the
factor 2 is the spreading of the beam on its way back. Pairs come from both factors (given q, e from the
lobe; and e from the beam) with the balance heuristic, so that any roughness is sampled well. Without
roughness and at normal incidence the integral is 1 - exp(-2 a^2 / w^2), a the aperture's radius and
w the beam's radius at twice the range.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._vector import dot, to_frame, vec
from ..materials import Specular
from .footprint import GOLDEN, Beam, quantile_radius
from .surfaces import Surface

PAIRS = 4096
# Lobes narrower than this are taken as this wide, in units of the beam's or aperture's radius.
_NARROW = 1e-3


def mirror_rays(
    beam: Beam, surface: Surface
) -> tuple[tuple[Float[Array, "rays"], Float[Array, "rays"]], Float[Array, "rays"]]:
    """Rays across the beam that return from a mirror, and the apparent reflectance each carries.

    The apparent reflectance is per unit reflectance and for a transparent way; rays weigh less towards
    the edges of the lobe. Small angles are assumed between the beam's axis and the mirror image of it.
    """
    assert isinstance(surface.law, Specular)
    r, a = beam.slant_range, beam.half_angle * beam.slant_range
    # Along the axis; the mirror may lie above the reference plane, before the aim point.
    towards = dot(surface.normal, beam.axis)
    parallel = jnp.abs(towards) < 1e-9
    distance = r + jnp.where(parallel, 0.0, surface.offset / jnp.where(parallel, 1.0, towards))
    # From here on `e` is on the mirror, where the beam is wider than on the reference plane.
    wider = distance / r
    beam = eqx.tree_at(lambda b: b.radius, beam, beam.radius * wider)
    normal = surface.lit_normal(beam.axis)
    cosine = -dot(normal, beam.axis)
    # Where the image of the axis meets the receiver's plane: along the normal's part across the axis.
    miss = vec(2.0 * cosine * distance * (n + cosine * k) for n, k in zip(normal, beam.axis))
    across_miss = to_frame(beam.axis, miss)[:2]

    widest = jnp.maximum(a, beam.radius)
    sigma = jnp.maximum(surface.law.roughness * distance, _NARROW * jnp.minimum(widest, a))
    n = PAIRS // 2
    i = np.arange(n)
    dtype = r.dtype

    def disc(radius, turn):
        return radius * jnp.cos(2 * np.pi * turn), radius * jnp.sin(2 * np.pi * turn)

    turn = jnp.asarray((i * GOLDEN) % 1.0, dtype)
    u = jnp.asarray((i + 0.5) / n, dtype)
    # A second, independent pair of coordinates for the inner point.
    v = jnp.asarray((i * 0.7548776662466927 + 0.5) % 1.0, dtype)
    spin = jnp.asarray((i * 0.5698402909980532 + 0.5) % 1.0, dtype)
    q = disc(a * jnp.sqrt(u), turn)
    lobe = disc(sigma * jnp.sqrt(-2.0 * jnp.log1p(-v)), spin)
    from_lobe = tuple((qk - m - g) / 2.0 for qk, m, g in zip(q, across_miss, lobe))
    from_beam = disc(quantile_radius(beam, u), turn)
    q_beam = disc(a * jnp.sqrt(v), spin)

    def value(e, q):
        irradiance = beam.irradiance(e)
        off2 = sum((qk - 2.0 * ek - m) ** 2 for qk, ek, m in zip(q, e, across_miss))
        density = jnp.exp(-jnp.minimum(off2 / (2 * sigma**2), 80.0)) / (2 * np.pi * sigma**2)
        # Densities of e given q: 4 N from the lobe, I from the beam; half of the pairs from each.
        sampled = 0.5 * (4.0 * density + irradiance)
        return irradiance * density / jnp.maximum(sampled, 1e-37)

    e = tuple(jnp.concatenate([p, b]) for p, b in zip(from_lobe, from_beam))
    both = tuple(jnp.concatenate([p, b]) for p, b in zip(q, q_beam))
    # Captured share of the energy is area of the aperture times the mean; divided by alpha^2 it is
    # apparent reflectance.
    share = np.pi * a**2 * value(e, both) / (2 * n)
    return (e[0] / wider, e[1] / wider), share * (distance / a) ** 2
