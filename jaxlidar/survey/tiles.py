"""Tiles: nodes that are traced together, the light that each gets, and the footprints that they are in."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.survey.irradiance import Patches
from jaxlidar.trace.entry_nodes import RAYS_PER_GROUP

# Nodes of a tile at most, and photons of a batch if a tile has several nodes: a batch cannot be interrupted.
_MOST_NODES, _MOST_PHOTONS = 512, 32_768


class SharedOut(NamedTuple):
    """Things shared out among nodes: the node of each, its number there, and its share of the node."""

    node: Int[np.ndarray, " things"]
    turn: Int[np.ndarray, " things"]
    share: Float[np.ndarray, " things"]


class Tile(NamedTuple):
    """Nodes that are traced together.

    - `aim`: (2,) place of the middle, m. - `place`: (nodes, 2) of the nodes from there, m.
    - `photons`, `rays`: node, turn and share of each, as in `jaxlidar.trace.entry_nodes.EntryNodes`.
    - `shots`: numbers of the footprints that have part in it. - `part`: (shots, nodes) coefficients.
    - `astray`: (shots, nodes) energy that is put elsewhere about the nodes.
    - `home`: (shots,) whether the node next to the middle of the footprint is in it.
    """

    aim: Float[np.ndarray, "2"]
    place: Float[np.ndarray, "nodes 2"]
    photons: "SharedOut"
    rays: "SharedOut"
    shots: Int[np.ndarray, " shots"]
    part: Float[np.ndarray, "shots nodes"]
    astray: Float[np.ndarray, "shots nodes"]
    home: Bool[np.ndarray, " shots"]


class Lit(NamedTuple):
    """The nodes that any footprint lights: numbers along x and y, and the largest coefficient, at most 1.

    - `overlap`: mean number of footprints that share the light of a node.
    """

    number: Int[np.ndarray, "nodes 2"]
    light: Float[np.ndarray, " nodes"]
    overlap: float


def lit(found: Patches, faint: float) -> Lit:
    """The nodes that footprints light, in the order of their numbers.

    `faint`: share of the largest coefficient below which others do not count.
    """
    size = found.coefficients.shape[1]
    low = found.first.min(axis=0)
    span = found.first.max(axis=0) - low + size
    largest = float(found.coefficients.max())
    keys, lights, whole = [], [], 0.0
    within = np.arange(size)
    for start in range(0, len(found.first), 1024):
        first = found.first[start : start + 1024] - low
        light = np.abs(found.coefficients[start : start + 1024]).reshape(len(first), -1) / largest
        x, y = (first[:, k, None] + within for k in range(2))
        key = (x[:, :, None] * span[1] + y[:, None, :]).reshape(len(first), -1)
        there = light > faint
        whole += float(light.sum())
        unique, where = np.unique(key[there], return_inverse=True)
        most = np.zeros(len(unique))
        np.maximum.at(most, where, light[there])
        keys.append(unique)
        lights.append(most)
    unique, where = np.unique(np.concatenate(keys), return_inverse=True)
    most = np.zeros(len(unique))
    np.maximum.at(most, where, np.concatenate(lights))
    number = np.stack(np.divmod(unique, span[1]), axis=-1) + low
    return Lit(number, most, whole / float(most.sum()))


def tiles(found: Patches, nodes: Lit, photons: float, rays: float) -> list[Tile]:
    """All tiles, of one size. `photons`, `rays`: of a fully lit node in a batch; photons may be 0."""
    most_light = max(_MOST_PHOTONS / max(photons, 16 * rays), 1.0)
    groups = _halved(nodes, np.arange(len(nodes.light)), most_light)
    most = size_bucket(max(len(group) for group in groups), 4)
    light = max(float(nodes.light[group].sum()) for group in groups)
    counts = [
        size_bucket(max(int(np.ceil(light * n)), most), 4) if n else 0
        for n in (photons, rays / RAYS_PER_GROUP)
    ]
    return [_tile(found, nodes, group, most, counts) for group in groups]


def _halved(nodes: Lit, group: Int[np.ndarray, " nodes"], most_light: float) -> list[Int[np.ndarray, " _"]]:
    """Groups of nodes side by side, halved across their longer side until each is small enough."""
    light = nodes.light[group]
    if len(group) == 1 or (len(group) <= _MOST_NODES and light.sum() <= most_light):
        return [group]
    number = nodes.number[group]
    axis = int(np.argmax(np.ptp(number, axis=0)))
    order = np.argsort(number[:, axis], kind="stable")
    # Equal light on both sides, or equal numbers where nodes are many.
    share = np.cumsum(light[order]) if light.sum() > most_light else np.arange(1.0, len(group) + 1)
    cut = int(np.clip(np.searchsorted(share, 0.5 * share[-1]), 1, len(group) - 1))
    halves = group[order[:cut]], group[order[cut:]]
    return [part for half in halves for part in _halved(nodes, half, most_light)]


def _tile(found: Patches, nodes: Lit, group: Int[np.ndarray, " nodes"], most: int, counts: list[int]) -> Tile:
    number = nodes.number[group]
    spare = most - len(group)
    middle = np.round(0.5 * (number.min(axis=0) + number.max(axis=0)))
    place = np.concatenate([number, np.repeat(number[:1], spare, axis=0)]) - middle
    photons, groups = (_shared_out(nodes.light[group], count) for count in counts)
    shots, part, astray = _parts(found, number)
    return Tile(
        aim=middle * found.spacing,
        place=place * found.spacing,
        photons=photons,
        rays=SharedOut(groups.node, RAYS_PER_GROUP * groups.turn, groups.share / RAYS_PER_GROUP),
        shots=shots,
        part=np.pad(part, ((0, 0), (0, spare))),
        astray=np.pad(astray, ((0, 0), (0, spare))),
        home=_home(found, shots, number),
    )


def _shared_out(light: Float[np.ndarray, " nodes"], things: int) -> SharedOut:
    """So many things by node, in proportion to its light, and one for each at least."""
    if things == 0:
        return SharedOut(np.zeros(0, int), np.zeros(0, int), np.zeros(0))
    spare = things - len(light)
    count = 1 + np.floor(spare * light / light.sum()).astype(int)
    left = things - count.sum()
    count[np.argsort(-light, kind="stable")[:left]] += 1
    node = np.repeat(np.arange(len(light)), count)
    turn = np.arange(things) - np.repeat(np.cumsum(count) - count, count)
    return SharedOut(node, turn, 1.0 / count[node])


def _home(
    found: Patches, shots: Int[np.ndarray, " shots"], number: Int[np.ndarray, "nodes 2"]
) -> Bool[np.ndarray, " shots"]:
    """Whether the middle nodes of patches are among the nodes."""
    middle = found.first[shots] + found.coefficients.shape[1] // 2
    return np.any(np.all(middle[:, None, :] == number[None, :, :], axis=2), axis=1)


def _parts(
    found: Patches, number: Int[np.ndarray, "nodes 2"]
) -> tuple[Int[np.ndarray, " shots"], Float[np.ndarray, "shots nodes"], Float[np.ndarray, "shots nodes"]]:
    """Which footprints have part in the nodes, their coefficients there, and what is put elsewhere."""
    size = found.coefficients.shape[1]
    low, high = number.min(axis=0), number.max(axis=0)
    shots = np.flatnonzero(np.all((found.first <= high) & (found.first + size > low), axis=1))
    off = number[None, :, :] - found.first[shots, None, :]
    inside = np.all((off >= 0) & (off < size), axis=2)
    x, y = (np.clip(off[..., k], 0, size - 1) for k in range(2))
    part, astray = (
        np.where(inside, a[shots[:, None], x, y], 0.0) for a in (found.coefficients, found.astray)
    )
    there = np.any(np.abs(part) > 0, axis=1)
    return shots[there], part[there].astype(np.float32), astray[there].astype(np.float32)
