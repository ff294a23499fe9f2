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

from ._checks import as_array, as_scalar, check_choice, check_range
from ._vector import Scalar, Vec, dot, from_frame, polar, scale, vec

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


class Isotropic(eqx.Module):
    """Volume scattering, equal into all directions: what discrete ordinates often compute.

    **Arguments:**

    - `albedo`: single scattering albedo, one number or one per wavelength, in [0, 1].
    """

    albedo: Float[Array, "..."] = eqx.field(converter=as_array)

    def __check_init__(self):
        check_range("albedo", self.albedo, 0.0, 1.0)


class LeafAngles(eqx.Module):
    """Distribution of leaf inclination, uniform in azimuth, as probabilities of one-degree cells.

    Made by `LeafAngles.named` or `LeafAngles.beta`; extinction of a canopy of leaf area density LAD is
    G(direction) * LAD. The spherical distribution needs no table (G = 1/2): a `VoxelMap` holds None.

    **Arguments:**

    - `probability`: (90,) probability that the inclination lies within 0..1, 1..2, ... 89..90 degrees;
      normalised here.
    """

    probability: Float[Array, "90"] = eqx.field(converter=as_array)

    def __check_init__(self):
        if self.probability.shape != (ANGLE_CELLS,):
            raise ValueError(
                f"probability has shape {self.probability.shape}; "
                f"admissible is ({ANGLE_CELLS},), one per degree"
            )
        check_range("probability", self.probability, 0.0)

    @staticmethod
    def named(name: str) -> "LeafAngles":
        """de Wit's (1965) planophile, erectophile, plagiophile, extremophile, or uniform, or spherical."""
        check_choice(
            "leaf_angles",
            name,
            ("spherical", "planophile", "erectophile", "plagiophile", "extremophile", "uniform"),
        )
        edge = np.linspace(0.0, np.pi / 2, ANGLE_CELLS + 1)
        cumulative = {
            "spherical": -np.cos(edge),
            "planophile": 2 / np.pi * (edge + np.sin(2 * edge) / 2),
            "erectophile": 2 / np.pi * (edge - np.sin(2 * edge) / 2),
            "plagiophile": 2 / np.pi * (edge - np.sin(4 * edge) / 4),
            "extremophile": 2 / np.pi * (edge + np.sin(4 * edge) / 4),
            "uniform": 2 / np.pi * edge,
        }[name]
        return LeafAngles(np.diff(cumulative))

    @staticmethod
    def beta(mean: float | Array, std: float | Array) -> "LeafAngles":
        """Beta distribution (Goel and Strebel 1984) of a mean and a standard deviation in degrees.

        Differentiable in both. Raises ValueError where no Beta distribution has these moments.
        """
        check_range("mean", mean, 0.0, 90.0, low_open=True, high_open=True)
        check_range("std", std, 0.0, 45.0, low_open=True, high_open=True)
        m, s = as_scalar(mean) / 90.0, as_scalar(std) / 90.0
        spread = m * (1 - m) / s**2 - 1
        check_range("mean (90 - mean) / std^2", spread + 1, 1.0, low_open=True)
        x = jnp.asarray((np.arange(ANGLE_CELLS) + 0.5) / ANGLE_CELLS)
        log_density = (m * spread - 1) * jnp.log(x) + ((1 - m) * spread - 1) * jnp.log1p(-x)
        density = jnp.exp(log_density - jnp.max(log_density))
        return LeafAngles(density / jnp.sum(density))

    def normalised(self) -> Float[Array, "90"]:
        """Probabilities that sum to one."""
        return self.probability / jnp.sum(self.probability)

    def tables(self) -> tuple[Float[Array, "129"], Float[Array, "129"]]:
        """Mean of |direction . normal| (which is G) and of its square, on equal steps of |cos zenith|."""
        mu = np.linspace(0.0, 1.0, ANGLE_NODES)[:, None]
        theta = np.deg2rad(np.arange(ANGLE_CELLS) + 0.5)[None, :]
        c, s = mu * np.cos(theta), np.sqrt(1 - mu**2) * np.sin(theta)
        # Mean over azimuth of |c + s cos(phi)| (Warren Wilson 1960).
        turn = np.arccos(np.clip(-c / np.where(s > 0, s, 1.0), -1.0, 1.0))
        oblique = (c * (2 * turn - np.pi) + 2 * s * np.sin(turn)) / np.pi
        first = np.where(c >= s, c, oblique)
        p = self.normalised()
        return jnp.asarray(first, p.dtype) @ p, jnp.asarray(c**2 + s**2 / 2, p.dtype) @ p


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
    return from_frame(scale(incident, jnp.asarray(-1.0)), polar(jnp.sqrt(1.0 - u), 2 * np.pi * v))


def about(normal: Vec, u: Scalar, v: Scalar) -> Vec:
    """A direction by the cosine law about `normal`."""
    return from_frame(normal, polar(jnp.sqrt(1.0 - u), 2 * np.pi * v))


def anywhere(u: Scalar, v: Scalar) -> Vec:
    """A direction, all equally likely."""
    return polar(1.0 - 2.0 * u, 2 * np.pi * v)
