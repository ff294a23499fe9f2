"""Surveys: the geometry of every shot against closed forms, and inadmissible arguments.

At the height H, a beam at the angle alpha from the vertical meets flat ground at the distance H tan(alpha),
after the slant range H / cos(alpha).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import jaxlidar as jl
from jaxlidar.sensors.survey import beam_angles

LINE = {"start": (100.0, 50.0), "end": (160.0, 130.0), "speed": 20.0, "pulse_rate": 400.0}
# Unit vectors along this line and to its right.
AHEAD, RIGHT = np.array([0.6, 0.8]), np.array([0.8, -0.6])
HEIGHT = 300.0


def scanned(pattern, **changes):
    return jl.Survey.scan(jl.Lidar(altitude=HEIGHT), pattern, **(LINE | changes))


def on_ground(survey):
    """Return positions ahead of and right of the platform, which has a constant speed, and times."""
    time = np.arange(len(survey)) / LINE["pulse_rate"]
    off = survey.position - np.array(LINE["start"]) - np.outer(time * LINE["speed"], AHEAD)
    return off @ AHEAD, off @ RIGHT, time


def test_a_shot_is_a_lidar_with_its_position_and_direction():
    survey = jl.Survey(
        jl.Lidar(altitude=HEIGHT, divergence=2.0), [(3.0, 4.0), (5.0, -6.0)], [10.0, 40.0], 70.0
    )
    for i, lidar in enumerate(survey):
        assert np.allclose(survey.direction[i], lidar.direction, atol=1e-6)
        assert np.allclose(survey.sensor[i], lidar.sensor, atol=1e-3)
        assert np.isclose(survey.slant_range[i], lidar.range_to_reference, rtol=1e-6)
        assert np.isclose(survey.footprint_radius[i], lidar.footprint_radius, rtol=1e-6)
        assert np.isclose(survey.sensor[i, 2], HEIGHT)


def test_slices_and_indices_of_a_survey():
    survey = jl.Survey.grid(jl.Lidar(zenith=3.0), (0, 0), (30, 30), 10.0)
    assert len(survey) == 16
    assert np.array_equal(survey[4:8].position, survey.position[4:8])
    assert np.array_equal(survey[-1].position, survey.position[15])
    with pytest.raises(IndexError, match="shot 16: the survey has 16"):
        survey[16]
    assert np.all(survey.zenith == np.float32(3.0))


def test_positions_keep_their_digits_in_single_precision():
    survey = jl.Survey.grid(jl.Lidar(), (4_500_000.1, 600_000.2), (4_500_000.3, 600_000.2), 0.1)
    assert survey.position[2].tolist() == [4_500_000.1 + 0.2, 600_000.2]
    assert survey[2].position.tolist() == survey.position[2].tolist()


def test_a_grid_has_its_spacings_and_no_footprint_beyond_its_end():
    survey = jl.Survey.grid(jl.Lidar(), (1.0, 2.0), (2.05, 3.0), (0.1, 0.5))
    assert len(survey) == 11 * 3
    assert np.allclose(np.unique(survey.position[:, 0].round(9)), 1.0 + 0.1 * np.arange(11))
    assert np.allclose(np.unique(survey.position[:, 1]), [2.0, 2.5, 3.0])


def test_beams_of_a_track_lie_side_by_side():
    survey = jl.Survey.track(jl.Lidar(), (0, 0), (300, 400), 50.0, beams=3, beam_spacing=20.0)
    position = survey.position.reshape(3, 11, 2)
    assert np.allclose(np.hypot(*(position[:, 1:] - position[:, :-1]).reshape(-1, 2).T), 50.0)
    assert np.allclose(np.hypot(*(position[1:] - position[:-1]).reshape(-1, 2).T), 20.0)
    # The middle one is the line itself; the first is on its left.
    assert np.allclose(position[1, -1], [300.0, 400.0])
    assert np.allclose(position[0, 0], 20.0 * np.array([-0.8, 0.6]))


def test_the_number_of_shots_of_a_line():
    # 100 m at 20 m/s and 400 shots per s.
    assert len(scanned(jl.Conical(10.0, 5.0))) == 2001


@pytest.mark.parametrize("motion", ["sine", "triangle"])
def test_an_oscillating_mirror_draws_its_curve_across_the_track(motion):
    survey = scanned(jl.Oscillating(20.0, 5.0, motion))
    ahead, right, time = on_ground(survey)
    phase = 2 * np.pi * 5.0 * time
    angle = 20.0 * (np.sin(phase) if motion == "sine" else 2 / np.pi * np.arcsin(np.sin(phase)))
    assert np.allclose(ahead, 0.0, atol=1e-9)
    assert np.allclose(right, HEIGHT * np.tan(np.deg2rad(angle)), atol=1e-6)
    assert np.allclose(survey.zenith, np.abs(angle), atol=1e-6)


def test_a_polygon_draws_parallel_lines():
    survey = scanned(jl.RotatingPolygon(30.0, 20.0))
    ahead, right, _ = on_ground(survey)
    # 20 shots a line: each line repeats the one before, 1 m further.
    assert np.allclose(right[20:], right[:-20], atol=1e-6)
    assert np.allclose(survey.position[20:] - survey.position[:-20], AHEAD, atol=1e-6)
    assert np.allclose(right[:20], HEIGHT * np.tan(np.deg2rad(-30.0 + 3.0 * np.arange(20))), atol=1e-6)
    assert np.allclose(ahead, 0.0, atol=1e-9)


def test_a_nutating_mirror_draws_circles():
    survey = scanned(jl.Conical(15.0, 8.0))
    ahead, right, time = on_ground(survey)
    radius = HEIGHT * np.tan(np.deg2rad(15.0))
    assert np.allclose(ahead, radius * np.cos(2 * np.pi * 8.0 * time), atol=1e-6)
    assert np.allclose(right, radius * np.sin(2 * np.pi * 8.0 * time), atol=1e-6)
    assert np.allclose(survey.zenith, 15.0)
    assert np.isclose(survey.slant_range[0], HEIGHT / np.cos(np.deg2rad(15.0)))


@pytest.mark.parametrize(
    "pattern", [jl.Oscillating(20.0, 5.0), jl.RotatingPolygon(30.0, 20.0), jl.Conical(15.0, 8.0)]
)
def test_every_shot_leaves_from_the_platform(pattern):
    survey = scanned(pattern)
    time = np.arange(len(survey)) / LINE["pulse_rate"]
    platform = np.array(LINE["start"]) + np.outer(time * LINE["speed"], AHEAD)
    assert np.allclose(survey.sensor[:, :2], platform, atol=1e-6)
    assert np.allclose(survey.sensor[:, 2], HEIGHT)
    # The lidar has single precision.
    assert np.allclose(survey[7].sensor[:2], platform[7], atol=1e-2)


LIDAR, NADIR = jl.Lidar(), [(0.0, 0.0), (1.0, 1.0)]


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: jl.Survey(jl.Scene(), NADIR), TypeError, "lidar"),
        (lambda: jl.Survey(LIDAR, [0.0, 1.0]), ValueError, r"position has shape \(2,\)"),
        (lambda: jl.Survey(LIDAR, np.zeros((0, 2))), ValueError, r"position has shape \(0, 2\)"),
        (lambda: jl.Survey(LIDAR, np.zeros((4, 3))), ValueError, r"position has shape \(4, 3\).*sensor="),
        (lambda: jl.Survey(LIDAR, [(0.0, np.nan)]), ValueError, "position = nan"),
        (lambda: jl.Survey(LIDAR, "here"), TypeError, "position is a str"),
        (lambda: jl.Survey(LIDAR, NADIR, zenith=[1, 2, 3]), ValueError, r"zenith has shape \(3,\).*\(2,\)"),
        (lambda: jl.Survey(LIDAR, NADIR, zenith=95.0), ValueError, r"zenith = 95 .*\[0, 89\]"),
        (lambda: jl.Survey(LIDAR, NADIR, azimuth=jnp.inf), ValueError, "azimuth = inf"),
        (lambda: jl.Survey.grid(LIDAR, (0, 0), (-1, 1), 1.0), ValueError, r"high = \[-1.0, 1.0\] lies below"),
        (lambda: jl.Survey.grid(LIDAR, (0, 0), (1, 1), 0.0), ValueError, "spacing = 0"),
        (lambda: jl.Survey.grid(LIDAR, 0.0, (1, 1), 1.0), ValueError, r"low has shape \(\)"),
        (lambda: jl.Survey.track(LIDAR, (0, 0), (0, 0), 1.0), ValueError, "admissible is a line"),
        (lambda: jl.Survey.track(LIDAR, (0, 0), (0, 9), 1.0, beams=0), ValueError, "beams = 0"),
        (lambda: jl.Survey.track(LIDAR, (0, 0), (0, 9), -1.0), ValueError, "spacing = -1"),
        (lambda: scanned("conical"), TypeError, "pattern"),
        (lambda: scanned(jl.Conical(15.0, 8.0), speed=0.0), ValueError, "speed = 0"),
        (
            lambda: jl.Survey.track(jl.Lidar(), (0, 0), (1e6, 0), spacing=1e-6, beams=8),
            ValueError,
            r"spacing = 1e-06 with beams = 8 asks for 8e\+12 shots, which take about 800000 GB of memory; "
            r"admissible are at most \S+ in the \S+ GB of this machine",
        ),
        (
            lambda: jl.Survey.track(jl.Lidar(), (0, 0), (1e6, 0), spacing=1e-320),
            ValueError,
            "spacing = 9.99989e-321 with beams = 1 asks for 1e\\+30 shots",
        ),
        (
            lambda: jl.Survey.grid(jl.Lidar(), (0, 0), (1e6, 1e6), spacing=(1.0, 1e-3)),
            ValueError,
            r"spacing = \[1\.0, 0\.001\] asks for 1e\+15 shots",
        ),
        (
            lambda: scanned(jl.Conical(15.0, 8.0), pulse_rate=1e20),
            ValueError,
            r"pulse_rate = 1e\+20 at speed = .* shots",
        ),
        (lambda: jl.Conical(0.0, 8.0), ValueError, r"half_angle = 0 .*\(0, 89\]"),
        (lambda: jl.Conical("wide", 8.0), TypeError, "half_angle is a str"),
        (lambda: jl.RotatingPolygon(30.0, np.nan), ValueError, "line_rate = nan"),
        (lambda: jl.Oscillating(30.0, 1.0, "square"), ValueError, "motion = 'square'"),
    ],
)
def test_inadmissible_input_is_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_a_figure_draws_every_footprint_where_it_lies():
    from matplotlib.figure import Figure

    lidar = jl.Lidar(altitude=HEIGHT, divergence=20.0)
    survey = jl.Survey(lidar, [(0.0, 0.0), (10.0, 5.0)], [0.0, 60.0], [0.0, 90.0])
    voxels = jl.VoxelMap.from_lad(np.ones((4, 4, 2)), voxel_size=5.0)
    scene = jl.Scene(
        canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4), hotspot=False), ground=jl.Ground()
    )
    ax = jl.plot.survey(survey, scene, Figure().subplots(), values=[1.0, 2.0], label="height (m)")
    (footprints,) = ax.collections
    assert np.allclose(footprints.get_offsets(), survey.position)
    # Looking east at 60 degrees: twice the slant range and twice as long along the azimuth.
    assert np.allclose(footprints.get_widths(), [6.0, 24.0])
    assert np.allclose(footprints.get_heights(), [6.0, 12.0])
    assert np.allclose(footprints.get_angles() % 180, [90.0, 0.0])
    low, high = ax.get_xlim()
    assert low < -3.0
    assert high > 22.0
    # Footprints that would be too small to see are dots.
    distant = jl.Survey.grid(jl.Lidar(), (0, 0), (900, 900), 300.0)
    dots = jl.plot.survey(distant, None, Figure().subplots()).collections
    assert len(dots[0].get_offsets()) == 16
    with pytest.raises(ValueError, match=r"values has shape \(3,\)"):
        jl.plot.survey(distant, None, Figure().subplots(), values=[1, 2, 3])


def test_shots_have_times_angles_and_flight_lines(tmp_path):
    line = {"start": (0, 0), "end": (0, 10), "speed": 50.0, "pulse_rate": 100.0}
    survey = jl.Survey.scan(jl.Lidar(), jl.Oscillating(20.0, 5.0), **line, gps_time=3.2e8, flight_line=7)
    np.testing.assert_allclose(survey.gps_time - 3.2e8, np.arange(len(survey)) / 100.0, atol=1e-7)
    # Across the track, to the right: the zenith angle with a sign.
    np.testing.assert_allclose(np.abs(survey.scan_angle), survey.zenith, atol=1e-9)
    np.testing.assert_array_equal(survey[3:5].scan_angle, survey.scan_angle[3:5])
    assert survey[3:5].flight_line.tolist() == [7, 7]
    assert survey.relative_to(np.array([1.0, 2.0])).gps_time[0] == 3.2e8
    jl.io.write_case(tmp_path / "a.toml", jl.io.Case(survey=survey))
    read_survey = jl.io.read_case(tmp_path / "a.toml").survey
    for name in ("gps_time", "scan_angle", "flight_line"):
        np.testing.assert_array_equal(getattr(read_survey, name), getattr(survey, name))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"flight_line": 70000}, "flight_line = 70000 is outside"),
        ({"flight_line": 1.5}, "not whole numbers"),
        ({"scan_angle": 181.0}, "scan_angle = 181 is outside"),
        ({"gps_time": [1.0, 2.0, 3.0]}, r"gps_time has shape \(3,\)"),
    ],
)
def test_wrong_times_angles_and_flight_lines_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        jl.Survey(jl.Lidar(), [(0, 0), (1, 0)], **fields)


# -- errors of geometry ------------------------------------------------------------------------------------

DRONE = jl.Lidar(sensor=(0.0, 0.0, 0.0), divergence=0.5)


def strips(*courses, **options):
    """One strip of eleven shots for each course, 60 m high; roll and pitch are not zero."""
    flights = []
    for start, end in courses:
        ends = np.column_stack([np.array([start, end], float), [60.0, 60.0]])
        flights.append(jl.Trajectory([0.0, 10.0], ends, roll=3.0, pitch=-2.0))
    pattern = jl.Oscillating(half_angle=20.0, frequency=0.3)
    return jl.Survey.fly(flights, pattern, lidar=DRONE, pulse_rate=1.0, **options)


@pytest.mark.parametrize(
    ("boresight", "course", "expected"),
    [
        # The right wing is down: the beam goes to the left. The nose is up: it goes ahead.
        ((0.1, 0.0, 0.0), (0.0, 5.0), (-0.10472, 0.0)),
        ((0.1, 0.0, 0.0), (0.0, -5.0), (0.10472, 0.0)),
        ((0.0, 0.1, 0.0), (5.0, 0.0), (0.10472, 0.0)),
        ((0.0, 0.0, 0.1), (5.0, 0.0), (0.0, 0.0)),
    ],
)
def test_a_boresight_error_moves_a_beam_by_its_angle(boresight, course, expected):
    """60 m tan(0.1 degrees) is 0.105 m."""
    flight = jl.Trajectory([0.0, 1.0], [(0, 0, 60), (*course, 60)])
    strip = jl.Survey.fly(flight, jl.Conical(half_angle=1e-7, frequency=1.0), lidar=DRONE)
    place = jl.ground_position(strip.disturbed(boresight=boresight), jl.Scene(ground=jl.Ground()))
    np.testing.assert_allclose(place[0, :2], expected, atol=2e-5)


def test_a_boresight_error_is_a_mounting_that_is_not_stated():
    """`fly` with this mounting is the reference; planted: turns in the frame of the map."""
    courses = ((0, 0), (30, 40)), ((30, 0), (0, 5))
    true = strips(*courses).disturbed(boresight=(1.0, -2.0, 3.0))
    expected = strips(*courses, mounting=(1.0, -2.0, 3.0))
    np.testing.assert_allclose(true.direction, expected.direction, atol=1e-12)
    np.testing.assert_array_equal(true.sensor, expected.sensor)
    stated = strips(*courses)
    np.testing.assert_array_equal(true.stated[:, :3], stated.sensor)
    np.testing.assert_array_equal(true.stated[:, 3:5], np.column_stack([stated.zenith, stated.azimuth]))
    # Of a lidar with an altitude, too, which is then placed by its sensors.
    high = jl.Survey.scan(jl.Lidar(altitude=HEIGHT), jl.Oscillating(20.0, 30.0), **LINE)
    true = high.disturbed(boresight=(0.5, 0.0, 0.0))
    assert true.has_sensor_position
    np.testing.assert_allclose(true.sensor, high.sensor)
    angle = np.rad2deg(np.arccos(np.sum(true.direction * high.direction, axis=1)))
    np.testing.assert_allclose(angle, 0.5, rtol=1e-6)


def test_errors_of_position_and_attitude_are_those_of_a_line():
    """400 lines: sums of squares are chi-squared (level 1e-4 for each of six); planted: errors by shot."""
    lines = np.repeat(np.arange(400), 5)
    survey = jl.Survey(DRONE, sensor=np.zeros((2000, 3)), flight_line=lines, attitude=np.zeros((2000, 3)))
    true = survey.disturbed(position=(0.1, 0.2, 0.3), range=0.05, key=jax.random.key(3))
    by_line = true.sensor.reshape(400, 5, 3)
    assert np.all(by_line == by_line[:, :1])
    error = true.stated[:, 5]
    for values, deviation in (*zip(by_line[:, 0].T, (0.1, 0.2, 0.3)), (error, 0.05)):
        probability = scipy.stats.chi2.cdf(np.sum((values / deviation) ** 2), len(values))
        assert 5e-5 < probability < 1 - 5e-5
    assert len(np.unique(error)) == 2000
    # Straight down and heading north, a roll and a pitch move the beam to the west and the north.
    true = survey.disturbed(attitude=(0.1, 0.2, 0.0), key=jax.random.key(4))
    west, north = (-true.direction[::5, 0], true.direction[::5, 1])
    for values, deviation in ((west, 0.1), (north, 0.2)):
        statistic = np.sum((np.rad2deg(values) / deviation) ** 2)
        assert 5e-5 < scipy.stats.chi2.cdf(statistic, 400) < 1 - 5e-5
    again = survey.disturbed(attitude=(0.1, 0.2, 0.0), key=jax.random.key(4))
    np.testing.assert_array_equal(again.direction, true.direction)


def test_stated_geometry_stays_with_its_shots():
    survey = strips(((0, 0), (30, 40)), ((30, 0), (0, 5)))
    true = survey.disturbed(boresight=(1.0, 0.0, 0.0), range=0.1, key=jax.random.key(0))
    part = true.subset(np.array([3, 15]))
    np.testing.assert_array_equal(part.stated, true.stated[[3, 15]])
    np.testing.assert_array_equal(part.attitude, true.attitude[[3, 15]])
    joined = jl.Survey.join([survey, true])
    np.testing.assert_array_equal(joined.stated[len(survey) :], true.stated)
    np.testing.assert_array_equal(joined.stated[: len(survey), :3], survey.sensor)
    assert not joined.stated[: len(survey), 5].any()
    moved = true.relative_to(np.array([10.0, 20.0]))
    np.testing.assert_allclose(moved.stated[:, :3], true.stated[:, :3] - [10.0, 20.0, 0.0])
    np.testing.assert_array_equal(moved.stated[:, 3:], true.stated[:, 3:])
    # A second error adds to the first; what is stated stays.
    twice = true.disturbed(boresight=(-1.0, 0.0, 0.0))
    np.testing.assert_allclose(twice.direction, survey.direction, atol=1e-9)
    np.testing.assert_array_equal(twice.stated, true.stated)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"boresight": 0.1}, ValueError, r"boresight has shape \(\); admissible is \(3,\)"),
        ({"position": -0.1}, ValueError, r"position = -0.1 is outside"),
        ({"attitude": (0.1, 0.1)}, ValueError, r"attitude has shape \(2,\)"),
        ({"range": np.nan}, ValueError, "range"),
        ({"range": 0.1}, ValueError, "key is None, but errors are to be drawn"),
        ({"range": 0.1, "key": 3}, TypeError, "key"),
    ],
)
def test_inadmissible_errors_of_geometry_are_refused(options, error, message):
    with pytest.raises(error, match=message):
        strips(((0, 0), (30, 40))).disturbed(**options)


def test_errors_of_angles_need_an_attitude():
    survey = jl.Survey(jl.Lidar(), [(0.0, 0.0)])
    for options in ({"boresight": (0.1, 0, 0)}, {"attitude": 0.1, "key": jax.random.key(0)}):
        with pytest.raises(ValueError, match=r"the survey has no attitude; .* Survey\.fly"):
            survey.disturbed(**options)
    with pytest.raises(ValueError, match="stated is given with position"):
        jl.Survey(jl.Lidar(), [(0.0, 0.0)], stated=np.zeros((1, 6)))
    with pytest.raises(ValueError, match=r"stated has shape \(1, 5\)"):
        jl.Survey(DRONE, sensor=[(0.0, 0.0, 1.0)], stated=np.zeros((1, 5)))


def test_strips_disagree_as_their_geometry_does(tmp_path):
    """Returns lie at s + w (r + e) with the stated s and w, the true range r and its error e.

    Over a slope of 20 degrees, strips of opposite courses differ in height by twice the shift and its slope.
    """
    down = jl.Conical(half_angle=1e-7, frequency=1.0)
    scene = jl.Scene(ground=jl.Ground(height=0.0, slope=20.0, aspect=90.0, reflectance=0.4))
    flights = [jl.Trajectory([0.0, 4.0], [(0, y, 60), (0, -y, 60)], crs="EPSG:25832") for y in (-10.0, 10.0)]
    stated = jl.Survey.fly(flights, down, lidar=DRONE, pulse_rate=1.0)
    true = stated.disturbed(boresight=(0.1, 0.0, 0.0), range=0.02, key=jax.random.key(5))
    options = {"key": jax.random.key(0), "max_orders": 1, "rtol": 0.05}
    many = jl.simulate_many(true, scene, path=tmp_path / "strips.zarr", **options)
    assert many.crs == "EPSG:25832"
    np.testing.assert_array_equal(many.position, stated.sensor)
    returns = many.returns()
    assert len(returns) == len(stated)
    true_range = np.linalg.norm(jl.ground_position(true, scene) - true.sensor, axis=1)
    expected = stated.sensor + (true_range + true.stated[:, 5])[:, None] * stated.direction
    np.testing.assert_allclose(returns.position, expected, atol=2e-3)
    without_noise = returns.position[:, 2] + true.stated[:, 5]
    line = returns.flight_line == 1
    difference = without_noise[line].mean() - without_noise[~line].mean()
    expected = 2 * 60.0 * np.tan(np.deg2rad(0.1)) * np.tan(np.deg2rad(20.0))
    np.testing.assert_allclose(abs(difference), expected, atol=2e-3)
    heights = [many.height_of_shot(3)[many.energy[3, 0].argmax()], returns.position[3, 2]]
    assert abs(heights[0] - heights[1]) < 0.2
    again = jl.rerun(tmp_path / "strips.zarr")
    np.testing.assert_array_equal(again.reflectance, many.reflectance)
    np.testing.assert_array_equal(again.acquisition.range_at_time_zero, true.stated[:, 5])


def test_errors_of_ranges_leave_the_strength_of_returns():
    """Over leaves, whose standard errors are thresholds; planted: the error of the range as the range."""
    down = jl.Conical(half_angle=1e-7, frequency=1.0)
    voxels = jl.VoxelMap.from_lad(np.full((4, 4, 2), 0.5), voxel_size=1.0, origin=(-2.0, -2.0, 1.0))
    scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4)), ground=jl.Ground())
    flight = jl.Trajectory([0.0, 1.0], [(0, 0, 60), (0, 1, 60)])
    stated = jl.Survey.fly(flight, down, lidar=DRONE, pulse_rate=2)
    options = {"key": jax.random.key(0), "max_orders": 1, "rtol": 0.05}
    true = stated.disturbed(range=0.01, key=jax.random.key(1))
    many = [jl.simulate_many(survey, scene, **options) for survey in (stated, true)]
    assert many[0].stderr.any()
    returns, with_errors = (waves.returns(detector="peak") for waves in many)
    assert len(returns) > len(stated)
    np.testing.assert_array_equal(with_errors.shot, returns.shot)
    np.testing.assert_allclose(with_errors.reflectance, returns.reflectance, rtol=2e-3)
    error = true.stated[returns.shot, 5]
    np.testing.assert_allclose(with_errors.range - returns.range, error, atol=1e-6)


def test_a_flight_line_has_its_errors_whichever_others_there_are():
    """Planted: errors by the order of lines, by which strips that are disturbed one by one would be alike."""
    stated, key = strips(((0, 0), (0, 50)), ((20, 50), (20, 0))), jax.random.key(7)
    options = {"position": 0.1, "attitude": 0.02, "key": key}
    true = stated.disturbed(**options)
    second = np.flatnonzero(stated.flight_line == 2)
    alone = stated.subset(second).disturbed(**options)
    np.testing.assert_array_equal(alone.sensor, true.sensor[second])
    np.testing.assert_allclose(alone.direction, true.direction[second], atol=1e-12)
    assert not np.isclose(alone.sensor[0] - stated.sensor[second[0]], true.sensor[0] - stated.sensor[0]).any()


def test_a_flight_above_terrain_takes_its_crs():
    terrain = jl.Terrain(np.zeros((12, 12)), 10.0, reflectance=0.3, crs=25832)
    flight = jl.Trajectory([0.0, 1.0], [(20.0, 20.0, 60.0), (20.0, 60.0, 60.0)])
    options = {"lidar": jl.Lidar(sensor=(0, 0, 0)), "above": terrain}
    strip = jl.Survey.fly(flight, jl.Conical(half_angle=5.0, frequency=2.0), **options)
    assert strip.crs == terrain.crs == "EPSG:25832"


def test_surveys_of_patterns_state_their_crs():
    line = {"start": (0.0, 0.0), "end": (0.0, 20.0), "crs": 25832}
    tripod = jl.Lidar(sensor=(0.0, 0.0, 1.7))
    surveys = [
        jl.Survey.grid(jl.Lidar(), (0.0, 0.0), (10.0, 10.0), 5.0, crs=25832),
        jl.Survey.track(jl.Lidar(), spacing=10.0, **line),
        jl.Survey.scan(jl.Lidar(), jl.Conical(20.0, 40.0), speed=10.0, pulse_rate=10.0, **line),
        jl.Survey.scan(tripod, jl.Panorama(zenith=(30.0, 150.0), step=30.0), crs=25832),
    ]
    assert {survey.crs for survey in surveys} == {"EPSG:25832"}


def test_azimuths_are_below_a_full_turn():
    """A beam that is vertical but for rounding; planted: the remainder alone, which rounds up."""
    almost_north = np.array([[-1e-30, 1.0, 0.0]])
    assert np.rad2deg(np.arctan2(-1e-30, 1.0)) % 360.0 == 360.0
    assert beam_angles(almost_north)[1][0] == 0.0
