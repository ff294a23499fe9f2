"""Truth of all shots of a survey: that of each shot alone, in memory, in files, and by workers."""

import concurrent.futures
import multiprocessing
import pickle

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.spectral.truth_class import Truth
from tests.quick_compilation import optimise_programs
from tests.survey.test_simulate_many import stored_shots

h5py = pytest.importorskip("h5py")

KEY = jax.random.key(4)
OPTIONS = {"key": KEY, "rtol": 0.3, "max_orders": 1, "truth": True}


def stand():
    random = np.random.default_rng(1)
    lad = random.uniform(0.0, 1.0, (12, 12, 3)) * (random.uniform(size=(12, 12, 1)) < 0.6)
    voxels = jl.VoxelMap.from_lad(lad, voxel_size=5.0, origin=(-30.0, -30.0, 1.0))
    ground = jl.Ground(reflectance=0.3, slope=8.0, aspect=90.0)
    return jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.3), hotspot=False), ground=ground)


SCENE = stand()
LIDAR = jl.Lidar(altitude=2e4, divergence=0.5, wavelength=(532.0, 1064.0), sampling_interval=4.0)
SURVEY = jl.Survey(LIDAR, np.random.default_rng(2).uniform(-12.0, 12.0, (11, 2)))
OBLIQUE = jl.Survey(LIDAR, SURVEY.position, np.linspace(0.0, 20.0, 11), 70.0)


def same(a, b):
    """Return True if all bits are equal; arrays mapped from a file count as arrays."""
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(
        np.asarray(x).dtype == np.asarray(y).dtype and np.array_equal(x, y, equal_nan=True) for x, y in leaves
    )


@pytest.fixture(scope="module")
def waveforms():
    return jl.simulate_many(OBLIQUE, SCENE, **OPTIONS)


def near(a, b, tolerance=1e-3):
    return all(
        np.allclose(x, y, atol=tolerance, rtol=tolerance)
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


@pytest.mark.slow
def test_truths_are_those_of_each_shot_alone(waveforms):
    plan = jl.plan(OBLIQUE, SCENE, max_orders=1, n_rays=512)
    assert waveforms.info["shared"] is False
    for shot in (0, 7):
        single, truth = jl.truth_of(OBLIQUE[shot], SCENE, plan=plan), waveforms[shot].truth
        assert near(truth, single)
        assert not near(truth, waveforms[3].truth)
        assert np.array_equal(truth.time, waveforms.time)
        assert np.array_equal(truth.height, waveforms[shot].height)
    # The mean of a slope is where the axis meets it.
    assert np.allclose(waveforms.truth.surface_height["ground"], waveforms.ground_height, atol=0.02)
    assert np.allclose(waveforms.first_order_share, 1.0)


@pytest.mark.slow
def test_truths_are_stored_in_files_and_a_killed_run_continues(waveforms, tmp_path):
    path = tmp_path / "many.zarr"

    class Killed(Exception):
        pass

    def kill(progress):
        if progress.done >= 6:
            raise Killed

    with pytest.raises(Killed):
        jl.simulate_many(OBLIQUE, SCENE, **OPTIONS, path=path, progress=kill)
    assert stored_shots(path)
    stored = jl.simulate_many(OBLIQUE, SCENE, **OPTIONS, path=path)
    assert same(stored, waveforms)
    assert same(jl.open(path), waveforms)
    assert same(pickle.loads(pickle.dumps(waveforms[5])), waveforms[5])
    waveforms[5].save(tmp_path / "one.nc")
    assert same(jl.open(tmp_path / "one.nc"), waveforms[5])
    # Beside the waveforms, not in place of them.
    dataset = waveforms.to_xarray()
    assert dataset.gap_probability.dims == ("shot", "time")
    assert dataset.gap_probability.attrs["units"] == "1"
    assert np.array_equal(dataset.returns.sel(material="leaf"), waveforms.truth.returns["leaf"])
    with pytest.raises(ValueError, match="another problem, which differs in truth"):
        jl.simulate_many(OBLIQUE, SCENE, **OPTIONS | {"truth": False}, path=path)


@pytest.mark.slow
def test_damaged_files_are_refused(waveforms, tmp_path):
    path = tmp_path / "many.nc"
    waveforms.save(path)
    with h5py.File(path) as file:
        offset = file["truth/gap_probability"].id.get_chunk_info(0).byte_offset
    data = bytearray(path.read_bytes())
    data[offset] ^= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"many.nc: /truth/gap_probability: damaged \("):
        jl.open(path)
    waveforms.save(path)
    with h5py.File(path, "a") as file:
        del file["truth"]
    with pytest.raises(ValueError, match=r"many.nc: /truth: no such group"):
        jl.open(path)


def test_truths_are_one_truth_with_an_axis_of_shots(waveforms, tmp_path):
    truth = waveforms.truth
    assert isinstance(truth, Truth)
    assert truth.time.shape == waveforms.time.shape
    assert truth.height.shape == truth.gap_probability.shape == (11, waveforms.time.size)
    assert same(truth[-2], waveforms[9].truth)
    assert not same(truth[8], waveforms[9].truth)
    # Heights are those of each shot: zenith angles differ.
    np.testing.assert_allclose(truth[9].height, waveforms.height_of_shot(9), atol=1e-3)
    assert not np.allclose(truth[9].height, waveforms.height_of_shot(8), atol=1e-3)
    for name in ("truth.nc", "truth.zarr"):
        jl.io.save(truth, tmp_path / name)
        assert same(jl.open(tmp_path / name), truth)
    with pytest.raises(IndexError, match="shot 11: there are 11"):
        truth[11]
    with pytest.raises(TypeError, match="no axis of shots"):
        truth[0][0]


def test_truth_is_none_unless_asked_for(tmp_path):
    scene = jl.Scene(ground=jl.Ground())
    waveforms = jl.simulate_many(jl.Survey(jl.Lidar(), [(0, 0), (1, 0)]), scene, key=KEY)
    assert waveforms.truth is None
    assert waveforms[1].truth is None
    waveforms.save(tmp_path / "few.nc")
    assert jl.open(tmp_path / "few.nc").truth is None
    with pytest.raises(TypeError, match="truth"):
        jl.simulate_many(jl.Survey.of(jl.Lidar()), scene, key=KEY, truth=1)  # pyright: ignore


@pytest.mark.slow
def test_a_case_file_may_ask_for_truth(tmp_path):
    scene = jl.Scene(plates=[jl.Plate(3.0, 0.4, coverage=0.5)])
    survey = jl.Survey(jl.Lidar(), [(0, 0), (1, 0)])
    case = jl.io.Case(survey=survey, scene=scene, key=KEY, arguments={"truth": True})
    jl.io.write_case(tmp_path / "a.toml", case)
    waveforms = jl.io.read_case(tmp_path / "a.toml").simulate(path=tmp_path / "a.zarr")
    assert np.allclose(waveforms.truth.gap_probability[:, -1], 0.5)
    assert set(waveforms.truth.surface_height) == {"plate"}


@pytest.mark.slow
def test_shared_illumination_has_the_same_truth(tmp_path):
    per_shot = jl.simulate_many(SURVEY, SCENE, **OPTIONS, shared=False)
    shared = jl.simulate_many(SURVEY, SCENE, **OPTIONS, shared=True, path=tmp_path / "a.zarr")
    assert shared.info["shared"] is True
    assert same(shared.truth, per_shot.truth)
    # Empty dicts are stored as well.
    bare = jl.Scene(canopy=SCENE.canopy)
    for is_shared in (True, False):
        path = tmp_path / f"bare {is_shared}.zarr"
        waveforms = jl.simulate_many(SURVEY, bare, **OPTIONS, shared=is_shared, path=path)
        assert waveforms.truth.surface_height == {}
        assert waveforms[2].truth.surface_spread == {}


@pytest.mark.slow
def test_workers_find_the_same_truth(waveforms):
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(2, context, optimise_programs) as pool:
        assert same(jl.simulate_many(OBLIQUE, SCENE, **OPTIONS, executor=pool), waveforms)
