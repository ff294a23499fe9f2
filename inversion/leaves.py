"""Leaf traits from measured reflectance and transmittance: PROSPECT inverted, many leaves at once."""

from collections.abc import Mapping, Sequence
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxlidar import Prospect
from jaxlidar.extend import check_range
from jaxlidar.optics.coefficients import TRAITS
from jaxlidar.optics.plate_model import Surface
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
    """Fitted leaves. Dictionaries are keyed by the names of the unknowns, in the units of `Prospect`.

    - `traits`: (leaves,) best values. - `stderr`: one standard error each; infinite where the spectra do not
      determine the trait. Of a trait on a bound, as if the bound were not there.
    - `at_bound`: whether the value lies on one of its bounds.
    - `leaves`: the fitted leaves, for `prospect_spectra`: a `Prospect` whose traits have shape (leaves,).
    - `rmse`: (leaves,) root of the mean squared residual of all samples used, of both spectra; zero where
      there are none.
    - `reduced_chi2`: (leaves,) sum of squared residuals over their variances, by the number of samples less
      that of unknowns. One by construction where no noise was given.
    - `n_steps`: (leaves,) points tried with all bands, each one PROSPECT with its Jacobian; two is usual, for
      spectra of many bands are first fitted at a part of them, and those points are not counted.
    - `status`: (leaves,) how it ended, number of a sentence of `inversion.leaves.STATUS`; 0 is convergence.
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
        """Which leaves ended at a minimum."""
        return self.status == 0

    def sentence(self, leaf: int) -> str:
        """How the fit of one leaf ended."""
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
    """Find the traits of leaves from directional-hemispherical reflectance and transmittance.

    Every leaf is fitted by itself: samples that are missing are left out, and a leaf without any, or one that
    does not converge, says so in its status and leaves the others alone.

    On measured leaves PROSPECT's own error, alike in neighbouring bands, exceeds the noise: standard errors,
    which take samples as independent, are then too small. Which traits to seek matters: without Cant and
    Cbrown, `unknowns=("N", "Cab", "Car", "Cw", "Cm")`, root mean squared errors in ug/cm2 become 4.9 instead
    of 6.6 (Cab) and 3.7 instead of 2.7 (Car) on ANGERS, 10.9 instead of 8.7 and 4.8 instead of 2.9 on LOPEX.

    **Arguments:**

    - `wavelengths`: (wavelengths,) nm, in any order, within PROSPECT's 400..2500.
    - `reflectance`, `transmittance`: (leaves, wavelengths) fractions, or (wavelengths,) of one leaf; NaN
      where a sample is missing. Either may be None, but without transmittance N is hardly told from the rest.
    - `unknowns`: names out of "N" and the traits of the version. Default: all of them.
    - `leaf`: gives the version, alpha and coefficients, the values that unknowns start from and those that
      the others keep; its traits are scalars or of shape (leaves,). Default `Prospect()`.
    - `bounds`: (low, high) by name. Default: N 1..5; Cab 0..150, Car and Cant 0..50 ug/cm2; Cbrown 0..5;
      Cw 0..0.1 cm; Cm and Cc 0..0.1, Cp 0..0.02 g/cm2.
    - `noise`: one standard deviation of all samples, or an array that broadcasts to (leaves, 2, wavelengths),
      the middle axis reflectance and transmittance. Infinity leaves a sample out. Default: alike for all
      and unknown, so that standard errors are scaled by the residuals.
    - `max_steps`: most points tried by a fit, 1 or more (default 50; measured leaves need two to fifteen).
    - `chunk`: most leaves fitted at once, 1 or more (default 20; from 10 to 40 are alike).

    Results are in JAX's default precision. Equal shapes compile once (a few seconds).

    **Raises:** ValueError naming field, value and admissible range: spectra outside -1..2 (per cent, say),
    of another shape than each other or than the wavelengths, or both None; wavelengths outside the table;
    noise that is not above 0; unknowns or bounds that are none of the version's, or twice; bounds that do not
    increase or admit N below 1 or negative contents; a start outside its bounds; max_steps or chunk below 1.

    **Source:** Jacquemoud et al. (1996), Remote Sens. Environ. 56, 194; Feret et al. (2017), 193, 204.
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
        Surface(*(jnp.asarray(x, dtype) for x in face)),
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
    # Traits that the version does not know are zero.
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
    """Start, lower and upper bounds of N and all traits; those that are not sought have no room."""
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
