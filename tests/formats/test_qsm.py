"""Quantitative structure models: the tables of aRchi and rTwig, roots, and models that were cut."""

import warnings

import numpy as np
import pytest

from jaxlidar.io import FileWarning, read_qsm

# A trunk of two cylinders, a branch on the first, and a twig on the branch.
START = [(0, 0, 0), (0, 0, 2), (0, 0, 2), (1, 0, 3)]
END = [(0, 0, 2), (0, 0, 4), (1, 0, 3), (1, 1, 3)]
RADIUS, PARENT, ORDER = [0.2, 0.1, 0.05, 0.01], [-1, 0, 0, 2], [0, 0, 1, 2]

SIMPLE_FOREST = "ID, parentID, startX, startY, startZ, endX, endY, endZ, radius, length, branchOrder"
RTWIG = "start_x,start_y,start_z,end_x,end_y,end_z,id,parent,radius,raw_radius,branch_order"
ARCHI = "startX,startY,startZ,endX,endY,endZ,cyl_ID,parent_ID,extension_ID,radius_cyl,branching_order"


@pytest.fixture
def write_table(tmp_path):
    """Writes a table of cylinders, given by IDs, parents and orders, and returns its path."""

    def write(names, ids, parents, orders, rows=range(4)):
        lines = [names]
        for i in rows:
            values = {"id": ids[i], "parent": parents[i], "order": orders[i], "radius": RADIUS[i]}
            lines.append(",".join(str(_value(name, i, values)) for name in names.split(",")))
        path = tmp_path / "tree.csv"
        path.write_text("\n".join(lines))
        return path

    return write


def _value(name, i, values):
    """Return the value of a cylinder in a column, by the words of its name."""
    name = name.strip().lower().replace("_", "")
    for points, prefix in ((START, "start"), (END, "end")):
        if name.startswith(prefix):
            return points[i]["xyz".index(name[-1])]
    for word in ("raw", "length", "extension"):
        if word in name:
            return 7
    return values[next(key for key in ("parent", "order", "radius", "id") if key in name)]


@pytest.mark.parametrize(
    ("names", "ids", "parents", "orders"),
    [
        (SIMPLE_FOREST, [0, 1, 2, 3], [-1, 0, 0, 2], [0, 0, 1, 2]),
        (RTWIG, [1, 2, 3, 4], [0, 1, 1, 3], [0, 0, 1, 2]),
        (ARCHI, [1, 2, 3, 4], [0, 1, 1, 3], [1, 1, 2, 3]),
        (ARCHI, [1, 2, 3, 4], [1, 1, 1, 3], [1, 1, 2, 3]),
        (SIMPLE_FOREST, [0, 1, 2, 3], [0, 0, 0, 2], [0, 0, 1, 2]),
        (RTWIG, [5, 6, 7, 8], [-9, 5, 5, 7], [0, 0, 1, 2]),
    ],
)
def test_one_tree_by_all_conventions(write_table, names, ids, parents, orders):
    tree, dropped = read_qsm(write_table(names, ids, parents, orders))
    np.testing.assert_array_equal(tree.start, START)
    np.testing.assert_array_equal(tree.end, END)
    np.testing.assert_array_equal(tree.radius_start, RADIUS)
    np.testing.assert_array_equal(tree.parent, PARENT)
    np.testing.assert_array_equal(tree.order, ORDER)
    assert dropped == {"without a length": 0}


def test_several_roots(write_table):
    """A cylinder whose parent is 0 is a root beside another, unless one has the ID 0."""
    tree, _ = read_qsm(write_table(RTWIG, [1, 2, 3, 4], [0, 1, 0, 3], ORDER))
    np.testing.assert_array_equal(tree.parent, [-1, 0, -1, 2])
    tree, _ = read_qsm(write_table(RTWIG, [0, 2, 3, 4], [0, 0, 0, 3], ORDER))
    np.testing.assert_array_equal(tree.parent, PARENT)


def test_a_model_without_its_trunk(write_table):
    """Pruned tables have the branches that were cut off: their lowest cylinders are roots, of their order."""
    path = write_table(RTWIG, [1, 2, 3, 4], [0, 1, 1, 3], ORDER, rows=[2, 3])
    with pytest.warns(FileWarning, match=r"tree\.csv: line 2: parent 1 is not in the file: 1 cylinder "):
        tree, dropped = read_qsm(path)
    np.testing.assert_array_equal(tree.start, START[2:])
    np.testing.assert_array_equal(tree.parent, [-1, 0])
    np.testing.assert_array_equal(tree.order, [1, 2])
    assert dropped == {"without a length": 0}
    path = write_table(RTWIG, [1, 2, 3, 4], [0, 1, 1, 3], ORDER, rows=[1, 2, 3])
    with pytest.warns(
        FileWarning, match=r"line 2: parent 1 is not in the file: 2 cylinders without a parent"
    ):
        tree, _ = read_qsm(path)
    np.testing.assert_array_equal(tree.parent, [-1, -1, 1])


def test_warnings_as_errors_refuse_a_cut_model(write_table):
    path = write_table(RTWIG, [1, 2, 3, 4], [0, 1, 1, 3], ORDER, rows=[2, 3])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ValueError, match=r"tree\.csv: line 2: parent 1 is not in the file"):
            read_qsm(path)


def test_a_circle_of_parents(write_table):
    path = write_table(RTWIG, [1, 2, 3, 4], [0, 1, 4, 3], ORDER)
    with pytest.raises(ValueError, match=r"tree\.csv: line 4: the cylinder is its own ancestor"):
        read_qsm(path)
