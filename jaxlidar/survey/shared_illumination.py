"""The strategy shared illumination: one trace of the scene serves all footprints that overlap.

The response is linear in the irradiance. Let beams be parallel, of one direction, and footprint f have the
irradiance I_f(a) at the position a of the reference plane (1/m2, integral one). Light enters all over the
scene, with the density p(a). A path that enters at a, leaves at b and returns at the time t with the weight w
contributes

    w I_f(a) / p(a) V_f(b)

to the sample of f at t, where V_f(b) is the fraction of the light from b that the receiver of f sees. The
estimator is unbiased for every f, from one set of paths; standard errors are those of each shot, and
neighbours are correlated.

Light enters about the nodes n of a grid with the spacing d: each sends light of the energy 1 with the density
B / d^2 about itself, where B is a B-spline of integral one. All together have the density p = 1 / d^2
everywhere.

- *By node.* Straight down and without a field of view, V_f = 1 and I_f is a sum of the splines with
  coefficients c_fn (`jaxlidar.survey.footprint_splines`). Responses are tallied by node. Photons of two nodes
  are independent, so that

      W_f = sum_n c_fn W_n,    Var W_f = sum_n c_fn^2 Var W_n + sum_n (m_fn W_n)^2

  where the last term is the error of the grid: the energy m_fn that the spline misplaces about the node. It
  is an estimate of the worst case: where it dominates, as of top hats, standard errors are mostly too large.
- *By shot.* Otherwise I_f(a) / p(a) V_f(b) = d^2 I_f(a) V_f(b) is computed for each path and each shot that
  may see it (`jaxlidar.survey.view_geometry`), without any error of the grid. Responses are tallied by shot.
  The first order is traced for each shot alone: a lattice of its own rays has less variance than rays that it
  shares. Absorbed and escaped energy is tallied by node: it is seen by no receiver.

Nodes are traced in groups (`jaxlidar.survey.node_groups`), which are the tasks. If a group has the fraction s
of f's light, its own relative error may be r / sqrt(s): squared errors of all groups, each
s^2 (r / sqrt(s))^2 = s r^2, then add up to r^2. A group has as many batches as its worst shot needs.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxlidar._fields.checks import as_array
from jaxlidar._jax.programs import Program
from jaxlidar._jax.workers import task
from jaxlidar.planning.plan import MIN_BATCHES
from jaxlidar.planning.setup import Setup
from jaxlidar.sampling.adaptive import AbstractEstimate, EstimateErrors, StepRule, StoppingRule, sample_until
from jaxlidar.sampling.errors import relative_error, student_widening
from jaxlidar.sampling.moments import RunningMoments
from jaxlidar.spectral.apply_optics import (
    ResponseSums,
    WaveformModel,
    budget_of_sums,
    budget_stderr_of_sums,
    component_samples,
    make_waveform_model,
    relative_energy_samples,
    response_samples,
    sum_response,
    total_samples,
)
from jaxlidar.survey.node_groups import NodeAllocation, NodeGroup
from jaxlidar.survey.results import ShotErrors, make_shot_results
from jaxlidar.survey.strategy import AbstractStrategy, ContributionSum, SurveyTask, slices_of_shots
from jaxlidar.survey.view_geometry import ViewGeometry
from jaxlidar.trace.device_scene import DeviceScene, aim_at, build_device_scene
from jaxlidar.trace.first.footprint import parallel_beam
from jaxlidar.trace.first.shot_views import ShotViews
from jaxlidar.trace.photons.entry_nodes import EntryNodes
from jaxlidar.trace.photons.shared_illumination import (
    trace_first_of_shots,
    trace_nodes,
    trace_shots,
)
from jaxlidar.trace.response import Response

# Coefficients of shots at nodes, or at shots, (shots, traced): a NumPy array, or a sparse one of SciPy.
ShotCoefficients = Any
# Largest number of batches of a group: a tolerance that is out of reach ends here.
MAX_BATCHES = 1024
# Shots whose results are completed together.
SHOTS_PER_BLOCK = 256
# Footprints of whose light a group has less than this fraction do not decide on its number of batches.
_NEGLIGIBLE_FRACTION = 1e-3
# Largest number of deposits along a flight. They cost more here than elsewhere: each is made for every
# wavelength, since optics are applied, and for every shot that may see it.
_MAX_DEPOSITS = 2
# Smallest number of rays of a batch of a shot's own first order.
_MIN_RAYS = 64
# The worst error of many shots, from few batches, is overestimated: steps are short, and the error
# is predicted to fall by a factor of at most 1.4 in each.
_STEPS = StepRule(safety=1.05, max_growth=1.05 * 1.4**2, min_step=2)
# Groups aim below the tolerance: their errors are relative to their own waveforms. Where these have another
# shape than the sum of all groups, squared errors add up to more.
_AIM = 0.94
# Smallest fraction of the squared tolerance that is left to photons and rays where the error of the grid,
# which no batch makes smaller, takes more.
_LEAST_RANDOM_VARIANCE = 0.5
# Fraction of the squared error that the first order may have where it is traced for each shot alone.
_FIRST_ORDER_VARIANCE = 0.25


@dataclasses.dataclass(frozen=True)
class SharedIlluminationStrategy(AbstractStrategy):
    """A shot is a sum over nodes, or over the paths that it sees; a task traces a group of nodes.

    - `groups`: of nodes. - `spacing`: of nodes, m.
    - `view_geometry`: how shots see shared light; None where they see all of it, straight down.
    - `parallel_light_bound`: bound on the fraction of samples that parallel light changes.
    """

    groups: list[NodeGroup]
    spacing: float
    view_geometry: ViewGeometry | None
    parallel_light_bound: float

    @functools.cached_property
    def context(self) -> "GroupContext":
        """Inputs that all groups have in common."""
        # One object for all tasks of this process: its device scene is built once.
        return make_group_context(self.setup, self.spacing, self.view_geometry)

    def tasks(self, key: PRNGKeyArray) -> list[SurveyTask]:
        return [
            SurveyTask(task(number, trace_group, (self.context, group, number, self.rtol), key), group.shots)
            for number, group in enumerate(self.groups)
        ]

    @property
    def shot_slices(self) -> list[slice]:
        return slices_of_shots(len(self.survey), SHOTS_PER_BLOCK)

    @property
    def contribution_sum(self) -> ContributionSum:
        return self._sum_contributions

    def _sum_contributions(self, contribution_of: Callable[[int], Any], shots: slice) -> dict[str, Any]:
        numbers = [
            number
            for number, group in enumerate(self.groups)
            if np.any((group.shots >= shots.start) & (group.shots < shots.stop))
        ]
        # One contribution at a time is in memory: they may be in a store.
        contributions = map(contribution_of, numbers)
        return sum_contributions(self.context, contributions, shots, self.kept_names)

    def info(self) -> dict[str, Any]:
        return {
            "shared": True,
            "grid": self.spacing,
            "parallel light": self.parallel_light_bound,
        }


class AirReturn(NamedTuple):
    """Return of the air itself to every shot, order one: apparent reflectance, and relative energy."""

    reflectance: Float[Array, "wavelengths samples"]
    relative_energy: Float[Array, "wavelengths samples"]


class GroupContext(NamedTuple):
    """Inputs that all groups of nodes have in common.

    - `scene`: of the survey's middle. - `model`: without histories, for optics are applied while light
      is traced, and without what the `air` returns, which is added once.
    - `air`: None where the air returns nothing.
    - `spacing`: of nodes, m. - `view_geometry`: as in `SharedIlluminationStrategy`.
    """

    scene: DeviceScene
    model: WaveformModel
    air: AirReturn | None
    spacing: float
    view_geometry: ViewGeometry | None


def make_group_context(setup: Setup, spacing: float, view_geometry: ViewGeometry | None) -> GroupContext:
    """Return the common inputs of groups over a grid of that spacing."""
    model = make_waveform_model(setup)
    # The air's own return is not random and is no part of the light of nodes: `_complete_shot` adds it
    # once.
    without_air, air = model.for_applied_optics().without_air_return(), None
    if model.air_return is not None and model.air_relative_energy is not None:
        air = AirReturn(model.air_return, model.air_relative_energy)
    plan = setup.plan
    plan = plan.with_config(deposits_per_flight=min(plan.config.deposits_per_flight, _MAX_DEPOSITS))
    if view_geometry is not None:
        # Paths are timed from their own entry. For a shot whose axis is beside it, an oblique path may be
        # later.
        plan = plan.with_limits(max_path=plan.limits.max_path + view_geometry.extra_path)
        # Rays serve the first order of each shot alone, which may have only `_FIRST_ORDER_VARIANCE` of the
        # squared error, and whose error falls faster with their number than that of photons.
        plan = plan.with_config(n_rays=max(plan.n_rays // 4, _MIN_RAYS))
    scene = build_device_scene(dataclasses.replace(setup, plan=plan), derivatives="none")
    return GroupContext(scene, without_air, air, spacing, view_geometry)


class GroupLight(NamedTuple):
    """The light of a group: its nodes, the views of its shots (None: by node), and the aim point, m."""

    nodes: EntryNodes
    shot_views: ShotViews | None
    aim: Float[Array, "2"]


class GroupContribution(NamedTuple):
    """Contribution of a group to its shots.

    - `shots`: their numbers. - `lines`: components: samples by material, then those of the first order, then
      the relative energy.
    - `energy`: sums of `jaxlidar.spectral.apply_optics.ResponseSums`, by name.
    - `variance`, `energy_variance`: squared standard errors of the waveform and of the energy.
    - `photons`: number of photons that contribute.
    """

    shots: Int[np.ndarray, " shots"]
    lines: Float[np.ndarray, "shots components wavelengths samples"]
    energy: dict[str, Float[np.ndarray, "shots *rows wavelengths"]]
    variance: Float[np.ndarray, "shots wavelengths samples"]
    energy_variance: dict[str, Float[np.ndarray, "shots *rows wavelengths"]]
    photons: Int[np.ndarray, " shots"]


def _trace_batch(
    scene: DeviceScene, nodes: EntryNodes, model: WaveformModel, key: PRNGKeyArray
) -> tuple[tuple[Array, dict[str, Array]], Response]:
    """Trace one batch.

    **Returns:** by node or by shot, the waveform of all materials together and the energy (see
    `GroupContribution`), whose standard errors are needed; and the response.
    """

    def sums(response: Response) -> tuple[Array, dict[str, Array]]:
        all_orders = response
        if response.higher is not None:
            # With optics applied, both orders have one history: one convolution with the pulse serves their
            # sum.
            all_orders = dataclasses.replace(response, first=response.first + response.higher, higher=None)
        return total_samples(all_orders, model), sum_response(response, model)._asdict()

    if scene.shot_views is None:
        response = trace_nodes(scene, nodes, key)
    else:
        response = trace_shots(scene, model.lidar, nodes, key)
    return jax.vmap(sums)(response), response


def _stacked_components(
    response: Response, model: WaveformModel
) -> Float[Array, "components wavelengths samples"]:
    """Return samples by material, then those of the first order, then the relative energy of all."""
    by_component = component_samples(response, model)
    by_material = [by_component[name] for name in model.materials]
    return jnp.stack([*by_material, by_component["first"], relative_energy_samples(response, model)])


def _group_moments(
    scene: DeviceScene,
    model: WaveformModel,
    light: GroupLight,
    key: PRNGKeyArray,
    first: Int[Array, ""],
    count: Int[Array, ""],
) -> RunningMoments:
    """Trace `count` batches from number `first` on.

    Returns the moments of their waveforms and energies; `mean_only` is the mean of their components.
    """
    scene = _group_scene(scene, model, light)

    # A batch has the same random numbers in whichever round it is traced.
    def trace_batch(number: Array) -> tuple[tuple[Array, dict[str, Array]], Response]:
        return _trace_batch(scene, light.nodes, model, jax.random.fold_in(key, first + number))

    def add_batch(number: Array, moments: RunningMoments) -> RunningMoments:
        return moments.update(*trace_batch(number))

    empty = RunningMoments.in_program(*jax.eval_shape(trace_batch, first))
    moments = jax.lax.fori_loop(0, count, add_batch, empty)
    # Waveforms by material are linear in the response: those of its mean are their mean, made once.
    components = jax.vmap(lambda response: _stacked_components(response, model))(moments.mean_only)
    return moments._replace(mean_only=components)


compiled_group_moments = Program(_group_moments, one_core=True)


def _group_scene(scene: DeviceScene, model: WaveformModel, light: GroupLight) -> DeviceScene:
    """Return the device scene of a group: at its aim point, with parallel light, and with optics."""
    # Coordinates are relative to the aim point of each group, so that single precision resolves them equally
    # well all over a large survey.
    lidar = model.lidar
    scene = aim_at(scene, lidar, light.aim - lidar.position)
    beam = parallel_beam(lidar)
    return dataclasses.replace(scene, beam=beam, optics=model.optics, shot_views=light.shot_views)


def _first_order_samples(
    scene: DeviceScene, model: WaveformModel, light: GroupLight, key: PRNGKeyArray
) -> Float[Array, "shots wavelengths samples"]:
    """Return samples of the first order, from few rays, of all shots of a group."""
    scene = _group_scene(scene, model, light)
    assert light.shot_views is not None
    # The last shot is a dummy.
    shots = jnp.arange(light.shot_views.n_shots - 1)
    weights, _ = trace_first_of_shots(scene, model.lidar, shots, key)
    return jax.vmap(lambda w: response_samples(jnp.sum(w, axis=1), model.first_histories, model))(weights)


_compiled_first_order_samples = Program(_first_order_samples, one_core=True)


class ErrorTarget(NamedTuple):
    """The shots that decide on the number of batches of a group, and the error that each of them may have.

    - `coefficients`: of these shots. - `light_fraction`: s, of their light that is the group's.
    - `variance_fraction`: of their squared error that may be the group's; s where all is traced by node.
    - `first_order_excess`: (s - 1) times the shot's order one in the group that traces it, s times in all
      others; 0 where all is traced by node. Added to the mean, it gives the fraction s of the complete
      waveform, to which errors are relative.
    - `misplaced_energy`: by the grid, as in `NodeGroup`; None where all is traced by shot.
    - `rtol`: tolerance of a shot, for the errors of all groups and of the grid.
    """

    coefficients: ShotCoefficients
    light_fraction: Float[np.ndarray, " shots"]
    variance_fraction: Float[np.ndarray, " shots"]
    first_order_excess: Float[np.ndarray, "shots wavelengths samples"] | float
    misplaced_energy: Float[np.ndarray, "shots nodes"] | None
    rtol: float

    def worst_error(self, moments: RunningMoments) -> float:
        """Return the largest relative error of a shot, over the square root of its variance fraction.

        It is the random error over the root of the fraction of the squared tolerance that the grid leaves.
        """
        # The mean and the excess are estimated separately: where little returns, their sum may be negative.
        mean = np.maximum(_sum_over_traced(self.coefficients, moments.mean[0]) + self.first_order_excess, 0.0)
        variance = _variance_of_sums(self.coefficients, moments.squares[0], moments.count)
        error = self._relative_error(mean, variance)
        if self.misplaced_energy is not None:
            grid_error = self._relative_error(mean, _grid_variance(self.misplaced_energy, moments))
            error = error / np.sqrt(np.maximum(1.0 - (grid_error / self.rtol) ** 2, _LEAST_RANDOM_VARIANCE))
        return float(np.max(error, initial=0.0))

    def _relative_error(
        self,
        mean: Float[np.ndarray, "shots wavelengths samples"],
        variance: Float[np.ndarray, "shots wavelengths samples"],
    ) -> Float[np.ndarray, " shots"]:
        """Return errors relative to complete waveforms, over the roots of the variance fractions."""
        # The error relative to the group's fraction is that times s relative to the complete waveform.
        error = relative_error(mean, np.sqrt(variance))
        return np.asarray(error) * self.light_fraction / np.sqrt(self.variance_fraction)


def _error_target(
    context: GroupContext,
    group: NodeGroup,
    coefficients: ShotCoefficients,
    light: GroupLight,
    rtol: float,
    key: PRNGKeyArray,
) -> ErrorTarget:
    """Return the shots that decide on the number of batches, and their errors."""
    fraction = group.coefficients.sum(axis=1)
    # The light and the error of the other shots are added all the same; they only do not cause more batches.
    is_significant = fraction > _NEGLIGIBLE_FRACTION
    fraction, has_centre = fraction[is_significant], group.has_centre[is_significant]
    if light.shot_views is None:
        misplaced_energy = group.misplaced_energy[is_significant]
        return ErrorTarget(coefficients[is_significant], fraction, fraction, 0.0, misplaced_energy, rtol)
    first = _compiled_first_order_samples(context.scene, context.model, light, key)
    # A shot's first order is traced, all of it, in the group that has its centre.
    first_of_shots = np.asarray(first)[: len(group.shots)][is_significant]
    excess = (fraction - has_centre)[:, None, None] * first_of_shots
    # Over all groups these fractions add up to 1: a shot has its centre in one of them, and its light in all.
    # The group with the centre has a larger one, as it alone traces the first order.
    variance = _FIRST_ORDER_VARIANCE * has_centre + (1.0 - _FIRST_ORDER_VARIANCE) * fraction
    return ErrorTarget(coefficients[is_significant], fraction, variance, excess, None, rtol)


class GroupEstimate(AbstractEstimate):
    """Moments of the batches of a group. `trace`: returns those of the batches with the given numbers."""

    def __init__(self, trace: Callable[[range], RunningMoments], target: ErrorTarget):
        self.trace, self.target = trace, target
        self.moments: Any = None

    @property
    def n_batches(self) -> int:
        """Number of batches."""
        return 0 if self.moments is None else self.moments.count

    def add_batches(self, numbers: range) -> None:
        """Trace batches and merge their moments."""
        moments = self.trace(numbers)
        self.moments = moments if self.moments is None else self.moments.merge(moments)

    def errors(self) -> EstimateErrors:
        """Return the largest relative error of the shots that decide."""
        return EstimateErrors(self.target.worst_error(self.moments))


def trace_group(
    context: GroupContext, group: NodeGroup, number: int, rtol: float, key: PRNGKeyArray
) -> GroupContribution:
    """Trace a group of nodes until its error is below the tolerance for all its shots.

    1. Put the group's light together: nodes with their photons and rays, and the shots that view them.
    2. Find the error that each shot may have from this group.
    3. Add batches until none has a larger one.
    4. Sum over nodes to means and variances of shots, and add the error of the grid.
    """
    key, shot_views, coefficients = jax.random.fold_in(key, number), None, group.coefficients
    if context.view_geometry is not None:
        shot_views = context.view_geometry.views_of_group(group, context.spacing)
        # Responses are those of shots: the sum over what is traced picks each shot's own row, without the
        # padding.
        unit_diagonal = np.ones(len(group.shots), np.float32)
        shape = (len(group.shots), context.view_geometry.max_shots)
        diagonal = scipy.sparse.dia_array((unit_diagonal, 0), shape)
        coefficients = scipy.sparse.csr_array(diagonal)
    light = GroupLight(_nodes(group, context.spacing), shot_views, as_array(group.aim))

    def trace(numbers: range) -> RunningMoments:
        # As arrays, since Python numbers are static: each round would compile a program of its own.
        first, count = jnp.asarray(numbers.start, jnp.int32), jnp.asarray(len(numbers), jnp.int32)
        moments = compiled_group_moments(context.scene, context.model, light, key, first, count)
        # Sums over nodes are made on the host: their shapes differ between groups, and would be compiled
        # each.
        moments = jax.tree.map(np.asarray, moments)
        return moments._replace(count=int(moments.count))

    estimate = GroupEstimate(trace, _error_target(context, group, coefficients, light, rtol, key))
    stop = StoppingRule(_AIM * rtol, min_size=MIN_BATCHES, max_size=MAX_BATCHES)
    sample_until(estimate, stop, _STEPS)

    moments: RunningMoments = estimate.moments
    variance, energy_variance = (_variance_of_sums(coefficients, a, moments.count) for a in moments.squares)
    if context.view_geometry is None:
        variance = variance + _grid_variance(group.misplaced_energy, moments)
    # A shot counts the photons of all nodes that it uses, which other shots may count too.
    illuminated = np.abs(group.coefficients) > 0
    photons_per_node = np.bincount(group.photons.node, minlength=group.coefficients.shape[1])
    return GroupContribution(
        shots=group.shots,
        lines=_sum_over_traced(coefficients, moments.mean_only),
        energy=_sum_over_traced(coefficients, moments.mean[1]),
        variance=variance,
        energy_variance=energy_variance,
        photons=(illuminated @ photons_per_node) * moments.count,
    )


def _nodes(group: NodeGroup, spacing: float) -> EntryNodes:
    """Return the nodes of a group, with their photons and rays, as arrays of JAX's present precision."""

    def arrays(allocation: NodeAllocation) -> tuple[Array, Array, Array]:
        return (
            jnp.asarray(allocation.node, jnp.int32),
            jnp.asarray(allocation.rank, jnp.int32),
            as_array(allocation.fraction),
        )

    return EntryNodes(
        as_array(group.node_position),
        as_array(spacing),
        *arrays(group.photons),
        *arrays(group.rays),
    )


class ShotSums(NamedTuple):
    """Sums of the contributions of all groups to shots; axis 0 is the shots'. See `GroupContribution`."""

    components: Float[Array, "shots components wavelengths samples"]
    energy: dict[str, Float[Array, "shots *rows wavelengths"]]
    stderr: Float[Array, "shots wavelengths samples"]
    energy_stderr: dict[str, Float[Array, "shots *rows wavelengths"]]


def sum_contributions(
    context: GroupContext,
    contributions: Iterable[GroupContribution],
    shots: slice,
    kept_names: tuple[str, ...],
) -> dict[str, Any]:
    """Return the results of at most `SHOTS_PER_BLOCK` shots, from the contributions of groups.

    `kept_names`: as in `make_shot_results`.
    """
    sums: Any = None
    for contribution in contributions:
        mine = (contribution.shots >= shots.start) & (contribution.shots < shots.stop)
        arrays = contribution._asdict()
        rows = arrays.pop("shots")[mine] - shots.start
        if sums is None:
            # Always as many shots, so that one compiled program completes all blocks; in double precision.
            sums = jax.tree.map(lambda a: np.zeros((SHOTS_PER_BLOCK, *a.shape[1:])), arrays)
        # A contribution names each shot once.
        for total, added in zip(jax.tree.leaves(sums), jax.tree.leaves(arrays)):
            total[rows] += added[mine]
    # Variances of groups add up, since their photons are independent.
    of_shots = ShotSums(
        components=sums["lines"],
        energy=sums["energy"],
        stderr=np.sqrt(sums["variance"]),
        energy_stderr=jax.tree.map(np.sqrt, sums["energy_variance"]),
    )
    of_shots, count = jax.tree.map(lambda a: jnp.asarray(a, float), of_shots), shots.stop - shots.start
    padded = _compiled_complete(context.model, context.air, of_shots, kept_names)
    results: dict[str, Any] = jax.tree.map(lambda a: np.asarray(a)[:count], padded)
    return results | {"photons": sums["photons"][:count].astype(int)}


def _complete_shot(
    model: WaveformModel, air: AirReturn | None, sums: ShotSums, kept_names: tuple[str, ...]
) -> dict[str, Any]:
    """Return the results of one shot."""
    # The last components are the first order and the relative energy, which are no further light.
    by_component, reflectance = (
        dict(zip(model.materials, sums.components)),
        jnp.sum(sums.components[:-2], axis=0),
    )
    first, relative_energy = sums.components[-2], sums.components[-1]
    by_component |= {"first": first, "higher": reflectance - first}
    if air is not None:
        by_component |= {"air": air.reflectance, "first": first + air.reflectance}
        reflectance = reflectance + air.reflectance
        relative_energy = relative_energy + air.relative_energy
    budget = budget_of_sums(ResponseSums(**sums.energy), model)
    energy_budget_stderr = budget_stderr_of_sums(ResponseSums(**sums.energy_stderr), model)
    shot_errors = ShotErrors(sums.stderr, energy_budget_stderr, relative_error(reflectance, sums.stderr))
    no_photons = jnp.zeros((), jnp.int32)
    return make_shot_results(
        model, by_component, relative_energy, budget, shot_errors, no_photons, kept_names
    )


def _complete_shots(
    model: WaveformModel, air: AirReturn | None, sums: ShotSums, kept_names: tuple[str, ...]
) -> dict[str, Any]:
    return jax.vmap(lambda shot: _complete_shot(model, air, shot, kept_names))(sums)


_compiled_complete = Program(_complete_shots)


def _sum_over_traced(coefficients: ShotCoefficients, values: Any) -> Any:
    """Return sums over nodes (or rows of shots) of a tree of arrays, with the coefficients of every shot."""

    def sum_array(a: np.ndarray) -> np.ndarray:
        return (coefficients @ a.reshape(len(a), -1)).reshape(coefficients.shape[0], *a.shape[1:])

    return jax.tree.map(sum_array, values)


def _grid_variance(
    misplaced_energy: Float[np.ndarray, "shots nodes"], moments: RunningMoments
) -> Float[np.ndarray, "shots wavelengths samples"]:
    """Return the squared error of the grid, sum_n (m_fn W_n)^2."""
    # Light at the wrong place about a node is an error as large as what the node returns of it.
    return _sum_over_traced(misplaced_energy**2, moments.mean[0] ** 2)


def _variance_of_sums(coefficients: ShotCoefficients, squares: Any, count: int) -> Any:
    """Return the variances of shots from the squared deviations of `count` batches of every node.

    Var W_f = sum_n c_fn^2 S_n / (count (count - 1)), widened by the square of Student's factor. The sum of
    independent variances has more degrees of freedom than each of them: count - 1 times (sum c^2)^2 / sum
    c^4, the effective number of nodes (Satterthwaite 1946, Biometrics Bull. 2, 110, for equal
    variances).
    """
    # Elementwise, for NumPy's arrays and for SciPy's sparse arrays alike (its matrices would multiply).
    weight = coefficients * coefficients
    # Fourth powers of faint coefficients underflow; at least one node takes part.
    effective_nodes = weight.sum(axis=1) ** 2 / np.maximum((weight * weight).sum(axis=1), 1e-30)
    freedom = (count - 1.0) * np.maximum(effective_nodes, 1.0)
    # `student_widening` takes a number of batches, which is one more than their degrees of freedom.
    variance_scale = student_widening(1.0 + freedom) ** 2 / (count * (count - 1.0))
    return _sum_over_traced((weight * variance_scale[:, None]).astype(coefficients.dtype), squares)
