"""Derivatives of the extinction of every voxel with respect to the columns of a Jacobian.

They are what the score functions of paths are made of (`jaxlidar.trace.score_functions`). A voxel is often
moved by few of the columns (a layer of a profile, say): it then stores the numbers of these, and a slope for
each.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._one_function import once


class ExtinctionSlopes(eqx.Module):
    """Derivatives d k / d theta_j of extinction by the columns j of a Jacobian, for each voxel.

    - `leaf`, `bark`: slopes, 1/m per unit of the column; for leaf as `Medium.leaf`, before leaf angles.
    - `column_number`: the column of each slope; None where a voxel has slopes in all columns.
    - `depth_above`: slope of the optical depth straight up from each voxel's upper face, for a beam at nadir.
    - `history_optics`: optical weight of every history, at the values at which derivatives are taken.
    - `count`: number of columns.
    """

    leaf: Float[Array, "slopes cells"] | None
    bark: Float[Array, "slopes cells"] | None
    column_number: Int[Array, "slopes cells"] | None
    depth_above: Float[Array, "cells columns"] | None
    history_optics: Float[Array, "histories wavelengths"]
    count: int = eqx.field(static=True)

    @property
    def slopes_per_voxel(self) -> int:
        """Largest number of columns that move one voxel."""
        table = self.leaf if self.leaf is not None else self.bark
        assert table is not None
        return table.shape[0]

    def slopes_at(
        self, cell: Int[Array, "*s"], leaf_factor: Float[Array, "*s"] | None = None
    ) -> list[Float[Array, "*s"]]:
        """Return the slopes of the extinction of leaf and bark together at voxels.

        `leaf_factor`: extinction per unit of `Medium.leaf` in the direction of flight; None for one.
        """
        bark = [] if self.bark is None else _gather_rows(self.bark, cell, None)
        if self.leaf is None:
            return bark
        leaf = _gather_rows(self.leaf, cell, leaf_factor)
        return [a + b for a, b in zip(leaf, bark)] if bark else leaf

    def of_material(self, is_leaf: bool) -> "ExtinctionSlopes | None":
        """Return the slopes of leaf, or of bark, alone; None where that material is not moved."""
        table = self.leaf if is_leaf else self.bark
        if table is None:
            return None
        return dataclasses.replace(self, bark=None) if is_leaf else dataclasses.replace(self, leaf=None)

    def columns_at(self, cell: Int[Array, "*s"]) -> list[Int[Array, "*s"]]:
        """Return the column numbers of the slopes of voxels; empty where these are all columns in turn."""
        # Profiles of few layers may move every voxel by every column: then no numbers are stored.
        if self.column_number is None:
            return []
        return [row.at[cell].get(mode="promise_in_bounds") for row in self.column_number]

    def to_columns(
        self, columns: list[Int[Array, "*s"]], values: list[Float[Array, "*s"]], axis: int = 0
    ) -> Float[Array, "..."]:
        """Put values that belong to the given columns among all columns, which become the axis `axis`."""
        if self.column_number is None:
            return jnp.stack(values, axis)
        shape = [1] * (values[0].ndim + 1)
        shape[axis] = self.count
        numbers = jnp.arange(self.count, dtype=jnp.int32).reshape(shape)
        pairs = ((jnp.expand_dims(a, axis), jnp.expand_dims(b, axis)) for a, b in zip(columns, values))
        # Comparisons in place of a scatter: columns are few, and comparisons are vectorised.
        total, *terms = (jnp.where(column == numbers, value, 0.0) for column, value in pairs)
        for term in terms:
            total = total + term
        return total

    def add_segment(
        self,
        depth_slopes: Float[Array, "ends columns photons"],
        cell: Int[Array, "photons"],
        length: Float[Array, "ends photons"],
        leaf_factor: Float[Array, "photons"] | None,
    ) -> Float[Array, "ends columns photons"]:
        """Add a segment to derivatives of optical depths; `length`, m, of it lies before each end."""
        slopes, columns = self.slopes_at(cell, leaf_factor), self.columns_at(cell)
        # Optimisation barrier: inside the march, fused slopes would be gathered again for every target.
        slopes, length = once((slopes, length))
        if self.column_number is None:
            return depth_slopes + jnp.stack(slopes)[None] * length[:, None]
        numbers = jnp.arange(self.count, dtype=jnp.int32)[None, :, None]
        for column, slope in zip(columns, slopes):
            term = (slope[None] * length)[:, None]
            depth_slopes = depth_slopes + jnp.where(column[None, None] == numbers, term, 0.0)
        return depth_slopes

    def log_extinction_slopes(
        self,
        cell: Int[Array, "*s"],
        leaf: tuple[Bool[Array, "*s"], Float[Array, "cells"]] | None,
        bark: tuple[Bool[Array, "*s"], Float[Array, "cells"]] | None,
    ) -> Float[Array, "*s columns"]:
        """Return (d k / d theta) / k of the material that photons collided with; zero where there was none.

        `leaf`, `bark`: whether photons collided with the material, and its extinction by voxel.
        """
        values = [jnp.zeros(cell.shape, self.history_optics.dtype)] * self.slopes_per_voxel
        for table, material in ((self.leaf, leaf), (self.bark, bark)):
            if table is None or material is None:
                continue
            collided, extinction = material
            k = extinction.at[cell].get(mode="promise_in_bounds")
            collided = collided & (k > 0)
            inverse = jnp.where(collided, 1.0 / jnp.where(collided, k, 1.0), 0.0)
            values = [v + slope * inverse for v, slope in zip(values, _gather_rows(table, cell, None))]
        return self.to_columns(self.columns_at(cell), values, axis=-1)


def _gather_rows(
    table: Float[Array, "slopes cells"], cell: Int[Array, "*s"], factor: Float[Array, "*s"] | None
) -> list[Float[Array, "*s"]]:
    rows = [row.at[cell].get(mode="promise_in_bounds") for row in table]
    return rows if factor is None else [slope * factor for slope in rows]


def pack_slopes(
    leaf: Float[Array, "columns cells"] | None, bark: Float[Array, "columns cells"] | None, per_voxel: int
) -> tuple[Array | None, Array | None, Array | None]:
    """Keep the slopes of leaf and bark in the at most `per_voxel` columns that move each voxel.

    **Returns:** both tables, (per_voxel, cells), and the column numbers of their rows; tables as they are and
    None where a voxel may be moved by all columns. Slopes are NaN where a voxel is moved by more columns than
    `per_voxel`.
    """
    tables = [table for table in (leaf, bark) if table is not None]
    is_moved = jnp.any(jnp.stack(tables) != 0, axis=0)
    count = len(is_moved)
    if per_voxel >= count:
        return leaf, bark, None
    selected, numbers = [], jnp.arange(count, dtype=jnp.int32)[:, None]
    for _ in range(per_voxel):
        # The lowest column that is left, voxel by voxel; all-False columns give 0.
        number = jnp.argmax(is_moved, axis=0).astype(jnp.int32)
        selected.append(number)
        is_moved = is_moved & (numbers != number[None])
    column_number, overflow = jnp.stack(selected), jnp.any(is_moved, axis=0)

    def pack(table: Array | None) -> Array | None:
        if table is None:
            return None
        slopes = jnp.take_along_axis(table, column_number, axis=0)
        # Where fewer columns move a voxel, column 0 stands in for the missing ones; its slope counts once.
        repeated = jnp.stack(
            [jnp.any(column_number[:i] == column_number[i][None], axis=0) for i in range(per_voxel)]
        )
        return jnp.where(overflow[None], jnp.nan, jnp.where(repeated, 0.0, slopes))

    return pack(leaf), pack(bark), column_number


def outer_rows(
    kernel: Float[Array, "rows bins"], slopes: Float[Array, "rows columns"]
) -> Float[Array, "rows bins columns"]:
    """Return the products of a row's bins and its slopes."""
    # Optimisation barrier: fused into the rows, slopes would be computed again for each bin.
    return kernel[:, :, None] * once(slopes)[:, None, :]
