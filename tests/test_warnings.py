"""A warning names the user's line, whatever lies between that line and the place that warns.

Tests check types by the import hook of jaxtyping (see conftest): its frames lie between too.
"""

import dataclasses
import linecache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar._fields.checks import warn_user

KEY = jax.random.key(5)
LIDAR = jl.Lidar()
# Light goes to and fro between the plate and the ground when the record ends.
BRIGHT = jl.Scene(plates=(jl.Plate(800.0, 0.4, 0.5),), ground=jl.Ground(reflectance=0.9))


def line_of_warning(call, category):
    """Return the source line that the first warning of a category names."""
    with pytest.warns(category) as caught:
        call()
    warning = next(w for w in caught if issubclass(w.category, category))
    assert warning.filename == __file__
    return linecache.getline(warning.filename, warning.lineno)


def test_one_shot():
    def call():
        jl.simulate(LIDAR, BRIGHT, key=KEY, n_photons=2_000, max_orders=4)

    assert "jl.simulate(" in line_of_warning(call, jl.LateLightWarning)


def test_a_survey():
    survey = jl.Survey(LIDAR, np.zeros((2, 2)))

    def call():
        jl.simulate_many(survey, BRIGHT, key=KEY, rtol=0.1, max_orders=4)

    assert "jl.simulate_many(" in line_of_warning(call, jl.LateLightWarning)


@pytest.mark.slow
def test_a_survey_that_leaves_the_map():
    voxels = jl.VoxelMap.from_lad(np.full((4, 4, 2), 0.5), voxel_size=1.0)
    scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4)), ground=jl.Ground())
    survey = jl.Survey(LIDAR, np.full((2, 2), 50.0))

    def call():
        jl.simulate_many(survey, scene, key=KEY, rtol=0.2, max_orders=1)

    assert "jl.simulate_many(" in line_of_warning(call, jl.OffMapWarning)


@pytest.mark.slow
def test_a_derivative_that_jax_takes():
    mesh = (np.array([[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [0.0, 9.0, 0.0]]), np.array([[0, 1, 2]]))
    surface = jl.MeshSurface(mesh, reflectance=0.4)
    plan = jl.plan(LIDAR, jl.Scene(meshes=(surface,)), max_orders=1, n_rays=64)

    def energy(height):
        moved = eqx.tree_at(
            lambda s: s.vertices, surface, surface.vertices + height * jnp.array([[0.0, 0.0, 1.0]])
        )
        wave = jl.simulate(LIDAR, jl.Scene(meshes=(moved,)), key=KEY, plan=plan)
        return wave.energy.sum()

    assert "jl.simulate(" in line_of_warning(lambda: jax.jacfwd(energy)(0.1), jl.OutlineWarning)


def test_a_reader(tmp_path):
    path = tmp_path / "tree.csv"
    names = "ID,parentID,startX,startY,startZ,endX,endY,endZ,radius"
    path.write_text(f"{names}\n1,-1,0,0,0,0,0,2,0.1\n3,2,0,0,3,0,0,4,0.05\n")
    assert "jl.io.read_qsm(" in line_of_warning(lambda: jl.io.read_qsm(path), jl.io.FileWarning)


def table_of_trees(path):
    path.write_text("x,y,height,crown_radius\n0,0,5,1\n")
    return path


VOXELS = jl.VoxelMap.from_lad(np.full((2, 2, 2), 0.5), voxel_size=1.0, origin=(0.0, 0.0, 300.0))
TREE = jl.Canopy(VOXELS, leaf=jl.LeafOptics(0.4, 0.4))
MEADOW = jl.Terrain(np.zeros((2, 2)), spacing=2.0)
SCAN = jl.RotatingPolygon(half_angle=20.0, line_rate=100.0)
LINE = {"start": (0.0, 0.0), "end": (0.0, 5.0), "speed": 60.0}
# Entry points of several kinds, each on one line, and the classes of their warnings.
ENTRY_POINTS = {
    "jl.Lidar(": (lambda path: jl.Lidar(divergence=3e-4), jl.UnitWarning),
    "dataclasses.replace(": (lambda path: dataclasses.replace(LIDAR, divergence=3e-4), jl.UnitWarning),
    "jl.RotatingPolygon(": (lambda path: jl.RotatingPolygon(half_angle=0.3, line_rate=9.0), jl.UnitWarning),
    "jl.Survey.scan(": (lambda path: jl.Survey.scan(LIDAR, SCAN, **LINE, pulse_rate=0.3), jl.UnitWarning),
    "jl.record(": (lambda path: jl.record(np.ones((1, 2)), 1.064, jl.Receiver()), jl.UnitWarning),
    "jl.Scene(": (lambda path: jl.Scene(canopy=TREE, ground=MEADOW), jl.MisplacedCanopyWarning),
    "jl.io.read_inventory(": (lambda path: jl.io.read_inventory(table_of_trees(path)), UserWarning),
}


@pytest.mark.parametrize("call", ENTRY_POINTS)
def test_entry_points(call, tmp_path):
    function, category = ENTRY_POINTS[call]
    assert call in line_of_warning(lambda: function(tmp_path / "table.csv"), category)


def test_frames_of_other_packages_are_the_users():
    """The line of a package that is not of the project is named, not that of its caller."""
    namespace = {"__name__": "jaxlidar_extension", "warn_user": warn_user}
    code = compile("def warn():\n    warn_user('a message')\n", "extension.py", "exec")
    exec(code, namespace)
    with pytest.warns(UserWarning, match="a message") as caught:
        namespace["warn"]()
    assert (caught[0].filename, caught[0].lineno) == ("extension.py", 2)


VOXELS = jl.VoxelMap.from_lad(np.full((4, 4, 2), 0.5), voxel_size=1.0, origin=(0.0, 0.0, 4.0))
BELOW = np.tile([2.0, 2.0, 1.5], (2, 1))
UPWARDS = jl.Survey(jl.instrument("RIEGL VZ-400"), sensor=BELOW, zenith=[180.0, 0.0], azimuth=0.0)


def crown():
    canopy = jl.Canopy(VOXELS, leaf=jl.LeafOptics(0.4, 0.4))
    return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3))


def simulated(survey, scene):
    return jl.simulate_many(survey, scene, key=KEY, rtol=0.3, max_orders=1)


def test_returns_of_crowns_alone():
    """Shots upwards into voxels are told."""
    many = simulated(UPWARDS, crown())

    def call():
        many.returns()

    assert "many.returns()" in line_of_warning(call, UserWarning)
    with pytest.warns(UserWarning, match="1 of 2 shots see crowns alone, by beams narrower than voxels"):
        many.returns()


@pytest.mark.slow
def test_returns_of_ground_leaves_and_wide_beams():
    """Nothing is told of shots that see the ground as well, leaves, or more than a voxel."""
    leaves = jl.Scene(meshes=[jl.leaf_mesh(VOXELS, 0.05, key=KEY, leaf=jl.LeafOptics(0.4, 0.4))])
    downwards = jl.Survey(jl.Lidar(divergence=0.01), [(2.0, 2.0)])
    wide = jl.Survey(jl.Lidar(divergence=300.0, sensor=(0, 0, 0)), sensor=BELOW, zenith=180.0)
    # Warnings are errors in tests.
    for survey, scene in ((UPWARDS, leaves), (downwards, crown()), (wide, crown())):
        simulated(survey, scene).returns()
