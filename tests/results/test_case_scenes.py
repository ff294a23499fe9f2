"""Scenes of case files that are made of stands, tree models and point clouds, against the same calls."""

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxlidar as jl

HILL = "ncols 4\nnrows 4\nxllcorner -15\nyllcorner -15\ncellsize 10\n9 9 9 9\n6 6 6 6\n3 3 3 3\n0 0 0 0\n"
QSM = "ID,parentID,startX,startY,startZ,endX,endY,endZ,radius\n1,-1,0,0,0,0,0,2,0.1\n2,1,0,0,2,0.5,0,3,0.05\n"
INVENTORY = "species,x,y,height\nbush,1.0,2.0,2.5\nbush,6,7,3\n"
CLOUD = """[scene.canopy]
leaf = {kind = "LeafOptics", reflectance = 0.4}
[scene.canopy.voxels]
kind = "canopy_from_points"
voxel_size = 2.0
points = {kind = "read_las", path = "plot.las"}
"""
TREES = """[scene.canopy]
leaf = {kind = "LeafOptics", reflectance = 0.4}
bark = 0.3
[scene.canopy.voxels]
kind = "voxelise"
voxel_size = 1.0
leaf_area = 0.002
"""
BUSH = '{kind = "shrub", height = 2.0, stems = 1, smallest_diameter = 0.02}'


def habit():
    """Return the habit of the case files."""
    return jl.shrub(height=2.0, stems=1, smallest_diameter=0.02)


@pytest.fixture
def folder(tmp_path):
    """Return a folder with an elevation model, a tree model, an inventory and a point cloud."""
    (tmp_path / "hill.asc").write_text(HILL)
    (tmp_path / "tree.csv").write_text(QSM)
    (tmp_path / "plot.csv").write_text(INVENTORY)
    random, one = np.random.default_rng(0), np.ones(2000, int)
    is_ground = random.uniform(size=2000) < 0.5
    z = np.where(is_ground, 0.0, random.uniform(2.0, 6.0, 2000))
    points = np.column_stack([random.uniform(0.0, 10.0, (2000, 2)), z])
    classes = np.where(is_ground, 2, 5)
    jl.io.write_las(
        tmp_path / "plot.las", points, classification=classes, return_number=one, number_of_returns=one
    )
    return tmp_path


def scene_of(folder, text):
    """Return the scene of a case file, which is the same after it is written and read again."""
    (folder / "a.toml").write_text(text)
    scene = jl.io.read_case(folder / "a.toml").scene
    jl.io.write_case(folder / "b.toml", jl.io.Case(scene=scene))
    again = jl.io.read_case(folder / "b.toml").scene
    assert jax.tree.structure(again) == jax.tree.structure(scene)
    assert eqx.tree_equal(again, scene)
    return scene


def same_voxels(voxels, expected):
    """True if two voxel maps are equal."""
    return bool(eqx.tree_equal(voxels, expected))


@pytest.mark.slow
def test_a_forest_stands_on_an_elevation_model(folder):
    text = f"""[scene.ground]
    kind = "read_dem"
    path = "hill.asc"
    {TREES}
    [scene.canopy.voxels.trees]
    kind = "Stand.above"
    terrain = {{same_as = "scene.ground"}}
    stand = {{kind = "forest", habits = {BUSH}, density = 400, area = [10, 10], individuals = 1}}
    """
    scene = scene_of(folder, text)
    stand = jl.forest(habit(), density=400, area=(10, 10), individuals=1).above(scene.ground)
    assert np.ptp(stand.position[:, 2]) > 1.0
    assert same_voxels(scene.canopy.voxels, jl.voxelise(stand, 1.0, leaf_area=0.002))
    lifted = text.replace(
        'kind = "Stand.above"', 'kind = "forest"\ndensity = 400\narea = [10, 10]\nindividuals = 1'
    )
    lifted = lifted.partition("    terrain =")[0] + f"    habits = {BUSH}\n"
    lifted = lifted.replace("[scene.canopy.voxels", "[scene.canopy.voxels.voxels").replace(
        "[scene.canopy.voxels.voxels]",
        "[scene.canopy.voxels]\nkind = 'VoxelMap.above'\nterrain = {same_as = 'scene.ground'}\n"
        "[scene.canopy.voxels.voxels]",
    )
    flat = jl.voxelise(jl.forest(habit(), density=400, area=(10, 10), individuals=1), 1.0, leaf_area=0.002)
    assert same_voxels(scene_of(folder, lifted).canopy.voxels, flat.above(scene.ground))


def test_a_stand_is_made_of_an_inventory_and_of_a_leaf_area_index(folder):
    text = (
        TREES
        + f"""[scene.canopy.voxels.trees]
    kind = "stand_from_inventory"
    inventory = {{kind = "read_inventory", path = "plot.csv"}}
    habits = {{bush = {BUSH}}}
    individuals = 1
    """
    )
    inventory = jl.io.read_inventory(folder / "plot.csv")
    stand = jl.stand_from_inventory(inventory, {"bush": habit()}, individuals=1)
    assert same_voxels(scene_of(folder, text).canopy.voxels, jl.voxelise(stand, 1.0, leaf_area=0.002))
    text = (
        TREES.replace("leaf_area = 0.002\n", "")
        + f"""[scene.canopy.voxels.trees]
    kind = "stand_of_leaf_area"
    leaf_area_index = 2
    heights = [2.0, 3.0]
    habits = {BUSH}
    density = 400
    area = [10, 10]
    individuals = 1
    """
    )
    how = {"density": 400, "area": (10, 10), "individuals": 1}
    stand = jl.stand_of_leaf_area(2, [2.0, 3.0], habit(), **how)
    assert same_voxels(scene_of(folder, text).canopy.voxels, jl.voxelise(stand, 1.0))


def test_parts_have_places_azimuths_and_scales(folder):
    """A tree model twice, and a tree that is grown."""
    text = (
        TREES
        + f"""[scene.canopy.voxels.trees]
    kind = "Stand.joined"
    [[scene.canopy.voxels.trees.stands]]
    kind = "Stand"
    individuals = {{kind = "read_qsm", path = "tree.csv"}}
    position = [[0, 0, 0], [4, 1, 0.5]]
    azimuth = [0, 90]
    scale = [[1, 1, 1], [2, 1.5, 1]]
    [[scene.canopy.voxels.trees.stands]]
    kind = "grow"
    habit = {BUSH}
    """
    )
    tree = jl.io.read_qsm(folder / "tree.csv").tree
    copies = jl.Stand(tree, [(0, 0, 0), (4, 1, 0.5)], azimuth=[0, 90], scale=[(1, 1, 1), (2, 1.5, 1)])
    stand = jl.Stand.joined([copies, jl.grow(habit())])
    assert same_voxels(scene_of(folder, text).canopy.voxels, jl.voxelise(stand, 1.0, leaf_area=0.002))
    assert np.allclose(stand[1].end[-1], (4.0, 0.0, 5.0))


def test_a_mesh_is_made_of_a_tree_model(folder):
    text = """[[scene.meshes]]
    mesh = {kind = "mesh_of", tree = {kind = "read_qsm", path = "tree.csv"}, sides = 4}
    instances = {shift = [[0, 0, 0], [3, 0, 0]]}
    """
    tree = jl.io.read_qsm(folder / "tree.csv").tree
    expected = jl.MeshSurface(
        jl.mesh_of(tree, sides=4), instances=jl.MeshInstances(shift=[(0, 0, 0), (3, 0, 0)])
    )
    assert eqx.tree_equal(scene_of(folder, text).meshes[0], expected)


def test_points_give_a_canopy_and_its_terrain(folder):
    text = (
        CLOUD
        + """[scene.ground]
    kind = "canopy_from_points"
    voxel_size = 2.0
    points = {same_as = "scene.canopy.voxels.points"}
    """
    )
    scene = scene_of(folder, text)
    cloud = jl.canopy_from_points(jl.io.read_las(folder / "plot.las"), 2.0)
    assert same_voxels(scene.canopy.voxels, cloud.voxels)
    assert eqx.tree_equal(scene.ground, cloud.terrain)
    text = CLOUD.replace("canopy_from_points", "voxelise_points") + "leaf_area = 30\n"
    points = jl.io.read_las(folder / "plot.las").position
    expected = jl.voxelise_points(points, 2.0, leaf_area=30)
    assert same_voxels(scene_of(folder, text).canopy.voxels, expected)


def test_a_survey_of_a_case_has_its_instrument_and_truth(folder):
    (folder / "a.toml").write_text(
        """[survey]
        position = [[0, 0], [10, 0]]
        lidar = {kind = "instrument", name = "GEDI coverage"}
        [scene.ground]
        [simulate]
        seed = 0
        truth = true
        max_orders = 1
        """
    )
    case = jl.io.read_case(folder / "a.toml")
    assert eqx.tree_equal(case.survey.lidar, jl.instrument("GEDI coverage"))
    assert case.arguments == {"truth": True, "max_orders": 1}
    jl.io.write_case(folder / "b.toml", case)
    assert jl.io.read_case(folder / "b.toml").arguments == case.arguments


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "[scene.ground]\nslope = {same_as = 'scene.grund'}",
            "scene.ground.slope.same_as = 'scene.grund' names no entry of the file",
        ),
        (
            "[scene.ground]\nslope = {same_as = 'scene'}",
            "scene.ground.slope.same_as = 'scene' refers to itself",
        ),
        (
            "[scene.ground]\nslope = {same_as = 'scene.ground.aspect'}\n"
            "aspect = {same_as = 'scene.ground.slope'}",
            "refers to itself",
        ),
        ("[scene.ground]\nslope = {same_as = 3}", "scene.ground.slope.same_as is an int"),
        (
            "[scene.ground]\nslope = {same_as = 'scene', kind = 'Plane'}",
            "scene.ground.slope.kind is not known; admissible are same_as",
        ),
        (
            CLOUD.replace("plot.las", "no.las"),
            "scene.canopy.voxels.points: .*no.las: no such file|no.las: no such file",
        ),
        (CLOUD.replace("2.0", "-2.0"), r"scene.canopy.voxels: voxel_size = -2 is outside"),
        (
            TREES + "trees = {kind = 'read_qsm', path = 'plot.csv'}",
            r"scene.canopy.voxels.trees: .*line 1: no ",
        ),
        (
            TREES + "trees = {kind = 'Stand', individuals = {kind = 'grow'}, position = [[0, 0]]}",
            r"scene.canopy.voxels.trees: position has shape \(1, 2\)",
        ),
        (
            TREES + "[scene.canopy.voxels.trees]\nkind = 'stand_from_inventory'\n"
            "inventory = {kind = 'read_inventory', path = 'plot.csv'}",
            "scene.canopy.voxels.trees: row 0: species = 'bush' has no habit",
        ),
        (
            TREES + "trees = {kind = 'Stand.above', stand = {kind = 'grow'}, terrain = 'Ground'}",
            "scene.canopy.voxels.trees: stand is a Tree; admissible is a Stand",
        ),
        (
            TREES + "trees = {kind = 'Stand.joined', stands = []}",
            "scene.canopy.voxels.trees: stands is empty",
        ),
        (
            "[[scene.meshes]]\nmesh = {kind = 'mesh_of', sides = 2, "
            "tree = {kind = 'read_qsm', path = 'tree.csv'}}",
            "scene.meshes.0.mesh: sides = 2 is outside",
        ),
        (
            "[scene.ground]\nkind = 'canopy_from_points'\n"
            "points = {kind = 'read_las', path = 'plot.las', scale = 0}",
            "scene.ground.points: scale = 0 is outside",
        ),
    ],
)
def test_bad_scenes_are_refused_with_their_place(text, message, folder):
    (folder / "a.toml").write_text(text)
    with pytest.raises((ValueError, TypeError, FileNotFoundError), match=message):
        jl.io.read_case(folder / "a.toml")
