"""Memory that a simulation takes, predicted before anything is allocated.

A response has traces x materials x histories x bins numbers, with C(degree + channels, channels) histories of
at most `degree` scatterings. Batches run on all cores at once, each with its own response, so that

    bytes = response * (3 cores + 1) + 2 * pulse matrix + compilation.
"""

import math
import os
from collections.abc import Sequence

import jax.numpy as jnp

from jaxlidar._jax.memory import format_bytes, machine_memory
from jaxlidar.planning.config import TimeBins, TraceConfig
from jaxlidar.scenes.mesh_surface import MeshSurface
from jaxlidar.scenes.triangle_tree import ROW

# Copies of a batch's response that are alive at once: sums of photons, of groups, and the result.
_RESPONSE_COPIES = 3
# Tangents of a response that are alive at once, for each column of a Jacobian. The sum of photons becomes the
# result, but newer compilers copy a part of it.
_RESPONSE_TANGENTS = 1.3
# Numbers of a photon, and of a ray segment, for each column of a score function.
_SCORE_NUMBERS = 2
# Tangents of a photon, and of a ray segment, that are alive at once.
_STATE_TANGENTS = 4
# Numbers of a photon, and of a ray segment, that are alive at once.
_STATE_NUMBERS = 16
# Footprint rays that are marched at once.
_RAYS_AT_ONCE = 512
# Tables with a number for each column and voxel: slopes of leaf, of bark, and of the optical depth above, and
# the columns' numbers (`trace.derivatives.extinction_slopes.ExtinctionSlopes`).
_SLOPE_TABLES = 4
# Tables of the trees of meshes that are alive at once.
_TREE_COPIES = 2
# Bytes that compiling takes.
_COMPILATION = 150e6
# Optics may be applied while light is traced where one response with histories takes more bytes than
# this. A program holds some three of them in one buffer. Beyond 32 MB the C library returns a buffer to
# the system after each call, and the system clears every page of the next one, which took half of all
# time. (Smaller ones lose a quarter at most so, and with histories a change of the number of wavelengths
# compiles nothing) ...
LARGE_RESPONSE = 24e6
# ... for at most this many wavelengths, whose deposits are then made one by one.
MAX_APPLIED_WAVELENGTHS = 8
# The pulse is a dense matrix of fine bins and samples up to this many elements; beyond, it is a band.
MAX_DENSE_PULSE = 1 << 22


def response_bytes(config: TraceConfig, bins: TimeBins, *, degree: int, n_traces: int) -> float:
    """Return the bytes of a response of `n_traces` traces, with histories of up to `degree` scatterings."""
    n_channels, n_materials = len(config.channels), len(config.materials)
    higher = math.comb(degree + n_channels, n_channels) if config.follows_higher_orders else 0
    first_degree = config.first_degree
    first = math.comb(first_degree + n_channels, n_channels)
    return float(_number_bytes() * n_traces * n_materials * (higher + first) * bins.padded)


def band_size(width: int, bins_per_sample: int) -> int:
    """Return the number of elements of the matrices of a band of `width` fine bins.

    See `jaxlidar.spectral.pulse_convolution`: two blocks of fine bins by the samples of a tile.
    """
    n_tile = -(-width // bins_per_sample)
    return 2 * n_tile**2 * bins_per_sample


def simulation_bytes(
    config: TraceConfig,
    bins: TimeBins,
    *,
    degree: int,
    n_samples: int,
    bins_per_sample: int,
    pulse_bins: int,
    n_traces: int,
) -> float:
    """Return the bytes of all responses that are alive at once, of the pulse, and of compiling.

    **Arguments:**

    - `config`, `bins`: of a plan.
    - `degree`: largest number of scatterings in a history.
    - `n_samples`, `bins_per_sample`: samples of the waveform, and fine bins in each.
    - `pulse_bins`: fine bins that the pulse spans.
    - `n_traces`: traces of a response; one for each wavelength where leaves transmit straight on, or where
      optics are applied while light is traced.
    """
    response = response_bytes(config, bins, degree=degree, n_traces=n_traces)
    # The pulse is applied as a matrix of fine bins and samples. One above `MAX_DENSE_PULSE` gives way to a
    # band, if that is smaller.
    n_elements = bins.count * n_samples
    if n_elements > MAX_DENSE_PULSE:
        n_elements = min(n_elements, band_size(pulse_bins, bins_per_sample))
    pulse = _number_bytes() * n_elements
    return response * (_RESPONSE_COPIES * (os.cpu_count() or 1) + 1) + 2 * pulse + _COMPILATION


def mesh_bytes(meshes: Sequence[MeshSurface]) -> float:
    """Return the bytes of the trees of meshes: two rows for each triangle, and its corners and indices.

    While the tree is built, its levels and the table are alive at once.
    """
    n_leaves, n_vertices = (
        sum(map(len, a)) for a in ([m.faces for m in meshes], [m.vertices for m in meshes])
    )
    n_instances = sum(len(mesh.instances) for mesh in meshes)
    numbers = 2 * _TREE_COPIES * ROW * (n_leaves + n_instances) + 9 * n_leaves + 3 * n_vertices
    return float(_number_bytes() * numbers + 4 * (6 * n_leaves + 3 * n_instances))


def keeps_histories(response: float, with_histories: float, applied: float, limit: float) -> bool:
    """Return True if the response shall keep scattering histories, so that one trace serves all optics.

    Otherwise optics are applied while light is traced. That is done where one `response` with histories is
    larger than `LARGE_RESPONSE`, or all of them take more memory than there is, and where applied optics take
    less: `with_histories` and `applied` are the bytes of a simulation. Wavelengths, whose deposits are then
    made one by one, must be few: at most `MAX_APPLIED_WAVELENGTHS`.
    """
    affordable = response <= LARGE_RESPONSE and with_histories <= limit
    return affordable or applied >= with_histories


def jacobian_bytes(
    config: TraceConfig, bins: TimeBins, *, degree: int, n_traces: int, batches: int, columns: int
) -> float:
    """Return the bytes of a geometric Jacobian with `columns` columns at once, without compilation.

    The responses of all batches are kept for the columns of optical unknowns; batches run on all cores.
    """
    cores = min(os.cpu_count() or 1, batches)
    response = response_bytes(config, bins, degree=degree, n_traces=n_traces)
    tangents = (
        _RESPONSE_TANGENTS * response + _STATE_TANGENTS * _photons_and_segments(config) * _number_bytes()
    )
    return (batches + 1) * response + cores * (response + columns * tangents)


def transformed_bytes(config: TraceConfig, bins: TimeBins, *, degree: int, n_traces: int) -> float:
    """Return the bytes of one simulation under `jax.vmap`: those of a batch, and of the sum of all."""
    response = response_bytes(config, bins, degree=degree, n_traces=n_traces)
    states = _STATE_NUMBERS * _photons_and_segments(config) * _number_bytes()
    return (1 + _RESPONSE_COPIES) * response + states


def scored_bytes(config: TraceConfig, bins: TimeBins, *, cells: int, columns: int, wavelengths: int) -> float:
    """Return the bytes of score functions for `columns` columns, on all cores.

    **Arguments:** `cells`: voxels of the map. `columns`: unknowns that change extinction alone.
    """
    rows = columns * wavelengths * bins.padded
    per_core = _RESPONSE_COPIES * rows + _SCORE_NUMBERS * columns * _photons_and_segments(config)
    slopes = _SLOPE_TABLES * columns * cells
    return float(_number_bytes() * ((os.cpu_count() or 1) * per_core + slopes))


def _number_bytes() -> int:
    """Bytes of a number in JAX's present precision."""
    return jnp.result_type(float).itemsize


def _photons_and_segments(config: TraceConfig) -> int:
    """Photons and ray segments that are alive at once."""
    return config.photons_per_batch + min(config.n_rays, _RAYS_AT_ONCE) * config.max_ray_segments


def memory_limit(max_memory: float | None) -> float:
    """Return the bytes that a simulation may take: `max_memory` GB, or a quarter of the machine's memory."""
    return 0.25 * machine_memory() if max_memory is None else max_memory * 1e9


def check_memory(
    size: float, limit: float, *, first_order: float = 0.0, n_plates: int = 0, wavelengths: int = 1
) -> None:
    """Refuse a simulation that does not fit.

    **Arguments:** `size`, `limit`: bytes. `first_order`: bytes of one response of order one. `n_plates`,
    `wavelengths`: numbers of them.

    **Raises:** ValueError with the numbers, and what to change.
    """
    if size <= limit:
        return
    fewer_orders = "" if first_order > limit else "follow fewer orders (max_orders=), "
    remedies = (
        f"{fewer_orders}record a shorter window (window=), use wider fine bins (bin_width=), or have fewer "
        "plates or materials"
    )
    if wavelengths > MAX_APPLIED_WAVELENGTHS:
        remedies += f", or at most {MAX_APPLIED_WAVELENGTHS} wavelengths"
    # Histories of order one are kept in any case: of n plates they are C(4 n + 2, 2 n + 1).
    if n_plates > 1 and first_order > limit:
        remedies += (
            f"; order one alone takes {format_bytes(first_order)}, for the histories of {n_plates} plates: "
            "many layers of leaves are the voxels of one canopy"
        )
    raise ValueError(
        f"the simulation would take about {format_bytes(size)} of memory; admissible is max_memory = "
        f"{limit / 1e9:.3g} GB: {remedies}"
    )
