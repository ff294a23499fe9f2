"""Stream compaction: living photons first, those with a short path through the medium before long ones.

Photons of a chunk march together until the last of them has stopped. With living photons alone, and paths of
about one length, in a chunk, fewer of its places idle. Photons are sorted into few classes by the number of
voxel faces that their ray crosses, by a counting sort that keeps their order within a class.

No estimate depends on the order: a photon takes its lane, which selects its random numbers, along.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxlidar._jax.one_function import barrier
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.march.voxel_traversal import enter_grid
from jaxlidar.trace.photons.photons import Photons

# Classes: rays that miss the box of occupied voxels, cross at most about `SHORT_PATH` faces in it, and more.
N_CLASSES, SHORT_PATH = 3, 32
# Counts of all classes are packed into one integer, of this many bits each: a chunk has fewer than 1,024
# photons.
_COUNT_BITS = 10


def compact(scene: DeviceScene, photons: Photons) -> tuple[Int[Array, "chunks size"], Int[Array, ""]]:
    """Return the indices of living photons in their new order, zeros after them, and their count.

    1. Give every living photon its class, and dead ones the class `N_CLASSES`.
    2. Within each chunk, run a cumulative count of every class, packed into one integer.
    3. A photon's new position is the count of lower classes, plus that of its class in earlier chunks, plus
       its rank within the chunk.
    4. Scatter photon numbers to their new positions; dead photons fall off the end.
    """
    alive = photons.alive
    # Optimisation barriers: these arrays would otherwise be computed again for each use.
    path_class = barrier(jnp.where(alive, _path_classes(scene, photons), N_CLASSES))
    class_bit = jnp.where(alive, 1 << (_COUNT_BITS * path_class), 0)
    running = barrier(jnp.cumsum(class_bit, axis=1))

    def count_of(packed: Int[Array, "*s"], number: int) -> Int[Array, "*s"]:
        return (packed >> (_COUNT_BITS * number)) & ((1 << _COUNT_BITS) - 1)

    per_chunk = jnp.stack([count_of(running[:, -1], c) for c in range(N_CLASSES)])
    before = (jnp.cumsum(per_chunk.reshape(-1)) - per_chunk.reshape(-1)).reshape(per_chunk.shape)
    position = jnp.full(alive.shape, alive.size)
    for c in range(N_CLASSES):
        position = jnp.where(path_class == c, before[c][:, None] + count_of(running, c) - 1, position)
    number, position = jnp.arange(alive.size), barrier(position.reshape(-1))
    source = jnp.zeros_like(number).at[position].set(number, mode="drop")
    return source.reshape(alive.shape), jnp.sum(per_chunk)


def _path_classes(scene: DeviceScene, photons: Photons) -> Int[Array, "chunks size"]:
    """Return 0 where a ray misses all occupied voxels, 1 where it crosses few faces in their box, else 2.

    The number of faces is estimated by the length of the ray in the box times its faces per metre.
    """
    medium = scene.medium
    if medium is None:
        return jnp.zeros(photons.alive.shape, jnp.int32)
    x, w = lax.stop_gradient((photons.x, photons.w))
    ray = enter_grid(medium, x, w, scene.occupied_box)
    faces_per_metre = sum(jnp.abs(w[k]) / medium.size[k] for k in range(3))
    faces = (ray.leave - ray.enter) * faces_per_metre
    return (faces > 0).astype(jnp.int32) + (faces > SHORT_PATH).astype(jnp.int32)
