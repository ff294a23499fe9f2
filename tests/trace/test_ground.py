r"""Bare ground: apparent reflectance, arrival time, duration and energy of its return.

Layout: a lidar over one infinite plane, no atmosphere. With rho the reflectance, R the range, theta the
angle between the beam and the plane's normal, the apparent reflectance summed over samples is

    Lambertian      rho cos(theta)
    specular        rho (1 - exp(-2 a^2 / w^2)) / alpha^2,  w^2 = (2 w_f)^2 + 4 (R m)^2
    equal-angle     rho / (pi sqrt(sin^2(theta) + alpha^2 / 4))

a the aperture's radius, alpha = a / R, w_f the footprint's 1/e^2 radius, m the roughness; alpha^2 times
the apparent reflectance is the fraction of the pulse that enters the aperture. The energy is
E eta A_r / (pi R^2) times it. A plane tilted by `slope` returns a Gaussian pulse (standard deviation
sigma_p) under a Gaussian beam (sigma_f = w_f / 2) with the variance

    sigma_p^2 + dt^2 / 12 + (2 sigma_f tan(slope) / c)^2,

dt^2 / 12 being that of the sample.

Tolerance: one plane is integrated by a Gauss rule, so that only rounding (1e-6), the truncation of the pulse
at 5.5 sigma (1e-7) and the divergence (second order, below 1e-5) contribute: 1e-4 throughout.
"""

import itertools

import jax
import numpy as np
import pytest
from scipy.integrate import quad

import jaxlidar as jl
from jaxlidar import SPEED_OF_LIGHT

KEY = jax.random.key(20)
TOLERANCE = 1e-4


def total(wave):
    return np.asarray(wave.reflectance, float).sum(axis=1)


def moments(wave):
    """Return centroid and variance of the waveform at the first wavelength, in ns and ns^2."""
    time, power = np.asarray(wave.time, float), np.asarray(wave.reflectance[0], float)
    mean = np.sum(time * power) / np.sum(power)
    return mean, np.sum((time - mean) ** 2 * power) / np.sum(power)


@pytest.fixture(scope="module", params=["gaussian", "top-hat"])
def flat_ground(request):
    """A lidar of three wavelengths, and one plan for all grounds between -40 and 100 m, to compile once."""
    lidar = jl.Lidar(
        wavelength=(532.0, 1064.0, 1550.0),
        profile=request.param,
        energy=(1e-3, 2e-3, 5e-4),
        efficiency=(0.5, 0.6, 0.7),
    )
    return lidar, jl.plan(lidar, jl.Scene(ground=jl.Ground(height=100.0)), window=(-720.0, 320.0))


@pytest.mark.parametrize("height", [0.0, 12.34, 100.0, -40.0])
def test_flat_ground_returns_its_reflectance_at_the_two_way_time(flat_ground, height):
    lidar, plan = flat_ground
    rho = np.array([0.1, 0.35, 1.0])
    scene = jl.Scene(ground=jl.Ground(height=height, reflectance=rho))
    wave = jl.simulate(lidar, scene, key=KEY, plan=plan)
    np.testing.assert_allclose(total(wave), rho, rtol=TOLERANCE)
    np.testing.assert_array_equal(wave.stderr, 0.0)
    np.testing.assert_allclose(wave.components["ground"], wave.reflectance)

    arrival = -2.0 * height / SPEED_OF_LIGHT
    assert moments(wave)[0] == pytest.approx(arrival, abs=1e-3)
    assert abs(float(wave.time[np.argmax(wave.reflectance[0])]) - arrival) <= 0.5
    height_at_peak = float(wave.height[np.argmax(wave.reflectance[0])])
    assert abs(height_at_peak - height) <= 0.25 * SPEED_OF_LIGHT + 1e-3

    # The lidar equation with the range of the ground; the range of the reference plane is rejected.
    area = np.pi * 0.1**2
    joules = np.array([1e-3, 2e-3, 5e-4]) * [0.5, 0.6, 0.7] * area / (np.pi * (1000.0 - height) ** 2) * rho
    np.testing.assert_allclose(np.asarray(wave.energy, float).sum(axis=1), joules, rtol=TOLERANCE)
    wrong = joules * (1000.0 - height) ** 2 / 1000.0**2
    assert height == 0.0 or not np.allclose(np.asarray(wave.energy, float).sum(1), wrong, rtol=1e-3, atol=0)


@pytest.fixture(scope="module")
def wide_beam():
    """A beam of 2 mrad (sigma_f = 0.5 m), and one plan for all slopes up to 60 degrees."""
    lidar = jl.Lidar(divergence=2.0, pulse=jl.GaussianPulse(fwhm=4.0))
    steepest = jl.Scene(ground=jl.Ground(slope=60.0))
    return lidar, jl.plan(lidar, steepest, window=(-80.0, 80.0))


@pytest.mark.parametrize(
    ("slope", "aspect"), [(0.0, 0.0), (1.0, 40.0), (15.0, 0.0), (30.0, 135.0), (45.0, 270.0), (60.0, 10.0)]
)
def test_tilted_ground_broadens_the_pulse(wide_beam, slope, aspect):
    lidar, plan = wide_beam
    scene = jl.Scene(ground=jl.Ground(reflectance=0.4, slope=slope, aspect=aspect))
    wave = jl.simulate(lidar, scene, key=KEY, plan=plan)
    assert total(wave)[0] == pytest.approx(0.4 * np.cos(np.deg2rad(slope)), rel=TOLERANCE)
    spread = 2.0 * 0.5 * np.tan(np.deg2rad(slope)) / SPEED_OF_LIGHT
    sigma = 4.0 / np.sqrt(8.0 * np.log(2.0))
    mean, variance = moments(wave)
    assert mean == pytest.approx(0.0, abs=0.01)
    assert variance == pytest.approx(sigma**2 + 1.0 / 12.0 + spread**2, rel=TOLERANCE)


# Slope, aspect, azimuth and zenith of the beam, degrees. The plane lies 5 m above the aim point.
FACING = {
    "east, beam to the east": (20.0, 90.0, 90.0, 30.0),
    "east, beam to the west": (20.0, 90.0, 270.0, 30.0),
    "east, beam to the north": (20.0, 90.0, 0.0, 30.0),
    "north-east, beam to the south": (35.0, 45.0, 180.0, 15.0),
}


def plane_return(slope, aspect, azimuth, zenith, height=5.0):
    """Return cosine of incidence and two-way time, ns, of a pencil beam on a plane, in closed form.

    With d the direction of the beam and n the normal of the plane, tilted towards its aspect, the beam meets
    the plane at the distance n_z h / (n.d) behind the aim point.
    """
    s, a, b, z = np.deg2rad([slope, aspect, azimuth, zenith])
    normal = np.array([np.sin(s) * np.sin(a), np.sin(s) * np.cos(a), np.cos(s)])
    beam = np.array([np.sin(z) * np.sin(b), np.sin(z) * np.cos(b), -np.cos(z)])
    return -normal @ beam, 2.0 * normal[2] * height / (normal @ beam) / SPEED_OF_LIGHT


@pytest.mark.parametrize("name", FACING)
def test_tilted_ground_off_nadir_returns_at_its_time(name):
    """An aspect with the wrong sign of east is rejected where the plane falls to the east."""
    slope, aspect, azimuth, zenith = FACING[name]
    lidar = jl.Lidar(divergence=0.0, zenith=zenith, azimuth=azimuth)
    ground = jl.Ground(height=5.0, reflectance=0.4, slope=slope, aspect=aspect)
    wave = jl.simulate(lidar, jl.Scene(ground=ground), key=KEY, window=(-100.0, 30.0))
    cosine, time = plane_return(slope, aspect, azimuth, zenith)
    assert total(wave)[0] == pytest.approx(0.4 * cosine, rel=TOLERANCE)
    assert moments(wave)[0] == pytest.approx(time, abs=2e-3)
    mirrored_cosine, mirrored_time = plane_return(slope, -aspect, azimuth, zenith)
    assert np.sin(np.deg2rad(azimuth)) == pytest.approx(0.0) or abs(mirrored_time - time) > 1.0
    assert np.sin(np.deg2rad(azimuth)) == pytest.approx(0.0) or abs(mirrored_cosine - cosine) > 0.1


@pytest.mark.parametrize("divergence", [0.0, 1e-3, 0.02, 0.3, 3.0])
def test_a_mirror_fills_the_aperture_as_a_gaussian_beam_does(divergence, mirror_plan):
    w = 2.0 * 0.5 * divergence
    exact = -np.expm1(-2.0 * 0.1**2 / max(w, 1e-6) ** 2)
    assert mirrored_fraction(divergence, 0.0, mirror_plan) == pytest.approx(exact, rel=TOLERANCE)


@pytest.mark.parametrize("roughness", [3e-5, 1e-4, 1e-2])
@pytest.mark.parametrize("divergence", [0.0, 0.02, 0.3, 3.0])
def test_roughness_widens_the_mirror_image(divergence, roughness, mirror_plan):
    w2, blur = (2.0 * 0.5 * divergence) ** 2, 4.0 * (1000.0 * roughness) ** 2
    exact, without_roughness = (
        -np.expm1(-2.0 * 0.1**2 / (w2 + blur)),
        -np.expm1(-2.0 * 0.1**2 / max(w2, 1e-12)),
    )
    fraction = mirrored_fraction(divergence, roughness, mirror_plan)
    assert fraction == pytest.approx(exact, rel=TOLERANCE)
    assert blur < 0.01 * w2 or fraction != pytest.approx(without_roughness, rel=10 * TOLERANCE)


def mirrored_fraction(divergence, roughness, plan):
    """Return the fraction of a pulse that a mirror sends into the aperture."""
    scene = jl.Scene(ground=jl.Ground(reflectance=0.8, law=jl.Specular(roughness=roughness)))
    wave = jl.simulate(jl.Lidar(divergence=divergence), scene, key=KEY, plan=plan)
    return total(wave)[0] * (0.1 / 1000.0) ** 2 / 0.8


@pytest.fixture(scope="module")
def mirror_plan():
    return jl.plan(jl.Lidar(divergence=3.0), jl.Scene(ground=jl.Ground(law=jl.Specular())))


@pytest.fixture(scope="module")
def pencil_beam():
    """A beam without divergence, and one plan for all slopes."""
    lidar = jl.Lidar(divergence=0.0)
    scene = jl.Scene(ground=jl.Ground(slope=80.0, law=jl.EqualAngle()))
    return lidar, jl.plan(lidar, scene, window=(-30.0, 30.0))


@pytest.mark.parametrize("slope", [0.0, 1e-3, 0.1, 5.0, 45.0, 80.0])
def test_equal_angle_ground_averages_its_density_over_the_aperture(pencil_beam, slope):
    lidar, plan = pencil_beam
    scene = jl.Scene(ground=jl.Ground(reflectance=0.6, slope=slope, law=jl.EqualAngle()))
    wave = jl.simulate(lidar, scene, key=KEY, plan=plan)
    alpha = 0.1 / 1000.0
    captured = total(wave)[0] * alpha**2
    disc = np.pi * alpha**2 / (np.pi**2 * np.hypot(np.sin(np.deg2rad(slope)), alpha / 2.0))
    assert captured == pytest.approx(0.6 * disc, rel=TOLERANCE)
    assert slope != 0.0 or captured == pytest.approx(0.6 * 2.0 * alpha / np.pi, rel=TOLERANCE)


@pytest.fixture(scope="module")
def oblique_plan():
    lidar = jl.Lidar(zenith=60.0)
    return jl.plan(lidar, jl.Scene(ground=jl.Ground()), window=(-40.0, 40.0))


@pytest.mark.parametrize("zenith", [10.0, 30.0, 60.0])
def test_pointing_off_nadir_costs_the_cosine_and_forgets_the_azimuth(oblique_plan, zenith):
    scene = jl.Scene(ground=jl.Ground(reflectance=0.5))
    waves = [
        jl.simulate(jl.Lidar(zenith=zenith, azimuth=azimuth), scene, key=KEY, plan=oblique_plan)
        for azimuth in (0.0, 77.0, 200.0)
    ]
    assert total(waves[0])[0] == pytest.approx(0.5 * np.cos(np.deg2rad(zenith)), rel=TOLERANCE)
    assert moments(waves[0])[0] == pytest.approx(0.0, abs=2e-3)
    peak = float(waves[0].reflectance.max())
    for wave in waves[1:]:
        np.testing.assert_allclose(wave.reflectance, waves[0].reflectance, atol=TOLERANCE * peak)


@pytest.mark.parametrize("field_of_view", [0.05, 0.3, 3.0])
@pytest.mark.parametrize("profile", ["gaussian", "top-hat"])
def test_the_edge_of_the_field_of_view(profile, field_of_view):
    """The fraction of a beam of 0.3 mrad within the field of view, integrated over its soft edge of 2 %."""
    lidar = jl.Lidar(profile=profile, field_of_view=field_of_view)
    wave = jl.simulate(lidar, jl.Scene(ground=jl.Ground(reflectance=0.5)), key=KEY)
    edge, beam = 0.5 * field_of_view, 0.15
    beam_edge = 4.0 * beam if profile == "gaussian" else beam

    def seen(r):
        density = np.exp(-2.0 * (r / beam) ** 2) * 4.0 * r if profile == "gaussian" else 2.0 * r
        return density / beam**2 / (1.0 + np.exp(np.clip((r / edge - 1.0) / 0.02, -80.0, 80.0)))

    breakpoints = np.clip([0.0, 0.8 * edge, edge, 1.2 * edge, beam_edge], 0.0, beam_edge)
    fraction = sum(quad(seen, a, b)[0] for a, b in itertools.pairwise(breakpoints))
    assert total(wave)[0] == pytest.approx(0.5 * fraction, rel=TOLERANCE)


@pytest.mark.parametrize("slope", [0.0, 40.0])
def test_ground_facing_the_beam_is_flat_ground(oblique_plan, slope):
    """A slope of the zenith angle towards the sensor is met at normal incidence."""
    scene = jl.Scene(ground=jl.Ground(reflectance=0.5, slope=slope, aspect=180.0))
    wave = jl.simulate(jl.Lidar(zenith=40.0), scene, key=KEY, plan=oblique_plan)
    assert total(wave)[0] == pytest.approx(0.5 * np.cos(np.deg2rad(40.0 - slope)), rel=TOLERANCE)


@pytest.mark.parametrize(("law", "slope"), [(jl.Lambertian(), 40.0), (jl.EqualAngle(), 40.0)])
def test_from_400_km_as_from_1_km(law, slope):
    """Divergence / 400 and aperture * 400 give the same footprint and angular aperture: the same waveform.

    The beam is narrow (0.5 mrad), as the asymmetry of a slope within it grows with the square of its width.
    """
    scene = jl.Scene(ground=jl.Ground(reflectance=0.5, slope=slope, law=law))
    low_lidar = jl.Lidar(divergence=0.5)
    high_lidar = jl.Lidar(altitude=4e5, divergence=0.5 / 400, aperture=0.2 * 400)
    plan = jl.plan(low_lidar, scene, window=(-60.0, 40.0))
    low_wave, high_wave = (jl.simulate(lidar, scene, key=KEY, plan=plan) for lidar in (low_lidar, high_lidar))
    peak = float(low_wave.reflectance.max())
    np.testing.assert_allclose(high_wave.reflectance, low_wave.reflectance, atol=TOLERANCE * peak)


def test_a_mirror_400_km_away(mirror_plan):
    """GEDI's divergence and aperture over still water: the image is 50 m wide, the aperture 0.8 m."""
    lidar = jl.Lidar(altitude=4e5, divergence=0.0625, aperture=0.8)
    scene = jl.Scene(ground=jl.Ground(reflectance=0.02, law=jl.Specular()))
    wave = jl.simulate(lidar, scene, key=KEY, plan=mirror_plan)
    exact = -np.expm1(-2.0 * 0.4**2 / 25.0**2)
    assert total(wave)[0] * 1e-12 == pytest.approx(0.02 * exact, rel=TOLERANCE)
