"""What photons and rays bring of scores: what collisions add, what the way back takes, and what returns."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._vectors import Scalar, Vec
from jaxlidar.trace.deposit import scatter_rows
from jaxlidar.trace.labels import Label
from jaxlidar.trace.march import Medium, straight_up
from jaxlidar.trace.photons import Hit, stop
from jaxlidar.trace.scores import Scores, packed, rows_of
from jaxlidar.trace.setting import Setting
from jaxlidar.trace.stretches import Stretches, stretch_pieces


def gains(
    setting: Setting, cell: Int[Array, "photons"], collided: Bool[Array, "photons"], hit: Hit
) -> Float[Array, "photons columns"]:
    """What collisions add to scores: the relative derivative of the extinction of leaf, or of bark."""
    medium, plan, scores = setting.medium, setting.plan, setting.scores
    assert medium is not None
    assert scores is not None
    inside = collided & (hit.on < 0)
    given = []
    for table, scatterer in ((medium.leaf, plan.leaf), (medium.bark, plan.bark)):
        if table is None or scatterer is None:
            given.append(None)
            continue
        given.append((inside & (hit.material == scatterer.material), stop(table)))
    return scores.gains(cell, *given)


def rise(setting: Setting, medium: Medium, x: Vec) -> Float[Array, "photons columns"]:
    """Derivatives of the optical depth from `x` straight up."""
    scores = setting.scores
    assert scores is not None
    assert scores.column is not None
    cell, above, inside = stop(straight_up(medium, x))
    up = (jnp.zeros_like(above), jnp.zeros_like(above), jnp.ones_like(above))
    length = jnp.where(inside, above * stop(medium.size[2]), 0.0)
    slopes = scores.slopes(cell, medium.leaf_share(up))
    own = scores.spread(scores.columns_of(cell), [slope * length for slope in slopes], axis=-1)
    higher = scores.column.at[cell].get(mode="promise_in_bounds")
    return jnp.where(inside[:, None], higher, 0.0) + own


def scored(
    setting: Setting,
    into: Float[Array, "bins columns wavelengths"],
    first: Int[Array, "photons"],
    row: Float[Array, "photons kernel"],
    score: Float[Array, "photons columns"],
    pairs: list[tuple[Array, Scalar]],
    label: Label,
) -> Float[Array, "bins columns wavelengths"]:
    """Derivatives of what returns, with those of more photons.

    `pairs`: letters with which light returns, and intensity factors; `row`: what returns but for these.
    """
    scores = setting.scores
    assert scores is not None
    value = jnp.zeros((first.size, scores.left.shape[1]), row.dtype)
    for letter, factor in pairs:
        factor = jnp.where(letter >= 0, factor, 0.0)
        history = label.grown(setting, letter).number
        value = value + factor[:, None] * scores.left.at[history].get(mode="promise_in_bounds")
    inner = score[:, :, None] * stop(value)[:, None, :]
    rows = rows_of(stop(row), inner.reshape(first.size, -1))
    flat = into.reshape(1, len(into), -1)
    return scatter_columns(flat, jnp.zeros_like(first), first, rows)[0].reshape(into.shape)


def scatter_columns(
    into: Float[Array, "slots bins columns"],
    slot: Int[Array, "rows"],
    first: Int[Array, "rows"],
    rows: Float[Array, "rows kernel columns"],
) -> Float[Array, "slots bins columns"]:
    """Add rows of contiguous bins, each with all columns."""
    slots, bins, columns = into.shape
    flat = scatter_rows(into.reshape(slots, -1), slot, first * columns, rows.reshape(len(rows), -1))
    return flat.reshape(slots, bins, columns)


def with_scores(
    setting: Setting, stretch: Stretches, w: Vec, stops: list[Scalar]
) -> tuple[Stretches, list[Float[Array, "rays columns"]]]:
    """Stretches of rays along `w` with the derivatives of the depth before each, and these up to `stops`."""
    medium, scores = setting.medium, setting.scores
    assert medium is not None
    assert scores is not None
    share = stop(medium.leaf_share(w))

    def step(carry, own):
        before, at_stops = carry
        start, length, cell = own
        slopes, columns = scores.slopes(cell, share), scores.columns_of(cell)
        slope = scores.spread(columns, slopes, axis=-1)
        parts = [jnp.clip(end - start, 0.0, length)[:, None] for end in stop(stops)]
        at_stops = [a + slope * part for a, part in zip(at_stops, parts)]
        return (before + slope * length[:, None], at_stops), before

    zero = jnp.zeros((w[0].size, scores.count), w[0].dtype)
    given = stop((stretch.start, stretch.length, stretch.cell))
    (_, at_stops), moved = jax.lax.scan(step, (zero, [zero] * len(stops)), given)
    return dataclasses.replace(stretch, moved=moved), at_stops


def rows_of_stretches(
    setting: Setting,
    is_leaf: bool,
    w: Vec,
    low: Scalar,
    stretch: Stretches,
    kappa: float,
    extinction: Scalar,
    value: Scalar,
) -> Float[Array, "stretches pieces columns"]:
    """Derivatives of what leaf, or bark, of that extinction returns from stretches, bin by bin.

    With the integral I of exp(-kappa tau) over a piece, its derivative dI/dk at a fixed depth of the start,
    and the derivatives D of that depth, they are `value` times

        extinction dI/dk dk  +  I (d extinction - kappa extinction D).
    """
    medium, scores, bins = setting.medium, setting.scores, setting.bins
    assert medium is not None
    assert scores is not None
    before = stretch.moved
    assert before is not None
    stretch, low, extinction, value = stop((stretch, low, extinction, value))
    share = stop(medium.leaf_share(w))

    def pieces_at(k):
        return stretch_pieces(bins, low, dataclasses.replace(stretch, extinction=k), kappa)[1]

    k = stretch.extinction
    pieces, steeper = jax.jvp(pieces_at, (k,), (jnp.ones_like(k),))
    columns = scores.columns_of(stretch.cell)
    slope = scores.spread(columns, scores.slopes(stretch.cell, share), axis=-1)
    own = scores.alone(is_leaf)
    if own is None:
        own = jnp.zeros_like(slope)
    else:
        own = scores.spread(columns, own.slopes(stretch.cell, share), axis=-1)
    inner = value[:, None] * (own - (kappa * extinction)[:, None] * before)
    return rows_of(pieces.T, inner) + rows_of(steeper.T, (value * extinction)[:, None] * slope)


def scores_of(
    setting: Setting,
    leaf: Float[Array, "columns cells"] | None,
    bark: Float[Array, "columns cells"] | None,
    optics: Float[Array, "letters wavelengths"],
    most: int,
) -> Scores:
    """Scores from the derivatives of extinction, of which at most `most` move one voxel."""
    medium = setting.medium
    assert medium is not None
    table = leaf if leaf is not None else bark
    assert table is not None
    leaf, bark, number = packed(leaf, bark, most)
    left = setting.table.monomials(optics)
    scores = Scores(leaf, bark, number, None, left, count=len(table))
    if setting.column is None:
        return scores
    return Scores(leaf, bark, number, _columns(medium, scores), left, count=len(table))


def _columns(medium: Medium, scores: Scores) -> Float[Array, "cells columns"]:
    """Derivatives of the optical depth straight up above each voxel's upper face."""
    nx, ny, nz = medium.shape
    cells = jnp.arange(int(np.prod(medium.shape))).reshape(nx * ny, nz).T
    one = jnp.ones((nx * ny,), medium.size.dtype)
    share = medium.leaf_share((0.0 * one, 0.0 * one, one))

    def level(above, cell):
        slopes = scores.slopes(cell, share)
        own = scores.spread(scores.columns_of(cell), [s * medium.size[2] for s in slopes], axis=-1)
        return above + own, above

    zero = jnp.zeros((nx * ny, scores.count), medium.size.dtype)
    _, above = jax.lax.scan(level, zero, cells, reverse=True)
    return jnp.swapaxes(above, 0, 1).reshape(-1, scores.count)
