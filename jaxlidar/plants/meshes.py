"""Triangle meshes of trees, and voxel maps of meshes.

To voxelise, every triangle is cut at the faces of the voxels, and its pieces are counted.

In a voxel of volume V with the one-sided leaf area L and the bark area B, the leaf area density is L/V and
the extinction coefficient of bark is B/(4 V) (Cauchy: a convex body's mean projected area is a quarter of its
surface).

L and B are exact to rounding, and their sums are the areas of the mesh. Along x, then y, then z, a triangle
that planes of the grid cross is cut at the middle one of these planes, and the pieces again, until each lies
between two neighbouring planes: the number of cuts in sequence grows with the logarithm of the number of
planes. A piece in the face between two voxels counts in the upper one; at the upper side of the grid, in the
last one.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Int

from jaxlidar._fields.checks import (
    check_integer,
    check_kind,
    check_number,
    check_range,
    check_seed,
    check_shape,
    warn_user,
)
from jaxlidar._text import percent
from jaxlidar.optics.leaf_angles import ANGLE_CELLS, LeafAngles
from jaxlidar.plants.grid import Grid, voxel_edges
from jaxlidar.plants.tree import Tree
from jaxlidar.scenes.mesh_surface import instance_numbers
from jaxlidar.scenes.voxels import VoxelMap

# Outlines of leaves: regular polygons, by the number of their corners and their width over their length.
LEAF_OUTLINES = {"rhombus": (4, 0.5), "ellipse": (8, 0.5), "needle": (3, 0.05)}
# Largest number of pieces in memory at a time, by an upper bound on their number.
_MAX_PIECES = 1_000_000
# Share of edges that two triangles have in common from which a surface counts as closed.
_CLOSED_SHARE = 0.95
# Irrational numbers, of which sums are the same for the same place alone.
_PLACE_NUMBERS = np.sqrt([2.0, 3.0, 5.0])
# A corner closer to a plane of the grid than this, in voxels, is moved into the plane.
_SNAP_DISTANCE = 1e-9


@final
@dataclass(frozen=True, eq=False, init=False)
class Mesh:
    """A mesh of n triangles over m vertices, each triangle of one of several materials.

    Coordinates are in metres, x east, y north, z up. Arrays are NumPy arrays. `jaxlidar.io.read_mesh` reads
    one from a file.

    **Arguments:**

    - `vertices`: (m, 3) positions, m.
    - `faces`: (n, 3) indices of the corners of each triangle, whole numbers from 0.
    - `material`: (n,) for each triangle the index of its material. Default None: the first.
    - `materials`: names of the materials, each its own. Default ("mesh",).
    - `instance`: (n,) for each triangle the number of the tree or object that it belongs to, an integer, 0 or
      more, by which `DiscreteReturns.labelled` labels what hits it. Default None: not stated.

    **Raises:** ValueError for arrays of other shapes, no triangle, positions that are not finite, indices of
    vertices and materials that do not exist, and a name that occurs twice; TypeError for indices that are no
    integers.

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
    instance: Int[np.ndarray, " n"] | None

    def __init__(
        self,
        vertices: ArrayLike | Sequence,
        faces: ArrayLike | Sequence,
        material: ArrayLike | Sequence | None = None,
        materials: Sequence[str] = ("mesh",),
        instance: ArrayLike | Sequence | None = None,
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
        fields = {"vertices": vertices, "faces": faces, "material": material, "materials": names}
        fields["instance"] = instance_numbers(instance, len(faces))
        for name, value in fields.items():
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
        """(n,) booleans, true for the triangles of the materials of these names.

        **Raises:** ValueError for a name that no material has.
        """
        names = (names,) if isinstance(names, str) else tuple(names)
        for name in names:
            if name not in self.materials:
                raise ValueError(
                    f"{name!r} is no material of the mesh; it has {', '.join(map(repr, self.materials))}"
                )
        return np.isin(self.material, [self.materials.index(name) for name in names])


class SolidMeshWarning(UserWarning):
    """Warning that a closed surface was voxelised, through which voxels let light pass.

    Voxels scatter light within a volume and cannot stop a beam. `Scene(meshes=)` traces triangles exactly.

    **Example:** a fifth of the light that falls on a box passes its voxels.

    >>> import warnings
    >>> import jaxlidar as jl
    >>> corners = [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    >>> quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    >>> faces = [[q[0], q[1 + k], q[2 + k]] for q in quads for k in (0, 1)]
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always")
    ...     voxels = jl.voxelise_mesh(jl.Mesh(corners, faces), 0.5, bark="mesh", leaf=())
    >>> print(caught[0].category.__name__)
    SolidMeshWarning
    """


def mesh_of(
    tree: Tree,
    *,
    sides: int = 8,
    leaves: int = 20,
    leaf_length: float = 0.1,
    seed: int | np.random.Generator = 0,
) -> Mesh:
    """Make the triangles of a tree: its branches as tapered tubes, and leaves within its leaf clumps.

    Segments are open prisms of cone frustums; the joints between them are not closed. A leaf is a rhombus of
    two triangles, half as wide as long, at a random place within its clump, of random orientation (a
    spherical leaf angle distribution).

    **Arguments:**

    - `tree`: a `Tree`, such as `grow`, `turtle` or `jaxlidar.io.read_qsm` give.
    - `sides`: sides of a branch, at least 3. Default 8. Its triangles have the cross-section of a circle of
      the branch's radius.
    - `leaves`: leaves of each clump, 0 or more. Default 20.
    - `leaf_length`: length of a leaf, m, positive. Default 0.1.
    - `seed`: a whole number, or a NumPy generator, for places and orientations of leaves. Default 0.

    **Returns:** a `Mesh` with the materials "wood" and "leaf", or the one of them that there is.

    **Raises:** TypeError for an object that is no `Tree`; ValueError for values outside the ranges above, and
    for a tree without segments or leaves.

    **Example:** a tree as triangles that stop light.

    >>> import jaxlidar as jl
    >>> mesh = jl.mesh_of(jl.grow(jl.shrub()), leaves=5)
    >>> surface = jl.MeshSurface(mesh, {"wood": 0.3, "leaf": 0.45}, {"leaf": 0.4})
    >>> print(mesh.materials, surface.n_triangles > 100)
    ('wood', 'leaf') True
    """
    check_kind("tree", tree, Tree, "a Tree, such as grow gives")
    sides, leaves = check_integer("sides", sides, 3), check_integer("leaves", leaves, 0)
    check_number("leaf_length", leaf_length, 0.0, low_open=True)
    check_seed(seed)
    corners = {"wood": _tubes(tree, sides), "leaf": _leaves(tree, leaves, leaf_length, seed)}
    corners = {name: triangles for name, triangles in corners.items() if len(triangles)}
    if not corners:
        raise ValueError("tree has no segments and no leaves: nothing has triangles")
    material = np.repeat(np.arange(len(corners)), [len(triangles) for triangles in corners.values()])
    triangles = np.concatenate(list(corners.values()))
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    return Mesh(triangles.reshape(-1, 3), faces, material, tuple(corners))


def _frames(axis: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors across each axis, a unit vector, and across each other."""
    reference = np.where(np.abs(axis[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(reference, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(axis, first)


def _tubes(tree: Tree, sides: int) -> Float[np.ndarray, "triangles 3 3"]:
    """Return the triangles of all segments that have a length, anticlockwise as seen from outside."""
    has_length = tree.length > 0
    start, end = tree.start[has_length], tree.end[has_length]
    if not len(start):
        return np.zeros((0, 3, 3))
    first, second = _frames((end - start) / tree.length[has_length][:, None])
    turns = 2.0 * np.pi * np.arange(sides) / sides
    circle = np.cos(turns)[:, None] * first[:, None] + np.sin(turns)[:, None] * second[:, None]
    # A polygon with the area of the circle: its corners lie outside.
    widening = np.sqrt(2.0 * np.pi / sides / np.sin(2.0 * np.pi / sides))
    radii = [widening * r[has_length][:, None, None] for r in (tree.radius_start, tree.radius_end)]
    lower, upper = (centre[:, None] + r * circle for centre, r in zip((start, end), radii))
    next_lower, next_upper = (np.roll(ring, -1, axis=1) for ring in (lower, upper))
    triangles = [(lower, next_lower, next_upper), (lower, next_upper, upper)]
    return np.concatenate([np.stack(t, axis=2).reshape(-1, 3, 3) for t in triangles])


def _leaves(
    tree: Tree, count: int, length: float, seed: int | np.random.Generator
) -> Float[np.ndarray, "triangles 3 3"]:
    """Return the triangles of `count` leaves in each clump."""
    random = np.random.default_rng(seed)
    centre = points_in_clumps(tree, np.full(len(tree.bud_radius), count), random)
    normals = random.normal(size=centre.shape)
    along, across = _frames(normals / np.linalg.norm(normals, axis=1, keepdims=True))
    corners = leaf_corners(centre, along, across, 0.25 * length**2, "rhombus")
    return corners[:, leaf_faces(4)].reshape(-1, 3, 3)


def points_in_clumps(
    tree: Tree, counts: Int[np.ndarray, " clumps"], random: np.random.Generator
) -> Float[np.ndarray, "points 3"]:
    """Draw points that are uniform within the leaf clumps of a tree: `counts` in each, clump by clump."""
    clump = np.repeat(np.arange(len(counts)), counts)
    # Directions from a normal distribution, radii as cube roots.
    direction = random.normal(size=(len(clump), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = np.cbrt(random.uniform(size=len(clump))) * tree.bud_radius[clump]
    return tree.bud_position[clump] + radius[:, None] * direction


def leaf_corners(
    centre: Float[np.ndarray, "n 3"],
    along: Float[np.ndarray, "n 3"],
    across: Float[np.ndarray, "n 3"],
    area: float,
    shape: str,
) -> Float[np.ndarray, "n corners 3"]:
    """Return the corners of leaves of a one-sided `area`, m2, and a shape of `LEAF_OUTLINES`.

    `along`, `across`: unit vectors of the axis and of the width.
    """
    n_corners, width = LEAF_OUTLINES[shape]
    turns = 2.0 * np.pi * np.arange(n_corners) / n_corners
    # The area of a regular polygon over its squared radius.
    radius = np.sqrt(area / (0.5 * n_corners * np.sin(turns[1]) * width))
    steps = radius * np.stack([np.cos(turns), width * np.sin(turns)])[:, None, :, None]
    return centre[:, None] + steps[0] * along[:, None] + steps[1] * across[:, None]


def leaf_faces(n_corners: int) -> Int[np.ndarray, "triangles 3"]:
    """Return the triangles of a convex polygon, as numbers of its corners."""
    return np.array([(0, k, k + 1) for k in range(1, n_corners - 1)])


def _closed_share(mesh: Mesh, selected: Bool[np.ndarray, " n"]) -> float:
    """Return the share of edges of the selected triangles that two of them have in common.

    Corners at the same place are the same: files often repeat the corners of every triangle.
    """
    # One number stands for the place of a corner: rows of three take far longer to sort.
    _, vertex = np.unique(mesh.vertices @ _PLACE_NUMBERS, return_inverse=True)
    faces = vertex[mesh.faces[selected]]
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    return float(np.mean(count == 2)) if len(count) else 0.0


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
    """Voxelise leaf and bark of a triangle mesh, with the mesh's own area in every voxel.

    Triangles of leaf are leaves without thickness: a triangle's two faces are the two sides of one leaf. The
    leaf area density is their area over the voxel's volume. Triangles of bark are the outer surfaces of
    solids; their extinction coefficient is a quarter of the area per volume (Cauchy), as for `voxelise` with
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
    for an object that is no `Mesh`.

    **Warns:** `SolidMeshWarning` where triangles of bark, or of one material that is all leaf, form closed
    surfaces, with the share of light that passes their voxels. `Scene(meshes=)` stops light.

    **Source:** Cauchy (1841).

    **Example:**

    >>> import jaxlidar as jl
    >>> slope = [[0, 0, 0], [2, 0, 2], [2, 1, 2], [0, 1, 0]]
    >>> mesh = jl.Mesh(slope, faces=[[0, 1, 2], [0, 2, 3]])
    >>> voxels = jl.voxelise_mesh(mesh, 1.0)
    >>> print(voxels.shape, f"{2 * voxels.leaf[0, 0, 0]:.3f} m2 per m3")
    (2, 1, 2) 1.414 m2 per m3
    """
    check_kind("mesh", mesh, Mesh, "a Mesh, such as jaxlidar.io.read_mesh gives")
    size = voxel_edges(voxel_size)
    is_bark = mesh.of(bark)
    is_leaf = ~is_bark if leaf is None else mesh.of(leaf)
    if np.any(is_ambiguous := is_leaf & is_bark):
        name = mesh.materials[mesh.material[np.argmax(is_ambiguous)]]
        raise ValueError(f"{name!r} is among the materials of leaf and of bark; admissible is one of them")
    area, is_used = mesh.area, is_leaf | is_bark
    if not np.any(area[is_used] > 0):
        raise ValueError(
            f"{is_used.sum()} triangles are leaf or bark, none with an area: nothing to voxelise"
        )
    corners = mesh.corners[is_used].reshape(-1, 3)
    grid = Grid.enclosing(corners.min(axis=0), corners.max(axis=0), size, origin, shape)
    leaf_density, bark_density = (
        _area_in_voxels(mesh, selected, area, grid) / size.prod() for selected in (is_leaf, is_bark)
    )
    wood = 0.25 * bark_density if np.any(is_bark) else None
    if np.any(is_leaf):
        angles = _inclinations(mesh.corners[is_leaf]) if leaf_angles is None else leaf_angles
        voxels = VoxelMap.from_lad(
            leaf_density, bark=wood, voxel_size=size, origin=grid.low, leaf_angles=angles
        )
    else:
        voxels = VoxelMap.from_extinction(bark=wood, voxel_size=size, origin=grid.low)
    # G of the leaves straight down, which is 1/2 where they are spherical.
    projection = 0.5 if voxels.leaf_angles is None else float(voxels.leaf_angles.tables()[0][-1])
    for selected, extinction in ((is_bark, 0.25 * bark_density), (is_leaf, projection * leaf_density)):
        _warn_of_closed_surfaces(mesh, selected, extinction, size)
    return voxels


def _warn_of_closed_surfaces(
    mesh: Mesh,
    selected: Bool[np.ndarray, " n"],
    extinction: Float[np.ndarray, "nx ny nz"],
    size: Float[np.ndarray, "3"],
) -> None:
    """Warn where triangles are closed surfaces, with the share of vertical light that passes their voxels.

    The share is the mean of exp(-tau) over the columns of voxels that the surfaces touch.
    """
    if not np.any(selected) or _closed_share(mesh, selected) < _CLOSED_SHARE:
        return
    depth = extinction.sum(axis=2) * size[2]
    passes = float(np.exp(-depth[depth > 0]).mean())
    warn_user(
        f"the mesh is closed, and stops light; its voxels let {percent(passes)} of it pass, straight down. "
        "Scene(meshes=(MeshSurface(mesh),)) traces its triangles",
        SolidMeshWarning,
    )


def _areas(corners: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    x, y, z = _normals(corners)
    return 0.5 * np.sqrt(x * x + y * y + z * z)


def _normals(corners: Float[np.ndarray, "n 3 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cross products of two sides: normals whose length is twice the area.

    Written out by components: `numpy.cross` takes several times as long on rows of three.
    """
    (ax, ay, az), (bx, by, bz) = (np.moveaxis(corners[:, k] - corners[:, 0], -1, 0) for k in (1, 2))
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def _inclinations(corners: Float[np.ndarray, "n 3 3"]) -> LeafAngles | str:
    """The distribution of the triangles' inclination by area; spherical where they have none."""
    x, y, z = _normals(corners)
    angle = np.rad2deg(np.arctan2(np.hypot(x, y), np.abs(z)))
    cells = np.minimum(angle * (ANGLE_CELLS / 90.0), ANGLE_CELLS - 1).astype(int)
    area_of_cell = np.bincount(cells, _areas(corners), ANGLE_CELLS)
    return LeafAngles(area_of_cell / area_of_cell.sum()) if area_of_cell.sum() > 0 else "spherical"


def _area_in_voxels(
    mesh: Mesh, selected: Bool[np.ndarray, " n"], area: Float[np.ndarray, " n"], grid: Grid
) -> Float[np.ndarray, "nx ny nz"]:
    """The area of the selected triangles in every voxel, m2."""
    total = grid.zeros()
    triangles = np.flatnonzero(selected & (area > 0))
    # In voxels from the grid's corner: a plane of the grid is at a whole number.
    corners = (mesh.corners[triangles] - grid.low) / grid.size
    nearest_plane = np.round(corners)
    corners = np.where(np.abs(corners - nearest_plane) < _SNAP_DISTANCE, nearest_plane, corners)
    for chunk in _chunks(corners):
        pieces, triangle = _pieces(corners[chunk])
        piece_area = _areas(pieces * grid.size)
        sums = np.bincount(triangle, piece_area, len(triangles[chunk]))
        # The areas of the pieces serve to divide the triangle's own. A triangle may be so small that its
        # corners coincide when they are moved to a plane: its one piece gets all of its area.
        fraction = np.where(sums[triangle] > 0, piece_area / np.where(sums > 0, sums, 1.0)[triangle], 1.0)
        centroid = (pieces[:, 0] + pieces[:, 1] + pieces[:, 2]) / 3
        grid.accumulate(grid.low + grid.size * centroid, fraction * area[triangles[chunk]][triangle], total)
    return total


def _chunks(corners: Float[np.ndarray, "n 3 3"]) -> Iterator[slice]:
    """Ranges of triangles that are cut together: of at most _MAX_PIECES pieces, or one triangle alone."""
    low, high = _extremes(corners)
    # A triangle that spans x by y by z voxels is plane: it meets at most about x y + y z + z x of them.
    x, y, z = (np.floor(high) - np.floor(low) + 1).T
    cumulative = np.cumsum(x * y + y * z + z * x)
    start = 0
    while start < len(corners):
        before_start = cumulative[start - 1] if start else 0.0
        end = max(int(np.searchsorted(cumulative, before_start + _MAX_PIECES)), start + 1)
        yield slice(start, end)
        start = end


def _extremes(corners: Float[np.ndarray, "n 3 *axes"]) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest of the three corners. (`min(axis=1)` over so few is slow.)"""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def _pieces(
    corners: Float[np.ndarray, "n 3 3"],
) -> tuple[Float[np.ndarray, "pieces 3 3"], Int[np.ndarray, " pieces"]]:
    """Cut triangles into pieces that lie within voxels of edge 1 each; and the triangle of each piece."""
    triangle = np.arange(len(corners))
    for axis in range(3):
        finished: list[tuple[np.ndarray, np.ndarray]] = []
        while len(corners):
            low, high = _extremes(corners[:, :, axis])
            # Planes strictly between the lowest and the highest corner.
            first, last = np.floor(low) + 1, np.ceil(high) - 1
            is_crossed = first <= last
            finished.append((corners[~is_crossed], triangle[~is_crossed]))
            plane = np.floor(0.5 * (first + last))[is_crossed]
            corners = _cut(corners[is_crossed], axis, plane)
            triangle = np.tile(triangle[is_crossed], 3)
        corners, triangle = (np.concatenate(columns) for columns in zip(*finished))
    return corners, triangle


def _cut(corners: Float[np.ndarray, "n 3 3"], axis: int, plane: Float[np.ndarray, " n"]) -> np.ndarray:
    """Cut each triangle by a plane across an axis into three; one is empty where the plane meets a corner.

    With a the corner that is alone on its side of the plane, and p and q the points where the plane meets the
    sides a b and a c, they are a p q, p b c and p c q.
    """
    row, is_below = np.arange(len(corners)), corners[:, :, axis] < plane[:, None]
    first, second, third = is_below.T
    lone = np.where(second == third, 0, np.where(first == third, 1, 2))
    a, b, c = (corners[row, (lone + k) % 3] for k in range(3))

    def intersection(end: np.ndarray) -> np.ndarray:
        """The point at which the side from the lone corner to `end` meets the plane."""
        fraction = (plane - a[:, axis]) / (end[:, axis] - a[:, axis])
        point = a + fraction[:, None] * (end - a)
        # Exactly, lest rounding leaves a sliver beyond the plane that would be cut again.
        point[:, axis] = plane
        return point

    p, q = intersection(b), intersection(c)
    return np.concatenate([np.stack(t, axis=1) for t in ((a, p, q), (p, b, c), (p, c, q))])
