"""Cost of meshes: the crown benchmark with 1,000 triangles, and with a million of 100 instances.

The scene is a crown of voxels over the ground, four orders, of light of one wavelength. Beside it stand
trunks of triangles: none, one of 1,000 triangles, or 100 instances of a mesh of 10,000. Alone: the same
without voxels.
"""

import jax
import numpy as np
from _common import best, crown_extinction, new_figure, page_of, race, seconds, table

import jaxlidar as jl

TITLE = "Cost of meshes"
QUICK = {"photons": 1024, "rounds": 1}
ORDERS = 4
N, SIZE = 32, 10.0


def crown() -> jl.Canopy:
    """Return leaf and bark in a sphere of voxels."""
    k = crown_extinction(N)
    voxels = jl.VoxelMap.from_extinction(0.9 * k, 0.1 * k, voxel_size=SIZE / N, origin=(-5.0, -5.0, 0.0))
    return jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4), bark=0.4)


def trunk(rows: int, sides: int, radius: float, instances: jl.MeshInstances | None = None) -> jl.MeshSurface:
    """Return an open tube of 2 x rows x sides triangles, 8 m high, with wavy bark."""
    turn = 2 * np.pi * np.arange(sides) / sides
    height = np.linspace(0.0, 8.0, rows + 1)
    wavy = radius * (1.0 + 0.1 * np.sin(7 * turn)[None] * np.cos(3 * height)[:, None])
    x, y = wavy * np.cos(turn), wavy * np.sin(turn)
    vertices = np.stack([x, y, np.broadcast_to(height[:, None], x.shape)], axis=-1).reshape(-1, 3)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(rows), np.arange(sides), indexing="ij"))
    a, b = i * sides + j, i * sides + (j + 1) % sides
    faces = np.concatenate([np.stack(t, axis=1) for t in ((a, b, b + sides), (a, b + sides, a + sides))])
    return jl.MeshSurface((vertices, faces), reflectance=0.3, instances=instances)


def meshes() -> dict[str, tuple[jl.MeshSurface, ...]]:
    """Return the meshes of all scenes, by name."""
    random = np.random.default_rng(1)
    shift = np.append(random.uniform(-5.0, 5.0, (100, 2)), np.zeros((100, 1)), axis=1)
    places = jl.MeshInstances(shift, random.uniform(0, 360, 100), random.uniform(0.5, 1.0, 100))
    return {
        "voxels alone": (),
        "1,000 triangles": (trunk(25, 20, 0.3),),
        "100 x 10,000 triangles": (trunk(100, 50, 0.1, places),),
    }


def measure(photons: int = 32768, rounds: int = 3) -> dict:
    """Return the times of all scenes, which trace the same photons."""
    lidar, key = jl.Lidar(divergence=10.0, profile="top-hat"), jax.random.key(0)
    canopy, ground = crown(), jl.Ground(reflectance=0.3)
    scenes = {name: jl.Scene(canopy=canopy, ground=ground, meshes=m) for name, m in meshes().items()}
    scenes["1,000 triangles alone"] = jl.Scene(ground=ground, meshes=meshes()["1,000 triangles"])
    # A tolerance that eight batches meet.
    choices = {"n_photons": photons, "max_orders": ORDERS}
    plans = {name: jl.plan(lidar, scene, rtol=0.9, **choices) for name, scene in scenes.items()}

    def simulation(name):
        return lambda: jl.simulate(lidar, scenes[name], key=key, rtol=0.9, plan=plans[name]).reflectance

    contestants = {name: simulation(name) for name in scenes}
    first_calls = {name: seconds(run) for name, run in contestants.items()}
    times = best(race(contestants, rounds))
    return {
        "photons": photons,
        "orders": ORDERS,
        "triangles": {n: sum(m.n_triangles * len(m.instances) for m in s.meshes) for n, s in scenes.items()},
        "seconds": times,
        "seconds_first_call": first_calls,
        "times_voxels_alone": {name: t / times["voxels alone"] for name, t in times.items()},
        "memory_bytes": {name: plan.memory for name, plan in plans.items()},
    }


def draw(record: dict):
    """Draw the seconds of each scene."""
    figure, axes = new_figure(size=(7, 3))
    times = record["seconds"]
    axes.barh(list(times), list(times.values()))
    axes.invert_yaxis()
    axes.axvline(1.5 * times["voxels alone"], color="black", linestyle="--", label="1.5 times voxels alone")
    axes.axvline(10 * times["voxels alone"], color="grey", linestyle=":", label="10 times voxels alone")
    axes.set(xlabel="seconds", title=f"simulate: {record['photons']} photons, {ORDERS} orders")
    axes.legend()
    return figure


def section(record: dict) -> str:
    columns = {
        "scene": str,
        "triangles": record["triangles"],
        "s": record["seconds"],
        "times voxels alone": record["times_voxels_alone"],
        "s, first call": record["seconds_first_call"],
        "MB, predicted": lambda name: 1e-6 * record["memory_bytes"][name],
    }
    return page_of(
        f"Seconds of `simulate` with {record['photons']:,} photons and {record['orders']} orders: a crown "
        "of 32³ voxels over the ground, and trunks of triangles beside and within it. A copy of a mesh costs "
        "its transformation alone.",
        table(record["seconds"], columns),
    )
