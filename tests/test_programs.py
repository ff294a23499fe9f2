"""Compiled programs: one for each shape, a bounded number of them, shared by threads."""

import concurrent.futures
import json
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlidar._programs import Program


class Counted:
    """A function that counts how often it is traced."""

    def __init__(self):
        self.times = 0

    def __call__(self, x, scale=1.0):
        self.times += 1
        return {"twice": 2 * scale * x, "name": "a name", "size": x.size}


def test_one_program_for_each_structure_shape_and_type():
    counted = Counted()
    program = Program(counted)
    for _ in range(2):
        found = program(jnp.arange(3.0))
        assert (found["name"], found["size"]) == ("a name", 3)
        np.testing.assert_array_equal(found["twice"], [0.0, 2.0, 4.0])
    assert counted.times == 1
    program(jnp.arange(4.0))
    program(jnp.arange(3))
    program(jnp.arange(3.0), scale=2.0)
    program(jnp.arange(3.0), scale=jnp.array(2.0))
    assert counted.times == 5
    assert float(program(jnp.arange(3.0), scale=3.0)["twice"][1]) == 6.0
    assert counted.times == 6
    # NumPy's arrays and scalars are arrays.
    for scale in (4.0, 5.0):
        for kind in (np.float32, lambda x: np.array(x, np.float32)):
            found = program(jnp.arange(3.0), scale=kind(scale))
            assert float(found["twice"][1]) == 2 * scale
    assert counted.times == 7


def test_the_oldest_programs_are_forgotten():
    counted = Counted()
    program = Program(counted, most=3)
    for n in (1, 2, 3, 1, 4):
        program(jnp.zeros(n))
    assert (counted.times, len(program.versions)) == (4, 3)
    program(jnp.zeros(1))
    assert counted.times == 4
    program(jnp.zeros(2))
    assert counted.times == 5


def test_arguments_given_once_share_the_program():
    counted = Counted()
    program = Program(counted)
    program.begin(x=jnp.arange(3.0), scale=jnp.array(2.0))
    for kept, other in (("scale", "x"), ("x", "scale")):
        arguments = {"x": jnp.arange(3.0), "scale": jnp.array(2.0)}
        bound = program.given(**{kept: arguments[kept]})
        for factor in (1.0, 3.0):
            found = bound(**{other: factor * arguments[other]})
            np.testing.assert_array_equal(found["twice"], factor * np.array([0.0, 4.0, 8.0]))
    assert (counted.times, len(program.versions)) == (1, 1)
    slope = jax.grad(lambda scale: program.given(x=jnp.arange(3.0))(scale=scale)["twice"].sum())
    assert float(slope(2.0)) == 6.0


def test_threads_wait_for_one_compilation():
    counted = Counted()
    program = Program(counted)
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        results = list(pool.map(lambda n: program(jnp.full(5, float(n)))["twice"][0], range(32)))
    assert counted.times == 1
    assert [float(r) for r in results] == [2.0 * n for n in range(32)]


def test_within_a_transformation_it_is_the_function():
    program = Program(lambda x: x**2)
    assert float(jax.grad(program)(3.0)) == 6.0
    assert float(jax.jit(program)(3.0)) == 9.0
    assert not program.versions
    assert isinstance(program(jnp.ones(2)), jax.Array)
    assert eqx.tree_equal(jax.vmap(program)(jnp.arange(3.0)), jnp.array([0.0, 1.0, 4.0]))


SHAPES = """
import json, resource
import jax, numpy as np
import jaxlidar as jl

SIZES = {"n_photons": 800, "n_rays": 64, "max_orders": 2, "window": (-90.0, 20.0)}

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 1e6

used = []
for n in range(100):
    lad = np.full((4, 4, 3 + n), 0.05)
    voxels = jl.VoxelMap.from_lad(lad, voxel_size=0.1, origin=(-0.2, -0.2, 0))
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4))
    scene = jl.Scene(canopy=canopy, ground=jl.Ground())
    jl.simulate(jl.Lidar(), scene, key=jax.random.key(n), **SIZES)
    used.append(resident())
print(json.dumps(used))
"""


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_resident_memory_levels_off_over_a_hundred_shapes():
    done = subprocess.run([sys.executable, "-c", SHAPES], capture_output=True, text=True, check=True)
    used = json.loads(done.stdout)
    assert used[-1] - used[49] < 0.25 * (used[24] - used[0]) + 60.0, used


def test_a_program_that_has_begun_is_compiled_once():
    """Its shapes are known at once, also those that follow from shapes; a call waits for it."""
    counted, after = Counted(), Counted()
    first, second = Program(counted), Program(lambda found: after(found["twice"]))
    shapes = first.begin(jnp.arange(3.0))
    assert shapes["twice"].shape == (3,)
    assert (shapes["name"], shapes["size"]) == ("a name", 3)
    assert second.begin(shapes)["twice"].dtype == jnp.float32
    assert second.begin(shapes)["size"] == 3
    assert not first.is_compiled(jnp.arange(3.0))
    np.testing.assert_array_equal(second(first(jnp.arange(3.0)))["twice"], [0.0, 4.0, 8.0])
    assert (counted.times, after.times) == (1, 1)
    assert first.is_compiled(jnp.arange(3.0))
    assert not first.is_compiled(jnp.arange(4.0))


def test_precision_of_a_program_that_has_begun_is_the_callers():
    program = Program(Counted())
    with jax.enable_x64(True):
        assert program.begin(np.float64(1.0) + jnp.zeros(2))["twice"].dtype == jnp.float64
        assert program(jnp.ones(2))["twice"].dtype == jnp.float64
    assert program(jnp.ones(2))["twice"].dtype == jnp.float32


def test_what_fails_in_a_program_that_has_begun_fails_where_it_is_called():
    def refuse(x):
        raise ValueError("no such value")

    with pytest.raises(ValueError, match="no such value"):
        Program(refuse).begin(jnp.zeros(2))
