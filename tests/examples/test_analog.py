"""The analog estimator of the paper, against the closed form and against `simulate`."""

import importlib.util
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxlidar as jl
from tests.helpers import agrees, slab, slow_unless

PATH = Path(__file__).resolve().parents[2] / "examples" / "paper" / "_analog.py"
spec = importlib.util.spec_from_file_location("paper_analog", PATH)
analog = importlib.util.module_from_spec(spec)
spec.loader.exec_module(analog)

LIDAR = jl.Lidar(altitude=1000.0, divergence=1.0)
CONE = 8.0


def total(lidar, scene, n_photons, *, seed=0, cone=CONE, **planned):
    """Return mean and standard error of the apparent reflectance, by independent photons."""
    plan = jl.plan(lidar, scene, **planned)
    returns = analog.analog_returns(
        lidar, scene, plan, key=jax.random.key(seed), n_photons=n_photons, cone=cone
    )
    weight = np.asarray(returns.weight, float)
    assert np.all(np.isfinite(weight))
    assert np.all(np.isfinite(returns.time))
    return weight.mean(axis=1), weight.std(axis=1, ddof=1) / np.sqrt(n_photons)


@pytest.mark.parametrize("angles", slow_unless([], ["planophile", "erectophile"]))
def test_leaf_angles_agree_with_simulate(angles):
    voxels = jl.VoxelMap.from_lad(
        np.full((1, 1, 4), 0.2), voxel_size=(50, 50, 2.5), origin=(-25, -25, 0), leaf_angles=angles
    )
    leaf = jl.LeafOptics(reflectance=0.45, transmittance=0.35)
    scene = jl.Scene(
        canopy=jl.Canopy(voxels, leaf=leaf, sides="periodic", hotspot=False),
        ground=jl.Ground(reflectance=0.4),
    )
    value, stderr = total(LIDAR, scene, 60_000, max_orders=4, cone=12.0)
    wave = jl.simulate(LIDAR, scene, key=jax.random.key(1), rtol=0.02, max_orders=4)
    expected = float(np.sum(wave.reflectance))
    assert agrees(value, stderr + 0.003 * expected, expected)
    assert not agrees(value, stderr + 0.003 * expected, 1.3 * expected)


def test_a_level_lambertian_ground_returns_its_reflectance():
    value, stderr = total(LIDAR, jl.Scene(ground=jl.Ground(reflectance=0.5)), 40_000)
    assert agrees(value, stderr, 0.5)
    assert not agrees(value, stderr, 0.6)


def test_returns_arrive_at_the_two_way_travel_time():
    scene = jl.Scene(ground=jl.Ground(height=-3.0, reflectance=0.5))
    plan = jl.plan(LIDAR, scene)
    returns = analog.analog_returns(LIDAR, scene, plan, key=jax.random.key(0), n_photons=2000)
    returned = np.asarray(returns.weight[0]) > 0
    assert np.allclose(np.asarray(returns.time)[returned], 2 * 3.0 / 0.299792458, atol=0.01)


@pytest.mark.slow
def test_a_plate_over_ground_agrees_with_simulate():
    lidar = jl.Lidar(wavelength=(532.0, 1064.0))
    plate = jl.Plate(height=2.0, reflectance=[0.36, 0.66], transmittance=[0.08, 0.30])
    scene = jl.Scene(plates=(plate,), ground=jl.Ground(reflectance=[0.10, 0.75]))
    value, stderr = total(lidar, scene, 200_000, max_orders=8)
    wave = jl.simulate(lidar, scene, key=jax.random.key(1), rtol=0.003, max_orders=8)
    expected = np.sum(wave.reflectance, axis=1)
    assert agrees(value, stderr, expected)
    # The same test rejects the plate without the ground.
    assert not agrees(value, stderr, [0.36, 0.66])


@pytest.mark.parametrize("transmission", slow_unless([], ["diffuse", "straight"]))
def test_a_slab_agrees_with_simulate(transmission):
    leaf = jl.LeafOptics(reflectance=0.45, transmittance=0.35)
    canopy = jl.Canopy(slab(leaf=1.0), leaf=leaf, transmission=transmission, sides="periodic", hotspot=False)
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.4))
    value, stderr = total(LIDAR, scene, 150_000, max_orders=8)
    wave = jl.simulate(LIDAR, scene, key=jax.random.key(1), rtol=0.01, max_orders=8)
    expected = float(np.sum(wave.reflectance))
    # `simulate` takes the return path along the beam; over the cone, its transmittance varies by 1 % at most.
    assert agrees(value, stderr + 0.003 * expected, expected)
    assert not agrees(value, stderr + 0.003 * expected, float(np.sum(wave.components["first"])))


def test_paths_lead_down_to_the_ground_and_up_again():
    lidar = jl.Lidar(divergence=1.0, position=(3.0, -2.0))
    scene = jl.Scene(ground=jl.Ground(height=-3.0, reflectance=0.5))
    plan = jl.plan(lidar, scene)
    points = np.asarray(
        analog.photon_paths(lidar, scene, plan, key=jax.random.key(0), n_photons=100, leaving=4.0)
    )
    assert points.shape == (100, 3, 3)
    assert np.allclose(points[:, 1, 2], -3.0, atol=1e-4)
    assert np.all(points[:, 0, 2] >= -3.0)
    assert np.all(points[:, 2, 2] > -3.0)
    assert np.allclose(np.linalg.norm(points[:, 2] - points[:, 1], axis=1), 4.0, atol=1e-4)
    assert np.allclose(points[:, 1, :2].mean(axis=0), [3.0, -2.0], atol=0.15)


def test_bad_input_is_refused():
    scene = jl.Scene(ground=jl.Ground())
    plan = jl.plan(LIDAR, scene)
    for cone in (0.0, 91.0, np.nan):
        with pytest.raises(ValueError, match="cone"):
            analog.analog_returns(LIDAR, scene, plan, key=jax.random.key(0), n_photons=10, cone=cone)
    with pytest.raises(ValueError, match="n_photons"):
        analog.analog_returns(LIDAR, scene, plan, key=jax.random.key(0), n_photons=0)
    leaf = jl.LeafOptics(reflectance=0.45, transmittance=0.35)
    hot = jl.Scene(canopy=jl.Canopy(slab(leaf=1.0), leaf=leaf, hotspot=True))
    with pytest.raises(ValueError, match="hotspot"):
        analog.analog_returns(LIDAR, hot, jl.plan(LIDAR, hot), key=jax.random.key(0), n_photons=10)
    straight = jl.Scene(canopy=jl.Canopy(slab(leaf=1.0), leaf=leaf, transmission="straight", hotspot=False))
    two = jl.Lidar(wavelength=(532.0, 1064.0))
    with pytest.raises(ValueError, match="straight"):
        analog.analog_returns(two, straight, jl.plan(two, straight), key=jax.random.key(0), n_photons=10)
    deep = jl.Scene(canopy=jl.Canopy(slab(leaf=1.0), leaf=leaf, hotspot=False), ground=jl.Ground())
    many_orders = jl.plan(LIDAR, deep, max_orders=300, describe=False)
    with pytest.raises(ValueError, match="300 orders, too many to keep histories"):
        analog.analog_returns(LIDAR, deep, many_orders, key=jax.random.key(0), n_photons=10)
