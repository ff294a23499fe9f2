"""Fits of GEDI shots: preparation, columns, damaged shots, and numbers of recorded shots."""

import dataclasses

import numpy as np
import pytest

import inversion
from inversion.metrics import gedi_fit
from inversion.scene import layered_canopy
from inversion.scene.layered_canopy import LAYERS
from jaxlidar.io import read_gedi_l1b
from tests.inversion.metrics.test_gedi_table import RECORD, STEP, shot

# Recorded shots, and their fits.
SHOTS = (19640119100108615, 19641102700108384)
EXPECTED = {
    "fit_ground": ((797.8091, 791.1763), 1e-3),
    "fit_ground_stderr": ((0.08405, 0.14328), 1e-3),
    "fit_canopy_top": ((802.6498, 799.3462), 1e-2),
    "fit_slope": ((6.7214, 19.8457), 1e-2),
    "fit_slope_stderr": ((1.0744, 1.9491), 1e-2),
    "fit_pai": ((0.16194, 0.19394), 1e-3),
    "fit_reduced_chi2": ((0.16939, 0.91020), 1e-3),
}


def names_of_fit():
    columns = gedi_fit.ESTIMATES | gedi_fit.LAYER_ESTIMATES
    return [f"fit_{name}" for name in columns]


# -- preparation -------------------------------------------------------------------------------------------


def test_a_shot_is_prepared_about_the_ground():
    record = shot(random=np.random.default_rng(0))
    prepared = gedi_fit.PreparedShot(record, 100.04)
    assert prepared.reference == pytest.approx(100.0, abs=1e-9)
    height = prepared.elevation - prepared.reference
    np.testing.assert_allclose(np.diff(height), -STEP)
    assert prepared.signal.sum() == pytest.approx(1.0)
    # Fractions of the record less the mean of its quiet samples, with the ground at its peak.
    assert height[np.argmax(prepared.signal)] == pytest.approx(0.0, abs=0.5 * STEP)
    quiet = record.waveform[:100]
    expected = record.waveform[np.argmax(record.waveform)] - quiet.mean()
    assert prepared.signal.max() * prepared.total == pytest.approx(expected, abs=1.0)
    # Samples in the receiver's tail have no weight.
    assert np.isinf(prepared.noise[height < -2.2]).all()
    assert np.isfinite(prepared.noise[height > -2.0]).all()
    # The canopy ends at 16 m.
    assert prepared.height == pytest.approx(16.0, abs=2.0)


def test_samples_outside_the_record_have_no_weight():
    prepared = gedi_fit.PreparedShot(shot(bins=420), 100.0)
    is_outside = prepared.elevation > 160.0 + 0.01
    is_outside |= prepared.elevation < 160.0 - STEP * 419 - 0.01
    assert is_outside.any()
    assert np.isinf(prepared.noise[is_outside]).all()
    with pytest.raises(ValueError, match="no signal about the ground"):
        gedi_fit.PreparedShot(shot(waveform=np.full(900, 190.0)), 100.0)


def test_a_second_ground_is_tried_where_the_lowest_mode_is_elsewhere():
    assert gedi_fit.start_grounds(100.0, 100.4) == [100.0]
    assert gedi_fit.start_grounds(100.0, np.nan) == [100.0]
    assert gedi_fit.start_grounds(100.0, 98.0) == [100.0, 98.0]


def test_pulses_of_any_length_become_those_of_one_length():
    record = shot()
    pulse = gedi_fit._padded_pulse(record, 100)
    np.testing.assert_allclose(pulse.time, np.arange(100.0) - 40.0)
    np.testing.assert_allclose(pulse.samples, np.r_[record.pulse_power, np.zeros(19)], rtol=1e-6)
    assert gedi_fit._padded_pulse(record, 81).samples.shape == (81,)


# -- columns -----------------------------------------------------------------------------------------------


def unusable_shots():
    """Return shots that are refused before anything is compiled."""
    return [shot(1, noise_std=-1.0), shot(2, waveform=np.full(900, np.nan))]


def test_shots_without_a_fit_have_columns_of_nan_and_the_reason(tmp_path):
    plain = inversion.gedi_table(unusable_shots())
    table = inversion.gedi_table(unusable_shots(), fit=True, path=tmp_path / "fits.zarr")
    assert list(table)[: len(plain.columns)] == list(plain)
    assert list(table)[len(plain.columns) :] == [*names_of_fit(), "fit_quality", "fit_reasons"]
    for name in names_of_fit():
        assert np.isnan(table[name]).all(), name
        assert table.columns[name].description.startswith("fit: ")
        assert table.columns[name].unit or name == "fit_reduced_chi2"
    assert table["fit_plant_area_density"].shape == (2, LAYERS)
    assert table["fit_quality"].tolist() == ["bad", "bad"]
    assert table["fit_reasons"].tolist() == plain["reasons"].tolist()
    assert "fits" in table.attributes["title"]
    assert not any(name.startswith("fit_") for name in (*plain, *plain.attributes))
    # Nothing to fit, nothing to continue with.
    assert not (tmp_path / "fits.zarr").exists()


def test_a_shot_that_cannot_be_prepared_is_bad():
    negative = shot(pulse_power=np.where(np.abs(np.arange(81) - 40) < 20, 1.0, -0.1))
    shots = [shot(), negative, shot(noise_std=0.0)]
    estimates, verdicts = gedi_fit.fit_gedi_shots(shots, np.array([np.nan, 100.0, 100.0]), np.full(3, np.nan))
    assert [verdict.quality for verdict in verdicts] == ["bad", "bad", "bad"]
    assert verdicts[0].reasons == ("no ground above the noise",)
    assert "power" in verdicts[1].reasons[0]
    assert verdicts[2].reasons == ("noise_std = 0; a fit needs a record with noise",)
    assert all(np.all(np.isnan(values)) for values in estimates.values())


def test_the_command_stores_fits_until_the_table_is_written(tmp_path, monkeypatch, capsys):
    from inversion.commands import gedi
    from jaxlidar.cli.constants import INTERRUPTED

    record, out = tmp_path / "shots.h5", tmp_path / "shots.csv"
    record.touch()
    stores = []

    def interrupted_once(files, *, path, fit, **options):
        stores.append(path)
        assert fit
        path.mkdir(exist_ok=True)
        if len(stores) == 1:
            raise KeyboardInterrupt
        return inversion.gedi_table(unusable_shots(), fit=True, path=None, **options)

    monkeypatch.setattr("inversion.commands.gedi_table", interrupted_once)
    arguments = [str(record), "-o", str(out), "--fit"]
    assert gedi.main(arguments, standalone_mode=False) == INTERRUPTED
    assert str(stores[0]) in capsys.readouterr().err
    assert stores[0].exists()
    assert not out.exists()
    assert gedi.main(arguments, standalone_mode=False) == 0
    assert stores[1] == stores[0]
    assert not stores[0].exists()
    assert "fit_ground" in out.read_text().splitlines()[0]


# -- fits --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_fits_of_a_made_up_canopy(tmp_path):
    """Two shots of which one is damaged; the second time the fits come from the store."""
    random = np.random.default_rng(0)
    shots = [shot(1, random=random), *unusable_shots(), shot(4, random=random, degrade=1)]
    stages = []
    table = inversion.gedi_table(shots, fit=True, path=tmp_path / "fits.zarr", progress=stages.append)
    assert [(p.done, p.total) for p in stages if p.unit == "fits"] == [(1, 2), (2, 2)]
    assert str(stages[0]).startswith("2 of 2 shots, ")
    assert str(stages[-1]).startswith("2 of 2 fits, ")
    with_fit = np.array([0, 3])
    assert np.isfinite(table["fit_ground"][with_fit]).all()
    assert np.isnan(table["fit_ground"][1:3]).all()
    np.testing.assert_allclose(table["fit_ground"][with_fit], 100.0, atol=0.2)
    # The uppermost layers may be all but empty.
    assert np.all((table["fit_canopy_top"][with_fit] > 115.5) & (table["fit_canopy_top"][with_fit] < 121.0))
    # Half of the energy is the ground's: 1.5 (1 - P) = P, with the gap probability P = exp(-pai / 2).
    np.testing.assert_allclose(table["fit_pai"][with_fit], -2.0 * np.log(0.6), rtol=0.05)
    assert table["fit_quality"][3] == "doubtful"
    assert "degrade" in table["fit_reasons"][3]
    # The sum of the layers is the plant area index.
    depth = table["fit_canopy_top"] - table["fit_ground"] - gedi_fit.CANOPY.clearance
    area = depth * table["fit_plant_area_density"].mean(axis=1)
    np.testing.assert_allclose(table["fit_pai"], area, rtol=1e-9)
    repeated_stages = []
    repeated = inversion.gedi_table(
        shots, fit=True, path=tmp_path / "fits.zarr", progress=repeated_stages.append
    )
    assert all(p.unit == "shots" for p in repeated_stages)
    for name in names_of_fit():
        np.testing.assert_array_equal(repeated[name], table[name])


def canopy_shot(number, random):
    """A shot of a canopy that is even, thins out upwards, or is thin in its upper part; and its top."""
    top, cover = random.uniform(6.0, 32.0), random.uniform(0.1, 0.7)
    base = random.uniform(1.0, 0.4 * top)
    height = 60.0 - STEP * np.arange(900)
    level = (height - base) / (top - base)
    shapes = (np.ones(900), 1.0 - level, np.where(level > 0.6, 0.25, 1.0))
    target = np.where((level > 0.0) & (level < 1.0), shapes[number % 3], 0.0)
    target *= cover / target.sum()
    target[np.argmin(np.abs(height))] += 1.0 - cover
    return shot(number, random=random, target=target), 100.0 + top


@pytest.mark.slow
def test_errors_of_the_top_hold_and_those_of_the_fit_alone_do_not():
    random = np.random.default_rng(5)
    shots, tops = zip(*(canopy_shot(number, random) for number in range(24)))
    table = inversion.gedi_table(shots, fit=True)
    is_good = table["fit_quality"] == "good"
    assert is_good.sum() >= 18
    error, stderr = table["fit_canopy_top"] - tops, table["fit_canopy_top_stderr"]
    assert np.mean(np.abs(error)[is_good] <= 2.0 * stderr[is_good]) >= 0.9
    # Negative control: without what is added for layers that may be empty.
    thickness = (table["fit_canopy_top"] - table["fit_ground"] - gedi_fit.CANOPY.clearance) / LAYERS
    layers = (table["fit_plant_area_density"], table["fit_plant_area_density_stderr"], thickness)
    added = np.array([layered_canopy._top_error(*row) for row in zip(*layers)])
    own = np.sqrt(np.maximum(stderr**2 - added**2, 0.0))
    assert np.mean(np.abs(error)[is_good] <= 2.0 * own[is_good]) < 0.7


@pytest.mark.slow
def test_fits_of_recorded_shots_keep_their_numbers(shared, tmp_path):
    path = shared / RECORD
    if not path.is_file():
        pytest.skip("the recorded GEDI file is not beside this checkout")
    shots = read_gedi_l1b(path, SHOTS)
    plain, table = inversion.gedi_table(shots), inversion.gedi_table(shots, fit=True)
    for name in plain:
        np.testing.assert_array_equal(table[name], plain[name])
    for name, (expected, tolerance) in EXPECTED.items():
        np.testing.assert_allclose(table[name], expected, atol=tolerance, err_msg=name)
    # Standard errors are those of the fit alone, without the distance from the matched mode.
    distance = np.abs(table["fit_ground"] - table["ground"])
    assert np.any(table["fit_ground_stderr"] < distance)
    assert table["fit_quality"].tolist() == ["good", "good"]
    table.save(tmp_path / "shots.nc")
    xarray = pytest.importorskip("xarray")
    with xarray.open_dataset(tmp_path / "shots.nc", engine="h5netcdf") as stored:
        assert stored["fit_ground"].attrs == {"units": "m", "long_name": "fit: elevation of the ground"}
        assert stored["fit_plant_area_density"].dims == ("shot", "fit_layer")
        assert stored["fit_layer"].values.tolist() == list(range(1, LAYERS + 1))


def damaged(record):
    """Yield kinds of damage and the changed fields of a shot."""
    waveform, mean, number = record.waveform, record.noise_mean, np.arange(record.waveform.size)
    peak, signal = int(np.argmax(waveform)), record.signal
    end = slice(0, peak + 6)
    yield "clipped", {"waveform": np.minimum(waveform, mean + 0.4 * signal[peak])}
    yield "cut", {name: getattr(record, name)[end] for name in ("waveform", "time", "elevation")}
    yield "padded", {"waveform": np.where(number > peak + 5, mean, waveform)}
    quiet = np.random.default_rng(0).normal(size=waveform.size)
    yield "noise", {"waveform": mean + 0.5 * record.noise_std * quiet}
    yield "dead", {"waveform": np.where(number == peak - 6, mean, waveform)}
    yield "gain", {"waveform": mean + signal * np.where(number >= peak, 2.0, 1.0)}


@pytest.mark.slow
def test_damaged_shots_are_not_good(shared):
    """Two good shots, and six damaged copies of each."""
    path = shared / RECORD
    if not path.is_file():
        pytest.skip("the recorded GEDI file is not beside this checkout")
    intact = read_gedi_l1b(path, SHOTS)
    copies = [
        (name, dataclasses.replace(record, **change)) for record in intact for name, change in damaged(record)
    ]
    table = inversion.gedi_table([*intact, *(record for _, record in copies)], fit=True)
    quality = table["fit_quality"].tolist()
    assert quality[:2] == ["good", "good"]
    assert [name for (name, _), q in zip(copies, quality[2:]) if q == "good"] == []
