"""Traits of measured leaves by `inversion.invert_leaves`, against scipy with prosail, same leaves and bands.

`--set files=FILE,FILE` names files (.npz) of leaves as of the ANGERS database: `wavelength_nm`, `R` and `T`
(leaves, wavelengths), of 1 nm steps, and the chemistry `leaf_chltot_per_area`, `leaf_cartot_per_area`
(ug/cm2), `leaf_water_thickness` (cm) and `leaf_mass_per_area` (g/cm2). Both fit N, Cab, Car, Cant, Cbrown, Cw
and Cm of PROSPECT-D to all bands of the first file, from the same start within the same bounds: jaxlidar by
the method of Levenberg and Marquardt in single precision with analytic derivatives, scipy by `least_squares`
(trust region, finite differences, default tolerances) over `prosail.run_prospect`, leaf by leaf, with linear
algebra on one thread (see `run.py`). Errors are differences from chemistry.

For all files, and synthetic leaves of PROSPECT with noise and a smooth model error: errors from all bands and
from the recommended domains, and the fraction of leaves within two standard errors.
"""

from pathlib import Path

import jax
import numpy as np
from _common import best, new_figure, number, page_of, percent, race, table

import jaxlidar as jl
from inversion import invert_leaves

TITLE = "Traits of measured leaves"
QUICK = {"rounds": 1}
CHEMISTRY = {
    "Cab": ("leaf_chltot_per_area", "µg/cm²"),
    "Car": ("leaf_cartot_per_area", "µg/cm²"),
    "Cw": ("leaf_water_thickness", "cm"),
    "Cm": ("leaf_mass_per_area", "g/cm²"),
}
# Start and bounds of both: those of invert_leaves.
PROSAIL_TRAITS = {
    "N": ("n", 1.5, 1.0, 5.0),
    "Cab": ("cab", 40.0, 0.0, 150.0),
    "Car": ("car", 8.0, 0.0, 50.0),
    "Cant": ("ant", 0.0, 0.0, 50.0),
    "Cbrown": ("cbrown", 0.0, 0.0, 5.0),
    "Cw": ("cw", 0.01, 0.0, 0.1),
    "Cm": ("cm", 0.009, 0.0, 0.1),
}


def by_scipy(first: int, reflectance: np.ndarray, transmittance: np.ndarray) -> tuple[np.ndarray, int]:
    """Return traits (leaves, traits) and the number of evaluations; `first` is the first band of prosail."""
    import prosail
    from scipy.optimize import least_squares

    keys, start, low, high = (list(column) for column in zip(*PROSAIL_TRAITS.values()))
    bands, traits, calls = slice(first, first + reflectance.shape[1]), [], 0

    def residual(x, measured, used):
        nonlocal calls
        calls += 1
        _, r, t = prosail.run_prospect(**dict(zip(keys, x)))
        return (np.concatenate([r[bands], t[bands]]) - measured)[used]

    for measured in np.concatenate([reflectance, transmittance], axis=1):
        args = (measured, np.isfinite(measured))
        traits.append(least_squares(residual, start, args=args, bounds=(low, high), x_scale="jac").x)
    return np.array(traits), calls


def synthetic_leaves(count: int = 200) -> dict[str, np.ndarray]:
    """Return leaves of PROSPECT with noise of 0.002 and smooth errors, 6 % of absorption and 0.003."""
    random, bands = np.random.default_rng(0), np.arange(400.0, 2501.0, 5.0)
    ranges = {"N": (1.3, 2.5), "Cab": (15, 70), "Car": (4, 16), "Cant": (1, 5), "Cbrown": (0.05, 0.4)}
    ranges |= {"Cw": (0.006, 0.03), "Cm": (0.003, 0.015)}
    traits = {name: random.uniform(low, high, count) for name, (low, high) in ranges.items()}

    def spectra(share: float) -> np.ndarray:
        content = {name: v * (1 if name == "N" else 1 + share) for name, v in traits.items()}
        leaves = jax.vmap(lambda t: jl.Prospect(**t))(content)
        return np.stack([np.asarray(s, float) for s in leaves(bands)], axis=1)

    exact = spectra(0.0)
    slope = (spectra(0.001) - exact) / 0.001
    root = np.linalg.cholesky(np.exp(-np.abs(bands[:, None] - bands) / 120.0))
    off, level = random.normal(size=(2, *exact.shape)) @ root.T
    off = 0.06 * slope * off + 0.003 * level + 0.002 * random.normal(size=exact.shape)
    chemistry = {column: traits[name] for name, (column, _) in CHEMISTRY.items()}
    return {"wavelength_nm": bands, "R": exact[:, 0] + off[:, 0], "T": exact[:, 1] + off[:, 1], **chemistry}


def by_domain(record: dict[str, np.ndarray]) -> dict[str, dict[str, dict[str, float]]]:
    """Return errors and fractions within two standard errors, by all bands and by recommended domains."""
    domains = {}
    for label, domain in (("all bands", None), ("recommended", "recommended")):
        fit = invert_leaves(record["wavelength_nm"], record["R"], record["T"], domain=domain)
        domains[label] = {"rmse": {}, "within two standard errors": {}}
        for name, (column, _) in CHEMISTRY.items():
            measured = ~np.isnan(record[column])
            errors = (np.asarray(fit.traits[name]) - record[column])[measured]
            within = np.abs(errors) < 2 * np.asarray(fit.stderr[name])[measured]
            domains[label]["rmse"][name] = float(np.sqrt(np.mean(errors**2)))
            domains[label]["within two standard errors"][name] = float(np.mean(within))
    return domains


def root_mean_square(errors: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(errors**2)))


def measure(files: tuple[str, ...] = (), rounds: int = 3) -> dict:
    """Return the times and errors of both for the leaves of the first file, and our errors for all."""
    if not files:
        raise SystemExit("leaf_inversion needs files of leaves: --set files=FILE,FILE")
    records = {}
    for path in map(Path, files):
        with np.load(path) as archive:
            records[path.stem] = dict(archive)
    leaves = next(iter(records.values()))
    wavelength, R, T = leaves["wavelength_nm"], leaves["R"].astype(float), leaves["T"].astype(float)
    contestants = {
        "jaxlidar": lambda: invert_leaves(wavelength, R, T),
        "scipy": lambda: by_scipy(int(wavelength[0]) - 400, R, T),
    }
    times = race(contestants, rounds)
    per_leaf = {name: t / len(R) for name, t in best(times).items()}

    fit = contestants["jaxlidar"]()
    scipy_traits, calls = contestants["scipy"]()
    estimates = {
        "jaxlidar": {name: np.asarray(value) for name, value in fit.traits.items()},
        "scipy": dict(zip(PROSAIL_TRAITS, scipy_traits.T)),
    }
    truth = {name: leaves[column] for name, (column, _) in CHEMISTRY.items()}
    return {
        "file": Path(files[0]).name,
        "leaves": len(R),
        "samples_per_leaf": 2 * wavelength.size,
        "converged": int(np.sum(fit.converged)),
        "seconds_per_leaf": per_leaf,
        "times_faster": per_leaf["scipy"] / per_leaf["jaxlidar"],
        "times_faster_each_round": [a / b for a, b in zip(times["scipy"], times["jaxlidar"])],
        "evaluations_per_leaf": {
            "jaxlidar, with Jacobian, all bands": float(np.mean(fit.n_steps)),
            "scipy": calls / len(R),
        },
        "rmse": {
            who: {name: root_mean_square(traits[name] - truth[name]) for name in truth}
            for who, traits in estimates.items()
        },
        "domains": {
            "made by PROSPECT": by_domain(synthetic_leaves()),
            **{name: by_domain(record) for name, record in records.items()},
        },
        "largest_difference_in_standard_errors": {
            name: float(np.max(np.abs(estimates["jaxlidar"][name] - traits) / fit.stderr[name]))
            for name, traits in estimates["scipy"].items()
        },
        "drawn": {"truth": truth, "estimates": estimates},
    }


def draw(record: dict):
    """Draw estimates over measurements."""
    truth, estimates = record["drawn"]["truth"], record["drawn"]["estimates"]
    figure, axes = new_figure(2, (7, 7), 2)
    for ax, (name, (_, unit)) in zip(axes.flat, CHEMISTRY.items()):
        for who, marker in (("scipy", "+"), ("jaxlidar", ".")):
            ax.plot(truth[name], estimates[who][name], marker, linestyle="none", label=who)
        limit = 1.05 * np.nanmax([truth[name], estimates["jaxlidar"][name]])
        ax.plot([0, limit], [0, limit], color="black", linewidth=0.8)
        rmse = record["rmse"]["jaxlidar"][name]
        ax.set(xlim=(0, limit), ylim=(0, limit), title=f"{name} ({unit}), rmse {rmse:.3g}")
        ax.set(xlabel="measured", ylabel="estimated", aspect="equal")
    # No leaf lies under the legend there.
    axes[1, 0].legend(loc="lower right")
    figure.suptitle(
        f"{record['leaves']} measured leaves, PROSPECT-D: {record['times_faster']:.0f} times faster than "
        "scipy with prosail"
    )
    return figure


def section(record: dict) -> str:
    def error(name: str):
        return lambda who: number(record["rmse"][who][name], 3)

    def error_and_coverage(name: str):
        return lambda r: f"{number(r['rmse'][name], 3)}, {percent(r['within two standard errors'][name])}"

    domains = [
        {"leaves": leaves, "domain": domain, **errors}
        for leaves, by_bands in record["domains"].items()
        for domain, errors in by_bands.items()
    ]
    return page_of(
        f"{record['leaves']} measured leaves, all bands.",
        table(
            record["rmse"],
            {
                "": str,
                "ms a leaf": lambda who: 1e3 * record["seconds_per_leaf"][who],
                **{f"rms error of {name}": error(name) for name in CHEMISTRY},
            },
        ),
        f"{number(record['times_faster'])} times faster than scipy over prosail.",
        "Root mean square errors and fractions of leaves within two standard errors, by the bands that the "
        "fit uses. Leaves made by PROSPECT have noise and a smooth error of the model.",
        table(
            domains,
            {
                "leaves": "leaves",
                "domain": "domain",
                **{name: error_and_coverage(name) for name in CHEMISTRY},
            },
        ),
    )
