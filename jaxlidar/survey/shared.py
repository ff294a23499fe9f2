"""Shots that share light: the scene is traced once, and every footprint is a weighted sum over nodes.

What returns is linear in what is sent. Parallel light falls on all of the scene that footprints cover, about
the nodes of a grid (`jaxlidar.trace.nodes`), and is told apart by its node. A footprint's waveform is the sum
of those of the nodes, with the coefficients of its irradiance; its variance is the sum of variances, with
their squares.
"""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from scipy import sparse

from jaxlidar._programs import Program
from jaxlidar._threads import ONE_CORE
from jaxlidar.planning.plan import MIN_BATCHES
from jaxlidar.planning.setup import Setup
from jaxlidar.sampling.adaptive import AbstractEstimate, EstimateErrors, StepRule, StoppingRule, sample_until
from jaxlidar.sampling.errors import relative_error, student_widening
from jaxlidar.sampling.moments import RunningMoments
from jaxlidar.survey.records import Record, record_of_shot
from jaxlidar.survey.tiles import Tile
from jaxlidar.survey.views import Views
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

# Coefficients of shots at what is traced, (shots, nodes): a NumPy array, or a sparse one.
Mixing = Any
# Batches of one tile at most: a tolerance that is out of reach ends here.
MOST_BATCHES = 1024
# Shots that are finished together.
TOGETHER = 256
# Footprints of which a tile has less than this share are not waited for.
_SMALL = 1e-3
# Ends of a flight at most: where optics are applied, and for each shot that may see them, they cost more.
_ENDS = 2
# Fewest rays of a batch of a shot's own.
_FEWEST_RAYS = 64
# Of few batches, the worst error of many shots is too large: no long steps.
_STEPS = StepRule(safety=1.05, max_growth=1.05 * 1.4**2, min_step=2)
# Tiles aim a little below the tolerance: where some are brighter than others, errors add up to a little more.
_AIM = 0.97
# Share of the squared error that order one may have where it is traced for each shot alone.
_OF_ORDER_ONE = 0.25


class Ready(NamedTuple):
    """What tiles have in common. `recording` is without histories, and without what the `air` returns.

    `views`: how shots see what they share; None where they see all of it, straight down.
    """

    setting: Setting
    recording: Recording
    air: Any
    spacing: float
    views: Views | None


def ready_for(setup: Setup, spacing: float, views: Views | None) -> Ready:
    """What all tiles over a grid of that spacing have in common."""
    recording = recording_of(setup)
    without_air = dataclasses.replace(without_histories(recording), air=None)
    plan = setup.plan
    trace = dataclasses.replace(plan.trace, ends=min(plan.trace.ends, _ENDS))
    if views is not None:
        trace = dataclasses.replace(trace, last=trace.last + views.slack)
        plan = dataclasses.replace(plan, n_rays=max(plan.n_rays // 4, _FEWEST_RAYS))
    setup = dataclasses.replace(setup, plan=dataclasses.replace(plan, trace=trace))
    return Ready(setting_of(setup, derivatives="none"), without_air, recording.air, spacing, views)


class Sums(NamedTuple):
    """Of nodes, or of shots that see what is shared, in one batch: what errors are wanted of, and responses.

    - `total`: (nodes, wavelengths, samples), all materials together. - `fates`:
      `jaxlidar.trace.colouring.Shares` of each, as a dict.
    """

    total: Any
    fates: Any
    response: Response


class Part(NamedTuple):
    """What a tile adds to its shots: to means, to variances, and photons. `shots`: their numbers."""

    shots: Int[np.ndarray, " shots"]
    lines: Float[np.ndarray, "shots lines wavelengths samples"]
    fates: dict[str, Float[np.ndarray, "shots *rows wavelengths"]]
    variance: Float[np.ndarray, "shots wavelengths samples"]
    fates_variance: dict[str, Float[np.ndarray, "shots *rows wavelengths"]]
    photons: Int[np.ndarray, " shots"]


def _of_nodes(setting: Setting, nodes: Nodes, recording: Recording, key: PRNGKeyArray) -> Sums:
    """One batch."""

    def of_one(response: Response) -> tuple[Array, dict[str, Array]]:
        together = response
        if response.higher is not None:
            # Optics have been applied to both: one pulse serves.
            together = dataclasses.replace(response, first=response.first + response.higher, higher=None)
        return total(together, recording), shares_of(response, recording)._asdict()

    if setting.viewing is None:
        response = trace_nodes(setting, nodes, key)
    else:
        response = trace_viewed(setting, recording.lidar, nodes, key)
    return Sums(*jax.vmap(of_one)(response), response)


def _lines(response: Response, recording: Recording) -> Float[Array, "lines wavelengths samples"]:
    """Samples by material, then those of order one."""
    parts = components(response, recording)
    return jnp.stack([*(parts[name] for name in recording.materials), parts["first"]])


def _batches(
    setting: Setting,
    recording: Recording,
    nodes: Nodes,
    viewing: Viewing | None,
    aim: Float[Array, "2"],
    key: PRNGKeyArray,
    first: Int[Array, ""],
    count: Int[Array, ""],
) -> RunningMoments:
    """Moments of `total` and `fates` of `count` batches from number `first` on, and their mean lines."""
    setting = _over(setting, recording, viewing, aim)

    def batch(n: Array) -> Sums:
        return _of_nodes(setting, nodes, recording, jax.random.fold_in(key, first + n))

    def add(n: Array, moments: RunningMoments) -> RunningMoments:
        sums = batch(n)
        return moments.update((sums.total, sums.fates), sums.response)

    shapes: Sums = jax.eval_shape(batch, first)
    empty = RunningMoments.compiled((shapes.total, shapes.fates), shapes.response)
    moments = jax.lax.fori_loop(0, count, add, empty)
    lines = jax.vmap(lambda response: _lines(response, recording))(moments.mean_only)
    return moments._replace(mean_only=lines)


_several = Program(_batches, **ONE_CORE)


def _over(setting: Setting, recording: Recording, viewing: Viewing | None, aim: Float[Array, "2"]) -> Setting:
    """The setting of a tile: parallel light, and optics."""
    lidar = recording.lidar
    setting = aimed(setting, lidar, aim - lidar.position)
    beam = parallel_beam(lidar)
    return dataclasses.replace(setting, beam=beam, optics=recording.optics, viewing=viewing)


def _orders_one(
    setting: Setting, recording: Recording, viewing: Viewing, aim: Float[Array, "2"], key: PRNGKeyArray
) -> Float[Array, "shots wavelengths samples"]:
    """Samples of order one, from few rays, of all shots of a tile."""
    setting = _over(setting, recording, viewing, aim)
    first = order_one(setting, recording.lidar, jnp.arange(viewing.shots - 1), key)
    return jax.vmap(lambda w: samples_of(jnp.sum(w, axis=1), recording.short, recording))(first.weights)


_rough = Program(_orders_one, **ONE_CORE)


class _Wanted(NamedTuple):
    """What the error of a tile is measured by, for the shots that are waited for.

    - `part`: as what is traced is summed. - `share`: of their light. - `may_err`: of their squared error.
    - `elsewhere`: samples of order one that count here and are traced elsewhere, or the other way round.
    """

    part: Mixing
    share: Float[np.ndarray, " shots"]
    may_err: Float[np.ndarray, " shots"]
    elsewhere: Float[np.ndarray, "shots wavelengths samples"] | float

    def worst(self, moments: RunningMoments) -> float:
        """The largest relative error, by what may be."""
        mean = np.maximum(_summed(self.part, moments.mean[0]) + self.elsewhere, 0.0)
        error = np.sqrt(_variance(self.part, moments.squares[0], moments.count))
        ratio = relative_error(mean, error) * self.share / np.sqrt(self.may_err)
        return float(np.max(ratio, initial=0.0))


def _wanted(ready: Ready, tile: Tile, part: Mixing, viewing: Viewing | None, key: Array) -> _Wanted:
    share = tile.part.sum(axis=1)
    waited = share > _SMALL
    share, home = share[waited], tile.home[waited]
    if viewing is None:
        return _Wanted(part[waited], share, share, 0.0)
    first = _rough(ready.setting, ready.recording, viewing, jnp.asarray(tile.aim, float), key)
    # Order one belongs to one tile, but counts by share.
    elsewhere = (share - home)[:, None, None] * np.asarray(first)[: len(tile.shots)][waited]
    may_err = _OF_ORDER_ONE * home + (1.0 - _OF_ORDER_ONE) * share
    return _Wanted(part[waited], share, may_err, elsewhere)


class _TileEstimate(AbstractEstimate):
    """Moments of the batches of a tile, on the host."""

    def __init__(self, trace: Callable[[range], RunningMoments], wanted: _Wanted):
        self.trace, self.wanted = trace, wanted
        self.moments: Any = None

    @property
    def n_batches(self) -> int:
        """Number of batches."""
        return 0 if self.moments is None else self.moments.count

    def add_batches(self, numbers: range) -> None:
        """Trace batches and add them."""
        moments = self.trace(numbers)
        self.moments = moments if self.moments is None else self.moments.merge(moments)

    def errors(self) -> EstimateErrors:
        """Return the largest relative error of the shots."""
        return EstimateErrors(self.wanted.worst(self.moments))


def trace_tile(ready: Ready, tile: Tile, number: int, rtol: float, key: PRNGKeyArray) -> Part:
    """What a tile adds to its shots, traced until its error is below the tolerance for all of them.

    A tile that has the share s of a footprint's light may be off by rtol / sqrt(s): then all tiles together
    are off by rtol.
    """
    nodes = Nodes(
        jnp.asarray(tile.place, float),
        jnp.asarray(ready.spacing, float),
        *(
            jnp.asarray(a, k)
            for of in (tile.photons, tile.rays)
            for a, k in zip(of, (jnp.int32, jnp.int32, float))
        ),
    )
    key, views, viewing, part = jax.random.fold_in(key, number), ready.views, None, tile.part
    if views is not None:
        viewing = views.at(tile, ready.spacing)
        # What is traced is the shots' already.
        one = np.ones(len(tile.shots), np.float32)
        part = sparse.csr_array(sparse.dia_array((one, 0), (one.size, views.shots)))

    def trace(numbers: range) -> RunningMoments:
        sizes = jnp.asarray(numbers.start, jnp.int32), jnp.asarray(len(numbers), jnp.int32)
        aim = jnp.asarray(tile.aim, float)
        given = (ready.setting, ready.recording, nodes, viewing, aim, key, *sizes)
        moments = jax.tree.map(np.asarray, _several(*given))
        return moments._replace(count=int(moments.count))

    estimate = _TileEstimate(trace, _wanted(ready, tile, part, viewing, key))
    stop = StoppingRule(_AIM * rtol, min_size=MIN_BATCHES, max_size=MOST_BATCHES)
    sample_until(estimate, stop, _STEPS)
    found = estimate.moments
    lit = np.abs(tile.part) > 0
    per_node = np.bincount(tile.photons.node, minlength=tile.part.shape[1])
    variance, fates_variance = (_variance(part, a, found.count) for a in found.squares)
    if views is None:
        # Light that is put elsewhere about a node is an error as large as what the node returns of it.
        variance = variance + _summed(tile.astray**2, found.mean[0] ** 2)
    return Part(
        tile.shots,
        _summed(part, found.mean_only),
        _summed(part, found.mean[1]),
        variance,
        fates_variance,
        (lit @ per_node) * found.count,
    )


def record_of(ready: Ready, parts: Iterable[Part], shots: slice) -> Record:
    """The records of some shots, at most `TOGETHER`, from what tiles add to them, one after the other."""
    whole: Any = None
    for part in parts:
        mine = (part.shots >= shots.start) & (part.shots < shots.stop)
        each = part._asdict()
        numbers = each.pop("shots")[mine] - shots.start
        if whole is None:
            whole = jax.tree.map(lambda a: np.zeros((TOGETHER, *a.shape[1:])), each)
        jax.tree.map(lambda w, a, of=numbers, m=mine: np.add.at(w, of, a[m]), whole, each)
    variances = whole["fates_variance"], whole["variance"]
    known = (whole["lines"], whole["fates"], *jax.tree.map(np.sqrt, variances))
    given = jax.tree.map(lambda a: jnp.asarray(a, float), known)
    finished, number = _finished(ready.recording, ready.air, *given), shots.stop - shots.start
    found: Record = jax.tree.map(lambda a: np.asarray(a)[:number], finished)
    return found._replace(photons=whole["photons"][:number].astype(int))


def _finish(
    recording: Recording,
    air: Float[Array, "wavelengths samples"] | None,
    lines: Float[Array, "lines wavelengths samples"],
    fates: dict[str, Float[Array, "*rows wavelengths"]],
    fates_stderr: dict[str, Float[Array, "*rows wavelengths"]],
    stderr: Float[Array, "wavelengths samples"],
) -> Record:
    """The record of one shot; `air`: what the air itself returns."""
    parts = dict(zip(recording.materials, lines))
    total, first = jnp.sum(lines[:-1], axis=0), lines[-1]
    parts |= {"first": first, "higher": total - first}
    if air is not None:
        parts |= {"air": air, "first": first + air}
        total = total + air
    balance, errors = (balance_of(Shares(**f), recording) for f in (fates, fates_stderr))
    # What returns is taken from one of the others, which keeps its error.
    held = {"escaped": "escaped", "after the window": "late", "unfollowed": "remaining"}
    ledger_stderr = errors.ledger | {name: fates_stderr[fate] for name, fate in held.items()}
    error = relative_error(total, stderr)
    photons = jnp.zeros((), jnp.int32)
    return record_of_shot(recording, parts, balance, stderr, ledger_stderr, error, photons)


def _finish_all(recording: Recording, air: Array | None, *arrays: Any) -> Record:
    return jax.vmap(lambda *own: _finish(recording, air, *own))(*arrays)


_finished = Program(_finish_all)


def _summed(part: Mixing, values: Any) -> Any:
    """Sums over nodes, with the coefficients of every shot, of a tree of arrays."""

    def one(a: np.ndarray) -> np.ndarray:
        return (part @ a.reshape(len(a), -1)).reshape(part.shape[0], *a.shape[1:])

    return jax.tree.map(one, values)


def _variance(part: Mixing, squares: Any, count: int) -> Any:
    """Variances of the means of batches, summed over nodes; widened for few batches of few nodes."""
    weight = part * part
    nodes = weight.sum(axis=1) ** 2 / np.maximum((weight * weight).sum(axis=1), 1e-30)
    wide = student_widening(1.0 + (count - 1.0) * np.maximum(nodes, 1.0)) ** 2 / (count * (count - 1.0))
    return _summed((weight * wide[:, None]).astype(part.dtype), squares)
