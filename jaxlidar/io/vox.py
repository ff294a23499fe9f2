"""Reader of voxel maps of AMAPVox (.vox text files)."""

import os
import re

import numpy as np

from jaxlidar.io.text import VoxelsRead, cells_of, lines_of, number_in
from jaxlidar.optics.leaf_angles import LeafAngles
from jaxlidar.scenes.voxels import VoxelMap

_FIRST_LINE = "VOXEL SPACE"
_DENSITY = ("PadBVTotal", "attenuation_FPL_unbiasedMLE")


def read_vox(
    path: str | os.PathLike[str], *, density: str | None = None, fill: float = 0.0, name: str = "leaf"
) -> VoxelsRead:
    r"""The voxel map of plant area density in an AMAPVox file.

    **Arguments:**

    - `path`: a text file that begins with "VOXEL SPACE".
    - `density`: the column of plant area density, m2/m3; a column whose name begins with "attenuation" holds
      extinction coefficients, 1/m, which are doubled. Default None: "PadBVTotal", or, where it is missing,
      "attenuation_FPL_unbiasedMLE".
    - `fill`: density of voxels that no beam sampled, m2/m3. Default 0.
    - `name`: what the plant area is taken for, "leaf" or "bark". Default "leaf".

    **Returns:** a `VoxelsRead`: the `VoxelMap` and what was dropped, by reason: voxels that no beam sampled
    ("not sampled") or whose density is not a number ("without a density"), which have the density `fill`, and
    voxels below the ground ("below the ground") that hold a density, which is left out. Leaf angles are those
    that the file names (`lad_type`).

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the line, for
    what is damaged: a first line or a header that is missing or makes no sense, rows of the wrong length or
    number, indices outside the grid or given twice, negative densities.

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
    path, lines = lines_of(path)
    if not lines or lines[0].strip() != _FIRST_LINE:
        raise ValueError(f"{path}: line 1: {_FIRST_LINE!r} is missing: no AMAPVox file")
    head, at = {}, 1
    while at < len(lines) and lines[at].startswith("#"):
        for key, value in re.findall(r"#([\w-]+):(\([^)]*\)|\S+)", lines[at]):
            head[key] = (value, at + 1)
        at += 1
    if at == len(lines):
        raise ValueError(f"{path}: line {at}: the file ends where the names of the columns belong")
    low, high = (_triple(path, head, key) for key in ("min_corner", "max_corner"))
    split = _triple(path, head, "split")
    shape = tuple(int(n) for n in split)
    if any(n != s or n < 1 for n, s in zip(shape, split)):
        raise ValueError(f"{path}: line {head['split'][1]}: split = {head['split'][0]} are no whole numbers")
    if not all(h > b for h, b in zip(high, low)):
        raise ValueError(f"{path}: line {head['max_corner'][1]}: max_corner does not lie beyond min_corner")
    names = lines[at].split()
    column = density or next((c for c in _DENSITY if c in names), _DENSITY[0])
    for needed in ("i", "j", "k", column):
        if needed not in names:
            raise ValueError(f"{path}: line {at + 1}: no column {needed}; there are {', '.join(names)}")
    sampled = names.index("nbSampling") if "nbSampling" in names else None
    ground = names.index("ground_distance") if "ground_distance" in names else None

    values, seen = np.full(shape, float(fill)), np.zeros(shape, bool)
    dropped = {"not sampled": 0, "without a density": 0, "below the ground": 0}
    factor = 2.0 if column.startswith("attenuation") else 1.0
    for number, text in enumerate(lines[at + 1 :], at + 2):
        if not text.strip():
            continue
        cells = cells_of(path, number, text, len(names), " ")
        voxel = tuple(int(number_in(path, number, c, cells[names.index(c)])) for c in "ijk")
        if any(not 0 <= v < n for v, n in zip(voxel, shape)):
            raise ValueError(f"{path}: line {number}: voxel {voxel} lies outside the grid {shape}")
        if seen[voxel]:
            raise ValueError(f"{path}: line {number}: voxel {voxel} is given a second time")
        seen[voxel] = True
        value = factor * number_in(path, number, column, cells[names.index(column)])
        if np.isnan(value):
            dropped["without a density"] += 1
        elif not 0 <= value < np.inf:
            raise ValueError(f"{path}: line {number}: {column} = {value:g} is outside the range [0, inf)")
        elif sampled is not None and number_in(path, number, "nbSampling", cells[sampled]) == 0:
            dropped["not sampled"] += 1
        elif ground is not None and number_in(path, number, "ground_distance", cells[ground]) < 0:
            dropped["below the ground"] += int(value > 0)
            values[voxel] = 0.0
        else:
            values[voxel] = value
    if not seen.all():
        raise ValueError(f"{path}: line {len(lines)}: {int((~seen).sum())} of {seen.size} voxels are missing")
    size = (np.array(high) - low) / shape
    angles = head.get("lad_type", ("Spherical", 0))[0].lower()
    if name == "bark":
        voxels = VoxelMap.from_extinction(bark=0.5 * values, voxel_size=size, origin=low)
    elif angles == "spherical":
        voxels = VoxelMap.from_lad(values, voxel_size=size, origin=low)
    else:
        try:
            leaning = LeafAngles.named(angles)
        except ValueError as error:
            raise ValueError(f"{path}: line {head['lad_type'][1]}: {error}") from error
        voxels = VoxelMap.from_lad(values, voxel_size=size, origin=low, leaf_angles=leaning)
    return VoxelsRead(voxels, dropped)


def _triple(path, head: dict[str, tuple[str, int]], key: str) -> tuple[float, float, float]:
    if key not in head:
        raise ValueError(f"{path}: line 2: the header has no #{key}")
    text, line = head[key]
    parts = text.strip("()").split(",")
    if len(parts) != 3:
        raise ValueError(f"{path}: line {line}: {key} = {text} are not three numbers")
    x, y, z = (number_in(path, line, key, part) for part in parts)
    return x, y, z
