"""Voxel maps of trees and point clouds: branches, leaf clumps and points are shared out on a regular grid.

Thin branch segments and leaf clumps are filled with points of known volume, `voxel_size / samples` apart. A
frustum is cut into slabs, and each slab's exact volume is shared among the points of a disc. Segments with a
radius of four such distances or more use the centres of the subvoxels that lie within them, so that a voxel
inside is full. Every point counts in the voxel in which it lies, and a clump within one voxel counts there as
a whole. The sum over voxels is the volume of the solids, whatever the voxel size. Only the division between
neighbouring voxels is uncertain: a voxel that the side of a trunk cuts through is off by about 1 % of its
volume with 8 samples (root mean square, measured).
"""

from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import Bool, Float

from jaxlidar._checks import (
    check_choice,
    check_integer,
    check_kind,
    check_number,
    check_range,
    check_shape,
    kind_of,
)
from jaxlidar.plants.grid import Grid, edges
from jaxlidar.plants.tree import Tree
from jaxlidar.scenes.voxels import VoxelMap

_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
# Points are made and counted for this many segments or clumps at a time, and clumps as wholes for so many.
_CHUNK, _WHOLE = 2000, 500_000
# More points for one solid would not change a voxel by 0.1 %.
_MOST = 200_000


def voxelise(
    trees: Tree | Iterable[Tree],
    voxel_size: float | tuple[float, float, float],
    *,
    leaf_area: float | None = None,
    wood: str = "volume",
    samples: int = 8,
    origin: tuple[float, float, float] | None = None,
    shape: tuple[int, int, int] | None = None,
) -> VoxelMap:
    """The voxel map of leaf and bark of one tree, or of several trees together.

    Where solids overlap, as branches do at joints, a voxel is at most full. The excess volume goes to the
    voxels around it, so that volumes are conserved.

    **Arguments:**

    - `trees`: a `Tree`, or several, for instance a `forest`.
    - `voxel_size`: voxel edges in m, positive: one number for cubes, or three.
    - `leaf_area`: one-sided leaf area of every clump in m2, 0 or more, spread evenly through its sphere. The
      extinction coefficient of leaf is then area / (2 volume). None: a clump fills its sphere, and the
      probability of leaf is the share of the voxel that clumps occupy. The clump radius is that of the tree;
      see `Tree.with_bud_radius`. Default None.
    - `wood`: "volume": the probability of bark is the share of the voxel that wood occupies. Twigs much
      thinner than a voxel then intercept less light than their width would. "surface": the extinction
      coefficient is a quarter of the wood surface per volume, as for thin convex bodies of random orientation
      (Cauchy), or that of "volume" where it is larger. Default "volume".
    - `samples`: points per voxel edge, an integer of at least 1. Default 8.
    - `origin`, `shape`: lower corner (x, y, z) in m and numbers of voxels (nx, ny, nz) of the grid; give both
      or neither. Default None: the smallest grid that holds everything, with faces at multiples of the edge,
      so that the maps of neighbouring trees fit together.

    **Returns:** a `VoxelMap`.

    **Raises:** ValueError for inadmissible arguments, for trees with neither wood nor clumps, for trees that
    reach out of a given grid, and for more material than the grid can hold; TypeError for what is no `Tree`.

    **Source:** Cauchy (1841); for the meaning of a voxel's probabilities, `VoxelMap.from_probability`.

    **Example:**

    >>> import jaxlidar as jl
    >>> tree = jl.grow(jl.shrub(height=1.0, stems=1))
    >>> voxels = jl.voxelise(tree, 0.2, leaf_area=0.001)
    >>> leaf_area = float(2 * voxels.leaf.sum()) * 0.2**3
    >>> print(f"{leaf_area / len(tree.bud_position):.4f} m2 per clump")
    0.0010 m2 per clump
    """
    check_kind("trees", trees, Tree | Iterable, "a Tree or several")
    trees = [trees] if isinstance(trees, Tree) else list(trees)
    size = edges(voxel_size)
    check_choice("wood", wood, ("volume", "surface"))
    if leaf_area is not None:
        check_number("leaf_area", leaf_area, 0.0)
    samples = check_integer("samples", samples)
    tree = Tree.joined(trees)
    if not len(tree.start) and not len(tree.bud_position):
        raise ValueError("trees have neither wood nor clumps; there is nothing to voxelise")
    grid = Grid.of(*_reach(tree), size, origin, shape)
    apart = float(size.min()) / samples
    volume, surface, leaf = grid.empty(), grid.empty(), grid.empty()
    thick = np.minimum(tree.radius_start, tree.radius_end) >= 4 * apart
    for i in np.flatnonzero(thick).tolist():
        grid.count(*_subvoxels_in(tree, i, size / samples), volume)
    thin = np.flatnonzero(~thick)
    for part in np.split(thin, range(_CHUNK, len(thin), _CHUNK)):
        grid.count(*_in_frustums(tree, part, apart), volume)
    if wood == "surface":
        for part in np.split(np.arange(len(thick)), range(_CHUNK, len(thick), _CHUNK)):
            grid.count(*_in_frustums(tree, part, apart, on_surface=True), surface)
    for part in _parts(len(tree.bud_position), _WHOLE):
        within = grid.within_a_voxel(tree.bud_position[part], tree.bud_radius[part])
        grid.count(*_at_centres(tree, part[within], leaf_area), leaf)
        for some in _parts(int(np.sum(~within)), _CHUNK):
            grid.count(*_in_spheres(tree, part[~within][some], apart, leaf_area), leaf)
    return _map(grid, leaf, volume, surface, tree, leaf_area, wood)


def voxelise_points(
    points: Float[np.ndarray, "n 3"],
    voxel_size: float | tuple[float, float, float],
    *,
    leaf_area: float,
    is_wood: Bool[np.ndarray, " n"] | None = None,
    wood_probability: float = 1.0,
    min_points: int = 1,
    origin: tuple[float, float, float] | None = None,
    shape: tuple[int, int, int] | None = None,
) -> VoxelMap:
    """The voxel map of a point cloud, such as a terrestrial laser scan.

    Points alone do not tell the leaf area. The total leaf area is therefore given, and shared out among the
    voxels in proportion to their numbers of points. A scan has fewer points on what is occluded. Maps that
    account for the paths of the beams, such as those of AMAPVox, are better: `jaxlidar.io.read_vox`.

    **Arguments:**

    - `points`: (n, 3) positions in m.
    - `voxel_size`: voxel edges in m, positive: one number for cubes, or three.
    - `leaf_area`: one-sided area of all leaves together, m2, 0 or more.
    - `is_wood`: (n,) booleans: which points lie on wood. Default None: no point.
    - `wood_probability`: probability of bark in a voxel with points on wood, in [0, 1]. Default 1.
    - `min_points`: a voxel with fewer leaf points than this has no leaf, and one with fewer wood points has
      no wood; 1 or more. Default 1.
    - `origin`, `shape`: lower corner (x, y, z) in m and numbers of voxels (nx, ny, nz) of the grid; give both
      or neither. Default None: as for `voxelise`.

    **Returns:** a `VoxelMap` with spherical leaf angles.

    **Raises:** ValueError for inadmissible arguments, for points outside a given grid, and for a positive
    leaf area where no voxel has enough leaf points; TypeError where `is_wood` is no array of booleans.

    **Example:**

    >>> import numpy as np, jaxlidar as jl
    >>> points = np.random.default_rng(0).uniform(0.0, 2.0, (1000, 3))
    >>> voxels = jl.voxelise_points(points, 0.5, leaf_area=6.0)
    >>> print(voxels.shape, f"{float(2 * voxels.leaf.sum()) * 0.5**3:.2f} m2")
    (4, 4, 4) 6.00 m2
    """
    check_range("points", points)
    points = np.asarray(points, float)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(f"points has shape {points.shape}; admissible is (n, 3), with one point or more")
    check_number("leaf_area", leaf_area, 0.0)
    check_number("wood_probability", wood_probability, 0.0, 1.0)
    min_points = check_integer("min_points", min_points)
    on_wood = np.zeros(len(points), bool) if is_wood is None else np.asarray(is_wood)
    if on_wood.dtype != bool:
        raise TypeError(f"is_wood is {kind_of(is_wood)}; admissible is an array of booleans, one a point")
    check_shape("is_wood", on_wood, (len(points),))
    size = edges(voxel_size)
    # A point on the upper face still counts in the voxel below it.
    grid = Grid.of(points.min(axis=0), np.nextafter(points.max(axis=0), np.inf), size, origin, shape)
    leaf, wood = grid.empty(), grid.empty()
    for chosen, into in ((~on_wood, leaf), (on_wood, wood)):
        grid.count(points[chosen], np.ones(int(chosen.sum())), into)
        into[into < min_points] = 0.0
    total = leaf.sum()
    if total == 0 and leaf_area > 0:
        raise ValueError(f"leaf_area = {leaf_area:g} m2, but no voxel holds {min_points} or more leaf points")
    density = leaf * (leaf_area / max(total, 1.0) / size.prod())
    bark = None
    if on_wood.any():
        share = np.where(wood > 0, wood_probability, 0.0)
        bark = VoxelMap.from_probability(bark=share, voxel_size=size).bark
    return VoxelMap.from_lad(density, bark=bark, voxel_size=size, origin=grid.low)


def trim_empty_layers(voxels: VoxelMap) -> VoxelMap:
    """The voxel map without the empty layers at its sides. One voxel remains if all are empty.

    **Arguments:**

    - `voxels`: a `VoxelMap`.

    **Returns:** a `VoxelMap` of the same voxels, smaller, with `origin` moved to its new corner.

    **Raises:** TypeError for what is no `VoxelMap`.

    **Example:**

    >>> import numpy as np, jaxlidar as jl
    >>> density = np.zeros((6, 6, 6))
    >>> density[2:4, 1:4, 3] = 1.0
    >>> smaller = jl.trim_empty_layers(jl.VoxelMap.from_lad(density, voxel_size=0.5))
    >>> print(smaller.shape, smaller.origin.tolist())
    (2, 3, 1) [1.0, 0.5, 1.5]
    """
    check_kind("voxels", voxels, VoxelMap, "a VoxelMap")
    full = voxels.mean_extinction() > 0
    if not full.any():
        full[0, 0, 0] = True
    parts, first = [], []
    for axis in range(3):
        (found,) = np.nonzero(full.any(axis=tuple(k for k in range(3) if k != axis)))
        parts.append(slice(found[0], found[-1] + 1))
        first.append(found[0])
    inside = tuple(parts)
    return VoxelMap(
        None if voxels.leaf is None else voxels.leaf[inside],
        None if voxels.bark is None else voxels.bark[inside],
        voxels.voxel_size,
        np.asarray(voxels.origin, float) + np.asarray(voxels.voxel_size, float) * first,
        voxels.leaf_angles,
    )


def _reach(tree: Tree) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of a box around all wood and clumps."""
    axis = (tree.end - tree.start) / np.maximum(tree.length, 1e-30)[:, None]
    # Extent along x, y and z of a unit disc across the axis.
    wide = np.sqrt(np.maximum(1.0 - axis * axis, 0.0))
    lows, highs = [], []
    for centre, reach in (
        (tree.start, tree.radius_start[:, None] * wide),
        (tree.end, tree.radius_end[:, None] * wide),
        (tree.bud_position, tree.bud_radius[:, None]),
    ):
        if len(centre):
            lows.append((centre - reach).min(axis=0))
            highs.append((centre + reach).max(axis=0))
    return np.min(lows, axis=0), np.max(highs, axis=0)


def _subvoxels_in(tree: Tree, i: int, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres of the subvoxels within a branch segment, and the share of its volume at each."""
    start, a, b = tree.start[i], tree.radius_start[i], tree.radius_end[i]
    axis = tree.end[i] - start
    length = max(float(np.linalg.norm(axis)), 1e-30)
    axis = axis / length
    wide = np.sqrt(np.maximum(1.0 - axis * axis, 0.0)) * max(a, b)
    low, high = (f(start, tree.end[i]) for f in (np.minimum, np.maximum))
    number = (
        np.arange(int(np.floor(lo / d)), int(np.ceil(hi / d)) + 1)
        for lo, hi, d in zip(low - wide, high + wide, step)
    )
    place = np.stack([n.ravel() for n in np.meshgrid(*number, indexing="ij")], axis=1)
    place = (place + 0.5) * step
    along = (place - start) @ axis
    across2 = np.sum((place - start) ** 2, axis=1) - along**2
    place = place[(along >= 0) & (along < length) & (across2 <= (a + (b - a) * along / length) ** 2)]
    if not len(place):
        # No centre lies within a thin or short segment: all of its volume counts at its middle.
        place = (start + 0.5 * length * axis)[None, :]
    volume = np.pi / 3 * np.linalg.norm(tree.end[i] - start) * (a * a + a * b + b * b)
    return place, np.full(len(place), volume / len(place))


def _in_frustums(
    tree: Tree, part: np.ndarray, apart: float, *, on_surface: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Points within branch segments, or on their sides, about `apart` m from each other, and their shares.

    Shares are of the volume in m3, or of the lateral surface in m2.
    """
    start, end = tree.start[part], tree.end[part]
    a, b = tree.radius_start[part], tree.radius_end[part]
    length = np.linalg.norm(end - start, axis=1)
    widest = np.maximum(a, b) / apart
    wide = np.clip(np.ceil(2 * np.pi * widest if on_surface else np.pi * widest**2), 3, _MOST).astype(int)
    slabs = np.clip(np.ceil(length / apart), 1, np.maximum(_MOST // wide, 1)).astype(int)
    axis = (end - start) / np.maximum(length, 1e-30)[:, None]
    # Two directions across the axis: from z, or from x where the axis is close to vertical.
    other = np.where(np.abs(axis[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    u = np.cross(axis, other)
    u /= np.maximum(np.linalg.norm(u, axis=1), 1e-30)[:, None]
    v = np.cross(axis, u)

    def spread(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """For groups of `counts` members: the group of each member, and its number from 0 within it."""
        owner = np.repeat(np.arange(len(counts)), counts)
        return owner, np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)

    segment, slab = spread(slabs)
    lower, upper = slab / slabs[segment], (slab + 1) / slabs[segment]
    slope, thick = (b - a)[segment], length[segment] / slabs[segment]
    inner, outer = a[segment] + slope * lower, a[segment] + slope * upper
    if on_surface:
        amount = np.pi * (inner + outer) * np.hypot(thick, outer - inner)
    else:
        amount = np.pi / 3 * thick * (inner**2 + inner * outer + outer**2)
    owner, point = spread(wide[segment])
    s = segment[owner]
    # Discs of successive slabs are rotated against each other, and their points lie at different depths.
    turn = _GOLDEN_ANGLE * point + 2.399 * slab[owner]
    depth = lower[owner] + (upper - lower)[owner] * ((point * 0.7548776662466927 + 0.5) % 1.0)
    r = a[s] + (b - a)[s] * depth
    if not on_surface:
        r *= np.sqrt((point + 0.5) / wide[s])
    place = start[s] + (end - start)[s] * depth[:, None]
    place += (r * np.cos(turn))[:, None] * u[s] + (r * np.sin(turn))[:, None] * v[s]
    return place, (amount / wide[segment])[owner]


def _parts(count: int, most: int) -> Iterator[np.ndarray]:
    """The numbers from 0 to `count`, at most so many at a time."""
    for start in range(0, count, most):
        yield np.arange(start, min(start + most, count))


def _at_centres(tree: Tree, part: np.ndarray, leaf_area: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Centres of leaf clumps, and the volume, or the leaf area, of each."""
    radius = tree.bud_radius[part]
    amount = np.full(len(radius), leaf_area) if leaf_area is not None else 4 / 3 * np.pi * radius**3
    return tree.bud_position[part], amount


def _in_spheres(
    tree: Tree, part: np.ndarray, apart: float, leaf_area: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Points within leaf clumps, and the volume, or the leaf area, at each."""
    (centre, amount), radius = _at_centres(tree, part, leaf_area), tree.bud_radius[part]
    n = int(np.clip(np.ceil(4 / 3 * np.pi * (radius.max() / apart) ** 3), 32, _MOST))
    i = np.arange(n)
    height = 1.0 - 2.0 * ((i * 0.7548776662466927 + 0.5) % 1.0)
    across = np.sqrt(1.0 - height * height)
    unit = np.stack([across * np.cos(_GOLDEN_ANGLE * i), across * np.sin(_GOLDEN_ANGLE * i), height], axis=1)
    unit *= np.cbrt((i + 0.5) / n)[:, None]
    place = centre[:, None, :] + radius[:, None, None] * unit
    return place.reshape(-1, 3), np.repeat(amount / n, n)


def _settled(share: np.ndarray) -> np.ndarray:
    """Shares of at most 1 with the same sum: the excess spreads to the neighbours, until little is left."""
    if share.sum() >= share.size:
        raise ValueError(f"trees = {share.sum():.3g} voxels of material, but the grid has {share.size}")
    while True:
        excess = np.maximum(share - 1.0, 0.0)
        share = share - excess
        if excess.sum() <= 1e-4 * share.sum():
            return share
        for axis in range(3):
            # Nothing leaves the grid at its sides.
            around = np.pad(excess, [(int(k == axis),) * 2 for k in range(3)], mode="edge")
            around = np.moveaxis(around, axis, 0)
            share += np.moveaxis(around[:-2] + around[2:], 0, axis) / 6


def _map(grid: Grid, leaf, volume, surface, tree: Tree, leaf_area: float | None, wood: str) -> VoxelMap:
    cell = grid.size.prod()
    bark = None
    if len(tree.start):
        solid = VoxelMap.from_probability(bark=_settled(volume / cell), voxel_size=grid.size).bark
        bark = solid if wood == "volume" else np.maximum(np.asarray(solid), surface / (4.0 * cell))
    green = None
    if len(tree.bud_position):
        if leaf_area is None:
            green = VoxelMap.from_probability(leaf=_settled(leaf / cell), voxel_size=grid.size).leaf
        else:
            green = 0.5 * leaf / cell
    return VoxelMap.from_extinction(leaf=green, bark=bark, voxel_size=grid.size, origin=grid.low)
