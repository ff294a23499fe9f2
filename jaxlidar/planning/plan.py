"""The plan of a simulation: effects simulated, bounds on what each changes, and sizes of all loops."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, final

import equinox as eqx
import jax

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fields.checks import (
    check_choice,
    check_integer,
    check_kind,
    check_number,
    check_range,
    concrete_array,
    concrete_number,
)
from jaxlidar._jax.memory import format_bytes
from jaxlidar._registry import survey_lines
from jaxlidar.optics.laws import AbstractMirror
from jaxlidar.planning.channels import (
    ScattererChannels,
    largest_albedo,
    number_channels,
    reflection_probability,
    scene_optics,
)
from jaxlidar.planning.config import PathLimits, TimeBins, TraceConfig, as_argument
from jaxlidar.planning.effect_table import effect_table, table_lines
from jaxlidar.planning.effects import (
    Effect,
    consists_of_planes,
    find_empty_materials,
    has_smooth_footprint,
    present_effects,
    replace_plane_terrain,
    switched_off_effects,
    without_effects,
)
from jaxlidar.planning.local_origin import move_aim_to_origin
from jaxlidar.planning.memory import (
    MAX_APPLIED_WAVELENGTHS,
    check_memory,
    jacobian_bytes,
    keeps_histories,
    memory_limit,
    mesh_bytes,
    response_bytes,
    simulation_bytes,
)
from jaxlidar.planning.orders import (
    MAX_ORDERS_OF_HISTORIES,
    choose_orders,
    max_degree,
    multiple_scattering_tail,
    order_steps,
)
from jaxlidar.planning.parallel_light import beams_are_parallel, parallel_light_bound
from jaxlidar.planning.path_lengths import (
    PathLengths,
    check_footprints_on_terrain,
    check_scene_near_beams,
    longest_segment,
    meshes_are_in_reach,
)
from jaxlidar.planning.record_times import (
    band_of_long_record,
    bins_and_samples,
    extend_to_air_return,
    first_sample_in_bins,
    target_bin_width,
)
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.scenes.scene import Scene, check_kinds
from jaxlidar.scenes.surfaces import AbstractSheet
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.survey import Survey

DEFAULT_RTOL = 0.01
# Fewer batches give no trustworthy standard error.
MIN_BATCHES = 8
# Least sizes of a plan with room (`Plan.with_room`). 1536 bins are some 500 ns, with three bins in each.
_ROOM_FOR_ORDERS, _ROOM_FOR_SEGMENTS, _ROOM_FOR_FACES = 32, 32, 64
_ROOM_FOR_BINS, _ROOM_FOR_SPAN = 1536, 16
# Local estimates (next-event estimation) per free flight through a canopy: points from which light returns to
# the sensor.
DEPOSITS_PER_FLIGHT = 4


@final
class PlanScope(eqx.Module):
    """The lidars and scenes that a plan was made for; `check_plan` compares others with it.

    - `from_sensor`: True if the lidar is placed by its sensor, and time zero is the emission.
    - `first_return`, `last_return`: times, ns, of the first and the last return of order one.
    - `albedo`: largest reflectance + transmittance of any material and wavelength.
    - `pulse_feature`: scale, ns, of the finest feature of the pulse.
    - `automatic_orders`, `automatic_window`: True if the plan chose the orders, and the window.
    - `affordable_orders`: largest number of orders that memory has room for.
    - `flat_terrain`: True if the terrain was found to be a plane, and is simulated as one.
    - `empty_materials`: which of "leaf" and "bark" were found to be zero everywhere, and left out.
    - `unreached_meshes`: True if no ray was found to meet a mesh, and all meshes are left out.
    - `max_memory`: the user's limit in GB, or None.
    """

    from_sensor: bool = eqx.field(static=True)
    first_return: float = eqx.field(converter=as_argument)
    last_return: float = eqx.field(converter=as_argument)
    albedo: float = eqx.field(converter=as_argument)
    pulse_feature: float = eqx.field(converter=as_argument)
    automatic_orders: bool = eqx.field(static=True)
    automatic_window: bool = eqx.field(static=True)
    affordable_orders: int = eqx.field(static=True)
    flat_terrain: bool = eqx.field(static=True)
    empty_materials: tuple[str, ...] = eqx.field(static=True)
    unreached_meshes: bool = eqx.field(static=True)
    max_memory: float | None = eqx.field(converter=as_argument)


@dataclasses.dataclass(frozen=True)
class _EffectTable:
    """The rows of a plan's table, and lines on its survey. All are equal: no program depends on them."""

    rows: tuple[Effect, ...] = dataclasses.field(compare=False)
    survey_lines: tuple[str, ...] = dataclasses.field(compare=False, default=())


@final
class Plan(eqx.Module):
    """Plan of a simulation: effects, time bins, orders of scattering, and numbers of rays and photons.

    Plans are made by `jaxlidar.plan`. Printed, a plan is a table of effects, followed by a line of sizes.
    What a plan leaves out is never compiled. For JAX it is a pytree: its lengths, times and tolerances are
    leaves, and its names, switches and sizes are static. So it can be an argument of `jax.jit` and of other
    transformations, and plans that differ in lengths and times alone share a program.

    - `config`: the static configuration of the tracer: scatterers, switches, sizes of loops and batches.
    - `limits`: lengths that bound rays and photons.
    - `bins`: the fine time bins, into which returns are sorted.
    - `sample_start`, `sample_interval`: time of the first sample, and the interval between samples, ns.
    - `n_samples`: number of samples.
    - `bins_per_sample`: number of fine bins per sample.
    - `first_sample`: centre of the first sample, in fine bins from that of the first bin.
    - `orders`: number of scatterings that are followed.
    - `n_traces`: number of traces in a response: one for each wavelength, where the trace depends on it.
    - `pulse_support`: times (ns) between which the pulse's energy lies.
    - `pulse_band`: of a long record, offsets of a sample from a fine bin, in fine bins, between which the
      sample takes from the bin; None where a matrix of all bins and samples is small.
    - `off`: names of the effects that are switched off.
    - `rtol`: relative accuracy aimed at.
    - `likely_beyond`: estimated fraction of the light in orders beyond the last.
    - `scope`: the lidars and scenes that the plan serves.
    - `memory`: bytes that a simulation is predicted to take.
    - `table`: the rows of `effects`.

    **Example:**

    >>> import jaxlidar as jl
    >>> plan = jl.plan(jl.Lidar(), jl.Scene(ground=jl.Ground()))
    >>> print(str(plan).splitlines()[-2])
    31 samples of 1 ns from -15 ns, 10 fine bins of 0.5 ns
    """

    config: TraceConfig = eqx.field(static=True)
    limits: PathLimits = eqx.field(converter=as_argument)
    bins: TimeBins = eqx.field(converter=as_argument)
    sample_start: float = eqx.field(converter=as_argument)
    sample_interval: float = eqx.field(converter=as_argument)
    first_sample: float = eqx.field(converter=as_argument)
    n_samples: int = eqx.field(static=True)
    bins_per_sample: int = eqx.field(static=True)
    orders: int = eqx.field(static=True)
    n_traces: int = eqx.field(static=True)
    pulse_support: tuple[float, float] = eqx.field(converter=as_argument)
    pulse_band: tuple[int, int] | None = eqx.field(static=True)
    off: tuple[str, ...] = eqx.field(static=True)
    # Within a JAX transformation these decide what the plan covers.
    rtol: float = eqx.field(converter=as_argument)
    scope: PlanScope
    likely_beyond: float = eqx.field(converter=as_argument)
    memory: float = eqx.field(converter=as_argument)
    table: _EffectTable = eqx.field(static=True)

    def __check_init__(self):
        static_part = (dataclasses.astuple(self.config), self.off)
        if any(isinstance(x, float) for x in jax.tree.leaves(static_part)):
            raise TypeError("the static part of a plan has a float: each of its values would be a program")

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The table, an `Effect` for every row; empty where it was not asked for."""
        return self.table.rows

    @property
    def n_rays(self) -> int:
        """Rays that sample the footprint in each batch; they carry the first order."""
        return self.config.n_rays

    @property
    def n_photons(self) -> int:
        """Photons of eight batches together; they carry the higher orders."""
        return MIN_BATCHES * self.config.photons_per_batch

    @property
    def photons_traced(self) -> int:
        """Photons that a batch traces: none where only one order is followed."""
        return self.config.photons_traced

    @property
    def record_end(self) -> float:
        """Time of the end of the last sample, ns."""
        return self.sample_start + self.sample_interval * self.n_samples

    @property
    def degree(self) -> int:
        """Longest history of the orders that are followed; `config.degree` has room for longer ones."""
        # Surfaces are the ground, if there is one, plates, and materials of meshes.
        n_plates = len(self.config.surfaces) - self.config.has_ground - self.config.n_mesh_materials
        return max_degree(self.orders, n_plates) if self.config.keeps_histories else 0

    @property
    def is_random(self) -> bool:
        """True if anything is drawn at random."""
        return self.config.is_random

    def with_config(self, **changes: Any) -> "Plan":
        """Return the plan with other values in its static configuration."""
        return dataclasses.replace(self, config=dataclasses.replace(self.config, **changes))

    def with_limits(self, **changes: Any) -> "Plan":
        """Return the plan with other path limits."""
        return dataclasses.replace(self, limits=dataclasses.replace(self.limits, **changes))

    def with_room(self) -> "Plan":
        """Return the plan with more room, where optics are applied while light is traced.

        Responses are small then, and loops end when all of their photons have: time hardly depends on sizes,
        and most changes of a scene compile nothing. A beam at nadir shares the program of others, although
        one of its own would be faster in tall canopies. For values alone, as reverse mode keeps what every
        step of a loop leaves.
        """
        if self.config.keeps_histories:
            return self
        config, bins = self.config, self.bins
        roomy = dataclasses.replace(
            config,
            vertical=False,
            order_steps=size_bucket(max(config.order_steps, _ROOM_FOR_ORDERS), 1),
            max_ray_segments=size_bucket(max(config.max_ray_segments, _ROOM_FOR_SEGMENTS), 2),
            max_faces=size_bucket(max(config.max_faces, _ROOM_FOR_FACES), 1),
        )
        # Three times a power of two: records of a few hundred ns have the smallest size.
        count = 3 * size_bucket(max(-(-bins.count // 3), _ROOM_FOR_BINS // 3), 1)
        span = size_bucket(max(bins.max_span, _ROOM_FOR_SPAN), 2)
        bins = dataclasses.replace(bins, count=count, max_span=span)
        return dataclasses.replace(self, config=roomy, bins=bins)

    def jacobian_memory(self, columns: int) -> float:
        """Return the bytes of derivatives in `columns` geometric unknowns, without compilation."""
        return jacobian_bytes(
            self.config,
            self.bins,
            degree=self.degree,
            n_traces=self.n_traces,
            batches=MIN_BATCHES,
            columns=columns,
        )

    def __str__(self) -> str:
        lines = table_lines(self.effects)
        sizes = (
            f"{self.n_samples} samples of {self.sample_interval:g} ns from {self.sample_start:g} ns, "
            f"{self.bins.count} fine bins of {self.bins.width:.3g} ns"
        )
        if not self.config.uses_quadrature and self.n_rays > 1:
            sizes += f", {self.n_rays} rays"
        if self.config.follows_higher_orders:
            sizes += f", {self.config.photons_per_batch} photons a batch, {self.orders} orders"
        if not self.config.keeps_histories:
            sizes += ", optics applied while light is traced"
        # Memory is linear in the number of columns: two of them give the intercept and the slope.
        one_column, two_columns = (self.jacobian_memory(n) for n in (1, 2))
        memory = f"about {format_bytes(self.memory)} of memory; a Jacobian in one geometric unknown "
        memory += f"{format_bytes(one_column)}, in each more {format_bytes(two_columns - one_column)}"
        return "\n".join([*lines, sizes, memory, *self.table.survey_lines])


def plan(
    lidar: Lidar | Survey,
    scene: Scene,
    *,
    rtol: float | None = None,
    max_orders: int | None = None,
    max_step: float | None = None,
    n_photons: int = 65536,
    n_rays: int | None = None,
    window: tuple[float, float] | None = None,
    bin_width: float | None = None,
    footprint: str = "random",
    effects: Mapping[str, bool] | None = None,
    max_memory: float | None = None,
    histories: bool | None = None,
    describe: bool = True,
) -> Plan:
    """Plan what `simulate` will do for a lidar and a scene.

    Effects that the lidar and the scene do not have are off, and never compiled. All others are on, however
    small, unless they are switched off: a plan also serves other values of the same scene, in fits and
    derivatives.

    **Arguments:**

    - `lidar`: a `Lidar`; or a `Survey`: the plan then serves all of its shots; its table is that of a shot
      in their middle with the largest zenith, followed by how `simulate_many` would trace the survey, what a
      shot takes, and the size of the results.
    - `scene`: a `Scene`.
    - `rtol`: relative accuracy aimed at, in (0, 1); sets how many orders are worth following, and for how
      long. Default None: 0.01.
    - `max_orders`: follow light for this many scatterings, whatever `rtol` needs; at least 1. Default None:
      from `rtol` and the optics; with histories, as many as their table has room for (some 16 to 29).
    - `max_step`: longest segment, m, of a footprint ray that order one deposits at once; positive. The result
      does not depend on it. Default None: the ray's chord in a voxel, or about 64 fine bins.
    - `n_photons`: photons of eight batches together, at least 1, rounded up to as many for each. Simulations
      trace eight batches, or more until their error is reached. Default 65536.
    - `n_rays`: rays that sample the footprint in each batch, at least 1; without effect over planes alone,
      where a quadrature rule takes their place. Default None: 4096 with one order or a fixed footprint; else
      2048 where the pulse's standard deviation, with its jitter, is below a sampling interval; else 1024.
    - `window`: (first, last) sample time, ns. Default None: covers the scene, and multiple scattering until
      what returns later is likely to be below `rtol`, for 3000 ns at most; for 300 ns at most where
      thousands of histories must be kept (many orders and more than 8 wavelengths).
    - `bin_width`: width of the fine bins, ns, positive; reduced to a whole fraction of the sampling interval.
      Default None: a quarter of the pulse's finest feature with its jitter, between 0.05 and 1 sampling
      intervals; half an interval for a pulse without duration.
    - `footprint`: "random" (each batch shifts the rays, so that the standard error covers them) or "fixed".
      Default "random".
    - `effects`: effects to switch off, by name, as in {"multiple scattering": False}; True asks for what is
      on anyway and refuses scenes that do not have it. Only leaf or bark that is zero everywhere, relief of
      terrain that is a plane, and meshes that no ray of a single order meets are off unless True asks for
      them. The names are those of the table's first column. Default None.
    - `max_memory`: GB that the simulation may take, positive. Default None: a quarter of the machine's.
    - `histories`: True to keep scattering histories, so that one trace serves all optics and wavelengths, and
      derivatives with respect to optics take no trace; False to apply optics while light of several orders is
      traced, for at most 8 wavelengths, which is faster, has no limit on orders but 1000, and takes less
      memory. Default None: histories, but where one response of them would take more than 24 MB (some 18
      orders of leaves over ground), or leave out orders that are likely to matter (dense and bright
      canopies). `simulate` without a plan applies optics wherever it may.
    - `describe`: True to make the table of effects with its bounds, which takes some 40 ms, and of a survey
      the lines on its simulation, some tenths of a second. Default True.

    **Returns:** a `Plan`; `print` shows it as a table.

    **Raises:** ValueError for inadmissible arguments, for more than 100 orders with histories where leaves or
    plates both reflect and transmit (weights of single precision), for a scene that reaches up to the
    altitude of the sensor, for a `Lidar(sensor=)` below the ground, in a plate, less than 1 degree from the
    level within a canopy with periodic sides, or in air with a lidar ratio, for a footprint that lies partly
    off the terrain, for a canopy or a mesh that is more than 100 km away from every beam, for what would take
    more memory than `max_memory`, and if the geometry is being traced by a JAX transformation: make the plan
    outside and pass it in.

    **Example:**

    >>> import jaxlidar as jl
    >>> scene = jl.Scene(ground=jl.Ground(slope=10.0))
    >>> plan = jl.plan(jl.Lidar(), scene, effects={"divergence": False})
    >>> print(plan.orders, [effect.name for effect in plan.effects if effect.simulated])
    1 ['ground', 'slope spread']
    """
    survey = lidar if isinstance(lidar, Survey) else None
    lidar = lidar.middle if isinstance(lidar, Survey) else lidar
    check_kinds(lidar, scene)
    rtol = DEFAULT_RTOL if rtol is None else rtol
    check_number("rtol", rtol, 0.0, 1.0, low_open=True, high_open=True)
    rtol = float(rtol)
    check_integer("n_photons", n_photons)
    for name, value in (("n_rays", n_rays), ("max_orders", max_orders)):
        if value is not None:
            check_integer(name, value)
    if max_step is not None:
        check_number("max_step", max_step, 0.0, low_open=True)
    if max_memory is not None:
        check_range("max_memory", max_memory, 0.0, low_open=True)
    check_choice("footprint", footprint, ("random", "fixed"))
    check_kind("histories", histories, bool | None, "True, False or None")
    shots, scene_of_map = lidar if survey is None else survey, scene
    check_footprints_on_terrain(shots, scene)
    check_scene_near_beams(shots, scene)
    air = scene.atmosphere
    if lidar.has_sensor_position and air is not None and air.lidar_ratio is not None:
        raise ValueError(
            "lidar_ratio: the return of the air itself is not simulated for a lidar that is placed by its "
            "sensor; admissible is lidar_ratio = None, or a lidar with an altitude"
        )
    # From here on x = y = 0 is the aim point, or the middle of the survey (see `local_origin`).
    survey = None if survey is None else survey.relative_to(concrete_array(lidar.position)[:2])
    lidar, scene = move_aim_to_origin(lidar, scene)
    # 1. Effects: leaf or bark that is zero everywhere, relief of flat terrain, and meshes out of reach are
    # off, then what the user switches off. The table compares with everything else in place.
    empty_materials = find_empty_materials(scene, effects)
    scene = without_effects(lidar, scene, empty_materials)[1]
    with_relief, scene = scene, replace_plane_terrain(lidar, scene, effects)
    flat_terrain = scene is not with_relief
    switches = effects or {}
    # Scattered light may go anywhere; of one order there are only the rays of the footprint.
    one_order = max_orders == 1 or switches.get("multiple scattering") is False
    unreached_meshes = bool(scene.meshes) and one_order and switches.get("meshes") is not True
    unreached_meshes = unreached_meshes and not meshes_are_in_reach(survey or lidar, scene)
    if unreached_meshes:
        scene = without_effects(lidar, scene, ("meshes",))[1]
    complete_scene = scene
    off = switched_off_effects(effects, present_effects(lidar, scene), max_orders)
    off = (*off, *(("relief",) if flat_terrain else ()), *empty_materials)
    off = (*off, *(("meshes",) if unreached_meshes else ()))
    complete_lidar = lidar
    lidar, scene = without_effects(lidar, scene, off)
    # 2. Orders of scattering, from the optics.
    path_lengths = PathLengths(lidar, scene, survey)
    optics = scene_optics(lidar, scene)
    scatterers = number_channels(optics)
    n_channels, n_plates = len(scatterers.channels), len(scene.plates)
    wavelengths = lidar.wavelength.size
    histories = _possible_histories(histories, max_orders, scatterers, wavelengths)
    order_choice = choose_orders(
        scene, optics, n_channels, rtol, 1 if "multiple scattering" in off else max_orders, histories
    )
    orders = order_choice.count
    if orders == 1 and histories is False:
        # A single order has few histories, and no photons.
        histories = None
    steps = order_steps(orders, n_plates, n_channels)
    # 3. Time: fine bins from the pulse's features, samples from the window.
    jitter, interval = concrete_number(lidar.jitter), concrete_number(lidar.sampling_interval)
    # Jitter smooths the pulse: widths add in quadrature.
    pulse_feature = math.hypot(concrete_number(lidar.pulse.finest), jitter)
    pulse_std = math.hypot(concrete_number(lidar.pulse.std), jitter)
    first_return = path_lengths.first_path / SPEED_OF_LIGHT
    last_return = path_lengths.last_path / SPEED_OF_LIGHT
    n_histories = 1
    if histories or wavelengths > MAX_APPLIED_WAVELENGTHS:
        n_histories = math.comb(max_degree(steps, n_plates) + n_channels, n_channels)
    tail = 0.0
    if orders > 1:
        tail = multiple_scattering_tail(scene, optics, first_return, last_return, rtol, n_histories)
    target_width = target_bin_width(interval, pulse_feature, pulse_std, bin_width)
    bins, samples = bins_and_samples(lidar, scene, path_lengths, tail, window, target_width)
    bins_with_air = extend_to_air_return(bins, lidar, samples)
    bin_length = 0.5 * SPEED_OF_LIGHT * bins.width
    max_segment, max_span = longest_segment(path_lengths.longest_chord, bin_length, max_step)
    # Light that comes later is not recorded, so that longer paths need not be followed.
    max_path = SPEED_OF_LIGHT * (bins.start + bins.width * bins.count)
    # Rounded up only now: the bins beyond `max_path` stay empty, and cost less than a compilation.
    bins = dataclasses.replace(bins, max_span=max_span, count=size_bucket(bins.count, 4))
    pulse_support = lidar.pulse.support(jitter)
    # 4. Sizes of loops and batches.
    if n_rays is None:
        # The shorter the pulse, the fewer rays a sample is made of.
        short_pulse = pulse_std < interval
        n_rays = 4096 if orders == 1 or footprint == "fixed" else 2048 if short_pulse else 1024
    # Rays march through steps that they do not need: buckets are at most a quarter apart where steps are few,
    # a sixteenth where they are many.
    ray_segments = path_lengths.max_ray_segments(max_segment)
    wide_beam = "divergence" not in off
    config = TraceConfig(
        materials=scatterers.materials,
        channels=scatterers.channels,
        leaf=scatterers.leaf,
        bark=scatterers.bark,
        surfaces=scatterers.surfaces,
        covers_fully=tuple(
            not isinstance(s, AbstractSheet) or concrete_number(s.coverage) == 1.0 for s in scene.surfaces
        ),
        mirrors=tuple(isinstance(s.law, AbstractMirror) for s in scene.surfaces),
        n_mesh_materials=sum(len(mesh.surfaces) for mesh in scene.meshes),
        has_ground=scene.ground is not None,
        hotspot=scene.canopy is not None and scene.canopy.hotspot,
        vertical=path_lengths.vertical,
        returns_specular="specular return" not in off,
        max_ray_segments=size_bucket(ray_segments, 4 if ray_segments <= 128 else 16),
        max_faces=size_bucket(path_lengths.max_faces(max_path + path_lengths.start_distance)),
        order_steps=steps,
        # Without a canopy all deposit points of a flight would be on the same surface.
        deposits_per_flight=1 if scene.canopy is None else DEPOSITS_PER_FLIGHT,
        degree=max_degree(steps, n_plates),
        first_degree=1 + 2 * n_plates,
        keeps_histories=True,
        # A beam whose divergence is switched off is one ray. One whose divergence is zero is not, as the plan
        # also serves wider beams.
        n_rays=int(n_rays) if wide_beam else 1,
        photons_per_batch=-(-int(n_photons) // MIN_BATCHES),
        uses_quadrature=consists_of_planes(scene) and has_smooth_footprint(lidar) and wide_beam,
        random_footprint=footprint == "random" and wide_beam,
    )
    limits = PathLimits(
        start_distance=path_lengths.start_distance,
        max_segment=max_segment,
        max_flight=path_lengths.longest_flight(max_path + path_lengths.start_distance),
        max_path=max_path,
        reflection_probability=reflection_probability(optics),
    )
    # 5. Memory decides between histories and applied optics, and how many orders there is room for.
    straight = scene.canopy is not None and scene.canopy.is_straight
    # A sample collects the pulse's support and its own interval, and partial bins at the ends.
    pulse_bins = math.ceil((pulse_support[1] - pulse_support[0] + samples.interval) / bins.width) + 5

    # A trace for each wavelength where extinction depends on it (leaves that transmit straight on), or where
    # optics are applied to deposits.
    def n_traces(keeps: bool) -> int:
        return wavelengths if straight or not keeps else 1

    def degree_of(orders: int, keeps: bool) -> int:
        return max_degree(order_steps(orders, n_plates, n_channels), n_plates) if keeps else 0

    def memory_of(orders: int, keeps: bool) -> float:
        return simulation_bytes(
            config,
            bins,
            degree=degree_of(orders, keeps),
            n_samples=samples.count,
            bins_per_sample=samples.bins_per_sample,
            pulse_bins=pulse_bins,
            n_traces=n_traces(keeps),
        ) + mesh_bytes(scene.meshes)

    limit = memory_limit(max_memory)
    if order_choice.needs_applied_optics:
        histories = False
    if histories is None:
        response = response_bytes(config, bins, degree=degree_of(orders, True), n_traces=n_traces(True))
        histories = keeps_histories(response, memory_of(orders, True), memory_of(orders, False), limit)
    keeps = histories
    if not keeps:
        config = dataclasses.replace(config, keeps_histories=False, degree=0)
    memory = memory_of(orders, keeps)
    of_order_one = dataclasses.replace(config, order_steps=1)
    first_order = response_bytes(of_order_one, bins, degree=0, n_traces=n_traces(keeps))
    check_memory(memory, limit, first_order=first_order, n_plates=n_plates, wavelengths=wavelengths)
    # Fits may ask for more orders later: the scope says how many there would be memory for.
    possible_orders = range(max(order_choice.affordable_orders, orders), orders - 1, -1)
    table, on_survey = (), ()
    if describe:
        # With all effects: a row also says what an effect that is off would change.
        table = effect_table(
            complete_lidar,
            complete_scene,
            off,
            order_choice,
            bins_with_air,
            path_lengths.start_distance,
            records_all_of_order_one=window is None,
        )
        if isinstance(shots, Survey):
            on_survey = survey_lines(shots, scene_of_map, rtol, max_orders)
        if survey is not None and beams_are_parallel(survey):
            bound = parallel_light_bound(survey, path_lengths.start_distance, last_return)
            reason = "neglected where footprints share light"
            table += (Effect("spreading of rays", False, reason, bound, "samples"),)
    return Plan(
        config=config,
        limits=limits,
        bins=bins,
        sample_start=samples.start,
        sample_interval=samples.interval,
        n_samples=samples.count,
        bins_per_sample=samples.bins_per_sample,
        first_sample=first_sample_in_bins(samples.start, bins),
        orders=orders,
        n_traces=n_traces(keeps),
        pulse_support=pulse_support,
        pulse_band=band_of_long_record(pulse_support, samples, bins),
        off=off,
        rtol=rtol,
        likely_beyond=order_choice.beyond,
        scope=PlanScope(
            from_sensor=path_lengths.from_sensor,
            first_return=first_return,
            last_return=last_return,
            albedo=largest_albedo(optics),
            pulse_feature=pulse_feature,
            automatic_orders=max_orders is None and "multiple scattering" not in off,
            automatic_window=window is None,
            affordable_orders=next(n for n in possible_orders if memory_of(n, keeps) <= limit),
            flat_terrain=flat_terrain,
            empty_materials=empty_materials,
            unreached_meshes=unreached_meshes,
            max_memory=max_memory,
        ),
        memory=memory,
        table=_EffectTable(table, on_survey),
    )


def _possible_histories(
    histories: bool | None, max_orders: int | None, scatterers: ScattererChannels, wavelengths: int
) -> bool | None:
    """Return True or False where histories must, or cannot be kept, and else what is asked for.

    **Raises:** ValueError where neither is possible.
    """
    few_wavelengths = wavelengths <= MAX_APPLIED_WAVELENGTHS
    if histories is False and not few_wavelengths:
        raise ValueError(
            f"histories = False with {wavelengths} wavelengths; admissible are at most "
            f"{MAX_APPLIED_WAVELENGTHS}, or histories = True"
        )
    # A photon's weight is divided by the probability of reflection or transmission at every scattering.
    all_scatterers = (scatterers.leaf, scatterers.bark, *scatterers.surfaces)
    splits = any(s is not None and min(s.reflection, s.transmission) >= 0 for s in all_scatterers)
    if max_orders is not None and max_orders > MAX_ORDERS_OF_HISTORIES and splits and histories is not False:
        if histories or not few_wavelengths:
            raise ValueError(
                f"max_orders = {max_orders} with scattering histories, of materials that reflect and "
                f"transmit; admissible are at most {MAX_ORDERS_OF_HISTORIES}, or histories = False and at "
                f"most {MAX_APPLIED_WAVELENGTHS} wavelengths"
            )
        return False
    return histories if few_wavelengths else True
