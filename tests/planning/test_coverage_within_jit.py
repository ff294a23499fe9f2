"""What a plan does not cover is refused eagerly, and told by `lost` within JAX transformations."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.planning.plan_check import check_plan, is_covered

KEY = jax.random.key(0)
LIDAR = jl.Lidar(divergence=0.3)
OBLIQUE = jl.Lidar(divergence=0.3, zenith=20.0)
SENSOR = jl.Lidar(divergence=0.3, sensor=(0.0, 0.0, 100.0), zenith=10.0)
BARE = jl.Scene(ground=jl.Ground(reflectance=0.3))
PLATES = jl.Scene(plates=(jl.Plate(3.0, 0.3, 0.3),), ground=jl.Ground(reflectance=0.3))


def stand(sides="periodic", leaf=(0.4, 0.3)):
    voxels = jl.VoxelMap.from_extinction(
        leaf=np.full((8, 8, 6), 0.1), voxel_size=1.0, origin=(-4.0, -4.0, 0.0)
    )
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(*leaf), sides=sides, hotspot=False)
    return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3))


def hills(sides="open"):
    heights = 2.0 * np.sin(np.arange(9.0))[:, None] * np.ones((9, 9))
    return jl.Scene(ground=jl.Terrain(heights, spacing=2.5, origin=(-10.0, -10.0), sides=sides))


def boxes():
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    corners = np.array([[-5.0, -5.0, 4.0], [5.0, -5.0, 4.0], [5.0, 5.0, 4.0], [-5.0, 5.0, 4.0]])
    return jl.Scene(meshes=(jl.MeshSurface((corners, faces)),), ground=jl.Ground(reflectance=0.3))


def of_lidar(field):
    return lambda pair: getattr(pair[0], field)


# Lidar and scene of the plan, options of the plan, the value that changes, a value that the plan covers, and
# one that it does not.
CASES = {
    "ground": (LIDAR, BARE, {}, lambda p: p[1].ground.height, 0.0, 0.5),
    "ground, window": (LIDAR, BARE, {"window": (-40, 40)}, lambda p: p[1].ground.height, 0.0, 0.5),
    "ground below": (LIDAR, BARE, {}, lambda p: p[1].ground.height, -0.01, -20.0),
    "plate": (LIDAR, PLATES, {}, lambda p: p[1].plates[0].height, 2.5, 3.2),
    "gaps": (LIDAR, PLATES, {}, lambda p: p[1].plates[0].coverage, 1.0, 0.5),
    "brighter plate": (LIDAR, PLATES, {}, lambda p: p[1].plates[0].reflectance, 0.2, 0.69),
    "plate transmits": (
        LIDAR,
        jl.Scene(plates=(jl.Plate(3.0, 0.3),), ground=BARE.ground),
        {},
        lambda p: p[1].plates[0].transmittance,
        0.0,
        0.2,
    ),
    "canopy height": (LIDAR, stand(), {}, lambda p: p[1].canopy.voxels.voxel_size, [1, 1, 0.9], [1, 1, 1.07]),
    "canopy base": (LIDAR, stand(), {}, lambda p: p[1].canopy.voxels.origin, [-4, -4, 0.2], [-4, -4, 2.0]),
    "narrow voxels": (
        LIDAR,
        stand(),
        {},
        lambda p: p[1].canopy.voxels.voxel_size,
        [1, 1, 1.0],
        [0.05, 0.05, 1.0],
    ),
    "segments": (OBLIQUE, stand("open"), {}, of_lidar("zenith"), 19.0, 75.0),
    "ground under canopy": (LIDAR, stand(), {}, lambda p: p[1].ground.height, 0.0, -80.0),
    "terrain": (
        LIDAR,
        hills(),
        {},
        lambda p: p[1].ground.heights,
        hills().ground.heights,
        np.full((9, 9), 3.0),
    ),
    "off the terrain": (LIDAR, hills(), {}, of_lidar("position"), (0.0, 0.0), (9.9, 0.0)),
    "mesh": (LIDAR, boxes(), {}, lambda p: p[1].meshes[0].instances.shift, [[0, 0, -0.5]], [[0, 0, 2.0]]),
    "nadir": (LIDAR, stand(), {}, of_lidar("zenith"), 0.0, 5.0),
    "pulse feature": (LIDAR, BARE, {}, lambda p: p[0].pulse.fwhm, 6.0, 2.0),
    "pulse length": (LIDAR, BARE, {}, lambda p: p[0].pulse.fwhm, 6.0, 9.0),
    "samples": (LIDAR, BARE, {}, of_lidar("sampling_interval"), 1.0, 0.9),
    "altitude": (LIDAR, PLATES, {}, of_lidar("altitude"), 900.0, 3.0),
    "wide beam": (OBLIQUE, BARE, {}, of_lidar("divergence"), 0.3, 60.0),
    "sensor": (SENSOR, BARE, {}, of_lidar("position"), (0, 0, 100.0), (0, 0, 140.0)),
    "sensor below ground": (SENSOR, BARE, {}, of_lidar("position"), (9, 0, 100.0), (0, 0, -1.0)),
    "sensor over terrain": (SENSOR, hills("periodic"), {}, of_lidar("position"), (0, 0, 100.0), (0, 0, -5.0)),
}


def changed(name, value):
    lidar, scene, _, where, *_ = CASES[name]
    value = jnp.asarray(value, float)
    return eqx.tree_at(where, (lidar, scene), jnp.broadcast_to(value, jnp.shape(where((lidar, scene)))))


def plan_of(name):
    lidar, scene, options, *_ = CASES[name]
    return jl.plan(lidar, scene, describe=False, **options)


@pytest.mark.parametrize("name", list(CASES))
def test_within_jit_a_plan_covers_what_it_is_not_refused_for(name):
    plan, (*_, within, beyond) = plan_of(name), CASES[name]
    check_plan(plan, *changed(name, within))
    with pytest.raises(ValueError, match=r"does not fit|off the terrain|reaches up|below the ground"):
        check_plan(plan, *changed(name, beyond))
    values = jnp.stack([jnp.asarray(v, float) for v in (within, beyond)])
    covered = jax.jit(jax.vmap(lambda value: is_covered(plan, *changed(name, value))))(values)
    assert covered.tolist() == [True, False]


@pytest.mark.parametrize("altitude", [pytest.param(30.0, marks=pytest.mark.slow), 4e5])
@pytest.mark.parametrize("make", [stand, hills, boxes, lambda: PLATES, lambda: stand("open")])
@pytest.mark.parametrize("beam", [pytest.param((0.0, 0.0), marks=pytest.mark.slow), (17.3, 211.0)])
def test_rounding_does_not_uncover_the_scene_of_the_plan(make, altitude, beam):
    zenith, azimuth = beam
    footprint = 0.5
    lidar = jl.Lidar(altitude=altitude, divergence=1e3 * footprint / altitude, zenith=zenith, azimuth=azimuth)
    scene = make()
    plan = jl.plan(lidar, scene, describe=False)
    arrays, static = eqx.partition((lidar, scene), eqx.is_inexact_array)
    assert jax.jit(lambda arrays: is_covered(plan, *eqx.combine(arrays, static)))(arrays)


@pytest.mark.slow
def test_lost_tells_in_a_batch_and_derivatives_stay_finite():
    plan = jl.plan(LIDAR, PLATES, max_orders=2, n_photons=512, describe=False)

    def wave(height):
        scene = eqx.tree_at(lambda s: s.plates[0].height, PLATES, height)
        return jl.simulate(LIDAR, scene, plan=plan, key=KEY)

    heights = jnp.array([3.0, 3.2, 2.5])
    waves = jax.jit(jax.vmap(wave))(heights)
    np.testing.assert_allclose(waves.lost[:, 0], [0.0, 1.0, 0.0], atol=1e-6)
    marked = jax.vmap(lambda w: w.nan_where_lost().reflectance)(waves)
    assert np.isnan(marked).all(axis=(1, 2)).tolist() == [False, True, False]
    slopes = jax.vmap(jax.jacfwd(lambda h: (wave(h).lost, wave(h).reflectance)))(heights)
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(slopes))
    np.testing.assert_array_equal(slopes[0][1], 0.0)


def test_stacks_of_scenes_are_refused_with_their_number():
    scenes = jax.vmap(lambda z: jl.Scene(ground=jl.Ground(height=z)))(jnp.array([0.0, 0.0, 0.5]))
    plan = jl.plan(LIDAR, BARE, window=(-40.0, 40.0), describe=False)
    with pytest.raises(ValueError, match=r"scenes\[2\]: the plan does not fit: its rays start"):
        jl.simulate_scenes(LIDAR, scenes, plan=plan, key=KEY)
    lost = jax.jit(lambda s: jl.simulate_scenes(LIDAR, s, plan=plan, key=KEY).lost)(scenes)
    np.testing.assert_allclose(lost[:, 0], [0.0, 0.0, 1.0], atol=1e-6)


def test_truth_that_a_plan_does_not_cover_is_nan():
    plan = jl.plan(LIDAR, BARE, describe=False)

    def gap(height):
        scene = dataclasses.replace(BARE, ground=jl.Ground(height=height))
        return jl.truth_of(LIDAR, scene, plan=plan).gap_probability

    gaps = jax.jit(jax.vmap(gap))(jnp.array([0.0, 0.5]))
    assert np.isnan(gaps).all(axis=tuple(range(1, gaps.ndim))).tolist() == [False, True]


def test_coverage_within_a_derivative_by_a_python_number():
    plan = jl.plan(LIDAR, BARE, describe=False)

    def covered_reflectance(reflectance):
        scene = eqx.tree_at(lambda s: s.ground.reflectance, BARE, reflectance)
        return jnp.where(is_covered(plan, LIDAR, scene), reflectance, 0.0)

    assert jax.grad(covered_reflectance)(0.3) == 1.0
