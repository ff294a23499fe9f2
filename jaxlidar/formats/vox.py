"""Reader of voxel maps of AMAPVox and HELIOS++ (.vox text files)."""

import dataclasses
import math
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxlidar._fields.checks import check_choice, check_range, warn_user
from jaxlidar._fields.crs import common_system
from jaxlidar._fields.units import unit_size
from jaxlidar.formats.checks import MAX_COORDINATE, FileWarning, column_index, max_unpacked_size
from jaxlidar.formats.text import parse_integer, parse_number, read_lines, split_cells
from jaxlidar.optics.leaf_angles import LeafAngles
from jaxlidar.scenes.voxels import VoxelMap

_FIRST_LINE = "VOXEL SPACE"
# Columns of plant area density, or of attenuation, in the order in which they are looked for.
_DENSITY_COLUMNS = ("PadBVTotal", "attenuation_FPL_unbiasedMLE")
# Columns that a file may have: number of beams that sampled a voxel, their mean angle from the vertical in
# degrees, and the voxel's height above the ground in m.
_SAMPLING, _ANGLE, _GROUND_DISTANCE = "nbSampling", "angleMean", "ground_distance"
_HEADER_KEYS = ("min_corner", "max_corner", "split", "res", "lad_type", "type")
# Materials that densities of a type of the header (leaf, wood area density; PAD is of both) can stand for.
_MATERIAL_OF_TYPE = {"lad": "leaf", "wad": "bark"}
# Numbers of the header stand in brackets, with commas between them, or, in older files, without either.
_BRACKETS, _SEPARATORS = "()[]{}", re.compile(r"[\s,;]+")
# Edges of voxels that differ by less, in m, agree: headers are rounded. (AMAPVox has the same limit.)
_EDGE_TOLERANCE = 1e-5
# The largest density that is finite in single precision.
_MAX_DENSITY = float(np.finfo(np.float32).max)


class VoxelsRead(NamedTuple):
    """Result of `read_vox`: a voxel map, and the number of voxels that were left out of it.

    - `voxels`: a `VoxelMap`.
    - `dropped`: number of voxels of the file that do not have their density in the map, by reason.

    **Example:**

    >>> import numpy as np
    >>> import jaxlidar as jl
    >>> from jaxlidar.formats.vox import VoxelsRead
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
    r"""Read the voxel map of plant area density in a file of AMAPVox or HELIOS++.

    Columns of attenuation, whose names begin with "attenuation", hold extinction coefficients k, 1/m, of the
    beams that sampled a voxel. The plant area density is k / G(theta), with the projection function G of the
    file's leaf angles, and theta the mean angle of these beams, column "angleMean". A file without this
    column is taken to be one of vertical beams; for spherical angles, G = 1/2 in every direction.

    **Arguments:**

    - `path`: a text file that begins with "VOXEL SPACE".
    - `density`: the column of plant area density, m2/m3, or of attenuation. Default None: "PadBVTotal", or,
      where it is missing, "attenuation_FPL_unbiasedMLE".
    - `fill`: density of voxels that no beam sampled, m2/m3. Default 0.
    - `name`: material of the plant area, "leaf" or "bark". Attenuation of bark is taken as it is. Default
      "leaf".

    A file that is placed with a turn, as HELIOS++ does, is read as it is: `VoxelMap.join` turns its map about
    the lower corner.

    **Returns:** a `VoxelsRead`: the `VoxelMap`, and the voxels that were dropped, by reason. The density
    `fill` is that of voxels that no beam sampled ("not sampled"), which sparse maps leave out, and of those
    whose density is not a number ("without a density"). Voxels below the ground ("below the ground") that
    hold a density, or would be filled, have none. Leaf angles are those that the file names (`lad_type`),
    spherical where it names none. Voxels have the edges `res` from `min_corner` on, or, without `res`, are
    those of the grid from `min_corner` to `max_corner`.

    **Warns:** `FileWarning` where the grid of `res` does not end at `max_corner`.

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the line, for a
    first line or a header that is missing or makes no sense, another unit than the metre in it, leaf angles
    without a name here, columns that are missing or given twice, rows of the wrong length, no row or
    implausibly few, indices outside the grid or given twice, negative densities, and angles outside 0 to 180
    degrees; for `name` "leaf" where the header's type is WAD, wood area density, and "bark" where it is LAD.
    ValueError for a `fill` that is negative or not finite, and for another `name`.

    **Source:** Vincent et al. (2017), Remote Sens. Environ. 190, 273; Vincent, Pimont and Verley (2021), A
    note on PAD/LAD estimators implemented in AMAPVox 1.7, doi:10.23708/1AJNMP.

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
    header, column_line = _read_header(path, lines)
    crs = _checked_system(path, header)
    kind, line = header.get("type", ("", 0))
    if (material := _MATERIAL_OF_TYPE.get(kind.lower(), name)) != name:
        raise ValueError(
            f"{path}: line {line}: type = {kind}, with name = {name!r}; give name = {material!r}"
        )
    grid = _read_grid(path, header)
    angles = _leaf_angles(path, header)
    names = lines[column_line].split()
    if density is None:
        density = next((c for c in _DENSITY_COLUMNS if c in names), _DENSITY_COLUMNS[0])
    optional = [c for c in (_SAMPLING, _ANGLE, _GROUND_DISTANCE) if c in names]
    used = ("i", "j", "k", density, *optional)
    column = {c: column_index(f"{path}: line {column_line + 1}", names, c) for c in used}
    if "correction" in density.lower() or "biascorr" in density.lower():
        raise ValueError(
            f"{path}: line {column_line + 1}: {density} is a correction of the attenuation, no density; give "
            "the name of another column as density"
        )
    _check_number_of_rows(path, lines, column_line, math.prod(grid.shape))

    def rows() -> Iterator[_VoxelRow]:
        for number, text in enumerate(lines[column_line + 1 :], column_line + 2):
            if text.strip():
                cells = split_cells(path, number, text, " ", len(names))
                voxel = tuple(parse_integer(path, number, c, cells[column[c]]) for c in "ijk")
                values = {c: parse_number(path, number, c, cells[column[c]]) for c in used[3:]}
                yield _VoxelRow(number, voxel, values)

    # Files made from points, as HELIOS++'s are, count no beams: all their numbers of beams are zero.
    counts_beams = _SAMPLING in column and any(row.values[_SAMPLING] > 0 for row in rows())
    convert = None
    if density.startswith("attenuation"):
        convert = _density_of_attenuation(path, angles if name == "leaf" else None)

    densities, is_read = np.full(grid.shape, float(fill)), np.zeros(grid.shape, bool)
    dropped = {"not sampled": 0, "without a density": 0, "below the ground": 0}
    for row in rows():
        if any(not 0 <= v < n for v, n in zip(row.voxel, grid.shape)):
            raise ValueError(f"{path}: line {row.line}: voxel {row.voxel} lies outside the grid {grid.shape}")
        if is_read[row.voxel]:
            raise ValueError(f"{path}: line {row.line}: voxel {row.voxel} is given a second time")
        is_read[row.voxel] = True
        value = row.values[density] if convert is None else convert(row, density)
        if not (np.isnan(value) or 0 <= value <= _MAX_DENSITY):
            raise ValueError(
                f"{path}: line {row.line}: {density} = {value:g} is outside the range [0, inf) of single "
                "precision"
            )
        is_sampled = not counts_beams or row.values[_SAMPLING] > 0
        if row.values.get(_GROUND_DISTANCE, 0.0) < 0:
            # No plants grow there, sampled or not.
            dropped["below the ground"] += int((value if is_sampled and not np.isnan(value) else fill) > 0)
            densities[row.voxel] = 0.0
        elif np.isnan(value):
            dropped["without a density"] += 1
        elif not is_sampled:
            dropped["not sampled"] += 1
        else:
            densities[row.voxel] = value
    # Sparse maps have no row of voxels that no beam sampled.
    dropped["not sampled"] += int(np.sum(~is_read))
    if name == "bark":
        voxels = VoxelMap.from_extinction(bark=0.5 * densities, voxel_size=grid.edges, origin=grid.origin)
    else:
        voxels = VoxelMap.from_lad(
            densities, voxel_size=grid.edges, origin=grid.origin, leaf_angles=angles or "spherical"
        )
    return VoxelsRead(dataclasses.replace(voxels, crs=crs), dropped)


class _VoxelRow(NamedTuple):
    """A row: its line, the indices of its voxel, and its values by column."""

    line: int
    voxel: tuple[int, ...]
    values: dict[str, float]


class _VoxelGrid(NamedTuple):
    """The grid of a file: numbers of voxels, edges of a voxel and lower corner, m, along x, y and z."""

    shape: tuple[int, ...]
    edges: Float[np.ndarray, "3"]
    origin: tuple[float, float, float]


def _check_number_of_rows(path: Path, lines: list[str], column_line: int, voxels: int) -> None:
    """Refuse a map without a row, and one so sparse that its grid is not that of the file."""
    missing = voxels - sum(bool(text.strip()) for text in lines[column_line + 1 :])
    if missing == voxels or (missing > 0 and voxels * np.dtype(float).itemsize > max_unpacked_size(path)):
        raise ValueError(f"{path}: line {len(lines)}: {missing} of {voxels} voxels are missing")


def _density_of_attenuation(path: Path, angles: LeafAngles | None) -> Callable[[_VoxelRow, str], float]:
    """Make the function of a row that returns the plant area density, m2/m3, of an attenuation column."""
    projection = np.full(2, 0.5) if angles is None else np.asarray(angles.tables()[0], float)
    cosines = np.linspace(0.0, 1.0, projection.size)

    def convert(row: _VoxelRow, column: str) -> float:
        attenuation, angle = row.values[column], row.values.get(_ANGLE, 0.0)
        if angles is None or attenuation == 0.0:
            return 2.0 * attenuation
        if not (0.0 <= angle <= 180.0 or math.isnan(angle)):
            raise ValueError(
                f"{path}: line {row.line}: {_ANGLE} = {angle:g} is outside the range [0, 180] degrees"
            )
        return attenuation / float(np.interp(abs(math.cos(math.radians(angle))), cosines, projection))

    return convert


# -- header ------------------------------------------------------------------------------------------------


def _read_header(path: Path, lines: list[str]) -> tuple[dict[str, tuple[str, int]], int]:
    """Return text and line number of the entries of the header, and the index of the line after it.

    A line may have several entries, "#key:value #key:value", with blanks around each word. Keys are returned
    in small letters.
    """
    if not lines or lines[0].strip() != _FIRST_LINE:
        raise ValueError(f"{path}: line 1: {_FIRST_LINE!r} is missing: no AMAPVox file")
    header: dict[str, tuple[str, int]] = {}
    for number, line in enumerate(lines[1:], 2):
        if not line.strip():
            continue
        before, *entries = line.split("#")
        if before.strip():
            return header, number - 1
        for entry in entries:
            key, colon, value = (word.strip() for word in entry.partition(":"))
            if not colon:
                raise ValueError(f"{path}: line {number}: #{key[:40]} has no colon and no value")
            key = key.lower()
            if key in _HEADER_KEYS and key in header:
                raise ValueError(f"{path}: line {number}: #{key} was given in line {header[key][1]}")
            header[key] = (value, number)
    raise ValueError(f"{path}: line {len(lines)}: the file ends where the names of the columns belong")


def _checked_system(path: Path, header: dict[str, tuple[str, int]]) -> str | None:
    """Return the system of coordinates that a header names; refuse another unit than the metre.

    **Raises:** ValueError, naming the file and the line, also for two systems.
    """
    names = {}
    for key, (text, line) in header.items():
        location = f"{path}: line {line}: {key}"
        if key in ("unit", "units") and unit_size("length", location, text) != 1.0:
            raise ValueError(f"{location} = {text}; read are voxels in metres")
        if key in ("crs", "srs", "epsg"):
            names[location] = f"EPSG:{text}" if text.isdigit() else text
    return common_system(names)


def _read_grid(path: Path, header: dict[str, tuple[str, int]]) -> _VoxelGrid:
    """Return the grid that the header describes.

    **Raises:** ValueError, naming the file and the line, for entries that are missing or make no sense.
    """
    low, high = (_triple(path, header, key) for key in ("min_corner", "max_corner"))
    split = _triple(path, header, "split")
    shape = tuple(int(n) for n in split)
    if any(n != s or n < 1 for n, s in zip(shape, split)):
        text, line = header["split"]
        raise ValueError(f"{path}: line {line}: split = {text} are no whole numbers")
    if not all(np.float32(h - b) > 0 for h, b in zip(high, low)):
        _, line = header["max_corner"]
        raise ValueError(f"{path}: line {line}: max_corner does not lie beyond min_corner")
    edges = (np.array(high) - low) / shape
    if "res" in header:
        text, line = header["res"]
        resolution = np.array(_triple(path, header, "res"))
        if not np.all(np.float32(resolution) > 0):
            raise ValueError(f"{path}: line {line}: res = {text} is outside the range (0, inf)")
        if np.any(np.abs(resolution - edges) > _EDGE_TOLERANCE):
            # HELIOS++ writes the points' largest coordinates, rounded up, as max_corner.
            end = (np.array(low) + shape * resolution).tolist()
            warn_user(
                f"{path}: line {line}: voxels of res = {text} end at {end}, not at max_corner = {[*high]}: "
                "res is used",
                FileWarning,
            )
            edges = resolution
    return _VoxelGrid(shape, edges, low)


def _leaf_angles(path: Path, header: dict[str, tuple[str, int]]) -> LeafAngles | None:
    """Return the leaf angles that the header names; None for spherical ones."""
    angles, line = header.get("lad_type", ("spherical", 0))
    if angles.lower() == "spherical":
        return None
    try:
        return LeafAngles.named(angles.lower())
    except ValueError as error:
        raise ValueError(f"{path}: line {line}: lad_type: {error}") from error


def _triple(path: Path, header: dict[str, tuple[str, int]], key: str) -> tuple[float, float, float]:
    """Return the three numbers of an entry of the header. One number of `res` is that of cubes."""
    if key not in header:
        raise ValueError(f"{path}: line 2: the header has no #{key}")
    text, line = header[key]
    texts = _SEPARATORS.split(text.strip().strip(_BRACKETS).strip())
    if len(texts) == 1 and key == "res":
        texts = 3 * texts
    if len(texts) != 3:
        raise ValueError(f"{path}: line {line}: {key} = {text} are not three numbers")
    x, y, z = (parse_number(path, line, key, number) for number in texts)
    if not all(abs(v) <= MAX_COORDINATE for v in (x, y, z)):
        raise ValueError(f"{path}: line {line}: {key} = {text} lies beyond {MAX_COORDINATE:g}")
    return x, y, z
