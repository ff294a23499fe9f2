"""A lidar that is placed by its sensor: anywhere, looking anywhere, against closed forms.

Order one of a slab of extinction k of leaves of the reflectance R, seen along a ray of the length s, is
(2/3) R (1 - exp(-k s)) with the hot spot, whichever way the beam goes. A wall is a plate on edge.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.sensors.lidar import tan_half
from tests.helpers import agrees, slab, slow_unless
from tests.scenes.test_outlines import SPHERE, Sphere

KEY = jax.random.key(0)
METRES_PER_NS = 0.5 * jl.SPEED_OF_LIGHT
# Of a slab 10 m high, on z = 0, of the extinction 0.2 /m.
EXTINCTION = 0.2
LEAVES = {"leaf": jl.LeafOptics(0.5, 0.3), "hotspot": True}


def canopy(**changes):
    voxels = slab(10.0 * EXTINCTION, shape=(8, 8, 10))
    return jl.Canopy(voxels, **{**LEAVES, **changes})


def look(sensor, zenith, azimuth=0.0, **changes):
    return jl.Lidar(sensor=sensor, zenith=zenith, azimuth=azimuth, **changes)


def first_order(lidar, scene, **options):
    return jl.simulate(lidar, scene, key=KEY, max_orders=1, rtol=0.005, **options)


def total(wave):
    return float(np.sum(wave.reflectance))


def mean_range(wave):
    """Range of the centroid of a waveform, m; time zero is the emission."""
    return float(np.average(np.asarray(wave.time, float), weights=wave.reflectance[0])) * METRES_PER_NS


# -- planes and shapes -------------------------------------------------------------------------------------


@pytest.mark.parametrize("zenith", slow_unless([40.0], [0.0, 40.0, 75.0]))
def test_ground_is_seen_at_its_range(zenith):
    """Range H / cos, apparent reflectance rho cos, energy E A rho cos / (pi r^2)."""
    wave = first_order(
        look((3.0, -2.0, 12.0), zenith), jl.Scene(ground=jl.Ground(height=2.0, reflectance=0.4))
    )
    cosine = np.cos(np.deg2rad(zenith))
    distance = 10.0 / cosine
    assert total(wave) == pytest.approx(0.4 * cosine, rel=1e-4)
    assert mean_range(wave) == pytest.approx(distance, rel=1e-5)
    energy = 1e-3 * (np.pi * 0.1**2) / (np.pi * distance**2) * 0.4 * cosine
    assert float(wave.energy.sum()) == pytest.approx(energy, rel=1e-4)
    peak = int(np.argmax(wave.reflectance))
    assert float(wave.height[peak]) == pytest.approx(2.0, abs=0.15 * cosine + 1e-3)


def test_ground_at_a_grazing_angle_is_lost_unless_the_window_has_it():
    """At 0.2 degrees from the level the ground is 430 m away, beyond the automatic record."""
    lidar, scene = look((0.0, 0.0, 1.5), 89.8, divergence=0.01), jl.Scene(ground=jl.Ground(reflectance=0.4))
    expected = 0.4 * np.cos(np.deg2rad(89.8))
    short, long = first_order(lidar, scene), first_order(lidar, scene, window=(0.0, 3000.0))
    assert total(short) == 0.0
    assert float(short.lost[0]) == pytest.approx(expected, rel=1e-2)
    assert total(long) == pytest.approx(expected, rel=1e-2)


# A wall: a plate 0.1 degrees from the vertical through (20, 0, 0), whose normal looks west.
WALL = jl.Plate(height=0.0, slope=89.9, aspect=270.0, position=(20.0, 0.0), reflectance=0.6)
TO_WALL, WALL_NORMAL = (
    np.array([20.0, 0.0, 0.0]),
    np.array([-np.cos(np.deg2rad(0.1)), 0, np.sin(np.deg2rad(0.1))]),
)


def range_and_cosine(sensor, direction):
    """Range, m, at which a beam meets the wall, and the cosine of incidence."""
    cosine = direction @ WALL_NORMAL
    return (TO_WALL - sensor) @ WALL_NORMAL / cosine, np.abs(cosine)


def test_a_wall_is_seen_by_level_and_inclined_beams():
    for zenith, azimuth in ((90.0, 90.0), (70.0, 60.0), (120.0, 110.0)):
        lidar = look((0.0, 0.0, 1.5), zenith, azimuth)
        distance, cosine = range_and_cosine(np.array([0.0, 0.0, 1.5]), np.asarray(lidar.direction))
        wave = first_order(lidar, jl.Scene(plates=(WALL,)))
        assert total(wave) == pytest.approx(0.6 * cosine, rel=1e-4)
        assert mean_range(wave) == pytest.approx(distance, rel=1e-4)
    # Away from the wall there is nothing: a sensor sees what lies before it.
    assert total(first_order(look((0.0, 0.0, 1.5), 90.0, 270.0), jl.Scene(plates=(WALL,)))) == 0.0


def test_a_wide_beam_widens_from_the_sensor():
    """A top-hat beam of the half-angle a on level ground 2 m below, in closed form by its rays.

    A ray at the angle g from the axis meets the ground at 2 / cos(g), and returns rho cos(g), of which the
    flat aperture sees cos(g).
    """
    a = 0.1
    lidar = look((0.0, 0.0, 2.0), 0.0, divergence=2e3 * a, profile="top-hat", sampling_interval=0.05)
    wave = first_order(lidar, jl.Scene(ground=jl.Ground()))
    # Uniform over the disc at 1 m, whose rays go to r = a sqrt(u): the path is 2 sqrt(1 + r^2).
    r = a * np.sqrt((np.arange(2000) + 0.5) / 2000)
    cosine = 1.0 / np.sqrt(1.0 + r**2)
    assert total(wave) == pytest.approx(float(jl.Ground().reflectance) * np.mean(cosine**2), rel=1e-4)
    mean = float(np.average(2.0 / cosine, weights=cosine**2))
    assert mean_range(wave) == pytest.approx(mean, rel=1e-5)
    # Of a beam that does not widen the mean is 2 m.
    assert abs(mean - 2.0) > 100 * 1e-5


def test_a_wide_field_of_view_is_an_angle():
    """A top-hat beam of 7.5 m radius on level ground 10 m below, seen within 1 rad.

    As above; the field ends, softly, where the tangent to the axis is tan(0.5), and not 0.5.
    """
    field = 1000.0
    lidar = look((0.0, 0.0, 10.0), 0.0, field_of_view=field, profile="top-hat", sampling_interval=2.0)
    # Wider than is admissible for a user, so that the field of view is what counts.
    lidar = eqx.tree_at(lambda v: v.divergence, lidar, jnp.asarray(1500.0))
    tangent = 0.75 * np.sqrt((np.arange(20_000) + 0.5) / 20_000)
    expected = {}
    for name, edge in (("angle", np.tan(0.5e-3 * field)), ("small angle", 0.5e-3 * field)):
        seen = 1.0 / (1.0 + np.exp(np.clip((tangent / edge - 1.0) / 0.02, -80.0, 80.0)))
        expected[name] = 0.3 * np.mean(seen / (1.0 + tangent**2))
    wave = jl.simulate(lidar, jl.Scene(ground=jl.Ground()), key=KEY, max_orders=1, rtol=0.001)
    assert total(wave) == pytest.approx(expected["angle"], rel=2e-3)
    assert expected["angle"] == pytest.approx(0.1393, abs=2e-4)
    assert expected["small angle"] == pytest.approx(0.1191, abs=2e-4)


def test_the_half_space_and_what_is_wider():
    assert float(tan_half(1000.0)) == pytest.approx(np.tan(0.5))
    assert float(tan_half(3141.6)) == float(tan_half(3200.0)) > 900.0
    with pytest.raises(ValueError, match=r"divergence.*300"):
        jl.Lidar(divergence=301.0)


@pytest.mark.slow
def test_time_and_light_are_those_of_the_same_lidar_by_its_altitude():
    scene = jl.Scene(canopy=canopy(), ground=jl.Ground(slope=10.0))
    options = {"divergence": 20.0, "aperture": 0.05, "profile": "top-hat"}
    above = jl.Lidar(altitude=80.0, zenith=20.0, azimuth=30.0, position=(2.0, 1.0), **options)
    sensor = look(np.asarray(above.sensor), 20.0, 30.0, **options)
    waves = [first_order(lidar, scene, footprint="fixed") for lidar in (above, sensor)]
    distance = float(above.range_to_reference)
    assert total(waves[0]) == pytest.approx(total(waves[1]), rel=1e-4)
    assert float(waves[0].energy.sum()) == pytest.approx(float(waves[1].energy.sum()), rel=1e-3)
    shift = mean_range(waves[1]) - mean_range(waves[0])
    assert shift == pytest.approx(distance, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("rise", [0.0, 0.3])
def test_terrain_that_is_a_plane_ends_at_its_border(rise):
    """From 60 m above the middle of 100 m, a beam 30 degrees off nadir meets it, and one of 60 does not."""
    heights = rise * np.arange(101.0)[:, None] + np.zeros(101)
    scene = jl.Scene(ground=jl.Terrain(heights, spacing=1.0, reflectance=0.4))
    sensor = (50.0, 50.0, 60.0 + 50.0 * rise)
    inside, outside = (look(sensor, zenith, 90.0, divergence=0.05) for zenith in (30.0, 60.0))
    distance = 60.0 / (np.cos(np.deg2rad(30.0)) + rise * np.sin(np.deg2rad(30.0)))
    assert mean_range(first_order(inside, scene)) == pytest.approx(distance, rel=1e-5)
    assert total(first_order(outside, scene)) == 0.0
    # A periodic plane goes on.
    if rise == 0.0:
        level = jl.Scene(ground=jl.Terrain(heights, spacing=1.0, reflectance=0.4, sides="periodic"))
        assert total(first_order(outside, level)) == pytest.approx(0.2, rel=1e-4)


# -- plants ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("height", "zenith", "length"),
    [
        # From below, from within upwards and downwards, level to the side of the map, and from above.
        pytest.param(-3.0, 150.0, 10.0 / np.cos(np.deg2rad(30.0)), marks=pytest.mark.slow),
        pytest.param(4.0, 150.0, 6.0 / np.cos(np.deg2rad(30.0)), marks=pytest.mark.slow),
        (4.0, 20.0, 4.0 / np.cos(np.deg2rad(20.0))),
        (4.0, 90.0, 20.0),
        pytest.param(4.0, 180.0, 6.0, marks=pytest.mark.slow),
        pytest.param(25.0, 10.0, 10.0 / np.cos(np.deg2rad(10.0)), marks=pytest.mark.slow),
        # From above, looking up.
        pytest.param(25.0, 170.0, 0.0, marks=pytest.mark.slow),
    ],
)
def test_first_order_of_a_slab_from_anywhere(height, zenith, length):
    scene = jl.Scene(canopy=canopy())
    wave = first_order(look((0.0, 0.0, height), zenith), scene)
    expected = 2.0 / 3.0 * 0.5 * (1.0 - np.exp(-EXTINCTION * length))
    assert total(wave) == pytest.approx(expected, rel=2e-4, abs=1e-7)
    # What is behind the sensor, which the wrong sign of the beam would see, is another length.
    if 0 < length < 10:
        behind = 2.0 / 3.0 * 0.5 * (1.0 - np.exp(-EXTINCTION * (20.0 - length)))
        assert abs(total(wave) - behind) > 0.02


@pytest.mark.slow
def test_energy_is_conserved_from_within_a_canopy():
    """Leaves and ground that absorb nothing, without sides: all light escapes, returns or is in flight."""
    scene = jl.Scene(
        canopy=canopy(leaf=jl.LeafOptics(0.6, 0.4), sides="periodic"), ground=jl.Ground(reflectance=1.0)
    )
    lidar = look((0.0, 0.0, 3.0), 140.0, sampling_interval=5.0, field_of_view=100.0)
    wave = jl.simulate(lidar, scene, key=KEY, max_orders=6, n_photons=2048, rtol=0.5, window=(0.0, 4000.0))
    budget = {name: float(value[0]) for name, value in wave.energy_budget.items()}
    absorbed = sum(value for name, value in budget.items() if name.startswith("absorbed"))
    assert absorbed == pytest.approx(0.0, abs=2e-4)
    stderr = sum(float(value[0]) for value in wave.energy_budget_stderr.values())
    assert agrees(sum(budget.values()), max(stderr, 1e-4), 1.0)
    assert budget["escaped"] > 0.1


def isotropic_second_order(extinction, top, sensor_height, albedo, rng, n):
    """Second-order return of an isotropic slab from a sensor within it that looks straight up, by NumPy.

    Light flies up from z_s, collides at z_1, flies in a direction of uniform distribution, collides at x_2,
    and returns straight to the sensor: apparent reflectance pi p exp(-k r) (r_t / r)^2 cos, with p = 1 / (4
    pi), r the distance of x_2 and r_t half the path. The aperture has a radius of 0.1 m.
    """
    first = -np.log1p(-rng.random(n) * -np.expm1(-extinction * (top - sensor_height))) / extinction
    weight = np.full(n, -np.expm1(-extinction * (top - sensor_height)) * albedo**2)
    cosine, turn = rng.uniform(-1, 1, n), rng.uniform(0, 2 * np.pi, n)
    sine = np.sqrt(1 - cosine**2)
    z = sensor_height + first
    room = np.where(cosine > 0, (top - z) / np.maximum(cosine, 1e-9), z / np.maximum(-cosine, 1e-9))
    weight = weight * -np.expm1(-extinction * room)
    second = -np.log1p(-rng.random(n) * -np.expm1(-extinction * room)) / extinction
    x, up = second * sine * np.cos(turn), z + second * cosine - sensor_height
    y = second * sine * np.sin(turn)
    distance = np.sqrt(x * x + y * y + up * up)
    recorded = 0.5 * (first + second + distance)
    seen = np.maximum(up, 0.0) / distance * (recorded / np.maximum(distance, 0.1)) ** 2
    value = weight * 0.25 * np.exp(-extinction * distance) * seen
    return value.mean(), value.std() / np.sqrt(n)


@pytest.mark.slow
def test_second_order_within_a_slab_agrees_with_another_code():
    """Fails by 20 standard errors if light from behind the sensor, or without the cosine, were seen."""
    extinction, albedo, height = 0.3, 0.8, 4.0
    expected, expected_stderr = isotropic_second_order(
        extinction, 10.0, height, albedo, np.random.default_rng(0), 400_000
    )
    scene = jl.Scene(
        canopy=jl.Canopy(
            slab(10.0 * extinction, width=400.0, origin=(-200.0, -200.0, 0.0)),
            leaf=jl.Isotropic(albedo=albedo),
            hotspot=True,
        )
    )
    lidar = look((0.0, 0.0, height), 180.0, divergence=1e-3, sampling_interval=2000.0)
    wave = jl.simulate(
        lidar, scene, key=KEY, max_orders=2, n_photons=16384, rtol=0.03, window=(900.0, 901.0), bin_width=20.0
    )
    higher, stderr = float(wave.components["higher"].sum()), float(wave.stderr.max())
    assert agrees(higher, np.hypot(stderr, expected_stderr), expected)
    assert not agrees(higher, np.hypot(stderr, expected_stderr), 1.25 * expected)


# -- surveys -----------------------------------------------------------------------------------------------


WALL_AND_GROUND = jl.Scene(ground=jl.Ground(reflectance=0.3), plates=(WALL,))


@pytest.fixture(scope="module")
def terrestrial_scan():
    """Shots from one place in many directions, their waveforms, and the ranges of what they meet."""
    zenith, azimuth = np.array([60.0, 80.0, 90.0, 100.0, 30.0]), np.array([90.0, 80.0, 90.0, 90.0, 0.0])
    survey = jl.Survey(jl.Lidar(), sensor=np.tile([5.0, 3.0, 4.0], (5, 1)), zenith=zenith, azimuth=azimuth)
    waveforms = jl.simulate_many(survey, WALL_AND_GROUND, key=KEY, max_orders=1, rtol=0.02, truth=True)
    to_wall, _ = range_and_cosine(survey.sensor[0], survey.direction)
    to_ground = 4.0 / np.maximum(-survey.direction[:, 2], 1e-9)
    hits_wall = (to_wall > 0) & (to_wall < to_ground)
    return survey, waveforms, np.where(hits_wall, to_wall, to_ground), hits_wall


def test_a_terrestrial_scan_of_a_wall_and_ground(terrestrial_scan):
    """Shots of many directions share one program; ranges and reflectances are those of the planes."""
    survey, waveforms, distance, hits_wall = terrestrial_scan
    scene, w = WALL_AND_GROUND, survey.direction
    _, wall_cosine = range_and_cosine(survey.sensor[0], w)
    to_ground = 4.0 / np.maximum(-w[:, 2], 1e-9)
    cosine = np.where(hits_wall, 0.6 * wall_cosine, -0.3 * w[:, 2])
    sums = waveforms.reflectance.sum(axis=(1, 2))
    centroid = (waveforms.reflectance[:, 0] * waveforms.time).sum(axis=1) / sums * METRES_PER_NS
    np.testing.assert_allclose(sums, cosine, rtol=2e-3)
    np.testing.assert_allclose(centroid, distance, rtol=1e-3)
    ground = survey.sensor + to_ground[:, None] * w
    goes_down = w[:, 2] < -1e-6
    np.testing.assert_allclose(waveforms.ground_position[goes_down], ground[goes_down], atol=1e-3)
    assert np.all(np.isnan(waveforms.ground_position[~goes_down]))
    np.testing.assert_allclose(waveforms.ground_position, jl.ground_position(survey, scene), atol=1e-4)
    # A shot alone is that of the survey.
    wave = jl.simulate(survey[1], scene, key=KEY, max_orders=1)
    assert total(wave) == pytest.approx(float(sums[1]), rel=1e-3)
    assert float(waveforms[1].height[0]) == pytest.approx(
        4.0 - waveforms.time[0] * METRES_PER_NS * np.cos(np.deg2rad(80.0)), abs=1e-3
    )


@pytest.mark.parametrize("detector", ["peak", "constant fraction"])
def test_returns_of_a_terrestrial_scan_lie_on_the_wall_and_the_ground(detector, terrestrial_scan):
    """Positions start at the sensor: s + r w, with the ranges of the planes in closed form."""
    survey, waveforms, distance, hits_wall = terrestrial_scan
    returns = waveforms.returns(detector)
    assert returns.shot.tolist() == list(range(5))
    assert returns.material.tolist() == np.where(hits_wall, "plate", "ground").tolist()
    np.testing.assert_allclose(returns.range, distance, atol=5e-3)
    np.testing.assert_allclose(
        returns.position, survey.sensor + distance[:, None] * survey.direction, atol=5e-3
    )
    np.testing.assert_allclose(returns.reflectance, waveforms.reflectance.sum(axis=(1, 2)), rtol=5e-3)
    # From the wrong end of the axis, 1 m ahead of the sensor, all would be 1 m off.
    assert np.all(np.abs(returns.range + 1.0 - distance) > 0.9)
    # A shot alone, and the truth.
    alone = waveforms[3].returns(survey[3], detector)
    np.testing.assert_allclose(alone.position[0], returns.position[3], atol=1e-4)
    true = waveforms.true_returns()
    np.testing.assert_allclose(true.range, distance, atol=0.02)
    is_inclined = np.abs(survey.direction[:, 2]) > 0.4
    np.testing.assert_allclose(true.range[is_inclined], distance[is_inclined], atol=1e-4)


def mesh_wall(east, reflectance):
    """A square of 80 m, of two triangles, across the x axis."""
    corners = np.array([[east, y, z] for y, z in ((-40, -40), (40, -40), (40, 40), (-40, 40))], float)
    return jl.MeshSurface((corners, [[0, 1, 2], [0, 2, 3]]), reflectance)


@pytest.mark.slow
def test_a_mesh_is_seen_from_before_it_alone():
    ahead = jl.Scene(meshes=(mesh_wall(10.0, 0.6),))
    for zenith, azimuth in ((90.0, 90.0), (60.0, 70.0)):
        lidar = look((0.0, 0.0, 1.5), zenith, azimuth)
        cosine = float(lidar.direction[0])
        wave = first_order(lidar, ahead)
        assert total(wave) == pytest.approx(0.6 * cosine, rel=1e-4)
        assert mean_range(wave) == pytest.approx(10.0 / cosine, rel=1e-4)
    assert total(first_order(look((0.0, 0.0, 1.5), 90.0, 270.0), ahead)) == 0.0


@pytest.mark.slow
def test_a_mesh_behind_the_sensor_hides_nothing():
    """Light from a wall and the ground: of a mesh, with a black one behind the sensor, as of a plate."""
    ground = jl.Ground(reflectance=0.8)
    plate = jl.Plate(height=0.0, slope=89.99, aspect=270.0, position=(10.0, 0.0), reflectance=0.6)
    scenes = (
        jl.Scene(ground=ground, plates=(plate,)),
        jl.Scene(ground=ground, meshes=(mesh_wall(10.0, 0.6), mesh_wall(-2.0, 0.0))),
    )
    lidar = look((0.0, 0.0, 1.5), 90.0, 90.0, field_of_view=400.0, sampling_interval=5.0)
    waves = [
        jl.simulate(lidar, scene, key=KEY, max_orders=2, n_photons=8192, rtol=0.05, window=(0.0, 200.0))
        for scene in scenes
    ]
    sums = [float(wave.components["higher"].sum()) for wave in waves]
    stderr = float(np.hypot(*(np.sqrt(np.sum(np.square(wave.stderr))) for wave in waves)))
    assert sums[0] > 0.01
    assert agrees(sums[1], stderr, sums[0])
    # Nothing of the order, which a wall that hides it would leave, differs by much more.
    assert not agrees(0.0, stderr, sums[0])


@pytest.mark.slow
def test_a_terrestrial_scan_of_a_sphere():
    """From the sensor, a sphere of radius a at the distance d is met at d cos(g) - sqrt(a^2 - d^2 sin(g)^2).

    g is the angle of the beam from its centre. Beams past the rim meet nothing.
    """
    radius, distance = 2.0, 12.0
    scene = jl.Scene(plates=(Sphere(height=5.0, radius=radius, east=distance),))
    off_centre = np.array([0.0, 4.0, 8.0, 12.0])
    survey = jl.Survey(
        jl.Lidar(divergence=0.01, sampling_interval=0.5),
        sensor=np.tile([0.0, 0.0, 5.0], (4, 1)),
        zenith=90.0 + off_centre,
        azimuth=90.0,
    )
    waveforms = jl.simulate_many(survey, scene, key=KEY, max_orders=1, rtol=0.02)
    angle = np.deg2rad(off_centre)
    half_chord = np.sqrt(np.maximum(radius**2 - (distance * np.sin(angle)) ** 2, 0.0))
    expected = distance * np.cos(angle) - half_chord
    sums = waveforms.reflectance.sum(axis=(1, 2))
    np.testing.assert_allclose(sums, SPHERE * half_chord / radius, rtol=2e-3, atol=1e-9)
    assert sums[3] == 0.0
    centroid = (waveforms.reflectance[:3, 0] * waveforms.time).sum(axis=1) / sums[:3] * METRES_PER_NS
    np.testing.assert_allclose(centroid, expected[:3], rtol=1e-4)


@pytest.mark.slow
def test_the_range_has_a_derivative_by_the_height_of_the_sensor():
    """Over level ground seen at the zenith angle 30 degrees, the range is z / cos(30 degrees)."""
    scene = jl.Scene(ground=jl.Ground())
    plan = jl.plan(look((0.0, 0.0, 12.0), 30.0), scene, window=(60.0, 130.0))

    def centroid(z):
        wave = jl.simulate(look((0.0, 0.0, z), 30.0), scene, key=KEY, plan=plan)
        return jnp.sum(wave.reflectance[0] * wave.time) / jnp.sum(wave.reflectance) * METRES_PER_NS

    value, slope = jax.jvp(centroid, (12.0,), (1.0,))
    assert float(value) == pytest.approx(12.0 / np.cos(np.deg2rad(30.0)), rel=1e-5)
    assert float(slope) == pytest.approx(1.0 / np.cos(np.deg2rad(30.0)), rel=1e-3)


# -- air ---------------------------------------------------------------------------------------------------


def test_air_along_level_and_inclined_beams():
    air = jl.Atmosphere(visibility=10.0, rayleigh=False, aerosol_scale_height=50.0)
    k = float(air.extinction(1064.0, 0.0)[()])
    for zenith in (90.0, 120.0, 60.0):
        cosine = np.cos(np.deg2rad(zenith))
        s = np.linspace(0.0, 40.0, 20001)
        column = np.trapezoid(k * np.exp(-(30.0 - s * cosine) / 50.0), s)
        transmittance = air.two_way_transmittance_along(1064.0, 40.0, 30.0, zenith)
        assert float(transmittance) == pytest.approx(np.exp(-2 * column), rel=1e-5)
    down = air.two_way_transmittance_along(1064.0, 30.0 / 0.5, 30.0, 60.0)
    assert float(down) == pytest.approx(float(air.two_way_transmittance(1064.0, 0.0, 30.0, 60.0)), rel=1e-5)


# -- inadmissible input ------------------------------------------------------------------------------------


def test_sensors_that_are_refused():
    ground = jl.Ground(height=1.0)
    for lidar, scene, message in (
        (look((0, 0, 0.5), 0.0), jl.Scene(ground=ground), "below the ground"),
        (look((0, 0, 2.0), 0.0), jl.Scene(plates=(jl.Plate(height=2.0, reflectance=0.5),)), "in a plate"),
        (look((0, 0, 2.0), 90.0), jl.Scene(canopy=canopy(sides="periodic")), "level beam"),
        (
            look((0, 0, 2.0), 90.0),
            jl.Scene(ground=jl.Ground(), atmosphere=jl.Atmosphere(lidar_ratio=50.0)),
            "lidar_ratio",
        ),
        (
            look((5.0, 5.0, 2.9), 90.0),
            jl.Scene(ground=jl.Terrain(np.full((11, 11), 3.0) + np.eye(11), spacing=1.0)),
            "below the ground",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            jl.plan(lidar, scene)
    scene = jl.Scene(ground=jl.Ground())
    plan = jl.plan(jl.Lidar(altitude=10.0), scene)
    with pytest.raises(ValueError, match="placed by its sensor"):
        jl.simulate(look((0, 0, 10.0), 0.0), scene, key=KEY, plan=plan)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sensor": (0, 0)}, "sensor"),
        ({"sensor": (0, 0, np.nan)}, "position"),
        ({"sensor": (0, 0, 1), "altitude": 10.0}, "altitude is given together with sensor"),
        ({"sensor": (0, 0, 1), "position": (0, 0)}, "position is given together with sensor"),
        ({"sensor": (0, 0, 1), "zenith": 181.0}, "zenith"),
        ({"zenith": 90.0}, "zenith"),
    ],
)
def test_inadmissible_places(arguments, message):
    with pytest.raises(ValueError, match=message):
        jl.Lidar(**arguments)


def test_a_lidar_with_a_sensor_is_kept_in_files(tmp_path):
    survey = jl.Survey(jl.Lidar(), sensor=[(1.0, 2.0, 3.0)] * 2, zenith=[80.0, 100.0])
    case = jl.io.Case(survey=survey, scene=jl.Scene(ground=jl.Ground()))
    jl.io.write_case(tmp_path / "case.toml", case)
    read = jl.io.read_case(tmp_path / "case.toml").survey
    assert read.has_sensor_position
    np.testing.assert_array_equal(read.sensor, survey.sensor)
    np.testing.assert_array_equal(read[1].sensor, survey[1].sensor)
    waveforms = jl.simulate_many(read, case.scene, key=KEY, max_orders=1)
    waveforms.save(tmp_path / "waveforms.nc", jl.io.Case(survey=read, scene=case.scene))
    np.testing.assert_array_equal(
        jl.open(tmp_path / "waveforms.nc").ground_position, waveforms.ground_position
    )


def test_messages_do_not_show_the_local_origin():
    lidar, scene = look((512345.25, 6123456.5, 420.0), 0.0), jl.Scene(ground=jl.Ground(height=430.0))
    with pytest.raises(ValueError, match="at the height 420 m is below the ground") as refusal:
        jl.plan(lidar, scene)
    assert "0.0, 0.0" not in str(refusal.value)
    assert "512345.25, 6123456.5, 420" in str(lidar)
