"""Accuracy of retrievals against the Cramer-Rao bound, and coverage of their intervals.

Run it as `python examples/benchmarks/retrieval_coverage.py [--out figures] [--targets 200] [--photons
8192] [--starts 2] [--exact 8]`. Fits are stored in the folder, and not repeated by a further run.

A layered canopy over ground at three wavelengths; unknown are Cab, water and structure of the leaf,
brightness and height of the ground, top and leaf area index of the canopy. Targets have random truths, are
simulated with other random numbers, eight times the photons and finer steps than the fits use, and get noise
of 2 % of the peak; fits begin at random starts. Results are the root mean square of (estimate - truth) over
the Cramer-Rao bound, the fraction of truths within 1.96 standard errors, the fraction of fits that converged,
and the errors of noise-free targets, simulated with 64 times and fitted with 32 times the photons.
"""

import dataclasses
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _common import machine, options, plt, print_table, save_figure, write_json

import inversion
import jaxlidar as jl
from inversion import Unknown

LIDAR = jl.Lidar(
    wavelength=(532.0, 1064.0, 1550.0), divergence=5.0, pulse=jl.GaussianPulse(fwhm=4.0), aperture=0.2
)
LAYERS, BASE, ORDERS = 8, 2.0, 4
WINDOW = (-105.0, 40.0)
NOISE = 0.02
# Leaf area of each layer for a leaf area index of one.
SHAPE = np.array([0.4, 0.8, 1.2, 1.5, 1.5, 1.2, 0.9, 0.5]) / 8.0
SOIL = np.array([0.12, 0.25, 0.33])
# Name: bounds of the fit, and range of the truths.
RANGES = {
    "Cab": ((10.0, 90.0), (25.0, 65.0)),
    "Cw": ((0.002, 0.04), (0.006, 0.025)),
    "N": ((1.0, 2.8), (1.3, 2.2)),
    "ground brightness": ((0.2, 2.5), (0.6, 1.6)),
    "ground height": ((-1.0, 1.0), (-0.5, 0.5)),
    "canopy top": ((9.0, 13.0), (10.0, 12.0)),
    "leaf area index": ((0.3, 5.0), (0.8, 3.0)),
}


def put_top(scene, top):
    """Stretch the canopy between its base and a new top, with the same leaf area."""
    size = scene.canopy.voxels.voxel_size
    new = (top - BASE) / LAYERS
    where = lambda s: (s.canopy.voxels.voxel_size, s.canopy.voxels.leaf)  # noqa: E731
    return eqx.tree_at(where, scene, (size.at[2].set(new), scene.canopy.voxels.leaf * size[2] / new))


def put_area(scene, area):
    """Set the leaf area index."""
    leaf = 0.5 * area * jnp.asarray(SHAPE).reshape(1, 1, LAYERS) / scene.canopy.voxels.voxel_size[2]
    return eqx.tree_at(lambda s: s.canopy.voxels.leaf, scene, leaf)


def put_brightness(scene, value):
    """Set the reflectance of the ground to a multiple of that of the soil."""
    return eqx.tree_at(lambda s: s.ground.reflectance, scene, value * jnp.asarray(SOIL))


def scene_of(values: dict[str, float]) -> jl.Scene:
    """Return the scene with some values of the unknowns."""
    thick = (values["canopy top"] - BASE) / LAYERS
    density = values["leaf area index"] * SHAPE / thick
    voxels = jl.VoxelMap.from_lad(
        density.reshape(1, 1, LAYERS), voxel_size=(50.0, 50.0, thick), origin=(-25.0, -25.0, BASE)
    )
    leaf = jl.Prospect(N=values["N"], Cab=values["Cab"], Car=8.0, Cw=values["Cw"], Cm=0.009)
    ground = jl.Ground(height=values["ground height"], reflectance=values["ground brightness"] * SOIL)
    return jl.Scene(canopy=jl.Canopy(voxels, leaf=leaf, sides="periodic", hotspot=False), ground=ground)


def unknowns() -> list[Unknown]:
    """Return all seven unknowns, starting in the middle of their bounds."""
    bounds = {name: b for name, (b, _) in RANGES.items()}
    start = {name: 0.5 * (low + high) for name, (low, high) in bounds.items()}

    def put(name, apply):
        return Unknown(name=name, bounds=bounds[name], start=start[name], apply=apply)

    return [
        Unknown(lambda s: s.canopy.leaf.Cab, bounds=bounds["Cab"], name="Cab"),
        Unknown(lambda s: s.canopy.leaf.Cw, bounds=bounds["Cw"], name="Cw"),
        Unknown(lambda s: s.canopy.leaf.N, bounds=bounds["N"], name="N"),
        put("ground brightness", put_brightness),
        Unknown(lambda s: s.ground.height, bounds=bounds["ground height"], name="ground height"),
        put("leaf area index", put_area),
        put("canopy top", put_top),
    ]


def plan_of(photons: int, **changes) -> jl.Plan:
    """Return one plan for all scenes within the bounds."""
    low, high = ({name: float(b[i]) for name, (b, _) in RANGES.items()} for i in (0, 1))
    largest = scene_of({**high, "ground height": low["ground height"]})
    return jl.plan(
        LIDAR, largest, max_orders=ORDERS, window=WINDOW, n_photons=8 * photons, **{"n_rays": 64, **changes}
    )


def main() -> dict:
    arguments = options("Coverage of retrievals.", targets=200, photons=8192, starts=2, exact=8)
    random = np.random.default_rng(0)
    n = arguments.targets
    truth = {name: random.uniform(*r, n) for name, (_, r) in RANGES.items()}
    scenes = [scene_of({name: float(v[i]) for name, v in truth.items()}) for i in range(n)]
    # Other random numbers and finer steps than those of the fits.
    fine = plan_of(arguments.photons, max_step=0.05)
    start_time = time.perf_counter()
    waves = [
        jl.simulate(LIDAR, s, key=jax.random.key(1000 + i), plan=fine, n_photons=8 * arguments.photons)
        for i, s in enumerate(scenes)
    ]
    clean = np.stack([np.asarray(w.reflectance, float) for w in waves])
    sigma = NOISE * clean.max(axis=2, keepdims=True) * np.ones_like(clean)
    simulated = time.perf_counter() - start_time
    print(f"{n} targets simulated in {simulated:.0f} s")

    plan = plan_of(arguments.photons // 8)
    times = np.asarray(waves[0].time)
    start = {name: random.uniform(*b, n) for name, (b, _) in RANGES.items()}
    key, common = jax.random.key(7), {"time": times, "noise_floor": 1e-4}
    middle = scene_of({k: 0.5 * (a + b) for k, ((a, b), _) in RANGES.items()})
    observed = clean + sigma * random.normal(size=clean.shape)
    arguments.out.mkdir(parents=True, exist_ok=True)
    start_time = time.perf_counter()
    problem = inversion.Problem(
        observed, LIDAR, middle, unknowns(), noise=sigma, start=start, plan=plan, **common
    )
    fits = inversion.retrieve_many(
        problem,
        key=key,
        starts=arguments.starts,
        lanes=8,
        path=arguments.out / f"retrieval_coverage_{n}.zarr",
        progress=lambda p: print(f"\r{p}", end="", flush=True),
    )
    seconds = {"noisy": time.perf_counter() - start_time}
    print(f"\rnoisy: {n} fits in {seconds['noisy']:.0f} s")

    start_time = time.perf_counter()
    n_exact = min(n, arguments.exact)
    # More photons than for noisy targets: their random error is all that remains without noise.
    n_photons_exact = 64 * arguments.photons
    exact = [
        jl.simulate(LIDAR, s, key=jax.random.key(5000 + i), plan=fine, n_photons=n_photons_exact)
        for i, s in enumerate(scenes[:n_exact])
    ]
    exact_problem = inversion.Problem(
        np.stack([np.asarray(w.reflectance, float) for w in exact]),
        LIDAR,
        middle,
        unknowns(),
        noise=0.01 * sigma[:n_exact],
        start={k: fits.values[k][:n_exact] for k in start},
        plan=plan_of(n_photons_exact // 16),
        **common,
    )
    exact_fits = inversion.retrieve_many(exact_problem, key=key, lanes=2)
    seconds["noise-free"] = time.perf_counter() - start_time
    print(f"noise-free: {n_exact} fits in {seconds['noise-free']:.0f} s")
    bounds = [
        inversion.cramer_rao(
            inversion.Problem(None, LIDAR, s, at_truth(i, truth), noise=e, plan=plan), key=jax.random.key(8)
        )
        for i, (s, e) in enumerate(zip(scenes, sigma))
    ]
    rows, record = [], {}
    for name in RANGES:
        errors = fits.values[name] - truth[name]
        bounds_of_error = np.array([float(b.stderr[name]) for b in bounds])
        converged = fits.converged
        ratio = float(np.sqrt(np.mean((errors / bounds_of_error)[converged] ** 2)))
        covered = float(np.mean(np.abs(errors / fits.stderr[name])[converged] < 1.96))
        exact_errors = (exact_fits.values[name] - truth[name][: len(exact_fits.converged)])[
            exact_fits.converged
        ]
        scale = np.ptp(RANGES[name][1]) if name == "ground height" else np.mean(truth[name])
        record[name] = {
            "rms": float(np.sqrt(np.mean(errors[converged] ** 2))),
            "cramer_rao": float(np.sqrt(np.mean(bounds_of_error**2))),
            "rms_over_bound": ratio,
            "covered": covered,
            "noise_free_median": float(np.median(np.abs(exact_errors)) / scale),
            "noise_free_bias": float(np.mean(exact_errors) / scale),
        }
        r = record[name]
        rows.append(
            (name, r["rms"], r["cramer_rao"], ratio, covered, r["noise_free_median"], r["noise_free_bias"])
        )
    print_table(("unknown", "rms", "bound", "rms/bound", "covered", "noise-free, rel.", "bias, rel."), rows)
    share = float(fits.converged.mean())
    all_covered = float(np.mean([r["covered"] for r in record.values()]))
    print(f"converged {share:.3f}; covered {all_covered:.3f} (aim 0.92 to 0.98)")
    write_json(
        arguments.out / "retrieval_coverage.json",
        {
            "machine": machine(),
            "targets": n,
            "photons": arguments.photons,
            "converged": share,
            "covered": all_covered,
            "seconds": seconds,
            "unknowns": record,
        },
    )

    figure, axes = plt.subplots(2, 4, figsize=(10, 5), layout="constrained")
    for ax, name in zip(axes.flat, RANGES):
        z = (fits.values[name] - truth[name]) / fits.stderr[name]
        ax.hist(z[fits.converged], np.linspace(-5, 5, 31), density=True, color="0.7")
        x = np.linspace(-5, 5, 200)
        ax.plot(x, np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi), color="#D55E00")
        ax.set_title(name)
    axes.flat[-1].axis("off")
    figure.supxlabel("(estimate - truth) / standard error")
    save_figure(figure, arguments.out / "retrieval_coverage.png")
    return {"converged": share, "covered": all_covered, "unknowns": record}


def at_truth(number: int, truth: dict[str, np.ndarray]) -> list[Unknown]:
    """Return the unknowns, starting from the truth of a target."""
    return [dataclasses.replace(u, start=float(truth[u.name][number])) for u in unknowns()]


if __name__ == "__main__":
    main()
