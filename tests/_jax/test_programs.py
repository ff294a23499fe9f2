"""Compiled programs: one for each shape, a bounded number of them, shared by threads."""

import concurrent.futures
import gc
import json
import subprocess
import sys
import weakref

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlidar._jax import programs
from jaxlidar._jax.programs import Program


class CountedFunction:
    """Function that counts how often it is traced."""

    def __init__(self):
        self.n_traces = 0

    def __call__(self, x, scale=1.0):
        self.n_traces += 1
        return {"twice": 2 * scale * x, "name": "a name", "size": x.size}


def test_one_program_for_each_structure_shape_and_type():
    function = CountedFunction()
    program = Program(function)
    for _ in range(2):
        result = program(jnp.arange(3.0))
        assert (result["name"], result["size"]) == ("a name", 3)
        np.testing.assert_array_equal(result["twice"], [0.0, 2.0, 4.0])
    assert function.n_traces == 1
    program(jnp.arange(4.0))
    program(jnp.arange(3))
    program(jnp.arange(3.0), scale=2.0)
    program(jnp.arange(3.0), scale=jnp.array(2.0))
    assert function.n_traces == 5
    assert float(program(jnp.arange(3.0), scale=3.0)["twice"][1]) == 6.0
    assert function.n_traces == 6
    # Arrays and scalars of NumPy are dynamic arguments too.
    for scale in (4.0, 5.0):
        for kind in (np.float32, lambda x: np.array(x, np.float32)):
            result = program(jnp.arange(3.0), scale=kind(scale))
            assert float(result["twice"][1]) == 2 * scale
    assert function.n_traces == 7


def test_the_least_recently_used_programs_are_dropped(monkeypatch):
    monkeypatch.setattr(programs, "MAX_VERSIONS", 3)
    function = CountedFunction()
    program = Program(function)
    for n in (1, 2, 3, 1, 4):
        program(jnp.zeros(n))
    assert (function.n_traces, len(program.versions)) == (4, 3)
    program(jnp.zeros(1))
    assert function.n_traces == 4
    program(jnp.zeros(2))
    assert function.n_traces == 5


def test_dropped_programs_are_freed_at_once(monkeypatch):
    """Without a collection of garbage, which comes many programs later."""
    monkeypatch.setattr(programs, "MAX_VERSIONS", 1)
    program = Program(CountedFunction())
    program(jnp.zeros(1))
    version = weakref.ref(program.versions[0])
    gc.disable()
    try:
        program(jnp.zeros(2))
        assert version() is None
    finally:
        gc.enable()


def test_bound_arguments_share_the_program():
    function = CountedFunction()
    program = Program(function)
    program.compile_ahead(x=jnp.arange(3.0), scale=jnp.array(2.0))
    for bound_name, free_name in (("scale", "x"), ("x", "scale")):
        arguments = {"x": jnp.arange(3.0), "scale": jnp.array(2.0)}
        bound = program.bind(**{bound_name: arguments[bound_name]})
        for factor in (1.0, 3.0):
            result = bound(**{free_name: factor * arguments[free_name]})
            np.testing.assert_array_equal(result["twice"], factor * np.array([0.0, 4.0, 8.0]))
    assert (function.n_traces, len(program.versions)) == (1, 1)
    slope = jax.grad(lambda scale: program.bind(x=jnp.arange(3.0))(scale=scale)["twice"].sum())
    assert float(slope(2.0)) == 6.0


def test_threads_wait_for_one_compilation():
    function = CountedFunction()
    program = Program(function)
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        results = list(pool.map(lambda n: program(jnp.full(5, float(n)))["twice"][0], range(32)))
    assert function.n_traces == 1
    assert [float(r) for r in results] == [2.0 * n for n in range(32)]


def test_within_a_transformation_a_program_is_its_function():
    program = Program(lambda x: x**2)
    assert float(jax.grad(program)(3.0)) == 6.0
    assert float(jax.jit(program)(3.0)) == 9.0
    assert not program.versions
    assert isinstance(program(jnp.ones(2)), jax.Array)
    assert eqx.tree_equal(jax.vmap(program)(jnp.arange(3.0)), jnp.array([0.0, 1.0, 4.0]))


SIMULATE_MANY_SHAPES = """
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
    process = subprocess.run(
        [sys.executable, "-c", SIMULATE_MANY_SHAPES], capture_output=True, text=True, check=True
    )
    used = json.loads(process.stdout)
    assert used[-1] - used[49] < 0.25 * (used[24] - used[0]) + 60.0, used


def test_compilation_ahead_happens_once():
    """Shapes of results are returned at once and serve to compile the next program; a call waits for it."""
    first_function, second_function = CountedFunction(), CountedFunction()
    first_program, second_program = (
        Program(first_function),
        Program(lambda result: second_function(result["twice"])),
    )
    shapes = first_program.compile_ahead(jnp.arange(3.0))
    assert shapes["twice"].shape == (3,)
    assert (shapes["name"], shapes["size"]) == ("a name", 3)
    assert second_program.compile_ahead(shapes)["twice"].dtype == jnp.float32
    assert second_program.compile_ahead(shapes)["size"] == 3
    assert not first_program.is_compiled(jnp.arange(3.0))
    np.testing.assert_array_equal(second_program(first_program(jnp.arange(3.0)))["twice"], [0.0, 4.0, 8.0])
    assert (first_function.n_traces, second_function.n_traces) == (1, 1)
    assert first_program.is_compiled(jnp.arange(3.0))
    assert not first_program.is_compiled(jnp.arange(4.0))


def test_compilation_ahead_has_the_precision_of_the_caller():
    program = Program(CountedFunction())
    with jax.enable_x64(True):
        assert program.compile_ahead(np.float64(1.0) + jnp.zeros(2))["twice"].dtype == jnp.float64
        assert program(jnp.ones(2))["twice"].dtype == jnp.float64
    assert program(jnp.ones(2))["twice"].dtype == jnp.float32


def test_errors_of_compilation_ahead_are_raised_where_it_begins():
    def refuse(x):
        raise ValueError("no such value")

    with pytest.raises(ValueError, match="no such value"):
        Program(refuse).compile_ahead(jnp.zeros(2))
