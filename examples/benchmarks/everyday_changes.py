"""Cost of changing a scene: the first call, and calls after everyday changes.

Every change is made to two scenes, and the slower call counts. Every call is timed twice; the second time is
its work without compilation. Programs compiled are counted as XLA reports them.
"""

import logging
import re
import warnings

import jax
import numpy as np
from _common import first_and_warm, new_figure, page_of, table

import jaxlidar as jl

TITLE = "Cost of changing a scene"
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
QUICK = {"n_changes": 2}
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


def measure(n_changes: int = len(CHANGES)) -> dict:
    """Return the times of a call after each of the first changes, and the programs that it compiles."""
    warnings.simplefilter("ignore", jl.LateLightWarning)
    compilations = Compilations()
    logger = logging.getLogger("jax")
    logger.addHandler(compilations)
    logger.propagate = False
    jax.config.update("jax_log_compiles", True)
    calls: dict[str, list[dict]] = {name: [] for name in list(CHANGES)[:n_changes]}
    for scene in SCENES:
        for name, of_scenes in calls.items():
            compilations.compiled.clear()
            settings = {**scene, **CHANGES[name]}
            first, warm = first_and_warm(lambda settings=settings: simulate(**settings), 1)
            notable = [what for what, elapsed in compilations.compiled if elapsed > NOTABLE]
            of_scenes.append({"seconds": first, "warm": warm, "compiled": notable})
    slowest = {name: max(of_scenes, key=lambda call: call["seconds"]) for name, of_scenes in calls.items()}
    return {"changes": [{"change": name, **call} for name, call in slowest.items()]}


def draw(record: dict):
    """Draw the seconds of each call, and of the same call repeated."""
    figure, axes = new_figure(size=(7, 5))
    names = [r["change"] for r in record["changes"]]
    for quantity, label in (("seconds", "with compilation"), ("warm", "again")):
        axes.barh(names, [r[quantity] for r in record["changes"]], label=label)
    axes.invert_yaxis()
    axes.set(xlabel="seconds", title="a call of simulate after a change", xscale="log")
    ticks = (0.2, 0.5, 1, 2, 5, 10)
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes.minorticks_off()
    axes.legend()
    return figure


def section(record: dict) -> str:
    columns = {
        "change": "change",
        "s": "seconds",
        "s, repeated": "warm",
        "programs compiled": lambda r: ", ".join(f"`{name}`" for name in r["compiled"]),
    }
    return page_of(
        "Seconds of a call of `simulate` with three wavelengths after one change, and of the same call "
        "repeated; of two scenes the slower one. Array sizes are rounded up to size buckets, and numbers are "
        "arguments of compiled programs: the trace (`batch_of_trace_first`, `batch_of_trace_higher`) is "
        "compiled anew where a size exceeds its bucket, as that of a record which a smaller tolerance makes "
        "longer may, and where an effect is new.",
        table(record["changes"], columns),
    )
