"""Results of retrievals: `Retrieval` of one record, or of many, made from `FitSummary`."""

import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int

from inversion.fit.fit_summary import CompletedFit, FitSummary, short_text
from inversion.fit.profiles import AveragingKernel
from inversion.fit.quality import judge_fit
from inversion.fit.uncertainty import correlation_of
from inversion.fit.unknowns import BoundUnknown, bounds_by_name, flat_labels, smooth_names, split_by_name
from jaxlidar import Scene, Waveform
from jaxlidar.extend import check_index, check_kind, check_range
from jaxlidar.io import save
from jaxlidar.results.datasets import datasets_of, variables_by_item


@final
class Retrieval(eqx.Module):
    """The result of `retrieve` or `retrieve_many`: values of unknowns, their standard errors, and the fit.

    The result of many records has NumPy arrays with a leading axis of footprints, in the order given.
    `fits[i]` is the `Retrieval` of record i, and `len(fits)` their number; both are refused (TypeError) for
    the result of one record. `retrieve` alone gives `scene`, `waveform` and `history`.

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
    - `scene`: the fitted scene; None for many records.
    - `waveform`: the fitted waveform, before the recorder (no receiver response, scale or offset); its
      `stderr` is the simulation's. None for many records.
    - `fitted`: (wavelengths, bins) its apparent reflectance.
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
    - `bounds`: (2, ...) lower and upper bounds of each unknown, the same for all records.
    - `converged`: True if the fit ended at a minimum.
    - `status`: a sentence on the end of the fit; of many, one for each.
    - `steps`: number of waveforms simulated, with few photons or all, each with its Jacobian.
    - `history`: reduced chi-squared of every call of `progress`; see `Step`. Empty for many records.
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

    # By name, in the shape of the unknown after the leading axis.
    values: dict[str, Float[Array, "..."]]
    stderr: dict[str, Float[Array, "..."]]
    robust_stderr: dict[str, Float[Array, "..."]]
    prior_share: dict[str, Float[Array, "..."]]
    at_bound: dict[str, Bool[Array, "..."]]
    simulation_error: dict[str, Float[Array, "..."]]
    covariance: Float[Array, "*footprints n n"]
    averaging: Float[Array, "*footprints n n"]
    reduced_chi2: Float[Array, "*footprints"]
    second_minimum: Float[Array, "*footprints"]
    independent_samples: Float[Array, "*footprints"]
    strength: dict[str, Float[Array, "*footprints"]]
    bounds: dict[str, Float[np.ndarray, "2 ..."]]
    converged: Bool[Array, "*footprints"]
    steps: Int[Array, "*footprints"]
    residuals: Float[Array, "*footprints wavelengths bins"]
    fitted: Float[Array, "*footprints wavelengths bins"]
    # A text, or a tuple of them.
    status: Any = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)
    # None for many records: declared as those of one, so that type checkers know their fields.
    scene: Scene = None  # pyright: ignore[reportAssignmentType]
    waveform: Waveform = None  # pyright: ignore[reportAssignmentType]
    history: tuple[float, ...] = eqx.field(static=True, default=())

    @property
    def correlation(self) -> Float[Array | np.ndarray, "*footprints n n"]:
        """Correlation of the flattened unknowns, (n, n)."""
        return correlation_of(self.covariance)

    def __len__(self) -> int:
        if np.ndim(self.reduced_chi2) == 0:
            raise TypeError("this is the retrieval of one record: it has no axis of footprints")
        return len(self.reduced_chi2)

    def __bool__(self) -> bool:
        # Not by the length, which the retrieval of one record does not have.
        return True

    def __getitem__(self, footprint: int) -> "Retrieval":
        i = check_index("footprint", footprint, len(self))
        row = jax.tree.map(lambda a: a[i], dataclasses.replace(self, bounds=None))
        return dataclasses.replace(row, bounds=self.bounds, status=self.status[i])

    def __iter__(self) -> Iterator["Retrieval"]:
        return (self[i] for i in range(len(self)))

    @property
    def quality(self) -> Any:
        """`Verdict` on the fit, or a tuple of them: `inversion.judge_fit` with all unknowns."""
        return judge_fit(self) if isinstance(self.status, str) else tuple(map(judge_fit, self))

    def band(self, name: str, level: float = 0.95, *, robust: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Credible band of an unknown, within its bounds: see `inversion.fit.profiles`.

        **Arguments:**

        - `name`: of the unknown.
        - `level`: probability, in (0, 1). Default 0.95.
        - `robust`: use `robust_stderr` in place of `stderr`. Default False.

        **Returns:** (low, high), each of the shape of the values; the bounds for an infinite standard error.

        **Raises:** ValueError for a name that the fit does not have, and a `level` outside (0, 1).
        """
        check_range("level", level, 0.0, 1.0, low_open=True, high_open=True)
        check_kind("robust", robust, bool, "True or False")
        self._rows_of(name)
        values = np.asarray(self.values[name], float)
        stderr = np.asarray((self.robust_stderr if robust else self.stderr)[name], float)
        low, high = (np.broadcast_to(b, values.shape) for b in np.asarray(self.bounds[name], float))
        is_determined = np.isfinite(stderr)
        half_width = scipy.special.ndtri(0.5 + 0.5 * level) * np.where(is_determined, stderr, 0.0)
        lower, upper = np.maximum(values - half_width, low), np.minimum(values + half_width, high)
        return np.where(is_determined, lower, low), np.where(is_determined, upper, high)

    def averaging_kernel(self, name: str, spacing: float = 1.0) -> AveragingKernel:
        """Response of the estimate of a profile to the true profile, and its height resolution.

        The other unknowns are fitted as well; strengths of smoothness priors are taken as known.

        **Arguments:**

        - `name`: of the unknown.
        - `spacing`: distance between layers, positive, such as in m. Default 1: the resolution is in layers.

        **Returns:** an `AveragingKernel`, of NumPy arrays.

        **Raises:** ValueError for a name that the fit does not have, and a `spacing` that is not positive.
        """
        check_range("spacing", spacing, 0.0, low_open=True)
        rows = self._rows_of(name)
        matrix = np.asarray(self.averaging, float)[..., rows, rows]
        diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
        # The inner where keeps the division finite.
        positive = np.where(diagonal > 0.0, diagonal, 1.0)
        resolution = np.where(diagonal > 0.0, float(spacing) / positive, np.inf)
        return AveragingKernel(matrix, np.sum(diagonal, axis=-1), resolution)

    def _rows_of(self, name: str) -> slice:
        """Return the rows of an unknown among the flattened ones. **Raises:** ValueError for another name."""
        if name not in self.values:
            raise ValueError(f"name = {name!r}; admissible are {', '.join(map(repr, self.values))}")
        first = 0
        for other_name, bounds in self.bounds.items():
            # Bounds have the shape (2, ...).
            size = int(np.size(bounds)) // 2
            if other_name == name:
                return slice(first, first + size)
            first += size
        raise AssertionError(name)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result as a netCDF file, which `jaxlidar.open` reads.

        **Arguments:** `path`: the file to write.

        **Raises:** what `jaxlidar.io.save` raises.
        """
        save(self, path)

    def to_xarray(self) -> Any:
        """The results of many records as an `xarray.Dataset` over the dimension `footprint`.

        **Returns:** an `xarray.Dataset` with a variable for each unknown, "... stderr" for its standard
        error, "... robust stderr", "... prior share" and "... at bound", and `reduced_chi2`,
        `second_minimum`, `independent_samples`, `converged`, `steps`, `status` and `fitted`.

        **Raises:** ImportError where xarray is not installed; TypeError for the result of one record.
        """
        import xarray

        len(self)
        stored = datasets_of(self)["/"]
        fields = ("values", "stderr", "robust_stderr", "prior_share", "at_bound")
        columns = columns_of_unknowns(stored, fields, first_axis=1)
        for name in ("reduced_chi2", "second_minimum", "independent_samples", "converged", "steps"):
            columns[name] = stored[name]
        columns["status"] = ("footprint", np.array(self.status, dtype=object))
        columns["fitted"] = stored["fitted"].rename(time="bin")
        return xarray.Dataset(columns)

    def __str__(self) -> str:
        if not isinstance(self.status, str):
            n_converged = int(np.sum(self.converged))
            return f"{len(self)} fits of {', '.join(self.values)}: {n_converged} converged"
        width = max(map(len, self.values))
        rows = [
            f"{name.ljust(width)}  {short_text(value)} +- {short_text(self.stderr[name])}"
            f" (robust {short_text(self.robust_stderr[name])})"
            for name, value in self.values.items()
        ]
        return "\n".join([*rows, f"reduced chi2 {float(self.reduced_chi2):.3g}; {self.status}"])

    def _repr_html_(self) -> str | None:
        """Return the HTML that notebooks show: the summary, the fitted waveform and its residuals."""
        if self.waveform is None:
            return None
        # matplotlib takes a while to import: only when a notebook shows the result.
        from jaxlidar.plot.html import fit_html

        return fit_html(str(self), self.waveform, self.residuals)


def columns_of_unknowns(stored: Any, fields: Sequence[str], first_axis: int = 0) -> dict[str, Any]:
    """Return variables of a result's dataset by name of unknown and field, with axes of their own.

    `first_axis`: number of axes that unknowns share, such as that of the footprints.
    """
    columns = {}
    for field in fields:
        suffix = "" if field == "values" else f" {field.replace('_', ' ')}"
        for name, variable in variables_by_item(stored, field).items():
            axes = {axis: f"{name} {i}" for i, axis in enumerate(stored[variable].dims[first_axis:])}
            columns[f"{name}{suffix}"] = stored[variable].rename(axes)
    return columns


def retrieval_of(
    fit: CompletedFit, unknowns: Sequence[BoundUnknown], scene: Scene, waveform: Waveform
) -> Retrieval:
    """Return the result of one fit.

    **Arguments:** `unknowns`: of the scene, then those of the recorder. `scene`, `waveform`: fitted.
    """
    quantities = _named_quantities(fit.summary.to_arrays(), unknowns)
    end_of_fit = {name: quantities.pop(name) for name in ("converged", "status", "steps")}
    # JAX's precision, as for the scene and the waveform.
    return Retrieval(
        **jax.tree.map(jnp.asarray, quantities),
        **end_of_fit,
        bounds=bounds_by_name(unknowns),
        labels=flat_labels(unknowns),
        scene=scene,
        waveform=waveform,
        history=fit.history,
    )


def retrievals_of(summaries: Sequence[FitSummary], unknowns: Sequence[BoundUnknown]) -> Retrieval:
    """Return the result of many fits, in their order.

    **Arguments:** `unknowns`: of the scene, then those of the recorder.
    """
    stacked: dict[str, Any] = {
        name: np.stack([np.asarray(getattr(summary, name)) for summary in summaries])
        for name in FitSummary.axes()
    }
    # An equinox module cannot hold strings in an array.
    stacked["status"] = tuple(summary.status for summary in summaries)
    return Retrieval(
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
