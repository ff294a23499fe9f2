"""The strategy shared illumination: one trace of the scene serves all footprints that overlap.

The response is linear in the irradiance. Let beams be parallel, of one direction, and footprint f have the
irradiance I_f(a) at the position a of the reference plane (1/m2, integral one). Light enters all over the
scene, with the density p(a). A path that enters at a, leaves at b and returns at the time t with the weight w
contributes

    w I_f(a) / p(a) V_f(b)

to the sample of f at t, where V_f(b) is the fraction of the light from b that the receiver of f sees. The
estimator is unbiased for every f, from one set of paths; standard errors are those of each shot, and
neighbours are correlated.

Light enters about the nodes n of a grid with the spacing d, with the density of a B-spline each; together p =
1 / d^2.

- *By node.* Straight down and without a field of view, V_f = 1 and I_f is a sum of the splines with
  coefficients c_fn (`jaxlidar.survey.footprint_splines`). Responses are kept by node. Photons of two nodes
  are independent, so that

      W_f = sum_n c_fn W_n,    Var W_f = sum_n c_fn^2 Var W_n + sum_n (m_fn W_n)^2

  where the last term is the error of the grid: the energy m_fn that the spline misplaces about the node.
- *By shot.* Otherwise I_f(a) / p(a) V_f(b) = d^2 I_f(a) V_f(b) is computed for each path and each shot that
  may see it (`jaxlidar.survey.shot_views`), without any error of the grid. Responses are kept by shot. The
  first order, which has few rays that would be seen by one shot each, is traced for each shot alone. Absorbed
  energy is taken by node.

Nodes are traced in groups (`jaxlidar.survey.node_groups`), which are the tasks. If a group has the fraction s
of f's light, its own relative error may be r / sqrt(s): squared errors of all groups, s^2 (r / sqrt(s))^2 = s
r^2 each, then add up to r^2. The number of batches of a group is the one that its worst shot needs.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from scipy import sparse

from jaxlidar._programs import Program
from jaxlidar._threads import ONE_CORE
from jaxlidar._workers import WorkUnit, task
from jaxlidar.planning.plan import MIN_BATCHES
from jaxlidar.planning.setup import Setup
from jaxlidar.sampling.adaptive import AbstractEstimate, EstimateErrors, StepRule, StoppingRule, sample_until
from jaxlidar.sampling.errors import relative_error, student_widening
from jaxlidar.sampling.moments import RunningMoments
from jaxlidar.survey.node_groups import NodeAllocation, NodeGroup
from jaxlidar.survey.results import ShotErrors, ShotResults, make_shot_results
from jaxlidar.survey.shot_views import ShotViews
from jaxlidar.survey.strategy import AbstractStrategy, slices_of_shots
from jaxlidar.trace.colouring import (
    Recording,
    Shares,
    balance_of,
    components,
    recording_of,
    samples_of,
    shares_of,
    total,
)
from jaxlidar.trace.footprint import parallel_beam
from jaxlidar.trace.node_response import trace_nodes, without_histories
from jaxlidar.trace.nodes import Nodes
from jaxlidar.trace.response import Response
from jaxlidar.trace.setting import Setting, aimed, setting_of
from jaxlidar.trace.viewed_response import order_one, trace_viewed
from jaxlidar.trace.viewing import Viewing

# Coefficients of shots at nodes, or at shots, (shots, traced): a NumPy array, or a sparse one of SciPy.
ShotCoefficients = Any
# Largest number of batches of a group: a tolerance that is out of reach ends here.
MAX_BATCHES = 1024
# Shots whose results are completed together.
SHOTS_PER_BLOCK = 256
# Footprints of whose light a group has less than this fraction do not decide on its number of batches.
_NEGLIGIBLE_FRACTION = 1e-3
# Largest number of deposits along a flight. Where optics are applied, and for each shot that may see them,
# deposits cost more than elsewhere.
_MAX_ENDS = 2
# Smallest number of rays of a batch of a shot's own first order.
_MIN_RAYS = 64
# The worst error of many shots, from few batches, is overestimated: steps are short.
_STEPS = StepRule(safety=1.05, max_growth=1.05 * 1.4**2, min_step=2)
# Groups aim a little below the tolerance: where some are brighter than others, squared errors add up to a
# little more.
_AIM = 0.97
# Fraction of the squared error that the first order may have where it is traced for each shot alone.
_FIRST_ORDER_VARIANCE = 0.25


@dataclasses.dataclass(frozen=True)
class SharedIlluminationStrategy(AbstractStrategy):
    """Shots are sums over nodes, or parts of all paths, of groups of nodes; a task is a group.

    - `groups`: of nodes. - `spacing`: of nodes, m.
    - `views`: how shots see shared light; None where they see all of it, straight down.
    - `parallel_light_bound`: bound on the fraction of samples that parallel light changes.
    """

    groups: list[NodeGroup]
    spacing: float
    views: ShotViews | None
    parallel_light_bound: float

    @functools.cached_property
    def context(self) -> "GroupContext":
        """Inputs that all groups have in common."""
        return make_group_context(self.setup, self.spacing, self.views)

    def tasks(self, key: PRNGKeyArray) -> list[WorkUnit]:
        return [
            task(number, trace_group, (self.context, group, number, self.rtol), key)
            for number, group in enumerate(self.groups)
        ]

    @property
    def n_tasks(self) -> int:
        return len(self.groups)

    @property
    def shot_slices(self) -> list[slice]:
        return slices_of_shots(len(self.survey), SHOTS_PER_BLOCK)

    def result_class(self, number: int) -> "type[GroupContribution]":
        return GroupContribution

    def shot_results(self, task_results: Mapping[int, Any]) -> Iterator[tuple[slice, ShotResults]]:
        for shots in self.shot_slices:
            numbers = [
                number
                for number, group in enumerate(self.groups)
                if np.any((group.shots >= shots.start) & (group.shots < shots.stop))
            ]
            # One contribution at a time is in memory: the mapping may be one of files.
            contributions = (task_results[number] for number in numbers)
            yield shots, sum_contributions(self.context, contributions, shots)

    def info(self) -> dict[str, Any]:
        return {
            "shared": True,
            "grid": self.spacing,
            "parallel light": self.parallel_light_bound,
        }


class GroupContext(NamedTuple):
    """Inputs that all groups of nodes have in common.

    - `setting`: of the survey's middle. - `recording`: without histories, for optics are applied while light
      is traced, and without what the `air` returns, which is added once.
    - `spacing`: of nodes, m. - `views`: as in `SharedIlluminationStrategy`.
    """

    setting: Setting
    recording: Recording
    air: Any
    spacing: float
    views: ShotViews | None


def make_group_context(setup: Setup, spacing: float, views: ShotViews | None) -> GroupContext:
    """Return the common inputs of groups over a grid of that spacing."""
    recording = recording_of(setup)
    without_air = dataclasses.replace(without_histories(recording), air=None)
    plan = setup.plan
    trace = dataclasses.replace(plan.trace, ends=min(plan.trace.ends, _MAX_ENDS))
    if views is not None:
        # Paths are timed from their own entry: for a shot beside it, they may end later than for that entry.
        trace = dataclasses.replace(trace, last=trace.last + views.extra_path)
        plan = dataclasses.replace(plan, n_rays=max(plan.n_rays // 4, _MIN_RAYS))
    setup = dataclasses.replace(setup, plan=dataclasses.replace(plan, trace=trace))
    setting = setting_of(setup, derivatives="none")
    return GroupContext(setting, without_air, recording.air, spacing, views)


class GroupLight(NamedTuple):
    """The light of a group: its nodes, the shots that view it (None: by node), and the aim point, m."""

    nodes: Nodes
    viewing: Viewing | None
    aim: Float[Array, "2"]


class BatchSums(NamedTuple):
    """Results of one batch, by node or by shot.

    - `waveform`: (nodes, wavelengths, samples), all materials together. - `energy`: sums of
      `jaxlidar.trace.colouring.Shares`, by name. - `response`: their responses.
    """

    waveform: Any
    energy: Any
    response: Response


class GroupContribution(NamedTuple):
    """Contribution of a group to its shots.

    - `shots`: their numbers. - `lines`: samples by material, then those of the first order.
    - `energy`: as in `BatchSums`. - `variance`, `energy_variance`: squared standard errors of the waveform
      and of the energy. - `photons`: number of photons that contribute.
    """

    shots: Int[np.ndarray, " shots"]
    lines: Float[np.ndarray, "shots lines wavelengths samples"]
    energy: dict[str, Float[np.ndarray, "shots *rows wavelengths"]]
    variance: Float[np.ndarray, "shots wavelengths samples"]
    energy_variance: dict[str, Float[np.ndarray, "shots *rows wavelengths"]]
    photons: Int[np.ndarray, " shots"]


def _trace_batch(setting: Setting, nodes: Nodes, recording: Recording, key: PRNGKeyArray) -> BatchSums:
    """Trace one batch."""

    def sums(response: Response) -> tuple[Array, dict[str, Array]]:
        all_orders = response
        if response.higher is not None:
            # With optics applied, both orders have one history: one convolution with the pulse serves their
            # sum.
            all_orders = dataclasses.replace(response, first=response.first + response.higher, higher=None)
        return total(all_orders, recording), shares_of(response, recording)._asdict()

    if setting.viewing is None:
        response = trace_nodes(setting, nodes, key)
    else:
        response = trace_viewed(setting, recording.lidar, nodes, key)
    return BatchSums(*jax.vmap(sums)(response), response)


def _lines(response: Response, recording: Recording) -> Float[Array, "lines wavelengths samples"]:
    """Return samples by material, then those of the first order."""
    by_component = components(response, recording)
    return jnp.stack([*(by_component[name] for name in recording.materials), by_component["first"]])


def _group_moments(
    setting: Setting,
    recording: Recording,
    light: GroupLight,
    key: PRNGKeyArray,
    first: Int[Array, ""],
    count: Int[Array, ""],
) -> RunningMoments:
    """Trace `count` batches from number `first` on.

    Returns the moments of their waveforms and energies; `mean_only` are their mean lines.
    """
    setting = _group_setting(setting, recording, light)

    def trace_batch(number: Array) -> BatchSums:
        return _trace_batch(setting, light.nodes, recording, jax.random.fold_in(key, first + number))

    def add_batch(number: Array, moments: RunningMoments) -> RunningMoments:
        batch = trace_batch(number)
        return moments.update((batch.waveform, batch.energy), batch.response)

    shapes: BatchSums = jax.eval_shape(trace_batch, first)
    empty = RunningMoments.compiled((shapes.waveform, shapes.energy), shapes.response)
    moments = jax.lax.fori_loop(0, count, add_batch, empty)
    # Lines are linear in the response: those of its mean are their mean, made once.
    lines = jax.vmap(lambda response: _lines(response, recording))(moments.mean_only)
    return moments._replace(mean_only=lines)


compiled_group_moments = Program(_group_moments, **ONE_CORE)


def _group_setting(setting: Setting, recording: Recording, light: GroupLight) -> Setting:
    """Return the setting of a group: at its aim point, with parallel light, and with optics."""
    lidar = recording.lidar
    setting = aimed(setting, lidar, light.aim - lidar.position)
    beam = parallel_beam(lidar)
    return dataclasses.replace(setting, beam=beam, optics=recording.optics, viewing=light.viewing)


def _first_order_samples(
    setting: Setting, recording: Recording, light: GroupLight, key: PRNGKeyArray
) -> Float[Array, "shots wavelengths samples"]:
    """Return samples of the first order, from few rays, of all shots of a group."""
    setting = _group_setting(setting, recording, light)
    viewing = setting.viewing
    assert viewing is not None
    first = order_one(setting, recording.lidar, jnp.arange(viewing.shots - 1), key)
    return jax.vmap(lambda w: samples_of(jnp.sum(w, axis=1), recording.short, recording))(first.weights)


_compiled_first_order_samples = Program(_first_order_samples, **ONE_CORE)


class ErrorTarget(NamedTuple):
    """The shots that decide on the number of batches of a group, and the error that each of them may have.

    - `coefficients`: of these shots. - `light_fraction`: s, of their light that is the group's.
    - `variance_fraction`: of their squared error that may be the group's; s where all is traced by node.
    - `first_order_excess`: samples that belong to the shot's light in this group but are traced in another
      one, positive, or the other way round, negative: errors are relative to what the group's fraction
      returns.
    """

    coefficients: ShotCoefficients
    light_fraction: Float[np.ndarray, " shots"]
    variance_fraction: Float[np.ndarray, " shots"]
    first_order_excess: Float[np.ndarray, "shots wavelengths samples"] | float

    def worst_error(self, moments: RunningMoments) -> float:
        """Return the largest relative error of a shot, over the square root of its variance fraction."""
        mean = np.maximum(_sum_over_traced(self.coefficients, moments.mean[0]) + self.first_order_excess, 0.0)
        stderr = np.sqrt(_variance_of_sums(self.coefficients, moments.squares[0], moments.count))
        # The error relative to the group's fraction is that times s relative to the complete waveform.
        error = relative_error(mean, stderr) * self.light_fraction / np.sqrt(self.variance_fraction)
        return float(np.max(error, initial=0.0))


def _error_target(
    context: GroupContext,
    group: NodeGroup,
    coefficients: ShotCoefficients,
    light: GroupLight,
    key: PRNGKeyArray,
) -> ErrorTarget:
    """Return the shots that decide on the number of batches, and their errors."""
    fraction = group.coefficients.sum(axis=1)
    counts = fraction > _NEGLIGIBLE_FRACTION
    fraction, has_centre = fraction[counts], group.has_centre[counts]
    if light.viewing is None:
        return ErrorTarget(coefficients[counts], fraction, fraction, 0.0)
    first = _compiled_first_order_samples(context.setting, context.recording, light, key)
    # A shot's first order is traced, all of it, in the group that has its centre.
    excess = (fraction - has_centre)[:, None, None] * np.asarray(first)[: len(group.shots)][counts]
    variance = _FIRST_ORDER_VARIANCE * has_centre + (1.0 - _FIRST_ORDER_VARIANCE) * fraction
    return ErrorTarget(coefficients[counts], fraction, variance, excess)


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
        """Return the largest relative error of the shots that count."""
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
    key, viewing, coefficients = jax.random.fold_in(key, number), None, group.coefficients
    if context.views is not None:
        viewing = context.views.viewing(group, context.spacing)
        # Responses are those of shots: the sum over what is traced picks each shot's own row, without the
        # padding.
        unit_diagonal = np.ones(len(group.shots), np.float32)
        shape = (len(group.shots), context.views.max_shots)
        diagonal = sparse.dia_array((unit_diagonal, 0), shape)
        coefficients = sparse.csr_array(diagonal)
    light = GroupLight(_nodes(group, context.spacing), viewing, jnp.asarray(group.aim, float))

    def trace(numbers: range) -> RunningMoments:
        first, count = jnp.asarray(numbers.start, jnp.int32), jnp.asarray(len(numbers), jnp.int32)
        moments = compiled_group_moments(context.setting, context.recording, light, key, first, count)
        moments = jax.tree.map(np.asarray, moments)
        return moments._replace(count=int(moments.count))

    estimate = GroupEstimate(trace, _error_target(context, group, coefficients, light, key))
    stop = StoppingRule(_AIM * rtol, min_size=MIN_BATCHES, max_size=MAX_BATCHES)
    sample_until(estimate, stop, _STEPS)

    moments: RunningMoments = estimate.moments
    variance, energy_variance = (_variance_of_sums(coefficients, a, moments.count) for a in moments.squares)
    if context.views is None:
        # Light at the wrong place about a node is an error as large as what the node returns of it.
        variance = variance + _sum_over_traced(group.misplaced_energy**2, moments.mean[0] ** 2)
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


def _nodes(group: NodeGroup, spacing: float) -> Nodes:
    """Return the nodes of a group, with their photons and rays, as arrays of JAX's present precision."""

    def arrays(allocation: NodeAllocation) -> tuple[Array, Array, Array]:
        return (
            jnp.asarray(allocation.node, jnp.int32),
            jnp.asarray(allocation.number, jnp.int32),
            jnp.asarray(allocation.fraction, float),
        )

    return Nodes(
        jnp.asarray(group.node_position, float),
        jnp.asarray(spacing, float),
        *arrays(group.photons),
        *arrays(group.rays),
    )


class ShotSums(NamedTuple):
    """Sums of the contributions of all groups to shots; axis 0 is the shots'. See `GroupContribution`."""

    lines: Float[Array, "shots lines wavelengths samples"]
    energy: dict[str, Float[Array, "shots *rows wavelengths"]]
    stderr: Float[Array, "shots wavelengths samples"]
    energy_stderr: dict[str, Float[Array, "shots *rows wavelengths"]]


def sum_contributions(
    context: GroupContext, contributions: Iterable[GroupContribution], shots: slice
) -> ShotResults:
    """Return the results of at most `SHOTS_PER_BLOCK` shots, from the contributions of groups."""
    sums: Any = None
    for contribution in contributions:
        mine = (contribution.shots >= shots.start) & (contribution.shots < shots.stop)
        arrays = contribution._asdict()
        rows = arrays.pop("shots")[mine] - shots.start
        if sums is None:
            # Always as many shots: one compiled program completes all blocks.
            sums = jax.tree.map(lambda a: np.zeros((SHOTS_PER_BLOCK, *a.shape[1:])), arrays)
        jax.tree.map(lambda s, a, r=rows, m=mine: np.add.at(s, r, a[m]), sums, arrays)
    of_shots = ShotSums(
        lines=sums["lines"],
        energy=sums["energy"],
        stderr=np.sqrt(sums["variance"]),
        energy_stderr=jax.tree.map(np.sqrt, sums["energy_variance"]),
    )
    of_shots, count = jax.tree.map(lambda a: jnp.asarray(a, float), of_shots), shots.stop - shots.start
    padded = _compiled_complete(context.recording, context.air, of_shots)
    results: ShotResults = jax.tree.map(lambda a: np.asarray(a)[:count], padded)
    return results._replace(photons=sums["photons"][:count].astype(int))


def _complete_shot(
    recording: Recording, air: Float[Array, "wavelengths samples"] | None, sums: ShotSums
) -> ShotResults:
    """Return the results of one shot. `air`: what the air itself returns, order one."""
    by_component = dict(zip(recording.materials, sums.lines))
    reflectance, first = jnp.sum(sums.lines[:-1], axis=0), sums.lines[-1]
    by_component |= {"first": first, "higher": reflectance - first}
    if air is not None:
        by_component |= {"air": air, "first": first + air}
        reflectance = reflectance + air
    balance, errors = (
        balance_of(Shares(**energy), recording) for energy in (sums.energy, sums.energy_stderr)
    )
    # The budget takes returned light off one of these fates; their errors are those before.
    fates = {"escaped": "escaped", "after the window": "late", "unfollowed": "remaining"}
    ledger_stderr = errors.ledger | {name: sums.energy_stderr[fate] for name, fate in fates.items()}
    shot_errors = ShotErrors(sums.stderr, ledger_stderr, relative_error(reflectance, sums.stderr))
    return make_shot_results(recording, by_component, balance, shot_errors, jnp.zeros((), jnp.int32))


def _complete_shots(recording: Recording, air: Array | None, sums: ShotSums) -> ShotResults:
    return jax.vmap(lambda shot: _complete_shot(recording, air, shot))(sums)


_compiled_complete = Program(_complete_shots)


def _sum_over_traced(coefficients: ShotCoefficients, values: Any) -> Any:
    """Return sums over nodes (or rows of shots) of a tree of arrays, with the coefficients of every shot."""

    def sum_array(a: np.ndarray) -> np.ndarray:
        return (coefficients @ a.reshape(len(a), -1)).reshape(coefficients.shape[0], *a.shape[1:])

    return jax.tree.map(sum_array, values)


def _variance_of_sums(coefficients: ShotCoefficients, squares: Any, count: int) -> Any:
    """Return the variances of shots from the squared deviations of `count` batches of every node.

    Var W_f = sum_n c_fn^2 S_n / (count (count - 1)), widened by the square of Student's factor. The sum of
    independent variances has more degrees of freedom than each of them: count - 1 times (sum c^2)^2 / sum
    c^4, the number of nodes that take part (Satterthwaite 1946, Biometrics Bull. 2, 110, for equal
    variances).
    """
    weight = coefficients * coefficients
    nodes = weight.sum(axis=1) ** 2 / np.maximum((weight * weight).sum(axis=1), 1e-30)
    freedom = (count - 1.0) * np.maximum(nodes, 1.0)
    scale = student_widening(1.0 + freedom) ** 2 / (count * (count - 1.0))
    return _sum_over_traced((weight * scale[:, None]).astype(coefficients.dtype), squares)
