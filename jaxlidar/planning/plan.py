"""The plan of a simulation: effects simulated, bounds on what each changes, and sizes of all loops."""

import dataclasses
import math
from collections.abc import Mapping
from typing import NamedTuple

from jaxlidar._checks import check_choice, check_integer, check_range, concrete_array, concrete_number
from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.instrument.survey import Survey
from jaxlidar.optics.laws import AbstractMirror
from jaxlidar.planning.effect_table import effect_table, table_lines
from jaxlidar.planning.effects import Effect, empty, flattened, only_planes, present, switched_off, without
from jaxlidar.planning.ladder import rung
from jaxlidar.planning.local_origin import about_aim
from jaxlidar.planning.memory import (
    check_memory,
    in_words,
    jacobian_bytes,
    keeps_histories,
    memory_limit,
    predicted,
)
from jaxlidar.planning.orders import degree_of, order_steps, orders_of, tail_of
from jaxlidar.planning.parallel_light import one_direction, parallel_light
from jaxlidar.planning.path_lengths import PathLengths, stretch
from jaxlidar.planning.record_times import fine_bin, times_of, with_air
from jaxlidar.planning.rims import check_on_terrain
from jaxlidar.planning.scatterers import largest_albedo, lobe_probability, scene_optics, spell
from jaxlidar.planning.trace_plan import Bins, TracePlan
from jaxlidar.scenes.scene import Scene, check_kinds
from jaxlidar.scenes.surfaces import AbstractSheet

DEFAULT_RTOL = 0.01
# Fewer batches give no trustworthy standard error.
MIN_BATCHES = 8
# Points of each flight through a canopy from which light returns.
ENDS = 4


class Limits(NamedTuple):
    """What a plan was made for.

    - `first`, `last`: times (ns) of the first and the last return of order one. - `albedo`: the largest.
    - `finest`: scale (ns) of the finest feature of the pulse.
    - `automatic_orders`, `automatic_window`: whether the plan chose them. - `most_orders`: how many there is
      room for. - `flat`: whether terrain was found to be a plane.
    - `empty`: which of "leaf" and "bark" were found to be zero everywhere.
    - `max_memory`: as it was given.
    """

    first: float
    last: float
    albedo: float
    finest: float
    automatic_orders: bool
    automatic_window: bool
    most_orders: int
    flat: bool
    empty: tuple[str, ...]
    max_memory: float | None


@dataclasses.dataclass(frozen=True)
class Plan:
    """How a lidar and a scene will be simulated: effects, time bins, orders and numbers of rays and photons.

    Plans are made by `jaxlidar.plan`. Printed, a plan is a table of effects, followed by a line of sizes. It
    is static: what a plan leaves out is never compiled.

    - `trace`: what the tracer must know: scatterers, lengths, sizes of loops.
    - `bins`: the fine time bins, into which returns are sorted.
    - `sample_start`, `sample_interval`: time of the first sample, and the interval between samples, ns.
    - `n_samples`: number of samples.
    - `per_sample`: fine bins per sample.
    - `n_rays`: rays of the footprint, which carry the first order.
    - `n_photons`: photons per batch, which carry the higher orders.
    - `smooth_footprint`: whether a quadrature rule takes the place of the rays, as it does over planes.
    - `random_footprint`: whether each batch shifts the rays at random.
    - `degree`, `first_degree`: most scatterings and passages through plates on a path, of all orders and of
      order one.
    - `traces`: of a response: one for each wavelength, where it matters while light is traced.
    - `reach`: times (ns) between which the pulse's energy lies.
    - `off`: names of the effects that are switched off.
    - `rtol`: relative accuracy aimed at.
    - `likely_beyond`: estimated share of the light of orders beyond the last.
    - `limits`: what the plan was made for, and a lidar and a scene that use it must keep to.
    - `memory`: bytes that a simulation is predicted to take.
    - `effects`: the table, an `Effect` for every row; empty where it was not asked for.

    **Example:**

    >>> import jaxlidar as jl
    >>> plan = jl.plan(jl.Lidar(), jl.Scene(ground=jl.Ground()))
    >>> print(str(plan).splitlines()[-2])
    31 samples of 1 ns from -15 ns, 7 fine bins of 0.5 ns
    """

    trace: TracePlan
    bins: Bins
    sample_start: float
    sample_interval: float
    n_samples: int
    per_sample: int
    n_rays: int
    n_photons: int
    smooth_footprint: bool
    random_footprint: bool
    degree: int
    first_degree: int
    traces: int
    reach: tuple[float, float]
    # Names of the effects that are switched off.
    off: tuple[str, ...]
    # Compiled programs depend on none of these.
    rtol: float = dataclasses.field(compare=False)
    likely_beyond: float = dataclasses.field(compare=False)
    limits: Limits = dataclasses.field(compare=False)
    memory: float = dataclasses.field(compare=False)
    effects: tuple[Effect, ...] = dataclasses.field(compare=False)

    @property
    def orders(self) -> int:
        """Number of scatterings that are followed."""
        return int(self.trace.orders)

    @property
    def least_degree(self) -> int:
        """Longest history of the orders that are followed; `degree` has room for more of them."""
        plates = len(self.trace.surfaces) - self.trace.has_ground
        return degree_of(self.orders, plates) if self.trace.keeps_histories else 0

    def jacobian_memory(self, columns: int) -> float:
        """Bytes that derivatives in so many geometric unknowns at once take, beside what compiling takes."""
        sizes = self.least_degree, self.first_degree, self.traces, (self.n_photons, self.n_rays)
        return jacobian_bytes(self.trace, self.bins, *sizes, MIN_BATCHES, columns)

    @property
    def is_random(self) -> bool:
        """Whether anything is drawn at random."""
        if self.trace.order_steps > 1 or self.trace.drawn_first:
            return True
        return self.random_footprint and not self.smooth_footprint

    def __str__(self) -> str:
        lines = table_lines(self.effects)
        sizes = (
            f"{self.n_samples} samples of {self.sample_interval:g} ns from {self.sample_start:g} ns, "
            f"{self.bins.count} fine bins of {self.bins.width:.3g} ns"
        )
        if not self.smooth_footprint and self.n_rays > 1:
            sizes += f", {self.n_rays} rays"
        if self.orders > 1:
            sizes += f", {self.n_photons} photons a batch, {self.orders} orders"
        if not self.trace.keeps_histories:
            sizes += ", optics applied while light is traced"
        one, two = (self.jacobian_memory(n) for n in (1, 2))
        memory = f"about {in_words(self.memory)} of memory; a Jacobian in one geometric unknown "
        memory += f"{in_words(one)}, in each more {in_words(two - one)}"
        return "\n".join([*lines, sizes, memory])


def plan(
    lidar: Lidar | Survey,
    scene: Scene,
    *,
    rtol: float | None = None,
    max_orders: int | None = None,
    max_step: float | None = None,
    n_photons: int = 8192,
    n_rays: int | None = None,
    window: tuple[float, float] | None = None,
    bin_width: float | None = None,
    footprint: str = "random",
    effects: Mapping[str, bool] | None = None,
    max_memory: float | None = None,
    describe: bool = True,
) -> Plan:
    """The plan of what `simulate` will do for a lidar and a scene.

    Effects that the lidar and the scene do not have are off, and never compiled. All others are on, however
    small, unless they are switched off: a plan also serves other values of the same scene, in fits and
    derivatives.

    **Arguments:**

    - `lidar`: a `Lidar`; or a `Survey`: the plan then serves all of its shots; its table is that of a shot
      in their middle with the largest zenith.
    - `scene`: a `Scene`.
    - `rtol`: relative accuracy aimed at, in (0, 1); sets how many orders are worth following. Default None:
      0.01.
    - `max_orders`: number of scatterings followed, at least 1. Default None: from `rtol` and the largest
      albedo.
    - `max_step`: longest stretch, m, that the first order takes at once; positive. The result does not depend
      on it. Default None: what lies within one voxel, or 64 fine bins.
    - `n_photons`: photons per batch, at least 1. Default 8192.
    - `n_rays`: rays of the footprint per batch, at least 1; without effect over planes alone, where a
      quadrature rule takes their place. Default None: 4096 with one order or a fixed footprint; else 2048
      where the pulse's standard deviation, with its jitter, is below a sampling interval; else 1024.
    - `window`: (first, last) sample time, ns. Default None: covers the scene, and multiple scattering until
      little of it is left, or 300 ns at most.
    - `bin_width`: width of the fine bins, ns, positive; reduced to a whole fraction of the sampling interval.
      Default None: a quarter of the pulse's finest feature with its jitter, between 0.05 and 1 sampling
      intervals; half an interval for a pulse without duration.
    - `footprint`: "random" (each batch shifts the rays, so that the standard error covers them) or "fixed".
      Default "random".
    - `effects`: effects to switch off, by name, as in {"multiple scattering": False}; True asks for what is
      on anyway and refuses scenes that do not have it. Only leaf or bark that is zero everywhere, and relief
      of terrain that is a plane, are off unless True asks for them. The names are those of the table's first
      column. Default None.
    - `max_memory`: GB that the simulation may take, positive. Default None: a quarter of the machine's.
    - `describe`: whether to make the table of effects with its bounds, which takes some 40 ms. Default True.

    **Returns:** a `Plan`; `print` shows it as a table.

    **Raises:** ValueError for inadmissible arguments, for a scene that reaches up to the sensor, for a
    footprint that lies partly off the terrain, for what would take more memory than `max_memory`, and if the
    geometry is being traced by a JAX transformation: make the plan outside and pass it in.

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
    rtol = DEFAULT_RTOL if rtol is None else float(rtol)
    if not 0 < rtol < 1:
        raise ValueError(f"rtol = {rtol:g} is outside the admissible range (0, 1)")
    check_integer("n_photons", n_photons)
    for name, value in (("n_rays", n_rays), ("max_orders", max_orders)):
        if value is not None:
            check_integer(name, value)
    if max_step is not None and not 0 < max_step < math.inf:
        raise ValueError(f"max_step = {max_step:g} is outside the admissible range (0, inf)")
    if max_memory is not None:
        check_range("max_memory", max_memory, 0.0, low_open=True)
    check_choice("footprint", footprint, ("random", "fixed"))
    check_on_terrain(lidar if survey is None else survey, scene)
    survey = None if survey is None else survey.about(concrete_array(lidar.position))
    lidar, given = about_aim(lidar, scene)
    nothing = empty(given, effects)
    given = without(lidar, given, nothing)[1]
    scene = flattened(given, effects)
    whole = lidar, scene
    off = switched_off(effects, present(lidar, scene), max_orders)
    flat = scene is not given
    off = (*off, *(("relief",) if flat else ()), *nothing)
    lidar, scene = without(lidar, scene, off)
    geometry = PathLengths(lidar, scene, survey)
    optics = scene_optics(lidar, scene)
    letters = spell(optics)
    if "multiple scattering" in off:
        max_orders = 1
    chosen = orders_of(scene, optics, len(letters.letters), rtol, max_orders)
    orders, plates = chosen.count, len(scene.plates)

    def steps_of(orders: int) -> int:
        return order_steps(orders, plates, len(letters.letters))

    jitter = concrete_number(lidar.jitter)
    finest = math.hypot(concrete_number(lidar.pulse.finest), jitter)
    duration = math.hypot(concrete_number(lidar.pulse.std), jitter)
    if n_rays is None:
        # The shorter the pulse, the fewer rays a sample is made of.
        short = duration < concrete_number(lidar.sampling_interval)
        n_rays = 4096 if orders == 1 or footprint == "fixed" else 2048 if short else 1024
    tail = tail_of(scene, optics, geometry.first / SPEED_OF_LIGHT, geometry.last / SPEED_OF_LIGHT)
    target = fine_bin(concrete_number(lidar.sampling_interval), finest, duration, bin_width)
    bins, samples = times_of(lidar, scene, geometry, tail if orders > 1 else 0.0, window, target)
    airy = with_air(bins, lidar, samples)
    metres = 0.5 * SPEED_OF_LIGHT * bins.width
    step, row = stretch(geometry.longest_chord, metres, max_step)
    last = SPEED_OF_LIGHT * (bins.start + bins.width * bins.count)
    bins = dataclasses.replace(bins, row=row, count=rung(bins.count, 4))
    # Rays march through room that they do not need: rungs are a quarter apart at most where steps are few, a
    # sixteenth where they are many.
    first_steps = geometry.first_steps(step)
    trace = TracePlan(
        materials=letters.materials,
        letters=letters.letters,
        leaf=letters.leaf,
        bark=letters.bark,
        surfaces=letters.surfaces,
        full_cover=tuple(
            not isinstance(s, AbstractSheet) or concrete_number(s.coverage) == 1.0 for s in scene.surfaces
        ),
        mirrors=tuple(isinstance(s.law, AbstractMirror) for s in scene.surfaces),
        has_ground=scene.ground is not None,
        hotspot=scene.canopy is not None and scene.canopy.hotspot,
        vertical=geometry.vertical,
        upstream=geometry.upstream,
        first_steps=rung(first_steps, 4 if first_steps <= 128 else 16),
        march_steps=rung(geometry.march_steps(last + geometry.upstream)),
        max_step=step,
        max_flight=geometry.longest_flight(last + geometry.upstream),
        last=last,
        lobe=lobe_probability(optics),
        orders=orders,
        order_steps=steps_of(orders),
        # Without a canopy all ends of a flight are on the same surface.
        ends=1 if scene.canopy is None else ENDS,
        drawn_first=False,
        independent=False,
    )
    degree, first_degree = degree_of(steps_of(orders), plates), 1 + 2 * plates
    reach = lidar.pulse.support(jitter)
    spanned = math.ceil((reach[1] - reach[0] + samples[1]) / bins.width) + 5
    limit = memory_limit(max_memory)
    straight = scene.canopy is not None and scene.canopy.is_straight
    wavelengths = lidar.wavelength.size

    def memory_of(orders: int, keeps: bool) -> float:
        most, traces = degree_of(steps_of(orders), plates), wavelengths if straight or not keeps else 1
        return predicted(trace, bins, most if keeps else 0, first_degree, samples[2], spanned, traces)

    keeps = keeps_histories(memory_of(orders, True), memory_of(orders, False), limit, wavelengths)
    trace = dataclasses.replace(trace, keeps_histories=keeps)
    degree = degree if keeps else 0
    memory = memory_of(orders, keeps)
    check_memory(memory, limit)
    most = next(n for n in range(max(chosen.most, orders), orders - 1, -1) if memory_of(n, keeps) <= limit)
    rows = ()
    if describe:
        rows = effect_table(*whole, off, chosen, airy, geometry.upstream, whole_first=window is None)
        if survey is not None and one_direction(survey):
            bound = parallel_light(survey, geometry.upstream, geometry.last / SPEED_OF_LIGHT)
            reason = "neglected where footprints share light"
            rows += (Effect("spreading of rays", False, reason, bound, "samples"),)
    return Plan(
        trace=trace,
        bins=bins,
        sample_start=samples[0],
        sample_interval=samples[1],
        n_samples=samples[2],
        per_sample=samples[3],
        # A beam without width is one ray.
        n_rays=1 if "divergence" in off else int(n_rays),
        n_photons=int(n_photons),
        smooth_footprint=only_planes(scene) and "divergence" not in off,
        random_footprint=footprint == "random" and "divergence" not in off,
        degree=degree,
        first_degree=first_degree,
        traces=wavelengths if straight or not keeps else 1,
        reach=reach,
        off=off,
        rtol=rtol,
        likely_beyond=chosen.beyond,
        limits=Limits(
            geometry.first / SPEED_OF_LIGHT,
            geometry.last / SPEED_OF_LIGHT,
            largest_albedo(optics),
            finest,
            max_orders is None,
            window is None,
            most,
            flat,
            nothing,
            max_memory,
        ),
        memory=memory,
        effects=rows,
    )
