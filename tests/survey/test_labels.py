"""Labels of returns: tilted planes, spheres, trees side by side, and triangles searched one by one."""

import jax
import laspy
import numpy as np
import pytest

import jaxlidar as jl

# A range finder of a tripod or a drone: 1 ns, so that surfaces 1 m apart are two returns.
SHARP = {"pulse": jl.GaussianPulse(fwhm=1.0), "sampling_interval": 0.25}
DRONE = jl.Lidar(sensor=(0, 0, 0), divergence=0.5, **SHARP)
GROUND = jl.Ground(reflectance=0.3)


def simulated(survey, scene):
    """The labelled returns of a simulation."""
    many = jl.simulate_many(survey, scene, key=jax.random.key(0), max_orders=1, rtol=0.05)
    return many.returns().labelled(survey, scene)


def labelled(survey, scene, material, distance, shot=None):
    """Labels of returns that are stated: their material, range in m and shot, each its own by default."""
    distance = np.asarray(distance, float)
    count = len(distance)
    shot = np.arange(count) if shot is None else np.asarray(shot)
    zero, one = np.zeros(count), np.ones(count, int)
    material = np.broadcast_to(material, (count,)).astype("U16")
    returns = jl.DiscreteReturns(
        *(shot, zero, distance, np.zeros((count, 3)), zero, zero + 1.0, zero, one, one, material),
        *(zero, zero, zero, zero, one, len(survey)),
    )
    return returns.labelled(survey, scene)


def downwards(places, height=30.0, divergence=0.5, **fields):
    lidar = jl.Lidar(sensor=(0, 0, 0), divergence=divergence, **SHARP)
    return jl.Survey(lidar, sensor=[(x, y, height) for x, y in places], **({"zenith": 0.0} | fields))


def panel(middle, normal, size=2.0, name="panel", **instances):
    """A square across a unit vector, of two triangles."""
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    first = np.cross(normal, [0.3, 0.2, 0.9])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    corners = [
        np.asarray(middle) + 0.5 * size * (a * first + b * second)
        for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    mesh = jl.Mesh(corners, [(0, 1, 2), (0, 2, 3)], materials=(name,))
    return jl.MeshSurface(mesh, {name: 0.4}, instances=jl.MeshInstances(**instances) if instances else None)


# -- normals and incidence ---------------------------------------------------------------------------------


@pytest.mark.parametrize("zenith", [0.0, 25.0])
def test_planes_of_known_tilt(zenith):
    """Panels, a slope and a plate have their own normals; the incidence is the angle to the beam."""
    normals = np.array([(0, 0, 1), (0.5, 0, 1), (0, -1, 1), (-0.3, 0.4, 0.6), (0.1, 0.1, -1)], float)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    places = [(6.0 * k, 0.0) for k in range(len(normals))]
    panels = [panel((x, y, 5.0), n) for (x, y), n in zip(places, normals)]
    slope = jl.Ground(reflectance=0.3, slope=20.0, aspect=90.0, height=-20.0)
    # Beams that aim at the middles, and one that meets the ground.
    shift = 25.0 * np.tan(np.deg2rad(zenith))
    survey = downwards([(x, y - shift) for x, y in [*places, (-9.0, 0.0)]], zenith=zenith)
    slant = np.cos(np.deg2rad(zenith))
    # The slope falls to the east, across the beams.
    below = 50.0 - np.tan(np.deg2rad(20.0)) * 9.0
    distance = np.array([25.0] * len(normals) + [below]) / slant
    material = [f"mesh:panel {k + 1}" for k in range(len(normals))] + ["ground"]
    returns = labelled(survey, jl.Scene(meshes=panels, ground=slope), material, distance)
    # Those that look down are seen from behind.
    upper = normals * np.where(normals[:, 2:] > 0, 1.0, -1.0)
    tilt = np.deg2rad(20.0)
    upper = np.concatenate([upper, [(np.sin(tilt), 0.0, np.cos(tilt))]])
    np.testing.assert_allclose(returns.normal, upper, atol=2e-5)
    cosine = -np.sum(upper * survey.direction, axis=1)
    np.testing.assert_allclose(returns.incidence, np.rad2deg(np.arccos(cosine)), atol=2e-3)
    assert returns.instance.tolist() == [1, 2, 3, 4, 5, 0]
    assert returns.part.tolist() == [4] * 5 + [1]
    # The planted wrong answer: angles from the vertical.
    if zenith:
        assert np.abs(np.rad2deg(np.arccos(upper[:, 2])) - returns.incidence).max() > 5.0


@pytest.mark.slow
@pytest.mark.parametrize("placed_by", ["sensor", "altitude"])
def test_a_sphere_has_radial_normals(placed_by):
    """At the distance b from the axis of a sphere of radius r, the incidence is arcsin(b / r)."""
    trimesh = pytest.importorskip("trimesh")
    radius, centre = 2.0, np.array([4e5, 5.2e6, 8.0])
    ball = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    surface = jl.MeshSurface((ball.vertices, ball.faces), 0.4, instances=jl.MeshInstances([centre]))
    distance = np.linspace(0.0, 1.8, 10)
    turn = 2.0 * np.arange(distance.size)
    place = centre[:2] + distance[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    if placed_by == "sensor":
        survey = downwards(place)
    else:
        survey = jl.Survey(jl.Lidar(altitude=5000.0, divergence=0.005, **SHARP), place)
    distance_to_it = survey.sensor[:, 2] - centre[2] - np.sqrt(radius**2 - distance**2)
    returns = labelled(survey, jl.Scene(meshes=[surface]), "mesh", distance_to_it)
    offset = place - centre[:2]
    expected = np.column_stack([offset, np.sqrt(radius**2 - distance**2)]) / radius
    # Facets are 4.4 degrees wide or less.
    error = np.rad2deg(np.arccos(np.clip(np.sum(expected * returns.normal, axis=1), -1.0, 1.0)))
    assert error.max() < 2.5
    np.testing.assert_allclose(returns.incidence, np.rad2deg(np.arcsin(distance / radius)), atol=2.5)


def test_the_normal_of_a_footprint_is_the_mean_of_its_own():
    """A beam on the ridge of a roof sees both sides alike: the mean is straight up."""
    corners = [(-3, -3, 0), (3, -3, 0), (3, 0, 3), (-3, 0, 3), (-3, 3, 0), (3, 3, 0)]
    roof = jl.MeshSurface((corners, [(0, 1, 2), (0, 2, 3), (3, 2, 5), (3, 5, 4)]), 0.4)
    survey = downwards([(0, 0), (0, 1)], divergence=10.0)
    returns = labelled(survey, jl.Scene(meshes=[roof]), "mesh", [27.0, 28.0])
    up, side = returns.normal
    np.testing.assert_allclose(up, [0, 0, 1], atol=0.06)
    np.testing.assert_allclose(side, [0, 0.5**0.5, 0.5**0.5], atol=1e-5)
    np.testing.assert_allclose(returns.incidence, [0.0, 45.0], atol=4.0)


# -- instances ---------------------------------------------------------------------------------------------


def half_plane(sign, height, rise=0.0, **instances):
    """A square of 4 m beside the line x = 0, at a height that rises to the east."""
    corners = [(x, y, height + rise * x) for x, y in ((0, -2), (4 * sign, -2), (4 * sign, 2), (0, 2))]
    mesh = jl.Mesh(corners, [(0, 1, 2), (0, 2, 3)], materials=("leaf",))
    return jl.MeshSurface(mesh, {"leaf": 0.4}, instances=jl.MeshInstances(**instances))


@pytest.mark.slow
def test_two_trees_share_a_footprint():
    """The nearer crown lies west of the beam's axis, the other east: a return of each, with its number."""
    west, east = (
        half_plane(*args, shift=[(0, 0, 0)], instance=[n]) for args, n in (((-1, 10), 7), ((1, 4, 0.2), 3))
    )
    survey = downwards([(-0.02, 0), (0.02, 0)], divergence=10.0)
    returns = simulated(survey, jl.Scene(meshes=[west, east]))
    assert returns.instance.tolist() == [7, 3, 7, 3]
    np.testing.assert_allclose(returns.incidence[:2], [0.0, np.rad2deg(np.arctan(0.2))], atol=1e-3)
    assert returns.material.tolist() == ["mesh:leaf 1", "mesh:leaf 2"] * 2
    # In one height and of one mesh they are one return: of the tree with most of the light.
    pair = half_plane(1, 4, shift=[(-4, 0, 0), (0, 0, 0)], instance=[7, 3])
    returns = labelled(survey, jl.Scene(meshes=[pair]), "mesh:leaf", [26.0, 26.0])
    assert returns.instance.tolist() == [7, 3]


def hit_triangle(corners, start, axis):
    """The number of the triangle that a ray meets first: Moeller and Trumbore (1997), all triangles."""
    a, b, c = np.moveaxis(corners, 1, 0)
    first, second, offset = b - a, c - a, start - a
    p = np.cross(axis, second)
    determinant = np.sum(first * p, axis=1)
    u = np.sum(offset * p, axis=1) / determinant
    q = np.cross(offset, first)
    v, distance = (np.sum(q * d, axis=1) / determinant for d in (axis, second))
    distance[(u < 0) | (v < 0) | (u + v > 1) | (distance <= 0)] = np.inf
    number = int(np.argmin(distance))
    return number, distance[number]


@pytest.fixture(scope="module")
def stand():
    """Six trees: three copies of one shrub, the others each of their own proportions."""
    shrubs = [jl.grow(jl.shrub(height=2.0, stems=2), seed=seed) for seed in (0, 1)]
    place = [(1.3 * k, 0.4 * k, 0.0) for k in range(6)]
    scale = np.array([(1, 1, 1), (1.2, 1.2, 1), (1, 1.3, 1), (0.8, 0.8, 1), (1, 1, 1), (1, 0.7, 1)], float)
    turns = [0, 40, 80, 120, 160, 200]
    return jl.Stand(shrubs, place, [0, 0, 0, 0, 1, 1], turns, scale, leaf_area=0.02 * scale[:, 0] ** 2)


@pytest.mark.slow
def test_leaves_have_the_numbers_of_their_trees(stand):
    """Beams without width: each label is that of the triangle that is met first, searched one by one."""
    leaves = jl.leaf_mesh(stand, 0.02, key=jax.random.key(1))
    # Copies 1, 2 and 4 share leaves; trees 3, 5 and 6 are one mesh.
    copies = [m for m in leaves if m.instances.instance is not None]
    joined = [m for m in leaves if m.instance is not None]
    assert [m.instances.instance.tolist() for m in copies] == [[1, 2, 4]]
    assert [sorted(set(m.instance.tolist())) for m in joined] == [[3, 5, 6]]
    random = np.random.default_rng(0)
    places, azimuth = random.uniform((-0.6, -0.6), (7.1, 2.6), (800, 2)), random.uniform(0, 360, 800)
    # Beams that pass these places 1 m above the ground.
    turn = np.deg2rad(azimuth)[:, None]
    places = places - 29.0 * np.tan(np.deg2rad(15.0)) * np.concatenate([np.sin(turn), np.cos(turn)], axis=1)
    survey = downwards(places, divergence=0.0, zenith=15.0, azimuth=azimuth)
    corners, owner, surface = [], [], []
    for number, mesh in enumerate(leaves):
        faces = np.unique(mesh.faces, axis=0)
        corners.append(mesh.corners())
        owners = mesh.instances.instance
        if mesh.instance is None:
            owner.append(np.repeat(owners, len(faces)))
        else:
            owner.append(np.unique(np.column_stack([mesh.faces, mesh.instance]), axis=0)[:, 3])
        surface += [f"mesh:leaf {number + 1}"] * len(owner[-1])
    corners, owner = np.concatenate(corners), np.concatenate(owner)
    hits = [hit_triangle(corners, *beam) for beam in zip(survey.sensor, survey.direction)]
    shot = np.array([k for k, (_, distance) in enumerate(hits) if np.isfinite(distance)])
    number, distance = (np.array([hits[k][i] for k in shot]) for i in (0, 1))
    returns = labelled(
        survey, jl.Scene(meshes=leaves, ground=GROUND), np.array(surface)[number], distance, shot
    )
    assert len(shot) > 100
    assert set(owner[number]) == {1, 2, 3, 4, 5, 6}
    np.testing.assert_array_equal(returns.instance, owner[number])
    a, b, c = np.moveaxis(corners[number], 1, 0)
    normal = np.cross(b - a, c - a)
    cosine = np.sum(normal * survey.direction[shot], axis=1) / np.linalg.norm(normal, axis=1)
    np.testing.assert_allclose(np.cos(np.deg2rad(returns.incidence)), np.abs(cosine), atol=1e-4)
    assert set(returns.part) == {2}


def test_copies_are_numbered_where_nothing_is_stated():
    first = panel((0, 0, 2), (0, 0, 1), shift=[(0, 0, 0), (5, 0, 0)])
    second = panel((0, 0, 2), (0, 0, 1), name="box", shift=[(10, 0, 0), (15, 0, 0)])
    survey = downwards([(0, 0), (5, 0), (10, 0), (15, 0), (20, 0)])
    there = ["mesh:panel"] * 2 + ["mesh:box"] * 2 + ["ground"], [28.0] * 4 + [30.0]
    scene = jl.Scene(meshes=[first, second], ground=GROUND)
    assert labelled(survey, scene, *there).instance.tolist() == [1, 2, 3, 4, 0]
    # Where one states its own, the others have none.
    stated = panel((0, 0, 2), (0, 0, 1), shift=[(0, 0, 0), (5, 0, 0)], instance=[9, 8])
    scene = jl.Scene(meshes=[stated, second], ground=GROUND)
    assert labelled(survey, scene, *there).instance.tolist() == [9, 8, 0, 0, 0]


def test_a_twig_that_fills_little_of_a_footprint_has_its_label():
    twig = panel((0.1, 0, 6), (0, 0, 1), size=0.03, shift=[(0, 0, 0)], instance=[5])
    scene, survey = jl.Scene(meshes=[twig], ground=GROUND), downwards([(0, 0)], divergence=10.0)
    returns = labelled(survey, scene, ["mesh:panel", "ground"], [24.0, 30.0], [0, 0])
    assert returns.instance.tolist() == [5, 0]
    # What lies farther from a return than it is wide has no part in it.
    with pytest.warns(UserWarning, match="1 of 2 returns of surfaces lie where no ray meets one"):
        returns = labelled(survey, scene, ["mesh:panel", "ground"], [23.8, 30.0], [0, 0])
    assert returns.instance.tolist() == [0, 0]
    assert np.isnan(returns.incidence).tolist() == [True, False]


def test_copies_of_a_scene_that_repeats_have_the_number_of_the_tree():
    voxels = jl.VoxelMap.from_lad(np.full((4, 4, 1), 1e-6), voxel_size=2.0)
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4), sides="periodic")
    trees = panel((0, 0, 5), (0, 0, 1), shift=[(2, 2, 0), (6, 6, 0)], instance=[4, 2])
    scene = jl.Scene(canopy=canopy, meshes=[trees], ground=GROUND)
    survey = downwards([(2, 2), (6, 6), (10, 2), (-2, -2), (22, 30)])
    assert labelled(survey, scene, "mesh:panel", [25.0] * 5).instance.tolist() == [4, 2, 4, 2, 2]


def test_labels_are_those_of_the_true_beams():
    """Stated beams miss the panel; the true ones meet it, at another range than the stated one."""
    flight = jl.Trajectory([0.0, 1.0], [(0, 0, 60), (0, 0.2, 60)])
    strip = jl.Survey.fly(flight, jl.Conical(half_angle=1e-6, frequency=1.0), lidar=DRONE)
    scene = jl.Scene(meshes=[panel((-5.25, 0, 0.5), (0.1, 0, 1), size=1.0)], ground=GROUND)
    true = strip.disturbed(boresight=(5.0, 0.0, 0.0), range=1.0, key=jax.random.key(1))
    distance = 59.5 / np.cos(np.deg2rad(5.0)) + true.stated[:, 5]
    returns = labelled(true, scene, "mesh:panel", distance)
    assert np.abs(true.stated[:, 5]).min() > 0.16
    assert returns.instance.tolist() == [1, 1]
    np.testing.assert_allclose(returns.normal, np.tile([0.0995, 0, 0.995], (2, 1)), atol=1e-3)
    with pytest.warns(UserWarning, match="2 of 2 returns of surfaces"):
        assert labelled(strip, scene, "mesh:panel", distance).instance.tolist() == [0, 0]


def test_voxels_and_air_have_no_surface():
    voxels = jl.VoxelMap.from_lad(np.full((4, 4, 4), 1.0), voxel_size=1.0, origin=(-2, -2, 3))
    scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4)), ground=GROUND)
    names = ["leaf", "bark", "air", "noise", "ground"]
    returns = labelled(downwards([(0, 0)]), scene, names, [24.0, 25.0, 26.0, 27.0, 30.0], [0] * 5)
    assert not returns.instance.any()
    assert np.isnan(returns.incidence).tolist() == [True] * 4 + [False]
    assert returns.part.tolist() == [2, 3, 0, 0, 1]


# -- files and refusals ------------------------------------------------------------------------------------


def test_extra_bytes_have_the_labels(tmp_path):
    tree = panel((0, 0, 4), (0.5, 0, 1), name="leaf", shift=[(0, 0, 0)], instance=[12])
    scene = jl.Scene(meshes=[tree], ground=GROUND)
    returns = simulated(downwards([(0, 0), (9, 0)]), scene)
    returns.to_las(tmp_path / "a.laz")
    cloud = laspy.read(tmp_path / "a.laz")
    np.testing.assert_array_equal(cloud["instance"], [12, 0])
    np.testing.assert_array_equal(cloud["part"], [2, 1])
    np.testing.assert_allclose(cloud["incidence"], [np.rad2deg(np.arctan(0.5)), 0.0], atol=1e-3)
    normal = np.stack([cloud[f"normal {axis}"] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(normal, returns.normal, atol=1e-6)
    returns.to_las(tmp_path / "b.las", extra=False)
    assert not list(laspy.read(tmp_path / "b.las").point_format.extra_dimension_names)
    with jl.io.LasWriter(tmp_path / "c.las") as file:
        returns.to_las(file)
    np.testing.assert_array_equal(laspy.read(tmp_path / "c.las")["instance"], [12, 0])


def test_instances_are_read_as_they_were_written(tmp_path):
    corners = [(0, 0, 1), (1, 0, 1), (0, 1, 1), (1, 1, 1)]
    mesh = jl.Mesh(corners, [(0, 1, 2), (1, 3, 2)], instance=[5, 9])
    places = jl.MeshInstances([(0, 0, 0), (3, 0, 0)], instance=[2, 4])
    scene = jl.Scene(meshes=[jl.MeshSurface(mesh), jl.MeshSurface(mesh, instances=places)])
    jl.io.write_case(tmp_path / "a.toml", jl.io.Case(scene=scene))
    first, second = jl.io.read_case(tmp_path / "a.toml").scene.meshes
    assert dict(zip(map(tuple, first.faces.tolist()), first.instance.tolist())) == {
        (0, 1, 2): 5,
        (1, 3, 2): 9,
    }
    assert second.instances.instance.tolist() == [2, 4]


CORNERS, FACES = [(0, 0, 1), (1, 0, 1), (0, 1, 1)], [(0, 1, 2)]
RETURNS = labelled(downwards([(0, 0)]), jl.Scene(ground=GROUND), "ground", [30.0])


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: jl.MeshInstances([(0, 0, 0)], instance=[1.5]), TypeError, "instance is an array of float64"),
        (
            lambda: jl.MeshInstances([(0, 0, 0)], instance=[-1]),
            ValueError,
            r"instance = -1 .*\[0, 16777216\]",
        ),
        (lambda: jl.MeshInstances([(0, 0, 0)], instance=[1, 2]), ValueError, r"instance has shape \(2,\)"),
        (lambda: jl.Mesh(CORNERS, FACES, instance=[1, 2]), ValueError, r"instance has shape \(2,\)"),
        (lambda: jl.Mesh(CORNERS, FACES, instance=["oak"]), TypeError, "instance is an array of"),
        (
            lambda: RETURNS.labelled(downwards([(0, 0), (1, 0)]), jl.Scene(ground=GROUND)),
            ValueError,
            "survey has 2 shots; admissible is that of the returns, 1",
        ),
        (lambda: RETURNS.labelled(DRONE, jl.Scene(ground=GROUND)), TypeError, "survey"),
        (
            lambda: RETURNS.labelled(downwards([(0, 0)]), jl.SceneParts(lambda low, high: None, z=(0, 1))),
            TypeError,
            "scene",
        ),
        (lambda: RETURNS.to_las("a.las", extra="none"), TypeError, "extra"),
    ],
)
def test_inadmissible_input_is_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()


@pytest.mark.slow
def test_another_survey_or_scene_is_warned_of():
    """Returns whose surfaces are not met are counted; those of the survey itself are all met."""
    survey = jl.Survey.grid(jl.Lidar(altitude=300.0, **SHARP), (-4, 0), (4, 0), 2.0)
    scene = jl.Scene(meshes=[panel((0.0, 0.0, 4.0), (0, 0, 1), size=4.5)], ground=GROUND)
    true = survey.disturbed(range=3.0, key=jax.random.key(1))
    returns = jl.simulate_many(true, scene, key=jax.random.key(0), max_orders=1, rtol=0.05).returns()
    assert np.isfinite(returns.labelled(true, scene).incidence).all()
    for other in ((survey, scene), (true, jl.Scene(ground=jl.Ground(height=-50.0)))):
        with pytest.warns(UserWarning, match="5 returns of surfaces lie where no ray meets one"):
            returns.labelled(*other)
