"""Time saved by plans: scenes with the plan of their own effects, and with all effects on.

"Everything on" is the same scene as a general simulator would trace it, with the code for effects that the
scene lacks: a voxel canopy with leaf and bark, empty where the scene has none, that rays and photons
traverse; all scattering orders that its leaves require; air that hardly absorbs or scatters; a receiver that
sees a hundred times the width of the beam; a jitter of a picosecond; a slope of a thousandth of a degree; a
footprint of random rays. Plates are not added: there would be too many histories; with the plate of the third
scene only three orders fit, and the plan of the scene has as few.

Both are simulated to the same tolerance, have the same window, bins and orders, and return the same light
(asserted, to 2 %), except where the plan has one order. Times are those of `simulate`, warm, in turns; the
fastest counts. The first calls, which compile, are listed separately.
"""

import dataclasses

import jax
import numpy as np
from _common import best, crown_extinction, new_figure, page_of, race, seconds, table

import jaxlidar as jl

TITLE = "Time saved by plans"
QUICK = {"rounds": 1, "percent": 20}
N, SIZE = 32, 10.0
WINDOW = (-90.0, 59.0)
LIDAR = jl.Lidar(divergence=3.0)
SEES_ALL = jl.Lidar(divergence=3.0, field_of_view=300.0, jitter=1e-3)
LEAF = jl.LeafOptics(reflectance=0.45, transmittance=0.4)
CLEAR = jl.Atmosphere(visibility=1e3, lidar_ratio=50.0)
GROUND = jl.Ground(reflectance=0.3)


def canopy(leaf: float | None, bark: float | None) -> jl.Canopy:
    """Return a crown of 7 m on a trunk of 1 m, with mean extinctions in 1/m; zero is empty, None absent."""
    crown = crown_extinction(N)
    x, y, z = SIZE / N * (np.indices(crown.shape) + 0.5)
    trunk = ((x - 5) ** 2 + (y - 5) ** 2 < 0.25) & (z < 6)
    voxels = jl.VoxelMap.from_extinction(
        leaf=None if leaf is None else leaf / 0.5 * crown,
        bark=None if bark is None else np.where(trunk, 10 * bark, np.where(crown > 0, 0.1 * bark, 0.0)),
        voxel_size=SIZE / N,
        origin=(-5.0, -5.0, 0.0),
    )
    return jl.Canopy(voxels, leaf=LEAF, bark=0.4, hotspot=False)


def scenes() -> dict[str, tuple[jl.Lidar, jl.Scene, jl.Scene, dict[str, bool]]]:
    """Return lidars, scenes, scenes with everything on, and effects that their plans switch off."""
    plate = jl.Plate(height=5.0, reflectance=0.45, transmittance=0.45, coverage=0.7)
    slope = jl.Ground(reflectance=0.3, slope=10.0)
    leaves, first_order = jl.Scene(canopy=canopy(0.4, None), ground=GROUND), {"multiple scattering": False}
    tree = jl.Scene(canopy=canopy(0.4, 0.2), ground=slope, atmosphere=CLEAR)

    def with_everything(scene: jl.Scene, leaf: float = 0.0) -> jl.Scene:
        ground = dataclasses.replace(scene.ground, slope=max(float(scene.ground.slope), 1e-3))
        return dataclasses.replace(scene, canopy=canopy(leaf, 0.0), ground=ground, atmosphere=CLEAR)

    flat, sloping = jl.Scene(ground=GROUND), jl.Scene(ground=slope)
    plates = jl.Scene(plates=(plate,), ground=GROUND)
    return {
        "flat ground": (LIDAR, flat, with_everything(flat), {}),
        "sloping ground": (LIDAR, sloping, with_everything(sloping), {}),
        "plate over ground": (LIDAR, plates, with_everything(plates), {}),
        "leaves, order one": (LIDAR, leaves, with_everything(leaves, 0.4), first_order),
        "leaves, all orders": (LIDAR, leaves, with_everything(leaves, 0.4), {}),
        "tree, all there is": (SEES_ALL, tree, tree, {}),
    }


def measure(rounds: int = 9, percent: int = 1) -> dict:
    """Return the times of each scene with its plan and with everything on, to a tolerance."""
    results = []
    for name, (lidar, scene, full_scene, off) in scenes().items():

        def simulation(lidar, scene, plan):
            key, rtol = jax.random.key(0), 0.01 * percent
            return lambda: jl.simulate(lidar, scene, key=key, rtol=rtol, plan=plan).reflectance

        general_plan = jl.plan(SEES_ALL, full_scene, window=WINDOW)
        orders = general_plan.orders if scene.canopy or scene.plates else None
        scene_plan = jl.plan(
            lidar,
            scene,
            effects=off,
            window=WINDOW,
            bin_width=general_plan.bins.width,
            max_orders=None if off else orders,
        )
        contestants = {
            "plan": simulation(lidar, scene, scene_plan),
            "everything": simulation(SEES_ALL, full_scene, general_plan),
        }
        # Compile programs that scenes share for each scene, for comparable first calls.
        jax.clear_caches()
        cold = {which: seconds(run) for which, run in contestants.items()}
        times = best(race(contestants, rounds))
        sums = {which: float(run().sum()) for which, run in contestants.items()}
        if not off:
            np.testing.assert_allclose(sums["plan"], sums["everything"], rtol=0.02 * percent)
        results.append(
            {
                "scene": name,
                "seconds": times,
                "seconds_with_compilation": cold,
                "ratio": times["everything"] / times["plan"],
                "reflectance": sums,
                "orders": {"plan": scene_plan.orders, "everything": general_plan.orders},
            }
        )
    return {"percent": percent, "rounds": rounds, "scenes": results}


def draw(record: dict):
    """Draw the time of each scene with its plan and with everything on."""
    figure, axes = new_figure(size=(7, 4))
    results = record["scenes"]
    places = np.arange(len(results))
    for shift, which, label in ((-0.2, "plan", "its plan"), (0.2, "everything", "everything on")):
        axes.barh(places + shift, [1e3 * r["seconds"][which] for r in results], 0.4, label=label)
    longest = [1e3 * max(r["seconds"].values()) for r in results]
    for place, end, r in zip(places, longest, results):
        axes.text(1.15 * end, place, f"{r['ratio']:.3g}x", va="center")
    axes.set(xscale="log", xlim=(1, 5 * max(longest)), xlabel="ms, warm", title="One waveform")
    axes.set_yticks(places, [r["scene"] for r in results])
    axes.invert_yaxis()
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, -0.35), ncols=2, frameon=False)
    return figure


def section(record: dict) -> str:
    columns = {
        "scene": "scene",
        "plan of the scene, s": lambda r: r["seconds"]["plan"],
        "everything on, s": lambda r: r["seconds"]["everything"],
        "times longer": "ratio",
    }
    return page_of(
        f"To {record['percent']} %: the plan of the scene, and a plan with everything on (empty voxels, all "
        "orders, air, field of view, jitter ...).",
        table(record["scenes"], columns),
    )
