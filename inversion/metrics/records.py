"""Records of any number and length in few programs: padded to a ladder of sizes, and batched over shots.

Programs are compiled for a size. Records are padded to the next size of a ladder, so that records of all
lengths up to a size share one program; where a record ends is told to the program as a number.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array


def ladder(count: int) -> int:
    """The smallest of 64, 96, 128, 192, 256, 384, ... that is not below `count`."""
    size = 64
    while size < count:
        size = size * 3 // 2 if size & (size - 1) == 0 else size * 4 // 3
    return size


def pad(samples: Array, size: int) -> Array:
    """Zeros after the last sample, up to `size`."""
    return jnp.pad(samples, [(0, 0)] * (samples.ndim - 1) + [(0, size - samples.shape[-1])])


def over_shots(*ranks: int, in_turn: bool = False) -> Callable[[Callable], Callable]:
    """Makes a compiled function of many shots out of one of a shot, whose arguments have so many dimensions.

    Leading dimensions of the arguments are shots, and broadcast. They are computed side by side or,
    where each takes its own number of steps, `in_turn`.
    """

    def decorate(function: Callable) -> Callable:
        def batched(*arguments: Array):
            shots = jnp.broadcast_shapes(*(a.shape[: a.ndim - rank] for a, rank in zip(arguments, ranks)))
            if not shots:
                return function(*arguments)
            parts = [a.shape[a.ndim - rank :] for a, rank in zip(arguments, ranks)]
            spread = [jnp.broadcast_to(a, shots + part) for a, part in zip(arguments, parts)]
            rows = [a.reshape(-1, *part) for a, part in zip(spread, parts)]
            out = lax.map(lambda row: function(*row), rows) if in_turn else jax.vmap(function)(*rows)
            return jax.tree.map(lambda a: a.reshape(*shots, *a.shape[1:]), out)

        batched.__name__ = function.__name__
        return jax.jit(batched)

    return decorate
