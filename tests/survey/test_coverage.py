"""Where the axes of beams meet the ground, and where they meet none."""

import jax
import numpy as np
import pytest

import jaxlidar as jl


def test_axes_beside_open_terrain_meet_no_ground():
    """A simulation refuses what `ground_position` says to meet nothing, and takes the rest."""
    hill = jl.Terrain(np.add.outer(np.arange(21.0), np.zeros(11)), 1.0, (0.0, 0.0))
    scene, x = jl.Scene(ground=hill), np.array([-30.0, 5.0, 14.0, 60.0])
    survey = jl.Survey(jl.Lidar(divergence=0.2), np.stack([x, np.full(4, 5.0)], axis=1))
    points = jl.ground_position(survey, scene)
    met = np.isfinite(points).all(axis=1)
    assert met.tolist() == [False, True, True, False]
    # The terrain is as high as x.
    np.testing.assert_allclose(points[met], np.stack([x[met], [5.0, 5.0], x[met]], axis=1), atol=1e-4)
    with pytest.raises(ValueError, match="lies off the terrain"):
        jl.simulate_many(survey, scene, key=jax.random.key(0))
    rest = survey.subset(np.flatnonzero(met))
    many = jl.simulate_many(rest, scene, key=jax.random.key(0), max_orders=1, rtol=0.1)
    np.testing.assert_allclose(many.ground_height, x[met], atol=1e-3)


def test_level_beams_meet_a_hill():
    """Planted: a point that follows from its height is unknown for an axis without a slope."""
    hill = jl.Terrain(np.repeat(np.array([0.0, 0, 0, 50, 50, 50])[:, None], 6, axis=1), 10.0, (0.0, 0.0))
    lidar = jl.Lidar(sensor=(5.0, 25.0, 20.0))
    survey = jl.Survey(lidar, sensor=[(5.0, 25.0, 20.0)] * 2, zenith=[90.0, 90.0], azimuth=[90.0, 270.0])
    points = jl.ground_position(survey, jl.Scene(ground=hill))
    np.testing.assert_allclose(points, [[24.0, 25.0, 20.0], [np.nan] * 3], atol=1e-3)


def test_bounds_of_a_terrain_hold_for_lines_that_begin_far_beside_it():
    """Planted: nodes counted from the first line on, as many as the terrain has, end before the peak."""
    heights = np.zeros((21, 11))
    heights[18, 5] = 9.0
    shape = jl.Terrain(heights, 1.0, (0.0, 0.0)).shape
    points = np.array([[-30.0, 5.0, 20.0], [19.0, 5.0, 20.0]])
    _, low, high = shape.height_bounds_below(points, np.array([[0.0, 0.0, -1.0]] * 2))
    assert (low, high) == (0.0, 9.0)
