"""Summary of one fit: all quantities that its result has, as plain arrays over the flattened unknowns.

`FitSummary` is the one place in which the quantities of a fit are listed. Each field names its axes and its
kind of number; from these,

- `inversion.fit.result` makes a `Retrieval` from one summary, or from many;
- `to_arrays` and `from_arrays` write a row of a store, and read it.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from inversion.fit.data import SampleNoise
from inversion.fit.model import Evaluation


@dataclasses.dataclass(frozen=True)
class Step:
    """One step of a fit, as `retrieve` passes it to `progress`: values that were tried in a simulation.

    A descent that starts anew, with new weights or strengths, begins with its first values once more.

    The first steps of a fit may trace few of the photons, the last ones trace all. Chi-squared, which counts
    the simulation's own noise, may rise between the two.

    - `number`: from 1 on.
    - `reduced_chi2`: reduced chi-squared at the values tried.
    - `accepted`: True if the step was accepted.
    - `values`: by name, the values tried.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion
    >>> from inversion.fit.fit_summary import Step
    >>> print(Step(number=2, reduced_chi2=1.5, accepted=False, values={"height": 0.25}))
    step 2: chi2 = 1.5 (not kept); height = 0.25
    """

    number: int
    reduced_chi2: float
    accepted: bool
    values: Mapping[str, np.ndarray | float]

    def __str__(self) -> str:
        values = ", ".join(f"{name} = {short_text(value)}" for name, value in self.values.items())
        rejection = "" if self.accepted else " (not kept)"
        return f"step {self.number}: chi2 = {self.reduced_chi2:.4g}{rejection}; {values}"


def short_text(value: Any) -> str:
    """Return a number or array in four digits, long arrays abridged."""
    return np.array2string(np.asarray(value), precision=4, threshold=8, edgeitems=3)


class SummarySizes(NamedTuple):
    """Lengths of the axes of a summary: flattened unknowns, smoothness priors, and those of a waveform."""

    unknowns: int
    smooth_priors: int
    wavelengths: int
    bins: int


def _axes(axes: str = "", kind: str = "f") -> dict[str, Any]:
    """Return metadata of a quantity: its axes (fields of `SummarySizes`), and NumPy's code of its kind."""
    return {"axes": tuple(axes.split()), "kind": kind}


@dataclasses.dataclass(frozen=True)
class FitSummary:
    """The result of one fit, in natural units.

    - `values`, `stderr`: estimates and standard errors; infinite errors for unknowns that neither
      data nor priors constrain to within their bounds.
    - `robust_stderr`: standard errors widened by misfit and by the spread over several starts.
    - `prior_share`: share of the prior in each estimate, one less the diagonal of the averaging kernel
      without bounds.
    - `at_bound`: True for unknowns at one of their bounds.
    - `covariance`: of the estimates.
    - `averaging`: averaging kernel, d estimate / d truth.
    - `reduced_chi2`, `independent_samples`: misfit, and effective number of samples.
    - `second_minimum`: rise in chi-squared to the next minimum, infinite if no start ended in another one.
    - `strength`: of the smoothness priors.
    - `converged`, `status`: end of the fit.
    - `steps`: number of simulations.
    - `simulation_error`: part of the standard errors that is the simulation's own noise.
    - `residuals`: observed minus fitted, whitened; zero for samples that are left out.
    - `fitted`: simulated apparent reflectance at the estimates, before the recorder (no receiver response,
      scale or offset).
    """

    # Estimates.
    values: np.ndarray = dataclasses.field(metadata=_axes("unknowns"))
    stderr: np.ndarray = dataclasses.field(metadata=_axes("unknowns"))
    robust_stderr: np.ndarray = dataclasses.field(metadata=_axes("unknowns"))
    prior_share: np.ndarray = dataclasses.field(metadata=_axes("unknowns"))
    at_bound: np.ndarray = dataclasses.field(metadata=_axes("unknowns", kind="b"))
    covariance: np.ndarray = dataclasses.field(metadata=_axes("unknowns unknowns"))
    averaging: np.ndarray = dataclasses.field(metadata=_axes("unknowns unknowns"))
    # Goodness of fit, and smoothness priors.
    reduced_chi2: float = dataclasses.field(metadata=_axes())
    independent_samples: float = dataclasses.field(metadata=_axes())
    second_minimum: float = dataclasses.field(metadata=_axes())
    strength: np.ndarray = dataclasses.field(metadata=_axes("smooth_priors"))
    # End of the fit.
    converged: bool = dataclasses.field(metadata=_axes(kind="b"))
    status: str = dataclasses.field(metadata=_axes(kind="U"))
    steps: int = dataclasses.field(metadata=_axes(kind="i"))
    simulation_error: np.ndarray = dataclasses.field(metadata=_axes("unknowns"))
    residuals: np.ndarray = dataclasses.field(metadata=_axes("wavelengths bins"))
    fitted: np.ndarray = dataclasses.field(metadata=_axes("wavelengths bins"))

    @staticmethod
    def axes() -> dict[str, tuple[str, ...]]:
        """Return the axes of every quantity, by name."""
        return {f.name: f.metadata["axes"] for f in dataclasses.fields(FitSummary)}

    def to_arrays(self) -> dict[str, Any]:
        """Return the quantities by name."""
        return {name: getattr(self, name) for name in self.axes()}

    @staticmethod
    def from_arrays(arrays: Mapping[str, np.ndarray]) -> "FitSummary":
        """Return the summary of quantities that `to_arrays` gave, as NumPy arrays.

        **Raises:** ValueError for quantities of other names.
        """
        if arrays.keys() != FitSummary.axes().keys():
            raise ValueError(f"it has {', '.join(arrays)}; admissible are {', '.join(FitSummary.axes())}")
        # Scalars were stored as arrays without axes.
        quantities: dict[str, Any] = {name: a if a.ndim else a.item() for name, a in arrays.items()}
        return FitSummary(**quantities)


@dataclasses.dataclass(frozen=True)
class CompletedFit:
    """A fit that has ended: its summary, and what is neither stored nor given for many fits.

    - `waveform_stderr`: (wavelengths, bins) standard error of the simulated waveform.
    - `cost`: chi-squared by the noise of measurement and pulse, without the simulation's, plus `prior_cost`:
      ranks minima.
    - `prior_cost`: -2 ln of the prior density at the estimates, up to a constant.
    - `difference`: (samples,) simulated minus observed, of the fitted samples.
    - `deviations`: (batches, samples) of the simulation's batches from their mean, or None for one batch.
    - `noise`: of the fitted samples.
    - `history`: reduced chi-squared of every call of `progress`.
    - `evaluation`: the simulation at the estimates.
    """

    summary: FitSummary
    waveform_stderr: np.ndarray
    cost: float
    prior_cost: float
    difference: np.ndarray
    deviations: np.ndarray | None
    noise: SampleNoise
    history: tuple[float, ...]
    evaluation: Evaluation

    @staticmethod
    def of_zeros(sizes: SummarySizes, *, status: str) -> "CompletedFit":
        """Return a fit whose numbers are all zero: the shapes and kinds of one."""
        quantities: dict[str, Any] = {"status": status}
        for field in dataclasses.fields(FitSummary):
            shape = [getattr(sizes, axis) for axis in field.metadata["axes"]]
            # As the code of a type, "b" would be an integer.
            kind = field.metadata["kind"]
            zeros = np.zeros(shape, bool if kind == "b" else kind)
            quantities.setdefault(field.name, zeros if zeros.ndim else zeros.item())
        record = np.zeros((sizes.wavelengths, sizes.bins))
        nothing = np.zeros(0)
        return CompletedFit(
            FitSummary(**quantities),
            waveform_stderr=record,
            cost=0.0,
            prior_cost=0.0,
            difference=nothing,
            deviations=None,
            noise=SampleNoise(nothing),
            history=(),
            evaluation=Evaluation(record, record[..., None], None, None),
        )
