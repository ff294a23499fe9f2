"""Derivatives of the orders two and above with respect to what moves: ground, canopy, plates, terrain, mesh.

The first order is left out: its shift in time is so much larger that it hides what the others lack. The
canopy is several columns wide, so that photons cross faces and leave by the sides, and the functionals are
the sum of the waveform and its first moment in time. Automatic differentiation is compared with central
differences, both as means over independent keys, at Sidak's level of 1 in 1,000 for both functionals.

The planted fault lets photons that collide on their way to a surface take part in the motion of landings: the
derivative then lacks what crosses the longest flight (`jaxlidar.trace.derivatives.reparametrisation`).

Invariances need no differences: ground and canopy that rise together shift time alone, a canopy that moves
sideways over a periodic scene changes nothing, and lengths that grow with extinction falling as their inverse
stretch time.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import jaxlidar as jl
from jaxlidar._jax.threads import ONE_CORE
from jaxlidar._vectors import FAR
from jaxlidar.trace.march.voxel_traversal import march_to_depths
from jaxlidar.trace.photons import higher_orders
from tests.helpers import slow_unless

KEYS = 16
LEAVES = jl.LeafOptics(reflectance=0.45, transmittance=0.4)
NODES = np.arange(-15.0, 16.0)
RELIEF = 0.5 * np.sin(0.5 * NODES)[:, None] + 0.3 * np.cos(0.6 * NODES)[None]
ROUGH = np.random.default_rng(0).normal(0, 0.25, (31, 31))
# ns, from the reference plane, or from the emission where the sensor's place is given.
WINDOW, SENSOR_WINDOW = (-120.0, 40.0), (-10.0, 120.0)


def lidar(**changes):
    """Return a lidar whose beam is 10 m wide on the ground 1 km below, where it is not placed otherwise."""
    defaults = {"divergence": 10.0, "pulse": jl.GaussianPulse(fwhm=4.0), "wavelength": 1064.0}
    if "sensor" not in changes:
        defaults["altitude"] = 1000.0
    return jl.Lidar(**(defaults | changes))


def canopy(rise=0.0, east=0.0, stretch=1.0, sides="open", density=0.8):
    """Return ten by ten columns of 2 m, and three layers of 2 m from 2 m up."""
    origin = jnp.stack([jnp.asarray(a) for a in (-10.0 + east, -10.0 + 0.5 * east, 2.0 + rise)])
    size = jnp.stack([jnp.asarray(2.0), jnp.asarray(2.0), 2.0 * jnp.asarray(stretch)])
    voxels = jl.VoxelMap.from_lad(jnp.full((10, 10, 3), density), voxel_size=size, origin=origin)
    return jl.Canopy(voxels, leaf=LEAVES, hotspot=False, sides=sides)


def ground(height=0.0, **changes):
    return jl.Ground(height=height, reflectance=0.25, **changes)


def terrain(height, relief):
    return jl.Terrain(jnp.asarray(relief) + height, spacing=1.0, origin=(-15.0, -15.0), reflectance=0.25)


def plate(height, coverage=0.5):
    return jl.Plate(height=height, reflectance=0.3, transmittance=0.3, coverage=coverage)


def sheet(height):
    """Return a mesh whose outlines no light meets."""
    corners = np.array(
        [[-300.0, -300.0, 0.0], [300.0, -300.0, 0.0], [300.0, 300.0, 0.0], [-300.0, 300.0, 0.0]]
    )
    mesh = jl.MeshSurface((corners, np.array([[0, 1, 2], [0, 2, 3]])), 0.25)
    up = jnp.stack([jnp.zeros(4), jnp.zeros(4), jnp.broadcast_to(height, (4,))], axis=1)
    return eqx.tree_at(lambda m: m.vertices, mesh, mesh.vertices + up)


def scene(floor, canopy=None, **surfaces):
    return jl.Scene(canopy=canopy, ground=floor, **surfaces)


def layers(rise):
    """Return a canopy that changes with height alone, over ground."""
    voxels = jl.VoxelMap.from_lad(
        jnp.full((1, 1, 3), 0.8),
        voxel_size=(20.0, 20.0, 2.0),
        origin=jnp.stack([jnp.asarray(-10.0), jnp.asarray(-10.0), 2.0 + rise]),
    )
    return scene(ground(), jl.Canopy(voxels, leaf=LEAVES, hotspot=False))


# Lidar, scene of a parameter, its value and half the step of the difference, orders.
CASES = {
    "ground, open sides": (lidar(), lambda h: scene(ground(h), canopy()), 0.0, 0.25, 4),
    "ground, periodic sides": (lidar(), lambda h: scene(ground(h), canopy(sides="periodic")), 0.0, 0.25, 2),
    "all nodes of terrain": (lidar(), lambda h: scene(terrain(h, RELIEF), canopy()), 0.0, 0.25, 3),
    "all nodes of rough terrain": (lidar(), lambda h: scene(terrain(h, ROUGH), canopy()), 0.0, 0.25, 4),
    "relief": (lidar(), lambda a: scene(terrain(0.0, RELIEF * a), canopy()), 1.0, 0.2, 3),
    "slope": (lidar(), lambda a: scene(ground(-1.0, slope=a, aspect=30.0), canopy()), 4.0, 2.0, 3),
    "ground, oblique beam": (lidar(zenith=25.0), lambda h: scene(ground(h), canopy()), 0.0, 0.25, 4),
    "ground, field of view": (lidar(field_of_view=11.0), lambda h: scene(ground(h), canopy()), 0.0, 0.25, 4),
    "plate below the canopy": (
        lidar(),
        lambda h: scene(ground(-1.0), canopy(), plates=(plate(h),)),
        0.7,
        0.25,
        4,
    ),
    "plate within the canopy": (
        lidar(),
        lambda h: scene(ground(-1.0), canopy(), plates=(plate(h),)),
        5.0,
        0.25,
        3,
    ),
    "slope of a plate within the canopy": (
        lidar(),
        lambda a: scene(
            ground(-1.0),
            canopy(),
            plates=(jl.Plate(height=5.0, reflectance=0.3, transmittance=0.3, coverage=0.5, slope=a),),
        ),
        4.0,
        2.0,
        3,
    ),
    "nodes of terrain within voxels": (
        lidar(),
        lambda h: scene(terrain(h, RELIEF + 3.0), canopy()),
        0.0,
        0.1,
        3,
    ),
    "both plates": (
        lidar(),
        lambda h: scene(ground(-1.0), canopy(), plates=(plate(h + 0.7), plate(h))),
        0.5,
        0.25,
        4,
    ),
    "all vertices of a mesh": (lidar(), lambda h: scene(None, canopy(), meshes=(sheet(h),)), 0.0, 0.25, 3),
    "mesh within voxels": (lidar(), lambda h: scene(None, canopy(), meshes=(sheet(h),)), 3.0, 0.25, 3),
    "all voxels up": (lidar(), lambda h: scene(ground(), canopy(rise=h)), 0.0, 0.25, 4),
    "all layers up": (lidar(), layers, 0.0, 0.25, 4),
    "size of voxels in z": (lidar(), lambda s: scene(ground(), canopy(stretch=s)), 1.0, 0.1, 4),
    "all voxels sideways": (lidar(), lambda a: scene(ground(), canopy(east=a)), 0.0, 0.3, 4),
    "ground, sensor in the canopy": (
        lidar(sensor=(0.3, 0.2, 5.0), zenith=20.0, divergence=100.0),
        lambda h: scene(ground(h), canopy()),
        0.0,
        0.25,
        3,
    ),
}
CHOSEN = ["ground, periodic sides", "all nodes of terrain"]


def measures(case, view_of=None, window=WINDOW):
    """Return a function of the parameter and a key: sum and first moment of the orders two and above.

    `view_of`: the lidar by the parameter, where it depends on it.
    """
    view, scene_of, middle, step, orders = case
    # The plan covers the highest and the lowest of the scenes.
    plan = jl.plan(view, scene_of(middle + step), max_orders=orders, n_photons=65536, window=window)

    def measure(value, key):
        view_now = view if view_of is None else view_of(value)
        wave = jl.simulate(view_now, scene_of(value), plan=plan, key=key)
        higher = wave.components["higher"][0]
        return jnp.stack([jnp.sum(higher), jnp.sum(higher * wave.time) / 20.0])

    return measure


def derivative_program(name):
    """Return a program of a value and a key: the measures, and their derivatives by AD."""
    measure = measures(CASES[name], window=SENSOR_WINDOW if "sensor" in name else WINDOW)

    def values_and_derivatives(value, key):
        return jax.jvp(lambda v: measure(v, key), (value,), (jnp.ones_like(value),))

    # It runs many times: optimised as the package's own programs are.
    return jax.jit(values_and_derivatives, **ONE_CORE)


def derivatives(program, name):
    """Return derivatives by AD, (keys, 2)."""
    middle = jnp.asarray(CASES[name][2])
    return np.array([program(middle, key)[1] for key in jax.random.split(jax.random.key(1), KEYS)])


def differences(program, name):
    """Return derivatives by central differences at other keys, (keys, 2)."""
    _, _, middle, step, _ = CASES[name]
    keys = jax.random.split(jax.random.key(2), KEYS)
    high, low = (np.array([program(middle + s, key)[0] for key in keys]) for s in (step, -step))
    return (high - low) / (2 * step)


def z_scores(exact, difference):
    """Return the difference of the two means over its standard error."""
    spread = np.sqrt(sum(np.var(a, axis=0, ddof=1) / len(a) for a in (exact, difference)))
    return (exact.mean(axis=0) - difference.mean(axis=0)) / spread


# Two functionals a case.
BOUND = norm.isf(0.5 * (1 - 0.999**0.5))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*outlines and edges of the mesh")
@pytest.mark.parametrize("name", [name for name in CASES if name not in CHOSEN])
def test_derivatives_agree_with_differences(name):
    program = derivative_program(name)
    z = z_scores(derivatives(program, name), differences(program, name))
    assert np.all(np.abs(z) < BOUND), z


@pytest.mark.parametrize("name", slow_unless(CHOSEN[:1], CHOSEN))
def test_a_motion_of_photons_that_collide_is_rejected(name, monkeypatch):
    program = derivative_program(name)
    difference = differences(program, name)
    z = z_scores(derivatives(program, name), difference)
    assert np.all(np.abs(z) < BOUND), z
    move_landings = higher_orders.move_landings

    def move_all(scene, p, encounters, flights, may_move):
        heads = jnp.broadcast_to(encounters.nearest_stop < FAR, flights.landed.shape)
        path = march_to_depths(
            scene.medium,
            p.x,
            p.w,
            jnp.zeros((0, p.weight.size)),
            encounters.nearest_stop,
            p.alive,
            scene.config.max_faces,
            by_path=True,
        )
        ratio = jnp.exp(jax.lax.stop_gradient(path.total_depth) - path.total_depth)
        heading = dataclasses.replace(
            flights,
            landed=flights.landed | (flights.collided & heads),
            ratio=jnp.broadcast_to(ratio, flights.ratio.shape),
            path_slopes=path.path_slopes,
        )
        moved = move_landings(scene, p, encounters, heading, may_move)
        distance = jnp.where(flights.landed, moved.distance, flights.distance)
        return dataclasses.replace(moved, landed=flights.landed, distance=distance)

    monkeypatch.setattr(higher_orders, "move_landings", move_all)
    jax.clear_caches()
    z = z_scores(derivatives(derivative_program(name), name), difference)
    jax.clear_caches()
    assert np.any(np.abs(z) > BOUND), z


@pytest.mark.slow
@pytest.mark.parametrize("name", CHOSEN)
def test_reverse_mode_agrees_with_forward_mode(name):
    measure, middle, key = measures(CASES[name]), jnp.asarray(CASES[name][2]), jax.random.key(3)
    forward = jax.jit(jax.jacfwd(measure))(middle, key)
    reverse = jax.jit(jax.jacrev(measure))(middle, key)
    np.testing.assert_allclose(forward, reverse, rtol=2e-3, atol=1e-6)


# -- invariances -------------------------------------------------------------------------------------------


def along_zero(view_of, scene_of, keys=1):
    """Return values and derivatives at zero, (keys, 2), of the sum and the first moment in time."""
    zero, one = jnp.zeros(()), jnp.ones(())
    # No light is cut off by the end of the record, which does not move.
    measure = measures((view_of(zero), scene_of, 0.0, 0.0, 4), view_of, window=(-120.0, 700.0))
    forward = jax.jit(lambda key: jax.jvp(lambda v: measure(v, key), (zero,), (one,)))
    values = [forward(key) for key in jax.random.split(jax.random.key(4), keys)]
    return tuple(np.array(a) for a in zip(*values))


def far_lidar(stretch=0.0):
    """Return a lidar of parallel light."""
    return lidar(altitude=4e5, divergence=0.025 * (1.0 + stretch))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plane", "relief", "plate"])
def test_ground_and_canopy_that_rise_together_shift_time(name):
    """Of parallel light from far away, path by path: d sum = 0, d moment = -(2 / c) sum.

    Over planes the canopy repeats without end: light that leaves one by its sides comes back so late that
    what the end of the record cuts off would show, by 0.1 %.
    """
    # Terrain ends, and the canopy with it.
    sides, tolerance = ("open", 1e-3) if name == "relief" else ("periodic", 1e-5)

    def scene_of(h):
        floor = terrain(h, RELIEF) if name == "relief" else ground(h)
        plates = (plate(h + 0.7),) if name == "plate" else ()
        return scene(floor, canopy(rise=h, sides=sides), plates=plates)

    values, slopes = along_zero(lambda h: far_lidar(), scene_of)
    assert np.abs(slopes[0, 0]) < 1e-4 * values[0, 0]
    shift = -2.0 / jl.SPEED_OF_LIGHT / 20.0
    assert slopes[0, 1] == pytest.approx(shift * values[0, 0], rel=tolerance)


@pytest.mark.slow
def test_periodic_canopy_that_moves_sideways_changes_nothing():
    def scene_of(a):
        return scene(ground(), canopy(east=a, sides="periodic"))

    _, slopes = along_zero(lambda a: lidar(), scene_of, keys=KEYS)
    error = slopes.std(axis=0, ddof=1) / np.sqrt(KEYS)
    assert np.all(np.abs(slopes.mean(axis=0)) < BOUND * error + 1e-7)
    # Power: errors are small against the derivative by height, 7e-4.
    assert np.all(error < 1e-4)


@pytest.mark.slow
def test_time_is_scaled_with_all_lengths():
    """With lengths times 1 + s and extinction over 1 + s: d sum = 0 and d moment = moment, path by path.

    The canopy repeats without end: light that leaves one by its sides comes back so late that what the end of
    the record cuts off, which does not scale, would show.
    """

    def scene_of(s):
        fixed = canopy(sides="periodic")
        voxels = fixed.voxels
        scaled = eqx.tree_at(
            lambda v: (v.voxel_size, v.origin, v.leaf),
            voxels,
            (voxels.voxel_size * (1 + s), voxels.origin * (1 + s), voxels.leaf / (1 + s)),
        )
        return scene(ground(0.5 * (1 + s)), eqx.tree_at(lambda c: c.voxels, fixed, scaled))

    values, slopes = along_zero(far_lidar, scene_of)
    assert np.abs(slopes[0, 0]) < 1e-4 * values[0, 0]
    assert slopes[0, 1] == pytest.approx(values[0, 1], rel=1e-3)
