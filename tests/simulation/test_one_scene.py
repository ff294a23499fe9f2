"""Scenes without anything in them."""

import jax
import numpy as np
import pytest

import jaxlidar as jl

KEY = jax.random.key(0)


@pytest.mark.parametrize("scene", [jl.Scene(), jl.Scene(atmosphere=jl.Atmosphere())], ids=["empty", "air"])
def test_scenes_without_materials_return_nothing(scene):
    wave = jl.simulate(jl.Lidar(), scene, key=KEY)
    np.testing.assert_array_equal(wave.reflectance, 0.0)
    many = jl.simulate_many(jl.Survey(jl.Lidar(), [(0.0, 0.0), (5.0, 0.0)]), scene, key=KEY)
    assert len(many.returns()) == 0
