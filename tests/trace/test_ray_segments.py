"""First order, deposited segment by segment, in blocks of all segments, and in blocks without empty ones."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.trace.device_scene import build_device_scene
from jaxlidar.trace.march import ray_segments
from jaxlidar.trace.response import trace_device_scene
from tests.helpers import slow_unless

KEY = jax.random.key(3)


def crown(n: int = 6) -> np.ndarray:
    """Return a map of which two thirds are empty."""
    density = np.random.default_rng(0).uniform(0.2, 1.5, (n, n, n))
    return np.where(np.random.default_rng(1).uniform(size=density.shape) < 0.65, 0.0, density)


def scenes() -> dict[str, jl.Scene]:
    """Return scenes with leaves, bark, leaf angles, plates and terrain."""
    voxels = jl.VoxelMap.from_lad(crown(), voxel_size=1.0)
    bark = eqx.tree_at(lambda v: v.bark, voxels, 0.3 * voxels.leaf[::-1], is_leaf=lambda x: x is None)
    angled = dataclasses.replace(voxels, leaf_angles=jl.LeafAngles.named("erectophile"))
    ground = jl.Ground(reflectance=0.3, slope=10.0)
    hills = jl.Terrain(0.5 * np.random.default_rng(2).uniform(size=(9, 9)), 2.0, (-8, -8), reflectance=0.3)
    return {
        "leaves": jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.Prospect(), hotspot=False), ground=ground),
        "bark": jl.Scene(canopy=jl.Canopy(bark, leaf=jl.Prospect(), bark=0.3, hotspot=False), ground=ground),
        "angles": jl.Scene(canopy=jl.Canopy(angled, leaf=jl.Prospect(), hotspot=False), ground=ground),
        "plate": jl.Scene(
            canopy=jl.Canopy(voxels, leaf=jl.Prospect(), hotspot=False),
            plates=[jl.Plate(3.3, 0.2, 0.5)],
            ground=ground,
        ),
        "terrain": jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.Prospect(), hotspot=False), ground=hills),
    }


LIDAR = jl.Lidar(altitude=500.0, divergence=6.0, zenith=12.0, pulse=jl.GaussianPulse(fwhm=4.0))


@pytest.mark.slow
@pytest.mark.parametrize("kind", slow_unless(["bark"], scenes()))
def test_skipped_segments_add_nothing(kind: str):
    scene = scenes()[kind]
    setup = jl.make_setup(LIDAR, scene, jl.plan(LIDAR, scene, max_orders=1, n_rays=700, describe=False))

    def traced(derivatives):
        device_scene = build_device_scene(setup, derivatives=derivatives)
        return eqx.filter_jit(trace_device_scene)(device_scene, KEY)

    complete, forward_only, no_derivatives = traced("all"), traced("forward"), traced("none")
    assert float(complete.first.sum()) > 0.05
    for shortened in (forward_only, no_derivatives):
        for a, b in zip(jax.tree.leaves(complete), jax.tree.leaves(shortened), strict=True):
            np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("block", [64, 1024])
def test_blocks_hold_every_segment_once(block: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(ray_segments, "SEGMENTS_AT_ONCE", block)
    random = np.random.default_rng(0)
    length = np.where(random.uniform(size=(11, 60)) < 0.5, 0.0, random.uniform(size=(11, 60)))
    start = np.concatenate([np.zeros((1, 60)), np.cumsum(length, axis=0)[:-1]])
    cell = np.arange(start.size).reshape(start.shape)
    extinction = np.where(random.uniform(size=start.shape) < 0.5, 0.0, 1.0)
    segments = ray_segments.RaySegments(*(jnp.asarray(a) for a in (start, length, start, cell, extinction)))

    def add(tally, block, ray):
        is_real = block.length > 0
        return tally.at[block.cell].add(jnp.where(is_real, 1.0 + ray, 0.0))

    tally, ray = jnp.zeros(start.size), jnp.arange(60.0)
    ray_weight = 1.0 + np.broadcast_to(np.arange(60.0), start.shape)
    sums = ray_segments.add_in_blocks(add, tally, segments, ray, None).reshape(start.shape)
    np.testing.assert_array_equal(sums, np.where(length > 0, ray_weight, 0.0))
    sums = ray_segments.add_in_blocks(add, tally, segments, ray, segments.extinction > 0).reshape(start.shape)
    np.testing.assert_array_equal(sums, np.where((length > 0) & (extinction > 0), ray_weight, 0.0))


@pytest.mark.parametrize("count", [1, 2, 22])
def test_transmittances_at_steps_are_exponential_functions(count):
    depth, step = jnp.array([0.0, 0.3, 2.0, 50.0]), jnp.array([0.0, 0.01, 0.4, 20.0])

    def by_powers(depth, step):
        return ray_segments._transmittances_at_steps(depth, step, count)

    def expected(depth, step):
        return jax.vmap(lambda n: jnp.exp(-(depth + n * step)))(jnp.arange(float(count)))

    np.testing.assert_allclose(by_powers(depth, step), expected(depth, step), rtol=5e-6, atol=1e-37)
    for tangents in ((jnp.ones(4), jnp.zeros(4)), (jnp.zeros(4), jnp.ones(4))):
        slopes, exact = (jax.jvp(f, (depth, step), tangents)[1] for f in (by_powers, expected))
        np.testing.assert_allclose(slopes, exact, rtol=5e-6, atol=1e-35)
    gradients, exact = (
        jax.grad(lambda *x, f=f: jnp.sum(f(*x)), (0, 1))(depth, step) for f in (by_powers, expected)
    )
    np.testing.assert_allclose(np.stack(gradients), np.stack(exact), rtol=5e-6, atol=1e-35)


@pytest.mark.slow
def test_empty_voxels_have_their_derivatives():
    """Forward, in reverse, and as differences; skipping empty voxels would make them zero."""
    with jax.enable_x64(True):
        scene = scenes()["leaves"]
        plan = jl.plan(LIDAR, scene, max_orders=1, n_rays=300, describe=False)
        assert scene.canopy is not None
        empty = jnp.asarray(scene.canopy.voxels.leaf == 0.0)

        def total(filled, reverse=False):
            thicker = scene.canopy.voxels.leaf + filled * empty
            moved = eqx.tree_at(lambda s: s.canopy.voxels.leaf, scene, thicker)
            setup = jl.make_setup(LIDAR, moved, plan)
            return jl.total_reflectance(jl.trace_scene(setup, KEY, reverse=reverse), setup)[0]

        forward = jax.jit(jax.jacfwd(total))(0.0)
        step = 1e-5
        differences = (jax.jit(total)(step) - jax.jit(total)(0.0)) / step
        np.testing.assert_allclose(forward, differences, atol=1e-4 * float(jnp.max(jnp.abs(forward))))
        assert float(jnp.max(jnp.abs(forward))) > 1e-3
        weight = jnp.cos(jnp.arange(forward.size))
        backward = jax.jit(jax.grad(lambda f: jnp.vdot(weight, total(f, True))))(0.0)
        np.testing.assert_allclose(backward, jnp.vdot(weight, forward), rtol=1e-9)


@pytest.mark.slow
def test_the_result_does_not_depend_on_the_longest_segment():
    scene = scenes()["leaves"]
    waves = [jl.simulate(LIDAR, scene, key=KEY, max_orders=1, max_step=step) for step in (None, 0.11, 5.0)]
    for wave in waves[1:]:
        np.testing.assert_allclose(wave.reflectance, waves[0].reflectance, rtol=1e-4, atol=1e-7)
