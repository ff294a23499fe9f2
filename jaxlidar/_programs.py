"""Compiled programs, a bounded number of them: the least recently used are dropped, and their memory freed.

JAX keeps every program that it has compiled. A simulation of many scenes of different sizes would fill the
memory with programs that are not used again. A `Program` keeps a bounded number of *versions* instead, one
for each structure, shapes and types of the arguments and each relevant setting of JAX.

Arguments are pytrees. Flattened, an argument is a *static part* (its structure, and the leaves that are not
arrays), on which the version depends, and its arrays, which are passed to the compiled function.
"""

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxlidar._checks import is_traced
from jaxlidar._executables import ExecutableStore, noting_cache_hits

# A compiled simulation takes 50 to 250 MB.
MAX_VERSIONS = 16


# Executables of earlier sessions; None unless `jaxlidar.compilation_cache` is in use.
_store: ExecutableStore | None = None


def use_store(store: ExecutableStore | None) -> ExecutableStore | None:
    """Load programs from a store, and add new ones to it; or from none. **Returns:** the store before."""
    global _store
    previous, _store = _store, store
    return previous


class Program:
    """A function of pytrees, compiled once for each structure, shape and type of its arguments.

    As with `equinox.filter_jit`, arrays (NumPy's among them) are traced and all else is static. At most
    `max_versions` compiled versions are kept. Within a JAX transformation the function is called directly.

    **Arguments:**

    - `function`: the function to compile; all its static arguments are hashable.
    - `max_versions`: number of versions to keep. Default 16.
    - `options`: keyword arguments of `jax.jit`.
    """

    def __init__(self, function: Callable, *, max_versions: int = MAX_VERSIONS, **options: Any):
        functools.update_wrapper(self, function)
        self.function, self.max_versions, self.options = function, max_versions, options
        self.versions: OrderedDict[Any, _Version] = OrderedDict()
        self._lock = threading.Lock()

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._run(_flatten_arguments(args, kwargs))

    def bind(self, **bound: Any) -> Callable:
        """Return the program with these arguments bound; it takes its remaining arguments by name.

        Bound arguments are flattened once, for many calls. For an equinox module of thirty arrays that takes
        longer than a short program runs, and Python lets only one thread at a time do it.
        """
        flat_bound = _flatten_arguments((), bound)

        def call(**kwargs: Any) -> Any:
            arguments = {**flat_bound, **_flatten_arguments((), kwargs)}
            # In the order of a call with all arguments, so that the two share a version.
            return self._run(dict(sorted(arguments.items())))

        return call

    def compile_ahead(self, *args: Any, **kwargs: Any) -> Any:
        """Begin to compile for arguments like these, in another thread.

        Arguments may have arrays, or shapes that another `compile_ahead` has returned.

        **Returns:** the result, with shapes in place of its arrays.
        """
        arguments = _flatten_arguments(args, kwargs)
        return self._version(arguments).compile_ahead(_all_arrays(arguments))

    def is_compiled(self, *args: Any, **kwargs: Any) -> bool:
        """Return True if a call with arguments like these compiles nothing."""
        return self._version(_flatten_arguments(args, kwargs)).is_compiled

    def _run(self, arguments: "dict[str | int, _FlatArgument]") -> Any:
        arrays = _all_arrays(arguments)
        if any(map(is_traced, arrays)):
            # The transformation around it differentiates or compiles the function.
            static_parts = {name: argument.static for name, argument in arguments.items()}
            return _call(self.function, static_parts, arrays)
        return self._version(arguments)(arrays)

    def _version(self, arguments: "dict[str | int, _FlatArgument]") -> "_Version":
        """Return the version for arguments like these, a new one if there is none."""
        config: Any = jax.config
        # Settings by thread or context that change what a function compiles to.
        settings = (config.jax_enable_x64, config.jax_default_device, config.jax_numpy_rank_promotion)
        static_parts = {name: argument.static for name, argument in arguments.items()}
        types = tuple(argument.types for argument in arguments.values())
        key = (tuple(static_parts.items()), types, settings)
        with self._lock:
            version = self.versions.get(key)
            if version is None:
                version = _Version(self.function, static_parts, types, settings, self.options)
                self.versions[key] = version
            self.versions.move_to_end(key)
            while len(self.versions) > self.max_versions:
                self.versions.popitem(last=False)
        return version


class _StaticPart(NamedTuple):
    """A pytree without its arrays: `leaves` has `_ARRAY` in their places."""

    structure: Any
    leaves: tuple[Any, ...]


class _FlatArgument(NamedTuple):
    """One argument, flattened. `types` has the shape, type and weak type of each array."""

    static: _StaticPart
    types: tuple[Any, ...]
    arrays: list[Any]


_ARRAY = object()


def _flatten(tree: Any) -> _FlatArgument:
    leaves, structure = jax.tree.flatten(tree)
    arrays = [x for x in leaves if _is_array_or_shape(x)]
    types = tuple((a.shape, a.dtype, getattr(a, "weak_type", False)) for a in arrays)
    static_leaves = tuple(_ARRAY if _is_array_or_shape(x) else x for x in leaves)
    return _FlatArgument(_StaticPart(structure, static_leaves), types, arrays)


def _unflatten(static: _StaticPart, arrays: Iterator[Any]) -> Any:
    """Return the pytree with this static part; it takes as many of `arrays` as it needs."""
    leaves = [next(arrays) if x is _ARRAY else x for x in static.leaves]
    return jax.tree.unflatten(static.structure, leaves)


def _flatten_arguments(args: tuple, kwargs: dict[str, Any]) -> dict[str | int, _FlatArgument]:
    """Return flat arguments by position or name; names are sorted, so that their order makes no version."""
    positional = {position: _flatten(x) for position, x in enumerate(args)}
    return positional | {name: _flatten(kwargs[name]) for name in sorted(kwargs)}


def _all_arrays(arguments: dict[str | int, _FlatArgument]) -> list[Any]:
    return [array for argument in arguments.values() for array in argument.arrays]


def _call(function: Callable, static_parts: dict[str | int, _StaticPart], arrays: Iterable[Any]) -> Any:
    """Call a function with the arguments that these static parts and arrays make up."""
    remaining_arrays = iter(arrays)
    arguments = {name: _unflatten(static, remaining_arrays) for name, static in static_parts.items()}
    args = [x for name, x in arguments.items() if isinstance(name, int)]
    return function(*args, **{name: x for name, x in arguments.items() if isinstance(name, str)})


def _is_array_or_shape(x: Any) -> bool:
    return isinstance(x, (jax.Array, np.ndarray, np.number, jax.ShapeDtypeStruct))


class _Version:
    """One compiled version of a function, for arguments with given static parts.

    - `result`: static part of the result, once the function has been traced.
    - `result_shapes`: shapes of the result's arrays, once the version has been compiled ahead.
    - `is_compiled`: True once the version has been called.
    """

    def __init__(
        self,
        function: Callable,
        static_parts: dict[str | int, _StaticPart],
        types: tuple[Any, ...],
        settings: tuple[Any, ...],
        options: dict[str, Any],
    ):
        """`types`: of the arrays of each argument. `settings`: of JAX. `options`: of `jax.jit`."""
        self._results: list[Any] = []
        self._lock = threading.Lock()
        self.path: Path | None = None
        self.identity = function, static_parts, types, settings, options

        # Not `self`: the version would be part of a cycle, and its program freed at the next collection of
        # garbage only, many programs later.
        results = self._results

        def of_arrays(arrays: list[Any]) -> list[Any]:
            flat_result = _flatten(_call(function, static_parts, arrays))
            # A side effect of tracing: jax.jit returns arrays only.
            results[:] = [flat_result.static]
            return flat_result.arrays

        # The name that profiles and dumps of the compiler show.
        of_arrays.__name__ = getattr(function, "__name__", "program")
        # A jax.jit of its own: when the version is dropped, so is its program.
        self.compiled: Any = jax.jit(of_arrays, **options)
        self.is_compiled = False
        self.result_shapes: Any = None
        self.compilation: Future | None = None

    @property
    def result(self) -> Any:
        """Static part of the result."""
        return self._results[0]

    def __call__(self, arrays: list[Any]) -> Any:
        if not self.is_compiled:
            # Threads that ask at once wait for one compilation.
            with self._lock:
                if self.compilation is not None:
                    wait([self.compilation])
                elif _store is not None and not self.is_compiled and not self._load(_store):
                    traced = self.compiled.trace(arrays)
                    self.result_shapes = traced.out_info
                    self._compile(traced.lower(), _store)
                result_arrays = self.compiled(arrays)
                self.is_compiled = True
        else:
            result_arrays = self.compiled(arrays)
        return _unflatten(self.result, iter(result_arrays))

    def compile_ahead(self, arrays: list[Any]) -> Any:
        with self._lock:
            if self.result_shapes is None and (_store is None or not self._load(_store)):
                # Tracing takes the caller's precision, which JAX keeps by thread; compiling needs it no more.
                # JAX keeps what is compiled here, so that the call after it compiles nothing.
                traced = self.compiled.trace(arrays)
                self.result_shapes = traced.out_info
                if not self.is_compiled:
                    lowered = traced.lower()
                    self.compilation = _compilation_threads().submit(self._compile, lowered, _store)
        # Either loaded from the store or traced.
        assert self.result_shapes is not None
        return _unflatten(self.result, iter(self.result_shapes))

    def _compile(self, lowered: Any, store: ExecutableStore | None) -> None:
        """Compile, and add the executable to the store."""
        with noting_cache_hits() as hits:
            compiled = lowered.compile()
        # XLA writes an executable that it has read itself without machine code: it would fail when called.
        if store is not None and self.path is not None and not hits:
            shapes = [jax.ShapeDtypeStruct(shape.shape, shape.dtype) for shape in self.result_shapes]
            store.save(self.path, compiled, _unflatten(self.result, iter(shapes)))

    def _load(self, store: ExecutableStore) -> bool:
        """Take the executable from the store. **Returns:** False if it has none."""
        # Here, in the thread of the caller, whose precision the path depends on.
        self.path = self._path_in(store)
        stored = None if self.path is None else store.load(self.path)
        if stored is None:
            return False
        flat_result = _flatten(stored.result)
        self._results[:], self.result_shapes = [flat_result.static], flat_result.arrays
        self.compiled, self.is_compiled = stored.call, True
        return True

    def _path_in(self, store: ExecutableStore) -> Path | None:
        function, static_parts, types, settings, options = self.identity
        # The arguments themselves, with types in place of arrays: structures of JAX have no digest.
        arguments = {
            name: _unflatten(static, iter([(shape, str(dtype), weak) for shape, dtype, weak in array_types]))
            for (name, static), array_types in zip(static_parts.items(), types)
        }
        parts = {"function": function, "arguments": arguments, "options": options}
        return store.path_of(function.__name__, settings=list(map(str, settings)), **parts)


@functools.cache
def _compilation_threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(2, thread_name_prefix="compile")
