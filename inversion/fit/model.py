"""The simulated waveform and its Jacobian, with each unknown's column computed in the cheapest way.

Optical unknowns do not change the response: their columns are a small matrix product with the traced
response. Unknowns that change extinction alone are scored while photons are traced (`inversion.extinction`).
Geometric unknowns need tangents pushed through the trace, all of them in one pass that shares what does not
depend on them, or as many as memory allows. Where all unknowns are optical, photons are traced once.

All evaluations use the same random keys, so that the waveform is a smooth function of the unknowns. An
evaluation averages batches of photons, each with its own key; their spread is the simulation's own noise.
Few of the batches are an evaluation as well, of more noise, for fits that are far from their end.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from inversion.fit.columns import columns_at_once
from inversion.fit.extinction import scores_at, sorted_places, traced_with
from inversion.fit.unknowns import Kind, Place, Settled, put
from jaxlidar import (
    Lidar,
    Plan,
    Response,
    Scene,
    Setup,
    Waveform,
    make_setup,
    total_reflectance,
    trace_scene,
    waveform_of,
)
from jaxlidar.extend import ONE_CORE, concrete, side_by_side
from jaxlidar.planning.plan import MIN_BATCHES
from jaxlidar.trace.extinction_slopes import ExtinctionSlopes

Values = tuple[Array, ...]
# So many batches are few: a quarter of the work of all, and their difference still tells the noise.
FEW_BATCHES = 2
# Rounding of coordinates, m, with which fits are still admissible.
ROUNDING = 1e-3


class Problem(eqx.Module):
    """Inputs of a simulation, except the values of the unknowns.

    `at_once`: geometric columns of the Jacobian that are pushed through the trace together. `most`: unknowns
    that move the extinction of one voxel, if scored.
    """

    lidar: Lidar
    scene: Scene
    plan: Plan = eqx.field(static=True)
    places: tuple[Place, ...] = eqx.field(static=True)
    at_once: int = eqx.field(static=True)
    most: int = eqx.field(static=True, default=0)

    def at(self, values: Values) -> Setup:
        """The setup with these values."""
        return make_setup(self.lidar, put(self.scene, self.places, values), self.plan)

    def moving(self, values: Values, kind: Kind) -> tuple[Array, Callable[[Array], Setup]]:
        """The values of the unknowns of a kind as one vector, and the setup as its function.

        The other unknowns keep their values.
        """
        numbers = [i for i, place in enumerate(self.places) if place.kind == kind]
        flat, restore = jax.flatten_util.ravel_pytree([values[i] for i in numbers])

        def setup(flat: Array) -> Setup:
            moved = dict(zip(numbers, restore(flat)))
            return self.at(tuple(moved.get(i, v) for i, v in enumerate(values)))

        return flat, setup


def _scores(problem: Problem, values: Values) -> ExtinctionSlopes | None:
    """Scores of the unknowns that change extinction alone, which all batches share."""
    flat, setup_at = problem.moving(values, "extinction")
    return scores_at(setup_at, flat, problem.most)


def _batch(
    problem: Problem, values: Values, key: PRNGKeyArray, scores: ExtinctionSlopes | None
) -> tuple[Response, Float[Array, "wavelengths bins"], Float[Array, "columns wavelengths bins"]]:
    """Response and total of one batch, and its derivatives in geometric unknowns, then in extinction."""
    flat, setup_at = problem.moving(values, "geometric")

    def total(flat: Array) -> tuple[Array, tuple[Response, Array | None]]:
        setup = setup_at(flat)
        if scores is None:
            response, scored = trace_scene(setup, key, reverse=False), None
        else:
            response, scored = traced_with(setup, scores, key)
        return total_reflectance(response, setup), (response, scored)

    value, columns, (response, scored) = _pushed(total, flat, problem.at_once)
    return response, value, columns if scored is None else jnp.concatenate([columns, scored])


def _pushed(
    total: Callable[[Array], tuple[Array, Any]], flat: Float[Array, "columns"], size: int
) -> tuple[Array, Array, Any]:
    """A function's value, its derivatives, `size` of them at once, and what it gives beside."""
    if not flat.size:
        value, beside = total(flat)
        return value, jnp.zeros((0, *value.shape), value.dtype), beside
    directions = jnp.eye(flat.size, dtype=flat.dtype)
    if size == flat.size:
        # What is beside, without its tangents is the same in all directions, hence not batched.
        push = jax.vmap(lambda t: jax.jvp(total, (flat,), (t,), has_aux=True), out_axes=(None, 0, None))
        return push(directions)

    def some(directions: Array) -> Array:
        return jax.vmap(lambda t: jax.jvp(lambda x: total(x)[0], (flat,), (t,))[1])(directions)

    value, beside = total(flat)
    groups = jnp.pad(directions, ((0, -flat.size % size), (0, 0))).reshape(-1, size, flat.size)
    columns = jax.lax.map(some, groups).reshape(-1, *value.shape)
    return value, columns[: flat.size], beside


_compiled_batch = eqx.filter_jit(_batch, **ONE_CORE)
_compiled_scores = eqx.filter_jit(_scores)


@eqx.filter_jit
def _colour(
    problem: Problem, values: Values, response: Response
) -> tuple[Float[Array, "wavelengths bins"], Float[Array, "columns wavelengths bins"]]:
    """Total of a response, and its derivatives in the optical unknowns."""
    flat, setup_at = problem.moving(values, "optical")

    def total(flat: Array) -> Array:
        return total_reflectance(response, setup_at(flat))

    if not flat.size:
        value = total(flat)
        return value, jnp.zeros((0, *value.shape), value.dtype)
    push = jax.vmap(lambda t: jax.jvp(total, (flat,), (t,)), out_axes=(None, 0))
    return push(jnp.eye(flat.size, dtype=flat.dtype))


@eqx.filter_jit
def _recorded(problem: Problem, values: Values, response: Response, stderr: Array) -> Waveform:
    return waveform_of(response, problem.at(values), stderr=stderr)


@jax.jit
def _mean(responses: list[Any]) -> Any:
    return jax.tree.map(lambda *a: sum(a) / len(a), *responses)


def evaluate(
    problem: Problem, values: Values, keys: Array, count: Int[Array, ""]
) -> tuple[
    Float[Array, "wavelengths bins"],
    Float[Array, "columns wavelengths bins"],
    Float[Array, "batches wavelengths bins"],
]:
    """Total, derivatives and batches of one scene, in one function.

    Columns are the geometric ones, then those in extinction, then the optical ones. The function is pure, to
    be batched over scenes; `keys` has one random key for each batch of photons. Only the first `count`
    batches are traced: the others are zero.
    """
    scores = _scores(problem, values)
    batch = jax.jit(lambda key: _batch(problem, values, key, scores))

    def add(n: Array, sums: Any) -> Any:
        response, total, columns = batch(keys[n])
        summed, totals = sums
        return jax.tree.map(jnp.add, summed, (response, columns)), totals.at[n].set(total)

    shapes = jax.eval_shape(batch, keys[0])
    response, total, columns = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)
    none = (response, columns), jnp.zeros((len(keys), *total.shape), total.dtype)
    sums, totals = jax.lax.fori_loop(0, count, add, none)
    response, columns = jax.tree.map(lambda a: a / jnp.maximum(count, 1), sums)
    total, more = _colour(problem, values, response)
    return total, jnp.concatenate([columns, more]), totals


class Evaluation(NamedTuple):
    """The simulated waveform at some values.

    - `total`: (wavelengths, bins) apparent reflectance, the mean of the batches.
    - `jacobian`: (wavelengths, bins, columns), columns in the order of the flattened unknowns.
    - `response`: mean of the batches' responses, or None where many scenes are simulated together.
    - `batches`: (batches, wavelengths, bins) the total of each, or None where it was not asked for.
    - `few`: whether these are few of the batches. Default False: they are all.
    """

    total: np.ndarray
    jacobian: np.ndarray
    response: Response | None
    batches: np.ndarray | None
    few: bool = False


def check_place(lidar: Lidar) -> None:
    """Refuse places that JAX's precision rounds by more than a millimetre: the fit's programs round them.

    **Raises:** ValueError with the rounding.
    """
    place, kind = concrete(lidar.position), jnp.result_type(float)
    if place is None:
        return
    rounding = float(np.max(np.spacing(np.abs(place).astype(kind))))
    if rounding > ROUNDING:
        raise ValueError(
            f"position = {place.tolist()} m is rounded by {rounding:.1g} m in {kind}; admissible for fits is "
            f"{ROUNDING:g} m: tell the lidar and the scene from a place nearby, or enable double precision"
        )


class Model:
    """The simulated waveform as a function of the unknowns. Photons are traced no more often than needed."""

    def __init__(self, lidar: Lidar, scene: Scene, plan: Plan, settled: Sequence[Settled], key: PRNGKeyArray):
        check_place(lidar)
        places, most, beside = sorted_places(lidar, scene, plan, settled)
        moving = sum(s.start.size for s, place in zip(settled, places) if place.kind == "geometric")
        at_once = columns_at_once(plan, moving, beside)
        self.problem = Problem(lidar, scene, plan, places, at_once, most)
        self.shapes = [s.start.shape for s in settled]
        self.dtypes = [s.start.dtype for s in settled]
        self.sizes = [s.start.size for s in settled]
        self.keys = [jax.random.fold_in(key, n) for n in range(MIN_BATCHES if plan.is_random else 1)]
        self.few = min(FEW_BATCHES, len(self.keys))
        self.traces = any(p.traced for p in self.problem.places)
        self._kept: tuple[np.ndarray, list[Any]] | None = None
        owner = np.repeat(np.arange(len(self.sizes)), self.sizes)
        kinds = np.array([p.kind for p in self.problem.places])[owner]
        found = [np.flatnonzero(kinds == kind) for kind in ("geometric", "extinction", "optical")]
        self.order = np.argsort(np.concatenate(found))

    def values(self, flat: Float[np.ndarray, " columns"]) -> Values:
        """The unknowns' values from one vector."""
        parts = np.split(np.asarray(flat), np.cumsum(self.sizes)[:-1])
        return tuple(jnp.asarray(p.reshape(s), d) for p, s, d in zip(parts, self.shapes, self.dtypes))

    def scene_at(self, flat: Float[np.ndarray, " columns"]) -> Scene:
        """The scene with these values."""
        return put(self.problem.scene, self.problem.places, self.values(flat))

    def __call__(
        self, flat: Float[np.ndarray, " columns"], *, spread: bool = False, few: bool = False
    ) -> Evaluation:
        """Simulate at the values `flat`.

        **Arguments:**

        - `spread`: whether the batches are needed one by one. Default False.
        - `few`: whether few of the batches will do; where none is traced again, all are given. Default False.
        """
        values = self.values(flat)
        fresh = self.traces or self._kept is None
        traced = self._trace(flat, self.few if few and self.traces else len(self.keys))
        responses = [t[0] for t in traced]
        response, batches = _mean(responses), None
        total, more = _colour(self.problem, values, response)
        columns = np.asarray(more, float)
        if fresh:
            batches = np.stack([np.asarray(t[1], float) for t in traced])
            geometric = np.mean([np.asarray(t[2], float) for t in traced], axis=0)
            columns = np.concatenate([geometric, columns])
        elif spread:
            batches = np.stack([np.asarray(_colour(self.problem, values, r)[0], float) for r in responses])
        jacobian = np.moveaxis(columns[self.order], 0, -1)
        few = len(traced) < len(self.keys)
        return Evaluation(np.asarray(total, float), jacobian, response, batches, few)

    def _trace(self, flat: Float[np.ndarray, " columns"], number: int) -> list[Any]:
        """The first batches, so many. Those of the last call are kept where they serve again."""
        kept = []
        if self._kept is not None and (not self.traces or np.array_equal(self._kept[0], flat)):
            kept = self._kept[1]
        values = self.values(flat)
        scores = _compiled_scores(self.problem, values) if self.problem.most else None

        def one(key):
            return _compiled_batch(self.problem, values, key, scores)

        with side_by_side() as run:
            traced = [*kept[:number], *run(one, self.keys[len(kept) : number])]
        # With all of them, a fit goes on to other values.
        again = not self.traces or number < len(self.keys)
        self._kept = (np.array(flat), traced) if again else None
        return traced

    def waveform(
        self, flat: Float[np.ndarray, " columns"], evaluation: Evaluation, stderr: np.ndarray
    ) -> Waveform:
        """The evaluation as a waveform."""
        assert evaluation.response is not None
        error = jnp.asarray(stderr, self.dtypes[0])
        return _recorded(self.problem, self.values(flat), evaluation.response, error)


def spread_of(batches: np.ndarray | None) -> np.ndarray | float:
    """Standard error of the mean of batches, smoothed over five bins; zero where there is one batch."""
    if batches is None or len(batches) < 2:
        return 0.0
    variance = np.var(batches, axis=0, ddof=1) / len(batches)
    padded = np.pad(variance, ((0, 0), (2, 2)), mode="edge")
    smooth = np.mean([padded[:, i : i + variance.shape[1]] for i in range(5)], axis=0)
    return np.sqrt(smooth)
