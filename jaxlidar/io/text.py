"""What the readers of text files share: numbers with their place, and a record of what was left out."""

import csv
import os
from pathlib import Path
from typing import NamedTuple

from jaxlidar.plants.tree import Tree
from jaxlidar.scenes.voxels import VoxelMap


class VoxelsRead(NamedTuple):
    """A voxel map from a file; `dropped` counts what the file holds and the map does not, by reason."""

    voxels: VoxelMap
    dropped: dict[str, int]


class TreeRead(NamedTuple):
    """A tree from a file; `dropped` counts what the file holds and the tree does not, by reason."""

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
    """The cells of a line, of which there must be `columns`."""
    if delimiter == " ":
        cells = text.split()
    else:
        (cells,) = csv.reader([text], delimiter=delimiter, skipinitialspace=True)
    if len(cells) != columns:
        raise ValueError(f"{path}: line {line}: {len(cells)} values; the header names {columns}")
    return cells
