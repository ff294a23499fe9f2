"""Profiles of plants and their averaging kernels: what is drawn is what is given."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxlidar import plot

EDGES, DENSITY = np.array([0.0, 1.0, 3.0, 6.0]), np.array([0.2, 0.4, 0.1])


@pytest.fixture
def axes():
    return Figure().subplots()


def test_a_profile_stands_in_its_layers_with_band_truth_and_product(axes):
    coarse_profile = ([0.0, 6.0], [0.25])
    assert (
        plot.profile(EDGES, DENSITY, axes, band=(0.5 * DENSITY, 2.0 * DENSITY), truth=coarse_profile) is axes
    )
    steps = {patch.get_label(): patch.get_data() for patch in axes.patches if hasattr(patch, "get_data")}
    np.testing.assert_array_equal(steps["estimate"].values, DENSITY)
    np.testing.assert_array_equal(steps["estimate"].edges, EDGES)
    np.testing.assert_array_equal(steps["truth"].edges, coarse_profile[0])
    (bars,) = axes.containers
    boxes = [bar.get_bbox() for bar in bars]
    np.testing.assert_allclose([(b.x0, b.x1) for b in boxes], np.column_stack([0.5 * DENSITY, 2.0 * DENSITY]))
    np.testing.assert_allclose([(b.y0, b.y1) for b in boxes], np.column_stack([EDGES[:-1], EDGES[1:]]))
    assert axes.get_ylim() == (0.0, 6.0)
    assert axes.get_xlim()[1] > DENSITY.max()


def test_a_product_in_the_same_layers_needs_no_edges(axes):
    plot.profile(EDGES, DENSITY, axes, product=0.7 * DENSITY, label="fit", color="red")
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["product", "fit"]


def test_a_kernel_has_truth_across_and_its_trace_above(axes):
    matrix = np.array([[0.8, 0.1, 0.0], [0.3, 0.6, 0.1], [0.0, 0.0, 0.0]])
    assert plot.averaging_kernel(matrix, EDGES, axes) is axes
    (image,) = axes.collections[:1]
    np.testing.assert_array_equal(np.asarray(image.get_array()).reshape(3, 3), matrix)
    assert axes.get_title() == "1.4 degrees of freedom in 3 layers"
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("true height (m)", "estimated height (m)")
    # The layer that no truth moves is hatched.
    assert [patch.get_hatch() for patch in axes.patches] == ["////"]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: plot.profile(EDGES, DENSITY[:2]), "density has shape"),
        (lambda: plot.profile(EDGES[::-1], DENSITY), "two edges or more, increasing"),
        (lambda: plot.profile(EDGES, DENSITY, truth=DENSITY[:2]), "truth density has shape"),
        (lambda: plot.profile(EDGES, DENSITY, band=(DENSITY,)), "band has 1 arrays; admissible are 2"),
        (lambda: plot.averaging_kernel(np.ones((2, 3))), "admissible is .layers, layers."),
        (lambda: plot.averaging_kernel(np.eye(3), EDGES[:2]), "admissible are 4 for 3 layers"),
    ],
)
def test_inadmissible_profiles_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
