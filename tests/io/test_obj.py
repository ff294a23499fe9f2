"""OBJ files: continued lines, comments after statements, names in Latin-1, vertices without a face."""

import numpy as np
import pytest

from jaxlidar.io import read_obj

SQUARE = "v 0 0 1\nv 2 0 1\nv 2 1 1\nv 0 1 1\nusemtl leaf\nf 1 2 3 4\n"


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
    mesh, dropped = read_obj(write_mesh(text))
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3]])
    assert mesh.area.sum() == pytest.approx(2.0)
    assert (mesh.materials, dropped) == (("leaf",), {"without an area": 0})


def test_names_may_have_the_sign_of_comments(write_mesh):
    assert read_obj(write_mesh(SQUARE.replace("leaf", "leaf#1 #2"))).mesh.materials == ("leaf#1",)


def test_an_error_names_the_line_where_the_statement_begins(write_mesh):
    with pytest.raises(ValueError, match=r"plant\.obj: line 6: vertex 9; those before are 1 to 4"):
        read_obj(write_mesh(SQUARE.replace("f 1 2 3 4", "f 1 2 \\\n3 9")))
    with pytest.raises(ValueError, match=r"plant\.obj: line 8: 'surf' is no statement"):
        read_obj(write_mesh(SQUARE.replace("f 1 2 3 4", "f 1 2 \\\n3 4") + "surf 1\n"))


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "cp1252"])
def test_names_in_other_encodings(write_mesh, encoding):
    mesh, _ = read_obj(write_mesh("# Bäume\n" + SQUARE.replace("leaf", "grüne Blätter"), encoding))
    assert mesh.materials == ("grüne Blätter",)


def test_a_file_that_is_no_text(write_mesh):
    path = write_mesh(SQUARE)
    path.write_bytes(path.read_bytes() + b"\n\x81\x8d\n")
    with pytest.raises(ValueError, match=r"plant\.obj: not a text file: line 8: "):
        read_obj(path)


@pytest.mark.parametrize("wrong", ["nan", "inf", "1e12"])
def test_vertices_without_a_face_may_be_anywhere(write_mesh, wrong):
    text = f"v 0 {wrong} 0\n" + SQUARE.replace("f 1 2 3 4", f"v {wrong} 0 0\nf 2 3 4 -2\nf -5 -4 -3")
    mesh, _ = read_obj(write_mesh(text))
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 1], [2, 0, 1], [2, 1, 1], [0, 1, 1]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 1, 2]])
    with pytest.raises(ValueError, match=r"plant\.obj: line 1: vertex at \(0\.0, "):
        read_obj(write_mesh(text + "f 1 2 3\n"))
