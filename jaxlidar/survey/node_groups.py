"""Groups of nodes that are traced together: the photons of each node, and the footprints that use them.

Nodes are those of `jaxlidar.survey.footprint_splines` with a coefficient of any footprint. A node gets
photons in proportion to its largest coefficient, over all footprints, so that no footprint rests on few
photons where it is bright. Groups are made by halving the illuminated nodes until each is small enough; all
have one shape, for which one program is compiled.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.survey.footprint_splines import FootprintSplines
from jaxlidar.trace.photons.entry_nodes import RAYS_PER_GROUP

# Largest number of nodes of a group, and of photons and of rays of a batch if a group has several nodes: a
# batch cannot be interrupted. A ray deposits light in every voxel that it crosses, a photon at two points of
# a flight.
_MAX_NODES, _MAX_PHOTONS, _MAX_RAYS = 512, 32_768, 2048


class NodeAllocation(NamedTuple):
    """Photons, or groups of rays, allocated to nodes.

    - `node`: of each. - `rank`: number of each within its node. - `fraction`: of the node's light that each
      carries.
    """

    node: Int[np.ndarray, " photons"]
    rank: Int[np.ndarray, " photons"]
    fraction: Float[np.ndarray, " photons"]


class NodeGroup(NamedTuple):
    """Nodes that are traced together.

    - `aim`: (2,) position of the middle, m. - `node_position`: (nodes, 2) from there, m.
    - `photons`, `rays`: allocated to the nodes, as in `trace.photons.entry_nodes.EntryNodes`.
    - `shots`: numbers of the footprints with a coefficient in the group.
    - `coefficients`, `misplaced_energy`: (shots, nodes), as in `FootprintSplines`.
    - `has_centre`: (shots,) whether the node next to the footprint's centre is in the group: it is in one
      alone.
    """

    aim: Float[np.ndarray, "2"]
    node_position: Float[np.ndarray, "nodes 2"]
    photons: NodeAllocation
    rays: NodeAllocation
    shots: Int[np.ndarray, " shots"]
    coefficients: Float[np.ndarray, "shots nodes"]
    misplaced_energy: Float[np.ndarray, "shots nodes"]
    has_centre: Bool[np.ndarray, " shots"]


class IlluminatedNodes(NamedTuple):
    """Nodes with a coefficient of any footprint.

    - `index`: (nodes, 2) numbers along x and y.
    - `light`: (nodes,) largest coefficient of any footprint, over the largest of all; at most 1.
    - `overlap`: mean number of footprints that share the light of a node: the sum of |c_fn| over footprints
      and nodes, over the sum over nodes of the largest.
    """

    index: Int[np.ndarray, "nodes 2"]
    light: Float[np.ndarray, " nodes"]
    overlap: float


def illuminated_nodes(splines: FootprintSplines, threshold: float) -> IlluminatedNodes:
    """Return the nodes that footprints illuminate, in the order of their numbers.

    `threshold`: coefficients at most this fraction of the largest do not count.

    1. For each block of footprints: the nodes with a larger coefficient, as integer keys, and for each node
       the largest coefficient of the block.
    2. The same over all blocks.
    """
    width = splines.coefficients.shape[1]
    lowest = splines.first_node.min(axis=0)
    span = splines.first_node.max(axis=0) - lowest + width
    largest = float(splines.coefficients.max())
    keys, lights, total_light = [], [], 0.0
    offsets = np.arange(width)
    # Block by block: all coefficients of many footprints at once take too much memory.
    for start in range(0, len(splines.first_node), 1024):
        first_node = splines.first_node[start : start + 1024] - lowest
        light = np.abs(splines.coefficients[start : start + 1024]).reshape(len(first_node), -1) / largest
        x, y = (first_node[:, k, None] + offsets for k in range(2))
        # One integer for each node of the rectangle around all footprints.
        key = (x[:, :, None] * span[1] + y[:, None, :]).reshape(len(first_node), -1)
        is_significant = light > threshold
        total_light += float(light.sum())
        block_keys, block_light = _largest_by_key(key[is_significant], light[is_significant])
        keys.append(block_keys)
        lights.append(block_light)
    # Without overlap, each node has light of one footprint alone, the largest one: the quotient is 1.
    node_key, node_light = _largest_by_key(np.concatenate(keys), np.concatenate(lights))
    index = np.stack(np.divmod(node_key, span[1]), axis=-1) + lowest
    return IlluminatedNodes(index, node_light, total_light / float(node_light.sum()))


def _largest_by_key(
    keys: Int[np.ndarray, " values"], values: Float[np.ndarray, " values"]
) -> tuple[Int[np.ndarray, " unique"], Float[np.ndarray, " unique"]]:
    """Return the unique keys in ascending order, and the largest non-negative value of each."""
    unique, inverse = np.unique(keys, return_inverse=True)
    largest = np.zeros(len(unique))
    np.maximum.at(largest, inverse, values)
    return unique, largest


def make_groups(
    splines: FootprintSplines, nodes: IlluminatedNodes, photons: float, rays: float
) -> list[NodeGroup]:
    """Return all groups, of one shape.

    `photons`, `rays`: those of a batch at a node with `light` one; photons may be 0.
    """
    largest_light = max(1.0 / max(photons / _MAX_PHOTONS, rays / _MAX_RAYS), 1.0)
    members = _halve(nodes, np.arange(len(nodes.light)), largest_light)
    size = size_bucket(max(len(group) for group in members), 4)
    # The brightest group determines the shape; darker ones get as many photons, and need fewer batches.
    light = max(float(nodes.light[group].sum()) for group in members)
    n_photons, n_ray_groups = (
        size_bucket(max(int(np.ceil(light * per_light)), size), 4) if per_light else 0
        for per_light in (photons, rays / RAYS_PER_GROUP)
    )
    return [_make_group(splines, nodes, group, size, n_photons, n_ray_groups) for group in members]


def _halve(
    nodes: IlluminatedNodes, group: Int[np.ndarray, " nodes"], largest_light: float
) -> list[Int[np.ndarray, " _"]]:
    """Halve a group across its longer side until each part is small enough."""
    light = nodes.light[group]
    if len(group) == 1 or (len(group) <= _MAX_NODES and light.sum() <= largest_light):
        return [group]
    index = nodes.index[group]
    axis = int(np.argmax(np.ptp(index, axis=0)))
    order = np.argsort(index[:, axis], kind="stable")
    # Equal light on both sides, or equal numbers where the number of nodes is what is too large.
    cumulative = np.cumsum(light[order]) if light.sum() > largest_light else np.arange(1.0, len(group) + 1)
    # Neither half is empty, also where one node has more than half of the light.
    cut = int(np.clip(np.searchsorted(cumulative, 0.5 * cumulative[-1]), 1, len(group) - 1))
    halves = group[order[:cut]], group[order[cut:]]
    return [small_group for half in halves for small_group in _halve(nodes, half, largest_light)]


def _make_group(
    splines: FootprintSplines,
    nodes: IlluminatedNodes,
    group: Int[np.ndarray, " nodes"],
    size: int,
    n_photons: int,
    n_ray_groups: int,
) -> NodeGroup:
    """Return a group filled up to `size` nodes with copies of its first node that get no photons."""
    index, padding = nodes.index[group], size - len(group)
    middle = np.round(0.5 * (index.min(axis=0) + index.max(axis=0)))
    # Photons and rays refer to nodes by number, and none to the copies.
    padded_index = np.concatenate([index, np.repeat(index[:1], padding, axis=0)])
    ray_groups = _allocate(nodes.light[group], n_ray_groups)
    shots, coefficients, misplaced = _footprints_of(splines, index)
    return NodeGroup(
        aim=middle * splines.spacing,
        node_position=(padded_index - middle) * splines.spacing,
        photons=_allocate(nodes.light[group], n_photons),
        # Rays come in groups of RAYS_PER_GROUP, of which the number of the first is known.
        rays=NodeAllocation(
            ray_groups.node, RAYS_PER_GROUP * ray_groups.rank, ray_groups.fraction / RAYS_PER_GROUP
        ),
        shots=shots,
        coefficients=np.pad(coefficients, ((0, 0), (0, padding))),
        misplaced_energy=np.pad(misplaced, ((0, 0), (0, padding))),
        has_centre=_have_centre(splines, shots, index),
    )


def _allocate(light: Float[np.ndarray, " nodes"], total: int) -> NodeAllocation:
    """Allocate `total` photons to nodes in proportion to their light, and one to each at least."""
    if total == 0:
        return NodeAllocation(np.zeros(0, int), np.zeros(0, int), np.zeros(0))
    # A node without photons would lose its light, and footprints that use it would be too dark on average.
    surplus = total - len(light)
    count = 1 + np.floor(surplus * light / light.sum()).astype(int)
    # What was lost by rounding down goes to the brightest.
    unallocated = total - count.sum()
    count[np.argsort(-light, kind="stable")[:unallocated]] += 1
    node = np.repeat(np.arange(len(light)), count)
    rank = np.arange(total) - np.repeat(np.cumsum(count) - count, count)
    return NodeAllocation(node, rank, 1.0 / count[node])


def _have_centre(
    splines: FootprintSplines, shots: Int[np.ndarray, " shots"], index: Int[np.ndarray, "nodes 2"]
) -> Bool[np.ndarray, " shots"]:
    """Return True for shots whose central node is among the nodes."""
    # A footprint is brightest there, so that the node is illuminated and belongs to exactly one group.
    centre = splines.first_node[shots] + splines.coefficients.shape[1] // 2
    return np.any(np.all(centre[:, None, :] == index[None, :, :], axis=2), axis=1)


def _footprints_of(
    splines: FootprintSplines, index: Int[np.ndarray, "nodes 2"]
) -> tuple[Int[np.ndarray, " shots"], Float[np.ndarray, "shots nodes"], Float[np.ndarray, "shots nodes"]]:
    """Return the shots that use the nodes, their coefficients, and the energy that they misplace there."""
    width = splines.coefficients.shape[1]
    # First the shots whose patch of nodes overlaps the group's bounding rectangle, then those with a
    # coefficient in it.
    low, high = index.min(axis=0), index.max(axis=0)
    shots = np.flatnonzero(np.all((splines.first_node <= high) & (splines.first_node + width > low), axis=1))
    offset = index[None, :, :] - splines.first_node[shots, None, :]
    inside = np.all((offset >= 0) & (offset < width), axis=2)
    x, y = (np.clip(offset[..., k], 0, width - 1) for k in range(2))
    coefficients, misplaced = (
        np.where(inside, a[shots[:, None], x, y], 0.0)
        for a in (splines.coefficients, splines.misplaced_energy)
    )
    illuminated = np.any(np.abs(coefficients) > 0, axis=1)
    return (
        shots[illuminated],
        coefficients[illuminated].astype(np.float32),
        misplaced[illuminated].astype(np.float32),
    )
