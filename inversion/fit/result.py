"""Results of retrievals: `Retrieval` of one waveform, `Retrievals` of many, both made from `FitSummary`."""

import os
from collections.abc import Mapping, Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from inversion.fit.fit_summary import CompletedFit, FitSummary, short_text
from inversion.fit.profiles import AbstractPosterior
from inversion.fit.quality import Verdict, judge_fit
from inversion.fit.uncertainty import correlation_of
from inversion.fit.unknowns import BoundUnknown, bounds_by_name, flat_labels, smooth_names, split_by_name
from jaxlidar import Scene, Waveform
from jaxlidar.io import save
from jaxlidar.io.datasets import datasets_of, variables_by_item


@final
class Retrieval(AbstractPosterior):
    """The result of `retrieve`: values of the unknowns, their standard errors, and the fitted scene.

    Unknowns are in their natural units, keyed by name. The rows of `covariance` and `correlation` are the
    flattened unknowns in the order given, named by `labels`. `print(fit)` shows a summary: values, standard
    errors and robust ones, reduced chi-squared and status.

    - `values`: best values.
    - `stderr`: one standard error each, of the same shapes; infinite for unknowns that neither
      data nor priors constrain to within their bounds.
    - `robust_stderr`: `stderr` widened by misfit and, with several starts, by the spread over their minima;
      never narrower. Use it for recorded waveforms, which no model fits to within the noise: see
      `inversion.fit.uncertainty`.
    - `prior_share`: share of the prior in each estimate, 0 to 1: one less the diagonal of the averaging
      kernel without bounds.
    - `at_bound`: True for unknowns at one of their bounds.
    - `simulation_error`: the part of `stderr` that comes from the simulation's own noise; it falls with
      `n_photons`.
    - `covariance`, `correlation`: (n, n). An unknown of infinite variance has no covariance with others.
    - `scene`: the fitted scene.
    - `waveform`: the fitted waveform, before the recorder (no receiver response, scale or offset); its
      `stderr` is the simulation's.
    - `residuals`: (wavelengths, bins) observed minus fitted, whitened (for independent errors: over the
      standard deviation); zero for samples that were left out.
    - `reduced_chi2`: sum of squared residuals over the number of samples less that of determined unknowns.
    - `second_minimum`: rise of chi-squared from the best minimum to the next one elsewhere, less two standard
      errors of the simulation's noise, times `independent_samples` over the number of samples, over
      `reduced_chi2` if that exceeds one; infinite if no start ended elsewhere.
    - `independent_samples`: effective number of independent samples among those fitted, whose residuals are
      correlated.
    - `averaging`: (n, n) averaging kernel, d estimate / d truth: see `averaging_kernel`.
    - `strength`: of each smoothness prior (`Smooth`), as given or by the data.
    - `bounds`: (2, ...) lower and upper bounds of each unknown.
    - `converged`: True if the fit ended at a minimum.
    - `status`: a sentence on the end of the fit.
    - `steps`: number of waveforms simulated, with few photons or all, each with its Jacobian.
    - `history`: reduced chi-squared of every call of `progress`; see `Step`.
    - `labels`: names of the flattened unknowns.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> truth, start = jl.Scene(ground=jl.Ground(height=0.5)), jl.Scene(ground=jl.Ground())
    >>> wave = jl.simulate(jl.Lidar(), truth, key=jax.random.key(0))
    >>> height = inversion.Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0))
    >>> problem = inversion.Problem(wave, jl.Lidar(), start, [height], noise=0.001)
    >>> fit = inversion.retrieve(problem, key=jax.random.key(1))
    >>> fit.converged, fit.labels, f"{float(fit.scene.ground.height):.3f} m"
    (True, ('ground.height',), '0.500 m')
    """

    # By name, in the shape of the unknown.
    values: dict[str, Float[Array, "..."]]
    stderr: dict[str, Float[Array, "..."]]
    robust_stderr: dict[str, Float[Array, "..."]]
    prior_share: dict[str, Float[Array, "..."]]
    at_bound: dict[str, Bool[Array, "..."]]
    simulation_error: dict[str, Float[Array, "..."]]
    covariance: Float[Array, "n n"]
    correlation: Float[Array, "n n"]
    scene: Scene
    waveform: Waveform
    residuals: Float[Array, "wavelengths bins"]
    reduced_chi2: Float[Array, ""]
    second_minimum: Float[Array, ""]
    independent_samples: Float[Array, ""]
    averaging: Float[Array, "n n"]
    strength: dict[str, Float[Array, ""]]
    bounds: dict[str, Float[Array, "2 ..."]]
    converged: bool = eqx.field(static=True)
    status: str = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    history: tuple[float, ...] = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)

    @property
    def quality(self) -> Verdict:
        """Verdict on the fit, with reasons: `inversion.judge_fit` with all unknowns."""
        return judge_fit(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result as a netCDF file, which `jaxlidar.open` reads.

        **Arguments:** `path`: the file to write.

        **Raises:** what `jaxlidar.io.save` raises.
        """
        save(self, path)

    def __str__(self) -> str:
        width = max(map(len, self.values))
        rows = [
            f"{name.ljust(width)}  {short_text(value)} +- {short_text(self.stderr[name])}"
            f" (robust {short_text(self.robust_stderr[name])})"
            for name, value in self.values.items()
        ]
        return "\n".join([*rows, f"reduced chi2 {float(self.reduced_chi2):.3g}; {self.status}"])

    def _repr_html_(self) -> str:
        """Return the HTML that notebooks show: the summary, the fitted waveform and its residuals."""
        # matplotlib takes a while to import: only when a notebook shows the result.
        from jaxlidar.plot.html import fit_html

        return fit_html(str(self), self.waveform, self.residuals)


@final
class Retrievals(AbstractPosterior):
    """The results of `retrieve_many`: one fit per footprint, in the order given.

    Arrays have a leading axis `footprints`. The quantities are those of `Retrieval`.

    - `values`: by name, (footprints, ...) best values.
    - `stderr`: by name, (footprints, ...) one standard error; infinite for unknowns that neither
      data nor priors constrain to within their bounds.
    - `robust_stderr`, `prior_share`, `at_bound`: by name, (footprints, ...).
    - `covariance`, `averaging`: (footprints, n, n).
    - `strength`: by name, (footprints,). `bounds`: by name, (2, ...), those of all footprints.
    - `reduced_chi2`, `second_minimum`, `independent_samples`: (footprints,).
    - `converged`: (footprints,) True for fits that ended at a minimum.
    - `steps`: (footprints,) number of waveforms simulated, with few photons or all, each with its Jacobian.
    - `fitted`: (footprints, wavelengths, bins) apparent reflectance, before the recorder (no
      receiver response, scale or offset).
    - `status`: a sentence for each footprint on the end of its fit.
    - `labels`: names of the rows of `covariance`.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> scene = jl.Scene(ground=jl.Ground(height=0.5))
    >>> wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
    >>> unknown = inversion.Unknown(lambda s: s.ground.reflectance, bounds=(0.0, 1.0), name="brightness")
    >>> records, time = wave.reflectance[None], wave.time
    >>> problem = inversion.Problem(records, jl.Lidar(), scene, [unknown], noise=0.001, time=time)
    >>> fits = inversion.retrieve_many(problem, key=jax.random.key(1))
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
        """Verdict on each fit, with reasons: `inversion.judge_fit` with all unknowns."""
        return judge_fit(self)

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


def retrieval_of(
    fit: CompletedFit, unknowns: Sequence[BoundUnknown], scene: Scene, waveform: Waveform
) -> Retrieval:
    """Return the result of one fit.

    **Arguments:** `unknowns`: of the scene, then those of the recorder. `scene`, `waveform`: fitted.
    """
    quantities = _named_quantities(fit.summary.to_arrays(), unknowns)
    # The waveform takes its place.
    del quantities["fitted"]
    # Static fields of the result: plain Python values.
    end_of_fit = {name: quantities.pop(name) for name in ("converged", "status", "steps")}
    quantities |= {
        "simulation_error": split_by_name(fit.details.simulation_error, unknowns),
        "correlation": correlation_of(fit.summary.covariance),
        "residuals": fit.details.residuals,
        "bounds": bounds_by_name(unknowns),
    }
    # JAX's precision, as for the scene and the waveform.
    return Retrieval(
        **jax.tree.map(jnp.asarray, quantities),
        **end_of_fit,
        scene=scene,
        waveform=waveform,
        history=fit.details.history,
        labels=flat_labels(unknowns),
    )


def retrievals_of(summaries: Sequence[FitSummary], unknowns: Sequence[BoundUnknown]) -> Retrievals:
    """Return the results of many fits, in their order.

    **Arguments:** `unknowns`: of the scene, then those of the recorder.
    """
    stacked: dict[str, Any] = {
        name: np.stack([np.asarray(getattr(summary, name)) for summary in summaries])
        for name in FitSummary.axes()
    }
    # An equinox module cannot hold strings in an array.
    stacked["status"] = tuple(summary.status for summary in summaries)
    return Retrievals(
        **_named_quantities(stacked, unknowns),
        bounds=bounds_by_name(unknowns),
        labels=flat_labels(unknowns),
    )


def _named_quantities(quantities: Mapping[str, Any], unknowns: Sequence[BoundUnknown]) -> dict[str, Any]:
    """Return the quantities of a summary, or stacked ones of many, with vectors split by name of unknown."""
    named = {}
    for name, axes in FitSummary.axes().items():
        quantity = quantities[name]
        # Matrices stay over all unknowns, in the order of the labels.
        if axes == ("unknowns",):
            named[name] = split_by_name(quantity, unknowns)
        elif axes == ("smooth_priors",):
            # One strength for each name; the last axis is theirs, a leading one that of the footprints.
            named[name] = dict(zip(smooth_names(unknowns), np.moveaxis(quantity, -1, 0)))
        else:
            named[name] = quantity
    return named
