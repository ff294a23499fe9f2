"""One trace for all wavelengths: 2,101 wavelengths against one, same scene and photons.

The scene is a crown of leaf (PROSPECT) and bark over the ground, ten orders. Whole calls of `simulate` are
timed, warm, in turn; the ratio is that of the fastest rounds.
"""

import jax
import numpy as np
from _common import best, crown_extinction, new_figure, number, page_of, race, table

import jaxlidar as jl

TITLE = "Many wavelengths from one trace"
QUICK = {"photons": 1024, "rounds": 1}
WAVELENGTHS = {1: 1064.0, 10: np.linspace(450, 2450, 10), 100: np.linspace(450, 2450, 100)}
WAVELENGTHS[2101] = np.arange(400.0, 2501.0)
N, SIZE = 32, 10.0
ORDERS = 10


def crown() -> jl.Scene:
    """Return leaf and bark in a sphere over bare soil."""
    k = crown_extinction(N)
    voxels = jl.VoxelMap.from_extinction(0.9 * k, 0.1 * k, voxel_size=SIZE / N, origin=(-5.0, -5.0, 0.0))
    leaf = jl.Prospect(N=1.5, Cab=40.0, Car=8.0, Cant=0.0, Cbrown=0.0, Cw=0.01, Cm=0.009)
    return jl.Scene(
        canopy=jl.Canopy(voxels, leaf=leaf, bark=0.4, hotspot=False), ground=jl.Ground(reflectance=0.3)
    )


def measure(photons: int = 131072, rounds: int = 9) -> dict:
    """Return the times of a simulation by the number of wavelengths."""
    scene, key = crown(), jax.random.key(0)

    def simulation(wavelength):
        lidar = jl.Lidar(wavelength=wavelength, divergence=10.0, profile="top-hat")
        return lambda: jl.simulate(lidar, scene, key=key, n_photons=photons, max_orders=ORDERS).reflectance

    times = race({str(n): simulation(w) for n, w in WAVELENGTHS.items()}, rounds)
    fastest = best(times)
    return {
        "photons": photons,
        "orders": ORDERS,
        "seconds": fastest,
        "seconds_median": {n: float(np.median(t)) for n, t in times.items()},
        "times_one_wavelength": {n: t / fastest["1"] for n, t in fastest.items()},
    }


def draw(record: dict):
    """Draw the seconds by the number of wavelengths."""
    figure, axes = new_figure()
    fastest = record["seconds"]
    axes.semilogx([int(n) for n in fastest], list(fastest.values()), "o-")
    axes.axhline(1.15 * fastest["1"], color="black", linestyle="--", label="1.15 times one wavelength")
    axes.set(xlabel="wavelengths", ylabel="seconds", ylim=(0, 1.2 * max(fastest.values())))
    axes.set_title(f"simulate: {record['photons']} photons, {ORDERS} orders")
    axes.legend()
    return figure


def section(record: dict) -> str:
    columns = {
        "wavelengths": int,
        "s": record["seconds"],
        "times one": lambda n: number(record["times_one_wavelength"][n], 3),
    }
    return page_of(f"{record['photons']:,} photons.", table(record["seconds"], columns))
