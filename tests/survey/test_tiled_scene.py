"""Scenes larger than memory: tiles give the same waveforms as the complete scene, from equal rectangles."""

import functools
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.survey.tiled_scene import lossless_margin, tiles_of

SIDE, TALL = 48, 6
LEAF = jl.LeafOptics(0.5, 0.45)
DENSITY = np.where(np.random.default_rng(0).uniform(size=(SIDE, SIDE, TALL)) < 0.5, 1.2, 0.0)


class Forest:
    """Parts of a forest whose corner is at `origin`; `requests` are the rectangles asked for."""

    def __init__(self, origin=(0.0, 0.0), density=DENSITY):
        self.origin, self.density, self.requests = np.asarray(origin), density, []

    def __call__(self, low, high):
        self.requests.append((low, high))
        first = np.clip(np.floor(low - self.origin), 0, SIDE - 1).astype(int)
        last = np.clip(np.ceil(high - self.origin), 1, SIDE).astype(int)
        density = self.density[first[0] : last[0], first[1] : last[1]]
        voxels = jl.VoxelMap.from_lad(density, voxel_size=1.0, origin=(*(self.origin + first), 0.0))
        canopy = jl.Canopy(voxels, leaf=LEAF) if density.any() else None
        return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.4))

    def complete(self):
        return self(self.origin, self.origin + SIDE)

    # Pickled, and for digests, without its requests: two forests with the same density are the same.
    def __reduce__(self):
        return Forest, (tuple(self.origin), self.density)


def survey(origin=(0.0, 0.0), zenith=0.0) -> jl.Survey:
    lidar = jl.Lidar(altitude=500.0, divergence=4.0, pulse=jl.GaussianPulse(fwhm=4.0), zenith=zenith)
    return jl.Survey(lidar, np.add(origin, [(12, 12), (13, 14), (36, 13), (20, 35), (34, 36), (35, 35)]))


def scene_parts(forest, **options) -> jl.SceneParts:
    return jl.SceneParts(forest, z=(0.0, TALL), tile=20.0, **options)


def simulated(scene, seed=0, **options):
    options = {"rtol": 0.05, "shared": False, **options}
    return jl.simulate_many(options.pop("survey", survey()), scene, key=jax.random.key(seed), **options)


def deviations(a, b) -> np.ndarray:
    """Return the difference of the light after the first return, in standard errors, shot by shot."""
    late = slice(3 * a.time.size // 5, None)
    light = (m.components["higher"][..., late].sum(axis=(1, 2)) for m in (a, b))
    # Errors of samples of one shot are correlated: the upper bound is that of full correlation.
    errors = (m.stderr[..., late].sum(axis=(1, 2)) for m in (a, b))
    return np.subtract(*light) / np.hypot(*errors)


@pytest.fixture(scope="module")
def complete_and_tiled() -> tuple[jl.Waveforms, jl.Waveforms]:
    """The forest as one scene and in tiles, at first order, with the truth."""
    scenes = Forest().complete(), scene_parts(Forest())
    complete, tiled = (simulated(scene, max_orders=1, truth=True) for scene in scenes)
    return complete, tiled


def test_tiles_give_the_waveforms_of_the_complete_scene_at_first_order(complete_and_tiled):
    complete, tiled = complete_and_tiled
    np.testing.assert_array_equal(complete.time, tiled.time)
    np.testing.assert_array_equal(complete.ground_height, tiled.ground_height)
    np.testing.assert_array_equal(tiled.position, survey().position)
    z = (complete.reflectance - tiled.reflectance) / np.hypot(complete.stderr, tiled.stderr).max()
    assert np.abs(z).max() < 4
    assert not np.allclose(tiled.reflectance[0], tiled.reflectance[2], rtol=0.05)
    assert (tiled.info["parts"], tiled.info["margin"]) == (3, 0.0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::jaxlidar.LateLightWarning")
def test_the_lossless_margin_loses_no_light_and_a_small_one_does():
    bright = {"rtol": 0.02, "max_orders": 30}
    complete = simulated(Forest().complete(), **bright)
    tiled = simulated(scene_parts(Forest()), seed=1, **bright)
    assert tiled.info["margin"] == tiled.info["margin of all light"] > 10
    assert np.abs(deviations(complete, tiled)).max() < 3
    assert np.abs(np.mean(deviations(complete, tiled))) < 0.75
    narrow = simulated(jl.SceneParts(Forest(), z=(0.0, TALL), tile=1.0, margin=0.0), **bright)
    assert narrow.info["margin"] == 0.0 < narrow.info["margin of all light"]
    # Without a margin, light falls in through the sides, where in truth there is forest.
    assert np.mean(deviations(narrow, complete)) > 1.5


def test_rectangles_have_one_size_and_contain_all_light():
    for zenith in (0.0, 30.0):
        shots, scene = survey(zenith=zenith), scene_parts(Forest())
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
    """Shortest paths to random positions and back are longer than those that are recorded."""
    random = np.random.default_rng(2)
    for zenith in (0.0, 20.0, 50.0):
        shots = survey(zenith=zenith)
        w, longest, top = shots.direction[0], 60.0, 10.0
        margin = lossless_margin(shots, longest, top)
        z = random.uniform(0, top, (20_000, 2))
        azimuth, distance = random.uniform(0, 2 * np.pi, 20_000), margin * random.uniform(0.5, 1.5, 20_000)
        first = z[:, :1] / w[2] * w
        offset = np.c_[distance * np.cos(azimuth), distance * np.sin(azimuth), z[:, 1] - z[:, 0]]
        path = first @ w + np.linalg.norm(offset, axis=1) + (first + offset) @ w
        assert path[distance > margin].min() >= longest
        # The bound is sharp: in the worst direction light comes from nearly as far.
        assert distance[path < longest].max() > 0.7 * margin


def test_an_interrupted_run_continues_with_the_same_results(tmp_path):
    path = tmp_path / "many.nc"

    def stop(progress):
        if progress.done < 6:
            raise KeyboardInterrupt

    options = {"max_orders": 1, "path": path}
    with pytest.raises(KeyboardInterrupt):
        simulated(scene_parts(Forest()), progress=stop, **options)
    stored = list((tmp_path / "many.nc.parts").glob("*.npz"))
    assert 0 < len(stored) < 4
    continued = simulated(scene_parts(Forest()), **options)
    with ThreadPoolExecutor(2) as executor:
        by_workers = simulated(scene_parts(Forest()), max_orders=1, executor=executor)
    for name in ("reflectance", "stderr", "ground_height"):
        np.testing.assert_array_equal(getattr(continued, name), getattr(by_workers, name))
    with pytest.raises(ValueError, match="scene"):
        simulated(scene_parts(Forest(density=0.9 * DENSITY)), **options)


def test_large_coordinates_lose_no_precision_and_bare_tiles_have_all_materials():
    density = DENSITY.copy()
    density[:26, :26] = 0.0
    origins = (0.0, 0.0), (400_000.0, 5_000_000.0)
    options = {"max_orders": 1, "truth": True}
    a, b = (
        simulated(scene_parts(Forest(origin, density), margin=0.0), survey=survey(origin), **options)
        for origin in origins
    )
    np.testing.assert_allclose(a.reflectance, b.reflectance, atol=1e-6)
    for leaf in (a.components["leaf"], a.truth.returns["leaf"]):
        assert float(leaf[0].max()) == 0.0 < float(leaf[5].max())
    total = sum(v[0] for v in a.energy_budget.values())
    np.testing.assert_allclose(total, 1.0, atol=1e-5)


def test_the_truth_of_tiles_is_that_of_the_complete_scene(complete_and_tiled, tmp_path):
    """In memory and from a file, in the survey's order."""
    complete, tiled = complete_and_tiled
    from_file = simulated(scene_parts(Forest()), max_orders=1, truth=True, path=tmp_path / "many.nc")
    compare = functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=2e-5)
    for truth in (tiled.truth, from_file.truth):
        assert set(truth.returns) == set(complete.truth.returns) == {"leaf", "ground"}
        for name, expected in vars(complete.truth).items():
            jax.tree.map(compare, getattr(truth, name), expected)
    assert float(tiled[3].truth.surface_height["ground"]) == pytest.approx(0.0, abs=1e-6)


def test_inadmissible_arguments_are_refused_before_any_work():
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
        simulated(jl.SceneParts(lambda low, high: None, z=(0, 1)))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"voxels from 0 m to 6 m; admissible is z = \(0.0, 5.0\)"):
        simulated(jl.SceneParts(Forest(), z=(0, 5)))
    with pytest.raises(TypeError, match="Scene"):
        jl.simulate(jl.Lidar(), scene_parts(Forest()), key=jax.random.key(0))  # pyright: ignore[reportArgumentType]
