"""Energy budgets: what a scene absorbs, returns to the sky and lets through to the ground, at any time."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxlidar._checks import briefly, check_choice, check_integer, check_key, check_range, known_number
from jaxlidar._programs import Program
from jaxlidar._progress import Progress
from jaxlidar._threads import ONE_CORE, side_by_side
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.planning.path_lengths import PathLengths
from jaxlidar.planning.plan import MIN_BATCHES
from jaxlidar.planning.plan import plan as make_plan
from jaxlidar.planning.setup import Setup, reduce
from jaxlidar.sampling.adaptive import (
    BATCH_STEPS,
    AbstractEstimate,
    EstimateErrors,
    HasErrors,
    StoppingRule,
    sample_until,
)
from jaxlidar.sampling.moments import RunningMoments
from jaxlidar.scenes.scene import Scene, check_kinds
from jaxlidar.trace.colouring import optics_of
from jaxlidar.trace.fates import Fates, follow, from_beam, from_the_sky
from jaxlidar.trace.setting import setting_of, straight_transmittance

# Photons of a batch.
BATCH = 8192
# Heights of the canopy over which a flight is followed at most where the canopy has no sides.
REACH = 300.0


@final
@briefly
class EnergyBudget(eqx.Module):
    """Shares of the emitted energy, (wavelengths,) each.

    - `absorbed`: by material, as in `Waveform.ledger`. - `returned`: to the sky, in whatever direction.
    - `transmitted`: arrived at the ground, every time light did: ground that reflects sees more than one
      pass.
    - `below`: left downward, where there is no ground. - `unfollowed`: not followed to its end.
    - `stderr`: one standard error of each, by name: materials, "returned", "transmitted", "below",
      "unfollowed".
    - `wavelength`: nm. - `info`: photons, batches, seconds, largest standard error and why it stopped.

    What is absorbed, returned, below and unfollowed adds up to one.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> scene = jl.Scene(ground=jl.Ground(reflectance=0.4))
    >>> budget = jl.energy_budget(jl.Lidar(), scene, key=jax.random.key(0))
    >>> print(f"{float(budget.absorbed['ground'][0]):.2f}")
    0.60
    """

    absorbed: dict[str, Float[Array, "wavelengths"]]
    returned: Float[Array, "wavelengths"]
    transmitted: Float[Array, "wavelengths"]
    below: Float[Array, "wavelengths"]
    unfollowed: Float[Array, "wavelengths"]
    stderr: dict[str, Float[Array, "wavelengths"]]
    wavelength: Float[Array, "wavelengths"]
    info: dict = eqx.field(static=True)


def energy_budget(
    lidar: Lidar,
    scene: Scene,
    *,
    key: PRNGKeyArray,
    rtol: float = 0.002,
    illumination: str = "beam",
    max_orders: int = 10_000,
    max_photons: int = 100_000_000,
    progress: Callable[[Progress], None] | None = None,
) -> EnergyBudget:
    """What a scene absorbs, returns to the sky and lets through, of light that is followed to its end.

    Unlike `Waveform.ledger` it knows no window and no last order: photons carry their energy, and end where
    they are absorbed or leave. The atmosphere, the receiver and the pulse do not count.

    **Arguments:**

    - `lidar`: its beam, or its direction, sends the light; at its wavelengths.
    - `scene`: a `Scene`; its atmosphere is passed over.
    - `key`: a JAX random key: the same key gives the same budget.
    - `rtol`: stop when the largest standard error of any share is below this share of the emitted energy, in
      (0, 1). Default 0.002.
    - `illumination`: "beam" (default), or "parallel": light from the beam's direction over one period of a
      canopy with periodic sides.
    - `max_orders`: scatterings followed, at least 1; what is left then is `unfollowed`. Default 10,000.
    - `max_photons`: stop after so many, at least 1, whatever the error. Default 100,000,000.
    - `progress`: a function called with a `Progress` after every round; for instance `print`. Default None.

    An interrupt (Ctrl-C) after eight batches ends it with what is done.

    **Returns:** an `EnergyBudget`.

    **Raises:** ValueError for values outside their ranges, and for parallel light where the canopy has open
    sides; TypeError for things of another kind; KeyboardInterrupt where it is interrupted before eight
    batches.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> plate = jl.Plate(height=2.0, reflectance=0.5, transmittance=0.3)
    >>> scene = jl.Scene(plates=(plate,), ground=jl.Ground(reflectance=1.0))
    >>> budget = jl.energy_budget(jl.Lidar(), scene, key=jax.random.key(0))
    >>> print(f"{float(budget.returned[0]):.2f}")  # 0.5 + 0.3 * 0.3 / (1 - 0.5)
    0.68
    """
    check_kinds(lidar, scene)
    check_key(key)
    check_range("rtol", rtol, 0.0, 1.0, low_open=True, high_open=True)
    check_choice("illumination", illumination, ("beam", "parallel"))
    max_orders = check_integer("max_orders", max_orders)
    max_photons = check_integer("max_photons", max_photons)
    if illumination == "parallel" and (scene.canopy is None or scene.canopy.sides != "periodic"):
        raise ValueError("illumination = 'parallel'; that is admissible where the canopy has periodic sides")
    setup = _endless(reduce(lidar, scene, make_plan(lidar, scene, max_orders=1, describe=False)))
    start_time = time.perf_counter()

    def trace_batch(number: int) -> Fates:
        return _compiled(setup, jax.random.fold_in(key, number), illumination == "parallel", max_orders)

    with side_by_side() as run:
        estimate = _BudgetEstimate(lambda numbers: run(trace_batch, numbers))

        def report(errors: HasErrors) -> None:
            if progress is not None:
                batches, seconds = estimate.n_batches, time.perf_counter() - start_time
                progress(Progress(batches, batches * BATCH, seconds, errors.relative, rtol))

        stop = StoppingRule(rtol, min_size=MIN_BATCHES, max_size=-(-max_photons // BATCH))
        reason, errors = sample_until(estimate, stop, BATCH_STEPS, report=report, keeps_interrupted=True)
    info = {
        "photons": estimate.n_batches * BATCH,
        "batches": estimate.n_batches,
        "seconds": time.perf_counter() - start_time,
        "error": errors.relative,
        "stopped": reason.value,
    }
    names = setup.plan.trace.materials
    mean, stderr = (_named(fates, names) for fates in (estimate.moments.mean, estimate.moments.stderr))
    return EnergyBudget(
        absorbed={name: mean[name] for name in names},
        returned=mean["returned"],
        transmitted=mean["transmitted"],
        below=mean["below"],
        unfollowed=mean["unfollowed"],
        stderr=stderr,
        wavelength=lidar.wavelength,
        info=info,
    )


class _BudgetEstimate(AbstractEstimate):
    """Moments of the absorption and escape of batches of photons.

    `trace`: traces the batches with the given numbers.
    """

    def __init__(self, trace: Callable[[range], Iterable[Fates]]):
        self.trace = trace
        self.moments: Any = None

    @property
    def n_batches(self) -> int:
        """Number of batches."""
        return 0 if self.moments is None else self.moments.count

    def add_batches(self, numbers: range) -> None:
        """Trace batches and add them."""
        for fates in self.trace(numbers):
            moments = RunningMoments.on_host(fates) if self.moments is None else self.moments
            self.moments = moments.update(fates)

    def errors(self) -> EstimateErrors:
        """Return the largest standard error: it is relative to the emitted energy, which is one."""
        return EstimateErrors(
            max(float(np.max(a, initial=0.0)) for a in jax.tree.leaves(self.moments.stderr))
        )


def _named(fates: Any, materials: Sequence[str]) -> dict[str, Float[Array, "wavelengths"]]:
    """Return the rows of absorption and escape by name."""
    rows = dict(zip(materials, fates.absorbed))
    rows |= {"returned": fates.up, "below": fates.down}
    rows |= {"transmitted": fates.on_ground, "unfollowed": fates.unfollowed}
    return {name: jnp.asarray(row) for name, row in rows.items()}


def _endless(setup: Setup) -> Setup:
    """With flights that are followed as far as it takes, whatever the record's window is."""
    canopy, trace = setup.scene.canopy, setup.plan.trace
    if canopy is None or canopy.sides == "open":
        return setup
    lengths = PathLengths(setup.lidar, setup.scene)
    height = known_number(canopy.voxels.voxel_size[2]) * canopy.voxels.shape[2]
    flight = min(REACH * height, lengths.longest_march)
    trace = dataclasses.replace(trace, max_flight=flight, march_steps=lengths.voxels_along(flight))
    return dataclasses.replace(setup, plan=dataclasses.replace(setup.plan, trace=trace))


def _trace(setup: Setup, key: PRNGKeyArray, parallel: bool, max_orders: int) -> Fates:
    source = from_the_sky if parallel else from_beam
    optics, transmittance = optics_of(setup), straight_transmittance(setup)
    setting = setting_of(setup, derivatives="none")
    if transmittance is None:
        return follow(setting, optics, key, BATCH, source, max_orders)
    # Where leaves transmit straight on, every wavelength has an extinction of its own.

    def one(given: tuple[Array, Array]) -> Fates:
        t, own = given
        return follow(setting.thinned(t), own[:, None], key, BATCH, source, max_orders)

    each = jax.lax.map(one, (transmittance, optics.T))
    absorbed = jnp.moveaxis(each.absorbed[..., 0], 0, 1)
    return Fates(absorbed, *(a[:, 0] for a in (each.up, each.down, each.on_ground, each.unfollowed)))


_compiled = Program(_trace, **ONE_CORE)
