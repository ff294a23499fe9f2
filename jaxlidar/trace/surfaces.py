"""Ground and plates as the tracer sees them: surfaces that rays meet or pass."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlidar._vectors import FAR, Scalar, Vec, along, dot, scale
from jaxlidar.optics.laws import AbstractLaw
from jaxlidar.scenes.raster import Raster
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.shapes import AbstractShape
from jaxlidar.scenes.surfaces import AbstractSheet, AbstractSurface


class Surface(eqx.Module):
    """One surface, with its shape relative to the aim point."""

    shape: AbstractShape
    coverage: Float[Array, ""]
    law: AbstractLaw
    # What the reflectance is multiplied by at each place, if it varies.
    pattern: Raster | None
    # Whether rays may pass: a plate lets some through, the ground does not.
    plate: bool = eqx.field(static=True)
    straight: bool = eqx.field(static=True)

    def moved(self, by: Float[Array, "3"]) -> "Surface":
        """The same surface, moved."""
        pattern = None if self.pattern is None else self.pattern.moved(by[:2])
        return dataclasses.replace(self, shape=self.shape.moved(by), pattern=pattern)

    def distance(self, x: Vec, w: Vec) -> Scalar:
        """Distance from `x` along `w` to the surface; FAR if behind, missed, or met from under the ground."""
        s = self.shape.distance(x, w)
        if self.plate:
            return s
        normal, _ = self.shape.tangent(along(x, w, jnp.where(s < FAR, s, 0.0)))
        return jnp.where(dot(normal, w) < 0, s, FAR)

    def lit_normal(self, x: Vec, w: Vec) -> Vec:
        """Normal, at the point `x`, of the side that light travelling along `w` falls on."""
        normal, _ = self.shape.tangent(x)
        sign = jnp.where(dot(normal, w) > 0, -1.0, 1.0)
        return scale(normal, sign)

    def by_place(self, x: Vec, value: Scalar) -> Scalar:
        """What is reflected at the point `x`, where `value` is reflected at the brightest place."""
        return value if self.pattern is None else value * self.pattern.value(x)


def surfaces_of(scene: Scene, aim: Float[Array, "3"]) -> tuple[Surface, ...]:
    """The surfaces of a scene, ground first, then plates, relative to the aim point."""
    one = jnp.ones_like(aim[0])

    def surface(s: AbstractSurface) -> Surface:
        here = Surface(s.shape, one, s.law, s.pattern, False, False)
        if isinstance(s, AbstractSheet):
            straight = s.transmission == "straight"
            here = dataclasses.replace(here, coverage=s.coverage, plate=True, straight=straight)
        return here.moved(-aim)

    return tuple(surface(s) for s in scene.surfaces)
