"""Levenberg-Marquardt solver for PROSPECT: the fit of many leaves.

Traits other than N act through the absorption of a plate, k = sum(c_i K_i)/N, alone. So with s = dR/dk / N
the Jacobian's columns are s K_i and dR/dN - s k: the normal equations need two derivatives of the plate model
and products with the table, and a fit of seven traits costs little more than one of two. Damping is relative
to the diagonal of the normal matrix.

Bounds are kept by projection: a trait on a bound beyond which the fit would be better is held there for the
step, the others move, and a trait that would leave its bounds is set to the bound. In `retrieve` unknowns
never reach a bound; here they can, because leaves without anthocyanins or brown pigments have their minimum
on one.

Leaves run in chunks that fit into the processor's cache, each chunk until its slowest leaf has ended. On
measured leaves `optimistix.LevenbergMarquardt` under `jax.vmap`, with unknowns that never reach a bound, took
more than 20 times as long, because some leaves ran to the last step.

Source: Marquardt (1963), J. SIAM 11, 431; Bertsekas (1982), SIAM J. Control Optim. 20, 221 (projection).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxlidar.extend import once
from jaxlidar.optics.leaf_surface import LeafSurface
from jaxlidar.optics.plate_model import plate_model_slopes

# A fit has converged when a Gauss-Newton step would move it by less than this many standard errors.
_SMALL_STEP = 0.02
# Residuals count as at least this many roundings.
_ROUNDINGS = 64
# Damping falls by ten with every step that improves the fit, including the first evaluation.
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-5, 1e8
# A first fit, to at least this many bands, gives the start of the fit to all bands.
_FEW_BANDS = 200


def rounding(dtype: Any) -> float:
    """Least uncertainty of a residual of reflectances in this precision."""
    return _ROUNDINGS * float(jnp.finfo(dtype).eps)


class Point(NamedTuple):
    """A leaf at the traits `x`: chi-squared, unweighted sum of squares, half the gradient, normal matrix."""

    x: Float[Array, "*leaves n"]
    chi2: Float[Array, "*leaves"]
    square: Float[Array, "*leaves"]
    slope: Float[Array, "*leaves n"]
    normal: Float[Array, "*leaves n n"]


class State(NamedTuple):
    """State of a fit: best point, next trial and its damping, points tried, whether it has converged."""

    best: Point
    trial: Float[Array, "*leaves n"]
    damping: Float[Array, "*leaves"]
    steps: Int[Array, "*leaves"]
    done: Bool[Array, "*leaves"]


class Task(NamedTuple):
    """Leaves to fit: start and bounds of N and the traits, spectra and their standard deviations.

    Traits that are not unknowns have equal bounds, which fix them. Spectra are NaN, or deviations infinite,
    where there is no sample.
    """

    start: Float[Array, "*leaves n"]
    low: Float[Array, "*leaves n"]
    high: Float[Array, "*leaves n"]
    observed: Float[Array, "*leaves 2 wavelengths"]
    sigma: Float[Array, "*leaves 2 wavelengths"]


def in_chunks(each: Callable[[Any], Any], leaves: Any, chunk: int) -> Any:
    """`each` of all leaves, arrays' first axis, in chunks of at most `chunk`."""
    count = len(jax.tree.leaves(leaves)[0])
    chunks = -(-count // chunk)
    size = -(-count // chunks)
    # The last chunk is filled up with the last leaf: a smaller one would be compiled separately.
    index = jnp.minimum(jnp.arange(chunks * size), count - 1).reshape(chunks, size)
    ends = lax.map(lambda i: jax.vmap(each)(jax.tree.map(lambda a: a[i], leaves)), index)
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:count], ends)


@partial(jax.jit, static_argnames="chunk")
def fit_all(
    task: Task, absorption: Array, face: LeafSurface, count: ArrayLike, max_steps: ArrayLike, chunk: int
) -> State:
    """Fit leaves, in chunks of at most `chunk`; `count` is the number of unknowns."""
    every = absorption.shape[1] // _FEW_BANDS

    def fit(leaf: Task) -> State:
        if every > 1:
            # Far from the minimum, a part of the bands gives steps as good at a part of the cost.
            few = leaf._replace(observed=leaf.observed[:, ::every], sigma=leaf.sigma[:, ::every])
            table, surface = absorption[:, ::every], LeafSurface(*(x[::every] for x in face))
            near = _fit(few, table, surface, count, max_steps, _FIRST_DAMPING)
            leaf = leaf._replace(start=near.best.x)
        damping = _FIRST_DAMPING if every <= 1 else _LEAST_DAMPING
        return _fit(leaf, absorption, face, count, max_steps, damping)

    return in_chunks(fit, task, chunk)


def _fit(
    leaf: Task, absorption: Array, face: LeafSurface, count: ArrayLike, max_steps: ArrayLike, damping: float
) -> State:
    start, low, high = leaf.start, leaf.low, leaf.high
    used = jnp.isfinite(leaf.observed) & jnp.isfinite(leaf.sigma)
    observed, weight = jnp.where(used, leaf.observed, 0.0), jnp.where(used, 1.0 / leaf.sigma, 0.0)
    samples = jnp.sum(used)
    freedom = jnp.maximum(samples - count, 1)
    floor = rounding(start.dtype) ** 2 * jnp.sum(weight**2) / jnp.maximum(samples, 1)

    def at(x: Array) -> Point:
        k = jnp.dot(x[1:], absorption, precision=lax.Precision.HIGHEST) / x[0]
        values, in_k, in_N = (jnp.stack(v[:2]) for v in plate_model_slopes(k, x[0], face))
        # Without the barrier the compiler would compute them again for every sum below.
        values, in_k, in_N = once((values, in_k, in_N))
        off = values - observed
        residual, s = off * weight, in_k * weight / x[0]
        n = in_N * weight - s * k[None]
        # Sums over wavelengths with every coefficient: of s s K_i, s n and s residual.
        rows = jnp.stack([jnp.sum(s * n, axis=0), jnp.sum(s * residual, axis=0)])
        rows = jnp.concatenate([absorption * jnp.sum(s * s, axis=0)[None], rows])
        rows = jnp.dot(rows, absorption.T, precision=lax.Precision.HIGHEST)
        mixed, corner = rows[-2], jnp.sum(n * n)
        normal = jnp.block([[corner[None, None], mixed[None]], [mixed[:, None], rows[:-2]]])
        slope = jnp.concatenate([jnp.sum(n * residual)[None], rows[-1]])
        return Point(x, jnp.sum(residual**2), jnp.sum(jnp.where(used, off, 0.0) ** 2), slope, normal)

    def step(p: Point, damping: ArrayLike) -> Array:
        free = ((p.x > low) | (p.slope < 0)) & ((p.x < high) | (p.slope > 0))
        norm = jnp.sqrt(jnp.diagonal(p.normal))
        norm = jnp.where(norm > 0, norm, 1.0)
        matrix = jnp.where(jnp.outer(free, free), p.normal / jnp.outer(norm, norm), 0.0)
        matrix = jnp.where(jnp.eye(norm.size, dtype=bool), 1.0 + damping, matrix)
        right = jnp.where(free, -p.slope / norm, 0.0)
        return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(matrix), True), right) / norm

    def converged(p: Point) -> Array:
        fall = -jnp.dot(p.slope, step(p, _LEAST_DAMPING), precision=lax.Precision.HIGHEST)
        small = _SMALL_STEP**2 * jnp.maximum(p.chi2 / freedom, floor)
        # A fall of chi-squared by a few roundings is not measurable.
        small = jnp.maximum(small, 8 * jnp.finfo(fall.dtype).eps * p.chi2)
        return (fall <= small) & jnp.isfinite(p.chi2)

    def advance(s: State) -> State:
        tried = at(s.trial)
        better = tried.chi2 < s.best.chi2
        best = jax.tree.map(partial(jnp.where, better), tried, s.best)
        damping = jnp.where(better, jnp.maximum(0.1 * s.damping, _LEAST_DAMPING), 10.0 * s.damping)
        trial = jnp.clip(best.x + step(best, damping), low, high)
        return State(best, trial, damping, s.steps + 1, converged(best))

    def going(s: State) -> Array:
        return ~s.done & (s.steps < max_steps) & (s.damping < _MOST_DAMPING)

    # Chi-squared begins at infinity, so that the start, tried first, is accepted.
    zero = jnp.zeros_like(start)
    none = Point(start, jnp.full_like(floor, jnp.inf), jnp.zeros_like(floor), zero, jnp.outer(zero, zero))
    first = State(none, start, jnp.asarray(damping, start.dtype), jnp.asarray(0), jnp.asarray(False))
    return lax.while_loop(going, advance, first)
