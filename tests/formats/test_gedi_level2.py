"""Readers of GEDI level 2A and 2B: small files that are written here, rows by shot number, damaged files."""

import tracemalloc

import numpy as np
import pytest

from jaxlidar.io import FileWarning, read_gedi_l2a, read_gedi_l2b

h5py = pytest.importorskip("h5py")


def write_level_2(path, kind):
    """Write two beams of 3 and 2 shots; the ground of shot n lies at n m."""
    with h5py.File(path, "w") as file:
        for beam, numbers in (("BEAM0000", [1, 2, 3]), ("BEAM0101", [11, 12])):
            group, n = file.create_group(beam), len(numbers)
            group["shot_number"] = np.array(numbers, np.uint64)
            group["sensitivity"] = np.full(n, 0.95, np.float32)
            place = group if kind == "2A" else group.create_group("geolocation")
            place["elev_lowestmode"] = np.array(numbers, np.float32)
            place["lat_lowestmode"] = np.full(n, -13.5)
            place["lon_lowestmode"] = np.array([-9999.0, *[-44.0] * (n - 1)])
            if kind == "2A":
                group["quality_flag"] = np.ones(n, np.uint8)
                group["rh"] = (np.arange(101.0) + np.array(numbers)[:, None]).astype(np.float32)
                geolocation = group.create_group("geolocation")
                geolocation["rh_a2"] = np.full((n, 101), 250, np.int16)
                geolocation["rh_a2"].attrs["units"] = "cm"
            else:
                group["pai"] = np.array(numbers, np.float32) / 10
                group["pai"].attrs["_FillValue"] = np.float32(0.3)
                group["pavd_z"] = np.full((n, 30), 0.1, np.float32)
                group["ancillary/dz"] = np.array([5.0])
    return path


def test_level_2a_has_ground_and_relative_heights(tmp_path):
    table = read_gedi_l2a(write_level_2(tmp_path / "a.h5", "2A"))
    assert table["shot_number"].tolist() == [1, 2, 3, 11, 12]
    assert table["beam"].tolist() == ["BEAM0000"] * 3 + ["BEAM0101"] * 2
    np.testing.assert_array_equal(table["elev_lowestmode"], [1, 2, 3, 11, 12])
    np.testing.assert_array_equal(table["rh"][:, 98], 98.0 + table["elev_lowestmode"])
    # Centimetres are metres, and -9999 is a missing number.
    assert np.all(table["rh_a2"] == 2.5)
    assert np.isnan(table["longitude"]).tolist() == [True, False, False, True, False]
    assert table.columns["rh"].axis.values[[0, 100]].tolist() == [0.0, 100.0]


def test_rows_come_in_the_order_of_the_requested_shots(tmp_path):
    heights = read_gedi_l2a(write_level_2(tmp_path / "a.h5", "2A"), [12, 5, 2])
    plants = read_gedi_l2b(write_level_2(tmp_path / "b.h5", "2B"), heights["shot_number"])
    table = heights.join(plants)
    assert table["shot_number"].tolist() == [12, 5, 2]
    np.testing.assert_array_equal(table["elev_lowestmode"], [12.0, np.nan, 2.0])
    np.testing.assert_allclose(table["pai"], [1.2, np.nan, 0.2], rtol=1e-6)
    assert table.columns["pavd_z"].axis.values[:3].tolist() == [0.0, 5.0, 10.0]
    assert np.isnan(read_gedi_l2b(tmp_path / "b.h5", [3])["pai"][0])
    with pytest.raises(TypeError, match="shot_number has the type float64"):
        read_gedi_l2a(tmp_path / "a.h5", np.array([12.0]))


def test_beams_that_cannot_be_read_are_skipped_and_other_files_refused(tmp_path):
    path = write_level_2(tmp_path / "a.h5", "2A")
    with pytest.raises(ValueError, match="/BEAM0000/pai: no such dataset; it is part of a GEDI L2B product"):
        read_gedi_l2b(path)
    with h5py.File(path, "r+") as file:
        del file["BEAM0000/elev_lowestmode"]
    with pytest.warns(FileWarning, match="BEAM0000/elev_lowestmode: no such dataset.*the beam is skipped"):
        assert read_gedi_l2a(path)["shot_number"].tolist() == [11, 12]
    (tmp_path / "text.h5").write_text("text")
    with pytest.raises(ValueError, match="not a readable HDF5 file"):
        read_gedi_l2a(tmp_path / "text.h5")


@pytest.mark.parametrize("thickness", [[], [np.inf], [1e308], [np.nan], [0.0], [-9999.0]])
def test_a_beam_whose_layers_have_no_thickness_is_skipped(tmp_path, thickness):
    path = write_level_2(tmp_path / "b.h5", "2B")
    with h5py.File(path, "r+") as file:
        del file["BEAM0101/ancillary/dz"]
        file["BEAM0101/ancillary/dz"] = np.array(thickness, float)
    with pytest.warns(FileWarning, match=r"b\.h5: /BEAM0101/ancillary/dz: .* is no thickness of layers"):
        assert read_gedi_l2b(path)["shot_number"].tolist() == [1, 2, 3]


def test_of_many_thicknesses_of_layers_one_is_read(tmp_path):
    path = write_level_2(tmp_path / "b.h5", "2B")
    with h5py.File(path, "r+") as file:
        for beam in ("BEAM0000", "BEAM0101"):
            del file[f"{beam}/ancillary/dz"]
            # As many as are plausible in a file, which in double precision are 8 times as many bytes.
            file.create_dataset(f"{beam}/ancillary/dz", data=np.full(2**24, 5, np.int8), compression=1)
    tracemalloc.start()
    table = read_gedi_l2b(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert table.columns["pavd_z"].axis.values[:3].tolist() == [0.0, 5.0, 10.0]
    assert peak < 2**24


@pytest.mark.parametrize("at", [0, 24])
def test_texts_in_a_damaged_heap_are_refused(tmp_path, at):
    path = write_level_2(tmp_path / "a.h5", "2A")
    content = bytearray(path.read_bytes())
    # Of the first text, or of what is free behind two: HDF5 stays at an object of number 0 and size 0.
    heap = content.index(b"GCOL") + 16 + at
    content[heap : heap + 48] = bytes(48)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.h5: /BEAM0000/geolocation/rh_a2: damaged \(the heap at byte"):
        read_gedi_l2a(path)


def test_texts_are_read_through_links_to_other_files(tmp_path):
    write_level_2(tmp_path / "a.h5", "2A")
    with h5py.File(tmp_path / "links.h5", "w") as file:
        file["BEAM0000"] = h5py.ExternalLink("a.h5", "/BEAM0000")
    assert np.all(read_gedi_l2a(tmp_path / "links.h5")["rh_a2"] == 2.5)
