"""Shots that share light: the scene is traced once, and every footprint is a weighted sum over nodes.

What returns is linear in what is sent. Parallel light falls on all of the scene that footprints cover, about
the nodes of a grid (`jaxlidar.trace.entry_nodes`), and is told apart by its node. A footprint's waveform is
the sum of those of the nodes, with the coefficients of its irradiance; its variance is the sum of variances,
with their squares.
"""

import dataclasses
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from scipy import sparse

from jaxlidar._programs import Program
from jaxlidar._statistics import relative_error, widening
from jaxlidar._threads import ONE_CORE
from jaxlidar.planning.plan import MIN_BATCHES
from jaxlidar.planning.setup import Setup
from jaxlidar.spectral.apply_optics import (
    ResponseSums,
    WaveformModel,
    budget_of_sums,
    component_samples,
    make_waveform_model,
    response_samples,
    sum_response,
    total_samples,
)
from jaxlidar.survey.records import BatchMoments, Record, record_of_shot
from jaxlidar.survey.tiles import Tile
from jaxlidar.survey.views import Views
from jaxlidar.trace.device_scene import DeviceScene, aim_at, build_device_scene
from jaxlidar.trace.entry_nodes import EntryNodes
from jaxlidar.trace.footprint import parallel_beam
from jaxlidar.trace.response import Response
from jaxlidar.trace.shared_illumination import trace_first_of_shots, trace_nodes, trace_shots
from jaxlidar.trace.shot_views import ShotViews

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
# Tiles aim a little below the tolerance: where some are brighter than others, errors add up to a little more.
_AIM = 0.97
# Share of the squared error that order one may have where it is traced for each shot alone.
_OF_ORDER_ONE = 0.25


class Ready(NamedTuple):
    """What tiles have in common. `recording` is without histories, and without what the `air` returns.

    `views`: how shots see what they share; None where they see all of it, straight down.
    """

    setting: DeviceScene
    recording: WaveformModel
    air: Any
    spacing: float
    views: Views | None


def ready_for(setup: Setup, spacing: float, views: Views | None) -> Ready:
    """What all tiles over a grid of that spacing have in common."""
    recording = make_waveform_model(setup)
    without_air = dataclasses.replace(recording.for_applied_optics(), air_return=None)
    plan = setup.plan
    plan = plan.with_config(deposits_per_flight=min(plan.config.deposits_per_flight, _ENDS))
    if views is not None:
        plan = plan.with_limits(max_path=plan.limits.max_path + views.slack)
        plan = plan.with_config(n_rays=max(plan.n_rays // 4, _FEWEST_RAYS))
    setup = dataclasses.replace(setup, plan=plan)
    return Ready(
        build_device_scene(setup, derivatives="none"), without_air, recording.air_return, spacing, views
    )


class Sums(NamedTuple):
    """Of nodes, or of shots that see what is shared, in one batch: what errors are wanted of, and responses.

    - `total`: (nodes, wavelengths, samples), all materials together. - `fates`:
      `jaxlidar.spectral.apply_optics.ResponseSums` of each, as a dict.
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


class _Batches(NamedTuple):
    """So many batches: moments of `total` and `fates`, and the mean of `lines`."""

    count: int
    moments: BatchMoments
    lines: Any

    def joined(self, other: "_Batches") -> "_Batches":
        """Both together."""
        whole = self.count + other.count
        lines = self.lines + other.count / whole * (other.lines - self.lines)
        return _Batches(whole, self.moments.joined(self.count, other.moments, other.count), lines)


def _of_nodes(setting: DeviceScene, nodes: EntryNodes, recording: WaveformModel, key: PRNGKeyArray) -> Sums:
    """One batch."""

    def of_one(response: Response) -> tuple[Array, dict[str, Array]]:
        together = response
        if response.higher is not None:
            # Optics have been applied to both: one pulse serves.
            together = dataclasses.replace(response, first=response.first + response.higher, higher=None)
        return total_samples(together, recording), sum_response(response, recording)._asdict()

    if setting.shot_views is None:
        response = trace_nodes(setting, nodes, key)
    else:
        response = trace_shots(setting, recording.lidar, nodes, key)
    return Sums(*jax.vmap(of_one)(response), response)


def _lines(response: Response, recording: WaveformModel) -> Float[Array, "lines wavelengths samples"]:
    """Samples by material, then those of order one."""
    parts = component_samples(response, recording)
    return jnp.stack([*(parts[name] for name in recording.materials), parts["first"]])


def _batches(
    setting: DeviceScene,
    recording: WaveformModel,
    nodes: EntryNodes,
    viewing: ShotViews | None,
    aim: Float[Array, "2"],
    key: PRNGKeyArray,
    first: Int[Array, ""],
    count: Int[Array, ""],
) -> tuple[BatchMoments, Array]:
    """Moments of `count` batches from number `first` on, and their mean lines."""
    setting = _over(setting, recording, viewing, aim)

    def batch(n: Array) -> Sums:
        return _of_nodes(setting, nodes, recording, jax.random.fold_in(key, first + n))

    def step(n: Array, state: tuple[BatchMoments, Response]) -> tuple[BatchMoments, Response]:
        (moments, mean), found, number = state, batch(n), n + 1.0
        mean = jax.tree.map(lambda m, v: m + (v - m) / number, mean, found.response)
        return moments.add((found.total, found.fates), number), mean

    zero: Sums = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(batch, first))
    none = (zero.total, zero.fates)
    moments, mean = jax.lax.fori_loop(0, count, step, (BatchMoments(none, none), zero.response))
    return moments, jax.vmap(lambda response: _lines(response, recording))(mean)


_several = Program(_batches, **ONE_CORE)


def _over(
    setting: DeviceScene, recording: WaveformModel, viewing: ShotViews | None, aim: Float[Array, "2"]
) -> DeviceScene:
    """The setting of a tile: parallel light, and optics."""
    lidar = recording.lidar
    setting = aim_at(setting, lidar, aim - lidar.position)
    beam = parallel_beam(lidar)
    return dataclasses.replace(setting, beam=beam, optics=recording.optics, shot_views=viewing)


def _orders_one(
    setting: DeviceScene,
    recording: WaveformModel,
    viewing: ShotViews,
    aim: Float[Array, "2"],
    key: PRNGKeyArray,
) -> Float[Array, "shots wavelengths samples"]:
    """Samples of order one, from few rays, of all shots of a tile."""
    setting = _over(setting, recording, viewing, aim)
    first = trace_first_of_shots(setting, recording.lidar, jnp.arange(viewing.n_shots - 1), key)
    return jax.vmap(lambda w: response_samples(jnp.sum(w, axis=1), recording.first_histories, recording))(
        first.weights
    )


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

    def worst(self, found: _Batches) -> float:
        """The largest relative error, by what may be."""
        mean = np.maximum(_summed(self.part, found.moments.mean[0]) + self.elsewhere, 0.0)
        error = np.sqrt(_variance(self.part, found.moments.squares[0], found.count))
        ratio = relative_error(mean, error) * self.share / np.sqrt(self.may_err)
        return float(np.max(ratio, initial=0.0))


def _wanted(ready: Ready, tile: Tile, part: Mixing, viewing: ShotViews | None, key: Array) -> _Wanted:
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


def trace_tile(ready: Ready, tile: Tile, number: int, rtol: float, key: PRNGKeyArray) -> Part:
    """What a tile adds to its shots, traced until its error is below the tolerance for all of them.

    A tile that has the share s of a footprint's light may be off by rtol / sqrt(s): then all tiles together
    are off by rtol.
    """
    nodes = EntryNodes(
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

    def more(first: int, count: int) -> _Batches:
        sizes = jnp.asarray(first, jnp.int32), jnp.asarray(count, jnp.int32)
        aim = jnp.asarray(tile.aim, float)
        given = (ready.setting, ready.recording, nodes, viewing, aim, key, *sizes)
        return _Batches(count, *jax.tree.map(np.asarray, _several(*given)))

    wanted = _wanted(ready, tile, part, viewing, key)
    found = more(0, MIN_BATCHES)
    while found.count < MOST_BATCHES:
        worst = wanted.worst(found) / (_AIM * rtol)
        if worst <= 1.0:
            break
        # Of few batches, the worst of many errors is too large: no long steps.
        count = int(np.ceil(1.05 * found.count * min(worst, 1.4) ** 2))
        found = found.joined(more(found.count, min(max(count - found.count, 2), MOST_BATCHES - found.count)))
    lit = np.abs(tile.part) > 0
    per_node = np.bincount(tile.photons.node, minlength=tile.part.shape[1])
    variance, fates_variance = (_variance(part, a, found.count) for a in found.moments.squares)
    if views is None:
        # Light that is put elsewhere about a node is an error as large as what the node returns of it.
        variance = variance + _summed(tile.astray**2, found.moments.mean[0] ** 2)
    return Part(
        tile.shots,
        _summed(part, found.lines),
        _summed(part, found.moments.mean[1]),
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
    recording: WaveformModel,
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
    balance, errors = (budget_of_sums(ResponseSums(**f), recording) for f in (fates, fates_stderr))
    # What returns is taken from one of the others, which keeps its error.
    held = {"escaped": "escaped", "after the window": "late", "unfollowed": "remaining"}
    energy_budget_stderr = errors.energy_budget | {name: fates_stderr[fate] for name, fate in held.items()}
    error = relative_error(total, stderr, jnp)
    photons = jnp.zeros((), jnp.int32)
    return record_of_shot(recording, parts, balance, stderr, energy_budget_stderr, error, photons)


def _finish_all(recording: WaveformModel, air: Array | None, *arrays: Any) -> Record:
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
    wide = widening(1.0 + (count - 1.0) * np.maximum(nodes, 1.0)) ** 2 / (count * (count - 1.0))
    return _summed((weight * wide[:, None]).astype(part.dtype), squares)
