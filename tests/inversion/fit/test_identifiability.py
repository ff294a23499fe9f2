"""Cramer-Rao bounds against closed forms, profile likelihoods, and blind waveforms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion import LogNormal, Recorder, Unknown
from tests.helpers import ask

LIDAR = jl.Lidar(wavelength=(532.0, 1064.0), pulse=jl.GaussianPulse(fwhm=6.0), divergence=1e-3)
REFLECTANCE = np.array([0.2, 0.4])
SCENE = jl.Scene(ground=jl.Ground(height=0.1, reflectance=REFLECTANCE))
NOISE = 0.002
HEIGHT = Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0), name="height")
BRIGHTNESS = Unknown(lambda s: s.ground.reflectance, bounds=(0.0, 1.0), name="reflectance")
UNKNOWNS = [HEIGHT, BRIGHTNESS]
KEY = jax.random.key(0)
# Of light, m/ns.
SPEED = 0.299792458


def pulse_at(time, height=0.1):
    """Return the ground's echo in samples of 1 ns, and its derivative in height, by the pulse's formula."""
    sigma = 6.0 / np.sqrt(8 * np.log(2))
    # The mean over a sample, by 100 midpoints.
    within_sample = (np.arange(100) + 0.5) / 100 - 0.5
    u = (np.asarray(time, float)[:, None] + within_sample + 2 * height / SPEED) / sigma
    density = np.exp(-0.5 * u**2) / np.sqrt(2 * np.pi) / sigma
    return density.mean(axis=1), (-u * density * 2 / SPEED / sigma).mean(axis=1)


def test_bounds_of_a_flat_ground_are_the_closed_form():
    bound = ask(inversion.cramer_rao, None, LIDAR, SCENE, UNKNOWNS, noise=NOISE, key=KEY)
    plan = jl.plan(LIDAR, SCENE)
    time = plan.sample_start + np.arange(plan.n_samples)
    echo, slope = pulse_at(time)
    assert np.allclose(bound.stderr["reflectance"], NOISE / np.linalg.norm(echo), rtol=2e-3)
    expected = NOISE / np.sqrt(np.sum(REFLECTANCE**2) * np.sum(slope**2))
    assert np.isclose(bound.stderr["height"], expected, rtol=2e-3)
    assert not np.isclose(bound.stderr["height"], 1.1 * expected, rtol=2e-3)
    assert bound.undetermined == ()
    assert bound.labels == ("height", "reflectance[0]", "reflectance[1]")
    assert np.allclose(np.diag(bound.correlation), 1.0)
    assert np.allclose(np.linalg.inv(bound.information), bound.covariance, rtol=1e-3, atol=1e-9)


def test_priors_add_to_the_information():
    with_prior = Unknown(
        lambda s: s.ground.reflectance,
        bounds=(0.0, 1.0),
        name="reflectance",
        prior=LogNormal(REFLECTANCE, 0.001),
    )
    bound = ask(inversion.cramer_rao, None, LIDAR, SCENE, [with_prior], noise=NOISE, key=KEY)
    data_bound = ask(inversion.cramer_rao, None, LIDAR, SCENE, [BRIGHTNESS], noise=NOISE, key=KEY)
    # Information adds up; the spread of a log-normal prior is relative.
    expected = 1 / np.hypot(1 / (0.001 * REFLECTANCE), 1 / np.asarray(data_bound.stderr["reflectance"]))
    assert np.allclose(bound.stderr["reflectance"], expected, rtol=1e-3)


@pytest.mark.slow
def test_chlorophyll_is_invisible_at_1064_nm():
    leaf = jl.Prospect(Cab=40.0, Cw=0.012)
    voxels = jl.VoxelMap.from_lad(
        np.full((1, 1, 4), 0.3), voxel_size=(40.0, 40.0, 1.0), origin=(-20, -20, 2.0)
    )
    scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=leaf, hotspot=False), ground=jl.Ground(reflectance=0.3))
    unknowns = [
        Unknown(lambda s: s.canopy.leaf.Cab, bounds=(5.0, 100.0), name="Cab"),
        Unknown(lambda s: s.canopy.leaf.Cm, bounds=(0.001, 0.03), name="Cm"),
    ]
    options = {"noise": 1e-4, "key": KEY, "max_orders": 1, "n_rays": 8}
    infrared = ask(inversion.cramer_rao, None, jl.Lidar(wavelength=1064.0), scene, unknowns, **options)
    assert infrared.undetermined == ("Cab",)
    assert np.isinf(infrared.stderr["Cab"])
    assert np.isfinite(infrared.stderr["Cm"])
    assert "Cab  not determined" in str(infrared)
    with_green = ask(
        inversion.cramer_rao, None, jl.Lidar(wavelength=(532.0, 1064.0)), scene, unknowns, **options
    )
    assert with_green.undetermined == ()


@pytest.fixture(scope="module")
def target():
    plan = jl.plan(LIDAR, SCENE, window=(-20.0, 20.0))
    wave = jl.simulate(LIDAR, SCENE, key=KEY, plan=plan)
    noise = NOISE * np.random.default_rng(3).normal(size=wave.reflectance.shape)
    return np.asarray(wave.reflectance) + noise, np.asarray(wave.time)


def profile(target, name, values, unknowns=UNKNOWNS, lidar=LIDAR, **options):
    observed, time = target
    options = {"noise": NOISE, "time": time, "key": KEY, "noise_floor": 0.0, **options}
    return ask(inversion.profile_likelihood, observed, lidar, SCENE, unknowns, name, values, **options)


@pytest.mark.slow
def test_a_profile_of_a_linear_problem_is_the_standard_error(target):
    observed, time = target
    fit = ask(
        inversion.retrieve, observed, LIDAR, SCENE, UNKNOWNS, noise=NOISE, time=time, key=KEY, noise_floor=0.0
    )
    best, error = float(fit.values["height"]), float(fit.stderr["height"])
    finished = []
    result = profile(target, "height", best + error * np.linspace(-3, 3, 9), progress=finished.append)
    assert sorted(finished) == list(range(9))
    assert np.all(result.converged)
    assert np.allclose(result.chi2, np.linspace(-3, 3, 9) ** 2, rtol=0.05, atol=0.05)
    low, high = result.interval()
    assert np.allclose([low, high], [best - error, best + error], atol=0.05 * error)
    low, high = result.interval(0.954)
    assert np.allclose([low, high], [best - 2 * error, best + 2 * error], atol=0.1 * error)
    assert result.others["reflectance"].shape == (9, 2)


@pytest.mark.slow
def test_all_points_of_a_profile_are_weighted_alike():
    """Noise of the pulse grows with the echo: weighted by its own noise, bright ground would fit best."""
    lidar, recorder = dataclasses.replace(LIDAR, wavelength=np.array([1064.0])), Recorder(pulse_noise=0.1)
    scene = jl.Scene(ground=jl.Ground(height=0.1, reflectance=0.4))
    plan = jl.plan(lidar, scene, window=(-20.0, 20.0))
    wave = jl.simulate(lidar, scene, key=KEY, plan=plan)
    unknowns = [HEIGHT, Unknown("ground.reflectance", bounds=(0.05, 0.9), name="brightness")]
    options = {"noise": 1e-3, "time": wave.time, "key": KEY, "recorder": recorder}
    fit = ask(inversion.retrieve, wave.reflectance, lidar, scene, unknowns, **options)
    z = np.linspace(-3.0, 3.0, 7)
    values = float(fit.values["brightness"]) + float(fit.stderr["brightness"]) * z
    result = ask(
        inversion.profile_likelihood,
        wave.reflectance,
        lidar,
        scene,
        unknowns,
        "brightness",
        values,
        **options,
    )
    assert np.allclose(result.chi2, z**2, rtol=0.05, atol=0.05)


@pytest.mark.slow
def test_a_profile_does_not_move_smoothness_priors():
    """A prior without mean is about the mean of the start, not of the neighbour's estimate."""
    voxels = jl.VoxelMap.from_lad(
        np.ones((1, 1, 6)), voxel_size=(40.0, 40.0, 2.0), origin=(-20.0, -20.0, -2.0)
    )
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.5, 0.4), hotspot=True, sides="periodic")
    base = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=np.array([0.3, 0.3])))
    truth = inversion.put_profile(base, jnp.array([0.1, 0.2, 0.2, 0.1]))
    start = jnp.full(4, 1.0)
    plants = Unknown(
        apply=inversion.put_profile,
        name="plants",
        bounds=(0.0, 2.0),
        start=start,
        prior=inversion.Smooth(4.0, spacing=2.0, strength=0.05),
    )
    wave = jl.simulate(LIDAR, truth, key=KEY, max_orders=1, window=(-80.0, 20.0), n_rays=8)
    options = {"noise": 0.01, "time": wave.time, "key": KEY, "max_orders": 1, "n_rays": 1}

    def estimates(first, values):
        height = Unknown("ground.height", bounds=(-2.0, 2.0), start=first, name="height")
        scene = inversion.put_profile(base, start)
        result = ask(
            inversion.profile_likelihood,
            wave.reflectance,
            LIDAR,
            scene,
            [height, plants],
            "height",
            values,
            **options,
        )
        return result.others["plants"]

    after_neighbours = estimates(-0.02, [-0.02, 0.0, 0.02])[-1]
    first_of_all = estimates(0.02, [0.02, 0.04])[0]
    np.testing.assert_allclose(after_neighbours, first_of_all, atol=2e-3)


def test_an_interval_that_the_values_do_not_close_is_infinite(target):
    low, high = profile(target, "height", [0.08, 0.1, 0.1005]).interval()
    assert np.isfinite(low)
    assert high == np.inf


def test_samples_lie_at_the_record_s_times_whatever_opened_the_window(target):
    first_return = dataclasses.replace(LIDAR, receiver=jl.Receiver(window="first return"))
    for times in ({"time": target[1]}, {}):
        bound, expected = (
            ask(inversion.cramer_rao, None, lidar, SCENE, UNKNOWNS, noise=NOISE, key=KEY, **times)
            for lidar in (first_return, LIDAR)
        )
        assert np.array_equal(bound.covariance, expected.covariance)
    values = [0.09, 0.1, 0.11]
    result, expected = (profile(target, "height", values, lidar=lidar) for lidar in (first_return, LIDAR))
    assert np.array_equal(result.chi2, expected.chi2)


def test_bad_input_is_refused(target):
    for change, message in (
        ({"name": "depth"}, "name = 'depth' is none of the unknowns: height, reflectance"),
        ({"name": "reflectance"}, "has 2 values"),
        ({"unknowns": [HEIGHT]}, "beside 0 unknowns"),
        ({"values": [0.2, 0.1]}, "two or more, increasing"),
        ({"values": [0.1, 5.0]}, "values = 5 is outside"),
        ({"unknowns": []}, "unknowns is empty"),
        ({"n_photons": 4}, "n_photons = 4 is outside"),
    ):
        with pytest.raises(ValueError, match=message):
            profile(target, **{"name": "height", "values": [0.0, 0.1], **change})
    with pytest.raises(ValueError, match="noise = 0 is outside"):
        ask(inversion.cramer_rao, None, LIDAR, SCENE, UNKNOWNS, noise=0.0, key=KEY)
    with pytest.raises(ValueError, match="does not broadcast"):
        ask(inversion.cramer_rao, None, LIDAR, SCENE, UNKNOWNS, noise=np.ones(3), key=KEY)
    with pytest.raises(ValueError, match="unknowns is empty; admissible is one unknown or more"):
        ask(inversion.cramer_rao, None, LIDAR, SCENE, [], noise=NOISE, key=KEY)
    for name, least in (("n_photons", 8), ("n_rays", 1)):
        with pytest.raises(ValueError, match=rf"{name} = 0 is outside the admissible range \[{least}, inf\)"):
            ask(inversion.cramer_rao, None, LIDAR, SCENE, UNKNOWNS, noise=NOISE, key=KEY, **{name: 0})
    result = profile(target, "height", [0.08, 0.12])
    with pytest.raises(ValueError, match="level = 1 is outside"):
        result.interval(1.0)


def test_plans_that_leave_out_light_are_refused():
    low_scene, high_scene = jl.Scene(ground=jl.Ground()), jl.Scene(ground=jl.Ground(height=8.0))
    lidar, time = jl.Lidar(), np.arange(-80.0, 81.0)
    plan = jl.plan(lidar, low_scene, window=(time[0], time[-1]), describe=False)
    height = inversion.Unknown("ground.height", bounds=(-1.0, 9.0), name="height")
    bright = inversion.Unknown("ground.reflectance", bounds=(0.0, 1.0), name="bright")
    options = {"noise": 0.01, "key": KEY, "time": time, "plan": plan}
    with pytest.raises(ValueError, match="the plan does not fit: its rays start"):
        ask(inversion.cramer_rao, None, lidar, high_scene, [height], **options)
    with pytest.raises(
        ValueError, match="at the bounds of the unknowns the plan does not fit: its rays start"
    ):
        ask(
            inversion.profile_likelihood,
            np.zeros((1, time.size)),
            lidar,
            low_scene,
            [height, bright],
            "bright",
            [0.2, 0.4],
            **options,
        )
