"""What the readers of text files share: numbers with their place, and records of what was left out."""

import csv
import os
from pathlib import Path
from typing import NamedTuple

from jaxlidar.plants.tree import Tree
from jaxlidar.scenes.voxels import VoxelMap


class VoxelsRead(NamedTuple):
    """What `read_vox` returns: a voxel map and what was left out of it.

    - `voxels`: a `VoxelMap`.
    - `dropped`: how many voxels of the file do not have their density in the map, by reason.

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


def lines_of(path: str | os.PathLike[str]) -> tuple[Path, list[str]]:
    """The lines of a text file."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        return path, path.read_text().splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not a text file ({error})") from error


def number_in(path: Path, line: int, column: str, text: str) -> float:
    """A number, or a ValueError that says where it is not one."""
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{path}: line {line}: {column} = {text.strip()!r} is no number") from None


def cells_of(path: Path, line: int, text: str, columns: int, delimiter: str) -> list[str]:
    """The cells of a line. There must be `columns` cells."""
    if delimiter == " ":
        cells = text.split()
    else:
        (cells,) = csv.reader([text], delimiter=delimiter, skipinitialspace=True)
    if len(cells) != columns:
        raise ValueError(f"{path}: line {line}: {len(cells)} values; the header names {columns}")
    return cells
