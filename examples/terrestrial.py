"""Scan a tree from a tripod. Run it as `python examples/terrestrial.py [--step 1] [--out figures]`.

A RIEGL VZ-400 stands 14 m from the paper's tree (Table 2) and turns about a vertical axis, with an angular
step that is coarser than the instrument's. Leaves and branches are triangles: beams hit them or pass between
them. Its returns are drawn as the scanner sees them and from the side. By height, the share of its returns
from leaves is set beside the share of leaf area: one scan sees less of the upper crown, which the lower one
hides.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import jax
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

import jaxlidar as jl
import jaxlidar.plot
from jaxlidar.io import atomic_write

# Position of the scanner, m: 14 m south of the stem.
SENSOR = np.array([0.0, -14.0, 1.7])
# A leaf for each bud, m2, and the height of layers, m.
LEAF_AREA, LAYER = 0.004, 1.0
# Range up to which the figure goes, m.
REACH = 25.0


def tree_scene() -> tuple[jl.Scene, jl.MeshSurface]:
    """Return the tree over level ground, and its leaves."""
    tree = jl.grow(jl.broadleaf(), seed=0)
    leaves = jl.leaf_mesh(tree, LEAF_AREA, key=jax.random.key(1))
    wood = jl.MeshSurface(jl.mesh_of(tree, leaves=0), {"wood": jl.spectrum("bark-oak")})
    ground = jl.Ground(reflectance=jl.spectrum("soil-medium"))
    return jl.Scene(meshes=(wood, leaves), ground=ground), leaves


def scan(step: float) -> jl.Survey:
    """Return the shots of a turning scanner that looks at the tree, `step` degrees apart both ways."""
    scanner = jl.instrument("RIEGL VZ-400").at(SENSOR)
    return jl.Survey.scan(scanner, jl.Panorama(zenith=(78.0, 146.0), azimuth=(-32.0, 32.0), step=step))


def profiles(
    returns: jl.DiscreteReturns, leaves: jl.MeshSurface
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the edges of layers, m, and the shares of returns from leaves and of leaf area in each."""
    z = leaves.corners()[:, :, 2].mean(axis=1)
    edges = np.arange(0.0, z.max() + LAYER, LAYER)
    # All triangles have the same area.
    present = np.histogram(z, edges)[0]
    seen = np.histogram(returns.position[returns.material == "mesh:leaf", 2], edges)[0]
    return edges, seen / seen.sum(), present / present.sum()


def draw(survey: jl.Survey, returns: jl.DiscreteReturns, leaves: jl.MeshSurface, step: float) -> Figure:
    """Draw the view of the scanner, the points from the side, and the profiles."""
    figure = plt.figure(figsize=(12.5, 4.3), layout="constrained")
    view, side, profile = figure.subplots(1, 3, width_ratios=(1.1, 1.0, 0.75))
    is_first = returns.number == 1
    distance = np.full(len(survey), np.nan)
    distance[returns.shot[is_first]] = returns.range[is_first]
    elevation = np.unique((survey.zenith - 90.0).round(6))
    # Lines of the head, from left to right.
    distance = distance.reshape(-1, elevation.size).T
    azimuth = (survey.azimuth[:: elevation.size] + 180.0) % 360.0 - 180.0
    # Beyond the tree there is ground alone.
    image = view.pcolormesh(azimuth, elevation, distance, cmap="viridis_r", vmax=REACH, rasterized=True)
    figure.colorbar(image, ax=view, label="range of the first return (m)", extend="max")
    view.set(title="as the scanner sees it", xlabel="azimuth (degrees)", ylabel="elevation (degrees)")
    for material, colour in (("ground", "#8c6d46"), ("leaf", "#009E73"), ("wood", "#3b2a1a")):
        is_material = np.char.endswith(returns.material.astype(str), material)
        _, y, z = returns.position[is_material].T
        side.scatter(
            y - SENSOR[1], z, s=5.0 * step, color=colour, linewidths=0, label=material, rasterized=True
        )
    side.plot(0.0, SENSOR[2], "^", color="#D55E00", label="scanner")
    side.set(title="from the side", xlabel="distance to the north (m)", ylabel="height (m)", aspect="equal")
    side.set(xlim=(-1.0, REACH), ylim=(-0.5, 22.5))
    side.legend(frameon=False, fontsize=8, loc="upper left", ncols=2)
    edges, seen, present = profiles(returns, leaves)
    profile.stairs(present, edges, orientation="horizontal", label="leaf area", color="k")
    profile.stairs(seen, edges, orientation="horizontal", label="returns from leaves", color="#009E73")
    profile.set(title="what one scan sees", xlabel="share of the tree in each metre", ylabel="height (m)")
    profile.legend(frameon=False, fontsize=8)
    return figure


def main(arguments: Sequence[str] | None = None) -> jl.DiscreteReturns:
    """Scan the tree, print numbers, draw the figure and return the discrete returns."""
    parser = argparse.ArgumentParser(description="Scan a tree from a tripod.")
    parser.add_argument("--step", type=float, default=1.0, help="angular step, degrees")
    parser.add_argument("--out", type=Path, default=Path("."), help="folder of the figure")
    options = parser.parse_args(arguments)
    scene, leaves = tree_scene()
    survey = scan(options.step)
    many = jl.simulate_many(survey, scene, key=jax.random.key(0), rtol=0.1, max_orders=1, truth=True)
    returns = many.returns()
    edges, seen, present = profiles(returns, leaves)
    middle = 0.5 * (edges[1:] + edges[:-1])
    print(returns)
    upwards = np.asarray(survey.zenith) > 90.0
    without = np.setdiff1d(np.flatnonzero(upwards), returns.shot)
    print(f"{without.size} of {upwards.sum()} shots above the horizon have no return")
    print(f"mean height of leaf area {present @ middle:.1f} m, of returns from leaves {seen @ middle:.1f} m")
    options.out.mkdir(parents=True, exist_ok=True)
    with atomic_write(options.out / "terrestrial.png") as draft:
        draw(survey, returns, leaves, options.step).savefig(draft, dpi=80, format="png")
    return returns


if __name__ == "__main__":
    main()
