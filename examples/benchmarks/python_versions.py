"""The same work on several versions of Python and JAX.

`--set pythons=PATH,PATH` names interpreters that have jaxlidar installed, the newest last. They take turns in
processes of their own, round after round, so that other load of the machine slows all alike; the fastest
round counts.

The scene is the crown over ground of `simulation_cost.py`. "First call" is the whole call of `simulate` in a
new process, which compiles; all other times are warm.
"""

import functools
import json
import platform
import subprocess
import sys
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _common import best, new_figure, number, page_of, race, table
from simulation_cost import LIDAR, ORDERS, WINDOW, scenes

import jaxlidar as jl
from jaxlidar.extend import Program

TITLE = "Older Pythons"
QUICK = {"rounds": 1, "calls": 1}
KEY = jax.random.key(0)
TRAITS = {"N": 1.8, "Cab": 40.0, "Car": 8.0, "Cant": 1.0, "Cbrown": 0.1, "Cw": 0.01, "Cm": 0.009}
LEAVES, SPECTRUM = 200, np.arange(400.0, 2501.0)


def seconds_of_calls(calls: int) -> dict[str, float]:
    """Return the seconds of typical calls in this process, the fastest of some."""
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
        calls,
    )
    return {"first call": first_call, **best(times)}


def in_process(python: str, calls: int) -> dict:
    """Return the version of an interpreter and its times, of a new process."""
    process = subprocess.run([python, __file__, str(calls)], capture_output=True, text=True)
    if process.returncode:
        raise SystemExit(f"{python} failed: {(process.stderr.strip() or 'no message').splitlines()[-1]}")
    return json.loads(process.stdout.splitlines()[-1])


def measure(pythons: tuple[str, ...] = (sys.executable,), rounds: int = 3, calls: int = 9) -> dict:
    """Return the times of each interpreter, and their ratio to those of the last."""
    runs: list[list[dict]] = [[] for _ in pythons]
    for _ in range(rounds):
        for python, measurements in zip(pythons, runs):
            measurements.append(in_process(python, calls))
    versions = []
    for first, *others in runs:
        fastest = {name: min(m["seconds"][name] for m in (first, *others)) for name in first["seconds"]}
        versions.append({**first, "seconds": fastest})
    newest = versions[-1]["seconds"]
    for version in versions:
        version["ratio"] = {name: s / newest[name] for name, s in version["seconds"].items()}
    return {"versions": versions}


def draw(record: dict):
    """Draw the seconds over those of the newest version."""
    figure, axes = new_figure(size=(7, 3.8))
    versions = record["versions"]
    names, height = list(versions[-1]["seconds"]), 0.8 / len(versions)
    for i, version in enumerate(versions):
        label = f"Python {version['python']}, jax {version['jax']}"
        axes.barh(np.arange(len(names)) + i * height, list(version["ratio"].values()), height, label=label)
    axes.set_yticks(np.arange(len(names)) + 0.5 * height * (len(versions) - 1), names)
    axes.invert_yaxis()
    axes.set_xlabel(f"times the seconds of Python {versions[-1]['python']}")
    figure.legend(loc="outside upper center", ncols=len(versions), frameon=False)
    return figure


def section(record: dict) -> str:
    *older, newest = record["versions"]
    name = "Python {python}, jax {jax}".format
    columns = {
        "": str,
        f"{name(**newest)}: s": newest["seconds"],
        **{
            f"{name(**v)}: s, and times as long": lambda what, v=v: (
                f"{number(v['seconds'][what])}, {number(v['ratio'][what])} times"
            )
            for v in older
        },
    }
    return page_of(
        "The same work on several versions of Python, each with its newest JAX.",
        table(newest["seconds"], columns),
    )


if __name__ == "__main__":
    times = seconds_of_calls(int(sys.argv[1]))
    print(json.dumps({"python": platform.python_version(), "jax": jax.__version__, "seconds": times}))
