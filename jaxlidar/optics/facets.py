"""Facets: flat Lambertian pieces of leaf or bark that light meets in a voxel.

Spherically oriented facets scatter by Ross's phase function (Ross 1981, eq. II.3.8; Shultis and Myneni 1988).
Its reflected part, per unit projected area, is the *intensity factor* 2/(3 pi) (sin b - b cos b), with b the
angle between incident and view direction. An intensity factor is pi times the radiant intensity towards the
view per unit of scattered flux, that is pi times the density per steradian.
"""

import jax.numpy as jnp
import numpy as np

from jaxlidar._vectors import Scalar, Vec, about, scale

# Backscatter of spherically oriented facets: the mean squared cosine 1/3 over the mean cosine 1/2, hence
# Ross's R/3 for leaf area.
FACET_BACKSCATTER = 2.0 / 3.0


def facet_reflection(cos_angle: Scalar) -> Scalar:
    """Intensity factor of reflection by spherically oriented facets.

    **Arguments:**

    - `cos_angle`: cosine of the angle between incident and view direction, any shape.

    **Returns:** an array shaped as `cos_angle`.
    """
    c = jnp.clip(cos_angle, -1.0, 1.0)
    b = _arccos(c)
    return 2.0 / (3.0 * np.pi) * (jnp.sqrt(_one_minus_square(c)) - b * c)


def facet_transmission(cos_angle: Scalar) -> Scalar:
    """Intensity factor of diffuse transmission by spherically oriented facets.

    **Arguments:**

    - `cos_angle`: cosine of the angle between incident and view direction, any shape.

    **Returns:** an array shaped as `cos_angle`.
    """
    return facet_reflection(-cos_angle)


def _one_minus_square(c: Scalar) -> Scalar:
    return jnp.maximum((1.0 - c) * (1.0 + c), 1e-30)


def _arccos(c: Scalar) -> Scalar:
    # arctan2 keeps the derivative finite at the ends, where arccos has none.
    return jnp.arctan2(jnp.sqrt(_one_minus_square(c)), c)


def facet_normal(incident: Vec, u: Scalar, v: Scalar) -> Vec:
    """Normal of the spherically oriented facet that light hits, drawn at random.

    Its density is |n . incident| / pi, on the lit side.

    **Arguments:**

    - `incident`: unit vector of travel.
    - `u`, `v`: numbers that are uniform in (0, 1).

    **Returns:** a unit vector.
    """
    return about(scale(incident, jnp.asarray(-1.0)), u, v)
