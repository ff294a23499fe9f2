"""Derivatives of the higher orders in thin voxels, against differences to a little leaf there.

Means over keys are compared by z-tests. The first order, which has no noise, is left out.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.trace.derivatives import higher_order_replay
from jaxlidar.trace.device_scene import build_device_scene
from jaxlidar.trace.march.thin_voxels import ThinVoxels
from jaxlidar.trace.march.voxel_traversal import Medium
from tests.helpers import agrees

RANDOM = np.random.default_rng(0)
LEAF, BARK = (
    RANDOM.uniform(0.2, largest, (3, 3, 4)) * (RANDOM.uniform(size=(3, 3, 4)) < 0.6) for largest in (1.0, 0.4)
)
MAP = {"voxel_size": 1.0, "origin": (-1.5, -1.25, 0.5)}
STEP, N_KEYS = 0.06, 16


def leaf_and_bark(leaf, bark, optics=(0.45, 0.4), **canopy):
    voxels = jl.VoxelMap.from_extinction(leaf=leaf, bark=bark, **MAP)
    return jl.Scene(
        canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(*optics), bark=0.3, **canopy),
        ground=jl.Ground(reflectance=0.5),
    )


def periodic(leaf, bark):
    return leaf_and_bark(leaf, bark, sides="periodic")


def with_plate(leaf, bark):
    plate = jl.Plate(height=2.1, reflectance=0.3, transmittance=0.3, coverage=0.5)
    return eqx.tree_at(lambda s: s.plates, leaf_and_bark(leaf, bark), (plate,))


def planophile(leaf, bark):
    voxels = jl.VoxelMap.from_lad(leaf, leaf_angles="planophile", **MAP)
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4))
    return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.5))


def three_colours(leaf, bark):
    optics = jnp.array([0.1, 0.3, 0.5]), jnp.array([0.05, 0.3, 0.45])
    return leaf_and_bark(leaf, bark, optics)


def problem(build, orders, zenith=12.0, wavelength=1064.0, n_photons=8192):
    """Return a function of leaf, bark and a key, which is linear in the higher orders; and its plan."""
    leaf, bark = (jnp.asarray(a, float) for a in (LEAF, BARK))
    lidar = jl.Lidar(divergence=2.0, zenith=zenith, wavelength=wavelength)
    plan = jl.plan(
        lidar, build(leaf, bark), max_orders=orders, n_rays=16, n_photons=8 * n_photons, window=(-60.0, 40.0)
    )

    def loss(leaf, bark, key):
        setup = jl.make_setup(lidar, build(leaf, bark), plan)
        response = jl.trace_scene(setup, key)
        response = eqx.tree_at(lambda r: r.first, response, jnp.zeros_like(response.first))
        samples = jnp.sum(jl.total_reflectance(response, setup), axis=0)
        return jnp.sum(samples * jnp.cos(0.05 * jnp.arange(samples.size)))

    return loss, plan


def gradients(loss, material, voxels, tables=(LEAF, BARK)):
    """Return the gradient in some voxels, for each of some keys."""
    start = [jnp.asarray(a, float) for a in tables]
    gradient = jax.jit(jax.grad(lambda *arguments: loss(*arguments), argnums=material))
    keys = jax.random.split(jax.random.key(3), N_KEYS)
    return np.asarray([np.asarray(gradient(*start, k), float)[tuple(voxels.T)] for k in keys])


def differences(loss, material, voxels, n_keys, tables=(LEAF, BARK)):
    """Return one-sided differences of second order in some voxels, for each of some keys."""
    start, value = [jnp.asarray(a, float) for a in tables], jax.jit(loss)

    def with_extinction(voxel, k, key):
        tables = list(start)
        tables[material] = tables[material].at[tuple(voxel)].set(k)
        return float(value(*tables, key))

    result = []
    for key in jax.random.split(jax.random.key(4), n_keys):
        none = float(value(*start, key))
        steps = [[with_extinction(v, s * STEP, key) for s in (1, 2)] for v in voxels]
        result.append([(4.0 * one - two - 3.0 * none) / (2.0 * STEP) for one, two in steps])
    return np.asarray(result)


CASES = [
    ("leaf", leaf_and_bark, 0, {"orders": 2, "zenith": 0.0}),
    pytest.param("leaf, many orders", leaf_and_bark, 0, {"orders": 12}, marks=pytest.mark.slow),
    pytest.param("bark", leaf_and_bark, 1, {"orders": 4}, marks=pytest.mark.slow),
    pytest.param("periodic", periodic, 0, {"orders": 4}, marks=pytest.mark.slow),
    pytest.param("plate", with_plate, 0, {"orders": 4}, marks=pytest.mark.slow),
    pytest.param("leaf angles", planophile, 0, {"orders": 4}, marks=pytest.mark.slow),
    pytest.param(
        "optics applied",
        three_colours,
        0,
        {"orders": 40, "wavelength": (500.0, 800.0, 1100.0)},
        marks=pytest.mark.slow,
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "build", "material", "options"), CASES)
def test_gradients_are_those_of_differences(name, build, material, options, monkeypatch):
    voxels = np.argwhere((LEAF, BARK)[material] == 0.0)[[0, 6]]
    loss, plan = problem(build, **options)
    assert plan.config.keeps_histories == (name != "optics applied")
    estimates = gradients(loss, material, voxels)
    expected = differences(loss, material, voxels, n_keys=2 * N_KEYS)
    stderr = np.sqrt(np.var(estimates, axis=0) / (N_KEYS - 1) + np.var(expected, axis=0) / (2 * N_KEYS - 1))
    mean, expected = estimates.mean(axis=0), expected.mean(axis=0)
    assert agrees(mean, stderr, expected, sigmas=3.5)
    # Planted: attenuation alone, nothing is scattered.
    monkeypatch.setattr(ThinVoxels, "add_to_tables", lambda self, tables, placed, values: tables)
    attenuation = gradients(loss, material, voxels).mean(axis=0)
    assert not agrees(attenuation, stderr, expected, sigmas=5.0)


def with_little_leaf(k):
    """Return the tables of leaf and bark, with the extinction `k` of leaf where there is none."""
    return [jnp.asarray(a, float) for a in (np.where(LEAF == 0.0, k, LEAF), BARK)]


def test_voxels_with_next_to_no_leaf_have_the_gradient_of_empty_ones(monkeypatch):
    """Of the same paths, which hardly change: in all of them, photons collide too rarely to tell."""
    loss, _ = problem(leaf_and_bark, orders=2)
    gradient, key = jax.jit(jax.grad(loss)), jax.random.key(1)
    empty, least, little = (gradient(*with_little_leaf(k), key)[LEAF == 0.0] for k in (0.0, 1e-9, 1e-3))
    largest = np.max(np.abs(empty))
    np.testing.assert_allclose(least, empty, atol=1e-4 * largest)
    np.testing.assert_allclose(little, empty, atol=0.02 * largest)
    # Planted: attenuation alone, nothing is scattered.
    monkeypatch.setattr(ThinVoxels, "add_to_tables", lambda self, tables, placed, values: tables)
    attenuation = jax.jit(jax.grad(lambda *a: loss(*a)))(*with_little_leaf(0.0), key)[LEAF == 0.0]
    assert np.max(np.abs(attenuation - empty)) > 0.1 * largest


@pytest.mark.slow
def test_without_thin_voxels_the_gradient_lacks_what_hardly_any_photon_meets(monkeypatch):
    """Planted: only voxels of exactly zero extinction are thin. Forward mode is wrong alike."""
    loss, _ = problem(leaf_and_bark, orders=2)
    key, tables = jax.random.key(1), with_little_leaf(1e-9)
    direction = [jnp.asarray(LEAF == 0.0, float), jnp.zeros_like(tables[1])]

    def both():
        pushed = jax.jit(lambda *a: jax.jvp(lambda *a: loss(*a, key), a, tuple(direction))[1])(*tables)
        return float(pushed), float(jnp.sum(jax.jit(jax.grad(loss))(*tables, key) * direction[0]))

    forward, reverse = both()
    assert forward == pytest.approx(reverse, rel=2e-4)
    monkeypatch.setattr(Medium, "is_thin", lambda self, k: k == 0.0)
    wrong_forward, wrong_reverse = both()
    assert wrong_forward == pytest.approx(wrong_reverse, rel=2e-4)
    assert abs(wrong_reverse - reverse) > 0.2 * abs(reverse)


@pytest.mark.slow
def test_voxels_around_the_occupied_ones_attenuate(monkeypatch):
    """Flights are followed in the box of occupied voxels alone; their derivatives are not."""
    leaf = np.zeros_like(LEAF)
    leaf[1, 1, 1] = 0.8
    tables, voxels = (leaf, np.zeros_like(BARK)), np.array([(1, 1, 3), (1, 1, 0), (0, 1, 2)])
    loss, _ = problem(leaf_and_bark, orders=4)
    estimates = gradients(loss, 0, voxels, tables)
    expected = differences(loss, 0, voxels, 3 * N_KEYS, tables)
    stderr = np.sqrt(np.var(estimates, axis=0) / (N_KEYS - 1) + np.var(expected, axis=0) / (3 * N_KEYS - 1))
    expected = expected.mean(axis=0)
    assert agrees(estimates.mean(axis=0), stderr, expected, sigmas=3.5)
    # Planted: flights attenuate nothing there.
    monkeypatch.setattr(
        higher_order_replay, "_subtract_flights", lambda scene, medium, tables, *arguments: tables
    )
    assert not agrees(gradients(loss, 0, voxels, tables).mean(axis=0), stderr, expected, sigmas=5.0)
    start = [jnp.asarray(a, float) for a in tables]
    direction = [
        jnp.asarray(np.random.default_rng(5).normal(size=leaf.shape), float),
        jnp.zeros_like(start[1]),
    ]
    monkeypatch.undo()
    key = jax.random.key(1)
    pushed = jax.jit(lambda t: jax.jvp(lambda *a: loss(*a, key), start, t)[1])(direction)
    gradient = jax.jit(jax.grad(lambda *a: loss(*a, key)))(*start)
    assert float(pushed) == pytest.approx(float(jnp.sum(gradient * direction[0])), rel=2e-4)


@pytest.mark.slow
def test_forward_mode_has_the_same_term():
    """Along directions in empty voxels alone, forward mode gives the product with the gradient."""
    loss, _ = problem(leaf_and_bark, orders=5, n_photons=2048)
    start, key = [jnp.asarray(a, float) for a in (LEAF, BARK)], jax.random.key(1)
    directions = [
        jnp.asarray(np.random.default_rng(n).normal(size=a.shape) * (a == 0.0), float)
        for n, a in enumerate((LEAF, BARK))
    ]
    pushed = jax.jit(lambda t: jax.jvp(lambda *a: loss(*a, key), start, t)[1])(directions)
    gradient = jax.jit(jax.grad(lambda *a: loss(*a, key), argnums=(0, 1)))(*start)
    expected = sum(float(jnp.sum(g * d)) for g, d in zip(gradient, directions))
    assert float(pushed) == pytest.approx(expected, rel=2e-4)
    assert abs(expected) > 1e-3


def test_tables_of_thin_voxels():
    """The second map is 1 where the first one is thin; room behind the map is not."""
    leaf, bark = (jnp.asarray(a, float) for a in (LEAF, BARK))
    scene, lidar = leaf_and_bark(leaf, bark), jl.Lidar()
    plan = jl.plan(lidar, scene, max_orders=2, n_rays=16, n_photons=128)
    device_scene = build_device_scene(jl.make_setup(lidar, scene, plan))
    thin_voxels = ThinVoxels.of(device_scene)
    assert int(thin_voxels.are_thin.sum()) == np.sum(LEAF == 0.0) + np.sum(BARK == 0.0)
    n = thin_voxels.n_cells
    assert n > LEAF.size
    medium, with_second = device_scene.medium, thin_voxels.scene.medium
    assert medium is not None
    assert with_second is not None
    np.testing.assert_array_equal(with_second.leaf[:n], medium.leaf)
    np.testing.assert_array_equal(with_second.leaf[n:], thin_voxels.are_thin[:n])
    np.testing.assert_array_equal(with_second.bark[n:], thin_voxels.are_thin[n:])
    np.testing.assert_allclose(with_second.total, with_second.leaf + with_second.bark)
