"""A new scattering law, Minnaert's, in one class. Run it as `python examples/minnaert.py`.

M. Minnaert (1941), Astrophys. J. 93, 403, described the moon's radiance by a power of the cosines of
incidence and of view. With mu0 the cosine of incidence and mu that of the outgoing direction,

    BRDF = R (k + 1) / (2 pi) (mu0 mu)^(k - 1),
    albedo(mu0) = R mu0^(k - 1),    density of directions = (k + 1) / (2 pi) mu^k per sr.

A surface that darkens towards the limb has k above one; k = 1 is Lambertian. Directions are sampled by the
inverse of their distribution, mu = (1 - u)^(1 / (k + 1)). Cosines of at least 1e-6 keep derivatives of the
powers finite at grazing angles.
"""

from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxlidar as jl
from jaxlidar.extend import Scalar, Vec, as_scalar, check_range, dot, from_frame, polar


@final
class Minnaert(jl.AbstractLaw):
    """Bidirectional reflectance R (k + 1) / (2 pi) (cos(incidence) cos(view))^(k - 1).

    **Arguments:** `k`: limb darkening, in [1, 10]; 1 (default) is Lambertian.
    """

    k: Float[Array, ""] = eqx.field(converter=as_scalar, default=1.0)

    def __check_init__(self):
        check_range("k", self.k, 1.0, 10.0)

    def intensity_factor(self, incident: Vec, normal: Vec, view: Vec, half_angle: Scalar) -> Scalar:
        return np.pi * self.albedo(incident, normal) * self.density(incident, normal, view)

    def albedo(self, incident: Vec, normal: Vec) -> Scalar:
        return jnp.maximum(-dot(incident, normal), 1e-6) ** (self.k - 1.0)

    def sample(self, incident: Vec, normal: Vec, u: Scalar, v: Scalar) -> Vec:
        return from_frame(normal, polar((1.0 - u) ** (1.0 / (self.k + 1.0)), 2 * np.pi * v))

    def density(self, incident: Vec, normal: Vec, out: Vec) -> Scalar:
        cosine = dot(normal, out)
        power = jnp.maximum(cosine, 1e-6) ** self.k
        return jnp.where(cosine > 0, (self.k + 1.0) / (2 * np.pi) * power, 0.0)

    def largest_intensity_factor(self, half_angle: float) -> float:
        return 0.5 * (float(self.k) + 1.0)


def main() -> None:
    """Print the returns of ground at several slopes, Lambertian and with limb darkening."""
    for slope in (0.0, 20.0, 40.0):
        sums = []
        for law in (jl.Lambertian(), Minnaert(k=1.5)):
            scene = jl.Scene(ground=jl.Ground(reflectance=0.3, slope=slope, law=law))
            wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
            sums.append(float(wave.reflectance.sum()))
        print(f"slope {slope:2.0f} degrees: Lambertian {sums[0]:.3f}, Minnaert {sums[1]:.3f}")


if __name__ == "__main__":
    main()
