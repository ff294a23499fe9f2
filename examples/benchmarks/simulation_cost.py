"""Cost of `simulate` at relative tolerances of 0.1, 0.03 and 0.01 on three scenes.

The first call of each compiles and is listed separately; the others are warm, the fastest counts. For the
crown, the time of one batch is split into the first order, the higher orders and the application of optics.
"""

import equinox as eqx
import jax
from _common import best, crown_extinction, first_and_warm, new_figure, race, table

import jaxlidar as jl
from jaxlidar.trace.device_scene import build_device_scene
from jaxlidar.trace.response import trace_device_scene

TITLE = "Cost of `simulate`"
QUICK = {"rounds": 1}
TOLERANCES = (0.1, 0.03, 0.01)
N, SIZE, ORDERS = 64, 10.0, 15
# 5 m of radius from 1000 m, and 200 samples of 1 ns.
LIDAR = jl.Lidar(divergence=10.0, field_of_view=10.0, profile="top-hat")
WINDOW = (-90.0, 109.0)


def scenes() -> dict[str, jl.Scene]:
    voxels = jl.VoxelMap.from_extinction(
        leaf=crown_extinction(N), voxel_size=SIZE / N, origin=(-5.0, -5.0, 0.0)
    )
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


def measure(rounds: int = 3) -> dict:
    """Return the times of all scenes by tolerance, and of the steps of one batch of the crown."""
    results = []
    for name, scene in scenes().items():
        for rtol in TOLERANCES:

            def run(rtol=rtol, scene=scene):
                return jl.simulate(
                    LIDAR, scene, key=jax.random.key(0), rtol=rtol, max_orders=ORDERS, window=WINDOW
                )

            cold, warm = first_and_warm(lambda run=run: run().reflectance, rounds)
            results.append(
                {**run().info, "scene": name, "rtol": rtol, "seconds": warm, "seconds_with_compilation": cold}
            )
    batch = split(scenes()["crown over ground"], 3 * rounds)
    return {"orders": ORDERS, "simulations": results, "crown_batch_seconds": batch}


def draw(record: dict):
    """Draw the seconds by tolerance."""
    figure, axes = new_figure()
    for name in scenes():
        rows = [r for r in record["simulations"] if r["scene"] == name]
        axes.loglog([r["rtol"] for r in rows], [r["seconds"] for r in rows], "o-", label=name)
    axes.set(xlabel="relative tolerance", ylabel="seconds, warm", title="simulate")
    axes.legend()
    return figure


def section(record: dict) -> str:
    columns = {
        "scene": "scene",
        "rtol": "rtol",
        "s": "seconds",
        "s, first call": "seconds_with_compilation",
        "photons": "photons",
        "error reached": "error",
    }
    return table(record["simulations"], columns)
