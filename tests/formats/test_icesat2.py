"""Readers of ICESat-2's ATL03 and ATL08: small files that are written here, and a recorded track."""

import warnings

import numpy as np
import pytest

from jaxlidar.io import FileWarning, read_atl03, read_atl08

h5py = pytest.importorskip("h5py")
COUNTS = [3, 0, 2, 4]


def write_photons(path, *, beams=("gt1r",), offset=0, impulse=False):
    """Write 9 photons in four segments of 20 m, the second of them empty. `offset`: of the start indices."""
    n, counts = sum(COUNTS), np.array(COUNTS)
    with h5py.File(path, "w") as file:
        for beam in beams:
            group = file.create_group(beam)
            group.attrs["atlas_spot_number"] = np.array([b"4"])
            segments = {
                "segment_ph_cnt": counts,
                "ph_index_beg": np.where(counts > 0, np.cumsum(counts) - counts + 1 + offset, 0),
                "segment_dist_x": 5e6 + 20.0 * np.arange(4),
                "segment_length": np.full(4, 20.0),
                "segment_id": 700 + np.arange(4),
                "reference_photon_lat": 41.0 + 0.001 * np.arange(4),
                "reference_photon_lon": np.full(4, -106.0),
                "solar_elevation": np.full(4, 33.0, np.float32),
                "tx_pulse_width_lower": np.full(4, 1.4e-9, np.float32),
            }
            photons = {
                "h_ph": 2000.0 + np.arange(n, dtype=np.float32),
                "dist_ph_along": np.tile([1.0, 2.0, 3.0], 3).astype(np.float32),
                "lat_ph": 41.0 + 1e-4 * np.arange(n),
                "lon_ph": np.full(n, -106.0),
                "delta_time": 1e8 + 1e-4 * np.arange(n),
                "signal_conf_ph": np.stack([np.arange(n) % 5, *[np.full(n, -1)] * 4], axis=1).astype(np.int8),
                "quality_ph": np.zeros(n, np.int8),
                "pce_mframe_cnt": np.full(n, 77, np.uint32),
                "ph_id_pulse": (1 + np.arange(n)).astype(np.uint8),
            }
            background = {"delta_time": [1e8, 1e8 + 8e-4], "bckgrd_rate": [1e6, 2e6]}
            for folder, columns in (
                ("geolocation", segments),
                ("heights", photons),
                ("bckgrd_atlas", background),
            ):
                for name, values in columns.items():
                    group[f"{folder}/{name}"] = values
        if impulse:
            file["ancillary_data/tep/tep_valid_spot"] = np.array([1, 1, 3, 3, 1, 3])
            time = 20e-9 + 0.05e-9 * np.arange(2000)
            histogram = 5.0 + 1000.0 * np.exp(-0.5 * ((time - 40e-9) / 0.6e-9) ** 2)
            file["atlas_impulse_response/pce2_spot3/tep_histogram/tep_hist"] = histogram
            file["atlas_impulse_response/pce2_spot3/tep_histogram/tep_hist_time"] = time
    return path


def write_heights(path):
    """Write two segments of 100 m; the second has no canopy, and ground in its first sub-segment alone."""
    fill = np.finfo(np.float32).max
    with h5py.File(path, "w") as file:
        group = file.create_group("gt1r/land_segments")
        group["segment_id_beg"] = np.array([700, 705])
        group["latitude"] = np.array([41.0, 41.001], np.float32)
        group["terrain/h_te_best_fit"] = np.array([2000.0, 2010.0], np.float32)
        group["canopy/h_canopy"] = np.array([8.0, fill], np.float32)
        fine = np.full((2, 5), fill, np.float32)
        fine[0], fine[1, 0] = 2000.0 + np.arange(5), 2010.0
        group["terrain/h_te_best_fit_20m"] = fine
        group["canopy/h_canopy_20m"] = np.repeat(np.float32([[8.0], [fill]]), 5, axis=1)
    return path


def test_heights_have_rows_of_100_or_of_20_m(tmp_path):
    path = write_heights(tmp_path / "atl08.h5")
    coarse, fine = (read_atl08(path, segment=length) for length in (100.0, 20.0))
    assert coarse["segment_id"].tolist() == [700, 705]
    np.testing.assert_array_equal(coarse["canopy"], [8.0, np.nan])
    assert fine["segment_id"].tolist() == list(range(700, 710))
    np.testing.assert_array_equal(fine["ground"][:6], [2000, 2001, 2002, 2003, 2004, 2010])
    assert np.all(np.isnan(fine["ground"][6:]))
    assert np.isnan(fine["canopy"]).tolist() == [False] * 5 + [True] * 5
    # What the file has for 100 m alone is repeated.
    np.testing.assert_allclose(fine["latitude"], np.repeat(coarse["latitude"], 5))


@pytest.mark.parametrize("offset", [0, 123456])
def test_photons_have_their_places_along_the_track(tmp_path, offset):
    track = read_atl03(write_photons(tmp_path / "atl03.h5", offset=offset))
    assert (track.beam, len(track), track.length) == ("gt1r", 9, 80.0)
    np.testing.assert_allclose(track.distance, [1, 2, 3, 41, 42, 63, 61, 62, 63])
    np.testing.assert_array_equal(track.segment, np.repeat(np.arange(4), COUNTS))
    np.testing.assert_array_equal(track.height, 2000.0 + np.arange(9))
    np.testing.assert_array_equal(track.pulse, np.arange(9))
    np.testing.assert_array_equal(track.confidence, np.arange(9) % 5)
    # Between the background's times it is interpolated.
    np.testing.assert_allclose(track.background_rate[[0, 4, 8]], [1e6, 1.5e6, 2e6], rtol=1e-4)
    assert track.segment_id.tolist() == [700, 701, 702, 703]
    assert track.pulse_width == pytest.approx(1.4)
    assert track.impulse is None
    assert str(track).startswith("9 photons of gt1r over 80 m")


def test_a_stretch_is_read_alone(tmp_path):
    path = write_photons(tmp_path / "atl03.h5")
    track = read_atl03(path, stretch=(40.0, 60.0))
    assert track.segment_id.tolist() == [702]
    np.testing.assert_allclose(track.distance, [1.0, 2.0])
    assert track.height.tolist() == [2003.0, 2004.0]
    by_latitude = read_atl03(path, latitude=(41.0015, 41.0025), surface="ocean")
    assert by_latitude.segment_id.tolist() == [702]
    assert by_latitude.confidence.tolist() == [-1, -1]
    with pytest.raises(ValueError, match=r"none of its 4 segments lies in stretch = \(500.0, 600.0\)"):
        read_atl03(path, stretch=(500.0, 600.0))
    with pytest.raises(ValueError, match=r"stretch = .* does not increase"):
        read_atl03(path, stretch=(60.0, 40.0))


def test_the_impulse_is_that_of_the_serving_spot(tmp_path):
    impulse = read_atl03(write_photons(tmp_path / "atl03.h5", impulse=True)).impulse
    assert impulse.power.sum() == pytest.approx(1.0)
    assert np.sum(impulse.power * impulse.time) == pytest.approx(0.0, abs=1e-9)
    assert np.sqrt(np.sum(impulse.power * impulse.time**2)) == pytest.approx(0.6, rel=0.01)


def test_other_files_and_beams_are_refused(tmp_path):
    path = write_photons(tmp_path / "atl03.h5", beams=("gt1l", "gt2r"))
    with pytest.raises(ValueError, match="beam = None; admissible is one of gt1l, gt2r"):
        read_atl03(path)
    with pytest.raises(ValueError, match="beam = 'gt1r' is none of gt1l, gt2r"):
        read_atl03(path, "gt1r")
    with pytest.raises(ValueError, match="no ICESat-2 ATL08 product"):
        read_atl08(path, "gt1l")
    with h5py.File(path, "r+") as file:
        file["gt1l/geolocation/segment_ph_cnt"][0] = 5
        file["gt2r/heights/h_ph"][4] = np.finfo(np.float32).max
    with pytest.raises(ValueError, match="neither do the indices fit the 9 photons"):
        read_atl03(path, "gt1l")
    with pytest.warns(FileWarning, match="1 of 9 photons have no height"):
        assert len(read_atl03(path, "gt2r")) == 8


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("geolocation/solar_elevation", lambda x: x[:3], r"\(3,\); .* \(4,\), as of the other"),
        ("geolocation/ph_index_beg", lambda x: x[:0], r"\(0,\); .* \(4,\), as of the other"),
        ("heights/pce_mframe_cnt", lambda x: x[:8], r"\(8,\); .* \(9,\), as of the other"),
        ("heights/lat_ph", lambda x: np.repeat(x, 2), r"\(18,\); .* \(9,\), as of the other"),
        ("heights/signal_conf_ph", lambda x: x[:, :0], r"\(9, 0\); .* \(9, 5\), as of the other"),
        ("bckgrd_atlas/bckgrd_rate", lambda x: x[:1], r"\(1,\); .* \(2,\), as of the other"),
    ],
)
def test_datasets_of_another_number_of_rows_are_refused(tmp_path, name, change, message):
    path = write_photons(tmp_path / "atl03.h5")
    with h5py.File(path, "r+") as file:
        values = file[f"gt1r/{name}"][...]
        del file[f"gt1r/{name}"]
        file[f"gt1r/{name}"] = change(values)
    with pytest.raises(ValueError, match=rf"atl03\.h5: /gt1r/{name}: shape {message}"):
        read_atl03(path)


def test_numbers_that_overflow_are_missing(tmp_path):
    path = write_photons(tmp_path / "atl03.h5", impulse=True)
    with h5py.File(path, "r+") as file:
        for name in (
            "gt1r/heights/pce_mframe_cnt",
            "atlas_impulse_response/pce2_spot3/tep_histogram/tep_hist",
        ):
            values = file[name][...].astype(float)
            del file[name]
            file[name] = np.full_like(values, 1e308)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        track = read_atl03(path)
    assert track.impulse is None
    assert track.pulse.tolist() == list(range(9))


def test_pulses_without_a_number_are_numbered_by_time(tmp_path):
    """A number for what is missing would lie far from the others, and pulses are counted between them."""
    path = write_photons(tmp_path / "atl03.h5")
    with h5py.File(path, "r+") as file:
        del file["gt1r/heights/ph_id_pulse"]
        file["gt1r/heights/ph_id_pulse"] = np.where(np.arange(9) == 4, np.nan, 1.0 + np.arange(9))
        file["gt1r/heights/delta_time"][6:] += 0.02
    assert read_atl03(path).pulse.tolist() == [0, 1, 2, 3, 4, 5, 206, 207, 208]


@pytest.mark.parametrize("missing", [np.nan, 1e300])
def test_photons_without_a_time_are_left_out(tmp_path, missing):
    path = write_photons(tmp_path / "atl03.h5")
    with h5py.File(path, "r+") as file:
        file["gt1r/heights/delta_time"][0] = missing
    with pytest.warns(FileWarning, match="1 of 9 photons have no height, no distance or no time"):
        track = read_atl03(path)
    assert track.pulse.tolist() == list(range(8))


def test_a_signalling_nan_of_the_impulse_is_missing(tmp_path):
    path = write_photons(tmp_path / "atl03.h5", impulse=True)
    with h5py.File(path, "r+") as file:
        time = file["atlas_impulse_response/pce2_spot3/tep_histogram/tep_hist_time"]
        values = time[...]
        values.view(np.uint64)[7] = 0x7FF0000000000001
        time[...] = values
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_atl03(path).impulse is None


def test_photons_before_those_of_an_empty_first_segment_are_left_out(tmp_path):
    path = write_photons(tmp_path / "atl03.h5")
    with h5py.File(path, "r+") as file:
        # The three photons of the first segment belong to none.
        file["gt1r/geolocation/segment_ph_cnt"][0] = 0
    assert read_atl03(path).height.tolist() == list(range(2003, 2009))


def test_a_recorded_track_has_the_segments_of_its_ground(shared):
    folder = shared / "icesat2"
    if not folder.is_dir():
        pytest.skip("the recorded track is not beside this checkout")
    track = read_atl03(folder / "atl03_half.h5")
    assert (len(track), len(track.segment_id)) == (3758, 20)
    assert track.length == pytest.approx(401, abs=1)
    assert np.all(np.isfinite(track.background_rate))
    fine, coarse = (read_atl08(folder / "atl08_half.h5", segment=length) for length in (20.0, 100.0))
    assert fine["segment_id"].tolist() == track.segment_id.tolist()
    np.testing.assert_allclose(fine["latitude"], track.segment_latitude, atol=2e-4)
    assert len(coarse) == 4
    assert np.isfinite(coarse["ground"]).all()
    assert np.isfinite(fine["ground"]).sum() == 8
    with pytest.raises(ValueError, match=r"segment = 50.0; admissible is 20 or 100 m"):
        read_atl08(folder / "atl08_half.h5", segment=50.0)
