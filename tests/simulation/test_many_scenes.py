"""Many scenes at once: against simulations of each, in chunks, with derivatives; plans of their families."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.planning.plan_check import check_plan
from tests.helpers import slow_unless

KEY = jax.random.key(3)
LIDAR = jl.Lidar(altitude=4e5, divergence=0.0625, aperture=0.8, pulse=jl.GaussianPulse(15.6))
N_SCENES = 7


def stand(density, base, height, reflectance):
    """Return a stand of four layers of one leaf area density, m2/m3, over ground."""
    voxels = jl.VoxelMap.from_lad(
        density * jnp.ones((1, 1, 4)), voxel_size=(60.0, 60.0, 3.0), origin=jnp.stack([-30.0, -30.0, base])
    )
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4), sides="periodic")
    return jl.Scene(canopy=canopy, ground=jl.Ground(height=height, reflectance=reflectance))


def random_stands(number=N_SCENES, seed=0):
    random = np.random.default_rng(seed)
    bounds = ((0.02, 0.3), (1.0, 8.0), (-3.0, 0.5), (0.1, 0.4))
    return jax.vmap(stand)(*(jnp.asarray(random.uniform(*b, number), float) for b in bounds))


def scene_number(scenes, i):
    return jax.tree.map(lambda a: a[i], scenes)


@pytest.fixture(scope="module")
def plan_of_two_orders():
    return jl.plan_scenes(LIDAR, random_stands(), max_orders=2, n_photons=512, n_rays=8)


@pytest.fixture(scope="module")
def waves(plan_of_two_orders):
    return jl.simulate_scenes(LIDAR, random_stands(), plan=plan_of_two_orders, key=KEY, chunk=3)


@pytest.mark.slow
def test_each_waveform_is_that_of_its_scene_alone(waves, plan_of_two_orders):
    simulate = eqx.filter_jit(lambda scene, key: jl.simulate(LIDAR, scene, plan=plan_of_two_orders, key=key))
    scenes = random_stands()
    assert len(waves) == N_SCENES
    for i in (0, 4, 6):
        alone = simulate(scene_number(scenes, i), jax.random.fold_in(KEY, i))
        np.testing.assert_allclose(waves[i].reflectance, alone.reflectance, rtol=1e-4, atol=1e-9)
        np.testing.assert_allclose(waves[i].stderr, alone.stderr, rtol=1e-2, atol=1e-9)
        assert np.all(alone.stderr[alone.reflectance > 1e-3] > 0)
    # The numbers of the scenes choose their random numbers: those of another scene differ.
    other = simulate(scene_number(scenes, 4), jax.random.fold_in(KEY, 5))
    assert np.max(np.abs(waves[4].reflectance - other.reflectance)) > 1e-5


@pytest.mark.slow
def test_standard_errors_are_those_of_each_scene(waves, plan_of_two_orders):
    repeated = jl.simulate_scenes(
        LIDAR, random_stands(), plan=plan_of_two_orders, key=jax.random.key(4), chunk=3
    )
    bright = np.asarray(waves.reflectance) > 0.02 * np.max(waves.reflectance)
    z = (repeated.reflectance - waves.reflectance) / np.hypot(repeated.stderr, waves.stderr)
    assert 0.5 < np.sqrt(np.mean(np.square(np.asarray(z)[bright]))) < 1.3


@pytest.mark.parametrize("orders", slow_unless([1], [1, 2]))
def test_chunks_and_other_scenes_change_nothing(orders):
    plan = jl.plan_scenes(LIDAR, random_stands(), max_orders=orders, n_photons=512, n_rays=8)
    fewer = jax.tree.map(lambda a: a[:5], random_stands())
    waves, repeated = (
        jl.simulate_scenes(LIDAR, scenes, plan=plan, key=KEY, chunk=3) for scenes in (random_stands(), fewer)
    )
    np.testing.assert_allclose(repeated.reflectance, waves.reflectance[:5], rtol=1e-4, atol=1e-9)
    # The same test rejects the neighbours' waveforms.
    assert not np.allclose(repeated.reflectance, waves.reflectance[1:6], rtol=1e-4, atol=1e-9)


def test_the_plan_of_a_stack_serves_all_of_its_scenes():
    scenes = random_stands(40)
    plan = jl.plan_scenes(LIDAR, scenes, n_rays=8)
    for i in range(40):
        check_plan(plan, LIDAR, scene_number(scenes, i))
    # So do the bounds of the family, without any of its scenes.
    corners = [stand(d, b, h, 0.4) for d in (0.02, 0.3) for b in (1.0, 8.0) for h in (-3.0, 0.5)]
    by_bounds = jl.plan_scenes(LIDAR, corners, n_rays=8)
    for i in range(40):
        check_plan(by_bounds, LIDAR, scene_number(scenes, i))
    # The plan of the lowest scene alone does not serve the highest.
    by_one = jl.plan(LIDAR, corners[0], n_rays=8)
    with pytest.raises(ValueError, match="the plan does not fit"):
        check_plan(by_one, LIDAR, corners[-1])


@pytest.mark.slow
def test_layers_of_the_tallest_scene_count_for_the_segments_of_a_ray():
    def layers(thickness):
        voxels = jl.VoxelMap.from_extinction(
            leaf=0.5 / thickness * jnp.ones((1, 1, 12)),
            voxel_size=jnp.stack([60.0, 60.0, thickness]),
            origin=(-30.0, -30.0, 0.0),
        )
        canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4), sides="periodic")
        return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.2, slope=20.0))

    lidar = jl.Lidar(divergence=5.0, pulse=jl.GaussianPulse(fwhm=4.0))
    scenes = jax.vmap(layers)(jnp.array([0.2, 1.5]))
    options = {"max_orders": 1, "n_rays": 16, "bin_width": 0.5, "window": (-150.0, 60.0)}
    waves = jl.simulate_scenes(lidar, scenes, plan=jl.plan_scenes(lidar, scenes, **options), key=KEY)
    for i in range(2):
        scene = scene_number(scenes, i)
        alone = jl.simulate(
            lidar, scene, plan=jl.plan(lidar, scene, **options), key=jax.random.fold_in(KEY, i)
        )
        np.testing.assert_allclose(
            waves[i].reflectance, alone.reflectance, atol=1e-3 * float(alone.reflectance.max())
        )


@pytest.mark.slow
def test_effects_that_are_absent_from_one_scene_are_planned():
    empty, leafy = (stand(density, 2.0, 0.0, 0.3) for density in (0.0, 0.2))
    plan = jl.plan_scenes(LIDAR, [empty, leafy], max_orders=1, n_rays=8)
    scenes = jax.tree.map(lambda *a: jnp.stack(a), empty, leafy)
    waves = jl.simulate_scenes(LIDAR, scenes, plan=plan, key=KEY)
    leaf = np.asarray(waves.components["leaf"]).sum(axis=(1, 2))
    assert leaf[0] == 0
    assert leaf[1] > 0.05


@pytest.mark.slow
def test_terrain_that_is_flat_in_one_scene_is_planned_with_relief():
    def hills(height):
        heights = height * jnp.sin(jnp.arange(9.0))[:, None] * jnp.ones((9, 9))
        return jl.Scene(ground=jl.Terrain(heights, spacing=20.0, origin=(-80.0, -80.0), reflectance=0.3))

    flat, hilly = hills(0.0), hills(3.0)
    plan = jl.plan_scenes(LIDAR, [flat, hilly], max_orders=1, n_rays=64)
    waves = jl.simulate_scenes(LIDAR, jax.tree.map(lambda *a: jnp.stack(a), flat, hilly), plan=plan, key=KEY)
    assert np.max(np.abs(waves.reflectance[1] - waves.reflectance[0])) > 0.1 * np.max(waves.reflectance)
    # Beside terrain whose heights never change, a plane remains a plane.
    assert jl.plan_scenes(LIDAR, [flat, flat], max_orders=1, n_rays=64).scope.flat_terrain


def test_the_result_is_differentiated():
    def ground(height):
        return jl.Scene(ground=jl.Ground(height=height, reflectance=0.3))

    heights = jnp.array([-1.0, 0.0, 2.0])
    plan = jl.plan_scenes(jl.Lidar(), jax.vmap(ground)(heights))

    def mean_times(heights):
        waves = jl.simulate_scenes(jl.Lidar(), jax.vmap(ground)(heights), plan=plan, key=KEY)
        return waves.reflectance[:, 0] @ waves.time / jnp.sum(waves.reflectance, axis=(1, 2))

    slopes = jax.jit(jax.jacfwd(mean_times))(heights)
    np.testing.assert_allclose(slopes, -2 / jl.SPEED_OF_LIGHT * np.eye(3), rtol=1e-3, atol=1e-5)
    with pytest.raises(ValueError, match="plan_scenes"):
        jax.jit(lambda h: jl.simulate_scenes(jl.Lidar(), jax.vmap(ground)(h), key=KEY).reflectance)(heights)


def test_waveforms_of_scenes_have_one_more_axis_in_memory_and_in_files(tmp_path):
    def ground(height, reflectance):
        return jl.Scene(ground=jl.Ground(height=height, reflectance=reflectance))

    heights, reflectances = jnp.array([-1.0, 0.0, 2.0]), jnp.array([0.1, 0.2, 0.4])
    scenes = jax.vmap(ground)(heights, reflectances)
    waves = jl.simulate_scenes(LIDAR, scenes, key=KEY, chunk=2)
    assert (len(waves), waves.time.ndim, waves.height.ndim) == (3, 1, 1)
    np.testing.assert_allclose([float(wave.reflectance.sum()) for wave in waves], reflectances, rtol=1e-3)
    for wave, height in zip(waves, heights, strict=True):
        assert wave.time.shape == wave.reflectance[0].shape == wave.components["ground"][0].shape
        mean = jnp.sum(wave.reflectance[0] * wave.height) / jnp.sum(wave.reflectance)
        assert float(mean) == pytest.approx(float(height), abs=0.01)
    np.testing.assert_array_equal(waves[-1].energy, waves.energy[2])
    assert waves.first_order_share.shape == (3, 1)
    with pytest.raises(IndexError, match="scene 3: there are 3"):
        waves[3]
    # The same within a transformation.
    plan = jl.plan_scenes(LIDAR, scenes)
    last = jax.jit(lambda s: jl.simulate_scenes(LIDAR, s, plan=plan, key=KEY)[2].reflectance)(scenes)
    np.testing.assert_allclose(last, waves[2].reflectance, rtol=1e-4, atol=1e-9)
    for name in ("waves.nc", "waves.zarr"):
        waves.save(tmp_path / name)
        stored = jl.open(tmp_path / name)
        assert jax.tree.structure(stored) == jax.tree.structure(waves)
        jax.tree.map(np.testing.assert_array_equal, stored, waves)
    single = waves[0]
    for refused in (len, iter, lambda wave: wave[0]):
        with pytest.raises(TypeError, match="no axis of scenes"):
            refused(single)
    with pytest.raises(ValueError, match="has 3 scenes"):
        waves.returns(LIDAR)
    with pytest.raises(ValueError, match="a case has one scene"):
        waves.save(tmp_path / "case.nc", jl.io.Case(LIDAR, jl.Scene(ground=jl.Ground()), KEY))


@pytest.mark.parametrize(
    ("scenes", "message"),
    [
        (jl.Scene(ground=jl.Ground()), "no leading axis"),
        (eqx.tree_at(lambda s: s.ground.height, random_stands(), jnp.zeros(3)), "a leading axis of 3"),
    ],
)
def test_arrays_that_are_no_stack_are_refused(scenes, message):
    with pytest.raises(ValueError, match=message):
        jl.simulate_scenes(LIDAR, scenes, key=KEY)


def test_families_of_other_kinds_are_refused():
    with pytest.raises(TypeError, match="scenes"):
        jl.plan_scenes(LIDAR, 3)
    with pytest.raises(ValueError, match="scenes is empty"):
        jl.plan_scenes(LIDAR, [])
    with pytest.raises(ValueError, match="structure"):
        jl.plan_scenes(LIDAR, [jl.Scene(ground=jl.Ground()), stand(0.1, 1.0, 0.0, 0.3)])
