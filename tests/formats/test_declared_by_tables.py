"""What tables declare: units and systems in comments, columns whose names are nearly known, radians."""

import warnings

import numpy as np
import pytest

import jaxlidar as jl
import jaxlidar.io

US_FOOT = 1200.0 / 3937.0
HEAD = "time,x,y,z,roll,pitch,yaw"
ROWS = "0,1000,2000,300,1,-2,90\n1,1100,2000,310,1,-2,90\n"


def table(folder, *lines):
    path = folder / "table.csv"
    path.write_text("\n".join(lines))
    return path


def test_a_trajectory_in_feet(tmp_path):
    for text, size in (("# units: feet", 0.3048), ("# Unit = us-ft", US_FOOT), ("# units: m", 1.0)):
        flight = jaxlidar.io.read_trajectory(table(tmp_path, text, HEAD, ROWS))
        np.testing.assert_allclose(flight.position[0], np.array([1000, 2000, 300]) * size, rtol=1e-12)
    # The header may be a comment, too, above or below.
    for order in (("# units: feet", "#" + HEAD), ("#" + HEAD, "# units: feet")):
        flight = jaxlidar.io.read_trajectory(table(tmp_path, *order, ROWS))
        np.testing.assert_allclose(flight.position[0], np.array([1000, 2000, 300]) * 0.3048)


def test_a_unit_beside_a_name_goes_before_the_comment(tmp_path):
    path = table(tmp_path, "# units: feet", HEAD.replace("z", "z (m)"), ROWS)
    flight = jaxlidar.io.read_trajectory(path)
    np.testing.assert_allclose(flight.position[0], [304.8, 609.6, 300.0])


def test_the_system_of_a_trajectory(tmp_path):
    pytest.importorskip("rasterio")
    flight = jaxlidar.io.read_trajectory(table(tmp_path, "# crs: EPSG:2263", HEAD, ROWS))
    np.testing.assert_allclose(flight.position[0], np.array([1000, 2000, 300]) * US_FOOT, rtol=1e-9)
    geographic = ("time,lon,lat,z", "0,15,48,500\n")
    path = table(tmp_path, "# crs: EPSG:32633", *geographic)
    given = jaxlidar.io.read_trajectory(table(tmp_path, *geographic), crs="EPSG:32633")
    path = table(tmp_path, "# crs: EPSG:32633", *geographic)
    np.testing.assert_array_equal(jaxlidar.io.read_trajectory(path).position, given.position)


@pytest.mark.parametrize(
    ("comments", "message"),
    [
        (("# units: furlong",), "furlong"),
        (("# units: feet", "# units: m"), "admissible is one"),
        (("# crs: EPSG:2263", "# units: m"), "another unit"),
        (("# crs: EPSG:4326",), "degrees"),
        (("# crs: nonsense",), "nonsense"),
    ],
)
def test_comments_that_do_not_fit_are_refused(tmp_path, comments, message):
    pytest.importorskip("rasterio")
    with pytest.raises(ValueError, match=message):
        jaxlidar.io.read_trajectory(table(tmp_path, *comments, HEAD, ROWS))


@pytest.mark.parametrize("name", ["dbh_in", "crown_radius", "elev", "z_feet", "Specis"])
def test_columns_with_nearly_known_names_are_said(tmp_path, name):
    path = table(tmp_path, f"x,y,height,{name}", "1,2,20,3")
    with pytest.warns(UserWarning, match=f"not read: '{name}'"):
        jaxlidar.io.read_inventory(path)
    with pytest.warns(UserWarning, match=f"not read: '{name}'"):
        jl.stand_from_inventory({"x": [1.0], "y": [2.0], "height": [9.0], name: [3.0]}, individuals=1)


def test_other_columns_are_not_said(tmp_path):
    jaxlidar.io.read_inventory(table(tmp_path, "tree,plot,x,y,height,dbh_cm,vigour", "1,2,1,2,20,30,0"))
    jaxlidar.io.read_trajectory(table(tmp_path, HEAD + ",quality,satellites", "0,1,2,3,1,2,90,1,9"))
    with pytest.warns(UserWarning, match="'rol'"):
        jaxlidar.io.read_trajectory(table(tmp_path, "time,x,y,z,rol", "0,1,2,3,1"))


def test_radians_are_said(tmp_path):
    place = ([0.0, 1.0], [(0, 0, 500), (0, 60, 500)])
    angles = {"roll": [0.02, -0.5], "pitch": [0.01, 0.05], "yaw": [0.0, 6.2]}
    with pytest.warns(jl.UnitWarning, match="rad2deg"):
        flight = jl.Trajectory(*place, **angles)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        flight.at([0.5])
        for changed in (
            {"yaw": [0.0, 6.4]},
            {"roll": [0.0, 0.7]},
            {"roll": 0.0, "pitch": 0.0},
            {"yaw": None},
        ):
            jl.Trajectory(*place, **{**angles, **changed})
        # A file that names the unit is believed.
        head = "time,x,y,z,roll [deg],pitch [deg],yaw [deg]"
        jaxlidar.io.read_trajectory(table(tmp_path, head, "0,0,0,500,0.02,0.01,6.2"))
    with pytest.warns(jl.UnitWarning):
        jaxlidar.io.read_trajectory(table(tmp_path, HEAD, "0,0,0,500,0.02,0.01,6.2"))


def test_rates_and_angles_of_scans():
    pattern = jl.RotatingPolygon(half_angle=30.0, line_rate=100.0)
    with pytest.warns(jl.UnitWarning, match=r"in MHz\? 0.377 MHz is 377000"):
        jl.Survey.scan(jl.Lidar(), pattern, start=(0, 0), end=(0, 600), speed=50.0, pulse_rate=0.377)
    with pytest.warns(jl.UnitWarning, match=r"in rad\? 0.52 rad is 29.79"):
        jl.RotatingPolygon(half_angle=0.52, line_rate=100.0)
