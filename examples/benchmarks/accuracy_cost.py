"""What accuracy costs: error against a converged reference, wall time and memory, knob by knob.

Run it as `python examples/benchmarks/accuracy_cost.py [--out figures] [--batches 64] [--photons 2048]`.

Errors are root mean squares over the samples of 1 ns above 1 % of the peak, relative, at 1064 nm, on four
scenes: sloping ground, a plate over ground, an L-system tree, and a dense stand of leaf area index 6. Times
are those of batches on all cores, warm. The error of n batches is measured on groups of n; what it would be
for a target is from the variance of the batches and the bias that remains, "~" where that lies beyond what
was run. The analog estimator is the paper's: photons that are counted where they leave within a cone of 10
degrees about the sensor's direction; how wrong the cone makes it is not counted against it.

Deterministic knobs (fine bins and their kernel, rays, steps, voxels, precision) are measured on the first
order, or on the ground, where no other error hides theirs, against the finest of their kind.
"""

import dataclasses
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import numpy as np
from _common import machine, options, plt, print_table, save_figure, write_json
from jaxlidar.planning.alternatives import with_alternatives

import jaxlidar as jl
from jaxlidar.spectral.pulse_convolution import pulse_convolution

LIDAR = jl.Lidar(wavelength=1064.0, divergence=5.0)
CONE = 10.0
# Settings that change the estimator, not the plan.
ALTERNATIVES = ("first_order", "points", "kernel", "ends")
TARGETS = (0.1, 0.01, 0.001)
LEAF = jl.LeafOptics(reflectance=0.45, transmittance=0.45)
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
POOL = ThreadPoolExecutor(os.cpu_count() or 1)


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene, the orders that it calls for, and the window that covers its return."""

    scene: jl.Scene
    orders: int
    window: tuple[float, float]

    def plan(self, **settings) -> jl.Plan:
        """By default all orders, and the other settings as `jaxlidar.plan` chooses them."""
        other = {name: settings.pop(name) for name in ALTERNATIVES if name in settings}
        usual = {"max_orders": self.orders, "window": self.window}
        return with_alternatives(jl.plan(LIDAR, self.scene, **(usual | settings)), **other)


def tree_scene(voxel_size: float) -> jl.Scene:
    """A broadleaf of 15 m, 250 m2 of leaves, over soil."""
    tree = jl.grow(jl.broadleaf(), seed=0)
    voxels = jl.voxelise(tree, voxel_size, leaf_area=250.0 / len(tree.bud_radius), wood="surface")
    canopy = jl.Canopy(voxels, leaf=LEAF, bark=jl.spectrum("bark-oak"))
    return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3))


def cases() -> dict[str, Case]:
    """The four scenes."""
    plate = jl.Plate(height=5.0, reflectance=0.45, transmittance=0.45, coverage=0.5, transmission="diffuse")
    voxels = jl.VoxelMap.from_lad(
        np.full((1, 1, 12), 0.5), voxel_size=(100.0, 100.0, 1.0), origin=(-50.0, -50.0, 2.0)
    )
    stand = jl.Canopy(voxels, leaf=LEAF, sides="periodic")
    ground = jl.Ground(reflectance=0.3)
    return {
        "ground": Case(jl.Scene(ground=jl.Ground(reflectance=0.3, slope=10.0)), 1, (-30.0, 30.0)),
        "plate over ground": Case(jl.Scene(plates=(plate,), ground=ground), 12, (-50.0, 60.0)),
        "tree": Case(tree_scene(0.25), 10, (-115.0, 40.0)),
        "dense stand": Case(jl.Scene(canopy=stand, ground=ground), 15, (-105.0, 60.0)),
    }


@dataclasses.dataclass(frozen=True)
class Run:
    """Waveforms of batches, seconds that each took, and bytes that one needs beside its arguments."""

    waves: np.ndarray
    seconds: float
    memory: int
    compiled_in: float

    @property
    def mean(self) -> np.ndarray:
        """Over batches."""
        return self.waves.mean(axis=0)


def run(case: Case, batches: int, plan: jl.Plan, seed: int = 0, x64: bool = False) -> Run:
    """Trace batches, after one to warm up; where nothing is random, one five times."""
    with jax.enable_x64(x64):
        scene = case.scene if not x64 else jax.tree.map(lambda a: a.astype(float), case.scene)

        def batch(scene, key):
            setup = jl.make_setup(LIDAR, scene, plan)
            return jl.total_reflectance(jl.trace_scene(setup, key), setup)[0]

        keys = [jax.random.key(seed + i) for i in range(batches if plan.is_random else 5)]
        begun = time.perf_counter()
        compiled = eqx.filter_jit(batch).lower(scene, keys[0]).compile()
        compiled_in = time.perf_counter() - begun
        jax.block_until_ready(compiled(scene, keys[0]))

        def one(key):
            # Settings of JAX belong to a thread.
            with jax.enable_x64(x64):
                return np.asarray(compiled(scene, key), float)

        begun = time.perf_counter()
        waves = np.stack(list((POOL.map if plan.is_random else map)(one, keys)))
        seconds = (time.perf_counter() - begun) / len(keys)
    memory = int(compiled.compiled.memory_analysis().temp_size_in_bytes)
    return Run(waves if plan.is_random else waves[:1], seconds, memory, compiled_in)


def run_analog(case: Case, photons: int, groups: int) -> Run:
    """Waveforms of groups of analog photons; a group counts as a batch."""
    plan = case.plan(bin_width=0.5)
    whole = dataclasses.replace(plan, bins=dataclasses.replace(plan.bins, kernel=0))
    kernel = np.asarray(pulse_convolution(LIDAR, whole).matrix(), float)
    edges = plan.bins.start + plan.bins.width * (np.arange(plan.bins.count + 1) - 0.5)

    def group(number):
        returns = jl.analog_returns(
            LIDAR, case.scene, plan, key=jax.random.key(number), n_photons=photons, cone=CONE
        )
        found, _ = np.histogram(returns.time, edges, weights=np.asarray(returns.weight[0], float))
        return found / photons @ kernel

    group(0)
    begun = time.perf_counter()
    waves = np.stack(list(POOL.map(group, range(1, groups + 1))))
    return Run(waves, (time.perf_counter() - begun) / groups, 0, 0.0)


def relative(wave: np.ndarray, reference: np.ndarray) -> float:
    """Root mean square of the relative difference over the samples above 1 % of the peak."""
    seen = reference > 0.01 * reference.max()
    return float(np.sqrt(np.mean((wave[..., seen] / reference[seen] - 1.0) ** 2)))


def spread(found: Run, reference: np.ndarray) -> float:
    """Relative standard deviation of one batch, as root mean square over samples."""
    seen = reference > 0.01 * reference.max()
    return float(np.sqrt(np.mean((found.waves[:, seen].std(axis=0, ddof=1) / reference[seen]) ** 2)))


def curve(found: Run, reference: np.ndarray) -> list[dict[str, float]]:
    """Seconds and error of 1, 2, 4 ... batches."""
    points, n = [], 1
    while n <= len(found.waves):
        groups = found.waves[: len(found.waves) // n * n].reshape(-1, n, found.waves.shape[-1]).mean(axis=1)
        points.append({"batches": n, "seconds": n * found.seconds, "error": relative(groups, reference)})
        n *= 2
    return points


def time_to(target: float, found: Run, reference: np.ndarray, bias: float) -> tuple[float | None, bool]:
    """Seconds to an error, and whether that is beyond what was run; None where bias is in the way."""
    if len(found.waves) == 1:
        return (found.seconds, False) if relative(found.mean, reference) <= target else (None, False)
    if bias >= target:
        return None, False
    needed = max(spread(found, reference) ** 2 / (target**2 - bias**2), 1.0)
    return needed * found.seconds, needed > len(found.waves)


def bias_of(found: Run, reference: Run) -> float:
    """What is left of the difference from the reference without the variance of both; 0 where that is all."""
    mean, seen = reference.mean, reference.mean > 0.01 * reference.mean.max()
    variance = sum(r.waves[:, seen].var(axis=0, ddof=1) / len(r.waves) for r in (found, reference))
    excess = np.mean(((found.mean - mean)[seen] ** 2 - variance) / mean[seen] ** 2)
    # Five standard errors of an excess that is noise alone: samples are correlated, and their tails long.
    noise = 5.0 * np.sqrt(2.0) * np.sqrt(np.mean((variance / mean[seen] ** 2) ** 2) / seen.sum() * 5.0)
    return float(np.sqrt(excess)) if excess > noise else 0.0


def order_of(knob: Sequence[float], error: Sequence[float], floor: float = 1e-6) -> float | str:
    """Slope of the logarithm of the error over that of the knob; in words why there is none.

    Errors below `floor` are what single precision leaves.
    """
    tell = np.asarray(error) > floor
    if not tell.any():
        return "within single precision"
    if tell.sum() == 1:
        return "one error alone is above single precision"
    return float(np.polyfit(np.log(np.asarray(knob)[tell]), np.log(np.asarray(error)[tell]), 1)[0])


def sweep(name, values, make, reference):
    """Run a knob through its values; `make(value)` gives case, plan and whether in double precision."""
    points = []
    for value in values:
        case, plan, double = make(value)
        # As many batches as tell the error from chance, where there is any.
        found = run(case, 8, plan, x64=double)
        points.append(
            {
                "value": value,
                "error": relative(found.waves, reference),
                "seconds": found.seconds,
                "memory": found.memory,
            }
        )
    slope = order_of([p["value"] for p in points], [p["error"] for p in points])
    print(
        f"{name}: "
        + ", ".join(f"{p['value']:g}: {p['error']:.1e} in {1e3 * p['seconds']:.3g} ms" for p in points)
    )
    return {"knob": name, "order": slope, "points": points}


def deterministic(all_cases: dict[str, Case]) -> dict[str, dict]:
    """Knobs of which the error can be seen by itself."""
    found = {}
    ground, stand, tree = (all_cases[n] for n in ("ground", "dense stand", "tree"))
    finest = run(ground, 1, ground.plan(bin_width=1 / 64), x64=True).mean
    for kernel in (1, 2, 3):
        found[f"fine bin (ns), kernel {kernel}"] = sweep(
            f"fine bin (ns), kernel of {kernel}",
            (1.0, 0.5, 0.25, 0.125),
            lambda v, k=kernel: (ground, ground.plan(bin_width=v, kernel=k), True),
            finest,
        )
    single = {"max_orders": 1, "footprint": "fixed"}
    far = run(tree, 1, tree.plan(**single, n_rays=131072)).mean
    for points in ("lattice", "independent"):
        found[f"rays, {points}"] = sweep(
            f"rays, {points}",
            (64, 256, 1024, 4096, 16384),
            lambda v, p=points: (tree, tree.plan(**single | {"points": p}, n_rays=v), False),
            far,
        )
    near = run(stand, 1, stand.plan(**single, n_rays=64, max_step=0.03), x64=True).mean
    found["step (m)"] = sweep(
        "step (m)",
        (10.0, 2.5, 0.6, 0.15),
        lambda v: (stand, stand.plan(**single, n_rays=64, max_step=v), False),
        near,
    )
    found["bits"] = sweep(
        "bits", (32, 64), lambda v: (stand, stand.plan(**single, n_rays=64, max_step=0.15), v == 64), near
    )
    voxels = {size: dataclasses.replace(tree, scene=tree_scene(size)) for size in (0.125, 0.25, 0.5, 1.0)}
    small = run(voxels[0.125], 1, voxels[0.125].plan(**single)).mean
    found["voxel (m)"] = sweep(
        "voxel (m)", (1.0, 0.5, 0.25), lambda v: (voxels[v], voxels[v].plan(**single), False), small
    )
    return found


def random_knobs(name: str, case: Case, batches: int, photons: int) -> dict:
    """Photons by themselves and in place of each default, orders, and the paper's estimator."""
    size = {"n_photons": photons, "n_rays": 1024}
    variants = {
        "default": {},
        "independent numbers": {"points": "independent"},
        "drawn first order": {"first_order": "drawn"},
        "one end a flight": {"ends": 1},
    }
    long = run(case, 8 * batches, case.plan(**size, bin_width=0.25), seed=10**6)
    reference = long.mean
    runs = {key: run(case, batches, case.plan(**size, **v)) for key, v in variants.items()}
    analog = run_analog(case, 16 * photons, batches)
    record = {
        "reference_error": spread(long, reference) / np.sqrt(len(long.waves)),
        "photons_per_batch": photons,
        "curves": {key: curve(r, reference) for key, r in runs.items()}
        | {"analog": curve(analog, reference)},
        "memory": {key: r.memory for key, r in runs.items()},
        "compiled_in": runs["default"].compiled_in,
    }
    for key, points in record["curves"].items():
        slope = order_of([p["seconds"] for p in points], [p["error"] for p in points])
        falls = slope if isinstance(slope, str) else f"slope {slope:.2f}"
        print(f"{name}, {key}: {points[-1]['error']:.2g} in {points[-1]['seconds']:.3g} s, {falls}")
    orders = []
    for n in (1, 2, 3, 4, 6, 8, 12):
        if n < case.orders:
            found = run(case, max(batches // 4, 2), case.plan(**size | {"max_orders": n}))
            error = relative(found.mean, reference)
            orders.append({"value": n, "error": error, "seconds": found.seconds, "memory": found.memory})
    record["orders"] = orders
    print(f"{name}, orders: " + ", ".join(f"{p['value']}: {p['error']:.1e}" for p in orders))
    bias = bias_of(runs["default"], long)
    record["bias"] = bias
    record["times"] = {
        "ours": [time_to(t, runs["default"], reference, bias) for t in TARGETS],
        "analog": [time_to(t, analog, reference, 0.0) for t in TARGETS],
    }
    return record


def ground_times(case: Case, photons: int) -> dict:
    """The ground is not random for us; the paper's estimator has no other way."""
    reference = run(case, 1, case.plan(bin_width=1 / 64), x64=True).mean
    ours, analog = run(case, 1, case.plan()), run_analog(case, 16 * photons, 32)
    points = [{"seconds": ours.seconds, "error": relative(ours.mean, reference)}]
    return {
        "curves": {"default": points, "analog": curve(analog, reference)},
        "times": {
            "ours": [time_to(t, ours, reference, 0.0) for t in TARGETS],
            "analog": [time_to(t, analog, reference, 0.0) for t in TARGETS],
        },
    }


def lines(ax, curves, x: str, y: str = "error", scales: str = "loglog", skip: int = 0) -> None:
    """One line for each of `curves`: pairs of label and points."""
    for colour, (label, points) in zip(COLOURS[skip:], curves):
        getattr(ax, scales)([p[x] for p in points], [p[y] for p in points], "o-", color=colour, label=label)


def draw(record: dict, path) -> None:
    """Work and precision on each scene, then the knobs."""
    plt.rcParams.update({"legend.fontsize": 7, "legend.frameon": False, "lines.markersize": 4})
    figure, axes = plt.subplots(3, 4, figsize=(12, 8.5), layout="constrained")
    for ax in axes.flat:
        ax.set_ylabel("relative error")
    for ax, (name, found) in zip(axes[0], record["scenes"].items()):
        analog = [("analog", found["curves"]["analog"])]
        lines(ax, analog, "seconds", skip=len(COLOURS) - 1)
        lines(ax, [c for c in found["curves"].items() if c[0] != "analog"], "seconds")
        ax.set(title=name, xlabel="seconds", xlim=(3e-5, 20.0), ylim=(5e-5, 1.0))
    axes[0, 1].legend(loc="lower left")
    orders = [(n, found["orders"]) for n, found in record["scenes"].items() if "orders" in found]
    lines(axes[1, 0], orders, "value", scales="semilogy")
    lines(axes[2, 0], orders, "value", "memory", scales="semilogy")
    axes[1, 0].set(xlabel="orders kept")
    axes[2, 0].set(xlabel="orders kept", ylabel="bytes of a batch")
    axes[2, 0].legend()
    knobs = {key: found["points"] for key, found in record["knobs"].items()}
    places = {
        "fine": axes[1, 1],
        "rays": axes[1, 2],
        "step": axes[1, 3],
        "voxel": axes[2, 1],
        "bits": axes[2, 2],
    }
    for start, ax in places.items():
        own = [(key.split(", ")[-1], points) for key, points in knobs.items() if key.startswith(start)]
        lines(ax, own, "value")
        ax.set(xlabel=next(k for k in knobs if k.startswith(start)).split(", ")[0])
        ax.set_xticks([p["value"] for p in own[0][1]], [f"{p['value']:g}" for p in own[0][1]])
        ax.minorticks_off()
        if len(own) > 1:
            ax.legend()
    axes[1, 3].set_ylim(1e-8, 1e-4)
    axes[2, 1].set_ylim(0.05, 1.0)
    some = ("rays, lattice", "step (m)", "voxel (m)", "fine bin (ns), kernel 3")
    lines(axes[2, 3], [(key, knobs[key]) for key in some], "seconds")
    axes[2, 3].set(xlabel="seconds", ylim=(1e-7, 1e3))
    axes[2, 3].legend(loc="upper left")
    save_figure(figure, path)


def main() -> None:
    given = options("What accuracy costs.", batches=64, photons=2048)
    all_cases = cases()
    record = {"machine": machine(), "targets": TARGETS, "scenes": {}, "knobs": deterministic(all_cases)}
    for name, case in all_cases.items():
        if case.orders == 1:
            record["scenes"][name] = ground_times(case, given.photons)
        else:
            record["scenes"][name] = random_knobs(name, case, given.batches, given.photons)
    write_json(given.out / "accuracy_cost.json", record)
    draw(record, given.out / "accuracy_cost.png")

    def cell(pair):
        return "not reached" if pair[0] is None else f"{'~' if pair[1] else ''}{pair[0]:.2g} s"

    rows = []
    for name, found in record["scenes"].items():
        for i, target in enumerate(TARGETS):
            ours, analog = found["times"]["ours"][i], found["times"]["analog"][i]
            ratio = analog[0] / ours[0] if ours[0] and analog[0] else float("nan")
            rows.append((name, f"{100 * target:g} %", cell(ours), cell(analog), ratio))
    print_table(("scene", "error", "ours", "analog", "ratio"), rows)
    print_table(("knob", "order of convergence"), [(k, v["order"]) for k, v in record["knobs"].items()])


if __name__ == "__main__":
    main()
