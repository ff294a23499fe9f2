r"""Levenberg-Marquardt solver for PROSPECT: the fit of many leaves.

Minimised is chi^2(x) = sum over spectra and wavelengths of (R(x) - R_observed)^2 / sigma^2, with x = (N, c_1,
c_2, ...), N the leaf structure parameter and c_i the contents.

**Jacobian.** Contents act only through the absorption of a plate, k = sum_i c_i K_i / N, with K_i the
specific absorption coefficients (Jacquemoud et al. 1996). With s = (dR/dk) / N,

    dR/dc_i = s K_i,    dR/dN = (dR/dN)_k - s k.

So the normal equations need two derivatives of the plate model and products with the table of coefficients,
and a fit of seven traits costs little more than one of two.

**Step.** (A + lambda diag A) dx = -g, with A = J'WJ and g = J'Wr (Marquardt 1963). lambda falls by ten with
every step that lowers chi^2, and rises by ten with any other.

**Bounds** are kept by projection (Bertsekas 1982): a trait on a bound beyond which the fit would improve is
held for the step while the others move, and a trait that would leave its bounds is set to the bound. Leaves
without anthocyanins or brown pigments have their minimum on one.

**Convergence.** A Gauss-Newton step would lower chi^2 by no more than (0.02)^2 times the reduced chi^2: it
would move the traits by less than 0.02 standard errors. A fall that rounding of the residuals alone promises
does not count: spectra without noise are met to the last place.

Leaves run in chunks that fit into the processor's cache, each chunk until its slowest leaf has ended. On
measured leaves `optimistix.LevenbergMarquardt` under `jax.vmap`, with unknowns that never reach a bound, took
more than 20 times as long, because some leaves ran to the last step.

**Source:** Marquardt (1963), J. SIAM 11, 431; Bertsekas (1982), SIAM J. Control Optim. 20, 221; Jacquemoud et
al. (1996), Remote Sens. Environ. 56, 194.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxlidar.extend import barrier, matmul
from jaxlidar.optics.leaf_surface import LeafSurface
from jaxlidar.optics.plate_model import plate_model_slopes

# A fit has converged when a Gauss-Newton step would move it by less than this many standard errors.
_SMALL_STEP = 0.02
# Least uncertainty of a residual, in units of the last place of the floating-point type.
_ROUNDING_UNITS = 64
# Least measurable fall of chi-squared, in units of its last place.
_CHI2_UNITS = 8
# Rounding of a residual that no step can remove, in units of the last place of a reflectance of 1.
_RESIDUAL_UNITS = 2
# Accepting the start, which is tried first, lowers the damping once: the first step has a tenth of it.
_FIRST_DAMPING, _LEAST_DAMPING, _LARGEST_DAMPING = 1e-2, 1e-5, 1e8
# Fewest bands of the preliminary fit that gives the start of the fit to all bands.
_PRELIMINARY_BANDS = 200


def residual_rounding(dtype: Any) -> float:
    """Least uncertainty of a residual of reflectances in this precision."""
    return _ROUNDING_UNITS * float(jnp.finfo(dtype).eps)


class NormalEquations(NamedTuple):
    """Normal equations of leaves at the traits `x`.

    - `x`: N and contents.
    - `chi2`: weighted sum of squared residuals.
    - `sum_of_squares`: that without weights, over the samples that are fitted.
    - `gradient`: J'Wr, half the derivative of `chi2`.
    - `normal`: J'WJ.
    """

    x: Float[Array, "*leaves n"]
    chi2: Float[Array, "*leaves"]
    sum_of_squares: Float[Array, "*leaves"]
    gradient: Float[Array, "*leaves n"]
    normal: Float[Array, "*leaves n n"]


class LeafFitState(NamedTuple):
    """State of the fit of leaves: best point, next trial with its damping, points tried, and convergence."""

    best: NormalEquations
    trial: Float[Array, "*leaves n"]
    damping: Float[Array, "*leaves"]
    n_steps: Int[Array, "*leaves"]
    converged: Bool[Array, "*leaves"]


class LeafProblem(NamedTuple):
    """Leaves to fit: start and bounds of N and contents, spectra and their standard deviations.

    Traits that are not unknowns have equal bounds, which fix them. Missing samples are NaN, or have infinite
    deviations.
    """

    start: Float[Array, "*leaves n"]
    low: Float[Array, "*leaves n"]
    high: Float[Array, "*leaves n"]
    observed: Float[Array, "*leaves 2 wavelengths"]
    sigma: Float[Array, "*leaves 2 wavelengths"]


def map_in_chunks(function: Callable[[Any], Any], leaves: Any, chunk: int) -> Any:
    """Apply a function to every leaf, the first axis of all arrays, in chunks of at most `chunk`."""
    count = len(jax.tree.leaves(leaves)[0])
    n_chunks = -(-count // chunk)
    size = -(-count // n_chunks)
    # The last chunk is filled up with the last leaf: a smaller one would be compiled separately.
    index = jnp.minimum(jnp.arange(n_chunks * size), count - 1).reshape(n_chunks, size)
    results = lax.map(lambda i: jax.vmap(function)(jax.tree.map(lambda a: a[i], leaves)), index)
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:count], results)


@partial(jax.jit, static_argnames="chunk")
def fit_leaves(
    problem: LeafProblem,
    absorption: Array,
    surface: LeafSurface,
    n_unknowns: ArrayLike,
    max_steps: ArrayLike,
    chunk: int,
) -> LeafFitState:
    """Fit leaves, in chunks of at most `chunk`.

    1. With many bands, fit every n-th band. Far from the minimum, a fraction of the bands gives steps as good
       at that fraction of the cost.
    2. Fit all bands from there, with little damping: few steps remain.

    **Arguments:** `absorption`: (contents, wavelengths), the table K. `surface`: refraction at the surface of
    plates. `n_unknowns`: number of traits that are free.
    """
    stride = absorption.shape[1] // _PRELIMINARY_BANDS

    def fit(leaf: LeafProblem) -> LeafFitState:
        if stride > 1:
            thinned = leaf._replace(observed=leaf.observed[:, ::stride], sigma=leaf.sigma[:, ::stride])
            thinned_surface = LeafSurface(*(x[::stride] for x in surface))
            table = absorption[:, ::stride]
            preliminary = _fit_leaf(thinned, table, thinned_surface, n_unknowns, max_steps, _FIRST_DAMPING)
            leaf = leaf._replace(start=preliminary.best.x)
        damping = _FIRST_DAMPING if stride <= 1 else _LEAST_DAMPING
        return _fit_leaf(leaf, absorption, surface, n_unknowns, max_steps, damping)

    return map_in_chunks(fit, problem, chunk)


def _fit_leaf(
    leaf: LeafProblem,
    absorption: Array,
    surface: LeafSurface,
    n_unknowns: ArrayLike,
    max_steps: ArrayLike,
    damping: float,
) -> LeafFitState:
    """Fit one leaf: evaluate the trial, keep the better point, propose the next trial, and so on."""
    start, low, high = leaf.start, leaf.low, leaf.high
    is_used = jnp.isfinite(leaf.observed) & jnp.isfinite(leaf.sigma)
    observed = jnp.where(is_used, leaf.observed, 0.0)
    inverse_sigma = jnp.where(is_used, 1.0 / leaf.sigma, 0.0)
    n_samples = jnp.sum(is_used)
    degrees_of_freedom = jnp.maximum(n_samples - n_unknowns, 1)
    eps = float(jnp.finfo(start.dtype).eps)
    mean_weight = jnp.sum(inverse_sigma**2) / jnp.maximum(n_samples, 1)
    # Reduced chi-squared of residuals that are all rounding.
    rounding_floor = residual_rounding(start.dtype) ** 2 * mean_weight
    # Residuals of independent errors with variance v promise a fall of v for each unknown. That of rounding
    # cannot be had: at the minimum of spectra without noise every step would be refused for it.
    fall_of_rounding = n_unknowns * (_RESIDUAL_UNITS * eps) ** 2 * mean_weight

    def evaluate(x: Array) -> NormalEquations:
        """Run PROSPECT at x and accumulate its normal equations (columns: see the module's docstring)."""
        k = matmul(x[1:], absorption) / x[0]
        values, dR_dk, dR_dN = (jnp.stack(v[:2]) for v in plate_model_slopes(k, x[0], surface))
        # Optimisation barrier: without it the compiler would compute the model again for every sum below.
        values, dR_dk, dR_dN = barrier((values, dR_dk, dR_dN))
        deviation = values - observed
        residual, s = deviation * inverse_sigma, dR_dk * inverse_sigma / x[0]
        N_column = dR_dN * inverse_sigma - s * k[None]
        # Content columns s K_i differ by K_i only: with sums over spectra of s s K_i, s N_column and
        # s residual, one product with the table gives all elements that involve contents.
        rows = jnp.stack([jnp.sum(s * N_column, axis=0), jnp.sum(s * residual, axis=0)])
        rows = jnp.concatenate([absorption * jnp.sum(s * s, axis=0)[None], rows])
        rows = matmul(rows, absorption.T)
        mixed, corner = rows[-2], jnp.sum(N_column * N_column)
        normal = jnp.block([[corner[None, None], mixed[None]], [mixed[:, None], rows[:-2]]])
        gradient = jnp.concatenate([jnp.sum(N_column * residual)[None], rows[-1]])
        sum_of_squares = jnp.sum(jnp.where(is_used, deviation, 0.0) ** 2)
        return NormalEquations(x, jnp.sum(residual**2), sum_of_squares, gradient, normal)

    def step(point: NormalEquations, damping: ArrayLike) -> Array:
        """Damped step of the traits that are free to move; the matrix is scaled to unit diagonal."""
        # A trait on a bound is held unless the gradient points back into the admissible range.
        is_free = ((point.x > low) | (point.gradient < 0)) & ((point.x < high) | (point.gradient > 0))
        norm = jnp.sqrt(jnp.diagonal(point.normal))
        norm = jnp.where(norm > 0, norm, 1.0)
        matrix = jnp.where(jnp.outer(is_free, is_free), point.normal / jnp.outer(norm, norm), 0.0)
        matrix = jnp.where(jnp.eye(norm.size, dtype=bool), 1.0 + damping, matrix)
        right_side = jnp.where(is_free, -point.gradient / norm, 0.0)
        return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(matrix), True), right_side) / norm

    def has_converged(point: NormalEquations) -> Array:
        """True if an undamped step promises no measurable or relevant fall of chi-squared."""
        undamped = step(point, _LEAST_DAMPING)
        fall = -matmul(point.gradient, undamped)
        small = _SMALL_STEP**2 * jnp.maximum(point.chi2 / degrees_of_freedom, rounding_floor)
        small = jnp.maximum(small, jnp.maximum(_CHI2_UNITS * eps * point.chi2, fall_of_rounding))
        return (fall <= small) & jnp.isfinite(point.chi2)

    def iterate(state: LeafFitState) -> LeafFitState:
        point = evaluate(state.trial)
        is_better = point.chi2 < state.best.chi2
        best = jax.tree.map(partial(jnp.where, is_better), point, state.best)
        damping = jnp.where(is_better, jnp.maximum(0.1 * state.damping, _LEAST_DAMPING), 10.0 * state.damping)
        trial = jnp.clip(best.x + step(best, damping), low, high)
        return LeafFitState(best, trial, damping, state.n_steps + 1, has_converged(best))

    def continues(state: LeafFitState) -> Array:
        return ~state.converged & (state.n_steps < max_steps) & (state.damping < _LARGEST_DAMPING)

    # Chi-squared begins at infinity, so that the start, tried first, is accepted.
    zero, scalar_zero = jnp.zeros_like(start), jnp.zeros_like(rounding_floor)
    before_start = NormalEquations(
        start, jnp.full_like(rounding_floor, jnp.inf), scalar_zero, zero, jnp.outer(zero, zero)
    )
    initial = LeafFitState(
        before_start, start, jnp.asarray(damping, start.dtype), jnp.asarray(0), jnp.asarray(False)
    )
    return lax.while_loop(continues, iterate, initial)
