"""Shots of a scanner at first order: cost of a shot, of a million with returns and files, and of the march.

Run it as `python examples/benchmarks/narrow_shots.py [--out figures] [--million 1000000]`. The forest and the
terrain of `surveys.py`, 120 m wide, at voxels of 1 m; shots 0.3 m wide from 1 km above.

A kernel in numba marches rays through the same voxels to the terrain, integrates them over the same fine bins
and adds the ground, on every core. It has as many rays for every shot as jaxlidar begins with; which shots
need more, what errors are, the pulse, samples, components and the energy budget it leaves out. What jaxlidar
takes beyond it is the cost of those.

The million is simulated line by line, as a scanner flies, so that memory holds one line of shots.
"""

import math
import resource
import tempfile
import time
import warnings
from pathlib import Path

import jax
import numba
import numpy as np
from _common import machine, new_figure, options, print_table, save_figure, write_json
from surveys import forest, scan

import jaxlidar as jl
from jaxlidar import SPEED_OF_LIGHT
from jaxlidar.planning.plan import MIN_BATCHES
from jaxlidar.survey.per_shot import LEAST_PARTS_TIMES_RTOL, RAYS_OF_PART

SIDE, SHOTS, SHOTS_OF_LINE, ROUNDS = 120, 5000, 20_000, 5
TOLERANCES = (0.05, 0.02)
# Edges of voxels, m.
EDGES = (1.0, 0.5, 0.25)
f4 = np.float32
LIGHT = f4(SPEED_OF_LIGHT)


@numba.njit(fastmath=True)
def height_at(heights, corner, x, y):
    """Return the height of the terrain, bilinear between nodes 1 m apart."""
    u, v = x - corner[0], y - corner[1]
    i, j = min(max(int(u), 0), heights.shape[0] - 2), min(max(int(v), 0), heights.shape[1] - 2)
    u, v = u - f4(i), v - f4(j)
    low = heights[i, j] * (f4(1) - u) + heights[i + 1, j] * u
    high = heights[i, j + 1] * (f4(1) - u) + heights[i + 1, j + 1] * u
    return low * (f4(1) - v) + high * v


@numba.njit(parallel=True, fastmath=True)
def march(aims, directions, across, k, origin, heights, corner, first_bin, width, count):
    """Return the first-order response (shots, 2, bins) per unit reflectance of leaf and ground.

    Voxels are 1 m wide. The rays of a shot are parallel, at the points `across` its beam.
    """
    shots, rays = len(aims), len(across)
    nx, ny, nz = k.shape
    metres, energy = f4(0.5) * LIGHT * width, f4(1.0 / rays)
    response = np.zeros((shots, 2, count), f4)
    for s in numba.prange(shots):
        wx, wy, wz = directions[s]
        for r in range(rays):
            ax, ay = aims[s, 0] + across[r, 0], aims[s, 1] + across[r, 1]
            # Distances count from the plane of height zero. Slopes are gentle and beams steep: a few rounds.
            end = f4(0)
            for _ in range(4):
                end = height_at(heights, corner, ax + wx * end, ay + wy * end) / wz
            distance = (origin[2] + f4(nz)) / wz
            x, y = ax + wx * distance - origin[0], ay + wy * distance - origin[1]
            vx, vy, vz = math.floor(x), math.floor(y), nz - 1
            sx, sy = (1 if wx > 0 else -1), (1 if wy > 0 else -1)
            gx = f4(1) / max(abs(wx), f4(1e-9))
            gy, gz = f4(1) / max(abs(wy), f4(1e-9)), f4(1) / abs(wz)
            tx = distance + gx * (f4(vx + 1) - x if sx > 0 else x - f4(vx))
            ty = distance + gy * (f4(vy + 1) - y if sy > 0 else y - f4(vy))
            tz = distance + gz
            clear, depth = energy * f4(1.0 / 3.0), f4(0)
            while distance < end and vz >= 0:
                face = min(tx, min(ty, tz))
                to = min(face, end)
                extinction = k[vx, vy, vz] if 0 <= vx < nx and 0 <= vy < ny else f4(0)
                if extinction > 0:
                    now = (f4(2) * distance / LIGHT - first_bin) / width
                    last = now + (to - distance) / metres
                    centre = math.floor(now + f4(0.5))
                    j = int(centre)
                    rate = -f4(2) * extinction * metres
                    while now < last:
                        edge = min(centre + f4(0.5), last)
                        remaining = clear * math.exp(rate * (edge - now))
                        response[s, 0, min(max(j, 0), count - 1)] += clear - remaining
                        clear = remaining
                        now = edge
                        centre += f4(1)
                        j += 1
                    depth += extinction * (to - distance)
                if to >= face:
                    if tx <= ty and tx <= tz:
                        vx += sx
                        tx += gx
                    elif ty <= tz:
                        vy += sy
                        ty += gy
                    else:
                        vz -= 1
                        tz += gz
                distance = to
            position = (f4(2) * end / LIGHT - first_bin) / width
            centre = math.floor(position + f4(0.5))
            q, j = position - centre, min(max(int(centre), 1), count - 2)
            value = energy * math.exp(-f4(2) * depth) * -wz
            response[s, 1, j - 1] += value * f4(0.5) * (f4(0.5) - q) ** 2
            response[s, 1, j] += value * (f4(0.75) - q * q)
            response[s, 1, j + 1] += value * f4(0.5) * (f4(0.5) + q) ** 2
    return response


def kernel(survey: jl.Survey, scene: jl.Scene, plan: jl.Plan):
    """Return a function of the number of rays that runs the kernel for all shots."""
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
        number = np.arange(rays) + 0.5
        distance, turn = radius * np.sqrt(-0.5 * np.log1p(-number / rays)), 2.4 * number
        across = np.stack([distance * np.cos(turn), distance * np.sin(turn)], axis=1).astype(f4)
        times = f4(bins.start), f4(bins.width), bins.count
        return march(positions, directions.astype(f4), across, *arrays, corner, *times)

    return run


def fastest(function, *arguments) -> float:
    """Return the seconds of the fastest of some calls; the first, which compiles, does not count."""
    function(*arguments)
    times = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        function(*arguments)
        times.append(time.perf_counter() - start)
    return min(times)


def simulate(survey: jl.Survey, scene: jl.Scene, rtol: float, seed: int = 1, **settings) -> jl.Waveforms:
    return jl.simulate_many(survey, scene, key=jax.random.key(seed), rtol=rtol, max_orders=1, **settings)


def by_tolerance(scene: jl.Scene) -> list[dict]:
    """Return the cost of a shot of 5,000, and that of the kernel with as many rays as the first round has."""
    survey, rows = scan(SIDE, SHOTS), []
    for rtol in TOLERANCES:
        # Those of a shot in the first round.
        rays = RAYS_OF_PART * MIN_BATCHES * math.ceil(LEAST_PARTS_TIMES_RTOL / rtol)
        run = kernel(survey, scene, jl.plan(survey, scene, rtol=rtol, max_orders=1, describe=False))
        waves = simulate(survey, scene, rtol)
        # The kernel does the same work: it returns the same energy, in the mean over shots.
        kernel_ground = run(rays)[:, 1].sum() * float(np.asarray(scene.ground.reflectance).mean())
        simulated_ground = np.asarray(waves.components["ground"]).sum()
        assert abs(kernel_ground / simulated_ground - 1.0) < 0.02, (kernel_ground, simulated_ground)
        seconds = {
            "simulate_many": fastest(simulate, survey, scene, rtol),
            "numba": fastest(run, rays),
        }
        rows.append(
            {
                "shots": len(survey),
                "tolerance": rtol,
                "first rays": rays,
                **{f"us per shot, {name}": 1e6 * s / len(survey) for name, s in seconds.items()},
                "us per ray, numba": 1e6 * seconds["numba"] / (len(survey) * rays),
                "error, median": float(np.median(waves.error)),
                "error, largest": float(waves.error.max()),
            }
        )
    return rows


def by_voxel(scene: jl.Scene) -> list[dict]:
    """Return the cost of a shot over voxels of several sizes; leaf area is spread at random within 1 m."""
    survey, rows, voxels = scan(SIDE, SHOTS), [], scene.canopy.voxels
    for edge in EDGES:
        leaf = np.asarray(voxels.leaf)
        for axis in range(3):
            leaf = np.repeat(leaf, round(1.0 / edge), axis=axis)
        if edge < 1.0:
            leaf = leaf * np.random.default_rng(0).uniform(0.0, 2.0, leaf.shape)
        fine = jl.VoxelMap.from_extinction(leaf=leaf, voxel_size=edge, origin=voxels.origin)
        canopy = jl.Canopy(fine, leaf=jl.Prospect(), hotspot=False)
        fine_scene, rtol = jl.Scene(canopy=canopy, ground=scene.ground), max(TOLERANCES)
        seconds, waves = fastest(simulate, survey, fine_scene, rtol), simulate(survey, fine_scene, rtol)
        rows.append(
            {
                "voxel": edge,
                "tolerance": rtol,
                "us per shot": 1e6 * seconds / len(survey),
                "error, median": float(np.median(waves.error)),
            }
        )
    return rows


def flight(scene: jl.Scene, shots: int, rtol: float) -> dict:
    """Return the cost of many shots in lines, with returns written to one LAZ file line by line."""
    n_lines = max(round(shots / SHOTS_OF_LINE), 1)
    line = scan(SIDE, SHOTS_OF_LINE)
    keep = ("recorded", "stderr", "energy", "components")
    simulate(line, scene, rtol, keep=keep).returns("peak")
    stages = dict.fromkeys(("simulate", "returns", "files"), 0.0)
    n_points = 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.laz"
        with jl.io.LasWriter(path) as file:
            for number in range(n_lines):
                times = [time.perf_counter()]
                waves = simulate(line, scene, rtol, seed=number, keep=keep)
                times.append(time.perf_counter())
                returns = waves.returns("peak")
                times.append(time.perf_counter())
                returns.to_las(file)
                times.append(time.perf_counter())
                for name, seconds in zip(stages, np.diff(times)):
                    stages[name] += float(seconds)
                n_points += len(returns.range)
        n_bytes = path.stat().st_size
    n_shots = n_lines * len(line)
    return {
        "shots": n_shots,
        "tolerance": rtol,
        "points": n_points,
        "bytes per point": n_bytes / n_points,
        "seconds": sum(stages.values()),
        **{f"us per shot, {name}": 1e6 * s / n_shots for name, s in stages.items()},
        "peak GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
    }


def draw(record: dict, out: Path) -> None:
    """Draw stacked bars of the time of a shot."""
    figure, axes = new_figure(size=(7, 2.6))
    labels, left = [], np.zeros(len(record["by tolerance"]) + 1)
    rows = [
        {
            "march": r["us per shot, numba"],
            "all else": r["us per shot, simulate_many"] - r["us per shot, numba"],
        }
        for r in record["by tolerance"]
    ]
    labels = [f"{r['shots']:,} shots to {r['tolerance']:.0%}" for r in record["by tolerance"]]
    million = record["flight"]
    rows.append({name: million[f"us per shot, {name}"] for name in ("simulate", "returns", "files")})
    labels.append(f"{million['shots']:,} shots to {million['tolerance']:.0%}, to LAZ")
    for name in ("march", "all else", "simulate", "returns", "files"):
        length = np.array([row.get(name, 0.0) for row in rows])
        label = {"march": "march of the first rays (numba)"}.get(name, name)
        axes.barh(labels, length, left=left, label=label)
        left += length
    axes.set(xlabel="µs per shot", xlim=(0.0, 1.05 * float(left.max())))
    axes.invert_yaxis()
    figure.legend(loc="outside upper center", ncols=5, fontsize="small", frameon=False)
    save_figure(figure, out / "narrow_shots.png")


def main() -> None:
    arguments = options("Cost of narrow shots.", million=1_000_000)
    warnings.simplefilter("ignore", jl.OffMapWarning)
    scene = forest(SIDE)
    record = {
        "by tolerance": by_tolerance(scene),
        # Before the finest voxels, whose memory would be its own.
        "flight": flight(scene, arguments.million, 0.05),
        "by voxel": by_voxel(scene),
    }
    record = {"machine": machine(), "side": SIDE, **record}
    write_json(arguments.out / "narrow_shots.json", record)
    draw(record, arguments.out)
    keys = "tolerance", "us per shot, simulate_many", "us per shot, numba", "error, median"
    print_table(keys, [tuple(r[k] for k in keys) for r in record["by tolerance"]])
    print(record["flight"])


if __name__ == "__main__":
    main()
