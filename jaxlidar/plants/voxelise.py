"""Voxel maps of trees and point clouds: volumes and areas of solids are counted on a regular grid.

*Quantities.* In a voxel of volume V and edge e, with the volume v of wood or leaf clumps, the lateral area S
of wood and the one-sided leaf area L that lie within it, the extinction coefficients (1/m) are

    -ln(1 - v/V)/e    of solids: a ray that crosses the voxel meets them with the probability v/V,
    S/(4 V)           of thin wood: a convex body's mean projected area is a quarter of its surface (Cauchy),
    L/(2 V)           of leaves: G = 1/2 for spherical leaf angles.

*Sampling.* v, S and L are sums over sample points, each of which carries a part of the volume or area of its
solid and counts in the voxel in which it lies. Points are h = `voxel_size / samples` apart:

- A frustum of length l and end radii a and b has the volume pi l (a^2 + a b + b^2)/3 and the lateral area
  pi (a + b) sqrt(l^2 + (a - b)^2). It is cut into slabs of about h; each slab's exact volume or area is
  divided among points of a sunflower disc (golden angle, r ~ sqrt(i + 1/2); Vogel 1979) or on its rim.
- A frustum with radii of 4 h or more uses the centres of the subvoxels of edge h within it, so that a voxel
  inside is full.
- A sphere uses points at golden angles, whose heights and radii are low-discrepancy sequences. A clump within
  one voxel counts there undivided.

The sum over voxels is the volume of the solids, whatever the voxel size. Only the division between
neighbouring voxels is uncertain: a voxel that the side of a trunk cuts through is off by about 1 % of its
volume with 8 samples (root mean square, measured).
"""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxlidar._fields.checks import (
    check_choice,
    check_integer,
    check_kind,
    check_number,
    check_shape,
    checked_array,
    kind_of,
)
from jaxlidar.plants.grid import Grid, voxel_edges
from jaxlidar.plants.stand import Stand
from jaxlidar.plants.tree import Tree
from jaxlidar.progress import ProgressOption, shows_progress
from jaxlidar.scenes.voxels import VoxelMap

# In radians.
_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
# The fractional parts of its multiples fill [0, 1) evenly, and are not correlated with golden angles: the
# reciprocal of the plastic number, 1.3247.
_LOW_DISCREPANCY = 0.7548776662466927
# Segments or clumps whose sample points are in memory at a time, and clumps that count undivided.
_SAMPLED_CHUNK, _UNDIVIDED_CHUNK = 2000, 500_000
# Largest number of points of one solid: more would not change a voxel by 0.1 %.
_MAX_POINTS = 200_000
# Small voxels along an edge, and azimuths, of the individuals of a stand.
_OFFSETS, _AZIMUTHS = 4, 16
# Distance, in voxels, within which faces coincide: the rounding of map coordinates.
_FACE_TOLERANCE = 1e-7


@shows_progress
def voxelise(
    trees: Tree | Iterable[Tree],
    voxel_size: float | tuple[float, float, float],
    *,
    leaf_area: float | None = None,
    wood: str = "volume",
    samples: int = 8,
    origin: tuple[float, float, float] | None = None,
    shape: tuple[int, int, int] | None = None,
    progress: ProgressOption = None,
) -> VoxelMap:
    """Voxelise leaf and bark of one tree, or of several trees together.

    Where solids overlap, as branches do at joints, a voxel is at most full. The excess volume goes to the
    voxels around it, so that volumes are conserved.

    A `Stand`, such as `forest` makes, is voxelised by its individuals: each one once for each azimuth, on a
    grid whose voxels are four times smaller, which are divided among the voxels of the stand by the volumes
    in which they overlap. Trees stand exactly at their positions; only azimuths are rounded, to multiples of
    22.5 degrees. To voxelise each of its trees for itself, which takes longer, give them as a list.

    **Arguments:**

    - `trees`: a `Tree`, several, or a `Stand`.
    - `voxel_size`: voxel edges in m, positive: one number for cubes, or three.
    - `leaf_area`: one-sided leaf area of every clump in m2, 0 or more, spread evenly through its sphere. The
      extinction coefficient of leaf is then area / (2 volume). None: a clump fills its sphere, and the
      probability of leaf is the fraction of the voxel that clumps occupy. The clump radius is that of the
      tree; see `Tree.with_bud_radius`. Default None; of a stand that has leaf areas: these.
    - `wood`: "volume": the probability of bark is the fraction of the voxel that wood occupies. Twigs much
      thinner than a voxel then intercept less light than their width would. "surface": the extinction
      coefficient is a quarter of the wood surface per volume, as for thin convex bodies of random orientation
      (Cauchy), or that of "volume" where it is larger. Default "volume".
    - `samples`: points per voxel edge, an integer of at least 1. Default 8.
    - `origin`, `shape`: lower corner (x, y, z) in m and numbers of voxels (nx, ny, nz) of the grid; give both
      or neither. Default None: the smallest grid that holds all trees, with faces at multiples of the edge,
      so that the maps of neighbouring trees fit together.
    - `progress`: of a stand: True for a bar; or a function called with the numbers of trees that are done,
      and of all, after each. Default None: silent.

    **Returns:** a `VoxelMap`.

    **Raises:** ValueError for inadmissible arguments, for trees with neither wood nor clumps, for trees that
    reach out of a given grid, and for more material than the grid can hold; TypeError for an object that is
    no `Tree`.

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
    if isinstance(trees, Stand):
        if leaf_area is not None:
            check_number("leaf_area", leaf_area, 0.0)
        areas = trees.leaf_area if leaf_area is None else np.full(len(trees), float(leaf_area))
        voxels = _voxelise_stand(
            trees,
            areas,
            voxel_size,
            wood=wood,
            samples=samples,
            origin=origin,
            shape=shape,
            progress=progress,
        )
        return dataclasses.replace(voxels, crs=trees.crs)
    trees = [trees] if isinstance(trees, Tree) else list(trees)
    size = voxel_edges(voxel_size)
    check_choice("wood", wood, ("volume", "surface"))
    if leaf_area is not None:
        check_number("leaf_area", leaf_area, 0.0)
    samples = check_integer("samples", samples)
    tree = Tree.joined(trees)
    if not len(tree.start) and not len(tree.bud_position):
        raise ValueError("trees have neither wood nor clumps; there is nothing to voxelise")
    grid = Grid.enclosing(*_bounding_box(tree), size, origin, shape)
    sums = _sum_material(tree, grid, leaf_area, wood, samples)
    return _voxel_map(grid, sums, _has_material(tree), leaf_area, wood)


class _MaterialSums(NamedTuple):
    """Sums by voxel, (nx, ny, nz): volume of wood (m3), its side area (m2), and leaf (m3 or m2)."""

    volume: np.ndarray
    surface: np.ndarray
    leaf: np.ndarray


def _sum_material(tree: Tree, grid: Grid, leaf_area: float | None, wood: str, samples: int) -> _MaterialSums:
    """Sum wood and leaf of a tree in each voxel of a grid that holds it, from `samples` points per edge."""
    spacing = float(grid.size.min()) / samples
    volume, surface, leaf = grid.zeros(), grid.zeros(), grid.zeros()
    is_thick = np.minimum(tree.radius_start, tree.radius_end) >= 4 * spacing
    for i in np.flatnonzero(is_thick).tolist():
        grid.accumulate(*_subvoxels_in_frustum(tree, i, grid.size / samples), volume)
    for segments in _chunks(np.flatnonzero(~is_thick), _SAMPLED_CHUNK):
        grid.accumulate(*_points_in_frustums(tree, segments, spacing), volume)
    if wood == "surface":
        for segments in _chunks(np.arange(len(is_thick)), _SAMPLED_CHUNK):
            grid.accumulate(*_points_in_frustums(tree, segments, spacing, on_surface=True), surface)
    for clumps in _chunks(np.arange(len(tree.bud_position)), _UNDIVIDED_CHUNK):
        is_undivided = grid.contains_in_one_voxel(tree.bud_position[clumps], tree.bud_radius[clumps])
        grid.accumulate(*_clump_centres(tree, clumps[is_undivided], leaf_area), leaf)
        for divided in _chunks(clumps[~is_undivided], _SAMPLED_CHUNK):
            grid.accumulate(*_points_in_clumps(tree, divided, spacing, leaf_area), leaf)
    return _MaterialSums(volume, surface, leaf)


def _has_material(tree: Tree) -> tuple[bool, bool]:
    """Return whether a tree has wood, and whether it has leaf clumps."""
    return len(tree.start) > 0, len(tree.bud_position) > 0


def _voxelise_stand(
    stand: Stand,
    leaf_area: Float[np.ndarray, " n"] | None,
    voxel_size: float | tuple[float, float, float],
    *,
    wood: str,
    samples: int,
    origin: tuple[float, float, float] | None,
    shape: tuple[int, int, int] | None,
    progress: ProgressOption,
) -> VoxelMap:
    """Voxelise a stand by its individuals; arguments as those of `voxelise`.

    1. Copies of one individual and azimuth are taken together. Its sums over small voxels are accumulated
       along the three axes (a summed-area table; Crow 1984), once for all of these copies.
    2. The faces of the stand's voxels are moved to the coordinates of the individual. The table, linear
       between its nodes, is interpolated at their corners, and its differences are the amounts of a copy in
       the voxels.
    """
    size = voxel_edges(voxel_size)
    check_choice("wood", wood, ("volume", "surface"))
    samples = check_integer("samples", samples)
    step = np.round(stand.azimuth / 360.0 * _AZIMUTHS).astype(int) % _AZIMUTHS
    material = np.array([_has_material(tree) for tree in stand.individuals])[stand.individual]
    has_wood, has_leaf = bool(np.any(material[:, 0])), bool(np.any(material[:, 1]))
    if not has_wood and not has_leaf:
        raise ValueError("individuals have neither wood nor clumps; there is nothing to voxelise")
    patterns: dict[tuple[int, int], list[int]] = {}
    for copy in np.flatnonzero(material.any(axis=1)).tolist():
        patterns.setdefault((int(stand.individual[copy]), int(step[copy])), []).append(copy)
    turned = {(k, m): stand.individuals[k].rotated(360.0 * m / _AZIMUTHS) for k, m in patterns}
    # Stretching moves the box around the axes of the wood; radii and clumps around them stretch differently.
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for key, copies in patterns.items():
        box = np.stack(_bounding_box(turned[key]))
        ends = stand.position[copies, None] + stand.scale[copies][:, None, [0, 0, 1]] * box
        low, high = np.minimum(low, ends[:, 0].min(axis=0)), np.maximum(high, ends[:, 1].max(axis=0))
    grid = Grid.enclosing(low, high, size, origin, shape)
    sums = _MaterialSums(grid.zeros(), grid.zeros(), grid.zeros())
    n_copies = 0
    for key, copies in patterns.items():
        fine = Grid.enclosing(*_bounding_box(turned[key]), size / _OFFSETS, None, None)
        # One m2 in each clump, where the areas are given.
        unit_area = None if leaf_area is None else 1.0
        amounts = _sum_material(turned[key], fine, unit_area, wood, -(-samples // _OFFSETS))
        tables = [_summed_area_table(a) for a in amounts]
        factors = _amount_factors(stand, key[0], copies, leaf_area)
        for copy, amount_factors in zip(copies, factors):
            stretch = stand.scale[copy, [0, 0, 1]]
            # The coarse grid in small voxels of the individual: its corner and its voxels.
            corner = ((grid.low - stand.position[copy]) / stretch - fine.low) / fine.size
            faces = [
                _faces_within(*of_axis) for of_axis in zip(corner, _OFFSETS / stretch, fine.shape, grid.shape)
            ]
            target = tuple(slice(first, first + len(t) - 1) for first, t in faces)
            for total, table, factor in zip(sums, tables, amount_factors):
                if factor > 0.0 and table[-1, -1, -1] > 0.0:
                    total[target] += factor * _box_sums(table, [t for _, t in faces])
            n_copies += 1
            if callable(progress):
                progress(n_copies, len(stand))
    if callable(progress) and n_copies < len(stand):
        # Copies without material took no time.
        progress(len(stand), len(stand))
    return _voxel_map(grid, sums, (has_wood, has_leaf), None if leaf_area is None else 1.0, wood)


def _summed_area_table(amounts: np.ndarray) -> np.ndarray:
    """Return the sums of all voxels below each node: zeros at the lower sides, then cumulative sums."""
    return np.pad(amounts, ((1, 0), (1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1).cumsum(axis=2)


def _faces_within(corner: float, step: float, n_small: int, n_voxels: int) -> tuple[int, np.ndarray]:
    """Return the first voxel that small voxels reach, and the faces of all that they reach.

    The faces of n voxels are at corner + step * k, k = 0 ... n, in small voxels, of which there are
    `n_small`. What lies beyond the grid counts in its outermost voxels.
    """
    first = int(np.clip(np.floor(-corner / step + _FACE_TOLERANCE), 0, n_voxels - 1))
    last = int(np.clip(np.ceil((n_small - corner) / step - _FACE_TOLERANCE), first + 1, n_voxels))
    faces = np.clip(corner + step * np.arange(first, last + 1), 0.0, n_small)
    # Faces that coincide with those of small voxels may differ from them by rounding.
    whole = np.round(faces)
    faces = np.where(np.abs(faces - whole) < _FACE_TOLERANCE * step, whole, faces)
    faces[0], faces[-1] = 0.0, n_small
    return first, faces


def _box_sums(table: np.ndarray, faces: Sequence[np.ndarray]) -> np.ndarray:
    """Return the sums in the boxes between faces. Small voxels that a face cuts count in proportion."""
    total = table[-1, -1, -1]
    for axis, t in enumerate(faces):
        node = np.minimum(np.floor(t).astype(int), table.shape[axis] - 2)
        weight = np.expand_dims(t - node, tuple(k for k in range(3) if k != axis))
        table = (1.0 - weight) * table.take(node, axis) + weight * table.take(node + 1, axis)
    sums = np.diff(np.diff(np.diff(table, axis=0), axis=1), axis=2)
    # Differences of equal sums are zero but for rounding.
    return np.where(sums > 1e-12 * total, sums, 0.0)


def _amount_factors(
    stand: Stand, k: int, copies: list[int], leaf_area: Float[np.ndarray, " n"] | None
) -> np.ndarray:
    """Return (copies, 3) factors of copies of individual k on its volume and side area of wood, and leaf."""
    tree, scale = stand.individuals[k], stand.scale[copies]
    a, b = tree.radius_start, tree.radius_end
    run, rise = np.hypot(*(tree.end - tree.start).T[:2]), np.abs((tree.end - tree.start)[:, 2])
    volume, side = a * a + a * b + b * b, a + b
    factors = np.ones((len(copies), 3))
    for row, (horizontal, vertical, radial) in enumerate(scale):
        length = np.hypot(horizontal * run, vertical * rise)
        if len(a):
            factors[row, 0] = radial**2 * np.sum(volume * length) / np.sum(volume * tree.length)
            slant = np.hypot(length, radial * (a - b)) / np.sum(side * np.hypot(tree.length, a - b))
            factors[row, 1] = radial * np.sum(side * slant)
    is_area = leaf_area is not None
    factors[:, 2] = leaf_area[copies] if is_area else scale[:, 0] ** 2 * scale[:, 1]
    return factors


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
    """Voxelise a point cloud, such as a terrestrial laser scan.

    Points alone do not tell the leaf area. The total leaf area is therefore an argument, and is divided among
    the voxels in proportion to their numbers of points. A scan has fewer points on occluded plants. Maps that
    account for the paths of the beams, such as those of AMAPVox, are better: `jaxlidar.io.read_vox`.

    **Arguments:**

    - `points`: (n, 3) positions in m.
    - `voxel_size`: voxel edges in m, positive: one number for cubes, or three.
    - `leaf_area`: one-sided area of all leaves together, m2, 0 or more.
    - `is_wood`: (n,) booleans, true for points on wood. Default None: no point.
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
    points = checked_array("points", points, (None, 3))
    check_number("leaf_area", leaf_area, 0.0)
    check_number("wood_probability", wood_probability, 0.0, 1.0)
    min_points = check_integer("min_points", min_points)
    on_wood = np.zeros(len(points), bool) if is_wood is None else np.asarray(is_wood)
    # Numbers are refused: they may be classes, as in a LAS file, and nearly all would count as true.
    if on_wood.dtype != bool:
        raise TypeError(f"is_wood is {kind_of(is_wood)}; admissible is an array of booleans, one a point")
    check_shape("is_wood", on_wood, (len(points),))
    size = voxel_edges(voxel_size)
    # A point on the upper face of the grid counts in the voxel below it.
    grid = Grid.enclosing(points.min(axis=0), np.nextafter(points.max(axis=0), np.inf), size, origin, shape)
    leaf_points, wood_points = grid.zeros(), grid.zeros()
    for selected, counts in ((~on_wood, leaf_points), (on_wood, wood_points)):
        grid.accumulate(points[selected], np.ones(int(selected.sum())), counts)
        counts[counts < min_points] = 0.0
    n_leaf_points = leaf_points.sum()
    if n_leaf_points == 0 and leaf_area > 0:
        raise ValueError(f"leaf_area = {leaf_area:g} m2, but no voxel holds {min_points} or more leaf points")
    density = leaf_points * (leaf_area / max(n_leaf_points, 1.0) / size.prod())
    bark = None
    if on_wood.any():
        probability = np.where(wood_points > 0, wood_probability, 0.0)
        bark = VoxelMap.from_probability(bark=probability, voxel_size=size).bark
    return VoxelMap.from_lad(density, bark=bark, voxel_size=size, origin=grid.low)


def _bounding_box(tree: Tree) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of a box around all wood and clumps."""
    axis = (tree.end - tree.start) / np.maximum(tree.length, 1e-30)[:, None]
    # Extent along x, y and z of a unit disc across the axis.
    disc = np.sqrt(np.maximum(1.0 - axis * axis, 0.0))
    lows, highs = [], []
    for centre, extent in (
        (tree.start, tree.radius_start[:, None] * disc),
        (tree.end, tree.radius_end[:, None] * disc),
        (tree.bud_position, tree.bud_radius[:, None]),
    ):
        if len(centre):
            lows.append((centre - extent).min(axis=0))
            highs.append((centre + extent).max(axis=0))
    return np.min(lows, axis=0), np.max(highs, axis=0)


def _subvoxels_in_frustum(tree: Tree, i: int, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres of the subvoxels of edges `step` in branch segment i, and its volume divided among them."""
    start, a, b = tree.start[i], tree.radius_start[i], tree.radius_end[i]
    axis = tree.end[i] - start
    length = max(float(np.linalg.norm(axis)), 1e-30)
    axis = axis / length
    extent = np.sqrt(np.maximum(1.0 - axis * axis, 0.0)) * max(a, b)
    low, high = (f(start, tree.end[i]) for f in (np.minimum, np.maximum))
    indices = (
        np.arange(int(np.floor(lo / d)), int(np.ceil(hi / d)) + 1)
        for lo, hi, d in zip(low - extent, high + extent, step)
    )
    position = np.stack([n.ravel() for n in np.meshgrid(*indices, indexing="ij")], axis=1)
    position = (position + 0.5) * step
    # Within the frustum: 0 <= z < length along the axis, and a distance from it below the radius at z.
    z = (position - start) @ axis
    distance2 = np.sum((position - start) ** 2, axis=1) - z**2
    position = position[(z >= 0) & (z < length) & (distance2 <= (a + (b - a) * z / length) ** 2)]
    if not len(position):
        # No centre lies within a thin or short segment: all of its volume counts at its middle.
        position = (start + 0.5 * length * axis)[None, :]
    volume = np.pi / 3 * np.linalg.norm(tree.end[i] - start) * (a * a + a * b + b * b)
    return position, np.full(len(position), volume / len(position))


def _points_in_frustums(
    tree: Tree, segments: np.ndarray, spacing: float, *, on_surface: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Points within branch segments, or on their sides, about `spacing` m apart, and the amount at each.

    Amounts are of the volume in m3, or of the lateral surface in m2.

    1. Every segment gets as many slabs as its length asks for, and every slab as many points as its widest
       cross-section or circumference asks for.
    2. The exact volume or lateral area of each slab, a frustum, is divided evenly among its points.
    3. Points lie on a sunflower disc, or on the rim, at a depth within the slab of their own.
    """
    start, end = tree.start[segments], tree.end[segments]
    a, b = tree.radius_start[segments], tree.radius_end[segments]
    length = np.linalg.norm(end - start, axis=1)
    widest = np.maximum(a, b) / spacing
    n_points = np.ceil(2 * np.pi * widest if on_surface else np.pi * widest**2)
    n_points = np.clip(n_points, 3, _MAX_POINTS).astype(int)
    n_slabs = np.clip(np.ceil(length / spacing), 1, np.maximum(_MAX_POINTS // n_points, 1)).astype(int)
    axis = (end - start) / np.maximum(length, 1e-30)[:, None]
    # Two directions across the axis: from z, or from x where the axis is close to vertical.
    not_parallel = np.where(np.abs(axis[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    u = np.cross(axis, not_parallel)
    u /= np.maximum(np.linalg.norm(u, axis=1), 1e-30)[:, None]
    v = np.cross(axis, u)

    def members(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """For groups of `counts` members: the group of each member, and its number from 0 within it."""
        group = np.repeat(np.arange(len(counts)), counts)
        return group, np.arange(len(group)) - np.repeat(np.cumsum(counts) - counts, counts)

    segment, slab = members(n_slabs)
    # Lower and upper end of each slab as fractions of the segment's length, and the radii there.
    lower, upper = slab / n_slabs[segment], (slab + 1) / n_slabs[segment]
    taper, thickness = (b - a)[segment], length[segment] / n_slabs[segment]
    radius_lower, radius_upper = a[segment] + taper * lower, a[segment] + taper * upper
    if on_surface:
        amount = np.pi * (radius_lower + radius_upper) * np.hypot(thickness, radius_upper - radius_lower)
    else:
        square = radius_lower**2 + radius_lower * radius_upper + radius_upper**2
        amount = np.pi / 3 * thickness * square
    slab_of_point, point = members(n_points[segment])
    s = segment[slab_of_point]
    # Discs of successive slabs are rotated against each other, by about the golden angle.
    azimuth = _GOLDEN_ANGLE * point + 2.399 * slab[slab_of_point]
    depth = lower[slab_of_point] + (upper - lower)[slab_of_point] * ((point * _LOW_DISCREPANCY + 0.5) % 1.0)
    r = a[s] + (b - a)[s] * depth
    if not on_surface:
        r *= np.sqrt((point + 0.5) / n_points[s])
    position = start[s] + (end - start)[s] * depth[:, None]
    position += (r * np.cos(azimuth))[:, None] * u[s] + (r * np.sin(azimuth))[:, None] * v[s]
    return position, (amount / n_points[segment])[slab_of_point]


def _chunks(indices: np.ndarray, size: int) -> Iterator[np.ndarray]:
    """Split indices into arrays of at most `size`, which bounds the memory that sample points take."""
    for start in range(0, len(indices), size):
        yield indices[start : start + size]


def _clump_centres(tree: Tree, clumps: np.ndarray, leaf_area: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Centres of leaf clumps, and the volume, or the leaf area, of each."""
    radius = tree.bud_radius[clumps]
    amount = np.full(len(radius), leaf_area) if leaf_area is not None else 4 / 3 * np.pi * radius**3
    return tree.bud_position[clumps], amount


def _points_in_clumps(
    tree: Tree, clumps: np.ndarray, spacing: float, leaf_area: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Points within leaf clumps, and the volume, or the leaf area, at each."""
    (centre, amount), radius = _clump_centres(tree, clumps, leaf_area), tree.bud_radius[clumps]
    # All clumps get the points of the largest.
    n = int(np.clip(np.ceil(4 / 3 * np.pi * (radius.max() / spacing) ** 3), 32, _MAX_POINTS))
    i = np.arange(n)
    # Directions that are even over the sphere, at radii that fill the ball: r^3 is even in [0, 1].
    height = 1.0 - 2.0 * ((i * _LOW_DISCREPANCY + 0.5) % 1.0)
    across = np.sqrt(1.0 - height * height)
    unit = np.stack([across * np.cos(_GOLDEN_ANGLE * i), across * np.sin(_GOLDEN_ANGLE * i), height], axis=1)
    unit *= np.cbrt((i + 0.5) / n)[:, None]
    position = centre[:, None, :] + radius[:, None, None] * unit
    return position.reshape(-1, 3), np.repeat(amount / n, n)


def _spread_excess(fraction: np.ndarray) -> np.ndarray:
    """Return volume fractions of at most 1 with the same sum, up to 1e-4 of it.

    Where solids overlap, a fraction may exceed 1. The excess diffuses to the six neighbours, step by step.
    """
    if fraction.sum() >= fraction.size:
        raise ValueError(f"trees = {fraction.sum():.3g} voxels of material, but the grid has {fraction.size}")
    while True:
        excess = np.maximum(fraction - 1.0, 0.0)
        fraction = fraction - excess
        if excess.sum() <= 1e-4 * fraction.sum():
            return fraction
        for axis in range(3):
            # Edge padding: nothing leaves the grid at its sides.
            padded = np.pad(excess, [(int(k == axis),) * 2 for k in range(3)], mode="edge")
            padded = np.moveaxis(padded, axis, 0)
            fraction += np.moveaxis(padded[:-2] + padded[2:], 0, axis) / 6


def _voxel_map(
    grid: Grid,
    sums: _MaterialSums,
    has_material: tuple[bool, bool],
    leaf_area: float | None,
    wood: str,
) -> VoxelMap:
    """Return extinction coefficients from sums per voxel (see the module); materials: wood, and leaf."""
    voxel_volume, (has_wood, has_leaf) = grid.size.prod(), has_material
    bark = None
    if has_wood:
        fraction = _spread_excess(sums.volume / voxel_volume)
        solid = VoxelMap.from_probability(bark=fraction, voxel_size=grid.size).bark
        # Inside thick wood there is no surface: the larger of the two is right there too.
        thin = sums.surface / (4.0 * voxel_volume)
        bark = solid if wood == "volume" else np.maximum(np.asarray(solid), thin)
    leaf_extinction = None
    if has_leaf:
        if leaf_area is None:
            fraction = _spread_excess(sums.leaf / voxel_volume)
            leaf_extinction = VoxelMap.from_probability(leaf=fraction, voxel_size=grid.size).leaf
        else:
            leaf_extinction = 0.5 * sums.leaf / voxel_volume
    return VoxelMap.from_extinction(leaf=leaf_extinction, bark=bark, voxel_size=grid.size, origin=grid.low)
