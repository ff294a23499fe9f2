"""Cramer-Rao bounds against closed forms, profile likelihoods, and blind waveforms."""

import dataclasses

import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion import LogNormal, Unknown

LIDAR = jl.Lidar(wavelength=(532.0, 1064.0), pulse=jl.GaussianPulse(fwhm=6.0), divergence=1e-3)
REFLECTANCE = np.array([0.2, 0.4])
SCENE = jl.Scene(ground=jl.Ground(height=0.1, reflectance=REFLECTANCE))
NOISE = 0.002
HEIGHT = Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0), name="height")
BRIGHTNESS = Unknown(lambda s: s.ground.reflectance, bounds=(0.0, 1.0), name="reflectance")
UNKNOWNS = [HEIGHT, BRIGHTNESS]
KEY = jax.random.key(0)
SPEED = 0.299792458


def pulse_at(time, height=0.1):
    """The ground's echo in samples of 1 ns, and its derivative in height, from the pulse's formula."""
    sigma = 6.0 / np.sqrt(8 * np.log(2))
    fine = (
        np.asarray(time, float)[:, None] + (np.arange(100) + 0.5) / 100 - 0.5 + 2 * height / SPEED
    ) / sigma
    density = np.exp(-0.5 * fine**2) / np.sqrt(2 * np.pi) / sigma
    return density.mean(axis=1), (-fine * density * 2 / SPEED / sigma).mean(axis=1)


def test_bounds_of_a_flat_ground_are_the_closed_form():
    found = inversion.cramer_rao(LIDAR, SCENE, UNKNOWNS, noise=NOISE, key=KEY)
    plan = jl.plan(LIDAR, SCENE)
    time = plan.sample_start + np.arange(plan.n_samples)
    echo, slope = pulse_at(time)
    assert np.allclose(found.stderr["reflectance"], NOISE / np.linalg.norm(echo), rtol=2e-3)
    expected = NOISE / np.sqrt(np.sum(REFLECTANCE**2) * np.sum(slope**2))
    assert np.isclose(found.stderr["height"], expected, rtol=2e-3)
    assert not np.isclose(found.stderr["height"], 1.1 * expected, rtol=2e-3)
    assert found.undetermined == ()
    assert found.labels == ("height", "reflectance[0]", "reflectance[1]")
    assert np.allclose(np.diag(found.correlation), 1.0)
    assert np.allclose(np.linalg.inv(found.information), found.covariance, rtol=1e-3, atol=1e-9)


def test_priors_add_to_the_information():
    tight = Unknown(
        lambda s: s.ground.reflectance,
        bounds=(0.0, 1.0),
        name="reflectance",
        prior=LogNormal(REFLECTANCE, 0.001),
    )
    found = inversion.cramer_rao(LIDAR, SCENE, [tight], noise=NOISE, key=KEY)
    free = inversion.cramer_rao(LIDAR, SCENE, [BRIGHTNESS], noise=NOISE, key=KEY)
    expected = 1 / np.hypot(1 / (0.001 * REFLECTANCE), 1 / np.asarray(free.stderr["reflectance"]))
    assert np.allclose(found.stderr["reflectance"], expected, rtol=1e-3)


def test_chlorophyll_is_invisible_at_1064_nm():
    leaf = jl.Prospect(Cab=40.0, Cw=0.012)
    voxels = jl.VoxelMap.from_lad(
        np.full((1, 1, 4), 0.3), voxel_size=(40.0, 40.0, 1.0), origin=(-20, -20, 2.0)
    )
    scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=leaf), ground=jl.Ground(reflectance=0.3))
    unknowns = [
        Unknown(lambda s: s.canopy.leaf.Cab, bounds=(5.0, 100.0), name="Cab"),
        Unknown(lambda s: s.canopy.leaf.Cm, bounds=(0.001, 0.03), name="Cm"),
    ]
    given = {"noise": 1e-4, "key": KEY, "max_orders": 1, "n_rays": 64}
    infrared = inversion.cramer_rao(jl.Lidar(wavelength=1064.0), scene, unknowns, **given)
    assert infrared.undetermined == ("Cab",)
    assert np.isinf(infrared.stderr["Cab"])
    assert np.isfinite(infrared.stderr["Cm"])
    assert "Cab  not determined" in str(infrared)
    both = inversion.cramer_rao(jl.Lidar(wavelength=(532.0, 1064.0)), scene, unknowns, **given)
    assert both.undetermined == ()


@pytest.fixture(scope="module")
def target():
    plan = jl.plan(LIDAR, SCENE, window=(-20.0, 20.0))
    wave = jl.simulate(LIDAR, SCENE, key=KEY, plan=plan)
    noise = NOISE * np.random.default_rng(3).normal(size=wave.reflectance.shape)
    return np.asarray(wave.reflectance) + noise, np.asarray(wave.time)


def profile(target, name, values, unknowns=UNKNOWNS, lidar=LIDAR, **more):
    observed, time = target
    given = {"noise": NOISE, "time": time, "key": KEY, "noise_floor": 0.0, **more}
    return inversion.profile_likelihood(observed, lidar, SCENE, unknowns, name, values, **given)


def test_a_profile_of_a_linear_problem_is_the_standard_error(target):
    observed, time = target
    fit = inversion.retrieve(
        observed, LIDAR, SCENE, UNKNOWNS, noise=NOISE, time=time, key=KEY, noise_floor=0.0
    )
    best, error = float(fit.values["height"]), float(fit.stderr["height"])
    seen = []
    found = profile(target, "height", best + error * np.linspace(-3, 3, 9), progress=seen.append)
    assert sorted(seen) == list(range(9))
    assert np.all(found.converged)
    assert np.allclose(found.chi2, np.linspace(-3, 3, 9) ** 2, rtol=0.05, atol=0.05)
    low, high = found.interval()
    assert np.allclose([low, high], [best - error, best + error], atol=0.05 * error)
    low, high = found.interval(0.954)
    assert np.allclose([low, high], [best - 2 * error, best + 2 * error], atol=0.1 * error)
    assert found.others["reflectance"].shape == (9, 2)


def test_an_interval_that_the_values_do_not_close_is_infinite(target):
    found = profile(target, "height", [0.08, 0.1, 0.1005])
    low, high = found.interval()
    assert np.isfinite(low)
    assert high == np.inf


def test_samples_lie_at_given_times_whatever_opened_the_window(target):
    opened = dataclasses.replace(LIDAR, receiver=jl.Receiver(window="first return"))
    for more in ({"time": target[1]}, {}):
        bound, same = (
            inversion.cramer_rao(lidar, SCENE, UNKNOWNS, noise=NOISE, key=KEY, **more)
            for lidar in (opened, LIDAR)
        )
        assert np.array_equal(bound.covariance, same.covariance)
    values = [0.09, 0.1, 0.11]
    found, same = (profile(target, "height", values, lidar=lidar) for lidar in (opened, LIDAR))
    assert np.array_equal(found.chi2, same.chi2)


def test_bad_input_is_refused(target):
    for change, words in (
        ({"name": "depth"}, "name = 'depth' is none of the unknowns: height, reflectance"),
        ({"name": "reflectance"}, "has 2 values"),
        ({"unknowns": [HEIGHT]}, "beside 0 unknowns"),
        ({"values": [0.2, 0.1]}, "two or more, increasing"),
        ({"values": [0.1, 5.0]}, "values = 5 is outside"),
        ({"unknowns": []}, "unknowns is empty"),
        ({"n_photons": 4}, "n_photons = 4 is outside"),
    ):
        with pytest.raises(ValueError, match=words):
            profile(target, **{"name": "height", "values": [0.0, 0.1], **change})
    with pytest.raises(ValueError, match="noise = 0 is outside"):
        inversion.cramer_rao(LIDAR, SCENE, UNKNOWNS, noise=0.0, key=KEY)
    with pytest.raises(ValueError, match="does not broadcast"):
        inversion.cramer_rao(LIDAR, SCENE, UNKNOWNS, noise=np.ones(3), key=KEY)
    with pytest.raises(ValueError, match="unknowns is empty; admissible is one unknown or more"):
        inversion.cramer_rao(LIDAR, SCENE, [], noise=NOISE, key=KEY)
    for name in ("n_photons", "n_rays"):
        with pytest.raises(ValueError, match=rf"{name} = 4 is outside the admissible range \[8, inf\)"):
            inversion.cramer_rao(LIDAR, SCENE, UNKNOWNS, noise=NOISE, key=KEY, **{name: 4})
    found = profile(target, "height", [0.08, 0.12])
    with pytest.raises(ValueError, match="level = 1 is outside"):
        found.interval(1.0)


def test_plans_that_leave_out_light_are_refused():
    low, ground = jl.Scene(ground=jl.Ground()), jl.Scene(ground=jl.Ground(height=8.0))
    lidar, time = jl.Lidar(), np.arange(-80.0, 81.0)
    plan = jl.plan(lidar, low, window=(time[0], time[-1]), describe=False)
    height = inversion.Unknown("ground.height", bounds=(-1.0, 9.0), name="height")
    bright = inversion.Unknown("ground.reflectance", bounds=(0.0, 1.0), name="bright")
    given = {"noise": 0.01, "key": KEY, "time": time, "plan": plan}
    with pytest.raises(ValueError, match="the plan does not fit: its rays start"):
        inversion.cramer_rao(lidar, ground, [height], **given)
    with pytest.raises(
        ValueError, match="at the bounds of the unknowns the plan does not fit: its rays start"
    ):
        inversion.profile_likelihood(
            np.zeros((1, time.size)), lidar, low, [height, bright], "bright", [0.2, 0.4], **given
        )
