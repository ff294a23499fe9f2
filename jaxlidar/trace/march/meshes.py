"""Meshes in tracer coordinates: the triangles among the surfaces that rays meet.

All triangles of a scene lie in one tree (`jaxlidar.scenes.triangle_tree`), and each is opaque to light that
goes straight on: of all meshes only the triangle that a ray meets first counts. So a ray is followed once
through the tree, and the surface of that triangle's material gets its distance, all others `FAR`.

Triangles that lie in the ground, nearer than `MIN_GAP` or the rounding of their corners, lie on it: light
meets them first. What they transmit goes on to the ground.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

from jaxlidar._fields.checks import warn_user
from jaxlidar._vectors import FAR, Scalar, Vec, along, dot, vec
from jaxlidar.scenes.mesh_surface import MeshHit
from jaxlidar.scenes.scene import MIN_GAP
from jaxlidar.scenes.shapes import OutlineWarning
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.march.surfaces import TracedSurface


def surface_distances(
    scene: DeviceScene, x: Vec, w: Vec, from_surface: Int[Array, "*s"] | None = None
) -> tuple[list[Scalar], Vec | None]:
    """Return the distances of all surfaces from `x` along `w`, and the normal of the triangle that is met.

    The normal, of the front side, is None in a scene without meshes.

    **Arguments:** `from_surface`: number of the surface that light comes from, or -1. None: from the lidar.
    """
    hit = None
    if scene.meshes is not None:
        hit = scene.meshes.meet(x, w)
        nearest = _warn_if_differentiated(hit.distance)
    distances, material = [], 0
    for surface in scene.surfaces:
        if not surface.is_mesh:
            if hit is None or surface.is_plate:
                distances.append(surface.distance(x, w))
            else:
                distances.append(_distance_of_ground(scene, surface, hit, x, w, from_surface))
            continue
        assert hit is not None
        distances.append(jnp.where(hit.material == material, nearest, FAR))
        material += 1
    return distances, None if hit is None else hit.normal


def _distance_of_ground(
    scene: DeviceScene,
    ground: TracedSurface,
    hit: MeshHit,
    x: Vec,
    w: Vec,
    from_surface: Int[Array, "*s"] | None,
) -> Scalar:
    """Return the distance of the ground; FAR where the triangle that is met lies in it.

    By rounding, light that a triangle in the ground transmits starts below the ground. It meets the ground at
    once: its ray is followed from a point above its start, and is as much shorter.
    """
    tolerance = lax.stop_gradient(jnp.maximum(MIN_GAP, _rounding(scene, x)))
    raised = jnp.zeros_like(tolerance)
    if from_surface is not None:
        raised = jnp.where(_is_mesh(scene, from_surface) & (w[2] < 0), 2.0 * tolerance, raised)
    above = vec((x[0], x[1], x[2] + raised))
    distance = ground.distance(above, w)
    ahead = jnp.where(distance < FAR, distance, 0.0)
    assert ground.shape is not None
    normal, _ = ground.shape.tangent(along(above, w, ahead))
    cosine = jnp.abs(dot(normal, w))
    excess = lax.stop_gradient(raised * normal[2] / jnp.maximum(cosine, 1e-6))
    distance = jnp.where(distance < FAR, jnp.maximum(distance - excess, 0.0), FAR)
    # Measured along the normal: along a grazing ray the rounding of both distances grows without bound.
    gap = jnp.abs(hit.distance - distance) * cosine
    return jnp.where((hit.distance < FAR) & (gap <= tolerance), FAR, distance)


def _is_mesh(scene: DeviceScene, surface: Int[Array, "*s"]) -> Bool[Array, "*s"]:
    """Return True for numbers of surfaces that are meshes."""
    is_mesh = jnp.zeros_like(surface, bool)
    for number, traced in enumerate(scene.surfaces):
        if traced.is_mesh:
            is_mesh |= surface == number
    return is_mesh


def _rounding(scene: DeviceScene, x: Vec) -> Scalar:
    """Return a bound, m, on the rounding of a point `x` on a triangle, to which a ray has come."""
    assert scene.meshes is not None
    # Rays come from above the scene, with the rounding of that distance.
    start = jnp.abs(jnp.asarray(scene.limits.start_distance, x[2].dtype))
    return scene.meshes.rounding((x[0], x[1], jnp.abs(x[2]) + start))


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
    step = _rounding(scene, x)
    step = jnp.where(dot(normal, direction) < 0, -step, step)
    return along(x, normal, lax.stop_gradient(jnp.where(_is_mesh(scene, surface), step, 0.0)))


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
