"""Retrieval of one scene from many records: Jacobians, priors, stopping, errors, stores."""

import dataclasses
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

import inversion
import jaxlidar as jl
from inversion.fit.planning import plan_for_bounds
from inversion.fit.uncertainty import estimate_covariance
from inversion.fit.unknowns import bind_unknowns, flat_start
from inversion.scene import retrieval
from inversion.scene.map_priors import MapPriors
from inversion.scene.retrieval import _shot_groups, no_longer_falls
from inversion.scene.survey_model import SurveyModel, _waveforms

LIDAR = jl.Lidar(wavelength=1064.0, altitude=1000.0, divergence=4.0, pulse=jl.GaussianPulse(4.0))
# G of spherical leaf angles.
G = 0.5


def stand(lad):
    voxels = jl.VoxelMap.from_lad(lad, voxel_size=1.0)
    return jl.Scene(
        canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4)), ground=jl.Ground(reflectance=0.3)
    )


def crowns():
    lad = np.zeros((10, 10, 10))
    lad[2:5, 2:6, 3:9], lad[6:9, 5:9, 2:6] = 0.5, 0.4
    return lad


def with_noise(waves, seed=0, fraction=0.02):
    noise = fraction * float(waves.reflectance.max())
    random = np.random.default_rng(seed)
    return waves.reflectance + noise * random.normal(size=waves.reflectance.shape), noise


@pytest.fixture(scope="module")
def small_stand():
    """Retrieve a stand of 1000 voxels from 16 footprints."""
    survey = jl.Survey.grid(LIDAR, (2.0, 2.0), (8.0, 8.0), 2.0)
    waves = jl.simulate_many(survey, stand(crowns()), key=jax.random.key(0), max_orders=1)
    observed, noise = with_noise(waves)
    prior = inversion.MarkovField(0.1)
    start = np.full((10, 10, 10), 0.05)
    unknown = inversion.Unknown(
        "canopy.voxels.leaf", bounds=(0.0, 1.0), name="leaf", start=start, prior=prior
    )
    steps = []
    fit = inversion.retrieve_scene(
        observed,
        survey,
        stand(crowns()),
        [unknown],
        noise=noise,
        time=waves.time,
        key=jax.random.key(1),
        max_orders=1,
        draws=4,
        kernels={"leaf": [(3, 3, 7)]},
        progress=steps.append,
    )
    return fit, steps


# -- a stand -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_small_stand_has_its_leaf_area_and_profile(small_stand):
    fit, _ = small_stand
    lad, truth = np.asarray(fit.values["leaf"]) / G, crowns()
    assert abs(lad.sum() / truth.sum() - 1.0) < 0.06
    assert np.corrcoef(lad.sum(axis=(0, 1)), truth.sum(axis=(0, 1)))[0, 1] > 0.95
    # The start, which has as much leaf area in every layer, would not pass.
    assert np.corrcoef(lad.ravel(), truth.ravel())[0, 1] > 0.7
    assert fit.converged
    assert float(fit.misfit) < 1.15


@pytest.mark.slow
def test_the_fit_ends_at_the_least_held_out_misfit(small_stand):
    fit, steps = small_stand
    history = np.asarray(fit.history)
    assert float(fit.held_out_misfit) == pytest.approx(history[:, 1].min(), rel=1e-4)
    assert int(np.sum(np.asarray(fit.held_out))) == 2
    assert [s.stage for s in steps].count("fit") == len(history)
    assert str(steps[0]).startswith("fit 1: misfit ")


@pytest.mark.slow
def test_total_leaf_area_is_better_determined_than_voxels(small_stand):
    fit, _ = small_stand
    error_of_total = float(fit.stderr_of("leaf", np.sum)) / float(fit.values["leaf"].sum())
    error_of_voxel = float(np.median(np.asarray(fit.stderr["leaf"]))) / float(fit.values["leaf"].mean())
    assert 0.0 < error_of_total < 0.2
    assert error_of_voxel > 0.5
    # The kernel spreads over the footprint, and lies about its own height. Values at the bound of zero cannot
    # follow the truth: it sums to about one over the others.
    kernel, at_bound = np.asarray(fit.averaging["leaf"][0]), np.asarray(fit.at_bound["leaf"])
    assert not at_bound[3, 3, 7]
    assert 0.5 < kernel[~at_bound].sum() < 1.5
    assert abs(kernel.sum(axis=(0, 1)).argmax() - 7) <= 1


@pytest.mark.slow
def test_a_result_is_printed_on_a_screen_and_stored(small_stand, tmp_path):
    fit, _ = small_stand
    assert len(str(fit).splitlines()) < 20
    fit.save(tmp_path / "fit.nc")
    stored = jl.open(tmp_path / "fit.nc")
    assert stored.status == fit.status
    np.testing.assert_array_equal(stored.draws["leaf"], fit.draws["leaf"])
    dataset = fit.to_xarray()
    assert dataset["leaf"].shape == (10, 10, 10)
    assert dataset["leaf stderr"].dims == dataset["leaf"].dims


@pytest.mark.slow
@pytest.mark.parametrize(("crown", "low", "high"), [(None, -0.06, 0.06), (3, -0.65, -0.35)])
def test_wide_footprints_determine_effective_leaf_area(crown, low, high):
    """Leaves spread evenly have their area; of crowns of 3 m, footprints of 12 m miss about half."""
    profile = np.array([0, 0, 0.1, 0.2, 0.3, 0.4, 0.4, 0.3, 0.2, 0.1, 0, 0])
    cover = np.ones((30, 30))
    if crown is not None:
        cover = np.kron(np.random.default_rng(0).uniform(size=(10, 10)) < 0.35, np.ones((crown, crown)))
    lad = profile * cover[:, :, None] / cover.mean()
    lidar = jl.Lidar(wavelength=1064.0, altitude=1000.0, divergence=12.0, pulse=jl.GaussianPulse(4.0))
    survey = jl.Survey.grid(lidar, (9.0, 9.0), (21.0, 21.0), 3.0)
    waves = jl.simulate_many(survey, stand(lad), key=jax.random.key(0), max_orders=1)
    observed, noise = with_noise(waves)
    unknown = inversion.Unknown(
        "canopy.voxels.leaf",
        bounds=(0.0, 1.0),
        name="leaf",
        start=np.full(lad.shape, 0.05),
        prior=inversion.MarkovField(0.1),
    )
    options = {"noise": noise, "time": waves.time, "key": KEY, "max_orders": 1, "draws": 0}
    fit = inversion.retrieve_scene(observed, survey, stand(lad), [unknown], **options)
    inner = (slice(8, -8), slice(8, -8))
    error = np.asarray(fit.values["leaf"])[inner].sum() / (G * lad[inner].sum()) - 1.0
    assert low < error < high
    # The records do not show it.
    assert float(fit.misfit) < 1.1


# -- products with the Jacobian ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model():
    """Return a model of narrow oblique shots with windows, gains and offsets, over a map with gaps."""
    lad = np.zeros((12, 12, 4))
    lad[::2, :, 1:3] = 0.4
    scene = stand(lad)
    random = np.random.default_rng(0)
    lidar = jl.Lidar(altitude=1000.0, divergence=0.5, pulse=jl.GaussianPulse(4.0))
    angles = {"zenith": random.uniform(0, 10, 24), "azimuth": random.uniform(0, 360, 24)}
    survey = jl.Survey(lidar, random.uniform(1.0, 11.0, (24, 2)), **angles)
    unknown = inversion.Unknown("canopy.voxels.leaf", bounds=(0.0, 1.0), start=jnp.asarray(0.5 * lad))
    bound = bind_unknowns([unknown], scene, of_maps=True)
    # The empty voxels stay empty: starts of fits keep off the bounds.
    bound = [bound[0]._replace(start=jnp.asarray(0.5 * lad))]
    groups = _shot_groups((0.5, 2.0), (-0.1, 0.1), np.arange(24) // 8, 24, bound)
    time = np.arange(-40.0, 10.0)
    plan = plan_for_bounds(survey, scene, bound, time, n_photons=16384, n_rays=8, max_orders=1)
    observed = random.uniform(0.0, 0.02, (24, 1, time.size))
    weight = random.uniform(10.0, 30.0, observed.shape)
    return SurveyModel(survey, scene, plan, bound, groups, observed, weight, jax.random.key(3)), observed


def perturbation(model, seed=1):
    """Return a change of all unknowns that leaves extinction non-negative."""
    random = np.random.default_rng(seed)
    change = random.uniform(0.0, 1.0, sum(model.sizes))
    change[-6:] = random.normal(size=6)
    return change


@pytest.mark.slow
def test_chunks_have_windows_and_give_the_waveforms_of_the_complete_map(model):
    model, _ = model
    assert model.inputs.window_shape is not None
    x = flat_start(model.all_unknowns)
    with_windows = model.gradient(x)
    inputs = model.inputs
    model.inputs = dataclasses.replace(inputs, window_shape=None)
    try:
        complete = model.gradient(x)
    finally:
        model.inputs = inputs
    np.testing.assert_allclose(with_windows.records, complete.records, atol=1e-7)
    np.testing.assert_allclose(with_windows.gradient, complete.gradient, rtol=1e-3, atol=1e-3)
    # Records of other shots differ by far more than the tolerance.
    assert np.ptp(complete.records, axis=0).max() > 1e-4


@pytest.mark.parametrize("precision", ["float64"], indirect=True)
def test_windows_hold_what_beams_meet_wherever_unknowns_move_the_map(precision):
    """An even map that moves by up to 6 m under narrow shots within it: records do not change."""
    survey = jl.Survey(jl.Lidar(divergence=1.0), [(-10.0, -10.0), (-10.0, 10.0), (10.0, -10.0), (10.0, 10.0)])

    def moved(scene, x):
        origin = jnp.stack([x - 20.0, jnp.full_like(x, -20.0), jnp.zeros_like(x)])
        return eqx.tree_at(lambda s: s.canopy.voxels.origin, scene, origin)

    unknown = inversion.Unknown(apply=moved, name="x", bounds=(-6.0, 6.0), start=0.0)
    scene = moved(stand(np.ones((40, 40, 1))), jnp.zeros(()))
    bound, time = bind_unknowns([unknown], scene, of_maps=True), np.arange(-20.0, 10.0)
    plan = plan_for_bounds(survey, scene, bound, time, n_photons=8, n_rays=8, max_orders=1)
    groups, zero = _shot_groups(None, None, np.arange(4), 4, bound), np.zeros((4, 1, time.size))
    model = SurveyModel(survey, scene, plan, bound, groups, zero, zero + 1.0, jax.random.key(3))
    assert model.inputs.window_shape is not None
    records = eqx.filter_jit(_waveforms)
    at_start, at_end = (records(model.inputs, (jnp.asarray(x),), model.shots[0]) for x in (0.0, 5.5))
    np.testing.assert_allclose(at_end, at_start, atol=1e-9)


def test_gradients_are_those_of_finite_differences(model):
    model, observed = model
    x, change, step = flat_start(model.all_unknowns), perturbation(model), 2e-3

    def half_chi_squared(x):
        return 0.5 * np.sum(((model.gradient(x).records - observed) * model.weight) ** 2)

    # One-sided, as empty voxels have no negative extinction: second order in the step.
    f0, f1, f2 = (half_chi_squared(x + k * step * change) for k in range(3))
    expected = (4.0 * f1 - 3.0 * f0 - f2) / (2.0 * step)
    assert model.gradient(x).gradient @ change == pytest.approx(expected, rel=2e-3)
    empty = np.append(x[:-6] == 0.0, np.zeros(6, bool))
    assert abs(model.gradient(x).gradient[empty] @ change[empty]) > 0.01 * abs(expected)


@pytest.mark.slow
def test_gauss_newton_products_are_those_of_finite_differences(model):
    model, _ = model
    x, v, step = flat_start(model.all_unknowns), perturbation(model), 2e-3
    m0, m1, m2 = (model.gradient(x + k * step * v).records for k in range(3))
    pushed = (4.0 * m1 - 3.0 * m0 - m2) / (2.0 * step)
    expected = np.sum((pushed * model.weight) ** 2)
    assert v @ model.gauss_newton_product(x, v) == pytest.approx(expected, rel=5e-3)
    # J^T c for another vector than the residuals.
    c = np.random.default_rng(2).normal(size=pushed.shape)
    assert v @ model.pull_back(x, c) == pytest.approx(np.sum(c * pushed), rel=0.02, abs=0.02)


# -- priors ------------------------------------------------------------------------------------------------


def test_priors_have_the_gradient_of_their_density():
    scene = jl.Scene(
        canopy=jl.Canopy(
            jl.VoxelMap.from_lad(np.ones((3, 4, 2)), voxel_size=1.0), leaf=jl.LeafOptics(0.4, 0.4)
        ),
        ground=jl.Ground(),
    )
    field = inversion.MarkovField((0.2, np.inf, 0.4), mean=0.3)
    unknowns = bind_unknowns(
        [
            inversion.Unknown("canopy.voxels.leaf", bounds=(0.0, 2.0), prior=field),
            inversion.Unknown("ground.reflectance", bounds=(0.0, 1.0), prior=inversion.LogNormal(0.3, 0.5)),
            inversion.Unknown("ground.height", bounds=(-1.0, 1.0), prior=(0.1, 0.2)),
        ],
        scene,
        of_maps=True,
    )
    priors, random = MapPriors(unknowns), np.random.default_rng(0)
    x, v = random.uniform(0.1, 0.9, 26), random.normal(size=26)

    def cost(x):
        k = x[:24].reshape(3, 4, 2)
        differences = np.sum(np.diff(k, axis=0) ** 2) / 0.2**2 + np.sum(np.diff(k, axis=2) ** 2) / 0.4**2
        priors_of_ground = (np.log(x[24] / 0.3) / 0.5) ** 2 + ((x[25] - 0.1) / 0.2) ** 2
        return 0.5 * (differences + priors_of_ground) + np.sum(k) / 0.3

    value, gradient = priors.cost_and_gradient(x)
    assert value == pytest.approx(cost(x), rel=1e-5)
    assert gradient @ v == pytest.approx((cost(x + 1e-5 * v) - cost(x - 1e-5 * v)) / 2e-5, rel=1e-5)


def test_markov_fields_and_smooth_priors_are_refused_where_they_do_not_serve():
    scene = stand(crowns())
    field = inversion.Unknown("canopy.voxels.leaf", bounds=(0.0, 1.0), prior=inversion.MarkovField(0.1))
    with pytest.raises(ValueError, match="prior is a MarkovField; admissible here is a Smooth"):
        bind_unknowns([field], scene)
    smooth = inversion.Unknown("ground.height", bounds=(0, 1), prior=inversion.Smooth(2.0))
    with pytest.raises(ValueError, match="prior is a Smooth; admissible here is a MarkovField"):
        bind_unknowns([smooth], scene, of_maps=True)
    prior = inversion.MarkovField((0.1, 0.2))
    unknown = inversion.Unknown("canopy.voxels.leaf", bounds=(0.0, 1.0), prior=prior)
    with pytest.raises(ValueError, match="difference has 2 values; admissible is one, or one for each"):
        bind_unknowns([unknown], scene, of_maps=True)
    with pytest.raises(ValueError, match="difference"):
        inversion.MarkovField(0.0)


# -- stopping, groups, errors and stores, without a canopy ------------------------------------------------


def test_the_stopping_rule_waits_for_ten_steps_without_a_gain():
    falling = np.geomspace(10.0, 1.0, 30)
    assert not no_longer_falls(falling)
    assert not no_longer_falls(np.append(falling, np.ones(9)))
    assert no_longer_falls(np.append(falling, np.ones(10)))


def flat_case(height=0.3, gains=(1.0, 1.2, 0.8)):
    """Return a survey over a plane, and its records in three groups."""
    survey = jl.Survey.grid(jl.Lidar(), (0, 0), (30, 20), 10.0)
    waves = jl.simulate_many(
        survey,
        jl.Scene(ground=jl.Ground(height=height, reflectance=0.4)),
        key=jax.random.key(0),
        max_orders=1,
    )
    groups = np.arange(len(survey)) % 3
    records = waves.reflectance * np.array(gains)[groups][:, None, None] + 0.001
    return survey, waves, records, groups


HEIGHT = inversion.Unknown("ground.height", bounds=(-2.0, 2.0), name="height")
START = jl.Scene(ground=jl.Ground(reflectance=0.4))
KEY = jax.random.key(1)


@pytest.mark.slow
def test_gains_and_offsets_of_groups_are_fitted_with_the_scene():
    survey, waves, records, groups = flat_case()
    shared = {"noise": 1e-4, "time": waves.time, "key": KEY, "max_orders": 1, "draws": 0}
    shots = {"gain": (0.3, 3.0), "offset": (-0.01, 0.01), "groups": groups}
    fit = inversion.retrieve_scene(records, survey, START, [HEIGHT], **shared, **shots)
    np.testing.assert_allclose(fit.values["gain"], [1.0, 1.2, 0.8], rtol=2e-3)
    np.testing.assert_allclose(fit.values["offset"], 0.001, atol=1e-4)
    assert float(fit.values["height"]) == pytest.approx(0.3, abs=2e-3)
    assert np.all(np.isnan(fit.stderr["height"]))
    # Held-out shots have gains of their own here: they get the best for their records.
    fit_by_shot = inversion.retrieve_scene(
        records, survey, START, [HEIGHT], **shared, gain=(0.3, 3.0), offset=(0, 0.1)
    )
    assert float(fit_by_shot.held_out_misfit) < 2.0


@pytest.mark.slow
def test_standard_errors_are_those_of_the_inverse_of_the_matrix():
    survey, waves, _, _ = flat_case()
    observed, noise = with_noise(waves)
    brightness = inversion.Unknown("ground.reflectance", bounds=(0.1, 0.9), name="brightness")
    fit = inversion.retrieve_scene(
        observed,
        survey,
        START,
        [HEIGHT, brightness],
        noise=noise,
        time=waves.time,
        key=KEY,
        max_orders=1,
        draws=64,
        held_out=0.0,
    )
    # An independent matrix, by finite differences of simulations.
    h, r = (float(fit.values[name]) for name in ("height", "brightness"))
    window = {"window": (float(waves.time[0]), float(waves.time[-1]))}

    def record(height, reflectance):
        scene = jl.Scene(ground=jl.Ground(height=height, reflectance=reflectance))
        return np.asarray(jl.simulate(jl.Lidar(), scene, key=KEY, max_orders=1, **window).reflectance)

    by_height = (record(h + 0.01, r) - record(h - 0.01, r)) / 0.02
    by_reflectance = (record(h, r + 0.01) - record(h, r - 0.01)) / 0.02
    columns = np.stack([by_height.ravel(), by_reflectance.ravel()]) / noise
    expected = np.sqrt(np.diag(np.linalg.inv(len(survey) * columns @ columns.T)))
    for name, error in zip(("height", "brightness"), expected):
        # Of 64 draws: chi-squared with 64 degrees of freedom, three standard deviations are 27 %.
        assert float(fit.stderr[name]) == pytest.approx(error, rel=0.27)
    truth = {"height": 0.3, "brightness": 0.4}
    assert all(abs(float(fit.values[n]) - truth[n]) < 4.0 * float(fit.stderr[n]) for n in truth)


def test_averaging_kernels_hold_values_at_their_bounds():
    """Kernels are finite differences of refits: least squares with bounds, to records of other truths."""
    random = np.random.default_rng(2)
    jacobian = random.normal(size=(30, 6)) + random.normal(size=(30, 1))
    precision = np.diag(random.uniform(1.0, 20.0, 6))
    # The second and the fifth value are far beyond the bounds.
    truth, low, high = np.array([0.1, 3.0, -0.2, 0.3, -2.0, 0.0]), np.full(6, -1.0), np.full(6, 1.0)

    def refit(truth, bounds=(low, high)):
        rows = np.concatenate([jacobian, np.sqrt(precision)])
        return lsq_linear(rows, np.append(jacobian @ truth, np.zeros(6)), bounds, method="bvls", tol=1e-14).x

    def differences(**changes):
        steps = 0.01 * np.eye(6)
        return np.stack([refit(truth + h, **changes) - refit(truth - h, **changes) for h in steps], 1) / 0.02

    x, refits = refit(truth), differences()
    at_bound = np.abs(x) == 1.0
    np.testing.assert_array_equal(at_bound, [False, True, False, False, True, False])

    matrix = jacobian.T @ jacobian + precision
    problem = SimpleNamespace(product=lambda x, v: matrix @ v)
    end = SimpleNamespace(evaluation=SimpleNamespace(x=x), scale=1.0 / np.sqrt(np.diag(matrix)))
    columns = [retrieval._Problem.solve(problem, end, unit, ~at_bound) for unit in np.eye(6)]
    kernels = np.stack(columns) @ jacobian.T @ jacobian
    np.testing.assert_allclose(kernels, refits, atol=0.02)
    np.testing.assert_array_equal(kernels[at_bound], 0.0)
    # Those of fits of single records.
    estimate = estimate_covariance(jacobian, precision, high - low, np.ones(30), None, at_bound=at_bound)
    np.testing.assert_allclose(estimate.averaging, refits, atol=1e-6)
    # Negative control: without bounds, other rows change too.
    assert np.abs(kernels - differences(bounds=(-np.inf, np.inf)))[~at_bound].max() > 0.1


@pytest.mark.slow
def test_a_value_at_its_bound_has_no_averaging_kernel():
    x = np.arange(0.0, 31.0, 5.0)
    brightness = 0.3 + 0.1 * np.sin(x / 5.0)[:, None] * np.ones_like(x)

    heights = np.sin(x / 6.0)[:, None] + np.cos(x / 8.0)

    def terrain(reflectance):
        return jl.Scene(ground=jl.Terrain(heights, spacing=5.0, origin=(0.0, 0.0), reflectance=reflectance))

    lidar = jl.Lidar(altitude=1000.0, divergence=3.0, pulse=jl.GaussianPulse(4.0))
    survey = jl.Survey.grid(lidar, (5.0, 5.0), (25.0, 25.0), 2.5)
    waves = jl.simulate_many(survey, terrain(brightness), key=jax.random.key(0), max_orders=1)
    observed, noise = with_noise(waves)
    # The first place has 0.39, beyond the bound, and the second has 0.2.
    unknown = inversion.Unknown(
        "ground.reflectance", bounds=(0.05, 0.32), name="brightness", prior=inversion.MarkovField(0.2)
    )
    fit = inversion.retrieve_scene(
        observed,
        survey,
        terrain(np.full_like(brightness, 0.25)),
        [unknown],
        noise=noise,
        time=waves.time,
        key=KEY,
        max_orders=1,
        draws=0,
        kernels={"brightness": [(2, 3), (5, 3)]},
    )
    at_bound = np.asarray(fit.at_bound["brightness"])
    assert at_bound[2, 3]
    assert not at_bound[5, 3]
    held, free = np.asarray(fit.averaging["brightness"])
    assert np.all(held == 0.0)
    assert free[5, 3] == free.max() > 0.3


@pytest.mark.slow
def test_an_interrupted_run_goes_on_and_another_problem_is_refused(tmp_path):
    survey, waves, _, groups = flat_case()
    path = tmp_path / "fit.zarr"
    shared = {"noise": 1e-3, "time": waves.time, "max_orders": 1, "draws": 3, "held_out": 0.0}
    shared |= {"gain": (0.3, 3.0), "groups": groups}
    records = np.asarray(waves.reflectance)

    def interrupt(step):
        if step.stage == "errors" and step.number == 2:
            raise KeyboardInterrupt

    def run(key=KEY, **arguments):
        return inversion.retrieve_scene(
            records, survey, START, [HEIGHT], key=key, path=path, **shared, **arguments
        )

    with pytest.raises(KeyboardInterrupt):
        run(progress=interrupt)
    with pytest.raises(ValueError, match="rows are missing: the run that writes them has not ended"):
        jl.open(path)
    steps = []
    resumed = run(progress=steps.append)
    # The fit and two draws were done.
    assert [(s.stage, s.number) for s in steps] == [("errors", 3)]
    uninterrupted = inversion.retrieve_scene(records, survey, START, [HEIGHT], key=KEY, **shared)
    np.testing.assert_allclose(resumed.draws["height"], uninterrupted.draws["height"], rtol=1e-6)
    np.testing.assert_array_equal(jl.open(path).draws["height"], resumed.draws["height"])
    with pytest.raises(ValueError, match="another problem, which differs in key"):
        run(key=jax.random.key(7))


def test_bad_arguments_are_refused_by_name():
    survey, waves, records, _ = flat_case()

    def run(observed=records, **changes):
        arguments = {"noise": 1e-3, "time": waves.time, "key": KEY, "max_orders": 1} | changes
        return inversion.retrieve_scene(observed, survey, START, [HEIGHT], **arguments)

    cases = [
        ({"observed": records[:3]}, r"waveforms has the shape \(3, 1, "),
        ({"noise": 0.0}, r"noise = 0 is outside the admissible range \(0, inf\]"),
        ({"noise": np.inf}, "noise is infinite throughout"),
        ({"time": None}, "time = None, but waveforms is an array"),
        ({"held_out": 1.0}, "held_out = 1"),
        ({"gain": (2.0, 1.0)}, r"gain = \(2.0, 1.0\) is not low < high"),
        ({"gain": (-1.0, 1.0)}, "gain"),
        ({"groups": [0.5] * 12}, "groups has values that are no whole numbers"),
        ({"kernels": {"depth": [()]}}, "kernels has 'depth'; admissible are 'height'"),
    ]
    for changes, message in cases:
        with pytest.raises(ValueError, match=message):
            run(**changes)
    with pytest.raises(ValueError, match="time is given with Waveforms"):
        run(observed=waves)


# -- maps of the ground ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_heights_and_reflectance_of_a_terrain_are_maps_of_their_own():
    """Nodes that footprints see are found; a plane, which the fit starts from, is far off."""
    x = np.arange(0.0, 31.0, 5.0)
    heights = np.sin(x / 6.0)[:, None] + np.cos(x / 8.0)
    brightness = 0.3 + 0.1 * np.sin(x / 5.0)[:, None] * np.ones_like(x)

    def terrain(heights, reflectance):
        return jl.Scene(ground=jl.Terrain(heights, spacing=5.0, origin=(0.0, 0.0), reflectance=reflectance))

    lidar = jl.Lidar(altitude=1000.0, divergence=3.0, pulse=jl.GaussianPulse(4.0))
    survey = jl.Survey.grid(lidar, (5.0, 5.0), (25.0, 25.0), 2.5)
    waves = jl.simulate_many(survey, terrain(heights, brightness), key=jax.random.key(0), max_orders=1)
    observed, noise = with_noise(waves)
    unknowns = [
        inversion.Unknown(
            "ground.heights", bounds=(-4.0, 4.0), name="heights", prior=inversion.MarkovField(2.0)
        ),
        inversion.Unknown(
            "ground.reflectance", bounds=(0.05, 0.9), name="brightness", prior=inversion.MarkovField(0.2)
        ),
    ]
    fit = inversion.retrieve_scene(
        observed,
        survey,
        terrain(np.full_like(heights, 0.5), np.full_like(brightness, 0.3)),
        unknowns,
        noise=noise,
        time=waves.time,
        key=KEY,
        max_orders=1,
        draws=0,
    )
    inner = (slice(1, -1), slice(1, -1))
    for name, truth, start in (("heights", heights, 0.5), ("brightness", brightness, 0.3)):
        error = np.asarray(fit.values[name])[inner] - truth[inner]
        assert np.sqrt(np.mean(error**2)) < 0.2 * np.sqrt(np.mean((truth[inner] - start) ** 2)), name
