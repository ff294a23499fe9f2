"""Names of columns in tables: their quantities and units, and names that are nearly one that is read."""

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxlidar._fields.checks import warn_user
from jaxlidar._fields.units import unit_size

# A name, and a unit in brackets or after an underscore.
_NAME_AND_UNIT = re.compile(r"\s*(.*?)\s*(?:[\[(]\s*([^\])]*?)\s*[\])]|_(m|cm|mm|ft|m2))?\s*$", re.DOTALL)
# Coordinates of a table: those of a map, or those on Earth.
_PAIRS = (("x", "y"), ("longitude", "latitude"))
# Names that agree to this ratio are nearly the same (`difflib.SequenceMatcher`).
_SIMILARITY = 0.8
# Names, and beginnings of names, that are shorter than this say nothing on their own.
_LEAST_LETTERS = 3


class NamedColumn(NamedTuple):
    """A column of a table: its index, its name as in the table, and the unit in that name or None."""

    index: int
    name: str
    unit: str | None

    def size(self, location: str, kind: str) -> float:
        """Return the size of the unit in m, m2, degrees or s, 1 without one. **Raises:** as `unit_size`."""
        size = unit_size(kind, f"{location}: {self.name!r}", self.unit)
        if size is None:
            return 1.0
        return float(np.rad2deg(size)) if kind == "angle" else size


def plain_name(name: str) -> str:
    """Return a name in lower case, without spaces, underscores, hyphens and dots."""
    return re.sub(r"[\s_\-.]", "", name.lower())


def name_and_unit(name: str) -> tuple[str, str | None]:
    """Return the plain name of a column without its unit, and the unit."""
    match = _NAME_AND_UNIT.match(name)
    assert match is not None
    return plain_name(match[1]), match[2] or match[3]


def match_columns(
    location: str, names: Sequence[str], known: Mapping[str, Sequence[str]]
) -> dict[str, NamedColumn]:
    """Return the columns of a table by quantity.

    **Arguments:** `location`: the table, for messages. `names`: its columns. `known`: plain names of each
    quantity.

    **Raises:** ValueError for a quantity that several columns may be.
    """
    plain = [name_and_unit(name) for name in names]
    columns = {}
    for quantity, admissible in known.items():
        matches = [
            NamedColumn(i, names[i].strip(), unit)
            for i, (name, unit) in enumerate(plain)
            if name in admissible
        ]
        # A column again in another unit is not needed.
        without_unit = [column for column in matches if column.unit is None]
        matches = without_unit if len(without_unit) == 1 else matches
        if len(matches) > 1:
            raise ValueError(
                f"{location}: {quantity} may be any of the columns "
                f"{', '.join(repr(column.name) for column in matches)}; remove or rename all but one"
            )
        if matches:
            columns[quantity] = matches[0]
    return columns


def check_columns(
    location: str,
    names: Sequence[str],
    columns: Mapping[str, NamedColumn],
    known: Mapping[str, Sequence[str]],
    required: Iterable[str] = (),
) -> None:
    """Check the columns that `match_columns` found.

    **Arguments:** as of `match_columns`. `required`: quantities that the table must have besides x and y, or
    longitude and latitude.

    **Raises:** ValueError for quantities that are missing, and for coordinates of both kinds.

    **Warns:** UserWarning for columns that are not read although they nearly have the name of a quantity that
    is missing, with the name that would be read.
    """
    pairs = [[axis for axis in pair if axis in columns] for pair in _PAIRS]
    if all(pairs):
        of_map, of_earth = (" and ".join(repr(columns[axis].name) for axis in pair) for pair in pairs)
        raise ValueError(f"{location}: columns {of_map} of a map, and {of_earth} in degrees; remove one pair")
    for quantity in (*_PAIRS[bool(pairs[1])], *required):
        if quantity not in columns:
            instead = " (or longitude and latitude)" if "longitude" in known and not any(pairs) else ""
            raise ValueError(
                f"{location}: no column {quantity}{instead}; its name may be {', '.join(known[quantity])}; "
                f"there are {', '.join(names)}"
            )
    read = [column.index for column in columns.values()]
    missing = [q for q in known if q not in columns and not any(q in pair for pair in _PAIRS)]
    similar = []
    for i, name in enumerate(names):
        likely = [q for q in missing if i not in read and _is_similar(name, known[q])]
        if likely:
            similar.append(f"{name.strip()!r} (as {known[likely[0]][0]}?)")
    if similar:
        warn_user(f"{location}: columns are not read: {', '.join(similar)}. Rename those that are meant")


def _is_similar(name: str, known_names: Sequence[str]) -> bool:
    words = re.findall(r"[a-z]+", name.lower())
    bare = "".join(words)
    for known in known_names:
        if known in words[:1]:
            return True
        if min(len(bare), len(known)) >= _LEAST_LETTERS:
            begins = bare.startswith(known) or known.startswith(bare)
            if begins or difflib.SequenceMatcher(None, bare, known).ratio() >= _SIMILARITY:
                return True
    return False
