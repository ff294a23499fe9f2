"""The example that fits GEDI shots: from file to table, and damaged shots that must not be judged good."""

import csv
import dataclasses
import importlib
from pathlib import Path

import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.io import GediShot

RECORD = "GEDI01_B_2019108080338_O01964_T05337_02_003_01_sub.h5"
# A shot with plants, and one with hardly any; both fits are good.
SHOTS = (19640119100108615, 19641102700108384)


@pytest.fixture(scope="module")
def example():
    """Return a function that imports a module of the folder of examples by name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "examples"))
        yield importlib.import_module


@pytest.fixture
def gedi(shared):
    pytest.importorskip("h5py")
    return shared / "gedi" / RECORD


def noise_only(number):
    """Return a record of 700 bins without a signal."""
    lag = np.arange(-20.0, 21.0)
    return GediShot(
        beam="BEAM0000",
        shot_number=number,
        time=np.arange(700.0),
        elevation=100.0 - 0.15 * np.arange(700),
        waveform=200.0 + np.random.default_rng(number).normal(size=700),
        noise_mean=200.0,
        noise_std=2.0,
        pulse_time=lag,
        pulse_power=np.exp(-0.5 * (lag / 6.0) ** 2),
        latitude=-10.0,
        longitude=20.0,
        altitude=4e5,
        zenith=0.0,
        azimuth=0.0,
    )


def test_shots_that_cannot_be_fitted_have_a_row_with_the_reason(example, tmp_path):
    unreadable = {"shot_number": 2, "beam": "BEAM0001", "quality": "bad", "reasons": "no pulse"}
    rows, pictures = example("fit_gedi").fit_shots([noise_only(1), unreadable])
    assert pictures == []
    assert [row["quality"] for row in rows] == ["bad", "bad"]
    assert rows[0]["reasons"].startswith("no ground above the noise")
    assert rows[1]["reasons"] == "no pulse"
    paths = example("_recorded").write_tables(rows, tmp_path / "v1.2 of a file", {"latitude": "degrees"})
    assert [path.name for path in paths] == ["v1.2 of a file.csv", "v1.2 of a file.nc"]
    with paths[0].open(newline="") as file:
        table_rows = list(csv.DictReader(file))
    assert [row["shot_number"] for row in table_rows] == ["1", "2"]
    assert [row["latitude"] for row in table_rows] == ["-10.0", "nan"]
    xarray = pytest.importorskip("xarray")
    with xarray.open_dataset(paths[1], engine="h5netcdf") as table:
        assert table["reasons"].values.tolist() == [row["reasons"] for row in rows]
        assert table["latitude"].attrs["units"] == "degrees"


def test_vectors_are_columns(example):
    columns = example("_recorded").columns_of([{"a": 1, "density": np.arange(3.0)}, {"a": 2}])
    assert columns["density"].shape == (2, 3)
    assert np.isnan(columns["density"][1]).all()
    assert columns["a"].tolist() == [1, 2]


def damaged(shot):
    """Yield kinds of damage and the changed fields of a shot."""
    record, mean, number = shot.waveform, shot.noise_mean, np.arange(shot.waveform.size)
    peak, signal = int(np.argmax(record)), shot.signal
    end = slice(0, peak + 6)
    yield "clipped", {"waveform": np.minimum(record, mean + 0.4 * signal[peak])}
    yield "cut", {name: getattr(shot, name)[end] for name in ("waveform", "time", "elevation")}
    yield "padded", {"waveform": np.where(number > peak + 5, mean, record)}
    quiet = np.random.default_rng(0).normal(size=record.size)
    yield "noise", {"waveform": mean + 0.5 * shot.noise_std * quiet}
    yield "dead", {"waveform": np.where(number == peak - 6, mean, record)}
    yield "gain", {"waveform": mean + signal * np.where(number >= peak, 2.0, 1.0)}


@pytest.mark.slow
def test_damaged_shots_are_not_good(example, gedi):
    """Two good shots, and six damaged copies of each."""
    intact = jl.io.read_gedi_l1b(gedi, SHOTS)
    copies = [
        (name, dataclasses.replace(shot, **change)) for shot in intact for name, change in damaged(shot)
    ]
    rows, _ = example("fit_gedi").fit_shots([*intact, *(shot for _, shot in copies)])
    assert [row["quality"] for row in rows[:2]] == ["good", "good"]
    assert [name for (name, _), row in zip(copies, rows[2:]) if row["quality"] == "good"] == []
    assert all(row["reasons"] for row in rows[2:])


@pytest.mark.slow
def test_gedi_from_file_to_table(example, gedi, tmp_path, capsys):
    """One shot, twice: the second time from the store, with the same row."""
    arguments = [str(gedi), "--shot", str(SHOTS[0]), "--out", str(tmp_path)]
    (row,), _ = example("fit_gedi").main(arguments)
    (repeated_row,), _ = example("fit_gedi").main(arguments)
    assert row["quality"] == "good"
    assert row["ground"] == repeated_row["ground"] == pytest.approx(797.9, abs=0.5)
    assert row["shot_number"] == SHOTS[0]
    kinds = {path.suffix for path in tmp_path.iterdir()}
    assert kinds == {".csv", ".nc", ".png", ".zarr", ".lock"}
    assert "1 good, 0 doubtful, 0 bad" in capsys.readouterr().out
