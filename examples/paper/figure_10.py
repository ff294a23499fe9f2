"""Figure 10: a leaf plate alone: what the simulation returns and lets through, on PROSPECT's spectra.

python examples/paper/figure_10.py [--out figures] [--small]
"""

import jax
import numpy as np
from _common import COLOURS, new_figure, options, save

import jaxlidar as jl


def main(argv=None) -> dict[str, float]:
    given = options(__doc__, argv)
    wavelength = np.arange(400.0, 2501.0, 50.0 if given.small else 1.0)
    leaf = jl.Prospect.paper()
    r, t = (np.asarray(x, float) for x in leaf(wavelength))
    plate = jl.Plate(height=1.0, reflectance=r, transmittance=t)
    lidar = jl.Lidar(wavelength=tuple(wavelength.tolist()))
    wave = jl.simulate(lidar, jl.Scene(plates=(plate,)), key=jax.random.key(0))
    returned = np.asarray(wave.reflectance, float).sum(axis=1)
    # Of all light, what neither came from the plate nor stayed in it went through.
    through = 1.0 - np.asarray(wave.energy_budget["absorbed by plate"], float) - returned
    found = {
        "largest difference of reflectance": float(np.max(np.abs(returned - r))),
        "largest difference of transmittance": float(np.max(np.abs(through - t))),
    }
    print(found)
    # Nothing is random here, and single precision rounds at 1e-7. The plate lies 1 m nearer than the plane
    # that apparent reflectance refers to, for which the time of arrival makes up.
    assert max(found.values()) < 2e-5

    every = slice(None, None, 1 if given.small else 50)
    figure, ax = new_figure()
    for line, points, colour, name in (
        (r, returned, COLOURS[2], "reflectance"),
        (t, through, COLOURS[0], "transmittance"),
    ):
        ax.plot(wavelength, line, color=colour, label=name)
        ax.plot(wavelength[every], points[every], "o", color=colour, markersize=3)
    ax.plot([], [], "o", color="0.5", markersize=3, label="simulated")
    ax.set(xlabel="wavelength (nm)", ylabel="reflectance, transmittance", xlim=(400, 2500), ylim=(0, 0.8))
    ax.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), columnspacing=0.8)
    save(figure, given.out / "paper_figure_10.png")
    return found


if __name__ == "__main__":
    main()
