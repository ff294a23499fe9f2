r"""Shared illumination: responses of nodes, or of shots, from one trace.

It builds on the light that enters about nodes (`trace.photons.entry_nodes`) and on the fraction of each path
that a shot sees (`trace.first.shot_views`).

What returns is linear in what is sent. A photon that enters at a with the density p(a), ends at b and returns
the weight W

    contributes  W I_f(a) / p(a) * V_f(b)  to the footprint f,

with I_f the irradiance of its beam and V_f the fraction that its receiver sees. Straight down, without a
field of view, V_f = 1, and I_f is nearly a sum of B-splines: then the response is tallied by node, and
footprints are summed afterwards (`trace_nodes`). Otherwise every deposit is added to the shots that see it
(`trace_shots`).
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxlidar._jax.products import einsum
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.trace.device_scene import DeviceScene, aim_at
from jaxlidar.trace.first.first_order import FirstOrder, first_order
from jaxlidar.trace.photons.entry_nodes import EntryNodes
from jaxlidar.trace.photons.higher_orders import HigherOrderTally, trace_higher_orders
from jaxlidar.trace.response import (
    FirstOrderWeights,
    Response,
    first_order_response,
    histories_to_traces,
    join_orders,
    trace_first,
    wavelengths_to_traces,
)


def trace_nodes(scene: DeviceScene, nodes: EntryNodes, key: PRNGKeyArray) -> Response:
    """Trace the response of one batch to light about every node; leading axis: nodes.

    `scene` has parallel light, and optics. Each wavelength is a trace of its own, with one history, for which
    optics are 1.

    1. Order one from few rays about each node, in groups of equal size; sum the groups of each node.
    2. Orders two and above from photons about the nodes, tallied by node and wavelength.
    3. Apply optics to order one; photons had theirs applied on the way.
    """
    assert scene.optics is not None
    ray_key, photon_key = jax.random.split(key)
    n_nodes = len(nodes.position)

    def trace_group(
        x: Float[Array, "rays"], y: Float[Array, "rays"], fraction: Float[Array, ""]
    ) -> FirstOrder:
        return first_order(scene, (x, y), jnp.broadcast_to(fraction, x.shape))

    # Rays of one node are few; groups of equal size let one program trace the rays of all nodes.
    groups = jax.vmap(trace_group)(*nodes.ray_entries(ray_key), nodes.group_fraction)
    first = jax.tree.map(lambda a: jax.ops.segment_sum(a, nodes.group_node, n_nodes), groups)
    histories, optics = scene.first_histories, scene.optics
    apply_optics = jax.vmap(functools.partial(histories_to_traces, histories=histories, optics=optics))
    if not scene.config.follows_higher_orders:
        response = jax.vmap(lambda f: first_order_response(scene, f, f.weights))(first)
        return apply_optics(jax.tree.map(lambda a: a[:, 0], response))
    # Order one has few histories, and keeps them until here; photons had optics applied on the way.
    weights = apply_optics((first.weights, first.outside))
    higher = _split_entries(trace_higher_orders(scene, photon_key, nodes), n_nodes)
    return jax.vmap(join_orders)(weights, higher)


def _split_entries(tally: HigherOrderTally, count: int) -> HigherOrderTally:
    """Split entries into nodes, or shots, as the first axis, and wavelengths, as traces."""

    def split(a: Array) -> Array:
        # Entries come first, or after materials.
        axis = min(a.ndim - 1, 1)
        return jnp.moveaxis(a.reshape(*a.shape[:axis], count, -1, *a.shape[axis + 1 :]), axis, 0)

    return jax.vmap(wavelengths_to_traces)(jax.tree.map(split, tally))


def trace_shots(scene: DeviceScene, lidar: Lidar, nodes: EntryNodes, key: PRNGKeyArray) -> Response:
    """Trace the response of one batch to light about nodes, as each shot sees it; leading axis: shots.

    `scene` has `shot_views`. Order one of its `first_order_shots` is traced from rays of their own.

    1. Orders two and above from photons about the nodes, tallied by shot and wavelength.
    2. Order one of each shot, from the rays of its own beam.
    3. The energy budget from nodes, by the coefficients of each shot's spline.
    4. Drop the dummy shot.
    """
    views = scene.shot_views
    assert views is not None
    ray_key, photon_key = jax.random.split(key)
    tally = trace_higher_orders(scene, photon_key, nodes)

    # Order one is traced with the group of nodes that owns the shot, once; to other groups it adds zero.
    def to_all_shots(a: Array) -> Array:
        return jnp.zeros((views.n_shots, *a.shape[1:]), a.dtype).at[views.first_order_shots].set(a)

    # The budget was tallied by node. To shots it goes by the splines' coefficients, with the grid's error,
    # which is tolerable for what no receiver records.
    def from_nodes(a: Array) -> Array:
        by_node = a.reshape(*a.shape[:-1], len(nodes.position), -1)
        return einsum("sn,...nw->...sw", views.node_coefficients, by_node).reshape(*a.shape[:-1], -1)

    names = ("arrived", "departed", "escaped", "flown_outside", "unfollowed")
    tally = dataclasses.replace(tally, **{name: from_nodes(getattr(tally, name)) for name in names})
    first = jax.tree.map(to_all_shots, trace_first_of_shots(scene, lidar, views.first_order_shots, ray_key))
    response = jax.vmap(join_orders)(first, _split_entries(tally, views.n_shots))
    # The last is the dummy shot.
    return jax.tree.map(lambda a: a[:-1], response)


def trace_first_of_shots(
    scene: DeviceScene, lidar: Lidar, shots: Int[Array, "shots"], key: PRNGKeyArray
) -> tuple[
    Float[Array, "shots traces materials first_histories bins"],
    Float[Array, "shots traces materials first_histories"],
]:
    """Trace order one of shots of `scene.shot_views`, one after the other, each from rays of its own beam.

    **Returns:** as `trace_first`, for each shot.
    """
    views = scene.shot_views
    assert views is not None

    def trace_shot(number: Array) -> FirstOrderWeights:
        # The first order depends on the shot's own divergent rays: a narrow beam through a coarse map would
        # show the difference.
        shot_scene = aim_at(dataclasses.replace(scene, shot_views=None), lidar, views.position[number])
        return trace_first(shot_scene, jax.random.fold_in(key, number))

    return jax.lax.map(trace_shot, shots)
