"""Cost of a scene among many: stands of random density and ground reflectance, by `simulate_scenes`.

The stands and the lidar are those of the section on many scenes in `jaxlidar/README.md`. A tenth of the
scenes is followed through eight orders, with several numbers of photons in each of eight batches. The error
is that of the sum of a waveform, from the differences between two random keys.
"""

import jax
import jax.numpy as jnp
import numpy as np
from _common import label_log_axis, new_figure, page_of, percent, seconds, table

import jaxlidar as jl

TITLE = "Cost of a scene among many"
QUICK = {"scenes": 20}
PHOTONS, MAX_ORDERS = (32, 128, 512), 8
LIDAR = jl.Lidar(altitude=4e5, divergence=0.0625, aperture=0.8, pulse=jl.GaussianPulse(15.6))


def stand(density: jax.Array, base: jax.Array, reflectance: jax.Array) -> jl.Scene:
    voxels = jl.VoxelMap.from_lad(
        density, voxel_size=(60.0, 60.0, 2.0), origin=jnp.stack([-30.0, -30.0, base])
    )
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4), sides="periodic")
    return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=reflectance))


def stands(count: int) -> jl.Scene:
    """Return a stack of random stands."""
    keys = jax.random.split(jax.random.key(0), 2)
    densities = jax.random.uniform(keys[0], (count, 1, 1, 12), maxval=0.3)
    bases, reflectances = jax.random.uniform(keys[1], (2, count), minval=0.1, maxval=0.4)
    return jax.vmap(stand)(densities, bases, reflectances)


def cost(scenes: jl.Scene, **settings) -> dict[str, object]:
    """Return the time of a scene, compiled before, and the relative error of the sum of its waveform."""
    plan = jl.plan_scenes(LIDAR, scenes, n_rays=8, footprint="fixed", **settings)

    def simulate(seed: int = 1) -> jax.Array:
        return jl.simulate_scenes(LIDAR, scenes, plan=plan, key=jax.random.key(seed)).reflectance

    totals = [np.asarray(simulate(seed)).sum(axis=-1) for seed in (1, 2)]
    elapsed, count = min(seconds(simulate) for _ in range(3)), len(totals[0])
    # The difference of two has twice the variance of one.
    error = np.sqrt(np.mean((totals[1] / totals[0] - 1.0) ** 2) / 2.0)
    return {"scenes": count, "ms per scene": 1e3 * elapsed / count, "error": float(error)}


def measure(scenes: int = 10_000) -> dict:
    """Return the cost of a scene at first order, and with several numbers of photons."""
    rows = [{"orders": 1, "photons": 0, **cost(stands(scenes), max_orders=1)}]
    fewer = stands(max(scenes // 10, 1))
    for photons in (8 * n for n in PHOTONS):
        settings = {"max_orders": MAX_ORDERS, "n_photons": photons}
        rows.append({"orders": MAX_ORDERS, "photons": photons, **cost(fewer, **settings)})
    return {"rows": rows}


def draw(record: dict):
    """Draw the error of a scene by its time."""
    figure, axes = new_figure()
    first_order, *rows = record["rows"]
    axes.loglog([r["ms per scene"] for r in rows], [100 * r["error"] for r in rows], "o-")
    axes.axvline(first_order["ms per scene"], color="0.5", ls="--", label="first order")
    axes.set(xlabel="ms per scene", ylabel="error of the sum of a waveform, %", title="eight orders")
    axes.legend()
    for axis in (axes.xaxis, axes.yaxis):
        label_log_axis(axis, 1, 3)
    return figure


def section(record: dict) -> str:
    columns = {
        "orders": "orders",
        "photons a scene": "photons",
        "scenes": "scenes",
        "ms a scene": "ms per scene",
        "error": lambda r: percent(r["error"]),
    }
    return page_of(
        "Stands of 12 layers over level ground, of random density and ground reflectance, by `plan_scenes` "
        "and `simulate_scenes`, compiled before. At first order nothing is random. The error is that of the "
        "sum of a waveform, in the root mean square over scenes.",
        table(record["rows"], columns),
    )
