"""Campaigns on several devices of one process, as many as are forced upon the host."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxlidar as jl
from tests.survey.test_simulate_many import FAST, KEY, nadir, stand

# Surveys, how they are simulated, and how many devices have work to do.
SURVEYS = {
    "apart": (nadir(32), FAST | {"shared": False}, 4),
    "shared": (jl.Survey.grid(nadir(1).lidar, (-20, -20), (20, 20), 4.0), {"rtol": 0.1, "max_orders": 2}, 2),
}
ON_FOUR_DEVICES = """
import sys

import jax

import jaxlidar as jl
from jaxlidar.survey import per_shot, shared_illumination
from tests.survey.test_simulate_many import KEY, stand
from tests.survey.test_devices import SURVEYS

assert len(jax.devices()) == 4
mesh, used = jax.make_mesh((2, 2), ("x", "y")), set()


def noting(program):
    def noted(*given):
        found = program(*given)
        used.update(*(a.devices() for a in jax.tree.leaves(found)))
        return found

    return noted


per_shot.compiled_shots = noting(per_shot.compiled_shots)
shared_illumination.compiled_group_moments = noting(shared_illumination.compiled_group_moments)
for name, (survey, how, busy) in SURVEYS.items():
    used.clear()
    many = jl.simulate_many(survey, stand(), key=KEY, mesh=mesh, **how)
    assert len(used) == busy, (name, used)
    assert many.info["shared"] is (name == "shared")
    many.save(f"{sys.argv[1]}/{name}.nc")
"""


@pytest.mark.slow
def test_devices_of_a_mesh_give_the_same(tmp_path):
    here = Path(__file__).parent
    own = {
        "XLA_FLAGS": "--xla_force_host_platform_device_count=4",
        "PYTHONPATH": os.pathsep.join([str(here), str(here.parent)]),
    }
    subprocess.run([sys.executable, "-c", ON_FOUR_DEVICES, str(tmp_path)], check=True, env=os.environ | own)
    for name, (survey, how, _) in SURVEYS.items():
        alone = jl.simulate_many(survey, stand(), key=KEY, **how)
        found = jl.Waveforms.open(tmp_path / f"{name}.nc")
        assert np.array_equal(found.reflectance, alone.reflectance), name
        assert np.array_equal(found.stderr, alone.stderr), name
