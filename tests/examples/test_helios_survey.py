"""The example reads small surveys of HELIOS++, and says what it does not map."""

import importlib.util
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

import jaxlidar as jl
from tests.fuzz.fuzz_changes import WORDS, change_text, choose

PATH = Path(__file__).resolve().parents[2] / "examples" / "helios_survey.py"
SQUARE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nf 1 2 3 4\n"
SCANNERS = """<document>
<scanner id="tripod" optics="rotating" beamDivergence_rad="0.0004" pulseFreqs_Hz="1000" pulseLength_ns="5"
 scanAngleMax_deg="120" scanAngleEffectiveMax_deg="50" wavelength_nm="1550">
 <beamOrigin x="0" y="0" z="0.2"/></scanner>
<scanner id="swing" optics="oscillating" pulseFreqs_Hz="100" scanAngleMax_deg="20"/>
<scanner id="cone" optics="conic" pulseFreqs_Hz="100" scanAngleMax_deg="20" scanFreqMax_Hz="5"/>
<scanner id="prisms" optics="risley" pulseFreqs_Hz="100" angle1_deg="10" angle2_deg="-10" rotorFreq1_Hz="3"
 rotorFreq2_Hz="-5" refrIndex1="1.5" refrIndex2="1.5"/>
<scanner id="odd" optics="fiberarray" pulseFreqs_Hz="100"/>
</document>"""
PLATFORMS = """<document>
<platform id="tripod" type="static"><scannerMount x="0" y="0" z="1.5"/></platform>
<platform id="plane" type="linearpath"><scannerMount z="0.7"><rot axis="x" angle_deg="-90"/>
 <rot axis="z" angle_deg="90"/></scannerMount></platform>
<platform id="ahead" type="linearpath"/>
</document>"""
GROUND = (
    '<part><filter type="objloader"><param type="string" key="filepath" value="square.obj"/></filter>'
    '<filter type="scale"><param type="double" key="scale" value="50"/></filter></part>'
)
WALL = """<part><filter type="objloader"><param key="filepath" value="square.obj"/></filter>
<filter type="rotate"><param key="rotation" type="rotation"><rot axis="x" angle_deg="90"/></param></filter>
<filter type="translate"><param key="offset" value="0;10;1"/></filter>
<filter type="scale"><param key="scale" value="2"/></filter></part>"""
TURN = """<leg><platformSettings x="0" y="0" onGround="true"/><scannerSettings template="set"
 headRotateStart_deg="-30" headRotateStop_deg="30" headRotatePerSec_deg="60"/></leg>"""
FLY = """<leg><platformSettings x="-5" y="0" z="{z}" movePerSec_m="10"/><scannerSettings scanAngle_deg="15"
 scanFreq_hz="2"/></leg><leg><platformSettings x="5" y="0" z="{z}"/><scannerSettings active="false"/></leg>"""


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("helios_survey", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def make(tmp_path):
    """Write a survey with its scene, scanners and platforms, and return its path."""

    def write(legs, parts=GROUND + WALL, platform="tripod", scanner="tripod", root="", survey=""):
        (tmp_path / "data").mkdir(exist_ok=True)
        files = {
            "scene": f'<document><scene id="s">{parts}</scene></document>',
            "scanners": SCANNERS,
            "platforms": PLATFORMS,
        }
        for name, text in files.items():
            (tmp_path / "data" / f"{name}.xml").write_text(text)
        (tmp_path / "square.obj").write_text(SQUARE)
        path = tmp_path / "data" / "survey.xml"
        path.write_text(
            f'<document>{root}<survey scene="data/scene.xml#s" platform="data/platforms.xml#{platform}" '
            f'scanner="data/scanners.xml#{scanner}">{survey}{legs}</survey></document>'
        )
        return path

    return write


SET = '<scannerSettings id="set" pulseFreq_hz="1000" scanFreq_hz="5" scanAngle_deg="{}"/>'


def test_a_tripod_turns_between_its_stops(example, make):
    path = make(TURN, root='<scannerSettings id="set" pulseFreq_hz="1000" scanFreq_hz="5"/>')
    survey, scene, unmapped = example.read_survey(path)
    # On the ground, on the tripod, and above its head.
    np.testing.assert_allclose(survey.sensor, np.tile([0.0, 0.0, 1.7], (len(survey), 1)), atol=1e-12)
    # Heads turn anticlockwise, azimuths clockwise; lines reach 50 degrees below and above the horizon.
    azimuth = (survey.azimuth + 180.0) % 360.0 - 180.0
    np.testing.assert_allclose([azimuth.min(), azimuth.max()], [-30.0, 30.0], atol=0.1)
    assert azimuth[0] > 29.0
    np.testing.assert_allclose([survey.zenith.min(), survey.zenith.max()], [40.0, 140.0], atol=1.3)
    # Of a turn of 240 degrees, pulses leave over 100.
    assert len(survey) == pytest.approx(1000 * 100 / 240, abs=3)
    assert float(survey.lidar.divergence) == pytest.approx(0.4)
    assert float(survey.lidar.wavelength[0]) == 1550.0
    ground, wall = (mesh.corners() for mesh in scene.meshes)
    np.testing.assert_allclose(
        [ground.min(axis=(0, 1)), ground.max(axis=(0, 1))], [(-50, -50, 0), (50, 50, 0)]
    )
    np.testing.assert_allclose(
        [wall.min(axis=(0, 1)), wall.max(axis=(0, 1))], [(-2, 10, -1), (2, 10, 3)], atol=1e-6
    )
    assert unmapped == ("materials: the reflectance of all parts is 0.4",)


@pytest.mark.parametrize("scanner", ["swing", "cone", "prisms"])
def test_a_plane_looks_down_and_scans_across_its_track(example, make, scanner):
    platform = "ahead" if scanner == "prisms" else "plane"
    survey, _, _ = example.read_survey(make(FLY.format(z=100), platform=platform, scanner=scanner))
    time = survey.gps_time - survey.gps_time[0]
    np.testing.assert_allclose(survey.sensor[:, 0], -5.0 + 10.0 * time, atol=1e-9)
    east, north, up = survey.direction.T
    if scanner == "swing":
        # Heading east, a triangle wave of 15 degrees across: no motion along the track.
        angle = np.rad2deg(np.arctan2(north, -up))
        wave = 2.0 / np.pi * np.arcsin(np.sin(2 * np.pi * 2.0 * time))
        np.testing.assert_allclose(np.abs(angle), np.abs(15.0 * wave), atol=1e-6)
        np.testing.assert_allclose(east, 0.0, atol=1e-12)
        np.testing.assert_allclose(survey.sensor[:, 2], 100.7)
    elif scanner == "cone":
        np.testing.assert_allclose(survey.zenith, 15.0, atol=1e-9)
    else:
        # Without a mount the beam looks ahead, to the east.
        expected = jl.Risley((10.0, -10.0), (3.0, -5.0), 1.5).direction(time)
        np.testing.assert_allclose(east, expected[:, 2], atol=1e-9)


def test_angular_resolutions_make_a_raster(example, make):
    settings = 'verticalResolution_deg="2" horizontalResolution_deg="3" pulseFreq_hz="1000"'
    leg = (
        f'<leg><platformSettings onGround="true"/><scannerSettings {settings} headRotateStop_deg="30"/></leg>'
    )
    survey, _, _ = example.read_survey(make(leg))
    line = np.abs(np.diff(survey.zenith))
    np.testing.assert_allclose(np.median(line), 2.0, atol=1e-6)
    # Ten lines of 240 degrees each, 3 degrees apart.
    assert (line > 50).sum() == 10


def test_voxels_and_points_are_cubes_or_turbid(example, make, tmp_path):
    head = "VOXEL SPACE\n#min_corner: 0 0 5\n#max_corner: 2 1 6\n#split: 2 1 1\n#res: 1\n"
    (tmp_path / "a.vox").write_text(head + "i j k PadBVTotal angleMean\n0 0 0 1.5 0\n1 0 0 0 0\n")
    (tmp_path / "b.xyz").write_text("// x y z\n0.2 0.3 0.4\n0.4 0.1 0.2\n2.5 0.5 0.5\n")
    vox = (
        '<part><filter type="detailedvoxels"><param key="filepath" value="a.vox"/>{}</filter>'
        '<filter type="translate"><param key="offset" value="1;2;3"/></filter></part>'
    )
    xyz = (
        '<part><filter type="xyzloader"><param key="filepath" value="b.xyz"/>'
        '<param key="voxelSize" value="1"/></filter></part>'
    )
    fixed = '<param key="intersectionMode" value="fixed"/>'
    path = make(FLY.format(z=100), GROUND + vox.format("") + vox.format(fixed) + xyz, "plane", "cone")
    _, scene, unmapped = example.read_survey(path)
    np.testing.assert_allclose(np.asarray(scene.canopy.voxels.origin), [1.0, 2.0, 8.0])
    assert 2.0 * float(scene.canopy.voxels.leaf.sum()) == pytest.approx(1.5)
    _, cubes, points = scene.meshes
    assert [cubes.n_triangles, points.n_triangles] == [24, 24]
    np.testing.assert_allclose(cubes.bounds()[0], [(1, 2, 8), (3, 3, 9)], atol=1e-5)
    np.testing.assert_allclose(points.bounds()[0], [(0, 0, 0), (3, 1, 1)], atol=1e-5)
    assert [set(m.instance.tolist()) for m in scene.meshes] == [{1}, {3}, {4}]
    assert len(unmapped) == 1


def test_what_is_not_mapped_is_named(example, make):
    odd = (
        '<part><filter type="objloader"><param key="filepath" value="lost.obj"/></filter></part>'
        '<part><filter type="sieve"/></part>'
        '<part><filter type="objloader"><param key="filepath" value="square.obj"/></filter><dmotion/></part>'
    )
    path = make(FLY.format(z=100), odd, "plane", "cone", survey='<FWFSettings binSize_ns="0.2"/>')
    _, _, unmapped = example.read_survey(path)
    text = "\n".join(unmapped)
    for word in ("'lost.obj', whose file is missing", "filter 'sieve'", "'dmotion' of a part", "FWFSettings"):
        assert word in text


@pytest.mark.parametrize(
    ("legs", "options", "message"),
    [
        ("", {}, "has no leg that scans"),
        (FLY.format(z="high"), {"platform": "plane"}, "z = 'high'; admissible is a number"),
        (
            FLY.format(z=9),
            {"platform": "plane", "scanner": "odd"},
            "optics = 'fiberarray'; admissible are rotating",
        ),
        (FLY.format(z=9), {"platform": "boat"}, "no platform with id = 'boat'"),
        ('<leg><platformSettings trajectory="a.trj"/></leg>', {}, "admissible are legs"),
        ("<leg>", {}, "no XML"),
        (FLY.format(z=9), {"parts": GROUND.replace('"50"', '"wide"'), "platform": "plane"}, "scale = 'wide'"),
    ],
)
def test_surveys_that_make_no_sense_are_refused(example, make, legs, options, message):
    with pytest.raises(ValueError, match=message):
        example.read_survey(make(legs, **options))


@pytest.mark.slow
def test_the_whole_run_labels_points_by_their_parts(example, make, tmp_path, capsys):
    path = make(TURN, root='<scannerSettings id="set" pulseFreq_hz="1000" scanFreq_hz="5"/>')
    returns = example.main([str(path), "--every", "3", "--out", str(tmp_path / "a.las")])
    assert "not mapped: materials" in capsys.readouterr().out
    # The wall is the second part, and stands at y = 10.
    is_wall = returns.instance == 2
    assert is_wall.any()
    np.testing.assert_allclose(returns.position[is_wall, 1], 10.0, atol=0.05)
    np.testing.assert_allclose(returns.position[returns.instance == 1, 2], 0.0, atol=0.05)
    assert len(jl.io.read_las(tmp_path / "a.las").position) == len(returns)


# -- mutants -----------------------------------------------------------------------------------------------

VOXELS = """VOXEL SPACE
#min_corner: -2 -2 0
#max_corner: 2 2 4
#split: 2 2 2
#res: 2
i j k PadBVTotal
0 0 0 0.5
0 1 1 1.5
"""
# Words that XML admits, and others that mean something to HELIOS++.
VALUES = [word for word in WORDS if word.isprintable() and len(word) < 100]
VALUES += ["static", "risley", "xyzloader", "scaled", "true", "a.vox", "1e6", "1e12", "1e-9", "-5"]


def change_xml(random, content):
    """Change or drop an attribute, or drop an element, of an XML file."""
    root = ElementTree.fromstring(content)
    elements = [element for element in root.iter() if element.attrib]
    element = choose(random, elements) if elements else root
    if random.uniform() < 0.2 and len(element):
        element.remove(choose(random, list(element)))
    elif element.attrib:
        name = choose(random, sorted(element.attrib))
        element.attrib.pop(name)
        if random.uniform() < 0.8:
            element.set(name, choose(random, VALUES))
    return ElementTree.tostring(root)


def part_of(loader, name, **options):
    parameters = "".join(f'<param key="{k}" value="{v}"/>' for k, v in {"filepath": name, **options}.items())
    return f'<part><filter type="{loader}">{parameters}</filter></part>'


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", ["tripod", "plane"])
def test_mutants_of_surveys_are_read_or_refused(example, make, tmp_path, kind):
    voxels = part_of("detailedvoxels", "a.vox"), part_of("detailedvoxels", "a.vox", intersectionMode="fixed")
    parts = GROUND + WALL + "".join(voxels) + part_of("xyzloader", "a.xyz", voxelSize=0.5)
    if kind == "tripod":
        path = make(TURN, parts, root='<scannerSettings id="set" pulseFreq_hz="1000" scanFreq_hz="5"/>')
    else:
        path = make(FLY.format(z=100), parts, "plane", scanner="swing")
    (tmp_path / "a.vox").write_text(VOXELS)
    (tmp_path / "a.xyz").write_text("1 2 3\n4 5 6\n")
    files = [*(tmp_path / "data").iterdir(), *(tmp_path / name for name in ("square.obj", "a.vox", "a.xyz"))]
    originals = {file: file.read_bytes() for file in sorted(files)}
    random, surveys, errors = np.random.default_rng(len(kind)), [], []
    for _ in range(30):
        file = choose(random, [*originals])
        content = originals[file]
        for _ in range(int(random.integers(1, 4))):
            content = (
                change_xml(random, content) if file.suffix == ".xml" else change_text(random, content)[0]
            )
        file.write_bytes(content)
        try:
            surveys.append(example.read_survey(path, every=10).survey)
        except (ValueError, FileNotFoundError) as error:
            errors.append((file, str(error)))
        file.write_bytes(originals[file])
    assert len(surveys) > 5
    assert len(errors) > 5
    assert all(np.isfinite(survey.sensor).all() and np.isfinite(survey.zenith).all() for survey in surveys)
    # Files of parts are named, and attributes of XML.
    unnamed = [error for file, error in errors if file.suffix != ".xml" and file.name not in error]
    assert all(error.startswith("mesh: ") for error in unnamed), unnamed


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ('movePerSec_m="1e-9"', r"leg 1 sends 1e\+12 pulses; admissible are 100,000,000: .* every = 1"),
        ('movePerSec_m="0"', "movePerSec_m = 0; admissible is a number above 0"),
        ('movePerSec_m="10" pulseFreq_hz="0"', "pulseFreq_hz = 0; admissible is a number above 0"),
    ],
)
def test_numbers_without_an_end_are_refused(example, make, change, message):
    legs = FLY.format(z=9).replace('movePerSec_m="10"', change)
    with pytest.raises(ValueError, match=message):
        example.read_survey(make(legs, platform="plane", scanner="swing"))
