"""Loops over many problems at once, by `jax.vmap`: conditions that all problems share.

Where the condition of a loop or a branch differs between problems, `jax.vmap` computes both sides and selects
the result of each problem. That copies all that the loop carries, at every step: also large sums, of which a
step changes little. A step that changes nothing for a problem that has ended needs no selection. Such a loop
goes on for all problems as long as any of them needs it.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int


@jax.custom_batching.custom_vmap
def any_problem(condition: Bool[Array, "*s"]) -> Bool[Array, ""]:
    """Return True if any element of `condition` is True, in any of the problems."""
    return jnp.any(condition)


@any_problem.def_vmap
def _any_of_all(size: int, is_batched: list[bool], condition: Bool[Array, "problems *s"]):
    return any_problem(condition), False


@jax.custom_batching.custom_vmap
def largest_count(count: Int[Array, "*s"]) -> Int[Array, ""]:
    """Return the largest element of `count`, over all problems."""
    return jnp.max(count)


@largest_count.def_vmap
def _largest_of_all(size: int, is_batched: list[bool], count: Int[Array, "problems *s"]):
    return largest_count(count), False
