"""Readers of LVIS: small files of both versions that are written here, and text of level 2."""

import numpy as np
import pytest

from jaxlidar.io import FileWarning, read_lvis_l1b, read_lvis_l2, stack_shots

h5py = pytest.importorskip("h5py")
# Length of a degree of latitude in m at 45 degrees, by the meridian's radius of curvature of WGS-84.
DEGREE = 111_131.8


def write_level_1(path, version, shots=3, **changes):
    """Write shots whose echo of a Gaussian pulse has its peak in sample 200 + i.

    Beams lean northward by 2 degrees. Version 1 has samples of 2 ns, version 2 of 1 ns.
    """
    samples, step, pulse_samples = (528, 2.0, 120) if version == 1 else (1024, 1.0, 128)
    length = 0.149896229 * step * (samples - 1)
    zenith = np.deg2rad(2.0)
    t, i, lag = np.arange(samples), np.arange(shots), np.arange(pulse_samples)
    datasets = {
        "LFID": np.full(shots, 57, np.uint32),
        "SHOTNUMBER": (7000 + i).astype(np.uint32),
        "TIME": 60000.0 + i,
        "LON0": np.full(shots, 285.0),
        "LAT0": np.full(shots, 45.0),
        "Z0": np.full(shots, 500.0, np.float32),
        f"LON{samples - 1}": np.full(shots, 285.0),
        f"LAT{samples - 1}": np.full(shots, 45.0 + length * np.sin(zenith) / DEGREE),
        f"Z{samples - 1}": np.full(shots, 500.0 - length * np.cos(zenith)),
        "INCIDENTANGLE": np.full(shots, 2.0, np.float32),
        "SIGMEAN": np.full(shots, 14.2, np.float32),
        "RXWAVE": np.rint(14 + 90 * np.exp(-0.5 * ((t - 200 - i[:, None]) / 4) ** 2)).astype(np.uint16),
        "TXWAVE": np.tile(np.rint(10 + 80 * np.exp(-0.5 * ((lag - 40) / 4) ** 2)), (shots, 1)),
        **changes,
    }
    with h5py.File(path, "w") as file:
        for name, values in datasets.items():
            if values is not None:
                file[name] = values
    return path


@pytest.mark.parametrize("version", [1, 2])
def test_shots_are_common_airborne_records(tmp_path, version):
    shots = read_lvis_l1b(write_level_1(tmp_path / "lvis.h5", version))
    step = 2.0 if version == 1 else 1.0
    assert len(shots) == 3
    shot = shots[1]
    assert (shot.index, shot.gps_time, shot.sampling_interval) == (7001, 60001.0, step)
    assert shot.zenith == pytest.approx(2.0, abs=1e-3)
    assert shot.azimuth == pytest.approx(0.0, abs=1e-3)
    assert shot.is_geographic
    assert shot.anchor[0] == pytest.approx(-75.0)
    # The stated noise is within a count of the quiet samples, and is used.
    assert shot.noise_mean == pytest.approx(14.2, abs=1e-5)
    drop = 201 * step * 0.149896229 * np.cos(np.deg2rad(2.0))
    assert shot.elevation[np.argmax(shot.signal)] == pytest.approx(500.0 - drop, abs=1e-3)
    assert shot.pulse_time[np.argmax(shot.pulse_power)] == 0.0
    assert stack_shots(shots).signal.shape == (3, 528 if version == 1 else 1024)
    np.testing.assert_array_equal(shots.gps_time, [60000.0, 60001.0, 60002.0])


def test_what_a_file_states_is_compared_with_its_samples(tmp_path):
    path = write_level_1(tmp_path / "noise.h5", 2, SIGMEAN=np.full(3, 30.0))
    with pytest.warns(FileWarning, match=r"SIGMEAN: 16 counts from the first samples"):
        shots = read_lvis_l1b(path)
    assert shots[0].noise_mean == 14.0
    path = write_level_1(tmp_path / "angle.h5", 2, INCIDENTANGLE=np.full(3, 5.0))
    with pytest.warns(FileWarning, match=r"INCIDENTANGLE: 3 degrees from the lines"):
        read_lvis_l1b(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"RXWAVE": None}, "no LVIS L1B product"),
        ({"TXWAVE": None}, "/TXWAVE: no such dataset"),
        ({"Z1023": np.full(3, 499.0)}, "samples .* ns apart, .* admissible are 1 and 2 ns"),
        ({"SIGMEAN": np.zeros(2)}, r"/SIGMEAN: shape \(2,\); admissible is \(3,\), as of the other"),
        ({"RXWAVE": np.zeros((3, 1000))}, r"/LON1023: .* /RXWAVE has 1000 samples"),
    ],
)
def test_files_that_are_not_of_the_product_are_refused(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        read_lvis_l1b(write_level_1(tmp_path / "lvis.h5", 2, **changes))


def test_a_damaged_shot_is_refused_when_it_is_read(tmp_path):
    path = write_level_1(tmp_path / "lvis.h5", 2, Z0=np.array([500.0, np.nan, 500.0]))
    shots = read_lvis_l1b(path)
    assert shots[0].anchor[2] == 500.0
    with pytest.raises(ValueError, match="shot 1: its position is"):
        shots[1]


def test_level_2_text_is_a_table(tmp_path):
    path = tmp_path / "LVISF2.TXT"
    names = (
        "# LFID SHOTNUMBER TIME GLON GLAT ZG HLON HLAT ZH TLON TLAT ZT RH50 RH98 RH100 AZIMUTH INCIDENTANGLE"
    )
    row = "57 {} 60000.5 285.5 45.0 300.25 285.5 45.0 312.0 285.5 45.0 320.0 4.5 18.5 19.75 10.0 2.0"
    path.write_text("\n".join(["# LVIS Facility", names, row.format(7), row.format(8), ""]))
    table = read_lvis_l2(path)
    assert table["shot_number"].tolist() == [7, 8]
    assert table["shot_number"].dtype.kind == "i"
    assert table["longitude"][0] == -74.5
    assert (table["ground"][1], table["canopy_top"][1], table["zenith"][1]) == (300.25, 320.0, 2.0)
    np.testing.assert_array_equal(table["rh"][0], [4.5, 18.5, 19.75])
    assert table.columns["rh"].axis.values.tolist() == [50.0, 98.0, 100.0]
    # More digits than a whole number has in double precision are no number of a shot.
    path.write_text("\n".join([names, row.format("1e39")]))
    assert read_lvis_l2(path)["shot_number"].tolist() == [1e39]
    path.write_text("\n".join([names, row.format("nan").replace("285.5", "-inf")]))
    with pytest.raises(ValueError, match=r"LVISF2\.TXT: line 2: GLON is not finite"):
        read_lvis_l2(path)
    path.write_text("\n".join([names, "57 7 60000.5"]))
    with pytest.raises(ValueError, match="line 2: 3 values; the header names 17"):
        read_lvis_l2(path)
    path.write_text("1 2 3\n")
    with pytest.raises(ValueError, match="no line begins with # and names the columns GLON, GLAT, ZG"):
        read_lvis_l2(path)
