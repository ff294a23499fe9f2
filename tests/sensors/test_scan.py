"""Patterns of terrestrial and mobile heads, against closed forms, Snell's law in a plane and data sheets."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxlidar as jl

TIMES = np.arange(40_000) / 4000.0


def angles(direction):
    """Return the angle from straight down, and those ahead and to the right of it, degrees."""
    forward, right, down = direction.T
    return tuple(np.rad2deg(a) for a in (np.arccos(down), np.arctan2(forward, down), np.arctan2(right, down)))


# -- panoramas ---------------------------------------------------------------------------------------------


def test_a_panorama_has_the_shots_that_are_laid_by_hand():
    """Zeniths and azimuths in loops, as a survey of single shots takes them."""
    pattern = jl.Panorama(zenith=(40.0, 146.0), azimuth=(-32.0, 33.0), step=(4.0, 5.0))
    sensor = (4e5, 5e6, 1.7)
    survey = jl.Survey.scan(jl.Lidar(sensor=sensor), pattern, gps_time=3e8, flight_line=4)
    expected = [(zenith, azimuth % 360.0) for azimuth in range(-32, 34, 5) for zenith in range(40, 147, 4)]
    assert pattern.shape == (14, 27)
    np.testing.assert_allclose(np.column_stack([survey.zenith, survey.azimuth]), expected, atol=1e-9)
    np.testing.assert_array_equal(survey.sensor, np.tile(sensor, (len(expected), 1)))
    np.testing.assert_allclose(survey.gps_time - 3e8, np.arange(len(expected)) / 2700.0, atol=1e-6)
    assert set(survey.flight_line) == {4}
    # Above the horizon there are scan angles of more than 90 degrees.
    assert np.array_equal(np.abs(survey.scan_angle) > 90.0, survey.zenith > 90.0 + 1e-9)
    assert pattern.direction(pattern.time[:3]).shape == (3, 3)


def test_level_beams_have_no_scan_angle_by_rounding():
    """Along the y axis, ahead and behind: components of 1e-16 have an angle of their own."""
    pattern = jl.Panorama(zenith=(90.0, 91.0), azimuth=(0.0, 360.0), step=(1.0, 90.0))
    survey = jl.Survey.scan(jl.Lidar(sensor=(0.0, 0.0, 0.0)), pattern)
    level = survey.scan_angle[np.isclose(survey.zenith, 90.0)]
    np.testing.assert_allclose(level, [0.0, 90.0, 0.0, -90.0], atol=1e-9)


def test_a_full_turn_has_no_line_twice():
    whole, half = (jl.Panorama((30, 150), (0, end), step=10.0) for end in (360.0, 180.0))
    assert whole.shape == (36, 13)
    assert half.shape == (19, 13)
    # No multiple of the step: the last line lies before the first.
    assert jl.Panorama((30, 150), step=(10.0, 7.0)).shape == (52, 13)
    lines = jl.Survey.scan(jl.Lidar(sensor=(0, 0, 0)), whole).azimuth.reshape(36, 13)
    np.testing.assert_allclose(lines[:, 0], np.arange(0.0, 360.0, 10.0), atol=1e-9)
    # After the last line the first one comes again.
    np.testing.assert_allclose(whole.direction(whole.time + 0.36), whole.direction(whole.time), atol=1e-9)
    backwards = jl.Panorama((150, 30), (90, 0), step=30.0)
    zenith, azimuth = np.rad2deg(np.arccos(backwards.direction(backwards.time)[:, 2])), backwards.azimuth
    np.testing.assert_allclose(zenith[:5], [150, 120, 90, 60, 30], atol=1e-9)
    assert azimuth == (90.0, 0.0)


def test_a_panorama_turns_with_its_platform():
    """A tripod that leans by 90 degrees to the front turns its panorama about the north."""
    pattern = jl.Panorama(zenith=(90.0, 100.0), azimuth=(0.0, 90.0), step=(10.0, 90.0))
    times = pattern.time
    tilted = jl.Trajectory(times, np.zeros((times.size, 3)), pitch=-90.0, yaw=0.0)
    survey = jl.Survey.fly(tilted, pattern, lidar=jl.Lidar(sensor=(0, 0, 0)))
    # Level ahead becomes straight down, level to the right stays.
    np.testing.assert_allclose(survey.direction[[0, 2]], [(0, 0, -1), (1, 0, 0)], atol=1e-12)


@pytest.mark.slow
def test_a_tripod_sees_the_walls_of_a_room():
    """Ranges to the sides of a square room are half its width over the sine of the azimuth."""
    corners = [(x, y, z) for z in (-5.0, 5.0) for x, y in ((-3, -3), (3, -3), (3, 3), (-3, 3))]
    faces = [(k, (k + 1) % 4, 4 + k) for k in range(4)] + [
        (4 + k, (k + 1) % 4, 4 + (k + 1) % 4) for k in range(4)
    ]
    room = jl.Scene(meshes=(jl.MeshSurface(jl.Mesh(corners, faces, materials=("wall",)), 0.5),))
    lidar = dataclasses.replace(jl.instrument("RIEGL VZ-400i"), divergence=1e-3)
    survey = jl.Survey.scan(lidar.at((0, 0, 0)), jl.Panorama((80.0, 100.0), step=(10.0, 22.5)))
    returns = jl.simulate_many(survey, room, key=jax.random.key(0), max_orders=1).returns()
    nearest = np.abs(survey.direction[:, :2]).max(axis=1)
    np.testing.assert_allclose(returns.range, 3.0 / nearest, atol=0.01)
    assert len(returns) == len(survey) == 48


# -- Risley prisms -----------------------------------------------------------------------------------------


def test_thin_prisms_draw_the_closed_form_of_a_rosette():
    """To first order, deflections (n - 1) a turn as vectors; the error falls with the cube of the wedges."""
    frequency, index = (7.0, -3.0, 1.0), (1.5, 1.6, 1.7)
    errors = []
    for size in (4.0, 2.0, 1.0):
        wedge = size * np.array([1.0, 0.7, 0.4])
        scan = jl.Risley(wedge=wedge, frequency=frequency, index=index)
        turn = 2 * np.pi * TIMES[:, None] * frequency
        deflection = -np.deg2rad(wedge) * (np.array(index) - 1.0)
        expected = np.stack([(deflection * f(turn)).sum(axis=1) for f in (np.cos, np.sin)], axis=1)
        errors.append(np.abs(scan.direction(TIMES)[:, :2] - expected).max() / size)
    assert errors[-1] < 1e-4
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 2.0, atol=0.1)


def bent(angle, prisms, index):
    """Return the angle of a beam behind prisms that all lie in one plane, rad: Snell's law, face by face."""
    for wedge, side in prisms:
        # Angles are those from the normal of each face, whose own angle is `tilt`.
        faces = (abs(wedge), 0.0) if wedge > 0 else (0.0, -abs(wedge))
        for tilt, ratio in zip(faces, (1.0 / index, index)):
            angle = np.arcsin(ratio * np.sin(angle + side * tilt)) - side * tilt
    return angle


@pytest.mark.parametrize("wedge", [(18.7481, 17.9634), (-29.7, 29.7), (12.0, -25.0, 5.0)])
@pytest.mark.parametrize("incidence", [0.0, 3.0])
def test_prisms_in_one_plane_refract_by_snells_law(wedge, incidence):
    index = 1.51
    frequency = tuple(float(k + 1) for k in range(len(wedge)))
    scan = jl.Risley(wedge, frequency, index, incidence)
    # At time zero all deflect backwards; half a second later those with odd frequencies forwards.
    for time, sides in ((0.0, np.ones(len(wedge))), (0.5, [(-1.0) ** int(f) for f in frequency])):
        prisms = [(np.deg2rad(w), side) for w, side in zip(wedge, sides)]
        expected = np.rad2deg(bent(np.deg2rad(incidence), prisms, index))
        _, ahead, right = angles(scan.direction(np.array([time])))
        np.testing.assert_allclose(ahead, expected, atol=1e-9)
        np.testing.assert_allclose(right, 0.0, atol=1e-9)


def test_the_pattern_repeats_itself_with_the_common_period_alone():
    scan = jl.Risley((10.0, -8.0), (5.0, -3.0))
    np.testing.assert_allclose(scan.direction(TIMES + 1.0), scan.direction(TIMES), atol=1e-9)
    assert np.abs(scan.direction(TIMES + 0.2) - scan.direction(TIMES)).max() > 0.1


@pytest.mark.parametrize(
    ("scan", "ahead", "across"),
    [
        # Prisms as in the data of HELIOS++; fields of view of the user manuals of the Mid-40 and the Mid-70.
        (jl.Risley((18.7481, 17.9634), (-121.5657, 77.743)), 38.4, 38.4),
        (jl.Risley((-29.7, 29.7), (-77.7333, 121.5667), 1.5095), 70.4, 70.4),
    ],
)
def test_fields_of_view_are_those_of_the_data_sheets(scan, ahead, across):
    _, a, b = angles(scan.direction(TIMES))
    np.testing.assert_allclose([np.ptp(a), np.ptp(b)], [ahead, across], atol=0.15)


def test_the_six_lasers_of_the_avia_fill_its_field_of_view():
    """70.4 degrees by 77.2 in the user manual."""
    scan = jl.instrument("Livox Avia").scan
    lines = (-2.9899, -1.8554, -0.6186, 0.6186, 1.8554, 3.0386)
    ahead, across = zip(*(angles(dataclasses.replace(scan, incidence=i).direction(TIMES))[1:] for i in lines))
    np.testing.assert_allclose([np.ptp(across), np.ptp(ahead)], [70.4, 77.2], atol=0.4)
    # The planted wrong answer: one laser alone.
    assert np.ptp(ahead[2]) < 72.5


# -- refusals ----------------------------------------------------------------------------------------------

TRIPOD = jl.Lidar(sensor=(0, 0, 1.7))


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: jl.Panorama((30.0,)), ValueError, r"zenith has shape \(1,\); admissible is \(2,\)"),
        (lambda: jl.Panorama((30.0, 200.0)), ValueError, r"zenith = 200 .*\[0, 180\]"),
        (lambda: jl.Panorama("up"), TypeError, "zenith is a str"),
        (lambda: jl.Panorama((30.0, np.nan)), ValueError, "zenith = nan"),
        (
            lambda: jl.Panorama((30.0, 30.0)),
            ValueError,
            r"extends over 0 degrees; admissible is \[step, 360\]",
        ),
        (lambda: jl.Panorama((30.0, 90.0), (-300.0, 300.0)), ValueError, "azimuth = .* extends over 600"),
        (lambda: jl.Panorama((30.0, 90.0), step=0.0), ValueError, "step = 0 is outside"),
        (lambda: jl.Panorama((30.0, 90.0), step=(1, 2, 3)), ValueError, r"step has shape \(3,\)"),
        (lambda: jl.Panorama((30.0, 90.0), line_rate=0.0), ValueError, "line_rate = 0"),
        (lambda: jl.Risley(5.0, 1.0), ValueError, r"wedge has shape \(\); admissible is \(prisms,\)"),
        (lambda: jl.Risley((5.0,), (1.0,)), ValueError, "two or more"),
        (lambda: jl.Risley((5.0, 0.0), (1.0, 2.0)), ValueError, "wedge = .*other than zero"),
        (lambda: jl.Risley((5.0, 5.0), (1.0, 0.0)), ValueError, "frequency = .*other than zero"),
        (lambda: jl.Risley((5.0, 5.0), (1.0,)), ValueError, r"frequency has shape \(1,\)"),
        (lambda: jl.Risley((5.0, 70.0), (1.0, 2.0)), ValueError, "wedge = 70"),
        (lambda: jl.Risley((45.0, -45.0), (1.0, 2.0)), ValueError, "reflects the beam"),
        (lambda: jl.Risley((5.0, 5.0), (1.0, 2.0), 1.0), ValueError, r"index = 1 .*\(1, 4\]"),
        (lambda: jl.Risley((5.0, 5.0), (1.0, 2.0), (1.5,) * 3), ValueError, r"index has shape \(3,\)"),
        (lambda: jl.Risley((5.0, 5.0), (1.0, 2.0), incidence=40), ValueError, "incidence = 40"),
        (lambda: jl.RotatingPolygon(181.0, 10.0), ValueError, r"half_angle = 181 .*\(0, 180\]"),
        (
            lambda: jl.Survey.scan(TRIPOD, jl.Conical(10.0, 5.0)),
            ValueError,
            "a Conical.*a Panorama, or Survey.fly",
        ),
        (lambda: jl.Survey.scan(TRIPOD, jl.Panorama((30, 90)), speed=1.0), ValueError, "speed is given"),
        (lambda: jl.Survey.scan(jl.Lidar(), jl.Panorama((30, 60))), ValueError, r"start is None.*lidar\.at"),
        (
            lambda: jl.Survey.scan(TRIPOD, jl.Panorama((30, 90), step=1e-5)),
            ValueError,
            r"step = 1e-05 asks for 2\.16e\+14 shots",
        ),
        (
            lambda: jl.Survey.scan(jl.Lidar(), jl.RotatingPolygon(120.0, 9.0), (0, 0), (9, 0), 9.0, 99.0),
            ValueError,
            "looks 120 degrees from the vertical",
        ),
    ],
)
def test_inadmissible_patterns_are_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_a_panorama_does_not_fly():
    """Its lines are those of a scanner that stands still: pulses of another rate would miss some."""
    line = {"start": (0, 0), "end": (0, 5), "speed": 1.0, "pulse_rate": 100.0}
    with pytest.raises(ValueError, match="pattern is a Panorama, but lidar has an altitude"):
        jl.Survey.scan(jl.Lidar(), jl.Panorama(zenith=(0, 60), step=30), **line)
