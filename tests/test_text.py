"""Texts of numbers and objects: values where equinox prints types, and map coordinates to the metre."""

import subprocess
import sys
from importlib import metadata

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar._fields.checks import check_range
from jaxlidar._text import number_text, object_text, samples_text


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (0.1, "0.1"),
        (1 / 3, "0.333333"),
        (5234187.25, "5234187.25"),
        (-499999.5, "-499999.5"),
        (3e8, "300000000"),
        (1e-15, "1e-15"),
        (1e30, "1e+30"),
        (np.inf, "inf"),
    ],
)
def test_numbers_have_the_digits_of_map_coordinates(number, text):
    assert number_text(number) == text


def test_messages_resolve_map_coordinates():
    with pytest.raises(
        ValueError, match=r"y = 5234187\.25 is outside the admissible range \[5234100, 5234187\]"
    ):
        check_range("y", 5234187.25, 5234100.0, 5234187.0)


def test_objects_print_their_values():
    lidar = jl.Lidar(wavelength=(532.0, 1064.0), position=(512345.25, 5234187.5))
    text = str(lidar)
    assert "wavelength=[532, 1064]" in text
    assert "position=[512345.25, 5234187.5]" in text
    assert "pulse=GaussianPulse(fwhm=6)" in text
    voxels = jl.VoxelMap.from_lad(np.full((4, 3, 2), 0.4), voxel_size=1.0)
    scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.Prospect()), ground=jl.Ground(height=2.5))
    text = str(scene)
    assert "leaf=4 x 3 x 2 values from 0.2 to 0.2" in text
    assert "height=2.5" in text
    survey = jl.Survey.grid(lidar, low=(0, 0), high=(20, 10), spacing=10.0)
    assert str(survey).startswith(
        "Survey of 6 shots: x 0 to 20 m, y 0 to 10 m, zenith 0 to 0 degrees\nLidar("
    )
    assert str(jl.grow(jl.shrub())).startswith("Tree of ")
    for printed in (str(lidar), text, str(survey)):
        assert "f32[" not in printed
        assert max(map(len, printed.splitlines())) <= 100


def test_one_sample_has_no_interval():
    assert samples_text(np.array([5.0])) == "1 sample at 5 ns"
    assert samples_text(np.array([5.0, 5.5, 6.0])) == "3 samples of 0.5 ns from 5 ns"


def test_traced_values_print_as_tracers():
    texts = []

    def f(height):
        texts.append(object_text(jl.Ground(height=height)))
        return height

    jax.jit(f)(1.0)
    assert "Ground" in texts[0]


def test_the_package_has_a_version_and_runs_as_a_module():
    assert jl.__version__ in (metadata.version("jaxlidar"), "not installed")
    command = [sys.executable, "-m", "jaxlidar", "--version"]
    process = subprocess.run(command, capture_output=True, text=True, check=True)
    assert process.stdout.startswith("jaxlidar ")
