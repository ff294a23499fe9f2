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
