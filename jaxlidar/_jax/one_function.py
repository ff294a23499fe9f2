"""Hints for older XLA compilers: loops to compile as one function, and values to compute once.

XLA runs a program on a CPU as a list of small kernels. In a loop whose arrays fit into the cache, the
overhead between kernels takes longer than the computation. Newer versions compile such loops as one function
by themselves. Older ones also drop optimisation barriers, and compute a value again for each result that uses
it.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
from jax import lax

State = TypeVar("State")
Result = TypeVar("Result")

# From this version of JAX on, XLA finds the loops itself, and keeps barriers.
_FIRST_VERSION_WITHOUT_HINTS = (0, 12)


def _needs_hints() -> bool:
    return jax.__version_info__ < _FIRST_VERSION_WITHOUT_HINTS and jax.default_backend() == "cpu"


def _called_separately(function: Callable[[State], Result], **attributes: str) -> Callable[[State], Result]:
    """Return `function`, which the compiler calls and does not inline, with more attributes for XLA."""
    # Experimental: only where it is needed.
    from jax.experimental.xla_metadata import set_xla_metadata

    compiled = jax.jit(function)

    def with_attributes(values: State) -> Result:
        # XLA's own attributes. A version that does not know them compiles the function as usual.
        with set_xla_metadata(inlineable="false", **attributes):
            return compiled(values)

    return with_attributes


def one_function(loop: Callable[[State], Result]) -> Callable[[State], Result]:
    """Return `loop`, compiled as one function on CPUs; elsewhere as it is.

    The loop must not scatter. So it cannot be differentiated in reverse, which turns gathers into scatters.
    """
    return _called_separately(loop, xla_cpu_small_call="true") if _needs_hints() else loop


def barrier(values: State) -> State:
    """Return the same values behind an optimisation barrier: they are computed once for all their uses."""
    # Older versions drop the barrier itself, but not a function call around it.
    if _needs_hints():
        return _called_separately(lax.optimization_barrier)(values)
    return lax.optimization_barrier(values)
