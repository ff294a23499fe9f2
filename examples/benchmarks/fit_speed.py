"""Fits of the same targets by `inversion.retrieve` and by `scipy.optimize.least_squares`.

Run it as `python examples/benchmarks/fit_speed.py [--out figures] [--targets 12] [--photons 65536]`.

Scene and unknowns are those of `retrieval_coverage.py`: seven unknowns, of which three are geometric, three
wavelengths, four orders. Both look at the same compiled simulation with the same random numbers and start
from the middle of the bounds; how many end at the same chi-squared, to 0.5, is in the record. scipy has no
derivatives but finite differences, each of which is a simulation; ours traces the tangents of the geometric
unknowns together and gets those of the optical ones from the traced response. The second case has only the
four optical unknowns: ours then traces once."""

import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import scipy.optimize
from _common import machine, new_figure, options, print_table, save_figure, write_json
from matplotlib.ticker import LogLocator, NullFormatter
from retrieval_coverage import LIDAR, NOISE, RANGES, plan_of, scene_of, unknowns

import inversion
import jaxlidar as jl
from inversion.fit.unknowns import bind_unknowns, set_values
from jaxlidar.planning.plan import MIN_BATCHES

OPTICAL = ("Cab", "Cw", "N", "ground brightness")


def main() -> None:
    given = options("Speed of fits.", targets=12, photons=65536)
    plan = plan_of(given.photons // MIN_BATCHES)
    key = jax.random.key(3)
    pool = ThreadPoolExecutor(os.cpu_count() or 1)
    random = np.random.default_rng(5)
    middle = {name: 0.5 * sum(b) for name, (b, _) in RANGES.items()}
    rows, record = [], {}
    for case, wanted in (("all seven", tuple(RANGES)), ("four optical", OPTICAL)):
        sought = [u for u in unknowns() if u.name in wanted]
        times: dict[str, list[float]] = {"ours": [], "scipy": []}
        counts: dict[str, list[int]] = {"ours": [], "scipy": []}
        gaps = []
        # The first target compiles, and does not count.
        for number in range(given.targets + 1):
            truth = {name: float(random.uniform(*r)) for name, (_, r) in RANGES.items()}
            base = scene_of({**truth, **{name: middle[name] for name in wanted}})
            wave = jl.simulate(
                LIDAR, scene_of(truth), key=jax.random.key(100 + number), plan=plan, n_photons=given.photons
            )
            sigma = NOISE * np.asarray(wave.reflectance, float).max(axis=1, keepdims=True)
            observed = np.asarray(wave.reflectance, float)
            observed = observed + sigma * random.normal(size=observed.shape)

            begun = time.perf_counter()
            fit = inversion.retrieve(
                observed, LIDAR, base, sought, noise=sigma, time=wave.time, key=key, plan=plan
            )
            ours = time.perf_counter() - begun

            bound = bind_unknowns(sought, base)
            setters = tuple(u.setter for u in bound)
            keys = [jax.random.fold_in(key, n) for n in range(MIN_BATCHES)]

            def residuals(x, base=base, setters=setters, keys=keys, observed=observed, sigma=sigma):
                values = tuple(jax.numpy.asarray(v, jax.numpy.zeros(()).dtype) for v in x)
                parts = pool.map(lambda k: _simulated(base, plan, setters, values, k), keys)
                return ((np.mean([np.asarray(p, float) for p in parts], axis=0) - observed) / sigma).ravel()

            low, high = (np.array([float(getattr(s, f)) for s in bound]) for f in ("low", "high"))
            residuals(low + 0.5 * (high - low))
            begun = time.perf_counter()
            theirs = scipy.optimize.least_squares(
                residuals,
                [float(s.start) for s in bound],
                bounds=(low, high),
                x_scale=high - low,
                # Above the rounding of single precision.
                diff_step=1e-2,
                ftol=1e-4,
                xtol=1e-4,
                gtol=1e-4,
            )
            seconds = time.perf_counter() - begun
            if number == 0:
                continue
            mine = np.sum(residuals([float(fit.values[s.name]) for s in bound]) ** 2)
            gaps.append(float(mine - 2 * theirs.cost))
            times["ours"].append(ours)
            times["scipy"].append(seconds)
            counts["ours"].append(fit.steps)
            counts["scipy"].append(int(theirs.nfev + theirs.njev * len(bound)))
        ratio = float(np.median(np.array(times["scipy"]) / np.array(times["ours"])))
        record[case] = {
            "seconds": times,
            "simulations": counts,
            "ratio": ratio,
            "chi2_ours_minus_scipy": gaps,
        }
        rows.append((case, np.median(times["ours"]), np.median(times["scipy"]), ratio, max(gaps), min(gaps)))
    print_table(("unknowns", "ours, s", "scipy, s", "ratio", "chi2, ours - scipy, most", "least"), rows)
    written = {"machine": machine(), "photons": given.photons, "targets": given.targets, "fits": record}
    write_json(given.out / "fit_speed.json", written)
    draw(record, given.out / "fit_speed.png")


def draw(record: dict, path: Path) -> None:
    """Seconds of every fit, theirs over ours."""
    figure, axes = new_figure()
    for case, r in record.items():
        axes.loglog(r["seconds"]["ours"], r["seconds"]["scipy"], "o", label=case)
    both = axes.get_xlim()
    axes.plot(both, [10 * b for b in both], color="0.7", label="ten times")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.set(xlabel="inversion.retrieve (s)", ylabel="scipy.optimize.least_squares (s)")
    axes.legend()
    save_figure(figure, path)


@eqx.filter_jit
def _simulated(scene, plan, setters, values, key):
    setup = jl.make_setup(LIDAR, set_values(scene, setters, values), plan)
    return jl.total_reflectance(jl.trace_scene(setup, key, reverse=False), setup)


if __name__ == "__main__":
    main()
