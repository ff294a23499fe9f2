"""Lidars and scenes as TOML: from objects to tables to text, and back.

A table (a dict of numbers, strings, lists and tables) is a call: `kind` names a class or a function of
jaxlidar (`jaxlidar.results.kinds`), the other keys are its arguments. Tables follow from the classes' own
fields, so a new class needs no code here.
"""

import difflib
import inspect
import tomllib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxlidar._fields.checks import is_traced, kind_of, required_for
from jaxlidar.results.kinds import (
    ALTERNATIVE_ARGUMENTS,
    Argument,
    admits_mapping,
    admits_numbers_alone,
    admits_text,
    admits_tuple,
    argument_value,
    arguments_of,
    call_kind,
    default_kind,
    item_annotation,
    kinds,
)

# Longer rows of numbers are arrays, which lie apart from the text.
_MAX_ROW_LENGTH = 32
# The string that stands for None: TOML has no such value.
_NONE = "none"
_HEADER = (
    "A case for jaxlidar, which jaxlidar.io.read_case reads. A table is a call: kind names a class or",
    "function, the other keys are its arguments. The schema is in jaxlidar/formats/README.md.",
)

# Reads an array by the file that it lies in, None for that of the text, and its name.
ArrayReader = Callable[[str | None, str], np.ndarray]


# -- objects and tables ------------------------------------------------------------------------------------


def table_of(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    """Return a value as a table, a list, a number or a string.

    Long and many-dimensional arrays are added to `arrays` under `path`, the path of the value in the case,
    such as "scene.canopy.voxels.leaf".

    **Raises:** TypeError, naming the path, for values that no file can hold: classes and functions of your
    own, and values that JAX is tracing.
    """
    if value is None:
        return _NONE
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, str | int):
        return value
    if isinstance(value, float):
        return float(value)
    if is_traced(value):
        raise TypeError(f"{path} is {kind_of(value)}; a file can hold known numbers alone")
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return _array_table(np.asarray(value), path, arrays)
    if isinstance(value, Mapping):
        return {name: table_of(item, f"{path}.{name}", arrays) for name, item in value.items()}
    if isinstance(value, tuple | list):
        return [table_of(item, f"{path}.{i}", arrays) for i, item in enumerate(value)]
    name = type(value).__name__
    if kinds().get(name) is not type(value):
        author = "" if type(value).__module__.startswith("jaxlidar.") else ", a class of your own"
        description = "a function" if inspect.isroutine(value) else f"{kind_of(value)}{author}"
        raise TypeError(
            f"{path} is {description}: a file cannot hold the code that makes it. Admissible is what "
            "jaxlidar exports; keep this scene as Python code, or pickle it"
        )
    entries = {
        key: table_of(argument_value(value, key, argument), f"{path}.{key}", arrays)
        for key, argument in arguments_of(type(value)).items()
        if (type(value), key) not in ALTERNATIVE_ARGUMENTS
    }
    defaults = {key: p.default for key, p in inspect.signature(type(value)).parameters.items()}
    # None is left out where it is the default.
    entries = {key: entry for key, entry in entries.items() if entry != _NONE or defaults[key] is not None}
    return {"kind": name, **entries} if entries else name


def _array_table(value: np.ndarray, path: str, arrays: dict[str, np.ndarray]) -> Any:
    """Return a short array as numbers, and a long one as a reference by its path."""
    if value.ndim > 1 or value.size > _MAX_ROW_LENGTH:
        arrays[path] = value
        return {"array": path}
    if value.ndim == 0:
        return _shortest_number(value)
    return [_shortest_number(x) for x in value]


def _shortest_number(x: Any) -> float | int:
    """Return the number with the fewest digits that JAX, in its present precision, reads as `x` again."""
    if x.dtype != np.float32 or jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        return x.item()
    # 0.1 in single precision is 0.10000000149 in double; its own shortest digits are 0.1.
    short = float(str(np.float32(x)))
    return short if np.float32(short) == x else x.item()


def value_of(table: Any, argument: Argument, path: str, read_array: ArrayReader, folder: Path) -> Any:
    """Return the value of a table, a list, a number or a string as an argument; the inverse of `table_of`.

    **Arguments:** `path`: that of the value in the case. `read_array`: reads the arrays that lie apart.
    `folder`: the folder to which paths in the table are relative.

    **Raises:** ValueError or TypeError, naming the path, for unknown kinds and arguments, with the nearest
    valid ones, for missing arguments, and for what the kind itself refuses.
    """
    annotation = argument.annotation
    if isinstance(table, str) and table != _NONE and admits_numbers_alone(annotation):
        # Names of all kinds would not help here.
        raise ValueError(f"{path} = {table!r} is a text; admissible is a number, without quotes")
    if isinstance(table, str) and not admits_text(annotation):
        return _kind_without_arguments(table, path, read_array, folder)
    if isinstance(table, list | tuple):
        item = argument._replace(annotation=item_annotation(annotation))
        items = [value_of(entry, item, f"{path}.{i}", read_array, folder) for i, entry in enumerate(table)]
        return tuple(items) if admits_tuple(annotation) else items
    if not isinstance(table, Mapping):
        return table
    if "array" in table:
        check_keys(table, ("array", "file"), path)
        file, name = table.get("file"), table["array"]
        if not isinstance(name, str) or not isinstance(file, str | None):
            raise TypeError(f"{path}: array and file are {name!r} and {file!r}; admissible are two names")
        return read_array(file, name)
    if "kind" not in table:
        kind = default_kind(annotation)
        # Where a mapping is admissible too, such as habits by species, keys tell which it is.
        if kind is not None and (not admits_mapping(annotation) or set(table) <= set(arguments_of(kind))):
            return _call(kind, table, path, read_array, folder, annotation)
        if admits_mapping(annotation):
            # Such as reflectances by material, of which each may be a spectrum.
            item = argument._replace(annotation=Any)
            return {
                name: value_of(entry, item, f"{path}.{name}", read_array, folder)
                for name, entry in table.items()
            }
        raise ValueError(f"{path}: kind is missing: which class it is, or which function makes it")
    name = table["kind"]
    if not isinstance(name, str) or name not in kinds():
        raise ValueError(f"{path}.kind = {name!r} is no kind; {nearest(str(name), kinds())}")
    arguments = {key: entry for key, entry in table.items() if key != "kind"}
    return _call(kinds()[name], arguments, path, read_array, folder, annotation)


def _kind_without_arguments(name: str, path: str, read_array: ArrayReader, folder: Path) -> Any:
    """Return the result of a kind whose name stands for a table without arguments; None for "none"."""
    if name == _NONE:
        return None
    if name not in kinds():
        raise ValueError(f"{path} = {name!r} is no kind; {nearest(name, kinds())}")
    return _call(kinds()[name], {}, path, read_array, folder)


def _call(
    kind: Callable[..., Any],
    table: Mapping[str, Any],
    path: str,
    read_array: ArrayReader,
    folder: Path,
    annotation: Any = Any,
) -> Any:
    """Return the result of a class or function with the arguments in a table, as `annotation` admits it.

    **Raises:** as `value_of`.
    """
    signature = arguments_of(kind)
    check_keys(table, signature, path)
    missing = [name for name, argument in signature.items() if argument.required and name not in table]
    if missing:
        verb = "are" if len(missing) > 1 else "is"
        raise ValueError(f"{path}: {', '.join(missing)} of {kind.__qualname__} {verb} missing")
    arguments = {
        name: value_of(entry, signature[name], f"{path}.{name}", read_array, folder)
        for name, entry in table.items()
    }
    if isinstance(arguments.get("path"), str):
        arguments["path"] = folder / arguments["path"]
    try:
        return call_kind(kind, arguments, annotation)
    except (ValueError, TypeError) as error:
        raise type(error)(f"{path}: {error}") from error


def with_references(tables: Mapping[str, Any]) -> dict[str, Any]:
    """Return tables in which every reference, {same_as = "scene.ground"}, is the entry that it names.

    **Raises:** ValueError, naming the place of the reference, for one that names no entry, or itself.
    """

    def entry_at(name: str, path: str) -> Any:
        entry: Any = tables
        for key in name.split("."):
            if isinstance(entry, list) and key.isdigit() and int(key) < len(entry):
                entry = entry[int(key)]
            elif isinstance(entry, Mapping) and key in entry:
                entry = entry[key]
            else:
                raise ValueError(f"{path}.same_as = {name!r} names no entry of the file")
        return entry

    def resolved(entry: Any, path: str, pending: tuple[str, ...]) -> Any:
        if isinstance(entry, list):
            return [resolved(item, f"{path}.{i}", pending) for i, item in enumerate(entry)]
        if not isinstance(entry, Mapping):
            return entry
        if "same_as" not in entry:
            return {key: resolved(item, f"{path}.{key}".lstrip("."), pending) for key, item in entry.items()}
        check_keys(entry, ("same_as",), path)
        name = entry["same_as"]
        if not isinstance(name, str):
            raise TypeError(f"{path}.same_as is {kind_of(name)}; admissible is the path of an entry")
        # An entry that holds the reference, or leads back to it, would have no end.
        if name in pending or f"{path}.".startswith(f"{name}."):
            raise ValueError(f"{path}.same_as = {name!r} refers to itself")
        return resolved(entry_at(name, path), path, (*pending, name))

    return resolved(tables, "", ())


def check_keys(table: Mapping[str, Any], admissible: Iterable[str], path: str) -> None:
    """Refuse keys that are not admissible. **Raises:** ValueError with the nearest ones that are."""
    for key in table:
        if key not in admissible:
            key_path = f"{path}.{key}" if path else key
            raise ValueError(f"{key_path} is not known; {nearest(key, admissible)}")


def nearest(name: str, admissible: Iterable[str]) -> str:
    """Return the end of a sentence with the admissible names nearest to a wrong one, or with all of them."""
    by_lower = {candidate.lower(): candidate for candidate in admissible}
    close = difflib.get_close_matches(name.lower(), by_lower, n=3, cutoff=0.5)
    if close:
        verb = "are" if len(close) > 1 else "is"
        return f"the nearest {verb} {', '.join(by_lower[lower] for lower in close)}"
    names = sorted(by_lower.values())
    return f"admissible are {', '.join(names)}" if names else "none is admissible"


# -- tables and text ---------------------------------------------------------------------------------------


def text_of(tables: Mapping[str, tuple[dict[str, Any], Callable[..., Any]]]) -> str:
    """Return named tables as TOML, with units as comments; each comes with the class or function of its keys.

    **Raises:** ImportError where tomlkit is not installed.
    """
    with required_for("writing TOML"):
        import tomlkit
    document = tomlkit.document()
    for line in _HEADER:
        document.add(tomlkit.comment(line))
    for name, (table, kind) in tables.items():
        document.add(tomlkit.nl())
        document.add(name, _toml_table(table, kind))
    return tomlkit.dumps(document)


def _toml_table(table: Mapping[str, Any], kind: Callable[..., Any] | None) -> Any:
    """Return a table of tomlkit with units as comments."""
    import tomlkit

    kind = kinds().get(table.get("kind", ""), kind)
    arguments: Mapping[str, Argument] = {} if kind is None else arguments_of(kind)
    toml_table = tomlkit.table()
    # Plain values come first: in TOML, a key after the head of a nested table belongs to that table.
    for nested in (False, True):
        for key, value in table.items():
            if _is_nested(value) != nested:
                continue
            item = _toml_item(value)
            if not nested and key in arguments and arguments[key].unit and not isinstance(value, str):
                item.comment(arguments[key].unit)
            toml_table.add(key, item)
    return toml_table


def _is_nested(value: Any) -> bool:
    """Return True for tables, and lists of tables; references to arrays are written in one line."""
    if isinstance(value, Mapping):
        return "array" not in value
    return isinstance(value, list) and any(map(_is_nested, value))


def _toml_item(value: Any) -> Any:
    import tomlkit

    if isinstance(value, list) and _is_nested(value):
        tables = tomlkit.aot()
        for table in value:
            tables.append(_toml_table(table, None))
        return tables
    if isinstance(value, Mapping) and _is_nested(value):
        return _toml_table(value, None)
    if isinstance(value, Mapping):
        reference = tomlkit.inline_table()
        reference.update(value)
        return reference
    return tomlkit.item(value)


def tables_of(text: str, path: Path) -> dict[str, Any]:
    """Return the tables of a TOML text; `path` names its file in messages.

    **Raises:** ValueError, naming file, line and column, for a text that is no TOML.
    """
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: no TOML: {error}") from error
