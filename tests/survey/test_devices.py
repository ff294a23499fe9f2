"""Surveys on several devices of one process: XLA makes them of the host's processor."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxlidar as jl
from tests.survey.test_simulate_many import FAST, KEY, nadir, stand

REPOSITORY = Path(__file__).resolve().parents[2]
# Surveys, how they are simulated, and how many devices have work to do.
SURVEYS = {
    "per shot": (nadir(32), FAST | {"shared": False}, 4),
    "shared": (jl.Survey.grid(nadir(1).lidar, (-20, -20), (20, 20), 4.0), {"rtol": 0.1, "max_orders": 2}, 2),
}
ON_FOUR_DEVICES = """
import sys

import jax

jax.config.update("jax_num_cpu_devices", 4)
from tests.quick_compilation import optimise_programs

# As in the process that compares: options of the compiler change the last bits of results.
optimise_programs()

import jaxlidar as jl
from jaxlidar.survey import per_shot, shared_illumination
from tests.survey.test_simulate_many import KEY, stand
from tests.survey.test_devices import SURVEYS

assert len(jax.devices()) == 4
mesh, used = jax.make_mesh((2, 2), ("x", "y")), set()


def record_devices(program):
    def recording(*arguments):
        result = program(*arguments)
        used.update(*(a.devices() for a in jax.tree.leaves(result)))
        return result

    return recording


per_shot.compiled_shots = record_devices(per_shot.compiled_shots)
shared_illumination.compiled_group_moments = record_devices(shared_illumination.compiled_group_moments)
for name, (survey, options, n_busy) in SURVEYS.items():
    used.clear()
    waveforms = jl.simulate_many(survey, stand(), key=KEY, mesh=mesh, **options)
    assert len(used) == n_busy, (name, used)
    assert waveforms.info["shared"] is (name == "shared")
    waveforms.save(f"{sys.argv[1]}/{name}.nc")
"""


@pytest.mark.slow
def test_devices_of_a_mesh_trace_the_same_waveforms(tmp_path):
    subprocess.run([sys.executable, "-c", ON_FOUR_DEVICES, str(tmp_path)], check=True, cwd=REPOSITORY)
    for name, (survey, options, _) in SURVEYS.items():
        on_one = jl.simulate_many(survey, stand(), key=KEY, **options)
        on_four = jl.Waveforms.open(tmp_path / f"{name}.nc")
        assert np.array_equal(on_four.reflectance, on_one.reflectance), name
        assert np.array_equal(on_four.stderr, on_one.stderr), name
