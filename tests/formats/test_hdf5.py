"""What HDF5 products declare of their numbers, by the attributes of the CF conventions: used, or refused."""

import subprocess
import sys

import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.formats.hdf5 import open_hdf5
from tests.formats.test_icesat2 import write_heights, write_photons
from tests.formats.test_lvis import write_level_1

h5py = pytest.importorskip("h5py")

FOOT = 0.3048
# The last number is missing by the attributes.
SINGLE = np.array([1.0, 2.0, -9999.9], np.float32)
DOUBLE = SINGLE.astype(float)
WHOLE = np.array([1, 2, 9], np.int16)


@pytest.mark.parametrize(
    ("values", "attributes"),
    [
        (SINGLE, {"_FillValue": np.float32(-9999.9)}),
        (SINGLE, {"_FillValue": -9999.9}),
        (SINGLE, {"_FillValue": b"-9999.9"}),
        (np.r_[1.0, 2.0, -9999.9], {"_FillValue": np.float32(-9999.9)}),
        (SINGLE, {"_FillValue": -1.0, "missing_value": [7.0, -9999.9]}),
        (SINGLE, {"missing_value": "-9999.9"}),
        (WHOLE, {"_FillValue": 9.0}),
        (WHOLE, {"missing_value": b"9"}),
        (DOUBLE, {"valid_min": 0}),
        (SINGLE, {"valid_min": "1.0"}),
        (WHOLE, {"valid_max": 2.0}),
        (WHOLE, {"valid_range": [1, 2]}),
        (WHOLE, {"valid_range": "1, 2"}),
        (WHOLE, {"flag_values": np.array([1, 2], np.int8)}),
        (WHOLE, {"flag_values": "1 2"}),
    ],
)
def test_numbers_that_attributes_declare_missing_are_nan(tmp_path, values, attributes):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x"] = values
        file["x"].attrs.update(attributes)
    with open_hdf5(tmp_path / "a.h5", "test") as file:
        np.testing.assert_array_equal(file.numbers("x"), [1.0, 2.0, np.nan])


@pytest.mark.parametrize(
    "attributes",
    [
        {"_FillValue": 255},
        {"valid_min": 1, "valid_max": np.float64(9)},
        {"valid_max": "N/A"},
        {"_FillValue": ""},
        {"flag_values": np.array([1, 8]), "flag_masks": np.array([3, 8])},
    ],
)
def test_numbers_that_are_declared_valid_stay(tmp_path, attributes):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x"] = WHOLE
        file["x"].attrs.update(attributes)
    with open_hdf5(tmp_path / "a.h5", "test") as file:
        np.testing.assert_array_equal(file.numbers("x"), WHOLE)


def test_a_limit_of_another_precision_includes_its_own_value(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x"] = np.array([0.1, 0.7], np.float32)
        file["x"].attrs.update({"valid_min": 0.1, "valid_max": 0.7})
    with open_hdf5(tmp_path / "a.h5", "test") as file:
        assert np.isfinite(file.numbers("x")).all()


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"valid_range": [1, 2, 3]}, "/x: valid_range = .* two numbers"),
        ({"_FillValue": "9 or 10"}, "/x: _FillValue = '9 or 10'; admissible are numbers"),
    ],
)
def test_attributes_that_are_no_numbers_are_refused(tmp_path, attributes, message):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x"] = WHOLE
        file["x"].attrs.update(attributes)
    with open_hdf5(tmp_path / "a.h5", "test") as file, pytest.raises(ValueError, match=message):
        file.numbers("x")


@pytest.mark.parametrize(
    ("declared", "unit", "expected"),
    [
        ("feet", "m", 10 * FOOT),
        (b"kilometers", "m", 10_000.0),
        ("meters", "m", 10.0),
        ("radian", "degrees", 10 * 180 / np.pi),
        ("degrees_north", "rad", 10 * np.pi / 180),
        ("ms", "s", 0.01),
        ("seconds since 2018-01-01", "s since 2018-01-01", 10.0),
        ("days since 2018-01-03T00:00:00Z", "s since 2018-01-01", 12 * 86400.0),
        ("seconds since 2017-12-31 23:59:00 UTC", "s since 2018-01-01", -50.0),
        ("seconds of the day", "s", 10.0),
        ("counts", "", 10.0),
    ],
)
def test_units_are_converted(tmp_path, declared, unit, expected):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x"] = [10.0]
        file["x"].attrs["units"] = declared
    with open_hdf5(tmp_path / "a.h5", "test") as file:
        np.testing.assert_allclose(file.numbers("x", unit), expected, rtol=1e-12)


@pytest.mark.parametrize("declared", ["fortnights", "seconds since launch"])
def test_times_of_other_units_and_epochs_are_refused(tmp_path, declared):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x"] = [10.0]
        file["x"].attrs["units"] = declared
    with open_hdf5(tmp_path / "a.h5", "test") as file, pytest.raises(ValueError, match=r"/x: "):
        file.numbers("x", "s since 2018-01-01")


def rescale(path, units):
    """Divide datasets by the size of a unit and declare it; of times, give another epoch too."""
    with h5py.File(path, "r+") as file:
        for name, (unit, size, offset) in units.items():
            values = file[name][:].astype(float)
            del file[name]
            file[name] = (values - offset) / size
            file[name].attrs["units"] = unit


def test_photons_of_other_units_are_those_of_the_product(tmp_path):
    track = jl.io.read_atl03(write_photons(tmp_path / "usual.h5"))
    path = write_photons(tmp_path / "other.h5")
    rescale(
        path,
        {
            "gt1r/heights/h_ph": ("feet", FOOT, 0.0),
            "gt1r/heights/dist_ph_along": ("cm", 0.01, 0.0),
            "gt1r/heights/lat_ph": ("radians", 180 / np.pi, 0.0),
            "gt1r/heights/delta_time": ("seconds since 2018-01-02", 1.0, 86400.0),
            "gt1r/bckgrd_atlas/delta_time": ("ms", 1e-3, 0.0),
            "gt1r/geolocation/segment_dist_x": ("km", 1000.0, 0.0),
            "gt1r/geolocation/segment_length": ("km", 1000.0, 0.0),
            "gt1r/geolocation/reference_photon_lat": ("radians", 180 / np.pi, 0.0),
            "gt1r/geolocation/solar_elevation": ("radians", 180 / np.pi, 0.0),
            "gt1r/geolocation/tx_pulse_width_lower": ("ns", 1e-9, 0.0),
        },
    )
    other = jl.io.read_atl03(path)
    for name, values in vars(track).items():
        if isinstance(values, np.ndarray | float):
            np.testing.assert_allclose(getattr(other, name), values, rtol=1e-6, atol=1e-6, err_msg=name)


def test_ground_that_an_attribute_of_another_type_declares_missing_is_nan(tmp_path):
    path = write_heights(tmp_path / "a.h5")
    with h5py.File(path, "r+") as file:
        ground = file["gt1r/land_segments/terrain/h_te_best_fit"]
        ground[1] = -9999.9
        ground.attrs["_FillValue"] = -9999.9
        ground.attrs["units"] = "meters"
        canopy = file["gt1r/land_segments/canopy/h_canopy"]
        canopy[0] = 8.0 / FOOT
        canopy.attrs["units"] = "feet"
    table = jl.io.read_atl08(path)
    np.testing.assert_array_equal(table["ground"], [2000.0, np.nan])
    np.testing.assert_allclose(table["canopy"], [8.0, np.nan], rtol=1e-6)


def test_positions_of_lvis_in_other_units_are_those_of_the_product(tmp_path):
    usual = jl.io.read_lvis_l1b(write_level_1(tmp_path / "usual.h5", 2))
    path = write_level_1(tmp_path / "other.h5", 2)
    radians = ("radians", 180 / np.pi, 0.0)
    rescale(path, dict.fromkeys(("LON0", "LAT0", "LON1023", "LAT1023", "INCIDENTANGLE"), radians))
    rescale(path, dict.fromkeys(("Z0", "Z1023"), ("feet", FOOT, 0.0)))
    other = jl.io.read_lvis_l1b(path)
    for name in ("anchor", "direction"):
        np.testing.assert_allclose(getattr(other[0], name), getattr(usual[0], name), rtol=1e-6, atol=1e-12)


def test_a_file_that_another_process_writes_is_in_use(tmp_path):
    write_photons(tmp_path / "a.h5")
    code = "import h5py, sys; f = h5py.File(sys.argv[1], 'a'); print(flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", code, str(tmp_path / "a.h5")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        with pytest.raises(ValueError, match=r"a\.h5: it is in use: another process"):
            jl.io.read_atl03(tmp_path / "a.h5")
        process.stdin.close()
    assert jl.io.read_atl03(tmp_path / "a.h5").height.size == 9


def test_a_filter_that_is_missing_is_named(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        # A registered number of a filter that HDF5 does not bring along.
        x = file.create_dataset("x", (10,), "f8", chunks=(10,), compression=32004, allow_unknown_filter=True)
        x.id.write_direct_chunk((0,), bytes(20))
    with (
        open_hdf5(tmp_path / "a.h5", "test") as file,
        pytest.raises(ValueError, match=r"/x: it is compressed by a filter .* pip install hdf5plugin"),
    ):
        file.numbers("x")
