"""Distributions of leaf inclination, and G of a canopy that has them."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._checks import as_array, as_scalar, check_choice, check_range

ANGLE_CELLS = 90
ANGLE_NODES = 129


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
