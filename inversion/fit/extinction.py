"""Unknowns that change extinction alone: their columns are scored, and not pushed through the trace.

This is exact (`jaxlidar.trace.score_functions`), and takes less than half of the time for a column, where

- histories keep optics apart, and no leaf transmits straight on, so that one trace serves all wavelengths;
- wavelengths and columns are few, so that all can be added up for every collision; off nadir, two or more.

Elsewhere such unknowns are treated like any others that move light.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from inversion.fit.unknowns import Place, Settled, put
from jaxlidar import Lidar, Plan, Response, Scene, Setup, make_setup
from jaxlidar.planning.memory import memory_limit, scored_bytes
from jaxlidar.spectral.apply_optics import derivatives_to_samples, make_waveform_model, setup_optics
from jaxlidar.trace.device_scene import build_device_scene
from jaxlidar.trace.extinction_slopes import ExtinctionSlopes
from jaxlidar.trace.response import trace_with_scores
from jaxlidar.trace.score_functions import make_slopes

# The most columns and wavelengths. All are added up for every collision.
COLUMNS, WAVELENGTHS = 64, 16
# Where one voxel is moved by no more than so many of more than a few columns, it has the numbers of its own:
# that is faster than slopes in all columns.
OVERLAP, FEW = 2, 8
# Places between the bounds where that is looked up.
PROBES = 4


def sorted_places(
    lidar: Lidar, scene: Scene, plan: Plan, settled: Sequence[Settled]
) -> tuple[tuple[Place, ...], int, float]:
    """Places of unknowns, the most columns that move the extinction of one voxel, and the bytes of scores.

    Those that change extinction are scored where this module says so, and else are geometric.
    """
    places = [s.place for s in settled]
    if not plan.config.keeps_histories:
        # Optics are applied while light is traced.
        return tuple(place._replace(kind="geometric") for place in places), 0, 0.0
    own = [i for i, place in enumerate(places) if place.kind == "extinction"]
    columns = sum(settled[i].start.size for i in own)
    if columns == 0:
        return tuple(places), 0, 0.0
    # A plan may leave the canopy out.
    canopy, wavelengths = make_setup(lidar, scene, plan).scene.canopy, lidar.wavelength.size
    # Off nadir a second march, of the way back, takes as long as the tangents of one column.
    pays = (1 if plan.config.vertical else 2) <= columns <= COLUMNS and wavelengths <= WAVELENGTHS
    if canopy is not None and not canopy.is_straight and pays:
        cells = int(np.prod(canopy.voxels.shape))
        room = scored_bytes(plan.config, plan.bins, cells=cells, columns=columns, wavelengths=wavelengths)
        if room <= 0.5 * memory_limit(plan.scope.max_memory):
            return tuple(places), _most(scene, settled, own), room
    as_geometric = {i: places[i]._replace(kind="geometric") for i in own}
    return tuple(as_geometric.get(i, place) for i, place in enumerate(places)), 0, 0.0


def _most(scene: Scene, settled: Sequence[Settled], own: list[int]) -> int:
    """The most columns that move the extinction of one voxel: few where that is sure, else all of them.

    It is found at the start and at places between the bounds of all unknowns, and as if leaf and bark were
    everywhere, for scenes that are fitted together may have them in other voxels.
    """
    columns = sum(settled[i].start.size for i in own)
    if columns <= FEW:
        return columns
    places, random = tuple(s.place for s in settled), np.random.default_rng(0)
    points = [tuple(s.start for s in settled)]
    for _ in range(PROBES):
        shares = [random.uniform(size=s.start.shape) for s in settled]
        between = [s.low + share * (s.high - s.low) for s, share in zip(settled, shares)]
        points.append(tuple(jnp.asarray(b, s.start.dtype) for s, b in zip(settled, between)))
    everywhere = eqx.tree_at(_tables, scene, replace_fn=jnp.ones_like)
    cases = [(where, values) for where in (scene, everywhere) for values in points]
    still = [jnp.zeros_like(s.start) for s in settled]
    count = np.zeros(())
    for i in own:
        for element in range(settled[i].start.size):
            direction = list(still)
            direction[i] = still[i].reshape(-1).at[element].set(1.0).reshape(still[i].shape)
            count = count + np.stack([_moved(s, values, places, tuple(direction)) for s, values in cases])
    most = int(np.max(count))
    return most if most <= OVERLAP else columns


def _tables(scene: Any) -> list[Any]:
    """Extinction of leaf and bark, of those that the canopy has."""
    voxels = scene.canopy.voxels
    return [t for t in (voxels.leaf, voxels.bark) if t is not None]


@eqx.filter_jit
def _moved(
    scene: Scene, values: tuple[Array, ...], places: tuple[Place, ...], direction: tuple[Array, ...]
) -> Bool[Array, "nx ny nz"]:
    """Which voxels' extinction moves with the values along a direction."""
    tables = jax.jvp(lambda values: _tables(put(scene, places, values)), (values,), (direction,))[1]
    return jnp.any(jnp.stack(tables) != 0, axis=0)


def scores_at(
    setup_at: Callable[[Array], Setup], flat: Float[Array, "columns"], most: int
) -> ExtinctionSlopes | None:
    """Scores of the unknowns in `flat`, of which `setup_at` makes the setup; None where there are none."""
    if not flat.size:
        return None

    def tables(flat: Array) -> tuple[Array | None, Array | None]:
        medium = build_device_scene(setup_at(flat), derivatives="forward").medium
        assert medium is not None
        return medium.leaf, medium.bark

    push = jax.vmap(lambda t: jax.jvp(tables, (flat,), (t,))[1])
    leaf, bark = push(jnp.eye(flat.size, dtype=flat.dtype))
    setup = setup_at(flat)
    return make_slopes(
        build_device_scene(setup, derivatives="forward"), leaf, bark, setup_optics(setup), most
    )


def traced_with(
    setup: Setup, slopes: ExtinctionSlopes, key: PRNGKeyArray
) -> tuple[Response, Float[Array, "columns wavelengths samples"]]:
    """The response of one batch, and the derivatives of its total by what is scored."""
    device_scene = dataclasses.replace(build_device_scene(setup, derivatives="forward"), slopes=slopes)
    response, fine = trace_with_scores(device_scene, setup_optics(setup), key)
    return response, derivatives_to_samples(fine, make_waveform_model(setup))
