"""What the readers of text files share: lines, cells and numbers, refused by their place."""

import codecs
import csv
import os
from pathlib import Path

from jaxlidar.io.checks import LARGEST_WHOLE, existing


def lines_of(path: str | os.PathLike[str]) -> tuple[Path, list[str]]:
    """The path of a text file in UTF-8, and its lines."""
    path = existing(path)
    lines = []
    for number, line in enumerate(path.read_bytes().removeprefix(codecs.BOM_UTF8).splitlines(), 1):
        try:
            lines.append(line.decode())
        except UnicodeDecodeError as error:
            raise ValueError(f"{path}: not a text file: line {number}: {error}") from error
    return path, lines


def number_in(path: Path, line: int, column: str, text: str) -> float:
    """A number, or a ValueError that says where it is not one."""
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{path}: line {line}: {column} = {_shown(text)} is no number") from None


def whole_in(path: Path, line: int, column: str, text: str) -> int:
    """A whole number, or a ValueError that says where it is not one."""
    value = number_in(path, line, column, text)
    if not (value.is_integer() and abs(value) <= LARGEST_WHOLE):
        raise ValueError(f"{path}: line {line}: {column} = {_shown(text)} is no whole number")
    return int(value)


def cells_of(path: Path, line: int, text: str, delimiter: str, columns: int | None = None) -> list[str]:
    """The cells of a line. There must be `columns` cells, where that is given."""
    if delimiter == " ":
        cells = text.split()
    else:
        try:
            (cells,) = csv.reader([text], delimiter=delimiter, skipinitialspace=True, strict=True)
        except csv.Error as error:
            raise ValueError(f"{path}: line {line}: not a row of a table ({error})") from error
    if columns is not None and len(cells) != columns:
        raise ValueError(f"{path}: line {line}: {len(cells)} values; the header names {columns}")
    return cells


def _shown(text: str) -> str:
    text = text.strip()
    return repr(text if len(text) <= 40 else text[:37] + "...")
