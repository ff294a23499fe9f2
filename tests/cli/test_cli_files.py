"""The commands `info` and `convert`: descriptions of files, and conversions."""

import contextlib
import re

import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar import cli
from tests.formats import test_gedi as test_io
from tests.formats import test_las_waveforms, test_neon, test_pulsewaves


@pytest.fixture(autouse=True)
def no_compilation_cache(monkeypatch):
    monkeypatch.setattr("jaxlidar.cli.group.compilation_cache", contextlib.nullcontext)


@pytest.mark.parametrize(
    ("name", "text", "description"),
    [
        ("a.csv", "400,0.1\n2400,0.4\n", "spectrum 'a' of 2 samples from 400 to 2400 nm"),
        ("a.toml", "[scene.ground]\nslope = 5", "scene: Scene("),
        (
            "a.asc",
            "ncols 3\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 10\n1.5 2 3\n4 5 6\n",
            "terrain of 3 x 2 nodes, 10 x 10 m apart\n"
            "heights 1.50 to 6.00 m, no coordinate reference system\n"
            "x 5.00 to 25.00 m, y 5.00 to 15.00 m",
        ),
        (
            "tree.csv",
            "ID,parentID,startX,startY,startZ,endX,endY,endZ,radius\n1,-1,0,0,0,0,0,2,0.1\n",
            "tree of 1 cylinders, 2.00 m tall",
        ),
        (
            "flight.csv",
            "GPSTime,Easting,Northing,Height,Roll,Pitch,Heading\n10,5,6,700,1,-2,90\n11,65,6,702,2,-1,90\n",
            "Trajectory of 2 times: time 10 to 11 s, x 5 to 65 m, y 6 to 6 m, z 700 to 702 m",
        ),
        (
            "world.csv",
            "GPSTime,Longitude,Latitude,Height,Roll_deg,Pitch_deg,Heading\n10,12,52,700,1,-2,90\n",
            "trajectory by longitude and latitude, or with a true heading: ",
        ),
        (
            "trees.csv",
            "tree,species,x,y,height,dbh_cm\n1,beech,2.5,7,21.4,35\n2,oak,8,3,18,\n3,oak,9,3,16,20\n",
            "inventory of 3 trees: x 2.50 to 9.00 m, y 3.00 to 7.00 m\n"
            "diameter: 0.2 to 0.35 m, 1 without\nheight: 16 to 21.4 m\nspecies: 1 beech, 2 oak\n"
            "columns: species, x, y, height, dbh_cm as diameter; not read: tree\n",
        ),
        (
            "plot.csv",
            "Easting;Northing;Ht [m]\n400000;5300000;12\n",
            "inventory of 1 trees: x 400000.00 to 400000.00 m, y 5300000.00 to 5300000.00 m\n"
            "height: 12 to 12 m\ncolumns: Easting as x, Northing as y, Ht [m] as height\n",
        ),
        (
            "shots.csv",
            "Easting,Northing,id\n500010.5,5500020,7\n500070,5500020,8\n",
            "places of 2 footprints: x 500010.50 to 500070.00 m, y 5500020.00 to 5500020.00 m\n",
        ),
        (
            "shots.csv",
            "shot_number,beam,lat,lon,height,time\n7,BEAM0011,50,15,12,3.5\n8,BEAM0000,50.5,14.5,13,4.5\n",
            "places of 2 footprints: longitude 14.50000 to 15.00000 degrees, "
            "latitude 50.00000 to 50.50000 degrees, beams BEAM0000, BEAM0011\n",
        ),
        (
            "leaf.csv",
            "wavelength,controlled reflectance\n400,0.1\n500,0.2\n",
            "spectrum 'leaf' of 2 samples from 400 to 500 nm",
        ),
        (
            "a.obj",
            "v 0 0 0\nv 2 0 1\nv 0 1 0\nusemtl leaf\nf 1 2 3\nf 1 1 2\n",
            "1 triangles: x 0.00 to 2.00 m, y 0.00 to 1.00 m, z 0.00 to 1.00 m\nleaf: 1.118 m2\n"
            "1 triangles left out: without an area",
        ),
        (
            "a.vox",
            "VOXEL SPACE\n#min_corner:(0,0,0)\n#max_corner:(1,1,2)\n#split:(1,1,2)\n"
            "i j k PadBVTotal\n0 0 0 NaN\n0 0 1 1.5\n",
            "1 x 1 x 2 voxels of 1 x 1 x 1 m from (0, 0, 0) m\nleaf: 1.5 m2\n1 voxels without a density",
        ),
    ],
)
def test_info_describes_text_files(name, text, description, tmp_path, capsys):
    (tmp_path / name).write_text(text)
    assert cli.main(["info", str(tmp_path / name)]) == 0
    assert capsys.readouterr().out.startswith(description)
    if name == "a.vox":
        assert cli.main(["convert", str(tmp_path / name), str(tmp_path / "b.toml")]) == 0
        assert "taken as empty: 1 voxels without a density" in capsys.readouterr().err
        assert jl.io.read_case(tmp_path / "b.toml").scene.canopy.voxels.shape == (1, 1, 2)


def test_info_of_recorded_waveforms(tmp_path, capsys):
    for path, content in zip(("a.pls", "a.wvs"), test_pulsewaves.small_files()):
        (tmp_path / path).write_bytes(content)
    test_las_waveforms.small_files(tmp_path)
    test_neon.write_small(tmp_path / "a.npz")
    test_io.write_small(tmp_path / "a.h5")
    for name, description in {
        "a.pls": r"3 airborne shots, GPS times 400000\.0+ to 400002\.0+ s\nscanner a scanner, 1064\.0 nm\n"
        r"5 to 5 samples of 1 ns in up to 2 segments, with outgoing pulses\nzenith 8\.6 to 8\.6 degrees",
        "small.las": r"7 points: x .*\npoint format \d; returns: .*\n"
        r"4 airborne shots, .*\n10 to 40 samples of 1 ns in up to 2 segments, ",
        "a.npz": r"3 airborne shots\n50 to 65 samples of 1 ns in up to 2 segments, with outgoing pulses\n",
        "a.h5": r"\d+ GEDI shots of BEAM\d+.*\nlatitude ",
    }.items():
        assert cli.main(["info", str(tmp_path / name)]) == 0
        out = capsys.readouterr().out
        assert re.match(description, out), out


@pytest.mark.slow
def test_airborne_waveforms_become_packets(shared, tmp_path, capsys):
    source, target = shared / "airborne" / "lvis_example2.pls", tmp_path / "b.las"
    assert cli.main(["convert", str(source), str(target)]) == 0
    assert "left out: outgoing pulses" in capsys.readouterr().err
    original, converted = jl.io.read_pulsewaves(source), jl.io.read_las_waveforms(target)
    assert len(converted) == len(original) > 0
    for before, after in zip(original[:100], converted[:100]):
        assert np.array_equal(before.waveform, after.waveform)
        assert np.allclose(before.elevation, after.elevation, atol=2e-3)


def test_shots_that_packets_cannot_hold_are_refused(tmp_path, capsys):
    for path, content in zip(("a.pls", "a.wvs"), test_pulsewaves.small_files()):
        (tmp_path / path).write_bytes(content)
    assert cli.main(["convert", str(tmp_path / "a.pls"), str(tmp_path / "b.las")]) == 1
    assert "shot 1: segments of the channels [0, 1]" in capsys.readouterr().err
    assert not (tmp_path / "b.las").exists()
