"""Coordinates about the aim point, so that places millions of metres out lose nothing in single precision."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxlidar._checks import concrete
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.scenes.scene import Scene


def about_aim(lidar: Lidar, scene: Scene) -> tuple[Lidar, Scene]:
    """The same lidar and scene, moved so that the lidar aims at x = y = 0.

    Differences are taken in double precision, and what is returned has JAX's default precision. Where the
    position of the lidar is traced by a JAX transformation, or a surface cannot be moved, all stays where it
    is.
    """
    place = concrete(lidar.position)
    if place is None:
        return lidar, scene
    moved = [surface.moved(-place) for surface in scene.surfaces]
    stays = not place.any() or any(surface is None for surface in moved)
    here = place if stays else np.zeros(2)
    lidar = eqx.tree_at(lambda a: a.position, lidar, jnp.asarray(here, float))
    surfaces = tuple(scene.surfaces if stays else moved)
    grounds = len(surfaces) - len(scene.plates)
    canopy = scene.canopy
    if canopy is not None:
        by = np.append(place - here, 0.0)
        canopy = eqx.tree_at(lambda c: c.voxels.origin, canopy, _difference(canopy.voxels.origin, by))
    ground = surfaces[0] if grounds else None
    return lidar, dataclasses.replace(scene, canopy=canopy, plates=surfaces[grounds:], ground=ground)


def _difference(a: Array | np.ndarray, b: np.ndarray) -> Array:
    known = concrete(a)
    return jnp.asarray(a, float) - b if known is None else jnp.asarray(known - b, float)
