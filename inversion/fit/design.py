r"""Design of an instrument: the wavelengths, pulse and energies that minimise Cramer-Rao bounds.

For a lidar d and the unknowns x of a scene, J(d) = dw / dx are the derivatives of its waveform, sigma(d) the
noise and P the precision of the priors. The Cramer-Rao bound is the inverse of

    I(d) = J(d)^T diag(1 / sigma(d)^2) J(d) + P.

A cost of the bound, such as the sum of the relative variances (A-optimality), is minimised over d by its
gradient, which holds mixed second derivatives of the waveform by unknowns and design.

Light is traced once for each scene. The response R and its derivatives by the unknowns do not depend on what
acts after the trace: wavelengths, pulse, energies and jitter. So for every design,

    J(d) = dw / dR . dR / dx + dw / dx at constant R,   w = w(R, x, d),

is a small matrix product, by forward mode; JAX differentiates it by d in reverse mode.

The bound is computed by the QR decomposition of the whitened Jacobian: squared, its condition number would
exceed single precision. The optimiser is L-BFGS-B (Byrd et al. 1995, SIAM J. Sci. Comput. 16, 1190) of the
logarithm of the cost, from several starts.

**Source:** optimality criteria: Pukelsheim (2006), Optimal Design of Experiments, chapter 6.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray
from scipy import optimize

from inversion.fit.data import with_fixed_window
from inversion.fit.identifiability import CramerRao
from inversion.fit.model import SimulationInputs, Values
from inversion.fit.planning import N_BATCHES
from inversion.fit.prior_residuals import fixed_priors
from inversion.fit.unknowns import (
    BoundUnknown,
    Unknown,
    bind_unknowns,
    flat_bounds,
    flat_labels,
    flat_start,
)
from jaxlidar import Lidar, Plan, Response, Scene, plan_scenes, total_reflectance, trace_scene
from jaxlidar.extend import as_numpy, check_integer, check_key, check_kind, check_kinds, check_range

# Fields of a lidar that act after the trace, of which `inversion.fit.unknowns` names those that records
# determine.
_ADMISSIBLE_FIELDS = ("wavelength", "pulse", "energy", "efficiency", "jitter")
# Bounds of wavelengths, nm: those of the leaf models. Of other values: this factor about those of the lidar.
_WAVELENGTHS, _DEFAULT_FACTOR = (400.0, 2500.0), 4.0
# Default noise, as a fraction of the largest sample.
_NOISE_FRACTION = 0.01
# Precision that all unknowns have, in widths of their bounds, so that bounds of undetermined ones are finite.
_LEAST_PRECISION = 1e-6
# Cost of a design that is not finite, such as one of two equal wavelengths; of its logarithm.
_REJECTED_COST = 1e6

Noise = ArrayLike | Callable[[Lidar, Array], Array] | None
Cost = Callable[[CramerRao], Array]


@final
class Design(eqx.Module):
    """The result of `design`: the lidar whose Cramer-Rao bounds cost least.

    - `lidar`: the best lidar.
    - `values`: its free values, by path, in their own units.
    - `cost`, `initial_cost`: of this lidar, and of the one that was given.
    - `bounds`: a `CramerRao` of each scene, by this lidar.
    - `costs`: (starts,) cost at the minimum that each start has reached.
    - `converged`: True if the best start has met the tolerance of the optimiser.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> scene = jl.Scene(ground=jl.Ground())
    >>> height = inversion.Unknown("ground.height", bounds=(-2.0, 2.0), name="height")
    >>> best = inversion.design(
    ...     jl.Lidar(), scene, [height], free=("pulse.fwhm",), noise=0.01, limits={"pulse.fwhm": (2.0, 20.0)}
    ... )
    >>> best.bounds[0].labels, bool(best.cost <= best.initial_cost)
    (('height',), True)
    """

    lidar: Lidar
    values: dict[str, Float[np.ndarray, "..."]]
    cost: float
    initial_cost: float
    bounds: tuple[CramerRao, ...]
    costs: Float[np.ndarray, " starts"]
    converged: bool

    def __str__(self) -> str:
        rows = [f"{path}  {np.array2string(value, precision=5)}" for path, value in self.values.items()]
        costs = f"cost {self.cost:.4g}; of the lidar at the start {self.initial_cost:.4g}"
        return "\n".join([*rows, costs])


class FreeValues(NamedTuple):
    """Free values of a lidar: paths, indices among its pytree leaves, shapes, and bounds as flat vectors."""

    paths: tuple[str, ...]
    indices: tuple[int, ...]
    shapes: tuple[tuple[int, ...], ...]
    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]

    def split(self, flat: Any) -> list[Any]:
        """Return the values of each path from one vector."""
        ends = np.cumsum([int(np.prod(shape)) for shape in self.shapes])
        # NumPy's `split` does not take tracers.
        pieces = [flat[end - int(np.prod(shape)) : end] for end, shape in zip(ends, self.shapes)]
        return [piece.reshape(shape) for piece, shape in zip(pieces, self.shapes)]

    def lidar_with(self, lidar: Lidar, flat: Array) -> Lidar:
        """Return the lidar with these values; wavelengths are put in order."""
        leaves, structure = jax.tree.flatten(lidar)
        for path, index, value in zip(self.paths, self.indices, self.split(flat)):
            # Which wavelength is the first does not matter: the noise is that of the record.
            leaves[index] = jnp.sort(value) if path == "wavelength" else value
        return jax.tree.unflatten(structure, leaves)


class _TracedScene(eqx.Module):
    """One scene of a design: its response, the derivatives of that, and what the bound needs besides.

    - `inputs`, `values`: of the simulation at the unknowns' starting values.
    - `response`, `slopes`: the mean response, and its derivatives; the latter with a leading axis of
      unknowns, zeros for those that do not change it.
    - `width`: of the bounds of the flattened unknowns. `prior_rows`: whitened Jacobian of the priors, in
      widths.
    """

    inputs: SimulationInputs
    values: Values
    response: Response
    slopes: Response
    width: Float[Array, " n"]
    prior_rows: Float[Array, "rows n"]


def design(
    lidar: Lidar,
    scenes: Scene | Sequence[Scene],
    unknowns: Sequence[Unknown],
    *,
    free: Sequence[str] = ("wavelength", "pulse.fwhm"),
    limits: Mapping[str, tuple[Any, Any]] | None = None,
    cost: Cost | None = None,
    noise: Noise = None,
    starts: int = 4,
    max_steps: int = 100,
    key: PRNGKeyArray | None = None,
    max_orders: int | None = None,
    n_photons: int = 65536,
    n_rays: int | None = None,
) -> Design:
    """Find the wavelengths, pulse and energies of a lidar that determine unknowns of scenes best.

    The cost of the Cramer-Rao bounds, its mean over the scenes, is minimised by its gradient. Light is
    traced once for each scene, so that a step takes milliseconds.

    **Arguments:**

    - `lidar`: the instrument; its values are the first start.
    - `scenes`: a `Scene`, or several of one structure, at whose values the bounds are taken.
    - `unknowns`: as for `cramer_rao`, the same for all scenes; priors count.
    - `free`: paths of the lidar's arrays that are free: "wavelength", "energy", "efficiency", "jitter", and
      values of the pulse such as "pulse.fwhm". Default ("wavelength", "pulse.fwhm").
    - `limits`: (low, high) by path, numbers or arrays that broadcast to the value. Default None, or where a
      path is missing: 400 to 2500 nm for wavelengths, a factor of 4 about the lidar's value for others.
    - `cost`: a function of a `CramerRao` of JAX arrays, to a positive scalar, differentiable, such as
      `lambda bound: bound.stderr["Cab"] ** 2`. Default None: the sum over unknowns of the squared standard
      error over the width of the bounds.
    - `noise`: standard deviation of the apparent reflectance, above 0, anything that broadcasts to
      (wavelengths, bins); or a differentiable function `noise(lidar, reflectance)` of the candidate and its
      waveform, such as that of a receiver whose noise falls with the energy. Default None: 1 % of the
      largest sample by `lidar` of each scene.
    - `starts`: starting points: the first is `lidar`, others are drawn evenly within the limits. Default 4.
    - `max_steps`: steps of the optimiser from each start. Default 100.
    - `key`: a JAX random key, for photons and starts. Default None: `jax.random.key(0)`; all designs are
      compared with the same random numbers.
    - `max_orders`, `n_rays`: of the simulation of each scene, as for `plan`. Default None.
    - `n_photons`: photons of all batches of a scene together. Default 65536.

    **Returns:** a `Design`.

    **Raises:** ValueError for inadmissible arguments, among them paths that are no array of the lidar or act
    on the paths of light, scenes of different structure, and leaves that transmit straight on with free
    wavelengths. TypeError for arguments of another kind.

    **Example:** the wavelength that tells chlorophyll best lies at an edge of its absorption.

    >>> import jaxlidar as jl
    >>> import inversion
    >>> import numpy as np
    >>> voxels = jl.VoxelMap.from_lad(np.full((1, 1, 4), 0.5), voxel_size=1.0)
    >>> canopy = jl.Canopy(voxels, leaf=jl.Prospect(Cab=40.0), sides="periodic")
    >>> scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.2))
    >>> Cab = inversion.Unknown("canopy.leaf.Cab", bounds=(5.0, 100.0), name="Cab")
    >>> options = {"free": ("wavelength",), "max_orders": 1, "n_rays": 8}
    >>> best = inversion.design(jl.Lidar(wavelength=680.0), scene, [Cab], **options)
    >>> print(500 < best.values["wavelength"][0] < 760, best.cost < 0.5 * best.initial_cost)
    True True
    """
    scenes = [scenes] if isinstance(scenes, Scene) else list(_checked_scenes(scenes))
    for scene in scenes:
        check_kinds(lidar, scene)
    key = jax.random.key(0) if key is None else key
    check_key(key)
    starts, max_steps = check_integer("starts", starts), check_integer("max_steps", max_steps)
    if not (cost is None or callable(cost)):
        raise TypeError(f"cost = {cost!r} is no function; admissible is one of a CramerRao")
    lidar = with_fixed_window(lidar)
    free_values = _free_values(lidar, free, {} if limits is None else dict(limits))
    bound_unknowns = [bind_unknowns(unknowns, scene) for scene in scenes]
    if "wavelength" in free_values.paths:
        _check_wavelengths_act_late(scenes)
    plan = _plan(lidar, scenes, free_values, max_orders, n_photons, n_rays)
    photon_key, start_key = jax.random.split(key)
    traced_scenes = [
        _trace(lidar, scene, plan, bound, photon_key) for scene, bound in zip(scenes, bound_unknowns)
    ]
    noises = [noise if callable(noise) else _noise_array(noise, traced, plan) for traced in traced_scenes]
    names = tuple(unknown.name for unknown in bound_unknowns[0])
    shapes = tuple(unknown.start.shape for unknown in bound_unknowns[0])
    labels = flat_labels(bound_unknowns[0])
    cost_of_bound = _relative_variance(traced_scenes[0].width) if cost is None else cost

    @eqx.filter_jit
    def bound_of(flat: Array, traced: _TracedScene, scene_noise: Any) -> CramerRao:
        return _cramer_rao(free_values.lidar_with(lidar, flat), traced, scene_noise, names, shapes, labels)

    @eqx.filter_jit
    def cost_and_slopes(fraction: Array, traced: _TracedScene, scene_noise: Any) -> tuple[Array, Array]:
        def of_fraction(fraction: Array) -> Array:
            low, high = jnp.asarray(free_values.low), jnp.asarray(free_values.high)
            value = cost_of_bound(bound_of(low + fraction * (high - low), traced, scene_noise))
            return jnp.asarray(value).reshape(())

        return jax.value_and_grad(of_fraction)(fraction)

    def log_mean_cost(fraction: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the logarithm of the mean cost over scenes, and its gradient by fractions of the limits."""
        terms = [cost_and_slopes(jnp.asarray(fraction), *pair) for pair in zip(traced_scenes, noises)]
        mean = float(np.mean([float(value) for value, _ in terms]))
        slopes = np.mean([np.asarray(slope, float) for _, slope in terms], axis=0)
        # The bounds are infinite where an unknown leaves no trace in the record. The line search of the
        # optimiser steps back from a large number, but not from infinity.
        if not (np.isfinite(mean) and mean > 0 and np.all(np.isfinite(slopes))):
            return _REJECTED_COST, np.zeros_like(fraction)
        # Variances span orders of magnitude over the limits: their logarithm has even steps.
        return float(np.log(mean)), slopes / mean

    width = free_values.high - free_values.low
    leaves = jax.tree.leaves(lidar)
    start = np.concatenate([np.ravel(np.asarray(leaves[index], float)) for index in free_values.indices])
    first = (start - free_values.low) / width
    initial_log_cost = log_mean_cost(first)[0]
    drawn = np.asarray(jax.random.uniform(start_key, (starts - 1, first.size)), float)
    # The cost has minima at each absorption band: one start would end in the next of them.
    ends = [
        optimize.minimize(
            log_mean_cost,
            start,
            jac=True,
            method="L-BFGS-B",
            bounds=[(0.0, 1.0)] * first.size,
            options={"maxiter": max_steps},
        )
        for start in [first, *drawn]
    ]
    best: Any = min(ends, key=lambda end: end.fun)
    if best.fun >= _REJECTED_COST:
        raise ValueError("the cost is not a finite positive number at any start; see cost and unknowns")
    flat = free_values.low + np.clip(best.x, 0.0, 1.0) * width
    best_lidar = free_values.lidar_with(lidar, jnp.asarray(flat))
    return Design(
        lidar=best_lidar,
        values={
            path: np.asarray(jax.tree.leaves(best_lidar)[index], float)
            for path, index in zip(free_values.paths, free_values.indices)
        },
        cost=float(np.exp(best.fun)),
        initial_cost=float(np.exp(initial_log_cost)) if initial_log_cost < _REJECTED_COST else float("inf"),
        bounds=tuple(bound_of(jnp.asarray(flat), *pair) for pair in zip(traced_scenes, noises)),
        costs=np.exp([end.fun for end in ends]) if best.fun < _REJECTED_COST else np.full(starts, np.inf),
        converged=bool(best.success),
    )


def _checked_scenes(scenes: Any) -> Sequence[Scene]:
    check_kind("scenes", scenes, Sequence, "a Scene, or a sequence of Scene")
    if len(scenes) == 0:
        raise ValueError("scenes is empty; admissible is one scene or more")
    for i, scene in enumerate(scenes):
        check_kind(f"scenes[{i}]", scene, Scene, "a Scene")
    return scenes


def _free_values(lidar: Lidar, free: Any, limits: dict[str, Any]) -> FreeValues:
    """Locate the free values in the lidar. **Raises:** ValueError for a path that cannot be free."""
    check_kind("free", free, Sequence, "a sequence of paths")
    if isinstance(free, str) or len(free) == 0 or len(set(free)) < len(free):
        raise ValueError(f"free = {free!r} is no sequence of one path or more, each of them once")
    leaves = jax.tree_util.tree_leaves_with_path(lidar)
    paths = [jax.tree_util.keystr(path).lstrip(".") for path, _ in leaves]
    admissible = [path for path in paths if path.split(".")[0] in _ADMISSIBLE_FIELDS]
    indices, shapes, lows, highs = [], [], [], []
    for path in free:
        if path not in admissible:
            raise ValueError(f"free = {path!r}; admissible are {', '.join(map(repr, admissible))}")
        index = paths.index(path)
        value = np.asarray(leaves[index][1], float)
        default = (value / _DEFAULT_FACTOR, value * _DEFAULT_FACTOR)
        low, high = limits.pop(path, _WAVELENGTHS if path == "wavelength" else default)
        low, high = (np.broadcast_to(as_numpy(end, f"limits of {path}"), value.shape) for end in (low, high))
        if not (np.all(np.isfinite(low)) and np.all(np.isfinite(high)) and np.all(low < high)):
            raise ValueError(f"limits of {path} = ({low.tolist()}, {high.tolist()}) are not low < high")
        check_range(f"{path} of lidar, in its limits,", (value - low) / (high - low), 0.0, 1.0)
        indices.append(index)
        shapes.append(value.shape)
        lows.append(low.ravel())
        highs.append(high.ravel())
    if limits:
        raise ValueError(f"limits has {', '.join(map(repr, limits))}, which free does not have")
    return FreeValues(tuple(free), tuple(indices), tuple(shapes), np.concatenate(lows), np.concatenate(highs))


def _check_wavelengths_act_late(scenes: Sequence[Scene]) -> None:
    """Refuse scenes whose trace depends on wavelength. **Raises:** ValueError."""
    for scene in scenes:
        if scene.canopy is not None and scene.canopy.transmission == "straight":
            raise ValueError(
                'transmission = "straight" makes extinction depend on the wavelength; admissible with a free '
                'wavelength is "diffuse"'
            )


def _plan(
    lidar: Lidar,
    scenes: Sequence[Scene],
    free_values: FreeValues,
    max_orders: int | None,
    n_photons: int,
    n_rays: int | None,
) -> Plan:
    """Plan for all scenes and for the shortest and the longest pulse within the limits.

    Fine bins are those of the shortest pulse; the window and the pulse's support are those of the longest.
    """
    lowest, highest = (free_values.lidar_with(lidar, jnp.asarray(end)) for end in free_values[3:])
    options = {
        "n_photons": -(-check_integer("n_photons", n_photons, N_BATCHES) // N_BATCHES),
        "n_rays": n_rays,
        "histories": True,
    }
    # Two wavelengths that start from one limit are equal: those of the lidar itself serve here.
    lowest, highest = (dataclasses.replace(end, wavelength=lidar.wavelength) for end in (lowest, highest))
    trials = [plan_scenes(end, scenes, max_orders=max_orders, **options) for end in (lowest, highest)]
    start = min(trial.sample_start for trial in trials)
    end = max(trial.sample_start + trial.sample_interval * (trial.n_samples - 1) for trial in trials)
    common = {"window": (start, end + 1e-3 * trials[0].sample_interval), **options}
    common["max_orders"] = max(trial.orders for trial in trials)
    plans = [plan_scenes(trial_lidar, scenes, **common) for trial_lidar in (lowest, highest)]
    finest = min(plans, key=lambda candidate: candidate.bins.width)
    supports = [candidate.pulse_support for candidate in plans]
    support = (min(low for low, _ in supports), max(high for _, high in supports))
    return dataclasses.replace(finest, pulse_support=support)


def _trace(
    lidar: Lidar, scene: Scene, plan: Plan, unknowns: list[BoundUnknown], key: PRNGKeyArray
) -> _TracedScene:
    """Trace one scene, with derivatives of its response by the unknowns that change it."""
    # Scores do not serve here: they give derivatives of the waveform of one lidar, not of the response.
    setters = tuple(
        u.setter._replace(dependence="geometric") if u.setter.changes_response else u.setter for u in unknowns
    )
    inputs = SimulationInputs(lidar, scene, plan, setters, tangents_per_pass=1)
    values = tuple(u.start for u in unknowns)
    keys = jax.random.split(key, N_BATCHES if plan.is_random else 1)
    response, slopes = _response_and_slopes(inputs, values, keys)
    priors, start = fixed_priors(unknowns), flat_start(unknowns)
    low, high = flat_bounds(unknowns)
    width = high - low
    return _TracedScene(
        inputs,
        values,
        response,
        slopes,
        jnp.asarray(width),
        jnp.asarray(priors(start)[1] * width),
    )


@eqx.filter_jit
def _response_and_slopes(inputs: SimulationInputs, values: Values, keys: Array) -> tuple[Response, Response]:
    """Return the mean response of all batches, and its derivatives by all flattened unknowns."""
    flat, restore = jax.flatten_util.ravel_pytree(values)
    changes = np.concatenate(
        [np.full(v.size, s.changes_response) for v, s in zip(values, inputs.setters)]
    ).astype(float)

    def response_of(flat: Array) -> Response:
        setup = inputs.setup(restore(flat))
        responses = jax.lax.map(lambda batch_key: trace_scene(setup, batch_key, reverse=False), keys)
        return jax.tree.map(lambda a: jnp.mean(a, axis=0), responses)

    def slope(direction: Array) -> Response:
        return jax.jvp(response_of, (flat,), (direction,))[1]

    # One column after the other: the tangents of a response, with all histories, are large.
    directions = jnp.diag(jnp.asarray(changes, flat.dtype))
    return response_of(flat), jax.lax.map(slope, directions)


def _noise_array(noise: Any, traced: _TracedScene, plan: Plan) -> Float[Array, "wavelengths bins"]:
    """Return the noise of each sample. **Raises:** ValueError for noise that is not above 0."""
    lidar = traced.inputs.lidar
    if noise is None:
        setup = traced.inputs.setup(traced.values)
        reflectance = eqx.filter_jit(total_reflectance)(traced.response, setup)
        noise = _NOISE_FRACTION * float(jnp.max(reflectance))
    sigma = as_numpy(noise, "noise")
    shape = (lidar.wavelength.size, plan.n_samples)
    try:
        sigma = np.broadcast_to(sigma, shape)
    except ValueError:
        raise ValueError(f"noise has the shape {sigma.shape}, which does not broadcast to {shape}") from None
    if not np.all(sigma > 0):
        raise ValueError(f"noise = {np.min(sigma):g} is outside the admissible range (0, inf]")
    return jnp.asarray(sigma)


def _relative_variance(width: Float[Array, " n"]) -> Cost:
    """Return the default cost: the sum of squared standard errors over the widths of the bounds."""

    def cost(bound: CramerRao) -> Array:
        return jnp.sum(jnp.diag(bound.covariance) / width**2)

    return cost


def _cramer_rao(
    lidar: Lidar,
    traced: _TracedScene,
    noise: Any,
    names: tuple[str, ...],
    shapes: tuple[tuple[int, ...], ...],
    labels: tuple[str, ...],
) -> CramerRao:
    """Return the bound of one scene for a lidar, differentiable with respect to the lidar.

    1. Waveform and Jacobian: one tangent for each unknown, of response and optics together.
    2. Rows of the whitened Jacobian, of the priors, and of a least precision, in widths of the bounds.
    3. R of their QR decomposition: R^T R is the information, R^-1 R^-T the bound.
    """
    inputs = dataclasses.replace(traced.inputs, lidar=lidar)
    flat, restore = jax.flatten_util.ravel_pytree(traced.values)

    def waveform(response: Response, flat: Array) -> Array:
        return total_reflectance(response, inputs.setup(restore(flat)))

    def column(slope: Response, direction: Array) -> tuple[Array, Array]:
        return jax.jvp(waveform, (traced.response, flat), (slope, direction))

    push = jax.vmap(column, out_axes=(None, 0))
    reflectance, columns = push(traced.slopes, jnp.eye(flat.size, dtype=flat.dtype))
    sigma = noise(lidar, reflectance) if callable(noise) else noise
    whitened = columns / jnp.broadcast_to(jnp.asarray(sigma), reflectance.shape)[None]
    rows = whitened.reshape(flat.size, -1).T * traced.width[None]
    least = np.sqrt(_LEAST_PRECISION) * jnp.eye(flat.size, dtype=flat.dtype)
    triangle = jnp.linalg.qr(jnp.concatenate([rows, traced.prior_rows, least]), mode="r")
    inverse = jax.scipy.linalg.solve_triangular(triangle, jnp.eye(flat.size, dtype=flat.dtype))
    # From widths of the bounds to natural units.
    scaled_inverse = inverse * traced.width[:, None]
    covariance = scaled_inverse @ scaled_inverse.T
    scaled_triangle = triangle / traced.width[None]
    std = jnp.sqrt(jnp.diag(covariance))
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    pieces = [std[end - int(np.prod(shape)) : end].reshape(shape) for end, shape in zip(ends, shapes)]
    return CramerRao(
        stderr=dict(zip(names, pieces)),
        covariance=covariance,
        correlation=covariance / (std[:, None] * std[None]),
        information=scaled_triangle.T @ scaled_triangle,
        labels=labels,
        undetermined=(),
    )
