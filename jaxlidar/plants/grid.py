"""The regular grid into which trees, meshes and points are voxelised."""

import numpy as np

from jaxlidar._fields.checks import check_integer, check_shape, checked_array

# Tolerance, in voxels, for coordinates that rounding has moved across a face of the grid.
_ROUNDING = 1e-9


class Grid:
    """A regular voxel grid in double precision.

    - `low`: (3,) lower corner, m.
    - `size`: (3,) edges of a voxel, m.
    - `shape`: numbers of voxels along x, y and z.
    """

    def __init__(self, low: np.ndarray, size: np.ndarray, shape: tuple[int, ...]):
        self.low, self.size, self.shape = low, size, shape

    @staticmethod
    def enclosing(low, high, size, origin, shape) -> "Grid":
        """Return the grid of `origin` and `shape`, or where both are None the smallest one around a box.

        The box reaches from `low` to `high`. Faces of the smallest grid lie at multiples of the voxel edges.

        **Raises:** ValueError as `jaxlidar.voxelise`.
        """
        if (origin is None) != (shape is None):
            raise ValueError("origin and shape belong together: give both or neither")
        if origin is None:
            first = np.floor(low / size + _ROUNDING)
            count = np.maximum(np.ceil(high / size - _ROUNDING) - first, 1)
            return Grid(first * size, size, tuple(int(n) for n in count))
        low_corner = checked_array("origin", origin, (3,))
        check_shape("shape", shape, (3,))
        grid = Grid(low_corner, size, tuple(check_integer("shape", n) for n in shape))
        top = grid.low + size * grid.shape
        if np.any(low < grid.low - _ROUNDING * size) or np.any(high > top + _ROUNDING * size):
            arguments = f"origin = {tuple(grid.low.tolist())} and shape = {grid.shape}"
            extent = f"from {np.round(low, 3).tolist()} to {np.round(high, 3).tolist()} m"
            raise ValueError(f"{arguments}: the geometry to voxelise reaches {extent}, out of the grid")
        return grid

    def zeros(self) -> np.ndarray:
        """Return an array of zeros, one for each voxel."""
        return np.zeros(self.shape)

    def contains_in_one_voxel(self, centre: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """(n,) booleans, true for each of n spheres that lies within one voxel."""
        low, high = (np.floor((centre + s * radius[:, None] - self.low) / self.size) for s in (-1.0, 1.0))
        return np.all(low == high, axis=1)

    def accumulate(self, position: np.ndarray, amount: np.ndarray, total: np.ndarray) -> None:
        """Add (n,) amounts at (n, 3) positions to the array `total` of the grid, in place.

        Positions outside of the grid, where rounding has put them there, count in the nearest voxel.
        """
        index = np.floor((position - self.low) / self.size).astype(np.int64)
        index = np.clip(index, 0, np.array(self.shape) - 1)
        flat = np.ravel_multi_index(tuple(index.T), self.shape)
        total += np.bincount(flat, amount, total.size).reshape(self.shape)


def voxel_edges(voxel_size: float | tuple[float, float, float]) -> np.ndarray:
    """The edges of a voxel along x, y and z, of one number or three. **Raises:** as `jaxlidar.voxelise`."""
    return checked_array("voxel_size", voxel_size, (3,), 0.0, one_for_all=True, low_open=True)
