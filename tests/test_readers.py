"""Voxel maps, point clouds and tree models from files: recorded ones, and damaged ones refused by place."""

import sys

import laspy
import numpy as np
import pytest

from jaxlidar.io import read_las, read_qsm, read_vox

VOX = """VOXEL SPACE
#min_corner: (0.0, 1.0, -0.5)
#max_corner:(1.0, 3.0, 1.0)
#split:(2, 2, 1)
#lad_type:{angles}
i j k ground_distance nbSampling PadBVTotal attenuation_FPL_unbiasedMLE
0 0 0 0.5 10 1.5 0.7
0 1 0 0.5 0 9.0 9.0
1 0 0 -0.5 10 0.25 0.1
1 1 0 0.5 10 NaN NaN
"""


@pytest.fixture
def written(tmp_path):
    """Writes a text file and gives its path."""

    def write(text, name="map.txt"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def vox(angles="Spherical"):
    return VOX.format(angles=angles).replace("#min_corner: ", "#min_corner:")


def test_a_vox_file(written):
    voxels, dropped = read_vox(written(vox()))
    assert dropped == {"not sampled": 1, "without a density": 1, "below the ground": 1}
    np.testing.assert_allclose(voxels.leaf[:, :, 0], [[0.75, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(voxels.voxel_size, [0.5, 1.0, 1.5])
    np.testing.assert_allclose(voxels.origin, [0.0, 1.0, -0.5])
    assert voxels.bark is None
    assert voxels.leaf_angles is None


def test_another_column_and_what_unsampled_voxels_hold(written):
    voxels, _ = read_vox(written(vox()), density="attenuation_FPL_unbiasedMLE", fill=0.4)
    np.testing.assert_allclose(voxels.leaf[:, :, 0], [[0.7, 0.2], [0.0, 0.2]], rtol=1e-6)
    bark, _ = read_vox(written(vox()), name="bark")
    assert bark.leaf is None
    assert float(bark.bark[0, 0, 0]) == 0.75


def test_leaf_angles_of_a_vox_file(written):
    voxels, _ = read_vox(written(vox("Planophile")))
    assert voxels.leaf_angles is not None


def test_the_recorded_vox_file(shared):
    path = shared / "voxels" / "amapvox_tls_sample.vox"
    voxels, dropped = read_vox(path)
    assert voxels.shape == (7, 6, 10)
    assert sum(dropped.values()) == 0
    rows = np.loadtxt(path, skiprows=13)
    column = path.read_text().splitlines()[12].split().index("PadBVTotal")
    assert 2 * float(voxels.leaf.sum()) == pytest.approx(rows[:, column].sum(), rel=1e-5)
    i, j, k = rows[100, :3].astype(int)
    assert 2 * float(voxels.leaf[i, j, k]) == pytest.approx(rows[100, column], rel=1e-5)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("VOXEL SPACE", "VOXELS"), r"map.txt: line 1: 'VOXEL SPACE' is missing"),
        (("#split:(2, 2, 1)\n", ""), "the header has no #split"),
        (("#split:(2, 2, 1)", "#split:(2, 2.5, 1)"), "line 4: split = .* no whole numbers"),
        (("(1.0, 3.0, 1.0)", "(1.0, 0.5, 1.0)"), "line 3: max_corner"),
        (("(1.0, 3.0, 1.0)", "(1.0, x, 1.0)"), "line 3: max_corner = 'x' is no number"),
        (("PadBVTotal", "density"), "line 10: density = NaN|voxel"),
        (("0 0 0 0.5 10 1.5 0.7", "0 0 0 0.5 10 1.5"), "line 7: 6 values; the header names 7"),
        (("0 0 0 0.5 10 1.5 0.7", "0 0 0 0.5 10 -1.5 0.7"), r"line 7: PadBVTotal = -1.5 .*\[0, inf\)"),
        (("0 0 0 0.5 10 1.5 0.7", "0 0 0 0.5 10 much 0.7"), "line 7: PadBVTotal = 'much' is no number"),
        (("0 1 0 0.5", "0 2 0 0.5"), r"line 8: voxel \(0, 2, 0\) lies outside the grid \(2, 2, 1\)"),
        (("0 1 0 0.5", "0 0 0 0.5"), r"line 8: voxel \(0, 0, 0\) is given a second time"),
        (("1 1 0 0.5 10 NaN NaN\n", ""), "1 of 4 voxels are missing"),
        (("Spherical", "Wild"), "line 5: .*Wild|line 5: .*wild"),
    ],
)
def test_damaged_vox_files(written, change, says):
    text = vox().replace(*change)
    density = "nothing" if change[0] == "PadBVTotal" else None
    if density:
        says = "line 6: no column nothing; there are i, j, k"
    with pytest.raises(ValueError, match=says):
        read_vox(written(text), density=density)


QSM = """ID, parentID, startX, startY, startZ, endX, endY, endZ, radius, branchOrder
5,-1,0,0,0,0,0,1,0.1,0
9,7,0,0,1,0,1,2,0.05,1
7,5,0,0,1,0,0,1,0.08,0
8,5,0,0,1,1,0,2,0.06,1
"""


def test_a_tree_model(written):
    tree, dropped = read_qsm(written(QSM))
    assert dropped == {"without a length": 1}
    assert len(tree.start) == 3
    # A cylinder without length leaves its child to its parent.
    np.testing.assert_array_equal(np.sort(tree.parent), [-1, 0, 0])
    assert tree.height == 2.0
    assert tree.trunk_diameter == pytest.approx(0.2)
    assert tree.wood_volume == pytest.approx(np.pi * (0.01 + np.sqrt(2) * (0.05**2 + 0.06**2)))
    assert len(tree.bud_position) == 0
    small, _ = read_qsm(written(QSM.replace(",", ";")), scale=0.01)
    assert small.height == pytest.approx(0.02)


def test_the_recorded_tree_model(shared):
    path = shared / "voxels" / "tree_qsm.csv"
    tree, dropped = read_qsm(path)
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    assert len(tree.start) + dropped["without a length"] == len(table)
    assert tree.wood_volume == pytest.approx(np.sum(np.pi * table[:, 8] ** 2 * table[:, 9]), rel=1e-3)
    assert np.all(tree.parent < np.arange(len(tree.parent)))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("radius", "thickness"), "line 1: no column radius"),
        (("8,5,0,0,1,1,0,2,0.06,1", "8,5,0,0,1,1,0,2,0.06"), "line 5: 9 values; the header names 10"),
        (("8,5,0,0,1,1", "8,5,0,zero,1,1"), "line 5: starty = 'zero' is no number"),
        (("0.06,1", "-0.06,1"), r"line 5: radius = -0.06 is outside \(0, inf\)"),
        (("0.06,1", "nan,1"), "line 5: a value is not finite"),
        (("8,5,0", "9,5,0"), "line 5: ID 9 was given in line 3"),
        (("8,5,0", "8,6,0"), "line 5: parent 6 is not in the file"),
        (("8,5,0", "8,8,0"), "line 5: the cylinder is its own ancestor"),
    ],
)
def test_damaged_tree_models(written, change, says):
    with pytest.raises(ValueError, match=says):
        read_qsm(written(QSM.replace(*change)))
    with pytest.raises(ValueError, match="line 1: there is no cylinder in the file"):
        read_qsm(written(QSM.splitlines()[0]))


@pytest.fixture
def cloud(tmp_path):
    """A LAS file of five points, of which one is noise and one is withheld."""
    las = laspy.create(point_format=6, file_version="1.4")
    las.header.scales = [0.001] * 3
    las.x, las.y, las.z = np.arange(15.0).reshape(3, 5)
    las.classification = np.array([2, 5, 7, 4, 5])
    las.withheld = np.array([0, 0, 0, 1, 0])
    las.return_number = np.array([1, 1, 1, 2, 2])
    las.intensity = np.arange(5) * 10
    path = tmp_path / "cloud.las"
    las.write(path)
    return path


def test_a_point_cloud(cloud):
    points = read_las(cloud, scale=0.5)
    assert points.dropped == {"noise": 1, "withheld": 1}
    np.testing.assert_allclose(points.position, [[0, 2.5, 5], [0.5, 3, 5.5], [2, 4.5, 7]])
    np.testing.assert_array_equal(points.classification, [2, 5, 5])
    np.testing.assert_array_equal(points.return_number, [1, 1, 2])
    np.testing.assert_array_equal(points.intensity, [0.0, 10.0, 40.0])


def test_the_recorded_point_cloud(shared):
    points = read_las(shared / "voxels" / "tree_point_cloud.las")
    assert len(points.position) == 20198
    assert points.dropped == {"noise": 0, "withheld": 0}
    assert np.ptp(points.position[:, 2]) == pytest.approx(21.97, abs=0.01)


def test_damaged_point_clouds(cloud, tmp_path):
    whole = cloud.read_bytes()
    for name, content in (("empty", b""), ("text", b"not a cloud" * 100), ("short", whole[:-40])):
        path = tmp_path / f"{name}.las"
        path.write_bytes(content)
        with pytest.raises(ValueError, match=f"{name}.las"):
            read_las(path)


@pytest.mark.parametrize("read", [read_las, read_qsm, read_vox])
def test_files_that_are_not_there(read, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.txt: no such file"):
        read(tmp_path / "nothing.txt")


@pytest.mark.parametrize("read", [read_qsm, read_vox])
def test_files_that_are_no_text(read, tmp_path):
    path = tmp_path / "binary"
    path.write_bytes(bytes(range(128, 256)))
    with pytest.raises(ValueError, match="binary: not a text file"):
        read(path)


def test_without_laspy(cloud, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(ImportError, match=r"jaxlidar\[io\]"):
        read_las(cloud)
