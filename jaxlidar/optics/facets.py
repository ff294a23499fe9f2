"""Facets: flat Lambertian elements of leaf or bark in a voxel, with normals in all directions alike.

Light that travels along w meets a facet of normal n (on the lit side) with the density |n . w|/pi per
steradian: the projected area. The facet reflects by the cosine law into the lit side, or transmits by the
cosine law into the other. The mean over normals is Ross's phase function (Ross 1981, The Radiation Regime and
Architecture of Plant Stands, eq. II.3.8; Shultis and Myneni 1988, J. Quant. Spectrosc. Radiat. Transf. 39,
115). With b the angle between the incident direction of travel w and the view direction v, its reflected part
has the *intensity factor* (pi times the radiant intensity towards v per unit of reflected flux)

    f(b) = pi * integral over n of [|n . w|/pi] [(n . v)+/pi] dn = 2/(3 pi) (sin b - b cos b),

and its transmitted part f(pi - b). Straight back, at b = pi, f = 2/3: the mean squared cosine 1/3 over the
mean cosine 1/2.
"""

import functools

import jax.numpy as jnp
import numpy as np

from jaxlidar._vectors import Scalar, Vec, cosine_direction, scale

# f(pi), per unit of intercepted and reflected light. Per leaf area, with G = 1/2, this is Ross's R/3.
FACET_BACKSCATTER = 2.0 / 3.0


def facet_reflection(cos_angle: Scalar) -> Scalar:
    """Intensity factor of reflection by spherically oriented facets, f(b).

    **Arguments:**

    - `cos_angle`: cosine of the angle between incident and view direction, any shape.

    **Returns:** an array shaped as `cos_angle`.
    """
    c = jnp.clip(cos_angle, -1.0, 1.0)
    return 2.0 / (3.0 * np.pi) * (_forward_factor(jnp.abs(c)) + np.pi * jnp.maximum(-c, 0.0))


def facet_transmission(cos_angle: Scalar) -> Scalar:
    """Intensity factor of diffuse transmission by spherically oriented facets, f(pi - b).

    **Arguments:**

    - `cos_angle`: cosine of the angle between incident and view direction, any shape.

    **Returns:** an array shaped as `cos_angle`.
    """
    return facet_reflection(-cos_angle)


# As f(pi - b) = f(b) + 2/3 cos b, this is needed for b up to pi/2 alone. With x = 1 - cos b it is x^(3/2)
# times a function that is smooth from 0 to 1. A polynomial for that takes much less time than the inverse
# tangent, and has no cancellation at small angles.
def _forward_factor(c: Scalar) -> Scalar:
    """Return sin b - b cos b for b from 0 to pi/2, of c = cos b."""
    x = 1.0 - c
    smooth = jnp.zeros_like(x)
    for coefficient in reversed(_smooth_coefficients(8 if jnp.finfo(x.dtype).bits == 32 else 17)):
        smooth = smooth * (2.0 * x - 1.0) + float(coefficient)
    # Above zero, for the derivative of the root.
    return x * jnp.sqrt(jnp.maximum(x, 1e-30)) * smooth


@functools.cache
def _smooth_coefficients(count: int) -> np.ndarray:
    """Return coefficients of a polynomial in y = 1 - 2 cos b for (sin b - b cos b) / (1 - cos b)^(3/2).

    Eight are exact to a few units in the last place in single precision, seventeen in double.
    """
    # Interpolation at the zeros of a Chebyshev polynomial, in x = 1 - cos b from 0 to 1.
    y = np.cos(np.pi * (np.arange(17) + 0.5) / 17)
    x = 0.5 * (y + 1.0)
    b = 2.0 * np.arcsin(np.sqrt(0.5 * x))
    # The power series of sin b - b cos b, over b^3: all digits at small angles.
    series, term = np.zeros_like(b), np.full_like(b, 1.0 / 3.0)
    for n in range(1, 20):
        series = series + term
        term = -term * b * b * (n + 1) / (n * (2 * n + 2) * (2 * n + 3))
    interpolation = np.polynomial.chebyshev.chebfit(y, series * (b / np.sqrt(x)) ** 3, 16)
    # Truncated as Chebyshev's series, which is next to the best approximation.
    return np.polynomial.chebyshev.cheb2poly(interpolation[:count])


def facet_normal(incident: Vec, u: Scalar, v: Scalar) -> Vec:
    """Draw the normal of the spherically oriented facet that light hits.

    Its density per steradian is |n . incident| / pi, on the lit side: the cosine law about the direction in
    which the light came.

    **Arguments:**

    - `incident`: unit vector of travel.
    - `u`, `v`: numbers that are uniform in (0, 1).

    **Returns:** a unit vector.
    """
    return cosine_direction(scale(incident, jnp.asarray(-1.0)), u, v)
