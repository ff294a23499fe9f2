"""The reader of trajectories: tolerant of names and separators, strict about what they mean."""

import numpy as np
import pytest

import jaxlidar.io

HEAD = "GPSTime,Easting,Northing,Height,Roll,Pitch,Heading"
ROWS = "100.0,500000.5,5200000.25,812.5,1.5,-2.0,359.0\n100.5,500030.5,5200000.25,813.5,2.5,-1.0,1.0\n"


def written(tmp_path, text, name="flight.csv"):
    path = tmp_path / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "text",
    [
        f"{HEAD}\n{ROWS}",
        f"# exported by a program\n#\n{HEAD}\n{ROWS}",
        f"#{HEAD}\n{ROWS}",
        "time [s];x (m);y (m);alt (m);ROLL (deg);PITCH (deg);Yaw (deg)\n" + ROWS.replace(",", ";"),
        "Time_SOW\tE\tN\tH-Ell\tRoll\tPitch\tHeading\n" + ROWS.replace(",", "\t"),
        "GPS_Time East North Elevation roll pitch heading\n" + ROWS.replace(",", "   "),
        "Quality," + HEAD + ",sdE\n" + "".join(f"1,{row},0.02\n" for row in ROWS.splitlines()),
        "GPSTime (ms),Easting,Northing,Height (cm),Roll,Pitch,Heading\n"
        "100000,500000.5,5200000.25,81250,1.5,-2.0,359\n100500,500030.5,5200000.25,81350,2.5,-1.0,1\n",
    ],
)
def test_names_separators_and_units(tmp_path, text):
    flight = jaxlidar.io.read_trajectory(written(tmp_path, text))
    np.testing.assert_allclose(flight.time, [100.0, 100.5])
    np.testing.assert_allclose(
        flight.position, [[500000.5, 5200000.25, 812.5], [500030.5, 5200000.25, 813.5]]
    )
    np.testing.assert_allclose(flight.roll, [1.5, 2.5])
    np.testing.assert_allclose(flight.yaw, [359.0, 1.0])


def test_angles_in_radians_and_without_attitude(tmp_path):
    text = "time,x,y,z,roll (rad),pitch (rad),yaw (rad)\n0,0,0,5,0.1,0.2,3.0\n"
    flight = jaxlidar.io.read_trajectory(written(tmp_path, text))
    np.testing.assert_allclose([flight.roll[0], flight.pitch[0], flight.yaw[0]], np.rad2deg([0.1, 0.2, 3.0]))
    level = jaxlidar.io.read_trajectory(written(tmp_path, "time,x,y,z\n0,0,0,5\n1,10,0,5\n"))
    assert level.yaw.tolist() == [90.0, 90.0]
    assert level.roll.tolist() == [0.0, 0.0]


def test_longitude_and_latitude_are_projected_and_headings_turned(tmp_path):
    pytest.importorskip("rasterio")
    # On the central meridian the grid's north is true; 3 degrees east of it, it is off by 3 sin(latitude).
    text = "time,lon,lat,height,roll,pitch,heading\n0,15,48,500,0,0,90\n1,18,48,500,0,0,90\n"
    path = written(tmp_path, text)
    flight = jaxlidar.io.read_trajectory(path, crs="EPSG:32633")
    assert flight.position[0, 0] == pytest.approx(500000.0, abs=0.01)
    convergence = np.rad2deg(np.arctan(np.tan(np.deg2rad(3.0)) * np.sin(np.deg2rad(48.0))))
    np.testing.assert_allclose(flight.yaw, [90.0, 90.0 - convergence], atol=1e-2)
    with pytest.raises(ValueError, match="give crs"):
        jaxlidar.io.read_trajectory(path)
    # West of the meridian, headings near north are more than a turn from the map's.
    path = written(tmp_path, "time,lon,lat,height,heading\n0,12,48,500,359.5\n1,12,48,500,0.5\n")
    flight = jaxlidar.io.read_trajectory(path, crs="EPSG:32633")
    expected = convergence + np.array([-0.5, 0.5])
    np.testing.assert_allclose(np.remainder(flight.yaw, 360.0), expected, atol=1e-2)


@pytest.mark.parametrize(
    "column",
    [
        *("UTC", "UTC time", "utc_time", "UTCSeconds", "Time (UTC)", "time [UTC s]", "GMT", "Unix time"),
        *("Local time", "time (local)", "Seconds of day", "Time_SOD", "TAI"),
    ],
)
def test_times_that_are_not_gps_time_are_refused(tmp_path, column):
    table = f"{column},x,y,z\n7,0,0,5\n8,10,0,5\n"
    with pytest.raises(ValueError, match=r"flight\.csv: line 1: .*not GPS time; admissible is") as error:
        jaxlidar.io.read_trajectory(written(tmp_path, table))
    assert repr(column) in str(error.value)
    # Beside a column of GPS time they are columns that are not read.
    table = f"{column},GPSTime,x,y,z\n7,25,0,0,5\n8,26,10,0,5\n"
    assert jaxlidar.io.read_trajectory(written(tmp_path, table)).time.tolist() == [25.0, 26.0]


def test_a_column_again_in_another_unit_is_not_read(tmp_path):
    path = tmp_path / "track.csv"
    path.write_text("time,x,y,z,z_ft\n0,1,2,3,9\n1,1,2,3,9\n")
    np.testing.assert_allclose(jaxlidar.io.read_trajectory(path).position[:, 2], 3.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no row"),
        (f"{HEAD}\n", "no row"),
        ("1,2,3,4,5,6,7\n2,2,3,4,5,6,7\n", "no column"),
        ("time,x,y,roll,pitch,yaw\n0,0,0,0,0,0\n", "no column z"),
        ("time,x,y,z,pitch\n0,0,0,0,0\n", "no column roll"),
        (f"{HEAD},yaw\n100,1,2,3,4,5,6,7\n", "yaw may be any of the columns 'Heading', 'yaw'"),
        ("time,x,y,lon,lat,z\n0,0,0,0,0,0\n", "remove one pair"),
        (f"{HEAD}\n100,1,2,3,4,5\n", "line 2"),
        (f"{HEAD}\n100,1,2,three,4,5,6\n", "line 2: Height"),
        (f"{HEAD}\n100,1,2,inf,4,5,6\n", "line 2: Height is not finite"),
        (f"{HEAD}\n100,1,2,3,4,95,6\n", "pitch"),
        (f"{HEAD}\n100,1,2,3,4,5,6\n99,1,2,3,4,5,6\n", "rise strictly"),
        ("time (weeks),x,y,z\n0,0,0,0\n", r"line 1: .time \(weeks\).: the unit .weeks. is not known"),
        ("time,x,y,z (parsec)\n0,0,0,0\n", "z"),
    ],
)
def test_inadmissible_files(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        jaxlidar.io.read_trajectory(written(tmp_path, text))


def test_a_true_heading_is_turned_to_the_map_of_x_and_y(tmp_path):
    """The same flight by longitude and latitude, and by their projection: without a map it is refused."""
    pytest.importorskip("rasterio")
    rows = "10,{},812.5,1.5,-2.0,359.5\n"
    text = "GPSTime,Longitude,Latitude,Height,Roll,Pitch,Heading\n" + rows.format("12.0,52.0")
    expected = jaxlidar.io.read_trajectory(written(tmp_path, text), crs="EPSG:32633")
    assert abs(expected.yaw[0] - 359.5) > 2.0
    x, y, _ = expected.position[0].tolist()
    text = HEAD.replace("Heading", "True Heading") + "\n" + rows.format(f"{x!r},{y!r}")
    path = written(tmp_path, text)
    flight = jaxlidar.io.read_trajectory(path, crs="EPSG:32633")
    np.testing.assert_allclose(flight.position, expected.position)
    np.testing.assert_allclose(flight.yaw, expected.yaw, atol=1e-9)
    with pytest.raises(ValueError, match="'True Heading' is from true north; give crs"):
        jaxlidar.io.read_trajectory(path)
    path = written(tmp_path, f"{HEAD}\n{ROWS}")
    with pytest.raises(ValueError, match="no heading is named as one from"):
        jaxlidar.io.read_trajectory(path, crs="EPSG:32633")
