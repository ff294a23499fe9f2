"""Footprints over airborne clouds: places from files, the command from end to end, and the GEDI simulator."""

import jax
import numpy as np
import pytest

import jaxlidar as jl
from inversion import commands, footprints
from inversion.metrics.gedi_simulator import link_margin_noise
from jaxlidar.cli.constants import INTERRUPTED, SUCCESS
from jaxlidar.formats.footprints import read_places
from jaxlidar.io import FileWarning, read_gedi_l1b, write_gedi_l1b, write_las
from tests.fuzz.fuzz_changes import change_text

pytest.importorskip("laspy")
pytest.importorskip("h5netcdf")
h5py = pytest.importorskip("h5py")
pytest.importorskip("pyproj")

CRS = "EPSG:32633"
# West and south of the cloud, m.
EAST, NORTH = 500_000.0, 5_500_000.0


# -- places ------------------------------------------------------------------------------------------------


def places_of(tmp_path, text):
    path = tmp_path / "places.csv"
    path.write_text(text)
    return read_places(path, CRS)


def test_places_are_read_from_maps_and_from_longitude_and_latitude(tmp_path):
    places = places_of(tmp_path, "beam;Easting;NORTH;id\nbeam0000;500010.5;5500020;19640119100108615\n")
    assert places.position.tolist() == [[500010.5, 5500020.0]]
    assert places.shot_number.tolist() == [19640119100108615]
    assert places.beam.tolist() == ["BEAM0000"]
    # The central meridian of the zone.
    places = places_of(tmp_path, "lat,lon\n50.0,15.0\n\n51.0,15.0\n")
    np.testing.assert_allclose(places.position[:, 0], 5e5, atol=1e-3)
    assert np.diff(places.position[:, 1]) == pytest.approx(111_200.0, abs=100.0)
    assert places.shot_number.tolist() == [1, 2]
    assert set(places.beam) == {"BEAM0101"}
    # An id is that of something else where the shots have numbers.
    places = places_of(tmp_path, "id,shot_number,x,y\n1,19640119100108615,2,3\n2,9223372036854775807,2,4\n")
    assert places.shot_number.tolist() == [19640119100108615, 2**63 - 1]
    assert places_of(tmp_path, "x,y,Shot Number\n1,2,7\n").shot_number.tolist() == [7]
    # Units of names.
    assert places_of(tmp_path, "x [km],y_ft\n1,1000\n").position.tolist() == [[1000.0, 304.8]]
    with pytest.warns(
        UserWarning, match=r"places.csv: line 1: columns are not read: 'shot_no' \(as shotnumber"
    ):
        places_of(tmp_path, "x,y,shot_no\n1,2,7\n")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: there is no line that names"),
        ("x,z\n1,2\n", "line 1: no column y; .* there are x, z"),
        ("x,y\n", "line 2: no footprint"),
        ("x,y\n1,2\n3\n", "line 3: 1 values; the header names 2"),
        ("x,y\n1,2\n3,north\n", "line 3: y = 'north' is no number"),
        ("x,y\n1,nan\n", "line 2: y = nan; admissible"),
        ("x [s],y\n1,2\n", r"line 1: 'x \[s\]': the unit 's' is not known; known are m, metre"),
        ("lon,lat\n15,91\n", "line 2: latitude = 91; admissible is"),
        ("lon,lat\n15,50\n-75,0\n", "line 3: longitude -75 and latitude 0 lie outside"),
        ("x,y,id\n1,2,3.5\n", "line 2: shot_number = '3.5' is no whole number"),
        ("x,y,id\n1,2,7\n3,4,7\n", "line 3: shot_number = 7 is that of line 2"),
        ("x,y,id\n1,2,1\n\n3,4,01\n", "line 4: shot_number = 1 is that of line 2, too"),
        ("x,y,id\n1,2,-1\n", "line 2: shot_number = '-1' is no whole number from 0 on"),
        (
            "x,y,id\n1,2,18446744073709551615\n",
            "line 2: shot_number = 18446744073709551615 is too large; admissible is .0, 9223372036854775807.",
        ),
        ("x,y,x\n1,2,3\n", "line 1: x may be any of the columns 'x', 'x'; remove or rename all but one"),
        ("Easting,y,x\n1,2,3\n", "line 1: x may be any of the columns 'Easting', 'x'"),
        ("x,y,shot,shot_number\n1,2,3,4\n", "line 1: shot_number may be any of the columns 'shot', 'shot_n"),
        ("x,y,Lon,lat\n1,2,15,50\n", "line 1: columns 'x' and 'y' of a map, and 'Lon' and 'lat' in degrees"),
        ("x,lat\n1,2\n", "line 1: columns 'x' of a map, and 'lat' in degrees; remove one pair"),
        ("x,y,beam\n1,2,BEAM0111\n", "line 2: beam = 'BEAM0111' is none of BEAM0000"),
    ],
)
def test_bad_places_are_refused_with_file_and_line(tmp_path, text, message):
    with pytest.raises(ValueError, match=f"places.csv: {message}"):
        places_of(tmp_path, text)


def test_mutants_of_tables_are_read_or_refused(tmp_path):
    table = b"x,y,shot_number,beam\n500010.5,5500020,7,BEAM0000\n500070.5,5500080,8,BEAM0101\n"
    path, random, messages = tmp_path / "places.csv", np.random.default_rng(0), []
    for _ in range(300):
        path.write_bytes(change_text(random, table)[0])
        try:
            places = read_places(path, CRS)
        except (ValueError, UserWarning) as error:
            messages.append(str(error))
            continue
        assert np.isfinite(places.position).all()
        assert len(set(places.shot_number.tolist())) == len(places.position) == len(places.beam)
    assert 50 < len(messages) < 290
    assert all(message.startswith(f"{path}: ") and "line " in message for message in messages)


def test_places_are_read_from_products(tmp_path):
    lidar = jl.instrument("GEDI power")
    survey = jl.Survey(lidar, [(EAST, NORTH), (EAST + 60.0, NORTH)], crs=CRS)
    many = jl.simulate_many(survey, jl.Scene(ground=jl.Ground()), key=jax.random.key(0), max_orders=1)
    write_gedi_l1b(tmp_path / "l1b.h5", many, survey, beam=["BEAM1011", "BEAM0000"], shot_number=[7, 9])
    places = read_places(tmp_path / "l1b.h5", CRS)
    assert places.shot_number.tolist() == [9, 7]
    assert places.beam.tolist() == ["BEAM0000", "BEAM1011"]
    np.testing.assert_allclose(places.position[::-1], survey.position, atol=0.02)
    # Level 2A has the place of the lowest mode; a shot without one has a fill value.
    with h5py.File(tmp_path / "l2a.h5", "w") as file:
        file["BEAM0101/shot_number"] = np.array([4, 5], np.uint64)
        file["BEAM0101/lon_lowestmode"], file["BEAM0101/lat_lowestmode"] = [15.0, -9999.0], [50.0, -9999.0]
    skipped = "l2a.h5: /BEAM0101/lon_lowestmode, shot 5: longitude -9999 .*: 1 of 2 shots of BEAM0101 skipped"
    with pytest.warns(FileWarning, match=skipped):
        places = read_places(tmp_path / "l2a.h5", CRS)
    assert places.shot_number.tolist() == [4]
    assert places.position[0, 0] == pytest.approx(5e5, abs=1e-3)
    for name, numbers, longitude in (("none", [], []), ("unplaced", [4, 5], [np.nan, -9999.0])):
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            file["BEAM0101/shot_number"] = np.array(numbers, np.uint64)
            file["BEAM0101/lon_lowestmode"] = file["BEAM0101/lat_lowestmode"] = np.array(longitude, float)
        with pytest.raises(ValueError, match=f"{name}.h5: no shot has a place; admissible"):
            read_places(tmp_path / f"{name}.h5", CRS)
    with h5py.File(tmp_path / "twice.h5", "w") as file:
        for beam, numbers in (("BEAM0000", [7, 8]), ("BEAM0101", [9, 7])):
            file[f"{beam}/shot_number"] = np.array(numbers, np.uint64)
            file[f"{beam}/lon_lowestmode"], file[f"{beam}/lat_lowestmode"] = [15.0, 15.0], [50.0, 50.0]
    twice = r"twice.h5: /BEAM0101/shot_number\[1\] = 7 is that of .*twice.h5: /BEAM0000/shot_number\[0\], too"
    with pytest.raises(ValueError, match=twice):
        read_places(tmp_path / "twice.h5", CRS)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["BEAM0101/shot_number"] = np.array([4], np.uint64)
    with pytest.raises(ValueError, match=r"other.h5: /BEAM0101: no longitude"):
        read_places(tmp_path / "other.h5", CRS)


# -- the command -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    """Write a cloud of 120 m: plants of 10 m on a slope to the east, which is 1 m in 10."""
    random, count = np.random.default_rng(0), 40_000
    x, y = random.uniform(0.0, 120.0, (2, count))
    is_plant = random.uniform(size=count) < 0.5
    z = 100.0 + 0.1 * x + np.where(is_plant, random.uniform(6.0, 10.0, count), 0.0)
    path = tmp_path_factory.mktemp("cloud") / "cloud.laz"
    position = np.column_stack([EAST + x, NORTH + y, z])
    write_las(path, position, classification=np.where(is_plant, 5, 2), crs=CRS)
    return path


PLACES = (
    f"x,y,id\n{EAST + 60},{NORTH + 60},11\n{EAST + 1000},{NORTH + 60},12\n{EAST + 124.5},{NORTH + 60},13\n"
)


def run(tmp_path, cloud, *options, places=PLACES):
    """Run the command; return the exit status, the shots and the table as rows of texts by column."""
    (tmp_path / "shots.csv").write_text(places)
    arguments = [str(cloud), str(tmp_path / "shots.csv"), "-o", str(tmp_path / "l1b.h5"), "--quiet", *options]
    status = commands.footprints.main(arguments, standalone_mode=False)
    if status != SUCCESS:
        return status, [], {}
    header, *rows = [line.split(",") for line in (tmp_path / "l1b.csv").read_text().splitlines()]
    columns = {name: [row[i] for row in rows] for i, name in enumerate(header)}
    return status, read_gedi_l1b(tmp_path / "l1b.h5"), columns


def test_footprints_become_a_file_and_a_table(tmp_path, cloud, capsys, monkeypatch):
    simulate, calls = footprints.jl.simulate_tiles, []

    def interrupted(*arguments, **options):
        parts = simulate(*arguments, **options)
        calls.append([path.stat().st_mtime_ns for path in (tmp_path / "l1b.h5.tiles").iterdir()])
        if len(calls) == 1:
            raise KeyboardInterrupt
        return parts

    monkeypatch.setattr(footprints.jl, "simulate_tiles", interrupted)
    status, _, _ = run(tmp_path, cloud, "--link-margin", "3", "--seed", "1")
    assert status == INTERRUPTED
    assert "the same command continues" in capsys.readouterr().err
    assert not (tmp_path / "l1b.h5").exists()
    status, shots, table = run(tmp_path, cloud, "--link-margin", "3", "--seed", "1")
    # The tiles of the interrupted run were used, and are not needed any more.
    assert calls[0] == calls[1]
    assert not (tmp_path / "l1b.h5.tiles").exists()
    # The same command may write its own table again.
    commands._check_default_table(tmp_path / "l1b.csv")
    output = capsys.readouterr().out
    assert "3 footprints: 2 bad, 1 good" in output
    assert "outside of all files of points: 1 footprints, 12" in output

    assert [shot.shot_number for shot in shots] == [11, 13]
    assert table["shot_number"] == ["11", "12", "13"]
    assert table["reasons"][0] == ""
    assert table["reasons"][1] == "outside of all files of points"
    assert table["reasons"][2].startswith("returns below")
    numbers = {
        name: float(table[name][0]) for name in table if table[name][0] not in ("", "good", "BEAM0101")
    }
    assert numbers["covered"] == pytest.approx(1.0, abs=0.01)
    assert numbers["true ground"] == pytest.approx(106.0, abs=0.2)
    assert numbers["ALS cover"] == pytest.approx(0.5 / (0.5 + 0.57 / 0.4 * 0.5), abs=0.03)
    assert numbers["ground"] == pytest.approx(106.0, abs=0.4)
    assert numbers["rhReal_75"] == pytest.approx(8.0, abs=0.4)
    # Ripples of noise below the ground move these.
    for ground in ("gHeight", "maxGround", "inflGround"):
        assert numbers[ground] == pytest.approx(106.0, abs=2.0)
    for height in ("rhGauss_75", "rhMax_75", "rhInfl_75"):
        assert numbers[height] == pytest.approx(8.0, abs=2.5)
    # The column of the package, beside the simulator's.
    assert {"cover", "cover_jaxlidar", "rh_98", "FHD", "blairSense"} < set(numbers)
    assert numbers["linkM"] == 3.0
    # Noise is that of the link margin, relative to the energy of the whole footprint.
    lidar = jl.instrument("GEDI power")
    pulse = 0.5 * jl.SPEED_OF_LIGHT * float(lidar.pulse.std)
    footprint = 0.5 * float(jl.Survey(lidar, [(0.0, 0.0)]).footprint_radius[0])
    sigma = link_margin_noise(3.0, 0.95, pulse, footprint)
    energy = shots[0].signal.sum() * 0.5 * jl.SPEED_OF_LIGHT
    assert shots[0].noise_std == pytest.approx(sigma * energy, rel=0.05)
    # The product smooths it: 0.41 of it is left.
    assert shots[0].signal[:190].std() == pytest.approx(0.41 * shots[0].noise_std, rel=0.25)


def test_errors_of_geolocation_leave_the_stated_places(tmp_path, cloud):
    places = f"x,y,beam\n{EAST + 55},{NORTH + 60},BEAM0000\n{EAST + 55},{NORTH + 65},BEAM0000\n"
    options = ("--geolocation-error", "8", "--seed", "2")
    _, shots, table = run(tmp_path, cloud, *options, places=places)
    assert table["x"] == [f"{EAST + 55}"] * 2
    shift = np.array([[float(table[f"true_{a}"][i]) - float(table[a][i]) for a in "xy"] for i in range(2)])
    # One error for a beam.
    np.testing.assert_allclose(shift[0], shift[1], atol=1e-6)
    assert 2.0 < np.abs(shift[0, 0]) < 30.0
    # Light fell on the true place, whose ground is that of the slope.
    assert float(table["true ground"][0]) == pytest.approx(105.5 + 0.1 * shift[0, 0], abs=0.2)
    stated = read_places(tmp_path / "l1b.h5", CRS).position
    np.testing.assert_allclose(stated, [[EAST + 55, NORTH + 60], [EAST + 55, NORTH + 65]], atol=0.02)
    # Without noise the record is quiet, states no noise, and nothing is judged by it or made up from it.
    assert shots[0].signal[:100].std() == shots[0].noise_std == 0.0
    assert table["quality"] == ["good"] * 2, table["reasons"]
    assert table["blairSense"] == table["sensitivity"] == [""] * 2
    assert all(len(table[name][0]) > 0 for name in ("gHeight", "cover", "ground", "cover_jaxlidar", "rh_98"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cloud", "-o", "o.h5"], "0 of places; admissible"),
        (["places", "-o", "o.h5"], "0 files of points"),
        (["cloud", "places", "places", "-o", "o.h5"], "2 of places"),
        (["cloud", "places", "-o", "o.nc"], "does not end in .h5"),
        (["cloud", "places", "-o", "o.h5", "--table", "t.txt"], "ends in none of .csv"),
        (["cloud", "places", "-o", "places.h5"], "places.csv would be overwritten"),
        (["cloud", "places", "-o", "o.h5", "--instrument", "GEDY"], "instrument 'GEDY' is not known"),
        (["cloud", "places", "-o", "o.h5", "--workers", "0"], "'0'; admissible are a number of processes"),
        (
            ["cloud", "places", "-o", "o.h5", "--workers", "foo"],
            "'foo'; admissible .* tcp://192.168.0.1:8786",
        ),
        (["cloud", "places", "-o", "o.h5", "--workers", "-1"], "'-1'; admissible are a number of processes"),
        (["cloud", "places", "-o", "o.h5", "--link-cover", "1"], "is not in the range"),
    ],
)
def test_wrong_usage_is_refused(tmp_path, cloud, arguments, message, monkeypatch):
    click = pytest.importorskip("click")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "places.csv").write_text(PLACES)
    names = {"cloud": str(cloud), "places": "places.csv"}
    with pytest.raises(click.UsageError, match=message):
        commands.footprints.main([names.get(a, a) for a in arguments], standalone_mode=False)


def test_a_folder_and_a_table_that_are_not_the_commands_own_stay(tmp_path, cloud, monkeypatch):
    click = pytest.importorskip("click")
    folder = tmp_path / "l1b.h5.tiles"
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"l1b.h5.tiles has 'notes.txt', which is no tile; admissible"):
        run(tmp_path, cloud)
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]
    (folder / "notes.txt").unlink()
    (tmp_path / "l1b.csv").write_text("x,y\n1,2\n")
    with pytest.raises(click.BadParameter, match=r"l1b.csv is there already and no table of footprints"):
        run(tmp_path, cloud)
    assert (tmp_path / "l1b.csv").read_text() == "x,y\n1,2\n"
    (tmp_path / "l1b.csv").unlink()
    # An empty folder of the user stays, with files that appear in it; the command's own tiles go.
    tile = folder / f"tile_{'0a' * 16}.nc"

    def simulated(*arguments, **options):
        for path in (tile, folder / "notes.txt"):
            path.touch()
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "simulate_footprints", simulated)
    assert run(tmp_path, cloud)[0] == INTERRUPTED
    commands.remove_tiles(folder)
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]


def test_a_run_that_is_refused_leaves_no_folder(tmp_path, cloud, capsys, monkeypatch):
    with pytest.raises(ValueError, match="no shot lies within"):
        run(tmp_path, cloud, places="x,y\n1,2\n")
    assert not (tmp_path / "l1b.h5.tiles").exists()

    def interrupted(clouds, places, out, folder, **options):
        folder.mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "simulate_footprints", interrupted)
    assert run(tmp_path, cloud)[0] == INTERRUPTED
    assert "no tile was finished" in capsys.readouterr().err
    assert not (tmp_path / "l1b.h5.tiles").exists()


def test_files_without_a_system_and_footprints_off_all_of_them_are_refused(tmp_path, cloud):
    with pytest.raises(ValueError, match=r"shots.csv: no shot lies within the extent of a file"):
        run(tmp_path, cloud, places="x,y\n1,2\n")
    bare = tmp_path / "bare.las"
    write_las(bare, np.array([[EAST, NORTH, 0.0], [EAST + 9.0, NORTH + 9.0, 0.0]]))
    with pytest.raises(ValueError, match=r"bare.las: no coordinate reference system .* \(--crs\)"):
        run(tmp_path, bare)


def test_a_link_margin_is_a_number(tmp_path, cloud):
    with pytest.raises(ValueError, match="link_margin = nan"):
        run(tmp_path, cloud, "--link-margin", "nan")


@pytest.mark.parametrize("address", ["foo:", "tcp://foo", "nonsense://foo:1"])
def test_addresses_that_are_none_are_refused(tmp_path, cloud, address):
    click = pytest.importorskip("click")
    pytest.importorskip("distributed")
    with pytest.raises(
        click.BadParameter, match=f"'{address}'; admissible are a number of processes"
    ) as info:
        run(tmp_path, cloud, "--workers", address)
    assert info.value.param_hint == "--workers"


def test_a_scheduler_of_dask_needs_dask(tmp_path, cloud, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(ImportError, match=r"jaxlidar\[cluster\]"):
        run(tmp_path, cloud, "--workers", "tcp://127.0.0.1:1")


@pytest.mark.slow
# Warnings of Dask itself.
@pytest.mark.filterwarnings("ignore::DeprecationWarning:(distributed|dask|tornado|zict).*")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_scheduler_of_dask_writes_what_one_process_does(tmp_path, cloud):
    distributed = pytest.importorskip("distributed")
    # In two tiles.
    places = f"x,y\n{EAST + 60},{NORTH + 60}\n{EAST + 110},{NORTH + 60}\n"
    _, expected, table = run(tmp_path, cloud, "--link-margin", "3", places=places)
    quiet = {"dashboard_address": None, "silence_logs": "CRITICAL"}
    # Threads of this process compile nothing twice; what they are sent is pickled all the same.
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, protocol="tcp", **quiet
    ) as cluster:
        options = ("--link-margin", "3", "--workers", cluster.scheduler_address)
        _, shots, other_table = run(tmp_path, cloud, *options, places=places)
    assert table == other_table
    for shot, other in zip(expected, shots, strict=True):
        assert shot.shot_number == other.shot_number
        np.testing.assert_array_equal(shot.signal, other.signal)
