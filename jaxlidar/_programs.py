"""Compiled programs, a bounded number of them: those used longest ago are forgotten, and their memory is
freed.
"""

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import equinox as eqx
import jax

from jaxlidar._checks import is_traced

# A compiled simulation takes 50 to 250 MB.
MOST = 16


class Program:
    """A function of pytrees, compiled once for each structure, shape and type of its arguments.

    As `equinox.filter_jit`, arrays are traced and all else is static; but at most `most` compiled versions
    are kept. Within a JAX transformation the function is called as it is.
    """

    def __init__(self, function: Callable, *, most: int = MOST, **options: Any):
        functools.update_wrapper(self, function)
        self.function, self.most, self.options = function, most, options
        self.versions: OrderedDict[Any, _Version] = OrderedDict()
        self._lock = threading.Lock()

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        dynamic, static = eqx.partition((args, kwargs), eqx.is_array)
        if any(map(is_traced, jax.tree.leaves(dynamic))):
            return self.function(*args, **kwargs)
        return self._version(dynamic, static)(dynamic)

    def begin(self, *args: Any, **kwargs: Any) -> Any:
        """Begin to compile for arguments of this kind, in a thread of its own.

        Arrays may be given, or shapes that another `begin` has returned.

        **Returns:** the shapes of the result, in place of its arrays.
        """
        dynamic, static = eqx.partition((args, kwargs), _is_shape)
        return self._version(dynamic, static).begin(dynamic)

    def is_compiled(self, *args: Any, **kwargs: Any) -> bool:
        """Whether a call with such arguments compiles nothing."""
        return self._version(*eqx.partition((args, kwargs), _is_shape)).ready

    def _version(self, dynamic: Any, static: Any) -> "_Version":
        leaves, structure = jax.tree.flatten(dynamic)
        fixed, shape = jax.tree.flatten(static)
        config: Any = jax.config
        kinds = tuple((a.shape, a.dtype, getattr(a, "weak_type", False)) for a in leaves)
        setting = (config.jax_enable_x64, config.jax_default_device, config.jax_numpy_rank_promotion)
        key = (structure, shape, tuple(fixed), kinds, setting)
        with self._lock:
            version = self.versions.get(key)
            if version is None:
                version = self.versions[key] = _Version(self.function, static, self.options)
            self.versions.move_to_end(key)
            while len(self.versions) > self.most:
                self.versions.popitem(last=False)
        return version


def _is_shape(x: Any) -> bool:
    return eqx.is_array(x) or isinstance(x, jax.ShapeDtypeStruct)


class _Version:
    """One compiled version. What its result has beside arrays is known once it has been traced."""

    def __init__(self, function: Callable, static: Any, options: dict[str, Any]):
        self.rest: Any = None
        self._lock = threading.Lock()

        def compiled(dynamic: Any) -> Any:
            args, kwargs = eqx.combine(dynamic, static)
            found, self.rest = eqx.partition(function(*args, **kwargs), eqx.is_array)
            return found

        compiled.__name__ = getattr(function, "__name__", "program")
        self.compiled, self.ready = jax.jit(compiled, **options), False
        self.shapes: Any = None
        self.ahead: Future | None = None

    def __call__(self, dynamic: Any) -> Any:
        if not self.ready:
            # Threads that ask at once wait for one compilation.
            with self._lock:
                if self.ahead is not None:
                    wait([self.ahead])
                found = self.compiled(dynamic)
                self.ready = True
        else:
            found = self.compiled(dynamic)
        return eqx.combine(found, self.rest)

    def begin(self, dynamic: Any) -> Any:
        with self._lock:
            if self.shapes is None:
                # Tracing takes the caller's precision, which JAX keeps by thread; compiling needs it no more.
                traced = self.compiled.trace(dynamic)
                self.shapes = traced.out_info
                if not self.ready:
                    self.ahead = _ahead().submit(traced.lower().compile)
        return eqx.combine(self.shapes, self.rest)


@functools.cache
def _ahead() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(2, thread_name_prefix="compile")
