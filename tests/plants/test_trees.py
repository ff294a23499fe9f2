"""Trees: Table 2, da Vinci's rule at every node, habits, individuals and forests."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import jaxlidar as jl
from tests.helpers import slow_unless

HABITS = {"broadleaf": jl.broadleaf, "conifer": jl.conifer, "spreading": jl.spreading_tree, "shrub": jl.shrub}
SEEDS, MORE_SEEDS = (0, 1), (2, 11)


@pytest.fixture(scope="module")
def individuals():
    return {name: [jl.grow(make(), seed=seed) for seed in SEEDS] for name, make in HABITS.items()}


def excess_at_nodes(tree, exponent=2.0):
    """Relative excess over da Vinci's rule, sum of d_i^p over d^p less 1, at each segment with children."""
    is_child = tree.parent >= 0
    n = len(tree.parent)
    sum_of_children = np.bincount(tree.parent[is_child], tree.radius_start[is_child] ** exponent, minlength=n)
    is_node = np.bincount(tree.parent[is_child], minlength=n) > 0
    return sum_of_children[is_node] / tree.radius_end[is_node] ** exponent - 1


@pytest.mark.parametrize("seed", slow_unless(range(2), range(6)))
def test_the_default_is_table_2(seed):
    tree = jl.grow(seed=seed)
    assert tree.height == pytest.approx(15.0, rel=0.01)
    assert tree.trunk_diameter == pytest.approx(0.89, rel=1e-12)
    assert tree.smallest_diameter == pytest.approx(0.03, rel=1e-9)
    assert np.allclose(2 * tree.bud_radius, 0.06)
    # Leaves included: the topmost shoots reach little higher than the wood.
    assert (tree.bud_position + tree.bud_radius[:, None])[:, 2].max() == pytest.approx(15.0, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("name", HABITS)
def test_sizes_are_met_by_every_individual(name, individuals):
    habit = HABITS[name]()
    for tree in [*individuals[name], *(jl.grow(habit, seed=seed) for seed in MORE_SEEDS)]:
        assert tree.height == pytest.approx(habit.height, rel=1e-6)
        assert tree.trunk_diameter == pytest.approx(habit.trunk_diameter, rel=1e-12)
        assert tree.smallest_diameter == pytest.approx(habit.smallest_diameter, rel=1e-9)
        assert np.allclose(2 * tree.bud_radius, habit.clump_diameter)
        assert min(tree.start[:, 2].min(), tree.end[:, 2].min()) >= 0
        assert np.all(tree.bud_position[:, 2] >= tree.bud_radius)
        assert tree.roots.sum() == habit.stems
        assert np.allclose(tree.base, 0)


@pytest.mark.parametrize("name", HABITS)
def test_da_vincis_rule_holds_at_every_node(name, individuals):
    for tree in individuals[name]:
        excess = excess_at_nodes(tree)
        assert len(excess) > 200
        assert np.abs(excess).max() < 1e-9


@pytest.mark.slow
def test_da_vincis_exponent_is_a_parameter():
    tree = jl.grow(jl.broadleaf(exponent=2.4), seed=1)
    assert np.abs(excess_at_nodes(tree, 2.4)).max() < 1e-9
    # The excess distinguishes the exponents.
    assert np.abs(excess_at_nodes(tree, 2.0)).max() > 0.05


@pytest.mark.parametrize("name", HABITS)
def test_segments_start_where_their_parents_end(name, individuals):
    for tree in individuals[name]:
        is_child = ~tree.roots
        parent = tree.parent[is_child]
        assert np.array_equal(tree.start[is_child], tree.end[parent])
        step = tree.order[is_child] - tree.order[parent]
        assert np.all((step == 0) | (step == 1))
        assert np.all(tree.order[tree.roots] == 0)
        assert np.all(tree.length > 0)
        # At most one of the children continues the same axis.
        assert np.bincount(parent[step == 0]).max() == 1


@pytest.mark.parametrize("name", HABITS)
def test_twigs_end_at_the_smallest_diameter_and_bear_the_buds(name, individuals):
    tree = individuals[name][0]
    habit = HABITS[name]()
    tips = np.setdiff1d(np.arange(len(tree.parent)), tree.parent)
    assert np.allclose(2 * tree.radius_end[tips], habit.smallest_diameter)
    assert len(tree.bud_radius) == len(tips) * habit.shoots * habit.shoot_buds
    # Each tip ends with at least the smallest cross-section, and nodes conserve it.
    max_tips = np.sum(tree.radius_start[tree.roots] ** 2) / (0.5 * habit.smallest_diameter) ** 2
    assert max_tips / 2 < len(tips) <= max_tips * (1 + 1e-9)
    nearest = np.min(
        np.linalg.norm(tree.bud_position[::97, None] - tree.end[None, tips], axis=2), axis=1, initial=np.inf
    )
    assert nearest.max() < habit.shoot_length + tree.length[tips].max() * habit.pieces


def test_seeds_make_individuals():
    tree, repeated, different = (jl.grow(seed=seed) for seed in (5, 5, 6))
    for name in ("start", "end", "radius_start", "parent", "bud_position", "bud_direction"):
        assert np.array_equal(getattr(tree, name), getattr(repeated, name))
    assert tree.end.shape != different.end.shape or not np.allclose(tree.end, different.end)
    assert not np.allclose(tree.end[:9], different.end[:9])


def test_habits_differ_as_their_names_say(individuals):
    """Conifers are conical with a straight trunk, shrubs have nine stems, spreading trees are the widest."""

    def widths(tree):
        """Mean distance of the wood from the axis, in the lower and the upper half of the crown."""
        tips = np.setdiff1d(np.arange(len(tree.parent)), tree.parent)
        z, distance = tree.end[tips, 2], np.hypot(tree.end[tips, 0], tree.end[tips, 1])
        middle = 0.5 * (z.min() + z.max())
        return distance[z < middle].mean(), distance[z >= middle].mean()

    for tree in individuals["conifer"]:
        low, high = widths(tree)
        assert low > 1.7 * high
        trunk = tree.order == 0
        assert np.hypot(*tree.end[trunk, :2].T).max() < 0.06 * tree.height
    for tree in individuals["shrub"]:
        assert tree.roots.sum() == 9
    width_of_broadleaf, width_of_spreading = (
        np.mean([np.ptp(t.end[:, :2], axis=0).mean() / t.height for t in individuals[name]])
        for name in ("broadleaf", "spreading")
    )
    assert width_of_spreading > 1.0 > width_of_broadleaf


def test_laterals_have_the_angle_of_their_branching_to_the_axis():
    branching = jl.Branching(angle=40.0, angle_spread=0.0, bend=0.0, tropism=0.0)
    tree = jl.grow(jl.Habit(trunk=branching, branches=branching), seed=2)
    direction = (tree.end - tree.start) / tree.length[:, None]
    child = np.flatnonzero(~tree.roots)
    # For each segment, the child that continues its axis.
    continuation = np.zeros(len(tree.parent), dtype=int)
    continues = child[tree.order[child] == tree.order[tree.parent[child]]]
    continuation[tree.parent[continues]] = continues
    lateral = child[tree.order[child] > tree.order[tree.parent[child]]]
    cosine = np.sum(direction[lateral] * direction[continuation[tree.parent[lateral]]], axis=1)
    assert np.allclose(np.rad2deg(np.arccos(cosine)), 40.0, atol=1e-4)


def test_leaf_off_keeps_the_wood(individuals):
    tree = individuals["broadleaf"][0]
    bare = tree.leafless()
    assert len(bare.bud_radius) == 0
    assert bare.clump_volume == 0
    assert bare.start is tree.start
    assert bare.wood_volume == tree.wood_volume
    without_shoots = jl.grow(jl.broadleaf(shoots=0))
    assert np.array_equal(without_shoots.end, tree.end)
    assert len(without_shoots.bud_radius) == 0


def test_no_leaves_grow_in_the_ground():
    hanging = jl.Branching(angle=90.0, tropism=-25.0)
    tree = jl.grow(jl.spreading_tree(branches=hanging, height=3.0), seed=0)
    assert tree.end[:, 2].min() < 0
    assert tree.bud_position[:, 2].min() >= 0.03
    assert len(tree.bud_position) == len(tree.bud_direction) == len(tree.bud_radius) > 0


def test_bud_radius_changes_cover(individuals):
    tree = individuals["broadleaf"][0]
    assert np.isclose(tree.with_bud_radius(0.06).clump_volume, 8 * tree.clump_volume)


def frustum_and_cylinder(**changes):
    """A tapering trunk, a level branch, and a clump at its end; `changes` replace fields of the tree."""
    fields = {
        "start": np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 4.0]]),
        "end": np.array([[0.0, 0.0, 4.0], [0.0, 4.0, 4.0]]),
        "radius_start": np.array([0.2, 0.1]),
        "radius_end": np.array([0.1, 0.1]),
        "parent": np.array([-1, 0]),
        "order": np.array([0, 1]),
        "bud_position": np.array([[1.0, 4.0, 4.0]]),
        "bud_direction": np.array([[0.0, 1.0, 0.0]]),
        "bud_radius": np.array([0.5]),
    }
    return jl.Tree(**{**fields, **changes})


def test_volumes_are_those_of_frustums_and_spheres():
    tree = frustum_and_cylinder()
    assert np.isclose(tree.wood_volume, np.pi / 3 * 3 * (0.04 + 0.02 + 0.01) + np.pi * 0.01 * 4)
    assert np.isclose(tree.clump_volume, 4 / 3 * np.pi * 0.125)
    assert (tree.height, tree.trunk_diameter, tree.smallest_diameter) == (3.0, 0.4, 0.2)


def test_moves_turns_and_sizes():
    tree = frustum_and_cylinder()
    moved = tree.translated((1.0, 2.0, 3.0))
    assert np.allclose(moved.base, [1, 2, 4])
    assert np.allclose(moved.bud_position, [[2, 6, 7]])
    # The branch to the north then leads east: azimuths are clockwise.
    turned = tree.rotated(90.0)
    assert np.allclose(turned.end[1], [4, 0, 4])
    assert np.allclose(turned.bud_position, [[4, -1, 4]])
    assert np.allclose(turned.bud_direction, [[1, 0, 0]])
    half = tree.scaled(0.5)
    assert half.height == 1.5
    assert np.isclose(half.wood_volume, tree.wood_volume / 8)
    assert np.isclose(half.clump_volume, tree.clump_volume / 8)


def test_trees_join():
    tree = frustum_and_cylinder()
    joined = jl.Tree.joined([tree, tree.translated((9.0, 0.0, 0.0)), tree.leafless()])
    assert joined.parent.tolist() == [-1, 0, -1, 2, -1, 4]
    assert np.isclose(joined.wood_volume, 3 * tree.wood_volume)
    assert len(joined.bud_radius) == 2


def test_a_forest_has_its_density_and_minimum_distance():
    trees = jl.forest(jl.shrub(shoots=0), density=600.0, area=(50.0, 30.0), minimum_distance=2.5, seed=4)
    assert len(trees) == 90
    position = np.array([tree.base for tree in trees])
    assert np.all((position >= 0) & (position <= [50, 30, 0]))
    gap = np.linalg.norm(position[:, None] - position[None], axis=2)[np.triu_indices(90, 1)]
    assert 2.5 <= gap.min() < 3.0
    repeated = jl.forest(jl.shrub(shoots=0), density=600.0, area=(50.0, 30.0), minimum_distance=2.5, seed=4)
    assert all(np.array_equal(a.end, b.end) for a, b in zip(trees, repeated, strict=True))


def test_without_a_minimum_distance_positions_are_uniform():
    bush = jl.shrub(shoots=0, stems=1, smallest_diameter=0.05)
    trees = jl.forest(bush, density=1e4, area=(40.0, 20.0), minimum_distance=0.0, origin=(5.0, -3.0, 7.0))
    position = np.array([tree.base for tree in trees])
    assert stats.kstest(position[:, 0], stats.uniform(5.0, 40.0).cdf).pvalue > 1e-3
    assert stats.kstest(position[:, 1], stats.uniform(-3.0, 20.0).cdf).pvalue > 1e-3
    assert np.allclose(position[:, 2], 7.0)


def test_a_forest_mixes_habits_by_shares_and_sizes():
    tall, low = (jl.shrub(shoots=0, stems=1, height=h, smallest_diameter=0.04) for h in (10.0, 1.0))
    trees = jl.forest(
        [tall, low],
        density=1e4,
        area=(40.0, 20.0),
        minimum_distance=0.2,
        shares=(3, 1),
        size=(0.8, 1.2),
        seed=1,
    )
    height = np.array([tree.height for tree in trees])
    assert abs(np.mean(height > 5) - 0.75) < 4 * np.sqrt(0.75 * 0.25 / 800)
    assert len(np.unique(height.round(6))) == 16
    # Eight trees, each grown for itself.
    trees = jl.forest(low, density=100, area=(40, 20), size=(0.5, 1), individuals=None)
    heights = [tree.height for tree in trees]
    assert len(set(heights)) == 8
    assert 0.5 <= min(heights) <= max(heights) <= 1.0


@pytest.mark.slow
def test_a_hundred_default_trees():
    trees = jl.forest(density=400.0, area=(50.0, 50.0), minimum_distance=3.0, individuals=2)
    assert len(trees) == 100
    assert all(abs(tree.height - 15.0) < 0.15 for tree in trees)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: jl.Habit(height=-1.0), "height = -1 is outside"),
        (lambda: jl.Habit(trunk_diameter=np.nan), "trunk_diameter = nan is outside"),
        (lambda: jl.Habit(smallest_diameter=1.0), "smallest_diameter = 1 is outside .* \\(0, 0.89\\]"),
        (lambda: jl.Habit(smallest_diameter=0.0), "smallest_diameter = 0 is outside"),
        (lambda: jl.Habit(clump_diameter=0.0), "clump_diameter = 0 is outside"),
        (lambda: jl.Habit(exponent=0.0), "exponent = 0 is outside"),
        (lambda: jl.Habit(length_exponent=-1.0), "length_exponent = -1 is outside"),
        (lambda: jl.Habit(bole=1.0), "bole = 1 is outside"),
        (lambda: jl.Habit(stems=0), "stems = 0 is outside"),
        (lambda: jl.Habit(stem_angle=100.0), "stem_angle = 100 is outside"),
        (lambda: jl.Habit(pieces=0), "pieces = 0 is outside"),
        (lambda: jl.Habit(twig=0.0), "twig = 0 is outside"),
        (lambda: jl.Habit(shoots=-1), "shoots = -1 is outside"),
        (lambda: jl.Habit(shoot_length=0.0), "shoot_length = 0 is outside"),
        (lambda: jl.Habit(shoot_angle=181.0), "shoot_angle = 181 is outside"),
        (lambda: jl.Habit(shoot_buds=0), "shoot_buds = 0 is outside"),
        (lambda: jl.Branching(laterals=0), "laterals = 0 is outside"),
        (lambda: jl.Branching(share=(0.2, 1.5)), "share = 1.5 is outside"),
        (lambda: jl.Branching(share=(0.5, 0.2)), "share = .* is not \\(low, high\\)"),
        (lambda: jl.Branching(angle=190.0), "angle = 190 is outside"),
        (lambda: jl.Branching(angle_spread=-1.0), "angle_spread = -1 is outside"),
        (lambda: jl.Branching(divergence=np.inf), "divergence = inf is outside"),
        (lambda: jl.Branching(bend=-1.0), "bend = -1 is outside"),
        (lambda: jl.Branching(tropism=np.nan), "tropism = nan is outside"),
        (lambda: frustum_and_cylinder(start=np.full((2, 3), np.nan)), "start = nan is outside"),
        (lambda: frustum_and_cylinder(end=np.full((2, 3), np.inf)), "end = inf is outside"),
        (lambda: frustum_and_cylinder(radius_start=np.array([0.1, 0.0])), "radius_start = 0 is outside"),
        (lambda: frustum_and_cylinder(radius_end=np.array([0.1, -1.0])), "radius_end = -1 is outside"),
        (lambda: frustum_and_cylinder(bud_radius=np.array([0.0])), "bud_radius = 0 is outside"),
        (lambda: frustum_and_cylinder(bud_direction=np.full((1, 3), 2.0)), "length of bud_direction = 3.46"),
        (lambda: frustum_and_cylinder(parent=np.array([-1, 1])), "parent = 1 of segment 1 is outside"),
        (lambda: frustum_and_cylinder(parent=np.array([-2, 0])), "parent = -2 is outside"),
        (lambda: frustum_and_cylinder(order=np.array([0, -1])), "order = -1 is outside"),
        (lambda: frustum_and_cylinder().scaled(0.0), "factor = 0 is outside"),
        (lambda: frustum_and_cylinder().translated((0.0, 0.0, np.nan)), "offset = nan is outside"),
        (lambda: frustum_and_cylinder().rotated(np.inf), "angle = inf is outside"),
        (lambda: frustum_and_cylinder().with_bud_radius(0.0), "radius = 0 is outside"),
        (lambda: jl.Tree.joined([]), "trees is empty"),
        (lambda: jl.forest(density=0.0, area=(9.0, 9.0)), "density = 0 is outside"),
        (lambda: jl.forest(density=1.0, area=(0.0, 9.0)), "area = 0 is outside"),
        (lambda: jl.forest(density=1.0, area=(9.0, 9.0), minimum_distance=-1.0), "minimum_distance = -1 is"),
        (lambda: jl.forest([], density=1.0, area=(9.0, 9.0)), "habits is empty"),
        (lambda: jl.forest(density=1.0, area=(9.0, 9.0), shares=(1, 1)), "shares has 2 elements"),
        (lambda: jl.forest(density=1.0, area=(9.0, 9.0), shares=(-1,)), "shares = -1 is outside"),
        (lambda: jl.forest(density=1.0, area=(9.0, 9.0), shares=(0,)), "sum of shares = 0 is outside"),
        (
            lambda: jl.forest(density=1.0, area=(9.0, 9.0), size=(1.0, 0.5)),
            "size = .* is not \\(low, high\\)",
        ),
        (lambda: jl.forest(density=1.0, area=(9.0, 9.0), individuals=0), "individuals = 0 is outside"),
        (lambda: jl.forest(density=1.0, area=(9.0, 9.0), origin=(0, 0, np.nan)), "origin = nan is outside"),
        (
            lambda: jl.forest(density=2000.0, area=(20.0, 20.0), minimum_distance=3.0),
            "density = 2000 stems/ha with minimum_distance = 3 m cannot be placed: room was found for ",
        ),
    ],
)
def test_inadmissible_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_a_tree_that_does_not_grow_up_is_refused():
    straight = jl.Branching(angle=0.0, angle_spread=0.0, bend=0.0, tropism=0.0)
    # Stems lean by up to 1.3 times their angle: these may lead below the horizon.
    habit = jl.Habit(stem_angle=90.0, trunk=straight, branches=straight)
    seeds_that_fail = [seed for seed in range(12) if not _grows(habit, seed)]
    assert seeds_that_fail
    with pytest.raises(ValueError, match="height = 15 cannot be had"):
        jl.grow(habit, seed=seeds_that_fail[0])


def _grows(habit, seed):
    try:
        return jl.grow(replace(habit, shoots=0), seed=seed) is not None
    except ValueError:
        return False
