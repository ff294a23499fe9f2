"""The response of a scene to light about nodes: one `Response` for each, optics applied."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxlidar.trace.colouring import Recording, colour
from jaxlidar.trace.first_order import FirstOrder, first_order
from jaxlidar.trace.higher_orders import higher_orders
from jaxlidar.trace.histories import Histories
from jaxlidar.trace.nodes import Nodes
from jaxlidar.trace.response import Response, only_first
from jaxlidar.trace.setting import Setting


def trace_nodes(setting: Setting, nodes: Nodes, key: PRNGKeyArray) -> Response:
    """The response of one batch to light about every node; leading axis: nodes.

    `setting` has parallel light, and optics. Each wavelength is a trace of its own, with one history, for
    which optics are 1: `without_histories` gives a recording for it.
    """
    assert setting.optics is not None
    ray_key, photon_key = jax.random.split(key)
    many = len(nodes.place)

    def of_group(x: Float[Array, "rays"], y: Float[Array, "rays"], share: Float[Array, ""]) -> FirstOrder:
        return first_order(setting, (x, y), jnp.broadcast_to(share, x.shape))

    groups = jax.vmap(of_group)(*nodes.rays(ray_key), nodes.ray_share)
    first = jax.tree.map(lambda a: jax.ops.segment_sum(a, nodes.ray_node, many), groups)
    if setting.plan.order_steps < 2:
        response = jax.vmap(lambda f: only_first(setting, f, f.weights))(first)
        return _coloured(response, setting)
    short, optics = setting.short, setting.optics
    wavelengths = optics.shape[1]
    higher = higher_orders(setting, photon_key, nodes)

    def by_node(a: Array) -> Array:
        """Axes: nodes, wavelengths, materials and one history, or one history alone; then bins."""
        rows = a.ndim - (2 if a.ndim == 3 else 1)
        a = a.reshape(*a.shape[:rows], many, wavelengths, *a.shape[rows + 1 :])
        return jnp.moveaxis(a, (rows, rows + 1), (0, 1))

    return Response(
        first=_one_history(first.weights, short, optics),
        higher=jnp.expand_dims(by_node(higher.weights), 3),
        first_outside=_one_history(first.outside[..., None], short, optics)[..., 0],
        higher_outside=by_node(higher.outside)[..., None],
        arrived=by_node(higher.arrived)[..., None],
        left=by_node(higher.left)[..., None],
        escaped=by_node(higher.escaped)[..., None],
        late=by_node(higher.late)[..., None],
        remaining=by_node(higher.remaining)[..., None],
    )


def _one_history(
    weights: Float[Array, "nodes *rows histories columns"],
    table: Histories,
    optics: Float[Array, "letters wavelengths"],
) -> Float[Array, "nodes wavelengths *rows 1 columns"]:
    """Weights by wavelength, in place of those by history."""
    return jnp.expand_dims(jnp.moveaxis(colour(weights[None], table, optics), -2, 1), -2)


def _coloured(response: Response, setting: Setting) -> Response:
    """The response of order one alone, by wavelength in place of history. It has one trace."""
    assert setting.optics is not None
    short, optics = setting.short, setting.optics

    def by_wavelength(a: Array) -> Array:
        return _one_history(a[:, 0, ..., None], short, optics)[..., 0]

    return Response(
        first=_one_history(response.first[:, 0], short, optics),
        higher=None,
        first_outside=by_wavelength(response.first_outside),
        higher_outside=None,
        arrived=by_wavelength(response.arrived),
        left=by_wavelength(response.left),
        escaped=by_wavelength(response.escaped),
        late=by_wavelength(response.late),
        remaining=by_wavelength(response.remaining),
    )


def without_histories(recording: Recording) -> Recording:
    """The recording of responses to which optics have been applied."""
    return dataclasses.replace(recording, first_degree=0, degree=0)
