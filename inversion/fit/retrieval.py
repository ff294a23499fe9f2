"""Retrieval of scene properties from one record."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import PRNGKeyArray

from inversion.fit.data import as_noise, as_sample_times, with_fixed_window
from inversion.fit.fit_summary import CompletedFit, SummarySizes
from inversion.fit.implicit_differentiation import (
    DifferentiableFit,
    DifferentiatedModel,
    EstimateDerivatives,
    FitInputs,
    differentiable_retrieval,
    estimate_derivatives,
)
from inversion.fit.model import Evaluation, ForwardModel, SimulationInputs
from inversion.fit.planning import checked_plan, size_arguments
from inversion.fit.problem import BoundProblem, Problem, check_problem, scale_unknown
from inversion.fit.recorder_model import RecorderModel, recorder_unknowns
from inversion.fit.result import Retrieval, retrieval_of
from inversion.fit.solver import (
    EvaluationRequest,
    SolverSettings,
    fits_from_starts,
    key_of_starts,
    multistart,
    run_fits,
)
from inversion.fit.unknowns import bind_unknowns, smooth_names
from inversion.receiver.recorder import Recorder
from jaxlidar import Lidar, Scene, Waveform, trace_scene, waveform_of
from jaxlidar.extend import check_integer, check_key, check_kinds
from jaxlidar.progress import ProgressOption, shows_progress

# Programs have no sentences: `converged` alone tells how the fit ended.
_STATUS_IN_PROGRAM = "fitted within a compiled program, which has no words for the end of the fit"


@shows_progress
def retrieve(
    problem: Problem,
    *,
    key: PRNGKeyArray,
    max_steps: int = 50,
    starts: int = 1,
    progress: ProgressOption = None,
    throw: bool = False,
) -> Retrieval:
    """Retrieve the unknowns of a problem of one record, with standard errors, by nonlinear least squares.

    Least squares finds the nearest local minimum: a height must start within about a pulse length of the
    truth, else the fit may end in another echo. `starts` fits from several starting points.

    All simulations of a fit use the same random numbers, so that the waveform is a smooth function of the
    unknowns except for small jumps. If photons are traced at every step, a fit begins with a quarter of them,
    two of eight batches, and goes on with all once a step is below one standard error. It converges with all:
    values, errors and chi-squared come from them.

    The remaining noise of the simulation is estimated from its batches. It lowers the weight of the
    samples that it affects and is part of the standard errors. `Retrieval.simulation_error` gives that part;
    more photons lower it. Unknowns that act through optics only (leaf traits, reflectances, the atmosphere)
    cost next to nothing; if all unknowns are such, photons are traced once. Fits with equal shapes, plans and
    unknowns compile once.

    **Derivatives.** `values` and `scene` of the result have first derivatives, forward and reverse, with
    respect to `observed`, `noise`, and all numbers of lidar and scene that are not fitted: by the implicit
    function theorem, with the Gauss-Newton Hessian (`inversion.fit.implicit_differentiation`). Unknowns at a
    bound do not move. Noise of the simulation, `noise_floor`, priors and starts count as fixed.
    Make the problem within the function that is differentiated. Within `jax.jit` or `jax.vmap` the program
    calls the fit on the host: `status` cannot tell how it ended (use `throw`), and the problem needs a plan
    if its lidar, scene or times are traced.

    **Arguments:**

    - `problem`: a `Problem` of one record.
    - `key`: a JAX random key, other than that of a simulated record.
    - `max_steps`: most simulations, each with its Jacobian, from each start; no more than half of them are
      with few photons. Default 50.
    - `starts`: number of starting points; the best fit is returned. The first is that of the unknowns
      (`Unknown.start`), the others are a Latin hypercube over the bounds. Default 1.
    - `progress`: True for a bar with the latest step; or a function called with a `Step` after every trial,
      with few photons or all, and again when a descent starts anew, with new weights or strengths of priors.
      Default None: silent.
    - `throw`: raise RuntimeError if the fit does not converge. Default False: only `Retrieval.status` says
      so.

    **Returns:** a `Retrieval`.

    **Raises:** ValueError for a problem of many records or none, for inadmissible arguments, derivatives that
    would take more than `max_memory` one at a time, a lidar so far from x = y = 0 that its position is
    rounded by more than a millimetre, and second derivatives. TypeError for arguments of another kind.
    RuntimeError if `throw` is set and the fit does not converge.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> truth, start = jl.Scene(ground=jl.Ground(height=0.5)), jl.Scene(ground=jl.Ground())
    >>> wave = jl.simulate(jl.Lidar(), truth, key=jax.random.key(0))
    >>> height = inversion.Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0), name="height")
    >>> problem = inversion.Problem(wave, jl.Lidar(), start, [height], noise=0.001)
    >>> fit = inversion.retrieve(problem, key=jax.random.key(1))
    >>> print(f"{float(fit.values['height']):.3f} +- {float(fit.stderr['height']):.3f} m")
    0.500 +- 0.005 m
    """
    check_problem(problem)
    check_key(key)
    settings = solver_settings(max_steps, starts)
    inputs = FitInputs.of(problem, key)
    if not inputs.is_traced:
        fitted = fit_record(problem.bound, settings, key, progress=progress, throw=throw)
        return retrieval_of_record(problem.bound, fitted)

    key_kind = str(jax.random.key_impl(key))

    def stated(inputs: FitInputs) -> tuple[Problem, PRNGKeyArray]:
        # A problem whose numbers were traced is bound now that they are known.
        arrays = inputs._asdict()
        key = jax.random.wrap_key_data(arrays.pop("key_data"), impl=key_kind)
        return dataclasses.replace(problem, **arrays), key

    def fit(inputs: FitInputs) -> tuple[DifferentiableFit, DifferentiatedModel]:
        stated_problem, key = stated(inputs)
        return fit_with_derivatives(stated_problem, settings, key, progress=progress, throw=throw)

    def outline(inputs: FitInputs) -> tuple[DifferentiableFit, DifferentiatedModel]:
        # What is computed of known numbers is known, although a program is being traced.
        with jax.ensure_compile_time_eval():
            return outline_of_fit(*stated(inputs))

    return differentiable_retrieval(inputs, fit, outline)


class FittedRecord(NamedTuple):
    """The fit of one record, with the models of scene and recorder that it used."""

    fit: CompletedFit
    model: ForwardModel
    recorder: RecorderModel


def fit_record(
    problem: BoundProblem,
    settings: SolverSettings,
    key: PRNGKeyArray,
    *,
    progress: ProgressOption = None,
    throw: bool = False,
) -> FittedRecord:
    """Fit the record of a problem. **Raises:** RuntimeError with `throw`, if the fit does not converge."""
    model = ForwardModel(problem.lidars[0], problem.scenes[0], problem.plan, problem.unknowns[0], key)
    recorder = problem.recorder_model(0)
    fits = fits_from_starts(
        problem.observed[0], problem.unknowns[0], recorder, settings, key_of_starts(key), progress
    )

    def simulate(requests: Mapping[int, EvaluationRequest]) -> dict[int, Evaluation]:
        values, with_batches, pilot = requests[0]
        return {0: model(values, with_batches=with_batches, pilot=pilot)}

    ((_, fit),) = run_fits(iter([(0, multistart(fits))]), simulate, n_together=1)
    # Failure is a status of the result; it is raised only here, on request.
    if throw and not fit.summary.converged:
        raise RuntimeError(fit.summary.status)
    return FittedRecord(fit, model, recorder)


def fit_with_derivatives(
    problem: Problem,
    settings: SolverSettings,
    key: PRNGKeyArray,
    *,
    progress: ProgressOption = None,
    throw: bool = False,
) -> tuple[DifferentiableFit, DifferentiatedModel]:
    """Fit the record of a problem, with the derivatives of its estimates."""
    bound = problem.bound
    fitted = fit_record(bound, settings, key, progress=progress, throw=throw)
    fit, _, recorder = fitted
    stated_noise = as_noise(problem.noise, bound.observed[0].sigma.shape)
    derivatives = estimate_derivatives(bound.observed[0], stated_noise, bound.all_unknowns, recorder, fit)
    retrieval = retrieval_of_record(bound, fitted)
    model = DifferentiatedModel.of(bound.plan, bound.all_unknowns, len(bound.unknowns[0]), key)
    return DifferentiableFit.of(retrieval, fit.summary.values, derivatives), model


def outline_of_fit(problem: Problem, key: PRNGKeyArray) -> tuple[Any, DifferentiatedModel]:
    """Return the types of the arrays of `fit_with_derivatives`, and the model, for numbers that are traced.

    **Raises:** ValueError where lidar, scene or times are traced and no plan is given.
    """
    lidar, scene, plan = problem.lidar, problem.scene, problem.plan
    check_kinds(lidar, scene)
    assert isinstance(lidar, Lidar)
    assert isinstance(scene, Scene)
    # Starts decide no shape, and may be traced.
    started = [
        u if u.where is None else dataclasses.replace(u, start=0.5 * (u.bounds[0] + u.bounds[1]))
        for u in problem.unknowns
    ]
    unknowns = bind_unknowns(started, scene, lidar)
    time = problem.observed.time if isinstance(problem.observed, Waveform) else problem.time
    if plan is None:
        if any(isinstance(x, Tracer) for x in jax.tree.leaves((lidar, scene, time))):
            raise ValueError(
                "plan = None, but the lidar, the scene or the times of the samples are being traced by a JAX "
                "transformation, so that none can be made: make one outside and pass it as plan="
            )
        lidar = with_fixed_window(lidar)
        sizes = size_arguments(problem.n_photons, problem.n_rays, problem.max_orders, plan)
        plan = checked_plan(None, lidar, scene, unknowns, as_sample_times(time, lidar), sizes)
    recorder = Recorder() if problem.recorder is None else problem.recorder
    assert isinstance(recorder, Recorder)
    scale = [] if problem.scale is None else [scale_unknown(problem.scale, unknowns)]
    all_unknowns = [*unknowns, *recorder_unknowns(recorder), *scale]
    model = DifferentiatedModel.of(plan, all_unknowns, len(unknowns), key)

    def outline() -> DifferentiableFit:
        inputs = SimulationInputs(with_fixed_window(lidar), scene, plan, model.setters, 0)
        setup = inputs.setup(tuple(u.start for u in unknowns))
        n_unknowns, shape = sum(u.start.size for u in all_unknowns), (lidar.wavelength.size, plan.n_samples)
        waveform = waveform_of(trace_scene(setup, model.keys[0]), setup, stderr=jnp.zeros(shape))
        sizes = SummarySizes(n_unknowns, len(smooth_names(all_unknowns)), *shape)
        fit = CompletedFit.of_zeros(sizes, status=_STATUS_IN_PROGRAM)
        derivatives = EstimateDerivatives(*(jnp.zeros((n_unknowns, *shape)) for _ in range(3)))
        retrieval = retrieval_of(fit, all_unknowns, scene, waveform)
        return DifferentiableFit.of(retrieval, fit.summary.values, derivatives)

    # Shapes suffice: nothing is computed.
    return jax.eval_shape(outline), model


def retrieval_of_record(problem: BoundProblem, fitted: FittedRecord) -> Retrieval:
    """Return the result of a fit."""
    fit, model, recorder = fitted
    # The recorder's unknowns come last, and are none of the scene's.
    scene_values = fit.summary.values[: fit.summary.values.size - recorder.count]
    waveform = model.waveform(scene_values, fit.evaluation, fit.waveform_stderr)
    return retrieval_of(fit, problem.all_unknowns, model.scene_at(scene_values), waveform)


def solver_settings(max_steps: int, starts: int) -> SolverSettings:
    """Check the numbers of a fit. **Raises:** ValueError for inadmissible ones."""
    return SolverSettings(check_integer("max_steps", max_steps), check_integer("starts", starts))
