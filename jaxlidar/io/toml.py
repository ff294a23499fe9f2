"""Cases as TOML: the text of a file, with units as comments, from plain tables."""

import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from jaxlidar.io.kinds import Argument, arguments_of, kinds

HEAD = (
    "A case for jaxlidar, which jaxlidar.io.read_case reads. A table is a call: kind names a class or",
    "function, the other keys are its arguments. The schema is in jaxlidar/io/README.md.",
)


def text_of(tables: Mapping[str, tuple[dict[str, Any], Callable[..., Any]]]) -> str:
    """TOML of named tables, each with the class or function whose arguments it has.

    **Raises:** ImportError where tomlkit is not installed.
    """
    try:
        import tomlkit
    except ImportError as error:
        raise ImportError("writing TOML needs tomlkit: pip install 'jaxlidar[io]'") from error
    document = tomlkit.document()
    for line in HEAD:
        document.add(tomlkit.comment(line))
    for name, (table, maker) in tables.items():
        document.add(tomlkit.nl())
        document.add(name, _table(table, maker))
    return tomlkit.dumps(document)


def _table(table: Mapping[str, Any], maker: Callable[..., Any] | None) -> Any:
    """A table with units as comments. Plain values come first: what follows a table belongs to it."""
    import tomlkit

    maker = kinds().get(table.get("kind", ""), maker)
    known: Mapping[str, Argument] = {} if maker is None else arguments_of(maker)
    written = tomlkit.table()
    for nested in (False, True):
        for key, value in table.items():
            if _is_nested(value) != nested:
                continue
            item = _item(value)
            if not nested and key in known and known[key].unit and not isinstance(value, str):
                item.comment(known[key].unit)
            written.add(key, item)
    return written


def _is_nested(value: Any) -> bool:
    if isinstance(value, Mapping):
        return "array" not in value
    return isinstance(value, list) and any(map(_is_nested, value))


def _item(value: Any) -> Any:
    import tomlkit

    if isinstance(value, list) and _is_nested(value):
        tables = tomlkit.aot()
        for part in value:
            tables.append(_table(part, None))
        return tables
    if isinstance(value, Mapping) and _is_nested(value):
        return _table(value, None)
    if isinstance(value, Mapping):
        reference = tomlkit.inline_table()
        reference.update(value)
        return reference
    return tomlkit.item(value)


def tables_of(text: str, path: Path) -> dict[str, Any]:
    """The tables of a TOML text; `path` names it in messages.

    **Raises:** ValueError, naming file, line and column, for what is no TOML.
    """
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: no TOML: {error}") from error
