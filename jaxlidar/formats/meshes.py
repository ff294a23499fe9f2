"""Reader of triangle meshes: OBJ here, PLY, STL and glTF by the package trimesh.

OBJ has a parser of its own: that of trimesh drops the names of materials without an .mtl file, and counts
negative indices from the last vertex of the file in place of the last one before the face.
"""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxlidar._fields.checks import check_choice, check_number, required_for
from jaxlidar._fields.units import unit_size
from jaxlidar.formats.checks import MAX_COORDINATE, existing_file
from jaxlidar.formats.text import parse_integer, parse_number, read_lines
from jaxlidar.plants.meshes import Mesh

# Endings of names of files, and the vertical axis of their format; None: it has none.
_UP = {".obj": None, ".ply": None, ".stl": None, ".gltf": "y", ".glb": "y"}
# Statements of OBJ that name the faces that follow, by the argument `part`.
_NAMING_STATEMENTS = {"material": "usemtl", "group": "g", "object": "o"}
# Statements without surfaces: textures, normals, shading, points and lines.
_IGNORED_STATEMENTS = frozenset(
    {"vt", "vn", "vp", "s", "mtllib", "p", "l", "mg", "lod", "bevel", "c_interp", "d_interp"}
)
# Comments: after statements that name something, only where a blank precedes; names may have the sign.
_COMMENT, _COMMENT_AFTER_NAME = re.compile(r"#.*"), re.compile(r"(^|\s)#.*")
# A comment that begins with the unit of length, such as SketchUp's "# File units = meters"; PLY's have a
# keyword.
_UNIT_COMMENT = re.compile(r"\s*(?:#|comment\b)\s*(?:\w+\s+)?units?\s*[:=]\s*(.*?)\s*$", re.IGNORECASE)
_PLY_COUNT = re.compile(rb"^element\s+\w+\s+(\d+)", re.MULTILINE)
# Bytes of a binary STL file before its triangles, and of each of them.
_STL_HEADER, _STL_TRIANGLE = 84, 50
_UNNAMED = "unnamed"
_NO_AREA = "without an area"


class MeshRead(NamedTuple):
    """Result of `read_mesh`: a mesh, and the number of triangles that were left out of it.

    - `mesh`: a `Mesh`.
    - `dropped`: number of triangles of the file that are not in the mesh, by reason.

    **Example:**

    >>> import numpy as np, jaxlidar as jl
    >>> from jaxlidar.formats.meshes import MeshRead
    >>> leaf = jl.Mesh(np.eye(3), np.array([[0, 1, 2]]))
    >>> mesh, dropped = MeshRead(leaf, {"without an area": 0})
    >>> print(f"{mesh.area.sum():.3f} m2", dropped)
    0.866 m2 {'without an area': 0}
    """

    mesh: Mesh
    dropped: dict[str, int]


class _StoredMesh(NamedTuple):
    """Triangles as a file has them, in its unit of length and with its vertical axis.

    - `metres_per_unit`: None where the file names no unit. - `location`: the file, and its last line.
    """

    vertices: Float[np.ndarray, "m 3"]
    faces: Int[np.ndarray, "n 3"]
    material: Int[np.ndarray, " n"]
    names: tuple[str, ...]
    metres_per_unit: float | None
    location: str


def read_mesh(
    path: str | os.PathLike[str],
    *,
    part: str = "material",
    scale: float | None = None,
    up: str | None = None,
) -> MeshRead:
    r"""Read the triangle mesh of an OBJ, PLY, STL or glTF file.

    Materials, groups or objects of the file become materials of the mesh. Faces of more than three corners
    must be flat and convex, and are cut into triangles. Coordinates are kept in double precision, those of
    maps exactly. Vertices without a face are left out. Formats other than OBJ need the package trimesh, which
    the extra `io` installs.

    **Arguments:**

    - `path`: a file that ends in .obj, .ply, .stl, .gltf or .glb. The .mtl file of an OBJ is not needed.
    - `part`: the kind of names that become `Mesh.materials`: "material" (`usemtl` of OBJ, materials of glTF),
      "group" (`g` of OBJ, meshes of glTF) or "object" (`o` of OBJ, nodes of glTF). Faces without one are
      "unnamed", as are those of PLY. Default "material".
    - `scale`: metres per unit of length in the file, positive, by which coordinates are multiplied in place
      of the unit that the file declares. Default None: that unit. It is that of a comment of an OBJ or PLY
      file, as in "# units: cm", or of "units" among the extras of a glTF file; otherwise the metre.
    - `up`: the file's vertical axis, "z" or "y"; of y, x stays, y becomes z, and z becomes -y. Default None:
      "y" for glTF, as its specification says, otherwise "z".

    **Returns:** a `MeshRead`: the `Mesh`, and the number of triangles that were left out, by reason: those
    "without an area".

    **Raises:** FileNotFoundError where there is no such file; ImportError without trimesh where it is needed.
    ValueError, naming the file, and in OBJ files the line, for another ending, for what is damaged or cut
    short, corners of faces whose coordinates are not numbers or not on Earth, indices of missing vertices,
    faces of OBJ of fewer than three corners or that are not convex, statements of OBJ that are not known, and
    unknown units or several ones. ValueError for other inadmissible arguments, and for a file without a
    triangle that has an area.

    **Source:** Wavefront Technologies (1989), Advanced Visualizer manual, appendix B1; ISO/IEC 12113:2022
    (glTF 2.0).

    **Example:**

    >>> import pathlib, tempfile
    >>> import jaxlidar.io
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "plant.obj"
    >>> corners = "v 0 0 1\nv 2 0 1\nv 2 1 1\nv 0 1 1\nv 1 0 0\n"
    >>> _ = path.write_text(corners + "usemtl leaf\nf 1 2 3 4\nusemtl stem\nf 1 5 2\n")
    >>> mesh, dropped = jaxlidar.io.read_mesh(path)
    >>> print(mesh.materials, mesh.area.tolist(), dropped)
    ('leaf', 'stem') [1.0, 1.0, 1.0] {'without an area': 0}
    """
    check_choice("part", part, tuple(_NAMING_STATEMENTS))
    if scale is not None:
        check_number("scale", scale, 0.0, low_open=True)
    if up is not None:
        check_choice("up", up, ("z", "y"))
    path = existing_file(path)
    ending = path.suffix.lower()
    if ending not in _UP:
        raise ValueError(f"{path}: the ending {ending!r} is none of {', '.join(_UP)}")
    uses_unit = scale is None
    stored = _read_obj(path, part, uses_unit) if ending == ".obj" else _read_other(path, part, uses_unit)
    vertices = stored.vertices * (scale or stored.metres_per_unit or 1.0)
    if (up or _UP[ending]) == "y":
        x, y, z = vertices.T
        vertices = np.stack([x, -z, y], axis=1)
    # All names of the file remain, also those without a triangle that has an area.
    mesh = Mesh(vertices, stored.faces, stored.material, stored.names)
    has_area = mesh.area > 0
    if not has_area.any():
        raise ValueError(f"{stored.location}: {len(has_area)} triangles, none with an area")
    mesh = Mesh(vertices, mesh.faces[has_area], mesh.material[has_area], mesh.materials)
    return MeshRead(mesh, {_NO_AREA: int(np.sum(~has_area))})


def _corner_vertices(
    path: Path, vertices: Float[np.ndarray, "m 3"], corners: Int[np.ndarray, "..."], lines: list[int] | None
) -> tuple[Float[np.ndarray, "k 3"], Int[np.ndarray, "..."]]:
    """Return the vertices that are corners of faces, and the corners by their number among these.

    `lines`: the line of each vertex, where a file has lines.

    **Raises:** ValueError for a corner that is missing, not finite or not on Earth.
    """
    used, corner_numbers = np.unique(corners, return_inverse=True)
    if used[0] < 0 or used[-1] >= len(vertices):
        wrong = used[0] if used[0] < 0 else used[-1]
        raise ValueError(f"{path}: a face has vertex {wrong}; there are 0 to {len(vertices) - 1}")
    (misplaced,) = np.nonzero(~np.all(np.abs(vertices[used]) <= MAX_COORDINATE, axis=1))
    if misplaced.size:
        first = used[misplaced[0]]
        place = "a" if lines is None else f"line {lines[first]}:"
        raise ValueError(
            f"{path}: {place} vertex at {tuple(vertices[first].tolist())}; admissible are numbers in "
            f"[-{MAX_COORDINATE:g}, {MAX_COORDINATE:g}]"
        )
    return vertices[used], corner_numbers.reshape(corners.shape)


def _unit(path: Path, lines: list[str]) -> float | None:
    """Return the metres of the unit of length that comments name; None where none does.

    **Raises:** ValueError, naming the file and the line, for an unknown unit, and for several.
    """
    sizes = {}
    for number, line in enumerate(lines, 1):
        if name := _UNIT_COMMENT.match(line):
            sizes[unit_size("length", f"{path}: line {number}", name[1]) or 1.0] = number
    if len(sizes) > 1:
        raise ValueError(
            f"{path}: lines {', '.join(map(str, sizes.values()))} name different units of length"
        )
    return next(iter(sizes), None)


# -- PLY, STL and glTF -------------------------------------------------------------------------------------


def _read_other(path: Path, part: str, uses_unit: bool) -> _StoredMesh:
    """Return the triangles of all nodes of a file that trimesh reads."""
    with required_for(f"reading {path.suffix} files"):
        import trimesh
    lines = _check_text(path)
    try:
        scene = trimesh.load_scene(path, process=False)
    # Parsers of trimesh raise errors of all kinds for damaged files, and a missing package where they guess
    # the encoding of what is no text.
    except Exception as error:
        detail = "" if isinstance(error, ImportError) else f" ({error})"
        raise ValueError(f"{path}: damaged, or no {path.suffix} file{detail}") from error
    is_gltf = _UP[path.suffix.lower()] == "y"
    vertices, faces, material, names, units, count = [], [], [], {}, set(), 0
    for node in scene.graph.nodes_geometry:
        transform, geometry_name = scene.graph[node]
        geometry: Any = scene.geometry[geometry_name]
        # Points and lines have no faces.
        if not isinstance(geometry, trimesh.Trimesh) or not len(geometry.faces):
            continue
        material_name = getattr(getattr(geometry.visual, "material", None), "name", None)
        by_part = {"material": material_name, "group": geometry_name, "object": node}
        name = by_part[part] if is_gltf and by_part[part] else _UNNAMED
        vertices.append(trimesh.transform_points(geometry.vertices, transform))
        # A mirrored copy has its front side behind.
        order = 1 if np.linalg.det(transform[:3, :3]) > 0 else -1
        faces.append(geometry.faces[:, ::order] + count)
        material.append(np.full(len(geometry.faces), names.setdefault(name, len(names))))
        units.add(geometry.units)
        count += len(geometry.vertices)
    if not faces:
        raise ValueError(f"{path}: there is no face in the file")
    metres = _unit(path, lines) if uses_unit else None
    if uses_unit and metres is None:
        if len(units) > 1:
            raise ValueError(f"{path}: several units of length: {', '.join(map(str, units))}")
        metres = unit_size("length", str(path), units.pop())
    vertices, faces = _corner_vertices(path, np.concatenate(vertices), np.concatenate(faces), None)
    return _StoredMesh(vertices, faces, np.concatenate(material), tuple(names), metres, str(path))


def _check_text(path: Path) -> list[str]:
    """Return the lines of the header of a PLY file; refuse text files of PLY and STL that end early.

    trimesh reads the triangles before the end of these.
    """
    ending = path.suffix.lower()
    content = path.read_bytes() if ending in (".ply", ".stl") else b""
    if ending == ".stl":
        is_text = len(content) < _STL_HEADER or (len(content) - _STL_HEADER) % _STL_TRIANGLE != 0
        last_line = content.strip().rpartition(b"\n")[2].strip().lower()
        if is_text and not last_line.startswith(b"endsolid"):
            raise ValueError(f"{path}: cut short, or no STL file: its last line is not that of a solid")
        return []
    header, _, body = content.partition(b"end_header")
    if b"format ascii" in header:
        # A vertex or a face is a line; the first one ends the header.
        rows = sum(1 for line in body.split(b"\n")[1:] if line.strip())
        declared = sum(map(int, _PLY_COUNT.findall(header)))
        if rows < declared:
            raise ValueError(f"{path}: cut short: {rows} rows, of {declared} that its header names")
    return header.decode("latin-1").splitlines()


# -- OBJ ---------------------------------------------------------------------------------------------------


def _read_obj(path: Path, part: str, uses_unit: bool) -> _StoredMesh:
    """Return the triangles of an OBJ file; its unit only where it is asked for, as it may be unknown."""
    path, lines = read_lines(path)
    location = f"{path}: line {len(lines)}"
    statements = _Statements(path, _NAMING_STATEMENTS[part])
    for number, statement in _joined_statements(lines):
        statements.add(number, statement)
    if not statements.faces:
        raise ValueError(f"{location}: there is no face in the file")
    corners = np.array([corner for face in statements.faces for corner in face])
    vertices, corners = _corner_vertices(
        path, np.array(statements.vertices), corners, statements.vertex_lines
    )
    faces, polygon = _triangles(path, statements, vertices, corners)
    material = np.array(statements.material)[polygon]
    metres = _unit(path, lines) if uses_unit else None
    return _StoredMesh(vertices, faces, material, tuple(statements.names), metres, location)


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


def _triangles(
    path: Path, statements: _Statements, vertices: Float[np.ndarray, "m 3"], corners: Int[np.ndarray, " k"]
) -> tuple[Int[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Cut faces into triangles that share the first corner of their face; return also the face of each.

    `corners` are those of all faces, one face after the other.
    """
    size = np.array([len(face) for face in statements.faces])
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
