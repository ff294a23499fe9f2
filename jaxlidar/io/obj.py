"""Reader of triangle meshes in Wavefront's OBJ format."""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxlidar._checks import check_choice, check_number
from jaxlidar.io.checks import FARTHEST
from jaxlidar.io.text import lines_of, number_in, whole_in
from jaxlidar.plants.meshes import Mesh

# What names the triangles that follow.
_PARTS = {"material": "usemtl", "group": "g", "object": "o"}
# Statements that say nothing of surfaces: textures, normals, shading, points and lines.
_OTHER = frozenset({"vt", "vn", "vp", "s", "mtllib", "p", "l", "mg", "lod", "bevel", "c_interp", "d_interp"})
_UNNAMED = "unnamed"
_NO_AREA = "without an area"


class MeshRead(NamedTuple):
    """What `read_obj` returns: a mesh and what was left out of it.

    - `mesh`: a `Mesh`.
    - `dropped`: how many triangles of the file are not in the mesh, by reason.

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
    path: str | os.PathLike[str], *, part: str = "material", scale: float = 1.0, up: str = "z"
) -> MeshRead:
    r"""The triangle mesh of a Wavefront OBJ file, with the names of its materials, groups or objects.

    Faces of more than three corners are taken to be flat and convex, and cut into triangles. Other formats
    are read by the package trimesh: `Mesh(other.vertices, other.faces)`.

    **Arguments:**

    - `path`: an OBJ file; its .mtl file is not needed.
    - `part`: whose names become `Mesh.materials`: "material" (`usemtl`), "group" (`g`) or "object" (`o`).
      Faces before the first of these are "unnamed". Default "material".
    - `scale`: metres per unit of length in the file, positive. Default 1.
    - `up`: the file's vertical axis, "z" or "y"; of y, x stays and y becomes z. Default "z".

    **Returns:** a `MeshRead`: the `Mesh`, and how many triangles were left out, by reason: those "without an
    area".

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the line, for
    coordinates that are not numbers or not on Earth, indices of vertices that are not there, faces of fewer
    than three corners or that are not convex, and statements that are not known. ValueError for other
    inadmissible arguments, and for a file without a triangle that has an area.

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
    check_choice("part", part, tuple(_PARTS))
    check_number("scale", scale, 0.0, low_open=True)
    check_choice("up", up, ("z", "y"))
    path, lines = lines_of(path)
    read = _Statements(path, _PARTS[part])
    for number, line in enumerate(lines, 1):
        read.take(number, line)
    if not read.faces:
        raise ValueError(f"{path}: line {len(lines)}: there is no face in the file")
    vertices = _places(path, read) * scale
    if up == "y":
        x, y, z = vertices.T
        vertices = np.stack([x, -z, y], axis=1)
    faces, face = _triangles(path, read, vertices)
    # Names of which no triangle has an area are kept: they are in the file.
    mesh = Mesh(vertices, faces, np.array(read.material)[face], tuple(read.names))
    full = mesh.area > 0
    if not full.any():
        raise ValueError(f"{path}: line {len(lines)}: {len(full)} triangles, none with an area")
    mesh = Mesh(vertices, faces[full], mesh.material[full], mesh.materials)
    return MeshRead(mesh, {_NO_AREA: int(np.sum(~full))})


class _Statements:
    """The vertices and faces of a file, with the line of each, and the part that each face is of."""

    def __init__(self, path: Path, naming: str):
        self.path, self.naming = path, naming
        self.vertices: list[list[float]] = []
        self.vertex_lines: list[int] = []
        self.faces: list[list[int]] = []
        self.face_lines: list[int] = []
        self.material: list[int] = []
        self.names: dict[str, int] = {}
        self.name = _UNNAMED

    def take(self, number: int, line: str) -> None:
        """Take one line."""
        words = line.split()
        if not words or words[0].startswith("#"):
            return
        kind, *words = words
        if kind == "v":
            self._vertex(number, words)
        elif kind == "f":
            self._face(number, words)
        elif kind == self.naming:
            self.name = " ".join(words) or _UNNAMED
        elif kind not in _OTHER and kind not in _PARTS.values():
            raise ValueError(
                f"{self.path}: line {number}: {kind[:40]!r} is no statement of a mesh of polygons"
            )

    def _vertex(self, number: int, words: list[str]) -> None:
        # A weight or a colour may follow.
        if len(words) not in (3, 4, 6, 7):
            raise ValueError(f"{self.path}: line {number}: {len(words)} numbers of a vertex; 3 belong here")
        try:
            place = [float(word) for word in words[:3]]
        except ValueError:
            place = [number_in(self.path, number, axis, word) for axis, word in zip("xyz", words)]
        self.vertices.append(place)
        self.vertex_lines.append(number)

    def _face(self, number: int, words: list[str]) -> None:
        if len(words) < 3:
            raise ValueError(
                f"{self.path}: line {number}: a face of {len(words)} corners; admissible are 3 or more"
            )
        try:
            corners = [int(word.partition("/")[0]) for word in words]
        except ValueError:
            corners = [whole_in(self.path, number, "f", word.partition("/")[0]) for word in words]
        there = len(self.vertices)
        for i, corner in enumerate(corners):
            if not (1 <= corner <= there or -there <= corner <= -1):
                raise ValueError(
                    f"{self.path}: line {number}: vertex {corner}; those before are 1 to {there}, or -1 to "
                    f"-{there} from the last"
                )
            corners[i] = corner - 1 if corner > 0 else there + corner
        self.faces.append(corners)
        self.face_lines.append(number)
        self.material.append(self.names.setdefault(self.name, len(self.names)))


def _places(path: Path, read: _Statements) -> Float[np.ndarray, "m 3"]:
    """The vertices, all of which are numbers and on Earth."""
    vertices = np.array(read.vertices)
    wrong = ~np.all(np.abs(vertices) <= FARTHEST, axis=1)
    if wrong.any():
        bad = int(np.argmax(wrong))
        raise ValueError(
            f"{path}: line {read.vertex_lines[bad]}: vertex at {tuple(read.vertices[bad])}; admissible are "
            f"numbers in [-{FARTHEST:g}, {FARTHEST:g}]"
        )
    return vertices


def _triangles(
    path: Path, read: _Statements, vertices: Float[np.ndarray, "m 3"]
) -> tuple[Int[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Triangles that share the first corner of their face, and the face of each."""
    size = np.array([len(face) for face in read.faces])
    flat = np.array([corner for face in read.faces for corner in face])
    face = np.repeat(np.arange(size.size), size - 2)
    first = np.cumsum(size) - size
    # The triangle's number within its face, from 1.
    within = np.arange(face.size) - np.repeat(np.cumsum(size - 2) - (size - 2), size - 2) + 1
    faces = np.stack([flat[first[face]], flat[first[face] + within], flat[first[face] + within + 1]], axis=1)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    whole = np.stack([np.bincount(face, part, size.size) for part in normal.T], axis=1)
    # Triangles of a convex face turn the same way. Rounding may turn one that is nearly a line.
    turned = np.sum(normal * whole[face], axis=1) < -1e-6 * np.sum(whole**2, axis=1)[face]
    if turned.any():
        bad = read.face_lines[int(face[np.argmax(turned)])]
        raise ValueError(f"{path}: line {bad}: a face that is not convex; cut it into triangles")
    return faces, face
