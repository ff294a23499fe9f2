"""Cost of the same traces on a CPU and on a GPU: single simulations, traces side by side, surveys, leaves.

Run it once on each device: the record keeps the results of others. Traces side by side are those of
independent keys under `jax.vmap`, 256 photons and 256 rays each.
"""

import os
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _common import first_and_warm, new_figure, page_of, table
from simulation_cost import LIDAR, WINDOW, scenes

import jaxlidar as jl

TITLE = "On a GPU"
QUICK = {"rounds": 1, "traces": 8, "shots": 9, "leaves": 100}
PHOTONS, ORDERS = 256, 5


def crown() -> jl.Scene:
    return scenes()["crown over ground"]


def times_of(run: Callable[[], object], rounds: int) -> dict[str, float]:
    """Return the seconds of the first call, which compiles, and of the fastest of others."""
    return dict(zip(("first", "warm"), first_and_warm(run, rounds)))


def simulation(orders: int, rounds: int) -> dict[str, float]:
    """Time `simulate` of the crown to 3 %."""
    plan = jl.plan(LIDAR, crown(), max_orders=orders, window=WINDOW)
    key = jax.random.key(0)
    return times_of(lambda: jl.simulate(LIDAR, crown(), key=key, plan=plan, rtol=0.03).reflectance, rounds)


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
        keys = jax.random.split(jax.random.key(0), count)
        times = times_of(lambda keys=keys: traced(extinction, keys), rounds)
        records.append({"traces": count, **times, "photons per second": count * PHOTONS / times["warm"]})
    return records


def survey(shots: int, rounds: int) -> dict[str, float]:
    """Time shots 0.3 m wide over the crown at first order, to 2 %."""
    side = round(np.sqrt(shots))
    x = np.linspace(-4.0, 4.0, side)
    beams = jl.Survey(
        jl.Lidar(altitude=1000.0, divergence=0.3), np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    )
    settings = {"key": jax.random.key(0), "max_orders": 1, "rtol": 0.02, "shared": False}
    times = times_of(lambda: jl.simulate_many(beams, crown(), **settings).reflectance, rounds)
    return {"shots": side**2, **times}


def leaf_spectra(leaves: int, rounds: int) -> dict[str, float]:
    """Time PROSPECT for many leaves at 2,101 wavelengths."""
    wavelengths = np.arange(400.0, 2501.0)
    cab = jnp.linspace(20.0, 60.0, leaves)
    batch = jax.vmap(lambda c: jl.Prospect(Cab=c))(cab)
    spectra = jax.jit(lambda x: jax.lax.map(lambda leaf: leaf(wavelengths), x, batch_size=min(leaves, 1000)))
    _, warm = first_and_warm(lambda: spectra(batch), rounds)
    return {"leaves": leaves, "warm": warm}


def measure(rounds: int = 3, traces: int = 1024, shots: int = 1000, leaves: int = 10_000) -> dict:
    """Return the times on this device, with up to `traces` side by side."""
    counts = [n for n in (1, 8, 64, 256, 1024, 4096) if n <= traces]
    few = [n for n in counts if n <= 256]
    return {
        "leaves": [leaf_spectra(n, rounds) for n in (leaves // 10, leaves)],
        "side by side": {
            # Not of the first order alone: its rays are the same for all keys, and would be traced once.
            "values": {f"orders: {ORDERS}": side_by_side(ORDERS, counts, rounds)},
            "gradient": {"orders: 2": side_by_side(2, few, rounds, gradient=True)},
        },
        "simulate": {f"orders: {n}": simulation(n, rounds) for n in (1, ORDERS)},
        "survey": survey(shots, 1),
    }


def add_to(earlier: dict, record: dict) -> dict:
    """Return an earlier record with that of this device."""
    device = jax.devices()[0]
    name = f"{os.cpu_count()} CPU cores" if device.platform == "cpu" else device.device_kind
    return {**earlier, name: record}


def draw(record: dict):
    """Draw photons per second over the number of traces side by side."""
    figure, axes = new_figure(2, size=(9, 4))
    for panel, kind in zip(axes, ("values", "gradient")):
        for device, part in record.items():
            for name, rows in part["side by side"][kind].items():
                count, rate = ([r[key] for r in rows] for key in ("traces", "photons per second"))
                panel.loglog(count, rate, "o-", label=f"{device}, {name}")
        panel.set(xlabel="traces side by side", ylabel="photons per second", title=kind)
        panel.legend(fontsize=8)
    return figure


def section(record: dict) -> str:
    def traces(kind: str) -> str:
        """Return a table with a row for each number of traces, and a column for each device and order."""
        rates = {
            f"{device}, {orders}": {r["traces"]: r["photons per second"] for r in rows}
            for device, part in record.items()
            for orders, rows in part["side by side"][kind].items()
        }
        columns = {name: rate.get for name, rate in rates.items()}
        return table(sorted(set().union(*rates.values())), {"traces": int, **columns})

    calls: dict[str, Callable[[dict], float]] = {
        "`simulate` to 3 %, orders: 1, s": lambda part: part["simulate"]["orders: 1"]["warm"],
        "`simulate` to 3 %, orders: 5, s": lambda part: part["simulate"]["orders: 5"]["warm"],
        "its first call, orders: 5, s": lambda part: part["simulate"]["orders: 5"]["first"],
        "`simulate_many`, first order, to 2 %, ms a shot": lambda part: (
            1e3 * part["survey"]["warm"] / part["survey"]["shots"]
        ),
        "PROSPECT, 2,101 wavelengths, us a leaf": lambda part: (
            1e6 * part["leaves"][-1]["warm"] / part["leaves"][-1]["leaves"]
        ),
    }
    devices = {name: lambda call, part=part: calls[call](part) for name, part in record.items()}
    return page_of(
        "The tracer is plain JAX and runs on GPUs as it is; products of arrays are computed in full single "
        "precision there as well. What a GPU gains depends on how much light is traced at once. The table "
        "has photons per second of traces side by side: independent keys of one crown of 64³ voxels under "
        "`jax.vmap`, with 256 photons and 256 rays each. (The times of the H200 are from before products "
        "asked for full precision.)",
        traces("values"),
        "The same for gradients in every voxel, by reverse mode:",
        traces("gradient"),
        "A single simulation or shot is too small for a GPU: its photons march in chunks that fit a "
        "processor's cache, one chunk after the other. Traces side by side, and leaves, gain:",
        table(calls, {"one call": str, **devices}),
    )
