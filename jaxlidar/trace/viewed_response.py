"""The response of a scene to light that shots share, by shot, where each has a part of every path of it."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from jaxlidar.instrument.lidar import Lidar
from jaxlidar.trace.higher_orders import higher_orders
from jaxlidar.trace.nodes import Nodes
from jaxlidar.trace.response import First, Response, trace_first
from jaxlidar.trace.setting import Setting, aimed


def trace_viewed(setting: Setting, lidar: Lidar, nodes: Nodes, key: PRNGKeyArray) -> Response:
    """The response of one batch to light about nodes, as `trace_nodes`; leading axis: shots.

    `setting` has a `viewing`, whose own shots get their order one, each from rays of its own.
    """
    viewing, optics = setting.viewing, setting.optics
    assert viewing is not None
    assert optics is not None
    ray_key, photon_key = jax.random.split(key)
    higher, shots, wavelengths = higher_orders(setting, photon_key, nodes), viewing.shots, optics.shape[1]

    def of_own(a: Array) -> Array:
        return jnp.zeros((shots, *a.shape[1:]), a.dtype).at[viewing.own].set(a)

    def by_shot(a: Array) -> Array:
        return jnp.moveaxis(a.reshape(len(a), shots, wavelengths, *a.shape[2:]), (1, 2), (0, 1))

    def from_nodes(a: Array) -> Array:
        by_node = a.reshape(*a.shape[:-1], -1, wavelengths)
        return jnp.einsum("sn,...nw->sw...", viewing.part, by_node)[..., None]

    first = jax.tree.map(of_own, order_one(setting, lidar, viewing.own, ray_key))
    response = Response(
        first=first.weights,
        higher=jnp.expand_dims(by_shot(higher.weights), 3),
        first_outside=first.outside,
        higher_outside=by_shot(higher.outside)[..., None],
        arrived=from_nodes(higher.arrived),
        left=from_nodes(higher.left),
        escaped=from_nodes(higher.escaped),
        late=from_nodes(higher.late),
        remaining=from_nodes(higher.remaining),
    )
    # The last is no shot.
    return jax.tree.map(lambda a: a[:-1], response)


def order_one(setting: Setting, lidar: Lidar, shots: Int[Array, "shots"], key: PRNGKeyArray) -> First:
    """Order one of shots of the setting's `viewing`, one after the other, each from rays of its own beam."""
    viewing = setting.viewing
    assert viewing is not None

    def alone(number: Array) -> First:
        there = aimed(dataclasses.replace(setting, viewing=None), lidar, viewing.place[number])
        return trace_first(there, None, jax.random.fold_in(key, number))

    return jax.lax.map(alone, shots)
