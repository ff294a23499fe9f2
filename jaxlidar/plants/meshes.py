"""Voxel maps of triangle meshes: every triangle is cut at the faces of the voxels, and its pieces counted.

A triangle that planes of the grid cross is cut in two parts at the middle one of these planes, the parts
again, until each piece lies within one voxel. So areas of voxels are exact to rounding, and their sum is that
of the mesh. A piece in the face between two voxels counts in the upper one; at the upper side of the grid, in
the last one.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Int

from jaxlidar._checks import check_kind, check_range, check_shape
from jaxlidar.optics.leaf_angles import ANGLE_CELLS, LeafAngles
from jaxlidar.plants.grid import Grid, edges
from jaxlidar.scenes.voxels import VoxelMap

# Pieces that are made at a time, by a bound on their number.
_CHUNK = 1_000_000
# A corner so close to a plane of the grid, in voxels, lies in it.
_NEAR = 1e-9


@final
@dataclass(frozen=True, eq=False, init=False)
class Mesh:
    """A mesh of n triangles over m vertices, each triangle of one of several materials.

    Coordinates are in metres, x east, y north, z up. Arrays are NumPy arrays. `jaxlidar.io.read_obj` reads
    one; one of the package trimesh, which reads many formats, is `Mesh(other.vertices, other.faces)`.

    **Arguments:**

    - `vertices`: (m, 3) places, m.
    - `faces`: (n, 3) indices of the corners of each triangle, whole numbers from 0.
    - `material`: (n,) for each triangle the index of its material. Default None: the first.
    - `materials`: names of the materials, each its own. Default ("mesh",).

    **Raises:** ValueError for arrays of other shapes, no triangle, places that are not finite, indices of
    vertices and materials that are not there, and a name that is given twice; TypeError for indices that are
    no integers.

    **Example:**

    >>> import jaxlidar as jl
    >>> leaf = jl.Mesh(vertices=[[0, 0, 1], [0.1, 0, 1], [0, 0.1, 1]], faces=[[0, 1, 2]])
    >>> print(leaf.area)
    [0.005]
    """

    vertices: Float[np.ndarray, "m 3"]
    faces: Int[np.ndarray, "n 3"]
    material: Int[np.ndarray, " n"]
    materials: tuple[str, ...]

    def __init__(
        self,
        vertices: ArrayLike | Sequence,
        faces: ArrayLike | Sequence,
        material: ArrayLike | Sequence | None = None,
        materials: Sequence[str] = ("mesh",),
    ):
        check_range("vertices", vertices)
        vertices, faces = np.asarray(vertices, float), np.asarray(faces)
        material = np.zeros(len(faces), int) if material is None else np.asarray(material)
        for name, indices in (("faces", faces), ("material", material)):
            if indices.dtype.kind not in "iu":
                raise TypeError(f"{name} is an array of {indices.dtype}; admissible are integers")
        check_shape("vertices", vertices, (len(vertices), 3))
        check_shape("faces", faces, (len(faces), 3))
        check_shape("material", material, (len(faces),))
        if not len(faces):
            raise ValueError("faces is empty; admissible is one triangle or more")
        check_range("faces", faces, 0, len(vertices) - 1)
        names = tuple(materials)
        for name in names:
            check_kind("one of materials", name, str, "a name")
        if len(set(names)) < len(names):
            raise ValueError(f"materials = {names} has a name twice")
        check_range("material", material, 0, len(names) - 1)
        made = {"vertices": vertices, "faces": faces, "material": material, "materials": names}
        for name, value in made.items():
            object.__setattr__(self, name, value)

    @property
    def corners(self) -> Float[np.ndarray, "n 3 3"]:
        """The three corners of every triangle in m."""
        return self.vertices[self.faces]

    @property
    def area(self) -> Float[np.ndarray, " n"]:
        """One-sided area of every triangle in m2."""
        return _areas(self.corners)

    def of(self, names: Sequence[str]) -> Bool[np.ndarray, " n"]:
        """Which triangles are of the materials of these names.

        **Raises:** ValueError for a name that no material has.
        """
        names = (names,) if isinstance(names, str) else tuple(names)
        for name in names:
            if name not in self.materials:
                raise ValueError(
                    f"{name!r} is no material of the mesh; it has {', '.join(map(repr, self.materials))}"
                )
        return np.isin(self.material, [self.materials.index(name) for name in names])


def voxelise_mesh(
    mesh: Mesh,
    voxel_size: float | tuple[float, float, float],
    *,
    leaf: str | Sequence[str] | None = None,
    bark: str | Sequence[str] = (),
    leaf_angles: str | LeafAngles | None = None,
    origin: tuple[float, float, float] | None = None,
    shape: tuple[int, int, int] | None = None,
) -> VoxelMap:
    """The voxel map of leaf and bark of a triangle mesh, with the mesh's own area in every voxel.

    Triangles of leaf are leaves without thickness: both sides of a triangle together are one leaf's. The leaf
    area density is their area over the voxel's volume. Triangles of bark are the outer surfaces of solids;
    their extinction coefficient is a quarter of the area per volume (Cauchy), as for `voxelise` with
    `wood="surface"`.

    **Arguments:**

    - `mesh`: a `Mesh`.
    - `voxel_size`: voxel edges in m, positive: one number for cubes, or three.
    - `leaf`: names of the materials that are leaf. Default None: all that are not bark. Materials that are
      neither are left out.
    - `bark`: names of the materials that are bark. Default (): none.
    - `leaf_angles`: distribution of leaf inclination, a name or a `LeafAngles`, as for `VoxelMap.from_lad`.
      Default None: that of the triangles' normals, by their area, all voxels together.
    - `origin`, `shape`: lower corner (x, y, z) in m and numbers of voxels (nx, ny, nz) of the grid; give both
      or neither. Default None: as for `voxelise`.

    **Returns:** a `VoxelMap`.

    **Raises:** ValueError for inadmissible arguments, a material that the mesh does not have or that is both
    leaf and bark, triangles that have no area in all, and a mesh that reaches out of a given grid; TypeError
    for what is no `Mesh`.

    **Source:** Cauchy (1841).

    **Example:**

    >>> import jaxlidar as jl
    >>> slope = [[0, 0, 0], [2, 0, 2], [2, 1, 2], [0, 1, 0]]
    >>> mesh = jl.Mesh(slope, faces=[[0, 1, 2], [0, 2, 3]])
    >>> voxels = jl.voxelise_mesh(mesh, 1.0)
    >>> print(voxels.shape, f"{2 * voxels.leaf[0, 0, 0]:.3f} m2 per m3")
    (2, 1, 2) 1.414 m2 per m3
    """
    check_kind("mesh", mesh, Mesh, "a Mesh, such as jaxlidar.io.read_obj gives")
    size = edges(voxel_size)
    is_bark = mesh.of(bark)
    is_leaf = ~is_bark if leaf is None else mesh.of(leaf)
    if np.any(both := is_leaf & is_bark):
        name = mesh.materials[mesh.material[np.argmax(both)]]
        raise ValueError(f"{name!r} is among the materials of leaf and of bark; admissible is one of them")
    area, used = mesh.area, is_leaf | is_bark
    if not np.any(area[used] > 0):
        raise ValueError(f"{used.sum()} triangles are leaf or bark, none with an area: nothing to voxelise")
    reach = mesh.corners[used].reshape(-1, 3)
    grid = Grid.of(reach.min(axis=0), reach.max(axis=0), size, origin, shape)
    cell = size.prod()
    density = [_shared_out(mesh, chosen, area, grid) / cell for chosen in (is_leaf, is_bark)]
    wood = 0.25 * density[1] if np.any(is_bark) else None
    if not np.any(is_leaf):
        return VoxelMap.from_extinction(bark=wood, voxel_size=size, origin=grid.low)
    angles = _inclinations(mesh.corners[is_leaf]) if leaf_angles is None else leaf_angles
    return VoxelMap.from_lad(density[0], bark=wood, voxel_size=size, origin=grid.low, leaf_angles=angles)


def _areas(corners: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    x, y, z = _normals(corners)
    return 0.5 * np.sqrt(x * x + y * y + z * z)


def _normals(corners: Float[np.ndarray, "n 3 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals of twice the length of the areas."""
    (ax, ay, az), (bx, by, bz) = (np.moveaxis(corners[:, k] - corners[:, 0], -1, 0) for k in (1, 2))
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def _inclinations(corners: Float[np.ndarray, "n 3 3"]) -> LeafAngles | str:
    """The distribution of the triangles' inclination by area; spherical where they have none."""
    x, y, z = _normals(corners)
    angle = np.rad2deg(np.arctan2(np.hypot(x, y), np.abs(z)))
    cells = np.minimum(angle * (ANGLE_CELLS / 90.0), ANGLE_CELLS - 1).astype(int)
    share = np.bincount(cells, _areas(corners), ANGLE_CELLS)
    return LeafAngles(share / share.sum()) if share.sum() > 0 else "spherical"


def _shared_out(
    mesh: Mesh, chosen: Bool[np.ndarray, " n"], area: Float[np.ndarray, " n"], grid: Grid
) -> Float[np.ndarray, "nx ny nz"]:
    """The area of some triangles in every voxel."""
    total = grid.empty()
    number = np.flatnonzero(chosen & (area > 0))
    # In voxels from the grid's corner: a plane of the grid is a whole number.
    corners = (mesh.corners[number] - grid.low) / grid.size
    whole = np.round(corners)
    corners = np.where(np.abs(corners - whole) < _NEAR, whole, corners)
    for some in _chunks(corners):
        pieces, owner = _pieces(corners[some])
        part = _areas(pieces * grid.size)
        sums = np.bincount(owner, part, len(number[some]))
        # A triangle may be so small that its corners fall together when they are moved to a plane.
        share = np.where(sums[owner] > 0, part / np.where(sums > 0, sums, 1.0)[owner], 1.0)
        middle = (pieces[:, 0] + pieces[:, 1] + pieces[:, 2]) / 3
        grid.count(grid.low + grid.size * middle, share * area[number[some]][owner], total)
    return total


def _chunks(corners: Float[np.ndarray, "n 3 3"]) -> Iterator[slice]:
    """Ranges of triangles that are cut together: of few pieces, or one triangle alone."""
    low, high = _ends(corners)
    x, y, z = (np.floor(high) - np.floor(low) + 1).T
    before = np.cumsum(x * y + y * z + z * x)
    start = 0
    while start < len(corners):
        done = before[start - 1] if start else 0.0
        end = max(int(np.searchsorted(before, done + _CHUNK)), start + 1)
        yield slice(start, end)
        start = end


def _ends(corners: Float[np.ndarray, "n 3 *axes"]) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest of the three corners; reductions over so few are slow."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def _pieces(
    corners: Float[np.ndarray, "n 3 3"],
) -> tuple[Float[np.ndarray, "pieces 3 3"], Int[np.ndarray, " pieces"]]:
    """Pieces that lie within voxels of edge 1 each, and the triangle that each is of."""
    owner = np.arange(len(corners))
    for axis in range(3):
        within: list[tuple[np.ndarray, np.ndarray]] = []
        while len(corners):
            low, high = _ends(corners[:, :, axis])
            first, last = np.floor(low) + 1, np.ceil(high) - 1
            crossed = first <= last
            within.append((corners[~crossed], owner[~crossed]))
            plane = np.floor(0.5 * (first + last))[crossed]
            corners = _cut(corners[crossed], axis, plane)
            owner = np.tile(owner[crossed], 3)
        corners, owner = (np.concatenate(parts) for parts in zip(*within))
    return corners, owner


def _cut(corners: Float[np.ndarray, "n 3 3"], axis: int, plane: Float[np.ndarray, " n"]) -> np.ndarray:
    """The three triangles that a plane across an axis makes of each; one is empty where it meets a corner."""
    row, below = np.arange(len(corners)), corners[:, :, axis] < plane[:, None]
    # The corner that is alone on its side of the plane, and the two others.
    first, second, third = below.T
    lone = np.where(second == third, 0, np.where(first == third, 1, 2))
    a, b, c = (corners[row, (lone + k) % 3] for k in range(3))

    def met(end: np.ndarray) -> np.ndarray:
        """Where the side from the lone corner to an end meets the plane."""
        share = (plane - a[:, axis]) / (end[:, axis] - a[:, axis])
        point = a + share[:, None] * (end - a)
        point[:, axis] = plane
        return point

    p, q = met(b), met(c)
    return np.concatenate([np.stack(t, axis=1) for t in ((a, p, q), (p, b, c), (p, c, q))])
