"""Derivatives of the optical depth of a ray by its direction and its length, against finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.trace.march.voxel_traversal import make_medium, march_to_depths, occupied_box

RAYS, STEP = 500, 1e-7


@pytest.mark.parametrize("sides", ["open", "periodic"])
@pytest.mark.parametrize("angles", ["spherical", "erectophile"])
def test_slopes_agree_with_differences(angles, sides):
    random = np.random.default_rng(0)
    density = random.uniform(0.0, 1.0, (6, 7, 5))
    density[0] = 0.0  # rays leave the occupied voxels before the map
    with jax.enable_x64(True):
        voxels = jl.VoxelMap.from_lad(
            density, voxel_size=(1.0, 1.3, 0.9), origin=(-3.0, -4.0, 0.0), leaf_angles=angles
        )
        medium = make_medium(jl.Canopy(voxels, leaf=jl.Prospect(), sides=sides), jnp.zeros(3))
        x = tuple(jnp.asarray(random.uniform(low, high, RAYS)) for low, high in ((-6, 6), (-6, 6), (-2, 7)))
        w = random.normal(size=(3, RAYS))
        w = jnp.asarray(w / np.linalg.norm(w, axis=0))
        length, active = jnp.asarray(random.uniform(0.5, 15.0, RAYS)), jnp.ones(RAYS, bool)

        @jax.jit
        def march(w, length):
            targets, box = jnp.zeros((0, RAYS)), occupied_box(medium)
            return march_to_depths(medium, x, tuple(w), targets, length, active, 200, box, by_path=True)

        def difference(dw, dl):
            ends = (march(w + s * dw, length + s * dl).total_depth for s in (STEP, -STEP))
            return (next(ends) - next(ends)) / (2.0 * STEP)

        slopes = march(w, length).path_slopes
        for i in range(3):
            turned = difference(jnp.eye(3)[i][:, None], 0.0)
            assert np.ptp(turned) > 1.0
            # Of a ray that crosses a face within the step the difference is another.
            error = np.abs(slopes.direction[i] - turned) / (1.0 + np.abs(turned))
            assert np.quantile(error, 0.99) < 1e-6
        error = np.abs(slopes.length - difference(jnp.zeros((3, 1)), 1.0))
        assert np.quantile(error, 0.99) < 1e-6
