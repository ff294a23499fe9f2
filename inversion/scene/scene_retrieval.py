"""`SceneRetrieval`: the result of a fit of many records of one scene."""

import os
from typing import Any, final

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from inversion.fit.fit_summary import short_text
from inversion.fit.result import columns_of_unknowns
from jaxlidar import Scene
from jaxlidar.io import save
from jaxlidar.results.datasets import datasets_of

# Values of an unknown beyond which a summary shows quantiles.
_FEW_VALUES = 8


@final
class SceneRetrieval(eqx.Module):
    """The result of `retrieve_scene`: values of all unknowns, their errors, and the fitted scene.

    Unknowns are in their natural units, keyed by name; "gain" and "offset" are those of groups of shots.
    `print(fit)` shows a summary.

    - `values`: best values, in the shapes of the unknowns.
    - `stderr`: one standard error each, from the draws; NaN without draws. An unknown that neither data nor
      priors determine has that of a uniform distribution within its bounds.
    - `draws`: (draws, ...) draws of the error. The standard deviation of a sum, or of another linear function
      of values, is that of the same function of the draws, about zero: see `stderr_of`.
    - `at_bound`: True for values at one of their bounds.
    - `averaging`: (places, ...) rows of the averaging kernel, d estimate at the place / d truth in each value
      of the unknown. Values at their bounds are held: the row of such a place is zero, and in other rows
      their elements say how the estimate answers to a truth that they cannot follow. `places`: (places, axes)
      their indices. Empty where none were asked for.
    - `bounds`: (2, ...) lower and upper bounds.
    - `scene`: the fitted scene.
    - `time`: (samples,) ns. `wavelength`: (wavelengths,) nm.
    - `fitted`: (shots, wavelengths, samples) fitted records, with gain and offset.
    - `residuals`: (shots, wavelengths, samples) observed minus fitted, over the noise; zero for samples that
      were left out.
    - `held_out`: (shots,) True for shots that were not fitted.
    - `misfit`: chi-squared of the fitted shots over their number of samples. `held_out_misfit`: that of the
      shots held out, the fair one of the two: it is above one where the model or the scene is wrong.
    - `history`: (steps, 3) misfit, held-out misfit and objective after each step.
    - `converged`: True if the fit ended by its stopping rule. `status`: a sentence on its end.

    **Example:** standard error of a mean.

    >>> import jax, jaxlidar as jl, inversion
    >>> survey = jl.Survey.grid(jl.Lidar(), (0, 0), (20, 20), 10.0)
    >>> waves = jl.simulate_many(survey, jl.Scene(ground=jl.Ground(height=0.5)), key=jax.random.key(0))
    >>> height = inversion.Unknown("ground.height", bounds=(-2.0, 2.0), name="height")
    >>> start = jl.Scene(ground=jl.Ground())
    >>> fit = inversion.retrieve_scene(waves, survey, start, [height], noise=0.01, key=jax.random.key(1))
    >>> fit.stderr_of("height", lambda height: height).shape, fit.converged
    ((), True)
    """

    values: dict[str, Float[Array, "..."]]
    stderr: dict[str, Float[Array, "..."]]
    draws: dict[str, Float[Array, "draws ..."]]
    at_bound: dict[str, Bool[Array, "..."]]
    averaging: dict[str, Float[Array, "places ..."]]
    places: dict[str, Int[Array, "places axes"]]
    bounds: dict[str, Float[Array, "2 ..."]]
    scene: Scene
    time: Float[Array, " samples"]
    wavelength: Float[Array, " wavelengths"]
    fitted: Float[Array, "shots wavelengths samples"]
    residuals: Float[Array, "shots wavelengths samples"]
    held_out: Bool[Array, " shots"]
    misfit: Float[Array, ""]
    held_out_misfit: Float[Array, ""]
    history: Float[Array, "steps 3"]
    converged: bool = eqx.field(static=True)
    status: str = eqx.field(static=True)

    def stderr_of(self, name: str, function: Any) -> Float[np.ndarray, "..."]:
        """Return one standard error of a linear function of an unknown, such as a sum or a profile.

        **Arguments:** `name`: of the unknown. `function`: a linear function of its values, an array.

        **Returns:** an array of the shape of the function's result; NaN without draws.
        """
        if name not in self.draws:
            raise ValueError(f"name = {name!r}; admissible are {', '.join(map(repr, self.draws))}")
        results = [np.asarray(function(draw)) for draw in np.asarray(self.draws[name])]
        if not results:
            return np.full(np.shape(function(np.asarray(self.values[name]))), np.nan)
        return np.asarray(np.sqrt(np.mean(np.square(results), axis=0)))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result as a netCDF file, which `jaxlidar.open` reads.

        **Arguments:** `path`: the file to write.

        **Raises:** what `jaxlidar.io.save` raises.
        """
        save(self, path)

    def to_xarray(self) -> Any:
        """The unknowns and the records as an `xarray.Dataset`.

        **Returns:** an `xarray.Dataset` with a variable for each unknown, over dimensions of its own, "...
        stderr" and "... at bound", and `fitted`, `residuals` and `held_out` over shots.

        **Raises:** ImportError where xarray is not installed.
        """
        import xarray

        stored = datasets_of(self)["/"]
        columns = columns_of_unknowns(stored, ("values", "stderr", "at_bound"))
        for name in ("fitted", "residuals", "held_out"):
            columns[name] = stored[name]
        return xarray.Dataset(columns)

    def __str__(self) -> str:
        width = max(map(len, self.values))
        rows = []
        for name, value in self.values.items():
            label, error = name.ljust(width), np.asarray(self.stderr[name])
            if value.size <= _FEW_VALUES:
                rows.append(f"{label}  {short_text(value)} +- {short_text(error)}")
                continue
            low, middle, high = np.quantile(np.asarray(value), (0.05, 0.5, 0.95))
            shape = " x ".join(map(str, value.shape))
            rows.append(
                f"{label}  {shape} values: mean {float(value.mean()):.4g}, quantiles (5, 50, 95 %) "
                f"{low:.4g}, {middle:.4g}, {high:.4g}; median standard error {float(np.median(error)):.2g}; "
                f"{float(np.mean(np.asarray(self.at_bound[name]))):.0%} at a bound"
            )
        shots, held_out = self.held_out.size, int(np.sum(np.asarray(self.held_out)))
        misfits = f"misfit {float(self.misfit):.3g} over {shots - held_out} shots"
        if held_out:
            misfits += f", {float(self.held_out_misfit):.3g} over {held_out} held out"
        return "\n".join([*rows, f"{misfits}; {self.status}"])
