"""Figure 10: a leaf plate alone: simulated reflectance and transmittance on the spectra of PROSPECT.

python examples/paper/figure_10.py [--out figures] [--small]
"""

import jax
import numpy as np
from _common import COLOURS, new_figure, options, save

import jaxlidar as jl


def main(argv=None) -> dict[str, float]:
    arguments = options(__doc__, argv)
    wavelength = np.arange(400.0, 2501.0, 50.0 if arguments.small else 1.0)
    leaf = jl.Prospect.paper()
    r, t = (np.asarray(x, float) for x in leaf(wavelength))
    plate = jl.Plate(height=1.0, reflectance=r, transmittance=t)
    lidar = jl.Lidar(wavelength=tuple(wavelength.tolist()))
    wave = jl.simulate(lidar, jl.Scene(plates=(plate,)), key=jax.random.key(0))
    returned = np.asarray(wave.reflectance, float).sum(axis=1)
    # Light that the plate neither reflected nor absorbed was transmitted.
    through = 1.0 - np.asarray(wave.energy_budget["absorbed by plate"], float) - returned
    results = {
        "largest difference of reflectance": float(np.max(np.abs(returned - r))),
        "largest difference of transmittance": float(np.max(np.abs(through - t))),
    }
    print(results)
    # Nothing is random here, and single precision rounds at 1e-7. The plate lies 1 m above the reference
    # plane of apparent reflectance; the correction for the range follows from the time of arrival.
    assert max(results.values()) < 2e-5

    marked = slice(None, None, 1 if arguments.small else 50)
    figure, ax = new_figure()
    for line, points, colour, name in (
        (r, returned, COLOURS[2], "reflectance"),
        (t, through, COLOURS[0], "transmittance"),
    ):
        ax.plot(wavelength, line, color=colour, label=name)
        ax.plot(wavelength[marked], points[marked], "o", color=colour, markersize=3)
    ax.plot([], [], "o", color="0.5", markersize=3, label="simulated")
    ax.set(xlabel="wavelength (nm)", ylabel="reflectance, transmittance", xlim=(400, 2500), ylim=(0, 0.8))
    ax.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), columnspacing=0.8)
    save(figure, arguments.out / "paper_figure_10.png")
    return results


if __name__ == "__main__":
    main()
