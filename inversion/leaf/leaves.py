"""Retrieval of leaf traits from reflectance and transmittance: inversion of PROSPECT for many leaves.

1. Every leaf is fitted to all its bands by weighted least squares (`solver.py`).
2. Traits with a spectral domain of their own are fitted again to its bands, with the others fixed. PROSPECT's
   errors then affect them less, because in these bands few other constituents absorb (Feret et al. 2019).
3. Standard errors include PROSPECT's own error, correlated over wavelengths (`errors.py`).
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from inversion.leaf.errors import LinearisedFit, inverse_root, trait_errors
from inversion.leaf.solver import LeafFitState, LeafProblem, fit_leaves
from jaxlidar import Prospect
from jaxlidar.extend import as_numpy, check_integer, check_numbers, check_range, warn_user
from jaxlidar.optics.coefficients import TRAITS
from jaxlidar.optics.leaf_surface import LeafSurface
from jaxlidar.optics.prospect import material

# Default bounds of N and contents, in the units of `Prospect`; the lower ones are the least admissible.
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
# Domains "recommended", nm: Feret et al. (2019), Remote Sens. Environ. 231, 110959 (Cw, Cm); Feret et al.
# (2021), 252, 112173 (Cp, Cc); Spafford et al. (2021), 252, 112176 (Cab, Car). Other traits have none.
_RECOMMENDED_DOMAINS = {
    "Cab": ((700.0, 720.0),),
    "Car": ((520.0, 560.0),),
    "Cw": ((1700.0, 2400.0),),
    "Cm": ((1700.0, 2400.0),),
}
# The same for needles, for the traits whose domain is another one.
_NEEDLE_DOMAIN = ((1500.0, 1800.0), (2050.0, 2400.0))
_NEEDLE_TRAITS = ("Cw", "Cm")
# Relative errors of chemistry that no spectrum shows, with the recommended domains: Cab and Car come out 7 %
# and 8 % too low on ANGERS, and 16 % and 19 % too high on LOPEX, in the median; these are about the root
# mean squares. Coefficients of PROSPECT and the extraction of pigments, which differs between laboratories,
# have a part in them.
_CALIBRATION = {"Cab": 0.12, "Car": 0.14}
# Transmittance of gaps above which a leaf is taken for needles.
_GAP_LIGHT = 0.015
# Fraction of an interval of a domain that the bands must span.
_LEAST_SPAN = 0.5
# Spectra outside of this range are no fractions (per cent, say).
_SPECTRUM_RANGE = (-1.0, 2.0)
STATUS = (
    "converged",
    "not converged: stopped at max_steps",
    "not converged: no step improves the fit",
    "not fitted: no sample to fit, values are those of the start",
)


# Wavelength intervals of a domain, (low, high) in nm.
Intervals = tuple[tuple[float, float], ...]


class GapLightWarning(UserWarning):
    """Leaves of which light passes gaps, as between needles, were fitted as if they had none.

    **Example:** no such warning, of leaves that are known to be no needles.

    >>> import inversion, warnings
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", inversion.GapLightWarning)
    """


@final
class LeafFit(eqx.Module):
    """The result of `invert_leaves`: leaf traits and their standard errors.

    Dictionaries are keyed by the names of the unknowns, in the units of `Prospect`. `print(fit)` shows a
    summary.

    - `traits`: by name, (leaves,) best values.
    - `stderr`: by name, (leaves,) one standard error, of noise and PROSPECT's own error; infinite for a trait
      that the spectra do not constrain. That of a trait on a bound is computed as if there were no bound.
    - `at_bound`: by name, (leaves,) True if the value lies on one of its bounds.
    - `domain`: by name, (intervals, 2) first and last wavelength, nm, of the bands that gave the trait; of
      leaves other than needles, if there are any.
    - `leaves`: the fitted leaves: a `Prospect` whose traits have shape (leaves,).
    - `rmse`: (leaves,) root mean square of the residuals of all samples used, of both spectra; zero for a
      leaf without samples. This and the next two are of the fit to all bands.
    - `reduced_chi2`: (leaves,) sum of squared residuals over their variances, divided by the number of
      samples less that of unknowns. One by construction if no noise was given.
    - `n_steps`: (leaves,) points tried with all bands, each one PROSPECT with its Jacobian. Two is usual: if
      there are many bands, a preliminary fit takes some of them only, and its points are not counted.
    - `status`: (leaves,) outcome of the fit, index of a sentence of `inversion.leaf.leaves.STATUS`; 0 is
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
        """True for each leaf whose fit ended at a minimum."""
        return self.status == 0

    def sentence(self, leaf: int) -> str:
        """Describe the outcome of one leaf's fit in a sentence, with traits not determined or at a bound.

        **Arguments:**

        - `leaf`: index of the leaf.

        **Returns:** the sentence.
        """
        text = f"{STATUS[int(self.status[leaf])]} after {int(self.n_steps[leaf])} steps"
        notes = {
            "not determined": [name for name, e in self.stderr.items() if not np.isfinite(e[leaf])],
            "at a bound": [name for name, at_bound in self.at_bound.items() if at_bound[leaf]],
        }
        return "; ".join([text, *(f"{note}: {', '.join(names)}" for note, names in notes.items() if names)])

    def __str__(self) -> str:
        count = np.bincount(np.asarray(self.status), minlength=len(STATUS))
        outcomes = [f"{n} {text}" for n, text in zip(count, STATUS) if n]
        rows = [
            f"{name.ljust(6)}  median {np.median(value):.4g} +- {np.median(self.stderr[name]):.2g}"
            for name, value in self.traits.items()
        ]
        return "\n".join([*rows, f"rmse, median {np.median(self.rmse):.2g}; leaves: {', '.join(outcomes)}"])


def invert_leaves(
    wavelengths: ArrayLike | Sequence[float],
    reflectance: ArrayLike | Sequence | None,
    transmittance: ArrayLike | Sequence | None = None,
    *,
    unknowns: Sequence[str] | None = None,
    leaf: Prospect | None = None,
    bounds: Mapping[str, Sequence[float]] | None = None,
    domain: str | Mapping[str, Sequence] | None = None,
    needle: ArrayLike | Sequence | None = None,
    noise: ArrayLike | Sequence | None = None,
    max_steps: int = 50,
    chunk: int = 20,
) -> LeafFit:
    """Retrieve leaf traits from directional-hemispherical reflectance and transmittance, by PROSPECT.

    Every leaf is fitted on its own. Missing samples are left out. The status of a leaf says if it has no
    sample or does not converge; other leaves are not affected. Results are in JAX's default precision. Equal
    shapes compile once (a few seconds).

    Standard errors include PROSPECT's own error, correlated over wavelengths; its size and length follow from
    the residuals of each leaf. They miss errors that residuals do not show, such as an absorption coefficient
    that is wrong by the same factor everywhere. With the recommended domains, 12 % of Cab and 14 % of Car
    stand for these: the root mean squares of the median errors on two databases.

    Root mean squared errors on the measured leaves of three databases, and the fraction of values within two
    standard errors:

    | | Cab, ug/cm2 | Car, ug/cm2 | Cw, cm | Cm, g/cm2 |
    | --- | --- | --- | --- | --- |
    | ANGERS, all bands | 6.6, 85 % | 2.7, 82 % | 0.0022, 96 % | 0.0027, 75 % |
    | ANGERS, recommended | 4.7, 96 % | 2.2, 92 % | 0.0014, 99 % | 0.0010, 99 % |
    | LOPEX, all bands | 8.7, 78 % | 2.9, 69 % | 0.0010, 100 % | 0.0022, 55 % |
    | LOPEX, recommended | 10.7, 94 % | 2.6, 88 % | 0.0008, 100 % | 0.0013, 100 % |
    | NASA FFT, broad leaves, recommended | | | 0.0010, 97 % | 0.0009, 99 % |
    | NASA FFT, needles, recommended | | | 0.0061, 96 % | 0.0038, 99 % |

    The recommended domains serve Car, Cw and Cm on both; for Cab they are worse on LOPEX. Without Cant and
    Cbrown, `unknowns=("N", "Cab", "Car", "Cw", "Cm")`, the error of Cab over all bands becomes 4.9 and that
    of Car 3.7 on ANGERS, 10.9 and 4.8 on LOPEX.

    Needles are measured side by side, and light passes the gaps between them. It matters most where needles
    are opaque, in visible light and about 1940 nm, which their domain leaves out. In the recommended domains
    of leaves, Cm of the needles of NASA FFT is 0.0070 g/cm2 too high, and 0.0015 in that of needles. Leaves
    with such light that are not said to be needles give a `GapLightWarning`.

    **Arguments:**

    - `wavelengths`: (wavelengths,) nm, in any order, within PROSPECT's 400 to 2500.
    - `reflectance`, `transmittance`: (leaves, wavelengths) fractions, or (wavelengths,) of one leaf; missing
      samples are NaN. One of the two may be None, but without transmittance the data hardly
      separate N from the other traits.
    - `unknowns`: names out of "N" and the traits of the version. Default None: all of them.
    - `leaf`: a `Prospect` that gives the version, alpha and coefficients, the starting values of the unknowns
      and the fixed values of the other traits; its traits are scalars or of shape (leaves,). Default None:
      that of `Prospect()`.
    - `bounds`: (low, high) by name. Default None: N 1 to 5; Cab 0 to 150, Car and Cant 0 to 50 ug/cm2; Cbrown
      0 to 5; Cw 0 to 0.1 cm; Cm and Cc 0 to 0.1, Cp 0 to 0.02 g/cm2. Those given replace these by name.
    - `domain`: the bands that each trait is fitted to: (low, high) in nm by name, or several such pairs, or
      "recommended": Cab 700 to 720, Car 520 to 560, Cw and Cm 1700 to 2400. All bands are fitted first.
      Traits of equal domains are then fitted together to their bands, with N if both spectra are given; other
      traits keep their values. Traits without a domain come from all bands. Default None: all traits do.
    - `needle`: True for needles, one value or (leaves,). In the recommended domains, their Cw and Cm come
      from 1500 to 1800 and 2050 to 2400 nm. Default None: no leaf is.
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
    pair of wavelengths, belongs to no unknown, or is not half spanned by the wavelengths; `needle` with
    another domain than "recommended", or of another shape; `max_steps` or `chunk` below 1. TypeError for
    `needle` that is not True or False.

    **Source:** Jacquemoud et al. (1996), Remote Sens. Environ. 56, 194; Feret et al. (2017), 193, 204;
    domains of Feret et al. (2019), 231, 110959 and Spafford et al. (2021), 252, 112176, who fit other
    traits along with Cab and Car and fix the rest at common values; the domain of needles is what the gaps
    leave of 1500 to 2400 nm; errors as in `inversion.leaf.errors`.

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
    trait_names = ("N", *TRAITS[leaf.version])
    unknown_names = trait_names if unknowns is None else tuple(unknowns)
    observed, sigma = _check_spectra(wavelengths, reflectance, transmittance, noise)
    start, low, high = _start_and_bounds(leaf, trait_names, unknown_names, bounds or {}, len(observed))
    for field, value in (("max_steps", max_steps), ("chunk", chunk)):
        check_integer(field, value)
    x = as_numpy(wavelengths, "wavelengths")
    is_needle = _check_needle(needle, domain, len(observed))
    domains = _trait_domains(x, domain, unknown_names, is_needle)
    dtype = jnp.result_type(float)
    # Tables at the wavelengths of the spectra, and the solver's precision.
    absorption, surface = material(leaf, x)
    absorption, surface = absorption.astype(dtype), jax.tree.map(lambda a: jnp.asarray(a, dtype), surface)
    sigma = jnp.broadcast_to(jnp.asarray(sigma, dtype), observed.shape)
    start, low, high = (jnp.asarray(a, dtype) for a in (start, low, high))
    problem = LeafProblem(start, low, high, jnp.asarray(observed, dtype), sigma)

    def fit_bands(
        problem: LeafProblem, free_names: Sequence[str], leaf_bands: Bool[np.ndarray, "_ wavelengths"]
    ) -> tuple[LeafFitState, LinearisedFit, np.ndarray]:
        """Fit some traits, the others fixed, to some bands; True for traits that are not determined.

        `leaf_bands`: True for the bands to use, of each leaf or, with a first axis of one, of all.
        """
        is_fixed = np.array([name not in free_names for name in trait_names])
        # Bands that another leaf alone uses have infinite noise.
        bands = np.any(leaf_bands, axis=0)
        sigma = jnp.where(jnp.asarray(leaf_bands[:, None, bands]), problem.sigma[..., bands], jnp.inf)
        state = fit_leaves(
            problem._replace(
                low=jnp.where(is_fixed[None], problem.start, problem.low),
                high=jnp.where(is_fixed[None], problem.start, problem.high),
                observed=problem.observed[..., bands],
                sigma=sigma,
            ),
            absorption[:, bands],
            LeafSurface(*(a[bands] for a in surface)),
            # Arguments that are traced: other values do not compile again.
            len(free_names),
            int(max_steps),
            int(chunk),
        )
        normal = np.asarray(state.best.normal, float)
        root, is_undetermined = inverse_root(normal * np.outer(~is_fixed, ~is_fixed))
        root = root * ~is_fixed[:, None]
        # Implicit differentiation of J'Wr = 0: dx_free = -(J'WJ)^-1 J'WJ_fixed dx_fixed.
        link = root @ root.transpose(0, 2, 1) @ (normal * is_fixed)
        used_bands = jnp.broadcast_to(jnp.asarray(leaf_bands, dtype), (len(normal), x.size))
        linearised = LinearisedFit(
            state.best.x, jnp.asarray(root, dtype), jnp.asarray(link, dtype), used_bands
        )
        return state, linearised, is_undetermined

    # All bands, for all unknowns.
    all_bands, linearised, is_undetermined = fit_bands(problem, unknown_names, np.ones((1, x.size), bool))
    linearised_fits, states = [linearised._replace(link=jnp.zeros_like(linearised.link))], [all_bands]
    fit_of_trait, best = np.zeros(len(trait_names), int), all_bands.best.x
    band_limits = {name: np.array([[x.min(), x.max()]]) for name in unknown_names}

    # Each domain, for its traits. One spectrum alone does not separate N from them in so few bands.
    has_both_spectra = reflectance is not None and transmittance is not None
    for names, bands, limits in domains:
        free_names = [n for n in unknown_names if n in names or (n == "N" and has_both_spectra)]
        state, linearised, is_undetermined_in_domain = fit_bands(
            problem._replace(start=all_bands.best.x), free_names, bands
        )
        is_of_domain = np.array([name in names for name in trait_names])
        fit_of_trait[is_of_domain] = len(linearised_fits)
        # N comes from all bands, also where it was free.
        best = jnp.where(is_of_domain[None], state.best.x, best)
        is_undetermined = np.where(is_of_domain, is_undetermined_in_domain, is_undetermined)
        band_limits |= dict.fromkeys(names, limits)
        linearised_fits, states = [*linearised_fits, linearised], [*states, state]

    errors, gap_light = trait_errors(
        x,
        problem.observed,
        sigma,
        absorption,
        surface,
        linearised_fits,
        fit_of_trait,
        noise is not None,
        int(chunk),
    )
    if domain == "recommended":
        # Gap light has no colour and PROSPECT no gaps: where leaves are opaque it shows.
        unflagged = np.flatnonzero((gap_light > _GAP_LIGHT) & ~is_needle)
        if unflagged.size:
            first = ", ".join(map(str, unflagged[:5])) + (", ..." if unflagged.size > 5 else "")
            warn_user(
                f"{unflagged.size} of {len(observed)} leaves ({first}) let more light through than leaves do "
                "where they are opaque, as needles with gaps between them do: their Cw and Cm are biased. "
                "needle=True for these leaves takes bands that gaps affect less",
                GapLightWarning,
            )
        calibration = jnp.asarray([_CALIBRATION.get(name, 0.0) for name in trait_names], dtype)
        errors = jnp.hypot(errors, calibration[None] * best)
    # An error larger than the width of the bounds adds nothing to them: the trait is not constrained.
    errors = jnp.where(is_undetermined | (errors > problem.high - problem.low), jnp.inf, errors)
    n_samples = np.count_nonzero(~np.isnan(observed) & np.isfinite(sigma), axis=(1, 2))
    reduced_chi2 = all_bands.best.chi2 / np.maximum(n_samples - len(unknown_names), 1)
    at_bound = dict(zip(trait_names, ((best <= problem.low) | (best >= problem.high)).T))
    values, stderr = dict(zip(trait_names, best.T)), dict(zip(trait_names, errors.T))
    # A `Prospect` has all traits; those that the version does not have are zero.
    all_values = [values.get(name, jnp.zeros_like(reduced_chi2)) for name in _BOUNDS]
    return LeafFit(
        traits={name: values[name] for name in unknown_names},
        stderr={name: stderr[name] for name in unknown_names},
        at_bound={name: at_bound[name] for name in unknown_names},
        domain={name: jnp.asarray(band_limits[name], dtype) for name in unknown_names},
        leaves=eqx.tree_at(lambda p: [getattr(p, name) for name in _BOUNDS], leaf, all_values),
        rmse=jnp.sqrt(all_bands.best.sum_of_squares / np.maximum(n_samples, 1)),
        reduced_chi2=jnp.ones_like(reduced_chi2) if noise is None else reduced_chi2,
        n_steps=all_bands.n_steps,
        status=_status(states, n_samples, max_steps),
    )


def _status(
    states: Sequence[LeafFitState], n_samples: Int[np.ndarray, " leaves"], max_steps: int
) -> Int[Array, " leaves"]:
    """Index into `STATUS` of each leaf: converged if all its fits have."""
    converged = jnp.stack([state.converged for state in states])
    tried = jnp.stack([state.n_steps for state in states])
    not_converged = jnp.where(jnp.any(~converged & (tried >= max_steps), axis=0), 1, 2)
    return jnp.where(n_samples == 0, 3, jnp.where(jnp.all(converged, axis=0), 0, not_converged))


def _check_spectra(
    wavelengths: Any, reflectance: Any, transmittance: Any, noise: Any
) -> tuple[Float[np.ndarray, "leaves 2 wavelengths"], Float[np.ndarray, "_ _ _"]]:
    """Return spectra, NaN for missing samples, and standard deviations that broadcast to them.

    **Raises:** ValueError for shapes that do not match and for values outside of their ranges.
    """
    x = as_numpy(wavelengths, "wavelengths")
    if x.ndim != 1 or x.size == 0:
        raise ValueError(f"wavelengths has the shape {x.shape}; admissible is (wavelengths,), one or more")
    arguments = {"reflectance": reflectance, "transmittance": transmittance}
    spectra = {name: np.atleast_2d(as_numpy(s, name)) for name, s in arguments.items() if s is not None}
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
        check_range(name, s[~np.isnan(s)], *_SPECTRUM_RANGE)
    observed = np.stack([spectra.get(name, np.full(shape, np.nan)) for name in arguments], axis=1)
    sigma = as_numpy(1.0 if noise is None else noise, "noise")
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


def _start_and_bounds(
    leaf: Prospect,
    trait_names: tuple[str, ...],
    unknown_names: tuple[str, ...],
    bounds: Mapping[str, Any],
    n_leaves: int,
) -> list[Float[np.ndarray, "leaves traits"]]:
    """Return start, lower and upper bounds of N and all contents; equal bounds fix those not unknown.

    **Raises:** ValueError for names that the version does not have, and for inadmissible bounds and starts.
    """
    admissible = ", ".join(trait_names)
    for i, name in enumerate(unknown_names):
        if name not in trait_names or name in unknown_names[:i]:
            raise ValueError(
                f"unknowns = {unknown_names}: {name!r} is given twice or is none of {admissible}"
            )
    if not unknown_names:
        raise ValueError(f"unknowns is empty; admissible is one or more of {admissible}")
    for name in bounds:
        if name not in unknown_names:
            raise ValueError(f"bounds: {name!r} is none of the unknowns {', '.join(unknown_names)}")
    columns = []
    for name in trait_names:
        value = np.asarray(getattr(leaf, name), float)
        if value.shape not in ((), (n_leaves,)):
            raise ValueError(f"leaf: {name} has the shape {value.shape}; admissible is () or ({n_leaves},)")
        low = high = value
        if name in unknown_names:
            check_numbers(f"bounds of {name}", bounds.get(name, _BOUNDS[name]))
            try:
                low, high = (float(b) for b in bounds.get(name, _BOUNDS[name]))
            except (TypeError, ValueError):
                raise ValueError(f"bounds: {name} = {bounds[name]!r} is not a pair (low, high)") from None
            check_range(f"bounds: lower of {name}", low, _BOUNDS[name][0])
            check_range(f"bounds: upper of {name}", high, low, low_open=True)
            check_range(f"leaf: the start of {name}", value, low, high)
        columns.append([np.broadcast_to(a, n_leaves) for a in (value, low, high)])
    return list(np.stack(columns, axis=2))


class _TraitDomain(NamedTuple):
    """Bands to which some traits are fitted.

    - `names`: of the traits.
    - `bands`: True for the bands of each leaf, or with a first axis of one, of all leaves.
    - `limits`: first and last wavelength of each interval, nm; of leaves other than needles, if any.
    """

    names: tuple[str, ...]
    bands: Bool[np.ndarray, "_ wavelengths"]
    limits: Float[np.ndarray, "intervals 2"]


def _check_needle(needle: Any, domain: Any, n_leaves: int) -> Bool[np.ndarray, " leaves"]:
    """Return True for needles.

    **Raises:** TypeError for other values than True and False, and ValueError for another number of leaves,
    or another domain than the recommended one.
    """
    if needle is None:
        return np.zeros(n_leaves, bool)
    is_needle = np.asarray(needle)
    if is_needle.dtype != bool:
        raise TypeError(f"needle has the type {is_needle.dtype}; admissible is True or False for each leaf")
    if is_needle.shape not in ((), (n_leaves,)):
        raise ValueError(f"needle has the shape {is_needle.shape}; admissible is () or ({n_leaves},)")
    if domain != "recommended":
        raise ValueError(
            f"needle is given with domain = {domain!r}; admissible is domain = 'recommended': over all bands "
            "light through gaps between needles biases the traits"
        )
    return np.broadcast_to(is_needle, (n_leaves,))


def _trait_domains(
    wavelengths: Float[np.ndarray, " wavelengths"],
    domain: str | Mapping[str, Any] | None,
    unknown_names: Sequence[str],
    is_needle: Bool[np.ndarray, " leaves"],
) -> list[_TraitDomain]:
    """Return the traits that are fitted to bands of their own. **Raises:** ValueError as `invert_leaves`."""
    domains = []
    for intervals, names in _names_by_domain(domain, unknown_names).items():
        if np.any(is_needle) and set(names) <= set(_NEEDLE_TRAITS):
            needle_bands, limits = _bands_in(wavelengths, _NEEDLE_DOMAIN, names)
            bands = np.broadcast_to(needle_bands, (is_needle.size, wavelengths.size))
            if not np.all(is_needle):
                leaf_bands, limits = _bands_in(wavelengths, intervals, names)
                bands = np.where(is_needle[:, None], bands, leaf_bands)
        else:
            leaf_bands, limits = _bands_in(wavelengths, intervals, names)
            bands = leaf_bands[None]
        domains.append(_TraitDomain(names, bands, limits))
    return domains


def _names_by_domain(
    domain: str | Mapping[str, Any] | None, unknown_names: Sequence[str]
) -> dict[Intervals, tuple[str, ...]]:
    """Return the unknowns of every domain, by its intervals, without those that have none.

    **Raises:** ValueError for a domain of no unknown, or one that is not a pair or several pairs.
    """
    if domain is None:
        return {}
    if isinstance(domain, str):
        if domain != "recommended":
            raise ValueError(f"domain = {domain!r} is none of None, 'recommended' and a mapping")
        domain_of = {n: _RECOMMENDED_DOMAINS[n] for n in unknown_names if n in _RECOMMENDED_DOMAINS}
    else:
        domain_of = {name: _intervals(name, value) for name, value in domain.items()}
    groups: dict[Intervals, tuple[str, ...]] = {}
    for name, intervals in domain_of.items():
        if name not in unknown_names:
            raise ValueError(f"domain: {name!r} is none of the unknowns {', '.join(unknown_names)}")
        groups[intervals] = (*groups.get(intervals, ()), name)
    return groups


def _intervals(name: str, value: Any) -> Intervals:
    """Return a pair (low, high), or several, as a tuple of pairs. **Raises:** ValueError for other values."""
    check_numbers(f"domain of {name}", value)
    try:
        pairs = np.atleast_1d(np.asarray(value, float))
        pairs = pairs.reshape(1, 2) if pairs.shape == (2,) else pairs
    except (TypeError, ValueError):
        pairs = np.empty((0, 2))
    if pairs.shape != (len(pairs), 2) or len(pairs) == 0 or not np.all(pairs[:, 0] <= pairs[:, 1]):
        raise ValueError(
            f"domain: {name} = {value!r} is neither a pair (low, high), nm, low <= high, nor several of them"
        )
    return tuple((low, high) for low, high in pairs.tolist())


def _bands_in(
    wavelengths: Float[np.ndarray, " wavelengths"], intervals: Intervals, names: Sequence[str]
) -> tuple[Bool[np.ndarray, " wavelengths"], Float[np.ndarray, "intervals 2"]]:
    """Return True for wavelengths in the intervals, and the first and last wavelength in each interval.

    **Raises:** ValueError for an interval that is not half spanned, with the names of its traits.
    """
    in_domain, limits = np.zeros(wavelengths.size, bool), []
    for low, high in intervals:
        in_interval = (wavelengths >= low) & (wavelengths <= high)
        inside = wavelengths[in_interval]
        if inside.size == 0 or np.ptp(inside) < _LEAST_SPAN * (high - low):
            raise ValueError(
                f"wavelengths {np.min(wavelengths):g} to {np.max(wavelengths):g} nm do not span half of "
                f"{low:g} to {high:g} nm, the domain of {', '.join(names)}: give these bands, another domain "
                "or other unknowns"
            )
        in_domain |= in_interval
        limits.append((inside.min(), inside.max()))
    return in_domain, np.array(limits)
