"""Derivatives with respect to everything that moves rays and grids against each other, in order one.

The return jumps where a ray crosses from one column of voxels, or one cell of terrain, to the next. Automatic
differentiation is compared with central differences at the same keys. A wrong answer that the comparison
rejects is the derivative at fixed rays, and the measured one before rays moved with all grids: with respect
to the divergence 50 times too large over terrain, with respect to the position of the wrong sign.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl

KEYS, STEPS = 6, {"divergence": 0.1, "position": 0.1, "map": 0.1, "size": 0.05, "relief": 0.05}
START = {"divergence": 2.0, "position": 0.0, "map": 0.0, "size": 1.0, "relief": 1.0}
RANDOM = np.random.default_rng(2)
LEAF = RANDOM.uniform(0, 0.6, (8, 8, 2)) * (RANDOM.uniform(size=(8, 8, 1)) > 0.5)
X, Y = np.meshgrid(np.arange(-10.0, 11.0), np.arange(-8.0, 9.0), indexing="ij")
HILLS = 1.5 * np.sin(0.8 * X + 0.3) * np.cos(0.6 * Y)
# Zenith, degrees; canopy; terrain; the parameter.
CASES = [
    (0.0, True, False, "divergence"),
    (25.0, False, True, "divergence"),
    (0.0, False, True, "position"),
    (25.0, True, True, "position"),
    (0.0, True, True, "size"),
    (25.0, True, True, "map"),
    (25.0, True, True, "relief"),
    (25.0, True, True, "divergence"),
]


def build(case, p):
    zenith, has_canopy, has_terrain, _ = case
    lidar = jl.Lidar(
        divergence=p["divergence"], zenith=zenith, azimuth=90.0, pulse=jl.GaussianPulse(fwhm=3.0)
    )
    position = jnp.stack([p["position"], jnp.zeros_like(p["position"])])
    lidar = eqx.tree_at(lambda v: v.position, lidar, position)
    # Faces of voxels are 0.13 m away from edges of cells: where both coincide, derivatives have two sides.
    origin = jnp.stack([p["map"] - 1.87, jnp.asarray(-1.87), jnp.asarray(3.0)])
    size = jnp.stack([0.5 * p["size"], 0.5 * p["size"], jnp.asarray(1.0)])
    voxels = jl.VoxelMap.from_extinction(leaf=LEAF, voxel_size=size, origin=origin)
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(reflectance=0.4, transmittance=0.3))
    ground = jl.Ground(reflectance=0.4)
    if has_terrain:
        ground = jl.Terrain(jnp.asarray(HILLS) * p["relief"], 1.0, (-10.0, -8.0), reflectance=0.4)
    return lidar, jl.Scene(canopy=canopy if has_canopy else None, ground=ground)


def derivatives(case):
    """Return derivatives of the total return and of its first moment, by AD and by differences, by key."""
    name = case[-1]
    start = {key: jnp.asarray(value) for key, value in START.items()}
    plan = jl.plan(*build(case, start), max_orders=1, window=(-80.0, 80.0), n_rays=4096)

    def measure(value, key):
        setup = jl.make_setup(*build(case, start | {name: value}), plan)
        total = jl.total_reflectance(jl.trace_scene(setup, key, reverse=False), setup)[0]
        return jnp.stack([jnp.sum(total), jnp.sum(total * jnp.arange(total.size)) / 50.0])

    value, jacobian = jax.jit(measure), jax.jit(jax.jacfwd(measure))
    keys, middle, step = jax.random.split(jax.random.key(1), KEYS), start[name], STEPS[name]
    exact = np.array([jacobian(middle, key) for key in keys])
    sides = [np.array([value(middle + s, key) for key in keys]) for s in (-step, step)]
    return exact, (sides[1] - sides[0]) / (2 * step)


@pytest.mark.slow
@pytest.mark.parametrize(("zenith", "has_canopy", "has_terrain", "name"), CASES)
def test_derivatives_agree_with_differences(zenith, has_canopy, has_terrain, name):
    exact, difference = derivatives((zenith, has_canopy, has_terrain, name))
    # Keys are the same on both sides.
    stderr = (exact - difference).std(axis=0, ddof=1) / np.sqrt(KEYS)
    # Truncation error of the central difference, of second order in the step.
    margin = 5.0 * stderr + 0.015 * np.abs(difference.mean(axis=0)) + 2e-4
    error = exact.mean(axis=0) - difference.mean(axis=0)
    assert np.all(np.abs(error) < margin), (exact.mean(axis=0), difference.mean(axis=0), stderr)
    wrong = 1.5 * exact.mean(axis=0) - difference.mean(axis=0)
    assert np.any(np.abs(wrong) > margin)
