"""Energy budgets: light that a scene absorbs, returns to the sky and transmits to the ground, at any time."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxlidar._fields.checks import check_choice, check_integer, check_key, check_range, concrete_number
from jaxlidar._jax.programs import Program
from jaxlidar._jax.threads import side_by_side
from jaxlidar.planning.path_lengths import PathLengths
from jaxlidar.planning.plan import MIN_BATCHES
from jaxlidar.planning.plan import plan as make_plan
from jaxlidar.planning.setup import Setup, make_setup
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.progress import Progress, ProgressOption, shows_progress
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
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.spectral.apply_optics import budget_excess, refuse_excess, setup_optics
from jaxlidar.trace.device_scene import DeviceScene, build_device_scene
from jaxlidar.trace.photons.absorption import (
    EnergyFractions,
    from_beam,
    from_parallel_light,
    trace_to_end,
)

PHOTONS_PER_BATCH = 8192
# A flight through a canopy with periodic sides is followed over at most this many heights of the canopy.
MAX_FLIGHT_HEIGHTS = 300.0


@final
class EnergyBudget(eqx.Module):
    """Fractions of the emitted energy, (wavelengths,) each.

    - `absorbed`: by material, as in `Waveform.energy_budget`. - `returned`: to the sky, in whatever
      direction.
    - `transmitted`: arrived at the ground, every time light did: ground that reflects sees more than one
      pass.
    - `below`: left downward, where there is no ground. - `unfollowed`: not followed to its end.
    - `stderr`: one standard error of each, by name: materials, "returned", "transmitted", "below",
      "unfollowed".
    - `wavelength`: nm. - `info`: photons, batches, seconds, largest standard error and why it stopped.

    The fractions that are absorbed, returned, below and unfollowed add up to one.

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


@shows_progress
def energy_budget(
    lidar: Lidar,
    scene: Scene,
    *,
    key: PRNGKeyArray,
    rtol: float = 0.002,
    illumination: str = "beam",
    max_orders: int = 10_000,
    max_photons: int = 100_000_000,
    progress: ProgressOption = None,
) -> EnergyBudget:
    """Compute the energy that a scene absorbs, returns to the sky and transmits to the ground.

    Unlike `Waveform.energy_budget` it has no window and no last order: photons carry their energy, and end
    where they are absorbed or leave. The atmosphere, the receiver and the pulse do not count.

    **Arguments:**

    - `lidar`: its beam, or its direction, sends the light; at its wavelengths.
    - `scene`: a `Scene`; its atmosphere is ignored.
    - `key`: a JAX random key: the same key gives the same budget.
    - `rtol`: stop when the largest standard error of any fraction is below this fraction of the emitted
      energy, in (0, 1). Default 0.002.
    - `illumination`: "beam" (default), or "parallel": light from the beam's direction over one period of a
      canopy with periodic sides.
    - `max_orders`: follow light for this many scatterings, at least 1; what remains then is `unfollowed`.
      Default 10,000.
    - `max_photons`: stop after this number of photons, at least 1, whatever the error. Default 100,000,000.
    - `progress`: True for a bar with the error and the time left; or a function called with a `Progress`
      after every round. Default None: silent.

    An interrupt (Ctrl-C) after eight batches ends it with the batches that are done.

    **Returns:** an `EnergyBudget`.

    **Raises:** ValueError for values outside their ranges, and for parallel light where the canopy has open
    sides; TypeError for arguments of another kind; KeyboardInterrupt where it is interrupted before eight
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
    # Light is followed to its end: it may meet meshes that no ray of order one meets.
    effects = {"meshes": True} if scene.meshes else None
    plan = make_plan(lidar, scene, max_orders=1, effects=effects, describe=False)
    setup = _with_longest_flights(make_setup(lidar, scene, plan))
    start_time = time.perf_counter()
    # Built here: a program that took the setup would be compiled for every number of voxels.
    device_scene, optics = build_device_scene(setup, derivatives="none"), setup_optics(setup)

    def trace_batch(number: int) -> EnergyFractions:
        batch_key = jax.random.fold_in(key, number)
        return _compiled_trace(device_scene, optics, batch_key, illumination == "parallel", max_orders)

    with side_by_side() as run:
        estimate = _BudgetEstimate(lambda numbers: run(trace_batch, numbers))

        def report(errors: HasErrors) -> None:
            if callable(progress):
                photons = estimate.n_batches * PHOTONS_PER_BATCH
                seconds = time.perf_counter() - start_time
                progress(Progress(photons, None, seconds, "photons", error=errors.relative, rtol=rtol))

        stop = StoppingRule(rtol, min_size=MIN_BATCHES, max_size=-(-max_photons // PHOTONS_PER_BATCH))
        reason, errors = sample_until(estimate, stop, BATCH_STEPS, report=report, keeps_interrupted=True)
    info = {
        "photons": estimate.n_batches * PHOTONS_PER_BATCH,
        "batches": estimate.n_batches,
        "seconds": time.perf_counter() - start_time,
        "error": errors.relative,
        "stopped": reason.value,
    }
    names = setup.plan.config.materials
    mean, stderr = (
        _by_name(fractions, names) for fractions in (estimate.moments.mean, estimate.moments.stderr)
    )
    # Light that arrives at the ground is absorbed there or goes on: it is no further fate.
    budget, errors_of_budget = ({k: v for k, v in a.items() if k != "transmitted"} for a in (mean, stderr))
    refuse_excess(np.asarray(budget_excess(budget, errors_of_budget)))
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
    """Moments of the energy fractions of batches of photons.

    `trace`: traces the batches with the given numbers.
    """

    def __init__(self, trace: Callable[[range], Iterable[EnergyFractions]]):
        self.trace = trace
        self.moments: Any = None

    @property
    def n_batches(self) -> int:
        """Number of batches."""
        return 0 if self.moments is None else self.moments.count

    def add_batches(self, numbers: range) -> None:
        """Trace batches and add them."""
        for fractions in self.trace(numbers):
            moments = RunningMoments.on_host(fractions) if self.moments is None else self.moments
            self.moments = moments.update(fractions)

    def errors(self) -> EstimateErrors:
        """Return the largest standard error: it is relative to the emitted energy, which is one."""
        stderr = jax.tree.leaves(self.moments.stderr)
        return EstimateErrors(max(float(np.max(a, initial=0.0)) for a in stderr))


def _by_name(fractions: Any, materials: Sequence[str]) -> dict[str, Float[Array, "wavelengths"]]:
    """Return energy fractions, or their standard errors, by name."""
    rows = dict(zip(materials, fractions.absorbed))
    rows |= {"returned": fractions.up, "below": fractions.down}
    rows |= {"transmitted": fractions.on_ground, "unfollowed": fractions.unfollowed}
    return {name: jnp.asarray(row) for name, row in rows.items()}


def _with_longest_flights(setup: Setup) -> Setup:
    """Follow flights as far as they may go, whatever the record's window is."""
    canopy, plan = setup.scene.canopy, setup.plan
    if canopy is None or canopy.sides == "open":
        return setup
    lengths = PathLengths(setup.lidar, setup.scene)
    height = concrete_number(canopy.voxels.voxel_size[2]) * canopy.voxels.shape[2]
    max_flight = min(MAX_FLIGHT_HEIGHTS * height, lengths.longest_affordable_flight)
    plan = plan.with_limits(max_flight=max_flight).with_config(
        max_faces=size_bucket(lengths.voxels_along(max_flight))
    )
    return dataclasses.replace(setup, plan=plan)


def _trace(
    scene: DeviceScene,
    optics: Float[Array, "channels wavelengths"],
    key: PRNGKeyArray,
    parallel: bool,
    max_orders: int,
) -> EnergyFractions:
    """Trace one batch; where leaves transmit straight on, once for each wavelength."""
    source = from_parallel_light if parallel else from_beam
    if scene.straight_transmittance is None:
        return trace_to_end(scene, optics, key, PHOTONS_PER_BATCH, source, max_orders)

    def trace_wavelength(of_wavelength: tuple[Array, Array]) -> EnergyFractions:
        transmittance, optics = of_wavelength
        wavelength_scene = scene.with_leaf_transmittance(transmittance)
        return trace_to_end(wavelength_scene, optics[:, None], key, PHOTONS_PER_BATCH, source, max_orders)

    spectra = jax.lax.map(trace_wavelength, (scene.straight_transmittance, optics.T))
    return EnergyFractions(
        absorbed=jnp.moveaxis(spectra.absorbed[..., 0], 0, 1),
        up=spectra.up[:, 0],
        down=spectra.down[:, 0],
        on_ground=spectra.on_ground[:, 0],
        unfollowed=spectra.unfollowed[:, 0],
    )


_compiled_trace = Program(_trace, one_core=True)
