"""Leaves that are hit or missed beside voxels: shots without a return, and what both cost.

The scanner stands 1.5 m above the ground below ellipsoidal crowns in voxels of 0.5 m. The share of shots
without a return is the gap probability of the crowns if leaves are hit or missed. Trees of the hectare share
the leaves of four individuals.
"""

import dataclasses
import itertools
import time
import warnings

import jax
import numpy as np
from _common import new_figure, number, page_of, peak_gigabytes, percent, table

import jaxlidar as jl

TITLE = "Leaves that are hit or missed"
QUICK = {"shots": 20}
RINGS = ((0.0, 30.0), (50.0, 65.0), (80.0, 90.0))
SENSOR = np.array([20.0, 20.0, 1.5])
LEAF, LEAF_AREA, RTOL = jl.LeafOptics(0.4, 0.35), 0.005, 0.3
# A return this bright is not of the edge of a leaf alone.
BRIGHT = 0.05
FOREST = {"individuals": 4, "seed": 1}
KEY = jax.random.key(0)


def crowns() -> jl.VoxelMap:
    """Return ellipsoids of leaves from about 2 m to 6 to 11 m over 40 m by 40 m."""
    random = np.random.default_rng(1)
    place = 0.5 * np.moveaxis(np.indices((80, 80, 24)), 0, -1) + 0.25
    density = np.zeros((80, 80, 24))
    for x, y in itertools.product(np.arange(2.5, 40.0, 5.0), repeat=2):
        stands, dx, dy, radius, top, bottom = random.uniform(
            [0, -1, -1, 1.2, 6.0, 1.8], [1, 1, 1, 2.2, 11, 3]
        )
        if stands < 0.7:
            centre = np.array([x + dx, y + dy, 0.5 * (top + bottom)])
            axes = [radius, radius, 0.5 * (top - bottom)]
            density[(((place - centre) / axes) ** 2).sum(axis=-1) < 1.0] = 0.7
    return jl.VoxelMap.from_lad(density, voxel_size=0.5)


def scan(shots: int) -> jl.Survey:
    """Return shots of the scanner in each ring, even by solid angle."""
    random = np.random.default_rng(0)
    up = [random.uniform(*np.cos(np.deg2rad(ring[::-1])), shots) for ring in RINGS]
    zenith, azimuth = 180.0 - np.rad2deg(np.arccos(np.concatenate(up))), random.uniform(0.0, 360.0, 3 * shots)
    sensor = np.tile(SENSOR, (3 * shots, 1))
    return jl.Survey(jl.instrument("RIEGL VZ-400"), sensor=sensor, zenith=zenith, azimuth=azimuth)


def by_ring(values: np.ndarray) -> list[float]:
    """Return the mean of values of shots over each ring."""
    return values.reshape(len(RINGS), -1).mean(axis=1).tolist()


def true_gaps(voxels: jl.VoxelMap, survey: jl.Survey) -> list[float]:
    """Return the gap probability of the axes of shots, by steps of 2 cm."""
    depth = np.zeros(len(survey))
    for distance in np.arange(0.01, 40.0, 0.02):
        index = np.floor((SENSOR + distance * survey.direction) / 0.5).astype(int)
        inside = np.all((index >= 0) & (index < voxels.shape), axis=1)
        depth[inside] += 0.02 * np.asarray(voxels.leaf, float)[tuple(index[inside].T)]
    return by_ring(np.exp(-depth))


def simulate(survey: jl.Survey, scene: jl.Scene, rtol: float = RTOL) -> tuple[jl.Waveforms, float]:
    """Return the waveforms and the microseconds of CPU of a shot, without compilation."""
    settings = {"key": KEY, "rtol": rtol, "max_orders": 1}
    jl.simulate_many(survey, scene, **settings)
    start = time.process_time()
    waves = jl.simulate_many(survey, scene, **settings)
    return waves, 1e6 * (time.process_time() - start) / len(survey)


def without_return(waves: jl.Waveforms, least: float = 0.0) -> list[float]:
    """Return the share of shots that have no return of at least this apparent reflectance."""
    returns, is_hit = waves.returns(), np.zeros(len(waves), bool)
    is_hit[returns.shot[returns.reflectance >= least]] = True
    return by_ring(~is_hit)


def gaps(shots: int) -> tuple[list[dict], list[dict]]:
    """Return the shares by row of the table, and the cost of shots over voxels and over leaves."""
    voxels, survey = crowns(), scan(shots)
    leaves = jl.leaf_mesh(voxels, LEAF_AREA, key=jax.random.key(1), leaf=LEAF)
    over_voxels, voxel_cost = simulate(survey, jl.Scene(canopy=jl.Canopy(voxels, leaf=LEAF)))
    over_leaves, leaf_cost = simulate(survey, jl.Scene(meshes=[leaves]))
    energy = np.asarray(over_voxels.reflectance).sum(axis=(1, 2)) / (2.0 / 3.0 * 0.4)
    rows = {
        "gap probability of the axes": true_gaps(voxels, survey),
        "voxels: no return": without_return(over_voxels),
        "voxels: 1 - energy / (2/3 of leaf reflectance)": by_ring(1.0 - energy),
        "leaves: no return": without_return(over_leaves),
        f"leaves: no return brighter than {BRIGHT:g}": without_return(over_leaves, BRIGHT),
    }
    leaf_count = leaves.n_triangles // 2
    costs = [
        {"what": "below crowns, voxels", "leaves": 0, "rtol": RTOL, "us per shot": voxel_cost},
        {"what": "below crowns, leaves", "leaves": leaf_count, "rtol": RTOL, "us per shot": leaf_cost},
    ]
    return [{"what": name, "shares": shares} for name, shares in rows.items()], costs


def hectare(shots: int) -> tuple[list[dict], float]:
    """Return the cost of footprints of 25 cm over a hectare, and the peak memory with its leaves, GB."""
    diameters = np.linspace(14.0, 22.0, 50)
    stand = jl.stand_of_leaf_area(
        4.0, diameters, jl.broadleaf(), density=400.0, area=(100.0, 100.0), **FOREST
    )
    meshes = jl.leaf_mesh(stand, 0.008, key=KEY, leaf=LEAF)
    count = sum(len(mesh.instances) * mesh.n_triangles // 2 for mesh in meshes)
    ground = jl.Ground(reflectance=0.3)
    lidar = jl.Lidar(altitude=500.0, divergence=0.5, pulse=jl.GaussianPulse(fwhm=4.0))
    survey = jl.Survey(lidar, np.random.default_rng(0).uniform(10.0, 90.0, (shots, 2)))
    rows = []
    for rtol in (RTOL, 0.1):
        cost = simulate(survey, jl.Scene(meshes=meshes, ground=ground), rtol)[1]
        rows.append({"what": "hectare, leaves", "leaves": count, "rtol": rtol, "us per shot": cost})
    peak = peak_gigabytes()
    voxels = dataclasses.replace(jl.voxelise(stand, 1.0), bark=None)
    scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=LEAF), ground=ground)
    rows.append(
        {"what": "hectare, voxels", "leaves": 0, "rtol": RTOL, "us per shot": simulate(survey, scene)[1]}
    )
    return rows, peak


def measure(shots: int = 1000) -> dict:
    """Return the shares of `shots` in each ring without a return, and costs of shots."""
    with warnings.catch_warnings():
        # What it says of voxels is what this shows.
        warnings.filterwarnings("ignore", "(?s).*see crowns alone.*")
        warnings.simplefilter("ignore", jl.OffMapWarning)
        # First, as the peak of memory is that of the process.
        hectare_costs, peak = hectare(shots // 2)
        rows, costs = gaps(shots)
    return {"shots": shots, "rings": RINGS, "rows": rows, "peak GB": peak, "costs": costs + hectare_costs}


def draw(record: dict):
    """Draw the shares of shots without a return beside the gap probability."""
    figure, axes = new_figure()
    true, *others = record["rows"]
    for row, marker in zip(others, "osD^"):
        axes.plot(true["shares"], row["shares"], marker, label=row["what"])
    axes.plot([0, 1], [0, 1], color="0.6", lw=0.8, zorder=0)
    axes.set(xlabel="gap probability of the axes", ylabel="share of shots", xlim=(0.4, 1.0), ylim=(0.1, 1.0))
    axes.legend(fontsize="small", frameon=False)
    return figure


def section(record: dict) -> str:
    shares = {
        f"{low:g} to {high:g} degrees": lambda r, n=n: f"{r['shares'][n]:.3f}"
        for n, (low, high) in enumerate(record["rings"])
    }
    costs = {
        "scene": "what",
        "leaves": "leaves",
        "tolerance": lambda r: percent(r["rtol"]),
        "µs a shot": "us per shot",
    }
    return page_of(
        f"Shots of a VZ-400 that stands below crowns, {record['shots']:,} in each ring of zenith angles. A "
        "voxel returns what is expected of its leaves, so that nearly every shot has a return from every "
        "crown that it crosses; leaves of 50 cm2 are hit or missed. A beam has a width, and the edge of a "
        "leaf returns a little of it.",
        table(record["rows"], {"share of shots": "what", **shares}),
        "CPU time of a shot. The hectare is a stand of 400 trees of leaf area index 4, seen from 500 m above "
        "with footprints of 25 cm; with its leaves the process takes at most "
        f"{number(record['peak GB'])} GB.",
        table(record["costs"], costs),
    )
