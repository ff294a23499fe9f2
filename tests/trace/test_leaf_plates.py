r"""The leaf plate of the paper over ground: first-order returns of both, and the sum of all orders.

Layout: an infinite horizontal plate (reflectance R, transmittance T, coverage c) one metre above Lambertian
ground (rho), nadir view. A ray meets the plate with probability c at each crossing, so the plate acts with
R' = c R and T' = (1 - c) + c T. First order:

    plate            c R
    ground           T'^2 rho where transmission is straight, (1 - c)^2 rho where it is diffuse,

as diffusely transmitted light has been scattered. All orders, by adding fluxes (adding method),
for either transmission:

    c R + T'^2 rho / (1 - rho c R).

Tolerance: first order is exact, 1e-4 for rounding; all orders agree within three standard errors (eight
batches or more) plus the neglected orders. A sum of geometric series wrong in one factor is refused.
"""

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar import SPEED_OF_LIGHT
from tests.helpers import SINGLE_SAMPLE, agrees, single_sample_lidar, slow_unless

KEY = jax.random.key(21)
R, T, RHO = 0.3, 0.5, 0.6


def scene(coverage=1.0, transmission="straight", height=1.0, ground=True):
    plate = jl.Plate(
        height=height, reflectance=R, transmittance=T, coverage=coverage, transmission=transmission
    )
    return jl.Scene(plates=(plate,), ground=jl.Ground(reflectance=RHO) if ground else None)


def test_a_plate_alone_returns_its_reflectance():
    wave = jl.simulate(jl.Lidar(), scene(coverage=0.7, ground=False), key=KEY)
    np.testing.assert_allclose(float(wave.reflectance.sum()), 0.7 * R, rtol=1e-4)
    np.testing.assert_array_equal(wave.stderr, 0.0)
    np.testing.assert_allclose(wave.energy_budget["absorbed by plate"], 0.7 * (1 - R - T), rtol=1e-4)


@pytest.mark.parametrize("transmission", ["straight", "diffuse"])
@pytest.mark.parametrize("coverage", [1.0, 0.6])
def test_first_order(transmission, coverage):
    lidar = jl.Lidar(pulse=jl.GaussianPulse(fwhm=1.0), sampling_interval=0.25)
    wave = jl.simulate(lidar, scene(coverage, transmission), key=KEY, max_orders=1)
    straight_on = (1 - coverage) + coverage * T
    ground = (straight_on if transmission == "straight" else 1 - coverage) ** 2 * RHO
    for name, expected, height in (("plate", coverage * R, 1.0), ("ground", ground, 0.0)):
        echo = np.asarray(wave.components[name][0], float)
        assert echo.sum() == pytest.approx(expected, rel=1e-4, abs=1e-9)
        centroid = np.sum(echo * np.asarray(wave.time)) / max(echo.sum(), 1e-9)
        assert expected == 0.0 or centroid == pytest.approx(-2 * height / SPEED_OF_LIGHT, abs=1e-3)


def all_orders(coverage=1.0, denominator=None, passing=None):
    passing = (1 - coverage) + coverage * T if passing is None else passing
    denominator = 1 - RHO * coverage * R if denominator is None else denominator
    return coverage * R + passing**2 * RHO / denominator


@pytest.mark.slow
@pytest.mark.parametrize("transmission", slow_unless(["diffuse"], ["straight", "diffuse"]))
@pytest.mark.parametrize("coverage", slow_unless([0.6], [0.6, 1.0]))
def test_all_orders(transmission, coverage):
    wave = jl.simulate(
        single_sample_lidar(),
        scene(coverage, transmission),
        key=KEY,
        max_orders=8 if transmission == "straight" else 10,
        n_photons=16_384,
        **(SINGLE_SAMPLE | {"bin_width": 10.0}),
    )
    estimate = (float(wave.reflectance[0, 0]), float(wave.stderr[0, 0]))
    assert estimate[1] < 0.005 * estimate[0]
    assert agrees(*estimate, all_orders(coverage), bound=wave.neglected[0])
    # The same test rejects a series without multiple bounces, or with T in place of R.
    assert not agrees(*estimate, all_orders(coverage, denominator=1.0), bound=wave.neglected[0])
    assert not agrees(*estimate, all_orders(coverage, denominator=1 - RHO * T), bound=wave.neglected[0])


@pytest.mark.slow
@pytest.mark.parametrize(("lower", "upper"), slow_unless([(0.5, 0.4)], [(0.5, 0.4), (0.5, 0.0)]))
def test_plates_shade_surfaces_below(lower, upper):
    """Each transmits 1 - c + c T on both paths; also opaque ones (T = 0)."""
    plates = (
        jl.Plate(height=1.0, reflectance=R, transmittance=lower, coverage=0.5),
        jl.Plate(height=2.5, reflectance=0.2, transmittance=upper, coverage=0.25),
    )
    plate_scene = jl.Scene(plates=plates, ground=jl.Ground(reflectance=RHO))
    wave = jl.simulate(jl.Lidar(), plate_scene, key=KEY, max_orders=1)
    sums = {name: float(component.sum()) for name, component in wave.components.items()}
    past_upper, past_lower = 0.75 + 0.25 * upper, 0.5 + 0.5 * lower
    assert sums["plate 2"] == pytest.approx(0.25 * 0.2, rel=1e-4)
    assert sums["plate 1"] == pytest.approx(past_upper**2 * 0.5 * R, rel=1e-4)
    assert sums["ground"] == pytest.approx(past_upper**2 * past_lower**2 * RHO, rel=1e-4)


@pytest.mark.parametrize("transmission", ["straight", "diffuse"])
def test_an_opaque_plate_hides_the_ground(transmission):
    hidden = jl.Scene(
        plates=(jl.Plate(height=1.0, reflectance=R, transmission=transmission),),
        ground=jl.Ground(reflectance=RHO),
    )
    wave = jl.simulate(jl.Lidar(), hidden, key=KEY, max_orders=1)
    assert float(wave.reflectance.sum()) == pytest.approx(R, rel=1e-4)


def test_a_tilted_plate_over_tilted_ground():
    """Both tilted by 20 degrees, the ground seen through the plate: cos(20) times R and T^2 rho."""
    tilt = {"slope": 20.0, "aspect": 50.0}
    plate = jl.Plate(height=1.0, reflectance=R, transmittance=T, **tilt)
    tilted = jl.Scene(plates=(plate,), ground=jl.Ground(reflectance=RHO, **tilt))
    wave = jl.simulate(jl.Lidar(), tilted, key=KEY, max_orders=1)
    cosine = np.cos(np.deg2rad(20.0))
    assert float(wave.components["plate"].sum()) == pytest.approx(R * cosine, rel=1e-4)
    assert float(wave.components["ground"].sum()) == pytest.approx(T**2 * RHO * cosine, rel=1e-4)


def test_coincident_planes_are_refused_and_give_nan_where_they_are_traced():
    plate, ground = jl.Plate(2.0, R, T, slope=10.0), jl.Ground(height=2.0, slope=10.0)
    with pytest.raises(
        ValueError, match=r"plates\[0\] lies 0 m from the plane of the ground: .* 0.0001 m or more"
    ):
        jl.Scene(plates=(plate,), ground=ground)
    with pytest.raises(ValueError, match=r"plates\[2\] lies 5e-05 m from the plane of plates\[0\]"):
        jl.Scene(plates=(jl.Plate(0.0, R), jl.Plate(1.0, R), jl.Plate(5e-5, R)))
    # Planes that cross one another are admissible.
    jl.Scene(plates=(plate, jl.Plate(2.0, R, slope=11.0)), ground=jl.Ground(height=1.999, slope=10.0))

    def scene(height):
        return jl.Scene(plates=(jl.Plate(height, R),), ground=jl.Ground())

    lidar = single_sample_lidar()
    plan = jl.plan(lidar, scene(1.0), max_orders=1, **SINGLE_SAMPLE)
    seen = jax.jit(lambda h: jl.simulate(lidar, scene(h), key=KEY, plan=plan).reflectance.sum())
    assert np.isfinite(seen(0.001))
    assert np.isnan(seen(0.0))
    assert jax.jit(lambda h: jl.extend.reasons(scene(h)))(0.0)["gap"]
