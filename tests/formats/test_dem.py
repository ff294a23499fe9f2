"""Reader of digital elevation models: positions of the heights, missing data, bounds, and damaged files."""

import numpy as np
import pytest

from jaxlidar.io import FileWarning, read_dem

# Rows of a file run from north to south.
ROWS = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.5]])
HEAD = {"ncols": 3, "nrows": 2, "xllcorner": 600_000, "yllcorner": 5_200_000, "cellsize": 10}


def write_ascii_grid(folder, rows=ROWS, **changes):
    head = {**HEAD, **changes}
    lines = [f"{key} {value}" for key, value in head.items() if value is not None]
    path = folder / "dem.asc"
    path.write_text("\n".join([*lines, *(" ".join(map(str, row)) for row in rows)]) + "\n")
    return path


def write_tiff(folder, rows=ROWS, crs="EPSG:32632", **changes):
    rasterio = pytest.importorskip("rasterio")
    transform = rasterio.Affine(10.0, 0.0, 600_000.0, 0.0, -10.0, 5_200_020.0)
    path = folder / "dem.tif"
    profile = {"driver": "GTiff", "width": rows.shape[1], "height": rows.shape[0], "count": 1}
    profile |= {"dtype": "float32", "crs": crs, "transform": transform, "nodata": -9999.0} | changes
    with rasterio.open(path, "w", **profile) as file:
        file.write(rows.astype("float32"), 1)
    return path


@pytest.mark.parametrize("write", [write_ascii_grid, write_tiff])
def test_heights_lie_at_the_centres_of_cells(tmp_path, write):
    terrain, crs, filled = read_dem(write(tmp_path), reflectance=0.2)
    np.testing.assert_array_equal(terrain.origin, [600_005.0, 5_200_005.0])
    np.testing.assert_array_equal(terrain.spacing, [10.0, 10.0])
    # Of the north-eastern cell and the one south of it.
    assert float(terrain.height_at(600_025.0, 5_200_015.0)) == 3.0
    assert float(terrain.height_at(600_025.0, 5_200_005.0)) == 6.5
    assert (crs, filled) == (None if write is write_ascii_grid else "EPSG:32632", 0)
    assert float(terrain.reflectance) == pytest.approx(0.2)


@pytest.mark.parametrize("write", [write_ascii_grid, write_tiff])
def test_nodes_without_data_are_refused_or_filled(tmp_path, write):
    rows = np.where(ROWS == 2.0, -9999.0, ROWS)
    with pytest.raises(ValueError, match=r"1 of 6 nodes have no data, the first at x = 600015, y = 5200015"):
        read_dem(write(tmp_path, rows))
    terrain, _, filled = read_dem(write(tmp_path, rows), fill=7.0)
    assert float(terrain.heights[1, 1]) == 7.0
    assert filled == 1


@pytest.mark.parametrize("write", [write_ascii_grid, write_tiff])
def test_only_nodes_within_the_bounds_are_read(tmp_path, write):
    terrain, _, _ = read_dem(write(tmp_path), bounds=(600_010, 5_200_000, 600_030, 5_200_020))
    np.testing.assert_array_equal(terrain.heights, [[5.0, 2.0], [6.5, 3.0]])
    np.testing.assert_array_equal(terrain.origin, [600_015.0, 5_200_005.0])
    with pytest.raises(ValueError, match="0 nodes lie between 1 and 2 m along x"):
        read_dem(write(tmp_path), bounds=(1, 1, 2, 2))


def test_bounds_beyond_the_cells_of_the_file_are_warned_of(tmp_path):
    path, infinite = write_ascii_grid(tmp_path), float("inf")
    terrain, _, _ = read_dem(path)
    low, high = terrain.origin - 5.0, np.asarray(terrain.end) + 5.0
    # The edges of the outermost cells are those of the file.
    for bounds in ((*low, *high), (*low, infinite, infinite)):
        np.testing.assert_array_equal(read_dem(path, bounds=bounds).terrain.heights, terrain.heights)
    with pytest.warns(FileWarning, match=r"bounds = .* reach beyond the file, from \(600000, 5200000\) to "):
        read_dem(path, bounds=(*low, high[0], high[1] + 1.0))


def test_a_header_may_name_the_centre_of_the_first_cell(tmp_path):
    path = write_ascii_grid(tmp_path, xllcorner=None, yllcorner=None, xllcenter=3, yllcenter=4)
    np.testing.assert_array_equal(read_dem(path).terrain.origin, [3.0, 4.0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ncols": None}, "line 5: the header has no ncols"),
        ({"ncols": 2.5}, "line 1: ncols = '2.5' is no whole number"),
        ({"ncols": 1}, "line 1: ncols = 1; at least 2"),
        ({"ncols": 4}, "2 of 8 heights are missing"),
        ({"nrows": 2, "ncols": 2}, "line 7: more than 2 x 2 heights"),
        ({"ncols": 10**6, "nrows": 10**6}, "bytes are declared"),
        ({"cellsize": -1}, "line 5: cellsize = -1"),
        ({"xllcorner": "nan"}, "line 3: xllcorner = nan lies beyond"),
        ({"rows": [["a", "b"]]}, "line 6: height = 'a' is no number"),
        ({"rows": np.full((2, 3), 1e9)}, "a height of 1e[+]09 m"),
    ],
)
def test_damaged_grids_are_refused(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        read_dem(write_ascii_grid(tmp_path, **changes))


@pytest.mark.parametrize(
    ("changes", "heights"),
    [
        ({"rows": [[1, 2, 3], [4, "a", 6]]}, [[1, 2, 3], [4, 0, 6]]),
        ({"rows": [[1, 2, 3], [4, 5, 6, 7]]}, [[1, 2, 3], [4, 5, 6]]),
        ({"xllcorner": None}, ROWS.tolist()),
    ],
)
def test_gdal_reads_damaged_grids(tmp_path, changes, heights):
    """Why ASCII grids have a parser here, which refuses them."""
    rasterio = pytest.importorskip("rasterio")
    path = write_ascii_grid(tmp_path, **changes)
    with rasterio.open(path) as file:
        assert file.read(1).tolist() == heights
    with pytest.raises(ValueError, match=r"dem\.asc: line \d"):
        read_dem(path)


def test_geographic_and_truncated_tiffs_are_refused(tmp_path):
    with pytest.raises(ValueError, match="coordinates in degrees"):
        read_dem(write_tiff(tmp_path, crs="EPSG:4326"))
    path = write_tiff(tmp_path)
    for size in (10, 200):
        path.write_bytes(path.read_bytes()[:size])
        with pytest.raises(ValueError, match=r"dem\.tif: "):
            read_dem(path)
    with pytest.raises(FileNotFoundError):
        read_dem(tmp_path / "none.tif")


def test_bad_arguments_are_refused(tmp_path):
    with pytest.raises(ValueError, match="west, south, east, north"):
        read_dem(write_ascii_grid(tmp_path), bounds=(2, 0, 1, 1))
    with pytest.raises(ValueError, match="fill = nan"):
        read_dem(write_ascii_grid(tmp_path), fill=np.nan)
