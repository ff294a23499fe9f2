"""Helpers of the tests: slabs, lidars that record a whole waveform as one sample, batches and z-tests."""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import jax
import numpy as np
import pytest
from jaxtyping import Array, PRNGKeyArray

import inversion
import jaxlidar as jl
from inversion.fit.fit_summary import CompletedFit
from inversion.fit.model import Evaluation
from inversion.fit.solver import EvaluationRequest, FitGenerator, run_fits
from jaxlidar.extend import side_by_side
from jaxlidar.planning.setup import Setup
from jaxlidar.sampling.batch_programs import make_batch_tracer


def slow_unless(chosen: Iterable, names: Iterable) -> list:
    """Return parameters of a test, of which those that are not `chosen` run with `-m slow` only.

    A tuple among `names` is the parameters of several arguments.
    """
    chosen = list(chosen)

    def parameter(case: Any) -> Any:
        values = case if isinstance(case, tuple) else (case,)
        return pytest.param(*values, marks=() if case in chosen else pytest.mark.slow)

    return [parameter(case) for case in names]


# Runs a test in single precision, and with `-m slow` in double precision as well.
BY_PRECISION = pytest.mark.parametrize(
    "precision", slow_unless(["float32"], ["float32", "float64"]), indirect=True
)

# Settings of a plan: one sample of 1000 ns centred on 400 ns, which takes in all light from -100 to 900 ns.
SINGLE_SAMPLE = {"window": (400.0, 401.0), "bin_width": 2.0}


def ask(function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Return what a function such as `inversion.retrieve` says of a problem that is made here.

    The first four arguments, and the options with names of its fields, are those of `inversion.Problem`.
    """
    fields = {field.name for field in dataclasses.fields(inversion.Problem)} & options.keys()
    problem = inversion.Problem(*arguments[:4], **{name: options.pop(name) for name in fields})
    return function(problem, *arguments[4:], **options)


def run_fit(fit: FitGenerator, simulate: Callable[[EvaluationRequest], Evaluation]) -> CompletedFit:
    """Run one fit to its end."""
    ((_, completed),) = run_fits(iter([(0, fit)]), lambda requests: {0: simulate(requests[0])}, 1)
    return completed


def single_sample_lidar(**changes: Any) -> jl.Lidar:
    """Return a lidar 400 km up, of narrow beam, that records one sample of 1000 ns (see `SINGLE_SAMPLE`).

    The sum of a waveform then has a standard error of its own; those of several samples would have to be
    added with their correlations. From this height every return path to the sensor is vertical.
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
    """Return a homogeneous slab of vertical optical depths `leaf` and `bark` (None: absent) on z = 0."""
    size = (width / shape[0], width / shape[1], thickness / shape[2])

    def fill(depth: float | None) -> np.ndarray | None:
        return None if depth is None else np.full(shape, depth / thickness)

    return jl.VoxelMap.from_extinction(leaf=fill(leaf), bark=fill(bark), voxel_size=size, origin=origin)


def agrees(value: Any, stderr: Any, expected: Any, *, bound: Any = 0.0, sigmas: float = 3.0) -> bool:
    """z-test: True if all of `value` lie within `sigmas` standard errors of `expected`.

    `bound` is the amount by which the expected value may exceed the simulated one: the neglected orders.
    """
    difference, margin = (
        np.asarray(value, float) - np.asarray(expected, float),
        sigmas * np.asarray(stderr, float),
    )
    return bool(np.all(difference <= margin) and np.all(difference >= -margin - np.asarray(bound, float)))


def with_applied_optics(plan: jl.Plan) -> jl.Plan:
    """Return the plan with optics applied while light is traced, in place of after it."""
    return plan.with_config(keeps_histories=False, degree=0)


def one_batch(setup: Setup, key: PRNGKeyArray) -> jl.Waveform:
    """Return the waveform of a single batch, by the programs that `simulate` compiles."""
    tracer = make_batch_tracer(setup, key)
    response = tracer.batch_function(key)(0)[0] if setup.plan.is_random else tracer.trace(key)
    return tracer.waveform(response, 1)


def first_wave(lidar: jl.Lidar, scene: jl.Scene, plan: jl.Plan) -> jl.Waveform:
    """Return the waveform of a plan that has nothing random, by one trace."""
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
    """Return mean and standard error, over batches, of a quantity of waveforms (an array or a tree)."""
    setup = jl.make_setup(lidar, scene, plan)
    with side_by_side() as run:
        waves = run(lambda key: one_batch(setup, key), jax.random.split(jax.random.key(seed), count))
        quantities = [quantity(jax.tree.map(np.asarray, wave)) for wave in waves]

    def stack(*batches: Array) -> np.ndarray:
        return np.stack([np.asarray(batch, float) for batch in batches])

    table = jax.tree.map(stack, *quantities)
    mean = jax.tree.map(lambda t: t.mean(axis=0), table)
    return mean, jax.tree.map(lambda t: t.std(axis=0, ddof=1) / np.sqrt(count), table)
