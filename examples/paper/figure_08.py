"""Figure 8: new information against the number of iterations, for a tree with leaves over ground.

By the estimator of the paper, and the photons that `simulate` needs for the same error. The paper found
nearly 1.5 million iterations before the waveform stabilises; the number depends on the definition of a
return, on the cone that replaces the aperture, and on the threshold, which the paper does not state.

    python examples/paper/figure_08.py [--out figures] [--small]
"""

import time as clock

import jax
import numpy as np
from _common import COLOURS, new_figure, options, save, send_pulses, tree_scene, unique_returns, until_stable

import jaxlidar as jl


def main(argv=None) -> dict[str, float]:
    arguments = options(__doc__, argv)
    lidar = jl.Lidar(position=(1.0, 0.5))
    scene = tree_scene(1.0 if arguments.small else 0.25)
    plan = jl.plan(lidar, scene, max_orders=2 if arguments.small else 8)
    rounds, window = (2, 20) if arguments.small else (20, 500)
    sent, started = [], 0.0
    for n in range(rounds):
        sent.append(send_pulses(lidar, scene, plan, n, 2 * window))
        # The first round compiles.
        started = started or clock.perf_counter()
    seconds = (clock.perf_counter() - started) * rounds / (rounds - 1)
    time, weight = (np.concatenate(arrays) for arrays in zip(*sent))
    pulses = len(time)
    unique = unique_returns(time, weight)
    threshold = 0.5 if arguments.small else 0.01
    stable = until_stable(unique, window, threshold)

    # Error of the waveform in samples of 1 ns, by the definition of `simulate`.
    def error(n: int) -> float:
        power = np.histogram(time[:n], edges, weights=weight[:n])[0] / n
        square = np.histogram(time[:n], edges, weights=weight[:n] ** 2)[0] / n**2
        seen = power > 0.01 * power.max()
        return float(np.sqrt(np.mean(square[seen] / power[seen] ** 2)))

    edges = np.arange(-120.0, 121.0)
    counts = np.unique(np.geomspace(max(pulses // 100, 2), pulses, 12).astype(int))
    errors = np.array([error(int(n)) for n in counts])
    wave = jl.simulate(lidar, scene, key=jax.random.key(0), plan=plan, rtol=0.3 if arguments.small else 0.02)
    simulate_photons = wave.info["photons"]
    # The error falls with the square root of the number of photons.
    needed = pulses * time.shape[1] * (errors[-1] / wave.info["error"]) ** 2
    results = {
        "unique returns": int(unique[-1]),
        "stable after, pulses": stable,
        "stable after, photons": stable * time.shape[1],
        "seconds of the paper's estimator": seconds,
        "its error": errors[-1],
        "error of simulate": wave.info["error"],
        "photons of simulate": simulate_photons,
        "photons of the paper's estimator for that error": needed,
    }
    for name, value in results.items():
        print(f"{name}: {value:.4g}")
    # A tree needs many more iterations than a flat surface (figure 5).
    assert stable > (20 if arguments.small else 200)
    assert needed > simulate_photons

    figure, (return_axes, error_axes) = new_figure(rows=2, height=4.0, sharex=True)
    photons = np.arange(1, pulses + 1) * time.shape[1]
    return_axes.semilogx(photons, unique, color="k")
    if stable < pulses:
        return_axes.axvline(stable * time.shape[1], color=COLOURS[1], linestyle="--")
        return_axes.set_title(f"fewer than 1 new return in {1 / threshold:.0f} pulses after {stable}")
    return_axes.set(ylabel="unique returns (0.1 ns)", ylim=(0, None))
    error_axes.loglog(
        counts * time.shape[1], errors, "o-", color="k", markersize=3, label="paper's estimator"
    )
    error_axes.plot(
        simulate_photons, wave.info["error"], "D", color=COLOURS[2], markersize=4, label="simulate"
    )
    error_axes.set(xlabel="photons", ylabel="relative error per ns")
    error_axes.legend()
    save(figure, arguments.out / "paper_figure_08.png")
    return results


if __name__ == "__main__":
    main()
