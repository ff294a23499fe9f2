"""Ground, plates and meshes in tracer coordinates: surfaces that rays meet or pass.

A ray x + s w meets a surface at the smallest s > 0 on its shape. Ground is opaque, is met from above only,
and ends the ray; a plate is met from both sides, and lets rays through its gaps or straight through its
material.
"""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlidar._fields.checks import warn_user
from jaxlidar._vectors import FAR, Scalar, Vec, along, dot, scale
from jaxlidar.optics.laws import AbstractLaw
from jaxlidar.scenes.height_field import HeightField
from jaxlidar.scenes.mesh_surface import MeshMaterial
from jaxlidar.scenes.raster import Raster
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.shapes import AbstractShape, OutlineWarning, Plane
from jaxlidar.scenes.surfaces import AbstractSheet, AbstractSurface

_NO_OUTLINE = (
    "derivatives through a shape without the method `outline` leave out how light comes to meet it or to "
    "miss it as it moves or grows: see jaxlidar.AbstractShape.outline"
)
_NO_GAPS = (
    "derivatives by the coverage of a plate leave out its gaps, which a plan for coverage = 1 does not "
    "trace: make the plan with a coverage below 1, and take the derivative there"
)


class TracedSurface(eqx.Module):
    """A surface, with its shape relative to the aim point.

    - `shape`: None for the triangles of a mesh, which lie in one tree (`trace.march.meshes`).
    - `coverage`: fraction of a plate that is not gap; 1 for ground.
    - `law`: law of reflection.
    - `pattern`: factor of the reflectance by position, 1 where it is brightest; None where it is the same
      everywhere.
    - `is_plate`: True for plates, False for the ground and for meshes.
    - `straight`: True if the plate transmits light straight on.
    """

    shape: AbstractShape | None
    coverage: Float[Array, ""]
    law: AbstractLaw
    pattern: Raster | None
    is_plate: bool = eqx.field(static=True)
    straight: bool = eqx.field(static=True)

    def moved(self, displacement: Float[Array, "3"]) -> "TracedSurface":
        """Return the same surface, moved by a displacement in m."""
        pattern = None if self.pattern is None else self.pattern.moved(displacement[:2])
        shape = None if self.shape is None else self.shape.moved(displacement)
        return dataclasses.replace(self, shape=shape, pattern=pattern)

    @property
    def is_mesh(self) -> bool:
        """True for the triangles of a mesh."""
        return self.shape is None

    @property
    def lights_itself(self) -> bool:
        """True if light that leaves the surface can meet it again."""
        return self.shape is None or self.shape.lights_itself

    @property
    def may_have_outline(self) -> bool:
        """True for shapes of the user; planes and height fields end nowhere within view."""
        return self.shape is not None and not isinstance(self.shape, (Plane, HeightField))

    def distance(self, x: Vec, w: Vec) -> Scalar:
        """Distance from `x` along `w`; FAR if the surface is behind, missed, or met from under the ground."""
        assert self.shape is not None
        s = self.shape.distance(x, w)
        if self.may_have_outline and self.shape.outline(x, w) is None:
            s = _warn_if_differentiated(_NO_OUTLINE, OutlineWarning, s)
        if self.is_plate:
            return s
        # Ground seen from below is no ground: a ray that starts under the terrain by rounding must not end
        # there.
        normal, _ = self.shape.tangent(along(x, w, jnp.where(s < FAR, s, 0.0)))
        return jnp.where(dot(normal, w) < 0, s, FAR)

    def lit_normal(self, x: Vec, w: Vec, mesh_normal: Vec | None = None) -> Vec:
        """Normal, at the point `x`, of the side that light travelling along `w` falls on.

        `mesh_normal`: that of the triangle at which light meets a mesh; a point alone does not tell it.
        """
        if self.shape is None:
            assert mesh_normal is not None
            normal = mesh_normal
        else:
            normal, _ = self.shape.tangent(x)
        # Plates are lit from either side; the normal is turned against the light.
        sign = jnp.where(dot(normal, w) > 0, -1.0, 1.0)
        return scale(normal, sign)

    def scale_by_pattern(self, x: Vec, value: Scalar) -> Scalar:
        """Multiply `value` by the pattern of reflectance at the point `x`."""
        return value if self.pattern is None else value * self.pattern.value(x)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _warn_if_differentiated(message: str, category: type[UserWarning], value: Scalar) -> Scalar:
    """Return a value; warn once where its derivative is taken."""
    return value


@_warn_if_differentiated.defjvp
def _(message, category, primals, tangents):
    # JAX calls this rule only where the value depends on what is differentiated by.
    warn_user(message, category)
    return primals[0], tangents[0]


def traced_surfaces(
    scene: Scene, aim: Float[Array, "3"], covers_fully: tuple[bool, ...]
) -> tuple[TracedSurface, ...]:
    """Return the surfaces of a scene, ground first, then plates and meshes, relative to the aim point.

    `covers_fully`: that of `TraceConfig`.
    """
    one = jnp.ones_like(aim[0])

    def traced(surface: AbstractSurface, covers_fully: bool) -> TracedSurface:
        if isinstance(surface, MeshMaterial):
            return TracedSurface(None, one, surface.law, None, False, False)
        result = TracedSurface(surface.shape, one, surface.law, surface.pattern, False, False)
        if isinstance(surface, AbstractSheet):
            straight = surface.transmission == "straight"
            coverage: Array = surface.coverage
            if covers_fully:
                coverage = _warn_if_differentiated(_NO_GAPS, UserWarning, coverage)
            result = dataclasses.replace(result, coverage=coverage, is_plate=True, straight=straight)
        return result.moved(-aim)

    return tuple(traced(*surface) for surface in zip(scene.surfaces, covers_fully, strict=True))
