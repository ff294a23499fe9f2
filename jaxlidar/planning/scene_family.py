"""One plan for a family of scenes: many scenes of one structure, such as random ones, or those within bounds.

A compiled simulation has loops of fixed length and a fixed time axis, which have to be long enough for every
scene. Both are monotonic in quantities such as heights, sizes and slopes, so that scenes at the extremes of
these decide. All scenes of a stack that have an extreme value of any array are examined, and two that
combine the smallest and the largest values of all geometric arrays.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlidar._fields.checks import check_kind
from jaxlidar.planning.effects import effects_of_family
from jaxlidar.planning.memory import MAX_APPLIED_WAVELENGTHS, transformed_bytes
from jaxlidar.planning.path_lengths import PathLengths
from jaxlidar.planning.plan import Plan, plan
from jaxlidar.planning.record_times import SampleTimes, band_of_long_record, first_sample_in_bins
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.scenes.scene import Scene, check_kinds
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.survey import Survey


def _union_plan(cases: Sequence[tuple[Lidar, Scene]], plans: Sequence[Plan], survey: Survey | None) -> Plan:
    """Return the first plan with fine time bins and loops that are long enough for the cases of all plans.

    The plans share the width of their bins, the number of orders and the samples. Scatterer channels are
    those of the first. With a `survey` the plans are those of all its shots.

    **Arguments:** `cases`: the lidar and the scene of each plan.
    """
    first = plans[0]
    # All plans share the bin width, so that the union of their bins is a whole number of bins.
    start = min(p.bins.start for p in plans)
    end = max(p.bins.start + p.bins.width * p.bins.count for p in plans)
    bins = dataclasses.replace(
        first.bins,
        start=start,
        count=size_bucket(round((end - start) / first.bins.width), 4),
        max_span=max(p.bins.max_span for p in plans),
    )
    start_distance = max(p.limits.start_distance for p in plans)
    max_path = max(p.limits.max_path for p in plans)
    path_lengths = [PathLengths(lidar, scene, survey) for lidar, scene in cases]
    supports = [p.pulse_support for p in plans]
    # Rays start above the scene: the distance down to it is part of the path.
    longest = max_path + start_distance
    united = first.with_limits(
        start_distance=start_distance,
        max_path=max_path,
        max_flight=max(p.longest_flight(longest) for p in path_lengths),
        # Numbers of segments and spans of bins are bounds for the longest chord of all scenes.
        max_segment=max(p.limits.max_segment for p in plans),
    ).with_config(
        vertical=all(p.config.vertical for p in plans),
        max_ray_segments=max(p.config.max_ray_segments for p in plans),
        # A bucket of sizes, so that simulations of similar scenes share a compiled program.
        max_faces=size_bucket(max(p.max_faces(longest) for p in path_lengths)),
        # A sheet that lets light through in any scene must be able to.
        covers_fully=tuple(all(c) for c in zip(*(p.config.covers_fully for p in plans))),
    )
    pulse_support = (min(low for low, _ in supports), max(high for _, high in supports))
    scope = dataclasses.replace(united.scope, pulse_feature=min(p.scope.pulse_feature for p in plans))
    samples = SampleTimes(first.sample_start, first.sample_interval, first.n_samples, first.bins_per_sample)
    return dataclasses.replace(
        united,
        bins=bins,
        first_sample=first_sample_in_bins(samples.start, bins),
        pulse_support=pulse_support,
        pulse_band=band_of_long_record(pulse_support, samples, bins),
        scope=scope,
    )


def plan_scenes(
    lidar: Lidar,
    scenes: Scene | Sequence[Scene],
    *,
    window: tuple[float, float] | None = None,
    max_orders: int | None = None,
    effects: Mapping[str, bool] | None = None,
    **options: Any,
) -> Plan:
    """Make one plan that serves all scenes of a family: scenes of one structure with other values.

    Give the scenes at the bounds of the family, or a stack of all of them. Light that a scene returns outside
    of the fine bins of the plan is in `lost` of its waveform, which is 1 where the plan covers no such scene.

    **Arguments:**

    - `lidar`: a `Lidar`.
    - `scenes`: a sequence of `Scene`, each of which the plan serves; or a stack, one `Scene` whose arrays
      have a leading axis of scenes: of these, the scenes with extreme values are examined, and two that
      combine the smallest and the largest values of heights, sizes, slopes and extinctions.
    - `window`: (first, last) sample time, ns. Default None: covers what `plan` chooses for each scene.
    - `max_orders`: follow light for this many scatterings. Default None: as many as any of the scenes needs.
    - `effects`, `options`: further arguments of `plan`. Its `histories` are False by default where a scene
      then takes less memory, as there is a response for each scene.

    **Returns:** a `Plan`.

    **Raises:** ValueError for scenes of different structure, for arrays that are no stack, for a combination
    of extreme values that is inadmissible, and as `plan` does. TypeError for arguments of another kind.

    **Example:**

    >>> import jaxlidar as jl
    >>> low, high = (jl.Scene(ground=jl.Ground(height=z)) for z in (-20.0, 5.0))
    >>> plan = jl.plan_scenes(jl.Lidar(), [low, high])
    >>> wide = jl.plan(jl.Lidar(), low).n_samples < plan.n_samples
    >>> print(wide)
    True
    """
    if isinstance(scenes, Scene):
        examined = _extreme_scenes(scenes)
    else:
        examined = check_scenes(scenes, "a Scene whose arrays are stacked, or a sequence of Scene")
    for scene in examined:
        check_kinds(lidar, scene)
    effects = {**effects_of_family(examined), **({} if effects is None else effects)}
    _check_one_structure(examined)
    cases, options = [(lidar, scene) for scene in examined], {"max_orders": max_orders, **options}
    if options.get("histories") is None and _applied_optics_take_less(
        *cases[0], window=window, effects=effects, **options
    ):
        options["histories"] = False
    try:
        return plan_cases(cases, window=window, effects=effects, **options)
    except ValueError as error:
        raise ValueError(f"a scene at the extremes of the family is inadmissible: {error}") from error


def _applied_optics_take_less(lidar: Lidar, scene: Scene, **options: Any) -> bool:
    """Return True if a scene takes less memory with optics that are applied while light is traced."""

    def size(histories: bool | None) -> float:
        p = plan(lidar, scene, **{**options, "histories": histories, "describe": False})
        return transformed_bytes(p.config, p.bins, degree=p.degree, n_traces=p.n_traces)

    return lidar.wavelength.size <= MAX_APPLIED_WAVELENGTHS and size(False) < size(None)


def plan_cases(
    cases: Sequence[tuple[Lidar, Scene]],
    *,
    window: tuple[float, float] | None,
    max_orders: int | None,
    effects: Mapping[str, bool],
    survey: Survey | None = None,
    **options: Any,
) -> Plan:
    """Make one plan that serves pairs of a lidar and a scene, each as it is.

    Lidars have one sampling interval, and scenes one structure; other arguments are those of `plan_scenes`.
    With a `survey` the plan serves all of its shots over each scene.

    1. Plan every case by itself.
    2. Plan every case with the common window, orders, width of fine bins and length of steps.
    3. Take the union of these.
    """
    common: dict[str, Any] = {**options, "effects": effects, "describe": False}

    def plan_case(lidar: Lidar, scene: Scene, settings: Mapping[str, Any]) -> Plan:
        return plan(lidar if survey is None else survey, scene, **settings)

    trials = [plan_case(*case, {**common, "window": window, "max_orders": max_orders}) for case in cases]
    # A channel of a transmittance that is zero is harmless; one that is missing is not.
    first = max(range(len(trials)), key=lambda i: len(trials[i].config.channels))
    order = [first, *(i for i in range(len(trials)) if i != first)]
    cases, trials = [cases[i] for i in order], [trials[i] for i in order]
    settings = [_common_settings(p, window) for p in trials]
    if window is None:
        starts, ends = zip(*(s["window"] for s in settings))
        window = (min(starts), max(ends))
    common |= {
        "window": window,
        "max_orders": max(s["max_orders"] for s in settings),
        "histories": all(s["histories"] for s in settings),
        "bin_width": min(s["bin_width"] for s in settings),
    }
    steps = [s["max_step"] for s in settings if "max_step" in s]
    if steps:
        common["max_step"] = max(steps)
    # What was planned with the common settings already serves as it is.
    plans = [
        trial if own.items() <= common.items() else plan_case(*case, common)
        for case, trial, own in zip(cases, trials, settings)
    ]
    united = _union_plan(cases, plans, survey)
    scope = dataclasses.replace(
        united.scope,
        first_return=min(p.scope.first_return for p in trials),
        last_return=max(p.scope.last_return for p in trials),
        albedo=max(p.scope.albedo for p in trials),
        automatic_orders=max_orders is None and trials[0].scope.automatic_orders,
        automatic_window=trials[0].scope.automatic_window,
    )
    return dataclasses.replace(united, scope=scope)


def _common_settings(trial: Plan, window: tuple[float, float] | None) -> dict[str, Any]:
    """Return what the plans of a family have in common, as arguments that `plan` made of its own."""
    # A thousandth of a sample keeps the last one in a window whose end is rounded.
    end = trial.sample_start + (trial.n_samples - 1 + 1e-3) * trial.sample_interval
    settings = {
        "window": (trial.sample_start, end) if window is None else window,
        "max_orders": trial.orders,
        "histories": trial.config.keeps_histories,
        "bin_width": trial.bins.width,
    }
    if trial.config.leaf is not None or trial.config.bark is not None:
        settings["max_step"] = trial.limits.max_segment
    return settings


def check_scenes(scenes: Any, expected: str) -> list[Scene]:
    """Return a sequence of scenes as a list.

    **Raises:** TypeError for another kind of argument, which names what is `expected`; ValueError for none.
    """
    check_kind("scenes", scenes, Sequence, expected)
    if len(scenes) == 0:
        raise ValueError("scenes is empty; admissible is one scene or more")
    for i, scene in enumerate(scenes):
        check_kind(f"scenes[{i}]", scene, Scene, "a Scene")
    return list(scenes)


def _check_one_structure(scenes: Sequence[Scene]) -> None:
    for i, scene in enumerate(scenes):
        if jax.tree.structure(scene) != jax.tree.structure(scenes[0]):
            raise ValueError(
                f"scenes[{i}] and scenes[0] differ in their structure; admissible is one structure"
            )


def stack_size(scenes: Scene) -> int:
    """Return the number of scenes in a stack.

    **Raises:** ValueError for arrays without a common leading axis.
    """
    paths = jax.tree_util.tree_leaves_with_path(scenes)
    sizes = {}
    for path, leaf in paths:
        shape = np.shape(leaf)
        sizes[jax.tree_util.keystr(path).lstrip(".")] = shape[0] if shape else None
    if not sizes:
        raise ValueError("scenes has no arrays; admissible is a stack of scenes with a leading axis")
    number = next(iter(sizes.values()))
    for name, size in sizes.items():
        if size is None or size != number or size == 0:
            lengths = "no leading axis" if size is None else f"a leading axis of {size}"
            raise ValueError(
                f"{name} of scenes has {lengths}, where others have {number}; admissible is a stack: each "
                "array has a leading axis of as many scenes"
            )
    return int(number)  # pyright: ignore[reportArgumentType]


def scene_of_stack(scenes: Scene, index: int) -> Scene:
    """Return one scene of a stack."""
    return jax.tree.map(lambda a: a[index], scenes)


def _acts_by_optics(path: tuple[Any, ...]) -> bool:
    """Return True for arrays of leaf and bark optics, reflectances and the atmosphere."""
    names = [getattr(entry, "name", None) for entry in path]
    is_material = names[:2] in (["canopy", "leaf"], ["canopy", "bark"])
    return is_material or names[:1] == ["atmosphere"] or bool({"reflectance", "transmittance"} & set(names))


def _extreme_scenes(stack: Scene) -> list[Scene]:
    """Return the scenes of a stack that have extreme values, and two that combine those of all geometry."""
    number = stack_size(stack)
    leaves, structure = jax.tree_util.tree_flatten_with_path(stack)
    indices, extremes = {0}, ([], [])
    for path, leaf in leaves:
        rows = np.asarray(leaf)
        flat = rows.reshape(number, -1)
        if flat.shape[1]:
            indices |= {int(np.argmin(flat.min(axis=1))), int(np.argmax(flat.max(axis=1)))}
        # Extremes of optics need not go together: a leaf cannot reflect and transmit all light.
        varies = np.issubdtype(rows.dtype, np.floating) and not _acts_by_optics(path)
        for values, extreme in zip(extremes, (np.min, np.max)):
            values.append(jnp.asarray(extreme(rows, axis=0) if varies else rows[0]))
    combined = [jax.tree.unflatten(structure, values) for values in extremes]
    return [scene_of_stack(stack, i) for i in sorted(indices)] + combined
