"""Names of columns in tables: those that nearly have a name that is read."""

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence

from jaxlidar._fields.checks import warn_user

# Names that agree to this ratio are nearly the same (`difflib.SequenceMatcher`).
_SIMILARITY = 0.8
# Names, and beginnings of names, that are shorter than this say nothing on their own.
_LEAST_LETTERS = 3


def warn_unread_columns(location: str, unread: Iterable[str], missing: Mapping[str, Sequence[str]]) -> None:
    """Warn of columns that are not read although they nearly have the name of a quantity that is missing.

    **Arguments:**

    - `location`: the table, for the message.
    - `unread`: names of columns.
    - `missing`: for each quantity without a column, the names by which it is known, in lower case and without
      spaces.

    **Warns:** UserWarning with the columns, and the names that would be read.
    """
    similar = {}
    for column in unread:
        words = re.findall(r"[a-z]+", column.lower())
        bare = "".join(words)
        for quantity, known_names in missing.items():
            if any(_is_similar(bare, words, name) for name in known_names):
                similar[column] = quantity
                break
    if similar:
        columns = ", ".join(
            f"{column!r} (as {missing[quantity][0]}?)" for column, quantity in similar.items()
        )
        warn_user(f"{location}: columns are not read: {columns}. Rename those that are meant", UserWarning)


def _is_similar(bare: str, words: Sequence[str], name: str) -> bool:
    if name in words[:1]:
        return True
    if min(len(bare), len(name)) < _LEAST_LETTERS:
        return False
    begins = bare.startswith(name) or name.startswith(bare)
    return begins or difflib.SequenceMatcher(None, bare, name).ratio() >= _SIMILARITY
