"""Fits of the same targets by `inversion.retrieve` and by `scipy.optimize.least_squares`.

Scene and unknowns are those of `retrieval_coverage.py`: seven unknowns, three of them geometric, three
wavelengths, four orders. Both use the same compiled simulation with the same random numbers and start in the
middle of the bounds; the record counts the fits that end at the same chi-squared, to 0.5. scipy uses finite
differences, each of which is a simulation; `retrieve` traces the tangents of the geometric unknowns together
and gets those of the optical ones from the traced response. The second case has only the four optical
unknowns, for which `retrieve` traces once.
"""

import os
import statistics
import time
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import numpy as np
from _common import label_log_axis, new_figure, number, page_of, table
from retrieval_coverage import LIDAR, NOISE, RANGES, plan_of, scene_of, unknowns

import inversion
import jaxlidar as jl
from inversion.fit.unknowns import bind_unknowns, set_values
from jaxlidar.planning.plan import MIN_BATCHES

TITLE = "Fits against scipy"
QUICK = {"targets": 1, "photons": 1024}
OPTICAL = ("Cab", "Cw", "N", "ground brightness")


def measure(targets: int = 12, photons: int = 65536) -> dict:
    """Return the times of fits of all and of optical unknowns, and where they end."""
    import scipy.optimize

    plan = plan_of(photons // MIN_BATCHES)
    key = jax.random.key(3)
    pool = ThreadPoolExecutor(os.cpu_count() or 1)
    random = np.random.default_rng(5)
    middle = {name: 0.5 * sum(b) for name, (b, _) in RANGES.items()}
    fits = {}
    for case, chosen in (("all seven", tuple(RANGES)), ("four optical", OPTICAL)):
        chosen_unknowns = [u for u in unknowns() if u.name in chosen]
        times: dict[str, list[float]] = {"ours": [], "scipy": []}
        counts: dict[str, list[int]] = {"ours": [], "scipy": []}
        chi2_differences = []
        # The first target compiles and does not count.
        for target in range(targets + 1):
            truth = {name: float(random.uniform(*r)) for name, (_, r) in RANGES.items()}
            base = scene_of({**truth, **{name: middle[name] for name in chosen}})
            wave = jl.simulate(
                LIDAR,
                scene_of(truth),
                key=jax.random.key(100 + target),
                plan=plan,
                n_photons=photons,
            )
            sigma = NOISE * np.asarray(wave.reflectance, float).max(axis=1, keepdims=True)
            observed = np.asarray(wave.reflectance, float)
            observed = observed + sigma * random.normal(size=observed.shape)

            start = time.perf_counter()
            problem = inversion.Problem(
                observed, LIDAR, base, chosen_unknowns, noise=sigma, time=wave.time, plan=plan
            )
            fit = inversion.retrieve(problem, key=key)
            ours = time.perf_counter() - start

            bound_unknowns = bind_unknowns(chosen_unknowns, base)
            setters = tuple(s.setter for s in bound_unknowns)
            keys = [jax.random.fold_in(key, n) for n in range(MIN_BATCHES)]

            def residuals(x, base=base, setters=setters, keys=keys, observed=observed, sigma=sigma):
                values = tuple(jax.numpy.asarray(v, jax.numpy.zeros(()).dtype) for v in x)
                waveforms = pool.map(lambda k: _simulated(base, plan, setters, values, k), keys)
                return (
                    (np.mean([np.asarray(p, float) for p in waveforms], axis=0) - observed) / sigma
                ).ravel()

            low, high = (np.array([float(getattr(s, f)) for s in bound_unknowns]) for f in ("low", "high"))
            residuals(low + 0.5 * (high - low))
            start = time.perf_counter()
            scipy_fit = scipy.optimize.least_squares(
                residuals,
                [float(s.start) for s in bound_unknowns],
                bounds=(low, high),
                x_scale=high - low,
                # Larger than the rounding of single precision.
                diff_step=1e-2,
                ftol=1e-4,
                xtol=1e-4,
                gtol=1e-4,
            )
            seconds = time.perf_counter() - start
            if target == 0:
                continue
            fit_chi2 = np.sum(residuals([float(fit.values[s.name]) for s in bound_unknowns]) ** 2)
            chi2_differences.append(float(fit_chi2 - 2 * scipy_fit.cost))
            times["ours"].append(ours)
            times["scipy"].append(seconds)
            counts["ours"].append(fit.steps)
            counts["scipy"].append(int(scipy_fit.nfev + scipy_fit.njev * len(bound_unknowns)))
        fits[case] = {
            "seconds": times,
            "simulations": counts,
            "ratio": float(np.median(np.array(times["scipy"]) / np.array(times["ours"]))),
            "chi2_ours_minus_scipy": chi2_differences,
        }
    return {"photons": photons, "targets": targets, "fits": fits}


@eqx.filter_jit
def _simulated(scene, plan, setters, values, key):
    setup = jl.make_setup(LIDAR, set_values(scene, setters, values), plan)
    return jl.total_reflectance(jl.trace_scene(setup, key, reverse=False), setup)


def draw(record: dict):
    """Draw the seconds of every fit by scipy over those of `retrieve`."""
    figure, axes = new_figure()
    for case, r in record["fits"].items():
        axes.loglog(r["seconds"]["ours"], r["seconds"]["scipy"], "o", label=case)
    limits = axes.get_xlim()
    axes.plot(limits, [10 * b for b in limits], color="0.7", label="ten times")
    for axis in (axes.xaxis, axes.yaxis):
        label_log_axis(axis, 1, 2, 5)
    axes.set(xlabel="inversion.retrieve (s)", ylabel="scipy.optimize.least_squares (s)")
    axes.legend()
    return figure


def section(record: dict) -> str:
    def gaps(case: str) -> list[float]:
        return record["fits"][case]["chi2_ours_minus_scipy"]

    columns = {
        "unknowns": str,
        "retrieve, s": lambda case: statistics.median(record["fits"][case]["seconds"]["ours"]),
        "scipy, s": lambda case: statistics.median(record["fits"][case]["seconds"]["scipy"]),
        "times faster": lambda case: record["fits"][case]["ratio"],
        "same": lambda case: sum(abs(gap) < 0.5 for gap in gaps(case)),
        "excess": lambda case: ", ".join(number(-gap) for gap in sorted(gaps(case)) if abs(gap) >= 0.5),
    }
    return page_of(
        f"Both use the same simulation of {record['photons']:,} photons; medians of {record['targets']} "
        'targets. "Same" counts the fits that end at the same chi-squared, to 0.5; "excess" lists by how '
        "much the chi-squared of scipy is larger in each of the others.",
        table(record["fits"], columns),
    )
