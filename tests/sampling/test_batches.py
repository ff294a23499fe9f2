"""Batches: each is the trace of its own key, whatever programs it is traced by."""

import importlib

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.trace import batches
from jaxlidar.trace.colouring import total_and_balance
from jaxlidar.trace.response import trace_setting
from tests.helpers import with_applied_optics

# The package's name `simulate` is the function.
simulation = importlib.import_module("jaxlidar.simulate")
KEY = jax.random.key(7)
LIDAR = jl.Lidar(divergence=2.0, wavelength=(532.0, 1064.0))
VOXELS = jl.VoxelMap.from_lad(np.full((2, 2, 3), 0.6), voxel_size=1.0, origin=(-1, -1, 2))


def scene(**canopy):
    leaf = jl.LeafOptics(reflectance=0.4, transmittance=0.3)
    return jl.Scene(
        canopy=jl.Canopy(VOXELS, leaf=leaf, **canopy), ground=jl.Ground(reflectance=0.4, slope=5.0)
    )


def same(plan):
    return plan


@pytest.mark.parametrize(
    ("orders", "transmission", "change"),
    [(1, "diffuse", same), (2, "diffuse", same), (2, "straight", same), (2, "diffuse", with_applied_optics)],
    ids=["one order", "two orders", "straight", "optics applied"],
)
def test_a_batch_is_the_trace_of_its_key(orders, transmission, change):
    crown = scene(transmission=transmission)
    plan = jl.plan(LIDAR, crown, max_orders=orders, n_photons=256, n_rays=64, window=(-50.0, 20.0))
    ready = simulation._prepared(jl.reduce(LIDAR, crown, change(plan)), KEY)
    batch, trace = batches.batch_of(ready, KEY), eqx.filter_jit(trace_setting)
    found, known = batch(3)
    expected = trace(ready.setting, ready.transmittance, jax.random.fold_in(KEY, 3))
    total, balance = total_and_balance(expected, ready.brief)

    def differ(a, b):
        return np.max(np.abs(np.asarray(a) - np.asarray(b))) / np.max(np.abs(np.asarray(b)))

    assert jax.tree.structure(found) == jax.tree.structure(expected)
    # Of 256 photons one, at an edge, may round to another side.
    assert differ(known.total, total) < 2e-3
    other = total_and_balance(batch(2)[0], ready.brief)[0]
    assert differ(other, total) > 1e-2
    assert set(known.names) == set(balance.ledger)
    for name, row in zip(known.names, known.ledger):
        np.testing.assert_allclose(row, balance.ledger[name], atol=2e-3)
    np.testing.assert_allclose(known.neglected, balance.neglected, atol=2e-3)


def test_traces_begin_to_compile_before_the_record_is_made(monkeypatch):
    """What takes longest begins first, in another thread."""
    batches._compiled_higher.versions.clear()
    make, begun = simulation.recording_with_room, []

    def recording(setup):
        begun.extend(version.ahead for version in batches._compiled_higher.versions.values())
        return make(setup)

    monkeypatch.setattr(simulation, "recording_with_room", recording)
    crown = scene()
    # A scene that has not been simulated before: its setting, too, has yet to be compiled.
    plan = jl.plan(LIDAR, crown, max_orders=3, n_photons=96, n_rays=64, window=(-50.0, 20.0))
    simulation._prepared(jl.reduce(LIDAR, crown, plan), KEY)
    (ahead,) = begun
    assert ahead is not None
