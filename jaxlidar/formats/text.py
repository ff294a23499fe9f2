"""Lines, cells and numbers of text files; what is not admissible is refused with its file and line."""

import codecs
import csv
import os
from collections.abc import Iterator
from pathlib import Path

from jaxlidar.formats.checks import MAX_EXACT_INTEGER, existing_file


def read_lines(path: str | os.PathLike[str]) -> tuple[Path, list[str]]:
    """Return the path of a text file, and its lines.

    A file that is not UTF-8 is read as Windows-1252, which has the letters of Latin-1. Some bytes are none of
    its characters, so that most binary files are refused.

    **Raises:** FileNotFoundError; ValueError, naming file and line, where it is neither.
    """
    path = existing_file(path)
    lines = path.read_bytes().removeprefix(codecs.BOM_UTF8).splitlines()
    encoding = "utf-8" if _first_undecodable(lines, "utf-8") is None else "cp1252"
    undecodable = _first_undecodable(lines, encoding)
    if undecodable is not None:
        number, error = undecodable
        raise ValueError(f"{path}: not a text file: line {number}: {error}") from error
    return path, [line.decode(encoding) for line in lines]


def read_table(path: str | os.PathLike[str]) -> tuple[Path, list[str], Iterator[tuple[int, list[str]]]]:
    """Read a text file of comma-, semicolon- or tab-separated values whose first line names the columns.

    **Returns:** the path, the names, and the number and the cells of each line that is not empty.

    **Raises:** as `read_lines`; ValueError, naming file and line, for a file without names, and for a line of
    another number of cells, when its turn comes.
    """
    path, lines = read_lines(path)
    if not lines or not lines[0].strip():
        raise ValueError(f"{path}: line 1: there is no line that names the columns")
    delimiter = max(",;\t", key=lines[0].count)
    names = [name.strip() for name in split_cells(path, 1, lines[0], delimiter)]
    rows = (
        (number, split_cells(path, number, text, delimiter, len(names)))
        for number, text in enumerate(lines[1:], 2)
        if text.strip()
    )
    return path, names, rows


def _first_undecodable(lines: list[bytes], encoding: str) -> tuple[int, UnicodeDecodeError] | None:
    """Return the number of the first line that is not text of an encoding and the error; None for none."""
    for number, line in enumerate(lines, 1):
        try:
            line.decode(encoding)
        except UnicodeDecodeError as error:
            return number, error
    return None


def parse_number(path: Path, line: int, column: str, text: str) -> float:
    """Return the number in a cell. **Raises:** ValueError, naming file, line and column."""
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{path}: line {line}: {column} = {_abbreviated(text)} is no number") from None


def parse_integer(path: Path, line: int, column: str, text: str) -> int:
    """Return the whole number in a cell. **Raises:** ValueError, naming file, line and column."""
    value = parse_number(path, line, column, text)
    if not (value.is_integer() and abs(value) <= MAX_EXACT_INTEGER):
        raise ValueError(f"{path}: line {line}: {column} = {_abbreviated(text)} is no whole number")
    return int(value)


def split_cells(path: Path, line: int, text: str, delimiter: str, columns: int | None = None) -> list[str]:
    """Return the cells of a line, of which there must be `columns` if that is given.

    **Raises:** ValueError, naming file and line.
    """
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


def _abbreviated(text: str) -> str:
    text = text.strip()
    return repr(text if len(text) <= 40 else text[:37] + "...")
