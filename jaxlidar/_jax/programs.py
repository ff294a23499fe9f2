"""Compiled programs, a bounded number of them: the least recently used are dropped, and their memory freed.

JAX keeps every program that it has compiled. A simulation of many scenes of different sizes would fill the
memory with programs that are not used again. A `Program` has *versions* instead, one for each structure,
shapes and types of the arguments and each relevant setting of JAX. One cache has those of all programs.

Arguments are pytrees. Flattened, an argument is a *static part* (its structure, and the leaves that are not
arrays), on which the version depends, and its arrays, which are passed to the compiled function.
"""

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxlidar._fields.checks import is_traced
from jaxlidar._jax.threads import ONE_CORE

# A simulation has some six programs, which take 50 to 250 MB together.
MAX_VERSIONS = 96
# Versions by program and key, those that were used last at the end.
_versions: "OrderedDict[tuple[Program, Any], _Version]" = OrderedDict()
_lock = threading.Lock()


class Program:
    """A function of pytrees, compiled once for each structure, shape and type of its arguments.

    As with `equinox.filter_jit`, arrays (NumPy's among them) are traced and all else is static. Within a JAX
    transformation the function is called directly.

    **Arguments:**

    - `function`: the function to compile; all its static arguments are hashable.
    - `one_core`: True for programs that run side by side, each on one core (`side_by_side`). Default False.
    """

    def __init__(self, function: Callable, *, one_core: bool = False):
        functools.update_wrapper(self, function)
        self.function, self.one_core = function, one_core

    @property
    def versions(self) -> "list[_Version]":
        """The compiled versions that are kept of this program, those that were used last at the end."""
        return [version for (program, _), version in _versions.items() if program is self]

    def clear(self) -> None:
        """Drop all versions of this program."""
        with _lock:
            for program, key in [*_versions]:
                if program is self:
                    del _versions[program, key]

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
        key = self, (tuple(static_parts.items()), types, settings)
        with _lock:
            version = _versions.get(key)
            if version is None:
                version = _Version(self.function, static_parts, ONE_CORE if self.one_core else {})
                _versions[key] = version
            _versions.move_to_end(key)
            while len(_versions) > MAX_VERSIONS:
                _versions.popitem(last=False)
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
    types = tuple((a.shape, _type_of(a), getattr(a, "weak_type", False)) for a in arrays)
    static_leaves = tuple(_ARRAY if _is_array_or_shape(x) else x for x in leaves)
    return _FlatArgument(_StaticPart(structure, static_leaves), types, arrays)


def _type_of(array: Any) -> Any:
    """Return the type that an array has in a program: JAX converts those of NumPy to its precision."""
    return array.dtype if isinstance(array, jax.Array) else jax.dtypes.canonicalize_dtype(array.dtype)


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
        options: dict[str, Any],
    ):
        """`options`: of `jax.jit`."""
        self._results: list[Any] = []
        self._lock = threading.Lock()

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
                result_arrays = self.compiled(arrays)
                self.is_compiled = True
        else:
            result_arrays = self.compiled(arrays)
        return _unflatten(self.result, iter(result_arrays))

    def compile_ahead(self, arrays: list[Any]) -> Any:
        with self._lock:
            if self.result_shapes is None:
                # Tracing takes the caller's precision, which JAX keeps by thread; compiling needs it no more.
                # JAX keeps what is compiled here, so that the call after it compiles nothing.
                traced = self.compiled.trace(arrays)
                self.result_shapes = traced.out_info
                if not self.is_compiled:
                    self.compilation = _compilation_threads().submit(traced.lower().compile)
        return _unflatten(self.result, iter(self.result_shapes))


@functools.cache
def _compilation_threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(2, thread_name_prefix="compile")
