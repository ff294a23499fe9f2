"""Retrieval of leaf traits from reflectance and transmittance: inversion of PROSPECT for many leaves."""

from collections.abc import Mapping, Sequence
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxlidar import Prospect
from jaxlidar.extend import check_range
from jaxlidar.optics.coefficients import TRAITS
from jaxlidar.optics.leaf_surface import LeafSurface
from jaxlidar.optics.prospect import material

from .leaf_solver import Task, errors_of, fit_all, rounding

_BOUNDS = {
    "N": (1.0, 5.0),
    "Cab": (0.0, 150.0),
    "Car": (0.0, 50.0),
    "Cant": (0.0, 50.0),
    "Cbrown": (0.0, 5.0),
    "Cw": (0.0, 0.1),
    "Cm": (0.0, 0.1),
    "Cp": (0.0, 0.02),
    "Cc": (0.0, 0.1),
}
STATUS = (
    "converged",
    "not converged: stopped at max_steps",
    "not converged: no step improves the fit",
    "not fitted: no sample to fit, values are those of the start",
)


@final
class LeafFit(eqx.Module):
    """The result of `invert_leaves`: leaf traits and their standard errors.

    Dictionaries are keyed by the names of the unknowns, in the units of `Prospect`. `print(fit)` shows a
    summary.

    - `traits`: by name, (leaves,) best values.
    - `stderr`: by name, (leaves,) one standard error; infinite where the spectra do not constrain the trait.
      That of a trait on a bound is computed as if there were no bound.
    - `at_bound`: by name, (leaves,) whether the value lies on one of its bounds.
    - `leaves`: the fitted leaves, for `prospect_spectra`: a `Prospect` whose traits have shape (leaves,).
    - `rmse`: (leaves,) root mean square of the residuals of all samples used, of both spectra; zero where
      there are none.
    - `reduced_chi2`: (leaves,) sum of squared residuals over their variances, divided by the number of
      samples less that of unknowns. One by construction where no noise was given.
    - `n_steps`: (leaves,) points tried with all bands, each one PROSPECT with its Jacobian. Two is usual:
      spectra of many bands are first fitted to a part of them, and those points are not counted.
    - `status`: (leaves,) how the fit ended, index of a sentence of `inversion.leaves.STATUS`; 0 is
      convergence.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion
    >>> import numpy as np
    >>> bands = np.arange(400.0, 2501.0, 10.0)
    >>> fit = inversion.invert_leaves(bands, *jl.Prospect(Cw=0.012)(bands))
    >>> fit.converged.tolist(), f"{float(fit.leaves.Cw[0]):.3f} cm"
    ([True], '0.012 cm')
    """

    traits: dict[str, Float[Array, " leaves"]]
    stderr: dict[str, Float[Array, " leaves"]]
    at_bound: dict[str, Bool[Array, " leaves"]]
    leaves: Prospect
    rmse: Float[Array, " leaves"]
    reduced_chi2: Float[Array, " leaves"]
    n_steps: Int[Array, " leaves"]
    status: Int[Array, " leaves"]

    @property
    def converged(self) -> Bool[Array, " leaves"]:
        """Whether the fit ended at a minimum, for each leaf."""
        return self.status == 0

    def sentence(self, leaf: int) -> str:
        """How the fit of one leaf ended, in a sentence that names traits not determined or at a bound.

        **Arguments:**

        - `leaf`: index of the leaf.

        **Returns:** the sentence.
        """
        text = f"{STATUS[int(self.status[leaf])]} after {int(self.n_steps[leaf])} steps"
        notes = {
            "not determined": [name for name, e in self.stderr.items() if not np.isfinite(e[leaf])],
            "at a bound": [name for name, held in self.at_bound.items() if held[leaf]],
        }
        return "; ".join([text, *(f"{note}: {', '.join(names)}" for note, names in notes.items() if names)])

    def __str__(self) -> str:
        count = np.bincount(np.asarray(self.status), minlength=len(STATUS))
        ends = [f"{n} {text}" for n, text in zip(count, STATUS) if n]
        rows = [
            f"{name.ljust(6)}  median {np.median(value):.4g} +- {np.median(self.stderr[name]):.2g}"
            for name, value in self.traits.items()
        ]
        return "\n".join([*rows, f"rmse, median {np.median(self.rmse):.2g}; leaves: {', '.join(ends)}"])


def invert_leaves(
    wavelengths: ArrayLike | Sequence[float],
    reflectance: ArrayLike | Sequence | None,
    transmittance: ArrayLike | Sequence | None = None,
    *,
    unknowns: Sequence[str] | None = None,
    leaf: Prospect | None = None,
    bounds: Mapping[str, Sequence[float]] | None = None,
    noise: ArrayLike | Sequence | None = None,
    max_steps: int = 50,
    chunk: int = 20,
) -> LeafFit:
    """Retrieve leaf traits from directional-hemispherical reflectance and transmittance, by PROSPECT.

    Every leaf is fitted on its own. Missing samples are left out. A leaf that has no sample or does not
    converge is marked so in its status and does not affect the others. Results are in JAX's default
    precision. Equal shapes compile once (a few seconds).

    On measured leaves PROSPECT's own error, which is correlated between neighbouring bands, exceeds the
    noise. Standard errors take samples as independent and are then too small. The choice of traits matters:
    without Cant and Cbrown, `unknowns=("N", "Cab", "Car", "Cw", "Cm")`, root mean squared errors in ug/cm2
    become 4.9 instead of 6.6 (Cab) and 3.7 instead of 2.7 (Car) on ANGERS, 10.9 instead of 8.7 and 4.8
    instead of 2.9 on LOPEX.

    **Arguments:**

    - `wavelengths`: (wavelengths,) nm, in any order, within PROSPECT's 400 to 2500.
    - `reflectance`, `transmittance`: (leaves, wavelengths) fractions, or (wavelengths,) of one leaf; NaN
      where a sample is missing. One of the two may be None, but without transmittance the data hardly
      constrain N apart from the other traits.
    - `unknowns`: names out of "N" and the traits of the version. Default None: all of them.
    - `leaf`: a `Prospect` that gives the version, alpha and coefficients, the starting values of the unknowns
      and the fixed values of the other traits; its traits are scalars or of shape (leaves,). Default None:
      that of `Prospect()`.
    - `bounds`: (low, high) by name. Default None: N 1 to 5; Cab 0 to 150, Car and Cant 0 to 50 ug/cm2; Cbrown
      0 to 5; Cw 0 to 0.1 cm; Cm and Cc 0 to 0.1, Cp 0 to 0.02 g/cm2. Those given replace these by name.
    - `noise`: one standard deviation, above 0, of all samples, or an array that broadcasts to
      (leaves, 2, wavelengths), the middle axis reflectance and transmittance. Infinity leaves a sample out.
      Default None: unknown and the same for all samples; standard errors are then scaled by the residuals.
    - `max_steps`: most points tried by a fit, 1 or more; measured leaves need two to fifteen. Default 50.
    - `chunk`: most leaves fitted at once, 1 or more; speed is the same from 10 to 40. Default 20.

    **Returns:** a `LeafFit`.

    **Raises:** ValueError naming field, value and admissible range: spectra outside -1 to 2 (in per cent,
    say), of shapes that differ or do not fit the wavelengths, or both None; wavelengths outside the table;
    noise that is not above 0; unknowns or bounds that the version does not have, or given twice; bounds that
    do not increase or admit N below 1 or negative contents; a start outside its bounds; `max_steps` or
    `chunk` below 1.

    **Source:** Jacquemoud et al. (1996), Remote Sens. Environ. 56, 194; Feret et al. (2017), 193, 204.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion
    >>> import numpy as np
    >>> bands = np.arange(400.0, 2501.0, 10.0)
    >>> reflectance, transmittance = jl.Prospect(Cab=50.0, Cw=0.012)(bands)
    >>> fit = inversion.invert_leaves(bands, reflectance, transmittance)
    >>> print(f"Cab {float(fit.traits['Cab'][0]):.1f} ug/cm2, Cw {float(fit.traits['Cw'][0]):.3f} cm")
    Cab 50.0 ug/cm2, Cw 0.012 cm
    """
    leaf = Prospect() if leaf is None else leaf
    known = ("N", *TRAITS[leaf.version])
    names = known if unknowns is None else tuple(unknowns)
    observed, sigma = _data(wavelengths, reflectance, transmittance, noise)
    start, low, high = _limits(leaf, known, names, bounds or {}, len(observed))
    for field, value in (("max_steps", max_steps), ("chunk", chunk)):
        if value != int(value) or value < 1:
            raise ValueError(f"{field} = {value} is outside the admissible range [1, inf) of integers")
    dtype = jnp.zeros(()).dtype
    sigma = jnp.broadcast_to(jnp.asarray(sigma, dtype), observed.shape)
    start, low, high = (jnp.asarray(a, dtype) for a in (start, low, high))
    absorption, face = material(leaf, np.asarray(wavelengths, float))
    end = fit_all(
        Task(start, low, high, jnp.asarray(observed, dtype), sigma),
        absorption.astype(dtype),
        LeafSurface(*(jnp.asarray(x, dtype) for x in face)),
        len(names),
        int(max_steps),
        int(chunk),
    )
    best, index = end.best, [known.index(name) for name in names]
    chi2, square, normal = (np.asarray(a, float) for a in (best.chi2, best.square, best.normal))
    samples = np.count_nonzero(~np.isnan(observed) & np.isfinite(sigma), axis=(1, 2))
    reduced = chi2 / np.maximum(samples - len(names), 1)
    if noise is None:
        normal = normal / np.maximum(reduced, rounding(dtype) ** 2)[:, None, None]
        reduced = np.ones_like(reduced)
    errors = errors_of(normal[:, index][:, :, index], np.asarray(high - low, float)[:, index])
    stopped = np.where(np.asarray(end.steps) >= max_steps, 1, 2)
    found = dict(zip(known, best.x.T))
    at_bound = dict(zip(known, ((best.x <= low) | (best.x >= high)).T))
    # Traits that the version does not have are zero.
    shown = {name: found.get(name, jnp.zeros_like(best.chi2)) for name in _BOUNDS}
    return LeafFit(
        traits={name: found[name] for name in names},
        stderr=dict(zip(names, jnp.asarray(errors.T, dtype))),
        at_bound={name: at_bound[name] for name in names},
        leaves=eqx.tree_at(lambda p: [getattr(p, n) for n in _BOUNDS], leaf, list(shown.values())),
        rmse=jnp.asarray(np.sqrt(square / np.maximum(samples, 1)), dtype),
        reduced_chi2=jnp.asarray(reduced, dtype),
        n_steps=end.steps,
        status=jnp.asarray(np.where(samples == 0, 3, np.where(end.done, 0, stopped))),
    )


def _data(
    wavelengths: Any, reflectance: Any, transmittance: Any, noise: Any
) -> tuple[Float[np.ndarray, "leaves 2 wavelengths"], Float[np.ndarray, "_ _ _"]]:
    """Spectra, NaN where there is no sample, and standard deviations that broadcast to them."""
    x = np.asarray(wavelengths, float)
    if x.ndim != 1 or x.size == 0:
        raise ValueError(f"wavelengths has the shape {x.shape}; admissible is (wavelengths,), one or more")
    given = {"reflectance": reflectance, "transmittance": transmittance}
    spectra = {name: np.atleast_2d(np.asarray(s, float)) for name, s in given.items() if s is not None}
    if not spectra:
        raise ValueError(
            "reflectance = None and transmittance = None; admissible is an array for one or both"
        )
    shape = (len(next(iter(spectra.values()))), x.size)
    for name, s in spectra.items():
        if s.shape != shape or len(s) == 0:
            raise ValueError(
                f"{name} has the shape {s.shape}; admissible is (leaves, wavelengths), one leaf or more, "
                f"here {shape}"
            )
        check_range(name, s[~np.isnan(s)], -1.0, 2.0)
    observed = np.stack([spectra.get(name, np.full(shape, np.nan)) for name in given], axis=1)
    sigma = np.asarray(1.0 if noise is None else noise, float)
    try:
        np.broadcast_to(sigma, observed.shape)
    except ValueError:
        raise ValueError(
            f"noise has the shape {sigma.shape}, which does not broadcast to (leaves, 2, wavelengths) = "
            f"{observed.shape}"
        ) from None
    if not np.all(sigma > 0):
        raise ValueError(f"noise = {sigma[~(sigma > 0)].flat[0]:g} is outside the admissible range (0, inf]")
    return observed, sigma[(None,) * (3 - sigma.ndim)]


def _limits(
    leaf: Prospect, known: tuple[str, ...], names: tuple[str, ...], bounds: Mapping[str, Any], count: int
) -> list[Float[np.ndarray, "leaves traits"]]:
    """Start, lower and upper bounds of N and all traits; traits that are not unknowns have equal bounds."""
    admissible = ", ".join(known)
    for i, name in enumerate(names):
        if name not in known or name in names[:i]:
            raise ValueError(f"unknowns = {names}: {name!r} is given twice or is none of {admissible}")
    if not names:
        raise ValueError(f"unknowns is empty; admissible is one or more of {admissible}")
    for name in bounds:
        if name not in names:
            raise ValueError(f"bounds: {name!r} is none of the unknowns {', '.join(names)}")
    columns = []
    for name in known:
        value = np.asarray(getattr(leaf, name), float)
        if value.shape not in ((), (count,)):
            raise ValueError(f"leaf: {name} has the shape {value.shape}; admissible is () or ({count},)")
        low = high = value
        if name in names:
            try:
                low, high = (float(b) for b in bounds.get(name, _BOUNDS[name]))
            except (TypeError, ValueError):
                raise ValueError(f"bounds: {name} = {bounds[name]!r} is not a pair (low, high)") from None
            check_range(f"bounds: lower of {name}", low, _BOUNDS[name][0])
            check_range(f"bounds: upper of {name}", high, low, low_open=True)
            check_range(f"leaf: the start of {name}", value, low, high)
        columns.append([np.broadcast_to(a, count) for a in (value, low, high)])
    return list(np.stack(columns, axis=2))
