"""Cost of the same traces on a CPU and on a GPU: single simulations, traces side by side, surveys, leaves.

Run it as `python examples/benchmarks/devices.py [--out figures] [--rounds 3] [--traces 1024]`, once on each
device. Results of devices that the file in the folder has already are kept. Traces side by side are those of
independent keys under `jax.vmap`, 256 photons and 256 rays each.
"""

import json
import os
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _common import best, machine, new_figure, options, print_table, race, save_figure, write_json
from simulation_cost import LIDAR, WINDOW, scenes

import jaxlidar as jl

PHOTONS, ORDERS = 256, 5


def crown() -> jl.Scene:
    return scenes()["crown over ground"]


def first_and_warm(run, rounds: int) -> dict[str, float]:
    """Return the seconds of the first call, which compiles, and of the fastest of the others."""
    start = time.perf_counter()
    jax.block_until_ready(run(0))
    first = time.perf_counter() - start
    times = []
    for n in range(rounds):
        start = time.perf_counter()
        jax.block_until_ready(run(n + 1))
        times.append(time.perf_counter() - start)
    return {"first": first, "warm": min(times)}


def simulation(orders: int, rounds: int) -> dict[str, float]:
    """Time `simulate` of the crown to 3 %."""
    plan = jl.plan(LIDAR, crown(), max_orders=orders, window=WINDOW)

    def run(n: int):
        return jl.simulate(LIDAR, crown(), key=jax.random.key(n), plan=plan, rtol=0.03).reflectance

    return first_and_warm(run, rounds)


def measure_of(plan: jl.Plan):
    """Return the energy of a trace as a function of the extinction coefficients and the key."""

    def measure(extinction, key):
        scene = crown()
        voxels = eqx.tree_at(lambda v: v.leaf, scene.canopy.voxels, extinction)
        scene = eqx.tree_at(lambda s: s.canopy.voxels, scene, voxels)
        setup = jl.make_setup(LIDAR, scene, plan)
        return jnp.sum(jl.total_reflectance(jl.trace_scene(setup, key), setup))

    return measure


def side_by_side(orders: int, counts: list[int], rounds: int, gradient: bool = False) -> list[dict]:
    """Time traces of several keys under `jax.vmap`."""
    plan = jl.plan(
        LIDAR,
        crown(),
        max_orders=orders,
        window=WINDOW,
        n_photons=8 * PHOTONS,
        n_rays=PHOTONS,
        footprint="fixed",
    )
    extinction = jnp.asarray(crown().canopy.voxels.leaf)
    function = jax.grad(measure_of(plan)) if gradient else measure_of(plan)
    traced = jax.jit(lambda k, keys: jnp.mean(jax.vmap(lambda key: function(k, key))(keys), axis=0))
    records = []
    for count in counts:
        times = first_and_warm(
            lambda n, count=count: traced(extinction, jax.random.split(jax.random.key(n), count)), rounds
        )
        records.append({"traces": count, **times, "photons per second": count * PHOTONS / times["warm"]})
        print(orders, "gradient" if gradient else "values", records[-1], flush=True)
    return records


def survey(shots: int, rounds: int) -> dict[str, float]:
    """Time shots 0.3 m wide over the crown at first order, to 2 %."""
    side = round(np.sqrt(shots))
    x = np.linspace(-4.0, 4.0, side)
    beams = jl.Survey(
        jl.Lidar(altitude=1000.0, divergence=0.3), np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    )

    def run(n: int):
        options = {"key": jax.random.key(n), "max_orders": 1, "rtol": 0.02, "shared": False}
        return jl.simulate_many(beams, crown(), **options).reflectance

    return {"shots": side**2, **first_and_warm(run, rounds)}


def leaf_spectra(leaves: int, rounds: int) -> dict[str, float]:
    """Time PROSPECT for many leaves at 2,101 wavelengths."""
    wavelengths = np.arange(400.0, 2501.0)
    cab = jnp.linspace(20.0, 60.0, leaves)
    batch = jax.vmap(lambda c: jl.Prospect(Cab=c))(cab)
    spectra = jax.jit(lambda x: jax.lax.map(lambda leaf: leaf(wavelengths), x, batch_size=min(leaves, 1000)))
    return {"leaves": leaves, **best(race({"warm": lambda: spectra(batch)}, rounds))}


def draw(results: dict, out) -> None:
    """Draw photons per second over the number of traces side by side."""
    figure, axes = new_figure(2, size=(9, 4))
    for panel, kind in zip(axes, ("values", "gradient")):
        for device, record in results.items():
            for name, rows in record["side by side"][kind].items():
                panel.loglog(
                    [r["traces"] for r in rows],
                    [r["photons per second"] for r in rows],
                    "o-",
                    label=f"{device}, {name}",
                )
        panel.set(xlabel="traces side by side", ylabel="photons per second", title=kind)
        panel.legend(fontsize=8)
    save_figure(figure, out / "devices.png")


def main() -> None:
    arguments = options("Cost on devices.", rounds=3, traces=1024)
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "devices.json"
    results = json.loads(path.read_text()) if path.exists() else {}
    rounds = arguments.rounds
    counts = [n for n in (1, 8, 64, 256, 1024, 4096) if n <= arguments.traces]
    few = [n for n in counts if n <= 256]
    record = {}
    device = jax.devices()[0]
    name = f"{os.cpu_count()} CPU cores" if device.platform == "cpu" else device.device_kind
    record["leaves"] = [leaf_spectra(n, rounds) for n in (1000, 10000)]
    print(record["leaves"], flush=True)
    record["side by side"] = {
        # Not of the first order alone: its rays are the same for all keys, and would be traced once.
        "values": {f"orders: {ORDERS}": side_by_side(ORDERS, counts, rounds)},
        "gradient": {"orders: 2": side_by_side(2, few, rounds, gradient=True)},
    }
    record["simulate"] = {f"orders: {n}": simulation(n, rounds) for n in (1, ORDERS)}
    print(record["simulate"], flush=True)
    record["survey"] = survey(1000, 1)
    print(record["survey"], flush=True)
    results[name] = {"machine": machine(), **record}
    write_json(path, results)
    draw(results, arguments.out)
    rows = [
        (kind, orders, r["traces"], r["first"], r["warm"], r["photons per second"])
        for kind, parts in record["side by side"].items()
        for orders, records in parts.items()
        for r in records
    ]
    print_table(("of", "orders", "traces", "first, s", "warm, s", "photons per s"), rows)


if __name__ == "__main__":
    main()
