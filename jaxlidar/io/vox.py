"""Reader of voxel maps of AMAPVox (.vox text files)."""

import math
import os
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxlidar._checks import check_choice, check_range
from jaxlidar.io.checks import MAX_COORDINATE, column_index
from jaxlidar.io.text import parse_integer, parse_number, read_lines, split_cells
from jaxlidar.optics.leaf_angles import LeafAngles
from jaxlidar.scenes.voxels import VoxelMap

_FIRST_LINE = "VOXEL SPACE"
# Columns of plant area density, or of attenuation, in the order in which they are looked for.
_DENSITY_COLUMNS = ("PadBVTotal", "attenuation_FPL_unbiasedMLE")
# Columns with the number of beams that sampled a voxel, and with its height above the ground.
_OPTIONAL_COLUMNS = ("nbSampling", "ground_distance")
_HEADER_KEYS = ("min_corner", "max_corner", "split", "lad_type")
# The largest density that is finite in single precision.
_MAX_DENSITY = float(np.finfo(np.float32).max)


class VoxelsRead(NamedTuple):
    """Result of `read_vox`: a voxel map, and the number of voxels that were left out of it.

    - `voxels`: a `VoxelMap`.
    - `dropped`: number of voxels of the file that do not have their density in the map, by reason.

    **Example:**

    >>> import numpy as np
    >>> import jaxlidar as jl
    >>> from jaxlidar.io import VoxelsRead
    >>> leaves = jl.VoxelMap.from_lad(np.ones((1, 1, 2)), voxel_size=1.0)
    >>> voxels, dropped = VoxelsRead(leaves, {"not sampled": 0})
    >>> print(voxels.shape, dropped)
    (1, 1, 2) {'not sampled': 0}
    """

    voxels: VoxelMap
    dropped: dict[str, int]


def read_vox(
    path: str | os.PathLike[str], *, density: str | None = None, fill: float = 0.0, name: str = "leaf"
) -> VoxelsRead:
    r"""Read the voxel map of plant area density in an AMAPVox file.

    **Arguments:**

    - `path`: a text file that begins with "VOXEL SPACE".
    - `density`: the column of plant area density, m2/m3; a column whose name begins with "attenuation" holds
      extinction coefficients, 1/m, which are doubled. Default None: "PadBVTotal", or, where it is missing,
      "attenuation_FPL_unbiasedMLE".
    - `fill`: density of voxels that no beam sampled, m2/m3. Default 0.
    - `name`: material of the plant area, "leaf" or "bark". Default "leaf".

    **Returns:** a `VoxelsRead`: the `VoxelMap`, and the voxels that were dropped, by reason: those that no
    beam sampled ("not sampled") or whose density is not a number ("without a density"), which have the
    density `fill`, and those below the ground ("below the ground") that hold a density, which is left out.
    Leaf angles are those that the file names (`lad_type`).

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the line, for a
    first line or a header that is missing or makes no sense, columns that are missing or given twice, rows of
    the wrong length or number, indices outside the grid or given twice, and negative densities. ValueError
    for a `fill` that is negative or not finite, and for another `name`.

    **Source:** Vincent et al. (2017), Remote Sens. Environ. 190, 273; AMAPVox's output format.

    **Example:**

    >>> import pathlib, tempfile
    >>> import jaxlidar.io
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "plot.vox"
    >>> lines = ["VOXEL SPACE", "#min_corner:(0,0,0)", "#max_corner:(1,1,2)", "#split:(1,1,2)"]
    >>> lines += ["i j k PadBVTotal", "0 0 0 NaN", "0 0 1 1.5"]
    >>> _ = path.write_text("\n".join(lines))
    >>> voxels, dropped = jaxlidar.io.read_vox(path)
    >>> print(voxels.leaf, dropped["without a density"])
    [[[0.   0.75]]] 1
    """
    check_choice("name", name, ("leaf", "bark"))
    check_range("fill", fill, 0.0)
    path, lines = read_lines(path)
    head, column_line = _read_header(path, lines)
    low, high = (_triple(path, head, key) for key in ("min_corner", "max_corner"))
    split = _triple(path, head, "split")
    shape = tuple(int(n) for n in split)
    if any(n != s or n < 1 for n, s in zip(shape, split)):
        raise ValueError(f"{path}: line {head['split'][1]}: split = {head['split'][0]} are no whole numbers")
    if not all(np.float32(h - b) > 0 for h, b in zip(high, low)):
        raise ValueError(f"{path}: line {head['max_corner'][1]}: max_corner does not lie beyond min_corner")
    names = lines[column_line].split()
    if density is None:
        density = next((c for c in _DENSITY_COLUMNS if c in names), _DENSITY_COLUMNS[0])
    needed = ("i", "j", "k", density, *(c for c in _OPTIONAL_COLUMNS if c in names))
    column = {c: column_index(f"{path}: line {column_line + 1}", names, c) for c in needed}

    numbered = enumerate(lines[column_line + 1 :], column_line + 2)
    rows = [(number, text) for number, text in numbered if text.strip()]
    if len(rows) < (count := math.prod(shape)):
        raise ValueError(f"{path}: line {len(lines)}: {count - len(rows)} of {count} voxels are missing")
    values, is_read = np.full(shape, float(fill)), np.zeros(shape, bool)
    dropped = {"not sampled": 0, "without a density": 0, "below the ground": 0}
    # Attenuation is half of the plant area density, for G = 1/2 of spherical angles.
    factor = 2.0 if density.startswith("attenuation") else 1.0
    for number, text in rows:
        cells = split_cells(path, number, text, " ", len(names))
        voxel = tuple(parse_integer(path, number, c, cells[column[c]]) for c in "ijk")
        if any(not 0 <= v < n for v, n in zip(voxel, shape)):
            raise ValueError(f"{path}: line {number}: voxel {voxel} lies outside the grid {shape}")
        if is_read[voxel]:
            raise ValueError(f"{path}: line {number}: voxel {voxel} is given a second time")
        is_read[voxel] = True
        row = {c: parse_number(path, number, c, cells[column[c]]) for c in needed[3:]}
        value = factor * row[density]
        if np.isnan(value):
            dropped["without a density"] += 1
        elif not 0 <= value <= _MAX_DENSITY:
            raise ValueError(
                f"{path}: line {number}: {density} = {value:g} is outside the range [0, inf) of single "
                "precision"
            )
        elif row.get("nbSampling") == 0:
            dropped["not sampled"] += 1
        elif row.get("ground_distance", 0.0) < 0:
            dropped["below the ground"] += int(value > 0)
            values[voxel] = 0.0
        else:
            values[voxel] = value
    size = (np.array(high) - low) / shape
    if name == "bark":
        voxels = VoxelMap.from_extinction(bark=0.5 * values, voxel_size=size, origin=low)
    else:
        angles = _leaf_angles(path, head)
        voxels = VoxelMap.from_lad(values, voxel_size=size, origin=low, leaf_angles=angles)
    return VoxelsRead(voxels, dropped)


def _read_header(path: Path, lines: list[str]) -> tuple[dict[str, tuple[str, int]], int]:
    """Return text and line number of the entries of the header, and the index of the line after it."""
    if not lines or lines[0].strip() != _FIRST_LINE:
        raise ValueError(f"{path}: line 1: {_FIRST_LINE!r} is missing: no AMAPVox file")
    head: dict[str, tuple[str, int]] = {}
    for number, line in enumerate(lines[1:], 2):
        if not line.startswith("#"):
            return head, number - 1
        for key, value in re.findall(r"#([\w-]+):(\([^)]*\)|\S+)", line):
            if key in _HEADER_KEYS and key in head:
                raise ValueError(f"{path}: line {number}: #{key} was given in line {head[key][1]}")
            head[key] = (value, number)
    raise ValueError(f"{path}: line {len(lines)}: the file ends where the names of the columns belong")


def _leaf_angles(path: Path, head: dict[str, tuple[str, int]]) -> str | LeafAngles:
    """Return the leaf angles that the header names."""
    angles, line = head.get("lad_type", ("spherical", 0))
    if angles.lower() == "spherical":
        return "spherical"
    try:
        return LeafAngles.named(angles.lower())
    except ValueError as error:
        raise ValueError(f"{path}: line {line}: {error}") from error


def _triple(path: Path, head: dict[str, tuple[str, int]], key: str) -> tuple[float, float, float]:
    """Return the three numbers of an entry of the header."""
    if key not in head:
        raise ValueError(f"{path}: line 2: the header has no #{key}")
    text, line = head[key]
    texts = text.strip("()").split(",")
    if len(texts) != 3:
        raise ValueError(f"{path}: line {line}: {key} = {text} are not three numbers")
    x, y, z = (parse_number(path, line, key, number) for number in texts)
    if not all(abs(v) <= MAX_COORDINATE for v in (x, y, z)):
        raise ValueError(f"{path}: line {line}: {key} = {text} lies beyond {MAX_COORDINATE:g}")
    return x, y, z
