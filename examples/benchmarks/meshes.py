"""Cost of meshes: the crown benchmark with 1,000 triangles, and with a million of 100 instances.

Run it as `python examples/benchmarks/meshes.py [--out figures] [--photons 32768] [--rounds 3]`. The scene is
a crown of voxels over the ground, four orders, of light of one wavelength. Beside it stand trunks of
triangles: none, one of 1,000 triangles, or 100 instances of a mesh of 10,000. Alone: the same without voxels.
"""

import jax
import numpy as np
from _common import best, machine, new_figure, options, print_table, race, save_figure, seconds, write_json

import jaxlidar as jl

ORDERS = 4
N, SIZE = 32, 10.0


def crown() -> jl.Canopy:
    """Return leaf and bark in a sphere of voxels."""
    centres = (np.arange(N) + 0.5) * SIZE / N
    x, y, z = np.meshgrid(centres, centres, centres, indexing="ij")
    inside = (x - 5) ** 2 + (y - 5) ** 2 + (z - 6) ** 2 < 3.5**2
    k = np.where(inside, 0.5 * np.random.default_rng(0).uniform(0, 2, (N, N, N)), 0.0)
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


def main() -> None:
    arguments = options("Cost of meshes.", photons=32768, rounds=3)
    lidar, key = jl.Lidar(divergence=10.0, profile="top-hat"), jax.random.key(0)
    canopy, ground = crown(), jl.Ground(reflectance=0.3)
    scenes = {name: jl.Scene(canopy=canopy, ground=ground, meshes=m) for name, m in meshes().items()}
    scenes["1,000 triangles alone"] = jl.Scene(ground=ground, meshes=meshes()["1,000 triangles"])
    # A tolerance that eight batches meet: all scenes trace the same photons.
    choices = {"n_photons": arguments.photons, "max_orders": ORDERS}
    plans = {name: jl.plan(lidar, scene, rtol=0.9, **choices) for name, scene in scenes.items()}

    def simulation(name):
        def run():
            return jl.simulate(lidar, scenes[name], key=key, rtol=0.9, plan=plans[name]).reflectance

        return run

    contestants = {name: simulation(name) for name in scenes}
    first_calls = {name: seconds(run) for name, run in contestants.items()}
    times = best(race(contestants, arguments.rounds))
    ratio = {name: t / times["voxels alone"] for name, t in times.items()}
    record = {
        "machine": machine(),
        "photons": arguments.photons,
        "orders": ORDERS,
        "triangles": {n: sum(m.n_triangles * len(m.instances) for m in s.meshes) for n, s in scenes.items()},
        "seconds": times,
        "seconds_first_call": first_calls,
        "times_voxels_alone": ratio,
        "memory_bytes": {name: plan.memory for name, plan in plans.items()},
    }
    write_json(arguments.out / "meshes.json", record)

    figure, axes = new_figure(size=(7, 3))
    axes.barh(list(times), list(times.values()))
    axes.invert_yaxis()
    axes.axvline(1.5 * times["voxels alone"], color="black", linestyle="--", label="1.5 times voxels alone")
    axes.axvline(10 * times["voxels alone"], color="grey", linestyle=":", label="10 times voxels alone")
    axes.set(xlabel="seconds", title=f"simulate: {arguments.photons} photons, {ORDERS} orders")
    axes.legend()
    save_figure(figure, arguments.out / "meshes.png")
    rows = [(n, t, ratio[n], first_calls[n], 1e-6 * plans[n].memory) for n, t in times.items()]
    print_table(("scene", "s", "times voxels alone", "s, first call", "MB"), rows)


if __name__ == "__main__":
    main()
