"""Distributions of leaf inclination, and the projection function G of a canopy that has them."""

from typing import ClassVar, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._checks import array, as_scalar, check_choice, check_range, concrete
from jaxlidar._ranges import Range, check_ranges

ANGLE_CELLS = 90
ANGLE_NODES = 129


@final
class LeafAngles(eqx.Module):
    """A leaf angle distribution, uniform in azimuth, as probabilities of cells of one degree of inclination.

    Usually made by `LeafAngles.named` or `LeafAngles.beta`. The extinction coefficient of a canopy of leaf
    area density LAD is G(direction) * LAD. The spherical distribution needs no table (G = 1/2): there
    `leaf_angles` of a `VoxelMap` is None.

    **Arguments:**

    - `probability`: (90,) probability that the inclination lies within 0..1, 1..2, ... 89..90 degrees, not
      negative and not all zero; need not sum to one, for it is normalised where it is used.

    **Raises:** ValueError for another shape, for negative or non-finite values, and where all are zero;
    TypeError for what is no number.

    **Example:** G of a canopy of mostly horizontal leaves, seen from above.

    >>> import jaxlidar as jl
    >>> angles = jl.LeafAngles.named("planophile")
    >>> G, _ = angles.tables()
    >>> print(f"{G[-1]:.3f}")
    0.849
    """

    probability: Float[Array, "90"] = eqx.field(converter=array("probability"))

    ranges: ClassVar = {"probability": Range(0.0)}

    def __check_init__(self):
        if self.probability.shape != (ANGLE_CELLS,):
            raise ValueError(
                f"probability has shape {self.probability.shape}; "
                f"admissible is ({ANGLE_CELLS},), one per degree"
            )
        check_ranges(self)
        known = concrete(self.probability)
        if known is not None:
            check_range("sum of probability", known.sum(), 0.0, low_open=True)

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
        m, s = as_scalar(mean, "mean") / 90.0, as_scalar(std, "std") / 90.0
        spread = m * (1 - m) / s**2 - 1
        check_range("mean (90 - mean) / std^2", spread + 1, 1.0, low_open=True)
        x = jnp.asarray((np.arange(ANGLE_CELLS) + 0.5) / ANGLE_CELLS)
        log_density = (m * spread - 1) * jnp.log(x) + ((1 - m) * spread - 1) * jnp.log1p(-x)
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
        c, s = mu * np.cos(theta), np.sqrt(1 - mu**2) * np.sin(theta)
        # Mean over azimuth of |c + s cos(phi)| (Warren Wilson 1960).
        turn = np.arccos(np.clip(-c / np.where(s > 0, s, 1.0), -1.0, 1.0))
        oblique = (c * (2 * turn - np.pi) + 2 * s * np.sin(turn)) / np.pi
        first = np.where(c >= s, c, oblique)
        p = self.normalised()
        return jnp.asarray(first, p.dtype) @ p, jnp.asarray(c**2 + s**2 / 2, p.dtype) @ p
