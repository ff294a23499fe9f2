"""Shapes of surfaces: where rays meet them."""

import abc
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._checks import known_array
from jaxlidar._vectors import FAR, Scalar, Vec, dot, vec

# Cosine between a direction and a normal, below which they never meet.
_PARALLEL = 1e-9


class AbstractShape(eqx.Module):
    """Where a surface lies. Its upper side is the one that its normal points to.

    Points and directions are (x, y, z) tuples of arrays of one shape, in m; directions are unit vectors.
    """

    @property
    @abc.abstractmethod
    def lights_itself(self) -> bool:
        """Whether light that leaves it can meet it again; `distance` then passes over where it starts."""

    @abc.abstractmethod
    def moved(self, by: Float[Array, "3"]) -> "AbstractShape":
        """The same shape, displaced by `by` (m)."""

    @abc.abstractmethod
    def distance(self, x: Vec, w: Vec) -> Scalar:
        """How far (m) from `x` along `w` it is first met; FAR, 1e30, where it is behind or missed."""

    @abc.abstractmethod
    def tangent(self, x: Vec) -> tuple[Vec, Scalar]:
        """Upper unit normal at the point `x` of it, and the offset of its plane, normal . point."""

    @abc.abstractmethod
    def crossing(
        self, points: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Signed distances at which straight lines cross it, and cosines between direction and normal there.

        In double precision, for plans, which bound all lengths of paths by them: a shape that is curved or
        ends gives the least and the largest that any line near by can have, at different elements.
        """


@final
class Plane(AbstractShape):
    """An infinite plane through the point `foot`, its upper unit normal `upward`."""

    upward: Float[Array, "3"]
    foot: Float[Array, "3"]

    @staticmethod
    def of(height: Float[Array, ""], slope: Float[Array, ""], aspect: Float[Array, ""]) -> "Plane":
        """Through (0, 0, height), its normal tilted by `slope` towards the azimuth `aspect` (degrees)."""
        s, a = jnp.deg2rad(slope), jnp.deg2rad(aspect)
        upward = jnp.stack([jnp.sin(s) * jnp.sin(a), jnp.sin(s) * jnp.cos(a), jnp.cos(s)])
        zero = jnp.zeros_like(height)
        return Plane(upward, jnp.stack([zero, zero, height]))

    @property
    def lights_itself(self) -> bool:
        return False

    def moved(self, by: Float[Array, "3"]) -> "Plane":
        return Plane(self.upward, self.foot + by)

    def distance(self, x: Vec, w: Vec) -> Scalar:
        normal, offset = self.tangent(x)
        towards = dot(normal, w)
        s = _crossing(offset - dot(normal, x), towards)
        return jnp.where((jnp.abs(towards) >= _PARALLEL) & (s > 0), jnp.minimum(s, FAR), FAR)

    def tangent(self, x: Vec) -> tuple[Vec, Scalar]:
        return vec(self.upward), jnp.sum(self.upward * self.foot)

    def crossing(
        self, points: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        normal, foot = known_array(self.upward), known_array(self.foot)
        towards = directions @ normal
        return _crossing(normal @ foot - points @ normal, towards, np), towards


def _crossing(height: Any, towards: Any, xp: Any = jnp) -> Any:
    """Signed distance to a plane that lies `height` further along its normal; huge where parallel."""
    return height / xp.where(xp.abs(towards) < _PARALLEL, _PARALLEL, towards)
