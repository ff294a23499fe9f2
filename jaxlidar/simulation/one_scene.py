"""`simulate`: make the plan, trace batches of photons until the tolerance is met, and make the waveform."""

import dataclasses
import math
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from jaxlidar._fields.checks import (
    as_array,
    check_flag,
    check_integer,
    check_key,
    check_number,
    check_numbers,
    check_shape,
    has_tracers,
    is_traced,
    is_within_program,
    warn_user,
)
from jaxlidar._jax.mesh_axes import vary_with, with_automatic_axes
from jaxlidar._jax.threads import side_by_side
from jaxlidar._text import outside_message, percent, unfollowed_message
from jaxlidar.planning.memory import MAX_APPLIED_WAVELENGTHS
from jaxlidar.planning.orders import MAX_ORDERS, orders_to_tolerance
from jaxlidar.planning.plan import MIN_BATCHES, Plan
from jaxlidar.planning.plan import plan as make_plan
from jaxlidar.planning.plan_check import check_plan
from jaxlidar.planning.setup import make_setup
from jaxlidar.progress import Progress, ProgressOption, shows_progress
from jaxlidar.sampling.adaptive import (
    BATCH_STEPS,
    AbstractEstimate,
    HasErrors,
    StoppingRule,
    StopReason,
    sample_until,
)
from jaxlidar.sampling.batch_programs import BatchEstimate, BatchTracer, make_batch_tracer
from jaxlidar.sampling.errors import student_widening
from jaxlidar.sampling.moments import RunningMoments
from jaxlidar.sampling.waveform_moments import WaveformErrors, make_waveform_moments
from jaxlidar.scenes.scene import Scene, check_kinds
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.simulation.truth import truth_of_setup
from jaxlidar.spectral.apply_optics import BudgetTerms, budget_excess, refuse_excess, samples_and_budget
from jaxlidar.spectral.summary import neglected_fractions
from jaxlidar.spectral.waveform import Waveform, open_at_first_return
from jaxlidar.trace.response import Response, trace_device_scene

# A batch has at most this many photons, because it cannot be interrupted. Within a JAX transformation, which
# cannot be interrupted at all, it may have more.
MAX_BATCH_PHOTONS = 65_536


@shows_progress
@with_automatic_axes
def simulate(
    lidar: Lidar,
    scene: Scene,
    *,
    key: PRNGKeyArray,
    rtol: float | None = None,
    atol: float = 0.0,
    n_photons: int | None = None,
    plan: Plan | None = None,
    max_orders: int | None = None,
    max_step: float | None = None,
    n_rays: int | None = None,
    window: tuple[float, float] | None = None,
    bin_width: float | None = None,
    footprint: str | None = None,
    effects: Mapping[str, bool] | None = None,
    max_memory: float | None = None,
    max_seconds: float = math.inf,
    truth: bool = False,
    progress: ProgressOption = None,
) -> Waveform:
    """Simulate the waveform that `lidar` records of `scene`.

    Batches of photons are traced until the error is below the tolerance. The error is the root mean square,
    over the samples above 1 % of the peak, of standard error over reflectance, for the worst wavelength.
    Where nothing is random (one order, over planes alone or with a fixed footprint), one pass is made.
    Standard errors are widened for few batches, by Student's t, so that the expected value lies within two of
    them in 95 % of cases. Neglected light (`Waveform.neglected`) and rounding come on top.

    Within a JAX transformation (grad, jacfwd, vmap over scenes) eight batches are traced, whatever the error.
    Where geometry is transformed, the plan must be made outside and passed as `plan`.

    An interrupt (Ctrl-C) after eight batches ends the simulation with the batches that are done.

    **Arguments:**

    - `lidar`: a `Lidar`.
    - `scene`: a `Scene`.
    - `key`: a JAX random key. The same key gives the same waveform.
    - `rtol`: stop when the error is below this, in (0, 1). Default None: the plan's, 0.01 if not given there.
    - `atol`: stop also when the largest standard error of the reflectance is below this, not negative.
      Default 0.
    - `n_photons`: trace at least this many photons, whatever the error; at least 1. They are traced in eight
      batches of equal size, so that up to seven more are traced than asked for, or in more batches of 65,536
      where eight would be larger. Within a JAX transformation there are always eight. Default None: as many
      as the tolerances need.
    - `plan`: a `Plan` made by `jaxlidar.plan`. Cannot be combined with the arguments of the next line.
      Default None: made here.
    - `max_orders`, `max_step`, `n_rays`, `window`, `bin_width`, `footprint`, `effects`, `max_memory`: see
      `jaxlidar.plan`. Default None: as there.
    - `max_seconds`: stop after this time in s, planning and compilation included, however large the error;
      positive. At least eight batches are traced. Default inf.
    - `truth`: True to add `Waveform.truth`: reference quantities computed from the scene itself (gap
      probability, area densities, heights), to train or to test retrieval algorithms. Default False.
    - `progress`: True for a bar with the error and the time left; or a function called with a `Progress`
      after every round of batches. Default None: silent.

    **Returns:** a `Waveform`. Its `info` says how many photons were traced and why the simulation stopped.

    **Raises:** ValueError for inadmissible arguments, for a plan that would miss parts of the scene, and for
    a plan together with planning arguments. KeyboardInterrupt where it is interrupted before eight batches.

    **Example:**

    >>> import jax
    >>> import jaxlidar as jl
    >>> scene = jl.Scene(ground=jl.Ground(reflectance=0.4))
    >>> wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
    >>> print(f"{float(wave.reflectance.sum()):.4f}")
    0.4000
    """
    start_time = time.perf_counter()
    check_kinds(lidar, scene)
    check_key(key)
    check_flag("truth", truth)
    planning = {
        "max_orders": max_orders,
        "max_step": max_step,
        "n_rays": n_rays,
        "window": window,
        "bin_width": bin_width,
        "footprint": footprint,
        "effects": effects,
        "max_memory": max_memory,
    }
    goal = _make_goal(rtol, atol, n_photons, max_seconds)
    given_plan = plan
    is_transformed = is_within_program() or has_tracers((lidar, scene, plan, key))
    plan = _check_or_make_plan(lidar, scene, given_plan, goal, planning, is_transformed)
    tracer = make_batch_tracer(make_setup(lidar, scene, plan), key)
    result = _run_batches(tracer, key, goal, progress, start_time)
    while result.needs_more_orders and given_plan is None:
        more_orders = _more_orders(plan, lidar.wavelength.size, result.unfollowed_fraction, goal)
        if more_orders is None or time.perf_counter() - start_time >= max_seconds:
            break
        plan = _check_or_make_plan(lidar, scene, None, goal, planning | more_orders, is_transformed)
        # Orders given as an argument count as the user's. These are still the plan's choice, so that what
        # lies beyond them is reported.
        plan = dataclasses.replace(plan, scope=dataclasses.replace(plan.scope, automatic_orders=True))
        tracer = make_batch_tracer(make_setup(lidar, scene, plan), key)
        result = _run_batches(tracer, key, goal, progress, start_time)
    wave = _make_waveform(tracer, result, goal)
    return dataclasses.replace(wave, truth=truth_of_setup(tracer.setup)) if truth else wave


class _Goal(NamedTuple):
    """The arguments of `simulate` that decide when to stop.

    `_trace_batches` makes the `StoppingRule` of them. `rtol`: None takes the plan's.
    """

    rtol: float | None
    atol: float
    n_photons: int | None
    max_seconds: float

    def tolerance(self, plan: Plan) -> float:
        """Relative tolerance aimed at."""
        return plan.rtol if self.rtol is None else self.rtol


def _make_goal(rtol: float | None, atol: float, n_photons: int | None, max_seconds: float) -> _Goal:
    # Here, not in `plan` alone: a plan that is passed in has been checked with its own.
    if rtol is not None:
        check_number("rtol", rtol, 0.0, 1.0, low_open=True, high_open=True)
    # Infinite is admissible, so that `check_number` is not.
    check_numbers("max_seconds", max_seconds)
    check_shape("max_seconds", max_seconds, ())
    if not max_seconds > 0:
        raise ValueError(f"max_seconds = {max_seconds:g} is outside the admissible range (0, inf]")
    check_number("atol", atol, 0.0)
    if n_photons is not None:
        n_photons = check_integer("n_photons", n_photons)
    return _Goal(rtol, atol, n_photons, max_seconds)


def _check_or_make_plan(
    lidar: Lidar,
    scene: Scene,
    plan: Plan | None,
    goal: _Goal,
    planning: dict[str, Any],
    is_transformed: bool,
) -> Plan:
    """Check the plan that was passed in, or else make one; with the batch size that the goal asks for.

    `is_transformed`: True where a JAX transformation traces the lidar, the scene or the key.
    """
    arguments = {name: value for name, value in planning.items() if value is not None}
    if plan is None:
        if not is_transformed and lidar.wavelength.size <= MAX_APPLIED_WAVELENGTHS:
            # Histories serve other optics and their derivatives, which one call has no use for.
            arguments.setdefault("histories", False)
        plan = make_plan(lidar, scene, rtol=goal.rtol, describe=False, **arguments)
        plan = plan if is_transformed else plan.with_room()
    elif arguments:
        raise ValueError(
            f"plan is given together with {', '.join(arguments)}; admissible is either: make the plan "
            "with them"
        )
    elif not has_tracers((lidar, scene, plan)):
        check_plan(plan, lidar, scene)
    if goal.n_photons is None:
        return plan
    # In eight batches, or in more of a size that leaves time for interrupts. Rounded up: no fewer photons
    # than were asked for.
    batch_photons = -(-goal.n_photons // MIN_BATCHES)
    if not is_transformed:
        batch_photons = min(batch_photons, MAX_BATCH_PHOTONS)
    return plan.with_config(photons_per_batch=batch_photons)


def _more_orders(
    plan: Plan, wavelengths: int, unfollowed_fraction: float, goal: _Goal
) -> dict[str, Any] | None:
    """Return the planning arguments of a simulation that follows more orders, or None where none can.

    First as many as histories have room for; then, with optics applied, as many as the fraction that is
    neglected asks for.
    """
    if plan.config.keeps_histories and plan.orders < plan.scope.affordable_orders:
        return {"max_orders": plan.scope.affordable_orders, "histories": True}
    if wavelengths > MAX_APPLIED_WAVELENGTHS or plan.orders >= MAX_ORDERS:
        return None
    # The first orders may fall faster than later ones, so that the mean ratio of orders is a lower bound.
    ratio = max(plan.likely_beyond, unfollowed_fraction) ** (1.0 / plan.orders)
    orders = plan.orders + orders_to_tolerance(ratio, goal.tolerance(plan) / unfollowed_fraction)
    return {"max_orders": min(orders, MAX_ORDERS), "histories": False}


class _BatchResults(NamedTuple):
    """The sum of the responses of some batches, standard errors, and `info`.

    Standard errors are None where nothing is random. `unfollowed_fraction`: fraction that orders beyond the
    last may add. `needs_more_orders`: True if nothing else was short of the goal.
    """

    response_sum: Response
    batches: int
    stderr: Array | None
    energy_budget_stderr: dict[str, Array] | None
    info: dict[str, Any]
    unfollowed_fraction: float = 0.0
    needs_more_orders: bool = False


def _run_batches(
    tracer: BatchTracer,
    key: PRNGKeyArray,
    goal: _Goal,
    progress: ProgressOption,
    start_time: float,
) -> _BatchResults:
    """Trace once if nothing is random, a fixed number of batches if transformed, or until the goal."""
    if not tracer.setup.plan.is_random:
        response = jax.block_until_ready(tracer.trace(key))
        info = {
            "photons": 0,
            "batches": 1,
            "error": 0.0,
            "stopped": StopReason.NOTHING_RANDOM.value,
            "seconds": time.perf_counter() - start_time,
        }
        return _BatchResults(response, 1, None, None, info)
    if has_tracers((tracer.setup, key)):
        return _trace_transformed(tracer, key)
    return _trace_batches(tracer, key, goal, progress, start_time)


def _make_waveform(tracer: BatchTracer, result: _BatchResults, goal: _Goal) -> Waveform:
    """Make the waveform of the batches, on the digitiser's samples; warn where it misses much light."""
    plan, lidar = tracer.setup.plan, tracer.setup.lidar
    wave = tracer.waveform(result.response_sum, result.batches)
    errors = {"stderr": result.stderr, "energy_budget_stderr": result.energy_budget_stderr}
    errors = {name: value for name, value in errors.items() if value is not None}
    wave = dataclasses.replace(wave, info=result.info, **errors)
    if is_traced(wave.energy):
        if lidar.opens_at_first_return:
            raise ValueError(
                "receiver window = 'first return' inside a JAX transformation, which traces where the record "
                "begins; admissible is 'fixed': apply first_return_window outside"
            )
        return wave
    # By NumPy: JAX would compile a program for each of these operations.
    budgets = jax.device_get((wave.energy_budget, result.energy_budget_stderr or {}))
    refuse_excess(budget_excess(*budgets))
    # Heights tell the zenith angle of a waveform's lidar, and nothing else its altitude.
    wave = dataclasses.replace(
        wave, info={**result.info, "altitude": None if lidar.altitude is None else float(lidar.altitude)}
    )
    outside = neglected_fractions(wave)[1]
    if plan.scope.automatic_window and outside > goal.tolerance(plan):
        message = outside_message(outside, plan.record_end, "give window=, or see Waveform.neglected")
        warn_user(message, LateLightWarning)
    if result.unfollowed_fraction > goal.tolerance(plan):
        warn_user(unfollowed_message(plan.orders, result.unfollowed_fraction), UnfollowedLightWarning)
    return open_at_first_return(wave, lidar) if lidar.opens_at_first_return else wave


class UnfollowedLightWarning(UserWarning):
    """The warning that orders of scattering that were not followed may add more than the tolerance.

    It is given where the plan chose the number of orders. `max_orders=` of your own is taken as it is; what
    it leaves out is in `Waveform.neglected`.

    **Example:** light in a deep canopy that absorbs nothing, for more wavelengths than optics can be applied
    to.

    >>> import warnings
    >>> import jax, jaxlidar as jl, numpy as np
    >>> voxels = jl.VoxelMap.from_lad(np.full((1, 1, 4), 10.0), voxel_size=1.0)
    >>> canopy = jl.Canopy(voxels, leaf=jl.Isotropic(0.999), sides="periodic")
    >>> lidar = jl.Lidar(wavelength=np.linspace(800.0, 900.0, 9))
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always")
    ...     wave = jl.simulate(lidar, jl.Scene(canopy=canopy), key=jax.random.key(0), n_photons=1000)
    >>> caught[0].category.__name__
    'UnfollowedLightWarning'
    """


class LateLightWarning(UserWarning):
    """The warning that more of the returned light than the tolerance comes after the end of the record.

    It is given where the plan chose the window, which is at most 3000 ns longer than that of order one. A
    `window=` of your own is taken as it is; an estimate of what it leaves out is in `Waveform.neglected`.

    **Example:** light goes to and fro between bright surfaces.

    >>> import warnings
    >>> import jax, jaxlidar as jl
    >>> scene = jl.Scene(plates=[jl.Plate(80.0, 0.4, 0.5)], ground=jl.Ground(reflectance=0.9))
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always")
    ...     wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0), n_photons=10000)
    >>> caught[0].category.__name__
    'LateLightWarning'
    """


def _trace_transformed(tracer: BatchTracer, key: PRNGKeyArray) -> _BatchResults:
    """Trace a fixed number of batches, within a JAX transformation."""

    def trace_batch(key: PRNGKeyArray) -> tuple[Response, tuple[Array, BudgetTerms]]:
        response = trace_device_scene(tracer.scene, key)
        return response, samples_and_budget(response, tracer.model)

    def add_batch(total: Response, key: PRNGKeyArray) -> tuple[Response, tuple[Array, BudgetTerms]]:
        response, estimates = trace_batch(key)
        return jax.tree.map(jnp.add, total, response), estimates

    # The sum is carried: responses of all batches together would take several times the memory.
    keys = jax.random.split(key, MIN_BATCHES)
    shapes = jax.eval_shape(trace_batch, keys[0])[0]
    zero = vary_with(jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes), (tracer.scene, key))
    response_sum, (samples, terms) = jax.lax.scan(add_batch, zero, keys)

    def stderr(values: Array) -> Array:
        # Standard errors have no derivatives: they would be those of the noise.
        variance = jnp.var(jax.lax.stop_gradient(values), axis=0)
        return student_widening(MIN_BATCHES) * jnp.sqrt(variance / (MIN_BATCHES - 1))

    energy_budget_stderr = jax.tree.map(stderr, terms.energy_budget)
    return _BatchResults(response_sum, MIN_BATCHES, stderr(samples), energy_budget_stderr, {})


class _WaveformEstimate(AbstractEstimate):
    """Sum of the responses of batches, and the moments from which their standard errors follow.

    - `response_sum`: the sum. - `waveforms`: moments of waveforms.
    - `budgets`: moments of energy budgets, with the mean reflectance of unfollowed light. - `budget_names`:
      of their rows.
    """

    def __init__(
        self, tracer: BatchTracer, trace: Callable[[range], Iterable[tuple[Response, BatchEstimate]]]
    ):
        """`trace`: traces the batches with the given numbers."""
        self.tracer, self.trace = tracer, trace
        self.n_wavelengths = tracer.setup.lidar.wavelength.size
        n_samples = tracer.setup.plan.n_samples
        self.waveforms = make_waveform_moments(tracer.error_model, self.n_wavelengths, n_samples)
        self.response_sum: Any = None
        self.budgets: Any = None
        self.budget_names: tuple[str, ...] = ()

    @property
    def n_batches(self) -> int:
        """Number of batches."""
        return self.waveforms.count

    def add_batches(self, numbers: range) -> None:
        """Trace batches and add them."""
        for response, batch in self.trace(numbers):
            self.response_sum = self.tracer.add(self.response_sum, response)
            # Wavelengths beyond the lidar's are padding.
            budget = np.asarray(batch.budget)[:, : self.n_wavelengths]
            unfollowed = np.asarray(batch.unfollowed)[: self.n_wavelengths]
            if self.budgets is None:
                self.budgets = RunningMoments.on_host(budget, unfollowed)
                self.budget_names = batch.budget_names
            self.budgets = self.budgets.update(budget, unfollowed)
            self.waveforms.add(batch.samples)

    def errors(self) -> WaveformErrors:
        """Return the errors of the waveform."""
        return self.waveforms.errors()


def _trace_batches(
    tracer: BatchTracer,
    key: PRNGKeyArray,
    goal: _Goal,
    progress: ProgressOption,
    start_time: float,
) -> _BatchResults:
    """Trace batches on all cores, round after round, until the goal is reached.

    1. Stop at the tolerances, or at a number of batches where the goal is a number of photons.
    2. Add batches in rounds of growing size (`sample_until`); report after each.
    3. Where the tolerance is met and the plan chose the orders, say what orders beyond the last may add.
    """
    plan = tracer.setup.plan
    rtol = goal.tolerance(plan)
    if goal.n_photons is None:
        stop = StoppingRule(rtol, goal.atol, MIN_BATCHES)
    else:
        # Rounded up: at least as many photons as were asked for.
        max_batches = max(MIN_BATCHES, -(-goal.n_photons // plan.config.photons_per_batch))
        stop = StoppingRule(rtol=None, min_size=MIN_BATCHES, max_size=max_batches)
    trace_batch = tracer.batch_function(key)
    with side_by_side() as run:
        estimate = _WaveformEstimate(tracer, lambda numbers: run(trace_batch, numbers))

        def report(errors: HasErrors) -> None:
            if callable(progress):
                photons = estimate.n_batches * plan.photons_traced
                seconds = time.perf_counter() - start_time
                progress(Progress(photons, None, seconds, "photons", error=errors.relative, rtol=stop.rtol))

        reason, errors = sample_until(
            estimate,
            stop,
            BATCH_STEPS,
            max_seconds=goal.max_seconds,
            start_time=start_time,
            report=report,
            keeps_interrupted=True,
        )
    assert isinstance(errors, WaveformErrors)
    stopped, unfollowed = reason.value, estimate.budgets.mean_only
    unfollowed_fraction = 0.0
    if plan.scope.automatic_orders and float(np.max(unfollowed, initial=0.0)) > goal.atol:
        unfollowed_fraction = float(np.max(unfollowed / np.maximum(errors.total, 1e-30), initial=0.0))
    needs_more_orders = reason is StopReason.TOLERANCE_MET and unfollowed_fraction > rtol
    if needs_more_orders:
        stopped = f"orders beyond {plan.orders} may add {percent(unfollowed_fraction)}"
    info = {
        "photons": estimate.n_batches * plan.photons_traced,
        "batches": estimate.n_batches,
        "seconds": time.perf_counter() - start_time,
        "error": errors.relative,
        "stopped": stopped,
    }
    return _BatchResults(
        response_sum=estimate.response_sum,
        batches=estimate.n_batches,
        stderr=as_array(errors.stderr),
        energy_budget_stderr=dict(zip(estimate.budget_names, map(as_array, estimate.budgets.stderr))),
        info=info,
        unfollowed_fraction=unfollowed_fraction,
        needs_more_orders=needs_more_orders,
    )
