"""Cost of changing a scene: the first call, and calls after everyday changes.

Run it as `python examples/benchmarks/everyday_changes.py [--out figures]`. Every change is made to two
scenes, and the slower call counts. Every call is timed twice; the second time is its work without
compilation. Programs compiled are counted as XLA reports them.
"""

import logging
import re
import time
import warnings

import jax
import numpy as np
from _common import machine, new_figure, options, print_table, save_figure, write_json

import jaxlidar as jl

CHANGES = {
    "first call": {},
    "rtol 0.05 to 0.02": {"rtol": 0.02},
    "slope 5 to 6": {"slope": 6.0},
    "ground 0.3 m higher": {"height": 0.3},
    "pulse of 5 ns": {"length": 5.0},
    "one wavelength of three": {"wavelength": 1064.0},
    "zenith 10": {"zenith": 10.0},
    "zenith 11": {"zenith": 11.0},
    "another window": {"window": (-125.0, 70.0)},
    "one more layer of voxels": {"more_voxels": (0, 0, 1)},
    "one more row of voxels": {"more_voxels": (1, 0, 0)},
    "leaf angles": {"angles": "planophile"},
    "other leaf angles": {"angles": "erectophile"},
    "bark": {"bark": True},
    "divergence 2 to 1.5": {"divergence": 1.5},
    "chlorophyll": {"Cab": 50.0},
}
# README's scene, and one of another size whose record is as long as the scene asks.
SCENES = (
    {},
    {"shape": (12, 12, 16), "zenith": 3.0, "slope": 2.0, "length": 4.0, "window": None, "rtol": 0.1},
)
# Seconds; shorter compilations are those of single operations.
NOTABLE = 0.1


class Compilations(logging.Handler):
    """Collects the names and seconds of compilations from the log of JAX."""

    def __init__(self):
        super().__init__()
        self.compiled: list[tuple[str, float]] = []

    def emit(self, record: logging.LogRecord) -> None:
        match = re.match(r"Finished XLA compilation of jit\((.*?)\) in ([\d.e-]+) sec", record.getMessage())
        if match:
            self.compiled.append((match[1], float(match[2])))


def simulate(
    rtol=0.05,
    slope=5.0,
    height=0.0,
    length=6.0,
    wavelength=(532.0, 1064.0, 1550.0),
    zenith=0.0,
    window=(-120.0, 60.0),
    shape=(8, 8, 20),
    more_voxels=(0, 0, 0),
    angles="spherical",
    bark=False,
    divergence=2.0,
    Cab=40.0,
) -> None:
    """Simulate a scene like that of the README."""
    density = np.full(np.add(shape, more_voxels), 0.5)
    voxels = jl.VoxelMap.from_lad(
        density,
        bark=0.05 * density if bark else None,
        voxel_size=0.5,
        origin=(-2, -2, 5),
        leaf_angles=angles,
    )
    leaf = jl.Prospect(N=1.5, Cab=Cab, Car=8.0, Cw=0.01, Cm=0.009)
    canopy = jl.Canopy(voxels, leaf=leaf, bark=0.3 if bark else None, hotspot=False)
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3, slope=slope, height=height))
    pulse = jl.GaussianPulse(fwhm=length)
    lidar = jl.Lidar(wavelength=wavelength, divergence=divergence, zenith=zenith, pulse=pulse)
    jl.simulate(lidar, scene, key=jax.random.key(0), rtol=rtol, window=window)


def main() -> None:
    arguments = options("Cost of changing a scene.")
    warnings.simplefilter("ignore", jl.LateLightWarning)
    compilations = Compilations()
    logger = logging.getLogger("jax")
    logger.addHandler(compilations)
    logger.propagate = False
    jax.config.update("jax_log_compiles", True)
    calls: dict[str, list[dict]] = {name: [] for name in CHANGES}
    for scene in SCENES:
        for name, changes in CHANGES.items():
            compilations.compiled.clear()
            times = []
            for _ in range(2):
                start = time.perf_counter()
                simulate(**{**scene, **changes})
                times.append(time.perf_counter() - start)
            notable = [what for what, elapsed in compilations.compiled if elapsed > NOTABLE]
            calls[name].append({"seconds": times[0], "warm": times[1], "compiled": notable})
    worst = {name: max(of_scenes, key=lambda call: call["seconds"]) for name, of_scenes in calls.items()}
    results = [{"change": name, **call} for name, call in worst.items()]
    write_json(arguments.out / "everyday_changes.json", {"machine": machine(), "changes": results})

    figure, axes = new_figure(size=(7, 5))
    names = [r["change"] for r in results]
    axes.barh(names, [r["seconds"] for r in results], label="with compilation")
    axes.barh(names, [r["warm"] for r in results], label="again")
    axes.invert_yaxis()
    axes.set(xlabel="seconds", title="a call of simulate after a change", xscale="log")
    ticks = (0.2, 0.5, 1, 2, 5, 10)
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes.minorticks_off()
    axes.legend()
    save_figure(figure, arguments.out / "everyday_changes.png")
    rows = [(r["change"], r["seconds"], r["warm"], ", ".join(r["compiled"])) for r in results]
    print_table(("change", "s", "s, again", "compiled"), rows)


if __name__ == "__main__":
    main()
