r"""Reverse mode by replay: derivatives with respect to all voxels from one more walk along the same paths.

A loss L of a response has cotangents y, its derivatives with respect to every value of the response. The
gradient of L with respect to the extinction of every voxel is the product of y with the Jacobian. Reverse
mode as JAX derives it keeps the state of every ray at every step, and for every step of a loop it adds a
whole voxel map, almost all zeros. A replay keeps no steps: it walks the same paths again, from the same
random numbers, and adds what each step contributes to its voxel alone (path replay backpropagation; Vicini,
Speierer and Jakob 2021, ACM Trans. Graph. 40, 108). Memory does not grow with the number of rays or photons,
nor with that of orders up to 256.

`with_replay` gives a function that traces light this rule. Its derivatives are

- forward: those of the function itself, and what `add_tangents` adds,
- reverse, with respect to extinction: by the replay,
- reverse, with respect to everything else (heights, sizes, laws): those that JAX derives, chunk by chunk,
- with respect to few numbers of the device scene: directional derivatives, taken together with the trace.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from jaxlidar._jax.mesh_axes import varies
from jaxlidar._jax.products import tensordot
from jaxlidar._vectors import Scalar, Vec
from jaxlidar.trace.derivatives.linear_map import linear_map
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.march.voxel_traversal import Medium

Traced = TypeVar("Traced")
Numbers = TypeVar("Numbers")

# Directional derivatives compile faster than reverse mode, whose backward pass repeats the steps of paths,
# but take longer the more numbers of the device scene vary. A plane has four beside its place: its normal and
# its height.
_MAX_DIRECTIONS = 4


class ExtinctionTables(NamedTuple):
    """Cotangents of the tables of extinction by voxel; None where there is no such table.

    - `leaf`, `bark`, `total`: of `Medium`. - `depth_above`: of `DeviceScene`.
    """

    leaf: Float[Array, "cells"] | None
    bark: Float[Array, "cells"] | None
    total: Float[Array, "cells"] | None
    depth_above: Float[Array, "cells"] | None

    @staticmethod
    def of(scene: DeviceScene) -> "ExtinctionTables":
        """Return the tables of a scene themselves."""
        medium = scene.medium
        if medium is None:
            return ExtinctionTables(None, None, None, None)
        return ExtinctionTables(medium.leaf, medium.bark, medium.total, scene.depth_above)

    def add_tables(
        self, cell: Int[Array, "*rays"], of_leaf: Scalar | None, of_bark: Scalar | None
    ) -> "ExtinctionTables":
        """Add to the tables of leaf and of bark as they are, for G = 1/2."""
        leaf, bark = self.leaf, self.bark
        if leaf is not None and of_leaf is not None:
            leaf = _scatter(leaf, cell, of_leaf)
        if bark is not None and of_bark is not None:
            bark = _scatter(bark, cell, of_bark)
        return self._replace(leaf=leaf, bark=bark)

    def add_depth_above(self, cell: Int[Array, "rays"], value: Scalar) -> "ExtinctionTables":
        """Add to the table of depths straight up."""
        assert self.depth_above is not None
        return self._replace(depth_above=_scatter(self.depth_above, cell, value))

    def add_materials(
        self,
        medium: Medium,
        cell: Int[Array, "*steps rays"],
        w: Vec,
        cotangents: tuple[Scalar | None, Scalar | None],
    ) -> "ExtinctionTables":
        """Add cotangents of the extinction of leaf and of bark that `Medium` looked up at voxels.

        `cell` may have several voxels of each ray, `w` is its direction.
        """
        of_leaf, of_bark = cotangents
        factor = medium.projection_factor(w)
        if of_leaf is not None and factor is not None:
            of_leaf = of_leaf * jnp.broadcast_to(factor, of_leaf.shape)
        return self.add_tables(cell, of_leaf, of_bark)

    def add_total(
        self, medium: Medium, cell: Int[Array, "*steps rays"], w: Vec, cotangent: Scalar
    ) -> "ExtinctionTables":
        """Add cotangents of the whole extinction that `Medium.extinction` looked up at voxels."""
        if self.total is not None:
            return self._replace(total=_scatter(self.total, cell, cotangent))
        return self.add_materials(medium, cell, w, (cotangent, cotangent))


def _scatter(
    table: Float[Array, "cells"], cell: Int[Array, "*rays"], value: Float[Array, "*rays"]
) -> Float[Array, "cells"]:
    return table.at[cell].add(value, mode="promise_in_bounds")


def with_replay(
    trace: Callable[[DeviceScene, Numbers], Traced],
    pull_back: Callable[[DeviceScene, Numbers, Traced], ExtinctionTables],
    scene: DeviceScene,
    numbers: Numbers,
    add_tangents: Callable[[DeviceScene, Numbers, ExtinctionTables, Traced], Traced] | None = None,
) -> Traced:
    """Return `trace(scene, numbers)`, with derivatives with respect to extinction by `pull_back`.

    **Arguments:**

    - `trace`: traces light; `numbers` are random numbers and the like, without derivatives.
    - `pull_back`: returns the cotangents of extinction from those of the result of `trace`.
    - `add_tangents`: adds to a tangent of the result of `trace` what `pull_back` has and forward mode lacks,
      from tangents of the tables of extinction. Default None: forward mode lacks nothing.

    Scenes without derivatives or with forward ones alone are traced as they are; so are those with score
    functions, and those that vary along axes of a mesh.
    """
    if not scene.reverse or scene.slopes is not None or varies((scene, numbers)):
        return trace(scene, numbers)
    arrays, static = eqx.partition((scene, numbers), eqx.is_array)
    leaves, treedef = jax.tree.flatten(arrays)

    def scene_and_numbers(leaves: list[Array], derivatives: Any) -> tuple[DeviceScene, Numbers]:
        scene, numbers = eqx.combine(jax.tree.unflatten(treedef, leaves), static)
        return dataclasses.replace(scene, derivatives=derivatives), numbers

    # The position of every table among the leaves.
    numbered: Any = eqx.combine(jax.tree.unflatten(treedef, range(len(leaves))), static)[0]
    tables: Any = ExtinctionTables.of(numbered)

    def function_of(leaves: list[Array], varying: list[int]) -> Callable[[list[Array]], Traced]:
        """Return the trace as a function of the leaves that vary, with all derivatives."""
        return lambda values: trace(*scene_and_numbers(_replaced(leaves, varying, values), "all"))

    def is_few(leaves: list[Array], varying: list[int]) -> bool:
        """Return True for leaves of few numbers, none of them in the tables of extinction."""
        return not set(varying) & set(tables) and 0 < sum(leaves[i].size for i in varying) <= _MAX_DIRECTIONS

    def linearised(leaves: list[Array], varying: list[int]) -> tuple[Traced, Callable[[list[Array]], Traced]]:
        """Return the trace, and its tangent as a function of those of few leaves: a sum over their numbers.

        The derivatives by each number are taken here, together with the trace. The sum is transposed in
        reverse mode, and nothing is traced again.
        """
        numbers, to_values = ravel_pytree([leaves[i] for i in varying])
        of_varying = function_of(leaves, varying)

        def along(direction: Float[Array, "numbers"]) -> tuple[Traced, Traced]:
            return jax.jvp(lambda numbers: of_varying(to_values(numbers)), (numbers,), (direction,))

        # A single direction needs no batch.
        if numbers.size == 1:
            result, derivative = along(jnp.ones_like(numbers))
            derivatives = jax.tree.map(lambda d: d[None], derivative)
        else:
            directions = jnp.eye(numbers.size, dtype=numbers.dtype)
            result, derivatives = jax.vmap(along, out_axes=(None, 0))(directions)

        def push(tangents: list[Array]) -> Traced:
            return jax.tree.map(lambda d: tensordot(ravel_pytree(tangents)[0], d, 1), derivatives)

        return result, push

    def pull_back_leaves(leaves: list[Any], varying: list[int], cotangent: Traced) -> list[Array]:
        """Return the cotangents of leaves: of tables of extinction by the replay, of others by JAX."""
        by_leaf: dict[int, Any] = {}
        if any(number in tables for number in varying):
            pulled = pull_back(*scene_and_numbers(leaves, "none"), cotangent)
            by_leaf = {number: c for number, c in zip(tables, pulled) if number is not None}
        others = [number for number in varying if number not in tables]
        if others:
            values = [leaves[i] for i in others]
            if is_few(leaves, others):
                pull_back_others = jax.linear_transpose(linearised(leaves, others)[1], values)
            else:
                pull_back_others = jax.vjp(function_of(leaves, others), values)[1]
            by_leaf |= dict(zip(others, pull_back_others(cotangent)[0]))
        return [by_leaf[number] for number in varying]

    @jax.custom_jvp
    def differentiable(leaves: list[Array]) -> Traced:
        return trace(*scene_and_numbers(leaves, "none"))

    def push_forward(primals: tuple[list[Any]], tangents: tuple[list[Any]]) -> tuple[Traced, Traced]:
        tangent = tangents[0]
        # JAX replaces constants of a program by numbers.
        leaves = [a if isinstance(a, jax.Array) else jnp.asarray(a, a.dtype) for a in primals[0]]
        varying = _varying(leaves, tangent)
        tangents_of_varying = [tangent[i] for i in varying]
        if is_few(leaves, varying):
            result, push = linearised(leaves, varying)
            return result, push(tangents_of_varying)
        if scene.medium is None:
            of_varying = function_of(leaves, varying)
            return jax.jvp(of_varying, ([leaves[i] for i in varying],), (tangents_of_varying,))
        result = differentiable(leaves)
        results, result_structure = jax.tree.flatten(result)

        def function(leaves: list[Any], tangents: list[Array]) -> list[Array]:
            by_leaf = dict(zip(varying, tangents))
            of_tables = ExtinctionTables(*(by_leaf.get(number) for number in tables))
            has_tables = any(t is not None for t in of_tables)
            fixed = scene_and_numbers(leaves, "forward")[0].medium

            def of_varying(values: list[Array]) -> Traced:
                scene, numbers = scene_and_numbers(_replaced(leaves, varying, values), "forward")
                if has_tables:
                    # Leaves in empty voxels around the box of occupied ones would attenuate, too.
                    scene = dataclasses.replace(scene, occupied_box=None)
                    if add_tangents is not None:
                        scene = _without_thin_collisions(scene, fixed)
                return trace(scene, numbers)

            pushed = jax.jvp(of_varying, ([leaves[i] for i in varying],), (tangents,))[1]
            if add_tangents is not None and has_tables:
                pushed = add_tangents(*scene_and_numbers(leaves, "none"), of_tables, pushed)
            return jax.tree.leaves(pushed)

        def transpose(leaves: list[Any], cotangents: list[Array]) -> list[Array]:
            return pull_back_leaves(leaves, varying, jax.tree.unflatten(result_structure, cotangents))

        result_tangent = linear_map(function, transpose, leaves, tangents_of_varying, results)
        return result, jax.tree.unflatten(result_structure, result_tangent)

    differentiable.defjvp(push_forward, symbolic_zeros=True)
    return differentiable(leaves)


def _without_thin_collisions(scene: DeviceScene, fixed: Medium | None) -> DeviceScene:
    """Return the scene with the tables of `fixed`, which do not vary, where light collides in thin voxels.

    Their derivatives are those of `add_tangents`.
    """
    medium = scene.medium
    assert medium is not None
    assert fixed is not None

    def table(values: Array | None, fixed_values: Array | None) -> Array | None:
        if values is None or fixed_values is None:
            return None
        return jnp.where(fixed.is_thin(fixed_values), fixed_values, values)

    collisions = table(medium.leaf, fixed.leaf), table(medium.bark, fixed.bark)
    return dataclasses.replace(scene, medium=dataclasses.replace(medium, collisions=collisions))


def _varying(leaves: list[Array], tangents: list[Any]) -> list[int]:
    """Return the positions of leaves of real numbers whose tangents are not zero throughout."""
    return [
        i
        for i, (a, t) in enumerate(zip(leaves, tangents))
        if not isinstance(t, SymbolicZero) and jnp.issubdtype(a.dtype, jnp.inexact)
    ]


def _replaced(values: list[Array], numbers: list[int], replacements: list[Array]) -> list[Array]:
    result = list(values)
    for number, replacement in zip(numbers, replacements):
        result[number] = replacement
    return result
