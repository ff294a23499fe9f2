"""A gradient in every voxel, jaxlidar beside Mitsuba's `prbvolpath`: seconds by its error.

Mitsuba, which `pip install -e '.[bench]'` brings, runs in a process of its own, after jaxlidar; the load
before each is recorded.

The scene is the crown of `peers.py` alone, 64^3 voxels and up to 15 scatterings, from 20 km, so that the
range of returns does not matter. Over ground, light that leaves the crown sideways and comes back from far
away is late, and no record holds all of it. Differentiated is the light of all times together, as
`prbvolpath` has no time, with respect to the extinction of every voxel; jaxlidar traces the waveform, and
sums it. Both replay paths (Vicini, Speierer and Jakob 2021, ACM Trans. Graph. 40(4), 108). Empty voxels
outside of the crown are left out of errors; for their derivatives jaxlidar traces photons once more.

The error of a gradient is the root of the summed variances of voxels, over that of their summed squared
means. Seconds to 10 % = seconds * (error / 0.1)^2. A ratio is the time of the gradient, with the value, over
that of the simulation with as many paths in the same program. Agreement is tested on the total, on the
derivative by a factor of all extinctions, and on that by an extinction that grows with height, in standard
errors of the difference.
"""

import os

import jax
import jax.numpy as jnp
import numpy as np
from _common import new_figure, number, page_of, percent, table
from _peer import repeated_gradient, run_peer
from peers import ALBEDO, crown_extinction
from simulation_cost import LIDAR, ORDERS, SIZE, N

import jaxlidar as jl

TITLE = "A gradient beside another code"
QUICK = {"repeats": 3, "photons": 8 * 64, "samples": 2**10}
ALTITUDE, GOAL = 20_000.0, 0.1
RADIUS = float(LIDAR.footprint_radius)
WINDOW = (-90.0, 109.0)


def run_jaxlidar(extinction: np.ndarray, repeats: int, photons: int) -> dict:
    """Return totals, gradients and times of repetitions with other random numbers."""
    lidar = jl.Lidar(
        altitude=ALTITUDE,
        divergence=2e3 * RADIUS / ALTITUDE,
        profile="top-hat",
        pulse=jl.GaussianPulse(2.0),
        sampling_interval=2.0,
    )

    def scene(k) -> jl.Scene:
        voxels = jl.VoxelMap.from_extinction(leaf=k, voxel_size=SIZE / N, origin=(-SIZE / 2, -SIZE / 2, 0.0))
        canopy = jl.Canopy(voxels, leaf=jl.Isotropic(albedo=ALBEDO), hotspot=False)
        return jl.Scene(canopy=canopy)

    plan = jl.plan(lidar, scene(extinction), max_orders=ORDERS, n_photons=photons, window=WINDOW)

    def total(k, key):
        return jnp.sum(jl.simulate(lidar, scene(k), plan=plan, key=key).reflectance)

    k, slopes = jnp.asarray(extinction, float), jax.value_and_grad(total)

    def call(function):
        function = jax.jit(function)
        return lambda seed: jax.block_until_ready(function(k, jax.random.key(seed)))

    return repeated_gradient(call(total), call(slopes), repeats)


def cost_of(run: dict, extinction: np.ndarray) -> dict[str, float]:
    """Return the error of one gradient, and its time to the goal."""
    crown = run["gradients"][:, extinction > 0].astype(float)
    variance = crown.var(axis=0, ddof=1)
    # The square of a mean has its variance as well.
    squared_mean = float(np.sum(crown.mean(axis=0) ** 2 - variance / len(crown)))
    error = float(np.sqrt(variance.sum() / squared_mean)) if squared_mean > 0 else float("nan")
    wall, cpu = np.median(run["gradient_times"], axis=0)
    simulation_wall, simulation_cpu = np.median(run["simulation_times"], axis=0)
    to_goal = (error / GOAL) ** 2
    return {
        "error": error,
        "seconds": float(wall),
        "cpu_seconds": float(cpu),
        "seconds_to_10_percent": float(wall * to_goal),
        "cpu_seconds_to_10_percent": float(cpu * to_goal),
        "times_one_simulation": float(wall / simulation_wall),
        "cpu_times_one_simulation": float(cpu / simulation_cpu),
        "first_call_seconds": float(run["gradient_first"]),
        "total": float(run["totals"].mean()),
    }


def projections(run: dict, extinction: np.ndarray) -> np.ndarray:
    """Return totals, and derivatives along two directions in the space of voxels, (repeats, 3)."""
    height = (np.arange(N) + 0.5) / N
    directions = (extinction, extinction * height)
    slopes = [np.sum(run["gradients"].astype(float) * direction, axis=(1, 2, 3)) for direction in directions]
    return np.stack([run["totals"].astype(float), *slopes], axis=1)


def measure(repeats: int = 8, photons: int = 8 * 8192, samples: int = 2**19) -> dict:
    """Return the costs of both; `photons` are those of jaxlidar's eight batches, `samples` of Mitsuba."""
    if repeats < 3:
        raise SystemExit(f"repeats={repeats} is below 3: no standard deviation to speak of")
    extinction = crown_extinction()
    task = {"extinction": extinction, "albedo": ALBEDO, "orders": ORDERS, "size": SIZE, "altitude": ALTITUDE}
    task |= {"radius": RADIUS, "repeats": repeats, "samples": samples}
    load = {"jaxlidar": os.getloadavg()[0]}
    runs = {"jaxlidar": run_jaxlidar(extinction, repeats, photons)}
    load["Mitsuba"] = os.getloadavg()[0]
    measurements = run_peer("_peer_mitsuba_gradient.py", task)
    if isinstance(measurements, str):
        notes = {"Mitsuba": f"left out: {measurements}"}
    else:
        notes = {"Mitsuba": str(measurements["version"])}
        runs["Mitsuba prbvolpath"] = measurements
    results = []
    reference = projections(runs["jaxlidar"], extinction)
    for name, run in runs.items():
        result = {"code": name, **cost_of(run, extinction)}
        if name != "jaxlidar":
            ours = results[0]
            result["ratio"] = result["seconds_to_10_percent"] / ours["seconds_to_10_percent"]
            result["cpu_ratio"] = result["cpu_seconds_to_10_percent"] / ours["cpu_seconds_to_10_percent"]
            values = projections(run, extinction)
            error = np.sqrt(sum(v.var(axis=0, ddof=1) / len(v) for v in (reference, values)))
            z = (values.mean(axis=0) - reference.mean(axis=0)) / error
            difference = values.mean(axis=0) / reference.mean(axis=0) - 1
            labels = ("total", "factor", "height")
            result["z"] = dict(zip(labels, map(float, z)))
            result["relative_difference"] = dict(zip(labels, map(float, difference)))
        results.append(result)
    work = {"photons": photons, "samples": samples, "repeats": repeats}
    drawn = {"runs": runs, "extinction": extinction}
    return {"load_before": load, "notes": notes, "work": work, "results": results, "drawn": drawn}


def draw(record: dict):
    """Draw the gradient by height: its mean over the voxels of each layer, with two standard errors."""
    figure, axes = new_figure(size=(5, 3.5))
    is_crown = record["drawn"]["extinction"] > 0
    count = np.maximum(is_crown.sum(axis=(0, 1)), 1)
    height = SIZE / N * (np.arange(N) + 0.5)
    for name, run in record["drawn"]["runs"].items():
        layers = (run["gradients"] * is_crown).sum(axis=(1, 2)) / count
        mean, error = layers.mean(axis=0), layers.std(axis=0, ddof=1) / np.sqrt(len(layers))
        axes.errorbar(1e6 * mean, height, xerr=2e6 * error, fmt=".", ms=3, lw=0.8, label=name)
    axes.set(xlabel="mean derivative by a voxel's extinction (1e-6 m)", ylabel="height (m)")
    axes.legend()
    return figure


def section(record: dict) -> str:
    columns = {
        "code": "code",
        "s": "seconds",
        "error %": lambda r: 100 * r["error"],
        "s to 10 %": "seconds_to_10_percent",
        "CPU s to 10 %": "cpu_seconds_to_10_percent",
        "times jaxlidar, CPU": lambda r: r.get("cpu_ratio"),
        "CPU, times one simulation": "cpu_times_one_simulation",
        "s, first call": "first_call_seconds",
    }

    def largest(quantity: str) -> float:
        return max((abs(v) for r in record["results"] for v in r.get(quantity, {}).values()), default=0.0)

    return page_of(
        "The gradient of all light that a crown of 64³ voxels returns, by the extinction of each, beside "
        "Mitsuba's path replay without time (`prbvolpath`). The error is that of single voxels, of which "
        f"each has few paths; sums over voxels differ by at most {percent(largest('relative_difference'))}, "
        f"{number(largest('z'))} standard errors. Voxels around the crown are empty: for their derivatives "
        "jaxlidar traces photons once more. Other programs ran at the same time (load "
        f"{number(max(record['load_before'].values()))}): compare seconds of the CPU.",
        table(record["results"], columns),
    )
