"""Scaling of cost: time and memory of one batch against photons, and against voxels along a side.

A crown over ground, as in `simulation_cost.py`, up to four orders. Photons are traced in chunks of one size,
so that time should grow with their number and memory not at all; the number of voxels along a ray grows with
the voxels along a side, and each voxel takes a few numbers of memory. Times are warm; memory is that of the
compiled batch besides its arguments. Slopes are those of logarithms, over the upper half of each range.
"""

import equinox as eqx
import jax
import numpy as np
from _common import new_figure, number, page_of, seconds, table
from simulation_cost import LIDAR, SIZE, WINDOW

import jaxlidar as jl

TITLE = "Scaling of cost"
QUICK = {"most": 100_000, "finest": 32}
ORDERS = 4


def crown(n: int) -> jl.Scene:
    """Return a crown whose extinction varies over half metres, on n^3 voxels."""
    place = (np.arange(n) + 0.5) * SIZE / n
    x, y, z = np.meshgrid(place, place, place, indexing="ij", sparse=True)
    inside = (x - 5) ** 2 + (y - 5) ** 2 + (z - 6) ** 2 < 3.5**2
    coarse = np.random.default_rng(0).uniform(0.0, 1.0, (20, 20, 20))
    half_metre = np.minimum((place / 0.5).astype(int), 19)
    k = np.where(inside, coarse[np.ix_(half_metre, half_metre, half_metre)], 0.0).astype(np.float32)
    voxels = jl.VoxelMap.from_extinction(leaf=k, voxel_size=SIZE / n, origin=(-5.0, -5.0, 0.0))
    return jl.Scene(
        canopy=jl.Canopy(voxels, leaf=jl.Isotropic(albedo=0.9), hotspot=False),
        ground=jl.Ground(reflectance=0.3),
    )


def cost(scene: jl.Scene, photons: int, rays: int) -> dict[str, float]:
    """Return seconds and bytes of a batch, and its apparent reflectance."""
    plan = jl.plan(
        LIDAR, scene, max_orders=ORDERS, window=WINDOW, n_photons=8 * photons, n_rays=rays, describe=False
    )

    def batch(scene, key):
        setup = jl.make_setup(LIDAR, scene, plan)
        return jl.total_reflectance(jl.trace_scene(setup, key, reverse=False), setup)

    key = jax.random.key(0)
    compiled = eqx.filter_jit(batch).lower(scene, key).compile()
    first_seconds = seconds(compiled, scene, key)
    # Long runs need no second measurement.
    batch_seconds = (
        min(seconds(compiled, scene, key) for _ in range(5)) if first_seconds < 5 else first_seconds
    )
    memory = int(compiled.compiled.memory_analysis().temp_size_in_bytes)
    return {"seconds": batch_seconds, "bytes": memory, "sum": float(compiled(scene, key).sum())}


def slope(rows: list[dict], size: str, quantity: str) -> float:
    """Return the slope of the logarithms over the upper half of the sizes."""
    upper = rows[min(len(rows) // 2, len(rows) - 2) :]
    logarithms = (np.log([r[name] for r in upper]) for name in (size, quantity))
    return float(np.polyfit(*logarithms, 1)[0])


def measure(most: int = 10_000_000, finest: int = 256) -> dict:
    """Return the costs by photons, to at most `most`, and by voxels along a side, to `finest`."""
    base = crown(64)
    counts = [int(n) for n in 10.0 ** np.arange(4, 10) if n <= most]
    sides = [n for n in (16, 32, 64, 128, 256, 512) if n <= finest]
    photons = [{"n": n, **cost(base, n, 256)} for n in counts]
    voxels = [{"side": n, **cost(crown(n), 16384, 2048)} for n in sides]
    return {
        "photons": photons,
        "voxels": voxels,
        "slope of seconds over photons": slope(photons, "n", "seconds"),
        "slope of seconds over voxels along a side": slope(voxels, "side", "seconds"),
        "slope of bytes over photons": slope(photons, "n", "bytes"),
    }


def draw(record: dict):
    """Draw seconds and memory by photons and by voxels."""
    figure, (photon_axes, voxel_axes) = new_figure(2, (8, 3.6))
    for ax, rows, name in ((photon_axes, record["photons"], "n"), (voxel_axes, record["voxels"], "side")):
        size = np.array([r[name] for r in rows])
        ax.loglog(size, [r["seconds"] for r in rows], "o-", color="#0072B2", label="seconds")
        ax.loglog(size, [r["bytes"] / 1e9 for r in rows], "s--", color="#D55E00", label="memory, GB")
        ax.loglog(size, rows[-1]["seconds"] * size / size[-1], ":", color="0.5", label="in proportion")
        ax.legend()
    photon_axes.set(xlabel="photons of a batch", title="64³ voxels")
    voxel_axes.set(xlabel="voxels along a side", title="16,384 photons, 2,048 rays")
    voxel_axes.set_xticks(size, [str(n) for n in size])
    voxel_axes.minorticks_off()
    return figure


def section(record: dict) -> str:
    rows = [{"what": f"{r['n']:,} photons", **r} for r in record["photons"]]
    rows += [{"what": f"{r['side']}³ voxels", **r} for r in record["voxels"]]
    photons, voxels = (
        number(record[f"slope of seconds over {n}"]) for n in ("photons", "voxels along a side")
    )
    return page_of(
        table(rows, {"one batch of": "what", "s": "seconds", "bytes beside the scene": "bytes"}),
        f"Time grows with the photons to the power {photons}, with the voxels along a side to the power "
        f"{voxels}.",
    )
