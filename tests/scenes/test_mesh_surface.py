"""Meshes as surfaces: rays against an independent intersector, instances, plans, refused input."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxlidar as jl
from jaxlidar._vectors import FAR, vec
from jaxlidar.scenes.mesh_surface import build_mesh_tree
from jaxlidar.scenes.scene import check_kinds
from tests.helpers import BY_PRECISION

CORNERS = np.array([[-5.0, -5, 6], [5, -5, 6], [5, 5, 6], [-5, 5, 6]])
ROOF = (CORNERS, np.array([[0, 1, 2], [0, 2, 3]]))


def meet(surfaces, x, w):
    """Return distances and normals of the triangles that rays meet first."""
    hit = jax.jit(lambda s, x, w: build_mesh_tree(s).meet(vec(x.T), vec(w.T)))(
        tuple(surfaces), jnp.asarray(x, float), jnp.asarray(w, float)
    )
    return np.asarray(hit.distance, float), np.stack(hit.normal, axis=-1)


def directions(count, random):
    w = random.normal(size=(count, 3))
    return w / np.linalg.norm(w, axis=1, keepdims=True)


def nearest_by_all_pairs(corners, x, w):
    """Return distances by the algorithm of Moeller and Trumbore (1997), every ray with every triangle."""
    first, side, other = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    distances = np.full(len(x), FAR)
    for n, (start, direction) in enumerate(zip(x, w)):
        p = np.cross(direction, other)
        determinant = (side * p).sum(axis=1)
        safe = np.where(np.abs(determinant) > 1e-14, determinant, np.inf)
        offset = start - first
        u, q = (offset * p).sum(axis=1) / safe, np.cross(offset, side)
        v, t = (direction * q).sum(axis=1) / safe, (other * q).sum(axis=1) / safe
        met = t[(u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & np.isfinite(safe)]
        distances[n] = met.min(initial=FAR)
    return distances


def nearest_by_embree(mesh, x, w):
    """Return distances to the triangles that Embree finds first, computed from their planes in float64."""
    pytest.importorskip("embreex")
    number = mesh.ray.intersects_first(x, w)
    normal, corner = mesh.face_normals[number], mesh.triangles[number][:, 0]
    distance = ((corner - x) * normal).sum(axis=1) / (w * normal).sum(axis=1)
    return np.where(number < 0, FAR, distance)


@BY_PRECISION
def test_rays_agree_with_embree(precision):
    """10,000 rays through two bumpy spheres, one in the other: every ray from within meets a triangle."""
    random = np.random.default_rng(5)
    size = 8.0
    spheres = []
    for radius in (2.0, 0.5 * size):
        sphere = trimesh.creation.icosphere(subdivisions=3, radius=radius)
        sphere.vertices *= random.uniform(0.8, 1.0, (len(sphere.vertices), 1))
        spheres.append(sphere)
    mesh = trimesh.util.concatenate(spheres)
    x, w = random.uniform(-1.0, 1.0, (10_000, 3)), directions(10_000, random)
    # Half of the rays aim at points on edges.
    ends = mesh.vertices[mesh.edges_unique[random.integers(len(mesh.edges_unique), size=5_000)]]
    targets = ends[:, 0] + random.uniform(0, 1, (5_000, 1)) * (ends[:, 1] - ends[:, 0])
    w[:5_000] = targets - x[:5_000]
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    distance, _ = meet([jl.MeshSurface(mesh)], x, w)
    assert np.all(distance < FAR)
    expected = nearest_by_embree(mesh, x, w)
    wrong = np.abs(distance - expected) > 1e-5 * size
    # Rays that aim at the outline of a bump meet it or pass it within rounding.
    assert not wrong[5_000:].any()
    assert wrong.sum() <= 5
    assert np.mean(np.abs(np.roll(distance, 1) - expected) > 1e-5 * size) > 0.9


@BY_PRECISION
def test_rays_meet_the_nearest_triangle(precision):
    random = np.random.default_rng(0)
    corners = random.uniform(-5, 5, (300, 1, 3)) + random.normal(0.0, 0.8, (300, 3, 3))
    x, w = random.uniform(-8, 8, (10_000, 3)), directions(10_000, random)
    surface = jl.MeshSurface((corners.reshape(-1, 3), np.arange(900).reshape(-1, 3)))
    distance, normal = meet([surface], x, w)
    expected = nearest_by_all_pairs(corners, x, w)
    is_met = expected < FAR
    assert 0.2 < is_met.mean() < 0.9
    # A ray may pass an edge within rounding.
    differs = (distance < FAR) != is_met
    assert differs.sum() <= 2
    both = is_met & ~differs
    tolerance = 1e-5 if precision == "float32" else 1e-10
    wrong = np.abs(distance - expected)[both] > tolerance * np.maximum(expected[both], 1.0)
    # Grazing rays magnify the rounding of their position.
    cosine = np.abs((normal * w).sum(axis=1))[both]
    assert not wrong[cosine > 0.05].any()
    assert wrong.sum() <= 5
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-6)


@BY_PRECISION
def test_no_ray_slips_through_edges_or_corners(precision):
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=2.0)
    sphere.apply_translation([0.3, -0.2, 0.1])
    random = np.random.default_rng(1)
    on_edge = sphere.vertices[sphere.edges_unique]
    fraction = random.uniform(0, 1, (len(on_edge), 1))
    targets = np.concatenate([sphere.vertices, fraction * on_edge[:, 0] + (1 - fraction) * on_edge[:, 1]])
    for start in ([0.3, -0.2, 0.1], [1.1, 0.4, -0.6]):
        w = targets - start
        w /= np.linalg.norm(w, axis=1, keepdims=True)
        distance, _ = meet([jl.MeshSurface(sphere)], np.broadcast_to(start, w.shape), w)
        assert np.all(distance < 5.0)


def test_no_ray_from_far_away_slips_through_edges_or_corners():
    """Triangles of some centimetres, from 400 m away, with rays in single precision."""
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=2.0)
    random = np.random.default_rng(3)
    on_edge = sphere.vertices[sphere.edges_unique]
    fraction = random.uniform(0, 1, (len(on_edge), 1))
    targets = np.concatenate([sphere.vertices, fraction * on_edge[:, 0] + (1 - fraction) * on_edge[:, 1]])
    for start in ([300.0, 200.0, 150.0], [-90.0, 20.0, 400.0]):
        w = targets - start
        w /= np.linalg.norm(w, axis=1, keepdims=True)
        # Rays that graze the sphere may pass beside it.
        w = w[(targets * -w).sum(axis=1) > 0.1]
        distance, _ = meet([jl.MeshSurface(sphere)], np.broadcast_to(start, w.shape), w)
        assert np.all(distance < np.linalg.norm(start))


def test_instances_are_scaled_rotated_and_shifted_copies():
    random = np.random.default_rng(2)
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=1.0)
    mesh.vertices[:, 0] *= 2.0
    shift, angle, scale = (
        random.uniform(-6, 6, (5, 3)),
        random.uniform(0, 360, 5),
        random.uniform(0.3, 1.5, 5),
    )
    instances = jl.MeshInstances(shift, angle, scale)
    copies = []
    for d, a, s in zip(shift, np.deg2rad(angle), scale):
        # Clockwise from above: an azimuth.
        turn = np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1]])
        copies.append(s * mesh.vertices @ turn.T + d)
    x, w = random.uniform(-8, 8, (2000, 3)), directions(2000, random)
    distance, _ = meet([jl.MeshSurface(mesh, instances=instances)], x, w)
    corners = np.concatenate([c[mesh.faces] for c in copies])
    expected = nearest_by_all_pairs(corners, x, w)
    same = (distance < FAR) == (expected < FAR)
    assert (~same).sum() <= 2
    np.testing.assert_allclose(distance[same], expected[same], rtol=1e-4, atol=1e-5)
    low = jl.MeshSurface(mesh, instances=instances).bounds().min(axis=(0, 1))
    assert np.all(low <= corners.min(axis=(0, 1)) + 1e-6)
    # A rotation vector along the downward axis is the same turn.
    vectors = jl.MeshInstances(shift, np.outer(angle, [0, 0, -1]), scale)
    np.testing.assert_allclose(vectors.matrices(), instances.matrices(), atol=1e-6)


@pytest.mark.slow
@BY_PRECISION
def test_rays_meet_meshes_that_repeat(precision):
    """The nearest of explicit copies, by Embree; two of the instances cross sides, one a corner."""
    pytest.importorskip("embreex")
    random = np.random.default_rng(3)
    mesh = trimesh.creation.icosphere(subdivisions=1)
    shift = [[4.0, 3.0, 0.0], [8.9, 2.0, 2.0], [-14.0, 13.8, 3.0], [8.5, 0.2, 5.0]]
    instances = jl.MeshInstances(shift, [0, 30, 60, 90], [1.0, 0.5, 1.5, 0.8])
    surface, period = jl.MeshSurface(mesh, instances=instances), np.array([9.0, 7.0])
    x = np.c_[random.uniform(-30, 30, (3000, 2)), random.uniform(-5, 14, 3000)]
    w = directions(3000, random)
    # Along axes, and along the sides of a cell.
    w[:300], w[300:400], x[400:450, 0] = [0, 0, -1], [1, 0, 0], 9.0
    w[400:450] = [0, 0.6, -0.8]
    tree = jax.jit(lambda s, p, x, w: build_mesh_tree(s, p).meet(vec(x.T), vec(w.T)))
    hit = tree((surface,), jnp.asarray(period, float), jnp.asarray(x, float), jnp.asarray(w, float))
    steps = np.stack(np.meshgrid(*[np.arange(-12, 13)] * 2), axis=-1).reshape(-1, 2) * period
    corners = surface.corners() + np.pad(steps, ((0, 0), (0, 1)))[:, None, None, None]
    copies = trimesh.Trimesh(**trimesh.triangles.to_kwargs(corners.reshape(-1, 3, 3)), process=False)
    place, ray, _ = copies.ray.intersects_location(x, w, multiple_hits=False)
    expected = np.full(len(x), FAR)
    expected[ray] = np.linalg.norm(place - x[ray], axis=1)
    # Beyond, there are no explicit copies.
    near = np.minimum(hit.distance, expected) < 50.0
    assert near.sum() > 400
    tolerance = 2e-4 if precision == "float32" else 1e-5
    wrong = np.abs(np.asarray(hit.distance) - expected)[near] > tolerance
    # Rays may pass the outline of a sphere within rounding.
    assert wrong.sum() <= 2
    # Without copies most of these rays meet nothing, or a triangle farther away.
    alone, _ = meet([surface], x, w)
    assert np.mean(np.abs(alone - expected)[near] > 1.0) > 0.5


def test_one_sided_triangles_are_passed_from_behind():
    x = np.array([[0.0, 1, 9], [0, 1, 1]])
    w = np.array([[0.0, 0, -1], [0, 0, 1]])
    for two_sided, expected in ((True, [3.0, 5.0]), (False, [3.0, FAR])):
        distance, _ = meet([jl.MeshSurface(ROOF, two_sided=two_sided)], x, w)
        np.testing.assert_allclose(distance, expected, rtol=1e-6)


def test_map_coordinates_lose_nothing():
    """A mesh at coordinates of millions of metres, moved to the aim point."""
    far_away = np.array([651_234.567, 5_412_345.678])
    surface = jl.MeshSurface((CORNERS + np.append(far_away, 0.0), ROOF[1])).moved(-far_away)
    distance, _ = meet([surface], [[4.999, 4.999, 10.0], [5.001, 0.0, 10.0]], [[0, 0, -1.0]] * 2)
    np.testing.assert_allclose(distance, [4.0, FAR], rtol=1e-5)


def test_meshes_out_of_reach_are_left_out():
    lidar = jl.Lidar(divergence=1.0)
    aside = jl.MeshSurface(ROOF, instances=jl.MeshInstances([[30.0, 0, 0]]))
    scene = jl.Scene(meshes=(aside,), ground=jl.Ground())

    def row(plan):
        return {effect.name: effect for effect in plan.effects}["meshes"]

    plan = jl.plan(lidar, scene, max_orders=1)
    assert plan.off == ("meshes",)
    assert (row(plan).simulated, row(plan).reason) == (False, "met by no ray of order one")
    # Light of higher orders may come there, and the user may ask for it.
    assert row(jl.plan(lidar, scene)).simulated
    assert row(jl.plan(lidar, scene, max_orders=1, effects={"meshes": True})).simulated
    near = dataclasses.replace(scene, meshes=(jl.MeshSurface(ROOF),))
    with pytest.raises(ValueError, match="does not fit: it is for meshes that no ray meets"):
        jl.simulate(lidar, near, plan=plan, key=jax.random.key(0))
    off = jl.plan(lidar, near, effects={"meshes": False}, max_orders=1)
    assert (row(off).simulated, row(off).reason) == (False, "switched off")
    # A wire between the lines of a footprint is in reach.
    wire = jl.MeshSurface((CORNERS * [1.0, 0.002, 1.0] + [0.0, 0.2, 0.0], ROOF[1]))
    assert row(jl.plan(lidar, jl.Scene(meshes=(wire,)), max_orders=1)).simulated


def test_plans_predict_memory_linear_in_triangles():
    def memory(subdivisions, count=1):
        sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
        instances = jl.MeshInstances(np.zeros((count, 3)))
        scene = jl.Scene(meshes=(jl.MeshSurface(sphere, instances=instances),))
        return jl.plan(jl.Lidar(), scene, max_orders=1, describe=False).memory

    small, large = memory(1), memory(6)
    per_triangle = (large - small) / (131072 - 128)
    assert 100 < per_triangle < 400
    # An instance costs its transformation.
    assert (memory(1, 1024) - small) / 1024 < 400


@pytest.mark.parametrize(
    ("arguments", "error", "says"),
    [
        (
            {"mesh": "roof.obj"},
            TypeError,
            "mesh is a str; admissible is a Mesh, a trimesh.Trimesh, or a tuple",
        ),
        ({"mesh": (CORNERS, np.array([[0, 1, 9]]))}, ValueError, r"faces = 9 .* \[0, 3\]"),
        ({"mesh": (CORNERS, np.array([[0.0, 1, 2]]))}, TypeError, "faces is an array of float64"),
        ({"mesh": (CORNERS[:, :2], ROOF[1])}, ValueError, r"vertices has shape \(4, 2\)"),
        ({"mesh": (CORNERS * np.nan, ROOF[1])}, ValueError, "vertices"),
        ({"mesh": (CORNERS, np.array([[0, 1, 1]]))}, ValueError, "no triangle with an area"),
        ({"reflectance": 1.2}, ValueError, "reflectance = 1.2"),
        ({"reflectance": 0.6, "transmittance": 0.6}, ValueError, r"reflectance \+ transmittance = 1.2"),
        ({"reflectance": {"tile": 0.2}}, ValueError, "'tile' is no material of the mesh; it has mesh"),
        ({"transmittance": {}, "reflectance": {}}, ValueError, "reflectance has no 'mesh'"),
        ({"law": jl.Specular(roughness=0.1)}, ValueError, "law is a mirror"),
    ],
)
def test_inadmissible_surfaces_are_refused(arguments, error, says):
    with pytest.raises(error, match=says):
        jl.MeshSurface(**({"mesh": ROOF} | arguments))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"shift": [0.0, 0, 0]}, r"shift has shape \(3,\); admissible is \(n, 3\)"),
        ({"shift": [[0.0, 0, np.inf]]}, "shift"),
        ({"shift": [[0.0, 0, 0]], "rotation": [0.0, 1.0]}, "rotation has shape"),
        ({"shift": [[0.0, 0, 0]], "scale": [0.0]}, r"scale = 0.* \(0, inf\)"),
    ],
)
def test_inadmissible_instances_are_refused(arguments, says):
    with pytest.raises(ValueError, match=says):
        jl.MeshInstances(**arguments)


PLACE = np.array([500_000.0, 5_400_000.0, 0.0])


@pytest.mark.parametrize("arguments", [{"rotation": [30]}, {"rotation": [0.1]}, {"scale": [1.01]}])
def test_meshes_on_maps_are_not_rotated_about_the_origin_of_the_map(arguments):
    on_map = (CORNERS + PLACE, ROOF[1])
    with pytest.raises(ValueError, match=r"instances: number 0 is rotated or scaled .* from \[500"):
        jl.MeshSurface(on_map, instances=jl.MeshInstances([[0.0, 0, 0]], **arguments))
    # In coordinates of its own, or with the shift that rotates it about another point, it stays.
    local = jl.MeshSurface(ROOF, instances=jl.MeshInstances([PLACE], **arguments))
    matrix = np.asarray(jl.MeshInstances([[0.0, 0, 0]], **arguments).matrices()[0], float)
    shift = PLACE - matrix @ PLACE
    same = jl.MeshSurface(on_map, instances=jl.MeshInstances([shift], **arguments))
    np.testing.assert_allclose(local.bounds().mean(axis=1), [[*PLACE[:2], 6 * matrix[2, 2]]])
    np.testing.assert_allclose(same.bounds(), local.bounds(), rtol=0, atol=1.0)
    jl.MeshSurface(on_map, instances=jl.MeshInstances([[7.0, 8.0, 1.0], PLACE]))


def test_small_meshes_beside_their_origin_are_rotated_about_it():
    """A leaf of 5 cm at the top of its tree."""
    leaf = (0.005 * CORNERS + np.array([3.0, 0.0, 20.0]), ROOF[1])
    instances = jl.MeshInstances([[0.0, 0, 0]], rotation=[90])
    middle = jl.MeshSurface(leaf, instances=instances).bounds().mean(axis=1)
    np.testing.assert_allclose(middle, [[0.0, -3.0, 20.03]], atol=1e-5)


def test_units_of_a_trimesh():
    box = trimesh.creation.box(bounds=[[0, 0, 0], [2000, 1000, 500]])
    box.units = "mm"
    np.testing.assert_allclose(jl.MeshSurface(box).bounds(), [[[0, 0, 0], [2, 1, 0.5]]], rtol=1e-6)
    assert box.units == "mm"
    assert box.extents.max() == 2000.0
    box.units = "ells"
    with pytest.raises(ValueError, match="ells"):
        jl.MeshSurface(box)


def test_scenes_refuse_what_meshes_do_not_go_with():
    surface = jl.MeshSurface(ROOF)
    voxels = jl.VoxelMap.from_lad(np.ones((2, 2, 2)), voxel_size=1.0)
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4), sides="periodic")
    too_wide = r"meshes\[0\]: instance 0 is 10 m wide along x; .* at most the period, {} m"
    with pytest.raises(ValueError, match=too_wide.format(2)):
        jl.Scene(canopy=canopy, meshes=(surface,))
    terrain = jl.Terrain(np.random.default_rng(0).uniform(size=(4, 4)), 1.0, sides="periodic")
    with pytest.raises(ValueError, match=too_wide.format(4)):
        jl.Scene(ground=terrain, meshes=(surface,))
    with pytest.raises(TypeError, match="one of meshes is a tuple"):
        jl.Scene(meshes=(ROOF,))
    with pytest.raises(TypeError, match="scene is a MeshSurface; admissible is a Scene, as in"):
        check_kinds(jl.Lidar(), surface)
    with pytest.raises(TypeError, match="mesh is being traced"):
        jax.jit(lambda v: jl.MeshSurface((v, ROOF[1])).vertices)(CORNERS)


def test_case_files_hold_meshes(tmp_path):
    """Exactly: materials, optics by material, one of them a spectrum, and instances."""
    mesh = jl.Mesh(CORNERS + np.array([651_234.5, 0.25, 0.0]), ROOF[1], [1, 0], ["tile", "glass"])
    shifts = jl.MeshInstances([[0.1, 0.2, 5_412_345.678], [1.0, 2.0, 3.0]])
    instances = jl.MeshInstances([[0.1, 0.2, 5_412_345.678], [1.0, 2.0, 3.0]], [10, 20], [1.0, 0.3])
    reflectance = {"tile": jl.spectrum("soil-medium"), "glass": 0.1}
    meshes = (
        jl.MeshSurface(mesh, reflectance, {"glass": 0.8}, two_sided=False, instances=shifts),
        jl.MeshSurface(ROOF, 0.25, instances=instances),
    )
    path = tmp_path / "roof.toml"
    jl.io.write_case(path, jl.io.Case(scene=jl.Scene(meshes=meshes)))
    copies = jl.io.read_case(path).scene.meshes
    for copy, original in zip(copies, meshes, strict=True):
        assert jax.tree.structure(copy) == jax.tree.structure(original)
        np.testing.assert_array_equal(copy.corners(), original.corners())
        for a, b in zip(jax.tree.leaves(copy.instances), jax.tree.leaves(original.instances), strict=True):
            np.testing.assert_array_equal(a, b)
        assert copy.group.tolist() == original.group.tolist()
    assert float(copies[0].reflectance["glass"]) == np.float32(0.1)


def test_case_files_name_files_of_meshes(tmp_path):
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS]
    (tmp_path / "roof.obj").write_text("\n".join([*lines, "usemtl tile", "f 1 2 3", "f 1 3 4"]))
    (tmp_path / "case.toml").write_text(
        """
        [[scene.meshes]]
        mesh = {kind = "read_mesh", path = "roof.obj"}
        reflectance = {tile = 0.4}
        instances = {shift = [[0.0, 0.0, 1.0], [20.0, 0.0, 0.0]]}
        """
    )
    (surface,) = jl.io.read_case(tmp_path / "case.toml").scene.meshes
    assert surface.materials == ("tile",)
    assert surface.bounds()[:, 1].tolist() == [[5.0, 5.0, 7.0], [25.0, 5.0, 6.0]]


def panel(*more):
    """Return a panel of 4 cm, and further triangles of 1 m at the given distances to the east."""
    half = 0.02
    corners = [[-half, -half, 5], [half, -half, 5], [half, half, 5], [-half, half, 5]]
    faces = [[0, 1, 2], [0, 2, 3]]
    for x in more:
        faces.append([len(corners), len(corners) + 1, len(corners) + 2])
        corners += [[x, 0, 0], [x + 1, 0, 0], [x, 1, 0]]
    return np.array(corners, float), np.array(faces)


def test_triangles_that_rounding_would_distort_are_refused():
    if jnp.zeros(()).dtype == jnp.float64:
        jl.MeshSurface(panel(2e5))
        return
    with pytest.raises(ValueError, match=r"2 triangles are rounded.*0.0566 m.*split the mesh"):
        jl.MeshSurface(panel(2e5))
    # The panel alone, anywhere; a mesh of the same size without small triangles; one that is not so wide.
    corners, faces = panel()
    jl.MeshSurface((corners + np.array([5e5, 6e6, 0.0]), faces))
    jl.MeshSurface((np.array([[0.0, 0, 0], [2e5, 0, 0], [2e5, 2e5, 0]]), [[0, 1, 2]]))
    jl.MeshSurface(panel(1e3))


def test_the_largest_rounding_that_is_admitted_keeps_the_area():
    corners, faces = panel(9e3)
    placed = jl.MeshSurface((corners, faces)).corners()
    area = 0.5 * np.linalg.norm(np.cross(*(placed[:, k] - placed[:, 0] for k in (1, 2))), axis=1)
    assert np.sort(area)[:2].sum() == pytest.approx(0.04**2, rel=0.02)


def test_instances_magnify_the_rounding_of_corners():
    if jnp.zeros(()).dtype == jnp.float64:
        pytest.skip("double precision")
    corners, faces = panel(2e3)
    corners[:4] *= 0.05
    jl.MeshSurface((corners, faces))
    with pytest.raises(ValueError, match=r"2 triangles are rounded.*0.00283 m.*split the mesh"):
        jl.MeshSurface((corners, faces), instances=jl.MeshInstances([[0.0, 0, 0]], scale=[10.0]))


def needles(size, pitch=3.0, count=40):
    """Corners of `count`^2 equilateral triangles, which stand apart, and the width of their field, m."""
    random, width = np.random.default_rng(0), count * pitch * size
    centre = np.stack(np.meshgrid(*[np.arange(count) * pitch * size] * 2, indexing="ij"), axis=-1).reshape(
        -1, 2
    )
    angle = random.uniform(0.0, 2.0 * np.pi, len(centre))[:, None] + np.deg2rad([0.0, 120.0, 240.0])
    level = centre[:, None] + size / np.sqrt(3.0) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([level, size * random.uniform(-0.2, 0.2, (*angle.shape, 1))], axis=-1), width


@pytest.mark.parametrize(
    ("size", "distance", "zenith", "far"),
    [
        (1e-3, 300.0, 0.0, 0.0),
        (5e-3, 300.0, 0.0, 0.0),
        (1e-3, 30.0, 60.0, 0.0),
        (5e-3, 300.0, 60.0, 0.0),
        (1e-3, 100.0, 0.0, 200.0),
        (1e-3, 100.0, 0.0, 1e3),
    ],
)
def test_small_triangles_that_stand_apart_keep_their_area(size, distance, zenith, far):
    """Millimetres, from hundreds of metres away, in a mesh whose middle is `far` m away.

    With `far` = 0 they are an instance that is 50 km away from the other one.
    """
    corners, width = needles(size)
    theta, count = np.deg2rad(zenith), 100_000
    w = np.array([0.6 * np.sin(theta), 0.8 * np.sin(theta), -np.cos(theta)])
    normal = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    covered = np.abs(normal @ w).sum() / (width**2 * np.cos(theta))
    if far:
        corners = np.concatenate([corners, [[[2 * far, 0, 0], [2 * far + 1, 0, 0], [2 * far, 1, 0]]]])
    shift = np.array([[5e4, 2e4, 0.0], [0.0, 0.0, 0.0]]) if not far else np.zeros((1, 3))
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    mesh = jl.MeshSurface((corners.reshape(-1, 3), faces), instances=jl.MeshInstances(shift))
    target = np.random.default_rng(1).uniform(-1.5 * size, width - 1.5 * size, (count, 2))
    x = np.c_[target, np.zeros(count)] - distance * w
    distances, _ = meet([mesh.moved(-shift[0, :2])], x, np.broadcast_to(w, x.shape))
    met, stderr = np.mean(distances < FAR), np.sqrt(covered * (1.0 - covered) / count)
    assert abs(met - covered) < 4.0 * stderr
