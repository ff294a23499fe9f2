"""Figures of trees: positions, widths and labels of segments and buds."""

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

import jaxlidar as jl
from jaxlidar.plot import trees as plot_trees

matplotlib.use("agg")


@pytest.fixture(scope="module")
def shrub():
    return jl.grow(jl.shrub(stems=3))


@pytest.fixture
def axes():
    return Figure(figsize=(5, 5)).add_subplot(projection="3d")


def collections_of(axes):
    """Return the collections by their labels."""
    return {collection.get_label(): collection for collection in axes.collections}


def test_a_tree_is_lines_and_points(shrub, axes):
    assert plot_trees.tree(shrub, axes) is axes
    drawn = collections_of(axes)
    assert set(drawn) == {"bark", "leaf"}
    assert np.allclose(drawn["bark"]._segments3d, np.stack([shrub.start, shrub.end], axis=1))
    assert np.allclose(np.stack(drawn["leaf"]._offsets3d, axis=1), shrub.bud_position)
    assert axes.get_zlabel() == "height (m)"
    low, high = axes.get_zlim()
    assert low <= 0 < 2.5 < high


def test_widths_are_to_scale(shrub, axes):
    plot_trees.tree(shrub, axes, elevation=0.0)
    drawn = collections_of(axes)
    widths = np.asarray(drawn["bark"].get_linewidth())
    thick = widths > plot_trees.MIN_LINEWIDTH
    scale = widths[thick] / (shrub.radius_start + shrub.radius_end)[thick]
    assert np.allclose(scale, scale[0])
    # A point is 1/72 inch, the axes are 5 inches, and the shrub takes a good fraction of them.
    assert 40 < scale[0] * shrub.height < 300
    assert np.allclose(np.sqrt(drawn["leaf"].get_sizes()) / (2 * shrub.bud_radius), scale[0])


def test_fewer_buds_are_drawn_larger(shrub, axes):
    plot_trees.tree(shrub, axes, max_buds=100)
    full_axes = Figure(figsize=(5, 5)).add_subplot(projection="3d")
    plot_trees.tree(shrub, full_axes)
    reduced, full = (collections_of(a)["leaf"].get_sizes() for a in (axes, full_axes))
    assert len(reduced) <= 100
    assert np.isclose(reduced.sum(), full.sum(), rtol=0.05)


def test_leaf_on_beside_leaf_off(shrub):
    figure = Figure(figsize=(9, 5))
    axes = [figure.add_subplot(1, 2, i, projection="3d") for i in (1, 2)]
    on, off = plot_trees.leaf_on_and_off(shrub, axes, alpha=0.5)
    assert (on, off) == tuple(axes)
    assert set(collections_of(on)) == {"bark", "leaf"}
    assert set(collections_of(off)) == {"bark"}
    assert (on.get_title(), off.get_title()) == ("leaf-on", "leaf-off")
    assert on.get_zlim() == off.get_zlim()
    figure.canvas.draw()


def test_forests_and_new_figures(shrub):
    from matplotlib import pyplot

    bare = shrub.leafless()
    axes = plot_trees.tree([bare, bare.translated((6.0, 0.0, 0.0))])
    assert set(collections_of(axes)) == {"bark"}
    assert np.ptp(axes.get_xlim()) > 6
    pyplot.close(axes.figure)
    on, _ = plot_trees.leaf_on_and_off(bare)
    pyplot.close(on.figure)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda t: plot_trees.tree(t, alpha=1.5), "alpha = 1.5 is outside"),
        (lambda t: plot_trees.tree(t, max_buds=0), "max_buds = 0 is outside"),
        (lambda t: plot_trees.tree(jl.turtle("")), "tree has 0 segments"),
        (lambda t: plot_trees.tree([]), "trees is empty"),
        (lambda t: plot_trees.leaf_on_and_off(t, []), "axes has 0 elements"),
    ],
)
def test_inadmissible_input_is_refused(shrub, call, message):
    with pytest.raises(ValueError, match=message):
        call(shrub)
