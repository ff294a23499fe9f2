"""Rasters: values at the nodes of a regular horizontal grid, bilinear in between."""

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
    - `spacing`: (2,) between nodes, m.
    - `origin`: (2,) place of one of the nodes, m. Places are told from there: where that node is near, they
      keep their digits.
    - `number`: (2,) which node that is. Cells are numbered from there, too.
    - `periodic`: whether the nodes repeat without end, node nx being node 0 again. Otherwise what lies beyond
      the edge is the continuation of the cell at the edge.
    """

    values: Float[Array, "nx ny"]
    spacing: Float[Array, "2"]
    origin: Float[Array, "2"]
    number: Int[Array, "2"]
    periodic: bool = eqx.field(static=True)

    @staticmethod
    def of(
        values: Float[Array, "nx ny"],
        spacing: Float[Array, "2"],
        origin: Float[Array, "2"],
        periodic: bool,
    ) -> "Raster":
        """The raster whose south-west node is at `origin`."""
        return Raster(values, spacing, origin, jnp.zeros(2, jnp.int32), periodic)

    @property
    def cells(self) -> tuple[int, int]:
        """Numbers of cells along x and y."""
        nx, ny = self.values.shape
        return (nx, ny) if self.periodic else (nx - 1, ny - 1)

    def moved(self, by: Float[Array, "2"]) -> "Raster":
        """The same raster, moved by (2,) m, and told from the node that is then nearest to x = y = 0."""
        origin = self.origin + by
        steps = jnp.round(lax.stop_gradient(-origin / self.spacing))
        if not self.periodic:
            last = jnp.asarray(self.values.shape) - 1
            steps = jnp.clip(steps, -self.number, last - self.number)
        number = self.number + steps.astype(jnp.int32)
        return Raster(self.values, self.spacing, origin + steps * self.spacing, number, self.periodic)

    @property
    def bounds(self) -> tuple[tuple[Scalar, Scalar], tuple[Scalar, Scalar]]:
        """The places of the edges along x, and along y, in units of cells."""
        (east, north), (i, j) = self.cells, self.number.astype(self.origin.dtype)
        return (-i, east - i), (-j, north - j)

    def place(self, p: Vec | tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        """Horizontal place of points in units of cells, from the node at `origin`."""
        x, y = ((p[k] - self.origin[k]) / self.spacing[k] for k in range(2))
        return x, y

    def cell(self, place: tuple[Scalar, Scalar]) -> Cell:
        """The cell of a place; the nearest one where the place lies beyond the edge."""
        numbers = []
        for k, (low, high) in enumerate(self.bounds):
            number = jnp.floor(lax.stop_gradient(place[k]))
            numbers.append((number if self.periodic else jnp.clip(number, low, high - 1)).astype(jnp.int32))
        return numbers[0], numbers[1]

    def corners(self, cell: Cell) -> tuple[Scalar, Scalar, Scalar, Scalar]:
        """Coefficients of 1, X, Y and X Y within a cell; X and Y run from 0 to 1."""
        nx, ny = self.values.shape
        i, j = (number + own for number, own in zip(cell, self.number))
        east, north = i + 1, j + 1
        if self.periodic:
            i, j, east, north = i % nx, j % ny, east % nx, north % ny
        flat = self.values.reshape(-1)
        here, right, up, across = (
            flat.at[number].get(mode="promise_in_bounds")
            for number in (i * ny + j, east * ny + j, i * ny + north, east * ny + north)
        )
        return here, right - here, up - here, across - right - up + here

    def value(self, p: Vec | tuple[Scalar, Scalar]) -> Scalar:
        """Value at points."""
        return self.with_slope(p)[0]

    def with_slope(self, p: Vec | tuple[Scalar, Scalar]) -> tuple[Scalar, tuple[Scalar, Scalar]]:
        """Value at points, and its derivatives with respect to x and y, per m."""
        place = self.place(p)
        cell = self.cell(place)
        one, a, b, c = self.corners(cell)
        x, y = (at - number for at, number in zip(place, cell))
        slope = ((a + c * y) / self.spacing[0], (b + c * x) / self.spacing[1])
        return one + a * x + (b + c * x) * y, slope
