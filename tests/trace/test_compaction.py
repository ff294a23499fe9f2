"""Stream compaction: living photons first, those with short paths before those with long ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.trace.device_scene import build_device_scene
from jaxlidar.trace.march.voxel_traversal import enter_grid
from jaxlidar.trace.photons.compaction import SHORT_PATH, compact
from jaxlidar.trace.photons.photons import Photons


def photons(alive):
    """Return photons around and within the map, in chunks."""
    random = np.random.default_rng(1)
    position = random.uniform(-30.0, 30.0, (3, alive.size))
    direction = random.normal(size=position.shape)
    direction /= np.linalg.norm(direction, axis=0)
    zero, indices = jnp.zeros(alive.size), jnp.zeros(alive.size, jnp.int32)
    position, direction = (tuple(jnp.asarray(a, float) for a in v) for v in (position, direction))
    photons_in_a_row = Photons(
        position, direction, zero, zero, indices, indices, None, jnp.asarray(alive.reshape(-1))
    )
    return jax.tree.map(lambda a: a.reshape(alive.shape), photons_in_a_row)


@pytest.mark.parametrize("living_fraction", [0.0, 0.3, 1.0])
def test_living_photons_come_first_and_those_with_short_paths_before_others(living_fraction):
    voxels = jl.VoxelMap.from_lad(np.full((24, 24, 24), 0.2), voxel_size=1.0, origin=(-12.0, -12.0, -12.0))
    scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4), hotspot=False))
    lidar = jl.Lidar()
    device_scene = build_device_scene(jl.make_setup(lidar, scene, jl.plan(lidar, scene)), derivatives="none")
    batch = photons(np.random.default_rng(0).uniform(size=(5, 64)) < living_fraction)
    source, living = jax.jit(compact)(device_scene, batch)
    assert device_scene.medium is not None
    ray = enter_grid(device_scene.medium, batch.x, batch.w, device_scene.occupied_box)
    faces = np.asarray(ray.leave - ray.enter) * np.abs(np.asarray(batch.w)).sum(axis=0)
    living_indices = np.flatnonzero(batch.alive)
    # Class 0 misses the map, 1 crosses few faces, 2 many.
    path_class = np.where(faces > SHORT_PATH, 2, faces > 0).reshape(-1)[living_indices]
    assert living_fraction == 0.0 or set(path_class) == {0, 1, 2}
    assert living == living_indices.size
    np.testing.assert_array_equal(
        source.reshape(-1)[: living_indices.size], living_indices[np.argsort(path_class, kind="stable")]
    )
    assert not np.any(source.reshape(-1)[living_indices.size :])


def test_without_a_medium_photons_keep_their_order():
    scene = jl.Scene(plates=[jl.Plate(5.0, 0.3, 0.4)], ground=jl.Ground(0.3))
    lidar = jl.Lidar()
    device_scene = build_device_scene(jl.make_setup(lidar, scene, jl.plan(lidar, scene)), derivatives="none")
    alive = np.random.default_rng(0).uniform(size=(3, 32)) < 0.5
    source, living = compact(device_scene, photons(alive))
    np.testing.assert_array_equal(source.reshape(-1)[: int(living)], np.flatnonzero(alive))
