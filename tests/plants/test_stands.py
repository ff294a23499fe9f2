"""Stands: leaf area index, distribution of heights, inventories, and voxel maps of their copies."""

import dataclasses
import time

import numpy as np
import pytest
from scipy import stats

import jaxlidar as jl

# Small trees, so that they grow in milliseconds.
BUSH = jl.shrub(height=2.0, stems=1, smallest_diameter=0.012)
FIR = jl.conifer(height=8.0, trunk_diameter=0.12)
HEIGHTS = stats.norm(6.0, 1.0)


def leaf_area(voxels):
    """Return the one-sided leaf area of a voxel map, m2."""
    return 2.0 * np.asarray(voxels.leaf, float).sum() * np.prod(np.asarray(voxels.voxel_size, float))


def wood_volume(voxels):
    """Return the volume of wood of a voxel map, m3."""
    edges = np.asarray(voxels.voxel_size, float)
    return -np.expm1(-np.asarray(voxels.bark, float) * edges[0]).sum() * edges.prod()


def crown_centre(voxels):
    """Return the centre of leaf area, (x, y, z) in m."""
    leaf = np.asarray(voxels.leaf, float)
    axes = [
        np.asarray(voxels.origin, float)[k] + float(voxels.voxel_size[k]) * (np.arange(leaf.shape[k]) + 0.5)
        for k in range(3)
    ]
    return np.array([np.average(x, weights=leaf.sum(axis=i)) for x, i in zip(axes, ((1, 2), (0, 2), (0, 1)))])


@pytest.fixture(scope="module")
def stand():
    """Return 150 trees of two habits with a leaf area index of 2.5 on 50 m x 30 m."""
    how = {"density": 1000.0, "area": (50.0, 30.0), "minimum_distance": 1.0, "individuals": 2}
    return jl.stand_of_leaf_area(2.5, HEIGHTS, [BUSH, FIR], shares=(1, 3), seed=3, **how)


# -- leaf area and heights ---------------------------------------------------------------------------------


def test_the_leaf_area_of_a_stand_is_its_target(stand):
    assert np.isclose(stand.tree_leaf_area.sum() / 1500.0, 2.5, rtol=1e-12)
    assert np.isclose(leaf_area(jl.voxelise(stand, 1.0)) / 1500.0, 2.5, rtol=1e-4)
    # The leaf area below a crown is the same for every tree.
    below_crown = stand.tree_leaf_area / stand.crown_diameter**2
    assert np.allclose(below_crown, below_crown[0])


def test_heights_follow_their_distribution(stand):
    height = np.array([tree.height for tree in stand])
    assert np.allclose(height, stand.height)
    # One tree from each of n classes of equal probability: no distance exceeds 1/n.
    assert stats.kstest(height, HEIGHTS.cdf).statistic <= 1.0 / len(stand) + 1e-9
    # Heights of another mean by 0.5 m are refused.
    assert stats.kstest(height, stats.norm(6.5, 1.0).cdf).pvalue < 1e-4
    # Heights are not sorted by position or habit.
    assert abs(np.corrcoef(height, stand.position[:, 0])[0, 1]) < 0.3
    assert abs(np.mean(stand.individual >= 2) - 0.75) < 4 * np.sqrt(0.75 * 0.25 / 150)


def test_a_sample_of_heights_is_drawn_in_proportion():
    measured = [3.0, 3.0, 4.0, 5.5]
    stand = jl.stand_of_leaf_area(1.0, measured, BUSH, density=1e3, area=(40.0, 10.0), individuals=1)
    values, counts = np.unique(stand.height.round(9), return_counts=True)
    assert values.tolist() == [3.0, 4.0, 5.5]
    assert np.all(np.abs(counts - np.array([20, 10, 10])) <= 1)
    level = jl.stand_of_leaf_area(1.0, 3.3, BUSH, density=100.0, area=(40.0, 10.0), individuals=1)
    assert np.allclose(level.height, 3.3)


# -- inventories -------------------------------------------------------------------------------------------

TABLE = {
    "Species": ["bush", "fir", "fir"],
    "x": [10.0, 30.0, 50.5],
    "y": [5.0, 25.0, 9.25],
    "z": [0.0, 1.5, 0.0],
    "height": [2.5, 9.0, 6.25],
    "DBH [cm]": [5.0, 16.0, np.nan],
    "crown_diameter": [2.0, 3.5, None],
    "plot": ["a", "a", "b"],
}
SPECIES = {"bush": BUSH, "fir": FIR}


def test_trees_stand_where_the_inventory_says_and_have_its_sizes():
    stand = jl.stand_from_inventory(TABLE, SPECIES, individuals=2, leaf_area_index=0.5, area=100.0)
    for tree, x, y, z, height in zip(stand, TABLE["x"], TABLE["y"], TABLE["z"], TABLE["height"]):
        assert np.allclose(tree.base, (x, y, z))
        assert np.isclose(tree.height, height)
    assert np.allclose([tree.trunk_diameter for tree in stand][:2], [0.05, 0.16])
    assert np.allclose([tree.crown_diameter for tree in stand][:2], [2.0, 3.5])
    # What is missing has the proportions of the individual.
    fir = stand.individuals[stand.individual[2]]
    assert np.isclose(stand[2].trunk_diameter / stand[2].height, fir.trunk_diameter / fir.height)
    assert np.isclose(stand[2].crown_diameter / stand[2].height, fir.crown_diameter / fir.height)
    # The crowns of the voxel map, tree by tree, against the centres of their clumps.
    for i, tree in enumerate(stand):
        centre = crown_centre(jl.voxelise(stand[i : i + 1], 0.5))
        clumps = tree.bud_position.mean(axis=0)
        # Azimuths are rounded, by up to 11.25 degrees.
        from_stem = np.hypot(*(clumps - tree.base)[:2])
        assert np.all(np.abs(centre - clumps) < 0.1 + np.deg2rad(11.25) * from_stem)
        assert np.hypot(*(centre[:2] - (TABLE["x"][i], TABLE["y"][i]))) < 1.5
        swapped = (TABLE["y"][i], TABLE["x"][i])
        assert np.hypot(*(centre[:2] - swapped)) > 3.0
    assert np.isclose(leaf_area(jl.voxelise(stand, 1.0)), 50.0, rtol=1e-4)


def test_columns_that_are_not_read_may_be_anything():
    """No lists, and heights again in another unit."""
    more = {"plot": 7, "note": None, "height_ft": [3.0]}
    stand, same = (jl.stand_from_inventory(table, SPECIES, individuals=1) for table in (TABLE, TABLE | more))
    np.testing.assert_array_equal(same.position, stand.position)
    assert [tree.height for tree in same] == [tree.height for tree in stand]


class Frame:
    """A stand-in for a DataFrame: columns with an index of their own."""

    def __init__(self, columns):
        self.columns = columns

    def keys(self):
        """Return the names of the columns."""
        return self.columns.keys()

    def __getitem__(self, name):
        return np.array(self.columns[name], dtype=object)


def test_tables_of_all_kinds_give_the_same_stand(tmp_path):
    path = tmp_path / "plot.csv"
    rows = zip(*TABLE.values())
    cells = [["" if cell is None or cell != cell else str(cell) for cell in row] for row in rows]
    path.write_text("\n".join(";".join(row) for row in [list(TABLE), *cells]))
    inventory = jl.io.read_inventory(path)
    stands = [
        jl.stand_from_inventory(table, SPECIES, individuals=1) for table in (TABLE, Frame(TABLE), inventory)
    ]
    for other in stands[1:]:
        for name in ("position", "scale", "individual", "azimuth"):
            assert np.array_equal(getattr(other, name), getattr(stands[0], name))
    with_areas = jl.stand_from_inventory({**TABLE, "leaf_area": [1, 20.5, 7]}, SPECIES, individuals=1)
    assert np.allclose(with_areas.tree_leaf_area, [1.0, 20.5, 7.0])
    assert np.isclose(leaf_area(jl.voxelise(with_areas, 1.0)), 28.5, rtol=1e-4)


def test_a_pandas_table_is_an_inventory():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(TABLE, index=["a", "b", "c"])
    stand = jl.stand_from_inventory(frame, SPECIES, individuals=1)
    assert np.array_equal(stand.position, jl.stand_from_inventory(TABLE, SPECIES, individuals=1).position)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"height": [2.5, -9.0, 6.0]}, r"row 1: height = -9 m is outside the admissible range \(0, 150\]"),
        ({"height": [2.5, 9.0, "tall"]}, "row 2: height = 'tall' is no number"),
        ({"height": [2.5, None, 6.0]}, "row 1: height is missing"),
        ({"x": [10.0, np.inf, 3.0]}, "row 1: x = inf m is outside"),
        ({"y": [np.nan, 1.0, 3.0]}, "row 0: y is missing"),
        ({"crown_diameter": [2.0, 3.0, 0.0]}, r"row 2: crown_diameter = 0 m is outside .* \(0, 100\]"),
        ({"DBH [cm]": [5.0, 900.0, 4.0]}, r"row 1: DBH \[cm\] = 9 m of a tree of 9 m; admissible is up to"),
        (
            {"Species": ["bush", "fir", "oak"]},
            "row 2: species = 'oak' has no habit; habits has 'bush', 'fir'",
        ),
        ({"Species": ["bush", "", "fir"]}, "row 1: species = ''; admissible is a name"),
        ({"leaf_area": [1.0, -1.0, 1.0]}, "row 1: leaf_area = -1 m2 is outside"),
        ({"y": [1.0, 2.0]}, "column 'y' has 2 rows; x has 3"),
        ({"easting": [1.0, 2.0, 3.0]}, "x may be any of the columns 'x', 'easting'"),
        (
            {"crown [acres]": [1.0, 2.0, 3.0], "crown_diameter": None},
            "the unit 'acres' is not known",
        ),
        ({"height": None}, "the inventory: no column height; its name may be height, treeheight"),
        ({name: [] for name in TABLE}, "the inventory: there is no row"),
    ],
)
def test_bad_rows_are_named_with_row_and_column(changes, message):
    table = {name: column for name, column in (TABLE | changes).items() if column is not None}
    with pytest.raises(ValueError, match=message):
        jl.stand_from_inventory(table, SPECIES)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,height\n1,2,3\n1,2\n", "plot.csv: line 3: 2 values; the header names 3"),
        ("x,y,height\n\n1,2,low\n", "plot.csv: line 3: height = 'low' is no number"),
        ("x,y,height,dbh\n1,2,20,35\n", "plot.csv: line 2: dbh = 35 m is outside"),
        ("x,y,dbh\n1,2,3\n", "plot.csv: line 1: no column height"),
        ("x,y,x,height\n1,2,3,4\n", "plot.csv: line 1: x may be any of the columns 'x', 'x'"),
        ("", "plot.csv: line 1: there is no line"),
    ],
)
def test_bad_files_are_named_with_line_and_column(text, message, tmp_path):
    (tmp_path / "plot.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        jl.io.read_inventory(tmp_path / "plot.csv")


# -- stands as trees, and their voxel maps -----------------------------------------------------------------


def test_a_stand_is_a_sequence_of_trees(stand):
    assert len(list(stand)) == len(stand) == 150
    assert len(stand[10:13]) == 3
    assert np.array_equal(stand[10:13][0].end, stand[10].end)
    assert np.array_equal(stand[-1].end, stand[149].end)
    with pytest.raises(IndexError):
        stand[150]
    assert str(stand).startswith("Stand of 150 trees, copies of 4 individuals: 3.")


def test_the_voxel_map_of_a_stand_has_the_volumes_of_its_trees():
    """Stretched copies, each at its own place, against direct voxelisation of each."""
    bush, fir = jl.grow(BUSH, seed=1), jl.grow(FIR, seed=1)
    random = np.random.default_rng(2)
    n = 12
    position = random.uniform(0.0, 6.0, (n, 3)) * [2, 1, 0.05] + [5e5, 5.2e6, 300.0]
    scale = random.uniform(0.6, 1.6, (n, 3))
    # Azimuths that need no rounding.
    azimuth = 22.5 * random.integers(16, size=n)
    stand = jl.Stand([bush, fir], position, random.integers(2, size=n), azimuth, scale, 0.002)
    grid = {"origin": (5e5 - 4, 5.2e6 - 4, 299.0), "shape": (20, 14, 15)}
    voxels = jl.voxelise(stand, 1.0, **grid)
    direct = jl.voxelise(list(stand), 1.0, leaf_area=0.002, **grid)
    assert np.isclose(leaf_area(voxels), leaf_area(direct), rtol=1e-5)
    assert np.isclose(wood_volume(voxels), sum(tree.wood_volume for tree in stand), rtol=1e-3)
    assert np.isclose(wood_volume(voxels), wood_volume(direct), rtol=1e-3)
    difference = np.abs(np.asarray(voxels.leaf, float) - np.asarray(direct.leaf, float)).sum()
    assert difference < 0.12 * np.asarray(direct.leaf, float).sum()
    # Without its scales the stand is another one.
    plain = jl.voxelise(with_fields(stand, scale=np.ones((n, 3))), 1.0, **grid)
    assert (
        np.abs(np.asarray(plain.leaf) - np.asarray(direct.leaf)).sum() > 0.5 * np.asarray(direct.leaf).sum()
    )
    # Clumps that fill their spheres, and sides of wood.
    filled, filled_directly = (
        jl.voxelise(trees, 1.0, wood="surface", **grid)
        for trees in (jl.Stand([bush, fir], position, stand.individual, azimuth, scale), list(stand))
    )
    assert np.isclose(np.sum(filled.leaf), np.sum(filled_directly.leaf), rtol=0.02)
    assert np.isclose(np.sum(filled.bark), np.sum(filled_directly.bark), rtol=0.03)


def with_fields(stand, **changes):
    """Return a stand with other values of some fields."""
    fields = {field.name: getattr(stand, field.name) for field in dataclasses.fields(stand)}
    return jl.Stand(**(fields | changes))


def test_a_stand_is_lifted_onto_a_terrain(stand):
    x = np.arange(-10.0, 81.0)
    hill = jl.Terrain(0.1 * x[:, None] + 0.0 * x, 1.0, (-10.0, -10.0))
    lifted = stand.above(hill)
    assert np.allclose(lifted.position[:, 2], 0.1 * stand.position[:, 0], atol=1e-4)
    assert np.array_equal(lifted.position[:, :2], stand.position[:, :2])
    with pytest.raises(ValueError, match=r"x = .* is outside the admissible range"):
        stand.above(jl.Terrain(np.zeros((3, 3)), 1.0))


def test_progress_counts_all_trees(stand):
    counts = []
    jl.voxelise(stand[:6], 1.0, progress=lambda *count: counts.append(count))
    assert counts == [(i + 1, 6) for i in range(6)]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: jl.Stand([], np.zeros((1, 3))), "individuals is empty"),
        (lambda: jl.Stand(jl.grow(BUSH), np.zeros((1, 2))), r"position has shape \(1, 2\)"),
        (lambda: jl.Stand(jl.grow(BUSH), np.zeros((1, 3)), scale=np.zeros((1, 3))), "scale = 0 is outside"),
        (lambda: jl.Stand(jl.turtle("F"), np.zeros((1, 3))).tree_leaf_area, "the stand states no leaf area"),
        (
            lambda: jl.Stand(jl.turtle("F"), np.zeros((1, 3))).with_leaf_area_index(1.0, 9.0),
            "no tree of the stand has leaf clumps",
        ),
        (
            lambda: jl.Stand(jl.turtle("F"), np.zeros((1, 3))).with_tree_leaf_area([2.0]),
            "area = 2 m2 of tree 0, which has no leaf clumps",
        ),
        (
            lambda: jl.stand_of_leaf_area(1.0, stats.norm(1.0, 2.0), BUSH, density=1e3, area=(9.0, 9.0)),
            "quantiles of heights = .* is outside",
        ),
        (lambda: jl.stand_of_leaf_area(-1.0, 5.0, density=1e3, area=(9.0, 9.0)), "leaf_area_index = -1 is"),
        (lambda: jl.stand_of_leaf_area(1.0, [], density=1e3, area=(9.0, 9.0)), r"heights has shape \(0,\)"),
        (lambda: jl.stand_from_inventory(TABLE, SPECIES, leaf_area_index=1.0), "give both or neither"),
        (
            lambda: jl.stand_from_inventory(TABLE),
            "row 0: species = 'bush' has no habit; habits has 'broadleaf'",
        ),
        (
            lambda: jl.stand_from_inventory(
                {**TABLE, "leaf_area": [1, 2, 3]}, SPECIES, leaf_area_index=1.0, area=9.0
            ),
            "give one of them",
        ),
    ],
)
def test_inadmissible_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_arguments_of_another_kind_are_refused():
    with pytest.raises(TypeError, match="heights is a str"):
        jl.stand_of_leaf_area(1.0, "tall", density=1e3, area=(9.0, 9.0))
    with pytest.raises(TypeError, match="inventory is a list; admissible is a table by columns"):
        jl.stand_from_inventory([1.0])


@pytest.mark.slow
def test_ten_thousand_trees_take_less_than_a_minute():
    start = time.process_time()
    habits = [jl.broadleaf(), jl.conifer()]
    area = (500.0, 500.0)
    stand = jl.stand_of_leaf_area(4.0, stats.norm(18.0, 3.0), habits, density=400.0, area=area, individuals=4)
    voxels = jl.voxelise(stand, 1.0)
    assert len(stand) == 10_000
    assert np.isclose(leaf_area(voxels), 4.0 * 500.0**2, rtol=1e-4)
    assert time.process_time() - start < 60.0
