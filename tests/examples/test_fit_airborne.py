"""`examples/fit_airborne.py`: records of every format, refused arguments, and fits."""

import argparse
import csv
import dataclasses
import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

import inversion
from inversion.scene import layered_canopy
from jaxlidar.io import AirborneShot, Segment, write_las_waveforms
from tests.io import test_neon, test_pulsewaves

HALF_PATH = np.array([0.0, 0.0, -0.149896229])
GROUND, ANCHOR = 290.0, 300.0
FWHM = 4.0
NO_OPTIONS = {"pulse": None, "pulses": None, "pulse_width": None, "instrument": None}


@pytest.fixture(scope="module")
def example():
    """Return a function that imports a module of the folder of examples by name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "examples"))
        yield importlib.import_module


def echo(positions, broadening=0.0, size=120):
    """Return counts of hard targets: Gaussians as wide as the pulse at (sample, height), above a pedestal."""
    sigma = np.hypot(FWHM / 2.3548, broadening)
    samples = sum(a * np.exp(-0.5 * ((np.arange(size) - t) / sigma) ** 2) for t, a in positions)
    noise = np.random.default_rng(size + len(positions)).normal(size=size)
    return np.round(np.maximum(20.0 + samples + 0.7 * noise, 0.0)).astype(np.uint16)


def las_of(folder, *samples):
    """Write a LAS file of shots straight down."""
    geometry = {"anchor": np.array([5e5, 4e6, ANCHOR]), "direction": HALF_PATH}
    shots = [
        AirborneShot(i, **geometry, returning=(Segment(counts, 0.0),), gps_time=10.0 + i)
        for i, counts in enumerate(samples)
    ]
    write_las_waveforms(folder / "small.las", shots)
    return folder / "small.las"


def written(folder):
    """Write a small file of every format; return the options that each needs."""
    small = dict(zip((".pls", ".wvs"), test_pulsewaves.small_files()))
    for suffix, content in small.items():
        (folder / f"small{suffix}").write_bytes(content)
    return {
        test_neon.write_small(folder / "small.npz"): {},
        folder / "small.pls": {},
        las_of(folder, echo([(60, 100)]), echo([(30, 50), (60, 100)])): {"pulse_width": FWHM},
    }


def test_every_format_gives_the_same_records(example, tmp_path):
    airborne = example("_airborne")
    for path, options in written(tmp_path).items():
        flight = airborne.read_flight(path, argparse.Namespace(**{**NO_OPTIONS, **options}))
        # The counts of the small PulseWaves file are not those that its table has.
        flight = flight._replace(tables={})
        records = airborne.records_of(flight.shots[:], flight)
        assert len(records) >= 2
        for record, shot in zip(records, flight.shots, strict=True):
            assert record.signal.shape == record.noise.shape == record.elevation.shape == shot.time.shape
            assert record.signal.max() == pytest.approx(1.0)
            np.testing.assert_array_equal(np.isfinite(record.noise), shot.recorded)
            np.testing.assert_allclose(record.elevation, shot.elevation)
            assert record.lidar.sampling_interval == shot.sampling_interval
            zero = shot.pulse_time[np.argmax(shot.pulse_power)] if shot.outgoing else 0.0
            assert np.argmax(record.pulse(30)) == pytest.approx(30 + zero / shot.sampling_interval, abs=1)
            assert record.saturated == 0


def test_saturated_samples_have_no_weight(example, tmp_path):
    airborne, counts = example("_airborne"), np.minimum(echo([(60, 200)]), 150)
    path = las_of(tmp_path, counts)
    options = argparse.Namespace(**{**NO_OPTIONS, "pulse_width": FWHM, "saturation": 150.0})
    flight = airborne.read_flight(path, options)
    (record,) = airborne.records_of(flight.shots[:], flight)
    assert record.saturated == np.sum(counts == 150) > 2
    np.testing.assert_array_equal(np.isinf(record.noise), counts == 150)
    np.testing.assert_array_equal(record.signal[counts == 150], 0.0)


def test_interleaved_digitisers_have_their_own_pedestals(example, tmp_path):
    airborne, counts = example("_airborne"), echo([(60, 100)])
    path = las_of(tmp_path, counts + 10 * (np.arange(counts.size) % 2).astype(np.uint16))
    options = argparse.Namespace(**{**NO_OPTIONS, "pulse_width": FWHM, "interleaved": 2})
    flight = airborne.read_flight(path, options)
    (record,) = airborne.records_of(flight.shots[:], flight)
    assert np.abs(record.signal[np.r_[:45, 75:120]]).max() < 0.04


def test_a_pulse_is_read_from_a_table(example, tmp_path):
    airborne, path = example("_airborne"), las_of(tmp_path, echo([(60, 100)]))
    (tmp_path / "pulse.csv").write_text("-4,0\n-1,3\n0,4\n6,0\n")
    flight = airborne.read_flight(path, argparse.Namespace(**{**NO_OPTIONS, "pulse": tmp_path / "pulse.csv"}))
    (record,) = airborne.records_of(flight.shots[:], flight)
    np.testing.assert_array_equal(record.lidar.pulse.time, [-4.0, -1.0, 0.0, 6.0])


def test_pulses_of_the_same_shots_are_found_by_time(example, tmp_path):
    (tmp_path / "a").mkdir()
    airborne, path = example("_airborne"), las_of(tmp_path / "a", echo([(60, 100)]))
    pulses = next(p for p in written(tmp_path) if p.suffix == ".pls")
    with pytest.raises(ValueError, match=r"small\.pls: it has no pulse at the GPS times"):
        airborne.read_flight(path, argparse.Namespace(**{**NO_OPTIONS, "pulses": pulses}))


REFUSED = {
    "suffix": (["small.csv"], r"small\.csv: its suffix is '\.csv'; admissible are \.npz, \.pls, \.las"),
    "missing": (["none.pls"], r"none\.pls"),
    "damaged": (["damaged.pls"], r"damaged\.pls: header"),
    "no waves": (["alone.pls"], r"alone\.wvs"),
    "no pulse": (["small.las"], r"small\.las: shots have no outgoing pulse; give one with --pulse, "),
    "width": (["small.las", "--pulse-width", "-1"], r"--pulse-width = -1; admissible is \(0, inf\) ns"),
    "table": (["small.las", "--pulse", "bad.txt"], r"bad\.txt: 3 columns; admissible are two"),
    "negative": (["small.las", "--pulse", "negative.txt"], r"negative\.txt: power"),
    "own pulses": (["small.npz", "--pulse-width", "4"], r"small\.npz: shots have their own outgoing pulses"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(example, tmp_path, monkeypatch, case):
    arguments, message = REFUSED[case]
    monkeypatch.chdir(tmp_path)
    pls = next(p for p in written(tmp_path) if p.suffix == ".pls").read_bytes()
    for name, content in {
        "small.csv": b"",
        "damaged.pls": pls[:100],
        "alone.pls": pls,
        "bad.txt": b"0 1 2\n1 2 3\n",
        "negative.txt": b"0 1\n1 -2\n",
    }.items():
        Path(name).write_bytes(content)
    with pytest.raises(SystemExit, match=message):
        example("fit_airborne").main(arguments)


@pytest.mark.slow
def test_echoes_decide_which_scene_is_fitted(example, tmp_path, monkeypatch, capsys):
    """One echo: ground; two: ground and canopy; none: a row with the reason."""
    module = example("fit_airborne")
    fitted = []

    def fit(kind, records, echoes, instrument, impulse, path, progress):
        fitted.append((kind.name, [record.shot.index for record in records]))
        time, n = np.arange(-60.0, 30.0), len(records)
        values = {"ground": np.zeros(n), "scale": np.ones(n)}
        if kind.canopy:
            values |= {"canopy height": np.full(n, 5.0), "log density": np.zeros((n, 10))}
        else:
            values |= {"receiver width": np.where(np.array([r.shot.index for r in records]) == 3, 3.0, 0.1)}
        errors = {name: np.full_like(v, 0.1) for name, v in values.items()}
        n_values = sum(v[0].size for v in values.values())
        fits = inversion.Retrieval(
            values=values,
            stderr=errors,
            robust_stderr=errors,
            prior_share={},
            at_bound={},
            covariance=np.tile(0.01 * np.eye(n_values), (n, 1, 1)),
            reduced_chi2=np.ones(n),
            second_minimum=np.ones(n),
            independent_samples=np.ones(n),
            averaging=np.zeros((n, n_values, n_values)),
            strength={},
            bounds={},
            converged=np.ones(n, bool),
            steps=np.ones(n, int),
            simulation_error={},
            residuals=np.zeros((n, 1, time.size)),
            fitted=np.zeros((n, 1, time.size)),
            status=("converged",) * n,
            labels=("",) * n_values,
        )
        windows = [module.window_of(r, e[-1], time) for r, e in zip(records, echoes)]
        recorder = inversion.Recorder(width=(0.1, 5.0))
        return module.FittedBatch(fits, windows, [recorder] * n, np.full(n, 4.5))

    monkeypatch.setattr(module, "fit", fit)
    good = inversion.Verdict("good", ())
    monkeypatch.setattr(inversion, "judge_fits", lambda fits, about: (good,) * len(fits.status))
    quiet = np.full(120, 20, np.uint16)
    records = echo([(60, 100)]), echo([(30, 50), (60, 100)]), quiet, echo([(60, 100)], broadening=3.0)
    arguments = [str(las_of(tmp_path, *records)), "--pulse-width", str(FWHM), "--out", str(tmp_path / "out")]
    rows = module.main(arguments)
    assert fitted == [("ground", [0, 3]), ("ground and canopy", [1])]
    assert [row["echoes"] for row in rows] == [1, 2, 0, 1]
    assert [row["quality"] for row in rows] == ["good", "good", "bad", "doubtful"]
    assert rows[2]["reasons"] == "no sample above the pedestal has weight"
    assert rows[3]["reasons"] == "broader by 3.0 ns than an echo of flat hard ground"
    assert rows[0]["ground"] == pytest.approx(ANCHOR + 60 * HALF_PATH[2], abs=0.08)
    assert rows[1]["canopy_top"] - rows[1]["ground"] == pytest.approx(5.0)
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"small.csv", "small.nc", "small.png"}
    with (tmp_path / "out" / "small.csv").open(newline="") as file:
        assert [row["scene"] for row in csv.DictReader(file)] == ["ground", "ground and canopy", "", "ground"]
    assert "2 good, 1 doubtful, 1 bad" in capsys.readouterr().out
    low = dataclasses.replace(module.Instrument(), above=3.0)
    monkeypatch.setitem(sys.modules["_airborne"].INSTRUMENTS, "other", low)
    row = module.main([*arguments[:-1], str(tmp_path / "low")])[1]
    assert (row["scene"], row["echoes"], row["quality"]) == ("ground", 1, "doubtful")
    assert row["reasons"] == "above what is fitted, 3 m over the last echo: 1 more"


@pytest.mark.slow
def test_planted_ground_is_found(example, tmp_path):
    """Single echoes, one of which is broadened: within four standard errors, and what broadened it."""
    positions = 60 + np.random.default_rng(5).uniform(-0.5, 0.5, 6)
    records = [echo([(t, 150)], broadening=2.0 * (i == 5)) for i, t in enumerate(positions)]
    arguments = [str(las_of(tmp_path, *records)), "--pulse-width", str(FWHM), "--out", str(tmp_path / "out")]
    rows = example("fit_airborne").main([*arguments, "--altitude", "500", "--model-error", "0"])
    z = [
        (row["ground"] - (ANCHOR + t * HALF_PATH[2])) / row["ground_stderr"]
        for row, t in zip(rows, positions)
    ]
    assert np.all(np.abs(z) < 4)
    assert all(row["ground_stderr"] < 0.02 for row in rows)
    assert rows[5]["broadening"] == pytest.approx(2.0, abs=4 * rows[5]["broadening_stderr"])
    assert all(row["reasons"].startswith("broader") == (i == 5) for i, row in enumerate(rows))


def canopy_echo(random, size=500):
    """Counts of a canopy over ground that is thin in its upper part, and the height of its top in m."""
    top, cover = random.uniform(6.0, 24.0), random.uniform(0.2, 0.8)
    base, step = random.uniform(1.0, 0.4 * top), -HALF_PATH[2] / 8
    level = (60.0 - step * np.arange(8 * size) - base) / (top - base)
    target = np.where((level > 0.0) & (level < 1.0), np.where(level > 0.6, 0.25, 1.0), 0.0)
    target *= cover / target.sum()
    target[round(60.0 / step)] += 1.0 - cover
    sigma = 8 * FWHM / 2.3548
    pulse = np.exp(-0.5 * (np.arange(-6 * int(sigma), 6 * int(sigma) + 1) / sigma) ** 2)
    record = np.convolve(target, pulse, mode="same")[::8]
    noise = 0.7 * random.normal(size=size)
    return np.round(20.0 + 180.0 * record / record.max() + noise).astype(np.uint16), top


@pytest.mark.slow
def test_errors_of_the_top_hold_and_those_of_the_fit_alone_do_not(example, tmp_path):
    random = np.random.default_rng(3)
    records, tops = zip(*(canopy_echo(random) for _ in range(16)))
    arguments = [str(las_of(tmp_path, *records)), "--pulse-width", str(FWHM), "--out", str(tmp_path / "out")]
    rows = example("fit_airborne").main(arguments)
    top, stderr = (np.array([row[name] for row in rows]) for name in ("canopy_top", "canopy_top_stderr"))
    error = top - (ANCHOR - 60.0 + np.array(tops))
    assert np.mean(np.abs(error) <= 2.0 * stderr) >= 0.9
    # Negative control: without what is added for layers that may be empty.
    added = np.array(
        [
            layered_canopy._top_error(
                row["density"],
                row["density_stderr"],
                (row["canopy_top"] - row["ground"] - row["clearance"]) / layered_canopy.LAYERS,
            )
            for row in rows
        ]
    )
    linear_error = np.sqrt(np.maximum(stderr**2 - added**2, 0.0))
    assert np.mean(np.abs(error) <= 2.0 * linear_error) < 0.7


def test_the_highest_return_is_that_of_the_first_plants(example, tmp_path):
    module, airborne = example("fit_airborne"), example("_airborne")
    records = echo([(30, 10), (60, 60), (90, 100)]), echo([(60, 100)])
    options = argparse.Namespace(**{**NO_OPTIONS, "pulse_width": FWHM})
    flight = airborne.read_flight(las_of(tmp_path, *records), options)
    shots = airborne.records_of(flight.shots[:], flight)
    last = [shots[0].elevation[90], shots[1].elevation[60]]
    windows = [module.window_of(r, e, np.arange(-80.0, 20.0)) for r, e in zip(shots, last)]
    samples = module.highest_returns(shots, windows, None) / -HALF_PATH[2]
    np.testing.assert_allclose(samples, [60.0, 0.0], atol=FWHM)


CASES = {
    "neon": (["neon/neon_harvard_250.npz", "--shots", "4"], 4),
    "riegl": (["airborne/riegl.pls", "--every", "300"], 8),
    "las": (["airborne/riegl.las", "--every", "600", "--pulses", "airborne/riegl.pls"], 4),
    "lvis": (["airborne/lvis_example2.pls", "--every", "250"], 4),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_from_file_to_table(example, shared, tmp_path, case):
    arguments, count = CASES[case]
    arguments = [str(shared / a) if "/" in a else a for a in arguments]
    rows = example("fit_airborne").main([*arguments, "--out", str(tmp_path)])
    repeated_rows = example("fit_airborne").main([*arguments, "--out", str(tmp_path)])
    assert len(rows) == count
    assert [row.get("ground") for row in rows] == [row.get("ground") for row in repeated_rows]
    assert {path.suffix for path in tmp_path.iterdir()} == {".csv", ".nc", ".png", ".zarr", ".lock"}
    assert all(row["quality"] in ("good", "doubtful", "bad") for row in rows)
    assert all(row["reasons"] for row in rows if row["quality"] != "good")
    fitted_rows = [row for row in rows if "ground" in row]
    assert len(fitted_rows) >= count / 2
    assert np.median([abs(row["ground"] - row["last_echo"]) for row in fitted_rows]) < 0.5
