"""Surveys over clouds in many files: borders of tiles and files, gaps, resuming, workers, and refusals."""

import contextlib
import itertools
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.io import write_las
from jaxlidar.survey import cloud_tiles

pytest.importorskip("laspy")
pytest.importorskip("h5netcdf")

# A beam of 4 m, so that tiles of 20 m differ in what they need of their neighbours.
LIDAR = jl.Lidar(altitude=1e4, divergence=0.4, pulse=jl.GaussianPulse(fwhm=6.0))
KEY = jax.random.key(3)
# Edge of the cloud and height of its slope, m.
WIDTH, RISE = 60.0, 6.0


def forest_points(seed=0, returns=36_000):
    """Return positions and classes of returns of plants on a slope, with none in one corner."""
    random = np.random.default_rng(seed)
    x, y = random.uniform(0.0, WIDTH, (2, returns))
    ground = RISE * x / WIDTH
    crown = np.sin(x / 4.0) * np.cos(y / 5.0) + random.normal(0.0, 0.2, returns)
    is_plant = random.uniform(size=returns) < 0.3 + 0.3 * (crown > 0)
    z = np.where(is_plant, ground + 2.0 + 8.0 * random.beta(3.0, 2.0, returns) * (1.2 + crown), ground)
    is_there = (x < 40.0) | (y < 40.0)
    return np.column_stack([x, y, z])[is_there], np.where(is_plant, 5, 2)[is_there]


def write_files(folder, borders):
    """Write the cloud as files from west to east."""
    position, classes = forest_points()
    files = []
    for west, east in itertools.pairwise(borders):
        rows = (position[:, 0] >= west) & (position[:, 0] < east)
        files.append(folder / f"{west:g}.laz")
        write_las(files[-1], position[rows], classification=classes[rows])
    return files


def survey_at(*position):
    return jl.Survey(LIDAR, position=list(position))


def rows_of(parts, shots):
    """Return the records of all shots on the heights of -5 to 30 m, normalised by the largest sample."""
    height = np.arange(-5.0, 30.0, 0.15)
    records = np.full((shots, height.size), np.nan)
    for numbers, waves in parts:
        for row, shot in enumerate(numbers):
            z = np.asarray(waves.height_of_shot(row))[::-1]
            records[shot] = np.interp(height, z, waves.recorded[row, 0][::-1], 0.0, 0.0)
    return records / np.nanmax(records)


@pytest.fixture(scope="module")
def halves(tmp_path_factory):
    return write_files(tmp_path_factory.mktemp("halves"), (0.0, 30.0, WIDTH))


# Shots at the border of the files (x = 30), where neither has returns, of tiles (20, 40), and within a tile.
BORDERS = [(30.0, 30.0), (20.0, 21.0), (39.9, 12.0), (29.0, 40.0), (10.0, 10.0)]


@pytest.mark.slow
def test_tiles_and_files_do_not_show_at_their_borders(halves, tmp_path, monkeypatch):
    survey, options = survey_at(*BORDERS), {"key": KEY, "rtol": 0.02}
    (whole,) = write_files(tmp_path, (0.0, WIDTH))
    reference = rows_of(jl.simulate_tiles([whole], survey, tmp_path / "one", tile=100.0, **options), 5)
    assert reference.max(axis=1).min() > 0.2
    parts = jl.simulate_tiles(halves, survey, tmp_path / "many", tile=20.0, **options)
    assert len(parts) == 4
    assert sorted(np.concatenate([shots for shots, _ in parts]).tolist()) == [0, 1, 2, 3, 4]
    records = rows_of(parts, 5)
    assert np.abs(records - reference).max() < 0.03
    for record, expected in zip(records, reference):
        assert np.corrcoef(record, expected)[0, 1] > 0.999
    # Without what lies beyond the border of a file.
    monkeypatch.setattr(cloud_tiles.CloudFile, "meets", lambda file, low, high: file.low[0] < 15.0)
    alone = rows_of(jl.simulate_tiles(halves, survey, tmp_path / "alone", tile=20.0, **options), 5)
    assert np.abs(alone - reference)[0].max() > 0.1


@pytest.mark.slow
def test_ground_without_returns_is_black_and_shots_outside_are_in_no_tile(halves, tmp_path):
    survey = survey_at((10.0, 30.0), (52.0, 52.0), (66.0, 30.0))
    parts = jl.simulate_tiles(halves, survey, tmp_path, key=KEY, tile=20.0, rtol=0.1)
    assert [shots.tolist() for shots, _ in parts] == [[0], [1]]
    covered, bare = (waves for _, waves in parts)
    assert bare.recorded.sum() < 1e-3 * covered.recorded.sum()
    # Leaves are as bright as the ground, whatever their number.
    components = {name: a[0, 0].sum() for name, a in covered.components.items()}
    assert components["ground"] + components["leaf"] == pytest.approx(0.3, rel=0.05)
    assert components["leaf"] > 0.05


@pytest.mark.slow
def test_an_interrupted_run_goes_on_with_the_same_bits(halves, tmp_path, monkeypatch):
    survey, options = survey_at(*BORDERS[:3]), {"key": KEY, "tile": 20.0, "rtol": 0.1}
    parts = jl.simulate_tiles(halves, survey, tmp_path / "whole", **options)
    simulate_tile, reports = cloud_tiles.simulate_tile, []

    def interrupted(tile, *arguments):
        if reports:
            raise KeyboardInterrupt
        simulate_tile(tile, *arguments)

    monkeypatch.setattr(cloud_tiles, "simulate_tile", interrupted)
    with pytest.raises(KeyboardInterrupt) as interrupt:
        jl.simulate_tiles(halves, survey, tmp_path / "part", **options, progress=reports.append)
    assert "the same call continues" in interrupt.value.__notes__[0]
    (finished,) = (tmp_path / "part").glob("*.nc")
    first_change = finished.stat().st_mtime_ns
    monkeypatch.setattr(cloud_tiles, "simulate_tile", simulate_tile)
    reports.clear()
    continued = jl.simulate_tiles(halves, survey, tmp_path / "part", **options, progress=reports.append)
    assert finished.stat().st_mtime_ns == first_change
    assert [(report.done, report.stored) for report in reports] == [(3, 1)]
    for (shots, waves), (expected_shots, expected) in zip(continued, parts, strict=True):
        assert shots.tolist() == expected_shots.tolist()
        assert np.array_equal(waves.recorded, expected.recorded)
    # Another key is another problem, in the same folder.
    jl.simulate_tiles(halves, survey, tmp_path / "part", **options | {"key": jax.random.key(4)})
    assert len(list((tmp_path / "part").glob("*.nc"))) == 4


@contextlib.contextmanager
def dask_executor():
    """The workers of a Dask scheduler, in threads of this process; what they are sent is pickled."""
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "protocol": "tcp"}
    with (
        distributed.LocalCluster(**options, dashboard_address=None, silence_logs="CRITICAL") as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client.get_executor()


# Warnings of Dask itself.
@pytest.mark.filterwarnings("ignore::DeprecationWarning:(distributed|dask|tornado|zict).*")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_workers_give_the_same_bits(halves, tmp_path):
    survey, options = survey_at(*BORDERS[:2]), {"key": KEY, "tile": 20.0, "rtol": 0.1}
    parts = jl.simulate_tiles(halves, survey, tmp_path / "here", **options)
    for name, executors in (("threads", ThreadPoolExecutor(1)), ("dask", dask_executor())):
        with executors as executor:
            others = jl.simulate_tiles(halves, survey, tmp_path / name, **options, executor=executor)
        for (_, waves), (_, expected) in zip(others, parts, strict=True):
            assert np.array_equal(waves.recorded, expected.recorded)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"files": []}, ValueError, "files is empty"),
        ({"files": ["missing.laz"]}, FileNotFoundError, "missing.laz"),
        ({"survey": jl.Survey(LIDAR, [(30.0, 30.0)], zenith=1.0)}, ValueError, "of tilted beams"),
        ({"survey": jl.Survey(LIDAR, sensor=[(30.0, 30.0, 500.0)])}, ValueError, "placed by its sensors"),
        ({"survey": survey_at((500.0, 30.0))}, ValueError, "no shot lies within the extent of a file"),
        ({"tile": 0.0}, ValueError, "tile = 0"),
        ({"voxel_size": -1.0}, ValueError, "voxel_size"),
        ({"rtol": 1.0}, ValueError, "rtol = 1"),
    ],
)
def test_inadmissible_arguments_are_refused(halves, tmp_path, changes, error, message):
    arguments = {"files": halves, "survey": survey_at((30.0, 30.0)), "key": KEY} | changes
    files, survey = arguments.pop("files"), arguments.pop("survey")
    with pytest.raises(error, match=message):
        jl.simulate_tiles(files, survey, tmp_path / "tiles", **arguments)


def test_a_file_given_twice_is_refused(halves, tmp_path):
    """Its points would count twice, under whichever name."""
    (tmp_path / "tiles").mkdir()
    again = tmp_path / "tiles" / ".." / "again.las"
    again.symlink_to(halves[0])
    with pytest.raises(ValueError, match=r"files has .* 2 times"):
        jl.simulate_tiles([*halves, again], survey_at((30.0, 30.0)), tmp_path / "tiles", key=KEY)


def test_files_of_two_systems_and_damaged_extents_are_refused(tmp_path):
    pytest.importorskip("pyproj")
    position, classes = forest_points(returns=100)
    files = [tmp_path / f"{code}.las" for code in (32633, 32634)]
    for path in files:
        write_las(path, position, classification=classes, crs=f"EPSG:{path.stem}")
    with pytest.raises(ValueError, match=r"32634.las is in EPSG:32634, .*32633.las in EPSG:32633"):
        jl.simulate_tiles(files, survey_at((30.0, 30.0)), tmp_path / "tiles", key=KEY)
    content = bytearray(files[0].read_bytes())
    content[179:187] = np.array(np.nan).tobytes()
    files[0].write_bytes(content)
    with pytest.raises(ValueError, match=r"32633.las: header: the extent .* is none"):
        jl.simulate_tiles(files[:1], survey_at((30.0, 30.0)), tmp_path / "tiles", key=KEY)
