"""One trace for all wavelengths: 2,101 wavelengths against one, same scene and photons.

Run it as `python examples/benchmarks/one_trace_all_wavelengths.py [--out figures] [--photons 131072]
[--rounds 9]`. The scene is a crown of leaf (PROSPECT) and bark over the ground, ten orders. Whole calls of
`simulate` are timed, warm, in turn; the ratio is that of the fastest rounds.
"""

import jax
import numpy as np
from _common import best, machine, new_figure, options, print_table, race, save_figure, write_json

import jaxlidar as jl

WAVELENGTHS = {1: 1064.0, 10: np.linspace(450, 2450, 10), 100: np.linspace(450, 2450, 100)}
WAVELENGTHS[2101] = np.arange(400.0, 2501.0)
N, SIZE = 32, 10.0
ORDERS = 10


def crown() -> jl.Scene:
    """Return leaf and bark in a sphere over bare soil."""
    centres = (np.arange(N) + 0.5) * SIZE / N
    x, y, z = np.meshgrid(centres, centres, centres, indexing="ij")
    inside = (x - 5) ** 2 + (y - 5) ** 2 + (z - 6) ** 2 < 3.5**2
    k = np.where(inside, 0.5 * np.random.default_rng(0).uniform(0, 2, (N, N, N)), 0.0)
    voxels = jl.VoxelMap.from_extinction(0.9 * k, 0.1 * k, voxel_size=SIZE / N, origin=(-5.0, -5.0, 0.0))
    leaf = jl.Prospect(N=1.5, Cab=40.0, Car=8.0, Cant=0.0, Cbrown=0.0, Cw=0.01, Cm=0.009)
    return jl.Scene(
        canopy=jl.Canopy(voxels, leaf=leaf, bark=0.4, hotspot=False), ground=jl.Ground(reflectance=0.3)
    )


def main() -> None:
    arguments = options("One trace for all wavelengths.", photons=131072, rounds=9)
    scene, key = crown(), jax.random.key(0)

    def simulation(wavelength):
        lidar = jl.Lidar(wavelength=wavelength, divergence=10.0, profile="top-hat")
        return lambda: (
            jl.simulate(lidar, scene, key=key, n_photons=arguments.photons, max_orders=ORDERS).reflectance
        )

    times = race({str(n): simulation(w) for n, w in WAVELENGTHS.items()}, arguments.rounds)
    fastest = best(times)
    ratio = {n: t / fastest["1"] for n, t in fastest.items()}
    record = {
        "machine": machine(),
        "photons": arguments.photons,
        "orders": ORDERS,
        "seconds": fastest,
        "seconds_median": {n: float(np.median(t)) for n, t in times.items()},
        "times_one_wavelength": ratio,
    }
    write_json(arguments.out / "one_trace_all_wavelengths.json", record)

    figure, axes = new_figure()
    axes.semilogx([int(n) for n in fastest], list(fastest.values()), "o-")
    axes.axhline(1.15 * fastest["1"], color="black", linestyle="--", label="1.15 times one wavelength")
    axes.set(xlabel="wavelengths", ylabel="seconds", ylim=(0, 1.2 * max(fastest.values())))
    axes.set_title(f"simulate: {arguments.photons} photons, {ORDERS} orders")
    axes.legend()
    save_figure(figure, arguments.out / "one_trace_all_wavelengths.png")

    medians = record["seconds_median"]
    print_table(
        ("wavelengths", "s, best", "s, median", "times one"),
        [(n, fastest[n], medians[n], ratio[n]) for n in fastest],
    )
    print(f"2,101 wavelengths cost {ratio['2101']:.2f} times one (wanted: at most 1.15)")


if __name__ == "__main__":
    main()
