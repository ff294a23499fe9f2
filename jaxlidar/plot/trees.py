"""Figures of trees and forests in three dimensions, leaf-on and leaf-off.

Every function draws on the given `mpl_toolkits.mplot3d.Axes3D`, or on that of a new figure, and returns it;
it neither shows nor saves the figure.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D, proj3d
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from jaxlidar._fields.checks import check_number
from jaxlidar.plants.tree import Tree
from jaxlidar.plot.style import MATERIAL_COLOURS, oblique_axes

# Width of the thinnest lines, in points: thinner ones would be too faint.
MIN_LINEWIDTH = 0.25


def tree(
    tree: Tree | Iterable[Tree],
    ax: Axes3D | None = None,
    *,
    leaves: bool = True,
    alpha: float = 0.25,
    max_buds: int = 60_000,
    elevation: float = 8.0,
    azimuth: float = 200.0,
) -> Axes3D:
    """Draw trees: branch segments as lines as wide as the wood, leaf buds as translucent points.

    Widths and sizes are to the scale of the axes at the time of the call.

    **Arguments:**

    - `tree`: a `Tree`, or several, such as a forest.
    - `ax`: the three-dimensional axes to draw on. Default None: those of a new figure.
    - `leaves`: True to draw the buds. Default True.
    - `alpha`: opacity of a bud, in [0, 1]. Default 0.25.
    - `max_buds`: largest number of buds that are drawn, at least 1. If there are more, about as many are
      drawn, each enlarged to make up for those left out. Default 60,000.
    - `elevation`: angle of the view above the horizon, degrees. Default 8.
    - `azimuth`: direction towards the viewer, degrees clockwise from north. Default 200.

    **Returns:** the axes.

    **Raises:** ValueError for trees without any segment, and for `alpha` or `max_buds` outside their ranges.

    **Example:**

    >>> import jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> ax = jaxlidar.plot.tree(jl.grow(jl.shrub()), Figure().add_subplot(projection="3d"))
    >>> print(ax.get_zlabel())
    height (m)
    """
    check_number("alpha", alpha, 0.0, 1.0)
    check_number("max_buds", max_buds, 1)
    check_number("elevation", elevation)
    check_number("azimuth", azimuth)
    joined = _joined(tree)
    if not len(joined.start):
        raise ValueError("tree has 0 segments; at least 1 is admissible")
    points = np.concatenate([joined.start, joined.end, joined.bud_position, joined.base[None]])
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.02 * np.max(high - low)
    ax = oblique_axes(ax, low - [margin, margin, 0.0], high + margin, elevation, azimuth, (5.0, 5.0))
    scale = _points_per_metre(ax)
    width = scale * (joined.radius_start + joined.radius_end)
    lines = Line3DCollection(
        np.stack([joined.start, joined.end], axis=1).tolist(),
        linewidths=np.maximum(width, MIN_LINEWIDTH).tolist(),
        colors=MATERIAL_COLOURS["bark"],
        capstyle="round",
        label="bark",
    )
    ax.add_collection3d(lines)
    if leaves and len(joined.bud_radius):
        # Every k-th bud: buds are ordered along the branches, so that these are spread evenly. Their areas
        # are scaled by k.
        stride = -(-len(joined.bud_radius) // max_buds)
        area: Any = stride * (2 * scale * joined.bud_radius[::stride]) ** 2
        ax.scatter(
            *joined.bud_position[::stride].T,
            s=area,
            color=MATERIAL_COLOURS["leaf"],
            alpha=alpha,
            linewidths=0,
            depthshade=False,
            label="leaf",
        )
    return ax


def leaf_on_and_off(
    tree: Tree | Iterable[Tree], axes: Sequence[Axes3D] | None = None, **style: Any
) -> tuple[Axes3D, Axes3D]:
    """Draw the same trees on two axes, with leaves and without.

    **Arguments:**

    - `tree`: a `Tree`, or several, such as a forest.
    - `axes`: two three-dimensional axes. Default None: those of a new figure, side by side.
    - `style`: further arguments of `tree`.

    **Returns:** the two axes, leaf-on first.

    **Raises:** ValueError for another number of axes than two, and as `tree`.

    **Example:**

    >>> import jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> axes = Figure().subplots(1, 2, subplot_kw={"projection": "3d"})
    >>> print([ax.get_title() for ax in jaxlidar.plot.leaf_on_and_off(jl.grow(jl.shrub()), axes)])
    ['leaf-on', 'leaf-off']
    """
    joined = _joined(tree)
    if axes is None:
        from matplotlib import pyplot

        figure = pyplot.figure(figsize=(9.0, 5.0), layout="constrained")
        axes = [figure.add_subplot(1, 2, i, projection="3d") for i in (1, 2)]
    if len(axes) != 2:
        raise ValueError(f"axes has {len(axes)} elements; admissible are 2")
    return _draw_titled(joined, axes[0], True, style), _draw_titled(joined, axes[1], False, style)


def _draw_titled(joined: Tree, ax: Axes3D, leaves: bool, style: dict[str, Any]) -> Axes3D:
    ax = tree(joined, ax, **{**style, "leaves": leaves})
    ax.set_title("leaf-on" if leaves else "leaf-off", fontsize="medium")
    return ax


def _joined(tree: Tree | Iterable[Tree]) -> Tree:
    """Join several trees into one set of segments and buds."""
    return tree if isinstance(tree, Tree) else Tree.joined(tree)


def _points_per_metre(ax: Axes3D) -> float:
    """Compute the points per metre at the middle of the axes, from the projection of a vertical metre."""
    x, y, z = (np.mean(limits) for limits in (ax.get_xlim(), ax.get_ylim(), ax.get_zlim()))
    # The projection is that of the final aspect only after this call.
    ax.apply_aspect()
    ends = [proj3d.proj_transform(x, y, z + up, ax.get_proj())[:2] for up in (-0.5, 0.5)]
    pixels = np.diff(ax.transData.transform(ends), axis=0)
    figure = ax.get_figure()
    assert isinstance(figure, Figure)
    return float(np.hypot(*pixels[0])) * 72 / figure.dpi
