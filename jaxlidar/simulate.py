"""`simulate`: make the plan, trace batches of photons until the tolerance is met, and record the waveform."""

import dataclasses
import math
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxlidar._checks import check_integer, check_range, is_traced
from jaxlidar._statistics import batches_needed, errors_of, standard_error, widening
from jaxlidar._threads import ONE_CORE, side_by_side
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.planning.plan import MIN_BATCHES, Plan
from jaxlidar.planning.plan import plan as make_plan
from jaxlidar.planning.plan_check import check_plan
from jaxlidar.planning.setup import Setup, reduce
from jaxlidar.scenes.scene import Scene
from jaxlidar.trace.response import Response, trace_scene
from jaxlidar.waveform import Waveform, open_at_first_return, total_of, waveform_of


@dataclasses.dataclass(frozen=True)
class Progress:
    """How far a running simulation has come; `simulate` gives it to its argument `progress`.

    Printed, it is one line of text.

    - `batches`: batches traced so far.
    - `photons`: photons traced so far.
    - `seconds`: time spent so far.
    - `error`: relative error of the waveform so far, as `simulate` defines it.
    - `rtol`: relative error aimed at, or None where the number of photons is given.

    **Example:**

    >>> import jaxlidar as jl
    >>> print(jl.Progress(batches=8, photons=65536, seconds=1.5, error=0.004, rtol=0.01))
    8 batches, 65536 photons, 1.5 s, relative error 0.004 (aim 0.01)
    """

    batches: int
    photons: int
    seconds: float
    error: float
    rtol: float | None

    def __str__(self) -> str:
        goal = "" if self.rtol is None else f" (aim {self.rtol:.2g})"
        return (
            f"{self.batches} batches, {self.photons} photons, {self.seconds:.1f} s, "
            f"relative error {self.error:.2g}{goal}"
        )


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
    max_seconds: float = math.inf,
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
    - `max_orders`, `max_step`, `n_rays`, `window`, `bin_width`, `footprint`, `effects`: see `jaxlidar.plan`.
      Default None: as there.
    - `max_seconds`: stop after this time in s, however large the error; positive. At least eight batches are
      traced. Default inf.
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
    planning = {
        "max_orders": max_orders,
        "max_step": max_step,
        "n_rays": n_rays,
        "window": window,
        "bin_width": bin_width,
        "footprint": footprint,
        "effects": effects,
    }
    goal = _goal(rtol, atol, n_photons, max_seconds)
    plan = _planned(lidar, scene, plan, goal, planning)
    setup = reduce(lidar, scene, plan)
    traced = _trace_until(setup, key, goal, progress)
    return _recorded(setup, *traced)


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
    return dataclasses.replace(plan, n_photons=max(goal.n_photons // MIN_BATCHES, 1))


def _trace_until(
    setup: Setup, key: PRNGKeyArray, goal: _Goal, progress: Callable[[Progress], None] | None
) -> tuple[Response, Array | None, dict[str, Any]]:
    """The mean response, the standard error of its waveform (None: nothing is random), and the `info`."""
    if not setup.plan.is_random:
        started = time.perf_counter()
        response = jax.block_until_ready(_compiled_trace(setup, key))
        seconds = time.perf_counter() - started
        stopped = "nothing is random"
        return (
            response,
            None,
            {"photons": 0, "batches": 1, "error": 0.0, "stopped": stopped, "seconds": seconds},
        )
    if any(is_traced(x) for x in jax.tree.leaves((setup, key))):
        return (*_trace_within(setup, key), {})
    return _trace_batches(setup, key, goal, progress)


def _recorded(setup: Setup, response: Response, stderr: Array | None, info: dict[str, Any]) -> Waveform:
    """The waveform of a response, on the digitiser's bins."""
    wave = _compiled_waveform(response, setup, stderr=stderr)
    if setup.lidar.receiver.window == "first return" and not is_traced(wave.energy):
        wave = open_at_first_return(wave, setup.lidar)
    return dataclasses.replace(wave, info=info)


def _batch(setup: Setup, key: PRNGKeyArray) -> tuple[Response, Float[Array, "wavelengths samples"]]:
    response = trace_scene(setup, key)
    return response, total_of(response, setup)


_compiled_batch = eqx.filter_jit(_batch, **ONE_CORE)
_compiled_trace = eqx.filter_jit(trace_scene)
_compiled_waveform = eqx.filter_jit(
    lambda response, setup, stderr: waveform_of(response, setup, stderr=stderr)
)


def _trace_within(setup: Setup, key: PRNGKeyArray) -> tuple[Response, Array]:
    """A fixed number of batches, within a JAX transformation."""
    responses, totals = jax.lax.map(lambda k: _batch(setup, k), jax.random.split(key, MIN_BATCHES))
    mean = jax.tree.map(lambda a: jnp.mean(a, axis=0), responses)
    spread = jnp.var(jax.lax.stop_gradient(totals), axis=0)
    return mean, widening(MIN_BATCHES) * jnp.sqrt(spread / (MIN_BATCHES - 1))


def _trace_batches(
    setup: Setup, key: PRNGKeyArray, goal: _Goal, progress: Callable[[Progress], None] | None
) -> tuple[Response, Array, dict[str, Any]]:
    """Batches on all cores, round after round, until the goal is reached."""
    started, plan = time.perf_counter(), setup.plan
    fixed, rtol = goal.n_photons is not None, plan.rtol if goal.rtol is None else goal.rtol
    total: Any = None
    means: list[np.ndarray] = []
    wanted, stopped, error = MIN_BATCHES, "tolerance met", math.inf

    def one(n: int) -> tuple[Response, Array]:
        return _compiled_batch(setup, jax.random.fold_in(key, n))

    with side_by_side() as run:
        try:
            while True:
                for response, mean in run(one, range(len(means), wanted)):
                    total = response if total is None else _add(total, response)
                    means.append(np.asarray(mean))
                done, seconds = len(means), time.perf_counter() - started
                error, worst = errors_of(np.stack(means))
                if progress is not None:
                    progress(Progress(done, done * plan.n_photons, seconds, error, None if fixed else rtol))
                if fixed:
                    stopped = "photons traced"
                    break
                if error <= rtol or worst <= goal.atol:
                    break
                if seconds >= goal.max_seconds:
                    stopped = "time spent"
                    break
                wanted = batches_needed(done, error, rtol)
                if math.isfinite(goal.max_seconds):
                    affordable = done * goal.max_seconds / max(seconds, 1e-9)
                    wanted = max(min(wanted, int(affordable)), done + 1)
        except KeyboardInterrupt:
            if len(means) < MIN_BATCHES:
                raise
            error, _ = errors_of(np.stack(means))
            stopped = "interrupted"
    mean = jax.tree.map(lambda a: a / len(means), total)
    info = {
        "photons": len(means) * plan.n_photons if plan.orders > 1 or plan.trace.drawn_first else 0,
        "batches": len(means),
        "seconds": time.perf_counter() - started,
        "error": error,
        "stopped": stopped,
    }
    return mean, jnp.asarray(standard_error(np.stack(means))), info


@jax.jit
def _add(a: Any, b: Any) -> Any:
    return jax.tree.map(jnp.add, a, b)
