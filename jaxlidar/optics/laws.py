r"""Scattering laws: how surfaces and the facets of a canopy send light on.

Everything is normalised by reflectance and transmittance, which the tracer never sees. The *view
factor* of a law is its apparent reflectance per unit reflectance, pi times the probability density
per steradian of scattering towards the receiver:

    Lambertian      cos(theta)
    equal-angle     1 / (pi sqrt(sin^2(theta) + alpha^2 / 4)),  alpha the aperture's half-angle
    isotropic       1 / 4
    facets          2/(3 pi) (sin b - b cos b), b the angle between incident and view direction

The equal-angle law (the paper's "every angle equally likely") has the density 1/(pi^2 sin theta),
singular at the normal; the form above is its average over the aperture, exact at the normal.
Facets with spherical orientation scatter by Ross's phase function (Ross 1981, eq. II.3.8; Shultis
and Myneni 1988), of which the formula is the reflected part per unit projected area.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._checks import as_scalar, check_range
from jaxlidar._vectors import Scalar, Vec, dot, from_frame, polar, vec

ANGLE_CELLS = 90
ANGLE_NODES = 129


class AbstractLaw(eqx.Module):
    """How a surface distributes what it reflects. Directions are unit vectors of travel."""

    @abc.abstractmethod
    def view_factor(self, incident: Vec, normal: Vec, view: Vec, half_angle: Scalar) -> Scalar:
        """Apparent reflectance per unit reflectance towards `view`; `normal` is on the lit side."""

    @abc.abstractmethod
    def sample(self, incident: Vec, normal: Vec, u: Scalar, v: Scalar) -> Vec:
        """A direction drawn with two uniform numbers; `normal` is on the lit side."""

    @abc.abstractmethod
    def density(self, incident: Vec, normal: Vec, out: Vec) -> Scalar:
        """Density of `sample`, up to a constant: only its relative change is used, for derivatives."""


class Lambertian(AbstractLaw):
    """Equal radiance into every direction of the lit side: intensity by the cosine law."""

    def view_factor(self, incident: Vec, normal: Vec, view: Vec, half_angle: Scalar) -> Scalar:
        return jnp.maximum(dot(normal, view), 0.0)

    def sample(self, incident: Vec, normal: Vec, u: Scalar, v: Scalar) -> Vec:
        return from_frame(normal, polar(jnp.sqrt(1.0 - u), 2 * np.pi * v))

    def density(self, incident: Vec, normal: Vec, out: Vec) -> Scalar:
        return dot(normal, out)


class EqualAngle(AbstractLaw):
    """Polar angle from the normal uniform in [0, 90] degrees: the paper's "every angle equally likely"."""

    def view_factor(self, incident: Vec, normal: Vec, view: Vec, half_angle: Scalar) -> Scalar:
        cosine = dot(normal, view)
        # |n x v|^2 without cancellation near the normal
        sine2 = (
            (normal[1] * view[2] - normal[2] * view[1]) ** 2
            + (normal[2] * view[0] - normal[0] * view[2]) ** 2
            + (normal[0] * view[1] - normal[1] * view[0]) ** 2
        )
        return jnp.where(cosine > 0, 1.0 / (np.pi * jnp.sqrt(sine2 + half_angle**2 / 4)), 0.0)

    def sample(self, incident: Vec, normal: Vec, u: Scalar, v: Scalar) -> Vec:
        return from_frame(normal, polar(jnp.cos(0.5 * np.pi * u), 2 * np.pi * v))

    def density(self, incident: Vec, normal: Vec, out: Vec) -> Scalar:
        cosine = dot(normal, out)
        return 1.0 / jnp.sqrt(jnp.maximum(1.0 - cosine * cosine, 1e-6))


class Specular(AbstractLaw):
    """A mirror whose facets are tilted a little: a Gaussian lobe about the mirror direction.

    **Arguments:**

    - `roughness`: standard deviation of the reflected direction about the mirror direction along
      each of two perpendicular axes, rad; 0 is a perfect mirror.

    The first return is exact for any roughness (see `jaxlidar.trace.mirror`). Paths of two or more
    scatterings whose last one is the mirror reach the receiver only within its lobe: they are
    unbiased, but so rare below a roughness of about 0.01 rad that few photons will show one. The
    derivative of such paths with respect to the mirror's slope leaves out the turning of the lobe.
    """

    roughness: Float[Array, ""] = eqx.field(converter=as_scalar, default=0.0)

    def __check_init__(self):
        check_range("roughness", self.roughness, 0.0, 0.5)

    def view_factor(self, incident: Vec, normal: Vec, view: Vec, half_angle: Scalar) -> Scalar:
        mirror = _mirror(incident, normal)
        # The receiver's own disc blurs the lobe; alpha^2 / 4 is the variance of a disc along an axis.
        variance = self.roughness**2 + half_angle**2 / 4
        off2 = 2.0 * (1.0 - jnp.clip(dot(mirror, view), -1.0, 1.0))
        return jnp.exp(-off2 / (2 * variance)) / (2 * variance)

    def sample(self, incident: Vec, normal: Vec, u: Scalar, v: Scalar) -> Vec:
        tilt = self.roughness * jnp.sqrt(-2.0 * jnp.log1p(-u))
        out = from_frame(_mirror(incident, normal), polar(jnp.cos(jnp.minimum(tilt, 1.5)), 2 * np.pi * v))
        # What the lobe would send through the surface is turned back into the lit side.
        below = jnp.minimum(dot(out, normal), 0.0)
        return vec(o - 2.0 * below * n for o, n in zip(out, normal))

    def density(self, incident: Vec, normal: Vec, out: Vec) -> Scalar:
        return jnp.ones_like(out[0])


def _mirror(incident: Vec, normal: Vec) -> Vec:
    along = 2.0 * dot(incident, normal)
    return vec(i - along * n for i, n in zip(incident, normal))
