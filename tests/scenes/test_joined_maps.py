"""Voxel maps that are joined: what is resampled keeps its amount, its place and its turn."""

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxlidar as jl

RANDOM = np.random.default_rng(2)


def random_map(shape, size, origin, **options):
    lad, bark = RANDOM.uniform(0.0, 2.0, (2, *shape))
    return jl.VoxelMap.from_lad(lad, bark=bark, voxel_size=size, origin=origin, **options)


def moments(voxels, name):
    """Area, m2, and its mean position, m."""
    k = np.asarray(getattr(voxels, name), float) * np.prod(np.asarray(voxels.voxel_size, float))
    axes = [
        o + d * (np.arange(n) + 0.5)
        for o, d, n in zip(np.asarray(voxels.origin), np.asarray(voxels.voxel_size, float), voxels.shape)
    ]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return k.sum(), np.einsum("ijk,ijka->a", k, places) / k.sum()


def test_maps_of_the_same_voxels_stay_as_they_are():
    """In map coordinates, and from parts that touch; planted: faces that rounding moves to the next voxel."""
    whole = random_map((7, 5, 4), (0.3, 0.3, 0.7), (4e5 + 0.1, 5.3e6 + 0.7, 312.4))

    def part(rows, first):
        origin = np.asarray(whole.origin) + 0.3 * first * np.array([1.0, 0.0, 0.0])
        return jl.VoxelMap(whole.leaf[rows], whole.bark[rows], whole.voxel_size, origin, crs="EPSG:25832")

    for joined in (
        jl.VoxelMap.join([whole]),
        jl.VoxelMap.join([part(slice(0, 3), 0), part(slice(3, 7), 3)]),
        jl.VoxelMap.join([part(slice(3, 7), 3), part(slice(0, 3), 0)]),
    ):
        assert joined.shape == whole.shape
        np.testing.assert_allclose(joined.leaf, whole.leaf, rtol=1e-5)
        np.testing.assert_allclose(joined.bark, whole.bark, rtol=1e-5)
        np.testing.assert_allclose(joined.origin, whole.origin, atol=1e-6)
    assert joined.crs == "EPSG:25832"


@pytest.mark.parametrize("azimuth", [0.0, 30.0, -75.5, 180.0])
@pytest.mark.parametrize("size", [None, (1.0, 0.8, 2.0), 0.35])
def test_amounts_and_their_places_are_conserved(azimuth, size):
    """A clockwise turn by a about the corner puts east (1, 0) at (cos a, -sin a); planted: the other sense.

    Where matter is within a voxel is not known: the mean place moves by less than the points are apart.
    """
    first = random_map((4, 3, 5), (0.5, 0.7, 0.4), (-3.0, 10.0, 1.0))
    second = random_map((6, 2, 3), (0.9, 1.1, 0.6), (40.0, 5.0, 0.3))
    joined = jl.VoxelMap.join([first, second], size, azimuth=(0.0, azimuth))
    a = np.deg2rad(azimuth)
    turn = np.array([[np.cos(a), np.sin(a), 0.0], [-np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
    for name in ("leaf", "bark"):
        (amount, place), (other_amount, other_place) = moments(first, name), moments(second, name)
        corner = np.asarray(second.origin)
        other_place = corner + turn @ (other_place - corner)
        expected = (amount * place + other_amount * other_place) / (amount + other_amount)
        total, mean = moments(joined, name)
        np.testing.assert_allclose(total, amount + other_amount, rtol=1e-5)
        # Means are taken over centres of voxels, as if each were full.
        edges = np.asarray(joined.voxel_size)
        assert np.all(np.abs(mean - expected) < 0.25 * edges)


def test_a_quarter_turn_is_exact():
    voxels = random_map((3, 4, 2), 1.0, (10.0, 20.0, 0.0))
    turned = jl.VoxelMap.join([voxels], azimuth=90.0)
    # North becomes east, and east becomes south of the corner.
    assert turned.shape == (4, 3, 2)
    np.testing.assert_allclose(turned.origin, [10.0, 17.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(turned.leaf, np.rot90(np.asarray(voxels.leaf), -1), rtol=1e-5)


@pytest.mark.parametrize("size", [1.0, (0.6, 0.25, 1.0), 0.1, 2.0])
def test_voxels_within_a_turned_map_keep_their_density(monkeypatch, size):
    """In small and large voxels; planted: 8 points along edges of 1 m leave holes between voxels of 0.1 m."""
    monkeypatch.setattr("jaxlidar.scenes.voxels._POINTS_AT_ONCE", 10_000)
    even = jl.VoxelMap.from_lad(np.ones((20, 20, 2)), voxel_size=1.0)
    turned = jl.VoxelMap.join([even], size, azimuth=20.0)
    middle = (moments(turned, "leaf")[1] - np.asarray(turned.origin)) / np.asarray(turned.voxel_size)
    reach = 6.0 / np.asarray(turned.voxel_size)
    around = (slice(int(m - r), int(m + r) + 1) for m, r in zip(middle[:2], reach))
    np.testing.assert_allclose(np.asarray(turned.leaf)[*around], 0.5, rtol=0.1)


def test_a_scene_of_two_joined_plots_returns_the_light_of_both():
    lad = np.full((4, 4, 3), 0.8)
    maps = [jl.VoxelMap.from_lad(lad, voxel_size=1.0, origin=(x, 0.0, 0.0)) for x in (0.0, 30.0)]
    leaf = jl.LeafOptics(0.4, 0.3)
    joined = jl.Scene(canopy=jl.Canopy(jl.VoxelMap.join(maps), leaf=leaf))
    options = {"key": jax.random.key(0), "max_orders": 1, "n_rays": 64}
    for voxels, x in zip(maps, (2.0, 32.0)):
        lidar = jl.Lidar(position=(x, 2.0))
        both = jl.simulate(lidar, joined, **options).reflectance.sum()
        alone = jl.simulate(lidar, jl.Scene(canopy=jl.Canopy(voxels, leaf=leaf)), **options).reflectance.sum()
        np.testing.assert_allclose(both, alone, rtol=1e-4)


MAP = jl.VoxelMap.from_lad(np.ones((1, 1, 1)), voxel_size=1.0)


@pytest.mark.parametrize(
    ("maps", "options", "error", "message"),
    [
        ([], {}, ValueError, "maps is empty"),
        ([3], {}, TypeError, "one of maps is an int"),
        ([MAP], {"voxel_size": 0.0}, ValueError, "voxel_size = 0 is outside"),
        ([MAP], {"azimuth": np.nan}, ValueError, "azimuth = nan"),
        ([MAP], {"azimuth": (1.0, 2.0)}, ValueError, r"azimuth has shape \(2,\)"),
        (
            [MAP, eqx.tree_at(lambda v: v.origin, MAP, np.array([4e5, 5.3e6, 0.0]))],
            {},
            ValueError,
            "are their coordinates those of one map",
        ),
        (
            [MAP, jl.VoxelMap.from_lad(np.ones((1, 1, 1)), voxel_size=1.0, leaf_angles="planophile")],
            {},
            ValueError,
            r"maps\[1\].leaf_angles differ",
        ),
    ],
)
def test_maps_that_cannot_be_joined_are_refused(maps, options, error, message):
    with pytest.raises(error, match=message):
        jl.VoxelMap.join(maps, **options)


def test_maps_are_joined_outside_of_transformations():
    def area(density):
        voxels = eqx.tree_at(lambda v: v.leaf, MAP, density * MAP.leaf)
        return jl.VoxelMap.join([voxels]).leaf.sum()

    with pytest.raises(ValueError, match="a JAX transformation is tracing a map"):
        jax.grad(area)(1.0)
