"""Shared by the tests: slabs, lidars that record a whole waveform as one sample, batches and z-tests."""

from collections.abc import Callable, Iterable
from typing import Any

import jax
import numpy as np
import pytest
from jaxtyping import Array, PRNGKeyArray

import jaxlidar as jl
from jaxlidar.extend import side_by_side
from jaxlidar.sampling.batch_programs import make_batch_tracer


def slow_unless(chosen: Iterable, names: Iterable) -> list:
    """Parameters of a test, tuples of several, of which those that are not chosen are left to `-m slow`."""
    chosen = list(chosen)

    def one(x: Any) -> Any:
        values = x if isinstance(x, tuple) else (x,)
        return pytest.param(*values, marks=() if x in chosen else pytest.mark.slow)

    return [one(x) for x in names]


# Double precision is left to `-m slow`.
NARROW = pytest.mark.parametrize("precision", slow_unless(["float32"], ["float32", "float64"]), indirect=True)

# One sample of 1000 ns centred on 400 ns takes in everything that arrives from -100 to 900 ns.
WHOLE = {"window": (400.0, 401.0), "bin_width": 2.0}


def whole_lidar(**changes: Any) -> jl.Lidar:
    """A lidar 400 km up, of narrow beam, that records one sample of 1000 ns (see `WHOLE`).

    The sum of a waveform then has a standard error of its own, where those of its samples would have to be
    added with their correlations. From this height every way back to the sensor is vertical.
    """
    return jl.Lidar(**({"altitude": 4e5, "divergence": 1e-3, "sampling_interval": 1000.0} | changes))


def slab(
    leaf: float | None = None,
    bark: float | None = None,
    *,
    thickness: float = 10.0,
    width: float = 40.0,
    shape: tuple[int, int, int] = (1, 1, 4),
    origin: tuple[float, float, float] = (-20.0, -20.0, 0.0),
) -> jl.VoxelMap:
    """A homogeneous slab of vertical optical depths `leaf` and `bark` (None: not there) on z = 0."""
    size = (width / shape[0], width / shape[1], thickness / shape[2])

    def fill(depth: float | None) -> np.ndarray | None:
        return None if depth is None else np.full(shape, depth / thickness)

    return jl.VoxelMap.from_extinction(leaf=fill(leaf), bark=fill(bark), voxel_size=size, origin=origin)


def agrees(value: Any, stderr: Any, expected: Any, *, bound: Any = 0.0, sigmas: float = 3.0) -> bool:
    """z-test: whether all of `value` lie within `sigmas` standard errors of `expected`.

    `bound` is what the expected value may exceed the simulated one by: the orders that were neglected.
    """
    off, margin = np.asarray(value, float) - np.asarray(expected, float), sigmas * np.asarray(stderr, float)
    return bool(np.all(off <= margin) and np.all(off >= -margin - np.asarray(bound, float)))


def applied(plan: jl.Plan) -> jl.Plan:
    """The plan where optics are applied while light is traced."""
    return plan.with_config(keeps_histories=False, degree=0)


def one_batch(setup: jl.Setup, key: PRNGKeyArray) -> jl.Waveform:
    """The waveform of a single batch, by the programs that `simulate` compiles."""
    tracer = make_batch_tracer(setup, key)
    response = tracer.batch_function(key)(0)[0] if setup.plan.is_random else tracer.trace(key)
    return tracer.waveform(response, 1)


def first_wave(lidar: jl.Lidar, scene: jl.Scene, plan: jl.Plan) -> jl.Waveform:
    """One trace, for what is not random."""
    assert not plan.is_random
    return one_batch(jl.make_setup(lidar, scene, plan), jax.random.key(0))


def batch_mean(
    lidar: jl.Lidar,
    scene: jl.Scene,
    plan: jl.Plan,
    *,
    seed: int,
    count: int = 32,
    quantity: Callable[[jl.Waveform], Any],
) -> tuple[Any, Any]:
    """Mean and standard error, over batches, of any quantity of a waveform (an array or a tree)."""
    setup = jl.make_setup(lidar, scene, plan)
    with side_by_side() as run:
        waves = run(lambda key: one_batch(setup, key), jax.random.split(jax.random.key(seed), count))
        found = [quantity(jax.tree.map(np.asarray, wave)) for wave in waves]

    def gather(*each: Array) -> np.ndarray:
        return np.stack([np.asarray(e, float) for e in each])

    table = jax.tree.map(gather, *found)
    mean = jax.tree.map(lambda t: t.mean(axis=0), table)
    return mean, jax.tree.map(lambda t: t.std(axis=0, ddof=1) / np.sqrt(count), table)
