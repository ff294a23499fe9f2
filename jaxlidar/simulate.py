"""`simulate`: make the plan, trace batches of photons until the tolerance is met, and record the waveform."""

import dataclasses
import math
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from jaxlidar._checks import check_flag, check_integer, check_key, check_range, is_traced
from jaxlidar._programs import Program
from jaxlidar._progress import Progress
from jaxlidar._summary import NOTABLE, late_share, percent
from jaxlidar._threads import side_by_side
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.planning.plan import MIN_BATCHES, Plan
from jaxlidar.planning.plan import plan as make_plan
from jaxlidar.planning.plan_check import check_plan
from jaxlidar.planning.setup import Setup, reduce
from jaxlidar.sampling.adaptive import (
    BATCH_STEPS,
    AbstractEstimate,
    HasErrors,
    StoppingRule,
    StopReason,
    sample_until,
)
from jaxlidar.sampling.errors import student_widening
from jaxlidar.sampling.moments import RunningMoments
from jaxlidar.sampling.waveform_moments import WaveformErrors
from jaxlidar.scenes.scene import Scene, check_kinds
from jaxlidar.trace.batches import (
    Known,
    Ready,
    add_responses,
    batch_of,
    begin_to_compile_sums,
    begin_to_compile_traces,
    compiled_trace,
)
from jaxlidar.trace.colouring import Balance, Recording, recording_of, recording_with_room, total_and_balance
from jaxlidar.trace.response import Response, trace_setting
from jaxlidar.trace.setting import setting_ahead, setting_of, straight_transmittance
from jaxlidar.truth import truth_of_setup
from jaxlidar.waveform import Waveform, open_at_first_return, recorded, trimmed

# Photons of one batch at most: a batch cannot be interrupted.
LARGEST_BATCH = 65_536


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
    progress: Callable[[Progress], None] | None = None,
) -> Waveform:
    """The waveform that `lidar` records of `scene`.

    Batches of photons are traced until the error is below the tolerance. The error is the root mean square,
    over the samples above 1 % of the peak, of standard error over reflectance, for the worst wavelength.
    Where nothing is random (one order, over planes alone or with a fixed footprint), one pass is made.
    Standard errors are widened for few batches, by Student's t, so that the expected value lies within two of
    them in 95 % of cases. Neglected orders (`Waveform.neglected`) and rounding come on top.

    Within a JAX transformation (grad, jacfwd, vmap over scenes) eight batches are traced, whatever the error.
    Where geometry is transformed, the plan must be made outside and passed as `plan`.

    An interrupt (Ctrl-C) after eight batches ends the simulation with what is done.

    **Arguments:**

    - `lidar`: a `Lidar`.
    - `scene`: a `Scene`.
    - `key`: a JAX random key. The same key gives the same waveform.
    - `rtol`: stop when the error is below this, in (0, 1). Default None: the plan's, 0.01 if not given there.
    - `atol`: stop also when the largest standard error of the reflectance is below this, not negative.
      Default 0.
    - `n_photons`: trace this many photons, in eight batches, whatever the error; at least 1. Default None: as
      many as the tolerances need.
    - `plan`: a `Plan` made by `jaxlidar.plan`. Cannot be combined with the arguments of the next line.
      Default None: made here.
    - `max_orders`, `max_step`, `n_rays`, `window`, `bin_width`, `footprint`, `effects`, `max_memory`: see
      `jaxlidar.plan`. Default None: as there.
    - `max_seconds`: stop after this time in s, planning and compilation included, however large the error;
      positive. At least eight batches are traced. Default inf.
    - `truth`: whether to add what the beam meets in the scene, as labels for algorithms: `Waveform.truth`.
      Default False.
    - `progress`: a function called with a `Progress` after every round of batches; for instance `print`.
      Default None.

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
    started = time.perf_counter()
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
    goal = _goal(rtol, atol, n_photons, max_seconds)
    given = plan
    plan = _planned(lidar, scene, given, goal, planning)
    ready = _prepared(reduce(lidar, scene, plan), key)
    traced = _trace_until(ready, key, goal, progress, started)
    spent = time.perf_counter() - started
    if given is None and traced.beyond > 0 and plan.orders < plan.limits.most_orders and spent < max_seconds:
        # Orders beyond the last matter: follow as many as there is room for.
        planning["max_orders"] = plan.limits.most_orders
        plan = _planned(lidar, scene, None, goal, planning)
        plan = dataclasses.replace(plan, limits=plan.limits._replace(automatic_orders=True))
        ready = _prepared(reduce(lidar, scene, plan), key)
        traced = _trace_until(ready, key, goal, progress, started)
    wave = _recorded(ready, traced)
    return dataclasses.replace(wave, truth=truth_of_setup(ready.setup)) if truth else wave


def _prepared(setup: Setup, key: PRNGKeyArray) -> Ready:
    transmittance = straight_transmittance(setup)
    own_traces = transmittance is not None or not setup.plan.trace.keeps_histories
    traced = any(is_traced(x) for x in jax.tree.leaves((setup, key)))
    exact = own_traces or traced
    record = recording_of if exact else recording_with_room
    if traced or not setup.plan.is_random:
        setting = setting_of(setup, derivatives="all" if traced else "none")
        recording = record(setup)
        return Ready(setup, setting, transmittance, recording, recording)
    # What takes longest begins to be compiled; numbers are made beside it.
    ahead, make = setting_ahead(setup)
    response = begin_to_compile_traces(ahead, transmittance, key)
    recording = record(setup)
    brief = recording if exact else recording.abridged()
    if response is not None:
        _compiled_waveform.begin(response, jnp.asarray(1.0), recording)
        begin_to_compile_sums(response, brief)
    return Ready(setup, make(), transmittance, recording, brief)


class _Goal(NamedTuple):
    """When to stop: after a number of photons, or below tolerances. `rtol` None takes the plan's."""

    rtol: float | None
    atol: float
    n_photons: int | None
    max_seconds: float


def _goal(rtol: float | None, atol: float, n_photons: int | None, max_seconds: float) -> _Goal:
    for name, value in (("rtol", rtol), ("max_seconds", max_seconds)):
        if value is not None and not value > 0:
            raise ValueError(f"{name} = {value:g} is outside the admissible range (0, inf)")
    check_range("atol", atol, 0.0)
    if n_photons is not None:
        n_photons = check_integer("n_photons", n_photons)
    return _Goal(rtol, atol, n_photons, max_seconds)


def _planned(lidar: Lidar, scene: Scene, plan: Plan | None, goal: _Goal, planning: dict[str, Any]) -> Plan:
    """The plan that was given, checked; or else one made here."""
    given = {name: value for name, value in planning.items() if value is not None}
    if plan is None:
        plan = make_plan(lidar, scene, rtol=goal.rtol, describe=False, **given)
    elif given:
        raise ValueError(
            f"plan is given together with {', '.join(given)}; admissible is either: make the plan with them"
        )
    elif not any(is_traced(x) for x in jax.tree.leaves((lidar, scene))):
        check_plan(plan, lidar, scene)
    if goal.n_photons is None:
        return plan
    # In eight batches, or in more of a size that leaves time to look up.
    return dataclasses.replace(plan, n_photons=min(max(goal.n_photons // MIN_BATCHES, 1), LARGEST_BATCH))


class _Traced(NamedTuple):
    """The sum of the responses of `batches`, standard errors of its waveform and ledger (None: nothing is
    random), and what it took.

    `beyond`: share that orders beyond the last may add, where nothing else was short of the goal; else 0.
    """

    response: Response
    batches: int
    stderr: Array | None
    ledger_stderr: dict[str, Array] | None
    info: dict[str, Any]
    beyond: float = 0.0


def _trace_until(
    ready: Ready,
    key: PRNGKeyArray,
    goal: _Goal,
    progress: Callable[[Progress], None] | None,
    started: float,
) -> _Traced:
    if not ready.setup.plan.is_random:
        response = jax.block_until_ready(compiled_trace(ready.setting, ready.transmittance, key))
        info = {"photons": 0, "batches": 1, "error": 0.0, "stopped": "nothing is random"}
        return _Traced(response, 1, None, None, {**info, "seconds": time.perf_counter() - started})
    if any(is_traced(x) for x in jax.tree.leaves((ready.setup, key))):
        return _trace_within(ready, key)
    return _trace_batches(ready, key, goal, progress, started)


def _recorded(ready: Ready, traced: _Traced) -> Waveform:
    """The waveform of a response, on the digitiser's bins."""
    plan, lidar = ready.setup.plan, ready.setup.lidar
    wave = _compiled_waveform(traced.response, jnp.asarray(float(traced.batches)), ready.recording)
    wave = trimmed(wave, lidar.wavelength.size, plan.n_samples)
    errors = {"stderr": traced.stderr, "ledger_stderr": traced.ledger_stderr}
    known = {name: value for name, value in errors.items() if value is not None}
    wave = dataclasses.replace(wave, info=traced.info, **known)
    if is_traced(wave.energy):
        return wave
    if plan.limits.automatic_window and late_share(wave) >= NOTABLE:
        end = plan.sample_start + plan.sample_interval * plan.n_samples
        warnings.warn(
            f"{percent(late_share(wave))} of the light is still on its way when the record ends at {end:.4g} "
            "ns: give window=, or see Waveform.ledger",
            LateLightWarning,
            stacklevel=3,
        )
    return open_at_first_return(wave, lidar) if lidar.receiver.window == "first return" else wave


class LateLightWarning(UserWarning):
    """The warning that a record ends while a hundredth of the light or more is still on its way.

    It is given where the plan chose the window. A `window=` of your own is taken as it is.

    **Example:** light goes to and fro between bright surfaces.

    >>> import warnings
    >>> import jax, jaxlidar as jl
    >>> scene = jl.Scene(plates=[jl.Plate(80.0, 0.4, 0.5)], ground=jl.Ground(reflectance=0.9))
    >>> with warnings.catch_warnings(record=True) as found:
    ...     warnings.simplefilter("always")
    ...     wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0), n_photons=10000)
    >>> found[0].category.__name__
    'LateLightWarning'
    """


def _waveform(whole: Response, batches: Array, recording: Recording) -> Waveform:
    """The waveform of the mean of so many responses."""
    return recorded(jax.tree.map(lambda a: a / batches, whole), recording)


_compiled_waveform = Program(_waveform)


def _trace_within(ready: Ready, key: PRNGKeyArray) -> _Traced:
    """A fixed number of batches, within a JAX transformation."""

    def batch(key: PRNGKeyArray) -> tuple[Response, Array, Balance]:
        response = trace_setting(ready.setting, ready.transmittance, key)
        return response, *total_and_balance(response, ready.recording)

    responses, totals, balances = jax.lax.map(batch, jax.random.split(key, MIN_BATCHES))

    def stderr(each: Array) -> Array:
        spread = jnp.var(jax.lax.stop_gradient(each), axis=0)
        return student_widening(MIN_BATCHES) * jnp.sqrt(spread / (MIN_BATCHES - 1))

    whole = jax.tree.map(lambda a: jnp.sum(a, axis=0), responses)
    return _Traced(whole, MIN_BATCHES, stderr(totals), jax.tree.map(stderr, balances.ledger), {})


class _WaveformEstimate(AbstractEstimate):
    """Sum of the responses of batches, and the moments of what they return.

    - `trace`: traces the batches with the given numbers. - `wavelengths`, `samples`: those of the waveform;
      batches are padded to larger shapes.
    - `response_sum`: sum of responses. - `waveforms`: moments of waveforms. - `budgets`: moments of energy
      budgets, and the mean of the neglected fractions. - `names`: of the rows of energy budgets.
    """

    def __init__(
        self,
        trace: Callable[[range], Iterable[tuple[Response, Known]]],
        recording: Recording,
        wavelengths: int,
        samples: int,
    ):
        self.trace, self.wavelengths = trace, wavelengths
        self.waveforms = recording.moments(wavelengths, samples)
        self.response_sum: Any = None
        self.budgets: Any = None
        self.names: tuple[str, ...] = ()

    @property
    def n_batches(self) -> int:
        """Number of batches."""
        return self.waveforms.count

    def add_batches(self, numbers: range) -> None:
        """Trace batches and add them."""
        for response, batch in self.trace(numbers):
            first = self.response_sum is None
            self.response_sum = response if first else add_responses(self.response_sum, response)
            budget = np.asarray(batch.ledger)[:, : self.wavelengths]
            neglected = np.asarray(batch.neglected)[: self.wavelengths]
            budgets = RunningMoments.on_host(budget, neglected) if first else self.budgets
            self.budgets = budgets.update(budget, neglected)
            self.names = batch.names
            # Last: its count is the estimate's, also after an interrupt.
            self.waveforms.add(batch.total)

    def errors(self) -> WaveformErrors:
        """Return the errors of the waveform."""
        return self.waveforms.errors()


def _trace_batches(
    ready: Ready,
    key: PRNGKeyArray,
    goal: _Goal,
    progress: Callable[[Progress], None] | None,
    started: float,
) -> _Traced:
    """Trace batches on all cores, round after round, until the goal is reached."""
    plan = ready.setup.plan
    rtol = plan.rtol if goal.rtol is None else goal.rtol
    if goal.n_photons is None:
        stop = StoppingRule(rtol, goal.atol, MIN_BATCHES)
    else:
        stop = StoppingRule(None, 0.0, MIN_BATCHES, max(MIN_BATCHES, -(-goal.n_photons // plan.n_photons)))
    photons_per_batch = plan.n_photons if plan.orders > 1 or plan.trace.drawn_first else 0
    batch = batch_of(ready, key)
    with side_by_side() as run:
        estimate = _WaveformEstimate(
            lambda numbers: run(batch, numbers),
            ready.brief,
            ready.setup.lidar.wavelength.size,
            plan.n_samples,
        )

        def report(errors: HasErrors) -> None:
            if progress is not None:
                batches, seconds = estimate.n_batches, time.perf_counter() - started
                progress(Progress(batches, batches * photons_per_batch, seconds, errors.relative, stop.rtol))

        reason, errors = sample_until(
            estimate,
            stop,
            BATCH_STEPS,
            max_seconds=goal.max_seconds,
            start_time=started,
            report=report,
            keeps_interrupted=True,
        )
    assert isinstance(errors, WaveformErrors)
    stopped, beyond = reason.value, 0.0
    if reason is StopReason.TOLERANCE_MET and plan.limits.automatic_orders:
        neglected = estimate.budgets.mean_only
        fraction = float(np.max(neglected / np.maximum(errors.total, 1e-30), initial=0.0))
        if fraction > rtol and float(np.max(neglected, initial=0.0)) > goal.atol:
            beyond, stopped = fraction, f"orders beyond {plan.orders} may add {percent(fraction)}"
    info = {
        "photons": estimate.n_batches * photons_per_batch,
        "batches": estimate.n_batches,
        "seconds": time.perf_counter() - started,
        "error": errors.relative,
        "stopped": stopped,
    }
    ledger_stderr = {name: jnp.asarray(row) for name, row in zip(estimate.names, estimate.budgets.stderr)}
    return _Traced(
        estimate.response_sum, estimate.n_batches, jnp.asarray(errors.stderr), ledger_stderr, info, beyond
    )
