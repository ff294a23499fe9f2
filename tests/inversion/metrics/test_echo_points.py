"""Echoes of records as points, written to a LAS file and read again."""

import laspy
import numpy as np
import pytest

import inversion
from jaxlidar.io import AirborneShot, Segment, read_las, stack_shots, write_las

# m per ns of two-way travel.
DIRECTION = np.array([0.03, -0.02, -0.1455])


def recorded(index, anchor, start, *echoes, size=90):
    """Shot with Gaussian echoes, (amplitude, time), 2 ns wide, at times on its clock."""
    time = start + np.arange(size)
    samples = np.full(size, 12.0) + sum(a * np.exp(-0.5 * ((time - t) / 2.0) ** 2) for a, t in echoes)
    beam = {"anchor": np.array(anchor), "direction": DIRECTION}
    noise = {"noise_mean": 12.0, "noise_std": 0.5}
    return AirborneShot(index, **beam, **noise, returning=(Segment(samples, start),), gps_time=4e5 + index)


@pytest.fixture(scope="module")
def shots():
    return [
        recorded(0, (5e5, 4e6, 300.0), 700.0, (80.0, 730.0), (40.0, 751.5)),
        recorded(1, (5e5 + 3, 4e6, 310.0), 20.0, size=70),
        recorded(2, (5e5 + 6, 4e6, 305.0), -10.0, (150.0, 12.25), size=60),
    ]


@pytest.fixture(scope="module")
def points(shots):
    stack = stack_shots(shots)
    noise = np.where(stack.recorded, 0.5, np.inf)
    echoes = inversion.gaussian_decomposition(stack.time, stack.signal, noise=noise, width=2.0)
    with pytest.raises(ValueError, match=r"records of shape \(3,\); admissible is \(2,\)"):
        inversion.echo_points(shots[:2], echoes)
    return inversion.echo_points(shots, echoes)


def test_points_lie_at_the_planted_echoes(shots, points):
    times = [(0, 730.0), (0, 751.5), (2, 12.25)]
    expected = [shots[i].anchor + t * DIRECTION for i, t in times]
    np.testing.assert_allclose(points.position, expected, rtol=0, atol=2e-3)
    np.testing.assert_allclose(points.intensity, [80, 40, 150], rtol=1e-2)
    # Shot 1 has no echo and no point.
    np.testing.assert_array_equal(points.return_number, [1, 2, 1])
    np.testing.assert_array_equal(points.number_of_returns, [2, 2, 1])
    np.testing.assert_array_equal(points.gps_time, [4e5, 4e5, 4e5 + 2])


def test_points_are_written(points, tmp_path):
    path = tmp_path / "echoes.las"
    write_las(path, **points._asdict())
    cloud = read_las(path)
    # LAS stores coordinates in whole millimetres.
    np.testing.assert_allclose(cloud.position, points.position, rtol=0, atol=0.6e-3)
    np.testing.assert_array_equal(cloud.intensity, np.round(points.intensity))
    np.testing.assert_array_equal(cloud.return_number, points.return_number)
    np.testing.assert_array_equal(cloud.number_of_returns, points.number_of_returns)
    np.testing.assert_array_equal(np.asarray(laspy.read(path).gps_time), points.gps_time)
