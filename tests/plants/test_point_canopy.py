"""Canopies from point clouds: pulses through known media, terrain, and the sum of points."""

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.io import PointCloud

BOTTOM, TOP, WIDTH = 5.0, 15.0, 40.0


def first_returns(extinction, *, pulses, seed, zenith=0.0, ground=0.0):
    """Points of pulses with one return each, through a slab of that extinction (1/m) over level ground.

    Free paths are exponential; pulses of the zenith angle have paths longer by 1 / cos.
    """
    random = np.random.default_rng(seed)
    depth = random.exponential(1.0 / extinction, pulses) * np.cos(np.deg2rad(zenith))
    is_ground = depth > TOP - BOTTOM
    height = np.where(is_ground, ground, TOP - depth)
    position = np.column_stack([random.uniform(0.0, WIDTH, (pulses, 2)), height])
    numbers = np.ones(pulses, int)
    angle = np.full(pulses, zenith)
    return PointCloud(
        position, np.where(is_ground, 2, 5), numbers, numbers, 20.0 * numbers, {}, scan_angle=angle
    )


def gap_z(extinction, cloud, zenith, pulses):
    """z-value of the mean gap along the pulses against that of the medium, with its binomial error.

    The mean of gaps is without bias; that of their logarithms, the plant area, is not where returns are few.
    """
    cosine = np.cos(np.deg2rad(zenith))
    gap = np.exp(-extinction * (TOP - BOTTOM) / cosine)
    estimate = np.exp(-0.5 * cloud.density.sum(axis=2) / cosine).mean()
    return (estimate - gap) / np.sqrt(gap * (1.0 - gap) / pulses)


@pytest.mark.parametrize("zenith", [0.0, 30.0])
def test_gaps_of_a_slab(zenith):
    points = first_returns(0.12, pulses=48_000, seed=3, zenith=zenith)
    cloud = jl.canopy_from_points(points)
    assert abs(gap_z(0.12, cloud, zenith, 48_000)) < 3.0
    # Plant area has a bias of a few per cent, from columns of few returns.
    assert cloud.density.sum(axis=2).mean() == pytest.approx(2.4, rel=0.05)
    if zenith:
        without_angle = jl.canopy_from_points(points._replace(scan_angle=None))
        assert gap_z(0.12, without_angle, zenith, 48_000) < -5.0


def test_standard_errors_cover_the_density_of_voxels():
    points = first_returns(0.1, pulses=16_000, seed=1)
    cloud = jl.canopy_from_points(points, origin=(0.0, 0.0, 0.0), shape=(40, 40, 16))
    inside = (slice(5, -5), slice(5, -5), slice(5, 15))
    z = (cloud.density[inside] - 0.2) / cloud.stderr[inside]
    assert 0.9 < np.mean(np.abs(z) < 2.0) < 0.995
    # Errors of half the size would not.
    assert np.mean(np.abs(2.0 * z) < 2.0) < 0.9
    assert np.all(cloud.stderr > 0)
    # Below an opaque layer nothing is seen.
    assert np.isfinite(cloud.stderr).all()


def tilted(x, y):
    return 100.0 + 0.15 * x - 0.1 * y


def test_terrain_is_that_of_ground_returns():
    random = np.random.default_rng(0)
    place = random.uniform(0.0, 30.0, (600, 2))
    height = tilted(*place.T) + random.normal(0.0, 0.05, 600)
    numbers = np.ones(600, int)
    cloud = jl.canopy_from_points(
        PointCloud(np.column_stack([place, height]), 2 * numbers, numbers, numbers, 1.0 * numbers, {})
    )
    x, y = np.meshgrid(np.linspace(1.0, 29.0, 15), np.linspace(1.0, 29.0, 15))
    error = np.asarray(cloud.terrain.height_at(x, y)) - tilted(x, y)
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert not np.any(cloud.density)


def unclassified_stand(random, returns=12_000):
    """Points without classes: a slope, and boxes of leaves 3 m across and 6 m high with few gaps."""
    place = random.uniform(0.0, 40.0, (returns, 2))
    is_tree = np.all(place % 8.0 < 3.0, axis=1) & (random.uniform(size=returns) < 0.8)
    above = np.where(is_tree, random.uniform(2.0, 6.0, returns), 0.0)
    numbers = np.ones(returns, int)
    position = np.column_stack([place, tilted(*place.T) + above + random.normal(0.0, 0.03, returns)])
    return PointCloud(position, 0 * numbers, numbers, numbers, 1.0 * numbers, {}), is_tree


def test_ground_is_found_where_nothing_is_classified():
    points, _ = unclassified_stand(np.random.default_rng(2))
    cloud = jl.canopy_from_points(points)
    x, y = np.meshgrid(np.linspace(2.0, 38.0, 19), np.linspace(2.0, 38.0, 19))
    error = np.asarray(cloud.terrain.height_at(x, y)) - tilted(x, y)
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert np.abs(error).max() < 0.5


def test_a_classified_cloud_without_ground_has_no_terrain():
    points, _ = unclassified_stand(np.random.default_rng(2), returns=500)
    cloud = jl.canopy_from_points(points._replace(classification=np.full(500, 5)))
    assert cloud.terrain is None


@pytest.mark.slow
def test_a_simulation_is_close_to_the_sum_of_points():
    """First order, with leaves as bright as the ground: 2/3 of their reflectance is the ground's."""
    random = np.random.default_rng(4)
    place = random.uniform(0.0, 40.0, (9000, 2))
    crown = np.maximum(0.0, 1.0 - np.sum(((place % 10.0) - 5.0) ** 2, axis=1) / 16.0)
    is_ground = random.uniform(size=9000) > 0.9 * (crown > 0)
    height = np.where(is_ground, 0.0, 3.0 + 9.0 * crown - random.exponential(1.5, 9000) * (crown > 0))
    height = np.maximum(height, 0.0)
    numbers = np.ones(9000, int)
    points = PointCloud(
        np.column_stack([place, height]), np.where(is_ground, 2, 5), numbers, numbers, 1.0 * numbers, {}
    )
    cloud = jl.canopy_from_points(points)
    canopy = jl.Canopy(cloud.voxels, leaf=jl.LeafOptics(0.45, 0.45))
    lidar = jl.Lidar(altitude=1000.0, divergence=11.0, position=(20.0, 20.0), pulse=jl.GaussianPulse(12.0))
    scene = jl.Scene(canopy=canopy, ground=cloud.terrain)
    wave = jl.simulate(lidar, scene, key=jax.random.key(0), rtol=0.05, max_orders=1)
    irradiance = np.exp(-2.0 * np.sum((place - 20.0) ** 2, axis=1) / 5.5**2)
    sigma = 12.0 / 2.3548 * 0.1499
    above = np.asarray(wave.height)[:, None] - height
    total = np.exp(-0.5 * (above / sigma) ** 2) @ irradiance
    assert np.corrcoef(total, np.asarray(wave.reflectance)[0])[0, 1] > 0.99
    cover = 1.0 - float(wave.components["ground"].sum() / wave.reflectance.sum())
    assert cover == pytest.approx(1.0 - irradiance[is_ground].sum() / irradiance.sum(), abs=0.03)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": np.zeros((0, 3))}, "holds no point"),
        ({"position": np.full((4, 3), np.nan)}, "points.position"),
        ({"return_number": np.zeros(4, int)}, "points.return_number"),
        ({"classification": np.ones(3, int)}, "points.classification has shape"),
        ({"scan_angle": np.full(4, 200.0)}, "points.scan_angle"),
    ],
)
def test_points_that_are_no_returns_are_refused(change, message):
    numbers = np.ones(4, int)
    points = PointCloud(np.zeros((4, 3)), numbers, numbers, numbers, 1.0 * numbers, {})
    with pytest.raises(ValueError, match=message):
        jl.canopy_from_points(points._replace(**change))
    with pytest.raises(ValueError, match="voxel_size"):
        jl.canopy_from_points(points, 0.0)
    with pytest.raises(TypeError, match="points"):
        jl.canopy_from_points(np.zeros((4, 3)))
