r"""Nonlinear least squares within bounds: a Gauss-Newton method of optimistix.

**Step.** With residuals r, their Jacobian J and the widths w of the bounds, the next trial is y + s with

    s = argmin |r + J s|^2 + d |s / w|^2   within the bounds, and |s / w| <= t.

This is bounded-variable least squares (Stark and Parker 1995, Comput. Stat. 10, 129). A step that is clipped
at the bounds need not lower the residuals if unknowns are correlated, and a bijection of the bounded unknowns
onto unbounded ones would be flat at the bounds: a fit that came near one would hardly leave it again.

- The damping d begins with 0.01, an error of ten widths of the bounds, and falls to a quarter with each
  accepted step. It holds unknowns that the data do not determine until the others have found their place.
- The half-width t of the trust region shrinks to a quarter of a rejected step, and grows fourfold with an
  accepted one, up to 0.4: residuals are linear only nearby.
- A step is accepted if the cost falls by more than a hundredth of what the linearised residuals promise.

**End.** The length of the Gauss-Newton step within the bounds alone, without damping and trust region, is the
root of the fall of |r|^2 that it promises. For residuals of unit variance these are standard errors of the
unknowns (Newton decrement). The method has converged if it is below a limit, which grows with the number of
steps rejected in a row: where residuals are noisy, no step improves the fit any more near the minimum. After
rejected steps the unit is the standard error that includes misfit. If more steps were rejected than there are
limits, although the length promises an improvement, the Jacobian is wrong, and the method fails.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jaxlidar.extend import matmul

# Largest half-width of the trust region, and its factor after a rejected step.
_MAX_RADIUS, _CUT = 0.4, 0.25
# Damping of the first step.
_DAMPING = 0.01
# Least fall of the cost of an accepted step, as a fraction of the predicted one.
_LEAST_GAIN = 0.01
# Added to the diagonal of the information, over its trace and the rounding of a number: undetermined unknowns
# stay where they are.
_RIDGE = 500.0
# Rounding of a gradient, over that of a number and the sizes of its terms; most changes of the set of free
# elements, over their number.
_ROUNDING, _MAX_CHANGES = 10.0, 10
# An unknown closer to a bound than this fraction of the bounds' width is at it: steps are rounded.
_AT_BOUND = 1e-6
# Keeps the trust region open after a rejected step of length zero.
_SMALLEST_RADIUS = 1e-12


def bounded_step(
    jacobian: Float[Array, "data n"],
    residual: Float[Array, " data"],
    low: Float[Array, " n"],
    high: Float[Array, " n"],
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Return the step within bounds that minimises the linearised residuals, and the fall of the cost."""
    width = high - low
    scaled = jacobian * width[None]
    # Normal equations: there are far more samples than unknowns.
    information = matmul(scaled.T, scaled)
    # The floor lets the decomposition succeed for a Jacobian of zeros: then the step is zero.
    tiny = jnp.finfo(information.dtype).tiny
    ridge = _RIDGE * jnp.finfo(information.dtype).eps * jnp.trace(information)
    information += jnp.maximum(ridge, jnp.sqrt(tiny)) * jnp.eye(width.size)
    gradient = matmul(scaled.T, residual)
    step = width * minimum_in_box(information, gradient, low / width, high / width)
    # The problem itself, without the ridge.
    return step, jnp.sum(residual**2) - jnp.sum((residual + matmul(jacobian, step)) ** 2)


def minimum_in_box(
    hessian: Float[Array, "n n"],
    gradient: Float[Array, " n"],
    low: Float[Array, " n"],
    high: Float[Array, " n"],
) -> Float[Array, " n"]:
    """Return x that minimises x^T H x / 2 + g^T x between bounds about zero, by an active-set method.

    1. Solve for the free elements, with the others at their bounds. At first all are free, and x = 0.
    2. If the solution leaves the bounds, go towards it to the first bound, and hold that element there.
    3. Else free the element at a bound whose gradient leads inwards most, or end if there is none.

    Values end exactly at their bounds; those of interior methods only come near them.
    """
    # Gradients below this are rounding.
    scale = jnp.abs(gradient) + matmul(jnp.abs(hessian), jnp.maximum(-low, high))
    rounding = _ROUNDING * jnp.finfo(gradient.dtype).eps * scale

    def go_on(carry: tuple[Array, Array, Array, Array]) -> Array:
        _, _, is_done, n = carry
        return ~is_done & (n < _MAX_CHANGES * gradient.size)

    def change(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        x, is_free, _, n = carry
        of_free = is_free[:, None] & is_free[None]
        held = jnp.where(is_free, 0.0, x)
        factor = jax.scipy.linalg.cho_factor(jnp.where(of_free, hessian, jnp.eye(x.size)))
        target = jnp.where(is_free, -(gradient + matmul(hessian, held)), held)
        solution = jnp.where(is_free, jax.scipy.linalg.cho_solve(factor, target), x)
        step = solution - x
        to_bound = jnp.where(step > 0, high - x, low - x)
        is_beyond = is_free & (jnp.abs(step) > jnp.abs(to_bound))
        fraction = jnp.where(is_beyond, to_bound / jnp.where(is_beyond, step, 1.0), 1.0)
        leaves, first = jnp.any(is_beyond), jnp.argmin(fraction)
        bound = jnp.where(step[first] > 0, high[first], low[first])
        at_bound = (x + fraction[first] * step).at[first].set(bound)
        slope = gradient + matmul(hessian, solution)
        inwards = jnp.where(is_free, 0.0, jnp.where(x <= low, -slope, slope)) - rounding
        freed = jnp.argmax(inwards)
        is_done = ~leaves & (inwards[freed] <= 0)
        x = jnp.where(leaves, at_bound, solution)
        is_free = jnp.where(leaves, is_free.at[first].set(False), is_free.at[freed].set(True))
        return x, is_free, is_done, n + 1

    start = jnp.zeros_like(gradient), jnp.ones(gradient.shape, bool), jnp.zeros((), bool), jnp.zeros((), int)
    return jax.lax.while_loop(go_on, change, start)[0]


class AtBounds(NamedTuple):
    """Unknowns at a bound, (n,) each: those that the minimum within bounds has there as well, and the others.

    The gradient of the others points inwards by more than a converged fit admits: the linearised cost falls
    by more than the square of `BoundedGaussNewton.atol` where they leave their bound.
    """

    held: Bool[np.ndarray, " n"]
    leaving: Bool[np.ndarray, " n"]


def at_bounds(
    values: Float[np.ndarray, " n"],
    residual: Float[np.ndarray, " data"],
    jacobian: Float[np.ndarray, "data n"],
    lower: Float[np.ndarray, " n"],
    upper: Float[np.ndarray, " n"],
) -> AtBounds:
    """Find unknowns at a bound, by the step to the minimum of the linearised cost within bounds."""
    end = _AT_BOUND * (upper - lower)
    is_at_end = (values < lower + end) | (values > upper - end)
    if not np.any(is_at_end):
        return AtBounds(is_at_end, is_at_end)
    with jax.enable_x64(True):
        step, fall = _compiled_bounded_step(
            *map(jnp.asarray, (jacobian, residual, lower - values, upper - values))
        )
        is_held = np.abs(np.asarray(step)) < end
        leaving = is_at_end & ~is_held
        # The cost falls by what others move, too: by how much less does it where these stay?
        ends = (jnp.asarray(np.where(leaving, 0.0, bound - values)) for bound in (lower, upper))
        _, fall_of_others = _compiled_bounded_step(jnp.asarray(jacobian), jnp.asarray(residual), *ends)
    falls = float(fall) - float(fall_of_others) > BoundedGaussNewton.atol**2
    return AtBounds(is_at_end & is_held, leaving & falls)


_compiled_bounded_step = jax.jit(bounded_step)


class _State(eqx.Module):
    """State of the method.

    - `y`, `y_eval`: the accepted point, and the next trial.
    - `aux`, `residual`, `jacobian`, `cost`: at the accepted point; the cost is |residual|^2.
    - `predicted_fall`: of the cost, at the trial.
    - `length`: of the Gauss-Newton step within the bounds.
    - `damping`, `radius`: of the trial, in widths of the bounds.
    - `n_rejected`: trials that were rejected in a row.
    """

    y: Float[Array, " n"]
    y_eval: Float[Array, " n"]
    aux: Any
    residual: Float[Array, " data"]
    jacobian: Float[Array, "data n"]
    cost: Float[Array, ""]
    predicted_fall: Float[Array, ""]
    length: Float[Array, ""]
    damping: Float[Array, ""]
    radius: Float[Array, ""]
    n_rejected: Int[Array, ""]


class BoundedGaussNewton(optx.AbstractLeastSquaresSolver):
    """Damped Gauss-Newton steps within bounds: see the module.

    `optimistix.least_squares` runs it, with y a vector and the options "lower" and "upper", finite bounds of
    the same shape. Residuals that are not finite reject a step.

    - `atol`: largest length of a step at which the method has converged. Default 0.05.
    - `limits`: the same after 1, 2, 3 ... rejected steps in a row. Default 0.3 (1 and 2), 0.6 (3 to 7), 1
      (8).
    - `rtol`: the same after rejected steps, in units of the misfit. Default 0.05.
    - `norm`: that of a length. It is the root of a sum of squares.
    """

    atol: float = 0.05
    limits: tuple[float, ...] = (0.3, 0.3, 0.6, 0.6, 0.6, 0.6, 0.6, 1.0)
    rtol: float = 0.05
    norm: Callable[[Any], Any] = optx.two_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """Return the state before the first evaluation, which is at `y` itself."""
        del fn, args, options, tags
        zero = jnp.zeros((), y.dtype)
        return _State(
            y=y,
            y_eval=y,
            aux=jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), aux_struct),
            residual=jnp.zeros(f_struct.shape, f_struct.dtype),
            jacobian=jnp.zeros((*f_struct.shape, y.size), f_struct.dtype),
            cost=zero + jnp.inf,
            predicted_fall=zero,
            length=zero + jnp.inf,
            # The first point is accepted, which makes it that of the first step.
            damping=zero + _DAMPING / _CUT,
            radius=zero + _MAX_RADIUS,
            n_rejected=jnp.zeros((), int),
        )

    def step(self, fn, y, args, options, state: _State, tags) -> tuple[Any, _State, Any]:
        """Evaluate the trial, accept or reject it, and find the next one."""
        del tags
        width = options["upper"] - options["lower"]
        residual, push, aux = jax.linearize(lambda y: fn(y, args), state.y_eval, has_aux=True)
        jacobian = jax.vmap(push, out_axes=-1)(jnp.eye(y.size, dtype=y.dtype))
        cost = jnp.sum(residual**2)
        gain = state.cost - cost
        accept = jnp.isfinite(cost) & jnp.all(jnp.isfinite(jacobian))
        accept = accept & (gain > _LEAST_GAIN * state.predicted_fall)
        rejected_step = jnp.max(jnp.abs(state.y_eval - y) / width)
        y, aux, residual, jacobian, cost = jax.tree.map(
            lambda new, old: jnp.where(accept, new, old),
            (state.y_eval, aux, residual, jacobian, cost),
            (y, state.aux, state.residual, state.jacobian, state.cost),
        )
        damping = jnp.where(accept, _CUT * state.damping, state.damping)
        radius = jnp.where(accept, jnp.minimum(_MAX_RADIUS, state.radius / _CUT), _CUT * rejected_step)
        low, high = options["lower"] - y, options["upper"] - y
        # There is no step from a first point that is not finite.
        length = jnp.where(
            jnp.isfinite(cost),
            jnp.sqrt(jnp.maximum(bounded_step(jacobian, residual, low, high)[1], 0.0)),
            jnp.inf,
        )
        reach = jnp.maximum(radius, _SMALLEST_RADIUS) * width
        damped_jacobian = jnp.concatenate([jacobian, jnp.diag(jnp.sqrt(damping) / width)])
        damped_residual = jnp.concatenate([residual, jnp.zeros_like(y)])
        step, _ = bounded_step(
            damped_jacobian, damped_residual, jnp.maximum(low, -reach), jnp.minimum(high, reach)
        )
        predicted_fall = cost - jnp.sum((residual + matmul(jacobian, step)) ** 2)
        y_eval = jnp.clip(y + step, options["lower"], options["upper"])
        n_rejected = jnp.where(accept, 0, state.n_rejected + 1)
        state = _State(
            y, y_eval, aux, residual, jacobian, cost, predicted_fall, length, damping, radius, n_rejected
        )
        return y, state, aux

    def terminate(self, fn, y, args, options, state: _State, tags) -> tuple[Array, Any]:
        """Return True at the end; the result is `nonlinear_divergence` if no step improves the fit."""
        del fn, y, args, options, tags
        degrees_of_freedom = max(state.residual.size - 2 * state.y_eval.size, 1)
        misfit = jnp.sqrt(jnp.maximum(state.cost / degrees_of_freedom, 1.0))
        n_limits = len(self.limits)
        limit = jnp.asarray((self.atol, *self.limits))[jnp.minimum(state.n_rejected, n_limits)]
        # With misfit, errors are larger than the stated ones. Not before a step was rejected: far from the
        # solution, where residuals are large, short steps may lead to it.
        limit = jnp.where(state.n_rejected > 0, jnp.maximum(limit, self.rtol * misfit), limit)
        converged = state.length < limit
        failed = ~converged & (state.n_rejected > n_limits)
        result = optx.RESULTS.where(failed, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful)
        return converged | failed, result

    def postprocess(self, fn, y, aux, args, options, state: _State, tags, result):
        """Return the accepted point, with the length of a Gauss-Newton step from it."""
        del fn, args, options, tags, result
        return y, aux, {"length": state.length}


# -- one step after the other, with evaluations from elsewhere


class Advance(NamedTuple):
    """The method after one more evaluation: its state, and how it ended if it has.

    - `accepted`: True if the trial was.
    - `trial`: where to evaluate next.
    - `terminated`, `successful`: True if the method has ended, and with success.
    """

    state: _State
    accepted: bool
    trial: Float[np.ndarray, " n"]
    terminated: bool
    successful: bool


def advance(
    solver: BoundedGaussNewton,
    state: _State | None,
    trial: Float[np.ndarray, " n"],
    residual: Float[np.ndarray, " data"],
    jacobian: Float[np.ndarray, "data n"],
    bounds: tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]],
) -> Advance:
    """Accept or reject a trial whose residual and Jacobian are known, in double precision.

    `state`: None to begin at the trial.
    """
    with jax.enable_x64(True):
        evaluation = tuple(map(jnp.asarray, (trial, residual, jacobian)))
        options = {"lower": jnp.asarray(bounds[0]), "upper": jnp.asarray(bounds[1])}
        if state is None:
            y, struct = evaluation[0], jax.ShapeDtypeStruct(residual.shape, evaluation[1].dtype)
            state = solver.init(_linear_residual, y, evaluation, options, struct, None, frozenset())
        end: _State
        end, terminated, successful = _advance(solver, state, evaluation, options)
        is_accepted, trial = int(end.n_rejected) == 0, np.asarray(end.y_eval)
        return Advance(end, is_accepted, trial, bool(terminated), bool(successful))


def _linear_residual(y: Array, evaluation: tuple[Array, Array, Array]) -> tuple[Array, None]:
    # optimistix differentiates its function itself. Given residuals that are linear about the trial, it takes
    # them as data, and one program serves all fits of equal shapes.
    trial, residual, jacobian = evaluation
    return residual + matmul(jacobian, y - trial), None


@eqx.filter_jit
def _advance(solver: BoundedGaussNewton, state: _State, evaluation: Any, options: dict[str, Array]) -> Any:
    arguments = evaluation, options
    y, state, _ = solver.step(_linear_residual, state.y, *arguments, state, frozenset())
    terminated, result = solver.terminate(_linear_residual, y, *arguments, state, frozenset())
    return state, terminated, result == optx.RESULTS.successful
