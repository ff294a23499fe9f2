"""Derivatives of the extinction of every voxel with respect to parameters, the columns of a Jacobian.

With parameters theta_j, the score functions of paths (`trace.derivatives.score_functions`) are made of

    d k / d theta_j                     of the extinction coefficient k in every voxel ("slopes"),
    d tau / d theta_j = sum over voxels of length * d k / d theta_j     of optical depths ("depth slopes").

The extinction of a voxel often depends on few of the parameters (those of a layer of a profile, say): the
voxel then stores the indices of these, and a slope for each. Nothing is estimated here.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._jax.one_function import barrier


class ExtinctionSlopes(eqx.Module):
    """Derivatives d k / d theta_j of extinction with respect to parameters, for each voxel.

    - `leaf`, `bark`: slopes, 1/m per unit of the parameter; for leaf as `Medium.leaf`, before leaf angles.
    - `parameter_index`: the parameter of each slope; None where a voxel has slopes of all parameters in turn.
    - `depth_above`: slope of the optical depth straight up from each voxel's upper face, for a beam at nadir.
    - `history_optics`: optical weight of every history, at the values at which derivatives are taken.
    - `count`: number of parameters.
    """

    leaf: Float[Array, "slopes cells"] | None
    bark: Float[Array, "slopes cells"] | None
    parameter_index: Int[Array, "slopes cells"] | None
    depth_above: Float[Array, "cells parameters"] | None
    history_optics: Float[Array, "histories wavelengths"]
    count: int = eqx.field(static=True)

    @property
    def slopes_per_voxel(self) -> int:
        """Largest number of parameters on which one voxel depends."""
        table = self.leaf if self.leaf is not None else self.bark
        assert table is not None
        return table.shape[0]

    def slopes_at(
        self, cell: Int[Array, "*s"], projection_factor: Float[Array, "*s"] | None = None
    ) -> list[Float[Array, "*s"]]:
        """Return the slopes of the extinction of leaf and bark together at voxels.

        `projection_factor`: of `Medium`, 2 G(w) in the direction of travel; None for one.
        """
        bark = [] if self.bark is None else _gather_rows(self.bark, cell, None)
        if self.leaf is None:
            return bark
        leaf = _gather_rows(self.leaf, cell, projection_factor)
        return [a + b for a, b in zip(leaf, bark)] if bark else leaf

    def of_material(self, is_leaf: bool) -> "ExtinctionSlopes | None":
        """Return the slopes of leaf, or of bark, alone; None where that material depends on no parameter."""
        table = self.leaf if is_leaf else self.bark
        if table is None:
            return None
        return dataclasses.replace(self, bark=None) if is_leaf else dataclasses.replace(self, leaf=None)

    def parameters_at(self, cell: Int[Array, "*s"]) -> list[Int[Array, "*s"]]:
        """Return the parameters of the slopes of voxels; empty where these are all parameters in turn."""
        # Profiles of few layers may change every voxel by every parameter: then no indices are stored.
        if self.parameter_index is None:
            return []
        return [row.at[cell].get(mode="promise_in_bounds") for row in self.parameter_index]

    def to_all_parameters(
        self, parameters: list[Int[Array, "*s"]], values: list[Float[Array, "*s"]], axis: int = 0
    ) -> Float[Array, "..."]:
        """Put values that belong to some parameters among all of them, which become the axis `axis`."""
        if self.parameter_index is None:
            return jnp.stack(values, axis)
        shape = [1] * (values[0].ndim + 1)
        shape[axis] = self.count
        numbers = jnp.arange(self.count, dtype=jnp.int32).reshape(shape)
        pairs = ((jnp.expand_dims(a, axis), jnp.expand_dims(b, axis)) for a, b in zip(parameters, values))
        # Comparisons in place of a scatter: parameters are few, and comparisons are vectorised.
        total, *terms = (jnp.where(parameter == numbers, value, 0.0) for parameter, value in pairs)
        for term in terms:
            total = total + term
        return total

    def add_segment(
        self,
        depth_slopes: Float[Array, "ends parameters photons"],
        cell: Int[Array, "photons"],
        length: Float[Array, "ends photons"],
        projection_factor: Float[Array, "photons"] | None,
    ) -> Float[Array, "ends parameters photons"]:
        """Add a segment to derivatives of optical depths; `length`, m, of it lies before each end."""
        slopes, parameters = self.slopes_at(cell, projection_factor), self.parameters_at(cell)
        # Optimisation barrier: inside the march, fused slopes would be gathered again for every target.
        slopes, length = barrier((slopes, length))
        if self.parameter_index is None:
            return depth_slopes + jnp.stack(slopes)[None] * length[:, None]
        numbers = jnp.arange(self.count, dtype=jnp.int32)[None, :, None]
        for parameter, slope in zip(parameters, slopes):
            term = (slope[None] * length)[:, None]
            depth_slopes = depth_slopes + jnp.where(parameter[None, None] == numbers, term, 0.0)
        return depth_slopes

    def log_extinction_slopes(
        self,
        cell: Int[Array, "*s"],
        leaf: tuple[Bool[Array, "*s"], Float[Array, "cells"]] | None,
        bark: tuple[Bool[Array, "*s"], Float[Array, "cells"]] | None,
    ) -> Float[Array, "*s parameters"]:
        """Return (d k / d theta) / k of the material that photons collided with; zero where there was none.

        `leaf`, `bark`: pairs of a mask of the photons that collided with the material, and its extinction by
        voxel; None where there is no such material.
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
        return self.to_all_parameters(self.parameters_at(cell), values, axis=-1)


def _gather_rows(
    table: Float[Array, "slopes cells"], cell: Int[Array, "*s"], factor: Float[Array, "*s"] | None
) -> list[Float[Array, "*s"]]:
    rows = [row.at[cell].get(mode="promise_in_bounds") for row in table]
    return rows if factor is None else [slope * factor for slope in rows]


def pack_slopes(
    leaf: Float[Array, "parameters cells"] | None,
    bark: Float[Array, "parameters cells"] | None,
    per_voxel: int,
) -> tuple[Array | None, Array | None, Array | None]:
    """Keep, for each voxel, the slopes of leaf and bark of the at most `per_voxel` parameters it depends on.

    1. Mark the parameters on which each voxel depends.
    2. `per_voxel` times: take the lowest that is marked, and unmark it.
    3. Gather the slopes of these; a parameter that fills up the list counts once.
    4. Set the slopes of voxels that have marks left to NaN.

    **Returns:** both tables, (per_voxel, cells), and the parameters of their rows; tables as they are and
    None where a voxel may depend on all parameters.
    """
    tables = [table for table in (leaf, bark) if table is not None]
    depends = jnp.any(jnp.stack(tables) != 0, axis=0)
    count = len(depends)
    if per_voxel >= count:
        return leaf, bark, None
    selected, numbers = [], jnp.arange(count, dtype=jnp.int32)[:, None]
    for _ in range(per_voxel):
        # The lowest parameter that is left, voxel by voxel; 0 where none is.
        number = jnp.argmax(depends, axis=0).astype(jnp.int32)
        selected.append(number)
        depends = depends & (numbers != number[None])
    parameter_index, overflow = jnp.stack(selected), jnp.any(depends, axis=0)

    def pack(table: Array | None) -> Array | None:
        if table is None:
            return None
        slopes = jnp.take_along_axis(table, parameter_index, axis=0)
        # Where a voxel depends on fewer parameters, parameter 0 fills up the list; its slope counts once.
        repeated = jnp.stack(
            [jnp.any(parameter_index[:i] == parameter_index[i][None], axis=0) for i in range(per_voxel)]
        )
        return jnp.where(overflow[None], jnp.nan, jnp.where(repeated, 0.0, slopes))

    return pack(leaf), pack(bark), parameter_index


def outer_rows(
    bin_values: Float[Array, "rows bins"], slopes: Float[Array, "rows parameters"]
) -> Float[Array, "rows bins parameters"]:
    """Return the products of a row's bins and its slopes."""
    # Optimisation barrier: fused into the rows, slopes would be computed again for each bin.
    return bin_values[:, :, None] * barrier(slopes)[:, None, :]
