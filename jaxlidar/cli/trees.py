"""The command `jaxlidar tree`."""

from pathlib import Path

import click

from jaxlidar.cli.shared import PLOT_OPTION, new_axes, out_option, save_figure
from jaxlidar.io import Case, write_case
from jaxlidar.optics.prospect import Prospect
from jaxlidar.optics.spectra import spectrum
from jaxlidar.plants.habits import broadleaf, conifer, grow, shrub, spreading_tree
from jaxlidar.plants.voxelise import voxelise
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.surfaces import Ground

HABITS = {"broadleaf": broadleaf, "conifer": conifer, "shrub": shrub, "spreading": spreading_tree}
POSITIVE = click.FloatRange(0, min_open=True)


@click.command()
@click.argument("habit", type=click.Choice(tuple(HABITS)), default="broadleaf")
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of the random growth.")
@click.option("--height", type=POSITIVE, help="Height, m.  [default: the habit's]")
@click.option("--voxel-size", type=POSITIVE, default=0.25, help="Edge of the voxels, m.")
@click.option("--leaf-area", type=POSITIVE, help="Leaf area of the tree, m2.  [default: that of its clumps]")
@click.option("--leafless", is_flag=True, help="Grow the tree without leaves.")
@out_option("Write a scene of the tree over soil as NAME.toml and NAME.npz.", ".toml")
@PLOT_OPTION
def tree(
    habit: str,
    seed: int,
    height: float | None,
    voxel_size: float,
    leaf_area: float | None,
    leafless: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Grow a tree by an L-system, print its size, and write a scene or a figure of it.

    \b
    Examples:
      jaxlidar tree --plot tree.png
      jaxlidar tree conifer --seed 3 --height 25 -o spruce.toml
      jaxlidar simulate spruce.toml
    """
    grown = grow(HABITS[habit](**({} if height is None else {"height": height})), seed=seed)
    grown = grown.leafless() if leafless else grown
    buds = len(grown.bud_radius)
    click.echo(
        f"{habit}: {grown.height:.2f} m tall, {grown.trunk_diameter:.2f} m thick, {len(grown.start):,} "
        f"segments of wood, {buds:,} leaf clumps"
    )
    if out is not None:
        area_per_bud = None if leaf_area is None or not buds else leaf_area / buds
        voxels = voxelise(grown, voxel_size, leaf_area=area_per_bud, wood="surface")
        leaf = None if voxels.leaf is None else Prospect()
        canopy = Canopy(voxels, leaf=leaf, bark=spectrum("bark-oak"))
        write_case(out, Case(scene=Scene(canopy=canopy, ground=Ground(reflectance=spectrum("soil-medium")))))
        click.echo(f"scene: {out}, {' x '.join(map(str, voxels.shape))} voxels")
    if plot is not None:
        from jaxlidar.plot import tree as draw_tree

        axes = new_axes(4.0, 4.5, projection="3d")
        draw_tree(grown, axes)
        save_figure(axes, plot)
