"""First order of a crown over the ground: jaxlidar against a parallel kernel written by hand in numba.

Both march the same rays through the same 64 x 64 x 128 voxels from face to face, at most `max_step` at a
time, integrate every segment over each fine bin that it spans, smooth that by (1, 10, 1)/12, and add the
ground through the quadratic B-spline. The kernel is given its rays, takes one exponential per bin, skips
empty voxels and runs on every core (`prange`, one histogram a thread, `fastmath`). jaxlidar is run as
`simulate` runs it: batches of rays submitted from one thread per core. It also follows histories, arrivals
and escaped light, and can be differentiated.

The two take turns, round after round; rates are those of the fastest rounds, with the medians beside them.
"""

import os
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _common import best, new_figure, number, page_of, race, table

import jaxlidar as jl
from jaxlidar.extend import along
from jaxlidar.trace.first.first_order import FACET_BACKSCATTER
from jaxlidar.trace.first.footprint import fibonacci_disc, make_beam

TITLE = "First order against a kernel written by hand"
QUICK = {"rays": 256, "rounds": 1}
BATCHES = 4
SHAPE, EDGE = (64, 64, 128), 0.25
GROUND = 0.0


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


def by_hand(lidar: jl.Lidar, scene: jl.Scene, plan: jl.Plan, threads: int):
    """Return the kernel as a function without arguments, for the rays and voxels of jaxlidar."""
    from _kernels import f4, march_beam

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
    return lambda: march_beam(*arguments, threads)


def measure(rays: int = 8192, rounds: int = 30) -> dict:
    """Return the rates of both, on one thread and on all cores, and the largest difference of waveforms."""
    import numba

    cores = os.cpu_count() or 1
    numba.set_num_threads(cores)
    lidar, scene = jl.Lidar(divergence=10.0), crown()
    plan = jl.plan(lidar, scene, max_orders=1, footprint="fixed", n_rays=rays)

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
    times = race(contestants, rounds)
    rates = {name: BATCHES * rays / t for name, t in best(times).items()}
    medians = {name: BATCHES * rays / float(np.median(t)) for name, t in times.items()}
    names = list(rates)

    waveforms = zip(("leaf", "ground"), np.asarray(batch(keys[0])).sum(axis=1), multi_threaded())
    difference = {material: float(np.abs(a - b).max() / b.max()) for material, a, b in waveforms}
    return {
        "numba": numba.__version__,
        "grid": SHAPE,
        "rays_per_batch": rays,
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


def draw(record: dict):
    """Draw the rates."""
    figure, axes = new_figure(size=(7, 3))
    rates = record["rays_per_second"]
    names = list(rates)[::-1]
    axes.barh(names, [1e-6 * rates[n] for n in names], color=["C1", "C1", "C0", "C0"])
    axes.set(xlabel="million rays per second", title="Order one through 64 x 64 x 128 voxels")
    return figure


def section(record: dict) -> str:
    ratio = record["jaxlidar_over_numba"]
    rates = record["rays_per_second"]
    return page_of(
        table(rates, {"first order": str, "million rays a second": lambda name: 1e-6 * rates[name]}),
        f"The rate of jaxlidar is {number(ratio['all cores'])} times that of a parallel numba kernel for the "
        f"same traversal on all cores, and {number(ratio['one thread'])} times on one.",
    )
