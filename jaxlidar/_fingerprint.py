"""Fingerprints: digests of everything that a result depends on, equal in any process for equal contents.

Arrays enter a digest by type, shape and every bit; instances of dataclasses by class and fields, static ones
included, but without fields that do not count in comparisons; other objects by what pickle would store.

Functions and classes of installed packages enter by name. Those of the user enter by their code, with its
constants, defaults, closures, and the globals and imports that it names. A module of the user enters by its
file and those of all modules of the user that it imports, directly or by way of others.
"""

import copyreg
import dataclasses
import dis
import hashlib
import importlib.metadata
import importlib.util
import inspect
import pickle
import platform
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import BuiltinFunctionType, CellType, CodeType, FunctionType, ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

# Another release of these may give other results.
_PACKAGES = ("jaxlidar", "jax", "jaxlib", "equinox", "optimistix", "lineax", "numpy")
_INSTALLED = {"inversion", *_PACKAGES, *sys.stdlib_module_names} - {"__main__"}
# Settings of JAX that results depend on.
_JAX_SETTINGS = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
)

# Digests of functions and classes that were met, by id. The objects are stored with them, so that no other
# object gets the id.
_CodeDigests = dict[int, tuple[Any, str]]


def fingerprint(parts: Mapping[str, Any]) -> dict[str, str]:
    """Return a digest of each part of a problem, and the releases and settings with which it is solved.

    **Raises:** TypeError for a part whose content is not accessible, such as an open file.
    """
    digests = {}
    for name, value in parts.items():
        try:
            digests[name] = digest_of(value)
        except (TypeError, RecursionError) as error:
            raise TypeError(f"{name} cannot be compared with that of another run: {error}") from error
    digests |= {f"version of {name}": version_of(name) for name in _PACKAGES}
    digests["version of python"] = ".".join(platform.python_version_tuple()[:2])
    digests |= {name: str(getattr(jax.config, name, None)) for name in _JAX_SETTINGS}
    return digests | {"jax.default_backend()": jax.default_backend()}


def version_of(name: str) -> str:
    """Return the version of an installed package."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def digest_of(x: Any, code_digests: _CodeDigests | None = None) -> str:
    """Return the digest of any object.

    `code_digests` has those of functions and classes on the way from the outermost object.

    **Raises:** TypeError for an object whose content is not accessible, such as an open file.
    """
    code_digests = {} if code_digests is None else code_digests
    is_code = isinstance(x, FunctionType | type)
    if is_code:
        if id(x) in code_digests:
            return code_digests[id(x)][1]
        # Code may name itself: within it, its order among the objects met stands for its digest.
        code_digests[id(x)] = x, f"number {len(code_digests)}"
    head, components = _decompose(x)
    digest = hashlib.sha256(repr(head).encode())
    if isinstance(x, set | frozenset):
        # The order of a set is another in every process. Sorted digests must not depend on it either, so each
        # is computed by itself.
        digest.update("\n".join(sorted(digest_of(component) for component in components)).encode())
    else:
        digest.update("\n".join(digest_of(component, code_digests) for component in components).encode())
    if is_code:
        code_digests[id(x)] = x, digest.hexdigest()
    return digest.hexdigest()


def _decompose(x: Any) -> tuple[Any, list[Any]]:
    """Return what identifies an object itself, as an object with a stable `repr`, and its components."""
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
            is_installed = _is_installed(x.__name__)
            return (x.__name__, _release_of(x.__name__) if is_installed else _sources_of([x.__name__])), []
        case type() | FunctionType() | BuiltinFunctionType() if _is_installed(x.__module__):
            # A function that a package's function returned may hold objects of the user in its closure.
            is_local = "<locals>" in x.__qualname__
            closure = (getattr(x, "__closure__", None) or ()) if is_local else ()
            return (x.__module__, x.__qualname__, _release_of(x.__module__)), [*map(_content, closure)]
        case type():
            return x.__qualname__, list(_members(x))
        case FunctionType():
            names = [n for n in _globals_of(x.__code__) if n in x.__globals__]
            used = [*map(_content, x.__closure__ or ()), *(x.__globals__[n] for n in names)]
            imported = _imports_of(x.__code__, x.__globals__.get("__package__") or "")
            head = (x.__qualname__, names, _sources_of(imported))
            return head, [x.__code__, x.__defaults__, x.__kwdefaults__, *used]
        case CodeType():
            names = x.co_names, x.co_varnames, x.co_freevars, x.co_cellvars, x.co_flags, x.co_exceptiontable
            return (x.co_code, *names), list(x.co_consts)
    if dataclasses.is_dataclass(x):
        fields = [f.name for f in dataclasses.fields(x) if f.compare]
        return fields, [type(x), *(getattr(x, name) for name in fields)]
    if callable(x) and hasattr(x, "__wrapped__"):
        # For instance `jax.custom_jvp`, whose rules are attributes.
        public = {n: value for n, value in getattr(x, "__dict__", {}).items() if not n.startswith("_")}
        return "wrapped", [type(x), x.__wrapped__, public]
    try:
        reduce = copyreg.dispatch_table.get(type(x))
        reduced = x.__reduce_ex__(2) if reduce is None else reduce(x)
    except (TypeError, pickle.PicklingError):
        raise TypeError(f"the content of a {type(x).__qualname__} is not known") from None
    if isinstance(reduced, str):
        return reduced, [type(x)]
    # A tuple: callable, arguments and state, then iterators of items.
    return "object", [type(x), *(list(item) if isinstance(item, Iterator) else item for item in reduced)]


def _is_installed(module: str | None) -> bool:
    """Return True if a module belongs to an installed package, for which its release stands."""
    module = module or "builtins"
    if module.partition(".")[0] in _INSTALLED:
        return True
    path = _file_of(module) or ""
    return "site-packages" in path or "dist-packages" in path


def _file_of(module: str) -> str | None:
    """Return the path of a module's file, imported or not; None for one without, and for what is none."""
    if module in sys.modules:
        return getattr(sys.modules[module], "__file__", None)
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, AttributeError, ValueError):
        return None
    return None if spec is None or not spec.has_location else spec.origin


def _release_of(module: str | None) -> str:
    """Return the release of an installed package; empty for those whose release every fingerprint has."""
    package = (module or "builtins").partition(".")[0]
    return "" if package in _INSTALLED else version_of(package)


def _sources_of(modules: Iterable[str]) -> dict[str, str]:
    """Return the digest of the file of each module of the user, and of all that these import, by module."""
    digests: dict[str, str] = {}
    pending = list(modules)
    while pending:
        name = pending.pop()
        path = None if name in digests or _is_installed(name) else _file_of(name)
        if path is None:
            continue
        source = Path(path).read_bytes()
        digests[name] = hashlib.sha256(source).hexdigest()
        if path.endswith(".py"):
            package = name if Path(path).name == "__init__.py" else name.rpartition(".")[0]
            pending += _imports_of(compile(source, path, "exec"), package)
    return dict(sorted(digests.items()))


def _imports_of(code: CodeType, package: str) -> set[str]:
    """Return the names of the modules that code of a package imports, nested functions included."""
    names, constants, base = set(), [], ""
    for instruction in dis.get_instructions(code):
        match instruction.opname:
            case "LOAD_CONST" | "LOAD_SMALL_INT":
                constants.append(instruction.argval)
            case "IMPORT_NAME":
                # Two constants precede it: the number of leading dots, and the names that are imported.
                level = constants[-2]
                base = "." * level + instruction.argval
                base = importlib.util.resolve_name(base, package) if level else base
                names.add(base)
            case "IMPORT_FROM":
                names.add(f"{base}.{instruction.argval}")
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            names |= _imports_of(constant, package)
    # Names that a module defines are among these; they have no file.
    return names


def _members(kind: type) -> Iterator[Any]:
    """Yield the bases, methods and constants of a class."""
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
    """Return the names of the globals that code uses, including nested functions."""
    names = {i.argval for i in dis.get_instructions(code) if i.opname == "LOAD_GLOBAL"}
    for const in code.co_consts:
        if isinstance(const, CodeType):
            names.update(_globals_of(const))
    return sorted(names)
