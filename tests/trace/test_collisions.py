"""The direction onward of collisions with facets, against its mean in closed form.

The normal of a facet has a cosine law about -w, and light leaves by the cosine law about the normal n (or, if
it is transmitted, about -n): E[n] = -2/3 w and E[out | n] = 2/3 n, so that the mean of the direction onward
is -4/9 w for reflection and 4/9 w for transmission. Its derivative with respect to w is as simple.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.extend import vec
from jaxlidar.trace.device_scene import build_device_scene
from jaxlidar.trace.photons.collisions import sample_collision
from jaxlidar.trace.photons.random_numbers import PhotonDraws
from tests.helpers import agrees, slab

COUNT = 1 << 16


@pytest.mark.parametrize("material", ["leaf", "bark"])
def test_the_mean_direction_onward_and_its_derivative(material):
    lidar = jl.Lidar()
    canopy = {"leaf": None, "bark": None} | {material: 1.0}
    leaf = jl.LeafOptics(reflectance=0.5, transmittance=0.4) if material == "leaf" else None
    optics = {"leaf": leaf} if material == "leaf" else {"bark": 0.5}
    scene = jl.Scene(canopy=jl.Canopy(slab(**canopy), **{"hotspot": False, **optics}))
    setup = jl.make_setup(lidar, scene, jl.plan(lidar, scene, max_orders=2))
    device_scene = build_device_scene(setup, derivatives="forward")
    draws = PhotonDraws.from_numbers(list(jax.random.uniform(jax.random.key(0), (6, COUNT))), 0)

    def onward(angle):
        """Return weight times direction of every photon, for reflection and for transmission."""
        one = jnp.ones(COUNT)
        w = vec((jnp.sin(angle) * one, 0.0 * one, -jnp.cos(angle) * one))
        cell, x = jnp.zeros(COUNT, jnp.int32), vec((0.0 * one, 0.0 * one, one))
        collision = sample_collision(device_scene, x, w, cell, cell == 0, [], draws, None)
        is_reflected = collision.channel == collision.reflection
        along = jnp.stack(collision.w) * (collision.weight * collision.onward_weight)[None]
        is_reflected = jnp.broadcast_to(is_reflected[None], along.shape)
        return jnp.stack([jnp.where(is_reflected, along, 0.0), jnp.where(is_reflected, 0.0, along)])

    angle = jnp.asarray(0.4)
    value, derivative = jax.jvp(onward, (angle,), (jnp.ones(()),))
    expected = np.array([np.sin(0.4), 0.0, -np.cos(0.4)]), np.array([np.cos(0.4), 0.0, np.sin(0.4)])
    factors = (-4.0 / 9.0, 4.0 / 9.0) if material == "leaf" else (-4.0 / 9.0, 0.0)
    for number, factor in enumerate(factors):
        for samples, direction in zip((value[number], derivative[number]), expected):
            mean, stderr = samples.mean(axis=1), samples.std(axis=1) / np.sqrt(COUNT)
            assert agrees(mean, stderr + 1e-6, factor * direction, sigmas=4.0)
            # The density without its derivative.
            assert factor == 0.0 or not agrees(0.0 * mean, stderr + 1e-6, factor * direction, sigmas=4.0)
