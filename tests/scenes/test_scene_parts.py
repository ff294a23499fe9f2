"""Scenes in parts: the same waveforms as of the whole, from rectangles of one size."""

import functools
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.survey.squares import all_light, squares_of
from tests.survey.test_simulate_many import stored_tasks

SIDE, TALL = 48, 6
LEAF = jl.LeafOptics(0.5, 0.45)
DENSITY = np.where(np.random.default_rng(0).uniform(size=(SIDE, SIDE, TALL)) < 0.5, 1.2, 0.0)


class Forest:
    """Parts of a forest whose corner is at `origin`; what was asked for is kept."""

    def __init__(self, origin=(0.0, 0.0), density=DENSITY):
        self.origin, self.density, self.asked = np.asarray(origin), density, []

    def __call__(self, low, high):
        self.asked.append((low, high))
        first = np.clip(np.floor(low - self.origin), 0, SIDE - 1).astype(int)
        last = np.clip(np.ceil(high - self.origin), 1, SIDE).astype(int)
        density = self.density[first[0] : last[0], first[1] : last[1]]
        voxels = jl.VoxelMap.from_lad(density, voxel_size=1.0, origin=(*(self.origin + first), 0.0))
        canopy = jl.Canopy(voxels, leaf=LEAF) if density.any() else None
        return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.4))

    def whole(self):
        return self(self.origin, self.origin + SIDE)

    # Two forests with the same density are the same.
    def __reduce__(self):
        return Forest, (tuple(self.origin), self.density)


def survey(origin=(0.0, 0.0), zenith=0.0) -> jl.Survey:
    lidar = jl.Lidar(altitude=500.0, divergence=4.0, pulse=jl.GaussianPulse(fwhm=4.0), zenith=zenith)
    return jl.Survey(lidar, np.add(origin, [(12, 12), (13, 14), (36, 13), (20, 35), (34, 36), (35, 35)]))


def parts(forest, **how) -> jl.SceneParts:
    return jl.SceneParts(forest, z=(0.0, TALL), tile=20.0, **how)


def simulated(scene, seed=0, **how):
    how = {"rtol": 0.05, "shared": False, **how}
    return jl.simulate_many(how.pop("survey", survey()), scene, key=jax.random.key(seed), **how)


def off(a, b) -> np.ndarray:
    """Standard errors by which the light after the first return of two campaigns differs, shot by shot."""
    late = slice(3 * a.time.size // 5, None)
    light = (m.components["higher"][..., late].sum(axis=(1, 2)) for m in (a, b))
    # Errors of samples of one shot are not independent: the bound that they are one and the same.
    errors = (m.stderr[..., late].sum(axis=(1, 2)) for m in (a, b))
    return np.subtract(*light) / np.hypot(*errors)


@pytest.fixture(scope="module")
def both() -> tuple[jl.Waveforms, jl.Waveforms]:
    """The forest as a whole and in parts, at first order, with the truth."""
    whole, found = (simulated(s, max_orders=1, truth=True) for s in (Forest().whole(), parts(Forest())))
    return whole, found


def test_the_same_waveforms_as_of_the_whole_at_first_order(both):
    whole, found = both
    np.testing.assert_array_equal(whole.time, found.time)
    np.testing.assert_array_equal(whole.ground_height, found.ground_height)
    np.testing.assert_array_equal(found.position, survey().position)
    z = (whole.reflectance - found.reflectance) / np.hypot(whole.stderr, found.stderr).max()
    assert np.abs(z).max() < 4
    assert not np.allclose(found.reflectance[0], found.reflectance[2], rtol=0.05)
    assert (found.info["parts"], found.info["margin"]) == (3, 0.0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::jaxlidar.LateLightWarning")
def test_a_margin_as_wide_as_all_light_loses_none_and_a_small_one_does():
    bright = {"rtol": 0.02, "max_orders": 30}
    whole = simulated(Forest().whole(), **bright)
    found = simulated(parts(Forest()), seed=1, **bright)
    assert found.info["margin"] == found.info["margin of all light"] > 10
    assert np.abs(off(whole, found)).max() < 3
    assert np.abs(np.mean(off(whole, found))) < 0.75
    narrow = simulated(jl.SceneParts(Forest(), z=(0.0, TALL), tile=1.0, margin=0.0), **bright)
    assert narrow.info["margin"] == 0.0 < narrow.info["margin of all light"]
    # Light falls in through the sides where there is forest.
    assert np.mean(off(narrow, whole)) > 1.5


def test_rectangles_have_one_size_and_hold_all_light():
    for zenith in (0.0, 30.0):
        shots, scene = survey(zenith=zenith), parts(Forest())
        for margin in (0.0, 7.0):
            squares = squares_of(shots, scene, margin)
            assert sorted(np.concatenate([s.shots for s in squares])) == list(range(len(shots)))
            sizes = np.array([s.high - s.low for s in squares])
            np.testing.assert_allclose(sizes, sizes[0, 0])
            for square in squares:
                for z in scene.z:
                    axis = shots.direction[square.shots]
                    at = shots.position[square.shots] + z * axis[:, :2] / axis[:, 2:]
                    reach = shots.footprint_radius[square.shots, None] + margin
                    assert np.all(at - reach >= square.low)
                    assert np.all(at + reach <= square.high)


def test_light_that_goes_farther_comes_back_too_late():
    """The shortest path to a place and back, against the distance, for places and directions at random."""
    random = np.random.default_rng(2)
    for zenith in (0.0, 20.0, 50.0):
        shots = survey(zenith=zenith)
        w, last, top = shots.direction[0], 60.0, 10.0
        far = all_light(shots, last, top)
        z = random.uniform(0, top, (20_000, 2))
        turn, apart = random.uniform(0, 2 * np.pi, 20_000), far * random.uniform(0.5, 1.5, 20_000)
        first = z[:, :1] / w[2] * w
        then = first + np.c_[apart * np.cos(turn), apart * np.sin(turn), z[:, 1] - z[:, 0]]
        path = first @ w + np.linalg.norm(then - first, axis=1) + then @ w
        assert path[apart > far].min() >= last
        # The bound is not idle: in the worst direction it is reached to a few per cent.
        assert apart[path < last].max() > 0.7 * far


def test_an_interrupted_run_goes_on_and_gives_the_same(tmp_path):
    path = tmp_path / "many.nc"

    def stop(done):
        if done.done < 6:
            raise KeyboardInterrupt

    how = {"max_orders": 1, "path": path}
    with pytest.raises(KeyboardInterrupt):
        simulated(parts(Forest()), progress=stop, **how)
    assert 0 < len(stored_tasks(path)) < 4
    found = simulated(parts(Forest()), **how)
    with ThreadPoolExecutor(2) as executor:
        again = simulated(parts(Forest()), max_orders=1, executor=executor)
    for name in ("reflectance", "stderr", "ground_height"):
        np.testing.assert_array_equal(getattr(found, name), getattr(again, name))
    with pytest.raises(ValueError, match="scene"):
        simulated(parts(Forest(density=0.9 * DENSITY)), **how)


def test_millions_of_metres_lose_nothing_and_bare_parts_have_all_materials():
    density = DENSITY.copy()
    density[:26, :26] = 0.0
    near, far = (0.0, 0.0), (400_000.0, 5_000_000.0)
    how = {"max_orders": 1, "truth": True}
    a, b = (
        simulated(parts(Forest(origin, density), margin=0.0), survey=survey(origin), **how)
        for origin in (near, far)
    )
    np.testing.assert_allclose(a.reflectance, b.reflectance, atol=1e-6)
    for leaf in (a.components["leaf"], a.truth.returns["leaf"]):
        assert float(leaf[0].max()) == 0.0 < float(leaf[5].max())
    total = sum(v[0] for v in a.energy_budget.values())
    np.testing.assert_allclose(total, 1.0, atol=1e-5)


def test_the_truth_is_that_of_the_whole(both, tmp_path):
    """In memory and from a file, in the survey's order."""
    whole, found = both
    filed = simulated(parts(Forest()), max_orders=1, truth=True, path=tmp_path / "many.nc")
    compare = functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=2e-5)
    for mine in (found.truth, filed.truth):
        assert set(mine.returns) == set(whole.truth.returns) == {"leaf", "ground"}
        for name, expected in vars(whole.truth).items():
            jax.tree.map(compare, getattr(mine, name), expected)
    assert float(found[3].truth.surface_height["ground"]) == pytest.approx(0.0, abs=1e-6)


def test_bad_input_is_refused_before_any_work():
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
        jl.simulate(jl.Lidar(), parts(Forest()), key=jax.random.key(0))  # pyright: ignore[reportArgumentType]
