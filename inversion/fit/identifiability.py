"""Identifiability of unknowns from waveforms: Cramer-Rao bounds and profile likelihoods."""

import inspect
import itertools
from collections.abc import Callable, Sequence
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.special
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from inversion.fit.data import at_fixed_times, data_of, noise_of, numbers, time_axis
from inversion.fit.model import Model
from inversion.fit.planning import batch_sizes, check_samples, plan_for, plan_within
from inversion.fit.priors import Priors, known_priors
from inversion.fit.retrieval import (
    check_progress,
    check_solution,
    check_solver,
    retrieve,
    retrieve_with,
    scale_of,
)
from inversion.fit.solver import labels_of, named
from inversion.fit.uncertainty import correlation_of, errors_of
from inversion.fit.unknowns import Unknown, put, settle
from inversion.receiver.recorder import Recorder, check_names
from jaxlidar import Lidar, Plan, Scene, Waveform
from jaxlidar import plan as make_plan
from jaxlidar.extend import check_key, check_kind, check_kinds, check_range
from jaxlidar.planning.plan_check import check_reach


@final
class CramerRao(eqx.Module):
    """The result of `cramer_rao`: the smallest standard errors that an unbiased retrieval can have.

    Rows of the matrices are the flattened unknowns, named by `labels`, in natural units. `print(bound)` shows
    a summary, with pairs of unknowns whose correlation exceeds 0.95.

    - `stderr`: by name; infinite where the waveforms do not constrain the unknown, alone or in combination
      with others.
    - `covariance`: (n, n) inverse of the Fisher information, priors included; infinite variances as in
      `stderr`.
    - `correlation`: (n, n).
    - `information`: (n, n) Fisher information, priors included.
    - `labels`: names of the rows.
    - `undetermined`: labels of the unknowns that the waveforms do not constrain.

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
        close = np.abs(np.asarray(self.correlation)) > 0.95
        rows += [
            f"{self.labels[i]} and {self.labels[j]} are hard to tell apart: correlation "
            f"{float(self.correlation[i, j]):.3f}"
            for i in range(len(std))
            for j in range(i)
            if close[i, j]
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

    For independent normal noise, the Fisher information is J^T diag(1/noise^2) J plus that of the priors,
    with J the derivatives of the waveform at the scene's values. An unknown with a start of its own
    (`Unknown(start=)`) is taken there.

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
    lidar = at_fixed_times(lidar)
    photons, rays = batch_sizes(n_photons, n_rays, max_orders, plan)
    settled = settle(unknowns, scene)
    priors = known_priors(settled)
    axis = None if time is None else time_axis(time, lidar)
    if plan is None:
        if axis is None:
            plan = make_plan(lidar, scene, max_orders=max_orders, n_photons=photons, n_rays=rays)
        else:
            plan = plan_for(lidar, scene, settled, axis, max_orders=max_orders, photons=photons, rays=rays)
    else:
        check_reach(plan, lidar, scene)
    if axis is not None:
        check_samples(plan, axis)
    sigma = noise_of(noise, (lidar.wavelength.size, plan.n_samples))
    if not np.all(sigma > 0):
        raise ValueError(f"noise = {np.min(sigma):g} is outside the admissible range (0, inf]")
    start = np.concatenate([np.ravel(np.asarray(s.start, float)) for s in settled])
    evaluation = Model(lidar, scene, plan, settled, key)(start)
    jacobian = (evaluation.jacobian / sigma[..., None]).reshape(-1, start.size)
    slope = priors(start)[1]
    precision = slope.T @ slope
    width = np.concatenate([np.ravel(s.high - s.low) for s in settled])
    errors = errors_of(jacobian, precision, width, np.ones(len(jacobian)), None, priors.basis)
    labels = labels_of(settled)
    std = np.sqrt(np.diag(errors.covariance))
    return CramerRao(
        stderr={k: jnp.asarray(v) for k, v in named(std, settled).items()},
        covariance=jnp.asarray(errors.covariance),
        correlation=jnp.asarray(correlation_of(errors.covariance)),
        information=jnp.asarray(jacobian.T @ jacobian + precision),
        labels=labels,
        undetermined=tuple(label for label, o in zip(labels, errors.open) if o),
    )


@final
class Profile(eqx.Module):
    """The result of `profile_likelihood`: the best fit at each of several values of one unknown.

    - `values`: (points,) values of the unknown.
    - `chi2`: (points,) chi-squared, priors included, less its minimum.
    - `others`: by name, (points, ...) fitted values of the other unknowns.
    - `converged`: (points,) whether the fit converged.

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
        """Confidence interval of the unknown: where chi-squared is below the quantile of `level`.

        The root of chi-squared is interpolated linearly between the values.

        **Arguments:**

        - `level`: probability, in (0, 1). Default 0.683.

        **Returns:** (low, high). An end is infinite where chi-squared stays below the quantile up to the last
        value: the waveform does not constrain the unknown to that side, as far as the values reach.

        **Raises:** ValueError for a `level` outside (0, 1).
        """
        check_range("level", level, 0.0, 1.0, low_open=True, high_open=True)
        limit = float(jax.scipy.special.ndtri(0.5 * (1.0 + level)))
        root, best = np.sqrt(self.chi2), int(np.argmin(self.chi2))

        def end(numbers: range) -> float:
            for inner, outer in itertools.pairwise(numbers):
                if root[outer] > limit:
                    share = (limit - root[inner]) / (root[outer] - root[inner])
                    return float(self.values[inner] + share * (self.values[outer] - self.values[inner]))
            return float("inf") * (-1 if numbers.step < 0 else 1)

        return end(range(best, -1, -1)), end(range(best, len(root)))


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
    **more: Any,
) -> Profile:
    """Profile likelihood of one unknown: all others are fitted at each of several fixed values of it.

    Where chi-squared is not a parabola of the unknown, as when two solutions compete, the standard error is
    misleading; the interval of the profile is not. Fits begin at the value nearest to the unknown's start and
    proceed outwards; each starts from the result of its neighbour.

    **Arguments:**

    - `observed`, `lidar`, `scene`, `unknowns`, `noise`, `key`, `time`, `plan`: as for `retrieve`, but with
      two unknowns or more.
    - `name`: name of the unknown that is held fixed; it must be a single number. Its value is put into the
      scene before the others.
    - `values`: (points,) values of that unknown, two or more, increasing, within its bounds.
    - `progress`: called with the index of each value when its fit has ended.
    - `more`: further arguments of `retrieve`, for all fits.

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
    check_kinds(lidar, scene)
    # Names that `retrieve` does not know are found before the work.
    given = inspect.signature(retrieve).bind(observed, lidar, scene, unknowns, noise=noise, key=key, **more)
    given.apply_defaults()
    own = given.arguments
    solution = check_solution(own["solver"], own["max_steps"], own["starts"])
    check_progress(progress)
    check_key(key)
    lidar = at_fixed_times(lidar)
    photons, rays = batch_sizes(own["n_photons"], own["n_rays"], own["max_orders"], plan)
    settled = settle(unknowns, scene)
    priors = known_priors(settled)
    names = [s.name for s in settled]
    if name not in names:
        raise ValueError(f"name = {name!r} is none of the unknowns: {', '.join(names)}")
    held = settled[names.index(name)]
    if held.start.size != 1 or len(settled) == 1:
        raise ValueError(
            f"name = {name!r} has {held.start.size} values beside {len(settled) - 1} unknowns; admissible is "
            "one value beside one unknown or more"
        )
    points = numbers("values", values)
    if points.ndim != 1 or points.size < 2 or not np.all(np.diff(points) > 0):
        raise ValueError(f"values has the shape {points.shape}; admissible are two or more, increasing")
    check_range("values", points, float(held.low), float(held.high))
    others = [u for u, s in zip(unknowns, settled) if s is not held]
    recorder = own["recorder"]
    check_solver(own["solver"], settled)
    check_kind("recorder", recorder, Recorder | None, "a Recorder, or None")
    check_names(recorder, settled)
    extra = [] if own["scale"] is None else [scale_of(own["scale"], settled)]
    data = data_of(observed, time, noise, own["noise_floor"], lidar)
    sizes = {"max_orders": own["max_orders"], "photons": photons, "rays": rays}
    plan = plan_within(plan, lidar, scene, settled, data.time, **sizes)
    how = (recorder, *solution, None, own["throw"])
    middle = int(np.argmin(np.abs(points - float(held.start))))
    found: dict[int, Any] = {}
    for order in (range(middle, points.size), range(middle - 1, -1, -1)):
        # The result of the neighbour towards the middle.
        last = found.get(middle)
        for i in order:
            here = put(
                scene, (held.place,), (jnp.asarray(points[i], held.start.dtype).reshape(held.start.shape),)
            )
            begun = settle(others, here)
            if last is not None:
                begun = settle([_from(u, s, last) for u, s in zip(others, begun)], here)
            last = retrieve_with(plan, data, lidar, here, begun, extra, key, *how)
            found[i] = last
            if progress is not None:
                progress(i)
    fits = [found[i] for i in range(points.size)]
    chi2 = np.array([_chi2(f, settled, priors, name, p) for f, p in zip(fits, points)])
    return Profile(
        values=points,
        chi2=chi2 - chi2.min(),
        others={k: np.stack([np.asarray(f.values[k]) for f in fits]) for k in fits[0].values},
        converged=np.array([f.converged for f in fits]),
    )


def _from(unknown: Unknown, settled: Any, fit: Any) -> Unknown:
    value = np.clip(np.asarray(fit.values[settled.name], float), settled.low, settled.high)
    return eqx.tree_at(
        lambda u: u.start, unknown, jnp.asarray(value, settled.start.dtype), is_leaf=lambda x: x is None
    )


def _chi2(fit: Any, settled: list, priors: Priors, name: str, value: float) -> float:
    flat = np.concatenate(
        [[value] if s.name == name else np.ravel(np.asarray(fit.values[s.name], float)) for s in settled]
    )
    return float(np.sum(np.asarray(fit.residuals, float) ** 2) + np.sum(priors(flat)[0] ** 2))
