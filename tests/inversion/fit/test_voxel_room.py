"""Fits give voxel maps room for more voxels, so that maps share programs. No value changes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion.fit.model import SimulationInputs, evaluate_scene
from inversion.fit.unknowns import bind_unknowns

# Set as they are, with their derivatives by the trace.
UNKNOWNS = [
    inversion.Unknown("ground.height", bounds=(-1.0, 1.0)),
    inversion.Unknown("canopy.voxels.origin", bounds=(-10.0, 10.0)),
    inversion.Unknown("ground.reflectance", bounds=(0.0, 1.0)),
]


def inputs_of(sides, unknowns=UNKNOWNS):
    density = np.random.default_rng(0).uniform(0.1, 0.8, (5, 6, 7))
    voxels = jl.VoxelMap.from_lad(density, voxel_size=1.0, origin=(-2.5, -3.0, 1.0))
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.3), hotspot=False, sides=sides)
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3))
    lidar = jl.Lidar(zenith=12.0, divergence=2.0)
    plan = jl.plan(lidar, scene, max_orders=2, n_photons=512, n_rays=32, window=(-80.0, 40.0))
    bound = bind_unknowns(unknowns, scene, lidar)
    setters = tuple(u.setter._replace(dependence="geometric") for u in bound)
    values = tuple(u.start for u in bound)
    return SimulationInputs(lidar, scene, plan, setters, tangents_per_pass=5), values


def waveform(inputs, values):
    def simulate(inputs, values):
        setup = inputs.setup(values)
        return jl.total_reflectance(jl.trace_scene(setup, jax.random.key(0)), setup)

    return np.asarray(jax.jit(simulate)(inputs, values))


def assert_close(actual, expected):
    np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-6 * np.max(np.abs(expected)))


def test_room_for_voxels_changes_no_value():
    """The planted fault, the numbers of voxels of the tables, is another map."""
    inputs, values = inputs_of("periodic")
    with_room = inputs.with_room()
    shape = with_room.scene.canopy.voxels.shape
    assert shape == (6, 8, 8)
    expected = waveform(inputs, values)
    assert_close(waveform(with_room, values), expected)
    wrong = dataclasses.replace(with_room, voxel_counts=np.array(shape, np.int32))
    with pytest.raises(AssertionError):
        assert_close(waveform(wrong, values), expected)


@pytest.mark.slow
@pytest.mark.parametrize("sides", ["open", "periodic"])
def test_room_for_voxels_changes_no_derivative(sides):
    inputs, values = inputs_of(sides)
    evaluate = jax.jit(evaluate_scene)
    arguments = (values, jnp.stack([jax.random.key(0)]), jnp.array(1))
    expected, actual = evaluate(inputs, *arguments), evaluate(inputs.with_room(), *arguments)
    assert np.asarray(expected[1]).any(axis=-1).all()
    for pair in zip(actual, expected):
        assert_close(*map(np.asarray, pair))


def test_unknown_voxels_get_no_room():
    inputs, _ = inputs_of("open", [inversion.Unknown("canopy.voxels.leaf", bounds=(0.0, 1.0))])
    assert inputs.with_room() is inputs
