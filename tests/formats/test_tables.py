"""Tables of shots: columns, joins by number, and files that other packages read."""

import csv

import numpy as np
import pytest

from jaxlidar.formats.tables import ColumnAxis
from jaxlidar.io import Column, ShotTable

LEVELS = ColumnAxis("percentile", np.array([50.0, 98.0]), "percent")


def small_table(**columns):
    return ShotTable(
        {
            "shot_number": Column(np.array([3, 1, 2], np.uint64)),
            "latitude": Column(np.array([50.0, 51.0, np.nan]), "degrees", "of the ground"),
            "longitude": Column(np.array([14.0, 15.0, 16.0]), "degrees", "of the ground"),
            "rh": Column(np.array([[1.0, 9.0], [2.0, np.nan], [3.0, 30.0]]), "m", "relative height", LEVELS),
            "quality": Column(np.array(["good", "bad", "good"])),
            **columns,
        },
        {"title": "three shots"},
    )


def test_tables_are_joined_by_shot_number():
    product = ShotTable(
        {
            "shot_number": Column(np.array([1, 9, 3], np.uint64)),
            "latitude": Column(np.array([1.0, 2.0, 3.0])),
            "modes": Column(np.array([4, 5, 6])),
            "beam": Column(np.array(["a", "b", "c"])),
            "pavd": Column(np.array([[0.1], [0.2], [0.3]]), "", "", ColumnAxis("layer", np.array([2.5]))),
        }
    )
    table = small_table().join(product)
    assert table["shot_number"].tolist() == [3, 1, 2]
    np.testing.assert_array_equal(table["modes"], [6.0, 4.0, np.nan])
    np.testing.assert_array_equal(table["latitude_joined"], [3.0, 1.0, np.nan])
    np.testing.assert_array_equal(table["pavd"][:, 0], [0.3, 0.1, np.nan])
    assert table["beam"].tolist() == ["c", "a", ""]
    with pytest.raises(ValueError, match="shot_number = 3 is that of 2 rows"):
        table.join(product.select([2, 2]))


def test_columns_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="extra has 2 rows; admissible is 3"):
        small_table(extra=Column(np.zeros(2)))
    with pytest.raises(ValueError, match=r"extra has the shape \(3, 2\); admissible is \(3,\)"):
        small_table(extra=Column(np.zeros((3, 2))))
    with pytest.raises(TypeError, match="extra is an array"):
        small_table(extra=np.zeros(3))
    with pytest.raises(ValueError, match=r"ends in none of \.csv, \.nc"):
        small_table().save("table.txt")


def test_printed_tables_fit_on_a_screen():
    many = {f"column_{i}": Column(np.arange(3.0)) for i in range(40)}
    lines = str(small_table(**many)).splitlines()
    assert len(lines) <= 14
    assert max(map(len, lines)) <= 120
    assert lines[0] == "3 rows, 45 columns"


def test_csv_has_one_column_for_each_level(tmp_path):
    small_table().save(tmp_path / "shots.csv")
    with (tmp_path / "shots.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["shot_number", "latitude", "longitude", "rh_50", "rh_98", "quality"]
    assert [row["rh_98"] for row in rows] == ["9.0", "", "30.0"]
    assert [row["quality"] for row in rows] == ["good", "bad", "good"]


def test_netcdf_has_dimensions_coordinates_and_units(tmp_path):
    xarray = pytest.importorskip("xarray")
    small_table().save(tmp_path / "shots.nc")
    with xarray.open_dataset(tmp_path / "shots.nc", engine="h5netcdf") as dataset:
        assert dataset.rh.dims == ("shot", "percentile")
        assert dataset.rh.attrs == {"units": "m", "long_name": "relative height"}
        np.testing.assert_array_equal(dataset.percentile, [50.0, 98.0])
        assert dataset.latitude.attrs["standard_name"] == "latitude"
        assert dataset.latitude.attrs["units"] == "degrees_north"
        assert {"latitude", "longitude", "percentile"} <= set(dataset.coords)
        assert dataset.attrs["title"] == "three shots"
        assert dataset.quality.values.tolist() == ["good", "bad", "good"]
        assert dataset.shot_number.values.tolist() == [3, 1, 2]


def test_parquet_keeps_types_and_units(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    small_table().save(tmp_path / "shots.parquet")
    table = parquet.read_table(tmp_path / "shots.parquet")
    assert table["shot_number"].to_pylist() == [3, 1, 2]
    assert table.schema.field("rh_98").metadata[b"unit"] == b"m"


def test_geopackage_has_points(tmp_path):
    pyogrio = pytest.importorskip("pyogrio")
    small_table().save(tmp_path / "shots.gpkg")
    meta, _, geometry, columns = pyogrio.raw.read(tmp_path / "shots.gpkg")
    # The shot without a latitude has no point.
    assert meta["crs"] == "EPSG:4326"
    assert meta["geometry_type"] == "Point"
    assert len(geometry) == 2
    by_name = dict(zip(meta["fields"], columns, strict=True))
    assert by_name["shot_number"].tolist() == [3, 1]
    np.testing.assert_allclose(np.frombuffer(geometry[0][-16:]), [14.0, 50.0])
    with pytest.raises(ValueError, match="the table has no latitude"):
        ShotTable({"shot_number": Column(np.array([1]))}).save(tmp_path / "bare.gpkg")
