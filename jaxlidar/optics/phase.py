"""Phase functions: how a volume scatters."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._checks import as_array, check_range
from jaxlidar._vectors import Scalar, Vec, polar


class Isotropic(eqx.Module):
    """Volume scattering, equal into all directions: what discrete ordinates often compute.

    **Arguments:**

    - `albedo`: single scattering albedo, one number or one per wavelength, in [0, 1].
    """

    albedo: Float[Array, "..."] = eqx.field(converter=as_array)

    def __check_init__(self):
        check_range("albedo", self.albedo, 0.0, 1.0)


def anywhere(u: Scalar, v: Scalar) -> Vec:
    """A direction, all equally likely."""
    return polar(1.0 - 2.0 * u, 2 * np.pi * v)
