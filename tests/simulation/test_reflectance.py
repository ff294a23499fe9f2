"""Reflectance factors under sunlight: against discrete ordinates, a lidar's hot spot, and reciprocity."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.simulation.reflectance import _is_same_direction
from jaxlidar.trace.photons import higher_orders
from tests.helpers import agrees, slow_unless

KEY = jax.random.key(0)
THICKNESS = 10.0


def slab(tau, leaf, ground, *, hotspot=True, shape=(1, 1, 4)):
    """Return a homogeneous periodic slab of the optical depth `tau` over Lambertian ground."""
    size = (20.0 / shape[0], 20.0 / shape[1], THICKNESS / shape[2])
    extinction = tau / THICKNESS * jnp.ones(shape)
    voxels = jl.VoxelMap.from_extinction(leaf=extinction, voxel_size=size, origin=(-10.0, -10.0, 0.0))
    canopy = jl.Canopy(voxels, leaf=leaf, sides="periodic", hotspot=hotspot)
    return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=ground))


def ross_moments(reflectance, transmittance, streams):
    """Return Legendre moments of the phase function of spherical leaves, 8 Gamma / (R + T)."""
    x, weight = np.polynomial.legendre.leggauss(400)
    angle = np.arccos(x)
    gamma = (reflectance + transmittance) / (3 * np.pi) * (np.sin(angle) - angle * x) + transmittance / 3 * x
    phase = 8 * gamma / (reflectance + transmittance)
    basis = np.polynomial.legendre.Legendre.basis
    return [0.5 * np.sum(weight * phase * basis(order)(x)) for order in range(streams)]


def discrete_ordinates(moments, albedo, tau, ground, sun_zenith, view_stream, relative_azimuth):
    """Return the reflectance factor in the direction of one stream, and the zenith angle of that, degrees."""
    from PythonicDISORT import pydisort

    streams, cosine = len(moments), np.cos(np.deg2rad(sun_zenith))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        stream_cosines, *_, radiance = pydisort(
            np.array([tau]),
            np.array([albedo]),
            streams,
            np.array([moments]),
            cosine,
            1.0,
            0.0,
            BDRF_Fourier_modes=[ground],
            NLeg=streams,
            NFourier=streams // 2,
        )
    # Directions of travel: light that goes up, to a sensor on the far side of the sun, goes on as it came.
    value = radiance(0.0, np.deg2rad(180.0 + relative_azimuth))
    zenith = np.rad2deg(np.arccos(stream_cosines[view_stream]))
    return float(np.pi * value[view_stream] / cosine), float(zenith)


CASES = [
    (1.0, 0.2, 30.0, 10, 0.0),
    (1.0, 0.2, 30.0, 6, 120.0),
    (4.0, 0.1, 60.0, 8, 180.0),
    (0.3, 0.3, 0.0, 13, 0.0),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tau", "ground", "sun_zenith", "stream", "relative_azimuth"), slow_unless(CASES[1:2], CASES)
)
def test_slabs_of_leaves_agree_with_discrete_ordinates(tau, ground, sun_zenith, stream, relative_azimuth):
    reflectance, transmittance = 0.4, 0.3
    moments = ross_moments(reflectance, transmittance, 32)
    expected, view_zenith = discrete_ordinates(
        moments, 0.7, tau, ground, sun_zenith, stream, relative_azimuth
    )
    leaf = jl.LeafOptics(reflectance, transmittance)
    # An azimuth of the sun that is not zero: only the difference matters.
    angles = {"sun": (sun_zenith, 70.0), "view": (view_zenith, 70.0 + relative_azimuth)}
    scene = slab(tau, leaf, ground)
    factor = jl.reflectance_factor(scene, **angles, wavelengths=865.0, key=KEY, n_photons=1 << 18)
    value, stderr = float(factor.reflectance[0]), float(factor.stderr[0])
    assert stderr < 2e-3 * expected
    # The reference itself is good to about 1e-4 at this number of streams.
    assert abs(value - expected) < 3 * np.hypot(stderr, 1e-4)
    assert value == pytest.approx(expected, rel=5e-3)
    assert float(factor.unfollowed[0]) < 1e-3
    # The same test rejects leaves whose two sides are exchanged.
    wrong_moments = ross_moments(transmittance, reflectance, 32)
    wrong, _ = discrete_ordinates(wrong_moments, 0.7, tau, ground, sun_zenith, stream, relative_azimuth)
    assert abs(value - wrong) > 3 * np.hypot(stderr, 1e-4)


def test_ground_alone_has_its_reflectance_whatever_its_slope():
    angles = {"sun": (50.0, 20.0), "view": (20.0, 250.0)}
    spectrum = np.array([0.05, 0.4])
    flat = jl.Scene(ground=jl.Ground(reflectance=spectrum, height=3.0))
    factor = jl.reflectance_factor(flat, **angles, wavelengths=[660.0, 865.0], key=KEY, n_photons=64)
    np.testing.assert_allclose(factor, spectrum, rtol=1e-5)
    # A slope towards the sun is lit as cos(incidence) / cos(zenith) of flat ground.
    slope = jl.Scene(ground=jl.Ground(reflectance=spectrum, slope=20.0, aspect=20.0))
    factor = jl.reflectance_factor(slope, **angles, wavelengths=[660.0, 865.0], key=KEY, n_photons=64)
    gain = np.cos(np.deg2rad(30.0)) / np.cos(np.deg2rad(50.0))
    np.testing.assert_allclose(factor, gain * spectrum, rtol=1e-4)


@pytest.mark.parametrize("view", [(40.0, 90.0), (45.0, 270.0), (55.0, 270.0)])
@pytest.mark.parametrize("area", [((-1.0, -1.0), (1.0, 1.0)), ((-10.0, -1.0), (10.0, 1.0))])
def test_an_inclined_plane_has_its_reflectance_from_whatever_direction(view, area):
    """Uphill it rises without end; planted: rays that start above its height straight below start too low."""
    slope = jl.Scene(ground=jl.Ground(reflectance=0.3, slope=30.0, aspect=90.0))
    settings = {"wavelengths": 865.0, "key": KEY, "n_photons": 64, "area": area}
    factor = jl.reflectance_factor(slope, sun=(10.0, 0.0), view=view, **settings)
    # The sun stands across the slope: cos(incidence) is the product of the cosines.
    np.testing.assert_allclose(factor, 0.3 * np.cos(np.deg2rad(30.0)), rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("hotspot", [True, False])
def test_the_direction_of_the_sun_is_that_of_a_lidar(hotspot):
    scene = slab(1.0, jl.LeafOptics(0.45, 0.4), 0.2, hotspot=hotspot)
    lidar = jl.Lidar(altitude=4e5, divergence=1e-3)
    wave = jl.simulate(lidar, scene, key=KEY, n_photons=1 << 16)
    factor = jl.reflectance_factor(
        scene, sun=(0.0, 0.0), view=(0.0, 90.0), wavelengths=1064.0, key=KEY, n_photons=1 << 16
    )
    # Samples of a waveform are correlated; four times the sum of their errors is a bound that is wide enough.
    stderr = np.hypot(float(factor.stderr[0]), float(np.sum(wave.stderr)) / 4)
    expected = float(wave.reflectance.sum() + wave.neglected[0] / 2)
    assert abs(float(factor.reflectance[0]) - expected) < 3 * stderr
    # A degree from the sun the hot spot is gone, and without one nothing happens there.
    beside = jl.reflectance_factor(
        scene, sun=(0.0, 0.0), view=(1.0, 90.0), wavelengths=1064.0, key=KEY, n_photons=1 << 16
    )
    ratio = float(beside.reflectance[0] / factor.reflectance[0])
    assert ratio < 0.85 if hotspot else ratio == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
def test_sun_and_sensor_may_change_places():
    extinction = np.zeros((4, 4, 3))
    extinction[1:3, 1:3] = 1.0
    voxels = jl.VoxelMap.from_extinction(leaf=extinction, voxel_size=2.0, origin=(100.0, 50.0, 0.0))
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4), bark=0.3, sides="periodic")
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.2))
    angles = (50.0, 30.0), (15.0, 200.0)
    options = {"wavelengths": 865.0, "key": KEY, "n_photons": 1 << 16}
    forward = jl.reflectance_factor(scene, sun=angles[0], view=angles[1], **options)
    swapped = jl.reflectance_factor(scene, sun=angles[1], view=angles[0], **options)
    difference = float(forward.reflectance[0] - swapped.reflectance[0])
    assert abs(difference) < 3 * float(jnp.hypot(forward.stderr[0], swapped.stderr[0]))
    assert float(forward.stderr[0]) < 0.01 * float(forward.reflectance[0])


@pytest.mark.slow
def test_derivatives_are_those_of_finite_differences():
    def scene_of(values):
        leaf = jl.LeafOptics(values[0], 0.3)
        return slab(values[1], leaf, values[2])

    options = {"sun": (40.0, 0.0), "view": (20.0, 100.0), "wavelengths": 865.0}
    values = jnp.array([0.4, 1.0, 0.2])
    plan = jl.plan_reflectance(scene_of(values), n_photons=2048, max_orders=2, **options)

    # Values and slopes from one program, as compilation takes nearly all of the time.
    @jax.jit
    @jax.value_and_grad
    def factor(values):
        return jl.reflectance_factor(scene_of(values), plan=plan, key=KEY, **options).reflectance[0]

    slopes = factor(values)[1]
    # Central differences with the same random numbers; those of the optical depth have noise of their own.
    for i, (step, tolerance) in enumerate([(0.02, 2e-3), (0.05, 0.1), (0.02, 2e-3)]):
        change = step * jnp.eye(3)[i]
        difference = (factor(values + change)[0] - factor(values - change)[0]) / (2 * step)
        assert float(slopes[i]) == pytest.approx(float(difference), rel=tolerance, abs=2e-3)


def factor_of_ridges(heights, half_width, sun, view):
    """Return the reflectance factor of ridges along y, of nodes 1 m apart, in view over |x| < half_width.

    Sun and sensor stand in the vertical plane across the ridges, and no slope hides another one. A node is
    seen through the point of the reference plane that lies beside it by its height times the tangent of the
    view's zenith angle. Slopes return the cosine of incidence over that of the sun's zenith angle.
    """
    nodes = np.arange(len(heights)) - 0.5 * (len(heights) - 1)
    edges = np.clip(nodes - np.tan(np.deg2rad(view)) * heights, -half_width, half_width)
    slopes, tangent = np.diff(heights), np.tan(np.deg2rad(sun))
    returned = (1.0 - slopes * tangent) / np.sqrt(1.0 + slopes**2)
    return np.sum(np.diff(edges) * returned) / (2.0 * half_width)


@pytest.mark.slow
def test_derivatives_by_the_relief_of_terrain_are_those_of_the_closed_form(monkeypatch):
    """Off nadir, light lands on other slopes as the relief grows. Planted: rays that keep their places."""
    relief = np.cumsum(np.random.default_rng(1).uniform(-0.25, 0.25, 25))
    relief -= relief.mean()
    options = {"sun": (40.0, 90.0), "view": (25.0, 90.0), "wavelengths": 865.0, "area": ((-8, -8), (8, 8))}

    def scene_of(scale):
        heights = jnp.broadcast_to(scale * jnp.asarray(relief)[:, None], (25, 25))
        return jl.Scene(ground=jl.Terrain(heights, spacing=1.0, origin=(-12.0, -12.0), reflectance=1.0))

    plan = jl.plan_reflectance(scene_of(1.1), n_photons=1 << 15, max_orders=1, **options)

    def estimate():
        def factor(scale, key):
            return jl.reflectance_factor(scene_of(scale), plan=plan, key=key, **options).reflectance[0]

        program = jax.jit(lambda key: jax.jvp(lambda scale: factor(scale, key), (1.0,), (1.0,)))
        values = np.array([program(key) for key in jax.random.split(jax.random.key(3), 24)])
        return values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(len(values))

    step, angles = 1e-5, (8.0, 40.0, 25.0)
    high, low = (factor_of_ridges((1.0 + s) * relief, *angles) for s in (step, -step))
    expected = np.array([factor_of_ridges(relief, *angles), (high - low) / (2.0 * step)])
    mean, stderr = estimate()
    assert agrees(mean, stderr, expected, sigmas=4.0)
    assert stderr[1] < 0.01 * abs(expected[1])

    monkeypatch.setattr(higher_orders, "rays_with_grids", lambda scene, x: (x, jnp.ones_like(x[0])))
    fixed, _ = estimate()
    assert agrees(fixed[0], stderr[0], expected[0], sigmas=4.0)
    assert not agrees(fixed[1], stderr[1], expected[1], sigmas=10.0)


def test_inadmissible_arguments_are_refused():
    scene = jl.Scene(ground=jl.Ground(reflectance=0.3))
    options = {"sun": (30.0, 0.0), "view": (0.0, 0.0), "wavelengths": 865.0, "key": KEY}
    for name, value, message in (
        ("sun", (88.0, 0.0), "zenith of sun"),
        ("view", (-1.0, 0.0), "zenith of view"),
        ("view", (3.0,), "not a pair"),
        ("wavelengths", [900.0, 800.0], "increasing"),
        ("area", [[0.0, 0.0], [0.0, 1.0]], "x0 < x1"),
        ("n_photons", 3, "n_photons"),
    ):
        with pytest.raises(ValueError, match=message):
            jl.reflectance_factor(scene, **{**options, name: value})
    mirror = eqx.tree_at(lambda s: s.ground, scene, jl.Ground(law=jl.Specular(roughness=0.0)))
    with pytest.raises(ValueError, match="mirror"):
        jl.reflectance_factor(mirror, **options)


@pytest.mark.parametrize("field", ["n_photons", "max_orders"])
def test_a_plan_together_with_what_it_holds_is_refused(field):
    options = {"sun": (30.0, 0.0), "view": (0.0, 0.0), "wavelengths": 865.0, "area": [(0, 0), (1, 1)]}
    scene = jl.Scene(ground=jl.Ground(reflectance=0.3))
    plan = jl.plan_reflectance(scene, n_photons=64, **options)
    with pytest.raises(ValueError, match=f"plan is given together with {field}; admissible is either"):
        jl.reflectance_factor(scene, plan=plan, key=KEY, **options, **{field: 64})


def test_a_plan_for_beams_nearer_to_the_zenith_is_refused():
    """Within a transformation the factor is NaN."""
    scene, options = slab(1.0, jl.LeafOptics(0.45, 0.4), 0.2), {"wavelengths": 1064.0}
    sun = (30.0, 100.0)
    plan = jl.plan_reflectance(scene, sun=sun, view=(20.0, 50.0), n_photons=64, max_orders=1, **options)
    with pytest.raises(ValueError, match="the plan does not fit"):
        jl.reflectance_factor(scene, sun=sun, view=(40.0, 50.0), plan=plan, key=KEY, **options)


PLACE, TURNED, BESIDE = (30.0, 100.0), (30.0, 460.0), (31.0, 100.0)


def factor_of_angles():
    """Return the reflectance factor of a slab as a function of sun and view, by one plan."""
    scene, options = slab(1.0, jl.LeafOptics(0.45, 0.4), 0.2), {"wavelengths": 1064.0}
    plan = jl.plan_reflectance(scene, sun=PLACE, view=PLACE, n_photons=512, max_orders=2, **options)

    def factor(sun, view):
        return jl.reflectance_factor(scene, sun=sun, view=view, plan=plan, key=KEY, **options).reflectance[0]

    return factor


@pytest.mark.parametrize(("sun", "is_same"), [(PLACE, True), (TURNED, True), (BESIDE, False)])
def test_one_direction_is_known_by_value(sun, is_same):
    assert _is_same_direction(sun, PLACE) is is_same
    assert bool(jax.jit(_is_same_direction)(sun, PLACE)) == is_same
    assert bool(jax.jit(lambda azimuth: _is_same_direction((0.0, azimuth), (0.0, 10.0)))(50.0))


@pytest.mark.slow
def test_the_hot_spot_does_not_depend_on_tracing():
    """Sun and sensor in one direction, whether JAX knows it or not; and beside it."""
    factor = factor_of_angles()
    traced_sun = jax.jit(lambda sun: factor(sun, PLACE))
    eager = float(factor(PLACE, PLACE))
    for sun in (PLACE, TURNED):
        assert float(traced_sun(sun)) == pytest.approx(eager, rel=1e-5)
    assert float(traced_sun(BESIDE)) < 0.85 * eager


@pytest.mark.slow
def test_the_hot_spot_of_any_angles():
    factor = factor_of_angles()
    eager, beside = float(factor(PLACE, PLACE)), float(factor(BESIDE, PLACE))
    assert float(jax.jit(factor)(PLACE, PLACE)) == pytest.approx(eager, rel=1e-5)
    assert float(jax.jit(factor)(BESIDE, PLACE)) == pytest.approx(beside, rel=1e-5)
    by_vmap = jax.vmap(lambda zenith: factor((zenith, 100.0), PLACE))(jnp.array([30.0, 31.0]))
    np.testing.assert_allclose(by_vmap, [eager, beside], rtol=1e-5)


@pytest.mark.slow
def test_a_periodic_slab_is_the_same_in_a_wide_area():
    """Rays start some 5 km before they meet it, at the zenith angle 80 degrees."""
    options = {"sun": (30.0, 0.0), "view": (80.0, 90.0), "wavelengths": 865.0, "n_photons": 8192}
    scene = slab(1.0, jl.LeafOptics(0.4, 0.4), 0.2, shape=(40, 40, 1))
    narrow, wide = (
        jl.reflectance_factor(scene, key=KEY, area=((-half, -half), (half, half)), **options)
        for half in (10.0, 200.0)
    )
    error = np.hypot(narrow.stderr[0], wide.stderr[0])
    assert abs(wide.reflectance[0] - narrow.reflectance[0]) < 4 * error


@pytest.mark.slow
def test_light_among_leaves_of_two_kinds_is_followed_to_the_stated_accuracy():
    """Histories of five channels have room for 12 orders; leaves of an albedo of 0.9 call for 30."""
    voxels = jl.VoxelMap.from_lad(np.full((2, 2, 2), 1.5), voxel_size=1.0)
    leaves = [
        jl.leaf_mesh(voxels, 0.02, key=jax.random.key(seed), leaf=jl.LeafOptics(0.49, 0.41))
        for seed in range(2)
    ]
    ground = jl.Terrain(np.zeros((2, 2)), 1.5, origin=(-0.5, -0.5), reflectance=0.2, sides="periodic")
    options = {"sun": (30.0, 0.0), "view": (10.0, 90.0), "wavelengths": 865.0, "n_photons": 4096}
    factor = jl.reflectance_factor(jl.Scene(meshes=leaves, ground=ground), key=KEY, **options)
    assert factor.unfollowed[0] < 1e-3
