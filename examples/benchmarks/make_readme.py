"""Write README.md of this folder from the records in `results/`: no number in it is typed by hand.

Run it as `python examples/benchmarks/make_readme.py` after a benchmark, run with `--out
examples/benchmarks/results`, has renewed its record.
"""

import json
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path

from _writing import number, page_of, table

from jaxlidar.io import atomic_write

FOLDER = Path(__file__).resolve().parent
RESULTS = FOLDER / "results"

HEAD = """# Benchmarks: cost of accuracy, and comparisons with other codes

Each script measures one thing and writes a record (JSON) and a figure; its first lines explain the
comparison. This page is made from the records in `results/` by `make_readme.py`.

```sh
pip install -e '.[bench]'
python examples/benchmarks/accuracy_cost.py --out examples/benchmarks/results
python examples/benchmarks/make_readme.py
```

Times are seconds of wall time, warm: programs are compiled before. A tilde marks extrapolated times.
"""


def machine(record: dict) -> str:
    """Return a sentence on the machine of a record, or on the machines of a record of several."""
    if "machine" not in record:
        return " ".join(machine(part) for part in record.values())
    m = record["machine"]
    text = f"Measured on {m['cores']} cores ({m['processor']}), Python {m['python']}, jax {m['jax']}."
    if "system share" in m:
        text += f" The operating system took {m['system share']:.0%} of {m['CPU seconds']:.0f} CPU seconds."
    return text


def accuracy(record: dict) -> str:
    def cell(pair: Sequence) -> str:
        return "not reached" if pair[0] is None else f"{'~' if pair[1] else ''}{number(pair[0])} s"

    rows = []
    for name, results in record["scenes"].items():
        ours, analog = results["times"]["ours"], results["times"]["analog"]
        ratios = [number(a[0] / o[0]) for a, o in zip(analog, ours) if a[0] and o[0]]
        rows.append([name, *map(cell, ours), ", ".join(ratios) + " times longer"])
    targets = [f"{100 * t:g} %" for t in record["targets"]]
    orders = [
        [key, v["order"] if isinstance(v["order"], str) else number(v["order"])]
        for key, v in record["knobs"].items()
    ]
    return page_of(
        "Seconds to a target error (root mean square over samples above 1 % of the peak, relative, at 1064 "
        "nm), and how much longer the estimator of the paper takes, target by target.",
        table(["scene", *targets, "the estimator of the paper takes"], rows),
        "Effect of each setting: errors of the first order against the finest value of the setting.",
        table(["setting", "error falls as the power"], orders),
    )


def changes(record: dict) -> str:
    rows = [
        [r["change"], number(r["seconds"]), number(r["warm"]), ", ".join(f"`{c}`" for c in r["compiled"])]
        for r in record["changes"]
    ]
    return page_of(
        "Seconds of a call of `simulate` with three wavelengths after one change, and of the same call "
        "repeated; of two scenes the slower one. Array sizes are rounded up to size buckets, and numbers are "
        "arguments of compiled programs: the trace (`batch_of_trace_first`, `batch_of_trace_higher`) is "
        "compiled anew where a size changes its bucket, as that of a record whose pulse, window or beam "
        "changes may, and where an effect is new.",
        table(["change", "s", "s, repeated", "programs compiled"], rows),
    )


def peers(record: dict) -> str:
    rows = [
        [
            f"{r['case']}, {r['pulse']}",
            r["code"],
            number(r["seconds_to_1_percent"]),
            number(r["cpu_seconds_to_1_percent"]),
            number(r.get("ratio")),
            number(r["first_call_seconds"]),
            number(r["total"], 4),
        ]
        for r in record["results"]
    ]
    head = ["scene, pulse", "code", "s to 1 %", "CPU s to 1 %", "times jaxlidar", "s, first call", "total"]
    return page_of(
        "Seconds to a waveform with an error of 1 %, for jaxlidar and codes that compute the same: a crown "
        "of 64³ voxels with 15 scatterings, seen by a receiver as wide as the illuminated area, or by one "
        "that sees everything. The other codes have features that jaxlidar lacks (any material and camera, "
        "polarisation); they do not serve all wavelengths by one trace, and do not stop at a tolerance. A "
        "scene of triangles is compared in the same way on the "
        "[page of validation](../validation/README.md#mitransient-meshes).",
        table(head, rows),
    )


def peers_gradient(record: dict) -> str:
    rows = [
        [
            r["code"],
            number(r["seconds"]),
            number(100 * r["error"]),
            number(r["seconds_to_10_percent"]),
            number(r["cpu_seconds_to_10_percent"]),
            number(r.get("cpu_ratio")),
            number(r["cpu_times_one_simulation"]),
            number(r["first_call_seconds"]),
        ]
        for r in record["results"]
    ]
    peers = [r for r in record["results"] if "z" in r]
    difference = max((abs(v) for r in peers for v in r["relative_difference"].values()), default=0.0)
    z = max((abs(v) for r in peers for v in r["z"].values()), default=0.0)
    load = max(record["machine"]["load_before"].values())
    head = ["code", "s", "error %", "s to 10 %", "CPU s to 10 %", "times jaxlidar, CPU"]
    return page_of(
        "The gradient of all light that a crown of 64³ voxels returns, by the extinction of each, beside "
        "Mitsuba's path replay without time (`prbvolpath`). The error is that of single voxels, of which "
        f"each has few paths; sums over voxels differ by at most {number(100 * difference)} %, "
        f"{number(z)} standard errors. Voxels around the crown are empty: for their derivatives jaxlidar "
        f"traces photons once more. Other programs ran at the same time (load {number(load)}): compare "
        "seconds of the CPU.",
        table([*head, "CPU, times one simulation", "s, first call"], rows),
    )


def simulation(record: dict) -> str:
    rows = [
        [
            r["scene"],
            number(r["rtol"]),
            number(r["seconds"]),
            number(r["seconds_with_compilation"]),
            f"{r['photons']:,}",
            number(r["error"]),
        ]
        for r in record["simulations"]
    ]
    return table(["scene", "rtol", "s", "s, first call", "photons", "error reached"], rows)


def pythons(record: dict) -> str:
    *older, newest = record["versions"]
    name = "Python {python}, jax {jax}".format
    head = ["", f"{name(**newest)}: s", *(f"{name(**v)}: s, and times as long" for v in older)]
    rows = [
        [
            what,
            number(seconds),
            *(f"{number(v['seconds'][what])}, {number(v['ratio'][what])} times" for v in older),
        ]
        for what, seconds in newest["seconds"].items()
    ]
    return page_of(
        "The same work on several versions of Python, each with its newest JAX.", table(head, rows)
    )


def scaling(record: dict) -> str:
    rows = [[f"{r['n']:,} photons", number(r["seconds"]), f"{r['bytes']:,.0f}"] for r in record["photons"]]
    rows += [[f"{r['side']}³ voxels", number(r["seconds"]), f"{r['bytes']:,.0f}"] for r in record["voxels"]]
    photons, voxels = (
        number(record[f"slope of seconds over {n}"]) for n in ("photons", "voxels along a side")
    )
    return page_of(
        table(["one batch of", "s", "bytes beside the scene"], rows),
        f"Time grows with the photons to the power {photons}, with the voxels along a side to the power "
        f"{voxels}.",
    )


def effects(record: dict) -> str:
    rows = [
        [r["scene"], number(r["seconds"]["plan"]), number(r["seconds"]["everything"]), number(r["ratio"])]
        for r in record["scenes"]
    ]
    return page_of(
        f"To {record['percent']} %: the plan of the scene, and a plan with everything on (empty voxels, all "
        "orders, air, field of view, jitter ...).",
        table(["scene", "plan of the scene, s", "everything on, s", "times longer"], rows),
    )


def march(record: dict) -> str:
    ratio = record["jaxlidar_over_numba"]
    rows = [[name, number(1e-6 * rate)] for name, rate in record["rays_per_second"].items()]
    return page_of(
        table(["first order", "million rays a second"], rows),
        f"The rate of jaxlidar is {number(ratio['all cores'])} times that of a parallel numba kernel for the "
        f"same traversal on all cores, and {number(ratio['one thread'])} times on one.",
    )


def wavelengths(record: dict) -> str:
    times = record["times_one_wavelength"]
    rows = [[f"{int(n):,}", number(record["seconds"][n]), number(times[n], 3)] for n in times]
    return page_of(f"{record['photons']:,} photons.", table(["wavelengths", "s", "times one"], rows))


def jacobian(record: dict) -> str:
    rows = [[n, number(record["seconds"][n]), number(r)] for n, r in record["times_one_simulation"].items()]
    return page_of(f"{record['photons']:,} photons.", table(["columns", "s", "simulations"], rows))


def gradients(record: dict) -> str:
    rows = [
        [
            f"{c['side']}³",
            str(c["orders"]),
            number(c["seconds"]["gradient"]),
            number(c["ratio"]),
            number(c["ratio_half_empty"]),
            number(c["ratio_as_called"]),
            number(c["MB"]),
            number(c["MB_four_times_the_photons"]),
            number(c["compilation"]["gradient"]),
            number(c["compilation"]["gradient"] / c["compilation"]["simulation"]),
        ]
        for c in record["cases"]
    ]
    head = [
        "voxels",
        "orders",
        "CPU s",
        "simulations",
        "half the voxels empty",
        "calls of `simulate`",
        "MB",
        "MB, four times the photons",
        "compilation, s",
        "times that of a simulation",
    ]
    return page_of(
        "The gradient of a function of the waveform with respect to the leaf area density of every voxel, "
        f"with its value, by `jax.grad` of `simulate(..., plan=)`: {record['photons']:,} photons, "
        f"{record['rays']:,} rays. Times are compared with a compiled simulation of the same photons, and "
        "with `simulate` as it is called outside of a transformation. Where voxels are empty, photons are "
        "traced once more for what leaves there would scatter. Memory is that of temporaries.",
        table(head, rows),
    )


def fits(record: dict) -> str:
    rows = [
        [
            case,
            *(number(statistics.median(r["seconds"][who])) for who in ("ours", "scipy")),
            number(r["ratio"]),
            str(sum(abs(gap) < 0.5 for gap in r["chi2_ours_minus_scipy"])),
            ", ".join(number(-gap) for gap in sorted(r["chi2_ours_minus_scipy"]) if abs(gap) >= 0.5),
        ]
        for case, r in record["fits"].items()
    ]
    return page_of(
        f"Both use the same simulation of {record['photons']:,} photons; medians of {record['targets']} "
        'targets. "Same" counts the fits that end at the same chi-squared, to 0.5; "excess" lists by how '
        "much the chi-squared of scipy is larger in each of the others.",
        table(["unknowns", "retrieve, s", "scipy, s", "times faster", "same", "excess"], rows),
    )


def coverage(record: dict) -> str:
    rows = [
        [
            name,
            number(r["rms"]),
            number(r["rms_over_bound"], 3),
            f"{100 * r['covered']:.1f} %",
            number(r["noise_free_median"]),
        ]
        for name, r in record["unknowns"].items()
    ]
    head = ["unknown", "rms error", "over the Cramer-Rao bound", "within 95 % intervals", "noise-free"]
    return page_of(
        f"{record['targets']} noisy targets (three wavelengths, noise of 2 % of the peak) from random "
        f"starts, {record['photons']:,} photons a batch: {100 * record['converged']:.0f} % of the fits "
        f"converge, and {100 * record['covered']:.1f} % of the truths lie within the 95 % intervals. The "
        "last column is the median error without noise, relative.",
        table(head, rows),
    )


def prospect(record: dict) -> str:
    seconds_per_leaf = record["seconds_per_leaf"]
    kinds = ("prosail", "spectra", "jacobian")
    rows = [
        [kind, number(1e6 * min(t for n, t in seconds_per_leaf.items() if n.startswith(kind)))]
        for kind in kinds
    ]
    return page_of(
        table(["2,101 wavelengths", "us a leaf"], rows),
        f"{number(record['times_faster_than_prosail'])} times faster than looping prosail; all derivatives "
        f"cost {number(record['jacobian_over_evaluation'])} evaluations.",
    )


def leaves(record: dict) -> str:
    rows = [
        [who, number(1e3 * record["seconds_per_leaf"][who]), *(number(v, 3) for v in rmse.values())]
        for who, rmse in record["rmse"].items()
    ]
    head = ["", "ms a leaf", *(f"rms error of {name}" for name in record["rmse"]["scipy"])]
    covered = [
        [
            leaves,
            domain,
            *(
                f"{number(error, 3)}, {number(100 * errors['within two standard errors'][name])} %"
                for name, error in errors["rmse"].items()
            ),
        ]
        for leaves, domains in record["domains"].items()
        for domain, errors in domains.items()
    ]
    return page_of(
        f"{record['leaves']} measured leaves, all bands.",
        table(head, rows),
        f"{number(record['times_faster'])} times faster than scipy over prosail.",
        "Root mean square errors and fractions of leaves within two standard errors, by the bands that the "
        "fit uses. Leaves made by PROSPECT have noise and a smooth error of the model.",
        table(["leaves", "domain", *record["rmse"]["scipy"]], covered),
    )


def surveys(record: dict) -> str:
    strategies, side = record["ways"], record["side"]
    faster = (
        strategies["footprints, simulate"]["ms per shot"] / strategies["footprints, shared"]["ms per shot"]
    )
    faster_scan = strategies["scan, simulate"]["ms per shot"] / strategies["scan, apart"]["ms per shot"]
    largest = record["by side"][-1]
    hectares, rough = largest["side"] ** 2 / 1e4, f"{number(100 * record['rough'])} %"
    hours = 100 * largest["seconds"] / hectares * record["machine"]["cores"] / 3600
    return page_of(
        f"Trees of {side} m x {side} m at voxels of 1 m over rolling terrain. Footprints of 25 m from "
        "orbit, all orders, by three strategies: shared illumination (`shared`); shot by shot in one "
        "program (`apart`); one call of `simulate` for each. The same with a field of view as wide as the "
        "footprints, and off nadir. Shots of a scanner, 0.3 m wide, at first order. The tolerance is that "
        "of every single shot.",
        table(
            ("strategy", "shots", "tolerance", "ms a shot", "error, median"),
            [
                (
                    name,
                    number(r["shots"], 4),
                    f"{number(100 * r['tolerance'])} %",
                    number(r["ms per shot"]),
                    f"{number(100 * r['error, median'])} %",
                )
                for name, r in strategies.items()
            ],
        ),
        f"Shared illumination is {number(faster)} times faster than single calls, one program for a scan "
        f"{number(faster_scan)} times. One process with all of these took at most "
        f"{number(record['peak GB'])} GB.",
        f"The number of footprints over the same trees, to {rough}, hardly changes the cost:",
        table(
            ("footprints", "s", "ms each"),
            [
                (number(r["shots"], 5), number(r["seconds"]), number(r["ms per shot"]))
                for r in record["by shots"]
            ],
        ),
        f"Larger areas with the same number of footprints per hectare, to {rough}:",
        table(
            ("ha", "footprints", "s"),
            [
                (number(r["side"] ** 2 / 1e4), number(r["shots"], 5), number(r["seconds"]))
                for r in record["by side"]
            ],
        ),
        f"Extrapolated, as tiles are independent: a square kilometre to {rough} takes {number(hours)} core "
        f"hours, and a country of 100,000 km2 {number(hours * 1e5 / 24 / 1e4)} days of 10,000 cores. "
        "Waveforms are written as they are computed; of a map, with 4 bytes a voxel, only the tiles in "
        "work (`SceneParts`) need to fit into memory.",
    )


def profiles(record: dict) -> str:
    total, batch, scattered = record["all"], record["batch"], record["scattered"]

    def percent(x: float) -> str:
        return f"{100 * x:.0f} %"

    rows = [
        [
            f"{c['slope']:g}°",
            f"{c['ratio']:g}",
            number(c["fit"]),
            number(c["closed"]),
            number(c["closed_true_ratio"]),
            percent(c["better"]),
            percent(c["better_than_true_ratio"]),
            percent(c["covered"]),
            number(c["resolution"]),
        ]
        for c in record["cells"]
    ]
    return page_of(
        f"Profiles of {record['layers']} layers of {record['thickness']:g} m from simulated GEDI-like "
        "waveforms, by fits with a smoothness prior and by the closed-form gap inversion of level 2B, "
        "which is given the true height of the ground and the ends of the signal. Errors are root mean "
        f"squares over layers in m2/m3, medians over {record['stands']} stands.",
        table(
            (
                "slope",
                "peak over noise",
                "fit",
                "closed form",
                "closed form, true ratio",
                "fit is better",
                "better than with the true ratio",
                "within 95 % band",
                "resolution, m",
            ),
            rows,
        ),
        f"Of all {total['profiles']} profiles, the fit is better in {percent(total['better'])}, in the median"
        f" by a factor of {number(total['factor'])}; in {percent(total['better_than_true_ratio'])} by "
        f"{number(total['factor_true_ratio'])} if the closed form is given the true ratio of reflectances. "
        f"Total plant area is off by {number(total['area_error'])} (closed form "
        f"{number(total['area_error_closed'])}); {percent(total['converged'])} of the fits converged, after "
        f"{number(total['steps'])} simulations, on slopes in {number(total['seconds'])} s each.",
        f"With {record['orders']} scatterings in the simulated records, which neither method models, the "
        f"fit is better in {percent(scattered['better'])} of {scattered['profiles']} profiles (errors "
        f"{number(scattered['fit'])} and {number(scattered['closed'])} m2/m3), but its band holds the truth "
        f"in only {percent(scattered['covered'])} of the layers; {percent(scattered['converged'])} "
        "converged.",
        f"On level ground, {batch['profiles']} profiles in one batch take {number(batch['seconds'])} s, "
        f"{number(batch['per_profile'])} s each.",
    )


def meshes(record: dict) -> str:
    rows = [
        [
            name,
            f"{record['triangles'][name]:,}",
            number(elapsed),
            number(record["times_voxels_alone"][name]),
            number(record["seconds_first_call"][name]),
            number(1e-6 * record["memory_bytes"][name]),
        ]
        for name, elapsed in record["seconds"].items()
    ]
    return page_of(
        f"Seconds of `simulate` with {record['photons']:,} photons and {record['orders']} orders: a crown "
        "of 32³ voxels over the ground, and trunks of triangles beside and within it. A copy of a mesh costs "
        "its transformation alone.",
        table(["scene", "triangles", "s", "times voxels alone", "s, first call", "MB, predicted"], rows),
    )


def mesh_or_voxels(record: dict) -> str:
    def chosen(leaves: str, kind: str, edge: float, orders: str, diameter: float) -> list[dict]:
        keys = {"leaves": leaves, "kind": kind, "edge": edge, "orders": orders, "diameter": diameter}
        return [row for row in record["rows"] if all(row[key] == value for key, value in keys.items())]

    def mean(values: list[float]) -> float:
        return statistics.fmean(values)

    def waveform_difference(rows: list[dict]) -> str:
        rms, noise = (100 * mean([row[name] for row in rows]) for name in ("rms", "rms of noise"))
        return f"{rms:.1f}" if rms > noise else f"< {noise:.1f}"

    def difference(rows: list[dict], measure: str, relative: bool = False) -> str:
        """Return the mean difference over footprints with its standard error, in percent if relative."""
        reference = mean([row["reference"][measure] for row in rows])
        if reference == 0.0:
            return ""
        factor = 100.0 / reference if relative else 1.0
        value = factor * mean([row["differences"][measure] for row in rows])
        error = abs(factor) * sum(row["errors"][measure] ** 2 for row in rows) ** 0.5 / len(rows)
        digits = 1 if relative else 3
        return f"{value:+.{digits}f} ± {error:.{digits}f}"

    scenes = [s for s in record["scenes"] if s["kind"] != "triangles"]
    names = {id(s): f"{s['edge']:g} m, {s['kind']}" if s["edge"] else s["kind"] for s in scenes}
    diameters = sorted({row["diameter"] for row in record["rows"]})
    narrow = diameters[0]
    columns = [(diameter, orders) for diameter in diameters for orders in ("first order", "all orders")]
    percents = ("total", "leaf", "wood", "ground")
    waves, measures = [], []
    for scene in scenes:
        key = scene["leaves"], scene["kind"], scene["edge"]
        cells = [waveform_difference(chosen(*key, orders, diameter)) for diameter, orders in columns]
        noise = mean([row["rms of noise"] for row in chosen(*key, "all orders", narrow)])
        waves.append([scene["leaves"], names[id(scene)], *cells, f"{100 * noise:.1f}"])
        rows = chosen(*key, "all orders", narrow)
        relative = [difference(rows, m, relative=True) for m in percents]
        heights = [difference(rows, m) for m in ("RH50", "RH98")]
        measures.append([scene["leaves"], names[id(scene)], *relative, *heights])
    size = {(s["leaves"], s["kind"], s["edge"]): s for s in record["scenes"]}
    triangles = size["leaf-on", "triangles", 0.0]
    finest = size["leaf-on", "by area", min(s["edge"] for s in scenes if s["edge"])]
    shots = record["runs"] * len({(row["diameter"], tuple(row["place"])) for row in record["rows"]})
    return page_of(
        f"The paper's tree over ground at 1064 nm, as {triangles['size']:,} triangles and as voxels, seen by "
        f"footprints of {' and '.join(f'{d:g}' for d in diameters)} m with a pulse of 6 ns, "
        f"{record['orders']} orders.",
        '"By area": `voxelise(tree, edge, leaf_area=, wood="surface")` has the leaf area of the triangles '
        'and attenuates by a quarter of the surface of wood. "By volume": the default of `voxelise`, the '
        "paper's probability map, has the fractions of voxels that clumps and wood fill; its leaf area "
        'follows from the edge. "Other leaves": triangles whose leaves have other random places within the '
        "same clumps, which is as near as a map can come.",
        "Leaf optics, wood, ground and lidar are the same. In voxels, too, light of the first order returns "
        "through the gap by which it came (`hotspot=True`, the default; the paper has none). Light of higher "
        "orders meets the gaps among triangles again, but in voxels it is attenuated independently.",
        "Root mean square difference of waveforms from those of the triangles, over samples above 1 % of the "
        "peak, in percent of the root mean square there; mean over footprints. What the noise of the "
        "simulations adds is subtracted.",
        table(
            [
                "leaves",
                "scene",
                *(f"{d:g} m, {orders}: %" for d, orders in columns),
                f"{narrow:g} m, noise: %",
            ],
            waves,
        ),
        f"Differences of the footprints of {narrow:g} m, all orders, with standard errors of the "
        "simulations: of the apparent reflectance in all and of each material, and of relative heights.",
        table(["leaves", "scene", *(f"{m}: %" for m in percents), "RH50: m", "RH98: m"], measures),
        "What remains by area at 0.1 m without leaves is scattering, not attenuation: facets of wood in "
        "voxels have all orientations, branches are steep. By their normals alone, wood seen from above "
        f"returns {100 * (record['steepness factor of wood'] - 1):.0f} % more in voxels than as triangles.",
        f"{shots} simulations of {record['photons']:,} photons, compilation included, take "
        f"{number(triangles['seconds to simulate'])} s with triangles and "
        f"{number(finest['seconds to simulate'])} s with {finest['size']:,} voxels of {finest['edge']:g} m.",
    )


def devices(record: dict) -> str:
    def rows(kind: str) -> list[list[str]]:
        """Return a row for each number of traces, with a column for each device and order."""
        parts = [part["side by side"][kind] for part in record.values()]
        columns = [
            {r["traces"]: number(r["photons per second"]) for r in records}
            for part in parts
            for records in part.values()
        ]
        counts = sorted({count for column in columns for count in column})
        return [[f"{count:,}", *(column.get(count, "") for column in columns)] for count in counts]

    def head(kind: str) -> list[str]:
        names = [f"{name}, {n}" for name, part in record.items() for n in part["side by side"][kind]]
        return ["traces", *names]

    def single(name: str, value: Callable[[dict], float]) -> list[str]:
        return [name, *(number(value(part)) for part in record.values())]

    calls = [
        *(
            single(f"`simulate` to 3 %, {n}, s", lambda part, n=n: part["simulate"][n]["warm"])
            for n in ("orders: 1", "orders: 5")
        ),
        single("its first call, orders: 5, s", lambda part: part["simulate"]["orders: 5"]["first"]),
        single(
            "`simulate_many`, first order, to 2 %, ms a shot",
            lambda part: 1e3 * part["survey"]["warm"] / part["survey"]["shots"],
        ),
        single(
            "PROSPECT, 2,101 wavelengths, us a leaf",
            lambda part: 1e6 * part["leaves"][-1]["warm"] / part["leaves"][-1]["leaves"],
        ),
    ]
    return page_of(
        "The tracer is plain JAX and runs on GPUs as it is; products of arrays are computed in full single "
        "precision there as well. What a GPU gains depends on how much light is traced at once. The table "
        "has photons per second of traces side by side: independent keys of one crown of 64³ voxels under "
        "`jax.vmap`, with 256 photons and 256 rays each. (The times of the H200 are from before products "
        "asked for full precision.)",
        table(head("values"), rows("values")),
        "The same for gradients in every voxel, by reverse mode:",
        table(head("gradient"), rows("gradient")),
        "A single simulation or shot is too small for a GPU: its photons march in chunks that fit a "
        "processor's cache, one chunk after the other. Traces side by side, and leaves, gain:",
        table(["one call", *record], calls),
    )


def scene_retrieval(record: dict) -> str:
    rows, narrow, terrain = record["footprints"], record["narrow"], record["terrain"]
    medians = {k: statistics.median(map(abs, terrain[f"error {k}"])) for k in ("alone", "together")}
    leaves = [
        [
            r["stand"],
            r["prior"],
            f"{100 * r['leaf area error']:+.0f} %",
            f"{r['profile correlation']:.3f}",
            number(r["misfit"], 3),
            str(r["steps"]),
            number(r["cpu seconds"]),
            number(r["peak GB"]),
        ]
        for r in rows
    ]
    head = [
        "stand",
        "prior",
        "leaf area error",
        "correlation of the profile",
        "misfit",
        "steps",
        "CPU s",
        "GB",
    ]
    return page_of(
        f"Leaf extinction in {rows[0]['unknowns']:,} voxels, {rows[0]['edge']:g} m wide and 1 m high, of a "
        f"stand of 60 m x 60 m x 25 m, from {rows[0]['shots']} overlapping footprints of 25 m with noise of "
        "2 % of the largest sample. Leaves vary over tens of metres (even), or are in crowns of 3 to 6 m. "
        "Misfit is chi-squared over the number of samples: one is the noise. CPU seconds include "
        "compilation.",
        table(head, leaves),
        "All priors explain the records to their noise. Leaf area beyond that of the Markov field, in "
        "crowns narrower than a footprint, is not in these records: it comes from what `clumped_leaves` is "
        "told of the crowns, and is no better than that.",
        f"**Narrow shots.** The crowns from {narrow['shots']:,} shots 0.5 m wide, up to 10 degrees off "
        f"nadir: leaf area {100 * narrow['leaf area error']:+.1f} %, correlation of the voxels "
        f"{narrow['voxel correlation']:.3f}, and {narrow['correlation in 2 m']:.3f} of means over 2 m; "
        f"{number(narrow['cpu seconds'])} CPU seconds, {number(narrow['peak GB'])} GB.",
        f"**Terrain under leaves.** {terrain['shots']} footprints of 25 m, 2.5 m apart, over hills under "
        f"leaves of unknown density. The rms error of the ground's height is {terrain['rms alone']:.2f} m "
        f"where each footprint is fitted alone, over a slope of its own, and {terrain['rms together']:.2f} m "
        "where nodes of the terrain and voxels of leaves are fitted to all records together, from there on; "
        f"the median sizes of the error are {medians['alone']:.2f} and {medians['together']:.2f} m: single "
        f"fits that end at another echo make the difference. {number(terrain['cpu seconds'])} CPU seconds.",
    )


def narrow_shots(record: dict) -> str:
    flight, voxels = record["flight"], record["by voxel"]
    stages = ("simulate", "returns", "files")
    return page_of(
        "Shots of a scanner 0.3 m wide, at first order, over the forest of the surveys above. A numba kernel "
        "marches as many rays for every shot as jaxlidar begins with, and deposits them in the same bins. It "
        "leaves out more rays where they are needed, errors, the pulse, samples and the energy budget.",
        table(
            (
                "shots",
                "tolerance",
                "error, median",
                "µs a shot",
                "numba: rays a shot",
                "µs a shot",
                "µs a ray",
            ),
            [
                (
                    f"{r['shots']:,}",
                    f"{number(100 * r['tolerance'])} %",
                    f"{number(100 * r['error, median'])} %",
                    number(r["us per shot, simulate_many"]),
                    str(r["first rays"]),
                    number(r["us per shot, numba"]),
                    number(r["us per ray, numba"]),
                )
                for r in record["by tolerance"]
            ],
        ),
        f"Over voxels of {', '.join(number(r['voxel']) for r in voxels)} m a shot takes "
        f"{', '.join(number(r['us per shot']) for r in voxels)} µs to "
        f"{number(100 * voxels[0]['tolerance'])} %: a beam crosses more of them.",
        f"{flight['shots']:,} shots, line by line, to {number(100 * flight['tolerance'])} %, with returns of "
        f"the peak detector written as one LAZ file: {number(flight['seconds'])} s, "
        f"{number(sum(flight[f'us per shot, {s}'] for s in stages))} µs a shot ("
        + ", ".join(f"{s} {number(flight[f'us per shot, {s}'])}" for s in stages)
        + f"), {flight['points']:,} points of {number(flight['bytes per point'])} bytes, at most "
        f"{number(flight['peak GB'])} GB.",
    )


def leaf_gaps(record: dict) -> str:
    rings = [f"{low:g} to {high:g} degrees" for low, high in record["rings"]]
    return page_of(
        f"Shots of a VZ-400 that stands below crowns, {record['shots']:,} in each ring of zenith angles. A "
        "voxel returns what is expected of its leaves, so that nearly every shot has a return from every "
        "crown that it crosses; leaves of 50 cm2 are hit or missed. A beam has a width, and the edge of a "
        "leaf returns a little of it.",
        table(
            ("share of shots", *rings),
            [(r["what"], *(f"{share:.3f}" for share in r["shares"])) for r in record["rows"]],
        ),
        "CPU time of a shot. The hectare is a stand of 400 trees of leaf area index 4, seen from 500 m above "
        "with footprints of 25 cm; with its leaves the process takes at most "
        f"{number(record['peak GB'])} GB.",
        table(
            ("scene", "leaves", "tolerance", "µs a shot"),
            [
                (r["what"], f"{r['leaves']:,}", f"{number(100 * r['rtol'])} %", number(r["us per shot"]))
                for r in record["costs"]
            ],
        ),
    )


def many_scenes(record: dict) -> str:
    return page_of(
        "Stands of 12 layers over level ground, of random density and ground reflectance, by `plan_scenes` "
        "and `simulate_scenes`, compiled before. At first order nothing is random. The error is that of the "
        "sum of a waveform, in the root mean square over scenes.",
        table(
            ("orders", "photons a scene", "scenes", "ms a scene", "error"),
            [
                (
                    str(r["orders"]),
                    str(r["photons"]),
                    f"{r['scenes']:,}",
                    number(r["ms per scene"]),
                    f"{number(100 * r['error'])} %",
                )
                for r in record["rows"]
            ],
        ),
    )


def posterior(record: dict) -> str:
    spent = record["seconds"]
    return page_of(
        f"A target of `retrieval_coverage.py`, with {record['photons']:,} photons in each of eight batches: "
        "leaf chemistry, heights, leaf area and brightness of the ground, by `inversion.retrieve`, and by "
        f"`inversion.log_density` and the no-U-turn sampler of blackjax, {record['draws']} draws of "
        f"{record['gradients per draw']:.1f} gradients. The covariance of the fit is the sampler's metric, "
        "and nothing is adapted.",
        table(
            ("unknown", "truth", "fit", "posterior", "effective draws"),
            [
                (
                    r["name"],
                    number(r["true"], 3),
                    f"{number(r['fit'], 3)} ± {number(r['stderr'])}",
                    f"{number(r['mean'], 3)} ± {number(r['standard deviation'])}",
                    f"{r['effective draws']:.0f}",
                )
                for r in record["unknowns"]
            ],
        ),
        f"The fit took {number(spent['fit'])} s with its compilation, the compilation of the sampler "
        f"{number(spent['compilation'])} s, and the draws {number(spent['sampling'])} s: "
        f"{number(1e3 * spent['gradient'])} ms a gradient. {100 * record['acceptance']:.0f} % of the steps "
        "were accepted.",
    )


SECTIONS: dict[str, tuple[str, Callable[[dict], str]]] = {
    "accuracy_cost": ("Cost of accuracy", accuracy),
    "simulation_cost": ("Cost of `simulate`", simulation),
    "everyday_changes": ("Cost of changing a scene", changes),
    "surveys": ("Cost of thousands of footprints", surveys),
    "narrow_shots": ("Cost of narrow shots", narrow_shots),
    "many_scenes": ("Cost of a scene among many", many_scenes),
    "peers": ("Other codes", peers),
    "peers_gradient": ("A gradient beside another code", peers_gradient),
    "effects_cost": ("Time saved by plans", effects),
    "scaling": ("Scaling of cost", scaling),
    "meshes": ("Cost of meshes", meshes),
    "mesh_or_voxels": ("Voxels against triangles", mesh_or_voxels),
    "leaves": ("Leaves that are hit or missed", leaf_gaps),
    "python_versions": ("Older Pythons", pythons),
    "first_order_march": ("First order against a kernel written by hand", march),
    "one_trace_all_wavelengths": ("Many wavelengths from one trace", wavelengths),
    "jacobian_cost": ("Jacobians of a waveform", jacobian),
    "gradient_cost": ("Gradients in every voxel", gradients),
    "fit_speed": ("Fits against scipy", fits),
    "retrieval_coverage": ("Accuracy and coverage of retrievals", coverage),
    "posterior_sampling": ("Posterior of seven unknowns", posterior),
    "profiles": ("Vertical profiles against the closed form", profiles),
    "scene_retrieval": ("One scene from many records", scene_retrieval),
    "prospect_speed": ("PROSPECT against prosail", prospect),
    "leaf_inversion": ("Traits of measured leaves", leaves),
    "devices": ("On a GPU", devices),
}


def page() -> str:
    """Return the text of README.md."""
    paragraphs = [HEAD]
    for name, (title, section) in SECTIONS.items():
        path = RESULTS / f"{name}.json"
        if not path.exists():
            paragraphs.append(f"## {title}\n\n`{name}.py`. There is no record of it yet.\n")
            continue
        record = json.loads(path.read_text())
        paragraphs.append(f"## {title}\n\n`{name}.py`. {machine(record)}\n\n{section(record)}\n")
        if path.with_suffix(".png").exists():
            paragraphs.append(f"![{title}](results/{name}.png)\n")
    return "\n".join(paragraphs)


if __name__ == "__main__":
    with atomic_write(FOLDER / "README.md") as draft:
        draft.write_text(page())
