r"""Segments of footprint rays between voxel faces, and the light that returns from them, bin by bin.

Within a segment from s0 to s1 the extinction k is constant, and the optical depth before it is tau0. The
first-order return of a piece [a, b] of it, per unit of k and of intensity factor, is

    integral over s in [a, b] of exp(-kappa tau(s)) ds = exp(-kappa tau(a)) (b - a) D(kappa k (b - a)),

    D(x) = (1 - exp(-x)) / x,

with kappa = 2 for independent paths in and out, or 1 with the hot spot. D is the mean of exp(-t) for t from 0
to x ("mean decay"). Segments are cut at the edges of time bins, so that every piece belongs to one bin.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._jax.mesh_axes import vary_together
from jaxlidar._jax.one_function import barrier
from jaxlidar._jax.vmapped_loops import largest_count
from jaxlidar._vectors import Scalar, Vec
from jaxlidar.planning.config import TimeBins
from jaxlidar.trace.deposit import padded_index
from jaxlidar.trace.march.voxel_traversal import Medium, cell_index, enter_grid, maximum, minimum, step_voxel

Tally = TypeVar("Tally")

# Segments that are deposited at once.
SEGMENTS_AT_ONCE = 256


class RaySegments(eqx.Module):
    """Segments of a ray between faces.

    - `start`, `length`: distance from the start of the ray, and length, m.
    - `depth`: optical depth before the segment. `cell`: the voxel. `extinction`: 1/m.
    - `depth_slopes`: derivatives of that depth with respect to parameters; None without score functions.
    """

    start: Float[Array, "*steps"]
    length: Float[Array, "*steps"]
    depth: Float[Array, "*steps"]
    cell: Int[Array, "*steps"]
    extinction: Float[Array, "*steps"]
    depth_slopes: Float[Array, "*steps parameters"] | None = None


def mean_decay(x: Scalar) -> Scalar:
    """(1 - exp(-x)) / x for x >= 0, with its derivative; accurate down to and at zero."""
    return _decay(x)[1]


def _decay(x: Scalar) -> tuple[Scalar, Scalar]:
    """exp(-x) and (1 - exp(-x)) / x, the latter for small x as exp(-x/2) sinh(x/2) / (x/2), by its series."""
    small = x < 1.0
    square = 0.25 * x * x
    # The direct formula loses all digits near zero, and its derivative more.
    series = jnp.ones_like(x)
    # So many terms are exact to the last digit at x = 1.
    for n in range(3 if jnp.finfo(x.dtype).bits == 32 else 7, 0, -1):
        series = 1.0 + square * (1.0 / (2 * n * (2 * n + 1))) * series
    half = jnp.exp(-0.5 * x)
    decay = half * half
    return decay, jnp.where(small, half * series, (1.0 - decay) / jnp.where(small, 1.0, x))


def march_ray(
    medium: Medium,
    x: Vec,
    w: Vec,
    end: Scalar,
    stops: list[Scalar],
    max_segments: int,
    max_length: Scalar,
) -> tuple[RaySegments, list[Scalar], Scalar]:
    """Cut one ray into segments up to `end`, none longer than `max_length`.

    Each step:

    1. Find the nearest of the faces ahead, the stops ahead, the end, and the greatest length.
    2. Look up the extinction of the voxel.
    3. Add to the depths of the stops what of the segment lies before each.
    4. Add the segment's depth, and go on to the voxel behind the face, if one was met.

    **Returns:** the segments; the optical depth at each of `stops`, which are distances along the ray; and
    that at its end. Segments after the end have no length.
    """
    # No target depth stops these rays, unlike photons: the first order needs every voxel on the way.
    ray = enter_grid(medium, x, w)
    end = minimum(end, ray.leave)

    def step(state, _):
        distance, depth, voxel, depth_at_stops = state
        faces = barrier(ray.face_distances(voxel))
        face = minimum(minimum(faces[0], faces[1]), faces[2])
        to = minimum(end, minimum(face, distance + max_length))
        for stop in stops:
            # Plates lie between segments, not within one: what they shade begins with the next segment.
            to = jnp.where(stop > distance, minimum(to, stop), to)
        cell = cell_index(medium, voxel)
        k = medium.extinction(cell, w)
        to, cell, k = barrier((maximum(distance, to), cell, k))
        length = to - distance
        depth_at_stops = [
            d + k * (maximum(distance, minimum(stop, to)) - distance)
            for d, stop in zip(depth_at_stops, stops)
        ]
        next_voxel = step_voxel(ray, voxel, faces, to)
        segment = RaySegments(distance, length, depth, cell, k)
        return (to, depth + k * length, next_voxel, depth_at_stops), segment

    zero = jnp.zeros_like(end)
    state = vary_together((jnp.minimum(ray.enter, end), zero, ray.voxel, [zero] * len(stops)))
    (_, total_depth, _, depth_at_stops), segments = lax.scan(step, state, None, length=max_segments)
    return segments, depth_at_stops, total_depth


def integrate_over_bins(
    bins: TimeBins, start_position: Float[Array, "*s"], segments: RaySegments, kappa: float
) -> tuple[Int[Array, "*s"], Float[Array, "pieces *s"]]:
    """Integrate exp(-kappa tau) ds over the pieces of each segment, bin by bin.

    1. Number the bin in which the segment starts.
    2. Cut the segment into a first piece up to the bin's edge, pieces that fill a bin, and the rest. As the
       extinction is constant, all pieces of one kind have the same transmittance, and the same integral for
       light that enters them undiminished.
    3. From bin to bin: that integral times the transmittance up to the piece.

    **Arguments:** `start_position`: of the start of each segment on the axis of bins.

    **Returns:** index of the first bin, counting the margin, and the integrals, m, from there on.
    """
    bin_length = 0.5 * SPEED_OF_LIGHT * bins.width
    end_position = start_position + segments.length / bin_length
    # Bin n covers positions n - 1/2 to n + 1/2.
    first_number = jnp.round(lax.stop_gradient(start_position))
    # `max_span` counts two bins by which smoothing widens a row. Rows of an even length are added faster; a
    # piece beyond the end is zero.
    count = bins.max_span - 2 + bins.max_span % 2

    # Pieces of the first bin, of whole bins, and of the last one; in bins.
    first_length = jnp.minimum(first_number + 0.5, end_position) - start_position
    to_last_edge = jnp.maximum(end_position - (first_number + 0.5), 0.0)
    n_whole = jnp.floor(lax.stop_gradient(to_last_edge))
    lengths = (first_length, jnp.ones_like(first_length), to_last_edge - n_whole)

    def integral_over(length: Scalar) -> Scalar:
        """Return the integral over a piece, of light that enters it undiminished."""
        length = length * bin_length
        return mean_decay(kappa * segments.extinction * length) * length

    # Optimisation barrier: these would be computed again for each bin.
    first, whole, last = barrier(tuple(integral_over(length) for length in lengths))
    first_depth = kappa * segments.extinction * (first_length * bin_length)
    depth, depth_of_whole = barrier((kappa * segments.depth, kappa * segments.extinction * bin_length))

    def piece(n_before: Array, transmittance: Scalar) -> Scalar:
        integral = jnp.where(n_before < n_whole, whole, jnp.where(n_before > n_whole, 0.0, last))
        return transmittance * integral

    # All pieces in one kernel: in a loop over bins, the overhead of kernels takes as long as they do.
    n_before = jnp.arange(count - 1, dtype=start_position.dtype)
    transmittances = _transmittances_at_steps(depth + first_depth, depth_of_whole, count - 1)
    behind_first = jax.vmap(piece)(n_before, transmittances)
    pieces = jnp.concatenate([(jnp.exp(-depth) * first)[None], behind_first])
    return padded_index(bins, first_number, count), pieces


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def _transmittances_at_steps(
    depth: Float[Array, "*s"], step: Float[Array, "*s"], count: int
) -> Float[Array, "count *s"]:
    """Return exp(-(depth + n step)) for n = 0 ... `count` - 1.

    They are products of the powers of exp(-step) with exponents 1, 2, 4 ..., by the binary digits of n: that
    takes two exponential functions instead of one for every n.
    """
    powers = [jnp.exp(-step)]
    while 2 ** len(powers) < count:
        powers.append(powers[-1] * powers[-1])
    transmittance, powers = barrier((jnp.exp(-depth), powers))

    def after_steps(number: Int[Array, ""]) -> Scalar:
        product = transmittance
        for digit, power in enumerate(powers):
            product = product * jnp.where((number >> digit) & 1 == 1, power, 1.0)
        return product

    return jax.vmap(after_steps)(jnp.arange(count))


@_transmittances_at_steps.defjvp
def _transmittances_at_steps_jvp(count, primals, tangents):
    transmittances = _transmittances_at_steps(*primals, count)
    of_depth, of_step = tangents
    numbers = jnp.arange(count, dtype=transmittances.dtype)
    slopes = jax.vmap(lambda n, value: -value * (of_depth + n * of_step))(numbers, transmittances)
    return transmittances, slopes


def add_in_blocks(
    add: Callable[[Tally, RaySegments, Any], Tally],
    tally: Tally,
    segments: RaySegments,
    per_ray: Any,
    contributes: Bool[Array, "steps rays"] | None,
) -> Tally:
    """Add segments to a tally by `add`, in blocks of those that contribute, and have not ended.

    1. Number the segments that contribute, ray by ray.
    2. List them by these numbers.
    3. Gather them from the list, `SEGMENTS_AT_ONCE` at a time; those that fill up the last block get no
       length.
    4. Add each block.

    **Arguments:**

    - `add`: returns the tally with some segments added; its last argument is `per_ray` at the ray of each.
    - `per_ray`: arrays with one row for each ray.
    - `contributes`: False for segments that return nothing. None: all contribute.

    Blocks stay within the processor's cache, and most voxels of a forest are empty.
    """
    shape = segments.start.shape
    not_ended = (segments.start < segments.start[-1:]) | (segments.length > 0.0)
    contributes = not_ended if contributes is None else not_ended & contributes
    # `rank` of each among those of its ray, `position` among all.
    one = contributes.astype(jnp.int32)
    zero = jnp.zeros_like(one[0])
    per_ray_count, rank = lax.scan(lambda n, is_counted: (n + is_counted, n), zero, one)
    upto = jnp.cumsum(per_ray_count)
    first = jnp.concatenate([jnp.zeros(1, jnp.int32), upto[:-1]])
    position = jnp.where(contributes, first[None] + rank, contributes.size)
    number = jnp.arange(contributes.size, dtype=jnp.int32)
    selected = jnp.zeros((contributes.size + SEGMENTS_AT_ONCE,), jnp.int32)
    selected = selected.at[position.reshape(-1)].set(number, mode="drop")

    def block(n, tally):
        numbers = lax.dynamic_slice(selected, (n * SEGMENTS_AT_ONCE,), (SEGMENTS_AT_ONCE,))
        in_block = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[numbers], segments)
        is_real = n * SEGMENTS_AT_ONCE + jnp.arange(SEGMENTS_AT_ONCE, dtype=upto.dtype) < upto[-1]
        in_block = eqx.tree_at(lambda s: s.length, in_block, jnp.where(is_real, in_block.length, 0.0))
        return add(tally, in_block, jax.tree.map(lambda a: a[numbers % shape[1]], per_ray))

    n_blocks = (largest_count(upto[-1]) + (SEGMENTS_AT_ONCE - 1)) // SEGMENTS_AT_ONCE
    return lax.fori_loop(0, n_blocks, block, tally)
