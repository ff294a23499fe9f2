"""Loops compiled as one function, and values computed once: same values and derivatives, fewer kernels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar._jax.one_function import barrier, one_function
from jaxlidar.trace.march.voxel_traversal import make_medium, march_to_depths

KEY = jax.random.key(0)


def flight(extinction, *, reverse):
    """Return optical depth and end points of 64 rays from the middle of a map."""
    voxels = jl.VoxelMap.from_extinction(leaf=extinction, voxel_size=1.0, origin=(-2.0, -2.0, 0.0))
    medium = make_medium(jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4), hotspot=False), jnp.zeros(3))
    direction = jax.random.normal(KEY, (3, 64))
    direction = tuple(direction / jnp.linalg.norm(direction, axis=0, keepdims=True))
    start = tuple(jnp.full(64, v) for v in (0.1, 0.2, 2.3))
    targets = jnp.linspace(0.1, 2.0, 64)[None]
    limit, active = jnp.full(64, 1e6), jnp.ones(64, bool)
    return march_to_depths(medium, start, direction, targets, limit, active, 32, reverse=reverse)


@pytest.fixture
def extinction():
    return jnp.asarray(np.random.default_rng(0).uniform(0, 0.6, (4, 4, 4)), jnp.zeros(()).dtype)


@pytest.mark.slow
def test_a_flight_in_one_function_is_the_same(extinction):
    plain, marked = (jax.jit(lambda k, r=r: flight(k, reverse=r))(extinction) for r in (True, False))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), plain, marked)


def test_derivatives_in_one_function_are_the_same(extinction):
    def depth(k, reverse):
        return jnp.sum(flight(k, reverse=reverse).total_depth)

    forward = jax.jit(jax.jacfwd(lambda k: depth(k, False)))(extinction)
    backward = jax.jit(jax.grad(lambda k: depth(k, True)))(extinction)
    assert float(jnp.max(backward)) > 1.0
    np.testing.assert_allclose(forward, backward, rtol=1e-4, atol=1e-4)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="kernels of processors")
def test_a_loop_becomes_one_function():
    def loop(x):
        # Large enough that XLA does not inline it by itself.
        return jax.lax.fori_loop(0, 16, lambda _, x: jnp.sin(x) + 0.5 * x[::-1], x)

    text = jax.jit(one_function(loop)).lower(jnp.ones(4096)).compile().as_text()
    _, _, program = text.partition("ENTRY")
    assert " call(" in program, program
    assert " while(" not in program, program


@pytest.mark.slow
def test_a_scene_can_be_traced_for_forward_derivatives_alone():
    lidar = jl.Lidar(divergence=10.0)
    voxels = jl.VoxelMap.from_extinction(
        leaf=np.full((2, 2, 2), 0.3), voxel_size=1.0, origin=(-1.0, -1.0, 1.0)
    )
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4), hotspot=False)
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3))
    setup = jl.make_setup(lidar, scene, jl.plan(lidar, scene, max_orders=3, n_photons=2048))
    totals = []
    for reverse in (True, False):
        response = jax.jit(lambda key, r=reverse: jl.trace_scene(setup, key, reverse=r))(KEY)
        totals.append(jl.total_reflectance(response, setup))
    np.testing.assert_allclose(*totals, rtol=1e-4, atol=1e-6)
    with pytest.raises(TypeError, match="reverse"):
        jl.trace_scene(setup, KEY, reverse="no")


def shared(x, hold):
    """Two results of one value, laid out so that one loop cannot give both."""
    y = hold(jnp.abs(x) * x + x)
    return y[::-1] + 1.0, jnp.sum(y.reshape(8, -1), axis=0), jnp.cumsum(y)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="kernels of processors")
def test_values_are_computed_once():
    """With the optimisation barrier; without it, older compilers compute them for each result."""

    def count(hold):
        return jax.jit(lambda x: shared(x, hold)).lower(jnp.ones(4096)).compile().as_text().count(" abs(")

    assert count(barrier) == 1
    assert jax.__version_info__ >= (0, 12) or count(lambda y: y) > 1


def test_values_computed_once_have_their_derivatives():
    x = jnp.linspace(0.5, 2.0, 16)
    plain, held = (
        lambda x, h=h: jnp.sum(jnp.stack([jnp.sum(a) for a in shared(x, h)])) for h in (lambda y: y, barrier)
    )
    np.testing.assert_allclose(held(x), plain(x), rtol=1e-6)
    np.testing.assert_allclose(jax.grad(held)(x), jax.grad(plain)(x), rtol=1e-5)
    np.testing.assert_allclose(jax.jacfwd(held)(x), jax.jacfwd(plain)(x), rtol=1e-5)
