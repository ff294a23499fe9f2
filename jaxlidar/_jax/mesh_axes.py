"""Arrays on a mesh of devices: what JAX's types say about its axes.

- *Manual axes*, within `jax.shard_map`: the type of a value says along which axes it may vary, that is,
  differ from device to device. The carry of a loop must have one type before and after every step, but sums
  begin as constants, which do not vary. `vary_together` and `vary_with` change the types; nothing is computed
  or sent.
- *Explicit axes*, the default of `jax.make_mesh`: the type says how a value is divided among devices, and
  every operation must be able to tell how its result is. Gathers, scatters and concatenations often cannot.
  `with_automatic_axes` leaves the axes to the compiler within a function.
"""

import functools
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer

Tree = TypeVar("Tree")
Function = TypeVar("Function", bound=Callable)


def _varying_axes(tree: Any) -> set[str]:
    """Return the manual axes of the mesh along which any array of a pytree may vary."""
    tracers = [x for x in jax.tree.leaves(tree) if isinstance(x, Tracer)]
    return {axis for x in tracers for axis in jax.typeof(x).manual_axis_type.varying}


def varies(tree: Any) -> bool:
    """Return True if any array of a pytree may vary along a manual axis of the mesh."""
    return bool(_varying_axes(tree))


def vary_with(tree: Tree, like: Any) -> Tree:
    """Return a pytree whose arrays vary along all mesh axes along which any array of `like` does."""
    axes = _varying_axes(like)
    if not axes:
        return tree

    def varying(x: Any) -> Any:
        x = jnp.asarray(x)
        missing = sorted(axes - _varying_axes(x))
        return jax.lax.pcast(x, tuple(missing), to="varying") if missing else x

    return jax.tree.map(lambda x: varying(x) if eqx.is_array_like(x) else x, tree)


def vary_together(tree: Tree) -> Tree:
    """Return a pytree whose arrays all vary along the mesh axes along which any of them does."""
    return vary_with(tree, tree)


def _explicit_mesh(arrays: Iterable[Any]) -> Any:
    """Return the mesh with explicit axes on which one of the arrays lies, or None."""
    for x in arrays:
        if isinstance(x, Tracer):
            mesh = jax.typeof(x).sharding.mesh
            if mesh.explicit_axes:
                return mesh
    return None


def _depends_on_mesh(x: Any) -> bool:
    """Return True for values that JAX traces, and for arrays that lie on a mesh with explicit axes."""
    return isinstance(x, Tracer) or (
        isinstance(x, jax.Array) and bool(jax.typeof(x).sharding.mesh.explicit_axes)
    )


def with_automatic_axes(function: Function) -> Function:
    """Return a function that leaves a mesh's explicit axes to the compiler.

    The arguments and the result are pytrees. Every device gets all of the result; under `jax.vmap` that of
    its own members of the batch.
    """

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        # Other arrays keep their values: as arguments of a program they would be traced.
        arrays, static_arguments = eqx.partition((args, kwargs), _depends_on_mesh)
        mesh = _explicit_mesh(jax.tree.leaves(arrays))
        if mesh is None:
            return function(*args, **kwargs)
        static_result = None

        def of_arrays(arrays: Any) -> Any:
            nonlocal static_result
            args, kwargs = eqx.combine(arrays, static_arguments)
            array_result, static_result = eqx.partition(function(*args, **kwargs), eqx.is_array)
            return array_result

        # Without `jax.set_mesh`, the mesh is known from the types alone.
        with jax.sharding.use_abstract_mesh(mesh):
            everywhere = jax.sharding.PartitionSpec()
            array_result = jax.sharding.auto_axes(of_arrays, out_sharding=everywhere)(arrays)
        return eqx.combine(array_result, static_result)

    return call  # pyright: ignore[reportReturnType]
