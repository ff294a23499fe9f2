"""Retrieval of scene properties from one waveform."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import ArrayLike, PRNGKeyArray

from inversion.fit.data import ObservedWaveform, as_observed, with_fixed_window
from inversion.fit.fit_summary import CompletedFit, Step
from inversion.fit.model import ForwardModel
from inversion.fit.planning import checked_plan, trace_sizes
from inversion.fit.recorder_model import RecorderModel, check_names
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
from inversion.fit.unknowns import BoundUnknown, Setter, Unknown, bind_unknowns
from inversion.receiver.recorder import Recorder
from jaxlidar import Lidar, Plan, Scene, Waveform
from jaxlidar.extend import check_integer, check_key, check_kind, check_kinds, check_range


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
    noise that is negative or NaN, and a lidar so far from x = y = 0 that its position is rounded by more than
    a millimetre. TypeError for arguments of another kind.
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
    # Everything that is quickly checked comes before the plan.
    problem = checked_problem(
        observed,
        lidar,
        scene,
        unknowns,
        noise=noise,
        time=time,
        solver=solver,
        max_steps=max_steps,
        starts=starts,
        scale=scale,
        recorder=recorder,
        noise_floor=noise_floor,
    )
    sample_times = problem.observed.time
    plan = checked_plan(plan, problem.lidar, scene, problem.unknowns, sample_times, sizes)
    return solve_problem(problem, plan, key, progress=progress, throw=throw)


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
    fit, model, recorder = fit_problem(problem, plan, key, progress=progress, throw=throw)
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
