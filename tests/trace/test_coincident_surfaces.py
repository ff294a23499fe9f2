"""Surfaces that lie in one another: light meets the first of them alone, or the scene is refused.

A mesh that lies in the ground is met before the ground. With the reflectance R and the transmittance T of the
mesh and the reflectance g of the ground, wide and without a gap in between, R + T^2 g / (1 - R g) returns.
"""

import re
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar._vectors import vec
from jaxlidar.scenes.mesh_surface import build_mesh_tree
from jaxlidar.spectral.apply_optics import budget_excess, refuse_excess
from tests.helpers import slow_unless

GROUND = 0.3


def sheet(height=0.0, slope=0.0, **optics):
    """Return a square mesh, 100 m wide, that falls to the north."""
    corners = np.array([[-50.0, -50.0], [50.0, -50.0], [50.0, 50.0], [-50.0, 50.0]])
    heights = height - np.tan(np.deg2rad(slope)) * corners[:, 1]
    return jl.MeshSurface((np.c_[corners, heights], [[0, 1, 2], [0, 2, 3]]), **optics)


def grounds(slope=0.0):
    plane = jl.Ground(reflectance=GROUND, slope=slope)
    if slope:
        return [plane]
    heights = np.zeros((5, 5))
    heights[0, 0] = 1.0
    return [plane, jl.Terrain(heights, spacing=100.0, origin=(-200.0, -200.0), reflectance=GROUND)]


@pytest.mark.parametrize("height", slow_unless([0.0], [-1e-5, 0.0, 1e-6]))
@pytest.mark.parametrize("zenith", [0.0, pytest.param(70.0, marks=pytest.mark.slow)])
def test_an_opaque_mesh_in_the_ground_hides_it(height, zenith):
    lidar = jl.Lidar(zenith=zenith)
    for ground in grounds():
        scene = jl.Scene(ground=ground, meshes=(sheet(height, reflectance=0.5),))
        wave = jl.simulate(lidar, scene, key=jax.random.key(0), max_orders=1)
        assert float(wave.components["ground"].sum()) == 0.0
        assert float(wave.reflectance.sum()) == pytest.approx(0.5 * np.cos(np.deg2rad(zenith)), rel=1e-4)


def test_a_mesh_in_sloping_ground():
    scene = jl.Scene(
        ground=jl.Ground(reflectance=GROUND, slope=20.0), meshes=(sheet(slope=20.0, reflectance=0.5),)
    )
    wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0), max_orders=1)
    assert float(wave.reflectance.sum()) == pytest.approx(0.5 * np.cos(np.deg2rad(20.0)), rel=1e-4)
    assert float(wave.components["ground"].sum()) == 0.0


@pytest.mark.slow
def test_what_the_mesh_transmits_goes_on_to_the_ground():
    reflectance, transmittance = 0.5, 0.4
    expected = reflectance + transmittance**2 * GROUND / (1.0 - reflectance * GROUND)
    for ground in grounds():
        mesh = sheet(reflectance=reflectance, transmittance=transmittance)
        scene = jl.Scene(ground=ground, meshes=(mesh,))
        budget = jl.energy_budget(jl.Lidar(), scene, key=jax.random.key(1), rtol=0.005)
        # The rim of the mesh is far away.
        assert abs(float(budget.returned[0]) - expected) < 4.0 * float(budget.stderr["returned"][0])
        assert float(budget.below[0]) == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("zenith", [0.0, 45.0, 80.0, 88.0])
def test_of_meshes_in_one_plane_rays_meet_the_first_named(zenith):
    """Sheets in one sloping plane, with triangles that differ: rounding would mix them."""
    wide, fall = sheet(5.0, 20.0), np.tan(np.deg2rad(20.0))
    corners = np.array([[-37.3, -37.3], [37.3, -37.3], [37.3, 37.3], [-37.3, 37.3], [3.7, -1.2]])
    faces = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]

    def narrow(gap):
        return jl.MeshSurface((np.c_[corners, 5.0 + gap - fall * corners[:, 1]], faces))

    # Rays from 100 m above to points of both sheets, at any angle to the plane.
    random = np.random.default_rng(0)
    x, y = random.uniform(-30.0, 30.0, (2, 3000))
    azimuth, theta = random.uniform(0.0, 2.0 * np.pi, 3000), np.deg2rad(zenith)
    tangent = np.cross([1.0, 0.0, 0.0], normal := np.array([0.0, fall, 1.0]) / np.hypot(fall, 1.0))
    side = np.cos(azimuth)[:, None] * [1.0, 0.0, 0.0] + np.sin(azimuth)[:, None] * -tangent
    direction = -np.cos(theta) * normal + np.sin(theta) * side
    start = np.stack([x, y, 5.0 - fall * y], axis=1) - 100.0 * direction
    rays = [vec(jnp.asarray(a.T, float)) for a in (start, direction)]
    for meshes in ((wide, narrow(0.0)), (narrow(0.0), wide)):
        hit = build_mesh_tree(meshes).meet(*rays)
        np.testing.assert_allclose(hit.distance, 100.0, rtol=1e-3)
        assert not hit.material.any()
    # Of sheets that are apart the upper one is met, whichever is named first.
    assert build_mesh_tree((wide, narrow(0.003))).meet(*rays).material.all()


def test_a_box_that_stands_on_the_ground_keeps_its_floor():
    low, high = np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 2.0])
    corners = np.array([[(low, high)[int(b)][k] for k, b in enumerate(f"{n:03b}")] for n in range(8)])
    faces = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    scene = jl.Scene(
        ground=jl.Ground(reflectance=GROUND), meshes=(jl.MeshSurface((corners, faces), reflectance=0.6),)
    )
    budget = jl.energy_budget(jl.Lidar(divergence=8.0), scene, key=jax.random.key(0), rtol=0.01)
    total = sum(float(a[0]) for a in (*budget.absorbed.values(), budget.returned))
    assert total == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("instances", [None, jl.MeshInstances([[0, 0, -8.0]], rotation=[30.0], scale=[2.0])])
def test_a_plate_in_the_plane_of_triangles_is_refused(instances):
    mesh = sheet(5.0, instances=instances)
    height = 5.0 if instances is None else 2.0
    with pytest.raises(ValueError, match=re.escape("plates[0] lies") + ".*" + re.escape("meshes[0]")):
        jl.Scene(plates=(jl.Plate(height + 5e-5, 0.3),), meshes=(mesh,))
    jl.Scene(plates=(jl.Plate(height + 1e-3, 0.3),), meshes=(mesh,))


def test_a_plate_in_a_cell_of_the_terrain_is_refused():
    heights = np.zeros((4, 4))
    heights[:, 2:] = 3.0
    terrain = jl.Terrain(heights, spacing=1.0)
    for height in (0.0, 3.0):
        with pytest.raises(ValueError, match="the terrain"):
            jl.Scene(plates=(jl.Plate(height, 0.3),), ground=terrain)
    jl.Scene(plates=(jl.Plate(1.0, 0.3),), ground=terrain)


def draped(relief, lift=0.0, origin=(0.0, 0.0), step=1, sides="open"):
    """Return a terrain of random heights, and a mesh of two triangles for each `step` cells."""
    heights, spacing = relief * np.random.default_rng(0).standard_normal((65, 65)), 0.5
    terrain = jl.Terrain(heights, spacing=spacing, origin=origin, sides=sides, reflectance=GROUND)
    number = np.arange(65 * 65).reshape(65, 65)[::step, ::step]
    west, east = number[:-1], number[1:]
    a, b, c, d = (n.ravel() for n in (west[:, :-1], east[:, :-1], east[:, 1:], west[:, 1:]))
    places = np.asarray(origin) + spacing * np.stack(np.divmod(np.arange(65 * 65), 65), axis=1)
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return terrain, jl.MeshSurface((np.c_[places, heights.ravel() + lift], faces), reflectance=0.5)


@pytest.mark.parametrize("change", [{}, {"origin": (5e5, 6e6)}, {"step": 2}, {"sides": "periodic"}])
def test_a_mesh_of_the_terrain_s_own_heights_is_refused(change):
    """It lies above the bilinear surface in one half of the cells, and below it in the other."""
    terrain, mesh = draped(0.05, **change)
    with pytest.raises(
        ValueError, match=r"meshes\[0\] follows the terrain, up to 0\.\d+ m below and 0\.\d+ m"
    ):
        jl.Scene(ground=terrain, meshes=(mesh,))
    # Level to 0.1 mm within each cell, and above the terrain.
    for relief, lift in ((1e-5, 0.0), (0.05, 0.5)):
        terrain, mesh = draped(relief, lift, **change)
        jl.Scene(ground=terrain, meshes=(mesh,))


@pytest.mark.slow
def test_a_mesh_of_nearly_level_terrain_is_met_before_it():
    terrain, mesh = draped(1e-5, origin=(-16.0, -16.0))
    wave = jl.simulate(
        jl.Lidar(zenith=30.0), jl.Scene(ground=terrain, meshes=(mesh,)), key=jax.random.key(0), max_orders=1
    )
    assert float(wave.reflectance.sum()) == pytest.approx(0.5 * np.cos(np.deg2rad(30.0)), rel=1e-3)
    assert float(wave.components["ground"].sum()) == 0.0


@pytest.mark.slow
def test_copies_of_a_mesh_in_one_place_count_once():
    reflectance, transmittance = 0.5, 0.4
    expected = reflectance + transmittance**2 * GROUND / (1.0 - reflectance * GROUND)
    mesh = sheet(
        reflectance=reflectance,
        transmittance=transmittance,
        instances=jl.MeshInstances([[0.0, 0.0, 0.5], [3.0, 2.0, 0.5]]),
    )
    scene = jl.Scene(ground=jl.Ground(reflectance=GROUND), meshes=(mesh,))
    budget = jl.energy_budget(jl.Lidar(), scene, key=jax.random.key(1), rtol=0.005)
    assert abs(float(budget.returned[0]) - expected) < 4.0 * float(budget.stderr["returned"][0])


@pytest.mark.parametrize("offset", [0.0, 5e-4, -5e-4])
def test_a_sensor_in_a_triangle_is_refused(offset):
    scene = jl.Scene(ground=jl.Ground(), meshes=(sheet(5.0),))
    with pytest.raises(ValueError, match="in a triangle of a mesh"):
        jl.simulate(jl.Lidar(sensor=(1.0, 2.0, 5.0 + offset)), scene, key=jax.random.key(0))
    # Beside the mesh it is free.
    jl.plan(jl.Lidar(sensor=(70.0, 2.0, 5.0 + offset)), scene)


def test_an_energy_budget_of_more_than_the_light_is_an_error():
    budget, stderr = (
        {"returned": jnp.array([0.7]), "escaped": jnp.array([0.5])},
        {"escaped": jnp.array([0.01])},
    )
    assert float(budget_excess(budget, stderr)) == pytest.approx(0.15)
    with pytest.raises(RuntimeError, match="sums to 15 % more"):
        refuse_excess(np.array([0.0, 0.15]))
    refuse_excess(np.array([-1.0, 0.0]))


@pytest.mark.slow
def test_every_run_looks_at_its_budget(monkeypatch):
    for module in ("jaxlidar.simulation.one_scene", "jaxlidar.simulation.energy", "jaxlidar.survey.collect"):
        # By its name in `sys.modules`: `jaxlidar.simulate` is also a function.
        monkeypatch.setattr(
            sys.modules[module], "refuse_excess", lambda excess: refuse_excess(np.asarray(excess) + 1.0)
        )
    lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground())
    survey = jl.Survey(lidar, position=[[0.0, 0.0], [1.0, 0.0]])
    for run in (jl.simulate, jl.energy_budget):
        with pytest.raises(RuntimeError, match="energy budget"):
            run(lidar, scene, key=jax.random.key(0))
    with pytest.raises(RuntimeError, match="energy budget"):
        jl.simulate_many(survey, scene, key=jax.random.key(0))


@pytest.mark.slow
def test_the_ground_under_a_mesh_keeps_its_derivative():
    """The return of an opaque mesh does not depend on the ground in which it lies."""
    scene = jl.Scene(ground=jl.Ground(reflectance=GROUND), meshes=(sheet(reflectance=0.5),))
    plan = jl.plan(jl.Lidar(), scene, max_orders=1)

    def total(reflectance):
        changed = eqx.tree_at(lambda s: s.ground.reflectance, scene, reflectance)
        return jl.simulate(jl.Lidar(), changed, plan=plan, key=jax.random.key(0)).reflectance.sum()

    assert float(jax.grad(total)(GROUND)) == 0.0
