"""Memory that a simulation takes, predicted before anything is allocated."""

import math
import os

import jax.numpy as jnp

from jaxlidar.planning.trace_plan import DENSE, Bins, TracePlan

# Copies of a batch's response that are alive at once: sums of photons, of groups, and the result.
_COPIES = 3
# Tangents of a response that are alive at once, for each column of a Jacobian: the sum of photons, and the
# result.
_TANGENTS = 2
# Tangents of a photon, and of a stretch of a ray, that are alive at once; rays that are marched at once.
_NUMBERS, _RAYS = 4, 512
# Bytes that compiling takes.
_COMPILING = 150e6
# Bytes of a response from which on optics may be applied while light is traced, and for how many wavelengths.
LARGE = 1e9
FEW = 8


def machine_memory() -> float:
    """Bytes of memory of this machine; 8 GB where that cannot be known."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):
        return 8e9


def response_bytes(trace: TracePlan, bins: Bins, degree: int, first_degree: int, traces: int) -> float:
    """Bytes of a response of `traces` traces, with histories of these degrees."""
    item = jnp.result_type(float).itemsize
    letters, materials = len(trace.letters), len(trace.materials)
    full = math.comb(degree + letters, letters) if trace.order_steps > 1 or trace.drawn_first else 0
    short = math.comb(first_degree + letters, letters)
    return float(item * traces * materials * (full + short) * bins.padded)


def predicted(
    trace: TracePlan, bins: Bins, degree: int, first_degree: int, samples: int, pulse: int, traces: int
) -> float:
    """Bytes of the responses of all batches that run at once, their sum, the pulse, and of compiling.

    **Arguments:** `degree`, `first_degree`: of histories. - `samples`: of the record. - `pulse`: fine bins
    that the pulse spans. - `traces`: of a response; one for each wavelength where leaves transmit straight
    on.
    """
    response = response_bytes(trace, bins, degree, first_degree, traces)
    matrix = jnp.result_type(float).itemsize * min(bins.count * samples, max(DENSE, pulse))
    return response * (_COPIES * (os.cpu_count() or 1) + 1) + 2 * matrix + _COMPILING


def keeps_histories(kept: float, applied: float, limit: float, wavelengths: int) -> bool:
    """Whether histories keep optics apart, so that one trace serves all wavelengths and all optics.

    Optics are applied while light is traced where histories take far more memory, `kept` in place of
    `applied` bytes, and wavelengths, whose deposits are then made one by one, are few.
    """
    return kept <= min(limit, LARGE) or applied >= kept or wavelengths > FEW


def jacobian_bytes(
    trace: TracePlan,
    bins: Bins,
    degree: int,
    first_degree: int,
    traces: int,
    light: tuple[int, int],
    batches: int,
    columns: int,
) -> float:
    """Bytes of an evaluation of so many columns of a geometric Jacobian at once, beside what compiling takes.

    The responses of all batches are kept for the optical columns; batches run on all cores.

    **Arguments:** as `predicted`, and `light`: photons and rays of a batch.
    """
    cores = min(os.cpu_count() or 1, batches)
    response = response_bytes(trace, bins, degree, first_degree, traces)
    photons, rays = light
    moving = photons + min(rays, _RAYS) * trace.first_steps
    each = _TANGENTS * response + _NUMBERS * moving * jnp.result_type(float).itemsize
    return (batches + 1) * response + cores * (response + columns * each)


def scored_bytes(
    trace: TracePlan, bins: Bins, light: tuple[int, int], cells: int, columns: int, wavelengths: int
) -> float:
    """Bytes that derivatives in so many unknowns which change extinction alone take on all cores.

    **Arguments:** `light`: photons and rays of a batch. - `cells`: voxels.
    """
    photons, rays = light
    rows = columns * wavelengths * bins.padded
    moving = photons + min(rays, _RAYS) * trace.first_steps
    each = _COPIES * rows + _TANGENTS * columns * moving
    tables = 4 * columns * cells
    return float(jnp.result_type(float).itemsize * ((os.cpu_count() or 1) * each + tables))


def in_words(size: float) -> str:
    """Bytes, MB or GB, to two digits."""
    for unit, one in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= one:
            return f"{float(f'{size / one:.2g}'):g} {unit}"
    return f"{size:.0f} bytes"


def memory_limit(most: float | None) -> float:
    """Bytes that a simulation may take: `most` GB, or a quarter of the machine's memory."""
    return 0.25 * machine_memory() if most is None else most * 1e9


def check_memory(size: float, limit: float) -> None:
    """Refuse what does not fit.

    **Raises:** ValueError with the numbers, and what to change.
    """
    if size > limit:
        raise ValueError(
            f"the simulation would take about {in_words(size)} of memory; admissible is max_memory = "
            f"{limit / 1e9:.3g} GB: follow fewer orders (max_orders=), record a shorter window (window=), "
            f"use wider fine bins (bin_width=), have fewer plates or materials, or at most {FEW} wavelengths"
        )
