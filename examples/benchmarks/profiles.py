"""Vertical profiles: fits with a smoothness prior beside the closed-form gap inversion of GEDI's level 2B.

Stands of 20 layers of 1.5 m along the ground, one or two storeys, plant area 0.5 to 5, on slopes about 0, 15
and 30 degrees, seen as GEDI sees them (25 m across, a pulse of 15.6 ns, samples of 1 ns), with normal noise
of a 10th, 30th and 100th of the peak. Reflectances vary by 10 %, slopes by 2 degrees and heights of the
ground by 0.5 m about the priors of the fits; the fits estimate them together with the profile. The model of
the fits has single scattering, columns twice as wide and fewer rays than the stands.

The closed form is given the true height of the ground and the ends of the noise-free signal; negative
densities are set to zero. It takes the ratio of reflectances from the medians of the priors ("median ratio"),
as level 2B takes 1.5, or the true ratio ("true ratio"). Further stands for each slope are simulated with four
scatterings, at a ratio of 30; neither method models those.

Timed are the fits, and a batch of profiles on level ground, where one column and few rays suffice.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
from _common import new_figure, number, page_of, show_progress, table

import inversion
import jaxlidar as jl
from inversion import LogNormal, Smooth, Unknown

TITLE = "Vertical profiles against the closed form"
QUICK = {"stands": 1, "batch": 2, "scattered": 1, "photons": 2048}
LIDAR = jl.Lidar(
    wavelength=1064.0, altitude=4e5, divergence=0.0625, pulse=jl.GaussianPulse(15.6), aperture=0.8
)
LAYERS, THICKNESS, WINDOW = 20, 1.5, (-320.0, 120.0)
EDGES = THICKNESS * np.arange(LAYERS + 1)
SLOPES, RATIOS, SCALE = (0.0, 15.0, 30.0), (10.0, 30.0, 100.0), 4.0
LEAF, SOIL = 0.45, 0.3
SPREAD = {"reflectance": 0.1, "slope": 2.0, "height": 0.5}
RAYS, ORDERS = 512, 4


def stand(density, slope=0.0, height=0.0, soil=SOIL, leaf=LEAF, columns=48) -> jl.Scene:
    """Return layers above a slope, 48 m across; level ground needs one column."""
    level = columns == 1
    # Layers below zero for the lowest and the steepest ground within the bounds.
    below = 4 if level else 20
    size = (48.0 / columns, 60.0, THICKNESS)
    voxels = jl.VoxelMap.from_lad(
        np.full((columns, 1, LAYERS + 2 * below), 0.1),
        voxel_size=size,
        origin=(-24.0, -30.0, -below * THICKNESS),
    )
    optics = jl.LeafOptics(leaf, 0.4)
    canopy = jl.Canopy(voxels, leaf=optics, hotspot=True, sides="periodic" if level else "open")
    ground = jl.Ground(height=height, reflectance=soil, slope=slope, aspect=90.0)
    return inversion.put_profile(jl.Scene(canopy=canopy, ground=ground), jnp.asarray(density, float))


def draw_stand(random: np.random.Generator, slope: float) -> dict:
    """Draw a stand: a profile of one or two storeys, and the ground and reflectances."""
    middle, top = EDGES[:-1] + 0.5 * THICKNESS, random.uniform(12.0, 28.0)

    def storey(at: float, wide: float) -> np.ndarray:
        return np.exp(-0.5 * ((middle - at * top) / (wide * top)) ** 2)

    shape = storey(random.uniform(0.6, 0.75), random.uniform(0.1, 0.2))
    if random.random() < 0.5:
        shape = shape + random.uniform(0.3, 1.0) * storey(random.uniform(0.1, 0.25), 0.08)
    shape = np.where(middle < top, shape, 0.0)
    return {
        "density": random.uniform(0.5, 5.0) * shape / (shape.sum() * THICKNESS),
        "slope": abs(random.normal(slope, SPREAD["slope"])),
        "height": random.normal(0.0, SPREAD["height"]),
        "soil": SOIL * np.exp(SPREAD["reflectance"] * random.normal()),
        # Reflectance and transmittance (0.4) of leaves must not exceed one.
        "leaf": min(LEAF * np.exp(SPREAD["reflectance"] * random.normal()), 0.6),
    }


def unknowns(slope: float | None) -> list[Unknown]:
    """Return the unknowns: ground, reflectances and profile, and the slope unless None."""
    slope_unknown = Unknown(
        "ground.slope",
        bounds=(0.0, 45.0),
        name="slope",
        prior=(slope or 0.0, SPREAD["slope"]),
        # At zero the derivative with respect to slope vanishes.
        start=max(slope or 0.0, 3.0),
    )
    reflectance_bounds = {"bounds": (0.05, 0.9)}
    return [
        Unknown("ground.height", bounds=(-5.0, 5.0), name="height", prior=(0.0, SPREAD["height"])),
        *([] if slope is None else [slope_unknown]),
        Unknown(
            "ground.reflectance",
            name="soil",
            prior=LogNormal(SOIL, SPREAD["reflectance"]),
            **reflectance_bounds,
        ),
        Unknown(
            "canopy.leaf.reflectance",
            name="leaf",
            prior=LogNormal(LEAF, SPREAD["reflectance"]),
            **reflectance_bounds,
        ),
        Unknown(
            apply=inversion.put_profile,
            name="plants",
            bounds=(0.0, 2.0),
            start=np.full(LAYERS, 0.1),
            prior=Smooth(SCALE, spacing=THICKNESS),
        ),
    ]


def recorded(
    stands: list[dict], orders: int, columns: int, window=WINDOW, photons: int = 64
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return waveforms without noise, their times and heights."""
    steepest = stand(np.ones(LAYERS), 38.0 if columns > 1 else 0.0, columns=columns)
    n_rays = 4096 if columns > 1 else 8
    plan = jl.plan(LIDAR, steepest, max_orders=orders, window=window, n_rays=n_rays, n_photons=photons)
    waves = []
    for i, stand_values in enumerate(stands):
        scene = stand(
            stand_values["density"],
            stand_values["slope"],
            stand_values["height"],
            stand_values["soil"],
            stand_values["leaf"],
            columns,
        )
        waves.append(jl.simulate(LIDAR, scene, key=jax.random.key(1000 + i), plan=plan))
    first = waves[0]
    clean = np.stack([np.asarray(w.reflectance[0], float) for w in waves])
    return clean, np.asarray(first.time), np.asarray(first.height, float)


def closed_form(clean, observed, height, stand_values, sigma, ratio) -> np.ndarray:
    """Return the gap inversion of a record, given the ground and the ends of the signal."""
    lit = height[clean > 0.01 * clean.max()]
    true_values = {"ground": stand_values["height"], "ends": (lit.max(), lit.min()), "noise": sigma}
    density = inversion.plant_area_profile(
        height, observed, edges=EDGES, pulse=LIDAR.pulse, reflectance_ratio=ratio, **true_values
    )
    return np.maximum(np.asarray(density, float), 0.0)


def root_mean_square(error: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(np.asarray(error) ** 2, axis=-1))


def fit(observed, sigma, times, start: jl.Scene, slope: float | None, plan: jl.Plan, lanes: int):
    """Fit records (records, samples) with the noise of each, by the unknowns of a slope."""
    problem = inversion.Problem(
        observed[:, None],
        LIDAR,
        start,
        unknowns(slope),
        noise=sigma[:, None, None],
        time=times,
        plan=plan,
    )
    return inversion.retrieve_many(problem, key=jax.random.key(7), lanes=lanes, progress=show_progress)


def compare_methods(
    slope: float, count: int, orders: int, ratios: tuple[float, ...], photons: int
) -> list[dict]:
    """Fit stands about one slope and invert them in closed form; return one row for each."""
    random = np.random.default_rng([int(slope), orders])
    stands = [draw_stand(random, slope) for _ in range(count)]
    clean, times, height = recorded(stands, orders, 96, photons=photons)
    rows = [(i, ratio) for ratio in ratios for i in range(count)]
    sigma = np.array([clean[i].max() / ratio for i, ratio in rows])
    observed = np.stack([clean[i] for i, _ in rows]) + sigma[:, None] * random.normal(
        size=(len(rows), times.size)
    )
    start = stand(np.full(LAYERS, 0.1), max(slope, 3.0))
    largest = stand(np.full(LAYERS, 0.1), 45.0)
    plan = jl.plan(LIDAR, largest, max_orders=1, window=WINDOW, n_rays=RAYS // 8)

    def fit_some(every: int):
        return fit(observed[::every], sigma[::every], times, start, slope, plan, lanes=4)

    fits, seconds = fit_some(1), 0.0
    if slope == SLOPES[1] and orders == 1:
        # Some are repeated, to time them when everything is compiled.
        fit_some(count)
        start_time = time.perf_counter()
        repeated = fit_some(count)
        seconds = (time.perf_counter() - start_time) / len(repeated.converged)
    low, high = fits.band("plants")
    kernel = fits.averaging_kernel("plants", THICKNESS)
    results = []
    for n, (i, ratio) in enumerate(rows):
        stand_values, truth, fitted = stands[i], stands[i]["density"], fits.values["plants"][n]
        median, true = (
            closed_form(clean[i], observed[n], height, stand_values, sigma[n], bright)
            for bright in (LEAF / SOIL, stand_values["leaf"] / stand_values["soil"])
        )
        results.append(
            {
                "slope": slope,
                "ratio": ratio,
                "orders": orders,
                "plant area": float(truth.sum() * THICKNESS),
                "fit": float(root_mean_square(fitted - truth)),
                "median ratio": float(root_mean_square(median - truth)),
                "true ratio": float(root_mean_square(true - truth)),
                "fitted plant area": float(fitted.sum() * THICKNESS),
                "closed plant area": float(median.sum() * THICKNESS),
                "covered": float(np.mean((truth >= low[n] - 1e-3) & (truth <= high[n] + 1e-3))),
                "degrees of freedom": float(kernel.degrees_of_freedom[n]),
                "resolution": float(np.median(kernel.resolution[n][truth > 1e-3])),
                "strength": float(fits.strength["plants"][n]),
                "converged": bool(fits.converged[n]),
                "steps": int(fits.steps[n]),
                "seconds": seconds,
                "profiles": {"truth": truth, "fit": fitted, "closed": median, "band": (low[n], high[n])},
            }
        )
    return results


def time_batch(count: int) -> dict:
    """Return the seconds of many profiles on level ground."""
    random = np.random.default_rng(99)
    stands = [draw_stand(random, 0.0) | {"slope": 0.0} for _ in range(count)]
    window = (-240.0, 50.0)
    clean, times, _ = recorded(stands, 1, 1, window)
    sigma = clean.max(axis=1) / 30.0
    observed = clean + sigma[:, None] * random.normal(size=clean.shape)
    start = stand(np.full(LAYERS, 0.1), columns=1)
    plan = jl.plan(LIDAR, start, max_orders=1, window=window, n_rays=1)
    fit(observed[:32], sigma[:32], times, start, None, plan, lanes=32)
    start_time = time.perf_counter()
    fits = fit(observed, sigma, times, start, None, plan, lanes=32)
    seconds = time.perf_counter() - start_time
    truth = np.stack([s["density"] for s in stands])
    return {
        "profiles": count,
        "seconds": seconds,
        "per_profile": seconds / count,
        "converged": float(fits.converged.mean()),
        "steps": float(fits.steps.mean()),
        "rms": float(np.mean(root_mean_square(fits.values["plants"] - truth))),
    }


def summary(rows: list[dict]) -> dict:
    """Return medians and fractions over stands, such as how often and by how much the fit is better."""

    def of(name: str) -> np.ndarray:
        return np.array([r[name] for r in rows])

    fit, area = of("fit"), of("plant area")
    return {
        "profiles": len(rows),
        "fit": float(np.median(fit)),
        "closed": float(np.median(of("median ratio"))),
        "closed_true_ratio": float(np.median(of("true ratio"))),
        "better": float(np.mean(fit < of("median ratio"))),
        "better_than_true_ratio": float(np.mean(fit < of("true ratio"))),
        "factor": float(np.median(of("median ratio") / fit)),
        "factor_true_ratio": float(np.median(of("true ratio") / fit)),
        "area_error": float(np.sqrt(np.mean((of("fitted plant area") - area) ** 2))),
        "area_error_closed": float(np.sqrt(np.mean((of("closed plant area") - area) ** 2))),
        "covered": float(np.mean(of("covered"))),
        "degrees_of_freedom": float(np.median(of("degrees of freedom"))),
        "resolution": float(np.median(of("resolution"))),
        "converged": float(np.mean(of("converged"))),
        "steps": float(np.mean(of("steps"))),
        "seconds": float(np.max(of("seconds"))),
    }


def measure(stands: int = 12, batch: int = 1000, scattered: int = 6, photons: int = 2**21) -> dict:
    """Return errors of both methods, of stands with single scattering and scattered ones, and batch times.

    Stands are those of each slope and are simulated with `photons`.
    """
    batch_record = time_batch(batch)
    rows = [r for slope in SLOPES for r in compare_methods(slope, stands, 1, RATIOS, photons)]
    several_orders = [
        r for slope in SLOPES for r in compare_methods(slope, scattered, ORDERS, (30.0,), photons)
    ]
    drawn = {r["slope"]: r["profiles"] for r in reversed(rows) if r["ratio"] == 30.0}
    return {
        "layers": LAYERS,
        "thickness": THICKNESS,
        "scale": SCALE,
        "stands": stands,
        "all": summary(rows),
        "cells": [
            {"slope": s, "ratio": q, **summary([r for r in rows if (r["slope"], r["ratio"]) == (s, q)])}
            for s in SLOPES
            for q in RATIOS
        ],
        "scattered": summary(several_orders),
        "orders": ORDERS,
        "batch": batch_record,
        "rows": [{k: v for k, v in r.items() if k != "profiles"} for r in rows + several_orders],
        "drawn": drawn,
    }


def draw(record: dict):
    """Draw the errors of both methods, and one stand for each slope."""
    figure, axes = new_figure(4, (12, 4))
    rows = [r for r in record["rows"] if r["orders"] == 1]
    for slope, colour in zip(SLOPES, ("#0072B2", "#009E73", "#D55E00")):
        x, y = ([r[n] for r in rows if r["slope"] == slope] for n in ("median ratio", "fit"))
        axes[0].loglog(x, y, "o", color=colour, ms=4, alpha=0.7, label=f"{slope:g} degrees")
    ends = (3e-3, 0.3)
    axes[0].plot(ends, ends, color="0.5", lw=1)
    axes[0].set(xlim=ends, ylim=ends, xlabel="closed form, error in m2/m3", ylabel="fit, error in m2/m3")
    axes[0].legend(loc="lower right", frameon=False, handletextpad=0.2)
    middle = EDGES[:-1] + 0.5 * THICKNESS
    for ax, slope in zip(axes[1:], SLOPES):
        profiles = record["drawn"][slope]
        ax.fill_betweenx(middle, *profiles["band"], color="#D55E00", alpha=0.2, lw=0, label="95 %")
        ax.stairs(
            profiles["truth"], EDGES, orientation="horizontal", color="0.3", baseline=None, label="truth"
        )
        ax.plot(profiles["fit"], middle, color="#D55E00", label="fit")
        ax.plot(profiles["closed"], middle, "--", color="#0072B2", label="closed form")
        ax.set(title=f"{slope:g} degrees, noise 1/30", xlabel="plant area in m2/m3", ylim=(0.0, 30.0))
    axes[1].set_ylabel("height above the ground in m")
    axes[1].legend(frameon=False)
    return figure


def section(record: dict) -> str:
    total, batch, scattered = record["all"], record["batch"], record["scattered"]

    def percent(x: float) -> str:
        return f"{100 * x:.0f} %"

    columns = {
        "slope": lambda c: f"{c['slope']:g}°",
        "peak over noise": lambda c: f"{c['ratio']:g}",
        "fit": "fit",
        "closed form": "closed",
        "closed form, true ratio": "closed_true_ratio",
        "fit is better": lambda c: percent(c["better"]),
        "better than with the true ratio": lambda c: percent(c["better_than_true_ratio"]),
        "within 95 % band": lambda c: percent(c["covered"]),
        "resolution, m": "resolution",
    }
    return page_of(
        f"Profiles of {record['layers']} layers of {record['thickness']:g} m from simulated GEDI-like "
        "waveforms, by fits with a smoothness prior and by the closed-form gap inversion of level 2B, "
        "which is given the true height of the ground and the ends of the signal. Errors are root mean "
        f"squares over layers in m2/m3, medians over {record['stands']} stands.",
        table(record["cells"], columns),
        f"Of all {total['profiles']} profiles, the fit is better in {percent(total['better'])}, in the median"
        f" by a factor of {number(total['factor'])}; in {percent(total['better_than_true_ratio'])} by "
        f"{number(total['factor_true_ratio'])} if the closed form is given the true ratio of reflectances. "
        f"Total plant area is off by {number(total['area_error'])} (closed form "
        f"{number(total['area_error_closed'])}); {percent(total['converged'])} of the fits converged, after "
        f"{number(total['steps'])} simulations, on slopes in {number(total['seconds'])} s each.",
        f"With {record['orders']} scatterings in the simulated records, which neither method models, the "
        f"fit is better in {percent(scattered['better'])} of {scattered['profiles']} profiles (errors "
        f"{number(scattered['fit'])} and {number(scattered['closed'])} m2/m3), but its band holds the truth "
        f"in only {percent(scattered['covered'])} of the layers; {percent(scattered['converged'])} "
        "converged.",
        f"On level ground, {batch['profiles']} profiles in one batch take {number(batch['seconds'])} s, "
        f"{number(batch['per_profile'])} s each.",
    )
