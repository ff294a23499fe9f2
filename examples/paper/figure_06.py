"""Figure 6: the waveform of a flat Lambertian surface after more and more iterations.

By the estimator of the paper; the exact waveform, which `simulate` computes in one pass, is drawn as well.

    python examples/paper/figure_06.py [--out figures] [--small]
"""

import jax
import numpy as np
from _common import COLOURS, new_figure, options, save, send_pulses, table

import jaxlidar as jl

REFLECTANCE = 0.5


def main(argv=None) -> dict[str, float]:
    arguments = options(__doc__, argv)
    lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground(reflectance=REFLECTANCE))
    iterations = (1, 10, 100, 1000) if arguments.small else (1, 10, 100, 1000, 10000)
    time, weight = send_pulses(lidar, scene, jl.plan(lidar, scene), 1, iterations[-1])
    wave = jl.simulate(lidar, scene, key=jax.random.key(0))
    exact, centres = np.asarray(wave.reflectance[0], float), np.asarray(wave.time, float)
    edges = np.append(centres - 0.5, centres[-1] + 0.5)

    figure, ax = new_figure()
    rows, results = [], {}
    for n, colour in zip(iterations, COLOURS):
        power = np.histogram(time[:n], edges, weights=weight[:n])[0] / n
        peak = float(centres[np.argmax(power)])
        error = float(np.sqrt(np.mean((power - exact) ** 2)) / exact.max())
        rows.append((n, power.sum(), peak, error))
        results |= {f"peak after {n}": peak, f"error after {n}": error}
        ax.step(centres, power, where="mid", color=colour, label=f"{n}", linewidth=0.9)
    ax.plot(centres, exact, "k--", linewidth=1.0, label="exact")
    table(("iterations", "sum", "peak (ns)", "rms error / peak"), rows)
    # The paper: after only 100 iterations, the peak can be correctly detected.
    assert abs(results["peak after 100"] - centres[np.argmax(exact)]) <= 1.0
    assert results["error after 1000"] < results["error after 10"]

    ax.set(xlabel="time from the reference plane (ns)", ylabel="apparent reflectance per ns")
    ax.set(xlim=(-9, 9), ylim=(0, 2.2 * exact.max()))
    ax.legend(title="iterations")
    save(figure, arguments.out / "paper_figure_06.png")
    return results


if __name__ == "__main__":
    main()
