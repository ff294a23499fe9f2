"""Worker of `python_versions.py`: seconds of typical calls in this process, as a line of JSON."""

import functools
import json
import platform
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _common import best, race
from simulation_cost import LIDAR, ORDERS, WINDOW, scenes

import jaxlidar as jl
from jaxlidar.extend import Program

KEY, ROUNDS = jax.random.key(0), 9
TRAITS = {"N": 1.8, "Cab": 40.0, "Car": 8.0, "Cant": 1.0, "Cbrown": 0.1, "Cw": 0.01, "Cm": 0.009}
LEAVES, SPECTRUM = 200, np.arange(400.0, 2501.0)


def main() -> None:
    scene = scenes()["crown over ground"]

    def simulation():
        return jl.simulate(LIDAR, scene, key=KEY, rtol=0.01, max_orders=ORDERS, window=WINDOW).reflectance

    start = time.perf_counter()
    jax.block_until_ready(simulation())
    first_call = time.perf_counter() - start

    plan = jl.plan(LIDAR, scene, max_orders=ORDERS, window=WINDOW, describe=False)
    rays_only = jl.plan(LIDAR, scene, max_orders=1, window=WINDOW, n_rays=8192, describe=False)
    photons_only = plan.with_config(n_rays=1)

    def trace(scene, plan, reverse=False):
        return jl.trace_scene(jl.make_setup(LIDAR, scene, plan), KEY, reverse=reverse)

    def raised(heights):
        moved = eqx.tree_at(lambda s: s.ground.height, scene, heights[0])
        return eqx.tree_at(lambda s: s.canopy.voxels.leaf, moved, scene.canopy.voxels.leaf * heights[1])

    def total(heights, reverse=False):
        setup = jl.make_setup(LIDAR, raised(heights), plan)
        return jl.total_reflectance(jl.trace_scene(setup, KEY, reverse=reverse), setup)

    # With the options by which `simulate` compiles its batches.
    traced = Program(trace, one_core=True)
    jacobian, reverse_jacobian = (
        Program(jax.jacfwd(functools.partial(total, reverse=r)), one_core=True) for r in (False, True)
    )
    heights = jnp.array([0.0, 1.0])
    leaves = jax.vmap(lambda n: jl.Prospect(**{**TRAITS, "N": n}))(jnp.linspace(1.2, 2.4, LEAVES))
    spectra = jax.jit(lambda x: jax.lax.map(lambda leaf: leaf(SPECTRUM), x, batch_size=20))
    times = race(
        {
            "simulate to 1 %": simulation,
            f"{rays_only.n_rays} rays, first order": lambda: traced(scene, rays_only),
            f"{photons_only.photons_traced} photons, higher orders": lambda: traced(scene, photons_only),
            "the same, reverse=True": lambda: traced(scene, photons_only, True),
            "Jacobian in height and density": lambda: jacobian(heights),
            "Jacobian, reverse=True": lambda: reverse_jacobian(heights),
            f"{LEAVES} leaf spectra": lambda: spectra(leaves),
        },
        ROUNDS,
    )
    seconds = {"first call": first_call, **best(times)}
    print(json.dumps({"python": platform.python_version(), "jax": jax.__version__, "seconds": seconds}))


if __name__ == "__main__":
    main()
