"""Vectors as tuples of three arrays: structure-of-arrays keeps the photon loops vectorised."""

from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Scalar = Float[Array, "..."]
Vec = tuple[Scalar, Scalar, Scalar]
# Distance, m, of what is never met.
FAR = 1e30


def vec(a: Float[Array, "3"] | Iterable[Scalar]) -> Vec:
    """The three components of an array, or three given one after the other."""
    x, y, z = a
    return x, y, z


@jax.custom_jvp
def with_derivative_of(value: Scalar, other: Scalar) -> Scalar:
    """`value`, which varies as `other` does. What only `other` needs is not computed without derivatives."""
    return value


@with_derivative_of.defjvp
def _(primals, tangents):
    return primals[0], tangents[1]


def dot(a: Vec, b: Vec) -> Scalar:
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def scale(a: Vec, s: Scalar) -> Vec:
    """`a` times the scalar `s`."""
    return a[0] * s, a[1] * s, a[2] * s


def add(a: Vec, b: Vec) -> Vec:
    """Sum."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def along(origin: Vec, direction: Vec, distance: Scalar) -> Vec:
    """The point at `distance` from `origin`."""
    return add(origin, scale(direction, distance))


def normalise(a: Vec) -> Vec:
    """Unit vector along `a`, which must not vanish."""
    return scale(a, 1.0 / jnp.sqrt(dot(a, a)))


def _frame(axis: Vec) -> tuple[Vec, Vec]:
    """Two unit vectors perpendicular to the unit vector `axis` and to each other.

    The frame is the branch-free one of Duff et al. (2017), smooth but at axis z = 0 where it turns.
    """
    sign = jnp.where(axis[2] >= 0, 1.0, -1.0)
    a = -1.0 / (sign + axis[2])
    b = axis[0] * axis[1] * a
    first = (1.0 + sign * axis[0] * axis[0] * a, sign * b, -sign * axis[0])
    return first, (b, sign + axis[1] * axis[1] * a, -axis[1])


def from_frame(axis: Vec, local: Vec) -> Vec:
    """Turn `local`, given in a frame whose third axis is the unit vector `axis`, into world coordinates."""
    first, second = _frame(axis)
    return add(add(scale(first, local[0]), scale(second, local[1])), scale(axis, local[2]))


def to_frame(axis: Vec, world: Vec) -> Vec:
    """The inverse of `from_frame`."""
    first, second = _frame(axis)
    return dot(first, world), dot(second, world), dot(axis, world)


def cross(a: Vec, b: Vec) -> Vec:
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def polar(cosine: Scalar, azimuth: Scalar) -> Vec:
    """Unit vector from the cosine of its polar angle and its azimuth in radians."""
    sine = jnp.sqrt(jnp.maximum(1.0 - cosine * cosine, 0.0))
    return sine * jnp.cos(azimuth), sine * jnp.sin(azimuth), cosine


def about(normal: Vec, u: Scalar, v: Scalar) -> Vec:
    """A direction drawn by the cosine law about `normal`, with two uniform numbers."""
    return from_frame(normal, polar(jnp.sqrt(1.0 - u), 2 * np.pi * v))
