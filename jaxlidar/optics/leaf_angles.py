"""Distributions of leaf inclination, and the projection function G of a canopy that has them.

Leaf normals have an inclination theta from the vertical, with the distribution function F(theta) on [0, 90]
degrees, and an azimuth that is uniform. The named distributions are de Wit's (1965), in radians:

    spherical       1 - cos(theta)
    planophile      2/pi (theta + sin(2 theta)/2)          mostly horizontal leaves
    erectophile     2/pi (theta - sin(2 theta)/2)          mostly vertical ones
    plagiophile     2/pi (theta - sin(4 theta)/4)          mostly at 45 degrees
    extremophile    2/pi (theta + sin(4 theta)/4)          the least at 45 degrees
    uniform         2/pi theta

or a Beta distribution of theta/90 degrees (Goel and Strebel 1984). The projection function of a direction w
with the zenith cosine mu is the mean over leaf normals n of the projected leaf area,

    G(mu) = mean of |w . n| = mean over theta of H(mu, theta),
    H = c                                                           where c >= s,
    H = [c (2 psi - pi) + 2 s sin(psi)]/pi, psi = arccos(-c/s)      elsewhere,

with c = mu cos(theta) and s = sqrt(1 - mu^2) sin(theta) (Warren Wilson 1960). The extinction coefficient is G
times the leaf area density; for spherical leaves G is 1/2 in every direction. The mean of |w . n|^2, which is
c^2 + s^2/2 averaged over theta, divided by G is the intensity factor of the leaves' backscatter.
"""

from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._fields.checks import as_array, as_scalar, check_choice, check_range, concrete
from jaxlidar._fields.ranges import NOT_NEGATIVE, check_ranges, quantity
from jaxlidar._jax.products import matmul

# Cells of inclination, one degree wide; nodes of |cos zenith| of the tables of G.
ANGLE_CELLS = 90
ANGLE_NODES = 129


@final
class LeafAngles(eqx.Module):
    """A leaf angle distribution, uniform in azimuth, as probabilities of cells of one degree of inclination.

    `LeafAngles.named` and `LeafAngles.beta` make the usual ones. The extinction coefficient of a canopy of
    leaf area density LAD is G(direction) * LAD. The spherical distribution needs no table (G = 1/2): there
    `leaf_angles` of a `VoxelMap` is None.

    **Arguments:**

    - `probability`: (90,) probability that the inclination lies within 0..1, 1..2, ... 89..90 degrees, not
      negative and not all zero; need not sum to one, for it is normalised where it is used.

    **Raises:** ValueError for another shape, for negative or non-finite values, and where all are zero;
    TypeError for arguments that are no numbers.

    **Example:** G of a canopy of mostly horizontal leaves, seen from above.

    >>> import jaxlidar as jl
    >>> angles = jl.LeafAngles.named("planophile")
    >>> G, _ = angles.tables()
    >>> print(f"{G[-1]:.3f}")
    0.849
    """

    probability: Float[Array, "90"] = quantity(range=NOT_NEGATIVE, converter=as_array)

    def __check_init__(self):
        if self.probability.shape != (ANGLE_CELLS,):
            raise ValueError(
                f"probability has shape {self.probability.shape}; "
                f"admissible is ({ANGLE_CELLS},), one per degree"
            )
        check_ranges(self)
        probability = concrete(self.probability)
        if probability is not None:
            check_range("sum of probability", probability.sum(), 0.0, low_open=True)

    @staticmethod
    def named(name: str) -> "LeafAngles":
        """A leaf angle distribution by its name.

        **Arguments:**

        - `name`: "planophile", "erectophile", "plagiophile", "extremophile", "uniform" or "spherical".

        **Returns:** a `LeafAngles`.

        **Raises:** ValueError for an unknown name.

        **Source:** de Wit (1965).
        """
        check_choice(
            "leaf_angles",
            name,
            ("spherical", "planophile", "erectophile", "plagiophile", "extremophile", "uniform"),
        )
        theta = np.linspace(0.0, np.pi / 2, ANGLE_CELLS + 1)
        cumulative = {
            "spherical": -np.cos(theta),
            "planophile": 2 / np.pi * (theta + np.sin(2 * theta) / 2),
            "erectophile": 2 / np.pi * (theta - np.sin(2 * theta) / 2),
            "plagiophile": 2 / np.pi * (theta - np.sin(4 * theta) / 4),
            "extremophile": 2 / np.pi * (theta + np.sin(4 * theta) / 4),
            "uniform": 2 / np.pi * theta,
        }[name]
        return LeafAngles(np.diff(cumulative))

    @staticmethod
    def beta(mean: float | Array, std: float | Array) -> "LeafAngles":
        """A Beta distribution of leaf inclination, differentiable in its mean and standard deviation.

        **Arguments:**

        - `mean`: mean inclination in degrees, in (0, 90).
        - `std`: standard deviation of the inclination in degrees, in (0, 45).

        **Returns:** a `LeafAngles`.

        **Raises:** ValueError for values outside their ranges, and where no Beta distribution has these
        moments.

        **Source:** Goel and Strebel (1984).
        """
        check_range("mean", mean, 0.0, 90.0, low_open=True, high_open=True)
        check_range("std", std, 0.0, 45.0, low_open=True, high_open=True)
        # The parameters a and b of a Beta distribution of mean m and standard deviation s have the sum
        # m (1 - m)/s^2 - 1, and a = m (a + b).
        m, s = as_scalar(mean, "mean") / 90.0, as_scalar(std, "std") / 90.0
        a_plus_b = m * (1 - m) / s**2 - 1
        check_range("mean (90 - mean) / std^2", a_plus_b + 1, 1.0, low_open=True)
        x = jnp.asarray((np.arange(ANGLE_CELLS) + 0.5) / ANGLE_CELLS)
        log_density = (m * a_plus_b - 1) * jnp.log(x) + ((1 - m) * a_plus_b - 1) * jnp.log1p(-x)
        # The largest is subtracted against overflow; the constant cancels.
        density = jnp.exp(log_density - jnp.max(log_density))
        return LeafAngles(density / jnp.sum(density))

    def normalised(self) -> Float[Array, "90"]:
        """Probabilities of the cells, (90,), scaled to sum to one."""
        return self.probability / jnp.sum(self.probability)

    def tables(self) -> tuple[Float[Array, "129"], Float[Array, "129"]]:
        """Projection function G and the mean squared cosine, by direction.

        **Returns:** the means over leaf normals of |direction . normal| (this is G) and of its square, (129,)
        each, at equal steps of |cos zenith| from 0 (horizontal) to 1 (vertical).

        **Source:** Warren Wilson (1960).
        """
        mu = np.linspace(0.0, 1.0, ANGLE_NODES)[:, None]
        theta = np.deg2rad(np.arange(ANGLE_CELLS) + 0.5)[None, :]
        # w . n = c + s cos(phi), with phi the azimuth between direction and normal.
        c, s = mu * np.cos(theta), np.sqrt(1 - mu**2) * np.sin(theta)
        psi = np.arccos(np.clip(-c / np.where(s > 0, s, 1.0), -1.0, 1.0))
        oblique = (c * (2 * psi - np.pi) + 2 * s * np.sin(psi)) / np.pi
        mean_cosine = np.where(c >= s, c, oblique)
        mean_square = c**2 + s**2 / 2
        p = self.normalised()
        return matmul(jnp.asarray(mean_cosine, p.dtype), p), matmul(jnp.asarray(mean_square, p.dtype), p)
