"""Full leaf spectra in single precision: time per leaf against looping `prosail`, and of the whole Jacobian.

Run it as `python examples/benchmarks/prospect_speed.py [--out figures]`. The three are timed in turn, round
after round, so that other load of the machine slows all alike; ratios are those of the fastest rounds.

On two cores of a shared machine: 30 to 40 us a leaf (2,101 wavelengths), 13 to 15 times faster than prosail
(500 to 570 us); with all seven derivatives of reflectance and transmittance 1.7 times that. Batches of 5 to
100 leaves are best.
"""

import jax
import jax.numpy as jnp
import numpy as np
import prosail
from _common import best, machine, new_figure, options, race, save_figure, write_json

import jaxlidar as jl

WAVELENGTHS = np.arange(400.0, 2501.0)
BATCHES = (1, 5, 20, 100, 500)
TYPICAL = {"N": 1.8, "Cab": 40.0, "Car": 8.0, "Cant": 1.0, "Cbrown": 0.1, "Cw": 0.01, "Cm": 0.009}


def leaves(n: int) -> tuple[dict[str, np.ndarray], jl.Prospect]:
    """Return the traits of `n` leaves within 30 % of typical ones, and the leaves."""
    rng = np.random.default_rng(0)
    traits = {name: value * rng.uniform(0.7, 1.3, n) for name, value in TYPICAL.items()}
    batch = jax.vmap(lambda traits: jl.Prospect(**traits))({k: jnp.asarray(v) for k, v in traits.items()})
    return traits, batch


def loop(traits: dict[str, np.ndarray], n: int) -> list:
    names = {"N": "n", "Cab": "cab", "Car": "car", "Cant": "ant", "Cbrown": "cbrown", "Cw": "cw", "Cm": "cm"}
    return [
        prosail.run_prospect(**{names[name]: values[i] for name, values in traits.items()}) for i in range(n)
    ]


def main() -> None:
    arguments = options("Speed of PROSPECT.", leaves=1000, rounds=9)
    n, n_looped = arguments.leaves, max(1, arguments.leaves // 20)
    traits, batch = leaves(n)

    contestants = {"prosail": lambda: loop(traits, n_looped)}
    for b in BATCHES:
        spectra = jax.jit(lambda x, b=b: jax.lax.map(lambda leaf: leaf(WAVELENGTHS), x, batch_size=b))
        jacobian = jax.jit(lambda x, b=b: x.jacobian(WAVELENGTHS, b))
        contestants[f"spectra {b}"] = lambda run=spectra: run(batch)
        contestants[f"jacobian {b}"] = lambda run=jacobian: run(batch)
    times = best(race(contestants, arguments.rounds))
    seconds_per_leaf = {name: t / (n_looped if name == "prosail" else n) for name, t in times.items()}

    R, T = batch(WAVELENGTHS)
    prosail_spectra = loop(traits, n_looped)
    error = max(
        float(abs(R[i] - r).max() + abs(T[i] - t).max()) for i, (_, r, t) in enumerate(prosail_spectra)
    )
    spectra_time, jacobian_time = (
        min(seconds_per_leaf[f"{kind} {b}"] for b in BATCHES) for kind in ("spectra", "jacobian")
    )
    record = {
        "machine": machine(),
        "leaves": n,
        "wavelengths": WAVELENGTHS.size,
        "seconds_per_leaf": seconds_per_leaf,
        "largest_difference": error,
        "times_faster_than_prosail": seconds_per_leaf["prosail"] / spectra_time,
        "jacobian_over_evaluation": jacobian_time / spectra_time,
    }
    write_json(arguments.out / "prospect_speed.json", record)

    figure, axes = new_figure()
    for kind, label in (("spectra", "R and T"), ("jacobian", "with all derivatives")):
        axes.loglog(BATCHES, [1e6 * seconds_per_leaf[f"{kind} {b}"] for b in BATCHES], "o-", label=label)
    axes.axhline(1e6 * seconds_per_leaf["prosail"], color="black", linestyle="--", label="prosail, R and T")
    axes.set(xlabel="leaves per batch", ylabel="time per leaf (µs)", title="PROSPECT-D, 2,101 wavelengths")
    axes.legend()
    save_figure(figure, arguments.out / "prospect_speed.png")

    print(record["machine"])
    prosail_time = seconds_per_leaf["prosail"]
    print(
        f"µs a leaf: prosail {1e6 * prosail_time:.0f}, R and T {1e6 * spectra_time:.1f}, "
        f"Jacobian {1e6 * jacobian_time:.1f}"
    )
    print(f"{prosail_time / spectra_time:.1f} times faster than looping prosail (wanted: 10)")
    print(f"full Jacobian {jacobian_time / spectra_time:.2f} times one evaluation (wanted: at most 3)")
    print(f"largest difference from prosail {error:.1e}")


if __name__ == "__main__":
    main()
