"""Retrievals from synthetic waveforms of other random numbers, and what a retrieval refuses or reports."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import inversion
import jaxlidar as jl
from inversion import Unknown
from inversion.fit.model import Model
from inversion.fit.planning import corners, plan_for
from inversion.fit.priors import inside, outside
from inversion.fit.uncertainty import errors_of
from inversion.fit.unknowns import optical_leaves, settle
from jaxlidar.planning.plan import MIN_BATCHES
from tests.helpers import NARROW

LIDAR = jl.Lidar(
    wavelength=(532.0, 1064.0, 1550.0), altitude=500.0, divergence=8.0, pulse=jl.GaussianPulse(fwhm=4.0)
)
WINDOW = (-60.0, 20.0)


def leaf_area(scene, value):
    return eqx.tree_at(lambda s: s.canopy.voxels.leaf, scene, replace_fn=lambda leaf: value * leaf)


def canopy_scene(Cab=40.0, Cw=0.012, height=0.0, ground=(0.1, 0.25, 0.35), extinction=0.3, **canopy):
    profile = extinction * np.array([0.5, 1.0, 1.5, 1.5, 1.0, 0.5]).reshape(1, 1, 6)
    voxels = jl.VoxelMap.from_extinction(leaf=profile, voxel_size=(4.0, 4.0, 1.0), origin=(0.0, 0.0, 2.0))
    canopy = {"leaf": jl.Prospect(Cab=Cab, Cw=Cw), "sides": "periodic", **canopy}
    return jl.Scene(
        canopy=jl.Canopy(voxels, **canopy), ground=jl.Ground(height=height, reflectance=np.array(ground))
    )


def start_scene(Cab=60.0):
    return canopy_scene(Cab=Cab, Cw=0.02, height=0.6, ground=(0.2, 0.2, 0.2), extinction=0.2)


UNKNOWNS = [
    Unknown(lambda s: s.canopy.leaf.Cab, bounds=(5.0, 100.0), name="Cab"),
    Unknown(name="leaf area scale", bounds=(0.1, 5.0), start=1.0, apply=leaf_area),
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


def retrieve_canopy(target, seed, start, unknowns=UNKNOWNS, **more):
    wave, noise = target
    observed = wave.reflectance + noise * np.random.default_rng(seed).normal(size=noise.shape)
    more = {"max_orders": 2, "n_photons": 8192, "n_rays": 2048, "key": jax.random.key(1), **more}
    return inversion.retrieve(observed, LIDAR, start, unknowns, noise=noise, time=wave.time, **more)


def assert_recovered(fit, truth, limit=4.0):
    assert fit.converged, fit.status
    for name, true in truth.items():
        z = (np.asarray(fit.values[name]) - true) / np.asarray(fit.stderr[name])
        assert np.max(np.abs(z)) < limit, (name, fit.values[name], fit.stderr[name])


@pytest.mark.slow
def test_canopy_and_ground_at_three_wavelengths(target, monkeypatch):
    """Leaf traits, ground reflectance and height, leaf area; a second target of the same shape reuses all."""
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
    for name, part in fit.simulation_error.items():
        assert np.all((part > 0) & (part < fit.stderr[name]))
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

    def traced(*args):
        raise AssertionError("the trace was compiled again")

    monkeypatch.setattr("inversion.fit.model.trace_scene", traced)
    monkeypatch.setattr("inversion.fit.model.total_reflectance", traced)
    fresh = [dataclasses.replace(u) for u in UNKNOWNS]
    again = retrieve_canopy(target, 1, start_scene(Cab=50.0), fresh)
    assert_recovered(again, TRUTH)
    assert not np.array_equal(again.values["Cab"], fit.values["Cab"])


@pytest.mark.slow
def test_optics_alone_trace_once(target, monkeypatch):
    """Leaf traits and reflectances never move light: the photons of the first simulation serve them all."""
    calls = []
    batch = inversion.fit.model._compiled_batch
    monkeypatch.setattr(
        "inversion.fit.model._compiled_batch", lambda *args: (calls.append(1), batch(*args))[1]
    )
    optical = [UNKNOWNS[0], UNKNOWNS[2], UNKNOWNS[4]]
    start = canopy_scene(Cab=60.0, Cw=0.02, ground=(0.2, 0.2, 0.2))
    fit = retrieve_canopy(target, 2, start, optical)
    assert_recovered(fit, {k: v for k, v in TRUTH.items() if k in fit.values})
    assert fit.steps > 3
    assert len(calls) == MIN_BATCHES


def test_the_tracer_does_not_look_at_optical_leaves():
    """All leaves called optical are taken out of the scene, and it is traced all the same."""
    voxels = jl.VoxelMap.from_extinction(leaf=np.ones((1, 1, 2)), bark=np.ones((1, 1, 2)), voxel_size=1.0)
    scene = jl.Scene(
        canopy=jl.Canopy(voxels, leaf=jl.Prospect(), bark=0.4),
        plates=(jl.Plate(height=5.0, reflectance=0.3, transmittance=0.2, coverage=0.5),),
        ground=jl.Ground(reflectance=jl.spectrum("soil-medium")),
        atmosphere=jl.Atmosphere(visibility=23.0),
    )
    plan = jl.plan(LIDAR, scene, max_orders=2, n_photons=64, n_rays=64)
    optical = optical_leaves(scene)
    leaves, structure = jax.tree.flatten(scene)
    blind = jax.tree.unflatten(structure, [None if i in optical else x for i, x in enumerate(leaves)])
    eqx.filter_eval_shape(jl.trace_scene, jl.make_setup(LIDAR, blind, plan), jax.random.key(0))
    assert len(optical) == len(
        jax.tree.leaves([scene.canopy.leaf, 0.4, scene.ground.reflectance, scene.atmosphere, 0.3, 0.2])
    )
    # A reflectance that varies from place to place is traced.
    terrain = jl.Terrain([[0.0, 1.0], [0.0, 1.0]], 50.0, (-25.0, -25.0), reflectance=[[0.1, 0.2], [0.3, 0.4]])
    assert not optical_leaves(jl.Scene(ground=terrain))
    # Leaves that transmit straight on scale extinction.
    straight = canopy_scene(transmission="straight")
    assert [s.place.traced for s in settle(UNKNOWNS, straight)] == [True, True, False, True, True]
    assert [s.place.traced for s in settle(UNKNOWNS, canopy_scene())] == [False, True, False, True, False]


@pytest.mark.slow
def test_jacobian_is_that_of_the_simulation():
    """Against central differences, where the simulation is smooth: first order, double precision."""
    with jax.enable_x64(True):
        lidar = jl.Lidar(wavelength=(532.0, 1550.0), divergence=8.0, pulse=jl.GaussianPulse(fwhm=4.0))
        scene = canopy_scene(ground=(0.1, 0.3))
        unknowns = settle(UNKNOWNS, scene)
        plan = jl.plan(lidar, scene, max_orders=1, n_rays=64, window=WINDOW, footprint="fixed")
        model = Model(lidar, scene, plan, unknowns, jax.random.key(0))
        at = np.array([40.0, 1.2, 0.1, 0.3, 0.1, 0.012])
        jacobian = model(at).jacobian

        @jax.jit
        def simulated(flat):
            Cab, area, first, second, height, Cw = flat
            here = eqx.tree_at(
                lambda s: (s.canopy.leaf.Cab, s.canopy.leaf.Cw, s.ground.height, s.ground.reflectance),
                leaf_area(scene, area),
                (Cab, Cw, height, jnp.stack([first, second])),
            )
            setup = jl.make_setup(lidar, here, plan)
            return jl.total_reflectance(jl.trace_scene(setup, jax.random.key(0)), setup)

        for i in range(at.size):
            step = 1e-4 * at[i] * np.eye(at.size)[i]
            slope = (simulated(at + step) - simulated(at - step)) / (2 * step[i])
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


def retrieve_ground(observed=None, unknowns=GROUND, noise=1e-3, scene=None, lidar=PLAIN, **more):
    observed = ground_wave() if observed is None else observed
    scene = ground_scene(-0.2, (0.3, 0.3)) if scene is None else scene
    return inversion.retrieve(observed, lidar, scene, unknowns, noise=noise, key=jax.random.key(0), **more)


@NARROW
def test_errors_are_as_large_as_stated(precision):
    """Over realisations of the noise, deviations over standard errors have variance 1, chi2 has mean 1."""
    wave, rng = ground_wave(), np.random.default_rng(0)
    sigma = np.array([[4e-3], [8e-3]])
    scores, chi2 = [], []
    for _ in range(25):
        observed = wave.reflectance + sigma * rng.normal(size=wave.reflectance.shape)
        fit = retrieve_ground(observed, noise=sigma, time=wave.time)
        assert fit.converged
        scores.append((float(fit.values["height"]) - 0.1) / float(fit.stderr["height"]))
        scores.extend((np.asarray(fit.values["reflectance"]) - [0.2, 0.4]) / fit.stderr["reflectance"])
        chi2.append(float(fit.reduced_chi2))
        assert fit.values["height"].dtype == precision
    assert np.max(np.abs(scores)) < 4.0
    # 75 scores: a variance of 1 within 4 of its standard errors, sqrt(2/120).
    assert np.mean(np.square(scores)) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 75))
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
    far = dataclasses.replace(PLAIN, position=np.array([4e5, 5e6]))
    with pytest.raises(ValueError, match=r"rounded by 0.5 m in float32; admissible for fits is 0.001 m"):
        retrieve_ground(lidar=far)
    with jax.enable_x64(True):
        inversion.fit.model.check_place(jl.Lidar(position=(4e5, 5e6)))


def test_a_start_on_a_bound_is_moved_inside():
    fit = retrieve_ground(scene=ground_scene(-1.0, (0.0, 1.0)))
    assert_recovered(fit, {"height": 0.1, "reflectance": [0.2, 0.4]})


@pytest.mark.slow
@pytest.mark.parametrize("apply", [lambda s, value: eqx.tree_at(lambda s: s.ground.aspect, s, value), None])
def test_an_unknown_to_which_the_data_are_blind(apply):
    """The direction of no slope; and two values of which only the product shows."""
    if apply is None:
        more = {"scale": (0.1, 10.0)}
        unknowns, blind = GROUND, ["reflectance[0]", "reflectance[1]", "scale"]
    else:
        more = {}
        unknowns = [*GROUND, Unknown(name="aspect", bounds=(0.0, 180.0), start=90.0, apply=apply)]
        blind = ["aspect"]
    wave = ground_wave(slope=0.0)
    fit = retrieve_ground(wave, unknowns, scene=ground_scene(-0.2, (0.3, 0.3), slope=0.0), **more)
    assert fit.converged
    assert f"do not determine {', '.join(blind)} (infinite standard error)" in fit.status
    for name in {b.split("[")[0] for b in blind}:
        assert np.all(np.isinf(fit.stderr[name]))
    assert np.isfinite(fit.stderr["height"])
    assert float(fit.values["height"]) == pytest.approx(0.1, abs=4 * float(fit.stderr["height"]))
    assert np.all(np.isfinite(fit.correlation))
    assert not np.any(np.isnan(fit.covariance))


def test_priors_bind_what_data_leave_open():
    """Of reflectance and scale, a prior on one determines the other, and both errors are as they must be."""
    unknowns = [GROUND[0], Unknown(lambda s: s.ground.reflectance, bounds=(0, 1), prior=([0.2, 0.4], 0.01))]
    wave = ground_wave()
    fit = retrieve_ground(3.0 * wave.reflectance, unknowns, scale=(0.1, 10.0), time=wave.time)
    assert_recovered(fit, {"ground.reflectance": [0.2, 0.4], "scale": 3.0}, limit=1.0)
    # Relative errors 5 % and 2.5 % of the two priors, combined.
    relative = float(fit.stderr["scale"]) / 3.0
    assert relative == pytest.approx((1 / 0.05**2 + 1 / 0.025**2) ** -0.5, rel=0.05)


def test_samples_of_infinite_noise_are_left_out():
    wave = ground_wave()
    spoilt = np.asarray(wave.reflectance).copy()
    noise = np.full(spoilt.shape, 1e-3)
    spoilt[:, 3], noise[:, 3] = np.nan, np.inf
    spoilt[0, 21], noise[0, 21] = 99.0, np.inf
    fit = retrieve_ground(spoilt, noise=noise, time=wave.time)
    assert_recovered(fit, {"height": 0.1, "reflectance": [0.2, 0.4]})
    assert fit.residuals[0, 21] == 0.0
    assert fit.reduced_chi2 < 0.1


def brightened(scene, value):
    return eqx.tree_at(lambda s: s.ground.reflectance, scene, replace_fn=lambda x: value * x)


def test_failure_is_data_and_raised_only_where_asked():
    fit = retrieve_ground(max_steps=2)
    assert not fit.converged
    assert fit.status == "not converged: stopped at max_steps after 2 simulations"
    assert np.all(np.isfinite(fit.values["reflectance"]))
    with pytest.raises(RuntimeError, match="stopped at max_steps after 2"):
        retrieve_ground(max_steps=2, throw=True)
    broken = Unknown(name="broken", bounds=(0.0, 1.0), start=0.5, apply=lambda s, v: brightened(s, v / 0.0))
    fit = retrieve_ground(unknowns=[broken])
    assert not fit.converged
    assert fit.status.startswith("failed: at the starting values the simulated waveform is not finite")
    assert np.isinf(fit.stderr["broken"])


def test_a_step_to_where_nothing_is_finite_is_taken_back():
    """Beyond a factor of 0.9 the simulation fails; the truth is at 1."""
    unknown = Unknown(
        name="factor",
        bounds=(0.0, 2.0),
        start=0.2,
        apply=lambda s, value: brightened(s, jnp.where(value > 0.9, jnp.nan, value)),
    )
    fit = retrieve_ground(unknowns=[unknown], scene=ground_scene())
    assert np.isfinite(fit.reduced_chi2)
    assert 0.5 < float(fit.values["factor"]) <= 0.9


def test_any_gauss_newton_method_serves():
    solvers = [optx.GaussNewton(1e-4, 1e-4), optx.Dogleg(1e-4, 1e-4), optx.LevenbergMarquardt(1e-4, 1e-4)]
    fits = [retrieve_ground(solver=solver) for solver in solvers]
    for fit in fits:
        assert_recovered(fit, {"height": 0.1, "reflectance": [0.2, 0.4]})
    with pytest.raises(ValueError, match="no Gauss-Newton method"):
        retrieve_ground(solver=optx.BestSoFarLeastSquares(solvers[0]))


def test_the_plan_serves_the_corners_of_the_bounds():
    """Loops and time bins are as long as any scene within the bounds needs."""
    scene = canopy_scene(sides="open")
    unknowns = [
        Unknown(lambda s: s.canopy.voxels.voxel_size, bounds=(0.5, 5.0)),
        Unknown(lambda s: s.canopy.voxels.origin, bounds=((-1.0, -1.0, -1.0), (1.0, 1.0, 9.0))),
        Unknown(lambda s: s.ground.height, bounds=(-5.0, 1.0)),
        Unknown(lambda s: s.ground.slope, bounds=(0.0, 30.0)),
    ]
    settled = settle(unknowns, scene)
    time = np.arange(-260.0, 60.0)
    plan = plan_for(LIDAR, scene, settled, time, max_orders=2, photons=64, rays=64)
    assert plan.n_samples == time.size
    scenes = corners(scene, settled)
    assert len(scenes) == 17
    for corner in scenes:
        own = jl.plan(LIDAR, corner, max_orders=2, window=(-260.0, 59.0), max_step=plan.limits.max_segment)
        assert own.limits.start_distance <= plan.limits.start_distance
        assert own.limits.max_path <= plan.limits.max_path
        assert own.config.max_ray_segments <= plan.config.max_ray_segments
        assert own.config.max_faces <= plan.config.max_faces
        assert own.bins.width == plan.bins.width
        assert own.bins.row <= plan.bins.row
        assert own.bins.start >= plan.bins.start - 1e-6
        end, longest = (b.start + b.width * b.count for b in (own.bins, plan.bins))
        assert end <= longest + 1e-6
    # More than four: each at its bounds alone, and all together.
    unknowns += [Unknown(name="leaf area", bounds=(0.1, 5.0), start=1.0, apply=leaf_area)]
    assert len(corners(scene, settle(unknowns, scene))) == 13
    high = [Unknown(lambda s: s.ground.height, bounds=(-1.0, 1000.0))]
    with pytest.raises(ValueError, match="at the bounds of the unknowns the scene is inadmissible: altitude"):
        plan_for(LIDAR, scene, settle(high, scene), time, max_orders=2, photons=64, rays=64)


def test_bijection():
    """Values stay within the bounds, for any free number; it is its own inverse's; its slope is right."""
    z = np.array([-800.0, -30.0, -2.0, 0.0, 1.0, 30.0, 800.0])
    value, slope = inside(z, np.full(7, -1.0), np.full(7, 3.0))
    assert np.all((value >= -1.0) & (value <= 3.0) & np.isfinite(slope) & (slope >= 0))
    np.testing.assert_allclose(outside(value[2:5], np.full(3, -1.0), np.full(3, 3.0)), z[2:5])
    ends = np.full(7, -1.0), np.full(7, 3.0)
    difference = (inside(z + 1e-5, *ends)[0] - inside(z - 1e-5, *ends)[0]) / 2e-5
    np.testing.assert_allclose(slope, difference, rtol=1e-6, atol=1e-9)


def test_errors_of_a_linear_problem():
    """Three columns, the last two alike: the first one's error is known, theirs is not."""
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 50))
    jacobian = np.stack([a, b, 2.0 * b], axis=1)
    errors = errors_of(jacobian, np.zeros((3, 3)), np.full(3, 10.0), np.ones(50), None)
    assert errors.open.tolist() == [False, True, True]
    expected = np.linalg.inv(jacobian[:, :2].T @ jacobian[:, :2])[0, 0]
    assert errors.covariance[0, 0] == pytest.approx(expected)
    errors = errors_of(jacobian, np.diag([0.0, 0.0, 4.0]), np.full(3, 10.0), np.ones(50), None)
    full = np.linalg.inv(jacobian.T @ jacobian + np.diag([0.0, 0.0, 4.0]))
    np.testing.assert_allclose(errors.covariance, full, atol=1e-12)
    # Batches that deviate as the first column does, with variance 8: their mean has the variance 1.
    deviations = np.outer(np.tile([1.0, -1.0], 4) * np.sqrt(7.0), a)
    errors = errors_of(a[:, None], np.zeros((1, 1)), np.full(1, 10.0), np.zeros(50), deviations)
    assert errors.simulation[0] == pytest.approx(1.0)
    assert errors.covariance[0, 0] == pytest.approx(1.0)


def wrong(**changes):
    return lambda: retrieve_ground(**changes)


def unknown(where=lambda s: s.ground.height, plan=None, **changes):
    return lambda: retrieve_ground(unknowns=[Unknown(where, **{"bounds": (-1.0, 1.0), **changes})], plan=plan)


# It does not reach up to 8 m.
LOW = jl.plan(PLAIN, ground_scene(), window=(-20.0, 20.0), describe=False)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (wrong(unknowns=[]), "unknowns is empty"),
        (wrong(noise=-1.0), r"noise = -1 is outside the admissible range \[0, inf\]"),
        (wrong(noise=np.nan), "noise = nan"),
        (wrong(noise=np.inf), "leaves no sample"),
        (wrong(noise=np.ones((3, 4))), r"noise has the shape \(3, 4\)"),
        (wrong(noise=0.0, noise_floor=0.0), "admissible is a noise above 0"),
        (wrong(noise_floor=-1.0), "noise_floor = -1"),
        (wrong(max_steps=0), "max_steps = 0"),
        (wrong(starts=1.5), "starts = 1.5 is outside"),
        (wrong(max_steps=np.nan), "max_steps = nan is outside"),
        (wrong(n_photons=4), r"n_photons = 4 is outside the admissible range \[8, inf\)"),
        (wrong(plan=jl.plan(PLAIN, jl.Scene(ground=jl.Ground())), n_rays=64), "together with n_rays"),
        (wrong(time=TIME), "has its own"),
        (wrong(observed=np.zeros((2, 41))), "sample times are needed"),
        (
            wrong(observed=np.zeros((2, 41)), time=2 * TIME),
            "time has a step of 2 ns.* sampling_interval, 1 ns",
        ),
        (wrong(observed=np.zeros((2, 40)), time=TIME), r"observed has the shape \(2, 40\).*\(2, 41\)"),
        (wrong(observed=np.full((2, 41), np.nan), time=TIME), "observed = nan"),
        (wrong(lidar=LIDAR), "observed has the wavelengths"),
        (wrong(plan=jl.plan(PLAIN, ground_scene())), "they must agree"),
        (
            unknown(bounds=(-1.0, 8.0), plan=LOW),
            r"at the bounds of the unknowns the plan does not fit: its rays start .* reaches to",
        ),
        (wrong(scale=(2.0, 1.0)), "scale = .* is not low < high"),
        (wrong(unknowns=[GROUND[0], GROUND[0]]), "name = 'height' is given to 2 unknowns"),
        (
            wrong(unknowns=[GROUND[0], dataclasses.replace(GROUND[0], name="other")]),
            "another one picks as well",
        ),
        (unknown(bounds=(0.0, 1.0)), r"'ground.height' starts from -0.2, .* \[0, 1\]"),
        (unknown(bounds=(1.0, -1.0)), "are not low < high"),
        (unknown(bounds=(-np.inf, 1.0)), "bounds = -inf"),
        (unknown(bounds=3.0), "not a pair"),
        (unknown(bounds=((0.0, 1.0), 2.0)), "does not broadcast"),
        (unknown(prior=(0.0, 0.0)), "prior standard deviation = 0"),
        (unknown(prior=1.0), "prior = 1.0 is no LogNormal, no Smooth"),
        (unknown("ground.hight"), "where = 'ground.hight' is no array .* nearest are 'ground.height'"),
        (unknown(lambda s: s.canopy.leaf.Cab), "where picks nothing in this scene"),
        (unknown(lambda s: s.canopy), r"where picks nothing \(None\)"),
        (unknown(lambda s: s.ground), "where picks a Ground; admissible is one array"),
        (unknown(lambda s: s.ground.reflectance[0]), "where picks nothing in this scene"),
        (unknown(None), "either where"),
        (unknown(apply=lambda s, value: s), "either where"),
        (unknown(None, apply=lambda s, value: s), "a name and a start are needed"),
        (unknown(None, name="x", start=0.0, apply=lambda s, value: s), "apply changes nothing"),
        (unknown(None, name="x", start=0.0, apply=lambda s, value: None), "other parts, or none"),
    ],
)
def test_bad_input_is_refused(call, words):
    with pytest.raises(ValueError, match=words):
        call()
