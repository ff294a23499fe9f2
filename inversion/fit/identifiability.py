r"""Identifiability of unknowns from waveforms: Cramer-Rao bounds and profile likelihoods.

**Cramer-Rao bound.** For independent normal noise sigma, the Fisher information at x is J^T diag(1/sigma^2)
J, J = dw / dx, and no unbiased estimate has a covariance below its inverse. With priors of precision P,

    I = J^T diag(1 / sigma^2) J + P

is the Bayesian information at x. Its inverse is the posterior covariance of the linearised problem (the bound
of van Trees 1968, Detection, Estimation and Modulation Theory, averages I over the prior).

**Profile likelihood.** With one unknown fixed at v, chi-squared is minimised over the others:

    chi2(v) = minimum over the others of |C^-1/2 (w(v, others) - y)|^2 + |q(v, others)|^2.

C, the covariance of the noise, depends on the simulated waveform. Every fit is weighted by its own, and
chi-squared of all is that with C of the best one: otherwise values at which the noise is larger would seem
better. The minimum over the others with other weights is the same to first order.

The confidence interval of a level is where chi2(v) minus its minimum is below the quantile of chi-squared
with one degree of freedom (Wilks 1938, Ann. Math. Stat. 9, 60).
"""

import dataclasses
import inspect
import itertools
from collections.abc import Callable, Sequence
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.special
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from inversion.fit.data import as_noise, as_sample_times, with_fixed_window
from inversion.fit.fit_summary import CompletedFit
from inversion.fit.model import ForwardModel
from inversion.fit.planning import check_samples, checked_plan, plan_for_bounds, trace_sizes
from inversion.fit.prior_residuals import fixed_priors
from inversion.fit.retrieval import check_progress, checked_problem, fit_problem, retrieve
from inversion.fit.uncertainty import correlation_of, estimate_covariance
from inversion.fit.unknowns import (
    BoundUnknown,
    Unknown,
    bind_unknowns,
    flat_bounds,
    flat_labels,
    flat_start,
    set_lidar_values,
    set_values,
    split_by_name,
    with_start,
)
from jaxlidar import Lidar, Plan, Scene, Waveform
from jaxlidar import plan as make_plan
from jaxlidar.extend import as_numpy, check_key, check_kinds, check_range
from jaxlidar.planning.plan_check import check_reach

# Unknowns whose correlation exceeds this are named in the summary.
_HIGH_CORRELATION = 0.95


@final
class CramerRao(eqx.Module):
    """The result of `cramer_rao`: the smallest standard errors that an unbiased retrieval can have.

    Rows of the matrices are the flattened unknowns, named by `labels`, in natural units. `print(bound)` shows
    a summary, with pairs of unknowns whose correlation exceeds 0.95.

    - `stderr`: by name; infinite for unknowns that neither waveforms nor priors constrain to within their
      bounds, alone or in combination with others.
    - `covariance`: (n, n) inverse of `information`; infinite variances as in `stderr`.
    - `correlation`: (n, n).
    - `information`: (n, n) Fisher information; with priors, their precision is added (Bayesian information).
    - `labels`: names of the rows.
    - `undetermined`: labels of the unknowns with an infinite `stderr`.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> scene = jl.Scene(ground=jl.Ground())
    >>> height = inversion.Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0))
    >>> bound = inversion.cramer_rao(jl.Lidar(), scene, [height], noise=0.001, key=jax.random.key(0))
    >>> bound.labels, bound.undetermined
    (('ground.height',), ())
    """

    stderr: dict[str, Float[Array, "..."]]
    covariance: Float[Array, "n n"]
    correlation: Float[Array, "n n"]
    information: Float[Array, "n n"]
    labels: tuple[str, ...] = eqx.field(static=True)
    undetermined: tuple[str, ...] = eqx.field(static=True)

    def __str__(self) -> str:
        width = max(map(len, self.labels))
        std = np.sqrt(np.diag(np.asarray(self.covariance)))
        rows = [
            f"{label.ljust(width)}  +- {s:.3g}" if np.isfinite(s) else f"{label.ljust(width)}  not determined"
            for label, s in zip(self.labels, std)
        ]
        correlation = np.asarray(self.correlation)
        rows += [
            f"{self.labels[i]} and {self.labels[j]} are hard to separate: correlation {correlation[i, j]:.3f}"
            for i in range(len(std))
            for j in range(i)
            if abs(correlation[i, j]) > _HIGH_CORRELATION
        ]
        return "\n".join(rows)


def cramer_rao(
    lidar: Lidar,
    scene: Scene,
    unknowns: Sequence[Unknown],
    *,
    noise: ArrayLike | Sequence,
    key: PRNGKeyArray,
    time: ArrayLike | Sequence | None = None,
    plan: Plan | None = None,
    n_photons: float | None = None,
    n_rays: float | None = None,
    max_orders: int | None = None,
) -> CramerRao:
    """Cramer-Rao bounds of the unknowns of a scene: the smallest standard errors, before data are recorded.

    For independent normal noise, the Fisher information is J^T diag(1/noise^2) J, with J the derivatives of
    the waveform at the scene's values. With priors, their precision is added: the result is then the
    posterior covariance of the linearised problem, and no bound of unbiased estimates. An unknown with a
    start of its own (`Unknown(start=)`) is taken there.

    **Arguments:**

    - `lidar`, `scene`, `unknowns`, `key`, `n_photons`, `n_rays`, `max_orders`: as for `retrieve`.
    - `noise`: standard deviation of the apparent reflectance per sample, above 0, anything that broadcasts to
      (wavelengths, bins). Infinity leaves a sample out.
    - `time`: (bins,) ns, sample times. Default None: those of `plan`.
    - `plan`: what to simulate (`jaxlidar.plan`). Default None: planned for the scene, and with `time` for the
      corners of the bounds as well.

    **Returns:** a `CramerRao`.

    **Raises:** ValueError for inadmissible arguments, TypeError for arguments of another kind.

    **Source:** Kay (1993), Fundamentals of Statistical Signal Processing, chapter 3.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> scene = jl.Scene(ground=jl.Ground())
    >>> height = inversion.Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0), name="height")
    >>> bound = inversion.cramer_rao(jl.Lidar(), scene, [height], noise=0.001, key=jax.random.key(0))
    >>> print(f"{float(bound.stderr['height']):.3f} m")
    0.005 m
    """
    check_kinds(lidar, scene)
    check_key(key)
    lidar = with_fixed_window(lidar)
    sizes = trace_sizes(n_photons, n_rays, max_orders, plan)
    bound_unknowns = bind_unknowns(unknowns, scene, lidar)
    priors = fixed_priors(bound_unknowns)
    sample_times = None if time is None else as_sample_times(time, lidar)
    moves_lidar = any(u.setter.of_lidar for u in bound_unknowns)
    if plan is None and sample_times is None:
        # Derivatives are needed at the scene only: without sample times, its own plan serves.
        photons, rays, _ = sizes
        plan = make_plan(lidar, scene, max_orders=max_orders, n_photons=photons, n_rays=rays)
        if moves_lidar:
            # A plan for a beam at nadir knows no other direction, and none of its derivatives.
            plan = plan_for_bounds(lidar, scene, bound_unknowns, _sample_times(plan), sizes)
    elif plan is None:
        assert sample_times is not None
        plan = plan_for_bounds(lidar, scene, bound_unknowns, sample_times, sizes)
    elif moves_lidar:
        plan = checked_plan(plan, lidar, scene, bound_unknowns, _sample_times(plan), sizes)
    else:
        check_reach(plan, lidar, scene)
    if sample_times is not None:
        check_samples(plan, sample_times)
    sigma = as_noise(noise, (lidar.wavelength.size, plan.n_samples))
    if not np.all(sigma > 0):
        raise ValueError(f"noise = {np.min(sigma):g} is outside the admissible range (0, inf]")
    start = flat_start(bound_unknowns)
    # All batches, as noise of the Jacobian would falsify the bound.
    evaluation = ForwardModel(lidar, scene, plan, bound_unknowns, key)(start)
    jacobian = (evaluation.jacobian / sigma[..., None]).reshape(-1, start.size)
    prior_jacobian = priors(start)[1]
    precision = prior_jacobian.T @ prior_jacobian
    low, high = flat_bounds(bound_unknowns)
    # The simulation's own noise is no part of the bound.
    measurement_fraction = np.ones(len(jacobian))
    estimate = estimate_covariance(jacobian, precision, high - low, measurement_fraction, None, priors.basis)
    labels = flat_labels(bound_unknowns)
    std = np.sqrt(np.diag(estimate.covariance))
    return CramerRao(
        stderr={name: jnp.asarray(s) for name, s in split_by_name(std, bound_unknowns).items()},
        covariance=jnp.asarray(estimate.covariance),
        correlation=jnp.asarray(correlation_of(estimate.covariance)),
        information=jnp.asarray(jacobian.T @ jacobian + precision),
        labels=labels,
        undetermined=tuple(label for label, u in zip(labels, estimate.is_undetermined) if u),
    )


@final
class Profile(eqx.Module):
    """The result of `profile_likelihood`: the likelihood profile of one unknown, with the fit at each value.

    - `values`: (points,) values of the unknown.
    - `chi2`: (points,) chi-squared, priors included, less its minimum.
    - `others`: by name, (points, ...) fitted values of the other unknowns.
    - `converged`: (points,) True for fits that converged.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion
    >>> import numpy as np
    >>> chi2, converged = np.array([4.0, 0.0, 4.0, 16.0]), np.full(4, True)
    >>> profile = inversion.Profile(np.array([0.0, 0.1, 0.2, 0.3]), chi2, others={}, converged=converged)
    >>> low, high = profile.interval(0.95)
    >>> print(f"{low:.3f} to {high:.3f}")
    0.002 to 0.198
    """

    values: Float[np.ndarray, " points"]
    chi2: Float[np.ndarray, " points"]
    others: dict[str, Float[np.ndarray, "points ..."]]
    converged: Any

    def interval(self, level: float = 0.683) -> tuple[float, float]:
        """Confidence interval of the unknown: values whose chi-squared is below the quantile of `level`.

        The root of chi-squared is interpolated linearly between the values.

        **Arguments:**

        - `level`: probability, in (0, 1). Default 0.683.

        **Returns:** (low, high). An end is infinite if chi-squared stays below the quantile up to the last
        value: the waveform does not constrain the unknown to that side, within the range of the values.

        **Raises:** ValueError for a `level` outside (0, 1).
        """
        check_range("level", level, 0.0, 1.0, low_open=True, high_open=True)
        # Chi-squared of one degree of freedom is the square of a normal number: its root has a normal
        # quantile.
        z_limit = float(jax.scipy.special.ndtri(0.5 * (1.0 + level)))
        # Near its minimum chi-squared is a parabola, and its root linear in the unknown.
        root_chi2, best = np.sqrt(self.chi2), int(np.argmin(self.chi2))

        def end(points: range) -> float:
            # Outwards from the minimum to the first crossing: a second minimum further out does not count.
            for inner, outer in itertools.pairwise(points):
                if root_chi2[outer] > z_limit:
                    fraction = (z_limit - root_chi2[inner]) / (root_chi2[outer] - root_chi2[inner])
                    return float(self.values[inner] + fraction * (self.values[outer] - self.values[inner]))
            return float("inf") * (-1 if points.step < 0 else 1)

        return end(range(best, -1, -1)), end(range(best, len(root_chi2)))


def profile_likelihood(
    observed: Waveform | ArrayLike | Sequence,
    lidar: Lidar,
    scene: Scene,
    unknowns: Sequence[Unknown],
    name: str,
    values: ArrayLike | Sequence,
    *,
    noise: ArrayLike | Sequence,
    key: PRNGKeyArray,
    time: ArrayLike | Sequence | None = None,
    plan: Plan | None = None,
    progress: Callable[[int], None] | None = None,
    **retrieve_options: Any,
) -> Profile:
    """Profile likelihood of one unknown: all others are fitted at each of several fixed values of it.

    If chi-squared is not a parabola of the unknown, as when two solutions compete, the standard error is
    misleading; the interval of the profile is not. Fits begin at the value nearest to the unknown's start and
    proceed outwards; each starts from the result of its neighbour.

    **Arguments:**

    - `observed`, `lidar`, `scene`, `unknowns`, `noise`, `key`, `time`, `plan`: as for `retrieve`, but with
      two unknowns or more.
    - `name`: name of the unknown that is fixed; it must be a single number. Its value is put into the scene
      before the others.
    - `values`: (points,) values of that unknown, two or more, increasing, within its bounds.
    - `progress`: called with the index of each value when its fit has ended.
    - `retrieve_options`: further arguments of `retrieve`, for all fits.

    **Returns:** a `Profile`.

    **Raises:** ValueError for a `name` that no unknown has, for `values` that are not increasing or lie
    outside the bounds, for a single unknown, and as `retrieve` does.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> scene = jl.Scene(ground=jl.Ground(height=0.5))
    >>> wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
    >>> height = inversion.Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0), name="height")
    >>> brightness = inversion.Unknown(lambda s: s.ground.reflectance, bounds=(0.0, 1.0))
    >>> unknowns, more = [height, brightness], {"noise": 0.005, "key": jax.random.key(1)}
    >>> values = [0.4, 0.5, 0.6]
    >>> profile = inversion.profile_likelihood(wave, jl.Lidar(), scene, unknowns, "height", values, **more)
    >>> print("{:.2f} m to {:.2f} m".format(*profile.interval()))
    0.47 m to 0.53 m
    """
    # Arguments that `retrieve` does not have are found before the work.
    arguments = inspect.signature(retrieve).bind(
        observed, lidar, scene, unknowns, noise=noise, key=key, **retrieve_options
    )
    arguments.apply_defaults()
    options = arguments.arguments
    check_progress(progress)
    check_key(key)
    sizes = trace_sizes(options["n_photons"], options["n_rays"], options["max_orders"], plan)
    names = ("solver", "max_steps", "starts", "scale", "recorder", "noise_floor")
    problem = checked_problem(
        observed, lidar, scene, unknowns, noise=noise, time=time, **{n: options[n] for n in names}
    )
    priors = fixed_priors(problem.unknowns)
    fixed = _fixed_unknown(name, problem.unknowns)
    points = as_numpy(values, "values")
    if points.ndim != 1 or points.size < 2 or not np.all(np.diff(points) > 0):
        raise ValueError(f"values has the shape {points.shape}; admissible are two or more, increasing")
    check_range("values", points, float(fixed.low), float(fixed.high))
    plan = checked_plan(plan, problem.lidar, scene, problem.unknowns, problem.observed.time, sizes)
    free_unknowns = [u for u, bound in zip(unknowns, problem.unknowns) if bound is not fixed]
    # Smoothness priors without mean are about the first start, and no fit moves them.
    levels = [bound.prior_level for bound in problem.unknowns if bound is not fixed]
    middle = int(np.argmin(np.abs(points - float(fixed.start))))
    fits: dict[int, CompletedFit] = {}
    estimates: dict[int, dict[str, np.ndarray]] = {}
    for outwards in (range(middle, points.size), range(middle - 1, -1, -1)):
        # Both directions start from the fit in the middle; None for the first one of all.
        neighbour = estimates.get(middle)
        for i in outwards:
            # First of all values: the `apply` of other unknowns may depend on it.
            value = jnp.asarray(points[i], fixed.start.dtype).reshape(fixed.start.shape)
            scene_at_point = set_values(scene, (fixed.setter,), (value,))
            lidar_at_point = set_lidar_values(problem.lidar, (fixed.setter,), (value,))
            # Bound again: they may depend on the scene.
            bound_unknowns = bind_unknowns(free_unknowns, scene_at_point, lidar_at_point)
            if neighbour is not None:
                bound_unknowns = [
                    with_start(u, jnp.asarray(neighbour[u.name], u.start.dtype)) for u in bound_unknowns
                ]
            bound_unknowns = [u._replace(smooth_level=v) for u, v in zip(bound_unknowns, levels)]
            problem_at_point = dataclasses.replace(
                problem, lidar=lidar_at_point, scene=scene_at_point, unknowns=bound_unknowns
            )
            # The same photons at all values: the noise of the simulation is no part of differences in
            # chi-squared.
            fits[i], _, recorder = fit_problem(problem_at_point, plan, key, throw=options["throw"])
            neighbour = split_by_name(fits[i].summary.values, [*bound_unknowns, *recorder.unknowns])
            estimates[i] = neighbour
            if progress is not None:
                progress(i)
    # From the order in which fits ran to that of the values.
    ordered = [fits[i] for i in range(points.size)]
    noise = min(ordered, key=lambda fit: fit.details.cost).details.noise
    chi2 = np.zeros(points.size)
    for i, fit in fits.items():
        values_of_all = {**estimates[i], name: points[i]}
        # The prior of the fixed unknown counts as well.
        flat = np.concatenate([np.ravel(values_of_all[u.name]) for u in problem.unknowns])
        residual = np.append(noise.whiten(fit.details.difference), priors(flat)[0])
        chi2[i] = residual @ residual
    return Profile(
        values=points,
        chi2=chi2 - chi2.min(),
        others={k: np.stack([estimates[i][k] for i in range(points.size)]) for k in estimates[middle]},
        converged=np.array([fit.summary.converged for fit in ordered]),
    )


def _sample_times(plan: Plan) -> Float[np.ndarray, " samples"]:
    """Return the times of the samples of a plan, ns."""
    return plan.sample_start + plan.sample_interval * np.arange(plan.n_samples)


def _fixed_unknown(name: str, unknowns: Sequence[BoundUnknown]) -> BoundUnknown:
    """Return the unknown of a profile. **Raises:** ValueError unless it is a single number beside others."""
    names = [u.name for u in unknowns]
    if name not in names:
        raise ValueError(f"name = {name!r} is none of the unknowns: {', '.join(names)}")
    fixed = unknowns[names.index(name)]
    if fixed.start.size != 1 or len(unknowns) == 1:
        raise ValueError(
            f"name = {name!r} has {fixed.start.size} values beside {len(unknowns) - 1} unknowns; admissible "
            "is one value beside one unknown or more"
        )
    return fixed
