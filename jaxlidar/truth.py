"""Truth for those who make algorithms: what a beam meets in a scene, as labels for its waveform.

Nothing is random, and nothing is smoothed by the pulse. The rays of the footprint are marched as those of
order one are, from face to face; what they meet within each sample is integrated exactly. The gap probability
is the mean over rays, weighted by their energy, of exp(-tau) times what plates leave open, tau being the
optical depth.
"""

import dataclasses
from typing import NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._checks import briefly, check_kind, is_traced
from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._programs import Program
from jaxlidar._vectors import FAR, Scalar
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.instrument.pulse import RectangularPulse
from jaxlidar.planning.plan import Plan
from jaxlidar.planning.plan import plan as make_plan
from jaxlidar.planning.plan_check import check_plan
from jaxlidar.planning.setup import Setup, reduce
from jaxlidar.planning.trace_plan import Bins
from jaxlidar.scenes.scene import Scene, check_kinds
from jaxlidar.trace.colouring import Recording, components, height_of, recording_of, recording_with_room
from jaxlidar.trace.deposit import first_bin, scatter_rows
from jaxlidar.trace.first_order import Sent, march_rays, sent_rays
from jaxlidar.trace.response import footprint_of, trace_setting
from jaxlidar.trace.setting import Setting, setting_of, straight_transmittance
from jaxlidar.trace.stretches import stretch_pieces

# Share of the beam that is intercepted above `Truth.top_height`.
TOP = 0.01
# Rays that are followed at once, and the fewest of a beam that has a width.
_CHUNK = 512


@final
@briefly
class Truth(eqx.Module):
    """What a beam meets in a scene: labels for its waveform, sample by sample.

    - `time`: (bins,) ns, `height`: (bins,) m, of the samples, as those of `Waveform`. Off nadir samples are
      shells of equal range, and `height` is where these meet the beam's axis.
    - `returns`: dict of (wavelengths, bins) apparent reflectance by material ("ground", "leaf", "bark",
      "plate", "air"): order one, as recorded of a pulse without duration. Its sums over bins are the
      amplitudes of layers. What returns at one instant is spread over three fine bins of the plan.
    - `gap_probability`: (bins,) share of the beam's energy that meets no leaf, bark or plate down to the
      lower end of each sample. Its last is that of all above the ground.
    - `leaf_area_density`, `bark_area_density`: (bins,) m2/m3, half of the surface (which is twice the
      extinction coefficient at G = 1/2), mean over the footprint, weighted by the beam's energy. Below the
      ground there is none.
    - `plant_area_index`: (bins,) m2 of leaf and bark per m2 of ground, above the lower end of each sample:
      the sum of densities times the distance of samples in height.
    - `top_height`: () m, the height above which plants and plates intercept 1 % of the beam's energy, to
      within a sample; NaN where they intercept less, or do so above the record.
    - `surface_height`, `surface_spread`: dict of () m, by surface ("ground", "plate", or "plate 1", ...):
      mean height and standard deviation of where the beam would meet it if nothing lay above, weighted by
      the beam's energy; NaN where it does not meet it.

    Gaps are those of the geometry, whatever the wavelength and whatever leaves transmit.

    **Example:** a plate that covers half of the beam, above sloping ground.

    >>> import jaxlidar as jl
    >>> scene = jl.Scene(plates=[jl.Plate(3.0, 0.4, coverage=0.5)], ground=jl.Ground(1.0, slope=10.0))
    >>> truth = jl.truth_of(jl.Lidar(altitude=1e4, divergence=1.0), scene)
    >>> {name: round(float(z), 2) for name, z in truth.surface_height.items()}
    {'ground': 1.0, 'plate': 3.0}
    >>> print(f"{float(truth.surface_spread['ground']):.2f} m")  # tan(10 degrees) of half the radius of 5 m
    0.44 m
    >>> print(f"{float(truth.gap_probability[-1]):.2f}")
    0.50
    """

    time: Float[Array, "bins"]
    height: Float[Array, "bins"]
    returns: dict[str, Float[Array, "wavelengths bins"]]
    gap_probability: Float[Array, "bins"]
    leaf_area_density: Float[Array, "bins"]
    bark_area_density: Float[Array, "bins"]
    plant_area_index: Float[Array, "bins"]
    top_height: Float[Array, ""]
    surface_height: dict[str, Float[Array, ""]]
    surface_spread: dict[str, Float[Array, ""]]


def truth_of(lidar: Lidar, scene: Scene, *, plan: Plan | None = None) -> Truth:
    """What the beam of `lidar` meets in `scene`, as labels for its waveform.

    `simulate(..., truth=True)` and `simulate_many(..., truth=True)` give it with the waveforms.

    **Arguments:**

    - `lidar`: a `Lidar`. - `scene`: a `Scene`.
    - `plan`: a `Plan` of `jaxlidar.plan`, whose samples and number of rays are used. It must be given where
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
    elif not any(is_traced(x) for x in jax.tree.leaves((lidar, scene))):
        check_plan(plan, lidar, scene)
    return truth_of_setup(reduce(lidar, scene, plan))


def truth_of_setup(setup: Setup) -> Truth:
    """The truth of a lidar and a scene as they are simulated."""
    setup, plan = of_first_order(setup), setup.plan
    transmittance = straight_transmittance(setup)
    traced = any(is_traced(x) for x in jax.tree.leaves(setup))
    exact = traced or transmittance is not None
    recording = recording_of(setup) if exact else recording_with_room(setup)
    found = _compiled(setting_of(setup), transmittance, recording)
    if exact:
        return found
    # There is room for more samples and wavelengths than asked for.
    sizes = (setup.lidar.wavelength.size, plan.n_samples)
    known = jax.device_get(found)
    return jax.tree.map(lambda a: jnp.asarray(a[tuple(map(slice, sizes[2 - a.ndim :]))]), known)


def of_first_order(setup: Setup) -> Setup:
    """The setup for light that is scattered once, of a pulse without duration; nothing is random."""
    plan, lidar = setup.plan, setup.lidar
    trace = dataclasses.replace(
        plan.trace, orders=1, order_steps=1, drawn_first=False, independent=False, keeps_histories=True
    )
    # Labels shall be no less accurate than waveforms of many batches.
    rays = plan.n_rays if plan.n_rays == 1 else max(plan.n_rays, _CHUNK)
    same = {"random_footprint": False, "degree": plan.first_degree}
    plan = dataclasses.replace(plan, trace=trace, n_rays=rays, **same)
    instant = RectangularPulse(length=0.0), jnp.zeros_like(lidar.jitter)
    lidar = eqx.tree_at(lambda v: (v.pulse, v.jitter), lidar, instant)
    return dataclasses.replace(setup, lidar=lidar, plan=plan)


def labels(
    setting: Setting, transmittance: Float[Array, "wavelengths"] | None, recording: Recording
) -> Truth:
    """The truth of a setting and a recording of `of_first_order`, to be compiled."""
    lidar, time, plan = recording.lidar, recording.time, setting.plan
    # Nothing is drawn.
    key = jax.random.key(0)
    returns = components(trace_setting(setting, transmittance, key), recording)
    height, samples = height_of(lidar, time), _samples(setting, recording)
    axis, (across, energy) = _on_axis(setting), footprint_of(setting, key)
    sums = _summed(setting, samples, across, energy, axis)
    # What is traced out of its range makes all labels NaN.
    sums = jax.tree.map(lambda a: recording.admissible * a, sums)
    met = jnp.cumsum(sums.rows[0])[samples.row - 1 : samples.row + samples.count]
    gap = jnp.maximum(jnp.sum(energy) - met, 0.0)
    metres = 0.5 * SPEED_OF_LIGHT * samples.width
    inside, before = sums.rows[1:, samples.row :], jnp.sum(sums.rows[1:, : samples.row])
    leaf, bark = inside[:, : samples.count]
    upright = jnp.cos(jnp.deg2rad(lidar.zenith))
    names = [plan.materials[s.material] for s in plan.surfaces]
    mean, spread = _moments(sums)
    return Truth(
        time=time,
        height=height,
        returns={name: a for name, a in returns.items() if name not in ("first", "higher")},
        gap_probability=gap[1:],
        leaf_area_density=leaf / metres,
        bark_area_density=bark / metres,
        plant_area_index=upright * (before + jnp.cumsum(leaf + bark)),
        top_height=_where_gap_is(1.0 - TOP, gap, height[0] + upright * metres * (0.5 - np.arange(gap.size))),
        surface_height=dict(zip(names, axis + mean)),
        surface_spread=dict(zip(names, spread)),
    )


_compiled = Program(labels)


def _samples(setting: Setting, recording: Recording) -> Bins:
    """The samples as bins of time, without a kernel."""
    fine, across = setting.bins, recording.sampling.per_sample
    # A stretch spans this many fine bins at most.
    longest = fine.row - 2
    row = -(-longest // across) + 3
    samples = Bins(0.0, 1.0, recording.time.size, row, kernel=1)
    return eqx.tree_at(lambda b: (b.start, b.width), samples, (recording.time[0], fine.width * across))


class _Sums(NamedTuple):
    """Sums over rays, weighted by their energy.

    - `rows`: by sample, with margins: the energy that is intercepted, the area (m) of leaf, and of bark.
    - `meets`, `height`, `square`: of each surface, the energy that meets it, and that times its height above
      where the axis meets it, and times the height's square.
    """

    rows: Float[Array, "3 padded"]
    meets: Float[Array, "surfaces"]
    height: Float[Array, "surfaces"]
    square: Float[Array, "surfaces"]


def _summed(
    setting: Setting,
    samples: Bins,
    across: tuple[Float[Array, "rays"], Float[Array, "rays"]],
    energy: Float[Array, "rays"],
    axis: Float[Array, "surfaces"],
) -> _Sums:
    """Sums over all rays, some at a time."""

    def some(x: Array, y: Array, e: Array) -> _Sums:
        sent = sent_rays(setting, (x, y), e)
        return _Sums(_intercepted(setting, samples, sent), *_heights(sent, axis))

    given = (*across, energy)
    if energy.size <= _CHUNK:
        return some(*given)
    chunks = [jnp.pad(a, (0, -energy.size % _CHUNK)).reshape(-1, _CHUNK) for a in given]
    zero = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(some, *given))

    def add(total: _Sums, chunk: list[Array]) -> tuple[_Sums, None]:
        return jax.tree.map(jnp.add, total, some(*chunk)), None

    return jax.lax.scan(add, zero, chunks)[0]


def _intercepted(setting: Setting, samples: Bins, sent: Sent) -> Float[Array, "3 padded"]:
    """What leaf, bark and plates intercept of rays, and the area of leaf and of bark, by sample."""
    medium, rows = setting.medium, jnp.zeros((3, samples.padded), sent.energy.dtype)
    plates = [
        (surface.coverage, jnp.where(met <= sent.stop, met, FAR))
        for surface, met in zip(setting.surfaces, sent.met)
        if surface.plate
    ]

    def clear(at: Scalar) -> Scalar:
        """What plates let pass to a distance along each ray, the last axis."""
        passing = jnp.ones_like(at)
        for coverage, met in plates:
            passing = passing * jnp.where(jnp.broadcast_to(met, at.shape) < at, 1.0 - coverage, 1.0)
        return passing

    def position(at: Scalar) -> Scalar:
        return samples.position(2.0 * (jnp.broadcast_to(sent.excess, at.shape) + at) / SPEED_OF_LIGHT)

    depths = [jnp.zeros_like(sent.energy) for _ in sent.met]
    if medium is not None:
        stretch, depths, _ = march_rays(setting, sent)
        low, energy = position(stretch.start), jnp.broadcast_to(sent.energy, stretch.start.shape)
        arriving = energy * clear(stretch.start + 0.5 * stretch.length) * stretch.extinction
        first, passing = stretch_pieces(samples, low, stretch, 1.0)
        _, lengths = stretch_pieces(samples, low, stretch, 0.0)
        deposits = [(0, passing * arriving[None])]
        for number, table in enumerate((medium.leaf, medium.bark), 1):
            if table is not None:
                # Extinction is half of the area density where facets have no preferred direction.
                deposits.append((number, lengths * (2.0 * energy * table[stretch.cell])[None]))
        for number, pieces in deposits:
            rows = scatter_rows(rows, jnp.full_like(first, number), first, jnp.moveaxis(pieces, 0, -1))
    depths = [d for d, surface in zip(depths, setting.surfaces) if surface.plate]
    for (coverage, met), depth in zip(plates, depths):
        there = met < FAR
        stopped = jnp.where(there, sent.energy * coverage * clear(met) * jnp.exp(-depth), 0.0)
        nearest = jnp.round(position(jnp.where(there, met, 0.0)))
        rows = rows.at[0, first_bin(samples, nearest, 1)].add(stopped)
    return rows


def _on_axis(setting: Setting) -> Float[Array, "surfaces"]:
    """Heights at which the beam's axis meets the surfaces; 0 where it does not."""
    zero = jnp.zeros((1,), setting.beam.radius.dtype)
    x, w, _, _, met, _ = sent_rays(setting, (zero, zero), zero + 1.0)
    return jnp.concatenate([jnp.where(m < FAR, x[2] + m * w[2], 0.0) for m in met]) if met else zero[:0]


def _heights(sent: Sent, axis: Float[Array, "surfaces"]) -> list[Float[Array, "surfaces"]]:
    """Moments of heights at which rays meet surfaces: the last three of `_Sums`."""
    moments: list[list[Array]] = [[], [], []]
    for met, middle in zip(sent.met, axis):
        there = (met < FAR) & (met <= sent.stop)
        z = jnp.where(there, sent.x[2] + met * sent.w[2] - middle, 0.0)
        hit = jnp.where(there, sent.energy, 0.0)
        for found, value in zip(moments, (hit, hit * z, hit * z * z)):
            found.append(jnp.sum(value))
    return [jnp.stack(found) if found else sent.energy[:0] for found in moments]


def _moments(sums: _Sums) -> tuple[Float[Array, "surfaces"], Float[Array, "surfaces"]]:
    """Mean heights of surfaces, and standard deviations; NaN of what is not met."""
    there = sums.meets > 0
    whole = jnp.where(there, sums.meets, 1.0)
    mean = sums.height / whole
    variance = sums.square / whole - mean * mean
    spread = jnp.where(variance > 0, jnp.sqrt(jnp.where(variance > 0, variance, 1.0)), 0.0)
    return jnp.where(there, mean, np.nan), jnp.where(there, spread, np.nan)


def _where_gap_is(gap: float, gaps: Float[Array, "edges"], heights: Float[Array, "edges"]) -> Scalar:
    """Height at which a gap probability that falls from edge to edge is `gap`; NaN where it stays above."""
    below = jnp.sum(gaps >= gap)
    last = jnp.clip(below, 1, gaps.size - 1)
    high, low = gaps[last - 1], gaps[last]
    share = (high - gap) / jnp.where(high > low, high - low, 1.0)
    height = heights[last - 1] + jnp.clip(share, 0.0, 1.0) * (heights[last] - heights[last - 1])
    return jnp.where((below > 0) & (below < gaps.size), height, np.nan)
