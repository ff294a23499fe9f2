"""How many geometric columns of a Jacobian are pushed through the trace at once: as many as memory allows."""

import os

import jax.numpy as jnp

from jaxlidar import Plan, Scene
from jaxlidar.planning.memory import in_words, memory_limit, response_bytes
from jaxlidar.planning.plan import MIN_BATCHES

# Tangents of a response that are alive at once, for each column: the sum of photons, and the result.
_COPIES = 2
# Tangents of a photon, and of a stretch of a ray, that are alive at once; rays that are marched at once.
_NUMBERS, _RAYS = 4, 512


def jacobian_bytes(plan: Plan, scene: Scene, wavelengths: int, columns: int) -> float:
    """Bytes that an evaluation with `columns` at once takes, beside what compiling does.

    The responses of all batches are kept for the optical columns; batches run on all cores.
    """
    cores = min(os.cpu_count() or 1, MIN_BATCHES)
    keeps, straight = plan.trace.keeps_histories, scene.canopy is not None and scene.canopy.is_straight
    traces = wavelengths if straight or not keeps else 1
    response = response_bytes(plan.trace, plan.bins, plan.least_degree, plan.first_degree, traces)
    light = plan.n_photons + min(plan.n_rays, _RAYS) * plan.trace.first_steps
    each = _COPIES * response + _NUMBERS * light * jnp.zeros(()).dtype.itemsize
    return (MIN_BATCHES + 1) * response + cores * (response + columns * each)


def columns_at_once(plan: Plan, scene: Scene, wavelengths: int, columns: int) -> int:
    """The number of columns that are pushed through the trace at once; groups of them are about as large.

    **Raises:** ValueError where one column alone takes more memory than the plan may.
    """
    most, limit = columns, memory_limit(plan.limits.max_memory)
    while most > 1 and jacobian_bytes(plan, scene, wavelengths, most) > limit:
        most -= 1
    if columns and (size := jacobian_bytes(plan, scene, wavelengths, most)) > limit:
        raise ValueError(
            f"derivatives in the geometric unknowns would take about {in_words(size)} of memory, one at a "
            f"time; admissible is max_memory = {limit / 1e9:.3g} GB of the plan: follow fewer orders "
            "(max_orders=), record a shorter window, have fewer plates or materials, or give a plan with more"
        )
    return -(-columns // -(-columns // most)) if columns else 0
