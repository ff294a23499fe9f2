"""Retrieval of leaf traits from reflectance and transmittance: inversion of PROSPECT for many leaves."""

from collections.abc import Mapping, Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from inversion.leaf.leaf_domains import bands_of, domains_of
from inversion.leaf.leaf_errors import Stage, inverse_root, trait_errors
from inversion.leaf.leaf_solver import State, Task, fit_all
from jaxlidar import Prospect
from jaxlidar.extend import check_range
from jaxlidar.optics.coefficients import TRAITS
from jaxlidar.optics.leaf_surface import LeafSurface
from jaxlidar.optics.prospect import material

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
    - `stderr`: by name, (leaves,) one standard error, of noise and PROSPECT's own error; infinite where the
      spectra do not constrain the trait. That of a trait on a bound is computed as if there were no bound.
    - `at_bound`: by name, (leaves,) whether the value lies on one of its bounds.
    - `domain`: by name, (intervals, 2) first and last wavelength, nm, of the bands that gave the trait.
    - `leaves`: the fitted leaves, for `prospect_spectra`: a `Prospect` whose traits have shape (leaves,).
    - `rmse`: (leaves,) root mean square of the residuals of all samples used, of both spectra; zero where
      there are none. This and the next two are of the fit to all bands.
    - `reduced_chi2`: (leaves,) sum of squared residuals over their variances, divided by the number of
      samples less that of unknowns. One by construction where no noise was given.
    - `n_steps`: (leaves,) points tried with all bands, each one PROSPECT with its Jacobian. Two is usual:
      spectra of many bands are first fitted to a part of them, and those points are not counted.
    - `status`: (leaves,) how the fit ended, index of a sentence of `inversion.leaf.leaves.STATUS`; 0 is
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
    domain: dict[str, Float[Array, "intervals 2"]]
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
    domain: str | Mapping[str, Sequence] | None = None,
    noise: ArrayLike | Sequence | None = None,
    max_steps: int = 50,
    chunk: int = 20,
) -> LeafFit:
    """Retrieve leaf traits from directional-hemispherical reflectance and transmittance, by PROSPECT.

    Every leaf is fitted on its own. Missing samples are left out. A leaf that has no sample or does not
    converge is marked so in its status and does not affect the others. Results are in JAX's default
    precision. Equal shapes compile once (a few seconds).

    Standard errors hold PROSPECT's own error too, correlated over wavelengths; its size and length follow
    from the residuals of each leaf. They do not hold what residuals do not show, such as an absorption
    coefficient that is wrong by the same factor everywhere.

    Root mean squared errors on the measured leaves of two databases, and how many of them lie within two
    standard errors:

    | | Cab, ug/cm2 | Car, ug/cm2 | Cw, cm | Cm, g/cm2 |
    | --- | --- | --- | --- | --- |
    | ANGERS, all bands | 6.6, 85 % | 2.7, 82 % | 0.0022, 96 % | 0.0027, 75 % |
    | ANGERS, recommended | 4.7, 92 % | 2.2, 90 % | 0.0014, 99 % | 0.0010, 99 % |
    | LOPEX, all bands | 8.7, 78 % | 2.9, 69 % | 0.0010, 100 % | 0.0022, 55 % |
    | LOPEX, recommended | 10.7, 69 % | 2.6, 69 % | 0.0008, 100 % | 0.0013, 100 % |

    The recommended domains serve Car, Cw and Cm on both; for Cab they are worse on LOPEX. Without Cant and
    Cbrown, `unknowns=("N", "Cab", "Car", "Cw", "Cm")`, the error of Cab over all bands becomes 4.9 and that
    of Car 3.7 on ANGERS, 10.9 and 4.8 on LOPEX.

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
    - `domain`: the bands that each trait comes from: (low, high) in nm by name, or several such pairs, or
      "recommended": Cab 700 to 720, Car 520 to 560, Cw and Cm 1700 to 2400. All bands are fitted first.
      Traits of equal domains are then fitted together to their bands, with N if both spectra are given; the
      others keep their values. Traits without a domain come from all bands. Default None: all do.
    - `noise`: one standard deviation, above 0, of all samples, or an array that broadcasts to
      (leaves, 2, wavelengths), the middle axis reflectance and transmittance. Infinity leaves a sample out.
      PROSPECT's own error comes on top. Default None: unknown and the same for all samples.
    - `max_steps`: most points tried by a fit, 1 or more; measured leaves need two to fifteen. Default 50.
    - `chunk`: most leaves fitted at once, 1 or more; speed is the same from 10 to 40. Default 20.

    **Returns:** a `LeafFit`.

    **Raises:** ValueError naming field, value and admissible range: spectra outside -1 to 2 (in per cent,
    say), of shapes that differ or do not fit the wavelengths, or both None; wavelengths outside the table;
    noise that is not above 0; unknowns or bounds that the version does not have, or given twice; bounds that
    do not increase or admit N below 1 or negative contents; a start outside its bounds; a domain that is no
    pair of wavelengths, of no unknown, or of which the wavelengths do not span half; `max_steps` or `chunk`
    below 1.

    **Source:** Jacquemoud et al. (1996), Remote Sens. Environ. 56, 194; Feret et al. (2017), 193, 204;
    domains of Feret et al. (2019), 231, 110959 and Spafford et al. (2021), 252, 112176, who fit other
    traits along with Cab and Car and fix the rest at common values; errors as in `inversion.leaf_errors`.

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
    x = np.asarray(wavelengths, float)
    groups = [(group, *bands_of(x, span, group)) for span, group in domains_of(domain, names).items()]
    dtype = jnp.result_type(float)
    absorption, face = material(leaf, x)
    absorption, face = absorption.astype(dtype), jax.tree.map(lambda a: jnp.asarray(a, dtype), face)
    sigma = jnp.broadcast_to(jnp.asarray(sigma, dtype), observed.shape)
    start, low, high = (jnp.asarray(a, dtype) for a in (start, low, high))
    task = Task(start, low, high, jnp.asarray(observed, dtype), sigma)

    def fit(task: Task, free: Sequence[str], bands: np.ndarray) -> tuple[State, Stage, np.ndarray]:
        """The fit of some traits, the others fixed, to some bands, and which traits it leaves open."""
        fixed = np.array([name not in free for name in known])
        end = fit_all(
            task._replace(
                low=jnp.where(fixed[None], task.start, task.low),
                high=jnp.where(fixed[None], task.start, task.high),
                observed=task.observed[..., bands],
                sigma=task.sigma[..., bands],
            ),
            absorption[:, bands],
            LeafSurface(*(a[bands] for a in face)),
            len(free),
            int(max_steps),
            int(chunk),
        )
        normal = np.asarray(end.best.normal, float)
        root, lost = inverse_root(normal * np.outer(~fixed, ~fixed))
        root = root * ~fixed[:, None]
        link = root @ root.transpose(0, 2, 1) @ (normal * fixed)
        used = jnp.broadcast_to(jnp.asarray(bands, dtype), (len(normal), x.size))
        return end, Stage(end.best.x, jnp.asarray(root, dtype), jnp.asarray(link, dtype), used), lost

    end, stage, lost = fit(task, names, np.ones(x.size, bool))
    stages, ends = [stage._replace(link=jnp.zeros_like(stage.link))], [end]
    of, best = np.zeros(len(known), int), end.best.x
    domains = {name: np.array([[x.min(), x.max()]]) for name in names}
    both = reflectance is not None and transmittance is not None
    for group, bands, span in groups:
        # Of one spectrum alone, the bands of a domain do not tell N apart from the traits.
        free = [n for n in names if n in group or (n == "N" and both)]
        other, stage, open_ = fit(task._replace(start=end.best.x), free, bands)
        mine = np.array([name in group for name in known])
        of[mine] = len(stages)
        best, lost = jnp.where(mine[None], other.best.x, best), np.where(mine, open_, lost)
        domains |= dict.fromkeys(group, span)
        stages, ends = [*stages, stage], [*ends, other]
    errors = trait_errors(
        x, task.observed, sigma, absorption, face, stages, of, noise is not None, int(chunk)
    )
    errors = jnp.where(lost | (errors > task.high - task.low), jnp.inf, errors)
    samples = np.count_nonzero(~np.isnan(observed) & np.isfinite(sigma), axis=(1, 2))
    reduced = end.best.chi2 / np.maximum(samples - len(names), 1)
    done = jnp.stack([e.done for e in ends])
    tried = jnp.stack([e.steps for e in ends])
    stopped = jnp.where(jnp.any(~done & (tried >= max_steps), axis=0), 1, 2)
    found, error = (dict(zip(known, a.T)) for a in (best, errors))
    at_bound = dict(zip(known, ((best <= task.low) | (best >= task.high)).T))
    # Traits that the version does not have are zero.
    shown = {name: found.get(name, jnp.zeros_like(reduced)) for name in _BOUNDS}
    return LeafFit(
        traits={name: found[name] for name in names},
        stderr={name: error[name] for name in names},
        at_bound={name: at_bound[name] for name in names},
        domain={name: jnp.asarray(domains[name], dtype) for name in names},
        leaves=eqx.tree_at(lambda p: [getattr(p, n) for n in _BOUNDS], leaf, list(shown.values())),
        rmse=jnp.sqrt(end.best.square / np.maximum(samples, 1)),
        reduced_chi2=jnp.ones_like(reduced) if noise is None else reduced,
        n_steps=end.steps,
        status=jnp.where(samples == 0, 3, jnp.where(jnp.all(done, axis=0), 0, stopped)),
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
