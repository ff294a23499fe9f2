"""Readers of voxel maps, tree models and point clouds: small, recorded and damaged files."""

import struct
import sys

import laspy
import numpy as np
import pytest

from jaxlidar.io import read_las, read_qsm, read_vox
from jaxlidar.optics.coefficients import load_coefficients
from tests.fuzz.fuzz_kinds import small_cloud

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
    """A function that writes a text file and returns its path."""

    def write(text, name="map.txt"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def vox(angles="Spherical"):
    """Return the text of a .vox file."""
    return VOX.format(angles=angles).replace("#min_corner: ", "#min_corner:")


def test_voxels_of_a_vox_file(written):
    voxels, dropped = read_vox(written(vox()))
    assert dropped == {"not sampled": 1, "without a density": 1, "below the ground": 1}
    np.testing.assert_allclose(voxels.leaf[:, :, 0], [[0.75, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(voxels.voxel_size, [0.5, 1.0, 1.5])
    np.testing.assert_allclose(voxels.origin, [0.0, 1.0, -0.5])
    assert voxels.bark is None
    assert voxels.leaf_angles is None


def test_column_fill_value_and_material_can_be_chosen(written):
    voxels, _ = read_vox(written(vox()), density="attenuation_FPL_unbiasedMLE", fill=0.4)
    np.testing.assert_allclose(voxels.leaf[:, :, 0], [[0.7, 0.2], [0.0, 0.2]], rtol=1e-6)
    bark, _ = read_vox(written(vox()), name="bark")
    assert bark.leaf is None
    assert float(bark.bark[0, 0, 0]) == 0.75


def test_leaf_angles_of_a_vox_file(written):
    voxels, _ = read_vox(written(vox("Planophile")))
    assert voxels.leaf_angles is not None


def test_a_recorded_vox_file(shared):
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
    ("change", "message"),
    [
        (("VOXEL SPACE", "VOXELS"), r"map.txt: line 1: 'VOXEL SPACE' is missing"),
        (("#split:(2, 2, 1)\n", ""), "the header has no #split"),
        (("#split:(2, 2, 1)", "#split:(2, 2.5, 1)"), "line 4: split = .* no whole numbers"),
        (("(1.0, 3.0, 1.0)", "(1.0, 0.5, 1.0)"), "line 3: max_corner"),
        (("(1.0, 3.0, 1.0)", "(1.0, x, 1.0)"), "line 3: max_corner = 'x' is no number"),
        (("0 0 0 0.5 10 1.5 0.7", "0 0 0 0.5 10 1.5"), "line 7: 6 values; the header names 7"),
        (("0 0 0 0.5 10 1.5 0.7", "0 0 0 0.5 10 -1.5 0.7"), r"line 7: PadBVTotal = -1.5 .*\[0, inf\)"),
        (("0 0 0 0.5 10 1.5 0.7", "0 0 0 0.5 10 much 0.7"), "line 7: PadBVTotal = 'much' is no number"),
        (("0 1 0 0.5", "0 2 0 0.5"), r"line 8: voxel \(0, 2, 0\) lies outside the grid \(2, 2, 1\)"),
        (("0 1 0 0.5", "0 0 0 0.5"), r"line 8: voxel \(0, 0, 0\) is given a second time"),
        ((VOX[VOX.index("0 0 0 0.5") :], ""), "line 6: 4 of 4 voxels are missing"),
        (("Spherical", "Wild"), "line 5: .*Wild|line 5: .*wild"),
        (
            ("#split:(2, 2, 1)", "#split:(9999, 9999, 9999)"),
            "line 10: 999700029995 of 999700029999 voxels are",
        ),
        (("#split:(2, 2, 1)", "#split:(inf, 2, 1)"), r"line 4: split = \(inf, 2, 1\) lies beyond 1e\+09"),
        (("i j k ground_distance", "i j k i"), "line 6: 2 times the column i; there are i, j, k, i"),
        (("(1.0, 3.0, 1.0)", "(1.0, 1e39, 1.0)"), r"line 3: max_corner = .* lies beyond 1e\+09"),
        (("(1.0, 3.0, 1.0)", "(1e-50, 3.0, 1.0)"), "line 3: max_corner does not lie beyond min_corner"),
        (("#split:(2, 2, 1)", "#split:(2, 2, 1)\n#split:(4, 1, 1)"), "line 5: #split was given in line 4"),
        (("0 1 0 0.5", "0 1.7 0 0.5"), "line 8: j = '1.7' is no whole number"),
        (("0 1 0 0.5", "0 inf 0 0.5"), "line 8: j = 'inf' is no whole number"),
        (
            ("0 0 0 0.5 10 1.5 0.7", "0 0 0 0.5 10 1e39 0.7"),
            r"line 7: PadBVTotal = 1e\+39 .* of single precision",
        ),
    ],
)
def test_damaged_vox_files_are_refused_by_line(written, change, message):
    with pytest.raises(ValueError, match=message):
        read_vox(written(vox().replace(*change)))


def test_an_unknown_density_column_is_refused(written):
    with pytest.raises(ValueError, match="line 6: no column nothing; there are i, j, k"):
        read_vox(written(vox()), density="nothing")


def test_unknown_materials_and_negative_fill_values_are_refused(written):
    with pytest.raises(ValueError, match="name = 'wood' is none of 'leaf', 'bark'"):
        read_vox(written(vox()), name="wood")
    with pytest.raises(ValueError, match=r"fill = -1 .*\[0, inf\)"):
        read_vox(written(vox()), fill=-1.0)


QSM = """ID, parentID, startX, startY, startZ, endX, endY, endZ, radius, branchOrder
5,-1,0,0,0,0,0,1,0.1,0
9,7,0,0,1,0,1,2,0.05,1
7,5,0,0,1,0,0,1,0.08,0
8,5,0,0,1,1,0,2,0.06,1
"""


def test_cylinders_of_a_tree_model(written):
    tree, dropped = read_qsm(written(QSM))
    assert dropped == {"without a length": 1}
    assert len(tree.start) == 3
    # Cylinder 7 has no length, so its child 9 becomes a child of its parent 5.
    np.testing.assert_array_equal(np.sort(tree.parent), [-1, 0, 0])
    assert tree.height == 2.0
    assert tree.trunk_diameter == pytest.approx(0.2)
    assert tree.wood_volume == pytest.approx(np.pi * (0.01 + np.sqrt(2) * (0.05**2 + 0.06**2)))
    assert len(tree.bud_position) == 0
    scaled, _ = read_qsm(written(QSM.replace(",", ";")), scale=0.01)
    assert scaled.height == pytest.approx(0.02)


def test_a_recorded_tree_model(shared):
    path = shared / "voxels" / "tree_qsm.csv"
    tree, dropped = read_qsm(path)
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    assert len(tree.start) + dropped["without a length"] == len(table)
    assert tree.wood_volume == pytest.approx(np.sum(np.pi * table[:, 8] ** 2 * table[:, 9]), rel=1e-3)
    assert np.all(tree.parent < np.arange(len(tree.parent)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("radius", "thickness"), "line 1: no column radius"),
        (("branchOrder", "radius"), "line 1: 2 times the column radius"),
        (("8,5,0,0,1,1,0,2,0.06,1", "8,5,0,0,1,1,0,2,0.06"), "line 5: 9 values; the header names 10"),
        (("8,5,0,0,1,1", "8,5,0,zero,1,1"), "line 5: starty = 'zero' is no number"),
        (("0.06,1", "-0.06,1"), r"line 5: radius = -0.06 m is outside \(0, inf\)"),
        (("0.06,1", "nan,1"), "line 5: radius is not finite"),
        (("8,5,0", "9,5,0"), "line 5: ID 9 was given in line 3"),
        (("9,7,0,0,1,0,1,2,0.05,1\n7,5", "9,7,0,0,1,0,1,2,0.05,1\n7,9"), "line 3: the cylinder is its own"),
        (("8,5,0", "-1,5,0"), r"line 5: ID -1 is outside \[0, inf\)"),
        (("8,5,0", "8.5,5,0"), "line 5: id = '8.5' is no whole number"),
        (("8,5,0", "8,1e300,0"), "line 5: parent = '1e300' is no whole number"),
        (("8,5,0", "8,5,-2e9"), r"line 5: startx = -2e\+09 m lies beyond 1e\+09 m"),
        (("0.06,1", "0.06,-1"), r"line 5: order = -1 is outside \[0, inf\)"),
        (("8,5,0", '8,"5,0'), "line 5: not a row of a table"),
        (("8,5,0", "8," + "5" * 200_000 + ",0"), "line 5: not a row of a table .*limit"),
        (("8,5,0", "8," + "5" * 1000 + ",0"), r"line 5: parent = '5{37}\.\.\.' is no whole number"),
    ],
)
def test_damaged_tree_models_are_refused_by_line(written, change, message):
    with pytest.raises(ValueError, match=message):
        read_qsm(written(QSM.replace(*change)))
    with pytest.raises(ValueError, match="line 1: there is no cylinder in the file"):
        read_qsm(written(QSM.splitlines()[0]))


def test_long_chains_of_cylinders_without_length_take_linear_time(written):
    """2000 cylinders have the end of a chain of 1999 cylinders without length as their parent.

    Following the chain anew for each of them would take quadratic time.
    """
    rows = [QSM.splitlines()[0], "0,-1,0,0,0,0,0,1,1,0"]
    rows += [f"{i},{i - 1},0,0,1,0,0,1,1,0" for i in range(1, 2_000)]
    rows += [f"{i},1999,0,0,1,0,0,2,1,0" for i in range(2_000, 4_000)]
    tree, dropped = read_qsm(written("\n".join(rows)))
    assert dropped == {"without a length": 1_999}
    np.testing.assert_array_equal(tree.parent, [-1, *[0] * 2_000])


def test_a_tree_model_may_have_quoted_fields_and_a_byte_order_mark(written):
    quoted = QSM.replace("parentID", '"parent_ID"').replace("8,5,", '"8","5",')
    assert len(read_qsm(written("\ufeff" + quoted)).tree.start) == 3
    with pytest.raises(ValueError, match=r"scale = 0 .*\(0, inf\)"):
        read_qsm(written(QSM), scale=0.0)


def test_coefficients_beyond_single_precision_are_refused(written):
    header = "lambda nrefrac SAC_CHL SAC_CAR SAC_ANT SAC_BROWN SAC_EWT SAC_PROT SAC_CBC\n"
    row = "1 1.4 0 0 0 0 0 0 0\n2 1.4 1e39 0 0 0 0 0 0\n"
    with pytest.raises(ValueError, match=r"map\.txt, line 3: SAC_CHL = '1e39' is no number in .*\[0, inf\)"):
        load_coefficients(written(header + row))


@pytest.fixture
def cloud(tmp_path):
    """Path of a LAS file of five points, of which one is noise and one is withheld."""
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


def test_points_of_a_cloud_without_noise_and_withheld_points(cloud):
    points = read_las(cloud, scale=0.5)
    assert points.dropped == {"noise": 1, "withheld": 1}
    np.testing.assert_allclose(points.position, [[0, 2.5, 5], [0.5, 3, 5.5], [2, 4.5, 7]])
    np.testing.assert_array_equal(points.classification, [2, 5, 5])
    np.testing.assert_array_equal(points.return_number, [1, 1, 2])
    np.testing.assert_array_equal(points.intensity, [0.0, 10.0, 40.0])


def write_with_extra_bytes(path, **changes):
    """Write two points with extra bytes of each kind; `changes` are of what declares "code"."""
    las = laspy.create(point_format=6, file_version="1.4")
    parameters = {"scales": [0.01], "offsets": [5.0], "no_data": [-1]}
    las.add_extra_dims(
        [
            laspy.ExtraBytesParams("code", "u2", "a number"),
            laspy.ExtraBytesParams("range", "i4", "in cm", **parameters),
            laspy.ExtraBytesParams("normal", "3f4", "of the surface"),
        ]
    )
    las.x, las.y, las.z = np.arange(6.0).reshape(3, 2)
    las.code, las.normal = [7, 65535], [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    las.points.array["range"] = [250, -1]
    las.write(path)
    data = bytearray(path.read_bytes())
    record = data.index(b"code\0") - 4
    for offset, value in changes.values():
        data[record + offset : record + offset + len(value)] = value
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_extra_bytes_are_read_as_declared(tmp_path, suffix):
    if suffix == ".laz":
        pytest.importorskip("lazrs")
    path = write_with_extra_bytes(tmp_path / f"a{suffix}")
    extra = read_las(path).extra
    assert list(extra) == ["code", "range", "normal"]
    assert extra["code"].dtype == np.uint16
    np.testing.assert_array_equal(extra["code"], [7, 65535])
    np.testing.assert_allclose(extra["range"], [7.5, np.nan])
    np.testing.assert_array_equal(extra["normal"], [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    # In single precision, too, a number stands for no data.
    las = laspy.create(point_format=6, file_version="1.4")
    las.add_extra_dim(laspy.ExtraBytesParams("rough", "f4", "", no_data=[-9999.9]))
    las.x, las.y, las.z = np.arange(6.0).reshape(3, 2)
    las.rough = [-9999.9, 1.5]
    las.write(path)
    np.testing.assert_array_equal(read_las(path).extra["rough"], [np.nan, 1.5])
    # Bytes without a type are no number.
    path = write_with_extra_bytes(path, untyped=(2, b"\0\2"))
    assert list(read_las(path).extra) == ["range", "normal"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ((2, b"\x1f"), "'code' has type 31; admissible is .0, 30."),
        ((2, b"\x0a"), "'normal' ends at byte 54 of point records, which have 48"),
        ((4, b"range\0"), "two dimensions have the name 'range'"),
    ],
)
def test_damaged_declarations_of_extra_bytes_are_refused(tmp_path, change, message):
    path = write_with_extra_bytes(tmp_path / "a.las", change=change)
    with pytest.raises(ValueError, match=f"a.las: header: extra bytes: {message}"):
        read_las(path)


def test_a_recorded_point_cloud(shared):
    points = read_las(shared / "voxels" / "tree_point_cloud.las")
    assert len(points.position) == 20198
    assert points.dropped == {"noise": 0, "withheld": 0}
    assert np.ptp(points.position[:, 2]) == pytest.approx(21.97, abs=0.01)


def test_empty_foreign_and_truncated_point_clouds_are_refused(cloud, tmp_path):
    data = cloud.read_bytes()
    for name, content in (("empty", b""), ("text", b"not a cloud" * 100), ("truncated", data[:-40])):
        path = tmp_path / f"{name}.las"
        path.write_bytes(content)
        with pytest.raises(ValueError, match=f"{name}.las"):
            read_las(path)


@pytest.mark.parametrize(
    ("offset", "format", "value", "message"),
    [
        (96, "<I", 2**32 - 1, "header: it is 375 bytes long and points begin at 4294967295: a file of"),
        (94, "<H", 20, "header: it is 20 bytes long"),
        (100, "<I", 2**32 - 1, "header: 4294967295 variable length records, but there is room for 0"),
        (104, "<B", 77, "header: point format 77"),
        (105, "<H", 29, "header: point format 6, records of 29 bytes"),
        (25, "<B", 9, r"header: version 1\.9 is none of LAS 1\.0 to 1\.5"),
        (131, "<d", 0.0, r"header: scale of x = 0 is outside the range \(1e-09, 1000\.0\)"),
        (139, "<d", np.nan, "header: scale of y = nan"),
        (155, "<d", np.inf, "header: offset of x = inf is not finite"),
        (155, "<d", 1e12, r"record 0: coordinates \[1000000000000\.0, .* lie beyond 1e\+09 m"),
        (243, "<I", 100, "header: 100 extended records from 0 on do not fit"),
        (247, "<Q", 10**8, "record 5: the file ends, but its header names 100000000 points"),
        (247, "<Q", 2**63, "record 5: the file ends, but its header names 9223372036854775808 points"),
        (247, "<Q", 0, "header: the file holds no points"),
        (104, "<B", 6 + 128, "header: points are compressed, but no record 22204 says how"),
    ],
)
def test_damaged_headers_of_point_clouds_are_refused(cloud, offset, format, value, message):
    content = bytearray(cloud.read_bytes())
    struct.pack_into(format, content, offset, value)
    cloud.write_bytes(content)
    with pytest.raises(ValueError, match=r"cloud\.las: (" + message + ")"):
        read_las(cloud)


@pytest.fixture
def compressed(tmp_path):
    """A function that writes a LAZ file and returns its path and the offset of its points."""
    pytest.importorskip("lazrs")

    def write(point_format=6, points=60):
        path = tmp_path / "cloud.laz"
        path.write_bytes(small_cloud(True, point_format, points))
        return path, struct.unpack_from("<I", path.read_bytes(), 96)[0]

    return write


@pytest.mark.parametrize(
    ("point_format", "points"), [*((n, 60) for n in range(11)), (3, 120_000), (6, 120_000)]
)
def test_compressed_points_equal_uncompressed_ones(compressed, tmp_path, point_format, points):
    path, _ = compressed(point_format, points)
    (tmp_path / "cloud.las").write_bytes(small_cloud(False, point_format, points))
    # The first five fields are arrays; the last one counts dropped points.
    cloud, uncompressed = read_las(path), read_las(tmp_path / "cloud.las")
    for array, expected in zip(cloud[:5], uncompressed[:5]):
        np.testing.assert_array_equal(array, expected)
    np.testing.assert_array_equal(cloud.extra["height"], uncompressed.extra["height"])
    assert cloud.extra["height"].any()


@pytest.mark.parametrize("point_format", [3, 6])
def test_truncated_compressed_point_clouds_are_refused(compressed, point_format):
    path, start = compressed(point_format)
    data = path.read_bytes()
    for size in (0, 100, 400, start - 1, start, start + 7, start + 20, start + 60, len(data) - 250):
        path.write_bytes(data[:size])
        with pytest.raises(ValueError, match=r"cloud\.laz: \w"):
            read_las(path)


def test_impossible_sizes_in_compressed_point_clouds_are_refused(compressed):
    path, start = compressed()
    data = path.read_bytes()
    (table,) = struct.unpack_from("<q", data, start)
    record = data.index(b"laszip encoded") + 52
    for offset, format, value, message in (
        (247, "<Q", 10**8, "header: 100000000 points: 3400000000 bytes are declared in a file of"),
        (247, "<Q", 61_000, "chunk table: its 1 chunks do not add up to 61000 points"),
        (start, "<q", 2**40, "chunk table: 1099511627776 is no place after"),
        (table + 4, "<I", 2**32 - 1, "chunk table: 4294967295 chunks in"),
        (table + 8, "<I", 2**32 - 1, "chunk table: its entries are damaged"),
        (table + 8, "<I", 0, "chunk table: its 1 chunks do not add up to .* bytes"),
        (start + 8 + 34 + 4, "<I", 2**32 - 1, "chunk 0: its layers do not fit into its"),
        (start + 8 + 34 + 4 + 4 * 13, "<I", 2**32 - 1, "chunk 0: layer 0 is damaged"),
        (record, "<H", 2, "record of the compression: compressor 2"),
        (record + 12, "<I", 0, "record of the compression: compressor 3 with 0 points per chunk"),
        (record + 34, "<H", 6, r"record of the compression: items \[\(6, 30\)"),
        (record + 32, "<H", 60_000, "record of the compression: 46 bytes cannot name 60000 items"),
    ):
        content = bytearray(data)
        struct.pack_into(format, content, offset, value)
        path.write_bytes(content)
        with pytest.raises(ValueError, match=rf"cloud\.laz: {message}"):
            read_las(path)


def test_bytes_that_would_overflow_the_stack_of_the_decompressor_are_refused(compressed):
    path, start = compressed(1, 500)
    content = bytearray(path.read_bytes())
    content[start + 100 : -40] = b"\xff" * len(content[start + 100 : -40])
    path.write_bytes(content)
    with pytest.raises(
        ValueError, match=r"cloud\.laz: chunk 0: the stream is damaged: bytes of 255 in a row"
    ):
        read_las(path)


def test_missing_lazrs_names_the_extra_to_install(compressed, monkeypatch):
    path, _ = compressed()
    monkeypatch.setitem(sys.modules, "lazrs", None)
    with pytest.raises(ImportError, match=r"needs lazrs: .*jaxlidar\[io\]"):
        read_las(path)


@pytest.mark.parametrize("read", [read_las, read_qsm, read_vox])
def test_missing_files_are_refused(read, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.txt: no such file"):
        read(tmp_path / "nothing.txt")


@pytest.mark.parametrize("read", [read_qsm, read_vox])
def test_binary_files_are_refused_as_text(read, tmp_path):
    path = tmp_path / "binary"
    path.write_bytes(b"\n\n" + bytes(range(128, 256)))
    with pytest.raises(ValueError, match="binary: not a text file: line 3: "):
        read(path)


def test_missing_laspy_names_the_extra_to_install(cloud, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(ImportError, match=r"jaxlidar\[io\]"):
        read_las(cloud)
