"""Shared by the figures of the paper: command line, figures one column wide, tables, pulses of photons."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import jax
import matplotlib
import numpy as np
from _analog import analog_returns

import jaxlidar as jl
from jaxlidar.io import atomic_write

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#1A1A1A")
plt.rcParams.update(
    {
        "font.size": 8,
        "axes.labelsize": 8,
        "axes.titlesize": 8,
        "legend.fontsize": 7,
        "legend.frameon": False,
        "lines.linewidth": 1.1,
    }
)
COLUMN_WIDTH = 3.5
# Time step of the paper, ns: a pulse is sent in pieces of this length, and returns are distinguished by it.
PIECE = 0.1
# Half angle of the cone in which photons count as returned, degrees.
CONE = 20.0


def options(description: str | None, argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line: `--out` for the folder, `--small` for a quick and coarse run."""
    parser = argparse.ArgumentParser(description=(description or "").split("\n")[0])
    parser.add_argument("--out", default="figures", type=Path, help="folder of the figure (default: figures)")
    parser.add_argument("--small", action="store_true", help="a quick and coarse run")
    return parser.parse_args(argv)


def new_figure(columns: int = 1, rows: int = 1, height: float = 2.6, width: float = COLUMN_WIDTH, **shared):
    """Return a figure, by default one column wide, and its axes."""
    return plt.subplots(rows, columns, figsize=(width, height), layout="constrained", **shared)


def save(figure, path: Path) -> None:
    """Write a PNG, atomically."""
    with atomic_write(path) as draft:
        figure.savefig(draft, format="png", dpi=200)
    plt.close(figure)
    print(path)


def table(header: Sequence[str], rows: Sequence[Sequence]) -> None:
    """Print rows below a header."""
    text = [list(header), *([c if isinstance(c, str) else f"{c:.4g}" for c in row] for row in rows)]
    widths = [max(len(row[i]) for row in text) for i in range(len(header))]
    for row in text:
        print("  ".join(c.rjust(w) for c, w in zip(row, widths)))


def peaks(power: np.ndarray, floor: float = 0.01) -> np.ndarray:
    """Return samples that are higher than both their neighbours and than `floor` of the highest."""
    middle = power[1:-1]
    return 1 + np.flatnonzero((middle > power[:-2]) & (middle >= power[2:]) & (middle > floor * power.max()))


def tree_scene(voxel_size: float, *, leaves: bool = True, **changes) -> jl.Scene:
    """Return the tree of the paper with 250 m2 of its leaf and measured bark, over measured soil.

    `changes` replaces fields of the scene, such as the ground.
    """
    tree = jl.grow(jl.broadleaf(), seed=0)
    tree = tree if leaves else tree.leafless()
    area = 250.0 / max(len(tree.bud_radius), 1)
    canopy = jl.Canopy(
        jl.voxelise(tree, voxel_size, leaf_area=area, wood="surface"),
        leaf=jl.Prospect.paper(),
        bark=jl.spectrum("bark-oak"),
        hotspot=False,
    )
    scene_fields = {"canopy": canopy, "ground": jl.Ground(reflectance=jl.spectrum("soil-medium"))}
    return jl.Scene(**(scene_fields | changes))


def send_pulses(
    lidar: jl.Lidar, scene: jl.Scene, plan: jl.Plan, seed: int, pulses: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return times (ns) and weights of returned photons, each of shape (pulses, pieces): iterations of the
    paper.

    A pulse is sent in pieces of 0.1 ns, one photon each, with the energy of the pulse at that time; pieces of
    less than a thousandth of the strongest are below the detection level.
    """
    low, high = lidar.pulse.support(float(lidar.jitter))
    edges = np.arange(np.floor(low / PIECE), np.ceil(high / PIECE) + 1) * PIECE
    energy = np.diff(np.asarray(lidar.pulse.cumulative(jax.numpy.asarray(edges), float(lidar.jitter))))
    strong = energy > 1e-3 * energy.max()
    sent, energy = (0.5 * (edges[:-1] + edges[1:]))[strong], energy[strong]
    returns = analog_returns(
        lidar, scene, plan, key=jax.random.key(seed), n_photons=pulses * sent.size, cone=CONE
    )
    shape = (pulses, sent.size)
    weight = np.asarray(returns.weight[0], float).reshape(shape) * energy
    return np.asarray(returns.time, float).reshape(shape) + sent, weight


def unique_returns(time: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the cumulative number of distinct return times, to 0.1 ns, after each pulse."""
    returned = weight > 0
    time_step = np.round(time[returned] / PIECE).astype(int)
    pulse = np.broadcast_to(np.arange(len(time))[:, None], time.shape)[returned]
    _, first = np.unique(time_step, return_index=True)
    return np.cumsum(np.bincount(pulse[first], minlength=len(time)))


def until_stable(unique: np.ndarray, window: int, threshold: float) -> int:
    """Return the first pulse after which `window` pulses have fewer than `threshold` new returns each."""
    new = unique[window:] - unique[:-window]
    quiet = np.flatnonzero(new <= threshold * window)
    return int(quiet[0]) if quiet.size else len(unique)
