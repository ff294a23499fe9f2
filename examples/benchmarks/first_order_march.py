"""First order of a crown over the ground: jaxlidar against a parallel kernel written by hand in numba.

Run it as `python examples/benchmarks/first_order_march.py [--out figures] [--rays 8192] [--rounds 30]`.

Both march the same rays through the same 64 x 64 x 128 voxels from face to face, at most `max_step` at a
time, integrate every segment over each fine bin that it spans, smooth that by (1, 10, 1)/12, and add the
ground through the quadratic B-spline. The kernel is given its rays, takes one exponential per bin, skips
empty voxels and runs on every core (`prange`, one histogram a thread, `fastmath`). jaxlidar is run as
`simulate` runs it: batches of rays submitted from one thread per core. It also follows histories, arrivals
and escaped light, and can be differentiated.

The two take turns, round after round; rates are those of the fastest rounds, with the medians beside them.
"""

import math
import os
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numba
import numpy as np
from _common import best, machine, new_figure, options, print_table, race, save_figure, write_json

import jaxlidar as jl
from jaxlidar import SPEED_OF_LIGHT
from jaxlidar.extend import along
from jaxlidar.trace.first.first_order import FACET_BACKSCATTER
from jaxlidar.trace.first.footprint import fibonacci_disc, make_beam

BATCHES = 4
SHAPE, EDGE = (64, 64, 128), 0.25
GROUND = 0.0
f4 = np.float32
LIGHT = f4(SPEED_OF_LIGHT)


def crown() -> jl.Scene:
    """Return an ellipsoid of 14 x 14 x 28 m with random extinction, 0.15 1/m on average, over the ground."""
    place = [(np.arange(n) + 0.5) * EDGE for n in SHAPE]
    x, y, z = np.meshgrid(*place, indexing="ij")
    inside = ((x - 8) / 7) ** 2 + ((y - 8) / 7) ** 2 + ((z - 17) / 14) ** 2 < 1
    k = np.where(inside, np.random.default_rng(0).uniform(0, 0.3, SHAPE), 0.0)
    voxels = jl.VoxelMap.from_extinction(leaf=k, voxel_size=EDGE, origin=(-8.0, -8.0, 0.0))
    leaf = jl.LeafOptics(reflectance=0.5, transmittance=0.0)
    return jl.Scene(
        canopy=jl.Canopy(voxels, leaf=leaf, hotspot=False), ground=jl.Ground(height=GROUND, reflectance=0.3)
    )


@numba.njit(parallel=True, fastmath=True)
def march(x, w, excess, energy, k, size, origin, start, width, count, row, max_step, ground, factor, threads):
    """Return the first-order response (2, bins) per unit reflectance of leaf and ground."""
    nx, ny, nz = k.shape
    rays = x.shape[0]
    padded = count + 2 * row
    metres = f4(0.5) * LIGHT * width
    spread = np.zeros((threads, padded), f4)
    instant = np.zeros((threads, padded), f4)
    for t in numba.prange(threads):
        leaf, soil = spread[t], instant[t]
        for r in range(t * rays // threads, (t + 1) * rays // threads):
            enter, leave = f4(0), f4(1e30)
            for a in range(3):
                low = origin[a] - x[r, a]
                high = low + size[a] * k.shape[a]
                if abs(w[r, a]) < 1e-12:
                    if low > 0 or high < 0:
                        leave = f4(0)
                else:
                    inverse = f4(1) / w[r, a]
                    enter = max(enter, min(low * inverse, high * inverse))
                    leave = min(leave, max(low * inverse, high * inverse))
            stop = (ground - x[r, 2]) / w[r, 2] if w[r, 2] < 0 else f4(1e30)
            end = min(leave, stop)
            depth = f4(0)
            if enter < end:
                # For numbers above zero, truncation is the floor; rounding below the first face is clipped.
                vx = min(max(int((x[r, 0] + w[r, 0] * enter - origin[0]) / size[0]), 0), nx - 1)
                vy = min(max(int((x[r, 1] + w[r, 1] * enter - origin[1]) / size[1]), 0), ny - 1)
                vz = min(max(int((x[r, 2] + w[r, 2] * enter - origin[2]) / size[2]), 0), nz - 1)
                sx = 1 if w[r, 0] > 0 else -1
                sy = 1 if w[r, 1] > 0 else -1
                sz = 1 if w[r, 2] > 0 else -1
                gx = gy = gz = tx = ty = tz = f4(1e30)
                if abs(w[r, 0]) >= 1e-12:
                    gx = size[0] / abs(w[r, 0])
                    tx = (origin[0] + size[0] * (vx + (sx > 0)) - x[r, 0]) / w[r, 0]
                if abs(w[r, 1]) >= 1e-12:
                    gy = size[1] / abs(w[r, 1])
                    ty = (origin[1] + size[1] * (vy + (sy > 0)) - x[r, 1]) / w[r, 1]
                if abs(w[r, 2]) >= 1e-12:
                    gz = size[2] / abs(w[r, 2])
                    tz = (origin[2] + size[2] * (vz + (sz > 0)) - x[r, 2]) / w[r, 2]
                distance = enter
                clear = energy[r] * factor * f4(0.5)
                while distance < end:
                    face = min(tx, min(ty, tz))
                    segment_end = max(min(min(face, end), distance + max_step), distance)
                    extinction = k[vx, vy, vz]
                    if extinction > 0:
                        now = (f4(2) * (excess[r] + distance) / LIGHT - start) / width
                        last = now + (segment_end - distance) / metres
                        centre = math.floor(now + f4(0.5))
                        j = int(centre) + row
                        rate = -f4(2) * extinction * metres
                        while now < last:
                            edge = min(centre + f4(0.5), last)
                            remaining = clear * math.exp(rate * (edge - now))
                            leaf[min(max(j, 0), padded - 1)] += clear - remaining
                            clear = remaining
                            now = edge
                            centre += f4(1)
                            j += 1
                        depth += extinction * (segment_end - distance)
                    if segment_end >= face:
                        if tx <= ty and tx <= tz:
                            vx += sx
                            tx += gx
                            if vx < 0 or vx >= nx:
                                break
                        elif ty <= tz:
                            vy += sy
                            ty += gy
                            if vy < 0 or vy >= ny:
                                break
                        else:
                            vz += sz
                            tz += gz
                            if vz < 0 or vz >= nz:
                                break
                    distance = segment_end
            if stop < f4(1e30):
                bin_position = (f4(2) * (excess[r] + stop) / LIGHT - start) / width
                centre = math.floor(bin_position + f4(0.5))
                q = bin_position - centre
                j = min(max(int(centre) + row, 1), padded - 2)
                value = energy[r] * math.exp(-f4(2) * depth) * -w[r, 2]
                soil[j - 1] += value * f4(0.5) * (f4(0.5) - q) ** 2
                soil[j] += value * (f4(0.75) - q * q)
                soil[j + 1] += value * f4(0.5) * (f4(0.5) + q) ** 2
    out = np.zeros((2, count), f4)
    for t in range(threads):
        for b in range(count):
            j = b + row
            out[0, b] += (spread[t, j - 1] + f4(10) * spread[t, j] + spread[t, j + 1]) / f4(12)
            out[1, b] += instant[t, j]
    return out


def by_hand(lidar: jl.Lidar, scene: jl.Scene, plan: jl.Plan, threads: int):
    """Return the kernel as a function without arguments, for the rays and voxels of jaxlidar."""
    beam = make_beam(lidar)
    across, energy = fibonacci_disc(beam, plan.n_rays, jnp.asarray([0.5, 0.0]))
    point, w, excess = beam.ray(across)
    x = along(point, w, jnp.asarray(-plan.limits.start_distance))
    x, w = (np.stack([np.broadcast_to(c, energy.shape) for c in v], axis=-1) for v in (x, w))
    voxels, bins = scene.canopy.voxels, plan.bins
    arguments = (
        *(x, w, np.asarray(excess) - f4(plan.limits.start_distance), np.asarray(energy)),
        *(np.asarray(voxels.leaf), np.asarray(voxels.voxel_size), np.asarray(voxels.origin)),
        *(f4(bins.start), f4(bins.width), bins.count, bins.max_span, f4(plan.limits.max_segment)),
        *(f4(GROUND), f4(FACET_BACKSCATTER)),
    )
    return lambda: march(*arguments, threads)


def main() -> None:
    arguments = options("First-order march against numba.", rays=8192, rounds=30)
    cores = os.cpu_count() or 1
    numba.set_num_threads(cores)
    lidar, scene = jl.Lidar(divergence=10.0), crown()
    plan = jl.plan(lidar, scene, max_orders=1, footprint="fixed", n_rays=arguments.rays)

    trace = eqx.filter_jit(
        lambda lidar, scene, key: jl.trace_scene(jl.make_setup(lidar, scene, plan), key).first[0]
    )
    keys = list(jax.random.split(jax.random.key(0), BATCHES))
    pool = ThreadPoolExecutor(cores)

    def batch(key):
        return jax.block_until_ready(trace(lidar, scene, key))

    single_threaded, multi_threaded = by_hand(lidar, scene, plan, 1), by_hand(lidar, scene, plan, cores)
    contestants = {
        "jaxlidar, one thread": lambda: [batch(key) for key in keys],
        f"jaxlidar, {cores} threads": lambda: list(pool.map(batch, keys)),
        "numba, one thread": lambda: [single_threaded() for _ in keys],
        f"numba, {cores} threads": lambda: [multi_threaded() for _ in keys],
    }
    times = race(contestants, arguments.rounds)
    fastest = best(times)
    names = list(fastest)
    rays = BATCHES * arguments.rays

    ours = np.asarray(batch(keys[0])).sum(axis=1)
    theirs = multi_threaded()
    difference = {
        material: float(np.abs(a - b).max() / b.max())
        for material, a, b in zip(("leaf", "ground"), ours, theirs)
    }
    rates = {name: rays / t for name, t in fastest.items()}
    medians = {name: rays / float(np.median(t)) for name, t in times.items()}
    record = {
        "machine": {**machine(), "numba": numba.__version__},
        "grid": SHAPE,
        "rays_per_batch": arguments.rays,
        "batches": BATCHES,
        "fine_bin_ns": plan.bins.width,
        "stretches_per_ray_at_most": plan.config.max_ray_segments,
        "rays_per_second": rates,
        "rays_per_second_median": medians,
        "jaxlidar_over_numba": {
            "one thread": rates[names[0]] / rates[names[2]],
            "all cores": rates[names[1]] / rates[names[3]],
            "all cores, median": medians[names[1]] / medians[names[3]],
        },
        "largest_difference_over_peak": difference,
    }
    write_json(arguments.out / "first_order_march.json", record)

    figure, axes = new_figure(size=(7, 3))
    axes.barh(names[::-1], [1e-6 * rates[n] for n in names[::-1]], color=["C1", "C1", "C0", "C0"])
    axes.set(xlabel="million rays per second", title="Order one through 64 x 64 x 128 voxels")
    save_figure(figure, arguments.out / "first_order_march.png")

    rows = [
        (n, rates[n] * 1e-6, medians[n] * 1e-6, 1e9 / rates[n] / plan.config.max_ray_segments) for n in names
    ]
    print_table(("", "Mrays/s, best", "median", "ns a step"), rows)
    ratio = record["jaxlidar_over_numba"]
    print(f"jaxlidar over numba: {ratio['all cores']:.2f} on all cores (wanted: at least 1),", end=" ")
    print(f"{ratio['one thread']:.2f} on one; largest difference {max(difference.values()):.1e} of the peak")


if __name__ == "__main__":
    main()
