"""Reader of GEDI level 1B files: a small file that is written here, a recorded file, and damaged files."""

import dataclasses
import sys
import warnings

import numpy as np
import pytest

from jaxlidar.io import FileWarning, read_gedi_l1b
from jaxlidar.sensors.pulse import SampledPulse

h5py = pytest.importorskip("h5py")

RECORD = "GEDI01_B_2019108080338_O01964_T05337_02_003_01_sub.h5"
# A NaN whose bits signal an error: NumPy warns where it is cast.
SIGNALLING_NAN = np.array(0x7F800001, np.uint32).view(np.float32)


def _transmitted_pulse(reference):
    """Return 128 counts of a Gaussian pulse that is centred on sample `reference`."""
    t = np.arange(128) - reference
    return 250 + 900 * np.exp(-0.5 * (t / 6) ** 2)


def write_small(path, *, is_subset=False):
    """Write a file of two beams, of 3 shots (40, 50, 60 bins) and of 1 (30).

    Bin k of shot i holds 200 + 10 i + k / 100. `is_subset`: the start indices are those of a larger file, as
    in subsets that some tools cut from a granule.
    """
    bins_of_beams = {"BEAM0001": [40, 50, 60], "BEAM0101": [30]}
    with h5py.File(path, "w") as file:
        for b, (name, bins) in enumerate(bins_of_beams.items()):
            n = len(bins)
            group = file.create_group(name)
            first = np.cumsum(bins) - bins + (123456 if is_subset else 0)
            group["shot_number"] = np.array([10**16 + 10 * b + i for i in range(n)], dtype=np.uint64)
            group["rx_sample_count"] = np.array(bins, dtype=np.uint16)
            group["rx_sample_start_index"] = (first + 1).astype(np.uint64)
            group["tx_sample_count"] = np.full(n, 128, dtype=np.uint16)
            group["tx_sample_start_index"] = (128 * np.arange(n) + 1).astype(np.uint64)
            waveforms = [200.0 + 10 * i + np.arange(c) / 100 for i, c in enumerate(bins)]
            group["rxwaveform"] = np.concatenate(waveforms).astype(np.float32)
            group["txwaveform"] = np.concatenate([_transmitted_pulse(55.25 + i) for i in range(n)]).astype(
                np.float32
            )
            group["tx_gloc"] = (55.25 + np.arange(n)).astype(np.float32)
            group["noise_mean_corrected"] = np.full(n, 199.5)
            group["noise_stddev_corrected"] = np.full(n, 3.0)
            geolocation = group.create_group("geolocation")
            geolocation["elevation_bin0"] = np.full(n, 500.0)
            geolocation["elevation_lastbin"] = 500.0 - 0.15 * (np.array(bins) - 1)
            geolocation["latitude_lastbin"] = np.full(n, -13.5)
            geolocation["longitude_lastbin"] = np.full(n, -44.25)
            geolocation["altitude_instrument"] = np.full(n, 412000.0)
            geolocation["local_beam_elevation"] = np.full(n, np.deg2rad(88.5), dtype=np.float32)
            geolocation["local_beam_azimuth"] = np.full(n, np.deg2rad(-160.0), dtype=np.float32)
    return path


def replace(path, name, change):
    """Replaces a dataset of a file by what `change` makes of its values; by nothing, if it is None."""
    with h5py.File(path, "r+") as file:
        values = file[name][()]
        del file[name]
        if change is not None:
            file[name] = change(values)


def with_value(index, value):
    """A change of one number of a dataset."""

    def change(values):
        changed = values.astype(np.result_type(values, np.asarray(value)))
        changed[index] = value
        return changed

    return change


@pytest.fixture
def small(tmp_path):
    """Path of the small file."""
    return write_small(tmp_path / "small.h5")


@pytest.fixture(scope="module")
def recorded():
    """Shots of the recorded file by their numbers, and values of the level 2 products for 60 of them."""
    from tests.conftest import SHARED

    if not (SHARED / "gedi" / RECORD).is_file():
        pytest.skip("the recorded GEDI file is not beside this checkout")
    level_2 = np.load(SHARED / "gedi" / "level2_answers_60_shots.npz")
    shots = {shot.shot_number: shot for shot in read_gedi_l1b(SHARED / "gedi" / RECORD)}
    return shots, level_2


@pytest.mark.parametrize("is_subset", [False, True])
def test_fields_of_shots(tmp_path, is_subset):
    shots = read_gedi_l1b(write_small(tmp_path / "small.h5", is_subset=is_subset))
    assert [(s.beam, s.shot_number - 10**16, s.time.size) for s in shots] == [
        ("BEAM0001", 0, 40),
        ("BEAM0001", 1, 50),
        ("BEAM0001", 2, 60),
        ("BEAM0101", 10, 30),
    ]
    shot = shots[1]
    np.testing.assert_allclose(shot.waveform, 210 + np.arange(50) / 100, rtol=1e-6)
    np.testing.assert_allclose(shot.signal, shot.waveform - 199.5)
    np.testing.assert_array_equal(shot.time, np.arange(50))
    np.testing.assert_allclose(shot.elevation, 500 - 0.15 * np.arange(50))
    assert (shot.noise_mean, shot.noise_std) == (199.5, 3.0)
    assert (shot.latitude, shot.longitude, shot.altitude) == (-13.5, -44.25, 412000.0)
    assert shot.zenith == pytest.approx(1.5, abs=1e-5)
    assert shot.azimuth == pytest.approx(20.0, abs=1e-4)
    assert shot.pulse_time[shot.pulse_power.argmax()] == pytest.approx(0, abs=0.5)
    pulse = SampledPulse(time=shot.pulse_time, power=shot.pulse_power)
    assert float(pulse.mean) == pytest.approx(0, abs=2e-3)
    assert float(pulse.std) == pytest.approx(6, rel=5e-3)


def test_shots_are_selected_by_index_or_number(small):
    all_shots = read_gedi_l1b(small)

    def numbers(selection):
        return [shot.shot_number for shot in read_gedi_l1b(small, selection)]

    assert numbers(2) == [all_shots[2].shot_number]
    assert numbers([3, 0]) == [all_shots[3].shot_number, all_shots[0].shot_number]
    assert numbers(np.array([1])) == [all_shots[1].shot_number]
    assert numbers(10**16 + 10) == [10**16 + 10]
    assert numbers(np.array([10**16 + 1], dtype=np.uint64)) == [10**16 + 1]
    assert numbers([]) == []
    for selection in (4, -1, 10**16 + 5):
        with pytest.raises(ValueError, match=rf"small\.h5.*{selection}.*\[0, 3\]"):
            read_gedi_l1b(small, selection)
    with pytest.raises(ValueError, match=r"shot = 0\.5"):
        read_gedi_l1b(small, np.array([0.5]))


def test_a_number_that_may_mean_two_shots_is_refused(small):
    """Planted: the shot with this index, whose number is another one."""
    with h5py.File(small, "r+") as file:
        file["BEAM0001/shot_number"][...] = [3, 2, 1]
    message = r"shot = 2 is the number of a shot here and the index of another one; .* `shot_number`"
    with pytest.raises(ValueError, match=message):
        read_gedi_l1b(small, 2)
    # No shot has this number.
    assert read_gedi_l1b(small, 0)[0].shot_number == 3


def test_shots_that_are_no_numbers(small):
    with pytest.raises(TypeError, match=r"shot = 'text' is a str; admissible are an index or a shot number"):
        read_gedi_l1b(small, "text")
    with pytest.raises(TypeError, match=r"shot = '1' is a str; .* or a list of them"):
        read_gedi_l1b(small, [0, "1"])
    with pytest.raises(TypeError, match=r"shot = True is a bool"):
        read_gedi_l1b(small, True)
    with pytest.raises(ValueError, match=r"shot = 1\.5 is neither an index nor a shot number"):
        read_gedi_l1b(small, 1.5)


def test_missing_foreign_and_truncated_files_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.h5"):
        read_gedi_l1b(tmp_path / "none.h5")
    text = tmp_path / "text.h5"
    text.write_text("no HDF5")
    with pytest.raises(ValueError, match=r"text\.h5.*HDF5"):
        read_gedi_l1b(text)
    foreign = tmp_path / "foreign.h5"
    with h5py.File(foreign, "w") as file:
        file["x"] = 1.0
    with pytest.raises(ValueError, match=r"foreign\.h5.*BEAM"):
        read_gedi_l1b(foreign)
    truncated = tmp_path / "truncated.h5"
    truncated.write_bytes(write_small(tmp_path / "small.h5").read_bytes()[:5000])
    with pytest.raises(ValueError, match=r"truncated\.h5"):
        read_gedi_l1b(truncated)


@pytest.mark.parametrize(
    ("field", "change", "message"),
    [
        ("tx_gloc", None, "tx_gloc.*no such dataset"),
        ("rxwaveform", None, "rxwaveform.*no such dataset"),
        ("rxwaveform", lambda x: x[:-1], "rx_sample_start_index.*149"),
        (
            "rxwaveform",
            lambda x: np.where(np.arange(x.size) == 45, np.nan, x),
            "rxwaveform.*0001.*sample 5 is nan",
        ),
        ("tx_sample_count", lambda x: x[:2], "tx_sample_count.*shape"),
        ("rx_sample_count", lambda x: x * 0, "rx_sample_count.*0000.*0 samples"),
        ("tx_gloc", lambda x: x * np.nan, "tx_gloc.*nan"),
        ("tx_gloc", lambda x: x + 100, r"tx_gloc.*155\.25.*\[0, 127\]"),
        ("noise_stddev_corrected", lambda x: -x, "noise_stddev_corrected.*-3"),
        ("geolocation/elevation_lastbin", lambda x: x + 99.0, "geolocation/elevation_lastbin.*below"),
        ("geolocation/elevation_bin0", lambda x: np.array([b"a"] * 3), "geolocation/elevation_bin0.*numbers"),
        (
            "geolocation/elevation_lastbin",
            lambda x: 500 - 1.1 * (500 - x),
            r"geolocation/elevation_lastbin, shot .*0000: 0\.165 m from sample to sample, where .* 0\.1498 m",
        ),
        ("geolocation/local_beam_azimuth", lambda x: x - 10, r"geolocation/local_beam_azimuth.* -12.*6\.28"),
        ("txwaveform", lambda x: 0 * x + 250, "txwaveform, shot .*0000: a pulse without energy.* 250 counts"),
        ("txwaveform", lambda x: 1e30 * x, r"txwaveform, shot .*0000: sample 0 is 2\.5e\+32"),
        (
            "tx_sample_start_index",
            lambda x: x.astype("f2") * np.inf,
            "tx_sample_start_index, shot .*0000: inf",
        ),
        ("tx_sample_count", lambda x: x + 0.5, r"tx_sample_count, shot .*0000: 128\.5 is no whole number"),
        ("shot_number", lambda x: x.astype(float), "shot_number: type float64 where whole numbers belong"),
        ("tx_gloc", lambda x: x[0], r"tx_gloc: shape \(\), where one dimension belongs"),
    ],
)
def test_damage_is_named(small, field, change, message):
    """A shot that is asked for is refused; of all shots, those of the other beam are read."""
    replace(small, f"BEAM0001/{field}", change)
    says = r"small\.h5: /BEAM0001/" + message
    with pytest.warns(FileWarning, match=says):
        shots = read_gedi_l1b(small)
    assert "BEAM0101" in {shot.beam for shot in shots}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ValueError, match=says):
            read_gedi_l1b(small)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"shape": (2**33,)}, "8589934592 numbers are declared, but the file holds 0 of 1 parts"),
        ({"shape": (2**33,), "chunks": (2**20,)}, "the file holds 0 of 8192 parts"),
        ({"shape": (3,), "chunks": (2**28,), "maxshape": (None,), "compression": 9}, "0 of 1 parts"),
        ({"shape": (3,), "external": [("elsewhere.bin", 0, 24)]}, "3 numbers are declared, but"),
    ],
)
def test_a_declared_size_that_the_file_does_not_hold_is_refused(small, options, message):
    """No memory is allocated for it: the first two would need 64 GiB."""
    with h5py.File(small, "r+") as file:
        del file["BEAM0001/noise_mean_corrected"]
        file["BEAM0001"].create_dataset("noise_mean_corrected", dtype="f8", **options)
    says = r"small\.h5: /BEAM0001/noise_mean_corrected: .*" + message
    with pytest.warns(FileWarning, match=says + r".*: 3 of 3 shots of BEAM0001 skipped"):
        assert len(read_gedi_l1b(small)) == 1
    with pytest.raises(ValueError, match=says):
        read_gedi_l1b(small, 0)


def test_a_chunk_far_larger_than_the_file_is_refused(small):
    with h5py.File(small, "r+") as file:
        values = file["BEAM0001/tx_gloc"][()]
        del file["BEAM0001/tx_gloc"]
        options = {"chunks": (2**23,), "maxshape": (None,), "compression": 9}
        file["BEAM0001"].create_dataset("tx_gloc", data=values, **options)
    with pytest.raises(ValueError, match="/BEAM0001/tx_gloc: 33554432 bytes are declared in a file of"):
        read_gedi_l1b(small, 0)


def test_beams_without_a_selected_shot_are_not_read(small):
    with h5py.File(small, "r+") as file:
        del file["BEAM0101/rxwaveform"]
    assert [shot.beam for shot in read_gedi_l1b(small, [0, 10**16 + 2])] == ["BEAM0001"] * 2
    with pytest.raises(ValueError, match="/BEAM0101/rxwaveform: no such dataset"):
        read_gedi_l1b(small, 3)


def test_selected_shots_equal_those_of_the_whole_file(small):
    all_shots = read_gedi_l1b(small)
    for shot, i in zip(read_gedi_l1b(small, [3, 0, 2, 0]), (3, 0, 2, 0)):
        np.testing.assert_array_equal(shot.waveform, all_shots[i].waveform)
        np.testing.assert_array_equal(shot.pulse_power, all_shots[i].pulse_power)


def test_missing_h5py_names_the_extra_to_install(small, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ImportError, match=r"jaxlidar\[io\]"):
        read_gedi_l1b(small)


def test_recorded_shots_are_plausible(recorded):
    shots, _ = recorded
    assert len(shots) == 300
    assert len({shot.beam for shot in shots.values()}) == 7
    for shot in shots.values():
        # 1 ns is 0.14990 m of range, at a zenith of 0.5 to 1.5 degrees, in air, 0.1498 m of elevation.
        np.testing.assert_allclose(-np.diff(shot.elevation), 0.1498, rtol=1e-3)
        assert 0.4 < shot.zenith < 1.6
        assert abs(np.median(shot.signal[:100])) < 3 * shot.noise_std
        assert shot.signal.max() > 20 * shot.noise_std
        above_half = shot.pulse_time[shot.pulse_power > shot.pulse_power.max() / 2]
        assert 10 <= above_half[-1] - above_half[0] <= 22
        assert 0 < np.average(shot.pulse_time, weights=shot.pulse_power) < 4


def test_recorded_ground_and_canopy_top_agree_with_level_2(recorded):
    """Waveforms have a maximum at the ground of level 2, and only noise above its highest return."""
    shots, level_2 = recorded
    ground_errors, signal_above_top = [], []
    for i, number in enumerate(level_2["shot"]):
        shot = shots[int(number)]
        ground, top = level_2["elev_lowestmode"][i], level_2["elev_highest"][i]
        near_ground = np.abs(shot.elevation - ground) < 2.0
        ground_errors.append(shot.elevation[near_ground][shot.signal[near_ground].argmax()] - ground)
        assert shot.elevation[-1] < ground < top < shot.elevation[0]
        signal_above_top.append(shot.signal[shot.elevation > top + 1.0].max() / shot.noise_std)
        # Level 2 gives rh in whole centimetres above the lowest mode, rounded down.
        assert top - ground == pytest.approx(level_2["rh100"][i] / 100, abs=0.02)
    # The lowest mode may be the shoulder of a larger echo, which has its maximum elsewhere.
    assert np.max(np.abs(ground_errors)) < 1.0
    assert abs(np.median(ground_errors)) < 0.1
    # The maximum of a noisy echo, in bins of 0.15 m.
    assert np.median(np.abs(ground_errors)) < 0.2
    assert np.quantile(signal_above_top, 0.9) < 5
    # The energies of canopy (rv) and ground (rg) in level 2B sum to the integral of the waveform.
    energy = np.array([shots[int(n)].signal.sum() for n in level_2["shot"]])
    ratio = energy / (level_2["rv"] + level_2["rg"])
    assert abs(np.median(ratio) - 1) < 0.05


def test_time_zero_of_the_pulse_places_the_ground_where_level_2_has_it(recorded):
    """Where vegetation is low, the recorded pulse is shifted until it fits the echo best."""
    shots, level_2 = recorded
    shifts = np.arange(-6.0, 6.0, 0.1)
    errors = []
    for number, ground, height in zip(level_2["shot"], level_2["elev_lowestmode"], level_2["rh100"]):
        shot = shots[int(number)]
        if height > 600:  # cm
            continue
        peak = int(shot.signal.argmax())
        window = slice(peak - 60, peak + 90)
        time, signal = shot.time[window] - peak, shot.signal[window]
        echoes = [np.interp(time - d, shot.pulse_time, shot.pulse_power, 0.0, 0.0) for d in shifts]
        # Least squares with a free amplitude: the sum of squares that each echo explains.
        explained = [(echo @ signal) ** 2 / (echo @ echo) for echo in echoes]
        errors.append(shot.elevation[peak] - 0.1498 * shifts[np.argmax(explained)] - ground)
    assert len(errors) > 30
    # The mean error is 0.07 m, as level 2 fits another shape. With time zero at the centroid it is 0.4 m.
    assert abs(np.mean(errors)) < 0.1
    assert np.std(errors) < 0.1


def test_flags_stay_with_the_shot(small):
    """Absent in this subset; where they are, each shot keeps its own, and damaged ones are left out."""
    assert [(s.degrade, s.stale_return) for s in read_gedi_l1b(small)] == [(None, None)] * 4
    with h5py.File(small, "a") as file:
        file["BEAM0001/geolocation/degrade"] = np.array([0, 30, 80], np.int8)
        file["BEAM0001/stale_return_flag"] = np.array([0, 1, 0], np.uint8)
    shots = read_gedi_l1b(small)
    assert [s.degrade for s in shots] == [0, 30, 80, None]
    assert [s.stale_return for s in shots] == [0, 1, 0, None]
    with h5py.File(small, "a") as file:
        del file["BEAM0001/stale_return_flag"]
        file["BEAM0001/stale_return_flag"] = np.array([0, 1], np.uint8)
    with pytest.warns(FileWarning, match="stale_return_flag: shape .*: it is left out"):
        shots = read_gedi_l1b(small)
    assert [(s.degrade, s.stale_return) for s in shots] == [(0, None), (30, None), (80, None), (None, None)]


def test_flags_in_floating_point(small):
    with h5py.File(small, "a") as file:
        file["BEAM0001/geolocation/degrade"] = np.array([0.0, 30.0, 80.0])
    assert [s.degrade for s in read_gedi_l1b(small)] == [0, 30, 80, None]
    replace(small, "BEAM0001/geolocation/degrade", lambda x: np.array([0.0, np.nan, np.inf]))
    with pytest.warns(
        FileWarning, match=r"degrade, shot .*1: nan is no whole number: 2 of 3 flags of BEAM0001"
    ):
        assert [s.degrade for s in read_gedi_l1b(small)] == [0, None, None, None]


def numbers_of(shots):
    return [shot.shot_number - 10**16 for shot in shots]


@pytest.mark.parametrize(
    ("field", "index", "value", "says"),
    [
        ("geolocation/elevation_bin0", 1, np.nan, "elevation_bin0, shot .*1: nan is outside"),
        ("geolocation/elevation_lastbin", 1, -999999.0, "elevation_lastbin, shot .*1: -999999 is outside"),
        ("geolocation/altitude_instrument", 1, -9999.0, "altitude_instrument, shot .*1: -9999 is outside"),
        ("noise_mean_corrected", 1, -9999.0, r"noise_mean_corrected, shot .*1: -9999 .* range \[0, 1e\+09\]"),
        ("noise_mean_corrected", 1, 9.96921e36, r"noise_mean_corrected, shot .*1: 9\.96921e\+36 is outside"),
        ("rx_sample_count", 1, 0, "rx_sample_count, shot .*1: 0 samples; at least 2"),
        ("rx_sample_count", 1, -9999.0, "rx_sample_count, shot .*1: -9999 is no whole number"),
        ("rxwaveform", 45, np.nan, "rxwaveform, shot .*1: sample 5 is nan"),
        ("rxwaveform", 45, SIGNALLING_NAN, "rxwaveform, shot .*1: sample 5 is nan"),
        ("tx_gloc", 1, SIGNALLING_NAN, "tx_gloc, shot .*1: nan is outside"),
        ("tx_gloc", 1, np.nan, "tx_gloc, shot .*1: nan is outside"),
    ],
)
def test_one_shot_that_is_not_complete(small, field, index, value, says):
    """It is skipped and counted; the others are what they were, and keep their indices."""
    expected = read_gedi_l1b(small)
    replace(small, f"BEAM0001/{field}", with_value(index, value))
    with pytest.warns(
        FileWarning, match=rf"small\.h5: /BEAM0001/.*{says}.*: 1 of 3 shots of BEAM0001 skipped"
    ):
        shots = read_gedi_l1b(small)
    assert numbers_of(shots) == [0, 2, 10]
    for shot, i in zip(shots, (0, 2, 3), strict=True):
        np.testing.assert_array_equal(shot.waveform, expected[i].waveform)
        np.testing.assert_array_equal(shot.pulse_power, expected[i].pulse_power)
    assert numbers_of(read_gedi_l1b(small, [2, 3])) == [2, 10]
    with pytest.raises(ValueError, match=says):
        read_gedi_l1b(small, 1)


@pytest.mark.parametrize("fill", [240.0, np.array([240.0])])
def test_fill_values_that_a_dataset_declares(small, fill):
    """Also those that could be numbers of a shot."""
    with h5py.File(small, "r+") as file:
        file["BEAM0001/noise_mean_corrected"][1] = 240.0
        file["BEAM0001/noise_mean_corrected"].attrs["_FillValue"] = fill
    with pytest.warns(FileWarning, match="noise_mean_corrected, shot .*1: nan is outside"):
        assert numbers_of(read_gedi_l1b(small)) == [0, 2, 10]


@pytest.mark.parametrize("value", [0, 2**64 - 1, np.nan, None])
def test_missing_start_indices(small, value):
    """The counts locate the samples; without them, the neighbours do."""
    expected = read_gedi_l1b(small)
    field = "BEAM0001/rx_sample_start_index"
    change = None if value is None else with_value(1, np.uint64(value) if isinstance(value, int) else value)
    replace(small, field, change)
    says = r"small\.h5: /BEAM0001/rx_sample_start_index, shot .*is no whole number in \[1, 150\]"
    with pytest.warns(FileWarning, match=says):
        shots = read_gedi_l1b(small)
    assert numbers_of(shots) == numbers_of(expected)
    for shot, original in zip(shots, expected):
        np.testing.assert_array_equal(shot.waveform, original.waveform)


def test_samples_that_are_not_stored(small):
    """The last shot's are cut short: its own index says so, and no other shot moves."""
    expected = read_gedi_l1b(small)
    replace(small, "BEAM0001/rxwaveform", lambda x: x[:-1])
    says = r"rx_sample_start_index, shot .*2: samples 91 to 150 of 149 .*: 1 of 3 shots"
    with pytest.warns(FileWarning, match=says):
        shots = read_gedi_l1b(small)
    assert numbers_of(shots) == [0, 1, 10]
    replace(small, "BEAM0001/rx_sample_start_index", with_value(1, np.uint64(0)))
    with pytest.warns(FileWarning) as caught:
        shots = read_gedi_l1b(small)
    assert [str(w.message).rpartition(": ")[2] for w in caught] == [
        "1 of 3 shots of BEAM0001 skipped",
        "the samples of 1 shots of BEAM0001 are located by the counts",
    ]
    np.testing.assert_array_equal(shots[1].waveform, expected[1].waveform)
    # Where the neighbours leave room for another number of samples, the shot is skipped. As the counts now
    # add up to the samples stored, so is the shot that they place elsewhere than its index does.
    replace(small, "BEAM0001/rx_sample_count", with_value(1, np.uint16(49)))
    with pytest.warns(FileWarning, match=r"1: 0 does not place its 49 samples between .*: 2 of 3"):
        assert numbers_of(read_gedi_l1b(small)) == [0, 10]


def test_indices_of_the_full_file_and_missing_samples(small):
    """Which samples are missing is not known: no shot of the beam is read at another's place."""
    replace(small, "BEAM0001/rxwaveform", lambda x: x[:-1])
    replace(small, "BEAM0001/rx_sample_start_index", lambda x: x + np.uint64(50))
    with pytest.warns(
        FileWarning, match=r"neither do the indices fit the 149 .*\(150 in all\): 3 of 3 shots"
    ):
        assert numbers_of(read_gedi_l1b(small)) == [10]


@pytest.mark.parametrize("content", ["empty", "numbers alone", "dataset"])
def test_beams_that_are_not_complete(small, content):
    with h5py.File(small, "r+") as file:
        if content == "dataset":
            file["BEAM0010"] = np.zeros(3)
        else:
            group = file.create_group("BEAM0010")
        if content == "numbers alone":
            group["shot_number"] = np.array([10**16 + 90, 10**16 + 91], np.uint64)
    says = {"numbers alone": r": 2 of 2 shots of BEAM0010 skipped"}.get(content, ": the beam is skipped")
    with pytest.warns(FileWarning, match=r"small\.h5: /BEAM0010/.*: no such dataset.*" + says):
        assert numbers_of(read_gedi_l1b(small)) == [0, 1, 2, 10]
    if content == "numbers alone":
        with pytest.raises(ValueError, match=r"/BEAM0010/.*: no such dataset"):
            read_gedi_l1b(small, 10**16 + 91)


def test_a_beam_without_shots_is_complete(small):
    with h5py.File(small, "r+") as file:
        file.create_group("BEAM0010")["shot_number"] = np.zeros(0, np.uint64)
    assert len(read_gedi_l1b(small)) == 4


def test_a_file_without_a_complete_shot(small):
    for name in ("BEAM0001", "BEAM0101"):
        replace(small, f"{name}/tx_gloc", lambda x: x * np.nan)
    with pytest.raises(ValueError, match=r"small\.h5: /BEAM0001/tx_gloc, shot .*0: nan is outside"):
        read_gedi_l1b(small)
    for name in ("BEAM0001", "BEAM0101"):
        replace(small, f"{name}/shot_number", None)
    with pytest.raises(ValueError, match=r"small\.h5: /BEAM0001/shot_number: no such dataset"):
        read_gedi_l1b(small)


def test_saturated_bins_are_counted(small, recorded):
    shot = read_gedi_l1b(small, 0)[0]
    assert shot.saturated == 0
    clipped = dataclasses.replace(shot, waveform=np.minimum(shot.waveform, shot.waveform[30]))
    assert clipped.saturated == 10
    shots, _ = recorded
    assert not any(s.saturated or s.degrade or s.stale_return for s in shots.values())
