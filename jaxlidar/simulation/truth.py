"""Truth of a waveform: gaps, areas and heights along the beam, as labels for those who develop algorithms.

Nothing is random, and nothing is smoothed by the pulse. The rays of the footprint are marched as those of
order one are, from face to face, and integrated exactly over each sample. The gap probability up to the range
r is

    P(r) = mean over rays, weighted by their energy, of  exp(-tau(r)) * product over plates before r of (1 -
    coverage),

with tau the optical depth.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fields.checks import check_kind, has_tracers
from jaxlidar._jax.mesh_axes import vary_with
from jaxlidar._jax.programs import Program
from jaxlidar._vectors import FAR, Scalar
from jaxlidar.planning.config import TimeBins
from jaxlidar.planning.plan import Plan
from jaxlidar.planning.plan import plan as make_plan
from jaxlidar.planning.plan_check import check_plan
from jaxlidar.planning.setup import Setup, make_setup
from jaxlidar.scenes.scene import Scene, check_kinds
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.pulse import RectangularPulse
from jaxlidar.spectral.apply_optics import (
    WaveformModel,
    component_samples,
    height_of,
    make_padded_waveform_model,
    make_waveform_model,
)
from jaxlidar.spectral.pulse_convolution import PulseConvolution
from jaxlidar.spectral.truth_class import Truth
from jaxlidar.trace.deposit import add_rows, padded_index
from jaxlidar.trace.device_scene import DeviceScene, build_device_scene
from jaxlidar.trace.first.first_order import FootprintRays, march_rays, move_rays, send_rays
from jaxlidar.trace.march.ray_segments import integrate_over_bins
from jaxlidar.trace.response import footprint_rays, trace_device_scene

# Fraction of the beam that is intercepted above `Truth.top_height`.
TOP_INTERCEPTION = 0.01
# Rays that are marched at once, and the fewest of a beam that has a width.
_RAYS_AT_ONCE = 512


def truth_of(lidar: Lidar, scene: Scene, *, plan: Plan | None = None) -> Truth:
    """Compute the labels of the waveform of `lidar` over `scene`, without simulating it.

    `simulate(..., truth=True)` and `simulate_many(..., truth=True)` give it with the waveforms.

    **Arguments:**

    - `lidar`: a `Lidar`. - `scene`: a `Scene`.
    - `plan`: a `Plan` of `jaxlidar.plan` (the truth is NaN where JAX traces what it does not cover), whose
      samples and number of rays are used. It must be given where
      geometry is traced by a JAX transformation. Default None: that of `simulate`.

    **Returns:** a `Truth`. It is deterministic. Derivatives are those of amounts; as places move from sample
    to sample, gaps below plates have none.

    **Raises:** TypeError for things of another kind; ValueError for a plan that does not fit.

    **Example:** a canopy of leaf area index 2 below which a tenth of the ground is bare.

    >>> import numpy as np, jaxlidar as jl
    >>> lad = np.full((10, 10, 5), 0.4)
    >>> lad[:, 0] = 0.0
    >>> voxels = jl.VoxelMap.from_lad(lad, voxel_size=1.0)
    >>> canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4), sides="periodic")
    >>> lidar = jl.Lidar(altitude=4e5, divergence=0.1)
    >>> truth = jl.truth_of(lidar, jl.Scene(canopy=canopy, ground=jl.Ground()))
    >>> gap, area = float(truth.gap_probability[-1]), float(truth.plant_area_index[-1])
    >>> print(f"gap {gap:.2f}, area {area:.1f}")  # 0.1 + 0.9 exp(-2 / 2), 0.9 of 2
    gap 0.43, area 1.8
    """
    check_kinds(lidar, scene)
    check_kind("plan", plan, Plan | None, "a Plan that jaxlidar.plan made, or None")
    if plan is None:
        plan = make_plan(lidar, scene, describe=False)
    elif not has_tracers((lidar, scene, plan)):
        check_plan(plan, lidar, scene)
    return truth_of_setup(make_setup(lidar, scene, plan))


def truth_of_setup(setup: Setup) -> Truth:
    """Compute the truth of a lidar and a scene as they are simulated."""
    setup, plan = first_order_setup(setup), setup.plan
    is_transformed = has_tracers(setup)
    scene = build_device_scene(setup)
    exact_sizes = is_transformed or scene.straight_transmittance is not None
    model = make_waveform_model(setup) if exact_sizes else make_padded_waveform_model(setup)
    truth = _compiled_labels(scene, model)
    if exact_sizes:
        return truth
    # The model has room for more samples and wavelengths than the plan.
    sizes = (setup.lidar.wavelength.size, plan.n_samples)
    padded = jax.device_get(truth)
    return jax.tree.map(lambda a: jnp.asarray(a[tuple(map(slice, sizes[2 - a.ndim :]))]), padded)


def first_order_setup(setup: Setup) -> Setup:
    """Return the setup for light that is scattered once, of a pulse without duration; nothing is random."""
    plan, lidar = setup.plan, setup.lidar
    config = plan.config
    # Labels shall be no less accurate than waveforms of many batches.
    n_rays = config.n_rays if config.n_rays == 1 else max(config.n_rays, _RAYS_AT_ONCE)
    plan = dataclasses.replace(plan, orders=1).with_config(
        order_steps=1,
        keeps_histories=True,
        n_rays=n_rays,
        random_footprint=False,
        degree=config.first_degree,
    )
    instant = RectangularPulse(length=0.0), jnp.zeros_like(lidar.jitter)
    lidar = eqx.tree_at(lambda v: (v.pulse, v.jitter), lidar, instant)
    return dataclasses.replace(setup, lidar=lidar, plan=plan)


def compute_labels(scene: DeviceScene, model: WaveformModel) -> Truth:
    """Compute the truth of a device scene and a waveform model of `first_order_setup`; to be compiled.

    1. Trace order one, for the returns of every material.
    2. March the rays of the footprint, and add up by sample: intercepted energy, areas of leaf and bark.
    3. Gap probability is the energy that is not intercepted yet: what passes through all, and what is
       intercepted later. Summed from the far end, small gaps are not differences of large numbers.
    4. Plant area and heights follow from the sums.
    """
    lidar, time = model.lidar, model.time
    # Nothing is drawn.
    key = jax.random.key(0)
    returns = component_samples(trace_device_scene(scene, key), model)
    height, samples = height_of(lidar, time), _sample_bins(scene, model)
    axis_heights, (across, energy) = _heights_on_axis(scene), footprint_rays(scene, key)
    # Traced coordinates are relative to the aim point, heights to the reference plane.
    aim_height = lidar.aim_point[2]
    sums = _sum_rays(scene, samples, across, energy, axis_heights)
    # A traced value outside its range makes all labels NaN.
    # Truth has no `lost`, which would tell what the plan does not cover.
    factor = jnp.where(model.is_covered, model.admissible, jnp.nan)
    sums = jax.tree.map(lambda a: factor * a, sums)
    intercepted_from = jnp.cumsum(sums.rows[0][::-1])[::-1]
    remaining = sums.passing + intercepted_from[samples.max_span : samples.max_span + samples.count + 1]
    # All of the energy is one or the other: the ratio takes off what the sums round.
    gap = jnp.sum(energy) * remaining / (sums.passing + intercepted_from[0])
    sample_length = 0.5 * SPEED_OF_LIGHT * samples.width
    inside = sums.rows[1:, samples.max_span :]
    before = jnp.sum(sums.rows[1:, : samples.max_span])
    leaf, bark = inside[:, : samples.count]
    cos_zenith = jnp.cos(jnp.deg2rad(lidar.zenith))
    # A beam that looks up passes through as much plant area.
    vertical = jnp.abs(cos_zenith)
    edges = height[0] + cos_zenith * sample_length * (0.5 - np.arange(gap.size))
    names = [scene.config.materials[s.material] for s in scene.config.surfaces]
    mean_height, height_std = _height_moments(sums)
    return Truth(
        time=time,
        height=height,
        returns={name: a for name, a in returns.items() if name not in ("first", "higher")},
        gap_probability=gap[1:],
        leaf_area_density=leaf / sample_length,
        bark_area_density=bark / sample_length,
        plant_area_index=vertical * (before + jnp.cumsum(leaf + bark)),
        top_height=_height_of_gap(1.0 - TOP_INTERCEPTION, gap, edges),
        surface_height=dict(zip(names, aim_height + axis_heights + mean_height)),
        surface_spread=dict(zip(names, height_std)),
    )


_compiled_labels = Program(compute_labels)


def _sample_bins(scene: DeviceScene, model: WaveformModel) -> TimeBins:
    """Return the samples as time bins."""
    # Models of simulations have samples of whole fine bins.
    assert isinstance(model.convolution, PulseConvolution)
    fine, bins_per_sample = scene.bins, model.convolution.bins_per_sample
    # A ray segment spans at most this many fine bins.
    longest = fine.max_span - 2
    max_span = -(-longest // bins_per_sample) + 3
    samples = TimeBins(0.0, 1.0, model.time.size, max_span)
    return eqx.tree_at(lambda b: (b.start, b.width), samples, (model.time[0], fine.width * bins_per_sample))


class _RaySums(NamedTuple):
    """Sums over rays, weighted by their energy.

    - `rows`: by sample, with margins: the energy that is intercepted, the area (m) of leaf, and of bark.
    - `passing`: the energy that leaf, bark and plates let pass to the ends of the rays.
    - `met`, `height`, `squared_height`: of each surface, the energy that meets it, and that times its height
      above where the axis meets it, and times the height's square.
    """

    rows: Float[Array, "3 padded"]
    passing: Float[Array, ""]
    met: Float[Array, "surfaces"]
    height: Float[Array, "surfaces"]
    squared_height: Float[Array, "surfaces"]


def _sum_rays(
    scene: DeviceScene,
    samples: TimeBins,
    across: tuple[Float[Array, "rays"], Float[Array, "rays"]],
    energy: Float[Array, "rays"],
    axis_heights: Float[Array, "surfaces"],
) -> _RaySums:
    """Sum over all rays, `_RAYS_AT_ONCE` at a time."""
    across, energy = move_rays(scene, across, energy)

    def sum_chunk(x: Array, y: Array, e: Array) -> _RaySums:
        rays = send_rays(scene, (x, y), e)
        return _RaySums(*_sum_interception(scene, samples, rays), *_sum_heights(rays, axis_heights))

    arrays = (*across, energy)
    if energy.size <= _RAYS_AT_ONCE:
        return sum_chunk(*arrays)
    chunks = [jnp.pad(a, (0, -energy.size % _RAYS_AT_ONCE)).reshape(-1, _RAYS_AT_ONCE) for a in arrays]
    zero = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(sum_chunk, *arrays))
    zero = vary_with(zero, (scene, arrays))

    def add(total: _RaySums, chunk: list[Array]) -> tuple[_RaySums, None]:
        return jax.tree.map(jnp.add, total, sum_chunk(*chunk)), None

    return jax.lax.scan(add, zero, chunks)[0]


def _sum_interception(
    scene: DeviceScene, samples: TimeBins, rays: FootprintRays
) -> tuple[Float[Array, "3 padded"], Float[Array, ""]]:
    """Sum what leaf, bark and plates intercept and let pass: the first two fields of `_RaySums`."""
    medium, rows = scene.medium, jnp.zeros((3, samples.padded), rays.energy.dtype)
    plates = [
        (surface.coverage, jnp.where(distance <= rays.end, distance, FAR))
        for surface, distance in zip(scene.surfaces, rays.surface_distances)
        if surface.is_plate or surface.is_mesh
    ]

    def plate_gap(distance: Scalar) -> Scalar:
        """Fraction that plates let pass up to a distance along each ray, the last axis."""
        passing = jnp.ones_like(distance)
        for coverage, plate_distance in plates:
            is_behind = jnp.broadcast_to(plate_distance, distance.shape) < distance
            passing = passing * jnp.where(is_behind, 1.0 - coverage, 1.0)
        return passing

    def sample_position(distance: Scalar) -> Scalar:
        path = jnp.broadcast_to(rays.excess, distance.shape) + distance
        return samples.position(2.0 * path / SPEED_OF_LIGHT)

    total_depth = jnp.zeros_like(rays.energy)
    depths = [total_depth for _ in rays.surface_distances]
    if medium is not None:
        segments, depths, total_depth = march_rays(scene, rays)
        position = sample_position(segments.start)
        energy = jnp.broadcast_to(rays.energy, segments.start.shape)
        arriving = energy * plate_gap(segments.start + 0.5 * segments.length) * segments.extinction
        first_bin, passing = integrate_over_bins(samples, position, segments, 1.0)
        # With kappa = 0 the integrals are lengths.
        _, lengths = integrate_over_bins(samples, position, segments, 0.0)
        deposits = [(0, passing * arriving[None])]
        for row, table in enumerate((medium.leaf, medium.bark), 1):
            if table is not None:
                # Extinction is half of the area density where facets have no preferred direction.
                deposits.append((row, lengths * (2.0 * energy * table[segments.cell])[None]))
        for row, pieces in deposits:
            rows = add_rows(rows, jnp.full_like(first_bin, row), first_bin, jnp.moveaxis(pieces, 0, -1))
    plate_depths = [d for d, surface in zip(depths, scene.surfaces) if surface.is_plate or surface.is_mesh]
    for (coverage, distance), depth in zip(plates, plate_depths):
        is_met = distance < FAR
        stopped = jnp.where(is_met, rays.energy * coverage * plate_gap(distance) * jnp.exp(-depth), 0.0)
        nearest = jnp.round(sample_position(jnp.where(is_met, distance, 0.0)))
        rows = rows.at[0, padded_index(samples, nearest, 1)].add(stopped)
    behind_all = plate_gap(jnp.full_like(rays.energy, FAR))
    return rows, jnp.sum(rays.energy * behind_all * jnp.exp(-total_depth))


def _heights_on_axis(scene: DeviceScene) -> Float[Array, "surfaces"]:
    """Heights at which the beam's axis meets the surfaces; 0 where it does not."""
    zero = jnp.zeros((1,), scene.beam.radius.dtype)
    axis = send_rays(scene, (zero, zero), zero + 1.0)
    heights = [jnp.where(d < FAR, axis.x[2] + d * axis.w[2], 0.0) for d in axis.surface_distances]
    return jnp.concatenate(heights) if heights else zero[:0]


def _sum_heights(
    rays: FootprintRays, axis_heights: Float[Array, "surfaces"]
) -> list[Float[Array, "surfaces"]]:
    """Sum moments of the heights at which rays meet surfaces: the last three fields of `_RaySums`."""
    moments: list[list[Array]] = [[], [], []]
    for distance, axis_height in zip(rays.surface_distances, axis_heights):
        is_met = (distance < FAR) & (distance <= rays.end)
        # Relative to the axis: squares of heights above sea level would lose the spread in rounding.
        z = jnp.where(is_met, rays.x[2] + distance * rays.w[2] - axis_height, 0.0)
        met_energy = jnp.where(is_met, rays.energy, 0.0)
        for sums, value in zip(moments, (met_energy, met_energy * z, met_energy * z * z)):
            sums.append(jnp.sum(value))
    return [jnp.stack(sums) if sums else rays.energy[:0] for sums in moments]


def _height_moments(sums: _RaySums) -> tuple[Float[Array, "surfaces"], Float[Array, "surfaces"]]:
    """Mean heights of surfaces, and standard deviations; NaN for surfaces that are not met."""
    is_met = sums.met > 0
    energy = jnp.where(is_met, sums.met, 1.0)
    mean = sums.height / energy
    variance = sums.squared_height / energy - mean * mean
    # The root of zero has no derivative.
    std = jnp.where(variance > 0, jnp.sqrt(jnp.where(variance > 0, variance, 1.0)), 0.0)
    return jnp.where(is_met, mean, np.nan), jnp.where(is_met, std, np.nan)


def _height_of_gap(gap: float, gaps: Float[Array, "edges"], heights: Float[Array, "edges"]) -> Scalar:
    """Interpolate the height at which the gap probability falls to `gap`; NaN if it never does."""
    n_above = jnp.sum(gaps >= gap)
    last = jnp.clip(n_above, 1, gaps.size - 1)
    high, low = gaps[last - 1], gaps[last]
    fraction = (high - gap) / jnp.where(high > low, high - low, 1.0)
    height = heights[last - 1] + jnp.clip(fraction, 0.0, 1.0) * (heights[last] - heights[last - 1])
    return jnp.where((n_above > 0) & (n_above < gaps.size), height, np.nan)
