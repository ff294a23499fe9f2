"""Plant area density by voxel, from the returns of an airborne laser scan.

**Weights.** Every return counts alike, per pulse: it has the weight w = 1 / (number of last returns per m2
about it), so that areas that were scanned twice do not count twice. Sums of points with these weights are the
waveforms of simulators that add up points (Hancock et al. 2019).

**Estimator.** In a column of voxels, H_v is the weight of the plant returns in voxel v, and E_v that of all
returns in or below it, ground included: of all light that entered it. What lies behind the returns of a
column is not seen by them, and E_v is small: occlusion is accounted for. The probability of interception and
the extinction coefficient are

    p_v = H_v / E_v,    k_v = -ln(1 - p_v) / l_v,    l_v = edge / cos(scan angle),

with the mean length l_v of paths through the voxel above the ground (contact frequency; Pimont et al. 2018).
The transmittance of a column is then the fraction of its returns that come from below, at every height. The
plant area density is k_v / G, with the projection function G of the leaf angles.

**Neighbours.** A column of a metre has a return or two.

1. H and E are smoothed horizontally by a Gaussian that holds some twenty returns.
2. Columns have more or fewer returns than their neighbourhood (a Gaussian of 5 m) in the mean: pulses have
   several returns in trees and one on bare ground, and some columns have none. A column with fewer is filled
   up to the mean by the surplus of its neighbours, at the heights where that lies. So the profile of the
   neighbourhood is that of all returns.

**Standard errors** are those of a binomial proportion of the returns n_v that entered, var p = p (1 - p) / n
with p = (n p_v + 1/2) / (n + 1), which is positive where nothing was hit. Differences between the column and
its neighbours are not part of them.

**Ground.** At every node of a grid a plane is fitted to the ground returns nearby. Where returns are not
classified, ground is found in the lowest last returns: what morphological openings of growing size lower by
more than a slope would is not ground (Zhang et al. 2003; Pingel et al. 2013).

**Source:** Hancock et al. (2019), Earth Space Sci. 6, 294; Pimont et al. (2018), Remote Sens. Environ. 215,
343; Pingel, Clarke and McBride (2013), ISPRS J. Photogramm. 77, 21; Zhang et al. (2003), IEEE Trans. Geosci.
Remote Sens. 41, 872.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from jaxlidar._fields.checks import check_kind, check_range, check_shape
from jaxlidar.optics.leaf_angles import LeafAngles
from jaxlidar.plants.grid import Grid, voxel_edges
from jaxlidar.plants.point_cloud import PointCloud
from jaxlidar.scenes.terrain import Terrain
from jaxlidar.scenes.voxels import VoxelMap

# Classes of the LAS specification: ground and water, which no light passes; never classified.
_GROUND_CLASSES, _UNCLASSIFIED = (2, 9), (0, 1)
# Edge of the cells in which last returns are counted, m, as the GEDI simulator has it.
_DENSITY_CELL = 1.5
# Returns within the smoothing Gaussian, and standard deviation of the neighbourhood, m.
_SMOOTHED_RETURNS, _NEIGHBOURHOOD = 20.0, 5.0
# Largest probability of interception of a voxel: the lowest returns of a column would be a solid layer.
_MAX_PROBABILITY = 0.98
# Least height above the ground of the lowest voxel of a column, over its edge: lower ones have no volume.
_MIN_HEIGHT = 0.05
# Distance by which the terrain is continued beyond the points, m, so that footprints lie on it; it is dark.
_MARGIN = 50.0
# Largest scan angle, degrees, whose path length is taken as it is: files have larger ones that are wrong.
_MAX_SCAN_ANGLE = 60.0
# Ground returns to which a plane is fitted, and the fewest that make a terrain.
_PLANE_RETURNS, _MIN_GROUND = 12, 3
# Ground that is not classified: edge of the raster of lowest returns and largest radius of the openings, m;
# slope that is still ground; distance from the surface within which returns are ground, m.
_RASTER_EDGE, _MAX_RADIUS, _SLOPE, _GROUND_DISTANCE = 1.0, 12.0, 0.2, 0.3


class PointCanopy(NamedTuple):
    """A canopy and its ground from a point cloud, by `canopy_from_points`.

    - `voxels`: a `VoxelMap` of all plant material, wood included, in the coordinates of the cloud.
    - `stderr`: (nx, ny, nz) standard errors of the plant area density, m2/m3.
    - `terrain`: a `Terrain` from ground returns; None where there are none. It goes on 50 m beyond the
      points, at the height of its rim and without reflectance, so that footprints at the rim lie on it.

    **Example:** plant area index, from the voxel map.

    >>> import numpy as np, jaxlidar as jl
    >>> voxels = jl.VoxelMap.from_lad(np.full((2, 2, 5), 0.4), voxel_size=1.0)
    >>> from jaxlidar.plants.point_canopy import PointCanopy
    >>> cloud = PointCanopy(voxels, np.full((2, 2, 5), 0.1), None)
    >>> print(cloud.density.sum(axis=2).mean())
    2.0
    """

    voxels: VoxelMap
    stderr: Float[np.ndarray, "nx ny nz"]
    terrain: Terrain | None

    @property
    def density(self) -> Float[np.ndarray, "nx ny nz"]:
        """Plant area density, m2/m3."""
        assert self.voxels.leaf is not None
        return 2.0 * np.asarray(self.voxels.leaf)


def canopy_from_points(
    points: PointCloud,
    voxel_size: float | tuple[float, float, float] = 1.0,
    *,
    leaf_angles: str | LeafAngles = "spherical",
    reflectance: float = 0.3,
    origin: tuple[float, float, float] | None = None,
    shape: tuple[int, int, int] | None = None,
) -> PointCanopy:
    """Make a canopy and its terrain of the points of an airborne laser scan.

    Returns that are neither ground (class 2) nor water (class 9) are plants, whatever else they may be: leave
    out buildings before. Where no return is classified (classes 0 and 1 alone), ground is found. A waveform
    that is simulated over the result, at first order and with leaves as bright as the ground, is close to the
    sum of all points under the footprint. Pulses are taken as vertical as to which voxels they cross; their
    scan angle makes paths longer.

    **Arguments:**

    - `points`: a `PointCloud`, such as `jaxlidar.io.read_las` returns, one point or more.
    - `voxel_size`: voxel edges in m, positive: one number for cubes, or three. Default 1.
    - `leaf_angles`: leaf inclination, as in `VoxelMap.from_lad`. Default "spherical".
    - `reflectance`: reflectance of the terrain below the points, in [0, 1]. Default 0.3.
    - `origin`, `shape`: lower corner (x, y, z) in m and numbers of voxels (nx, ny, nz) of the grid; give both
      or neither. Default None: the smallest grid that holds all points, with faces at multiples of the edge.

    **Returns:** a `PointCanopy`.

    **Raises:** ValueError for inadmissible arguments, no point, positions that are not finite, returns with a
    number below 1 or beyond that of all returns of their pulse, and points outside a given grid; TypeError
    for arguments of the wrong type.

    **Source:** see the module's list; the estimator is that of Pimont et al. (2018), eq. 5.

    **Example:** a layer of single returns from pulses that half of the time reach the ground.

    >>> import numpy as np, jaxlidar as jl
    >>> random, one = np.random.default_rng(0), np.ones(40000, int)
    >>> is_ground = random.uniform(size=40000) < 0.5
    >>> z = np.where(is_ground, 0.0, random.uniform(4.0, 5.0, 40000))
    >>> position = np.column_stack([random.uniform(0.0, 40.0, (40000, 2)), z])
    >>> points = jl.io.PointCloud(position, np.where(is_ground, 2, 5), one, one, 1.0 * one, {})
    >>> cloud = jl.canopy_from_points(points)
    >>> print(f"{cloud.density[5:-5, 5:-5].sum(axis=2).mean():.1f}, of {2 * np.log(2):.1f}")
    1.4, of 1.4
    """
    check_kind("points", points, PointCloud, "a PointCloud, as jaxlidar.io.read_las returns it")
    _check_points(points)
    size = voxel_edges(voxel_size)
    check_range("reflectance", reflectance, 0.0, 1.0)
    check_kind("leaf_angles", leaf_angles, str | LeafAngles, "a name or a LeafAngles")
    angles = LeafAngles.named(leaf_angles) if isinstance(leaf_angles, str) else leaf_angles
    position = np.array(points.position, float)
    low, high = position.min(axis=0), np.nextafter(position.max(axis=0), np.inf)
    grid = Grid.enclosing(low, high, size, origin, shape)
    is_ground = _is_ground(points)
    surface, terrain = np.full(grid.shape[:2], grid.low[2]), None
    if is_ground.sum() >= _MIN_GROUND:
        spacing = float(np.sqrt(size[0] * size[1]))
        columns = _column_centres(grid)
        surface = _fitted_heights(position[is_ground], columns.reshape(-1, 2), spacing)
        surface = surface.reshape(grid.shape[:2])
        terrain = _terrain(position[is_ground], low[:2], position.max(axis=0)[:2], size[:2], reflectance)
        terrain = dataclasses.replace(terrain, crs=points.crs)
    ground_layer = np.clip(
        np.floor((surface - grid.low[2]) / size[2] + _MIN_HEIGHT).astype(int), 0, grid.shape[2] - 1
    )
    probability, entered = _interception(points, position, is_ground, grid, ground_layer)
    # Paths of the voxels that the ground cuts through end there.
    bottom = grid.low[2] + size[2] * np.arange(grid.shape[2])
    height = np.clip((bottom + size[2] - surface[:, :, None]) / size[2], _MIN_HEIGHT, 1.0)
    cosine = _mean_cosine(points)
    projection = float(np.interp(cosine, np.linspace(0.0, 1.0, 129), np.asarray(angles.tables()[0])))
    # Plant area density that intercepts exp(-1) of the light along such a path.
    unit_density = cosine / (size[2] * height * projection)
    density = -np.log1p(-probability) * unit_density
    smoothed = (entered * probability + 0.5) / (entered + 1.0)
    stderr = np.sqrt(smoothed / ((1.0 - smoothed) * (entered + 1.0))) * unit_density
    voxels = VoxelMap.from_lad(density, voxel_size=size, origin=tuple(grid.low), leaf_angles=leaf_angles)
    return PointCanopy(dataclasses.replace(voxels, crs=points.crs), stderr, terrain)


def _check_points(points: PointCloud) -> None:
    """Refuse points that are no returns. **Raises:** as `canopy_from_points`."""
    n = len(points.position)
    check_shape("points.position", points.position, (n, 3))
    if n == 0:
        raise ValueError("points.position holds no point; admissible is one or more")
    check_range("points.position", points.position)
    for name in ("classification", "return_number", "number_of_returns"):
        check_shape(f"points.{name}", getattr(points, name), (n,))
        check_range(f"points.{name}", getattr(points, name), 0 if name == "classification" else 1)
    if points.scan_angle is not None:
        check_shape("points.scan_angle", points.scan_angle, (n,))
        check_range("points.scan_angle", points.scan_angle, -180.0, 180.0)


def _mean_cosine(points: PointCloud) -> float:
    """Return the cosine of the scan angle at which paths have their mean length; 1 where it is not known."""
    if points.scan_angle is None:
        return 1.0
    angle = np.minimum(np.abs(points.scan_angle), _MAX_SCAN_ANGLE)
    return 1.0 / float(np.mean(1.0 / np.cos(np.deg2rad(angle))))


def _column_centres(grid: Grid) -> Float[np.ndarray, "nx ny 2"]:
    x, y = (grid.low[k] + grid.size[k] * (np.arange(grid.shape[k]) + 0.5) for k in range(2))
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)


# -- interception ------------------------------------------------------------------------------------------


def _weights(points: PointCloud) -> Float[np.ndarray, " n"]:
    """Return the weights of returns: one over the number of last returns per m2; the mean where none is."""
    cell = np.floor((points.position[:, :2] - points.position[:, :2].min(axis=0)) / _DENSITY_CELL).astype(int)
    index = np.ravel_multi_index(tuple(cell.T), tuple(cell.max(axis=0) + 1))
    is_last = points.return_number == points.number_of_returns
    last_returns = np.bincount(index, is_last)[index]
    is_counted = last_returns > 0
    weights = _DENSITY_CELL**2 / np.maximum(last_returns, 1.0)
    # Files of first returns alone have few last ones.
    return np.where(is_counted, weights, weights[is_counted].mean() if is_counted.any() else 1.0)


def _interception(
    points: PointCloud,
    position: Float[np.ndarray, "n 3"],
    is_ground: Bool[np.ndarray, " n"],
    grid: Grid,
    ground_layer: Int[np.ndarray, "nx ny"],
) -> tuple[Float[np.ndarray, "nx ny nz"], Float[np.ndarray, "nx ny nz"]]:
    """Return the probability of interception of each voxel, and the number of returns that entered it.

    1. Weights of plant returns by voxel, and of ground returns by column. Layers are counted from that of the
       ground, so that neighbours on a slope are compared at one height above it.
    2. Smoothed over some returns; columns filled up from their neighbourhood.
    3. What entered a voxel is the sum of what was returned in it, below it and from the ground.
    """
    weights, plants = _weights(points), position[~is_ground]
    # Errors of the surface put returns of low plants beneath it, where they would intercept nothing.
    column = np.clip(np.floor((plants[:, :2] - grid.low[:2]) / grid.size[:2]).astype(int), 0, None)
    column = np.minimum(column, np.array(grid.shape[:2]) - 1)
    lowest = grid.low[2] + grid.size[2] * (ground_layer[tuple(column.T)] + 0.5)
    plants[:, 2] = np.maximum(plants[:, 2], lowest)

    def sums(amount: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sum amounts over the plant returns of voxels, and over the ground returns of columns."""
        hits, ground = grid.zeros(), grid.zeros()
        grid.accumulate(plants, amount[~is_ground], hits)
        grid.accumulate(position[is_ground], amount[is_ground], ground)
        return _moved_layers(hits, ground_layer), ground.sum(axis=2)

    area = float(grid.size[0] * grid.size[1])
    # Of the columns that the returns span: a given grid may be larger.
    spanned = Grid.enclosing(position.min(axis=0), position.max(axis=0), grid.size, None, None)
    returns_per_column = len(position) / float(np.prod(spanned.shape[:2]))
    # A Gaussian of the standard deviation s holds 2 pi s^2 times the density.
    sigma = np.sqrt(_SMOOTHED_RETURNS * area / (2.0 * np.pi * returns_per_column))
    counted_hits, counted_ground = (_smooth(a, sigma, grid) for a in sums(np.ones(len(position))))
    hits, ground = (_smooth(a, sigma, grid) for a in sums(weights))
    hits, ground = _filled_up(hits, ground, grid)

    def entering(hits: np.ndarray, ground: np.ndarray) -> np.ndarray:
        return np.cumsum(hits, axis=2) + ground[:, :, None]

    entered = entering(hits, ground)
    is_lit = entered > 1e-12 * max(float(entered.max()), 1e-300)
    probability = np.where(is_lit, hits / np.where(is_lit, entered, 1.0), 0.0)
    # The mean of a Gaussian window of independent returns is as good as that of 4 pi s^2 times the density.
    window = max(1.0, 4.0 * np.pi * sigma**2 / area)
    counted = window * entering(counted_hits, counted_ground)
    # Back to layers of equal height. Below the ground are no plants, and no returns.
    probability = np.clip(probability, 0.0, _MAX_PROBABILITY)
    return _moved_layers(probability, -ground_layer), _moved_layers(counted, -ground_layer)


def _moved_layers(
    values: Float[np.ndarray, "nx ny nz"], layers: Int[np.ndarray, "nx ny"]
) -> Float[np.ndarray, "nx ny nz"]:
    """Move every column down by a number of layers; zero where nothing comes from."""
    count = values.shape[2]
    source = np.arange(count) + layers[:, :, None]
    moved = np.take_along_axis(values, np.clip(source, 0, count - 1), axis=2)
    return np.where((source >= 0) & (source < count), moved, 0.0)


def _smooth(values: np.ndarray, sigma: float, grid: Grid) -> np.ndarray:
    """Smooth values of voxels or columns horizontally by a Gaussian, m; nothing lies beyond the grid."""
    widths = (*(sigma / grid.size[:2]), 0.0)[: values.ndim]
    return scipy.ndimage.gaussian_filter(values, widths, mode="constant", truncate=3.0)


def _filled_up(
    hits: Float[np.ndarray, "nx ny nz"], ground: Float[np.ndarray, "nx ny"], grid: Grid
) -> tuple[np.ndarray, np.ndarray]:
    """Return hits and ground returns of columns that all have the mean number of returns nearby, as one.

    The surplus of a column with r times the mean is the fraction 1 - 1/r. It goes to the columns nearby that
    have less, in proportion to what they lack.
    """
    tiny = 1e-12
    inside = _smooth(np.ones_like(ground), _NEIGHBOURHOOD, grid)
    total = hits.sum(axis=2) + ground
    mean = np.maximum(_smooth(total, _NEIGHBOURHOOD, grid) / inside, tiny)
    ratio = total / mean
    surplus = np.maximum(ratio - 1.0, 0.0) / np.maximum(total, tiny)
    lacking = np.maximum(1.0 - ratio, 0.0)
    nearby_hits = _smooth(hits * surplus[:, :, None], _NEIGHBOURHOOD, grid)
    nearby_ground = _smooth(ground * surplus, _NEIGHBOURHOOD, grid)
    nearby = nearby_hits.sum(axis=2) + nearby_ground
    fill = np.where(nearby > tiny, lacking / np.maximum(nearby, tiny), 0.0)
    scale = 1.0 / np.maximum(total, mean)
    return (
        hits * scale[:, :, None] + nearby_hits * fill[:, :, None],
        ground * scale + nearby_ground * fill,
    )


# -- ground ------------------------------------------------------------------------------------------------


def _is_ground(points: PointCloud) -> Bool[np.ndarray, " n"]:
    """Return True for returns of ground or water: as classified, or found where nothing is classified."""
    if not np.all(np.isin(points.classification, _UNCLASSIFIED)):
        return np.isin(points.classification, _GROUND_CLASSES)
    return _lowest_surface(points)


def _lowest_surface(points: PointCloud) -> Bool[np.ndarray, " n"]:
    """Find ground in returns that are not classified, by progressive morphological opening.

    1. A raster of the lowest last returns; empty cells take the value of the nearest other one.
    2. Openings by discs of growing radius. Cells that are lowered by more than a slope would be are objects.
    3. Last returns near the surface through the remaining cells are ground.
    """
    position = np.asarray(points.position, float)
    (last,) = np.nonzero(points.return_number == points.number_of_returns)
    is_ground = np.zeros(len(position), bool)
    if last.size < _MIN_GROUND:
        return is_ground
    cell = np.floor((position[last, :2] - position[last, :2].min(axis=0)) / _RASTER_EDGE).astype(int)
    raster = np.full(tuple(cell.max(axis=0) + 1), np.inf)
    np.minimum.at(raster, tuple(cell.T), position[last, 2])
    is_empty = np.isinf(raster)
    nearest = scipy.ndimage.distance_transform_edt(is_empty, return_distances=False, return_indices=True)
    assert nearest is not None
    heights = raster[tuple(nearest)]
    is_object, radius = np.zeros(raster.shape, bool), 1
    while radius * _RASTER_EDGE <= min(_MAX_RADIUS, 0.5 * min(raster.shape) * _RASTER_EDGE):
        steps = np.arange(-radius, radius + 1)
        disc = np.add.outer(steps**2, steps**2) <= radius**2
        opened = scipy.ndimage.grey_opening(heights, footprint=disc, mode="nearest")
        is_object |= heights - opened > max(_SLOPE * radius * _RASTER_EDGE, _GROUND_DISTANCE)
        radius *= 2
    # The lowest return of each ground cell makes the surface.
    is_lowest = position[last, 2] == raster[tuple(cell.T)]
    on_surface = position[last[is_lowest & ~is_object[tuple(cell.T)]]]
    if len(on_surface) < _MIN_GROUND:
        return is_ground
    distance = position[last, 2] - _fitted_heights(on_surface, position[last, :2], _RASTER_EDGE)
    is_ground[last] = np.abs(distance) < _GROUND_DISTANCE
    return is_ground


def _terrain(
    ground: Float[np.ndarray, "n 3"],
    low: Float[np.ndarray, "2"],
    high: Float[np.ndarray, "2"],
    spacing: Float[np.ndarray, "2"],
    reflectance: float,
) -> Terrain:
    """Return the terrain over the rectangle of all points, with nodes about `spacing` m apart.

    It goes on at the height of its rim, without reflectance: ground without returns has no plants either.
    """
    extent = np.maximum(high - low, spacing)
    cells = np.maximum(np.ceil(extent / spacing - 1e-9).astype(int), 1)
    step = extent / cells
    margin = np.ceil(_MARGIN / step).astype(int)
    nodes = [np.arange(-m, n + m + 1) for m, n in zip(margin, cells)]
    x, y = (low[k] + step[k] * np.clip(nodes[k], 0, cells[k]) for k in range(2))
    place = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    heights = _fitted_heights(ground, place.reshape(-1, 2), float(np.sqrt(spacing.prod())))
    on_cloud = [(n >= 0) & (n <= count) for n, count in zip(nodes, cells)]
    raster = reflectance * np.outer(*on_cloud)
    origin = low - step * margin
    return Terrain(
        heights=heights.reshape(place.shape[:2]), spacing=step, origin=tuple(origin), reflectance=raster
    )


def _fitted_heights(
    ground: Float[np.ndarray, "n 3"], place: Float[np.ndarray, "places 2"], spacing: float
) -> Float[np.ndarray, " places"]:
    """Return the heights of planes that are fitted to the ground returns near each place.

    Weights are Gaussian. A small penalty keeps the slope of planes through few or collinear returns finite.
    """
    count = min(_PLANE_RETURNS, len(ground))
    middle = ground.mean(axis=0)
    distance, index = scipy.spatial.KDTree(ground[:, :2] - middle[:2]).query(place - middle[:2], k=count)
    distance, index = distance.reshape(len(place), count), index.reshape(len(place), count)
    width = np.maximum(distance[:, count // 2], 0.7 * spacing)[:, None]
    # Relative to the nearest return: far from all of them, weights would all be zero.
    weight = np.exp(-0.5 * (distance**2 - distance[:, :1] ** 2) / width**2)
    offset = ground[index, :2] - place[:, None]
    rows = np.concatenate([np.ones((*index.shape, 1)), offset / width[:, :, None]], axis=2)
    height = ground[index, 2] - middle[2]
    mean = (weight * height).sum(axis=1) / weight.sum(axis=1)
    matrix = np.einsum("nk,nki,nkj->nij", weight, rows, rows)
    matrix += 0.05 * weight.sum(axis=1)[:, None, None] * np.diag([0.0, 1.0, 1.0])
    right = np.einsum("nk,nki,nk->ni", weight, rows, height - mean[:, None])
    return middle[2] + mean + np.linalg.solve(matrix, right[:, :, None])[:, 0, 0]
