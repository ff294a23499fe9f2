"""Stream compaction: living photons first, those with short paths before those with long ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.trace.compaction import SHORT_PATH, compact
from jaxlidar.trace.device_scene import build_device_scene
from jaxlidar.trace.photons import Photons
from jaxlidar.trace.voxel_traversal import enter_grid


def photons(alive):
    """Photons about and within the map, in chunks."""
    random = np.random.default_rng(1)
    x = random.uniform(-30.0, 30.0, (3, alive.size))
    w = random.normal(size=x.shape)
    w /= np.linalg.norm(w, axis=0)
    zero, number = jnp.zeros(alive.size), jnp.zeros(alive.size, jnp.int32)
    x, w = (tuple(jnp.asarray(a, float) for a in v) for v in (x, w))
    flat = Photons(x, w, zero, zero, number, number, None, jnp.asarray(alive.reshape(-1)))
    return jax.tree.map(lambda a: a.reshape(alive.shape), flat)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_living_photons_come_first_and_those_with_short_paths_before_others(share):
    voxels = jl.VoxelMap.from_lad(np.full((24, 24, 24), 0.2), voxel_size=1.0, origin=(-12.0, -12.0, -12.0))
    scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4)))
    lidar = jl.Lidar()
    device_scene = build_device_scene(jl.make_setup(lidar, scene, jl.plan(lidar, scene)), derivatives="none")
    these = photons(np.random.default_rng(0).uniform(size=(5, 64)) < share)
    source, living = jax.jit(compact)(device_scene, these)
    assert device_scene.medium is not None
    ray = enter_grid(device_scene.medium, these.x, these.w, device_scene.occupied_box)
    faces = np.asarray(ray.leave - ray.enter) * np.abs(np.asarray(these.w)).sum(axis=0)
    number = np.flatnonzero(these.alive)
    kind = np.where(faces > SHORT_PATH, 2, faces > 0).reshape(-1)[number]
    assert share == 0.0 or set(kind) == {0, 1, 2}
    assert living == number.size
    np.testing.assert_array_equal(source.reshape(-1)[: number.size], number[np.argsort(kind, kind="stable")])
    assert not np.any(source.reshape(-1)[number.size :])


def test_without_a_medium_photons_keep_their_order():
    scene = jl.Scene(plates=[jl.Plate(5.0, 0.3, 0.4)], ground=jl.Ground(0.3))
    lidar = jl.Lidar()
    device_scene = build_device_scene(jl.make_setup(lidar, scene, jl.plan(lidar, scene)), derivatives="none")
    alive = np.random.default_rng(0).uniform(size=(3, 32)) < 0.5
    source, living = compact(device_scene, photons(alive))
    np.testing.assert_array_equal(source.reshape(-1)[: int(living)], np.flatnonzero(alive))
