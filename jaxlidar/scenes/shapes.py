"""Shapes of surfaces, and where rays meet them."""

import abc
from collections.abc import Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._checks import as_scalar, concrete_array
from jaxlidar._vectors import FAR, Scalar, Vec, dot, vec

# Rays whose direction has a cosine with the normal below this never meet the plane.
_PARALLEL = 1e-9


class AbstractShape(eqx.Module):
    """The shape and position of a surface in space.

    Derive your own shape from this class and define its five methods. The upper side of a surface is the
    side to which its normal points. Points (in m) and directions (unit vectors) are (x, y, z) tuples of
    arrays of one shape.

    **Example:** the shape of a level ground, met 8 m below a point.

    >>> import jaxlidar as jl
    >>> import jax.numpy as jnp
    >>> from jaxlidar.extend import vec
    >>> shape = jl.Ground(height=2.0).shape
    >>> isinstance(shape, jl.AbstractShape)
    True
    >>> float(shape.distance(vec(jnp.array([0.0, 0.0, 10.0])), vec(jnp.array([0.0, 0.0, -1.0]))))
    8.0
    """

    @property
    @abc.abstractmethod
    def lights_itself(self) -> bool:
        """Whether light that leaves the surface can meet it again.

        If True, `distance` must leave out the point where the light starts.
        """

    @abc.abstractmethod
    def moved(self, by: Float[Array, "3"]) -> "AbstractShape":
        """The same shape, moved.

        **Arguments:**

        - `by`: (3,) displacement, m.

        **Returns:** an `AbstractShape`.
        """

    @abc.abstractmethod
    def distance(self, x: Vec, w: Vec) -> Scalar:
        """Distance in m from a point to the first intersection along a direction.

        **Arguments:**

        - `x`: points, m.
        - `w`: directions.

        **Returns:** distances in m; 1e30 where the surface is behind the point or is missed.
        """

    @abc.abstractmethod
    def tangent(self, x: Vec) -> tuple[Vec, Scalar]:
        """The tangent plane at a point of the surface.

        **Arguments:**

        - `x`: points on the surface, m.

        **Returns:** the upper unit normal, and the offset of the plane in m, which is normal . point.
        """

    @abc.abstractmethod
    def crossing(
        self, points: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Signed distances at which straight lines cross the surface, and the cosines of incidence there.

        Used by plans to bound the lengths of all paths, in double precision. A shape that is curved or
        bounded gives the smallest and the largest values that any line nearby can have, at different
        elements.

        **Arguments:**

        - `points`: (n, 3) points on the lines, m.
        - `directions`: (n, 3) directions of the lines.

        **Returns:** (n,) distances in m, and (n,) cosines between direction and normal.
        """


@jax.jit
def _tilted(
    slope: Float[Array, ""], aspect: Float[Array, ""], place: Float[Array, "2"], height: Float[Array, ""]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Upper unit normal and a point. Compiled, for they are asked for often."""
    s, a = jnp.deg2rad(slope), jnp.deg2rad(aspect)
    upward = jnp.stack([jnp.sin(s) * jnp.sin(a), jnp.sin(s) * jnp.cos(a), jnp.cos(s)])
    return upward, jnp.stack([place[0], place[1], height])


@final
class Plane(AbstractShape):
    """An infinite plane. `Plane.of` makes one of height, slope and aspect.

    **Arguments:**

    - `upward`: (3,) upper unit normal.
    - `foot`: (3,) a point of the plane, m.

    **Example:**

    >>> import jaxlidar as jl
    >>> plane = jl.Plane.of(height=2.0, slope=60.0, aspect=90.0)
    >>> print(f"normal: {float(plane.upward[0]):.3f} east, {float(plane.upward[2]):.3f} up")
    normal: 0.866 east, 0.500 up
    """

    upward: Float[Array, "3"]
    foot: Float[Array, "3"]

    @staticmethod
    def of(
        height: ArrayLike, slope: ArrayLike, aspect: ArrayLike, position: ArrayLike | Sequence = (0.0, 0.0)
    ) -> "Plane":
        """The plane of a given slope and aspect through a point.

        **Arguments:**

        - `height`: height of the point, m.
        - `slope`: angle between the normal and the vertical, degrees.
        - `aspect`: azimuth to which the normal is tilted, degrees clockwise from north (+y). The plane falls
          in this direction.
        - `position`: (2,) horizontal place of the point, m. Default (0, 0).

        **Returns:** a `Plane`.
        """
        height = as_scalar(height, "height")
        place = jnp.asarray(position, height.dtype)
        return Plane(*_tilted(as_scalar(slope, "slope"), as_scalar(aspect, "aspect"), place, height))

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
        normal, foot = concrete_array(self.upward), concrete_array(self.foot)
        towards = directions @ normal
        return _crossing(normal @ foot - points @ normal, towards, np), towards


def _crossing(height: Any, towards: Any, xp: Any = jnp) -> Any:
    """Signed distance to a plane that lies `height` further along its normal; huge where parallel."""
    return height / xp.where(xp.abs(towards) < _PARALLEL, _PARALLEL, towards)
