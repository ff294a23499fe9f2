"""Maps of surveys as GeoTIFF: exact values at the positions of the shots, and refusal of bad arguments."""

import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.io import read_dem, write_raster

rasterio = pytest.importorskip("rasterio")

SURVEY = jl.Survey.grid(jl.Lidar(), low=(600_000.0, 5_200_000.0), high=(600_020.0, 5_200_010.0), spacing=5.0)
COUNT = len(SURVEY)


def maps(seed=0):
    """Return two quantities of every shot."""
    random = np.random.default_rng(seed)
    return {"RH98": random.uniform(5, 30, COUNT), "ground": random.normal(size=COUNT)}


def test_every_shot_is_the_centre_of_a_cell(tmp_path):
    values = maps()
    write_raster(tmp_path / "a.tif", values, SURVEY.position, crs="EPSG:32632")
    with rasterio.open(tmp_path / "a.tif") as file:
        assert file.descriptions == ("RH98", "ground")
        assert file.crs.to_epsg() == 32632
        assert (file.height, file.width) == (3, 5)
        for band, values_of_shots in enumerate(values.values()):
            sampled = [pixel[band] for pixel in file.sample(SURVEY.position)]
            assert np.array_equal(sampled, values_of_shots)
    terrain, crs, _ = read_dem(tmp_path / "a.tif")
    assert crs == "EPSG:32632"
    assert np.array_equal(terrain.origin, SURVEY.position[0])
    assert [p.name for p in tmp_path.iterdir()] == ["a.tif"]


def test_shots_may_be_in_any_order_and_cells_may_have_no_shot(tmp_path):
    order = np.random.default_rng(1).permutation(COUNT)[:-2]
    values = {"RH98": maps()["RH98"][order]}
    values["RH98"][0] = np.nan
    write_raster(tmp_path / "a.tif", values, SURVEY.position[order])
    with rasterio.open(tmp_path / "a.tif") as file:
        sampled = np.array([pixel[0] for pixel in file.sample(SURVEY.position[order])])
        assert np.array_equal(sampled, values["RH98"], equal_nan=True)
        # Two cells without a shot, and one with NaN.
        assert int((file.read_masks(1) == 0).sum()) == 3
        assert file.crs is None


@pytest.mark.parametrize("axis", [0, 1])
def test_a_raster_may_have_a_single_row_or_column(tmp_path, axis):
    position = np.zeros((4, 2))
    position[:, axis] = 0.1 * np.arange(4) + 7e5
    write_raster(tmp_path / "a.tiff", {"x": np.arange(4.0)}, position)
    with rasterio.open(tmp_path / "a.tiff") as file:
        assert [pixel[0] for pixel in file.sample(position)] == [0.0, 1.0, 2.0, 3.0]
        assert file.res == pytest.approx((0.1, 0.1), rel=1e-4)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"path": "a.png"}, ValueError, r"path = a.png ends in '.png'; admissible are .tif, .tiff"),
        ({"values": {}}, ValueError, "values is empty"),
        ({"values": [1.0]}, TypeError, "values"),
        ({"values": {"x": np.zeros(3)}}, ValueError, r"values of 'x' has shape \(3,\)"),
        ({"values": {"x": np.full(COUNT, np.inf)}}, ValueError, "values of 'x' = inf"),
        ({"crs": "EPSG:0"}, ValueError, "crs = 'EPSG:0' is not known"),
        ({"crs": 32632}, TypeError, "crs"),
        ({"position": np.zeros((COUNT, 4))}, ValueError, r"position has the shape \(15, 4\)"),
        ({"position": np.zeros((COUNT, 2))}, ValueError, "position: shot 1 lies where another one does"),
        (
            {"position": SURVEY.position + np.array([[1.234, 0.0]]) * (np.arange(COUNT) == 7)[:, None]},
            ValueError,
            "position: shot .* is off the grid of",
        ),
    ],
)
def test_bad_arguments_are_refused(tmp_path, monkeypatch, arguments, error, message):
    monkeypatch.chdir(tmp_path)
    good_arguments = {"path": "a.tif", "values": maps(), "position": SURVEY.position}
    with pytest.raises(error, match=message):
        write_raster(**(good_arguments | arguments))
    assert list(tmp_path.iterdir()) == []


def test_shots_anywhere_are_averaged_in_cells(tmp_path):
    """Ground positions of a scanner: cells at multiples of the spacing, NaN left out."""
    position = np.array(
        [(10.5, 20.5, 3.0), (11.5, 21.9, 4.0), (13.0, 20.0, 5.0), (np.nan, np.nan, np.nan), (10.1, 23.0, 1.0)]
    )
    values = {"height": position[:, 2], "echo": np.array([1.0, np.nan, 2.0, 7.0, 3.0])}
    write_raster(tmp_path / "a.tif", values, position, spacing=2.0)
    with rasterio.open(tmp_path / "a.tif") as file:
        assert (file.transform.c, file.transform.f, file.transform.a) == (10.0, 24.0, 2.0)
        # Rows run from north to south.
        np.testing.assert_array_equal(file.read(1), [[1.0, np.nan], [3.5, 5.0]])
        np.testing.assert_array_equal(file.read(2), [[3.0, np.nan], [1.0, 2.0]])
    with pytest.raises(ValueError, match="NaN for all"):
        write_raster(tmp_path / "b.tif", {"a": [1.0]}, [(np.nan, np.nan)], spacing=1.0)
    with pytest.raises(ValueError, match="makes 1e"):
        write_raster(tmp_path / "b.tif", {"a": [1.0, 2.0]}, [(0.0, 0.0), (1e5, 1e5)], spacing=0.1)
