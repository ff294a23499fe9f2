"""A gradient in every voxel, jaxlidar beside Mitsuba's `prbvolpath`: seconds by its error.

Run it as `python examples/benchmarks/peers_gradient.py [--out figures] [--repeats 8]` after `pip install -e
'.[bench]'`. Mitsuba runs in a process of its own, after jaxlidar; the load before each is recorded.

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
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from _common import machine, new_figure, options, print_table, save_figure, write_json
from peers import ALBEDO, crown_extinction, run_peer
from simulation_cost import LIDAR, ORDERS, SIZE, N

import jaxlidar as jl

ALTITUDE, GOAL = 20_000.0, 0.1
RADIUS = float(LIDAR.footprint_radius)
# Photons of one gradient, of all eight batches of jaxlidar, and samples of Mitsuba.
PHOTONS, SAMPLES = 8 * 8192, 2**19
WINDOW = (-90.0, 109.0)


def run_jaxlidar(extinction: np.ndarray, repeats: int) -> dict:
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

    plan = jl.plan(lidar, scene(extinction), max_orders=ORDERS, n_photons=PHOTONS, window=WINDOW)

    def total(k, key):
        return jnp.sum(jl.simulate(lidar, scene(k), plan=plan, key=key).reflectance)

    out: dict = {}
    k = jnp.asarray(extinction, float)
    for name, function in (("simulation", jax.jit(total)), ("gradient", jax.jit(jax.value_and_grad(total)))):
        results, times = [], []
        for seed in range(repeats + 1):
            wall, cpu = time.perf_counter(), time.process_time()
            results.append(jax.block_until_ready(function(k, jax.random.key(seed))))
            times.append((time.perf_counter() - wall, time.process_time() - cpu))
        out[f"{name}_times"], out[f"{name}_first"] = np.array(times[1:]), times[0][0]
    out["totals"] = np.array([value for value, _ in results[1:]])
    out["gradients"] = np.array([np.asarray(slopes) for _, slopes in results[1:]])
    return out


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


def main() -> None:
    arguments = options("A gradient in every voxel beside Mitsuba's.", repeats=8)
    if arguments.repeats < 3:
        raise SystemExit(f"--repeats = {arguments.repeats} is below 3: no standard deviation to speak of")
    extinction = crown_extinction()
    load = {"jaxlidar": os.getloadavg()[0]}
    runs = {"jaxlidar": run_jaxlidar(extinction, arguments.repeats)}
    notes: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "given.npz")
        load["Mitsuba"] = os.getloadavg()[0]
        np.savez(
            file,
            extinction=extinction,
            albedo=ALBEDO,
            orders=ORDERS,
            size=SIZE,
            altitude=ALTITUDE,
            radius=RADIUS,
            repeats=arguments.repeats,
            samples=SAMPLES,
        )
        measurements = run_peer("_peer_mitsuba_gradient.py", file)
    if isinstance(measurements, str):
        notes["Mitsuba"] = f"left out: {measurements}"
    else:
        notes["Mitsuba"] = str(measurements["version"])
        runs["Mitsuba prbvolpath"] = measurements
    results = []
    reference = projections(runs["jaxlidar"], extinction)
    for name, run in runs.items():
        result = {"code": name, **cost_of(run, extinction)}
        if name != "jaxlidar":
            own = results[0]
            result["ratio"] = result["seconds_to_10_percent"] / own["seconds_to_10_percent"]
            result["cpu_ratio"] = result["cpu_seconds_to_10_percent"] / own["cpu_seconds_to_10_percent"]
            values = projections(run, extinction)
            error = np.sqrt(sum(v.var(axis=0, ddof=1) / len(v) for v in (reference, values)))
            z = (values.mean(axis=0) - reference.mean(axis=0)) / error
            difference = values.mean(axis=0) / reference.mean(axis=0) - 1
            labels = ("total", "factor", "height")
            result["z"] = dict(zip(labels, map(float, z)))
            result["relative_difference"] = dict(zip(labels, map(float, difference)))
        results.append(result)
    record = {"machine": {**machine(), "load_before": load}, "notes": notes}
    work = {"photons": PHOTONS, "samples": SAMPLES, "repeats": arguments.repeats}
    write_json(arguments.out / "peers_gradient.json", {**record, "work": work, "results": results})
    head = ("", "s", "error %", "s to 10 %", "CPU s", "times one", "ratio", "s, first", "total", "z")
    rows = [
        (
            r["code"],
            r["seconds"],
            100 * r["error"],
            r["seconds_to_10_percent"],
            r["cpu_seconds_to_10_percent"],
            r["times_one_simulation"],
            r.get("ratio", ""),
            r["first_call_seconds"],
            r["total"],
            ", ".join(f"{v:.1f}" for v in r.get("z", {}).values()),
        )
        for r in results
    ]
    print_table(head, rows)
    for name, note in notes.items():
        print(f"{name}: {note}")
    draw_record(runs, extinction, arguments.out / "peers_gradient.png")


def draw_record(runs: dict, extinction: np.ndarray, path: Path) -> None:
    """Draw the gradient by height: its mean over the voxels of each layer, with two standard errors."""
    figure, axes = new_figure(size=(5, 3.5))
    count = np.maximum((extinction > 0).sum(axis=(0, 1)), 1)
    height = SIZE / N * (np.arange(N) + 0.5)
    for name, run in runs.items():
        layers = (run["gradients"] * (extinction > 0)).sum(axis=(1, 2)) / count
        mean, error = layers.mean(axis=0), layers.std(axis=0, ddof=1) / np.sqrt(len(layers))
        axes.errorbar(1e6 * mean, height, xerr=2e6 * error, fmt=".", ms=3, lw=0.8, label=name)
    axes.set(xlabel="mean derivative by a voxel's extinction (1e-6 m)", ylabel="height (m)")
    axes.legend()
    save_figure(figure, path)


if __name__ == "__main__":
    main()
