"""Meshes in tracer coordinates: the triangles among the surfaces that rays meet.

All triangles of a scene lie in one tree (`jaxlidar.scenes.triangle_tree`), and each is opaque to light that
goes straight on: of all meshes only the triangle that a ray meets first counts. So a ray is followed once
through the tree, and the surface of that triangle's material gets its distance, all others `FAR`.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxlidar._checks import warn_user
from jaxlidar._vectors import FAR, Scalar, Vec, along, dot
from jaxlidar.scenes.shapes import OutlineWarning
from jaxlidar.trace.device_scene import DeviceScene


def surface_distances(scene: DeviceScene, x: Vec, w: Vec) -> tuple[list[Scalar], Vec | None]:
    """Return the distances of all surfaces from `x` along `w`, and the normal of the triangle that is met.

    The normal, of the front side, is None in a scene without meshes.
    """
    hit = None
    if scene.meshes is not None:
        hit = scene.meshes.meet(x, w)
        nearest = _warn_if_differentiated(hit.distance)
    distances, material = [], 0
    for surface in scene.surfaces:
        if not surface.is_mesh:
            distances.append(surface.distance(x, w))
            continue
        assert hit is not None
        distances.append(jnp.where(hit.material == material, nearest, FAR))
        material += 1
    return distances, None if hit is None else hit.normal


def clear_of_mesh(
    scene: DeviceScene, x: Vec, direction: Vec, surface: Int[Array, "*s"], normal: Vec | None
) -> Vec:
    """Move light that leaves a mesh off its triangle by more than the rounding of its position.

    It moves to the side to which it goes on, along the normal. Scenes without meshes stay as they are.

    **Arguments:** `surface`: number of the surface that light leaves, or -1. `normal`: of the triangle.
    """
    if scene.meshes is None:
        return x
    assert normal is not None
    is_on_mesh = jnp.zeros_like(surface, bool)
    for number, traced in enumerate(scene.surfaces):
        if traced.is_mesh:
            is_on_mesh |= surface == number
    # Rays come from above the scene, with the rounding of that distance.
    start = jnp.abs(jnp.asarray(scene.limits.start_distance, x[2].dtype))
    step = scene.meshes.rounding((x[0], x[1], jnp.abs(x[2]) + start))
    step = jnp.where(dot(normal, direction) < 0, -step, step)
    return along(x, normal, lax.stop_gradient(jnp.where(is_on_mesh, step, 0.0)))


@jax.custom_jvp
def _warn_if_differentiated(distance: Scalar) -> Scalar:
    """Return the distance to a mesh; warn where its derivative is taken."""
    return distance


@_warn_if_differentiated.defjvp
def _(primals, tangents):
    # JAX calls this rule only where the distance depends on what is differentiated by.
    message = (
        "derivatives through a mesh are those where the return is smooth: they leave out how light comes to "
        "meet outlines and edges of the mesh or to miss them"
    )
    warn_user(message, OutlineWarning)
    return primals[0], tangents[0]
