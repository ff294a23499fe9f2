"""Cost of thousands of footprints: with shared illumination, shot by shot, and by one call for each.

A forest on rolling terrain, at voxels of 1 m: footprints of 25 m as GEDI has them, with all orders, to 1 %;
and shots of a scanner, 0.3 m wide, at first order, to 2 %.
"""

import time
import warnings

import jax
import numpy as np
from _common import label_log_axis, new_figure, number, page_of, peak_gigabytes, percent, table

import jaxlidar as jl

TITLE = "Cost of thousands of footprints"
QUICK = {"side": 40, "shots": 16, "scans": 20, "largest": 50}
# Width of terrain around the trees, m.
MARGIN = 45
STEMS_PER_HECTARE = 280
TALLEST = 20
# Relative tolerance of the curves, and of shots with a field of view or off nadir.
ROUGH_TOLERANCE, VIEWED_TOLERANCE = 0.05, 0.03
# Full angle of the receiver that sees footprints of 25 m from 400 km, mrad.
FIELD_OF_VIEW = 0.0625


def rolling_terrain(side: int) -> jl.Terrain:
    """Return terrain of hills 10 m high, around a square whose corner is at the origin."""
    x = np.arange(side + 2.0 * MARGIN + 1) - MARGIN
    heights = 3.0 * np.sin(x / 17.0)[:, None] + 2.0 * np.cos(x / 11.0)[None, :]
    return jl.Terrain(heights, 1.0, (-MARGIN, -MARGIN), reflectance=0.25)


def forest(side: int) -> jl.Scene:
    """Return crowns of 3 to 7 m, 9 to 18 m tall, at random positions over rolling terrain."""
    random, density = np.random.default_rng(1), np.zeros((side, side, TALLEST))
    z = np.arange(TALLEST) + 0.5
    for _ in range(round(STEMS_PER_HECTARE * side**2 / 1e4)):
        (x, y), top, radius = random.uniform(0, side, 2), random.uniform(9, 18), random.uniform(1.5, 3.5)
        i, j = (np.arange(max(int(c - 4), 0), min(int(c + 5), side)) for c in (x, y))
        in_radius = (i[:, None] + 0.5 - x) ** 2 + (j[None, :] + 0.5 - y) ** 2 < radius**2
        crown = in_radius[..., None] & (z > 0.35 * top) & (z < top)
        block = density[np.ix_(i, j)]
        density[np.ix_(i, j)] = np.where(crown, 0.8, block)
    terrain = rolling_terrain(side)
    voxels = jl.VoxelMap.from_lad(density, voxel_size=1.0).above(terrain)
    return jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.Prospect(), hotspot=False), ground=terrain)


def gedi_like_lidar(**changes) -> jl.Lidar:
    """Return a spaceborne lidar with footprints of 25 m."""
    pulse = jl.GaussianPulse(fwhm=15.6)
    return jl.Lidar(altitude=4e5, divergence=0.0625, wavelength=1064.0, pulse=pulse, **changes)


def grid(side: int, shots: int, zenith: float = 0.0, **changes) -> jl.Survey:
    """Return a grid of about `shots` footprints over the square without its edge."""
    low, high, count = 11.0, side - 11.0, max(round(np.sqrt(shots)), 1)
    x = np.linspace(low, high, count) if count > 1 else np.array([0.5 * side])
    return jl.Survey(gedi_like_lidar(**changes), np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2), zenith)


def every_nth_shot(survey: jl.Survey, shots: int = 8) -> jl.Survey:
    """Return a survey of about `shots` shots, evenly taken from one."""
    chosen = slice(None, None, max(len(survey) // shots, 1))
    return jl.Survey(survey.lidar, survey.position[chosen], survey.zenith[chosen], survey.azimuth[chosen])


def scan(side: int, shots: int) -> jl.Survey:
    """Return about `shots` shots of an oscillating mirror, 1 km above the square."""
    lidar = jl.Lidar(altitude=1000.0, divergence=0.3, pulse=jl.GaussianPulse(fwhm=4.0))
    middle, length = 0.5 * side, side - 20.0
    line = {"start": (middle, 10.0), "end": (middle, 10.0 + length), "speed": 50.0}
    swing = np.rad2deg(np.arctan((middle - 10.0) / 1000.0))
    mirror = jl.Oscillating(half_angle=float(swing), frequency=40.0)
    return jl.Survey.scan(lidar, mirror, **line, pulse_rate=(shots - 1) * 50.0 / length)


def timed(survey: jl.Survey, scene: jl.Scene, seed: int = 0, **settings) -> dict[str, object]:
    """Return the seconds of a survey and the errors that it reached."""
    start = time.perf_counter()
    waveforms = jl.simulate_many(survey, scene, key=jax.random.key(seed), **settings)
    elapsed = time.perf_counter() - start
    return {
        "shots": len(survey),
        "tolerance": settings["rtol"],
        "seconds": elapsed,
        "ms per shot": 1e3 * elapsed / len(survey),
        "error, median": float(np.median(waveforms.error)),
        "error, largest": float(waveforms.error.max()),
        "shared": bool(waveforms.info["shared"]),
    }


def warm(survey: jl.Survey, scene: jl.Scene, **settings) -> dict[str, object]:
    """Return the record of the second of two surveys; `"first"` is the time of the first, which compiles."""
    first = timed(survey, scene, **settings)
    second = timed(survey, scene, seed=1, **settings)
    return {**second, "first": first["seconds"]}


def one_by_one(survey: jl.Survey, scene: jl.Scene, shots: int, **settings) -> dict[str, object]:
    """Return the time of one call of `simulate` for each of some shots, by one plan, compiled before."""
    plan = jl.plan(survey, scene, describe=False, **settings)
    lidars = [survey[int(i)] for i in np.linspace(0, len(survey) - 1, shots + 1)]
    jl.simulate(lidars[0], scene, key=jax.random.key(0), plan=plan)
    start, errors = time.perf_counter(), []
    for n, lidar in enumerate(lidars[1:]):
        errors.append(jl.simulate(lidar, scene, key=jax.random.key(n), plan=plan).info["error"])
    elapsed = time.perf_counter() - start
    error = float(np.median(errors))
    return {
        "shots": shots,
        "tolerance": settings["rtol"],
        "ms per shot": 1e3 * elapsed / shots,
        "error, median": error,
    }


def measure(side: int = 120, shots: int = 2500, scans: int = 5000, largest: int = 400) -> dict:
    """Return the costs of all strategies over a forest `side` m wide, and by the shots and the area.

    `shots`: footprints; fields of view and angles off nadir have a quarter. - `scans`: shots of the scanner.
    - `largest`: width of the largest area, m.
    """
    warnings.simplefilter("ignore", jl.LateLightWarning)
    warnings.simplefilter("ignore", jl.OffMapWarning)
    scene, footprints, scanner = forest(side), grid(side, shots), scan(side, scans)
    narrow_view = grid(side, shots // 4, field_of_view=FIELD_OF_VIEW)
    oblique = grid(side, shots // 4, zenith=5.0)
    precise, viewed, scanned = {"rtol": 0.01}, {"rtol": VIEWED_TOLERANCE}, {"rtol": 0.02, "max_orders": 1}
    strategies = {
        "footprints, shared": warm(footprints, scene, **precise),
        "footprints, apart": warm(every_nth_shot(footprints), scene, shared=False, **precise),
        "footprints, simulate": one_by_one(footprints, scene, 5, **precise),
        "field of view, shared": warm(narrow_view, scene, **viewed),
        "field of view, apart": warm(every_nth_shot(narrow_view), scene, shared=False, **viewed),
        "5 degrees off nadir, shared": warm(oblique, scene, **viewed),
        "5 degrees off nadir, apart": warm(every_nth_shot(oblique), scene, shared=False, **viewed),
        "scan, apart": warm(scanner, scene, **scanned),
        "scan, simulate": one_by_one(scanner, scene, 50, **scanned),
    }
    peak = peak_gigabytes()
    counts = [n for n in (1, 9, 100, 1024, 10000) if n <= 4 * shots]
    by_shots = [warm(grid(side, n), scene, rtol=ROUGH_TOLERANCE) for n in counts]
    by_side = []
    for other_side in (n for n in (50, 100, 200, 400) if n <= largest):
        other_scene, per_area = forest(other_side), round(shots * (other_side / side) ** 2)
        row = warm(grid(other_side, per_area), other_scene, rtol=ROUGH_TOLERANCE)
        by_side.append({"side": other_side, **row})
    return {
        "side": side,
        "peak GB": peak,
        "strategies": strategies,
        "rough": ROUGH_TOLERANCE,
        "by shots": by_shots,
        "by side": by_side,
    }


def draw(record: dict):
    """Draw the seconds by the number of footprints and by the area."""
    figure, axes = new_figure(2, size=(9, 4))
    side, rough = f"{record['side']} m", f"to {record['rough']:.0%}"
    by_shots, by_side = record["by shots"], record["by side"]
    axes[0].loglog([r["shots"] for r in by_shots], [r["seconds"] for r in by_shots], "o-")
    axes[0].set(xlabel="footprints", ylabel="s, compiled", title=f"{side} x {side}, {rough}")
    axes[1].loglog([r["side"] ** 2 / 1e4 for r in by_side], [r["seconds"] for r in by_side], "o-")
    axes[1].set(xlabel="ha", ylabel="s, compiled", title=f"as many footprints per hectare, {rough}")
    for panel in axes:
        label_log_axis(panel.yaxis, 1, 2, 5)
    return figure


def section(record: dict) -> str:
    def times_longer(slow: str, fast: str) -> str:
        return number(strategies[slow]["ms per shot"] / strategies[fast]["ms per shot"])

    strategies, side, rough = record["strategies"], record["side"], percent(record["rough"])
    largest = record["by side"][-1]
    hectares = largest["side"] ** 2 / 1e4
    hours = 100 * largest["seconds"] / hectares * record["machine"]["cores"] / 3600
    columns = {
        "strategy": "strategy",
        "shots": "shots",
        "tolerance": lambda r: percent(r["tolerance"]),
        "ms a shot": "ms per shot",
        "error, median": lambda r: percent(r["error, median"]),
    }
    return page_of(
        f"Trees of {side} m x {side} m at voxels of 1 m over rolling terrain. Footprints of 25 m from "
        "orbit, all orders, by three strategies: shared illumination (`shared`); shot by shot in one "
        "program (`apart`); one call of `simulate` for each. The same with a field of view as wide as the "
        "footprints, and off nadir. Shots of a scanner, 0.3 m wide, at first order. The tolerance is that "
        "of every single shot.",
        table([{"strategy": name, **r} for name, r in strategies.items()], columns),
        f"Shared illumination is {times_longer('footprints, simulate', 'footprints, shared')} times faster "
        "than single calls, one program for a scan "
        f"{times_longer('scan, simulate', 'scan, apart')} times. One process with all of these took at most "
        f"{number(record['peak GB'])} GB.",
        f"The number of footprints over the same trees, to {rough}, hardly changes the cost:",
        table(record["by shots"], {"footprints": "shots", "s": "seconds", "ms each": "ms per shot"}),
        f"Larger areas with the same number of footprints per hectare, to {rough}:",
        table(
            record["by side"],
            {"ha": lambda r: r["side"] ** 2 / 1e4, "footprints": "shots", "s": "seconds"},
        ),
        f"Extrapolated, as tiles are independent: a square kilometre to {rough} takes {number(hours)} core "
        f"hours, and a country of 100,000 km2 {number(hours * 1e5 / 24 / 1e4)} days of 10,000 cores. "
        "Waveforms are written as they are computed; of a map, with 4 bytes a voxel, only the tiles in "
        "work (`SceneParts`) need to fit into memory.",
    )
