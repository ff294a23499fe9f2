"""Retrieval from many waveforms: footprints are simulated together, and each is fitted on its own.

Fits run side by side in lanes. The simulations that they request are gathered, run in one compiled call, and
sent back. A lane whose fit has ended takes the next footprint. A fit that fails is marked as such and does
not affect the others.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import ArrayLike, Bool, Float, Int, PRNGKeyArray

from inversion.fit.checkpoint import Frame, Row, kept_fits
from inversion.fit.data import at_fixed_times, data_of, noise_of, numbers
from inversion.fit.job import Job, fits, fits_by
from inversion.fit.lanes import Lanes
from inversion.fit.planning import batch_sizes, plan_within
from inversion.fit.profiles import AbstractFitted
from inversion.fit.quality import Verdict, judge_fits
from inversion.fit.retrieval import SOLVER, check_progress, check_solution, check_solver, scale_of
from inversion.fit.solver import bounds_of, labels_of, named, smooth_names
from inversion.fit.unknowns import Settled, Unknown, settle, start_from
from inversion.receiver.recorder import Recorder, check_names, recorder_unknowns
from jaxlidar import Lidar, Plan, Scene
from jaxlidar.extend import briefly, check_integer, check_key, check_kind, fingerprint
from jaxlidar.io import save
from jaxlidar.io.datasets import datasets_of, variables_by_item


@dataclasses.dataclass(frozen=True)
class Progress:
    """Progress of `retrieve_many`.

    - `done`: fits that have ended.
    - `total`: fits in all.
    - `converged`: fits that have converged.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion
    >>> print(inversion.Progress(done=3, total=10, converged=2))
    3 of 10 fits, 2 converged
    """

    done: int
    total: int
    converged: int

    def __str__(self) -> str:
        return f"{self.done} of {self.total} fits, {self.converged} converged"


@final
@briefly
class Retrievals(AbstractFitted):
    """The results of `retrieve_many`: one fit per footprint, in the order given.

    Arrays have a leading axis `footprints`. The quantities are those of `Retrieval`.

    - `values`: by name, (footprints, ...) best values.
    - `stderr`: by name, (footprints, ...) one standard error; infinite where the data do not constrain the
      unknown.
    - `robust_stderr`, `prior_share`, `at_bound`: by name, (footprints, ...).
    - `covariance`, `averaging`: (footprints, n, n).
    - `strength`: by name, (footprints,). `bounds`: by name, (2, ...), those of all footprints.
    - `reduced_chi2`, `second_minimum`, `independent_samples`: (footprints,).
    - `converged`: (footprints,) whether the fit ended at a minimum.
    - `steps`: (footprints,) waveforms simulated, with few photons or all, each with its Jacobian.
    - `fitted`: (footprints, wavelengths, bins) apparent reflectance, without the scale.
    - `status`: a sentence for each footprint on how its fit ended.
    - `labels`: names of the rows of `covariance`.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> scene = jl.Scene(ground=jl.Ground(height=0.5))
    >>> wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
    >>> unknown = inversion.Unknown(lambda s: s.ground.reflectance, bounds=(0.0, 1.0), name="brightness")
    >>> more = {"noise": 0.001, "time": wave.time, "key": jax.random.key(1)}
    >>> fits = inversion.retrieve_many(wave.reflectance[None], jl.Lidar(), scene, [unknown], **more)
    >>> fits.labels, fits.covariance.shape, fits.converged.tolist()
    (('brightness',), (1, 1, 1), [True])
    """

    values: dict[str, Float[np.ndarray, "footprints ..."]]
    stderr: dict[str, Float[np.ndarray, "footprints ..."]]
    robust_stderr: dict[str, Float[np.ndarray, "footprints ..."]]
    prior_share: dict[str, Float[np.ndarray, "footprints ..."]]
    at_bound: dict[str, Bool[np.ndarray, "footprints ..."]]
    covariance: Float[np.ndarray, "footprints n n"]
    reduced_chi2: Float[np.ndarray, " footprints"]
    second_minimum: Float[np.ndarray, " footprints"]
    independent_samples: Float[np.ndarray, " footprints"]
    averaging: Float[np.ndarray, "footprints n n"]
    strength: dict[str, Float[np.ndarray, " footprints"]]
    bounds: dict[str, Float[np.ndarray, "2 ..."]]
    converged: Bool[np.ndarray, " footprints"]
    steps: Int[np.ndarray, " footprints"]
    fitted: Float[np.ndarray, "footprints wavelengths bins"]
    status: tuple[str, ...] = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)

    @property
    def quality(self) -> tuple[Verdict, ...]:
        """Whether each fit can be trusted, with reasons: `inversion.judge_fits` with all unknowns."""
        return judge_fits(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the results as a netCDF file, which `jaxlidar.open` reads.

        **Arguments:** `path`: the file to write.

        **Raises:** what `jaxlidar.io.save` raises.
        """
        save(self, path)

    def to_xarray(self) -> Any:
        """The results as an `xarray.Dataset` over the dimension `footprint`.

        **Returns:** an `xarray.Dataset` with a variable for each unknown, "... stderr" for its standard
        error, "... robust stderr", "... prior share" and "... at bound", and `reduced_chi2`,
        `second_minimum`, `independent_samples`, `converged`, `steps`, `status` and `fitted`.

        **Raises:** ImportError where xarray is not installed.
        """
        import xarray

        stored = datasets_of(self)["/"]
        columns: dict[str, Any] = {}
        for field in ("values", "stderr", "robust_stderr", "prior_share", "at_bound"):
            suffix = "" if field == "values" else f" {field.replace('_', ' ')}"
            for name, variable in variables_by_item(stored, field).items():
                axes = {axis: f"{name} {i}" for i, axis in enumerate(stored[variable].dims[1:])}
                columns[f"{name}{suffix}"] = stored[variable].rename(axes)
        for name in ("reduced_chi2", "second_minimum", "independent_samples", "converged", "steps"):
            columns[name] = stored[name]
        columns["status"] = ("footprint", np.array(self.status, dtype=object))
        columns["fitted"] = stored["fitted"].rename(time="bin")
        return xarray.Dataset(columns)


def retrieve_many(
    observed: ArrayLike | Sequence,
    lidar: Lidar | Sequence[Lidar],
    scene: Scene | Sequence[Scene],
    unknowns: Sequence[Unknown],
    *,
    noise: ArrayLike | Sequence,
    time: ArrayLike | Sequence,
    key: PRNGKeyArray,
    plan: Plan | None = None,
    n_photons: float | None = None,
    n_rays: float | None = None,
    max_orders: int | None = None,
    solver: optx.AbstractLeastSquaresSolver = SOLVER,
    max_steps: float = 50,
    starts: float = 1,
    start: Mapping[str, ArrayLike | Sequence] | None = None,
    scale: tuple[float, float] | None = None,
    recorder: Recorder | Sequence[Recorder] | None = None,
    noise_floor: float = 1e-3,
    lanes: int = 16,
    path: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Retrievals:
    """Retrieve unknowns of a scene from many waveforms, each on its own, as `retrieve` does for one.

    A fit that fails says so in its status and does not affect the others.

    **Arguments:**

    - `observed`: (footprints, wavelengths, bins) apparent reflectance, or in any other unit with `scale`.
    - `lidar`, `scene`: one for all footprints, or one for each. Those of different footprints may differ only
      in the values of their arrays (such as transmit pulses, or starting values).
    - `noise`: one standard deviation, in [0, inf], anything that broadcasts to `observed`.
    - `time`: (bins,) ns, the same for all footprints.
    - `unknowns`, `key`, `n_photons`, `n_rays`, `max_orders`: as for `retrieve`.
    - `solver`, `max_steps`, `starts`, `scale`, `noise_floor`: as for `retrieve`.
    - `recorder`: as for `retrieve`, one for all footprints, or one for each, with the same unknowns.
    - `plan`: one for all footprints. Default None: made for the first lidar and scene and the corners of the
      bounds.
    - `start`: by name, (footprints, ...) values that unknowns start from. Default None: their own.
    - `lanes`: number of footprints simulated together, at least 1; memory grows with it. Default 16.
    - `path`: a file (of SQLite) that keeps every fit once it has ended, so that a run that was interrupted or
      killed goes on where it stopped. It belongs to the problem: everything that the result depends on must
      be as it was, and only `lanes`, `executor` and `progress` may change. One run at a time can use it.
      Where it cannot be written any more, as on a full disk, a warning says so once and the fits go on.
      Default None: no file.
    - `executor`: a `concurrent.futures.Executor`, whose workers fit chunks of footprints, as for
      `jaxlidar.simulate_many`. What the unknowns have must be such that it can be sent to them: paths, or
      functions of a module. A chunk whose worker dies gets a second try. Default None: this process.
    - `progress`: called with a `Progress` after every fit.

    **Returns:** a `Retrievals`, which does not depend on the number of workers.

    **Raises:** ValueError for inadmissible arguments, as `retrieve` does, and for a `path` that is
    damaged, no file of fits, or one of another problem, of which it says what differs. TypeError for
    arguments of another kind. OSError for a `path` that cannot be written, before any fit, or that another
    run uses. RuntimeError where the workers of a chunk die twice.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> import numpy as np
    >>> scene = jl.Scene(ground=jl.Ground(height=0.5, reflectance=0.4))
    >>> wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
    >>> unknown = inversion.Unknown(lambda s: s.ground.reflectance, bounds=(0.0, 1.0), name="brightness")
    >>> observed = np.stack([0.5 * wave.reflectance, wave.reflectance])
    >>> more = {"noise": 0.001, "time": wave.time, "key": jax.random.key(1)}
    >>> fits = inversion.retrieve_many(observed, jl.Lidar(), scene, [unknown], **more)
    >>> fits.values["brightness"].round(3).tolist()
    [0.2, 0.4]
    """
    y = numbers("observed", observed)
    if y.ndim != 3 or len(y) == 0:
        raise ValueError(f"observed has the shape {y.shape}; admissible is (footprints, wavelengths, bins)")
    sigma = noise_of(noise, y.shape)
    check_key(key)
    check_progress(progress)
    check_kind("path", path, str | os.PathLike | None, "a path, or None")
    check_kind("executor", executor, Executor | None, "a concurrent.futures.Executor, or None")
    lanes = check_integer("lanes", lanes)
    solver, max_steps, starts = check_solution(solver, max_steps, starts)
    photons, rays = batch_sizes(n_photons, n_rays, max_orders, plan)
    lidars = [at_fixed_times(a) for a in _one_each("lidar", lidar, Lidar, len(y))]
    scenes = _one_each("scene", scene, Scene, len(y))
    settled = _started([settle(unknowns, s) for s in scenes], {} if start is None else start, len(y))
    check_solver(solver, settled[0])
    data = [data_of(y[i], time, sigma[i], noise_floor, lidars[i % len(lidars)]) for i in range(len(y))]
    axis = data[0].time
    extra = [] if scale is None else [scale_of(scale, settled[0])]
    recorders: list[Recorder | None] = (
        [None] if recorder is None else _one_each("recorder", recorder, Recorder, len(y))
    )
    check_names(recorders[0], settled[0])
    terms = [] if recorders[0] is None else recorder_unknowns(recorders[0])
    names = [*settled[0], *terms, *extra]
    parts = {
        "observed": y,
        "noise": sigma,
        "time": axis,
        "noise_floor": float(noise_floor),
        "lidar": lidars,
        "scene": scenes,
        **_parts_of(settled),
        "scale": [(s.low, s.high) for s in extra],
        "recorder": recorders,
        "key": key,
        "plan": plan,
        # A plan has its own.
        "n_photons": photons if plan is None else None,
        "n_rays": rays if plan is None else None,
        "max_orders": max_orders,
        "solver": solver,
        "max_steps": max_steps,
        "starts": starts,
    }
    sizes = {"max_orders": max_orders, "photons": photons, "rays": rays}
    plan = plan_within(plan, lidars[0], scenes[0], settled[0], axis, **sizes)

    how = (plan, solver, max_steps, starts, Lanes.of(min(lanes, len(y))))
    job = Job(range(len(y)), data, lidars, scenes, settled, extra, recorders, *how)
    frame = Frame(len(y), sum(s.start.size for s in names), y.shape[1:], len(smooth_names(names)))
    with kept_fits(path, {} if path is None else fingerprint(parts), frame) as kept:
        ended = kept.rows
        todo = [i for i in range(len(y)) if i not in ended]
        here = executor is None
        for i, row in fits(job, key, todo) if here else fits_by(executor, job, key, todo):
            kept.add(i, row)
            if progress is not None:
                progress(Progress(len(ended), len(y), sum(r.converged for r in ended.values())))
    return _gathered([ended[i] for i in range(len(y))], names)


def _gathered(rows: list[Row], names: list[Settled]) -> Retrievals:
    """The results from those of all footprints."""

    def stack(pick: Callable[[Row], np.ndarray]) -> np.ndarray:
        return np.stack([pick(r) for r in rows])

    return Retrievals(
        values=named(stack(lambda r: r.values), names),
        stderr=named(stack(lambda r: r.stderr), names),
        robust_stderr=named(stack(lambda r: r.robust_stderr), names),
        prior_share=named(stack(lambda r: r.prior_share), names),
        at_bound=named(stack(lambda r: r.at_bound), names),
        covariance=stack(lambda r: r.covariance),
        reduced_chi2=np.array([r.reduced_chi2 for r in rows]),
        second_minimum=np.array([r.second_minimum for r in rows]),
        independent_samples=np.array([r.independent_samples for r in rows]),
        averaging=stack(lambda r: r.averaging),
        strength=dict(zip(smooth_names(names), stack(lambda r: r.strength).T)),
        bounds=bounds_of(names),
        converged=np.array([r.converged for r in rows]),
        steps=np.array([r.steps for r in rows]),
        fitted=stack(lambda r: r.fitted),
        status=tuple(r.status for r in rows),
        labels=labels_of(names),
    )


def _parts_of(settled: list[list[Settled]]) -> dict[str, Any]:
    """What fits depend on of the unknowns, by name: those of the first footprint, and the starts of all."""
    parts: dict[str, Any] = {"unknowns": [s.name for s in settled[0]]}
    for s, *others in zip(*settled):
        parts[f"place of {s.name!r}"] = s.place
        parts[f"bounds of {s.name!r}"] = s.low, s.high
        parts[f"prior of {s.name!r}"] = (s.prior, s.log_prior) if s.smooth is None else s.smooth
        parts[f"start of {s.name!r}"] = [s.start, *(other.start for other in others)]
    return parts


def _started(settled: list[list[Settled]], start: Mapping[str, Any], count: int) -> list[list[Settled]]:
    """The unknowns of every footprint, with its own starting values; one list where all are the same."""
    check_kind("start", start, Mapping, "a mapping from names of unknowns to values")
    shapes = {s.name: s.start.shape for s in settled[0]}
    given = {}
    for name, values in start.items():
        if name not in shapes:
            raise ValueError(f"start has {name!r}; admissible are {', '.join(map(repr, shapes))}")
        given[name] = numbers(f"start of {name!r}", values)
        if given[name].shape != (count, *shapes[name]):
            raise ValueError(
                f"start of {name!r} has the shape {given[name].shape}; admissible is {(count, *shapes[name])}"
            )
    if not given:
        return settled
    return [
        [
            start_from(s, jnp.asarray(given[s.name][i], s.start.dtype)) if s.name in given else s
            for s in settled[i % len(settled)]
        ]
        for i in range(count)
    ]


def _one_each(field: str, given: Any, kind: type, count: int) -> list[Any]:
    """One for all footprints, or one for each. **Raises:** as `retrieve_many`."""
    if isinstance(given, kind):
        return [given]
    check_kind(field, given, Sequence, f"one {kind.__name__}, or a sequence of one for each footprint")
    given = list(given)
    if len(given) != count:
        raise ValueError(f"{field} has {len(given)} elements; admissible is one, or {count} as observed")
    for i, other in enumerate(given):
        check_kind(f"{field} {i}", other, kind, f"a {kind.__name__}")
    shape = jax.tree.map(jnp.shape, given[0])
    for i, other in enumerate(given):
        same = jax.tree.structure(other) == jax.tree.structure(given[0])
        if not same or jax.tree.map(jnp.shape, other) != shape:
            raise ValueError(f"{field} {i} differs from the first in more than the values of its arrays")
    return given
