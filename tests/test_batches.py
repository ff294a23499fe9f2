"""Batches: each is the trace of its own key, whatever programs it is traced by."""

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.simulate import _prepared
from jaxlidar.trace.batches import batch_of
from jaxlidar.trace.response import trace_setting

KEY = jax.random.key(7)
LIDAR = jl.Lidar(divergence=2.0, wavelength=(532.0, 1064.0))
SCENE = jl.Scene(
    canopy=jl.Canopy(
        jl.VoxelMap.from_lad(np.full((2, 2, 3), 0.6), voxel_size=1.0, origin=(-1, -1, 2)),
        leaf=jl.LeafOptics(reflectance=0.4, transmittance=0.3),
    ),
    ground=jl.Ground(reflectance=0.4, slope=5.0),
)


@pytest.mark.parametrize("orders", [1, 2])
def test_a_batch_is_the_trace_of_its_key(orders):
    plan = jl.plan(LIDAR, SCENE, max_orders=orders, n_photons=256, n_rays=64, window=(-50.0, 20.0))
    ready = _prepared(jl.reduce(LIDAR, SCENE, plan), KEY)
    batch = batch_of(ready, KEY)
    found, known = batch(3)
    expected = trace_setting(ready.setting, ready.transmittance, jax.random.fold_in(KEY, 3))
    other, _ = batch(2)

    def agree(a, b):
        pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
        return all(np.allclose(x, y, rtol=1e-4, atol=1e-6) for x, y in pairs)

    assert jax.tree.structure(found) == jax.tree.structure(expected)
    assert agree(found, expected)
    assert not agree(found, other)
    assert np.all(np.isfinite(known.total))
    assert known.ledger.shape[0] == len(known.names)
