"""Accuracy of retrievals against the Cramer-Rao bound, and coverage of their intervals.

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
from _common import new_figure, number, page_of, show_progress, table

import inversion
import jaxlidar as jl
from inversion import Unknown

TITLE = "Accuracy and coverage of retrievals"
QUICK = {"targets": 2, "photons": 128, "starts": 1, "exact": 1}
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


def at_truth(target: int, truth: dict[str, np.ndarray]) -> list[Unknown]:
    """Return the unknowns, starting from the truth of a target."""
    return [dataclasses.replace(u, start=float(truth[u.name][target])) for u in unknowns()]


def simulated(scenes: list[jl.Scene], first_seed: int, plan: jl.Plan, photons: int) -> tuple[np.ndarray, ...]:
    """Return the times of samples, and the waveforms of scenes (scenes, wavelengths, samples)."""
    waves = [
        jl.simulate(LIDAR, s, key=jax.random.key(first_seed + i), plan=plan, n_photons=photons)
        for i, s in enumerate(scenes)
    ]
    return np.asarray(waves[0].time), np.stack([np.asarray(w.reflectance, float) for w in waves])


def measure(targets: int = 200, photons: int = 8192, starts: int = 2, exact: int = 8) -> dict:
    """Return errors and coverage of fits of `targets` with noise, and of the first `exact` without."""
    random = np.random.default_rng(0)
    truth = {name: random.uniform(*r, targets) for name, (_, r) in RANGES.items()}
    scenes = [scene_of({name: float(v[i]) for name, v in truth.items()}) for i in range(targets)]
    # Other random numbers and finer steps than those of the fits.
    fine = plan_of(photons, max_step=0.05)
    times, clean = simulated(scenes, 1000, fine, 8 * photons)
    sigma = NOISE * clean.max(axis=2, keepdims=True) * np.ones_like(clean)

    plan = plan_of(photons // 8)
    start = {name: random.uniform(*b, targets) for name, (b, _) in RANGES.items()}
    key, common = jax.random.key(7), {"time": times, "noise_floor": 1e-4}
    middle = scene_of({k: 0.5 * (a + b) for k, ((a, b), _) in RANGES.items()})
    observed = clean + sigma * random.normal(size=clean.shape)
    start_time = time.perf_counter()
    problem = inversion.Problem(
        observed, LIDAR, middle, unknowns(), noise=sigma, start=start, plan=plan, **common
    )
    fits = inversion.retrieve_many(problem, key=key, starts=starts, lanes=8, progress=show_progress)
    seconds = {"noisy": time.perf_counter() - start_time}

    start_time = time.perf_counter()
    # More photons than for noisy targets: their random error is all that remains without noise.
    _, exact_records = simulated(scenes[:exact], 5000, fine, 64 * photons)
    exact_problem = inversion.Problem(
        exact_records,
        LIDAR,
        middle,
        unknowns(),
        noise=0.01 * sigma[:exact],
        start={k: fits.values[k][:exact] for k in start},
        plan=plan_of(4 * photons),
        **common,
    )
    exact_fits = inversion.retrieve_many(exact_problem, key=key, lanes=2)
    seconds["noise-free"] = time.perf_counter() - start_time
    bounds = [
        inversion.cramer_rao(
            inversion.Problem(None, LIDAR, s, at_truth(i, truth), noise=e, plan=plan), key=jax.random.key(8)
        )
        for i, (s, e) in enumerate(zip(scenes, sigma))
    ]
    rows, in_stderr, converged = {}, {}, fits.converged
    for name in RANGES:
        errors = (fits.values[name] - truth[name])[converged]
        in_stderr[name] = errors / fits.stderr[name][converged]
        bounds_of_error = np.array([float(b.stderr[name]) for b in bounds])
        exact_errors = (exact_fits.values[name] - truth[name][:exact])[exact_fits.converged]
        scale = np.ptp(RANGES[name][1]) if name == "ground height" else np.mean(truth[name])
        rows[name] = {
            "rms": float(np.sqrt(np.mean(errors**2))),
            "cramer_rao": float(np.sqrt(np.mean(bounds_of_error**2))),
            "rms_over_bound": float(np.sqrt(np.mean((errors / bounds_of_error[converged]) ** 2))),
            "covered": float(np.mean(np.abs(in_stderr[name]) < 1.96)),
            "noise_free_median": float(np.median(np.abs(exact_errors)) / scale),
            "noise_free_bias": float(np.mean(exact_errors) / scale),
        }
    return {
        "targets": targets,
        "photons": photons,
        "converged": float(converged.mean()),
        "covered": float(np.mean([r["covered"] for r in rows.values()])),
        "seconds": seconds,
        "unknowns": rows,
        "drawn": in_stderr,
    }


def draw(record: dict):
    """Draw histograms of errors over standard errors."""
    figure, axes = new_figure(4, (10, 5), 2)
    for ax, (name, z) in zip(axes.flat, record["drawn"].items()):
        ax.hist(z, np.linspace(-5, 5, 31), density=True, color="0.7")
        x = np.linspace(-5, 5, 200)
        ax.plot(x, np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi), color="#D55E00")
        ax.set_title(name)
    axes.flat[-1].axis("off")
    figure.supxlabel("(estimate - truth) / standard error")
    return figure


def section(record: dict) -> str:
    rows = [{"name": name, **r} for name, r in record["unknowns"].items()]
    columns = {
        "unknown": "name",
        "rms error": "rms",
        "over the Cramer-Rao bound": lambda r: number(r["rms_over_bound"], 3),
        "within 95 % intervals": lambda r: f"{100 * r['covered']:.1f} %",
        "noise-free": "noise_free_median",
    }
    return page_of(
        f"{record['targets']} noisy targets (three wavelengths, noise of 2 % of the peak) from random "
        f"starts, {record['photons']:,} photons a batch: {100 * record['converged']:.0f} % of the fits "
        f"converge, and {100 * record['covered']:.1f} % of the truths lie within the 95 % intervals. The "
        "last column is the median error without noise, relative.",
        table(rows, columns),
    )
