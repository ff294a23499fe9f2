"""Log-posterior densities: against a Gaussian in closed form and the density of the noise; derivatives."""

import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import inversion
import jaxlidar as jl
from inversion import LogNormal, Smooth, Unknown
from inversion.fit.recorder_model import RecorderModel
from tests.helpers import ask

LIDAR = jl.Lidar(altitude=500.0, divergence=4.0, pulse=jl.GaussianPulse(fwhm=4.0))
WINDOW = (-40.0, 20.0)
REFLECTANCE = Unknown("ground.reflectance", bounds=(0.0, 1.0), name="reflectance")


def ground(reflectance=0.3, height=0.2):
    return jl.Scene(ground=jl.Ground(height=height, reflectance=reflectance))


def stand(density=(0.1, 0.3, 0.2), height=0.0):
    voxels = jl.VoxelMap.from_extinction(
        leaf=np.reshape(density, (1, 1, 3)), voxel_size=(4.0, 4.0, 1.0), origin=(0.0, 0.0, 2.0)
    )
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4), sides="periodic")
    return jl.Scene(canopy=canopy, ground=jl.Ground(height=height, reflectance=0.3))


def noisy_record(scene, sigma, seed=0):
    wave = jl.simulate(LIDAR, scene, key=jax.random.key(0), window=WINDOW, max_orders=1)
    noise = sigma * np.random.default_rng(seed).normal(size=wave.reflectance.shape)
    return np.asarray(wave.reflectance, float) + noise, wave.time


def moments(density, to_natural, name, low=-4.0, high=4.0):
    """Posterior mean and standard deviation of a single unknown, by quadrature over its coordinate."""
    x = jnp.linspace(low, high, 4001)[:, None]
    weight = np.asarray(jax.nn.softmax(jax.vmap(density)(x)), float)
    value = np.asarray(to_natural(x)[name], float)
    mean = weight @ value
    return mean, np.sqrt(weight @ (value - mean) ** 2)


@pytest.mark.parametrize("prior", [None, (0.16, 0.01)])
def test_the_posterior_of_a_linear_unknown_is_the_gaussian_of_the_fit(prior):
    observed, time = noisy_record(ground(0.15), 0.005)
    unknown = Unknown("ground.reflectance", bounds=(0.0, 1.0), name="reflectance", prior=prior)
    arguments = observed, LIDAR, ground(reflectance=0.5), [unknown]
    options = {"noise": 0.005, "time": time, "key": jax.random.key(1)}
    fit = ask(inversion.retrieve, *arguments, **options)
    density = ask(inversion.log_density, *arguments, **options)
    estimate, stderr = float(fit.values["reflectance"]), float(fit.stderr["reflectance"])
    mean, std = moments(density, density.to_natural, "reflectance")
    assert abs(mean - estimate) < 0.015 * stderr
    assert abs(std / stderr - 1) < 0.01

    # The same test rejects a density without the Jacobian of its coordinates.
    def planted(x):
        return density(x) - jnp.sum(jax.nn.log_sigmoid(x) + jax.nn.log_sigmoid(-x))

    wrong_mean, _ = moments(planted, density.to_natural, "reflectance")
    assert abs(wrong_mean - estimate) > 0.03 * stderr


def test_a_log_normal_prior_is_a_density_of_the_unknown_itself():
    observed, time = noisy_record(ground(), 0.01)
    unknown = Unknown("ground.reflectance", bounds=(0.0, 1.0), prior=LogNormal(0.3, 0.2), name="reflectance")
    # So noisy that the prior alone remains.
    options = {"noise": 100.0, "time": time, "key": jax.random.key(1)}
    density = ask(inversion.log_density, observed, LIDAR, ground(), [unknown], **options)
    mean, std = moments(density, density.to_natural, "reflectance", -8.0, 8.0)
    prior = stats.lognorm(s=0.2, scale=0.3)
    assert mean == pytest.approx(prior.mean(), rel=2e-3)
    assert std == pytest.approx(prior.std(), rel=2e-2)


@pytest.mark.slow
def test_noise_of_a_recorder_is_normalised_where_it_grows_with_the_scale():
    observed, time = noisy_record(ground(), 0.01)
    recorder = inversion.Recorder(offset=(-0.1, 0.1), interleaved=2, pulse_noise=0.05, correlation=0.5)
    options = {"noise": 0.01, "time": time, "key": jax.random.key(1), "recorder": recorder}
    height = Unknown("ground.height", bounds=(-1.0, 1.0), name="height")
    density = ask(inversion.log_density, observed, LIDAR, ground(), [height], scale=(0.1, 10.0), **options)
    assert density.names == ("height", "offset[0]", "offset[1]", "scale")
    values = density.to_natural(density.initial)
    differences = []
    unit = {**values, "scale": jnp.ones(())}
    wave = jl.simulate(LIDAR, ground(), key=jax.random.key(0), window=WINDOW)
    reflectance = np.asarray(wave.reflectance, float)
    model = RecorderModel(recorder, [], LIDAR, time.size)
    shared = model.pulse_noise(reflectance, np.asarray(unit["offset"], float))[0]
    lag = np.abs(np.subtract.outer(np.arange(time.size), np.arange(time.size)))
    expected = []
    for scale in (0.5, 1.0, 3.0):
        x = density.to_unconstrained({**values, "scale": scale})
        fraction = np.asarray(jax.nn.sigmoid(x), float)
        differences.append(float(density(x)) - np.sum(np.log(fraction * (1 - fraction))))
        sigma = np.asarray(density._noise.sigma, float)
        separate = np.hypot(sigma, scale * np.asarray(density._noise.simulation_sigma, float))
        covariance = separate[:, None] * 0.5**lag * separate + scale**2 * shared @ shared.T
        offset = np.resize(np.asarray(values["offset"]), time.size)
        mean = scale * reflectance[0] + offset
        expected.append(stats.multivariate_normal(mean, covariance).logpdf(observed[0]))
    np.testing.assert_allclose(np.diff(differences), np.diff(expected), rtol=2e-3)


@pytest.fixture(scope="module")
def stand_density():
    observed, time = noisy_record(stand(), 2e-4)
    unknowns = [
        Unknown("ground.height", bounds=(-1.0, 1.0), name="height", prior=(0.0, 0.3)),
        Unknown(
            "canopy.voxels.leaf",
            bounds=(0.0, 1.0),
            name="extinction",
            prior=Smooth(scale=2.0, strength=0.3),
        ),
        Unknown("canopy.leaf.reflectance", bounds=(0.1, 0.6), name="leaf", prior=LogNormal(0.45, 0.1)),
    ]
    options = {"noise": 2e-4, "time": time, "key": jax.random.key(1), "max_orders": 1, "n_rays": 8}
    return ask(inversion.log_density, observed, LIDAR, stand((0.2, 0.2, 0.2), 0.1), unknowns, **options)


@pytest.mark.slow
def test_gradients_are_those_of_finite_differences(stand_density):
    x = stand_density.initial
    value, gradient = jax.value_and_grad(stand_density)(x)
    # A call by itself traces no derivatives: its value is the same.
    assert float(value) == pytest.approx(float(stand_density(x)), rel=1e-5)
    step = 0.02
    directions = step * np.eye(x.size)
    differences = [
        (float(stand_density(x + d)) - float(stand_density(x - d))) / (2 * step) for d in directions
    ]
    np.testing.assert_allclose(gradient, differences, rtol=0.02, atol=0.02 * np.max(np.abs(gradient)))


def test_coordinates_invert_one_another(stand_density):
    x = stand_density.initial + jnp.linspace(-1.0, 1.0, stand_density.initial.size)
    values = stand_density.to_natural(jnp.stack([x, -x]))
    assert values["extinction"].shape == (2, 1, 1, 3)
    np.testing.assert_allclose(stand_density.to_unconstrained(values), [x, -x], rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match="lacks 'leaf'"):
        stand_density.to_unconstrained({name: values[name] for name in ("height", "extinction")})
    with pytest.raises(ValueError, match="outside the admissible range"):
        stand_density.to_unconstrained({**values, "leaf": 0.7})
    with pytest.raises(ValueError, match=r"admissible is \(\.\.\., 5\)"):
        stand_density.to_natural(jnp.zeros(4))
    with pytest.raises(ValueError, match=r"jax\.vmap"):
        stand_density(jnp.zeros((2, 5)))


def test_densities_are_pickled(stand_density):
    copy = pickle.loads(pickle.dumps(stand_density))
    assert (
        copy.names == stand_density.names == ("height", *(f"extinction[0, 0, {i}]" for i in range(3)), "leaf")
    )
    assert eqx.tree_equal(copy.initial, stand_density.initial)
    assert float(copy(copy.initial)) == float(stand_density(stand_density.initial))


def test_a_scene_out_of_range_has_no_density():
    observed, time = noisy_record(stand(), 1e-3)
    # Leaves of a transmittance of 0.4 reflect 0.6 at most.
    unknown = Unknown("canopy.leaf.reflectance", bounds=(0.1, 0.9), name="leaf")
    options = {"noise": 1e-3, "time": time, "key": jax.random.key(1), "max_orders": 1, "n_rays": 8}
    density = ask(inversion.log_density, observed, LIDAR, stand(), [unknown], **options)
    assert np.isfinite(density(density.initial))
    value, gradient = jax.value_and_grad(density)(density.to_unconstrained({"leaf": 0.8}))
    assert float(value) == -np.inf
    np.testing.assert_array_equal(gradient, 0.0)


@pytest.mark.parametrize(
    "scene", [ground(), pytest.param(stand(), marks=pytest.mark.slow)], ids=["ground", "stand"]
)
def test_a_scene_that_the_plan_does_not_reach_has_no_density(scene):
    observed, time = noisy_record(scene, 1e-3)

    def bulge(scene, x):
        return eqx.tree_at(lambda s: s.ground.height, scene, 0.2 + 8.0 * jnp.sin(jnp.pi * x))

    # The plan serves the start and both bounds; between them the ground rises above the start of its rays.
    unknown = Unknown(apply=bulge, bounds=(0.0, 1.0), start=0.01, name="bulge")
    options = {"noise": 1e-3, "time": time, "key": jax.random.key(1), "max_orders": 1, "n_rays": 8}
    density = ask(inversion.log_density, observed, LIDAR, scene, [unknown], **options)
    x = density.to_unconstrained({"bulge": np.array([0.01, 0.5, 0.99])})
    values, gradients = jax.vmap(jax.value_and_grad(density))(x)
    assert np.isfinite(values).tolist() == [True, False, True]
    assert float(values[1]) == -np.inf
    np.testing.assert_array_equal(gradients[1], 0.0)
    assert np.all(np.isfinite(gradients))
    assert np.all(gradients[::2] != 0.0)


@pytest.mark.slow
def test_optics_brighter_than_the_start_have_a_density():
    """Orders are those that the start calls for: values that call for more keep their density."""
    observed, time = noisy_record(stand(), 1e-3)
    unknowns = [
        Unknown("canopy.leaf.reflectance", bounds=(0.05, 0.6), start=0.06, name="leaf"),
        Unknown("ground.height", bounds=(-1.0, 1.0), name="height"),
    ]
    options = {"noise": 1e-3, "time": time, "key": jax.random.key(1), "n_photons": 64, "n_rays": 8}
    density = ask(inversion.log_density, observed, LIDAR, stand(), unknowns, **options)
    corners = density.to_unconstrained({"leaf": np.array([0.059, 0.59]), "height": np.array([-0.99, 0.99])})
    assert np.all(np.isfinite(jax.vmap(density)(corners)))


def test_a_smoothness_prior_without_strength_is_refused():
    observed, time = noisy_record(stand(), 1e-3)
    unknown = Unknown("canopy.voxels.leaf", bounds=(0.0, 1.0), prior=Smooth(scale=2.0))
    with pytest.raises(ValueError, match="strength = None"):
        ask(
            inversion.log_density,
            observed,
            LIDAR,
            stand(),
            [unknown],
            noise=1.0,
            time=time,
            key=jax.random.key(0),
        )


def test_covariances_are_those_of_draws():
    """The covariance of coordinates, of draws in natural units that are close together, and near a bound."""
    observed, time = noisy_record(ground(), 0.01)
    unknowns = [Unknown("ground.height", bounds=(-1.0, 1.0), name="height"), REFLECTANCE]
    options = {"noise": 0.01, "time": time, "key": jax.random.key(1)}
    density = ask(inversion.log_density, observed, LIDAR, ground(), unknowns, **options)
    values = {"height": 0.99, "reflectance": 0.3}
    covariance = np.array([[1e-8, 3e-7], [3e-7, 4e-5]])
    with jax.enable_x64(True):
        draws = np.random.default_rng(0).multivariate_normal(list(values.values()), covariance, 40_000)
        low, width = (np.asarray(a, float) for a in (density._low, density._width))
        fraction = (draws - low) / width
        expected = np.cov(np.log(fraction / (1.0 - fraction)).T)
    result = np.asarray(density.to_unconstrained_covariance(covariance, values))
    np.testing.assert_allclose(result, expected, rtol=0.03)
    with pytest.raises(AssertionError):
        np.testing.assert_allclose(covariance / width[:, None] / width, expected, rtol=0.03)


@pytest.mark.parametrize(
    ("covariance", "message"),
    [
        (np.eye(3), r"covariance has the shape \(3, 3\); admissible is \(2, 2\)"),
        (np.diag([1.0, np.inf]), "covariance = inf"),
        (np.diag([1.0, 0.0]), "diagonal of covariance = 0"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "not that of any values"),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), "not that of any values"),
    ],
)
def test_inadmissible_covariances_are_refused(covariance, message):
    observed, time = noisy_record(ground(), 0.01)
    unknowns = [Unknown("ground.height", bounds=(-1.0, 1.0), name="height"), REFLECTANCE]
    options = {"noise": 0.01, "time": time, "key": jax.random.key(1)}
    density = ask(inversion.log_density, observed, LIDAR, ground(), unknowns, **options)
    with pytest.raises(ValueError, match=message):
        density.to_unconstrained_covariance(covariance, {"height": 0.0, "reflectance": 0.3})


@pytest.mark.parametrize("package", ["blackjax", "numpyro"])
def test_samplers_draw_from_the_posterior(package):
    sampler = pytest.importorskip(package)
    observed, time = noisy_record(ground(), 0.01)
    unknowns = [Unknown("ground.height", bounds=(-1.0, 1.0), name="height"), REFLECTANCE]
    arguments = observed, LIDAR, ground(height=0.0), unknowns
    options = {"noise": 0.01, "time": time, "key": jax.random.key(1)}
    fit, density = (
        ask(inversion.retrieve, *arguments, **options),
        ask(inversion.log_density, *arguments, **options),
    )
    key = jax.random.key(2)
    if package == "blackjax":
        adaptation = sampler.window_adaptation(sampler.nuts, density)
        (state, settings), _ = adaptation.run(key, density.initial, 200)
        step = sampler.nuts(density, **settings).step
        draws = jax.lax.scan(lambda s, k: (step(k, s)[0],) * 2, state, jax.random.split(key, 400))[1].position
    else:
        from numpyro.infer import MCMC, NUTS

        nuts = NUTS(potential_fn=lambda x: -density(x))
        mcmc = MCMC(nuts, num_warmup=200, num_samples=400, progress_bar=False)
        mcmc.run(key, init_params=density.initial)
        draws = mcmc.get_samples()
    for name, values in density.to_natural(draws).items():
        stderr = float(fit.stderr[name])
        assert abs(np.mean(values) - float(fit.values[name])) < 0.3 * stderr
        assert np.std(values) == pytest.approx(stderr, rel=0.25)
