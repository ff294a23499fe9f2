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

import jax.numpy as jnp
import numpy as np

from jaxlidar._vectors import Scalar, Vec, about, scale

# f(pi), per unit of intercepted and reflected light. Per leaf area, with G = 1/2, this is Ross's R/3.
FACET_BACKSCATTER = 2.0 / 3.0


def facet_reflection(cos_angle: Scalar) -> Scalar:
    """Intensity factor of reflection by spherically oriented facets, f(b).

    **Arguments:**

    - `cos_angle`: cosine of the angle between incident and view direction, any shape.

    **Returns:** an array shaped as `cos_angle`.
    """
    c = jnp.clip(cos_angle, -1.0, 1.0)
    b = _arccos(c)
    return 2.0 / (3.0 * np.pi) * (jnp.sqrt(_one_minus_square(c)) - b * c)


def facet_transmission(cos_angle: Scalar) -> Scalar:
    """Intensity factor of diffuse transmission by spherically oriented facets, f(pi - b).

    **Arguments:**

    - `cos_angle`: cosine of the angle between incident and view direction, any shape.

    **Returns:** an array shaped as `cos_angle`.
    """
    return facet_reflection(-cos_angle)


def _one_minus_square(c: Scalar) -> Scalar:
    """1 - c^2 without cancellation near c = 1 and -1; above zero, for the derivative of its root."""
    return jnp.maximum((1.0 - c) * (1.0 + c), 1e-30)


def _arccos(c: Scalar) -> Scalar:
    # arctan2 keeps the derivative finite at the ends, where arccos has none.
    return jnp.arctan2(jnp.sqrt(_one_minus_square(c)), c)


def facet_normal(incident: Vec, u: Scalar, v: Scalar) -> Vec:
    """Draw the normal of the spherically oriented facet that light hits.

    Its density per steradian is |n . incident| / pi, on the lit side: the cosine law about the direction in
    which the light came.

    **Arguments:**

    - `incident`: unit vector of travel.
    - `u`, `v`: numbers that are uniform in (0, 1).

    **Returns:** a unit vector.
    """
    return about(scale(incident, jnp.asarray(-1.0)), u, v)
