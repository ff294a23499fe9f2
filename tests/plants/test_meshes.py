"""Triangle meshes: areas in voxels against closed forms and another implementation, and files of them."""

import re
import warnings

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.io import read_case, read_mesh
from tests.helpers import SINGLE_SAMPLE, single_sample_lidar

trimesh = pytest.importorskip("trimesh")
# Spheres and boxes whose area in voxels is known are closed. By its words: naming the class would import the
# package before the tests' type checks are in place.
pytestmark = pytest.mark.filterwarnings("ignore:the mesh is closed")


def areas(voxels):
    """One-sided leaf area in every voxel, m2."""
    return 2 * np.asarray(voxels.leaf, float) * np.prod(np.asarray(voxels.voxel_size, float))


def mesh_of(trimesh_mesh):
    """A mesh of the package trimesh as one of jaxlidar."""
    return jl.Mesh(np.asarray(trimesh_mesh.vertices), np.asarray(trimesh_mesh.faces))


def random_triangles(n, seed=0, size=0.3):
    """Triangles of random directions, about `size` m; some with corners or sides in planes of the grid."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(0.0, 3.0, (n, 1, 3)) + size * rng.normal(size=(n, 3, 3))
    corners[::3] = np.round(corners[::3] * 4) / 4
    return jl.Mesh(corners.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3))


def test_area_is_conserved_and_the_order_of_triangles_and_corners_does_not_matter(precision):
    mesh = random_triangles(3000)
    total = areas(jl.voxelise_mesh(mesh, (0.25, 0.5, 1.0)))
    tolerance = {"float32": 1e-6, "float64": 1e-12}[precision]
    assert total.sum() == pytest.approx(mesh.area.sum(), rel=tolerance)
    reordered = jl.Mesh(mesh.vertices, mesh.faces[::-1, [2, 0, 1]])
    np.testing.assert_allclose(areas(jl.voxelise_mesh(reordered, (0.25, 0.5, 1.0))), total, atol=1e-6)


def test_voxels_of_a_mesh_have_the_area_that_trimesh_cuts_out():
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=1.1)
    sphere.apply_translation((0.03, -0.11, 0.21))
    voxels = jl.voxelise_mesh(mesh_of(sphere), 0.4)
    leaf_area, low = areas(voxels), np.asarray(voxels.origin, float)
    occupied = np.argwhere(leaf_area > 0)
    assert len(occupied) > 100
    for voxel in occupied[::9]:
        corner = low + 0.4 * voxel
        planes = [(corner, n) for n in np.eye(3)] + [(corner + 0.4, -n) for n in np.eye(3)]
        vertices, faces = sphere.vertices, sphere.faces
        for origin, normal in planes:
            vertices, faces, _ = trimesh.intersections.slice_faces_plane(vertices, faces, normal, origin)
        area = trimesh.triangles.area(vertices[faces]).sum()
        assert leaf_area[tuple(voxel)] == pytest.approx(area, rel=1e-5, abs=1e-8)


def test_a_tilted_plane():
    """Over each column the area is that of the column over the cosine, split where it meets faces."""
    steep = np.array([[0, 0, 0.1], [3, 0, 6.1], [3, 2, 6.1], [0, 2, 0.1]])
    voxels = jl.voxelise_mesh(jl.Mesh(steep, np.array([[0, 1, 2], [0, 2, 3]])), 1.0)
    assert voxels.shape == (3, 2, 7)
    # The length in x of the plane z = 2 x + 0.1 within each voxel.
    length = np.array(
        [[0.45, 0.5, 0.05] + [0] * 4, [0] * 2 + [0.45, 0.5, 0.05] + [0] * 2, [0] * 4 + [0.45, 0.5, 0.05]]
    )
    np.testing.assert_allclose(areas(voxels), np.sqrt(5) * length[:, None, :].repeat(2, axis=1), atol=1e-6)


def test_layers_of_a_sphere():
    """Every layer between two planes through a sphere has the area 2 pi r dz (Archimedes)."""
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=2.0)
    voxels = jl.voxelise_mesh(mesh_of(sphere), (4.0, 4.0, 0.5))
    np.testing.assert_allclose(areas(voxels).sum(axis=(0, 1)), 2 * np.pi * 2.0 * 0.5, rtol=2e-3)
    assert voxels.shape[2] == 8


def test_leaf_angles_are_those_of_the_normals():
    sphere = jl.voxelise_mesh(mesh_of(trimesh.creation.icosphere(subdivisions=5)), 1.0)
    spherical = jl.LeafAngles.named("spherical").normalised()
    # Twenty thousand triangles fill cells unevenly; their distribution function is even.
    cumulative = (np.cumsum(probability) for probability in (sphere.leaf_angles.normalised(), spherical))
    np.testing.assert_allclose(*cumulative, atol=1e-2)
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    # G towards the nadir of a horizontal and of a vertical triangle.
    for corners, nadir in (([0, 1, 2], 1.0), ([0, 1, 3], 0.0)):
        angles = jl.voxelise_mesh(jl.Mesh(flat, np.array([corners])), 1.0).leaf_angles
        # Cells are a degree wide.
        assert float(angles.tables()[0][-1]) == pytest.approx(nadir, abs=0.01)
    named = jl.voxelise_mesh(random_triangles(10), 1.0, leaf_angles="planophile").leaf_angles
    assert np.array_equal(named.probability, jl.LeafAngles.named("planophile").probability)
    assert jl.voxelise_mesh(random_triangles(10), 1.0, leaf_angles="spherical").leaf_angles is None


def test_bark_is_a_quarter_of_its_surface_and_materials_are_chosen_by_name():
    box = trimesh.creation.box(extents=(0.2, 0.2, 2.0))
    n = len(box.faces)
    faces = np.concatenate([box.faces, box.faces[:2]])
    mesh = jl.Mesh(np.asarray(box.vertices), faces, np.repeat([1, 0], [n, 2]), ("leaf", "trunk", "pot"))
    leaf_and_bark = jl.voxelise_mesh(mesh, 0.5, bark="trunk")
    assert float(leaf_and_bark.bark.sum()) * 0.5**3 == pytest.approx(box.area / 4, rel=1e-6)
    assert areas(leaf_and_bark).sum() == pytest.approx(mesh.area[n:].sum(), rel=1e-6)
    bark_only = jl.voxelise_mesh(mesh, 0.5, leaf=(), bark=["trunk"])
    assert bark_only.leaf is None
    leaf_only = jl.voxelise_mesh(mesh, 0.5, leaf="leaf")
    assert leaf_only.bark is None
    assert areas(leaf_only).sum() == pytest.approx(mesh.area[n:].sum(), rel=1e-6)


def test_a_given_grid_and_pieces_in_its_faces():
    """A sheet in the face between two voxels lies in the upper one, and at the top in the last."""
    sheet = np.array([[0.0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    for layers, occupied in ((2, 1), (1, 0)):
        voxels = jl.voxelise_mesh(jl.Mesh(sheet, faces), 1.0, origin=(0, 0, 0), shape=(1, 1, layers))
        assert areas(voxels)[0, 0, occupied] == 1.0
    # Below the face by less than rounding: in the face.
    just_below = jl.Mesh(sheet * [1, 1, 1 - 1e-12], faces)
    assert areas(jl.voxelise_mesh(just_below, 1.0, origin=(0, 0, 0), shape=(1, 1, 2)))[0, 0, 1] == 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bark": "stem"}, "'stem' is no material of the mesh; it has 'mesh'"),
        ({"leaf": "mesh", "bark": "mesh"}, "'mesh' is among the materials of leaf and of bark"),
        ({"leaf": ()}, "0 triangles are leaf or bark"),
        ({"voxel_size": 0.0}, "voxel_size = 0"),
        ({"leaf_angles": "wild"}, "leaf_angles = 'wild'"),
        ({"origin": (0, 0, 0), "shape": (1, 1, 1)}, "out of the grid"),
    ],
)
def test_inadmissible_arguments(change, message):
    with pytest.raises(ValueError, match=message):
        jl.voxelise_mesh(**{"mesh": random_triangles(10), "voxel_size": 0.5, **change})


def test_inadmissible_meshes():
    vertices, face = np.eye(3), np.array([[0, 1, 2]])
    for arguments, message in (
        ((vertices * np.nan, face), "vertices = nan"),
        ((vertices, face + 1), r"faces = 3 .*\[0, 2\]"),
        ((vertices, face - 1), "faces = -1"),
        ((vertices, face[:0]), "faces is empty"),
        ((vertices, face, np.array([1])), "material = 1"),
        ((vertices, face, np.array([0]), ("a", "a")), "has a name twice"),
    ):
        with pytest.raises(ValueError, match=message):
            jl.Mesh(*arguments)
    line = jl.Mesh(np.array([[0.0, 0, 0], [1, 1, 1], [2, 2, 2]]), face)
    with pytest.raises(ValueError, match="1 triangles are leaf or bark, none with an area"):
        jl.voxelise_mesh(line, 1.0)


OBJ = """# a plant
mtllib plant.mtl
o plant
v 0 0 1 0.5 0.5 0.5
v 2 0 1
v 2 1 1
v 0 1 1
vt 0 0
vn 0 0 1
v 1 0 0
usemtl green leaf
s off
f 1/1/1 2/1/1 3//1 4
usemtl stem
g lower
f -1 2 -5
f 1 1 2
"""


@pytest.fixture
def obj_file(tmp_path):
    """A function that writes a text to a file, and returns its path."""

    def write(text):
        path = tmp_path / "plant.obj"
        path.write_text(text)
        return path

    return write


def test_an_obj_file(obj_file):
    mesh, dropped = read_mesh(obj_file(OBJ))
    assert mesh.materials == ("green leaf", "stem")
    assert mesh.material.tolist() == [0, 0, 1]
    assert mesh.area.tolist() == [1.0, 1.0, 1.0]
    assert dropped == {"without an area": 1}
    groups, _ = read_mesh(obj_file(OBJ), part="group", scale=0.1, up="y")
    assert groups.materials == ("unnamed", "lower")
    assert groups.area.sum() == pytest.approx(0.03)
    np.testing.assert_allclose(groups.vertices[0], [0.0, -0.1, 0.0])
    assert read_mesh(obj_file(OBJ), part="object")[0].materials == ("plant",)


def test_an_obj_file_that_trimesh_writes(obj_file):
    sphere = trimesh.creation.icosphere(subdivisions=2)
    mesh, dropped = read_mesh(obj_file(trimesh.exchange.obj.export_obj(sphere, digits=17)))
    np.testing.assert_array_equal(mesh.vertices, sphere.vertices)
    np.testing.assert_array_equal(mesh.faces, sphere.faces)
    assert mesh.area.sum() == pytest.approx(sphere.area)
    assert (mesh.materials, dropped) == (("unnamed",), {"without an area": 0})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("v 2 1 1", "v 2 x 1"), "line 6: y = 'x' is no number"),
        (("v 2 1 1", "v 2 nan 1"), r"line 6: vertex at \(2.0, nan, 1.0\)"),
        (("v 2 1 1", "v 2 1e12 1"), r"line 6: vertex at .*\[-1e\+09, 1e\+09\]"),
        (("v 2 1 1", "v 2 1"), "line 6: 2 numbers of a vertex"),
        (("f -1 2 -5", "f -1 2 -6"), "line 16: vertex -6; those before are 1 to 5"),
        (("f -1 2 -5", "f 5 2 0"), "line 16: vertex 0; those"),
        (("f -1 2 -5", "f 5 2 6"), "line 16: vertex 6; those"),
        (("f -1 2 -5", "f 5 2 1.5"), "line 16: f = '1.5' is no whole number"),
        (("f -1 2 -5", "f 5 2"), "line 16: a face of 2 corners"),
        (("f -1 2 -5", "surf 0 1 0 1"), "line 16: 'surf' is no statement of a mesh"),
        (("v 0 1 1", "v 1.9 0.5 1"), "line 13: a face that is not convex"),
        (("f ", "p "), "line 17: there is no face in the file"),
    ],
)
def test_damaged_obj_files(obj_file, change, message):
    with pytest.raises(ValueError, match=rf"plant.obj: {message}"):
        read_mesh(obj_file(OBJ.replace(*change)))


def test_faces_without_any_area(obj_file):
    with pytest.raises(ValueError, match=r"plant\.obj: line 3: 1 triangles, none with an area"):
        read_mesh(obj_file("v 0 0 0\nv 1 1 1\nf 1 1 2\n"))


def test_a_case_voxelises_a_mesh(obj_file, tmp_path):
    obj_file(OBJ)
    case = tmp_path / "case.toml"
    case.write_text(
        '[scene.canopy]\nleaf = "Prospect"\nbark = 0.3\n[scene.canopy.voxels]\nkind = "voxelise_mesh"\n'
        'voxel_size = 0.5\nbark = ["stem"]\nmesh = {kind = "read_mesh", path = "plant.obj"}\n'
    )
    voxels = read_case(case).scene.canopy.voxels
    assert areas(voxels).sum() == pytest.approx(2.0, rel=1e-6)
    assert float(voxels.bark.sum()) * 0.5**3 == pytest.approx(0.25, rel=1e-6)


def test_closed_surfaces_warn_of_the_light_that_passes_their_voxels():
    """A closed box 2 m wide: tau is a quarter of its 24 m2 over the 4 m2 of the column of its voxel."""
    box = mesh_of(trimesh.creation.box(bounds=[[0, 0, 0], [2, 2, 2]]))
    assert np.exp(-24 / 4 / 4) == pytest.approx(0.22, abs=0.005)
    with pytest.warns(jl.SolidMeshWarning, match=r"voxels let 22 % of it pass.* Scene\(meshes="):
        jl.voxelise_mesh(box, 2.0, bark="mesh", leaf=())
    # Without a lid it is open.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jl.voxelise_mesh(jl.Mesh(box.vertices, box.faces[2:]), 2.0, bark="mesh", leaf=())


@pytest.mark.slow
@pytest.mark.parametrize("materials", [{"bark": "mesh", "leaf": ()}, {"leaf": "mesh"}])
def test_the_share_that_passes_voxels_is_that_of_a_simulation(materials):
    """The voxels of a house, side by side without end, pass as much light to the ground as the warning says.

    With leaf they do not where its angles are taken as spherical: 14 % in place of 17 %.
    """
    corners = [[x, y, z] for x in (0, 4) for y in (0, 4) for z in (0, 2)]
    house = mesh_of(trimesh.convex.convex_hull([*corners, [0, 2, 3.5], [4, 2, 3.5]]))
    with pytest.warns(jl.SolidMeshWarning) as messages:
        voxels = jl.voxelise_mesh(house, 1.0, **materials)
    stated = re.search(r"let (\d+) % of it pass", str(messages[0].message))
    assert stated is not None
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4), bark=0.4, sides="periodic")
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3))
    lidar = single_sample_lidar(divergence=0.2, profile="top-hat")
    wave = jl.simulate(lidar, scene, key=jax.random.key(0), max_orders=1, **SINGLE_SAMPLE)
    passes = float(wave.components["ground"].sum()) / 0.3
    # The warning has whole percents.
    assert 0.01 * int(stated.group(1)) == pytest.approx(passes, abs=0.006)
    assert 0.1 < passes < 0.5


def test_a_tree_as_triangles():
    """Tubes have the volume of their frustums, leaves their area and the spherical distribution."""
    tree = jl.turtle("F[+FJ]FJ", angle=45, length=2.0, radius=0.1)
    mesh = jl.mesh_of(tree, sides=12, leaves=500, leaf_length=0.1)
    assert mesh.materials == ("wood", "leaf")
    is_leaf = mesh.of("leaf")
    # Two clumps; a rhombus of 0.1 m by 0.05 m.
    assert mesh.area[is_leaf].sum() == pytest.approx(2 * 500 * 0.5 * 0.1 * 0.05, rel=1e-9)
    upright = np.cross(*(mesh.corners[is_leaf][:, k] - mesh.corners[is_leaf][:, 0] for k in (1, 2)))
    cosine = np.abs(upright[:, 2]) / np.linalg.norm(upright, axis=1)
    assert cosine.mean() == pytest.approx(0.5, abs=0.03)
    # Tubes look outwards, and have the volume of prisms: a third of the sum of base heights times areas, with
    # the lids of their ends, which lie across the axis.
    for segment in range(len(tree.start)):
        triangles = mesh.corners[~is_leaf].reshape(2, -1, 12, 3, 3)[:, segment].reshape(-1, 3, 3)
        outward = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        from_start = triangles[:, 0] - tree.start[segment]
        sides = (outward * from_start).sum() / 6
        top = np.pi / 3 * tree.radius_end[segment] ** 2 * tree.length[segment]
        a, b = tree.radius_start[segment], tree.radius_end[segment]
        volume = np.pi / 3 * tree.length[segment] * (a * a + a * b + b * b)
        assert sides + top == pytest.approx(volume, rel=1e-9)
    assert jl.mesh_of(tree.leafless()).materials == ("wood",)
    with pytest.raises(ValueError, match="sides = 2"):
        jl.mesh_of(tree, sides=2)
    with pytest.raises(ValueError, match="no segments and no leaves"):
        jl.mesh_of(jl.turtle("", angle=0, length=1.0, radius=0.1), leaves=0)
