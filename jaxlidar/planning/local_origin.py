"""Coordinates about the aim point, so that map coordinates lose nothing in single precision.

Single precision resolves coordinates of a few million metres to half a metre only. So the aim point is
subtracted from all positions in double precision, before anything goes to the device.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxlidar._fields.checks import as_array, concrete
from jaxlidar.scenes.scene import Scene
from jaxlidar.sensors.lidar import Lidar


def move_aim_to_origin(lidar: Lidar, scene: Scene) -> tuple[Lidar, Scene]:
    """Return the same lidar and scene, moved so that the lidar aims at x = y = 0, or its sensor is there.

    Differences are taken in double precision, and what is returned has JAX's default precision. Where the
    position of the lidar is traced by a JAX transformation, or a surface cannot be moved, nothing is moved.
    """
    position = concrete(lidar.position)
    if position is None:
        return lidar, scene
    # The height of a sensor stays.
    aim, height = position[:2], position[2:]
    # `moved` returns None for surfaces that cannot be moved.
    surfaces = (*(() if scene.ground is None else (scene.ground,)), *scene.plates, *scene.meshes)
    moved = [surface.moved(-aim) for surface in surfaces]
    stays = not aim.any() or any(surface is None for surface in moved)
    new_aim = aim if stays else np.zeros(2)
    lidar = eqx.tree_at(lambda a: a.position, lidar, as_array(np.append(new_aim, height)))
    surfaces = surfaces if stays else tuple(moved)
    # `surfaces` has the ground first, if there is one, then the plates and the meshes.
    n_grounds = len(surfaces) - len(scene.plates) - len(scene.meshes)
    n_planes = n_grounds + len(scene.plates)
    canopy = scene.canopy
    if canopy is not None:
        shift = np.append(aim - new_aim, 0.0)
        origin = _subtract_in_double(canopy.voxels.origin, shift)
        canopy = eqx.tree_at(lambda c: c.voxels.origin, canopy, origin)
    ground = surfaces[0] if n_grounds else None
    # Meshes go on to repeat where a simulation leaves out the canopy or the terrain with which they do.
    meshes = tuple(
        eqx.tree_at(lambda s: s.period, mesh, scene.period, is_leaf=lambda x: x is None)
        for mesh in surfaces[n_planes:]
    )
    return lidar, dataclasses.replace(
        scene,
        canopy=canopy,
        plates=surfaces[n_grounds:n_planes],
        ground=ground,
        meshes=meshes,
    )


def _subtract_in_double(a: Array | np.ndarray, b: np.ndarray) -> Array:
    """Return a - b in JAX's default precision, subtracted in double precision unless `a` is traced."""
    value = concrete(a)
    return jnp.asarray(a, float) - b if value is None else as_array(value - b)
