"""Figure 2, Tables 3 and 4: the leaf of the paper by PROSPECT, and differences from the numbers of the paper.

Version 2.01 of PROSPECT has no public coefficients; see `Prospect.paper()` for the replacement.

    python examples/paper/figure_02.py [--out figures] [--small]
"""

import numpy as np
from _common import new_figure, options, save, table

import jaxlidar as jl

TABLE_4 = {532.0: (36, 8, 56), 1064.0: (66, 30, 4), 1550.0: (57, 27, 16)}


def main(argv=None) -> dict[str, float]:
    arguments = options(__doc__, argv)
    leaf = jl.Prospect.paper()
    laser = np.array(list(TABLE_4))
    r, t = (100 * np.asarray(x, float) for x in leaf(laser))
    simulated = np.stack([r, t, 100 - r - t], axis=1)
    differences = simulated - np.array(list(TABLE_4.values()))
    rows = [(f"{w:g}", *TABLE_4[w], *simulated[i], *differences[i]) for i, w in enumerate(laser)]
    names = ("R", "T", "A")
    table(("nm", *(f"paper {n}" for n in names), *names, *(f"off {n}" for n in names)), rows)
    results = {"rms difference, percentage points": float(np.sqrt(np.mean(differences**2)))}
    print(results)
    # The paper gives whole per cents: their rounding alone is 0.29.
    assert results["rms difference, percentage points"] < 0.3

    wavelength = np.arange(400.0, 2501.0)
    r, t = (np.asarray(x, float) for x in leaf(wavelength))
    figure, ax = new_figure()
    ax.fill_between(wavelength, 0, r, color="#009E73", alpha=0.5, linewidth=0, label="reflectance")
    ax.fill_between(wavelength, r, 1 - t, color="0.75", linewidth=0, label="absorptance")
    ax.fill_between(wavelength, 1 - t, 1, color="#56B4E9", alpha=0.5, linewidth=0, label="transmittance")
    ax.set(xlim=(400, 2500), ylim=(0, 1), xlabel="wavelength (nm)", ylabel="reflectance")
    for w, (reflected, transmitted, _) in TABLE_4.items():
        ax.plot([w, w], [reflected / 100, 1 - transmitted / 100], "k.", markersize=5)
    ax.plot([], [], "k.", markersize=5, label="Table 4")
    right = ax.twinx()
    right.set(ylim=(1, 0), ylabel="transmittance")
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    save(figure, arguments.out / "paper_figure_02.png")
    return results


if __name__ == "__main__":
    main()
