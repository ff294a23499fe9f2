"""Reader of quantitative structure models: tables of the cylinders of a tree."""

import math
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxlidar._fields.checks import check_number, warn_user
from jaxlidar._fields.columns import NamedColumn, name_and_unit
from jaxlidar.formats.checks import MAX_COORDINATE, FileWarning, column_index
from jaxlidar.formats.text import parse_integer, parse_number, read_table
from jaxlidar.plants.tree import Tree

# Columns in use, with their names in files, without case, spaces and underscores: those of SimpleForest, of
# rTwig (id, parent, start_x ... end_z, radius, branch_order) and of aRchi (cyl_ID, parent_ID, radius_cyl,
# branching_order).
_COLUMNS = {
    "id": ("id", "cylid", "cylinderid"),
    "parent": ("parentid", "parent"),
    "order": ("branchorder", "branchingorder", "order"),
    **{f"{end}{axis}": (f"{end}{axis}",) for end in ("start", "end") for axis in "xyz"},
    "radius": ("radius", "radiuscyl"),
}
_INTEGERS = ("id", "parent", "order")
_LENGTHS = (*(f"{end}{axis}" for end in ("start", "end") for axis in "xyz"), "radius")
# The parent of a cylinder that has none, as this module writes it.
_NO_PARENT = -1


class TreeRead(NamedTuple):
    """Result of `read_qsm`: a tree, and the number of cylinders that were left out of it.

    - `tree`: a `Tree`.
    - `dropped`: number of cylinders of the file that are not in the tree, by reason.

    **Example:**

    >>> import jaxlidar as jl
    >>> from jaxlidar.formats.qsm import TreeRead
    >>> tree, dropped = TreeRead(jl.grow(jl.shrub()), {"without a length": 0})
    >>> print(tree.height > 0, dropped)
    True {'without a length': 0}
    """

    tree: Tree
    dropped: dict[str, int]


def read_qsm(path: str | os.PathLike[str], *, scale: float | None = None) -> TreeRead:
    r"""Read the tree of a quantitative structure model: a table of cylinders of SimpleForest, aRchi or rTwig.

    A cylinder is a root if its parent is negative, is itself, or is 0 where no cylinder has the ID 0. Where a
    model was cut, cylinders have parents that are not in the file: they become roots.

    **Arguments:**

    - `path`: a text file of comma-, semicolon- or tab-separated values whose first line names the columns:
      ID, parentID, startX .. endZ and radius, in any order and case; branchOrder where there is one, from 0
      or, as aRchi's, from 1 for the trunk on. Names may be followed by their unit, as in "radius [cm]".
    - `scale`: metres per unit of length in the file. Default None: the units that the columns name, otherwise
      metres.

    **Returns:** a `TreeRead`: the `Tree`, leaf-off, each cylinder a segment of constant radius, and the
    cylinders that were dropped, by reason: those "without a length". Their children grow from their parents.

    **Warns:** `FileWarning` where parents are not in the file, with the number of their cylinders.

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the line, for
    columns that are missing or name an unknown unit, rows of the wrong length, cells that are not numbers, or
    not whole ones where those belong, coordinates that are not on Earth, radii that are not positive, IDs
    given twice, and several cylinders that are their own ancestors. ValueError for a scale that is not
    positive.

    **Source:** Hackenberg et al. (2021), SimpleForest; Martin-Ducup and Lecigne (2022), the R package aRchi;
    Morales and MacFarlane (2024), Forestry 98, 1, and the dictionary of the R package rTwig.

    **Example:**

    >>> import pathlib, tempfile
    >>> import jaxlidar.io
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "tree.csv"
    >>> names = "ID,parentID,startX,startY,startZ,endX,endY,endZ,radius"
    >>> _ = path.write_text(f"{names}\n1,-1,0,0,0,0,0,2,0.1\n2,1,0,0,2,1,0,3,0.05\n")
    >>> tree, dropped = jaxlidar.io.read_qsm(path)
    >>> print(f"{tree.height:.1f} m, {tree.trunk_diameter:.1f} m", dropped)
    3.0 m, 0.2 m {'without a length': 0}
    """
    if scale is not None:
        check_number("scale", scale, 0.0, low_open=True)
    path, names, lines = read_table(path)
    column = _columns(path, names)
    units = {k: column[k].size(f"{path}: line 1", "length") for k in _LENGTHS}
    if scale is not None:
        units = dict.fromkeys(_LENGTHS, scale)
    number, rows = 1, dict[int, _Cylinder]()
    for number, cells in lines:
        row = _cylinder(path, number, column, cells, units)
        if row.id in rows:
            raise ValueError(f"{path}: line {number}: ID {row.id} was given in line {rows[row.id].line}")
        rows[row.id] = row
    # Of a root, and of a cylinder whose parent is missing, it is `_NO_PARENT`.
    parent_of = {
        row.id: row.parent if row.parent in rows and row.parent != row.id else _NO_PARENT
        for row in rows.values()
    }
    roots = [row for row in rows.values() if parent_of[row.id] == _NO_PARENT]
    # The other roots are cylinders whose parents were cut off.
    is_declared = [row.parent <= 0 or row.parent == row.id for row in roots]
    trunk_orders = [row.order for row, declared in zip(roots, is_declared) if declared]
    cut = [row for row, declared in zip(roots, is_declared) if not declared]
    # Orders are counted from 1 where no order is smaller.
    first_order = int(min(trunk_orders, default=0) == 1 and all(row.order >= 1 for row in rows.values()))
    cylinders, parents, dropped = [], [], {"without a length": 0}
    # Index of each cylinder in the tree, by ID. One without a length has the index of its parent.
    index = {_NO_PARENT: -1}
    for row in _parents_first(path, rows, parent_of):
        index[row.id] = index[parent_of[row.id]]
        if sum((e - s) ** 2 for s, e in zip(row.start, row.end)) > 0:
            parents.append(index[row.id])
            index[row.id] = len(cylinders)
            cylinders.append(row)
        else:
            dropped["without a length"] += 1
    if not cylinders:
        raise ValueError(f"{path}: line {number}: there is no cylinder in the file")
    radius = np.array([row.radius for row in cylinders])
    tree = Tree(
        start=np.array([row.start for row in cylinders]),
        end=np.array([row.end for row in cylinders]),
        radius_start=radius,
        radius_end=radius.copy(),
        parent=np.array(parents),
        order=np.array([row.order for row in cylinders]) - first_order,
        bud_position=np.zeros((0, 3)),
        bud_direction=np.zeros((0, 3)),
        bud_radius=np.zeros(0),
    )
    if cut:
        became = "cylinder without a parent became a root"
        if len(cut) > 1:
            became = "cylinders without a parent became roots"
        warn_user(
            f"{path}: line {cut[0].line}: parent {cut[0].parent} is not in the file: {len(cut)} {became}",
            FileWarning,
        )
    return TreeRead(tree, dropped)


class _Cylinder(NamedTuple):
    """A row of the table, with lengths in m."""

    line: int
    id: int
    parent: int
    order: int
    start: list[float]
    end: list[float]
    radius: float


def _columns(path: Path, names: list[str]) -> dict[str, NamedColumn]:
    """Return each column in use: that of its first name which the table has. Orders may be missing."""
    plain, units = zip(*map(name_and_unit, names))
    # A column again in another unit is not needed.
    bare = {name for name, unit in zip(plain, units) if unit is None}
    plain = ["" if unit is not None and name in bare else name for name, unit in zip(plain, units)]
    columns = {}
    for column, known in _COLUMNS.items():
        present = [name for name in known if name in plain]
        if present or column != "order":
            i = column_index(f"{path}: line 1", plain, (present or known)[0])
            columns[column] = NamedColumn(i, names[i], units[i])
    return columns


def _cylinder(
    path: Path, line: int, column: dict[str, NamedColumn], cells: list[str], units: dict[str, float]
) -> _Cylinder:
    location = f"{path}: line {line}"
    integers = {k: parse_integer(path, line, k, cells[column[k].index]) for k in _INTEGERS if k in column}
    lengths = {k: units[k] * parse_number(path, line, k, cells[column[k].index]) for k in _LENGTHS}
    for k, value in lengths.items():
        if not math.isfinite(value):
            raise ValueError(f"{location}: {k} is not finite")
        if abs(value) > MAX_COORDINATE:
            raise ValueError(f"{location}: {k} = {value:g} m lies beyond {MAX_COORDINATE:g} m")
    if integers["id"] < 0:
        raise ValueError(f"{location}: ID {integers['id']} is outside [0, inf)")
    if not lengths["radius"] > 0:
        raise ValueError(f"{location}: radius = {lengths['radius']:g} m is outside (0, inf)")
    order = integers.get("order", 0)
    if order < 0:
        raise ValueError(f"{location}: order = {order} is outside [0, inf)")
    start, end = ([lengths[f"{point}{axis}"] for axis in "xyz"] for point in ("start", "end"))
    return _Cylinder(
        line=line,
        id=integers["id"],
        parent=integers["parent"],
        order=order,
        start=start,
        end=end,
        radius=lengths["radius"],
    )


def _parents_first(path: Path, rows: dict[int, _Cylinder], parent_of: dict[int, int]) -> list[_Cylinder]:
    """Return the rows with parents before their children, in depth-first order.

    **Raises:** ValueError, naming the line, for a cycle of parents.
    """
    children: dict[int, list[int]] = {}
    for row_id, parent in parent_of.items():
        children.setdefault(parent, []).append(row_id)
    ordered, stack = {}, children.get(_NO_PARENT, [])[::-1]
    while stack:
        row_id = stack.pop()
        ordered[row_id] = rows[row_id]
        stack.extend(children.get(row_id, [])[::-1])
    for row in rows.values():
        # Rows that no root leads to.
        if row.id not in ordered:
            raise ValueError(f"{path}: line {row.line}: the cylinder is its own ancestor")
    return list(ordered.values())
