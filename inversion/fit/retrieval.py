"""Retrieval of scene properties from one waveform."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, PRNGKeyArray

from inversion.fit.data import Data, at_fixed_times, data_of
from inversion.fit.model import Model
from inversion.fit.planning import batch_sizes, plan_within
from inversion.fit.result import Retrieval, Step
from inversion.fit.solver import Fit, Outcome, bounds_of, drive, labels_of, named, smooth_names
from inversion.fit.starts import best_of
from inversion.fit.unknowns import Place, Settled, Unknown, latin_hypercube, settle
from inversion.receiver.recorder import Recorder, RecorderModel, check_names
from jaxlidar import Lidar, Plan, Scene, Waveform
from jaxlidar.extend import check_integer, check_key, check_kind, check_kinds, check_range

SOLVER = optx.LevenbergMarquardt(rtol=1e-3, atol=1e-3)


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
    solver: optx.AbstractLeastSquaresSolver = SOLVER,
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
    unknowns. Where photons are traced at every step, a fit begins with a quarter of them, two of eight
    batches, and goes on with all once a step is below one standard error. It converges with all:
    values, errors and chi-squared come from them.

    The remaining noise of the simulation is estimated from its batches. It lowers the weight of the
    samples that it affects and is part of the standard errors. `Retrieval.simulation_error` gives that part;
    more photons lower it. Unknowns that act through optics alone (leaf traits, reflectances, the atmosphere)
    cost next to nothing; if all unknowns are such, photons are traced once. Fits with equal shapes, plans and
    unknowns compile once.

    **Arguments:**

    - `observed`: a `Waveform`, of which `reflectance` is fitted, or an array (wavelengths, bins) of apparent
      reflectance with `time`, or in any other unit with `scale`.
    - `lidar`: the instrument.
    - `scene`: the scene at the starting values.
    - `unknowns`: what to retrieve, one `Unknown` or more. Every scene within the bounds must be admissible: a
      sum of reflectance and transmittance above one, say, is not noticed.
    - `noise`: one standard deviation of `observed`, in [0, inf], anything that broadcasts to it. Samples are
      taken as independent. Infinity leaves a sample out.
    - `key`: a JAX random key, other than that of a simulated `observed`.
    - `time`: (bins,) ns, needed where `observed` is an array. Times must lie the lidar's sampling interval
      apart. Default None: those of the `Waveform`.
    - `plan`: what to simulate (`jaxlidar.plan`, with the window of `observed`, valid throughout the bounds),
      with the photons and rays of one of eight batches. Derivatives are computed in groups where all at once
      would take more memory than its `max_memory`. Default None: planned for the start and the corners of
      the bounds.
    - `n_photons`: photons of one simulation, all eight batches together, at least 8. Default None: 65536, or
      what `plan` has.
    - `n_rays`: rays of the footprint of one simulation, all eight batches together, at least 8. Default None:
      8192, or what `plan` has.
    - `max_orders`: orders of scattering. Default None: chosen by the albedos of the starting scene.
    - `solver`: a Gauss-Newton method of optimistix. Default: Levenberg-Marquardt. A fit also ends where a
      Gauss-Newton step would be below 0.05 standard errors, or where small steps no longer improve it. With
      a `Smooth` prior, only the default is admissible: steps are then solved within the bounds.
    - `max_steps`: most simulations, each with its Jacobian, from each start; no more than half of them are
      with few photons. Default 50.
    - `starts`: number of starting points; the best fit is returned. The first is the scene's own, the others
      are a Latin hypercube over the bounds. Default 1.
    - `scale`: (low, high), bounds of a further unknown, "scale", which multiplies the simulated reflectance,
      the same for all wavelengths (an uncalibrated receiver). It starts where it fits best. Default None: no
      such unknown.
    - `recorder`: what the recorder adds, a `Recorder`: its receiver's response, offsets of its digitisers,
      and the noise of the recorded pulse. Default None: nothing.
    - `noise_floor`: share of each wavelength's largest observed value, 0 to 1, that replaces any smaller
      `noise`: standard errors of a simulation are zero where no photon came. Default 1e-3.
    - `progress`: called with a `Step` after every simulation, with few photons or all; for instance `print`.
    - `throw`: whether to raise RuntimeError where the fit does not converge. Default False: only
      `Retrieval.status` says so.

    **Returns:** a `Retrieval`.

    **Raises:** ValueError for inadmissible arguments, among them a start outside its bounds, samples that do
    not fit the lidar or the plan, a plan that does not serve all scenes within the bounds or that is given
    together with photons, rays or orders, derivatives that would take more than `max_memory` one at a time,
    noise that is negative or NaN, and a lidar so far from x = y = 0 that its place is rounded by more than a
    millimetre. TypeError for arguments of another kind.
    RuntimeError where `throw` is set and the fit does not converge.

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
    check_kinds(lidar, scene)
    check_key(key)
    solver, max_steps, starts = check_solution(solver, max_steps, starts)
    check_progress(progress)
    photons, rays = batch_sizes(n_photons, n_rays, max_orders, plan)
    lidar = at_fixed_times(lidar)
    data = data_of(observed, time, noise, noise_floor, lidar)
    settled = settle(unknowns, scene)
    check_solver(solver, settled)
    check_kind("recorder", recorder, Recorder | None, "a Recorder, or None")
    check_names(recorder, settled)
    extra = [] if scale is None else [scale_of(scale, settled)]
    sizes = {"max_orders": max_orders, "photons": photons, "rays": rays}
    plan = plan_within(plan, lidar, scene, settled, data.time, **sizes)
    how = (recorder, solver, max_steps, starts, progress, throw)
    return retrieve_with(plan, data, lidar, scene, settled, extra, key, *how)


def retrieve_with(
    plan: Plan,
    data: Data,
    lidar: Lidar,
    scene: Scene,
    settled: list[Settled],
    extra: list[Settled],
    key: PRNGKeyArray,
    recorder: Recorder | None,
    solver: Any,
    max_steps: int,
    starts: int,
    progress: Callable[[Step], None] | None,
    throw: bool,
) -> Retrieval:
    """`retrieve` with what it has made of its arguments."""
    model = Model(lidar, scene, plan, settled, key)
    terms = RecorderModel(recorder, extra, lidar, data.time.size)
    fits = fits_from(starts, key, data, settled, terms, solver, max_steps, progress)
    outcome = drive(best_of(fits), lambda q: model(q.values, spread=q.spread, few=q.few))
    if throw and not outcome.converged:
        raise RuntimeError(outcome.status)
    return retrieval_of(outcome, model, [*settled, *terms.unknowns], terms.count)


def check_solution(solver: Any, max_steps: float, starts: float) -> tuple[Any, int, int]:
    """How fits are to be solved, checked. **Raises:** ValueError where inadmissible."""
    if not isinstance(solver, optx.AbstractGaussNewton):
        raise ValueError(f"solver = {solver!r} is no Gauss-Newton method of optimistix")
    return solver, check_integer("max_steps", max_steps), check_integer("starts", starts)


def check_solver(solver: Any, settled: Sequence[Settled]) -> None:
    """Refuse another solver for profiles, which have their own: see `inversion.descent`."""
    smooth = [s.name for s in settled if s.smooth is not None]
    if smooth and solver != SOLVER:
        raise ValueError(
            f"solver = {solver!r}, but unknown {smooth[0]!r} has a Smooth prior; admissible with one is the "
            "default"
        )


def check_progress(progress: object) -> None:
    """Refuse what cannot be called after a step or fit."""
    if not (progress is None or callable(progress)):
        raise TypeError(f"progress = {progress!r} is no function")


def fits_from(
    starts: int, key: PRNGKeyArray, data: Data, settled: list[Settled], terms: RecorderModel, *more: Any
) -> list[Fit]:
    """One fit from the unknowns' own start, and further ones from a Latin hypercube over their bounds."""
    places = (
        latin_hypercube([*settled, *terms.unknowns], starts - 1, jax.random.fold_in(key, 1))
        if starts > 1
        else []
    )
    return [Fit(data, settled, terms, *more, start=place) for place in [None, *places]]


def retrieval_of(outcome: Outcome, model: Model, settled: list[Settled], terms: int) -> Retrieval:
    """A `Retrieval` from the outcome of a fit, with values by name; the last ones are the recorder's."""

    def by_name(flat: np.ndarray) -> dict[str, Array]:
        return {k: jnp.asarray(v) for k, v in named(flat, settled).items()}

    flat = outcome.values[: outcome.values.size - terms]
    return Retrieval(
        values=by_name(outcome.values),
        stderr=by_name(outcome.stderr),
        robust_stderr=by_name(outcome.robust_stderr),
        prior_share=by_name(outcome.prior_share),
        at_bound=by_name(outcome.at_bound),
        simulation_error=by_name(outcome.simulation_error),
        covariance=jnp.asarray(outcome.covariance),
        correlation=jnp.asarray(outcome.correlation),
        scene=model.scene_at(flat),
        waveform=model.waveform(flat, outcome.evaluation, outcome.simulation),
        residuals=jnp.asarray(outcome.residuals),
        reduced_chi2=jnp.asarray(outcome.reduced_chi2),
        second_minimum=jnp.asarray(outcome.second_minimum),
        independent_samples=jnp.asarray(outcome.independent_samples),
        averaging=jnp.asarray(outcome.averaging),
        strength=dict(zip(smooth_names(settled), map(jnp.asarray, outcome.strength))),
        bounds={k: jnp.asarray(v) for k, v in bounds_of(settled).items()},
        converged=outcome.converged,
        status=outcome.status,
        steps=outcome.steps,
        history=outcome.history,
        labels=labels_of(settled),
    )


def scale_of(bounds: Any, settled: list[Settled]) -> Settled:
    """The unknown "scale" of an uncalibrated receiver. **Raises:** ValueError for inadmissible bounds."""
    try:
        low, high = (float(b) for b in bounds)
    except (TypeError, ValueError):
        raise ValueError(f"scale = {bounds!r} is not a pair (low, high)") from None
    check_range("scale", [low, high], 0.0)
    if not low < high:
        raise ValueError(f"scale = {bounds!r} is not low < high")
    if any(s.name == "scale" for s in settled):
        raise ValueError("name = 'scale' is taken by the scale; the unknown needs another one")
    # Its start is set after the first simulation.
    start = jnp.asarray(0.5 * (low + high))
    return Settled("scale", Place(None, None, "optical"), start, np.asarray(low), np.asarray(high), None)
