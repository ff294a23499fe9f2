"""Cost of accuracy: error against a converged reference, wall time and memory, by each setting.

Errors are root mean squares over the samples of 1 ns above 1 % of the peak, relative, at 1064 nm, on four
scenes: sloping ground, a plate over ground, an L-system tree, and a dense stand of leaf area index 6. Times
are those of batches on all cores, warm. The error of n batches is measured on groups of n. The time to a
target error follows from the variance of the batches and the remaining bias; "~" marks extrapolation beyond
the batches that were run. The analog estimator of the paper counts photons that leave within a cone of 10
degrees about the direction of the sensor; the bias by the width of the cone is not counted.

Deterministic settings (fine bins and their kernel, rays, steps, voxels, precision) are measured on the first
order or on the ground, where no other error hides theirs, against the finest value.
"""

import dataclasses
import os
import runpy
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
from _common import COLOURS, new_figure, number, page_of, plt, table

import jaxlidar as jl

TITLE = "Cost of accuracy"
QUICK = {"batches": 4, "photons": 16, "n_scenes": 2}
# The estimator of the paper.
ANALOG = runpy.run_path(str(Path(__file__).resolve().parents[1] / "paper" / "_analog.py"))
LIDAR = jl.Lidar(wavelength=1064.0, divergence=5.0)
CONE = 10.0
TARGETS = (0.1, 0.01, 0.001)
LEAF = jl.LeafOptics(reflectance=0.45, transmittance=0.45)
POOL = ThreadPoolExecutor(os.cpu_count() or 1)


@dataclasses.dataclass(frozen=True)
class AccuracyCase:
    """A scene, its number of orders, and the window that covers its return."""

    scene: jl.Scene
    orders: int
    window: tuple[float, float]

    def plan(self, **settings) -> jl.Plan:
        """Return a plan, by default with all orders and otherwise as `jaxlidar.plan` chooses."""
        defaults = {"max_orders": self.orders, "window": self.window}
        return jl.plan(LIDAR, self.scene, **(defaults | settings))


def tree_scene(voxel_size: float) -> jl.Scene:
    """Return a broadleaf tree of 15 m with 250 m2 of leaves over soil."""
    tree = jl.grow(jl.broadleaf(), seed=0)
    voxels = jl.voxelise(tree, voxel_size, leaf_area=250.0 / len(tree.bud_radius), wood="surface")
    canopy = jl.Canopy(voxels, leaf=LEAF, bark=jl.spectrum("bark-oak"), hotspot=False)
    return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3))


def cases() -> dict[str, AccuracyCase]:
    """Return the four scenes."""
    plate = jl.Plate(height=5.0, reflectance=0.45, transmittance=0.45, coverage=0.5, transmission="diffuse")
    voxels = jl.VoxelMap.from_lad(
        np.full((1, 1, 12), 0.5), voxel_size=(100.0, 100.0, 1.0), origin=(-50.0, -50.0, 2.0)
    )
    stand = jl.Canopy(voxels, leaf=LEAF, sides="periodic", hotspot=False)
    ground = jl.Ground(reflectance=0.3)
    return {
        "ground": AccuracyCase(jl.Scene(ground=jl.Ground(reflectance=0.3, slope=10.0)), 1, (-30.0, 30.0)),
        "plate over ground": AccuracyCase(jl.Scene(plates=(plate,), ground=ground), 12, (-50.0, 60.0)),
        "tree": AccuracyCase(tree_scene(0.25), 10, (-115.0, 40.0)),
        "dense stand": AccuracyCase(jl.Scene(canopy=stand, ground=ground), 15, (-105.0, 60.0)),
    }


@dataclasses.dataclass(frozen=True)
class BatchRun:
    """Waveforms of batches; seconds, bytes besides arguments, and seconds of compilation of one batch."""

    waves: np.ndarray
    seconds: float
    memory: int
    compiled_in: float

    @property
    def mean(self) -> np.ndarray:
        """Mean waveform of the batches."""
        return self.waves.mean(axis=0)


def run_batches(
    case: AccuracyCase, batches: int, plan: jl.Plan, seed: int = 0, x64: bool = False
) -> BatchRun:
    """Trace batches after one for warming up; if nothing is random, the same batch five times."""
    with jax.enable_x64(x64):
        scene = case.scene if not x64 else jax.tree.map(lambda a: a.astype(float), case.scene)

        def batch(scene, key):
            setup = jl.make_setup(LIDAR, scene, plan)
            return jl.total_reflectance(jl.trace_scene(setup, key), setup)[0]

        keys = [jax.random.key(seed + i) for i in range(batches if plan.is_random else 5)]
        start = time.perf_counter()
        compiled = eqx.filter_jit(batch).lower(scene, keys[0]).compile()
        compiled_in = time.perf_counter() - start
        jax.block_until_ready(compiled(scene, keys[0]))

        def traced(key):
            # Settings of JAX are local to a thread.
            with jax.enable_x64(x64):
                return np.asarray(compiled(scene, key), float)

        start = time.perf_counter()
        waves = np.stack(list((POOL.map if plan.is_random else map)(traced, keys)))
        seconds = (time.perf_counter() - start) / len(keys)
    memory = int(compiled.compiled.memory_analysis().temp_size_in_bytes)
    return BatchRun(waves if plan.is_random else waves[:1], seconds, memory, compiled_in)


def run_analog(case: AccuracyCase, photons: int, groups: int) -> BatchRun:
    """Return waveforms of groups of analog photons; a group counts as a batch."""
    plan = case.plan(bin_width=0.5)
    edges = plan.bins.start + plan.bins.width * (np.arange(plan.bins.count + 1) - 0.5)
    # The fraction of a return in the middle of each fine bin that each sample receives.
    samples = plan.sample_start + plan.sample_interval * np.arange(plan.n_samples)
    offset = samples[None, :] - 0.5 * (edges[1:] + edges[:-1])[:, None]
    half = 0.5 * plan.sample_interval
    upper, lower = (np.asarray(LIDAR.pulse.cumulative(offset + s, 0.0), float) for s in (half, -half))
    kernel = upper - lower

    def group(number):
        returns = ANALOG["analog_returns"](
            LIDAR, case.scene, plan, key=jax.random.key(number), n_photons=photons, cone=CONE
        )
        counts, _ = np.histogram(returns.time, edges, weights=np.asarray(returns.weight[0], float))
        return counts / photons @ kernel

    group(0)
    start = time.perf_counter()
    waves = np.stack(list(POOL.map(group, range(1, groups + 1))))
    return BatchRun(waves, (time.perf_counter() - start) / groups, 0, 0.0)


def relative(wave: np.ndarray, reference: np.ndarray) -> float:
    """Return the root mean square of relative differences over the samples above 1 % of the peak."""
    bright = reference > 0.01 * reference.max()
    return float(np.sqrt(np.mean((wave[..., bright] / reference[bright] - 1.0) ** 2)))


def batch_spread(batches: BatchRun, reference: np.ndarray) -> float:
    """Return the relative standard deviation of one batch, root mean square over samples."""
    bright = reference > 0.01 * reference.max()
    return float(np.sqrt(np.mean((batches.waves[:, bright].std(axis=0, ddof=1) / reference[bright]) ** 2)))


def error_curve(batches: BatchRun, reference: np.ndarray) -> list[dict[str, float]]:
    """Return seconds and error of 1, 2, 4 ... batches."""
    points, n = [], 1
    while n <= len(batches.waves):
        groups = (
            batches.waves[: len(batches.waves) // n * n].reshape(-1, n, batches.waves.shape[-1]).mean(axis=1)
        )
        points.append({"batches": n, "seconds": n * batches.seconds, "error": relative(groups, reference)})
        n *= 2
    return points


def time_to(
    target: float, batches: BatchRun, reference: np.ndarray, bias: float
) -> tuple[float | None, bool]:
    """Return the seconds to an error (None if the bias is larger), and True if they are extrapolated."""
    if len(batches.waves) == 1:
        return (batches.seconds, False) if relative(batches.mean, reference) <= target else (None, False)
    if bias >= target:
        return None, False
    n_batches = max(batch_spread(batches, reference) ** 2 / (target**2 - bias**2), 1.0)
    return n_batches * batches.seconds, n_batches > len(batches.waves)


def bias_of(batches: BatchRun, reference: BatchRun) -> float:
    """Return the root mean square bias, the difference beyond the variance of both, or 0."""
    mean, bright = reference.mean, reference.mean > 0.01 * reference.mean.max()
    variance = sum(r.waves[:, bright].var(axis=0, ddof=1) / len(r.waves) for r in (batches, reference))
    excess = np.mean(((batches.mean - mean)[bright] ** 2 - variance) / mean[bright] ** 2)
    # Five standard errors of an excess by noise alone: samples are correlated and have long tails.
    noise = 5.0 * np.sqrt(2.0) * np.sqrt(np.mean((variance / mean[bright] ** 2) ** 2) / bright.sum() * 5.0)
    return float(np.sqrt(excess)) if excess > noise else 0.0


def convergence_order(knob: Sequence[float], error: Sequence[float], floor: float = 1e-6) -> float | str:
    """Return the exponent of the error as a power of the setting, or the reason for the lack of one.

    Errors below `floor` are due to single precision.
    """
    above_floor = np.asarray(error) > floor
    if not above_floor.any():
        return "within single precision"
    if above_floor.sum() == 1:
        return "one error alone is above single precision"
    return float(
        np.polyfit(np.log(np.asarray(knob)[above_floor]), np.log(np.asarray(error)[above_floor]), 1)[0]
    )


def sweep(values: Sequence[float], settings_of: Callable, reference: np.ndarray) -> dict:
    """Run a setting through its values; `settings_of(value)` returns case, plan and, for doubles, True."""
    points = []
    for value in values:
        case, plan, x64 = settings_of(value)
        # Eight batches average out the noise of random cases.
        batches = run_batches(case, 8, plan, x64=x64)
        cost = {"seconds": batches.seconds, "memory": batches.memory}
        points.append({"value": value, "error": relative(batches.waves, reference), **cost})
    return {
        "order": convergence_order([p["value"] for p in points], [p["error"] for p in points]),
        "points": points,
    }


def deterministic(all_cases: dict[str, AccuracyCase]) -> dict[str, dict]:
    """Return the errors of settings that are not random, each by itself."""
    ground, stand, tree = (all_cases[n] for n in ("ground", "dense stand", "tree"))
    voxels = {size: dataclasses.replace(tree, scene=tree_scene(size)) for size in (0.125, 0.25, 0.5, 1.0)}
    single = {"max_orders": 1, "footprint": "fixed"}
    steps = {**single, "n_rays": 64}

    def finest(case: AccuracyCase, x64: bool = False, **settings) -> np.ndarray:
        return run_batches(case, 1, case.plan(**settings), x64=x64).mean

    finest_steps = finest(stand, x64=True, **steps, max_step=0.03)
    return {
        "fine bin (ns)": sweep(
            (1.0, 0.5, 0.25, 0.125),
            lambda v: (ground, ground.plan(bin_width=v), True),
            finest(ground, x64=True, bin_width=1 / 64),
        ),
        "rays": sweep(
            (64, 256, 1024, 4096, 16384),
            lambda v: (tree, tree.plan(**single, n_rays=v), False),
            finest(tree, **single, n_rays=131072),
        ),
        "step (m)": sweep(
            (10.0, 2.5, 0.6, 0.15), lambda v: (stand, stand.plan(**steps, max_step=v), False), finest_steps
        ),
        "bits": sweep((32, 64), lambda v: (stand, stand.plan(**steps, max_step=0.15), v == 64), finest_steps),
        "voxel (m)": sweep(
            (1.0, 0.5, 0.25),
            lambda v: (voxels[v], voxels[v].plan(**single), False),
            finest(voxels[0.125], **single),
        ),
    }


def random_knobs(case: AccuracyCase, analog: BatchRun, photons: int) -> dict:
    """Return errors and times of the default, one deposit a flight, fewer orders and analog photons."""
    batches = len(analog.waves)
    size = {"n_photons": 8 * photons, "n_rays": 1024}
    plan = case.plan(**size)
    plans = {"default": plan, "one deposit a flight": plan.with_config(deposits_per_flight=1)}
    long = run_batches(case, 8 * batches, case.plan(**size, bin_width=0.25), seed=10**6)
    reference = long.mean
    runs = {key: run_batches(case, batches, variant) for key, variant in plans.items()}
    record = {
        "reference_error": batch_spread(long, reference) / np.sqrt(len(long.waves)),
        "photons_per_batch": photons,
        "curves": {key: error_curve(r, reference) for key, r in runs.items()}
        | {"analog": error_curve(analog, reference)},
        "memory": {key: r.memory for key, r in runs.items()},
        "compiled_in": runs["default"].compiled_in,
    }
    orders = []
    for n in (1, 2, 3, 4, 6, 8, 12):
        if n < case.orders:
            fewer = run_batches(case, max(batches // 4, 2), case.plan(**size | {"max_orders": n}))
            error = relative(fewer.mean, reference)
            orders.append({"value": n, "error": error, "seconds": fewer.seconds, "memory": fewer.memory})
    record["orders"] = orders
    bias = bias_of(runs["default"], long)
    record["bias"] = bias
    record["times"] = {
        "ours": [time_to(t, runs["default"], reference, bias) for t in TARGETS],
        "analog": [time_to(t, analog, reference, 0.0) for t in TARGETS],
    }
    return record


def ground_times(case: AccuracyCase, analog: BatchRun) -> dict:
    """Return errors and times of the ground, which is random for the analog estimator alone."""
    reference = run_batches(case, 1, case.plan(bin_width=1 / 64), x64=True).mean
    ours = run_batches(case, 1, case.plan())
    points = [{"seconds": ours.seconds, "error": relative(ours.mean, reference)}]
    return {
        "curves": {"default": points, "analog": error_curve(analog, reference)},
        "times": {
            "ours": [time_to(t, ours, reference, 0.0) for t in TARGETS],
            "analog": [time_to(t, analog, reference, 0.0) for t in TARGETS],
        },
    }


def plot_curves(ax, curves, x: str, y: str = "error", scales: str = "loglog", skip: int = 0) -> None:
    """Draw one line for each of `curves`, pairs of label and points."""
    for colour, (label, points) in zip(COLOURS[skip:], curves):
        getattr(ax, scales)([p[x] for p in points], [p[y] for p in points], "o-", color=colour, label=label)


def measure(batches: int = 64, photons: int = 2048, n_scenes: int = 4) -> dict:
    """Return errors and times of the first scenes, and of settings that are not random."""
    all_cases = cases()
    # First: after programs in double precision, those of the analog estimator do not run.
    analog = {
        name: run_analog(case, 16 * photons, 32 if case.orders == 1 else batches)
        for name, case in list(all_cases.items())[:n_scenes]
    }
    scenes = {}
    for name, groups in analog.items():
        case = all_cases[name]
        is_ground = case.orders == 1
        scenes[name] = ground_times(case, groups) if is_ground else random_knobs(case, groups, photons)
    return {"targets": TARGETS, "scenes": scenes, "knobs": deterministic(all_cases)}


@plt.rc_context({"legend.fontsize": 7, "legend.frameon": False, "lines.markersize": 4})
def draw(record: dict):
    """Draw error over time on each scene, then the settings."""
    figure, axes = new_figure(4, (12, 8.5), 3)
    for ax in axes.flat:
        ax.set_ylabel("relative error")
    for ax, (name, results) in zip(axes[0], record["scenes"].items()):
        analog = [("analog", results["curves"]["analog"])]
        plot_curves(ax, analog, "seconds", skip=len(COLOURS) - 1)
        plot_curves(ax, [c for c in results["curves"].items() if c[0] != "analog"], "seconds")
        ax.set(title=name, xlabel="seconds", xlim=(3e-5, 20.0), ylim=(5e-5, 1.0))
    axes[0, 1].legend(loc="lower left")
    orders = [(n, results["orders"]) for n, results in record["scenes"].items() if "orders" in results]
    plot_curves(axes[1, 0], orders, "value", scales="semilogy")
    plot_curves(axes[2, 0], orders, "value", "memory", scales="semilogy")
    axes[1, 0].set(xlabel="orders kept")
    axes[2, 0].set(xlabel="orders kept", ylabel="bytes of a batch")
    axes[2, 0].legend()
    knobs = {key: results["points"] for key, results in record["knobs"].items()}
    panels = {
        "fine bin (ns)": axes[1, 1],
        "rays": axes[1, 2],
        "step (m)": axes[1, 3],
        "voxel (m)": axes[2, 1],
        "bits": axes[2, 2],
    }
    for key, ax in panels.items():
        plot_curves(ax, [(key, knobs[key])], "value")
        ax.set(xlabel=key)
        ax.set_xticks([p["value"] for p in knobs[key]], [f"{p['value']:g}" for p in knobs[key]])
        ax.minorticks_off()
    axes[1, 3].set_ylim(1e-8, 1e-4)
    axes[2, 1].set_ylim(0.05, 1.0)
    chosen = ("rays", "step (m)", "voxel (m)", "fine bin (ns)")
    plot_curves(axes[2, 3], [(key, knobs[key]) for key in chosen], "seconds")
    axes[2, 3].set(xlabel="seconds", ylim=(1e-7, 1e3))
    axes[2, 3].legend(loc="upper left")
    return figure


def section(record: dict) -> str:
    def time_to_target(number_of_target: int):
        def cell(name: str) -> str:
            elapsed, is_extrapolated = record["scenes"][name]["times"]["ours"][number_of_target]
            return (
                "not reached" if elapsed is None else f"{'~' if is_extrapolated else ''}{number(elapsed)} s"
            )

        return cell

    def times_longer(name: str) -> str:
        times = record["scenes"][name]["times"]
        ratios = [a / o for (a, _), (o, _) in zip(times["analog"], times["ours"]) if a and o]
        return ", ".join(map(number, ratios)) + " times longer"

    scenes = {
        "scene": str,
        **{f"{100 * target:g} %": time_to_target(n) for n, target in enumerate(record["targets"])},
        "the estimator of the paper takes": times_longer,
    }
    knobs = {"setting": str, "error falls as the power": lambda name: record["knobs"][name]["order"]}
    return page_of(
        "Seconds to a target error (root mean square over samples above 1 % of the peak, relative, at 1064 "
        "nm), and how much longer the estimator of the paper takes, target by target.",
        table(record["scenes"], scenes),
        "Effect of each setting: errors of the first order against the finest value of the setting.",
        table(record["knobs"], knobs),
    )
