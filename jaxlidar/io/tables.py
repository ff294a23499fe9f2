"""Parts of lidars and scenes as plain tables (dicts, lists, numbers, strings), and back.

A table is a call: `kind` names a class or a function of jaxlidar (`jaxlidar.io.kinds`), the other keys are
its arguments. Tables are made from the classes' own fields, so that a new class needs nothing here.
"""

import difflib
import inspect
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxlidar._checks import is_traced, kind_of
from jaxlidar.io.kinds import (
    Argument,
    arguments_of,
    choices,
    current_kind,
    is_text,
    is_tuple,
    item_of,
    kinds,
    made,
    usual_of,
)

# Longer rows of numbers are kept as arrays, apart from the text.
LONGEST_ROW = 32
# What stands for None: TOML has no such value.
NOTHING = "none"

Arrays = Callable[[str | None, str], np.ndarray]


def table_of(value: Any, place: str, arrays: dict[str, np.ndarray]) -> Any:
    """A value as a plain one. Long and many-dimensional arrays go into `arrays` under the name of the place.

    **Raises:** TypeError, naming the place, for what no file can hold: classes and functions of one's own,
    and values that JAX is tracing.
    """
    if value is None:
        return NOTHING
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, str | int):
        return value
    if isinstance(value, float):
        return float(value)
    if is_traced(value):
        raise TypeError(f"{place} is {kind_of(value)}; a file can hold known numbers alone")
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return _numbers(np.asarray(value), place, arrays)
    if isinstance(value, Mapping):
        return {name: table_of(part, f"{place}.{name}", arrays) for name, part in value.items()}
    if isinstance(value, tuple | list):
        return [table_of(part, f"{place}.{i}", arrays) for i, part in enumerate(value)]
    name = type(value).__name__
    if kinds().get(name) is not type(value):
        what = "a function" if inspect.isroutine(value) else f"{kind_of(value)}, a class of your own"
        raise TypeError(
            f"{place} is {what}: a file cannot hold the code that makes it. Admissible is what jaxlidar "
            "exports; keep this scene as Python code, or pickle it"
        )
    parts = {
        key: table_of(getattr(value, argument.stored), f"{place}.{key}", arrays)
        for key, argument in arguments_of(type(value)).items()
    }
    defaults = {key: p.default for key, p in inspect.signature(type(value)).parameters.items()}
    # What is None is left out where it is None anyway.
    kept = {key: part for key, part in parts.items() if part != NOTHING or defaults[key] is not None}
    return {"kind": name, **kept} if kept else name


def _numbers(value: np.ndarray, place: str, arrays: dict[str, np.ndarray]) -> Any:
    if value.ndim > 1 or value.size > LONGEST_ROW:
        arrays[place] = value
        return {"array": place}
    if value.ndim == 0:
        return _digits(value)
    return [_digits(x) for x in value]


def _digits(x: Any) -> float | int:
    """The number whose digits, read in JAX's precision of now, give `x` again: the fewest that do."""
    if x.dtype != np.float32 or jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        return x.item()
    short = float(str(np.float32(x)))
    return short if np.float32(short) == x else x.item()


def value_of(table: Any, argument: Argument, place: str, arrays: Arrays, folder: Path) -> Any:
    """What a plain value stands for, as an argument; the inverse of `table_of`.

    `arrays` gives an array by file (None: that of the text) and name; paths are relative to `folder`.

    **Raises:** ValueError or TypeError, naming the place, for unknown kinds and arguments, with the nearest
    valid ones, for arguments that are missing, and for what the kind itself refuses.
    """
    annotation = argument.annotation
    if isinstance(table, str) and not is_text(annotation):
        if table == NOTHING:
            return None
        table = current_kind(table)
        if table in kinds():
            return _call(kinds()[table], {}, place, arrays, folder)
        raise ValueError(f"{place} = {table!r} is no kind; {nearest(table, kinds())}")
    if isinstance(table, list | tuple):
        item = argument._replace(annotation=item_of(annotation))
        items = [value_of(part, item, f"{place}.{i}", arrays, folder) for i, part in enumerate(table)]
        return tuple(items) if is_tuple(annotation) else items
    if not isinstance(table, Mapping):
        return table
    if "array" in table:
        check_keys(table, ("array", "file"), place)
        file, name = table.get("file"), table["array"]
        if not isinstance(name, str) or not isinstance(file, str | None):
            raise TypeError(f"{place}: array and file are {name!r} and {file!r}; admissible are two names")
        return arrays(file, name)
    if "kind" not in table:
        maker = usual_of(annotation)
        if maker is None:
            if any(_is_mapping(choice) for choice in choices(annotation)):
                return dict(table)
            raise ValueError(f"{place}: kind is missing: which class it is, or which function makes it")
        return _call(maker, table, place, arrays, folder)
    kind = table["kind"]
    kind = current_kind(kind) if isinstance(kind, str) else kind
    if not isinstance(kind, str) or kind not in kinds():
        raise ValueError(f"{place}.kind = {kind!r} is no kind; {nearest(str(kind), kinds())}")
    given = {key: part for key, part in table.items() if key != "kind"}
    return _call(kinds()[kind], given, place, arrays, folder)


def _is_mapping(annotation: Any) -> bool:
    origin = getattr(annotation, "__origin__", annotation)
    return isinstance(origin, type) and issubclass(origin, Mapping)


def _call(
    maker: Callable[..., Any], table: Mapping[str, Any], place: str, arrays: Arrays, folder: Path
) -> Any:
    known = arguments_of(maker)
    check_keys(table, known, place)
    missing = [name for name, argument in known.items() if argument.required and name not in table]
    if missing:
        raise ValueError(f"{place}: {', '.join(missing)} of {maker.__qualname__} {_are(missing)} missing")
    given = {
        name: value_of(part, known[name], f"{place}.{name}", arrays, folder) for name, part in table.items()
    }
    if isinstance(given.get("path"), str):
        given["path"] = folder / given["path"]
    try:
        return made(maker, given)
    except (ValueError, TypeError) as error:
        raise type(error)(f"{place}: {error}") from error


def _are(names: list[str]) -> str:
    return "are" if len(names) > 1 else "is"


def check_keys(table: Mapping[str, Any], known: Iterable[str], place: str) -> None:
    """Refuse keys that are not known, with the nearest that are."""
    for key in table:
        if key not in known:
            where = f"{place}.{key}" if place else key
            raise ValueError(f"{where} is not known; {nearest(key, known)}")


def nearest(name: str, known: Iterable[str]) -> str:
    """What may have been meant."""
    lower = {k.lower(): k for k in known}
    close = difflib.get_close_matches(name.lower(), lower, n=3, cutoff=0.5)
    if close:
        return f"the nearest {'are' if len(close) > 1 else 'is'} {', '.join(lower[c] for c in close)}"
    listed = sorted(lower.values())
    return f"admissible are {', '.join(listed)}" if listed else "none is admissible"
