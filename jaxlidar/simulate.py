"""The one entry: plan, trace in batches until the tolerance is met, waveform."""

import dataclasses
import math
import time
from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxlidar._checks import is_traced
from jaxlidar._threads import ONE_CORE, side_by_side
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.planning.effects import without
from jaxlidar.planning.path_lengths import PathLengths
from jaxlidar.planning.plan import Plan
from jaxlidar.planning.plan import plan as make_plan
from jaxlidar.planning.scatterers import scene_optics, spell
from jaxlidar.scenes.scene import Scene, leaf_optics
from jaxlidar.trace.response import Response, trace_scene
from jaxlidar.waveform import Waveform, is_straight, open_at_first_return, total_of, waveform_of

# Fewer batches give no trustworthy standard error.
MIN_BATCHES = 8


@dataclasses.dataclass(frozen=True)
class Progress:
    """How far a simulation has come: batches and photons traced, seconds, and the relative error so far."""

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
    footprint: str = "random",
    effects: Mapping[str, bool] | None = None,
    max_seconds: float = math.inf,
    progress: Callable[[Progress], None] | None = None,
) -> Waveform:
    """The waveform that `lidar` records of `scene`.

    Batches of photons are traced until the error is below the tolerance. The error is the root mean
    square, over the samples above 1 % of the peak, of standard error over reflectance, for the worst
    wavelength. Where nothing is random (one plane; a fixed footprint and one order), one pass does.
    Standard errors are widened for few batches, by Student's t, so that the expected value lies within two
    of them in 95 % of cases; neglected orders (`Waveform.neglected`) and rounding come on top.

    **Arguments:**

    - `key`: a JAX random key: the same key gives the same waveform.
    - `rtol`, `atol`: stop when the error is below `rtol`, or the largest standard error below `atol`. Default
      0.01, unless `n_photons` is given.
    - `n_photons`: trace this many photons, in eight batches, whatever the error. Within a JAX
      transformation (grad, jacfwd, vmap over scenes) `n_photons` and `plan` are needed.
    - `plan`: what to simulate (`jaxlidar.plan`); the next arguments then have no say.
    - `max_orders`, `max_step`, `n_rays`, `window`, `bin_width`, `footprint`, `effects`: see `jaxlidar.plan`.
    - `max_seconds`: stop after this time, however large the error. An interrupt (Ctrl-C) after eight
      batches also ends the simulation with what is done.
    - `progress`: called with a `Progress` after every round of batches; for instance `print`.

    **Raises:** ValueError for inadmissible arguments, and for a plan that would miss parts of the scene.
    """
    for name, value in (("rtol", rtol), ("max_seconds", max_seconds)):
        if value is not None and not value > 0:
            raise ValueError(f"{name} = {value:g} is outside the admissible range (0, inf)")
    if not atol >= 0:
        raise ValueError(f"atol = {atol:g} is outside the admissible range [0, inf)")
    if n_photons is not None and (n_photons != int(n_photons) or n_photons < 1):
        raise ValueError(f"n_photons = {n_photons} is outside the admissible range [1, inf) of integers")
    if plan is None:
        plan = make_plan(
            lidar,
            scene,
            rtol=rtol,
            max_orders=max_orders,
            max_step=max_step,
            n_rays=n_rays,
            window=window,
            bin_width=bin_width,
            footprint=footprint,
            effects=effects,
            describe=False,
        )
    elif not any(is_traced(x) for x in jax.tree.leaves((lidar, scene))):
        _check_plan(plan, lidar, scene)
    if n_photons is not None:
        plan = dataclasses.replace(plan, n_photons=max(int(n_photons) // MIN_BATCHES, 1))
    if not plan.is_random:
        started = time.perf_counter()
        info = {"photons": 0, "batches": 1, "error": 0.0, "stopped": "nothing is random"}
        wave = _once(lidar, scene, plan, key)
        if lidar.receiver.window == "first return" and not is_traced(wave.energy):
            wave = open_at_first_return(wave, lidar)
        return dataclasses.replace(wave, info={**info, "seconds": time.perf_counter() - started})
    traced = any(is_traced(x) for x in jax.tree.leaves((lidar, scene, key)))
    if traced:
        return _simulate_traced(lidar, scene, plan, key)
    if n_photons is not None:
        rtol = None
    elif rtol is None:
        rtol = plan.rtol
    return _simulate_batches(
        lidar, scene, plan, key, rtol, atol, n_photons is not None, max_seconds, progress
    )


def _check_plan(plan: Plan, lidar: Lidar, scene: Scene) -> None:
    """Refuse a plan that would miss parts of the scene."""
    lidar, scene = without(lidar, scene, plan.off)
    top = -0.5 * PathLengths(lidar, scene).first
    if top > plan.trace.upstream:
        raise ValueError(
            f"plan starts {plan.trace.upstream:g} m before the reference plane; admissible for this scene "
            f"is more than {top:g} m: make the plan for the scene that reaches highest"
        )
    missing = set(spell(scene_optics(lidar, scene)).letters) - set(plan.trace.letters)
    if missing:
        raise ValueError(
            f"plan has {', '.join(plan.trace.letters) or 'no scatterers'}; admissible for this scene is one "
            f"that also has {', '.join(sorted(missing))}: make the plan with it"
        )


def trace_all(lidar: Lidar, scene: Scene, plan: Plan, key: PRNGKeyArray) -> Response | list[Response]:
    """One batch: a response, or one for each wavelength where leaves transmit straight on."""
    lidar, scene = without(lidar, scene, plan.off)
    if scene.canopy is None or not is_straight(scene):
        return trace_scene(lidar, scene, plan, key)
    _, t = leaf_optics(scene.canopy, lidar.wavelength)
    return [trace_scene(lidar, scene, plan, key, t[i]) for i in range(t.size)]


def total_all(
    response: Response | list[Response], lidar: Lidar, scene: Scene, plan: Plan
) -> Float[Array, "wavelengths samples"]:
    """Apparent reflectance per sample of a response, or of a list of one for each wavelength."""
    if not isinstance(response, list):
        return total_of(response, lidar, scene, plan)
    return jnp.stack([total_of(r, lidar, scene, plan)[i] for i, r in enumerate(response)])


def _batch(lidar: Lidar, scene: Scene, plan: Plan, key: PRNGKeyArray):
    response = trace_all(lidar, scene, plan, key)
    return response, total_all(response, lidar, scene, plan)


_compiled_batch = eqx.filter_jit(_batch, **ONE_CORE)


@eqx.filter_jit
def _once(lidar: Lidar, scene: Scene, plan: Plan, key: PRNGKeyArray) -> Waveform:
    return waveform_of(trace_all(lidar, scene, plan, key), lidar, scene, plan)


_finish = eqx.filter_jit(
    lambda response, lidar, scene, plan, stderr: waveform_of(response, lidar, scene, plan, stderr=stderr)
)


def _simulate_traced(lidar: Lidar, scene: Scene, plan: Plan, key: PRNGKeyArray) -> Waveform:
    responses, totals = jax.lax.map(
        lambda k: _batch(lidar, scene, plan, k), jax.random.split(key, MIN_BATCHES)
    )
    mean = jax.tree.map(lambda a: jnp.mean(a, axis=0), responses)
    spread = jnp.var(jax.lax.stop_gradient(totals), axis=0)
    stderr = _widening(MIN_BATCHES) * jnp.sqrt(spread / (MIN_BATCHES - 1))
    return waveform_of(mean, lidar, scene, plan, stderr=stderr)


def _simulate_batches(lidar, scene, plan, key, rtol, atol, fixed, max_seconds, progress) -> Waveform:
    started = time.perf_counter()
    total = None
    means: list[np.ndarray] = []
    done, wanted, stopped = 0, MIN_BATCHES, "tolerance met"
    error = math.inf

    def one(n: int):
        return _compiled_batch(lidar, scene, plan, jax.random.fold_in(key, n))

    with side_by_side() as run:
        try:
            while True:
                for response, mean in run(one, range(done, wanted)):
                    total = response if total is None else _add(total, response)
                    means.append(np.asarray(mean))
                    done += 1
                error, worst = _error(np.stack(means))
                seconds = time.perf_counter() - started
                if progress is not None:
                    progress(Progress(done, done * plan.n_photons, seconds, error, rtol))
                if fixed:
                    stopped = "photons traced"
                    break
                if error <= rtol or worst <= atol:
                    break
                if seconds >= max_seconds:
                    stopped = "time spent"
                    break
                # The error falls with the square root; four times as many at most before looking again.
                needed = done * (error / rtol) ** 2
                if needed > done:
                    needed *= (_widening(math.ceil(needed)) / _widening(done)) ** 2
                # In fours: what is left of a round would leave cores idle.
                needed = 4 * math.ceil(1.05 * needed / 4)
                wanted = int(min(max(needed, done + 4), 4 * done))
                if math.isfinite(max_seconds):
                    affordable = done * max_seconds / max(seconds, 1e-9)
                    wanted = max(min(wanted, int(affordable)), done + 1)
        except KeyboardInterrupt:
            if done < MIN_BATCHES:
                raise
            error, _ = _error(np.stack(means))
            stopped = "interrupted"
    mean = jax.tree.map(lambda a: a / done, total)
    stderr = jnp.asarray(_standard_error(np.stack(means)))
    wave = _finish(mean, lidar, scene, plan, stderr)
    if lidar.receiver.window == "first return":
        wave = open_at_first_return(wave, lidar)
    info = {
        "photons": done * plan.n_photons if plan.orders > 1 or plan.trace.drawn_first else 0,
        "batches": done,
        "seconds": time.perf_counter() - started,
        "error": error,
        "stopped": stopped,
    }
    return dataclasses.replace(wave, info=info)


@jax.jit
def _add(a, b):
    return jax.tree.map(jnp.add, a, b)


def _widening(batches: int) -> float:
    """Quantile of Student's t for the probability of two standard errors of a normal distribution, over two.

    By its expansion in 1 / degrees of freedom (Abramowitz and Stegun 26.7.5): to 0.1 % for eight batches.
    """
    x, n = 2.0, batches - 1
    terms = (
        (x**3 + x) / 4,
        (5 * x**5 + 16 * x**3 + 3 * x) / 96,
        (3 * x**7 + 19 * x**5 + 17 * x**3 - 15 * x) / 384,
    )
    return (x + sum(t / n ** (i + 1) for i, t in enumerate(terms))) / x


def _standard_error(
    means: Float[np.ndarray, "batches wavelengths bins"],
) -> Float[np.ndarray, "wavelengths bins"]:
    return _widening(len(means)) * np.std(means, axis=0, ddof=1) / math.sqrt(len(means))


def _error(means: Float[np.ndarray, "batches wavelengths bins"]) -> tuple[float, float]:
    """Relative error (see `simulate`) and largest standard error of the mean of batches."""
    mean = np.mean(means, axis=0)
    stderr = _standard_error(means)
    seen = mean > 0.01 * np.max(mean, axis=1, keepdims=True)
    squares = np.where(seen, (stderr / np.where(seen, mean, 1.0)) ** 2, 0.0)
    relative = np.sqrt(np.sum(squares, axis=1) / np.maximum(np.sum(seen, axis=1), 1))
    return float(np.max(relative, initial=0.0)), float(np.max(stderr))
