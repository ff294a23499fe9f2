r"""Terrain against closed forms and bisection, its derivatives, and inadmissible arguments.

Closed forms, for Lambertian facets of slope s and reflectance rho, seen from straight above:

- roof: two facets that fall from a ridge on the beam's axis return rho cos(s) together. Positions across the
  ridge are normal with the standard deviation sigma of the footprint, and heights are -tan(s) |x|. Their mean
  is sigma sqrt(2 / pi) tan(s) below the ridge, their variance sigma^2 (1 - 2 / pi) tan^2(s).
- valley: the view factor from one facet to the other is F = (1 + cos(psi)) / 2, psi being the angle between
  the two, at any distance from the line where they meet. All orders together return
  rho cos(s) / (1 - rho F), and (1 - rho) / (1 - rho F) is absorbed.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.extend import vec
from jaxlidar.scenes.height_field import HeightField
from tests.helpers import SINGLE_SAMPLE, agrees, batch_mean, single_sample_lidar, slow_unless

KEY = jax.random.key(3)
X, Y = np.meshgrid(np.arange(21.0), np.arange(17.0), indexing="ij")
HILLS = 2.0 * np.sin(X / 2.5) * np.cos(Y / 2.0)


# Compiled as one program: dispatched one by one, its operations would each be compiled.
distances = eqx.filter_jit(lambda shape, start, direction: shape.distance(start, direction))


def hills(**changes):
    return jl.Terrain(**({"heights": HILLS, "spacing": 1.0, "origin": (-10.0, -8.0)} | changes))


def height_of(heights, position):
    """Interpolate heights bilinearly in double precision; the spacing is 1 m, node 0 at the origin."""
    x, y = np.moveaxis(position, -1, 0)
    i, j = (np.clip(np.floor(p), 0, n - 2).astype(int) for p, n in zip((x, y), heights.shape))
    x, y = x - i, y - j
    rows = [(1 - y) * heights[i + k, j] + y * heights[i + k, j + 1] for k in range(2)]
    return (1 - x) * rows[0] + x * rows[1]


def first_hit(heights, start, direction, max_distance=40.0, steps=8000):
    """Find the distance at which rays first fall through the surface, by small steps and bisection."""
    s = np.linspace(0.0, max_distance, steps)
    size = np.array(heights.shape) - 1

    def clearance(s):
        point = start[:, None, :] + s[..., None] * direction[:, None, :]
        inside = np.all((point[..., :2] >= 0) & (point[..., :2] <= size), axis=-1)
        return np.where(inside, point[..., 2] - height_of(heights, point[..., :2]), np.nan)

    f = clearance(np.broadcast_to(s, (len(start), steps)))
    falls = (f[:, :-1] >= 0) & (f[:, 1:] < 0)
    first, hit = np.argmax(falls, axis=1), np.any(falls, axis=1)
    low, high = s[first], s[first + 1]
    for _ in range(50):
        middle = 0.5 * (low + high)
        is_above = clearance(middle[:, None])[:, 0] >= 0
        low, high = np.where(is_above, middle, low), np.where(is_above, high, middle)
    return np.where(hit, low, 1e30)


@pytest.mark.parametrize("from_surface", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_rays_meet_the_surface_where_bisection_does(from_surface):
    random = np.random.default_rng(1)
    start = np.c_[random.uniform(1, 19, 300), random.uniform(1, 15, 300), np.full(300, 3.0)]
    direction = random.normal(size=(300, 3)) * (1.0, 1.0, 0.3)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    direction[:, 2] = np.abs(direction[:, 2]) * (1 if from_surface else -1)
    shape = hills(origin=(0.0, 0.0)).shape
    if from_surface:
        start[:, 2] = height_of(HILLS, start[:, :2])
        normal, _ = shape.tangent(vec(jnp.asarray(start.T, float)))
        rises = np.einsum("kn,nk->n", np.asarray(normal), direction) > 1e-2
        start, direction = start[rises], direction[rises]
    rays = (vec(jnp.asarray(a.T, float)) for a in (start, direction))
    distance = np.asarray(distances(shape, *rays), float)
    # Bisection must not take the start itself for an intersection.
    just_above = np.array([0.0, 0.0, 1e-9 * from_surface])
    expected = first_hit(HILLS, start + just_above, direction)
    np.testing.assert_array_equal(distance < 1e29, expected < 1e29)
    hit = expected < 1e29
    assert hit.sum() > 30
    # The error in height is bounded for all rays; the distance along a grazing ray has a far larger one.
    points = (start + distance[:, None] * direction)[hit]
    assert np.abs(height_of(HILLS, points[:, :2]) - points[:, 2]).max() < 1e-5
    assert np.median(np.abs(distance - expected)[hit]) < 1e-5


def test_distances_do_not_depend_on_the_number_of_rays():
    # With many rays, the last active ones are gathered and traced alone.
    random = np.random.default_rng(3)
    start = np.c_[random.uniform(1, 19, 600), random.uniform(1, 15, 600), random.uniform(-1, 4, 600)]
    direction = random.normal(size=(600, 3)) * (1.0, 1.0, 0.1)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    shape = hills(origin=(0.0, 0.0)).shape

    def distance(start, direction):
        return np.asarray(distances(shape, *(vec(jnp.asarray(a.T, float)) for a in (start, direction))))

    by_fifty = [distance(start[n : n + 50], direction[n : n + 50]) for n in range(0, 600, 50)]
    assert 100 < np.sum(np.concatenate(by_fifty) < 1e29) < 550
    np.testing.assert_array_equal(distance(start, direction), np.concatenate(by_fifty))


def test_rays_from_below_and_outside_the_nodes_do_not_hit():
    shape = hills().shape
    assert isinstance(shape, HeightField)
    start = vec(jnp.asarray([[0.0, 0.0, -5.0], [10.5, 0.0, 9.0]]).T)
    direction = vec(jnp.asarray([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]).T)
    assert np.all(np.asarray(shape.distance(start, direction)) == np.float32(1e30))


# -- planes, roofs and valleys -----------------------------------------------------------------------------


SLOPE = np.tan(np.deg2rad(15.0))
# At this altitude all rays are parallel to the accuracy of the tests.
WIDE = jl.Lidar(altitude=1e5, divergence=0.02, pulse=jl.GaussianPulse(fwhm=4.0))


@pytest.mark.parametrize("heights", [np.zeros_like(HILLS), np.maximum(HILLS, 0.0)], ids=["plain", "lake"])
@pytest.mark.parametrize("depth", [30.0, 300.0, 3000.0])
def test_level_terrain_far_below_a_sensor_is_met(heights, depth):
    """Also where it is the lowest; planted: a tolerance of the start's rounding, not of the terrain's."""
    random, below = np.random.default_rng(5), depth + 1.0 / 3.0
    start = np.column_stack([random.uniform(2.0, 14.0, (500, 2)), np.zeros(500)])
    tilt = random.uniform(-1.0, 1.0, (500, 2)) / below
    direction = np.column_stack([tilt, -np.sqrt(1.0 - np.sum(tilt**2, axis=1))])
    shape = hills(heights=heights - below, origin=(0.0, 0.0)).shape
    distance = np.asarray(distances(shape, *(vec(jnp.asarray(a.T)) for a in (start, direction))))
    point = start + distance[:, None] * direction
    np.testing.assert_allclose(point[:, 2], height_of(heights, point[:, :2]) - below, atol=1e-6 * below)


def test_terrain_in_a_plane_is_traced_as_a_plane():
    flat = jl.Terrain(SLOPE * X + 3.0, 1.0, (-10.0, -8.0), 0.4)
    ground = jl.Ground(SLOPE * 10.0 + 3.0, 0.4, slope=15.0, aspect=270.0)
    plans = [jl.plan(WIDE, jl.Scene(ground=g)) for g in (flat, ground)]
    rows = [{e.name: e for e in plan.effects} for plan in plans]
    assert rows[0]["relief"].reason == "the terrain is a plane"
    assert not rows[0]["relief"].simulated
    assert rows[0]["slope spread"].bound == pytest.approx(rows[1]["slope spread"].bound, rel=1e-4)
    waves = [jl.simulate(WIDE, jl.Scene(ground=g), key=KEY) for g in (flat, ground)]
    peak = float(waves[1].reflectance.max())
    np.testing.assert_allclose(waves[0].reflectance, waves[1].reflectance, atol=1e-4 * peak)


@pytest.mark.slow
def test_a_plane_traced_as_heights():
    """Every ray meets the same slope, and the mean height is that on the axis."""
    flat = jl.Scene(ground=jl.Terrain(SLOPE * X, 1.0, (-10.0, -8.0), 0.4))
    plan = jl.plan(WIDE, flat, effects={"relief": True}, max_orders=1)
    assert not plan.config.uses_quadrature
    mean, stderr = batch_mean(WIDE, flat, plan, seed=1, count=8, quantity=moments)
    assert mean[0] == pytest.approx(0.4 * np.cos(np.deg2rad(15.0)), rel=1e-4)
    spread = 2.0 * 0.5 * SLOPE / jl.SPEED_OF_LIGHT
    assert agrees(mean[1], stderr[1] + 3e-4, -2.0 * 10.0 * SLOPE / jl.SPEED_OF_LIGHT)
    sigma2 = pulse_variance(WIDE)
    assert agrees(mean[2], stderr[2] + 3e-4, sigma2 + spread**2)
    assert not agrees(mean[2], stderr[2] + 3e-4, sigma2 + 1.05 * spread**2)


def pulse_variance(lidar):
    return (float(lidar.pulse.fwhm) / np.sqrt(8.0 * np.log(2.0))) ** 2 + 1.0 / 12.0


def moments(wave):
    total = jnp.sum(wave.reflectance[0])
    middle = jnp.sum(wave.reflectance[0] * wave.time) / total
    return total, middle, jnp.sum(wave.reflectance[0] * (wave.time - middle) ** 2) / total


@pytest.mark.slow
def test_a_roof():
    roof = jl.Scene(
        ground=jl.Terrain([[-20 * SLOPE] * 2, [0.0] * 2, [-20 * SLOPE] * 2], 20.0, (-20, -10), 0.4)
    )
    plan = jl.plan(WIDE, roof, max_orders=1)
    mean, stderr = batch_mean(WIDE, roof, plan, seed=2, count=16, quantity=moments)
    per_metre = 2.0 * SLOPE * 0.5 / jl.SPEED_OF_LIGHT
    assert mean[0] == pytest.approx(0.4 * np.cos(np.deg2rad(15.0)), rel=1e-4)
    assert agrees(mean[1], stderr[1] + 1e-4, per_metre * np.sqrt(2 / np.pi))
    assert not agrees(mean[1], stderr[1] + 1e-4, per_metre * np.sqrt(2 / np.pi) * 1.01)
    assert agrees(mean[2], stderr[2] + 3e-4, pulse_variance(WIDE) + per_metre**2 * (1 - 2 / np.pi))


def energies(wave):
    return wave.reflectance.sum(), wave.energy_budget["absorbed by ground"][0]


@pytest.mark.slow
def test_facets_of_a_valley_light_each_other():
    """Slopes of 45 degrees, so F = 1/2. The valley is 10^7 times as wide as the beam is off its axis.

    That needs double precision. A fraction of 1e-7 of the light leaves the valley at its ends; 12 orders
    truncate 0.4^12 = 2e-5.
    """
    with jax.enable_x64(True):
        side = 1000.0
        valley = jl.Terrain([[side] * 2, [0.0] * 2, [side] * 2], (side, 2 * side), (-side, -side), 0.8)
        with pytest.warns(jl.UnitWarning):
            lidar = single_sample_lidar(position=(1e-4, 0.0), divergence=5e-9, sampling_interval=2e4)
        scene = jl.Scene(ground=valley)
        plan = jl.plan(lidar, scene, max_orders=12, window=(8000.0, 8001.0), bin_width=20.0)
        (total, absorbed), (e1, e2) = batch_mean(lidar, scene, plan, seed=0, count=16, quantity=energies)
    expected = 0.8 * np.cos(np.pi / 4) / (1 - 0.8 * 0.5), 0.2 / (1 - 0.8 * 0.5)
    assert agrees(total, e1 + 1e-5, expected[0])
    assert agrees(absorbed, e2 + 1e-5, expected[1])
    assert not agrees(total, e1 + 1e-5, 1.005 * expected[0])


@pytest.mark.slow
def test_no_light_leaks_through_white_terrain():
    scene = jl.Scene(ground=hills(reflectance=1.0, sides="periodic"))
    budget = jl.energy_budget(jl.Lidar(divergence=5.0, zenith=30.0), scene, key=KEY, rtol=0.01)
    assert float(budget.below[0]) == pytest.approx(0.0, abs=1e-4)
    assert float(budget.returned[0]) == pytest.approx(1.0, abs=1e-3)
    # Slopes of up to 40 degrees light one another.
    assert float(budget.transmitted[0]) > 1.05


# -- reflectance by position -------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_raster_of_reflectance():
    """On a plane with rho = a + b x, the footprint returns the reflectance at its centre."""
    lidar, level = single_sample_lidar(divergence=0.005), np.zeros_like(HILLS)
    ramp = jl.Scene(ground=hills(heights=level, reflectance=0.3 + 0.02 * (X - 10.0)))
    off_centre = dataclasses.replace(lidar, position=(2.5, 0.0))
    plan = jl.plan(off_centre, ramp, **SINGLE_SAMPLE)
    assert plan.orders == 1
    assert not plan.config.uses_quadrature
    wave = jl.simulate(off_centre, ramp, key=KEY, plan=plan)
    assert float(wave.reflectance.sum()) == pytest.approx(0.35, rel=1e-3)
    assert float(wave.energy_budget["absorbed by ground"][0]) == pytest.approx(0.65, rel=1e-3)


@pytest.mark.slow
def test_a_raster_of_equal_numbers_is_one_number():
    lidar = single_sample_lidar(divergence=0.005)
    number, raster = (jl.Scene(ground=hills(reflectance=rho)) for rho in (0.4, np.full_like(HILLS, 0.4)))
    plans = [
        jl.plan(lidar, scene, max_orders=3, n_photons=8192, **SINGLE_SAMPLE) for scene in (number, raster)
    ]
    of_number, of_raster = (
        batch_mean(lidar, scene, plan, seed=0, count=2, quantity=energies)[0]
        for scene, plan in zip((number, raster), plans)
    )
    np.testing.assert_allclose(of_number, of_raster, rtol=1e-5)


@pytest.mark.slow
def test_black_terrain():
    wave = jl.simulate(jl.Lidar(), jl.Scene(ground=hills(reflectance=0.0 * HILLS)), key=KEY, max_orders=1)
    assert float(jnp.abs(wave.reflectance).max()) == 0.0


# -- derivatives -------------------------------------------------------------------------------------------

BOWL = 0.2 * ((X - 10.0) ** 2 + (Y - 8.0) ** 2)
NODE = np.zeros_like(BOWL)
NODE[10, 8] = 1.0


@pytest.mark.parametrize(
    ("zenith", "orders", "photons", "keys", "heights"),
    [
        pytest.param(25.0, 1, 4096, 6, HILLS, marks=pytest.mark.slow),
        pytest.param(0.0, 4, 65536, 60, BOWL, marks=pytest.mark.slow),
    ],
)
def test_derivatives_with_respect_to_heights(zenith, orders, photons, keys, heights):
    """Derivatives in the amplitude of the relief, in one node and in the reflectance of a strip.

    They are compared with central differences over independent keys. In higher orders, derivatives leave out
    that slopes begin or cease to hide one another: in the bowl none does. Its node is raised: about a lowered
    one, cells are saddles that hide their own diagonals.
    """
    lidar = jl.Lidar(divergence=2.0, pulse=jl.GaussianPulse(fwhm=3.0), zenith=zenith, azimuth=40.0)
    start = {"relief": jnp.asarray(1.0), "node": jnp.asarray(0.1), "strip": jnp.asarray(0.3)}
    steps = {"relief": 0.05, "node": 0.05, "strip": 0.1}

    def build(p):
        relief = jnp.asarray(heights) * p["relief"] + jnp.asarray(NODE) * p["node"]
        reflectance = jnp.asarray(0.4 + 0.0 * X) + p["strip"] * jnp.asarray(X > 9.5)
        return jl.Scene(ground=hills(heights=relief, reflectance=reflectance))

    size = {"n_photons": 8 * photons, "n_rays": 2048}
    plan = jl.plan(lidar, build(start), max_orders=orders, window=(-60.0, 60.0), **size)

    def measure(p, key):
        setup = jl.make_setup(lidar, build(p), plan)
        total = jl.total_reflectance(jl.trace_scene(setup, key), setup)[0]
        time = jnp.arange(plan.n_samples) / 50.0
        return jnp.stack([jnp.sum(total), jnp.sum(total * time)])

    value, jacobian = jax.jit(measure), jax.jit(jax.jacfwd(measure))
    exact = [jacobian(start, key) for key in jax.random.split(jax.random.key(1), keys)]
    difference_keys = jax.random.split(jax.random.key(2), keys)
    for name, step in steps.items():
        sides = [
            np.array([value(start | {name: start[name] + s}, key) for key in difference_keys])
            for s in (-step, step)
        ]
        difference = (sides[1] - sides[0]) / (2 * step)
        derivative = np.array([jacobian_of_key[name] for jacobian_of_key in exact])
        stderr = np.sqrt((derivative.var(axis=0, ddof=1) + difference.var(axis=0, ddof=1)) / keys)
        # Truncation error of the central difference, of second order in the step.
        truncation = 0.004 * np.abs(difference.mean(axis=0))
        mean, expected = derivative.mean(axis=0), difference.mean(axis=0)
        assert agrees(mean, stderr + truncation / 3, expected, sigmas=3.5), name
        assert not agrees(1.3 * mean, stderr + truncation / 3, expected, sigmas=3.5)


@pytest.mark.slow
def test_the_gradient_is_that_of_the_jacobian():
    scene = jl.Scene(ground=hills())
    plan = jl.plan(jl.Lidar(divergence=2.0), scene, max_orders=2, n_photons=2048, n_rays=64)

    def brightness(heights):
        setup = jl.make_setup(
            jl.Lidar(divergence=2.0), eqx.tree_at(lambda s: s.ground.heights, scene, heights), plan
        )
        total = jl.total_reflectance(jl.trace_scene(setup, KEY), setup)[0]
        return jnp.sum(total * jnp.arange(total.size))

    tangent = jnp.asarray(np.cos(X * Y))
    _, forward = eqx.filter_jit(lambda h: jax.jvp(brightness, (h,), (tangent,)))(scene.ground.heights)
    reverse = eqx.filter_jit(jax.grad(brightness))(scene.ground.heights)
    assert np.all(np.isfinite(reverse))
    assert float(jnp.sum(reverse * tangent)) == pytest.approx(float(forward), rel=1e-3)


# -- positions ---------------------------------------------------------------------------------------------


def test_coordinates_of_millions_of_metres_change_nothing():
    def setup(east, north):
        terrain = hills(origin=(east - 10.0, north - 8.0), reflectance=0.3 + 0.01 * X)
        lad = np.random.default_rng(0).uniform(0, 1, (4, 3, 5))
        trees = jl.VoxelMap.from_lad(lad, voxel_size=1.5, origin=(east - 3.0, north - 2.0, 1.0)).above(
            terrain
        )
        canopy = jl.Canopy(trees, leaf=jl.LeafOptics(reflectance=0.4, transmittance=0.3), hotspot=False)
        lidar = jl.Lidar(divergence=3.0, position=(east + 0.3, north - 0.2))
        scene = jl.Scene(canopy=canopy, ground=terrain)
        plan = jl.plan(lidar, scene, max_orders=2)
        return jl.make_setup(lidar, scene, plan), plan

    (near_setup, near_plan), (distant_setup, distant_plan) = setup(0.0, 0.0), setup(512_345.0, 5_212_345.0)
    assert near_plan == distant_plan
    for near, distant in zip(*map(jax.tree.leaves, (near_setup, distant_setup))):
        np.testing.assert_allclose(near, distant, rtol=1e-6, atol=1e-6)


def test_a_map_is_lifted_above_the_terrain():
    random = np.random.default_rng(4)
    voxels = jl.VoxelMap.from_extinction(
        leaf=random.uniform(0, 1, (6, 5, 4)),
        bark=random.uniform(0, 1, (6, 5, 4)),
        voxel_size=(2.0, 2.0, 0.5),
        origin=(-6, -5, 0.0),
    )
    lifted = voxels.above(hills())
    for before, after in ((voxels.leaf, lifted.leaf), (voxels.bark, lifted.bark)):
        np.testing.assert_allclose(after.sum(axis=2), before.sum(axis=2), rtol=1e-5)
        z = float(lifted.origin[2]) + 0.5 * (np.arange(after.shape[2]) + 0.5)
        middle = np.sum(np.asarray(after) * z, axis=2) / np.sum(np.asarray(after), axis=2)
        z = 0.5 * (np.arange(4) + 0.5)
        middle_before = np.sum(np.asarray(before) * z, axis=2) / np.sum(before, axis=2)
        x, y = np.meshgrid(-6 + 2 * (np.arange(6) + 0.5), -5 + 2 * (np.arange(5) + 0.5), indexing="ij")
        in_voxel = np.array([-2 / 3, 0.0, 2 / 3])
        points = (x[..., None, None] + in_voxel[:, None] + 10.0, y[..., None, None] + in_voxel + 8.0)
        ground = height_of(HILLS, np.stack(np.broadcast_arrays(*points), axis=-1)).mean(axis=(2, 3))
        np.testing.assert_allclose(middle - middle_before, ground, atol=1e-5)
    level = voxels.above(hills(heights=np.full_like(HILLS, 7.0)))
    assert level.shape == voxels.shape
    assert float(level.origin[2]) == 7.0
    np.testing.assert_allclose(level.leaf, voxels.leaf, rtol=1e-6)


def test_a_ridge_hides_its_far_slope():
    """A sensor in the west, 60 degrees from the zenith, does not see an eastern slope of 45 degrees."""
    ridge = np.maximum(0.0, 6.0 - np.abs(X - 10.0))
    scene = jl.Scene(ground=hills(heights=ridge, reflectance=0.9))
    lidar = single_sample_lidar(zenith=60.0, azimuth=90.0, altitude=1e3, position=(5.0, 0.0), divergence=0.5)
    plan = jl.plan(lidar, scene, max_orders=2, n_photons=16384, n_rays=64, **SINGLE_SAMPLE)
    setup = jl.make_setup(lidar, scene, plan)
    from jaxlidar.trace.device_scene import build_device_scene

    device_scene = build_device_scene(setup)
    shape = device_scene.surfaces[0].shape
    # From the eastern foot and from the western, relative to the aim point.
    x = vec(jnp.asarray([[3.0, 0.0, 1.0], [-4.0, 0.0, 0.0]]).T)
    assert (np.asarray(shape.distance(x, device_scene.beam.view(x))) < 1e29).tolist() == [True, False]


# -- limits of numbers -------------------------------------------------------------------------------------


@pytest.mark.parametrize("azimuth", slow_unless([37.0], [0.0, 37.0]))
def test_every_grazing_ray_meets_terrain_that_repeats(azimuth):
    """A spike of 20 m on nodes of 5 mm: a ray crosses a hundred thousand cells while it falls by 20 m.

    Counted as light that leaves the scene downwards were 9 % that had not met it after 16,384 steps.
    """
    heights = np.zeros((256, 256))
    heights[100, 60] = 20.0
    shape = jl.Terrain(heights, 0.005, (0.0, 0.0), 0.4, sides="periodic").shape
    random, zenith = np.random.default_rng(0), np.deg2rad(88.0)
    start = np.c_[random.uniform(0, 1.28, (64, 2)), np.full(64, 20.1)]
    horizontal = np.sin(zenith) * np.array([np.sin(np.deg2rad(azimuth)), np.cos(np.deg2rad(azimuth))])
    direction = np.broadcast_to(np.r_[horizontal, -np.cos(zenith)], start.shape)
    distance = np.asarray(shape.distance(*(vec(jnp.asarray(a.T, float)) for a in (start, direction))), float)
    assert np.all(distance < 1e29)
    # None goes farther than to the lowest node; and most get past spikes that they do not meet.
    lowest = 20.1 / np.cos(zenith)
    assert np.all(distance < lowest * (1 + 1e-4))
    assert np.median(distance) > 0.5 * lowest


@pytest.mark.parametrize("zenith", [0.0, 30.0])
@pytest.mark.parametrize("height", slow_unless([4e4, -3e5], [-4e4, 4e4, -3e5]))
@pytest.mark.parametrize("kind", ["plane", "terrain", "plate"])
def test_surfaces_far_from_the_reference_plane(kind, height, zenith):
    """They return rho cos(zenith): rays start above them, by more than single precision rounds."""
    lidar = jl.Lidar(altitude=1e5, zenith=zenith, divergence=1e-3, pulse=jl.GaussianPulse(fwhm=4.0))
    if kind == "plate":
        scene = jl.Scene(plates=(jl.Plate(height, 0.3),))
    elif kind == "plane":
        scene = jl.Scene(ground=jl.Ground(height, 0.3))
    else:
        # Without relief it would be the plane. Nodes lie about the axis where it meets the terrain.
        y = -height * np.tan(np.deg2rad(zenith))
        heights = np.full((9, 9), height) + 1e-3 * (np.arange(9) % 2)
        scene = jl.Scene(ground=jl.Terrain(heights, 2e3, (-8e3, y - 8e3), 0.3))
    plan = jl.plan(lidar, scene, max_orders=1)
    wave = jl.simulate(lidar, scene, key=KEY, plan=plan)
    exact = 0.3 * np.cos(np.deg2rad(zenith))
    assert float(wave.reflectance.sum()) == pytest.approx(exact, rel=1e-3)


# -- inadmissible input ------------------------------------------------------------------------------------


CANOPY = jl.Canopy(
    jl.VoxelMap.from_lad(np.ones((3, 3, 3)), voxel_size=1.0),
    leaf=jl.LeafOptics(0.4, 0.3),
    sides="periodic",
    hotspot=False,
)
INADMISSIBLE = {
    "one row": (lambda: hills(heights=np.zeros((1, 5))), r"heights has shape \(1, 5\)"),
    "not finite": (lambda: hills(heights=np.full((2, 2), np.nan)), "heights = nan is outside"),
    "spacing": (lambda: hills(spacing=0.0), "spacing = 0 is outside"),
    "sides": (lambda: hills(sides="closed"), "sides = 'closed' is none of"),
    "raster": (lambda: hills(reflectance=np.zeros((2, 2))), r"reflectance has shape \(2, 2\).*\(21, 17\)"),
    "bright": (lambda: hills(reflectance=2.0 + 0.0 * HILLS), "reflectance = 2 is outside"),
    "mirror": (lambda: hills(law=jl.Specular()), "law is a mirror"),
    "no repetition": (lambda: jl.Scene(CANOPY, ground=hills()), "the terrain 'open'"),
    "another period": (
        lambda: jl.Scene(CANOPY, ground=hills(sides="periodic")),
        "repeats after 3 m and 3 m, the terrain after 21 m and 17 m",
    ),
    "off": (
        lambda: jl.plan(jl.Lidar(position=(9.9, 0.0)), jl.Scene(ground=hills())),
        r"footprint lies off the terrain: .* x = 9.60 to 10.20 m .*the terrain has x = -10.00 to 10.00 m",
    ),
    "a map off": (
        lambda: jl.VoxelMap.from_lad(np.ones((1, 1, 1)), voxel_size=1.0, origin=(10, 0, 0)).above(hills()),
        r"x = 10.1667 is outside the admissible range \[-10, 10\]",
    ),
}


@pytest.mark.parametrize("case", INADMISSIBLE)
def test_inadmissible_terrain_is_refused(case):
    make, message = INADMISSIBLE[case]
    with pytest.raises(ValueError, match=message):
        make()


def test_a_footprint_off_the_terrain_is_refused_with_a_plan_too():
    scene = jl.Scene(ground=hills())
    plan = jl.plan(jl.Lidar(), scene, max_orders=1)
    with pytest.raises(ValueError, match="off the terrain"):
        jl.simulate(jl.Lidar(position=(0.0, 500.0)), scene, key=KEY, plan=plan)


def test_a_plan_for_a_plane_does_not_admit_relief():
    level = jl.Scene(ground=hills(heights=0.0 * HILLS))
    plan = jl.plan(jl.Lidar(), level)
    with pytest.raises(ValueError, match="takes the terrain for a plane"):
        jl.simulate(jl.Lidar(), jl.Scene(ground=hills()), key=KEY, plan=plan)

    def brightness(heights):
        scene = jl.Scene(ground=hills(heights=heights))
        return jl.make_setup(jl.Lidar(), scene, plan).scene.ground.slope

    with pytest.raises(ValueError, match="make the plan with effects="):
        jax.grad(brightness)(level.ground.heights)


def test_relief_can_be_switched_off():
    scene = jl.Scene(ground=hills(heights=HILLS + 0.1 * X))
    wave = jl.simulate(jl.Lidar(), scene, key=KEY, effects={"relief": False})
    fit = np.polynomial.polynomial.polyfit(X.ravel() - 10.0, (HILLS + 0.1 * X).ravel(), 1)
    north = np.polynomial.polynomial.polyfit(Y.ravel() - 8.0, HILLS.ravel(), 1)[1]
    assert float(wave.reflectance.sum()) == pytest.approx(0.3 / np.sqrt(1 + fit[1] ** 2 + north**2), rel=1e-4)
    assert wave.info["stopped"] == "nothing is random"
