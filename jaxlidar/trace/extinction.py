"""Derivatives of a waveform by what changes extinction alone: no tangent goes through the march.

Where light goes, and when, depends on extinction only through what is drawn, and that is held fixed. So the
derivative of the weight of a path is the weight times

    sum over collisions of dk / k  -  integral of dk along the path and the way back,

the path's score (the likelihood ratio of Glynn 1990, Commun. ACM 33, 75). Values are those of forward
derivatives of `jaxlidar.trace_scene`, to rounding.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxlidar.planning.setup import Setup
from jaxlidar.trace.colouring import columns_in_samples, recording_of, total
from jaxlidar.trace.response import Response, trace_scored
from jaxlidar.trace.scored_light import scores_of
from jaxlidar.trace.setting import setting_of

Slopes = tuple[Float[Array, "columns cells"] | None, Float[Array, "columns cells"] | None]


def can_be_scored(setup: Setup) -> bool:
    """Whether derivatives by extinction are known for the setup without tangents."""
    canopy = setup.scene.canopy
    return canopy is not None and not canopy.is_straight and setup.plan.trace.keeps_histories


def slopes_of(setup_at: Callable[[Array], Setup], flat: Float[Array, "columns"]) -> Slopes:
    """Derivatives of the extinction of leaf and bark by the numbers that a setup is a function of."""

    def tables(flat: Array) -> tuple[Array | None, Array | None]:
        medium = setting_of(setup_at(flat), derivatives="forward").medium
        assert medium is not None
        return medium.leaf, medium.bark

    push = jax.vmap(lambda way: jax.jvp(tables, (flat,), (way,))[1])
    return push(jnp.eye(flat.size, dtype=flat.dtype))


def most_columns(slopes: Slopes) -> Array:
    """The most columns that move one voxel."""
    return jnp.max(jnp.sum(jnp.any(jnp.stack([s for s in slopes if s is not None]) != 0, axis=0), axis=0))


def total_and_columns(
    setup_at: Callable[[Array], Setup], flat: Float[Array, "columns"], key: PRNGKeyArray, most: int
) -> tuple[Response, Float[Array, "wavelengths samples"], Float[Array, "columns wavelengths samples"]]:
    """Response and total of one batch, and the total's derivatives.

    **Arguments:**

    - `setup_at`: the setup as a function of numbers that change extinction alone.
    - `flat`: these numbers.
    - `most`: columns that move one voxel at most. Derivatives are NaN where there are more.
    """
    setup = setup_at(flat)
    setting, recording = setting_of(setup, derivatives="forward"), recording_of(setup)
    scores = scores_of(setting, *slopes_of(setup_at, flat), recording.optics, most)
    response, fine = trace_scored(dataclasses.replace(setting, scores=scores), recording.optics, key)
    return response, total(response, recording), columns_in_samples(fine, recording)
