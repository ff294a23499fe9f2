"""Stretches of rays: pieces between the faces of voxels, what is left of light there, and bins they span."""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._one_function import once
from jaxlidar._vectors import Scalar, Vec
from jaxlidar.planning.trace_plan import Bins
from jaxlidar.trace.deposit import first_bin
from jaxlidar.trace.march import Medium, advance, begin, cell_of, earlier, later

Tally = TypeVar("Tally")

# Stretches that are added at once.
BLOCK = 256


class Stretches(eqx.Module):
    """Pieces of one ray between faces: start, length (m), depth at its start, voxel, extinction (1/m).

    `moved`: derivatives of that depth, where scores are asked for.
    """

    start: Float[Array, "*steps"]
    length: Float[Array, "*steps"]
    depth: Float[Array, "*steps"]
    cell: Int[Array, "*steps"]
    extinction: Float[Array, "*steps"]
    moved: Float[Array, "*steps columns"] | None = None


def mean_decay(x: Scalar) -> Scalar:
    """(1 - exp(-x)) / x for x >= 0, with its derivative; accurate down to and at zero."""
    return _decay(x)[1]


def _decay(x: Scalar) -> tuple[Scalar, Scalar]:
    """exp(-x) and (1 - exp(-x)) / x, the latter for small x as exp(-x/2) sinh(x/2) / (x/2)."""
    small = x < 1.0
    square = 0.25 * x * x
    series = jnp.ones_like(x)
    # Terms to the last digit at 1.
    for n in range(3 if jnp.finfo(x.dtype).bits == 32 else 7, 0, -1):
        series = 1.0 + square * (1.0 / (2 * n * (2 * n + 1))) * series
    half = jnp.exp(-0.5 * x)
    passing = half * half
    return passing, jnp.where(small, half * series, (1.0 - passing) / jnp.where(small, 1.0, x))


def march_ray(
    medium: Medium, x: Vec, w: Vec, end: Scalar, stops: list[Scalar], steps: int, max_step: Scalar
) -> tuple[Stretches, list[Scalar], Scalar]:
    """All stretches of one ray up to `end`, and the optical depth at each of `stops` and at its end."""
    walk = begin(medium, x, w)
    end = earlier(end, walk.leave)

    def step(state, _):
        distance, depth, voxel, at_stops = state
        faces = once(walk.faces(voxel))
        face = earlier(earlier(faces[0], faces[1]), faces[2])
        to = earlier(end, earlier(face, distance + max_step))
        for stop in stops:
            # Plates lie between stretches, not within one.
            to = jnp.where(stop > distance, earlier(to, stop), to)
        cell = cell_of(medium, voxel)
        k = medium.extinction(cell, w)
        to, cell, k = once((later(distance, to), cell, k))
        length = to - distance
        at_stops = [
            a + k * (later(distance, earlier(stop, to)) - distance) for a, stop in zip(at_stops, stops)
        ]
        moved = advance(walk, voxel, faces, to)
        return (to, depth + k * length, moved, at_stops), Stretches(distance, length, depth, cell, k)

    zero = jnp.zeros_like(end)
    state = (jnp.minimum(walk.enter, end), zero, walk.voxel, [zero] * len(stops))
    (_, total, _, at_stops), stretches = lax.scan(step, state, None, length=steps)
    return stretches, at_stops, total


def stretch_pieces(
    bins: Bins, low: Float[Array, "*s"], stretch: Stretches, kappa: float
) -> tuple[Int[Array, "*s"], Float[Array, "pieces *s"]]:
    """First bin of each stretch, and the integrals of exp(-kappa tau) ds over its pieces, bin by bin.

    `low` is the position of the start of each stretch on the axis of bins.
    """
    metres = 0.5 * SPEED_OF_LIGHT * bins.width
    high = low + stretch.length / metres
    number = jnp.round(lax.stop_gradient(low))
    # Rows of an even length are added faster; a piece beyond the end is zero.
    count = bins.row - 2 + bins.row % 2

    def piece(carry, j):
        clear, start = carry
        end = jnp.clip(number + (j + 0.5), low, high)
        length = (end - start) * metres
        passing, mean = _decay(kappa * stretch.extinction * length)
        return (clear * passing, end), clear * mean * length

    # A scan computes each piece once; unrolled, compilers recompute them for every element.
    start = (jnp.exp(-kappa * stretch.depth), low)
    _, pieces = lax.scan(piece, start, jnp.arange(count, dtype=low.dtype))
    return first_bin(bins, number, count), pieces


def in_blocks(
    add: Callable[[Tally, Stretches, Any], Tally],
    tally: Tally,
    stretch: Stretches,
    light: Any,
    there: Bool[Array, "steps rays"] | None,
) -> Tally:
    """A tally to which `add` has added stretches: those that are `there`, or all before the end of their ray.

    `light` is what is known of each ray. Blocks stay within the processor's cache, and most of a forest is
    empty.
    """
    shape = stretch.start.shape
    before_end = (stretch.start < stretch.start[-1:]) | (stretch.length > 0.0)
    there = before_end if there is None else before_end & there
    one, none = there.astype(jnp.int32), jnp.zeros(shape[1], jnp.int32)
    number_of, before = lax.scan(lambda n, more: (n + more, n), none, one)
    upto = jnp.cumsum(number_of)
    first = jnp.concatenate([jnp.zeros(1, jnp.int32), upto[:-1]])
    place = jnp.where(there, first[None] + before, there.size)
    number = jnp.arange(there.size, dtype=jnp.int32)
    chosen = jnp.zeros((there.size + BLOCK,), jnp.int32).at[place.reshape(-1)].set(number, mode="drop")

    def block(n, tally):
        own = lax.dynamic_slice(chosen, (n * BLOCK,), (BLOCK,))
        its = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[own], stretch)
        # What fills up the last block has no length.
        last = n * BLOCK + jnp.arange(BLOCK) < upto[-1]
        its = eqx.tree_at(lambda s: s.length, its, jnp.where(last, its.length, 0.0))
        return add(tally, its, jax.tree.map(lambda a: a[own % shape[1]], light))

    return lax.fori_loop(0, (upto[-1] + (BLOCK - 1)) // BLOCK, block, tally)
