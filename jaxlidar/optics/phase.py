r"""Phase functions: how a volume scatters, in place of the facets of leaves or bark.

The *view factor* of a phase function is pi times its density per steradian: apparent reflectance per unit
single scattering albedo. With beta the angle by which light is turned,

    isotropic            1 / 4
    Henyey-Greenstein    (1 - g^2) / (4 (1 + g^2 - 2 g cos beta)^(3/2))

A phase function of your own is one class in one file: derive it from `AbstractPhase`, give its albedo and
three methods, and pass it as `leaf=` or `bark=` of a `Canopy`.
"""

import abc
from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._checks import as_array, as_scalar, check_range
from jaxlidar._vectors import Scalar, Vec, dot, from_frame, polar

# Of isotropic scattering.
ISOTROPIC_VIEW_FACTOR = 0.25


class AbstractPhase(eqx.Module):
    """How a volume scatters: an albedo, and the three methods that trace and plan need.

    Directions are unit vectors of travel, (x, y, z) tuples of arrays of one shape. Methods are pure, written
    with `jax.numpy` (see `jaxlidar.extend`), and differentiable in directions and fields. A phase function is
    normalised: the integral of view_factor / pi over all directions is one.

    - `albedo`: single scattering albedo, one number or one per wavelength, in [0, 1].

    All other fields are the same for all wavelengths: they decide where light goes, which is traced once.
    """

    albedo: eqx.AbstractVar[Float[Array, "..."]]

    @abc.abstractmethod
    def view_factor(self, incident: Vec, view: Vec) -> Scalar:
        """Pi times the probability per steradian of scattering from `incident` into `view`."""

    @abc.abstractmethod
    def sample(self, incident: Vec, u: Scalar, v: Scalar) -> Vec:
        """A direction drawn with that density, by two numbers that are uniform in (0, 1)."""

    @abc.abstractmethod
    def largest_view_factor(self) -> float:
        """A bound on the view factor over all directions, for the plan; infinite if there is none."""

    def density(self, incident: Vec, out: Vec) -> Scalar:
        """Probability per steradian of scattering from `incident` into `out`."""
        return self.view_factor(incident, out) / np.pi


@final
class Isotropic(AbstractPhase):
    """Volume scattering, equal into all directions: what discrete ordinates often compute.

    **Arguments:**

    - `albedo`: single scattering albedo, one number or one per wavelength, in [0, 1].

    **Raises:** ValueError for an albedo outside its range.
    """

    albedo: Float[Array, "..."] = eqx.field(converter=as_array)

    def __check_init__(self):
        check_range("albedo", self.albedo, 0.0, 1.0)

    def view_factor(self, incident: Vec, view: Vec) -> Scalar:
        return jnp.full_like(incident[0], ISOTROPIC_VIEW_FACTOR)

    def sample(self, incident: Vec, u: Scalar, v: Scalar) -> Vec:
        return polar(1.0 - 2.0 * u, 2 * np.pi * v)

    def largest_view_factor(self) -> float:
        return ISOTROPIC_VIEW_FACTOR


@final
class HenyeyGreenstein(AbstractPhase):
    """Volume scattering with a forward or backward lobe.

    **Arguments:**

    - `albedo`: single scattering albedo, one number or one per wavelength, in [0, 1].
    - `g`: mean cosine of the scattering angle, in [-0.95, 0.95]; 0 (default) is isotropic, positive forward.

    **Raises:** ValueError for values outside their ranges.

    **Source:** Henyey and Greenstein (1941), Astrophys. J. 93, 70.
    """

    albedo: Float[Array, "..."] = eqx.field(converter=as_array)
    g: Float[Array, ""] = eqx.field(converter=as_scalar, default=0.0)

    def __check_init__(self):
        check_range("albedo", self.albedo, 0.0, 1.0)
        check_range("g", self.g, -0.95, 0.95)

    def view_factor(self, incident: Vec, view: Vec) -> Scalar:
        g = self.g
        cosine = jnp.clip(dot(incident, view), -1.0, 1.0)
        # 1 + g^2 - 2 g cos without cancellation for lobes ahead.
        across = (1.0 - g) ** 2 + 2.0 * g * (1.0 - cosine)
        return ISOTROPIC_VIEW_FACTOR * (1.0 - g * g) / (across * jnp.sqrt(across))

    def sample(self, incident: Vec, u: Scalar, v: Scalar) -> Vec:
        # The inverse of the distribution function, as a form without a quotient by g.
        g, s = self.g, 2.0 * u - 1.0
        cosine = (s * (1.0 + g * g) + 0.5 * g * (s * s * (1.0 + g * g) + 3.0 - g * g)) / (1.0 + g * s) ** 2
        return from_frame(incident, polar(jnp.clip(cosine, -1.0, 1.0), 2 * np.pi * v))

    def largest_view_factor(self) -> float:
        g = abs(float(self.g))
        return ISOTROPIC_VIEW_FACTOR * (1.0 + g) / (1.0 - g) ** 2
