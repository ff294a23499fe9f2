r"""Forward model of a fit: the simulated waveform and its Jacobian, each column in the cheapest way.

The waveform w(x) of the unknowns x is linear in the traced response (`jaxlidar.trace_scene`): w = optics(x)
applied to response(x). A column dw/dx_k of the Jacobian is computed

- for an *optical* unknown from the derivative of the optics: a small matrix product with the response;
- for an unknown that changes *extinction* only, from the score function of the traced paths, d log(path
  probability) / d x_k (likelihood-ratio method, `jaxlidar.trace.derivatives.score_functions`), if that is
  possible and pays;
- for any other, *geometric* unknown as a tangent (forward-mode derivative) pushed through the trace; all
  tangents share one pass, or as many as memory allows.

If all unknowns are optical, photons are traced once.

**Scores.** They are unbiased, though no derivative of the sampled waveform, and take less than half of the
time of a tangent if

- the response keeps scattering histories apart from optics and no leaf transmits straight on, so that one
  trace serves all wavelengths;
- wavelengths and columns are few, as every collision adds to all of them; off nadir, two columns or more.

**Common random numbers.** All evaluations of a fit use the same random keys, so that w is a smooth function
of x except for small jumps. An evaluation is the mean of batches of photons, each with its own key; their
spread gives the simulation's own noise. The first few batches are an evaluation with more noise, for fits
that are far from their end.

**Source:** score function: Glynn (1990), Comm. ACM 33(10), 75; common random numbers and sample averages:
Shapiro, Dentcheva and Ruszczynski (2009), Lectures on Stochastic Programming, chapter 5.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from inversion.fit.planning import N_BATCHES
from inversion.fit.unknowns import (
    BoundUnknown,
    Dependence,
    Setter,
    extinction_arrays,
    set_lidar_values,
    set_values,
)
from jaxlidar import (
    Lidar,
    Plan,
    Scene,
    Waveform,
    make_setup,
    total_reflectance,
    trace_scene,
    waveform_of,
)
from jaxlidar.extend import Program, concrete, side_by_side
from jaxlidar.planning.memory import format_bytes, memory_limit, scored_bytes
from jaxlidar.planning.plan_check import is_in_reach
from jaxlidar.planning.setup import Setup
from jaxlidar.spectral.apply_optics import derivatives_to_samples, make_waveform_model, setup_optics
from jaxlidar.trace.derivatives.extinction_slopes import ExtinctionSlopes
from jaxlidar.trace.derivatives.score_functions import make_slopes
from jaxlidar.trace.device_scene import build_device_scene
from jaxlidar.trace.march.voxel_traversal import with_room
from jaxlidar.trace.response import Response, trace_with_scores

Values = tuple[Array, ...]
# Batches of a pilot evaluation: a quarter of the work of all, and the least that shows its own noise.
PILOT_BATCHES = 2
# Largest rounding of the lidar's position in a fit, m.
MAX_ROUNDING = 1e-3
# Most columns and wavelengths of scores: every collision adds to all of them.
MAX_SCORED_COLUMNS, MAX_SCORED_WAVELENGTHS = 64, 16
# With more than DENSE_COLUMNS columns, of which at most SPARSE_COLUMNS move one voxel, a voxel lists its own
# columns: this is faster than a derivative for all columns in every voxel.
DENSE_COLUMNS, SPARSE_COLUMNS = 8, 2
# Points within the bounds at which the columns of each voxel are probed.
N_PROBES = 4


class JacobianMethods(NamedTuple):
    """The method for each unknown.

    - `setters`: their `dependence` names the method here: "geometric" (tangents) also for unknowns that act
      through less, where the cheaper method cannot be used.
    - `columns_per_voxel`: the most columns that move the extinction of one voxel; 0 without scores.
    - `score_bytes`: memory of the scores.
    """

    setters: tuple[Setter, ...]
    columns_per_voxel: int
    score_bytes: float


def choose_jacobian_methods(
    lidar: Lidar, scene: Scene, plan: Plan, unknowns: Sequence[BoundUnknown]
) -> JacobianMethods:
    """Choose scores for unknowns that change extinction, if they are valid and pay, and tangents if not.

    Scores are valid if the plan keeps histories apart from optics, and no leaf transmits straight on. They
    pay for some columns, at few wavelengths, if they take no more than half of the memory.
    """
    setters = tuple(u.setter for u in unknowns)
    as_tangents = tuple(
        setter._replace(dependence="geometric") if setter.dependence == "extinction" else setter
        for setter in setters
    )
    if not plan.config.keeps_histories:
        # Optics are applied while light is traced: even optical unknowns change the trace.
        return JacobianMethods(tuple(s._replace(dependence="geometric") for s in setters), 0, 0.0)
    columns = sum(u.start.size for u in unknowns if u.setter.dependence == "extinction")
    if columns == 0:
        return JacobianMethods(setters, 0, 0.0)
    # The setup's scene: a plan may leave the canopy out.
    canopy, wavelengths = make_setup(lidar, scene, plan).scene.canopy, lidar.wavelength.size
    # Off nadir the return path is marched as well, which takes as long as the tangent of one column.
    min_columns = 1 if plan.config.vertical else 2
    pays = min_columns <= columns <= MAX_SCORED_COLUMNS and wavelengths <= MAX_SCORED_WAVELENGTHS
    if canopy is None or canopy.is_straight or not pays:
        return JacobianMethods(as_tangents, 0, 0.0)
    n_voxels = int(np.prod(canopy.voxels.shape))
    size = scored_bytes(plan.config, plan.bins, cells=n_voxels, columns=columns, wavelengths=wavelengths)
    # The other half is for the response and for tangents of the geometric unknowns.
    if size > 0.5 * memory_limit(plan.scope.max_memory):
        return JacobianMethods(as_tangents, 0, 0.0)
    return JacobianMethods(setters, max_columns_per_voxel(scene, unknowns), size)


def max_columns_per_voxel(scene: Scene, unknowns: Sequence[BoundUnknown]) -> int:
    """Return the most columns that move the extinction of one voxel: a small number if probes show it.

    Else it is the number of all columns, which is always right.

    Few columns (`DENSE_COLUMNS`) are not probed. More are probed at the start and at random points between
    the bounds of all unknowns, in the scene and with plants in every voxel: scenes that are fitted together
    may have plants in different voxels.
    """
    scored = [i for i, u in enumerate(unknowns) if u.setter.dependence == "extinction"]
    columns = sum(unknowns[i].start.size for i in scored)
    if columns <= DENSE_COLUMNS:
        return columns
    # A fixed seed: the count decides which program is compiled, and must not differ between equal fits.
    setters, random = tuple(u.setter for u in unknowns), np.random.default_rng(0)
    points = [tuple(u.start for u in unknowns)]
    for _ in range(N_PROBES):
        fractions = [random.uniform(size=u.start.shape) for u in unknowns]
        between = [u.low + fraction * (u.high - u.low) for u, fraction in zip(unknowns, fractions)]
        points.append(tuple(jnp.asarray(b, u.start.dtype) for u, b in zip(unknowns, between)))
    plants_everywhere = eqx.tree_at(_extinction_tables, scene, replace_fn=jnp.ones_like)
    cases = [(probed_scene, values) for probed_scene in (scene, plants_everywhere) for values in points]
    zeros = [jnp.zeros_like(u.start) for u in unknowns]
    count = np.zeros(())
    for i in scored:
        for element in range(unknowns[i].start.size):
            direction = list(zeros)
            direction[i] = zeros[i].reshape(-1).at[element].set(1.0).reshape(zeros[i].shape)
            moved = [_moved_voxels(s, values, setters, tuple(direction)) for s, values in cases]
            count = count + np.stack(moved)
    most = int(np.max(count))
    return most if most <= SPARSE_COLUMNS else columns


def _extinction_tables(scene: Any) -> list[Any]:
    """Return the extinction of leaf and bark, of those that the canopy has."""
    voxels = scene.canopy.voxels
    return [table for table in (voxels.leaf, voxels.bark) if table is not None]


@Program
def _moved_voxels(
    scene: Scene, values: Values, setters: tuple[Setter, ...], direction: Values
) -> Bool[Array, "nx ny nz"]:
    """Return True for voxels whose extinction changes with the values along a direction."""
    derivatives = jax.jvp(
        lambda values: _extinction_tables(set_values(scene, setters, values)), (values,), (direction,)
    )[1]
    return jnp.any(jnp.stack(derivatives) != 0, axis=0)


def tangents_per_pass(plan: Plan, columns: int, reserved: float = 0.0) -> int:
    """Return the number of tangents that are pushed through the trace at once: as many as memory allows.

    Passes are about equally large. `reserved`: bytes that the other columns take.

    **Raises:** ValueError if a single column takes more memory than the plan may.
    """
    n_at_once, limit = columns, memory_limit(plan.scope.max_memory) - reserved
    while n_at_once > 1 and plan.jacobian_memory(n_at_once) > limit:
        n_at_once -= 1
    if columns and (size := plan.jacobian_memory(n_at_once)) > limit:
        raise ValueError(
            f"derivatives in the geometric unknowns would take about {format_bytes(size)} of memory, one at "
            f"a time; admissible is max_memory = {limit / 1e9:.3g} GB of the plan: follow fewer orders "
            "(max_orders=), record a shorter window, have fewer plates or materials, or give a plan with more"
        )
    if not columns:
        return 0
    # Ceiling division, twice: the number of passes, then columns per pass.
    passes = -(-columns // n_at_once)
    return -(-columns // passes)


class SimulationInputs(eqx.Module):
    """Inputs of a simulation, except the values of the unknowns.

    - `tangents_per_pass`: geometric columns of the Jacobian that are pushed through the trace together.
    - `columns_per_voxel`: the most columns that move the extinction of one voxel; 0 without scores.
    - `voxel_counts`: numbers of voxels, where the scene's map has room for more (`with_room`); else None.
    """

    lidar: Lidar
    scene: Scene
    plan: Plan
    setters: tuple[Setter, ...] = eqx.field(static=True)
    tangents_per_pass: int = eqx.field(static=True)
    columns_per_voxel: int = eqx.field(static=True, default=0)
    voxel_counts: Int[Array | np.ndarray, "3"] | None = None

    def with_room(self) -> "SimulationInputs":
        """Return the inputs with a voxel map of a size bucket, whose programs maps of several shapes share.

        Unknowns may stand for the map itself: then it stays as it is.
        """
        if self.scene.canopy is None:
            return self
        extinction = extinction_arrays(self.scene)
        if any(s.apply is not None or (not s.of_lidar and s.array_index in extinction) for s in self.setters):
            return self
        assert self.columns_per_voxel == 0
        voxels = with_room(self.scene.canopy.voxels)
        # The numbers of voxels join the scene after the values, whose setters count the arrays before them.
        tables = dataclasses.replace(voxels, _counts=None)
        scene = eqx.tree_at(lambda s: s.canopy.voxels, self.scene, tables)
        return dataclasses.replace(self, scene=scene, voxel_counts=voxels.counts)

    def setup(self, values: Values) -> Setup:
        """Return the setup with these values."""
        return make_setup(*self._with_values(values), self.plan)

    def can_simulate(self, values: Values) -> Bool[Array, ""]:
        """Return True if these values are admissible and the plan has the path lengths of their scene."""
        is_admissible = jnp.isfinite(self.setup(values).admissible)
        return is_admissible & is_in_reach(self.plan, *self._with_values(values))

    def _with_values(self, values: Values) -> tuple[Lidar, Scene]:
        lidar = set_lidar_values(self.lidar, self.setters, values)
        scene = set_values(self.scene, self.setters, values)
        if self.voxel_counts is not None:
            assert scene.canopy is not None
            voxels = dataclasses.replace(scene.canopy.voxels, _counts=self.voxel_counts)
            scene = eqx.tree_at(lambda s: s.canopy.voxels, scene, voxels)
        return lidar, scene

    def as_function_of(
        self, dependence: Dependence, values: Values
    ) -> tuple[Array, Callable[[Array], Setup]]:
        """Return the values of the unknowns of one dependence as a vector, and the setup as its function.

        The other unknowns keep their values.
        """
        indices = [i for i, setter in enumerate(self.setters) if setter.dependence == dependence]
        flat, restore = jax.flatten_util.ravel_pytree([values[i] for i in indices])

        def setup_at(flat: Array) -> Setup:
            changed = dict(zip(indices, restore(flat)))
            return self.setup(tuple(changed.get(i, v) for i, v in enumerate(values)))

        return flat, setup_at


def _extinction_slopes(inputs: SimulationInputs, values: Values) -> ExtinctionSlopes | None:
    """Return dk/dx per voxel, k the extinction, of the unknowns that change it only; all batches share it."""
    flat, setup_at = inputs.as_function_of("extinction", values)
    if not flat.size:
        return None

    def extinction(flat: Array) -> tuple[Array | None, Array | None]:
        medium = build_device_scene(setup_at(flat), derivatives="forward").medium
        assert medium is not None
        return medium.leaf, medium.bark

    derivatives = jax.vmap(lambda tangent: jax.jvp(extinction, (flat,), (tangent,))[1])
    leaf, bark = derivatives(jnp.eye(flat.size, dtype=flat.dtype))
    setup = setup_at(flat)
    device_scene = build_device_scene(setup, derivatives="forward")
    return make_slopes(device_scene, leaf, bark, setup_optics(setup), inputs.columns_per_voxel)


def _trace_with_slopes(
    setup: Setup, slopes: ExtinctionSlopes, key: PRNGKeyArray
) -> tuple[Response, Float[Array, "columns wavelengths bins"]]:
    """Trace one batch. Return its response, and the derivatives of its reflectance by scores."""
    device_scene = dataclasses.replace(build_device_scene(setup, derivatives="forward"), slopes=slopes)
    response, fine_columns = trace_with_scores(device_scene, setup_optics(setup), key)
    return response, derivatives_to_samples(fine_columns, make_waveform_model(setup))


class TracedBatch(NamedTuple):
    """Response of one batch, its reflectance, and the columns of its Jacobian that need the trace.

    These are the geometric ones, then those by extinction. Optical columns are computed later from the mean
    response of all batches.
    """

    response: Response
    reflectance: Float[Array, "wavelengths bins"]
    columns: Float[Array, "columns wavelengths bins"]


def _trace_batch(
    inputs: SimulationInputs, values: Values, key: PRNGKeyArray, slopes: ExtinctionSlopes | None
) -> TracedBatch:
    """Trace one batch, with its derivatives.

    `slopes`: dk/dx of the unknowns of extinction, or None without scores.
    """
    flat, setup_at = inputs.as_function_of("geometric", values)

    # The response is an auxiliary output: its tangents, with all histories, would take far more memory than
    # those of the total.
    def simulate(flat: Array) -> tuple[Array, tuple[Response, Array | None]]:
        setup = setup_at(flat)
        if slopes is None:
            response, score_columns = trace_scene(setup, key, reverse=False), None
        else:
            response, score_columns = _trace_with_slopes(setup, slopes, key)
        return total_reflectance(response, setup), (response, score_columns)

    reflectance, columns, (response, score_columns) = _value_and_tangents(
        simulate, flat, inputs.tangents_per_pass
    )
    if score_columns is not None:
        columns = jnp.concatenate([columns, score_columns])
    return TracedBatch(response, reflectance, columns)


def _value_and_tangents(
    function: Callable[[Array], tuple[Array, Any]], flat: Float[Array, "columns"], per_pass: int
) -> tuple[Array, Array, Any]:
    """Return a function's value, its derivatives (columns, ...) and its auxiliary output.

    `per_pass`: derivatives that are computed at once.
    """
    if not flat.size:
        value, auxiliary = function(flat)
        return value, jnp.zeros((0, *value.shape), value.dtype), auxiliary
    directions = jnp.eye(flat.size, dtype=flat.dtype)
    if per_pass == flat.size:
        # The auxiliary output without its tangents is the same in all directions: out_axes=None does not
        # batch it, and the primal computation is shared.
        push = jax.vmap(lambda t: jax.jvp(function, (flat,), (t,), has_aux=True), out_axes=(None, 0, None))
        return push(directions)

    def one_pass(directions: Array) -> Array:
        return jax.vmap(lambda t: jax.jvp(lambda x: function(x)[0], (flat,), (t,))[1])(directions)

    value, auxiliary = function(flat)
    # The last pass is filled up with zero directions.
    passes = jnp.pad(directions, ((0, -flat.size % per_pass), (0, 0))).reshape(-1, per_pass, flat.size)
    columns = jax.lax.map(one_pass, passes).reshape(-1, *value.shape)
    return value, columns[: flat.size], auxiliary


# One core each: batches run side by side on threads.
_compiled_trace_batch = Program(_trace_batch, one_core=True)
_compiled_slopes = Program(_extinction_slopes)


@Program
def _apply_optics(
    inputs: SimulationInputs, values: Values, response: Response
) -> tuple[Float[Array, "wavelengths bins"], Float[Array, "columns wavelengths bins"]]:
    """Return the reflectance of a response, and its derivatives by the optical unknowns."""
    flat, setup_at = inputs.as_function_of("optical", values)

    def reflectance(flat: Array) -> tuple[Array, None]:
        return total_reflectance(response, setup_at(flat)), None

    return _value_and_tangents(reflectance, flat, flat.size)[:2]


@Program
def _as_waveform(inputs: SimulationInputs, values: Values, response: Response, stderr: Array) -> Waveform:
    return waveform_of(response, inputs.setup(values), stderr=stderr)


@Program
def _mean_response(responses: list[Any]) -> Any:
    return jax.tree.map(lambda *a: sum(a) / len(a), *responses)


def evaluate_scene(
    inputs: SimulationInputs, values: Values, keys: Array, n_batches: Int[Array, ""]
) -> tuple[
    Float[Array, "wavelengths bins"],
    Float[Array, "columns wavelengths bins"],
    Float[Array, "batches wavelengths bins"],
]:
    """Return reflectance, derivatives and batches of one scene: a pure function, to be mapped over scenes.

    Columns are the geometric ones, then those by extinction, then the optical ones. `keys` has a random key
    for each batch of photons. Only the first `n_batches` are traced; the rows of the others are zero. As
    their number is data, one compiled program serves pilot evaluations and full ones.
    """
    slopes = _extinction_slopes(inputs, values)
    # Under jit the batch is traced by JAX once for shapes and loop alike.
    trace_batch = jax.jit(lambda key: _trace_batch(inputs, values, key, slopes))

    # One batch after the other: batches side by side would multiply the memory that the plan was made for.
    def add_batch(n: Array, sums: Any) -> Any:
        response, reflectance, columns = trace_batch(keys[n])
        summed, batches = sums
        return jax.tree.map(jnp.add, summed, (response, columns)), batches.at[n].set(reflectance)

    shapes = jax.eval_shape(trace_batch, keys[0])
    response, reflectance, columns = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)
    zero = (response, columns), jnp.zeros((len(keys), *reflectance.shape), reflectance.dtype)
    sums, batches = jax.lax.fori_loop(0, n_batches, add_batch, zero)
    # At least 1: an idle member of a lockstep group traces nothing.
    response, columns = jax.tree.map(lambda a: a / jnp.maximum(n_batches, 1), sums)
    reflectance, optical_columns = _apply_optics(inputs, values, response)
    return reflectance, jnp.concatenate([columns, optical_columns]), batches


class Evaluation(NamedTuple):
    """The simulated waveform at some values.

    - `reflectance`: (wavelengths, bins) apparent reflectance of all orders, the mean of the batches.
    - `jacobian`: (wavelengths, bins, columns), columns in the order of the flattened unknowns.
    - `response`: mean of the batches' responses, or None if many scenes are simulated together.
    - `batches`: (batches, wavelengths, bins) the reflectance of each, or None if they were not requested.
    - `is_pilot`: True if only the first few batches were traced. Default False.
    """

    reflectance: np.ndarray
    jacobian: np.ndarray
    response: Response | None
    batches: np.ndarray | None
    is_pilot: bool = False


def batch_keys(plan: Plan, key: PRNGKeyArray) -> list[PRNGKeyArray]:
    """Return the random keys of the batches of an evaluation: one without random numbers, which is exact."""
    return [jax.random.fold_in(key, n) for n in range(N_BATCHES if plan.is_random else 1)]


def check_position(lidar: Lidar) -> None:
    """Refuse positions that JAX's precision rounds by more than a millimetre.

    `simulate` moves the origin before it rounds; the compiled programs of a fit take positions as they are.

    **Raises:** ValueError with the rounding.
    """
    position, dtype = concrete(lidar.position), jnp.result_type(float)
    if position is None:
        return
    rounding = float(np.max(np.spacing(np.abs(position).astype(dtype))))
    if rounding > MAX_ROUNDING:
        raise ValueError(
            f"position = {position.tolist()} m is rounded by {rounding:.1g} m in {dtype}; admissible for "
            f"fits is {MAX_ROUNDING:g} m: give lidar and scene relative to a nearby origin, or enable double "
            "precision"
        )


class ForwardModel:
    """The simulated waveform as a function of the unknowns. Photons are traced no more often than needed.

    - If all unknowns are optical, photons are traced once, with all batches, and reused at every call; pilot
      evaluations are full ones.
    - Otherwise the batches of a pilot evaluation are stored, and a full evaluation at the same values traces
      only the remaining ones. They are discarded after a full evaluation: the fit goes on to other values,
      and responses may be large.
    """

    def __init__(
        self, lidar: Lidar, scene: Scene, plan: Plan, unknowns: Sequence[BoundUnknown], key: PRNGKeyArray
    ):
        check_position(lidar)
        methods = choose_jacobian_methods(lidar, scene, plan, unknowns)
        n_geometric = sum(
            u.start.size for u, setter in zip(unknowns, methods.setters) if setter.dependence == "geometric"
        )
        per_pass = tangents_per_pass(plan, n_geometric, methods.score_bytes)
        self.scene = scene
        self.inputs = SimulationInputs(
            lidar, scene, plan, methods.setters, per_pass, methods.columns_per_voxel
        ).with_room()
        self.shapes = [u.start.shape for u in unknowns]
        self.dtypes = [u.start.dtype for u in unknowns]
        self.sizes = [u.start.size for u in unknowns]
        # Pilot batches are the first ones: a full evaluation at the same values reuses them.
        self.keys = batch_keys(plan, key)
        self.n_pilot = min(PILOT_BATCHES, len(self.keys))
        self.retraces = any(setter.changes_response for setter in methods.setters)
        # Values of the last call, and its traced batches.
        self._cache: tuple[np.ndarray, list[TracedBatch]] | None = None
        # Columns are computed by dependence; `order` sorts them as the flattened unknowns.
        column_dependence = np.repeat([setter.dependence for setter in methods.setters], self.sizes)
        computed = [np.flatnonzero(column_dependence == d) for d in ("geometric", "extinction", "optical")]
        self.order = np.argsort(np.concatenate(computed))

    def values(self, flat: Float[np.ndarray, " columns"]) -> Values:
        """Return the values of the unknowns from one vector."""
        pieces = np.split(np.asarray(flat), np.cumsum(self.sizes)[:-1])
        return tuple(jnp.asarray(p.reshape(s), d) for p, s, d in zip(pieces, self.shapes, self.dtypes))

    def scene_at(self, flat: Float[np.ndarray, " columns"]) -> Scene:
        """Return the scene with these values."""
        return set_values(self.scene, self.inputs.setters, self.values(flat))

    def __call__(
        self, flat: Float[np.ndarray, " columns"], *, with_batches: bool = False, pilot: bool = False
    ) -> Evaluation:
        """Simulate at the values `flat`.

        1. Trace the batches that the cache does not have.
        2. Average their responses, and apply the optics to the mean, with the optical columns.
        3. Average the other columns over batches.

        **Arguments:**

        - `with_batches`: give the batches one by one. Default False: only if photons are traced anyway.
        - `pilot`: the first few batches suffice. Without effect if all unknowns are optical. Default False.
        """
        values = self.values(flat)
        is_new_trace = self.retraces or self._cache is None
        traced = self._trace(flat, self.n_pilot if pilot and self.retraces else len(self.keys))
        responses = [batch.response for batch in traced]
        # The waveform is linear in the response: optics are applied once, to the mean.
        response, batches = _mean_response(responses), None
        reflectance, optical_columns = _apply_optics(self.inputs, values, response)
        columns = np.asarray(optical_columns, float)
        # The batches of a new trace have been evaluated at these values already.
        if is_new_trace:
            batches = np.stack([np.asarray(batch.reflectance, float) for batch in traced])
            traced_columns = np.mean([np.asarray(batch.columns, float) for batch in traced], axis=0)
            columns = np.concatenate([traced_columns, columns])
        elif with_batches:
            batches = np.stack(
                [np.asarray(_apply_optics(self.inputs, values, r)[0], float) for r in responses]
            )
        jacobian = np.moveaxis(columns[self.order], 0, -1)
        is_pilot = len(traced) < len(self.keys)
        return Evaluation(np.asarray(reflectance, float), jacobian, response, batches, is_pilot)

    def _trace(self, flat: Float[np.ndarray, " columns"], n_batches: int) -> list[TracedBatch]:
        """Return the first `n_batches`: from the cache if it holds these values, else traced."""
        reused = []
        if self._cache is not None and (not self.retraces or np.array_equal(self._cache[0], flat)):
            reused = self._cache[1]
        values = self.values(flat)
        slopes = _compiled_slopes(self.inputs, values) if self.inputs.columns_per_voxel else None

        def trace_batch(key):
            return _compiled_trace_batch(self.inputs, values, key, slopes)

        with side_by_side() as run:
            traced = [*reused[:n_batches], *run(trace_batch, self.keys[len(reused) : n_batches])]
        may_serve_again = not self.retraces or n_batches < len(self.keys)
        self._cache = (np.array(flat), traced) if may_serve_again else None
        return traced

    def waveform(
        self, flat: Float[np.ndarray, " columns"], evaluation: Evaluation, stderr: np.ndarray
    ) -> Waveform:
        """Return the evaluation as a waveform."""
        assert evaluation.response is not None
        error = jnp.asarray(stderr, self.dtypes[0])
        return _as_waveform(self.inputs, self.values(flat), evaluation.response, error)


def batch_stderr(batches: np.ndarray | None) -> np.ndarray | float:
    """Return the standard error of the mean of batches, smoothed over five bins; zero for a single batch.

    Few batches give a poor estimate in each bin, while the error varies slowly with time.
    """
    if batches is None or len(batches) < 2:
        return 0.0
    variance = np.var(batches, axis=0, ddof=1) / len(batches)
    padded = np.pad(variance, ((0, 0), (2, 2)), mode="edge")
    smoothed = np.mean([padded[:, i : i + variance.shape[1]] for i in range(5)], axis=0)
    return np.sqrt(smoothed)
