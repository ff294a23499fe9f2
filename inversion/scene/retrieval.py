r"""Retrieval of a scene from many records at once: tomography of leaf area, terrain, rasters, gains.

**Objective.** With records y_i of noise sigma, their simulation m_i(x) (`inversion.scene.survey_model`) and
the priors p(x) of all unknowns (`inversion.scene.map_priors`), within the bounds of x,

    f(x) = 1/2 sum over fitted shots of |(m_i(x) - y_i) / sigma|^2 - ln p(x)

is minimised by L-BFGS-B (Byrd et al. 1995), which takes gradients and bounds, and needs memory for some
twenty vectors. Unknowns are scaled by the inverse root of the diagonal of the Gauss-Newton matrix at the
start, as their curvatures differ by orders of magnitude: upper voxels see more light than lower ones.

**Stopping.** Records do not determine a hundred thousand voxels, and a fit that goes on begins to reproduce
their noise. A part of the shots is held out: their misfit falls while the fit learns about the scene, and
rises again. The fit stops when it has not fallen for some steps, and its result is the best of them
(early stopping, a form of regularisation; Hansen 2010, section 6). Where shots have gains or offsets of their
own, those of held-out shots are the best ones for their records.

**Errors.** With the Jacobian J at the result, whitened, and the residuals r of the priors with their Jacobian
R, the Gauss-Newton matrix of the posterior is H = J^T J + R^T R + D. D = 12 / (width of the bounds)^2 is what
bounds say of an unknown by themselves. For independent unit normal numbers e,

    z = H^-1 (J^T e_1 + R^T e_2 + D^(1/2) e_3)

has the covariance H^-1: a few such draws estimate the standard error of every value and of every sum of
values (Papandreou and Yuille 2010; Bardsley et al. 2014, "randomise then optimise"). They need no matrix but
products with H: each is solved by conjugate gradients.

**Averaging kernel.** A value at its bound stays there when the truth changes a little, and the others are
fitted with it held: its row is zero, and that of a free value k is e_k^T (H_FF)^-1 (J^T J)_F, with the free
values F, from one more solution. Standard errors are those without bounds, as in `inversion.fit.uncertainty`.

**Source:** Byrd, Lu, Nocedal and Zhu (1995), SIAM J. Sci. Comput. 16, 1190; diagonal by random signs: Bekas,
Kokiopoulou and Saad (2007), Appl. Numer. Math. 57, 1214; Hansen (2010), Discrete Inverse Problems; Papandreou
and Yuille (2010), NeurIPS 23; Bardsley et al. (2014), SIAM J. Sci. Comput. 36, A1895.
"""

import contextlib
import dataclasses
import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import ArrayLike, Bool, Float, Int, PRNGKeyArray

from inversion.fit.data import as_positive_noise, as_sample_times, with_fixed_window
from inversion.fit.planning import N_BATCHES, plan_for_bounds
from inversion.fit.unknowns import (
    BoundUnknown,
    Unknown,
    bind_unknowns,
    bounds_by_name,
    flat_bounds,
    flat_start,
    split_by_name,
    unknown_outside_scene,
)
from inversion.receiver.recorder import bound_pair
from inversion.scene.map_priors import MapPriors
from inversion.scene.scene_retrieval import SceneRetrieval
from inversion.scene.survey_model import Pulled, ShotGroups, SurveyModel
from jaxlidar import Plan, Scene, Survey, Waveforms
from jaxlidar.extend import (
    as_numpy,
    check_integer,
    check_key,
    check_kind,
    check_kinds,
    check_number,
    check_range,
    fingerprint,
)
from jaxlidar.progress import ProgressOption, shows_progress
from jaxlidar.results.netcdf import store_result
from jaxlidar.results.store import ResultStore, dataset_of_rows, open_store

# Rays of a footprint unless they are given: one for each column of voxels in it, within limits; photons.
_RAYS, _PHOTONS = (32, 512), 2048
# A fit stops when the held-out misfit (or the objective) has not fallen by this fraction in this many steps.
_LEAST_GAIN, _PATIENCE = 1e-3, 10
# Pairs of steps and gradients that L-BFGS-B keeps; draws of the diagonal that scales the unknowns.
_MEMORY, _SCALE_DRAWS = 20, 4
# Conjugate gradients of a draw of the error: most steps, and relative residual.
_CG_STEPS, _CG_RTOL = 40, 0.03
# A value nearer to a bound than this fraction of their width is at the bound.
_BOUND_MARGIN = 1e-6
# Standard deviations of a log-normal prior below its median at which a bound of zero is moved.
_LOG_REACH = 8.0


@dataclasses.dataclass(frozen=True)
class SceneStep:
    """Progress of `retrieve_scene`.

    - `stage`: "fit", "errors" or "averaging kernels". - `number`: of the step, draw or kernel, from 1 on.
    - `misfit`: chi-squared of the fitted shots over their number of samples; `held_out_misfit`: that of the
      shots held out, NaN if there are none. One means a misfit like the noise.

    **Example:**

    >>> import inversion
    >>> from inversion.scene.retrieval import SceneStep
    >>> print(SceneStep(stage="fit", number=3, misfit=1.31, held_out_misfit=1.42))
    fit 3: misfit 1.31, held out 1.42
    """

    stage: str
    number: int
    misfit: float
    held_out_misfit: float

    def __str__(self) -> str:
        held_out = "" if np.isnan(self.held_out_misfit) else f", held out {self.held_out_misfit:.4g}"
        return f"{self.stage} {self.number}: misfit {self.misfit:.4g}{held_out}"


@shows_progress
def retrieve_scene(
    waveforms: Waveforms | ArrayLike | Sequence,
    survey: Survey,
    scene: Scene,
    unknowns: Sequence[Unknown],
    *,
    noise: ArrayLike | Sequence,
    key: PRNGKeyArray,
    time: ArrayLike | Sequence | None = None,
    gain: tuple[float, float] | None = None,
    offset: tuple[float, float] | None = None,
    groups: ArrayLike | Sequence | None = None,
    held_out: float = 0.1,
    max_steps: int = 100,
    draws: int = 8,
    kernels: Mapping[str, Sequence] | None = None,
    plan: Plan | None = None,
    max_orders: int | None = None,
    n_rays: int | None = None,
    n_photons: int | None = None,
    path: str | os.PathLike[str] | None = None,
    progress: ProgressOption = None,
) -> SceneRetrieval:
    """Retrieve one scene from the records of all shots of a survey together.

    Unknowns are of the scene, such as the leaf area density of every voxel, the height of every node of a
    terrain, a raster of reflectance, or leaf chemistry of each stratum, and of groups of shots: gains and
    offsets. Gradients with respect to all voxels cost a few simulations, however many voxels there are; an
    empty voxel has one, too, so that leaves can appear where there were none.

    **What is determined.** A footprint averages over its own width: detail below it comes from footprints
    that overlap, with noise that grows quickly as detail becomes finer, and from the priors. Leaves in clumps
    smaller than a footprint, such as crowns, let more light through than the same leaves spread evenly, and
    records of wide footprints do not tell the two apart: with a smooth prior the result is the effective leaf
    area, which may be half of the true one; state clumps by `clumped_leaves` where you know them. Standard
    errors and draws do not contain this, and the misfit does not show it. The shape of the
    profile suffers less. Little light comes from below dense leaves. Waveforms determine the product of area
    and reflectance better than either: keep leaf and ground reflectance fixed or give them priors; and a free
    gain is the same as a common factor of all reflectances. Look at `stderr`, at the kernels of some places
    (`kernels=`), and at the draws for sums. Standard errors are those of a linear approximation within a
    Gaussian posterior; they do not know of errors of the model (positions of footprints, leaf angles, orders
    beyond `max_orders`), nor of the simulation's own noise: use more rays and photons until the result no
    longer changes.

    **Arguments:**

    - `waveforms`: a `Waveforms`, whose `reflectance` is used, or an array (shots, wavelengths, samples) of
      apparent reflectance, up to the `gain` and the `offset`; then give `time`.
    - `survey`: the `Survey`, with one shot for each record.
    - `scene`: the scene; unknowns start from its values.
    - `unknowns`: a sequence of `Unknown`. Give maps a `MarkovField` as prior, or leaves `clumped_leaves`.
    - `noise`: one standard deviation of `waveforms`, in (0, inf], anything that broadcasts to them. Infinity
      leaves a sample out.
    - `key`: a JAX random key, for the simulation, the choice of the shots held out, and errors.
    - `time`: (samples,) ns, with an array. Default None: those of the `Waveforms`.
    - `gain`: bounds (low, high), positive, of an unknown factor of the simulated records, one for each group.
      Default None: 1.
    - `offset`: bounds (low, high) of an unknown number that is added, one for each group. Default None: 0.
    - `groups`: (shots,) whole numbers from 0 on, group of each shot. Default None: each shot is its own
      group.
    - `held_out`: fraction of the shots that are not fitted, in [0, 1); with 0 the fit runs until the
      objective no longer falls. Default 0.1.
    - `max_steps`: largest number of steps of the fit, at least 1. Default 100.
    - `draws`: number of draws of the error, from which `stderr` is computed, with a relative error of 1 /
      sqrt(2 draws); 0 for none (`stderr` is NaN). A draw takes up to 40 products with the Gauss-Newton
      matrix. Default 8.
    - `kernels`: by name of unknown, indices of values for which rows of the averaging kernel are computed,
      such as `{"leaf": [(5, 5, 3)]}`; each takes as long as a draw. Default None: none.
    - `plan`: a `Plan` for the survey. Default None: made here, for the bounds of the unknowns.
    - `max_orders`: follow light for this many scatterings, at least 1. Default None: as many as the
      start needs.
    - `n_rays`, `n_photons`: rays and photons of the simulation of a shot, which is one batch. Default None: a
      ray for each column of voxels in a footprint, within 32 and 512; 2048 photons.
    - `path`: a Zarr store, whose name ends in ".zarr". A run that was interrupted goes on from its last step,
      draw or kernel. Only `progress` may change. Default None: no store.
    - `progress`: True for a bar with the latest step; or a function called with a `SceneStep` after every
      step. Default None: silent.

    **Returns:** a `SceneRetrieval`.

    **Raises:** ValueError for inadmissible arguments, as `retrieve` does, and for a `path` that is no Zarr
    store or one of another problem; TypeError for arguments of another kind; OSError for a `path` that
    cannot be written.

    **Example:** the height of the ground, the same under nine footprints.

    >>> import jax, jaxlidar as jl, inversion
    >>> survey = jl.Survey.grid(jl.Lidar(), (0, 0), (20, 20), 10.0)
    >>> waves = jl.simulate_many(survey, jl.Scene(ground=jl.Ground(height=0.5)), key=jax.random.key(0))
    >>> height = inversion.Unknown("ground.height", bounds=(-2.0, 2.0), name="height")
    >>> start = jl.Scene(ground=jl.Ground())
    >>> fit = inversion.retrieve_scene(waves, survey, start, [height], noise=0.001, key=jax.random.key(1))
    >>> print(f"{float(fit.values['height']):.2f} m from {len(fit.fitted)} records")
    0.50 m from 9 records
    """
    check_kind("survey", survey, Survey, "a Survey, as in Survey(lidar, position=...)")
    check_kinds(survey.lidar, scene)
    check_key(key)
    check_kind("path", path, str | os.PathLike | None, "a path, or None")
    check_kind("kernels", kernels, Mapping | None, "a mapping from names of unknowns to indices, or None")
    check_number("held_out", held_out, 0.0, 1.0, high_open=True)
    max_steps, draws = check_integer("max_steps", max_steps), check_integer("draws", draws, 0)
    survey = _with_fixed_window(survey)
    records = _observed_records(waveforms, time, noise, survey)
    bound = bind_unknowns(unknowns, scene, of_maps=True)
    shot_groups = _shot_groups(gain, offset, groups, len(survey), bound)
    places = _kernel_places({} if kernels is None else kernels, bound)
    sizes = {"max_orders": max_orders, "n_rays": n_rays, "n_photons": n_photons}
    # Everything that the result depends on: a store of another problem is refused.
    parts = {
        "waveforms": records.observed,
        "noise": records.sigma,
        "time": records.time,
        "survey": survey,
        "scene": scene,
        "unknowns": [u._asdict() for u in [*bound, *shot_groups.unknowns]],
        "groups": shot_groups.group,
        "held_out": float(held_out),
        "max_steps": max_steps,
        "draws": draws,
        "kernels": places,
        "key": key,
        "plan": plan,
        **sizes,
    }
    if plan is None:
        plan = plan_for_bounds(survey, scene, bound, records.time, **_plan_arguments(survey, scene, **sizes))
    elif any(value is not None for value in sizes.values()):
        raise ValueError("plan is given together with max_orders, n_rays or n_photons; admissible is either")
    # The host draws shots to hold out and signs; their numbers must not be those of the light.
    trace_key, host_key = jax.random.split(key)
    random = np.random.default_rng(np.asarray(jax.random.key_data(host_key)).ravel())
    is_held_out = _choose_held_out(len(survey), float(held_out), random)
    # Infinite noise leaves a sample out, and a weight of zero leaves out a shot, with no second code path.
    weight = np.where(np.isfinite(records.sigma), 1.0 / records.sigma, 0.0)
    fitted_weight = np.where(is_held_out[:, None, None], 0.0, weight)
    model = SurveyModel(survey, scene, plan, bound, shot_groups, records.observed, fitted_weight, trace_key)
    problem = _Problem(model, MapPriors(model.all_unknowns), records.observed, weight, is_held_out)
    n_kernels = sum(len(indices) for indices in places.values())
    no_store = contextlib.nullcontext()
    with no_store if path is None else open_store(path, fingerprint(parts)) as store:
        steps, stored_draws, stored_kernels = (
            _StoredSteps(store, *sizes_of_group)
            for sizes_of_group in (("steps", max_steps), ("draws", draws), ("kernels", n_kernels))
        )
        end = _fit(problem, max_steps, random, steps, progress)
        errors = _draws_of_error(problem, end, draws, host_key, stored_draws, progress)
        rows = _averaging_kernels(problem, end, places, stored_kernels, progress)
        x, fitted = end.evaluation.x, end.evaluation.pulled.records
        flat_quantities = {
            "values": x,
            "stderr": np.sqrt(np.mean(errors**2, axis=0)) if draws else np.full(x.size, np.nan),
            "draws": errors,
            "at_bound": ~problem.is_free(x),
        }
        by_name = {n: split_by_name(a, model.all_unknowns) for n, a in flat_quantities.items()}
        quantities = {
            **by_name,
            "averaging": rows,
            "places": places,
            "bounds": bounds_by_name(model.all_unknowns),
            "time": records.time,
            "wavelength": survey.lidar.wavelength,
            "fitted": fitted,
            "residuals": (records.observed - fitted) * weight,
            "held_out": is_held_out,
            "misfit": end.evaluation.misfit,
            "held_out_misfit": end.evaluation.held_out_misfit,
            "history": end.history,
        }
        result = SceneRetrieval(
            **jax.tree.map(jnp.asarray, quantities),
            scene=model.scene_at(x),
            converged=end.converged,
            status=end.status,
        )
        if store is not None:
            store_result(store, result)
    return result


# -- arguments ---------------------------------------------------------------------------------------------


class _CheckedRecords(NamedTuple):
    """Records and their noise, (shots, wavelengths, samples) each, and the (samples,) times, ns."""

    observed: np.ndarray
    sigma: np.ndarray
    time: np.ndarray


def _with_fixed_window(survey: Survey) -> Survey:
    """Return the survey with a fixed recording window: the samples of records lie at known times."""
    lidar = with_fixed_window(survey.lidar)
    return survey if lidar is survey.lidar else dataclasses.replace(survey, lidar=lidar)


def _observed_records(waveforms: Any, time: Any, noise: Any, survey: Survey) -> _CheckedRecords:
    """Check records, their times and their noise. **Raises:** as `retrieve_scene`."""
    if isinstance(waveforms, Waveforms):
        if time is not None:
            raise ValueError("time is given with Waveforms, which have times; admissible is None")
        time, waveforms = waveforms.time, waveforms.reflectance
    elif time is None:
        raise ValueError("time = None, but waveforms is an array: its sample times are needed")
    times = as_sample_times(time, survey.lidar)
    observed = as_numpy(waveforms, "waveforms")
    shape = (len(survey), survey.lidar.wavelength.size, times.size)
    if observed.shape != shape:
        raise ValueError(
            f"waveforms has the shape {observed.shape}; admissible is (shots, wavelengths, samples) = {shape}"
        )
    sigma = as_positive_noise(noise, shape)
    is_used = np.isfinite(sigma)
    if not np.any(is_used):
        raise ValueError("noise is infinite throughout, which leaves no sample to fit")
    check_range("waveforms", observed[is_used])
    # Samples that are left out may be NaN, which a weight of zero would not remove.
    return _CheckedRecords(np.where(is_used, observed, 0.0), sigma, times)


def _shot_groups(
    gain: Any, offset: Any, groups: Any, shots: int, unknowns: Sequence[BoundUnknown]
) -> ShotGroups:
    """Return the gains and offsets of groups of shots. **Raises:** as `retrieve_scene`."""
    # Without groups each shot is one of its own.
    numbers = np.arange(shots) if groups is None else as_numpy(groups, "groups")
    if numbers.shape != (shots,):
        raise ValueError(f"groups has the shape {numbers.shape}; admissible is (shots,) = ({shots},)")
    if np.any(numbers != np.floor(numbers)) or np.any(numbers < 0):
        raise ValueError("groups has values that are no whole numbers from 0 on")
    group = numbers.astype(int)
    n_groups = int(group.max()) + 1

    def unknown(name: str, bounds: Any, start: float, least: float) -> BoundUnknown | None:
        if bounds is None:
            return None
        pair = bound_pair(name, bounds, least)
        if name in [u.name for u in unknowns]:
            raise ValueError(f"name = {name!r} is given to an unknown; with {name} = ... it is that of shots")
        # No gain and no offset is the natural start, where the bounds admit it.
        return unknown_outside_scene(name, pair, (n_groups,), float(np.clip(start, *pair)))

    return ShotGroups(group, unknown("gain", gain, 1.0, 0.0), unknown("offset", offset, 0.0, -np.inf))


def _kernel_places(
    kernels: Mapping[str, Sequence], unknowns: Sequence[BoundUnknown]
) -> dict[str, Int[np.ndarray, "places axes"]]:
    """Return the indices of values whose averaging kernels are wanted. **Raises:** as `retrieve_scene`."""
    shapes = {u.name: u.start.shape for u in unknowns}
    places = {}
    for name, indices in kernels.items():
        if name not in shapes:
            raise ValueError(f"kernels has {name!r}; admissible are {', '.join(map(repr, shapes))}")
        places[name] = np.array(indices, int).reshape(-1, len(shapes[name]))
        for index in places[name]:
            if np.any(index < 0) or np.any(index >= shapes[name]):
                raise ValueError(
                    f"kernels of {name!r} has the index {tuple(index.tolist())}; admissible are those of an "
                    f"array of the shape {shapes[name]}"
                )
    return places


def _choose_held_out(shots: int, fraction: float, random: np.random.Generator) -> Bool[np.ndarray, " shots"]:
    """Choose the shots that are not fitted: one at least, if any, and never all."""
    is_held_out = np.zeros(shots, bool)
    # Fractions of few shots round to none or all of them.
    count = min(max(round(fraction * shots), 1), shots - 1) if fraction > 0 else 0
    is_held_out[random.permutation(shots)[:count]] = True
    return is_held_out


def _plan_arguments(
    survey: Survey, scene: Scene, max_orders: int | None, n_rays: int | None, n_photons: int | None
) -> dict[str, Any]:
    """Return the arguments of `plan` for a shot, whose simulation is one batch. **Raises:** ValueError."""
    photons = _PHOTONS if n_photons is None else check_integer("n_photons", n_photons)
    rays = _rays(survey, scene) if n_rays is None else check_integer("n_rays", n_rays)
    # Plans count the photons of eight batches.
    return {"n_photons": N_BATCHES * photons, "n_rays": rays, "max_orders": max_orders}


def _rays(survey: Survey, scene: Scene) -> int:
    """Return the number of rays of a shot: a power of two of about the columns of voxels in a footprint."""
    if scene.canopy is None:
        return _RAYS[1]
    edge = float(np.min(np.asarray(scene.canopy.voxels.voxel_size)[:2]))
    # Rays are spread over the footprint by a lattice: one for each column meets every voxel of the map.
    columns = (1.0 + 2.0 * float(np.max(survey.footprint_radius)) / edge) ** 2
    return int(np.clip(2 ** np.ceil(np.log2(columns)), *_RAYS))


# -- fit ---------------------------------------------------------------------------------------------------


class _Evaluation(NamedTuple):
    """The objective at some values: its gradient, and the misfits of fitted and of held-out shots."""

    x: np.ndarray
    objective: float
    gradient: np.ndarray
    pulled: Pulled
    misfit: float
    held_out_misfit: float


class _Problem:
    """Objective of a fit, its scaling, and the Gauss-Newton matrix of its posterior."""

    def __init__(
        self,
        model: SurveyModel,
        priors: MapPriors,
        observed: np.ndarray,
        weight: np.ndarray,
        is_held_out: Bool[np.ndarray, " shots"],
    ):
        self.model, self.priors = model, priors
        self.observed, self.weight, self.is_held_out = observed, weight, is_held_out
        self.low, self.high = flat_bounds(model.all_unknowns)
        # At zero a log-normal prior has no density, and its logarithm no number.
        medians_low = [
            np.exp(u.prior[0] - _LOG_REACH * u.prior[1]).ravel()
            if u.is_log_prior and u.prior is not None
            else u.low.ravel()
            for u in model.all_unknowns
        ]
        self.low = np.minimum(np.maximum(self.low, np.concatenate(medians_low)), self.high)
        # That of a uniform distribution between the bounds: H is then regular whatever the data determine.
        self.bounds_precision = 12.0 / (self.high - self.low) ** 2

    def evaluate(self, x: Float[np.ndarray, " n"]) -> _Evaluation:
        """Evaluate the objective and its gradient."""
        pulled = self.model.gradient(x)
        squares = ((pulled.records - self.observed) * self.model.weight) ** 2
        prior_cost, prior_gradient = self.priors.cost_and_gradient(x)
        objective = 0.5 * float(np.sum(squares)) + prior_cost
        # Weights are zero for held-out shots, so that squares are those of fitted shots alone.
        n_fitted = max(int(np.sum(self.model.weight > 0)), 1)
        return _Evaluation(
            np.array(x),
            objective,
            pulled.gradient + prior_gradient,
            pulled,
            float(np.sum(squares)) / n_fitted,
            self._held_out_misfit(pulled),
        )

    def _held_out_misfit(self, pulled: Pulled) -> float:
        """Return chi-squared of the held-out shots over their number of samples."""
        if not np.any(self.is_held_out):
            return float("nan")
        w, y = self.weight[self.is_held_out], self.observed[self.is_held_out]
        records = pulled.records[self.is_held_out]
        # The gain of a group whose shots are all held out is not fitted, and says nothing of the scene.
        groups = self.model.groups
        if groups.unknowns:
            records = _best_gains(pulled.waveforms[self.is_held_out], y, w, groups)
        return float(np.sum(((records - y) * w) ** 2)) / max(int(np.sum(w > 0)), 1)

    def scale(self, x: np.ndarray, random: np.random.Generator) -> Float[np.ndarray, " n"]:
        """Return the inverse root of the diagonal of the Gauss-Newton matrix, estimated by random signs.

        For signs e, (J^T e)_k^2 has the expectation (J^T J)_kk.
        """
        # Exact for the priors; a few random signs do for the data, as the diagonal only scales the unknowns.
        squares = self.priors.jacobian(x).power(2)
        diagonal = squares.T @ np.ones(squares.shape[0]) + self.bounds_precision
        for _ in range(_SCALE_DRAWS):
            signs = random.choice([-1.0, 1.0], size=self.model.weight.shape)
            diagonal += self.model.pull_back(x, signs * self.model.weight) ** 2 / _SCALE_DRAWS
        return 1.0 / np.sqrt(diagonal)

    def product(self, x: np.ndarray, v: np.ndarray) -> Float[np.ndarray, " n"]:
        """Return the product of H of the module with a vector."""
        jacobian = self.priors.jacobian(x)
        of_priors = jacobian.T @ (jacobian @ v) + self.bounds_precision * v
        return self.model.gauss_newton_product(x, v) + of_priors

    def is_free(self, x: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Return True for values that are not at one of their bounds, where L-BFGS-B puts them exactly."""
        margin = _BOUND_MARGIN * (self.high - self.low)
        return (x > self.low + margin) & (x < self.high - margin)

    def solve(
        self, end: "_FitEnd", b: np.ndarray, is_free: Bool[np.ndarray, " n"] | None = None
    ) -> Float[np.ndarray, " n"]:
        """Return H^-1 b by conjugate gradients, preconditioned by the diagonal of H.

        With `is_free`, it is (H_FF)^-1 b_F of the free values, and zero for the others.
        """
        n = b.size
        free = np.ones(n) if is_free is None else is_free.astype(float)

        def product(v: np.ndarray) -> np.ndarray:
            # The identity for values that are held, which keeps the matrix regular.
            return free * self.product(end.evaluation.x, free * v) + (1.0 - free) * v

        # SciPy's stubs know the constructor of the base class alone, without its functions.
        operator: Any = scipy.sparse.linalg.LinearOperator
        matrix = operator((n, n), matvec=product, dtype=float)
        inverse_diagonal = operator((n, n), matvec=lambda v: end.scale**2 * v, dtype=float)
        tolerance = {"rtol": _CG_RTOL, "maxiter": _CG_STEPS}
        solution, _ = scipy.sparse.linalg.cg(matrix, free * b, M=inverse_diagonal, **tolerance)
        return solution


def _best_gains(
    waveforms: np.ndarray, observed: np.ndarray, weight: np.ndarray, groups: ShotGroups
) -> np.ndarray:
    """Return records with the gain and the offset that fit each record best, within their bounds."""
    # Normal equations of a straight line y = s m + o for each record.
    w2 = weight**2
    total, ones = np.sum(w2, axis=(1, 2)), np.ones_like(waveforms)
    sums = {
        name: np.sum(w2 * a * b, axis=(1, 2))
        for name, a, b in (
            ("mm", waveforms, waveforms),
            ("m", waveforms, ones),
            ("my", waveforms, observed),
            ("y", observed, ones),
        )
    }
    # A record without weight has sums of zero, and its misfit is zero whatever its gain.
    tiny = 1e-300
    gain = np.ones(len(waveforms))
    if groups.gain is not None:
        if groups.offset is None:
            gain = sums["my"] / np.maximum(sums["mm"], tiny)
        else:
            centred = sums["mm"] - sums["m"] ** 2 / np.maximum(total, tiny)
            gain = (sums["my"] - sums["m"] * sums["y"] / np.maximum(total, tiny)) / np.maximum(centred, tiny)
        gain = np.clip(gain, groups.gain.low.min(), groups.gain.high.max())
    offset = np.zeros(len(waveforms))
    if groups.offset is not None:
        offset = (sums["y"] - gain * sums["m"]) / np.maximum(total, tiny)
        offset = np.clip(offset, groups.offset.low.min(), groups.offset.high.max())
    return gain[:, None, None] * waveforms + offset[:, None, None]


class _FitEnd(NamedTuple):
    """The end of a fit: the best evaluation, the scale of the unknowns, and how it ended."""

    evaluation: _Evaluation
    scale: np.ndarray
    history: np.ndarray
    converged: bool
    status: str


class _StoredSteps:
    """Steps of a run that are stored, or none: arrays by number of the step, draw or kernel."""

    def __init__(self, store: ResultStore | None, group: str, count: int):
        self._rows = None if store is None else store.rows(group, group.removesuffix("s"), count)

    def read(self, number: int) -> dict[str, np.ndarray] | None:
        """Return the arrays of a step; None where it is not stored."""
        if self._rows is None or not self._rows.is_done[number]:
            return None
        return {
            name: np.asarray(array[0]) for name, array in self._rows.read(slice(number, number + 1)).items()
        }

    def write(self, number: int, **arrays: Any) -> None:
        """Store a step, in place of an earlier one."""
        if self._rows is not None:
            rows = {name: [array] for name, array in arrays.items()}
            self._rows.write(slice(number, number + 1), dataset_of_rows(self._rows.dimension, rows))


def _fit(
    problem: _Problem,
    max_steps: int,
    random: np.random.Generator,
    store: _StoredSteps,
    progress: ProgressOption,
) -> _FitEnd:
    """Minimise the objective until the held-out misfit no longer falls.

    1. Start from the unknowns' starts, or from the last step that is stored.
    2. After each step of L-BFGS-B note both misfits, and store them and the values.
    3. Stop when the criterion, the held-out misfit or without one the objective, has not fallen.
    """
    x = np.clip(flat_start(problem.model.all_unknowns), problem.low, problem.high)
    scale = problem.scale(x, random)
    history: list[tuple[float, float, float]] = []
    last_x, best_x, at_minimum = x, x, False
    # Unregularised maps go on to fit noise after the scene is found. Held-out shots show when this begins.
    has_held_out = bool(np.any(problem.is_held_out))
    latest: _Evaluation | None = None

    def criterion() -> np.ndarray:
        return np.array([row[1] if has_held_out else row[2] for row in history])

    def add_step(values: np.ndarray, misfits: tuple[float, float, float]) -> None:
        nonlocal last_x, best_x
        history.append(misfits)
        last_x = values
        if int(np.argmin(criterion())) == len(history) - 1:
            best_x = values

    while len(history) < max_steps and (stored := store.read(len(history))) is not None:
        misfit, held_out_misfit, objective_value = stored["misfits"].tolist()
        add_step(stored["x"], (misfit, held_out_misfit, objective_value))
        at_minimum = bool(stored["at_minimum"])
    stopped = bool(history) and no_longer_falls(criterion())

    def objective(scaled: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal latest
        # Division and multiplication by the scale may leave the bounds by rounding.
        latest = problem.evaluate(np.clip(scaled * scale, problem.low, problem.high))
        return latest.objective, latest.gradient * scale

    def after_step(intermediate_result: Any) -> None:
        nonlocal stopped
        at = np.clip(intermediate_result.x * scale, problem.low, problem.high)
        # The last point of a line search is usually the accepted one; another has to be evaluated again.
        if latest is None or not np.array_equal(latest.x, at):
            objective(intermediate_result.x)
        assert latest is not None
        add_step(latest.x, (latest.misfit, latest.held_out_misfit, latest.objective))
        stopped = no_longer_falls(criterion())
        store.write(len(history) - 1, x=last_x, misfits=history[-1], at_minimum=False)
        if callable(progress):
            progress(SceneStep("fit", len(history), latest.misfit, latest.held_out_misfit))
        # SciPy ends the minimisation at this exception, and returns its result as usual.
        if stopped:
            raise StopIteration

    if not (stopped or at_minimum) and len(history) < max_steps:
        result = scipy.optimize.minimize(
            objective,
            last_x / scale,
            jac=True,
            method="L-BFGS-B",
            bounds=np.stack([problem.low / scale, problem.high / scale], axis=1),
            callback=after_step,
            # The stopping rule above ends the fit; the tolerance is for objectives without noise.
            options={"maxiter": max_steps - len(history), "maxcor": _MEMORY, "ftol": 1e-9, "maxfun": 10**9},
        )
        # Status 1 is the limit of steps.
        at_minimum = not stopped and result.status != 1
        if history:
            # A run that goes on from here does not repeat the fit.
            store.write(len(history) - 1, x=last_x, misfits=history[-1], at_minimum=at_minimum)
        else:
            # The start is a minimum: no step was taken.
            assert latest is not None
            history.append((latest.misfit, latest.held_out_misfit, latest.objective))
    best = problem.evaluate(best_x)
    what = "misfit of held-out shots" if has_held_out else "objective"
    if stopped:
        status = f"converged: the {what} no longer falls, after {len(history)} steps"
    elif at_minimum:
        status = f"converged: at a minimum, after {len(history)} steps"
    else:
        status = f"not converged in {len(history)} steps: the {what} still falls; give more max_steps"
    table = np.array(history).reshape(-1, 3)
    return _FitEnd(best, scale, table, stopped or at_minimum, status)


def no_longer_falls(values: Float[np.ndarray, " steps"]) -> bool:
    """Return True if the last steps have not brought values below the least one before by a fraction."""
    if len(values) <= _PATIENCE:
        return False
    # A single step may rise by chance: the least of several counts.
    before, since = np.min(values[:-_PATIENCE]), np.min(values[-_PATIENCE:])
    return bool(since > before - _LEAST_GAIN * abs(before))


# -- errors ------------------------------------------------------------------------------------------------


def _draws_of_error(
    problem: _Problem,
    end: _FitEnd,
    draws: int,
    key: PRNGKeyArray,
    store: _StoredSteps,
    progress: ProgressOption,
) -> Float[np.ndarray, "draws n"]:
    """Draw errors of the values from the linearised posterior."""
    best = end.evaluation
    errors = np.zeros((draws, best.x.size))
    for number in range(draws):
        if stored := store.read(number):
            errors[number] = stored["error"]
            continue
        # The numbers of a draw do not depend on where a run was interrupted.
        seed = jax.random.key_data(jax.random.fold_in(key, number))
        random = np.random.default_rng(np.asarray(seed).ravel())
        # The right side has the covariance H, so that H^-1 of it has the posterior's covariance H^-1.
        weight = problem.model.weight
        of_data = problem.model.pull_back(best.x, random.normal(size=weight.shape) * weight)
        jacobian = problem.priors.jacobian(best.x)
        of_priors = jacobian.T @ random.normal(size=jacobian.shape[0])
        of_bounds = np.sqrt(problem.bounds_precision) * random.normal(size=best.x.size)
        right_side = of_data + of_priors + of_bounds
        errors[number] = problem.solve(end, right_side)
        store.write(number, error=errors[number])
        if callable(progress):
            progress(SceneStep("errors", number + 1, best.misfit, best.held_out_misfit))
    return errors


def _averaging_kernels(
    problem: _Problem,
    end: _FitEnd,
    places: Mapping[str, np.ndarray],
    store: _StoredSteps,
    progress: ProgressOption,
) -> dict[str, Float[np.ndarray, "places ..."]]:
    """Return rows of the averaging kernel, d estimate / d truth, within the unknown itself.

    Rows of values at their bounds are zero.
    """
    kernels, number, best = {}, 0, end.evaluation
    is_free = problem.is_free(best.x)
    starts = np.cumsum([0, *problem.model.sizes])
    for start, u in zip(starts, problem.model.all_unknowns):
        if u.name not in places:
            continue
        rows = []
        for index in places[u.name]:
            flat = int(start) + int(np.ravel_multi_index(tuple(index), u.start.shape))
            stored = store.read(number)
            if stored is None:
                unit = np.zeros(best.x.size)
                unit[flat] = 1.0
                # A row of (H_FF)^-1 (J^T J)_F: by symmetry, J^T J times a column of (H_FF)^-1.
                row = np.zeros(best.x.size)
                if is_free[flat]:
                    column = problem.solve(end, unit, is_free)
                    row = problem.model.gauss_newton_product(best.x, column)
                store.write(number, row=row)
            else:
                row = stored["row"]
            number += 1
            rows.append(row[start : start + u.start.size].reshape(u.start.shape))
            if stored is None and callable(progress):
                progress(SceneStep("averaging kernels", number, best.misfit, best.held_out_misfit))
        kernels[u.name] = np.stack(rows)
    return kernels
