"""What older compilers have to be told: which loops are one function, and which values to compute once.

XLA runs a program on a processor as a list of small kernels. In a loop whose arrays fit into the processor's
cache, handing on from kernel to kernel takes longer than computing. Newer versions compile such loops as one
function by themselves. Older ones also drop optimisation barriers, and compute what several results share
again for each of them.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
from jax import lax

State = TypeVar("State")

# From this version on, XLA finds the loops itself, and keeps barriers.
_UNAIDED = (0, 12)


def _is_aided() -> bool:
    return jax.__version_info__ < _UNAIDED and jax.default_backend() == "cpu"


def _apart(function: Callable[[State], State], **marks: str) -> Callable[[State], State]:
    """`function`, which the compiler calls, and does not make part of what calls it."""
    # Experimental: only where it is needed.
    from jax.experimental.xla_metadata import set_xla_metadata

    compiled = jax.jit(function)

    def marked(values: State) -> State:
        # XLA's own marks. A version that does not know them compiles the function as ever.
        with set_xla_metadata(inlineable="false", **marks):
            return compiled(values)

    return marked


def one_function(loop: Callable[[State], State]) -> Callable[[State], State]:
    """`loop`, compiled as one function on processors; elsewhere as it is.

    It may not scatter. So it cannot be differentiated in reverse, which makes scatters of gathers.
    """
    return _apart(loop, xla_cpu_small_call="true") if _is_aided() else loop


def once(values: State) -> State:
    """The same values, computed once for all that use them."""
    # A function that is called is a barrier.
    return _apart(lax.optimization_barrier)(values) if _is_aided() else lax.optimization_barrier(values)
