"""Retrievals from synthetic waveforms of other random numbers; status, failure and inadmissible arguments."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion import Unknown
from inversion.fit.model import ForwardModel
from inversion.fit.planning import corner_cases, plan_for_bounds
from inversion.fit.solver import latin_hypercube
from inversion.fit.uncertainty import estimate_covariance
from inversion.fit.unknowns import bind_unknowns, optical_arrays
from jaxlidar.planning.plan import MIN_BATCHES
from jaxlidar.planning.plan_check import check_plan
from tests.helpers import BY_PRECISION, ask

LIDAR = jl.Lidar(
    wavelength=(532.0, 1064.0, 1550.0), altitude=500.0, divergence=8.0, pulse=jl.GaussianPulse(fwhm=4.0)
)
WINDOW = (-60.0, 20.0)


def scale_leaf_area(scene, factor):
    return eqx.tree_at(lambda s: s.canopy.voxels.leaf, scene, replace_fn=lambda leaf: factor * leaf)


def canopy_scene(Cab=40.0, Cw=0.012, height=0.0, ground=(0.1, 0.25, 0.35), extinction=0.3, **canopy):
    profile = extinction * np.array([0.5, 1.0, 1.5, 1.5, 1.0, 0.5]).reshape(1, 1, 6)
    voxels = jl.VoxelMap.from_extinction(leaf=profile, voxel_size=(4.0, 4.0, 1.0), origin=(0.0, 0.0, 2.0))
    canopy = {"leaf": jl.Prospect(Cab=Cab, Cw=Cw), "sides": "periodic", "hotspot": False, **canopy}
    return jl.Scene(
        canopy=jl.Canopy(voxels, **canopy), ground=jl.Ground(height=height, reflectance=np.array(ground))
    )


def start_scene(Cab=60.0):
    return canopy_scene(Cab=Cab, Cw=0.02, height=0.6, ground=(0.2, 0.2, 0.2), extinction=0.2)


UNKNOWNS = [
    Unknown(lambda s: s.canopy.leaf.Cab, bounds=(5.0, 100.0), name="Cab"),
    Unknown(name="leaf area scale", bounds=(0.1, 5.0), start=1.0, apply=scale_leaf_area),
    Unknown(lambda s: s.ground.reflectance, bounds=(0.0, 1.0)),
    Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0), name="height"),
    Unknown(lambda s: s.canopy.leaf.Cw, bounds=(0.001, 0.05)),
]
TRUTH = {
    "Cab": 40.0,
    "canopy.leaf.Cw": 0.012,
    "ground.reflectance": [0.1, 0.25, 0.35],
    "height": 0.0,
    "leaf area scale": 1.5,
}


@pytest.fixture(scope="module")
def target():
    wave = jl.simulate(
        LIDAR, canopy_scene(), key=jax.random.key(7), n_photons=100_000, max_orders=2, window=WINDOW
    )
    noise = np.broadcast_to(0.01 * np.max(wave.reflectance, axis=1, keepdims=True), wave.reflectance.shape)
    return wave, np.asarray(noise)


def retrieve_canopy(target, seed, start, unknowns=UNKNOWNS, **options):
    wave, noise = target
    observed = wave.reflectance + noise * np.random.default_rng(seed).normal(size=noise.shape)
    options = {"max_orders": 2, "n_photons": 8192, "n_rays": 256, "key": jax.random.key(1), **options}
    return ask(inversion.retrieve, observed, LIDAR, start, unknowns, noise=noise, time=wave.time, **options)


def assert_recovered(fit, truth, max_z=4.0):
    assert fit.converged, fit.status
    for name, true_value in truth.items():
        z = (np.asarray(fit.values[name]) - true_value) / np.asarray(fit.stderr[name])
        assert np.max(np.abs(z)) < max_z, (name, fit.values[name], fit.stderr[name])


@pytest.mark.slow
def test_canopy_and_ground_at_three_wavelengths(target, monkeypatch):
    """Leaf traits, ground, leaf area. A second fit of the same shapes compiles nothing."""
    steps = []
    fit = retrieve_canopy(target, 0, start_scene(), progress=steps.append)
    assert_recovered(fit, TRUTH)
    assert 0.75 < fit.reduced_chi2 < 1.3
    assert fit.steps < 20
    assert fit.status.startswith("converged after")
    assert fit.labels[2:5] == tuple(f"ground.reflectance[{i}]" for i in range(3))
    assert fit.covariance.shape == fit.correlation.shape == (7, 7)
    np.testing.assert_allclose(np.sqrt(np.diag(fit.covariance))[1], fit.stderr["leaf area scale"], rtol=1e-5)
    assert np.all(np.abs(fit.correlation) <= 1 + 1e-5)
    for name, error in fit.simulation_error.items():
        assert np.all((error > 0) & (error < fit.stderr[name]))
    wave, _ = target
    assert fit.waveform.reflectance.shape == fit.residuals.shape == wave.reflectance.shape
    assert float(fit.scene.canopy.leaf.Cab) == pytest.approx(float(fit.values["Cab"]))
    np.testing.assert_allclose(
        fit.scene.canopy.voxels.leaf,
        fit.values["leaf area scale"] * start_scene().canopy.voxels.leaf,
        rtol=1e-5,
    )
    assert [s.number for s in steps] == list(range(1, len(steps) + 1))
    assert steps[-1].reduced_chi2 < steps[0].reduced_chi2
    assert "Cab" in str(steps[0])
    assert "Cab" in str(fit)
    assert fit.history == tuple(s.reduced_chi2 for s in steps)

    def fail(*args):
        raise AssertionError("the trace was compiled again")

    # JAX calls these only while it traces a program to compile it.
    monkeypatch.setattr("inversion.fit.model.trace_scene", fail)
    monkeypatch.setattr("inversion.fit.model.total_reflectance", fail)
    equal_unknowns = [dataclasses.replace(u) for u in UNKNOWNS]
    second_fit = retrieve_canopy(target, 1, start_scene(Cab=50.0), equal_unknowns)
    assert_recovered(second_fit, TRUTH)
    assert not np.array_equal(second_fit.values["Cab"], fit.values["Cab"])


@pytest.mark.slow
def test_optics_alone_trace_once(target, monkeypatch):
    """Leaf traits and reflectances do not change paths: the photons of the first simulation serve all."""
    calls, trace_batch = [], inversion.fit.model._compiled_trace_batch
    monkeypatch.setattr(
        "inversion.fit.model._compiled_trace_batch", lambda *args: (calls.append(1), trace_batch(*args))[1]
    )
    optical = [UNKNOWNS[0], UNKNOWNS[2], UNKNOWNS[4]]
    start = canopy_scene(Cab=60.0, Cw=0.02, ground=(0.2, 0.2, 0.2))
    fit = retrieve_canopy(target, 2, start, optical)
    assert_recovered(fit, {k: v for k, v in TRUTH.items() if k in fit.values})
    assert fit.steps > 3
    assert len(calls) == MIN_BATCHES


def test_the_tracer_does_not_read_optical_arrays():
    """All arrays called optical are taken out of the scene, and it is traced all the same."""
    voxels = jl.VoxelMap.from_extinction(leaf=np.ones((1, 1, 2)), bark=np.ones((1, 1, 2)), voxel_size=1.0)
    scene = jl.Scene(
        canopy=jl.Canopy(voxels, leaf=jl.Prospect(), bark=0.4, hotspot=False),
        plates=(jl.Plate(height=5.0, reflectance=0.3, transmittance=0.2, coverage=0.5),),
        ground=jl.Ground(reflectance=jl.spectrum("soil-medium")),
        atmosphere=jl.Atmosphere(visibility=23.0),
    )
    plan = jl.plan(LIDAR, scene, max_orders=2, n_photons=512, n_rays=64)
    optical = optical_arrays(scene)
    leaves, structure = jax.tree.flatten(scene)
    without_optics = jax.tree.unflatten(
        structure, [None if i in optical else x for i, x in enumerate(leaves)]
    )
    eqx.filter_eval_shape(jl.trace_scene, jl.make_setup(LIDAR, without_optics, plan), jax.random.key(0))
    assert len(optical) == len(
        jax.tree.leaves([scene.canopy.leaf, 0.4, scene.ground.reflectance, scene.atmosphere, 0.3, 0.2])
    )
    # A reflectance that varies with position is applied while light is traced.
    terrain = jl.Terrain([[0.0, 1.0], [0.0, 1.0]], 50.0, (-25.0, -25.0), reflectance=[[0.1, 0.2], [0.3, 0.4]])
    assert not optical_arrays(jl.Scene(ground=terrain))
    # With straight transmission, the transmittance of leaves scales extinction.
    straight = canopy_scene(transmission="straight")
    for scene, expected in (
        (straight, [True, True, False, True, True]),
        (canopy_scene(), [False, True, False, True, False]),
    ):
        assert [u.setter.changes_response for u in bind_unknowns(UNKNOWNS, scene)] == expected


@pytest.mark.slow
def test_jacobian_is_that_of_the_simulation():
    """Against central differences, where the simulation is smooth: first order, double precision."""
    with jax.enable_x64(True):
        lidar = jl.Lidar(wavelength=(532.0, 1550.0), divergence=8.0, pulse=jl.GaussianPulse(fwhm=4.0))
        scene = canopy_scene(ground=(0.1, 0.3))
        unknowns = bind_unknowns(UNKNOWNS, scene)
        plan = jl.plan(lidar, scene, max_orders=1, n_rays=64, window=WINDOW, footprint="fixed")
        model = ForwardModel(lidar, scene, plan, unknowns, jax.random.key(0))
        x = np.array([40.0, 1.2, 0.1, 0.3, 0.1, 0.012])
        jacobian = model(x).jacobian

        @jax.jit
        def simulated(flat):
            Cab, area, first, second, height, Cw = flat
            scene_at_x = eqx.tree_at(
                lambda s: (s.canopy.leaf.Cab, s.canopy.leaf.Cw, s.ground.height, s.ground.reflectance),
                scale_leaf_area(scene, area),
                (Cab, Cw, height, jnp.stack([first, second])),
            )
            setup = jl.make_setup(lidar, scene_at_x, plan)
            return jl.total_reflectance(jl.trace_scene(setup, jax.random.key(0)), setup)

        for i in range(x.size):
            step = 1e-4 * x[i] * np.eye(x.size)[i]
            slope = (simulated(x + step) - simulated(x - step)) / (2 * step[i])
            np.testing.assert_allclose(jacobian[..., i], slope, rtol=0, atol=2e-5 * np.max(np.abs(slope)))


# Ground alone: nothing is random, and everything is quick.

PLAIN = jl.Lidar(
    wavelength=(532.0, 1064.0), altitude=500.0, divergence=10.0, pulse=jl.GaussianPulse(fwhm=4.0)
)
TIME = np.arange(-20.0, 21.0)
GROUND = [
    Unknown(lambda s: s.ground.height, bounds=(-1.0, 1.0), name="height"),
    Unknown(lambda s: s.ground.reflectance, bounds=(0.0, 1.0), name="reflectance"),
]


def ground_scene(height=0.1, reflectance=(0.2, 0.4), slope=20.0):
    return jl.Scene(
        ground=jl.Ground(height=height, reflectance=np.array(reflectance), slope=slope, aspect=30.0)
    )


def ground_wave(**scene):
    return jl.simulate(PLAIN, ground_scene(**scene), key=jax.random.key(0), window=(-20.0, 20.0))


def retrieve_ground(observed=None, unknowns=GROUND, noise=1e-3, scene=None, lidar=PLAIN, **options):
    observed = ground_wave() if observed is None else observed
    scene = ground_scene(-0.2, (0.3, 0.3)) if scene is None else scene
    return ask(
        inversion.retrieve, observed, lidar, scene, unknowns, noise=noise, key=jax.random.key(0), **options
    )


@pytest.mark.slow
@BY_PRECISION
def test_errors_are_as_large_as_stated(precision):
    """Over realisations of the noise, deviations over standard errors have variance 1, chi2 has mean 1."""
    wave, random = ground_wave(), np.random.default_rng(0)
    sigma = np.array([[4e-3], [8e-3]])
    z, chi2 = [], []
    for _ in range(25):
        observed = wave.reflectance + sigma * random.normal(size=wave.reflectance.shape)
        fit = retrieve_ground(observed, noise=sigma, time=wave.time)
        assert fit.converged
        z.append((float(fit.values["height"]) - 0.1) / float(fit.stderr["height"]))
        z.extend((np.asarray(fit.values["reflectance"]) - [0.2, 0.4]) / fit.stderr["reflectance"])
        chi2.append(float(fit.reduced_chi2))
        assert fit.values["height"].dtype == precision
    assert np.max(np.abs(z)) < 4.0
    # 75 z-scores: a variance of 1 within 4 of its standard errors, sqrt(2 / 75).
    assert np.mean(np.square(z)) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 75))
    assert np.mean(chi2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / (25 * 79)))


def test_a_truth_beyond_the_bounds_is_reported():
    fit = retrieve_ground(
        unknowns=[Unknown(lambda s: s.ground.height, bounds=(-1.0, 0.0), name="height"), GROUND[1]]
    )
    assert -1.0 <= float(fit.values["height"]) <= 0.0
    assert float(fit.values["height"]) == pytest.approx(0.0, abs=1e-2)
    assert "at the upper bound: height" in fit.status
    assert fit.reduced_chi2 > 2


def test_coordinates_that_single_precision_rounds_are_refused():
    far_lidar = dataclasses.replace(PLAIN, position=np.array([4e5, 5e6]))
    with pytest.raises(ValueError, match=r"rounded by 0.5 m in float32; admissible for fits is 0.001 m"):
        retrieve_ground(lidar=far_lidar)
    with jax.enable_x64(True):
        inversion.fit.model.check_position(jl.Lidar(position=(4e5, 5e6)))


def test_a_start_on_a_bound_is_moved_inside():
    fit = retrieve_ground(scene=ground_scene(-1.0, (0.0, 1.0)))
    assert_recovered(fit, {"height": 0.1, "reflectance": [0.2, 0.4]})


@pytest.mark.slow
@pytest.mark.parametrize("apply", [lambda s, value: eqx.tree_at(lambda s: s.ground.aspect, s, value), None])
def test_undetermined_unknowns_have_infinite_errors(apply):
    """The aspect of level ground, and two factors of which the waveform shows only the product."""
    if apply is None:
        options = {"scale": (0.1, 10.0)}
        unknowns, undetermined = GROUND, ["reflectance[0]", "reflectance[1]", "scale"]
    else:
        options = {}
        unknowns = [*GROUND, Unknown(name="aspect", bounds=(0.0, 180.0), start=90.0, apply=apply)]
        undetermined = ["aspect"]
    wave = ground_wave(slope=0.0)
    fit = retrieve_ground(wave, unknowns, scene=ground_scene(-0.2, (0.3, 0.3), slope=0.0), **options)
    assert fit.converged
    assert f"do not determine {', '.join(undetermined)} (infinite standard error)" in fit.status
    for name in {b.split("[")[0] for b in undetermined}:
        assert np.all(np.isinf(fit.stderr[name]))
    assert np.isfinite(fit.stderr["height"])
    assert float(fit.values["height"]) == pytest.approx(0.1, abs=4 * float(fit.stderr["height"]))
    assert np.all(np.isfinite(fit.correlation))
    assert not np.any(np.isnan(fit.covariance))


def test_a_prior_determines_what_the_data_leave_open():
    """With a prior on the reflectance, the scale is determined, and both errors are those of the formula."""
    unknowns = [GROUND[0], Unknown(lambda s: s.ground.reflectance, bounds=(0, 1), prior=([0.2, 0.4], 0.01))]
    wave = ground_wave()
    fit = retrieve_ground(3.0 * wave.reflectance, unknowns, scale=(0.1, 10.0), time=wave.time)
    assert_recovered(fit, {"ground.reflectance": [0.2, 0.4], "scale": 3.0}, max_z=1.0)
    # Relative errors 5 % and 2.5 % of the two priors, combined.
    relative = float(fit.stderr["scale"]) / 3.0
    assert relative == pytest.approx((1 / 0.05**2 + 1 / 0.025**2) ** -0.5, rel=0.05)


def test_samples_of_infinite_noise_are_left_out():
    wave = ground_wave()
    damaged = np.asarray(wave.reflectance).copy()
    noise = np.full(damaged.shape, 1e-3)
    damaged[:, 3], noise[:, 3] = np.nan, np.inf
    damaged[0, 21], noise[0, 21] = 99.0, np.inf
    fit = retrieve_ground(damaged, noise=noise, time=wave.time)
    assert_recovered(fit, {"height": 0.1, "reflectance": [0.2, 0.4]})
    assert fit.residuals[0, 21] == 0.0
    assert fit.reduced_chi2 < 0.1


def scale_reflectance(scene, factor):
    return eqx.tree_at(lambda s: s.ground.reflectance, scene, replace_fn=lambda x: factor * x)


def test_failure_is_a_status_and_raised_on_request_only():
    fit = retrieve_ground(max_steps=2)
    assert not fit.converged
    assert fit.status == "not converged: stopped at max_steps after 2 simulations"
    assert np.all(np.isfinite(fit.values["reflectance"]))
    with pytest.raises(RuntimeError, match="stopped at max_steps after 2"):
        retrieve_ground(max_steps=2, throw=True)
    broken = Unknown(
        name="broken", bounds=(0.0, 1.0), start=0.5, apply=lambda s, v: scale_reflectance(s, v / 0.0)
    )
    fit = retrieve_ground(unknowns=[broken])
    assert not fit.converged
    assert fit.status.startswith("failed: at the starting values the simulated waveform is not finite")
    assert np.isinf(fit.stderr["broken"])


@pytest.mark.slow
def test_a_step_to_a_simulation_that_is_not_finite_is_rejected():
    """Beyond a factor of 0.9 the simulation fails; the truth is at 1."""
    unknown = Unknown(
        name="factor",
        bounds=(0.0, 2.0),
        start=0.2,
        apply=lambda s, value: scale_reflectance(s, jnp.where(value > 0.9, jnp.nan, value)),
    )
    fit = retrieve_ground(unknowns=[unknown], scene=ground_scene())
    assert np.isfinite(fit.reduced_chi2)
    assert 0.5 < float(fit.values["factor"]) <= 0.9


@pytest.mark.slow
def test_starts_and_photons_have_different_keys(monkeypatch):
    """Latin hypercubes of one fit and of many are drawn with keys of no batch of photons."""
    keys = []

    def record_key(unknowns, count, key):
        keys.append(key)
        return latin_hypercube(unknowns, count, key)

    monkeypatch.setattr("inversion.fit.solver.latin_hypercube", record_key)
    wave = jl.simulate(PLAIN, ground_scene(), key=jax.random.key(5))
    unknown = Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0), name="height")
    key = jax.random.key(1)
    options = {"noise": 0.01, "key": key, "starts": 2, "max_steps": 1}
    ask(inversion.retrieve, wave, PLAIN, ground_scene(), [unknown], **options)
    ask(
        inversion.retrieve_many,
        np.stack([wave.reflectance] * 2),
        PLAIN,
        ground_scene(),
        [unknown],
        time=wave.time,
        **options,
    )
    assert len(keys) == 3
    batches = [jax.random.fold_in(key, n) for n in range(MIN_BATCHES)]
    # Keys that a batch, or a footprint, may derive from its own by a small number.
    derived = [jax.random.fold_in(batch, n) for batch in batches for n in range(MIN_BATCHES)]
    of_photons = {tuple(np.asarray(jax.random.key_data(k)).tolist()) for k in [*batches, *derived]}
    assert not of_photons & {tuple(np.asarray(jax.random.key_data(k)).tolist()) for k in keys}


def test_the_plan_serves_the_corners_of_the_bounds():
    """Loops and time bins are as long as any scene within the bounds needs."""
    scene = canopy_scene(sides="open")
    unknowns = [
        Unknown(lambda s: s.canopy.voxels.voxel_size, bounds=(0.5, 5.0)),
        Unknown(lambda s: s.canopy.voxels.origin, bounds=((-1.0, -1.0, -1.0), (1.0, 1.0, 9.0))),
        Unknown(lambda s: s.ground.height, bounds=(-5.0, 1.0)),
        Unknown(lambda s: s.ground.slope, bounds=(0.0, 30.0)),
    ]
    bound = bind_unknowns(unknowns, scene)
    time = np.arange(-260.0, 60.0)
    sizes = {"n_photons": 512, "n_rays": 64, "max_orders": 2}
    plan = plan_for_bounds(LIDAR, scene, bound, time, **sizes)
    assert plan.n_samples == time.size
    scenes = [corner for _, corner in corner_cases(LIDAR, scene, bound)]
    assert len(scenes) == 17
    for corner in scenes:
        corner_plan = jl.plan(
            LIDAR, corner, max_orders=2, window=(-260.0, 59.0), max_step=plan.limits.max_segment
        )
        assert corner_plan.limits.start_distance <= plan.limits.start_distance
        assert corner_plan.limits.max_path <= plan.limits.max_path
        assert corner_plan.config.max_ray_segments <= plan.config.max_ray_segments
        assert corner_plan.config.max_faces <= plan.config.max_faces
        assert corner_plan.bins.width == plan.bins.width
        assert corner_plan.bins.max_span <= plan.bins.max_span
        assert corner_plan.bins.start >= plan.bins.start - 1e-6
        end, longest = (b.start + b.width * b.count for b in (corner_plan.bins, plan.bins))
        assert end <= longest + 1e-6
    # More than four unknowns: each at its bounds alone, and all together.
    unknowns += [Unknown(name="leaf area", bounds=(0.1, 5.0), start=1.0, apply=scale_leaf_area)]
    assert len(corner_cases(LIDAR, scene, bind_unknowns(unknowns, scene))) == 13
    high = [Unknown(lambda s: s.ground.height, bounds=(-1.0, 1000.0))]
    with pytest.raises(ValueError, match="at the bounds of the unknowns the scene is inadmissible: altitude"):
        plan_for_bounds(LIDAR, scene, bind_unknowns(high, scene), time, **sizes)


def test_the_plan_of_a_fit_refuses_scenes_that_call_for_more_orders():
    """Its orders are those of the start, as `plan` chooses them, not a number that a user asked for."""
    height = Unknown(lambda s: s.ground.height, bounds=(-1.0, 1.0))
    dark, bright = (canopy_scene(leaf=jl.LeafOptics(r, r)) for r in (0.2, 0.49))
    sizes, time = {"n_photons": 64, "n_rays": 8}, np.arange(-60.0, 20.0)
    plan = plan_for_bounds(LIDAR, dark, bind_unknowns([height], dark), time, max_orders=None, **sizes)
    assert plan.scope.automatic_orders
    with pytest.raises(ValueError, match=rf"it follows {plan.orders} orders"):
        check_plan(plan, LIDAR, bright)
    chosen = plan_for_bounds(
        LIDAR, dark, bind_unknowns([height], dark), time, max_orders=plan.orders, **sizes
    )
    check_plan(chosen, LIDAR, bright)


def test_covariance_of_a_linear_problem():
    """Three columns, the last two collinear: the first unknown is determined, the others are not."""
    a, b = np.random.default_rng(0).normal(size=(2, 50))
    jacobian = np.stack([a, b, 2.0 * b], axis=1)
    width, fraction = np.full(3, 10.0), np.ones(50)
    estimate = estimate_covariance(jacobian, np.zeros((3, 3)), width, fraction, None)
    assert estimate.is_undetermined.tolist() == [False, True, True]
    expected = np.linalg.inv(jacobian[:, :2].T @ jacobian[:, :2])[0, 0]
    assert estimate.covariance[0, 0] == pytest.approx(expected)
    precision = np.diag([0.0, 0.0, 4.0])
    estimate = estimate_covariance(jacobian, precision, width, fraction, None)
    expected = np.linalg.inv(jacobian.T @ jacobian + precision)
    np.testing.assert_allclose(estimate.covariance, expected, atol=1e-12)
    # Batches that deviate along the first column, with variance 8: the mean of eight has the variance 1.
    deviations = np.outer(np.tile([1.0, -1.0], 4) * np.sqrt(7.0), a)
    estimate = estimate_covariance(a[:, None], np.zeros((1, 1)), np.full(1, 10.0), np.zeros(50), deviations)
    assert estimate.simulation_error[0] == pytest.approx(1.0)
    assert estimate.covariance[0, 0] == pytest.approx(1.0)


def retrieval_with(**changes):
    return lambda: retrieve_ground(**changes)


def retrieval_of(where=lambda s: s.ground.height, plan=None, **changes):
    return lambda: retrieve_ground(unknowns=[Unknown(where, **{"bounds": (-1.0, 1.0), **changes})], plan=plan)


# A plan for scenes below 8 m.
LOW_PLAN = jl.plan(PLAIN, ground_scene(), window=(-20.0, 20.0), describe=False)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (retrieval_with(unknowns=[]), "unknowns is empty"),
        (retrieval_with(noise=-1.0), r"noise = -1 is outside the admissible range \[0, inf\]"),
        (retrieval_with(noise=np.nan), "noise = nan"),
        (retrieval_with(noise=np.inf), "leaves no sample"),
        (retrieval_with(noise=np.ones((3, 4))), r"noise has the shape \(3, 4\)"),
        (retrieval_with(noise=0.0, noise_floor=0.0), "admissible is a noise above 0"),
        (retrieval_with(noise_floor=-1.0), "noise_floor = -1"),
        (retrieval_with(max_steps=0), "max_steps = 0"),
        (retrieval_with(n_photons=4), r"n_photons = 4 is outside the admissible range \[8, inf\)"),
        (
            retrieval_with(plan=jl.plan(PLAIN, jl.Scene(ground=jl.Ground())), n_rays=64),
            "together with n_rays",
        ),
        (retrieval_with(time=TIME), "has its own"),
        (retrieval_with(observed=np.zeros((2, 41))), "sample times are needed"),
        (
            retrieval_with(observed=np.zeros((2, 41)), time=2 * TIME),
            "time has a step of 2 ns.* sampling_interval, 1 ns",
        ),
        (
            retrieval_with(observed=np.zeros((2, 40)), time=TIME),
            r"observed has the shape \(2, 40\).*\(2, 41\)",
        ),
        (retrieval_with(observed=np.full((2, 41), np.nan), time=TIME), "observed = nan"),
        (retrieval_with(lidar=LIDAR), "observed has the wavelengths"),
        (retrieval_with(plan=jl.plan(PLAIN, ground_scene())), "they must agree"),
        (
            retrieval_of(bounds=(-1.0, 8.0), plan=LOW_PLAN),
            r"at the bounds of the unknowns the plan does not fit: its rays start .* reaches to",
        ),
        (retrieval_with(scale=(2.0, 1.0)), "scale = .* is not low < high"),
        (retrieval_with(unknowns=[GROUND[0], GROUND[0]]), "name = 'height' is given to 2 unknowns"),
        (
            retrieval_with(unknowns=[GROUND[0], dataclasses.replace(GROUND[0], name="other")]),
            "another one picks as well",
        ),
        (retrieval_of(bounds=(0.0, 1.0)), r"'ground.height' starts from -0.2, .* \[0, 1\]"),
        (retrieval_of(bounds=(1.0, -1.0)), "are not low < high"),
        (retrieval_of(bounds=(-np.inf, 1.0)), "bounds = -inf"),
        (retrieval_of(bounds=3.0), "not a pair"),
        (retrieval_of(bounds=((0.0, 1.0), 2.0)), "does not broadcast"),
        (retrieval_of(prior=(0.0, 0.0)), "prior standard deviation = 0"),
        (retrieval_of(prior=1.0), "prior = 1.0 is no LogNormal, no Smooth"),
        (retrieval_of("ground.hight"), "where = 'ground.hight' is no array .* nearest are 'ground.height'"),
        (retrieval_of(lambda s: s.canopy.leaf.Cab), "where picks nothing in this scene"),
        (retrieval_of(lambda s: s.canopy), r"where picks nothing \(None\)"),
        (retrieval_of(lambda s: s.ground), "where picks a Ground; admissible is one array"),
        (retrieval_of(lambda s: s.ground.reflectance[0]), "where picks nothing in this scene"),
        (retrieval_of(None), "either where"),
        (retrieval_of(apply=lambda s, value: s), "either where"),
        (retrieval_of(None, apply=lambda s, value: s), "a name and a start are needed"),
        (retrieval_of(None, name="x", start=0.0, apply=lambda s, value: s), "apply changes nothing"),
        (retrieval_of(None, name="x", start=0.0, apply=lambda s, value: None), "other parts, or none"),
    ],
)
def test_inadmissible_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.slow
def test_relief_is_found_from_terrain_that_is_flat_at_the_start():
    key = jax.random.key(0)
    x = np.arange(-20.0, 21.0, 10.0)
    bowl = np.add.outer(x, np.zeros(5)) ** 2 / 200.0

    def scene(depth):
        ground = jl.Terrain(depth * bowl, spacing=10.0, origin=(-20.0, -20.0), reflectance=0.3)
        return jl.Scene(ground=ground)

    lidar = jl.Lidar(altitude=1000.0, divergence=8.0, pulse=jl.GaussianPulse(4.0))
    wave = jl.simulate(lidar, scene(1.5), key=key, window=(-60.0, 60.0))
    depth = Unknown(apply=lambda s, d: scene(d), bounds=(-3.0, 3.0), start=0.0, name="depth")
    fit = ask(
        inversion.retrieve,
        wave.reflectance,
        lidar,
        scene(0.0),
        [depth],
        noise=1e-4,
        time=wave.time,
        key=key,
        max_orders=1,
    )
    assert float(fit.values["depth"]) == pytest.approx(1.5, abs=0.02)
