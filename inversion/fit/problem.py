"""The problem of a fit: records, instrument, scene, unknowns and noise, checked once.

A `Problem` is what a user states. Its constructor checks it and makes a `BoundProblem`: records with their
noise, unknowns bound to scenes, and a plan. `retrieve`, `retrieve_many`, `log_density`, `profile_likelihood`
and `cramer_rao` take a problem and read the bound one.

Where JAX is tracing records, noise, times, lidar or scene, a problem is not bound: the numbers are unknown.
`retrieve` makes it anew with those that it gets (`inversion.fit.implicit_differentiation`).
"""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import ArrayLike

from inversion.fit.data import (
    ObservedWaveform,
    as_noise,
    as_observed,
    as_sample_times,
    nothing_observed,
    with_fixed_window,
)
from inversion.fit.planning import checked_plan, plan_without_record, size_arguments
from inversion.fit.recorder_model import RecorderModel, check_names
from inversion.fit.unknowns import BoundUnknown, Unknown, bind_unknowns, unknown_outside_scene, with_start
from inversion.receiver.recorder import Recorder, bound_pair
from jaxlidar import Lidar, Plan, Scene, Waveform
from jaxlidar.extend import as_numpy, check_kind, check_kinds


@dataclasses.dataclass(frozen=True)
class BoundProblem:
    """A problem that has been checked, its unknowns bound to scene and lidar.

    `lidars`, `scenes`, `unknowns` and `recorders` have one object for all records, or one for each.

    - `numbers`: of the records; the random keys of their starts are made from these.
    - `observed`: each record with its noise.
    - `unknowns`: of scene and lidar.
    - `scale`: the unknown "scale", or empty.
    - `plan`: serves all scenes and lidars within the bounds.
    """

    numbers: Sequence[int]
    observed: list[ObservedWaveform]
    lidars: list[Lidar]
    scenes: list[Scene]
    unknowns: list[list[BoundUnknown]]
    scale: list[BoundUnknown]
    recorders: list[Recorder | None]
    plan: Plan

    def unknowns_of(self, i: int) -> list[BoundUnknown]:
        """Return the unknowns of scene and lidar of record `i`."""
        return _of_record(self.unknowns, i)

    def recorder_model(self, i: int) -> RecorderModel:
        """Return the model of the recorder of record `i`, with the scale."""
        recorder, lidar = _of_record(self.recorders, i), _of_record(self.lidars, i)
        return RecorderModel(recorder, self.scale, lidar, self.observed[i].time.size)

    @property
    def all_unknowns(self) -> list[BoundUnknown]:
        """Unknowns of the first record, then its recorder's. Names, shapes and bounds are those of all."""
        return [*self.unknowns[0], *self.recorder_model(0).unknowns]

    def subset(self, indices: Sequence[int]) -> "BoundProblem":
        """Return the problem of some records."""

        def of_subset(objects: list[Any]) -> list[Any]:
            # One for all stays one for all, unless there is one record anyway.
            is_shared = len(objects) == 1 < len(self.observed)
            return objects if is_shared else [objects[i] for i in indices]

        names = ("observed", "lidars", "scenes", "unknowns", "recorders")
        parts: dict[str, Any] = {name: of_subset(getattr(self, name)) for name in names}
        return dataclasses.replace(self, numbers=[self.numbers[i] for i in indices], **parts)


@final
class Problem(eqx.Module):
    """What is to be retrieved from which records: the argument of all fits and of what is asked about them.

    It is checked once, as it is made. Unless a plan is given, the simulation is planned here, for the start
    and the corners of the bounds. Arrays are read then: changes in place come too late. `retrieve`,
    `log_density`, `profile_likelihood` and `cramer_rao` take problems of one record, `retrieve_many` one of
    many. For `retrieve` JAX may trace `observed`, `noise`, `time`, lidar, scene and starts.

    **Arguments:**

    - `observed`: a `Waveform`, whose `reflectance` is fitted, or an array (wavelengths, bins) of apparent
      reflectance with `time`, or in any other unit with `scale`. A leading axis makes a problem of many
      records. None: nothing has been recorded yet, for `cramer_rao`.
    - `lidar`: the instrument.
    - `scene`: the scene at the starting values. With many records, lidar and scene are one for all, or a
      sequence of one for each. Those of different records may differ only in the values of their arrays (such
      as transmit pulses, or starting values).
    - `unknowns`: what to retrieve, one `Unknown` or more. Every scene within the bounds must be admissible: a
      sum of reflectance and transmittance above one, for instance, is not noticed.
    - `noise`: one standard deviation of `observed`, in [0, inf], anything that broadcasts to it. Samples are
      taken as independent unless `recorder` says otherwise. Infinity leaves a sample out.
    - `time`: (bins,) ns, the same for all records, needed if `observed` is an array. Times must lie the
      lidar's sampling interval apart. Default None: those of the `Waveform`, or, if nothing has been
      recorded, of the plan.
    - `start`: by name, values that unknowns start from, with a leading axis for many records. Default None:
      their own.
    - `scale`: (low, high), bounds of a further unknown, "scale", which multiplies the simulated reflectance,
      the same for all wavelengths (the gain, or calibration factor, of an uncalibrated receiver). It starts
      from its least-squares value. Default None: no such unknown.
    - `recorder`: what the recorder adds, a `Recorder`: its receiver's response, offsets of its digitisers,
      and the noise of the recorded pulse. With many records, one for all, or one for each, with the same
      unknowns. Default None: nothing.
    - `noise_floor`: fraction of each wavelength's largest observed value (with offsets of a `recorder`, above
      the median), 0 to 1, that replaces any smaller `noise`: a record without noise would give bins that no
      photon reached, where the simulation's standard error is zero, infinite weight. Default 1e-3.
    - `plan`: what to simulate (`jaxlidar.plan`, with the window of `observed`, valid throughout the bounds),
      one for all records. Derivatives are computed in groups if all at once would take more memory than its
      `max_memory`. Default None: planned for the first lidar and scene and the corners of the bounds.
    - `n_photons`: photons of one simulation, all eight batches together, at least 8. Default None: 65536, or
      those of `plan`.
    - `n_rays`: rays that sample the footprint in each of the eight batches, at least 1. Default None: 1024,
      or those of `plan`.
    - `max_orders`: follow light for this many scatterings. Default None: as many as the start needs.

    **Raises:** ValueError for inadmissible arguments, among them a start outside its bounds, samples that do
    not fit the lidar or the plan, a plan that does not serve all scenes within the bounds or that is given
    together with photons, rays or orders, and noise that is negative or NaN. TypeError for arguments of
    another kind.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> truth, start = jl.Scene(ground=jl.Ground(height=0.5)), jl.Scene(ground=jl.Ground())
    >>> wave = jl.simulate(jl.Lidar(), truth, key=jax.random.key(0))
    >>> height = inversion.Unknown("ground.height", bounds=(-2.0, 2.0), name="height")
    >>> problem = inversion.Problem(wave, jl.Lidar(), start, [height], noise=0.001)
    >>> fit = inversion.retrieve(problem, key=jax.random.key(1))
    >>> bound = inversion.cramer_rao(problem, key=jax.random.key(1))
    >>> f"{float(fit.values['height']):.2f} m", f"{float(bound.stderr['height']):.3f} m"
    ('0.50 m', '0.005 m')
    """

    observed: Waveform | ArrayLike | Sequence | None
    lidar: Lidar | Sequence[Lidar]
    scene: Scene | Sequence[Scene]
    unknowns: Sequence[Unknown]
    noise: ArrayLike | Sequence
    time: ArrayLike | Sequence | None = eqx.field(default=None, kw_only=True)
    start: Mapping[str, ArrayLike | Sequence] | None = eqx.field(default=None, kw_only=True)
    scale: tuple[float, float] | None = eqx.field(default=None, kw_only=True)
    recorder: Recorder | Sequence[Recorder] | None = eqx.field(default=None, kw_only=True)
    noise_floor: float = eqx.field(default=1e-3, kw_only=True)
    plan: Plan | None = eqx.field(default=None, kw_only=True)
    n_photons: int | None = eqx.field(default=None, kw_only=True)
    n_rays: int | None = eqx.field(default=None, kw_only=True)
    max_orders: int | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self):
        if isinstance(self.observed, Sequence) and any(isinstance(a, Waveform) for a in self.observed):
            raise TypeError(
                "observed is a sequence of Waveforms; admissible for many records is an array (records, "
                "wavelengths, bins), such as numpy.stack([w.reflectance for w in waves]), with time="
            )
        arrays = (self.observed, self.noise, self.time, self.lidar, self.scene)
        if not any(isinstance(x, Tracer) for x in jax.tree.leaves(arrays)):
            self.bound  # noqa: B018

    @cached_property
    def bound(self) -> BoundProblem:
        """The problem as fits read it."""
        return _bind(self)

    @property
    def has_many_records(self) -> bool:
        """True if `observed` has a leading axis."""
        return not isinstance(self.observed, Waveform | None) and np.ndim(self.observed) == 3


def check_problem(problem: Problem, *, many: bool = False, recorded: bool = True) -> None:
    """Refuse what is no problem of one record, or of many. `recorded`: refuse one without a record as well.

    **Raises:** TypeError for what is no problem, ValueError for one of other records.
    """
    check_kind("problem", problem, Problem, "an inversion.Problem")
    # These are read by NumPy, and bounds decide what is fitted; starts may be traced.
    of_unknowns = [(u.bounds, u.prior) for u in problem.unknowns if isinstance(u, Unknown)]
    numbers = of_unknowns, problem.scale, problem.noise_floor
    if any(isinstance(x, Tracer) for x in jax.tree.leaves(numbers)):
        raise TypeError(
            "bounds, priors, scale and noise_floor of a problem are numbers, and JAX traces one of them; "
            "admissible is a Problem that is made within the transformed function, with traced observed, "
            "noise, time, lidar or scene"
        )
    if problem.observed is None and recorded:
        raise ValueError("problem has observed = None; admissible with it is cramer_rao alone")
    if many and not problem.has_many_records:
        raise ValueError("observed is one record; admissible here is (records, wavelengths, bins)")
    if problem.has_many_records and not many:
        raise ValueError("observed has many records; admissible here is one. retrieve_many fits many")


def _bind(problem: Problem) -> BoundProblem:
    """Check a problem and bind it.

    1. Sort out one object for all records from one for each.
    2. Bind the unknowns to scenes and lidars, and check the recorders.
    3. Read the records. What is quickly checked comes before the plan.
    4. Make the plan, or check it.
    """
    sizes = size_arguments(problem.n_photons, problem.n_rays, problem.max_orders, problem.plan)
    records: Any = [problem.observed]
    n_records = None
    if problem.has_many_records:
        records = as_numpy(problem.observed, "observed")
        n_records = len(records)
        if n_records == 0:
            raise ValueError(f"observed has the shape {records.shape}; admissible is one record or more")
    else:
        check_kinds(problem.lidar, problem.scene)
    # One for all is never repeated, so that arrays are neither stacked nor sent to workers more often than
    # needed.
    lidars = [with_fixed_window(a) for a in _one_or_each("lidar", problem.lidar, Lidar, n_records)]
    scenes: list[Scene] = _one_or_each("scene", problem.scene, Scene, n_records)
    recorders: list[Recorder | None] = [None]
    if problem.recorder is not None:
        recorders = _one_or_each("recorder", problem.recorder, Recorder, n_records)
    unknowns = [bind_unknowns(problem.unknowns, scene, lidars[0]) for scene in scenes]
    if any(unknown.setter.of_lidar for unknown in unknowns[0]):
        # They start from the lidar of each record.
        cases = range(max(len(lidars), len(scenes)))
        unknowns = [
            bind_unknowns(problem.unknowns, _of_record(scenes, i), _of_record(lidars, i)) for i in cases
        ]
    unknowns = _with_starts(unknowns, problem.start, n_records)
    scale = [] if problem.scale is None else [scale_unknown(problem.scale, unknowns[0])]
    check_names(recorders[0], unknowns[0])
    place = lidars[0], scenes[0], unknowns[0]
    if problem.observed is None:
        time = None if problem.time is None else as_sample_times(problem.time, lidars[0])
        plan = plan_without_record(problem.plan, *place, time, sizes)
        observed = [nothing_observed(plan, problem.noise, lidars[0])]
    else:
        noise = [problem.noise]
        if n_records is not None:
            noise = as_noise(problem.noise, np.shape(records))
        # Recorders of all records have the same unknowns.
        has_offset = recorders[0] is not None and recorders[0].offset is not None
        options: dict[str, Any] = {"noise_floor": problem.noise_floor, "has_offset": has_offset}
        observed = [
            as_observed(record, problem.time, noise[i], lidar=_of_record(lidars, i), **options)
            for i, record in enumerate(records)
        ]
        # One plan, and one compiled program, serve all.
        records_of_extremes = sorted({*_extremes(lidars), *_extremes(scenes)} - {0})
        others = [
            (_of_record(lidars, i), _of_record(scenes, i), _of_record(unknowns, i))
            for i in records_of_extremes
        ]
        plan = checked_plan(problem.plan, *place, observed[0].time, sizes, others)
    return BoundProblem(range(len(observed)), observed, lidars, scenes, unknowns, scale, recorders, plan)


def _extremes(objects: Sequence[Any]) -> set[int]:
    """Return the indices of lidars or scenes that have the least or the largest values of any array."""
    indices = set()
    for arrays in zip(*(jax.tree.leaves(a) for a in objects)):
        for extreme in (np.min, np.max):
            values = [float(extreme(np.asarray(a))) for a in arrays if np.size(a)]
            if values and min(values) < max(values):
                indices |= {int(np.argmin(values)), int(np.argmax(values))}
    return indices


def _with_starts(
    unknowns: list[list[BoundUnknown]], start: Mapping[str, Any] | None, n_records: int | None
) -> list[list[BoundUnknown]]:
    """Return the unknowns of every record with its starting values; a single list if all are the same.

    `n_records`: None for one record, whose starting values have no axis of records.
    """
    # Without starts of their own, records share their unknowns.
    if start is None or start == {}:
        return unknowns
    check_kind("start", start, Mapping, "a mapping from names of unknowns to values")
    shapes = {u.name: u.start.shape for u in unknowns[0]}
    starts = {}
    for name, values in start.items():
        if name not in shapes:
            raise ValueError(f"start has {name!r}; admissible are {', '.join(map(repr, shapes))}")
        starts[name] = as_numpy(values, f"start of {name!r}")
        shape = shapes[name] if n_records is None else (n_records, *shapes[name])
        if starts[name].shape != shape:
            raise ValueError(f"start of {name!r} has the shape {starts[name].shape}; admissible is {shape}")
        starts[name] = starts[name].reshape(-1, *shapes[name])
    return [
        [
            with_start(u, jnp.asarray(starts[u.name][i], u.start.dtype)) if u.name in starts else u
            for u in _of_record(unknowns, i)
        ]
        for i in range(n_records or 1)
    ]


def _one_or_each(field: str, argument: Any, kind: type, n_records: int | None) -> list[Any]:
    """Return a list of one object for all records, or of one for each. **Raises:** as `Problem`.

    `n_records`: None for one record, which has no sequences.
    """
    if isinstance(argument, kind):
        return [argument]
    if n_records is None:
        check_kind(field, argument, kind, f"a {kind.__name__}")
    check_kind(field, argument, Sequence, f"one {kind.__name__}, or a sequence of one for each record")
    objects = list(argument)
    if len(objects) != n_records:
        raise ValueError(
            f"{field} has {len(objects)} elements; admissible is one, or {n_records} as observed"
        )
    for i, x in enumerate(objects):
        check_kind(f"{field} {i}", x, kind, f"a {kind.__name__}")
    # One compiled program serves all: structures and shapes have to agree.
    structure, shapes = jax.tree.structure(objects[0]), jax.tree.map(jnp.shape, objects[0])
    for i, x in enumerate(objects):
        if jax.tree.structure(x) != structure or jax.tree.map(jnp.shape, x) != shapes:
            raise ValueError(f"{field} {i} differs from the first in more than the values of its arrays")
    return objects


def _of_record(objects: Sequence[Any], i: int) -> Any:
    """Return the object of record `i`, from one for all or one for each."""
    return objects[0] if len(objects) == 1 else objects[i]


def scale_unknown(bounds: Any, unknowns: Sequence[BoundUnknown]) -> BoundUnknown:
    """Return the unknown "scale" of an uncalibrated receiver. **Raises:** ValueError for bad bounds."""
    pair = bound_pair("scale", bounds, 0.0)
    # Results are keyed by name.
    if any(u.name == "scale" for u in unknowns):
        raise ValueError("name = 'scale' is taken by the scale; the unknown needs another one")
    # The first simulation gives it a better start (`RecorderModel.fit_linear`).
    return unknown_outside_scene("scale", pair)
