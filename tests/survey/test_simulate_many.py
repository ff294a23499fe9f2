"""Surveys against single simulations: agreement, repeatability, interrupted runs, workers, bad input."""

import concurrent.futures
import dataclasses
import errno
import multiprocessing
import os
import subprocess
import sys
import warnings
from pathlib import Path

import filelock
import jax
import numpy as np
import pytest
import zarr

import jaxlidar as jl
from jaxlidar.results.store import StoredRows
from jaxlidar.sampling.adaptive import StopReason
from jaxlidar.survey import choose_strategy, coverage
from jaxlidar.survey.coverage import ground_heights, off_map
from jaxlidar.survey.footprint_splines import fit_footprints
from tests.quick_compilation import optimise_programs
from tests.results.test_store import flip_a_bit

KEY = jax.random.key(5)


def stand(reflectance=0.45, *, ground=None, **canopy):
    """Return a stand of crowns of different heights, 60 m wide."""
    random = np.random.default_rng(2)
    lad = np.zeros((30, 30, 6))
    for _ in range(40):
        i, j = random.integers(0, 27, 2)
        low = random.integers(0, 3)
        lad[i : i + 4, j : j + 4, low : low + random.integers(1, 4)] += 0.25
    voxels = jl.VoxelMap.from_lad(lad, voxel_size=2.0, origin=(-30.0, -30.0, 1.0))
    leaf = jl.LeafOptics(reflectance, 0.25)
    ground = jl.Ground(reflectance=0.3) if ground is None else ground
    return jl.Scene(canopy=jl.Canopy(voxels, leaf=leaf, **{"hotspot": False, **canopy}), ground=ground)


def lidar(**changes):
    """Return a lidar with samples far apart for its pulse, so that their errors are nearly independent."""
    options = {
        "altitude": 2e4,
        "divergence": 0.5,
        "pulse": jl.GaussianPulse(fwhm=2.0),
        "sampling_interval": 8.0,
    }
    return jl.Lidar(**(options | changes))


def nadir(count, **changes):
    return jl.Survey(lidar(**changes), np.random.default_rng(7).uniform(-15, 15, (50, 2))[:count])


def scan(count):
    """Return shots in many directions, from low altitude."""
    line = {"start": (0.0, -10.0), "end": (0.0, 10.0), "speed": 20.0, "pulse_rate": count - 1}
    return jl.Survey.scan(lidar(altitude=100.0, divergence=60.0), jl.Oscillating(8.0, 7.0), **line)


FAST = {"rtol": 0.3, "max_orders": 1}


def simulate_each(survey, scene, **options):
    """Simulate the shots one by one, with keys of their own."""
    plan = jl.plan(survey, scene, describe=False, **options)
    keys = jax.random.split(jax.random.key(99), len(survey))
    return [jl.simulate(lidar, scene, key=k, plan=plan) for lidar, k in zip(survey, keys)]


def deviations(waveforms, waves, wavelength=slice(None)):
    """Return difference / standard error of all samples above 1 % of their waveform's peak."""
    scores = []
    for i, wave in enumerate(waves):
        mean, error = np.asarray(wave.reflectance, float), np.asarray(wave.stderr, float)
        counts = mean > 0.01 * mean.max(axis=1, keepdims=True)
        z = (waveforms.reflectance[i] - mean) / np.maximum(np.hypot(waveforms.stderr[i], error), 1e-12)
        scores.append(z[wavelength][counts[wavelength]])
    return np.concatenate(scores)


def agree(z, least=0.5):
    """Return True if z-tests of all samples, at a level of 1 % together, and chi-squared of all pass.

    `least`: smallest admissible mean of z^2; smaller values tell that standard errors are too large.
    """
    # 2.6 is the normal quantile of 1 %; by Sidak the worst of n has that of 1 % / n.
    worst = np.sqrt(2 * np.log(z.size / 0.01))
    # Standard errors are widened for few batches: on average by a tenth or two.
    return np.all(np.abs(z) < worst) and least < np.mean(z**2) < 1.0 + 4.0 * np.sqrt(2.0 / z.size)


def same(a, b):
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y, equal_nan=True) for x, y in leaves)


def top_hats(count):
    """Return footprints with an edge."""
    return nadir(count, profile="top-hat")


def limited(count):
    """Return shots with a field of view as wide as their footprints, which have an edge."""
    return nadir(count, profile="top-hat", field_of_view=0.5)


def oblique(count, **changes):
    """Return shots of one oblique direction, from so far that rays are parallel."""
    survey = nadir(count, **changes)
    return jl.Survey(survey.lidar, survey.position, 20.0, 30.0)


def oblique_and_limited(count):
    """Return shots of one oblique direction, with a field of view narrower than the beam."""
    return oblique(count, field_of_view=0.4)


# Kinds of shots, and whether they share light.
KINDS = [
    (nadir, True),
    (nadir, False),
    (limited, True),
    (oblique, True),
    (oblique_and_limited, True),
    (scan, False),
]
# Oblique and limited shots cannot share first order (`tests.survey.test_shared_illumination`).
EXCLUDED = [(kind, 1) for kind in (limited, oblique, oblique_and_limited)]
SLOW_CASES = [
    pytest.param(kind, shared, shots, orders, marks=pytest.mark.slow)
    for kind, shared in KINDS
    for shots, orders in ((6, 1), (6, 2), (50, 2))
    if (kind, orders) not in EXCLUDED and (kind, shared, shots, orders) != (nadir, True, 6, 1)
]


@pytest.mark.parametrize(("kind", "shared", "shots", "orders"), [(nadir, True, 6, 1), *SLOW_CASES])
def test_shots_agree_with_single_simulations(kind, shared, shots, orders):
    check_agreement(kind(shots), shared=shared, orders=orders)


def check_agreement(survey, *, shared, orders, least=0.5):
    """Check shots of a survey against single simulations, and return these.

    `least`: as in `agree`.
    """
    scene, options = stand(), {"rtol": 0.03, "max_orders": orders}
    waves = simulate_each(survey, scene, **options)
    options |= {"shared": shared}
    waveforms = jl.simulate_many(survey, scene, key=KEY, **options)
    assert waveforms.info["shared"] is shared
    assert np.array_equal(waveforms.time, waves[0].time)
    assert np.all(waveforms.error <= 0.03)
    z = deviations(waveforms, waves)
    assert z.size > 5 * len(survey)
    assert agree(z, least)
    # Planted: each shot 2 m further, and leaves that are a tenth darker.
    assert not agree(deviations(jl.simulate_many(survey, stand(0.4), key=KEY, **options), waves), least)
    shifted = jl.Survey(survey.lidar, survey.position + np.array([2.0, 0.0]), survey.zenith, survey.azimuth)
    assert not agree(deviations(jl.simulate_many(shifted, scene, key=KEY, **options), waves), least)
    return waves


@pytest.mark.slow
@pytest.mark.parametrize(("shots", "orders"), [(6, 1), (6, 2), (50, 2)])
def test_top_hats_agree_within_the_error_of_the_grid(shots, orders, monkeypatch):
    """Splines do not fit the edge of a top hat: most of its squared error is that of the grid.

    That part is an upper estimate for scenes like this one (`jaxlidar.survey.footprint_splines`), so that the
    mean of z^2 may be small. The random part is compared without it: it is too large by no more than that of
    others.
    """
    survey = top_hats(shots)
    waves = check_agreement(survey, shared=True, orders=orders, least=0.0)

    def fit_without_error(*arguments):
        splines = fit_footprints(*arguments)
        return splines._replace(misplaced_energy=np.zeros_like(splines.misplaced_energy))

    monkeypatch.setattr(choose_strategy, "fit_footprints", fit_without_error)
    options = {"rtol": 0.03, "max_orders": orders, "shared": True}
    random_part = jl.simulate_many(survey, stand(), key=KEY, **options)
    assert np.mean(deviations(random_part, waves) ** 2) > 0.5
    # Planted: random errors that are five times as large.
    widened = dataclasses.replace(random_part, stderr=5.0 * random_part.stderr)
    assert np.mean(deviations(widened, waves) ** 2) < 0.5


@pytest.mark.slow
def test_deterministic_shots_equal_single_simulations():
    survey = jl.Survey(lidar(wavelength=(532.0, 1064.0)), [(0, 0), (40, 5)], [0.0, 30.0], [0.0, 70.0])
    scene = jl.Scene(
        plates=[jl.Plate(6.0, 0.4, 0.3, coverage=0.5)],
        ground=jl.Ground(reflectance=0.3, slope=10.0),
        atmosphere=jl.Atmosphere(),
    )
    waveforms = jl.simulate_many(survey, scene, key=KEY, max_orders=1)
    plan = jl.plan(survey, scene, max_orders=1)
    for lidar_of_shot, wave in zip(survey, waveforms):
        single = jl.simulate(lidar_of_shot, scene, key=KEY, plan=plan)
        for name in ("time", "height", "reflectance", "energy", "recorded", "neglected", "wavelength"):
            assert np.allclose(getattr(wave, name), getattr(single, name), rtol=2e-4, atol=1e-9), name
        for name in single.components:
            assert np.allclose(wave.components[name], single.components[name], rtol=2e-4, atol=1e-9), name
        for name, energy in single.energy_budget.items():
            assert np.allclose(wave.energy_budget[name], energy, rtol=2e-4, atol=1e-9), name


@pytest.mark.slow
def test_straight_transmission_is_traced_for_each_wavelength():
    survey, options = nadir(2, wavelength=(532.0, 1064.0)), {"rtol": 0.05, "max_orders": 2}
    leaf = jl.LeafOptics(np.array([0.1, 0.4]), np.array([0.1, 0.4]))
    scene = stand(transmission="straight")
    scene = jl.Scene(
        canopy=jl.Canopy(scene.canopy.voxels, leaf=leaf, transmission="straight", hotspot=False),
        ground=scene.ground,
    )
    waveforms = jl.simulate_many(survey, scene, key=KEY, **options)
    assert agree(deviations(waveforms, simulate_each(survey, scene, **options)))


def test_shots_end_for_the_reasons_of_single_simulations():
    survey, scene = jl.Survey(jl.Lidar(), [(0.0, 0.0)]), jl.Scene(ground=jl.Ground(reflectance=0.4))
    many = jl.simulate_many(survey, scene, key=KEY)
    wave = jl.simulate(jl.Lidar(), scene, key=KEY)
    assert many[0].info["stopped"] == wave.info["stopped"] == "nothing is random"

    def stopped(**changes):
        """Return the reason for a shot with standard errors whose neglected orders may double it."""
        info = {**many.info, "orders": 2, "rtol": 0.01, **changes.pop("info", {})}
        fields = {"stderr": 0.001 * many.reflectance, "neglected": many.reflectance.sum(axis=2), **changes}
        return dataclasses.replace(many, info=info, **fields)[0].info["stopped"]

    assert stopped() == "orders beyond 2 may add 100 %"
    # `simulate` does not report what lies beyond orders that the user chose.
    assert stopped(info={"automatic orders": False}) == "tolerance met"
    assert stopped(error=np.array([0.02])) == StopReason.BATCHES_SPENT.value
    # Files of version 0.3.0 do not say who chose the orders.
    del many.info["automatic orders"]
    assert stopped() == "orders beyond 2 may add 100 %"


@pytest.mark.slow
def test_large_coordinates_lose_no_precision():
    survey, scene = nadir(16), stand()
    waveforms = jl.simulate_many(survey, scene, key=KEY, **FAST)
    shift = np.array([4_500_000.0, 600_000.0])
    voxels = scene.canopy.voxels
    origin = np.asarray(voxels.origin, float) + np.append(shift, 0.0)
    moved_voxels = jl.VoxelMap(voxels.leaf, None, voxels.voxel_size, origin)
    moved_scene = jl.Scene(
        canopy=jl.Canopy(moved_voxels, leaf=scene.canopy.leaf, hotspot=False), ground=scene.ground
    )
    moved_waveforms = jl.simulate_many(
        jl.Survey(survey.lidar, survey.position + shift), moved_scene, key=KEY, **FAST
    )
    assert np.allclose(moved_waveforms.reflectance, waveforms.reflectance, rtol=1e-3, atol=1e-6)


def test_heights_of_the_ground_below_every_shot():
    slope, position = np.tan(np.deg2rad(10.0)), np.array([[0.0, 0.0], [30.0, 0.0], [0.0, 30.0]])
    scene = jl.Scene(ground=jl.Ground(height=2.0, slope=10.0, aspect=90.0))
    level = jl.simulate_many(jl.Survey(lidar(), position), scene, key=KEY)
    assert np.allclose(level.ground_height, 2.0 - slope * position[:, 0], atol=1e-4)
    # Looking east at 45 degrees, the ray falls as fast as it goes east: z = x0 - x = 2 - slope x.
    oblique_shots = jl.simulate_many(jl.Survey(lidar(), position, 45.0, 90.0), scene, key=KEY)
    x = (position[:, 0] - 2.0) / (1.0 - slope)
    assert np.allclose(oblique_shots.ground_height, 2.0 - slope * x, atol=1e-3)
    plate = jl.Scene(plates=[jl.Plate(2.0, 0.4)])
    assert np.all(np.isnan(jl.simulate_many(jl.Survey(lidar(), position), plate, key=KEY).ground_height))


def test_a_shot_depends_neither_on_other_shots_nor_on_workers():
    survey, scene = nadir(16), stand()
    waveforms = jl.simulate_many(survey, scene, key=KEY, **FAST)
    repeated = jl.simulate_many(survey, scene, key=KEY, **FAST)
    assert same(waveforms, repeated)
    with concurrent.futures.ThreadPoolExecutor(3) as pool:
        assert same(waveforms, jl.simulate_many(survey, scene, key=KEY, **FAST, executor=pool))
    other_key = jl.simulate_many(survey, scene, key=jax.random.key(6), **FAST)
    assert not np.allclose(other_key.reflectance, waveforms.reflectance, rtol=1e-6)


class Dying(concurrent.futures.Executor):
    """An executor whose workers die over given chunks; after `max_deaths` it takes no more work."""

    def __init__(self, deaths, max_deaths=100):
        self.deaths, self.max_deaths, self.submitted = list(deaths), max_deaths, []

    def submit(self, function, /, *args, **kwargs):
        if self.max_deaths <= 0:
            raise concurrent.futures.BrokenExecutor("a worker died")
        future, (unit,) = concurrent.futures.Future(), args
        self.submitted.append(unit.number)
        if unit.number in self.deaths:
            self.deaths.remove(unit.number)
            self.max_deaths -= 1
            future.set_exception(concurrent.futures.BrokenExecutor("a worker died"))
        else:
            future.set_result(function(unit))
        return future


def test_a_worker_that_dies_costs_its_chunk_a_second_try():
    survey, scene = nadir(16), stand()
    waveforms = jl.simulate_many(survey, scene, key=KEY, **FAST)
    dying = Dying([1, 3])
    assert same(waveforms, jl.simulate_many(survey, scene, key=KEY, **FAST, executor=dying))
    assert sorted(dying.submitted) == sorted([*range(8), 1, 3])
    with pytest.raises(RuntimeError, match="the workers of chunk 2 died twice"):
        jl.simulate_many(survey, scene, key=KEY, **FAST, executor=Dying([2, 2]))
    with pytest.warns(jl.LostWorkersWarning, match="done in this process"):
        finished_locally = jl.simulate_many(survey, scene, key=KEY, **FAST, executor=Dying([1], max_deaths=1))
    assert same(waveforms, finished_locally)


def die_once(marker, function, unit):
    """Run a unit of work in a worker that dies with the first unit, unless the file `marker` exists."""
    if unit.number == 0 and not os.path.exists(marker):
        Path(marker).touch()
        os._exit(1)
    return function(unit)


SPAWN = multiprocessing.get_context("spawn")


class PoolWithKilledWorker(concurrent.futures.ProcessPoolExecutor):
    """A process pool of two workers, one of which makes the file `marker` and is killed."""

    def __init__(self, marker):
        super().__init__(2, SPAWN, optimise_programs)
        self.marker = marker

    def submit(self, function, /, *args, **kwargs):
        return super().submit(die_once, self.marker, function, *args)


@pytest.mark.slow
def test_a_process_pool_traces_the_same_and_may_lose_a_worker(tmp_path):
    survey, scene = nadir(32), stand()
    waveforms = jl.simulate_many(survey, scene, key=KEY, **FAST)
    with concurrent.futures.ProcessPoolExecutor(2, SPAWN, optimise_programs) as pool:
        assert same(waveforms, jl.simulate_many(survey, scene, key=KEY, **FAST, executor=pool))
    with PoolWithKilledWorker(str(tmp_path / "died")) as pool, pytest.warns(jl.LostWorkersWarning):
        assert same(waveforms, jl.simulate_many(survey, scene, key=KEY, **FAST, executor=pool))


class Stopped(Exception):
    pass


def stored_shots(path, group=""):
    """Return the shots whose results a store has, read without the code under test."""
    return set(np.flatnonzero(zarr.open_array(path / group / "done", mode="r")[:]).tolist())


def test_an_interrupted_run_continues(tmp_path):
    survey, scene, path = nadir(16), stand(), tmp_path / "many.zarr"
    uninterrupted = jl.simulate_many(survey, scene, key=KEY, **FAST)

    def stop(progress):
        if progress.done >= 6:
            raise Stopped

    with pytest.raises(Stopped):
        jl.simulate_many(survey, scene, key=KEY, **FAST, path=path, progress=stop)
    n_stored = len(stored_shots(path))
    assert n_stored >= 6
    with pytest.raises(ValueError, match=rf"many\.zarr: /: {16 - n_stored} of 16 rows are missing: the run"):
        jl.open(path)
    with pytest.raises(ValueError, match=r"another problem, which differs in scene; nothing is overwritten"):
        jl.simulate_many(survey, stand(0.3), key=KEY, **FAST, path=path)
    reports = []
    waveforms = jl.simulate_many(survey, scene, key=KEY, **FAST, path=path, progress=reports.append)
    assert same(uninterrupted, waveforms)
    assert (reports[0].done, reports[-1].done, reports[-1].total) == (n_stored + 2, 16, 16)
    assert reports[-1].left == 0.0
    assert str(reports[-1]).startswith("16 of 16 shots")
    # All is there: nothing is traced.
    assert same(waveforms, jl.simulate_many(survey, scene, key=KEY, **FAST, path=path, progress=pytest.fail))
    opened = jl.Waveforms.open(path)
    assert same(waveforms, opened)
    assert opened.info == waveforms.info
    with pytest.raises(ValueError, match="differs in key"):
        jl.simulate_many(survey, scene, key=jax.random.key(6), **FAST, path=path)


def test_one_run_at_a_time_writes_a_file(tmp_path):
    path = tmp_path / "many.zarr"
    with filelock.FileLock(f"{path}.lock"), pytest.raises(OSError, match=r"many\.zarr is in use by another"):
        jl.simulate_many(nadir(16), stand(), key=KEY, **FAST, path=path)


# Another process runs this: it says that the first task is done, and waits.
BUSY_RUN = """
import sys, jax, jaxlidar as jl
from tests.quick_compilation import optimise_programs

optimise_programs()

def wait(progress):
    print(progress.done, flush=True)
    sys.stdin.readline()

survey = jl.Survey(jl.Lidar(), [(float(x), 0.0) for x in range(16)])
scene = jl.Scene(ground=jl.Ground(slope=5.0))
jl.simulate_many(survey, scene, key=jax.random.key(5), path=sys.argv[1], progress=wait)
"""


@pytest.mark.slow
@pytest.mark.parametrize("end", ["ends", "is killed"])
def test_a_second_process_is_refused_until_the_first_has_gone(tmp_path, end):
    survey = jl.Survey(jl.Lidar(), [(float(x), 0.0) for x in range(16)])
    scene, path = jl.Scene(ground=jl.Ground(slope=5.0)), tmp_path / "many.zarr"
    process = subprocess.Popen(
        [sys.executable, "-c", BUSY_RUN, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert int(process.stdout.readline()) > 0
        with pytest.raises(OSError, match=r"many\.zarr is in use by another run: wait until it has ended"):
            jl.simulate_many(survey, scene, key=KEY, path=path)
        if end == "ends":
            process.communicate("\n" * 16)
            assert process.returncode == 0
    finally:
        process.kill()
        process.communicate()
    reports = []
    waveforms = jl.simulate_many(survey, scene, key=KEY, path=path, progress=reports.append)
    # Shots of the process that was killed are not traced again, nor any where it has ended.
    assert [report.done for report in reports] == ([] if end == "ends" else list(range(4, 17, 2)))
    assert same(waveforms, jl.simulate_many(survey, scene, key=KEY))


def test_damaged_chunks_are_named_and_their_shots_traced_again(tmp_path):
    survey, scene, path = nadir(16), stand(), tmp_path / "many.zarr"

    def run(**options):
        return jl.simulate_many(survey, scene, key=KEY, **FAST, path=path, **options)

    info = run().info
    flip_a_bit(path / "stderr" / "c" / "3" / "0" / "0")
    (path / "photons" / "c" / "0").unlink()
    with pytest.raises(ValueError, match=r"many\.zarr: /photons: damaged \(1 chunks are missing\)"):
        jl.open(path)
    reports = []
    with pytest.warns(
        UserWarning, match=r"many\.zarr is damaged, .* again: chunk 0 of photons, chunk 3 of st"
    ):
        many = run(progress=reports.append)
    assert [report.done for report in reports] == [14, 16]
    assert same(many, jl.simulate_many(survey, scene, key=KEY, **FAST))
    # It states the time of the first run.
    assert many.info == info
    assert same(many, run(progress=pytest.fail))


def test_damage_of_what_describes_all_shots_is_repaired(tmp_path):
    scene, path = jl.Scene(ground=jl.Ground(slope=5.0)), tmp_path / "many.zarr"
    expected = jl.simulate_many(NADIR, scene, key=KEY, truth=True)
    jl.simulate_many(NADIR, scene, key=KEY, truth=True, path=path)
    flip_a_bit(path / "time" / "c" / "0")
    (path / "truth" / "material" / "c" / "0").unlink()
    (path / "acquisition" / "gps_time" / "c" / "0").unlink()
    with pytest.raises(ValueError, match=r"many\.zarr: .*damaged"):
        jl.open(path)
    names = r"acquisition/gps_time, time, truth/material$"
    with pytest.warns(UserWarning, match=rf"many\.zarr is damaged, and these arrays are made again: {names}"):
        many = jl.simulate_many(NADIR, scene, key=KEY, truth=True, path=path)
    assert same(many, expected)


def test_a_full_disk_stops_a_run_which_goes_on_with_what_was_written(tmp_path, monkeypatch):
    survey, scene, path = nadir(16), stand(), tmp_path / "many.zarr"
    write, writes = StoredRows.write, []

    def write_until_the_disk_is_full(self, shots, values):
        writes.append(shots)
        if len(writes) > 5:
            raise OSError(errno.ENOSPC, "no space left on device")
        write(self, shots, values)

    with monkeypatch.context() as patch:
        patch.setattr(StoredRows, "write", write_until_the_disk_is_full)
        with pytest.raises(OSError, match="no space left on device"):
            jl.simulate_many(survey, scene, key=KEY, **FAST, path=path)
    assert len(stored_shots(path)) == 10
    many = jl.simulate_many(survey, scene, key=KEY, **FAST, path=path)
    assert same(many, jl.simulate_many(survey, scene, key=KEY, **FAST))


def test_paths_that_are_no_store_are_refused_before_any_work(tmp_path):
    survey, scene = nadir(16), stand()
    with pytest.raises(
        ValueError, match=r"path = .*many\.nc; admissible is .* such as many\.zarr.* method save"
    ):
        jl.simulate_many(survey, scene, key=KEY, **FAST, path=tmp_path / "many.nc")
    (tmp_path / "many.zarr").write_text("no store")
    with pytest.raises(ValueError, match=r"many\.zarr: it is there already and no Zarr store"):
        jl.simulate_many(survey, scene, key=KEY, **FAST, path=tmp_path / "many.zarr")
    with pytest.raises(FileNotFoundError, match=r"none\.zarr: no such folder"):
        jl.Waveforms.open(tmp_path / "none.zarr")


def test_a_dataset_has_units_and_all_waveforms():
    waveforms = jl.simulate_many(nadir(16), stand(), key=KEY, **FAST)
    data = waveforms.to_xarray()
    assert data.reflectance.dims == ("shot", "wavelength", "time")
    assert data.sizes["shot"] == 16
    assert data.energy.attrs["units"] == "J"
    assert np.array_equal(data.components.sel(component="ground"), waveforms.components["ground"])
    assert np.array_equal(data.energy_budget.sel(fate="escaped"), waveforms.energy_budget["escaped"])
    acquisition = waveforms.acquisition
    for name in ("gps_time", "scan_angle", "flight_line", "range_at_time_zero"):
        assert data[name].dims == ("shot",)
        assert np.array_equal(data.coords[name], getattr(acquisition, name), equal_nan=True)
    assert data.gps_time.attrs["units"] == "s"
    wave = waveforms[-1]
    assert isinstance(wave, jl.Waveform)
    assert np.array_equal(wave.reflectance, waveforms.reflectance[15])
    assert wave.info["stopped"] == "tolerance met"
    with pytest.raises(IndexError, match="shot 16: there are 16"):
        waveforms[16]
    assert len(list(waveforms)) == 16


@pytest.mark.slow
def test_footprints_partly_beside_the_map_warn_with_their_fractions():
    survey = jl.Survey(lidar(profile="top-hat"), [(0.0, 0.0), (30.0, 0.0), (300.0, 0.0)])
    with pytest.warns(jl.OffMapWarning, match=r"2 of 3 .*shot 2 with 100 %, shot 1 with 50 % of their light"):
        waveforms = jl.simulate_many(survey, stand(), key=KEY, **FAST)
    assert np.allclose(waveforms.off_map, [0.0, 0.5, 1.0], atol=0.01)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jl.simulate_many(survey, stand(sides="periodic"), key=KEY, **FAST)


NADIR = nadir(2)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (
            {
                "survey": jl.Survey(lidar(), [(0, 0), (6, 0), (18, 0)]),
                "scene": jl.Scene(ground=jl.Terrain(np.eye(21), 2.0, (-20.0, -20.0))),
            },
            ValueError,
            "the footprint of shot 2 of 3 lies off the terrain: .* x = 8.00 to 28.00 m",
        ),
        ({"survey": jl.Lidar()}, TypeError, "survey"),
        ({"scene": 3}, TypeError, "scene"),
        ({"key": 0}, TypeError, "key"),
        ({"rtol": 0.0}, ValueError, r"rtol = 0 is outside the admissible range \(0, 1\)"),
        ({"max_orders": 0}, ValueError, "max_orders = 0"),
        ({"path": 3}, TypeError, "path"),
        ({"executor": 3}, TypeError, "executor"),
        ({"mesh": 3}, TypeError, "mesh"),
        (
            {"mesh": jax.make_mesh((1,), ("shots",)), "executor": Dying([])},
            ValueError,
            "mesh and executor are both given",
        ),
        ({"progress": 3}, TypeError, "progress"),
        (
            {"survey": jl.Survey(lidar(altitude=10.0), [(0, 0)])},
            ValueError,
            "the scene reaches up to the sensor",
        ),
        (
            {"survey": jl.Survey(lidar(receiver=jl.Receiver(window="first return")), [(0, 0)])},
            ValueError,
            "receiver window = 'first return'",
        ),
    ],
)
def test_inadmissible_arguments_are_refused_before_any_work(arguments, error, message, monkeypatch):
    from jaxlidar.survey import simulate_many

    monkeypatch.setattr(simulate_many, "outcomes", lambda *_: pytest.fail("work was done"))
    with pytest.raises(error, match=message):
        jl.simulate_many(**({"survey": NADIR, "scene": stand(), "key": KEY} | arguments))


def test_a_jax_transformation_is_refused_with_its_cause():
    """Within a program all that is computed is traced, also where no argument is."""
    survey, scene = NADIR, jl.Scene(ground=jl.Ground())
    message = r"simulate_many cannot run inside a JAX transformation \(jit, .* use simulate for each shot"

    def scaled(x):
        return x * jl.simulate_many(survey, scene, key=KEY).reflectance.sum()

    def of_reflectance(reflectance):
        ground = jl.Ground(reflectance=reflectance)
        return jl.simulate_many(survey, jl.Scene(ground=ground), key=KEY).reflectance.sum()

    for transformed in (jax.jit(scaled), jax.jit(of_reflectance), jax.grad(of_reflectance)):
        with pytest.raises(TypeError, match=message):
            transformed(0.3)


def test_an_interrupt_says_where_finished_shots_are(tmp_path, monkeypatch):
    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["jaxlidar.survey.simulate_many"], "_trace", interrupted)
    survey = jl.Survey(jl.Lidar(), position=[(0, 0), (10, 0)])
    scene = jl.Scene(ground=jl.Ground())
    with pytest.raises(KeyboardInterrupt) as interrupt:
        jl.simulate_many(survey, scene, key=jax.random.key(0), path=tmp_path / "a.zarr")
    assert "a.zarr: the same call continues" in interrupt.value.__notes__[0]


@pytest.mark.slow
def test_a_tree_on_a_lawn_is_not_cut_off():
    survey = jl.Survey(lidar(), [(2.0, 2.0), (20.0, 0.0)])
    lad = np.zeros((4, 4, 2))
    lad[1:3, 1:3] = 0.5
    for row in ((0, 0), (3, 1), (1, 0), (2, 3)):
        canopies = []
        for density in (0.0, 0.5):
            lad[row] = density
            voxels = jl.VoxelMap.from_lad(lad, voxel_size=1.0)
            canopies.append(jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4)))
        lad[row] = 0.0
        assert [coverage.is_cut_off(canopy) for canopy in canopies] == [False, True]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = jl.Scene(canopy=canopies[0], ground=jl.Ground())
        waveforms = jl.simulate_many(survey, scene, key=KEY, max_orders=1, rtol=0.2)
    assert waveforms.off_map[1] == 1.0


def test_light_off_the_map_is_that_of_a_circular_segment():
    # A disc of radius r whose middle lies h r inside of a straight rim: acos(h) - h sqrt(1 - h^2) over pi.
    voxels = jl.VoxelMap.from_lad(np.ones((40, 40, 1)), voxel_size=1.0)
    scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4)))
    inside = np.array([-1.5, -0.9, -0.3, 0.0, 0.4, 0.8, 0.999, 1.001, 1.5, 8.0])
    beam = jl.Lidar(altitude=1e6, divergence=4e-3, profile="top-hat")
    radius = float(beam.footprint_radius)
    survey = jl.Survey(beam, np.column_stack([radius * inside, np.full(inside.size, 20.0)]))
    h = np.clip(inside, -1.0, 1.0)
    expected = (np.arccos(h) - h * np.sqrt(1.0 - h**2)) / np.pi
    fractions = off_map(survey, scene)
    assert np.allclose(fractions, expected, atol=0.01)
    assert not np.allclose(fractions, expected[::-1], atol=0.01)
    assert np.all(fractions[inside > 1.0] == 0.0)


def test_heights_of_terrain_are_compiled_once():
    terrain = jl.Terrain(np.add.outer(np.arange(9.0), np.zeros(9)), 10.0, (-40.0, -40.0))
    surveys = [jl.Survey(lidar(), np.full((count, 2), 3.0)) for count in (20, 22)]
    heights = [ground_heights(survey, jl.Scene(ground=terrain), 50.0) for survey in surveys]
    assert np.allclose(np.concatenate(heights), 4.3, atol=1e-4)
    n_versions = len(coverage._compiled_distance.versions)
    assert n_versions >= 1
    ground_heights(surveys[0], jl.Scene(ground=terrain), 50.0)
    assert len(coverage._compiled_distance.versions) == n_versions
