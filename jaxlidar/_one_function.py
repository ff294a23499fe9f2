"""Loops that the processor's compiler makes one function of.

XLA runs a program on a processor as a list of small kernels. In a loop whose arrays fit into the processor's
cache, handing on from kernel to kernel takes longer than computing. Newer versions compile such loops as one
function by themselves; older ones have to be told.
"""

from collections.abc import Callable
from typing import TypeVar

import jax

State = TypeVar("State")

# From this version on, XLA finds the loops itself.
_UNAIDED = (0, 12)


def one_function(loop: Callable[[State], State]) -> Callable[[State], State]:
    """`loop`, compiled as one function on processors; elsewhere as it is.

    It may not scatter. So it cannot be differentiated in reverse, which makes scatters of gathers.
    """
    if jax.__version_info__ >= _UNAIDED or jax.default_backend() != "cpu":
        return loop
    # Experimental: only where it is needed.
    from jax.experimental.xla_metadata import set_xla_metadata

    compiled = jax.jit(loop)

    def marked(state: State) -> State:
        # XLA's own marks. A version that does not know them compiles the loop as ever.
        with set_xla_metadata(inlineable="false", xla_cpu_small_call="true"):
            return compiled(state)

    return marked
