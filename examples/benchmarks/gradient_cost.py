"""Gradients in every voxel, or by one height, against one simulation: time, memory, compilation.

A map of 20 m x 20 m x 20 m of leaves over ground, in 20^3 and in 100^3 voxels, at first order and with eight
orders, seen from nadir by a beam of 10 m. A linear function of the waveform is differentiated by `jax.grad`
of `simulate`: by the leaf area density of every voxel, in reverse mode by replay, and by the height of the
ground, in the direction of that one number (`jaxlidar/trace/derivatives/replay.py`). Compared are programs of
`jax.jit`: `simulate`, and the gradient with the value (within a transformation each simulates eight batches).
Seconds are of the processor, the fastest of some rounds in turns: other load of the machine matters less.
Memory is what the compiler reserves beside arguments and results.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
from _common import best, new_figure, page_of, table

import jaxlidar as jl

TITLE = "Gradients in every voxel, and by a height"
QUICK = {"photons": 64, "rays": 64, "rounds": 1, "finest": 20}
SIZE, ORDERS = 20.0, 8
# What derivatives are by, in the order of arguments.
VARIED = ("every voxel", "height of the ground")
HEIGHT = jnp.asarray(0.0)
KEY = jax.random.key(0)
# A single call of a few ms is near the resolution of the processor's clock.
SPAN = 0.5


def problem(varied: str, side: int, orders: int, photons: int, rays: int):
    """Return leaf area densities, and functions: `simulate`, the same as called, and the gradient.

    They are functions of leaf area densities, the height of the ground and a key.
    """
    lidar = jl.Lidar(wavelength=1064.0, divergence=10.0)
    lad = jnp.asarray(np.random.default_rng(0).uniform(0.0, 0.5, (side, side, side)), float)

    def scene(lad, height) -> jl.Scene:
        voxels = jl.VoxelMap.from_lad(lad, voxel_size=SIZE / side, origin=(-SIZE / 2, -SIZE / 2, 1.0))
        return jl.Scene(
            canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4)),
            ground=jl.Ground(height=height, reflectance=0.3),
        )

    numbers = {"max_orders": orders, "n_photons": 8 * photons, "n_rays": rays, "window": (-150.0, 150.0)}
    plan = jl.plan(lidar, scene(lad, HEIGHT), **numbers)
    factors = jnp.sin(jnp.arange(plan.n_samples))

    def simulate(lad, height, key):
        return jl.simulate(lidar, scene(lad, height), plan=plan, key=key).reflectance

    def as_called(lad, height, key):
        wave = jl.simulate(lidar, scene(lad, height), plan=plan, key=key, n_photons=8 * photons)
        return wave.reflectance

    def loss(lad, height, key):
        return jnp.sum(simulate(lad, height, key) @ factors)

    return lad, simulate, as_called, jax.value_and_grad(loss, argnums=VARIED.index(varied))


def compiled(function, lad) -> tuple[object, dict[str, float]]:
    """Compile a function; return it with the seconds that took and the memory of temporaries in MB."""
    start = time.perf_counter()
    lowered = jax.jit(function).lower(lad, HEIGHT, KEY)
    tracing = time.perf_counter() - start
    program = lowered.compile()
    seconds = time.perf_counter() - start
    memory = program.memory_analysis().temp_size_in_bytes / 1e6
    return program, {"tracing": tracing, "compilation": seconds - tracing, "MB": memory}


def processor_seconds(program, lad) -> float:
    """Return the time of the processor of one call, the mean of as many as fill `SPAN` seconds."""
    calls, start = 0, time.process_time()
    while time.process_time() - start < SPAN:
        jax.block_until_ready(program(lad, HEIGHT, KEY))
        calls += 1
    return (time.process_time() - start) / calls


def cost_of_case(varied: str, side: int, orders: int, photons: int, rays: int, rounds: int) -> dict:
    """Return the times of simulation and gradient, with all voxels and with half of them, and memory."""
    lad, simulate, as_called, gradient = problem(varied, side, orders, photons, rays)
    programs, costs = {}, {}
    for name, function in {"simulation": simulate, "gradient": gradient}.items():
        programs[name], costs[name] = compiled(function, lad)
    half_empty = lad * (np.random.default_rng(1).uniform(size=lad.shape) < 0.5)
    contestants = {
        **{name: (program, lad) for name, program in programs.items()},
        "simulate, as called": (as_called, lad),
        **{f"{name}, half empty": (program, half_empty) for name, program in programs.items()},
    }
    times: dict[str, list[float]] = {name: [] for name in contestants}
    for program, values in contestants.values():
        jax.block_until_ready(program(values, HEIGHT, KEY))
    for _ in range(rounds):
        for name, (program, values) in contestants.items():
            times[name].append(processor_seconds(program, values))
    fastest = best(times)
    lad, _, _, gradient = problem(varied, side, orders, 4 * photons, 4 * rays)
    _, more = compiled(gradient, lad)
    return {
        "varied": varied,
        "side": side,
        "orders": orders,
        "seconds": {name: fastest[name] for name in ("simulation", "gradient", "simulate, as called")},
        "ratio": fastest["gradient"] / fastest["simulation"],
        "ratio_half_empty": fastest["gradient, half empty"] / fastest["simulation, half empty"],
        "ratio_as_called": fastest["gradient"] / fastest["simulate, as called"],
        "compilation": {name: cost["compilation"] for name, cost in costs.items()},
        "tracing": {name: cost["tracing"] for name, cost in costs.items()},
        "MB": costs["gradient"]["MB"],
        "MB_simulation": costs["simulation"]["MB"],
        "MB_four_times_the_photons": more["MB"],
        "MB_voxels": lad.size * lad.dtype.itemsize / 1e6,
    }


def measure(photons: int = 8192, rays: int = 1024, rounds: int = 3, finest: int = 100) -> dict:
    """Return the costs of maps of 20^3 and `finest`^3 voxels; photons and rays are those of a batch."""
    sides = dict.fromkeys((20, finest))
    cases = [(VARIED[0], side, orders) for side in sides for orders in (1, ORDERS)]
    cases += [(VARIED[1], 20, orders) for orders in (1, ORDERS)]
    rows = [cost_of_case(*case, photons, rays, rounds) for case in cases]
    return {"photons": 8 * photons, "rays": 8 * rays, "cases": rows}


def draw(record: dict):
    """Draw the time of each gradient over that of a simulation."""
    figure, axes = new_figure(size=(8, 3.6))
    cases = record["cases"]
    place = np.arange(len(cases))
    axes.barh(place - 0.2, [c["ratio"] for c in cases], 0.4, label="leaves everywhere")
    axes.barh(place + 0.2, [c["ratio_half_empty"] for c in cases], 0.4, label="half of the voxels empty")
    axes.axvline(3.0, color="black", linestyle="--", label="three simulations")
    names = [
        f"{c['varied']}, {c['side']}³ voxels, {c['orders']} order{'s' * (c['orders'] > 1)}" for c in cases
    ]
    axes.set_yticks(place, names)
    axes.set(xlabel="times one simulation", title="Gradients")
    # The first case on top, and room for the legend beside the bars.
    axes.invert_yaxis()
    axes.margins(x=1.0)
    axes.legend(loc="upper right")
    return figure


def section(record: dict) -> str:
    columns = {
        "by": "varied",
        "voxels": lambda c: f"{c['side']}³",
        "orders": "orders",
        "CPU s": lambda c: c["seconds"]["gradient"],
        "simulations": "ratio",
        "half the voxels empty": "ratio_half_empty",
        "calls of `simulate`": "ratio_as_called",
        "MB": "MB",
        "MB, four times the photons": "MB_four_times_the_photons",
        "compilation, s": lambda c: c["compilation"]["gradient"],
        "times that of a simulation": lambda c: c["compilation"]["gradient"] / c["compilation"]["simulation"],
    }
    return page_of(
        "The gradient of a function of the waveform with respect to the leaf area density of every voxel, or "
        "to the height of the ground, with its value, by `jax.grad` of `simulate(..., plan=)`: "
        f"{record['photons']:,} photons, {record['rays']:,} rays. Times are compared with a compiled "
        "simulation of the same photons, and with `simulate` as it is called outside of a transformation. "
        "Where voxels are empty or thin, photons are traced once more for what leaves there would scatter. "
        "Memory is that of temporaries.",
        table(record["cases"], columns),
    )
