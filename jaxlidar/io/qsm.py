"""Reader of quantitative structure models: trees as tables of cylinders."""

import math
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxlidar._checks import check_range
from jaxlidar.io.checks import FARTHEST, column_of
from jaxlidar.io.text import cells_of, lines_of, number_in, whole_in
from jaxlidar.plants.tree import Tree

# Names of the columns in use, without case, spaces and underscores.
_COLUMNS = {
    "id": ("id", "cylid", "cylinderid"),
    "parent": ("parentid", "parent"),
    "order": ("branchorder", "branchingorder", "order"),
    **{f"{end}{axis}": (f"{end}{axis}",) for end in ("start", "end") for axis in "xyz"},
    "radius": ("radius", "radiuscyl"),
}
_WHOLE = ("id", "parent", "order")
_LENGTHS = (*(f"{end}{axis}" for end in ("start", "end") for axis in "xyz"), "radius")


class TreeRead(NamedTuple):
    """What `read_qsm` returns: a tree and what was left out of it.

    - `tree`: a `Tree`.
    - `dropped`: how many cylinders of the file are not in the tree, by reason.

    **Example:**

    >>> import jaxlidar as jl
    >>> from jaxlidar.io import TreeRead
    >>> tree, dropped = TreeRead(jl.grow(jl.shrub()), {"without a length": 0})
    >>> print(tree.height > 0, dropped)
    True {'without a length': 0}
    """

    tree: Tree
    dropped: dict[str, int]


def read_qsm(path: str | os.PathLike[str], *, scale: float = 1.0) -> TreeRead:
    r"""The tree of a quantitative structure model: a table of cylinders, as SimpleForest or aRchi write it.

    **Arguments:**

    - `path`: a text file of comma-, semicolon- or tab-separated values whose first line names the columns:
      ID, parentID, startX .. endZ and radius, in any order and case; branchOrder where there is one.
    - `scale`: metres per unit of length in the file. Default 1.

    **Returns:** a `TreeRead`: the `Tree`, leaf-off, each cylinder a segment of constant radius, and what was
    dropped, by reason: cylinders "without a length". Children of those grow from their parents.

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the line, for
    columns that are missing, rows of the wrong length, cells that are not numbers, or not whole ones where
    those belong, places that are not on Earth, radii that are not positive, IDs given twice, parents that are
    not there, and cylinders that are their own ancestors. ValueError for a scale that is not positive.

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
    check_range("scale", scale, 0.0, low_open=True)
    path, lines = lines_of(path)
    if not lines:
        raise ValueError(f"{path}: line 1: the file is empty")
    delimiter = max(",;\t", key=lines[0].count)
    names = [c.strip().lower().replace("_", "") for c in cells_of(path, 1, lines[0], delimiter)]
    column = _columns(path, names)
    rows: dict[int, _Cylinder] = {}
    for number, text in enumerate(lines[1:], 2):
        if not text.strip():
            continue
        row = _cylinder(path, number, column, cells_of(path, number, text, delimiter, len(names)), scale)
        if row.id in rows:
            raise ValueError(f"{path}: line {number}: ID {row.id} was given in line {rows[row.id].line}")
        rows[row.id] = row
    kept, parents, dropped = [], [], {"without a length": 0}
    # Where each cylinder stands in the tree. One without a length stands where its parent does.
    index = {-1: -1}
    for row in _parents_first(path, rows):
        index[row.id] = index[row.parent]
        if sum((e - s) ** 2 for s, e in zip(row.start, row.end)) > 0:
            parents.append(index[row.parent])
            index[row.id] = len(kept)
            kept.append(row)
        else:
            dropped["without a length"] += 1
    if not kept:
        raise ValueError(f"{path}: line {len(lines)}: there is no cylinder in the file")
    radius = np.array([row.radius for row in kept])
    tree = Tree(
        start=np.array([row.start for row in kept]),
        end=np.array([row.end for row in kept]),
        radius_start=radius,
        radius_end=radius.copy(),
        parent=np.array(parents),
        order=np.array([row.order for row in kept]),
        bud_position=np.zeros((0, 3)),
        bud_direction=np.zeros((0, 3)),
        bud_radius=np.zeros(0),
    )
    return TreeRead(tree, dropped)


class _Cylinder(NamedTuple):
    """A row of the table, with lengths in m. A parent of -1 means none."""

    line: int
    id: int
    parent: int
    order: int
    start: list[float]
    end: list[float]
    radius: float


def _columns(path: Path, names: list[str]) -> dict[str, int]:
    """Where each column in use stands. Branch orders may be missing."""
    column = {}
    for name, spelled in _COLUMNS.items():
        present = [s for s in spelled if s in names]
        if present or name != "order":
            column[name] = column_of(f"{path}: line 1", names, present[0] if present else spelled[0])
    return column


def _cylinder(path: Path, line: int, column: dict[str, int], cells: list[str], scale: float) -> _Cylinder:
    place = f"{path}: line {line}"
    whole = {k: whole_in(path, line, k, cells[column[k]]) for k in _WHOLE if k in column}
    length = {k: scale * number_in(path, line, k, cells[column[k]]) for k in _LENGTHS}
    for k, value in length.items():
        if not math.isfinite(value):
            raise ValueError(f"{place}: {k} is not finite")
        if abs(value) > FARTHEST:
            raise ValueError(f"{place}: {k} = {value:g} m lies beyond {FARTHEST:g} m")
    if whole["id"] < 0:
        raise ValueError(f"{place}: ID {whole['id']} is outside [0, inf)")
    if not length["radius"] > 0:
        raise ValueError(f"{place}: radius = {length['radius']:g} m is outside (0, inf)")
    order = whole.get("order", 0)
    if order < 0:
        raise ValueError(f"{place}: order = {order} is outside [0, inf)")
    start, end = ([length[f"{which}{axis}"] for axis in "xyz"] for which in ("start", "end"))
    return _Cylinder(line, whole["id"], max(whole["parent"], -1), order, start, end, length["radius"])


def _parents_first(path: Path, rows: dict[int, _Cylinder]) -> list[_Cylinder]:
    """The rows, parents before their children."""
    children: dict[int, list[int]] = {}
    for row in rows.values():
        if row.parent != -1 and row.parent not in rows:
            raise ValueError(f"{path}: line {row.line}: parent {row.parent} is not in the file")
        children.setdefault(row.parent, []).append(row.id)
    ordered, ahead = {}, children.get(-1, [])[::-1]
    while ahead:
        own = ahead.pop()
        ordered[own] = rows[own]
        ahead.extend(children.get(own, [])[::-1])
    for row in rows.values():
        if row.id not in ordered:
            raise ValueError(f"{path}: line {row.line}: the cylinder is its own ancestor")
    return list(ordered.values())
