"""Shapes of surfaces, and their intersections with rays.

A plane with the upper unit normal n through the point q is met by the ray x + s w at

    s = n . (q - x) / (n . w).

With the slope sigma and the aspect a, the compass direction in which the plane falls,

    n = (sin(sigma) sin(a), sin(sigma) cos(a), cos(sigma)).

`jaxlidar.scenes.height_field` has the shape of terrain.
"""

import abc
from collections.abc import Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._fields.checks import array_namespace, as_array, as_scalar, fixed_array
from jaxlidar._vectors import FAR, Scalar, Vec, add, dot, vec

# Rays whose cosine with the normal is smaller than this are taken as parallel and do not meet the plane.
_PARALLEL = 1e-9


class AbstractShape(eqx.Module):
    """The shape and position of a surface in space.

    Derive your own shape from this class and define its five methods; and `outline`, if the shape has one and
    derivatives are taken with respect to anything that moves it or the beam: without, they leave out that
    rays come to meet the shape or to miss it, and a `jaxlidar.OutlineWarning` says so. The upper side of a
    surface is the side to which its normal points. Points (in m) and directions (unit vectors) are (x, y, z)
    tuples of arrays of one shape.

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
        """True if light that leaves the surface can meet it again.

        `distance` must then leave out the point at which the light starts.
        """

    @abc.abstractmethod
    def moved(self, by: Float[Array, "3"]) -> "AbstractShape":
        """Move the shape.

        **Arguments:**

        - `by`: (3,) displacement, m.

        **Returns:** an `AbstractShape`.
        """

    @abc.abstractmethod
    def distance(self, x: Vec, w: Vec) -> Scalar:
        """Find the distance in m from a point to the first intersection along a direction.

        **Arguments:**

        - `x`: points, m.
        - `w`: directions.

        **Returns:** distances in m; 1e30 where the surface is behind the point or is missed.
        """

    @abc.abstractmethod
    def tangent(self, x: Vec) -> tuple[Vec, Scalar]:
        """Return the tangent plane at a point of the surface.

        **Arguments:**

        - `x`: points on the surface, m.

        **Returns:** the upper unit normal n, and the offset n . x of the plane in m.
        """

    @abc.abstractmethod
    def crossing(
        self, points: Float[np.ndarray | Array, "n 3"], directions: Float[np.ndarray | Array, "n 3"]
    ) -> tuple[Float[np.ndarray | Array, " n"], Float[np.ndarray | Array, " n"]]:
        """Find the signed distances at which straight lines cross the surface, and the cosines of incidence.

        Plans use them, in double precision, to bound the lengths of all paths. A shape that is curved or
        bounded returns the smallest and the largest values that any line near the given ones can have, at
        different elements of the arrays. Within a JAX transformation the arguments are JAX arrays; where a
        shape of yours cannot take these, `Waveform.lost` does not tell that a plan starts below it.

        **Arguments:**

        - `points`: (n, 3) points on the lines, m.
        - `directions`: (n, 3) directions of the lines.

        **Returns:** (n,) distances in m, and (n,) cosines between direction and normal.
        """

    def outline(self, x: Vec, w: Vec) -> Scalar | None:
        """Return the signed distances of rays from the outline of the shape, by which derivatives see it.

        The return jumps where rays come to meet the shape or to miss it. Derivatives of the first order, and
        of the first flight of photons, take that in by this distance (see
        `trace.derivatives.reparametrisation`); flights after a scattering leave it out.

        **Arguments:**

        - `x`: points, m.
        - `w`: directions.

        **Returns:** distances in m, negative for rays that meet the shape and positive for those that miss
        it: a function of point and direction that can be differentiated twice, zero at the outline alone. A
        constant, as `jnp.full_like(x[0], -1.0)`, for a shape that has no outline in view. None (default)
        where it is not stated.
        """
        return None


class OutlineWarning(UserWarning):
    """The warning that a derivative leaves out the outline of a shape.

    It is given where a derivative is taken through a shape of yours that does not define
    `AbstractShape.outline`.

    **Example:** it is an error in tests.

    >>> import warnings
    >>> import jaxlidar as jl
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", jl.OutlineWarning)
    """


# Compiled: plans evaluate it often, and dispatching its operations one by one takes longer.
@jax.jit
def _normal_and_point(
    slope: Float[Array, ""], aspect: Float[Array, ""], position: Float[Array, "2"], height: Float[Array, ""]
) -> tuple[Float[Array, "3"], Vec]:
    s, a = jnp.deg2rad(slope), jnp.deg2rad(aspect)
    upward = jnp.stack([jnp.sin(s) * jnp.sin(a), jnp.sin(s) * jnp.cos(a), jnp.cos(s)])
    return upward, (position[0], position[1], height)


@final
class Plane(AbstractShape):
    """An infinite plane. `Plane.of` makes it from height, slope and aspect.

    **Arguments:**

    - `upward`: (3,) upper unit normal.
    - `foot`: (3,) a point of the plane, m, or its x, y and z. It is kept as three arrays: for derivatives, a
      change of the height alone is one number (`trace.derivatives.replay`).

    **Example:**

    >>> import jaxlidar as jl
    >>> plane = jl.Plane.of(height=2.0, slope=60.0, aspect=90.0)
    >>> print(f"normal: {float(plane.upward[0]):.3f} east, {float(plane.upward[2]):.3f} up")
    normal: 0.866 east, 0.500 up
    """

    upward: Float[Array, "3"]
    foot: Vec = eqx.field(converter=vec)

    @staticmethod
    def of(
        height: ArrayLike, slope: ArrayLike, aspect: ArrayLike, position: ArrayLike | Sequence = (0.0, 0.0)
    ) -> "Plane":
        """Make the plane of a given slope and aspect through a point.

        **Arguments:**

        - `height`: height of the point, m.
        - `slope`: angle between the normal and the vertical, degrees.
        - `aspect`: azimuth to which the normal is tilted, degrees clockwise from north (+y). The plane falls
          in this direction.
        - `position`: (2,) horizontal position of the point, m. Default (0, 0).

        **Returns:** a `Plane`.
        """
        height = as_scalar(height, "height")
        slope, aspect = as_scalar(slope, "slope"), as_scalar(aspect, "aspect")
        place = as_array(position, "position").astype(height.dtype)
        return Plane(*_normal_and_point(slope, aspect, place, height))

    @property
    def lights_itself(self) -> bool:
        return False

    def moved(self, by: Float[Array, "3"]) -> "Plane":
        return Plane(self.upward, add(self.foot, vec(by)))

    def distance(self, x: Vec, w: Vec) -> Scalar:
        normal, offset = self.tangent(x)
        cosine = dot(normal, w)
        s = _signed_distance(offset - dot(normal, x), cosine)
        return jnp.where((jnp.abs(cosine) >= _PARALLEL) & (s > 0), jnp.minimum(s, FAR), FAR)

    def tangent(self, x: Vec) -> tuple[Vec, Scalar]:
        normal = vec(self.upward)
        return normal, dot(normal, self.foot)

    def crossing(
        self, points: Float[np.ndarray | Array, "n 3"], directions: Float[np.ndarray | Array, "n 3"]
    ) -> tuple[Float[np.ndarray | Array, " n"], Float[np.ndarray | Array, " n"]]:
        xp = array_namespace(points)
        normal, foot = fixed_array(self.upward, xp), fixed_array(self.foot, xp)
        # Products and sums in place of `@`, which some devices evaluate in half precision.
        cosine, height = (directions * normal).sum(axis=1), ((foot - points) * normal).sum(axis=1)
        return _signed_distance(height, cosine, xp), cosine


def _signed_distance(height: Any, cosine: Any, xp: Any = jnp) -> Any:
    """Compute the distance to a plane that lies `height` further along its normal; huge where parallel."""
    return height / xp.where(xp.abs(cosine) < _PARALLEL, _PARALLEL, cosine)
