r"""Design of an instrument: the wavelengths, pulse, energies, divergence and sampling of least error.

For a lidar d and the unknowns x of a scene, J(d) = dw / dx are the derivatives of its waveform, sigma(d) the
noise and P the precision of the priors. The Cramer-Rao bound is the inverse of

    I(d) = J(d)^T diag(1 / sigma(d)^2) J(d) + P.

A cost of the bound, such as the sum of the relative variances (A-optimality), is minimised over d by its
gradient, which holds mixed second derivatives of the waveform by unknowns and design.

Without a free divergence, light is traced once for each scene. The response R and its derivatives by the
unknowns do not depend on what acts after the trace: wavelengths, pulse, energies, jitter and sampling. So for
every design,

    J(d) = dw / dR . dR / dx + dw / dx at constant R,   w = w(R, x, d),

is a small matrix product, by forward mode; JAX differentiates it by d in reverse mode. The divergence changes
R: it is traced at several divergences, and interpolated between them (`inversion.fit.design_trace`).

**Sampling.** The samples of a record follow one another without gaps: each is the energy of its interval.
The number of samples is fixed, by the shortest interval within the limits, so that the record is a
differentiable function of the interval. Samples after the last light hold no information: the bound is that
of a record of any length that contains all light.

The bound is computed by the QR decomposition of the whitened Jacobian: squared, its condition number would
exceed single precision. The optimiser is L-BFGS-B (Byrd et al. 1995, SIAM J. Sci. Comput. 16, 1190) of the
logarithm of the cost, from several starts.

**Source:** optimality criteria: Pukelsheim (2006), Optimal Design of Experiments, chapter 6.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
import scipy
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray

from inversion.fit.data import as_positive_noise, with_fixed_window
from inversion.fit.design_trace import DivergenceNodes, TracedScene, refine_nodes, trace_for_design
from inversion.fit.identifiability import CramerRao
from inversion.fit.planning import N_BATCHES
from inversion.fit.unknowns import (
    Setter,
    Unknown,
    bind_unknowns,
    flat_labels,
    locate_lidar_array,
    set_lidar_values,
    split_values,
)
from jaxlidar import Lidar, Plan, Scene
from jaxlidar.extend import (
    Program,
    as_numpy,
    check_integer,
    check_key,
    check_kind,
    check_kinds,
    check_range,
    warn_user,
)
from jaxlidar.planning.effects import effects_of_family
from jaxlidar.planning.scene_family import check_scenes, plan_cases
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.trace.response import Response

# Fields of a lidar that can be free: those that act after the trace, of which `inversion.fit.unknowns` names
# those that records determine, and the divergence, which is interpolated.
_ADMISSIBLE_FIELDS = (
    "wavelength",
    "pulse",
    "energy",
    "efficiency",
    "jitter",
    "sampling_interval",
    "divergence",
)
# Fields whose limits must be above zero.
_POSITIVE_FIELDS = ("sampling_interval", "divergence")
# Bounds of wavelengths, nm: those of the leaf models. Other values may change by this factor.
_WAVELENGTHS, _DEFAULT_FACTOR = (400.0, 2500.0), 4.0
# Default noise, as a fraction of the largest sample.
_NOISE_FRACTION = 0.01
# Precision that all unknowns have, in widths of their bounds, so that bounds of undetermined ones are finite.
_LEAST_PRECISION = 1e-6
# Divergences of the first traces, and the most.
_FIRST_NODES, _MAX_NODES = 9, 33
# Divergences are added until the interpolated cost has this relative error: over all limits, where the minima
# have to be told apart, and within the factor `_NEAR_BEST` of the best divergence.
_COARSE_TOLERANCE, _FINE_TOLERANCE, _NEAR_BEST = 0.1, 0.01, 1.5
# Errors count only where the cost is below this multiple of the lowest one.
_NEAR_LOWEST = 4.0
# Cost of a design that is not finite, such as one of two equal wavelengths; of its logarithm.
_REJECTED_COST = 1e6
# The optimiser ends where a step lowers the logarithm of the cost by less than this many roundings,
# relative to it, or by less than the second number.
_ROUNDINGS, _FINEST_TOLERANCE = 4.0, 2e-9

# Traces all scenes of a design by a lidar: at its own divergence (None), or at those of nodes.
Tracer = Callable[[Lidar, DivergenceNodes | None], list[TracedScene]]
Noise = ArrayLike | Callable[[Lidar, Array], Array] | None
Cost = Callable[[CramerRao], Array]


@final
class Design(eqx.Module):
    """The result of `design`: the lidar whose Cramer-Rao bounds cost least.

    - `lidar`: the best lidar.
    - `values`: its free values, by path, in their own units.
    - `cost`, `initial_cost`: of this lidar, and of the one that was given.
    - `bounds`: a `CramerRao` of each scene, by this lidar.
    - `costs`: (starts,) cost at the minimum that each start has reached. With a free divergence these are
      interpolated, before the search is refined about the best of them.
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
    """Free values of a lidar: paths, setters and shapes, and bounds as flat vectors."""

    paths: tuple[str, ...]
    setters: tuple[Setter, ...]
    shapes: tuple[tuple[int, ...], ...]
    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]

    def of(self, lidar: Lidar) -> list[Array | np.ndarray]:
        """Return the free values of a lidar."""
        return [
            locate_lidar_array(path, lidar, _ADMISSIBLE_FIELDS, argument="free")[1] for path in self.paths
        ]

    def flat_of(self, lidar: Lidar) -> Float[np.ndarray, " n"]:
        """Return the free values of a lidar as one vector."""
        return np.concatenate([np.ravel(np.asarray(value, float)) for value in self.of(lidar)])

    def fraction_of(self, flat: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return values as fractions of the way from their lower to their upper bounds."""
        return (flat - self.low) / (self.high - self.low)

    def at_fraction(self, fraction: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return the values at these fractions of the way from their lower to their upper bounds."""
        return self.low + fraction * (self.high - self.low)

    def lidar_with(self, lidar: Lidar, flat: Array) -> Lidar:
        """Return the lidar with these values; wavelengths are put in order."""
        # Which wavelength is the first does not matter: the noise is that of the record.
        values = tuple(
            jnp.sort(value) if path == "wavelength" else value
            for path, value in zip(self.paths, split_values(flat, self.shapes))
        )
        return set_lidar_values(lidar, self.setters, values)

    def is_value_of(self, path: str) -> Bool[np.ndarray, " n"]:
        """Return True for the elements of the flat vectors that are values of a path."""
        sizes = [int(np.prod(shape)) for shape in self.shapes]
        return np.repeat(np.array(self.paths) == path, sizes)


@final
class _DesignProblem(eqx.Module):
    """The cost of a lidar as a function of its free values, and its minimisation.

    Methods take the traced scenes, since these are other ones once divergences are traced between closer
    limits. Free values are a flat vector in their own units, or, for the optimiser, fractions of the way from
    their lower to their upper bounds.

    - `lidar`: with the values that are not free.
    - `free_values`: their places in the lidar and their bounds.
    - `noises`: of each scene, an array or a function, as of `design`.
    - `names`, `shapes`, `labels`: of the unknowns. - `cost_of_bound`: as the argument `cost` of `design`.
    """

    lidar: Lidar
    free_values: FreeValues
    noises: list[Any]
    names: tuple[str, ...] = eqx.field(static=True)
    shapes: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)
    cost_of_bound: Cost | None

    def bound(self, flat: Array, traced: TracedScene, noise: Any) -> CramerRao:
        """Return the bound of one scene."""
        lidar = self.free_values.lidar_with(self.lidar, flat)
        return _cramer_rao(lidar, traced, noise, self.names, self.shapes, self.labels)

    def scene_cost(self, flat: Array, traced: TracedScene, noise: Any) -> Array:
        """Return the cost of one scene."""
        bound = self.bound(flat, traced, noise)
        if self.cost_of_bound is None:
            return jnp.sum(jnp.diag(bound.covariance) / traced.width**2)
        return jnp.asarray(self.cost_of_bound(bound)).reshape(())

    def bounds(self, flat: np.ndarray, traced_scenes: list[TracedScene]) -> tuple[CramerRao, ...]:
        """Return the bounds of all scenes."""
        pairs = zip(traced_scenes, self.noises)
        return tuple(_bound(self, jnp.asarray(flat), *pair) for pair in pairs)

    def mean_cost(self, flat: np.ndarray, traced_scenes: list[TracedScene]) -> float:
        """Return the mean cost over scenes."""
        pairs = zip(traced_scenes, self.noises)
        return float(np.mean([float(_scene_cost(self, jnp.asarray(flat), *pair)) for pair in pairs]))

    def log_mean_cost(
        self, fraction: np.ndarray, cost_and_slopes: Sequence[Callable]
    ) -> tuple[float, np.ndarray]:
        """Return the logarithm of the mean cost over scenes, and its gradient by fractions.

        `cost_and_slopes`: of each scene, a function of the fractions.
        """
        terms = [function(fraction=jnp.asarray(fraction)) for function in cost_and_slopes]
        mean = float(np.mean([float(value) for value, _ in terms]))
        slopes = np.mean([np.asarray(slope, float) for _, slope in terms], axis=0)
        # The bounds are infinite where an unknown leaves no trace in the record. The line search of the
        # optimiser steps back from a large number, but not from infinity.
        if not (np.isfinite(mean) and mean > 0 and np.all(np.isfinite(slopes))):
            return _REJECTED_COST, np.zeros_like(fraction)
        # Variances span orders of magnitude over the limits: their logarithm has even steps.
        return float(np.log(mean)), slopes / mean

    def minimise(
        self,
        fraction: np.ndarray,
        traced_scenes: list[TracedScene],
        lower: np.ndarray,
        upper: np.ndarray,
        max_steps: int,
    ) -> Any:
        """Minimise the logarithm of the mean cost from a start, between fractions of the limits."""
        pairs = zip(traced_scenes, self.noises)
        cost_and_slopes = [
            _cost_and_slopes.bind(problem=self, traced=traced, noise=noise) for traced, noise in pairs
        ]
        # The cost is as precise as JAX's default float: steps below its rounding are noise, in which the line
        # search fails. In double precision it is the optimiser's own tolerance.
        tolerance = max(_ROUNDINGS * float(jnp.finfo(jnp.result_type(float)).eps), _FINEST_TOLERANCE)
        return scipy.optimize.minimize(
            self.log_mean_cost,
            fraction,
            args=(cost_and_slopes,),
            jac=True,
            method="L-BFGS-B",
            bounds=np.stack([lower, upper], axis=1),
            options={"maxiter": max_steps, "ftol": tolerance},
        )

    def limits_near(
        self, flat: np.ndarray, lower: np.ndarray, upper: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return fractions as limits, those of the divergence within `_NEAR_BEST` of its value."""
        near_low, near_high = (
            np.clip(self.free_values.fraction_of(flat * factor), 0.0, 1.0)
            for factor in (1.0 / _NEAR_BEST, _NEAR_BEST)
        )
        is_divergence = self.free_values.is_value_of("divergence")
        return np.where(is_divergence, near_low, lower), np.where(is_divergence, near_high, upper)

    def trace_divergences(
        self, trace: Tracer, lower: np.ndarray, upper: np.ndarray, flat: np.ndarray, tolerance: float
    ) -> list[TracedScene]:
        """Trace divergences between fractions of the limits, until the cost is known between them.

        The error is that at each new node, of the interpolation between those before.

        `flat`: values of all free variables; that of the divergence is not used.

        **Warns:** UserWarning where the tolerance is not met with `_MAX_NODES` divergences.
        """
        is_divergence = self.free_values.is_value_of("divergence")
        low, high = (self.free_values.at_fraction(end)[is_divergence] for end in (lower, upper))
        nodes: Any = DivergenceNodes(float(low[0]), float(high[0]), _FIRST_NODES)
        traced_scenes = trace(self.lidar, nodes)
        while True:
            refined_scenes = [refine_nodes(traced) for traced in traced_scenes]
            nodes = refined_scenes[0].nodes
            candidates = [np.where(is_divergence, new, flat) for new in nodes.divergences[1::2]]
            interpolated, exact = (
                np.array([self.mean_cost(candidate, scenes) for candidate in candidates])
                for scenes in (traced_scenes, refined_scenes)
            )
            error, traced_scenes = _interpolation_error(interpolated, exact), refined_scenes
            if error < tolerance:
                return traced_scenes
            if nodes.count >= _MAX_NODES:
                warn_user(
                    f"the cost between the {nodes.count} divergences that were traced is known to "
                    f"{error:.1%} only: the divergence found may not be the best; narrower limits, or more "
                    "rays or photons, help"
                )
                return traced_scenes


_bound, _scene_cost = Program(_DesignProblem.bound), Program(_DesignProblem.scene_cost)


@Program
def _cost_and_slopes(
    problem: _DesignProblem, traced: TracedScene, noise: Any, fraction: Array
) -> tuple[Array, Array]:
    """Return the cost of one scene, and its gradient by fractions."""
    low, high = jnp.asarray(problem.free_values.low), jnp.asarray(problem.free_values.high)
    return jax.value_and_grad(lambda x: problem.scene_cost(low + x * (high - low), traced, noise))(fraction)


def _interpolation_error(
    interpolated: Float[np.ndarray, " nodes"], exact: Float[np.ndarray, " nodes"]
) -> float:
    """Return the largest relative error of interpolated costs.

    It counts where the cost is not far above the lowest one: elsewhere, divergences that tell little have
    large relative errors.
    """
    # Not finite where no record determines an unknown: no design has such a divergence.
    lowest = np.fmin(interpolated, exact)
    is_near = lowest < _NEAR_LOWEST * np.min(exact[np.isfinite(exact)], initial=np.inf)
    errors = np.abs(interpolated[is_near] / exact[is_near] - 1.0)
    errors = np.where(np.isfinite(errors), errors, np.inf)
    return float(np.max(errors, initial=0.0))


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
    """Find the wavelengths, pulse, energies, divergence and sampling of a lidar that determine unknowns best.

    The cost of the Cramer-Rao bounds, its mean over the scenes, is minimised by its gradient. Light is
    traced once for each scene, so that a step takes milliseconds. With a free divergence it is traced at
    17 to 33 divergences within the limits, and again near the best one, until the cost between them is known
    to 1 %.

    The positions and the number of shots cannot be free. To choose them, compare a list: records of separate
    shots add to the information, `CramerRao.information`, of `cramer_rao` with a lidar at each position.

    **Arguments:**

    - `lidar`: the instrument; its values are the first start.
    - `scenes`: a `Scene`, or several of one structure, at whose values the bounds are taken.
    - `unknowns`: as for `cramer_rao`, the same for all scenes; priors count.
    - `free`: paths of the lidar's arrays that are free: "wavelength", "energy", "efficiency", "jitter",
      "divergence", "sampling_interval", and values of the pulse such as "pulse.fwhm". Default ("wavelength",
      "pulse.fwhm").
    - `limits`: (low, high) by path, numbers or arrays that broadcast to the value; above 0 for divergence and
      sampling interval. Default None, or where a path is missing: 400 to 2500 nm for wavelengths, a factor of
      4 about the lidar's value for others.
    - `cost`: a function of a `CramerRao` of JAX arrays, to a positive scalar, differentiable, such as
      `lambda bound: bound.stderr["Cab"] ** 2`. Default None: the sum over unknowns of the squared standard
      error over the width of the bounds.
    - `noise`: standard deviation of the apparent reflectance of a sample, above 0, which broadcasts to
      (wavelengths, bins); or a differentiable function `noise(lidar, reflectance)` of the candidate and its
      waveform, such as that of a receiver whose noise falls with the energy. With a free sampling interval,
      it is a number, one by wavelength (wavelengths, 1), or a function; a number holds for samples of any
      length, as the electronic noise of a `Receiver` does. Default None: 1 % of the largest sample by `lidar`
      of each scene; with a free sampling interval, times the root of the interval over that of `lidar`, as
      white noise collected over a sample has.
    - `starts`: starting points: the first is `lidar`, others are drawn evenly within the limits. Default 4.
    - `max_steps`: steps of the optimiser from each start. Default 100.
    - `key`: a JAX random key, for photons and starts. Default None: `jax.random.key(0)`; all designs are
      compared with the same random numbers.
    - `max_orders`, `n_rays`, `n_photons`: of the simulation of each scene, as for `plan`.

    **Returns:** a `Design`.

    Echoes that fall within one sample or astride two differ in what they tell. With long samples, give scenes
    of several heights, so that the design does not depend on it.

    **Raises:** ValueError for inadmissible arguments, among them paths that are no array of the lidar or that
    cannot be free, scenes of different structure, and leaves that transmit straight on with free wavelengths.
    TypeError for arguments of another kind.

    **Warns:** `UserWarning` where the cost depends on the divergence in more detail than it was traced.

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
    scenes = (
        [scenes] if isinstance(scenes, Scene) else check_scenes(scenes, "a Scene, or a sequence of Scene")
    )
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
    n_samples = _number_of_samples(plan, free_values)

    def trace(lidar: Lidar, nodes: DivergenceNodes | None) -> list[TracedScene]:
        # The same random numbers for every lidar.
        options: dict[str, Any] = {"n_samples": n_samples, "nodes": nodes}
        return [
            trace_for_design(lidar, scene, plan, unknowns, photon_key, **options)
            for scene, unknowns in zip(scenes, bound_unknowns)
        ]

    traced_scenes = trace(lidar, None)
    problem = _DesignProblem(
        lidar,
        free_values,
        noises=[noise if callable(noise) else _noise_of_samples(noise, t, plan) for t in traced_scenes],
        names=tuple(unknown.name for unknown in bound_unknowns[0]),
        shapes=tuple(unknown.start.shape for unknown in bound_unknowns[0]),
        labels=flat_labels(bound_unknowns[0]),
        cost_of_bound=cost,
    )
    start = free_values.flat_of(lidar)
    initial_cost = problem.mean_cost(start, traced_scenes)

    lower, upper = np.zeros_like(start), np.ones_like(start)
    varies_divergence = "divergence" in free_values.paths
    if varies_divergence:
        traced_scenes = problem.trace_divergences(trace, lower, upper, start, _COARSE_TOLERANCE)
    drawn = np.asarray(jax.random.uniform(start_key, (starts - 1, start.size)), float)
    # The cost has minima at each absorption band: one start would end in the next of them.
    ends = [
        problem.minimise(fraction, traced_scenes, lower, upper, max_steps)
        for fraction in [free_values.fraction_of(start), *drawn]
    ]
    costs = np.exp([end.fun for end in ends])
    best: Any = min(ends, key=lambda end: end.fun)
    if best.fun >= _REJECTED_COST:
        raise ValueError("the cost is not a finite positive number at any start; see cost and unknowns")
    if varies_divergence:
        # Once more from the best, between divergences near it: there the interpolation is accurate.
        flat = free_values.at_fraction(best.x)
        lower, upper = problem.limits_near(flat, lower, upper)
        traced_scenes = problem.trace_divergences(trace, lower, upper, flat, _FINE_TOLERANCE)
        best = problem.minimise(best.x, traced_scenes, lower, upper, max_steps)
    flat = free_values.at_fraction(np.clip(best.x, 0.0, 1.0))
    best_lidar, best_cost = free_values.lidar_with(lidar, jnp.asarray(flat)), float(np.exp(best.fun))
    if varies_divergence:
        # Traced at the divergence that was found: without the error of the interpolation.
        traced_scenes = trace(best_lidar, None)
        best_cost = problem.mean_cost(flat, traced_scenes)
    best_values = [np.asarray(value, float) for value in free_values.of(best_lidar)]
    return Design(
        lidar=best_lidar,
        values=dict(zip(free_values.paths, best_values)),
        cost=best_cost,
        initial_cost=initial_cost if np.isfinite(initial_cost) else float("inf"),
        bounds=problem.bounds(flat, traced_scenes),
        costs=costs,
        converged=bool(best.success),
    )


def _free_values(lidar: Lidar, free: Any, limits: dict[str, Any]) -> FreeValues:
    """Locate the free values in the lidar. **Raises:** ValueError for a path that cannot be free."""
    check_kind("free", free, Sequence, "a sequence of paths")
    if isinstance(free, str) or len(free) == 0 or len(set(free)) < len(free):
        raise ValueError(f"free = {free!r} is no sequence of one path or more, each of them once")
    setters, shapes, lows, highs = [], [], [], []
    for path in free:
        index, array = locate_lidar_array(path, lidar, _ADMISSIBLE_FIELDS, argument="free")
        value = np.asarray(array, float)
        default = (value / _DEFAULT_FACTOR, value * _DEFAULT_FACTOR)
        low, high = limits.pop(path, _WAVELENGTHS if path == "wavelength" else default)
        low, high = (np.broadcast_to(as_numpy(end, f"limits of {path}"), value.shape) for end in (low, high))
        if not (np.all(np.isfinite(low)) and np.all(np.isfinite(high)) and np.all(low < high)):
            raise ValueError(f"limits of {path} = ({low.tolist()}, {high.tolist()}) are not low < high")
        if path in _POSITIVE_FIELDS:
            check_range(f"lower of limits of {path}", low, 0.0, low_open=True)
        check_range(f"{path} of lidar, in its limits,", (value - low) / (high - low), 0.0, 1.0)
        setters.append(Setter(index, None, "optical", of_lidar=True))
        shapes.append(value.shape)
        lows.append(low.ravel())
        highs.append(high.ravel())
    if limits:
        raise ValueError(f"limits has {', '.join(map(repr, limits))}, which free does not have")
    return FreeValues(tuple(free), tuple(setters), tuple(shapes), np.concatenate(lows), np.concatenate(highs))


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
    """Plan for all scenes with all free values at their lower limits, and with all at their upper ones.

    Fine bins are those of the shortest pulse and samples; the window and the pulse's support are those of the
    longest pulse, and paths those of the widest beam.
    """
    options: dict[str, Any] = {
        "n_photons": check_integer("n_photons", n_photons, N_BATCHES),
        "n_rays": n_rays,
        "histories": True,
        "max_orders": max_orders,
        "effects": effects_of_family(scenes),
    }
    ends = [free_values.lidar_with(lidar, jnp.asarray(end)) for end in (free_values.low, free_values.high)]
    # Two wavelengths that start from one limit are equal: those of the lidar itself serve here. Plans that
    # are united have one sampling interval.
    fixed_fields = {"wavelength": lidar.wavelength, "sampling_interval": lidar.sampling_interval}
    cases = [(dataclasses.replace(end, **fixed_fields), scene) for end in ends for scene in scenes]
    if "sampling_interval" in free_values.paths:
        shortest = dataclasses.replace(ends[0], wavelength=lidar.wavelength)
        finest = _plan_of_limits([(shortest, scene) for scene in scenes], **options)
        options["bin_width"] = finest.bins.width
    return _plan_of_limits(cases, **options)


def _plan_of_limits(cases: list[tuple[Lidar, Scene]], **options: Any) -> Plan:
    try:
        plan = plan_cases(cases, window=None, **options)
        # A size bucket of samples, so that a change of a number compiles nothing. Samples without light
        # determine nothing.
        count = size_bucket(plan.n_samples)
        end = plan.sample_start + (count - 1 + 1e-3) * plan.sample_interval
        is_full = count == plan.n_samples
        return plan if is_full else plan_cases(cases, window=(plan.sample_start, end), **options)
    except ValueError as error:
        raise ValueError(f"at the limits a lidar or a scene is inadmissible: {error}") from error


def _number_of_samples(plan: Plan, free_values: FreeValues) -> int | None:
    """Return the number of the shortest samples within the limits that cover the plan's window.

    None if the sampling interval is not free.
    """
    is_interval = free_values.is_value_of("sampling_interval")
    if not np.any(is_interval):
        return None
    shortest = float(free_values.low[is_interval][0])
    return math.ceil((plan.n_samples - 1) * plan.sample_interval / shortest - 1e-6) + 1


def _noise_of_samples(
    noise: Any, traced: TracedScene, plan: Plan
) -> Float[Array, "wavelengths bins"] | Callable[[Lidar, Array], Array]:
    """Return the noise of each sample, or the function that gives it.

    **Raises:** ValueError for noise that is not above 0, or of a shape that does not broadcast.
    """
    lidar, is_free = traced.inputs.lidar, traced.n_samples is not None
    if noise is None:
        response, _ = traced.at(lidar.divergence)
        reflectance = _record(traced, lidar, response, traced.values)
        noise = _NOISE_FRACTION * float(jnp.max(reflectance))
        if is_free:
            return jax.tree_util.Partial(
                _white_noise, jnp.asarray(noise / math.sqrt(float(lidar.sampling_interval)))
            )
    # Samples of a free interval have no fixed place in the record.
    shape = (lidar.wavelength.size, 1 if is_free else plan.n_samples)
    return jnp.asarray(as_positive_noise(noise, shape))


_record = Program(TracedScene.record)


def _white_noise(density: Array, lidar: Lidar, reflectance: Array) -> Array:
    """Return noise that is white: its standard deviation grows with the root of the sampling interval.

    `density`: standard deviation of a sample of 1 ns.
    """
    return density * jnp.sqrt(lidar.sampling_interval) * jnp.ones_like(reflectance)


def _cramer_rao(
    lidar: Lidar,
    traced: TracedScene,
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
    flat, restore = jax.flatten_util.ravel_pytree(traced.values)
    response, slopes = traced.at(lidar.divergence)

    def waveform(response: Response, flat: Array) -> Array:
        return traced.record(lidar, response, restore(flat))

    def column(slope: Response, direction: Array) -> tuple[Array, Array]:
        return jax.jvp(waveform, (response, flat), (slope, direction))

    push = jax.vmap(column, out_axes=(None, 0))
    reflectance, columns = push(slopes, jnp.eye(flat.size, dtype=flat.dtype))
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
    return CramerRao(
        stderr=dict(zip(names, split_values(std, shapes))),
        covariance=covariance,
        correlation=covariance / (std[:, None] * std[None]),
        information=scaled_triangle.T @ scaled_triangle,
        labels=labels,
        undetermined=(),
    )
