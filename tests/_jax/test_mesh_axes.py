"""Simulations on two devices: within `jax.shard_map`, and on meshes with explicit axes.

They run in a process of their own, with two devices that XLA makes of the host's processor. Values are
compared with those of one device. Types are checked while JAX traces, which compiles nothing.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

START = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec as P
import jaxlidar as jl

assert len(jax.devices()) == 2
KEY, LIDAR = jax.random.key(0), jl.Lidar(zenith=ZENITH)
LADS = np.stack([np.full((4, 4, 4), 0.3, np.float32), np.full((4, 4, 4), 0.6, np.float32)])


def scene_of(lad, hotspot=False):
    voxels = jl.VoxelMap.from_lad(lad, voxel_size=1.0, origin=(-2.0, -2.0, 0.0))
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.3), hotspot=hotspot)
    return jl.Scene(canopy=canopy, ground=GROUND, plates=(jl.Plate(2.5, 0.3, 0.2),))


# Within a program the scene is made of traced arrays, also the heights of terrain that is a plane.
EFFECTS = {"relief": True} if isinstance(scene_of(LADS[0]).ground, jl.Terrain) else None
PLAN = jl.plan(LIDAR, scene_of(LADS[0]), n_photons=512, n_rays=64, max_orders=ORDERS, effects=EFFECTS)


def simulated(lad, key=KEY):
    return jl.simulate(LIDAR, scene_of(lad), key=key, plan=PLAN)


def total(lad):
    return simulated(lad).reflectance.sum()


mesh = jax.make_mesh((2,), ("shots",), axis_types=(AxisType[AXES],))
sharded = NamedSharding(mesh, P("shots"))
"""

WITHIN_SHARD_MAP = """
def one_per_device(function):
    return jax.shard_map(
        lambda *args: jax.tree.map(lambda a: a[None], function(*(a[0] for a in args))),
        mesh=mesh, in_specs=P("shots"), out_specs=P("shots"),
    )


keys = jax.random.split(KEY, 2)
with jax.set_mesh(mesh):
    lads, keys = jax.device_put((jnp.asarray(LADS), keys), sharded)
    jax.eval_shape(one_per_device(simulated), lads)
    if ONLY_VALUES:
        raise SystemExit
    jax.eval_shape(one_per_device(simulated), lads, keys)
    jax.eval_shape(one_per_device(lambda key: simulated(LADS[0], key)), keys)
    jax.eval_shape(one_per_device(jax.grad(total)), lads)
    jax.eval_shape(one_per_device(lambda lad: jax.jvp(total, (lad,), (lad,))), lads)
"""

VALUES_WITHIN_SHARD_MAP = (
    WITHIN_SHARD_MAP
    + """
    values = jax.jit(one_per_device(total))(lads)
for value, lad in zip(values, LADS):
    np.testing.assert_allclose(value, jax.jit(total)(lad), rtol=1e-5)
"""
)

# Several keys on each device, whose mean is that over all devices.
KEYS_WITHIN_SHARD_MAP = """
def mean(lad, keys):
    return jnp.mean(jax.vmap(lambda key: simulated(lad, key).reflectance.sum())(keys))


def mean_over_devices(lad, keys):
    return jax.shard_map(
        lambda lad, keys: jax.lax.pmean(mean(lad, keys), "shots"),
        mesh=mesh, in_specs=(P(), P("shots")), out_specs=P(),
    )(lad, keys)


def derivatives(mean):
    def gradient_and_tangent(lad, keys):
        push = jax.jvp(lambda lad: mean(lad, keys), (lad,), (lad,))
        return jax.grad(mean)(lad, keys), push

    return gradient_and_tangent


lad, keys = jnp.asarray(LADS[0]), jax.random.split(KEY, 4)
on_two = jax.jit(derivatives(mean_over_devices))(lad, jax.device_put(keys, sharded))
on_one = jax.jit(derivatives(mean))(lad, keys)
for a, b in zip(jax.tree.leaves(on_two), jax.tree.leaves(on_one)):
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)
assert np.abs(on_one[0]).max() > 1e-3
"""

UNDER_VMAP = """
lads = jax.device_put(jnp.asarray(LADS), sharded)
for function in (simulated, jax.grad(total)):
    shapes = jax.eval_shape(jax.vmap(function), lads)
    with jax.set_mesh(mesh):
        assert jax.tree.all(jax.tree.map(
            lambda a, b: a.shape == b.shape, jax.eval_shape(jax.vmap(function), lads), shapes
        ))
"""

VALUES_UNDER_VMAP = (
    UNDER_VMAP
    + """
# NumPy indexes an array that is divided among devices; JAX does not say where the result would lie.
values = np.asarray(jax.jit(jax.vmap(total))(lads))
for value, lad in zip(values, LADS):
    np.testing.assert_allclose(value, jax.jit(total)(lad), rtol=1e-5)
# One simulation whose voxels are divided among the devices.
np.testing.assert_allclose(jax.jit(total)(jax.device_put(LADS[0], sharded)), values[0], rtol=1e-5)
"""
)

TERRAIN = "jl.Terrain(np.linspace(0.0, 1.0, 100).reshape(10, 10), spacing=10.0, origin=(-45.0, -45.0))"


def run_on_two_devices(code, axes, orders=1, zenith=0.0, ground="jl.Ground(slope=3.0)", *, only_values=False):
    settings = f"AXES, ORDERS, ZENITH, ONLY_VALUES = {axes!r}, {orders}, {zenith}, {only_values}\n"
    start = START.replace("ground=GROUND", f"ground={ground}")
    environment = os.environ | {
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2",
        "PYTHONPATH": str(Path(__file__).resolve().parents[1]),
    }
    arguments = [sys.executable, "-W", "ignore", "-c", settings + start + code]
    process = subprocess.run(arguments, env=environment, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr[-2000:]


def test_a_simulation_within_shard_map():
    run_on_two_devices(WITHIN_SHARD_MAP, "Auto", orders=2, only_values=True)


@pytest.mark.slow
def test_derivatives_of_many_keys_within_shard_map():
    run_on_two_devices(KEYS_WITHIN_SHARD_MAP, "Auto", orders=2)


@pytest.mark.slow
@pytest.mark.parametrize("axes", ["Explicit", "Auto"])
def test_the_first_order_within_shard_map(axes):
    run_on_two_devices(VALUES_WITHIN_SHARD_MAP, axes)


@pytest.mark.slow
def test_the_first_order_with_explicit_axes():
    run_on_two_devices(VALUES_UNDER_VMAP, "Explicit")


@pytest.mark.slow
@pytest.mark.parametrize("case", [{}, {"zenith": 20.0}, {"ground": TERRAIN}], ids=str)
def test_all_orders_within_shard_map(case):
    run_on_two_devices(WITHIN_SHARD_MAP, "Explicit", orders=3, **case)


@pytest.mark.slow
def test_all_orders_with_explicit_axes():
    run_on_two_devices(UNDER_VMAP, "Explicit", orders=3)
