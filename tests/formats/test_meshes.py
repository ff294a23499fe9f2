"""Files of meshes: OBJ with continued lines, comments, names in Latin-1; units of PLY, STL and glTF."""

import sys

import numpy as np
import pytest
import trimesh

from jaxlidar.io import read_mesh

SQUARE = "v 0 0 1\nv 2 0 1\nv 2 1 1\nv 0 1 1\nusemtl leaf\nf 1 2 3 4\n"


# -- OBJ ---------------------------------------------------------------------------------------------------


@pytest.fixture
def write_mesh(tmp_path):
    """Writes a text, in an encoding, as an .obj file and returns its path."""

    def write(text, encoding="utf-8"):
        path = tmp_path / "plant.obj"
        path.write_bytes(text.encode(encoding))
        return path

    return write


@pytest.mark.parametrize(
    "text",
    [
        SQUARE.replace("f 1 2 3 4", "f 1 2 \\\n3 4"),
        SQUARE.replace("f 1 2 3 4", "f 1 \\  \n 2 \\\n3 \\\n4"),
        SQUARE.replace("f 1 2 3 4", "f 1 2 3 \\ # the last corner follows\n4"),
        SQUARE.replace("\n", " # a comment\n"),
        SQUARE.replace("2 1 1", "2 1 1#1"),
        SQUARE.replace("usemtl leaf", "# written to C:\\plants\\\nusemtl leaf"),
        SQUARE.replace("usemtl leaf", "mtllib plant.mtl # C:\\\nusemtl\tleaf\t# green"),
        SQUARE.rstrip("\n") + " \\",
    ],
)
def test_the_same_square(write_mesh, text):
    mesh, dropped = read_mesh(write_mesh(text))
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3]])
    assert mesh.area.sum() == pytest.approx(2.0)
    assert (mesh.materials, dropped) == (("leaf",), {"without an area": 0})


def test_names_may_have_the_sign_of_comments(write_mesh):
    assert read_mesh(write_mesh(SQUARE.replace("leaf", "leaf#1 #2"))).mesh.materials == ("leaf#1",)


def test_an_error_names_the_line_where_the_statement_begins(write_mesh):
    with pytest.raises(ValueError, match=r"plant\.obj: line 6: vertex 9; those before are 1 to 4"):
        read_mesh(write_mesh(SQUARE.replace("f 1 2 3 4", "f 1 2 \\\n3 9")))
    with pytest.raises(ValueError, match=r"plant\.obj: line 8: 'surf' is no statement"):
        read_mesh(write_mesh(SQUARE.replace("f 1 2 3 4", "f 1 2 \\\n3 4") + "surf 1\n"))


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "cp1252"])
def test_names_in_other_encodings(write_mesh, encoding):
    mesh, _ = read_mesh(write_mesh("# Bäume\n" + SQUARE.replace("leaf", "grüne Blätter"), encoding))
    assert mesh.materials == ("grüne Blätter",)


def test_a_file_that_is_no_text(write_mesh):
    path = write_mesh(SQUARE)
    path.write_bytes(path.read_bytes() + b"\n\x81\x8d\n")
    with pytest.raises(ValueError, match=r"plant\.obj: not a text file: line 8: "):
        read_mesh(path)


@pytest.mark.parametrize("wrong", ["nan", "inf", "1e12"])
def test_vertices_without_a_face_may_be_anywhere(write_mesh, wrong):
    text = f"v 0 {wrong} 0\n" + SQUARE.replace("f 1 2 3 4", f"v {wrong} 0 0\nf 2 3 4 -2\nf -5 -4 -3")
    mesh, _ = read_mesh(write_mesh(text))
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 1], [2, 0, 1], [2, 1, 1], [0, 1, 1]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 1, 2]])
    with pytest.raises(ValueError, match=r"plant\.obj: line 1: vertex at \(0\.0, "):
        read_mesh(write_mesh(text + "f 1 2 3\n"))


def test_trimesh_misreads_obj(write_mesh):
    """Why OBJ has a parser here: negative indices count from the last vertex before the face."""
    triangle = "v {0} 0 0\nv {0} 1 0\nv {0} 0 1\nusemtl leaf\nf -3 -2 -1\n"
    path = write_mesh(triangle.format(1) + triangle.format(5))
    mesh, _ = read_mesh(path)
    assert (mesh.corners[:, 0, 0].tolist(), mesh.materials) == ([1.0, 5.0], ("leaf",))
    scene = trimesh.load_scene(path, process=False)
    (geometry,) = scene.geometry.values()
    assert geometry.triangles[:, 0, 0].tolist() == [5.0, 5.0]
    assert not hasattr(geometry.visual, "material")


# -- PLY, STL and glTF -------------------------------------------------------------------------------------

# A mast of 10 m on the ground, 2 m by 1 m wide: its volume is positive if its triangles face outwards.
MAST = trimesh.creation.box(bounds=[[0, 0, 0], [2, 1, 10]])
VOLUME, AREA = 20.0, 2 * (2 * 1 + 2 * 10 + 1 * 10)
# Of glTF the vertical axis is y: z up becomes y up.
TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def volume(mesh):
    """Sum of the tetrahedra between the origin and each triangle."""
    a, b, c = np.moveaxis(mesh.corners, 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6.0)


def mast_file(folder, name, **options):
    """Write the mast in the format of the file's name, glTF with y up; return its path."""
    path = folder / name
    is_gltf = path.suffix in (".gltf", ".glb")
    mesh = MAST.copy()
    if is_gltf:
        mesh.apply_transform(TO_Y_UP)
    exported = mesh.export(file_type=path.suffix[1:], **options)
    for file, content in ({name: exported} if not isinstance(exported, dict) else exported).items():
        file = path if file.endswith(".gltf") else folder / file
        file.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


FORMATS = [
    ("mast.ply", {"encoding": "ascii"}),
    ("mast.ply", {"encoding": "binary"}),
    ("mast.STL", {}),
    ("mast.stl", {}),
    ("mast.gltf", {}),
    ("mast.glb", {}),
    ("mast.obj", {}),
]


@pytest.mark.parametrize(("name", "options"), FORMATS)
def test_formats(tmp_path, name, options):
    if name == "mast.STL":
        path = tmp_path / name
        path.write_text(trimesh.exchange.stl.export_stl_ascii(MAST))
    else:
        path = mast_file(tmp_path, name, **options)
    mesh, dropped = read_mesh(path)
    assert (mesh.materials, dropped) == (("unnamed",), {"without an area": 0})
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [2.0, 1.0, 10.0], rtol=1e-6)
    assert mesh.area.sum() == pytest.approx(AREA, rel=1e-6)
    assert volume(mesh) == pytest.approx(VOLUME, rel=1e-6)
    # The other axis, and a unit.
    other = "z" if path.suffix in (".gltf", ".glb") else "y"
    lying = read_mesh(path, up=other, scale=0.5).mesh
    np.testing.assert_allclose(np.ptp(lying.vertices, axis=0), [1.0, 5.0, 0.5], rtol=1e-6)
    assert volume(lying) == pytest.approx(VOLUME / 8, rel=1e-6)


PLY = """ply
format ascii 1.0
comment units: {unit}
element vertex 5
property double x
property double y
property double z
element face 2
property list uchar int vertex_indices
end_header
500000.12345678 5200000.25 0
500002.12345678 5200000.25 0
500002.12345678 5200001.25 0
500000.12345678 5200001.25 0
nan nan nan
3 0 1 2
3 0 2 3
"""


def test_map_coordinates_are_exact(tmp_path):
    path = tmp_path / "a.ply"
    path.write_text(PLY.format(unit="m"))
    mesh, _ = read_mesh(path)
    np.testing.assert_array_equal(mesh.vertices[0], [500000.12345678, 5200000.25, 0.0])
    assert len(mesh.vertices) == 4
    # Single precision within a node far away, as glTF has it.
    scene = trimesh.Scene()
    place = np.eye(4)
    place[:3, 3] = [500000.12345678, 7.0, -5200000.25]
    scene.add_geometry(MAST.copy().apply_transform(TO_Y_UP), transform=place)
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb"))
    low = read_mesh(tmp_path / "a.glb").mesh.vertices.min(axis=0)
    np.testing.assert_array_equal(low, [500000.12345678, 5200000.25, 7.0])


@pytest.mark.parametrize(("unit", "metres"), [("mm", 1e-3), ("feet", 0.3048), ("", 1.0)])
def test_declared_units(tmp_path, unit, metres):
    (tmp_path / "a.ply").write_text(PLY.format(unit=unit))
    assert read_mesh(tmp_path / "a.ply").mesh.area.sum() == pytest.approx(2.0 * metres**2)
    assert read_mesh(tmp_path / "a.ply", scale=3.0).mesh.area.sum() == pytest.approx(18.0)
    mast = MAST.copy()
    if unit:
        mast.units = unit
    (tmp_path / "a.glb").write_bytes(mast.export(file_type="glb"))
    assert read_mesh(tmp_path / "a.glb").mesh.area.sum() == pytest.approx(AREA * metres**2)
    assert read_mesh(tmp_path / "a.glb", scale=2.0).mesh.area.sum() == pytest.approx(AREA * 4)


def test_unknown_units(tmp_path):
    (tmp_path / "a.ply").write_text(PLY.format(unit="parsec"))
    with pytest.raises(ValueError, match=r"a\.ply: line 3: the unit 'parsec' is not known"):
        read_mesh(tmp_path / "a.ply")
    assert len(read_mesh(tmp_path / "a.ply", scale=1.0).mesh.faces) == 2
    scene = trimesh.Scene()
    for unit in ("mm", "m"):
        mast = MAST.copy()
        mast.units = unit
        scene.add_geometry(mast)
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb"))
    with pytest.raises(ValueError, match=r"a\.glb: several units of length: "):
        read_mesh(tmp_path / "a.glb")


def test_names_and_copies_in_a_gltf_file(tmp_path):
    """A mesh at two nodes, one of them mirrored, and another one of no material."""
    trunk = MAST.copy().apply_transform(TO_Y_UP)
    bark = trimesh.visual.material.PBRMaterial(name="bark")
    trunk.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(trunk.vertices), 2)), material=bark)
    mirror = np.diag([-2.0, 2.0, 2.0, 1.0])
    scene = trimesh.Scene()
    scene.add_geometry(trunk, node_name="first", geom_name="trunk")
    scene.graph.update("second", matrix=mirror, geometry="trunk")
    scene.add_geometry(trimesh.creation.box(), node_name="third", geom_name="crown")
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb"))
    names = {}
    for part in ("material", "group", "object"):
        mesh, _ = read_mesh(tmp_path / "a.glb", part=part)
        assert volume(mesh) == pytest.approx(VOLUME * (1 + 8) + 1, rel=1e-6)
        areas = np.bincount(mesh.material, mesh.area).round(4).tolist()
        names[part] = dict(zip(mesh.materials, areas, strict=True))
    assert names["material"] == {"bark": AREA * 5, "unnamed": 6.0}
    assert names["group"] == {"trunk": AREA * 5, "crown": 6.0}
    assert names["object"] == {"first": AREA, "second": AREA * 4, "third": 6.0}


def test_faces_of_many_corners_are_cut(tmp_path):
    """A square and the same square in two triangles."""
    text = PLY.format(unit="m").replace("3 0 1 2\n", "4 0 1 2 3\n")
    (tmp_path / "a.ply").write_text(text)
    assert read_mesh(tmp_path / "a.ply").mesh.area.tolist() == pytest.approx([1.0] * 3)


# PLY and STL as text hold all triangles without their last byte.
CUTS = [(*f, cut) for f in FORMATS[:-1] for cut in (1, 12, 60, 0.6, 0.9) if cut > 1 or f not in FORMATS[:3:2]]


@pytest.mark.parametrize(("name", "options", "cut"), CUTS)
def test_files_that_are_cut_short(tmp_path, name, options, cut):
    if name == "mast.STL":
        content = trimesh.exchange.stl.export_stl_ascii(MAST).encode()
        content = content + content
    else:
        content = mast_file(tmp_path, name, **options).read_bytes()
    length = int(cut * len(content)) if cut < 1 else len(content.rstrip()) - cut
    (tmp_path / name).write_bytes(content[:length])
    with pytest.raises(ValueError, match=rf"{name}: (damaged|cut short)"):
        read_mesh(tmp_path / name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("3 0 2 3", "3 0 2 9"), "damaged|a face has vertex 9"),
        (("3 0 2 3", "3 0 2 -1"), "a face has vertex -1; there are 0 to 4"),
        (("3 0 2 3", "3 0 2 4"), r"a vertex at \(nan, nan, nan\); admissible are numbers"),
        (("500002.12345678 5200000.25 0", "1e12 0 0"), r"a vertex at \(10{12}\.0"),
        (("vertex 5", "vertex 4000000000"), "cut short: 7 rows, of 4000000002"),
        (("face 2", "face 0"), "damaged|there is no face"),
        (("ply", "plx"), r"damaged, or no \.ply file"),
        (("3 0 1 2\n3 0 2 3", "3 0 1 1\n3 0 2 2"), "2 triangles, none with an area"),
    ],
)
def test_damaged_ply_files(tmp_path, change, message):
    path = tmp_path / "a.ply"
    path.write_text(PLY.format(unit="m").replace(*change))
    with pytest.raises(ValueError, match=rf"a\.ply: ({message})"):
        read_mesh(path)


def test_other_endings_and_packages(tmp_path, monkeypatch):
    path = tmp_path / "a.dxf"
    path.write_text("")
    with pytest.raises(ValueError, match=r"a\.dxf: the ending '\.dxf' is none of \.obj, \.ply"):
        read_mesh(path)
    with pytest.raises(FileNotFoundError, match=r"b\.ply: no such file"):
        read_mesh(tmp_path / "b.ply")
    (tmp_path / "a.ply").write_text(PLY.format(unit="m"))
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError, match=r"reading \.ply files needs trimesh: pip install"):
        read_mesh(tmp_path / "a.ply")
