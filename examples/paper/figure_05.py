"""Figure 5: new information against the number of iterations, for a flat Lambertian surface.

An iteration is one pulse, sent in pieces of 0.1 ns, as in the estimator of the paper (`analog_returns`). The
number of distinct return times levels off soon. `simulate` needs one pass: nothing here is random.

    python examples/paper/figure_05.py [--out figures] [--small]
"""

import jax
import numpy as np
from _common import new_figure, options, save, send_pulses, unique_returns, until_stable

import jaxlidar as jl


def main(argv=None) -> dict[str, float]:
    arguments = options(__doc__, argv)
    lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground(reflectance=0.5))
    pulses = 600 if arguments.small else 2000
    time, weight = send_pulses(lidar, scene, jl.plan(lidar, scene), 0, pulses)
    unique = unique_returns(time, weight)
    stable = until_stable(unique, 50, 0.02)
    wave = jl.simulate(lidar, scene, key=jax.random.key(0))
    results = {
        "unique returns": int(unique[-1]),
        "stable after, pulses": stable,
        "stable after, photons": stable * time.shape[1],
        "batches of simulate": wave.info["batches"],
    }
    print(results)
    assert stable < 500
    assert unique[100] > 0.85 * unique[-1]
    assert wave.info["stopped"] == "nothing is random"

    figure, ax = new_figure()
    ax.semilogx(np.arange(1, pulses + 1), unique, color="k")
    ax.axvline(stable, color="#D55E00", linestyle="--", label=f"below 1 new return in 50 pulses: {stable}")
    ax.set(xlabel="iterations (pulses)", ylabel="unique returns (0.1 ns)", ylim=(0, None))
    ax.legend(loc="lower right")
    save(figure, arguments.out / "paper_figure_05.png")
    return results


if __name__ == "__main__":
    main()
