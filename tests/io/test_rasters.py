"""Maps of surveys as GeoTIFF: at their place, to the bit, and refused where shots are on no grid."""

import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.io import read_dem, write_raster

rasterio = pytest.importorskip("rasterio")

SURVEY = jl.Survey.grid(jl.Lidar(), low=(600_000.0, 5_200_000.0), high=(600_020.0, 5_200_010.0), spacing=5.0)
COUNT = len(SURVEY)


def maps(seed=0):
    random = np.random.default_rng(seed)
    return {"RH98": random.uniform(5, 30, COUNT), "ground": random.normal(size=COUNT)}


def test_every_shot_is_the_middle_of_a_cell(tmp_path):
    values = maps()
    write_raster(tmp_path / "a.tif", values, SURVEY.position, crs="EPSG:32632")
    with rasterio.open(tmp_path / "a.tif") as file:
        assert file.descriptions == ("RH98", "ground")
        assert file.crs.to_epsg() == 32632
        assert (file.height, file.width) == (3, 5)
        for number, of_shots in enumerate(values.values(), 1):
            found = [value[number - 1] for value in file.sample(SURVEY.position)]
            assert np.array_equal(found, of_shots)
    terrain, crs, _ = read_dem(tmp_path / "a.tif")
    assert crs == "EPSG:32632"
    assert np.array_equal(terrain.origin, SURVEY.position[0])
    assert [p.name for p in tmp_path.iterdir()] == ["a.tif"]


def test_any_order_and_cells_without_a_shot(tmp_path):
    order = np.random.default_rng(1).permutation(COUNT)[:-2]
    values = {"RH98": maps()["RH98"][order]}
    values["RH98"][0] = np.nan
    write_raster(tmp_path / "a.tif", values, SURVEY.position[order])
    with rasterio.open(tmp_path / "a.tif") as file:
        found = np.array([value[0] for value in file.sample(SURVEY.position[order])])
        assert np.array_equal(found, values["RH98"], equal_nan=True)
        assert int((file.read_masks(1) == 0).sum()) == 3
        assert file.crs is None


@pytest.mark.parametrize("axis", [0, 1])
def test_one_row_alone(tmp_path, axis):
    place = np.zeros((4, 2))
    place[:, axis] = 0.1 * np.arange(4) + 7e5
    write_raster(tmp_path / "a.tiff", {"x": np.arange(4.0)}, place)
    with rasterio.open(tmp_path / "a.tiff") as file:
        assert [v[0] for v in file.sample(place)] == [0.0, 1.0, 2.0, 3.0]
        assert file.res == pytest.approx((0.1, 0.1), rel=1e-4)


@pytest.mark.parametrize(
    ("given", "error", "said"),
    [
        ({"path": "a.png"}, ValueError, r"path = a.png ends in '.png'; admissible are .tif, .tiff"),
        ({"values": {}}, ValueError, "values is empty"),
        ({"values": [1.0]}, TypeError, "values"),
        ({"values": {"x": np.zeros(3)}}, ValueError, r"values of 'x' has shape \(3,\)"),
        ({"values": {"x": np.full(COUNT, np.inf)}}, ValueError, "values of 'x' = inf"),
        ({"crs": "EPSG:0"}, ValueError, "crs = 'EPSG:0' is not known"),
        ({"crs": 32632}, TypeError, "crs"),
        ({"position": np.zeros((COUNT, 3))}, ValueError, r"position has the shape \(15, 3\)"),
        ({"position": np.zeros((COUNT, 2))}, ValueError, "position: shot 1 lies where another one does"),
        (
            {"position": SURVEY.position + np.array([[1.234, 0.0]]) * (np.arange(COUNT) == 7)[:, None]},
            ValueError,
            "position: shot .* is off the grid of",
        ),
    ],
)
def test_what_is_refused(tmp_path, monkeypatch, given, error, said):
    monkeypatch.chdir(tmp_path)
    usual = {"path": "a.tif", "values": maps(), "position": SURVEY.position}
    with pytest.raises(error, match=said):
        write_raster(**(usual | given))
    assert list(tmp_path.iterdir()) == []
