"""jaxlidar beside Mitsuba 3 with mitransient, and MCX-CL: seconds until a waveform is known to 1 %.

`pip install -e '.[bench]'` brings the peers where they run on a CPU. A missing peer is left out, with a
note. Each runs in a process of its own. mitransient needs an LLVM library (`DRJIT_LIBLLVM_PATH`, or the one
that the extra brings), pmcxcl an OpenCL runtime (see `_peer_mcx.py`).

The scene: 64^3 voxels of 10 m / 64; in a sphere of radius 3.5 m the extinction is 0.5 U(0, 2) 1/m, rounded to
1/200 1/m because MCX numbers its media; isotropic scattering with albedo 0.9; Lambertian ground of
reflectance 0.3. The laser lights a disc of 5 m from 1000 m; 200 samples of 1 ns; up to 15 scatterings. The
receiver is as wide as what is lit, as instruments have it: jaxlidar's field of view is round with a soft
edge, mitransient's camera sees a square of the same area. As their edges differ, agreement is tested where
the receiver sees everything. Compared are the returns of an instant pulse in samples of 1 ns, which the peers
compute, and those of a pulse of 6 ns; the convolution of the histograms of the peers (0.05 ns) is not timed.

The error of a sample is its standard deviation over repetitions divided by its mean; that of a waveform is
the root mean square over the samples above 1 % of the peak. Seconds to 1 % = seconds * (error / 0.01)^2. A
repetition has about 1 % of error. For jaxlidar it is `simulate(..., rtol=0.01)` with defaults except orders
and window, so that its seconds need no extrapolation. The first call, which compiles, is listed separately.
CPU seconds depend less on other load of the machine. Agreement is tested on sums of 5 ns (jaxlidar spreads an
instant over three fine bins) and on totals, in standard errors of the difference.

Features that only the peers have: Mitsuba takes any material, camera and emitter, polarisation, and images
(`examples/validation/mitransient_meshes.py` compares a scene of meshes); MCX has refraction, detectors in
contact and maps of fluence. Both are made for GPUs and are slower on a CPU. Limitations of the peers: MCX has
no Lambertian ground (so that only the crown alone is compared), no limit of orders and no return to a distant
receiver, which is computed here from its fluence; neither has the optics of all wavelengths from one trace,
standard errors, or a stop at a tolerance.

mitransient 1.3.1 leaves segments between null collisions out of path lengths. `_peer_mitransient.py` corrects
that; if it cannot, the record says so, and only totals can be compared. The case "camera" is the set-up that
a user of a renderer begins with, a spot and a camera that sees the square of 10 m x 10 m. MCX deposits light
when it leaves a voxel, by gates of 1 ns: compare its totals, as its samples are that coarse. The usual method
of MCX is to count photons that leave within a cone; the time of that is computed, not measured, for a half
angle of 10 degrees, from the rate of photons and the Poisson statistics of equal photons.
"""

import os

import jax
import numpy as np
from _common import new_figure, number, page_of, table
from _peer import repeated, run_peer
from simulation_cost import LIDAR, ORDERS, SIZE, WINDOW, N, scenes

import jaxlidar as jl

TITLE = "Other codes"
QUICK = {"repeats": 3, "rtol": 0.2, "work": 0.01, "cases": ("alone",)}
FINE, SAMPLES, LEVELS = 0.05, 200, 200
ALBEDO, SOIL = 0.9, 0.3
PULSES = {"instant": 0.0, "6 ns": 6.0}
# Sums of five samples, so that the ground's return lies in the middle of one.
FIRST_SAMPLE, BLOCK_SIZE = 3, 5
CONE = 10.0
# Rays and photons of one repetition, for about 1 % of error.
WORK = {"mitransient_samples": 2**19, "mcx_photons": 400_000}
CASES = {
    "camera": "crown over ground, narrow receiver",
    "ground": "crown over ground",
    "alone": "crown alone",
}
# Full angle in mrad of a round view from 1000 m, of the same area as the square of the camera.
FIELD_OF_VIEW = 2 * SIZE / np.sqrt(np.pi)


def crown_extinction() -> np.ndarray:
    """Return the extinction coefficients of the crown in 1/m."""
    k = np.asarray(scenes()["crown over ground"].canopy.voxels.leaf, dtype=float)
    return np.rint(k * LEVELS) / LEVELS


def worker_task(extinction: np.ndarray, repeats: int, work: float = 1.0) -> dict:
    """Return the arrays that a worker reads; `work` is a factor of the number of rays and photons."""
    return {
        **{"extinction": extinction, "albedo": ALBEDO, "reflectance": SOIL, "orders": ORDERS, "size": SIZE},
        **{"altitude": float(LIDAR.altitude), "radius": float(LIDAR.footprint_radius), "fine": FINE},
        **{"start": WINDOW[0] - 0.5, "count": round(SAMPLES / FINE), "repeats": repeats},
        **{name: round(work * amount) for name, amount in WORK.items()},
    }


def run_jaxlidar(
    extinction: np.ndarray, case: str, pulse: float, repeats: int, orders: int = ORDERS, rtol: float = 0.01
) -> dict:
    """Return waveforms and times of the crown of a case."""
    voxels = jl.VoxelMap.from_extinction(
        leaf=extinction, voxel_size=SIZE / N, origin=(-SIZE / 2, -SIZE / 2, 0.0)
    )
    canopy = jl.Canopy(voxels, leaf=jl.Isotropic(albedo=ALBEDO), hotspot=False)
    scene = jl.Scene(canopy=canopy, ground=None if case == "alone" else jl.Ground(reflectance=SOIL))
    receiver = {"field_of_view": FIELD_OF_VIEW} if case == "camera" else {}
    lidar = jl.Lidar(
        divergence=LIDAR.divergence, profile="top-hat", pulse=jl.GaussianPulse(pulse), **receiver
    )
    return repeat_jaxlidar(lidar, scene, repeats, orders, rtol)


def repeat_jaxlidar(lidar: jl.Lidar, scene: jl.Scene, repeats: int, orders: int, rtol: float = 0.01) -> dict:
    """Return waveforms and times of repetitions of `simulate`, and the time of the first call."""

    def simulate(seed: int) -> tuple[np.ndarray, jl.Waveform]:
        key = jax.random.key(seed)
        wave = jl.simulate(lidar, scene, key=key, rtol=rtol, max_orders=orders, window=WINDOW)
        return np.asarray(wave.reflectance[0], dtype=float), wave

    results, times, first = repeated(simulate, repeats)
    samples, waves = zip(*results)
    return {
        "waves": np.array(samples),
        "times": times,
        "first": first,
        "own_error": float(np.mean([wave.info["error"] for wave in waves])),
        "photons": float(np.mean([wave.info["photons"] for wave in waves])),
        "neglected": float(waves[-1].neglected[0]),
    }


def sampled(fine: np.ndarray, pulse: float) -> np.ndarray:
    """Convolve histograms of fine bins with a Gaussian pulse and sum them to samples of 1 ns."""
    if pulse > 0:
        sigma = pulse / np.sqrt(8 * np.log(2)) / FINE
        offsets = np.arange(-int(5 * sigma), int(5 * sigma) + 1)
        kernel = np.exp(-0.5 * (offsets / sigma) ** 2)
        fine = np.array([np.convolve(row, kernel / kernel.sum(), "same") for row in fine])
    return fine.reshape(len(fine), SAMPLES, -1).sum(axis=-1)


def cost_of(run: dict) -> dict[str, float]:
    """Return the error of one repetition, and the time to 1 %."""
    mean, deviation = run["waves"].mean(axis=0), run["waves"].std(axis=0, ddof=1)
    seen = mean > 0.01 * mean.max()
    error = float(np.sqrt(np.mean((deviation[seen] / mean[seen]) ** 2)))
    wall, cpu = np.median(run["times"], axis=0)
    to_goal = (error / 0.01) ** 2
    return {
        "error": error,
        "samples_seen": int(seen.sum()),
        "seconds": float(wall),
        "cpu_seconds": float(cpu),
        "seconds_to_1_percent": float(wall * to_goal),
        "cpu_seconds_to_1_percent": float(cpu * to_goal),
        "first_call_seconds": float(run["first"]),
        "total": float(run["waves"].sum(axis=1).mean()),
        **{k: run[k] for k in ("own_error", "photons", "neglected") if k in run},
    }


def seconds_if_counted(run: dict, photons: int) -> float:
    """Return the seconds to 1 % by counting photons that leave within a cone, at the rate of `run`."""
    mean = run["waves"].mean(axis=0)
    # The fraction sin^2(half angle) of Lambertian light leaves within the cone.
    share = np.sin(np.deg2rad(CONE)) ** 2 * mean[mean > 0.01 * mean.max()]
    return float(np.mean(1 / share) / 0.01**2 * np.median(run["times"][:, 0]) / photons)


def block_sums(waves: np.ndarray) -> np.ndarray:
    """Return sums of 5 ns of waveforms, from sample number `FIRST_SAMPLE` on."""
    last = FIRST_SAMPLE + (SAMPLES - FIRST_SAMPLE) // BLOCK_SIZE * BLOCK_SIZE
    return waves[:, FIRST_SAMPLE:last].reshape(len(waves), -1, BLOCK_SIZE).sum(axis=-1)


def agreement(a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    """Return differences in standard errors: totals; root mean square and largest of the sums of 5 ns."""

    def z(x, y):
        error = np.sqrt(x.var(axis=0, ddof=1) / len(x) + y.var(axis=0, ddof=1) / len(y))
        return (x.mean(axis=0) - y.mean(axis=0)) / np.maximum(error, 1e-30)

    sums = [block_sums(w) for w in (a, b)]
    bright = sums[0].mean(axis=0) > 0.01 * sums[0].mean(axis=0).max()
    by_block = z(sums[0][:, bright], sums[1][:, bright])
    relative = sums[1][:, bright].mean(axis=0) / sums[0][:, bright].mean(axis=0) - 1
    freedom = len(a) + len(b) - 2
    return {
        "total_z": float(z(a.sum(axis=1), b.sum(axis=1))),
        "total_relative": float(b.sum(axis=1).mean() / a.sum(axis=1).mean() - 1),
        "rms_z": float(np.sqrt(np.mean(by_block**2))),
        "largest_z": float(np.abs(by_block).max()),
        "rms_relative": float(np.sqrt(np.mean(relative**2))),
        "blocks": int(bright.sum()),
        # Student's distribution, as standard errors are estimated from few repetitions.
        "rms_z_expected": float(np.sqrt(freedom / (freedom - 2))),
    }


def measured_by_all(repeats: int, rtol: float, work: float, cases: tuple[str, ...]) -> tuple[dict, ...]:
    """Return runs by case and pulse and by code, notes on the peers, and the load before each."""
    extinction = crown_extinction()
    load = {"jaxlidar": os.getloadavg()[0]}
    runs = {
        (case, pulse): {"jaxlidar": run_jaxlidar(extinction, case, fwhm, repeats, rtol=rtol)}
        for case in cases
        for pulse, fwhm in PULSES.items()
    }
    task = {**worker_task(extinction, repeats, work), "cases": cases}
    notes: dict[str, str] = {}
    for name, worker in (("mitransient", "_peer_mitransient.py"), ("MCX-CL", "_peer_mcx.py")):
        load[name] = os.getloadavg()[0]
        measurements = run_peer(worker, task)
        if isinstance(measurements, str):
            notes[name] = f"left out: {measurements}"
            continue
        notes[name] = str(measurements["version"])
        if not measurements.get("corrected", True):
            notes[name] += ", path lengths not corrected: only totals are comparable"
        for (case, pulse), run in runs.items():
            if f"{case}_waves" in measurements:
                waves = sampled(measurements[f"{case}_waves"], PULSES[pulse])
                times, first = measurements[f"{case}_times"], float(measurements[f"{case}_first"])
                run[name] = {"waves": waves, "times": times, "first": first}
    return runs, notes, load


def measure(
    repeats: int = 8, rtol: float = 0.01, work: float = 1.0, cases: tuple[str, ...] = tuple(CASES)
) -> dict:
    """Return the costs of all codes; `rtol` is that of jaxlidar, `work` a factor of that of the peers."""
    if repeats < 3:
        raise SystemExit(f"repeats={repeats} is below 3: no standard deviation to speak of")
    runs, notes, load = measured_by_all(repeats, rtol, work, cases)
    results = []
    for (case, pulse), run in runs.items():
        ours = cost_of(run["jaxlidar"])
        for name, code_run in run.items():
            cost = cost_of(code_run)
            if name != "jaxlidar":
                cost["ratio"] = cost["seconds_to_1_percent"] / ours["seconds_to_1_percent"]
                cost["cpu_ratio"] = cost["cpu_seconds_to_1_percent"] / ours["cpu_seconds_to_1_percent"]
            if name != "jaxlidar" and case != "camera":
                cost["agreement"] = agreement(run["jaxlidar"]["waves"], code_run["waves"])
            if name == "MCX-CL":
                counted = seconds_if_counted(code_run, round(work * WORK["mcx_photons"]))
                cost["seconds_if_counted_computed"] = counted
                notes["counted"] = notes.get("counted", "MCX-CL counting photons, computed s to 1 %") + (
                    f"; {pulse} {counted:.3g}"
                )
            results.append({"case": CASES[case], "pulse": pulse, "code": name, **cost})
    return {"load_before": load, "notes": notes, "work": WORK, "results": results, "drawn": runs}


def draw(record: dict):
    """Draw waveforms with bands of two standard deviations of one repetition, and the time to 1 %."""
    figure, grid = new_figure(2, (11, 7.5), rows=2)
    axes, runs = grid.flat, record["drawn"]
    names = list(dict.fromkeys(r["code"] for r in record["results"]))
    colour = {name: f"C{i}" for i, name in enumerate(names)}
    style = dict(zip(names, ("-", "--", "-.", ":")))
    at = WINDOW[0] + np.arange(SAMPLES)
    for ax, case in zip(axes, dict.fromkeys(case for case, _ in runs)):
        for name, run in runs[case, "6 ns"].items():
            mean, deviation = run["waves"].mean(axis=0), run["waves"].std(axis=0, ddof=1)
            ax.plot(at, mean, style[name], color=colour[name], lw=1.5, label=name)
            low = np.maximum(mean - 2 * deviation, 1e-9)
            ax.fill_between(at, low, mean + 2 * deviation, color=colour[name], alpha=0.3, lw=0)
        ax.set(
            yscale="log", ylim=(1e-6, 0.1), xlim=(-75, 105), xlabel="time (ns)", title=f"{CASES[case]}, 6 ns"
        )
        ax.legend()
    for ax in (axes[0], axes[2]):
        ax.set_ylabel("apparent reflectance per ns")
    keys = {(CASES[case], pulse): n for n, (case, pulse) in enumerate(runs)}
    for name in names:
        code_results = [r for r in record["results"] if r["code"] == name]
        y = [keys[r["case"], r["pulse"]] for r in code_results]
        for marker, quantity, label in (("o", "seconds", name), ("x", "cpu_seconds", None)):
            values = [r[f"{quantity}_to_1_percent"] for r in code_results]
            axes[3].semilogx(values, y, marker, color=colour[name], label=label)
    axes[3].set_yticks(list(keys.values()), [", ".join(key) for key in keys], fontsize=8)
    axes[3].invert_yaxis()
    axes[3].set(xlabel="seconds to 1 %: wall (o), CPU (x)", title="what 1 % costs")
    return figure


def section(record: dict) -> str:
    columns = {
        "scene, pulse": lambda r: f"{r['case']}, {r['pulse']}",
        "code": "code",
        "s to 1 %": "seconds_to_1_percent",
        "CPU s to 1 %": "cpu_seconds_to_1_percent",
        "times jaxlidar": lambda r: r.get("ratio"),
        "s, first call": "first_call_seconds",
        "total": lambda r: number(r["total"], 4),
    }
    return page_of(
        "Seconds to a waveform with an error of 1 %, for jaxlidar and codes that compute the same: a crown "
        "of 64³ voxels with 15 scatterings, seen by a receiver as wide as the illuminated area, or by one "
        "that sees everything. The other codes have features that jaxlidar lacks (any material and camera, "
        "polarisation); they do not serve all wavelengths by one trace, and do not stop at a tolerance. A "
        "scene of triangles is compared in the same way on the "
        "[page of validation](../validation/README.md#mitransient-meshes).",
        table(record["results"], columns),
    )
