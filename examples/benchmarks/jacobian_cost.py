"""Jacobians of the waveform in eight unknowns and in 20 layers against one simulation, same photons and keys.

Four unknowns are optical (Cab, Cw, N of the leaf, reflectance of the ground), four geometric (height and
slope of the ground, size of the voxels, leaf area). "structured" pushes only the geometric tangents
through the trace, together, and gets the optical columns from the traced response; "jacfwd" pushes all
eight through everything. "20 layers" is the leaf area of 20 layers of the crown, as `inversion.retrieve`
computes it: layers change extinction alone, so that score functions of photon paths give the derivatives.
"20 layers, jvp" pushes tangents through the trace. Eight batches, one thread per core, warm.
"""

import os
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _common import best, crown_extinction, new_figure, page_of, race, table

import inversion
import jaxlidar as jl
from inversion.fit.model import ForwardModel
from inversion.fit.unknowns import bind_unknowns
from jaxlidar.planning.plan import MIN_BATCHES

TITLE = "Jacobians of a waveform"
QUICK = {"photons": 1024, "rounds": 1}
N, SIZE, ORDERS, LAYERS = 32, 10.0, 10, 20
RADIUS, MIDDLE = 3.5, 5.0
OPTICAL = ("Cab", "Cw", "N", "ground reflectance")
GEOMETRIC = ("ground height", "slope", "voxel size", "leaf area")
START = (jnp.array([40.0, 0.01, 1.5, 0.3]), jnp.array([0.0, 5.0, 1.0, 1.0]))


def scene_at(optical, geometric, extinction) -> jl.Scene:
    cab, cw, layers, ground = optical
    height, slope, size, area = geometric
    leaf = jl.Prospect(N=layers, Cab=cab, Car=8.0, Cant=0.0, Cbrown=0.0, Cw=cw, Cm=0.009)
    voxels = jl.VoxelMap.from_extinction(
        leaf=area * extinction, voxel_size=size * SIZE / N, origin=(-5.0, -5.0, 1.0)
    )
    return jl.Scene(
        canopy=jl.Canopy(voxels, leaf=leaf, hotspot=False),
        ground=jl.Ground(height=height, slope=slope, reflectance=ground),
    )


def measure(photons: int = 65536, rounds: int = 5) -> dict:
    """Return the times of Jacobians, and how far columns are from those of `jax.jacfwd`."""
    centres = (np.arange(N) + 0.5) * SIZE / N
    # Layer of each level of voxels.
    layer = np.clip((centres - MIDDLE + RADIUS) / (2.0 * RADIUS) * LAYERS, 0, LAYERS - 1).astype(int)
    extinction = jnp.asarray(crown_extinction(N, MIDDLE))
    lidar = jl.Lidar(wavelength=(532.0, 1064.0, 1550.0), divergence=10.0)
    plan = jl.plan(
        lidar,
        scene_at(*START, extinction),
        max_orders=ORDERS,
        n_photons=photons,
        n_rays=8192 // MIN_BATCHES,
    )

    def response(geometric, optical, key):
        setup = jl.make_setup(lidar, scene_at(optical, geometric, extinction), plan)
        return jl.trace_scene(setup, key, reverse=False)

    def apply_optics(response, optical, geometric):
        return jl.total_reflectance(
            response, jl.make_setup(lidar, scene_at(optical, geometric, extinction), plan)
        )

    def simulate(optical, geometric, key):
        return apply_optics(response(geometric, optical, key), optical, geometric)

    def geometric_columns(optical, geometric, key):
        def total(g):
            traced = response(g, optical, key)
            return apply_optics(traced, optical, g), traced

        push = jax.vmap(lambda t: jax.jvp(total, (geometric,), (t,), has_aux=True), out_axes=(None, -1, None))
        return push(jnp.eye(geometric.size))

    def structured(optical, geometric, key):
        value, columns, traced = geometric_columns(optical, geometric, key)
        return value, jax.jacfwd(lambda o: apply_optics(traced, o, geometric))(optical), columns

    def jacfwd_all(optical, geometric, key):
        return jax.jacfwd(simulate, argnums=(0, 1))(optical, geometric, key)

    def optical_columns(optical, geometric, key):
        traced = response(geometric, optical, key)
        return jax.jacfwd(lambda o: apply_optics(traced, o, geometric))(optical)

    def layer_columns(optical, geometric, key):
        def total(factors):
            grown = extinction * factors[layer][None, None]
            setup = jl.make_setup(lidar, scene_at(optical, geometric, grown), plan)
            return jl.total_reflectance(jl.trace_scene(setup, key, reverse=False), setup)

        push = jax.vmap(lambda t: jax.jvp(total, (jnp.ones(LAYERS),), (t,)), out_axes=(None, -1))
        return push(jnp.eye(LAYERS))

    def grow(scene, factors):
        grown = extinction * factors[layer][None, None]
        return eqx.tree_at(lambda s: s.canopy.voxels.leaf, scene, grown)

    unknown = inversion.Unknown(apply=grow, name="layers", bounds=(0.1, 4.0), start=jnp.ones(LAYERS))
    scene = scene_at(*START, extinction)
    model = ForwardModel(lidar, scene, plan, bind_unknowns([unknown], scene), jax.random.key(0))

    keys = list(jax.random.split(jax.random.key(0), MIN_BATCHES))
    pool = ThreadPoolExecutor(os.cpu_count() or 1)

    def over_batches(function):
        compiled = eqx.filter_jit(function)
        return lambda: list(pool.map(lambda k: jax.block_until_ready(compiled(*START, k)), keys))

    contestants = {
        "simulation": over_batches(simulate),
        "4 optical": over_batches(optical_columns),
        "4 geometric": over_batches(geometric_columns),
        "all 8, structured": over_batches(structured),
        "all 8, jacfwd": over_batches(jacfwd_all),
        f"{LAYERS} layers": lambda: model(np.ones(LAYERS)),
        f"{LAYERS} layers, jvp": over_batches(layer_columns),
    }
    times = race(contestants, rounds)
    fastest = best(times)

    _, optical_part, geometric_part = contestants["all 8, structured"]()[0]
    jacfwd_columns = contestants["all 8, jacfwd"]()[0]
    difference = max(
        float(jnp.max(jnp.abs(a - b)) / jnp.max(jnp.abs(b)))
        for a, b in zip((optical_part, geometric_part), jacfwd_columns)
    )
    return {
        "photons": photons,
        "orders": ORDERS,
        "unknowns": {"optical": OPTICAL, "geometric": GEOMETRIC},
        "seconds": fastest,
        "seconds_median": {name: float(np.median(t)) for name, t in times.items()},
        "times_one_simulation": {name: t / fastest["simulation"] for name, t in fastest.items()},
        "structured_against_jacfwd": difference,
    }


def draw(record: dict):
    """Draw the time of each Jacobian over that of a simulation."""
    figure, axes = new_figure(size=(7, 3))
    ratio = record["times_one_simulation"]
    names = list(ratio)[::-1]
    axes.barh(names, [ratio[n] for n in names])
    axes.axvline(5.0, color="black", linestyle="--", label="five simulations")
    axes.set(xlabel="times one simulation", title=f"Jacobian, {record['photons']} photons, {ORDERS} orders")
    axes.legend()
    return figure


def section(record: dict) -> str:
    columns = {
        "columns": str,
        "s": record["seconds"],
        "simulations": record["times_one_simulation"],
    }
    return page_of(f"{record['photons']:,} photons.", table(record["seconds"], columns))
