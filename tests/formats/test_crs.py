"""Coordinate reference systems travel with data, from files to results."""

import dataclasses
import warnings

import jax
import numpy as np
import pyproj
import pytest

import jaxlidar as jl
from jaxlidar._fields.crs import common_system
from jaxlidar.plants.inventory import Inventory

CRS, CORNER = "EPSG:25832", np.array([4e5, 5.3e6])
# Another zone, another datum, another projection: each was accepted for data in CRS.
OTHERS = ["EPSG:25833", "EPSG:2056", "EPSG:31467"]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A terrain, points with their ground, an inventory and a flight, of one map."""
    rasterio = pytest.importorskip("rasterio")
    folder, random = tmp_path_factory.mktemp("files"), np.random.default_rng(0)
    profile = {"driver": "GTiff", "width": 40, "height": 40, "count": 1, "dtype": "float32", "crs": CRS}
    profile["transform"] = rasterio.Affine(1.0, 0.0, CORNER[0], 0.0, -1.0, CORNER[1] + 40.0)
    with rasterio.open(folder / "dem.tif", "w", **profile) as file:
        file.write(random.uniform(0.0, 0.2, (40, 40)).astype("float32"), 1)
    xy = CORNER + random.uniform(5.0, 35.0, (2000, 2))
    is_ground = random.uniform(size=2000) < 0.5
    z = np.where(is_ground, 0.1, random.uniform(3.0, 6.0, 2000))
    points = np.column_stack([xy, z])
    jl.io.write_las(folder / "scan.las", points, classification=np.where(is_ground, 2, 5), crs=CRS)
    x, y = CORNER + 10.0
    (folder / "trees.csv").write_text(f"x,y,height\n{x},{y},4\n{x + 9},{y + 9},5\n")
    rows = [f"{t},{x + t},{y},120" for t in (0, 2, 18)]
    (folder / "flight.csv").write_text("\n".join([f"# crs: {CRS}", "time,x,y,z", *rows]))
    return folder


def flight_of(files):
    flight = jl.io.read_trajectory(files / "flight.csv")
    lidar = jl.Lidar(sensor=(0, 0, 0), divergence=0.5)
    return jl.Survey.fly(flight, jl.Conical(half_angle=2.0, frequency=1.0), lidar=lidar, pulse_rate=1.0)


def test_a_system_travels_from_files_to_results(files, tmp_path):
    """The LAS file that is written at the end declares the system that the first files declared."""
    terrain, stated, _ = jl.io.read_dem(files / "dem.tif")
    points = jl.io.read_las(files / "scan.las")
    canopy = jl.canopy_from_points(points, 2.0)
    assert canopy.terrain is not None
    survey = flight_of(files)
    scene = jl.Scene(canopy=jl.Canopy(canopy.voxels, leaf=jl.LeafOptics(0.4, 0.4)), ground=terrain)
    assert survey.subset(np.arange(3)).crs == survey.within(scene).crs == CRS
    for thing in (terrain, points, canopy.terrain, canopy.voxels.trimmed(), survey, scene):
        assert thing.crs == stated == CRS
    bare = jl.Scene(ground=terrain)
    many = jl.simulate_many(survey, bare, key=jax.random.key(0), max_orders=1, rtol=0.3)
    assert many.crs == many.info["crs"] == CRS
    many.save(tmp_path / "strip.nc")
    many = jl.open(tmp_path / "strip.nc")
    returns = many.returns(threshold=1e-20)
    for write in (many.to_las, returns.to_las, many.to_las_waveforms):
        write(tmp_path / "strip.las")
        assert jl.io.read_las(tmp_path / "strip.las").crs == CRS
        for other in OTHERS:
            with pytest.raises(ValueError, match=rf"crs is in {other}, the simulation in {CRS}; .*to_crs"):
                write(tmp_path / "other.las", crs=other)
    # A writer takes the system of its first part, and refuses another one.
    with jl.io.LasWriter(tmp_path / "parts.las") as file:
        returns.to_las(file)
        with pytest.raises(ValueError, match="the part is in EPSG:25833, LasWriter in EPSG:25832"):
            dataclasses.replace(returns, crs="EPSG:25833").to_las(file)
    assert jl.io.read_las(tmp_path / "parts.las").crs == CRS
    with jl.io.LasWriter(tmp_path / "parts.las") as file:
        dataclasses.replace(returns, crs=None).to_las(file)
        with pytest.raises(ValueError, match="the first part has none: give it to LasWriter"):
            returns.to_las(file)


def test_a_wrong_system_of_an_inventory_is_no_fault_of_its_file(files):
    with pytest.raises(ValueError, match=r"^crs = 'EPSG:4326' is not in metres"):
        jl.io.read_inventory(files / "trees.csv", crs="EPSG:4326")


def test_trees_and_their_leaves_are_in_the_system_of_the_inventory(files):
    inventory = jl.io.read_inventory(files / "trees.csv", crs=25832)
    stand = jl.stand_from_inventory(inventory, jl.shrub(), individuals=1)
    terrain, _, _ = jl.io.read_dem(files / "dem.tif")
    stands = (stand, stand[:1], stand.above(terrain), jl.Stand.joined([stand, stand]))
    voxels = jl.voxelise(stand, 1.0, leaf_area=0.001)
    leaves = jl.leaf_mesh(voxels, leaf_area=0.01, key=jax.random.key(0))
    for thing in (inventory, *stands, voxels, voxels.above(terrain), leaves):
        assert thing.crs == CRS
    elsewhere = dataclasses.replace(terrain, crs="EPSG:25833")
    for put in (stand.above, voxels.above):
        with pytest.raises(ValueError, match=r"terrain is in EPSG:25833, (stand|voxels) in EPSG:25832"):
            put(elsewhere)


def test_two_systems_are_refused(files):
    terrain, _, _ = jl.io.read_dem(files / "dem.tif")
    elsewhere, survey = dataclasses.replace(terrain, crs=25833), flight_of(files)
    voxels = dataclasses.replace(jl.VoxelMap.from_lad(np.ones((2, 2, 2)), voxel_size=1.0), crs=CRS)
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4))
    mesh = jl.MeshSurface(([[0, 0, 5], [1, 0, 5], [0, 1, 5]], [[0, 1, 2]]), crs="EPSG:2056")
    with pytest.raises(ValueError, match=r"canopy is in EPSG:25832, ground in EPSG:25833; admissible is one"):
        jl.Scene(canopy=canopy, ground=elsewhere)
    with pytest.raises(ValueError, match=r"meshes\[0\] is in EPSG:2056, canopy in EPSG:25832"):
        jl.Scene(canopy=canopy, meshes=[mesh])
    scene = jl.Scene(ground=elsewhere)
    for use in (survey.within, lambda scene: jl.ground_position(survey, scene)):
        with pytest.raises(ValueError, match=r"scene is in EPSG:25833, survey in EPSG:25832"):
            use(scene)
    with pytest.raises(ValueError, match=r"scene is in EPSG:25833, survey in EPSG:25832"):
        jl.simulate_many(survey, scene, key=jax.random.key(0))
    other = jl.Survey(survey.lidar, sensor=survey.sensor, crs=25833)
    with pytest.raises(ValueError, match=r"surveys\[1\] is in EPSG:25833, surveys\[0\] in EPSG:25832"):
        jl.Survey.join([survey, other])


def test_systems_are_compared_by_what_they_are():
    """Planted: a comparison of texts."""
    wkt = pyproj.CRS("EPSG:25832").to_wkt("WKT1_GDAL")
    with_heights, ellipsoid = "EPSG:25832+7837", "EPSG:25832+5773"
    assert common_system({"a": None, "b": CRS, "c": wkt, "d": 25832}) == CRS
    assert common_system({"a": CRS, "b": with_heights}) == with_heights
    assert common_system({"a": with_heights, "b": CRS}) == with_heights
    with pytest.raises(ValueError, match=r"b is in .* \+ EGM96 height, a in .* \+ DHHN2016 height"):
        common_system({"a": with_heights, "b": ellipsoid})


@pytest.mark.parametrize(
    ("crs", "error", "message"),
    [
        ("EPSG:1", ValueError, "crs = 'EPSG:1' is not known"),
        ("EPSG:4326", ValueError, "crs = 'EPSG:4326' is not in metres"),
        ("EPSG:2263", ValueError, "crs = 'EPSG:2263' is not in metres"),
        (25832.0, TypeError, "crs"),
        (True, TypeError, "crs is a bool"),
    ],
)
@pytest.mark.parametrize(
    "make",
    [
        lambda crs: jl.Terrain([[0.0, 0.0], [0.0, 1.0]], 1.0, crs=crs),
        lambda crs: jl.VoxelMap(np.ones((1, 1, 1)), None, 1.0, (0, 0, 0), crs=crs),
        lambda crs: jl.MeshSurface(([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), crs=crs),
        lambda crs: jl.Trajectory(0.0, [(0, 0, 0)], crs=crs),
        lambda crs: jl.Survey(jl.Lidar(), [(0, 0)], crs=crs),
        lambda crs: jl.Stand(jl.grow(jl.shrub()), [(0, 0, 0)], crs=crs),
    ],
)
def test_what_is_no_map_in_metres_is_refused(make, crs, error, message):
    with pytest.raises(error, match=message):
        make(crs)


def test_cases_hold_the_system(tmp_path):
    flight = jl.Trajectory([0.0, 1.0], [(0, 0, 90.0), (5, 0, 90.0)], crs=CRS)
    survey = jl.Survey.fly(flight, jl.Conical(half_angle=2.0, frequency=1.0), lidar=jl.Lidar(altitude=90.0))
    scene = jl.Scene(ground=jl.Terrain(np.zeros((3, 3)), 20.0, (-20, -20), crs=CRS))
    jl.io.write_case(tmp_path / "case.toml", jl.io.Case(survey=survey, scene=scene))
    case = jl.io.read_case(tmp_path / "case.toml")
    assert case.survey.crs == case.scene.crs == CRS


def test_points_inventories_and_trajectories_move_to_another_map():
    """PROJ itself, and headings from the course of the moved positions, are the references."""
    step = np.array([[0.0, 0.0, 0.0], [0.3, 0.4, 0.0], [0.6, 0.8, 0.0]])
    position = np.array([*CORNER, 90.0]) + step
    expected = np.stack(pyproj.Transformer.from_crs(CRS, "EPSG:25833", always_xy=True).transform(*position.T))
    one = np.ones(3, int)
    cloud = jl.io.PointCloud(position, one, one, one, 1.0 * one, {}, crs=CRS)
    moved = jl.io.to_crs(cloud, 25833)
    assert moved.crs == "EPSG:25833"
    np.testing.assert_allclose(moved.position, expected.T, atol=1e-6)
    none = cloud._replace(position=np.zeros((0, 3)), classification=one[:0], intensity=1.0 * one[:0])
    moved = jl.io.to_crs(none._replace(return_number=one[:0], number_of_returns=one[:0]), 25833)
    assert (moved.position.shape, moved.crs) == ((0, 3), "EPSG:25833")
    trees = Inventory(position[:, 0], position[:, 1], np.full(3, 7.0), crs=CRS)
    moved = jl.io.to_crs(trees, "EPSG:25833")
    np.testing.assert_allclose([moved.x, moved.y], expected[:2], atol=1e-6)
    assert (moved.z, moved.crs) == (None, "EPSG:25833")
    flight = jl.Trajectory(np.arange(3.0), position, roll=2.0, crs=CRS)
    moved = jl.io.to_crs(flight, "EPSG:25833")
    course = jl.Trajectory(np.arange(3.0), expected.T).yaw
    assert abs(course[0] - flight.yaw[0]) > 1.0
    np.testing.assert_allclose(moved.yaw, course, atol=1e-3)
    np.testing.assert_array_equal(moved.roll, flight.roll)
    again = jl.io.to_crs(moved, CRS)
    np.testing.assert_allclose(again.position, position, atol=1e-5)
    np.testing.assert_allclose(again.yaw, flight.yaw, atol=1e-9)


def test_transformations_say_their_accuracy_and_what_they_cannot_do():
    flight = jl.Trajectory(0.0, [(3.5e6, 5.3e6, 90.0)], crs="EPSG:31467")
    with pytest.warns(UserWarning, match="accuracy of the transformation from DHDN .* is 3 m"):
        jl.io.to_crs(flight, "EPSG:32632")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jl.io.to_crs(dataclasses.replace(flight, crs="EPSG:32632"), "EPSG:32633")
    for data, crs, message in (
        (dataclasses.replace(flight, crs=None), CRS, "data has no crs"),
        (
            dataclasses.replace(flight, crs="EPSG:25832+7837"),
            "EPSG:25833",
            "heights are declared in EPSG:258",
        ),
        (dataclasses.replace(flight, crs=CRS), "EPSG:4326", "is not in metres"),
    ):
        with pytest.raises(ValueError, match=message):
            jl.io.to_crs(data, crs)
    with pytest.raises(TypeError, match="data"):
        jl.io.to_crs(jl.Lidar(), CRS)
