r"""Derivatives of a fit with respect to its data and its model, by the implicit function theorem.

**Formula.** A fit ends at the minimum over x of (`inversion.fit.solver`)

    1/2 |C^-1/2 (R w(x, t) - y)|^2 + 1/2 |q(x)|^2,

with w the simulated waveform, R the recorder, y the record, C the covariance of their difference, q the
priors as residuals, and t the numbers of lidar and scene that are not fitted. There the gradient with respect
to x is zero, whatever y, C and t are, so that with J = d(R w)/dx and r = R w - y

    dx = H^-1 J^T C^-1 (dy - R (dw/dt) dt + dC C^-1 r),   H = J^T C^-1 J + (Hessian of the priors).

dC is the change of C with the noise of the measurement. Unknowns that a bound holds at the minimum do not
move: their rows and columns are left out of H. Those that neither data nor priors determine stay where they
are.

**Gauss-Newton.** H, and the derivative of J^T C^-1 r by t, leave out the second derivatives of the simulation
times the residual r. These vanish where the model fits the record; with noise alone in r they are of the
order of (standard error) / (distance over which J changes), and zero in the mean. In return dx takes only
first derivatives, which are unbiased, where second ones of sampled paths would be far noisier; H is positive
definite, but for log-normal priors, whose Hessian is exact; and without priors (dx/dy) C (dx/dy)^T is the
covariance of the fit.

**Held fixed.** The noise of the simulation and of a recorded pulse, `noise_floor`, priors and their
strengths, and starting values: of these there are no derivatives.

**Transposition.** dx is linear in dy, in the change of sigma and in (dw/dt) dt. The last is the forward
derivative of a simulation with all batches, which JAX transposes as that of `jaxlidar.simulate`: so
`jax.grad` follows from the same rule as `jax.jvp`. The fit itself runs on the host, also within a compiled
program.

**Source:** Krantz and Parks (2013), The Implicit Function Theorem; Blondel et al. (2022), Efficient and
Modular Implicit Differentiation, NeurIPS 35.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, PRNGKeyArray

from inversion.fit.bounded_gauss_newton import at_bounds
from inversion.fit.data import ObservedWaveform, with_fixed_window
from inversion.fit.fit_summary import CompletedFit
from inversion.fit.model import SimulationInputs, Values, batch_keys
from inversion.fit.prior_residuals import PriorResiduals
from inversion.fit.recorder_model import RecorderModel
from inversion.fit.result import Retrieval
from inversion.fit.solver import fit_range
from inversion.fit.unknowns import BoundUnknown, Setter, flat_bounds, set_values, split_values
from jaxlidar import Plan, Waveform, total_reflectance, trace_scene
from jaxlidar.extend import side_by_side, tensordot

# Added to the diagonal of H in widths of the bounds, as a fraction of its trace: undetermined unknowns stay
# where they are.
_RIDGE = 1e-13


class FitInputs(NamedTuple):
    """Numbers of a `Problem`, and of a key, that JAX may be tracing. The last two have no derivatives.

    `key_data`: of the random key, which programs cannot hand to the host as it is.
    """

    observed: Any
    noise: Any
    lidar: Any
    scene: Any
    time: Any
    key_data: Any

    @staticmethod
    def of(problem: Any, key: PRNGKeyArray) -> "FitInputs":
        """Return those of a `Problem` and a key."""
        numbers = (problem.observed, problem.noise, problem.lidar, problem.scene, problem.time)
        return FitInputs(*numbers, jax.random.key_data(key))

    @property
    def is_traced(self) -> bool:
        """True if JAX is tracing any of the arrays."""
        return any(isinstance(x, Tracer) for x in jax.tree.leaves(self))


class EstimateDerivatives(NamedTuple):
    """Derivatives of the flattened estimates, each (unknowns, wavelengths, bins).

    - `by_record`: with respect to the samples of the record. `by_noise`: to their standard deviations.
    - `by_reflectance`: to the simulated reflectance at fixed values of the unknowns, before the recorder.
    """

    by_record: Any
    by_noise: Any
    by_reflectance: Any


def estimate_derivatives(
    observed: ObservedWaveform,
    stated_noise: Float[np.ndarray, "wavelengths bins"],
    unknowns: Sequence[BoundUnknown],
    recorder: RecorderModel,
    fit: CompletedFit,
) -> EstimateDerivatives:
    """Compute the derivatives of the estimates at the end of a fit.

    1. J at the estimates, with the columns of the recorder's unknowns; H of the unknowns that no bound holds.
    2. The gain A = H^-1 J^T C^-1 is the derivative by the record.
    3. That by the simulated reflectance is -A R.
    4. C is S (R' + B B^T) S with S = diag(sigma) and S B fixed, R' the correlation. With u = C^-1 r, the
       derivative by sigma_j is A_j (R' S u)_j + (A S R')_j u_j.

    **Arguments:** `stated_noise`: of the record, before it is raised to the floor. `unknowns`: of the scene,
    then those of the recorder.
    """
    is_fitted, noise, evaluation = observed.is_fitted, fit.noise, fit.evaluation
    values, difference = fit.summary.values, fit.difference
    recorder_values = values[values.size - recorder.count :]
    _, jacobian = recorder(evaluation.reflectance, evaluation.jacobian, recorder_values)
    jacobian = jacobian[is_fitted]
    priors = PriorResiduals(unknowns)
    priors.set_strengths(fit.summary.strength)
    prior_residual, prior_jacobian = priors(values)
    low, high = flat_bounds(unknowns)
    is_held = at_bounds(
        values,
        np.append(noise.whiten(difference), prior_residual),
        np.concatenate([noise.whiten(jacobian), prior_jacobian]),
        *fit_range(low, high),
    ).held
    moves, width = np.flatnonzero(~is_held), (high - low)[~is_held]
    # In widths of the bounds, so that the ridge compares unknowns of different units.
    columns = jacobian[:, moves] * width
    weighted = noise.times_precision(columns)
    hessian = columns.T @ weighted + priors.hessian(values)[np.ix_(moves, moves)] * np.outer(width, width)
    hessian += _RIDGE * max(np.trace(hessian), 1e-300) * np.eye(width.size)
    gain = np.zeros((values.size, difference.size))
    gain[moves] = width[:, None] * np.linalg.solve(hessian, weighted.T)

    def in_record(derivatives: np.ndarray) -> np.ndarray:
        # Samples that are left out have no effect.
        result = np.zeros((values.size, *is_fitted.shape))
        result[:, is_fitted] = derivatives
        return result

    by_record = in_record(gain)
    # Row j: the record of a unit of reflectance in sample j.
    responses = recorder.received(np.eye(is_fitted.shape[1]), recorder_values)
    sigma, weighted_difference = noise.sigma_unshared, noise.times_precision(difference)
    correlation = np.eye(sigma.size) if noise.correlation is None else noise.correlation
    by_sigma = gain * (correlation @ (sigma * weighted_difference))
    by_sigma += ((gain * sigma) @ correlation) * weighted_difference
    # sigma is that of the record and of the simulation together.
    is_stated = (stated_noise >= observed.sigma)[is_fitted]
    by_noise = by_sigma * np.where(is_stated, observed.sigma[is_fitted] / sigma, 0.0)
    return EstimateDerivatives(by_record, in_record(by_noise), -by_record @ responses.T)


class DifferentiableFit(NamedTuple):
    """A fit with the derivatives of its estimates.

    - `retrieval`: result of the fit, without the scene. - `values`: (unknowns,) estimates, flattened.
    - `derivatives`: of the estimates.
    """

    retrieval: Retrieval
    values: Any
    derivatives: EstimateDerivatives

    @staticmethod
    def of(
        retrieval: Retrieval, values: Float[np.ndarray, " n"], derivatives: EstimateDerivatives
    ) -> "DifferentiableFit":
        """Return a result with its derivatives, all in JAX's precision."""
        without_scene = eqx.tree_at(lambda r: r.scene, retrieval, None)
        return DifferentiableFit(*jax.tree.map(jnp.asarray, (without_scene, values, derivatives)))


class DifferentiatedModel(NamedTuple):
    """The simulation of a fit, except what JAX may be tracing, and the names and shapes of all unknowns.

    - `plan`, `setters`: of simulations. - `keys`: random keys of the batches.
    - `names`, `shapes`: of the unknowns of the scene, then of those of the recorder.
    """

    plan: Plan
    setters: tuple[Setter, ...]
    keys: Array
    names: tuple[str, ...]
    shapes: tuple[tuple[int, ...], ...]

    @staticmethod
    def of(plan: Plan, unknowns: Sequence[BoundUnknown], n_setters: int, key: PRNGKeyArray):
        """Return the model of unknowns, of which the first `n_setters` are of the scene."""
        return DifferentiatedModel(
            plan,
            tuple(u.setter for u in unknowns[:n_setters]),
            jnp.stack(batch_keys(plan, key)),
            tuple(u.name for u in unknowns),
            tuple(u.start.shape for u in unknowns),
        )


@eqx.filter_jit
def _mean_reflectance(
    inputs: SimulationInputs, values: Values, keys: Array
) -> Float[Array, "wavelengths bins"]:
    """Simulate the mean reflectance of all batches, for forward and reverse derivatives."""
    setup = inputs.setup(values)

    def add_batch(total: Array, key: PRNGKeyArray) -> tuple[Array, None]:
        return total + total_reflectance(trace_scene(setup, key), setup), None

    shape = jax.eval_shape(lambda: total_reflectance(trace_scene(setup, keys[0]), setup))
    # Reverse mode traces a batch again, and keeps the intermediate values of one at a time.
    total, _ = jax.lax.scan(jax.checkpoint(add_batch), jnp.zeros(shape.shape, shape.dtype), keys)
    return total / len(keys)


def differentiable_retrieval(
    inputs: FitInputs,
    fit: Callable[[FitInputs], tuple[DifferentiableFit, DifferentiatedModel]],
    outline: Callable[[FitInputs], tuple[DifferentiableFit, DifferentiatedModel]],
) -> Retrieval:
    """Fit a record of arrays that JAX is tracing. Values and scene of the result have derivatives.

    1. Where derivatives alone are traced (`jax.grad`, `jax.jvp`), the arrays themselves are known, and are
       fitted as usual. Within a compiled program, the program calls the fit as it runs.
    2. The tangent of the values follows from the formula of the module.
    3. The fitted scene is made of the traced one and these values.

    **Arguments:**

    - `fit`: fits inputs of which none is traced.
    - `outline`: gives the types of the result of `fit`, and the model, for inputs that are traced.
    """
    traced, known = eqx.partition(inputs, lambda x: isinstance(x, Tracer))
    leaves, structure = jax.tree.flatten(traced)
    # The field of the inputs to which each leaf belongs.
    fields = [name for name in FitInputs._fields for _ in jax.tree.leaves(getattr(traced, name))]
    model: DifferentiatedModel | None = None

    def inputs_of(leaves: Sequence[Any]) -> FitInputs:
        return eqx.combine(jax.tree.unflatten(structure, leaves), known)

    def solve(leaves: Sequence[Any]) -> DifferentiableFit:
        nonlocal model

        def fit_on_host(*leaves: Any) -> list[np.ndarray]:
            # Arrays that a program passes on lie on the host; the fit may place them anew.
            completed = fit(inputs_of([jnp.asarray(np.asarray(a)) for a in leaves]))[0]
            return [np.asarray(a) for a in jax.tree.leaves(completed)]

        # What a program computes of known numbers is traced as well.
        if not (isinstance(jnp.zeros(()), Tracer) or any(isinstance(x, Tracer) for x in leaves)):
            completed, model = _untraced(fit, inputs_of(leaves))
            return completed
        outlined, model = outline(inputs_of(leaves))
        types, outline_structure = jax.tree.flatten(outlined)
        arrays = jax.pure_callback(fit_on_host, types, *leaves, vmap_method="sequential")
        return jax.tree.unflatten(outline_structure, arrays)

    def values_of(solved: DifferentiableFit) -> Values:
        assert model is not None
        return split_values(solved.values, model.shapes)

    def tangent_of_values(
        leaves: Sequence[Any], tangents: Sequence[Any], solved: DifferentiableFit
    ) -> Float[Array, " n"]:
        """Return dx, the sum of what record, noise and simulation add."""
        assert model is not None
        derivatives = solved.derivatives
        shape = derivatives.by_record.shape[1:]
        # A list: programs may be asked for derivatives by none of these.
        terms = [jnp.zeros_like(solved.values)]

        def record(inputs: FitInputs) -> Array:
            observed = inputs.observed
            return _as_array(observed.reflectance if isinstance(observed, Waveform) else observed, shape)

        def simulated(inputs: FitInputs) -> Array:
            assert model is not None
            lidar = with_fixed_window(inputs.lidar)
            simulation = SimulationInputs(lidar, inputs.scene, model.plan, model.setters, 0).with_room()
            return _mean_reflectance(simulation, values_of(solved)[: len(model.setters)], model.keys)

        for derivative, function, names in (
            (derivatives.by_record, record, ("observed",)),
            (derivatives.by_noise, lambda inputs: _as_array(inputs.noise, shape), ("noise",)),
            (derivatives.by_reflectance, simulated, ("lidar", "scene")),
        ):
            varying = [
                i
                for i, (a, t, name) in enumerate(zip(leaves, tangents, fields))
                if name in names
                and not isinstance(t, SymbolicZero)
                and jnp.issubdtype(jnp.result_type(a), jnp.inexact)
            ]
            if not varying:
                continue

            def of_varying(
                values: list[Any], function: Callable = function, varying: list[int] = varying
            ) -> Array:
                by_number = dict(zip(varying, values))
                return function(inputs_of([by_number.get(i, a) for i, a in enumerate(leaves)]))

            primals, pushed = [leaves[i] for i in varying], [tangents[i] for i in varying]
            terms.append(tensordot(derivative, jax.jvp(of_varying, (primals,), (pushed,))[1], 2))
        return sum(terms[1:], terms[0])

    @jax.custom_jvp
    def solution(leaves: list[Any]) -> DifferentiableFit:
        return solve(leaves)

    def push_forward(primals: tuple[list[Any]], tangents: tuple[list[Any]]) -> tuple[Any, Any]:
        # Not `solution`: its other results have no derivatives, so that second ones would be wrong. JAX
        # refuses to differentiate the call of the fit.
        solved = solve(primals[0])
        tangent = eqx.tree_at(
            lambda fit: fit.values,
            jax.tree.map(_zero_tangent, solved),
            tangent_of_values(primals[0], tangents[0], solved),
        )
        return solved, tangent

    solution.defjvp(push_forward, symbolic_zeros=True)
    solved = solution(leaves)
    assert model is not None
    values = values_of(solved)
    # JAX returns what has no derivative as arrays of NumPy.
    return dataclasses.replace(
        jax.tree.map(jnp.asarray, solved.retrieval),
        values=dict(zip(model.names, values)),
        scene=set_values(inputs.scene, model.setters, values[: len(model.setters)]),
    )


def _untraced(fit: Callable[[FitInputs], Any], inputs: FitInputs) -> Any:
    """Return `fit(inputs)`, of whose constants JAX traces none."""
    # While `jax.vjp` linearises a function, it traces what is converted to an array, whatever is asked of it.
    # Traces are those of a thread.
    with side_by_side(1) as run:
        (completed,) = run(fit, [inputs])
    return completed


def _as_array(x: Any, shape: tuple[int, ...]) -> Array:
    # A record of one wavelength may lack its axis.
    return jnp.broadcast_to(jnp.asarray(x, float), shape)


def _zero_tangent(x: Any) -> Any:
    is_real = jnp.issubdtype(x.dtype, jnp.inexact)
    return jnp.zeros_like(x) if is_real else np.zeros(x.shape, jax.dtypes.float0)
