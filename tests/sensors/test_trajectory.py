"""Trajectories and flights: rotations, boresight and lever arm in closed form, and what is refused."""

import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.sensors.trajectory import rotation_matrix

NADIR = jl.Conical(half_angle=1e-9, frequency=1.0)
# Forward, right and down of the body in east, north and up, of a platform that heads north and is level.
FORWARD, RIGHT, DOWN = np.array([0.0, 1, 0]), np.array([1.0, 0, 0]), np.array([0.0, 0, -1])


class Sideways(jl.AbstractScan):
    """A beam that always leaves to the right, level."""

    def direction(self, time):
        return np.tile([0.0, 1.0, 0.0], (len(time), 1))


def flight(height=500.0, **attitude):
    return jl.Trajectory([0.0, 10.0], [(0, 0, height), (0, 600, height)], **attitude)


@pytest.mark.parametrize(
    ("attitude", "axes"),
    [
        ({}, (FORWARD, RIGHT, DOWN)),
        # Heading east: forward is east, right is south.
        ({"yaw": 90.0}, (RIGHT, -FORWARD, DOWN)),
        # Nose straight up: forward is up, down is ahead.
        ({"pitch": 90.0}, (-DOWN, RIGHT, FORWARD)),
        # Right wing straight down: right is down, down points to the left.
        ({"roll": 90.0}, (FORWARD, DOWN, -RIGHT)),
        # Roll first, then yaw: the wing is down wherever the nose points to.
        ({"roll": 90.0, "yaw": 90.0}, (RIGHT, DOWN, FORWARD)),
    ],
)
def test_quarter_turns_of_the_body(attitude, axes):
    rotation = jl.Trajectory([0.0], [(0, 0, 0)], **{"yaw": 0.0, **attitude}).rotation[0]
    np.testing.assert_allclose(rotation, np.stack(axes, axis=-1), atol=1e-12)


def test_rotations_keep_lengths_and_hands():
    angles = np.random.default_rng(0).uniform(-80, 80, (3, 50))
    matrices = rotation_matrix(*angles)
    np.testing.assert_allclose(
        matrices @ np.swapaxes(matrices, 1, 2), np.broadcast_to(np.eye(3), (50, 3, 3)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(matrices), 1.0)


@pytest.mark.parametrize(("roll", "pitch"), [(8.0, 0.0), (0.0, 6.0), (8.0, 6.0)])
def test_a_profiler_with_attitude_over_flat_ground(roll, pitch):
    """A beam down in the body meets level ground H tan(roll) / cos(pitch) left, H tan(pitch) ahead."""
    survey = jl.Survey.fly(flight(roll=roll, pitch=pitch), NADIR, lidar=jl.Lidar(), pulse_rate=1.0)
    offset = survey.position - survey.sensor[:, :2]
    leftwards = 500 * np.tan(np.deg2rad(roll)) / np.cos(np.deg2rad(pitch))
    forwards = 500 * np.tan(np.deg2rad(pitch))
    np.testing.assert_allclose(offset, np.tile([-leftwards, forwards], (11, 1)), atol=1e-5)
    np.testing.assert_allclose(
        survey.zenith, np.rad2deg(np.arccos(np.cos(np.deg2rad(roll)) * np.cos(np.deg2rad(pitch)))), atol=1e-6
    )
    np.testing.assert_allclose(survey.gps_time, np.arange(11.0))
    assert np.all(np.sign(survey.scan_angle) == (-1 if roll else 0)) or roll == 0


def test_mounting_angles_and_lever_arm_turn_with_the_body():
    lidar = jl.Lidar(sensor=(0, 0, 0))
    # A scanner that is mounted looking to the right, on an aircraft that heads east and rolls a little.
    survey = jl.Survey.fly(
        jl.Trajectory([0.0], [(10.0, 20.0, 30.0)], roll=30.0, yaw=90.0),
        NADIR,
        lidar=lidar,
        mounting=(-90.0, 0.0, 0.0),
        lever_arm=(1.0, 2.0, 3.0),
    )
    c, s = np.cos(np.deg2rad(30.0)), np.sin(np.deg2rad(30.0))
    # Right of the body, with its wing down, is south and down; down of the body is to the left, north.
    right, down = np.array([0.0, -c, -s]), np.array([0.0, s, -c])
    np.testing.assert_allclose(survey.direction[0], right, atol=1e-8)
    np.testing.assert_allclose(survey.sensor[0], [10, 20, 30] + np.array([1.0, 0, 0]) + 2 * right + 3 * down)


def test_a_conical_scanner_over_a_slope():
    """Beams from q along w meet the plane n . x = 0 at q - w (n . q) / (n . w)."""
    slope = np.deg2rad(20.0)
    normal = np.array([np.sin(slope), 0.0, np.cos(slope)])
    scene = jl.Scene(ground=jl.Ground(slope=20.0, aspect=90.0))
    survey = jl.Survey.fly(flight(), jl.Conical(half_angle=15.0, frequency=3.0), pulse_rate=20.0)
    points, q, w = jl.ground_position(survey, scene), survey.sensor, survey.direction
    np.testing.assert_allclose(points, q - w * ((q @ normal) / (w @ normal))[:, None], atol=2e-4)
    # A circle about each sensor on level ground.
    level = jl.ground_position(survey, jl.Scene(ground=jl.Ground(height=100.0)))
    np.testing.assert_allclose(
        np.linalg.norm((level - q)[:, :2], axis=1), 400 * np.tan(np.deg2rad(15.0)), rtol=1e-6
    )
    # The same as the shots of a line that is level and straight.
    scan = jl.Survey.scan(jl.Lidar(altitude=500.0), jl.Conical(15.0, 3.0), (0, 0), (0, 600), 60.0, 20.0)
    np.testing.assert_allclose(scan.position, survey.position, atol=1e-9)
    np.testing.assert_allclose(scan.zenith, survey.zenith)


def test_heights_above_terrain_and_strips_that_are_joined():
    heights = 50.0 + 0.1 * np.arange(0.0, 1001.0, 100.0)
    terrain = jl.Terrain(np.tile(heights, (3, 1)), spacing=100.0, origin=(-100.0, -100.0))
    strips = [flight(height=300.0), flight(height=400.0)]
    survey = jl.Survey.fly(strips, NADIR, pulse_rate=0.5, above=terrain)
    ground = 50.0 + 0.1 * (survey.position[:, 1] + 100.0)
    above = np.repeat([300.0, 400.0], 6)
    np.testing.assert_allclose(survey.altitude - ground, above, rtol=1e-5)
    assert survey.flight_line.tolist() == [1] * 6 + [2] * 6
    assert float(survey[7].altitude) == pytest.approx(survey.altitude[7])
    middle = survey[5:8]
    assert middle.flight_line.tolist() == [1, 2, 2]
    assert middle.gps_time.tolist() == [10.0, 0.0, 2.0]


def test_a_flight_has_the_scanner_of_its_lidar():
    lidar = jl.Lidar(altitude=500.0, scan=jl.Conical(half_angle=15.0, frequency=3.0))
    by_lidar = jl.Survey.fly(flight(), lidar=lidar, pulse_rate=20.0)
    by_argument = jl.Survey.fly(flight(), lidar.scan, lidar=jl.Lidar(altitude=500.0), pulse_rate=20.0)
    np.testing.assert_array_equal(by_lidar.position, by_argument.position)
    # To the right of the track is positive: east of a flight to the north.
    east = by_lidar.position[:, 0] > 1e-6
    np.testing.assert_array_equal(by_lidar.scan_angle > 1e-6, east)
    with pytest.raises(ValueError, match="scan is None"):
        jl.Survey.fly(flight())


def test_flight_lines_of_surveys_that_are_joined():
    line = {"start": (0, 0), "end": (0, 10), "speed": 50.0, "pulse_rate": 10.0}
    scans = [
        jl.Survey.scan(jl.Lidar(), NADIR, **line, gps_time=3.2e8 + number, flight_line=number)
        for number in (7, 3)
    ]
    joined = jl.Survey.join(scans)
    assert joined.flight_line.tolist() == [7] * 3 + [3] * 3
    np.testing.assert_array_equal(joined.gps_time, np.concatenate([scan.gps_time for scan in scans]))
    # Where one survey has no number, all are numbered from 1, and times are not known.
    track = jl.Survey.track(jl.Lidar(), (0, 0), (0, 10), 10.0)
    numbered = jl.Survey.join([*scans, track])
    assert numbered.flight_line.tolist() == [1] * 3 + [2] * 3 + [3] * 2
    assert numbered.gps_time is None


def test_strips_at_several_altitudes_are_joined():
    line = {"start": (0, 0), "end": (0, 10), "speed": 50.0, "pulse_rate": 10.0}
    low, high = (jl.Survey.scan(jl.Lidar(altitude=h), NADIR, **line) for h in (500.0, 700.0))
    joined = jl.Survey.join([low, high])
    assert joined.altitude.tolist() == [500.0] * 3 + [700.0] * 3
    assert [float(lidar.altitude) for lidar in joined] == joined.altitude.tolist()
    for other in (jl.Lidar(altitude=500.0, divergence=1.0), jl.Lidar(sensor=(0.0, 0.0, 500.0))):
        survey = jl.Survey(
            other, **({"sensor": [(0, 0, 1)]} if other.altitude is None else {"position": [(0, 0)]})
        )
        with pytest.raises(ValueError, match="lidar of survey 1"):
            jl.Survey.join([low, survey])


def test_text_of_a_trajectory_states_its_ranges():
    path = jl.Trajectory([3.2e8, 3.2e8 + 2.0], [(412345.25, 0, 500), (412345.25, 60, 500)], roll=[-1.5, 2.0])
    assert str(path) == (
        "Trajectory of 2 times: time 320000000 to 320000002 s, x 412345.25 to 412345.25 m, y 0 to 60 m, "
        "z 500 to 500 m, roll -1.5 to 2 degrees, pitch 0 to 0 degrees, yaw 0 to 0 degrees"
    )


def test_headings_pass_through_north():
    path = jl.Trajectory([0.0, 2.0], [(0, 0, 1), (0, 1, 1)], yaw=[350.0, 10.0])
    np.testing.assert_allclose(path.at([1.0]).yaw % 360.0, 0.0)
    # From 359 degrees the unwrapped heading passes 360.
    for yaw in ([359.0, 1.0], [1.0, 359.0], [-359.0, -1.0]):
        path = jl.Trajectory([0.0, 2.0], [(0, 0, 500), (0, 120, 500)], yaw=yaw)
        middle = np.remainder(path.at([1.0]).yaw, 360.0)
        assert min(middle[0], 360.0 - middle[0]) < 1e-9
        survey = jl.Survey.fly(path, NADIR, lidar=jl.Lidar(altitude=500.0), pulse_rate=1.0)
        np.testing.assert_allclose(survey.position, [(0, 0), (0, 60), (0, 120)], atol=1e-6)
    course = jl.Trajectory([0.0, 1.0, 2.0, 3.0], [(0, 0, 1), (1, 0, 1), (1, 0, 1), (1, 0, 1)])
    np.testing.assert_allclose(course.yaw, 90.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"time": [0.0, 0.0]}, "rise strictly"),
        ({"time": [1.0, 0.0]}, "rise strictly"),
        ({"time": [0.0]}, r"position has shape \(2, 3\)"),
        ({"position": [(0, 0), (1, 1)]}, r"position has shape \(2, 2\)"),
        ({"pitch": 91.0}, "pitch"),
        ({"roll": [0.0, np.nan]}, "roll"),
        ({"yaw": [0.0, 1.0, 2.0]}, "yaw has shape"),
    ],
)
def test_inadmissible_trajectories(arguments, message):
    admissible = {"time": [0.0, 1.0], "position": [(0, 0, 100), (0, 60, 100)]}
    with pytest.raises(ValueError, match=message):
        jl.Trajectory(**{**admissible, **arguments})


def test_flights_that_a_lidar_with_an_altitude_cannot_make():
    with pytest.raises(ValueError, match="looks 90 degrees from the vertical"):
        jl.Survey.fly(flight(), Sideways())
    with pytest.raises(ValueError, match="z = -5 m"):
        jl.Survey.fly(flight(height=-5.0), NADIR)
    # With a sensor both are right.
    survey = jl.Survey.fly(flight(height=-5.0), Sideways(), lidar=jl.Lidar(sensor=(0, 0, 0)))
    np.testing.assert_allclose(survey.direction, np.tile(RIGHT, (2, 1)), atol=1e-12)
    with pytest.raises(ValueError, match="outside"):
        flight().at([11.0])
    with pytest.raises(TypeError, match="trajectory"):
        jl.Survey.fly([1.0], NADIR)
    with pytest.raises(TypeError, match="above"):
        jl.Survey.fly(flight(), NADIR, above=3.0)


def test_channels_fly_together():
    """Lines that are turned by 14 degrees either way cross: the edges look ahead by tan(29) sin(14)."""
    flight = jl.Trajectory([0.0, 1.0], [(0, 0, 1000.0), (0, 60, 1000.0)])
    lidar = jl.instrument("RIEGL VQ-1560i")
    options = {"lidar": lidar, "pulse_rate": 3000.0}
    both = jl.Survey.fly([flight, flight], mounting=[(0, 0, 14), (0, 0, -14)], **options)
    assert np.unique(both.flight_line).tolist() == [1, 2, 3, 4]
    for line, turn in ((1, 14), (2, 14), (3, -14), (4, -14)):
        one = jl.Survey.fly(flight, mounting=(0, 0, turn), **options)
        is_line = both.flight_line == line
        np.testing.assert_array_equal(both.position[is_line], one.position)
        np.testing.assert_array_equal(both.gps_time[is_line], one.gps_time)
        # The first shot looks to the left: a turn to the right brings it ahead.
        ahead = one.position[0, 1] / 1000.0
        np.testing.assert_allclose(ahead, np.tan(np.deg2rad(29)) * np.sin(np.deg2rad(turn)), atol=1e-4)


@pytest.mark.parametrize("mounting", [(0, 0), [(0, 0, 1), (0, 0)], [], [[]], "level"])
def test_mountings_of_other_shapes_are_refused(mounting):
    flight = jl.Trajectory([0.0, 1.0], [(0, 0, 100.0), (0, 60, 100.0)])
    with pytest.raises((ValueError, TypeError), match="mounting"):
        jl.Survey.fly(flight, jl.Conical(10.0, 5.0), mounting=mounting)
