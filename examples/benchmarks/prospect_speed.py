"""Full leaf spectra in single precision: time per leaf against looping `prosail`, and of the whole Jacobian.

The three are timed in turn, round after round, so that other load of the machine slows all alike; ratios are
those of the fastest rounds. Batches of 5 to 100 leaves are best.
"""

import jax
import jax.numpy as jnp
import numpy as np
from _common import best, new_figure, number, page_of, race, table

import jaxlidar as jl

TITLE = "PROSPECT against prosail"
QUICK = {"leaf_count": 20, "rounds": 1}
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
    """Return the spectra of the first `n` leaves by prosail."""
    import prosail

    names = {"N": "n", "Cab": "cab", "Car": "car", "Cant": "ant", "Cbrown": "cbrown", "Cw": "cw", "Cm": "cm"}
    return [
        prosail.run_prospect(**{names[name]: values[i] for name, values in traits.items()}) for i in range(n)
    ]


def measure(leaf_count: int = 1000, rounds: int = 9) -> dict:
    """Return the seconds of a leaf by prosail, and of spectra and Jacobians by the size of batches."""
    n_looped = max(1, leaf_count // 20)
    traits, batch = leaves(leaf_count)
    contestants = {"prosail": lambda: loop(traits, n_looped)}
    for b in BATCHES:
        spectra = jax.jit(lambda x, b=b: jax.lax.map(lambda leaf: leaf(WAVELENGTHS), x, batch_size=b))
        jacobian = jax.jit(lambda x, b=b: x.jacobian(WAVELENGTHS, b))
        contestants[f"spectra {b}"] = lambda run=spectra: run(batch)
        contestants[f"jacobian {b}"] = lambda run=jacobian: run(batch)
    times = best(race(contestants, rounds))
    per_leaf = {name: t / (n_looped if name == "prosail" else leaf_count) for name, t in times.items()}

    R, T = batch(WAVELENGTHS)
    by_prosail = enumerate(loop(traits, n_looped))
    error = max(float(abs(R[i] - r).max() + abs(T[i] - t).max()) for i, (_, r, t) in by_prosail)
    spectra_time, jacobian_time = (
        min(per_leaf[f"{kind} {b}"] for b in BATCHES) for kind in ("spectra", "jacobian")
    )
    return {
        "leaves": leaf_count,
        "wavelengths": WAVELENGTHS.size,
        "seconds_per_leaf": per_leaf,
        "largest_difference": error,
        "times_faster_than_prosail": per_leaf["prosail"] / spectra_time,
        "jacobian_over_evaluation": jacobian_time / spectra_time,
    }


def draw(record: dict):
    """Draw the time of a leaf by the size of batches."""
    figure, axes = new_figure()
    microseconds = {name: 1e6 * t for name, t in record["seconds_per_leaf"].items()}
    for kind, label in (("spectra", "R and T"), ("jacobian", "with all derivatives")):
        axes.loglog(BATCHES, [microseconds[f"{kind} {b}"] for b in BATCHES], "o-", label=label)
    axes.axhline(microseconds["prosail"], color="black", linestyle="--", label="prosail, R and T")
    axes.set(xlabel="leaves per batch", ylabel="time per leaf (µs)", title="PROSPECT-D, 2,101 wavelengths")
    axes.legend()
    return figure


def section(record: dict) -> str:
    def microseconds(kind: str) -> float:
        return 1e6 * min(t for name, t in record["seconds_per_leaf"].items() if name.startswith(kind))

    return page_of(
        table(("prosail", "spectra", "jacobian"), {"2,101 wavelengths": str, "us a leaf": microseconds}),
        f"{number(record['times_faster_than_prosail'])} times faster than looping prosail; all derivatives "
        f"cost {number(record['jacobian_over_evaluation'])} evaluations.",
    )
