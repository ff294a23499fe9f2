"""The atmosphere over a scene: a factor for every wavelength and bin, and the air's own return.

Flat ground of reflectance rho at height h under a lidar at 3 km returns rho T^2(h). With a lidar ratio the
air above it returns pi beta T^2 per metre of range; summed over a window that starts 300 ns before the
ground, that is the integral over the last 45 m above the ground.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from tests.helpers import slow_unless

KEY = jax.random.key(0)
LIDAR = jl.Lidar(wavelength=(532.0, 1064.0), altitude=3000.0)


def test_ground_through_the_air():
    air = jl.Atmosphere(visibility=5.0)
    for height in (0.0, 40.0):
        wave = jl.simulate(
            LIDAR, jl.Scene(ground=jl.Ground(height=height, reflectance=0.4), atmosphere=air), key=KEY
        )
        clear = air.two_way_transmittance(LIDAR.wavelength, height, 3000.0, 0.0)
        assert np.allclose(jnp.sum(wave.reflectance, axis=1), 0.4 * clear.reshape(-1), rtol=1e-4)
        assert float(clear.reshape(-1)[0]) < 0.8


@pytest.mark.parametrize("ratio", slow_unless([60.0], [30.0, 60.0]))
def test_the_return_of_the_air(ratio):
    air = jl.Atmosphere(visibility=5.0, lidar_ratio=ratio)
    scene = jl.Scene(ground=jl.Ground(reflectance=0.0), atmosphere=air)
    wave = jl.simulate(LIDAR, scene, key=KEY, window=(-300.0, -50.0))
    heights = np.asarray(wave.height, float)
    per_metre = air.backscatter(LIDAR.wavelength, jnp.asarray(heights), 3000.0, 0.0)
    expected = np.asarray(per_metre) * 0.5 * 0.299792458
    # At the ends of the window, part of the pulse lies outside.
    inner = slice(20, -20)
    assert np.allclose(wave.reflectance[:, inner], expected[:, inner], rtol=2e-3)
    assert np.array_equal(wave.components["air"], wave.components["first"])
