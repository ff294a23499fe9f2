"""Truth for all shots of a survey: as of each shot alone, in memory and in files, whoever does the work."""

import concurrent.futures
import multiprocessing
import pickle

import jax
import numpy as np
import pytest

import jaxlidar as jl
from tests.survey.test_simulate_many import stored_tasks

h5py = pytest.importorskip("h5py")

KEY = jax.random.key(4)
HOW = {"key": KEY, "rtol": 0.3, "max_orders": 1, "truth": True}


def stand():
    random = np.random.default_rng(1)
    lad = random.uniform(0.0, 1.0, (12, 12, 3)) * (random.uniform(size=(12, 12, 1)) < 0.6)
    voxels = jl.VoxelMap.from_lad(lad, voxel_size=5.0, origin=(-30.0, -30.0, 1.0))
    ground = jl.Ground(reflectance=0.3, slope=8.0, aspect=90.0)
    return jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.3)), ground=ground)


SCENE = stand()
LIDAR = jl.Lidar(altitude=2e4, divergence=0.5, wavelength=(532.0, 1064.0), sampling_interval=4.0)
SURVEY = jl.Survey(LIDAR, np.random.default_rng(2).uniform(-12.0, 12.0, (11, 2)))
ASLANT = jl.Survey(LIDAR, SURVEY.position, np.linspace(0.0, 20.0, 11), 70.0)


def same(a, b):
    """To the bit; arrays mapped from a file count as arrays."""
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(
        np.asarray(x).dtype == np.asarray(y).dtype and np.array_equal(x, y, equal_nan=True) for x, y in leaves
    )


@pytest.fixture(scope="module")
def many():
    return jl.simulate_many(ASLANT, SCENE, **HOW)


def near(a, b, tolerance=1e-3):
    return all(
        np.allclose(x, y, atol=tolerance, rtol=tolerance)
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


def test_it_is_that_of_each_shot_alone(many):
    plan = jl.plan(ASLANT, SCENE, max_orders=1, n_rays=512)
    assert many.info["shared"] is False
    for shot in (0, 7):
        alone, truth = jl.truth_of(ASLANT[shot], SCENE, plan=plan), many[shot].truth
        assert near(truth, alone)
        assert not near(truth, many[3].truth)
        assert np.array_equal(truth.time, many.time)
        assert np.array_equal(truth.height, many[shot].height)
    # The mean of a slope is where the axis meets it.
    assert np.allclose(many.truth.surface_height["ground"], many.ground_height, atol=0.02)
    assert np.allclose(many.first_order_share, 1.0)


def test_it_is_kept_in_files_and_a_run_that_was_killed_goes_on(many, tmp_path):
    path = tmp_path / "many.nc"

    class Killed(Exception):
        pass

    def kill(progress):
        if progress.done >= 6:
            raise Killed

    with pytest.raises(Killed):
        jl.simulate_many(ASLANT, SCENE, **HOW, path=path, progress=kill)
    assert len(stored_tasks(path)) > 2
    kept = jl.simulate_many(ASLANT, SCENE, **HOW, path=path)
    assert same(kept, many)
    assert isinstance(kept.truth.gap_probability, np.memmap)
    assert same(jl.open(path), many)
    assert same(pickle.loads(pickle.dumps(many[5])), many[5])
    many[5].save(tmp_path / "one.nc")
    assert same(jl.open(tmp_path / "one.nc"), many[5])
    # Beside the waveforms, not in place of them.
    found = many.to_xarray()
    assert found.gap_probability.dims == ("shot", "time")
    assert found.gap_probability.attrs["units"] == "1"
    assert np.array_equal(found.returns.sel(material="leaf"), many.truth.returns["leaf"])
    with pytest.raises(ValueError, match="another problem, which differs in truth"):
        jl.simulate_many(ASLANT, SCENE, **HOW | {"truth": False}, path=path)


def test_damage_does_not_pass(many, tmp_path):
    path = tmp_path / "many.nc"
    many.save(path)
    with h5py.File(path) as file:
        place = file["truth/gap_probability"].id.get_offset()
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"many.nc: /truth: row 0: damaged \(its checksum is another\)"):
        jl.open(path)
    many.save(path)
    with h5py.File(path, "a") as file:
        del file["truth"]
    with pytest.raises(ValueError, match=r"many.nc: /truth: no such group"):
        jl.open(path)


def test_without_it_nothing_is_added(tmp_path):
    scene = jl.Scene(ground=jl.Ground())
    few = jl.simulate_many(jl.Survey(jl.Lidar(), [(0, 0), (1, 0)]), scene, key=KEY)
    assert few.truth is None
    assert few[1].truth is None
    few.save(tmp_path / "few.nc")
    assert jl.open(tmp_path / "few.nc").truth is None
    with pytest.raises(TypeError, match="truth"):
        jl.simulate_many(jl.Survey.of(jl.Lidar()), scene, key=KEY, truth=1)  # pyright: ignore


def test_a_survey_in_a_file_may_ask_for_it(tmp_path):
    scene = jl.Scene(plates=[jl.Plate(3.0, 0.4, coverage=0.5)])
    survey = jl.Survey(jl.Lidar(), [(0, 0), (1, 0)])
    case = jl.io.Case(survey=survey, scene=scene, key=KEY, arguments={"truth": True})
    jl.io.write_case(tmp_path / "a.toml", case)
    many = jl.io.read_case(tmp_path / "a.toml").simulate(path=tmp_path / "a.zarr")
    assert np.allclose(many.truth.gap_probability[:, -1], 0.5)
    assert set(many.truth.surface_height) == {"plate"}


@pytest.mark.slow
def test_footprints_that_share_light_have_the_same_truth(tmp_path):
    apart = jl.simulate_many(SURVEY, SCENE, **HOW, shared=False)
    together = jl.simulate_many(SURVEY, SCENE, **HOW, shared=True, path=tmp_path / "a.zarr")
    assert together.info["shared"] is True
    assert same(together.truth, apart.truth)
    # Empty dicts are kept as well.
    bare = jl.Scene(canopy=SCENE.canopy)
    for shared in (True, False):
        path = tmp_path / f"bare {shared}.nc"
        many = jl.simulate_many(SURVEY, bare, **HOW, shared=shared, path=path)
        assert many.truth.surface_height == {}
        assert many[2].truth.surface_spread == {}


@pytest.mark.slow
def test_workers_give_the_same(many):
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(2, mp_context=context) as pool:
        assert same(jl.simulate_many(ASLANT, SCENE, **HOW, executor=pool), many)
