"""What thousands of footprints cost: those that share light, those that do not, and one call for each.

Run it as `python examples/benchmarks/campaign.py [--out figures] [--side 120] [--shots 2500]`. A forest on
rolling terrain, at voxels of 1 m: footprints of 25 m as GEDI has them, with all orders, to 1 %; and shots of
a scanner, 0.3 m wide, at first order, to 2 %.
"""

import resource
import time
import warnings
from pathlib import Path

import jax
import numpy as np
from _common import machine, new_figure, options, print_table, save_figure, write_json
from matplotlib.ticker import LogLocator, NullFormatter

import jaxlidar as jl

# Terrain reaches so far beyond the trees, m.
MARGIN = 45
STEMS_PER_HECTARE = 280
TALLEST = 20
# Relative error of the curves, and of shots that see light each in its own way.
ROUGH, VIEWED = 0.05, 0.03
COLUMNS = "shots", "tolerance", "ms per shot", "error, median"
# Full angle of the receiver that sees footprints of 25 m from 400 km, mrad.
FIELD_OF_VIEW = 0.0625


def rolling(side: int) -> jl.Terrain:
    """Terrain of hills 10 m high, around a square whose corner is at the origin."""
    x = np.arange(side + 2.0 * MARGIN + 1) - MARGIN
    heights = 3.0 * np.sin(x / 17.0)[:, None] + 2.0 * np.cos(x / 11.0)[None, :]
    return jl.Terrain(heights, 1.0, (-MARGIN, -MARGIN), reflectance=0.25)


def forest(side: int) -> jl.Scene:
    """Crowns of 3 to 7 m, 9 to 18 m tall, at random places over rolling terrain."""
    random, density = np.random.default_rng(1), np.zeros((side, side, TALLEST))
    z = np.arange(TALLEST) + 0.5
    for _ in range(round(STEMS_PER_HECTARE * side**2 / 1e4)):
        (x, y), top, radius = random.uniform(0, side, 2), random.uniform(9, 18), random.uniform(1.5, 3.5)
        i, j = (np.arange(max(int(c - 4), 0), min(int(c + 5), side)) for c in (x, y))
        round_ = (i[:, None] + 0.5 - x) ** 2 + (j[None, :] + 0.5 - y) ** 2 < radius**2
        crown = round_[..., None] & (z > 0.35 * top) & (z < top)
        part = density[np.ix_(i, j)]
        density[np.ix_(i, j)] = np.where(crown, 0.8, part)
    terrain = rolling(side)
    voxels = jl.VoxelMap.from_lad(density, voxel_size=1.0).above(terrain)
    return jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.Prospect()), ground=terrain)


def gedi(**more) -> jl.Lidar:
    """A spaceborne lidar with footprints of 25 m."""
    pulse = jl.GaussianPulse(fwhm=15.6)
    return jl.Lidar(altitude=4e5, divergence=0.0625, wavelength=1064.0, pulse=pulse, **more)


def grid(side: int, shots: int, zenith: float = 0.0, **more) -> jl.Survey:
    """About so many footprints, evenly over the square but for its edge."""
    low, high, count = 11.0, side - 11.0, max(round(np.sqrt(shots)), 1)
    x = np.linspace(low, high, count) if count > 1 else np.array([0.5 * side])
    return jl.Survey(gedi(**more), np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2), zenith)


def some(survey: jl.Survey, shots: int = 8) -> jl.Survey:
    """So many of the shots, or one more."""
    chosen = slice(None, None, max(len(survey) // shots, 1))
    return jl.Survey(survey.lidar, survey.position[chosen], survey.zenith[chosen], survey.azimuth[chosen])


def scan(side: int, shots: int) -> jl.Survey:
    """About so many shots of an oscillating mirror, 1 km above the square."""
    lidar = jl.Lidar(altitude=1000.0, divergence=0.3, pulse=jl.GaussianPulse(fwhm=4.0))
    middle, length = 0.5 * side, side - 20.0
    line = {"start": (middle, 10.0), "end": (middle, 10.0 + length), "speed": 50.0}
    swing = np.rad2deg(np.arctan((middle - 10.0) / 1000.0))
    mirror = jl.Oscillating(half_angle=float(swing), frequency=40.0)
    return jl.Survey.scan(lidar, mirror, **line, pulse_rate=(shots - 1) * 50.0 / length)


def timed(survey: jl.Survey, scene: jl.Scene, seed: int = 0, **how) -> dict[str, object]:
    """Seconds of a campaign once its program is compiled, and the errors that it reached."""
    start = time.perf_counter()
    many = jl.simulate_many(survey, scene, key=jax.random.key(seed), **how)
    took = time.perf_counter() - start
    return {
        "shots": len(survey),
        "tolerance": how["rtol"],
        "seconds": took,
        "ms per shot": 1e3 * took / len(survey),
        "error, median": float(np.median(many.error)),
        "error, largest": float(many.error.max()),
        "shared": bool(many.info["shared"]),
    }


def warm(survey: jl.Survey, scene: jl.Scene, **how) -> dict[str, object]:
    """The second of two campaigns, with the first as its compilation."""
    first = timed(survey, scene, **how)
    second = timed(survey, scene, seed=1, **how)
    return {**second, "first": first["seconds"]}


def one_by_one(survey: jl.Survey, scene: jl.Scene, shots: int, **how) -> dict[str, object]:
    """A call of `simulate` for each of some shots, the plan made once, compiled."""
    plan = jl.plan(survey, scene, describe=False, **how)
    chosen = [survey[int(i)] for i in np.linspace(0, len(survey) - 1, shots + 1)]
    jl.simulate(chosen[0], scene, key=jax.random.key(0), plan=plan)
    start, errors = time.perf_counter(), []
    for n, lidar in enumerate(chosen[1:]):
        errors.append(jl.simulate(lidar, scene, key=jax.random.key(n), plan=plan).info["error"])
    took = time.perf_counter() - start
    error = float(np.median(errors))
    return {
        "shots": shots,
        "tolerance": how["rtol"],
        "ms per shot": 1e3 * took / shots,
        "error, median": error,
    }


def draw(record: dict, out: Path) -> None:
    """The figure of a record."""
    figure, axes = new_figure(2, size=(9, 4))
    axes[0].loglog([r["shots"] for r in record["by shots"]], [r["seconds"] for r in record["by shots"]], "o-")
    side = f"{record['side']} m"
    axes[0].set(xlabel="footprints", ylabel="s, compiled", title=f"{side} x {side}, to {ROUGH:.0%}")
    area = [r["side"] ** 2 / 1e4 for r in record["by side"]]
    axes[1].loglog(area, [r["seconds"] for r in record["by side"]], "o-")
    axes[1].set(xlabel="ha", ylabel="s, compiled", title=f"as many footprints per hectare, to {ROUGH:.0%}")
    for panel in axes:
        # Less than two powers of ten: numbers in between are named, too.
        panel.yaxis.set(
            major_locator=LogLocator(subs=(1, 2, 5)), major_formatter="{x:g}", minor_formatter=NullFormatter()
        )
    save_figure(figure, out / "campaign.png")


def main() -> None:
    given = options("What campaigns cost.", side=120, shots=2500, scans=5000)
    warnings.simplefilter("ignore", jl.LateLightWarning)
    warnings.simplefilter("ignore", jl.OffMapWarning)
    side, scene = given.side, forest(given.side)
    footprints, scans = grid(side, given.shots), scan(side, given.scans)
    limited = grid(side, given.shots // 4, field_of_view=FIELD_OF_VIEW)
    leaning = grid(side, given.shots // 4, zenith=5.0)
    ways = {
        "footprints, shared": warm(footprints, scene, rtol=0.01),
        "footprints, apart": warm(some(footprints), scene, rtol=0.01, shared=False),
        "footprints, simulate": one_by_one(footprints, scene, 5, rtol=0.01),
        "field of view, shared": warm(limited, scene, rtol=VIEWED),
        "field of view, apart": warm(some(limited), scene, rtol=VIEWED, shared=False),
        "5 degrees off nadir, shared": warm(leaning, scene, rtol=VIEWED),
        "5 degrees off nadir, apart": warm(some(leaning), scene, rtol=VIEWED, shared=False),
        "scan, apart": warm(scans, scene, rtol=0.02, max_orders=1),
        "scan, simulate": one_by_one(scans, scene, 50, rtol=0.02, max_orders=1),
    }
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    by_shots = [warm(grid(side, n), scene, rtol=ROUGH) for n in (1, 9, 100, 1024, 10000)]
    by_side = []
    for other in (50, 100, 200, 400):
        own, per_area = forest(other), round(given.shots * (other / side) ** 2)
        by_side.append({"side": other, **warm(grid(other, per_area), own, rtol=ROUGH)})
    record = {"machine": machine(), "side": side, "peak GB": peak, "ways": ways}
    record |= {"rough": ROUGH, "by shots": by_shots, "by side": by_side}
    write_json(given.out / "campaign.json", record)
    draw(record, given.out)
    rows = [(name, *(r[k] for k in COLUMNS)) for name, r in ways.items()]
    print_table(("way", *COLUMNS), rows)


if __name__ == "__main__":
    main()
