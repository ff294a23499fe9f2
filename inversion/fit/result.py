"""Records of a retrieval: its steps and its result."""

import dataclasses
import os
from collections.abc import Mapping
from typing import final

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from inversion.fit.profiles import AbstractFitted
from inversion.fit.quality import Verdict, judge_fit
from jaxlidar import Scene, Waveform
from jaxlidar.extend import briefly
from jaxlidar.io import save


@dataclasses.dataclass(frozen=True)
class Step:
    """One step of a fit, as `retrieve` passes it to `progress`: values that were tried in a simulation.

    The first steps of a fit may trace few of the photons, the last ones trace all. Chi-squared, which counts
    the simulation's own noise, may rise between the two.

    - `number`: from 1 on.
    - `reduced_chi2`: reduced chi-squared at the values tried.
    - `accepted`: whether the values tried were kept.
    - `values`: by name, the values tried.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion
    >>> print(inversion.Step(number=2, reduced_chi2=1.5, accepted=False, values={"height": 0.25}))
    step 2: chi2 = 1.5 (not kept); height = 0.25
    """

    number: int
    reduced_chi2: float
    accepted: bool
    values: Mapping[str, np.ndarray | float]

    def __str__(self) -> str:
        values = ", ".join(f"{name} = {_short(value)}" for name, value in self.values.items())
        kept = "" if self.accepted else " (not kept)"
        return f"step {self.number}: chi2 = {self.reduced_chi2:.4g}{kept}; {values}"


@final
@briefly
class Retrieval(AbstractFitted):
    """The result of `retrieve`: values of the unknowns, their standard errors, and the fitted scene.

    Unknowns are in their natural units, keyed by name. The rows of `covariance` and `correlation` are the
    flattened unknowns in the order given, named by `labels`. `print(fit)` shows a summary.

    - `values`: best values.
    - `stderr`: one standard error each, of the same shapes; infinite where the data do not constrain the
      unknown.
    - `robust_stderr`: `stderr` widened by misfit and, with several starts, by the spread over their ends;
      never narrower. To be used for records, which no model fits to the noise: see `inversion.misfit`.
    - `prior_share`: share of the information on each unknown that is the prior's, 0 to 1.
    - `at_bound`: whether an unknown lies at one of its bounds.
    - `simulation_error`: the part of `stderr` that comes from the simulation's own noise; it falls with
      `n_photons`.
    - `covariance`, `correlation`: (n, n). An unknown of infinite variance has no covariance with others.
    - `scene`: the fitted scene.
    - `waveform`: the fitted waveform, without the fitted scale; its `stderr` is the simulation's.
    - `residuals`: (wavelengths, bins) observed minus fitted over its standard deviation; zero where the
      sample was left out.
    - `reduced_chi2`: sum of squared residuals over the number of samples less that of determined unknowns.
    - `second_minimum`: rise in chi-squared, in units of the reduced one and of independent samples, from the
      best end to the next that lies elsewhere; infinite where no start ended there.
    - `independent_samples`: how many independent samples tell as much as those fitted, whose residuals are
      correlated.
    - `averaging`: (n, n) how the estimates follow the truth, d estimate / d truth: see `averaging_kernel`.
    - `strength`: that of each smoothness prior (`Smooth`), as given or by the data.
    - `bounds`: (2, ...) lower and upper bounds of each unknown.
    - `converged`: whether the fit ended at a minimum.
    - `status`: how the fit ended, in a sentence.
    - `steps`: waveforms simulated, with few photons or all, each with its Jacobian.
    - `history`: reduced chi-squared of every step; see `Step`.
    - `labels`: names of the flattened unknowns.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> truth, start = jl.Scene(ground=jl.Ground(height=0.5)), jl.Scene(ground=jl.Ground())
    >>> wave = jl.simulate(jl.Lidar(), truth, key=jax.random.key(0))
    >>> height = inversion.Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0))
    >>> fit = inversion.retrieve(wave, jl.Lidar(), start, [height], noise=0.001, key=jax.random.key(1))
    >>> fit.converged, fit.labels, f"{float(fit.scene.ground.height):.3f} m"
    (True, ('ground.height',), '0.500 m')
    """

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
        """Whether the fit can be trusted, with reasons: `inversion.judge_fit` with all unknowns."""
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
            f"{name.ljust(width)}  {_short(np.asarray(value))} +- {_short(np.asarray(self.stderr[name]))}"
            for name, value in self.values.items()
        ]
        return "\n".join([*rows, f"reduced chi2 {float(self.reduced_chi2):.3g}; {self.status}"])

    def _repr_html_(self) -> str:
        """What notebooks show: the summary, the fitted waveform and its residuals."""
        # matplotlib takes a while to import: only for those who look.
        from jaxlidar.plot.html import fit_html

        return fit_html(str(self), self.waveform, self.residuals)


def _short(value: np.ndarray | float) -> str:
    return np.array2string(np.asarray(value), precision=4, threshold=8, edgeitems=3)
