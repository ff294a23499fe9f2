"""Surveys: the geometry of every shot against closed forms, and inadmissible arguments.

At the height H, a beam at the angle alpha from the vertical meets flat ground at the distance H tan(alpha),
after the slant range H / cos(alpha).
"""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl

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
