"""Shots of a scanner at first order: cost of a shot, of a million with returns and files, and of the march.

The forest and the terrain of `surveys.py`, 120 m wide, at voxels of 1 m; shots 0.3 m wide from 1 km above.

A kernel in numba marches rays through the same voxels to the terrain, integrates them over the same fine bins
and adds the ground, on every core. It has as many rays for every shot as jaxlidar begins with; which shots
need more, what errors are, the pulse, samples, components and the energy budget it leaves out. What jaxlidar
takes beyond it is the cost of those.

The million is simulated line by line, as a scanner flies, so that memory holds one line of shots.
"""

import math
import tempfile
import time
import warnings
from functools import partial
from pathlib import Path

import jax
import numpy as np
from _common import first_and_warm, new_figure, number, page_of, peak_gigabytes, percent, table
from surveys import forest, scan

import jaxlidar as jl
from jaxlidar.planning.plan import MIN_BATCHES
from jaxlidar.survey.per_shot import LEAST_PARTS_TIMES_RTOL, RAYS_OF_PART

TITLE = "Cost of narrow shots"
QUICK = {"shots": 100, "million": 200, "line": 100, "finest": 1.0}
SIDE, ROUNDS = 120, 5
TOLERANCES = (0.05, 0.02)
# Edges of voxels, m.
EDGES = (1.0, 0.5, 0.25)
# Parts of a flight that are timed.
STAGES = ("simulate", "returns", "files")


def kernel(survey: jl.Survey, scene: jl.Scene, plan: jl.Plan):
    """Return a function of the number of rays that runs the kernel for all shots."""
    from _kernels import f4, march_shots

    zenith, azimuth = np.deg2rad(np.asarray(survey.zenith)), np.deg2rad(np.asarray(survey.azimuth))
    level = np.sin(zenith)
    directions = np.stack([level * np.sin(azimuth), level * np.cos(azimuth), -np.cos(zenith)], axis=1)
    expected = np.asarray(survey[1].direction)
    assert np.allclose(directions[1], expected, atol=1e-4), (directions[1], expected)
    voxels, terrain = scene.canopy.voxels, scene.ground
    arrays = [np.ascontiguousarray(a, f4) for a in (voxels.leaf, voxels.origin, terrain.heights)]
    corner, bins = np.asarray(terrain.origin, f4), plan.bins
    radius, positions = float(survey.footprint_radius[0]), np.asarray(survey.position, f4)

    def run(rays: int):
        ray = np.arange(rays) + 0.5
        distance, turn = radius * np.sqrt(-0.5 * np.log1p(-ray / rays)), 2.4 * ray
        across = np.stack([distance * np.cos(turn), distance * np.sin(turn)], axis=1).astype(f4)
        times = f4(bins.start), f4(bins.width), bins.count
        return march_shots(positions, directions.astype(f4), across, *arrays, corner, *times)

    return run


def simulate(survey: jl.Survey, scene: jl.Scene, rtol: float, seed: int = 1, **settings) -> jl.Waveforms:
    return jl.simulate_many(survey, scene, key=jax.random.key(seed), rtol=rtol, max_orders=1, **settings)


def by_tolerance(scene: jl.Scene, shots: int) -> list[dict]:
    """Return the cost of a shot, and that of the kernel with as many rays as the first round has."""
    survey, rows = scan(SIDE, shots), []
    for rtol in TOLERANCES:
        # Those of a shot in the first round.
        rays = RAYS_OF_PART * MIN_BATCHES * math.ceil(LEAST_PARTS_TIMES_RTOL / rtol)
        run = kernel(survey, scene, jl.plan(survey, scene, rtol=rtol, max_orders=1, describe=False))
        waves = simulate(survey, scene, rtol)
        # The kernel does the same work: it returns the same energy, in the mean over shots.
        kernel_ground = run(rays)[:, 1].sum() * float(np.asarray(scene.ground.reflectance).mean())
        simulated_ground = np.asarray(waves.components["ground"]).sum()
        assert abs(kernel_ground / simulated_ground - 1.0) < 0.02, (kernel_ground, simulated_ground)
        _, ours = first_and_warm(partial(simulate, survey, scene, rtol), ROUNDS)
        _, by_hand = first_and_warm(partial(run, rays), ROUNDS)
        rows.append(
            {
                "shots": len(survey),
                "tolerance": rtol,
                "first rays": rays,
                "us per shot, simulate_many": 1e6 * ours / len(survey),
                "us per shot, numba": 1e6 * by_hand / len(survey),
                "us per ray, numba": 1e6 * by_hand / (len(survey) * rays),
                "error, median": float(np.median(waves.error)),
                "error, largest": float(waves.error.max()),
            }
        )
    return rows


def by_voxel(scene: jl.Scene, shots: int, finest: float) -> list[dict]:
    """Return the cost of a shot over voxels of several sizes; leaf area is spread at random within 1 m."""
    survey, rows, voxels = scan(SIDE, shots), [], scene.canopy.voxels
    for edge in (e for e in EDGES if e >= finest):
        leaf = np.asarray(voxels.leaf)
        for axis in range(3):
            leaf = np.repeat(leaf, round(1.0 / edge), axis=axis)
        if edge < 1.0:
            leaf = leaf * np.random.default_rng(0).uniform(0.0, 2.0, leaf.shape)
        fine = jl.VoxelMap.from_extinction(leaf=leaf, voxel_size=edge, origin=voxels.origin)
        canopy = jl.Canopy(fine, leaf=jl.Prospect(), hotspot=False)
        fine_scene, rtol = jl.Scene(canopy=canopy, ground=scene.ground), max(TOLERANCES)
        _, elapsed = first_and_warm(partial(simulate, survey, fine_scene, rtol), ROUNDS)
        rows.append(
            {
                "voxel": edge,
                "tolerance": rtol,
                "us per shot": 1e6 * elapsed / len(survey),
                "error, median": float(np.median(simulate(survey, fine_scene, rtol).error)),
            }
        )
    return rows


def flight(scene: jl.Scene, shots: int, shots_of_line: int, rtol: float) -> dict:
    """Return the cost of many shots in lines, with returns written to one LAZ file line by line."""
    line = scan(SIDE, shots_of_line)
    keep = ("recorded", "stderr", "energy", "components")
    simulate(line, scene, rtol, keep=keep).returns("peak")
    n_lines = max(round(shots / shots_of_line), 1)
    times, n_points = dict.fromkeys(STAGES, 0.0), 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.laz"
        with jl.io.LasWriter(path) as file:
            for number_of_line in range(n_lines):
                clock = [time.perf_counter()]
                waves = simulate(line, scene, rtol, seed=number_of_line, keep=keep)
                clock.append(time.perf_counter())
                returns = waves.returns("peak")
                clock.append(time.perf_counter())
                returns.to_las(file)
                clock.append(time.perf_counter())
                for stage, elapsed in zip(STAGES, np.diff(clock)):
                    times[stage] += float(elapsed)
                n_points += len(returns.range)
        n_bytes = path.stat().st_size
    n_shots = n_lines * len(line)
    return {
        "shots": n_shots,
        "tolerance": rtol,
        "points": n_points,
        "bytes per point": n_bytes / n_points,
        "seconds": sum(times.values()),
        **{f"us per shot, {stage}": 1e6 * s / n_shots for stage, s in times.items()},
        "peak GB": peak_gigabytes(),
    }


def measure(shots: int = 5000, million: int = 1_000_000, line: int = 20_000, finest: float = 0.25) -> dict:
    """Return the cost of `shots` by tolerance and by voxel, down to `finest` m, and of a million in lines."""
    warnings.simplefilter("ignore", jl.OffMapWarning)
    scene = forest(SIDE)
    return {
        "side": SIDE,
        "by tolerance": by_tolerance(scene, shots),
        # Before the finest voxels, whose memory would be its own.
        "flight": flight(scene, million, line, 0.05),
        "by voxel": by_voxel(scene, shots, finest),
    }


def draw(record: dict):
    """Draw stacked bars of the time of a shot."""
    figure, axes = new_figure(size=(7, 2.6))
    bars = {}
    for r in record["by tolerance"]:
        march = r["us per shot, numba"]
        parts = {"march of the first rays (numba)": march}
        parts["all else"] = r["us per shot, simulate_many"] - march
        bars[f"{r['shots']:,} shots to {r['tolerance']:.0%}"] = parts
    million = record["flight"]
    label = f"{million['shots']:,} shots to {million['tolerance']:.0%}, to LAZ"
    bars[label] = {stage: million[f"us per shot, {stage}"] for stage in STAGES}
    left = np.zeros(len(bars))
    for part in dict.fromkeys(part for parts in bars.values() for part in parts):
        length = np.array([parts.get(part, 0.0) for parts in bars.values()])
        axes.barh(list(bars), length, left=left, label=part)
        left += length
    axes.set(xlabel="µs per shot", xlim=(0.0, 1.05 * float(left.max())))
    axes.invert_yaxis()
    figure.legend(loc="outside upper center", ncols=5, fontsize="small", frameon=False)
    return figure


def section(record: dict) -> str:
    flight, voxels = record["flight"], record["by voxel"]
    columns = {
        "shots": "shots",
        "tolerance": lambda r: percent(r["tolerance"]),
        "error, median": lambda r: percent(r["error, median"]),
        "µs a shot": "us per shot, simulate_many",
        "numba: rays a shot": "first rays",
        "numba: µs a shot": "us per shot, numba",
        "µs a ray": "us per ray, numba",
    }
    costs = {stage: flight[f"us per shot, {stage}"] for stage in STAGES}
    return page_of(
        "Shots of a scanner 0.3 m wide, at first order, over the forest of the surveys above. A numba kernel "
        "marches as many rays for every shot as jaxlidar begins with, and deposits them in the same bins. It "
        "leaves out more rays where they are needed, errors, the pulse, samples and the energy budget.",
        table(record["by tolerance"], columns),
        f"Over voxels of {', '.join(number(r['voxel']) for r in voxels)} m a shot takes "
        f"{', '.join(number(r['us per shot']) for r in voxels)} µs to "
        f"{percent(voxels[0]['tolerance'])}: a beam crosses more of them.",
        f"{flight['shots']:,} shots, line by line, to {percent(flight['tolerance'])}, with returns of "
        f"the peak detector written as one LAZ file: {number(flight['seconds'])} s, "
        f"{number(sum(costs.values()))} µs a shot "
        f"({', '.join(f'{stage} {number(cost)}' for stage, cost in costs.items())}), "
        f"{flight['points']:,} points of {number(flight['bytes per point'])} bytes, at most "
        f"{number(flight['peak GB'])} GB.",
    )
