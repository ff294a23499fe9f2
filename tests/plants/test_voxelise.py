"""Voxel maps of trees and points: volumes, areas and positions against geometry.

Sums over voxels are exact by construction (1e-6, single precision). The amount in one voxel is sampled, to a
few per cent of the voxel, and compared with integrals in closed form.
"""

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar import Tree, voxelise, voxelise_points

NO_POSITIONS = np.zeros((0, 3))


def one_segment(start, end, a, b=None):
    """A tree of one branch segment with the end radii a and b (None: a cylinder)."""
    return Tree(
        start=np.array([start], float),
        end=np.array([end], float),
        radius_start=np.array([a], float),
        radius_end=np.array([a if b is None else b], float),
        parent=np.array([-1]),
        order=np.array([0]),
        bud_position=NO_POSITIONS,
        bud_direction=NO_POSITIONS,
        bud_radius=np.zeros(0),
    )


def clumps_only(*positions, radius=0.06):
    """A tree of leaf clumps without wood."""
    n = len(positions)
    return Tree(
        start=NO_POSITIONS,
        end=NO_POSITIONS,
        radius_start=np.zeros(0),
        radius_end=np.zeros(0),
        parent=np.zeros(0, int),
        order=np.zeros(0, int),
        bud_position=np.array(positions, float).reshape(n, 3),
        bud_direction=np.tile([0.0, 0.0, 1.0], (n, 1)),
        bud_radius=np.full(n, radius),
    )


def probability(extinction, edge):
    """Probability that a ray of length `edge` meets matter of this extinction coefficient."""
    return -np.expm1(-np.asarray(extinction, float) * edge)


SEGMENTS = {
    "upright": ((0.1, 0.1, 0.0), (0.1, 0.1, 3.0), 0.2, 0.05),
    "level": ((-1.0, 0.3, 2.0), (1.3, 0.3, 2.0), 0.03, 0.03),
    "slanting": ((0.0, 0.0, 0.0), (1.0, 2.0, 1.5), 0.1, 0.02),
    "widening": ((0.0, 0.0, 0.0), (0.2, 0.1, 1.5), 0.02, 0.1),
    "within a voxel": ((0.1, 0.1, 0.1), (0.12, 0.13, 0.15), 0.004, 0.003),
    "without a length": ((0.1, 0.1, 0.1), (0.1, 0.1, 0.1), 0.02, 0.02),
}


@pytest.mark.parametrize("name", SEGMENTS)
@pytest.mark.parametrize("edge", [0.25, (0.5, 0.3, 0.2)])
def test_wood_keeps_its_volume(name, edge):
    tree = one_segment(*SEGMENTS[name])
    p = probability(voxelise(tree, edge).bark, np.broadcast_to(edge, 3)[2])
    assert np.all((p >= 0) & (p <= 1))
    assert p.sum() * np.prod(np.broadcast_to(edge, 3)) == pytest.approx(tree.wood_volume, rel=1e-5, abs=1e-15)


def test_the_volume_lies_where_the_wood_is():
    """A quarter of a cylinder in each of four voxels, half of its length in each of two layers."""
    p = probability(voxelise(one_segment((1.0, 1.0, 0.5), (1.0, 1.0, 1.5), 0.3), 1.0, samples=16).bark, 1.0)
    assert p.shape == (2, 2, 2)
    np.testing.assert_allclose(p, np.pi * 0.3**2 / 8, rtol=0.06)
    # The part of a disc beyond a line at half its radius: (pi/3 - sqrt(3)/4) r^2.
    p = probability(voxelise(one_segment((0.85, 0.5, 0.0), (0.85, 0.5, 1.0), 0.3), 1.0, samples=16).bark, 1.0)
    assert p[1, 0, 0] == pytest.approx((np.pi / 3 - np.sqrt(3) / 4) * 0.3**2, rel=0.02)


def test_a_trunk_is_solid_inside_and_the_error_at_its_side_is_as_stated():
    tree = one_segment((0.5, 0.5, 0.0), (0.5, 0.5, 2.0), 0.5)
    fine = probability(voxelise(tree, 0.05, samples=4).bark, 0.05)
    # Sixty-four small voxels make up one large one.
    exact = fine.reshape(5, 4, 5, 4, 10, 4).mean(axis=(1, 3, 5))
    coarse = probability(voxelise(tree, 0.2).bark, 0.2)
    error = coarse - exact
    assert np.sqrt(np.mean(error**2)) < 0.015
    assert coarse[2, 2, 5] == pytest.approx(1.0, abs=0.02)


def test_clumps_fill_their_spheres():
    positions = [(0.0, 0.0, 0.0), (0.4, 0.1, 2.0), (0.125, 0.125, 1.0)]
    tree = clumps_only(*positions, radius=0.1)
    p = probability(voxelise(tree, 0.25).leaf, 0.25)
    assert p.sum() * 0.25**3 == pytest.approx(3 * 4 / 3 * np.pi * 1e-3, rel=1e-5)
    # The first sits on a corner of the grid: an eighth in each voxel around.
    octants = probability(voxelise(clumps_only(positions[0], radius=0.1), 0.25, samples=30).leaf, 0.25)
    np.testing.assert_allclose(octants, np.pi / 6 * 1e-3 / 0.25**3, rtol=0.03)


def test_the_radius_of_clumps_changes_coverage():
    tree = clumps_only((0.12, 0.12, 0.12))
    small, large = (
        probability(voxelise(t, 0.25).leaf, 0.25).sum() for t in (tree, tree.with_bud_radius(0.12))
    )
    assert large == pytest.approx(8 * small, rel=1e-5)


def test_leaf_area_is_kept():
    tree = clumps_only((0.1, 0.2, 0.3), (1.0, 1.1, 1.2), radius=0.2)
    voxels = voxelise(tree, 0.25, leaf_area=0.03)
    assert 2 * float(voxels.leaf.sum()) * 0.25**3 == pytest.approx(2 * 0.03, rel=1e-5)


def test_surface_of_wood_is_kept_where_it_is_thin():
    tree = one_segment((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.01)
    thin = voxelise(tree, 0.25, wood="surface")
    lateral = 2 * np.pi * 0.01 * np.sqrt(3)
    assert 4 * float(thin.bark.sum()) * 0.25**3 == pytest.approx(lateral, rel=1e-5)
    # Inside thick wood there is no surface, but it is opaque all the same.
    thick = voxelise(one_segment((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.6), 0.2, wood="surface")
    assert probability(thick.bark, 0.2)[3, 3, 2] > 0.98


def test_several_trees_make_one_map_of_the_sum():
    trunk, clump = one_segment((0.0, 0.0, 0.0), (0.0, 0.0, 2.0), 0.1), clumps_only((3.0, 1.0, 2.5))
    together = voxelise([trunk, clump], 0.25)
    p, q = probability(together.bark, 0.25), probability(together.leaf, 0.25)
    assert p.sum() * 0.25**3 == pytest.approx(trunk.wood_volume, rel=1e-5)
    assert q.sum() * 0.25**3 == pytest.approx(clump.clump_volume, rel=1e-5)
    # The trunk alone, in the same grid.
    origin = tuple(np.asarray(together.origin).tolist())
    alone = voxelise(trunk, 0.25, origin=origin, shape=together.shape)
    np.testing.assert_allclose(alone.bark, together.bark, rtol=1e-6)


def test_overlapping_wood_spreads_to_neighbours_and_its_volume_is_conserved():
    post = one_segment((0.5, 0.5, 0.0), (0.5, 0.5, 1.0), 0.3)
    twice = probability(voxelise([post, post], 0.2, origin=(-1.0, -1.0, -1.0), shape=(15, 15, 15)).bark, 0.2)
    assert np.all(twice <= 1.0)
    assert twice.sum() * 0.2**3 == pytest.approx(2 * post.wood_volume, rel=1e-3)
    np.testing.assert_allclose(twice, twice[::-1], atol=1e-6)
    with pytest.raises(ValueError, match="voxels of material"):
        voxelise([post] * 8, 0.2)


@pytest.mark.parametrize("habit", [jl.broadleaf, jl.shrub])
def test_a_grown_tree_keeps_its_volumes(habit):
    """Volumes of frustums and spheres are those of the tree to 1 %, for its joints overlap."""
    tree = jl.grow(habit())
    voxels = voxelise(tree, 0.25)
    for extinction, exact in ((voxels.bark, tree.wood_volume), (voxels.leaf, tree.clump_volume)):
        assert probability(extinction, 0.25).sum() * 0.25**3 == pytest.approx(exact, rel=0.01)
    assert voxelise(tree.leafless(), 0.25).leaf is None


def test_faces_lie_at_multiples_of_the_edge():
    voxels = voxelise(one_segment((0.3, -1.1, 2.05), (0.3, -1.1, 2.6), 0.04), 0.25)
    np.testing.assert_allclose(np.asarray(voxels.origin) / 0.25, np.round(np.asarray(voxels.origin) / 0.25))
    assert voxels.shape == (1, 1, 3)


def test_empty_layers_are_trimmed():
    k = np.zeros((5, 6, 7))
    k[1, 2, 3], k[3, 2, 5] = 0.5, 0.1
    voxels = jl.VoxelMap.from_extinction(
        leaf=k, bark=0 * k, voxel_size=(1.0, 2.0, 3.0), origin=(10.0, 0.0, -3.0)
    )
    trimmed = voxels.trimmed()
    assert trimmed.shape == (3, 1, 3)
    np.testing.assert_allclose(trimmed.origin, [11.0, 4.0, 6.0])
    np.testing.assert_allclose(trimmed.leaf, k[1:4, 2:3, 3:6])
    assert jl.VoxelMap.from_extinction(leaf=0 * k, voxel_size=1.0).trimmed().shape == (1, 1, 1)


def test_points_divide_the_leaf_area():
    rng = np.random.default_rng(2)
    points = rng.uniform(0, [1.0, 2.0, 3.0], (3000, 3))
    on_wood = points[:, 0] < 0.25
    voxels = voxelise_points(points, 0.5, leaf_area=4.0, is_wood=on_wood, wood_probability=0.7)
    assert 2 * float(voxels.leaf.sum()) * 0.5**3 == pytest.approx(4.0, rel=1e-5)
    # Half of the points of the first column of voxels lie on wood, and none of the next.
    np.testing.assert_allclose(probability(voxels.bark, 0.5)[0], 0.7, rtol=1e-5)
    np.testing.assert_allclose(voxels.bark[1], 0.0)
    sparse = voxelise_points(points[:5], 0.5, leaf_area=4.0)
    assert np.count_nonzero(sparse.leaf) <= 5


def test_a_point_on_the_upper_face_counts():
    voxels = voxelise_points(np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]), 1.0, leaf_area=2.0)
    assert 2 * float(voxels.leaf.sum()) == pytest.approx(2.0)


@pytest.mark.slow
def test_a_voxelised_tree_is_simulated():
    tree = Tree.joined(
        [one_segment((0.0, 0.0, 0.0), (0.0, 0.0, 4.0), 0.2, 0.05), clumps_only((0.1, 0.0, 4.2), radius=0.3)]
    )
    leaf = jl.LeafOptics(reflectance=0.4, transmittance=0.3)
    scene = jl.Scene(
        canopy=jl.Canopy(voxelise(tree, 0.1), leaf=leaf, bark=0.3, hotspot=False), ground=jl.Ground()
    )
    wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0), max_orders=1, footprint="fixed")
    sums = {name: float(component.sum()) for name, component in wave.components.items()}
    assert all(sums[name] > 0 for name in ("leaf", "bark", "ground"))


TREE, POINTS = one_segment((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.1), np.zeros((2, 3))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: voxelise(TREE, 0.0), "voxel_size = 0"),
        (lambda: voxelise(TREE, (0.1, np.nan, 0.1)), "voxel_size = nan"),
        (lambda: voxelise(TREE, 0.1, leaf_area=-1.0), "leaf_area = -1"),
        (lambda: voxelise(TREE, 0.1, samples=0), "samples = 0"),
        (lambda: voxelise(TREE, 0.1, wood="solid"), "wood = 'solid'"),
        (lambda: voxelise(TREE, 0.1, origin=(0.0, 0.0, 0.0)), "belong together"),
        (lambda: voxelise(TREE, 0.1, origin=(0.0, 0.0, 0.0), shape=(5, 5, 5)), "out of the grid"),
        (lambda: voxelise(clumps_only(), 0.1), "neither wood nor clumps"),
        (lambda: voxelise_points(POINTS, 0.1, leaf_area=-1.0), "leaf_area = -1"),
        (lambda: voxelise_points(POINTS, 0.1, leaf_area=1.0, min_points=3), "3 or more leaf points"),
        (lambda: voxelise_points(POINTS, 0.1, leaf_area=1.0, wood_probability=1.5), "wood_probability = 1.5"),
        (lambda: voxelise_points(NO_POSITIONS, 0.1, leaf_area=1.0), r"points has shape \(0, 3\)"),
        (lambda: voxelise_points(POINTS * np.nan, 0.1, leaf_area=1.0), "points = nan"),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_copies_on_the_nodes_of_the_fine_grid_are_those_of_direct_voxelisation():
    """Places and azimuths that need no rounding, in map coordinates; others conserve the leaf area."""
    shrub = jl.grow(jl.shrub(height=1.0, stems=1))
    random = np.random.default_rng(0)
    place = np.round(random.uniform(0.0, 6.0, (12, 3)) * [1, 1, 0] / 0.125) * 0.125
    azimuth = 90.0 * (np.arange(12) % 4)
    how = {"leaf_area": 0.001, "wood": "surface"}
    copies = jl.voxelise(jl.Stand(shrub, place, azimuth=azimuth), 0.5, **how)
    trees = [shrub.translated(-shrub.base).rotated(a).translated(p) for p, a in zip(place, azimuth)]
    direct = jl.voxelise(trees, 0.5, **how)
    np.testing.assert_array_equal(copies.origin, direct.origin)
    np.testing.assert_allclose(copies.leaf, direct.leaf, rtol=1e-5, atol=1e-6)
    # Points on wood differ, as the fine grid is aligned with the copy.
    assert np.allclose(copies.bark.sum(), direct.bark.sum(), rtol=1e-4)
    far = np.add(place, (5e5 + 0.03, 5.2e6 - 0.04, 0.0))
    shifted = jl.voxelise(jl.Stand(shrub, far, azimuth=17.0 + azimuth), 0.5, **how)
    area = 2.0 * float(np.asarray(shifted.leaf, float).sum()) * 0.5**3
    assert np.isclose(area, 12 * 0.001 * len(shrub.bud_position), rtol=1e-5)
    # A copy that is moved by a voxel is another map.
    other = jl.voxelise(jl.Stand(shrub, np.add(place, (0.125, 0, 0)), azimuth=azimuth), 0.5, **how)
    assert other.shape != direct.shape or not np.allclose(other.leaf, direct.leaf)


def test_copies_of_several_individuals_and_refused_arguments():
    small, tall = (jl.grow(jl.shrub(height=h, stems=1)) for h in (1.0, 2.0))
    place = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    stand = jl.voxelise(jl.Stand([small, tall], place, np.array([1, 0])), 0.5, leaf_area=0.001)
    area = 2.0 * float(np.asarray(stand.leaf, float).sum()) * 0.5**3
    assert np.isclose(area, 0.001 * (len(small.bud_position) + len(tall.bud_position)), rtol=1e-5)
    assert float(stand.top[2]) >= tall.height
    with pytest.raises(ValueError, match=r"individual = 2 is outside the admissible range \[0, 1\]"):
        jl.Stand([small, tall], place, np.array([2, 0]))
    with pytest.raises(ValueError, match=r"position has shape \(0, 3\)"):
        jl.Stand(small, np.zeros((0, 3)))
    with pytest.raises(ValueError, match="individuals is empty"):
        jl.Stand([], place)
