"""The strategy per shot: every shot has photons of its own.

One compiled program traces any shots of a survey, one after the other (`lax.map`), each until its tolerance
is met. The cost of the voxel map (its layout, the optical depth above every voxel) is paid once for all shots
of a chunk. No shot needs a window of the map, and none costs more over a larger map: light is followed as far
as it goes, and only the voxels that it meets are read.

A batch estimates the response of a shot without bias from its own random key. The error of n batches falls in
one of two ways:

- Higher orders: photons are independent. The error falls as n^-1/2, and batches are added.
- First order alone: a batch is the mean over the N rays of a randomly shifted Fibonacci lattice in the
  footprint. Its error falls as N^-3/4 where the integrand jumps along a line, as at the edges of crowns: the
  jump crosses about N^1/2 of the cells around points, each with an independent error of about 1 / N, which
  gives N^1/4 / N. (He and Owen 2016, J. R. Stat. Soc. B 78, 917, prove this rate for stratified points along
  a space-filling curve.) So N grows and the number of batches stays at the fewest that tell a standard error.
  A lattice of N = m N_0 rays is traced in m parts of N_0 rays, since compiled programs need fixed shapes.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxlidar._programs import Program
from jaxlidar._threads import ONE_CORE
from jaxlidar._workers import WorkUnit, task
from jaxlidar.instrument.survey import Survey
from jaxlidar.planning.plan import MIN_BATCHES
from jaxlidar.planning.setup import Setup
from jaxlidar.sampling.adaptive import StepRule, StoppingRule, sample_until_compiled
from jaxlidar.sampling.errors import relative_error
from jaxlidar.sampling.moments import RunningMoments
from jaxlidar.spectral.apply_optics import (
    BudgetTerms,
    WaveformModel,
    budget_terms,
    component_samples,
    make_waveform_model,
    relative_energy_samples,
    total_samples,
)
from jaxlidar.survey.results import ShotErrors, ShotResults, make_shot_results
from jaxlidar.survey.strategy import AbstractStrategy, slices_of_shots
from jaxlidar.trace.device_scene import DeviceScene, aim_at, build_device_scene
from jaxlidar.trace.footprint import RaySlice
from jaxlidar.trace.response import Response, trace_device_scene, trace_first_only

# Largest number of shots of a chunk, of first order alone and of more: a chunk cannot be interrupted.
_CHUNK_FIRST_ORDER, _CHUNK_HIGHER_ORDERS = 128, 16
# Largest number of batches of a shot, or of parts of a lattice: a tolerance that is out of reach ends here.
MAX_BATCHES_OR_PARTS = 1024
# Rays that are marched side by side: more would not fit into a processor's cache.
_RAYS_SIDE_BY_SIDE = 512
# Batches of a shot follow one another, so that steps could be as small as one. The error is looked at after
# every fourth: an estimate that stops at the first moment at which it seems precise is wrong more often.
_BATCH_STEPS = StepRule(max_growth=1.0, min_step=4)
# Coarser lattices are dropped when denser ones are traced: small steps would waste most of the rays.
_LATTICE_STEPS = StepRule(convergence_rate=0.75, safety=1.2, min_growth=2.0, max_growth=32.0)


class ShotGeometry(NamedTuple):
    """Geometry of shots; axis 0 is the shots'.

    - `number`: of each in the survey. - `position`: m, from the survey's origin. - `zenith`, `azimuth`:
      degrees. - `altitude`: m; None where `position` is that of the sensor.
    """

    number: Int[Array, "*shots"] | np.ndarray
    position: Float[Array, "*shots axes"] | np.ndarray
    zenith: Float[Array, "*shots"] | np.ndarray
    azimuth: Float[Array, "*shots"] | np.ndarray
    altitude: Float[Array, "*shots"] | np.ndarray | None

    def as_arrays(self) -> "ShotGeometry":
        """Return the same in JAX's present precision."""

        def convert(a: Any) -> Any:
            return None if a is None else jnp.asarray(a, float)

        return ShotGeometry(jnp.asarray(self.number), *map(convert, self[1:]))


def shot_geometry(survey: Survey, first: int, count: int) -> ShotGeometry:
    """Return `count` shots from number `first` on; copies of the last one fill up what there are fewer."""
    shots = np.minimum(np.arange(first, first + count), len(survey) - 1)
    altitude = None if survey.altitude is None else survey.altitude[shots]
    position, zenith, azimuth = (a[shots] for a in (survey.position, survey.zenith, survey.azimuth))
    return ShotGeometry(shots.astype(np.int32), position, zenith, azimuth, altitude)


def setup_of_shot(setup: Setup, shot: ShotGeometry) -> Setup:
    """Return the setup with the lidar aimed at one shot."""
    # `tree_at` sets nested fields without the constructors' checks, which traced values cannot have.
    names = ("position", "zenith", "azimuth", *(() if shot.altitude is None else ("altitude",)))
    return eqx.tree_at(
        lambda s: tuple(getattr(s.lidar, name) for name in names),
        setup,
        tuple(getattr(shot, name) for name in names),
    )


def aim_offset(setup: Setup, shot: ShotGeometry) -> Float[Array, "axes"]:
    """Return how far the aim point of a shot lies from that of a setup's lidar, m, east, north (and up)."""
    if shot.altitude is None:
        return setup_of_shot(setup, shot).lidar.aim_point - setup.lidar.aim_point
    return jnp.asarray(shot.position) - setup.lidar.position


@dataclasses.dataclass(frozen=True)
class PerShotStrategy(AbstractStrategy):
    """Every shot has photons of its own; a task is a chunk of shots."""

    @property
    def shots_per_chunk(self) -> int:
        """Number of shots of a chunk.

        It depends on the survey and the plan alone, not on the number of workers.
        """
        shots = len(self.survey)
        largest = _CHUNK_HIGHER_ORDERS if self.setup.plan.orders > 1 else _CHUNK_FIRST_ORDER
        largest = min(largest, max(1, shots // 8))
        # Chunks of nearly equal size: the copies that fill up the last one are traced in vain.
        return -(-shots // -(-shots // largest))

    def tasks(self, key: PRNGKeyArray) -> list[WorkUnit]:
        return [
            task(number, trace_chunk, (self.setup, self._chunk_geometry(shots), self.rtol), key)
            for number, shots in enumerate(self.shot_slices)
        ]

    def _chunk_geometry(self, shots: slice) -> ShotGeometry:
        return shot_geometry(self.survey, shots.start, self.shots_per_chunk)

    @property
    def n_tasks(self) -> int:
        return len(self.shot_slices)

    @property
    def shot_slices(self) -> list[slice]:
        return slices_of_shots(len(self.survey), self.shots_per_chunk)

    def result_class(self, number: int) -> type[ShotResults]:
        return ShotResults

    def shot_results(self, task_results: Mapping[int, Any]) -> Iterator[tuple[slice, ShotResults]]:
        for number, shots in enumerate(self.shot_slices):
            # Without the copies that fill up the last chunk.
            count = shots.stop - shots.start
            yield shots, jax.tree.map(lambda a, n=count: a[:n], task_results[number])

    def info(self) -> dict[str, Any]:
        return {"shared": False}


def trace_chunk(setup: Setup, shots: ShotGeometry, rtol: float, key: PRNGKeyArray) -> ShotResults:
    """Trace a chunk of shots."""
    return compiled_shots(setup, shots.as_arrays(), key, jnp.asarray(rtol))


class ShotBatch(NamedTuple):
    """Samples by component and of the relative energy, and the energy budget, of a shot."""

    components: dict[str, Float[Array, "wavelengths samples"]]
    relative_energy: Float[Array, "wavelengths samples"]
    budget: BudgetTerms

    @staticmethod
    def of_response(response: Response, model: WaveformModel) -> "ShotBatch":
        """Apply optics, atmosphere and pulse to a response."""
        return ShotBatch(
            component_samples(response, model),
            relative_energy_samples(response, model),
            budget_terms(response, model),
        )


def _trace_shot(
    scene: DeviceScene, setup: Setup, shot: ShotGeometry, key: PRNGKeyArray, rtol: Array
) -> ShotResults:
    """Trace one shot until its tolerance is met.

    1. Aim the lidar and the device scene, which are those of the survey's middle, at the shot.
    2. Where nothing is random, trace one batch: its errors are zero.
    3. Otherwise refine the estimate, by more batches or by denser lattices.
    """
    offset = aim_offset(setup, shot)
    # The key follows from the shot's number: its waveform does not depend on chunks or workers.
    setup, key = setup_of_shot(setup, shot), jax.random.fold_in(key, shot.number)
    scene, model = aim_at(scene, setup.lidar, offset), make_waveform_model(setup)
    if not setup.plan.is_random:
        batch = ShotBatch.of_response(trace_device_scene(scene, key), model)
        waveform, energy_budget = jax.tree.map(jnp.zeros_like, _with_errors(batch))
        errors = ShotErrors(waveform, energy_budget, jnp.zeros(()))
        return make_shot_results(model, *batch, errors, photons=jnp.zeros((), jnp.int32))

    refine = _add_batches if scene.config.follows_higher_orders else _densify_lattices
    estimate = refine(scene, model, key, rtol)
    waveform_stderr, energy_budget_stderr = estimate.stderr
    errors = ShotErrors(waveform_stderr, energy_budget_stderr, _relative_error(estimate))
    mean: ShotBatch = estimate.mean_only
    photons = estimate.count * setup.plan.photons_traced
    return make_shot_results(model, *mean, errors, photons=photons)


def _with_errors(batch: ShotBatch) -> tuple[Array, dict[str, Array]]:
    """Return the quantities whose standard errors are reported: the waveform and the energy budget."""
    return batch.components["first"] + batch.components["higher"], batch.budget.energy_budget


def _relative_error(estimate: RunningMoments) -> Array:
    """Return the relative error of the waveform of a shot."""
    return relative_error(estimate.mean[0], estimate.stderr[0])


def _add_batches(scene: DeviceScene, model: WaveformModel, key: PRNGKeyArray, rtol: Array) -> RunningMoments:
    """Trace batch after batch until the error is below the tolerance."""

    @eqx.filter_jit
    def trace_batch(number: Array) -> ShotBatch:
        return ShotBatch.of_response(trace_device_scene(scene, jax.random.fold_in(key, number)), model)

    def add_batch(number: Array, estimate: RunningMoments) -> RunningMoments:
        batch = trace_batch(number)
        return estimate.update(_with_errors(batch), batch)

    def refine(estimate: RunningMoments, size: Array, next_size: Array) -> RunningMoments:
        return jax.lax.fori_loop(size, next_size, add_batch, estimate)

    shapes = jax.eval_shape(trace_batch, jnp.zeros((), jnp.int32))
    no_batches = RunningMoments.in_program(_with_errors(_zeros(shapes)), shapes)
    stop = StoppingRule(rtol, min_size=MIN_BATCHES, max_size=MAX_BATCHES_OR_PARTS)
    return sample_until_compiled(refine, no_batches, _relative_error, stop, _BATCH_STEPS)


def _densify_lattices(
    scene: DeviceScene, model: WaveformModel, key: PRNGKeyArray, rtol: Array
) -> RunningMoments:
    """Trace eight lattices, again with more parts, until the error is below the tolerance.

    1. Trace the lattices. Where each has few rays, several are marched side by side: a step costs about as
       much for a few rays as for hundreds.
    2. Apply optics and pulse to each of them, but in its sum over materials alone: that is what their scatter
       is needed for.
    3. When the tolerance is met, apply them to the mean of the responses, component by component.
    """
    side_by_side = math.gcd(MIN_BATCHES, max(_RAYS_SIDE_BY_SIDE // scene.config.n_rays, 1))

    def trace_lattice(number: Array, n_parts: Array) -> tuple[tuple[Array, dict[str, Array]], Response]:
        response = _trace_lattice(scene, jax.random.fold_in(key, number), n_parts)
        return (total_samples(response, model), budget_terms(response, model).energy_budget), response

    def refine(coarser: RunningMoments, n_parts: Array, next_n_parts: Array) -> RunningMoments:
        # The coarser estimate is dropped: a standard error is the scatter of batches of one kind.
        def add_lattices(group: Array, estimate: RunningMoments) -> RunningMoments:
            numbers = group * side_by_side + jnp.arange(side_by_side, dtype=jnp.int32)
            lattices = jax.vmap(trace_lattice, (0, None))(numbers, next_n_parts)
            return estimate.merge(RunningMoments.of_batches(*lattices))

        return jax.lax.fori_loop(0, MIN_BATCHES // side_by_side, add_lattices, no_lattices)

    one = jnp.ones((), jnp.int32)
    no_lattices = RunningMoments.in_program(*jax.eval_shape(trace_lattice, one, one))
    stop = StoppingRule(rtol, min_size=1, max_size=MAX_BATCHES_OR_PARTS)
    estimate = sample_until_compiled(refine, no_lattices, _relative_error, stop, _LATTICE_STEPS)
    return estimate._replace(mean_only=ShotBatch.of_response(estimate.mean_only, model))


# Its shapes are needed as well as its values: within `filter_jit`, JAX evaluates the function once for both.
@eqx.filter_jit
def _trace_lattice_part(scene: DeviceScene, key: PRNGKeyArray, ray_slice: RaySlice) -> Response:
    """Return the response of a part of the rays of a lattice."""
    return trace_first_only(scene, key, ray_slice)


def _trace_lattice(scene: DeviceScene, key: PRNGKeyArray, n_parts: Array) -> Response:
    """Return the response of a lattice of rays, which is traced in parts."""

    def add_part(number: Array, response_sum: Response) -> Response:
        response = _trace_lattice_part(scene, key, RaySlice(number, n_parts))
        return jax.tree.map(jnp.add, response_sum, response)

    shapes = jax.eval_shape(_trace_lattice_part, scene, key, RaySlice(n_parts, n_parts))
    response_sum = jax.lax.fori_loop(0, n_parts, add_part, _zeros(shapes))
    # Every part has the energy of the complete beam: the lattice is their mean.
    return jax.tree.map(lambda a: a / n_parts, response_sum)


def _zeros(shapes: Any) -> Any:
    return jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)


def _trace_shots(setup: Setup, shots: ShotGeometry, key: PRNGKeyArray, rtol: Array) -> ShotResults:
    """Trace shots one after the other over one device scene."""
    scene = build_device_scene(setup, derivatives="none")
    # Not `vmap`: the loops of all shots together would run until the slowest of them has met its tolerance,
    # and their arrays would not fit into a processor's cache.
    return jax.lax.map(lambda shot: _trace_shot(scene, setup, shot, key, rtol), shots)


compiled_shots = Program(_trace_shots, **ONE_CORE)
