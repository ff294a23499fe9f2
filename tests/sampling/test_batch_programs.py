"""Batches: each is the trace of its own key, whatever programs it is traced by."""

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.sampling import batch_programs
from jaxlidar.spectral.apply_optics import samples_and_budget
from jaxlidar.trace.response import trace_device_scene
from tests.helpers import with_applied_optics

KEY = jax.random.key(7)
LIDAR = jl.Lidar(divergence=2.0, wavelength=(532.0, 1064.0))
VOXELS = jl.VoxelMap.from_lad(np.full((2, 2, 3), 0.6), voxel_size=1.0, origin=(-1, -1, 2))


def scene(**canopy):
    leaf = jl.LeafOptics(reflectance=0.4, transmittance=0.3)
    return jl.Scene(
        canopy=jl.Canopy(VOXELS, leaf=leaf, **{"hotspot": False, **canopy}),
        ground=jl.Ground(reflectance=0.4, slope=5.0),
    )


def same(plan):
    return plan


@pytest.mark.slow
@pytest.mark.parametrize(
    ("orders", "transmission", "change"),
    [
        (1, "diffuse", same),
        (2, "diffuse", same),
        (2, "straight", same),
        (2, "diffuse", with_applied_optics),
    ],
    ids=["one order", "two orders", "straight", "optics applied"],
)
def test_a_batch_is_the_trace_of_its_key(orders, transmission, change):
    crown = scene(transmission=transmission)
    plan = jl.plan(LIDAR, crown, max_orders=orders, n_photons=2048, n_rays=64, window=(-50.0, 20.0))
    tracer = batch_programs.make_batch_tracer(jl.make_setup(LIDAR, crown, change(plan)), KEY)
    batch, trace = tracer.batch_function(KEY), eqx.filter_jit(trace_device_scene)
    response, estimate = batch(3)
    expected = trace(tracer.scene, jax.random.fold_in(KEY, 3))
    samples, terms = samples_and_budget(expected, tracer.error_model)

    def differ(a, b):
        return np.max(np.abs(np.asarray(a) - np.asarray(b))) / np.max(np.abs(np.asarray(b)))

    assert jax.tree.structure(response) == jax.tree.structure(expected)
    # One of 256 photons, at a face, may round to the other side.
    assert differ(estimate.samples, samples) < 2e-3
    other_samples = samples_and_budget(batch(2)[0], tracer.error_model)[0]
    assert differ(other_samples, samples) > 1e-2
    assert set(estimate.budget_names) == set(terms.energy_budget)
    for name, row in zip(estimate.budget_names, estimate.budget):
        np.testing.assert_allclose(row, terms.energy_budget[name], atol=2e-3)
    np.testing.assert_allclose(estimate.unfollowed, terms.unfollowed, atol=2e-3)


@pytest.mark.slow
def test_traces_begin_to_compile_before_the_waveform_model_is_made(monkeypatch):
    """The program that takes longest begins first, in another thread."""
    batch_programs._compiled_higher.clear()
    make, compilations = batch_programs.make_padded_waveform_model, []

    def make_model(setup):
        versions = batch_programs._compiled_higher.versions
        compilations.extend(version.compilation for version in versions)
        return make(setup)

    monkeypatch.setattr(batch_programs, "make_padded_waveform_model", make_model)
    crown = scene()
    # A scene that has not been simulated before: its device scene, too, has yet to be compiled.
    plan = jl.plan(LIDAR, crown, max_orders=3, n_photons=768, n_rays=64, window=(-50.0, 20.0))
    batch_programs.make_batch_tracer(jl.make_setup(LIDAR, crown, plan), KEY)
    (compilation,) = compilations
    assert compilation is not None
