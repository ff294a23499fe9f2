"""Faults planted in the core, each of which tests of the default run reject. Long: `-m slow`.

A copy of the packages gets one fault: a factor of 1.005, half a bin, a sign, swapped axes, a missing 1/2. The
tests that are named with it run against the copy, and one of them has to fail. The text that a fault replaces
occurs exactly once; where a change of the code removes it, the fault has to be planted anew.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]


class Fault(NamedTuple):
    """A file of `jaxlidar`, the text that is replaced in it, and the tests that have to notice."""

    path: str
    text: str
    wrong_text: str
    tests: str


FAULTS = {
    "reflection of facets, 1.005": Fault(
        "optics/facets.py",
        "return 2.0 / (3.0 * np.pi)",
        "return 2.01 / (3.0 * np.pi)",
        "optics/test_facets.py",
    ),
    "transmission of facets, 1.005": Fault(
        "optics/facets.py",
        "return facet_reflection(-cos_angle)",
        "return 1.005 * facet_reflection(-cos_angle)",
        "optics/test_facets.py",
    ),
    "forward and backward of a phase function": Fault(
        "optics/phase.py", "2.0 * g * (1.0 - cosine)", "2.0 * g * (1.0 + cosine)", "optics/test_laws.py"
    ),
    "a missing 1/2 in the angle of an equal-angle lobe": Fault(
        "optics/laws.py", "jnp.cos(0.5 * np.pi * u)", "jnp.cos(np.pi * u)", "optics/test_laws.py"
    ),
    "an aspect to the west for one to the east": Fault(
        "scenes/shapes.py",
        "jnp.stack([jnp.sin(s) * jnp.sin(a)",
        "jnp.stack([-jnp.sin(s) * jnp.sin(a)",
        "trace/test_ground.py",
    ),
    "a beam to the west for one to the east": Fault(
        "sensors/lidar.py",
        "jnp.stack([horizontal * jnp.sin(azimuth)",
        "jnp.stack([-horizontal * jnp.sin(azimuth)",
        "trace/test_ground.py",
    ),
    "the derivative by parameters of laws again where landings move": Fault(
        "trace/device_scene.py",
        "laws = jax.tree.map(jax.lax.stop_gradient, self.laws)",
        "laws = self.laws",
        "optics/test_laws.py",
    ),
    "paths in and out exchanged for the hot spot": Fault(
        "trace/first/first_order.py",
        "self.kappa = 1.0 if scene.config.hotspot else 2.0",
        "self.kappa = 2.0 if scene.config.hotspot else 1.0",
        "trace/test_slab_first_order.py",
    ),
    "half a bin": Fault(
        "trace/march/ray_segments.py",
        "jnp.minimum(first_number + 0.5, end_position)",
        "jnp.minimum(first_number + 1.0, end_position)",
        "trace/test_slab_first_order.py",
    ),
    "deposits half a bin late": Fault(
        "trace/deposit.py",
        "(position) - 0.5 * (KERNEL_BINS - 1)",
        "(position) - 0.5 * KERNEL_BINS",
        "trace/test_deposits.py",
    ),
    "a missing 1/2 in the radius of a Gaussian beam": Fault(
        "trace/first/footprint.py", "jnp.asarray(x / 2)", "jnp.asarray(x)", "trace/test_ground.py"
    ),
    "one way for two in the time of a surface": Fault(
        "trace/first/first_order.py",
        "time = 2.0 * (excess",
        "time = 1.0 * (excess",
        "trace/test_ground.py",
    ),
    "swapped axes of voxels": Fault(
        "trace/march/voxel_traversal.py",
        "return (i * along_y + j) * along_z",
        "return (j * along_y + i) * along_z",
        "trace/test_ray_segments.py trace/test_invariance.py",
    ),
    "reflection and transmission weighted the wrong way round": Fault(
        "trace/photons/collisions.py",
        "jnp.where(through, 1.0 / (1.0 - q), 1.0 / q)",
        "jnp.where(through, 1.0 / q, 1.0 / (1.0 - q))",
        "trace/test_slab_all_orders.py",
    ),
    "optical depth drawn 1.005 too long": Fault(
        "trace/march/flight.py",
        "scene.medium, -jnp.log(u)",
        "scene.medium, -1.005 * jnp.log(u)",
        "simulation/test_energy.py",
    ),
    "a wider pulse, 1.005": Fault(
        "sensors/pulse.py",
        "_FWHM_PER_SIGMA = 2 *",
        "_FWHM_PER_SIGMA = 1.99 *",
        "sensors/test_pulse.py",
    ),
    "air on one way only": Fault(
        "scenes/atmosphere.py",
        "jnp.exp(-2 * self.optical_depth",
        "jnp.exp(-self.optical_depth",
        "scenes/test_atmosphere.py",
    ),
    "energy, 1.005": Fault(
        "spectral/waveform.py",
        "lidar.aperture_area / (jnp.pi",
        "1.005 * lidar.aperture_area / (jnp.pi",
        "trace/test_ground.py",
    ),
    "a plate that absorbs more, 1.005": Fault(
        "optics/plate_model.py",
        "absorbed = omega / q",
        "absorbed = 1.005 * omega / q",
        "optics/test_prospect.py",
    ),
}


def run_tests(folder: Path, tests: str) -> subprocess.CompletedProcess:
    """Run tests against the packages in `folder`, until the first failure."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
    command += [f"tests/{name}" for name in tests.split()]
    environment = os.environ | {"PYTHONPATH": str(folder)}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def copied(tmp_path_factory) -> Path:
    """A copy of packages and tests."""
    folder = tmp_path_factory.mktemp("planted") / "copy"
    ignored = shutil.ignore_patterns("__pycache__")
    for name in ("jaxlidar", "inversion", "tests", "examples"):
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


@pytest.mark.parametrize("name", FAULTS)
def test_the_text_of_a_fault_occurs_once(name):
    fault = FAULTS[name]
    assert (ROOT / "jaxlidar" / fault.path).read_text().count(fault.text) == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_fails_a_test(name, copied):
    fault = FAULTS[name]
    path = copied / "jaxlidar" / fault.path
    source = path.read_text()
    path.write_text(source.replace(fault.text, fault.wrong_text))
    try:
        result = run_tests(copied, fault.tests)
    finally:
        path.write_text(source)
    # 1: tests failed. Any other status is an error of this test.
    assert result.returncode == 1, result.stdout[-2000:] + result.stderr[-2000:]
    assert " failed" in result.stdout
    assert " error" not in result.stdout.rsplit("\n", 2)[-2]


@pytest.mark.slow
def test_without_a_fault_these_tests_pass(copied):
    tests = sorted({name for fault in FAULTS.values() for name in fault.tests.split()})
    result = run_tests(copied, " ".join(tests))
    assert result.returncode == 0, result.stdout[-2000:]
