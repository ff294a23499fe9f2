"""Tasks in threads: results in order, JAX configured as by the caller, no task started after an error."""

import os
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.extend import side_by_side
from jaxlidar.sampling import batch_programs
from jaxlidar.trace.response import join_orders
from tests.helpers import slow_unless


@pytest.mark.skipif(os.cpu_count() == 1, reason="one core has one thread")
def test_results_come_in_order_from_several_threads():
    meeting = threading.Barrier(2, timeout=30)

    def task(n):
        # The barrier opens only if two tasks run at the same time.
        if n < 2:
            meeting.wait()
        return jnp.asarray(n) ** 2

    with side_by_side(2) as run:
        assert [int(v) for v in run(task, range(9))] == [n**2 for n in range(9)]


@pytest.mark.parametrize("double", [False, True])
def test_precision_is_the_callers(double):
    with jax.enable_x64(double), side_by_side(2) as run:
        kinds = {str(v.dtype) for v in run(lambda n: jnp.ones(n + 1), range(4))}
    assert kinds == {"float64" if double else "float32"}


def test_waiting_tasks_are_dropped_after_an_error():
    started = []

    def task(n):
        started.append(n)
        if n == 0:
            raise RuntimeError("first")
        time.sleep(1.0)

    with pytest.raises(RuntimeError, match="first"), side_by_side(1) as run:
        list(run(task, range(100)))
    # A second task may have started before the error was noticed.
    assert len(started) <= 2


@pytest.mark.slow
@pytest.mark.parametrize("double", slow_unless([True], [False, True]))
def test_simulate_keeps_the_precision(double, monkeypatch):
    expected = "float64" if double else "float32"
    dtypes = []

    def recording_join(*orders):
        response = join_orders(*orders)
        # Shapes are computed ahead by tracing the function.
        if not isinstance(response.first, jax.core.Tracer):
            dtypes.append(str(response.first.dtype))
        return response

    monkeypatch.setattr(batch_programs, "join_orders", recording_join)
    with jax.enable_x64(double):
        voxels = jl.VoxelMap.from_lad(np.full((1, 1, 4), 0.2), voxel_size=2.0, origin=(-1.0, -1.0, 0.0))
        canopy = jl.Canopy(voxels, leaf=jl.Isotropic(albedo=0.8), hotspot=False)
        scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3))
        wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0), n_photons=256, max_orders=2, n_rays=64)
    assert str(wave.reflectance.dtype) == str(wave.stderr.dtype) == expected
    assert dtypes == [expected] * 8
