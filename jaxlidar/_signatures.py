"""Signatures that fit on a screen, for `help`, notebooks and the API reference.

jaxtyping and typing expand their aliases when a module is imported: `Float[ArrayLike, "bins"]` becomes a
union of array types that fills several lines for each argument. Only the displayed signature
(`__signature__`) is changed here; `__annotations__`, which type checkers and `jaxlidar.io` read, stay as they
are.
"""

import collections.abc
import inspect
import types
import typing
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import AbstractArray, ArrayLike, PRNGKeyArray

Exported = TypeVar("Exported", bound=Callable)

# A longer annotation is shown by its outermost type; a signature whose text is longer shows no types at all.
MAX_ANNOTATION = 60
MAX_SIGNATURE = 600

# Unions that source code writes by these names.
_ALIASES = {"ArrayLike": ArrayLike, "PRNGKeyArray": PRNGKeyArray}


class _ShortName:
    """An annotation that prints as a given text, without quotes.

    A plain string would be printed in quotes, and pdoc would evaluate it back to the long type.
    """

    def __init__(self, text: str):
        self.text = text

    def __repr__(self) -> str:
        return self.text

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ShortName) and other.text == self.text

    def __hash__(self) -> int:
        return hash(self.text)


def briefly(exported: Exported) -> Exported:
    """Shorten the signature that `help` shows of a function, or of a class and its public methods.

    A function shows its types by short names, such as `Float[ArrayLike, "bins"]` and `Lidar`. A class shows
    its arguments with their defaults alone: the types of its fields are those after conversion, and its
    docstring states what it admits.

    As a decorator of a class it also hides these types from jaxtyping's import hook, which would otherwise
    check arguments against them: constructors check and convert their arguments, and compiled programs build
    modules of shapes in the place of arrays.

    **Arguments:**

    - `exported`: a function or a class.

    **Returns:** `exported` itself.

    **Example:**

    >>> import inspect, jax
    >>> from jaxtyping import ArrayLike, Float
    >>> from jaxlidar.extend import briefly
    >>> @briefly
    ... def total(power: Float[ArrayLike, " bins"]) -> jax.Array: ...
    >>> print(inspect.signature(total))
    (power: Float[ArrayLike, "bins"]) -> Array
    """
    target: Any = exported
    if isinstance(target, type):
        _shorten_class(target)
    else:
        _shorten(target)
    return exported


def shorten_signatures(namespace: Mapping[str, Any], *, converters: Collection[str] = ()) -> None:
    """Apply `briefly` to all functions and classes that a package exports.

    **Arguments:**

    - `namespace`: `globals()` of the package, with `__all__`. Call it after all imports.
    - `converters`: names of functions that keep their signatures, as they serve as converters of fields:
      equinox takes the type of a constructor's argument from the signature of its converter. Default ().
    """
    for name in namespace["__all__"]:
        exported = namespace.get(name)
        # Aliases of types, such as `Vec`, can be called but have no signature.
        if callable(exported) and typing.get_origin(exported) is None and name not in converters:
            briefly(exported)


def _shorten_class(cls: type) -> None:
    # Members that the class defines itself: those of its bases belong to other public classes.
    for name in vars(cls):
        member = getattr(cls, name)
        if name in ("__init__", "__new__"):
            _shorten(member, show_types=False)
        elif (not name.startswith("_") or name == "__call__") and inspect.isroutine(member):
            _shorten(member)


def _shorten(function: Any, *, show_types: bool = True) -> None:
    """Set the displayed signature of a Python function, below the wrappers of jit and of class methods."""
    function = inspect.unwrap(getattr(function, "__func__", function), stop=inspect.isfunction)
    if not inspect.isfunction(function):
        return
    signature = inspect.signature(function)
    short = _with_annotations(signature, _short_annotation)
    if not show_types or len(str(short)) > MAX_SIGNATURE:
        short = _with_annotations(signature, lambda annotation: inspect.Signature.empty)
    function.__signature__ = short  # pyright: ignore[reportFunctionMemberAccess]


def _with_annotations(signature: inspect.Signature, convert: Callable[[Any], Any]) -> inspect.Signature:
    parameters = [p.replace(annotation=convert(p.annotation)) for p in signature.parameters.values()]
    return inspect.Signature(parameters, return_annotation=convert(signature.return_annotation))


def _short_annotation(annotation: Any) -> Any:
    if annotation is inspect.Signature.empty or isinstance(annotation, _ShortName):
        return annotation
    text = short_type(annotation)
    if len(text) > MAX_ANNOTATION:
        origin = typing.get_origin(annotation)
        if origin in (None, typing.Union, types.UnionType):
            return inspect.Signature.empty
        text = origin.__name__
    return _ShortName(text)


def short_type(annotation: Any) -> str:
    """Name a type as source code does: without modules, and with the aliases of jaxtyping folded back."""
    if annotation is None or annotation is type(None):
        return "None"
    if annotation is ...:
        return "..."
    if isinstance(annotation, str):
        return annotation
    if isinstance(annotation, typing.ForwardRef):
        return annotation.__forward_arg__
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is None:
        if _is_array_type(annotation):
            return _array_type(annotation, short_type(annotation.array_type))
        # The name of `jax.Array` has a module in it.
        return getattr(annotation, "__name__", str(annotation)).rpartition(".")[2]
    if origin in (typing.Union, types.UnionType):
        return _short_union(arguments)
    if origin is typing.Literal:
        return f"Literal[{', '.join(map(repr, arguments))}]"
    if origin is collections.abc.Callable:
        return "Callable"
    return f"{origin.__name__}[{', '.join(map(short_type, arguments))}]"


def _short_union(members: Sequence[Any]) -> str:
    """Name a union by its members, or by the alias that stands for several of them.

    jaxtyping makes of `Float[ArrayLike, "bins"]` an array type for JAX, one for NumPy, and the types of
    scalars where the shape admits them.
    """
    names = {member: short_type(member) for member in members}
    for alias, union in _ALIASES.items():
        aliased = set(typing.get_args(union))
        if aliased.issubset(members):
            names |= dict.fromkeys(aliased, alias)
    arrays: dict[str, set[Any]] = {}
    for member in filter(_is_array_type, members):
        arrays.setdefault(_array_type(member, "ArrayLike"), set()).add(member)
    for alias, array_types in arrays.items():
        if {jax.Array, np.ndarray} <= {member.array_type for member in array_types}:
            scalars = set(typing.get_args(ArrayLike)).intersection(members)
            names |= dict.fromkeys(array_types | scalars, alias)
    return " | ".join(dict.fromkeys(names[member] for member in members))


def _is_array_type(annotation: Any) -> bool:
    return (
        isinstance(annotation, type)
        and issubclass(annotation, AbstractArray)
        and annotation is not AbstractArray
    )


def _array_type(annotation: Any, array: str) -> str:
    """Name a jaxtyping array type with `array` in the place of its array class."""
    element = annotation.__name__.partition("[")[0]
    return f'{element}[{array}, "{annotation.dim_str}"]'
