"""Voxel maps: extinction coefficients of leaf and bark on a regular grid.

Within a voxel the material is a turbid medium: a path of length l passes with the probability exp(-sigma l).
The extinction coefficient sigma (1/m) follows from

- the leaf area density, LAD (m2/m3): sigma = G(direction) LAD, with the projection function G of the leaf
  angles (1/2 for spherical ones). Maps store sigma for G = 1/2;
- the probability p that a ray which crosses one voxel edge d meets material: sigma = -ln(1 - p) / d.
"""

from collections.abc import Sequence
from typing import NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from jaxlidar._fields.checks import (
    Magnitude,
    Numbers,
    as_array,
    as_optional_array,
    check_kind,
    check_range,
    check_shape,
    checked_array,
    concrete,
    concrete_array,
    coordinates,
    has_tracers,
)
from jaxlidar._fields.crs import common_system, crs_name
from jaxlidar._fields.ranges import NOT_NEGATIVE, POSITIVE, check_ranges, quantity
from jaxlidar._jax.memory import machine_memory
from jaxlidar._text import object_text
from jaxlidar.optics.leaf_angles import LeafAngles
from jaxlidar.scenes.terrain import Terrain

# Optical depth along one edge of a solid voxel (probability 1): exp(-40) = 4e-18.
SOLID_OPTICAL_DEPTH = 40.0
# Faces that differ by less than this fraction of an edge are the same.
_FACE_TOLERANCE = 1e-6
# Points along the horizontal edges of voxels, where a map is turned, and how many are turned together.
_POINTS, _POINTS_AT_ONCE = 8, 2**21
# Bytes of a voxel while maps are joined.
_BYTES_PER_VOXEL = 40.0


def _as_triple(x: Numbers, field: str = "voxel_size") -> Float[Array, "3"]:
    """Convert a field that is three numbers, or one number for all three."""
    a = as_array(x, field)
    check_shape(field, a, (), (3,))
    value = concrete(a)
    return jnp.broadcast_to(a, (3,)) if value is None else as_array(np.broadcast_to(value, (3,)))


@final
class VoxelMap(eqx.Module):
    """A voxel map: extinction coefficients of leaf and bark in a box of equal voxels, x east, y north, z up.

    Make it by `VoxelMap.from_lad`, `VoxelMap.from_probability` or `VoxelMap.from_extinction`. Within a voxel
    the material is spread evenly as a turbid medium: the interception of a ray depends only on the length of
    its path through the voxel.

    **Arguments:**

    - `leaf`: (nx, ny, nz) extinction coefficient of leaf in 1/m for the projection function G = 1/2, that
      is half the leaf area density, 0 or more; or None: no leaf.
    - `bark`: (nx, ny, nz) extinction coefficient of bark in 1/m, 0 or more, the same in all directions, as of
      spherically oriented facets; or None: no bark.
    - `voxel_size`: (3,) voxel edges in m, positive; or one number for cubes.
    - `origin`: (3,) lower south-west corner in m.
    - `leaf_angles`: distribution of leaf inclination, a `LeafAngles`, or None: spherical. Default None.
    - `crs`: coordinate reference system of `origin`, as that of `Terrain`. Default None: not known.

    **Raises:** ValueError for extinction that is negative or not finite, sizes that are not positive, leaf
    and bark of different shapes, an edge or origin that is neither one number nor three, and a map with
    neither leaf nor bark; TypeError for an object of the wrong type. Edges so far from those of any map that
    another unit is likely give a `UnitWarning`.

    **Example:**

    >>> import numpy as np, jaxlidar as jl
    >>> voxels = jl.VoxelMap.from_lad(np.full((4, 4, 10), 0.5), voxel_size=(1, 1, 2), origin=(-2, -2, 3))
    >>> print(voxels.shape, voxels.top.tolist(), f"{float(voxels.leaf[0, 0, 0]):.2f} per m")
    (4, 4, 10) [2.0, 2.0, 23.0] 0.25 per m
    """

    # The shapes are not part of the types: the constructor compares them, and its error names both.
    leaf: Float[Array, "..."] | None = quantity(unit="1/m", range=NOT_NEGATIVE, converter=as_optional_array)
    bark: Float[Array, "..."] | None = quantity(unit="1/m", range=NOT_NEGATIVE, converter=as_optional_array)
    voxel_size: Float[Array, "3"] = quantity(
        unit=Magnitude("m", 1e-4, 1e3, {"mm": 1e-3, "cm": 1e-2, "km": 1e3}),
        range=POSITIVE,
        converter=_as_triple,
    )
    origin: Float[Array | np.ndarray, "3"] = quantity(unit="m", converter=coordinates(3))
    leaf_angles: LeafAngles | None = None
    crs: str | None = eqx.field(static=True, converter=crs_name, default=None)
    # Voxels along x, y and z, where the tables have room for more: in programs that maps of several shapes
    # share (`trace.march.voxel_traversal.with_room`). None: all of the tables.
    _counts: Int[Array | np.ndarray, "3"] | None = None

    def __str__(self) -> str:
        return object_text(self)

    def __check_init__(self):
        check_kind("leaf_angles", self.leaf_angles, LeafAngles | None, "a LeafAngles or None")
        if self.leaf is None and self.bark is None:
            raise ValueError("leaf and bark are both None; a voxel map holds at least one of them")
        shapes = {a.shape for a in (self.leaf, self.bark) if a is not None}
        if len(shapes) > 1:
            raise ValueError(f"leaf and bark have the shapes {sorted(shapes)}; they must agree")
        (shape,) = shapes
        if len(shape) != 3 or 0 in shape:
            raise ValueError(
                f"leaf or bark has the shape {shape}; admissible is (nx, ny, nz), each at least 1"
            )
        check_ranges(self)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of voxels along x, y and z."""
        extinction = self.leaf if self.leaf is not None else self.bark
        assert extinction is not None
        nx, ny, nz = extinction.shape
        return nx, ny, nz

    @property
    def counts(self) -> Int[Array | np.ndarray, "3"]:
        """(3,) numbers of voxels along x, y and z: `shape` as an array, which programs trace."""
        return np.array(self.shape) if self._counts is None else self._counts

    @property
    def top(self) -> Float[Array, "3"]:
        """(3,) upper north-east corner in m."""
        return jnp.asarray(self.origin + self.voxel_size * self.counts.astype(float))

    @staticmethod
    def from_extinction(
        leaf: Numbers | None = None,
        bark: Numbers | None = None,
        *,
        voxel_size: Numbers,
        origin: Numbers = (0.0, 0.0, 0.0),
    ) -> "VoxelMap":
        """Make a voxel map of extinction coefficients that are the same in every direction.

        **Arguments:**

        - `leaf`, `bark`: (nx, ny, nz) extinction coefficients in 1/m, 0 or more, or None. Default None.
        - `voxel_size`: (3,) voxel edges in m, positive; or one number for cubes.
        - `origin`: (3,) lower south-west corner in m. Default (0, 0, 0).

        **Returns:** a `VoxelMap`.

        **Raises:** ValueError for arguments that `VoxelMap` does not admit.
        """
        return VoxelMap(leaf, bark, voxel_size, origin)

    @staticmethod
    def from_probability(
        leaf: Numbers | None = None,
        bark: Numbers | None = None,
        *,
        voxel_size: Numbers,
        origin: Numbers = (0.0, 0.0, 0.0),
    ) -> "VoxelMap":
        """Make a voxel map of the probabilities p that a ray that crosses one voxel edge meets leaf, or bark.

        The extinction coefficient is -log1p(-p)/edge. Where voxels are not cubes, the edge is the vertical
        one. A solid trunk, p = 1, is admissible: it has an optical depth of 40 per edge, and its derivative
        with respect to p is zero.

        **Arguments:**

        - `leaf`, `bark`: (nx, ny, nz) probabilities in [0, 1], or None. Default None.
        - `voxel_size`: (3,) voxel edges in m, positive; or one number for cubes.
        - `origin`: (3,) lower south-west corner in m. Default (0, 0, 0).

        **Returns:** a `VoxelMap`.

        **Raises:** ValueError for a probability outside [0, 1], and for arguments that `VoxelMap` does not
        admit.
        """
        size = _as_triple(voxel_size)
        check_range("voxel_size", size, 0.0, low_open=True)

        def extinction(name: str, p: Numbers | None) -> Array | None:
            if p is None:
                return None
            check_range(name, p, 0.0, 1.0)
            return _extinction_of_probability(as_array(p, name), size[2])

        return VoxelMap(extinction("leaf", leaf), extinction("bark", bark), size, origin)

    @staticmethod
    def from_lad(
        lad: Numbers,
        *,
        voxel_size: Numbers,
        origin: Numbers = (0.0, 0.0, 0.0),
        leaf_angles: str | LeafAngles = "spherical",
        bark: Numbers | None = None,
    ) -> "VoxelMap":
        """Make a voxel map of leaf area density (LAD); the extinction coefficient is G(direction) * LAD.

        **Arguments:**

        - `lad`: (nx, ny, nz) one-sided leaf area density in m2/m3, 0 or more.
        - `voxel_size`: (3,) voxel edges in m, positive; or one number for cubes.
        - `origin`: (3,) lower south-west corner in m. Default (0, 0, 0).
        - `leaf_angles`: "spherical", "planophile", "erectophile", "plagiophile", "extremophile", "uniform",
          or a `LeafAngles`. Default "spherical".
        - `bark`: (nx, ny, nz) extinction coefficient of bark in 1/m, 0 or more, or None. Default None.

        **Returns:** a `VoxelMap`.

        **Raises:** ValueError for a negative density, an unknown name, and arguments that `VoxelMap` does not
        admit.
        """
        check_range("lad", lad, 0.0)
        check_kind("leaf_angles", leaf_angles, str | LeafAngles, "a name or a LeafAngles")
        angles = LeafAngles.named(leaf_angles) if isinstance(leaf_angles, str) else leaf_angles
        spherical = isinstance(leaf_angles, str) and leaf_angles == "spherical"
        # By NumPy where values are known: JAX would compile a program for every shape.
        density = concrete(lad)
        leaf = 0.5 * (as_array(lad, "lad") if density is None else density)
        return VoxelMap(leaf, bark, voxel_size, origin, None if spherical else angles)

    def trimmed(self) -> "VoxelMap":
        """Trim the empty layers at the sides. One voxel remains if all are empty.

        **Returns:** a `VoxelMap` of the same voxels, smaller, with `origin` moved to its new corner.

        **Example:**

        >>> import numpy as np, jaxlidar as jl
        >>> density = np.zeros((6, 6, 6))
        >>> density[2:4, 1:4, 3] = 1.0
        >>> smaller = jl.VoxelMap.from_lad(density, voxel_size=0.5).trimmed()
        >>> print(smaller.shape, smaller.origin.tolist())
        (2, 3, 1) [1.0, 0.5, 1.5]
        """
        is_occupied = self.mean_extinction() > 0
        if not is_occupied.any():
            is_occupied[0, 0, 0] = True
        (occupied,) = scipy.ndimage.find_objects(is_occupied.astype(np.int8))
        first = [layers.start for layers in occupied]
        return VoxelMap(
            None if self.leaf is None else self.leaf[occupied],
            None if self.bark is None else self.bark[occupied],
            self.voxel_size,
            np.asarray(self.origin, float) + np.asarray(self.voxel_size, float) * first,
            self.leaf_angles,
            self.crs,
        )

    def above(self, terrain: Terrain) -> "VoxelMap":
        """Lift the map onto a terrain, if its z is height above the ground.

        Every column is lifted by the mean height of the terrain below it. The extinction of a voxel is
        divided between the two voxels in which it then lies, so that the optical depth of each column does
        not change. On a slope, the lowest voxels of a column lie partly in the ground.

        **Arguments:**

        - `terrain`: a `Terrain` below all columns; its heights must be concrete.

        **Returns:** a `VoxelMap` with more layers, as many as the terrain rises by.

        **Raises:** ValueError for a map that lies partly off the terrain, or has another `crs`, and within a
        JAX transformation; TypeError where `terrain` is not a `Terrain`.

        **Example:**

        >>> import numpy as np, jaxlidar as jl
        >>> hill = jl.Terrain([[10.0, 10.0], [14.0, 14.0]], spacing=4.0)
        >>> trees = jl.VoxelMap.from_lad(np.ones((2, 2, 3)), voxel_size=2.0).above(hill)
        >>> print(trees.shape, trees.origin.tolist(), trees.leaf[:, 0].tolist())
        (2, 2, 5) [0.0, 0.0, 10.0] [[0.25, 0.5, 0.5, 0.25, 0.0], [0.0, 0.25, 0.5, 0.5, 0.25]]
        """
        check_kind("terrain", terrain, Terrain, "a Terrain")
        crs = common_system({"voxels": self.crs, "terrain": terrain.crs})
        size, origin, heights = (concrete(a) for a in (self.voxel_size, self.origin, terrain.heights))
        if size is None or origin is None or heights is None:
            raise ValueError("a JAX transformation is tracing the map or the terrain: lift the map outside")
        # 1. Mean height of the terrain below each column, at 3 x 3 points, in units of layers.
        (nx, ny, nz), in_voxel = self.shape, (np.arange(3) + 0.5) / 3
        x, y = (o + d * np.add.outer(np.arange(n), in_voxel) for o, d, n in zip(origin, size, (nx, ny)))
        points = np.broadcast_arrays(x[:, :, None, None], y[None, None])
        lift = np.asarray(terrain.height_at(*points), float).mean(axis=(1, 3)) / size[2]
        # 2. Split it into whole layers and a fraction, counted from the lowest column.
        base = np.floor(lift.min())
        whole_layers = np.floor(lift - base).astype(int)
        fraction = as_array(lift - base - whole_layers)[:, :, None]
        more_layers = int(np.ceil((lift - base).max()))
        # 3. Layer k of the lifted map takes from the layers k - whole_layers and k - whole_layers - 1 of the
        #    map, which is padded with empty layers.
        source = np.arange(nz + more_layers) - whole_layers[:, :, None] + more_layers + 1

        def lifted(k: Float[Array, "nx ny nz"] | None) -> Float[Array, "nx ny _"] | None:
            if k is None:
                return None
            k = jnp.pad(k, ((0, 0), (0, 0), (more_layers + 1, more_layers)))
            upper, lower = (jnp.take_along_axis(k, jnp.asarray(s), axis=2) for s in (source, source - 1))
            return (1.0 - fraction) * upper + fraction * lower

        corner = origin + np.array([0.0, 0.0, base * size[2]])
        leaf, bark, angles = lifted(self.leaf), lifted(self.bark), self.leaf_angles
        return VoxelMap(leaf, bark, self.voxel_size, corner, angles, crs)

    @staticmethod
    def join(
        maps: "Sequence[VoxelMap]", voxel_size: Numbers | None = None, *, azimuth: Numbers = 0.0
    ) -> "VoxelMap":
        """Join maps of different places, voxel sizes and turns into one, by resampling.

        Extinction times volume is what is divided among voxels, so that the leaf and bark areas of all maps
        are conserved; where maps overlap, areas add up. A map that is not turned is divided by the volumes
        that voxels share: one with the same voxels in the same places stays as it is. A turned one is divided
        by points, 8 or more along the horizontal edges of its voxels and of those of the result. Wood that
        fills a voxel, with a probability of one, is spread like leaves: where it must stop light, join maps
        of the same voxels.

        **Arguments:**

        - `maps`: one `VoxelMap` or more, with equal `leaf_angles`.
        - `voxel_size`: (3,) voxel edges in m, positive, or one number for cubes. Default None: the smallest
          edges of the maps along each axis.
        - `azimuth`: degrees by which a map is turned clockwise, seen from above, about its south-west corner,
          such as those of a rotated .vox file: one number, or one for each map. Default 0.

        **Returns:** a `VoxelMap` that encloses all of them.

        **Raises:** ValueError for no map, sizes and azimuths outside their ranges, leaf angles or a `crs`
        that differ, more voxels than memory has room for, and within a JAX transformation; TypeError for
        objects of another kind.

        **Example:** two plots of 4 m2, the second of them turned.

        >>> import numpy as np, jaxlidar as jl
        >>> near = jl.VoxelMap.from_lad(np.full((2, 2, 1), 1.5), voxel_size=1.0)
        >>> far = jl.VoxelMap.from_lad(np.full((4, 4, 2), 1.5), voxel_size=0.5, origin=(4.0, 1.0, 0.0))
        >>> both = jl.VoxelMap.join([near, far], voxel_size=1.0, azimuth=(0.0, 30.0))
        >>> print(both.shape, f"{float(2 * both.leaf.sum()):.1f} m2, of {1.5 * (4 + 4):.1f}")
        (7, 3, 1) 12.0 m2, of 12.0
        """
        check_kind("maps", maps, Sequence, "several VoxelMap, as in [voxels, other]")
        for voxels in maps:
            check_kind("one of maps", voxels, VoxelMap, "a VoxelMap")
        if not len(maps):
            raise ValueError("maps is empty; admissible is one VoxelMap or more")
        if has_tracers(list(maps)):
            raise ValueError("a JAX transformation is tracing a map: join maps outside")
        for number, voxels in enumerate(maps):
            if not eqx.tree_equal(voxels.leaf_angles, maps[0].leaf_angles):
                raise ValueError(
                    f"maps[{number}].leaf_angles differ from those of maps[0]; admissible are equal"
                )
        crs = common_system({f"maps[{number}]": voxels.crs for number, voxels in enumerate(maps)})
        turns = checked_array("azimuth", azimuth, (len(maps),), one_for_all=True)
        sizes = np.array([concrete_array(voxels.voxel_size) for voxels in maps], float)
        size = sizes.min(axis=0)
        if voxel_size is not None:
            size = np.asarray(_as_triple(voxel_size), float)
            check_range("voxel_size", size, 0.0, low_open=True)
        places = [_Place.of(voxels, float(turn)) for voxels, turn in zip(maps, turns)]
        # Faces lie at multiples of the edges from the corner of the first map.
        first, low = places[0].origin, np.min([place.low for place in places], axis=0)
        high = np.max([place.high for place in places], axis=0)
        steps = np.floor((low - first) / size + _FACE_TOLERANCE)
        shape = np.maximum(np.ceil((high - first) / size - _FACE_TOLERANCE) - steps, 1).astype(int)
        n_voxels, most = float(shape.prod(dtype=float)), machine_memory() / _BYTES_PER_VOXEL
        if n_voxels > most:
            raise ValueError(
                f"maps lie within {(high - low).tolist()} m, which are {n_voxels:.3g} voxels of "
                f"{size.tolist()} m; admissible are at most {most:.3g} on this machine: are their "
                "coordinates those of one map?"
            )
        origin = first + steps * size
        extinction = {}
        for name in ("leaf", "bark"):
            values = [(place, getattr(voxels, name)) for place, voxels in zip(places, maps)]
            total = [
                place.resampled(concrete_array(k), origin, size, tuple(shape.tolist()))
                for place, k in values
                if k is not None
            ]
            extinction[name] = np.sum(total, axis=0) if total else None
        return VoxelMap(
            **extinction, voxel_size=size, origin=origin, leaf_angles=maps[0].leaf_angles, crs=crs
        )

    def mean_extinction(self) -> Float[np.ndarray, "nx ny nz"]:
        """Sum the extinction coefficients of leaf (at G = 1/2) and bark.

        **Returns:** (nx, ny, nz) NumPy array in 1/m.
        """
        return np.sum([np.asarray(a) for a in (self.leaf, self.bark) if a is not None], axis=0)


class _Place(NamedTuple):
    """Where the voxels of a map lie: its corner and edges, m, its shape, and its turn, degrees clockwise.

    `low`, `high`: corners of the box around it, m.
    """

    origin: Float[np.ndarray, "3"]
    size: Float[np.ndarray, "3"]
    shape: tuple[int, int, int]
    turn: float
    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]

    @staticmethod
    def of(voxels: VoxelMap, turn: float) -> "_Place":
        origin, size = (np.asarray(concrete_array(a), float) for a in (voxels.origin, voxels.voxel_size))
        end = size * voxels.shape
        corners = np.array([[0.0, 0.0], [end[0], 0.0], [0.0, end[1]], end[:2]])
        turned = _turned(corners, turn)
        low, high = (np.append(f(turned, axis=0), z) for f, z in ((np.min, 0.0), (np.max, end[2])))
        return _Place(origin, size, voxels.shape, turn, origin + low, origin + high)

    def resampled(
        self,
        extinction: Float[np.ndarray, "nx ny nz"],
        origin: Float[np.ndarray, "3"],
        size: Float[np.ndarray, "3"],
        shape: tuple[int, int, int],
    ) -> Float[np.ndarray, "mx my mz"]:
        """Return extinction coefficients, 1/m, on another grid with the same integral over space."""
        nx, ny, nz = self.shape
        faces = [o + d * np.arange(n + 1) for o, d, n in zip(self.origin, self.size, self.shape)]
        layers = _shares(faces[2], origin[2], size[2], shape[2])
        if self.turn % 360.0 == 0.0:
            columns = scipy.sparse.kron(*(_shares(faces[k], origin[k], size[k], shape[k]) for k in range(2)))
        else:
            columns = self._turned_shares(origin[:2], size[:2], shape[:2])
        amount = extinction.reshape(nx * ny, nz).astype(float) * self.size.prod()
        amount = columns.tocsr() @ (layers.tocsr() @ amount.T).T
        return amount.reshape(shape) / size.prod()

    def _turned_shares(
        self, origin: Float[np.ndarray, "2"], size: Float[np.ndarray, "2"], shape: tuple[int, int]
    ) -> "scipy.sparse.csr_array":
        """Return the share of each column of turned voxels in each column of another grid, by points."""
        nx, ny, _ = self.shape
        # As many along an edge as leave no column of the other grid without a point.
        counts = np.ceil(_POINTS * np.maximum(self.size[:2] / size.min(), 1.0)).astype(int).tolist()
        x, y = (d / c * (np.arange(n * c) + 0.5) for d, c, n in zip(self.size, counts, (nx, ny)))
        column_of_y = np.arange(len(y)) // counts[1]
        shares = scipy.sparse.csr_array((shape[0] * shape[1], nx * ny))
        rows = -(-_POINTS_AT_ONCE // len(y))
        for first in range(0, len(x), rows):
            row = np.arange(first, min(first + rows, len(x)))
            places = np.stack(np.meshgrid(x[row], y, indexing="ij"), axis=-1).reshape(-1, 2)
            places = self.origin[:2] + _turned(places, self.turn)
            # Rounding may put a point at a face just outside.
            target = np.floor((places - origin) / size).astype(int)
            i, j = np.clip(target, 0, np.array(shape) - 1).T
            source = np.add.outer(row // counts[0] * ny, column_of_y).ravel()
            weights = np.full(len(source), 1.0 / (counts[0] * counts[1]))
            shares += scipy.sparse.coo_array((weights, (i * shape[1] + j, source)), shares.shape).tocsr()
        return shares


def _turned(points: Float[np.ndarray, "n 2"], azimuth: float) -> Float[np.ndarray, "n 2"]:
    """Turn horizontal positions clockwise about the origin, by degrees."""
    cosine, sine = np.cos(np.deg2rad(azimuth)), np.sin(np.deg2rad(azimuth))
    return points @ np.array([[cosine, -sine], [sine, cosine]])


def _shares(
    faces: Float[np.ndarray, " n"], origin: float, size: float, count: int
) -> "scipy.sparse.coo_array":
    """Return the share of each interval between faces that lies in each of `count` cells of a size."""
    lowest = np.floor((faces[:-1] - origin) / size + _FACE_TOLERANCE).astype(int)
    most = int(np.ceil((faces[1] - faces[0]) / size)) + 1
    cells = lowest[:, None] + np.arange(most)
    overlap = np.minimum(faces[1:, None], origin + size * (cells + 1)) - np.maximum(
        faces[:-1, None], origin + size * cells
    )
    share = np.maximum(overlap / np.diff(faces)[:, None], 0.0)
    share[share < _FACE_TOLERANCE] = 0.0
    share /= share.sum(axis=1, keepdims=True)
    number, k = np.nonzero(share)
    return scipy.sparse.coo_array((share[number, k], (cells[number, k], number)), (count, len(faces) - 1))


@jax.jit
def _extinction_of_probability(
    p: Float[Array, "nx ny nz"], edge: Float[Array, ""]
) -> Float[Array, "nx ny nz"]:
    """Return the extinction coefficient in 1/m of voxels that a ray along an edge in m meets with `p`."""
    is_open = p < 1.0
    # The inner `where` keeps log(0), whose derivative is infinite, out of the solid voxels.
    depth = jnp.where(is_open, -jnp.log1p(-jnp.where(is_open, p, 0.0)), SOLID_OPTICAL_DEPTH)
    return depth / edge
