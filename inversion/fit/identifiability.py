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
import itertools
from collections.abc import Sequence
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.special
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from inversion.fit.fit_summary import CompletedFit
from inversion.fit.model import ForwardModel
from inversion.fit.prior_residuals import fixed_priors
from inversion.fit.problem import Problem, check_problem
from inversion.fit.retrieval import fit_record, solver_settings
from inversion.fit.uncertainty import correlation_of, estimate_covariance
from inversion.fit.unknowns import (
    BoundUnknown,
    bind_unknowns,
    flat_bounds,
    flat_labels,
    flat_start,
    set_lidar_values,
    set_values,
    split_by_name,
    with_start,
)
from jaxlidar.extend import as_numpy, check_key, check_range
from jaxlidar.progress import ProgressOption, shows_progress

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
    >>> problem = inversion.Problem(None, jl.Lidar(), scene, [height], noise=0.001)
    >>> bound = inversion.cramer_rao(problem, key=jax.random.key(0))
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


def cramer_rao(problem: Problem, *, key: PRNGKeyArray) -> CramerRao:
    """Cramer-Rao bounds of the unknowns of a problem: the smallest standard errors, before data are recorded.

    For independent normal noise, the Fisher information is J^T diag(1/noise^2) J, with J the derivatives of
    the waveform at the starting values. With priors, their precision is added: the result is then the
    posterior covariance of the linearised problem, and no bound of unbiased estimates. A recorder's unknowns
    and noise count; its offset and scale are fitted to the record, or, without one, in the middle of their
    bounds.

    **Arguments:**

    - `problem`: a `Problem` of one record, or with `observed=None`. Then its noise is above 0 throughout, and
      without `time` and `plan` it is planned for the scene alone.
    - `key`: a JAX random key.

    **Returns:** a `CramerRao`.

    **Raises:** ValueError for a problem of many records, and for a `Smooth` prior without strength. TypeError
    for arguments of another kind.

    **Source:** Kay (1993), Fundamentals of Statistical Signal Processing, chapter 3.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> scene = jl.Scene(ground=jl.Ground())
    >>> height = inversion.Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0), name="height")
    >>> problem = inversion.Problem(None, jl.Lidar(), scene, [height], noise=0.001)
    >>> bound = inversion.cramer_rao(problem, key=jax.random.key(0))
    >>> print(f"{float(bound.stderr['height']):.3f} m")
    0.005 m
    """
    check_problem(problem, recorded=False)
    check_key(key)
    bound = problem.bound
    unknowns, observed, recorder_model = bound.all_unknowns, bound.observed[0], bound.recorder_model(0)
    priors = fixed_priors(unknowns)
    start = flat_start(bound.unknowns[0])
    # All batches, as noise of the Jacobian would falsify the bound.
    model = ForwardModel(bound.lidars[0], bound.scenes[0], bound.plan, bound.unknowns[0], key)
    evaluation = model(start)
    record = None if problem.observed is None else observed
    recorder_start = recorder_model.start(evaluation.reflectance, record)
    # The simulation's own noise is no part of the bound.
    noise = recorder_model.sample_noise(observed, evaluation, recorder_start, with_simulation=False)
    _, jacobian = recorder_model(evaluation.reflectance, evaluation.jacobian, recorder_start)
    jacobian = noise.whiten(jacobian[observed.is_fitted])
    prior_jacobian = priors(np.append(start, recorder_start))[1]
    precision = prior_jacobian.T @ prior_jacobian
    low, high = flat_bounds(unknowns)
    measurement_fraction = np.ones(len(jacobian))
    estimate = estimate_covariance(jacobian, precision, high - low, measurement_fraction, None, priors.basis)
    labels = flat_labels(unknowns)
    std = np.sqrt(np.diag(estimate.covariance))
    return CramerRao(
        stderr={name: jnp.asarray(s) for name, s in split_by_name(std, unknowns).items()},
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
    >>> from inversion.fit.identifiability import Profile
    >>> profile = Profile(np.array([0.0, 0.1, 0.2, 0.3]), chi2, others={}, converged=converged)
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


@shows_progress
def profile_likelihood(
    problem: Problem,
    name: str,
    values: ArrayLike | Sequence,
    *,
    key: PRNGKeyArray,
    max_steps: int = 50,
    starts: int = 1,
    progress: ProgressOption = None,
) -> Profile:
    """Profile likelihood of one unknown: all others are fitted at each of several fixed values of it.

    If chi-squared is not a parabola of the unknown, as when two solutions compete, the standard error is
    misleading; the interval of the profile is not. Fits begin at the value nearest to the unknown's start and
    proceed outwards; each starts from the result of its neighbour.

    **Arguments:**

    - `problem`: a `Problem` of one record, with two unknowns or more.
    - `name`: name of the unknown that is fixed; it must be a single number. Its value is put into the scene
      before the others.
    - `values`: (points,) values of that unknown, two or more, increasing, within its bounds.
    - `key`, `max_steps`, `starts`: as for `retrieve`.
    - `progress`: True for a bar; or a function called with the index of each value when its fit has ended.
      Default None: silent.

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
    >>> problem = inversion.Problem(wave, jl.Lidar(), scene, [height, brightness], noise=0.005)
    >>> profile = inversion.profile_likelihood(problem, "height", [0.4, 0.5, 0.6], key=jax.random.key(1))
    >>> print("{:.2f} m to {:.2f} m".format(*profile.interval()))
    0.47 m to 0.53 m
    """
    check_problem(problem)
    check_key(key)
    settings, bound = solver_settings(max_steps, starts), problem.bound
    lidar, scene, unknowns = bound.lidars[0], bound.scenes[0], bound.unknowns[0]
    priors = fixed_priors(unknowns)
    fixed = _fixed_unknown(name, unknowns)
    points = as_numpy(values, "values")
    if points.ndim != 1 or points.size < 2 or not np.all(np.diff(points) > 0):
        raise ValueError(f"values has the shape {points.shape}; admissible are two or more, increasing")
    check_range("values", points, float(fixed.low), float(fixed.high))
    free_unknowns = [u for u, bound_u in zip(problem.unknowns, unknowns) if bound_u is not fixed]
    # The starts of the first fits, which smoothness priors without mean are about: no fit moves these.
    starts_of_free = {u.name: np.asarray(u.start) for u in unknowns if u is not fixed}
    levels = [u.prior_level for u in unknowns if u is not fixed]
    middle = int(np.argmin(np.abs(points - float(fixed.start))))
    fits: dict[int, CompletedFit] = {}
    estimates: dict[int, dict[str, np.ndarray]] = {}
    for outwards in (range(middle, points.size), range(middle - 1, -1, -1)):
        # Both directions start from the fit in the middle.
        neighbour = estimates.get(middle, starts_of_free)
        for i in outwards:
            # First of all values: the `apply` of other unknowns may depend on it.
            value = jnp.asarray(points[i], fixed.start.dtype).reshape(fixed.start.shape)
            scene_at_point = set_values(scene, (fixed.setter,), (value,))
            lidar_at_point = set_lidar_values(lidar, (fixed.setter,), (value,))
            # Bound again: they may depend on the scene.
            at_point = [
                with_start(u, jnp.asarray(neighbour[u.name], u.start.dtype))._replace(smooth_level=level)
                for u, level in zip(bind_unknowns(free_unknowns, scene_at_point, lidar_at_point), levels)
            ]
            problem_at_point = dataclasses.replace(
                bound, lidars=[lidar_at_point], scenes=[scene_at_point], unknowns=[at_point]
            )
            # The same photons at all values: the noise of the simulation is no part of differences in
            # chi-squared.
            fits[i] = fit_record(problem_at_point, settings, key).fit
            estimates[i] = split_by_name(fits[i].summary.values, problem_at_point.all_unknowns)
            neighbour = estimates[i]
            if callable(progress):
                progress(i)
    # From the order in which fits ran to that of the values.
    ordered = [fits[i] for i in range(points.size)]
    noise = min(ordered, key=lambda fit: fit.cost).noise
    chi2 = np.zeros(points.size)
    for i, fit in fits.items():
        values_of_all = {**estimates[i], name: points[i]}
        # The prior of the fixed unknown counts as well.
        flat = np.concatenate([np.ravel(values_of_all[u.name]) for u in unknowns])
        residual = np.append(noise.whiten(fit.difference), priors(flat)[0])
        chi2[i] = residual @ residual
    return Profile(
        values=points,
        chi2=chi2 - chi2.min(),
        others={k: np.stack([estimates[i][k] for i in range(points.size)]) for k in estimates[middle]},
        converged=np.array([fit.summary.converged for fit in ordered]),
    )


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
