"""Draw the hectare of README.md: run it as `python examples/figures/hectare.py`.

The truth of RH98 is that of level ground below the same trees, an instant pulse and light that is scattered
once: from every voxel comes what enters it and is not absorbed on the way, each column with the irradiance
of the footprint there.
"""

import contextlib
import re
import tempfile
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from jaxlidar.io import atomic_write

HERE = Path(__file__).resolve().parent
# Spherically oriented leaves return this share of their reflectance straight back.
SPHERICAL = 2.0 / 3.0


def true_rh98(stand, canopy, survey, ground: float) -> np.ndarray:
    """Heights above the ground below which 98 % of the energy returns."""
    edge, low = (np.asarray(a, float) for a in (stand.voxel_size, stand.origin))
    leaf, bark = (np.asarray(a, float) for a in (stand.leaf, stand.bark))
    wavelength = survey.lidar.wavelength
    green, brown = float(canopy.leaf(wavelength)[0][0]), float(canopy.bark(wavelength)[0])
    depth = (leaf + bark) * edge[2]
    above = np.cumsum(depth[:, :, ::-1], axis=2)[:, :, ::-1] - depth
    albedo = (green * leaf + brown * bark) / np.maximum(leaf + bark, 1e-30)
    returned = 0.5 * SPHERICAL * albedo * np.exp(-2.0 * above) * -np.expm1(-2.0 * depth)
    floor = ground * np.exp(-2.0 * depth.sum(axis=2))
    faces = low[2] + edge[2] * np.arange(leaf.shape[2] + 1)
    x, y = (low[k] + edge[k] * (np.arange(leaf.shape[k]) + 0.5) for k in (0, 1))
    found = []
    for (east, north), radius in zip(survey.position, survey.footprint_radius):
        r2 = (x[:, None] - east) ** 2 + (y[None, :] - north) ** 2
        light = np.exp(-2.0 * r2 / radius**2)
        energy = np.concatenate([[np.sum(light * floor)], np.einsum("xy,xyz->z", light, returned)])
        found.append(np.interp(0.98, np.cumsum(energy) / energy.sum(), faces))
    return np.array(found)


def drawn(names: dict, seconds: float):
    """The figure: the stand from above, and three maps."""
    survey, hills, stand = names["survey"], names["hills"], names["stand"]
    truth = true_rh98(stand, names["canopy"], survey, float(hills.reflectance))
    figure, axes = plt.subplots(1, 4, figsize=(13.0, 3.5), layout="constrained", sharey=True)
    tops = np.where(np.asarray(stand.leaf) > 0, 1.0 + np.arange(stand.shape[2]), 0.0).max(axis=2)
    low, high = (np.asarray(a, float) for a in (stand.origin, stand.top))
    extent = (low[0], high[0], low[1], high[1])
    image = axes[0].imshow((tops + low[2]).T, origin="lower", extent=extent, cmap="Greens", vmin=0)
    figure.colorbar(image, ax=axes[0], label="height of trees (m)", location="bottom", aspect=30)
    terrain = names["x"], names["x"], np.asarray(hills.heights).T
    levels = axes[0].contour(*terrain, 6, colors="k", linewidths=0.6)
    axes[0].clabel(levels, fontsize=7)
    axes[0].add_patch(plt.Circle((50, 50), survey.footprint_radius[0], fill=False, color="C3"))
    axes[0].set(title="trees, terrain, a footprint", ylabel="y, north (m)")
    panels = [
        (names["rh98"], "RH98 (m)", "viridis", None),
        (names["rh98"] - truth, "error of RH98 (m)", "RdBu_r", 2.0),
        (names["error"], "error of the ground (m)", "RdBu_r", 1.0),
    ]
    half = 0.5 * np.ptp(np.unique(survey.position[:, 0])[:2])
    (west, south), (east, north) = survey.position.min(axis=0) - half, survey.position.max(axis=0) + half
    side = np.unique(survey.position[:, 0]).size
    order = np.lexsort(survey.position.T)
    for ax, (values, label, colours, most) in zip(axes[1:], panels):
        known = np.asarray(values)[order].reshape(-1, side)
        look = {} if most is None else {"vmin": -most, "vmax": most}
        image = ax.imshow(known, origin="lower", extent=(west, east, south, north), cmap=colours, **look)
        figure.colorbar(image, ax=ax, label=label, location="bottom", aspect=30)
        if most is not None:
            ax.set_title(f"median {np.median(known):+.2f} m, spread {np.std(known):.2f} m")
    axes[1].set_title(f"{len(survey)} footprints in {seconds:.0f} s")
    for ax in axes:
        ax.set(xlim=(west, east), ylim=(south, north), xlabel="x, east (m)")
    return figure


def main() -> None:
    """Run the second example as it is printed and save its picture."""
    page = (HERE.parents[1] / "README.md").read_text()
    code = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)[1]
    names: dict = {}
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        exec(code, names)
    figure = drawn(names, time.perf_counter() - start)
    with atomic_write(HERE / "hectare.png") as draft:
        figure.savefig(draft, dpi=80, format="png")


if __name__ == "__main__":
    main()
