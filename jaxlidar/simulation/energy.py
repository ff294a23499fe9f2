"""Energy budgets: light that a scene absorbs, returns to the sky and transmits to the ground, at any time."""

import dataclasses
import time
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxlidar._fields.checks import (
    check_choice,
    check_integer,
    check_key,
    check_range,
    concrete_array,
    concrete_number,
    has_tracers,
    is_within_program,
)
from jaxlidar._jax.programs import Program
from jaxlidar._jax.threads import side_by_side
from jaxlidar.planning.memory import MAX_APPLIED_WAVELENGTHS
from jaxlidar.planning.path_lengths import PathLengths
from jaxlidar.planning.plan import MIN_BATCHES
from jaxlidar.planning.plan import plan as make_plan
from jaxlidar.planning.setup import Setup, make_setup
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.progress import Progress, ProgressOption, shows_progress
from jaxlidar.sampling.adaptive import (
    BATCH_STEPS,
    HasErrors,
    MeanEstimate,
    StoppingRule,
    sample_until,
)
from jaxlidar.scenes.scene import Scene, check_kinds
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.simulation.reflectance import distance_above, parallel_lidar
from jaxlidar.spectral.apply_optics import budget_excess, refuse_excess
from jaxlidar.trace.device_scene import DeviceScene, build_device_scene
from jaxlidar.trace.first.footprint import bistatic_beam
from jaxlidar.trace.photons.absorption import trace_to_end

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

    The fractions that are absorbed, returned, below and unfollowed add up to one, to single precision. What a
    material absorbs is what arrived there less what went on: within its standard error it may be below zero
    for one that absorbs nothing, and what returns above one. Standard errors come from eight batches at least
    and are widened for so few: deviations of three of them are more frequent than for a normal distribution.

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

    An interrupt (Ctrl-C) after eight batches ends it with the batches that are done. It has no derivatives;
    `Waveform.energy_budget` has.

    **Returns:** an `EnergyBudget`.

    **Raises:** ValueError for values outside their ranges, and for parallel light where the canopy has open
    sides; TypeError for arguments of another kind, and inside a JAX transformation; KeyboardInterrupt where
    it is interrupted before eight batches.

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
    if is_within_program() or has_tracers((lidar, scene, key)):
        raise TypeError(
            "energy_budget cannot run inside a JAX transformation (jit, grad, vmap, ...): it traces until "
            "the tolerance is met. Call it outside, or use Waveform.energy_budget of simulate with a plan "
            "that is made outside"
        )
    check_range("rtol", rtol, 0.0, 1.0, low_open=True, high_open=True)
    check_choice("illumination", illumination, ("beam", "parallel"))
    max_orders = check_integer("max_orders", max_orders)
    max_photons = check_integer("max_photons", max_photons)
    if illumination == "parallel" and (scene.canopy is None or scene.canopy.sides != "periodic"):
        raise ValueError("illumination = 'parallel'; that is admissible where the canopy has periodic sides")
    # Light is followed to its end: it may meet meshes that no ray of order one meets.
    effects = {"meshes": True} if scene.meshes else None
    canopy, size = scene.canopy if illumination == "parallel" else None, np.zeros(2)
    if canopy is not None:
        size = concrete_array(canopy.voxels.voxel_size)[:2] * canopy.voxels.shape[:2]
        centre = concrete_array(canopy.voxels.origin)[:2] + 0.5 * size
        lidar = parallel_lidar(lidar.wavelength, lidar.zenith, lidar.azimuth, centre)
    plan = make_plan(lidar, scene, max_orders=1, effects=effects, describe=False)
    if canopy is not None:
        plan = plan.with_limits(start_distance=distance_above(lidar, scene, size))
    setup = _without_record(make_setup(lidar, scene, plan))
    start_time = time.perf_counter()
    # Built here: a program that took the setup would be compiled for every number of voxels.
    device_scene = build_device_scene(setup, derivatives="none")
    if canopy is not None:
        # The aim point, the middle of the period, is the origin.
        beam = bistatic_beam(setup.lidar, None, jnp.asarray(-0.5 * size, float), jnp.asarray(size, float))
        device_scene = dataclasses.replace(device_scene, beam=beam)

    def trace_batch(number: int) -> dict[str, Array]:
        return _compiled_trace(device_scene, jax.random.fold_in(key, number), max_orders)

    with side_by_side() as run:
        estimate = MeanEstimate(lambda numbers: run(trace_batch, numbers))

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
    mean, stderr = (jax.tree.map(jnp.asarray, a) for a in (estimate.moments.mean, estimate.moments.stderr))
    # Light that arrives at the ground is absorbed there or goes on: it is no further fate.
    budget, errors_of_budget = ({k: v for k, v in a.items() if k != "transmitted"} for a in (mean, stderr))
    refuse_excess(np.asarray(budget_excess(budget, errors_of_budget)))
    return EnergyBudget(
        absorbed={name: mean[name] for name in plan.config.materials},
        returned=mean["returned"],
        transmitted=mean["transmitted"],
        below=mean["below"],
        unfollowed=mean["unfollowed"],
        stderr=stderr,
        wavelength=lidar.wavelength,
        info=info,
    )


def _without_record(setup: Setup) -> Setup:
    """Apply optics to light while it is traced, and follow it as far as it may go, whatever the window is."""
    canopy, plan = setup.scene.canopy, setup.plan
    # A square of it still has its place in single precision.
    plan = plan.with_limits(max_path=1e15).with_config(
        keeps_histories=False,
        degree=0,
        order_steps=2,
        deposits_per_flight=1,
        photons_per_batch=PHOTONS_PER_BATCH,
    )
    if canopy is not None and canopy.sides == "periodic":
        lengths = PathLengths(setup.lidar, setup.scene)
        height = concrete_number(canopy.voxels.voxel_size[2]) * canopy.voxels.shape[2]
        max_flight = min(MAX_FLIGHT_HEIGHTS * height, lengths.longest_affordable_flight)
        max_faces = size_bucket(lengths.voxels_along(max_flight))
        plan = plan.with_limits(max_flight=max_flight).with_config(max_faces=max_faces)
    return dataclasses.replace(setup, plan=plan)


def _trace(scene: DeviceScene, key: PRNGKeyArray, max_orders: int) -> dict[str, Array]:
    """Trace one batch.

    It is traced once for every few wavelengths; where leaves transmit straight on, for each.
    """
    optics, transmittance = scene.optics, scene.straight_transmittance
    assert optics is not None
    n_wavelengths = optics.shape[1]
    size = min(n_wavelengths, MAX_APPLIED_WAVELENGTHS if transmittance is None else 1)

    def trace_wavelengths(numbers: Array) -> dict[str, Array]:
        few = scene if transmittance is None else scene.with_leaf_transmittance(transmittance[numbers[0]])
        return trace_to_end(dataclasses.replace(few, optics=optics[:, numbers]), key, max_orders)

    # The last group is filled up with copies of the last wavelength.
    numbers = jnp.minimum(jnp.arange(-(-n_wavelengths // size) * size), n_wavelengths - 1)
    groups = jax.lax.map(trace_wavelengths, numbers.reshape(-1, size))
    return jax.tree.map(lambda a: a.reshape(-1)[:n_wavelengths], groups)


_compiled_trace = Program(_trace, one_core=True)
