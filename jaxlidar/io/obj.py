"""Reader of triangle meshes in Wavefront's OBJ format."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxlidar._fields.checks import check_choice, check_number
from jaxlidar.io.checks import MAX_COORDINATE
from jaxlidar.io.coordinates import unit_length
from jaxlidar.io.text import parse_integer, parse_number, read_lines
from jaxlidar.plants.meshes import Mesh

# Statements that name the faces that follow, by the argument `part`.
_NAMING_STATEMENTS = {"material": "usemtl", "group": "g", "object": "o"}
# Statements without surfaces: textures, normals, shading, points and lines.
_IGNORED_STATEMENTS = frozenset(
    {"vt", "vn", "vp", "s", "mtllib", "p", "l", "mg", "lod", "bevel", "c_interp", "d_interp"}
)
# Comments: after statements that name something, only where a blank precedes; names may have the sign.
_COMMENT, _COMMENT_AFTER_NAME = re.compile(r"#.*"), re.compile(r"(^|\s)#.*")
# A comment that names the unit of length, such as SketchUp's "# File units = meters".
_UNIT_COMMENT = re.compile(r"\s*#.*\bunits?\s*[:=]\s*(.*?)\s*$", re.IGNORECASE)
_UNNAMED = "unnamed"
_NO_AREA = "without an area"


class MeshRead(NamedTuple):
    """Result of `read_obj`: a mesh, and the number of triangles that were left out of it.

    - `mesh`: a `Mesh`.
    - `dropped`: number of triangles of the file that are not in the mesh, by reason.

    **Example:**

    >>> import numpy as np, jaxlidar as jl
    >>> from jaxlidar.io import MeshRead
    >>> leaf = jl.Mesh(np.eye(3), np.array([[0, 1, 2]]))
    >>> mesh, dropped = MeshRead(leaf, {"without an area": 0})
    >>> print(f"{mesh.area.sum():.3f} m2", dropped)
    0.866 m2 {'without an area': 0}
    """

    mesh: Mesh
    dropped: dict[str, int]


def read_obj(
    path: str | os.PathLike[str], *, part: str = "material", scale: float | None = None, up: str = "z"
) -> MeshRead:
    r"""Read the triangle mesh of a Wavefront OBJ file, with the names of its materials, groups or objects.

    Faces of more than three corners must be flat and convex, and are cut into triangles. Vertices without a
    face may be at places that are not numbers; these vertices are not in the mesh. Other formats are read by
    the package trimesh: `Mesh(other.vertices, other.faces)`.

    **Arguments:**

    - `path`: an OBJ file; its .mtl file is not needed.
    - `part`: the kind of names that become `Mesh.materials`: "material" (`usemtl`), "group" (`g`) or "object"
      (`o`). Faces before the first of these are "unnamed". Default "material".
    - `scale`: metres per unit of length in the file, positive. Default None: the unit that a comment names,
      as in "# units: cm", otherwise metres.
    - `up`: the file's vertical axis, "z" or "y"; of y, x stays and y becomes z. Default "z".

    **Returns:** a `MeshRead`: the `Mesh`, and the number of triangles that were left out, by reason: those
    "without an area".

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the line, for
    corners of faces whose coordinates are not numbers or not on Earth, indices of missing vertices, faces of
    fewer than three corners or that are not convex, statements that are not known, and comments that name an
    unknown unit or several units. ValueError for other inadmissible arguments, and for a file without a
    triangle that has an area.

    **Source:** Wavefront Technologies (1989), Advanced Visualizer manual, appendix B1.

    **Example:**

    >>> import pathlib, tempfile
    >>> import jaxlidar.io
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "plant.obj"
    >>> corners = "v 0 0 1\nv 2 0 1\nv 2 1 1\nv 0 1 1\nv 1 0 0\n"
    >>> _ = path.write_text(corners + "usemtl leaf\nf 1 2 3 4\nusemtl stem\nf 1 5 2\n")
    >>> mesh, dropped = jaxlidar.io.read_obj(path)
    >>> print(mesh.materials, mesh.area.tolist(), dropped)
    ('leaf', 'stem') [1.0, 1.0, 1.0] {'without an area': 0}
    """
    check_choice("part", part, tuple(_NAMING_STATEMENTS))
    if scale is not None:
        check_number("scale", scale, 0.0, low_open=True)
    check_choice("up", up, ("z", "y"))
    path, lines = read_lines(path)
    statements = _Statements(path, _NAMING_STATEMENTS[part])
    for number, statement in _joined_statements(lines):
        statements.add(number, statement)
    if not statements.faces:
        raise ValueError(f"{path}: line {len(lines)}: there is no face in the file")
    metres_per_unit = _unit(path, lines) if scale is None else scale
    vertices = _remove_misplaced_vertices(path, statements) * metres_per_unit
    if up == "y":
        x, y, z = vertices.T
        vertices = np.stack([x, -z, y], axis=1)
    triangles, face = _triangles(path, statements, vertices)
    # All names of the file remain, also those without a triangle that has an area.
    mesh = Mesh(vertices, triangles, np.array(statements.material)[face], tuple(statements.names))
    has_area = mesh.area > 0
    if not has_area.any():
        raise ValueError(f"{path}: line {len(lines)}: {len(has_area)} triangles, none with an area")
    mesh = Mesh(vertices, triangles[has_area], mesh.material[has_area], mesh.materials)
    return MeshRead(mesh, {_NO_AREA: int(np.sum(~has_area))})


def _joined_statements(lines: list[str]) -> Iterator[tuple[int, str]]:
    """Yield statements without comments, and the number of the line in which each begins.

    A statement goes on in the next line after a backslash at the end.
    """
    statement, first = "", 0
    for number, line in enumerate(lines, 1):
        text = (_without_comment(line) if "#" in line else line).rstrip()
        first = first or number
        if text.endswith("\\"):
            statement += text[:-1] + " "
            continue
        yield first, statement + text
        statement, first = "", 0
    if first:
        yield first, statement


def _without_comment(line: str) -> str:
    kind = line.split(maxsplit=1)[0]
    return (_COMMENT_AFTER_NAME if kind in _NAMING_STATEMENTS.values() else _COMMENT).sub("", line)


class _Statements:
    """Vertices and faces of a file, with the line of each, and the number of the name of each face."""

    def __init__(self, path: Path, naming: str):
        self.path, self.naming = path, naming
        self.vertices: list[list[float]] = []
        self.vertex_lines: list[int] = []
        self.faces: list[list[int]] = []
        self.face_lines: list[int] = []
        self.material: list[int] = []
        self.names: dict[str, int] = {}
        self.name = _UNNAMED

    def add(self, number: int, statement: str) -> None:
        """Add a statement, which begins in a line."""
        words = statement.split()
        if not words:
            return
        kind, *words = words
        if kind == "v":
            self._add_vertex(number, words)
        elif kind == "f":
            self._add_face(number, words)
        elif kind == self.naming:
            self.name = " ".join(words) or _UNNAMED
        elif kind not in _IGNORED_STATEMENTS and kind not in _NAMING_STATEMENTS.values():
            raise ValueError(
                f"{self.path}: line {number}: {kind[:40]!r} is no statement of a mesh of polygons"
            )

    def _add_vertex(self, number: int, words: list[str]) -> None:
        # A weight or a colour may follow.
        if len(words) not in (3, 4, 6, 7):
            raise ValueError(f"{self.path}: line {number}: {len(words)} numbers of a vertex; 3 belong here")
        try:
            position = [float(word) for word in words[:3]]
        except ValueError:
            # Again, for an error that names the coordinate.
            position = [parse_number(self.path, number, axis, word) for axis, word in zip("xyz", words)]
        self.vertices.append(position)
        self.vertex_lines.append(number)

    def _add_face(self, number: int, words: list[str]) -> None:
        if len(words) < 3:
            raise ValueError(
                f"{self.path}: line {number}: a face of {len(words)} corners; admissible are 3 or more"
            )
        try:
            corners = [int(word.partition("/")[0]) for word in words]
        except ValueError:
            corners = [parse_integer(self.path, number, "f", word.partition("/")[0]) for word in words]
        count = len(self.vertices)
        for i, corner in enumerate(corners):
            if not (1 <= corner <= count or -count <= corner <= -1):
                raise ValueError(
                    f"{self.path}: line {number}: vertex {corner}; those before are 1 to {count}, or -1 to "
                    f"-{count} from the last"
                )
            corners[i] = corner - 1 if corner > 0 else count + corner
        self.faces.append(corners)
        self.face_lines.append(number)
        self.material.append(self.names.setdefault(self.name, len(self.names)))


def _unit(path: Path, lines: list[str]) -> float:
    """Return the metres of the unit of length that comments name; 1 where none does.

    **Raises:** ValueError, naming the file and the line, for an unknown unit, and for several.
    """
    sizes = {}
    for number, line in enumerate(lines, 1):
        if name := _UNIT_COMMENT.match(line):
            sizes[unit_length(f"{path}: line {number}", name[1]) or 1.0] = number
    if len(sizes) > 1:
        raise ValueError(
            f"{path}: lines {', '.join(map(str, sizes.values()))} name different units of length"
        )
    return next(iter(sizes), 1.0)


def _remove_misplaced_vertices(path: Path, statements: _Statements) -> Float[np.ndarray, "m 3"]:
    """Remove vertices that are not finite, or not on Earth, from the faces' numbers; return the others.

    **Raises:** ValueError for one that is a corner of a face.
    """
    vertices = np.array(statements.vertices)
    is_misplaced = ~np.all(np.abs(vertices) <= MAX_COORDINATE, axis=1)
    if not is_misplaced.any():
        return vertices
    is_corner = np.zeros(len(vertices), bool)
    is_corner[[corner for face in statements.faces for corner in face]] = True
    if np.any(is_misplaced & is_corner):
        first = int(np.argmax(is_misplaced & is_corner))
        raise ValueError(
            f"{path}: line {statements.vertex_lines[first]}: vertex at {tuple(statements.vertices[first])}; "
            f"admissible are numbers in [-{MAX_COORDINATE:g}, {MAX_COORDINATE:g}]"
        )
    number = (np.cumsum(~is_misplaced) - 1).tolist()
    statements.faces = [[number[corner] for corner in face] for face in statements.faces]
    return vertices[~is_misplaced]


def _triangles(
    path: Path, statements: _Statements, vertices: Float[np.ndarray, "m 3"]
) -> tuple[Int[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Cut faces into triangles that share the first corner of their face; return also the face of each."""
    size = np.array([len(face) for face in statements.faces])
    corners = np.array([corner for face in statements.faces for corner in face])
    # A face of n corners has n - 2 triangles: corners 0, k, k + 1 for k = 1 to n - 2.
    face = np.repeat(np.arange(size.size), size - 2)
    first = (np.cumsum(size) - size)[face]
    k = np.arange(face.size) - np.repeat(np.cumsum(size - 2) - (size - 2), size - 2) + 1
    triangles = np.stack([corners[first], corners[first + k], corners[first + k + 1]], axis=1)
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    face_normal = np.stack([np.bincount(face, axis, size.size) for axis in normal.T], axis=1)
    # Triangles of a convex face turn the same way. Rounding may turn one that is nearly a line.
    is_reversed = np.sum(normal * face_normal[face], axis=1) < -1e-6 * np.sum(face_normal**2, axis=1)[face]
    if is_reversed.any():
        line = statements.face_lines[int(face[np.argmax(is_reversed)])]
        raise ValueError(f"{path}: line {line}: a face that is not convex; cut it into triangles")
    return triangles, face
