"""Light over meshes against closed forms: planes, a box and its shadow, a sphere, a wire, a closed box.

Layout: a beam from 400 km, so that light is parallel, over a few triangles near the origin. First order has
rays of a lattice; their error is far below the tolerances. Energy is that of one sample of 1000 ns where
times do not matter.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.special import erf, ndtr

import jaxlidar as jl
from jaxlidar._constants import SPEED_OF_LIGHT
from tests.helpers import SINGLE_SAMPLE, agrees, first_wave, single_sample_lidar, slab, slow_unless

ALTITUDE = 4e5


def level(half, height=0.0, slope=0.0, **optics):
    """Return a square mesh of two triangles that falls to the north."""
    corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]], float)
    heights = height - np.tan(np.deg2rad(slope)) * corners[:, 1]
    return jl.MeshSurface((np.c_[corners, heights], [[0, 1, 2], [0, 2, 3]]), **optics)


def box(low, high, **options):
    """Return a closed box; the front sides of its triangles are outside."""
    return jl.MeshSurface(trimesh.creation.box(bounds=[low, high]), **options)


def wide_lidar(radius, **changes):
    """Return a single-sample lidar whose beam has a radius in m."""
    return single_sample_lidar(divergence=2e3 * radius / ALTITUDE, **changes)


def first_sums(lidar, scene, n_rays=8192, **options):
    """Return the sums of the components of the first order."""
    options = {"max_orders": 1, "n_rays": n_rays, "footprint": "fixed", **SINGLE_SAMPLE} | options
    wave = first_wave(lidar, scene, jl.plan(lidar, scene, describe=False, **options))
    return {name: float(a.sum()) for name, a in wave.components.items()}


@pytest.mark.parametrize("surface", slow_unless(["ground"], ["ground", "plate"]))
def test_a_flat_mesh_is_a_plane(surface):
    lidar = jl.Lidar(divergence=3.0, zenith=10.0)
    slope = 20.0 if surface == "ground" else 0.0
    plane = jl.Ground(0.0, 0.3, slope) if surface == "ground" else jl.Plate(0.0, 0.3)
    planes = jl.Scene(ground=plane) if surface == "ground" else jl.Scene(plates=(plane,))
    options = {"max_orders": 1, "window": (-20.0, 20.0), "footprint": "fixed", "n_rays": 16384}
    waves = [
        first_wave(lidar, scene, jl.plan(lidar, scene, describe=False, **options))
        for scene in (jl.Scene(meshes=(level(50.0, slope=slope),)), planes)
    ]
    np.testing.assert_allclose(waves[0].reflectance, waves[1].reflectance, atol=1e-5)
    assert float(waves[1].reflectance.max()) > 0.01


def test_a_box_and_its_shadow():
    """A long box, 2 m wide and high, under a beam at 30 degrees that travels to the east.

    Across the beam the sunlit side takes -cos(z) < u < 2 sin(z) - cos(z), the top the rest up to 2 sin(z) +
    cos(z); the ground behind is in the shadow. u has the standard deviation of half the beam's radius.
    """
    zenith = np.deg2rad(30.0)
    sine, cosine = np.sin(zenith), np.cos(zenith)
    lidar = wide_lidar(4.0, zenith=30.0, azimuth=90.0)
    # Wider than straight down by the longer range.
    radius = float(lidar.footprint_radius)
    scene = jl.Scene(
        meshes=(box([-1, -40, 0], [1, 40, 2], reflectance=0.6),), ground=jl.Ground(reflectance=0.3)
    )
    sums = first_sums(lidar, scene)
    edges = ndtr(np.array([-cosine, 2 * sine - cosine, 2 * sine + cosine]) / (0.5 * radius))
    side, top = np.diff(edges)
    assert sums["mesh"] == pytest.approx(0.6 * (side * sine + top * cosine), abs=1e-3)
    assert sums["ground"] == pytest.approx(0.3 * cosine * (1.0 - side - top), abs=1e-3)
    # Ground under the box and in its shadow counts otherwise.
    assert abs(sums["ground"] - 0.3 * cosine * (1.0 - top)) > 0.02


@pytest.mark.slow
def test_a_sphere_is_resolved_in_time():
    """A Lambertian sphere of radius a in a top-hat beam of radius w.

    The part above the height z returns 2 rho (a^3 - z^3) / (3 a w^2), in all 2 rho / 3 (a / w)^2.
    """
    a, w, rho = 3.0, 4.0, 0.5
    sphere = jl.MeshSurface(trimesh.creation.icosphere(subdivisions=4, radius=a), reflectance=rho)
    assert sphere.n_triangles == 5120
    interval = 2.0  # ns, 0.3 m
    pulse = jl.RectangularPulse(length=0.0)
    lidar = jl.Lidar(
        altitude=ALTITUDE,
        divergence=2e3 * w / ALTITUDE,
        profile="top-hat",
        pulse=pulse,
        sampling_interval=interval,
    )
    scene = jl.Scene(meshes=(sphere,))
    options = {"max_orders": 1, "n_rays": 32768, "footprint": "fixed", "bin_width": 0.1}
    wave = first_wave(lidar, scene, jl.plan(lidar, scene, describe=False, **options))
    assert float(wave.reflectance.sum()) == pytest.approx(2 / 3 * rho * (a / w) ** 2, rel=3e-3)
    # The lower edges of samples.
    z = np.clip(np.asarray(wave.height) - 0.25 * SPEED_OF_LIGHT * interval, 0.0, a)
    expected = 2 * rho * (a**3 - z**3) / (3 * a * w**2)
    np.testing.assert_allclose(np.cumsum(wave.reflectance[0]), expected, atol=0.006)


def test_a_wire():
    """A wire 2 cm thick across a beam 30 cm wide returns rho times the integral of irradiance and cosine."""
    r, w, rho = 0.01, 0.15, 0.5
    wire = trimesh.creation.cylinder(radius=r, segment=[[-2, 0, 5], [2, 0, 5]], sections=64)
    lidar = wide_lidar(w)
    sums = first_sums(lidar, jl.Scene(meshes=(jl.MeshSurface(wire, rho),)), n_rays=1 << 17)
    s = np.linspace(-1, 1, 2001)
    density = np.sqrt(2 / np.pi) / w * np.exp(-2 * (r * s / w) ** 2)
    expected = rho * r * np.trapezoid(np.sqrt(1 - s * s) * density, s)
    assert sums["mesh"] == pytest.approx(expected, rel=0.01)
    assert abs(expected - rho * erf(np.sqrt(2) * r / w)) > 0.1 * expected


@pytest.mark.slow
def test_two_facing_sheets_by_their_series():
    """A sheet of R, T over ground of r returns R + T^2 r / (1 - R r); both are meshes of 2 triangles."""
    sheet = level(3e3, 2.0, reflectance=0.4, transmittance=0.3)
    scene = jl.Scene(meshes=(sheet, level(3e3, reflectance=0.5)))
    lidar = single_sample_lidar()
    wave = jl.simulate(lidar, scene, key=jax.random.key(0), rtol=0.004, max_orders=8, **SINGLE_SAMPLE)
    # Order 3 + 2 n has the factor (R r)^n: those beyond order 8 begin with n = 3.
    expected, neglected = 0.4 + 0.045 / (1 - 0.2), 0.045 * 0.2**3 / (1 - 0.2)
    assert agrees(wave.reflectance.sum(), wave.stderr.sum(), expected, bound=neglected)
    assert not agrees(wave.reflectance.sum(), wave.stderr.sum(), 0.4 + 0.045, bound=neglected)
    assert sum(map(np.sum, wave.energy_budget.values())) == pytest.approx(1.0, abs=1e-4)


def closed_box():
    """Return a bright box, which light enters from behind its lid, and whose sides it meets from within."""
    inside_out = trimesh.creation.box(bounds=[[-1, -1, 0], [1, 1, 2]])
    inside_out.invert()
    return jl.Scene(meshes=(jl.MeshSurface(inside_out, reflectance=0.9, two_sided=False),))


@pytest.mark.slow
def test_no_light_leaks_from_a_closed_box():
    options = {"max_orders": 12, "n_photons": 4096, **SINGLE_SAMPLE}
    wave = jl.simulate(wide_lidar(0.1), closed_box(), key=jax.random.key(0), **options)
    budget = {name: float(np.sum(value)) for name, value in wave.energy_budget.items()}
    assert budget["escaped"] + budget["returned"] < 1e-6
    # What twelve reflections leave.
    assert budget["unfollowed"] + budget["after the window"] == pytest.approx(0.9**12, abs=1e-4)
    assert sum(budget.values()) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.slow
def test_a_closed_box_absorbs_everything():
    budget = jl.energy_budget(wide_lidar(0.1), closed_box(), key=jax.random.key(0), rtol=0.9)
    assert float(budget.returned[0] + budget.below[0]) < 1e-5
    assert agrees(budget.absorbed["mesh"], budget.stderr["mesh"], 1.0)
    np.testing.assert_allclose(budget.absorbed["mesh"], 1.0, atol=1e-3)


def test_materials_share_one_mesh():
    """Light that two materials return is that of one, times their reflectances."""
    corners = [[-3, -3, 1], [0, -3, 1], [0, 3, 1], [-3, 3, 1], [3, -3, 1], [3, 3, 1]]
    faces = [[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]]
    mesh = jl.Mesh(corners, faces, [0, 0, 1, 1], ["tile", "glass"])
    surface = jl.MeshSurface(mesh, {"tile": 0.4, "glass": 0.1}, {"glass": 0.8})
    sums = first_sums(wide_lidar(0.5), jl.Scene(meshes=(surface,), ground=jl.Ground()))
    assert sums["mesh:tile"] == pytest.approx(0.2, abs=1e-3)
    assert sums["mesh:glass"] == pytest.approx(0.05, abs=1e-3)
    assert sums["ground"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.slow
def test_a_mesh_within_voxels():
    """Below a depth d of leaf of extinction k a mesh returns rho exp(-k d), with the derivative k in height.

    Leaf above it returns what a slab of the depth d does, and nothing below it is lit.
    """
    k, top, rho = 0.05, 10.0, 0.4
    canopy = jl.Canopy(slab(leaf=k * top), leaf=jl.LeafOptics(0.45, 0.4))
    lidar = single_sample_lidar()
    options = {"max_orders": 1, "n_rays": 64, "footprint": "fixed", **SINGLE_SAMPLE}
    base = jl.Scene(canopy=canopy, ground=jl.Ground(), meshes=(level(15.0, 4.3, reflectance=rho),))
    plan = jl.plan(lidar, base, describe=False, **options)

    def returns(height):
        vertices = base.meshes[0].vertices.at[:, 2].set(height - float(base.meshes[0].origin[2]))
        scene = eqx.tree_at(lambda s: s.meshes[0].vertices, base, vertices)
        setup = jl.make_setup(lidar, scene, plan)
        wave = jl.waveform_of(jl.trace_scene(setup, jax.random.key(0), reverse=False), setup)
        return jnp.stack([wave.components[name].sum() for name in ("mesh", "leaf", "ground")])

    with pytest.warns(jl.OutlineWarning, match="mesh"):
        value, slope = jax.jvp(returns, (jnp.asarray(4.3),), (jnp.asarray(1.0),))
    passes = np.exp(-k * (top - 4.3))
    # Facets of spherical orientation scatter back 2/3 of R; hot spot.
    expected = np.array([rho * passes, 2 / 3 * 0.45 * (1 - passes), 0.0])
    np.testing.assert_allclose(value, expected, atol=2e-5)
    np.testing.assert_allclose(slope, [k * rho * passes, -k * 2 / 3 * 0.45 * passes, 0.0], atol=2e-5)


def repeating(period=8.0, leaf=0.3, **elements):
    """Return a canopy with periodic sides, over ground that it shades evenly."""
    voxels = jl.VoxelMap.from_extinction(
        leaf=np.full((2, 2, 4), leaf / 8.0), voxel_size=(period / 2, period / 2, 2.0), origin=(0.0, 0.0, 0.0)
    )
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4), sides="periodic")
    return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3), **elements)


@pytest.mark.slow
@pytest.mark.parametrize("max_orders", slow_unless([1], [1, 5]))
def test_a_level_mesh_that_repeats_is_a_plate(max_orders):
    """A square as wide as the period has no gaps, under a beam many periods wide; off nadir."""
    square = [[1.0, 1, 3], [9, 1, 3], [9, 9, 3], [1, 9, 3]]
    mesh = jl.MeshSurface((square, [[0, 1, 2], [0, 2, 3]]), reflectance=0.4, transmittance=0.2)
    plate = jl.Plate(3.0, 0.4, 0.2, transmission="diffuse")
    lidar = wide_lidar(30.0, zenith=20.0)
    options = {"max_orders": max_orders, "rtol": 0.01, **SINGLE_SAMPLE}
    waves = [
        jl.simulate(lidar, scene, key=jax.random.key(n), **options)
        for n, scene in enumerate([repeating(meshes=(mesh,)), repeating(plates=(plate,))])
    ]
    for name, other in (("mesh", "plate"), ("leaf", "leaf"), ("ground", "ground")):
        value, expected = waves[0].components[name].sum(), waves[1].components[other].sum()
        assert float(value) == pytest.approx(float(expected), abs=2e-5 if max_orders == 1 else 0.004), name
    assert float(waves[0].components["mesh"].sum()) > 0.2


@pytest.mark.slow
def test_a_mesh_across_sides_of_a_period_is_whole():
    """A box at a corner of the period is that in its middle, for beams that move with it."""
    heights = np.zeros((8, 8))
    heights[0, 0] = 1e-3
    terrain = jl.Terrain(heights, 1.0, reflectance=0.3, sides="periodic")
    for scene in (repeating(), jl.Scene(ground=terrain)):
        sums = []
        for x, y in ((4.0, 4.0), (-16.0, 8.0)):
            shift = jl.MeshInstances([[x, y, 0.0]])
            mesh = box([-2, -1, 2], [2, 1, 4], reflectance=0.5, instances=shift)
            beams = wide_lidar(3.0, position=(4.0 * (x == 4.0), 4.0 * (y == 4.0)))
            sums.append(first_sums(beams, dataclasses.replace(scene, meshes=(mesh,)), n_rays=4096))
        for name, value in sums[0].items():
            assert sums[1][name] == pytest.approx(value, abs=2e-3), name
        assert sums[0]["mesh"] > 0.1


@pytest.mark.slow
def test_meshes_repeat_without_the_canopy_that_is_left_out():
    square = [[1.0, 1, 3], [9, 1, 3], [9, 9, 3], [1, 9, 3]]
    scene = repeating(meshes=(jl.MeshSurface((square, [[0, 1, 2], [0, 2, 3]]), reflectance=0.4),))
    sums = first_sums(wide_lidar(30.0), scene, effects={"leaf": False}, n_rays=1024)
    assert sums["mesh"] == pytest.approx(0.4, abs=1e-5)
    assert sums["ground"] == pytest.approx(0.0, abs=1e-5)


@pytest.mark.slow
def test_truth_counts_meshes_among_what_intercepts():
    scene = jl.Scene(meshes=(level(1.0, 3.0),), ground=jl.Ground())
    truth = jl.truth_of(wide_lidar(1.0, profile="top-hat", sampling_interval=1.0), scene)
    assert float(truth.surface_height["mesh"]) == pytest.approx(3.0, abs=1e-3)
    assert float(truth.gap_probability[-1]) == pytest.approx(0.0, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("shared", [False, True])
def test_many_shots_are_single_simulations(shared):
    scene = jl.Scene(
        meshes=(box([-3, -3, 0], [3, 3, 4], reflectance=0.6),), ground=jl.Ground(reflectance=0.4)
    )
    lidar = jl.Lidar(altitude=ALTITUDE, divergence=2e3 * 3.0 / ALTITUDE)
    positions = [(0, 0), (3, 0), (6, 0), (9, 0), (3, 3)]
    survey = jl.Survey(lidar, position=positions)
    options = {"rtol": 0.02, "max_orders": 4}
    waveforms = jl.simulate_many(survey, scene, key=jax.random.key(0), shared=shared, **options)
    assert bool(waveforms.info["shared"]) == shared
    for number in (0, 1, 3):
        wave = jl.simulate(survey[number], scene, key=jax.random.key(1), **options)
        for name in ("mesh", "ground"):
            one, several = (np.asarray(w.components[name]).sum() for w in (wave, waveforms[number]))
            assert one == pytest.approx(several, abs=0.015), (number, name)


@pytest.mark.slow
def test_a_mesh_among_voxels_is_a_plate_among_voxels():
    """All orders, hot spot and return path: a level mesh and an opaque plate within a canopy agree."""
    voxels = jl.VoxelMap.from_extinction(
        leaf=np.full((4, 4, 4), 0.2), voxel_size=(1e3, 1e3, 2.0), origin=(-2e3, -2e3, 0.0)
    )
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4))
    lidar = single_sample_lidar()
    options = {"rtol": 0.005, "max_orders": 6, **SINGLE_SAMPLE}
    plate = jl.Plate(3.1, 0.5, 0.2, transmission="diffuse")
    waves = [
        jl.simulate(
            lidar, jl.Scene(canopy=canopy, ground=jl.Ground(), **sheet), key=jax.random.key(2), **options
        )
        for sheet in (
            {"meshes": (level(1900.0, 3.1, reflectance=0.5, transmittance=0.2),)},
            {"plates": (plate,)},
        )
    ]
    for mesh_name, plate_name in (("mesh", "plate"), ("leaf", "leaf"), ("ground", "ground")):
        mesh, plate = waves[0].components[mesh_name].sum(), waves[1].components[plate_name].sum()
        assert float(mesh) == pytest.approx(float(plate), abs=0.004), mesh_name
