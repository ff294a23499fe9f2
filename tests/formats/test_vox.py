"""Voxel maps of AMAPVox and HELIOS++: leaf angles and attenuation, headers of all versions, sparse maps."""

import warnings

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.io import FileWarning, read_case, read_vox

HEADER = """VOXEL SPACE
#min_corner:(-10.0, -10.0, 0.0)
#max_corner:(10.0, 10.0, 2.0)
#split:(1, 1, 2)
"""
NADIR_G = {"spherical": 0.5, "planophile": 8 / (3 * np.pi), "erectophile": 4 / (3 * np.pi)}


@pytest.fixture
def write_map(tmp_path):
    """Writes a text as a .vox file and returns its path."""

    def write(text):
        path = tmp_path / "map.vox"
        path.write_text(text)
        return path

    return write


def attenuation_map(angles, attenuation, mean_angle=None):
    """Return the text of a map of two voxels of one attenuation, sampled by beams of one mean angle."""
    column, values = ("", "") if mean_angle is None else (" angleMean", f" {mean_angle}")
    rows = [f"0 0 {k} {attenuation}{values}" for k in range(2)]
    names = f"i j k attenuation_FPL_unbiasedMLE{column}"
    return "\n".join([f"{HEADER}#lad_type:{angles}", names, *rows, ""])


@pytest.mark.parametrize("angles", list(NADIR_G))
def test_vertical_beams_find_the_attenuation_that_the_file_has(write_map, angles):
    """Half of the plant area density is stored: extinction is that and 2 G, whatever the leaf angles are."""
    voxels, _ = read_vox(write_map(attenuation_map(angles, 0.5)))
    np.testing.assert_allclose(voxels.leaf, 0.5 * 0.5 / NADIR_G[angles], rtol=1e-3)


@pytest.mark.slow
def test_the_two_way_gap_is_that_of_the_attenuation(write_map):
    """Two voxels of 1 m and of attenuation 1/2 per m leave exp(-2) of white ground to first-order light."""
    voxels, _ = read_vox(write_map(attenuation_map("Planophile", 0.5)))
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.0, 0.0), hotspot=False)
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=1.0))
    lidar = jl.Lidar(altitude=500.0, divergence=1e-3)
    wave = jl.simulate(lidar, scene, key=jax.random.key(0), max_orders=1)
    assert float(wave.components["ground"].sum()) == pytest.approx(np.exp(-2.0), rel=1e-3)


@pytest.mark.parametrize(("mean_angle", "zenith"), [(60.0, 60.0), (120.0, 60.0), (0.0, 0.0)])
def test_attenuation_is_that_of_the_mean_direction_of_the_beams(write_map, mean_angle, zenith):
    """Extinction is that of the file for beams of this angle: G of planophile leaves by quadrature."""
    voxels, _ = read_vox(write_map(attenuation_map("Planophile", 0.25, mean_angle)))
    inclination = (np.arange(2000) + 0.5) * np.pi / 4000
    azimuth = (np.arange(2000) + 0.5) * np.pi / 1000
    weight = 2 / np.pi * (1 + np.cos(2 * inclination)) * np.pi / 4000
    beam = np.deg2rad(zenith)
    cosine = np.cos(beam) * np.cos(inclination)[:, None] + np.sin(beam) * np.sin(inclination)[
        :, None
    ] * np.cos(azimuth)
    projection = weight @ np.abs(cosine).mean(axis=1)
    np.testing.assert_allclose(2 * voxels.leaf * projection, 0.25, rtol=1e-3)


def test_attenuation_of_horizontal_beams(write_map):
    """Warren Wilson: seen from the side, leaves of inclination t have G = 2 / pi sin(t)."""
    voxels, _ = read_vox(write_map(attenuation_map("Planophile", 0.3, 90.0)))
    inclination = np.linspace(0.0, np.pi / 2, 100_001)
    density = 2 / np.pi * (1 + np.cos(2 * inclination))
    projection = np.trapezoid(density * 2 / np.pi * np.sin(inclination), inclination)
    np.testing.assert_allclose(2 * voxels.leaf, 0.3 / projection, rtol=1e-3)


def test_attenuation_without_an_angle(write_map):
    text = attenuation_map("Planophile", 0.3, "NaN")
    assert read_vox(write_map(text)).dropped["without a density"] == 2
    empty, dropped = read_vox(write_map(text.replace(" 0.3 NaN", " 0 NaN")))
    assert dropped["without a density"] == 0
    assert not np.any(empty.leaf)
    with pytest.raises(ValueError, match=r"line 7: angleMean = 190 is outside the range \[0, 180\] degrees"):
        read_vox(write_map(text.replace("NaN", "190")))


def test_attenuation_of_bark_is_taken_as_it_is(write_map):
    voxels, _ = read_vox(write_map(attenuation_map("Planophile", 0.3, 10.0)), name="bark")
    np.testing.assert_allclose(voxels.bark, 0.3, rtol=1e-6)


def test_a_correction_is_no_density(write_map):
    text = attenuation_map("Spherical", 0.3).replace("FPL_unbiasedMLE", "FPL_biasCorrection")
    with pytest.raises(ValueError, match="line 6: attenuation_FPL_biasCorrection is a correction"):
        read_vox(write_map(text), density="attenuation_FPL_biasCorrection")


@pytest.mark.parametrize(
    "entry",
    ["#lad_type:Planophile", "#lad_type: Planophile", "#LAD_TYPE:PLANOPHILE", " # lad_type :planophile "],
)
def test_leaf_angles_in_every_spelling(write_map, entry):
    text = attenuation_map("Planophile", 0.3)
    expected, _ = read_vox(write_map(text))
    voxels, _ = read_vox(write_map(text.replace("#lad_type:Planophile", entry)))
    np.testing.assert_array_equal(voxels.leaf_angles.probability, expected.leaf_angles.probability)
    np.testing.assert_allclose(voxels.leaf_angles.probability, jl.LeafAngles.named("planophile").probability)


@pytest.mark.parametrize(
    ("entry", "says"),
    [
        ("#lad_type:", "line 5: lad_type: leaf_angles = '' is none of"),
        ("#lad_type Planophile", "line 5: #lad_type Planophile has no colon and no value"),
        ("#lad_type:Ellipsoidal", "line 5: lad_type: leaf_angles = 'ellipsoidal' is none of"),
        ("#lad_type:Planophile #LAD_TYPE:Planophile", "line 5: #lad_type was given in line 5"),
        ("#res:(0,1,1)", r"line 5: res = \(0,1,1\) is outside the range \(0, inf\)"),
        ("#res:1 1", "line 5: res = 1 1 are not three numbers"),
    ],
)
def test_damaged_entries(write_map, entry, says):
    text = attenuation_map("Planophile", 0.3).replace("#lad_type:Planophile", entry)
    with pytest.raises(ValueError, match=f"map.vox: {says}"):
        read_vox(write_map(text))


@pytest.mark.parametrize("spelling", ["{} {} {}", " {} {} {} ", "({}, {}, {})", "[{};{};{}]", "{}\t{}\t{}"])
def test_corners_in_every_spelling(write_map, spelling):
    lines = attenuation_map("Spherical", 0.3).splitlines()
    lines[1:4] = [
        f"#{key}:{spelling.format(*numbers)}"
        for key, numbers in {
            "min_corner": (-10.0, -10.0, 0.0), "max_corner": (10.0, 10.0, 2.0), "split": (1, 1, 2)
        }.items()
    ]  # fmt: skip
    voxels, _ = read_vox(write_map("\n".join(lines)))
    np.testing.assert_allclose(voxels.origin, [-10.0, -10.0, 0.0])
    np.testing.assert_allclose(voxels.voxel_size, [20.0, 20.0, 1.0])


def test_several_entries_on_a_line(write_map):
    text = "VOXEL SPACE\n#min_corner:0 0 0 #max_corner:1 1 2 #split:1 1 2\n\n#res:1.0\n"
    voxels, _ = read_vox(write_map(text + "i j k PadBVTotal\n0 0 0 1.5\n0 0 1 0.5\n"))
    np.testing.assert_allclose(2 * voxels.leaf[0, 0], [1.5, 0.5])


def test_a_sparse_map(write_map):
    rows = "i j k PadBVTotal\n0 0 1 1.5\n"
    voxels, dropped = read_vox(write_map(HEADER + rows), fill=0.25)
    np.testing.assert_allclose(2 * voxels.leaf[0, 0], [0.25, 1.5])
    assert dropped == {"not sampled": 1, "without a density": 0, "below the ground": 0}
    with pytest.raises(ValueError, match=r"map\.vox: line 5: 2 of 2 voxels are missing"):
        read_vox(write_map(HEADER + "i j k PadBVTotal\n"))
    huge = HEADER.replace("(1, 1, 2)", "(3000, 3000, 3000)")
    with pytest.raises(ValueError, match=r"map\.vox: line 6: 26999999999 of 27000000000 voxels are missing"):
        read_vox(write_map(huge + rows))


def test_a_case_says_which_density_left_out_voxels_have(write_map):
    path = write_map(HEADER + "i j k PadBVTotal\n0 0 1 1.5\n")
    case = path.with_suffix(".toml")
    canopy = '[scene.canopy]\nleaf = {kind = "LeafOptics", reflectance = 0.4, transmittance = 0.1}\n'
    case.write_text(canopy + 'voxels = {kind = "read_vox", path = "map.vox"}\n')
    with pytest.raises(ValueError, match=r"1 not sampled.*give fill"):
        read_case(case)
    case.write_text(canopy + 'voxels = {kind = "read_vox", path = "map.vox", fill = 0.0}\n')
    assert read_case(case).scene.canopy.voxels.shape == (1, 1, 2)


def test_a_map_made_from_points(write_map):
    """HELIOS++ writes no numbers of beams (zeros), and as max_corner the points' end, rounded up."""
    header = (
        "VOXEL SPACE\n#min_corner: 9.75 -18.25 247.75\n#max_corner: 11 -17 249\n#split: 2 2 2\n#res: 0.5\n"
    )
    path = write_map(header + "i j k PadBVTotal angleMean nbSampling\n0 1 0 1 0 0\n1 1 1 1 0 0\n")
    with pytest.warns(FileWarning, match=r"map\.vox: line 5: voxels of res = 0\.5 end at .*max_corner"):
        voxels, dropped = read_vox(path)
    np.testing.assert_allclose(voxels.voxel_size, 0.5)
    assert 2 * float(voxels.leaf.sum()) == pytest.approx(2.0)
    assert dropped["not sampled"] == 6
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ValueError, match="res is used"):
            read_vox(path)


def test_the_recorded_map_of_helios(shared):
    voxels, dropped = read_vox(shared / "voxels" / "helios_semitransparent.vox")
    assert voxels.shape == (3, 3, 4)
    np.testing.assert_allclose(voxels.voxel_size, 10.0)
    np.testing.assert_allclose(voxels.top, [30.0, 30.0, 40.0])
    assert sum(dropped.values()) == 0
    expected = jl.LeafAngles.named("planophile").probability
    np.testing.assert_allclose(voxels.leaf_angles.probability, expected)


GROUND = """VOXEL SPACE
#min_corner:(0,0,0)
#max_corner:(1,1,5)
#split:(1,1,5)
i j k ground_distance nbSampling PadBVTotal
0 0 0 -1.5 0 0
0 0 1 -0.5 0 NaN
0 0 2 -0.1 4 0
0 0 3 0.5 0 NaN
0 0 4 1.5 4 1.0
"""


@pytest.mark.parametrize(("fill", "below"), [(0.0, 0), (0.8, 2)])
def test_voxels_below_the_ground_are_not_filled(tmp_path, fill, below):
    path = tmp_path / "a.vox"
    path.write_text(GROUND)
    voxels, dropped = read_vox(path, fill=fill)
    np.testing.assert_allclose(voxels.leaf[0, 0], 0.5 * np.array([0.0, 0.0, 0.0, fill, 1.0]))
    assert dropped == {"not sampled": 0, "without a density": 1, "below the ground": below}


@pytest.mark.parametrize(
    ("kind", "name", "other"), [("WAD", "bark", "leaf"), ("wad", "bark", "leaf"), ("LAD", "leaf", "bark")]
)
def test_the_type_of_area_is_that_of_the_material(tmp_path, kind, name, other):
    path = tmp_path / "a.vox"
    path.write_text(GROUND.replace("#split", f"#type:{kind}\n#split"))
    voxels, _ = read_vox(path, name=name)
    assert float(getattr(voxels, name).sum()) > 0
    assert getattr(voxels, other) is None
    with pytest.raises(ValueError, match=rf"line 4: type = {kind}, with name = '{other}'; give"):
        read_vox(path, name=other)


def test_plant_area_stands_for_either_material(tmp_path):
    path = tmp_path / "a.vox"
    path.write_text(GROUND.replace("#split", "#type:PAD\n#split"))
    for name in ("leaf", "bark"):
        assert float(getattr(read_vox(path, name=name)[0], name).sum()) > 0
