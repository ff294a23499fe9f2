"""Worker of `python_versions.py`: seconds of some work in this process, as a line of JSON."""

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
from jaxlidar.extend import ONE_CORE

KEY, ROUNDS = jax.random.key(0), 9
TRAITS = {"N": 1.8, "Cab": 40.0, "Car": 8.0, "Cant": 1.0, "Cbrown": 0.1, "Cw": 0.01, "Cm": 0.009}
LEAVES, SPECTRUM = 200, np.arange(400.0, 2501.0)


def main() -> None:
    scene = scenes()["crown over ground"]

    def simulation():
        return jl.simulate(LIDAR, scene, key=KEY, rtol=0.01, max_orders=ORDERS, window=WINDOW).reflectance

    begun = time.perf_counter()
    jax.block_until_ready(simulation())
    first_call = time.perf_counter() - begun

    plan = jl.plan(LIDAR, scene, max_orders=ORDERS, window=WINDOW, describe=False)
    single = jl.plan(LIDAR, scene, max_orders=1, window=WINDOW, n_rays=8192, describe=False)
    few = plan.with_config(n_rays=1)

    def trace(scene, plan, reverse=False):
        return jl.trace_scene(jl.make_setup(LIDAR, scene, plan), KEY, reverse=reverse)

    def raised(heights):
        moved = eqx.tree_at(lambda s: s.ground.height, scene, heights[0])
        return eqx.tree_at(lambda s: s.canopy.voxels.leaf, moved, scene.canopy.voxels.leaf * heights[1])

    def total(heights, reverse=False):
        setup = jl.make_setup(LIDAR, raised(heights), plan)
        return jl.total_reflectance(jl.trace_scene(setup, KEY, reverse=reverse), setup)

    # As `simulate` compiles its batches.
    traced = eqx.filter_jit(trace, **ONE_CORE)
    jacobian, either = (
        jax.jit(jax.jacfwd(functools.partial(total, reverse=r)), **ONE_CORE) for r in (False, True)
    )
    heights = jnp.array([0.0, 1.0])
    leaves = jax.vmap(lambda n: jl.Prospect(**{**TRAITS, "N": n}))(jnp.linspace(1.2, 2.4, LEAVES))
    spectra = jax.jit(lambda x: jl.prospect_spectra(x, SPECTRUM, 20))
    found = race(
        {
            "simulate to 1 %": simulation,
            f"{single.n_rays} rays, first order": lambda: traced(scene, single),
            f"{few.n_photons} photons, higher orders": lambda: traced(scene, few),
            "the same, reverse=True": lambda: traced(scene, few, True),
            "Jacobian in height and density": lambda: jacobian(heights),
            "Jacobian, reverse=True": lambda: either(heights),
            f"{LEAVES} leaf spectra": lambda: spectra(leaves),
        },
        ROUNDS,
    )
    seconds = {"first call": first_call, **best(found)}
    print(json.dumps({"python": platform.python_version(), "jax": jax.__version__, "seconds": seconds}))


if __name__ == "__main__":
    main()
