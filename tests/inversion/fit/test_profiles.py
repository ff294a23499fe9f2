"""Profiles: smoothness priors, averaging kernels, credible bands, and layers on slopes.

The references are dense formulas for Gaussian processes, repeated fits, and the closed-form gap inversion in
a case that it solves exactly.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

import inversion
import jaxlidar as jl
from inversion import Smooth, Unknown
from inversion.fit.data import ObservedWaveform
from inversion.fit.model import Evaluation
from inversion.fit.prior_residuals import PriorResiduals
from inversion.fit.recorder_model import RecorderModel
from inversion.fit.result import retrievals_of
from inversion.fit.solver import LeastSquaresFit, SolverSettings
from inversion.fit.unknowns import BoundUnknown, Setter
from tests.helpers import BY_PRECISION, ask, run_fit

LAYERS, SAMPLES, STRENGTH = 12, 40, 0.3
SMOOTH = Smooth(3.0, strength=STRENGTH)
CENTRE = 1.0


def unknowns_with(smooth, low=-9.0, high=11.0):
    """Return a profile with a smoothness prior, and a number without a prior."""
    start, setter = jnp.full(LAYERS, CENTRE), Setter(None, None, "geometric")
    low, high = np.full(LAYERS, low), np.full(LAYERS, high)
    profile = BoundUnknown("x", setter, start, low, high, None, smooth=smooth)
    number = BoundUnknown("b", setter, jnp.asarray(0.0), np.asarray(-50.0), np.asarray(50.0), None)
    return [profile, number]


def instrument():
    """Return the matrix of a linear instrument that blurs the layers, and of an offset: (samples, values)."""
    position = np.linspace(0.0, LAYERS - 1.0, SAMPLES)
    blur = np.exp(-0.5 * ((position[:, None] - np.arange(LAYERS)) / 1.2) ** 2)
    return np.column_stack([blur, np.ones(SAMPLES)])


def fitted(observed, smooth, **bounds):
    """Fit a record with noise of one."""
    matrix, unknowns = instrument(), unknowns_with(smooth, **bounds)
    observation = ObservedWaveform(np.arange(SAMPLES, dtype=float), observed[None], np.ones((1, SAMPLES)))
    recorder, settings = RecorderModel(None, [], jl.Lidar(), SAMPLES), SolverSettings(50, 1)
    fit = LeastSquaresFit(observation, unknowns, recorder, settings)

    def simulate(request):
        return Evaluation((matrix @ request.values)[None], matrix[None], None, None)

    return retrievals_of([run_fit(fit.run(), simulate).summary], unknowns)[0]


def matern(scale):
    """Correlation of the layers, written out."""
    layer = np.arange(LAYERS)
    distance = np.sqrt(3.0) * np.abs(np.subtract.outer(layer, layer)) / scale
    return (1.0 + distance) * np.exp(-distance)


def covariance_of(strength, smooth=SMOOTH):
    """Covariance of the layers, common level included."""
    return strength**2 * (matern(smooth.scale) + 9.0)


def simulated_record(random, strength=STRENGTH):
    """Draw a profile of the prior. Return it, and a record of it."""
    root = np.linalg.cholesky(covariance_of(strength) + 1e-9 * np.eye(LAYERS))
    truth = CENTRE + root @ random.normal(size=LAYERS)
    return truth, instrument() @ np.append(truth, 2.0) + random.normal(size=SAMPLES)


def test_the_fit_is_the_posterior_mean_with_its_covariance():
    """Against the formulas for jointly normal profile and data, with a wide prior of the offset."""
    _, y = simulated_record(np.random.default_rng(0))
    matrix, prior = instrument(), np.zeros((LAYERS + 1, LAYERS + 1))
    prior[:-1, :-1], prior[-1, -1] = covariance_of(STRENGTH), 1e5
    gain = prior @ matrix.T @ np.linalg.inv(matrix @ prior @ matrix.T + np.eye(SAMPLES))
    centre = np.append(np.full(LAYERS, CENTRE), 0.0)
    mean, covariance = centre + gain @ (y - matrix @ centre), prior - gain @ matrix @ prior
    fit = fitted(y, SMOOTH)
    assert fit.converged, fit.status
    np.testing.assert_allclose(fit.values["x"], mean[:-1], atol=2e-3)
    np.testing.assert_allclose(fit.covariance, covariance, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(fit.averaging, gain @ matrix, atol=1e-4)
    prior_share = np.clip(1.0 - np.diag(gain @ matrix)[:-1], 0.0, 1.0)
    np.testing.assert_allclose(fit.prior_share["x"], prior_share, atol=1e-4)


def test_the_strength_is_that_of_the_largest_evidence():
    """Against the density of the data, by dense matrices, on a fine grid."""
    _, y = simulated_record(np.random.default_rng(3))
    matrix = instrument()
    difference = y - matrix @ np.append(np.full(LAYERS, CENTRE), 0.0)

    def deviance(strength):
        prior = np.zeros((LAYERS + 1, LAYERS + 1))
        prior[:-1, :-1], prior[-1, -1] = covariance_of(strength), 100.0**2
        covariance = matrix @ prior @ matrix.T + np.eye(SAMPLES)
        chi2 = difference @ np.linalg.solve(covariance, difference)
        return chi2 + np.linalg.slogdet(covariance)[1]

    grid = np.geomspace(0.02, 5.0, 400)
    best = grid[np.argmin([deviance(s) for s in grid])]
    priors = PriorResiduals(unknowns_with(Smooth(3.0)))
    values = np.append(np.full(LAYERS, CENTRE), 0.0)
    for _ in range(8):
        priors.set_strengths(priors.maximise_evidence(values, matrix @ values - y, matrix))
    np.testing.assert_allclose(priors.strengths, best, rtol=0.02)
    fit = fitted(y, Smooth(3.0))
    assert fit.converged
    np.testing.assert_allclose(fit.strength["x"], best, rtol=0.12)
    # The evidence of other strengths is lower by more than the grid's steps.
    assert deviance(3.0 * best) > deviance(best) + 0.5
    assert deviance(best / 3.0) > deviance(best) + 0.5


def test_the_averaging_kernel_is_that_of_refits():
    truth, _ = simulated_record(np.random.default_rng(1))
    kernel = fitted(instrument() @ np.append(truth, 2.0), SMOOTH).averaging_kernel("x", 1.5)
    for layer in (0, 5, LAYERS - 1):
        refits = []
        for change in (1.0, -1.0):
            changed = truth + change * np.eye(LAYERS)[layer]
            refits.append(fitted(instrument() @ np.append(changed, 2.0), SMOOTH).values["x"])
        np.testing.assert_allclose(0.5 * (refits[0] - refits[1]), kernel.matrix[:, layer], atol=2e-3)
    np.testing.assert_allclose(kernel.degrees_of_freedom, np.trace(kernel.matrix))
    assert 1.0 < kernel.degrees_of_freedom < LAYERS
    diagonal = np.diag(kernel.matrix)
    np.testing.assert_allclose(kernel.resolution, np.where(diagonal > 0, 1.5 / diagonal, np.inf))


def test_layers_at_their_bound_have_no_degrees_of_freedom():
    """Against refits of a changed truth, within the bounds."""
    truth = np.append(9.0 * np.sin(np.arange(LAYERS)), 2.0)
    record = instrument() @ truth + np.random.default_rng(5).normal(size=SAMPLES)
    smooth, change = Smooth(2.0, strength=5.0, mean=0.5), 0.02
    fit = fitted(record, smooth, low=0.0)
    is_held = fit.values["x"] < 5e-3
    assert 2 <= is_held.sum() < LAYERS - 2
    kernel = fit.averaging_kernel("x")
    for layer in (1, int(np.argmax(is_held)), LAYERS - 2):
        ends = [record + sign * change * instrument()[:, layer] for sign in (1.0, -1.0)]
        refits = [fitted(end, smooth, low=0.0).values["x"] for end in ends]
        np.testing.assert_allclose(
            (refits[0] - refits[1]) / (2.0 * change), kernel.matrix[:, layer], atol=0.03
        )
    assert np.all(kernel.matrix[is_held] == 0.0)
    assert np.all(np.isinf(kernel.resolution[is_held]))
    free_layers = LAYERS - is_held.sum()
    assert 1.0 < kernel.degrees_of_freedom < free_layers
    # Negative control: the kernel of the fit without bounds counts more.
    assert fitted(record, smooth).averaging_kernel("x").degrees_of_freedom > kernel.degrees_of_freedom + 1.0


def coverage(strength, count, level=0.9):
    """Return the z-score of the coverage of bands with this strength, of profiles of strength STRENGTH."""
    random = np.random.default_rng(7)
    covered = []
    for _ in range(count):
        truth, y = simulated_record(random)
        low, high = fitted(y, Smooth(3.0, strength=strength)).band("x", level)
        covered.append(np.mean((truth > low) & (truth < high)))
    return (np.mean(covered) - level) / (np.std(covered, ddof=1) / np.sqrt(count))


def test_bands_cover_the_truth_at_their_level():
    assert abs(coverage(STRENGTH, 40)) < 3.0
    # Negative control: a prior that is too narrow.
    assert coverage(STRENGTH / 6.0, 20) < -5.0


def test_layers_at_their_bound_are_those_of_bounded_least_squares():
    truth = 9.0 * np.sin(np.arange(LAYERS))
    matrix = instrument()
    y = matrix @ np.append(truth, 2.0) + np.random.default_rng(5).normal(size=SAMPLES)
    smooth = Smooth(2.0, strength=5.0, mean=0.5)
    # The prior as rows of the least-squares problem.
    root = np.linalg.cholesky(np.linalg.inv(25.0 * matern(2.0))).T
    rows = np.vstack([matrix, np.column_stack([root, np.zeros(LAYERS)])])
    right_hand_side = np.concatenate([y, root @ np.full(LAYERS, 0.5)])
    bounds = np.append(np.zeros(LAYERS), -50.0), np.append(np.full(LAYERS, 11.0), 50.0)
    exact = optimize.lsq_linear(rows, right_hand_side, bounds, method="bvls", tol=1e-12).x
    assert np.sum(exact[:-1] < 1e-9) >= 2
    fit = fitted(y, smooth, low=0.0)
    assert fit.converged
    assert fit.steps < 8
    np.testing.assert_allclose(fit.values["x"], exact[:-1], atol=5e-3)
    low, high = fit.band("x", 0.95)
    assert np.all((low >= 0.0) & (low <= fit.values["x"]) & (fit.values["x"] < high))


# -- inadmissible input --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale": 0.0}, "scale = 0"),
        ({"scale": -1.0}, "scale = -1"),
        ({"spacing": 0.0}, "spacing = 0"),
        ({"strength": 0.0}, "strength = 0"),
        ({"strength": np.nan}, "strength = nan"),
        ({"mean": np.inf}, "mean = inf"),
    ],
)
def test_inadmissible_smoothness_priors_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Smooth(**{"scale": 2.0} | change)


def assert_refused(unknown, message, **options):
    options = {"noise": 1.0, "time": np.arange(9.0), "key": jax.random.key(0), **options}
    with pytest.raises(ValueError, match=message):
        ask(inversion.retrieve, np.zeros((1, 9)), jl.Lidar(), stand(np.ones(4)), [unknown], **options)


def test_unknowns_that_are_no_profile_are_refused():
    assert_refused(
        Unknown("ground.height", bounds=(0, 1), prior=Smooth(2.0)), "two values or more along one axis"
    )
    profile = profile_of(4, Smooth(2.0, mean=np.ones(3)))
    assert_refused(profile, "mean has the shape")
    with pytest.raises(ValueError, match="is no LogNormal, no Smooth"):
        profile_of(4, 3.0)


def test_cramer_rao_bounds_and_profile_likelihoods_need_a_strength():
    options = {"noise": 1.0, "key": jax.random.key(0), "max_orders": 1}
    for call in (
        lambda u: ask(inversion.cramer_rao, None, jl.Lidar(), stand(np.ones(4)), u, **options),
        lambda u: ask(
            inversion.profile_likelihood,
            np.zeros((1, 9)),
            jl.Lidar(),
            stand(np.ones(4)),
            u,
            "h",
            [0, 1],
            time=np.arange(9.0),
            **options,
        ),
    ):
        with pytest.raises(ValueError, match="strength = None leaves the Smooth prior's strength to a fit"):
            call([profile_of(4, Smooth(2.0)), Unknown("ground.height", bounds=(0, 1), name="h")])


def test_inadmissible_arguments_of_bands_and_kernels_are_refused():
    fit = fitted(np.zeros(SAMPLES), SMOOTH)
    with pytest.raises(ValueError, match="name = 'y'; admissible are 'b', 'x'"):
        fit.band("y", 0.9)
    with pytest.raises(ValueError, match="level = 1"):
        fit.band("x", 1.0)
    with pytest.raises(ValueError, match="spacing = 0"):
        fit.averaging_kernel("x", 0.0)


# -- stands ------------------------------------------------------------------------------------------------

# Of layers and voxels, m.
THICK = 2.0


def stand(density, slope=0.0, ground=0.3, columns=1, below=0):
    """Return layers over the ground. `below`: voxels below its middle, and as many above the plants."""
    shape = (columns, 1, len(density) + 2 * below)
    size = (40.0 / columns, 40.0, THICK)
    voxels = jl.VoxelMap.from_lad(np.ones(shape), voxel_size=size, origin=(-20.0, -20.0, -below * THICK))
    sides = "periodic" if columns == 1 else "open"
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.5, 0.4), hotspot=True, sides=sides)
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=ground, slope=slope, aspect=90.0))
    return inversion.put_profile(scene, jnp.asarray(density, float))


def profile_of(layers, prior):
    return Unknown(
        apply=inversion.put_profile, name="plants", bounds=(0.0, 2.0), start=np.full(layers, 0.2), prior=prior
    )


@pytest.mark.slow
def test_layers_lie_on_the_ground():
    density = np.array([0.4, 0.1, 0.3])
    flat = stand(density, below=2).canopy.voxels
    np.testing.assert_allclose(2.0 * flat.leaf[0, 0], [0, 0, *density, 0, 0], atol=1e-6)
    # 45 degrees, falling to the east; columns are 5 m wide, layers 2 m thick.
    steep = stand(density, slope=45.0, columns=8, below=12).canopy.voxels
    leaf = 2.0 * np.asarray(steep.leaf[:, 0])
    np.testing.assert_allclose(leaf.sum(axis=1), density.sum(), rtol=1e-5)
    middle = (leaf * np.arange(leaf.shape[1])).sum(axis=1) / leaf.sum(axis=1)
    np.testing.assert_allclose(np.diff(middle), -5.0 / THICK, rtol=1e-4)
    # The derivative in the slope.
    moment = lambda slope: jnp.sum(first_column_at(slope) * jnp.arange(27.0))  # noqa: E731
    derivative = jax.grad(moment)(10.0)
    expected = (moment(10.1) - moment(9.9)) / 0.2
    assert float(derivative) == pytest.approx(float(expected), rel=2e-2)
    scene = stand(density)
    with pytest.raises(ValueError, match="no canopy with leaf"):
        inversion.put_profile(jl.Scene(ground=scene.ground), jnp.ones(2))
    with pytest.raises(ValueError, match="from 0 m to 8 m, but the voxel map reaches from 0 m to 6 m"):
        inversion.put_profile(scene, jnp.ones(4))
    # Below the map as well. Empty layers may extend beyond it.
    with pytest.raises(ValueError, match=r"from -6\.\d+ m to"):
        stand(density, slope=20.0, columns=8, below=1)
    inversion.put_profile(scene, jnp.array([0.1, 0.2, 0.0, 0.0]))


def first_column_at(slope):
    """Return the voxels of the first column as a function of the slope, which JAX may be tracing."""
    base = stand(np.array([0.4, 0.1, 0.3]), columns=8, below=12)
    ground = dataclasses.replace(base.ground, slope=slope)
    scene = inversion.put_profile(jl.Scene(canopy=base.canopy, ground=ground), jnp.array([0.4, 0.1, 0.3]))
    return scene.canopy.voxels.leaf[0, 0]


SHARP = {"divergence": 1e-3, "altitude": 4e5, "sampling_interval": 0.25}


@pytest.mark.slow
def test_the_closed_form_is_exact_for_a_sharp_pulse():
    """The closed form assumes a hot spot, single scattering, and the ratio of reflectances that is given."""
    density = np.array([0.0, 0.1, 0.3, 0.2, 0.05])
    lidar = jl.Lidar(pulse=jl.GaussianPulse(fwhm=0.7), **SHARP)
    wave = jl.simulate(
        lidar, stand(density), key=jax.random.key(0), max_orders=1, window=(-90.0, 20.0), n_rays=16
    )
    height, power = np.asarray(wave.height), np.asarray(wave.reflectance[0])
    options = {"edges": THICK * np.arange(6), "pulse": lidar.pulse, "noise": 1e-6}
    # The reflectance of a Lambertian surface that scatters back as much as the leaves.
    brightness = 2.0 * float(np.sum(power[height > 1.5])) / (1.0 - np.exp(-THICK * 0.5 * density.sum())) / 2.0
    profile = inversion.plant_area_profile(height, power, reflectance_ratio=brightness / 0.3, **options)
    np.testing.assert_allclose(profile, density, atol=0.01)
    # Negative control: the wrong ratio.
    wrong = inversion.plant_area_profile(height, power, reflectance_ratio=2.0 * brightness / 0.3, **options)
    assert np.max(np.abs(wrong - density)) > 0.05
    several = inversion.plant_area_profile(
        height, np.stack([power, 2.0 * power]), reflectance_ratio=brightness / 0.3, **options
    )
    np.testing.assert_allclose(several, [profile, profile], atol=1e-3)
    with pytest.raises(ValueError, match="edges"):
        inversion.plant_area_profile(height, power, **options | {"edges": [1.0, 1.0]})


TRUTH = np.array([0.05, 0.2, 0.1, 0.3, 0.35, 0.1])


def noisy_records(n, seed=0):
    """Return n noisy waveforms of a stand at two wavelengths, and the arguments of a retrieval."""
    lidar = jl.Lidar(wavelength=(905.0, 1064.0), pulse=jl.GaussianPulse(6.0), divergence=1e-3, altitude=4e5)
    start = stand(np.full(6, 0.2), ground=np.array([0.3, 0.3]), below=1)
    truth = stand(TRUTH, ground=np.array([0.25, 0.35]), below=1)
    plan = jl.plan(lidar, start, max_orders=1, window=(-100.0, 30.0), n_rays=1)
    wave = jl.simulate(lidar, truth, key=jax.random.key(2), plan=plan)
    sigma = float(np.max(wave.reflectance)) / 100.0
    noise = sigma * np.random.default_rng(seed).normal(size=(n, *wave.reflectance.shape))
    unknowns = [
        Unknown("ground.height", bounds=(-2.0, 2.0), start=0.3, name="height"),
        Unknown("ground.reflectance", bounds=(0.05, 0.9), name="ground"),
        profile_of(6, Smooth(4.0, spacing=THICK)),
    ]
    options = {"noise": sigma, "time": wave.time, "key": jax.random.key(1), "plan": plan}
    return np.asarray(wave.reflectance) + noise, lidar, start, unknowns, options


@pytest.mark.slow
@BY_PRECISION
def test_a_profile_from_two_wavelengths(precision, tmp_path):
    observed, lidar, start, unknowns, options = noisy_records(3)
    fit = ask(inversion.retrieve, observed[0], lidar, start, unknowns, **options)
    assert fit.converged, fit.status
    low, high = fit.band("plants")
    assert np.all((low >= 0.0) & (high <= 2.0))
    z = (np.asarray(fit.values["plants"]) - TRUTH) / np.asarray(fit.stderr["plants"])
    assert np.max(np.abs(z)) < 4.0
    assert 0.02 < float(fit.strength["plants"]) < 2.0
    kernel = fit.averaging_kernel("plants", THICK)
    assert kernel.matrix.shape == (6, 6)
    assert 3.0 < kernel.degrees_of_freedom < 6.0
    assert np.all(kernel.resolution > THICK)
    assert np.all(fit.band("plants", robust=True)[1] >= high - 1e-6)

    path = tmp_path / "fits.zarr"
    fits = ask(inversion.retrieve_many, observed, lidar, start, unknowns, lanes=3, path=path, **options)
    np.testing.assert_allclose(fits.values["plants"][0], fit.values["plants"], atol=2e-2)
    assert fits.strength["plants"].shape == (3,)
    assert fits.band("plants")[0].shape == fits.averaging_kernel("plants").resolution.shape == (3, 6)
    from_store = ask(inversion.retrieve_many, observed, lidar, start, unknowns, lanes=3, path=path, **options)
    np.testing.assert_array_equal(from_store.averaging, fits.averaging)
    np.testing.assert_array_equal(from_store.strength["plants"], fits.strength["plants"])
    with_other_prior = [*unknowns[:2], profile_of(6, Smooth(5.0, spacing=THICK))]
    with pytest.raises(ValueError, match="which differs in prior of 'plants'"):
        ask(inversion.retrieve_many, observed, lidar, start, with_other_prior, lanes=3, path=path, **options)
