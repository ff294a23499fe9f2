"""Linear maps with a transpose of their own, which can be batched.

Forward mode pushes tangents t through a function f to J t; reverse mode pulls cotangents c back to J^T c. JAX
makes the program for J^T c by transposing that for J t step by step, and keeps every intermediate value that
it needs for that. `linear_map` takes both programs: where it is transposed, it runs the second one.

As the tangent of a `jax.custom_jvp` it gives a function a reverse rule, and leaves forward mode as it is,
which `jax.custom_vjp` does not. It differs from `jax.custom_derivatives.linear_call` in that `jax.vmap`
applies, as in `jax.jacfwd`, and that derivatives by the residuals exist, as for Hessians.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

# A function of lists of residuals and of arguments (cotangents), which gives a list of results.
FlatMap = Callable[[list[Array], list[Array]], Sequence[Array]]


def linear_map(
    function: FlatMap,
    transpose: FlatMap,
    residuals: Sequence[Any],
    arguments: Sequence[Array],
    results: Sequence[Any],
) -> list[Array]:
    """Return `function(residuals, arguments)`, whose transpose is `transpose(residuals, cotangents)`.

    **Arguments:**

    - `function`: linear in the arguments. `transpose`: its transpose, which returns a cotangent for each
      argument. Neither may use traced values other than its arguments, and both must have forward derivatives
      by the residuals, if second derivatives are taken.
    - `residuals`: arrays on which both depend, or the numbers by which JAX replaces them where they are
      constants of a program. `arguments`: arrays of real numbers.
    - `results`: arrays, or types of arrays, of the shapes and types of the results. So the function that is
      not used, here or in the transpose, need not be traced.
    """
    return _linear_map_p.bind(
        *residuals,
        *arguments,
        function=function,
        transpose=transpose,
        n_residuals=len(residuals),
        result_types=_types(results),
    )


def _types(arrays: Sequence[Any]) -> tuple[ShapedArray, ...]:
    return tuple(ShapedArray(a.shape, a.dtype) for a in arrays)


def _evaluate(*operands: Array, function: FlatMap, n_residuals: int, **other_parameters: Any) -> list[Array]:
    del other_parameters
    return list(function(list(operands[:n_residuals]), list(operands[n_residuals:])))


def _evaluate_compiled(*operands: Array, **parameters: Any) -> list[Array]:
    # Outside of a compiled program: operation by operation, loops would be compiled one by one.
    return jax.jit(lambda *operands: _evaluate(*operands, **parameters))(*operands)


def _result_types(*operands: Any, **parameters: Any) -> list[ShapedArray]:
    return list(parameters["result_types"])


def _push_forward(primals: Sequence[Any], tangents: Sequence[Any], **parameters: Any) -> tuple[Any, Any]:
    """Apply the map to tangents of its arguments; where residuals vary, differentiate through it."""
    results = _linear_map_p.bind(*primals, **parameters)
    n = parameters["n_residuals"]
    total = [ad.Zero(a) for a in parameters["result_types"]]
    if any(not isinstance(t, ad.Zero) for t in tangents[n:]):
        of_arguments = [ad.instantiate_zeros(t) for t in tangents[n:]]
        total = _linear_map_p.bind(*primals[:n], *of_arguments, **parameters)
    varying = [i for i in range(n) if not isinstance(tangents[i], ad.Zero)]
    if varying:

        def of_varying(*residuals: Array) -> list[Array]:
            operands = list(primals)
            for i, residual in zip(varying, residuals):
                operands[i] = residual
            return _evaluate(*operands, **parameters)

        of_residuals = jax.jvp(of_varying, [primals[i] for i in varying], [tangents[i] for i in varying])[1]
        total = [ad.add_tangents(a, b) for a, b in zip(total, of_residuals)]
    return results, total


def _pull_back(
    cotangents: Sequence[Any],
    *operands: Any,
    function: FlatMap,
    transpose: FlatMap,
    n_residuals: int,
    result_types: tuple[ShapedArray, ...],
) -> list[Any]:
    residuals, arguments = operands[:n_residuals], operands[n_residuals:]
    of_results = [ad.instantiate_zeros(c) for c in cotangents]
    # The values of arguments that the map is not transposed by are at hand, the types of the others.
    types = [a.aval if ad.is_undefined_primal(a) else a for a in arguments]
    pulled = linear_map(transpose, function, residuals, of_results, types)
    # Tangents that are known are zeros: nothing is asked of them.
    of_arguments = [c if ad.is_undefined_primal(a) else None for c, a in zip(pulled, arguments)]
    return [None] * n_residuals + of_arguments


def _batch(
    operands: Sequence[Array],
    axes: Sequence[int | None],
    *,
    function: FlatMap,
    transpose: FlatMap,
    n_residuals: int,
    result_types: tuple[ShapedArray, ...],
) -> tuple[list[Array], list[int]]:
    """Map the function and its transpose over a batch.

    The transpose of a map over a batch sums over it where an argument has no batch. So all arguments get one.
    """
    size = next(a.shape[axis] for a, axis in zip(operands, axes) if axis is not None)
    moved = [a if axis is None else jnp.moveaxis(a, axis, 0) for a, axis in zip(operands, axes)]
    residuals, arguments = moved[:n_residuals], moved[n_residuals:]
    arguments = [
        jnp.broadcast_to(a, (size, *a.shape)) if axis is None else a
        for a, axis in zip(arguments, axes[n_residuals:])
    ]
    residual_axes = [None if axis is None else 0 for axis in axes[:n_residuals]]

    def over_batch(of_one: FlatMap) -> FlatMap:
        # Every result has the batch axis in front.
        return jax.vmap(lambda r, a: list(of_one(r, a)), (residual_axes, 0))

    types = [ShapedArray((size, *t.shape), t.dtype) for t in result_types]
    results = linear_map(over_batch(function), over_batch(transpose), residuals, arguments, types)
    return results, [0] * len(results)


_linear_map_p = Primitive("linear_map")
_linear_map_p.multiple_results = True
_linear_map_p.def_impl(_evaluate_compiled)
_linear_map_p.def_abstract_eval(_result_types)
ad.primitive_jvps[_linear_map_p] = _push_forward
ad.primitive_transposes[_linear_map_p] = _pull_back
batching.primitive_batchers[_linear_map_p] = _batch
mlir.register_lowering(_linear_map_p, mlir.lower_fun(_evaluate, multiple_results=True))
