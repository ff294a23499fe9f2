r"""Laws of reflection: how a surface distributes the light that it reflects.

Everything is normalised by reflectance, which the tracer never sees. The *view factor* of a law is its
apparent reflectance per unit reflectance, pi times the energy per steradian that it sends towards the
receiver:

    Lambertian      cos(theta)
    equal-angle     1 / (pi sqrt(sin^2(theta) + alpha^2 / 4)),  alpha the aperture's half-angle

The equal-angle law (the paper's "every angle equally likely") has the density 1/(pi^2 sin theta), singular at
the normal; the form above is its average over the aperture, exact at the normal.

A law of your own is one class in one file: derive it from `AbstractLaw`, give its five methods, and pass it
as `law=`. `jaxlidar/README.md` shows Minnaert's.
"""

import abc
from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._checks import as_scalar, check_range
from jaxlidar._vectors import Scalar, Vec, about, cross, dot, from_frame, polar, vec


class AbstractLaw(eqx.Module):
    """How a surface distributes what it reflects: the five methods that trace and plan need.

    Directions are unit vectors, (x, y, z) tuples of arrays of one shape; `incident` is the direction in which
    the light travels, `normal` that of the side it falls on, `out` and `view` lead away from the surface.
    Methods are pure, written with `jax.numpy` (see `jaxlidar.extend`), and differentiable in directions and
    fields.

    A law is consistent if, for an aperture that shrinks to nothing,

        view_factor = pi * albedo * density,

    and light that `sample` draws has that density. It is reciprocal if view_factor / |cosine of out| is the
    same with incident and out exchanged.
    """

    @abc.abstractmethod
    def view_factor(self, incident: Vec, normal: Vec, view: Vec, half_angle: Scalar) -> Scalar:
        """Apparent reflectance per unit reflectance towards `view`, averaged over the receiver's aperture.

        `half_angle`: of the aperture as seen from the surface, rad; laws without a singularity pass it over.
        """

    @abc.abstractmethod
    def albedo(self, incident: Vec, normal: Vec) -> Scalar:
        """Share of the light that is reflected at all, per unit reflectance, in [0, 1]; most laws: one."""

    @abc.abstractmethod
    def sample(self, incident: Vec, normal: Vec, u: Scalar, v: Scalar) -> Vec:
        """A direction drawn with two numbers that are uniform in (0, 1)."""

    @abc.abstractmethod
    def density(self, incident: Vec, normal: Vec, out: Vec) -> Scalar:
        """Probability per steradian with which `sample` draws `out`; zero below the surface."""

    @abc.abstractmethod
    def largest_view_factor(self, half_angle: float) -> float:
        """A bound on the view factor over all directions, for the plan; infinite if there is none."""


class AbstractMirror(AbstractLaw):
    """A law whose lobe about the mirror direction may be narrower than the rays of a footprint are apart.

    Its first return is integrated over beam, lobe and aperture (`jaxlidar.trace.mirror`), in place of
    `view_factor`.
    """

    roughness: eqx.AbstractVar[Float[Array, ""]]


@final
class Lambertian(AbstractLaw):
    """Equal radiance into every direction of the lit side: intensity by the cosine law."""

    def view_factor(self, incident: Vec, normal: Vec, view: Vec, half_angle: Scalar) -> Scalar:
        return jnp.maximum(dot(normal, view), 0.0)

    def albedo(self, incident: Vec, normal: Vec) -> Scalar:
        return jnp.ones_like(incident[0])

    def sample(self, incident: Vec, normal: Vec, u: Scalar, v: Scalar) -> Vec:
        return about(normal, u, v)

    def density(self, incident: Vec, normal: Vec, out: Vec) -> Scalar:
        return jnp.maximum(dot(normal, out), 0.0) / np.pi

    def largest_view_factor(self, half_angle: float) -> float:
        return 1.0


@final
class EqualAngle(AbstractLaw):
    """Polar angle from the normal uniform in [0, 90] degrees: the paper's "every angle equally likely"."""

    def view_factor(self, incident: Vec, normal: Vec, view: Vec, half_angle: Scalar) -> Scalar:
        sine = jnp.sqrt(_square_of_sine(normal, view) + half_angle**2 / 4)
        return jnp.where(dot(normal, view) > 0, 1.0 / (np.pi * sine), 0.0)

    def albedo(self, incident: Vec, normal: Vec) -> Scalar:
        return jnp.ones_like(incident[0])

    def sample(self, incident: Vec, normal: Vec, u: Scalar, v: Scalar) -> Vec:
        return from_frame(normal, polar(jnp.cos(0.5 * np.pi * u), 2 * np.pi * v))

    def density(self, incident: Vec, normal: Vec, out: Vec) -> Scalar:
        # A floor on the squared sine keeps the derivative finite at the normal.
        sine = jnp.sqrt(jnp.maximum(_square_of_sine(normal, out), 1e-6))
        return jnp.where(dot(normal, out) > 0, 1.0 / (np.pi**2 * sine), 0.0)

    def largest_view_factor(self, half_angle: float) -> float:
        return 2.0 / (np.pi * half_angle)


def _square_of_sine(normal: Vec, out: Vec) -> Scalar:
    """Of the angle between two unit vectors: |n x v|^2, without cancellation near the normal."""
    across = cross(normal, out)
    return dot(across, across)


@final
class Specular(AbstractMirror):
    """A mirror whose facets are tilted a little: a Gaussian lobe about the mirror direction.

    **Arguments:**

    - `roughness`: standard deviation of the reflected direction about the mirror direction along
      each of two perpendicular axes, rad, in [0, 0.5]; 0 (default) is a perfect mirror.

    The first return is exact for any roughness (see `jaxlidar.trace.mirror`). Paths of two or more
    scatterings whose last one is the mirror reach the receiver only within its lobe: they are
    unbiased, but so rare below a roughness of about 0.01 rad that few photons will show one. The
    derivative of such paths with respect to the mirror's slope leaves out the turning of the lobe.

    **Raises:** ValueError for a roughness outside its range.
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

    def albedo(self, incident: Vec, normal: Vec) -> Scalar:
        return jnp.ones_like(incident[0])

    def sample(self, incident: Vec, normal: Vec, u: Scalar, v: Scalar) -> Vec:
        tilt = self.roughness * jnp.sqrt(-2.0 * jnp.log1p(-u))
        out = from_frame(_mirror(incident, normal), polar(jnp.cos(jnp.minimum(tilt, 1.5)), 2 * np.pi * v))
        # What the lobe would send through the surface is turned back into the lit side.
        below = jnp.minimum(dot(out, normal), 0.0)
        return vec(o - 2.0 * below * n for o, n in zip(out, normal))

    def density(self, incident: Vec, normal: Vec, out: Vec) -> Scalar:
        # Taken as constant: the lobe's own derivative grows without bound as it becomes narrow.
        return jnp.ones_like(out[0])

    def largest_view_factor(self, half_angle: float) -> float:
        return np.inf


def _mirror(incident: Vec, normal: Vec) -> Vec:
    along = 2.0 * dot(incident, normal)
    return vec(i - along * n for i, n in zip(incident, normal))
