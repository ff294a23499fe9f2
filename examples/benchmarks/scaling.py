"""Scaling of cost: time and memory of one batch against photons, and against voxels along a side.

Run it as `python examples/benchmarks/scaling.py [--out figures] [--most 10000000] [--finest 256]`.

A crown over ground, as in `simulation_cost.py`, up to four orders. Photons are traced in chunks of one size,
so that time should grow with their number and memory not at all; the number of voxels along a ray grows with
the voxels along a side, and each voxel takes a few numbers of memory. Times are warm; memory is that of the
compiled batch besides its arguments. Slopes are those of logarithms, over the upper half of each range.
"""

import time

import equinox as eqx
import jax
import numpy as np
from _common import machine, new_figure, options, print_table, save_figure, seconds, write_json
from simulation_cost import LIDAR, SIZE, WINDOW

import jaxlidar as jl

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


def cost(scene: jl.Scene, photons: int, rays: int) -> tuple[float, int, float]:
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
    return (
        batch_seconds,
        int(compiled.compiled.memory_analysis().temp_size_in_bytes),
        float(compiled(scene, key).sum()),
    )


def slope(size: list[int], value: list[float]) -> float:
    """Return the slope of the logarithms over the upper half."""
    upper = len(size) // 2
    return float(np.polyfit(np.log(size[upper:]), np.log(value[upper:]), 1)[0])


def main() -> None:
    arguments = options("How cost grows.", most=10_000_000, finest=256)
    start_time = time.perf_counter()
    base = crown(64)
    photons = [int(n) for n in 10.0 ** np.arange(4, 10) if n <= arguments.most]
    sides = [n for n in (16, 32, 64, 128, 256, 512) if n <= arguments.finest]
    by_photons = [cost(base, n, 256) for n in photons]
    by_voxels = [cost(crown(n), 16384, 2048) for n in sides]
    record = {
        "machine": machine(),
        "photons": [
            dict(zip(("n", "seconds", "bytes", "sum"), (n, *c))) for n, c in zip(photons, by_photons)
        ],
        "voxels": [dict(zip(("side", "seconds", "bytes", "sum"), (n, *c))) for n, c in zip(sides, by_voxels)],
        "slope of seconds over photons": slope(photons, [c[0] for c in by_photons]),
        "slope of seconds over voxels along a side": slope(sides, [c[0] for c in by_voxels]),
        "slope of bytes over photons": slope(photons, [c[1] for c in by_photons]),
    }
    write_json(arguments.out / "scaling.json", record)

    figure, (photon_axes, voxel_axes) = new_figure(2, (8, 3.6))
    for ax, size, costs in ((photon_axes, photons, by_photons), (voxel_axes, sides, by_voxels)):
        ax.loglog(size, [c[0] for c in costs], "o-", color="#0072B2", label="seconds")
        ax.loglog(size, [c[1] / 1e9 for c in costs], "s--", color="#D55E00", label="memory, GB")
        ax.loglog(size, costs[-1][0] * np.array(size) / size[-1], ":", color="0.5", label="in proportion")
        ax.legend()
    photon_axes.set(xlabel="photons of a batch", title="64³ voxels")
    voxel_axes.set(xlabel="voxels along a side", title="16,384 photons, 2,048 rays")
    voxel_axes.set_xticks(sides, [str(n) for n in sides])
    voxel_axes.minorticks_off()
    save_figure(figure, arguments.out / "scaling.png")

    rows = [(f"{n:,} photons", *c) for n, c in zip(photons, by_photons)]
    rows += [(f"{n}^3 voxels", *c) for n, c in zip(sides, by_voxels)]
    print_table(("", "s", "bytes", "apparent reflectance"), rows)
    for name in record:
        if name.startswith("slope"):
            print(f"{name}: {record[name]:.2f}")
    print(f"done in {time.perf_counter() - start_time:.0f} s")


if __name__ == "__main__":
    main()
