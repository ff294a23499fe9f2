"""The regular grid on which trees and points are shared out."""

import numpy as np

from jaxlidar._checks import check_integer, check_range, check_shape


class Grid:
    """A regular voxel grid in double precision."""

    def __init__(self, low: np.ndarray, size: np.ndarray, shape: tuple[int, ...]):
        self.low, self.size, self.shape = low, size, shape

    @staticmethod
    def of(low, high, size, origin, shape) -> "Grid":
        """The given grid, or the smallest one around the box from `low` to `high`."""
        if (origin is None) != (shape is None):
            raise ValueError("origin and shape belong together: give both or neither")
        if origin is None:
            first = np.floor(low / size + 1e-9)
            count = np.maximum(np.ceil(high / size - 1e-9) - first, 1)
            return Grid(first * size, size, tuple(int(n) for n in count))
        check_range("origin", origin)
        check_shape("origin", origin, (3,))
        check_range("shape", shape, 1)
        check_shape("shape", shape, (3,))
        grid = Grid(np.asarray(origin, float), size, tuple(check_integer("shape", n) for n in shape))
        top = grid.low + size * grid.shape
        if np.any(low < grid.low - 1e-9 * size) or np.any(high > top + 1e-9 * size):
            asked = f"origin = {tuple(grid.low.tolist())} and shape = {grid.shape}"
            reach = f"from {np.round(low, 3).tolist()} to {np.round(high, 3).tolist()} m"
            raise ValueError(f"{asked}: what is to be voxelised reaches {reach}, out of the grid")
        return grid

    def empty(self) -> np.ndarray:
        """Zeros, one for each voxel."""
        return np.zeros(self.shape)

    def within_a_voxel(self, centre: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Which spheres lie within one voxel."""
        low, high = (np.floor((centre + s * radius[:, None] - self.low) / self.size) for s in (-1.0, 1.0))
        return np.all(low == high, axis=1)

    def count(self, place: np.ndarray, amount: np.ndarray, into: np.ndarray) -> None:
        """Add amounts at positions to an array of the grid. Positions outside count in the nearest voxel."""
        number = np.floor((place - self.low) / self.size).astype(np.int64)
        number = np.clip(number, 0, np.array(self.shape) - 1)
        flat = np.ravel_multi_index(tuple(number.T), self.shape)
        into += np.bincount(flat, amount, into.size).reshape(self.shape)


def edges(voxel_size: float | tuple[float, float, float]) -> np.ndarray:
    """The edges of a voxel along x, y and z, of one number or three. **Raises:** as `jaxlidar.voxelise`."""
    check_range("voxel_size", voxel_size, 0.0, low_open=True)
    check_shape("voxel_size", voxel_size, (), (3,))
    return np.broadcast_to(np.asarray(voxel_size, float), (3,)).copy()
