"""Ground and plates as the tracer sees them: planes that rays cross, meet or pass."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlidar._vectors import FAR, Scalar, Vec, dot, scale, vec
from jaxlidar.optics.laws import AbstractLaw
from jaxlidar.scenes.scene import Ground, Plate, Scene


class Surface(eqx.Module):
    """One plane: the points x, relative to the aim point, with normal . x = offset."""

    normal: Vec
    offset: Float[Array, ""]
    coverage: Float[Array, ""]
    law: AbstractLaw
    # Whether rays may pass: a plate lets some through, the ground does not.
    plate: bool = eqx.field(static=True)
    straight: bool = eqx.field(static=True)

    def distance(self, x: Vec, w: Vec) -> Scalar:
        """How far from `x` along `w` it is met; FAR if behind, parallel, or met from under the ground."""
        towards = dot(self.normal, w)
        flat = jnp.abs(towards) < 1e-9
        s = (self.offset - dot(self.normal, x)) / jnp.where(flat, 1.0, towards)
        met = ~flat & (s > 0)
        if not self.plate:
            met &= towards < 0
        return jnp.where(met, jnp.minimum(s, FAR), FAR)

    def lit_normal(self, w: Vec) -> Vec:
        """The normal of the side on which light travelling along `w` falls."""
        sign = jnp.where(dot(self.normal, w) > 0, -1.0, 1.0)
        return scale(self.normal, sign)


def surfaces_of(scene: Scene, aim: Float[Array, "3"]) -> tuple[Surface, ...]:
    """Ground first, then plates, as planes relative to the aim point."""

    def surface(s: Ground | Plate) -> Surface:
        plane = s.plane
        foot = jnp.stack([-aim[0], -aim[1], plane.height - aim[2]])
        plate = isinstance(s, Plate)
        return Surface(
            vec(plane.normal),
            jnp.sum(plane.normal * foot),
            s.coverage if plate else jnp.ones_like(plane.height),
            s.law,
            plate,
            plate and s.transmission == "straight",
        )

    return tuple(surface(s) for s in scene.surfaces)
