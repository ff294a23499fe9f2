"""Retrieval of scene properties from one waveform."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.core import Tracer
from jaxtyping import ArrayLike, PRNGKeyArray

from inversion.fit.data import (
    ObservedWaveform,
    as_noise,
    as_observed,
    as_sample_times,
    with_fixed_window,
)
from inversion.fit.fit_summary import CompletedFit, Step, SummarySizes
from inversion.fit.implicit_differentiation import (
    DifferentiableFit,
    DifferentiatedModel,
    EstimateDerivatives,
    FitInputs,
    differentiable_retrieval,
    estimate_derivatives,
)
from inversion.fit.model import ForwardModel, SimulationInputs
from inversion.fit.planning import TraceSizes, checked_plan, trace_sizes
from inversion.fit.recorder_model import RecorderModel, check_names, recorder_unknowns
from inversion.fit.result import Retrieval, retrieval_of
from inversion.fit.solver import (
    DEFAULT_SOLVER,
    EvaluationRequest,
    SolverSettings,
    fits_from_starts,
    key_of_starts,
    multistart,
    run_fit,
)
from inversion.fit.unknowns import BoundUnknown, Setter, Unknown, bind_unknowns, smooth_names
from inversion.receiver.recorder import Recorder
from jaxlidar import Lidar, Plan, Scene, Waveform, trace_scene, waveform_of
from jaxlidar.extend import check_integer, check_key, check_kind, check_kinds, check_range

# Programs have no sentences; neither do they have a status.
_STATUS_IN_PROGRAM = "fitted within a compiled program, which does not tell how the fit ended"


@dataclasses.dataclass(frozen=True)
class FitProblem:
    """The fit of one waveform.

    - `observed`: the waveform with its noise.
    - `lidar`, `scene`: instrument, and scene at the starting values.
    - `unknowns`: of the scene, bound to it.
    - `scale`: the unknown "scale", or empty.
    - `recorder`: receiver and digitisers, or None.
    - `settings`: solver, steps and starts.
    """

    observed: ObservedWaveform
    lidar: Lidar
    scene: Scene
    unknowns: list[BoundUnknown]
    scale: list[BoundUnknown]
    recorder: Recorder | None
    settings: SolverSettings


def retrieve(
    observed: Waveform | ArrayLike | Sequence,
    lidar: Lidar,
    scene: Scene,
    unknowns: Sequence[Unknown],
    *,
    noise: ArrayLike | Sequence,
    key: PRNGKeyArray,
    time: ArrayLike | Sequence | None = None,
    plan: Plan | None = None,
    n_photons: float | None = None,
    n_rays: float | None = None,
    max_orders: int | None = None,
    solver: optx.AbstractLeastSquaresSolver = DEFAULT_SOLVER,
    max_steps: float = 50,
    starts: float = 1,
    scale: tuple[float, float] | None = None,
    recorder: Recorder | None = None,
    noise_floor: float = 1e-3,
    progress: Callable[[Step], None] | None = None,
    throw: bool = False,
) -> Retrieval:
    """Retrieve unknowns of a scene from one waveform, with standard errors, by nonlinear least squares.

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
    Within `jax.jit` or `jax.vmap` the program calls the fit on the host: `status` cannot tell how it ended
    (use `throw`), and a plan is needed if lidar, scene or times are traced.

    **Arguments:**

    - `observed`: a `Waveform`, whose `reflectance` is fitted, or an array (wavelengths, bins) of apparent
      reflectance with `time`, or in any other unit with `scale`.
    - `lidar`: the instrument.
    - `scene`: the scene at the starting values.
    - `unknowns`: what to retrieve, one `Unknown` or more. Every scene within the bounds must be admissible: a
      sum of reflectance and transmittance above one, for instance, is not noticed.
    - `noise`: one standard deviation of `observed`, in [0, inf], anything that broadcasts to it. Samples are
      taken as independent unless `recorder` says otherwise. Infinity leaves a sample out.
    - `key`: a JAX random key, other than that of a simulated `observed`.
    - `time`: (bins,) ns, needed if `observed` is an array. Times must lie the lidar's sampling interval
      apart. Default None: those of the `Waveform`.
    - `plan`: what to simulate (`jaxlidar.plan`, with the window of `observed`, valid throughout the bounds),
      with the photons and rays of one of eight batches. Derivatives are computed in groups if all at once
      would take more memory than its `max_memory`. Default None: planned for the start and the corners of
      the bounds.
    - `n_photons`: photons of one simulation, all eight batches together, at least 8. Default None: 65536, or
      those of `plan`.
    - `n_rays`: rays of the footprint of one simulation, all eight batches together, at least 8. Default None:
      8192, or those of `plan`.
    - `max_orders`: orders of scattering. Default None: chosen by the albedos of the starting scene.
    - `solver`: a Gauss-Newton method of optimistix. A step that leaves the bounds is replaced by the minimum
      of the linearised problem within them. Default: Levenberg-Marquardt. A fit also ends if a Gauss-Newton
      step within the bounds would be below 0.05 standard errors, or if small steps no longer improve it. With
      a `Smooth` prior, only the default is admissible: all steps are then solved within the bounds.
    - `max_steps`: most simulations, each with its Jacobian, from each start; no more than half of them are
      with few photons. Default 50.
    - `starts`: number of starting points; the best fit is returned. The first is that of the unknowns
      (`Unknown.start`), the others are a Latin hypercube over the bounds. Default 1.
    - `scale`: (low, high), bounds of a further unknown, "scale", which multiplies the simulated reflectance,
      the same for all wavelengths (the gain, or calibration factor, of an uncalibrated receiver). It starts
      from its least-squares value. Default None: no such unknown.
    - `recorder`: what the recorder adds, a `Recorder`: its receiver's response, offsets of its digitisers,
      and the noise of the recorded pulse. Default None: nothing.
    - `noise_floor`: fraction of each wavelength's largest observed value (with offsets of a `recorder`, above
      the median), 0 to 1, that replaces any smaller `noise`: a record without noise would give bins that no
      photon reached, where the simulation's standard error is zero, infinite weight. Default 1e-3.
    - `progress`: called with a `Step` after every trial, with few photons or all, and again when a descent
      starts anew, with new weights or strengths of priors; for instance `print`.
    - `throw`: raise RuntimeError if the fit does not converge. Default False: only `Retrieval.status` says
      so.

    **Returns:** a `Retrieval`.

    **Raises:** ValueError for inadmissible arguments, among them a start outside its bounds, samples that do
    not fit the lidar or the plan, a plan that does not serve all scenes within the bounds or that is given
    together with photons, rays or orders, derivatives that would take more than `max_memory` one at a time,
    noise that is negative or NaN, a lidar so far from x = y = 0 that its position is rounded by more than
    a millimetre, and second derivatives. TypeError for arguments of another kind.
    RuntimeError if `throw` is set and the fit does not converge.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> truth, start = jl.Scene(ground=jl.Ground(height=0.5)), jl.Scene(ground=jl.Ground())
    >>> wave = jl.simulate(jl.Lidar(), truth, key=jax.random.key(0))
    >>> height = inversion.Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0), name="height")
    >>> fit = inversion.retrieve(wave, jl.Lidar(), start, [height], noise=0.001, key=jax.random.key(1))
    >>> print(f"{float(fit.values['height']):.3f} +- {float(fit.stderr['height']):.3f} m")
    0.500 +- 0.005 m
    """
    check_key(key)
    check_progress(progress)
    sizes = trace_sizes(n_photons, n_rays, max_orders, plan)

    def checked(inputs: FitInputs) -> tuple[FitProblem, Plan]:
        # Everything that is quickly checked comes before the plan.
        problem = checked_problem(
            inputs.observed,
            inputs.lidar,
            inputs.scene,
            unknowns,
            noise=inputs.noise,
            time=inputs.time,
            solver=solver,
            max_steps=max_steps,
            starts=starts,
            scale=scale,
            recorder=recorder,
            noise_floor=noise_floor,
        )
        sample_times = problem.observed.time
        return problem, checked_plan(
            plan, problem.lidar, problem.scene, problem.unknowns, sample_times, sizes
        )

    inputs = FitInputs(observed, noise, time, lidar, scene, jax.random.key_data(key))
    if not inputs.is_traced:
        return solve_problem(*checked(inputs), key, progress=progress, throw=throw)

    key_kind = str(jax.random.key_impl(key))

    def as_key(inputs: FitInputs) -> PRNGKeyArray:
        return jax.random.wrap_key_data(inputs.key_data, impl=key_kind)

    def fit(inputs: FitInputs) -> tuple[DifferentiableFit, DifferentiatedModel]:
        problem, plan = checked(inputs)
        key = as_key(inputs)
        return solve_with_derivatives(problem, plan, inputs, key, progress=progress, throw=throw)

    def outline(inputs: FitInputs) -> tuple[DifferentiableFit, DifferentiatedModel]:
        # What is computed of known numbers is known, although a program is being traced.
        with jax.ensure_compile_time_eval():
            return outline_of_fit(inputs, unknowns, plan, sizes, as_key(inputs), scale, recorder)

    return differentiable_retrieval(inputs, fit, outline)


def checked_problem(
    observed: Any,
    lidar: Lidar,
    scene: Scene,
    unknowns: Sequence[Unknown],
    *,
    noise: Any,
    time: Any,
    solver: Any,
    max_steps: float,
    starts: float,
    scale: Any,
    recorder: Any,
    noise_floor: float,
) -> FitProblem:
    """Check the arguments of `retrieve`, except those of the simulation. **Raises:** as `retrieve`."""
    check_kinds(lidar, scene)
    settings = solver_settings(solver, max_steps, starts)
    lidar = with_fixed_window(lidar)
    check_kind("recorder", recorder, Recorder | None, "a Recorder, or None")
    has_offset = recorder is not None and recorder.offset is not None
    observation = as_observed(observed, time, noise, noise_floor, lidar, has_offset=has_offset)
    bound_unknowns = bind_unknowns(unknowns, scene, lidar)
    check_solver_for(bound_unknowns, settings)
    check_names(recorder, bound_unknowns)
    # A list of none or one, as the recorder appends it to its own unknowns.
    scale_unknowns = [] if scale is None else [scale_unknown(scale, bound_unknowns)]
    return FitProblem(observation, lidar, scene, bound_unknowns, scale_unknowns, recorder, settings)


class FittedProblem(NamedTuple):
    """The fit of one waveform, with the models of scene and recorder that it used."""

    fit: CompletedFit
    model: ForwardModel
    recorder: RecorderModel


def fit_problem(
    problem: FitProblem,
    plan: Plan,
    key: PRNGKeyArray,
    *,
    progress: Callable[[Step], None] | None = None,
    throw: bool = False,
) -> FittedProblem:
    """Fit one waveform. **Raises:** RuntimeError with `throw`, if the fit does not converge."""
    model = ForwardModel(problem.lidar, problem.scene, plan, problem.unknowns, key)
    recorder = RecorderModel(problem.recorder, problem.scale, problem.lidar, problem.observed.time.size)
    fits = fits_from_starts(
        problem.observed, problem.unknowns, recorder, problem.settings, key_of_starts(key), progress
    )

    def simulate(request: EvaluationRequest) -> Any:
        return model(request.values, with_batches=request.with_batches, pilot=request.pilot)

    fit = run_fit(multistart(fits), simulate)
    # Failure is a status of the result; it is raised only here, on request.
    if throw and not fit.summary.converged:
        raise RuntimeError(fit.summary.status)
    return FittedProblem(fit, model, recorder)


def solve_problem(
    problem: FitProblem,
    plan: Plan,
    key: PRNGKeyArray,
    *,
    progress: Callable[[Step], None] | None = None,
    throw: bool = False,
) -> Retrieval:
    """Fit one waveform: `retrieve` with checked arguments."""
    return retrieval_of_problem(problem, fit_problem(problem, plan, key, progress=progress, throw=throw))


def solve_with_derivatives(
    problem: FitProblem,
    plan: Plan,
    inputs: FitInputs,
    key: PRNGKeyArray,
    *,
    progress: Callable[[Step], None] | None = None,
    throw: bool = False,
) -> tuple[DifferentiableFit, DifferentiatedModel]:
    """Fit one waveform, with the derivatives of its estimates. `inputs`: those of the problem."""
    fitted = fit_problem(problem, plan, key, progress=progress, throw=throw)
    fit, model, recorder = fitted
    unknowns = [*problem.unknowns, *recorder.unknowns]
    stated_noise = as_noise(inputs.noise, problem.observed.sigma.shape)
    derivatives = estimate_derivatives(problem.observed, stated_noise, unknowns, recorder, fit)
    retrieval = retrieval_of_problem(problem, fitted)
    model = DifferentiatedModel.of(plan, unknowns, len(problem.unknowns), key)
    return DifferentiableFit.of(retrieval, fit.summary.values, derivatives), model


def outline_of_fit(
    inputs: FitInputs,
    unknowns: Sequence[Unknown],
    plan: Plan | None,
    sizes: TraceSizes,
    key: PRNGKeyArray,
    scale: tuple[float, float] | None,
    recorder: Recorder | None,
) -> tuple[Any, DifferentiatedModel]:
    """Return the types of the arrays of `solve_with_derivatives`, and the model, for inputs that are traced.

    **Raises:** ValueError where lidar, scene or times are traced and no plan is given.
    """
    lidar, scene = inputs.lidar, inputs.scene
    check_kinds(lidar, scene)
    # Starts decide no shape, and may be traced.
    started = [
        u if u.where is None else dataclasses.replace(u, start=0.5 * (u.bounds[0] + u.bounds[1]))
        for u in unknowns
    ]
    bound = bind_unknowns(started, scene, lidar)
    time = inputs.observed.time if isinstance(inputs.observed, Waveform) else inputs.time
    if plan is None:
        if any(isinstance(x, Tracer) for x in jax.tree.leaves((lidar, scene, time))):
            raise ValueError(
                "plan = None, but the lidar, the scene or the times of the samples are being traced by a JAX "
                "transformation, so that none can be made: make one outside and pass it as plan="
            )
        lidar = with_fixed_window(lidar)
        plan = checked_plan(None, lidar, scene, bound, as_sample_times(time, lidar), sizes)
    scale_unknowns = [] if scale is None else [scale_unknown(scale, bound)]
    all_unknowns = [*bound, *recorder_unknowns(Recorder() if recorder is None else recorder), *scale_unknowns]
    model = DifferentiatedModel.of(plan, all_unknowns, len(bound), key)

    def outline() -> DifferentiableFit:
        inputs = SimulationInputs(with_fixed_window(lidar), scene, plan, model.setters, 0)
        setup = inputs.setup(tuple(u.start for u in bound))
        n_unknowns, shape = sum(u.start.size for u in all_unknowns), (lidar.wavelength.size, plan.n_samples)
        waveform = waveform_of(trace_scene(setup, model.keys[0]), setup, stderr=jnp.zeros(shape))
        sizes = SummarySizes(n_unknowns, len(smooth_names(all_unknowns)), *shape)
        fit = CompletedFit.of_zeros(sizes, status=_STATUS_IN_PROGRAM)
        derivatives = EstimateDerivatives(*(jnp.zeros((n_unknowns, *shape)) for _ in range(3)))
        retrieval = retrieval_of(fit, all_unknowns, scene, waveform)
        return DifferentiableFit.of(retrieval, fit.summary.values, derivatives)

    # Shapes suffice: nothing is computed.
    return jax.eval_shape(outline), model


def retrieval_of_problem(problem: FitProblem, fitted: FittedProblem) -> Retrieval:
    """Return the result of a fit."""
    fit, model, recorder = fitted
    # The recorder's unknowns come last, and are none of the scene's.
    scene_values = fit.summary.values[: fit.summary.values.size - recorder.count]
    waveform = model.waveform(scene_values, fit.details.evaluation, fit.details.waveform_stderr)
    all_unknowns = [*problem.unknowns, *recorder.unknowns]
    return retrieval_of(fit, all_unknowns, model.scene_at(scene_values), waveform)


def solver_settings(solver: Any, max_steps: float, starts: float) -> SolverSettings:
    """Check the solver and its numbers. **Raises:** ValueError for inadmissible ones."""
    if not isinstance(solver, optx.AbstractGaussNewton):
        raise ValueError(f"solver = {solver!r} is no Gauss-Newton method of optimistix")
    return SolverSettings(solver, check_integer("max_steps", max_steps), check_integer("starts", starts))


def check_solver_for(unknowns: Sequence[BoundUnknown], settings: SolverSettings) -> None:
    """Refuse other solvers for profiles, whose steps are solved within the bounds. **Raises:** ValueError."""
    # The bounded Gauss-Newton method takes no settings of a solver.
    names = [unknown.name for unknown in unknowns if unknown.smooth is not None]
    if names and settings.solver != DEFAULT_SOLVER:
        raise ValueError(
            f"solver = {settings.solver!r}, but unknown {names[0]!r} has a Smooth prior; admissible with one "
            "is the default"
        )


def check_progress(progress: object) -> None:
    """Refuse a `progress` that is neither None nor callable. **Raises:** TypeError."""
    if not (progress is None or callable(progress)):
        raise TypeError(f"progress = {progress!r} is no function")


def scale_unknown(bounds: Any, unknowns: Sequence[BoundUnknown]) -> BoundUnknown:
    """Return the unknown "scale" of an uncalibrated receiver. **Raises:** ValueError for bad bounds."""
    try:
        low, high = (float(b) for b in bounds)
    except (TypeError, ValueError):
        raise ValueError(f"scale = {bounds!r} is not a pair (low, high)") from None
    check_range("scale", [low, high], 0.0)
    if not low < high:
        raise ValueError(f"scale = {bounds!r} is not low < high")
    # Results are keyed by name.
    if any(u.name == "scale" for u in unknowns):
        raise ValueError("name = 'scale' is taken by the scale; the unknown needs another one")
    # The first simulation gives it a better start (`RecorderModel.fit_linear`).
    start = jnp.asarray(0.5 * (low + high))
    outside_scene = Setter(None, None, "optical")
    return BoundUnknown("scale", outside_scene, start, np.asarray(low), np.asarray(high), None)
