"""Elliptical footprints: moments over tilted planes, step edges by the error function, and what sees them.

With the semi-axes w1 in the vertical plane of the beam and w2 across it, at 1/e^2, a Gaussian footprint has
the standard deviations w1 / 2 and w2 / 2. Beyond a straight edge at the distance d from the axis, with the
unit normal (c, s) in these axes, lies the fraction

    1/2 erfc(sqrt(2) d / w),   w^2 = (c w1)^2 + (s w2)^2.
"""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.plot.surveys import _footprints
from jaxlidar.survey.coverage import off_map

VERTICAL, LEVEL = 8.0, 3.0
PULSE = jl.GaussianPulse(fwhm=0.5)


def lidar(zenith=0.0, azimuth=0.0, *, placed_by="altitude", **fields):
    fields = {
        "divergence": VERTICAL,
        "level_divergence": LEVEL,
        "pulse": PULSE,
        "sampling_interval": 0.1,
    } | fields
    if placed_by == "altitude":
        return jl.Lidar(altitude=500.0, zenith=zenith, azimuth=azimuth, **fields)
    # The axis passes the origin.
    axis = np.asarray(jl.Lidar(zenith=zenith, azimuth=azimuth).direction, float)
    return jl.Lidar(sensor=-500.0 * axis, zenith=zenith, azimuth=azimuth, **fields)


def simulate(lidar, scene, **options):
    return jl.simulate(lidar, scene, key=jax.random.key(0), **({"max_orders": 1} | options))


@pytest.mark.parametrize("placed_by", ["altitude", "sensor"])
@pytest.mark.parametrize(("aspect", "ellipse_turn"), [(30.0, 0.0), (60.0, 0.0), (120.0, 0.0), (60.0, 50.0)])
def test_a_tilted_plane_has_the_second_moment_of_the_ellipse(placed_by, aspect, ellipse_turn):
    """The variance of ranges at nadir is that of heights: tan^2(slope) times that of the footprint."""
    azimuth, slope = 30.0, 20.0
    beam = lidar(azimuth=azimuth, placed_by=placed_by, ellipse_turn=ellipse_turn)
    wave = simulate(beam, jl.Scene(ground=jl.Ground(reflectance=0.3, slope=slope, aspect=aspect)))
    time, power = (np.asarray(a, float) for a in (wave.time, wave.reflectance[0]))
    mean = np.sum(power * time) / power.sum()
    variance = np.sum(power * (time - mean) ** 2) / power.sum()
    # Along the azimuth and across it, to the right.
    turn = math.radians(aspect - azimuth - ellipse_turn)
    w1, w2 = (0.5e-3 * d * 500.0 for d in (VERTICAL, LEVEL))

    def of_footprint(w1, w2):
        sigma = 0.5 * math.hypot(math.cos(turn) * w1, math.sin(turn) * w2)
        return (2.0 / 0.299792458 * math.tan(math.radians(slope)) * sigma) ** 2

    sampled = float(PULSE.std) ** 2 + 0.1**2 / 12.0
    np.testing.assert_allclose(variance - sampled, of_footprint(w1, w2), rtol=0.01)
    # The planted wrong answer: axes that are swapped.
    assert abs(variance - sampled - of_footprint(w2, w1)) > 0.05 * variance


def half_plane(normal, distance, zenith=0.0, azimuth=0.0):
    """A mesh across a beam, 40 m wide, that begins `distance` m from its axis in the direction `normal`.

    `normal`: in the vertical plane of the beam and across it, to the right.
    """
    zenith, azimuth = np.deg2rad(zenith), np.deg2rad(azimuth)
    sin, cos = np.sin(azimuth), np.cos(azimuth)
    vertical = np.array([np.cos(zenith) * sin, np.cos(zenith) * cos, np.sin(zenith)])
    level = np.array([cos, -sin, 0.0])
    first = normal[0] * vertical + normal[1] * level
    second = normal[1] * vertical - normal[0] * level
    corners = [distance * first + a * first + b * second for a, b in ((0, -20), (40, -20), (40, 20), (0, 20))]
    return jl.MeshSurface((corners, [(0, 1, 2), (0, 2, 3)]), reflectance=0.5)


def beyond_edge(normal, distance, w1=0.5e-3 * VERTICAL * 500.0, w2=0.5e-3 * LEVEL * 500.0):
    return 0.5 * math.erfc(math.sqrt(2.0) * distance / math.hypot(normal[0] * w1, normal[1] * w2))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("placed_by", "zenith"),
    [
        ("sensor", 40.0),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (("sensor", 0.0), ("altitude", 0.0), ("altitude", 40.0))
        ),
    ],
)
def test_a_step_edge_has_the_share_of_the_error_function(placed_by, zenith):
    azimuth = 70.0
    slant = 500.0 if placed_by == "sensor" or zenith == 0 else 500.0 / math.cos(math.radians(zenith))
    for turn in (0.0, 35.0, 90.0, 145.0):
        normal = (math.cos(math.radians(turn)), math.sin(math.radians(turn)))
        scene = jl.Scene(meshes=[half_plane(normal, 0.6, zenith, azimuth)])
        wave = simulate(lidar(zenith, azimuth, placed_by=placed_by), scene, rtol=0.003)
        axes = [0.5e-3 * d * slant for d in (VERTICAL, LEVEL)]
        share = float(wave.reflectance.sum()) / 0.5
        np.testing.assert_allclose(share, beyond_edge(normal, 0.6, *axes), atol=0.006)
    # The planted wrong answer: the round footprint of the larger divergence, across the level.
    assert abs(beyond_edge((0, 1), 0.6) - beyond_edge((1, 0), 0.6)) > 0.1


def test_equal_divergences_are_a_round_beam():
    scene = jl.Scene(ground=jl.Ground(reflectance=0.3, slope=25.0, aspect=60.0))
    pulse = {"pulse": jl.GaussianPulse(fwhm=8.0)}
    round_beam, ellipse = (lidar(20.0, 30.0, level_divergence=d, **pulse) for d in (None, VERTICAL))
    a, b = (np.asarray(simulate(beam, scene).reflectance) for beam in (round_beam, ellipse))
    np.testing.assert_allclose(a, b, atol=1e-3 * a.max())
    assert round_beam.ellipse is None


@pytest.mark.slow
def test_higher_orders_enter_over_the_ellipse():
    """Half a plane of leaves returns that share of a whole one, of all orders, which the footprint lights."""
    voxels = jl.VoxelMap.from_lad(
        np.full((40, 40, 1), 3.0), voxel_size=(1.0, 1.0, 3.0), origin=(0.4, -20.0, 0.0)
    )
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.5, 0.4))
    beam = lidar(azimuth=90.0)
    wave = simulate(beam, jl.Scene(canopy=canopy), max_orders=4, rtol=0.02)
    wide = simulate(
        beam,
        jl.Scene(
            canopy=dataclasses.replace(
                canopy, voxels=dataclasses.replace(voxels, origin=jnp.array([-20.0, -20.0, 0.0]))
            )
        ),
        max_orders=4,
        rtol=0.02,
    )
    # The edge lies east of the axis, along the azimuth; light that is scattered across it is little.
    for name, tolerance in (("first", 0.01), ("higher", 0.06)):
        share = float(wave.components[name].sum() / wide.components[name].sum())
        assert abs(share - beyond_edge((1, 0), 0.4)) < tolerance


@pytest.mark.slow
def test_the_derivative_of_an_edge_by_both_divergences():
    """d share / d divergence by the closed form; the edge lies at 30 degrees from the vertical plane."""
    turn = math.radians(30.0)
    normal = (math.cos(turn), math.sin(turn))
    scene = jl.Scene(ground=jl.Ground(reflectance=0.3, slope=20.0, aspect=30.0))
    beam = lidar(sampling_interval=0.5)
    made = jl.plan(beam, scene, max_orders=1)

    def variance(divergences):
        moved = eqx.tree_at(lambda a: (a.divergence, a.level_divergence), beam, tuple(divergences))
        wave = jl.simulate(moved, scene, key=jax.random.key(0), plan=made)
        power, time = wave.reflectance[0], wave.time
        mean = jnp.sum(power * time) / jnp.sum(power)
        return jnp.sum(power * (time - mean) ** 2) / jnp.sum(power)

    slopes = jax.grad(variance)(jnp.array([VERTICAL, LEVEL]))
    scale = (2.0 / 0.299792458 * math.tan(math.radians(20.0)) * 0.25e-3 * 500.0) ** 2
    expected = [2.0 * scale * c**2 * d for c, d in zip(normal, (VERTICAL, LEVEL))]
    np.testing.assert_allclose(slopes, expected, rtol=0.02)


def test_a_turned_ellipse_meets_an_edge_beside_an_inclined_beam():
    """In a survey, too; the turn is from the vertical plane to the right."""
    zenith, azimuth, turn = 40.0, 70.0, 50.0
    beam = lidar(zenith, azimuth, placed_by="sensor")
    turns = [turn, turn - 90.0]
    survey = jl.Survey(beam, sensor=[beam.sensor] * 2, ellipse_turn=turns)
    angle = math.radians(turn)
    edge = half_plane((math.cos(angle), math.sin(angle)), 0.8, zenith, azimuth)
    many = jl.simulate_many(survey, jl.Scene(meshes=[edge]), key=jax.random.key(0), max_orders=1, rtol=0.003)
    shares = many.reflectance.sum(axis=(1, 2)) / 0.5
    np.testing.assert_allclose(shares, [beyond_edge(n, 0.8) for n in ((1, 0), (0, 1))], atol=0.006)
    # The planted wrong answer: an ellipse that is not turned.
    assert abs(beyond_edge((math.cos(angle), math.sin(angle)), 0.8) - shares[0]) > 0.02
    assert [float(shot.ellipse_turn) for shot in survey] == pytest.approx(turns)
    assert survey[1:].ellipse_turn.tolist() == turns[1:]
    both = jl.Survey.join([survey, jl.Survey(beam, sensor=[beam.sensor])])
    assert both.ellipse_turn.tolist() == [*turns, 0.0]


@pytest.mark.parametrize("placed_by", ["altitude", "sensor"])
def test_an_ellipse_keeps_its_place_in_the_scanner_however_the_platform_leans(placed_by):
    """Straight down and with pitch, where the vertical plane of the beam is any other."""
    flight = jl.Trajectory(
        [0.0, 1.0, 2.0],
        [(0, 0, 500), (30, 0, 500), (60, 0, 500)],
        roll=[0, 1, -2],
        pitch=[0, 4, -3],
        yaw=[60, 60, 75],
    )
    flight = flight.at(np.linspace(0.0, 2.0, 21))
    survey = jl.Survey.fly(flight, jl.Oscillating(10.0, 0.5), lidar=lidar(placed_by=placed_by))
    first, second = (a / np.linalg.norm(a, axis=1, keepdims=True) for a in survey.footprint_axes)
    forward = flight.rotation[:, :, 0]
    # The scan plane lies across the forward axis.
    np.testing.assert_allclose(np.abs(np.sum(second * forward, axis=1)), 1.0, atol=1e-9)
    np.testing.assert_allclose(np.sum(first * survey.direction, axis=1), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.sum(first * forward, axis=1), 0.0, atol=1e-9)
    # The planted wrong answer: an ellipse in the vertical plane of each beam.
    level = eqx.tree_at(lambda s: s.ellipse_turn, survey, None).footprint_axes[1]
    assert np.min(np.abs(np.sum(level * forward, axis=1)) / np.linalg.norm(level, axis=1)) < 0.5


def test_an_ellipse_turns_with_the_platform_that_flies_otherwise_than_stated():
    flight = jl.Trajectory([0.0, 1.0], [(0, 0, 500), (30, 0, 500)], yaw=90.0)
    line = jl.Survey.fly(flight, jl.Oscillating(10.0, 0.2), lidar=lidar(placed_by="sensor"))
    turned = line.disturbed(boresight=(0.0, 0.0, 30.0))
    np.testing.assert_allclose(line.footprint_axes[1][0] * [1, 0, 1], line.footprint_axes[1][0], atol=1e-12)
    level = turned.footprint_axes[1]
    east_of_north = np.rad2deg(np.arctan2(level[:, 0], level[:, 1])) % 180.0
    np.testing.assert_allclose(east_of_north, 120.0, atol=1e-6)
    # A roll of a survey that states no turns leaves its level axis where it is, but for that angle.
    beam = lidar(placed_by="sensor")
    still = jl.Survey(beam, sensor=[(0, 0, 500)], zenith=0.0, azimuth=0.0, attitude=[(0, 0, 0)])
    rolled = still.disturbed(boresight=(0.1, 0.0, 0.0)).footprint_axes[1][0]
    np.testing.assert_allclose(rolled / np.linalg.norm(rolled), [1.0, 0.0, 0.0], atol=0.002)


@pytest.mark.parametrize("turn", [0.0, 90.0, 30.0])
def test_a_turned_ellipse_lies_off_the_map_and_in_pictures_as_on_the_ground(turn):
    """By random points of the footprint along inclined beams; by 90 degrees, divergences change places."""
    beam = lidar(divergence=1.0, level_divergence=20.0)
    survey = jl.Survey(beam, [(0.0, 0.0)], zenith=60.0, azimuth=20.0, ellipse_turn=turn)
    first, second = (a[0] for a in survey.footprint_axes)
    across = np.random.default_rng(0).normal(scale=0.5, size=(100_000, 2)) * survey.footprint_radius[0]
    points = across[:, :1] * first + across[:, 1:] * second
    w = survey.direction[0]
    points = points - points[:, 2:] / w[2] * w
    voxels = jl.VoxelMap.from_lad(np.ones((10, 10, 1)), voxel_size=(1.0, 1.0, 1e-3), origin=(-5, -5, 0))
    off = off_map(survey, jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4))))
    outside = np.mean(np.any(np.abs(points[:, :2]) > 5.0, axis=1))
    np.testing.assert_allclose(off, outside, atol=0.02)
    _, short, long, angle = _footprints(survey, None)
    # Of a Gaussian, the covariance has the squares of half the radii.
    values, vectors = np.linalg.eigh(np.cov(points[:, :2].T))
    np.testing.assert_allclose([short[0], long[0]], 2.0 * np.sqrt(values), rtol=0.02)
    direction = np.rad2deg(np.arctan2(vectors[1, 1], vectors[0, 1]))
    assert abs((angle[0] - direction + 90.0) % 180.0 - 90.0) < 2.0
    swapped = lidar(divergence=20.0, level_divergence=1.0)
    same = jl.Survey(swapped, [(0.0, 0.0)], zenith=60.0, azimuth=20.0, ellipse_turn=turn - 90.0)
    for a, b in zip(survey.footprint_axes, same.footprint_axes[::-1]):
        np.testing.assert_allclose(np.abs(a), np.abs(b), atol=1e-12)


class Ahead(jl.AbstractScan):
    """Looks down, with a level axis of one's own."""

    axis: np.ndarray

    def direction(self, time):
        return np.tile([0.0, 0.0, 1.0], (len(time), 1))

    def level_axis(self, time):
        return self.axis


def test_a_level_axis_of_the_wrong_kind_is_named():
    flight = jl.Trajectory([0.0, 1.0], [(0, 0, 500), (30, 0, 500)], yaw=0.0)

    def fly(axis, **fields):
        return jl.Survey.fly(flight, Ahead(np.asarray(axis)), lidar=lidar(placed_by="sensor", **fields))

    for axis in ([1.0, 0.0, 0.0], np.ones((3, 3)), np.ones((2, 2))):
        with pytest.raises(ValueError, match=r"level_axis of the scan pattern has shape .*\(2, 3\)"):
            fly(axis)
    with pytest.raises(ValueError, match="level_axis of the scan pattern = nan"):
        fly([[np.nan, 0.0, 0.0]] * 2)
    # Any length; the lidar's own turn is added.
    np.testing.assert_allclose(fly([[0.0, 1e-12, 0.0]] * 2).ellipse_turn, 0.0, atol=1e-9)
    np.testing.assert_allclose(fly([[0.0, 1e5, 0.0]] * 2, ellipse_turn=30.0).ellipse_turn, 30.0)


def test_surveys_whose_lidars_are_turned_otherwise_join():
    surveys = [jl.Survey(lidar(ellipse_turn=turn), [(0.0, 0.0)]) for turn in (5.0, 40.0)]
    assert jl.Survey.join(surveys).ellipse_turn.tolist() == [5.0, 40.0]
    round_beam = jl.Survey(jl.Lidar(), [(0.0, 0.0)])
    assert jl.Survey.join([round_beam, round_beam]).ellipse_turn is None


def test_the_axes_of_patterns_lie_across_their_beams():
    """A panorama draws its lines along `divergence`; of prisms that look ahead, the level axis is level."""
    tripod = lidar(placed_by="sensor")
    panorama = jl.Survey.scan(tripod, jl.Panorama(zenith=(30.0, 150.0), step=30.0))
    assert np.all(np.minimum(panorama.ellipse_turn, 180.0 - panorama.ellipse_turn) < 1e-9)
    still = jl.Trajectory([0.0, 1.0], [(0, 0, 500)] * 2, yaw=0.0)
    prisms = jl.Risley(wedge=(10.0, 10.0), frequency=(3.0, -1.3))
    ahead = jl.Survey.fly(still, prisms, lidar=tripod, pulse_rate=20.0, mounting=(0.0, 90.0, 0.0))
    upward, level = ahead.footprint_axes
    assert np.all(np.abs(level[:, 2]) < 0.05 * np.linalg.norm(level, axis=1))
    assert np.all(np.abs(upward[:, 2]) > 0.9 * np.linalg.norm(upward, axis=1))
    round_beams = jl.Survey.scan(jl.Lidar(sensor=(0, 0, 2)), jl.Panorama((30.0, 60.0), step=30.0))
    assert round_beams.ellipse_turn is None


def test_surveys_labels_and_coverage_see_the_ellipse():
    beam = lidar(placed_by="sensor")
    # Panels east and north of the axis, 1 m away: outside the ellipse's level axis, within the other.
    panels = [half_plane((1, 0), 1.0), half_plane((0, 1), 1.0)]
    survey = jl.Survey(beam, sensor=[(0, 0, 500.0)])
    many = jl.simulate_many(
        survey,
        jl.Scene(meshes=panels, ground=jl.Ground(height=-10.0)),
        key=jax.random.key(0),
        max_orders=1,
        rtol=0.01,
    )
    share = {name: float(a.sum()) for name, a in many.components.items() if name.startswith("mesh")}
    np.testing.assert_allclose(share["mesh 1"] / 0.5, beyond_edge((1, 0), 1.0), atol=0.01)
    assert share["mesh 2"] / 0.5 < 0.01
    assert float(survey.footprint_radius[0]) == pytest.approx(0.5e-3 * VERTICAL)
    # Labels: rays that meet the first panel, and none the second.
    returns = many.returns().labelled(survey, jl.Scene(meshes=panels, ground=jl.Ground(height=-10.0)))
    assert returns.instance.tolist() == [1, 0]
    # Off the map: what lies beyond its border.
    voxels = jl.VoxelMap.from_lad(np.ones((10, 10, 1)), voxel_size=10.0, origin=(0.6, -50.0, 0.0))
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4))
    for azimuth, normal in ((90.0, (1, 0)), (0.0, (0, 1))):
        one = jl.Survey(lidar(azimuth=azimuth), position=[(0.0, 0.0)], azimuth=azimuth)
        off = off_map(one, jl.Scene(canopy=canopy))
        np.testing.assert_allclose(1.0 - off[0], beyond_edge(normal, 0.6), atol=0.01)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"profile": "top-hat"}, "level_divergence is given with profile = 'top-hat'"),
        ({"level_divergence": 0.0}, r"level_divergence = 0 .*\(0, 300\]"),
        ({"divergence": 0.0}, "level_divergence is given with divergence = 0"),
        ({"level_divergence": [1.0, 2.0]}, "level_divergence has shape"),
        ({"ellipse_turn": math.nan}, "ellipse_turn = nan"),
        ({"ellipse_turn": 361.0}, r"ellipse_turn = 361 .*\[-360, 360\]"),
        ({"ellipse_turn": 5.0, "level_divergence": None}, "ellipse_turn is given without level_divergence"),
    ],
)
def test_inadmissible_ellipses_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        lidar(**fields)


def test_turns_of_round_beams_and_beyond_a_turn_are_refused():
    with pytest.raises(ValueError, match="ellipse_turn is given, but the beam of lidar is round"):
        jl.Survey(jl.Lidar(), [(0.0, 0.0)], ellipse_turn=5.0)
    with pytest.raises(ValueError, match=r"ellipse_turn = 1e\+30 .*\[-360, 360\]"):
        jl.Survey(lidar(), [(0.0, 0.0)], ellipse_turn=1e30)
