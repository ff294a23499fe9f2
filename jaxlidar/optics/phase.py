"""Phase functions of volume scattering, in place of the facets of leaves or bark.

The *density* p of a phase function is the probability per steradian that scattered light travels on in a
direction; its integral over the sphere is one. As for laws of reflection, the *intensity factor* is pi p: pi
times the radiant intensity towards the view per unit of scattered flux. With beta the scattering angle (0 is
forward) and g its mean cosine,

    phase function       intensity factor pi p
    isotropic            1 / 4
    Henyey-Greenstein    (1 - g^2) / (4 (1 + g^2 - 2 g cos beta)^(3/2))

(Henyey and Greenstein 1941). The single scattering albedo is the fraction of the collisions that scatter.

A phase function of your own is one class in one file: derive it from `AbstractPhase`, give its albedo and
three methods, and pass it as `leaf=` or `bark=` of a `Canopy`.
"""

import abc
from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._fields.checks import as_array, as_scalar
from jaxlidar._fields.ranges import FRACTION, Range, check_ranges, quantity
from jaxlidar._vectors import Scalar, Vec, dot, from_frame, polar

# Pi times the density 1/(4 pi) of isotropic scattering.
ISOTROPIC_INTENSITY_FACTOR = 0.25


class AbstractPhase(eqx.Module):
    """A phase function with its single scattering albedo: how a volume scatters light.

    A phase function of your own is one class in one file: derive it from this, give its three methods
    (`intensity_factor`, `sample`, `largest_intensity_factor`) and the field below, and pass it as `leaf=` or
    `bark=` of a `Canopy`.

    - `albedo`: single scattering albedo, one number or one per wavelength, in [0, 1].

    All other fields are the same for all wavelengths: they decide the directions of light, which are traced
    once for all wavelengths.

    Directions are unit vectors of travel, given as (x, y, z) tuples of arrays of one shape. Methods are pure,
    written with `jax.numpy` (see `jaxlidar.extend`), and differentiable in directions and fields. A phase
    function is normalised: the integral of intensity_factor / pi over all directions is one.

    **Example:** probability per steradian of isotropic scattering, 1 / (4 pi).

    >>> import jaxlidar as jl
    >>> import jax.numpy as jnp
    >>> from jaxlidar.extend import vec
    >>> down, up = vec(jnp.array([0.0, 0.0, -1.0])), vec(jnp.array([0.0, 0.0, 1.0]))
    >>> print(f"{jl.Isotropic(albedo=0.9).density(down, up):.4f}")
    0.0796
    """

    albedo: eqx.AbstractVar[Float[Array, "..."]]

    @abc.abstractmethod
    def intensity_factor(self, incident: Vec, view: Vec) -> Scalar:
        """Pi times the probability per steradian of scattering from `incident` into `view`.

        **Arguments:**

        - `incident`, `view`: unit vectors of travel.

        **Returns:** an array shaped as the components of `incident`.
        """

    @abc.abstractmethod
    def sample(self, incident: Vec, u: Scalar, v: Scalar) -> Vec:
        """Draw a direction of scattering from this density.

        **Arguments:**

        - `incident`: unit vector of travel.
        - `u`, `v`: numbers that are uniform in (0, 1).

        **Returns:** a unit vector of travel.
        """

    @abc.abstractmethod
    def largest_intensity_factor(self) -> float:
        """An upper bound on the intensity factor over all directions, for the plan.

        **Returns:** a number; infinite where there is no bound.
        """

    def density(self, incident: Vec, out: Vec) -> Scalar:
        """Probability per steradian of scattering from `incident` into `out`.

        **Arguments:**

        - `incident`, `out`: unit vectors of travel.

        **Returns:** an array shaped as the components of `incident`.
        """
        return self.intensity_factor(incident, out) / np.pi


def _check_phase(phase: AbstractPhase) -> None:
    albedo = phase.albedo
    if albedo.ndim > 1 or albedo.size == 0:
        raise ValueError(f"albedo has shape {albedo.shape}; admissible is a number or one per wavelength")
    check_ranges(phase)


@final
class Isotropic(AbstractPhase):
    """Isotropic volume scattering, the same in all directions: often assumed by discrete ordinates codes.

    **Arguments:**

    - `albedo`: single scattering albedo, one number or one per wavelength, in [0, 1].

    **Raises:** ValueError for an albedo outside its range or of more than one dimension; TypeError for
    arguments that are no numbers.

    **Example:** a canopy of isotropic scatterers at two wavelengths.

    >>> import jaxlidar as jl
    >>> import numpy as np
    >>> voxels = jl.VoxelMap.from_lad(np.full((2, 2, 5), 0.5), voxel_size=1.0, origin=(-1.0, -1.0, 2.0))
    >>> canopy = jl.Canopy(voxels, leaf=jl.Isotropic(albedo=[0.1, 0.9]))
    >>> print([f"{a:.1f}" for a in canopy.leaf.albedo])
    ['0.1', '0.9']
    """

    albedo: Float[Array, "..."] = quantity(range=FRACTION, converter=as_array)

    def __check_init__(self):
        _check_phase(self)

    def intensity_factor(self, incident: Vec, view: Vec) -> Scalar:
        return jnp.full_like(incident[0], ISOTROPIC_INTENSITY_FACTOR)

    def sample(self, incident: Vec, u: Scalar, v: Scalar) -> Vec:
        return polar(1.0 - 2.0 * u, 2 * np.pi * v)

    def largest_intensity_factor(self) -> float:
        return ISOTROPIC_INTENSITY_FACTOR


@final
class HenyeyGreenstein(AbstractPhase):
    """Volume scattering by Henyey and Greenstein's phase function: a forward or a backward lobe.

    **Arguments:**

    - `albedo`: single scattering albedo, one number or one per wavelength, in [0, 1].
    - `g`: mean cosine of the scattering angle, in [-0.95, 0.95]; 0 is isotropic, positive values scatter
      forward. Default 0.

    **Raises:** ValueError for values outside their ranges and for an albedo of more than one dimension;
    TypeError for arguments that are no numbers.

    **Source:** Henyey and Greenstein (1941), Astrophys. J. 93, 70.

    **Example:** intensity factors of forward scattering and of backscatter.

    >>> import jaxlidar as jl
    >>> import jax.numpy as jnp
    >>> from jaxlidar.extend import vec
    >>> down, up = vec(jnp.array([0.0, 0.0, -1.0])), vec(jnp.array([0.0, 0.0, 1.0]))
    >>> phase = jl.HenyeyGreenstein(albedo=0.9, g=0.5)
    >>> forward, back = phase.intensity_factor(down, down), phase.intensity_factor(down, up)
    >>> print(f"{forward:.3f} forward, {back:.3f} back")
    1.500 forward, 0.056 back
    """

    albedo: Float[Array, "..."] = quantity(range=FRACTION, converter=as_array)
    g: Float[Array, ""] = quantity(range=Range(-0.95, 0.95), converter=as_scalar, default=0.0)

    def __check_init__(self):
        _check_phase(self)

    def intensity_factor(self, incident: Vec, view: Vec) -> Scalar:
        g = self.g
        cosine = jnp.clip(dot(incident, view), -1.0, 1.0)
        # 1 + g^2 - 2 g cos(beta) without cancellation in a narrow forward lobe.
        square = (1.0 - g) ** 2 + 2.0 * g * (1.0 - cosine)
        return ISOTROPIC_INTENSITY_FACTOR * (1.0 - g * g) / (square * jnp.sqrt(square))

    def sample(self, incident: Vec, u: Scalar, v: Scalar) -> Vec:
        # The inverse of the distribution function is {1 + g^2 - [(1 - g^2)/(1 + g s)]^2}/(2 g), s = 2 u - 1;
        # this is the same without the quotient by g, which may be zero.
        g, s = self.g, 2.0 * u - 1.0
        cosine = (s * (1.0 + g * g) + 0.5 * g * (s * s * (1.0 + g * g) + 3.0 - g * g)) / (1.0 + g * s) ** 2
        return from_frame(incident, polar(jnp.clip(cosine, -1.0, 1.0), 2 * np.pi * v))

    def largest_intensity_factor(self) -> float:
        g = abs(float(self.g))
        return ISOTROPIC_INTENSITY_FACTOR * (1.0 + g) / (1.0 - g) ** 2
