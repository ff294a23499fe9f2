"""What a waveform can tell, before and after it is recorded: Cramer-Rao bounds and profile likelihoods."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.special
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from jaxlidar import Lidar, Plan, Scene, Waveform
from jaxlidar import plan as make_plan
from jaxlidar.extend import check_range
from jaxlidar.planning.plan import MIN_BATCHES

from .data import data_of, time_axis
from .fit import labels_of, named
from .model import Model
from .planning import check_samples, plan_for
from .retrieval import retrieve
from .uncertainty import correlation_of, errors_of
from .unknowns import Priors, Unknown, put, settle


@final
class CramerRao(eqx.Module):
    """The least standard errors that any unbiased retrieval can have.

    Rows of the matrices are the flattened unknowns, named by `labels`, in natural units.

    - `stderr`: by name; infinite where the waveforms do not determine the unknown, alone or with others.
    - `covariance`: (n, n) inverse of the Fisher information, priors included; infinite variances as in
      `stderr`. - `correlation`: (n, n). - `information`: (n, n) Fisher information.
    - `undetermined`: labels of the unknowns to which the waveforms are blind.
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
    n_photons: float = 65536,
    n_rays: float = 8192,
    max_orders: int | None = None,
) -> CramerRao:
    """What waveforms of a scene can tell about its unknowns: the Fisher information at the scene's values.

    For independent normal noise: information = J^T diag(1/noise^2) J + that of the priors, J the waveform's
    derivatives. An unknown with a start of its own (`Unknown(start=)`) is taken there.

    **Arguments:**

    - `lidar`, `scene`, `unknowns`, `key`, `n_photons`, `n_rays`, `max_orders`: as for `retrieve`.
    - `noise`: standard deviation of the apparent reflectance per sample, anything that broadcasts to
      (wavelengths, bins), above 0; infinity leaves a sample out.
    - `time`: (bins,) ns, sample times. Default: those of `plan`.
    - `plan`: default: the scene's.

    **Raises:** ValueError for inadmissible arguments.

    **Source:** Kay (1993), Fundamentals of Statistical Signal Processing, chapter 3.
    """
    settled = settle(unknowns, scene)
    if plan is None:
        photons, rays = int(n_photons) // MIN_BATCHES, int(n_rays) // MIN_BATCHES
        if time is None:
            plan = make_plan(lidar, scene, max_orders=max_orders, n_photons=photons, n_rays=rays)
        else:
            plan = plan_for(
                lidar,
                scene,
                settled,
                time_axis(time, lidar),
                max_orders=max_orders,
                photons=photons,
                rays=rays,
            )
    if time is not None:
        check_samples(plan, time_axis(time, lidar))
    shape = (lidar.wavelength.size, plan.n_samples)
    try:
        sigma = np.broadcast_to(np.asarray(noise, float), shape)
    except ValueError:
        raise ValueError(
            f"noise has the shape {np.shape(noise)}, which does not broadcast to {shape}"
        ) from None
    if not np.all(sigma > 0):
        raise ValueError(f"noise = {np.min(sigma):g} is outside the admissible range (0, inf]")
    start = np.concatenate([np.ravel(np.asarray(s.start, float)) for s in settled])
    evaluation = Model(lidar, scene, plan, settled, key)(start)
    jacobian = (evaluation.jacobian / sigma[..., None]).reshape(-1, start.size)
    precision = Priors(settled)(start)[1] ** 2
    width = np.concatenate([np.ravel(s.high - s.low) for s in settled])
    errors = errors_of(jacobian, precision, width, np.ones(len(jacobian)), None)
    labels = labels_of(settled)
    std = np.sqrt(np.diag(errors.covariance))
    return CramerRao(
        stderr={k: jnp.asarray(v) for k, v in named(std, settled).items()},
        covariance=jnp.asarray(errors.covariance),
        correlation=jnp.asarray(correlation_of(errors.covariance)),
        information=jnp.asarray(jacobian.T @ jacobian + np.diag(precision)),
        labels=labels,
        undetermined=tuple(label for label, o in zip(labels, errors.open) if o),
    )


@final
class Profile(eqx.Module):
    """The best fit for each of several values of one unknown.

    - `values`: (points,) of the unknown. - `chi2`: (points,) chi-squared, priors included, less its least.
    - `others`: by name, (points, ...) the values of the other unknowns.
    - `converged`: (points,) whether these fits did.
    """

    values: Float[np.ndarray, " points"]
    chi2: Float[np.ndarray, " points"]
    others: dict[str, Float[np.ndarray, "points ..."]]
    converged: Any

    def interval(self, level: float = 0.683) -> tuple[float, float]:
        """Where chi-squared is below the quantile of `level`, in (0, 1); its root is interpolated linearly.

        An end is infinite where chi-squared stays below it as far as the values reach: to that side, the
        waveform does not say.
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
    """Fit all unknowns but one, for each of several values of that one.

    Where chi-squared is no parabola of the unknown, as when two explanations compete, its standard error
    misleads, and the profile's interval does not. Each fit starts where its neighbour ended, from the value
    nearest to the scene's own outwards.

    **Arguments:** those of `retrieve`, and

    - `name`: of the unknown to be held, a single number. It is put into the scene before the others.
    - `values`: (points,) increasing, within its bounds.
    - `progress`: called with the number of each value that is done.

    **Raises:** ValueError for a name that is none of the unknowns', for values that are not increasing or
    outside the bounds, for a single unknown, and as `retrieve` does.
    """
    settled = settle(unknowns, scene)
    names = [s.name for s in settled]
    if name not in names:
        raise ValueError(f"name = {name!r} is none of the unknowns: {', '.join(names)}")
    held = settled[names.index(name)]
    if held.start.size != 1 or len(settled) == 1:
        raise ValueError(
            f"name = {name!r} has {held.start.size} values beside {len(settled) - 1} unknowns; admissible is "
            "one value beside one unknown or more"
        )
    points = np.asarray(values, float)
    if points.ndim != 1 or points.size < 2 or not np.all(np.diff(points) > 0):
        raise ValueError(f"values has the shape {points.shape}; admissible are two or more, increasing")
    check_range("values", points, float(held.low), float(held.high))
    others = [u for u, s in zip(unknowns, settled) if s is not held]
    data = data_of(observed, time, noise, more.get("noise_floor", 1e-3), lidar)
    if plan is None:
        plan = plan_for(
            lidar,
            scene,
            settled,
            data.time,
            max_orders=more.get("max_orders"),
            photons=int(more.get("n_photons", 65536)) // MIN_BATCHES,
            rays=int(more.get("n_rays", 8192)) // MIN_BATCHES,
        )
    middle = int(np.argmin(np.abs(points - float(held.start))))
    found: dict[int, Any] = {}
    for numbers in (range(middle, points.size), range(middle - 1, -1, -1)):
        # Where the neighbour towards the middle ended.
        last = found.get(middle)
        for i in numbers:
            here = put(
                scene, (held.place,), (jnp.asarray(points[i], held.start.dtype).reshape(held.start.shape),)
            )
            begun = (
                others if last is None else [_from(u, s, last) for u, s in zip(others, settle(others, scene))]
            )
            last = retrieve(
                data.observed,
                lidar,
                here,
                begun,
                noise=data.sigma,
                key=key,
                time=data.time,
                plan=plan,
                **more,
            )
            found[i] = last
            if progress is not None:
                progress(i)
    fits = [found[i] for i in range(points.size)]
    priors = Priors(settled)
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
