"""Reader of quantitative structure models: trees as tables of cylinders."""

import os

import numpy as np

from jaxlidar.io.text import TreeRead, cells_of, lines_of, number_in
from jaxlidar.plants.tree import Tree

# Names of the columns in use, without case, spaces and underscores.
_COLUMNS = {
    "id": ("id", "cylid", "cylinderid"),
    "parent": ("parentid", "parent"),
    "order": ("branchorder", "branchingorder", "order"),
    **{f"{end}{axis}": (f"{end}{axis}",) for end in ("start", "end") for axis in "xyz"},
    "radius": ("radius", "radiuscyl"),
}


def read_qsm(path: str | os.PathLike[str], *, scale: float = 1.0) -> TreeRead:
    r"""The tree of a quantitative structure model: a table of cylinders, as SimpleForest or aRchi write it.

    **Arguments:**

    - `path`: a text file of comma-, semicolon- or tab-separated values whose first line names the columns:
      ID, parentID, startX .. endZ and radius, in any order and case; branchOrder where there is one.
    - `scale`: metres per unit of length in the file. Default 1.

    **Returns:** a `TreeRead`: the `Tree`, leaf-off, each cylinder a segment of constant radius, and what was
    dropped, by reason: cylinders "without a length". Children of those grow from their parents.

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the line, for
    columns that are missing, rows of the wrong length, cells that are not numbers, radii that are not
    positive, IDs given twice, parents that are not there, and cylinders that are their own ancestors.

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
    path, lines = lines_of(path)
    if not lines:
        raise ValueError(f"{path}: line 1: the file is empty")
    delimiter = max(",;\t", key=lines[0].count)
    names = [c.strip().lower().replace("_", "") for c in lines[0].split(delimiter)]
    column = {}
    for name, spelled in _COLUMNS.items():
        found = [names.index(s) for s in spelled if s in names]
        if not found and name != "order":
            raise ValueError(f"{path}: line 1: no column {spelled[0]}; there are {', '.join(names)}")
        column[name] = found[0] if found else None

    rows, line_of, dropped = [], {}, {"without a length": 0}
    skipped: dict[int, int] = {}
    for number, text in enumerate(lines[1:], 2):
        if not text.strip():
            continue
        cells = cells_of(path, number, text, len(names), delimiter)
        row = {k: number_in(path, number, k, cells[i]) for k, i in column.items() if i is not None}
        if not all(np.isfinite(list(row.values()))):
            raise ValueError(f"{path}: line {number}: a value is not finite")
        own = int(row["id"])
        if own in line_of:
            raise ValueError(f"{path}: line {number}: ID {own} was given in line {line_of[own]}")
        line_of[own] = number
        if not row["radius"] > 0:
            raise ValueError(f"{path}: line {number}: radius = {row['radius']:g} is outside (0, inf)")
        if all(row[f"start{a}"] == row[f"end{a}"] for a in "xyz"):
            dropped["without a length"] += 1
            skipped[own] = int(row["parent"])
        else:
            rows.append(row)
    if not rows:
        raise ValueError(f"{path}: line {len(lines)}: there is no cylinder in the file")
    rows = _parents_first(path, rows, skipped, line_of)
    index = {int(row["id"]): i for i, row in enumerate(rows)}
    table = {k: np.array([row[k] for row in rows]) for k in rows[0]}
    start, end = (scale * np.stack([table[f"{w}{a}"] for a in "xyz"], axis=1) for w in ("start", "end"))
    radius = scale * table["radius"]
    tree = Tree(
        start=start,
        end=end,
        radius_start=radius,
        radius_end=radius.copy(),
        parent=np.array([index.get(int(row["parent"]), -1) for row in rows]),
        order=table.get("order", np.zeros(len(rows))).astype(int),
        bud_position=np.zeros((0, 3)),
        bud_direction=np.zeros((0, 3)),
        bud_radius=np.zeros(0),
    )
    return TreeRead(tree, dropped)


def _parents_first(path, rows: list[dict], skipped: dict[int, int], line_of: dict[int, int]) -> list[dict]:
    """The rows, parents before their children. A negative parent means none."""
    children: dict[int, list[dict]] = {}
    for row in rows:
        parent = int(row["parent"])
        for _ in range(len(skipped) + 1):
            if parent not in skipped:
                break
            parent = skipped[parent]
        if parent >= 0 and parent not in line_of:
            line = line_of[int(row["id"])]
            raise ValueError(f"{path}: line {line}: parent {parent} is not in the file")
        row["parent"] = max(parent, -1)
        children.setdefault(int(row["parent"]), []).append(row)
    ordered, ahead = [], children.get(-1, [])[::-1]
    while ahead:
        row = ahead.pop()
        ordered.append(row)
        ahead.extend(children.get(int(row["id"]), [])[::-1])
    if len(ordered) < len(rows):
        reached = {int(row["id"]) for row in ordered}
        line = min(line_of[int(row["id"])] for row in rows if int(row["id"]) not in reached)
        raise ValueError(f"{path}: line {line}: the cylinder is its own ancestor")
    return ordered
