"""Scores: relative derivatives of the weights of paths by what changes extinction alone.

Where only extinction moves, paths stay where they are. The weight of a path is a product of extinction
coefficients k, where it collided, and of exp(-integral of k), so that its relative derivative, its score, is

    sum over collisions of dk / k  -  integral of dk along all that was flown, and along the way back.

Scores are numbers like the weights themselves, one for each column of a Jacobian. No derivative is pushed
through the march, which would move positions, directions and times along.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._one_function import once


class Scores(eqx.Module):
    """Derivatives of extinction by the columns of a Jacobian, laid out like the voxels of a `Medium`.

    A voxel is moved by few columns: it has their numbers, and the slopes of its extinction in them.

    - `leaf`, `bark`: slopes, 1/m per unit of the column; for leaf as `Medium.leaf`, before leaf angles.
    - `number`: the column of each slope; None where a voxel has slopes in all columns.
    - `column`: slope of the optical depth straight up above each voxel's upper face, for a beam at nadir.
    - `left`: what the optics of every history leave, at the values at which derivatives are taken.
    - `count`: of columns.
    """

    leaf: Float[Array, "most cells"] | None
    bark: Float[Array, "most cells"] | None
    number: Int[Array, "most cells"] | None
    column: Float[Array, "cells columns"] | None
    left: Float[Array, "histories wavelengths"]
    count: int = eqx.field(static=True)

    @property
    def most(self) -> int:
        """The most columns that one voxel is moved by."""
        table = self.leaf if self.leaf is not None else self.bark
        assert table is not None
        return table.shape[0]

    def slopes(
        self, cell: Int[Array, "*s"], leaf_share: Float[Array, "*s"] | None = None
    ) -> list[Float[Array, "*s"]]:
        """Slopes of the extinction of leaf and bark at voxels.

        `leaf_share`: extinction per unit of `Medium.leaf` in the direction of flight; None for one.
        """
        bark = [] if self.bark is None else _at(self.bark, cell, None)
        if self.leaf is None:
            return bark
        leaf = _at(self.leaf, cell, leaf_share)
        return [a + b for a, b in zip(leaf, bark)] if bark else leaf

    def alone(self, is_leaf: bool) -> "Scores | None":
        """The scores of leaf, or of bark, alone; None where it is not moved."""
        kept = self.leaf if is_leaf else self.bark
        if kept is None:
            return None
        return dataclasses.replace(self, bark=None) if is_leaf else dataclasses.replace(self, leaf=None)

    def columns_of(self, cell: Int[Array, "*s"]) -> list[Int[Array, "*s"]]:
        """The columns of the slopes of voxels; empty where these are all columns in turn."""
        if self.number is None:
            return []
        return [row.at[cell].get(mode="promise_in_bounds") for row in self.number]

    def spread(
        self, columns: list[Int[Array, "*s"]], values: list[Float[Array, "*s"]], axis: int = 0
    ) -> Float[Array, "..."]:
        """Values of some columns among all of them, which become the axis `axis`."""
        if self.number is None:
            return jnp.stack(values, axis)
        shape = [1] * (values[0].ndim + 1)
        shape[axis] = self.count
        names = jnp.arange(self.count, dtype=jnp.int32).reshape(shape)
        pairs = ((jnp.expand_dims(a, axis), jnp.expand_dims(b, axis)) for a, b in zip(columns, values))
        first, *rest = (jnp.where(own == names, value, 0.0) for own, value in pairs)
        for more in rest:
            first = first + more
        return first

    def add(
        self,
        moved: Float[Array, "ends columns photons"],
        cell: Int[Array, "photons"],
        length: Float[Array, "ends photons"],
        leaf_share: Float[Array, "photons"] | None,
    ) -> Float[Array, "ends columns photons"]:
        """Derivatives of optical depths after one more step, of which `length` lies before each end."""
        slopes, columns = self.slopes(cell, leaf_share), self.columns_of(cell)
        slopes, length = once((slopes, length))
        if self.number is None:
            return moved + jnp.stack(slopes)[None] * length[:, None]
        names = jnp.arange(self.count, dtype=jnp.int32)[None, :, None]
        for own, slope in zip(columns, slopes):
            more = (slope[None] * length)[:, None]
            moved = moved + jnp.where(own[None, None] == names, more, 0.0)
        return moved

    def gains(
        self,
        cell: Int[Array, "*s"],
        leaf: tuple[Bool[Array, "*s"], Float[Array, "cells"]] | None,
        bark: tuple[Bool[Array, "*s"], Float[Array, "cells"]] | None,
    ) -> Float[Array, "*s columns"]:
        """Relative derivatives of the extinction that made photons collide; zero where there is none.

        `leaf`, `bark`: whether they collided with it, and its extinction.
        """
        values = [jnp.zeros(cell.shape, self.left.dtype)] * self.most
        for table, given in ((self.leaf, leaf), (self.bark, bark)):
            if table is None or given is None:
                continue
            there, extinction = given
            k = extinction.at[cell].get(mode="promise_in_bounds")
            there = there & (k > 0)
            inverse = jnp.where(there, 1.0 / jnp.where(there, k, 1.0), 0.0)
            values = [v + slope * inverse for v, slope in zip(values, _at(table, cell, None))]
        return self.spread(self.columns_of(cell), values, axis=-1)


def _at(
    table: Float[Array, "most cells"], cell: Int[Array, "*s"], share: Float[Array, "*s"] | None
) -> list[Float[Array, "*s"]]:
    found = [row.at[cell].get(mode="promise_in_bounds") for row in table]
    return found if share is None else [slope * share for slope in found]


def packed(
    leaf: Float[Array, "columns cells"] | None, bark: Float[Array, "columns cells"] | None, most: int
) -> tuple[Array | None, Array | None, Array | None]:
    """Slopes of leaf and bark in the `most` columns that move each voxel, and the numbers of these.

    NaN where a voxel is moved by more of them.
    """
    tables = [table for table in (leaf, bark) if table is not None]
    moved = jnp.any(jnp.stack(tables) != 0, axis=0)
    count = len(moved)
    if most >= count:
        return leaf, bark, None
    numbers, names = [], jnp.arange(count, dtype=jnp.int32)[:, None]
    for _ in range(most):
        number = jnp.argmax(moved, axis=0).astype(jnp.int32)
        numbers.append(number)
        moved = moved & (names != number[None])
    number, over = jnp.stack(numbers), jnp.any(moved, axis=0)

    def chosen(table: Array | None) -> Array | None:
        if table is None:
            return None
        own = jnp.take_along_axis(table, number, axis=0)
        # One slope of several of the same column is enough.
        again = jnp.stack([jnp.any(number[:i] == number[i][None], axis=0) for i in range(most)])
        return jnp.where(over[None], jnp.nan, jnp.where(again, 0.0, own))

    return chosen(leaf), chosen(bark), number


def rows_of(
    kernel: Float[Array, "rows bins"], inner: Float[Array, "rows columns"]
) -> Float[Array, "rows bins columns"]:
    """Rows of bins, each with all columns."""
    # Fused into the rows, it would be computed again for each of their bins.
    return kernel[:, :, None] * once(inner)[:, None, :]
