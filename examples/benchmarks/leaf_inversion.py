"""Traits of measured leaves by `inversion.invert_leaves`, against scipy with prosail, same leaves and bands.

Run it as `python examples/benchmarks/leaf_inversion.py FILE [--also FILE ...] [--out figures] [--rounds 3]`.

FILE is an .npz of leaves as of the ANGERS database: `wavelength_nm`, `R` and `T` (leaves, wavelengths), of
1 nm steps, and the chemistry `leaf_chltot_per_area`, `leaf_cartot_per_area` (ug/cm2), `leaf_water_thickness`
(cm) and `leaf_mass_per_area` (g/cm2). Both fit N, Cab, Car, Cant, Cbrown, Cw and Cm of PROSPECT-D to all
bands, from the same start within the same bounds: here Levenberg and Marquardt's method in single precision
with PROSPECT's own derivatives, there `scipy.optimize.least_squares` (trust region, finite differences, its
default tolerances) over `prosail.run_prospect`, leaf by leaf. Errors are those against chemistry. Scipy's
linear algebra has one thread: with two, on a busy machine, it took five times as long.

For FILE, those of `--also`, and leaves that PROSPECT made, with noise and a smooth error of the model: errors
from all bands and from the recommended domains, and the share of leaves within two standard errors.
"""

import argparse
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import numpy as np
import prosail
from _common import best, machine, plt, print_table, race, save_figure, write_json
from scipy.optimize import least_squares

import jaxlidar as jl
from inversion import invert_leaves

CHEMISTRY = {
    "Cab": ("leaf_chltot_per_area", "µg/cm²"),
    "Car": ("leaf_cartot_per_area", "µg/cm²"),
    "Cw": ("leaf_water_thickness", "cm"),
    "Cm": ("leaf_mass_per_area", "g/cm²"),
}
# Start and bounds of both: those of invert_leaves.
THEIRS = {
    "N": ("n", 1.5, 1.0, 5.0),
    "Cab": ("cab", 40.0, 0.0, 150.0),
    "Car": ("car", 8.0, 0.0, 50.0),
    "Cant": ("ant", 0.0, 0.0, 50.0),
    "Cbrown": ("cbrown", 0.0, 0.0, 5.0),
    "Cw": ("cw", 0.01, 0.0, 0.1),
    "Cm": ("cm", 0.009, 0.0, 0.1),
}


def by_scipy(first: int, reflectance: np.ndarray, transmittance: np.ndarray) -> tuple[np.ndarray, int]:
    """Traits (leaves, traits), and evaluations of PROSPECT, for bands from number `first` of prosail's on."""
    keys, start, low, high = (list(column) for column in zip(*THEIRS.values()))
    bands, found, calls = slice(first, first + reflectance.shape[1]), [], 0

    def residual(x, measured, used):
        nonlocal calls
        calls += 1
        _, r, t = prosail.run_prospect(**dict(zip(keys, x)))
        return (np.concatenate([r[bands], t[bands]]) - measured)[used]

    for measured in np.concatenate([reflectance, transmittance], axis=1):
        args = (measured, np.isfinite(measured))
        found.append(least_squares(residual, start, args=args, bounds=(low, high), x_scale="jac").x)
    return np.array(found), calls


def made(count: int = 200) -> dict[str, np.ndarray]:
    """Leaves by PROSPECT with noise of 0.002, absorption off by 6 % and scattering by 0.003, smoothly."""
    random, bands = np.random.default_rng(0), np.arange(400.0, 2501.0, 5.0)
    ranges = {"N": (1.3, 2.5), "Cab": (15, 70), "Car": (4, 16), "Cant": (1, 5), "Cbrown": (0.05, 0.4)}
    ranges |= {"Cw": (0.006, 0.03), "Cm": (0.003, 0.015)}
    traits = {name: random.uniform(low, high, count) for name, (low, high) in ranges.items()}

    def spectra(share: float) -> np.ndarray:
        content = {name: v * (1 if name == "N" else 1 + share) for name, v in traits.items()}
        leaves = jax.vmap(lambda t: jl.Prospect(**t))(content)
        return np.stack([np.asarray(s, float) for s in jl.prospect_spectra(leaves, bands)], axis=1)

    exact = spectra(0.0)
    slope = (spectra(0.001) - exact) / 0.001
    root = np.linalg.cholesky(np.exp(-np.abs(bands[:, None] - bands) / 120.0))
    off, level = random.normal(size=(2, *exact.shape)) @ root.T
    off = 0.06 * slope * off + 0.003 * level + 0.002 * random.normal(size=exact.shape)
    chemistry = {column: traits[name] for name, (column, _) in CHEMISTRY.items()}
    return {"wavelength_nm": bands, "R": exact[:, 0] + off[:, 0], "T": exact[:, 1] + off[:, 1], **chemistry}


def by_domain(record: dict[str, np.ndarray]) -> dict[str, dict[str, dict[str, float]]]:
    """Errors, and shares of leaves within two standard errors, of all bands and recommended domains."""
    found = {}
    for label, domain in (("all bands", None), ("recommended", "recommended")):
        fit = invert_leaves(record["wavelength_nm"], record["R"], record["T"], domain=domain)
        found[label] = {"rmse": {}, "within two standard errors": {}}
        for name, (column, _) in CHEMISTRY.items():
            known = ~np.isnan(record[column])
            off = (np.asarray(fit.traits[name]) - record[column])[known]
            within = np.abs(off) < 2 * np.asarray(fit.stderr[name])[known]
            found[label]["rmse"][name] = float(np.sqrt(np.mean(off**2)))
            found[label]["within two standard errors"][name] = float(np.mean(within))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description="Inversion of PROSPECT on measured leaves.")
    parser.add_argument("file", type=Path)
    parser.add_argument("--also", nargs="*", default=[], type=Path, help="further files of leaves")
    parser.add_argument("--out", default="figures", type=Path, help="folder of the results")
    parser.add_argument("--rounds", default=3, type=int)
    given = parser.parse_args()
    with np.load(given.file) as archive:
        record = dict(archive)
    wavelength = record["wavelength_nm"]
    R, T = record["R"].astype(float), record["T"].astype(float)
    contestants = {
        "jaxlidar": lambda: invert_leaves(wavelength, R, T),
        "scipy": lambda: by_scipy(int(wavelength[0]) - 400, R, T),
    }
    times = race(contestants, given.rounds)
    per_leaf = {name: t / len(R) for name, t in best(times).items()}
    ratio = per_leaf["scipy"] / per_leaf["jaxlidar"]
    rounds = [theirs / ours for theirs, ours in zip(times["scipy"], times["jaxlidar"])]

    fit = contestants["jaxlidar"]()
    theirs, calls = contestants["scipy"]()
    found = {
        "jaxlidar": {name: np.asarray(value) for name, value in fit.traits.items()},
        "scipy": dict(zip(THEIRS, theirs.T)),
    }
    truth = {name: record[column] for name, (column, _) in CHEMISTRY.items()}
    rmse = {
        who: {name: float(np.sqrt(np.nanmean((traits[name] - truth[name]) ** 2))) for name in truth}
        for who, traits in found.items()
    }
    apart = {
        name: float(np.max(np.abs(found["jaxlidar"][name] - found["scipy"][name]) / fit.stderr[name]))
        for name in THEIRS
    }
    domains = {"made by PROSPECT": by_domain(made()), given.file.stem: by_domain(record)}
    for path in given.also:
        with np.load(path) as archive:
            domains[path.stem] = by_domain(dict(archive))
    write_json(
        given.out / "leaf_inversion.json",
        {
            "machine": machine(),
            "file": given.file.name,
            "leaves": len(R),
            "samples_per_leaf": 2 * wavelength.size,
            "converged": int(np.sum(fit.converged)),
            "seconds_per_leaf": per_leaf,
            "times_faster": ratio,
            "times_faster_each_round": rounds,
            "evaluations_per_leaf": {
                "jaxlidar, with Jacobian, all bands": float(np.mean(fit.n_steps)),
                "scipy": calls / len(R),
            },
            "rmse": rmse,
            "domains": domains,
            "largest_difference_in_standard_errors": apart,
        },
    )

    figure, axes = plt.subplots(2, 2, figsize=(7, 7), layout="constrained")
    for ax, (name, (_, unit)) in zip(axes.flat, CHEMISTRY.items()):
        for who, marker in (("scipy", "+"), ("jaxlidar", ".")):
            ax.plot(truth[name], found[who][name], marker, linestyle="none", label=who)
        limit = 1.05 * np.nanmax([truth[name], found["jaxlidar"][name]])
        ax.plot([0, limit], [0, limit], color="black", linewidth=0.8)
        ax.set(xlim=(0, limit), ylim=(0, limit), title=f"{name} ({unit}), rmse {rmse['jaxlidar'][name]:.3g}")
        ax.set(xlabel="measured", ylabel="estimated", aspect="equal")
    # There no leaf lies underneath.
    axes[1, 0].legend(loc="lower right")
    figure.suptitle(f"{len(R)} measured leaves, PROSPECT-D: {ratio:.0f} times faster than scipy with prosail")
    save_figure(figure, given.out / "leaf_inversion.png")

    print_table(("rmse", *truth), [(who, *rmse[who].values()) for who in found])
    print(f"ms a leaf: jaxlidar {1e3 * per_leaf['jaxlidar']:.3g}, scipy {1e3 * per_leaf['scipy']:.3g}")
    print(f"{ratio:.0f} times faster (wanted: 50); round by round {', '.join(f'{r:.0f}' for r in rounds)}")
    print(f"largest difference of traits: {max(apart.values()):.2g} standard errors")


if __name__ == "__main__":
    main()
