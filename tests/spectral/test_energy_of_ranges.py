"""The received energy of light from the range R: E_t eta A_r / (pi R^2) times its apparent reflectance.

The pulse spreads the return over samples that stand for other ranges. With the factor of these, the energy
from 20 m of a pulse of 15 ns (a standard deviation of s = 0.95 m) would be larger by 3 s^2 / R^2 = 0.7 %.
"""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from tests.helpers import slow_unless

KEY = jax.random.key(0)
ALTITUDE = 20.0
WINDOW = (-120.0, 120.0)
LONG, SHORT = jl.GaussianPulse(fwhm=15.0), jl.GaussianPulse(fwhm=2.0)
# Of a wrong energy.
EXCESS = 3.0 * (0.5 * jl.SPEED_OF_LIGHT * 15.0 / np.sqrt(8.0 * np.log(2.0))) ** 2 / ALTITUDE**2


def near_lidar(**changes):
    return jl.Lidar(**({"altitude": ALTITUDE, "divergence": 0.3, "pulse": LONG, "energy": 2e-3} | changes))


def joules(lidar, distance):
    """Return the energy, J, per apparent reflectance at a range, m."""
    aperture = 0.25 * float(lidar.aperture) ** 2
    return float(lidar.energy) * float(lidar.efficiency) * aperture / distance**2


def total_energy(wave):
    return np.asarray(wave.energy, float).sum(axis=-1)


@pytest.mark.parametrize("height", [0.0, 6.0, -30.0])
def test_flat_ground(height):
    lidar = near_lidar(efficiency=0.5)
    wave = jl.simulate(lidar, jl.Scene(ground=jl.Ground(height, 0.3)), key=KEY, window=(-160.0, 330.0))
    exact = 0.3 * joules(lidar, ALTITUDE - height)
    np.testing.assert_allclose(total_energy(wave), exact, rtol=1e-5)
    assert EXCESS > 6e-3
    # All energy that enters the aperture is in the record, but for the efficiency of the detector.
    returned = float(wave.energy_budget["returned"][0])
    np.testing.assert_allclose(returned, exact / (0.5 * 2e-3), rtol=1e-5)


def test_returns_from_several_ranges():
    """The energy is a sum over plates, each with its own range; its spread over samples is the pulse's."""
    heights, rho = (10.0, 0.0, -10.0), (0.1, 0.2, 0.4)
    plates = [jl.Plate(z, r, 1.0 - r, transmission="straight") for z, r in zip(heights[:2], rho)]
    scene = jl.Scene(plates=plates, ground=jl.Ground(heights[2], rho[2]))
    lidar = near_lidar()
    wave = jl.simulate(lidar, scene, key=KEY, max_orders=1, window=(-200.0, 200.0))
    seen = (0.1, 0.9**2 * 0.2, (0.9 * 0.8) ** 2 * 0.4)
    exact = sum(r * joules(lidar, ALTITUDE - z) for z, r in zip(heights, seen))
    np.testing.assert_allclose(total_energy(wave), exact, rtol=1e-5)


@pytest.mark.slow
def test_the_pulse_changes_no_energy():
    """Of all orders, in a canopy: with the same photons, energies are the same for every pulse."""
    voxels = jl.VoxelMap.from_lad(np.full((1, 1, 4), 0.4), voxel_size=2.0)
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(reflectance=0.5, transmittance=0.4), sides="periodic")
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.4))
    plan = jl.plan(near_lidar(), scene, max_orders=2, window=(-130.0, 150.0), n_photons=8192, n_rays=256)
    setups = [jl.make_setup(near_lidar(pulse=pulse), scene, plan) for pulse in (LONG, SHORT)]
    response = eqx.filter_jit(partial(jl.trace_scene, reverse=False))(setups[0], KEY)
    assert response.higher is not None
    assert float(response.higher.sum()) > 0.05
    energies = [total_energy(jl.waveform_of(response, setup)) for setup in setups]
    np.testing.assert_allclose(energies[0], energies[1], rtol=1e-5)


@pytest.mark.slow
def test_energy_of_the_air():
    """What the air returns, from a short pulse, over R^2 and convolved with the long one."""
    air = jl.Atmosphere(visibility=2.0, lidar_ratio=40.0)
    scene = jl.Scene(ground=jl.Ground(reflectance=0.0), atmosphere=air)
    settings = {"key": KEY, "max_orders": 1, "window": (-80.0, 60.0), "bin_width": 0.25}
    short, wave = (
        jl.simulate(near_lidar(pulse=pulse, sampling_interval=0.25), scene, **settings)
        for pulse in (jl.GaussianPulse(fwhm=0.01), LONG)
    )
    time, fine = np.asarray(short.time, float), np.asarray(short.components["air"][0], float)
    lidar = near_lidar()
    fine = fine * joules(lidar, ALTITUDE + 0.5 * jl.SPEED_OF_LIGHT * time)
    sigma = 15.0 / np.sqrt(8.0 * np.log(2.0))
    pulse = np.exp(-0.5 * ((time[:, None] - time[None, :]) / sigma) ** 2)
    expected = (0.25 / (sigma * np.sqrt(2.0 * np.pi)) * pulse) @ fine
    # Samples to which the air before the window adds nothing.
    middle = time > -80.0 + 5.0 * sigma
    energy = np.asarray(wave.energy[0], float)
    np.testing.assert_allclose(energy[middle], expected[middle], rtol=2e-3, atol=1e-4 * energy.max())
    # The factor of the sample's own range is rejected.
    wrong = np.asarray(wave.components["air"][0], float)
    wrong = wrong * joules(lidar, ALTITUDE + 0.5 * jl.SPEED_OF_LIGHT * time)
    assert abs(wrong[middle][0] / expected[middle][0] - 1.0) > 0.01


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shared", "field_of_view"),
    slow_unless([(True, None)], [(False, None), (True, None), (True, 50.0)]),
)
def test_shots_of_a_survey(shared, field_of_view):
    """A layer of 1 mm on the ground; shared light is tallied by node, or by shot for a field of view."""
    lidar = near_lidar(divergence=1.0, field_of_view=field_of_view)
    survey = jl.Survey.grid(lidar, low=(0, 0), high=(0.01, 0.01), spacing=0.01)
    voxels = jl.VoxelMap.from_lad(np.full((1, 1, 1), 1000.0), voxel_size=(1.0, 1.0, 1e-3))
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(reflectance=0.5, transmittance=0.4), sides="periodic")
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.4))
    waves = jl.simulate_many(survey, scene, key=KEY, rtol=0.3, max_orders=2, shared=shared)
    assert waves.info["shared"] == shared
    exact = joules(lidar, ALTITUDE) * np.asarray(waves.reflectance, float).sum(axis=2)
    np.testing.assert_allclose(np.asarray(waves.energy, float).sum(axis=2), exact, rtol=1e-3)


def test_derivative_with_respect_to_the_altitude():
    """d ln E / d ln R = -2."""
    scene = jl.Scene(ground=jl.Ground(reflectance=0.3))
    plan = jl.plan(near_lidar(), scene, window=WINDOW)

    def energy(altitude):
        lidar = dataclasses.replace(near_lidar(), altitude=altitude)
        setup = jl.make_setup(lidar, scene, plan)
        return 1e6 * jnp.sum(jl.waveform_of(jl.trace_scene(setup, KEY), setup).energy)

    value, slope = jax.jit(jax.value_and_grad(energy))(jnp.asarray(ALTITUDE))
    np.testing.assert_allclose(slope * ALTITUDE / value, -2.0, rtol=1e-4)
