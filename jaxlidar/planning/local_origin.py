"""Coordinates about the aim point, so that map coordinates lose nothing in single precision.

Single precision resolves coordinates of a few million metres to half a metre only. So the aim point is
subtracted from all positions in double precision, before anything goes to the device.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxlidar._checks import concrete
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.scenes.scene import Scene


def move_aim_to_origin(lidar: Lidar, scene: Scene) -> tuple[Lidar, Scene]:
    """Return the same lidar and scene, moved so that the lidar aims at x = y = 0, or its sensor is there.

    Differences are taken in double precision, and what is returned has JAX's default precision. Where the
    position of the lidar is traced by a JAX transformation, or a surface cannot be moved, nothing is moved.
    """
    position = concrete(lidar.position)
    if position is None:
        return lidar, scene
    # Of a sensor the height stays.
    aim, height = position[:2], position[2:]
    # `moved` returns None for surfaces that cannot be moved.
    moved = [surface.moved(-aim) for surface in scene.surfaces]
    stays = not aim.any() or any(surface is None for surface in moved)
    new_aim = aim if stays else np.zeros(2)
    lidar = eqx.tree_at(lambda a: a.position, lidar, jnp.asarray(np.append(new_aim, height), float))
    surfaces = tuple(scene.surfaces if stays else moved)
    # `surfaces` has the ground first, if there is one, then the plates.
    n_grounds = len(surfaces) - len(scene.plates)
    canopy = scene.canopy
    if canopy is not None:
        shift = np.append(aim - new_aim, 0.0)
        origin = _subtract_in_double(canopy.voxels.origin, shift)
        canopy = eqx.tree_at(lambda c: c.voxels.origin, canopy, origin)
    ground = surfaces[0] if n_grounds else None
    return lidar, dataclasses.replace(scene, canopy=canopy, plates=surfaces[n_grounds:], ground=ground)


def _subtract_in_double(a: Array | np.ndarray, b: np.ndarray) -> Array:
    """Return a - b in JAX's default precision, subtracted in double precision unless `a` is traced."""
    value = concrete(a)
    return jnp.asarray(a, float) - b if value is None else jnp.asarray(value - b, float)
