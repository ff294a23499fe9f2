"""Vectors as tuples of three arrays.

This structure of arrays keeps the loops over photons vectorised; an array of shape (photons, 3) does not: as
the state of a scan over photons it measured 3 to 10 times slower on a CPU.
"""

from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

Scalar = Float[Array, "..."]
Vec = tuple[Scalar, Scalar, Scalar]
# Distance in m that stands for "no intersection". Finite, so that its products with zero are zero.
FAR = 1e30


def vec(a: Float[Array, "3"] | Iterable[Scalar]) -> Vec:
    """Split an array of shape (3, ...), or any three arrays, into the components of a vector."""
    x, y, z = a
    return x, y, z


@jax.custom_jvp
def with_derivative_of(value: Scalar, differentiated: Scalar) -> Scalar:
    """Return `value` with the derivative of `differentiated`.

    Where no derivatives are taken, `differentiated` is not used and the compiler drops its computation.
    """
    # The condition is a constant, so that the compiler sees that this is `value`. Under `jax.vmap` the result
    # must have a batch axis where its derivative has one, even if `value` has none: JAX takes the axes from
    # here alone, and within loops nothing corrects them.
    return lax.select_n(np.False_, value, differentiated)


@with_derivative_of.defjvp
def _(primals, tangents):
    # Not the plain value: a second derivative holds products of first ones.
    return with_derivative_of(*primals), tangents[1]


def dot(a: Vec, b: Vec) -> Scalar:
    """Inner product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def scale(a: Vec, s: Scalar) -> Vec:
    """`a` times the scalar `s`."""
    return a[0] * s, a[1] * s, a[2] * s


def add(a: Vec, b: Vec) -> Vec:
    """Sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def along(origin: Vec, direction: Vec, distance: Scalar) -> Vec:
    """Point at `distance` from `origin` along the unit vector `direction`."""
    return add(origin, scale(direction, distance))


def normalise(a: Vec) -> Vec:
    """Unit vector along `a`, which must not vanish."""
    return scale(a, 1.0 / jnp.sqrt(dot(a, a)))


def _frame(axis: Vec) -> tuple[Vec, Vec]:
    """Two unit vectors perpendicular to the unit vector `axis` and to each other.

    The frame is the branch-free one of Duff et al. (2017), J. Comput. Graph. Tech. 6(1), 1. It is smooth
    except at z = 0 of the axis, where it flips.
    """
    sign = jnp.where(axis[2] >= 0, 1.0, -1.0)
    a = -1.0 / (sign + axis[2])
    b = axis[0] * axis[1] * a
    first = (1.0 + sign * axis[0] * axis[0] * a, sign * b, -sign * axis[0])
    return first, (b, sign + axis[1] * axis[1] * a, -axis[1])


def from_frame(axis: Vec, local: Vec) -> Vec:
    """Transform `local` from the frame whose third axis is the unit vector `axis` to world coordinates."""
    first, second = _frame(axis)
    return add(add(scale(first, local[0]), scale(second, local[1])), scale(axis, local[2]))


def to_frame(axis: Vec, world: Vec) -> Vec:
    """Transform `world` to the frame whose third axis is the unit vector `axis`: inverse of `from_frame`."""
    first, second = _frame(axis)
    return dot(first, world), dot(second, world), dot(axis, world)


def cross(a: Vec, b: Vec) -> Vec:
    """Vector product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def polar(cosine: Scalar, azimuth: Scalar) -> Vec:
    """Unit vector from the cosine of its polar angle and its azimuth in radians."""
    sine = jnp.sqrt(jnp.maximum(1.0 - cosine * cosine, 0.0))
    return sine * jnp.cos(azimuth), sine * jnp.sin(azimuth), cosine


def cosine_direction(normal: Vec, u: Scalar, v: Scalar) -> Vec:
    """Draw a direction by the cosine law about the unit vector `normal`.

    The density is cos(theta) / pi: cos(theta) = sqrt(1 - u), azimuth = 2 pi v.

    **Arguments:** `normal`: unit vector; `u`, `v`: uniform random numbers in [0, 1).
    """
    return from_frame(normal, polar(jnp.sqrt(1.0 - u), 2 * np.pi * v))
