r"""Facets: flat Lambertian pieces of leaf or bark, turned every way, that light in a voxel meets.

With spherical orientation they scatter by Ross's phase function (Ross 1981, eq. II.3.8; Shultis and Myneni
1988). Its reflected part, per unit projected area, is the *view factor* 2/(3 pi) (sin b - b cos b), b the
angle between incident and view direction: apparent reflectance per unit reflectance, pi times the density per
steradian.
"""

import jax.numpy as jnp
import numpy as np

from jaxlidar._vectors import Scalar, Vec, about, scale

# Backscatter of spherically oriented facets: the mean squared cosine 1/3 over the mean cosine 1/2, hence
# Ross's R/3 for leaf area.
FACET_BACKSCATTER = 2.0 / 3.0


def facet_reflection(cos_angle: Scalar) -> Scalar:
    """View factor of reflection by spherically oriented facets; `cos_angle` = incident . view."""
    c = jnp.clip(cos_angle, -1.0, 1.0)
    b = _arccos(c)
    return 2.0 / (3.0 * np.pi) * (jnp.sqrt(_one_minus_square(c)) - b * c)


def facet_transmission(cos_angle: Scalar) -> Scalar:
    """View factor of diffuse transmission by spherically oriented facets."""
    return facet_reflection(-cos_angle)


def _one_minus_square(c: Scalar) -> Scalar:
    return jnp.maximum((1.0 - c) * (1.0 + c), 1e-30)


def _arccos(c: Scalar) -> Scalar:
    # arctan2 keeps the derivative finite at the ends, where arccos has none.
    return jnp.arctan2(jnp.sqrt(_one_minus_square(c)), c)


def facet_normal(incident: Vec, u: Scalar, v: Scalar) -> Vec:
    """Normal of a spherically oriented facet that was hit: density |n . incident| / pi, on the lit side."""
    return about(scale(incident, jnp.asarray(-1.0)), u, v)
