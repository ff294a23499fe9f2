"""Retrieval from many waveforms: footprints are simulated together, and each is fitted on its own.

Fits run side by side in lanes. The simulations that they request are gathered, run in one compiled call, and
sent back. A lane whose fit has ended takes the next footprint. A fit that fails is marked as such and does
not affect the others.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from jaxlidar import Lidar, Plan, Scene
from jaxlidar.extend import ONE_CORE, check_range, side_by_side
from jaxlidar.planning.plan import MIN_BATCHES

from .checkpoint import Kept, Row, fingerprint, row_of
from .data import data_of
from .fit import Fitting, Request, best_of, labels_of, named
from .model import Evaluation, Model, Problem, evaluate
from .planning import check_samples, plan_for
from .retrieval import SOLVER, fits_from, scale_of
from .unknowns import Settled, Unknown, settle, start_from


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
class Retrievals(eqx.Module):
    """The results of `retrieve_many`: one fit per footprint, in the order given.

    Arrays have a leading axis `footprints`. The quantities are those of `Retrieval`.

    - `values`: by name, (footprints, ...) best values.
    - `stderr`: by name, (footprints, ...) one standard error; infinite where the data do not constrain the
      unknown.
    - `covariance`: (footprints, n, n).
    - `reduced_chi2`: (footprints,).
    - `converged`: (footprints,) whether the fit ended at a minimum.
    - `steps`: (footprints,) waveforms simulated, each with its Jacobian.
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
    covariance: Float[np.ndarray, "footprints n n"]
    reduced_chi2: Float[np.ndarray, " footprints"]
    converged: Bool[np.ndarray, " footprints"]
    steps: Int[np.ndarray, " footprints"]
    fitted: Float[np.ndarray, "footprints wavelengths bins"]
    status: tuple[str, ...] = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)

    def to_xarray(self) -> Any:
        """The results as an `xarray.Dataset` over the dimension `footprint`.

        **Returns:** an `xarray.Dataset` with a variable for each unknown, "... stderr" for its standard
        error, and `reduced_chi2`, `converged`, `steps`, `status` and `fitted`.

        **Raises:** ImportError where xarray is not installed.
        """
        import xarray

        def variable(name: str, array: np.ndarray) -> tuple:
            return (("footprint", *(f"{name} {i}" for i in range(array.ndim - 1))), array)

        columns = {name: variable(name, v) for name, v in self.values.items()}
        columns |= {f"{name} stderr": variable(name, v) for name, v in self.stderr.items()}
        columns |= {
            "reduced_chi2": ("footprint", self.reduced_chi2),
            "converged": ("footprint", self.converged),
            "steps": ("footprint", self.steps),
            "status": ("footprint", np.array(self.status, dtype=object)),
            "fitted": (("footprint", "wavelength", "bin"), self.fitted),
        }
        return xarray.Dataset(columns)


def retrieve_many(
    observed: ArrayLike,
    lidar: Lidar | Sequence[Lidar],
    scene: Scene | Sequence[Scene],
    unknowns: Sequence[Unknown],
    *,
    noise: ArrayLike,
    time: ArrayLike,
    key: PRNGKeyArray,
    plan: Plan | None = None,
    n_photons: float = 65536,
    n_rays: float = 8192,
    max_orders: int | None = None,
    solver: optx.AbstractLeastSquaresSolver = SOLVER,
    max_steps: float = 50,
    starts: float = 1,
    start: Mapping[str, ArrayLike] | None = None,
    scale: tuple[float, float] | None = None,
    noise_floor: float = 1e-3,
    lanes: int = 16,
    path: str | os.PathLike[str] | None = None,
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
    - `plan`: one for all footprints. Default None: made for the first lidar and scene and the corners of the
      bounds.
    - `start`: by name, (footprints, ...) values that unknowns start from. Default None: their own.
    - `lanes`: number of footprints simulated together, at least 1; memory grows with it. Default 16.
    - `path`: an .npz file, the checkpoint of finished fits. Where it exists, the fits in it are not repeated.
      It is written after every few fits, and when interrupted. It belongs to `observed`, `noise` and the
      names and bounds of the unknowns; changes of other arguments are not noticed. Default None: no file.
    - `progress`: called with a `Progress` after every fit.

    **Returns:** a `Retrievals`.

    **Raises:** ValueError for inadmissible arguments, and for a `path` that is damaged or belongs to other
    footprints, noise, bounds or unknowns.

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
    y = np.asarray(observed, float)
    if y.ndim != 3 or len(y) == 0:
        raise ValueError(f"observed has the shape {y.shape}; admissible is (footprints, wavelengths, bins)")
    try:
        sigma = np.broadcast_to(np.asarray(noise, float), y.shape)
    except ValueError:
        raise ValueError(
            f"noise has the shape {np.shape(noise)}, which does not broadcast to {y.shape}"
        ) from None
    check_range("lanes", lanes, 1)
    check_range("starts", starts, 1)
    lidars = [_fixed(a) for a in _one_each("lidar", lidar, len(y))]
    scenes = _one_each("scene", scene, len(y))
    settled = _started([settle(unknowns, s) for s in scenes], start or {}, len(y))
    data = [data_of(y[i], time, sigma[i], noise_floor, lidars[i % len(lidars)]) for i in range(len(y))]
    if plan is None:
        plan = plan_for(
            lidars[0],
            scenes[0],
            settled[0],
            data[0].time,
            max_orders=max_orders,
            photons=int(n_photons) // MIN_BATCHES,
            rays=int(n_rays) // MIN_BATCHES,
        )
    check_samples(plan, data[0].time)
    extra = [] if scale is None else [scale_of(scale, settled[0])]

    def fitting(i: int) -> Fitting:
        own = [*settled[i % len(settled)], *extra]
        fits = fits_from(
            int(starts), jax.random.fold_in(key, i), data[i], own, bool(extra), solver, int(max_steps), None
        )
        return best_of(fits)

    names = [*settled[0], *extra]
    kept = Kept(path, fingerprint(y, sigma, names))
    simulate = _Simulator(lidars, scenes, plan, settled[0], key, min(int(lanes), len(y)))
    ended: dict[int, Row] = kept.rows
    todo = [i for i in range(len(y)) if i not in ended]
    running: dict[int, tuple[Fitting, Request]] = {}
    try:
        while todo or running:
            while todo and len(running) < simulate.lanes:
                i = todo.pop(0)
                fit = fitting(i)
                running[i] = fit, next(fit)
            found = simulate({i: request for i, (_, request) in running.items()})
            for i, evaluation in found.items():
                fit = running[i][0]
                try:
                    running[i] = fit, fit.send(evaluation)
                except StopIteration as end:
                    del running[i]
                    ended[i] = row_of(end.value)
                    if progress is not None:
                        progress(Progress(len(ended), len(y), sum(r.converged for r in ended.values())))
                    if len(ended) % max(simulate.lanes, 16) == 0:
                        kept.write()
    finally:
        kept.write()
    rows = [ended[i] for i in range(len(y))]
    stack = lambda pick: np.stack([pick(r) for r in rows])  # noqa: E731
    return Retrievals(
        values=named(stack(lambda r: r.values), names),
        stderr=named(stack(lambda r: r.stderr), names),
        covariance=stack(lambda r: r.covariance),
        reduced_chi2=np.array([r.reduced_chi2 for r in rows]),
        converged=np.array([r.converged for r in rows]),
        steps=np.array([r.steps for r in rows]),
        fitted=stack(lambda r: r.fitted),
        status=tuple(r.status for r in rows),
        labels=labels_of(names),
    )


def _started(settled: list[list[Settled]], start: Mapping[str, ArrayLike], count: int) -> list[list[Settled]]:
    """The unknowns of every footprint, with its own starting values; one list where all are the same."""
    shapes = {s.name: s.start.shape for s in settled[0]}
    given = {}
    for name, values in start.items():
        if name not in shapes:
            raise ValueError(f"start has {name!r}; admissible are {', '.join(map(repr, shapes))}")
        given[name] = np.asarray(values, float)
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


def _fixed(lidar: Lidar) -> Lidar:
    # Samples lie at the given times, whatever opened the recording window.
    return dataclasses.replace(lidar, receiver=dataclasses.replace(lidar.receiver, window="fixed"))


def _one_each(field: str, given: Any, count: int) -> list[Any]:
    if isinstance(given, Lidar | Scene):
        return [given]
    given = list(given)
    if len(given) != count:
        raise ValueError(f"{field} has {len(given)} elements; admissible is one, or {count} as observed")
    shape = jax.tree.map(jnp.shape, given[0])
    for i, other in enumerate(given):
        same = jax.tree.structure(other) == jax.tree.structure(given[0])
        if not same or jax.tree.map(jnp.shape, other) != shape:
            raise ValueError(f"{field} {i} differs from the first in more than the values of its arrays")
    return given


class _Simulator:
    """Simulates the requests of all lanes in one compiled call; several threads share the lanes."""

    def __init__(
        self,
        lidars: list[Lidar],
        scenes: list[Scene],
        plan: Plan,
        settled: list[Settled],
        key: PRNGKeyArray,
        lanes: int,
    ):
        self.model = Model(lidars[0], scenes[0], plan, settled, key)
        self.threads = min(max(os.cpu_count() or 1, 1), lanes)
        self.each = -(-lanes // self.threads)
        self.lanes = self.each * self.threads
        self.lidars, self.scenes = lidars, scenes

    def __call__(self, requests: dict[int, Request]) -> dict[int, Evaluation]:
        numbers = list(requests)
        groups = [numbers[i : i + self.each] for i in range(0, len(numbers), self.each)]
        found: dict[int, Evaluation] = {}
        with side_by_side(self.threads) as run:
            for more in run(lambda group: self._group(group, requests), groups):
                found |= more
        return found

    def _group(self, group: list[int], requests: dict[int, Request]) -> dict[int, Evaluation]:
        # The compiled call has a fixed number of lanes: idle ones repeat the last.
        padded = [*group, *[group[-1]] * (self.each - len(group))]
        values = jax.tree.map(
            lambda *a: jnp.stack(a), *(self.model.values(requests[i].values) for i in padded)
        )
        lidar, scene = _stacked(self.lidars, padded), _stacked(self.scenes, padded)
        model = self.model
        problem = dataclasses.replace(model.problem, lidar=lidar, scene=scene)
        own = Own(len(self.lidars) > 1, len(self.scenes) > 1)
        out = _simulate(problem, values, jnp.stack(model.keys), own)
        total, columns, batches = (np.asarray(a, float) for a in out)
        return {
            i: Evaluation(
                total[n],
                np.moveaxis(columns[n][model.order], 0, -1),
                None,
                batches[n] if model.problem.plan.is_random else None,
            )
            for n, i in enumerate(group)
        }


def _stacked(given: list[Any], numbers: list[int]) -> Any:
    if len(given) == 1:
        return given[0]
    dynamic, static = zip(*(eqx.partition(given[i], eqx.is_array) for i in numbers))
    return eqx.combine(jax.tree.map(lambda *a: jnp.stack(a), *dynamic), static[0])


class Own(NamedTuple):
    """Whether every footprint has a lidar, or a scene, of its own."""

    lidar: bool
    scene: bool


@eqx.filter_jit(**ONE_CORE)
def _simulate(problem: Problem, values: Any, keys: Array, own: Own) -> tuple[Array, Array, Array]:
    lidar, fixed_lidar = eqx.partition(problem.lidar, eqx.is_array)
    scene, fixed_scene = eqx.partition(problem.scene, eqx.is_array)

    def one(lidar: Lidar, scene: Scene, values: Any) -> tuple[Array, Array, Array]:
        lidar, scene = eqx.combine(lidar, fixed_lidar), eqx.combine(scene, fixed_scene)
        return evaluate(dataclasses.replace(problem, lidar=lidar, scene=scene), values, keys)

    if problem.plan.orders == 1:
        axes = (0 if own.lidar else None, 0 if own.scene else None, 0)
        return jax.vmap(one, in_axes=axes)(lidar, scene, values)

    # Batched with vmap, every lane would be traced until the photons of the slowest have ended.
    def in_turn(each: tuple) -> tuple[Array, Array, Array]:
        return one(each[0] if own.lidar else lidar, each[1] if own.scene else scene, each[2])

    mapped = (lidar if own.lidar else None, scene if own.scene else None, values)
    return jax.lax.map(in_turn, mapped)
