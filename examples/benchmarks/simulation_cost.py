"""Cost of `simulate` at relative tolerances of 0.1, 0.03 and 0.01 on three scenes.

Run it as `python examples/benchmarks/simulation_cost.py [--out figures] [--rounds 3]`. The first call of each
compiles and is listed separately; the others are warm, the fastest counts. For the crown, the time of one
batch is split into the first order, the higher orders and the application of optics.
"""

import time

import equinox as eqx
import jax
import numpy as np
from _common import best, machine, new_figure, options, print_table, race, save_figure, seconds, write_json

import jaxlidar as jl
from jaxlidar.trace.device_scene import build_device_scene
from jaxlidar.trace.response import trace_device_scene

TOLERANCES = (0.1, 0.03, 0.01)
N, SIZE, ORDERS = 64, 10.0, 15
# 5 m of radius from 1000 m, and 200 samples of 1 ns.
LIDAR = jl.Lidar(divergence=10.0, field_of_view=10.0, profile="top-hat")
WINDOW = (-90.0, 109.0)


def scenes() -> dict[str, jl.Scene]:
    centres = (np.arange(N) + 0.5) * SIZE / N
    x, y, z = np.meshgrid(centres, centres, centres, indexing="ij")
    inside = (x - 5) ** 2 + (y - 5) ** 2 + (z - 6) ** 2 < 3.5**2
    k = np.where(inside, 0.5 * np.random.default_rng(0).uniform(0, 2, inside.shape), 0.0)
    voxels = jl.VoxelMap.from_extinction(leaf=k, voxel_size=SIZE / N, origin=(-5.0, -5.0, 0.0))
    ground = jl.Ground(reflectance=0.3)
    plate = jl.Plate(height=5.0, reflectance=0.45, transmittance=0.45, coverage=0.7)
    return {
        "flat ground": jl.Scene(ground=ground),
        "plate over ground": jl.Scene(plates=(plate,), ground=ground),
        "crown over ground": jl.Scene(
            canopy=jl.Canopy(voxels, leaf=jl.Isotropic(albedo=0.9), hotspot=False), ground=ground
        ),
    }


def split(scene: jl.Scene, rounds: int) -> dict[str, float]:
    """Return the seconds of the steps of one batch with the default sizes."""
    plan = jl.plan(LIDAR, scene, max_orders=ORDERS, window=WINDOW)
    rays_only = jl.plan(LIDAR, scene, max_orders=1, window=WINDOW, n_rays=plan.n_rays)
    photons_only = plan.with_config(n_rays=1)
    key = jax.random.key(0)

    def traced(plan):
        # Without derivatives, as `simulate` does.
        def trace(scene, key):
            return trace_device_scene(
                build_device_scene(jl.make_setup(LIDAR, scene, plan), derivatives="none"), key
            )

        return eqx.filter_jit(trace)

    all_orders, first, higher = traced(plan), traced(rays_only), traced(photons_only)
    apply_optics = eqx.filter_jit(
        lambda response, scene: jl.total_reflectance(response, jl.make_setup(LIDAR, scene, plan))
    )
    response = all_orders(scene, key)
    return best(
        race(
            {
                f"first order, {plan.n_rays} rays": lambda: first(scene, key),
                f"higher orders, {plan.photons_traced} photons": lambda: higher(scene, key),
                "apply optics": lambda: apply_optics(response, scene),
                "trace": lambda: all_orders(scene, key),
            },
            rounds,
        )
    )


def main() -> None:
    arguments = options("Cost of simulations.", rounds=3)
    results, rows = [], []
    for name, scene in scenes().items():
        for rtol in TOLERANCES:

            def run(rtol=rtol, scene=scene):
                return jl.simulate(
                    LIDAR, scene, key=jax.random.key(0), rtol=rtol, max_orders=ORDERS, window=WINDOW
                )

            start = time.perf_counter()
            wave = run()
            cold = time.perf_counter() - start
            warm = min(seconds(lambda: run().reflectance) for _ in range(arguments.rounds))
            info = wave.info
            results.append(
                {**info, "scene": name, "rtol": rtol, "seconds": warm, "seconds_with_compilation": cold}
            )
            rows.append((name, rtol, warm, cold, info["photons"], info["batches"], info["error"]))
    batch_seconds = split(scenes()["crown over ground"], 3 * arguments.rounds)
    record = {
        "machine": machine(),
        "orders": ORDERS,
        "simulations": results,
        "crown_batch_seconds": batch_seconds,
    }
    write_json(arguments.out / "simulation_cost.json", record)

    figure, axes = new_figure()
    for name in scenes():
        scene_results = [r for r in results if r["scene"] == name]
        axes.loglog(
            [r["rtol"] for r in scene_results], [r["seconds"] for r in scene_results], "o-", label=name
        )
    axes.set(xlabel="relative tolerance", ylabel="seconds, warm", title="simulate")
    axes.legend()
    save_figure(figure, arguments.out / "simulation_cost.png")

    print_table(("scene", "rtol", "s, warm", "s, cold", "photons", "batches", "error"), rows)
    print(
        "One batch of the crown:", ", ".join(f"{name} {1e3 * t:.0f} ms" for name, t in batch_seconds.items())
    )


if __name__ == "__main__":
    main()
