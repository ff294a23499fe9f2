"""Fingerprints: digests of all that a result depends on, equal in any process for equal contents.

Arrays are told by type, shape and every bit; instances of dataclasses by class and fields, static ones
included, but not by fields that do not count in comparisons; other objects by what pickle would keep of them.

What an installed package defines is told by name. Functions and classes of one's own are told by their code,
with its constants, defaults, closures, and the globals that it names. A module of one's own is told by its
file: for `helpers.double(x)`, that of `helpers`, but not the files that `helpers` imports in turn.
"""

import copyreg
import dataclasses
import dis
import hashlib
import importlib.metadata
import inspect
import pickle
import platform
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import BuiltinFunctionType, CellType, CodeType, FunctionType, ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

# Another release of these may give other results.
_PACKAGES = ("jaxlidar", "jax", "jaxlib", "equinox", "optimistix", "lineax", "numpy")
_BY_NAME = {"inversion", *_PACKAGES, *sys.stdlib_module_names} - {"__main__"}
# Results depend on these as well.
_SETTINGS = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
)

# Digests of functions and classes met so far, by id; with them, so that no other object gets the id.
_Told = dict[int, tuple[Any, str]]


def fingerprint(parts: Mapping[str, Any]) -> dict[str, str]:
    """A digest of each part of a problem, and the releases and settings with which it is solved.

    **Raises:** TypeError for a part that has no content to tell, such as an open file.
    """
    found = {}
    for name, part in parts.items():
        try:
            found[name] = digest_of(part)
        except (TypeError, RecursionError) as error:
            raise TypeError(f"{name} cannot be compared with that of another run: {error}") from error
    found |= {f"version of {name}": version_of(name) for name in _PACKAGES}
    found["version of python"] = ".".join(platform.python_version_tuple()[:2])
    found |= {name: str(getattr(jax.config, name, None)) for name in _SETTINGS}
    return found | {"jax.default_backend()": jax.default_backend()}


def version_of(name: str) -> str:
    """Return the version of an installed package, by its name."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def digest_of(x: Any, told: _Told | None = None) -> str:
    """The digest of anything. **Raises:** TypeError for what has no content to tell, such as an open file."""
    told = {} if told is None else told
    by_code = isinstance(x, FunctionType | type)
    if by_code:
        if id(x) in told:
            return told[id(x)][1]
        # Code may name itself.
        told[id(x)] = x, f"number {len(told)}"
    head, parts = _apart(x)
    digest = hashlib.sha256(repr(head).encode())
    if isinstance(x, set | frozenset):
        digest.update("\n".join(sorted(digest_of(part) for part in parts)).encode())
    else:
        digest.update("\n".join(digest_of(part, told) for part in parts).encode())
    if by_code:
        told[id(x)] = x, digest.hexdigest()
    return digest.hexdigest()


def _apart(x: Any) -> tuple[Any, list[Any]]:
    """What tells a thing by itself, and the parts of which it is made."""
    match x:
        case None | bool() | int() | float() | complex() | str() | bytes():
            return (type(x).__qualname__, x), []
        case jax.Array() if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return str(jax.random.key_impl(x)), [jax.random.key_data(x)]
        case jax.Array() | np.ndarray() | np.generic():
            a = np.asarray(x)
            if a.dtype.hasobject:
                return ("objects", a.shape), list(a.flat)
            return (str(a.dtype), a.shape, hashlib.sha256(a.tobytes()).hexdigest()), []
        case dict():
            return tuple(map(repr, x)), list(x.values())
        case tuple() | list() | set() | frozenset():
            return type(x).__qualname__, list(x)
        case ModuleType():
            installed = _is_installed(x.__name__)
            return (x.__name__, _release_of(x.__name__) if installed else _file_of(x)), []
        case type() | FunctionType() | BuiltinFunctionType() if _is_installed(x.__module__):
            # What a package's function has made may hold one's own.
            held = (getattr(x, "__closure__", None) or ()) if "<locals>" in x.__qualname__ else ()
            return (x.__module__, x.__qualname__, _release_of(x.__module__)), [*map(_content, held)]
        case type():
            return x.__qualname__, list(_members(x))
        case FunctionType():
            names = [n for n in _globals_of(x.__code__) if n in x.__globals__]
            used = [*map(_content, x.__closure__ or ()), *(x.__globals__[n] for n in names)]
            return (x.__qualname__, names), [x.__code__, x.__defaults__, x.__kwdefaults__, *used]
        case CodeType():
            names = x.co_names, x.co_varnames, x.co_freevars, x.co_cellvars, x.co_flags, x.co_exceptiontable
            return (x.co_code, *names), list(x.co_consts)
    if dataclasses.is_dataclass(x):
        fields = [f.name for f in dataclasses.fields(x) if f.compare]
        return fields, [type(x), *(getattr(x, name) for name in fields)]
    if callable(x) and hasattr(x, "__wrapped__"):
        # Such as the rules of `jax.custom_jvp`.
        public = {n: part for n, part in getattr(x, "__dict__", {}).items() if not n.startswith("_")}
        return "wrapped", [type(x), x.__wrapped__, public]
    try:
        reduce = copyreg.dispatch_table.get(type(x))
        kept = x.__reduce_ex__(2) if reduce is None else reduce(x)
    except (TypeError, pickle.PicklingError):
        raise TypeError(f"the content of a {type(x).__qualname__} is not known") from None
    if isinstance(kept, str):
        return kept, [type(x)]
    # State, then items, which come as iterators.
    return "object", [type(x), *(list(part) if isinstance(part, Iterator) else part for part in kept)]


def _is_installed(module: str | None) -> bool:
    """Whether a module is of an installed package, which its release stands for."""
    module = module or "builtins"
    place = getattr(sys.modules.get(module), "__file__", None) or ""
    return module.partition(".")[0] in _BY_NAME or "site-packages" in place or "dist-packages" in place


def _release_of(module: str | None) -> str:
    """The release of an installed package, but for those of which the fingerprint has it in any case."""
    package = (module or "builtins").partition(".")[0]
    return "" if package in _BY_NAME else version_of(package)


def _file_of(module: ModuleType) -> bytes:
    """The content of a module's file, where it has one."""
    place = getattr(module, "__file__", None)
    return Path(place).read_bytes() if place else b""


def _members(kind: type) -> Iterator[Any]:
    """Bases, methods and constants of a class."""
    yield from kind.__bases__
    for name, member in sorted(vars(kind).items()):
        if isinstance(member, staticmethod | classmethod):
            member = member.__func__
        if isinstance(member, property):
            member = member.fget
        if inspect.isfunction(member) or not (name.startswith("__") or name == "_abc_impl"):
            yield from (name, member)


def _content(cell: CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:
        return "not set yet"


def _globals_of(code: CodeType) -> list[str]:
    """Names of the globals that code uses, that of nested functions included."""
    names = {i.argval for i in dis.get_instructions(code) if i.opname == "LOAD_GLOBAL"}
    for const in code.co_consts:
        if isinstance(const, CodeType):
            names.update(_globals_of(const))
    return sorted(names)
