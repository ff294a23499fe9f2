"""Compiled programs, a bounded number of them: those used longest ago are forgotten, and their memory is
freed.
"""

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxlidar._checks import is_traced

# A compiled simulation takes 50 to 250 MB.
MOST = 16


class Program:
    """A function of pytrees, compiled once for each structure, shape and type of its arguments.

    As with `equinox.filter_jit`, arrays (NumPy's among them) are traced and all else is static. At most
    `most` compiled versions are kept. Within a JAX transformation the function is called as it is.
    """

    def __init__(self, function: Callable, *, most: int = MOST, **options: Any):
        functools.update_wrapper(self, function)
        self.function, self.most, self.options = function, most, options
        self.versions: OrderedDict[Any, _Version] = OrderedDict()
        self._lock = threading.Lock()

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._run(_parts(args, kwargs))

    def given(self, **kept: Any) -> Callable:
        """The program with these arguments given; it takes the others by name.

        They are taken apart once, for many calls. For an equinox module of thirty arrays that takes longer
        than a short program runs, and Python lets only one thread at a time do it.
        """
        known = _parts((), kept)
        return lambda **others: self._run(dict(sorted({**known, **_parts((), others)}.items())))

    def begin(self, *args: Any, **kwargs: Any) -> Any:
        """Begin to compile for arguments of this kind, in a thread of its own.

        Arrays may be given, or shapes that another `begin` has returned.

        **Returns:** the shapes of the result, in place of its arrays.
        """
        parts = _parts(args, kwargs)
        return self._version(parts).begin(_arrays(parts))

    def is_compiled(self, *args: Any, **kwargs: Any) -> bool:
        """Whether a call with such arguments compiles nothing."""
        return self._version(_parts(args, kwargs)).ready

    def _run(self, parts: "dict[str | int, _Part]") -> Any:
        arrays = _arrays(parts)
        if any(map(is_traced, arrays)):
            return _call(self.function, {name: part.kind for name, part in parts.items()}, arrays)
        return self._version(parts)(arrays)

    def _version(self, parts: "dict[str | int, _Part]") -> "_Version":
        config: Any = jax.config
        setting = (config.jax_enable_x64, config.jax_default_device, config.jax_numpy_rank_promotion)
        kinds = {name: part.kind for name, part in parts.items()}
        key = (tuple(kinds.items()), tuple(part.types for part in parts.values()), setting)
        with self._lock:
            version = self.versions.get(key)
            if version is None:
                version = self.versions[key] = _Version(self.function, kinds, self.options)
            self.versions.move_to_end(key)
            while len(self.versions) > self.most:
                self.versions.popitem(last=False)
        return version


class _Kind(NamedTuple):
    """What a pytree is without its arrays: `leaves` has `_ARRAY` where one belongs."""

    structure: Any
    leaves: tuple[Any, ...]


class _Part(NamedTuple):
    """One argument, taken apart."""

    kind: _Kind
    types: tuple[Any, ...]
    arrays: list[Any]


_ARRAY = object()


def _part(tree: Any) -> _Part:
    leaves, structure = jax.tree.flatten(tree)
    arrays = [x for x in leaves if _is_shape(x)]
    types = tuple((a.shape, a.dtype, getattr(a, "weak_type", False)) for a in arrays)
    return _Part(_Kind(structure, tuple(_ARRAY if _is_shape(x) else x for x in leaves)), types, arrays)


def _whole(kind: _Kind, arrays: Iterator[Any]) -> Any:
    """The pytree of a kind, with the next of the arrays."""
    return jax.tree.unflatten(kind.structure, [next(arrays) if x is _ARRAY else x for x in kind.leaves])


def _parts(args: tuple, kwargs: dict[str, Any]) -> dict[str | int, _Part]:
    """The arguments by place or name, in an order that does not depend on how they were given."""
    return {n: _part(x) for n, x in enumerate(args)} | {name: _part(kwargs[name]) for name in sorted(kwargs)}


def _arrays(parts: dict[str | int, _Part]) -> list[Any]:
    return [a for part in parts.values() for a in part.arrays]


def _call(function: Callable, kinds: dict[str | int, _Kind], arrays: Iterable[Any]) -> Any:
    every = iter(arrays)
    found = {name: _whole(kind, every) for name, kind in kinds.items()}
    args = [x for name, x in found.items() if isinstance(name, int)]
    return function(*args, **{name: x for name, x in found.items() if isinstance(name, str)})


def _is_shape(x: Any) -> bool:
    return isinstance(x, (jax.Array, np.ndarray, np.number, jax.ShapeDtypeStruct))


class _Version:
    """One compiled version. What its result has beside arrays is known once it has been traced."""

    def __init__(self, function: Callable, kinds: dict[str | int, _Kind], options: dict[str, Any]):
        self.result: Any = None
        self._lock = threading.Lock()

        def compiled(arrays: list[Any]) -> list[Any]:
            found = _part(_call(function, kinds, arrays))
            self.result = found.kind
            return found.arrays

        compiled.__name__ = getattr(function, "__name__", "program")
        self.compiled, self.ready = jax.jit(compiled, **options), False
        self.shapes: Any = None
        self.ahead: Future | None = None

    def __call__(self, arrays: list[Any]) -> Any:
        if not self.ready:
            # Threads that ask at once wait for one compilation.
            with self._lock:
                if self.ahead is not None:
                    wait([self.ahead])
                found = self.compiled(arrays)
                self.ready = True
        else:
            found = self.compiled(arrays)
        return _whole(self.result, iter(found))

    def begin(self, arrays: list[Any]) -> Any:
        with self._lock:
            if self.shapes is None:
                # Tracing takes the caller's precision, which JAX keeps by thread; compiling needs it no more.
                traced = self.compiled.trace(arrays)
                self.shapes = traced.out_info
                if not self.ready:
                    self.ahead = _ahead().submit(traced.lower().compile)
        return _whole(self.result, iter(self.shapes))


@functools.cache
def _ahead() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(2, thread_name_prefix="compile")
