"""Measure and draw the hectare of README.md: `python examples/figures/hectare.py`, on an idle machine.

The time goes into `hectare.json`, into the picture and into the sentence of README.md before the example.

The truth of RH98 is that of level ground below the same trees, an instant pulse and single scattering: each
voxel returns the intercepted light times the two-way transmittance above it, each column weighted by the
irradiance of the footprint.
"""

import contextlib
import json
import os
import re
import tempfile
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from jaxlidar.io import atomic_write

FOLDER = Path(__file__).resolve().parent
PAGE = FOLDER.parents[1] / "README.md"
# Intensity factor of backscatter of spherically oriented leaves, per reflectance.
SPHERICAL = 2.0 / 3.0


def true_rh98(stand, canopy, survey, ground: float) -> np.ndarray:
    """Return the heights above the ground below which 98 % of the energy returns."""
    voxel_size, origin = (np.asarray(a, float) for a in (stand.voxel_size, stand.origin))
    leaf, bark = (np.asarray(a, float) for a in (stand.leaf, stand.bark))
    wavelength = survey.lidar.wavelength
    green, brown = float(canopy.leaf(wavelength)[0][0]), float(canopy.bark(wavelength)[0])
    depth = (leaf + bark) * voxel_size[2]
    above = np.cumsum(depth[:, :, ::-1], axis=2)[:, :, ::-1] - depth
    albedo = (green * leaf + brown * bark) / np.maximum(leaf + bark, 1e-30)
    returned = 0.5 * SPHERICAL * albedo * np.exp(-2.0 * above) * -np.expm1(-2.0 * depth)
    ground_return = ground * np.exp(-2.0 * depth.sum(axis=2))
    faces = origin[2] + voxel_size[2] * np.arange(leaf.shape[2] + 1)
    x, y = (origin[k] + voxel_size[k] * (np.arange(leaf.shape[k]) + 0.5) for k in (0, 1))
    heights = []
    for (east, north), radius in zip(survey.position, survey.footprint_radius):
        r2 = (x[:, None] - east) ** 2 + (y[None, :] - north) ** 2
        light = np.exp(-2.0 * r2 / radius**2)
        energy = np.concatenate([[np.sum(light * ground_return)], np.einsum("xy,xyz->z", light, returned)])
        heights.append(np.interp(0.98, np.cumsum(energy) / energy.sum(), faces))
    return np.array(heights)


def duration(record: dict) -> str:
    """Return what the front page says of the time that its survey takes."""
    return f"It takes {record['seconds']:.0f} s on {record['cores']} cores:"


def draw(names: dict, seconds: float):
    """Draw the figure: the stand from above, and three maps."""
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
    for ax, (values, label, colours, limit) in zip(axes[1:], panels):
        grid_values = np.asarray(values)[order].reshape(-1, side)
        limits = {} if limit is None else {"vmin": -limit, "vmax": limit}
        image = ax.imshow(
            grid_values, origin="lower", extent=(west, east, south, north), cmap=colours, **limits
        )
        figure.colorbar(image, ax=ax, label=label, location="bottom", aspect=30)
        if limit is not None:
            ax.set_title(f"median {np.median(grid_values):+.2f} m, spread {np.std(grid_values):.2f} m")
    axes[1].set_title(f"{len(survey)} footprints in {seconds:.0f} s")
    for ax in axes:
        ax.set(xlim=(west, east), ylim=(south, north), xlabel="x, east (m)")
    return figure


def main() -> None:
    """Run the survey of the front page as it is printed; write its time and its picture."""
    page = PAGE.read_text()
    code = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)[3]
    names: dict = {}
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        exec(code, names)
    record = {"seconds": round(time.perf_counter() - start, 1), "cores": os.cpu_count()}
    with atomic_write(FOLDER / "hectare.json") as draft:
        draft.write_text(json.dumps(record) + "\n")
    with atomic_write(PAGE) as draft:
        draft.write_text(re.sub(r"It takes \d+ s on \d+ cores:", duration(record), page))
    with atomic_write(FOLDER / "hectare.png") as draft:
        draw(names, record["seconds"]).savefig(draft, dpi=80, format="png")


if __name__ == "__main__":
    main()
