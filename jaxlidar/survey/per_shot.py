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

Lattices of narrow footprints begin with as few rays as the tolerance allows, and those of several shots are
traced together (`trace.first.lattices_of_shots`). The lattices of a shot interleave: together they are one
lattice of eight times as many rays, which has no gaps. If a lattice of N rays has the error c N^-a, that of
all eight is c (8 N)^-a. It is 8^(1/2 - a) times what their scatter tells, the standard error of the mean of
eight independent ones. Seen from straight above, returns jump at the edges of columns: a = 3/4. A slant beam
enters voxels by their sides as well, so that returns bend where they would jump, and more so the more columns
it crosses: a grows up to 0.95, found by trial (`error_of_interleaved`).
Round Gaussian beams straight down have rays in every column that they graze, weighted by its share of the
energy (`trace.first.lattices_of_shots.strips_of_columns`), so that no error stays unseen for want of rays.
`examples/validation/standard_errors.py` compares the errors that follow with the scatter of many keys. Shots
that are not within the tolerance get more parts, as many as the error of each asks for.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxlidar._jax.programs import Program
from jaxlidar._jax.workers import task
from jaxlidar.planning.plan import MIN_BATCHES
from jaxlidar.planning.setup import Setup
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.sampling.adaptive import StepRule, StoppingRule, sample_until_compiled
from jaxlidar.sampling.errors import relative_error
from jaxlidar.sampling.moments import RunningMoments
from jaxlidar.scenes.atmosphere import Atmosphere
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.survey import Survey
from jaxlidar.spectral.apply_optics import (
    BudgetTerms,
    WaveformModel,
    budget_terms,
    component_samples,
    make_survey_model,
    relative_energy_samples,
    total_samples,
)
from jaxlidar.survey.results import SAMPLED_ARRAYS, ShotErrors, make_shot_results
from jaxlidar.survey.strategy import AbstractStrategy, SurveyTask, slices_of_shots, without_padding
from jaxlidar.trace.device_scene import DeviceScene, aim_at, build_device_scene
from jaxlidar.trace.first.first_order import FirstOrderTally
from jaxlidar.trace.first.footprint import (
    Beam,
    FootprintStrips,
    RaySlice,
    interleaving_shifts,
    make_beam,
)
from jaxlidar.trace.first.lattices_of_shots import (
    LatticeParts,
    LatticeSums,
    add_parts,
    can_trace_parts,
    empty_tally,
    energy_of_lattices,
    lattice_sums,
    per_unit_energy,
    response_of_lattice,
    strips_of_columns,
)
from jaxlidar.trace.response import Response, footprint_shift, trace_device_scene, trace_first_only

# Largest number of shots of a chunk, of first order alone and of more: a chunk cannot be interrupted.
_CHUNK_FIRST_ORDER, _CHUNK_HIGHER_ORDERS = 128, 16
# The same of narrow shots, which take so little time that what a chunk costs by itself counts.
_CHUNK_NARROW = 512
# Largest number of batches of a shot, or of parts of a lattice: a tolerance that is out of reach ends here.
MAX_BATCHES_OR_PARTS = 1024
# Rays that are marched side by side: more would not fit into a processor's cache.
_RAYS_SIDE_BY_SIDE = 512
# Batches of a shot follow one another, so that steps could be as small as one. The error is looked at after
# every fourth: an estimate that stops at the first moment at which it seems precise is wrong more often.
_BATCH_STEPS = StepRule(max_growth=1.0, min_step=4)
# Footprints whose lattices need at most this many rays are narrow: they meet a few columns of voxels. Wider
# ones would trace as many rays in the end. Lattices of narrow ones ...
_NARROW_RAYS = 256
# ... which are traced in parts of this many rays, for this many shots together ...
RAYS_OF_PART, _SHOTS_AT_ONCE = 8, 8
# ... and summed over this many blocks of parts before they are added to the sum of all: hundreds of thousands
# of terms, added one by one in single precision, would lose the third digit ...
_BLOCKS_OF_SUM = 64
# ... with as many parts in the first round that about three rays of all lattices meet what covers the
# fraction `rtol` of a footprint. Shots of which no ray meets an edge of a crown seem exact: with fewer rays,
# too many of them would have an error of more than twice `rtol` ...
LEAST_PARTS_TIMES_RTOL = 0.04
# ... at no more wavelengths than there are histories: the responses of lattices, with optics applied, would
# be larger.
MAX_WAVELENGTHS_OF_NARROW = 4
# The error of a lattice of N rays falls as N^-a: a at nadir, by how much it grows for slant beams, and the
# columns of voxels that a beam crosses where half of that is reached.
_RATE_AT_NADIR, _RATE_OF_SLANT, _COLUMNS_AT_HALF = 0.75, 0.2, 3.0
# Narrow shots get more rays until this times their error is within the tolerance: where an edge lies between
# the rays, the error stated is too small.
_CAUTION = 1.25
# Coarser lattices are dropped when denser ones are traced: small steps would waste most of the rays.
_LATTICE_STEPS = StepRule(convergence_rate=0.75, safety=1.2, min_growth=2.0, max_growth=32.0)


class ShotGeometry(NamedTuple):
    """Geometry of shots; axis 0 is the shots'.

    - `number`: of each in the survey.
    - `position`: m, from the survey's origin.
    - `zenith`, `azimuth`: degrees.
    - `altitude`: m; None where `position` is that of the sensor.
    - `ellipse_turn`: degrees; None where it is that of the lidar.
    """

    number: Int[Array, "*shots"] | np.ndarray
    position: Float[Array, "*shots axes"] | np.ndarray
    zenith: Float[Array, "*shots"] | np.ndarray
    azimuth: Float[Array, "*shots"] | np.ndarray
    altitude: Float[Array, "*shots"] | np.ndarray | None
    ellipse_turn: Float[Array, "*shots"] | np.ndarray | None

    def in_precision(self) -> "ShotGeometry":
        """Return the same in JAX's present precision."""
        precision = jnp.result_type(float)

        # Arrays of NumPy: compiled programs take them faster than JAX makes its own of each.
        def convert(a: Any) -> Any:
            return None if a is None else np.asarray(a, precision)

        return ShotGeometry(self.number, *map(convert, self[1:]))

    def padded_to(self, size: int) -> "ShotGeometry":
        """Return `size` shots: these, and copies of the last one."""
        rows = np.minimum(np.arange(size), len(self.number) - 1)
        return jax.tree.map(lambda a: np.asarray(a)[rows], self)


def shot_geometry(survey: Survey, first: int, count: int) -> ShotGeometry:
    """Return `count` shots from number `first` on."""
    shots = np.arange(first, first + count)
    names = ("position", "zenith", "azimuth", "altitude", "ellipse_turn")
    rows = jax.tree.map(lambda a: a[shots], {name: getattr(survey, name) for name in names})
    return ShotGeometry(shots.astype(np.int32), **rows)


def lidar_of_shot(lidar: Lidar, shot: ShotGeometry) -> Lidar:
    """Return the lidar aimed at one shot."""
    # `tree_at` sets fields without the constructor's checks, which traced values cannot have.
    names = [name for name in shot._fields[1:] if getattr(shot, name) is not None]
    return eqx.tree_at(
        lambda v: tuple(getattr(v, name) for name in names),
        lidar,
        tuple(getattr(shot, name) for name in names),
    )


def aim_offset(lidar: Lidar, shot: ShotGeometry) -> Float[Array, "axes"]:
    """Return how far the aim point of a shot lies from that of a lidar, m, east, north (and up)."""
    if shot.altitude is None:
        return lidar_of_shot(lidar, shot).aim_point - lidar.aim_point
    return jnp.asarray(shot.position) - lidar.position


class AimedShot(NamedTuple):
    """One shot of a survey: its device scene and waveform model, and its random key."""

    scene: DeviceScene
    model: WaveformModel
    key: PRNGKeyArray


class SurveyContext(NamedTuple):
    """What all shots of a survey have in common.

    - `scene`: the device scene, at the aim point of the survey's middle. - `model`: the waveform model, with
      room for more samples than the survey has. - `atmosphere`: None without one.
    """

    scene: DeviceScene
    model: WaveformModel
    atmosphere: Atmosphere | None

    def aim(self, shot: ShotGeometry, key: PRNGKeyArray) -> "AimedShot":
        """Aim the device scene and the model at one shot; its key follows from that of the survey."""
        lidar = lidar_of_shot(self.model.lidar, shot)
        scene = aim_at(self.scene, lidar, aim_offset(self.model.lidar, shot))
        model = self.model.aimed(lidar, self.atmosphere, scene.limits.start_distance)
        # The key follows from the shot's number: its waveform does not depend on chunks or workers.
        return AimedShot(scene, model, jax.random.fold_in(key, shot.number))


def make_survey_context(setup: Setup) -> SurveyContext:
    """Return what all shots of a survey have in common, from the setup of its middle."""
    scene = build_device_scene(setup, derivatives="none")
    return SurveyContext(scene, make_survey_model(setup), setup.scene.atmosphere)


def shots_to_trace(n_shots: int) -> int:
    """Return the number of shots that a program for a chunk of `n_shots` has room for: a size bucket."""
    return size_bucket(n_shots, 1)


@dataclasses.dataclass(frozen=True)
class PerShotStrategy(AbstractStrategy):
    """Every shot has photons of its own; a task is a chunk of shots."""

    @functools.cached_property
    def context(self) -> SurveyContext:
        """What all tasks have in common: the device scene of this process is built once."""
        return make_survey_context(self.setup)

    @property
    def shots_per_chunk(self) -> int:
        """Number of shots of a chunk.

        It depends on the survey and the plan alone, not on the number of workers.
        """
        shots, plan = len(self.survey), self.setup.plan
        largest = _CHUNK_HIGHER_ORDERS if plan.orders > 1 else _CHUNK_FIRST_ORDER
        largest = min(largest, max(1, shots // 8))
        if plan.orders == 1 and plan.n_rays <= _NARROW_RAYS:
            # Not fewer chunks than 32, so that many workers have something to do.
            largest = max(largest, min(_CHUNK_NARROW, shots // 32))
        # Chunks of nearly equal size: the copies that fill up the last one are traced in vain.
        return -(-shots // -(-shots // largest))

    def tasks(self, key: PRNGKeyArray) -> list[SurveyTask]:
        options = self.setup.plan.n_samples, self.rtol, self.kept_names
        tasks = []
        for number, shots in enumerate(self.shot_slices):
            geometry = shot_geometry(self.survey, shots.start, shots.stop - shots.start)
            unit = task(number, trace_chunk, (self.context, geometry, *options), key)
            tasks.append(SurveyTask(unit, shots))
        return tasks

    @property
    def contribution_sum(self) -> None:
        return None

    @property
    def shot_slices(self) -> list[slice]:
        return slices_of_shots(len(self.survey), self.shots_per_chunk)

    def info(self) -> dict[str, Any]:
        return {"shared": False}


def trace_chunk(
    context: SurveyContext,
    shots: ShotGeometry,
    n_samples: int,
    rtol: float,
    kept_names: tuple[str, ...],
    key: PRNGKeyArray,
) -> dict[str, Any]:
    """Trace a chunk of shots."""
    n_shots = len(shots.number)
    results = compiled_shots(
        context,
        shots.padded_to(shots_to_trace(n_shots)).in_precision(),
        np.int32(n_shots),
        key,
        np.asarray(rtol, jnp.result_type(float)),
        kept_names,
    )
    return without_padding(results, n_shots, n_samples, SAMPLED_ARRAYS)


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


def _trace_shot(aimed: AimedShot, rtol: Array, kept_names: tuple[str, ...]) -> dict[str, Any]:
    """Trace one shot until its tolerance is met.

    Where nothing is random, that is one batch, whose errors are zero. Otherwise the estimate is refined, by
    more batches or by denser lattices.
    """
    if not aimed.scene.config.is_random:
        batch = ShotBatch.of_response(trace_device_scene(aimed.scene, aimed.key), aimed.model)
        waveform, energy_budget = jax.tree.map(jnp.zeros_like, _with_errors(batch))
        errors = ShotErrors(waveform, energy_budget, jnp.zeros(()))
        return make_shot_results(
            aimed.model, *batch, errors, photons=jnp.zeros((), jnp.int32), kept_names=kept_names
        )
    if aimed.scene.config.follows_higher_orders:
        return _shot_results(aimed, _add_batches(aimed, rtol), kept_names)
    return _shot_results(aimed, _densify_lattices(aimed, rtol), kept_names)


def _shot_results(
    aimed: AimedShot, estimate: RunningMoments, kept_names: tuple[str, ...], error_factor: Array | float = 1.0
) -> dict[str, Any]:
    """Return the results of a shot from the moments of its batches.

    `error_factor`: standard error over that of batches that are independent.
    """
    waveform_stderr, energy_budget_stderr = jax.tree.map(lambda a: error_factor * a, estimate.stderr)
    errors = ShotErrors(waveform_stderr, energy_budget_stderr, error_factor * _relative_error(estimate))
    mean: ShotBatch = estimate.mean_only
    photons = estimate.count * aimed.scene.config.photons_traced
    return make_shot_results(aimed.model, *mean, errors, photons=photons, kept_names=kept_names)


def _with_errors(batch: ShotBatch) -> tuple[Array, dict[str, Array]]:
    """Return the quantities whose standard errors are reported: the waveform and the energy budget."""
    return batch.components["first"] + batch.components["higher"], batch.budget.energy_budget


def _relative_error(estimate: RunningMoments) -> Array:
    """Return the relative error of the waveform of a shot."""
    return relative_error(estimate.mean[0], estimate.stderr[0])


def _add_batches(aimed: AimedShot, rtol: Array) -> RunningMoments:
    """Trace batch after batch until the error is below the tolerance."""
    scene, model, key = aimed

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


def _densify_lattices(aimed: AimedShot, rtol: Array) -> RunningMoments:
    """Trace eight lattices, again with more parts, until the error is below the tolerance.

    1. Trace the lattices. Where each has few rays, several are marched side by side: a step costs about as
       much for a few rays as for hundreds.
    2. Apply optics and pulse to each of them, but in its sum over materials alone: that is what their scatter
       is needed for.
    3. When the tolerance is met, apply them to the mean of the responses, component by component.
    """
    scene, model, key = aimed
    side_by_side = math.gcd(MIN_BATCHES, max(_RAYS_SIDE_BY_SIDE // scene.config.n_rays, 1))

    def trace_lattice(number: Array, n_parts: Array) -> tuple[tuple[Array, dict[str, Array]], Response]:
        response = _trace_lattice(scene, jax.random.fold_in(key, number), n_parts)
        return _total_and_budget(response, model), response

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


def _total_and_budget(response: Response, model: WaveformModel) -> tuple[Array, dict[str, Array]]:
    """Return the quantities of `_with_errors`, without those of single components."""
    return total_samples(response, model), budget_terms(response, model).energy_budget


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


def begins_with_few_rays(context: SurveyContext) -> bool:
    """Return True if shots are narrow, of a scene whose lattices can be traced together, in parts."""
    scene, model = context.scene, context.model
    if scene.config.follows_higher_orders or not scene.config.is_random:
        return False
    few_wavelengths = model.lidar.wavelength.size <= MAX_WAVELENGTHS_OF_NARROW
    return scene.config.n_rays <= _NARROW_RAYS and few_wavelengths and can_trace_parts(scene)


def _trace_narrow_shots(
    context: SurveyContext,
    shots: ShotGeometry,
    count: Array,
    key: PRNGKeyArray,
    rtol: Array,
    kept_names: tuple[str, ...],
) -> dict[str, Any]:
    """Trace the lattices of the first `count` narrow shots, again for those not within the tolerance.

    In each round:

    1. Find how many parts the lattices of each pending shot get: in the first round by the
       tolerance, then by its error.
    2. Trace the pending shots, several at a time, and replace their results.
    """
    n_shots, scene = len(shots.number), context.scene
    max_parts = MAX_BATCHES_OR_PARTS * scene.config.n_rays // RAYS_OF_PART
    # Not more than where shots are not narrow.
    most = -(-scene.config.n_rays // RAYS_OF_PART)
    first_parts = jnp.clip(jnp.ceil(LEAST_PARTS_TIMES_RTOL / rtol), 1, most).astype(jnp.int32)

    is_shot = jnp.arange(n_shots) < count

    def is_pending(n_parts: Array, results: dict[str, Any]) -> Array:
        is_rough = _CAUTION * results["error"] > rtol
        return is_shot & ((n_parts == 0) | (is_rough & (n_parts < max_parts)))

    def trace_some(numbers: Array, n_parts: Array) -> dict[str, Any]:
        shots_of_group = jax.tree.map(lambda a: a[numbers], shots)
        return trace_together(context, shots_of_group, n_parts, key, kept_names)

    def next_round(state: tuple[Array, dict[str, Any]]) -> tuple[Array, dict[str, Any]]:
        n_parts, results = state
        error = _CAUTION * results["error"]
        following = jnp.minimum(_LATTICE_STEPS.next_size(n_parts, error, rtol), max_parts)
        pending = is_pending(*state)
        n_parts = jnp.where(pending, jnp.where(n_parts == 0, first_parts, following), n_parts)
        # Numbers of the shots, those that are pending first.
        order, n_pending = jnp.argsort(~pending, stable=True), jnp.sum(pending, dtype=jnp.int32)

        def trace_group(group: Array, results: dict[str, Any]) -> dict[str, Any]:
            position = group * _SHOTS_AT_ONCE + jnp.arange(_SHOTS_AT_ONCE, dtype=jnp.int32)
            exists = position < n_pending
            numbers = order[jnp.minimum(position, n_shots - 1)]
            new = trace_some(numbers, jnp.where(exists, n_parts[numbers], 0))
            # Shots that fill up the last group are dropped: their number is that of no shot.
            numbers = jnp.where(exists, numbers, n_shots)
            return jax.tree.map(lambda a, b: a.at[numbers].set(b, mode="drop"), results, new)

        return n_parts, jax.lax.fori_loop(0, -(-n_pending // _SHOTS_AT_ONCE), trace_group, results)

    some = jnp.zeros((_SHOTS_AT_ONCE,), jnp.int32)
    shapes = jax.eval_shape(trace_some, some, some)
    no_results = jax.tree.map(lambda a: jnp.zeros((n_shots, *a.shape[1:]), a.dtype), shapes)
    no_parts = jnp.zeros((n_shots,), jnp.int32)
    return jax.lax.while_loop(lambda s: jnp.any(is_pending(*s)), next_round, (no_parts, no_results))[1]


def error_of_interleaved(scene: DeviceScene, zenith: Array | np.ndarray) -> Array:
    """Return the standard error of the mean of interleaved lattices over that of as many independent ones.

    For lattices of N rays, with the error N^-a, it is 8^(1/2 - a) for eight of them. A beam that crosses m
    columns of voxels has a = 0.75 + 0.2 m / (m + 3), found by trial: errors of narrow shots over voxels of
    0.25 and 1 m are then near their scatter, but too small where a beam crosses half a column to one.

    `zenith`: degrees, of the beam.
    """
    sideways, column = sideways_path_and_column(scene, zenith)
    slant = sideways / (sideways + _COLUMNS_AT_HALF * column)
    return MIN_BATCHES ** (0.5 - _RATE_AT_NADIR - _RATE_OF_SLANT * slant)


def is_slant(scene: DeviceScene, zenith: Array | np.ndarray) -> Array:
    """Return True for beams that cross half a voxel on their way through the map; `zenith`: degrees."""
    sideways, column = sideways_path_and_column(scene, zenith)
    return sideways > 0.5 * column


def sideways_path_and_column(scene: DeviceScene, zenith: Array | np.ndarray) -> tuple[Array, Array]:
    """Return how far beams go sideways through the map, and the width of a column, both times cos(zenith)."""
    assert scene.medium is not None
    angle, size = jnp.deg2rad(zenith), scene.medium.size
    sideways = size[2] * scene.medium.counts[2] * jnp.abs(jnp.sin(angle))
    return sideways, jnp.minimum(size[0], size[1]) * jnp.abs(jnp.cos(angle))


def trace_together(
    context: SurveyContext,
    shots: ShotGeometry,
    n_parts: Int[Array, "*shots"],
    key: PRNGKeyArray,
    kept_names: tuple[str, ...],
) -> dict[str, Any]:
    """Trace the lattices of a group of shots, each in `n_parts` parts.

    1. List the parts of all lattices of all shots, shot by shot. Of beams straight down, spread the rays over
       the columns of voxels.
    2. Trace them, a block of parts at a time, and add them to the tally of their lattices.
    3. Apply optics and pulse to the lattices of each shot, whose scatter tells the errors, and to their mean.
    """
    scene, lidar = context.scene, context.model.lidar
    # Step 1. The list ends, for each shot, at:
    ends = jnp.cumsum(n_parts * MIN_BATCHES)
    n_rows, n_lattices = len(n_parts), len(n_parts) * MIN_BATCHES
    block_size = n_lattices

    def shifts_of(shot: ShotGeometry) -> Array:
        random_shift = footprint_shift(scene, jax.random.fold_in(key, shot.number))
        return interleaving_shifts(random_shift, MIN_BATCHES)

    shifts = jax.vmap(shifts_of)(shots)
    beams = jax.vmap(lambda shot: make_beam(lidar_of_shot(lidar, shot)))(shots)
    # Coordinates are relative to the aim point of the first shot. Shots that follow one another are near it;
    # at a distance, single precision places rays to 1e-7 of that.
    offsets = jax.vmap(lambda shot: aim_offset(lidar, shot))(shots)
    scene_of_first = aim_at(scene, lidar, offsets[0])
    aims = jnp.pad(offsets - offsets[:1], ((0, 0), (0, 3 - offsets.shape[1])))

    def strips_of(shot: ShotGeometry, beam: Beam, aim: Array, n_parts: Array) -> FootprintStrips:
        is_straight_down = ~is_slant(scene, shot.zenith) & (beam.axis[2] < 0.0)
        # Along the axes of the map, other footprints are not normally distributed, or not independently.
        is_spread = is_straight_down & (beam.gaussian and beam.ellipse is None)
        n_rays = n_parts * RAYS_OF_PART * MIN_BATCHES
        return strips_of_columns(scene_of_first, beam, aim, n_rays, MIN_BATCHES, is_spread)

    strips = jax.vmap(strips_of)(shots, beams, aims, n_parts)

    # Step 2.
    def add_block(block: Array, tally: FirstOrderTally) -> FirstOrderTally:
        number = block * block_size + jnp.arange(block_size, dtype=jnp.int32)
        row = jnp.minimum(jnp.searchsorted(ends, number, side="right"), n_rows - 1)
        in_shot = number - (ends[row] - n_parts[row] * MIN_BATCHES)
        lattice, part = in_shot % MIN_BATCHES, in_shot // MIN_BATCHES
        # Parts that fill up the last block are traced in vain, as the first ones of their shot.
        exists, count = number < ends[-1], jnp.maximum(n_parts[row], 1)
        parts = LatticeParts(
            lattice=row * MIN_BATCHES + lattice,
            energy=jnp.where(exists, 1.0 / count, 0.0),
            beams=jax.tree.map(lambda a: a[row], beams),
            aims=aims[row],
            shifts=shifts[row, lattice],
            ray_slices=RaySlice(jnp.where(exists, part, 0), count),
            strips=jax.tree.map(lambda a: a[row, lattice], strips),
        )
        return add_parts(scene_of_first, tally, parts, n_lattices, RAYS_OF_PART)

    def add_blocks(group: Array, tally: FirstOrderTally) -> FirstOrderTally:
        first, last = group * _BLOCKS_OF_SUM, jnp.minimum((group + 1) * _BLOCKS_OF_SUM, n_blocks)
        return jax.tree.map(jnp.add, tally, jax.lax.fori_loop(first, last, add_block, no_rays))

    no_rays, n_blocks = empty_tally(scene_of_first, n_lattices), -(-ends[-1] // block_size)
    tally = jax.lax.fori_loop(0, -(-n_blocks // _BLOCKS_OF_SUM), add_blocks, no_rays)
    sums = jax.tree.map(
        lambda a: a.reshape(n_rows, MIN_BATCHES, *a.shape[1:]), lattice_sums(scene, tally, n_lattices)
    )

    # Step 3.
    def results_of(shot: ShotGeometry, sums: LatticeSums, strips: FootprintStrips) -> dict[str, Any]:
        aimed = context.aim(shot, key)
        aimed = aimed._replace(model=aimed.model.for_applied_optics())
        responses = jax.vmap(lambda s: response_of_lattice(scene, s, context.model.optics))(sums)
        values = jax.vmap(lambda response: _total_and_budget(response, aimed.model))(responses)
        energy = energy_of_lattices(sums, strips)
        moments = RunningMoments.of_batches(per_unit_energy(values, energy), responses)
        response = jax.tree.map(lambda a: a / jnp.mean(energy), moments.mean_only)
        batch = ShotBatch.of_response(response, aimed.model)
        factor = error_of_interleaved(scene, shot.zenith)
        return _shot_results(aimed, moments._replace(mean_only=batch), kept_names, factor)

    return jax.vmap(results_of)(shots, sums, strips)


def _trace_shots(
    context: SurveyContext,
    shots: ShotGeometry,
    count: Array,
    key: PRNGKeyArray,
    rtol: Array,
    kept_names: tuple[str, ...],
) -> dict[str, Any]:
    """Trace the first `count` shots over one device scene."""
    if begins_with_few_rays(context):
        return _trace_narrow_shots(context, shots, count, key, rtol, kept_names)

    def trace(shot: ShotGeometry) -> dict[str, Any]:
        return _trace_shot(context.aim(shot, key), rtol, kept_names)

    return map_first_shots(trace, shots, count)


def map_first_shots(function: Callable[[ShotGeometry], Any], shots: ShotGeometry, count: Array) -> Any:
    """Apply a function to each of the first `count` shots, one after the other; other rows are zero."""
    # Not `vmap`: the loops of all shots together would run until the slowest of them has met its tolerance,
    # and their arrays would not fit into a processor's cache.
    function = eqx.filter_jit(function)

    def add(number: Array, results: Any) -> Any:
        new = function(jax.tree.map(lambda a: a[number], shots))
        return jax.tree.map(lambda a, b: a.at[number].set(b), results, new)

    shapes = jax.eval_shape(function, jax.tree.map(lambda a: a[0], shots))
    empty = jax.tree.map(lambda a: jnp.zeros((len(shots.number), *a.shape), a.dtype), shapes)
    return jax.lax.fori_loop(0, count, add, empty)


compiled_shots = Program(_trace_shots, one_core=True)
