"""Coordinate reference systems and units that files declare: they are used, or the file is refused.

The same points, 10 units apart and 20 units high, are declared in all the ways that files have. Sizes of
units are those of the EPSG registry: foot 0.3048 m, foot of the US survey 1200/3937 m, degree pi/180 rad,
gradian pi/200 rad.
"""

import contextlib
import dataclasses
import math
import re
import struct

import jax
import laspy
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar import cli
from jaxlidar._fields.crs import directions_of_north, system_of_name, transform
from jaxlidar._fields.units import unit_size
from jaxlidar.io import (
    read_dem,
    read_gedi_l1b,
    read_las,
    read_las_waveforms,
    read_mesh,
    read_pulsewaves,
    read_qsm,
    read_vox,
    write_las,
    write_las_waveforms,
    write_raster,
)
from tests.formats import test_gedi, test_las_waveforms, test_neon, test_pulsewaves
from tests.formats.test_dem import ROWS, write_ascii_grid, write_tiff

rasterio = pytest.importorskip("rasterio")
project = pytest.importorskip("rasterio.warp").transform
pyproj = pytest.importorskip("pyproj")

FOOT, US_FOOT = 0.3048, 1200 / 3937
POINTS = np.array([[10.0, 20.0, 5.0], [20.0, 20.0, 25.0]])
USER_DEFINED = 32767


# -- declarations ------------------------------------------------------------------------------------------


def wkt(name, version="WKT1_GDAL"):
    return rasterio.CRS.from_user_input(name).to_wkt(version=version)


def keys(**codes):
    """Directory of GeoTIFF keys by number, as k1024=2."""
    rows = [(int(key[1:]), 0, 1, code) for key, code in codes.items()]
    return b"".join(struct.pack("<4H", *row) for row in [(1, 1, 0, len(rows)), *rows])


MAP = {"k1024": 1, "k3072": 26910}
LOCAL_FEET = 'LOCAL_CS["site",UNIT["foot",0.3048]]'
ENGINEERING_FEET = (
    'ENGCRS["site",EDATUM["site"],CS[Cartesian,3],AXIS["x",east],AXIS["y",north],AXIS["z",up],'
    'LENGTHUNIT["foot",0.3048]]'
)
GEODETIC = (
    'GEODCRS["WGS 84",DATUM["World Geodetic System 1984",ELLIPSOID["WGS 84",6378137,298.257223563,'
    'LENGTHUNIT["metre",1.0]]],CS[ellipsoidal,2],AXIS["latitude",north,ORDER[1]],'
    'AXIS["longitude",east,ORDER[2]],ANGLEUNIT["degree",0.017453292519943]]'
)
HEIGHTS = 'VERTCRS["NAVD88",VDATUM["NAVD88"],CS[vertical,1],AXIS["height",up],LENGTHUNIT["metre",1.0]]'
# In international feet, with the shift of its datum to WGS 84.
BOUND_FEET = (
    'COMPD_CS["site",PROJCS["site",GEOGCS["site",DATUM["Potsdam",SPHEROID["Bessel 1841",6377397.155,'
    '299.1528128],TOWGS84[598.1,73.7,418.2,0.202,0.045,-2.455,6.7]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",9],PARAMETER["scale_factor",0.9996],'
    'PARAMETER["false_easting",1640000],PARAMETER["false_northing",0],UNIT["foot",0.3048],'
    'AXIS["Easting",EAST],AXIS["Northing",NORTH]],VERT_CS["site",VERT_DATUM["site",2005],'
    'UNIT["foot",0.3048],AXIS["Up",UP]]]'
)
UNKNOWN_UNIT_OF_HEIGHTS = "+proj=utm +zone=33 +units=km"
# Metres per unit of x and y, and per unit of z, by the content of the record.
IN_METRES = {
    "metres": (wkt("EPSG:32633"), 1.0, 1.0),
    "feet of the US survey": (wkt("EPSG:2225"), US_FOOT, US_FOOT),
    "international feet": (wkt("EPSG:2222"), FOOT, FOOT),
    "vertical feet": (wkt("EPSG:26910+6360"), 1.0, US_FOOT),
    "vertical metres": (wkt("EPSG:2225+5703"), US_FOOT, 1.0),
    "text of version 2": (wkt("EPSG:26910+6360", "WKT2_2019"), 1.0, US_FOOT),
    "blanks before and after": (" \t\r\n" + wkt("EPSG:2225") + " \n", US_FOOT, US_FOOT),
    "a byte order mark": ("\ufeff" + wkt("EPSG:2225"), US_FOOT, US_FOOT),
    "Esri's text": (wkt("EPSG:2225", "WKT1_ESRI"), US_FOOT, US_FOOT),
    "a bound system": (BOUND_FEET, FOOT, FOOT),
    "a local system": (LOCAL_FEET, FOOT, FOOT),
    "an engineering system": (ENGINEERING_FEET, FOOT, FOOT),
    "heights alone": (wkt("EPSG:6360"), US_FOOT, US_FOOT),
    "an empty text": ("", 1.0, 1.0),
    "keys in metres": (keys(**MAP), 1.0, 1.0),
    "keys of a code in feet": (keys(k1024=1, k3072=2225), US_FOOT, US_FOOT),
    "3076": (keys(k1024=1, k3072=USER_DEFINED, k3076=9002), FOOT, FOOT),
    "3076 without a code": (keys(k1024=1, k3076=9003), US_FOOT, US_FOOT),
    "3076 without a model": (keys(k3076=9003), US_FOOT, US_FOOT),
    "3076 beside a code": (keys(**MAP, k3076=9003), US_FOOT, US_FOOT),
    "4099": (keys(**MAP, k4099=9003), 1.0, US_FOOT),
    "4099 in metres": (keys(k1024=1, k3072=2225, k4099=9001), US_FOOT, 1.0),
    "4096": (keys(**MAP, k4096=6360), 1.0, US_FOOT),
    "no keys": (keys(), 1.0, 1.0),
}
REFUSED = {
    "degrees": (wkt("EPSG:4326"), "coordinates in degrees"),
    "blanks and degrees": ("  " + wkt("EPSG:4326"), "coordinates in degrees"),
    "degrees with heights": (wkt("EPSG:4326+5773"), "coordinates in degrees"),
    "degrees in three dimensions": (wkt("EPSG:4979", "WKT2_2019"), "coordinates in degrees"),
    "GEODCRS": (GEODETIC, "coordinates in degrees"),
    "COMPOUNDCRS": (f'COMPOUNDCRS["both",{GEODETIC},{HEIGHTS}]', "coordinates in degrees"),
    "gradians": (wkt("EPSG:4807"), "coordinates in degrees"),
    "geocentric": (wkt("EPSG:4978"), "geocentric"),
    "to the south and west": (wkt("EPSG:2048"), "axes to the south and west"),
    "kilometres": (wkt(UNKNOWN_UNIT_OF_HEIGHTS), "x and y are in units of 1000 m"),
    "garbage": ("PROJCS[", "is not known"),
    "keys in degrees": (keys(k1024=2, k2048=4326), "coordinates in degrees"),
    "keys in degrees without a model": (keys(k2048=4326), "coordinates in degrees"),
    "keys of a user's degrees": (keys(k1024=2), "coordinates in degrees"),
    "geocentric keys": (keys(k1024=3), "geocentric"),
    "keys that differ on heights": (
        keys(**MAP, k4096=5703, k4099=9003),
        "two coordinate systems that differ",
    ),
    "keys that differ on angles": (keys(k1024=2, k2048=4326, k2054=9105), "two coordinate systems that dif"),
}


def las(folder, content, *, extended=False, number=None, scale=0.001, points=POINTS):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, scale), np.zeros(3)
    file = laspy.LasData(header)
    file.x, file.y, file.z = points.T
    if isinstance(content, str):
        content, number = content.encode() + b"\0", number or 2112
    record = laspy.VLR("LASF_Projection", number or 34735, "", content)
    if extended:
        file.evlrs = laspy.vlrs.vlrlist.VLRList([record])
    else:
        file.vlrs.append(record)
    path = folder / "cloud.las"
    file.write(path)
    return path


# -- transformations ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("crs", "says"),
    [
        # Of WGS 84, and of an ellipsoid without a datum.
        ("EPSG:32633", None),
        ("EPSG:32633+5773", None),
        ("+proj=utm +zone=33 +ellps=WGS84 +units=m", None),
        # The registry states 1 m between ETRS89 and WGS 84.
        ("EPSG:25833", "accuracy of the transformation from WGS 84 to ETRS89 / UTM zone 33N is 1 m"),
        (wkt("EPSG:25833"), "is 1 m"),
        # A shift whose accuracy nobody states: of a datum that is "unknown", too.
        ("+proj=utm +zone=33 +ellps=WGS84 +towgs84=0,0,0 +units=m", "is not known"),
        # A datum that no transformation leads to.
        (wkt("EPSG:32633").replace('DATUM["WGS_1984"', 'DATUM["survey of 1970"'), "is not known"),
    ],
)
def test_transformations_say_their_accuracy(tmp_path, crs, says):
    path = tmp_path / "flight.csv"
    path.write_text("time,lon,lat,height\n0,15,48,500\n1,15.001,48,500\n")
    # Names and codes of EPSG in a text would lead to its own datum.
    if "survey" in crs:
        crs = re.sub(r',AUTHORITY\["EPSG","\d+"\]', "", crs)
    caught = contextlib.nullcontext() if says is None else pytest.warns(UserWarning, match=says)
    with caught:
        flight = jl.io.read_trajectory(path, crs=crs)
    # Their ellipsoids differ by 0.1 mm.
    np.testing.assert_allclose(
        flight.position[:, :2].T,
        project("EPSG:4326", "EPSG:32633", [15, 15.001], [48, 48]),
        rtol=0,
        atol=1e-3,
    )


@pytest.mark.parametrize(
    ("zone", "says"),
    [
        ("EPSG:32633", "a better one needs a file that `projsync --file us_nga_egm96"),
        ("EPSG:25833", "a better one needs a file that `projsync --file us_nga_egm96"),
        # Of its ellipsoid nothing is asked.
        ("+proj=utm +zone=33 +ellps=WGS84 +type=crs", ""),
    ],
)
def test_heights_above_another_surface_are_not_known(zone, says):
    """Without its grid, PROJ takes heights above the geoid for those above the ellipsoid."""
    crs = pyproj.crs.CompoundCRS("zone and heights", [pyproj.CRS(zone), pyproj.CRS("EPSG:5773")])
    place = np.array([[5e5], [5.3e6], [100.0]])
    with pytest.warns(UserWarning, match=rf"^a\.csv: the accuracy .* is not known.*{says}"):
        there = transform("a.csv", crs, "EPSG:4979", *place)
    with pytest.warns(UserWarning, match=r"^a\.csv: the accuracy .* is not known"):
        transform("a.csv", "EPSG:4979", crs, *there.T)


def test_a_better_transformation_that_is_not_installed_is_named():
    """OSTN15 is a file of its own. Without it the datum of Great Britain is known to 2 m."""
    with pytest.warns(UserWarning, match=r"is \d m; a better one needs a file that `projsync --file uk_os_"):
        transform("a.csv", "EPSG:4326", "EPSG:27700", np.array([-1.0]), np.array([52.0]))


def test_directions_of_north_of_a_conic_map():
    """Of Lambert-93 the north turns by sin(latitude of the cone) times the longitude from 3 degrees east."""
    longitude, latitude = np.array([3.0, 8.0, -4.0]), np.array([46.5, 48.0, 44.0])
    x, y = project("EPSG:4171", "EPSG:2154", longitude, latitude)
    directions = directions_of_north(system_of_name("crs", "EPSG:2154").crs, np.array(x), np.array(y))
    np.testing.assert_allclose(directions, 0.7256077650 * (longitude - 3.0), atol=1e-6)


# -- point clouds ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize("case", IN_METRES)
def test_points_are_read_in_metres(tmp_path, case, extended):
    content, horizontal, vertical = IN_METRES[case]
    cloud = read_las(las(tmp_path, content, extended=extended))
    np.testing.assert_allclose(cloud.position, POINTS * [horizontal, horizontal, vertical], rtol=1e-9)


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize("case", REFUSED)
def test_points_in_other_units_are_refused(tmp_path, case, extended):
    content, says = REFUSED[case]
    with pytest.raises(ValueError, match=rf"cloud\.las: header: .*{says}"):
        read_las(las(tmp_path, content, extended=extended))


def test_feet_of_the_us_survey_are_told_from_international_ones(tmp_path):
    """At 6 million feet they differ by 3.7 m."""
    far = np.add(POINTS, [6e6, 2e6, 0.0])
    eastings = [
        read_las(las(tmp_path, wkt(code), points=far, scale=0.01)).position[0, 0]
        for code in ("EPSG:2225", "EPSG:2222")
    ]
    assert eastings[0] - eastings[1] == pytest.approx(6e6 * (US_FOOT - FOOT), abs=1e-3)


def test_a_scale_replaces_the_declared_unit(tmp_path):
    path = las(tmp_path, wkt("EPSG:2225"))
    np.testing.assert_allclose(read_las(path, scale=0.5).position, 0.5 * POINTS)
    contradictory, _ = REFUSED["keys that differ on heights"]
    np.testing.assert_allclose(read_las(las(tmp_path, contradictory), scale=0.5).position, 0.5 * POINTS)
    with pytest.raises(ValueError, match="coordinates in degrees"):
        read_las(las(tmp_path, wkt("EPSG:4326")), scale=1.0)


def test_text_and_keys_must_agree(tmp_path):
    file = laspy.read(las(tmp_path, wkt("EPSG:2225")))
    for content, says in (
        (keys(k1024=1, k3072=2225, k4099=9001), None),
        (keys(**MAP), "systems that differ"),
    ):
        file.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", content))
        file.write(tmp_path / "both.las")
        if says:
            with pytest.raises(ValueError, match=says):
                read_las(tmp_path / "both.las")
        else:
            position = read_las(tmp_path / "both.las").position
            np.testing.assert_allclose(position, POINTS * [US_FOOT, US_FOOT, 1.0])
        file.vlrs.pop()


def test_a_transformation_of_coordinates_is_refused(tmp_path):
    path = las(tmp_path, 'PARAM_MT["Affine"]', number=2111)
    with pytest.raises(ValueError, match=r"its coordinates are to be transformed \(record 2111\)"):
        read_las(path)


def test_elevations_of_millions_of_metres_are_refused(tmp_path):
    geocentric = np.array([[4.1e6, 1.2e6, 4.7e6], [4.1e6, 1.2e6, 4.7e6]])
    with pytest.raises(ValueError, match=r"an elevation of 4\.7e[+]06 m"):
        read_las(las(tmp_path, "", points=geocentric, scale=0.01))


def test_info_describes_points_in_degrees(tmp_path, capsys):
    assert cli.main(["info", str(las(tmp_path, wkt("EPSG:4326")))]) == 0
    assert "2 points: x 10 to 20, y 20 to 20, z 5 to 25, WGS 84" in capsys.readouterr().out
    assert cli.main(["info", str(las(tmp_path, wkt("EPSG:26910+6360")))]) == 0
    assert "x 10.00 to 20.00 m, y 20.00 to 20.00 m, z 1.52 to 7.62 m" in capsys.readouterr().out


def test_written_points_declare_their_system(tmp_path):
    path = tmp_path / "a.las"
    write_las(path, POINTS, crs="EPSG:32633")
    np.testing.assert_allclose(read_las(path).position, POINTS)
    header = laspy.read(path).header
    assert header.global_encoding.wkt
    (record,) = header.vlrs.get_by_id("LASF_Projection", (2112,))
    assert rasterio.CRS.from_wkt(record.string).to_epsg() == 32633


@pytest.fixture(scope="module")
def waves():
    lidar = jl.Lidar()
    return [jl.simulate(lidar, jl.Scene(ground=jl.Ground()), key=jax.random.key(0), max_orders=1)]


@pytest.mark.parametrize(
    ("crs", "error", "says"),
    [
        ("EPSG:4326", ValueError, "is not in metres"),
        ("EPSG:2225", ValueError, "is not in metres"),
        ("EPSG:26910+6360", ValueError, "is not in metres"),
        ("EPSG:4978", ValueError, "is not in metres"),
        (UNKNOWN_UNIT_OF_HEIGHTS, ValueError, "is not in metres"),
        ("EPSG:2048", ValueError, "axes to the south and west"),
        ("EPSG:0", ValueError, "is not known"),
        (32633, TypeError, None),
    ],
)
def test_writers_refuse_systems_that_are_not_in_metres(tmp_path, waves, crs, error, says):
    with pytest.raises(error, match=says):
        write_las(tmp_path / "a.las", POINTS, crs=crs)
    with pytest.raises(error, match=says):
        write_raster(tmp_path / "a.tif", {"x": [1.0, 2.0]}, POINTS[:, :2], crs=crs)
    with pytest.raises(error, match=says):
        jl.io.write_gedi_l1b(tmp_path / "a.h5", waves, jl.Survey.of(jl.Lidar()), crs=crs)
    assert list(tmp_path.iterdir()) == []


# -- waveforms ---------------------------------------------------------------------------------------------


def pulsewaves(folder, content, **changes):
    """The small files of test_pulsewaves with one more record, of the coordinate reference system."""
    pls, wvs = test_pulsewaves.small_files(**changes)
    number = 2112 if isinstance(content, str) else 34735
    record = test_pulsewaves.variable_length_record(
        b"PulseWaves_Proj", number, content.encode() + b"\0" if isinstance(content, str) else content
    )
    (start,), (records,) = struct.unpack_from("<q", pls, 176), struct.unpack_from("<I", pls, 216)
    data = bytearray(pls[:start] + record + pls[start:])
    struct.pack_into("<q", data, 176, start + len(record))
    struct.pack_into("<I", data, 216, records + 1)
    (folder / "small.pls").write_bytes(bytes(data))
    (folder / "small.wvs").write_bytes(wvs)
    return folder / "small.pls"


def scales(horizontal, vertical):
    """Scales with which the small files hold the same flight in other units."""
    return {"scale": (0.001 / horizontal, 0.001 / horizontal, 0.001 / vertical)}


@pytest.mark.parametrize("case", IN_METRES)
def test_pulses_have_the_declared_units(tmp_path, case):
    content, horizontal, vertical = IN_METRES[case]
    shot = read_pulsewaves(pulsewaves(tmp_path, content, **scales(horizontal, vertical)))[0]
    np.testing.assert_allclose(shot.metres, [horizontal, horizontal, vertical], rtol=2e-6)
    expected = read_pulsewaves(pulsewaves(tmp_path, ""))[0]
    assert shot.zenith == pytest.approx(expected.zenith, rel=1e-6)


@pytest.mark.parametrize("case", ["vertical feet", "4099", "feet of the US survey"])
def test_pulses_in_other_units_than_declared_are_refused(tmp_path, case):
    with pytest.raises(ValueError, match=r"small\.pls: pulses: directions of 0\.0[45]"):
        read_pulsewaves(pulsewaves(tmp_path, IN_METRES[case][0]))


def test_light_tells_the_unit_of_heights_that_is_not_declared(tmp_path):
    """EPSG:2225 has feet for x and y alone; heights are metres here."""
    shot = read_pulsewaves(pulsewaves(tmp_path, wkt("EPSG:2225"), **scales(US_FOOT, 1.0)))[0]
    np.testing.assert_allclose(shot.metres, [US_FOOT, US_FOOT, 1.0], rtol=1e-9)


@pytest.mark.parametrize("unit", ["degree", "gradian"])
def test_pulses_in_degrees_and_gradians(tmp_path, unit):
    size = math.pi / 180 if unit == "degree" else math.pi / 200
    system = 'GEOGCS["x",DATUM["x",SPHEROID["x",6378137,298.257223563]],PRIMEM["Greenwich",0],UNIT["{}",{}]]'
    north, east = 6_367_449.0, 6_378_137.0
    folder_scale = (0.001 / (east * size), 0.001 / (north * size), 0.001)
    # The fixture lies at 500,000 + n counts of mm east, 4,000,000 north, from the offset: on the equator.
    path = pulsewaves(tmp_path, "  " + system.format(unit, size), scale=folder_scale, offset=(0.2, 0.1, 0.0))
    shot = read_pulsewaves(path)[0]
    expected = read_pulsewaves(pulsewaves(tmp_path, ""))[0]
    assert shot.is_geographic
    assert shot.zenith == pytest.approx(expected.zenith, rel=0.02)
    assert shot.zenith > 5


@pytest.mark.parametrize("case", ["garbage", "to the south and west", "keys that differ on heights"])
def test_pulses_of_systems_that_cannot_be_used_are_refused(tmp_path, case):
    content, says = REFUSED[case]
    with pytest.raises(ValueError, match=rf"small\.pls: header: .*{says}"):
        read_pulsewaves(pulsewaves(tmp_path, content))


def geocentric_flight(place, zenith, azimuth, keys_of_file, folder):
    """A pulse that leaves 400 m above a place (degrees, degrees, m), in geocentric coordinates."""
    lon, lat, height = np.deg2rad(place[0]), np.deg2rad(place[1]), place[2]
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    north = np.cross(up, east)
    a, e2 = 6378137.0, 0.00669437999014
    prime_vertical = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    ground = np.array(
        [
            (prime_vertical + height) * np.cos(lat) * np.cos(lon),
            (prime_vertical + height) * np.cos(lat) * np.sin(lon),
            (prime_vertical * (1 - e2) + height) * np.sin(lat),
        ]
    )
    z, az = np.deg2rad(zenith), np.deg2rad(azimuth)
    way = 0.149896 * (np.sin(z) * (np.sin(az) * east + np.cos(az) * north) - np.cos(z) * up)
    anchor = ground - 702.0 * way
    pls, wvs = test_pulsewaves.small_files(offset=tuple(anchor))
    counts = np.round(1000 * way / 0.001).astype(int)
    data = bytearray(pls)
    (start,) = struct.unpack_from("<q", data, 176)
    for n in range(3):
        struct.pack_into("<3i3ih", data, start + 48 * n + 16, 0, 0, 0, *counts, 702)
    record = (
        test_pulsewaves.variable_length_record(b"PulseWaves_Proj", 34735, keys_of_file)
        if keys_of_file
        else b""
    )
    content = bytearray(bytes(data[:start]) + record + bytes(data[start:]))
    struct.pack_into("<q", content, 176, start + len(record))
    struct.pack_into("<I", content, 216, 4 + bool(record))
    (folder / "a.pls").write_bytes(bytes(content))
    (folder / "a.wvs").write_bytes(wvs)
    return folder / "a.pls"


@pytest.mark.parametrize("place", [(16.2, 47.7, 350.0), (-120.0, -33.0, 12.0), (2.0, 0.5, 900.0)])
def test_geocentric_pulses_become_geographic(tmp_path, place):
    """Light returns 702 ns after the anchor from the place, whose coordinates follow from the ellipsoid."""
    path = geocentric_flight(place, 25.0, 130.0, keys(k1024=3, k3076=9001), tmp_path)
    shots = read_pulsewaves(path)
    shot = shots[0]
    assert shot.is_geographic
    assert (shot.zenith, shot.azimuth) == (pytest.approx(25.0, abs=0.02), pytest.approx(130.0, abs=0.02))
    returned = shot.anchor + 702.0 * shot.direction
    np.testing.assert_allclose(returned[:2], place[:2], rtol=0, atol=1e-8)
    assert returned[2] == pytest.approx(place[2], abs=2e-3)
    np.testing.assert_array_equal(shots.anchor[0], shot.anchor)
    write_las_waveforms(tmp_path / "a.las", shots[:1])
    back = read_las_waveforms(tmp_path / "a.las")[0]
    assert back.is_geographic
    assert back.zenith == pytest.approx(25.0, abs=0.02)


def test_geocentric_pulses_of_another_datum_are_warned_of(tmp_path):
    of_etrs89 = keys(k1024=3, k2048=4258, k3076=9001)
    path = geocentric_flight((16.2, 47.7, 350.0), 25.0, 130.0, of_etrs89, tmp_path)
    with pytest.warns(UserWarning, match=r"a\.pls: pulses: the accuracy of .* to WGS 84 is 1 m"):
        read_pulsewaves(path)


def test_geocentric_pulses_that_are_not_declared_are_refused(tmp_path):
    path = geocentric_flight((16.2, 47.7, 350.0), 25.0, 130.0, None, tmp_path)
    with pytest.raises(ValueError, match=r"a\.pls: pulses: an elevation of 4\.69\d*e\+06 m"):
        read_pulsewaves(path)


def test_the_recorded_geocentric_pulses(shared):
    shot = read_pulsewaves(shared / "airborne" / "riegl_example3.pls")[0]
    assert shot.zenith == pytest.approx(7.75, abs=0.005)
    assert shot.elevation[0] == pytest.approx(351.04, abs=0.005)


def test_units_of_packets_survive_writing(tmp_path):
    shots = test_las_waveforms.small_shots()
    for metres, crs in (
        ((FOOT, FOOT, FOOT), None),
        ((1.0, 1.0, FOOT), None),
        ((1.0, 1.0, US_FOOT), "EPSG:26910+6360"),
    ):
        in_units = [
            jl.io.AirborneShot(
                shot.index,
                anchor=shot.anchor / metres,
                direction=shot.direction / metres,
                returning=shot.returning,
                metres=np.array(metres),
                gps_time=shot.gps_time,
                crs=crs,
            )
            for shot in shots
        ]
        write_las_waveforms(tmp_path / "a.las", in_units)
        for again, shot in zip(read_las_waveforms(tmp_path / "a.las"), shots, strict=True):
            np.testing.assert_allclose(again.metres, metres, rtol=1e-9)
            assert again.zenith == pytest.approx(shot.zenith, abs=1e-3)
            assert (again.crs is None) is False
        # Points of the same file are metres.
        assert read_las(tmp_path / "a.las").position[:, 2].max() < 301.0


def test_shots_of_two_systems_do_not_fit_into_one_file(tmp_path):
    one, other, *_ = test_las_waveforms.small_shots()
    with pytest.raises(ValueError, match="that of the first shot None; a file holds one"):
        write_las_waveforms(tmp_path / "a.las", [one, dataclasses.replace(other, crs="EPSG:32633")])


@pytest.mark.parametrize("case", ["garbage", "geocentric", "keys that differ on heights"])
def test_packets_of_systems_that_cannot_be_used_are_refused(tmp_path, case):
    write_las_waveforms(tmp_path / "a.las", test_las_waveforms.small_shots())
    file = laspy.read(tmp_path / "a.las")
    content, says = REFUSED[case]
    is_text = isinstance(content, str)
    content = content.encode() + b"\0" if is_text else content
    file.vlrs.append(laspy.VLR("LASF_Projection", 2112 if is_text else 34735, "", content))
    file.write(tmp_path / "b.las")
    (tmp_path / "b.wdp").write_bytes((tmp_path / "a.wdp").read_bytes())
    with pytest.raises(ValueError, match=rf"b\.las: .*{says}"):
        read_las_waveforms(tmp_path / "b.las")


# -- elevation models --------------------------------------------------------------------------------------


def declared_tiff(folder, crs, *, unit=None, scale=None, offset=None, **changes):
    path = write_tiff(folder, crs=crs, **changes)
    with rasterio.open(path, "r+") as file:
        if unit is not None:
            file.units = (unit,)
        if scale is not None:
            file.scales, file.offsets = (scale,), (offset,)
    return path


@pytest.mark.parametrize(
    ("crs", "unit", "horizontal", "vertical"),
    [
        ("EPSG:32632", None, 1.0, 1.0),
        ("EPSG:32632", "ft", 1.0, FOOT),
        ("EPSG:32632", "US survey foot", 1.0, US_FOOT),
        ("EPSG:32632", "cm", 1.0, 0.01),
        ("EPSG:26910+6360", None, 1.0, US_FOOT),
        ("EPSG:26910+5703", None, 1.0, 1.0),
        ("EPSG:2225+6360", None, US_FOOT, US_FOOT),
        ("EPSG:2225+5703", None, US_FOOT, 1.0),
        ("EPSG:2225", "us-ft", US_FOOT, US_FOOT),
        ("EPSG:2225", "metre", US_FOOT, 1.0),
        ("EPSG:2222", "ft", FOOT, FOOT),
        (UNKNOWN_UNIT_OF_HEIGHTS, "m", 1000.0, 1.0),
        (None, "ft", 1.0, FOOT),
        (None, None, 1.0, 1.0),
    ],
)
def test_elevation_models_are_read_in_metres(tmp_path, crs, unit, horizontal, vertical):
    transform = rasterio.Affine(10.0, 0.0, 6000.0, 0.0, -10.0, 5020.0)
    terrain, name, _ = read_dem(declared_tiff(tmp_path, crs, unit=unit, transform=transform))
    np.testing.assert_allclose(terrain.heights, vertical * ROWS[::-1].T, rtol=1e-6)
    np.testing.assert_allclose(terrain.spacing, [10 * horizontal] * 2, rtol=1e-6)
    np.testing.assert_allclose(terrain.origin, [6005 * horizontal, 5005 * horizontal], rtol=1e-9)
    if crs is not None:
        # The system that comes back is in metres, so that a writer takes it.
        system = system_of_name("crs", name)
        assert (system.horizontal, system.vertical) in ((1.0, None), (1.0, 1.0))
        write_raster(tmp_path / "b.tif", {"x": np.arange(4.0)}, [[0, 0], [0, 1], [1, 0], [1, 1]], crs=name)


def test_feet_in_metres_are_at_the_same_place(tmp_path):
    transform = rasterio.Affine(10.0, 0.0, 6_560_000.0, 0.0, -10.0, 1_640_000.0)
    path = declared_tiff(tmp_path, "EPSG:2225", unit="us-ft", transform=transform)
    terrain, name, _ = read_dem(path)
    with rasterio.open(path) as file:
        in_feet = file.xy(1, 0)
    expected = project("EPSG:2225", "EPSG:4269", [in_feet[0]], [in_feet[1]])
    place = project(rasterio.CRS.from_user_input(name), "EPSG:4269", *terrain.origin.reshape(2, 1).tolist())
    np.testing.assert_allclose(place, expected, rtol=0, atol=1e-8)


def test_bound_systems_in_metres_are_at_the_same_place(tmp_path):
    """A system and the shift of its datum, with heights, become metres together."""
    terrain, name, _ = read_dem(write_tiff(tmp_path), crs=BOUND_FEET)
    system = system_of_name("crs", name)
    assert (system.horizontal, system.vertical) == (1.0, 1.0)
    place = project(name, "EPSG:4326", *terrain.origin.reshape(2, 1).tolist())
    expected = project(BOUND_FEET, "EPSG:4326", [600_005.0], [5_200_005.0])
    np.testing.assert_allclose(place, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("crs", "unit", "says"),
    [
        ("EPSG:2225", None, r"x and y are in units of 0\.304801 m .* but heights have no unit"),
        (UNKNOWN_UNIT_OF_HEIGHTS, None, "x and y are in units of 1000 m .* but heights have no unit"),
        ("EPSG:26910+6360", "m", "the unit of heights is 'm' in the band, but 0.304801 m in"),
        ("EPSG:32632", "furlong", "band 1: the unit 'furlong' is not known"),
        ("EPSG:4326", None, "coordinates in degrees"),
        ("EPSG:4326+5773", None, "coordinates in degrees"),
        ("EPSG:4807", None, "coordinates in degrees"),
        ("EPSG:2048", None, "axes to the south and west"),
    ],
)
def test_elevation_models_in_other_units_are_refused(tmp_path, crs, unit, says):
    transform = rasterio.Affine(10.0, 0.0, 6000.0, 0.0, -10.0, 5020.0)
    with pytest.raises(ValueError, match=rf"dem\.tif: .*{says}"):
        read_dem(declared_tiff(tmp_path, crs, unit=unit, transform=transform))


def test_a_system_given_as_argument_replaces_the_declared_one(tmp_path):
    terrain = read_dem(declared_tiff(tmp_path, "EPSG:2225"), crs="EPSG:2225+6360").terrain
    np.testing.assert_allclose(terrain.heights, US_FOOT * ROWS[::-1].T, rtol=1e-6)
    terrain = read_dem(write_tiff(tmp_path), crs="EPSG:2225+5703").terrain
    np.testing.assert_allclose(terrain.spacing, [10 * US_FOOT] * 2, rtol=1e-6)
    np.testing.assert_allclose(terrain.heights, ROWS[::-1].T)
    with pytest.raises(ValueError, match="coordinates in degrees"):
        read_dem(write_tiff(tmp_path), crs="EPSG:4326")


def test_scale_and_offset_of_whole_numbers(tmp_path):
    """1000 counts of 0.1 m above 5 m are 105 m; counts without data are not scaled."""
    counts = np.array([[1000, 1010, -9999], [990, 980, 970]], np.int16)
    path = tmp_path / "dem.tif"
    profile = {"driver": "GTiff", "width": 3, "height": 2, "count": 1, "dtype": "int16", "nodata": -9999}
    profile |= {"crs": "EPSG:32632", "transform": rasterio.Affine(10.0, 0.0, 6e5, 0.0, -10.0, 5e6)}
    with rasterio.open(path, "w", **profile) as file:
        file.write(counts, 1)
        file.scales, file.offsets = (0.1,), (5.0,)
    terrain, _, filled = read_dem(path, fill=0.0)
    np.testing.assert_allclose(terrain.heights, [[104.0, 105.0], [103.0, 106.0], [102.0, 0.0]], rtol=1e-6)
    assert filled == 1


@pytest.mark.parametrize("dtype", ["float32", "float64", "int16"])
@pytest.mark.parametrize("number", [-9999.0, -32768.0, -32767.0, -3.4028234663852886e38])
def test_numbers_that_stand_for_no_data_undeclared(tmp_path, number, dtype):
    if dtype == "int16" and abs(number) > 40_000:
        pytest.skip("whole numbers of 16 bits do not reach it")
    rows = np.where(ROWS == 2.0, number, ROWS).astype(dtype)
    path = tmp_path / "dem.tif"
    profile = {"driver": "GTiff", "width": 3, "height": 2, "count": 1, "dtype": dtype, "crs": "EPSG:32632"}
    with rasterio.open(path, "w", transform=rasterio.Affine(10, 0, 6e5, 0, -10, 5e6), **profile) as file:
        file.write(rows, 1)
    with pytest.raises(ValueError, match="1 of 6 nodes have no data"):
        read_dem(path)
    assert read_dem(path, fill=2.0).filled == 1


@pytest.mark.parametrize("write", [write_ascii_grid, write_tiff])
@pytest.mark.parametrize(
    "number", ["-3.4e38", "-3.4028235e+38", "nan", "1e20", "-1", "3.4028234663852886e+38"]
)
def test_declared_numbers_for_no_data(tmp_path, write, number):
    declared = {"nodata": float(number)} if write is write_tiff else {"nodata_value": number}
    rows = np.where(ROWS == 2.0, float(number), ROWS)
    terrain, _, filled = read_dem(write(tmp_path, rows, **declared), fill=7.0)
    assert (filled, float(terrain.heights[1, 1])) == (1, 7.0)


def test_numbers_of_single_precision_match_the_declared_one(tmp_path):
    """Heights have the digits of single precision, and the header those of double precision."""
    rows = [["1.0", "-3.4028235e+38", "3.0"], ["4.0", "5.0", "6.5"]]
    path = write_ascii_grid(tmp_path, rows, nodata_value="-3.4028234663852886e+38")
    assert read_dem(path, fill=0.0).filled == 1


@pytest.mark.parametrize("value", [32767.0, 65535.0, 1e20, np.inf, -20_000.0])
def test_heights_that_no_terrain_has_are_refused(tmp_path, value):
    rows = np.where(ROWS == 2.0, value, ROWS)
    for write in (write_ascii_grid, write_tiff):
        with pytest.raises(ValueError, match=r"a height of .* at x = 600015, y = 5200015; admis"):
            read_dem(write(tmp_path, rows), fill=0.0)


@pytest.mark.parametrize("cell", [1 / 1200, 1 / 120, 0.01, 0.05])
def test_ascii_grids_in_degrees_are_refused(tmp_path, cell):
    path = write_ascii_grid(tmp_path, 100 * ROWS, xllcorner=-122.5, yllcorner=37.1, cellsize=cell)
    with pytest.raises(ValueError, match=r"dem\.asc: .*(in degrees; project it|cells of \[0\.00083)"):
        read_dem(path)


@pytest.mark.parametrize("cell", [0.05, 0.5, 1.0])
def test_small_plots_in_metres_are_not_taken_for_degrees(tmp_path, cell):
    rows = cell * ROWS
    terrain = read_dem(write_ascii_grid(tmp_path, rows, xllcorner=0, yllcorner=0, cellsize=cell)).terrain
    np.testing.assert_allclose(terrain.heights, rows[::-1].T, rtol=1e-6)


# ArcInfo's form, before that of well-known text.
OLD_FORM = "Projection    UTM\nZone          32\nDatum         WGS84\n"


@pytest.mark.parametrize(
    ("text", "horizontal", "vertical"),
    [
        (wkt("EPSG:32632", "WKT1_ESRI"), 1.0, 1.0),
        (wkt("EPSG:26910+6360"), 1.0, US_FOOT),
        (wkt("EPSG:2225+5703"), US_FOOT, 1.0),
        (OLD_FORM + "Units         METERS\n", 1.0, 1.0),
        (OLD_FORM + "Zunits        FEET\nUnits         METERS\n", 1.0, FOOT),
        (OLD_FORM + "Zunits        NO\nUnits         METERS\n", 1.0, 1.0),
    ],
)
def test_the_projection_beside_an_ascii_grid(tmp_path, text, horizontal, vertical):
    path = write_ascii_grid(tmp_path)
    (tmp_path / "dem.PRJ").write_text(text)
    terrain, name, _ = read_dem(path)
    np.testing.assert_allclose(terrain.heights, vertical * ROWS[::-1].T, rtol=1e-6)
    np.testing.assert_allclose(terrain.spacing, [10 * horizontal] * 2, rtol=1e-6)
    assert name is not None


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (wkt("EPSG:4326", "WKT1_ESRI"), "coordinates in degrees"),
        (wkt("EPSG:2225", "WKT1_ESRI"), "heights have no unit"),
        ("Projection    GEOGRAPHIC\nDatum         WGS84\nUnits         DD\n", "coordinates in degrees"),
        ("nonsense", "dem.prj: the coordinate reference system is not known"),
    ],
)
def test_projections_beside_an_ascii_grid_that_cannot_be_used(tmp_path, text, says):
    path = write_ascii_grid(tmp_path)
    (tmp_path / "dem.prj").write_text(text)
    with pytest.raises(ValueError, match=says):
        read_dem(path)


def test_info_of_an_elevation_model_with_an_empty_cell(tmp_path, capsys):
    for write in (write_ascii_grid, write_tiff):
        path = write(tmp_path, np.where(ROWS == 2.0, -9999.0, ROWS))
        assert cli.main(["info", str(path)]) == 0
        out = capsys.readouterr().out
        assert "terrain of 3 x 2 nodes, 10 x 10 m apart\nheights 1.00 to 6.50 m" in out
        assert "1 nodes without data" in out
        assert cli.main(["info", str(write(tmp_path, np.full((2, 3), -9999.0)))]) == 0
        assert "heights unknown" in capsys.readouterr().out


# -- other files -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "unit", "factor"),
    [
        ("elevation_bin0", "meters", 1.0),
        ("elevation_bin0", "m", 1.0),
        ("elevation_lastbin", b"feet", FOOT),
        ("altitude_instrument", "km", 1000.0),
        ("latitude_lastbin", "degrees_north", 1.0),
        ("longitude_lastbin", "radians", 180 / math.pi),
        ("local_beam_elevation", "degrees", math.pi / 180),
        ("local_beam_azimuth", "rad", 1.0),
    ],
)
def test_units_of_gedi_are_used(tmp_path, field, unit, factor):
    h5py = pytest.importorskip("h5py")
    path = test_gedi.write_small(tmp_path / "a.h5")
    expected = read_gedi_l1b(path)
    with h5py.File(path, "r+") as file:
        for beam in file.values():
            beam[f"geolocation/{field}"][:] = beam[f"geolocation/{field}"][:] / factor
            beam[f"geolocation/{field}"].attrs["units"] = unit
    for shot, usual in zip(read_gedi_l1b(path), expected, strict=True):
        for name in ("elevation", "latitude", "longitude", "altitude", "zenith", "azimuth"):
            np.testing.assert_allclose(getattr(shot, name), getattr(usual, name), rtol=1e-5)


@pytest.mark.parametrize(
    ("attribute", "value", "says"),
    [("units", "parsec", "the unit 'parsec' is not known"), ("scale_factor", 0.1, "scale_factor: counts")],
)
def test_declarations_of_gedi_that_cannot_be_used(tmp_path, attribute, value, says):
    h5py = pytest.importorskip("h5py")
    path = test_gedi.write_small(tmp_path / "a.h5")
    with h5py.File(path, "r+") as file:
        file["BEAM0001/geolocation/elevation_bin0"].attrs[attribute] = value
    with pytest.raises(ValueError, match=rf"elevation_bin0: .*{says}"):
        read_gedi_l1b(path)


def test_geocentric_elevations_of_neon_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    test_neon.write_small(path)
    arrays = dict(np.load(path))
    arrays["geo"][:, arrays["geo_cols"].tolist().index("V11")] = 4.7e6
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match=r"V11: an elevation of 4\.7e[+]06 m"):
        jl.io.read_neon(path)


TRIANGLE = "v 0 0 0\nv 2 0 0\nv 0 1 0\nf 1 2 3\n"


@pytest.mark.parametrize(
    ("comment", "metres"),
    [
        ("# File units = meters", 1.0),
        ("#units: cm", 0.01),
        ("# Unit: inches", 0.0254),
        ("# units = 0.5 m", 0.5),
        ("# units are the user's affair", 1.0),
        ("# Leaves of the beech, see the list of units: beech.txt", 1.0),
    ],
)
def test_units_of_meshes(tmp_path, comment, metres):
    path = tmp_path / "a.obj"
    path.write_text(f"{comment}\n{TRIANGLE}")
    assert read_mesh(path).mesh.area[0] == pytest.approx(metres**2)
    assert read_mesh(path, scale=3.0).mesh.area[0] == pytest.approx(9.0)


@pytest.mark.parametrize("comment", ["# units: parsec", "# units: cm\n# units: mm"])
def test_units_of_meshes_that_are_not_known(tmp_path, comment):
    path = tmp_path / "a.obj"
    path.write_text(f"{comment}\n{TRIANGLE}")
    with pytest.raises(ValueError, match=r"a\.obj: lines? 1"):
        read_mesh(path)


def test_units_of_tree_models(tmp_path):
    path = tmp_path / "a.csv"
    names = "ID,parentID,startX [cm],startY [cm],startZ [cm],endX [cm],endY [cm],endZ [cm],radius (mm)"
    path.write_text(f"{names}\n1,-1,0,0,0,0,0,200,100\n")
    tree, _ = read_qsm(path)
    assert (tree.height, tree.trunk_diameter) == (pytest.approx(2.0), pytest.approx(0.2))
    path.write_text(f"{names.replace('mm', 'span')}\n1,-1,0,0,0,0,0,200,100\n")
    with pytest.raises(ValueError, match=r"line 1: .radius \(span\).: the unit"):
        read_qsm(path)


@pytest.mark.parametrize(
    ("entry", "says"),
    [
        ("#units:ft", "units = ft; read are voxels in metres"),
        ("#unit:parsec", "is not known"),
        ("#crs:EPSG:2225", "is not in metres"),
        ("#epsg:4326", "is not in metres"),
        ("#units:m #crs:EPSG:32633", None),
    ],
)
def test_units_of_voxels(tmp_path, entry, says):
    lines = ["VOXEL SPACE", "#min_corner:(0,0,0)", "#max_corner:(1,1,2)", "#split:(1,1,2)", entry]
    lines += ["i j k PadBVTotal", "0 0 0 2.0", "0 0 1 1.5"]
    path = tmp_path / "a.vox"
    path.write_text("\n".join(lines))
    if says is None:
        assert read_vox(path).voxels.shape == (1, 1, 2)
    else:
        with pytest.raises(ValueError, match=rf"a\.vox: line 5: .*{says}"):
            read_vox(path)


@pytest.mark.parametrize(
    ("name", "metres"),
    [
        ("Metre", 1.0),
        ("feet", FOOT),
        ("US_survey_foot", US_FOOT),
        ("us-ft", US_FOOT),
        (" [ft] ", FOOT),
        ("", None),
    ],
)
def test_names_of_units(name, metres):
    assert unit_size("length", "a", name) == metres
