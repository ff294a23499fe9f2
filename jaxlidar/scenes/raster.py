"""Rasters: values at the nodes of a regular horizontal grid, bilinear in between.

A point (x, y) has the grid coordinates (x - x0) / dx and (y - y0) / dy, with the spacing (dx, dy) and one
node, the origin node, at (x0, y0). Within a cell, X and Y run from 0 to 1. With the values h00, h10, h01 and
h11 at its south-west, south-east, north-west and north-east nodes,

    h = h00 + (h10 - h00) X + (h01 - h00) Y + (h11 - h10 - h01 + h00) X Y.
"""

from typing import final

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxlidar._vectors import Scalar, Vec

# Numbers of a cell along x and y.
Cell = tuple[Int[Array, "..."], Int[Array, "..."]]


@final
class Raster(eqx.Module):
    """Values at nodes, x along the first axis and y along the second, bilinear within each cell.

    - `values`: (nx, ny) at the nodes.
    - `spacing`: (2,) distance between nodes along x and y, m.
    - `origin`: (2,) position of the origin node, m. Grid coordinates are relative to it, and keep their
      digits where it is near.
    - `origin_node`: (2,) indices of the origin node in `values`. Cells are numbered from it.
    - `periodic`: True if the nodes repeat without end, node nx being node 0 again. Otherwise the cells at the
      edge extend beyond it.
    """

    values: Float[Array, "nx ny"]
    spacing: Float[Array, "2"]
    origin: Float[Array, "2"]
    origin_node: Int[Array, "2"]
    periodic: bool = eqx.field(static=True)

    @staticmethod
    def of(
        values: Float[Array, "nx ny"],
        spacing: Float[Array, "2"],
        origin: Float[Array, "2"],
        periodic: bool,
    ) -> "Raster":
        """Make the raster whose south-west node is at `origin`."""
        return Raster(values, spacing, origin, jnp.zeros(2, jnp.int32), periodic)

    @property
    def cells(self) -> tuple[int, int]:
        """Numbers of cells along x and y."""
        nx, ny = self.values.shape
        return (nx, ny) if self.periodic else (nx - 1, ny - 1)

    def moved(self, by: Float[Array, "2"]) -> "Raster":
        """Move the raster by (2,) m, and make the node that is then nearest to x = y = 0 its origin node.

        Scenes are moved so that the beam's aim is at zero. Grid coordinates then are small where rays are,
        which single precision needs.
        """
        origin = self.origin + by
        steps = jnp.round(lax.stop_gradient(-origin / self.spacing))
        if not self.periodic:
            last_node = jnp.asarray(self.values.shape, jnp.int32) - 1
            first, last = ((n - self.origin_node).astype(steps.dtype) for n in (0, last_node))
            steps = jnp.clip(steps, first, last)
        origin_node = self.origin_node + steps.astype(jnp.int32)
        return Raster(self.values, self.spacing, origin + steps * self.spacing, origin_node, self.periodic)

    @property
    def bounds(self) -> tuple[tuple[Scalar, Scalar], tuple[Scalar, Scalar]]:
        """Grid coordinates of the edges along x, and along y."""
        (nx, ny), (i, j) = self.cells, self.origin_node.astype(self.origin.dtype)
        return (-i, nx - i), (-j, ny - j)

    def grid_coordinates(self, p: Vec | tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        """Compute the horizontal positions of points in units of cells, from the origin node."""
        x, y = ((p[k] - self.origin[k]) / self.spacing[k] for k in range(2))
        return x, y

    def cell_at(self, position: tuple[Scalar, Scalar]) -> Cell:
        """Find the cell at grid coordinates, or the nearest one where they lie beyond the edge."""
        numbers = []
        for k, (low, high) in enumerate(self.bounds):
            number = jnp.floor(lax.stop_gradient(position[k]))
            numbers.append((number if self.periodic else jnp.clip(number, low, high - 1)).astype(jnp.int32))
        return numbers[0], numbers[1]

    def bilinear_coefficients(self, cell: Cell) -> tuple[Scalar, Scalar, Scalar, Scalar]:
        """Return the coefficients of 1, X, Y and X Y within a cell; X and Y run from 0 to 1."""
        nx, ny = self.values.shape
        i, j = (number + origin for number, origin in zip(cell, self.origin_node))
        i_next, j_next = i + 1, j + 1
        if self.periodic:
            i, j, i_next, j_next = i % nx, j % ny, i_next % nx, j_next % ny
        flat_values = self.values.reshape(-1)
        # All indices lie within the raster, so that no check of bounds is needed.
        h00, h10, h01, h11 = (
            flat_values.at[index].get(mode="promise_in_bounds")
            for index in (i * ny + j, i_next * ny + j, i * ny + j_next, i_next * ny + j_next)
        )
        return h00, h10 - h00, h01 - h00, h11 - h10 - h01 + h00

    def value(self, p: Vec | tuple[Scalar, Scalar]) -> Scalar:
        """Interpolate the value at points."""
        return self.value_and_slope(p)[0]

    def value_and_slope(self, p: Vec | tuple[Scalar, Scalar]) -> tuple[Scalar, tuple[Scalar, Scalar]]:
        """Interpolate the value at points, and its derivatives with respect to x and y, per m."""
        position = self.grid_coordinates(p)
        cell = self.cell_at(position)
        c0, cx, cy, cxy = self.bilinear_coefficients(cell)
        x, y = (p - number.astype(p.dtype) for p, number in zip(position, cell))
        slope = ((cx + cxy * y) / self.spacing[0], (cy + cxy * x) / self.spacing[1])
        return c0 + cx * x + (cy + cxy * x) * y, slope
