"""Fly a scanner over a street of houses, trees and wires. Run it as `python examples/street.py [--out .]`.

Houses, trees, poles, wires and the road are triangles, which stop a beam; houses and trees are instances of
one house and one tree. A RIEGL VQ-780 II passes on either side and looks at the street obliquely, so that it
sees walls. One of the trees is also made of voxels, and seen by the same shots.
"""

import argparse
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

import jaxlidar as jl
import jaxlidar.plot
from jaxlidar.io import atomic_write

# Ends of the street, and half its width with gardens, m.
LENGTH, HALF_WIDTH = 60.0, 20.0
# Places of houses and trees, m, with their azimuths in degrees and scales.
HOUSES = ((10, 12, 0, 1.0), (31, 14, 90, 1.1), (51, 12, 0, 0.9), (17, -13, 180, 1.1), (45, -13, 180, 1.0))
TREES = ((20, 7, 0, 1.1), (42, 7, 90, 0.9), (5, -7.5, 180, 1.0), (31, -9, 270, 1.2), (56, -8, 45, 0.9))
# Edge of voxels of the first tree, m.
VOXEL_SIZE = 0.25
# Leaves of each clump, and their length, m.
LEAVES, LEAF_LENGTH = 2, 0.1
ROAD_HEIGHT = 0.05
# Places of poles along the street, their height, and their distance from its middle, m.
POLES, POLE_HEIGHT, POLE_Y = (2.0, 30.0, 58.0), 8.0, -4.5
# Places of wires across the line of poles, their radius, and how far they hang down between poles, m.
WIRES, WIRE_RADIUS, SAG = (-0.7, 0.0, 0.7), 0.01, 0.8
# Flight lines, m: height, and distance from the middle of the street.
ALTITUDE, OFFSET = 500.0, 200.0
OPTICS = {"wall": 0.5, "roof": 0.25, "wood": 0.4, "leaf": 0.45, "pole": 0.4, "wire": 0.3, "road": 0.15}
LEAF_TRANSMITTANCE = 0.4
LAWN = jl.Ground(reflectance=0.35)


def house() -> jl.Mesh:
    """Return walls and a gabled roof with eaves, about the origin."""
    x, y, eaves, ridge, overhang = 5.0, 4.0, 5.0, 8.0, 0.6
    base = [(sx * x, sy * y, z) for z in (0.0, eaves) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    gables = [(-x, 0.0, ridge), (x, 0.0, ridge)]
    # Eaves continue the slope of the roof.
    low = eaves - overhang * (ridge - eaves) / y
    edges = [(s * (x + overhang), t * (y + overhang), low) for t in (-1, 1) for s in (-1, 1)]
    tops = [(s * (x + overhang), 0.0, ridge) for s in (-1, 1)]
    walls = [(k, (k + 1) % 4, 4 + (k + 1) % 4, 4 + k) for k in range(4)]
    walls = [t for a, b, c, d in walls for t in ((a, b, c), (a, c, d))] + [(4, 8, 7), (5, 6, 9)]
    roof = [(10, 11, 15), (10, 15, 14), (12, 14, 15), (12, 15, 13)]
    material = np.repeat([0, 1], [len(walls), len(roof)])
    return jl.Mesh(base + gables + edges + tops, walls + roof, material, ("wall", "roof"))


def tubes(start: np.ndarray, end: np.ndarray, radius: float, name: str) -> jl.Mesh:
    """Return round rods between points (n, 3), of a material."""
    radii, count = np.full(len(start), radius), len(start)
    none = np.zeros((0, 3))
    rods = jl.Tree(
        start, end, radii, radii, np.full(count, -1), np.zeros(count, int), none, none, np.zeros(0)
    )
    mesh = jl.mesh_of(rods, sides=12)
    return jl.Mesh(mesh.vertices, mesh.faces, materials=(name,))


def poles_and_wires() -> tuple[jl.Mesh, jl.Mesh]:
    """Return poles with crossarms, and wires that sag between them."""
    feet = np.array([(x, POLE_Y, 0.0) for x in POLES])
    heads = feet + np.array([0.0, 0.0, POLE_HEIGHT])
    arm = np.array([0.0, WIRES[-1] + 0.2, 0.0])
    poles = tubes(np.concatenate([feet, heads - arm]), np.concatenate([heads, heads + arm]), 0.12, "pole")
    x = np.linspace(POLES[0], POLES[-1], 113)
    # A parabola between poles, near to the catenary.
    span = np.clip(np.searchsorted(POLES, x, side="right") - 1, 0, len(POLES) - 2)
    first, last = np.array(POLES)[span], np.array(POLES)[span + 1]
    sag = 4.0 * SAG * (x - first) * (last - x) / (last - first) ** 2
    lines = [np.c_[x, np.full_like(x, POLE_Y + y), POLE_HEIGHT + 0.15 - sag] for y in WIRES]
    start, end = (np.concatenate([line[s] for line in lines]) for s in (slice(None, -1), slice(1, None)))
    return poles, tubes(start, end, WIRE_RADIUS, "wire")


def copies(places: Sequence[tuple[float, float, float, float]]) -> jl.MeshInstances:
    """Return copies of a mesh at rows of (x, y, azimuth, scale)."""
    x, y, azimuth, scale = np.array(places, float).T
    return jl.MeshInstances(np.c_[x, y, np.zeros_like(x)], azimuth, scale)


def surface(mesh: jl.Mesh, instances: jl.MeshInstances | None = None) -> jl.MeshSurface:
    """Return a mesh with the optics of its materials, and its copies."""
    reflectance = {name: OPTICS[name] for name in mesh.materials}
    transmittance = {"leaf": LEAF_TRANSMITTANCE} if "leaf" in mesh.materials else {}
    return jl.MeshSurface(mesh, reflectance, transmittance, instances=instances)


def grown_tree() -> jl.Tree:
    """Return the tree of which all others are copies."""
    return jl.grow(jl.broadleaf(height=8.0, trunk_diameter=0.35), seed=2)


def street() -> jl.Scene:
    """Return the street, all of triangles."""
    corners = [(x, y, ROAD_HEIGHT) for x, y in ((-50, -3), (LENGTH + 50, -3), (LENGTH + 50, 3), (-50, 3))]
    road = jl.Mesh(corners, [(0, 1, 2), (0, 2, 3)], materials=("road",))
    tree = jl.mesh_of(grown_tree(), leaves=LEAVES, leaf_length=LEAF_LENGTH)
    buildings, trees = surface(house(), copies(HOUSES)), surface(tree, copies(TREES))
    return jl.Scene(meshes=(buildings, trees, *map(surface, (*poles_and_wires(), road))), ground=LAWN)


def tree_of_voxels() -> jl.Scene:
    """Return the first tree alone, of voxels with the leaf area of its triangles."""
    x, y, azimuth, scale = TREES[0]
    tree = grown_tree().scaled(scale).rotated(azimuth).translated((x, y, 0.0))
    leaf_area = LEAVES * (0.5 * scale * LEAF_LENGTH) ** 2
    voxels = jl.voxelise(tree, VOXEL_SIZE, leaf_area=leaf_area, wood="surface")
    leaf = jl.LeafOptics(OPTICS["leaf"], LEAF_TRANSMITTANCE)
    return jl.Scene(canopy=jl.Canopy(voxels, leaf=leaf, bark=OPTICS["wood"]), ground=LAWN)


def flight(spacing: float) -> jl.Survey:
    """Return the shots of two strips that look at the street from both sides, about `spacing` m apart."""
    lidar = replace(jl.instrument("RIEGL VQ-780 II"), altitude=ALTITUDE)
    speed, margin = 60.0, 2.0
    ends = np.array([[-margin, OFFSET, ALTITUDE], [LENGTH + margin, OFFSET, ALTITUDE]])
    # To the east on the north side, and back on the south side: the street lies to the right.
    strips = [ends, ends[::-1] * [1, -1, 1]]
    seconds = (LENGTH + 2 * margin) / speed
    trajectories = [jl.Trajectory([2 * k, 2 * k + seconds], p) for k, p in enumerate(strips)]
    across = np.rad2deg(np.arctan2(OFFSET, ALTITUDE))
    half_angle = np.rad2deg(np.arctan2(OFFSET + HALF_WIDTH, ALTITUDE)) - across
    lines = speed / spacing
    return jl.Survey.fly(
        trajectories,
        jl.RotatingPolygon(half_angle=half_angle, line_rate=lines),
        lidar=lidar,
        # No whole number of shots in a line: shots of all lines at the same places would miss a thin wire for
        # metres.
        pulse_rate=lines * (round(2 * HALF_WIDTH / spacing) + 0.382),
        mounting=(-across, 0.0, 0.0),
    )


def shots_at_tree(survey: jl.Survey) -> np.ndarray:
    """Return the numbers of the shots that pass within 6 m of the middle of the first tree's crown."""
    x, y, _, scale = TREES[0]
    crown = jl.ground_position(survey, jl.Scene(ground=jl.Ground(height=5.0 * scale)))
    return np.flatnonzero(np.hypot(*(crown[:, :2] - [x, y]).T) < 6.0)


def heights_of_tree(returns: jl.DiscreteReturns) -> np.ndarray:
    """Return the heights of the returns of leaf and wood about the first tree, m."""
    is_plant = np.isin(returns.material, ["leaf", "bark", "mesh:leaf", "mesh:wood"])
    is_near = np.hypot(*(returns.position[:, :2] - TREES[0][:2]).T) < 6.0
    return returns.position[is_plant & is_near, 2]


def draw(returns: jl.DiscreteReturns, of_voxels: jl.DiscreteReturns, scene: jl.Scene) -> Figure:
    """Draw the street from above and obliquely, a section along the wires, and the tree of both kinds."""
    figure = plt.figure(figsize=(11.0, 11.0), layout="constrained")
    rows: Any = figure.subfigures(3, 1, height_ratios=(1.3, 0.5, 0.85))
    upper, middle, lower = rows
    look = {"colour_by": "material", "legend": False}
    # The street is wide and low: a square with equal scales is larger than the picture.
    oblique = upper.add_axes((-0.2, -0.65, 1.4, 2.3), projection="3d")
    jaxlidar.plot.points(returns, oblique, view="oblique", elevation=35.0, azimuth=200.0, size=2.5, **look)
    wires, line = middle.subplots(), ((0.0, POLE_Y), (LENGTH, POLE_Y))
    jaxlidar.plot.section(returns, *line, wires, width=2.5, scene=scene, size=2.5, **look)
    wires.set_title("along the wires, 2.5 m wide", fontsize="medium")
    above, *trees = lower.subplots(1, 3, width_ratios=(1.7, 1.0, 1.0))
    jaxlidar.plot.points(returns, above, size=1.6, **look)
    x, y, *_ = TREES[0]
    kinds = {"triangles": returns, f"voxels of {VOXEL_SIZE:g} m": of_voxels}
    for ax, (kind, points) in zip(trees, kinds.items()):
        line = (x - 5.0, y), (x + 5.0, y)
        jaxlidar.plot.section(points, *line, ax, width=5.0, scene=scene, size=3.0, **look)
        ax.set_title(f"tree of {kind}:\n{heights_of_tree(points).size} returns", fontsize="medium")
    handles, labels = above.get_legend_handles_labels()
    entries = {label.removeprefix("mesh:"): handle for handle, label in zip(handles, labels)}
    figure.legend(
        entries.values(), entries, loc="outside lower center", ncols=9, markerscale=4.0, frameon=False
    )
    return figure


def main(arguments: Sequence[str] | None = None) -> jl.DiscreteReturns:
    """Scan the street, print numbers, draw the figure and return the discrete returns."""
    parser = argparse.ArgumentParser(description="Fly a scanner over a street.")
    parser.add_argument("--spacing", type=float, default=0.7, help="distance of shots of a strip, m")
    parser.add_argument("--out", type=Path, default=Path("."), help="folder of the figure")
    options = parser.parse_args(arguments)
    survey, scene = flight(options.spacing), street()
    choices = {"key": jax.random.key(0), "rtol": 0.1, "max_orders": 1}
    returns = jl.simulate_many(survey, scene, **choices).returns()
    print(returns)
    with warnings.catch_warnings():
        # Some shots pass the tree, beside which there are no voxels.
        warnings.simplefilter("ignore", jl.OffMapWarning)
        at_tree = survey.subset(shots_at_tree(survey))
        of_voxels = jl.simulate_many(at_tree, tree_of_voxels(), **choices).returns()
    for kind, points in (("triangles", returns), ("voxels", of_voxels)):
        heights = heights_of_tree(points)
        print(f"tree of {kind}: {heights.size} returns, mean height {heights.mean():.2f} m")
    options.out.mkdir(parents=True, exist_ok=True)
    with atomic_write(options.out / "street.png") as draft:
        draw(returns, of_voxels, scene).savefig(draft, dpi=80, format="png")
    return returns


if __name__ == "__main__":
    main()
