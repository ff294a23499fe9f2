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
from tests.helpers import slow_unless

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


# Terrain that is level to the west of x = 0 and rises by 45 degrees to the east.
BEND = np.array([0.0, 0.0, 0.0, 10.0, 20.0])[:, None] * np.ones(2)
RADIUS, OFFSET = 5.0, 1.0
# Energy per metre of the line x = 0 across a footprint of this radius, whose middle is 1 m to the east.
PER_METRE = {
    "top-hat": 2.0 * np.sqrt(RADIUS**2 - OFFSET**2) / (np.pi * RADIUS**2),
    "gaussian": np.sqrt(2.0 / np.pi) / RADIUS * np.exp(-2.0 * (OFFSET / RADIUS) ** 2),
}


@pytest.mark.parametrize(
    ("profile", "from_sensor"),
    slow_unless(
        [("gaussian", True)],
        [("top-hat", False), ("gaussian", True), ("top-hat", True), ("gaussian", False)],
    ),
)
def test_the_return_changes_as_a_footprint_moves_over_a_bend(profile, from_sensor):
    """By rho (cos 45 - 1) times the energy that crosses the bend: only the slope differs on both sides.

    Planted: 0, the derivative of rays that move with the beam.
    """
    scene = jl.Scene(ground=jl.Terrain(BEND, spacing=(10.0, 80.0), origin=(-20.0, -40.0), reflectance=0.5))
    beam = {"divergence": 2.0 * RADIUS, "profile": profile}

    def lidar_at(x):
        place = jnp.stack([x, jnp.zeros_like(x)])
        if from_sensor:
            return jl.Lidar(**beam, sensor=jnp.append(place, 1000.0))
        return jl.Lidar(**beam, altitude=1000.0, position=place)

    window = (6500.0, 6900.0) if from_sensor else (-150.0, 150.0)
    start = jnp.asarray(OFFSET)
    plan = jl.plan(lidar_at(start), scene, max_orders=1, n_rays=4096, window=window)

    @jax.jit
    def derivative(key):
        def total(x):
            return jl.simulate(lidar_at(x), scene, plan=plan, key=key).reflectance.sum()

        return jax.grad(total)(start)

    by_key = np.array([derivative(key) for key in jax.random.split(jax.random.key(1), 12)])
    expected = 0.5 * (np.sqrt(0.5) - 1.0) * PER_METRE[profile]
    # Rays of the beam's cone meet the slope a little farther up or down.
    allowance = 4.0 * by_key.std(ddof=1) / np.sqrt(by_key.size) + 0.01 * abs(expected)
    assert abs(by_key.mean() - expected) < allowance
    assert abs(expected) > 5.0 * allowance
