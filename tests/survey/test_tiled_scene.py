"""Tiled scenes: the same waveforms as of the untiled scene, from rectangles of one size."""

import functools
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.survey.tiled_scene import lossless_margin, tiles_of
from tests.survey.test_simulate_many import stored_shots

SIDE, TALL = 48, 6
LEAF = jl.LeafOptics(0.5, 0.45)
DENSITY = np.where(np.random.default_rng(0).uniform(size=(SIDE, SIDE, TALL)) < 0.5, 1.2, 0.0)


class Forest:
    """The function `part` of a forest whose south-west corner is at `origin`."""

    def __init__(self, origin=(0.0, 0.0), density=DENSITY):
        self.origin, self.density = np.asarray(origin), density

    def __call__(self, low, high):
        first = np.clip(np.floor(low - self.origin), 0, SIDE - 1).astype(int)
        last = np.clip(np.ceil(high - self.origin), 1, SIDE).astype(int)
        density = self.density[first[0] : last[0], first[1] : last[1]]
        voxels = jl.VoxelMap.from_lad(density, voxel_size=1.0, origin=(*(self.origin + first), 0.0))
        canopy = jl.Canopy(voxels, leaf=LEAF, hotspot=False) if density.any() else None
        return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.4))

    def untiled(self):
        return self(self.origin, self.origin + SIDE)

    # The fingerprint of a survey includes its function by pickle: forests of the same density are the same.
    def __reduce__(self):
        return Forest, (tuple(self.origin), self.density)


def survey(origin=(0.0, 0.0), zenith=0.0) -> jl.Survey:
    lidar = jl.Lidar(altitude=500.0, divergence=4.0, pulse=jl.GaussianPulse(fwhm=4.0), zenith=zenith)
    return jl.Survey(lidar, np.add(origin, [(12, 12), (13, 14), (36, 13), (20, 35), (34, 36), (35, 35)]))


def tiled(forest, **options) -> jl.SceneParts:
    return jl.SceneParts(forest, z=(0.0, TALL), tile=20.0, **options)


def simulate_forest(scene, seed=0, **options):
    options = {"rtol": 0.05, "shared": False, **options}
    return jl.simulate_many(options.pop("survey", survey()), scene, key=jax.random.key(seed), **options)


def z_of_late_light(a, b) -> np.ndarray:
    """Compare the light after the first return of two surveys, shot by shot, in standard errors."""
    late = slice(3 * a.time.size // 5, None)
    light = (m.components["higher"][..., late].sum(axis=(1, 2)) for m in (a, b))
    # Errors of the samples of one shot are not independent. Their sum is an upper bound.
    errors = (m.stderr[..., late].sum(axis=(1, 2)) for m in (a, b))
    return np.subtract(*light) / np.hypot(*errors)


@pytest.fixture(scope="module")
def untiled_and_tiled() -> tuple[jl.Waveforms, jl.Waveforms]:
    """Simulate the untiled and the tiled forest at first order, with the truth."""
    scenes = (Forest().untiled(), tiled(Forest()))
    untiled, in_tiles = (simulate_forest(scene, max_orders=1, truth=True) for scene in scenes)
    return untiled, in_tiles


@pytest.mark.slow
def test_the_same_waveforms_as_of_the_untiled_scene_at_first_order(untiled_and_tiled):
    untiled, in_tiles = untiled_and_tiled
    np.testing.assert_array_equal(untiled.time, in_tiles.time)
    np.testing.assert_array_equal(untiled.ground_height, in_tiles.ground_height)
    np.testing.assert_array_equal(in_tiles.position, survey().position)
    z = (untiled.reflectance - in_tiles.reflectance) / np.hypot(untiled.stderr, in_tiles.stderr).max()
    assert np.abs(z).max() < 4
    assert not np.allclose(in_tiles.reflectance[0], in_tiles.reflectance[2], rtol=0.05)
    assert (in_tiles.info["parts"], in_tiles.info["margin"]) == (3, 0.0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::jaxlidar.LateLightWarning")
def test_the_default_margin_loses_no_light_and_a_small_one_does():
    orders = {"rtol": 0.02, "max_orders": 30}
    untiled = simulate_forest(Forest().untiled(), **orders)
    in_tiles = simulate_forest(tiled(Forest()), seed=1, **orders)
    assert in_tiles.info["margin"] == in_tiles.info["margin of all light"] > 10
    assert np.abs(z_of_late_light(untiled, in_tiles)).max() < 3
    assert np.abs(np.mean(z_of_late_light(untiled, in_tiles))) < 0.75
    narrow = simulate_forest(jl.SceneParts(Forest(), z=(0.0, TALL), tile=1.0, margin=0.0), **orders)
    assert narrow.info["margin"] == 0.0 < narrow.info["margin of all light"]
    # Through the cut sides of the tile light enters and leaves that the forest around would attenuate.
    assert np.mean(z_of_late_light(narrow, untiled)) > 1.5


def test_rectangles_have_one_size_and_hold_all_light():
    for zenith in (0.0, 30.0):
        shots, scene = survey(zenith=zenith), tiled(Forest())
        for margin in (0.0, 7.0):
            tiles = tiles_of(shots, scene, margin)
            assert sorted(np.concatenate([s.shots for s in tiles])) == list(range(len(shots)))
            sizes = np.array([s.high - s.low for s in tiles])
            np.testing.assert_allclose(sizes, sizes[0, 0])
            for tile in tiles:
                for z in scene.z:
                    axis = shots.direction[tile.shots]
                    centre = shots.position[tile.shots] + z * axis[:, :2] / axis[:, 2:]
                    extent = shots.footprint_radius[tile.shots, None] + margin
                    assert np.all(centre - extent >= tile.low)
                    assert np.all(centre + extent <= tile.high)


def test_light_beyond_the_lossless_margin_returns_after_the_record():
    """The shortest path over two random points farther apart than the bound ends after the record."""
    random = np.random.default_rng(2)
    for zenith in (0.0, 20.0, 50.0):
        shots = survey(zenith=zenith)
        w, longest, top = shots.direction[0], 60.0, 10.0
        bound = lossless_margin(shots, longest, top)
        z = random.uniform(0, top, (20_000, 2))
        azimuth, separation = random.uniform(0, 2 * np.pi, 20_000), bound * random.uniform(0.5, 1.5, 20_000)
        first = z[:, :1] / w[2] * w
        second = first + np.c_[separation * np.cos(azimuth), separation * np.sin(azimuth), z[:, 1] - z[:, 0]]
        path = first @ w + np.linalg.norm(second - first, axis=1) + second @ w
        assert path[separation > bound].min() >= longest
        # The bound is tight: in the worst direction, light from 0.7 of it returns in time.
        assert separation[path < longest].max() > 0.7 * bound


@pytest.mark.slow
def test_an_interrupted_run_continues_with_the_same_results(tmp_path):
    path = tmp_path / "many.zarr"

    def interrupt(progress):
        if progress.done < 6:
            raise KeyboardInterrupt

    options = {"max_orders": 1, "path": path}
    with pytest.raises(KeyboardInterrupt):
        simulate_forest(tiled(Forest()), progress=interrupt, **options)
    assert 0 < len(stored_shots(path)) < len(survey())
    continued = simulate_forest(tiled(Forest()), **options)
    with ThreadPoolExecutor(2) as executor:
        uninterrupted = simulate_forest(tiled(Forest()), max_orders=1, executor=executor)
    for name in ("reflectance", "stderr", "ground_height"):
        np.testing.assert_array_equal(getattr(continued, name), getattr(uninterrupted, name))
    with pytest.raises(ValueError, match="scene"):
        simulate_forest(tiled(Forest(density=0.9 * DENSITY)), **options)


@pytest.mark.slow
def test_coordinates_of_millions_of_metres_change_nothing_and_bare_tiles_have_all_materials():
    density = DENSITY.copy()
    density[:26, :26] = 0.0
    options = {"max_orders": 1, "truth": True}
    near, distant = (
        simulate_forest(tiled(Forest(origin, density), margin=0.0), survey=survey(origin), **options)
        for origin in ((0.0, 0.0), (400_000.0, 5_000_000.0))
    )
    np.testing.assert_allclose(near.reflectance, distant.reflectance, atol=1e-6)
    for leaf in (near.components["leaf"], near.truth.returns["leaf"]):
        assert float(leaf[0].max()) == 0.0 < float(leaf[5].max())
    total = sum(v[0] for v in near.energy_budget.values())
    np.testing.assert_allclose(total, 1.0, atol=1e-5)


@pytest.mark.slow
def test_the_truth_is_that_of_the_untiled_scene(untiled_and_tiled, tmp_path):
    """In memory and from a file, in the survey's order."""
    untiled, in_tiles = untiled_and_tiled
    from_file = simulate_forest(tiled(Forest()), max_orders=1, truth=True, path=tmp_path / "many.zarr")
    compare = functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=2e-5)
    for truth in (in_tiles.truth, from_file.truth):
        assert set(truth.returns) == set(untiled.truth.returns) == {"leaf", "ground"}
        for name, expected in vars(untiled.truth).items():
            jax.tree.map(compare, getattr(truth, name), expected)
    assert float(in_tiles[3].truth.surface_height["ground"]) == pytest.approx(0.0, abs=1e-6)


def test_inadmissible_input_is_refused_before_any_work():
    with pytest.raises(TypeError, match="part"):
        jl.SceneParts(3, z=(0, 1))  # pyright: ignore[reportArgumentType]
    for z in ((1.0, 0.0), (0.0, np.inf), (0.0,)):
        with pytest.raises(ValueError, match="z = "):
            jl.SceneParts(Forest(), z=z)
    with pytest.raises(ValueError, match="tile"):
        jl.SceneParts(Forest(), z=(0, 1), tile=0.0)
    with pytest.raises(ValueError, match="margin"):
        jl.SceneParts(Forest(), z=(0, 1), margin=-1.0)
    with pytest.raises(TypeError, match=r"part\(\[.*a Scene"):
        simulate_forest(jl.SceneParts(lambda low, high: None, z=(0, 1)))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"voxels from 0 m to 6 m; admissible is z = \(0.0, 5.0\)"):
        simulate_forest(jl.SceneParts(Forest(), z=(0, 5)))
    with pytest.raises(TypeError, match="Scene"):
        jl.simulate(jl.Lidar(), tiled(Forest()), key=jax.random.key(0))  # pyright: ignore[reportArgumentType]


class Street:
    """A function of parts: a house in the rectangle of each tile, over ground."""

    def __init__(self, top=6.0):
        self.top = top

    def __call__(self, low, high):
        corners = np.array([[10.0, 10, 0], [14, 10, 0], [14, 16, 0], [10, 16, 0]])
        corners[:, 2] = self.top
        roof = (corners, [[0, 1, 2], [0, 2, 3]])
        centre = 20.0 * np.floor((low + high) / 40.0)
        house = jl.MeshSurface(roof, 0.6, instances=jl.MeshInstances([[*centre, 0.0]]))
        return jl.Scene(meshes=(house,), ground=jl.Ground(reflectance=0.3))


@pytest.mark.slow
def test_parts_may_have_meshes():
    shots = jl.Survey(
        jl.Lidar(altitude=500.0, divergence=1.0), position=[(12, 13), (32, 13), (12, 33), (36, 33)]
    )
    options = {"survey": shots, "max_orders": 1}
    many = simulate_forest(jl.SceneParts(Street(), z=(0.0, TALL), tile=20.0), **options)
    roofs, ground = (many.components[name].sum(axis=(1, 2)) for name in ("mesh", "ground"))
    np.testing.assert_allclose(roofs, [0.6, 0.6, 0.6, 0.0], atol=1e-3)
    np.testing.assert_allclose(ground, [0.0, 0.0, 0.0, 0.3], atol=1e-3)
    with pytest.raises(ValueError, match=r"has meshes from 60 m to 60 m; admissible is z"):
        simulate_forest(jl.SceneParts(Street(60.0), z=(0.0, TALL), tile=20.0), **options)
