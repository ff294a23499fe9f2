"""Laws of reflection: how a surface distributes the light that it reflects over directions.

Everything is per unit reflectance, which the tracer does not need. A law has an *albedo*, the reflected
fraction a(w) of the flux that arrives along w; a *density* p(w, v), the probability per steradian that
reflected light leaves along v, which `sample` draws from; and an *intensity factor*

    f(w, v) = pi a(w) p(w, v), averaged over the receiver's aperture.

This is pi times the radiant intensity towards the view per incident flux, or pi times BRDF times the cosine
of the view angle: a surface of reflectance rho that fills the footprint has the apparent reflectance rho f.
With theta the angle between view and surface normal, alpha the half-angle of the aperture as seen from the
surface, delta the angle between view and mirror direction and sigma the roughness,

    law             density p                                     intensity factor f
    Lambertian      cos(theta) / pi                               cos(theta)
    equal-angle     1 / (pi^2 sin(theta))                         1 / (pi sqrt(sin^2(theta) + alpha^2 / 4))
    specular        exp(-delta^2/(2 sigma^2)) / (2 pi sigma^2)    exp(-delta^2/(2 S)) / (2 S),
                                                                  S = sigma^2 + alpha^2 / 4

The equal-angle law (the paper's "every angle equally likely") has a polar angle that is uniform in [0, 90]
degrees. Its density is singular at the normal; averaged over the aperture, a disc of solid angle pi alpha^2,
it is 2/(pi^2 alpha) there, and the form above is exact at the normal and far from it. The specular lobe is
Gaussian in the small angle delta; alpha^2 / 4 is the variance of a uniform disc of radius alpha along an
axis.

A law of your own is one class in one file: derive it from `AbstractLaw`, give its five methods, and pass it
as `law=`. `examples/minnaert.py` shows Minnaert's law.
"""

import abc
from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._fields.checks import as_scalar
from jaxlidar._fields.ranges import Range, check_ranges, quantity
from jaxlidar._vectors import Scalar, Vec, cosine_direction, cross, dot, from_frame, polar, vec


class AbstractLaw(eqx.Module):
    """A law of reflection: how a surface distributes the light that it reflects over directions.

    A law of your own is one class in one file: derive it from this, give its five methods, and pass it as
    `law=` of a `Ground` or a `Plate`. `examples/minnaert.py` shows Minnaert's law.

    Directions are unit vectors, given as (x, y, z) tuples of arrays of one shape. `incident` is the direction
    in which the light travels, `normal` is the normal on the lit side, `out` and `view` lead away from the
    surface. Methods are pure, written with `jax.numpy` (see `jaxlidar.extend`), and differentiable in
    directions and fields.

    A law is consistent if, for an aperture that shrinks to nothing,

        intensity_factor = pi * albedo * density,

    and light that `sample` draws has that density. It is reciprocal if the BRDF, proportional to
    intensity_factor / |cosine of out|, stays the same when incident and out are exchanged.

    **Example:** straight back from a horizontal surface.

    >>> import jaxlidar as jl
    >>> import jax.numpy as jnp
    >>> from jaxlidar.extend import vec
    >>> down, up = vec(jnp.array([0.0, 0.0, -1.0])), vec(jnp.array([0.0, 0.0, 1.0]))
    >>> intensity_factor = jl.Lambertian().intensity_factor(down, up, up, jnp.array(1e-4))
    >>> print(f"{intensity_factor:.1f}, density {jl.Lambertian().density(down, up, up):.4f} per sr")
    1.0, density 0.3183 per sr
    """

    @abc.abstractmethod
    def intensity_factor(self, incident: Vec, normal: Vec, view: Vec, half_angle: Scalar) -> Scalar:
        """Pi times BRDF times the cosine of the view angle, per unit reflectance, averaged over the aperture.

        This is pi times the radiant intensity towards `view` per incident flux. The apparent reflectance of a
        surface is its reflectance times this.

        **Arguments:**

        - `incident`, `normal`, `view`: unit vectors, as above.
        - `half_angle`: half-angle of the aperture as seen from the surface, rad. Laws without a singularity
          ignore it.

        **Returns:** an array shaped as the components of `incident`.
        """

    @abc.abstractmethod
    def albedo(self, incident: Vec, normal: Vec) -> Scalar:
        """Directional-hemispherical reflectance per unit reflectance, in [0, 1]; one for most laws.

        This is the fraction of the incident light that is reflected at all.

        **Arguments:**

        - `incident`, `normal`: unit vectors, as above.

        **Returns:** an array shaped as the components of `incident`.
        """

    @abc.abstractmethod
    def sample(self, incident: Vec, normal: Vec, u: Scalar, v: Scalar) -> Vec:
        """Draw a direction of reflection.

        **Arguments:**

        - `incident`, `normal`: unit vectors, as above.
        - `u`, `v`: numbers that are uniform in (0, 1).

        **Returns:** a unit vector that leads away from the surface.
        """

    @abc.abstractmethod
    def density(self, incident: Vec, normal: Vec, out: Vec) -> Scalar:
        """Probability per steradian with which `sample` draws `out`; zero below the surface.

        **Arguments:**

        - `incident`, `normal`, `out`: unit vectors, as above.

        **Returns:** an array shaped as the components of `incident`.
        """

    @abc.abstractmethod
    def largest_intensity_factor(self, half_angle: float) -> float:
        """An upper bound on the intensity factor over all directions, for the plan.

        **Arguments:**

        - `half_angle`: half-angle of the aperture as seen from the reference plane, rad.

        **Returns:** a number; infinite where there is no bound.
        """


class AbstractMirror(AbstractLaw):
    """A law of reflection with a lobe about the mirror direction that may be very narrow.

    The lobe may be narrower than the angle between neighbouring rays of a footprint. The first return is
    therefore not computed from `intensity_factor`: it is integrated over beam, lobe and aperture, with a
    Gaussian lobe of the standard deviation `roughness` (`trace.first.mirror_return`).

    A mirror of your own is one class in one file: derive it from this, and give the five methods of
    `AbstractLaw` and the field

    - `roughness`: standard deviation of the reflected direction about the mirror direction along each of two
      perpendicular axes, rad.

    **Example:** the intensity factor of a perfect mirror has no bound.

    >>> import jaxlidar as jl
    >>> mirror = jl.Specular(roughness=0.0)
    >>> from jaxlidar.optics.laws import AbstractMirror
    >>> isinstance(mirror, AbstractMirror), mirror.largest_intensity_factor(1e-4)
    (True, inf)
    """

    roughness: eqx.AbstractVar[Float[Array, ""]]


@final
class Lambertian(AbstractLaw):
    """Lambertian reflection: equal radiance in all directions of the lit side (intensity by the cosine law).

    **Example:** the apparent reflectance of ground, per unit reflectance, seen at 60 degrees from its normal.

    >>> import jaxlidar as jl
    >>> import jax.numpy as jnp
    >>> from jaxlidar.extend import polar
    >>> up, view = (polar(jnp.cos(jnp.deg2rad(a)), jnp.array(0.0)) for a in (0.0, 60.0))
    >>> down = tuple(-x for x in up)
    >>> print(f"{jl.Lambertian().intensity_factor(down, up, view, jnp.array(1e-4)):.3f}")
    0.500
    """

    def intensity_factor(self, incident: Vec, normal: Vec, view: Vec, half_angle: Scalar) -> Scalar:
        return jnp.maximum(dot(normal, view), 0.0)

    def albedo(self, incident: Vec, normal: Vec) -> Scalar:
        return jnp.ones_like(incident[0])

    def sample(self, incident: Vec, normal: Vec, u: Scalar, v: Scalar) -> Vec:
        return cosine_direction(normal, u, v)

    def density(self, incident: Vec, normal: Vec, out: Vec) -> Scalar:
        return jnp.maximum(dot(normal, out), 0.0) / np.pi

    def largest_intensity_factor(self, half_angle: float) -> float:
        return 1.0


@final
class EqualAngle(AbstractLaw):
    """Reflection with a polar angle uniform in [0, 90] degrees: the paper's "every angle equally likely".

    The angle is measured from the surface normal. The density 1/(pi^2 sin theta) is singular there; the
    intensity factor is its average over the receiver's aperture.

    **Example:** the apparent reflectance of ground, per unit reflectance, seen at 60 degrees from its normal.

    >>> import jaxlidar as jl
    >>> import jax.numpy as jnp
    >>> from jaxlidar.extend import polar
    >>> up, view = (polar(jnp.cos(jnp.deg2rad(a)), jnp.array(0.0)) for a in (0.0, 60.0))
    >>> down = tuple(-x for x in up)
    >>> print(f"{jl.EqualAngle().intensity_factor(down, up, view, jnp.array(1e-4)):.3f}")
    0.368
    """

    def intensity_factor(self, incident: Vec, normal: Vec, view: Vec, half_angle: Scalar) -> Scalar:
        sine = jnp.sqrt(_square_of_sine(normal, view) + half_angle**2 / 4)
        return jnp.where(dot(normal, view) > 0, 1.0 / (np.pi * sine), 0.0)

    def albedo(self, incident: Vec, normal: Vec) -> Scalar:
        return jnp.ones_like(incident[0])

    def sample(self, incident: Vec, normal: Vec, u: Scalar, v: Scalar) -> Vec:
        return from_frame(normal, polar(jnp.cos(0.5 * np.pi * u), 2 * np.pi * v))

    def density(self, incident: Vec, normal: Vec, out: Vec) -> Scalar:
        # The floor on the squared sine keeps the derivative finite at the normal.
        sine = jnp.sqrt(jnp.maximum(_square_of_sine(normal, out), 1e-6))
        return jnp.where(dot(normal, out) > 0, 1.0 / (np.pi**2 * sine), 0.0)

    def largest_intensity_factor(self, half_angle: float) -> float:
        return 2.0 / (np.pi * half_angle)


def _square_of_sine(normal: Vec, out: Vec) -> Scalar:
    """Squared sine of the angle between two unit vectors: |n x v|^2, without cancellation near the normal."""
    product = cross(normal, out)
    return dot(product, product)


@final
class Specular(AbstractMirror):
    """Specular reflection: a mirror of slightly tilted facets, with a Gaussian lobe about its direction.

    The first return is exact for any roughness (see `trace.first.mirror_return`). Paths of two or more
    scatterings that end at the mirror reach the receiver only within its lobe. They are unbiased, but so rare
    below a roughness of about 0.01 rad that few photons show one. The derivative of such paths with respect
    to the mirror's slope leaves out the rotation of the lobe.

    **Arguments:**

    - `roughness`: standard deviation of the reflected direction about the mirror direction along each of two
      perpendicular axes, rad, in [0, 0.5]; 0 is a perfect mirror. Default 0.

    **Raises:** ValueError for a roughness outside its range; TypeError for arguments that are no numbers.

    **Example:** straight back, a lobe of 0.1 rad is 1 / (2 * 0.1^2) times as bright as a Lambertian surface.

    >>> import jaxlidar as jl
    >>> import jax.numpy as jnp
    >>> from jaxlidar.extend import vec
    >>> down, up = vec(jnp.array([0.0, 0.0, -1.0])), vec(jnp.array([0.0, 0.0, 1.0]))
    >>> print(f"{jl.Specular(roughness=0.1).intensity_factor(down, up, up, jnp.array(1e-4)):.1f}")
    50.0
    """

    roughness: Float[Array, ""] = quantity(
        unit="rad", range=Range(0.0, 0.5), converter=as_scalar, default=0.0
    )

    def __check_init__(self):
        check_ranges(self)

    def intensity_factor(self, incident: Vec, normal: Vec, view: Vec, half_angle: Scalar) -> Scalar:
        # The receiver's disc blurs the lobe.
        variance = self.roughness**2 + half_angle**2 / 4
        # delta^2, as the squared distance between two unit vectors.
        cosine = jnp.clip(dot(_mirror_direction(incident, normal), view), -1.0, 1.0)
        square = 2.0 * (1.0 - cosine)
        return jnp.exp(-square / (2 * variance)) / (2 * variance)

    def albedo(self, incident: Vec, normal: Vec) -> Scalar:
        return jnp.ones_like(incident[0])

    def sample(self, incident: Vec, normal: Vec, u: Scalar, v: Scalar) -> Vec:
        # The distance of two independent normal deviates from zero has Rayleigh's distribution; inverted.
        tilt = self.roughness * jnp.sqrt(-2.0 * jnp.log1p(-u))
        lobe = polar(jnp.cos(jnp.minimum(tilt, 1.5)), 2 * np.pi * v)
        out = from_frame(_mirror_direction(incident, normal), lobe)
        # Directions of the lobe that lead through the surface are reflected back into the lit side.
        below = jnp.minimum(dot(out, normal), 0.0)
        return vec(o - 2.0 * below * n for o, n in zip(out, normal))

    def density(self, incident: Vec, normal: Vec, out: Vec) -> Scalar:
        # Not the density of the lobe: the tracer uses relative changes of densities alone, and that of a lobe
        # grows without bound as it becomes narrow.
        return jnp.ones_like(out[0])

    def largest_intensity_factor(self, half_angle: float) -> float:
        return np.inf


def _mirror_direction(incident: Vec, normal: Vec) -> Vec:
    """The mirror direction w - 2 (w . n) n of light that travels along w."""
    projection = 2.0 * dot(incident, normal)
    return vec(i - projection * n for i, n in zip(incident, normal))
