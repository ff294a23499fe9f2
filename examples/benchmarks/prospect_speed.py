"""Full leaf spectra in single precision: time per leaf against looping `prosail`, and of the whole Jacobian.

Run it as `python examples/benchmarks/prospect_speed.py [folder]`. Writes `prospect_speed.json` and
`prospect_speed.png` into the folder (default `figures/`). The three are timed in turn, round after round, so
that other work on the machine falls on all alike; ratios are those of the fastest rounds.

On two cores of a shared machine: 30 to 40 us a leaf (2,101 wavelengths), 13 to 15 times faster than prosail
(500 to 570 us); with all seven derivatives of reflectance and transmittance 1.7 times that. Batches of 5 to
100 leaves are best.
"""

import argparse
import json
import os
import platform
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import prosail

import jaxlidar as jl

matplotlib.use("Agg")
import matplotlib.pyplot as plt

WAVELENGTHS = np.arange(400.0, 2501.0)
BATCHES = (1, 5, 20, 100, 500)
TYPICAL = {"N": 1.8, "Cab": 40.0, "Car": 8.0, "Cant": 1.0, "Cbrown": 0.1, "Cw": 0.01, "Cm": 0.009}


def leaves(n: int) -> tuple[dict[str, np.ndarray], jl.Prospect]:
    """Traits of `n` leaves within 30 % of typical ones, and the leaves."""
    rng = np.random.default_rng(0)
    traits = {name: value * rng.uniform(0.7, 1.3, n) for name, value in TYPICAL.items()}
    batch = jax.vmap(lambda traits: jl.Prospect(**traits))({k: jnp.asarray(v) for k, v in traits.items()})
    return traits, batch


def seconds(function, *arguments) -> float:
    start = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - start


def loop(traits: dict[str, np.ndarray], n: int) -> list:
    names = {"N": "n", "Cab": "cab", "Car": "car", "Cant": "ant", "Cbrown": "cbrown", "Cw": "cw", "Cm": "cm"}
    return [
        prosail.run_prospect(**{names[name]: values[i] for name, values in traits.items()}) for i in range(n)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description="Speed of PROSPECT.")
    parser.add_argument("folder", nargs="?", default="figures", type=Path)
    parser.add_argument("--leaves", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=9)
    options = parser.parse_args()
    n, looped = options.leaves, max(1, options.leaves // 20)
    traits, batch = leaves(n)

    spectra = {b: jax.jit(lambda x, b=b: jl.prospect_spectra(x, WAVELENGTHS, b)) for b in BATCHES}
    jacobian = {b: jax.jit(lambda x, b=b: jl.prospect_jacobian(x, WAVELENGTHS, b)) for b in BATCHES}
    for compiled in (*spectra.values(), *jacobian.values()):
        seconds(compiled, batch)
    seconds(loop, traits, 1)

    times: dict[str, list[float]] = {}
    for _ in range(options.rounds):
        times.setdefault("prosail", []).append(seconds(loop, traits, looped) / looped)
        for b in BATCHES:
            times.setdefault(f"spectra {b}", []).append(seconds(spectra[b], batch) / n)
            times.setdefault(f"jacobian {b}", []).append(seconds(jacobian[b], batch) / n)
    best = {name: min(values) for name, values in times.items()}

    R, T = spectra[100](batch)
    theirs = loop(traits, looped)
    error = max(float(abs(R[i] - r).max() + abs(T[i] - t).max()) for i, (_, r, t) in enumerate(theirs))
    one, whole = (min(best[f"{kind} {b}"] for b in BATCHES) for kind in ("spectra", "jacobian"))
    record = {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
            "device": str(jax.devices()[0]),
            "python": platform.python_version(),
            "jax": jax.__version__,
        },
        "leaves": n,
        "wavelengths": WAVELENGTHS.size,
        "seconds_per_leaf": best,
        "largest_difference": error,
        "times_faster_than_prosail": best["prosail"] / one,
        "jacobian_over_evaluation": whole / one,
    }
    options.folder.mkdir(parents=True, exist_ok=True)
    (options.folder / "prospect_speed.json").write_text(json.dumps(record, indent=2) + "\n")

    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for kind, label in (("spectra", "R and T"), ("jacobian", "with all derivatives")):
        axes.loglog(BATCHES, [1e6 * best[f"{kind} {b}"] for b in BATCHES], "o-", label=label)
    axes.axhline(1e6 * best["prosail"], color="black", linestyle="--", label="prosail, R and T")
    axes.set(xlabel="leaves per batch", ylabel="time per leaf (µs)", title="PROSPECT-D, 2,101 wavelengths")
    axes.legend()
    figure.savefig(options.folder / "prospect_speed.png", dpi=150)

    print(json.dumps(record["machine"]))
    print(
        f"µs a leaf: prosail {1e6 * best['prosail']:.0f}, R and T {1e6 * one:.1f}, Jacobian {1e6 * whole:.1f}"
    )
    print(f"{best['prosail'] / one:.1f} times faster than looping prosail (wanted: 10)")
    print(f"full Jacobian {whole / one:.2f} times one evaluation (wanted: at most 3)")
    print(f"largest difference from prosail {error:.1e}")


if __name__ == "__main__":
    main()
